"""What an MCAP file holds, found without reading its messages.

The summary at the end of a file tells it at once. Where there is none, or it is not to be trusted,
a walk over the file's records finds the same.
"""

from __future__ import annotations

import struct
from collections import Counter
from itertools import pairwise

from isal import isal_zlib
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from trainlog.errors import LogError
from trainlog.mcap.codec import RECORD_HEAD
from trainlog.mcap.errors import damaged
from trainlog.mcap.places import ChunkPlace, Contents
from trainlog.mcap.records import parsed, records
from trainlog.mcap.source import Source
from trainlog.mcap.stored import attachment_place, heads
from trainlog.mcap.walk import check_is_mcap, contents_by_walk

_FOOTER_LENGTH = 20
_DATA_END_LENGTH = 4
_CHUNK_INDEX = struct.Struct("<QQQQI")
_INDEX_HEAD = RECORD_HEAD + 6
"""Bytes of a message index before its entries, of 16 bytes each."""


def contents_of(source: Source) -> Contents:
    """What a file holds: by its summary, or else by a walk.

    Raises
    ------
    LogError
        If it is not an MCAP file at all.
    """
    check_is_mcap(source)
    return contents_by_index(source) or contents_by_walk(source)


def contents_by_index(source: Source) -> Contents | None:
    """What a file holds by its summary; None if that is missing, damaged or does not tell all.

    The summary's checksum is verified. Every byte of the data section must belong to a chunk and
    its message indexes, as listed, or to a record that is no chunk and no message.
    """
    try:
        return _by_index(source)
    except LogError:
        return None


def _by_index(source: Source) -> Contents | None:
    footer_at = source.size - len(MCAP0_MAGIC) - _FOOTER_LENGTH - RECORD_HEAD
    closing = source.read(footer_at, source.size - footer_at) if footer_at > 0 else b""
    if source.read(0, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        return None
    if closing[:RECORD_HEAD] != struct.pack("<BQ", Opcode.FOOTER, _FOOTER_LENGTH):
        return None
    if closing[-len(MCAP0_MAGIC) :] != MCAP0_MAGIC:
        return None
    footer = parsed(Footer, memoryview(closing)[RECORD_HEAD : -len(MCAP0_MAGIC)], footer_at)
    start = footer.summary_start
    data_end = start - RECORD_HEAD - _DATA_END_LENGTH
    if not len(MCAP0_MAGIC) <= data_end < start <= footer_at:
        return None
    summary = source.read(data_end, footer_at - data_end) + closing[: RECORD_HEAD + 16]
    summary_at = RECORD_HEAD + _DATA_END_LENGTH
    stored = memoryview(summary)[summary_at:]
    if footer.summary_crc and isal_zlib.crc32(stored) != footer.summary_crc:
        return None
    if summary[:RECORD_HEAD] != struct.pack("<BQ", Opcode.DATA_END, _DATA_END_LENGTH):
        return None
    end = parsed(DataEnd, memoryview(summary)[RECORD_HEAD:summary_at], data_end)
    found = Contents(data_section=(data_end, end.data_section_crc), indexed=True)
    for at, opcode, content in records(stored[: footer_at - start]):
        _collect(opcode, content, start + at, found)
    found.chunks.sort()
    return found if _tells_all(source, found, data_end) else None


def _collect(opcode: int, content: memoryview, at: int, found: Contents) -> None:
    """Add one record of the summary to what was found."""
    if opcode == Opcode.CHUNK_INDEX:
        found.chunks.append(_chunk_place(content, at))
    elif opcode == Opcode.SCHEMA:
        schema = parsed(Schema, content, at)
        found.schemas.setdefault(schema.id, schema)
    elif opcode == Opcode.CHANNEL:
        channel = parsed(Channel, content, at)
        found.channels.setdefault(channel.id, channel)
    elif opcode == Opcode.STATISTICS:
        found.statistics = parsed(Statistics, content, at)


def _chunk_place(index: memoryview, at: int) -> ChunkPlace:
    """The place of a chunk by its index; the lengths of its message indexes give the counts.

    A long log has tens of thousands: the class of the mcap package takes ten times as long.
    """
    try:
        start, end, offset, length, width = _CHUNK_INDEX.unpack_from(index)
        listed = sorted(
            (place, channel) for channel, place in struct.iter_unpack("<HQ", index[36 : 36 + width])
        )
        message_indexes, named = struct.unpack_from("<QI", index, 36 + width)
        compression = str(index[48 + width : 48 + width + named], "utf-8")
        stored, size = struct.unpack_from("<QQ", index, 48 + width + named)
    except (struct.error, UnicodeDecodeError) as error:
        raise damaged(at, "the chunk index record cannot be read") from error
    behind = offset + length
    counts = {}
    for (place, channel), (following, _) in pairwise([*listed, (behind + message_indexes, 0)]):
        counts[channel], rest = divmod(following - place - _INDEX_HEAD, 16)
        if rest or counts[channel] < 0:
            raise damaged(at, "the message indexes of a chunk are not of their lengths")
    if (listed and listed[0][0] != behind) or len(counts) < len(listed) or stored > length:
        raise damaged(at, "a chunk index contradicts itself")
    return ChunkPlace(
        offset,
        length,
        compression,
        behind - stored,
        stored,
        size,
        start,
        end,
        {channel: place for place, channel in listed},
        behind + message_indexes,
        {channel: count for channel, count in counts.items() if count},
    )


def _tells_all(source: Source, found: Contents, data_end: int) -> bool:
    """Whether the summary leaves out nothing; metadata and attachments are collected meanwhile."""
    spans = [(chunk.offset, chunk.behind) for chunk in found.chunks]
    limits = [(0, len(MCAP0_MAGIC)), *spans, (data_end, data_end)]
    for (_, start), (end, _) in pairwise(limits):
        if start > end:
            return False
        for at, opcode, length in heads(source, start, end):
            if opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.DATA_END, Opcode.FOOTER):
                return False
            if opcode == Opcode.ATTACHMENT:
                found.attachments.append(attachment_place(source, at, RECORD_HEAD + length))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
                content = memoryview(source.read(at + RECORD_HEAD, length))
                if opcode == Opcode.METADATA:
                    found.metadata.append(parsed(Metadata, content, at))
                else:
                    _collect(opcode, content, at, found)
    counts = found.counts()
    if not counts.keys() <= found.channels.keys():
        return False
    if found.statistics is None:
        return all(chunk.indexes for chunk in found.chunks)
    told = Counter(found.statistics.channel_message_counts)
    return counts == +told and counts.total() == found.statistics.message_count

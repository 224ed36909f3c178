"""What an MCAP file holds, found by one walk over its records.

The walk needs no summary, so it serves files without one and the readable part of damaged ones.
Chunks stay compressed unless something in them has to be looked up.
"""

from __future__ import annotations

from isal import isal_zlib
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from trainlog.errors import LogError
from trainlog.mcap.account import Loss
from trainlog.mcap.errors import damaged
from trainlog.mcap.layout import RECORD_HEAD
from trainlog.mcap.places import ChunkPlace, Contents
from trainlog.mcap.records import index_of, opened, parsed, records, stored_index
from trainlog.mcap.source import Source
from trainlog.mcap.stored import attachment_place, chunk_place, fetched, heads, loose_place

_DATA_END_LENGTH = 4


def contents_by_walk(source: Source) -> Contents:
    """What a file holds as far as it can be read, by a walk over its records.

    Parameters
    ----------
    source : Source
        Of a file that begins as an MCAP file does.
    """
    found = Contents()
    at = len(MCAP0_MAGIC)
    try:
        for at, opcode, length in heads(source, len(MCAP0_MAGIC), source.size):
            if opcode == Opcode.FOOTER:
                _check_end(source, found, at, length)
                break
            _add(source, found, at, opcode, length)
        else:
            at = source.size
            raise damaged(at, "the file ends without its closing records")
    except LogError as error:
        start = _place(error, at)
        found.losses.append(Loss(start, source.size, error.problem))
    _complete(source, found)
    return found


def _add(source: Source, found: Contents, at: int, opcode: int, length: int) -> None:
    """Add one record to what was found; those that only repeat or point are passed over."""
    behind = at + RECORD_HEAD + length
    last = found.chunks[-1] if found.chunks else None
    if opcode == Opcode.MESSAGE:
        if last is not None and last.loose and last.behind == at:
            found.chunks[-1] = loose_place(last.offset, behind)
        else:
            found.chunks.append(loose_place(at, behind))
    elif opcode == Opcode.CHUNK:
        found.chunks.append(chunk_place(source, at, RECORD_HEAD + length))
    elif opcode == Opcode.ATTACHMENT:
        found.attachments.append(attachment_place(source, at, RECORD_HEAD + length))
    elif opcode == Opcode.MESSAGE_INDEX:
        if last is None:
            raise damaged(at, "a message index comes before any chunk")
        channel, entries = stored_index(memoryview(source.read(at + RECORD_HEAD, length)), at)
        if len(entries):
            last.indexes[channel] = at
            last.counts[channel] = len(entries)
        found.chunks[-1] = last._replace(behind=behind)
    else:
        _collect(opcode, memoryview(source.read(at + RECORD_HEAD, length)), at, found)


def _collect(opcode: int, content: memoryview, at: int, found: Contents) -> None:
    if opcode == Opcode.SCHEMA:
        schema = parsed(Schema, content, at)
        found.schemas.setdefault(schema.id, schema)
    elif opcode == Opcode.CHANNEL:
        channel = parsed(Channel, content, at)
        found.channels.setdefault(channel.id, channel)
    elif opcode == Opcode.METADATA:
        found.metadata.append(parsed(Metadata, content, at))
    elif opcode == Opcode.STATISTICS:
        found.statistics = parsed(Statistics, content, at)
    elif opcode == Opcode.DATA_END:
        found.data_section = (at, parsed(DataEnd, content, at).data_section_crc)


def _check_end(source: Source, found: Contents, at: int, length: int) -> None:
    """Check how the file ends and its summary; raises LogError where that fails."""
    footer = parsed(Footer, memoryview(source.read(at + RECORD_HEAD, length)), at)
    behind = at + RECORD_HEAD + length
    if source.read(behind, source.size) != MCAP0_MAGIC:
        raise damaged(behind, "the file does not end where its footer does")
    if found.data_section is None:
        raise damaged(at, "the data section has no end")
    summary = found.data_section[0] + RECORD_HEAD + _DATA_END_LENGTH
    if footer.summary_start not in (0, summary):
        raise damaged(at, "the footer does not point to the summary")
    stored = source.read(summary, behind - 4 - summary)
    if footer.summary_crc and isal_zlib.crc32(stored) != footer.summary_crc:
        raise damaged(summary, "the summary fails its checksum")


def _place(error: LogError, at: int) -> int:
    """The byte that the error names."""
    word, _, number = (error.place or "").partition(" ")
    return int(number) if word == "byte" and number.isdigit() else at


def _complete(source: Source, found: Contents) -> None:
    """Look into the chunks that lack an index, or hold channels that are declared nowhere else.

    The same for all chunks if their indexes do not list what the statistics count, and for the
    last one of a file that breaks off, whose indexes may be cut.
    """
    told = found.statistics.channel_message_counts if found.statistics else None
    counts = {channel: count for channel, count in found.counts().items() if count}
    astray = told is not None and counts != {c: n for c, n in told.items() if n}
    chunks, found.chunks = found.chunks, []
    for number, chunk in enumerate(chunks, start=1):
        cut = bool(found.losses) and number == len(chunks)
        known = chunk.indexes and chunk.counts.keys() <= found.channels.keys()
        if known and not astray and not cut:
            found.chunks.append(chunk)
            continue
        try:
            found.chunks.append(_looked_into(source, chunk, found))
        except LogError as error:
            messages = chunk.messages if chunk.counts else None
            found.losses.append(Loss(chunk.offset, chunk.behind, error.problem, messages))


def _looked_into(source: Source, chunk: ChunkPlace, found: Contents) -> ChunkPlace:
    """The chunk, counted by its records; schemas and channels among them are collected."""
    content = opened(fetched(source, chunk), check=True)
    index = index_of(content, chunk.offset)
    for _, opcode, body in records(memoryview(content)):
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _collect(opcode, body, chunk.offset, found)
    unknown = index.keys() - found.channels.keys()
    if unknown:
        raise damaged(chunk.offset, f"messages of channel {min(unknown)}, which is not declared")
    counts = {channel: len(entries) for channel, entries in index.items()}
    return chunk._replace(indexes={}, counts=counts)

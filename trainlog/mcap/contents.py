"""What an MCAP file holds, found by one walk over its records.

The walk needs no summary, so it serves whole files, files without one, and the readable part of
damaged ones alike. Chunks stay compressed unless something in them has to be looked up.
"""

from __future__ import annotations

import zlib
from collections import Counter
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Footer, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from trainlog.errors import LogError
from trainlog.mcap.errors import damaged, shown
from trainlog.mcap.layout import RECORD_HEAD
from trainlog.mcap.records import (
    Index,
    StoredChunk,
    index_of,
    opened,
    parsed,
    records,
    stored_chunk,
    stored_index,
)

_DATA_END_LENGTH = 4


@dataclass
class Contents:
    """What an MCAP file holds, as far as it can be read.

    Attributes
    ----------
    schemas, channels : dict by id
    metadata : list of mcap.records.Metadata
    attachments : list of mcap.records.Attachment
    chunks : list of (StoredChunk, Index)
        With the messages of each channel.
    statistics : mcap.records.Statistics or None
    damage : LogError or None
        What is wrong with the file, with its byte offset; None if it is whole and ends properly.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    chunks: list[tuple[StoredChunk, Index]] = field(default_factory=list)
    statistics: Statistics | None = None
    damage: LogError | None = None

    def counts(self) -> Counter[int]:
        """Number of messages by channel id."""
        counted: Counter[int] = Counter()
        for _, index in self.chunks:
            counted.update({channel: len(entries) for channel, entries in index.items()})
        return counted

    def schema(self, channel: Channel) -> Schema | None:
        """The schema of a channel, if it has one."""
        return self.schemas.get(channel.schema_id)


def contents_of(data: bytes) -> Contents:
    """What the file whose bytes are `data` holds, as far as it can be read.

    Whatever has a checksum is checked. In a damaged file the chunks that fail are left out.

    Raises
    ------
    LogError
        If it is not an MCAP file at all.
    """
    if data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
        what = "is not an MCAP file" if data else "is empty"
        raise LogError(what, place="byte 0", remedy="expected a log in the MCAP format")
    found = Contents()
    try:
        _walk(memoryview(data), found)
    except LogError as error:
        found.damage = error
        _keep_whole_chunks(found)
    _complete(found)
    return found


def _walk(data: memoryview, found: Contents) -> None:
    """Collect the file's records; raises LogError at the first damage."""
    data_end: tuple[int, DataEnd] | None = None
    loose = range(0)
    try:
        for at, opcode, content in records(data, start=len(MCAP0_MAGIC)):
            if opcode == Opcode.MESSAGE:
                loose = range(loose.start or at, at + RECORD_HEAD + len(content))
                continue
            _add_loose_messages(data, loose, found)
            loose = range(0)
            if opcode == Opcode.DATA_END:
                data_end = (at, parsed(DataEnd, content, at))
            elif opcode == Opcode.FOOTER:
                _check(data, found, data_end, at, parsed(Footer, content, at))
                return
            else:
                _collect(opcode, content, at, found)
    except LogError:
        _add_loose_messages(data, loose, found)
        raise
    _add_loose_messages(data, loose, found)
    raise damaged(len(data), "the file ends without its closing records")


def _add_loose_messages(data: memoryview, span: range, found: Contents) -> None:
    """Take a run of messages outside of chunks as if it were a chunk that is not compressed."""
    if span:
        stored = data[span.start : span.stop]
        found.chunks.append((StoredChunk(span.start, "", stored, len(stored), checksum=0), {}))


def _collect(opcode: int, content: memoryview, at: int, found: Contents) -> None:
    """Add one record to what was found; those that only repeat or point are passed over."""
    if opcode == Opcode.SCHEMA:
        schema = parsed(Schema, content, at)
        found.schemas.setdefault(schema.id, schema)
    elif opcode == Opcode.CHANNEL:
        channel = parsed(Channel, content, at)
        found.channels.setdefault(channel.id, channel)
    elif opcode == Opcode.METADATA:
        found.metadata.append(parsed(Metadata, content, at))
    elif opcode == Opcode.ATTACHMENT:
        attachment = parsed(Attachment, content, at)
        checksum = int.from_bytes(content[-4:], "little")
        if checksum and zlib.crc32(content[:-4]) != checksum:
            raise damaged(at, f"attachment {shown(attachment.name)} fails its checksum")
        found.attachments.append(attachment)
    elif opcode == Opcode.CHUNK:
        found.chunks.append((stored_chunk(content, at), {}))
    elif opcode == Opcode.MESSAGE_INDEX:
        channel_id, entries = stored_index(content, at)
        if not found.chunks:
            raise damaged(at, "a message index comes before any chunk")
        if len(entries):
            found.chunks[-1][1][channel_id] = entries
    elif opcode == Opcode.STATISTICS:
        found.statistics = parsed(Statistics, content, at)


def _check(
    data: memoryview, found: Contents, data_end: tuple[int, DataEnd] | None, at: int, footer: Footer
) -> None:
    """Check how the file ends and its checksums; raises LogError where one fails."""
    footer_end = at + RECORD_HEAD + 20
    if bytes(data[footer_end:]) != MCAP0_MAGIC:
        raise damaged(footer_end, "the file does not end where its footer does")
    if data_end is None:
        raise damaged(at, "the data section has no end")
    data_length, end = data_end
    summary = data_length + RECORD_HEAD + _DATA_END_LENGTH
    if footer.summary_start not in (0, summary):
        raise damaged(at, "the footer does not point to the summary")
    if footer.summary_crc and zlib.crc32(data[summary : footer_end - 4]) != footer.summary_crc:
        raise damaged(summary, "the summary fails its checksum")
    whole = end.data_section_crc
    if whole and zlib.crc32(data[:data_length]) == whole:
        return
    for chunk, _ in found.chunks:
        opened(chunk, check=True)
    if whole:
        raise damaged(len(MCAP0_MAGIC), "a record between the chunks fails the checksum")


def _keep_whole_chunks(found: Contents) -> None:
    """Drop the chunks of a damaged file that fail, and rebuild the index of the others."""
    whole = []
    for chunk, _ in found.chunks:
        try:
            opened(chunk, check=True)
        except LogError:
            continue
        whole.append((chunk, Index()))
    found.chunks = whole
    found.statistics = None


def _complete(found: Contents) -> None:
    """Look into the chunks that lack an index, or hold channels that are declared nowhere else.

    The same for all chunks if their indexes do not list what the statistics count.
    """
    counted = found.statistics.channel_message_counts if found.statistics else None
    known = {channel: count for channel, count in found.counts().items() if count}
    astray = counted is not None and known != {c: n for c, n in counted.items() if n}
    usable = []
    for chunk, index in found.chunks:
        if index and not astray and index.keys() <= found.channels.keys():
            usable.append((chunk, index))
            continue
        try:
            usable.append((chunk, _look_into(chunk, found)))
        except LogError as error:
            found.damage = found.damage or error
    found.chunks = usable


def _look_into(chunk: StoredChunk, found: Contents) -> Index:
    """Index of a chunk by its records; schemas and channels among them are collected."""
    content = opened(chunk)
    index = index_of(content, chunk.offset)
    for _, opcode, body in records(memoryview(content)):
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _collect(opcode, body, chunk.offset, found)
    unknown = index.keys() - found.channels.keys()
    if unknown:
        raise damaged(chunk.offset, f"messages of channel {min(unknown)}, which is not declared")
    return index

"""What an MCAP file holds and where it stands: by the summary at its end, without its messages.

Also how the parts are fetched: chunks, message indexes, attachments. `trainlog.mcap.scan` finds
the same in files whose summary is missing, damaged or incomplete.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

from trainlog.errors import LogError
from trainlog.mcap.account import Account, Loss, Unfinished
from trainlog.mcap.records import (
    DECLARATIONS,
    KINDS,
    RECORD_HEAD,
    RECORDING_RECORD,
    Index,
    Source,
    StoredChunk,
    checksum,
    damaged,
    index_of,
    opened,
    parsed,
    record_head,
    records,
    shown,
    stored_chunk,
    stored_index,
)

MAGIC: bytes = MCAP0_MAGIC
"""The first and the last eight bytes of every MCAP file."""

_PIECE = 2**22
"""Read at once for a checksum [bytes]."""

_WINDOW = 4096
"""Read at once while going from record to record [bytes]; most heads are far apart."""

_LONGEST_HEAD = 65_536
"""Longer names and media types of attachments are refused [bytes]."""

_FOOTER_LENGTH = 20
_DATA_END_LENGTH = 4
_CHUNK_INDEX = struct.Struct("<QQQQI")
_INDEX_HEAD = RECORD_HEAD + 6
"""Bytes of a message index before its entries, of 16 bytes each."""


class MisplacedError(LogError):
    """Something is not where the summary says; a scan of the file may find it."""


class ChunkPlace(NamedTuple):
    """Where a chunk stands, or a run of messages outside of chunks as if it were one.

    Attributes
    ----------
    offset, length : int
        Where its record begins, and the record's length with its head [bytes].
    compression : str
    data, stored : int
        Where its content as stored begins, and the content's length [bytes].
    size : int
        Length of its content when decompressed, as the record says [bytes].
    start, end : int
        Log time of its first and last message, as the record says [ns]; zero if nothing says so.
    indexes : dict of int to int
        Where the message index of each channel stands in the file; empty if they have to be found
        by going through the chunk's records.
    behind : int
        Where the next record begins that is not one of its message indexes.
    counts : dict of int to int
        Number of messages by channel id.
    """

    offset: int
    length: int
    compression: str
    data: int
    stored: int
    size: int
    start: int
    end: int
    indexes: dict[int, int]
    behind: int
    counts: dict[int, int]

    @property
    def loose(self) -> bool:
        """Whether it is a run of messages outside of chunks."""
        return self.data == self.offset

    @property
    def messages(self) -> int:
        """Number of messages of all channels."""
        return sum(self.counts.values())


class AttachmentPlace(NamedTuple):
    """Where an attachment stands; `data` and `size` are those of its content.

    Attributes
    ----------
    offset, length : int
        Where its record begins, and the record's length with its head [bytes].
    name, media_type : str
    log_time, create_time : int
        [ns since 1970 UTC]
    data, size : int
        Where its content begins, and the content's length [bytes].
    """

    offset: int
    length: int
    name: str
    media_type: str
    log_time: int
    create_time: int
    data: int
    size: int


@dataclass
class Contents:
    """What an MCAP file holds, as far as it can be read.

    Attributes
    ----------
    schemas, channels : dict by id
    metadata : list of mcap.records.Metadata
    attachments : list of AttachmentPlace
    chunks : list of ChunkPlace
        In the order of the file.
    statistics : mcap.records.Statistics or None
        As the file has it.
    data_section : (int, int) or None
        Where the data section ends, and its CRC-32, 0 if the file does not have it; None if the
        file ends without one.
    indexed : bool
        Whether all this comes from the summary, not from a scan of the file.
    losses : list of Loss
        What could not be read so far.
    expected : int or None
        How many messages the file held, by its statistics; None if these are not readable.
    closed : bool
        Whether the file has its closing records.
    profile : str
        Of the header, if a scan read that.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[AttachmentPlace] = field(default_factory=list)
    chunks: list[ChunkPlace] = field(default_factory=list)
    statistics: Statistics | None = None
    data_section: tuple[int, int] | None = None
    indexed: bool = False
    losses: list[Loss] = field(default_factory=list)
    expected: int | None = None
    closed: bool = True
    profile: str = ""

    def declare(self, record: Schema | Channel) -> None:
        """Add a schema or channel; of several with the same number the first counts."""
        if isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        else:
            self.channels.setdefault(record.id, record)

    def counts(self) -> Counter[int]:
        """Number of messages by channel id."""
        counted: Counter[int] = Counter()
        for chunk in self.chunks:
            counted.update(chunk.counts)
        return counted

    def schema(self, channel: Channel) -> Schema | None:
        """The schema of a channel, if it has one."""
        return self.schemas.get(channel.schema_id)

    def drop(self, chunk: ChunkPlace, reason: str) -> None:
        """Leave out a chunk that turned out to be damaged."""
        self.chunks.remove(chunk)
        self.losses.append(Loss(chunk.offset, chunk.behind, reason, chunk.messages))

    @property
    def account(self) -> Account:
        """What is readable and what is lost, as far as it is known by now."""
        losses = sorted(self.losses, key=lambda loss: (loss.start, loss.end))
        return Account(
            self.counts().total(),
            len(self.chunks),
            tuple(losses),
            None if self.closed else self._unfinished(),
            self.expected,
        )

    def _unfinished(self) -> Unfinished | None:
        """How a live recording ended that was not closed; None if this is none."""
        flush = None
        for record in self.metadata:
            if record.name == RECORDING_RECORD:
                if "closed" in record.metadata:
                    return None
                flush = record.metadata.get("flush", flush)
        try:
            period = float(flush or "nan")
        except ValueError:
            return None
        last = max((chunk.end for chunk in self.chunks if chunk.counts), default=None)
        return Unfinished(last, period) if period >= 0 else None


@dataclass
class Summary:
    """What the summary at the end of a file says, and where the records are that it lists.

    Attributes
    ----------
    contents : Contents
        The chunks as they are listed, schemas, channels and statistics.
    start : int
        Where the summary begins; the data section ends before it.
    listed : list of int
        Where the attachments and metadata begin that it lists.
    """

    contents: Contents
    start: int
    listed: list[int] = field(default_factory=list)

    @property
    def data_end(self) -> int:
        """Where the record stands that ends the data section."""
        return self.start - RECORD_HEAD - _DATA_END_LENGTH


def summary_of(source: Source) -> Summary | None:
    """The summary of a file; None if it has none, or one that fails its checksum."""
    try:
        return _summary(source)
    except LogError:
        return None


def _summary(source: Source) -> Summary | None:
    footer_at = source.size - len(MAGIC) - _FOOTER_LENGTH - RECORD_HEAD
    closing = source.read(footer_at, source.size - footer_at) if footer_at > 0 else b""
    if closing[-len(MAGIC) :] != MAGIC:
        return None
    if closing[:RECORD_HEAD] != struct.pack("<BQ", Opcode.FOOTER, _FOOTER_LENGTH):
        return None
    footer = parsed(Footer, memoryview(closing)[RECORD_HEAD : -len(MAGIC)], footer_at)
    found = Summary(Contents(indexed=True), footer.summary_start)
    if not len(MAGIC) <= found.data_end < found.start <= footer_at:
        return None
    data = source.read(found.data_end, footer_at - found.data_end) + closing[: RECORD_HEAD + 16]
    head = RECORD_HEAD + _DATA_END_LENGTH
    stored = memoryview(data)[head:]
    if footer.summary_crc and checksum(stored) != footer.summary_crc:
        return None
    if data[:RECORD_HEAD] == struct.pack("<BQ", Opcode.DATA_END, _DATA_END_LENGTH):
        end = parsed(DataEnd, memoryview(data)[RECORD_HEAD:head], found.data_end)
        found.contents.data_section = (found.data_end, end.data_section_crc)
    for at, opcode, content in records(stored[: footer_at - found.start]):
        _collect(opcode, content, found.start + at, found)
    found.contents.chunks.sort()
    return found


def _collect(opcode: int, content: memoryview, at: int, found: Summary) -> None:
    """Add one record of the summary to what was found."""
    if opcode == Opcode.CHUNK_INDEX:
        found.contents.chunks.append(_chunk_place(content, at))
    elif opcode in DECLARATIONS:
        found.contents.declare(parsed(KINDS[opcode], content, at))
    elif opcode == Opcode.STATISTICS:
        found.contents.statistics = parsed(Statistics, content, at)
    elif opcode == Opcode.ATTACHMENT_INDEX:
        found.listed.append(parsed(AttachmentIndex, content, at).offset)
    elif opcode == Opcode.METADATA_INDEX:
        found.listed.append(parsed(MetadataIndex, content, at).offset)


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


def contents_by_summary(source: Source) -> Contents | None:
    """What a file holds by its summary; None if that is missing, damaged or incomplete.

    Every byte of the data section must belong to a chunk and its message indexes, as listed, or to
    a record that is no chunk and no message.
    """
    summary = summary_of(source) if source.read(0, len(MAGIC)) == MAGIC else None
    try:
        return summary.contents if summary is not None and _complete(source, summary) else None
    except LogError:
        return None


def _complete(source: Source, summary: Summary) -> bool:
    """Whether a summary leaves out nothing; metadata and attachments are collected meanwhile."""
    found, data_end = summary.contents, summary.data_end
    if found.data_section is None:
        return False
    spans = [(chunk.offset, chunk.behind) for chunk in found.chunks]
    limits = [(0, len(MAGIC)), *spans, (data_end, data_end)]
    for (_, start), (end, _) in pairwise(limits):
        if start > end:
            return False
        for at, opcode, length in heads(source, start, end):
            if opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.DATA_END, Opcode.FOOTER):
                return False
            if opcode == Opcode.ATTACHMENT:
                found.attachments.append(attachment_place(source, at, RECORD_HEAD + length))
            elif opcode in (Opcode.METADATA, *DECLARATIONS):
                content = memoryview(source.read(at + RECORD_HEAD, length))
                if opcode == Opcode.METADATA:
                    found.metadata.append(parsed(Metadata, content, at))
                else:
                    found.declare(parsed(KINDS[opcode], content, at))
    counts = found.counts()
    if not counts.keys() <= found.channels.keys():
        return False
    if found.statistics is None:
        return all(chunk.indexes for chunk in found.chunks)
    stated = Counter(found.statistics.channel_message_counts)
    found.expected = found.statistics.message_count
    return counts == +stated and counts.total() == found.expected


def heads(source: Source, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Offset, opcode and length of the content of each record from `start` to `end` of a file.

    Raises
    ------
    LogError
        Where a record leads beyond `end`.
    """
    at, base, window = start, start, b""
    while at < end:
        if not base <= at <= base + len(window) - RECORD_HEAD:
            base, window = at, source.read(at, _WINDOW)
        opcode, length = record_head(window[at - base :][:RECORD_HEAD], at, end)
        yield at, opcode, length
        at += RECORD_HEAD + length


def fetched(source: Source, place: ChunkPlace) -> StoredChunk:
    """The chunk that stands there.

    Raises
    ------
    MisplacedError
        If there is no such chunk.
    """
    record = memoryview(source.read(place.offset, place.length))
    if place.loose:
        return StoredChunk(place.offset, "", record, place.size, checksum=0)
    try:
        if record[:RECORD_HEAD] == struct.pack("<BQ", Opcode.CHUNK, place.length - RECORD_HEAD):
            chunk = stored_chunk(record[RECORD_HEAD:], place.offset)
            if (chunk.compression, chunk.size) == (place.compression, place.size):
                return chunk
    except LogError as error:
        raise MisplacedError(error.problem, place=error.place, remedy=error.remedy) from error
    raise MisplacedError(
        "the chunk is not where the summary says",
        place=f"byte {place.offset}",
        remedy="copy or record it again",
    )


def fetched_index(source: Source, place: ChunkPlace, channels: Iterable[int]) -> Index:
    """The message index of those of the channels that the chunk holds.

    Raises
    ------
    LogError
        If it cannot be read, or lists another number of messages than it should.
    """
    found: Index = {}
    wanted = [channel for channel in channels if channel in place.indexes]
    if not wanted:
        return found
    first = min(place.indexes[channel] for channel in wanted)
    last = max(
        place.indexes[channel] + _INDEX_HEAD + 16 * place.counts[channel] for channel in wanted
    )
    stored = memoryview(source.read(first, last - first))
    for channel in wanted:
        at, size = place.indexes[channel] - first, 16 * place.counts[channel]
        head = struct.pack("<HI", channel, size)
        if stored[at] != Opcode.MESSAGE_INDEX or stored[at + RECORD_HEAD :][:6] != head:
            raise damaged(first + at, "the message index record cannot be read")
        entries = stored_index(stored[at + RECORD_HEAD :][: 6 + size], first + at)[1]
        if len(entries):
            found[channel] = entries
    return found


def index_in(source: Source, place: ChunkPlace) -> Index:
    """The message index of all channels of a chunk: as stored, or else from the chunk's records.

    Raises
    ------
    LogError
        If neither can be read.
    """
    if place.indexes:
        with suppress(LogError):
            return fetched_index(source, place, place.counts)
    index = index_of(opened(fetched(source, place), check=True), place.offset)
    return {channel: entries for channel, entries in index.items() if channel in place.counts}


def attachment_place(source: Source, offset: int, length: int) -> AttachmentPlace:
    """Where the attachment's content stands whose record of `length` bytes begins at `offset`.

    Raises
    ------
    LogError
        If the record is no attachment.
    """
    texts = []
    head = source.read(offset + RECORD_HEAD, min(length - RECORD_HEAD, _LONGEST_HEAD))
    try:
        log_time, create_time = struct.unpack_from("<QQ", head)
        at = 16
        for _ in range(2):
            (width,) = struct.unpack_from("<I", head, at)
            at += 4 + width
            texts.append(str(head[at - width : at], "utf-8"))
        (size,) = struct.unpack_from("<Q", head, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise damaged(offset, "the attachment record cannot be read") from error
    data = offset + RECORD_HEAD + at + 8
    if data + size + 4 > offset + length:
        raise damaged(offset, "the attachment's length contradicts its record's")
    return AttachmentPlace(offset, length, texts[0], texts[1], log_time, create_time, data, size)


def attachment_data(source: Source, place: AttachmentPlace) -> bytes:
    """The content of an attachment, checked.

    Raises
    ------
    LogError
        If it fails its checksum.
    """
    check_attachment(source, place)
    return source.read(place.data, place.size)


def check_attachment(source: Source, place: AttachmentPlace) -> None:
    """Verify the checksum of an attachment, if it has one.

    Raises
    ------
    LogError
        If it fails.
    """
    end = place.data + place.size
    expected = int.from_bytes(source.read(end, 4), "little")
    if expected and checksum_of(source, place.offset + RECORD_HEAD, end) != expected:
        raise damaged(place.offset, f"attachment {shown(place.name)} fails its checksum")


def checksum_of(source: Source, start: int, end: int) -> int:
    """CRC-32 of the file from `start` to `end`."""
    found = 0
    for at in range(start, end, _PIECE):
        found = checksum(source.read(at, min(_PIECE, end - at)), found)
    return found

"""What an MCAP file holds and where it stands; with an account of what is lost.

The summary at the end of a file says it without the messages. Files whose summary is missing,
damaged or incomplete are gone through record by record. One rule: a chunk whose checksum holds is
kept. Everything else that cannot be read is one `Loss` with its range of bytes, its messages
counted where the summary or the message indexes know them. Also how the parts are fetched: chunks,
message indexes, attachments.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

from trainlog.arrays import UintArray
from trainlog.errors import LogError
from trainlog.formats.files import LOOKED_AT, mistaken_log
from trainlog.mcap.account import NOT_CLOSED, Account, Loss, Unfinished
from trainlog.mcap.records import (
    DECLARATIONS,
    KINDS,
    MESSAGE,
    RECORD_HEAD,
    RECORDING_RECORD,
    Index,
    Source,
    StoredChunk,
    checksum,
    damaged,
    index_of,
    measured,
    opened,
    parsed,
    record_head,
    records,
    shown,
    stored_chunk,
    stored_index,
    tally,
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


_T = TypeVar("_T")

_LONGEST_RUN = 2**20
"""Messages outside of chunks are taken together up to this length [bytes]."""

_LONGEST_RECORD = 2**26
"""Longer records are refused, but chunks, attachments and those that nobody knows [bytes]."""

_SEARCHED = 2**22
"""Where the beginning of a file is damaged, a chunk is sought in so much of it [bytes]."""

_SURE = (Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.MESSAGE)
"""Records that have a checksum, or are only taken if another record follows."""

_CONVERTED = {b"\x89MCAP0\n": "CRLF to LF", b"\x89MCAP0\r\r\n": "LF to CRLF"}
"""How a file begins whose line ends a program has converted that took it for a text."""


def contents_of(source: Source) -> Contents:
    """What a file holds: by its summary, or else by a scan.

    Raises
    ------
    LogError
        If it is not an MCAP file at all.
    """
    check_is_mcap(source)
    return contents_by_summary(source) or scanned(source)


def contents_used(source: Source, use: Callable[[Contents], _T]) -> tuple[Contents, _T]:
    """What a file holds, and what `use` makes of that: by the summary, or by a scan if it is wrong.

    Raises
    ------
    LogError
        If it is not an MCAP file at all, or as `use`.
    """
    contents = contents_of(source)
    try:
        return contents, use(contents)
    except MisplacedError:
        contents = scanned(source)
        return contents, use(contents)


def checksum_holds(source: Source, contents: Contents) -> bool:
    """Whether the records of a file hold their checksum, where only its summary was gone by.

    It is so of a file that states none, and of one whose records were gone through.
    """
    end, expected = contents.data_section or (0, 0)
    return not (contents.indexed and expected) or checksum_of(source, 0, end) == expected


def check_is_mcap(source: Source) -> None:
    """Raise a LogError if the file neither begins nor ends as an MCAP file, nor holds a chunk."""
    start = source.read(0, LOOKED_AT)
    if start.startswith(MAGIC):
        return
    if source.read(max(0, source.size - len(MAGIC)), len(MAGIC)) == MAGIC:
        return
    converted = converted_line_ends(start)
    if converted is not None:
        raise LogError(converted[0], place="byte 0", remedy=converted[1])
    searched = min(source.size, _SEARCHED)
    if Finder(source).search(0, searched) == searched:
        what, remedy = mistaken_log(start)
        raise LogError(what, place="byte 0", remedy=remedy)


def converted_line_ends(start: bytes) -> tuple[str, str] | None:
    r"""Problem and remedy if a file that begins with `start` is MCAP with converted line ends.

    Examples
    --------
    >>> converted_line_ends(b"\x89MCAP0\n")[0]
    'is an MCAP file whose line ends were converted from CRLF to LF, as in a text'
    """
    for magic, conversion in _CONVERTED.items():
        if start.startswith(magic):
            return (
                f"is an MCAP file whose line ends were converted from {conversion}, as in a text",
                "copy it again in binary mode; in git, '*.mcap -text' in .gitattributes",
            )
    return None


def scanned(source: Source) -> Contents:
    """What a file holds as far as it can be read, by going through its records.

    Parameters
    ----------
    source : Source
        Of an MCAP file.
    """
    return _Scan(source).go()


class _Scan:
    """One scan: from record to record, and what it found."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._finder = Finder(source)
        self._size = source.size
        self._summary = summary_of(source)
        places = []
        if self._summary is not None:
            places = [chunk.offset for chunk in self._summary.contents.chunks]
            places += [*self._summary.listed, self._summary.data_end, self._summary.start]
        self._places = sorted(places)
        """Where records begin that the summary lists."""
        self._found = Contents(closed=False)
        self._losses: list[Loss] = []
        self._sections = [Contents()]
        """What each file declares and holds: several where files were joined."""
        self._declared = Contents()
        """What the summary of the last of them declares."""
        self._data_end: tuple[int, DataEnd] | None = None
        self._footer: tuple[int, Footer] | None = None
        self._read_to = 0
        """Up to where the summary is read that has no footer."""
        self._seen: dict[tuple[int, int, int, int], int] = {}
        self._repeated: list[tuple[ChunkPlace, int]] = []
        """Chunks that come again, and where they came first."""

    def go(self) -> Contents:
        """Go through the file to its end."""
        at = min(len(MAGIC), self._size)
        if self._finder.read(0, len(MAGIC)) != MAGIC:
            self._lose(0, at, "the file does not begin as an MCAP file does", 0)
        doubtful = at
        while at < self._size:
            kind = self._finder.read(at, 1)[0]
            try:
                behind = self._step(at)
                doubtful = behind if kind in _SURE else at
            except LogError as error:
                # Where bytes are missing, the record before may have taken the head of a chunk.
                doubtful = max(doubtful, *(loss.end for loss in self._losses[-1:]), 0)
                behind = self._finder.search(doubtful + 1, at)
                if behind < at:
                    at = doubtful
                else:
                    behind = self._next(at + 1)
                self._lose(at, behind, error.problem, None)
                doubtful = behind
            at = behind
        return self._settled()

    def _next(self, start: int) -> int:
        """Where to go on behind damage."""
        listed = (at for at in self._places if at >= start and self._finder.follows(at))
        chunks = self._sections[-1].chunks
        return self._finder.search(
            start, next(listed, self._size), messages=bool(chunks) and chunks[-1].loose
        )

    def _lose(self, start: int, end: int, reason: str, messages: int | None) -> None:
        """Note a loss; one that adjoins the last continues it."""
        last = self._losses[-1] if self._losses else None
        if last is not None and last.end == start and last.start < last.end and start < end:
            known = last.messages is not None and messages is not None
            both = (last.messages or 0) + (messages or 0) if known else None
            self._losses[-1] = Loss(last.start, end, last.reason, both)
        else:
            self._losses.append(Loss(start, end, reason, messages))

    # -------------------------------------------------------------------------------- the records

    def _step(self, at: int) -> int:
        """Take the record at `at`; returns where the next begins; LogError if it is damaged."""
        finder = self._finder
        if finder.begins(at):
            return self._join(at)
        if finder.read(at, len(MAGIC)) == MAGIC:
            if self._footer is None:
                raise damaged(at, NOT_CLOSED)
            self._found.closed = True
            return at + len(MAGIC)
        if self._summary is not None and at == self._summary.start and self._data_end is None:
            self._data_end = self._summary.data_end, DataEnd(data_section_crc=0)
            lost = self._losses[-1].end if self._losses else 0
            if lost < at:
                start = max(lost, self._summary.data_end)
                self._lose(start, at, "the data section has no end", 0)
        opcode, length = finder.head(at)
        end = at + RECORD_HEAD + length
        if opcode == Opcode.CHUNK:
            return self._take_chunk(at, end)
        if opcode == Opcode.ATTACHMENT:
            self._take_attachment(at, end)
        elif opcode == Opcode.MESSAGE:
            self._take_message(at, end)
        elif opcode <= Opcode.DATA_END:
            self._take_small(at, opcode, end)
        else:
            self._check_end(at, end)
        return end

    def _check_end(self, at: int, end: int) -> None:
        """Raise a LogError if a record's length cannot be right, which nothing else vouches for."""
        if not self._finder.follows(end):
            raise damaged(at, "a record is longer or shorter than it can be")

    def _take_small(self, at: int, opcode: int, end: int) -> None:
        if end - at > _LONGEST_RECORD:
            raise damaged(at, f"a record of {end - at:,} bytes begins")
        content = memoryview(self._finder.read(at + RECORD_HEAD, end - at - RECORD_HEAD))
        if opcode == Opcode.MESSAGE_INDEX:
            self._take_index(at, end, *stored_index(content, at))
            return
        record, length = measured(KINDS[opcode], content, at)
        if length < len(content):
            self._check_end(at, end)
        if isinstance(record, Schema | Channel):
            (self._declared if self._data_end else self._sections[-1]).declare(record)
        elif isinstance(record, Metadata):
            self._found.metadata.append(record)
        elif isinstance(record, Statistics):
            self._found.statistics = record
            self._read_to = end
        elif isinstance(record, DataEnd):
            if self._data_end is not None:
                raise damaged(at, "the data section ends a second time")
            self._data_end = at, record
        elif isinstance(record, Footer):
            behind = end + len(MAGIC)
            ends = behind == self._size or self._finder.begins(behind)
            if not ends or self._finder.read(end, len(MAGIC)) != MAGIC:
                raise damaged(at, "the file does not end where its footer does")
            self._footer = at, record
        elif isinstance(record, Header) and at == len(MAGIC):
            self._found.profile = record.profile

    def _take_attachment(self, at: int, end: int) -> None:
        place = attachment_place(self._source, at, end - at)
        if place.data + place.size + 4 < end:
            self._check_end(at, end)
        try:
            check_attachment(self._source, place)
        except LogError as error:
            self._check_end(at, end)
            self._lose(at, end, error.problem, 0)
        else:
            self._found.attachments.append(place)

    def _take_message(self, at: int, end: int) -> None:
        """Add a message outside of chunks to the run of such messages."""
        if end - at < MESSAGE.size:
            raise damaged(at, "a message is shorter than it can be")
        if self._data_end is not None:
            raise damaged(at, "a message stands behind the end of the data section")
        self._check_end(at, end)
        _, _, channel, _, time, _ = MESSAGE.unpack(self._finder.read(at, MESSAGE.size))
        chunks = self._sections[-1].chunks
        last = chunks[-1] if chunks else None
        if last is None or not last.loose or last.behind != at or last.length > _LONGEST_RUN:
            last = _run(at, at, time, time, {})
            chunks.append(last)
        counts = last.counts
        counts[channel] = counts.get(channel, 0) + 1
        chunks[-1] = _run(last.offset, end, min(last.start, time), max(last.end, time), counts)

    def _take_chunk(self, at: int, end: int) -> int:
        """Add a chunk with the message indexes that follow it; returns what is behind them."""
        index, places, behind = self._indexes(end)
        section = self._sections[-1]
        try:
            record = memoryview(self._source.read(at + RECORD_HEAD, end - at - RECORD_HEAD))
            chunk = stored_chunk(record, at)
            content = opened(chunk, check=True)
            held = tally(content, index, at)
            declared = [parsed(KINDS[opcode], body, at) for opcode, body in held.declared]
        except LogError as error:
            self._check_end(at, behind)
            found = self._finder.search(at + 1, behind)
            counted = bool(index) and found == behind
            messages = sum(len(entries) for entries in index.values()) if counted else None
            self._lose(at, found, error.problem, messages)
            return found
        for each in declared:
            section.declare(each)
        fits = held.listed or not index
        following = behind if fits else self._finder.search(end, behind)
        place = ChunkPlace(
            at,
            end - at,
            chunk.compression,
            end - len(chunk.data),
            len(chunk.data),
            chunk.size,
            held.start,
            held.end,
            {number: places[number] for number in held.counts} if held.listed else {},
            behind if following == behind else end,
            held.counts,
        )
        section.chunks.append(place)
        known = (checksum(content), len(content), held.start, held.end)
        if held.index and known in self._seen:
            self._repeated.append((place, self._seen[known]))
        self._seen.setdefault(known, at)
        if following < behind:
            self._lose(end, following, "a message index is damaged", 0)
        return following

    def _indexes(self, at: int) -> tuple[Index, dict[int, int], int]:
        """The message indexes from `at` on, where each stands, and where they end."""
        index: Index = {}
        places: dict[int, int] = {}
        with suppress(LogError):
            while self._finder.read(at, 1) == bytes([Opcode.MESSAGE_INDEX]):
                length = self._finder.head(at)[1]
                content = memoryview(self._finder.read(at + RECORD_HEAD, length))
                channel, entries = stored_index(content, at)
                extended = 6 + entries.nbytes < length
                if channel in places or (
                    extended and not self._finder.follows(at + RECORD_HEAD + length)
                ):
                    break
                if len(entries):
                    index[channel], places[channel] = entries, at
                at += RECORD_HEAD + length
        return index, places, at

    def _take_index(self, at: int, end: int, channel: int, entries: UintArray) -> None:
        """Pass over a message index that does not follow its chunk at once."""
        if RECORD_HEAD + 6 + entries.nbytes < end - at:
            self._check_end(at, end)
        chunks = self._sections[-1].chunks
        if not len(entries) or (
            chunks
            and channel not in chunks[-1].indexes
            and chunks[-1].counts.get(channel) == len(entries)
        ):
            return
        self._lose(at, end, "a message index without its chunk", len(entries))

    def _join(self, at: int) -> int:
        """Another file begins here: the one before is at its end, closed or not."""
        behind = at + len(MAGIC)
        start = at - len(MAGIC) if self._found.closed else at
        self._lose(start, behind, "one file ends here and another begins", 0)
        self._sections[-1].schemas = self._declared.schemas | self._sections[-1].schemas
        self._sections[-1].channels = self._declared.channels | self._sections[-1].channels
        self._sections.append(Contents())
        self._declared = Contents()
        self._found.statistics = self._data_end = self._footer = None
        self._found.closed = False
        return behind

    # ------------------------------------------------------------------------------- the account

    def _settled(self) -> Contents:
        """What was found, each channel as it is declared, each message once."""
        found = self._found
        reached = bool(self._losses) and self._losses[-1].end == self._size
        if not found.closed and not reached:
            self._lose(self._size, self._size, NOT_CLOSED, None)
        elif self._footer is not None and self._data_end is None and not self._losses:
            self._lose(self._footer[0], self._footer[0], "the data section has no end", 0)
        self._check_data_section()
        holds = self._summary_holds()
        self._define(trusted=holds and self._footer is not None)
        if self._data_end is not None and self._is_closed_by(self._data_end[0]):
            self._losses = [
                replace(loss, messages=0) if loss.start > self._data_end[0] else loss
                for loss in self._losses
            ]
            if holds:
                self._reconcile()
        found.losses = sorted(self._losses, key=lambda each: (each.start, each.end))
        return found

    def _is_closed_by(self, end: int) -> bool:
        """Whether the data section of a single file ends there, and no chunk is behind it."""
        return len(self._sections) == 1 and not any(
            chunk.offset > end for chunk in self._sections[0].chunks
        )

    def _check_data_section(self) -> None:
        """Verify what is outside of the chunks; where it fails, what comes twice counts once."""
        intact = False
        if self._data_end is not None and self._is_closed_by(self._data_end[0]):
            end, expected = self._data_end[0], self._data_end[1].data_section_crc
            self._found.data_section = end, expected
            if expected and all(loss.start > end for loss in self._losses):
                intact = checksum_of(self._source, 0, end) == expected
                if not intact:
                    reason = "a record outside of the chunks, or their order, fails the checksum"
                    if any(chunk.loose for chunk in self._sections[0].chunks):
                        reason = "a message outside of chunks, or another record, is damaged"
                    self._losses.append(Loss(end, end, reason))
        for place, first in () if intact else self._repeated:
            for section in self._sections:
                section.chunks = [each for each in section.chunks if each != place]
            reason = f"the chunk of byte {first:,} comes again"
            self._losses.append(Loss(place.offset, place.behind, reason, 0))
        if self._losses and any(not chunk.loose for chunk in self._sections[-1].chunks):
            self._drop_loose()

    def _drop_loose(self) -> None:
        """Leave out messages outside of the chunks of a damaged file that keeps them in chunks.

        They are other records, damaged, or pieces of damaged chunks: no checksum holds for them.
        """
        for section in self._sections:
            for chunk in section.chunks:
                if chunk.loose:
                    reason = "a message outside of the chunks that the file has"
                    self._losses.append(Loss(chunk.offset, chunk.behind, reason))
            section.chunks = [chunk for chunk in section.chunks if not chunk.loose]

    def _summary_holds(self) -> bool:
        """Whether the summary is as it was written, as far as it is there; a Loss is noted if not.

        That of a file whose end is lost counts as far as it can be read.
        """
        if self._data_end is None:
            return False
        start = self._data_end[0] + RECORD_HEAD + 4
        at = self._footer[0] if self._footer is not None else self._read_to
        if at < start or any(start < loss.end and loss.start < at for loss in self._losses):
            return False
        expected = self._footer[1].summary_crc if self._footer is not None else 0
        if expected and checksum_of(self._source, start, at + RECORD_HEAD + 16) != expected:
            self._losses.append(Loss(start, at, "the summary fails its checksum", 0))
            return False
        return True

    def _define(self, trusted: bool) -> None:
        """Schemas and channels: of the summary if that is trusted, else of the data section."""
        found, sections = self._found, self._sections
        for each in [self._declared, *sections] if trusted else [*sections, self._declared]:
            found.schemas = each.schemas | found.schemas
            found.channels = each.channels | found.channels
        found.channels = {
            number: channel
            for number, channel in found.channels.items()
            if not channel.schema_id or channel.schema_id in found.schemas
        }
        for section in sections:
            whole = trusted and section is sections[-1]
            for chunk in section.chunks:
                found.chunks.append(self._explained(chunk, None if whole else section))

    def _explained(self, chunk: ChunkPlace, section: Contents | None) -> ChunkPlace:
        """The chunk without messages that no channel, or another file's, explains."""
        found = self._found
        kept = dict(chunk.counts)
        for number, count in chunk.counts.items():
            if number not in found.channels:
                what = "nowhere declared"
            elif section is not None and not _agree(section, found, number):
                what = "declared otherwise elsewhere"
            else:
                continue
            reason = f"{count:,} messages of channel {number}, which is {what}"
            self._losses.append(Loss(chunk.offset, chunk.offset, reason, count))
            del kept[number]
        indexes = {number: at for number, at in chunk.indexes.items() if number in kept}
        return chunk._replace(counts=kept, indexes=indexes)

    def _reconcile(self) -> None:
        """Compare with the summary: how many messages are lost, and in which losses."""
        found = self._found
        readable = found.counts().total()
        listed = self._summary.contents.chunks if self._summary is not None else []
        held = sum(chunk.messages for chunk in listed)
        statistics = found.statistics
        if statistics is not None and (
            # Without the footer no checksum holds for them: they must agree with themselves.
            self._footer is not None
            or statistics.message_count == sum(statistics.channel_message_counts.values())
        ):
            found.expected = statistics.message_count
        elif listed and all(chunk.indexes for chunk in listed):
            found.expected = held
        kept = {chunk.offset for chunk in found.chunks if not chunk.loose}
        if listed and kept <= {chunk.offset for chunk in listed}:
            self._locate([chunk for chunk in listed if chunk.offset not in kept], held)
        expected = found.expected
        if expected is None:
            return
        if not self._losses and expected != readable and self._data_end is not None:
            reason = f"the summary counts {expected:,} messages and there are {readable:,}"
            self._losses.append(Loss(self._data_end[0], self._data_end[0], reason))
        missing = max(0, expected - readable)
        known = sum(loss.messages or 0 for loss in self._losses)
        unknown = [number for number, loss in enumerate(self._losses) if loss.messages is None]
        if known > missing:
            # What comes twice, or the message indexes of a damaged chunk, count too many.
            self._losses = [replace(loss, messages=None) for loss in self._losses]
        elif known == missing or len(unknown) == 1:
            for number in unknown:
                self._losses[number] = replace(self._losses[number], messages=missing - known)

    def _locate(self, missing: list[ChunkPlace], held: int) -> None:
        """Say of each loss which of the chunks were in it that the summary lists."""
        counted = held == self._found.expected
        for chunk in missing:
            if not any(loss.start <= chunk.offset < loss.end for loss in self._losses):
                reason = "there is no chunk where the summary lists one"
                self._losses = [
                    loss
                    for loss in self._losses
                    if not chunk.offset <= loss.start < loss.end <= chunk.behind
                ]
                starts = [loss.start for loss in self._losses if loss.start > chunk.offset]
                end = min([chunk.behind, *starts])
                self._losses.append(Loss(chunk.offset, end, reason))
        for number, loss in enumerate(self._losses):
            inside = [chunk for chunk in missing if loss.start <= chunk.offset < loss.end]
            if counted and loss.start < loss.end:
                count = sum(chunk.messages for chunk in inside)
                self._losses[number] = replace(loss, messages=count)


def _agree(section: Contents, found: Contents, number: int) -> bool:
    """Whether a channel means in a section what it means in the whole, or is not declared there."""
    channel = section.channels.get(number)
    if channel is None:
        return True
    schema = section.schemas.get(channel.schema_id)
    return channel == found.channels[number] and schema in (None, found.schema(channel))


def _run(start: int, end: int, first: int, last: int, counts: dict[int, int]) -> ChunkPlace:
    """A run of messages outside of chunks, as if it were a chunk that is not compressed."""
    size = end - start
    return ChunkPlace(start, size, "", start, size, size, first, last, {}, end, counts)


# ---------------------------------------------------------------- the next record behind damage

_LONGEST = 2**40
"""No record of a known kind is as long [bytes]."""

_KEPT = 2**16
"""Kept of the file where it is read in small pieces [bytes]."""

_BLOCK = 2**20
"""Searched at once for the next record behind damage [bytes]."""

_FOLLOWING = 3
"""Behind a message outside of chunks so many records must follow, if it is found by a search."""


class Finder:
    """Where the records of a file are, and where the next one is behind damage."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.size = source.size
        self._start = 0
        self._kept = b""

    def read(self, offset: int, length: int) -> bytes:
        """The bytes from `offset`; a window of the file is kept for small pieces."""
        length = min(length, self.size - offset)
        within = offset - self._start
        if not 0 <= within <= len(self._kept) - length:
            if length > _KEPT:
                return self.source.read(offset, length)
            self._start, within = offset, 0
            self._kept = self.source.read(offset, _KEPT)
        return self._kept[within : within + length]

    def head(self, at: int) -> tuple[int, int]:
        """Opcode and length of the record at `at`; a LogError if none can stand there."""
        return record_head(self.read(at, RECORD_HEAD), at, self.size)

    def follows(self, at: int) -> bool:
        """Whether at `at` the file ends, even inside a record, or a record begins, by its head."""
        head = self.read(at, RECORD_HEAD)
        if len(head) < RECORD_HEAD or head.startswith(MAGIC):
            return True
        opcode, length = struct.unpack("<BQ", head)
        if opcode == Opcode.MESSAGE and length < MESSAGE.size - RECORD_HEAD:
            return False
        rest = self.size - at - RECORD_HEAD
        longest: int = _LONGEST if opcode <= Opcode.DATA_END else rest + 1
        return bool(opcode > 0 and length < longest)

    def begins(self, at: int) -> bool:
        """Whether a file begins at `at`."""
        opening: bytes = MAGIC + bytes([Opcode.HEADER])
        return self.read(at, len(opening)) == opening

    def search(self, start: int, stop: int, *, messages: bool = False) -> int:
        """The first place from `start` where something stands that is bound to be right; or `stop`.

        That is a chunk or an attachment whose checksum holds, the end of the data section, and the
        beginning of another file; if asked for, messages outside of chunks.
        """
        kinds = [Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.DATA_END]
        kinds += [Opcode.MESSAGE] if messages else []
        for base in range(start, stop, _BLOCK):
            data = np.frombuffer(self.source.read(base, _BLOCK + RECORD_HEAD - 1), np.uint8)
            heads = len(data) - RECORD_HEAD + 1
            if heads <= 0:
                return stop
            likely = np.isin(data[:heads], kinds)
            for byte in (8, 7, 6):  # shorter than `_LONGEST`
                likely &= data[byte : byte + heads] == 0
            likely |= data[:heads] == MAGIC[0]
            for at in (base + np.flatnonzero(likely)).tolist():
                if at < stop and self._is_right(at):
                    return at
        return stop

    def _is_right(self, at: int) -> bool:
        if self.begins(at):
            return True
        with suppress(LogError):
            opcode, length = self.head(at)
            end = at + RECORD_HEAD + length
            if opcode == Opcode.DATA_END:
                return bool(length == 4 and end < self.size and self.follows(end))
            if opcode == Opcode.CHUNK:
                return self._is_chunk(at, length)
            if opcode == Opcode.ATTACHMENT:
                place = attachment_place(self.source, at, end - at)
                check_attachment(self.source, place)
                return any(self.source.read(place.data + place.size, 4))
            for _ in range(_FOLLOWING if opcode == Opcode.MESSAGE else 0):
                if at == self.size or not self.follows(at):
                    return at == self.size
                at += RECORD_HEAD + self.head(at)[1]
            return bool(opcode == Opcode.MESSAGE)
        return False

    def _is_chunk(self, at: int, length: int) -> bool:
        head = self.read(at + RECORD_HEAD, 64)
        width = int.from_bytes(head[28:32], "little")
        if head[32 : 32 + width] not in (b"", b"zstd", b"lz4"):
            return False
        if int.from_bytes(head[32 + width : 40 + width], "little") != length - 40 - width:
            return False
        chunk = stored_chunk(memoryview(self.source.read(at + RECORD_HEAD, length)), at)
        tally(opened(chunk, check=True), {}, at)
        return chunk.size > 0

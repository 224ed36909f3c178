"""What an MCAP file holds and where it stands; with an account of what is lost.

The summary at the end of a file says it without the messages. Files whose summary is missing,
damaged or incomplete are gone through record by record. One rule: a chunk whose checksum holds is
kept. Everything else that cannot be read is one `Loss` with its range of bytes, its messages
counted where the summary knows them. Also how the parts are fetched: chunks, message indexes,
attachments.
"""

from __future__ import annotations

import struct
import warnings
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

from trainlog.arrays import UintArray
from trainlog.errors import LogError
from trainlog.formats.files import LOOKED_AT, mistaken_log
from trainlog.mcap.codec import is_as_written
from trainlog.mcap.records import (
    DECLARATIONS,
    KINDS,
    MESSAGE,
    NOT_CLOSED,
    RECORD_HEAD,
    RECORDING_RECORD,
    Account,
    DamageWarning,
    Index,
    Loss,
    Source,
    Unfinished,
    attachment_at,
    checksum,
    chunk_at,
    damaged,
    fills,
    gone_through,
    opened,
    parsed,
    records,
    stored_index,
)

MAGIC: bytes = MCAP0_MAGIC
"""The first and the last eight bytes of every MCAP file."""

_FOOTER_LENGTH = 20
_DATA_END_LENGTH = 4
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
    stored : int
        Length of its content as stored [bytes].
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
        return self.stored == self.length

    @property
    def messages(self) -> int:
        """Number of messages of all channels."""
        return sum(self.counts.values())

    def without(self, channel: int) -> ChunkPlace:
        """The same without the messages of a channel."""
        counts, indexes = dict(self.counts), dict(self.indexes)
        del counts[channel]
        indexes.pop(channel, None)
        return self._replace(counts=counts, indexes=indexes)


@dataclass
class Contents:
    """What an MCAP file holds, as far as it can be read.

    Attributes
    ----------
    schemas, channels : dict by id
    metadata : list of mcap.records.Metadata
    attachments : list of (int, int)
        Where the record of each begins and ends.
    chunks : list of ChunkPlace
        In the order of the file.
    data_section : (int, int) or None
        Where the data section ends, and its CRC-32, 0 if the file does not have it; None if the
        file ends without one.
    indexed : bool
        Whether all this comes from the summary, not from a scan of the file.
    losses : list of Loss
        What could not be read so far.
    stated : Counter of int or None
        How many messages the file held by channel id, by its statistics; None if these are not
        readable.
    closed : bool
        Whether the file has its closing records.
    profile : str
        Of the header, if a scan read that.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[tuple[int, int]] = field(default_factory=list)
    chunks: list[ChunkPlace] = field(default_factory=list)
    data_section: tuple[int, int] | None = None
    indexed: bool = False
    losses: list[Loss] = field(default_factory=list)
    stated: Counter[int] | None = None
    closed: bool = True
    profile: str = ""

    def declare(self, record: Schema | Channel) -> None:
        """Add a schema or channel.

        Of several with the same number the first counts, or the one that is as trainlog writes it:
        the copies outside of chunks have no checksum of their own.
        """
        known: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        first = known.setdefault(record.id, record)
        if first != record and is_as_written(record) and not is_as_written(first):
            known[record.id] = record

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
            None if self.stated is None else self.stated.total(),
            tuple(self._lost()),
        )

    def _lost(self) -> Iterator[tuple[str, int, int]]:
        """Topics of which messages are lost: how many, of how many."""
        stated, readable, counts = Counter[str](), Counter[str](), self.counts()
        for number, channel in self.channels.items():
            stated[channel.topic] += (self.stated or counts)[number]
            readable[channel.topic] += counts[number]
        for topic in sorted(stated):
            if stated[topic] > readable[topic]:
                yield topic, stated[topic] - readable[topic], stated[topic]

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


# ------------------------------------------------------------------------------------ the summary


@dataclass
class Summary:
    """What the summary at the end of a file says.

    Attributes
    ----------
    contents : Contents
        The chunks as they are listed, schemas and channels.
    start : int
        Where the summary begins; the data section ends before it.
    counts : Counter of int or None
        Number of messages by channel id, as its statistics say, or its chunks without these.
    listed : list of int
        Where the attachments and metadata begin that it lists.
    """

    contents: Contents
    start: int
    counts: Counter[int] | None = None
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
    at = source.size - len(MAGIC) - _FOOTER_LENGTH - RECORD_HEAD
    closing = source.read(at, source.size - at) if at > 0 else b""
    opening = struct.pack("<BQ", Opcode.FOOTER, _FOOTER_LENGTH)
    if not closing.startswith(opening) or not closing.endswith(MAGIC):
        return None
    footer = parsed(Footer, source.read, at, source.size - len(MAGIC))
    found = Summary(Contents(), footer.summary_start)
    if not len(MAGIC) <= found.data_end < found.start <= at:
        return None
    if footer.summary_crc not in (0, source.checksum(found.start, at + RECORD_HEAD + 16)):
        return None
    countable = True
    for place, opcode, end in records(source.read, found.start, at):
        if opcode == Opcode.CHUNK_INDEX:
            try:
                index = parsed(ChunkIndex, source.read, place, end)
                found.contents.chunks.append(_chunk_place(index, place))
            except LogError:
                countable = False
        elif opcode in DECLARATIONS:
            found.contents.declare(parsed(KINDS[opcode], source.read, place, end))
        elif opcode == Opcode.STATISTICS:
            found.counts = _counts(parsed(Statistics, source.read, place, end))
        elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            found.listed.append(int.from_bytes(source.read(place + RECORD_HEAD, 8), "little"))
    chunks = found.contents.chunks
    chunks.sort()
    countable &= bool(chunks) and all(chunk.indexes for chunk in chunks)
    if found.counts is None and countable:
        found.counts = found.contents.counts()
    return found


def _counts(statistics: Statistics) -> Counter[int]:
    """Number of messages by channel id."""
    return +Counter(statistics.channel_message_counts)


def _chunk_place(index: ChunkIndex, at: int) -> ChunkPlace:
    """The place of a chunk by its index; the lengths of its message indexes give the counts."""
    listed = sorted((place, number) for number, place in index.message_index_offsets.items())
    end = index.chunk_start_offset + index.chunk_length
    behind = end + index.message_index_length
    counts = {}
    for (place, number), (following, _) in pairwise([*listed, (behind, 0)]):
        counts[number], rest = divmod(following - place - _INDEX_HEAD, 16)
        if rest or counts[number] < 0:
            raise damaged(at, "the message indexes of a chunk are not of their lengths")
    if (listed and listed[0][0] != end) or index.compressed_size > index.chunk_length:
        raise damaged(at, "a chunk index contradicts itself")
    return ChunkPlace(
        index.chunk_start_offset,
        index.chunk_length,
        index.compression,
        index.compressed_size,
        index.uncompressed_size,
        index.message_start_time,
        index.message_end_time,
        dict(index.message_index_offsets),
        behind,
        {number: count for number, count in counts.items() if count},
    )


# -------------------------------------------------------------------------------- parts of a file


def fetched(source: Source, place: ChunkPlace) -> Chunk:
    """The chunk that stands there.

    Raises
    ------
    MisplacedError
        If there is no such chunk.
    """
    if place.loose:
        data = source.read(place.offset, place.length)
        return Chunk("", data, place.end, place.start, 0, place.size)
    try:
        chunk = chunk_at(source, place.offset)
        if (chunk.compression, chunk.uncompressed_size) == (place.compression, place.size):
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
    for channel in channels:
        if channel in place.indexes:
            number, found[channel], _ = stored_index(source, place.indexes[channel])
            if (number, len(found[channel])) != (channel, place.counts[channel]):
                raise damaged(place.indexes[channel], "the message index is of other messages")
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
    index, _ = gone_through(opened(fetched(source, place), place.offset), place.offset)
    return {channel: entries for channel, entries in index.items() if channel in place.counts}


_T = TypeVar("_T")

_LONGEST_RUN = 2**20
"""Messages outside of chunks are taken together up to this length [bytes]."""

_LONGEST_RECORD = 2**26
"""Longer records are refused, but chunks, attachments and those that nobody knows [bytes]."""

_SEARCHED = 2**22
"""Where the beginning of a file is damaged, a chunk is sought in so much of it [bytes]."""

_SURE = (Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.MESSAGE)
"""Records that have a checksum, or follow each other."""

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
    summary = summary_of(source)
    if summary is not None and summary.counts is not None:
        with suppress(LogError):
            return _Scan(source, summary, indexed=True).go()
    return _Scan(source, summary).go()


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


def check_data_section(source: Source, contents: Contents) -> None:
    """Verify what is outside of the chunks and attachments, each of which has its own checksum.

    Raises
    ------
    MisplacedError
        If it fails, or an attachment has, and the contents were found by the summary; a scan
        finds more.
    """
    if contents.indexed and contents.losses:
        raise MisplacedError(contents.losses[0].reason, place=f"byte {contents.losses[0].start}")
    if not checksum_holds(source, contents):
        raise MisplacedError("the data section fails its checksum")


def report_losses(path: str | Path, contents: Contents, called_by: int = 3) -> None:
    """Warn of what is lost of a file, at the line that called trainlog, so many calls above."""
    if contents.losses:
        warnings.warn(DamageWarning(str(path), contents.account), stacklevel=called_by)


def checksum_holds(source: Source, contents: Contents) -> bool:
    """Whether the records of a file hold their checksum, where only its summary was gone by.

    It is so of a file that states none, and of one whose records were gone through.
    """
    end, expected = contents.data_section or (0, 0)
    return not (contents.indexed and expected) or source.checksum(0, end) == expected


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
    if search(source, 0, searched) == searched:
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
    return _Scan(source, summary_of(source)).go()


# --------------------------------------------------------------------------------------- the scan


class _Scan:
    """One way through a file: from record to record, and what it found.

    Parameters
    ----------
    source : Source
    summary : Summary or None
        Its places and counts say what is lost.
    indexed : bool
        Whether the chunks that it lists are taken as they are listed; a LogError then ends the scan
        at whatever is lost or is not listed.
    """

    def __init__(self, source: Source, summary: Summary | None, *, indexed: bool = False) -> None:
        self._source = source
        self._summary = summary
        self._found = Contents(indexed=indexed, closed=False)
        self._listed: dict[int, ChunkPlace] = {}
        self._places: list[int] = []
        """Where records begin that the summary lists."""
        if summary is not None:
            self._listed = {chunk.offset: chunk for chunk in summary.contents.chunks}
            self._places = sorted([*self._listed, *summary.listed, summary.data_end, summary.start])
            self._found.schemas = dict(summary.contents.schemas)
            self._found.channels = dict(summary.contents.channels)
        self._earlier: list[tuple[int, dict[int, Schema], dict[int, Channel]]] = []
        """Of files before the last: where they end, and what they declare."""
        self._data_end: tuple[int, int] | None = None
        """Where the data section ends, and its checksum."""
        self._footer: tuple[int, Footer] | None = None
        self._counts = summary.counts if summary is not None else None
        self._seen: dict[tuple[int, int, int, int], ChunkPlace] = {}
        self._repeated: list[tuple[ChunkPlace, int]] = []
        """Chunks that come again, and where they do."""

    def go(self) -> Contents:
        """Go through the file to its end.

        Raises
        ------
        LogError
            If the summary was to be gone by and does not say what there is.
        """
        found, source = self._found, self._source
        at = doubtful = min(len(MAGIC), source.size)
        if source.read(0, len(MAGIC)) != MAGIC:
            self._lose(0, at, "the file does not begin as an MCAP file does")
        stop = self._summary.start if found.indexed and self._summary else source.size
        while at < stop:
            if found.indexed and at in self._listed:
                found.chunks.append(self._listed[at])
                at = self._listed[at].behind
                continue
            kind = source.read(at, 1)[0]
            try:
                behind = self._step(at)
                doubtful = behind if self._is_sure(kind, behind) else at
            except LogError as error:
                if found.indexed:
                    raise
                # Where bytes are missing, the record before may have taken the head of a chunk.
                last = found.losses[-1] if found.losses else Loss(0, 0, "")
                if not last.start <= doubtful < last.end:
                    doubtful = max(doubtful, last.end)
                behind = search(source, doubtful + 1, at)
                if behind < at:
                    at = doubtful
                    found.attachments = [each for each in found.attachments if each[1] <= at]
                    if last.end > at:
                        found.losses.pop()
                        at = last.start
                else:
                    behind = self._next(at + 1)
                self._lose(at, behind, error.problem)
                doubtful = behind
            at = behind
        found.closed |= found.indexed
        self._settle(stop)
        if found.indexed and found.losses:
            raise damaged(found.losses[0].start, found.losses[0].reason)
        return found

    def _is_sure(self, kind: int, behind: int) -> bool:
        """Whether the record that was taken up to `behind` is bound to end there."""
        if kind != Opcode.ATTACHMENT:
            return kind in _SURE
        lost = bool(self._found.losses) and self._found.losses[-1].end == behind
        return any(self._source.read(behind - 4, 4)) and not lost

    def _next(self, start: int) -> int:
        """Where to go on behind damage."""
        number, chunks = bisect_left(self._places, start), self._found.chunks
        stop = self._places[number] if number < len(self._places) else self._source.size
        return search(self._source, start, stop, messages=bool(chunks) and chunks[-1].loose)

    def _lose(self, start: int, end: int, reason: str, messages: int | None = None) -> None:
        """Note a loss; one that adjoins the last continues it."""
        losses = self._found.losses
        last = losses[-1] if losses else None
        if last is not None and last.end == start and last.start < last.end and start < end:
            known = last.messages is not None and messages is not None
            both = (last.messages or 0) + (messages or 0) if known else None
            losses[-1] = Loss(last.start, end, last.reason, both)
        else:
            losses.append(Loss(start, end, reason, messages))

    # -------------------------------------------------------------------------------- the records

    def _step(self, at: int) -> int:
        """Take the record at `at`; returns where the next begins; LogError if it is damaged."""
        source, found = self._source, self._found
        if begins(source, at):
            return self._join(at)
        if source.read(at, len(MAGIC)) == MAGIC:
            behind = at + len(MAGIC)
            if self._footer is None:
                raise damaged(at, NOT_CLOSED)
            if behind < source.size and not begins(source, behind):
                raise damaged(at, "the file does not end where its footer does")
            found.closed = True
            return behind
        opcode, end = source.head(at)
        if opcode == Opcode.CHUNK:
            return self._take_chunk(at, end)
        if at in self._listed:
            raise damaged(at, "there is no chunk where the summary lists one")
        if opcode == Opcode.MESSAGE:
            self._take_message(at, end)
        elif opcode == Opcode.ATTACHMENT:
            self._take_attachment(at, end)
        elif opcode == Opcode.MESSAGE_INDEX:
            self._pass_index(at, end)
        elif opcode in KINDS:
            if end - at > _LONGEST_RECORD:
                raise damaged(at, f"a record of {end - at:,} bytes begins")
            try:
                record = parsed(KINDS[opcode], source.read, at, end, exact=True)
            except LogError:
                self._check_longer(at, end)
                record = parsed(KINDS[opcode], source.read, at, end)
            self._take(at, record)
        else:
            self._check_longer(at, end)
        return end

    def _check_longer(self, at: int, end: int) -> None:
        """Refuse a record that is longer than its fields, as one of a later version, by a chunk."""
        if search(self._source, at + 1, end) < end:
            raise damaged(at, "a record reaches into the next one")

    def _take(self, at: int, record: object) -> None:
        """Take a record that has no checksum of its own."""
        found = self._found
        if isinstance(record, Schema | Channel):
            found.declare(record)
        elif isinstance(record, Metadata):
            found.metadata.append(record)
        elif isinstance(record, Statistics) and self._data_end is not None:
            # Without a footer no checksum holds for them: they must agree with themselves.
            counts = _counts(record)
            self._counts = counts if counts.total() == record.message_count else None
        elif isinstance(record, DataEnd):
            if self._data_end is not None:
                raise damaged(at, "the data section ends a second time")
            self._data_end = at, record.data_section_crc
        elif isinstance(record, Footer):
            self._footer = at, record
        elif isinstance(record, Header) and at == len(MAGIC):
            found.profile = record.profile

    def _take_attachment(self, at: int, end: int) -> None:
        try:
            if not self._found.indexed:
                attachment_at(self._source, at)
            self._found.attachments.append((at, end))
        except LogError as error:
            if not follows(self._source, end) or search(self._source, at + 1, end) < end:
                raise
            self._lose(at, end, error.problem, 0)

    def _take_message(self, at: int, end: int) -> None:
        """Add a message outside of chunks to the run of such messages."""
        if end - at < MESSAGE.size:
            raise damaged(at, "a message is shorter than it can be")
        if self._data_end is not None or self._found.indexed:
            raise damaged(at, "a message stands behind the end of the data section")
        if not follows(self._source, end):
            raise damaged(at, "a record is longer or shorter than it can be")
        _, _, channel, _, time, _ = MESSAGE.unpack(self._source.read(at, MESSAGE.size))
        chunks = self._found.chunks
        last = chunks[-1] if chunks else None
        if last is None or not last.loose or last.behind != at or last.length > _LONGEST_RUN:
            last = _run(at, at, time, time, {})
            chunks.append(last)
        counts = last.counts
        counts[channel] = counts.get(channel, 0) + 1
        chunks[-1] = _run(last.offset, end, min(last.start, time), max(last.end, time), counts)

    def _take_chunk(self, at: int, end: int) -> int:
        """Add a chunk with the message indexes that follow it; returns what is behind them."""
        if self._found.indexed:
            raise damaged(at, "a chunk is not listed")
        given, places, behind = self._indexes(end)
        try:
            chunk = chunk_at(self._source, at)
            content = opened(chunk, at)
            index, declared = (given, []) if fills(content, given) else gone_through(content, at)
        except LogError as error:
            if not given or search(self._source, at + 1, behind) < behind:
                raise
            # What stands behind its indexes is not lost with it.
            self._lose(at, behind, error.problem)
            return behind
        for each in declared:
            self._found.declare(each)
        right = given.keys() == index.keys() and all(
            np.array_equal(index[number], entries) for number, entries in given.items()
        )
        following = behind if right else search(self._source, end, behind)
        times = np.concatenate([np.empty(0, np.uint64), *(each[:, 0] for each in index.values())])
        place = ChunkPlace(
            at,
            end - at,
            chunk.compression,
            len(chunk.data),
            chunk.uncompressed_size,
            int(times.min()) if index else 0,
            int(times.max(initial=0)),
            places if right else {},
            behind if following == behind else end,
            {number: len(entries) for number, entries in index.items()},
        )
        self._found.chunks.append(place)
        known = checksum(content), len(content), place.start, place.end
        if index and known in self._seen:
            self._repeated.append((self._seen[known], at))
        self._seen[known] = place
        if following < behind:
            self._lose(end, following, "a message index is damaged", 0)
        return following

    def _indexes(self, at: int) -> tuple[Index, dict[int, int], int]:
        """The message indexes from `at` on, where each stands, and where they end."""
        index: Index = {}
        places: dict[int, int] = {}
        with suppress(LogError):
            while self._source.read(at, 1) == bytes([Opcode.MESSAGE_INDEX]):
                channel, entries, end = self._index(at)
                if channel in places:
                    break
                if len(entries):
                    index[channel], places[channel] = entries, at
                at = end
        return index, places, at

    def _index(self, at: int) -> tuple[int, UintArray, int]:
        """Channel and entries of the message index at `at`, and its end."""
        channel, entries, end = stored_index(self._source, at)
        if end - at > _INDEX_HEAD + 16 * len(entries):
            self._check_longer(at, end)
        return channel, entries, end

    def _pass_index(self, at: int, end: int) -> None:
        """Pass over a message index that does not follow its chunk at once."""
        channel, entries, _ = self._index(at)
        counts = self._found.chunks[-1].counts if self._found.chunks else {}
        listed = self._found.chunks[-1].indexes if counts else {}
        if len(entries) and (channel in listed or counts.get(channel) != len(entries)):
            self._lose(at, end, "a message index without its chunk", len(entries))

    def _join(self, at: int) -> int:
        """Another file begins here: the one before is at its end, closed or not."""
        behind = at + len(MAGIC)
        start = at - len(MAGIC) if self._found.closed else at
        self._lose(start, behind, "one file ends here and another begins", 0)
        found = self._found
        self._earlier.append((at, found.schemas, found.channels))
        found.schemas, found.channels, found.closed = {}, {}, False
        self._summary = self._data_end = self._footer = None
        return behind

    # ------------------------------------------------------------------------------- the account

    def _settle(self, stop: int) -> None:
        """State what is lost up to `stop`, each message once."""
        found = self._found
        reached = bool(found.losses) and found.losses[-1].end == stop
        if not found.closed and not reached:
            self._lose(stop, stop, NOT_CLOSED)
        elif self._data_end is None and not found.losses:
            self._lose(stop, stop, "the data section has no end")
        end, expected = self._data_end or (0, 0)
        if self._earlier or any(chunk.offset > end for chunk in found.chunks):
            end = 0
        found.data_section = (end, expected) if end else None
        left_out: dict[int, tuple[str, int | None]] = {}
        if not self._intact(end, expected):
            for place, again in self._repeated:
                left_out[place.offset] = f"the chunk comes again at byte {again:,}", 0
        if (found.losses or left_out) and any(not chunk.loose for chunk in found.chunks):
            # Other records, damaged, or pieces of damaged chunks: no checksum holds for them.
            reason = "a message outside of the chunks that the file has"
            left_out |= {chunk.offset: (reason, None) for chunk in found.chunks if chunk.loose}
        found.losses += [
            Loss(chunk.offset, chunk.behind, *left_out[chunk.offset])
            for chunk in found.chunks
            if chunk.offset in left_out
        ]
        found.chunks = [chunk for chunk in found.chunks if chunk.offset not in left_out]
        self._explain()
        if end:
            self._check_summary(end)
        self._compare()
        found.losses.sort(key=lambda loss: (loss.start, loss.end))

    def _explain(self) -> None:
        """Leave out messages that no channel, or that of another file, explains."""
        found = self._found
        for _, schemas, channels in reversed(self._earlier):
            found.schemas, found.channels = schemas | found.schemas, channels | found.channels
        found.channels = {
            number: channel
            for number, channel in found.channels.items()
            if not channel.schema_id or channel.schema_id in found.schemas
        }
        for place, chunk in enumerate(found.chunks):
            own = next((each for each in self._earlier if chunk.offset < each[0]), (0, {}, {}))
            for number, count in chunk.counts.items():
                channel = own[2].get(number)
                if number not in found.channels:
                    what = "nowhere declared"
                elif channel is not None and (
                    channel != found.channels[number]
                    or own[1].get(channel.schema_id) != found.schema(channel)
                ):
                    what = "declared otherwise elsewhere"
                else:
                    continue
                reason = f"{count:,} messages of channel {number}, which is {what}"
                found.losses.append(Loss(chunk.offset, chunk.offset, reason, count))
                found.chunks[place] = found.chunks[place].without(number)

    def _intact(self, end: int, expected: int) -> bool:
        """Whether the data section holds its checksum; by the summary that is verified later."""
        found = self._found
        if found.indexed or not end or not expected:
            return found.indexed
        if any(loss.start <= end for loss in found.losses):
            return False
        if self._source.checksum(0, end) == expected:
            return True
        reason = "a record outside of the chunks, or their order, fails the checksum"
        if any(chunk.loose for chunk in found.chunks):
            reason = "a message outside of chunks, or another record, is damaged"
        found.losses.append(Loss(end, end, reason))
        return False

    def _check_summary(self, end: int) -> None:
        """Verify a summary that is not where its footer says, behind the data section."""
        losses = self._found.losses
        losses[:] = [replace(each, messages=0) if each.start > end else each for each in losses]
        start = end + RECORD_HEAD + _DATA_END_LENGTH
        at, footer = self._footer or (start, Footer(0, 0, 0))
        if self._summary is None and start < at and not any(start < each.end for each in losses):
            stated = self._source.checksum(start, at + RECORD_HEAD + 16)
            if footer.summary_crc not in (0, stated):
                losses.append(Loss(start, at, "the summary fails its checksum", 0))
                self._counts = None

    def _compare(self) -> None:
        """Compare with the summary: how many messages are lost, and in which losses."""
        found, losses = self._found, self._found.losses
        if self._counts is None or self._earlier:
            return
        readable, expected = found.counts(), self._counts.total()
        found.stated = self._counts
        if not losses and readable != self._counts:
            at = self._data_end[0] if self._data_end else 0
            reason = f"the summary counts {expected:,} messages and there are {readable.total():,}"
            losses.append(Loss(at, at, reason))
        kept = {chunk.offset for chunk in found.chunks if not chunk.loose}
        missing = [chunk for at, chunk in self._listed.items() if at not in kept]
        if kept <= self._listed.keys() and all(
            any(loss.start <= chunk.offset < loss.end for loss in losses) for chunk in missing
        ):
            for number, loss in enumerate(losses):
                if loss.start < loss.end:
                    held = [each for each in missing if loss.start <= each.offset < loss.end]
                    count = sum(each.messages for each in held)
                    losses[number] = replace(loss, messages=count)


def _run(start: int, end: int, first: int, last: int, counts: dict[int, int]) -> ChunkPlace:
    """A run of messages outside of chunks, as if it were a chunk that is not compressed."""
    size = end - start
    return ChunkPlace(start, size, "", size, size, first, last, {}, end, counts)


# ---------------------------------------------------------------- the next record behind damage

_LONGEST = 2**40
"""No record is as long [bytes]."""

_BLOCK = 2**20
"""Searched at once for the next record behind damage [bytes]."""

_FOLLOWING = 3
"""So many records must follow each other where a message outside of chunks is found."""


def begins(source: Source, at: int) -> bool:
    """Whether a file begins at `at`."""
    opening: bytes = MAGIC + bytes([Opcode.HEADER])
    return source.read(at, len(opening)) == opening


def follows(source: Source, at: int) -> bool:
    """Whether at `at` the file ends, even inside a record, or a record begins, by its head."""
    head = source.read(at, RECORD_HEAD)
    if len(head) < RECORD_HEAD or head.startswith(MAGIC):
        return True
    opcode, length = head[0], int.from_bytes(head[1:], "little")
    least = MESSAGE.size - RECORD_HEAD if opcode == Opcode.MESSAGE else 0
    longest = _LONGEST if opcode <= Opcode.DATA_END else source.size - at - RECORD_HEAD + 1
    return opcode > 0 and least <= length < longest


def search(source: Source, start: int, stop: int, *, messages: bool = False) -> int:
    """The first place from `start` where something stands that is bound to be right; or `stop`.

    That is a chunk or an attachment whose checksum holds, the end of the data section, and the
    beginning of another file; if asked for, messages outside of chunks.
    """
    kinds = [Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.DATA_END]
    kinds += [Opcode.MESSAGE] if messages else []
    for base in range(start, stop, _BLOCK):
        data = np.frombuffer(source.read(base, _BLOCK + RECORD_HEAD - 1), np.uint8)
        heads = len(data) - RECORD_HEAD + 1
        if heads <= 0:
            return stop
        likely = np.isin(data[:heads], kinds)
        for byte in (8, 7, 6):  # shorter than `_LONGEST`
            likely &= data[byte : byte + heads] == 0
        likely |= data[:heads] == MAGIC[0]
        for at in (base + np.flatnonzero(likely)).tolist():
            if at < stop and _is_right(source, at):
                return at
    return stop


def _is_right(source: Source, at: int) -> bool:
    """Whether what stands at `at` is bound to be right."""
    if begins(source, at):
        return True
    with suppress(LogError):
        opcode, end = source.head(at)
        if opcode == Opcode.DATA_END:
            return end - at == RECORD_HEAD + _DATA_END_LENGTH and follows(source, end)
        if opcode == Opcode.CHUNK:
            content = opened(chunk_at(source, at), at)
            gone_through(content, at)
            return bool(content)
        if opcode == Opcode.ATTACHMENT:
            attachment_at(source, at)
            return any(source.read(end - 4, 4))
        for _ in range(_FOLLOWING if opcode == Opcode.MESSAGE else 0):
            if at == source.size or not follows(source, at):
                return at == source.size
            _, at = source.head(at)
        return bool(opcode == Opcode.MESSAGE)
    return False

"""What an MCAP file holds, found by going through its records; with an account of what is lost.

A scan needs no summary, so it serves files without one and damaged ones. One rule: a chunk whose
checksum holds is kept. Everything else that cannot be read is one `Loss` with its range of bytes,
its messages counted where the summary or the message indexes know them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    DataEnd,
    Footer,
    Header,
    Metadata,
    Schema,
    Statistics,
)

from trainlog.arrays import UintArray
from trainlog.errors import LogError
from trainlog.formats.files import LOOKED_AT, mistaken_log
from trainlog.mcap.account import NOT_CLOSED, Loss
from trainlog.mcap.index import (
    MAGIC,
    ChunkPlace,
    Contents,
    MisplacedError,
    attachment_place,
    check_attachment,
    checksum_of,
    contents_by_summary,
    summary_of,
)
from trainlog.mcap.records import (
    KINDS,
    MESSAGE,
    RECORD_HEAD,
    Index,
    Source,
    checksum,
    damaged,
    measured,
    opened,
    parsed,
    record_head,
    stored_chunk,
    stored_index,
    tally,
)

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

_WINDOW = 2**16
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
            if length > _WINDOW:
                return self.source.read(offset, length)
            self._start, within = offset, 0
            self._kept = self.source.read(offset, _WINDOW)
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

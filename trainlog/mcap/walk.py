"""What an MCAP file holds, found by one walk over its records; with an exact account.

The walk needs no summary, so it serves files without one and damaged ones. Every byte is read and
every checksum is checked. At damage it goes on with the next record that can be believed, so that
only what was touched is lost; every stretch that is passed over is a `Loss`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace

import numpy as np
from isal import isal_zlib
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.mcap.account import Loss
from trainlog.mcap.errors import damaged, shown
from trainlog.mcap.layout import RECORD_HEAD
from trainlog.mcap.places import ChunkPlace, Contents
from trainlog.mcap.records import Index, opened, parsed, stored_index
from trainlog.mcap.resync import (
    Scanner,
    Window,
    follows,
    is_chunk,
    is_message_index,
    told_length,
)
from trainlog.mcap.schemas import descriptor_set
from trainlog.mcap.source import Source
from trainlog.mcap.stored import attachment_place, chunk_place, fetched, loose_place
from trainlog.mcap.tally import tally
from trainlog.topics import TOPICS

_MAGIC = len(MCAP0_MAGIC)
_FIRST_PRIVATE = 0x80
_PIECE = 2**22
"""Read at once for a checksum [bytes]."""

_LONGEST_RUN = 2**20
"""Messages outside of chunks are taken together up to this length [bytes]."""

_PATIENCE = 8
"""Once chunks of this many times the file's length have failed, what is inside of failing chunks
is not looked for any more: a forger must not make the walk longer than the file allows."""

_FIXED = (int(Opcode.FOOTER), int(Opcode.DATA_END))
"""Records that have one length."""

_SEARCHED = 2**22
"""Where the beginning of a file is damaged, a chunk is looked for in so much of it [bytes]."""

_CHUNKS = (int(Opcode.CHUNK),)
_INSIDE = (int(Opcode.CHUNK), int(Opcode.MESSAGE_INDEX))


def check_is_mcap(source: Source) -> None:
    """Raise a LogError if the file neither begins nor ends as an MCAP file, nor holds a chunk."""
    magic: bytes = MCAP0_MAGIC
    if source.read(0, _MAGIC) == magic:
        return
    if source.read(max(0, source.size - _MAGIC), _MAGIC) == magic and source.size > 2 * _MAGIC:
        return
    searched = min(source.size, _SEARCHED)
    if searched and Scanner(source).next(0, searched, _CHUNKS) < searched:
        return
    what = "is not an MCAP file" if source.size else "is empty"
    raise LogError(what, place="byte 0", remedy="expected a log in the MCAP format")


def contents_by_walk(source: Source) -> Contents:
    """What a file holds as far as it can be read, by a walk over its records.

    Parameters
    ----------
    source : Source
        Of an MCAP file.
    """
    walk = _Walk(source)
    walk.go()
    return walk.contents()


@dataclass
class _Section:
    """What one file declares: where files were joined there are several."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkPlace] = field(default_factory=list)

    def add(self, other: _Section) -> None:
        """Take over what only the other declares."""
        self.schemas = other.schemas | self.schemas
        self.channels = other.channels | self.channels

    def declare(self, opcode: int, content: memoryview, at: int) -> None:
        """Add a schema or channel record; of several with the same number the first counts."""
        if opcode == Opcode.SCHEMA:
            schema = parsed(Schema, content, at)
            self.schemas.setdefault(schema.id, schema)
        else:
            channel = parsed(Channel, content, at)
            self.channels.setdefault(channel.id, channel)


class _Walk:
    """One walk: where it is, what it found, what it passed over."""

    def __init__(self, source: Source) -> None:
        self._source = Window(source)
        self._scanner = Scanner(source)
        self._found = Contents()
        self._losses: list[Loss] = []
        self._sections = [_Section()]
        self._summary = _Section()
        self._listed: list[ChunkIndex] = []
        self._data_end: tuple[int, DataEnd] | None = None
        self._footer: tuple[int, Footer] | None = None
        self._closed = False
        self._seen: dict[tuple[int, int, int, int], int] = {}
        self._failed = 0
        self._failed_before: set[tuple[int, int]] = set()
        self._failures: list[tuple[int, int, int]] = []
        self._indexed: set[int] = set()
        self._chunked = False
        self._verified = _verified(source)

    # ------------------------------------------------------------------------------ the records

    def go(self) -> None:
        """Walk to the end of the file."""
        at = min(_MAGIC, self._source.size)
        if self._source.read(0, _MAGIC) != MCAP0_MAGIC:
            self._lose(0, at, "the file does not begin as an MCAP file does", 0)
        while at < self._source.size:
            try:
                at = self._step(at)
            except LogError as error:
                behind = self._scanner.next(at + 1, self._source.size)
                self._lose(at, behind, error.problem, None)
                at = behind

    def _step(self, at: int) -> int:
        """Take the record at `at`; returns where the next begins; LogError if it is damaged."""
        source = self._source
        if self._closed:
            return self._go_on(at)
        if source.read(at, _MAGIC) == MCAP0_MAGIC:
            if self._footer is not None:
                self._closed = True
            elif at + _MAGIC == source.size:
                raise damaged(at, "the file ends without its closing records")
            else:
                self._join(at, at + _MAGIC)
            return at + _MAGIC
        head = source.read(at, RECORD_HEAD)
        if len(head) < RECORD_HEAD:
            raise damaged(at, "the file ends inside a record")
        opcode, length = struct.unpack("<BQ", head)
        rest = source.size - at - RECORD_HEAD
        if length > rest:
            self._chunked |= opcode == Opcode.CHUNK
            raise damaged(at, f"a record of {length:,} bytes begins and only {rest:,} bytes follow")
        if opcode == 0:
            raise damaged(at, "there is no record with opcode 0")
        end = at + RECORD_HEAD + length
        if end > self._verified:
            self._doubt(at, opcode, length)
        return self._take(at, opcode, length)

    def _doubt(self, at: int, opcode: int, length: int) -> None:
        """Raise a LogError if the record that seems to stand here is not to be believed."""
        source, start, end = self._source, at + RECORD_HEAD, at + RECORD_HEAD + length
        told = told_length(source, at, opcode, length)
        if told is None or (told < length and opcode in _FIXED):
            raise damaged(at, f"the {_name(opcode)} record contradicts itself")
        if opcode != Opcode.CHUNK and is_chunk(source, at, length):
            self._chunked = True
            raise damaged(at, f"a chunk has become a {_name(opcode)} record")
        if opcode > Opcode.DATA_END and is_message_index(source, at, length):
            raise damaged(at, f"a message index has become a {_name(opcode)} record")
        if opcode == Opcode.FOOTER and source.read(end, _MAGIC) != MCAP0_MAGIC:
            raise damaged(at, "a footer stands where the file does not end")
        if opcode != Opcode.CHUNK and self._stops_short(start, end):
            raise damaged(at, f"the {_name(opcode)} record stops short")
        if told == length:
            return
        # Nothing in the record vouches for its length.
        inside = start + told
        if (
            self._scanner.ends_inside(inside, end)
            or self._scanner.next(inside, end, _INSIDE) < end
            or (not follows(source, end) and self._scanner.next(inside, end) < end)
        ):
            raise damaged(at, f"the {_name(opcode)} record is longer than it can be")

    def _stops_short(self, start: int, end: int) -> bool:
        """Whether another record begins inside of one that nothing follows."""
        return not follows(self._source, end) and self._scanner.next(start, end, _INSIDE) < end

    def _take(self, at: int, opcode: int, length: int) -> int:
        """Add one record to what was found; returns where the next begins."""
        end = at + RECORD_HEAD + length
        if opcode == Opcode.MESSAGE:
            self._take_message(at, end)
        elif opcode == Opcode.CHUNK:
            return self._take_chunk(at, end)
        elif opcode == Opcode.ATTACHMENT:
            self._take_attachment(at, end)
        elif opcode == Opcode.MESSAGE_INDEX:
            self._chunked = True
            self._lose(at, end, "a message index does not follow its chunk", 0)
        elif opcode == Opcode.HEADER and at != _MAGIC:
            self._join(at, end)
        elif opcode <= Opcode.DATA_END:
            self._take_small(at, opcode, memoryview(self._source.read(at + RECORD_HEAD, length)))
        return end

    def _take_small(self, at: int, opcode: int, content: memoryview) -> None:
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            summary = self._data_end is not None
            (self._summary if summary else self._sections[-1]).declare(opcode, content, at)
        elif opcode == Opcode.METADATA:
            self._found.metadata.append(parsed(Metadata, content, at))
        elif opcode == Opcode.STATISTICS:
            self._found.statistics = parsed(Statistics, content, at)
        elif opcode == Opcode.CHUNK_INDEX:
            self._listed.append(parsed(ChunkIndex, content, at))
        elif opcode == Opcode.DATA_END:
            if self._data_end is not None:
                raise damaged(at, "the data section ends a second time")
            self._data_end = (at, parsed(DataEnd, content, at))
        elif opcode == Opcode.FOOTER:
            self._footer = (at, parsed(Footer, content, at))
        elif opcode == Opcode.HEADER:
            parsed(Header, content, at)

    def _take_message(self, at: int, end: int) -> None:
        """Add a message outside of chunks to the run of such messages."""
        channel, _, time = struct.unpack("<HIQ", self._source.read(at + RECORD_HEAD, 14))
        chunks = self._sections[-1].chunks
        last = chunks[-1] if chunks else None
        if last is None or not last.loose or last.behind != at or last.length > _LONGEST_RUN:
            last = loose_place(at, at)._replace(start=time, end=time)
            chunks.append(last)
        counts = last.counts
        counts[channel] = counts.get(channel, 0) + 1
        chunks[-1] = loose_place(last.offset, end)._replace(
            start=min(last.start, time), end=max(last.end, time), counts=counts
        )

    def _take_chunk(self, at: int, end: int) -> int:
        """Add a chunk with the message indexes that follow it; returns what is behind them."""
        place = chunk_place(self._source.file, at, end - at)
        self._chunked = True
        index, places, behind = self._indexes(end)
        try:
            chunk = fetched(self._source.file, place)
            content = opened(chunk, check=True)
            held = tally(content, index, at)
            for opcode, body in held.declared:
                self._sections[-1].declare(opcode, body, at)
        except LogError as error:
            return self._pass_chunk(place, error.problem, index, behind)
        checksum = isal_zlib.crc32(content)
        known = (checksum, len(content), held.start, held.end)
        if behind > self._verified and held.index and known in self._seen:
            again = f"the chunk of byte {self._seen[known]:,} comes again"
            self._lose(at, behind, again, 0)
            return behind
        self._seen[known] = at
        self._indexed.update(_key(*each) for each in held.index.items())
        if places and not held.listed and behind > self._verified:
            self._lose(end, behind, "message indexes do not fit their chunk", 0)
        self._sections[-1].chunks.append(
            place._replace(
                start=held.start,
                end=held.end,
                counts=held.counts,
                indexes={number: places[number] for number in held.counts} if held.listed else {},
                behind=behind,
            )
        )
        return behind

    def _indexes(self, at: int) -> tuple[Index, dict[int, int], int]:
        """The message indexes from `at` on, where each stands, and where they end."""
        index: Index = {}
        places: dict[int, int] = {}
        while True:
            head = self._source.read(at, RECORD_HEAD)
            if len(head) < RECORD_HEAD or head[0] != Opcode.MESSAGE_INDEX:
                return index, places, at
            length = int.from_bytes(head[1:], "little")
            if length > self._source.size - at - RECORD_HEAD or (
                length != 6 and not is_message_index(self._source, at, length)
            ):
                return index, places, at
            content = memoryview(self._source.read(at + RECORD_HEAD, length))
            channel, entries = stored_index(content, at)
            start, end = at + RECORD_HEAD, at + RECORD_HEAD + length
            if channel in places or (end > self._verified and self._stops_short(start, end)):
                return index, places, at
            if len(entries):
                index[channel], places[channel] = entries, at
            at += RECORD_HEAD + length

    def _pass_chunk(self, place: ChunkPlace, reason: str, index: Index, behind: int) -> int:
        """Pass over a chunk that failed, up to the next one if its length was forged."""
        end = place.offset + place.length
        self._failed += place.stored + min(place.size, place.stored * 4)
        if self._failed < _PATIENCE * self._source.size:
            inside = self._scanner.next(place.offset + RECORD_HEAD, end, _INSIDE)
            if inside < end:
                self._lose(place.offset, inside, reason, None)
                return inside
        stored = _checksum(self._source.file, place.data, end)
        again = (stored, place.stored) in self._failed_before
        self._failed_before.add((stored, place.stored))
        messages = sum(len(entries) for entries in index.values()) if index else None
        self._lose(place.offset, behind, reason, 0 if again else messages)
        if again:
            return behind
        for channel, entries in index.items():
            self._failures.append((place.offset, len(entries), _key(channel, entries)))
        return behind

    def _take_attachment(self, at: int, end: int) -> None:
        place = attachment_place(self._source.file, at, end - at)
        expected = int.from_bytes(self._source.read(end - 4, 4), "little")
        if expected and _checksum(self._source.file, at + RECORD_HEAD, end - 4) != expected:
            self._lose(at, end, f"attachment {shown(place.name)} fails its checksum", 0)
        else:
            self._found.attachments.append(place)

    def _go_on(self, at: int) -> int:
        """Go on behind the end of the file, where another one may begin."""
        size = self._source.size
        behind = self._scanner.next(at, size)
        if behind < size:
            self._join(at, behind)
        else:
            self._lose(at, size, "the file does not end where its footer does", 0)
        return behind

    def _join(self, at: int, end: int) -> None:
        """Another file begins here: the end of the one before, if it has one, closes nothing."""
        closing = self._data_end or self._footer
        start = at if closing is None else closing[0]
        section = self._sections[-1]
        section.chunks = [
            each for each in section.chunks if not (each.loose and each.offset > start)
        ]
        start = max([start, *(each.behind for each in section.chunks)])
        while self._losses and self._losses[-1].start >= start:
            self._losses.pop()
        self._lose(start, end, "one file ends here and another begins", 0)
        self._sections[-1].add(self._summary)
        self._sections.append(_Section())
        self._found.statistics = self._data_end = self._footer = None
        self._closed = False
        self._summary, self._listed = _Section(), []

    def _lose(self, start: int, end: int, reason: str, messages: int | None) -> None:
        """Note a loss; one that adjoins the last continues it."""
        last = self._losses[-1] if self._losses else None
        if last is not None and last.end == start and last.start < last.end and start < end:
            known = last.messages is not None and messages is not None
            both = (last.messages or 0) + (messages or 0) if known else None
            self._losses[-1] = Loss(last.start, end, last.reason, both)
        else:
            self._losses.append(Loss(start, end, reason, messages))

    # ------------------------------------------------------------------------------- the result

    def contents(self) -> Contents:
        """What was found, each channel as it is declared, each message counted once."""
        found = self._found
        self._settle_failures()
        self._check_end()
        trusted = self._check_summary()
        if self._data_end is not None:
            found.data_section = (self._data_end[0], self._data_end[1].data_section_crc)
        self._define(trusted)
        self._count(trusted)
        found.losses = self._losses
        return found

    def _settle_failures(self) -> None:
        """Take back the messages of chunks that failed and came once more, unharmed."""
        for offset, messages, key in self._failures:
            if key not in self._indexed:
                # Of what failed several times, the first stands for all.
                self._indexed.add(key)
            else:
                for number, loss in enumerate(self._losses):
                    if loss.start <= offset < loss.end and loss.messages is not None:
                        self._losses[number] = replace(loss, messages=loss.messages - messages)
        if self._chunked:
            self._drop_astray()

    def _drop_astray(self) -> None:
        """Leave out messages outside of the chunks of a damaged file that keeps them in chunks.

        They are pieces of broken chunks, and nothing vouches for them.
        """
        size = self._source.size
        end, closing = self._data_end or (size, None)
        fails = closing is not None and closing.data_section_crc and end > self._verified
        harmed = bool(self._losses) or not self._closed or fails
        for section in self._sections:
            kept = []
            for chunk in section.chunks:
                doubtful = chunk.behind > self._verified and (harmed or chunk.offset > end)
                if chunk.loose and doubtful:
                    reason = "messages outside of the chunks that the file has"
                    self._insert(Loss(chunk.offset, chunk.behind, reason))
                else:
                    kept.append(chunk)
            section.chunks = kept
        losses, self._losses = self._losses, []
        for loss in losses:
            self._lose(loss.start, loss.end, loss.reason, loss.messages)

    def _check_end(self) -> None:
        size = self._source.size
        last = self._losses[-1] if self._losses else None
        reached = last is not None and last.end == size and last.messages is None
        if not self._closed and not reached:
            self._lose(size, size, "the file ends without its closing records", None)
        elif self._closed and self._data_end is None and not self._losses:
            at = self._footer[0] if self._footer else size
            self._lose(at, at, "the data section has no end", 0)
        self._settle_summary()
        if self._data_end is not None and self._data_end[1].data_section_crc:
            end = self._data_end[0]
            damage = any(loss.start <= end for loss in self._losses)
            if (
                not damage
                and _checksum(self._source.file, 0, end) != self._data_end[1].data_section_crc
            ):
                reason = "a record outside of the chunks, or their order, fails the checksum"
                self._insert(Loss(end, end, reason))

    def _settle_summary(self) -> None:
        """Say that what is lost behind the data section held no messages."""
        if self._data_end is None or len(self._sections) > 1:
            return
        end = self._data_end[0]
        if not any(chunk.offset > end for chunk in self._sections[0].chunks):
            self._losses = [
                replace(loss, messages=0) if loss.start > end else loss for loss in self._losses
            ]

    def _check_summary(self) -> bool:
        """Whether the summary is as it was written; a Loss is noted if not."""
        if self._footer is None or self._data_end is None or not self._closed:
            return False
        at, footer = self._footer
        start = self._data_end[0] + RECORD_HEAD + 4
        if at < start:
            return False
        inside = any(loss.end > start for loss in self._losses)
        expected = footer.summary_crc
        if expected and _checksum(self._source.file, start, at + RECORD_HEAD + 16) != expected:
            if not inside:
                self._lose_summary("the summary fails its checksum")
            return False
        if self._losses or start == at or not expected:
            return not inside
        places = {_told(chunk) for chunk in self._sections[-1].chunks if not chunk.loose}
        listed = {_listed(each) for each in self._listed}
        statistics = self._found.statistics
        held = sum(chunk.messages for chunk in self._sections[-1].chunks)
        if footer.summary_start != start or (listed and listed != places):
            self._lose_summary("the summary does not tell where its records and the chunks are")
            return False
        if self._verified and statistics is not None and statistics.message_count != held:
            self._lose_summary(
                f"the summary counts {statistics.message_count:,} messages and there are {held:,}"
            )
            return False
        return True

    def _lose_summary(self, reason: str) -> None:
        if self._footer is None or self._data_end is None:
            return
        start = self._data_end[0] + RECORD_HEAD + 4
        mixed = any(chunk.behind > start for chunk in self._sections[-1].chunks)
        self._insert(Loss(start, start if mixed else self._footer[0], reason, 0))

    def _insert(self, loss: Loss) -> None:
        self._losses.append(loss)
        self._losses.sort(key=lambda each: (each.start, each.end))

    def _define(self, trusted: bool) -> None:
        """Schemas and channels: of the summary if that is trusted, else of the sections."""
        found, sections = self._found, self._sections
        for number, schema in self._summary.schemas.items():
            # Of two copies that nothing verifies, the one that says what the table of topics says.
            if not trusted and number in sections[-1].schemas and _of_the_table(schema):
                sections[-1].schemas[number] = schema
        order = [self._summary, *sections] if trusted else [*sections, self._summary]
        for each in order:
            for number, schema in each.schemas.items():
                found.schemas.setdefault(number, schema)
            for number, channel in each.channels.items():
                found.channels.setdefault(number, channel)
        lost = [
            number
            for number, channel in found.channels.items()
            if channel.schema_id and channel.schema_id not in found.schemas
        ]
        for number in lost:
            del found.channels[number]
        for section in sections:
            whole = section is sections[-1] and trusted
            other = set() if whole else self._misdeclared(section)
            self._keep(section, other)

    def _misdeclared(self, section: _Section) -> set[int]:
        """Channels that the section declares otherwise than they will be read."""
        found = self._found
        return {
            number
            for number, channel in section.channels.items()
            if channel != found.channels.get(number)
            or (
                channel.schema_id in section.schemas
                and section.schemas[channel.schema_id] != found.schemas.get(channel.schema_id)
            )
        }

    def _keep(self, section: _Section, other: set[int]) -> None:
        """Keep a section's chunks, without messages that no channel, or another one, explains."""
        found = self._found
        for chunk in section.chunks:
            unknown = {
                number: count
                for number, count in chunk.counts.items()
                if number not in found.channels or number in other
            }
            for number, count in unknown.items():
                elsewhere = number in other and number in found.channels
                what = "declared otherwise elsewhere" if elsewhere else "nowhere declared"
                reason = f"{count:,} messages of channel {number}, which is {what}"
                self._insert(Loss(chunk.offset, chunk.offset, reason, count))
            if unknown:
                kept = {n: count for n, count in chunk.counts.items() if n not in unknown}
                chunk = chunk._replace(
                    counts=kept, indexes={n: at for n, at in chunk.indexes.items() if n in kept}
                )
            found.chunks.append(chunk)

    def _count(self, trusted: bool) -> None:
        """Tell how many messages a loss held where the statistics leave one answer."""
        statistics = self._found.statistics
        if not (trusted and statistics) or len(self._sections) > 1:
            return
        missing = max(0, statistics.message_count - self._found.counts().total())
        if sum(loss.messages or 0 for loss in self._losses) > missing:
            # What comes twice, or the indexes of a chunk that failed, tell too many.
            self._losses = [replace(loss, messages=None) for loss in self._losses]
        known = sum(loss.messages or 0 for loss in self._losses)
        unknown = [number for number, loss in enumerate(self._losses) if loss.messages is None]
        if missing == known or len(unknown) == 1:
            for number in unknown:
                self._losses[number] = replace(self._losses[number], messages=missing - known)


_Told = tuple[int, int, str, int, int, int, int]
"""What a chunk index says of a chunk: place, lengths, compression, times."""


def _told(chunk: ChunkPlace) -> _Told:
    return (
        chunk.offset,
        chunk.length,
        chunk.compression,
        chunk.stored,
        chunk.size,
        chunk.start,
        chunk.end,
    )


def _listed(index: ChunkIndex) -> _Told:
    return (
        index.chunk_start_offset,
        index.chunk_length,
        index.compression,
        index.compressed_size,
        index.uncompressed_size,
        index.message_start_time,
        index.message_end_time,
    )


def _of_the_table(schema: Schema) -> bool:
    """Whether a schema is the one that trainlog writes for a topic."""
    topics = [topic for topic in TOPICS.values() if topic.message == schema.name]
    return any(descriptor_set(topic) == schema.data for topic in topics)


def _verified(source: Source) -> int:
    """Up to where the file is as it was written, by the checksum of its data section."""
    closing = RECORD_HEAD + 20 + _MAGIC
    tail = source.read(source.size - closing, closing) if source.size > closing else b""
    if tail[-_MAGIC:] != MCAP0_MAGIC or tail[:RECORD_HEAD] != struct.pack("<BQ", Opcode.FOOTER, 20):
        return 0
    (start,) = struct.unpack_from("<Q", tail, RECORD_HEAD)
    behind = start or source.size - closing
    at = behind - RECORD_HEAD - 4
    if not _MAGIC <= at < source.size - closing:
        return 0
    record = source.read(at, RECORD_HEAD + 4)
    (expected,) = struct.unpack_from("<I", record, RECORD_HEAD)
    if record[:RECORD_HEAD] != struct.pack("<BQ", Opcode.DATA_END, 4) or not expected:
        return 0
    return at if _checksum(source, 0, at) == expected else 0


def _checksum(source: Source, start: int, end: int) -> int:
    """CRC-32 of the file from `start` to `end`."""
    checksum = 0
    for at in range(start, end, _PIECE):
        checksum = isal_zlib.crc32(source.read(at, min(_PIECE, end - at)), checksum)
    return checksum


def _key(channel: int, entries: NDArray[np.uint64]) -> int:
    """What tells a channel's messages in a chunk from all others: a checksum of their index."""
    listed = np.ascontiguousarray(entries, dtype="<u8")
    return hash((channel, len(listed), isal_zlib.crc32(listed.tobytes())))


def _name(opcode: int) -> str:
    """What a kind of record is called."""
    if opcode >= _FIRST_PRIVATE:
        return "private"
    known: dict[int, str] = {int(each): each.name for each in Opcode}
    return known.get(opcode, "unknown").lower().replace("_", " ")

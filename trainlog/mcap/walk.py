"""What an MCAP file holds, found by one walk over its records; with an exact account.

The walk needs no summary, so it serves files without one and damaged ones. Every byte is read and
every checksum is checked. At damage it goes on with the next record that can be believed, so that
only what was touched is lost; every stretch that is passed over is a `Loss`.
"""

from __future__ import annotations

import struct

import numpy as np
from isal import isal_zlib
from mcap.opcode import Opcode
from mcap.records import (
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.formats.files import LOOKED_AT, mistaken_log
from trainlog.mcap.codec import RECORD_HEAD
from trainlog.mcap.errors import damaged, shown
from trainlog.mcap.findings import Findings, checksum_of
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
from trainlog.mcap.source import Source
from trainlog.mcap.stored import attachment_place, chunk_place, fetched, loose_place
from trainlog.mcap.tally import tally

_MAGIC = len(MCAP0_MAGIC)
_FIRST_PRIVATE = 0x80
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
    what, remedy = mistaken_log(source.read(0, min(source.size, LOOKED_AT)))
    raise LogError(what, place="byte 0", remedy=remedy)


def contents_by_walk(source: Source) -> Contents:
    """What a file holds as far as it can be read, by a walk over its records.

    Parameters
    ----------
    source : Source
        Of an MCAP file.
    """
    return _Walk(source).go().settled()


class _Walk:
    """One walk: from record to record, and what it found."""

    def __init__(self, source: Source) -> None:
        self._source = Window(source)
        self._scanner = Scanner(source)
        self._found = Findings(source, _verified(source))
        self._seen: dict[tuple[int, int, int, int], int] = {}
        self._failed = 0
        self._failed_before: set[tuple[int, int]] = set()

    def go(self) -> Findings:
        """Walk to the end of the file."""
        at = min(_MAGIC, self._source.size)
        if self._source.read(0, _MAGIC) != MCAP0_MAGIC:
            self._found.lose(0, at, "the file does not begin as an MCAP file does", 0)
        while at < self._source.size:
            try:
                at = self._step(at)
            except LogError as error:
                behind = self._scanner.next(at + 1, self._source.size)
                self._found.lose(at, behind, error.problem, None)
                at = behind
        return self._found

    def _step(self, at: int) -> int:
        """Take the record at `at`; returns where the next begins; LogError if it is damaged."""
        source = self._source
        if self._found.closed:
            return self._go_on(at)
        if source.read(at, _MAGIC) == MCAP0_MAGIC:
            if self._found.footer is not None:
                self._found.closed = True
            elif at + _MAGIC == source.size:
                raise damaged(at, "the file ends without its closing records")
            else:
                self._found.join(at, at + _MAGIC)
            return at + _MAGIC
        head = source.read(at, RECORD_HEAD)
        if len(head) < RECORD_HEAD:
            raise damaged(at, "the file ends inside a record")
        opcode, length = struct.unpack("<BQ", head)
        rest = source.size - at - RECORD_HEAD
        if length > rest:
            self._found.chunked |= opcode == Opcode.CHUNK
            raise damaged(at, f"a record of {length:,} bytes begins and only {rest:,} bytes follow")
        if opcode == 0:
            raise damaged(at, "there is no record with opcode 0")
        end = at + RECORD_HEAD + length
        if end > self._found.verified:
            self._doubt(at, opcode, length)
        return self._take(at, opcode, length)

    def _doubt(self, at: int, opcode: int, length: int) -> None:
        """Raise a LogError if the record that seems to stand here is not to be believed."""
        source, start, end = self._source, at + RECORD_HEAD, at + RECORD_HEAD + length
        told = told_length(source, at, opcode, length)
        if told is None or (told < length and opcode in _FIXED):
            raise damaged(at, f"the {_name(opcode)} record contradicts itself")
        if opcode != Opcode.CHUNK and is_chunk(source, at, length):
            self._found.chunked = True
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
            self._found.chunked = True
            self._found.lose(at, end, "a message index does not follow its chunk", 0)
        elif opcode == Opcode.HEADER and at != _MAGIC:
            self._found.join(at, end)
        elif opcode <= Opcode.DATA_END:
            self._take_small(at, opcode, memoryview(self._source.read(at + RECORD_HEAD, length)))
        return end

    def _take_small(self, at: int, opcode: int, content: memoryview) -> None:
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            summary = self._found.data_end is not None
            (self._found.summary if summary else self._found.sections[-1]).declare(
                opcode, content, at
            )
        elif opcode == Opcode.METADATA:
            self._found.contents.metadata.append(parsed(Metadata, content, at))
        elif opcode == Opcode.STATISTICS:
            self._found.contents.statistics = parsed(Statistics, content, at)
        elif opcode == Opcode.CHUNK_INDEX:
            self._found.listed.append(parsed(ChunkIndex, content, at))
        elif opcode == Opcode.DATA_END:
            if self._found.data_end is not None:
                raise damaged(at, "the data section ends a second time")
            self._found.data_end = (at, parsed(DataEnd, content, at))
        elif opcode == Opcode.FOOTER:
            self._found.footer = (at, parsed(Footer, content, at))
        elif opcode == Opcode.HEADER:
            parsed(Header, content, at)

    def _take_message(self, at: int, end: int) -> None:
        """Add a message outside of chunks to the run of such messages."""
        channel, _, time = struct.unpack("<HIQ", self._source.read(at + RECORD_HEAD, 14))
        chunks = self._found.sections[-1].chunks
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
        self._found.chunked = True
        index, places, behind = self._indexes(end)
        try:
            chunk = fetched(self._source.file, place)
            content = opened(chunk, check=True)
            held = tally(content, index, at)
            for opcode, body in held.declared:
                self._found.sections[-1].declare(opcode, body, at)
        except LogError as error:
            return self._pass_chunk(place, error.problem, index, behind)
        checksum = isal_zlib.crc32(content)
        known = (checksum, len(content), held.start, held.end)
        if behind > self._found.verified and held.index and known in self._seen:
            again = f"the chunk of byte {self._seen[known]:,} comes again"
            self._found.lose(at, behind, again, 0)
            return behind
        self._seen[known] = at
        self._found.indexed.update(_key(*each) for each in held.index.items())
        if places and not held.listed and behind > self._found.verified:
            self._found.lose(end, behind, "message indexes do not fit their chunk", 0)
        self._found.sections[-1].chunks.append(
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
            if channel in places or (end > self._found.verified and self._stops_short(start, end)):
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
                self._found.lose(place.offset, inside, reason, None)
                return inside
        stored = checksum_of(self._source.file, place.data, end)
        again = (stored, place.stored) in self._failed_before
        self._failed_before.add((stored, place.stored))
        messages = sum(len(entries) for entries in index.values()) if index else None
        self._found.lose(place.offset, behind, reason, 0 if again else messages)
        if again:
            return behind
        for channel, entries in index.items():
            self._found.failures.append((place.offset, len(entries), _key(channel, entries)))
        return behind

    def _take_attachment(self, at: int, end: int) -> None:
        place = attachment_place(self._source.file, at, end - at)
        expected = int.from_bytes(self._source.read(end - 4, 4), "little")
        if expected and checksum_of(self._source.file, at + RECORD_HEAD, end - 4) != expected:
            self._found.lose(at, end, f"attachment {shown(place.name)} fails its checksum", 0)
        else:
            self._found.contents.attachments.append(place)

    def _go_on(self, at: int) -> int:
        """Go on behind the end of the file, where another one may begin."""
        size = self._source.size
        behind = self._scanner.next(at, size)
        if behind < size:
            self._found.join(at, behind)
        else:
            self._found.lose(at, size, "the file does not end where its footer does", 0)
        return behind


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
    return at if checksum_of(source, 0, at) == expected else 0


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

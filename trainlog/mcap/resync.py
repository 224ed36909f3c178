"""Finding the next record behind damage, by what records are bound to look like.

A record tells its length more than once: in its head, and by the lengths of the texts, maps and
arrays in it. Where these agree to the byte it is believed wherever it stands. Short records and
messages have too little of this; they are believed where another record follows them.
"""

from __future__ import annotations

import struct
from collections.abc import Container

import numpy as np
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from trainlog.mcap.codec import MESSAGE, RECORD_HEAD
from trainlog.mcap.source import Source

_FIELDS = {
    int(Opcode.HEADER): "ss",
    int(Opcode.FOOTER): "884",
    int(Opcode.SCHEMA): "2sss",
    int(Opcode.CHANNEL): "22sss",
    int(Opcode.CHUNK): "8884sS",
    int(Opcode.MESSAGE_INDEX): "2s",
    int(Opcode.CHUNK_INDEX): "8888s8s88",
    int(Opcode.ATTACHMENT): "88ssS4",
    int(Opcode.ATTACHMENT_INDEX): "88888ss",
    int(Opcode.STATISTICS): "82444488s",
    int(Opcode.METADATA): "ss",
    int(Opcode.METADATA_INDEX): "88s",
    int(Opcode.SUMMARY_OFFSET): "188",
    int(Opcode.DATA_END): "4",
}
"""Fields of each kind of record: the length of a number, ``s`` and ``S`` for what tells its own
length in four or eight bytes."""

_SHORTEST = 24
"""Shorter contents are not believed without a record behind them [bytes]."""

_MESSAGE_HEAD = MESSAGE.size - RECORD_HEAD
_LAST_OPCODE = int(Opcode.DATA_END)
_FIRST_PRIVATE = 0x80
_LONGEST = 2**40
"""Longer records are not looked for [bytes]; three bytes of their length are zero."""

_WINDOW = 2**16
"""Kept of the file where it is read in small pieces [bytes]."""

_BLOCK = 2**20
"""Looked through at once [bytes]."""

_LEAST = np.array(
    [
        2**62
        if op == 0
        else sum(4 if f == "s" else 8 if f == "S" else int(f) for f in _FIELDS[op])
        if op in _FIELDS
        else _MESSAGE_HEAD
        for op in range(_LAST_OPCODE + 1)
    ],
    dtype=np.int64,
)
"""Shortest content by opcode [bytes]."""


def told_length(source: Window, at: int, opcode: int, length: int) -> int | None:
    """How long the content of the record at `at` is by its own fields; None if they do not fit.

    Of messages and private records, which have no such fields, the least that they may have.
    """
    if opcode not in _FIELDS:
        least = _MESSAGE_HEAD if opcode == Opcode.MESSAGE else 0
        return least if length >= least else None
    start = at + RECORD_HEAD
    head = source.read(start, min(length, 256))
    told = 0
    for field in _FIELDS[opcode]:
        if field not in "sS":
            told += int(field)
        else:
            width = 4 if field == "s" else 8
            if told + width > length:
                return None
            if told + width <= len(head):
                number = head[told : told + width]
            else:
                number = source.read(start + told, width)
            told += width + int.from_bytes(number, "little")
        if told > length:
            return None
    return told


def believed(source: Window, at: int) -> bool:
    """Whether a record stands at `at`, by its own evidence or by what follows it."""
    head = _head(source, at)
    if head is None:
        return False
    opcode, length = head
    end = at + RECORD_HEAD + length
    if opcode > _LAST_OPCODE or not _consistent(source, at, opcode, length):
        return False
    if opcode == Opcode.FOOTER:
        return _closes(source, end)
    if opcode in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
        return True
    if opcode != Opcode.MESSAGE and length >= _SHORTEST:
        return True
    return follows(source, end)


def follows(source: Window, at: int) -> bool:
    """Whether at `at` a record begins, by its head, or the file ends."""
    if at == source.size or _closes(source, at):
        return True
    head = _head(source, at)
    if head is None:
        return False
    opcode, length = head
    return opcode >= _FIRST_PRIVATE or (
        opcode <= _LAST_OPCODE and _consistent(source, at, opcode, length)
    )


def is_chunk(source: Window, at: int, length: int) -> bool:
    """Whether the content of the record at `at` is that of a chunk, whatever its opcode says."""
    if told_length(source, at, Opcode.CHUNK, length) != length:
        return False
    head = source.read(at + RECORD_HEAD + 28, 4 + 8)
    name = head[4 : 4 + int.from_bytes(head[:4], "little")]
    if name in (b"zstd", b"lz4"):
        return True
    # The content of a chunk that is not compressed has the length that it will have.
    size = source.read(at + RECORD_HEAD + 16, 8)
    return name == b"" and size == source.read(at + RECORD_HEAD + 32, 8) and any(size)


def is_message_index(source: Window, at: int, length: int) -> bool:
    """Whether the content of the record at `at` is that of a message index with entries."""
    return (
        length > 6
        and (length - 6) % 16 == 0
        and told_length(source, at, Opcode.MESSAGE_INDEX, length) == length
    )


def _closes(source: Window, at: int) -> bool:
    magic: bytes = MCAP0_MAGIC
    return source.read(at, len(magic)) == magic


def _head(source: Window, at: int) -> tuple[int, int] | None:
    """Opcode and length of the record at `at`; None if it is none or leads out of the file."""
    head = source.read(at, RECORD_HEAD)
    if len(head) < RECORD_HEAD:
        return None
    opcode, length = struct.unpack("<BQ", head)
    return (opcode, length) if opcode and length <= source.size - at - RECORD_HEAD else None


def _consistent(source: Window, at: int, opcode: int, length: int) -> bool:
    if opcode == Opcode.CHUNK:
        return is_chunk(source, at, length)
    if opcode == Opcode.MESSAGE_INDEX:
        return is_message_index(source, at, length) or length == 6
    told = told_length(source, at, opcode, length)
    return told is not None and (told == length or opcode == Opcode.MESSAGE)


class Window:
    """A file read in small pieces close to each other: a block of it is kept.

    Attributes
    ----------
    file : Source
    size : int
        Length of the file [bytes].
    """

    def __init__(self, file: Source) -> None:
        self.file = file
        self.size = file.size
        self._start = 0
        self._kept = b""

    def read(self, offset: int, length: int) -> bytes:
        """The bytes from `offset`, as many as `length` or the end of the file allow."""
        length = min(length, self.size - offset)
        within = offset - self._start
        if not 0 <= within <= len(self._kept) - length:
            if length > _WINDOW:
                return self.file.read(offset, length)
            self._start, within = offset, 0
            self._kept = self.file.read(offset, _WINDOW)
        return self._kept[within : within + length]


class Scanner:
    """Where in a file records may begin, block by block; each block is looked through once."""

    def __init__(self, source: Source) -> None:
        self._source = Window(source)
        self._block = -1
        self._found: NDArray[np.int64] = np.empty(0, np.int64)
        self._opcodes: NDArray[np.uint8] = np.empty(0, np.uint8)
        self._ends: NDArray[np.int64] = np.empty(0, np.int64)

    def next(self, start: int, stop: int, opcodes: Container[int] | None = None) -> int:
        """The first place from `start` where a record is believed to begin; `stop` if none is."""
        for block in range(start // _BLOCK, (stop - 1) // _BLOCK + 1):
            self._look_through(block)
            first, behind = np.searchsorted(self._found, (start, stop))
            for place in range(int(first), int(behind)):
                at = int(self._found[place])
                wanted = opcodes is None or int(self._opcodes[place]) in opcodes
                if wanted and believed(self._source, at):
                    return at
        return stop

    def ends_inside(self, start: int, end: int) -> bool:
        """Whether from `start` on a record may begin that ends at `end` to the byte."""
        for block in range(start // _BLOCK, (end - 1) // _BLOCK + 1):
            self._look_through(block)
            first, behind = np.searchsorted(self._found, (start, end))
            for place in first + np.flatnonzero(self._ends[first:behind] == end):
                at = int(self._found[place])
                opcode, length = int(self._opcodes[place]), end - at - RECORD_HEAD
                if _consistent(self._source, at, opcode, length):
                    return True
        return False

    def _look_through(self, block: int) -> None:
        if block == self._block:
            return
        self._block = block
        base = block * _BLOCK
        data = np.frombuffer(self._source.read(base, _BLOCK + RECORD_HEAD - 1), np.uint8)
        heads = len(data) - RECORD_HEAD + 1
        if heads <= 0:
            self._found = self._ends = np.empty(0, np.int64)
            return
        # Opcode, five bytes of a length, three bytes of zeros.
        likely = (data[:heads] - np.uint8(1)) < _LAST_OPCODE
        for byte in (8, 7, 6):
            likely &= data[byte : byte + heads] == 0
        at = np.flatnonzero(likely)
        opcodes = data[at]
        length = np.zeros(len(at), np.int64)
        for byte in range(5):
            length |= data[at + 1 + byte].astype(np.int64) << (8 * byte)
        ends = base + at + RECORD_HEAD + length
        fits = (length >= _LEAST[opcodes]) & (ends <= self._source.size)
        self._found, self._opcodes, self._ends = base + at[fits], opcodes[fits], ends[fits]

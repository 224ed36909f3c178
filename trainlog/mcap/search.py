"""Where in a damaged file the next record is that is bound to be right."""

from __future__ import annotations

import struct
from contextlib import suppress

import numpy as np
from mcap.opcode import Opcode

from trainlog.errors import LogError
from trainlog.mcap.codec import MESSAGE, RECORD_HEAD
from trainlog.mcap.index import MAGIC, attachment_place, check_attachment
from trainlog.mcap.records import opened, stored_chunk, tally
from trainlog.mcap.source import Source, damaged

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
        head = self.read(at, RECORD_HEAD)
        if len(head) < RECORD_HEAD:
            raise damaged(at, "the file ends inside a record")
        opcode, length = struct.unpack("<BQ", head)
        if opcode == 0:
            raise damaged(at, "there is no record with opcode 0")
        rest = self.size - at - RECORD_HEAD
        if length > rest:
            raise damaged(at, f"a record of {length:,} bytes begins and only {rest:,} bytes follow")
        return opcode, length

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

"""Fixed-length MCAP messages as numpy records.

When every message of a channel has the same length and the same bytes outside its values, the
messages of a chunk are an array: written by filling columns into copies of a template, read by
gathering the records and taking columns out. The file stays entirely standard; nothing in it says
that it was made this way.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

MESSAGE = struct.Struct("<BQHIQQ")
"""Head of a message record: opcode, length, channel, sequence, log time, publish time."""

RECORD_HEAD = 9
"""Bytes of opcode and length before the content of any record."""

SEQUENCE, LOG_TIME, PUBLISH_TIME = "#sequence", "#log_time", "#publish_time"
"""Fields of a record that belong to its head; no field of a protobuf message has such a name."""


@dataclass(frozen=True)
class Value:
    """A variable part of a message: a name, the numpy type of its bytes, how many if an array."""

    name: str
    format: str
    count: int | None = None

    @property
    def kind(self) -> str | tuple[str, tuple[int]]:
        """What numpy calls it."""
        return self.format if self.count is None else (self.format, (self.count,))

    @property
    def size(self) -> int:
        """Length on the wire [bytes]."""
        return np.dtype(self.kind).itemsize


@dataclass(frozen=True)
class Layout:
    """Where the constant and the variable bytes of a channel's message records are.

    Attributes
    ----------
    record : numpy.dtype
        Packed record of one message: `SEQUENCE`, `LOG_TIME`, `PUBLISH_TIME` and the values.
    template : bytes
        One record with every variable byte zero.
    constants : tuple of (offset, dtype, value)
        The constant bytes, cut into words that numpy compares at once.
    """

    record: np.dtype[np.void]
    template: bytes
    constants: tuple[tuple[int, str, int], ...]

    @property
    def size(self) -> int:
        """Length of one record, head included [bytes]."""
        return len(self.template)

    @cached_property
    def masks(self) -> NDArray[np.uint64]:
        """Place, mask and value of words of eight bytes that cover the constants; (k, 3)."""
        mask, value = bytearray(self.size), bytearray(self.size)
        for offset, kind, number in self.constants:
            width = np.dtype(kind).itemsize
            mask[offset : offset + width] = b"\xff" * width
            value[offset : offset + width] = number.to_bytes(width, "little")
        words, covered = [], 0
        for at in range(self.size):
            if mask[at] and at >= covered:
                start = min(at, self.size - 8)
                covered = start + 8
                part = slice(start, covered)
                words.append(
                    (
                        start,
                        int.from_bytes(mask[part], "little"),
                        int.from_bytes(value[part], "little"),
                    )
                )
        return np.array(words, dtype=np.uint64)

    def place(self, name: str) -> int:
        """Where a value begins in a record [bytes]."""
        return int(self.record.fields[name][1])  # type: ignore[index]

    def rows(self, count: int) -> NDArray[np.void]:
        """`count` records with the constant bytes in place."""
        blank = np.full(count, np.void(self.template), dtype=f"V{self.size}")
        return blank.view(self.record)

    def matches(self, rows: NDArray[np.void]) -> bool:
        """Whether each record has the constant bytes where they belong."""
        raw = rows.view(f"V{self.size}")
        return all(
            bool(np.all(np.ndarray(raw.shape, kind, raw.data, offset, (self.size,)) == value))
            for offset, kind, value in self.constants
        )


def layout(channel: int, body: Iterable[bytes | Value]) -> Layout:
    """Layout of a channel whose messages are `body`: constant bytes and values in wire order."""
    values: dict[str, tuple[str | tuple[str, tuple[int]], int]] = {}
    runs: list[tuple[int, bytes]] = []
    at = 0

    def add(part: bytes | Value) -> None:
        nonlocal at
        if isinstance(part, bytes):
            if runs and runs[-1][0] + len(runs[-1][1]) == at:
                start, before = runs.pop()
                runs.append((start, before + part))
            else:
                runs.append((at, part))
            at += len(part)
        else:
            values[part.name] = (part.kind, at)
            at += part.size

    parts = list(body)
    length = (
        MESSAGE.size
        - RECORD_HEAD
        + sum(len(part) if isinstance(part, bytes) else part.size for part in parts)
    )
    add(struct.pack("<BQH", Opcode.MESSAGE, length, channel))
    head = (Value(SEQUENCE, "<u4"), Value(LOG_TIME, "<u8"), Value(PUBLISH_TIME, "<u8"))
    for part in (*head, *parts):
        add(part)
    template = bytearray(at)
    for start, run in runs:
        template[start : start + len(run)] = run
    names = list(values)
    specification: Any = {
        "names": names,
        "formats": [values[name][0] for name in names],
        "offsets": [values[name][1] for name in names],
        "itemsize": at,
    }
    return Layout(np.dtype(specification), bytes(template), tuple(_words(runs)))


def gather(buffer: bytes, offsets: NDArray[np.integer], form: Layout) -> NDArray[np.void] | None:
    """The records that start at `offsets` of a chunk, or None if they do not fit the layout."""
    if len(offsets) == 0:
        return form.rows(0)
    last = len(buffer) - form.size
    if len(offsets) * form.size > len(buffer) or not 0 <= offsets.min() <= offsets.max() <= last:
        return None
    rows = _windows(buffer, form.size)[offsets].view(form.record)
    return rows if form.matches(rows) else None


def scatter(rows: NDArray[np.void], buffer: bytearray, offsets: NDArray[np.int64]) -> None:
    """Put the records at `offsets` of a chunk that is being built."""
    size = rows.dtype.itemsize
    _windows(buffer, size)[offsets] = rows.view(f"V{size}")


def varint(number: int) -> bytes:
    """`number` as a protobuf varint, in its shortest form."""
    encoded = bytearray()
    while number > 0x7F:
        encoded.append(number & 0x7F | 0x80)
        number >>= 7
    encoded.append(number)
    return bytes(encoded)


def _windows(buffer: bytes | bytearray, size: int) -> NDArray[np.void]:
    """Every window of `size` bytes: indexing it copies whole messages, wherever they start."""
    return np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer, 0, (1,))


def _words(runs: list[tuple[int, bytes]]) -> list[tuple[int, str, int]]:
    """The runs of constant bytes, cut into words of 8, 4, 2 and 1 bytes."""
    words = []
    for start, run in runs:
        at = 0
        while at < len(run):
            width = next(width for width in (8, 4, 2, 1) if width <= len(run) - at)
            value = int.from_bytes(run[at : at + width], "little")
            words.append((start + at, f"<u{width}", value))
            at += width
    return words

"""Messages of ROS 1, and of ROS 2 in CDR, taken apart after their definitions.

The packages that decode them elsewhere (genpy, mcap-ros2-support) make and run Python code from
the schema's text, or believe every length that a message claims and return what is cut off as if
it were whole. Files are not trusted here: nothing in them is run, every length is checked, and the
message must end where its definition does.

A definition is compiled once into steps: runs of numbers, which are unpacked in one call, texts,
and arrays whose length stands in the message. CDR aligns each number to its own size, counted from
behind the header of four bytes, so that a run has one packing for each place it can begin at.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from trainlog.mcap.foreign_rows import (
    BYTES,
    DEEPEST,
    LONG_ARRAY,
    MOST_ELEMENTS,
    BrokenMessage,
    Decode,
    Message,
)
from trainlog.mcap.ros_definitions import (
    NUMBERS,
    DefinitionError,
    Definitions,
    Dialect,
    definitions_of,
    short_name,
)

_CDR_HEADER = 4
_PADDING = 8
"""A CDR message may end with fewer bytes than this that mean nothing."""

_MOST_NUMBERS = 4096
"""Numbers in a message, apart from arrays that are not expanded."""

_MOST_STEPS = 1_000_000
"""Steps that the arrays of one message may take."""


@dataclass
class _Cursor:
    """Where the reading of a message stands."""

    data: bytes
    at: int
    order: str
    aligned: bool
    steps: int = 0

    def length(self, width: int) -> int:
        """The length of an array or text whose elements take at least `width` bytes."""
        self.align(4)
        (count,) = struct.unpack_from(f"{self.order}I", self.data, self.at)
        self.at += 4
        if count * width > len(self.data) - self.at:
            raise BrokenMessage("it claims to be longer than it is")
        return int(count)

    def align(self, size: int) -> None:
        if self.aligned:
            self.at += (_CDR_HEADER - self.at) % size

    def step(self, count: int) -> None:
        """Count steps that have to be gone through one by one."""
        self.steps += count
        if self.steps > _MOST_STEPS:
            raise BrokenMessage(f"its arrays take more than {_MOST_STEPS:,} steps")


_Read = Callable[[_Cursor, Message], None]
"""Read on from the cursor and add what is found."""


@dataclass
class _Numbers:
    """A run of numbers, of a length that is known beforehand."""

    paths: list[str] = field(default_factory=list)
    codes: list[str] = field(default_factory=list)
    packings: dict[tuple[str, int], struct.Struct] = field(default_factory=dict)

    def __call__(self, cursor: _Cursor, found: Message) -> None:
        phase = (cursor.at - _CDR_HEADER) % 8 if cursor.aligned else 0
        packing = self.packings.get((cursor.order, phase))
        if packing is None:
            packing = self._packing(cursor, phase)
        values = packing.unpack_from(cursor.data, cursor.at)
        cursor.at += packing.size
        found.update(zip(self.paths, values, strict=True))

    def _packing(self, cursor: _Cursor, phase: int) -> struct.Struct:
        letters, at = [cursor.order], phase
        for code in self.codes:
            size = struct.calcsize(f"<{code}")
            gap = -at % size if cursor.aligned else 0
            letters.append("x" * gap + code)
            at += gap + size
        packing = struct.Struct("".join(letters))
        self.packings[cursor.order, phase] = packing
        return packing


def decoder(name: str, data: bytes, dialect: Dialect) -> Decode:
    """The decoder of the messages that a schema defines.

    Parameters
    ----------
    name : str
        Of the schema.
    data : bytes
        Its text.
    dialect : {"ros1", "ros2"}

    Raises
    ------
    DefinitionError
        If the definitions cannot be read, or describe messages that have no bounded size.
    """
    plan = _Plan(definitions_of(name, data, dialect), dialect)
    plan.add_message(short_name(name), "", 0)
    steps = plan.steps

    def decode(data: bytes) -> Message:
        cursor = _opened(data) if dialect == "ros2" else _Cursor(data, 0, "<", aligned=False)
        found: Message = {}
        try:
            for step in steps:
                step(cursor, found)
        except struct.error:
            raise BrokenMessage("it ends too early") from None
        rest = len(data) - cursor.at
        if rest < 0:
            raise BrokenMessage("it ends too early")
        if rest >= (_PADDING if dialect == "ros2" else 1):
            raise BrokenMessage("it is longer than its definition")
        return found

    return decode


def _opened(data: bytes) -> _Cursor:
    """The cursor behind the header of a CDR message."""
    if len(data) < _CDR_HEADER:
        raise BrokenMessage("it ends too early")
    if data[0] != 0 or data[1] > 1:
        raise BrokenMessage(f"it is no plain CDR (its header is {data[:2].hex(' ')})")
    return _Cursor(data, _CDR_HEADER, "<" if data[1] else ">", aligned=True)


class _Plan:
    """The steps that read a message, while they are put together."""

    def __init__(self, definitions: Definitions, dialect: Dialect) -> None:
        self.definitions = definitions
        self.dialect: Dialect = dialect
        self.steps: list[_Read] = []
        self.size = 0

    def add_message(self, name: str, path: str, depth: int) -> None:
        """Add the steps that read the message called `name`, found at `path`."""
        if depth > DEEPEST:
            raise DefinitionError(f"{name[:60]} is nested more than {DEEPEST} levels deep")
        members = self.definitions[name]
        if not members and self.dialect == "ros2":
            # CDR has no message without content: one byte stands for it.
            self.steps.append(_skip(1))
        for member in members:
            place = f"{path}.{member.name}" if path else member.name
            if member.sequence:
                self._add_sequence(member.type, place, depth)
            elif member.count is None:
                self._add_value(member.type, place, depth)
            elif member.type in NUMBERS and member.count > MOST_ELEMENTS:
                self.steps.append(_skip_numbers(NUMBERS[member.type], member.count, place))
            elif member.count > MOST_ELEMENTS:
                self.steps.append(self._elements(member.type, place, depth, member.count))
            else:
                for at in range(member.count):
                    self._add_value(member.type, f"{place}[{at}]", depth)

    def _add_value(self, type_name: str, path: str, depth: int) -> None:
        self.size += 1
        if self.size > _MOST_NUMBERS:
            raise DefinitionError(f"the schema has more than {_MOST_NUMBERS:,} fields")
        if type_name in NUMBERS:
            last = self.steps[-1] if self.steps else None
            if not isinstance(last, _Numbers):
                self.steps.append(last := _Numbers())
            last.paths.append(path)
            last.codes.append(NUMBERS[type_name])
        elif type_name == "string":
            self.steps.append(_text(path))
        else:
            self.add_message(type_name, path, depth + 1)

    def _add_sequence(self, type_name: str, path: str, depth: int) -> None:
        if type_name in ("uint8", "int8"):
            self.steps.append(_blob(path))
        elif type_name in NUMBERS:
            self.steps.append(_sequence(NUMBERS[type_name], path))
        else:
            self.steps.append(self._elements(type_name, path, depth, None))

    def _elements(self, type_name: str, path: str, depth: int, fixed: int | None) -> _Read:
        """Read an array of texts or messages, element by element."""
        plan = _Plan(self.definitions, self.dialect)
        plan.size = self.size
        plan._add_value(type_name, "", depth)
        self.size = plan.size
        steps = plan.steps
        bare = type_name == "string"

        def read(cursor: _Cursor, found: Message) -> None:
            count = cursor.length(0) if fixed is None else fixed
            cursor.step(count * max(1, len(steps)))
            kept: list[Any] = []
            for _ in range(count):
                element: Message = {}
                for step in steps:
                    step(cursor, element)
                if count <= MOST_ELEMENTS:
                    kept.append(element[""] if bare else element)
            found[path] = kept if count <= MOST_ELEMENTS else LONG_ARRAY

        return read


def _text(path: str) -> _Read:
    def read(cursor: _Cursor, found: Message) -> None:
        length = cursor.length(1)
        text = cursor.data[cursor.at : cursor.at + length]
        cursor.at += length
        if cursor.aligned:
            text = text.removesuffix(b"\0")
        # Some publishers write Latin-1; the numbers beside it are not given up for that.
        found[path] = text.decode("utf-8", "backslashreplace")

    return read


def _blob(path: str) -> _Read:
    def read(cursor: _Cursor, found: Message) -> None:
        length = cursor.length(1)
        cursor.at += length
        found[path] = BYTES

    return read


def _sequence(code: str, path: str) -> _Read:
    size = struct.calcsize(f"<{code}")

    def read(cursor: _Cursor, found: Message) -> None:
        count = cursor.length(size)
        if count:
            cursor.align(size)
        if count > MOST_ELEMENTS:
            found[path] = LONG_ARRAY
        else:
            packing = f"{cursor.order}{count}{code}"
            found[path] = list(struct.unpack_from(packing, cursor.data, cursor.at))
        cursor.at += count * size

    return read


def _skip_numbers(code: str, count: int, path: str) -> _Read:
    size = struct.calcsize(f"<{code}")

    def read(cursor: _Cursor, found: Message) -> None:
        cursor.align(size)
        cursor.at += count * size
        found[path] = LONG_ARRAY

    return read


def _skip(count: int) -> _Read:
    def read(cursor: _Cursor, found: Message) -> None:  # noqa: ARG001
        cursor.at += count

    return read

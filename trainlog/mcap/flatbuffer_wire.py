"""FlatBuffers messages, taken apart after the binary schema (``.bfbs``) that the file carries.

The Python package of FlatBuffers reads with generated code only. A message, and the schema, which
is a FlatBuffers message itself, are tables: a table points to its vtable, which tells where in it
each field stands, and fields point to texts, vectors and further tables. Every offset is checked,
and the number of tables and the depth are bounded, so that offsets that lead back, or many of them
to the same place, cost nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from trainlog.mcap.foreign_rows import (
    BYTES,
    DEEPEST,
    LONG_ARRAY,
    MOST_ELEMENTS,
    TOO_DEEP,
    BrokenMessage,
    Decode,
    Message,
    Unexpanded,
)

_NUMBERS = dict(zip(range(1, 13), "B?bBhHiIqQfd", strict=True))
"""Letter of the struct module for reflection's base types of numbers."""

_BOOL, _UBYTE, _STRING, _VECTOR, _OBJECT, _ARRAY = 2, 4, 13, 14, 15, 17
_FLOATS = (11, 12)
_UNION = Unexpanded("a union, not expanded")

_MOST_TABLES = 20_000
"""Tables and structs in one message."""


class SchemaError(ValueError):
    """A binary schema that cannot be used; the text says why."""


@dataclass
class _Buffer:
    """The bytes of a message, and how many tables of it may still be read."""

    data: bytes
    left: int = _MOST_TABLES

    def number(self, code: str, at: int) -> Any:
        if at < 0:
            raise BrokenMessage("an offset leads out of it")
        return struct.unpack_from(f"<{code}", self.data, at)[0]

    def target(self, at: int) -> int:
        """Where the offset that stands at `at` leads: always forward."""
        offset: int = self.number("I", at)
        return at + offset

    def place(self, table: int, slot: int) -> int:
        """Where the field with this vtable slot stands; 0 if the table does not have it."""
        vtable = table - self.number("i", table)
        if slot + 2 > self.number("H", vtable):
            return 0
        offset = self.number("H", vtable + slot)
        return table + offset if offset else 0

    def text(self, at: int) -> str:
        """The text that the offset at `at` leads to."""
        start, length = self.vector(at, 1)
        return self.data[start : start + length].decode("utf-8", "backslashreplace")

    def vector(self, at: int, width: int) -> tuple[int, int]:
        """First element and length of the vector that the offset at `at` leads to."""
        start = self.target(at)
        length = self.number("I", start)
        if length * width > len(self.data) - start - 4:
            raise BrokenMessage("it claims to be longer than it is")
        return start + 4, length

    def enter(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise BrokenMessage(f"it has more than {_MOST_TABLES:,} tables")


@dataclass(frozen=True)
class _Field:
    """A field as the schema declares it."""

    name: str
    offset: int
    kind: int
    element: int
    index: int
    length: int
    default: Any


@dataclass(frozen=True)
class _Kind:
    """A table or struct as the schema declares it."""

    name: str
    is_struct: bool
    size: int
    fields: tuple[_Field, ...]


def decoder(name: str, schema: bytes) -> Decode:
    """The decoder of the messages of a binary schema.

    Parameters
    ----------
    name : str
        Of the table that the messages are.
    schema : bytes
        Content of the ``.bfbs`` file.

    Raises
    ------
    SchemaError
        If it is no binary schema, or does not declare such a table.
    """
    try:
        kinds = _kinds(_Buffer(schema))
    except (BrokenMessage, struct.error) as error:
        raise SchemaError("the schema is no binary schema of FlatBuffers") from error
    root = next((kind for kind in kinds if kind.name == name and not kind.is_struct), None)
    if root is None:
        raise SchemaError("the schema does not declare the message it is named for")

    def decode(data: bytes) -> Message:
        buffer = _Buffer(data)
        try:
            found: Message = _table(buffer, buffer.target(0), root, kinds, 0)
        except struct.error:
            raise BrokenMessage("an offset leads out of it") from None
        return found

    return decode


def _kinds(schema: _Buffer) -> list[_Kind]:
    """The tables and structs that a schema declares (``reflection.fbs``)."""
    objects = schema.place(schema.target(0), 4)
    if not objects:
        raise BrokenMessage("no objects")
    return [_kind(schema, table) for table in _tables(schema, objects)]


def _kind(schema: _Buffer, table: int) -> _Kind:
    fields = schema.place(table, 6)
    found = [_field(schema, each) for each in _tables(schema, fields)] if fields else []
    name = schema.place(table, 4)
    return _Kind(
        schema.text(name) if name else "",
        bool(_or(schema, "?", table, 8, default=False)),
        _or(schema, "i", table, 12, default=0),
        tuple(each for each in found if each is not None),
    )


def _field(schema: _Buffer, table: int) -> _Field | None:
    """A field; None if it is deprecated, and not to be read."""
    kind_at, name = schema.place(table, 6), schema.place(table, 4)
    if not kind_at or not name:
        raise BrokenMessage("a field without a type")
    if _or(schema, "?", table, 16, default=False):
        return None
    kind_table = schema.target(kind_at)
    kind = _or(schema, "b", kind_table, 4, default=0)
    default: Any
    if kind in _FLOATS:
        default = _or(schema, "d", table, 14, default=0.0)
    else:
        default = _or(schema, "q", table, 12, default=0)
        default = bool(default) if kind == _BOOL else default
    optional = _or(schema, "?", table, 26, default=False)
    return _Field(
        schema.text(name),
        _or(schema, "H", table, 10, default=0),
        kind,
        _or(schema, "b", kind_table, 6, default=0),
        _or(schema, "i", kind_table, 8, default=-1),
        _or(schema, "H", kind_table, 10, default=0),
        None if optional else default,
    )


def _or(buffer: _Buffer, code: str, table: int, slot: int, *, default: Any) -> Any:
    """A number of a table, or its default."""
    at = buffer.place(table, slot)
    return buffer.number(code, at) if at else default


def _tables(buffer: _Buffer, at: int) -> list[int]:
    """The tables of the vector that the offset at `at` leads to."""
    start, length = buffer.vector(at, 4)
    if length > _MOST_TABLES:
        raise BrokenMessage("more tables than are read")
    return [buffer.target(start + 4 * each) for each in range(length)]


def _table(buffer: _Buffer, at: int, kind: _Kind, kinds: list[_Kind], depth: int) -> Any:
    if depth > DEEPEST:
        return TOO_DEEP
    buffer.enter()
    found: Message = {}
    for field in kind.fields:
        place = buffer.place(at, field.offset)
        if place:
            found[field.name] = _value(buffer, place, field, kinds, depth)
        elif field.kind in _NUMBERS:
            found[field.name] = field.default
    return found


def _struct(buffer: _Buffer, at: int, kind: _Kind, kinds: list[_Kind], depth: int) -> Any:
    if depth > DEEPEST:
        return TOO_DEEP
    buffer.enter()
    return {
        field.name: _value(buffer, at + field.offset, field, kinds, depth) for field in kind.fields
    }


def _value(buffer: _Buffer, at: int, field: _Field, kinds: list[_Kind], depth: int) -> Any:
    """The value of a field that stands at `at`."""
    if field.kind in _NUMBERS:
        return buffer.number(_NUMBERS[field.kind], at)
    if field.kind == _STRING:
        return buffer.text(at)
    if field.kind == _OBJECT:
        return _object(buffer, at, field, kinds, depth)
    if field.kind == _ARRAY:
        return _elements(buffer, at, field.length, field, kinds, depth)
    if field.kind == _VECTOR:
        start, length = buffer.vector(at, 1)
        return _elements(buffer, start, length, field, kinds, depth)
    return _UNION


def _object(buffer: _Buffer, at: int, field: _Field, kinds: list[_Kind], depth: int) -> Any:
    """The table that stands, or is pointed to, at `at`."""
    if not 0 <= field.index < len(kinds):
        raise BrokenMessage("its schema points to no table")
    kind = kinds[field.index]
    if kind.is_struct:
        return _struct(buffer, at, kind, kinds, depth + 1)
    return _table(buffer, buffer.target(at), kind, kinds, depth + 1)


def _elements(
    buffer: _Buffer, start: int, length: int, field: _Field, kinds: list[_Kind], depth: int
) -> Any:
    """The elements of a vector or array."""
    if field.element == _UBYTE:
        return BYTES
    if length > MOST_ELEMENTS:
        return LONG_ARRAY
    if field.element in _NUMBERS:
        packing = f"<{length}{_NUMBERS[field.element]}"
        return list(struct.unpack_from(packing, buffer.data, start))
    read: Callable[[int], Any]
    if field.element == _STRING:
        width, read = 4, buffer.text
    elif field.element == _OBJECT and 0 <= field.index < len(kinds):
        kind = kinds[field.index]
        width = kind.size if kind.is_struct else 4

        def read(at: int) -> Any:
            return _object(buffer, at, field, kinds, depth)
    else:
        return _UNION
    return [read(start + each * width) for each in range(length)]

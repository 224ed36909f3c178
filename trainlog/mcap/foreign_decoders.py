"""Which decoder a foreign channel needs: protobuf, JSON, ROS 1, ROS 2, FlatBuffers.

Whatever a decoder can raise on bytes that it was not made for becomes an `UndecodableError` (the
channel) or a `BrokenMessage` (one message).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as ProtobufMessage
from google.protobuf.unknown_fields import UnknownFieldSet
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory

from trainlog.mcap.errors import shown
from trainlog.mcap.flatbuffer_wire import SchemaError
from trainlog.mcap.flatbuffer_wire import decoder as flatbuffer_decoder
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
from trainlog.mcap.ros_definitions import DefinitionError, Dialect
from trainlog.mcap.ros_wire import decoder as ros_decoder

LARGEST = 2**25
"""Longer messages are not decoded [bytes]: as objects they would take many times their length."""

_REPEATED = 3
"""The label of a repeated field in a protobuf descriptor."""

_MAP = Unexpanded("a map, not expanded")
_UNDECLARED = Unexpanded("fields that the schema does not declare")


class UndecodableError(ValueError):
    """A channel that cannot be decoded; the text says why."""


def decoder_of(channel: Channel, schema: Schema | None) -> Decode:
    """The decoder of a channel's messages.

    Raises
    ------
    UndecodableError
        If there is none for its encoding, or its schema is missing or broken.
    """
    encoding = channel.message_encoding
    if encoding == "json":
        return partial(_bounded, _json)
    kinds: dict[tuple[str, str], Callable[[Schema], Decode]] = {
        ("protobuf", "protobuf"): _protobuf,
        ("cdr", "ros2msg"): partial(_ros, "ros2"),
        ("ros1", "ros1msg"): partial(_ros, "ros1"),
        ("flatbuffer", "flatbuffer"): _flatbuffer,
    }
    if encoding not in {known for known, _ in kinds}:
        raise UndecodableError(f"encoding {shown(encoding)} is not decoded")
    if schema is None:
        raise UndecodableError(f"encoding {shown(encoding)} needs a schema, there is none")
    make = kinds.get((encoding, schema.encoding))
    if make is None:
        raise UndecodableError(
            f"encoding {shown(encoding)} with a schema in {shown(schema.encoding)} is not decoded"
        )
    return make(schema)


def _bounded(decode: Decode, data: bytes) -> Message:
    """Decode a message whose length bounds what it can become."""
    if len(data) > LARGEST:
        raise BrokenMessage(f"it has more than {LARGEST // 2**20} MiB")
    return decode(data)


def _json(data: bytes) -> Message:
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        raise BrokenMessage("it is not JSON") from None
    if not isinstance(found, dict):
        raise BrokenMessage("it is JSON, but no object")
    return found


def _ros(dialect: Dialect, schema: Schema) -> Decode:
    try:
        return ros_decoder(schema.name, schema.data, dialect)
    except DefinitionError as error:
        raise UndecodableError(str(error)) from error


def _flatbuffer(schema: Schema) -> Decode:
    try:
        return flatbuffer_decoder(schema.name, schema.data)
    except SchemaError as error:
        raise UndecodableError(str(error)) from error


def _protobuf(schema: Schema) -> Decode:
    try:
        parse = DecoderFactory().decoder_for("protobuf", schema)
    except (McapError, DecodeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise UndecodableError(f"schema {shown(schema.name)} is no descriptor of it") from error
    if parse is None:
        raise UndecodableError(f"schema {shown(schema.name)} is no descriptor of it")
    readers: dict[str, _Reader] = {}

    def decode(data: bytes) -> Message:
        try:
            message = parse(data)
        except (DecodeError, RecursionError):
            raise BrokenMessage(f"it is no {schema.name[:60]}") from None
        found = _object(message, readers, 0)
        if len(UnknownFieldSet(message)):
            found["(unknown)"] = _UNDECLARED
        return found

    return partial(_bounded, decode)


class _Reader:
    """What turns protobuf messages of one kind into plain values."""

    def __init__(self, descriptor: Any, readers: dict[str, _Reader]) -> None:
        self.readers = readers
        self.scalars = [field.name for field in descriptor.fields if _is_scalar(field)]
        self.others = [
            (field.name, field.has_presence, _plain(field, readers))
            for field in descriptor.fields
            if not _is_scalar(field)
        ]

    def read(self, message: ProtobufMessage, depth: int) -> Message:
        found: Message = {name: getattr(message, name) for name in self.scalars}
        for name, told, plain in self.others:
            if not told or message.HasField(name):
                found[name] = plain(getattr(message, name), depth)
        return found


def _object(message: ProtobufMessage, readers: dict[str, _Reader], depth: int) -> Message:
    descriptor: Any = message.DESCRIPTOR
    reader = readers.get(descriptor.full_name)
    if reader is None:
        reader = readers[descriptor.full_name] = _Reader(descriptor, readers)
    return reader.read(message, depth)


def _is_scalar(field: Any) -> bool:
    """Whether a field always has one number or text."""
    composite = field.message_type is not None or field.type == FieldDescriptor.TYPE_BYTES
    return not (composite or field.has_presence or _is_repeated(field))


def _is_repeated(field: Any) -> bool:
    # Before version 6 the package has no `is_repeated`, after it the label is given up.
    if hasattr(field, "is_repeated"):
        return bool(field.is_repeated)
    return bool(field.label == _REPEATED)


def _plain(field: Any, readers: dict[str, _Reader]) -> Callable[[Any, int], Any]:
    """What turns the value of a field that is not scalar into plain values."""
    nested = field.message_type
    if nested is not None and nested.GetOptions().map_entry:
        return _map

    def single(value: Any, depth: int) -> Any:
        if nested is not None:
            return TOO_DEEP if depth >= DEEPEST else _object(value, readers, depth + 1)
        return BYTES if isinstance(value, bytes) else value

    def several(values: Any, depth: int) -> Any:
        if len(values) > MOST_ELEMENTS:
            return LONG_ARRAY
        if nested is None and field.type != FieldDescriptor.TYPE_BYTES:
            return list(values)
        return [single(value, depth) for value in values]

    return several if _is_repeated(field) else single


def _map(values: Any, depth: int) -> Unexpanded | None:  # noqa: ARG001
    return _MAP if len(values) else None

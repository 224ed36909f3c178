"""Which decoder a foreign channel needs: protobuf, JSON, ROS 1, ROS 2.

Whatever a decoder can raise on bytes that it was not made for becomes an `UndecodableError` (the
channel) or a `BrokenMessage` (one message).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from typing import Any

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as ProtobufMessage
from google.protobuf.unknown_fields import UnknownFieldSet
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory

from trainlog.mcap.errors import shown
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

LARGEST = 2**26
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


def _protobuf(schema: Schema) -> Decode:
    try:
        parse = DecoderFactory().decoder_for("protobuf", schema)
    except (McapError, DecodeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise UndecodableError(f"schema {shown(schema.name)} is no descriptor of it") from error
    if parse is None:
        raise UndecodableError(f"schema {shown(schema.name)} is no descriptor of it")
    fields: dict[str, list[_Getter]] = {}

    def decode(data: bytes) -> Message:
        try:
            message = parse(data)
        except (DecodeError, RecursionError):
            raise BrokenMessage(f"it is no {schema.name[:60]}") from None
        found = _object(message, fields, 0)
        if len(UnknownFieldSet(message)):
            found["(unknown)"] = _UNDECLARED
        return found

    return partial(_bounded, decode)


_Getter = tuple[str, bool, Callable[[Any, int], Any]]
"""Name of a field, whether it may be absent, and what turns its value into a plain one."""


def _object(message: ProtobufMessage, fields: dict[str, list[_Getter]], depth: int) -> Message:
    descriptor: Any = message.DESCRIPTOR
    getters = fields.get(descriptor.full_name)
    if getters is None:
        getters = fields[descriptor.full_name] = _getters(descriptor, fields)
    return {
        name: plain(getattr(message, name), depth)
        for name, told, plain in getters
        if not told or message.HasField(name)
    }


def _getters(descriptor: Descriptor, fields: dict[str, list[_Getter]]) -> list[_Getter]:
    return [
        (str(field.name), bool(field.has_presence), _plain(field, fields))
        for field in descriptor.fields
    ]


def _plain(field: FieldDescriptor, fields: dict[str, list[_Getter]]) -> Callable[[Any, int], Any]:
    nested = field.message_type
    if nested is not None and nested.GetOptions().map_entry:
        return _map

    def single(value: Any, depth: int) -> Any:
        if nested is not None:
            return TOO_DEEP if depth >= DEEPEST else _object(value, fields, depth + 1)
        return BYTES if isinstance(value, bytes) else value

    def several(values: Any, depth: int) -> Any:
        if len(values) > MOST_ELEMENTS:
            return LONG_ARRAY
        return [single(value, depth) for value in values]

    # Before version 6 the package has no `is_repeated`, after it the label is given up.
    told: Any = field
    repeated = told.is_repeated if hasattr(field, "is_repeated") else told.label == _REPEATED
    return several if repeated else single


def _map(values: Any, depth: int) -> Unexpanded | None:  # noqa: ARG001
    return _MAP if len(values) else None

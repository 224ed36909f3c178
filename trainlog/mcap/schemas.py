"""Schemas and channels: how the table of topics is declared in a file, and read from one.

A ``trainlog.*`` message has one ``optional double`` a field; a field with one value for each
powered axle is a ``repeated double``. The field's number is its place in the table, so new fields
go at the end of a topic. A reader finds fields by name, in the descriptor that the file carries.

A channel's metadata explains its fields to whoever opens the file: ``unit.<field>`` (SI),
``meaning.<field>`` and, for a field with one value for each powered axle, ``axles.<field>``, the
number of values in every message.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.message import DecodeError
from mcap.records import Channel, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_protobuf.schema import build_file_descriptor_set

from trainlog.mcap.source import shown, unusable
from trainlog.topics import TOPICS, Topic

UNIT, MEANING, AXLES = "unit.", "meaning.", "axles."
"""Prefixes of a channel's metadata keys."""

_MOST_AXLES = 4096
"""More values in one message are not believed; a message would pass 64 KiB."""

_FOXGLOVE = {"foxglove.LocationFix": LocationFix, "foxglove.Log": Log}

_FIX_FIELDS = (
    "latitude",
    "longitude",
    "altitude",
    "position_covariance",
    "position_covariance_type",
    "timestamp",
)

_HIGHEST_NUMBER = 2**29 - 1
"""Of a protobuf field."""


@dataclass(frozen=True)
class WireField:
    """A ``double`` field of a message as a descriptor declares it."""

    name: str
    number: int
    repeated: bool


def schema_of(topic: Topic, schema_id: int) -> Schema:
    """The schema record of a topic."""
    return Schema(
        id=schema_id,
        name=topic.message,
        encoding=SchemaEncoding.Protobuf,
        data=descriptor_set(topic),
    )


def channel_of(topic: Topic, channel_id: int, schema_id: int, axles: dict[str, int]) -> Channel:
    """The channel record of a topic whose fields have that many axles."""
    metadata = {f"{UNIT}{field.name}": field.unit for field in topic.fields}
    metadata |= {f"{MEANING}{field.name}": field.meaning for field in topic.fields}
    metadata |= {f"{AXLES}{name}": str(count) for name, count in axles.items()}
    return Channel(
        id=channel_id,
        topic=topic.name,
        message_encoding=MessageEncoding.Protobuf,
        metadata=metadata,
        schema_id=schema_id,
    )


def topic_of(channel: Channel, schema: Schema | None) -> Topic | None:
    """The topic of trainlog's table that a file's channel carries; None if it is foreign."""
    topic = TOPICS.get(channel.topic)
    if topic is None or schema is None or schema.name != topic.message:
        return None
    encodings = (channel.message_encoding, schema.encoding)
    if encodings != (MessageEncoding.Protobuf, SchemaEncoding.Protobuf):
        return None
    return topic


def axles_of(channel: Channel) -> dict[str, int]:
    """How many values each repeated field of the channel has, as its metadata state."""
    counts = {}
    for key, text in channel.metadata.items():
        if key.startswith(AXLES) and re.fullmatch(r"[0-9]{1,4}", text):
            counts[key.removeprefix(AXLES)] = min(int(text), _MOST_AXLES)
    return counts


@cache
def descriptor_set(topic: Topic) -> bytes:
    """The serialised FileDescriptorSet that the log embeds for `topic`."""
    if topic.foxglove:
        files = build_file_descriptor_set(_FOXGLOVE[topic.message])
    else:
        files = FileDescriptorSet(file=[_file(topic)])
    data: bytes = files.SerializeToString(deterministic=True)
    return data


def wire_fields(schema: Schema) -> tuple[WireField, ...] | None:
    """The fields of the message that `schema` declares, in the order of their numbers.

    None if the message holds anything else than doubles, or two fields of one name or number.

    Raises
    ------
    LogError
        If the schema is not a FileDescriptorSet, or does not declare the message it is named for.
    """
    declared = sorted(_declared(schema).field, key=lambda field: field.number)
    # In a broken descriptor a name can come as bytes that are not UTF-8.
    names = {field.name for field in declared if str(field.name).isidentifier()}
    numbers = {field.number for field in declared if 0 < field.number <= _HIGHEST_NUMBER}
    if len(names) < len(declared) or len(numbers) < len(declared):
        return None
    if any(field.type != FieldDescriptorProto.TYPE_DOUBLE for field in declared):
        return None
    return tuple(
        WireField(field.name, field.number, field.label == FieldDescriptorProto.LABEL_REPEATED)
        for field in declared
    )


def is_location_fix(schema: Schema) -> bool:
    """Whether `schema` numbers the fields of a position as ``foxglove.LocationFix`` does.

    Raises
    ------
    LogError
        As `wire_fields`.
    """
    published = LocationFix.DESCRIPTOR.fields_by_name
    declared = {field.name: field for field in _declared(schema).field}
    return all(
        name in declared
        and (declared[name].number, declared[name].type)
        == (published[name].number, published[name].type)
        for name in _FIX_FIELDS
    )


def _declared(schema: Schema) -> DescriptorProto:
    try:
        files = FileDescriptorSet.FromString(schema.data)
    except DecodeError as error:
        raise unusable(f"schema {shown(schema.name)} is not a protobuf descriptor") from error
    for file in files.file:
        for message in file.message_type:
            if f"{file.package}.{message.name}" == schema.name:
                return message
    raise unusable(f"schema {shown(schema.name)} does not declare the message it is named for")


def _file(topic: Topic) -> FileDescriptorProto:
    """The ``.proto`` file of a ``trainlog.*`` message."""
    package, _, name = topic.message.rpartition(".")
    message = DescriptorProto(name=name)
    for number, item in enumerate(topic.fields, start=1):
        field = message.field.add(
            name=item.name, number=number, type=FieldDescriptorProto.TYPE_DOUBLE
        )
        if item.per_axle:
            field.label = FieldDescriptorProto.LABEL_REPEATED
        else:
            # In proto3 a oneof of the field alone distinguishes an absent value from zero.
            field.label = FieldDescriptorProto.LABEL_OPTIONAL
            field.proto3_optional = True
            field.oneof_index = len(message.oneof_decl)
            message.oneof_decl.add(name=f"_{item.name}")
    return FileDescriptorProto(
        name=f"{package}/{name}.proto", package=package, syntax="proto3", message_type=[message]
    )

"""Protobuf schemas, made from the table of topics.

A ``trainlog.*`` message has one ``optional double`` a field; a field with one value for each
powered axle is a ``repeated double``. The field's number is its place in the table, so new fields
go at the end of a topic. A reader finds fields by name, in the descriptor that the file carries.
"""

from __future__ import annotations

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
from mcap.records import Schema
from mcap_protobuf.schema import build_file_descriptor_set

from trainlog.mcap.errors import shown, unusable
from trainlog.topics import Topic

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

    None if the message holds anything else than doubles, or fields that cannot be told apart.

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
            # proto3 tells an absent value from zero by a oneof of the field alone.
            field.label = FieldDescriptorProto.LABEL_OPTIONAL
            field.proto3_optional = True
            field.oneof_index = len(message.oneof_decl)
            message.oneof_decl.add(name=f"_{item.name}")
    return FileDescriptorProto(
        name=f"{package}/{name}.proto", package=package, syntax="proto3", message_type=[message]
    )

"""Messages of constant length as numpy records, and events one by one.

When every message of a channel has the same length and the same bytes outside its values, the
messages of a chunk are an array: written by filling columns into copies of a template, read by
gathering the records and taking columns out. The file stays entirely standard; nothing in it says
that it was made this way. A codec knows one channel: it turns columns into message records and
records into columns.

A ``trainlog.*`` message has one ``optional double`` a field; a field with one value for each
powered axle is a ``repeated double``. The field's number is its place in the table, so new fields
go at the end of a topic. A reader finds fields by name, in the descriptor that the file carries.

A channel's metadata explains its fields to whoever opens the file: ``unit.<field>`` (SI),
``meaning.<field>`` and, for a field with one value for each powered axle, ``axles.<field>``, the
number of values in every message. Of a topic of the recorder's own the metadata are all that is
known; there ``interpolation.<field>`` says how values between samples are found.
"""

from __future__ import annotations

import base64
import binascii
import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.message import DecodeError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_protobuf.schema import build_file_descriptor_set
from numpy.typing import NDArray

from trainlog.arrays import FloatArray, IntArray, UintArray
from trainlog.errors import InputError, LogError
from trainlog.mcap.records import MESSAGE, RECORD_HEAD, shown, unusable, windows
from trainlog.topics import EVENTS, RECORDED, TOPICS, Field, Interpolation, Topic, recorded_topic

SEQUENCE, LOG_TIME, PUBLISH_TIME = "#sequence", "#log_time", "#publish_time"
"""Fields of a record that belong to its head; no field of a protobuf message has such a name."""

HIGHEST_LEVEL = 5
"""foxglove.Log.FATAL."""

Columns = dict[str, Any]
"""Arrays of values by column of the frame."""

_DOUBLE, _LENGTH_DELIMITED = 1, 2
"""Protobuf wire types."""

_UNKNOWN, _DIAGONAL_KNOWN, _KNOWN = 0, 2, 3
"""Values of LocationFix.PositionCovarianceType."""


# -------------------------------------------------------------------------------------- layouts


@dataclass(frozen=True)
class Value:
    """A variable part of a message: a name, the numpy type of its bytes, how many if an array."""

    name: str
    format: str
    count: int | None = None


@dataclass(frozen=True)
class Layout:
    """Where the constant and the variable bytes of a channel's message records are.

    Attributes
    ----------
    record : numpy.dtype
        Packed record of one message: `SEQUENCE`, `LOG_TIME`, `PUBLISH_TIME` and the values.
    template : bytes
        One record with every variable byte zero.
    constants : tuple of str
        Fields of `record` that are the same in every message.
    """

    record: np.dtype[np.void]
    template: bytes
    constants: tuple[str, ...]

    @property
    def size(self) -> int:
        """Length of one record, head included [bytes]."""
        return len(self.template)

    def rows(self, count: int) -> NDArray[np.void]:
        """`count` records with the constant bytes in place."""
        return np.frombuffer(bytearray(self.template) * count, dtype=self.record)

    def matches(self, rows: NDArray[np.void]) -> bool:
        """Whether each record has the constant bytes where they belong."""
        expected = self.rows(1)
        return all(bool(np.all(rows[name] == expected[name])) for name in self.constants)


def layout(channel: int, body: Iterable[bytes | Value]) -> Layout:
    """Layout of a channel whose messages are `body`: constant bytes and values in wire order."""
    head = struct.pack("<BQH", Opcode.MESSAGE, 0, channel)
    stated = (Value(SEQUENCE, "<u4"), Value(LOG_TIME, "<u8"), Value(PUBLISH_TIME, "<u8"))
    fields: list[Any] = []
    template, constants = bytearray(), []
    for part in (head, *stated, *body):
        if isinstance(part, Value):
            fields.append((part.name, part.format, part.count or ()))
            template += bytes(np.dtype(fields[-1:]).itemsize)
            continue
        while part:
            # As whole numbers: they are compared faster than bytes one by one.
            size = 1 << min(len(part), 8).bit_length() - 1
            constants.append(f"#{len(template)}")
            fields.append((constants[-1], f"u{size}"))
            template, part = template + part[:size], part[size:]
    struct.pack_into("<Q", template, 1, len(template) - RECORD_HEAD)
    return Layout(np.dtype(fields), bytes(template), tuple(constants))


def gather(buffer: bytes, offsets: NDArray[np.integer], form: Layout) -> NDArray[np.void] | None:
    """The records that start at `offsets` of a chunk, or None if they do not fit the layout."""
    if len(offsets) == 0:
        return form.rows(0)
    last = len(buffer) - form.size
    if len(offsets) * form.size > len(buffer) or not 0 <= offsets.min() <= offsets.max() <= last:
        return None
    if len(offsets) * form.size == len(buffer):
        # They follow each other and fill the chunk.
        rows = np.frombuffer(buffer, dtype=form.record)
    else:
        rows = windows(buffer, form.size)[offsets].view(form.record)
    return rows if form.matches(rows) else None


def scatter(rows: NDArray[np.void], buffer: bytearray | memoryview, offsets: IntArray) -> None:
    """Put the records at `offsets` of a chunk that is being built."""
    size = rows.dtype.itemsize
    windows(buffer, size)[offsets] = rows.view(f"V{size}")


def varint(number: int) -> bytes:
    """`number` as a protobuf varint, in its shortest form."""
    encoded = bytearray()
    while number > 0x7F:
        encoded.append(number & 0x7F | 0x80)
        number >>= 7
    encoded.append(number)
    return bytes(encoded)


# --------------------------------------------------------------------------------------- codecs


@dataclass(frozen=True)
class SampleCodec:
    """A ``trainlog.*`` message: one double a field, several for a field with axles.

    Attributes
    ----------
    layout : Layout
    fields : tuple of WireField
    axles : dict of str to int
        How many values each repeated field has in every message of the channel.
    """

    layout: Layout
    fields: tuple[WireField, ...]
    axles: dict[str, int]

    @property
    def names(self) -> list[str]:
        """The columns that a frame of the channel has in full."""
        return [name for name, _, _ in self._values()]

    def encode(self, time: IntArray, table: FloatArray) -> NDArray[np.void]:
        """The message records of a table: one row a column of `names`, one column a message."""
        rows, values, at = _timed(self.layout, time), _one_nan(table), 0
        for field in self.fields:
            count = self.axles.get(field.name, 0) if field.repeated else 1
            if count:
                rows[field.name] = values[at : at + count].T if field.repeated else values[at]
            at += count
        return rows

    def columns(self, rows: NDArray[np.void]) -> Columns:
        """The columns that message records hold."""
        return {
            name: rows[field] if axle is None else rows[field][:, axle]
            for name, field, axle in self._values()
        }

    def _values(self) -> Iterator[tuple[str, str, int | None]]:
        """Each column with its field, and which of the field's values it is."""
        for field in self.fields:
            if not field.repeated:
                yield field.name, field.name, None
            for axle in range(self.axles.get(field.name, 0)):
                yield f"{field.name}_{axle + 1}", field.name, axle


def sample_codec(channel: int, fields: Sequence[WireField], axles: dict[str, int]) -> SampleCodec:
    """Codec of a ``trainlog.*`` channel from the fields of its message."""
    body: list[bytes | Value] = []
    for field in fields:
        count = axles.get(field.name, 0)
        if not field.repeated:
            body += [varint(field.number << 3 | _DOUBLE), Value(field.name, "<f8")]
        elif count:
            tag = varint(field.number << 3 | _LENGTH_DELIMITED)
            body += [tag + varint(8 * count), Value(field.name, "<f8", count)]
    return SampleCodec(layout(channel, body), tuple(fields), dict(axles))


@dataclass(frozen=True)
class FixCodec:
    """A ``foxglove.LocationFix``: accuracies are the diagonal of the position covariance."""

    layout: Layout

    @property
    def names(self) -> list[str]:
        """The columns that a frame of the channel has in full."""
        return ["latitude", "longitude", "altitude", "horizontal_accuracy", "vertical_accuracy"]

    def encode(self, time: IntArray, table: FloatArray) -> NDArray[np.void]:
        """The message records of a table: one row a column of `names`, one column a message."""
        rows = _timed(self.layout, time)
        known = _one_nan(table)
        with np.errstate(over="ignore", under="ignore"):
            horizontal, vertical = known[3:] ** 2
        rows["latitude"], rows["longitude"], rows["altitude"] = known[:3]
        rows["east"], rows["north"], rows["up"] = horizontal, horizontal, vertical
        unknown = np.all(np.isnan(table[3:]), axis=0)
        rows["covariance_type"] = np.where(unknown, _UNKNOWN, _DIAGONAL_KNOWN)
        seconds, nanoseconds = np.divmod(time.astype(np.uint64), np.uint64(10**9))
        rows["seconds"], rows["nanoseconds"] = _padded_varint(seconds), _padded_varint(nanoseconds)
        return rows

    def columns(self, rows: NDArray[np.void]) -> Columns | None:
        """The columns that message records hold; None if the covariance type is a longer varint."""
        kind = rows["covariance_type"]
        if np.any(kind > _KNOWN):
            return None
        found = {name: rows[name] for name in ("latitude", "longitude", "altitude")}
        return found | accuracies(kind, rows["east"], rows["north"], rows["up"])


def fix_codec(channel: int) -> FixCodec:
    """Codec of a ``foxglove.LocationFix`` channel.

    The time stamp's two varints are padded to five bytes, enough for the year 2262; protobuf reads
    them like shorter ones.
    """
    zeros = bytes(8 * 3)
    body: list[bytes | Value] = [
        b"\x09",
        Value("latitude", "<f8"),
        b"\x11",
        Value("longitude", "<f8"),
        b"\x19",
        Value("altitude", "<f8"),
        b"\x22" + varint(8 * 9),
        Value("east", "<f8"),
        zeros,
        Value("north", "<f8"),
        zeros,
        Value("up", "<f8"),
        b"\x28",
        Value("covariance_type", "<u1"),
        b"\x32\x0c\x08",
        Value("seconds", "<u1", 5),
        b"\x10",
        Value("nanoseconds", "<u1", 5),
    ]
    return FixCodec(layout(channel, body))


Codec = SampleCodec | FixCodec
"""What one channel's messages look like."""


def codec_of(channel: Channel, schema: Schema) -> Codec | None:
    """How to read the messages of a channel as arrays; None if only one by one.

    Raises
    ------
    LogError
        If the schema is broken, or the channel declares another unit than trainlog's table.
    """
    topic = topic_of(channel, schema)
    assert topic is not None, "foreign channels are not asked for"
    for field in topic.fields:
        declared = channel.metadata.get(f"{UNIT}{field.name}", field.unit)
        if declared != field.unit:
            raise LogError(
                f"channel {topic.name} gives {field.name} in {shown(declared)}, "
                f"not in {shown(field.unit)}",
                remedy="bring it in as a recorded log, which converts units",
            )
    if topic is EVENTS:
        return None
    if topic.foxglove:
        return fix_codec(channel.id) if is_location_fix(schema) else None
    fields = wire_fields(schema)
    return None if fields is None else sample_codec(channel.id, fields, axles_of(channel))


def codec_for(topic: Topic, channel: int, axles: dict[str, int]) -> Codec:
    """How the messages of a topic's channel are laid out when they are written; not for events."""
    if topic.foxglove:
        return fix_codec(channel)
    fields = [
        WireField(field.name, at, field.per_axle) for at, field in enumerate(topic.fields, start=1)
    ]
    return sample_codec(channel, fields, axles)


def table_of(frame: pd.DataFrame, names: Sequence[str]) -> FloatArray:
    """The frame's columns `names` as the rows of a table; NaN where a column is absent.

    Raises
    ------
    LogError
        If a column holds something that is not a number.
    """
    if list(frame.columns) == list(names) and bool((frame.dtypes == np.float64).all()):
        # The frame's own memory, as pandas keeps columns of one kind.
        return np.ascontiguousarray(frame.to_numpy().T)
    table = np.full((len(names), len(frame)), np.nan)
    for row, name in zip(table, names, strict=True):
        if name in frame:
            try:
                row[:] = frame[name].to_numpy(dtype=np.float64, na_value=np.nan)
            except (TypeError, ValueError) as error:
                raise LogError(
                    f"column {name} holds something that is not a number",
                    place=frame.attrs.get("topic"),
                    remedy="give numbers in SI units, NaN where there is none",
                ) from error
    return table


def accuracies(
    kind: NDArray[Any], east: NDArray[Any], north: NDArray[Any], up: NDArray[Any]
) -> Columns:
    """Standard deviations [m] from the covariance's diagonal [m²], NaN where it is not known."""
    with np.errstate(invalid="ignore", over="ignore"):
        horizontal = np.where(kind == _UNKNOWN, np.nan, np.sqrt((east + north) / 2))
        vertical = np.where(kind == _UNKNOWN, np.nan, np.sqrt(up))
    return {"horizontal_accuracy": horizontal, "vertical_accuracy": vertical}


def _timed(form: Layout, time: IntArray) -> NDArray[np.void]:
    """Records with the constant bytes and the times in place."""
    rows = form.rows(len(time))
    rows[LOG_TIME] = rows[PUBLISH_TIME] = time
    return rows


def _one_nan(table: FloatArray) -> FloatArray:
    """The table with one pattern of bits for NaN, so that the same trip gives the same bytes."""
    absent = np.isnan(table)
    return np.where(absent, np.nan, table) if absent.any() else table


def _padded_varint(numbers: UintArray) -> NDArray[np.uint8]:
    """Each number as a varint of exactly five bytes."""
    shifted = numbers[:, None] >> np.arange(0, 35, 7, dtype=np.uint64)
    more = np.array([0x80, 0x80, 0x80, 0x80, 0], dtype=np.uint64)
    return (shifted & np.uint64(0x7F) | more).astype(np.uint8)


# ------------------------------------------------------------------------------------ positions
#
# Where the train was in each chunk: for each topic with the train's position, one entry a chunk
# that has messages of the topic. An entry is four little-endian words of eight bytes: where the
# chunk begins in the file and the log time of its first message, as integers, and the least and the
# greatest position, as doubles, NaN if none is known. The entries follow each other, in base64.

Range = tuple[float, float]
"""Least and greatest position [m]; NaN if none is known."""

Entry = tuple[int, int, float, float]
"""Where a chunk begins, the log time of its first message [ns], its least and greatest position."""

_ENTRY = np.dtype([("offset", "<u8"), ("start", "<u8"), ("least", "<f8"), ("greatest", "<f8")])


def encoded(entries: Sequence[Entry]) -> str:
    """The entries of a topic as text."""
    return base64.b64encode(np.array(entries, dtype=_ENTRY).tobytes()).decode("ascii")


def decoded(text: str) -> dict[tuple[int, int], Range]:
    """The positions by offset and start of the chunk; empty if the text is no such index."""
    try:
        data = base64.b64decode(text, validate=True)
        entries = np.frombuffer(data, dtype=_ENTRY).tolist()
    except (binascii.Error, ValueError):
        return {}
    return {(offset, start): (least, greatest) for offset, start, least, greatest in entries}


def range_of(position: FloatArray) -> Range:
    """The least and the greatest of positions, as far as they are known."""
    known = position[np.isfinite(position)]
    return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)


# --------------------------------------------------------------------------------------- events


def encode_events(channel: int, frame: pd.DataFrame) -> list[bytes]:
    """The ``foxglove.Log`` records of an event frame's rows, their sequence numbers zero.

    Raises
    ------
    LogError
        If a level is none of foxglove.Log's, or a text cannot be written as UTF-8.
    """
    records = []
    times = pd.DatetimeIndex(frame.index).as_unit("ns").asi8.tolist()
    texts = (_texts(frame, "message"), _texts(frame, "name"))
    for time, level, message, name in zip(times, _levels(frame), *texts, strict=True):
        log = Log(level=Log.Level.ValueType(level), message=message, name=name)
        log.timestamp.seconds, log.timestamp.nanos = divmod(time, 10**9)
        data = log.SerializeToString(deterministic=True)
        length = MESSAGE.size - RECORD_HEAD + len(data)
        records.append(MESSAGE.pack(Opcode.MESSAGE, length, channel, 0, time, time) + data)
    return records


def _levels(frame: pd.DataFrame) -> list[int]:
    if "level" not in frame:
        return [int(Log.UNKNOWN)] * len(frame)
    levels = frame["level"].to_numpy(dtype=np.float64, na_value=np.nan)
    wrong = np.flatnonzero(~np.isin(levels, range(HIGHEST_LEVEL + 1)))
    if len(wrong):
        raise LogError(
            f"{frame['level'].iloc[wrong[0]]} is not a level of an event",
            place=f"row {wrong[0]}, column level",
            remedy=f"give a whole number from 0 to {HIGHEST_LEVEL}",
        )
    return [int(level) for level in levels]


def _texts(frame: pd.DataFrame, column: str) -> list[str]:
    if column not in frame:
        return [""] * len(frame)
    texts = ["" if pd.isna(text) else str(text) for text in frame[column]]
    for row, text in enumerate(texts):
        try:
            text.encode()
        except UnicodeEncodeError as error:
            raise LogError(
                "the text cannot be written as UTF-8",
                place=f"row {row}, column {column}",
                remedy="remove the broken characters",
            ) from error
    return texts


# -------------------------------------------------------------------------- schemas and channels

UNIT, MEANING, AXLES, BETWEEN = "unit.", "meaning.", "axles.", "interpolation."
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
    if topic.name not in TOPICS:
        metadata |= {f"{BETWEEN}{field.name}": field.interpolation for field in topic.fields}
    return Channel(
        id=channel_id,
        topic=topic.name,
        message_encoding=MessageEncoding.Protobuf,
        metadata=metadata,
        schema_id=schema_id,
    )


def is_as_written(record: Schema | Channel) -> bool:
    """Whether trainlog declares one of its topics with just this record, but for the numbers.

    Examples
    --------
    >>> from trainlog.topics import TRAIN_STATE
    >>> is_as_written(schema_of(TRAIN_STATE, 7))
    True
    """
    if isinstance(record, Schema):
        messages = {topic.message: topic for topic in TOPICS.values()}
        topic = messages.get(record.name)
        return topic is not None and record == schema_of(topic, record.id)
    topic = TOPICS.get(record.topic)
    return topic is not None and record == channel_of(
        topic, record.id, record.schema_id, axles_of(record)
    )


def topic_of(channel: Channel, schema: Schema | None) -> Topic | None:
    """The topic that a file's channel carries, of the table or described by the channel itself.

    None if it is foreign.
    """
    if schema is None:
        return None
    encodings = (channel.message_encoding, schema.encoding)
    if encodings != (MessageEncoding.Protobuf, SchemaEncoding.Protobuf):
        return None
    topic = TOPICS.get(channel.topic) or _described(channel, schema)
    return topic if topic is not None and schema.name == topic.message else None


def _described(channel: Channel, schema: Schema) -> Topic | None:
    """The recorder's own topic that a channel describes; None if it describes none."""
    if not channel.topic.startswith(RECORDED):
        return None
    between: dict[str, Interpolation] = {"linear": "linear", "previous": "previous"}
    try:
        return recorded_topic(
            channel.topic,
            (
                Field(
                    field.name,
                    channel.metadata.get(f"{UNIT}{field.name}", "1"),
                    channel.metadata.get(f"{MEANING}{field.name}", ""),
                    between.get(channel.metadata.get(f"{BETWEEN}{field.name}", ""), "linear"),
                )
                for field in wire_fields(schema) or ()
                if not field.repeated
            ),
        )
    except (InputError, LogError):
        return None


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

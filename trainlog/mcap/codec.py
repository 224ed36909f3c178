"""Messages of constant length as numpy records, and events one by one.

When every message of a channel has the same length and the same bytes outside its values, the
messages of a chunk are an array: written by filling columns into copies of a template, read by
gathering the records and taking columns out. The file stays entirely standard; nothing in it says
that it was made this way. A codec knows one channel: it turns columns into message records and
records into columns.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import pandas as pd
from foxglove_schemas_protobuf.Log_pb2 import Log
from isal import isal_zlib
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.mcap.schemas import UNIT, WireField, axles_of, is_location_fix, wire_fields
from trainlog.mcap.source import shown
from trainlog.topics import EVENTS, TOPICS, Topic

MESSAGE = struct.Struct("<BQHIQQ")
"""Head of a message record: opcode, length, channel, sequence, log time, publish time."""

RECORD_HEAD = 9
"""Bytes of opcode and length before the content of any record."""

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


_VECTOR = np.zeros(64)


def checksum(data: bytes | bytearray | memoryview, before: int = 0) -> int:
    """CRC-32 of data, continued from that of what stands before.

    On Intel's processors the function of isal leaves the upper halves of the vector registers in
    use. All of Python is then slower, building a tuple by three times, until a function clears them
    as those of numpy do.

    Examples
    --------
    >>> checksum(b"789", checksum(b"123456")) == checksum(b"123456789") == 0xCBF43926
    True
    """
    found: int = isal_zlib.crc32(data, before)
    np.add(_VECTOR, _VECTOR, out=_VECTOR)
    return found


# -------------------------------------------------------------------------------------- layouts


@dataclass(frozen=True)
class Value:
    """A variable part of a message: a name, the numpy type of its bytes, how many if an array."""

    name: str
    format: str
    count: int | None = None

    @property
    def kind(self) -> np.dtype[Any]:
        """What numpy calls it."""
        return np.dtype(self.format if self.count is None else (self.format, (self.count,)))


@dataclass(frozen=True)
class Layout:
    """Where the constant and the variable bytes of a channel's message records are.

    Attributes
    ----------
    record : numpy.dtype
        Packed record of one message: `SEQUENCE`, `LOG_TIME`, `PUBLISH_TIME` and the values.
    template : bytes
        One record with every variable byte zero.
    """

    record: np.dtype[np.void]
    template: bytes

    @property
    def size(self) -> int:
        """Length of one record, head included [bytes]."""
        return len(self.template)

    @cached_property
    def constants(self) -> list[tuple[int, np.uint64, np.uint64]]:
        """Place, mask and value of words of eight bytes that cover the constant bytes."""
        constant = np.ones(self.size, dtype=np.bool_)
        for kind, at, *_ in (self.record.fields or {}).values():
            constant[at : at + kind.itemsize] = False
        mask = bytes(np.where(constant, 0xFF, 0).astype(np.uint8))
        words, covered = [], 0
        for at in np.flatnonzero(constant).tolist():
            if at >= covered:
                start = min(at, self.size - 8)
                covered = start + 8
                halves = (part[start:covered] for part in (mask, self.template))
                words.append((start, *(np.frombuffer(half, dtype="<u8")[0] for half in halves)))
        return words

    def place(self, name: str) -> int:
        """Where a value begins in a record [bytes]."""
        return int(self.record.fields[name][1])  # type: ignore[index]

    def rows(self, count: int) -> NDArray[np.void]:
        """`count` records with the constant bytes in place."""
        return np.frombuffer(bytearray(self.template) * count, dtype=self.record)

    def matches(self, rows: NDArray[np.void]) -> bool:
        """Whether each record has the constant bytes where they belong."""
        raw = rows.view(f"V{self.size}")
        return all(
            bool(np.all((np.ndarray(raw.shape, "<u8", raw.data, at, (self.size,)) & mask) == value))
            for at, mask, value in self.constants
        )


def layout(channel: int, body: Iterable[bytes | Value]) -> Layout:
    """Layout of a channel whose messages are `body`: constant bytes and values in wire order."""
    head = (Value(SEQUENCE, "<u4"), Value(LOG_TIME, "<u8"), Value(PUBLISH_TIME, "<u8"))
    template = bytearray(struct.pack("<BQH", Opcode.MESSAGE, 0, channel))
    kinds, places = {}, {}
    for part in (*head, *body):
        if isinstance(part, Value):
            kinds[part.name], places[part.name] = part.kind, len(template)
            template += bytes(part.kind.itemsize)
        else:
            template += part
    struct.pack_into("<Q", template, 1, len(template) - RECORD_HEAD)
    specification: Any = {
        "names": list(kinds),
        "formats": list(kinds.values()),
        "offsets": list(places.values()),
        "itemsize": len(template),
    }
    return Layout(np.dtype(specification), bytes(template))


def gather(buffer: bytes, offsets: NDArray[np.integer], form: Layout) -> NDArray[np.void] | None:
    """The records that start at `offsets` of a chunk, or None if they do not fit the layout."""
    if len(offsets) == 0:
        return form.rows(0)
    last = len(buffer) - form.size
    if len(offsets) * form.size > len(buffer) or not 0 <= offsets.min() <= offsets.max() <= last:
        return None
    rows = _windows(buffer, form.size)[offsets].view(form.record)
    return rows if form.matches(rows) else None


def scatter(
    rows: NDArray[np.void], buffer: bytearray | memoryview, offsets: NDArray[np.int64]
) -> None:
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


def _windows(buffer: bytes | bytearray | memoryview, size: int) -> NDArray[np.void]:
    """Every window of `size` bytes: indexing it copies whole messages, wherever they start."""
    return np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer, 0, (1,))


# --------------------------------------------------------------------------------------- codecs


class Codec(Protocol):
    """What one channel's messages look like."""

    @property
    def layout(self) -> Layout:
        """Where the bytes of a message are."""

    @property
    def names(self) -> list[str]:
        """The columns that a frame of the channel has in full."""

    def encode(self, time: NDArray[np.int64], table: NDArray[np.float64]) -> NDArray[np.void]:
        """The message records of a table: one row a column of `names`, one column a message."""

    def columns(self, rows: NDArray[np.void]) -> Columns | None:
        """The columns that message records hold; None if they do not fit after all."""


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

    def encode(self, time: NDArray[np.int64], table: NDArray[np.float64]) -> NDArray[np.void]:
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

    def encode(self, time: NDArray[np.int64], table: NDArray[np.float64]) -> NDArray[np.void]:
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


def codec_of(channel: Channel, schema: Schema) -> Codec | None:
    """How to read the messages of a channel as arrays; None if only one by one.

    Raises
    ------
    LogError
        If the schema is broken, or the channel declares another unit than trainlog's table.
    """
    topic = TOPICS[channel.topic]
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


def table_of(frame: pd.DataFrame, names: Sequence[str]) -> NDArray[np.float64]:
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
            row[:] = _doubles(frame, name)
    return table


def _doubles(frame: pd.DataFrame, column: str) -> NDArray[np.float64]:
    try:
        return frame[column].to_numpy(dtype=np.float64, na_value=np.nan)
    except (TypeError, ValueError) as error:
        raise LogError(
            f"column {column} holds something that is not a number",
            place=frame.attrs.get("topic"),
            remedy="give numbers in SI units, NaN where there is none",
        ) from error


def accuracies(
    kind: NDArray[Any], east: NDArray[Any], north: NDArray[Any], up: NDArray[Any]
) -> Columns:
    """Standard deviations [m] from the covariance's diagonal [m²], NaN where it is not known."""
    with np.errstate(invalid="ignore", over="ignore"):
        horizontal = np.where(kind == _UNKNOWN, np.nan, np.sqrt((east + north) / 2))
        vertical = np.where(kind == _UNKNOWN, np.nan, np.sqrt(up))
    return {"horizontal_accuracy": horizontal, "vertical_accuracy": vertical}


def _timed(form: Layout, time: NDArray[np.int64]) -> NDArray[np.void]:
    """Records with the constant bytes and the times in place."""
    rows = form.rows(len(time))
    rows[LOG_TIME] = rows[PUBLISH_TIME] = time
    return rows


def _one_nan(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """The table with one pattern of bits for NaN, so that the same trip gives the same bytes."""
    absent = np.isnan(table)
    return np.where(absent, np.nan, table) if absent.any() else table


def _padded_varint(numbers: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Each number as a varint of exactly five bytes."""
    shifted = numbers[:, None] >> np.arange(0, 35, 7, dtype=np.uint64)
    more = np.array([0x80, 0x80, 0x80, 0x80, 0], dtype=np.uint64)
    return (shifted & np.uint64(0x7F) | more).astype(np.uint8)


# --------------------------------------------------------------------------------------- events


def encode_events(channel: int, frame: pd.DataFrame) -> list[bytes]:
    """The ``foxglove.Log`` records of an event frame's rows, their sequence numbers zero.

    Raises
    ------
    LogError
        If a level is none of foxglove.Log's, or a text cannot be written as UTF-8.
    """
    times = pd.DatetimeIndex(frame.index).as_unit("ns").asi8.tolist()
    texts = zip(_texts(frame, "message"), _texts(frame, "name"), strict=True)
    return [
        event_record(channel, time, level, message, name)
        for time, level, (message, name) in zip(times, _levels(frame), texts, strict=True)
    ]


def event_record(channel: int, time: int, level: int, message: str, name: str) -> bytes:
    """The message record of one event, its sequence number zero."""
    log = Log(level=Log.Level.ValueType(level), message=message, name=name)
    log.timestamp.seconds, log.timestamp.nanos = divmod(time, 10**9)
    data = log.SerializeToString(deterministic=True)
    length = MESSAGE.size - RECORD_HEAD + len(data)
    return MESSAGE.pack(Opcode.MESSAGE, length, channel, 0, time, time) + data


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

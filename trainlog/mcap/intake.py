"""What a recording has been given and not yet written: samples in rows of bytes, by topic.

The caller's side of a recording must cost little and never wait, so that a sample is checked and
laid down in one step, as a row of eight-byte words: log time, number of the sample in its topic,
values. The rows become arrays again when the recorder takes them.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np
import pandas as pd
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.mcap.channels import channel_of, schema_of
from trainlog.mcap.chunks import Stream
from trainlog.mcap.fill import Records
from trainlog.mcap.samples import Codec
from trainlog.mcap.streams import codec_for
from trainlog.topics import Topic

_HEAD = 2
"""Words of a row before its values: time and number."""


@dataclass
class Form:
    """The samples of one topic that give the same fields in the same order.

    Attributes
    ----------
    table : Table
    pack : callable
        From time, number and values to the bytes of a row; struct.error if they are not numbers.
    axles : tuple of int
        For each value 0, or how many numbers it is for a field with one for each axle.
    rows : bytearray
        The samples that wait.
    """

    table: Table
    names: tuple[str, ...]
    axles: tuple[int, ...]
    rows: bytearray = field(default_factory=bytearray)

    def __post_init__(self) -> None:
        self.width = sum(count or 1 for count in self.axles)
        self.pack = struct.Struct(f"<qq{self.width}d").pack
        self.flat = not any(self.axles)

    def row(self, time: int, values: Mapping[str, Any]) -> bytes:
        """The row of one sample; struct.error, TypeError or ValueError if it is not one."""
        numbers: list[Any] = []
        for count, value in zip(self.axles, values.values(), strict=True):
            if not count:
                numbers.append(value)
            elif len(value) == count:
                numbers.extend(value)
            else:
                raise ValueError(count)
        return self.pack(time, self.table.count, *numbers)

    def block(self, time: Any, values: Mapping[str, Any]) -> bytes:
        """The rows of a block of samples, or of one whose time is no whole number.

        Raises
        ------
        LogError
            If they do not fit the topic.
        """
        times = nanoseconds(self.table.topic.name, time)
        rows = np.empty((times.size, _HEAD + self.width))
        rows[:, :_HEAD].view(np.int64)[:, 0] = times
        rows[:, :_HEAD].view(np.int64)[:, 1] = self.table.count + np.arange(times.size)
        at = _HEAD
        for (name, value), count in zip(values.items(), self.axles, strict=True):
            shape = times.shape + ((count,) if count else ())
            try:
                numbers = np.asarray(value, dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise self.table.refusal(f"{name} holds something that is not a number") from error
            if numbers.shape != shape:
                raise self.table.refusal(
                    f"{name} has the shape {numbers.shape}, where the time asks for {shape}"
                )
            rows[:, at : at + (count or 1)] = numbers.reshape(times.size, count or 1)
            at += count or 1
        return rows.tobytes()

    def arrays(
        self, rows: bytearray
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Times, numbers, and a table with a row for each column of the topic, NaN if absent."""
        words = np.frombuffer(rows, dtype=np.float64).reshape(-1, _HEAD + self.width)
        head = words[:, :_HEAD].view(np.int64)
        columns = self.table.columns
        table = np.full((len(columns), len(words)), np.nan)
        at = _HEAD
        for name, count in zip(self.names, self.axles, strict=True):
            first = columns[f"{name}_1" if count else name]
            table[first : first + (count or 1)] = words[:, at : at + (count or 1)].T
            at += count or 1
        return head[:, 0].copy(), head[:, 1].copy(), table


@dataclass
class Table:
    """One topic of a recording.

    Attributes
    ----------
    topic : Topic
    channel : mcap.records.Channel
    schema : mcap.records.Schema
    codec : Codec
    axles : int
        How many numbers its fields have that have one for each axle; the first sample says it.
    columns : dict of str to int
        Row of each column in the codec's tables.
    count : int
        How many samples it was given, those dropped included.
    dropped : int
        How many of them were not recorded.
    """

    topic: Topic
    channel: Channel
    schema: Schema
    codec: Codec
    axles: int
    columns: dict[str, int]
    count: int = 0
    dropped: int = 0

    def refusal(self, problem: str) -> LogError:
        """The error for a sample that does not fit."""
        return LogError(
            problem,
            place=f"sample {self.count:,} of {self.topic.name}",
            remedy="give numbers in SI units; leave out what is not known",
        )

    def stream(self, parts: list[tuple[Form, bytearray]]) -> Stream:
        """The samples taken, in the order of time, numbered as they arrived."""
        found = [form.arrays(rows) for form, rows in parts]
        time = np.concatenate([part[0] for part in found])
        number = np.concatenate([part[1] for part in found])
        table = np.concatenate([part[2] for part in found], axis=1)
        if len(found) > 1 or np.any(np.diff(time) < 0):
            order = np.lexsort((number, time))
            time, number, table = time[order], number[order], table[:, order]
        records: Records = self.codec.encode(time, table)
        sequence = (number & 0xFFFFFFFF).astype(np.uint32)
        return Stream(self.channel, self.schema, time, records, sequence)


def table_of(topic: Topic, number: int, axles: int) -> Table:
    """A topic's table; channel and schema are both called `number`."""
    counts = {each.name: axles for each in topic.fields if each.per_axle}
    codec = codec_for(topic, number, counts)
    columns = {name: row for row, name in enumerate(codec.names)}
    channel, schema = channel_of(topic, number, number, counts), schema_of(topic, number)
    return Table(topic, channel, schema, codec, axles, columns)


def form_of(table: Table, values: Mapping[str, Any]) -> Form:
    """How a topic's samples with these fields are laid down.

    Raises
    ------
    LogError
        If the topic does not have one of the fields.
    """
    if not values:
        raise table.refusal("has no values")
    per_axle = {each.name: each.per_axle for each in table.topic.fields}
    for name in values:
        if name not in per_axle:
            raise LogError(
                f"{table.topic.name} has no field {name}",
                remedy=f"its fields are {', '.join(per_axle)}",
            )
    axles = tuple(table.axles if per_axle[name] else 0 for name in values)
    return Form(table, tuple(values), axles)


def axles_in(topic: Topic, values: Mapping[str, Any]) -> int:
    """How many axles a sample tells of; 0 if it has no field with one number for each.

    Raises
    ------
    LogError
        If such a field is a single number.
    """
    for each in topic.fields:
        if each.per_axle and each.name in values:
            shape = np.shape(values[each.name])
            if not shape or not shape[-1]:
                raise LogError(
                    f"{each.name} of {topic.name} is one number",
                    remedy="give a sequence with one number for each powered axle",
                )
            return int(shape[-1])
    return 0


def nanoseconds(topic: str, time: Any) -> NDArray[np.int64]:
    """Times [ns since 1970 UTC], of shape () or (n,), from all that may stand for one.

    Parameters
    ----------
    topic : str
        For the error.
    time : int, Timestamp or datetime (naive is UTC), or an array or index of such

    Raises
    ------
    LogError
        If it is no time, or one before 1970.
    """
    found: NDArray[np.int64] | None = None
    try:
        if isinstance(time, datetime | np.datetime64):
            found = np.array(pd.Timestamp(time).as_unit("ns").value, dtype=np.int64)
        elif isinstance(time, pd.DatetimeIndex):
            found = time.as_unit("ns").asi8
        else:
            array = np.asarray(time)
            if array.dtype.kind == "M":
                found = array.astype("M8[ns]").astype(np.int64)
            elif array.dtype.kind in "iu":
                found = array.astype(np.int64)
    except (TypeError, ValueError, OverflowError) as error:
        raise _no_time(topic, time) from error
    if found is None or found.ndim > 1 or np.any(found < 0):
        raise _no_time(topic, time)
    return found


def _no_time(topic: str, time: Any) -> LogError:
    return LogError(
        f"{str(time)[:60]} of {topic} is no time, or one before 1970",
        remedy="give nanoseconds since 1970 (UTC) as whole numbers, or time stamps",
    )

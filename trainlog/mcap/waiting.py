"""Samples that a live recording was given and has not written: checked, and laid out as rows."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import LogError
from trainlog.mcap.chunks import Samples, Stream
from trainlog.mcap.codec import HIGHEST_LEVEL, channel_of, codec_for, schema_of
from trainlog.topics import Topic

INFINITE = frozenset((float("inf"), float("-inf")))

_HEAD = 2
"""Words of a row before its values: time and number."""


def checked_event(time: Any, level: int, message: str, name: str) -> tuple[int, int, str, str]:
    """Time, level, message and name of an event; LogError if it cannot be recorded."""
    if not isinstance(time, int):
        raise LogError("an event has one time", remedy="record events one by one")
    if level not in range(HIGHEST_LEVEL + 1):
        raise LogError(
            f"{level!r} is not a level of an event",
            remedy=f"give a whole number from 0 to {HIGHEST_LEVEL}",
        )
    for text in (message, name):
        try:
            text.encode()
        except (AttributeError, UnicodeEncodeError) as error:
            raise LogError(
                f"{text!r} of an event cannot be written as UTF-8", remedy="give ordinary text"
            ) from error
    return time, int(level), message, name


@dataclass
class Form:
    """The samples of one topic that give the same fields in the same order.

    Attributes
    ----------
    table : Table
    names : tuple of str
    axles : tuple of int
        For each field 0, or how many numbers it is for a field with one for each axle.
    rows : bytearray
        The samples that wait.
    pack : callable
        From time, number and values to the bytes of a row; struct.error if they are not numbers.
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
        if not INFINITE.isdisjoint(numbers):
            raise ValueError(numbers)
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
        for (name, value), at, count in zip(
            values.items(), self._places(), self.axles, strict=True
        ):
            shape = times.shape + ((count,) if count else ())
            try:
                numbers = np.asarray(value, dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise self.table.refusal(f"{name} holds something that is not a number") from error
            if np.asarray(value).dtype.kind in "US":
                raise self.table.refusal(f"{name} holds text")
            if np.any(np.isinf(numbers)):
                raise self.table.refusal(f"{name} holds an infinite number")
            if numbers.shape != shape:
                raise self.table.refusal(
                    f"{name} has the shape {numbers.shape}, where the time asks for {shape}"
                )
            rows[:, at] = numbers.reshape(times.size, count or 1)
        return rows.tobytes()

    def arrays(self, rows: bytearray) -> tuple[IntArray, IntArray, FloatArray]:
        """Times, numbers, and a table with a row for each column of the topic, NaN if absent."""
        words = np.frombuffer(rows, dtype=np.float64).reshape(-1, _HEAD + self.width)
        head = words[:, :_HEAD].view(np.int64)
        columns = self.table.codec.names
        table = np.full((len(columns), len(words)), np.nan)
        for name, at, count in zip(self.names, self._places(), self.axles, strict=True):
            first = columns.index(f"{name}_1" if count else name)
            table[first : first + (count or 1)] = words[:, at].T
        return head[:, 0].copy(), head[:, 1].copy(), table

    def _places(self) -> Iterator[slice]:
        """Where the values of each field stand in a row."""
        at = _HEAD
        for count in self.axles:
            yield slice(at, at + (count or 1))
            at += count or 1


@dataclass
class Table:
    """One topic of a recording.

    Attributes
    ----------
    topic : Topic
    number : int
        Of its channel and its schema.
    axles : int
        How many numbers its fields have that have one for each axle; the first sample decides it.
    count : int
        How many samples it was given, those dropped included.
    dropped : int
        How many of them were not recorded.
    gap : (int, int, int), optional
        First and last time [ns] and number of the samples dropped since the last flush.
    """

    topic: Topic
    number: int
    axles: int
    count: int = 0
    dropped: int = 0
    gap: tuple[int, int, int] | None = None

    def __post_init__(self) -> None:
        counts = {each.name: self.axles for each in self.topic.fields if each.per_axle}
        self.codec = codec_for(self.topic, self.number, counts)
        self.channel = channel_of(self.topic, self.number, self.number, counts)
        self.schema = schema_of(self.topic, self.number)

    def form(self, values: Mapping[str, Any]) -> Form:
        """How samples with these fields are laid down.

        Raises
        ------
        LogError
            If the topic does not have one of the fields.
        """
        if not values:
            raise self.refusal("has no values")
        per_axle = {each.name: each.per_axle for each in self.topic.fields}
        for name in values:
            if name not in per_axle:
                raise LogError(
                    f"{self.topic.name} has no field {name}",
                    remedy=f"its fields are {', '.join(per_axle)}",
                )
        axles = tuple(self.axles if per_axle[name] else 0 for name in values)
        return Form(self, tuple(values), axles)

    def refusal(self, problem: str) -> LogError:
        """The error for a sample that does not fit."""
        return LogError(
            problem,
            place=f"sample {self.count:,} of {self.topic.name}",
            remedy="give numbers in SI units; leave out what is not known",
        )

    def drop(self, time: IntArray, count: int) -> None:
        """Count samples that come when the queue is full."""
        self.dropped += count
        self.count += count
        if time.size:
            least, greatest = int(time.min()), int(time.max())
            first, last, before = self.gap or (least, greatest, 0)
            self.gap = min(first, least), max(last, greatest), before + count

    def stream(self, parts: list[tuple[Form, bytearray]]) -> Stream:
        """The samples taken, in the order of time, numbered as they arrived."""
        found = [form.arrays(rows) for form, rows in parts]
        time = np.concatenate([part[0] for part in found])
        number = np.concatenate([part[1] for part in found])
        table = np.concatenate([part[2] for part in found], axis=1)
        if len(found) > 1 or np.any(np.diff(time) < 0):
            order = np.lexsort((number, time))
            time, number, table = time[order], number[order], table[:, order]
        sequence = (number & 0xFFFFFFFF).astype(np.uint32)
        return Stream(self.channel, self.schema, time, Samples(self.codec, table), sequence)


def axles_in(topic: Topic, values: Mapping[str, Any]) -> int:
    """How many axles a sample has values for; 0 if it has no field with one number for each.

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


def nanoseconds(topic: str, time: Any) -> IntArray:
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
    found: IntArray | None = None
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

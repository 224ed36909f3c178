"""Live recording: samples as they come, into a file that outlives its program.

The caller lays samples down in memory and goes on: each is checked and packed in one step, as a row
of eight-byte words (log time, number of the sample in its topic, values). A thread takes what has
gathered once a flush period, turns the rows into arrays and writes them as chunks, each whole with
its index, so that a program killed at any moment loses what it was given since the last flush, and
nothing else.
"""

from __future__ import annotations

import atexit
import errno
import os
import struct
import threading
import time as clock
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from math import isfinite
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pandas as pd
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from trainlog.errors import InputError, LogError
from trainlog.formats.files import writing_error
from trainlog.mcap.chunks import Listed, Samples, Stream, known_topic, packed, plan_of
from trainlog.mcap.codec import HIGHEST_LEVEL, Codec, codec_for, event_record
from trainlog.mcap.errors import in_file
from trainlog.mcap.names import RECORDING_RECORD
from trainlog.mcap.schemas import channel_of, schema_of
from trainlog.mcap.writer import Sink, attachment_of, metadata_records
from trainlog.topics import EVENTS, TOPICS, Topic
from trainlog.trip import Trip
from trainlog.version import __version__

QUEUE = 2**26
"""How much may wait to be written, unless told otherwise [bytes]: seconds of a busy train."""

_WARNING = 3
"""foxglove.Log.WARNING."""

_HEAD = 2
"""Words of a row before its values: time and number."""

_UNBOUNDED = 2**62
"""A period [ns] that no chunk of a recording reaches: it is cut by its flushes."""


class OverloadWarning(UserWarning):
    """A recording was given more than it could write; the samples dropped are counted."""


@dataclass(frozen=True)
class RecordingAccount:
    """What became of the samples that a recording was given, by topic.

    Attributes
    ----------
    written : dict of str to int
        That are in the file.
    waiting : dict of str to int
        That are not yet; after a failure, that never will be.
    dropped : dict of str to int
        That were not recorded because the queue was full.
    """

    written: dict[str, int]
    waiting: dict[str, int]
    dropped: dict[str, int]


@dataclass
class _Batch:
    """What has gathered since the last flush."""

    rows: list[tuple[Form, bytearray]] = field(default_factory=list)
    events: list[tuple[int, int, str, str]] = field(default_factory=list)
    drops: dict[str, list[int]] = field(default_factory=dict)


def record(
    path: str | Path,
    *,
    metadata: dict[str, str] | None = None,
    attachments: dict[str, bytes] | None = None,
    flush: float = 1.0,
    queue: int = QUEUE,
    sync: bool = False,
) -> Recording:
    """Record live.

        with trainlog.record("today.mcap", metadata={"train": "FLIRT"}) as log:
            log.write("/train/state", time, speed=21.3, position=1204.0)

    Parameters
    ----------
    path : path
        Of a file that does not exist yet; it can be read while it is being written.
    metadata, attachments : dict, optional
        Of the trip, see `Trip`.
    flush : float
        Period [s] after which what was given is in the file: the most that is lost when the
        program is killed.
    queue : int
        How much may wait to be written [bytes]. What comes when it is full is dropped, counted and
        told, in the log too; the caller never waits.
    sync : bool
        Whether to wait at every flush until the disk has it, so that no more is lost by a power
        cut either.

    Raises
    ------
    InputError
        If the file exists or cannot be made, or `flush` or `queue` is not positive.
    LogError
        If metadata are not text.
    """
    if not (isfinite(flush) and flush > 0):
        raise InputError(f"flush is {flush}", remedy="give a period in seconds, such as 1.0")
    if queue <= 0:
        raise InputError(f"queue is {queue}", remedy="give a number of bytes, such as 2**26")
    return Recording(Path(path), metadata or {}, attachments or {}, flush, queue, sync)


class Recording:
    """A recording under way, made by `record`; closed by its ``with`` block or `close`.

    Any thread may write. Samples of a topic should come in the order of time; those that come late
    are kept nevertheless: within a flush they are sorted, and readers sort the rest. The sequence
    number of a message is the number of the sample in its topic as it arrived, those dropped
    included.
    """

    def __init__(
        self,
        path: Path,
        metadata: dict[str, str],
        attachments: dict[str, bytes],
        flush: float,
        queue: int,
        sync: bool,
    ) -> None:
        self._path, self._flush, self._limit, self._sync = path, flush, queue, sync
        self._lock = threading.Lock()
        self._due = threading.Event()
        self._closing = False
        self._failure: InputError | None = None
        self._waiting = 0
        self._tables: dict[str, Table] = {}
        self._forms: dict[tuple[str, ...], Form] = {}
        self._batch = _Batch()
        self._written: dict[str, int] = {}
        events = self._table(EVENTS.name, {})
        step = {"step": "record", "software": f"trainlog {__version__}"}
        with in_file(path):
            described = metadata_records(Trip({}, metadata, (step,), attachments))
        described[RECORDING_RECORD] = {"flush": repr(float(flush)), "sync": str(sync).lower()}
        declared = (events.schema, events.channel)
        self._file = RecordingFile(path, declared, described, attachments, sync=sync)
        self._thread = threading.Thread(target=self._run, name="trainlog.record", daemon=True)
        self._thread.start()
        atexit.register(self.close)

    def write(self, topic: str, time: Any, /, **values: Any) -> None:
        """Record one sample, or a block of samples.

        Parameters
        ----------
        topic : str
        time : int, Timestamp, or (n,) array or index of such
            Nanoseconds since 1970 UTC, or time stamps (naive is UTC).
        **values : float, or (n,) array
            By field, in SI units; for a field with one value for each axle a sequence of so many,
            or an (n, axles) array. Fields that are left out, None or NaN are absent, not zero.

        Raises
        ------
        LogError
            If it does not fit the table of topics. Nothing of it is recorded then.
        InputError
            If the file can no longer be written; the recording is at its end then.
        """
        form = self._forms.get((topic, *values)) or self._form(topic, values)
        with self._lock:
            if self._failure or self._closing:
                self._refuse()
            try:
                row = (
                    form.pack(time, form.table.count, *values.values())
                    if form.flat
                    else form.row(time, values)
                )
                if time < 0:
                    raise ValueError(time)
                count = 1
            except (struct.error, TypeError, ValueError):
                with in_file(self._path):
                    row = form.block(time, values)
                count = len(row) // (8 * (form.width + 2))
            if self._waiting >= self._limit:
                self._drop(form.table, time, count)
                return
            form.rows += row
            form.table.count += count
            self._waiting += len(row)
        if self._waiting > self._limit // 2:
            self._due.set()

    def event(self, level: int, message: str, name: str = "", *, time: Any = None) -> None:
        """Record in words what happened.

        Parameters
        ----------
        level : int
            1 debug, 2 info, 3 warning, 4 error, 5 fatal; 0 unknown.
        message, name : str
            What happened, and which part of the train or the software says so.
        time : int or Timestamp, optional
            Default: now, by the clock of this computer.

        Raises
        ------
        LogError, InputError
            As `write`.
        """
        with in_file(self._path):
            at = nanoseconds(EVENTS.name, clock.time_ns() if time is None else time)
            event = _checked_event(at.tolist(), level, message, name)
        with self._lock:
            if self._failure or self._closing:
                self._refuse()
            table = self._tables[EVENTS.name]
            if self._waiting >= self._limit:
                self._drop(table, event[0], 1)
                return
            self._batch.events.append(event)
            self._waiting += 64 + 4 * (len(message) + len(name))

    def account(self) -> RecordingAccount:
        """What became of the samples so far."""
        with self._lock:
            given = {name: table.count for name, table in self._tables.items() if table.count}
            dropped = {name: self._tables[name].dropped for name in given}
            written = {name: self._written.get(name, 0) for name in given}
        left = {name: given[name] - dropped[name] - written[name] for name in given}
        return RecordingAccount(
            written,
            {name: count for name, count in left.items() if count},
            {name: count for name, count in dropped.items() if count},
        )

    def close(self) -> None:
        """Write what waits, and end the file with its summary. A second call does nothing.

        Raises
        ------
        InputError
            If not everything could be written. What is in the file is readable then.

        Warns
        -----
        OverloadWarning
            If samples were dropped.
        """
        with self._lock:
            if self._closing:
                return
            self._closing = True
        atexit.unregister(self.close)
        self._due.set()
        self._thread.join()
        self._end()
        if self._failure:
            raise self._failure
        dropped = self.account().dropped
        if dropped:
            told = ", ".join(f"{count:,} of {name}" for name, count in dropped.items())
            message = f"{self._path}: samples were dropped because the queue was full: {told}"
            warnings.warn(OverloadWarning(message), stacklevel=2)

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except InputError as failure:
            if error is None:
                raise
            if error is not failure:
                error.add_note(str(failure))

    def _refuse(self) -> None:
        if self._failure:
            raise self._failure
        raise LogError("the recording is closed", file=self._path, remedy="begin another one")

    def _form(self, topic: str, values: Mapping[str, Any]) -> Form:
        """The form of samples with these fields, made when the first one comes."""
        with in_file(self._path):
            if known_topic(topic) is EVENTS:
                raise LogError("events are not samples", remedy="record them with event()")
            with self._lock:
                form = form_of(self._table(topic, values), values)
                return self._forms.setdefault((topic, *values), form)

    def _table(self, name: str, values: Mapping[str, Any]) -> Table:
        """The table of a topic; its first sample that tells of axles says how many there are."""
        table = self._tables.get(name)
        if table is None:
            axles = axles_in(TOPICS[name], values)
            table = table_of(TOPICS[name], len(self._tables) + 1, axles)
            self._tables[name] = table
        return table

    def _drop(self, table: Table, time: Any, count: int) -> None:
        """Count samples that come when the queue is full."""
        table.dropped += count
        table.count += count
        at = nanoseconds(table.topic.name, time)
        if at.size:
            first, last, before = self._batch.drops.get(
                table.topic.name, [int(at.min()), int(at.max()), 0]
            )
            span = [min(first, int(at.min())), max(last, int(at.max())), before + count]
            self._batch.drops[table.topic.name] = span

    def _run(self) -> None:
        """The recorder's thread: a flush a period, and one at the end."""
        due = clock.monotonic() + self._flush
        closing = False
        while not closing and self._failure is None:
            self._due.wait(max(0.0, due - clock.monotonic()))
            due = max(due + self._flush, clock.monotonic())
            with self._lock:
                self._due.clear()
                closing = self._closing
                batch = self._taken()
            try:
                for counts in self._file.put(self._streams(batch)):
                    self._count(counts)
            except MemoryError:
                self._fail(OSError(errno.ENOMEM, "out of memory"))
            except OSError as error:
                self._fail(error)

    def _taken(self) -> _Batch:
        """What has gathered; the queue is empty then."""
        batch, self._batch = self._batch, _Batch()
        for form in self._forms.values():
            if form.rows:
                batch.rows.append((form, form.rows))
                form.rows = bytearray()
        table = self._tables[EVENTS.name]
        for name, (first, last, count) in batch.drops.items():
            said = f"{count:,} samples of {name} dropped: the queue was full"
            span = f"from {np.datetime64(first, 'ns')} to {np.datetime64(last, 'ns')}"
            batch.events.append((first, _WARNING, f"{said} {span}", "trainlog.record"))
        table.count += len(batch.events)
        self._waiting = 0
        return batch

    def _streams(self, batch: _Batch) -> list[Stream]:
        """The streams of what was taken, in the order of their channels."""
        parts: dict[str, list[tuple[Form, bytearray]]] = {}
        for form, rows in batch.rows:
            parts.setdefault(form.table.topic.name, []).append((form, rows))
        streams = [form_rows[0][0].table.stream(form_rows) for form_rows in parts.values()]
        if batch.events:
            table = self._tables[EVENTS.name]
            first = table.count - len(batch.events)
            numbered = sorted(enumerate(batch.events, start=first), key=lambda each: each[1][0])
            records = [event_record(table.channel.id, *event) for _, event in numbered]
            streams.append(
                Stream(
                    table.channel,
                    table.schema,
                    np.array([event[0] for _, event in numbered], dtype=np.int64),
                    Listed(records),
                    np.array([number for number, _ in numbered], dtype=np.uint64).astype(np.uint32),
                )
            )
        return sorted(streams, key=lambda stream: stream.channel.id)

    def _count(self, counts: dict[str, int]) -> None:
        with self._lock:
            for name, count in counts.items():
                self._written[name] = self._written.get(name, 0) + count

    def _fail(self, error: OSError) -> None:
        """End the recording because the file cannot be written; what is whole in it stays."""
        found = writing_error(self._path, error)
        with self._lock:
            self._failure = found

    def _end(self) -> None:
        """Close the file; its closing metadata say what is missing."""
        account = self.account()
        closed = {"closed": "whole" if self._failure is None else self._failure.problem}
        closed |= {f"dropped.{name}": str(count) for name, count in account.dropped.items()}
        closed |= {f"lost.{name}": str(count) for name, count in account.waiting.items()}
        try:
            self._file.end(closed, failed=self._failure is not None)
        except OSError as error:
            if self._failure is None:
                self._fail(error)


def _checked_event(time: Any, level: int, message: str, name: str) -> tuple[int, int, str, str]:
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


# ---------------------------------------------------------------------- samples not yet written


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
        sequence = (number & 0xFFFFFFFF).astype(np.uint32)
        return Stream(self.channel, self.schema, time, Samples(self.codec, table), sequence)


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


# ------------------------------------------------------------------------------------- the file


class RecordingFile:
    """The file of a recording, which did not exist before.

    Parameters
    ----------
    path : Path
    declared : (mcap.records.Schema, mcap.records.Channel)
        The channel that every recording has.
    described : dict of str to dict
        Its metadata records by name.
    attachments : dict of str to bytes
    sync : bool
        Whether each flush waits until the disk has it.

    Raises
    ------
    InputError
        If the file exists or cannot be made.
    """

    def __init__(
        self,
        path: Path,
        declared: tuple[Schema, Channel],
        described: dict[str, dict[str, str]],
        attachments: dict[str, bytes],
        *,
        sync: bool,
    ) -> None:
        self._path, self._sync = path, sync
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError as error:
            remedy = "choose another name; a recording never overwrites a file"
            raise InputError("exists already", file=path, remedy=remedy) from error
        except OSError as error:
            raise writing_error(path, error) from error
        try:
            self._sink = Sink(self._file)
            self._declare(*declared)
            for name, values in described.items():
                self._sink.put_metadata(name, values)
            for name, content in sorted(attachments.items()):
                self._sink.put_attachment(attachment_of(name, content, 0))
        except OSError as error:
            self._file.close()
            path.unlink(missing_ok=True)
            raise writing_error(path, error) from error

    def _declare(self, schema: Schema, channel: Channel) -> None:
        self._sink.declare(schema)
        self._sink.declare(channel)

    def put(self, streams: list[Stream]) -> Iterator[dict[str, int]]:
        """Write streams as chunks; for each chunk that is in the file, its messages by topic.

        Raises
        ------
        OSError
            If they cannot be written, or the file is no longer at its place.
        """
        for stream in streams:
            self._declare(stream.schema, stream.channel)
        topics = {stream.channel.id: stream.channel.topic for stream in streams}
        plan = plan_of(streams, period=_UNBOUNDED)
        for number in range(len(plan)):
            chunk = packed(plan.chunk(number))
            self._sink.put_chunk(chunk)
            yield {topics[channel]: len(entries) for channel, entries in chunk.index.items()}
        if self._sync:
            os.fsync(self._file.fileno())
        here, there = os.fstat(self._file.fileno()), self._path.stat()
        if (here.st_dev, here.st_ino) != (there.st_dev, there.st_ino):
            raise FileNotFoundError(errno.ENOENT, "another file has taken its place")

    def end(self, closed: dict[str, str], *, failed: bool) -> None:
        """Close the file: with its summary if there is room for it, else behind its last chunk.

        Parameters
        ----------
        closed : dict of str to str
            What the closing metadata say.
        failed : bool
            Whether the last write failed, and may have left a part of a record.

        Raises
        ------
        OSError
            If there is no summary.
        """
        try:
            if failed:
                self._cut()
            self._sink.put_metadata(RECORDING_RECORD, closed)
            self._sink.finish()
            if self._sync:
                os.fsync(self._file.fileno())
        except OSError:
            self._cut()
            raise
        finally:
            self._file.close()

    def _cut(self) -> None:
        """Take away the part of a record that a failed write may have left."""
        self._file.truncate(self._sink.position)
        self._file.seek(self._sink.position)

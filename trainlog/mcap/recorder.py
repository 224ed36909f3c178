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
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from math import isfinite, nan
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.arrays import IntArray
from trainlog.errors import InputError, LogError, in_file
from trainlog.formats.files import writing_error
from trainlog.mcap.codec import HIGHEST_LEVEL
from trainlog.mcap.records import RECORDING_RECORD
from trainlog.mcap.writer import (
    Sink,
    declared,
    known_topic,
    laid_out,
    metadata_records,
    parts_of,
    stream_of,
)
from trainlog.topics import EVENTS, RECORDED, Topic
from trainlog.trip import Trip, frame_of
from trainlog.units import NANOSECONDS, lasted
from trainlog.version import __version__

QUEUE = 2**26
"""How much may wait to be written by default [bytes]: seconds of a busy train."""

_UNBOUNDED = 2**62
"""A period [ns] that no chunk of a recording reaches: it is cut by its flushes."""

_WARNING = 3
"""foxglove.Log.WARNING."""

_EARLY = 10**16
"""Times [ns] before it, April 1970, are most likely seconds, milli- or microseconds."""


class OverloadWarning(UserWarning):
    """A recording was given more than it could write; the samples dropped are counted.

    Examples
    --------
    >>> import warnings
    >>> import trainlog
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", trainlog.OverloadWarning)
    """


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
        reported, in the log too; the caller never waits.
    sync : bool
        Whether to wait at every flush until the disk has it, so that no more is lost by a power
        cut either.

    Raises
    ------
    InputError
        If the file exists or cannot be made, or `flush` or `queue` is not positive.
    LogError
        If metadata are not text.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.mcap import read_log
    >>> start = 1_700_000_000 * 10**9
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with record(f"{folder}/today.mcap", metadata={"train": "FLIRT"}) as log:
    ...         log.write("/train/state", start, speed=21.3, position=1204.0)
    ...         log.write("/train/state", [start + 10**8, start + 2 * 10**8], speed=[21.4, 21.5])
    ...     trip = read_log(f"{folder}/today.mcap")
    >>> trip["/train/state"]["speed"].tolist()
    [21.3, 21.4, 21.5]
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

    Examples
    --------
    >>> import tempfile
    >>> import trainlog
    >>> start = 1_700_000_000 * 10**9
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with trainlog.record(f"{folder}/today.mcap") as recording:
    ...         recording.write("/train/state", start, speed=21.3)
    ...         recording.event(2, "brakes released")
    ...         _ = recording.flush()
    ...         written = recording.account().written
    >>> written["/train/state"]
    1
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
        self._metadata, self._attachments = metadata, attachments
        self._lock = threading.Lock()
        self._round = threading.RLock()
        self._due = threading.Event()
        self._closing = False
        self._failure: InputError | None = None
        self._waiting = 0
        self._early = False
        self._declared: dict[str, Topic] = {}
        self._tables: dict[str, Table] = {}
        self._written: Counter[str] = Counter()
        self._first, self._last = _UNBOUNDED, 0
        self._notes: dict[str, str] = {}
        self._observers: list[Callable[[Trip], object]] = []
        events = self._table(EVENTS.name, {})
        stream = stream_of(EVENTS, frame_of(EVENTS, [], {}), events.number)
        step = {"step": "record", "software": f"trainlog {__version__}"}
        with in_file(path):
            described = metadata_records(Trip({}, metadata, (step,), attachments))
        described[RECORDING_RECORD] = {"flush": repr(float(flush)), "sync": str(sync).lower()}
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError as error:
            remedy = "choose another name; a recording never overwrites a file"
            raise InputError("exists already", file=path, remedy=remedy) from error
        except OSError as error:
            raise writing_error(path, error) from error
        try:
            self._sink = Sink(self._file)
            self._sink.explain((stream.schema, stream.channel), described, attachments, 0)
        except OSError as error:
            self._file.close()
            path.unlink(missing_ok=True)
            raise writing_error(path, error) from error
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
            If it does not fit the table of topics, or a value is text or infinite. Nothing of it
            is recorded then.
        InputError
            If the file can no longer be written; the recording is at its end then.

        Warns
        -----
        UserWarning
            Once, if a topic begins before April 1970, as times in seconds do.
        """
        if topic not in self._tables:
            with in_file(self._path), self._lock:
                self._table(topic, values)
        table = self._tables[topic]
        with self._lock:
            if self._failure or self._closing:
                self._refuse()
            try:
                row, count = table.row(time, values), 1
            except (struct.error, KeyError, TypeError, ValueError):
                with in_file(self._path):
                    row = table.block(time, values)
                count = len(row) // (8 * table.width)
            if self._waiting >= self._limit:
                table.drop(nanoseconds(topic, time), count)
                return
            table.rows += row
            table.count += count
            self._waiting += len(row)
            early = table.count == count and not self._early
            early = early and bool(np.min(nanoseconds(topic, time), initial=_EARLY) < _EARLY)
            self._early |= early
        if early:
            warnings.warn(
                f"{self._path}: {topic} begins at {pd.Timestamp(nanoseconds(topic, time).min())};"
                " whole numbers are nanoseconds since 1970, not seconds",
                stacklevel=2,
            )
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
            event = checked_event(at.tolist(), level, message, name)
        with self._lock:
            if self._failure or self._closing:
                self._refuse()
            table = self._tables[EVENTS.name]
            if self._waiting >= self._limit:
                table.drop(at, 1)
                return
            table.rows.append((event[0], table.count, *event[1:]))
            table.count += 1
            self._waiting += 64 + 4 * (len(message) + len(name))

    def note(self, key: str, text: str) -> None:
        """State something in the step ``"record"`` of the provenance, which ends the file.

        Raises
        ------
        LogError
            If the recording is closed.
        """
        with self._lock:
            if self._closing:
                self._refuse()
            self._notes[key] = text

    def observe(self, observer: Callable[[Trip], object]) -> None:
        """Have a function called with what has been written, after each flush.

        Parameters
        ----------
        observer : callable
            Given a trip with the samples of this flush alone, in the order of time. It is called by
            the recorder's thread and must return at once; one that raises is not called again, with
            a warning.
        """
        self._observers.append(observer)

    @property
    def path(self) -> Path:
        """Of the log."""
        return self._path

    def flush(self, timeout: float = 10.0) -> bool:
        """Have what was given written and observed now; whether it is in the file in time [s]."""
        deadline = clock.monotonic() + timeout
        while self.account().waiting and not (self._failure or self._closing):
            self._due.set()
            if clock.monotonic() > deadline:
                return False
            clock.sleep(0.005)
        # What is in the file is given to the observers in the same round.
        if self._round.acquire(timeout=max(deadline - clock.monotonic(), 0.0)):
            self._round.release()
        return not self.account().waiting

    def account(self) -> RecordingAccount:
        """What became of the samples so far."""
        with self._lock:
            given = {name: table.count for name, table in self._tables.items() if table.count}
            dropped = {name: self._tables[name].dropped for name in given}
            written = {name: self._written[name] for name in given}
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
            counts = ", ".join(f"{count:,} of {name}" for name, count in dropped.items())
            message = f"{self._path}: samples were dropped because the queue was full: {counts}"
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

    def declare(self, topic: Topic) -> None:
        """Take samples of a topic of the recorder's own; before its first sample.

        Parameters
        ----------
        topic : Topic
            Made by `trainlog.recorded_topic`.

        Raises
        ------
        LogError
            If it has been declared with other fields.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> import trainlog
        >>> from trainlog.topics import Field
        >>> oil = trainlog.recorded_topic("/recorded/oil", [Field("pressure", "Pa", "of the oil")])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "trip.mcap"
        ...     with trainlog.record(path) as recording:
        ...         recording.declare(oil)
        ...         recording.write("/recorded/oil", 1_700_000_000_000_000_000, pressure=3.2e5)
        ...     trip = trainlog.read(path)
        >>> trip["/recorded/oil"]["pressure"].tolist()
        [320000.0]
        """
        with in_file(self._path), self._lock:
            if topic.name in self._tables or self._declared.get(topic.name, topic) != topic:
                raise LogError(f"{topic.name} is in use already", remedy="declare it once, first")
            self._declared[topic.name] = topic

    def _table(self, name: str, values: Mapping[str, Any]) -> Table:
        """The table of a topic; its first sample decides how many axles there are.

        Raises
        ------
        LogError
            If there is no such topic, of the table or declared.
        """
        if name not in self._tables:
            if name.startswith(RECORDED) and name not in self._declared:
                remedy = "declare its fields with recording.declare(trainlog.recorded_topic(...))"
                raise LogError(f"{name} has not been declared", remedy=remedy)
            topic = self._declared.get(name) or known_topic(name)
            self._tables[name] = Table(topic, len(self._tables) + 1, axles_in(topic, values))
        return self._tables[name]

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
                taken = self._taken()
            try:
                frames = {table.topic.name: table.frame(rows) for table, rows in taken}
                with self._round:
                    self._put(frames)
                    if self._observers and frames:
                        self._show({name: frame for name, (frame, _) in frames.items()})
            except MemoryError:
                self._fail(OSError(errno.ENOMEM, "out of memory"))
            except OSError as error:
                self._fail(error)

    def _put(self, frames: _Frames) -> None:
        """Write frames as chunks; an OSError if the file is no longer at its place, too."""
        tables = {name: self._tables[name] for name in frames}
        streams = [
            replace(stream_of(table.topic, frames[name][0], table.number), sequence=frames[name][1])
            for name, table in sorted(tables.items(), key=lambda each: each[1].number)
        ]
        self._sink.declare(*declared(streams))
        topics = {stream.channel.id: stream.channel.topic for stream in streams}
        for parts in parts_of(streams, period=_UNBOUNDED):
            chunk, index, positions = laid_out(parts)
            self._sink.put_chunk(chunk, index, positions)
            with self._lock:
                self._written.update({topics[each]: len(rows) for each, rows in index.items()})
            for stream, rows, _ in parts:
                if stream.channel.topic != EVENTS.name:
                    self._first = min(self._first, int(stream.time[rows.start]))
                    self._last = max(self._last, int(stream.time[rows.stop - 1]))
        if self._sync:
            os.fsync(self._file.fileno())
        here, there = os.fstat(self._file.fileno()), self._path.stat()
        if (here.st_dev, here.st_ino) != (there.st_dev, there.st_ino):
            raise FileNotFoundError(errno.ENOENT, "another file has taken its place")

    def _taken(self) -> list[tuple[Table, Any]]:
        """The samples and events that have gathered, by topic; the queue is empty then."""
        events = self._tables[EVENTS.name]
        for name, table in self._tables.items():
            if table.gap is not None:
                first, last, count = table.gap
                span = f"from {np.datetime64(first, 'ns')} to {np.datetime64(last, 'ns')}"
                problem = f"{count:,} samples of {name} dropped: the queue was full {span}"
                events.rows.append((first, events.count, _WARNING, problem, "trainlog.record"))
                events.count += 1
                table.gap = None
        taken = [(table, table.rows) for table in self._tables.values() if table.rows]
        for table, rows in taken:
            table.rows = type(rows)()
        self._waiting = 0
        return taken

    def _show(self, topics: dict[str, pd.DataFrame]) -> None:
        """Give the observers what was written."""
        piece = Trip(topics, self._metadata, (), self._attachments)
        for observer in tuple(self._observers):
            try:
                observer(piece)
            except Exception as error:  # noqa: BLE001 - whatever a user's function raises
                self._observers.remove(observer)
                warnings.warn(f"{observer!r} failed and is not called again: {error}", stacklevel=1)

    def _fail(self, error: OSError) -> None:
        """End the recording because the file cannot be written; what is whole in it stays."""
        found = writing_error(self._path, error)
        if self._last and error.errno != errno.ENOENT:
            kept = lasted((self._last - self._first) / NANOSECONDS)
            problem = f"{found.problem}; the log up to there is whole: {kept}"
            found = InputError(problem, file=found.file, remedy=found.remedy)
        with self._lock:
            self._failure = found

    def _end(self) -> None:
        """Close the file: with a summary if there is space for it, else behind its last chunk.

        Its closing metadata say what is missing.
        """
        account = self.account()
        closed = dict(self._notes)
        closed |= {"closed": "whole" if self._failure is None else self._failure.problem}
        closed |= {f"dropped.{name}": str(count) for name, count in account.dropped.items()}
        closed |= {f"lost.{name}": str(count) for name, count in account.waiting.items()}
        try:
            if self._failure is not None:
                self._cut()
            self._sink.put_metadata(RECORDING_RECORD, closed)
            self._sink.finish()
            if self._sync:
                os.fsync(self._file.fileno())
        except OSError as error:
            self._cut()
            if self._failure is None:
                self._fail(error)
        finally:
            self._file.close()

    def _cut(self) -> None:
        """Take away the part of a record that a failed write may have left."""
        self._file.truncate(self._sink.position)
        self._file.seek(self._sink.position)


_Frames = dict[str, tuple[pd.DataFrame, NDArray[np.uint32]]]
"""Frames by topic, and the sequence number of each row."""

_HEAD = 2
"""Words of a row before its values: time and number."""

_INFINITE = frozenset((float("inf"), float("-inf")))


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
class Table:
    """One topic of a recording.

    Attributes
    ----------
    topic : Topic
    number : int
        Of its channel and its schema.
    axles : int
        How many numbers its fields have that have one for each axle; the first sample decides it.
    rows : bytearray, or list of (time, number, level, message, name)
        The samples, or the events, that wait.
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
    rows: Any = field(default_factory=bytearray)
    count: int = 0
    dropped: int = 0
    gap: tuple[int, int, int] | None = None

    def __post_init__(self) -> None:
        # Where the values of each field stand in a row: one, or one for each axle.
        self.places: dict[str, int | slice] = {}
        self.rows = [] if self.topic is EVENTS else self.rows
        self.names: list[str] = []
        for each in self.topic.fields if self.topic is not EVENTS else ():
            begin = _HEAD + len(self.names)
            count = self.axles if each.per_axle else 1
            self.places[each.name] = slice(begin, begin + count) if each.per_axle else begin
            axles = [f"{each.name}_{axle + 1}" for axle in range(count)]
            self.names += axles if each.per_axle else [each.name]
        self.width = _HEAD + len(self.names)
        self.absent = [nan] * (self.width - _HEAD)
        self.pack = struct.Struct(f"<qq{len(self.absent)}d").pack

    def row(self, time: int, values: Mapping[str, Any]) -> bytes:
        """The row of one sample; struct.error, KeyError, TypeError or ValueError if it is none."""
        numbers: list[Any] = [time, self.count, *self.absent]
        for name, value in values.items():
            place = self.places[name]
            if isinstance(place, slice) and len(value) != self.axles:
                raise ValueError(name)
            numbers[place] = value
        if not values or time < 0 or not _INFINITE.isdisjoint(numbers):
            raise ValueError(values)
        return self.pack(*numbers)

    def block(self, time: Any, values: Mapping[str, Any]) -> bytes:
        """The rows of a block of samples, or of one whose time is no whole number.

        Raises
        ------
        LogError
            If they do not fit the topic.
        """
        if self.topic is EVENTS:
            raise LogError("events are not samples", remedy="record them with event()")
        if not values:
            raise self.refusal("has no values")
        times = nanoseconds(self.topic.name, time)
        rows = np.full((times.size, self.width), np.nan)
        rows[:, :_HEAD].view(np.int64)[:, 0] = times
        rows[:, :_HEAD].view(np.int64)[:, 1] = self.count + np.arange(times.size)
        for name, value in values.items():
            if name not in self.places:
                raise LogError(
                    f"{self.topic.name} has no field {name}",
                    remedy=f"its fields are {', '.join(self.places)}",
                )
            place = self.places[name]
            shape = times.shape + ((self.axles,) if isinstance(place, slice) else ())
            try:
                numbers = np.asarray(value, dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise self.refusal(f"{name} holds something that is not a number") from error
            if np.asarray(value).dtype.kind in "US":
                raise self.refusal(f"{name} holds text")
            if np.any(np.isinf(numbers)):
                first = np.argwhere(np.isinf(np.atleast_1d(numbers)))[0][0] if times.ndim else 0
                raise self.refusal(f"{name} holds an infinite number", int(first))
            if numbers.shape != shape:
                raise self.refusal(
                    f"{name} has the shape {numbers.shape}, where the time asks for {shape}"
                )
            rows[:, place] = numbers.reshape(times.size, *shape[times.ndim :])
        return rows.tobytes()

    def refusal(self, problem: str, number: int = 0) -> LogError:
        """The error for a sample that does not fit, by its number in its block."""
        return LogError(
            problem,
            place=f"sample {self.count + number:,} of {self.topic.name}",
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

    def frame(self, rows: Any) -> tuple[pd.DataFrame, NDArray[np.uint32]]:
        """What was taken, in the order of time, with its numbers as it arrived."""
        if self.topic is EVENTS:
            time, number, *texts = zip(*sorted(rows, key=itemgetter(0)), strict=True)
            texts_by: dict[str, Any] = dict(zip(("level", "message", "name"), texts, strict=True))
            return frame_of(EVENTS, time, texts_by), np.array(number).astype(np.uint32)
        words = np.frombuffer(rows, dtype=np.float64).reshape(-1, self.width)
        words = words[np.argsort(words[:, :1].view(np.int64)[:, 0], kind="stable")]
        time, number = words[:, :_HEAD].view(np.int64).T
        columns = dict(zip(self.names, words[:, _HEAD:].T, strict=True))
        return frame_of(self.topic, time, columns), (number & 0xFFFFFFFF).astype(np.uint32)


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
        f"{str(time)[:60]} of {topic} is not a time, or one before 1970",
        remedy="give nanoseconds since 1970 (UTC) as whole numbers, or time stamps",
    )

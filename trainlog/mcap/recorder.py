"""Live recording: samples as they come, into a file that outlives its program.

The caller lays samples down in memory and goes on. A thread takes what has gathered once a flush
period and writes it as chunks, each whole with its index, so that a program killed at any moment
loses what it was given since the last flush, and nothing else.
"""

from __future__ import annotations

import atexit
import errno
import struct
import threading
import time as clock
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from trainlog.errors import InputError, LogError
from trainlog.formats.files import writing_error
from trainlog.mcap.chunks import Stream, plan_of
from trainlog.mcap.errors import in_file
from trainlog.mcap.events import HIGHEST_LEVEL, event_record
from trainlog.mcap.facts import metadata_records
from trainlog.mcap.fill import ListedRecords
from trainlog.mcap.intake import Form, Table, axles_in, form_of, nanoseconds, table_of
from trainlog.mcap.names import RECORDING_RECORD
from trainlog.mcap.recording_file import RecordingFile
from trainlog.mcap.sink import packed
from trainlog.mcap.streams import known_topic
from trainlog.topics import EVENTS, TOPICS
from trainlog.trip import Trip
from trainlog.version import __version__

QUEUE = 2**26
"""How much may wait to be written, unless told otherwise [bytes]: seconds of a busy train."""

_WARNING = 3
"""foxglove.Log.WARNING."""


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
        warm_up()
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
                    ListedRecords(records),
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


def warm_up() -> None:
    """Have the compiled loops ready before the first flush needs them."""
    table = table_of(TOPICS["/train/state"], 1, 0)
    form = form_of(table, {"speed": 0.0})
    row = bytearray(form.block(0, {"speed": 0.0}))
    packed(plan_of([table.stream([(form, row)])]).chunk(0))

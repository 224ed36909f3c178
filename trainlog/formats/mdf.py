"""A trip as a measurement file of ASAM MDF 4, written and read with asammdf (extra ``recorders``).

Each topic is a channel group that is named after it, with a clock of its own; channels have the
units of the table of topics. What a measurement file has no place for (provenance, and which group
is which topic) is in its attachment `INDEX`.
"""

from __future__ import annotations

import gc
import json
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pandas as pd

from trainlog.errors import InputError, LogError
from trainlog.extras import load
from trainlog.formats.files import atomic_write
from trainlog.topics import RECORDED, TOPICS, column_field, topic_of_frame
from trainlog.trip import Trip
from trainlog.units import NANOSECONDS

INDEX = "trainlog.json"
"""Attachment that makes a measurement file a trip."""

FORMAT, VERSION = "trainlog/trip-mdf", 1

LONGEST = 2**53
"""Time [ns] since the start, 104 days, up to which the file's seconds give every nanosecond."""


class MdfWriter:
    """A measurement file written piece by piece; whole or not at all, as `LogWriter`.

    Samples go to asammdf's temporary file, words (events) are held until the end.

    Parameters
    ----------
    path : path
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._place = atomic_write(path)
        self._trip: Trip | None = None
        self._start = 0
        self._groups: dict[str, int] = {}
        self._words: dict[str, list[pd.DataFrame]] = {}
        self._frames: dict[str, pd.DataFrame] = {}

    def __enter__(self) -> MdfWriter:
        library = load("asammdf")
        self._library = library
        self._temporary = self._place.__enter__()
        self._mdf = library.MDF(version="4.10")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._finish()
        except BaseException as failure:
            self._mdf.close()
            self._place.__exit__(type(failure), failure, failure.__traceback__)
            raise
        self._mdf.close()
        self._place.__exit__(kind, error, trace)

    def add(self, piece: Trip) -> None:
        """Append the rows of a piece.

        Raises
        ------
        LogError
            If a topic changes its columns, or the trip is longer than 104 days.
        """
        if self._trip is None:
            starts = [frame.index[0] for frame in piece.topics.values() if len(frame)]
            first = min(starts) if starts else pd.Timestamp(0, tz="UTC")
            self._start = int(first.floor("s").as_unit("ns").value)
            self._trip = piece
        self._trip = Trip({}, self._trip.metadata, piece.provenance, self._trip.attachments)
        for topic, frame in piece.topics.items():
            known = self._frames.setdefault(topic, frame.iloc[:0])
            if list(known.columns) != list(frame.columns):
                raise LogError(f"{topic} changes its columns on the way", file=self._path)
            if not len(frame):
                continue
            if any(frame[name].dtype.kind not in "fiub" for name in frame.columns):
                self._words.setdefault(topic, []).append(frame)
                continue
            self._append(topic, frame)

    def _append(self, topic: str, frame: pd.DataFrame) -> None:
        """Write rows behind those of the topic that are in the file."""
        seconds = self._seconds(topic, frame)
        columns = [_samples(frame[name]) for name in frame.columns]
        if topic in self._groups:
            parts = [(seconds, None), *((column, None) for column in columns)]
            self._mdf.extend(self._groups[topic], parts)
            return
        units, meanings = _described(topic, frame)
        signals = [
            self._library.Signal(
                samples=column,
                timestamps=seconds,
                name=str(name),
                unit=units.get(name, ""),
                comment=meanings.get(name, ""),
                **({"encoding": "utf-8"} if column.dtype.kind == "S" else {}),
            )
            for name, column in zip(frame.columns, columns, strict=True)
        ]
        group = self._mdf.append(signals, acq_name=topic, common_timebase=True)
        self._groups[topic] = int(group)

    def _seconds(self, topic: str, frame: pd.DataFrame) -> np.ndarray:
        since = pd.DatetimeIndex(frame.index).as_unit("ns").asi8 - self._start
        if since.size and (since[-1] > LONGEST or since[0] < -LONGEST):
            raise LogError(
                f"{topic} is longer than the 104 days for which MDF gives every nanosecond",
                file=self._path,
                remedy="cut it, or convert to Parquet",
            )
        return np.asarray(since / NANOSECONDS)

    def _finish(self) -> None:
        for topic, frames in self._words.items():
            joined = pd.concat(frames)
            joined.attrs = frames[0].attrs
            self._append(topic, joined)
        trip = Trip({}) if self._trip is None else self._trip
        start = pd.Timestamp(self._start, tz="UTC")
        self._mdf.header.start_time = start.to_pydatetime()
        index = {
            "format": FORMAT,
            "version": VERSION,
            "start": self._start,
            "topics": [
                {
                    "topic": topic,
                    "group": self._groups.get(topic),
                    "columns": {str(n): str(frame[n].dtype) for n in frame.columns},
                    "attrs": dict(frame.attrs),
                }
                for topic, frame in self._frames.items()
            ],
            "metadata": trip.metadata,
            "provenance": list(trip.provenance),
            "attachments": sorted(trip.attachments),
        }
        text = json.dumps(index, ensure_ascii=False, allow_nan=False).encode()
        for name, content in [*sorted(trip.attachments.items()), (INDEX, text)]:
            self._mdf.attach(content, file_name=name, compression=True, embedded=True)
        with _quiet():
            made = self._mdf.save(self._temporary, overwrite=True, compression=2)
        if Path(made) != self._temporary:
            Path(made).replace(self._temporary)


def read_mdf_trip(path: str | Path, topics: list[str] | None = None) -> Trip:
    """Read the trip of a measurement file that trainlog wrote.

    Raises
    ------
    InputError
        If the file is missing, cannot be read, or another program wrote it.
    """
    with _opened(Path(path)) as (mdf, index, attachments):
        frames = {}
        for entry in index["topics"]:
            if topics is not None and entry["topic"] not in topics:
                continue
            frames[entry["topic"]] = _frame(mdf, entry, int(index["start"]))
    wanted = {name: attachments[name] for name in index["attachments"]}
    return Trip(frames, index["metadata"], tuple(index["provenance"]), wanted)


def called(path: Path, call: Callable[[], Any]) -> Any:
    """What asammdf returns; one error for whatever it raises on a damaged file.

    Its messages, in the log and when the half-opened file is closed, are not passed on.
    """
    hook = sys.unraisablehook
    with _quiet():
        try:
            try:
                return call()
            except Exception as error:  # noqa: BLE001 - asammdf raises whatever a byte leads it to
                sys.unraisablehook = lambda _: None
                problem = f"{type(error).__name__}: {error}".splitlines()[0][:120]
            gc.collect()
        finally:
            sys.unraisablehook = hook
    raise InputError(
        f"is no measurement file that can be read ({problem})",
        file=path,
        remedy="copy or convert it again; was the recorder stopped while writing?",
    )


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, dict[str, Any], dict[str, bytes]]]:
    library = load("asammdf")
    if not path.is_file():
        raise InputError("does not exist", file=path, remedy="check the path")
    mdf = called(path, lambda: library.MDF(path))
    try:
        attachments = {
            str(each.file_name): each.extract()
            for each in mdf.attachments
        }  # fmt: skip
        if INDEX not in attachments:
            raise InputError(
                "is a measurement file of another program",
                file=path,
                remedy="'trainlog ingest' makes a trip of it, with a profile of its channels",
            )
        yield mdf, json.loads(attachments[INDEX]), attachments
    finally:
        mdf.close()


def _frame(mdf: Any, entry: dict[str, Any], start: int) -> pd.DataFrame:
    """The frame of one topic."""
    columns: dict[str, Any] = {}
    time = np.empty(0, dtype=np.int64)
    group = entry["group"]
    for name, kind in entry["columns"].items():
        if group is None:
            columns[name] = np.empty(0, dtype=object if kind in ("object", "str") else kind)
            continue
        signal = mdf.get(name, group=group)
        time = start + np.round(signal.timestamps * NANOSECONDS).astype(np.int64)
        samples = signal.samples
        if samples.dtype.kind == "S":
            columns[name] = pd.Series([each.decode("utf-8") for each in samples], dtype=kind)
        else:
            columns[name] = samples.astype(kind)
    index = pd.DatetimeIndex(time.view("M8[ns]"), tz="UTC", name="time")
    values = {name: getattr(each, "array", each) for name, each in columns.items()}
    frame = pd.DataFrame(values, index=index)
    frame.attrs = entry["attrs"]
    return frame


def _samples(column: pd.Series[Any]) -> np.ndarray:
    """The values of a column as asammdf takes them: numbers, or words in UTF-8."""
    if column.dtype.kind in "fiu":
        return column.to_numpy()
    if column.dtype.kind == "b":
        return column.to_numpy().astype(np.uint8)
    words = [str(each).encode() for each in column]
    return np.array(words, dtype=f"S{max(1, *map(len, words))}")


def _described(topic: str, frame: pd.DataFrame) -> tuple[dict[str, str], dict[str, str]]:
    known = TOPICS.get(topic)
    if topic.startswith(RECORDED):
        known = topic_of_frame({**frame.attrs, "topic": topic})
    if known is None:
        return {}, {}
    fields = {str(name): column_field(known, str(name)) for name in frame.columns}
    units = {name: each.unit for name, each in fields.items()}
    return units, {name: each.meaning for name, each in fields.items()}


@contextmanager
def _quiet() -> Iterator[None]:
    """Without asammdf's log."""
    log = logging.getLogger("asammdf")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(level)

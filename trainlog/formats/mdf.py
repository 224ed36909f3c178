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
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from trainlog.errors import InputError, LogError
from trainlog.extras import load
from trainlog.formats.files import atomic_write
from trainlog.formats.trip_tables import check_columns, described_fields, joined_head
from trainlog.trip import Trip
from trainlog.units import NANOSECONDS

INDEX = "trainlog.json"
"""Attachment that makes a measurement file a trip."""

FORMAT, VERSION = "trainlog/trip-mdf", 1

LONGEST = 2**53
"""Time [ns] since the start, 104 days, up to which the file's seconds give every nanosecond."""


@contextmanager
def mdf_writer(path: str | Path) -> Iterator[MdfWriter]:
    """Write a measurement file piece by piece; whole or not at all."""
    library = load("asammdf")
    with atomic_write(path) as temporary, closing(library.MDF(version="4.10")) as mdf:
        writer = MdfWriter(Path(path), mdf, library.Signal)
        yield writer
        writer.save(temporary)


class MdfWriter:
    """A measurement file being written; made by `mdf_writer`.

    Samples go to asammdf's temporary file, words (events) are held until the end.
    """

    def __init__(self, path: Path, mdf: Any, signal: Callable[..., Any]) -> None:
        self._path, self._mdf, self._signal = path, mdf, signal
        self._head: Trip | None = None
        self._start = 0
        self._groups: dict[str, int] = {}
        self._words: dict[str, list[pd.DataFrame]] = {}
        self._frames: dict[str, pd.DataFrame] = {}

    def add(self, piece: Trip) -> None:
        """Append the rows of a piece.

        Raises
        ------
        LogError
            If a topic changes its columns, or the trip is longer than 104 days.
        """
        if self._head is None:
            starts = [frame.index[0] for frame in piece.topics.values() if len(frame)]
            first = min(starts) if starts else pd.Timestamp(0, tz="UTC")
            self._start = int(first.floor("s").as_unit("ns").value)
        self._head = joined_head(self._head, piece)
        for topic, frame in piece.topics.items():
            check_columns(topic, self._frames.setdefault(topic, frame.iloc[:0]).columns, frame)
            if any(frame[name].dtype.kind not in "fiub" for name in frame.columns):
                self._words.setdefault(topic, []).append(frame)
            elif len(frame):
                self._append(topic, frame)

    def _append(self, topic: str, frame: pd.DataFrame) -> None:
        """Write rows behind those of the topic that are in the file."""
        since = pd.DatetimeIndex(frame.index).as_unit("ns").asi8 - self._start
        if since[-1] > LONGEST or since[0] < -LONGEST:
            raise LogError(
                f"{topic} is longer than the 104 days for which MDF gives every nanosecond",
                file=self._path,
                remedy="cut it, or convert to Parquet",
            )
        seconds = since / NANOSECONDS
        columns = [_samples(frame[name]) for name in frame.columns]
        if topic in self._groups:
            parts = [(seconds, None), *((column, None) for column in columns)]
            self._mdf.extend(self._groups[topic], parts)
            return
        _, fields = described_fields(topic, map(str, frame.columns), frame.attrs)
        signals = [
            self._signal(
                samples=column,
                timestamps=seconds,
                name=str(name),
                unit=fields[name].unit if name in fields else "",
                comment=fields[name].meaning if name in fields else "",
                **({"encoding": "utf-8"} if column.dtype.kind == "S" else {}),
            )
            for name, column in zip(frame.columns, columns, strict=True)
        ]
        group = self._mdf.append(signals, acq_name=topic, common_timebase=True)
        self._groups[topic] = int(group)

    def save(self, path: Path) -> None:
        """Write the words, the attachments and the index, and save the file."""
        for topic, frames in self._words.items():
            joined = pd.concat(frames)
            joined.attrs = frames[0].attrs
            if len(joined):
                self._append(topic, joined)
        head = Trip({}) if self._head is None else self._head
        self._mdf.header.start_time = pd.Timestamp(self._start, tz="UTC").to_pydatetime()
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
            "metadata": head.metadata,
            "provenance": list(head.provenance),
            "attachments": sorted(head.attachments),
        }
        text = json.dumps(index, ensure_ascii=False, allow_nan=False).encode()
        for name, content in [*sorted(head.attachments.items()), (INDEX, text)]:
            self._mdf.attach(content, file_name=name, compression=True, embedded=True)
        with _quiet():
            made = Path(self._mdf.save(path, overwrite=True, compression=2))
        if made != path:
            made.replace(path)


def read_mdf_trip(path: str | Path) -> Trip:
    """Read the trip of a measurement file that trainlog wrote.

    Raises
    ------
    InputError
        If the file is missing, cannot be read, or another program wrote it.
    """
    path = Path(path)
    library = load("asammdf")
    if not path.is_file():
        raise InputError("does not exist", file=path, remedy="check the path")
    with closing(called(path, lambda: library.MDF(path))) as mdf:
        attachments = {str(each.file_name): each.extract() for each in mdf.attachments}
        if INDEX not in attachments:
            raise InputError(
                "is a measurement file of another program",
                file=path,
                remedy="'trainlog ingest' makes a trip of it, with a profile of its channels",
            )
        index = json.loads(attachments[INDEX])
        frames = {
            entry["topic"]: _frame(mdf, entry, int(index["start"])) for entry in index["topics"]
        }
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


def _frame(mdf: Any, entry: dict[str, Any], start: int) -> pd.DataFrame:
    """The frame of one topic."""
    columns: dict[str, Any] = {}
    time = np.empty(0, dtype=np.int64)
    for name, kind in entry["columns"].items():
        if entry["group"] is None:
            columns[name] = np.empty(0, dtype=object if kind in ("object", "str") else kind)
            continue
        signal = mdf.get(name, group=entry["group"])
        time = start + np.round(signal.timestamps * NANOSECONDS).astype(np.int64)
        samples = signal.samples
        if samples.dtype.kind == "S":
            columns[name] = pd.array([each.decode("utf-8") for each in samples], dtype=kind)
        else:
            columns[name] = samples.astype(kind)
    index = pd.DatetimeIndex(time.view("M8[ns]"), tz="UTC", name="time")
    frame = pd.DataFrame(columns, index=index)
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

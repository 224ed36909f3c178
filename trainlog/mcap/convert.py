"""Logs as Parquet and back, whole or in part, piece by piece."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pandas as pd

from trainlog.errors import InputError, LogError
from trainlog.formats.trip_tables import (
    CsvTripIndex,
    FolderWriter,
    MdfWriter,
    TripIndex,
    folder_writer,
    mdf_writer,
    read_mdf_trip,
    stream_parquet,
    time_span,
    trip_index,
)
from trainlog.mcap.description import LogDescription, describe
from trainlog.mcap.foreign import frames_of
from trainlog.mcap.reader import stream_log
from trainlog.mcap.records import nothing_of
from trainlog.mcap.writer import LogWriter
from trainlog.topics import RECORDED, TOPICS
from trainlog.trip import Trip

ROWS = 100_000
"""Rows that are read at a time."""

LOG, MDF = ".mcap", ".mf4"
FOLDERS = {".parquet": TripIndex, ".csv": CsvTripIndex}
"""Folders with a file for each topic, by how their names end."""


@dataclass(frozen=True)
class Converted:
    """What was written.

    Attributes
    ----------
    rows : Counter of str
        Number of rows by topic.
    left_out : list of str
        What of the source is not in the target although it was asked for, and why.
    """

    rows: Counter[str] = field(default_factory=Counter)
    left_out: list[str] = field(default_factory=list)


def convert(
    source: str | Path,
    target: str | Path,
    *,
    topics: Sequence[str] | None = None,
    time: tuple[Any, Any] | None = None,
    position: tuple[float | None, float | None] | None = None,
    progress: Callable[[int], object] | None = None,
) -> Converted:
    """Write a log, or a part of it, as a log or as Parquet.

    Logs of trainlog and folders of Parquet go through in pieces, however long they are. MCAP files
    of other programs become Parquet with the frames that `frames_of` gives, in memory as a whole.

    Parameters
    ----------
    source : path
        An ``.mcap`` file, or a folder that `write_parquet` made.
    target : path
        Ending in ``.mcap`` or ``.parquet``; written whole or not at all.
    topics : sequence of str, optional
        Default: all.
    time, position : (start, end), optional
        As in `Trip.between` and `Trip.within`.
    progress : callable, optional
        Called with the number of rows after each piece.

    Raises
    ------
    LogError
        If the source cannot be read, not one of its messages can, or nothing of it is in the part
        asked for.
    InputError
        If a file is missing or cannot be written, or the target's kind is unknown.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     target = f"{folder}/trip.parquet"
    ...     done = convert("sample_logs/nonstop.mcap", target, topics=["/gnss/fix"])
    >>> done.rows
    Counter({'/gnss/fix': 5379})
    """
    source, target = Path(source), Path(target)
    _check_target(source, target)
    done = Converted()
    pieces = _pieces(source, target, topics, time, position, done.left_out)
    with _writer(target) as writer:
        for piece in pieces:
            writer.add(piece if topics is None else piece.with_step("slice", topics=[*topics]))
            done.rows.update({name: len(frame) for name, frame in piece.topics.items()})
            if progress is not None:
                progress(done.rows.total())
        if not done.rows.total():
            if (topics, time, position) != (None, None, None):
                raise nothing_of(source)
            if done.left_out:
                raise LogError(
                    f"holds no message that can be read: {done.left_out[0]}",
                    file=source,
                    remedy=f"see 'trainlog show {source}' for what it holds",
                )
    return done


def span_of(source: str | Path) -> tuple[pd.Timestamp, pd.Timestamp] | None:
    """Times of the first and the last row of a log or a folder; None if it has no rows.

    Examples
    --------
    >>> first, last = span_of("sample_logs/nonstop.mcap")
    >>> first < last
    True
    """
    if Path(source).is_dir():
        return time_span(source)
    if Path(source).suffix == MDF:
        trip = read_mdf_trip(source)
        return (trip.start, trip.end) if any(map(len, trip.topics.values())) else None
    found = describe(source)
    return None if found.first is None or found.last is None else (found.first, found.last)


def _check_target(source: Path, target: Path) -> None:
    if target.suffix not in (LOG, MDF, *FOLDERS):
        raise InputError(
            "is not the name of a log, a measurement file, or a folder of Parquet or CSV files",
            file=target,
            remedy=f"end it in {LOG}, {MDF}, {' or '.join(FOLDERS)}",
        )
    if target.exists() and source.exists() and target.samefile(source):
        raise InputError("would be overwritten", file=source, remedy="choose another name")


def _writer(target: Path) -> AbstractContextManager[LogWriter | FolderWriter | MdfWriter]:
    if target.suffix == LOG:
        return LogWriter(target)
    if target.suffix == MDF:
        return mdf_writer(target)
    return folder_writer(target, FOLDERS[target.suffix])


def _pieces(
    source: Path,
    target: Path,
    topics: Sequence[str] | None,
    time: tuple[Any, Any] | None,
    position: tuple[float | None, float | None] | None,
    left_out: list[str],
) -> Iterator[Trip]:
    """The source in pieces; what it does not give is added to `left_out`."""
    part: dict[str, Any] = {"time": time, "position": position, "rows": ROWS}
    if source.is_dir():
        _check_known([each.topic for each in trip_index(source).topics], topics, source)
        return stream_parquet(source, topics, **part)
    if source.suffix == MDF:
        trip = read_mdf_trip(source)
        _check_known([*trip], topics, source)
        if topics is not None:
            trip = replace(trip, topics={name: trip[name] for name in trip if name in topics})
        trip = trip if time is None else trip.between(*time)
        return iter([trip if position is None else trip.within(*position)])
    description = describe(source)
    held = {topic.name for topic in description.topics}
    _check_known(sorted(held), topics, source)
    others = sorted(name for name in held - TOPICS.keys() if not name.startswith(RECORDED))
    if description.schema_version is None and others:
        if target.suffix == LOG:
            raise InputError(
                f"is a log of another program, with {', '.join(others[:4])}",
                file=source,
                remedy="'trainlog ingest' makes a trip of it, or name a .parquet folder",
            )
        return iter([_foreign(source, description, topics, time, position, left_out)])
    left_out += [f"{name}: no topic of trainlog" for name in others if name in (topics or others)]
    ours = None if topics is None else [name for name in topics if name not in others]
    return stream_log(source, ours, **part)


def _check_known(held: Sequence[str], topics: Sequence[str] | None, source: Path) -> None:
    for name in topics or ():
        if name not in held:
            raise LogError(
                f"holds no topic {name}", file=source, remedy=f"it holds {', '.join(held)}"
            )


def _foreign(
    source: Path,
    description: LogDescription,
    topics: Sequence[str] | None,
    time: tuple[Any, Any] | None,
    position: tuple[float | None, float | None] | None,
    left_out: list[str],
) -> Trip:
    """The frames of another program's file, with its times of publishing where they differ."""
    if position is not None:
        raise InputError(
            "is a log of another program: where the train was is not known",
            file=source,
            remedy="'trainlog ingest' makes a trip of it; or choose by time",
        )
    found = frames_of(source, topics)
    left_out += [str(each) for each in found.skipped if each.messages]
    if not found.account.whole:
        left_out.append("; ".join(found.account.lines()))
    left_out += [f"attachment {each.name}: not carried over" for each in description.attachments]
    frames = {}
    for name, frame in found.frames.items():
        # The index is the column "time" of the file.
        frames[name] = frame.rename(columns={"time": "message.time"})
        if not found.publish_times[name].equals(frame.index):
            frames[name] = frames[name].assign(publish_time=found.publish_times[name])
        frames[name].attrs = frame.attrs
    trip = Trip(frames, description.metadata)
    return trip if time is None else trip.between(*time)

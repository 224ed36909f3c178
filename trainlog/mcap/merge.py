"""Logs of one trip as one log: parts that follow each other, or what several recorders wrote."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pandas as pd

from trainlog.errors import InputError, LogError
from trainlog.formats.files import sha256_of
from trainlog.mcap.description import LogDescription, describe
from trainlog.mcap.reader import read_log
from trainlog.mcap.writer import LogWriter
from trainlog.topics import EVENTS, RECORDED, TOPICS
from trainlog.trip import Trip
from trainlog.version import __version__

ROWS = 200_000
"""Rows that are held at a time, about."""

ONE = ("train", "line", "direction")
"""Metadata that logs of one trip agree on."""

STATED = ("load", "load_std", "weather", "configuration")
"""Metadata that are left out where logs disagree."""


@dataclass(frozen=True)
class Merged:
    """What became of the rows of the logs that were merged.

    Attributes
    ----------
    rows : Counter of str
        Written, by topic.
    repeated : Counter of str
        Rows that another log holds as well, by topic: written once.
    left_out : Counter of str
        Rows of other logs than the preferred one where both hold a topic, by topic.
    notes : list of str
        What else the logs do not agree on, a sentence each.
    """

    rows: Counter[str] = field(default_factory=Counter)
    repeated: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


def merge(
    sources: Sequence[str | Path],
    target: str | Path,
    *,
    prefer: str | Path | None = None,
    progress: Callable[[int], object] | None = None,
) -> Merged:
    """Write logs of one trip as one log, in the order of time; whole or not at all.

    A topic may be in several logs where their times do not overlap (parts of a trip), or where the
    samples are the same. Events of all are kept. The metadata are those of the first log; its
    provenance goes on with a step ``"merge"`` that holds metadata and provenance of all others, and
    the SHA-256 of every log.

    Parameters
    ----------
    sources : sequence of path
        Two logs at least, as `trainlog.write` or `trainlog.record` makes them.
    target : path
        Ends in ``.mcap``.
    prefer : path, optional
        One of the logs: where it holds a topic at the same time as another, it alone counts.
    progress : callable, optional
        Called with the number of rows so far.

    Raises
    ------
    LogError
        If a log cannot be read, the logs are of different trains, lines or directions, or hold
        different samples of a topic at the same time.
    InputError
        If there are not two logs, or a file is missing or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.mcap.convert import convert
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     parts = [f"{folder}/{name}.mcap" for name in ("first", "second", "whole")]
    ...     for part, time in zip(parts, [(None, "2024-10-07T06:10"), ("2024-10-07T06:10", None)]):
    ...         done = convert("sample_logs/nonstop.mcap", part, time=time)
    ...     merged = merge(parts[:2], parts[2])
    ...     same = read_log(parts[2]) == read_log("sample_logs/nonstop.mcap")
    >>> same, merged.repeated["/train/state"]
    (True, 1)
    """
    paths = [Path(source) for source in sources]
    _check(paths, Path(target), prefer)
    done = Merged()
    descriptions = [describe(path) for path in paths]
    for description in descriptions:
        _check_ours(description)
    about = _joined([read_log(path, []) for path in paths], paths, done.notes)
    first = [] if prefer is None else [Path(prefer)]
    order = [*first, *(path for path in paths if path not in first)]
    spans = {
        path: _spans(description) for path, description in zip(paths, descriptions, strict=True)
    }
    with LogWriter(target) as writer:
        for start, end in _windows(descriptions):
            pieces = {path: read_log(path, time=(start, end)) for path in order}
            frames = _frames(pieces, spans, prefer is not None, done)
            writer.add(replace(about, topics=frames))
            done.rows.update({name: len(frame) for name, frame in frames.items()})
            if progress is not None:
                progress(done.rows.total())
    return done


def _check(paths: list[Path], target: Path, prefer: str | Path | None) -> None:
    if len(paths) < 2:
        raise InputError("one log cannot be merged", remedy="name two logs at least")
    if target.suffix != ".mcap":
        raise InputError("is not the name of a log", file=target, remedy="end it in .mcap")
    for number, path in enumerate(paths):
        if path in paths[:number]:
            raise InputError("is given twice", file=path, remedy="name each log once")
        if target.exists() and path.exists() and target.samefile(path):
            raise InputError("would be overwritten", file=path, remedy="choose another name")
    if prefer is not None and Path(prefer) not in paths:
        raise InputError(f"'{prefer}' is none of the logs", remedy="prefer one of those named")


def _check_ours(description: LogDescription) -> None:
    held = {topic.name for topic in description.topics}
    others = sorted(n for n in held - TOPICS.keys() if not n.startswith(RECORDED))
    if description.schema_version is None or others:
        named = f", with {', '.join(others[:4])}" if others else ""
        raise LogError(
            f"is a log of another program{named}",
            file=description.path,
            remedy="'trainlog ingest' makes a trip of it",
        )


def _joined(trips: list[Trip], paths: list[Path], notes: list[str]) -> Trip:
    """Metadata, provenance and attachments of the merged log."""
    metadata = dict(trips[0].metadata)
    for path, trip in zip(paths[1:], trips[1:], strict=True):
        for key in ONE:
            ours, theirs = metadata.get(key), trip.metadata.get(key)
            if ours is not None and theirs is not None and ours != theirs:
                raise LogError(
                    f"states {key} '{theirs}', {paths[0]} states '{ours}'",
                    file=path,
                    remedy="merge logs of one trip",
                )
        for key, value in trip.metadata.items():
            metadata.setdefault(key, value)
    for key in STATED:
        values = {trip.metadata[key] for trip in trips if key in trip.metadata}
        if len(values) > 1:
            del metadata[key]
            notes.append(f"{key} is left out, the logs state {' and '.join(sorted(values))}")
    attachments: dict[str, bytes] = {}
    for path, trip in zip(paths, trips, strict=True):
        for name, content in trip.attachments.items():
            if attachments.setdefault(name, content) != content:
                attachments[f"{path.stem}/{name}"] = content
                notes.append(f"attachment {name} of {path} differs: kept as {path.stem}/{name}")
    step: dict[str, Any] = {
        "software": f"trainlog {__version__}",
        "inputs": {str(number): sha256_of(path) for number, path in enumerate(paths, start=1)},
        "others": [
            {"file": path.name, "metadata": trip.metadata, "provenance": [*trip.provenance]}
            for path, trip in zip(paths[1:], trips[1:], strict=True)
        ],
    }
    return Trip({}, metadata, trips[0].provenance, attachments).with_step("merge", **step)


def _windows(descriptions: Sequence[LogDescription]) -> Iterator[tuple[pd.Timestamp, pd.Timestamp]]:
    """Spans of time, both ends included, with about `ROWS` rows each."""
    known = [each for each in descriptions if each.first is not None and each.last is not None]
    if not known:
        now = pd.Timestamp(0, tz="UTC")
        yield now, now
        return
    first = min(each.first for each in known if each.first is not None).as_unit("ns").value
    last = max(each.last for each in known if each.last is not None).as_unit("ns").value
    rate = sum(
        each.count / max((each.last - each.first).total_seconds(), 1.0)
        for each in known
        if each.first is not None and each.last is not None
    )
    length = max(int(ROWS / max(rate, 1e-3) * 1e9), 1)
    for start in range(first, last + 1, length):
        end = min(start + length - 1, last)
        yield pd.Timestamp(start, tz="UTC"), pd.Timestamp(end, tz="UTC")


_Spans = dict[str, tuple[pd.Timestamp, pd.Timestamp]]


def _spans(description: LogDescription) -> _Spans:
    """Times of the first and the last sample of each topic that has any."""
    return {
        topic.name: (topic.first, topic.last)
        for topic in description.topics
        if topic.first is not None and topic.last is not None
    }


def _frames(
    pieces: dict[Path, Trip], spans: dict[Path, _Spans], preferring: bool, done: Merged
) -> dict[str, pd.DataFrame]:
    """The frames of one span of time; where logs overlap, those of the first of `pieces`."""
    names = dict.fromkeys(name for piece in pieces.values() for name in piece)
    found = {}
    for name in [*(n for n in TOPICS if n in names), *(n for n in names if n not in TOPICS)]:
        held = [(path, piece[name]) for path, piece in pieces.items() if name in piece]
        parts = [held[0]]
        for path, frame in held[1:]:
            kept = frame
            for other, before in parts:
                if name in spans[other] and name in spans[path]:
                    both = spans[other][name], spans[path][name]
                    common = max(span[0] for span in both), min(span[1] for span in both)
                    kept = _apart(name, common, (other, before), (path, kept), preferring, done)
            parts.append((path, kept))
        filled = [frame for _, frame in parts if len(frame)]
        if len(filled) < 2:
            found[name] = filled[0] if filled else held[0][1]
            continue
        joined = pd.concat(filled)
        joined = joined.iloc[joined.index.argsort(kind="stable")]
        joined.attrs = filled[0].attrs
        found[name] = joined
    return found


def _apart(
    name: str,
    common: tuple[pd.Timestamp, pd.Timestamp],
    first: tuple[Path, pd.DataFrame],
    second: tuple[Path, pd.DataFrame],
    preferring: bool,
    done: Merged,
) -> pd.DataFrame:
    """The rows of the second log without those of the time that both hold."""
    (path, before), (other, frame) = first, second
    start, end = common
    if name == EVENTS.name:
        twice = pd.MultiIndex.from_frame(frame.reset_index()).isin(
            pd.MultiIndex.from_frame(before.reset_index())
        )
        done.repeated[name] += int(twice.sum())
        return _rows(frame, ~twice)
    theirs = (frame.index >= start) & (frame.index <= end)
    ours = (before.index >= start) & (before.index <= end)
    if not theirs.any():
        return frame
    if before[ours].equals(frame[theirs]):
        done.repeated[name] += int(theirs.sum())
    elif preferring:
        done.left_out[name] += int(theirs.sum())
    else:
        raise LogError(
            f"holds other samples of {name} than {path} from {start:%Y-%m-%dT%H:%M:%S} to"
            f" {end:%H:%M:%S}",
            file=other,
            remedy=f"prefer one of the logs, as --prefer {path}, or cut the topic or the time out"
            " of one with 'trainlog convert'",
        )
    return _rows(frame, ~theirs)


def _rows(frame: pd.DataFrame, kept: Any) -> pd.DataFrame:
    rows: pd.DataFrame = frame[kept]
    rows.attrs = frame.attrs
    return rows

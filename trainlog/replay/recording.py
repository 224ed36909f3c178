"""Trips as one Rerun recording, with the layout that shows them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import rerun as rr

from trainlog.display import few
from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.formats.railway import line_to_bytes
from trainlog.progress import track
from trainlog.railway import Line, TrackConditionMap, Trajectory
from trainlog.replay.drawing import (
    Drawing,
    chart_of,
    draw_line_of,
    draw_trajectory,
    observed,
    top_of,
)
from trainlog.replay.layout import Contents, blueprint, check_view
from trainlog.replay.samples import TRIPS
from trainlog.replay.survey import (
    Pieces,
    Survey,
    group_of,
    neighboured,
    pieces_of,
    references,
    survey,
    thinned_trips,
)
from trainlog.resampling import POSITION_SOURCES, known_rows
from trainlog.trip import LINE_ATTACHMENT, Trip
from trainlog.units import EARTH_RADIUS

_ENDING, _FOOTER = 64, b"RRF2FOOT"
"""What the last bytes of a whole .rrd file hold."""

APPLICATION = "trainlog"
"""Rerun's application id: a layout made for it fits every replay."""


MOST_WHOLE = 16
"""Of more trips a replay is an overview, with their samples thinned, unless asked for otherwise."""


@dataclass(frozen=True)
class ReplayOptions:
    """How trips are shown.

    Attributes
    ----------
    view : str or None
        Which view is shown first: overview, driving, traction, identification, map or recorder.
    reference : int or None
        Number of the trip with which the others are compared by position. Default: the trajectory
        if there is one, else the first trip of each line and direction.
    thinned : bool or None
        Only the overview, with the lowest and the highest speed of each 0.4 s. Default: of more
        than 16 trips.
    tiles : bool
        Places over the tiles of a map that the viewer asks a server for, instead of on a plan.
    line : Line or None
        The line, in its own direction, of trips that carry none.

    Examples
    --------
    >>> import trainlog
    >>> logs = ["sample_logs/nonstop.mcap", "sample_logs/stopping.mcap"]
    >>> options = trainlog.ReplayOptions(view="driving", reference=1)
    >>> trainlog.write_replay([trainlog.read(log) for log in logs], "two.rrd", options=options)
    Replay(trips=('trip-01', 'trip-03'), references=('trip-03',), thinned=False)
    """

    view: str | None = None
    reference: int | None = None
    thinned: bool | None = None
    tiles: bool = False
    line: Line | None = None


@dataclass(frozen=True)
class Replay:
    """What a replay shows.

    Attributes
    ----------
    trips : tuple of str
        Names of the trips, each once.
    references : tuple of str
        With what trips are compared, each line and direction apart; empty if with nothing.
    thinned : bool
        Whether samples were left out.
    """

    trips: tuple[str, ...]
    references: tuple[str, ...]
    thinned: bool


def write_replay(
    trips: Sequence[Trip | Pieces],
    path: str | Path,
    *,
    trajectory: Trajectory | None = None,
    condition_map: TrackConditionMap | None = None,
    options: ReplayOptions | None = None,
) -> Replay:
    """Write trips, and what is known of their line, as one Rerun recording with its layout.

    The same trips give the same content; Rerun's own row numbers differ from file to file.

    Parameters
    ----------
    trips : sequence of Trip or of functions
        At least one. Topics that are missing or empty are left out. A trip that is longer than
        the memory is a function that gives its pieces in the order of time, as `stream_log` does;
        it is called twice. If it takes ``topics``, as `stream_log` does, less is read of a trip
        that is thinned.
    path : path
        Ends in ``.rrd``; written whole or not at all.
    trajectory : Trajectory, optional
        What it plans is drawn where each trip is.
    condition_map : TrackConditionMap, optional
        Drawn along the line, and under each trip.
    options : ReplayOptions, optional

    Returns
    -------
    Replay
        What is shown, and compared with what.

    Raises
    ------
    InputError
        If there is no trip, the path ends otherwise or cannot be written, trajectory or map are of
        another line, or there is no such view or reference.
    LogError
        If a trip holds no samples, or its pieces cannot be read.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/nonstop.mcap")
    >>> trainlog.write_replay([trip], "nonstop.rrd")
    Replay(trips=('trip-01',), references=(), thinned=False)
    """
    asked = options or ReplayOptions()
    if Path(path).suffix != ".rrd":
        raise InputError("is not the name of a Rerun recording", file=path, remedy="end it in .rrd")
    if not trips:
        raise InputError("there is no trip to replay", file=path, remedy="name at least one log")
    if asked.view is not None:
        check_view(asked.view)
    # Whatever can be refused is refused before anything is drawn.
    sources = [pieces_of(trip) for trip in trips]
    if asked.line is not None:
        sources = [with_line(source, asked.line) for source in sources]
    thinned = len(trips) > MOST_WHOLE if asked.thinned is None else asked.thinned
    if thinned:
        read = list(track(thinned_trips(sources), "reading", "trip", total=len(sources)))
        surveys = [known for known, _ in read]
        sources = [pieces_of(trip) for _, trip in read]
    else:
        surveys = [survey(source) for source in track(sources, "reading", "trip")]
    lines = _lines(surveys, trajectory, condition_map)
    names = _distinct([each.bare.name for each in surveys])
    compared = references(surveys, names, trajectory, asked.reference)
    recording = rr.RecordingStream(
        APPLICATION,
        recording_id=content_id(surveys, trajectory, condition_map),
        send_properties=False,
    )
    chart = chart_of([each.line for each in surveys], [e.fixes for e in surveys], tiles=asked.tiles)
    with atomic_write(path) as temporary, _saved(recording, temporary, path):
        recording.send_recording_name(few(names, 1))
        recording.send_recording_start_time_nanos(surveys[0].clock.start)
        for first in lines:
            draw_line_of(recording, surveys[first], condition_map, chart)
        shown = []
        each = list(zip(sources, surveys, names, strict=True))
        groups = list(map(group_of, surveys))
        for i, (source, known, name) in enumerate(track(each, "drawing", "trip")):
            colour = TRIPS[i % len(TRIPS)]
            brief = thinned and groups.index(groups[i]) < i
            drawing = Drawing(recording, known, name, colour, chart=chart, brief=brief)
            for piece, state in neighboured(source()):
                drawing.add(piece, state)
                # What is not yet written piles up in Rerun's memory.
                recording.flush()
            reference = compared.get(group_of(known))
            if reference is not None and reference.trip != i:
                drawing.compare(reference)
            shown.append(drawing.finish(trajectory, condition_map))
        if trajectory is not None and len(trips) > 1:
            draw_trajectory(recording, trajectory, surveys[0].clock.start)
        planned = None if trajectory is None else trajectory.direction
        contents = Contents(planned, observed(condition_map), chart, top_of(condition_map))
        recording.send_blueprint(blueprint(shown, contents, asked.view))
    stated = tuple(each.name for each in compared.values())
    return Replay(tuple(names), stated, thinned)


def with_line(source: Pieces, line: Line) -> Pieces:
    """A trip with this line if it carries none.

    The pieces raise an InputError where the trip was not on the line.
    """
    attached = line_to_bytes(line)

    def pieces(**asked: Any) -> Iterator[Trip]:
        for piece in source(**asked):
            if LINE_ATTACHMENT in piece.attachments:
                yield piece
                continue
            check_on_line(piece, line)
            yield replace(piece, attachments={**piece.attachments, LINE_ATTACHMENT: attached})

    return pieces


FURTHEST = 250.0
"""Median distance of fixes to where the chainage puts them, up to which a trip is on a line [m]."""


def check_on_line(piece: Trip, line: Line) -> None:
    """Refuse a line on which a trip was not, as far as its chainage and fixes can show it.

    Raises
    ------
    InputError
    """
    remedy = "ingest its recording with --line, which finds its chainage"
    known = {source: known_rows(piece, *source) for source in POSITION_SOURCES[:2]}
    found = next((rows for rows in known.values() if rows is not None), None)
    if found is None:
        if any(len(frame) for frame in piece.topics.values()):
            raise InputError(
                f"trip '{piece.name}' has no chainage that could be along '{line.name}'",
                remedy=remedy,
            )
        return
    time, position = found
    if position.max() > line.length + FURTHEST:
        raise InputError(
            f"trip '{piece.name}' reaches {position.max() / 1e3:.3f} km, beyond the end of"
            f" '{line.name}' at {line.length / 1e3:.3f} km",
            remedy=remedy,
        )
    fixes = known_rows(piece, *POSITION_SOURCES[3])
    own = line.travelled(piece.metadata.get("direction"))
    if fixes is None or own.geometry is None:
        return
    latitude, longitude = own.geometry.at(np.interp(fixes[0], time, position))
    north = np.radians(fixes[1] - latitude)
    east = np.radians(fixes[2] - longitude) * np.cos(np.radians(latitude))
    away = EARTH_RADIUS * float(np.median(np.hypot(north, east)))
    if away > FURTHEST:
        raise InputError(
            f"trip '{piece.name}' was {away / 1e3:.1f} km away from where its chainage puts it on"
            f" '{line.name}'",
            remedy=remedy,
        )


@contextmanager
def _saved(recording: rr.RecordingStream, temporary: Path, path: str | Path) -> Iterator[None]:
    """Write a recording to `temporary`, whole; `path` is what errors call it.

    Rerun writes in a thread of its own and does not say what kept it from it.
    """
    recording.save(temporary)
    failure = None
    try:
        yield
        recording.flush()
    except RuntimeError as error:
        failure = error
    finally:
        # The index at the file's end is written when the recording lets go of it.
        recording.disconnect()
    with temporary.open("rb") as written:
        written.seek(max(0, written.seek(0, os.SEEK_END) - _ENDING))
        whole = _FOOTER in written.read()
    if not whole:
        raise InputError(
            "cannot be written to its end: is the disk full?",
            file=path,
            remedy="free some space on the disk, or choose another place, and try again",
        ) from failure
    if failure is not None:
        raise failure


def content_id(
    surveys: Iterable[Survey], trajectory: Trajectory | None, condition: TrackConditionMap | None
) -> str:
    """The recording's id: a digest of all that is drawn, so that the viewer mixes no two."""
    digest = hashlib.sha256()
    given = list(surveys)
    for each in given:
        digest.update(each.digest)
    if trajectory is not None:
        digest.update(trajectory.speeds.tobytes() + trajectory.positions.tobytes())
    for name, layer in sorted(condition.layers.items()) if condition is not None else ():
        digest.update(name.encode() + layer.log_mean.tobytes() + layer.observed.tobytes())
        digest.update(repr(layer.spots).encode())
        for each in given:
            expected = layer.expected(pd.Timestamp(each.clock.start, tz="UTC"))
            digest.update(expected.log_mean.tobytes() + expected.log_std.tobytes())
    return digest.hexdigest()[:32]


def _distinct(names: Sequence[str]) -> list[str]:
    """Names with a number behind each that came before."""
    seen: dict[str, int] = {}
    distinct = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        distinct.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return distinct


def _lines(
    surveys: Sequence[Survey],
    trajectory: Trajectory | None,
    condition: TrackConditionMap | None,
) -> list[int]:
    """Which is the first trip on each line; refuses trajectory or map of another line."""
    found: dict[str, int] = {}
    for number, each in enumerate(surveys):
        if each.line is None:
            continue
        if trajectory is not None and trajectory.line != each.line.name:
            raise InputError(
                f"the trajectory was made for line '{trajectory.line}', trip '{each.bare.name}'"
                f" ran on '{each.line.name}'",
                remedy="give that line's trajectory, or leave the trip out",
            )
        if condition is not None:
            where = f"trip '{each.bare.name}'"
            condition.check_line(each.line.name, each.line.length, what=where)
        found.setdefault(each.line.name, number)
    return list(found.values())

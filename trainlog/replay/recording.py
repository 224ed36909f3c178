"""Trips as one Rerun recording, with the layout that shows them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pandas as pd
import rerun as rr

from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.railway import TrackConditionMap, Trajectory
from trainlog.replay.condition import check_line, observed
from trainlog.replay.curves import TRIPS
from trainlog.replay.drawing import Drawing, draw_line_of, draw_trajectory
from trainlog.replay.layout import blueprint
from trainlog.replay.survey import Pieces, Survey, neighboured, pieces_of, survey
from trainlog.trip import Trip

_ENDING, _FOOTER = 64, b"RRF2FOOT"
"""What the last bytes of a whole .rrd file hold."""

APPLICATION = "trainlog"
"""Rerun's application id: a layout made for it fits every replay."""


def write_replay(
    trips: Sequence[Trip | Pieces],
    path: str | Path,
    *,
    trajectory: Trajectory | None = None,
    condition_map: TrackConditionMap | None = None,
) -> None:
    """Write trips, and what is known of their line, as one Rerun recording with its layout.

    The same trips give the same content; Rerun's own row numbers differ from file to file.

    Parameters
    ----------
    trips : sequence of Trip or of functions
        At least one. Topics that are missing or empty are left out. A trip that is longer than
        the memory is a function that gives its pieces in the order of time, as `stream_log` does;
        it is called twice.
    path : path
        Ends in ``.rrd``; written whole or not at all.
    trajectory : Trajectory, optional
        What it plans is drawn where each trip is.
    condition_map : TrackConditionMap, optional
        Drawn along the line, and under each trip.

    Raises
    ------
    InputError
        If there is no trip, the path ends otherwise or cannot be written, or trajectory or map
        are of another line.
    LogError
        If a trip holds no samples, or its pieces cannot be read.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/nonstop.mcap")
    >>> trainlog.write_replay([trip], "nonstop.rrd")
    """
    if Path(path).suffix != ".rrd":
        raise InputError("is not the name of a Rerun recording", file=path, remedy="end it in .rrd")
    if not trips:
        raise InputError("there is no trip to replay", file=path, remedy="name at least one log")
    # Whatever can be refused is refused before anything is drawn.
    sources = [pieces_of(trip) for trip in trips]
    surveys = [survey(source) for source in sources]
    lines = _lines(surveys, trajectory, condition_map)
    recording = rr.RecordingStream(
        APPLICATION,
        recording_id=content_id(surveys, trajectory, condition_map),
        send_properties=False,
    )
    names = _distinct([each.bare.name for each in surveys])
    others = f" and {len(names) - 1} more" if len(names) > 1 else ""
    with atomic_write(path) as temporary, _saved(recording, temporary, path):
        recording.send_recording_name(names[0] + others)
        recording.send_recording_start_time_nanos(surveys[0].clock.start)
        for first in lines:
            draw_line_of(recording, surveys[first], condition_map)
        shown = []
        for i, (source, known, name) in enumerate(zip(sources, surveys, names, strict=True)):
            drawing = Drawing(recording, known, name, TRIPS[i % len(TRIPS)])
            for piece, state in neighboured(source()):
                drawing.add(piece, state)
                # What is not yet written piles up in Rerun's memory.
                recording.flush()
            shown.append(drawing.finish(trajectory, condition_map))
        if trajectory is not None and len(trips) > 1:
            draw_trajectory(recording, trajectory, surveys[0].clock.start)
        planned = None if trajectory is None else trajectory.direction
        recording.send_blueprint(blueprint(shown, planned, observed(condition_map)))


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
            check_line(condition, each.line, each.bare.name)
        found.setdefault(each.line.name, number)
    return list(found.values())

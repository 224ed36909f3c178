"""Trips over each other by position: how far each is behind a reference, and how much slower.

Also how trips are thinned where there are too many to draw every sample: of each moment the rows
with the lowest and the highest speed remain.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from inspect import signature
from typing import Any

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.railway import Trajectory
from trainlog.replay.clock import Clock, Instants
from trainlog.replay.curves import Colour
from trainlog.replay.samples import Samples, changes, send_curve
from trainlog.replay.survey import GRID_STEP, Pieces, Survey, survey
from trainlog.resampling import (
    OnGrid,
    difference,
    grid_over,
    known_rows,
    planned_time_distance,
)
from trainlog.topics import ENVIRONMENT, ESTIMATED_STATE, GNSS_FIX, GNSS_MOTION, TRAIN_STATE
from trainlog.trip import LINE_ATTACHMENT, Trip
from trainlog.units import KMH, NANOSECONDS

BEHIND, SLOWER = "behind/time", "behind/speed"
"""Entities of a trip with its differences to the reference."""

OVERVIEW: dict[str, list[str]] = {
    TRAIN_STATE.name: ["position", "speed"],
    ESTIMATED_STATE.name: ["position"],
    ENVIRONMENT.name: ["speed_limit", "gradient"],
}
"""What is read of a trip that is thinned."""

SATELLITES: dict[str, list[str]] = {
    GNSS_MOTION.name: ["speed"],
    GNSS_FIX.name: ["latitude", "longitude"],
}
"""What is read besides of a trip without line, or without speed of its own."""

MOMENT = 400_000_000
"""Of each such moment [ns] two samples remain."""

RARE = 10 * NANOSECONDS
"""How often a satellite fix of a thinned trip remains [ns]."""


@dataclass(frozen=True, eq=False)
class Reference:
    """What trips are compared with.

    Attributes
    ----------
    name : str
    line, direction : str
        It is compared with the trips of this line, empty if none is known, and direction.
    along : OnGrid
    trip : int or None
        Number of the trip that it is; None for a trajectory.
    """

    name: str
    line: str
    direction: str
    along: OnGrid
    trip: int | None = None


def group_of(known: Survey) -> tuple[str, str]:
    """Line, empty if none is known, and direction: trips of one group lie over each other."""
    line = "" if known.line is None else known.line.name
    return line, known.bare.metadata.get("direction", "forward")


def references(
    surveys: Sequence[Survey],
    names: Sequence[str],
    trajectory: Trajectory | None,
    chosen: int | None,
) -> dict[tuple[str, str], Reference]:
    """What the trips of each group are compared with.

    The trip that is chosen; of other groups the trajectory, if it is theirs; else the first trip.

    Raises
    ------
    InputError
        If there is no trip of that number, or it does not know where it was.
    """
    found: dict[tuple[str, str], Reference] = {}
    if chosen is not None:
        if not 0 <= chosen < len(surveys):
            raise InputError(f"there is no trip {chosen + 1}", remedy="choose one of the trips")
        if surveys[chosen].along is None:
            raise InputError(
                f"trip '{names[chosen]}' does not know where it was",
                remedy="choose another trip as reference",
            )
    order = range(len(surveys)) if chosen is None else [chosen, *range(len(surveys))]
    for number in order:
        known = surveys[number]
        group = group_of(known)
        if group in found or known.along is None:
            continue
        theirs = trajectory is not None and (trajectory.line, trajectory.direction) == group
        if number != chosen and trajectory is not None and theirs:
            found[group] = _planned(trajectory, group)
            continue
        if sum(group_of(each) == group for each in surveys) > 1:
            found[group] = Reference(names[number], *group, known.along, number)
    return found


def _planned(trajectory: Trajectory, group: tuple[str, str]) -> Reference:
    """The trajectory in the configuration that arrives last, which trains follow."""
    row = trajectory.latest
    curve = planned_time_distance(trajectory, row)
    grid = grid_over([curve], GRID_STEP)
    speed = trajectory.speed_at(row, grid)
    along = OnGrid(grid, curve.arrival_at(grid), np.asarray(speed, dtype=np.float64))
    name = trajectory.configurations[row].name
    return Reference(f"the trajectory (configuration {name})", *group, along)


def draw_difference(
    recording: Any, root: str, name: str, colour: Colour, known: Survey, reference: Reference
) -> set[str]:
    """Draw how much later than the reference a trip is at each place, and how much faster.

    Parameters
    ----------
    recording : rerun.RecordingStream
    root, name, colour
        Path of the trip, its name and colour.
    known : Survey
    reference : Reference

    Returns
    -------
    set of str
        Entities that were drawn; none if both have no place in common.
    """
    if known.along is None:
        return set()
    own, other = _on_one_grid(known.along, reference.along)
    found = difference(own, other)
    both = np.isfinite(found.time)
    if not both.any():
        return set()
    shown = slice(int(np.flatnonzero(both)[0]), int(np.flatnonzero(both)[-1]) + 1)
    passed = np.interp(found.position[shown], own.position[both], own.time[both])
    time = known.clock.start + np.rint(passed * NANOSECONDS).astype(np.int64)
    instants = Instants(known.clock.start, time, found.position[shown])
    for entity, values in ((BEHIND, found.time), (SLOWER, KMH * found.speed)):
        points = Samples(time, values[shown, None])
        drawn = (recording, f"{root}/{entity}", instants, points)
        send_curve(*drawn, names=[name], colours=[colour])
    return {BEHIND, SLOWER}


def _on_one_grid(one: OnGrid, other: OnGrid) -> tuple[OnGrid, OnGrid]:
    """Both on the nodes that they share: each grid consists of multiples of one step."""
    first, last = (
        max(one.position[0], other.position[0]),
        min(one.position[-1], other.position[-1]),
    )

    def cut(each: OnGrid) -> OnGrid:
        inside = (each.position >= first) & (each.position <= last)
        return OnGrid(each.position[inside], each.time[inside], each.speed[inside])

    return cut(one), cut(other)


# ------------------------------------------------------------------------------------- thinning


def thinned_trips(sources: Sequence[Pieces]) -> Iterator[tuple[Survey, Trip]]:
    """Each trip's survey and what remains of its samples, in order; several are read at once.

    Only the columns `OVERVIEW` are asked for, of which each source is a function.

    Raises
    ------
    LogError
        If a trip holds no samples, or cannot be read.
    """
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        yield from pool.map(_thinned, sources)


def _thinned(source: Pieces) -> tuple[Survey, Trip]:
    pieces = list(_part(source, OVERVIEW))
    if not (LINE_ATTACHMENT in pieces[0].attachments and any(map(_knows_speed, pieces))):
        pieces = list(_part(source, OVERVIEW | SATELLITES))
    known = survey(lambda: pieces)
    parts = list(map(thinned_trip, pieces))
    topics = {
        name: _joined([part[name] for part in parts if name in part])
        for name in dict.fromkeys(name for part in parts for name in part)
    }
    trip = replace(known.bare, topics=topics)
    return replace(known, clock=_thinned_clock(known.clock), fixes=_thinned_fixes(known)), trip


def _knows_speed(piece: Trip) -> bool:
    known = [known_rows(piece, TRAIN_STATE.name, name) for name in ("position", "speed")]
    return all(rows is not None for rows in known)


def _part(source: Pieces, wanted: dict[str, list[str]]) -> Iterator[Trip]:
    """The pieces of a trip with no more than what is wanted."""
    asked = "topics" in signature(source).parameters
    for piece in source(topics=wanted) if asked else source():
        topics = {name: frame for name, frame in piece.topics.items() if name in wanted}
        yield replace(piece, topics=topics)


def thinned_trip(trip: Trip) -> Trip:
    """What remains of a trip, or of a piece of one, where there are too many to draw all."""
    topics = {}
    for name, frame in trip.topics.items():
        time = np.asarray(pd.DatetimeIndex(frame.index).as_unit("ns").asi8)
        if name not in OVERVIEW | SATELLITES or name == ESTIMATED_STATE.name or not time.size:
            continue
        if name == GNSS_FIX.name:
            kept = np.unique(time // RARE, return_index=True)[1]
        elif name == ENVIRONMENT.name:
            # Rows far apart would be taken for a gap.
            each = np.unique(time // MOMENT, return_index=True)[1]
            kept = np.union1d(changes(frame.to_numpy(dtype=np.float64)), each)
        else:
            kept = extremes(frame["speed"].to_numpy(dtype=np.float64), time // MOMENT)
        topics[name] = frame.iloc[kept]
        topics[name].attrs = frame.attrs
    if TRAIN_STATE.name in topics and np.isfinite(topics[TRAIN_STATE.name]["speed"]).any():
        topics.pop(GNSS_MOTION.name, None)
    return replace(trip, topics=topics)


def extremes(values: FloatArray, piece: IntArray) -> IntArray:
    """Rows with the least and the greatest value of each piece, and the first unknown one.

    Parameters
    ----------
    values : (n,) array
        NaN where unknown.
    piece : (n,) int array
        Never decreasing.

    Examples
    --------
    >>> extremes(np.array([3.0, 1.0, 2.0, np.nan, 5.0]), np.array([0, 0, 0, 1, 1]))
    array([0, 1, 3, 4])
    """
    if values.size == 0:
        return np.empty(0, dtype=np.int64)
    begins = np.flatnonzero(np.concatenate(([True], np.diff(piece) != 0)))
    counts = np.diff(np.append(begins, values.size))
    unknown = np.isnan(values)
    low = np.repeat(np.minimum.reduceat(np.where(unknown, np.inf, values), begins), counts)
    high = np.repeat(np.maximum.reduceat(np.where(unknown, -np.inf, values), begins), counts)
    kept = [
        rows[np.unique(piece[rows], return_index=True)[1]]
        for rows in map(np.flatnonzero, (values == low, values == high, unknown))
    ]
    return np.unique(np.concatenate(kept))


def _joined(frames: Sequence[pd.DataFrame]) -> pd.DataFrame:
    if len(frames) == 1:
        return frames[0]
    joined = pd.concat(frames)
    joined.attrs = frames[0].attrs
    return joined


def _thinned_clock(clock: Clock) -> Clock:
    """The clock at the ends of moments, in which it is nearly a line."""
    if clock.time.size == 0:
        return clock
    begins = np.unique(clock.time // MOMENT, return_index=True)[1]
    kept = np.unique(np.concatenate((begins, begins[1:] - 1, [clock.time.size - 1])))
    return Clock(clock.start, clock.time[kept], clock.position[kept])


def _thinned_fixes(known: Survey) -> Any:
    if known.fixes is None:
        return None
    time, fixes = known.fixes
    kept = np.unique(time // NANOSECONDS, return_index=True)[1]
    return time[kept], fixes[kept]

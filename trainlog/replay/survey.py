"""What a replay has to know of whole trips before the first piece of them is drawn.

A trip may be longer than the memory: it is read twice, piece by piece. The first time gives where
the train was when, how high the plots have to be, and the recording's id; the second time each
piece is drawn and forgotten.

Trips over each other by position: how far each is behind a reference, and how much slower. Where
there are too many to draw every sample they are thinned: of each moment the rows with the lowest
and the highest speed remain.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from inspect import signature
from itertools import chain, pairwise
from typing import Any

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.formats.railway import line_of
from trainlog.railway import Line, Trajectory
from trainlog.replay.samples import (
    SPEEDS,
    Clock,
    Colour,
    Instants,
    Samples,
    changes,
    curves_of,
    largest_pulls,
    send_curve,
    shown_values,
    with_slip,
)
from trainlog.resampling import (
    POSITION_SOURCES,
    Nanoseconds,
    OnGrid,
    difference,
    grid_over,
    known_rows,
    on_grid,
    planned_time_distance,
    time_distance,
)
from trainlog.topics import (
    ENVIRONMENT,
    ESTIMATED_STATE,
    GNSS_FIX,
    GNSS_MOTION,
    TRAIN_CONTROLS,
    TRAIN_STATE,
)
from trainlog.trip import LINE_ATTACHMENT, Trip, nanoseconds, stacked
from trainlog.units import KMH, NANOSECONDS

Pieces = Callable[..., Iterable[Trip]]
"""Gives a trip piece by piece, in the order of time, each time that it is called.

Of a trip that is thinned it is asked for a part, as `trainlog.mcap.stream_log`: with ``topics``.
"""

GRID_STEP = 10.0
"""Trips lie over each other at positions that are multiples of this [m]."""

MOST = 500_000
"""Samples of a quantity that are kept of a whole trip; of more, every second, fourth, ..."""

USUAL = 0.999
"""Share of the values that a plot shows: outliers do not flatten the rest."""


class Sparse:
    """Rows of a long series, every one until there are too many, then every second, and so on."""

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._parts: list[tuple[Any, ...]] = []
        self._step = 1
        self._passed = 0
        self._held = 0

    def add(self, *columns: Any) -> None:
        """The next rows: arrays of one length."""
        count = len(columns[0])
        first = -self._passed % self._step
        self._passed += count
        self._parts.append(tuple(column[first :: self._step].copy() for column in columns))
        self._held += len(self._parts[-1][0])
        while self._held > self._most:
            # What is kept are the rows whose number is a multiple of the step.
            self._parts = [tuple(column[::2] for column in self.rows())]
            self._held = len(self._parts[0][0])
            self._step *= 2

    def __len__(self) -> int:
        return self._held

    def rows(self) -> tuple[Any, ...]:
        """The columns, of what was kept."""
        return tuple(np.concatenate(each) for each in zip(*self._parts, strict=True))


@dataclass(frozen=True, eq=False)
class Survey:
    """A whole trip at a glance.

    Attributes
    ----------
    bare : Trip
        Its metadata and attachments, and its topics without rows.
    line : Line or None
        As travelled; None if the trip carries none.
    clock : Clock
    tops : dict of str to float
        Of each curve that has anything to show, by entity, the value that nearly all are below,
        in the curve's unit.
    pulls : (3,) array
        Largest magnitude of lever, of the effort asked for, and of that given.
    fixes : (time [ns], (n, 2) array [deg]) or None
        When and where the satellites saw it.
    digest : bytes
        Of everything recorded.
    along : OnGrid or None
        When it passed each multiple of `GRID_STEP`, and how fast; None without a position.
    """

    bare: Trip
    line: Line | None
    clock: Clock
    tops: dict[str, float]
    pulls: FloatArray
    fixes: tuple[Nanoseconds, FloatArray] | None
    digest: bytes
    along: OnGrid | None = None


def pieces_of(trip: Trip | Pieces) -> Pieces:
    """A trip in memory is a single piece."""
    if isinstance(trip, Trip):
        return lambda topics=None: [trip]  # noqa: ARG005
    return trip


def survey(pieces: Pieces) -> Survey:
    """Read a trip once.

    Raises
    ------
    LogError
        If the trip holds no samples.
    """
    bare: Trip | None = None
    start: int | None = None
    digest = hashlib.sha256()
    speeds = [(name, "speed") for name in SPEEDS]
    series = {source: Sparse() for source in (*POSITION_SOURCES, *speeds)}
    values: dict[str, Sparse] = {}
    pulls = np.zeros(3)
    for piece, state in neighboured(pieces()):
        if bare is None:
            bare = replace(
                piece, topics={name: frame.iloc[:0] for name, frame in piece.topics.items()}
            )
            digest.update(json.dumps(piece.metadata, sort_keys=True).encode())
        if start is None and any(map(len, piece.topics.values())):
            start = int(piece.start.as_unit("ns").value)
        _digest(digest, piece)
        for source, kept in series.items():
            found = known_rows(piece, *source)
            if found is not None:
                kept.add(*found)
        drawn = with_slip(piece, state)
        for curve in curves_of(piece):
            shown = shown_values(curve, drawn)
            if shown is not None and np.isfinite(shown).any():
                values.setdefault(curve.entity, Sparse(MOST // shown.shape[1])).add(shown)
        if TRAIN_CONTROLS.name in piece:
            pulls = np.maximum(pulls, largest_pulls(piece[TRAIN_CONTROLS.name]))
    if bare is None or start is None:
        bare = bare or Trip({})
        start = int(bare.start.as_unit("ns").value)
    rows = {source: kept.rows() for source, kept in series.items() if len(kept)}
    known = {source: rows[source] for source in POSITION_SOURCES if source in rows}
    seen = known.get((GNSS_FIX.name, "latitude", "longitude"))
    passed = time_distance(start, known)
    clock = Clock(start, passed.time, passed.position)
    speed = next((rows[source] for source in speeds if source in rows), None)
    return Survey(
        bare=bare,
        line=line_of(bare) if LINE_ATTACHMENT in bare.attachments else None,
        clock=clock,
        tops={
            entity: float(np.nanquantile(kept.rows()[0], USUAL)) for entity, kept in values.items()
        },
        pulls=pulls,
        fixes=None if seen is None else (seen[0], np.column_stack(seen[1:])),
        digest=digest.digest(),
        along=_along(clock, speed),
    )


def _along(clock: Clock, speed: tuple[Any, ...] | None) -> OnGrid | None:
    """The trip on its part of the grid of all, from its departure."""
    if clock.position.size == 0:
        return None
    grid = grid_over([clock], GRID_STEP)
    if grid.size < 2:
        return None
    along = on_grid(clock, grid, speed)
    # It may stand where it begins for as long as it was recorded before.
    along.time[0] = clock.departure_at(grid[:1])[0]
    return along


def neighboured(pieces: Iterable[Trip]) -> Iterator[tuple[Trip, pd.DataFrame | None]]:
    """Each piece, and the train's state in it with one sample before it and one behind it.

    What is read between two samples of the train's state then has no seams.
    """
    before: pd.DataFrame | None = None
    for piece, after in pairwise(chain(pieces, [None])):
        assert piece is not None
        state, behind = (
            None if each is None else each.topics.get(TRAIN_STATE.name) for each in (piece, after)
        )
        if state is None:
            yield piece, None
            continue
        around = (before, state, None if behind is None else behind.iloc[:1])
        parts = [part for part in around if part is not None and len(part)]
        joined = stacked(parts or [state])
        joined.attrs = state.attrs
        yield piece, joined
        before = state.iloc[-1:] if len(state) else before


def _digest(digest: Any, piece: Trip) -> None:
    for topic, frame in sorted(piece.topics.items()):
        digest.update(topic.encode() + nanoseconds(frame).tobytes())
        for column in frame.columns:
            values = frame[column]
            numbers = values.dtype.kind in "fiub"
            text = (
                values.to_numpy().tobytes() if numbers else "\n".join(values.astype(str)).encode()
            )
            digest.update(column.encode() + text)


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
    if LINE_ATTACHMENT not in pieces[0].attachments or all(
        known_rows(piece, TRAIN_STATE.name, "speed") is None
        or known_rows(piece, TRAIN_STATE.name, "position") is None
        for piece in pieces
    ):
        pieces = list(_part(source, OVERVIEW | SATELLITES))
    known = survey(lambda: pieces)
    parts = list(map(thinned_trip, pieces))
    topics = {
        name: stacked([part[name] for part in parts if name in part])
        for name in dict.fromkeys(name for part in parts for name in part)
    }
    trip = replace(known.bare, topics=topics)
    clock, fixes = known.clock, known.fixes
    if clock.time.size:
        # Between the ends of moments it is nearly a line.
        begins = np.unique(clock.time // MOMENT, return_index=True)[1]
        kept = np.unique(np.concatenate((begins, begins[1:] - 1, [clock.time.size - 1])))
        clock = Clock(clock.start, clock.time[kept], clock.position[kept])
    if fixes is not None:
        kept = np.unique(fixes[0] // NANOSECONDS, return_index=True)[1]
        fixes = fixes[0][kept], fixes[1][kept]
    return replace(known, clock=clock, fixes=fixes), trip


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

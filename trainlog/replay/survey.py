"""What a replay has to know of a whole trip before the first piece of it is drawn.

A trip may be longer than the memory: it is read twice, piece by piece. The first time gives where
the train was when, how high the plots have to be, and the recording's id; the second time each
piece is drawn and forgotten.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import Any

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray
from trainlog.formats.railway import line_of
from trainlog.railway import Line
from trainlog.replay.clock import (
    POSITION_SOURCES,
    Clock,
    Nanoseconds,
    clock_from,
    known_rows,
    nanoseconds,
)
from trainlog.replay.curves import curves_of
from trainlog.replay.samples import largest_pulls, shown_values, with_slip
from trainlog.replay.track import SPEEDS
from trainlog.resampling import OnGrid, grid_over, on_grid
from trainlog.topics import GNSS_FIX, TRAIN_CONTROLS, TRAIN_STATE
from trainlog.trip import LINE_ATTACHMENT, Trip

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
    places = {candidate: Sparse() for candidate in POSITION_SOURCES}
    values: dict[str, Sparse] = {}
    pulls, speeds = np.zeros(3), {name: Sparse() for name in SPEEDS}
    for piece, state in neighboured(pieces()):
        if bare is None:
            bare = replace(
                piece, topics={name: frame.iloc[:0] for name, frame in piece.topics.items()}
            )
            digest.update(json.dumps(piece.metadata, sort_keys=True).encode())
        if start is None and any(map(len, piece.topics.values())):
            start = int(piece.start.as_unit("ns").value)
        _digest(digest, piece)
        for (topic, *names), kept in places.items():
            found = known_rows(piece, topic, *names)
            if found is not None:
                kept.add(*found)
        for name, kept in speeds.items():
            found = known_rows(piece, name, "speed")
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
    known = {candidate: kept.rows() for candidate, kept in places.items() if len(kept)}
    seen = known.get((GNSS_FIX.name, "latitude", "longitude"))
    clock = clock_from(start, known)
    speed = next((kept.rows() for kept in speeds.values() if len(kept)), None)
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
        joined = pd.concat(parts) if len(parts) > 1 else parts[0] if parts else state
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

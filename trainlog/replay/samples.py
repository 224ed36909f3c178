"""From a trip's frames to what is drawn: scaled, thinned where held, broken at gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.replay.clock import FloatArray, Nanoseconds, nanoseconds
from trainlog.replay.curves import Curve
from trainlog.resampling import interpolated
from trainlog.topics import ESTIMATED_ADHESION, TRAIN_AXLES, TRAIN_CONTROLS, TRAIN_STATE
from trainlog.trip import Trip, frame_of

GAP_PERIODS = 5.0
"""Samples that are this many median periods apart have a gap between them."""

SHORTEST_GAP = 1_000_000_000
"""Shorter pauses are never a gap [ns]."""

STANDSTILL = 0.1
"""Speed below which a train stands [m/s]."""

APPLIED = 0.02
"""Share of its largest value from which an effort or a lever counts as applied."""


@dataclass(frozen=True, eq=False)
class Samples:
    """The points of a curve.

    Attributes
    ----------
    time : (n,) int array [ns since 1970 UTC]
    ordinates : (n, lines) array
        In the curve's unit; NaN breaks the line.
    variances : (n, lines) array or None
        In that unit squared.
    """

    time: Nanoseconds
    ordinates: FloatArray
    variances: FloatArray | None = None


def samples_of(curve: Curve, trip: Trip) -> Samples | None:
    """The points of a curve; None if the trip has nothing to show."""
    if curve.topic.name not in trip:
        return None
    frame = trip[curve.topic.name]
    names = _columns(curve, frame)
    scale = [stroke.scale for stroke in curve.strokes]
    values = _block(frame, names) * scale
    if not np.isfinite(values).any():
        return None
    if curve.magnitude:
        values = np.abs(values)
    variances = None
    if curve.std is not None:
        variances = (_block(frame, [curve.std]) * scale) ** 2
    points = broken(Samples(nanoseconds(frame), values, variances))
    return thinned(points) if curve.held else points


def broken(points: Samples) -> Samples:
    """A row of NaN after each sample that is followed by a gap in time, so that the line breaks."""
    steps = np.diff(points.time)
    if steps.size == 0:
        return points
    gaps = np.flatnonzero(steps > max(GAP_PERIODS * float(np.median(steps)), SHORTEST_GAP)) + 1
    variances = points.variances
    return Samples(
        np.insert(points.time, gaps, points.time[gaps - 1] + 1),
        np.insert(points.ordinates, gaps, np.nan, axis=0),
        None if variances is None else np.insert(variances, gaps, np.nan, axis=0),
    )


def thinned(points: Samples) -> Samples:
    """The samples on either side of each change, which is all that a held value needs."""
    values = points.ordinates
    same = np.all((values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1])), 1)
    if points.variances is not None:
        same &= points.variances[1:, 0] == points.variances[:-1, 0]
    kept = np.ones(points.time.size, dtype=np.bool_)
    kept[1:-1] = ~(same[1:] & same[:-1])
    variances = None if points.variances is None else points.variances[kept]
    return Samples(points.time[kept], values[kept], variances)


def with_slip(trip: Trip) -> Trip:
    """The trip with slip speeds: wheel less train speed, where no estimate of them is recorded."""
    if ESTIMATED_ADHESION.name in trip or not {TRAIN_AXLES.name, TRAIN_STATE.name} <= {
        *trip.topics
    }:
        return trip
    axles = trip[TRAIN_AXLES.name]
    wheels = _block(axles, [name for name in axles.columns if name.startswith("wheel_speed_")])
    train = interpolated(trip[TRAIN_STATE.name], "speed", pd.DatetimeIndex(axles.index))
    return trip.with_topic(
        frame_of(ESTIMATED_ADHESION, nanoseconds(axles), {"slip_speed": wheels - train[:, None]})
    )


def phases(trip: Trip) -> tuple[Nanoseconds, NDArray[np.str_]] | None:
    """When the train changed between traction, coasting, braking and standstill, and to which.

    The lever decides, which has no noise; without one the efforts asked for, then those given.
    None if the trip records none of them.
    """
    if TRAIN_CONTROLS.name not in trip:
        return None
    frame = trip[TRAIN_CONTROLS.name].reindex(columns=[f.name for f in TRAIN_CONTROLS.fields])
    pull = _pull(frame)
    if pull is None:
        return None
    phase = np.select([pull > 0.0, pull < 0.0], ["traction", "braking"], default="coasting")
    if TRAIN_STATE.name in trip:
        index = pd.DatetimeIndex(frame.index)
        speed = interpolated(trip[TRAIN_STATE.name], "speed", index)
        phase = np.where(speed < STANDSTILL, "standstill", phase)
    phase = np.where(np.isnan(pull), "", phase)
    changed = np.concatenate(([True], phase[1:] != phase[:-1]))
    return nanoseconds(frame)[changed], phase[changed]


def _pull(frame: pd.DataFrame) -> FloatArray | None:
    """Positive in traction, negative in braking, 0 between, NaN where unknown; (n,)."""
    demand = frame["tractive_effort_demand"] - frame["braking_effort_demand"]
    given = frame["tractive_effort"].fillna(0.0) - frame[
        ["dynamic_braking_effort", "pneumatic_braking_effort"]
    ].sum(axis=1)
    for candidate in (frame["lever"], demand, given):
        pull = candidate.to_numpy(dtype=np.float64)
        largest = np.nanmax(np.abs(pull), initial=0.0)
        if np.isfinite(pull).any() and largest > 0.0:
            return np.where(np.abs(pull) < APPLIED * largest, 0.0, pull)
    return None


def _columns(curve: Curve, frame: pd.DataFrame) -> list[str]:
    if not curve.per_axle:
        return [stroke.field for stroke in curve.strokes]
    prefix = f"{curve.strokes[0].field}_"
    return [name for name in frame.columns if name.startswith(prefix)]


def _block(frame: pd.DataFrame, names: list[str]) -> FloatArray:
    """Columns side by side; those that an older log does not have are unknown."""
    return frame.reindex(columns=names).to_numpy(dtype=np.float64)

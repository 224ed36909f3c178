"""From a trip's frames to what is drawn: scaled, thinned where held, broken at gaps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import rerun as rr
from numpy.typing import NDArray

from trainlog.arrays import FloatArray, IntArray
from trainlog.replay.clock import Instants, Nanoseconds, nanoseconds
from trainlog.replay.curves import Colour, Curve
from trainlog.resampling import interpolated
from trainlog.topics import ESTIMATED_ADHESION, STANDSTILL, TRAIN_AXLES, TRAIN_CONTROLS
from trainlog.trip import Trip, frame_of
from trainlog.units import NANOSECONDS

GAP_PERIODS = 5.0
"""Samples that are this many median periods apart have a gap between them."""

SHORTEST_GAP = NANOSECONDS
"""Shorter pauses are never a gap [ns]."""

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

    def broken_at(self, rows: Any, time: Any) -> Samples:
        """With a row of NaN, which breaks the line, before each of these rows, at these times."""
        variances = self.variances
        return Samples(
            np.insert(self.time, rows, time),
            np.insert(self.ordinates, rows, np.nan, axis=0),
            None if variances is None else np.insert(variances, rows, np.nan, axis=0),
        )


class Pen:
    """Makes the points of a curve piece by piece, with no seams between the pieces.

    Nothing comes before the first piece in which there is anything to show.
    """

    def __init__(self, curve: Curve) -> None:
        self._curve = curve
        self._last = 0
        self._longest: float | None = None
        self._begun = False

    def samples(self, trip: Trip) -> Samples | None:
        """The points of the next piece; None if it has nothing to show."""
        curve = self._curve
        values = shown_values(curve, trip)
        if values is None or not (self._begun or np.isfinite(values).any()):
            return None
        frame = trip[curve.topic.name]
        variances = (_block(frame, [curve.std]) * curve.scales) ** 2 if curve.std else None
        points = Samples(nanoseconds(frame), values, variances)
        if self._longest is None:
            self._longest = longest_pause(points.time)
        points = broken(points, self._longest, self._last if self._begun else None)
        self._begun, self._last = True, int(points.time[-1])
        return thinned(points) if curve.held else points


def shown_values(curve: Curve, trip: Trip) -> FloatArray | None:
    """The ordinates of a curve, (n, lines), in its unit; None if there is no sample of it."""
    if curve.topic.name not in trip or trip[curve.topic.name].empty:
        return None
    frame = trip[curve.topic.name]
    names = _columns(curve, frame)
    if not names:
        return None
    values = _block(frame, names) * curve.scales + curve.offsets
    return np.abs(values) if curve.magnitude else values


def longest_pause(time: Nanoseconds) -> float | None:
    """Samples further apart than this [ns] have a gap between them; None of a single sample."""
    if time.size < 2:
        return None
    return max(GAP_PERIODS * float(np.median(np.diff(time))), SHORTEST_GAP)


def broken(points: Samples, longest: float | None = None, before: int | None = None) -> Samples:
    """A row of NaN after each sample that is followed by a gap in time, so that the line breaks.

    Parameters
    ----------
    points : Samples
    longest : float [ns], optional
        What is longer is a gap. Default: `longest_pause` of the points.
    before : int [ns since 1970 UTC], optional
        Time of the last sample before these: the line breaks after it, too.
    """
    if longest is None:
        longest = longest_pause(points.time)
    if longest is None:
        return points
    if before is not None and points.time[0] - before > longest:
        points = points.broken_at(0, before + 1)
    gaps = np.flatnonzero(np.diff(points.time) > longest) + 1
    if before is not None:
        gaps = gaps[points.time[gaps - 1] != before + 1]
    return points.broken_at(gaps, points.time[gaps - 1] + 1)


def thinned(points: Samples) -> Samples:
    """The samples on either side of each change, which is all that a held value needs."""
    variances = points.variances
    every = points.ordinates if variances is None else np.hstack((points.ordinates, variances))
    kept = changes(every)
    return Samples(
        points.time[kept],
        points.ordinates[kept],
        None if variances is None else variances[kept],
    )


def changes(values: FloatArray) -> IntArray:
    """Rows on either side of each change of any column, the first and the last, of (n, columns)."""
    same = np.all((values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1])), 1)
    kept = np.ones(len(values), dtype=np.bool_)
    kept[1:-1] = ~(same[1:] & same[:-1])
    return np.flatnonzero(kept)


def with_slip(trip: Trip, state: pd.DataFrame | None) -> Trip:
    """The trip with slip speeds: wheel less train speed, where no estimate of them is recorded.

    `state` is the train's state from before the trip's first sample to behind its last.
    """
    if ESTIMATED_ADHESION.name in trip or TRAIN_AXLES.name not in trip or state is None:
        return trip
    axles = trip[TRAIN_AXLES.name]
    wheels = _block(axles, [name for name in axles.columns if name.startswith("wheel_speed_")])
    train = interpolated(state, "speed", pd.DatetimeIndex(axles.index))
    return trip.with_topic(
        frame_of(ESTIMATED_ADHESION, nanoseconds(axles), {"slip_speed": wheels - train[:, None]})
    )


def phases(
    trip: Trip, state: pd.DataFrame | None, largest: FloatArray
) -> tuple[Nanoseconds, NDArray[np.str_]] | None:
    """When the train changed between traction, coasting, braking and standstill, and to which.

    The lever decides, which has no noise; without one the efforts asked for, then those given.
    None if the trip records none of them.

    Parameters
    ----------
    trip : Trip
        Or a piece of one.
    state : DataFrame or None
        The train's state from before the piece's first sample to behind its last.
    largest : (3,) array
        `largest_pulls` of the whole trip.
    """
    if TRAIN_CONTROLS.name not in trip or trip[TRAIN_CONTROLS.name].empty:
        return None
    frame = trip[TRAIN_CONTROLS.name]
    pull = _pull(frame, largest)
    if pull is None:
        return None
    phase = np.select([pull > 0.0, pull < 0.0], ["traction", "braking"], default="coasting")
    if state is not None:
        speed = interpolated(state, "speed", pd.DatetimeIndex(frame.index))
        phase = np.where(speed < STANDSTILL, "standstill", phase)
    phase = np.where(np.isnan(pull), "", phase)
    changed = np.concatenate(([True], phase[1:] != phase[:-1]))
    return nanoseconds(frame)[changed], phase[changed]


def largest_pulls(frame: pd.DataFrame) -> FloatArray:
    """Largest magnitude of the lever, of the effort asked for, and of that given; (3,)."""
    found = [np.nanmax(np.abs(pull), initial=0.0) for pull in _pulls(frame)]
    return np.array(found, dtype=np.float64)


def _pull(frame: pd.DataFrame, largest: FloatArray) -> FloatArray | None:
    """Positive in traction, negative in braking, 0 between, NaN where unknown; (n,)."""
    for pull, most in zip(_pulls(frame), largest.tolist(), strict=True):
        if most > 0.0:
            return np.where(np.abs(pull) < APPLIED * most, 0.0, pull)
    return None


def _pulls(frame: pd.DataFrame) -> tuple[FloatArray, ...]:
    """The lever, the effort asked for, and that given, braking negative; (n,) each."""
    full = frame.reindex(columns=[field.name for field in TRAIN_CONTROLS.fields])
    demand = full["tractive_effort_demand"] - full["braking_effort_demand"]
    given = full["tractive_effort"].fillna(0.0) - full[
        ["dynamic_braking_effort", "pneumatic_braking_effort"]
    ].sum(axis=1)
    return tuple(each.to_numpy(dtype=np.float64) for each in (full["lever"], demand, given))


def _columns(curve: Curve, frame: pd.DataFrame) -> list[str]:
    if not curve.per_axle:
        return list(curve.fields)
    prefix = f"{curve.fields[0]}_"
    return [name for name in frame.columns if name.startswith(prefix)]


def _block(frame: pd.DataFrame, names: list[str]) -> FloatArray:
    """Columns side by side; those that an older log does not have are unknown."""
    return frame.reindex(columns=names).to_numpy(dtype=np.float64)


ROWS = 10_000
"""Rows a chunk: larger ones are slower to write and to draw."""


def path_of(*parts: str) -> str:
    """Entity path of these parts, whatever characters they hold."""
    return str(rr.new_entity_path(list(parts)))


def send_static(recording: Any, entity: str, what: Any) -> None:
    """Log something that holds at all times and places."""
    recording.log(entity, what, static=True, strict=True)


def send_rows(
    recording: Any,
    entity: str,
    instants: Instants,
    columns: Callable[[slice], Any],
) -> None:
    """Send the rows of an entity; `columns` makes Rerun's columns of a slice of them."""
    for first in range(0, len(instants), ROWS):
        rows = slice(first, first + ROWS)
        recording.send_columns(entity, instants.columns(rows), columns(rows), strict=True)


def send_curve(
    recording: Any,
    entity: str,
    instants: Instants,
    points: Samples,
    *,
    names: list[str],
    colours: list[Colour],
    width: float = 1.5,
    held: bool = False,
) -> None:
    """Send the points of a curve and how it is drawn: lines, or with variances bands as well."""
    # Rerun counts a plot's ticks from its first sample: they fall on whole kilometres with it.
    instants, points = from_whole_kilometre(instants), points.broken_at(0, points.time[0])
    style = {
        "names": names,
        "colors": np.array(colours, dtype=np.uint8),
        "widths": [width] * len(names),
        "interpolation_mode": "StepAfter" if held else "Linear",
        # Seen from afar Rerun shows the mean of neighbouring samples: a limit that was never in
        # force on either side of each change, and slips that never were as high.
        "aggregation_policy": "Off" if held else "MinMax",
    }
    style_of = rr.SeriesLines if points.variances is None else rr.Measurements.from_fields
    send_static(recording, entity, style_of(**style))
    send_samples(recording, entity, instants, points)


def send_samples(recording: Any, entity: str, instants: Instants, points: Samples) -> None:
    """Send further points of a curve."""

    def columns(rows: slice) -> Any:
        values = _rows(points.ordinates[rows])
        if points.variances is None:
            return rr.Scalars.columns(scalars=values)
        return rr.Measurements.columns(values=values, variances=_rows(points.variances[rows]))

    send_rows(recording, entity, instants, columns)


def send_dots(
    recording: Any,
    entity: str,
    instants: Instants,
    values: FloatArray,
    *,
    name: str,
    colour: Colour,
) -> None:
    """Send values, (n,), that are drawn as dots in a plot."""
    style = rr.SeriesPoints(names=name, colors=np.array([colour]), marker_sizes=3.0)
    send_static(recording, entity, style)
    send_rows(recording, entity, instants, lambda rows: rr.Scalars.columns(scalars=values[rows]))


def from_whole_kilometre(instants: Instants) -> Instants:
    """The same with one more, before them, at the whole kilometre before the first position."""
    first = np.floor(instants.position.min() / 1e3) * 1e3
    return Instants(
        instants.start,
        np.insert(instants.time, 0, instants.time[0]),
        np.insert(instants.position, 0, first),
    )


def _rows(block: FloatArray) -> FloatArray:
    """A block as Rerun partitions it: one column flat, several as they are."""
    return np.ascontiguousarray(block[:, 0] if block.shape[1] == 1 else block)

"""Bringing a trip's topics onto one clock, and trips onto one grid of positions.

How a value between two samples is found stands in the table of topics: on the line between them,
held since the last, or not at all. Nothing is known before the first sample of a topic, after its
last, beside a sample that is not known, and in a gap longer than a stated time: there the result is
NaN. What has no value between samples (texts and codes) is never resampled.

A time-distance curve orders a trip by position. Recorded chainage does not grow steadily: that of a
standing train wavers by millimetres, an odometer's is set back by metres at a balise. The curve is
the non-decreasing one nearest to what was recorded, in the least-squares sense (isotonic
regression). Trips lie over each other on a grid of positions, by the time at which each node is
reached.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from trainlog.arrays import BoolArray, FloatArray, IntArray, numbered
from trainlog.errors import InputError, LogError
from trainlog.railway.trajectory import Trajectory
from trainlog.topics import (
    ESTIMATED_STATE,
    GNSS_FIX,
    GNSS_MOTION,
    TRAIN_STATE,
    column_field,
    topic_of_frame,
)
from trainlog.trip import Trip, nanoseconds
from trainlog.units import EARTH_RADIUS, NANOSECONDS
from trainlog.version import __version__

Clock = pd.DatetimeIndex | pd.Timedelta | float
"""The times to resample to: as they are, or the step between them, a duration or in [s]."""


def interpolated(
    frame: pd.DataFrame, column: str, time: pd.DatetimeIndex, max_gap: float | None = None
) -> FloatArray:
    """The values of a column at other times, by the topic table's interpolation rule.

    Parameters
    ----------
    frame : DataFrame
        Of a topic, in the order of time.
    column : str
        One with a unit; texts and codes have no values between samples.
    time : (n,) DatetimeIndex
    max_gap : float [s], optional
        Samples further apart than this have nothing between them. Default: no limit.

    Returns
    -------
    (n,) array
        In the column's unit. A sample at exactly one of the times is found as it is, the last of
        several; at its own times a topic is what it was. NaN outside the recorded span, in gaps,
        and between two samples of which one is not known.

    Raises
    ------
    KeyError
        If the topic has no such column.
    InputError
        If its values cannot be interpolated.

    Examples
    --------
    >>> from trainlog.topics import TRAIN_STATE
    >>> from trainlog.trip import frame_of
    >>> frame = frame_of(TRAIN_STATE, [0, 2_000_000_000], {"speed": [3.0, 4.0]})
    >>> interpolated(frame, "speed", pd.DatetimeIndex(["1970-01-01T00:00:01Z"])).tolist()
    [3.5]
    """
    return interpolated_columns(frame, [column], time, max_gap)[0]


def interpolated_columns(
    frame: pd.DataFrame,
    columns: Sequence[str],
    time: pd.DatetimeIndex,
    max_gap: float | None = None,
) -> list[FloatArray]:
    """The values of several columns, as `interpolated` gives each."""
    rules = [column_field(topic_of_frame(frame.attrs), name).interpolation for name in columns]
    if "none" in rules:
        raise InputError(
            f"{columns[rules.index('none')]} of {frame.attrs['topic']} has no values between its"
            " samples",
            remedy="take the rows as they are",
        )
    known = nanoseconds(frame)
    wanted = time.as_unit("ns").asi8
    every = [frame[name].to_numpy(dtype=np.float64) for name in columns]
    if len(known) == 0:
        return [np.full(len(wanted), np.nan) for _ in every]
    if np.array_equal(known, wanted):
        return [values.copy() for values in every]
    before = np.clip(np.searchsorted(known, wanted, side="right") - 1, 0, None)
    after = np.clip(before + 1, None, len(known) - 1)
    step = known[after] - known[before]
    since = np.clip(wanted - known[before], 0, step)
    unknown = (wanted < known[0]) | (wanted > known[-1])
    if max_gap is not None:
        unknown |= (since > 0) & (step > max_gap * NANOSECONDS)
    all_found = []
    for rule, values in zip(rules, every, strict=True):
        found = values[before]
        if rule == "linear":
            found = np.where(since == 0, found, _on_line(found, values[after], since, step))
        all_found.append(np.where(unknown, np.nan, found))
    return all_found


def filled(seconds: FloatArray, values: FloatArray, max_gap: float) -> FloatArray:
    """Values with those on the line between neighbours that are missing for no longer than a time.

    Parameters
    ----------
    seconds, values : (n,) array
    max_gap : float [s]
        Between two known values.

    Examples
    --------
    >>> filled(np.arange(6.0), np.array([np.nan, 1.0, np.nan, 3.0, np.nan, np.nan]), 2.0).tolist()
    [nan, 1.0, 2.0, 3.0, nan, nan]
    """
    known = np.flatnonzero(np.isfinite(values))
    if known.size in (0, values.size):
        return values
    there, after = seconds[known], np.searchsorted(known, np.arange(values.size))
    within = (after > 0) & (after < known.size)
    gap = np.diff(there, prepend=-np.inf)[np.minimum(after, known.size - 1)]
    missing = within & np.isnan(values) & (gap <= max_gap)
    return np.where(missing, np.interp(seconds, there, values[known]), values)


def resampled(trip: Trip, clock: Clock, *, max_gap: float | None) -> Trip:
    """A trip with all its topics on one clock.

    Topics without values between samples (the events) keep their own rows; columns of that kind
    in other topics are left out.

    Parameters
    ----------
    trip : Trip
    clock : DatetimeIndex, Timedelta, or float [s]
        The times; or the step between them, from the first sample of the trip to its last.
    max_gap : float [s] or None
        Samples of a topic further apart than this have nothing between them; None: no limit.

    Returns
    -------
    Trip
        With one step of provenance more.

    Raises
    ------
    InputError
        If the clock is neither times nor a step, the step not positive, or its times do not
        increase; if `max_gap` is not positive.
    LogError
        If the trip holds no samples.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/stopping.mcap")
    >>> steady = resampled(trip, 0.5, max_gap=2.0)
    >>> len(steady["/gnss/fix"]), len(steady["/train/state"])
    (2828, 2828)
    """
    check_max_gap(max_gap)
    times = _times(trip, clock)
    topics = dict(trip.topics)
    for name, frame in trip.topics.items():
        fields = topic_of_frame(frame.attrs).fields
        if any(field.interpolation != "none" for field in fields):
            topics[name] = resampled_frame(frame, times, max_gap=max_gap)
    step = None if isinstance(clock, pd.DatetimeIndex) else _step(clock)
    return replace(trip, topics=topics).with_step(
        "resample", software=f"trainlog {__version__}", seconds=step, max_gap=max_gap
    )


def resampled_frame(
    frame: pd.DataFrame, time: pd.DatetimeIndex, *, max_gap: float | None
) -> pd.DataFrame:
    """The frame of a topic at other times; see `interpolated`. Texts and codes are left out."""
    topic = topic_of_frame(frame.attrs)
    names = [name for name in frame.columns if column_field(topic, name).interpolation != "none"]
    found = pd.DataFrame(
        {name: interpolated(frame, name, time, max_gap) for name in names},
        index=_named(time),
        columns=names,
        dtype=np.float64,
    )
    units = frame.attrs.get("units", {})
    found.attrs = {**frame.attrs, "units": {n: u for n, u in units.items() if n in names}}
    return found


def joined(
    trip: Trip, columns: Iterable[str], on: str | Clock, *, max_gap: float | None
) -> pd.DataFrame:
    """Columns of several topics on one clock, side by side.

    Parameters
    ----------
    trip : Trip
    columns : iterable of str
        As ``"/train/state.speed"``. A field with one value for each axle gives all its columns:
        ``"/train/axles.wheel_speed"``.
    on : str, DatetimeIndex, Timedelta, or float [s]
        Topic whose times are the clock; or the times; or the step between them.
    max_gap : float [s] or None
        Samples of a topic further apart than this have nothing between them; None: no limit.

    Returns
    -------
    DataFrame
        Indexed by time, one column a name, the units in ``attrs["units"]``.

    Raises
    ------
    LogError
        If the trip has no such topic, or the topic no such column.
    InputError
        If a name is not of the form ``topic.column``, comes twice, or its values cannot be
        interpolated; if the clock cannot be used; if `max_gap` is not positive.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/stopping.mcap")
    >>> names = ["/train/state.speed", "/train/controls.lever"]
    >>> table = joined(trip, names, on="/train/controls", max_gap=1.0)
    >>> table.shape, table.attrs["units"]["/train/state.speed"]
    ((14140, 2), 'm/s')
    """
    check_max_gap(max_gap)
    times = pd.DatetimeIndex(trip[on].index) if isinstance(on, str) else _times(trip, on)
    found: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    for name in [columns] if isinstance(columns, str) else columns:
        topic, dot, column = name.rpartition(".")
        if not (dot and topic and column):
            remedy = "write it as /train/state.speed"
            raise InputError(f"'{name}' is not a column of a topic", remedy=remedy)
        frame = trip[topic]
        for column in _columns_of(frame, name):
            full = f"{topic}.{column}"
            if full in found:
                raise InputError(f"{full} is joined twice", remedy="name it once")
            found[full] = interpolated(frame, column, times, max_gap)
            units[full] = frame.attrs["units"][column]
    result = pd.DataFrame(found, index=_named(times), columns=list(found), dtype=np.float64)
    result.attrs = {"units": units}
    return result


MOST_INSTANTS = 10**8
"""Of a clock: more are no clock but a slip of the unit."""


def regular_clock(start: pd.Timestamp, end: pd.Timestamp, step: float) -> pd.DatetimeIndex:
    """Times from `start` on, `step` seconds apart, none after `end`.

    Raises
    ------
    InputError
        If the step is shorter than a nanosecond, or makes more than `MOST_INSTANTS`.

    Examples
    --------
    >>> start = pd.Timestamp("2024-10-07T08:00Z")
    >>> len(regular_clock(start, start + pd.Timedelta("1s"), 0.25))
    5
    """
    nanoseconds = round(step * NANOSECONDS) if np.isfinite(step) else 0
    if nanoseconds < 1:
        raise InputError(f"a clock cannot go in steps of {step:g} s", remedy="give seconds above 0")
    first, last = start.as_unit("ns").value, end.as_unit("ns").value
    if (last - first) // nanoseconds > MOST_INSTANTS:
        raise InputError(
            f"a clock in steps of {step:g} s has {(last - first) // nanoseconds:,} instants"
            f" in {(last - first) / NANOSECONDS:.0f} s",
            remedy=f"take longer steps or a part of the trip: at most {MOST_INSTANTS:,}",
        )
    times = np.arange(first, last + 1, nanoseconds)
    return pd.DatetimeIndex(times.view("M8[ns]"), tz="UTC", name="time")


def _on_line(first: FloatArray, second: FloatArray, since: IntArray, step: IntArray) -> FloatArray:
    """Values on the lines from `first` to `second`, never beyond either."""
    with np.errstate(invalid="ignore", divide="ignore"):
        part = since / step
        # The weighted sum cannot overflow, as the difference of large values would.
        value = (1.0 - part) * first + part * second
        return np.clip(value, np.minimum(first, second), np.maximum(first, second))


def _times(trip: Trip, clock: Clock) -> pd.DatetimeIndex:
    """The clock's times in UTC, checked."""
    if not isinstance(clock, pd.DatetimeIndex):
        return regular_clock(trip.start, trip.end, _step(clock))
    if not clock.is_monotonic_increasing or clock.hasnans:
        raise InputError("the times of the clock do not increase", remedy="sort them")
    return clock.tz_localize("UTC") if clock.tz is None else clock.tz_convert("UTC")


_NUMBERS = (int, float, np.integer, np.floating)


def _step(clock: object) -> float:
    """The step of a clock [s]."""
    if isinstance(clock, timedelta | np.timedelta64):  # a Timedelta is a timedelta
        return pd.Timedelta(clock).total_seconds()
    if isinstance(clock, _NUMBERS) and not isinstance(clock, bool):
        return float(clock)
    raise InputError(
        f"{clock!r:.80} is not a clock",
        remedy="give the times as a DatetimeIndex, or the step between them in seconds",
    )


def check_max_gap(max_gap: object) -> None:
    """Refuse a longest gap that is not a positive number of seconds.

    Raises
    ------
    InputError
    """
    if max_gap is None:
        return
    number = isinstance(max_gap, _NUMBERS) and not isinstance(max_gap, bool)
    if not (number and float(str(max_gap)) > 0):
        raise InputError(
            f"max_gap is {max_gap!r}", remedy="give seconds above 0, or None for gaps of any length"
        )


def _named(time: pd.DatetimeIndex) -> pd.DatetimeIndex:
    return time.as_unit("ns").rename("time")


def _columns_of(frame: pd.DataFrame, name: str) -> list[str]:
    """The column, or the columns of a field with one value for each axle."""
    wanted = name.rpartition(".")[2]
    topic = topic_of_frame(frame.attrs)
    fields = {column: column_field(topic, column) for column in frame.columns}
    found = [column for column, field in fields.items() if wanted in (column, field.name)]
    if not found:
        raise LogError(
            f"{topic.name} has no column {wanted}",
            remedy=f"its columns are {', '.join(frame.columns)}",
        )
    return found


# ------------------------------------------------------------------ on a grid of positions

Nanoseconds = IntArray

POSITION_SOURCES: tuple[tuple[str, ...], ...] = (
    (ESTIMATED_STATE.name, "position"),
    (TRAIN_STATE.name, "position"),
    (GNSS_MOTION.name, "speed"),
    (GNSS_FIX.name, "latitude", "longitude"),
)
"""Topics, and columns of them, from which a trip's position is known, the best first."""

LONGEST_GAP = 10.0
"""Between two known positions [s]: within a longer gap it is not known when a place was passed."""

GAP_DISTANCE = 20.0
"""Moved over a gap [m]: a train that stood through it is known all the time."""


@dataclass(frozen=True, eq=False)
class TimeDistance:
    """Time-distance curve of a trip or of a plan.

    Attributes
    ----------
    start : int [ns since 1970 UTC]
        First sample of the trip.
    time : (n,) int array [ns since 1970 UTC]
        When the position was recorded.
    position : (n,) array [m]
        Never decreasing; counted in the direction of travel.

    Examples
    --------
    Stands 10 s at 100 m:

    >>> times = np.array([0, 10, 20, 30]) * 1_000_000_000
    >>> curve = TimeDistance(0, times, np.array([0.0, 100.0, 100.0, 200.0]))
    >>> curve.arrival_at([50.0, 100.0, 300.0]), curve.departure_at([100.0])
    (array([ 5., 10., nan]), array([20.]))
    """

    start: int
    time: Nanoseconds
    position: FloatArray

    @property
    def covered(self) -> tuple[float, float]:
        """First and last position [m]; NaN where none is known."""
        if self.position.size == 0:
            return float("nan"), float("nan")
        return float(self.position[0]), float(self.position[-1])

    @property
    def seconds(self) -> FloatArray:
        """Time of each position since the start [s]."""
        return np.asarray((self.time - self.start) / NANOSECONDS, dtype=np.float64)

    def position_at(self, time: Nanoseconds) -> FloatArray:
        """Chainage [m] at each instant [ns]; held before the first and after the last."""
        if self.time.size == 0:
            return np.zeros(time.size)
        return np.interp(
            (time - self.start).astype(np.float64),
            (self.time - self.start).astype(np.float64),
            self.position,
        )

    def arrival_at(self, position: ArrayLike) -> FloatArray:
        """When each position [m] is reached [s since the start]; NaN where the train never was."""
        return self._passed(position, "left")

    def departure_at(self, position: ArrayLike) -> FloatArray:
        """When each position [m] is left [s since the start]; NaN where the train never was."""
        return self._passed(position, "right")

    def in_gap(self, position: ArrayLike) -> BoolArray:
        """Whether each position [m] was passed where none was recorded for `LONGEST_GAP`."""
        s = np.asarray(position, dtype=np.float64)
        long = (np.diff(self.seconds) > LONGEST_GAP) & (np.diff(self.position) > GAP_DISTANCE)
        if not long.any():
            return np.zeros(s.shape, dtype=np.bool_)
        index = np.clip(np.searchsorted(self.position, s, side="left") - 1, 0, long.size - 1)
        # At its very ends the position is a recorded one.
        return np.asarray(long[index] & (s < self.position[index + 1]) & (s > self.position[index]))

    def _passed(self, position: ArrayLike, side: Any) -> FloatArray:
        s = np.asarray(position, dtype=np.float64)
        if self.position.size == 0:
            return np.full(s.shape, np.nan)
        seconds, last = self.seconds, self.position.size - 1
        index = np.searchsorted(self.position, s, side=side)
        # The samples on both sides; on a recorded position the first or the last at it.
        high = np.clip(index, 0, last)
        low = np.clip(index - 1, 0, last)
        step = self.position[high] - self.position[low]
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(step > 0.0, (s - self.position[low]) / step, float(side == "left"))
        passed = seconds[low] + share * (seconds[high] - seconds[low])
        inside = (s >= self.position[0]) & (s <= self.position[-1])
        return np.asarray(np.where(inside, passed, np.nan))


def forward_chainage(position: ArrayLike) -> FloatArray:
    """The non-decreasing chainage [m] nearest to a recorded one.

    A line's chainage begins at 0: what lies before it is noise and is put there.

    Source: isotonic regression by pooling adjacent violators (Barlow et al., 1972).

    Examples
    --------
    >>> forward_chainage([0.0, 10.0, 9.0, 20.0])
    array([ 0. ,  9.5,  9.5, 20. ])
    """
    from scipy.optimize import isotonic_regression

    recorded = np.maximum(np.asarray(position, dtype=np.float64), 0.0)
    if recorded.size == 0:
        return recorded
    return np.asarray(isotonic_regression(recorded).x, dtype=np.float64)


def time_distance_of(trip: Trip) -> TimeDistance:
    """The trip's time-distance curve, with the best position that it holds.

    Estimated chainage before the train's own; without either, the distance since the first sample,
    from the satellites' speed or else from their fixes. The curve of a trip without any of them is
    empty.

    Raises
    ------
    LogError
        If the trip holds no samples.

    Examples
    --------
    >>> import trainlog
    >>> curve = time_distance_of(trainlog.read("sample_logs/nonstop.mcap"))
    >>> curve.arrival_at([10_000.0]).round(1)
    array([376.8])
    """
    start = int(trip.start.as_unit("ns").value)
    found = {source: known_rows(trip, *source) for source in POSITION_SOURCES}
    return time_distance(start, {key: rows for key, rows in found.items() if rows is not None})


def time_distance(start: int, known: Mapping[tuple[str, ...], tuple[Any, ...]]) -> TimeDistance:
    """The curve of a trip that began at `start` [ns], from the positions in `known`.

    Parameters
    ----------
    start : int [ns since 1970 UTC]
    known : mapping of tuple of str to tuple of arrays
        By one of `POSITION_SOURCES`: time [ns] and columns of the rows in which all are known.

    Examples
    --------
    >>> rows = np.array([0, 10]) * 1_000_000_000, np.array([0.0, 250.0])
    >>> time_distance(0, {("/train/state", "position"): rows}).covered
    (0.0, 250.0)
    """
    for source in POSITION_SOURCES[:2]:
        if source in known:
            time, position = known[source]
            return TimeDistance(start, time, forward_chainage(position))
    if POSITION_SOURCES[2] in known:
        time, speed = known[POSITION_SOURCES[2]]
        steps = np.diff(time) / NANOSECONDS * 0.5 * (speed[1:] + speed[:-1])
        return TimeDistance(start, time, np.concatenate(([0.0], np.cumsum(steps))))
    if POSITION_SOURCES[3] in known:
        time, latitude, longitude = known[POSITION_SOURCES[3]]
        return TimeDistance(start, time, _run(latitude, longitude))
    return TimeDistance(start, np.empty(0, np.int64), np.empty(0))


def planned_time_distance(trajectory: Trajectory, row: int, start: int = 0) -> TimeDistance:
    """The time-distance curve that a trajectory plans for configuration `row`.

    Parameters
    ----------
    trajectory : Trajectory
    row : int
    start : int [ns since 1970 UTC]
        Departure.

    Notes
    -----
    Between nodes the speed squared is linear in position, so that ``t = t0 + 2 (s - s0)/(v0 + v)``.
    Nodes far apart are parted, so that the curve between is not a line.
    """
    nodes = trajectory.positions
    parts = np.maximum(1, np.ceil(np.diff(nodes) / _PLAN_STEP)).astype(np.int64)
    cell, number = numbered(parts)
    share = number / parts[cell]
    place = nodes[cell] + share * (nodes[cell + 1] - nodes[cell])
    speed = trajectory.speeds[row]
    with np.errstate(invalid="ignore", divide="ignore"):
        after = 2.0 * (place - nodes[cell]) / (speed[cell] + trajectory.speed_at(row, place))
    times = trajectory.times[row][cell] + np.where(share > 0.0, after, 0.0)
    seconds = np.append(times, trajectory.times[row][-1])
    return TimeDistance(
        start, start + np.rint(seconds * NANOSECONDS).astype(np.int64), np.append(place, nodes[-1])
    )


_PLAN_STEP = 10.0
"""Longest piece of a planned curve [m]."""


@dataclass(frozen=True, eq=False)
class OnGrid:
    """A trip on a grid of positions.

    Attributes
    ----------
    position : (n,) array [m]
        Nodes of the grid, increasing.
    time : (n,) array [s]
        When each node is reached, since the curve's start; NaN outside the trip and in its gaps.
    speed : (n,) array [m/s]
        At that time; NaN alike.
    """

    position: FloatArray
    time: FloatArray
    speed: FloatArray


def grid_over(curves: list[TimeDistance], step: float = 10.0) -> FloatArray:
    """Multiples of `step` [m] over all that any of the curves covers.

    Raises
    ------
    InputError
        If no curve knows a position, or the step is not positive.

    Examples
    --------
    >>> curve = TimeDistance(0, np.array([0, 10**10]), np.array([3.0, 31.0]))
    >>> grid_over([curve])
    array([10., 20., 30.])
    """
    if not step > 0.0:
        raise InputError(f"a grid cannot have steps of {step:g} m", remedy="give metres above 0")
    ends = np.array([curve.covered for curve in curves if curve.position.size])
    if ends.size == 0:
        raise InputError("no trip has a position", remedy="give trips with a position")
    first, last = np.ceil(ends[:, 0].min() / step), np.floor(ends[:, 1].max() / step)
    return np.asarray(step * np.arange(first, last + 1.0))


def on_grid(
    curve: TimeDistance, grid: FloatArray, recorded: tuple[Nanoseconds, FloatArray] | None = None
) -> OnGrid:
    """Passing time and speed of a trip at the nodes of a grid.

    Parameters
    ----------
    curve : TimeDistance
    grid : (n,) array [m]
    recorded : (time [ns since 1970 UTC], speed [m/s]), optional
        The speed is read of it; without, it is the mean over a step of the grid to either side.

    Examples
    --------
    >>> curve = TimeDistance(0, np.array([0, 10**10]), np.array([0.0, 200.0]))
    >>> on_grid(curve, np.array([0.0, 100.0, 200.0])).speed
    array([20., 20., 20.])
    """
    time = np.where(curve.in_gap(grid), np.nan, curve.arrival_at(grid))
    if recorded is not None and recorded[0].size:
        instants = (recorded[0] - curve.start) / NANOSECONDS
        speed = np.interp(time, instants, recorded[1], left=np.nan, right=np.nan)
    elif grid.size > 1:
        with np.errstate(invalid="ignore", divide="ignore"):
            speed = 1.0 / np.gradient(time, grid)
    else:
        speed = np.full(grid.shape, np.nan)
    return OnGrid(grid, time, np.asarray(speed))


STANDING_PACE = 1.0
"""Mean speed between two nodes below which a train stood there [m/s]."""

STOPS_APART = 60.0
"""Two trains that stand within such a distance stand at the same place [m]."""


def difference(trip: OnGrid, reference: OnGrid) -> OnGrid:
    """How far a trip is behind a reference, and how much faster, at each node of their grid.

    Time is what was lost since the first node that both reached, negative where gained; time and
    speed are NaN outside of both.

    Raises
    ------
    InputError
        If they are on different grids.

    Examples
    --------
    >>> grid = np.array([0.0, 100.0])
    >>> fast = OnGrid(grid, np.array([0.0, 5.0]), np.array([20.0, 20.0]))
    >>> slow = OnGrid(grid, np.array([60.0, 70.0]), np.array([10.0, 10.0]))
    >>> difference(slow, fast).time, difference(slow, fast).speed
    (array([0., 5.]), array([-10., -10.]))
    """
    if not np.array_equal(trip.position, reference.position):
        raise InputError("trip and reference are on different grids", remedy="take one for both")
    lost, place = trip.time - reference.time, trip.position
    # Of a stop that both make a few metres apart one has stood already, and the other has not.
    own, other = (
        np.flatnonzero(np.diff(each.time) > np.diff(place) / STANDING_PACE)
        for each in (trip, reference)
    )
    for begin, end in np.sort([(one, two) for one in own for two in other if one != two]):
        if place[end] - place[begin] <= STOPS_APART:
            ends, inner = [begin, end + 1], slice(begin + 1, end + 1)
            lost[inner] = np.interp(place[inner], place[ends], lost[ends])
    both = np.flatnonzero(np.isfinite(lost))
    since = lost[both[0]] if both.size else 0.0
    return OnGrid(trip.position, lost - since, trip.speed - reference.speed)


def known_rows(trip: Trip, topic: str, *names: str) -> tuple[Any, ...] | None:
    """Time and columns of the rows of `topic` in which all of `names` are known; None if none."""
    if topic not in trip:
        return None
    frame = trip[topic]
    if any(name not in frame for name in names):
        return None
    values = [frame[name].to_numpy(dtype=np.float64) for name in names]
    known = np.all(np.isfinite(values), axis=0)
    if not known.any():
        return None
    return nanoseconds(frame)[known], *(column[known] for column in values)


def _run(latitude: FloatArray, longitude: FloatArray) -> FloatArray:
    """Distance run along fixes [deg] since the first [m], on a sphere and from fix to fix."""
    north = np.radians(np.diff(latitude))
    east = np.radians(np.diff(longitude)) * np.cos(np.radians(latitude[:-1]))
    return np.concatenate(([0.0], np.cumsum(EARTH_RADIUS * np.hypot(north, east))))

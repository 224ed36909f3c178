"""Values that freeze: a column repeats itself, bit for bit, while the train moves on.

A train at rest repeats itself rightly, a coarse speed rests while the train cruises, and so does an
exact one that is controlled to be constant. What distinguishes a frozen value is the other evidence
and the column itself:

- it trembles everywhere else at such values, so that not even a constant quantity would repeat;
- speeds, positions and fixes move otherwise than it says, and they do otherwise agree with it;
- with neither, it rests far longer than usual and then jumps.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid

from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray, robust_std
from trainlog.ingest.clock import Result, gap_threshold
from trainlog.ingest.motion import (
    EFFORTS,
    ELSEWHERE,
    GATE,
    GNSS_SPEED,
    LATITUDE,
    LONGITUDE,
    MANY,
    MOVING,
    POSITION,
    RESTING,
    SEVERAL,
    SPAN,
    SPEED,
    SPEED_STD,
    STANDING,
    STEEPEST,
    WHEEL_SPEED,
    Agreement,
    agreement,
    covered,
    plane,
    repeats,
    seconds_of,
)
from trainlog.ingest.profile import Limits
from trainlog.ingest.recording import MOST, Finding, Table, field_of
from trainlog.trip import Trip

Column = FloatArray | ComplexArray

MEASURED = ("/train/state", "/train/controls", "/train/axles", "/gnss/fix", "/gnss/motion", "/imu")
"""Topics that are measured at every instant; others, such as the weather, rest."""

UNUSUAL = 10.0
"""Ratio to the usual number of repeats beyond which a run of them is unusual."""

USUAL_FIX_STD = 3.0
"""Standard deviation of that difference [m/s] where it is not known, of the speed by fixes."""

BEYOND = 1.5
"""Ratio to the largest unexplained acceleration elsewhere that speaks against an effort."""


@dataclass(frozen=True, eq=False)
class Runs:
    """Stretches in which a column repeats one value.

    Attributes
    ----------
    first, last : (k,) int64 array
        First and last row of each.
    value : (k,) array
    before, after : (k,) array
        Size of the jump to it and from it; NaN at the ends of the file and at gaps.
    step : float
        The column's smallest usual change.
    usual_jump : float
        What hardly any change exceeds.
    usual_repeats : float
        Samples that hardly any other run exceeds.
    samples : (k,) int64 array
        How many there are in each.
    """

    first: IntArray
    last: IntArray
    value: Column
    before: FloatArray
    after: FloatArray
    step: float
    usual_jump: float
    usual_repeats: float
    samples: IntArray

    def rows(self, chosen: BoolArray, size: int) -> BoolArray:
        """The rows of the chosen runs but for the first of each, which was measured."""
        return covered(self.first[chosen] + 1, self.last[chosen] + 1, size)

    def leaps(self, seconds: FloatArray, values: Column) -> BoolArray:
        """Which of them begin or end with a change that no train's speed makes at once."""
        known = np.flatnonzero(np.isfinite(values))
        apart = np.diff(seconds[known], prepend=-np.inf, append=np.inf)
        first, last = (np.searchsorted(known, rows) for rows in (self.first, self.last))
        most = self.step + STEEPEST * np.array([apart[first], apart[last + 1]])
        return np.asarray(np.any(np.array([self.before, self.after]) > most, axis=0))

    @property
    def broken(self) -> BoolArray:
        """Which of them begin or end with an unusual jump, or where nothing follows."""
        most = max(1.5 * self.step, self.usual_jump)
        return np.asarray((self.before > most) | ~(self.after <= most))


def long_runs(seconds: FloatArray, values: Column, gap: float) -> Runs | None:
    """The runs of at least `RESTING`; None if there are none.

    Parameters
    ----------
    seconds : (n,) array [s]
    values : (n,) array
        NaN where absent; complex for places in a plane.
    gap : float [s]
        Time between two samples that ends a run.
    """
    known = np.flatnonzero(np.isfinite(values))
    if known.size < SEVERAL:
        return None
    column, at = values[known], seconds[known]
    found = repeats(values, np.flatnonzero(np.diff(at) > gap))
    first, last, samples = found.first, found.last, found.samples
    long = (samples >= SEVERAL) & (at[last] - at[first] >= RESTING)
    if not long.any():
        return None
    jump = np.abs(column[first[1:]] - column[last[:-1]])
    jump[at[first[1:]] - at[last[:-1]] > gap] = np.nan
    moved = jump[jump > 0.0]
    others = samples[~long]
    small, large = np.percentile(moved, (5.0, 99.0)).tolist() if moved.size else (0.0, 0.0)
    return Runs(
        known[first[long]],
        known[last[long]],
        column[first[long]],
        np.concatenate(([np.nan], jump))[long],
        np.concatenate((jump, [np.nan]))[long],
        small,
        large if moved.size > 20 else 0.0,
        float(np.percentile(others, 95.0)) if others.size else 1.0,
        samples[long],
    )


def blank_frozen(table: Table, limits: Limits) -> Result:
    """Take away values that a recorder or a receiver repeated while the train moved on.

    The first of each run is kept: it was measured.
    """
    motion = _Motion(table, limits)
    for name in table.signals:
        topic, column, item = field_of(name)
        if topic.name not in MEASURED or item.interpolation != "linear":
            continue
        if not column.endswith("accuracy") and name not in (LATITUDE, LONGITUDE):
            motion.add(name, table.signals[name])
    places = plane(table)
    if places is not None:
        motion.add(LATITUDE, places)
    if not motion.runs:
        return table, []
    frozen = {name: motion.trembling(name) for name in motion.runs}
    for name in (POSITION, LATITUDE):
        if name in motion.runs:
            motion.exclude(frozen)
            frozen[name] |= motion.stayed(name)
    for name in motion.runs:
        if is_speed(name):
            motion.exclude(frozen)
            frozen[name] |= motion.contradicted(name)
    motion.exclude(frozen)
    for name, unexplained in motion.unexplained(frozen).items():
        frozen[name] |= unexplained
    return _without(table, motion, frozen)


def without_frozen(trip: Trip) -> tuple[Trip, list[Finding]]:
    """A trip without values that were repeated while the train moved on, and what they are.

    For logs that ingest has not seen; of what it has made nothing is found.

    Examples
    --------
    >>> import trainlog
    >>> without_frozen(trainlog.read("sample_logs/stopping.mcap"))[1]
    []
    """
    clocks: dict[bytes, list[tuple[str, pd.DataFrame]]] = {}
    for name in MEASURED:
        frame = trip.topics.get(name)
        if frame is not None and len(frame) > 1:
            clock = pd.DatetimeIndex(frame.index).as_unit("ns").asi8
            clocks.setdefault(clock.tobytes(), []).append((name, frame))
    every: list[Finding] = []
    for frames in clocks.values():
        time = pd.DatetimeIndex(frames[0][1].index).as_unit("ns").asi8
        columns = {
            f"{name}.{column}": frame[column].to_numpy(np.float64)
            for name, frame in frames
            for column in frame.columns
        }
        table = Table(time, np.arange(time.size, dtype=np.int64), columns)
        table, findings = blank_frozen(table, Limits())
        every += findings
        for name, frame in frames if findings else ():
            kept = {column: table.signals[f"{name}.{column}"] for column in frame.columns}
            found = frame.assign(**kept)
            found.attrs = frame.attrs
            trip = trip.with_topic(found)
    return trip, every


def _without(table: Table, motion: _Motion, frozen: dict[str, BoolArray]) -> Result:
    findings: list[Finding] = []
    for name, chosen in frozen.items():
        if not chosen.any():
            continue
        runs = motion.runs[name]
        rows = runs.rows(chosen, len(table))
        lasted = (motion.seconds[runs.last] - motion.seconds[runs.first])[chosen]
        note = f"{lasted.size} times, longest {lasted.max():.0f} s"
        for column in (LATITUDE, LONGITUDE) if name == LATITUDE else (name,):
            cells = rows & np.isfinite(table.signals[column])
            topic, _, item = field_of(column)
            findings += table.found("frozen", cells, f"{topic.name}.{item.name}", note)
            table = table.without(column, rows)
    return table, findings


def is_speed(name: str) -> bool:
    """Whether a column holds a speed of the train or of a wheel."""
    return name in (SPEED, GNSS_SPEED) or name.startswith(WHEEL_SPEED)


@dataclass(eq=False)
class _Motion:
    """The columns of a table, their runs, and how fast each says that the train moves.

    Attributes
    ----------
    runs : dict of str to Runs
        Of the columns that have any.
    pace : dict of str to (w,) array [m/s]
        Mean speed in each window by each speed, the position and the fixes; NaN where unknown.
    frozen : dict of str to (w,) bool array
        Windows in which a column is known to be frozen.
    """

    table: Table
    limits: Limits
    seconds: FloatArray = field(init=False)
    edges: FloatArray = field(init=False)
    gap: float = field(init=False)
    values: dict[str, Column] = field(default_factory=dict)
    runs: dict[str, Runs] = field(default_factory=dict)
    pace: dict[str, FloatArray] = field(default_factory=dict)
    excluded: dict[str, BoolArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.seconds = seconds_of(self.table)
        self.edges = np.arange(0.0, self.seconds[-1] + 1e-9, SPAN)
        self.gap = gap_threshold(self.table.time, self.limits)

    def add(self, name: str, values: Column) -> None:
        """Take in a column."""
        runs = long_runs(self.seconds, values, max(self.gap, SPAN))
        self.values[name] = values
        if runs is not None:
            self.runs[name] = runs

    def paces(self) -> dict[str, FloatArray]:
        """`pace`, computed when it is first needed."""
        if not self.pace:
            for name, values in self.values.items():
                if is_speed(name) or name in (POSITION, LATITUDE):
                    self.pace[name] = self._pace(values, is_speed(name))
                    self.excluded[name] = np.zeros(self.pace[name].size, dtype=np.bool_)
        return self.pace

    def _pace(self, values: Column, is_rate: bool) -> FloatArray:
        known = np.isfinite(values)
        found = np.full(max(0, self.edges.size - 1), np.nan)
        if np.count_nonzero(known) < 2 or not found.size:
            return found
        at, column = self.seconds[known], values[known]
        if is_rate:
            column = cumulative_trapezoid(column, at, initial=0.0)
        moved = np.diff(np.interp(self.edges, at, column))
        late = np.flatnonzero(np.diff(at) > max(self.gap, SPAN / 2.0))
        inside = (self.edges[:-1] >= at[0]) & (self.edges[1:] <= at[-1])
        # Windows that overlap a gap.
        begin = np.searchsorted(self.edges, at[late], side="right") - 1
        end = np.searchsorted(self.edges, at[late + 1], side="left")
        inside &= ~covered(begin, end, found.size)
        found[inside] = np.abs(moved[inside]) / SPAN
        return found

    def windows(self, name: str) -> tuple[IntArray, IntArray]:
        """First window within each run of a column, and the first beyond."""
        runs = self.runs[name]
        first = np.ceil(self.seconds[runs.first] / SPAN - 1e-9).astype(np.int64)
        beyond = np.floor(self.seconds[runs.last] / SPAN + 1e-9).astype(np.int64)
        return first, np.maximum(first, np.minimum(beyond, self.edges.size - 1))

    def exclude(self, frozen: dict[str, BoolArray]) -> None:
        """Do not use columns where they are known to be frozen."""
        for name, pace in self.paces().items():
            if name in frozen:
                self.excluded[name] = self._covered(name, frozen[name], pace.size)

    def _covered(self, name: str, chosen: BoolArray, size: int) -> BoolArray:
        """Windows that overlap the chosen runs of a column."""
        runs = self.runs[name]
        first = np.floor(self.seconds[runs.first[chosen]] / SPAN).astype(np.int64)
        last = np.ceil(self.seconds[runs.last[chosen]] / SPAN).astype(np.int64)
        return covered(first, last, size)

    def trembling(self, name: str) -> BoolArray:
        """Which runs are of a column that never rests at such values while the train moves."""
        runs = self.runs[name]
        none = np.zeros(runs.value.size, dtype=np.bool_)
        if name in (POSITION, LATITUDE):
            return none
        unusual = (runs.value != 0.0) & (runs.samples >= UNUSUAL * runs.usual_repeats)
        unusual &= self._moving(name)
        if not unusual.any():
            return none
        values = self.values[name]
        known = np.isfinite(values)
        resting = runs.rows(np.ones(runs.value.size, dtype=np.bool_), values.size)
        column = values[known & ~resting]
        octave = np.floor(np.log2(np.abs(np.where(unusual, runs.value, 1.0))))
        found = none
        for power in np.unique(octave[unusual]):
            if _trembles(column, 2.0**power, runs.step):
                found |= unusual & (octave == power)
        return found

    def _moving(self, name: str) -> BoolArray:
        """During which runs the train moves, by any speed; always for an IMU."""
        runs = self.runs[name]
        if is_speed(name):
            return np.abs(runs.value) > STANDING
        moving = np.full(runs.value.size, name.startswith("/imu"))
        first, beyond = self.windows(name)
        for other, pace in self.paces().items():
            if is_speed(other):
                way = _sums(np.nan_to_num(pace), first, beyond)
                moving |= way > STANDING * (beyond - first)
        return moving

    def stayed(self, name: str) -> BoolArray:
        """During which runs of a position the train was driven on."""
        runs = self.runs[name]
        first, beyond = self.windows(name)
        least = ELSEWHERE + 3.0 * runs.step
        driven = np.zeros(runs.value.size)
        for other, pace in self.paces().items():
            if is_speed(other):
                resting = np.zeros(pace.size, dtype=np.bool_)
                if other in self.runs:
                    resting = self._covered(other, self.runs[other].value != 0.0, pace.size)
                usable = (pace > MOVING) & ~self.excluded[other] & ~resting
                way = _sums(np.where(usable, pace * SPAN, 0.0), first, beyond)
                driven = np.maximum(driven, way)
        return driven > least

    def contradicted(self, name: str) -> BoolArray:
        """Which runs of a speed the other columns contradict, or nothing confirms."""
        runs = self.runs[name]
        own = self.paces()[name]
        resting = self._covered(name, np.ones(runs.value.size, dtype=np.bool_), own.size)
        compared = []
        for other, pace in self._others(name).items():
            live = ~resting & (own > MOVING) & (pace > MOVING)
            usual = Agreement(1.0, USUAL_FIX_STD if LATITUDE in (name, other) else SPEED_STD)
            ratio, std, _ = agreement(own, pace, live) or usual
            allowed = runs.step + STANDING + GATE * std
            compared.append(self._compared(name, own - ratio * pace, std, allowed))
        contradicted, asked = _verdict(compared, runs)
        # No train changes its speed so at once: the receiver had held it, and wheels do not slip.
        if name == GNSS_SPEED:
            contradicted |= (runs.value != 0.0) & runs.leaps(self.seconds, self.values[name])
        # Nothing to compare with: it rests far longer than it ever does, and then jumps.
        jumps = np.fmax(runs.before, runs.after) > 3.0 * max(runs.step, runs.usual_jump)
        unusual = (runs.samples >= UNUSUAL * runs.usual_repeats) & (runs.value != 0.0)
        return np.asarray(contradicted | (~asked & unusual & jumps))

    def _compared(self, name: str, off: FloatArray, std: float, allowed: float) -> Compared:
        """How far the windows within each run of a column are off what another says."""
        first, beyond = self.windows(name)
        known = np.isfinite(off)
        number, square, beside = (
            _sums(part, first, beyond)
            for part in (known, np.where(known, off, 0.0) ** 2, np.abs(off) > allowed)
        )
        size = np.sqrt(square / np.maximum(number, 1.0))
        mostly = beside >= 0.5 * number
        return Compared(std, number, (number > 0) & ((size > allowed) | mostly), mostly)

    def unexplained(self, frozen: dict[str, BoolArray]) -> dict[str, BoolArray]:
        """During which runs of an effort the train accelerates in another way than it explains.

        Acceleration is a linear function of all efforts, and of speed and its square, whose
        coefficients are those of the other windows.
        """
        source = SPEED if SPEED in self.paces() else GNSS_SPEED
        speed = self.paces().get(source)
        names = [name for name in self.runs if name.startswith(EFFORTS)]
        none = {name: np.zeros(self.runs[name].value.size, dtype=np.bool_) for name in names}
        if not names or speed is None or speed.size < MANY:
            return none
        speed = np.where(self.excluded[source], np.nan, speed)
        # Efforts are averaged over the two windows whose mean speeds are compared.
        acceleration = np.append(np.diff(speed), np.nan) / SPAN
        efforts = {name: self.values[name] for name in self.values if name.startswith(EFFORTS)}
        mean = [self._pace(values, is_rate=True) for values in efforts.values()]
        mean = [0.5 * (each + np.append(each[1:], np.nan)) for each in mean]
        columns = np.column_stack([*mean, np.ones(speed.size), speed, speed**2])
        known = np.isfinite(columns).all(axis=1) & np.isfinite(acceleration) & (speed > STANDING)
        live = known.copy()
        for name in names:
            # What another effort does while one is known to be frozen is not known.
            known &= ~self._covered(name, frozen[name], speed.size)
            live &= ~self._covered(name, self.runs[name].value != 0.0, speed.size)
        if np.count_nonzero(live) < MANY:
            return none
        scale = np.maximum(np.max(np.abs(columns[live]), axis=0), 1e-9)
        found = np.linalg.lstsq(columns[live] / scale, acceleration[live], rcond=None)[0]
        off = np.where(known, acceleration - columns @ (found / scale), np.nan)
        size = np.abs(off[live])
        if np.sqrt(np.mean(size**2)) > MOST * np.std(acceleration[live]):
            return none
        allowed = max(GATE * robust_std(size), BEYOND * float(np.max(size)))
        # Of two efforts that rest at the same time the one that does so longer is doubted first.
        took = {n: np.max(self.runs[n].last - self.runs[n].first) for n in names}
        for name in sorted(names, key=lambda n: -took[n]):
            column = columns[:, list(efforts).index(name)]
            if np.count_nonzero(live & (column != 0.0)) < MANY:
                off[self._covered(name, self.runs[name].value != 0.0, off.size)] = np.nan
                continue
            compared = self._compared(name, off, 1.0, allowed)
            none[name] = _verdict([compared], self.runs[name])[0] & (self.runs[name].value != 0.0)
            off[self._covered(name, none[name], off.size)] = np.nan
        return none

    def _others(self, name: str) -> dict[str, FloatArray]:
        """What says how fast the train moves, but for the column itself; all wheels are one."""
        found: dict[str, FloatArray] = {}
        wheels: list[FloatArray] = []
        for other, pace in self.paces().items():
            if other == name:
                continue
            live = np.where(self.excluded[other], np.nan, pace)
            if is_speed(other) and other in self.runs:
                runs = self.runs[other]
                live[self._covered(other, runs.value != 0.0, live.size)] = np.nan
            if other.startswith(WHEEL_SPEED):
                wheels.append(live)
            else:
                found[other] = live
        if wheels:
            stacked = np.array(wheels)
            some = np.isfinite(stacked).any(axis=0)
            median = np.full(some.size, np.nan)
            median[some] = np.nanmedian(stacked[:, some], axis=0)
            found[WHEEL_SPEED] = median
        return found


@dataclass(frozen=True, eq=False)
class Compared:
    """The runs of a column beside another.

    Attributes
    ----------
    std : float
        Of their usual difference.
    number : (k,) array
        Windows of each run in which both are known.
    against : (k,) bool array
        Whether the other contradicts the run.
    mostly : (k,) bool array
        Whether it does in most windows.
    """

    std: float
    number: FloatArray
    against: BoolArray
    mostly: BoolArray


def _verdict(compared: list[Compared], runs: Runs) -> tuple[BoolArray, BoolArray]:
    """Which runs are contradicted, and which are compared with anything.

    Of several columns those that agree best elsewhere count.
    """
    if not compared:
        none = np.zeros(runs.value.size, dtype=np.bool_)
        return none, none
    std = np.array([[each.std] for each in compared])
    there = np.array([each.number > 0 for each in compared])
    sharp = there & (std <= 2.0 * np.min(np.where(there, std, np.inf), axis=0))
    against = np.array([each.against for each in compared]) & sharp
    often = np.array([each.mostly & (each.number >= 3) for each in compared]) & against
    asked = sharp.any(axis=0)
    most = 2 * against.sum(axis=0) >= sharp.sum(axis=0)
    return asked & most & (runs.broken | often.any(axis=0)), asked


def _sums(values: FloatArray | BoolArray, first: IntArray, beyond: IntArray) -> FloatArray:
    """Sums of some stretches, each from `first` to before `beyond`."""
    total = np.concatenate(([0.0], np.cumsum(values, dtype=np.float64)))
    return np.asarray(total[beyond] - total[first])


def _trembles(column: Column, size: float, step: float) -> bool:
    """Whether a column has noise of more than a step among values of about that size."""
    like = (np.abs(column) >= 0.5 * size) & (np.abs(column) < 4.0 * size)
    bend = np.diff(column, 2)[like[:-2] & like[1:-1] & like[2:]]
    if bend.size < MANY:
        return False
    # Noise turns at every sample, a motion does not.
    signs = np.sign(bend)
    alternating = bool(np.mean(signs[1:] * signs[:-1]) < 0.0)
    return alternating and bool(robust_std(bend) / np.sqrt(6.0) >= step)

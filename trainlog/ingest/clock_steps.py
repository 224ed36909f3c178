"""Clocks that were set while they recorded: the rows on the wrong side are put back.

A clock is set by 1024 weeks where the receiver's week number rolled over, by whole days where it
had no date before its first fix, by quarters of an hour where the time zone or summer time was
corrected, by seconds where the receiver learnt the leap seconds or the recorder the time. A step
back gives times twice. A step forward looks like a gap. How far the train came meanwhile decides
whether rows are missing or the clock was set: distances over 5 and 20 s before and after the step,
against how they usually depart from the speeds in this recording. Where that leaves it open, or
both seem to have happened, the step is reported and left as it is.

Rows of both clocks may be mixed for a while. Then it is the count of rows since the last one before
and to the first one after that shows by which clock each was written.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import cumulative_trapezoid

from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray, robust_std
from trainlog.ingest.clock import (
    Result,
    has_fix,
    longest_nondecreasing,
    outside_largest_group,
    rows_per_second,
    same_as_previous,
    usual_step,
)
from trainlog.ingest.motion import (
    ENOUGH,
    GATE,
    GNSS_SPEED,
    MOVING,
    POSITION,
    SPEED,
    agreement,
    plane,
    seconds_of,
    speed_of,
)
from trainlog.ingest.profile import Limits
from trainlog.ingest.receiver import LOSS_DENSITY
from trainlog.ingest.recording import Finding, Table
from trainlog.units import DAY, NANOSECONDS

ROLLOVER = 1024 * 7 * DAY
"""Weeks of GPS time are counted modulo 1024 [ns]."""

QUARTER = 900 * NANOSECONDS
"""Time zones differ by multiples of a quarter of an hour [ns]."""

EARLY = np.datetime64("2007-01-01").astype("datetime64[ns]").astype(np.int64)
"""Time [ns] before which a recording is rather one of today with a week number that rolled over."""

MOST_ZONE = 14 * 3600 * NANOSECONDS
"""Time zones span 26 hours, but nobody sets a clock by more than so much [ns]."""

REAL = 5 * NANOSECONDS
"""Time that may really pass while a clock is set [ns]."""

MAJORITY = 2.0 / 3.0
"""Share of the rows that a date must have to be the right one."""

MOST_EDGES = 50
"""Steps beyond which it is not the clock that was set."""

CHAIN = 15.0
"""Time [s] between two steps that may belong to one setting of the clock."""

MOST_MISFITS = 0.05
"""Share of rows between the first and the last step that may fit neither clock."""

LEAST_CHANGES = 5
"""Changes from one clock to the other that it takes to call them mixed."""

LEAST_STEP = 0.6
"""Smaller steps [s] are left: receivers themselves are late by as much."""

LARGEST = 60.0, 900.0
"""Longer steps forward [s] are pauses, after which a receiver may begin where it left off; longer
ones back are of zones and dates."""

BRAKING, STARTING = 1.2, 1.0
"""Braking and acceleration [m/s²] with which any train may have become slower, or faster, and as
fast as before again, unseen."""

WINDOWS = 2.0, 20.0
"""Times [s] before and after a step over which distances are compared: a receiver that begins late
after a gap has caught up within the longer one."""

SMALLEST_STD = 0.2
"""Standard deviation [m] that no distance undercuts."""

LEAP = 0.3
"""Part of a step back by which the clock leaps on at least behind rows that were written late."""

LEAST_SIZE, LONGEST_TAKEN = 2.0, 60.0
"""A clock that was set while rows were missing is put right by a size of at least so many standard
deviations, where they are missing no longer [s]."""

LEAST_AROUND = 2
"""Rows, one a second, without another step that there must be on both sides."""

SURE = 6.0
"""How much likelier (logarithm) a setting must be than missing rows to be undone."""


def undo_clock_steps(table: Table, limits: Limits) -> Result:
    """Put the rows before or after a step of the clock where they belong.

    Of two levels of the clock the last one is right, as clocks are set to be; for 1024 weeks the
    later one, for time zones the one that holds for more rows, for whole days too, unless it is the
    date of a receiver that knows none. Rows are moved only if that brings more rows into order, or
    if the motion across the step shows that the clock was set.
    """
    time = table.time
    if len(table) < ENOUGH:
        return table, []
    shift = _too_early(time, limits)
    shift = shift + _coarse(time + shift, limits)
    shift = shift + _to_last(_seconds(table.at(time + shift))[0])
    if not shift.any():
        return table, []
    sizes = ", ".join(_size(int(size)) for size in np.unique(shift[shift != 0]))
    note = f"moved by {sizes}"
    return table.at(time + shift), table.found("clock_step", shift != 0, note=note)


def suspect_clock_steps(table: Table, limits: Limits) -> Result:
    """Report what may be steps of the clock, and what may be dates of another week count."""
    findings: list[Finding] = []
    if len(table) < ENOUGH:
        return table, findings
    undecided = _seconds(table)[1]
    if undecided:
        marked = np.zeros(len(table), dtype=np.bool_)
        marked[[place + 1 for place, _ in undecided]] = True
        sizes = ", ".join(f"{size:+.2g} s" for _, size in undecided)
        note = f"{sizes}: a gap, a step of the clock or both, which the motion leaves open"
        findings += table.found("clock_step_suspected", marked, note=note)
    if limits.not_before is None and table.time[-1] < EARLY and has_fix(table) is not None:
        first = np.arange(len(table)) == 0
        note = (
            f"all dates are of {str(table.time[0].astype('datetime64[ns]'))[:4]}: 1024 weeks too"
            " early? not_before under [limits] puts them right"
        )
        findings += table.found("clock_step_suspected", first, note=note)
    return table, findings


def _too_early(time: IntArray, limits: Limits) -> IntArray:
    """What brings times from before the recorder existed into the weeks after that [ns]."""
    if limits.not_before is None:
        return np.zeros(time.size, dtype=np.int64)
    earliest = np.datetime64(limits.not_before).astype("datetime64[ns]").astype(np.int64)
    shift = -np.minimum((time - earliest) // ROLLOVER, 0) * ROLLOVER
    undated = _undated(time)
    # Rows without a date follow those that have one, if there are such.
    return np.asarray(shift if undated.all() else np.where(undated, 0, shift))


def _size(shift: int) -> str:
    if shift % ROLLOVER == 0:
        return f"{1024 * (shift // ROLLOVER):+d} weeks"
    if shift % DAY == 0:
        return f"{shift // DAY:+d} days"
    return f"{round(shift / NANOSECONDS, 2):+.9g} s"


# ------------------------------------------------------------------ weeks, days and time zones


def _coarse(time: IntArray, limits: Limits) -> IntArray:
    """What undoes steps by weeks, days and quarters of an hour [ns]."""
    none = np.zeros(time.size, dtype=np.int64)
    if not np.any(np.diff(time) < 0) and np.ptp(time) < DAY:
        return none
    weeks = _edges(time, ROLLOVER, limits.pause * NANOSECONDS)
    days = np.where(weeks == 0, _edges(time, DAY), 0)
    others = np.where((weeks == 0) & (days == 0), _edges(time, QUARTER), 0)
    others[np.abs(others) > MOST_ZONE] = 0
    if not np.any(others < 0):
        others[:] = 0
    edges = np.count_nonzero(weeks) + np.count_nonzero(days) + np.count_nonzero(others)
    if not 0 < edges <= MOST_EDGES:
        return none
    shift = _to_latest(_levels(weeks)) + _to_dated(time, _levels(days)) + _to_most(_levels(others))
    before, after = _disorder(time, limits.pause), _disorder(time + shift, limits.pause)
    return shift if after < before else none


def _levels(edges: IntArray) -> IntArray:
    """How far the clock is off in each row, against the first [ns]."""
    return np.concatenate(([0], np.cumsum(edges)))


def _to_most(levels: IntArray) -> IntArray:
    """What puts every row on the level of the most rows."""
    values, counts = np.unique(levels, return_counts=True)
    return np.asarray(values[np.argmax(counts)] - levels)


def _to_latest(levels: IntArray) -> IntArray:
    """What puts every row on the latest level that is no slip of a few rows."""
    values, counts = np.unique(levels, return_counts=True)
    real = values[(counts >= ENOUGH) | (counts == counts.max())]
    return np.asarray(real.max() - levels)


def _to_last(levels: IntArray) -> IntArray:
    """What puts every row on the last level that is no slip of a few rows: clocks are set right."""
    _, owner, counts = np.unique(levels, return_inverse=True, return_counts=True)
    real = np.flatnonzero((counts >= ENOUGH)[owner] | (counts == counts.max())[owner])
    return np.asarray(levels[real[-1]] - levels)


UNDATED = (
    np.datetime64("1980-01-06"),
    np.datetime64("1999-08-22"),
    np.datetime64("2000-01-01"),
    np.datetime64("2019-04-07"),
    np.datetime64("2080-01-06"),
)
"""Days on which receivers begin that know none: of GPS, its week counts, and of their clocks."""


def _undated(time: IntArray) -> BoolArray:
    """Which times are of a day that stands for none."""
    return np.isin(time.astype("datetime64[ns]").astype("datetime64[D]"), UNDATED)


def _to_dated(time: IntArray, levels: IntArray) -> IntArray:
    """What puts every row on the date of most rows whose receiver knew one.

    Nothing where no date is that of two thirds of them, and nothing for a few rows with another.
    """
    none = np.zeros(levels.size, dtype=np.int64)
    undated = _undated(time)
    if undated.all() or not levels.any():
        return none
    values, counts = np.unique(levels[~undated], return_counts=True)
    if counts.max() < MAJORITY * counts.sum():
        return none
    right = values[np.argmax(counts)]
    few = values[counts < ENOUGH]
    return np.where(~undated & np.isin(levels, few), 0, right - levels)


def _edges(time: IntArray, unit: int, real: float = REAL) -> IntArray:
    """Steps by multiples of a unit [ns], besides which `real` may have passed; 0 where none is."""
    step = np.diff(time)
    count = np.floor_divide(step + int(real), unit)
    return np.where(np.abs(step - count * unit) <= real, count * unit, 0)


def _disorder(time: IntArray, pause: float) -> int:
    """How many rows are out of order, or do not belong to the trip."""
    return int(np.count_nonzero(~longest_nondecreasing(time) | outside_largest_group(time, pause)))


# ------------------------------------------------------------------ seconds


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows in the order of the file, with a time that goes on within whole seconds.

    Attributes
    ----------
    table : Table
    time : (n,) array [s]
        Since the first row.
    period : float [s]
        Between two rows.
    whole : bool
        Whether the file gives whole seconds only, several rows each.
    late : (n - 1,) array [s]
        How much later than a period after the row before each row is.
    steps : (m,) array of int
        Rows after which that is more than gaps of a row or two explain.
    """

    table: Table
    time: FloatArray
    period: float
    whole: bool
    late: FloatArray
    steps: IntArray

    @classmethod
    def of(cls, table: Table) -> _Rows | None:
        """The rows of a table; None if they come too rarely."""
        usual = rows_per_second(table)
        seconds = seconds_of(table)
        if usual > 1:
            time, period = _with_fractions(seconds, usual), 1.0 / usual
        else:
            time, period = seconds, usual_step(table.time)
        if period <= 0.0 or period > 2.0:
            return None
        late = np.diff(time) - period
        steps = (np.abs(late) > max(LEAST_STEP, 0.7 * period)) | (np.diff(seconds) < 0.0)
        return cls(table, time, period, usual > 1, late, np.flatnonzero(steps))

    def size(self, before: int, after: int) -> float:
        """How far [s] the clock goes ahead between two rows beyond what their number takes."""
        return float(self.time[after] - self.time[before] - (after - before) * self.period)


def _with_fractions(seconds: FloatArray, usual: int) -> FloatArray:
    """Times of rows of whole `seconds`, of which `usual` make a second, in the order of the file.

    A second of fewer rows is filled from its end where it begins after a step, else from its
    begin; one of twice the rows is two seconds.
    """
    count = seconds.size
    new = np.concatenate(([True], np.diff(seconds) != 0.0))
    first = np.flatnonzero(new)
    sizes = np.diff(np.append(first, count))
    twice = sizes >= 2 * usual - 1
    first = np.sort(np.concatenate((first, (first + sizes - usual)[twice])))
    sizes = np.diff(np.append(first, count))
    group = np.repeat(np.arange(first.size), sizes)
    rank = np.arange(count) - first[group]
    value = seconds[first]
    goes_on = np.diff(value) == 1.0
    after_step = np.concatenate(([True], ~goes_on)) & np.concatenate((goes_on, [False]))
    # Two short seconds that together make one: the clock went ahead by one between them.
    short = sizes < usual - 1
    pair = short[1:] & short[:-1] & (np.abs(sizes[1:] + sizes[:-1] - usual) <= 1) & goes_on
    after_step |= np.concatenate(([False], pair))
    from_end = (after_step & (sizes < usual))[group]
    rest = np.maximum(usual - sizes, 0)[group]
    return np.asarray(seconds + (rank + np.where(from_end, rest, 0)) / usual)


def _seconds(table: Table) -> tuple[IntArray, list[tuple[int, float]]]:
    """How far [ns] steps of seconds set the clock; undecided ones by row and size [s]."""
    if rows_per_second(table) == 1:
        doubled = same_as_previous(table) & (np.diff(table.time, prepend=table.time[0] - 1) == 0)
        if doubled.any():
            single = np.flatnonzero(~doubled)
            shift, open_ = _seconds(table.take(single))
            behind = np.cumsum(~doubled) - 1
            return shift[behind], [(int(single[place]), size) for place, size in open_]
    level = np.zeros(len(table))
    rows = _Rows.of(table)
    if rows is None or not rows.steps.size:
        return level.astype(np.int64), []
    clusters = np.split(rows.steps, np.flatnonzero(np.diff(rows.steps) * rows.period > CHAIN) + 1)
    if len(clusters) > MOST_EDGES:
        return level.astype(np.int64), []
    motion = _Motion.of(rows)
    undecided: list[tuple[int, float]] = []
    for cluster in clusters:
        mixed = _mixed(rows, cluster)
        if mixed is not None:
            size, ahead = mixed
            level[cluster[0] + 1 : cluster[-1] + 1] += size * ahead
            level[cluster[-1] + 1 :] += size
            continue
        for place in cluster.tolist():
            size, sure = _set_by(rows, motion, place)
            if sure:
                level[place + 1 :] += size
            elif abs(size) > 1.5 * rows.period:  # else a row is lost, or one too many
                undecided.append((place, size))
    return np.round(level * NANOSECONDS).astype(np.int64), undecided


def _mixed(rows: _Rows, steps: IntArray) -> tuple[float, IntArray] | None:
    """By how many seconds the clock was set while rows of both clocks were written in turn.

    And which rows from the first step to the last one are by the new clock; None if they are not
    so mixed.
    """
    if steps.size < LEAST_CHANGES:
        return None
    before, after = int(steps[0]), int(steps[-1]) + 1
    size = rows.size(before, after)
    if abs(size) < LEAST_STEP:
        return None
    size = round(size) if rows.whole else size
    inner = np.arange(before + 1, after)
    by_count = rows.time[before] + (inner - before) * rows.period
    # Of a second of which rows are mixed only the whole is known.
    shown = np.floor(rows.time[inner]) + 0.5 if rows.whole else rows.time[inner]
    ahead = ((shown - by_count) / size > 0.5).astype(np.int64)
    slack = 0.5 + 2.0 * rows.period if rows.whole else max(0.5 * rows.period, 0.25)
    misfits = np.abs(shown - by_count - size * ahead) > slack
    if np.count_nonzero(misfits) > MOST_MISFITS * inner.size:
        return None
    if np.count_nonzero(np.diff(np.concatenate(([0], ahead, [1])))) < LEAST_CHANGES:
        return None
    return size, ahead


def _set_by(rows: _Rows, motion: _Motion | None, place: int) -> tuple[float, bool]:
    """By how many seconds the clock was set after a row, 0 if it was not; and whether that is sure.

    What the distance across the place exceeds that of the speeds by is nothing where no row is
    missing, and the way of a train that went on, or braked and went on, where rows are.
    """
    late = float(rows.late[place])
    seen = None if motion is None else motion.across(place)
    if seen is None or not -LARGEST[1] < late < LARGEST[0]:
        return 0.0, False
    # Rows that were written late: behind them time leaps on to where it was before.
    leaps = np.flatnonzero(rows.late[place + 1 :] > LEAP * abs(late)) + place + 2
    if late < 0.0 and np.any(np.abs(rows.time[leaps] - rows.time[place]) < 2.5 * rows.period):
        return 0.0, False
    excess, std, speed = seen
    # How far the way is from any that a train can come in the time that is shown, against how far
    # it is from that of rows that are missing besides, or of none. A receiver that begins late
    # after a gap has come less far, but never further.
    ahead = max(late, 0.0)
    most = speed * late + 0.25 * STARTING * ahead**2
    brakes = min(ahead, 2.0 * speed / BRAKING)
    less = np.maximum(speed * brakes - 0.25 * BRAKING * brakes**2 - excess, 0.0) * (late > 0.0)
    beside = np.maximum(less, excess - most)
    missing = bool(np.any(np.abs(excess) > GATE * std))
    likelier = 0.5 * (np.maximum(beside, 0.0) ** 2 - (0.0 if missing else excess) ** 2) / std**2
    took = np.maximum(excess, 0.0) / speed * missing
    unsure = np.hypot(std, np.sqrt(LOSS_DENSITY * took**3 / 12.0)) / speed
    best = int(np.argmin(unsure))
    size = late - float(took[best])
    if missing:
        least = np.min(likelier) if less.any() else np.max(likelier)
        shown = least > 0.5 * GATE**2 and np.min(excess) > 0.0
        sure = took[best] < LONGEST_TAKEN and abs(size) > LEAST_SIZE * unsure[best]
    else:
        shown, sure = np.min(likelier) > 0.0, np.max(likelier) > SURE
    if not shown or abs(size) < LEAST_STEP:
        return 0.0, False
    # A file of whole seconds gives no others.
    return float(round(size)) if rows.whole else size, bool(sure)


# ------------------------------------------------------------------ what the motion shows


@dataclass(frozen=True, eq=False)
class _Motion:
    """How far distances exceed the integral of the speed, the time of steps left out.

    Attributes
    ----------
    rows : (k,) array of int
        Rows that are looked at: one a second, and those around steps.
    time : (k,) array [s]
        Of these rows, by a clock that takes a usual period over each step.
    rest : (k,) array [m]
        Distance less the integral.
    speed : (k,) array [m/s]
        By the scale of the distance.
    broken : (k,) array of int
        How many steps lie before each row.
    usual : (w, 3) array [s], [m], [m]
        Of `WINDOWS` that are known each, and median and standard deviation of what `rest` changes
        by over so long before and after a place without a step.
    """

    rows: IntArray
    time: FloatArray
    rest: FloatArray
    speed: FloatArray
    broken: IntArray
    usual: FloatArray

    @classmethod
    def of(cls, rows: _Rows) -> _Motion | None:
        """What the columns of a table show; None without a distance and a speed."""
        position, points = rows.table.signals.get(POSITION), plane(rows.table)
        signed = position is not None and bool(np.isfinite(position).any())
        # The speed of the same source as the distance first.
        speed = speed_of(rows.table, *((SPEED, GNSS_SPEED) if signed else (GNSS_SPEED, SPEED)))
        places = position + 0j if position is not None and signed else points
        if speed is None or places is None:
            return None
        known = np.flatnonzero(np.isfinite(speed) & np.isfinite(places))
        if not signed:
            # Fixes that a receiver holds while the train moves show no distance.
            again = np.diff(places[known], prepend=np.nan) == 0.0
            known = known[~(again & (speed[known] > MOVING))]
        if known.size < ENOUGH:
            return None
        passed = rows.late + rows.period
        passed[rows.steps] = rows.period
        time = np.concatenate(([0.0], np.cumsum(np.maximum(passed, 0.0))))
        broken = np.zeros(time.size, dtype=np.int64)
        broken[rows.steps + 1] = 1
        broken = np.cumsum(broken)
        # One row a second, and the first and the last one between steps.
        number = np.floor(time[known]).astype(np.int64) + broken[known] * (int(time[-1]) + 2)
        first = np.diff(number, prepend=-1) != 0
        edges = np.diff(broken[known], append=-1) != 0
        nodes = known[first | edges]
        driven = cumulative_trapezoid(speed[known], time[known], initial=0.0)
        driven = np.interp(time[nodes], time[known], driven)
        along = places[nodes].real if signed else _along(places[nodes], broken[nodes], time[nodes])
        # Distance over the integral of the speed, the median over up to 20 s without a step.
        last = np.searchsorted(broken[nodes], broken[nodes], side="right") - 1
        later = np.minimum(np.searchsorted(time[nodes], time[nodes] + WINDOWS[-1]), last)
        by_speed = driven[later] - driven
        found = agreement(along[later] - along, by_speed, by_speed > WINDOWS[-1] * MOVING)
        if found is None:
            return None
        motion = cls(
            nodes,
            time[nodes],
            along - found.ratio * driven,
            found.ratio * speed[nodes],
            broken[nodes],
            np.zeros((0, 3)),
        )
        return motion._calibrated()

    def _calibrated(self) -> _Motion | None:
        """With what is usual where no step is; None where that is not known."""
        moving = np.flatnonzero(self.speed > MOVING)
        usual = []
        for window in WINDOWS:
            left, right = self._around(moving, moving, window)
            whole = self.broken[left] == self.broken[right]
            whole &= self.time[right] - self.time[left] > 1.5 * window
            change = (self.rest[right] - self.rest[left])[whole]
            if change.size < ENOUGH:
                continue
            middle = float(np.median(change))
            size = np.abs(change - middle)
            tail = float(np.quantile(size, 0.9)) / 1.64
            usual.append((window, middle, max(robust_std(size), tail, SMALLEST_STD)))
        return replace(self, usual=np.array(usual)) if usual else None

    def _around(
        self, before: IntArray, after: IntArray, window: float | FloatArray
    ) -> tuple[IntArray, IntArray]:
        """The rows a time [s] before ones, and after others."""
        left = np.searchsorted(self.time, self.time[before] - window)
        right = np.searchsorted(self.time, self.time[after] + window, side="right") - 1
        return left, right

    def across(self, place: int) -> tuple[FloatArray, FloatArray, float] | None:
        """How far the train came across the step after a row beyond what its speeds show.

        By window, less what is usual, with its standard deviation [m]; and the speed there [m/s].
        None where the train stands, or other steps are too close.
        """
        after = int(np.searchsorted(self.rows, place, side="right"))
        before = after - 1
        if before < 0 or after >= self.rows.size or self.broken[after] != self.broken[before] + 1:
            return None
        speed = 0.5 * float(self.speed[before] + self.speed[after])
        edges = np.searchsorted(self.broken, self.broken[before])
        beyond = np.searchsorted(self.broken, self.broken[after], side="right") - 1
        if speed < MOVING or min(before - edges, beyond - after) < LEAST_AROUND:
            return None
        windows, middle, std = self.usual.T
        left, right = self._around(np.array([before]), np.array([after]), windows)
        change = self.rest[np.minimum(right, beyond)] - self.rest[np.maximum(left, edges)]
        return change - middle, std, speed


def _along(points: ComplexArray, broken: IntArray, time: FloatArray) -> FloatArray:
    """Distance [m] along fixes; across a step it is negative where they go back."""
    chord = np.diff(points)
    size = np.abs(chord)
    step = np.diff(broken) != 0
    behind = np.maximum(np.searchsorted(time, time[:-1] - 3.0), 0)
    heading = points[:-1] - points[behind]
    size[step & (np.real(chord * np.conj(heading)) < 0.0)] *= -1.0
    return np.concatenate(([0.0], np.cumsum(size)))

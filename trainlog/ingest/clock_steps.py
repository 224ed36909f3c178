"""Clocks that were set while they recorded: the rows on the wrong side are put back.

A clock is set by 1024 weeks where the receiver's week number rolled over, by whole days where it
had no date before its first fix, by quarters of an hour where the time zone or summer time was
corrected, by 1 to 18 whole seconds where the receiver learnt the leap seconds. A step back gives
times twice. A step forward looks like a gap: distance and speed on both sides show how much time
passed. Where they do not, the step is reported and left as it is.

Rows of both clocks may be mixed for a while. Then it is the count of rows since the last one before
and to the first one after that shows by which clock each was written.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trainlog.arrays import BoolArray, FloatArray, IntArray, robust_std
from trainlog.ingest.clock import (
    Result,
    has_fix,
    longest_nondecreasing,
    outside_largest_group,
    rows_per_second,
    same_as_previous,
    usual_step,
)
from trainlog.ingest.profile_parts import Limits
from trainlog.ingest.recording import METRES_PER_DEGREE, Finding, Table
from trainlog.units import DAY, NANOSECONDS

ROLLOVER = 1024 * 7 * DAY
"""Weeks of GPS time are counted modulo 1024 [ns]."""

QUARTER = 900 * NANOSECONDS
"""Time zones differ by multiples of a quarter of an hour [ns]."""

EARLY = np.datetime64("2007-01-01").astype("datetime64[ns]").astype(np.int64)
"""Time [ns] before which a recording is rather one of today with a week number that rolled over."""

MOST_QUARTERS = 56
"""Time zones span 26 hours, but nobody sets a clock by more than 14."""

MOST_LEAPS = 18
"""GPS time is 18 s ahead of UTC: what a receiver may have to learn."""

REAL = 5 * NANOSECONDS
"""Time that may really pass while a clock is set [ns]."""

MAJORITY = 2.0 / 3.0
"""Share of the rows that a date must have to be the right one."""

MOST_EDGES = 50
"""Steps beyond which it is not the clock that was set."""

MOST_LEVELS = 3
"""Times that a clock may show in a recording, up to what is undone before."""

MOST_SUSPECTED = 3
"""Steps that may be gaps, beyond which they are gaps."""

LEAST_ROWS = 10
"""Rows that it takes to judge a clock."""

CHAIN = 15.0
"""Time [s] between two steps that may belong to one setting of the clock."""

LEAST_KIND = 0.2
"""Share of the rows that a kind of them must have to be judged by itself."""

MOST_MISFITS = 0.05
"""Share of rows between the first and the last step that may fit neither clock."""

LEAST_CHANGES = 5
"""Changes from one clock to the other that it takes to call them mixed."""

HARDEST = 0.4
"""Speed [m/s] for each second of a gap up to which a train may have stopped in it unseen."""

SLOWEST = 2.0
"""Speed [m/s] from which on distance shows how much time passed."""

REFERENCES, LEAST_REFERENCES = 200, 6
"""Places without a step on which the noise of what passed is measured."""


def undo_clock_steps(table: Table, limits: Limits) -> Result:
    """Put the rows before or after a step of the clock where they belong.

    Of two levels of the clock the one that holds for more rows is right, for 1024 weeks the later
    one, for whole days the later one if the other has the date of a receiver that knows none. Rows
    are moved only if that brings more rows into order, or if the motion shows that the clock was
    set.
    """
    time = table.time
    if len(table) < LEAST_ROWS:
        return table, []
    shift = _too_early(time, limits)
    shift = shift + _coarse(time + shift, limits)
    shift = shift + _to_most(_seconds(table.at(time + shift))[0])
    if np.any(np.diff(time + shift) < 0):
        shift = shift + _by_kind(table.at(time + shift))
    if not shift.any():
        return table, []
    sizes = ", ".join(_size(int(size)) for size in np.unique(shift[shift != 0]))
    note = f"moved by {sizes}"
    return table.at(time + shift), table.found("clock_step", shift != 0, note=note)


def suspect_clock_steps(table: Table, limits: Limits) -> Result:
    """Report what may be steps of the clock, and what may be dates of another week count."""
    findings: list[Finding] = []
    if len(table) < LEAST_ROWS:
        return table, findings
    undecided = _seconds(table)[1]
    if 0 < len(undecided) <= MOST_SUSPECTED:
        marked = np.zeros(len(table), dtype=np.bool_)
        marked[[place + 1 for place, _ in undecided]] = True
        sizes = ", ".join(f"{size:+d} s" for _, size in undecided)
        note = f"{sizes}: a gap or a step of the clock, which the motion does not show"
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
    return f"{shift / NANOSECONDS:+.0f} s"


# ------------------------------------------------------------------ weeks, days and time zones


def _coarse(time: IntArray, limits: Limits) -> IntArray:
    """What undoes steps by weeks, days and quarters of an hour [ns]."""
    none = np.zeros(time.size, dtype=np.int64)
    if not np.any(np.diff(time) < 0) and np.ptp(time) < DAY:
        return none
    weeks = _week_edges(time, limits.pause)
    days = np.where(weeks == 0, _day_edges(time), 0)
    others = np.where((weeks == 0) & (days == 0), _zone_edges(time), 0)
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
    real = values[(counts >= LEAST_ROWS) | (counts == counts.max())]
    return np.asarray(real.max() - levels)


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
    few = values[counts < LEAST_ROWS]
    return np.where(~undated & np.isin(levels, few), 0, right - levels)


def _week_edges(time: IntArray, pause: float) -> IntArray:
    """Steps by multiples of 1024 weeks [ns], 0 where there is none."""
    step = np.diff(time)
    count = np.round(step / ROLLOVER).astype(np.int64)
    rest = np.abs(step - count * ROLLOVER)
    return np.where(rest <= pause * NANOSECONDS, count * ROLLOVER, 0)


def _day_edges(time: IntArray) -> IntArray:
    """Steps by whole days, the time of day going on [ns], 0 where there is none."""
    step = np.diff(time)
    count = np.floor_divide(step + REAL, DAY)
    rest = np.abs(step - count * DAY)
    return np.where((count != 0) & (rest <= REAL), count * DAY, 0)


def _zone_edges(time: IntArray) -> IntArray:
    """Steps by multiples of a quarter of an hour [ns], 0 where there is none."""
    step = np.diff(time)
    count = step // QUARTER
    fits = (count != 0) & (np.abs(count) <= MOST_QUARTERS) & (step - count * QUARTER <= REAL)
    return np.where(fits, count * QUARTER, 0)


def _disorder(time: IntArray, pause: float) -> int:
    """How many rows are out of order, or do not belong to the trip."""
    return int(np.count_nonzero(~longest_nondecreasing(time) | outside_largest_group(time, pause)))


# ------------------------------------------------------------------ whole seconds


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
    steps : (m,) array of int
        Rows after which the time does not go on as usual.
    """

    table: Table
    time: FloatArray
    period: float
    whole: bool
    steps: IntArray

    @classmethod
    def of(cls, table: Table) -> _Rows | None:
        """The rows of a table; None if they come too irregularly."""
        usual = rows_per_second(table)
        seconds = (table.time - table.time[0]) / NANOSECONDS
        if usual > 1:
            time, period = _with_fractions(seconds, usual), 1.0 / usual
        else:
            time, period = seconds, usual_step(table.time)
        if period <= 0.0 or period > 2.0:
            return None
        late = np.diff(time) - period
        slack = max(0.5 * period, 0.3) if usual > 1 else 0.5 * period
        steps = (np.abs(late) > slack) | (np.diff(seconds) < 0.0)
        return cls(table, time, period, usual > 1, np.flatnonzero(steps))

    @property
    def candidates(self) -> IntArray:
        """Those steps that are of whole seconds, or go back."""
        late = np.diff(self.time)[self.steps] - self.period
        fit = np.array([self.fits(each, mixed=False) for each in late], dtype=np.bool_)
        return self.steps[fit | (late < -self.period)]

    def uneven(self, begin: int, end: int, level: IntArray) -> int:
        """How many rows of a range do not follow the one before as usual once `level` is undone."""
        time = (self.time - level)[max(0, begin - 1) : end + 2]
        return int(np.count_nonzero(np.abs(np.diff(time) - self.period) > 0.5 * self.period))

    def size(self, before: int, after: int) -> float:
        """How far [s] the clock goes ahead between two rows beyond what their number takes."""
        return float(self.time[after] - self.time[before] - (after - before) * self.period)

    def fits(self, size: float, *, mixed: bool) -> bool:
        """Whether a step is of whole seconds that a receiver learns."""
        slack = 1.2 * self.period if self.whole else min(0.5 * self.period, 0.2) + 0.1
        if mixed:
            # Some rows may have been lost in between.
            slack = 0.45 if self.whole else max(slack, 0.35)
        whole = round(size)
        return 1 <= abs(whole) <= MOST_LEAPS and abs(size - whole) <= min(slack, 0.45)


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


def _seconds(table: Table) -> tuple[IntArray, list[tuple[int, int]]]:
    """How far [ns] steps by whole seconds set the clock; undecided ones by row and size [s]."""
    if rows_per_second(table) == 1:
        doubled = same_as_previous(table) & (np.diff(table.time, prepend=table.time[0] - 1) == 0)
        if doubled.any():
            single = np.flatnonzero(~doubled)
            shift, open_ = _seconds(table.take(single))
            behind = np.cumsum(~doubled) - 1
            return shift[behind], [(int(single[place]), size) for place, size in open_]
    none = np.zeros(len(table), dtype=np.int64)
    rows = _Rows.of(table)
    if rows is None or not rows.steps.size:
        return none, []
    steps = rows.candidates
    clusters = np.split(steps, np.flatnonzero(np.diff(steps) * rows.period > CHAIN) + 1)
    if not steps.size or len(clusters) > MOST_EDGES:
        return none, []
    motion = _Motion.of(rows)
    level = np.zeros(len(table), dtype=np.int64)
    undecided: list[tuple[int, int]] = []
    for cluster in clusters:
        found = _setting(rows, motion, cluster)
        if found is None:
            if cluster.size > 1:
                level += _one_by_one(rows, motion, cluster)
            continue
        size, ahead = found
        if ahead is None:
            undecided.append((int(cluster[0]), size))
        else:
            level += _levels_of(len(table), cluster, size, ahead)
    if np.unique(level).size > MOST_LEVELS or np.ptp(level) > MOST_LEAPS:
        # No receiver learns the time so often: what was found contradicts itself.
        places = np.flatnonzero(np.diff(level))
        return none, [(int(place), int(level[place + 1] - level[place])) for place in places]
    return level * NANOSECONDS, undecided


def _levels_of(count: int, steps: IntArray, size: int, ahead: IntArray) -> IntArray:
    """How far [s] the clock is off after it was set by `size` at `steps`."""
    level = np.zeros(count, dtype=np.int64)
    level[steps[0] + 1 : steps[-1] + 1] = size * ahead
    level[steps[-1] + 1 :] = size
    return level


def _one_by_one(rows: _Rows, motion: _Motion | None, steps: IntArray) -> IntArray:
    """How far [s] the clock is off after those of `steps` at which it was set, each by itself.

    Other defects stand among them. Nothing where that gives more than two levels or does not make
    the rows more even.
    """
    count = rows.time.size
    level = np.zeros(count, dtype=np.int64)
    for place in steps:
        size, ahead = _setting(rows, motion, place[None]) or (0, None)
        if ahead is not None:
            level += _levels_of(count, place[None], size, ahead)
    first, last = int(steps[0]), int(steps[-1])
    before = rows.uneven(first, last, np.zeros(count, dtype=np.int64))
    two = np.unique(level).size <= 2
    return level if two and rows.uneven(first, last, level) < before else np.zeros_like(level)


def _by_kind(table: Table) -> IntArray:
    """What undoes steps by whole seconds [ns] where rows of two kinds were set one by one.

    Rows are of a kind by the columns that they hold, as the sentences of a receiver are.
    """
    none = np.zeros(len(table), dtype=np.int64)
    held = {np.isfinite(values).tobytes() for values in table.signals.values()}
    kinds = [np.frombuffer(each, dtype=np.bool_) for each in sorted(held)]
    kinds = [kind for kind in kinds if LEAST_KIND * kind.size < np.count_nonzero(kind) < kind.size]
    if len(kinds) < 2 or len(kinds) > 4 or not np.logical_or.reduce(kinds).all():
        return none
    found = np.zeros((len(kinds), len(table)), dtype=np.int64)
    for number, kind in enumerate(kinds):
        found[number, kind] = _seconds(table.take(np.flatnonzero(kind)))[0]
    known = np.ma.masked_array(found, ~np.array(kinds))
    if np.any(known.min(axis=0) != known.max(axis=0)):
        return none
    shift = _to_most(np.asarray(known.max(axis=0)))
    in_order = np.count_nonzero(longest_nondecreasing(table.time + shift))
    return shift if in_order > np.count_nonzero(longest_nondecreasing(table.time)) else none


def _setting(
    rows: _Rows, motion: _Motion | None, steps: IntArray
) -> tuple[int, IntArray | None] | None:
    """By how many seconds the clock was set at `steps`, and which rows between have the new one.

    None if it was not; no rows if it cannot be decided.
    """
    before, after = int(steps[0]), int(steps[-1]) + 1
    size = rows.size(before, after)
    if not rows.fits(size, mixed=after > before + 1):
        return None
    whole = round(size)
    inner = np.arange(before + 1, after)
    ahead = np.zeros(inner.size, dtype=np.int64)
    if inner.size:
        by_count = rows.time[before] + (inner - before) * rows.period
        if rows.whole:
            # Of a second of which rows are mixed only the whole is known.
            late = np.floor(rows.time[inner]) + 0.5 - by_count
        else:
            late = rows.time[inner] - by_count
        ahead = (late / whole > 0.5).astype(np.int64)
        slack = 0.5 + 2.0 * rows.period if rows.whole else max(0.5 * rows.period, 0.25)
        misfits = np.abs(late - whole * ahead) > slack
        if np.count_nonzero(misfits) > MOST_MISFITS * inner.size:
            return None
    changes = np.flatnonzero(np.diff(np.concatenate(([0], ahead, [1]))))
    if changes.size > 1:
        if changes.size < LEAST_CHANGES:
            return None
        beyond = None if motion is None else motion.beyond(before, after)
        return (whole, ahead) if beyond is None or abs(beyond / whole) < 0.4 else None
    place = before + int(changes[0])
    passed = None if motion is None else motion.passed(place)
    if passed is not None:
        decided = passed.decide(whole)
        if decided is not None:
            return (whole, ahead) if decided else None
        if whole < 0 and passed.time < 0.3 * whole - 3.0 * passed.std:
            return None
    if whole < 0:
        return (whole, ahead) if _repeated_differently(rows, place) else None
    return whole, None


def _repeated_differently(rows: _Rows, place: int) -> bool:
    """Whether the times between row `place` and the next come twice, with other values.

    A block that was written late goes back too. A clock that was set back gives its times twice.
    """
    time, table, usual = rows.time, rows.table, rows.period
    low, high = time[place + 1] - 0.1 * usual, time[place] + 0.1 * usual
    capacity = round((high - low) / usual) + 1
    reach = int(2 * capacity + 10)
    before = np.arange(max(0, place + 1 - reach), place + 1)
    after = np.arange(place + 1, min(time.size, place + 1 + reach))
    before = before[(time[before] >= low) & (time[before] <= high)]
    after = after[(time[after] >= low) & (time[after] <= high)]
    if not before.size or not after.size or before.size + after.size < 1.5 * capacity:
        return False
    nearest = before[np.abs(time[before][None, :] - time[after][:, None]).argmin(axis=1)]
    same = np.ones(after.size, dtype=np.bool_)
    for values in table.signals.values():
        a, b = values[after], values[nearest]
        same &= (a == b) | (np.isnan(a) & np.isnan(b))
    return bool(np.mean(same) < 0.5)


# ------------------------------------------------------------------ what the motion shows


@dataclass(frozen=True, slots=True)
class _Passed:
    """How much time [s] beyond a usual step passed between two rows at a speed, and its noise."""

    time: float
    std: float
    spread: float
    speed: float

    def decide(self, size: int) -> bool | None:
        """Whether the clock was set by `size` [s], and no such time passed; None: not decided."""
        noise = 3.0 * self.std
        if self.speed < HARDEST * size:
            # In the gap a train this slow can have stopped, and gone on.
            return None
        if noise > 0.35 * abs(size) or self.spread > 0.4 * abs(size):
            return None
        as_step, as_gap = abs(self.time), abs(self.time - size)
        allowed = max(noise, 0.2 * abs(size))
        if as_step <= allowed < as_gap:
            return True
        if as_gap <= max(allowed, 0.35 * abs(size)) < as_step:
            return False
        return None


@dataclass(frozen=True, eq=False)
class _Motion:
    """Distance and speed by rows, and how well they show the time that passed.

    Attributes
    ----------
    period : float [s]
    places : (2, n) array [m]
        North and east, or chainage and nothing.
    speed : (n,) array [m/s]
    bias, std : float [m]
        Of distances against speeds where nothing happened.
    """

    period: float
    places: FloatArray
    speed: FloatArray
    bias: float = 0.0
    std: float = 0.0

    @classmethod
    def of(cls, rows: _Rows) -> _Motion | None:
        """What the columns of a table show; None without a distance and a speed."""
        signals = rows.table.signals
        speed = next(
            (signals[n] for n in ("/gnss/motion.speed", "/train/state.speed") if n in signals),
            None,
        )
        position = signals.get("/train/state.position")
        latitude, longitude = (signals.get(f"/gnss/fix.{n}") for n in ("latitude", "longitude"))
        if speed is None or not np.isfinite(speed).any():
            return None
        if position is not None and np.isfinite(position).any():
            places = np.stack((position, np.zeros(position.size)))
        elif latitude is not None and longitude is not None and np.isfinite(latitude).any():
            east = METRES_PER_DEGREE * np.cos(np.radians(float(np.nanmedian(latitude))))
            places = np.stack((latitude * METRES_PER_DEGREE, longitude * east))
        else:
            return None
        motion = cls(rows.period, places, np.abs(speed))
        return motion._calibrated(rows.steps)

    def _calibrated(self, steps: IntArray) -> _Motion | None:
        """With the noise measured at places away from `steps`."""
        count = self.speed.size
        reach = self._reach
        away = np.arange(reach, count - reach - 1, max(1, (count - 2 * reach) // REFERENCES))
        near = np.searchsorted(steps, away - reach) < np.searchsorted(steps, away + reach + 1)
        errors = [error for place in away[~near] if (error := self._excess(int(place))) is not None]
        if len(errors) < LEAST_REFERENCES:
            return None
        metres = np.array([np.median(each) for each in errors])
        bias = float(np.median(metres))
        std = robust_std(metres - bias)
        return replace(
            self, bias=bias, std=max(std, float(np.quantile(np.abs(metres - bias), 0.9)) / 2)
        )

    @property
    def _reach(self) -> int:
        """Rows on either side that are looked at."""
        return max(2, min(20, round(2.0 / self.period)))

    def _excess(self, place: int) -> FloatArray | None:
        """Distances [m] across a place beyond those of usual steps, of pairs of rows around it."""
        reach = np.arange(self._reach)
        left, right = place - reach, place + 1 + reach
        known = (left >= 0) & (right < self.speed.size)
        left, right = left[known], right[known]
        across = self.places[:, right] - self.places[:, left]
        # Along the way from the rows before to those after: rows out of order go back.
        heading = (
            np.nanmean(across, axis=1) if np.isfinite(across).all(axis=0).any() else across[:, 0]
        )
        moved = heading @ across / max(float(np.hypot(*heading)), 1e-9)
        mean = self._mean_speed(place)
        excess = moved - mean * (right - left) * self.period
        excess = excess[np.isfinite(excess)]
        return excess if excess.size >= 2 and mean > SLOWEST else None

    def _mean_speed(self, place: int) -> float:
        around = self.speed[max(0, place - self._reach) : place + 2 + self._reach]
        around = around[np.isfinite(around)]
        return float(np.median(around)) if around.size else 0.0

    def beyond(self, before: int, after: int) -> float | None:
        """The time [s] that passed between two rows beyond their count; None if it stands."""
        rows = np.append(np.arange(before, after, max(1, round(1.0 / self.period))), after)
        moved = float(np.nansum(np.hypot(*np.diff(self.places[:, rows]))))
        speed = self.speed[before : after + 1]
        mean = float(np.mean(speed[np.isfinite(speed)])) if np.isfinite(speed).any() else 0.0
        if mean <= SLOWEST:
            return None
        return moved / mean - (after - before) * self.period

    def passed(self, place: int) -> _Passed | None:
        """The time that passed between row `place` and the next beyond a usual step."""
        excess = self._excess(place)
        if excess is None:
            return None
        speed = self._mean_speed(place)
        spread = float(np.ptp(excess)) / speed
        return _Passed(
            (float(np.median(excess)) - self.bias) / speed, self.std / speed, spread, speed
        )

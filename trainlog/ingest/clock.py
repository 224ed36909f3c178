"""Rules on rows and their time: which rows stay, in which order, at which instant.

Each rule takes a table and the profile's limits and returns the table it leaves and what it found.

A clock that was set while it recorded leaves rows on the wrong side, which are put back. A clock is
set by 1024 weeks where the receiver's week number rolled over, by whole days where it had no date
before its first fix, by quarters of an hour where the time zone or summer time was corrected, by
seconds where the receiver learnt the leap seconds or the recorder the time. A step back gives times
twice: rows of such times whose values differ are of two clocks, and rows of times that nobody wrote
before were written late. A step forward looks like a gap. How far the train came meanwhile shows
whether rows are missing, the clock was set, or both: distances over 2 and 20 s before and after the
step, against how they usually depart from the speeds in this recording, and against how hard the
train starts and brakes in it. What is likelier than missing rows, but not surely, is reported and
left as it is.

Rows of both clocks may be mixed for a while. Then it is the count of rows since the last one before
and to the first one after that shows by which clock each was written.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from scipy.integrate import cumulative_trapezoid

from estimators.motion import reach
from trainlog.arrays import BoolArray, FloatArray, IntArray, robust_std
from trainlog.errors import InputError
from trainlog.ingest.motion import (
    ACCURACY,
    CHORD,
    ENOUGH,
    GATE,
    GNSS_SPEED,
    LATITUDE,
    LIKELY,
    LONGITUDE,
    MANY,
    MARGIN,
    MOVING,
    POSITION,
    SEVERAL,
    SPAN,
    SPEED,
    STEEPEST,
    SURE,
    agreement,
    plane,
    seconds_of,
    speed_of,
)
from trainlog.ingest.profile import Limits
from trainlog.ingest.recording import MOST, NEARLY_ALL, NO_TIME, SELDOM, Finding, Table
from trainlog.units import DAY, NANOSECONDS

NO_ACCURACY = 4_000_000.0
"""Horizontal accuracy [m] from which on a receiver means "none" (2^32 - 1 mm at u-blox)."""

MAX_DROPPED = 0.25
"""Share of rows, values, fixes or stops up to which those that do not fit are left out: if they are
more, the clock, the unit or the network is another one."""

Result = tuple[Table, list[Finding]]


def drop_before_first_fix(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Drop the rows of a pure GNSS log before its first row with a time and a fix."""
    fix = has_fix(table)
    if fix is None or not all(name.startswith("/gnss/") for name in table.signals):
        return table, []
    usable = fix & (table.time != NO_TIME)
    first = int(np.argmax(usable)) if usable.any() else len(table)
    before = np.arange(len(table)) < first
    return table.take(~before), table.found("before_first_fix", before)


def has_fix(table: Table) -> BoolArray | None:
    """Which rows hold a satellite fix; None if the table holds no satellite positions.

    No fix: position empty or exactly 0° 0°, no satellite used, or an accuracy that means "none".
    """
    latitude, longitude = table.signals.get(LATITUDE), table.signals.get(LONGITUDE)
    if latitude is None or longitude is None:
        return None
    fix = np.isfinite(latitude) & np.isfinite(longitude) & ((latitude != 0.0) | (longitude != 0.0))
    satellites = table.signals.get("/gnss/motion.satellites")
    if satellites is not None:
        fix &= satellites != 0.0
    accuracy = table.signals.get(ACCURACY)
    if accuracy is not None:
        fix &= ~(accuracy >= NO_ACCURACY)
    return np.asarray(fix, dtype=np.bool_)


def drop_unreadable_time(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Drop rows whose time is empty or cannot be read."""
    unreadable = table.time == NO_TIME
    return table.take(~unreadable), table.found("time_unreadable", unreadable)


def drop_clock_jumps(table: Table, limits: Limits) -> Result:
    """Drop rows whose clock was far off.

    Times that no pause of ``limits.pause`` parts belong together: the largest such group is the
    trip. Of it, in file order, the most rows whose time never decreases are trusted. Another row
    is far off if its time differs from both trusted rows around it by more than
    ``limits.sort_within`` and by more than five usual steps.
    """
    far = outside_largest_group(table.time, limits.pause)
    group = np.flatnonzero(~far)
    time = table.time[group]
    trusted = longest_nondecreasing(time)
    kept = np.flatnonzero(trusted)
    after = np.searchsorted(kept, np.arange(time.size))
    nearest = np.minimum(
        np.abs(time - time[kept[np.clip(after - 1, 0, None)]]),
        np.abs(time - time[kept[np.clip(after, None, kept.size - 1)]]),
    )
    within = max(limits.sort_within, 5.0 * usual_step(time[kept]))
    far[group[~trusted & (nearest > within * NANOSECONDS)]] = True
    if np.count_nonzero(far) > MAX_DROPPED * len(table):
        raise InputError(
            f"the clock jumps: {np.count_nonzero(far)} of {len(table)} rows do not fit into"
            " one trip",
            place=f"row {table.rows[far][0]}",
            remedy="split the file where the clock was set, or one file a trip",
        )
    return table.take(~far), table.found("clock_jump", far)


def outside_largest_group(time: IntArray, pause: float) -> BoolArray:
    """Which times lie outside the largest group that no `pause` [s] parts."""
    order = np.sort(time)
    leaps = np.flatnonzero(np.diff(order) > pause * NANOSECONDS)
    edges = np.concatenate(([0], leaps + 1, [order.size]))
    largest = int(np.argmax(np.diff(edges)))
    first, last = order[edges[largest]], order[edges[largest + 1] - 1]
    return np.asarray((time < first) | (time > last))


def longest_nondecreasing(time: IntArray) -> BoolArray:
    """Mark the longest subsequence of `time` that never decreases."""
    if not np.any(np.diff(time) < 0):
        return np.ones(time.size, dtype=np.bool_)
    return np.asarray(_longest_nondecreasing(time))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _longest_nondecreasing(time: IntArray) -> BoolArray:  # pragma: no cover - compiled
    """Patience sorting: `tails[k]` ends the best subsequence of length k + 1 so far."""
    tails = np.empty(time.size, dtype=np.int64)
    previous = np.empty(time.size, dtype=np.int64)
    length = 0
    for i in range(time.size):
        low, high = 0, length
        while low < high:
            middle = (low + high) // 2
            if time[tails[middle]] <= time[i]:
                low = middle + 1
            else:
                high = middle
        previous[i] = tails[low - 1] if low else -1
        tails[low] = i
        length = max(length, low + 1)
    marked = np.zeros(time.size, dtype=np.bool_)
    i = tails[length - 1]
    while i >= 0:
        marked[i] = True
        i = previous[i]
    return marked


def sort_time(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Sort rows that were written out of order; rows of equal time stay in file order."""
    moved = ~longest_nondecreasing(table.time)
    if not moved.any():
        return table, []
    return table.take(np.argsort(table.time, kind="stable")), table.found("time_backwards", moved)


def drop_duplicates(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Drop rows that repeat the row before: same time, same values.

    Where time has whole seconds only, a train at rest repeats itself without fault: there, only
    rows in excess of the usual number a second are dropped.
    """
    repeated = same_as_previous(table) & (np.diff(table.time, prepend=NO_TIME) == 0)
    usual = rows_per_second(table)
    if usual > 1:
        _, second, size = np.unique(table.time, return_inverse=True, return_counts=True)
        rank = np.cumsum(repeated)
        first_rank = rank[np.searchsorted(second, np.arange(size.size))]
        repeated &= rank - first_rank[second] <= (size - usual)[second]
    return table.take(~repeated), table.found("duplicates", repeated)


def same_as_previous(table: Table) -> BoolArray:
    """Which rows hold the values of the row before, whatever their time."""
    same = np.ones(len(table), dtype=np.bool_)
    same[:1] = False
    for values in table.signals.values():
        equal = values[1:] == values[:-1]
        same[1:] &= equal | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    for texts in table.texts.values():
        same[1:] &= np.asarray(texts[1:] == texts[:-1], dtype=np.bool_)
    return same


def rows_per_second(table: Table) -> int:
    """Usual number of rows with the same whole second; 1 if time has fractions of a second.

    Only seconds in which something moved count. Rows that repeat the one before are samples, too,
    where all rows of other seconds differ, as those of a receiver that came to rest, or where
    repeats come irregularly; they are not where each row was written equally often.
    """
    if len(table) < 2 or not table.signals or np.any(table.time % NANOSECONDS):
        return 1
    fresh = ~same_as_previous(table)
    # Rows that each hold another column of the same instant are not samples of their own.
    present = np.isfinite(max(table.signals.values(), key=lambda c: int(np.isfinite(c).sum())))
    fresh &= present
    _, first, second = np.unique(table.time, return_index=True, return_inverse=True)
    # The first and the last second are seldom whole.
    moved = np.flatnonzero(fresh[first])
    moved = moved[(moved > 0) & (moved < first.size - 1)] if moved.size > 2 else moved[:0]
    if not moved.size:
        return 1
    differing = np.bincount(second, weights=fresh).astype(np.int64)[moved]
    written = np.bincount(second, weights=present).astype(np.int64)[moved]
    most = int(np.argmax(np.bincount(written)))
    times = np.diff(np.append(np.flatnonzero(fresh), len(table)))
    regular = float(np.max(np.bincount(times)) / times.size) >= NEARLY_ALL
    if np.mean(differing >= most) >= SELDOM or not regular:
        return max(1, most)
    return max(1, int(np.argmax(np.bincount(differing))))


def rebuild_subsecond(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Rebuild fractions of a second where several rows a second carry whole seconds only.

    Seconds with the usual number N of rows are whole: their rows lie 1/N s apart. The rows of any
    other second are spread evenly between the whole seconds around them. A second with N - 1 rows
    beside one with N + 1 thereby comes out exactly; a lost row costs the others of its second less
    than 1/N s. Where a second is missing altogether, what lies before and after is dealt with
    apart.
    """
    usual = rows_per_second(table)
    if usual == 1:
        return table, []
    time = _spread(table.time, usual)
    _, counts = np.unique(table.time, return_counts=True)
    odd = int(np.count_nonzero(counts != usual))
    note = f"{usual} rows a second; {odd} seconds with another number of rows"
    return table.at(time), table.found("subsecond", time != table.time, note=note)


def _spread(time: IntArray, usual: int) -> IntArray:
    """Times [ns] of rows whose whole seconds are `time`, with `usual` rows a second."""
    start = time[0]
    seconds = (time - start) // NANOSECONDS
    first = np.searchsorted(seconds, seconds, side="left")
    last = np.searchsorted(seconds, seconds, side="right")
    rank = np.arange(time.size) - first
    # Ticks count periods of 1/usual s; a row's tick is whole where its second is.
    row = np.arange(time.size, dtype=np.float64)
    tick = (seconds * usual + rank).astype(np.float64)
    whole = last - first == usual
    for edge in np.split(np.arange(time.size), np.flatnonzero(np.diff(seconds) > 1) + 1):
        whole_in_run = np.flatnonzero(whole[edge])
        if whole_in_run.size:
            tick[edge] = _interpolated(row[edge], tick[edge], whole_in_run)
        else:
            share = np.maximum(last[edge] - first[edge], usual)
            tick[edge] = (seconds[edge] + rank[edge] / share) * usual
    return np.asarray(start + np.round(tick * (NANOSECONDS / usual)), dtype=np.int64)


def _interpolated(row: FloatArray, tick: FloatArray, anchors: IntArray) -> FloatArray:
    """Ticks by row between the anchors, one tick a row before the first and after the last."""
    first, last = anchors[0], anchors[-1]
    found = np.interp(row, row[anchors], tick[anchors])
    found[:first] = tick[first] - (row[first] - row[:first])
    found[last:] = tick[last] + (row[last:] - row[last])
    return np.asarray(found)


def merge_same_time(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Merge rows of the same time: the first value present in each column is kept."""
    new = np.diff(table.time, prepend=NO_TIME) != 0
    if new.all():
        return table, []
    starts = np.flatnonzero(new)

    def first(column: Any, absent: BoolArray) -> Any:
        number = np.where(absent, len(table), np.arange(len(table)))
        present = np.minimum.reduceat(number, starts)
        return column[np.where(present < len(table), present, starts)]

    merged = replace(
        table.take(starts),
        signals={name: first(column, np.isnan(column)) for name, column in table.signals.items()},
        texts={name: first(words, words == "") for name, words in table.texts.items()},
    )
    return merged, table.found("same_time", ~new)


def count_gaps(table: Table, limits: Limits) -> Result:
    """Count the gaps; they are never filled."""
    step = np.diff(table.time)
    if not step.size:
        return table, []
    threshold = gap_threshold(table.time, limits)
    late = np.concatenate(([False], step > threshold * NANOSECONDS))
    longest = float(step.max()) / NANOSECONDS
    return table, table.found("gaps", late, note=f"longest {longest:.1f} s, beyond {threshold:g} s")


def gap_threshold(time: IntArray, limits: Limits) -> float:
    """Time between two rows [s] beyond which it counts as a gap."""
    return gap_beside(usual_step(time), limits)


def gap_beside(usual: float, limits: Limits) -> float:
    """The same where rows usually lie so far apart [s]."""
    return max(1.0, round(5.0 * usual, 3)) if limits.gap is None else limits.gap


def usual_step(time: IntArray) -> float:
    """Median time between two rows of different time [s]; 0 if there is none."""
    step = np.diff(time)
    step = step[step > 0]
    return float(np.median(step)) / NANOSECONDS if step.size else 0.0


# ------------------------------------------------------------------ clocks that were set


ROLLOVER = 1024 * 7 * DAY
"""Weeks of GPS time are counted modulo 1024 [ns]."""

QUARTER = 900 * NANOSECONDS
"""Time zones differ by multiples of a quarter of an hour [ns]."""

EARLY = np.datetime64("2007-01-01").astype("datetime64[ns]").astype(np.int64)
"""Time [ns] before which a recording is rather one of today with a week number that rolled over."""

MOST_ZONE = 14 * 3600 * NANOSECONDS
"""Time zones span 26 hours, but nobody sets a clock by more than so much [ns]."""

SMALLEST_STD = 0.2
"""Standard deviation [m] that no distance undercuts."""

LEAST_STEP = 0.6
"""Smaller steps [s] are left: receivers themselves are late by as much."""

LARGEST = 60.0
"""Longer steps forward [s] are pauses, after which a recorder may begin where it left off: they are
reported where the train cannot have come so little; longer ones back are of zones and dates."""

HARDEST = 0.3, STEEPEST
"""Acceleration and braking [m/s²] of which every train, and of which some train, is capable."""

WINDOWS = 2.0, CHORD
"""Times [s] before and after a step over which distances are compared: a receiver that begins late
after a gap has caught up within the longer one."""

REPLAYING = 300.0
"""For how long receivers replay after a gap [s]."""


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
    found = _seconds(table.at(time + shift))
    shift = shift + found.level
    if not shift.any():
        return table, []
    sizes = ", ".join(_size(int(size)) for size in np.unique(shift[shift != 0]))
    note = f"moved by {sizes}; clock_step = false under [repair] of the profile keeps the times"
    return table.at(found.time), table.found("clock_step", shift != 0, note=note)


def suspect_clock_steps(table: Table, limits: Limits) -> Result:
    """Report what may be steps of the clock, and what may be dates of another week count."""
    findings: list[Finding] = []
    if len(table) < ENOUGH:
        return table, findings
    undecided = _seconds(table).undecided
    if undecided:
        marked = np.zeros(len(table), dtype=np.bool_)
        marked[[place + 1 for place, _ in undecided]] = True
        sizes = ", ".join(f"{round(size, 1):+.9g} s" for _, size in undecided)
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
    steps = np.array([np.count_nonzero(each) for each in (weeks, days, others)])
    # A receiver may lose its date, and find it again, as often as it loses the sky.
    counted = steps[[0, 2]] if _undated(time).any() else steps
    if not steps.any() or counted.sum() > MANY:
        return none
    week, zone = _levels(weeks), _levels(others)
    values, counts = np.unique(zone, return_counts=True)
    # The latest week that is no slip of a few rows, and the zone of the most rows.
    shift = week[_common(week)].max() - week + values[np.argmax(counts)] - zone
    shift += _to_dated(time, _levels(days))
    before, after = _disorder(time, limits.pause), _disorder(time + shift, limits.pause)
    return shift if after < before else none


def _levels(edges: IntArray) -> IntArray:
    """How far the clock is off in each row, against the first [ns]."""
    return np.concatenate(([0], np.cumsum(edges)))


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

    Nothing where no date is that of three quarters of them, nor for a few rows with another.
    """
    none = np.zeros(levels.size, dtype=np.int64)
    undated = _undated(time)
    if undated.all() or not levels.any():
        return none
    values, counts = np.unique(levels[~undated], return_counts=True)
    if counts.max() < (1.0 - MAX_DROPPED) * counts.sum():
        return none
    right = values[np.argmax(counts)]
    few = values[counts < ENOUGH]
    return np.where(~undated & np.isin(levels, few), 0, right - levels)


def _edges(time: IntArray, unit: int, real: float = SPAN * NANOSECONDS) -> IntArray:
    """Steps by multiples of a unit [ns], besides which `real` may have passed; 0 where none is."""
    step = np.diff(time)
    count = np.floor_divide(step + int(real), unit)
    return np.where(np.abs(step - count * unit) <= real, count * unit, 0)


def _disorder(time: IntArray, pause: float) -> int:
    """How many rows are out of order, or do not belong to the trip."""
    return int(np.count_nonzero(~longest_nondecreasing(time) | outside_largest_group(time, pause)))


# ------------------------------------------------------------------ seconds


class _Found(NamedTuple):
    """What steps of seconds do to the rows.

    Attributes
    ----------
    level, time : (n,) array [ns]
        How far each row is moved, and where to; whole seconds where the file has no others.
    undecided : list of (int, float)
        Rows behind which the clock may have been set, and by how many seconds.
    """

    level: IntArray
    time: IntArray
    undecided: list[tuple[int, float]]


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
        """The rows of a table; None if they come too rarely, or are written several times each."""
        usual, seconds = rows_per_second(table), seconds_of(table)
        repeated = usual > 1 and len(table) > 1.5 * usual * (np.ptp(seconds) + 1.0)
        if usual > 1:
            time, period = _with_fractions(seconds, usual), 1.0 / usual
        else:
            time, period = seconds, usual_step(table.time)
        if repeated or not 0.0 < period <= 2.0:
            return None
        late = np.diff(time) - period
        steps = (np.abs(late) > max(LEAST_STEP, 0.7 * period)) | (np.diff(seconds) < 0.0)
        return cls(table, time, period, usual > 1, late, np.flatnonzero(steps))

    @property
    def least(self) -> float:
        """Smaller settings [s] are left: whole seconds of single rows are rounded."""
        rounded = not self.whole and not np.any(self.table.time % NANOSECONDS)
        return LEAST_STEP + rounded

    def size(self, size: float, std: float = 0.0) -> float:
        """By how many seconds the clock was set: whole ones if they are as good.

        Where rows carry whole seconds, one that is missing moves the others of its second.
        """
        likely = max(2.0 * std, 1.5 * self.period * self.whole)
        return float(round(size)) if abs(size - round(size)) <= likely else size

    def at(self, level: FloatArray) -> IntArray:
        """Time of each row [ns] that is moved by a level [s]."""
        if not self.whole:
            return self.table.time + np.round(level * NANOSECONDS).astype(np.int64)
        # What lies within a second is rebuilt from the rows of each second.
        seconds = np.floor(np.round(self.time + level, 6)) - np.floor(np.round(self.time, 6))
        return self.table.time + seconds.astype(np.int64) * NANOSECONDS

    def written_twice(self, place: int) -> float:
        """Share of the rows behind a step back whose times were written before, with other values.

        Times are given again up to that of the row before the step.
        """
        following = np.append(self.steps, self.time.size - 1)
        beyond = following[np.searchsorted(following, place, side="right")] + 1
        after = np.arange(place + 1, beyond)
        after = after[self.time[after] < self.time[place] + 0.5 * self.period]
        back = round((self.time[place] - self.time[place + 1]) / self.period)
        before = np.arange(max(place - 2 * (back + after.size), 0), place + 1)
        before = before[np.argsort(self.time[before], kind="stable")]
        nearest = np.searchsorted(self.time[before], self.time[after] - 0.5 * self.period)
        nearest = before[np.minimum(nearest, before.size - 1)]
        twice = np.abs(self.time[nearest] - self.time[after]) <= 0.5 * self.period
        columns = self.table.signals.values()
        other = [np.abs(column[nearest] - column[after]) > 0.0 for column in columns]
        return float(np.mean(twice & np.any(other, axis=0)))


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
    short = sizes < usual
    pair = short[1:] & short[:-1] & (np.abs(sizes[1:] + sizes[:-1] - usual) <= 1) & goes_on
    after_step |= np.concatenate(([False], pair))
    from_end = (after_step & (sizes < usual))[group]
    rest = np.maximum(usual - sizes, 0)[group]
    return np.asarray(seconds + (rank + np.where(from_end, rest, 0)) / usual)


def _seconds(table: Table) -> _Found:
    """What steps of seconds do to the rows."""
    doubled = np.zeros(len(table), dtype=np.bool_)
    if rows_per_second(table) == 1:
        doubled[1:] = same_as_previous(table)[1:] & (np.diff(table.time) == 0)
    single, behind = np.flatnonzero(~doubled), np.cumsum(~doubled) - 1
    rows = _Rows.of(table.take(single) if doubled.any() else table)
    nothing = _Found(np.zeros(len(table), dtype=np.int64), table.time, [])
    if rows is None or not rows.steps.size:
        return nothing
    apart = np.flatnonzero(np.diff(rows.steps) * rows.period > WINDOWS[-1])
    clusters = np.split(rows.steps, apart + 1)
    if len(clusters) > MANY:
        return nothing
    level = np.zeros(single.size)
    motion, undecided = _Motion.of(rows), []
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
                undecided.append((int(single[place]), size))
    # Clocks are set right: the last level holds.
    level = level[_common(level)][-1] - level
    moved = np.round(level * NANOSECONDS).astype(np.int64)
    return _Found(moved[behind], rows.at(level)[behind], undecided)


def _mixed(rows: _Rows, steps: IntArray) -> tuple[float, IntArray] | None:
    """By how many seconds the clock was set while rows of both clocks were written in turn.

    And which rows from the first step to the last one are by the new clock; None if they are not
    so mixed.
    """
    if steps.size < ENOUGH:
        return None
    before, after = int(steps[0]), int(steps[-1]) + 1
    inner = np.arange(before + 1, after)
    by_count = rows.time[before] + (np.append(inner, after) - before) * rows.period
    # Of a second of which rows are mixed only the whole is known.
    unsure = 1.5 * rows.period if rows.whole else 0.0
    size = rows.size(float(rows.time[after] - by_count[-1]), unsure)
    shown = np.floor(rows.time[inner]) + 0.5 if rows.whole else rows.time[inner]
    slack = 0.5 + 2.0 * rows.period if rows.whole else max(0.5 * rows.period, 0.25)
    # By one row: of two clocks some times are given twice, else rows were swapped and one lost.
    swapped = np.unique(rows.time[before : after + 1]).size == after + 1 - before
    if abs(size) < LEAST_STEP or (swapped and abs(size) < 1.5 * rows.period):
        return None
    ahead = ((shown - by_count[:-1]) / size > 0.5).astype(np.int64)
    fits = np.abs(shown - by_count[:-1] - size * ahead) <= slack
    changes = np.count_nonzero(np.diff(np.concatenate(([0], ahead, [1]))))
    return (size, ahead) if np.mean(fits) >= NEARLY_ALL and changes >= ENOUGH else None


def _set_by(rows: _Rows, motion: _Motion | None, place: int) -> tuple[float, bool]:
    """By how many seconds the clock was set after a row, 0 if it was not; and whether that is sure.

    A step back that gives times again says so by itself; where the rows of these times are new,
    they were written late.
    """
    late = float(rows.late[place])
    pause = late >= LARGEST
    if late * NANOSECONDS <= -QUARTER or (pause and (motion is None or not motion.signed)):
        return 0.0, False
    if late < 0.0 and rows.written_twice(place) <= MOST:
        return 0.0, False
    shown = (0.0, 0.0, 0.0) if motion is None else motion.likelier(place, late)
    again = late <= -SEVERAL * rows.period
    likelier, size = shown[0] + SURE * again, rows.size(late - shown[1], shown[2])
    if abs(size) < rows.least or likelier < LIKELY:
        return 0.0, False
    return size, likelier >= SURE and not pause


def _common(levels: IntArray | FloatArray) -> BoolArray:
    """Which rows are on a level that is no slip of a few rows."""
    _, owner, counts = np.unique(levels, return_inverse=True, return_counts=True)
    return np.asarray(((counts >= ENOUGH) | (counts == counts.max()))[owner])


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
    usual : (w, 2) array [s], [m]
        Of `WINDOWS` that are known each, and the standard deviation of what `rest` changes by over
        so long before and after a place without a step.
    hardest : (2,) array [m/s²]
        How hard the train may start and brake unseen.
    signed : bool
        Whether the distance is the train's own rather than that between fixes.
    """

    rows: IntArray
    time: FloatArray
    rest: FloatArray
    speed: FloatArray
    broken: IntArray
    usual: FloatArray
    hardest: FloatArray
    signed: bool

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
        passed = rows.late + rows.period
        passed[rows.steps] = rows.period
        time = np.concatenate(([0.0], np.cumsum(np.maximum(passed, 0.0))))[known]
        broken = np.searchsorted(rows.steps, known)
        # One row a second, and the first and the last one between steps.
        first = (np.diff(np.floor(time), prepend=-1) != 0) | (np.diff(broken, prepend=-1) != 0)
        nodes = np.flatnonzero(first | (np.diff(broken, append=-1) != 0))
        if nodes.size < ENOUGH:
            return None
        driven = cumulative_trapezoid(speed[known], time, initial=0.0)[nodes]
        known, time, broken = known[nodes], time[nodes], broken[nodes]
        chords = np.cumsum(np.abs(np.diff(places[known], prepend=places[known[0]])))
        along = places[known].real if signed else chords
        # Distance over the integral of the speed, the median over up to 20 s without a step.
        last = np.searchsorted(broken, broken, side="right") - 1
        later = np.minimum(np.searchsorted(time, time + WINDOWS[-1]), last)
        by_speed = driven[later] - driven
        found = agreement(along[later] - along, by_speed, by_speed > WINDOWS[-1] * MOVING)
        if found is None:
            return None
        rest, speed = along - found.ratio * driven, found.ratio * speed[known]
        later = np.minimum(np.searchsorted(time, time + SPAN), last)
        rate = (speed[later] - speed) / np.maximum(time[later] - time, SPAN)
        hardest = np.clip(MARGIN * np.abs(np.quantile(rate, (0.99, 0.01))), *HARDEST)
        usual = []
        for window in WINDOWS:
            left, right = _around(time, np.flatnonzero(speed > MOVING), window)
            whole = (broken[left] == broken[right]) & (time[right] - time[left] > 1.5 * window)
            change = np.abs(rest[right] - rest[left])[whole]
            if change.size >= ENOUGH:
                # Nine of ten lie within 1.64 standard deviations.
                usual.append((window, max(float(np.quantile(change, 0.9)) / 1.64, SMALLEST_STD)))
        if not usual:
            return None
        return cls(known, time, rest, speed, broken, np.array(usual), hardest, signed)

    def likelier(self, place: int, late: float) -> tuple[float, float, float]:
        """How much likelier (logarithm) than `late` seconds without rows a setting of the clock is.

        And the time [s] without rows besides, with its standard deviation. What the distance across
        the place exceeds that of the speeds by is nothing where no row is missing, and the way of
        the train meanwhile where rows are. Zeros where the train stands, or other steps are too
        close.
        """
        nothing = 0.0, 0.0, 0.0
        after = int(np.searchsorted(self.rows, place, side="right"))
        before = after - 1
        if before < 0 or after >= self.rows.size or self.broken[after] != self.broken[before] + 1:
            return nothing
        edges = int(np.searchsorted(self.broken, self.broken[before]))
        beyond = int(np.searchsorted(self.broken, self.broken[after], side="right")) - 1
        speeds = self.speed[[before, after]]
        speed = float(np.mean(speeds))
        if np.min(speeds) < MOVING or min(before - edges, beyond - after) < 2:
            return nothing
        windows, std = self.usual.T
        left = np.maximum(_around(self.time, before, windows)[0], edges)
        right = np.minimum(_around(self.time, after, windows)[1], beyond)
        way = self.rest[right] - self.rest[left]
        # How far the way is from any that a train can come in the time that is shown, against how
        # far it is from that of rows that are missing besides, or of none. A receiver that begins
        # late after a gap has caught up within the longer window.
        least, most = reach(speeds, late, *self.hardest)
        missing = bool(np.any(np.abs(way) > GATE * std))
        beside = way - np.clip(way, least, most)
        gain = 0.5 * (beside**2 - (0.0 if missing else way) ** 2) / std**2
        likelier = float(np.min(gain) if missing or np.min(gain) <= 0.0 else np.max(gain))
        if not missing:
            caught_up = not self.signed and self._caught_up(after, 0.5 * speed * late)
            return nothing if caught_up else (likelier, 0.0, 0.0)
        if not self.signed:
            # Receivers hold places around a gap, and the line bends in it.
            likelier = 0.0
        # The mean of the speeds, and how far speeds that bend lie above it.
        around = [left[0], before, after, right[0]]
        rates = np.diff(self.speed[around]) / np.maximum(np.diff(self.time[around]), 1.0)
        bent = (rates[0] - rates[2]) / 12.0 * way / speed
        took = way / (speed + np.clip(bent, -0.3 * speed, 0.3 * speed))
        widths = [np.subtract(*reach(speeds, each, *self.hardest)) / 6.0 for each in took]
        unsure = np.hypot(std, widths) / speed
        best = int(np.argmin(unsure))
        if not 0.0 < took[best] < LARGEST:
            return nothing
        return likelier, float(took[best]), float(unsure[best])

    def _caught_up(self, first: int, least: float) -> bool:
        """Whether fixes come `least` [m] further than the speeds say in the minutes after a row.

        Then the receiver replayed, after a gap, what it had kept, until it showed its own place.
        """
        marks = np.arange(self.time[first], self.time[-1], WINDOWS[-1])
        at = np.searchsorted(self.time, marks)
        whole = np.diff(self.broken[at]) == 0
        further = np.diff(self.rest[at])
        if least <= 0.0 or not whole.any():
            return False
        leaps = whole & (further > GATE * robust_std(further[whole]))
        soon = marks[1:] <= self.time[first] + REPLAYING
        return bool(further[leaps & soon].sum() >= least)


def _around(
    time: FloatArray, places: int | IntArray, window: float | FloatArray
) -> tuple[IntArray, IntArray]:
    """The rows a time [s] before and after places."""
    left = np.searchsorted(time, time[places] - window)
    return left, np.searchsorted(time, time[places] + window, side="right") - 1

"""Steps of a recorder's clock by an amount that is known: whole blocks of rows are put back.

The clock of a recorder is set while it records: by 1024 weeks where the receiver's week number
rolled over, by quarters of an hour where the time zone or summer time was corrected, by whole
seconds where the receiver learnt the leap seconds. A step back shows; a step forward looks like a
gap and stays one, unless it undoes a step back or is of 1024 weeks.
"""

from __future__ import annotations

import numpy as np

from trainlog.ingest.clock import (
    NANOSECONDS,
    Result,
    longest_nondecreasing,
    outside_largest_group,
    usual_step,
)
from trainlog.ingest.profile import Limits
from trainlog.ingest.recording import IntArray, Table

ROLLOVER = 1024 * 7 * 86_400 * NANOSECONDS
"""Weeks of GPS time are counted modulo 1024 [ns]."""

QUARTER = 900 * NANOSECONDS
"""Time zones differ by multiples of a quarter of an hour [ns]."""

MOST_QUARTERS = 56
"""Time zones span 26 hours, but nobody sets a clock by more than 14."""

MOST_LEAPS = 18
"""GPS time is 18 s ahead of UTC: what a receiver may have to learn."""

REAL = 5 * NANOSECONDS
"""Time that may really pass while a clock is set [ns]."""

MOST_EDGES = 50
"""Steps beyond which it is not the clock that was set."""


def undo_clock_steps(table: Table, limits: Limits) -> Result:
    """Put the rows before or after a step of the clock where they belong.

    Of two levels of the clock the one that holds for more rows is right, for 1024 weeks the later
    one. Rows are moved only if that brings more rows into order.
    """
    time = table.time
    if len(table) < 10 or (not np.any(np.diff(time) < 0) and np.ptp(time) < ROLLOVER // 2):
        return table, []
    weeks = _week_edges(time, limits.pause)
    others = _zone_edges(time)
    if not np.any(others < 0):
        others[:] = 0
    others += np.where((weeks == 0) & (others == 0), _leap_edges(table), 0)
    edges = np.count_nonzero(weeks) + np.count_nonzero(others)
    if not 0 < edges <= MOST_EDGES:
        return table, []
    shift = _to_latest(_levels(weeks)) + _to_most(_levels(others))
    moved = time + shift
    if _disorder(moved, limits.pause) >= _disorder(time, limits.pause):
        return table, []
    sizes = ", ".join(_told(int(size)) for size in np.unique(shift[shift != 0]))
    return table.at(moved), table.found("clock_step", shift != 0, note=f"moved by {sizes}")


def _told(shift: int) -> str:
    if shift % ROLLOVER == 0:
        return f"{1024 * (shift // ROLLOVER):+d} weeks"
    return f"{shift / NANOSECONDS:+.0f} s"


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
    real = values[(counts >= 10) | (counts == counts.max())]
    return np.asarray(real.max() - levels)


def _week_edges(time: IntArray, pause: float) -> IntArray:
    """Steps by multiples of 1024 weeks [ns], 0 where there is none."""
    step = np.diff(time)
    count = np.round(step / ROLLOVER).astype(np.int64)
    rest = np.abs(step - count * ROLLOVER)
    return np.where(rest <= pause * NANOSECONDS, count * ROLLOVER, 0)


def _zone_edges(time: IntArray) -> IntArray:
    """Steps by multiples of a quarter of an hour [ns], 0 where there is none."""
    step = np.diff(time)
    count = step // QUARTER
    fits = (count != 0) & (np.abs(count) <= MOST_QUARTERS) & (step - count * QUARTER <= REAL)
    return np.where(fits, count * QUARTER, 0)


def _leap_edges(table: Table) -> IntArray:
    """Steps back by 1 to 18 whole seconds [ns], 0 where there is none.

    A block that was written late goes back too. A clock that was set back tells its times twice,
    with other values.
    """
    time = table.time
    found = np.zeros(time.size - 1, dtype=np.int64)
    usual = round(usual_step(time) * NANOSECONDS)
    step = np.diff(time)
    if not usual or (np.any(step == 0) and not np.any(time % NANOSECONDS)):
        return found
    seconds = np.round((usual - step) / NANOSECONDS).astype(np.int64)
    fits = (step < 0) & (seconds >= 1) & (seconds <= MOST_LEAPS)
    fits &= np.abs(step + seconds * NANOSECONDS - usual) <= usual // 2
    places = np.flatnonzero(fits)
    if places.size > MOST_EDGES:
        return found
    for place in places:
        if _told_twice(table, int(place), usual):
            found[place] = -seconds[place] * NANOSECONDS
    return found


def _told_twice(table: Table, place: int, usual: int) -> bool:
    """Whether the times between row `place` and the next are told before and after, differently."""
    time = table.time
    low, high = time[place + 1], time[place]
    capacity = (high - low) // usual + 1
    reach = int(2 * capacity + 10)
    before = np.arange(max(0, place + 1 - reach), place + 1)
    after = np.arange(place + 1, min(time.size, place + 1 + reach))
    before = before[(time[before] >= low) & (time[before] <= high)]
    after = after[(time[after] >= low) & (time[after] <= high)]
    if before.size + after.size < 1.5 * capacity:
        return False
    nearest = before[np.abs(time[before][None, :] - time[after][:, None]).argmin(axis=1)]
    same = np.ones(after.size, dtype=np.bool_)
    for values in table.signals.values():
        a, b = values[after], values[nearest]
        same &= (a == b) | (np.isnan(a) & np.isnan(b))
    return bool(np.mean(same) < 0.5)


def _disorder(time: IntArray, pause: float) -> int:
    """How many rows are out of order, or do not belong to the trip."""
    return int(np.count_nonzero(~longest_nondecreasing(time) | outside_largest_group(time, pause)))

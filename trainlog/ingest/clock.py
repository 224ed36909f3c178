"""Rules on rows and their time: which rows stay, in which order, at which instant.

Each rule takes a table and the profile's limits and returns the table it leaves and what it found.
Clocks that were set while they recorded are in `trainlog.ingest.clock_steps`.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numba import njit

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.ingest.profile import Limits
from trainlog.ingest.recording import NEARLY_ALL, NO_TIME, SELDOM, Finding, Table
from trainlog.units import NANOSECONDS

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
    latitude = table.signals.get("/gnss/fix.latitude")
    longitude = table.signals.get("/gnss/fix.longitude")
    if latitude is None or longitude is None:
        return None
    fix = np.isfinite(latitude) & np.isfinite(longitude) & ((latitude != 0.0) | (longitude != 0.0))
    satellites = table.signals.get("/gnss/motion.satellites")
    if satellites is not None:
        fix &= satellites != 0.0
    accuracy = table.signals.get("/gnss/fix.horizontal_accuracy")
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
    run = np.cumsum(np.diff(seconds, prepend=seconds[0]) > 1)
    first = np.searchsorted(seconds, seconds, side="left")
    last = np.searchsorted(seconds, seconds, side="right")
    rank = np.arange(time.size) - first
    # Ticks count periods of 1/usual s; a row's tick is whole where its second is.
    row = np.arange(time.size, dtype=np.float64)
    tick = (seconds * usual + rank).astype(np.float64)
    whole = last - first == usual
    for edge in _run_edges(run):
        whole_in_run = np.flatnonzero(whole[edge])
        if whole_in_run.size:
            tick[edge] = _interpolated(row[edge], tick[edge], whole_in_run)
        else:
            share = np.maximum(last[edge] - first[edge], usual)
            tick[edge] = (seconds[edge] + rank[edge] / share) * usual
    return np.asarray(start + np.round(tick * (NANOSECONDS / usual)), dtype=np.int64)


def _run_edges(run: IntArray) -> list[slice]:
    edges = np.concatenate(([0], np.flatnonzero(np.diff(run)) + 1, [run.size]))
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]


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
    number = np.arange(len(table))
    merged = table.take(starts)
    values, texts = dict(merged.signals), dict(merged.texts)
    for name, column in table.signals.items():
        candidates = np.where(np.isnan(column), len(table), number)
        present = np.minimum.reduceat(candidates, starts)
        values[name] = column[np.where(present < len(table), present, starts)]
    for name, words in table.texts.items():
        candidates = np.where(words == "", len(table), number)
        present = np.minimum.reduceat(candidates, starts)
        texts[name] = words[np.where(present < len(table), present, starts)]
    return replace(merged, signals=values, texts=texts), table.found("same_time", ~new)


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
    if limits.gap is not None:
        return limits.gap
    return max(1.0, round(5.0 * usual_step(time), 3))


def usual_step(time: IntArray) -> float:
    """Median time between two rows of different time [s]; 0 if there is none."""
    step = np.diff(time)
    step = step[step > 0]
    return float(np.median(step)) / NANOSECONDS if step.size else 0.0

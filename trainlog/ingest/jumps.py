"""Values that jump: spikes, places that no train gets to, counters that lose their distance.

A spike is a piece of a column that nothing can have jumped to and back from. A counter is known
from the distance that it loses: all of it, or the same distance every time, when it starts anew or
wraps; and whole stretches between two stops, when it counts down because the train has turned.
Other steps stay and are reported: the chainage of another line, a balise, a wheel diameter that was
set.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from trainlog.ingest.clock import MAX_DROPPED, Result, gap_threshold
from trainlog.ingest.motion import (
    ACCURACY,
    ALIKE,
    ENOUGH,
    FEW,
    FIX_STD,
    GNSS_SPEED,
    HOLD,
    INLIER,
    LATITUDE,
    LONGITUDE,
    MARGIN,
    POSITION,
    RESTING,
    SEVERAL,
    SPAN,
    SPEED,
    STANDING,
    STAYED,
    STEEPEST,
    covered,
    plane,
    repeats,
    seconds_of,
    speed_of,
)
from trainlog.ingest.profile import Limits
from trainlog.ingest.recording import MOST, NEARLY_ALL, Finding, Table, base_name
from trainlog.spans import runs_of

FIX_TOLERANCE = 20.0
"""By how much satellite positions of perfect accuracy may err from one to the next [m]."""

FASTER = 10.0
"""How much faster than recorded positions may move [m/s], beyond `MARGIN`."""

POOR = 3.0
"""Ratio to the usual accuracy from which on a fix is compared with those around it."""

UNSTEADY = 2.0
"""By how much a step may differ from what was driven [m/s], beside a share `INLIER` of it."""


def blank_spikes(table: Table, limits: Limits) -> Result:
    """Take away values that nothing can have jumped to and back from.

    A column is cut wherever two values differ by more than ``tolerance + rate * (time between
    them)``. Of its pieces those are kept that make the best sequence: the most samples, less
    `SPAN` for every two that follow each other and do not fit. The sample after a spike, and
    runs of several, are judged in the same way as a spike. What changes no faster than `rate` is
    never taken for one, whatever its sampling; nor is anything where most would be.
    """
    findings: list[Finding] = []
    seconds = seconds_of(table)
    for name, values in table.signals.items():
        bounds = limits.of(name)
        if math.isinf(bounds.rate):
            continue
        spike = spikes(seconds, values, bounds.rate, bounds.tolerance)
        findings += table.found("spikes", spike, base_name(name))
        if spike.any():
            table = table.without(name, spike)
    leaps = leaping_fixes(table, limits, seconds)
    if leaps.any():
        for name in (LATITUDE, LONGITUDE):
            findings += table.found("spikes", leaps, name)
            table = table.without(name, leaps)
    return table, findings


def spikes(
    seconds: FloatArray,
    values: FloatArray | ComplexArray,
    rate: float | FloatArray,
    tolerance: float,
) -> BoolArray:
    """Mark spikes; see `blank_spikes`.

    Parameters
    ----------
    seconds : (n,) array [s]
        Increasing.
    values : (n,) array
        NaN where absent; absent values take no part. Complex: places in a plane.
    rate : float or (n,) array
        How fast they change, in the unit of `values` a second.
    tolerance : float
        In the unit of `values`.
    """
    marked = np.zeros(values.size, dtype=np.bool_)
    present = np.flatnonzero(np.isfinite(values))
    if present.size < ENOUGH:
        return marked
    known, at = values[present], seconds[present]
    fastest = np.broadcast_to(np.asarray(rate, dtype=np.float64), values.shape)[present]
    allowed = tolerance + np.maximum(fastest[1:], fastest[:-1]) * np.diff(at)
    cuts = np.flatnonzero(np.abs(np.diff(known)) > allowed)
    if not cuts.size:
        return marked
    first = np.concatenate(([0], cuts + 1))
    last = np.concatenate((cuts, [present.size - 1]))
    kept = _best_sequence(first, last, at, known, fastest, tolerance)
    outside = np.repeat(~kept, last - first + 1)
    if np.count_nonzero(outside) <= MAX_DROPPED * present.size:
        marked[present] = outside
    return marked


def _best_sequence(
    first: IntArray,
    last: IntArray,
    at: FloatArray,
    known: FloatArray | ComplexArray,
    rate: FloatArray,
    tolerance: float,
) -> BoolArray:
    """Which pieces, each from sample `first` to `last`, make the best sequence."""
    size = last - first + 1.0
    step = float(np.median(np.diff(at)))
    price = max(SEVERAL, round(SPAN / step)) if step > 0.0 else SEVERAL
    best, before = size.copy(), np.full(size.size, -1)
    for piece in range(1, size.size):
        others = np.arange(max(0, piece - ENOUGH), piece)
        end, begin = last[others], first[piece]
        allowed = tolerance + np.maximum(rate[end], rate[begin]) * (at[begin] - at[end])
        fits = np.abs(known[begin] - known[end]) <= allowed
        score = best[others] - np.where(fits, 0, price)
        # Of equals the nearest.
        chosen = score.size - 1 - int(np.argmax(score[::-1]))
        if score[chosen] > 0.0:
            best[piece] += score[chosen]
            before[piece] = others[chosen]
    kept = np.zeros(size.size, dtype=np.bool_)
    piece = int(np.argmax(best))
    while piece >= 0:
        kept[piece] = True
        piece = int(before[piece])
    return kept


def leaping_fixes(table: Table, limits: Limits, seconds: FloatArray) -> BoolArray:
    """Which satellite positions the train cannot have been at.

    The recorded speed bounds how far it gets from one to the next, else the largest speed that
    `limits` allow. A fix whose own accuracy is stated to be much worse than usual is compared with
    the good ones around it as well.
    """
    places = plane(table)
    if places is None:
        return np.zeros(len(table), dtype=np.bool_)
    stated = table.signals.get(ACCURACY, np.full(len(table), np.nan))
    stated = np.where(stated > 0.0, stated, np.nan)
    known = stated[np.isfinite(stated) & np.isfinite(places)]
    usual = min(float(np.median(known)), STAYED) if known.size else FIX_STD
    tolerance = FIX_TOLERANCE + HOLD * usual
    fastest = limits.of(GNSS_SPEED).high
    leaps = spikes(seconds, places, _fastest(table, seconds, fastest), tolerance)
    poor = np.isfinite(places) & (stated > POOR * usual) & ~leaps
    return leaps | _beside(seconds, places, poor, np.isfinite(places) & ~leaps & ~poor, tolerance)


def _fastest(table: Table, seconds: FloatArray, most: float) -> FloatArray:
    """How fast satellite positions can move [m/s], by the recorded speed where there is one."""
    speed = speed_of(table, GNSS_SPEED, SPEED)
    if speed is None:
        return np.full(len(table), most)
    found = repeats(speed)
    at, column = seconds[found.known], speed[found.known]
    # A speed that repeats itself may be frozen: it bounds nothing.
    rests = np.repeat(at[found.last] - at[found.first] >= RESTING, found.samples)
    bound = np.where(rests, most, MARGIN * column + FASTER)
    return np.minimum(np.interp(seconds, at, bound), most)


def _beside(
    seconds: FloatArray,
    places: ComplexArray,
    poor: BoolArray,
    good: BoolArray,
    tolerance: float,
) -> BoolArray:
    """Which of the poor fixes are further from the way between the good ones than a train gets."""
    beside = np.zeros(places.size, dtype=np.bool_)
    asked, known = np.flatnonzero(poor), np.flatnonzero(good)
    after = np.searchsorted(known, asked)
    between = (after > 0) & (after < known.size)
    asked, after = asked[between], after[between]
    if not asked.size:
        return beside
    a, b = known[after - 1], known[after]
    since, until = seconds[asked] - seconds[a], seconds[b] - seconds[asked]
    there = (places[a] * until + places[b] * since) / (since + until)
    allowed = tolerance + 0.5 * STEEPEST * since * until
    beside[asked] = np.abs(places[asked] - there) > allowed
    return beside


# ------------------------------------------------------------------ counters


@dataclass(frozen=True, eq=False)
class _Counter:
    """The samples of a position.

    Attributes
    ----------
    seconds, position : (n,) array [s], [m]
    step : (n - 1,) array [m]
        From each sample to the next.
    driven : (n - 1,) array [m]
        As the speed gives it; NaN where it is not known, and over gaps.
    expected : (n - 1,) array [m]
        The same, over gaps too; without a speed by the steps around, and 0 over gaps.
    tolerance : (n - 1,) array [m]
        By which the two may differ.
    """

    seconds: FloatArray
    position: FloatArray
    step: FloatArray
    driven: FloatArray
    expected: FloatArray
    tolerance: FloatArray

    @property
    def lost(self) -> IntArray:
        """Steps back by more than a train can go back."""
        return np.flatnonzero(-self.step > self.tolerance + self.expected)


def unwrap_counters(table: Table, limits: Limits) -> Result:
    """Let a distance grow on where its counter started anew, wrapped or counted down."""
    position = table.signals.get(POSITION)
    if position is None:
        return table, []
    known = np.isfinite(position)
    if np.count_nonzero(known) < ENOUGH:
        return table, []
    counter = _counter(table, position, known, limits)
    gained = np.flatnonzero((counter.step - counter.expected) > counter.tolerance)
    back = _losses(counter, gained)
    words = [f"{back.size} times started anew or wrapped"] if back.size else []
    step = counter.step.copy()
    step[back] = counter.expected[back]
    down = _counting_down(counter, step)
    if down.any():
        step = np.where(down, -step, step)
        words.append(f"{len(runs_of(down))} stretches counted down")
    changed = step != counter.step
    if not changed.any():
        return table, []
    # Samples before the first change stay as they were written, to the last bit.
    first = int(np.argmax(changed)) + 1
    grown = counter.position.copy()
    grown[first:] = grown[first - 1] + np.cumsum(step[first - 1 :])
    shift = np.round(grown - counter.position, 6)
    # From the first one that was counted down on they are sums of steps.
    mirrored = np.concatenate(([False], np.cumsum(down) > 0))
    grown = np.where(mirrored, np.round(grown, 6), counter.position + shift)
    cells = np.zeros(len(table), dtype=np.bool_)
    cells[known] = grown != counter.position
    values = position.copy()
    values[known] = grown
    found = table.found("counter", cells, POSITION, ", ".join(words))
    return table.with_values(POSITION, values), found


def _counter(table: Table, position: FloatArray, known: BoolArray, limits: Limits) -> _Counter:
    clock = seconds_of(table)
    seconds, column = clock[known], position[known]
    step, took = np.diff(column), np.diff(seconds)
    bounds = limits.of(POSITION)
    rate, tolerance = bounds.rate, bounds.tolerance
    driven = expected = np.full(step.size, np.nan)
    recorded = speed_of(table)
    if recorded is not None:
        at = np.isfinite(recorded)
        speed = np.interp(seconds, clock[at], recorded[at])
        driven = 0.5 * (speed[1:] + speed[:-1]) * took
        # The two may be in other units: what they usually have in common counts.
        whole = (driven > 0.0) & (np.abs(step) > 0.0) & (np.abs(step) < tolerance + rate * took)
        if np.any(whole):
            driven = driven * float(np.sum(np.abs(step[whole])) / np.sum(driven[whole]))
    else:
        expected = median_filter(np.abs(step) / np.maximum(took, 1e-9), SEVERAL) * took
    late = took > gap_threshold(table.time, limits)
    expected = np.where(late, 0.0, expected) if recorded is None else np.nan_to_num(driven)
    driven = np.where(late, np.nan, driven)
    reach = tolerance + rate * took
    sure = tolerance + INLIER * driven + UNSTEADY * took
    reach = np.where(np.isfinite(driven), np.minimum(sure, reach), reach)
    return _Counter(seconds, column, step, driven, expected, reach)


def _losses(counter: _Counter, gained: IntArray) -> IntArray:
    """The steps at which a counter fell to 0, or by the same distance each time to its lowest."""
    lost = [place for place in counter.lost if _stays(counter, int(place), gained)]
    at = np.array(lost, dtype=np.int64)
    loss = counter.expected[at] - counter.step[at]
    at, loss = at[loss > STAYED], loss[loss > STAYED]
    after, slack = counter.position[at + 1], counter.tolerance[at]
    alike = np.abs(loss[:, None] - loss[None, :]) <= np.minimum(slack[:, None], slack[None, :])
    lowest = after <= np.min(counter.position) + 2.0 * slack
    return np.asarray(at[(np.abs(after) <= slack) | (lowest & (alike.sum(axis=1) >= 2))])


def _stays(counter: _Counter, place: int, gained: IntArray) -> bool:
    """Whether the samples after a loss follow it, and no step leads back at once."""
    if counter.position.size - place - 1 < SEVERAL:
        return False
    loss = counter.expected[place] - counter.step[place]
    soon = gained[np.abs(counter.seconds[gained] - counter.seconds[place]) <= RESTING]
    back = np.abs(counter.step[soon] - loss) <= np.maximum(counter.tolerance[soon], ALIKE * loss)
    return not bool(back.any())


def _counting_down(counter: _Counter, step: FloatArray) -> BoolArray:
    """Which steps lie in stretches between two stops in which the counter counts down.

    None if it does throughout: then it is the sign of the column.
    """
    none = np.zeros(step.size, dtype=np.bool_)
    if not np.any(step < 0.0):
        return none
    pace = counter.driven / np.maximum(np.diff(counter.seconds), 1e-9)
    if not np.isfinite(pace).any():
        # Without a speed, the counter's own over 3 s.
        later = np.minimum(np.searchsorted(counter.seconds, counter.seconds[:-1] + 3.0), step.size)
        total = np.concatenate(([0.0], np.cumsum(step)))
        took = np.maximum(counter.seconds[later] - counter.seconds[:-1], 1e-9)
        pace = np.abs(total[later] - total[:-1]) / took
    moving = ~(pace < STANDING)
    begins, ends = np.array(runs_of(moving), dtype=np.int64).reshape(-1, 2).T
    if not begins.size:
        return none
    possible = np.abs(step) <= counter.tolerance + counter.expected
    small = np.where(possible, step, 0.0)
    sums = np.concatenate(([0.0], np.cumsum(small)))
    ways = np.concatenate(([0.0], np.cumsum(np.abs(small))))
    net, both_ways = sums[ends] - sums[begins], ways[ends] - ways[begins]
    driven = np.concatenate(([0.0], np.cumsum(counter.expected)))
    far = np.maximum(both_ways, driven[ends] - driven[begins])
    falls = (net < -STAYED) & (-net >= MOST * far)
    if not falls.any() or -net[falls].sum() > NEARLY_ALL * np.abs(net).sum():
        return none
    return covered(begins[falls], ends[falls], step.size) & possible


def report_steps(table: Table, limits: Limits) -> Result:
    """Report steps of the position that nothing explains; they stay."""
    position = table.signals.get(POSITION)
    if position is None:
        return table, []
    known = np.isfinite(position)
    if np.count_nonzero(known) < 2:
        return table, []
    counter = _counter(table, position, known, limits)
    off = np.abs(counter.step - counter.expected)
    steps = off > counter.tolerance
    if np.count_nonzero(steps) > FEW * steps.size:
        return table, []
    if not steps.any():
        return table, []
    cells = np.zeros(len(table), dtype=np.bool_)
    cells[np.flatnonzero(known)[1:][steps]] = True
    largest = counter.step[steps][np.argmax(off[steps])]
    note = f"largest {largest:+.0f} m; a counter that started anew or another line's chainage?"
    return table, table.found("position_steps", cells, POSITION, note)

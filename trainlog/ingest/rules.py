"""The rules of repair, in the order in which they are applied; docs/ingest-rules.md has the table.

Those on rows and their time are in `trainlog.ingest.clock`, those on values that freeze in
`trainlog.ingest.frozen`; the others on values are here.

A spike is a piece of a column that nothing can have jumped to and back from. A counter is known
from the distance that it loses: all of it, or the same distance every time, when it starts anew or
wraps; and whole stretches between two stops, when it counts down because the train has turned.
Other steps stay and are reported: the chainage of another line, a balise, a wheel diameter that was
set.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import median_filter

from estimators.receiver import integral
from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.ingest import clock
from trainlog.ingest.clock import MAX_DROPPED, Result, gap_threshold, has_fix, longest_nondecreasing
from trainlog.ingest.frozen import blank_frozen
from trainlog.ingest.motion import (
    ACCURACY,
    ACTS,
    ALIKE,
    EFFORTS,
    ENOUGH,
    FAR,
    GNSS_SPEED,
    HOLD,
    INLIER,
    LATITUDE,
    LONGITUDE,
    MARGIN,
    MOVING,
    POSITION,
    RESTING,
    SEVERAL,
    SPAN,
    SPEED,
    STANDING,
    STAYED,
    STEEPEST,
    SUSPECT,
    WHEEL_SPEED,
    agreement,
    covered,
    driven_mass,
    fix_std,
    plane,
    repeats,
    scale_of,
    seconds_of,
    speed_of,
)
from trainlog.ingest.profile import Limits, Repair
from trainlog.ingest.recording import (
    MOST,
    NEARLY_ALL,
    NO_TIME,
    SELDOM,
    Finding,
    Raw,
    Table,
    base_name,
    field_of,
)
from trainlog.spans import runs_of
from trainlog.topics import Bounds

FEW = 0.01
"""Share of the steps up to which those that nothing explains are single ones; by which steps that
are written down are off."""


def blank_without_fix(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Take away the values of a receiver in rows without a satellite fix."""
    fix = has_fix(table)
    if fix is None or fix.all():
        return table, []
    present = np.zeros(len(table), dtype=np.bool_)
    for name, values in table.signals.items():
        if name.startswith("/gnss/"):
            present |= np.isfinite(values)
    lost = ~fix & present
    found = table.found("no_fix", lost)
    for name in table.signals:
        if name.startswith("/gnss/"):
            table = table.without(name, lost)
    return table, found


def impossible(values: FloatArray, bounds: Bounds) -> tuple[BoolArray, BoolArray]:
    """Which values are beyond their bounds, and which show the unit: 0 is it in any unit.

    Examples
    --------
    >>> impossible(np.array([0.0, 3.0, 900.0, np.nan]), Bounds(0.0, 100.0, 10.0, 1.0))
    (array([False, False,  True, False]), array([False,  True,  True, False]))
    """
    return (values < bounds.low) | (values > bounds.high), np.isfinite(values) & (values != 0.0)


def blank_out_of_limits(table: Table, limits: Limits) -> Result:
    """Take away values that are physically impossible.

    Raises
    ------
    InputError
        If most values of a column are: then it is the unit that is wrong.
    """
    findings: list[Finding] = []
    for name, values in table.signals.items():
        bounds = limits.of(name)
        out, judged = impossible(values, bounds)
        count, present = np.count_nonzero(out), np.count_nonzero(judged)
        if not count:
            continue
        if count > MOST * present:
            unit = field_of(name)[2].unit
            first = int(np.argmax(out))
            raise InputError(
                f"{base_name(name)}: {count} of {present} values are impossible, the first is"
                f" {values[first]:.6g} {unit}, limits {bounds.low:.6g} to {bounds.high:.6g}",
                place=f"row {table.rows[first]}",
                remedy="check the unit, scale and sign of its column in the profile",
            )
        findings += table.found("out_of_limits", out, base_name(name))
        table = table.without(name, out)
    return table, findings


FACTOR = 2.0
"""Ratio of two columns beyond which they cannot be of the units that the profile gives."""

TO_AND_FRO = 0.2
"""Share of the rows that leap away and back from which on they are those of two trains."""

LEVER = "/train/controls.lever"


def refuse_inconsistent(table: Table, limits: Limits) -> Result:
    """Refuse a table whose columns contradict each other by a factor, or by sign.

    Raises
    ------
    InputError
        If distance and speed, or two speeds, differ by more than `FACTOR`, position runs against
        the direction of travel, or the train slows down whenever it is driven.
    """
    for _, ratio, problem in ratios(table, limits):
        if not 1.0 / FACTOR <= ratio <= FACTOR:
            raise InputError(
                problem,
                remedy="check the units of the two columns in the profile (km/h, m/s, km, m)",
            )
    _refuse_sign(table)
    _refuse_two_trains(table, limits)
    return table, []


def _refuse_two_trains(table: Table, limits: Limits) -> None:
    """Refuse rows between which the train leaps to and fro: those of two trains."""
    for name in (POSITION, SPEED):
        if name not in table.signals:
            continue
        known, bounds = np.flatnonzero(np.isfinite(table.signals[name])), limits.of(name)
        values, step = table.signals[name][known], np.diff(seconds_of(table)[known])
        move = np.diff(values)
        leaps = np.sign(move) * (np.abs(move) > bounds.tolerance + bounds.rate * step)
        back = leaps[1:] * leaps[:-1] < 0.0
        if np.count_nonzero(back) > TO_AND_FRO * values.size > 0.0:
            row = table.rows[known[1 + int(np.argmax(back))]]
            raise InputError(
                f"{name} leaps to and fro in {np.mean(back):.0%} of the rows, as of two trains",
                place=f"row {row}",
                remedy="give a file of each train",
            )


def ratios(table: Table, limits: Limits) -> Iterator[tuple[str, float, str]]:
    """Ratios of columns that should measure the same, each with the column and in words.

    Raises
    ------
    InputError
        If position runs against the direction of travel.
    """
    speed = table.signals.get(SPEED)
    if speed is not None:
        position = table.signals.get(POSITION)
        if position is not None:
            yield from _distance_ratio(table, position, speed, limits)
        for name, other in table.signals.items():
            if name == GNSS_SPEED or name.startswith(WHEEL_SPEED):
                found = agreement(other, speed, speed > MOVING)
                if found is not None and found.holds:
                    yield name, found.ratio, f"{name} is {found.ratio:.4g} times {SPEED}"
    points = plane(table)
    for name in (GNSS_SPEED, SPEED):
        if points is not None and name in table.signals:
            seconds, speed = seconds_of(table), table.signals[name]
            ratio = scale_of(seconds, points, speed)
            if np.isfinite(ratio) and np.ptp(integral(seconds, speed)[0]) > FAR:
                words = f"{name} is {ratio:.4g} times the speed at which the fixes move"
                yield name, ratio, words


def _distance_ratio(
    table: Table, position: FloatArray, speed: FloatArray, limits: Limits
) -> Iterator[tuple[str, float, str]]:
    """Compare the change of position with the integral of speed, gaps left out."""
    known = np.isfinite(position) & np.isfinite(speed)
    seconds = seconds_of(table)[known]
    step = np.diff(seconds)
    whole = step <= gap_threshold(table.time, limits)
    moves = np.diff(position[known])
    bounds = limits.of(POSITION)
    leaps = whole & (np.abs(moves) > bounds.tolerance + bounds.rate * step)
    if np.count_nonzero(leaps) <= FEW * np.count_nonzero(whole):
        # Steps to another chainage are no unit.
        whole &= ~leaps
    moved = float(np.sum(moves[whole]))
    driven = float(np.sum(np.diff(integral(seconds, speed[known])[0])[whole]))
    if driven < FAR:
        return
    if moved < -FAR:
        raise InputError(
            f"{POSITION} falls by {-moved:.0f} m while the train drives {driven:.0f} m",
            remedy="position grows in the direction of travel: turn the sign of its column in the"
            " profile (-1, or 1 where it is -1), with minus the kilometre where this direction"
            " begins as offset",
        )
    yield POSITION, moved / driven, f"{POSITION} moves {moved:.0f} m, {SPEED} gives {driven:.0f} m"


def _refuse_sign(table: Table) -> None:
    """Refuse efforts, or a lever, that the train's acceleration runs against."""
    speed = table.signals.get(SPEED)
    if speed is None:
        return
    present = [name for name in EFFORTS if name in table.signals]
    if EFFORTS[0] in present:
        sizes = [np.nan_to_num(table.signals[name]) for name in present]
        _refuse_against(table, speed, sizes[0] - sum(sizes[1:]), " and ".join(present))
    lever = table.signals.get(LEVER)
    if lever is not None:
        _refuse_against(table, speed, np.nan_to_num(lever), LEVER)


def _refuse_against(table: Table, speed: FloatArray, push: FloatArray, name: str) -> None:
    strong = np.abs(push) >= ACTS * np.max(np.abs(push))
    driven = driven_mass(seconds_of(table), np.where(strong, push, np.nan), speed)
    if driven.decides and driven.correlation < 0.0:
        raise InputError(
            f"the train slows down whenever {name} would drive it"
            f" (correlation {driven.correlation:.2f})",
            remedy="check sign and part of the columns of the efforts and of the lever in the"
            " profile: traction speeds a train up",
        )


CONFUSIONS = {
    1.609: "miles an hour taken for km/h",
    1.852: "knots taken for km/h",
    1.944: "m/s taken for knots",
    1.152: "knots taken for miles an hour",
}
"""Ratios that units of speed have."""


def suspect_units(table: Table, limits: Limits) -> Result:
    """Report columns that disagree by a factor that is too small to be refused."""
    findings: list[Finding] = []
    for name, ratio, problem in ratios(table, limits):
        size = max(ratio, 1.0 / ratio) if ratio > 0.0 else np.inf
        if size < SUSPECT:
            continue
        nearest = min(CONFUSIONS, key=lambda known: abs(known - size))
        likely = f": {CONFUSIONS[nearest]}?" if abs(nearest / size - 1.0) < 0.02 else ""
        findings.append(Finding("unit_suspected", 1, (), base_name(name), problem + likely))
    return table, findings


def find_quantised(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Report columns whose steps are coarser than what they measure changes between two samples."""
    findings: list[Finding] = []
    for name, values in table.signals.items():
        item = field_of(name)[2]
        if item.interpolation != "linear":
            continue
        step = quantum(values)
        if step is not None:
            count, note = int(np.isfinite(values).sum()), f"steps of {step:.4g} {item.unit}"
            findings.append(Finding("quantised", count, (), base_name(name), note))
    return table, findings


def quantum(values: FloatArray) -> float | None:
    """The step of a column that moves by one step at a time; None if it does not.

    Parameters
    ----------
    values : (n,) array
        NaN where absent.
    """
    known = values[np.isfinite(values)]
    change = np.diff(known)
    moving = np.flatnonzero(change)
    if moving.size < 2 * ENOUGH:
        return None
    within = change[moving[0] : moving[-1] + 1]
    size = np.abs(within[within != 0.0])
    step = float(np.median(size))
    single: BoolArray = np.abs(size - step) <= FEW * step
    held = float(np.mean(within == 0.0))
    levels = (float(np.max(known)) - float(np.min(known))) / step
    if held < SELDOM or float(np.mean(single)) < NEARLY_ALL or levels < SEVERAL:
        return None
    return step


# ------------------------------------------------------------------ spikes


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
    usual = min(fix_std(table, places), STAYED)
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
    seconds: FloatArray, places: ComplexArray, poor: BoolArray, good: BoolArray, tolerance: float
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
    rows : (n,) int array
        Of the table.
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

    rows: IntArray
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
    counter = _counter(table, limits, ENOUGH)
    if counter is None:
        return table, []
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
    cells[counter.rows] = grown != counter.position
    values = table.signals[POSITION].copy()
    values[counter.rows] = grown
    found = table.found("counter", cells, POSITION, ", ".join(words))
    return table.with_values(POSITION, values), found


def _counter(table: Table, limits: Limits, least: int) -> _Counter | None:
    """The counter of a table; None with fewer samples than `least`."""
    position = table.signals.get(POSITION, np.zeros(0))
    rows = np.flatnonzero(np.isfinite(position))
    if rows.size < least:
        return None
    every = seconds_of(table)
    seconds, column = every[rows], position[rows]
    step, took = np.diff(column), np.diff(seconds)
    bounds = limits.of(POSITION)
    rate, tolerance = bounds.rate, bounds.tolerance
    driven = expected = np.full(step.size, np.nan)
    recorded = speed_of(table)
    if recorded is not None:
        at = np.isfinite(recorded)
        speed = np.interp(seconds, every[at], recorded[at])
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
    return _Counter(rows, seconds, column, step, driven, expected, reach)


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
    counter = _counter(table, limits, 2)
    if counter is None:
        return table, []
    off = np.abs(counter.step - counter.expected)
    steps = off > counter.tolerance
    if not 0 < np.count_nonzero(steps) <= FEW * steps.size:
        return table, []
    cells = np.zeros(len(table), dtype=np.bool_)
    cells[counter.rows[1:][steps]] = True
    largest = counter.step[steps][np.argmax(off[steps])]
    note = f"largest {largest:+.0f} m; a counter that started anew or another line's chainage?"
    return table, table.found("position_steps", cells, POSITION, note)


# ------------------------------------------------------------------ the table of rules


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule of repair.

    Attributes
    ----------
    name : str
        As in [repair] of the profile and in the report.
    off : {"refuse", "keep"}
        What happens to the defect when the rule is switched off: the file is refused, or the
        defect stays.
    apply : callable, optional
        ``apply(table, limits)`` gives the table that is left and what was found; absent for rules
        that the format's reader applies while it splits the file.
    """

    name: str
    off: Literal["refuse", "keep"]
    apply: Callable[[Table, Limits], Result] | None = None


RULES = (
    Rule("truncated_rows", "refuse"),
    Rule("damaged_messages", "refuse"),
    Rule("not_a_number", "refuse"),
    Rule("empty", "refuse"),
    Rule("newest_first", "refuse"),
    Rule("before_first_fix", "keep", clock.drop_before_first_fix),
    Rule("time_unreadable", "refuse", clock.drop_unreadable_time),
    Rule("clock_step", "keep", clock.undo_clock_steps),
    Rule("clock_step_suspected", "keep", clock.suspect_clock_steps),
    Rule("clock_jump", "refuse", clock.drop_clock_jumps),
    Rule("time_backwards", "refuse", clock.sort_time),
    Rule("duplicates", "refuse", clock.drop_duplicates),
    Rule("subsecond", "keep", clock.rebuild_subsecond),
    Rule("same_time", "refuse", clock.merge_same_time),
    Rule("no_fix", "keep", blank_without_fix),
    Rule("out_of_limits", "keep", blank_out_of_limits),
    Rule("counter", "keep", unwrap_counters),
    Rule("spikes", "keep", blank_spikes),
    Rule("frozen", "keep", blank_frozen),
    Rule("position_steps", "keep", report_steps),
    Rule("inconsistent", "keep", refuse_inconsistent),
    Rule("unit_suspected", "keep", suspect_units),
    Rule("quantised", "keep", find_quantised),
    Rule("gaps", "keep", clock.count_gaps),
    Rule("direction", "refuse"),
    Rule("contradicted", "keep"),
    Rule("off_line", "keep"),
    Rule("slip", "keep"),
    Rule("position_offset", "keep"),
)
"""Every rule by the order of its application; the last three where chainage is estimated."""


def changes(rule: str, before: Table, after: Table) -> list[Raw]:
    """What `rule` did to a table: rows that it moved or dropped, and values that it changed."""
    if before is after:
        return []
    place = np.full(int(before.samples.max(initial=-1)) + 1, -1, dtype=np.int64)
    place[before.samples] = np.arange(len(before))
    source = place[after.samples]
    time = np.full(len(before), NO_TIME)
    time[source] = after.time
    dropped = np.ones(len(before), dtype=np.bool_)
    dropped[source] = False
    moved = dropped | (time != before.time)
    if np.any(np.diff(source) < 0):
        moved |= ~longest_nondecreasing(before.time)
    found = [Raw(rule, "", before.rows, None, before.time, time).take(moved)]
    for name, values in before.signals.items():
        new = np.full(len(before), np.nan)
        new[source] = after.signals[name]
        cells = (values != new) & ~(np.isnan(values) & np.isnan(new))
        found.append(Raw(rule, name, before.rows, None, before.time, time, values, new).take(cells))
    for name, texts in before.texts.items():
        cells = dropped & np.asarray(texts != "", dtype=np.bool_)
        found.append(Raw(rule, name, before.rows, texts, before.time, time).take(cells))
    return [each for each in found if each.rows.size]


def refuse_switched_off(findings: tuple[Finding, ...], repair: Repair) -> None:
    """Refuse what the reader repaired although its rule is switched off.

    Raises
    ------
    InputError
        With the first row concerned.
    """
    for rule in RULES:
        if rule.off == "refuse" and not getattr(repair, rule.name):
            for finding in findings:
                if finding.rule == rule.name:
                    _refuse(finding)


def repaired(
    table: Table, limits: Limits, repair: Repair, least: int = 2
) -> tuple[Table, list[Finding], list[Raw]]:
    """Apply the rules, one after the other.

    Parameters
    ----------
    least : int
        Rows that have to be left: a trip needs 2, one table among several none.

    Returns
    -------
    Table, list of Finding, list of Raw
        What is left, what was met, and how what was changed stood before.

    Raises
    ------
    InputError
        If a defect cannot be repaired, or its rule is switched off and it cannot stay.
    """
    findings: list[Finding] = []
    changed: list[Raw] = []
    for rule in RULES:
        if rule.apply is None:
            continue
        wanted = getattr(repair, rule.name)
        if not wanted and rule.off == "keep":
            continue
        before = table
        table, found = rule.apply(before, limits)
        if found and not wanted:
            _refuse(found[0])
        findings += found
        changed += changes(rule.name, before, table)
        if len(table) < least:
            raise _too_short(before, table, rule.name)
        if not len(table):
            break
    return table, findings, changed


def _too_short(before: Table, table: Table, rule: str) -> InputError:
    every = f"rows {before.rows[0]} to {before.rows[-1]}" if len(before) else None
    if rule == "before_first_fix" and not len(table):
        fixed = np.count_nonzero(fix) if (fix := clock.has_fix(before)) is not None else 0
        dated = np.count_nonzero(before.time != NO_TIME)
        remedy = "the receiver never saw the sky; nothing can be made of this file"
        if fixed:
            remedy = (
                "the date or the time is missing: check the columns under [time] of the profile"
            )
        return InputError(
            f"no row has both a time and a satellite fix ({fixed} have a fix, {dated} a time)",
            place=every,
            remedy=remedy,
        )
    if rule == "time_unreadable" and not len(table):
        return InputError(
            "no row has a time that can be read",
            place=every,
            remedy="check the columns, format and unit under [time] of the profile",
        )
    return InputError(
        f"{len(table)} row is left after rule '{rule}', a trip needs 2",
        place=f"row {table.rows[0]}" if len(table) else None,
        remedy="check the time column; was the recorder stopped at once?",
    )


def _refuse(finding: Finding) -> None:
    where = f", column {finding.column}" if finding.column else ""
    raise InputError(
        f"{finding.count} times '{finding.rule}', which the profile does not let be repaired",
        place=f"row {finding.rows[0]}{where}" if finding.rows else None,
        remedy=f"correct the file, or set {finding.rule} = true under [repair]",
    )

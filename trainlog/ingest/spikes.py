"""Values and satellite positions that nothing can have jumped to and back from."""

from __future__ import annotations

import math

import numpy as np

from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from trainlog.ingest.clock import Result
from trainlog.ingest.profile import Limits
from trainlog.ingest.recording import METRES_PER_DEGREE, Finding, Table, base_name
from trainlog.units import NANOSECONDS

LATITUDE, LONGITUDE = "/gnss/fix.latitude", "/gnss/fix.longitude"
ACCURACY = "/gnss/fix.horizontal_accuracy"
GNSS_SPEED, SPEED = "/gnss/motion.speed", "/train/state.speed"

LEAST = 7
"""Samples that a column needs before any of them can be a spike."""

PERSISTING = 5.0
"""Time [s] for which values must stay where they jumped to before the jump is taken for real; twice
that between a jump and the jump back."""

LEAST_PERSISTING = 3
"""Samples that this is at least."""

REACH = 20
"""Pieces between which the way back is looked for."""

MOST_SPIKES = 1 / 3
"""Share of a column's values beyond which they are no spikes: it has another unit."""

FIX_TOLERANCE = 20.0
"""By how much satellite positions of perfect accuracy may err from one to the next [m]."""

FIX_STDS = 3.0
"""Standard deviations, as receivers usually state them, that are added to that."""

LARGEST_USUAL = 50.0
"""Standard deviation [m] that is usual at most."""

USUAL_ACCURACY = 5.0
"""Standard deviation [m] where the receiver states none."""

SPEED_MARGIN, FASTER = 1.2, 10.0
"""How much faster than the recorded speed positions may move, as a factor and beyond it [m/s]."""

RESTING = 10.0
"""Time [s] from which on a repeated speed is not taken for how fast positions move."""

MOST_JUMPS = 0.02
"""Share of steps between positions beyond which it is the recorded speed that is doubted."""

POOR = 3.0
"""Ratio to the usual accuracy from which on a fix is compared with those around it."""

TURNING = 2.0
"""Acceleration [m/s²], along and across, by which a train departs from a straight line."""

LONGEST_BETWEEN = 60.0
"""Time [s] between two good fixes beyond which they do not say where one between them is."""


def blank_spikes(table: Table, limits: Limits) -> Result:
    """Take away values that nothing can have jumped to and back from.

    A column is cut wherever two values differ by more than ``tolerance + rate * (time between
    them)``. Of its pieces those are kept that make the best sequence: the most samples, less
    `PERSISTING` for every two that follow each other and do not fit. The sample after a spike, and
    runs of several, are judged in the same way as a spike. What changes no faster than `rate` is
    never taken for one, whatever its sampling; nor is anything where most would be.
    """
    findings: list[Finding] = []
    seconds = (table.time - table.time[0]) / NANOSECONDS
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
    if present.size < LEAST:
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
    if np.count_nonzero(outside) <= MOST_SPIKES * present.size:
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
    price = max(LEAST_PERSISTING, round(PERSISTING / step)) if step > 0.0 else LEAST_PERSISTING
    best, before = size.copy(), np.full(size.size, -1)
    for piece in range(1, size.size):
        others = np.arange(max(0, piece - REACH), piece)
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


def plane(table: Table) -> ComplexArray | None:
    """Satellite positions in a plane, north + i east [m], NaN where absent; None without any."""
    latitude, longitude = table.signals.get(LATITUDE), table.signals.get(LONGITUDE)
    if latitude is None or longitude is None:
        return None
    fixed = np.isfinite(latitude) & np.isfinite(longitude)
    if not fixed.any():
        return None
    scale = METRES_PER_DEGREE * np.cos(np.radians(float(np.median(latitude[fixed]))))
    places = METRES_PER_DEGREE * latitude + 1j * scale * longitude
    return np.where(fixed, places, np.nan)


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
    usual = min(float(np.median(known)), LARGEST_USUAL) if known.size else USUAL_ACCURACY
    tolerance = FIX_TOLERANCE + FIX_STDS * usual
    fastest = limits.of(GNSS_SPEED).high
    rate = _fastest(table, seconds, fastest)
    leaps = spikes(seconds, places, rate, tolerance)
    if np.count_nonzero(leaps) > MOST_JUMPS * np.count_nonzero(np.isfinite(places)):
        leaps = spikes(seconds, places, fastest, tolerance)
    poor = np.isfinite(places) & (stated > POOR * usual) & ~leaps
    return leaps | _beside(seconds, places, poor, np.isfinite(places) & ~leaps & ~poor, tolerance)


def _fastest(table: Table, seconds: FloatArray, most: float) -> FloatArray:
    """How fast satellite positions can move [m/s], by the recorded speed where there is one."""
    for name in (GNSS_SPEED, SPEED):
        speed = table.signals.get(name)
        if speed is not None and np.isfinite(speed).any():
            known = np.isfinite(speed)
            at, column = seconds[known], speed[known]
            # A speed that repeats itself may be frozen: it bounds nothing.
            first = np.concatenate(([0], np.flatnonzero(np.diff(column)) + 1))
            last = np.append(first[1:], at.size) - 1
            rests = np.repeat(at[last] - at[first] >= RESTING, last - first + 1)
            bound = np.where(rests, most, SPEED_MARGIN * np.abs(column) + FASTER)
            return np.minimum(np.interp(seconds, at, bound), most)
    return np.full(len(table), most)


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
    allowed = tolerance + 0.5 * TURNING * since * until
    far = np.abs(places[asked] - there) > allowed
    beside[asked] = far & (since + until <= LONGEST_BETWEEN)
    return beside

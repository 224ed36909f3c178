"""Satellite fixes, satellite speeds and wheel speeds of a trip on one clock; wheels that slip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numba import njit
from scipy.ndimage import label

from trainlog.arrays import BoolArray, FloatArray

GATE, HOLD = 4.5, 2.5
"""A fix further from the expected place than `GATE` standard deviations is off; so are its
neighbours, one after the other, down to `HOLD`."""

WHEEL_GATE = 0.4
"""Least difference between wheels and satellites that counts as slip [m/s]."""

EVIDENT = 0.8
"""Part of the fixes that must be held equally long, both coordinates changing at once: coordinates
that are only rounded change one by one, and after times that vary."""

SLIP_TIME = 5.0
"""Wheels that changed speed too fast twice within this time [s] are not trusted between."""

STEEPEST = 1.5
"""No train on wheels gains or loses speed faster than this [m/s²]; slipping wheels do."""


@dataclass(frozen=True, eq=False)
class Fixes:
    """Satellite fixes and speeds on one clock; all (n,) arrays, NaN where absent.

    Attributes
    ----------
    index : DatetimeIndex
    seconds : array [s]
        Since the first row.
    latitude, longitude : array [deg]
    std : array [m]
        Of each horizontal axis.
    speed, speed_std : array [m/s]
    wheel_speed, wheel_speed_std : array [m/s] or None
    row_time : float [s]
        Between the rows of a table that held each fix for several rows, of which the first is
        kept: it may be late by as much. 0 where fixes were not held.
    """

    index: pd.DatetimeIndex
    seconds: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    std: FloatArray
    speed: FloatArray
    speed_std: FloatArray
    wheel_speed: FloatArray | None = None
    wheel_speed_std: FloatArray | None = None
    row_time: float = 0.0


def held(departure: FloatArray, seconds: FloatArray, gate: float, hold: float) -> BoolArray:
    """Samples of runs above `hold` that somewhere exceed `gate`: a switch with hysteresis.

    Parameters
    ----------
    departure : (n,) array
        In standard deviations; NaN where absent.
    seconds : (n,) array [s]
    gate, hold : float

    Returns
    -------
    (n,) bool array
    """
    known = np.flatnonzero(np.isfinite(seconds) & ~np.isnan(departure))
    runs, count = label(departure[known] > hold)
    beyond = np.zeros(count + 1, dtype=np.bool_)
    beyond[runs[departure[known] > gate]] = True
    beyond[0] = False
    off = np.zeros(departure.size, dtype=np.bool_)
    off[known] = beyond[runs]
    return off


def held_fixes(
    seconds: FloatArray, latitude: FloatArray, longitude: FloatArray
) -> tuple[BoolArray, float]:
    """Fixes that a table with more rows than the receiver had fixes repeats, and its row time [s].

    None, and 0 s, unless most fixes are held equally long. What is held longer, as at a standstill,
    is left.

    Examples
    --------
    >>> import numpy as np
    >>> fix = np.repeat(np.arange(40.0), 5)
    >>> repeated, row = held_fixes(np.arange(200) / 5.0, fix, fix)
    >>> np.flatnonzero(repeated)[:5], row
    (array([ 6,  7,  8,  9, 11]), 0.2)
    """
    flags = np.zeros(seconds.size, dtype=np.bool_)
    known = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude))
    moved = [np.diff(values[known]) != 0.0 for values in (latitude, longitude)]
    changed = np.flatnonzero(moved[0] | moved[1]) + 1
    if changed.size < 20:
        return flags, 0.0
    time = seconds[known]
    row, lasted = float(np.median(np.diff(time))), np.diff(time[changed])
    usual = float(np.median(lasted))
    even = np.mean(np.abs(lasted - usual) < 1.1 * row)
    both = np.mean((moved[0] & moved[1])[changed - 1])
    if usual < 1.9 * row or min(even, both) < EVIDENT:
        return flags, 0.0
    since = np.full(known.size, np.inf)
    run = np.cumsum(np.isin(np.arange(known.size), changed))
    begin = time[changed]
    since[changed[0] :] = time[changed[0] :] - begin[run[changed[0] :] - 1]
    length = np.append(lasted, np.inf)
    short = np.concatenate(([False], length < usual + 1.1 * row))[run]
    flags[known] = (since > 0.0) & short
    return flags, round(row, 6)


def wheel_ratio(fixes: Fixes) -> float:
    """Speed over the ground for a wheel speed of 1: the median where both are known, else 1."""
    if fixes.wheel_speed is None:
        return 1.0
    satellite = _bridged(fixes.seconds, fixes.speed)
    both = (fixes.wheel_speed > 3.0) & (satellite > 3.0)
    if np.count_nonzero(both) < 20:
        return 1.0
    return float(np.median(satellite[both] / fixes.wheel_speed[both]))


def slipping_wheels(
    fixes: Fixes, speed: FloatArray, speed_std: FloatArray, ratio: float
) -> BoolArray:
    """Wheel speeds away from a speed over the ground, or changing faster than a train can.

    Parameters
    ----------
    fixes : Fixes
    speed, speed_std : (n,) array [m/s]
        Over the ground, NaN where not known.
    ratio : float
        Speed over the ground for a wheel speed of 1.

    Returns
    -------
    (n,) bool array
    """
    if fixes.wheel_speed is None or fixes.wheel_speed_std is None:
        return np.zeros(fixes.seconds.size, dtype=np.bool_)
    apart = np.abs(fixes.wheel_speed * ratio - _bridged(fixes.seconds, speed))
    spread = np.hypot(fixes.wheel_speed_std, _bridged(fixes.seconds, speed_std))
    unit = np.maximum(spread, WHEEL_GATE / GATE)
    slipping = held(apart / unit, fixes.seconds, GATE, HOLD)
    known = np.flatnonzero(np.isfinite(fixes.wheel_speed))
    speeds, time = fixes.wheel_speed[known], fixes.seconds[known]
    back = np.ascontiguousarray(speeds[::-1])  # one layout, one compiled version
    spans = (_feasible(time, speeds), _feasible(-time[::-1], back)[::-1])
    unit = np.maximum(fixes.wheel_speed_std[known], WHEEL_GATE / GATE)
    for feasible in spans:
        slipping[known] |= held(np.abs(speeds - feasible) / unit, time, GATE, HOLD)
    # Between the rise and the fall of a slip the wheels turn at a steady speed.
    flagged = np.flatnonzero(slipping)
    short = np.diff(fixes.seconds[flagged]) < SLIP_TIME
    between = np.zeros(slipping.size + 1, dtype=np.int64)
    between[flagged[:-1][short]] += 1
    between[flagged[1:][short]] -= 1
    slipping |= np.cumsum(between)[:-1] > 0
    return np.asarray(slipping & np.isfinite(fixes.wheel_speed))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _feasible(time: FloatArray, speed: FloatArray) -> FloatArray:
    """Speed that follows the given one no faster than a train can."""
    feasible = speed.copy()
    for i in range(1, speed.size):
        most = STEEPEST * (time[i] - time[i - 1])
        feasible[i] = min(max(speed[i], feasible[i - 1] - most), feasible[i - 1] + most)
    return feasible


def _bridged(seconds: FloatArray, values: FloatArray) -> FloatArray:
    """Values at every row, on a line between those at most 2 s apart; NaN elsewhere."""
    known = np.flatnonzero(np.isfinite(values))
    if not known.size:
        return np.full(seconds.size, np.nan)
    time = seconds[known]
    following = np.clip(np.searchsorted(time, seconds), 0, time.size - 1)
    preceding = np.maximum(np.searchsorted(time, seconds, side="right") - 1, 0)
    near = np.maximum(time[following] - seconds, seconds - time[preceding]) <= 2.0
    return np.where(near, np.interp(seconds, time, values[known]), np.nan)

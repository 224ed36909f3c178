"""Chainage from satellite fixes: matched to the line's geometry, smoothed with the speed.

First the best chain of places along the line (`estimators.matching`): where a line comes close to
itself, continuity and direction decide. Then, a few times over: the fixes are projected where the
chain or the last turn's motion puts the train, what departs from it is set aside, and the motion is
smoothed anew (`estimators.motion`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import label

from estimators.matching import Nodes, best_chain
from estimators.motion import LASTING_TIME, SmoothedMotion, smooth_motion
from trainlog.errors import InputError
from trainlog.ingest.recording import BoolArray, FloatArray
from trainlog.railway.geometry import Track, beside, candidates, nearest_on, track_of
from trainlog.railway.line import Geometry

GATE, HOLD = 4.5, 2.5
"""A fix further from the expected place than `GATE` standard deviations is off; so are its
neighbours, one after the other, down to `HOLD`."""

WHEEL_GATE = 0.4
"""Least difference between wheels and satellites that counts as slip [m/s]."""

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


ComplexArray = NDArray[np.complex128]

GEOMETRY_STD = 2.0
"""Standard deviation of a good line's own geometry [m]."""

DRIFT = 0.1
"""Random walk [m/√s] of the chainage beyond the integral of the speed: curves cut short by the
geometry, satellite speeds whose errors last."""

NODE = 5.0
"""Time between fixes from which the chain is made [s]."""

LAG = 5.0
"""Time over which differences of the distance beside the line show what part of it lasts [s]."""

WHITE_SHARE = 0.02
"""Least part of a fix's variance that is taken to be white."""

TURNS = 5
"""Times the fixes are projected and the motion is smoothed."""

WHEEL_TIME = 2.0
"""Time over which the errors of wheel speeds last [s]: creep goes with the effort."""

LOSS_DENSITY = 1.6
"""Spectral density of a train's acceleration [m²/s³]: how unsure an unmeasured speed becomes."""

MAX_MISFIT = 500.0
"""Misfit of line and fixes [m] beyond which it is another line."""

BACKWARDS = 500.0
"""Distance against the line [m] from which a trip is refused."""


@dataclass(frozen=True, eq=False)
class Matched:
    """Fixes on the line.

    Attributes
    ----------
    chainage : (n,) array [m]
        NaN where there is none.
    rejected : (n,) bool array
        Fixes that give no chainage.
    slipping : (n,) bool array
        Wheel speeds that are not trusted.
    misfit : float [m]
        Standard deviation of the line's own place on the earth: what of the distance between line
        and fixes the receiver's accuracy does not explain.
    motion : SmoothedMotion
        At every row.
    """

    chainage: FloatArray
    rejected: BoolArray
    slipping: BoolArray
    misfit: float
    motion: SmoothedMotion


def chainage_of(
    geometry: Geometry, fixes: Fixes, *, gated: bool = True, slip_aware: bool = True
) -> Matched:
    """Chainage of satellite fixes, growing in the direction of travel.

    Parameters
    ----------
    geometry : Geometry
        Of the line as travelled.
    fixes : Fixes
        At least two of them with a position.
    gated : bool
        Whether fixes are rejected at all.
    slip_aware : bool
        Whether wheel speeds are set aside at all.

    Raises
    ------
    InputError
        If the fixes lie elsewhere, follow another line, or chainage falls while the train drives.
    """
    track = track_of(geometry)
    points = track.plane(fixes.latitude, fixes.longitude)
    known = np.isfinite(points)
    near, distance = nearest_on(track, points)
    misfit = _rough_misfit(distance[known], fixes.std[known])
    std = np.sqrt(fixes.std**2 + misfit**2 + GEOMETRY_STD**2)
    ratio = wheel_ratio(fixes)
    slipping = slipping_wheels(fixes, fixes.speed, fixes.speed_std, ratio) & slip_aware
    chain = _chain(track, points, fixes, std, _driven(fixes, slipping, ratio), near, gated)
    motion = _smooth(fixes, slipping, chain, std, 0.0 * std)
    rejected = np.zeros(known.size, dtype=np.bool_)
    for _ in range(TURNS):
        chainage, aside = beside(track, points, motion.position)
        before = rejected
        if gated:
            rejected = known & _departs(
                chainage, aside, motion, std, fixes.seconds, _ends(track, chainage, std)
            )
        ratio = 1.0 - motion.wheel_error
        slipping = slipping_wheels(fixes, motion.speed, motion.speed_std, ratio) & slip_aware
        kept = np.where(known & ~rejected, chainage, np.nan)
        if np.count_nonzero(np.isfinite(kept)) < 2:
            break
        share = _lasting_share(fixes.seconds, np.where(np.isfinite(kept), aside / std, np.nan))
        spread = np.hypot(fixes.std, misfit)
        white = spread * np.sqrt(max(1.0 - share, WHITE_SHARE))
        lasting = np.hypot(spread * np.sqrt(share), GEOMETRY_STD)
        last = motion.position
        motion = _smooth(fixes, slipping, kept, white, lasting)
        settled = np.abs(motion.position - last).max() < 0.1
        if settled and np.array_equal(before, rejected):
            break
    misfit = _misfit(np.where(np.isfinite(kept), aside, np.nan), fixes, share)
    return Matched(kept, rejected, slipping, misfit, motion)


def distance_driven(fixes: Fixes) -> FloatArray:
    """Distance driven since the first row [m] by the measured speeds; NaN without any."""
    ratio = wheel_ratio(fixes)
    slipping = slipping_wheels(fixes, fixes.speed, fixes.speed_std, ratio)
    return _driven(fixes, slipping, ratio)[0]


def _smooth(
    fixes: Fixes, slipping: BoolArray, chainage: FloatArray, white: FloatArray, lasting: FloatArray
) -> SmoothedMotion:
    wheels, wheel_std = fixes.wheel_speed, fixes.wheel_speed_std
    if wheels is not None and wheel_std is not None:
        step = float(np.median(np.diff(fixes.seconds[np.isfinite(wheels)])))
        wheels = np.where(slipping, np.nan, wheels)
        # White noise of this size carries as much, taken together, as errors that last.
        wheel_std = wheel_std * np.sqrt(max(1.0, 2.0 * WHEEL_TIME / step))
    return smooth_motion(
        fixes.seconds,
        fixes.speed,
        fixes.speed_std,
        chainage,
        white,
        lasting_std=lasting,
        drift=DRIFT,
        wheel_speed=wheels,
        wheel_speed_std=wheel_std,
    )


def _rough_misfit(distance: FloatArray, std: FloatArray) -> float:
    """First guess of the line's misfit [m], from distances that are mostly across the track.

    Raises
    ------
    InputError
        If the line is too far away to be theirs.
    """
    spread = 1.4826 * float(np.median(distance))
    misfit = float(np.sqrt(max(0.0, spread**2 - float(np.median(std)) ** 2)))
    if misfit > MAX_MISFIT:
        raise InputError(
            f"half of the {distance.size} fixes lie {np.median(distance) / 1e3:.1f} km or more"
            " from the line",
            remedy="give the line that was driven",
        )
    return misfit


def _misfit(aside: FloatArray, fixes: Fixes, share: float) -> float:
    """Standard deviation [m] of the line's place: what the fixes' own noise does not explain.

    The mean square of n distances whose noise lasts for a time tau is itself unsure, by
    sqrt(2 tau / T) of the noise's variance; taking the root of whatever is left over would call
    half of all well placed lines misplaced. Only what exceeds that is the line's.
    """
    used = np.isfinite(aside)
    noise = float(np.mean(fixes.std[used] ** 2))
    apart = np.minimum(np.diff(fixes.seconds[used], prepend=fixes.seconds[0]), LASTING_TIME)
    lasting = LASTING_TIME / max(float(apart.sum()), LASTING_TIME)
    independent = share**2 * lasting + (1.0 - share**2) / np.count_nonzero(used)
    excess = float(np.mean(aside[used] ** 2)) - noise * (1.0 + np.sqrt(2.0 * independent))
    return float(np.sqrt(max(0.0, excess)))


def _lasting_share(seconds: FloatArray, aside: FloatArray) -> float:
    """Part of the fixes' variance that lasts, from the distances beside the line.

    With a white part w and one of correlation time tau, half the mean square of differences over
    a lag L is ``w + (1 - w) (1 - exp(-L / tau))`` of the variance.
    """
    used = np.flatnonzero(np.isfinite(aside))
    time, value = seconds[used], aside[used]
    later = np.searchsorted(time, time + LAG)
    pairs = later < time.size
    lag = time[later[pairs]] - time[pairs]
    close = lag < 2.0 * LASTING_TIME
    if np.count_nonzero(close) < 20:
        return 1.0
    difference = (value[later[pairs]] - value[pairs])[close]
    alike = 1.0 - 0.5 * float(np.mean(difference**2)) / max(float(np.mean(value**2)), 1e-12)
    return float(np.clip(alike / np.mean(np.exp(-lag[close] / LASTING_TIME)), 0.0, 1.0))


def _driven(fixes: Fixes, slipping: BoolArray, ratio: float) -> tuple[FloatArray, FloatArray]:
    """Distance driven since the first row [m] and its variance [m²]; NaN where no speed is known.

    By the satellite speed, else by the wheels', across gaps on a line.
    """
    speed, std = fixes.speed, fixes.speed_std
    if fixes.wheel_speed is not None and fixes.wheel_speed_std is not None:
        wheels = np.where(slipping, np.nan, fixes.wheel_speed * ratio)
        std = np.where(np.isfinite(speed), std, fixes.wheel_speed_std)
        speed = np.where(np.isfinite(speed), speed, wheels)
    known = np.isfinite(speed)
    if not known.any():
        return np.full(speed.size, np.nan), np.zeros(speed.size)
    time = fixes.seconds[known]
    steps = np.diff(time)
    driven = np.concatenate(
        ([0.0], np.cumsum(0.5 * (speed[known][1:] + speed[known][:-1]) * steps))
    )
    unsure = (std[known][1:] * steps) ** 2 + DRIFT**2 * steps + LOSS_DENSITY * steps**3 / 12.0
    variance = np.concatenate(([0.0], np.cumsum(unsure)))
    return np.interp(fixes.seconds, time, driven), np.interp(fixes.seconds, time, variance)


def _chain(
    track: Track,
    points: ComplexArray,
    fixes: Fixes,
    std: FloatArray,
    driven: tuple[FloatArray, FloatArray],
    near: FloatArray,
    gated: bool,
) -> FloatArray:
    """Chainage of the fixes in the best chain, NaN for all others.

    Raises
    ------
    InputError
        If most fixes follow no chain, or one against the line.
    """
    known = np.flatnonzero(np.isfinite(points))
    _, first = np.unique(np.floor(fixes.seconds[known] / NODE), return_index=True)
    chosen = known[first]
    places = candidates(track, points[chosen], GATE * std[chosen])
    counts = np.bincount(places.owner, minlength=chosen.size)
    nodes = Nodes(
        seconds=fixes.seconds[chosen],
        east=points[chosen].real,
        north=points[chosen].imag,
        std=std[chosen],
        driven=driven[0][chosen],
        driven_variance=driven[1][chosen],
        first=np.concatenate(([0], np.cumsum(counts))),
        chainage=places.chainage,
        distance=places.distance,
    )
    worth, chain = best_chain(nodes, 1.0)
    back, backwards = best_chain(nodes, -1.0)
    if back > worth and np.ptp(places.chainage[backwards[backwards >= 0]]) > BACKWARDS:
        ends = known[np.isfinite(near[known])][[0, -1]]
        raise InputError(
            f"the fixes run from km {near[ends[0]] / 1e3:.3f} to km {near[ends[1]] / 1e3:.3f},"
            " against the direction of travel",
            remedy="give the other direction: 'reverse' instead of 'forward', or vice versa",
        )
    inside = np.count_nonzero(chain >= 0)
    against = backwards[(chain < 0) & (backwards >= 0)]
    returns = against.size > 0.25 * inside and np.ptp(places.chainage[against]) > BACKWARDS
    if gated and (returns or inside < 0.5 * np.count_nonzero(counts)):
        raise InputError(
            f"only {inside / np.count_nonzero(counts):.0%} of the fixes near the line follow it"
            " in one direction",
            remedy="give the line that was driven; a log that runs in both directions is two trips",
        )
    chainage = np.full(points.size, np.nan)
    chainage[chosen[chain >= 0]] = places.chainage[chain[chain >= 0]]
    return chainage


def _departs(
    chainage: FloatArray,
    aside: FloatArray,
    motion: SmoothedMotion,
    std: FloatArray,
    seconds: FloatArray,
    beyond: BoolArray,
) -> BoolArray:
    """Fixes that do not go with the motion, along the line or beside it."""
    along = (chainage - motion.position) / np.hypot(std, motion.position_std)
    departure = np.hypot(along, aside / std)
    departure[beyond] = np.inf
    return held(departure, seconds, GATE, HOLD)


def _ends(track: Track, chainage: FloatArray, std: FloatArray) -> BoolArray:
    """Fixes beyond the ends of the track, by more than their own error."""
    margin = GATE * std
    return np.asarray(
        (chainage < track.positions[0] - margin) | (chainage > track.positions[-1] + margin)
    )

"""Chainage from satellite fixes: matched to the line's geometry, smoothed with the speed.

First the best chain of places along the line (`estimators.matching`): where a line comes close to
itself, continuity and direction decide. Then, a few times over: the fixes are projected where the
chain or the last turn's motion puts the train, what departs from it is set aside, and the motion is
smoothed anew (`estimators.motion`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimators.matching import Nodes, best_chain, off_between
from estimators.motion import SmoothedMotion
from estimators.receiver import Delay, ReceiverNoise
from trainlog.arrays import BoolArray, ComplexArray, FloatArray, robust_std
from trainlog.errors import InputError
from trainlog.ingest.fixes import GATE, Fixes, slipping_wheels, wheel_ratio
from trainlog.ingest.line_motion import GEOMETRY_STD, SMALLEST_NOISE, LineMotion
from trainlog.ingest.receiver import (
    Speeds,
    common_delay,
    extrapolated,
    kept_on,
    with_late_wheels,
)
from trainlog.railway.geometry import Track, beside, candidates, nearest_on, track_of
from trainlog.railway.line import Geometry

NODE = 5.0
"""Time between fixes from which the chain is made [s]."""

UNCHECKED_DENSITY = 5.0
"""Spectral density of the error of a speed that was not checked [m²/s]: 0.5 m/s for 10 s."""

LOSS_DENSITY = 1.6
"""Spectral density of a train's acceleration [m²/s³]: how unsure an unmeasured speed becomes."""

MAX_MISFIT = 500.0
"""Misfit of line and fixes [m] beyond which it is another line."""

BACKWARDS = 500.0
"""Distance against the line [m] from which a trip is refused."""


MOST_ASIDE = 0.5
"""Part of the fixes that may be set aside; a trip with more is refused."""


class AgainstLineError(InputError):
    """The fixes run against the direction of travel."""


@dataclass(frozen=True, eq=False)
class Matched:
    """Fixes on the line.

    Attributes
    ----------
    chainage : (n,) array [m]
        NaN where there is none.
    rejected : (n,) bool array
        Fixes that give no chainage.
    extrapolated : (n,) bool array
        Fixes that the receiver did not measure then: extrapolated, held or replayed ones.
    contradicted : (n,) bool array
        Satellite speeds that are not used.
    slipping : (n,) bool array
        Wheel speeds that are not trusted.
    misfit : float [m]
        Standard deviation of the line's own place on the earth: what of the distance between line
        and fixes the receiver's noise does not explain.
    motion : SmoothedMotion
        At every row.
    position_noise, speed_noise : ReceiverNoise or None
        As estimated on this trip [m], [m/s].
    along_std : float [m]
        Of a further noise of the positions, along the line alone: fixes that come late.
    delay : float [s]
        By which the satellite speed came later than the fixes; it was put back by it.
    common_delay : Delay
        By which fixes and satellite speed came later than the wheels' speed, NaN if that is not
        known; `motion` is that of the satellites' clock.
    reasons : str
        Why speeds are not used, in words.
    """

    chainage: FloatArray
    rejected: BoolArray
    extrapolated: BoolArray
    contradicted: BoolArray
    slipping: BoolArray
    misfit: float
    motion: SmoothedMotion
    position_noise: ReceiverNoise
    speed_noise: ReceiverNoise | None
    along_std: float
    delay: float
    common_delay: Delay
    reasons: str


def chainage_of(
    geometry: Geometry,
    fixes: Fixes,
    *,
    gated: bool = True,
    slip_aware: bool = True,
    speed_aware: bool = True,
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
    speed_aware : bool
        Whether satellite speeds are set aside, or put back by their delay, at all.

    Raises
    ------
    InputError
        If the fixes lie elsewhere or follow another line; if most of them are set aside.
    AgainstLineError
        If chainage falls while the train drives.
    """
    track = track_of(geometry)
    points = track.plane(fixes.latitude, fixes.longitude)
    count = np.count_nonzero(np.isfinite(points))
    near, distance = nearest_on(track, points)
    fixes, misfit = _rough_noise(fixes, distance)
    computed = extrapolated(fixes.seconds, points) | kept_on(fixes.seconds, points, fixes.std)
    computed &= gated
    points[computed] = np.nan
    speeds = Speeds(fixes, points, computed) if speed_aware else Speeds(fixes)
    std = np.sqrt(fixes.std**2 + misfit**2 + GEOMETRY_STD**2)
    fixes = replace(fixes, speed=speeds.used)
    ratio = wheel_ratio(fixes)
    slipping = slipping_wheels(fixes, fixes.speed, fixes.speed_std, ratio) & slip_aware
    driven = _driven(fixes, slipping, ratio)
    chain, off = _chain(track, points, fixes, std, driven, near, gated)
    computed |= off
    points[off & gated] = np.nan
    course = _course(fixes.seconds, chain, driven[0])
    chainage, aside = beside(track, points, course)
    spread = robust_std(aside[~np.isnan(aside)])
    fitting = np.isfinite(points)
    if gated:
        fitting &= np.hypot(aside, chainage - course) < GATE * np.hypot(spread, std)
    if speed_aware:
        fit = np.where(fitting, chainage, np.nan)
        speeds.compare(fit, max(spread, SMALLEST_NOISE[0]))
        fixes = replace(fixes, speed=speeds.used)
        speeds.common = common_delay(fixes, fit)
        if speeds.common.value > 0.0:
            fixes = with_late_wheels(fixes, speeds.common.value)
            slipping = slipping_wheels(fixes, fixes.speed, fixes.speed_std, wheel_ratio(fixes))
            slipping &= slip_aware
    work = LineMotion(track, points, fixes, gated=gated, slip_aware=slip_aware, hold=speeds.hold)
    motion = work.run(course, fitting, slipping)
    rejected = np.isfinite(points) & ~np.isfinite(work.chainage)
    aside_count = int(np.count_nonzero(rejected | computed))
    if gated and aside_count > MOST_ASIDE * count:
        raise InputError(
            f"{aside_count} of {count} fixes were set aside"
            f" ({np.count_nonzero(computed)} extrapolated, held or replayed, the others away from"
            " line or motion):"
            " what is left determines no chainage",
            remedy="give the line that was driven, or another recording of the trip",
        )
    return Matched(
        chainage=work.chainage,
        rejected=rejected,
        extrapolated=computed,
        contradicted=speeds.aside | work.contradicted,
        slipping=work.slipping,
        misfit=work.misfit,
        motion=motion,
        position_noise=work.position_noise,
        speed_noise=work.speed_noise,
        along_std=work.along_std,
        delay=speeds.delay,
        common_delay=speeds.common,
        reasons=speeds.words(int(np.count_nonzero(work.contradicted & ~speeds.aside))),
    )


def _rough_noise(fixes: Fixes, distance: FloatArray) -> tuple[Fixes, float]:
    """Fixes whose accuracy is no larger than the distances show, and a guess of the line's misfit.

    Raises
    ------
    InputError
        If the line is too far away to be theirs.
    """
    known = np.isfinite(distance)
    spread = robust_std(distance[known])
    stated = float(np.median(fixes.std[known]))
    misfit = float(np.sqrt(max(0.0, spread**2 - stated**2)))
    if misfit > MAX_MISFIT:
        raise InputError(
            f"half of the {np.count_nonzero(known)} fixes lie"
            f" {np.median(distance[known]) / 1e3:.1f} km or more from the line",
            remedy="give the line that was driven",
        )
    smaller = min(1.0, max(spread, GEOMETRY_STD) / stated)
    return replace(fixes, std=fixes.std * smaller), misfit


def _course(seconds: FloatArray, chain: FloatArray, driven: FloatArray) -> FloatArray:
    """Rough chainage at every row: that of the chain, between its fixes by the distance driven."""
    nodes = np.flatnonzero(np.isfinite(chain))
    if not np.isfinite(driven).all():
        return np.interp(seconds, seconds[nodes], chain[nodes])
    return driven + np.interp(seconds, seconds[nodes], chain[nodes] - driven[nodes])


def distance_driven(fixes: Fixes) -> tuple[FloatArray, FloatArray]:
    """Distance driven since the first row [m] by the measured speeds, and its variance [m²].

    NaN without any speed.
    """
    ratio = wheel_ratio(fixes)
    slipping = slipping_wheels(fixes, fixes.speed, fixes.speed_std, ratio)
    return _driven(fixes, slipping, ratio)


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
    unsure = (std[known][1:] * steps) ** 2 + UNCHECKED_DENSITY * steps
    unsure += LOSS_DENSITY * steps**3 / 12.0
    variance = np.concatenate(([0.0], np.cumsum(unsure)))
    return np.interp(fixes.seconds, time, driven), np.interp(fixes.seconds, time, variance)


def _pace(fixes: Fixes) -> FloatArray:
    """The speed at every row [m/s], between measured ones on a line; NaN where there is none."""
    speed = fixes.speed
    if fixes.wheel_speed is not None:
        speed = np.where(np.isfinite(speed), speed, fixes.wheel_speed)
    known = np.isfinite(speed)
    if not known.any():
        return np.full(speed.size, np.nan)
    return np.interp(fixes.seconds, fixes.seconds[known], speed[known])


def _chain(
    track: Track,
    points: ComplexArray,
    fixes: Fixes,
    std: FloatArray,
    driven: tuple[FloatArray, FloatArray],
    near: FloatArray,
    gated: bool,
) -> tuple[FloatArray, BoolArray]:
    """Chainage of the fixes in the best chain, NaN for all others; fixes while the receiver is off.

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
        pace=_pace(fixes)[chosen],
        first=np.concatenate(([0], np.cumsum(counts))),
        chainage=places.chainage,
        distance=places.distance,
    )
    worth, chain = best_chain(nodes, 1.0)
    back, backwards = best_chain(nodes, -1.0)
    if back > worth and np.ptp(places.chainage[backwards[backwards >= 0]]) > BACKWARDS:
        ends = known[np.isfinite(near[known])][[0, -1]]
        raise AgainstLineError(
            f"the fixes run from km {near[ends[0]] / 1e3:.3f} to km {near[ends[1]] / 1e3:.3f},"
            " against the direction of travel",
            remedy="correct the direction: 'reverse' instead of 'forward', or vice versa; it is"
            " given by --reverse, direction= in Python, or direction under [trip] of the profile",
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
    off = np.zeros(points.size, dtype=np.bool_)
    for before, after in off_between(nodes, chain):
        off[chosen[before] + 1 : chosen[after]] = True
    return chainage, off & np.isfinite(points)

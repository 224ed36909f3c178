"""Chainage from satellite fixes: projected on the line's geometry, checked against the speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial import cKDTree

from trainlog.errors import InputError
from trainlog.ingest.recording import BoolArray, FloatArray
from trainlog.railway.geometry import to_plane
from trainlog.railway.line import Geometry

SPACING = 25.0
"""Longest stretch of the geometry between two points [m]; longer ones are divided."""

GATE_STDS, GATE = 5.0, 25.0
"""A fix further from the line than this many standard deviations, and this many metres, is off."""

WINDOW = 101
"""Fixes in the median that chainage less distance driven is compared with."""

MAX_MISFIT = 500.0
"""Misfit of line and fixes [m] beyond which it is another line."""


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
    """

    index: pd.DatetimeIndex
    seconds: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    std: FloatArray
    speed: FloatArray
    speed_std: FloatArray


@dataclass(frozen=True, eq=False)
class Matched:
    """Fixes on the line.

    Attributes
    ----------
    chainage : (n,) array [m]
        NaN where there is none.
    rejected : (n,) bool array
        Fixes that give no chainage.
    misfit : float [m]
        Standard deviation of the line's own place on the earth: what of the distance between line
        and fixes the receiver's accuracy does not explain.
    """

    chainage: FloatArray
    rejected: BoolArray
    misfit: float


def chainage_of(geometry: Geometry, fixes: Fixes, *, gated: bool = True) -> Matched:
    """Chainage of satellite fixes, growing in the direction of travel.

    Each fix is projected on the nearest stretch of the geometry. Rejected are fixes too far from
    the line, and fixes whose chainage, less the distance driven by the satellite speed, departs
    from the median of its neighbours: nearest to another bend, or reflected.

    Parameters
    ----------
    geometry : Geometry
        Of the line as travelled.
    fixes : Fixes
        At least one of them with a position.
    gated : bool
        Whether fixes are rejected at all.

    Raises
    ------
    InputError
        If the fixes lie elsewhere, or chainage falls while the train drives.
    """
    chainage, distance = project(geometry, fixes.latitude, fixes.longitude)
    known = np.isfinite(chainage)
    misfit = _misfit(distance[known], fixes.std[known])
    std = np.hypot(fixes.std, misfit)
    near = known & (distance <= np.maximum(GATE_STDS * std, GATE))
    driven = _driven(fixes)
    _refuse_backwards(chainage[near], driven[near])
    kept = near if gated else known
    if gated:
        kept = kept & ~_stray(chainage, driven, near, fixes.std)
    return Matched(np.where(kept, chainage, np.nan), known & ~kept, misfit)


def project(
    geometry: Geometry, latitude: FloatArray, longitude: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Chainage [m] of the nearest point of the geometry, and the distance to it [m].

    Parameters
    ----------
    latitude, longitude : (n,) array [deg]
        NaN where absent.

    Returns
    -------
    chainage, distance : (n,) arrays [m]
    """
    position = _divided(geometry.positions)
    origin = (float(geometry.latitudes.mean()), float(geometry.longitudes.mean()))
    track = to_plane(*geometry.at(position), origin)
    chord = np.diff(track)
    chainage = np.full(latitude.size, np.nan)
    distance = np.full(latitude.size, np.nan)
    known = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude))
    if not known.size:
        return chainage, distance
    point = to_plane(latitude[known], longitude[known], origin)
    _, corner = cKDTree(_pairs(track)).query(_pairs(point))
    best = np.full(known.size, np.inf)
    for start in (np.maximum(corner - 1, 0), np.minimum(corner, chord.size - 1)):
        ahead = point - track[start]
        along = (np.conj(chord[start]) * ahead).real / np.abs(chord[start]) ** 2
        share = np.clip(along, 0.0, 1.0)
        apart = np.abs(ahead - share * chord[start])
        at = position[start] + share * (position[start + 1] - position[start])
        closer = apart < best
        chainage[known[closer]] = at[closer]
        best = np.minimum(best, apart)
    distance[known] = best
    return chainage, distance


def _pairs(points: NDArray[np.complex128]) -> FloatArray:
    return np.column_stack([points.real, points.imag])


def _misfit(distance: FloatArray, std: FloatArray) -> float:
    """Standard deviation [m] of the line's place, from distances that are mostly across the track.

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


def _divided(positions: FloatArray) -> FloatArray:
    """The positions, and further ones between them so that none are more than `SPACING` apart."""
    even = np.arange(positions[0], positions[-1], SPACING)
    return np.unique(np.concatenate([positions, even]))


def _driven(fixes: Fixes) -> FloatArray:
    """Distance driven since the first row [m] by the satellite speed, across its gaps on a line."""
    known = np.isfinite(fixes.speed)
    if not known.any():
        return np.full(fixes.seconds.size, np.nan)
    speed = np.interp(fixes.seconds, fixes.seconds[known], fixes.speed[known])
    step = np.diff(fixes.seconds)
    return np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * step)))


def _refuse_backwards(chainage: FloatArray, driven: FloatArray) -> None:
    """Refuse a trip that runs against the chainage of the line."""
    moved = chainage[-1] - chainage[0]
    total = driven[-1] - driven[0]
    way = abs(moved) if not np.isfinite(total) else total
    if moved < -0.5 * way and way > 500.0:
        raise InputError(
            f"the fixes run from km {chainage[0] / 1e3:.3f} to km {chainage[-1] / 1e3:.3f},"
            " against the direction of travel",
            remedy="give the other direction: 'reverse' instead of 'forward', or the other way"
            " round",
        )


def _stray(chainage: FloatArray, driven: FloatArray, near: BoolArray, std: FloatArray) -> BoolArray:
    """Fixes whose chainage does not go with the distance driven."""
    stray = np.zeros(chainage.size, dtype=np.bool_)
    index = np.flatnonzero(near & np.isfinite(driven))
    if index.size < WINDOW:
        return stray
    ahead = chainage[index] - driven[index]
    departure = np.abs(ahead - median_filter(ahead, WINDOW, mode="mirror"))
    stray[index] = departure > np.maximum(GATE_STDS * std[index], GATE)
    return stray

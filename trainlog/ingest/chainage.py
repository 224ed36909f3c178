"""Chainage from satellite fixes: projected on the line's geometry, checked against the speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.ndimage import median_filter
from scipy.spatial import cKDTree

from trainlog.errors import InputError
from trainlog.ingest.recording import BoolArray, FloatArray
from trainlog.railway.line import Geometry

SPACING = 25.0
"""Longest stretch of the geometry between two points [m]; longer ones are divided."""

METRES_PER_DEGREE = 111_195.0
"""Length of a degree of latitude [m]."""

GATE_STDS, GATE = 5.0, 25.0
"""A fix further from the line than this many standard deviations, and this many metres, is off."""

WINDOW = 101
"""Fixes in the median that chainage less distance driven is compared with."""

ON_LINE = 0.1
"""Share of the fixes that must lie on the line."""


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
    """Chainage of each fix [m], NaN where there is none, and which fixes were rejected."""

    chainage: FloatArray
    rejected: BoolArray


def chainage_of(geometry: Geometry, fixes: Fixes, *, gated: bool = True) -> Matched:
    """Chainage of satellite fixes, growing in the direction of travel.

    Each fix is projected on the nearest stretch of the geometry. Rejected are fixes too far from
    the line, and fixes whose chainage, less the distance driven by the satellite speed, departs
    from the median of its neighbours: nearest to another bend, or reflected.

    Parameters
    ----------
    geometry : Geometry
        Of the line as travelled.
    gated : bool
        Whether fixes are rejected at all.

    Raises
    ------
    InputError
        If hardly any fix lies on the line, or chainage falls while the train drives.
    """
    chainage, distance = project(geometry, fixes.latitude, fixes.longitude)
    known = np.isfinite(chainage)
    near = known & (distance <= np.maximum(GATE_STDS * fixes.std, GATE))
    if np.count_nonzero(near) < max(2, ON_LINE * np.count_nonzero(known)):
        raise InputError(
            f"{np.count_nonzero(known) - np.count_nonzero(near)} of {np.count_nonzero(known)} fixes"
            f" do not lie on the line, half of them {np.nanmedian(distance) / 1e3:.1f} km away or"
            " more",
            remedy="give the line that was driven",
        )
    driven = _driven(fixes)
    _refuse_backwards(chainage[near], driven[near])
    kept = near if gated else known
    if gated:
        kept = kept & ~_stray(chainage, driven, near, fixes.std)
    return Matched(np.where(kept, chainage, np.nan), known & ~kept)


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
    scale = METRES_PER_DEGREE * np.cos(np.radians(np.mean(geometry.latitudes)))
    track_latitude, track_longitude = geometry.at(position)
    track = np.column_stack([track_longitude * scale, track_latitude * METRES_PER_DEGREE])
    chainage = np.full(latitude.size, np.nan)
    distance = np.full(latitude.size, np.nan)
    known = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude))
    if not known.size:
        return chainage, distance
    point = np.column_stack([longitude[known] * scale, latitude[known] * METRES_PER_DEGREE])
    _, nearest = cKDTree(track).query(point)
    best = np.full(known.size, np.inf)
    for start in (np.maximum(nearest - 1, 0), np.minimum(nearest, position.size - 2)):
        along = track[start + 1] - track[start]
        length = np.maximum(np.einsum("ij,ij->i", along, along), 1e-12)
        share = np.clip(np.einsum("ij,ij->i", point - track[start], along) / length, 0.0, 1.0)
        apart = np.linalg.norm(point - track[start] - share[:, None] * along, axis=1)
        at = position[start] + share * (position[start + 1] - position[start])
        closer = apart < best
        chainage[known[closer]] = at[closer]
        best = np.minimum(best, apart)
    distance[known] = best
    return chainage, distance


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

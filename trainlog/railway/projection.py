"""Points of the plane against the track: where along it they lie, and how far beside it.

Points are complex numbers, east + i north [m], on the plane that touches the earth at the middle
of the line; beside is positive to the left of the direction of travel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from trainlog.railway.geometry import to_plane
from trainlog.railway.line import Geometry

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]

SPACING = 25.0
"""Longest stretch of the track between two points [m]; longer ones are divided."""

TURNS = 3
"""Times a point is projected anew on the tangent where it came to lie."""


@dataclass(frozen=True, eq=False)
class Track:
    """A line's geometry on the plane.

    Attributes
    ----------
    positions : (n,) array [m]
        Strictly increasing, at most `SPACING` apart.
    points : (n,) complex array [m]
    origin : (latitude, longitude) [deg]
        Where the plane touches the earth.
    """

    positions: FloatArray
    points: ComplexArray
    origin: tuple[float, float]

    def plane(self, latitude: ArrayLike, longitude: ArrayLike) -> ComplexArray:
        """Points [m] of coordinates [deg]."""
        return to_plane(latitude, longitude, self.origin)

    def segments(self, position: FloatArray) -> IntArray:
        """Number of the stretch in which each position lies; ends are extended."""
        index = np.searchsorted(self.positions, position, side="right") - 1
        return np.clip(index, 0, self.positions.size - 2)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Places of the track near to given points; a point may have several, or none. (m,) arrays.

    Attributes
    ----------
    owner : int array
        Number of the point, not falling.
    chainage : array [m]
    distance : array [m]
    """

    owner: IntArray
    chainage: FloatArray
    distance: FloatArray


def track_of(geometry: Geometry) -> Track:
    """The track of a geometry, long stretches divided."""
    even = np.arange(geometry.positions[0], geometry.positions[-1], SPACING)
    positions = np.unique(np.concatenate([geometry.positions, even]))
    origin = (float(geometry.latitudes.mean()), float(geometry.longitudes.mean()))
    points = to_plane(*geometry.at(positions), origin)
    moving = np.concatenate(([True], np.abs(np.diff(points)) > 0.0))
    return Track(positions[moving], points[moving], origin)


def nearest_on(track: Track, points: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Chainage [m] of the nearest place of the track, and the distance to it [m].

    Parameters
    ----------
    points : (n,) complex array [m]

    Returns
    -------
    chainage, distance : (n,) arrays [m]
        NaN where the point is NaN.
    """
    chainage = np.full(points.size, np.nan)
    distance = np.full(points.size, np.nan)
    known = np.flatnonzero(np.isfinite(points))
    if known.size:
        point = points[known]
        _, corner = cKDTree(_pairs(track.points)).query(_pairs(point))
        last = track.points.size - 2
        sides = [_on_segment(track, point, np.clip(corner + side, 0, last)) for side in (-1, 0)]
        closer = sides[1][1] < sides[0][1]
        chainage[known] = np.where(closer, sides[1][0], sides[0][0])
        distance[known] = np.where(closer, sides[1][1], sides[0][1])
    return chainage, distance


def candidates(track: Track, points: ComplexArray, reach: FloatArray) -> Candidates:
    """Every place of the track that is nearer to a point than the track before and after it.

    Parameters
    ----------
    points : (n,) complex array [m]
        Finite.
    reach : (n,) array [m]
        Places further away are not looked for.

    Returns
    -------
    Candidates
        Of points with more than one, those at the same bend once.
    """
    tree = cKDTree(_pairs(track.points))
    corners = tree.query_ball_point(_pairs(points), reach + SPACING, return_sorted=True)
    sizes = np.array([len(found) for found in corners], dtype=np.int64)
    corner = np.fromiter((c for found in corners for c in found), np.int64, int(sizes.sum()))
    owner = np.repeat(np.arange(points.size), sizes)
    # The stretch before each corner and the one after it, each once.
    width = track.positions.size + 1
    both = np.unique(np.concatenate([owner * width + corner, owner * width + corner + 1]))
    owner, segment = both // width, both % width - 1
    inside = (segment >= 0) & (segment <= track.positions.size - 2)
    owner, segment = owner[inside], segment[inside]
    chainage, distance = _on_segment(track, points[owner], segment)
    alone = np.full(owner.size, np.inf)
    follows = (np.diff(owner) == 0) & (np.diff(segment) == 1)
    before, after = alone.copy(), alone
    before[1:][follows] = distance[:-1][follows]
    after[:-1][follows] = distance[1:][follows]
    least = (distance <= before) & (distance < after) & (distance <= reach[owner])
    return Candidates(owner[least], chainage[least], distance[least])


def beside(
    track: Track, points: ComplexArray, position: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Chainage of points that are known to lie near given positions, and how far beside they are.

    Unlike the nearest place of the whole track it stays at its bend. The track's ends are extended
    straight on.

    Parameters
    ----------
    points : (n,) complex array [m]
        NaN where absent.
    position : (n,) array [m]

    Returns
    -------
    chainage, beside : (n,) arrays [m]
    """
    at = position
    for _ in range(TURNS):
        segment = track.segments(at)
        chord = track.points[segment + 1] - track.points[segment]
        stretch = track.positions[segment + 1] - track.positions[segment]
        ahead = np.conj(chord) * (points - track.points[segment]) / np.abs(chord)
        at = track.positions[segment] + ahead.real / np.abs(chord) * stretch
    return at, ahead.imag


def _on_segment(
    track: Track, points: ComplexArray, segment: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Chainage and distance of the nearest point of each point's own stretch."""
    chord = track.points[segment + 1] - track.points[segment]
    ahead = points - track.points[segment]
    share = np.clip((np.conj(chord) * ahead).real / np.abs(chord) ** 2, 0.0, 1.0)
    stretch = track.positions[segment + 1] - track.positions[segment]
    return track.positions[segment] + share * stretch, np.abs(ahead - share * chord)


def _pairs(points: ComplexArray) -> FloatArray:
    return np.column_stack([points.real, points.imag])

"""The plane curve of a line from its curvature, and its place on the earth.

Points of the plane are complex numbers, east + i north [m]: to turn and to scale is to multiply.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import ComplexArray, FloatArray, IntArray, numbered
from trainlog.railway.line import CurvatureProfile, Geometry

STEP = 25.0
"""Largest distance between computed points [m]."""

SEMI_MAJOR_AXIS = 6_378_137.0
"""Of the ellipsoid WGS 84 [m]."""

_FLATTENING = 1.0 / 298.257_223_563
_ECCENTRICITY_SQUARED = _FLATTENING * (2.0 - _FLATTENING)


def plane_curve(
    curvatures: CurvatureProfile, length: float, step: float = STEP
) -> tuple[FloatArray, ComplexArray]:
    """Integrate curvature to a curve that starts at 0, heading north.

    Positive curvature bends to the right. Elements are straights, arcs and clothoids; on each
    piece of at most `step` the heading is a quadratic in position, known exactly, and the point is
    its integral by Gauss-Legendre quadrature with 8 nodes, whose error is far below a millimetre.

    Parameters
    ----------
    curvatures : CurvatureProfile [1/m]
    length : float [m]
    step : float [m]

    Returns
    -------
    positions : (n,) array [m]
        Starts of the elements, and points between them at most `step` apart.
    points : (n,) complex array [m]
    """
    starts = np.append(curvatures.positions, length)
    pieces = np.maximum(np.ceil(np.diff(starts) / step), 1.0).astype(np.int64)
    element, within = numbered(pieces)
    width = np.diff(starts)[element]
    span = width / pieces[element]
    rate = (curvatures.end - curvatures.start)[element] / width
    bend = curvatures.start[element] + rate * within * span
    turned = np.concatenate(([0.0], np.cumsum((bend + 0.5 * rate * span) * span)))
    nodes, weights = np.polynomial.legendre.leggauss(8)
    ahead = 0.5 * span[:, None] * (nodes + 1.0)
    heading = turned[:-1, None] + (bend[:, None] + 0.5 * rate[:, None] * ahead) * ahead
    # Heading h clockwise from north is the direction i exp(-i h) = sin h + i cos h.
    chords = 0.5 * span * ((1j * np.exp(-1j * heading)) @ weights)
    positions = np.append(starts[element] + within * span, length)
    return positions, np.concatenate(([0.0], np.cumsum(chords)))


def thinned(positions: FloatArray, points: ComplexArray, tolerance: float) -> IntArray:
    """Indices of the points to keep so that interpolation in position stays within `tolerance`.

    Douglas and Peucker's method, with the distance taken at the same position.

    Examples
    --------
    >>> thinned(np.arange(4.0), np.array([0.0, 1.0, 2.0, 3.0 + 1.0j]), 0.1).tolist()
    [0, 2, 3]
    """
    kept = {0, positions.size - 1}
    open_pieces = [(0, positions.size - 1)]
    while open_pieces:
        first, last = open_pieces.pop()
        share = (positions[first : last + 1] - positions[first]) / (
            positions[last] - positions[first]
        )
        chord = points[first] + share * (points[last] - points[first])
        distances = np.abs(points[first : last + 1] - chord)
        worst = first + int(np.argmax(distances))
        if distances.max() > tolerance:
            kept.add(worst)
            open_pieces += [(first, worst), (worst, last)]
    return np.array(sorted(kept), dtype=np.int64)


def to_plane(
    latitude: ArrayLike, longitude: ArrayLike, origin: tuple[float, float]
) -> ComplexArray:
    """Points [m] of WGS 84 coordinates [deg] on the plane that touches the ellipsoid at `origin`.

    Source: B. Hofmann-Wellenhof et al., GNSS, Springer 2008, section 8.2.

    Examples
    --------
    >>> to_plane(47.01, 9.0, (47.0, 9.0)).round(1).item()
    1111.7j
    """
    offset = (_cartesian(latitude, longitude).T - _cartesian(*origin)).T
    east, north, _ = np.tensordot(_axes(origin), offset, axes=1)
    return np.asarray(east + 1j * north)


def from_plane(points: ComplexArray, origin: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Latitudes and longitudes [deg] of points of the plane, dropped on the ellipsoid."""
    east, north = points.real, points.imag
    up = np.zeros(points.shape)
    # The plane rises above the ellipsoid with the square of the distance; each turn leaves a
    # thousandth of the last turn's error.
    for _ in range(4):
        cartesian = _cartesian(*origin)[:, None] + _axes(origin).T @ np.stack((east, north, up))
        latitude, longitude, height = _geodetic(cartesian)
        up = up - height
    return latitude, longitude


def _cartesian(latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
    """Earth-centred coordinates [m] on the ellipsoid, (3, ...)."""
    phi, lam = np.radians(latitude), np.radians(longitude)
    normal = SEMI_MAJOR_AXIS / np.sqrt(1.0 - _ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
    return np.array(
        (
            normal * np.cos(phi) * np.cos(lam),
            normal * np.cos(phi) * np.sin(lam),
            normal * (1.0 - _ECCENTRICITY_SQUARED) * np.sin(phi),
        )
    )


def _geodetic(cartesian: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Latitude, longitude [deg] and height [m], by Bowring's formula."""
    x, y, z = cartesian
    distance = np.hypot(x, y)
    minor = SEMI_MAJOR_AXIS * (1.0 - _FLATTENING)
    second = _ECCENTRICITY_SQUARED / (1.0 - _ECCENTRICITY_SQUARED)
    reduced = np.arctan2(z * SEMI_MAJOR_AXIS, distance * minor)
    phi = np.arctan2(
        z + second * minor * np.sin(reduced) ** 3,
        distance - _ECCENTRICITY_SQUARED * SEMI_MAJOR_AXIS * np.cos(reduced) ** 3,
    )
    normal = SEMI_MAJOR_AXIS / np.sqrt(1.0 - _ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
    height = distance / np.cos(phi) - normal
    return np.degrees(phi), np.degrees(np.arctan2(y, x)), height


def _axes(origin: tuple[float, float]) -> FloatArray:
    """East, north and up at `origin` in earth-centred coordinates, (3, 3)."""
    phi, lam = np.radians(origin)
    return np.array(
        (
            (-np.sin(lam), np.cos(lam), 0.0),
            (-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)),
            (np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)),
        )
    )


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


def track_of(
    geometry: Geometry, length: float | None = None, origin: tuple[float, float] | None = None
) -> Track:
    """The track of a geometry, long stretches divided.

    Parameters
    ----------
    geometry : Geometry
    length : float [m], optional
        Of the line: points beyond its ends are left out.
    origin : (latitude, longitude) [deg], optional
        Where the plane touches the earth; default: in the middle of the points.
    """
    even = np.arange(geometry.positions[0], geometry.positions[-1], SPACING)
    positions = np.unique(np.concatenate([geometry.positions, even]))
    if length is not None:
        positions = positions[(positions >= -1.0) & (positions <= length + 1.0)]
    if origin is None:
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
        _, corner = _tree(track.points).query(_pairs(point))
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
    tree = _tree(track.points)
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


def _tree(points: ComplexArray) -> Any:
    """A tree of the points; SciPy is loaded where one is asked for."""
    from scipy.spatial import cKDTree

    return cKDTree(_pairs(points))


def _pairs(points: ComplexArray) -> FloatArray:
    return np.column_stack([points.real, points.imag])

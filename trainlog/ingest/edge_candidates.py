"""Where on the edges of a network satellite fixes may lie, and which of them are looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimators.route_matching import EdgeGraph, EdgeNodes
from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray, robust_std
from trainlog.ingest.fixes import GATE, Fixes
from trainlog.ingest.line_motion import GEOMETRY_STD
from trainlog.railway.geometry import SPACING as TRACK_SPACING, Track, candidates, to_plane
from trainlog.railway.line import Geometry

SPACING, MOST_NODES, STANDING_TIME = 50.0, 800, 120.0
"""Distance [m] between fixes that are looked at, how many at most, and how often [s] at a
standstill."""

SHIFT = 5.0
"""Standard deviation [m] of a constant shift between a receiver's fixes and a network."""

WIDEST = 150.0
"""Distance [m] within which a fix may be on the network at all."""

STOOD_SPEED, TURNING_TIME = 1.5, 60.0
"""Speed [m/s] at which a train may have turned round, and the time [s] that takes, where no speed
is known."""


@dataclass(frozen=True, eq=False)
class EdgeTracks:
    """Edges of a network on a plane.

    Attributes
    ----------
    graph : EdgeGraph
    tracks : tuple of Track or None
        By edge; None where an edge has no geometry.
    origin : (latitude, longitude) [deg]
        Where the plane touches the earth.
    """

    graph: EdgeGraph
    tracks: tuple[Track | None, ...]
    origin: tuple[float, float]


def edge_tracks(
    graph: EdgeGraph, geometries: Sequence[Geometry | None], origin: tuple[float, float]
) -> EdgeTracks:
    """The edges on the plane that touches the earth at `origin`."""
    tracks = tuple(
        None if geometry is None else _track(geometry, float(length), origin)
        for geometry, length in zip(geometries, graph.lengths, strict=True)
    )
    return EdgeTracks(graph, tracks, origin)


def _track(geometry: Geometry, length: float, origin: tuple[float, float]) -> Track:
    even = np.arange(geometry.positions[0], geometry.positions[-1], TRACK_SPACING)
    positions = np.unique(np.concatenate([geometry.positions, even]))
    positions = positions[(positions >= -1.0) & (positions <= length + 1.0)]
    points = to_plane(*geometry.at(positions), origin)
    moving = np.concatenate(([True], np.abs(np.diff(points)) > 0.0))
    return Track(positions[moving], points[moving], origin)


def edge_nodes(
    edges: EdgeTracks, fixes: Fixes, driven: FloatArray, driven_variance: FloatArray
) -> tuple[EdgeNodes, FloatArray]:
    """The fixes that are looked at, with their candidates; distances to the nearest edge [m]."""
    points = to_plane(fixes.latitude, fixes.longitude, edges.origin)
    known = np.flatnonzero(np.isfinite(points))
    chosen = known[_chosen(fixes.seconds[known], points[known], driven[known])]
    at, std = points[chosen], fixes.std[chosen]
    wide = _candidates(edges, at, np.full(at.size, WIDEST))
    near = np.full(at.size, np.inf)
    np.minimum.at(near, wide[0], wide[3])
    std = _usual_std(std, near)
    owner, edge, chainage, apart = wide
    close = apart <= np.maximum(GATE * std, 20.0)[owner]
    owner, edge, chainage, apart = owner[close], edge[close], chainage[close], apart[close]
    counts = np.bincount(owner, minlength=at.size)
    nodes = EdgeNodes(
        seconds=fixes.seconds[chosen],
        east=np.ascontiguousarray(at.real),
        north=np.ascontiguousarray(at.imag),
        std=std,
        driven=driven[chosen],
        driven_variance=driven_variance[chosen],
        stood=_stood(fixes, chosen, at),
        first=np.concatenate(([0], np.cumsum(counts))),
        edge=edge,
        chainage=chainage,
        distance=apart,
    )
    return nodes, near


def _chosen(seconds: FloatArray, points: ComplexArray, driven: FloatArray) -> IntArray:
    """Of many fixes the first of each stretch driven, and of each longer time."""
    if not seconds.size:
        return np.zeros(0, dtype=np.int64)
    way = driven
    if not np.isfinite(driven).all():
        way = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(points)))))
    stretch = max(SPACING, float(way[-1] - way[0]) / MOST_NODES)
    number = np.floor((way - way[0]) / stretch) + np.floor((seconds - seconds[0]) / STANDING_TIME)
    return np.unique(number, return_index=True)[1].astype(np.int64)


def _candidates(
    edges: EdgeTracks, points: ComplexArray, reach: FloatArray
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Owner, edge, chainage and distance of all candidates, in order of their owners."""
    found = []
    furthest = float(reach.max())
    for number, track in enumerate(edges.tracks):
        if track is None:
            continue
        east, north = track.points.real, track.points.imag
        inside = (points.real > east.min() - furthest) & (points.real < east.max() + furthest)
        inside &= (points.imag > north.min() - furthest) & (points.imag < north.max() + furthest)
        mine = np.flatnonzero(inside)
        if mine.size:
            of = candidates(track, points[mine], reach[mine])
            edge = np.full(of.owner.size, number, dtype=np.int64)
            found.append((mine[of.owner], edge, of.chainage, of.distance))
    if not found:
        none, nothing = np.zeros(0, dtype=np.int64), np.zeros(0)
        return none, none, nothing, nothing
    owner, edge, chainage, apart = (np.concatenate(each) for each in zip(*found, strict=True))
    order = np.argsort(owner, kind="stable")
    length = edges.graph.lengths[edge[order]]
    return owner[order], edge[order], np.clip(chainage[order], 0.0, length), apart[order]


def _usual_std(std: FloatArray, near: FloatArray) -> FloatArray:
    """Standard deviation of the distances from the right edge [m]: as stated, and as they show."""
    known = np.isfinite(near)
    if not known.any():
        return std
    spread = robust_std(near[known])
    stated = float(np.median(std[known]))
    smaller = min(1.0, max(spread, GEOMETRY_STD) / stated)
    misfit = min(float(np.sqrt(max(0.0, spread**2 - stated**2))), WIDEST / GATE)
    return np.sqrt((std * smaller) ** 2 + misfit**2 + GEOMETRY_STD**2 + (0.5 * SHIFT) ** 2)


def _stood(fixes: Fixes, chosen: IntArray, points: ComplexArray) -> BoolArray:
    """Whether the train may have stood since the fix chosen before."""
    steps, way = np.diff(fixes.seconds[chosen]), np.abs(np.diff(points))
    slow = (way < STOOD_SPEED * steps) & (steps > 5.0) | (steps > TURNING_TIME)
    speed = fixes.speed
    if fixes.wheel_speed is not None:
        speed = np.where(np.isfinite(speed), speed, fixes.wheel_speed)
    if np.count_nonzero(np.isfinite(speed)) > 0.5 * np.count_nonzero(np.isfinite(fixes.latitude)):
        still = np.cumsum(speed < STOOD_SPEED)
        slow = (np.diff(still[chosen]) > 0) | (steps > TURNING_TIME)
    return np.concatenate(([False], slow)).astype(np.bool_)

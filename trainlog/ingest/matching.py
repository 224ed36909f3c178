"""The route of satellite fixes over the edges of a network, or along a line, which is one edge.

First the best chain of the places that the fixes may mean (`estimators.matching`), on a network cut
where the train turned round or was away. Then, for every edge of the chain, the best one without
it: both are compared by the fixes' distances beside them, whose errors last, and by the distances
driven. The least of these differences is the margin. What is below `LIKELY` is not determined.

Without fixes stop places and gradients say where on its line a trip begins, and in which direction
it ran: a counter that starts anywhere is put where the stops lie at stations. Both directions are
tried where none is stated; what decides is kept as metadata, and so is that nothing does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby, pairwise

import numpy as np
from scipy.special import logsumexp

from estimators.matching import (
    ABSENCE,
    ALONG,
    IDLE_SPEED,
    REVERSAL,
    REVERSED,
    STEP_LENGTH,
    STEP_PENALTY,
    TURN_SHARE,
    Between,
    Chain,
    EdgeGraph,
    EdgeNodes,
    LeftOut,
    best_chain,
    distances,
)
from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray, robust_std
from trainlog.errors import InputError
from trainlog.ingest.motion import (
    EFFORTS,
    GATE,
    LIKELY,
    MANY,
    MOVING,
    POSITION,
    RESTING,
    SEVERAL,
    SHORTEST,
    SPAN,
    SPEED,
    STANDING,
    SURE,
    seconds_of,
)
from trainlog.ingest.receiver import Driven, Fixes, distance_driven
from trainlog.ingest.recording import Table
from trainlog.railway.geometry import Track, beside, candidates, to_plane, track_of
from trainlog.railway.line import Geometry, Line
from trainlog.railway.train import Train
from trainlog.units import NANOSECONDS

GEOMETRY_STD = 2.0
"""Standard deviation of a good line's own geometry [m]."""

SPACING, MOST_NODES, STANDING_TIME = 50.0, 800, 120.0
"""Distance [m] between fixes that are looked at, how many at most, and how often [s] at a
standstill."""

SHIFT = 5.0
"""Standard deviation [m] of a constant shift between a receiver's fixes and a network."""

WIDEST = 150.0
"""Distance [m] within which a fix may be on the network at all."""

LASTING, WHITE = 60.0, 2.0
"""How long [s] errors of a receiver last, or a train takes to turn round; the least standard
deviation [m] of what lasts, and that of what does not."""

LEAST_DISTURBED, DISTURBED, DISTURBANCE = 0.002, 0.05, 30.0
"""Probability that a stretch of any length is disturbed, that a short one is, besides, and how
long [s] such disturbances last."""

FURTHEST = 60.0
"""How far [m] beside the way disturbed fixes lie, evenly."""

APART = 3.0
"""Distance [m] from which on two ways run apart."""

KNOWN_LENGTH = 0.01
"""Share by which the length of an edge without a course may be off."""

ROUNDS = 4
"""How often a better route found among the others takes the place of the best."""

END = 100.0
"""A route's first and last edge on which a train was for less than this [m] do not count."""


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
        None if geometry is None else track_of(geometry, float(length), origin)
        for geometry, length in zip(geometries, graph.lengths, strict=True)
    )
    return EdgeTracks(graph, tracks, origin)


def edge_nodes(
    edges: EdgeTracks,
    fixes: Fixes,
    chosen: IntArray,
    std: FloatArray,
    driven: Driven,
    found: tuple[IntArray, IntArray, FloatArray, FloatArray],
) -> EdgeNodes:
    """Some fixes with their candidates.

    Parameters
    ----------
    edges : EdgeTracks
    fixes : Fixes
    chosen : (n,) int array
        Which of them are looked at.
    std : (n,) array [m]
        Of their distances from the right edge.
    driven : Driven
    found : (owner, edge, chainage, distance)
        Their candidates, in order of their owners.
    """
    points = to_plane(fixes.latitude[chosen], fixes.longitude[chosen], edges.origin)
    owner, edge, chainage, apart = found
    counts = np.bincount(owner, minlength=chosen.size)
    return EdgeNodes(
        seconds=fixes.seconds[chosen],
        east=np.ascontiguousarray(points.real),
        north=np.ascontiguousarray(points.imag),
        std=std,
        driven=driven.distance[chosen],
        driven_variance=driven.variance[chosen],
        stood=_stood(fixes, chosen, points),
        first=np.concatenate(([0], np.cumsum(counts))),
        edge=edge,
        chainage=chainage,
        distance=apart,
    )


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


def rough_noise(std: FloatArray, near: FloatArray) -> tuple[FloatArray, float]:
    """Accuracies of fixes [m], no larger than their distances from the nearest edge show.

    And what these distances show beyond them: a guess of how far the edges are misplaced [m].
    """
    known = np.isfinite(near)
    if not known.any():
        return std, 0.0
    spread, stated = robust_std(near[known]), float(np.median(std[known]))
    smaller = min(1.0, max(spread, GEOMETRY_STD) / stated)
    return std * smaller, float(np.sqrt(max(0.0, spread**2 - stated**2)))


def _stood(fixes: Fixes, chosen: IntArray, points: ComplexArray) -> BoolArray:
    """Whether the train may have stood since the fix chosen before."""
    steps, way = np.diff(fixes.seconds[chosen]), np.abs(np.diff(points))
    slow = (way < MOVING * steps) & (steps > 5.0) | (steps > LASTING)
    speed = fixes.any_speed
    if np.count_nonzero(np.isfinite(speed)) > 0.5 * np.count_nonzero(np.isfinite(fixes.latitude)):
        still = np.cumsum(speed < MOVING)
        slow = (np.diff(still[chosen]) > 0) | (steps > LASTING)
    return np.concatenate(([False], slow)).astype(np.bool_)


@dataclass(frozen=True)
class Unseen:
    """Edges without a course on the way between two fixes.

    Attributes
    ----------
    courses : tuple of int
    before, after : float [s]
        Of the last fix before them and the first behind them.
    length : float [m]
        Between the two along the way.
    driven, std : float [m]
        By the speed; NaN where none is known. Its standard deviation.
    """

    courses: tuple[int, ...]
    before: float
    after: float
    length: float
    driven: float
    std: float

    @property
    def agrees(self) -> bool:
        """Whether the distance driven is that along the way."""
        most = GATE * self.std + KNOWN_LENGTH * self.length
        return bool(abs(self.driven - self.length) <= most)


@dataclass(frozen=True)
class Passage:
    """A stretch driven over the network in one direction.

    Attributes
    ----------
    courses : tuple of int
        Edges with their directions, in order of travel: edge `e` along its chainage is ``2 e``,
        against it ``2 e + 1``.
    start, end : float [m]
        On the first and the last edge, by their chainage.
    begin, finish : float [s]
        When.
    margin : float
        By how much it is better than the second-best, in units of log-likelihood; infinite where
        no other route is possible.
    other : tuple of int
        The courses of the second-best.
    after : str
        Why it does not go on from the passage before: ``"reversal"``, ``"absence"``, or empty.
    unseen : tuple of Unseen
        Where it runs over edges without a course.
    """

    courses: tuple[int, ...]
    start: float
    end: float
    begin: float
    finish: float
    margin: float = np.inf
    other: tuple[int, ...] = ()
    after: str = ""
    unseen: tuple[Unseen, ...] = ()

    @property
    def determined(self) -> bool:
        """Whether the fixes determine it."""
        return self.margin >= LIKELY


@dataclass(frozen=True)
class Passages:
    """What fixes show of a trip over a network.

    Attributes
    ----------
    passages : tuple of Passage
    fixes, on_network : int
        Fixes that were looked at, and those of them that belong to a passage.
    near : int
        Fixes with an edge within reach.
    distance : float [m]
        Median distance of the fixes from the nearest edge; infinite beyond `WIDEST`.
    dropped : tuple of (float, float)
        When the train was on the network for too short a stretch [s].
    """

    passages: tuple[Passage, ...]
    fixes: int
    on_network: int
    near: int
    distance: float
    dropped: tuple[tuple[float, float], ...] = field(default=())


def match_route(edges: EdgeTracks, fixes: Fixes) -> Passages:
    """The passages of a trip over the edges of a network.

    Parameters
    ----------
    edges : EdgeTracks
    fixes : Fixes
    """
    driven = distance_driven(fixes)
    points = to_plane(fixes.latitude, fixes.longitude, edges.origin)
    known = np.flatnonzero(np.isfinite(points))
    chosen = known[_chosen(fixes.seconds[known], points[known], driven.distance[known])]
    owner, edge, chainage, apart = _candidates(edges, points[chosen], np.full(chosen.size, WIDEST))
    near = np.full(chosen.size, np.inf)
    np.minimum.at(near, owner, apart)
    std, misfit = rough_noise(fixes.std[chosen], near)
    std = np.sqrt(std**2 + min(misfit, WIDEST / GATE) ** 2 + GEOMETRY_STD**2 + (0.5 * SHIFT) ** 2)
    close = apart <= np.maximum(GATE * std, 20.0)[owner]
    places = owner[close], edge[close], chainage[close], apart[close]
    nodes = edge_nodes(edges, fixes, chosen, std, driven, places)
    distance = float(np.median(near)) if near.size else np.inf
    count, reached = nodes.seconds.size, int(np.count_nonzero(np.diff(nodes.first)))
    if reached < SEVERAL:
        return Passages((), count, 0, reached, distance)
    between = distances(edges.graph, np.unique(nodes.edge))
    chain = best_chain(edges.graph, nodes, between)
    found, dropped, inside = list[Passage](), list[tuple[float, float]](), 0
    for part, after in _parts(chain):
        first, last = int(part.node[0]), int(part.node[-1])
        extent = float(np.ptp(_driven(part, nodes, edges.graph, between, None).position))
        if part.node.size < SEVERAL or extent < SHORTEST:
            dropped.append((float(nodes.seconds[first]), float(nodes.seconds[last])))
            continue
        inside += part.node.size
        own = nodes.between(first, last + 1)
        found.append(replace(Search(edges, own).passage(), after=after))
    return Passages(tuple(found), count, inside, reached, distance, tuple(dropped))


def _parts(chain: Chain) -> Iterator[tuple[Chain, str]]:
    """The chain between reversals and absences, and what was before each part."""
    cuts = np.flatnonzero(chain.link != ALONG)
    cuts = cuts[cuts > 0]
    edges = [0, *cuts.tolist(), chain.node.size]
    for first, last in pairwise(edges):
        after = ""
        if first:
            after = "reversal" if chain.link[first] == REVERSED else "absence"
        part = slice(first, last)
        link = chain.link[part].copy()
        link[:1] = ALONG
        columns = chain.node[part], chain.candidate[part], chain.course[part]
        yield Chain(chain.worth, *columns, link, chain.without[part]), after


@dataclass(frozen=True, eq=False)
class _Driven:
    """A part of a chain as a route: its courses, and where along them its fixes lie [m]."""

    courses: list[int]
    node: IntArray
    position: FloatArray


def _driven(
    part: Chain, nodes: EdgeNodes, graph: EdgeGraph, between: Between, left_out: LeftOut | None
) -> _Driven:
    courses, position, begun = list[int](), np.zeros(part.node.size), 0.0
    for number in range(part.node.size):
        course, chainage = int(part.course[number]), float(nodes.chainage[part.candidate[number]])
        length = float(graph.lengths[course // 2])
        along = length - chainage if course % 2 else chainage
        if number == 0:
            courses.append(course)
        else:
            noise = float(np.hypot(*nodes.std[part.node[number - 1 : number + 1]]))
            on = course == courses[-1] and begun + along > position[number - 1] - 3.0 * noise
            if not on:
                use = left_out.between if left_out is not None and part.without[number] else between
                for each in [*use.path(courses[-1], course), course]:
                    begun += float(graph.lengths[courses[-1] // 2])
                    courses.append(each)
        position[number] = begun + along
    return _Driven(courses, part.node, position)


@dataclass(frozen=True, eq=False)
class Way:
    """One possible way of the train.

    Attributes
    ----------
    chain : Chain
    parts : list of _Driven
        One, but for ways that turn round or are away.
    """

    chain: Chain
    parts: list[_Driven]

    @cached_property
    def position(self) -> FloatArray:
        """Along the parts one after the other [m], by fix of the chain."""
        return np.concatenate([part.position for part in self.parts])

    def legs(self, lengths: FloatArray) -> list[list[_Leg]]:
        """Of each part its legs, without those at its ends on which the train hardly was."""
        found = []
        for part in self.parts:
            own = lengths[np.array(part.courses) // 2]
            begun = np.concatenate(([0.0], np.cumsum(own)))
            low, high = float(part.position.min()), float(part.position.max())
            legs = [
                _Leg(course, float(length), at, max(at, low), min(at + float(length), high))
                for course, length, at in zip(part.courses, own, begun.tolist(), strict=False)
            ]
            while len(legs) > 1 and legs[0].last - legs[0].first < END:
                del legs[0]
            while len(legs) > 1 and legs[-1].last - legs[-1].first < END:
                del legs[-1]
            found.append(legs)
        return found


@dataclass(frozen=True)
class _Leg:
    """An edge of a part: its course and length [m], where along the part it begins [m].

    And the first and the last position along the part that was driven [m].
    """

    course: int
    length: float
    begun: float
    first: float
    last: float

    def chainage(self, position: float) -> float:
        """On the edge, of a position along the part [m]."""
        along = position - self.begun
        return self.length - along if self.course % 2 else along


class Search:
    """The best way of a train among all others, from fixes of one direction of travel.

    Parameters
    ----------
    edges : EdgeTracks
    nodes : EdgeNodes
    worth : dict of str to float
        What absences cost and fixes are worth, where nothing but the chain itself is compared:
        options of `estimators.matching.best_chain`.
    """

    def __init__(
        self, edges: EdgeTracks, nodes: EdgeNodes, worth: dict[str, float] | None = None
    ) -> None:
        self.edges, self.nodes, self.worth = edges, nodes, worth
        self.between = distances(edges.graph, np.unique(nodes.edge))
        self.points = nodes.east + 1j * nodes.north
        self._distances: dict[int, Between] = {}

    def passage(self) -> Passage:
        """The best way as a passage."""
        return self.passage_of(*self.best())

    def best(self) -> tuple[Way, float, Way | None]:
        """The best way, by how much it is, and the second-best."""
        best = self._way(None)
        margin, other = np.inf, None
        for _ in range(ROUNDS):
            margin, other = self._second(best)
            if other is None or margin >= 0.0:
                break
            best = other
        return best, max(margin, 0.0), other

    def passage_of(self, best: Way, margin: float, other: Way | None) -> Passage:
        """A way as a passage."""
        legs = [leg for part in best.legs(self.edges.graph.lengths) for leg in part]
        seconds = self.nodes.seconds[best.chain.node]
        return Passage(
            courses=self._courses(best),
            start=legs[0].chainage(legs[0].first),
            end=legs[-1].chainage(legs[-1].last),
            begin=float(seconds[0]),
            finish=float(seconds[-1]),
            margin=margin,
            other=() if other is None else self._courses(other),
            unseen=tuple(self._unseen(best)),
        )

    def _unseen(self, way: Way) -> Iterator[Unseen]:
        """The edges without a course between its fixes; none where no edge has one."""
        n, tracks = self.nodes, self.edges.tracks
        if all(track is None for track in tracks):
            return
        for part, legs in zip(way.parts, way.legs(self.edges.graph.lengths), strict=True):
            for bare, run in groupby(legs, key=lambda leg: tracks[leg.course // 2] is None):
                passed = list(run)
                end = passed[-1].begun + passed[-1].length
                before = np.flatnonzero(part.position <= passed[0].begun)
                after = np.flatnonzero(part.position >= end)
                if not bare or not before.size or not after.size:
                    continue
                at = np.array([before[-1], after[0]])
                one, two = part.node[at].tolist()
                variance = n.driven_variance[two] - n.driven_variance[one]
                yield Unseen(
                    tuple(leg.course for leg in passed),
                    float(n.seconds[one]),
                    float(n.seconds[two]),
                    float(np.diff(part.position[at])[0]),
                    float(n.driven[two] - n.driven[one]),
                    float(np.sqrt(variance + n.std[one] ** 2 + n.std[two] ** 2)),
                )

    def _way(self, left_out: LeftOut | None) -> Way:
        chain = best_chain(
            self.edges.graph, self.nodes, self.between, left_out, **(self.worth or {})
        )
        parts = [
            _driven(part, self.nodes, self.edges.graph, self.between, left_out)
            for part, _ in _parts(chain)
            if part.node.size
        ]
        return Way(chain, parts)

    def _courses(self, way: Way) -> tuple[int, ...]:
        return tuple(leg.course for part in way.legs(self.edges.graph.lengths) for leg in part)

    def _second(self, best: Way) -> tuple[float, Way | None]:
        """The best of the ways that do without an edge of `best`; negative if it is better."""
        margin, found = np.inf, None
        courses = self._courses(best)
        for part, legs in zip(best.parts, best.legs(self.edges.graph.lengths), strict=True):
            seconds = self.nodes.seconds[part.node]
            order = np.maximum.accumulate(part.position)
            for number, leg in enumerate(legs):
                begin, finish = np.interp([leg.first, leg.last], order, seconds).tolist()
                left_out = LeftOut(
                    leg.course,
                    -np.inf if number == 0 else begin - 1.0,
                    np.inf if number == len(legs) - 1 else finish + 1.0,
                    self._without(leg.course),
                )
                rival = self._way(left_out)
                if not rival.parts or self._courses(rival) == courses:
                    continue
                ahead = self.compared(best, rival)
                if ahead < margin:
                    margin, found = ahead, rival
        return margin, found

    def _without(self, course: int) -> Between:
        if course not in self._distances:
            used = np.unique(self.nodes.edge)
            self._distances[course] = distances(self.edges.graph, used, course)
        return self._distances[course]

    def compared(self, best: Way, rival: Way) -> float:
        """By how much one way fits better than another."""
        if self.worth is not None:
            return best.chain.worth - rival.chain.worth
        one, other = self._aside(best), self._aside(rival)
        known = one.known | other.known
        # Where both run together neither gains; each stretch apart is judged by itself.
        gap = np.where(one.known & other.known, np.abs(one.vector - other.vector), FURTHEST)
        block = _blocks(self.nodes.seconds[known], (gap > APART)[known])
        size = robust_std(one.size[known & one.known])
        std = max(WHITE, size)
        seconds = self.nodes.seconds[known]
        fit = [_evidence(way.at(known), block, seconds, std) for way in (one, other)]
        steps = [self._steps(way, best, rival) for way in (best, rival)]
        return fit[0] - fit[1] + steps[1] - steps[0]

    def _aside(self, way: Way) -> _Aside:
        """How far beside the way each fix lies."""
        size, normal = np.full(self.points.size, np.nan), np.ones(self.points.size, np.complex128)
        for part in way.parts:
            track = self._track(part.courses)
            span = np.arange(part.node[0], part.node[-1] + 1)
            course = np.interp(
                self.nodes.seconds[span], self.nodes.seconds[part.node], part.position
            )
            if np.isfinite(self.nodes.driven).all():
                off = part.position - self.nodes.driven[part.node]
                course = self.nodes.driven[span] + np.interp(span, part.node, off)
            at, size[span] = beside(track, self.points[span], course)
            segment = track.segments(at)
            chord = track.points[segment + 1] - track.points[segment]
            normal[span] = 1j * chord / np.abs(chord)
        return _Aside(size, normal)

    def _track(self, courses: list[int]) -> Track:
        """The track of courses one after the other."""
        positions, points, begun = list[FloatArray](), list[ComplexArray](), 0.0
        for course in courses:
            track = self.edges.tracks[course // 2]
            length = float(self.edges.graph.lengths[course // 2])
            if track is not None:
                way = slice(None, None, -1 if course % 2 else 1)
                along = length - track.positions if course % 2 else track.positions
                positions.append(begun + along[way])
                points.append(track.points[way])
            begun += length
        position, point = np.concatenate(positions), np.concatenate(points)
        grows = np.concatenate(([True], np.diff(np.maximum.accumulate(position)) > 0.01))
        return Track(position[grows], point[grows], self.edges.origin)

    def _steps(self, way: Way, best: Way, rival: Way) -> float:
        """What the distances driven between the fixes that two ways share cost one of them."""
        n = self.nodes
        both = np.intersect1d(best.chain.node, rival.chain.node)
        mine = np.isin(way.chain.node, both)
        node, position = way.chain.node[mine], way.position[mine]
        number = np.repeat(np.arange(len(way.parts)), [part.node.size for part in way.parts])[mine]
        kinds = way.chain.link
        cost = REVERSAL * np.count_nonzero(kinds == REVERSED)
        cost += ABSENCE * np.count_nonzero(kinds > REVERSED)
        if node.size < 2:
            return float(cost)
        driven, variance = n.driven, n.driven_variance
        if np.isnan(driven).any():
            every = np.union1d(best.chain.node, rival.chain.node)
            chords = np.abs(np.diff(self.points[every], prepend=self.points[every[0]]))
            unsure = (TURN_SHARE * chords) ** 2
            unsure += (IDLE_SPEED * np.diff(n.seconds[every], prepend=n.seconds[every[0]])) ** 2
            driven = np.interp(np.arange(n.seconds.size), every, np.cumsum(chords))
            variance = np.interp(np.arange(n.seconds.size), every, np.cumsum(unsure))
        noise = n.std[node[1:]] ** 2 + n.std[node[:-1]] ** 2 + np.diff(variance[node])
        off = np.diff(position) - np.diff(driven[node])
        penalty = np.minimum(0.5 * off**2 / noise, STEP_PENALTY + np.abs(off) / STEP_LENGTH)
        return float(cost + penalty[np.diff(number) == 0].sum())


@dataclass(frozen=True, eq=False)
class _Aside:
    """Distances beside a way, positive to its left [m], NaN before and behind it; its normals."""

    size: FloatArray
    normal: ComplexArray

    @property
    def known(self) -> BoolArray:
        return np.isfinite(self.size)

    @property
    def vector(self) -> ComplexArray:
        return self.size * self.normal

    def at(self, rows: BoolArray) -> _Aside:
        return _Aside(self.size[rows], self.normal[rows])


def _blocks(seconds: FloatArray, apart: BoolArray) -> IntArray:
    """Numbers of blocks in which two ways run together or apart, no longer than `LASTING`."""
    change = np.concatenate(([True], apart[1:] != apart[:-1]))
    begun = np.maximum.accumulate(np.where(change, seconds, -np.inf))
    within = np.floor((seconds - begun) / LASTING)
    change |= np.concatenate(([False], within[1:] != within[:-1]))
    return np.cumsum(change) - 1


def _evidence(way: _Aside, block: IntArray, seconds: FloatArray, std: float) -> float:
    """Logarithm of how probable the distances beside a way are.

    Errors last: a block of time counts once, by its median. They are a shift that is the same
    throughout, which is not known, and a part that is normal but for a share of disturbances, the
    smaller the longer one would last.
    """
    first = np.flatnonzero(np.diff(block, prepend=-1))
    last = np.append(first[1:], block.size)
    rows = list(zip(first.tolist(), last.tolist(), strict=True))
    middle = np.array([np.median(way.size[low:high]) for low, high in rows])
    normal = np.array([way.normal[(low + high) // 2] for low, high in rows])
    lasted = seconds[last - 1] - seconds[first]
    disturbed = LEAST_DISTURBED + DISTURBED * np.exp(-lasted / DISTURBANCE)
    noise = np.hypot(std, WHITE / np.sqrt(last - first))
    grid = np.linspace(-2.5, 2.5, 11)
    shifts = SHIFT * (grid[:, None] + 1j * grid[None, :]).ravel()
    prior = np.exp(-0.5 * np.abs(shifts / SHIFT) ** 2)
    off = middle[None, :] - (shifts[:, None] * np.conj(normal)[None, :]).real
    fits = np.exp(-0.5 * (off / noise) ** 2) / (np.sqrt(2.0 * np.pi) * noise)
    fits = np.where(np.isfinite(off), fits, 0.0)
    density = (1.0 - disturbed) * fits + disturbed / (2.0 * FURTHEST)
    return float(logsumexp(np.log(density).sum(axis=1), b=prior / prior.sum()))


# --------------------------------------------------------------------------- places without fixes


NEAR, DRIFT = 60.0, 0.01
"""A stop lies at a station up to this distance [m], and this share of the way so far."""


@dataclass(frozen=True)
class Match:
    """Stops of a trip at the stations of a line.

    Attributes
    ----------
    start : float [m]
        Chainage at which the trip begins, in its direction.
    matched, stops : int
        Stops that lie at stations, both ends included, and all.
    error : float [m]
        RMS of the distances between them.
    """

    start: float
    matched: int
    stops: int
    error: float


def stops_of(table: Table) -> FloatArray | None:
    """Positions [m] of the stops from the first one, both ends included; None without them.

    The trip has to begin and end at standstill.
    """
    position, speed = table.signals.get(POSITION), table.signals.get(SPEED)
    if position is None or speed is None:
        return None
    known = np.flatnonzero(np.isfinite(position) & np.isfinite(speed))
    moves = np.flatnonzero(np.abs(speed[known]) > STANDING)
    if moves.size < 2 or moves[0] == 0 or moves[-1] == known.size - 1:
        return None
    time, place = table.time[known] / NANOSECONDS, position[known]
    still = np.flatnonzero(np.diff(time[moves]) >= RESTING)
    inner = [
        float(np.median(place[first + 1 : last]))
        for first, last in zip(moves[still].tolist(), moves[still + 1].tolist(), strict=True)
        if last - first > 1
    ]
    stops = np.array([place[0], *inner, place[-1]])
    return np.asarray(stops - stops[0])


def match_of(stops: FloatArray, line: Line) -> Match | None:
    """The one start at which both ends lie at stations, and the most stops; None if there is none.

    Of two that match as many stops none is taken.
    """
    stations = np.array([station.position for station in line.stations])
    near = NEAR + DRIFT * stops
    found = []
    for begin in stations:
        off = np.abs(begin + stops[:, None] - stations[None, :]).min(axis=1)
        if off[-1] <= near[-1]:
            inside = off <= near
            error = float(np.sqrt(np.mean(off[inside] ** 2)))
            found.append(Match(float(begin), int(inside.sum()), stops.size, error))
    found.sort(key=lambda match: (-match.matched, match.error))
    if not found or (len(found) > 1 and found[1].matched == found[0].matched):
        return None
    return found[0]


@dataclass(frozen=True)
class Gradients:
    """How well the motion follows the gradients of a direction.

    Attributes
    ----------
    share, std : float
        Of the gradients' acceleration in the motion, one if they are right, and its standard
        deviation.
    squares : float
        Mean square [m²/s⁴] that is left.
    windows : int
    """

    share: float
    std: float
    squares: float
    windows: int


def gradients_in(table: Table, line: Line, train: Train, start: float | None) -> Gradients | None:
    """Gradients of `line`, in its direction, in the motion; None where the data do not show them.

    Least squares of the acceleration by efforts, running resistance and gradients, with every
    coefficient free.
    """
    if not {POSITION, SPEED, EFFORTS[0]} <= set(table.signals):
        return None
    seconds = seconds_of(table)
    columns = [table.signals[name] for name in (POSITION, SPEED, *EFFORTS) if name in table.signals]
    values = np.column_stack([seconds, *columns])
    values = values[np.isfinite(values).all(axis=1)]
    if not len(values):
        return None
    values[:, 1] += 0.0 if start is None else start - values[0, 1]
    bins = (values[:, 0] / SPAN).astype(np.int64)
    count = np.bincount(bins)
    sums = [np.bincount(bins, column) for column in values.T]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.column_stack(sums) / count[:, None]
    rate = (mean[2:, 2] - mean[:-2, 2]) / (mean[2:, 0] - mean[:-2, 0])
    mean = 0.25 * (mean[2:] + 2.0 * mean[1:-1] + mean[:-2])
    used = np.isfinite(rate) & np.isfinite(mean).all(axis=1) & (mean[:, 2] > MOVING)
    used &= rate > (-0.4 if EFFORTS[2] not in table.signals else -3.0)
    if used.sum() < MANY:
        return None
    rate, mean = rate[used], mean[used]
    place, speed = np.clip(mean[:, 1], 0.0, line.length), mean[:, 2]
    pull = -line.track_acceleration(place, train.length) / (1.0 + train.rotating_mass_factor)
    if np.std(pull) < 1e-3:
        return None
    efforts = mean[:, 3:] / train.mass
    design = np.column_stack([pull, np.ones_like(speed), speed, speed**2, efforts])
    kept = np.ones(rate.size, dtype=np.bool_)
    for _ in range(3):
        beta = np.linalg.lstsq(design[kept], rate[kept], rcond=None)[0]
        left = rate - design @ beta
        scale = robust_std(left[kept])
        kept = np.abs(left) <= 4.0 * max(scale, 1e-6)
    # All windows count, those far off by no more than the bound: both directions have the same.
    squares = float(np.mean(np.minimum(np.abs(left), 4.0 * scale) ** 2))
    inverse = np.linalg.pinv(design[kept].T @ design[kept])
    std = float(np.sqrt(3.0 * squares * inverse[0, 0]))
    return Gradients(float(beta[0]), std, squares, int(rate.size))


@dataclass(frozen=True)
class Placed:
    """Where a trip lies.

    Attributes
    ----------
    direction : str
        ``"forward"`` or ``"reverse"``; empty where the data do not decide.
    start : float or None [m]
        Of the stations.
    evidence : str
    """

    direction: str
    start: float | None
    evidence: str


def placed(
    table: Table, line: Line, train: Train | None, stated: str | None, *, by_stations: bool
) -> Placed:
    """The direction of a trip, and its start by the stations if that is asked for.

    Raises
    ------
    InputError
        If the start is asked for, and the stops do not decide it.
    """
    ways = {"forward": line, "reverse": line.reversed()}
    stops = stops_of(table)
    matches = {way: None if stops is None else match_of(stops, each) for way, each in ways.items()}
    able = {way: match for way, match in matches.items() if match is not None}
    if by_stations and not ({stated} if stated else set(ways)) & set(able):
        raise InputError(
            f"its stops match the stations of line '{line.name}' nowhere, or in several places",
            remedy="give start_position under [trip] of the profile, or --set start_position=0.2km",
        )
    starts = {way: able[way].start if by_stations and way in able else None for way in ways}
    most = max((match.matched for match in able.values()), default=0)
    best = [way for way, match in able.items() if match.matched == most]
    shown = {way: f"{m.matched} of {m.stops} stops at stations {way}" for way, m in able.items()}
    if by_stations and stated is None and len(best) == 1:
        match = able[best[0]]
        where = f"start at km {match.start / 1e3:.3f}"
        words = f"{shown[best[0]]}, {match.error:.0f} m off (RMS), {where}"
        return Placed(best[0], match.start, words)
    found: dict[str, Gradients | None] = {}
    if train is not None:
        found = {way: gradients_in(table, each, train, starts[way]) for way, each in ways.items()}
    one, other = found.get("forward"), found.get("reverse")
    if one is not None and other is not None:
        way = "forward" if one.squares <= other.squares else "reverse"
        good, bad = (one, other) if way == "forward" else (other, one)
        ratio = good.windows / 6.0 * float(np.log(bad.squares / max(good.squares, 1e-12)))
        if ratio > SURE and 0.5 < good.share < 1.6 and (not by_stations or way in able):
            words = (
                f"the motion follows the gradients {way} ({good.share:.2f}"
                f" ± {1.96 * good.std:.2f} of them; the other way {bad.share:.2f}"
                f" ± {1.96 * bad.std:.2f})"
            )
            return Placed(way, starts[stated or way], words)
    way = stated or (best[0] if by_stations else "forward")
    words = "neither stops at stations nor gradients decide it"
    words = f"as stated: {words}" if stated else f"{way} assumed: {words}"
    return Placed("", starts[way] if by_stations else None, words)

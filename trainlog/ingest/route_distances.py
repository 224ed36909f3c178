"""Routes of recordings without fixes: by kilometres of numbered lines, by distances between stops.

Recorders write the number of a line and its kilometre, which jumps where the train passes to
another line: the places on the edges that this means are a chain as fixes are
(`trainlog.ingest.route_matching`). Without numbers the distances between the stops of a trip are
compared with those between stations, over the shortest ways.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.route_matching import Between, EdgeGraph, EdgeNodes, distances
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.ingest.edge_candidates import SPACING, STOOD_SPEED, EdgeTracks
from trainlog.ingest.placing import DRIFT, NEAR
from trainlog.ingest.recording import NO_TIME, Table
from trainlog.ingest.route_matching import DECIDES, LEAST_NODES, Search, Way
from trainlog.ingest.rules import POSITION
from trainlog.railway.line import Line
from trainlog.railway.network import Network
from trainlog.units import NANOSECONDS

KILOMETRE_STD = 50.0
"""Standard deviation [m] of kilometres that a recorder writes."""

BEYOND = 150.0
"""Kilometres so far [m] beyond the ends of an edge are still on it."""

LEAST_KNOWN = 0.7
"""Share of the kilometres that the network must have."""

SKIPPED, MOST_SKIPPED = 8.0, 0.25
"""What it costs, in units of log-likelihood, to take a stop for one outside stations, and the share
of stops that may be."""

RANKS = 6
"""Sequences of stations that are kept at each stop."""

LEAST_STOPS = 3
"""Fewer stops, both ends included, show no route."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A route by its courses, and what shows it.

    Attributes
    ----------
    courses : tuple of int
    start, end : float [m]
        On the first and the last edge.
    margin : float
        By how much it is better than the second-best.
    other : tuple of int
        The second-best.
    words : str
        What was matched.
    position : (n,) array or None [m]
        Of every row from the beginning of the first edge, in the direction of travel.
    """

    courses: tuple[int, ...]
    start: float
    end: float
    margin: float
    other: tuple[int, ...]
    words: str
    position: FloatArray | None = None


class _KilometreSearch(Search):
    """The best way through kilometres: nothing but the chain itself decides."""

    def compared(self, best: Way, rival: Way) -> float:
        return best.chain.worth - rival.chain.worth


def by_kilometres(
    network: Network, graph: EdgeGraph, table: Table, words: NDArray[np.object_]
) -> Placed:
    """The route of positions that are kilometres of numbered lines.

    Parameters
    ----------
    network : Network
    graph : EdgeGraph
        Of its edges.
    table : Table
        As read: ``/train/state.position`` is the kilometre [m].
    words : (n,) object array
        Number or name of the line at each row; where it is empty, that of the row before.

    Raises
    ------
    InputError
        If the network has no such lines or kilometres, or several ways have them.
    """
    kilometre = table.signals[POSITION]
    words = _filled(words)
    known = np.isfinite(kilometre) & (words != "")
    lines = _edges_called(network)
    lost = sorted({str(word) for word in words[known]} - set(lines))
    if not known.any() or len(lost) == len(set(words[known])):
        raise InputError(
            f"network '{network.name}' has no line {', '.join(repr(word) for word in lost[:3])}",
            remedy="its lines are known by the names of their edges, or as the operator calls them",
        )
    chosen = _spaced(kilometre, words, known)
    nodes = _nodes(network, lines, table, chosen, kilometre, words)
    reached = np.diff(nodes.first) > 0
    if reached.sum() < max(LEAST_NODES, LEAST_KNOWN * chosen.size):
        at = chosen[np.flatnonzero(~reached)[:1]]
        where = (
            f", such as {kilometre[at[0]] / 1e3:.3f} of line '{words[at[0]]}'" if at.size else ""
        )
        raise InputError(
            f"network '{network.name}' has only {int(reached.sum())} of {chosen.size} kilometres"
            f" that were looked at{''.join(where)}",
            remedy="are the kilometres of the network's lines (reference) those of the recorder?",
        )
    bare = EdgeTracks(graph, tuple(None for _ in network.edges), (0.0, 0.0))
    search = _KilometreSearch(bare, nodes, distances(graph, np.unique(nodes.edge)))
    best, margin, other = search.best()
    if len(best.parts) > 1:
        raise InputError(
            "its kilometres turn back, or leave the network",
            remedy="cut the file where the train turned back: these are two trips",
        )
    if best.chain.node.size < LEAST_KNOWN * reached.sum():
        raise InputError(
            f"only {best.chain.node.size} of {int(reached.sum())} kilometres follow a route that"
            " the turns of the network allow",
            remedy="are the numbers of the lines and the network right?",
        )
    passage = search.passage_of(best, margin, other)
    first = best.legs(graph.lengths)[0][0].begun
    position = _positions(network, best, chosen, kilometre, words) - first
    count = best.chain.node.size
    shown = f"kilometres of {len(set(words[known]))} line(s), {count} of {chosen.size} looked at"
    return Placed(
        passage.courses, passage.start, passage.end, passage.margin, passage.other, shown, position
    )


def _filled(words: NDArray[np.object_]) -> NDArray[np.object_]:
    """Words without blanks around them; where there is none, the one before."""
    plain = np.array([str(word).strip() for word in words], dtype=np.object_)
    last = np.maximum.accumulate(np.where(plain != "", np.arange(plain.size), -1))
    return np.asarray(np.where(last >= 0, plain[np.maximum(last, 0)], ""), dtype=np.object_)


def _edges_called(network: Network) -> dict[str, list[int]]:
    """Edges by the name of their line, and as the operator calls it."""
    found: dict[str, list[int]] = {}
    for number, edge in enumerate(network.edges):
        reference = edge.line.reference
        names = {edge.name} | ({reference.name} if reference is not None else set())
        for name in names:
            found.setdefault(name, []).append(number)
    return found


def _spaced(kilometre: FloatArray, words: NDArray[np.object_], known: BoolArray) -> IntArray:
    """Rows at which the line or the place is another than before."""
    rows = np.flatnonzero(known)
    stretch = np.floor(kilometre[rows] / SPACING)
    changes = (np.diff(stretch) != 0) | (words[rows][1:] != words[rows][:-1])
    return rows[np.concatenate(([True], changes))]


def _chainages(line: Line, kilometre: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Chainage of kilometres on each piece of a line, and how far beyond its ends they are [m]."""
    known = line.reference
    if known is None:
        inside = np.clip(kilometre, 0.0, line.length)
        return [(inside, np.abs(kilometre - inside))]
    ends = np.append(known.positions[1:], line.length)
    found = []
    for first, last, start, end in zip(known.positions, ends, known.start, known.end, strict=True):
        inside = np.clip(kilometre, min(start, end), max(start, end))
        share = (inside - start) / (end - start) if end != start else np.zeros(inside.shape)
        found.append((first + share * (last - first), np.abs(kilometre - inside)))
    return found


def _nodes(
    network: Network,
    lines: dict[str, list[int]],
    table: Table,
    chosen: IntArray,
    kilometre: FloatArray,
    words: NDArray[np.object_],
) -> EdgeNodes:
    """The rows that are looked at, with the places on edges that they may mean."""
    rows: list[tuple[IntArray, IntArray, FloatArray, FloatArray]] = []
    for word in sorted(set(words[chosen])):
        mine = np.flatnonzero(words[chosen] == word)
        for number in lines.get(word, []):
            line = network.edges[number].line
            for chainage, beyond in _chainages(line, kilometre[chosen[mine]]):
                near = beyond <= BEYOND
                edge = np.full(int(near.sum()), number, dtype=np.int64)
                rows.append((mine[near], edge, chainage[near], beyond[near]))
    owner = np.concatenate([each[0] for each in rows])
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=chosen.size)
    seconds, driven, variance, stood = _driven(table, chosen, kilometre, words)
    nothing = np.zeros(chosen.size)
    return EdgeNodes(
        seconds=seconds,
        east=nothing,
        north=nothing,
        std=np.full(chosen.size, KILOMETRE_STD),
        driven=driven,
        driven_variance=variance,
        stood=stood,
        first=np.concatenate(([0], np.cumsum(counts))),
        edge=np.concatenate([each[1] for each in rows])[order],
        chainage=np.concatenate([each[2] for each in rows])[order],
        distance=np.concatenate([each[3] for each in rows])[order],
    )


def _driven(
    table: Table, chosen: IntArray, kilometre: FloatArray, words: NDArray[np.object_]
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Time [s], distance driven [m], its variance [m²], and whether the train stood."""
    time = table.time[chosen]
    seconds = np.arange(chosen.size, dtype=np.float64)
    if (time != NO_TIME).all() and (np.diff(time) >= 0).all():
        seconds = (time - time[0]) / NANOSECONDS
    same = words[chosen][1:] == words[chosen][:-1]
    steps = np.where(same, np.abs(np.diff(kilometre[chosen])), SPACING)
    unsure = np.where(same, 0.01 * steps, 4.0 * KILOMETRE_STD) ** 2
    driven = np.concatenate(([0.0], np.cumsum(steps)))
    variance = np.concatenate(([0.0], np.cumsum(unsure)))
    speed = table.signals.get("/train/state.speed")
    stood = np.zeros(chosen.size, dtype=np.bool_)
    if speed is not None:
        still = np.cumsum(np.abs(speed) < STOOD_SPEED)
        stood[1:] = np.diff(still[chosen]) > 0
    return seconds, driven, variance, stood


def _positions(
    network: Network, way: Way, chosen: IntArray, kilometre: FloatArray, words: NDArray[np.object_]
) -> FloatArray:
    """Position of every row along the first part of a way [m]; NaN where it is not on it."""
    part = way.parts[0]
    rows = np.arange(kilometre.size)
    course = np.interp(rows, chosen[part.node], part.position)
    position = np.full(kilometre.size, np.nan)
    best = np.full(kilometre.size, 10.0 * BEYOND)
    begun = 0.0
    for number in part.courses:
        edge = network.edges[number // 2]
        names = {edge.name} | ({edge.line.reference.name} if edge.line.reference else set())
        mine = np.isin(words.astype(str), sorted(names)) & np.isfinite(kilometre)
        for chainage, beyond in _chainages(edge.line, np.where(mine, kilometre, 0.0)):
            along = begun + (edge.line.length - chainage if number % 2 else chainage)
            off = np.where(mine & (beyond <= BEYOND), np.abs(along - course), np.inf)
            closer = off < best
            position[closer], best[closer] = along[closer], off[closer]
        begun += edge.line.length
    return position


@dataclass(frozen=True, eq=False)
class _Stations:
    """Stations on courses: where a train may stop, travelling in a direction; (m,) arrays."""

    course: IntArray
    along: FloatArray
    length: FloatArray
    name: list[str]


def by_stops(network: Network, graph: EdgeGraph, stops: FloatArray) -> Placed:
    """The route whose stations lie as far apart as the stops of a trip [m].

    Raises
    ------
    InputError
        If there is none, or more than one.
    """
    if stops.size < LEAST_STOPS:
        raise InputError(
            f"{stops.size} stops show no route in network '{network.name}'",
            remedy="state its stations (--stations A,B)",
        )
    stations = _stations(network)
    between = distances(graph, np.arange(graph.lengths.size))
    found = _sequences(stations, between, stops)
    if not found:
        raise InputError(
            f"no stations of network '{network.name}' lie as far apart as its {stops.size} stops",
            remedy="state its stations (--stations A,B), or check the unit of the position",
        )
    routes = [(cost, _courses(stations, between, states), states) for cost, states in found]
    cost, courses, states = routes[0]
    rivals = [each for each in routes[1:] if each[1] != courses]
    margin = rivals[0][0] - cost if rivals else np.inf
    first, last = states[0], states[-1]
    ends = [
        float(stations.length[at] - stations.along[at])
        if stations.course[at] % 2
        else float(stations.along[at])
        for at in (first, last)
    ]
    words = f"{len(states)} of {stops.size} stops lie as far apart as its stations"
    other = rivals[0][1] if rivals else ()
    return Placed(courses, ends[0], ends[1], float(margin), other, words)


def _stations(network: Network) -> _Stations:
    """Every station of every edge, in both directions; nodes that are stations, too."""
    rows: list[tuple[int, float, float, str]] = []
    for number, edge in enumerate(network.edges):
        length = edge.line.length
        places = {round(each.position, 3): each.name for each in edge.line.stations}
        for at, name in ((0.0, edge.start), (length, edge.end)):
            near = [each for each in places if abs(each - at) <= 1.0]
            for each in near:
                del places[each]
            if network.node(name).kind == "station":
                places[at] = name
        for at, name in places.items():
            rows.append((2 * number, at, length, name))
            rows.append((2 * number + 1, length - at, length, name))
    course, along, length_of, names = zip(*rows, strict=True)
    return _Stations(np.array(course), np.array(along), np.array(length_of), list(names))


def _sequences(
    stations: _Stations, between: Between, stops: FloatArray
) -> list[tuple[float, list[int]]]:
    """The sequences of stations that fit best, the best first, with what they cost."""
    departs = np.flatnonzero(stations.along < stations.length - 1.0)
    arrives = np.flatnonzero(stations.along > 1.0)
    most = int(MOST_SKIPPED * stops.size)
    # Of each stop: the station of each sequence kept, its cost, and the sequence before.
    layers: list[tuple[IntArray, FloatArray, list[tuple[int, int]]]] = [
        (departs, np.zeros(departs.size), [(-1, -1)] * departs.size)
    ]
    for number in range(1, stops.size):
        costs, backs = list[FloatArray](), list[tuple[int, IntArray]]()
        for before in range(max(0, number - 1 - most), number):
            states, cost, _ = layers[before]
            if not states.size:
                continue
            gap = stops[number] - stops[before]
            off = np.abs(_apart(stations, between, states, arrives) - gap)
            near = off <= 2.0 * NEAR + DRIFT * gap
            penalty = np.where(near, 0.5 * (off / _std(gap)) ** 2, np.inf)
            costs.append(cost[:, None] + penalty + SKIPPED * (number - 1 - before))
            backs.append((before, np.arange(states.size)))
        layers.append(_kept(costs, backs, arrives))
    states, cost, _ = layers[-1]
    order = np.argsort(cost, kind="stable")[: 4 * RANKS]
    return [(float(cost[at]), _traced(layers, int(at))) for at in order]


def _kept(
    costs: list[FloatArray], backs: list[tuple[int, IntArray]], arrives: IntArray
) -> tuple[IntArray, FloatArray, list[tuple[int, int]]]:
    """The best sequences to each station."""
    if not costs:
        return np.zeros(0, dtype=np.int64), np.zeros(0), []
    every = np.concatenate(costs)
    origin = [(layer, int(row)) for layer, rows in backs for row in rows]
    best = np.argsort(every, axis=0, kind="stable")[:RANKS]
    rank, column = np.nonzero(np.isfinite(np.take_along_axis(every, best, axis=0)))
    source = best[rank, column]
    return arrives[column], every[source, column], [origin[each] for each in source]


def _traced(layers: list[tuple[IntArray, FloatArray, list[tuple[int, int]]]], at: int) -> list[int]:
    found, layer = list[int](), len(layers) - 1
    while layer >= 0:
        states, _, backs = layers[layer]
        found.append(int(states[at]))
        layer, at = backs[at]
    return found[::-1]


def _std(gap: float) -> float:
    """Standard deviation [m] of a distance between two stops."""
    return float(0.5 * NEAR + 0.5 * DRIFT * gap)


def _apart(
    stations: _Stations, between: Between, states: IntArray, arrives: IntArray
) -> FloatArray:
    """Distances [m] from stations to stations, the shortest way on."""
    course, along = stations.course[states], stations.along[states]
    to, at = stations.course[arrives], stations.along[arrives]
    rest = stations.length[states] - along
    found = rest[:, None] + between.distance[between.row[course]][:, to] + at[None, :]
    ahead = at[None, :] - along[:, None]
    direct = (course[:, None] == to[None, :]) & (ahead > 1.0)
    return np.asarray(np.where(direct, ahead, found))


def _courses(stations: _Stations, between: Between, states: list[int]) -> tuple[int, ...]:
    """The courses that a sequence of stations leads over."""
    found = [int(stations.course[states[0]])]
    along = float(stations.along[states[0]])
    for state in states[1:]:
        course, at = int(stations.course[state]), float(stations.along[state])
        if course != found[-1] or at <= along + 1.0:
            found += [*between.path(found[-1], course), course]
        along = at
    return tuple(found)


def check_determined(placed: Placed, words: str, other: str) -> None:
    """Refuse a route that is hardly better than another.

    Raises
    ------
    InputError
    """
    if placed.margin < DECIDES:
        raise InputError(
            f"they do not determine the route ({placed.words}): over {words} is by a"
            f" log-likelihood of {placed.margin:.1f} better than over {other}, {DECIDES:g} is"
            " needed",
            remedy="state its stations (--stations A,B)",
        )

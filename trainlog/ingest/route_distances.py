"""Routes of recordings without fixes: by kilometres of numbered lines, by distances between stops.

Recorders write the number of a line and its kilometre, which jumps where the train passes to
another line: the places on the edges that this means are a chain as fixes are
(`trainlog.ingest.matching`). Without numbers the distances between the stops of a trip are
compared with those between stations, by the same chain: each stop may be at any station.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.matching import EdgeGraph, EdgeNodes
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.ingest.clock import MAX_DROPPED
from trainlog.ingest.matching import (
    SPACING,
    WIDEST,
    EdgeTracks,
    Passage,
    Search,
    Way,
)
from trainlog.ingest.motion import LIKELY, MOVING, POSITION, SEVERAL
from trainlog.ingest.placing import DRIFT, NEAR
from trainlog.ingest.recording import NO_TIME, Table
from trainlog.railway.line import Line
from trainlog.railway.network import Network
from trainlog.units import NANOSECONDS

KILOMETRE_STD = 50.0
"""Standard deviation [m] of kilometres that a recorder writes."""

SKIPPED = 8.0
"""What it costs, in units of log-likelihood, to take a stop for one outside stations."""

USUAL_PACE = 10.0
"""Speed [m/s] that stands for the times of stops, of which only the order counts."""

LEAST_STOPS = 3
"""Fewer stops, both ends included, show no route."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A route, and what shows it.

    Attributes
    ----------
    passage : Passage
    words : str
        What was matched.
    position : (n,) array or None [m]
        Of every row from the beginning of the first edge, in the direction of travel.
    """

    passage: Passage
    words: str
    position: FloatArray | None = None


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
    if reached.sum() < max(SEVERAL, (1.0 - MAX_DROPPED) * chosen.size):
        at = chosen[np.flatnonzero(~reached)[:1]]
        where = (
            f", such as {kilometre[at[0]] / 1e3:.3f} of line '{words[at[0]]}'" if at.size else ""
        )
        raise InputError(
            f"network '{network.name}' has only {int(reached.sum())} of {chosen.size} kilometres"
            f" that were looked at{''.join(where)}",
            remedy="are the kilometres of the network's lines (reference) those of the recorder?",
        )
    search = Search(_bare(graph), nodes, {})
    best, margin, other = search.best()
    if len(best.parts) > 1:
        raise InputError(
            "its kilometres turn back, or leave the network",
            remedy="cut the file where the train turned back: these are two trips",
        )
    if best.chain.node.size < (1.0 - MAX_DROPPED) * reached.sum():
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
    return Placed(passage, shown, position)


def _bare(graph: EdgeGraph) -> EdgeTracks:
    """Edges without a course."""
    return EdgeTracks(graph, (None,) * graph.lengths.size, (0.0, 0.0))


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
                near = beyond <= WIDEST
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
        still = np.cumsum(np.abs(speed) < MOVING)
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
    best = np.full(kilometre.size, 10.0 * WIDEST)
    begun = 0.0
    for number in part.courses:
        edge = network.edges[number // 2]
        names = {edge.name} | ({edge.line.reference.name} if edge.line.reference else set())
        mine = np.isin(words.astype(str), sorted(names)) & np.isfinite(kilometre)
        for chainage, beyond in _chainages(edge.line, np.where(mine, kilometre, 0.0)):
            along = begun + (edge.line.length - chainage if number % 2 else chainage)
            off = np.where(mine & (beyond <= WIDEST), np.abs(along - course), np.inf)
            closer = off < best
            position[closer], best[closer] = along[closer], off[closer]
        begun += edge.line.length
    return position


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
    edges, chainages = _stations(network)
    none = np.zeros(stops.size)
    nodes = EdgeNodes(
        seconds=stops / USUAL_PACE,
        east=none,
        north=none,
        # Distances between two stops err by half of `NEAR`, and of `DRIFT` of them.
        std=np.full(stops.size, 0.5 * NEAR / np.sqrt(2.0)),
        driven=stops,
        driven_variance=(0.5 * DRIFT * stops) ** 2,
        stood=none > 0.0,
        first=edges.size * np.arange(stops.size + 1),
        edge=np.tile(edges, stops.size),
        chainage=np.tile(chainages, stops.size),
        distance=np.zeros(edges.size * stops.size),
    )
    search = Search(_bare(graph), nodes, {"absence": np.inf, "reward": SKIPPED})
    best, margin, other = search.best()
    node, gap = best.chain.node, np.diff(stops[best.chain.node])
    ends = node.size > 1 and node[0] == 0 and node[-1] == stops.size - 1
    off = np.abs(np.diff(best.position) - gap)
    few = node.size < stops.size - int(MAX_DROPPED * stops.size)
    if not ends or few or np.any(off > 2.0 * NEAR + DRIFT * gap):
        raise InputError(
            f"no stations of network '{network.name}' lie as far apart as its {stops.size} stops",
            remedy="state its stations (--stations A,B), or check the unit of the position",
        )
    words = f"{node.size} of {stops.size} stops lie as far apart as its stations"
    return Placed(search.passage_of(best, margin, other), words)


def _stations(network: Network) -> tuple[IntArray, FloatArray]:
    """Edge and chainage [m] of every station of every edge; nodes that are stations, too."""
    rows: list[tuple[int, float]] = []
    for number, edge in enumerate(network.edges):
        ends = [(0.0, edge.start), (edge.line.length, edge.end)]
        places = {round(station.position, 3) for station in edge.line.stations}
        places = {at for at in places if all(abs(at - end) > 1.0 for end, _ in ends)}
        places |= {at for at, name in ends if network.node(name).kind == "station"}
        rows += [(number, at) for at in sorted(places)]
    edges, chainages = zip(*rows, strict=True) if rows else ((), ())
    return np.array(edges, dtype=np.int64), np.array(chainages, dtype=np.float64)


def check_determined(placed: Placed, words: str, other: str) -> None:
    """Refuse a route that is hardly better than another.

    Raises
    ------
    InputError
    """
    margin = placed.passage.margin
    if not placed.passage.determined:
        raise InputError(
            f"they do not determine the route ({placed.words}): over {words} is by a"
            f" log-likelihood of {margin:.1f} better than over {other}, {LIKELY:g} is"
            " needed",
            remedy="state its stations (--stations A,B)",
        )

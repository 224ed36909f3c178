"""Tracks and how they connect, as infrastructure files describe them, made into a network.

A file's tracks are lines; its switches, links and crossings are movements between their ends.
Tracks that follow each other without a choice become one edge.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, combinations
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from trainlog.formats.track_data import ASSUMED_SECTION, SAME_PLACE, Account, LimitChoice, TrackData
from trainlog.railway import Line, Station
from trainlog.railway.composition import composed
from trainlog.railway.network import AT_END, Edge, Network, Node, NodeKind


class TrackEnd(NamedTuple):
    """The beginning of a track, or its end.

    Examples
    --------
    >>> TrackEnd("T1", at_end=True).other
    TrackEnd(track='T1', at_end=False)
    """

    track: str
    at_end: bool

    @property
    def other(self) -> TrackEnd:
        """The other end of the track."""
        return TrackEnd(self.track, not self.at_end)


@dataclass
class TrackGraph:
    """Tracks as lines, and the movements between their ends.

    Attributes
    ----------
    name, source : str
    tracks : dict of str to Line
    movements : list of (TrackEnd, TrackEnd)
        Each in both directions.
    labels : dict of TrackEnd to str
        What stands there: a switch, a buffer stop.
    stations : set of str
        Nodes that are stations.
    corners : dict of TrackEnd to (latitude, longitude)
    account : Account
    """

    name: str
    source: str
    tracks: dict[str, Line] = field(default_factory=dict)
    movements: list[tuple[TrackEnd, TrackEnd]] = field(default_factory=list)
    labels: dict[TrackEnd, str] = field(default_factory=dict)
    stations: set[str] = field(default_factory=set)
    corners: dict[TrackEnd, tuple[float, float]] = field(default_factory=dict)
    account: Account = field(default_factory=Account)

    def add(
        self,
        track: TrackData,
        limits: LimitChoice,
        sections: dict[str, tuple[float, float]] | None = None,
    ) -> None:
        """Add a track, or the sections [m] that switches cut it into.

        Sections without a length are not: what they would join is.
        """
        line = None if track.length <= SAME_PLACE else track.line(self.account, limits)
        for name, (start, end) in (sections or {track.name: (0.0, track.length)}).items():
            if line is None or end - start <= SAME_PLACE:
                self._pass_through(name)
                continue
            whole = start == 0.0 and end == track.length
            part = replace(line if whole else line.section(start, end), name=name)
            if all(each.cross_section != ASSUMED_SECTION for each in part.tunnels):
                assumed = tuple(each for each in part.assumed if each != "tunnel_cross_sections")
                part = replace(part, assumed=assumed)
            self.tracks[name] = part
            if part.geometry is not None:
                for at_end, index in ((False, 0), (True, -1)):
                    place = float(part.geometry.positions[index])
                    if abs(place - (part.length if at_end else 0.0)) <= AT_END:
                        self.corners.setdefault(
                            TrackEnd(name, at_end),
                            (
                                float(part.geometry.latitudes[index]),
                                float(part.geometry.longitudes[index]),
                            ),
                        )

    def label(self, track: str, length: float, position: float, label: str) -> None:
        """Name the end of a track that lies at a position [m], unless it has a name already."""
        for at_end, place in ((False, 0.0), (True, length)):
            if abs(position - place) <= 1.0:
                self.labels.setdefault(TrackEnd(track, at_end), label)

    def _pass_through(self, name: str) -> None:
        """Leave a track out, its movements passing on to what it joins."""
        ends = TrackEnd(name, at_end=False), TrackEnd(name, at_end=True)
        beside = [
            {b if a == end else a for a, b in self.movements if end in (a, b)} for end in ends
        ]
        self.movements = [pair for pair in self.movements if not set(pair) & set(ends)]
        self.movements += [(a, b) for a in beside[0] for b in beside[1]]
        for end in ends:
            label = self.labels.pop(end, None)
            for other in beside[0] | beside[1] if label else ():
                self.labels.setdefault(other, str(label))

    def networks(self) -> list[Network]:
        """The networks that the tracks make, the longest first: one where all are connected.

        An edge is a run of tracks without a choice, a node stands where there is one.
        """
        near = self._neighbours()
        through = {
            end: next(iter(others))
            for end, others in near.items()
            if len(others) == 1 and near[next(iter(others))] == {end}
        }
        chains = list(self._chains(through))
        edges, at = list[Edge](), dict[TrackEnd, str]()
        for chain in chains:
            first, last = chain[0], chain[-1].other
            line = self._edge_line(chain)
            edges.append(Edge(line.name, line, str(first), str(last)))
            at[first] = at[last] = line.name
        groups = self._groups(near, at)
        node_of = self._names(groups)
        ends = {str(end): name for end, name in node_of.items()}
        edges = [replace(each, start=ends[each.start], end=ends[each.end]) for each in edges]
        turns: dict[str, set[tuple[str, str]]] = {}
        for end, name in node_of.items():
            pairs = {tuple(sorted((at[end], at[other]))) for other in near[end] if other in at}
            turns.setdefault(name, set()).update(pairs)  # type: ignore[arg-type]
        return list(self._parts(*_without_loops(edges, turns), node_of))

    def _neighbours(self) -> dict[TrackEnd, set[TrackEnd]]:
        """The ends that a train can go on to from each end."""
        near: dict[TrackEnd, set[TrackEnd]] = {
            TrackEnd(name, at_end): set() for name in self.tracks for at_end in (False, True)
        }
        for first, second in self.movements:
            near[first].add(second)
            near[second].add(first)
        return near

    def _chains(self, through: dict[TrackEnd, TrackEnd]) -> Iterator[list[TrackEnd]]:
        """Runs of tracks, each by the ends at which a train enters them."""
        left = dict.fromkeys(self.tracks)
        while left:
            start = TrackEnd(next(iter(left)), at_end=False)
            entry, seen = start, {start.track}
            while (before := through.get(entry)) is not None and before.track not in seen:
                entry = before.other
                seen.add(entry.track)
            chain, seen = [entry], {entry.track}
            while (after := through.get(chain[-1].other)) is not None and after.track not in seen:
                chain.append(after)
                seen.add(after.track)
            if sum(end.at_end for end in chain) * 2 > len(chain):
                chain = [end.other for end in reversed(chain)]
            for end in chain:
                del left[end.track]
            yield chain

    def _groups(
        self, near: dict[TrackEnd, set[TrackEnd]], at: dict[TrackEnd, str]
    ) -> list[list[TrackEnd]]:
        """Ends of edges that meet, the ends of tracks inside edges left out."""
        groups, seen = list[list[TrackEnd]](), set[TrackEnd]()
        for end in at:
            if end in seen:
                continue
            group, todo = [end], [end]
            seen.add(end)
            while todo:
                for other in sorted(near[todo.pop()]):
                    if other in at and other not in seen:
                        seen.add(other)
                        group.append(other)
                        todo.append(other)
            groups.append(sorted(group))
        return groups

    def _names(self, groups: list[list[TrackEnd]]) -> dict[TrackEnd, str]:
        """The name of the node at each end of an edge, each name once.

        A station that stands there, a switch or a buffer stop, or the track that ends there.
        """
        node_of, taken = dict[TrackEnd, str](), set[str]()
        for group in groups:
            there = {_station_at(end, self.tracks) for end in group}
            name = there.pop() if len(there) == 1 else ""
            if not name or name in taken:
                known = [self.labels[each] for each in group if each in self.labels]
                own = f"{group[0].track} {'end' if group[0].at_end else 'begin'}"
                name = _unused(" + ".join(dict.fromkeys(known)) or own, taken)
            else:
                taken.add(name)
                self.stations.add(name)
            node_of |= dict.fromkeys(group, name)
        return node_of

    def _parts(
        self,
        edges: list[Edge],
        turns: dict[str, set[tuple[str, str]]],
        node_of: dict[TrackEnd, str],
    ) -> Iterator[Network]:
        """A network of each part that is connected."""
        index: dict[str, int] = {}
        for edge in edges:
            for name in (edge.start, edge.end):
                index.setdefault(name, len(index))
        pairs = np.array([(index[edge.start], index[edge.end]) for edge in edges])
        joined_by = coo_array((np.ones(len(edges)), pairs.T), shape=(len(index), len(index)))
        count, part = connected_components(joined_by, directed=False)
        own: list[list[Edge]] = [[] for _ in range(count)]
        for edge, number in zip(edges, part[pairs[:, 0]], strict=True):
            own[number].append(edge)
        own.sort(key=lambda found: -sum(edge.line.length for edge in found))
        places: dict[str, list[tuple[float, float]]] = {}
        for end, name in node_of.items():
            if end in self.corners:
                places.setdefault(name, []).append(self.corners[end])
        for number, found in enumerate(own, start=1):
            names = dict.fromkeys(name for edge in found for name in (edge.start, edge.end))
            yield Network(
                name=self.name if len(own) == 1 else f"{self.name} {number}",
                nodes=tuple(self._node(name, places.get(name, [])) for name in names),
                edges=tuple(found),
                turns=_restrictions(found, turns, names),
                source=self.source,
            )

    def _node(self, name: str, places: list[tuple[float, float]]) -> Node:
        """The node, in the middle of where its edges end."""
        kind: NodeKind = "station" if name in self.stations else "junction"
        if not places:
            return Node(name, kind)
        latitude, longitude = np.mean(places, axis=0).round(9).tolist()
        return Node(name, kind, latitude, longitude)

    def _edge_line(self, chain: Sequence[TrackEnd]) -> Line:
        lines = [
            self.tracks[end.track].reversed() if end.at_end else self.tracks[end.track]
            for end in chain
        ]
        return joined(lines, joined_name([end.track for end in chain]), self.source)


def joined_name(names: Sequence[str]) -> str:
    """The name of an edge of several tracks.

    Examples
    --------
    >>> joined_name(["T1"]), joined_name(["T1", "T2"]), joined_name(["T1", "T2", "T3"])
    ('T1', 'T1+T2', 'T1..T3')
    """
    return "+".join(names) if len(names) < 3 else f"{names[0]}..{names[-1]}"


def joined(lines: Sequence[Line], name: str, source: str) -> Line:
    """Lines that follow each other, in this order, as one.

    Examples
    --------
    >>> from trainlog.formats.line import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> both = joined([line.section(0.0, 4e3), line.section(4e3, line.length)], "again", "")
    >>> both.length, bool(both.gradient(20e3) == line.gradient(20e3))
    (29556.1, True)
    """
    if len(lines) == 1:
        return replace(lines[0], name=name, source=source)
    begins = accumulate((line.length for line in lines), initial=0.0)
    placed = list(zip(begins, lines, strict=False))
    stations = [
        Station(each.name, begin + each.position)
        for begin, line in placed
        for each in line.stations
    ]
    once = [
        each
        for number, each in enumerate(stations)
        if not number
        or (each.name, round(each.position, 3))
        != (stations[number - 1].name, round(stations[number - 1].position, 3))
    ]
    return replace(composed(name, placed, once), source=source)


def _station_at(end: TrackEnd, tracks: dict[str, Line]) -> str:
    """The station that stands at an end of an edge; empty without."""
    track = tracks[end.track]
    for station in track.stations:
        if abs(station.position - (track.length if end.at_end else 0.0)) <= AT_END:
            return station.name
    return ""


def _without_loops(
    edges: list[Edge], turns: dict[str, set[tuple[str, str]]]
) -> tuple[list[Edge], dict[str, set[tuple[str, str]]]]:
    """Edges that begin and end at one node as two, so that turns name one of their ends."""
    found = list[Edge]()
    for edge in edges:
        if edge.start != edge.end:
            found.append(edge)
            continue
        half, middle = 0.5 * edge.line.length, f"{edge.name} middle"
        found.append(Edge(f"{edge.name}/1", edge.line.section(0.0, half), edge.start, middle))
        found.append(
            Edge(f"{edge.name}/2", edge.line.section(half, edge.line.length), middle, edge.end)
        )
        own = turns[edge.start]
        for pair in [pair for pair in own if edge.name in pair]:
            own.remove(pair)
            halves = [
                [each] if each != edge.name else [f"{edge.name}/1", f"{edge.name}/2"]
                for each in pair
            ]
            own.update((a, b) for a in halves[0] for b in halves[1] if a != b)
    return found, turns


def _restrictions(
    edges: list[Edge], turns: dict[str, set[tuple[str, str]]], names: Iterable[str]
) -> dict[str, tuple[tuple[str, str], ...]]:
    """The turns of the nodes that do not allow every movement."""
    found = {}
    ending: dict[str, set[str]] = {}
    for edge in edges:
        ending.setdefault(edge.start, set()).add(edge.name)
        ending.setdefault(edge.end, set()).add(edge.name)
    for name in names:
        there = sorted(ending[name])
        if name in turns and set(combinations(there, 2)) - turns[name]:
            found[name] = tuple(sorted(turns[name]))
    return found


def _unused(name: str, taken: set[str]) -> str:
    """The name, with a number where it is taken."""
    found = next(
        each
        for number in range(1, len(taken) + 2)
        if (each := name if number == 1 else f"{name} ({number})") not in taken
    )
    taken.add(found)
    return found

"""A network of lines that share stations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from trainlog.errors import InputError
from trainlog.railway.geometry import to_plane
from trainlog.railway.line import Line
from trainlog.railway.line_parts import StepProfile
from trainlog.railway.network import AT_END, Edge, Network, Node

SAME_STATION = 2_000.0
"""How far apart [m] two lines may have a station of one name."""

SAME_TRACK = 0.001
"""By how much of their length two lines between the same stations may differ, to be one track."""


@dataclass(frozen=True)
class NetworkOfLines:
    """A network made of lines.

    Attributes
    ----------
    network : Network
    notes : tuple of str
        What was joined, cut or left out, in words.
    """

    network: Network
    notes: tuple[str, ...]


def network_of_lines(name: str, lines: Sequence[Line]) -> NetworkOfLines:
    """Join lines to a network at the stations that they share.

    Nodes are the ends of the lines, and stations that several of them serve; there lines are cut,
    and trains can pass from any edge to any other. Where two lines run over the same track, which
    is as long and as steep on both, it is one edge, that of the line that comes first. Where a
    later one runs the other way, its speed limits become the edge's `speed_limits_reverse`, unless
    the first states these itself, or the later one does not know its own.

    Parameters
    ----------
    name : str
    lines : sequence of Line

    Raises
    ------
    InputError
        If a station lies at two places, a line is a route itself, or the lines are not connected.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.railway import Station
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> line = replace(line, geometry=None)
    >>> branch = replace(
    ...     line.section(0.0, 5_000.0),
    ...     name="branch",
    ...     stations=(Station(line.stations[1].name, 0.0), Station("Branch", 5_000.0)),
    ... )
    >>> found = network_of_lines("both", [line, branch])
    >>> [(edge.name, edge.start, edge.end) for edge in found.network.edges][-1]
    ('branch', 'Gossau SG', 'Branch')
    """
    if not lines:
        raise InputError(f"network '{name}': there are no lines", remedy="give at least one")
    for line in lines:
        if line.legs:
            raise InputError(
                f"line '{line.name}' is a route itself", remedy="give the lines of its edges"
            )
    lines = _with_own_names(lines)
    _check_places(lines)
    shared = _shared(lines)
    edges, notes = list[Edge](), list[str]()
    for line in lines:
        parts = list(_parts(line, shared))
        if len(parts) > 1:
            notes.append(f"'{line.name}' is cut into {len(parts)} edges at stations it shares")
        for part in parts:
            same = next((each for each in edges if _same_track(each, part)), None)
            if same is None:
                edges.append(part)
                continue
            kept, note = _with_limits_of(same, part)
            edges[edges.index(same)] = kept
            notes.append(f"'{part.name}' is the track of '{same.name}', which stays{note}")
    names = dict.fromkeys(end for edge in edges for end in (edge.start, edge.end))
    nodes = tuple(_node(each, edges, shared) for each in names)
    source = "; ".join(dict.fromkeys(line.source for line in lines if line.source))
    return NetworkOfLines(Network(name, nodes, tuple(edges), source=source), tuple(notes))


def _with_own_names(lines: Sequence[Line]) -> list[Line]:
    """The lines, with a number behind a name that comes again."""
    counts, found = Counter[str](), list[Line]()
    for line in lines:
        counts[line.name] += 1
        number = counts[line.name]
        found.append(line if number == 1 else replace(line, name=f"{line.name} ({number})"))
    return found


def _check_places(lines: Sequence[Line]) -> None:
    """Refuse stations of one name that lie apart on lines with coordinates."""
    known: dict[str, tuple[str, tuple[float, float]]] = {}
    for line in lines:
        for station in line.stations:
            if line.geometry is None:
                continue
            latitude, longitude = line.geometry.at([station.position])
            here = (float(latitude[0]), float(longitude[0]))
            other, there = known.setdefault(station.name, (line.name, here))
            apart = float(np.abs(to_plane(*here, there)))
            if other != line.name and apart > SAME_STATION:
                raise InputError(
                    f"station '{station.name}' of line '{line.name}' lies {apart / 1e3:.1f} km from"
                    f" that of line '{other}'",
                    remedy="rename one of them if they are two stations",
                )


def _shared(lines: Sequence[Line]) -> set[str]:
    """Names of stations at the ends of lines, and of those that several lines serve."""
    served = Counter(name for line in lines for name in {each.name for each in line.stations})
    found = {name for name, count in served.items() if count > 1}
    for line in lines:
        for station in line.stations:
            if station.position <= AT_END or station.position >= line.length - AT_END:
                found.add(station.name)
    return found


def _parts(line: Line, shared: set[str]) -> Iterator[Edge]:
    """The line between its shared stations."""
    cuts = [(each.position, each.name) for each in line.stations if each.name in shared]
    if not cuts or cuts[0][0] > AT_END:
        cuts.insert(0, (0.0, f"{line.name} start"))
    if cuts[-1][0] < line.length - AT_END:
        cuts.append((line.length, f"{line.name} end"))
    cuts[0], cuts[-1] = (0.0, cuts[0][1]), (line.length, cuts[-1][1])
    pieces = [(start, end) for start, end in pairwise(cuts) if end[0] - start[0] > AT_END]
    taken = Counter[str]()
    for start, end in pieces:
        whole = len(pieces) == 1
        name = line.name if whole else f"{line.name} {start[1]} - {end[1]}"
        taken[name] += 1
        own = name if taken[name] == 1 else f"{name} ({taken[name]})"
        part = line if whole else line.section(start[0], end[0])
        yield Edge(own, replace(part, name=own), start[1], end[1])


def _same_track(edge: Edge, other: Edge) -> bool:
    """Whether two edges between the same nodes are as long and as steep."""
    if {edge.start, edge.end} != {other.start, other.end}:
        return False
    line, against = edge.line, other.line
    if edge.start != other.start:
        against = against.reversed()
    if abs(line.length - against.length) > SAME_TRACK * line.length:
        return False
    # In the middle of pieces of 50 m; profiles may be cut differently.
    s = np.arange(25.0, line.length, 50.0)
    apart = np.abs(line.altitudes(s) - line.altitude - (against.altitudes(s) - against.altitude))
    return bool(np.max(apart, initial=0.0) < 1.0)


def _with_limits_of(edge: Edge, other: Edge) -> tuple[Edge, str]:
    """The edge with the other direction's limits of the same track, and what is said of them."""
    line, turned = edge.line, other.line
    if edge.start == other.start:
        same = _alike(line.speed_limits, _scaled(turned.speed_limits, turned, line), line.length)
        return edge, "" if same else "; its speed limits, which differ, are not used"
    turned = turned.reversed()
    against = _scaled(turned.limits_against, turned, line)
    if "speed_limits" in turned.assumed or _alike(line.limits_against, against, line.length):
        return edge, ""
    if line.speed_limits_reverse is not None:
        return edge, " with its own speed limits of the other direction, which differ"
    kept = replace(edge, line=replace(line, speed_limits_reverse=against))
    return kept, " and takes over its speed limits for the other direction"


def _scaled(limits: StepProfile, own: Line, other: Line) -> StepProfile:
    """A line's limits by the chainage of another over the same track."""
    return StepProfile(limits.positions * (other.length / own.length), limits.values)


def _alike(limits: StepProfile, others: StepProfile, length: float) -> bool:
    """Whether limits differ nowhere over more than the lines' lengths may."""
    edges = np.unique(np.concatenate((limits.positions, others.positions, [length])))
    middle = 0.5 * (edges[:-1] + edges[1:])
    apart = ~np.isclose(limits(middle), others(middle), rtol=1e-3, atol=0.0)
    return bool(np.max(np.diff(edges)[apart], initial=0.0) <= max(1.0, SAME_TRACK * length))


def _node(name: str, edges: Sequence[Edge], stations: set[str]) -> Node:
    kind = "station" if name in stations else "junction"
    for edge in edges:
        course = edge.line.geometry
        for end, at in ((edge.start, 0.0), (edge.end, edge.line.length)):
            if course is None or end != name:
                continue
            if course.positions[0] - AT_END <= at <= course.positions[-1] + AT_END:
                latitude, longitude = course.at([at])
                return Node(name, kind, float(latitude[0]), float(longitude[0]))  # type: ignore[arg-type]
    return Node(name, kind)  # type: ignore[arg-type]

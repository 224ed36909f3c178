"""A network: stations and junctions joined by lines, and routes that run over several of them.

Each edge is a whole `Line` with a chainage of its own, from one node to another. A `Route` gives
the line as it is travelled, composed of stretches of edges: an ordinary `Line` that states in
`Line.legs` what each of them was.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np

from trainlog.declaration import Declared, Must, Quantity, Table, Text
from trainlog.display import counted, span
from trainlog.errors import InputError, similar
from trainlog.extras import require
from trainlog.presentation import (
    POSITION,
    SPEED,
    Column,
    Presented,
    Quantity as Shown,
    Said,
    WordTable,
    new_table,
)
from trainlog.railway.composition import composed
from trainlog.railway.kilometres import position_of
from trainlog.railway.line import Leg as Leg, Line, Station, route_words
from trainlog.railway.line_parts import TINY
from trainlog.units import KMH

if TYPE_CHECKING:
    from networkx import DiGraph

Part = TypeVar("Part")

NodeKind = Literal["station", "junction"]

AT_END = 1.0
"""Stations so near [m] to an end of an edge stand at its node."""


def _angle(most: float) -> Quantity:
    """A coordinate [deg] and how large it is at most."""
    beyond = Must(f"is not between -{most:g} and {most:g} deg", "give degrees", -most, most)
    return Quantity("deg", "deg", must=beyond)


@dataclass(frozen=True, slots=True)
class Node(Declared):
    """Where edges meet or end.

    Attributes
    ----------
    name : str
    kind : {"station", "junction"}
        At a station trains stop, and a route may turn back.
    latitude, longitude : float [deg] or None

    Examples
    --------
    >>> Node("Wil", latitude=47.462, longitude=9.041).kind
    'station'
    """

    name: str
    kind: NodeKind = "station"
    latitude: Annotated[float | None, _angle(90.0)] = None
    longitude: Annotated[float | None, _angle(180.0)] = None

    def problems(self) -> Iterator[InputError]:
        """Half a place on the earth."""
        if (self.latitude is None) != (self.longitude is None):
            yield InputError(
                f"node '{self.name}' lies at latitude {self.latitude} and longitude"
                f" {self.longitude}",
                remedy="give both in degrees, or none",
            )


@dataclass(frozen=True, slots=True)
class Edge:
    """A line between two nodes, with a chainage of its own from `start` to `end`.

    Attributes
    ----------
    name : str
        Also that of its line.
    line : Line
    start, end : str
        Nodes at chainage 0 and at the line's length. Both may be the same: a balloon loop.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> Edge("850", line, "St. Gallen", "Wil").line.name
    '850'
    """

    ORDER: ClassVar[tuple[str, ...]] = ("name", "start", "end")

    name: Annotated[str, Text(stated="read")]
    line: Line
    start: str
    end: str

    def __post_init__(self) -> None:
        if self.line.name != self.name:
            object.__setattr__(self, "line", replace(self.line, name=self.name))


@dataclass(frozen=True, slots=True)
class Place:
    """Where a train can be sent: a node, or a point of an edge.

    Attributes
    ----------
    node : str
        Its name; empty inside an edge.
    edge : str
    position : float [m]
        On the edge's chainage.
    station : bool
        Whether trains stop, and may turn back.
    """

    node: str = ""
    edge: str = ""
    position: float = 0.0
    station: bool = True


def climbs(line: Line) -> tuple[float, float]:
    """How far a line rises and falls altogether [m], both positive.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> rise, fall = climbs(read_line("sample_logs/CH_StGallen_Wil.line.json"))
    >>> round(rise, 1), round(fall, 1)
    (40.2, 144.5)
    """
    edges = np.append(line.gradients.positions, line.length)
    steps = line.gradients.values * np.diff(edges)
    return float(steps[steps > 0.0].sum()), float(np.abs(steps[steps < 0.0]).sum())


def _limits(line: Line) -> Said:
    """The lowest limit of both directions, shown with the highest."""
    values = np.concatenate([line.speed_limits.values, line.limits_against.values])
    low, high = float(values.min()), float(values.max())
    one = f"{low * KMH:.0f}"
    return Said(low, one if low == high else f"{one} to {high * KMH:.0f}")


def _least_radius(line: Line) -> float:
    if line.curvatures is None:
        return np.nan
    sharpest = float(max(np.abs(line.curvatures.start).max(), np.abs(line.curvatures.end).max()))
    return 1.0 / sharpest if sharpest > 0.0 else np.nan


def _names(edges: list[Edge]) -> str:
    return ", ".join(edge.name for edge in edges)


HEIGHT = Shown("m", "m")

EDGES = (
    Column("edge", of="name"),
    Column("from", of="start"),
    Column("to", of="end"),
    Column("length", POSITION, of=lambda edge: edge.line.length),
    Column("rise", HEIGHT, of=lambda edge: climbs(edge.line)[0]),
    Column("fall", HEIGHT, of=lambda edge: climbs(edge.line)[1]),
    Column("limits", SPEED, key="lowest_limit", of=lambda edge: _limits(edge.line)),
    Column(
        "radius",
        Shown("m", "m", 1.0, 0),
        key="least_radius",
        of=lambda edge: _least_radius(edge.line),
    ),
)
"""Of the table of a network's edges."""


@dataclass(frozen=True, eq=False, repr=False)
class Network(Declared):
    """Stations and junctions, joined by lines.

    Attributes
    ----------
    name : str
    nodes : tuple of Node
    edges : tuple of Edge
    turns : dict of str to tuple of (str, str)
        By node, which pairs of edges a train can pass between, in either direction. A node that
        is not named allows every movement but back over the edge that the train came by.
    source : str
        Where the data come from.

    Raises
    ------
    InputError
        If an edge leads nowhere, names come twice, or parts are not connected; all of it listed.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> network = Network(
    ...     "short",
    ...     nodes=(Node("St. Gallen"), Node("Gossau"), Node("Wil")),
    ...     edges=(
    ...         Edge("east", line.section(0.0, 10_000.0), "St. Gallen", "Gossau"),
    ...         Edge("west", line.section(10_000.0, line.length), "Gossau", "Wil"),
    ...     ),
    ... )
    >>> route = network.route("Wil", "St. Gallen")
    >>> route
    Route 'Wil - St. Gallen', 29.556 km
      edges  west (against its chainage), east (against its chainage)
    """

    charts_by: ClassVar[str] = "analysis.network.plot:network_charts"
    FORMAT: ClassVar[str] = "trainlog/network"
    VERSION: ClassVar[int] = Line.VERSION
    ORDER: ClassVar[tuple[str, ...]] = ("name", "source")

    name: Annotated[str, Text(least=1)]
    nodes: Annotated[tuple[Node, ...], Table()]
    edges: tuple[Edge, ...]
    turns: Mapping[str, tuple[tuple[str, str], ...]] = field(default_factory=dict)
    source: Annotated[str, Text(stated="written")] = ""

    @property
    def version_needed(self) -> int:
        """That of the lines which the file holds."""
        return max((each.line.version_needed for each in self.edges), default=1)

    def problems(self) -> Iterator[InputError]:
        """What no network can be, one by one."""
        where = f"network '{self.name}'"
        for kind, names in (
            ("node", [each.name for each in self.nodes]),
            ("edge", [each.name for each in self.edges]),
        ):
            for name, count in sorted(Counter(names).items()):
                if count == 1:
                    continue
                yield InputError(
                    f"{where}: {counted(count, kind)} have the name '{name}'",
                    remedy="give each a name of its own",
                )
        if not self.edges:
            yield InputError(f"{where}: has no edges", remedy="give at least one line")
            return
        known = {each.name for each in self.nodes}
        lost = list(self._edge_problems(where, known))
        yield from lost
        yield from self._turn_problems(where)
        if not lost:
            yield from self._unconnected(where)

    def _edge_problems(self, where: str, known: set[str]) -> Iterator[InputError]:
        """Edges that end nowhere, or are routes themselves."""
        for edge in self.edges:
            for end in ("start", "end"):
                name = getattr(edge, end)
                if name not in known:
                    yield InputError(
                        f"{where}: edge '{edge.name}' has the {end} '{name}', which is no node",
                        remedy=_nearest(name, known, "name one of the nodes"),
                    )
            if edge.line.legs:
                yield InputError(
                    f"{where}: edge '{edge.name}' is a route over"
                    f" {counted(len(edge.line.legs), 'edge')} itself",
                    remedy="give a line that is no route",
                )
            ends = (edge.line.stations[:1], edge.line.stations[-1:])
            named = [each[0].name if each else "" for each in ends]
            if edge.start != edge.end and named == [edge.end, edge.start]:
                yield InputError(
                    f"{where}: edge '{edge.name}' runs from '{edge.start}' to '{edge.end}', and"
                    f" the stations of its line from '{named[0]}' to '{named[1]}'",
                    remedy="exchange its start and end, or reverse the line",
                )

    def _turn_problems(self, where: str) -> Iterator[InputError]:
        """Turns between edges that do not meet."""
        known = {each.name for each in self.nodes}
        ending: dict[str, set[str]] = {}
        for edge in self.edges:
            for name in (edge.start, edge.end):
                ending.setdefault(name, set()).add(edge.name)
        for node, pairs in self.turns.items():
            if node not in known:
                yield InputError(
                    f"{where}: turns are given at '{node}', which is no node",
                    remedy=_nearest(node, known, "name one of the nodes"),
                )
                continue
            there = ending.get(node, set())
            for name in sorted({name for pair in pairs for name in pair} - there):
                yield InputError(
                    f"{where}: turns at '{node}' name the edge '{name}', which does not end there",
                    remedy=_nearest(name, there, f"its edges are {', '.join(sorted(there))}"),
                )

    def _unconnected(self, where: str) -> Iterator[InputError]:
        """Parts of the network that no edge joins to the largest."""
        part = {node.name: node.name for node in self.nodes}

        def root(name: str) -> str:
            while part[name] != name:
                part[name] = part[part[name]]
                name = part[name]
            return name

        for edge in self.edges:
            part[root(edge.start)] = root(edge.end)
        groups: dict[str, list[str]] = {}
        for node in self.nodes:
            groups.setdefault(root(node.name), []).append(node.name)
        for names in sorted(groups.values(), key=len)[:-1]:
            shown = ", ".join(f"'{name}'" for name in names[:3])
            yield InputError(
                f"{where}: {shown}{', ...' * (len(names) > 3)}"
                f" ({counted(len(names), 'node')}) {'is' if len(names) == 1 else 'are'} not"
                " connected to the rest",
                remedy="join them by an edge, or make a network of their own",
            )

    @property
    def title(self) -> str:
        """Its name and length."""
        return f"Network '{self.name}', {self.length / 1e3:.1f} km"

    def summary(self) -> dict[str, str]:
        """Stations, nodes, edges and turns."""
        stations = sum(any(each.station for each in points) for points in self.places.values())
        junctions = sum(node.kind == "junction" for node in self.nodes)
        rows = {
            "stations": f"{stations}, at nodes and within edges",
            "nodes": f"{len(self.nodes)}, {counted(junctions, 'junction')} among them",
            "edges": f"{len(self.edges)}: {', '.join(each.name for each in self.edges[:4])}"
            + ", ..." * (len(self.edges) > 4),
        }
        if self.turns:
            rows["turns"] = f"restricted at {counted(len(self.turns), 'node')}"
        return rows

    def tables(self) -> list[WordTable]:
        """Edges, stations and nodes."""
        stations = [(each, edge) for edge in self.edges for each in edge.line.stations]
        return [
            new_table(
                f"Edges of {self.name}: {len(self.edges)}, {self.length / 1e3:.3f} km",
                *EDGES,
                name="edges",
            ).add_rows(self.edges),
            new_table(
                "Stations",
                Column("station", of=lambda row: row[0].name),
                Column("edge", of=lambda row: row[1].name),
                Column("at", POSITION, of=lambda row: row[0].position),
                name="stations",
            ).add_rows(stations),
            new_table(
                "Nodes",
                Column("node", of="name"),
                Column("kind"),
                Column("edges", of=lambda node: _names(self._at(node))),
                Column("turns", of=self._turns_words),
                name="nodes",
            ).add_rows(self.nodes),
        ]

    def _at(self, node: Node) -> list[Edge]:
        return [edge for edge in self.edges if node.name in (edge.start, edge.end)]

    def _turns_words(self, node: Node) -> str:
        turns = self.turns.get(node.name)
        if turns is None:
            return "all" if len(self._at(node)) > 1 else ""
        return ", ".join(f"{a} and {b}" for a, b in turns)

    @property
    def notes(self) -> list[str]:
        """Source, what is assumed, and edges without coordinates."""
        found = [self.source] if self.source else []
        for name, edges in self.assumed.items():
            which = "all edges" if len(edges) == len(self.edges) else _names(edges)
            found.append(f"{name.replace('_', ' ')} assumed {assumed_on(edges)}: {which}")
        drawn = [edge for edge in self.edges if edge.line.geometry is None]
        return [*found, f"without coordinates: {_names(drawn)}"] if drawn else found

    @property
    def length(self) -> float:
        """Of all edges together [m]."""
        return float(sum(edge.line.length for edge in self.edges))

    @property
    def assumed(self) -> dict[str, list[Edge]]:
        """What is assumed on a part of which edges, by the names in their lines' `assumed`."""
        found: dict[str, list[Edge]] = {}
        for edge in self.edges:
            for name in edge.line.assumed:
                found.setdefault(name, []).append(edge)
        return found

    def node(self, name: str) -> Node:
        """The node of a name.

        Raises
        ------
        InputError
            If there is none.
        """
        return self._called("node", name, self._nodes)

    def edge(self, name: str) -> Edge:
        """The edge of a name.

        Raises
        ------
        InputError
            If there is none.
        """
        return self._called("edge", name, self._edges)

    def _called(self, kind: str, name: str, known: Mapping[str, Part]) -> Part:
        if name not in known:
            raise InputError(
                f"network '{self.name}' has no {kind} '{name}'",
                remedy=_nearest(name, known, f"look at its {kind}s"),
            )
        return known[name]

    @cached_property
    def _nodes(self) -> dict[str, Node]:
        return {node.name: node for node in self.nodes}

    @cached_property
    def _edges(self) -> dict[str, Edge]:
        return {edge.name: edge for edge in self.edges}

    @cached_property
    def places(self) -> Mapping[str, tuple[Place, ...]]:
        """Nodes, and stations inside edges, by name; several points where edges share it."""
        found: dict[str, list[Place]] = {
            node.name: [Place(node.name, station=node.kind == "station")] for node in self.nodes
        }
        for edge in self.edges:
            for station in edge.line.stations:
                place = self._point(edge, station.position)
                known = found.setdefault(station.name, [])
                if place.node and any(each.node == place.node for each in known):
                    continue
                known.append(replace(place, station=True))
        return {name: tuple(points) for name, points in found.items()}

    def _point(self, edge: Edge, position: float) -> Place:
        """A point of an edge, which is its node where it stands at one."""
        if position <= AT_END:
            return Place(edge.start, station=self._nodes[edge.start].kind == "station")
        if position >= edge.line.length - AT_END:
            return Place(edge.end, station=self._nodes[edge.end].kind == "station")
        return Place("", edge.name, position, station=False)

    def place(self, name: str) -> tuple[Place, ...]:
        """The points of a place: a node, a station, or ``"edge@km"``.

        Raises
        ------
        InputError
            If the network has no such place.
        """
        name = name.strip()
        if name in self.places:
            return self.places[name]
        edge, at, km = name.rpartition("@")
        if at and edge.strip() in self._edges:
            found = self._edges[edge.strip()]
            try:
                position = position_of(found.line, float(km))
            except ValueError:
                raise InputError(
                    f"'{name}': '{km}' is not a kilometre", remedy="write edge@12.5"
                ) from None
            return (self._point(found, position),)
        raise InputError(
            f"network '{self.name}' has no place '{name}'",
            remedy=_nearest(name, self.places, "name nodes, stations, or edge@km"),
        )

    def route(self, *places: str) -> Route:
        """The shortest route through places, in this order.

        Trains pass between edges as `turns` allow; they turn back only at stations that are named
        here. Needs the extra ``fleet``.

        Parameters
        ----------
        *places : str
            Nodes, stations inside edges, or points such as ``"edge@12.5"`` with the operator's
            kilometre; the same place may come several times.

        Raises
        ------
        InputError
            If a place is not known, or no route leads from one to the next.
        """
        if len(places) < 2:
            raise InputError(
                f"a route of network '{self.name}' needs two places", remedy="name start and end"
            )
        require("networkx")
        names = tuple(place.strip() for place in places)
        stages = [
            {(each.node, each.edge, each.position): each.station for each in self.place(name)}
            for name in names
        ]
        found = RouteSearch(self._edges, self.turns, stages).stretches()
        if isinstance(found, int):
            raise InputError(
                f"network '{self.name}' has no route from '{names[found]}' to '{names[found + 1]}'",
                remedy="its turns allow none; name a station on the way at which the train can"
                " turn back",
            )
        return Route(self, names, self._legs(found))

    def along(
        self,
        movements: Sequence[tuple[str, bool]],
        start: float | None = None,
        end: float | None = None,
    ) -> Route:
        """The route over given edges, in the order of travel.

        Parameters
        ----------
        movements : sequence of (str, bool)
            Names of edges, each with whether it is travelled along its chainage; an edge may come
            several times.
        start, end : float [m], optional
            Chainage on the first and on the last edge where the route begins and ends; None: at
            the edge's end.

        Raises
        ------
        InputError
            If edges do not follow each other, or an end leaves nothing of its edge.

        Examples
        --------
        >>> from trainlog.formats.railway import read_line
        >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
        >>> nodes = (Node("St. Gallen"), Node("Wil"))
        >>> network = Network("one", nodes, (Edge("850", line, "St. Gallen", "Wil"),))
        >>> network.along([("850", False)], start=20_000.0).length
        20000.0
        """
        if not movements:
            raise InputError("a route needs an edge", remedy="name the edges in order of travel")
        stretches: list[tuple[str, float, float]] = []
        for name, forward in movements:
            ends = (0.0, self.edge(name).line.length)
            stretches.append((name, *(ends if forward else ends[::-1])))
        for (before, forward), (after, onward) in pairwise(movements):
            meets, leaves = self._ends(before, forward)[1], self._ends(after, onward)[0]
            if meets != leaves:
                raise InputError(
                    f"edge '{after}' begins at '{leaves}', and '{before}' ends at '{meets}'",
                    remedy="name the edges that lie between, or exchange a direction",
                )
        first, last = stretches[0], stretches[-1]
        places = [self._ends(*movements[0])[0], self._ends(*movements[-1])[1]]
        if start is not None:
            stretches[0] = (first[0], start, first[2])
            places[0] = self._name_of(first[0], start)
        if end is not None:
            stretches[-1] = (last[0], stretches[-1][1], end)
            places[1] = self._name_of(last[0], end)
        for (name, begin, finish), (_, forward) in zip(stretches, movements, strict=True):
            if (finish > begin) is not forward:
                raise InputError(
                    f"a route from km {begin / 1e3:.3f} to km {finish / 1e3:.3f} of edge '{name}'"
                    f" does not run {'along' if forward else 'against'} its chainage",
                    remedy="exchange the direction, or correct where it begins and ends",
                )
        return Route(self, tuple(places), self._legs(stretches))

    def _legs(self, stretches: Sequence[Stretch]) -> tuple[Leg, ...]:
        """Legs, one behind the other, over edges from one chainage to another."""
        legs, position = [], 0.0
        for name, start, end in stretches:
            length = abs(end - start)
            legs.append(Leg(name, position, length, start, end, self.edge(name).line.length))
            position += length
        return tuple(legs)

    def _ends(self, name: str, forward: bool) -> tuple[str, str]:
        """Nodes at which a movement over an edge begins and ends."""
        edge = self.edge(name)
        return (edge.start, edge.end) if forward else (edge.end, edge.start)

    def _name_of(self, name: str, chainage: float) -> str:
        """A point of an edge as a place: its node, its station, or ``edge@km``."""
        edge = self.edge(name)
        node = self._point(edge, chainage).node
        near = [s.name for s in edge.line.stations if abs(s.position - chainage) <= AT_END]
        km = float(edge.line.kilometre(chainage)) / 1e3
        return node or (near[0] if near else f"{name}@{km:.3f}")


LEGS = (
    Column("edge"),
    Column("from", POSITION, key="position"),
    Column("length", POSITION),
    Column("on the edge from", POSITION, key="edge_start"),
    Column("to", POSITION, key="edge_end"),
    Column("direction", of=lambda leg: "along its chainage" if leg.forward else "against it"),
)


@dataclass(frozen=True, eq=False, repr=False)
class Route(Presented):
    """A way of a train through a network.

    Attributes
    ----------
    network : Network
    places : tuple of str
        That it was asked to run through.
    legs : tuple of Leg

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> nodes = (Node("St. Gallen"), Node("Wil"))
    >>> network = Network("one", nodes, (Edge("850", line, "St. Gallen", "Wil"),))
    >>> route = network.route("Wil", "Gossau SG")
    >>> route.name, route.length, route.legs[0].forward
    ('Wil - Gossau SG', 20270.0, False)
    """

    network: Network
    places: tuple[str, ...]
    legs: tuple[Leg, ...]

    @property
    def name(self) -> str:
        """Its places; also the name of its line."""
        return " - ".join(self.places)

    @property
    def length(self) -> float:
        """[m]."""
        return self.legs[-1].end

    @property
    def title(self) -> str:
        """Its name and length."""
        return f"Route '{self.name}', {self.length / 1e3:.3f} km"

    def summary(self) -> dict[str, str]:
        """Its edges."""
        return {"edges": route_words(self.legs)}

    def tables(self) -> list[WordTable]:
        """Legs and stations."""
        at = (Column("station", of="name"), Column("at", POSITION, of="position"))
        return [
            new_table(f"Legs of {self.name}", *LEGS, name="legs").add_rows(self.legs),
            new_table("Stations", *at, name="stations").add_rows(self.line.stations),
        ]

    @property
    def sentence(self) -> str:
        """Its length, climbs and limits."""
        line, (rise, fall) = self.line, climbs(self.line)
        return (
            f"{line.length / 1e3:.3f} km over {counted(len(self.legs), 'edge')}, rising"
            f" {rise:.1f} m and falling {fall:.1f} m, limits {span(line.speed_limits.values, KMH)}"
            " km/h"
        )

    @property
    def notes(self) -> list[str]:
        """What of its line is assumed."""
        assumed = self.line.summary().get("assumed")
        return [f"assumed on a part of it: {assumed}"] if assumed else []

    def reversed(self) -> Route:
        """The same way travelled from its end to its start."""
        turned = tuple(leg.reversed(self.length) for leg in reversed(self.legs))
        return Route(self.network, self.places[::-1], turned)

    @cached_property
    def line(self) -> Line:
        """The line as travelled.

        Composed of stretches of its edges, see `trainlog.railway.composition`.

        Raises
        ------
        InputError
            If edges state different formulas of the curve resistance.

        Examples
        --------
        >>> from trainlog.formats.railway import read_line
        >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
        >>> nodes = (Node("St. Gallen"), Node("Wil"))
        >>> network = Network("one", nodes, (Edge("only", line, "St. Gallen", "Wil"),))
        >>> back = network.route("Wil", "St. Gallen").line
        >>> back.name, bool(back.gradient(500.0) == -line.gradient(line.length - 500.0))
        ('Wil - St. Gallen', True)
        >>> back.legs[0].edge_start, back.legs[0].edge_end
        (29556.1, 0.0)
        """
        parts = [(leg.position, self.leg_line(leg)) for leg in self.legs]
        return composed(self.name, parts, self._stations(parts), self.legs)

    def leg_line(self, leg: Leg) -> Line:
        """What of an edge's line a leg runs over, in the direction of travel."""
        start, end = sorted((leg.edge_start, leg.edge_end))
        part = self.network.edge(leg.edge).line.section(start, end)
        return part if leg.forward else part.reversed()

    def _stations(self, parts: Sequence[tuple[float, Line]]) -> tuple[Station, ...]:
        """Stations of the parts and of the nodes between them, each once; and both ends."""
        found = [
            (at + station.position, station.name) for at, part in parts for station in part.stations
        ]
        for at, name, kind in self._joints():
            if kind == "station":
                found = [each for each in found if abs(each[0] - at) > AT_END]
                found.append((at, name))
        for at, name in ((0.0, self.places[0]), (self.length, self.places[-1])):
            if all(abs(each[0] - at) > AT_END for each in found):
                found.append((at, name))
        found.sort(key=lambda each: each[0])
        once = [
            each
            for before, each in pairwise([(-np.inf, ""), *found])
            if not (each[1] == before[1] and each[0] - before[0] <= AT_END)
        ]
        return tuple(Station(name, min(max(at, 0.0), self.length)) for at, name in once)

    def _joints(self) -> Iterator[tuple[float, str, NodeKind]]:
        """Position [m], name and kind of the nodes that the route passes."""
        for leg in self.legs:
            edge = self.network.edge(leg.edge)
            for at, chainage in ((leg.position, leg.edge_start), (leg.end, leg.edge_end)):
                if chainage <= TINY or chainage >= edge.line.length - TINY:
                    name = edge.start if chainage <= TINY else edge.end
                    yield at, name, self.network.node(name).kind


def assumed_on(edges: Sequence[Edge]) -> str:
    """On how much of a network something is assumed, in words.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> assumed_on([Edge("850", line, "St. Gallen", "Wil")])
    'on all or a part of 1 edge, 29.556 km long together'
    """
    length = sum(edge.line.length for edge in edges) / 1e3
    return f"on all or a part of {counted(len(edges), 'edge')}, {length:.3f} km long together"


def _nearest(name: str, known: Any, otherwise: str) -> str:
    """A remedy that names what was perhaps meant."""
    found = similar(name, known)
    return f"did you mean {' or '.join(repr(each) for each in found)}?" if found else otherwise


# ------------------------------------------------------------------ the shortest way

Stretch = tuple[str, float, float]
"""Of an edge, by its name, from one chainage [m] to another."""

Point = tuple[str, str, float]
"""A node by its name, or of an edge, by its name, a chainage [m]."""

_State = tuple[int, str, int, int]
"""Towards which place, over which edge, which piece of it, in which direction (1 or -1)."""


class RouteSearch:
    """The shortest way through places, as a graph of pieces of edges that are travelled.

    Edges are cut where places lie inside them; the graph has each piece once for each direction
    and for each place that the train is on its way to.

    Parameters
    ----------
    edges : dict of str to Edge
    turns : dict of str to sequence of (str, str)
        By node, pairs of edges between which trains pass; see `trainlog.railway.network.Network`.
    stages : sequence of dict
        Of each place in the order of travel: its points, and whether trains turn back there.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> first, second = line.section(0.0, 800.0), line.section(800.0, 1_300.0)
    >>> edges = {"a": Edge("a", first, "X", "Y"), "b": Edge("b", second, "Y", "Z")}
    >>> stages = [{("Z", "", 0.0): True}, {("", "a", 300.0): True}]
    >>> RouteSearch(edges, {}, stages).stretches()
    [('b', 500.0, 0.0), ('a', 800.0, 300.0)]
    """

    def __init__(
        self,
        edges: Mapping[str, Edge],
        turns: Mapping[str, Sequence[tuple[str, str]]],
        stages: Sequence[Mapping[Point, bool]],
    ) -> None:
        self.edges, self.turns, self.stages = edges, turns, stages
        cuts = {name: [0.0, edge.line.length] for name, edge in edges.items()}
        for _, name, position in {point for stage in stages for point in stage if not point[0]}:
            cuts[name].append(position)
        self.cuts = {name: sorted(set(found)) for name, found in cuts.items()}
        self.departures: dict[str, list[tuple[str, int, int]]] = {}
        for name, edge in edges.items():
            last = len(self.cuts[name]) - 2
            self.departures.setdefault(edge.start, []).append((name, 0, 1))
            self.departures.setdefault(edge.end, []).append((name, last, -1))

    def stretches(self) -> list[Stretch] | int:
        """Stretches of edges of the shortest way, or the place behind which there is none."""
        import networkx

        graph = self._graph()
        try:
            states = networkx.dijkstra_path(graph, "start", "end")[1:-1]
        except (networkx.NetworkXNoPath, networkx.NodeNotFound):
            reached = networkx.descendants(graph, "start") if "start" in graph else set()
            return max((state[0] for state in reached if isinstance(state, tuple)), default=0)
        return self._joined(states)

    def _graph(self) -> DiGraph[Any]:
        import networkx

        graph: DiGraph[Any] = networkx.DiGraph()
        last = len(self.stages) - 1
        for key in self.stages[0]:
            for first in self._departing(key):
                graph.add_edge("start", (0, *first), weight=0.0)
        for layer in range(last):
            for name, cuts in self.cuts.items():
                for piece in range(len(cuts) - 1):
                    length = cuts[piece + 1] - cuts[piece]
                    for way in (1, -1):
                        state = (layer, name, piece, way)
                        for following in self._following(state, last):
                            graph.add_edge(state, following, weight=length)
        return graph

    def _following(self, state: _State, last: int) -> Iterator[_State | str]:
        """States that can follow one."""
        layer, name, piece, way = state
        key = self._end(name, piece, way)
        onward = list(self._onward(name, piece, way, key))
        yield from ((layer, *each) for each in onward)
        station = self.stages[layer + 1].get(key)
        if station is None:
            return
        if layer + 1 == last:
            yield "end"
            return
        for each in self._departing(key) if station else onward:
            yield (layer + 1, *each)

    def _end(self, name: str, piece: int, way: int) -> Point:
        """The place at which a piece ends."""
        at = piece + (way > 0)
        edge = self.edges[name]
        if at == 0:
            return edge.start, "", 0.0
        if at == len(self.cuts[name]) - 1:
            return edge.end, "", 0.0
        return "", name, self.cuts[name][at]

    def _departing(self, key: Point) -> list[tuple[str, int, int]]:
        """Pieces over which a train can leave a place, whichever way it came."""
        node, name, position = key
        if node:
            return self.departures.get(node, [])
        at = self.cuts[name].index(position)
        return [(name, at, 1), (name, at - 1, -1)]

    def _onward(
        self, name: str, piece: int, way: int, key: Point
    ) -> Iterator[tuple[str, int, int]]:
        """Pieces onto which a train passes without turning back."""
        node = key[0]
        if not node:
            yield name, piece + way, way
            return
        allowed = self.turns.get(node)
        for other in self.departures.get(node, []):
            if other == (name, piece, -way):
                continue
            pair = (name, other[0])
            if allowed is None or pair in allowed or pair[::-1] in allowed:
                yield other

    def _joined(self, states: Sequence[_State]) -> list[Stretch]:
        """Stretches of pieces; those that continue each other are one."""
        stretches: list[Stretch] = []
        for _, name, piece, way in states:
            ends = self.cuts[name][piece : piece + 2][::way]
            if stretches and stretches[-1][0] == name and _continues(stretches[-1], ends):
                stretches[-1] = (name, stretches[-1][1], ends[1])
            else:
                stretches.append((name, ends[0], ends[1]))
        return stretches


def _continues(before: Stretch, ends: Sequence[float]) -> bool:
    """Whether a piece goes on where the one before ends, in the same direction."""
    return before[2] == ends[0] and (before[2] > before[1]) == (ends[1] > ends[0])

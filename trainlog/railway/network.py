"""A network: stations and junctions joined by lines, and routes that run over several of them.

Each edge is a whole `Line` with a chainage of its own, from one node to another. A `Route` gives
the line as it is travelled, composed of stretches of edges: an ordinary `Line` that states in
`Line.legs` what each of them was.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np

from trainlog.declaration import Declared, Must, Quantity, Table, Text
from trainlog.display import counted, span
from trainlog.errors import InputError, did_you_mean, meant
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
from trainlog.railway.geometry import to_plane
from trainlog.railway.line import (
    TINY,
    Leg as Leg,
    Line,
    Station,
    StepProfile,
    composed,
    position_of,
    route_words,
)
from trainlog.units import KMH

if TYPE_CHECKING:
    from networkx import DiGraph

Part = TypeVar("Part")
Key = TypeVar("Key")

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
    station: bool = field(default=True, compare=False)


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
        of=lambda edge: edge.line.least_radius if edge.line.least_radius < np.inf else np.nan,
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
                        f"{where}: edge '{edge.name}' has the {end} '{name}', which is not a node",
                        remedy=did_you_mean(name, known, "name one of the nodes"),
                    )
            if edge.line.legs:
                yield InputError(
                    f"{where}: edge '{edge.name}' is a route over"
                    f" {counted(len(edge.line.legs), 'edge')} itself",
                    remedy="give a line that is not a route",
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
                    f"{where}: turns are given at '{node}', which is not a node",
                    remedy=did_you_mean(node, known, "name one of the nodes"),
                )
                continue
            there = ending.get(node, set())
            for name in sorted({name for pair in pairs for name in pair} - there):
                yield InputError(
                    f"{where}: turns at '{node}' name the edge '{name}', which does not end there",
                    remedy=did_you_mean(name, there, f"its edges are {', '.join(sorted(there))}"),
                )

    def _unconnected(self, where: str) -> Iterator[InputError]:
        """Parts of the network that no edge joins to the largest."""
        ends = [(edge.start, edge.end) for edge in self.edges]
        groups = connected([node.name for node in self.nodes], ends)
        for names in sorted(groups, key=len)[:-1]:
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
                remedy=did_you_mean(name, known, f"look at its {kind}s"),
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
        name = meant(name.strip(), self.places)
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
            remedy=did_you_mean(name, self.places, "name nodes, stations, or edge@km"),
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
        names = tuple(meant(place.strip(), self.places) for place in places)
        found = shortest_way(self._edges, self.turns, [self.place(name) for name in names])
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
        for (before, forward), (after, onward) in pairwise(movements):
            meets, leaves = self._ends(before, forward)[1], self._ends(after, onward)[0]
            if meets != leaves:
                raise InputError(
                    f"edge '{after}' begins at '{leaves}', and '{before}' ends at '{meets}'",
                    remedy="name the edges that lie between, or exchange a direction",
                )
        stretches: list[Stretch] = []
        for number, (name, forward) in enumerate(movements):
            begin, finish = (0.0, self.edge(name).line.length)[:: 1 if forward else -1]
            if number == 0 and start is not None:
                begin = start
            if number == len(movements) - 1 and end is not None:
                finish = end
            if (finish > begin) != forward:
                raise InputError(
                    f"a route from km {begin / 1e3:.3f} to km {finish / 1e3:.3f} of edge '{name}'"
                    f" does not run {'along' if forward else 'against'} its chainage",
                    remedy="exchange the direction, or correct where it begins and ends",
                )
            stretches.append((name, begin, finish))
        (first, begin, _), (last, _, finish) = stretches[0], stretches[-1]
        places = self._name_of(first, begin), self._name_of(last, finish)
        return Route(self, places, self._legs(stretches))

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

        Composed of stretches of its edges, see `trainlog.railway.line`.

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
        for leg in self.legs:
            edge = self.network.edge(leg.edge)
            for at, chainage in ((leg.position, leg.edge_start), (leg.end, leg.edge_end)):
                name = edge.start if chainage <= TINY else edge.end
                at_node = chainage <= TINY or chainage >= edge.line.length - TINY
                if at_node and self.network.node(name).kind == "station":
                    found = [each for each in found if abs(each[0] - at) > AT_END]
                    found.append((at, name))
        for at, name in ((0.0, self.places[0]), (self.length, self.places[-1])):
            if all(abs(each[0] - at) > AT_END for each in found):
                found.append((at, name))
        found.sort(key=lambda each: each[0])
        return tuple(Station(name, min(max(at, 0.0), self.length)) for at, name in found)


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


def connected(nodes: Iterable[Key], pairs: Iterable[tuple[Key, Key]]) -> list[list[Key]]:
    """The parts of a graph that pairs of its nodes connect, in the order of the nodes.

    Examples
    --------
    >>> connected("abcd", [("a", "c"), ("d", "c")])
    [['a', 'c', 'd'], ['b']]
    """
    part = {node: [node] for node in nodes}
    for ends in pairs:
        fewer, more = sorted((part[end] for end in ends), key=len)
        if fewer is not more:
            more += fewer
            part |= dict.fromkeys(fewer, more)
    groups: dict[int, list[Key]] = {}
    for node, own in part.items():
        groups.setdefault(id(own), []).append(node)
    return list(groups.values())


# ------------------------------------------------------------------ the shortest way

Stretch = tuple[str, float, float]
"""Of an edge, by its name, from one chainage [m] to another."""


def shortest_way(
    edges: Mapping[str, Edge],
    turns: Mapping[str, Sequence[tuple[str, str]]],
    stages: Sequence[Sequence[Place]],
) -> list[Stretch] | int:
    """Stretches of edges of the shortest way through places, or the place behind which none leads.

    Edges are cut where places lie inside them. The graph has each piece once for each direction and
    for each place that the train is on its way to.

    Parameters
    ----------
    edges : dict of str to Edge
    turns : dict of str to sequence of (str, str)
        By node, pairs of edges between which trains pass; see `Network`.
    stages : sequence of sequence of Place
        The points of each place in the order of travel.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> first, second = line.section(0.0, 800.0), line.section(800.0, 1_300.0)
    >>> edges = {"a": Edge("a", first, "X", "Y"), "b": Edge("b", second, "Y", "Z")}
    >>> shortest_way(edges, {}, [[Place("Z")], [Place(edge="a", position=300.0)]])
    [('b', 500.0, 0.0), ('a', 800.0, 300.0)]
    """
    import networkx

    inside: dict[str, set[float]] = {name: set() for name in edges}
    for point in (point for stage in stages for point in stage if point.edge):
        inside[point.edge].add(point.position)
    ends: dict[Stretch, Place] = {}
    departing: dict[Place, list[Stretch]] = {}
    for name, edge in edges.items():
        points = {0.0: Place(edge.start)}
        points |= {at: Place("", name, at) for at in sorted(inside[name])}
        points[edge.line.length] = Place(edge.end)
        for first, last in pairwise(points):
            for begin, end in ((first, last), (last, first)):
                ends[name, begin, end] = points[end]
                departing.setdefault(points[begin], []).append((name, begin, end))

    def onward(piece: Stretch) -> Iterator[Stretch]:
        """Pieces onto which a train passes without turning back."""
        name, begin, end = piece
        allowed = turns.get(ends[piece].node)
        for other in departing[ends[piece]]:
            pair = (name, other[0])
            free = allowed is None or pair in allowed or pair[::-1] in allowed
            if free and other != (name, end, begin):
                yield other

    graph: DiGraph[Any] = networkx.DiGraph()
    for point in stages[0]:
        graph.add_weighted_edges_from(
            ("start", (0, first), 0.0) for first in departing.get(point, [])
        )
    for stage, asked in enumerate(stages[1:]):
        places = {each: each.station for each in asked}
        for piece, point in ends.items():
            following: list[Any] = [(stage, each) for each in onward(piece)]
            if point in places and stage == len(stages) - 2:
                following.append("end")
            elif point in places:
                leaving = departing[point] if places[point] else onward(piece)
                following += [(stage + 1, each) for each in leaving]
            length = abs(piece[2] - piece[1])
            graph.add_weighted_edges_from(((stage, piece), each, length) for each in following)
    try:
        way = networkx.dijkstra_path(graph, "start", "end")[1:-1]
    except (networkx.NetworkXNoPath, networkx.NodeNotFound):
        reached = networkx.descendants(graph, "start") if "start" in graph else set()
        return max((state[0] for state in reached if isinstance(state, tuple)), default=0)
    stretches: list[Stretch] = []
    for _, (name, begin, end) in way:
        before = stretches[-1] if stretches else ("", 0.0, 0.0)
        # A piece that goes on where the one before ends, in the same direction, is one with it.
        if before[0::2] == (name, begin) and (before[2] > before[1]) == (end > begin):
            begin = stretches.pop()[1]
        stretches.append((name, begin, end))
    return stretches


# ------------------------------------------------------------------ networks of lines

SAME_STATION = 2_000.0
"""How far apart [m] two lines may have a station of one name."""

SAME_TRACK = 0.001
"""By how much of their length two lines between the same stations may differ, to be one track."""


def network_of_lines(name: str, lines: Sequence[Line]) -> tuple[Network, list[str]]:
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

    Returns
    -------
    network : Network
    notes : list of str
        What was joined, cut or left out, in words.

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
    >>> network, _ = network_of_lines("both", [line, branch])
    >>> [(edge.name, edge.start, edge.end) for edge in network.edges][-1]
    ('branch', 'Gossau SG', 'Branch')
    """
    if not lines:
        raise InputError(f"network '{name}': there are no lines", remedy="give at least one")
    for line in lines:
        if line.legs:
            raise InputError(
                f"line '{line.name}' is a route itself", remedy="give the lines of its edges"
            )
    taken = set[str]()
    lines = [replace(line, name=unused(line.name, taken)) for line in lines]
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
    return Network(name, nodes, tuple(edges), source=source), notes


def unused(name: str, taken: set[str]) -> str:
    """The name, with a number where it is taken; then it is, too.

    Examples
    --------
    >>> taken = {"Wil"}
    >>> unused("Wil", taken), unused("Wil", taken)
    ('Wil (2)', 'Wil (3)')
    """
    numbered = (f"{name} ({number})" for number in range(2, len(taken) + 3))
    found = next(each for each in (name, *numbered) if each not in taken)
    taken.add(found)
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
    taken = set[str]()
    for start, end in pieces:
        whole = len(pieces) == 1
        own = unused(line.name if whole else f"{line.name} {start[1]} - {end[1]}", taken)
        yield Edge(own, line if whole else line.section(start[0], end[0]), start[1], end[1])


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

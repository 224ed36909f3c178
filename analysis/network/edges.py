"""The edges of a network that a trip ran over; an ordinary line is one edge, itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from analysis.adhesion.export import course_of, point_of, write_features
from analysis.adhesion.slip import SlipAnalysis
from trainlog.arrays import BoolArray, FloatArray
from trainlog.errors import InputError
from trainlog.formats.railway import line_of, line_to_bytes
from trainlog.railway.line import (
    TINY,
    CurvatureProfile,
    Leg,
    Line,
    LineReference,
    Profile,
    StepProfile,
)
from trainlog.railway.network import Edge, Network, Node, climbs
from trainlog.railway.weather import WEATHER_BY_EDGE, stated_condition
from trainlog.spans import spans_within
from trainlog.trip import LINE_ATTACHMENT, PASSPORT_ATTACHMENT, TRAIN_ATTACHMENT, Trip
from trainlog.units import KMH
from trainlog.version import __version__


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch of a line that lies on an edge.

    Attributes
    ----------
    first, last : float [m]
        On the line.
    edge_first, edge_last : float [m]
        The same places on the edge's own chainage; it falls where the line runs against it.
    """

    first: float
    last: float
    edge_first: float
    edge_last: float

    def holds(self, position: ArrayLike) -> BoolArray:
        """Which positions [m] of the line lie in it."""
        s = np.asarray(position, dtype=np.float64)
        return np.asarray((s >= self.first) & (s < self.last))

    def on_edge(self, position: ArrayLike) -> FloatArray:
        """Chainage on the edge [m] of positions of the line [m]."""
        sign = -1.0 if self.backwards else 1.0
        s = np.asarray(position, dtype=np.float64)
        return np.asarray(self.edge_first + sign * (s - max(self.first, 0.0)))

    @property
    def backwards(self) -> bool:
        """Whether the line runs against the edge's chainage."""
        return self.edge_last < self.edge_first


@dataclass(frozen=True, slots=True)
class EdgeOfLine:
    """An edge with the stretches of a line that run over it.

    Attributes
    ----------
    name : str
    length : float [m]
        Of the whole edge.
    stretches : tuple of Stretch
    whole : bool
        Whether the edge is the line itself.
    """

    name: str
    length: float
    stretches: tuple[Stretch, ...]
    whole: bool = False


def edges_of(line: Line, *, backwards: bool = False) -> tuple[EdgeOfLine, ...]:
    """The edges that a line runs over, in the order in which it reaches them.

    Parameters
    ----------
    line : Line
    backwards : bool
        Whether an ordinary line is given reversed, as a trip against its chainage travels it.

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> [(edge.name, edge.length) for edge in edges_of(line)]
    [('CH_StGallen_Wil', 29556.1)]
    """
    if not line.legs:
        ends = (line.length, 0.0) if backwards else (0.0, line.length)
        whole = Stretch(-np.inf, np.inf, *ends)
        return (EdgeOfLine(line.name, line.length, (whole,), whole=True),)
    found: dict[str, EdgeOfLine] = {}
    for number, leg in enumerate(line.legs):
        # The end of the line belongs to its last leg.
        end = np.inf if number == len(line.legs) - 1 else leg.position + leg.length
        stretch = Stretch(leg.position, end, leg.edge_start, leg.edge_end)
        before = found.get(leg.edge)
        known = () if before is None else before.stretches
        found[leg.edge] = EdgeOfLine(leg.edge, leg.edge_length, (*known, stretch))
    return tuple(found.values())


def on_edge(analysis: SlipAnalysis, edge: EdgeOfLine) -> SlipAnalysis:
    """What a slip analysis shows on an edge: its samples and events there, by the edge's chainage.

    Parameters
    ----------
    analysis : SlipAnalysis
        With positions on the line in its own direction.
    edge : EdgeOfLine
        Of that line.
    """
    if edge.whole:
        return analysis
    position, rows = _moved(analysis.position, edge)
    places, kept = _moved(analysis.events["position"].to_numpy(np.float64), edge)
    names = ("speed", "speed_std", "slip_speed", "adhesion", "adhesion_std", "slipping", "time")
    return replace(
        analysis,
        trip=f"{analysis.trip}@{edge.name}",
        position=position[rows],
        events=analysis.events.assign(position=places)[kept],
        **{name: getattr(analysis, name)[rows] for name in names},
    )


def _moved(position: FloatArray, edge: EdgeOfLine) -> tuple[FloatArray, BoolArray]:
    """Chainage on the edge, and which of the positions lie on it."""
    found, there = np.full(position.size, np.nan), np.zeros(position.size, dtype=np.bool_)
    for stretch in edge.stretches:
        inside = stretch.holds(position)
        found[inside] = stretch.on_edge(position[inside])
        there |= inside
    return found, there


CARRIED = (TRAIN_ATTACHMENT, PASSPORT_ATTACHMENT)
"""Attachments that hold on an edge as on the whole route, beside its line."""


def trips_on_edges(trip: Trip, network: Network | None = None) -> list[Trip]:
    """A trip on a route as ordinary trips, one a stretch on an edge.

    Each is named ``trip@edge`` and carries the edge's line; its positions are counted in the
    direction of travel of that line, and its metadata state line and direction, as of any trip.

    Parameters
    ----------
    trip : Trip
        That carries its line.
    network : Network, optional
        Whose lines the trips carry; without it, of each edge what the trip's own line knows: where
        the trip did not run, the edge is level and straight.

    Returns
    -------
    list of Trip
        In the order of travel; the trip itself if its line is no route. Stretches without samples
        are left out.

    Raises
    ------
    LogError
        If the trip carries no line, or does not know where the train was.
    InputError
        If an edge is not one of the network's.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/nonstop.mcap")
    >>> [each.name for each in trips_on_edges(trip)]
    ['trip-01']
    """
    line = line_of(trip)
    if not line.legs:
        return [trip]
    state = trip.located()
    time = pd.DatetimeIndex(state.index).as_unit("ns").asi8
    position = state["position"].to_numpy(np.float64)
    found = []
    for number, leg in enumerate(line.legs):
        first = -np.inf if number == 0 else leg.position
        # What lies at a joint belongs to the stretch that begins there.
        last = np.inf if number == len(line.legs) - 1 else float(np.nextafter(leg.end, -np.inf))
        part = trip.cut(spans_within(time, position, first, last))
        if any(len(frame) for frame in part.topics.values()):
            found.append(_on_leg(part, line, leg, network))
    return found


def _on_leg(part: Trip, line: Line, leg: Leg, network: Network | None) -> Trip:
    """What of a trip was recorded on a leg, as a trip on the edge's line."""
    own = edge_line(line, leg) if network is None else _line_of_network(network, leg)
    shift = (leg.edge_start if leg.forward else own.length - leg.edge_start) - leg.position
    topics = {
        name: frame.assign(position=frame["position"] + shift) if "position" in frame else frame
        for name, frame in part.topics.items()
    }
    direction = "forward" if leg.forward else "reverse"
    named = {"trip": f"{part.name}@{leg.edge}", "line": leg.edge, "direction": direction}
    kept = {name: part.attachments[name] for name in CARRIED if name in part.attachments}
    condition = stated_condition(part.metadata, leg.edge)
    metadata = part.metadata | named | ({"weather": condition} if condition else {})
    metadata.pop(WEATHER_BY_EDGE, None)
    return replace(
        part,
        topics=topics,
        metadata=metadata,
        attachments={LINE_ATTACHMENT: line_to_bytes(own), **kept},
    ).with_step("edge", software=f"trainlog {__version__}", route=line.name, **named)


def _line_of_network(network: Network, leg: Leg) -> Line:
    own = network.edge(leg.edge).line
    if abs(own.length - leg.edge_length) > 1e-3:
        raise InputError(
            f"edge '{leg.edge}' of network '{network.name}' is {own.length:.1f} m long, and"
            f" {leg.edge_length:.1f} m on the trip's route",
            remedy="give the network that the route was made of",
        )
    return own


def edge_line(line: Line, leg: Leg) -> Line:
    """An edge's line in its own direction, as far as a route knows it.

    Elsewhere it is level and straight, with the speed limits of the ends of what is known.

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> nodes = (trainlog.Node("St. Gallen"), trainlog.Node("Wil"))
    >>> edge = trainlog.Edge("850", line, "St. Gallen", "Wil")
    >>> route = trainlog.Network("one", nodes, (edge,)).route("Wil", "Gossau SG").line
    >>> known = edge_line(route, route.legs[0])
    >>> known.length == line.length, bool(known.gradient(20e3) == line.gradient(20e3))
    (True, True)
    """
    part = line.section(leg.position, min(leg.end, line.length))
    part = part if leg.forward else part.reversed()
    low, high = sorted((leg.edge_start, leg.edge_end))
    low, length = (0.0 if low <= TINY else low), leg.edge_length
    before, after = low > 0.0, length - high > TINY

    def padded(known: Profile | None, first: Profile, last: Profile) -> Any:
        """The profile of the whole edge, with others before and behind what is known."""
        pads = [(0.0, first)] * before, [(high, last)] * after
        return known and known.joined([*pads[0], (low, known), *pads[1]])

    def from_start(limits: StepProfile) -> StepProfile:
        """Limits of the whole edge, with the first and the last beyond the ends."""
        positions = low + limits.positions
        positions[0] = 0.0
        return StepProfile(positions, limits.values)

    level = StepProfile(np.zeros(1), np.zeros(1))
    straight = CurvatureProfile(np.zeros(1), np.zeros(1), np.zeros(1))
    own, course = part.kilometres, part.geometry
    # Kilometres go on as they begin and end.
    ways = np.sign(own.end - own.start)
    begins, ends = own.start[:1], own.end[-1:]
    kilometres = (
        LineReference(own.name, np.zeros(1), begins - ways[0] * low, begins),
        LineReference(own.name, np.zeros(1), ends, ends + ways[-1] * (length - high)),
    )
    return replace(
        part,
        name=leg.edge,
        length=length,
        stations=tuple(
            replace(each, position=min(low + each.position, length)) for each in part.stations
        ),
        speed_limits=from_start(part.speed_limits),
        speed_limits_reverse=part.speed_limits_reverse and from_start(part.speed_limits_reverse),
        gradients=padded(part.gradients, level, level),
        curvatures=padded(part.curvatures, straight, straight),
        tunnels=tuple(replace(each, position=low + each.position) for each in part.tunnels),
        geometry=course and replace(course, positions=low + course.positions),
        reference=padded(part.reference, *kilometres),
        legs=(),
    )


@dataclass(frozen=True)
class Exported:
    """What a file holds of a network.

    Attributes
    ----------
    edges, nodes, stations : int
    left_out : tuple of str
        Edges, nodes and stations without coordinates.
    """

    edges: int
    nodes: int
    stations: int
    left_out: tuple[str, ...]


def export_network(network: Network, path: str | Path) -> Exported:
    """Write a network as GeoJSON (RFC 7946, WGS 84), whole or not at all.

    Edges are lines with their length, climbs, limits and least radius; nodes, and stations inside
    edges, are points. What has no coordinates is left out and listed.

    Raises
    ------
    InputError
        If nothing of the network has coordinates, or the file is not to be GeoJSON.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> nodes = (Node("St. Gallen"), Node("Wil"))
    >>> network = Network("one", nodes, (Edge("only", line, "St. Gallen", "Wil"),))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     export_network(network, Path(folder) / "one.geojson").left_out
    ("node 'St. Gallen'", "node 'Wil'")
    """
    if Path(path).suffix.lower() not in (".geojson", ".json"):
        raise InputError(
            "a network is not exported to files of this kind",
            file=path,
            remedy="end it in .geojson",
        )
    features, left_out = list[dict[str, Any]](), list[str]()
    numbers = {"edge": 0, "node": 0, "station": 0}

    def add(kind: str, name: str, course: Any, properties: dict[str, Any]) -> None:
        if course is None:
            left_out.append(f"{kind} '{name}'")
            return
        numbers[kind] += 1
        shape = {"type": "LineString", "coordinates": course.tolist()}
        if kind != "edge":
            shape = {"type": "Point", "coordinates": course[0].tolist()}
        about = {"kind": kind, "name": name, **properties}
        features.append({"type": "Feature", "geometry": shape, "properties": about})

    for edge in network.edges:
        course = course_of(edge.line, 0.0, edge.line.length)
        add("edge", edge.name, course, _properties(edge))
    for node in network.nodes:
        add("node", node.name, _place(node), {"node_kind": node.kind})
    for edge in network.edges:
        for station in edge.line.stations:
            add(
                "station",
                station.name,
                point_of(edge.line, station.position),
                {"edge": edge.name, "position_m": station.position},
            )
    if not features:
        raise InputError(
            f"nothing of network '{network.name}' has coordinates",
            file=path,
            remedy="add geometry to its lines, such as from fixes with 'trainlog new line --from'",
        )
    about = {
        "network": network.name,
        "source": network.source,
        "software": f"trainlog {__version__}",
    }
    write_features(path, features, about)
    return Exported(numbers["edge"], numbers["node"], numbers["station"], tuple(left_out))


def _properties(edge: Edge) -> dict[str, Any]:
    line: Line = edge.line
    rise, fall = climbs(line)
    bends = line.curvatures
    limits = np.concatenate([line.speed_limits.values, line.limits_against.values])
    sharpest = 0.0 if bends is None else float(max(abs(bends.start).max(), abs(bends.end).max()))
    return {
        "start": edge.start,
        "end": edge.end,
        "length_m": line.length,
        "rise_m": round(rise, 3),
        "fall_m": round(fall, 3),
        "lowest_limit_km_h": round(float(limits.min()) * KMH, 3),
        "highest_limit_km_h": round(float(limits.max()) * KMH, 3),
        "least_radius_m": round(1.0 / sharpest, 3) if sharpest > 0.0 else None,
        "assumed": ", ".join(line.assumed),
        "operators_line": "" if line.reference is None else line.reference.name,
    }


def _place(node: Node) -> Any:
    if node.latitude is None or node.longitude is None:
        return None
    return np.array([[node.longitude, node.latitude]]).round(7)

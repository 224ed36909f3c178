"""Recordings on a network: which route each was driven over, cut where one route ends.

By satellite fixes (`trainlog.ingest.matching`), by stations that are stated, by kilometres with the
number of a line, or by the distances between stops. Recorders write the number of a line and its
kilometre, which jumps where the train passes to another line: the places on the edges that this
means are a chain as fixes are. Without numbers the distances between the stops of a trip are
compared with those between stations, by the same chain: each stop may be at any station.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimators.matching import EdgeGraph, EdgeNodes
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.display import counted
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.declared import thing_to_bytes
from trainlog.formats.files import sha256
from trainlog.ingest.clock import MAX_DROPPED
from trainlog.ingest.matching import (
    DRIFT,
    NEAR,
    SPACING,
    WIDEST,
    EdgeTracks,
    Passage,
    Passages,
    Search,
    Unseen,
    Way,
    edge_tracks,
    match_route,
    stops_of,
)
from trainlog.ingest.motion import LATITUDE, LIKELY, MOVING, POSITION, SEVERAL
from trainlog.ingest.parts import part_of, with_cut_lines
from trainlog.ingest.receiver import Fixes, count_placed, fixes_of
from trainlog.ingest.recording import NO_TIME, Recording, Table, carried_on
from trainlog.railway.line import Geometry, Leg, Line
from trainlog.railway.network import Edge, Network, Route
from trainlog.trip import Trip
from trainlog.units import NANOSECONDS

AT_STATION = 250.0
"""A trip that begins or ends so near [m] to a station or a node begins or ends there."""

LEFT_BEHIND = 60.0
"""Time [s] off the network, before and after a route, from which on its rows are left out."""

NETWORK_INPUT = "network.json"
"""Name of the network among the inputs of a trip's provenance."""

STATIONS = "stations"
"""Metadata that states the stations of a trip, with commas between them."""

KILOMETRE_STD = 50.0
"""Standard deviation [m] of kilometres that a recorder writes."""

SKIPPED = 8.0
"""What it costs, in units of log-likelihood, to take a stop for one outside stations."""

USUAL_PACE = 10.0
"""Speed [m/s] that stands for the times of stops, of which only the order counts."""

LEAST_STOPS = 3
"""Fewer stops, both ends included, show no route."""


@dataclass(frozen=True, eq=False)
class NetworkRoutes:
    """A network whose routes are looked for.

    Attributes
    ----------
    network : Network
    stations : tuple of str
        Places of the route of every recording, where they are stated.
    """

    network: Network
    stations: tuple[str, ...] = ()

    @cached_property
    def sha256(self) -> str:
        """Of the network as a file."""
        return sha256(thing_to_bytes(self.network))

    @cached_property
    def turns(self) -> IntArray:
        """Courses of which the second may follow the first."""
        leaving: dict[str, list[int]] = {}
        for number, edge in enumerate(self.network.edges):
            leaving.setdefault(edge.start, []).append(2 * number)
            leaving.setdefault(edge.end, []).append(2 * number + 1)
        found = [
            (course, other)
            for course in range(2 * len(self.network.edges))
            for other in leaving.get(self._end(course), [])
            if other != course ^ 1 and self._allowed(course, other)
        ]
        return np.array(found, dtype=np.int64).reshape(-1, 2)

    def _end(self, course: int) -> str:
        edge = self.network.edges[course // 2]
        return edge.start if course % 2 else edge.end

    def _allowed(self, course: int, other: int) -> bool:
        allowed = self.network.turns.get(self._end(course))
        pair = (self.network.edges[course // 2].name, self.network.edges[other // 2].name)
        return allowed is None or pair in allowed or pair[::-1] in allowed

    @cached_property
    def graph(self) -> EdgeGraph:
        """The edges by number."""
        return EdgeGraph(np.array([edge.line.length for edge in self.network.edges]), self.turns)

    @cached_property
    def edges(self) -> EdgeTracks:
        """The edges on a plane.

        Raises
        ------
        InputError
            If none has a geometry.
        """
        lines = [edge.line for edge in self.network.edges]
        courses = [line.geometry for line in lines]
        known = [course for course in courses if course is not None]
        if not known:
            raise InputError(
                f"no edge of network '{self.network.name}' has a geometry: fixes match none",
                remedy="state the stations of the trip (--stations A,B), or give a network with"
                " the course of its lines",
            )
        origin = (
            float(np.mean([course.latitudes.mean() for course in known])),
            float(np.mean([course.longitudes.mean() for course in known])),
        )
        return edge_tracks(self.graph, courses, origin)

    def words(self, courses: Sequence[int]) -> str:
        """Edges with their directions, in words."""
        names = [
            self.network.edges[course // 2].name + " (against)" * (course % 2) for course in courses
        ]
        return ", ".join(names)

    def along(self, courses: Sequence[int], start: float, end: float) -> Route:
        """The route over courses, from a chainage [m] of the first to one of the last.

        It begins and ends at stations or nodes: the nearest up to `AT_STATION` away, else the one
        behind the train, and before it.
        """
        chosen = list(courses)
        edges = [self.network.edges[course // 2] for course in chosen]
        back = [course % 2 == 1 for course in chosen]
        first = _stop(edges[0], start, ahead=back[0])
        last = _stop(edges[-1], end, ahead=not back[-1])
        if len(chosen) == 1 and (first == last or (last < first) != back[0]):
            first, last = (edges[0].line.length, 0.0) if back[0] else (0.0, edges[0].line.length)
        movements = [(edge.name, not turned) for edge, turned in zip(edges, back, strict=True)]
        begins: float | None = first
        ends: float | None = last
        # An edge of which the train reached nothing but its end is not a part of the route.
        if first == (0.0 if back[0] else edges[0].line.length):
            begins = None
            del movements[0]
        if last == (edges[-1].line.length if back[-1] else 0.0):
            ends = None
            del movements[-1]
        return self._named(self.network.along(movements, begins, ends).legs)

    def _named(self, legs: tuple[Leg, ...]) -> Route:
        """The route with the fewest places that lead over its legs."""
        ends = [self._place(legs[0], legs[0].edge_start), self._place(legs[-1], legs[-1].edge_end)]
        route = Route(self.network, (ends[0], ends[1]), legs)
        passed = [each.name for each in route.line.stations[1:-1]]
        tried = [(), *((name,) for name in passed), tuple(passed)]
        for vias in tried:
            places = (ends[0], *vias, ends[1])
            with suppress(InputError):
                if self.network.route(*places).legs == legs:
                    return Route(self.network, places, legs)
        middle = [f"{leg.edge}@{_km(self.network.edge(leg.edge), leg)}" for leg in legs]
        return Route(self.network, (ends[0], *middle, ends[1]), legs)

    def _place(self, leg: Leg, chainage: float) -> str:
        """The name of a stop of an edge."""
        edge = self.network.edge(leg.edge)
        if chainage <= 0.0:
            return edge.start
        if chainage >= edge.line.length:
            return edge.end
        near = min(edge.line.stations, key=lambda station: abs(station.position - chainage))
        return near.name


def routes_of(network: Network | NetworkRoutes | None) -> NetworkRoutes | None:
    """The routes of a network that is given as such."""
    return NetworkRoutes(network) if isinstance(network, Network) else network


def _km(edge: Edge, leg: Leg) -> str:
    return f"{float(edge.line.kilometre(0.5 * (leg.edge_start + leg.edge_end))) / 1e3:.3f}"


def _stop(edge: Edge, chainage: float, *, ahead: bool) -> float:
    """The stop of an edge [m] at which a train is, else the next with more, or less chainage."""
    stops = np.unique([0.0, edge.line.length, *(each.position for each in edge.line.stations)])
    nearest = float(stops[np.argmin(np.abs(stops - chainage))])
    if abs(nearest - chainage) <= AT_STATION:
        return nearest
    if ahead:
        return float(stops[stops > chainage].min())
    return float(stops[stops < chainage].max())


@dataclass(frozen=True, eq=False)
class OnRoute:
    """The route of a recording.

    Attributes
    ----------
    route : Route
    evidence : str
        What shows it, in words.
    start_position : str or None
        As for a profile: the first position [m], or ``"stations"``.
    course : Geometry or None
        Of the line, where edges without one lie between those with.
    """

    route: Route
    evidence: str
    start_position: str | None = None
    course: Geometry | None = None

    @cached_property
    def line(self) -> Line:
        """As travelled."""
        line = self.route.line
        return line if self.course is None else replace(line, geometry=self.course)

    @property
    def metadata(self) -> dict[str, str]:
        """What a trip states of it."""
        known = {"network": self.route.network.name, "route_evidence": self.evidence}
        if self.start_position is not None:
            known["start_position"] = self.start_position
        return known


Found = tuple[Recording, OnRoute | TrainlogError]
"""A recording and its route, or why it has none."""


def routed(
    routes: NetworkRoutes,
    recording: Recording,
    tables: list[Table],
    trip: Trip,
    metadata: Mapping[str, str],
    stem: str,
) -> list[Found]:
    """The parts of a recording that became a route each.

    Parameters
    ----------
    routes : NetworkRoutes
    recording : Recording
        As it was read.
    tables : list of Table
        What repair left of its rows.
    trip : Trip
        Of these tables.
    metadata : mapping of str to str
        What is given of the trip.
    stem : str
        Before the numbers in the names of the trips, where there are several.

    Raises
    ------
    InputError
        If nothing shows a route.
    """
    stated = metadata.get(STATIONS) or recording.metadata.get(STATIONS, "")
    places = routes.stations or places_in(stated)
    if places:
        route = routes.network.route(*places)
        return [(recording, OnRoute(route, f"stated: {', '.join(places)}"))]
    if count_placed(trip) > 1:
        number = next(i for i, each in enumerate(tables) if LATITUDE in each.signals)
        return list(by_fixes(routes, recording, tables[number], fixes_of(trip), stem))
    return [(recording, _by_stops(routes, tables))]


def on_numbered_lines(
    routes: NetworkRoutes, recording: Recording, column: str | None
) -> Found | None:
    """The route of positions that are kilometres of numbered lines; None of other positions.

    They become positions along the route.

    Parameters
    ----------
    routes : NetworkRoutes
    recording : Recording
        As it was read: repair takes a jump of the kilometre for a defect.
    column : str or None
        With the number of the line at each row.

    Raises
    ------
    InputError
        If they show no route.
    """
    words, table = recording.about.get(column or ""), recording.tables[0]
    if words is None or POSITION not in table.signals:
        return None
    found = by_kilometres(routes, table, words)
    route = _of_places(routes, found)
    first = route.legs[0]
    begun = first.edge_start if first.forward else first.edge_length - first.edge_start
    assert found.position is not None
    moved = table.with_values(POSITION, found.position - begun)
    tables = (moved, *recording.tables[1:])
    evidence = found.words + _margin(routes, found.passage)
    return replace(recording, tables=tables), OnRoute(route, evidence)


def _by_stops(routes: NetworkRoutes, tables: list[Table]) -> OnRoute:
    """The route of a recording by the distances between its stops.

    Raises
    ------
    InputError
        If they show none.
    """
    stops = stops_of(tables[0]) if len(tables) == 1 else None
    if stops is None:
        raise InputError(
            f"nothing shows its route in network '{routes.network.name}': it has no fixes, no"
            " column of line numbers with kilometres, and no positions and speeds that begin and"
            " end at a stop",
            remedy="state its stations (--stations A,B)",
        )
    found = by_stops(routes, stops)
    evidence = found.words + _margin(routes, found.passage)
    return OnRoute(_of_places(routes, found), evidence, "stations")


def _of_places(routes: NetworkRoutes, found: Placed) -> Route:
    remedy = "state its stations (--stations A,B)"
    return _determined(routes, found.passage, "they", f" ({found.words})", remedy)


def _determined(
    routes: NetworkRoutes, passage: Passage, what: str, shown: str, remedy: str
) -> Route:
    """The route of a passage; InputError if it is hardly better than another."""
    if not passage.determined:
        raise InputError(
            f"{what} do not determine the route{shown}: over {routes.words(passage.courses)} is by"
            f" a log-likelihood of {passage.margin:.1f} better than over"
            f" {routes.words(passage.other)}, {LIKELY:g} is needed",
            remedy=remedy,
        )
    return routes.along(passage.courses, passage.start, passage.end)


def _margin(routes: NetworkRoutes, passage: Passage) -> str:
    if not passage.other:
        return "; no other route is possible"
    return (
        f"; log-likelihood {passage.margin:.1f} better than the second-best, over"
        f" {routes.words(passage.other)}"
    )


def by_fixes(
    routes: NetworkRoutes, recording: Recording, table: Table, fixes: Fixes, stem: str
) -> Iterator[Found]:
    """The parts of a recording by its fixes, or why one has no route.

    Parameters
    ----------
    routes : NetworkRoutes
    recording : Recording
        As it was read.
    table : Table
        What repair left of its rows.
    fixes : Fixes
        Of `table`.
    stem : str
        Before the numbers in the names of the trips, where there are several.
    """
    found = match_route(routes.edges, fixes)
    _check(routes.network, found)
    spans = _spans(fixes, found.passages)
    shown = f"fixes ({found.on_network / max(found.near, 1):.0%} of {found.near} looked at)"
    inside = np.zeros(len(table), dtype=np.bool_)
    for first, last in spans:
        inside |= (table.time >= first) & (table.time <= last)
    left = int(np.count_nonzero(~inside))
    for number, (passage, span) in enumerate(zip(found.passages, spans, strict=True), start=1):
        name = f"{stem}-{number:02d}" if len(spans) > 1 else None
        part = recording if name is None else named(recording, name)
        try:
            part = _between(recording, table, span, name)
            if left and number == 1:
                off = {f"{counted(left, 'row')} off the network": left}
                part = replace(part, not_used=part.not_used | off)
            joined = "".join(_joined_over(routes, unseen) for unseen in passage.unseen)
            route = _determined(
                routes,
                passage,
                "the fixes",
                "",
                "state the way: --stations with a place on the edge that was driven,"
                " such as A,edge@1.2,B",
            )
            evidence = shown + _margin(routes, passage) + joined
            for unseen in passage.unseen:
                part = _without_fixes(part, fixes, unseen, routes.words(unseen.courses))
        except TrainlogError as error:
            yield part, error
        else:
            yield part, OnRoute(route, evidence, course=_course(route))


def named(recording: Recording, name: str) -> Recording:
    """The recording under another name."""
    return replace(recording, metadata=recording.metadata | {"trip": name})


def _joined_over(routes: NetworkRoutes, unseen: Unseen) -> str:
    """That the distance driven over edges without a course is theirs, in words.

    Raises
    ------
    InputError
        If it is another, or not known.
    """
    words = routes.words(unseen.courses)
    remedy = "give the course of these edges of the network, or state the stations (--stations A,B)"
    if not np.isfinite(unseen.driven):
        raise InputError(
            f"its route runs over {words} without a geometry, and no speed shows how far it drove"
            " there",
            remedy=remedy,
        )
    if not unseen.agrees:
        raise InputError(
            f"its route runs over {words} without a geometry: between the fixes before and behind"
            f" it is {unseen.length:.0f} m long, and by its speed the train drove"
            f" {unseen.driven:.0f} m",
            remedy=remedy,
        )
    return (
        f"; over {words} without a geometry by the distance driven ({unseen.driven:.0f} of"
        f" {unseen.length:.0f} m)"
    )


def _without_fixes(part: Recording, fixes: Fixes, unseen: Unseen, words: str) -> Recording:
    """The recording, with its fixes on edges that have no course known as without a chainage."""
    inside = (fixes.seconds > unseen.before) & (fixes.seconds < unseen.after)
    count = int(np.count_nonzero(inside & np.isfinite(fixes.latitude)))
    time = fixes.index.as_unit("ns").asi8
    if not count:
        return part
    span = (int(time[inside][0]), int(time[inside][-1]))
    off = {f"{counted(count, 'position')} of fixes on {words}, which has no geometry": count}
    return replace(part, unplaced=(*part.unplaced, span), not_used=part.not_used | off)


def _course(route: Route) -> Geometry | None:
    """The course of a route on which some edges have none, straight there; None of other routes."""
    if route.line.geometry is not None:
        return None
    courses = [(leg, route.leg_line(leg).geometry) for leg in route.legs]
    known = [(leg, course) for leg, course in courses if course is not None]
    lacking = dict.fromkeys(leg.edge for leg, course in courses if course is None)
    positions = np.concatenate([leg.position + course.positions for leg, course in known])
    grows = np.concatenate(([True], np.diff(np.maximum.accumulate(positions)) > 0.01))
    quality = dict.fromkeys(course.quality for _, course in known if course.quality)
    return Geometry(
        positions[grows],
        np.concatenate([course.latitudes for _, course in known])[grows],
        np.concatenate([course.longitudes for _, course in known])[grows],
        "; ".join([*quality, f"straight over {', '.join(lacking)}, of which none is known"]),
    )


def _check(network: Network, found: Passages) -> None:
    """Refuse fixes that show no route at all."""
    where = f"network '{network.name}'"
    if found.fixes < 2 or not found.near:
        away = f"{found.distance:.0f} m" if np.isfinite(found.distance) else "more than 150 m"
        raise InputError(
            f"its fixes lie {away} from {where}",
            remedy="give the network that was driven on, or state the stations (--stations A,B)",
        )
    if not found.passages:
        raise InputError(
            f"too few fixes on {where} to show a route: {found.near} of {found.fixes} that were"
            " looked at lie near an edge",
            remedy="state the stations of the trip (--stations A,B)",
        )
    if found.on_network < (1.0 - MAX_DROPPED) * found.near:
        raise InputError(
            f"only {found.on_network / found.near:.0%} of the fixes near edges of {where} follow a"
            " route that its turns allow",
            remedy="give the network that was driven on; are its turns and its course right?",
        )


def _spans(fixes: Fixes, passages: Sequence[Passage]) -> list[tuple[int, int]]:
    """First and last time [ns] of each passage; the first and the last reach the recording's ends.

    Unless the train was off the network there for long.
    """
    time = fixes.index.as_unit("ns").asi8
    known = np.flatnonzero(np.isfinite(fixes.latitude))
    ends = [float(fixes.seconds[known[0]]), float(fixes.seconds[known[-1]])]
    spans = [[passage.begin, passage.finish] for passage in passages]
    if spans[0][0] - ends[0] < LEFT_BEHIND:
        spans[0][0] = -np.inf
    if ends[1] - spans[-1][1] < LEFT_BEHIND:
        spans[-1][1] = np.inf
    for number in range(1, len(spans)):
        if passages[number].after == "reversal":
            middle = 0.5 * (spans[number - 1][1] + spans[number][0])
            spans[number - 1][1] = spans[number][0] = middle
    lowest, highest = np.iinfo(np.int64).min, np.iinfo(np.int64).max

    def at(seconds: float) -> int:
        if np.isinf(seconds):
            return int(lowest if seconds < 0.0 else highest)
        return int(time[0] + round(seconds * 1e9))

    return [(at(first), at(last)) for first, last in spans]


def _between(
    recording: Recording, table: Table, span: tuple[int, int], name: str | None
) -> Recording:
    """The rows of a recording between two times of what repair left of it.

    Raises
    ------
    InputError
        If it must be cut, and has several tables.
    """
    inside = np.flatnonzero((table.time >= span[0]) & (table.time <= span[1]))
    if inside.size == len(table):
        return recording
    if len(recording.tables) != 1:
        raise InputError(
            "leaves its route, or turns round, and its samples are on several clocks",
            remedy="cut the file where the trip begins and ends",
        )
    samples = table.samples[inside]
    number = recording.tables[0].samples
    rows: BoolArray = (number >= samples.min()) & (number <= samples.max())
    metadata = dict(recording.metadata) | ({"trip": name} if name else {})
    part = part_of(recording, rows, metadata)
    first = bool(rows[0]) if rows.size else False
    return with_cut_lines(part, recording) if first else part


def places_in(words: str) -> tuple[str, ...]:
    """Places with commas between them.

    Examples
    --------
    >>> places_in("Wil, Gossau,St. Gallen")
    ('Wil', 'Gossau', 'St. Gallen')
    """
    return tuple(word.strip() for word in words.split(",") if word.strip())


# ------------------------------------------------------- kilometres, and distances between stops


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


def by_kilometres(routes: NetworkRoutes, table: Table, words: NDArray[np.object_]) -> Placed:
    """The route of positions that are kilometres of numbered lines.

    Parameters
    ----------
    routes : NetworkRoutes
    table : Table
        As read: ``/train/state.position`` is the kilometre [m].
    words : (n,) object array
        Number or name of the line at each row; where it is empty, that of the row before.

    Raises
    ------
    InputError
        If the network has no such lines or kilometres, or several ways have them.
    """
    network, kilometre = routes.network, table.signals[POSITION]
    words = carried_on(np.array([str(word).strip() for word in words], dtype=np.object_))
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
            f" that were looked at{where}",
            remedy="are the kilometres of the network's lines (reference) those of the recorder?",
        )
    search = Search(_bare(routes.graph), nodes, {})
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
    first = best.legs(routes.graph.lengths)[0][0].begun
    position = _positions(network, best, chosen, kilometre, words) - first
    count = best.chain.node.size
    shown = f"kilometres of {len(set(words[known]))} line(s), {count} of {chosen.size} looked at"
    return Placed(passage, shown, position)


def _bare(graph: EdgeGraph) -> EdgeTracks:
    """Edges without a course."""
    return EdgeTracks(graph, (None,) * graph.lengths.size, (0.0, 0.0))


def _edges_called(network: Network) -> dict[str, list[int]]:
    """Edges by the name of their line, and as the operator calls it."""
    found: dict[str, list[int]] = {}
    for number, edge in enumerate(network.edges):
        for name in _names(edge):
            found.setdefault(name, []).append(number)
    return found


def _names(edge: Edge) -> set[str]:
    """The name of an edge, and what the operator calls its line."""
    reference = edge.line.reference
    return {edge.name} | ({reference.name} if reference is not None else set())


def _spaced(kilometre: FloatArray, words: NDArray[np.object_], known: BoolArray) -> IntArray:
    """Rows at which the line or the place is another than before."""
    rows = np.flatnonzero(known)
    stretch = np.floor(kilometre[rows] / SPACING)
    changes = (np.diff(stretch) != 0) | (words[rows][1:] != words[rows][:-1])
    return rows[np.concatenate(([True], changes))]


def _chainages(line: Line, kilometre: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Chainage of kilometres on each piece of a line, and how far beyond its ends they are [m]."""
    known, found = line.kilometres, []
    ends = known.ends(line.length)
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
        mine = np.isin(words.astype(str), sorted(_names(edge))) & np.isfinite(kilometre)
        for chainage, beyond in _chainages(edge.line, np.where(mine, kilometre, 0.0)):
            along = begun + (edge.line.length - chainage if number % 2 else chainage)
            off = np.where(mine & (beyond <= WIDEST), np.abs(along - course), np.inf)
            closer = off < best
            position[closer], best[closer] = along[closer], off[closer]
        begun += edge.line.length
    return position


def by_stops(routes: NetworkRoutes, stops: FloatArray) -> Placed:
    """The route whose stations lie as far apart as the stops of a trip [m].

    Raises
    ------
    InputError
        If there is none, or more than one.
    """
    if stops.size < LEAST_STOPS:
        raise InputError(
            f"{stops.size} stops show no route in network '{routes.network.name}'",
            remedy="state its stations (--stations A,B)",
        )
    edges, chainages = _stations(routes.network)
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
    search = Search(_bare(routes.graph), nodes, {"absence": np.inf, "reward": SKIPPED})
    best, margin, other = search.best()
    node, gap = best.chain.node, np.diff(stops[best.chain.node])
    ends = node.size > 1 and node[0] == 0 and node[-1] == stops.size - 1
    off = np.abs(np.diff(best.position) - gap)
    few = node.size < stops.size - int(MAX_DROPPED * stops.size)
    if not ends or few or np.any(off > 2.0 * NEAR + DRIFT * gap):
        raise InputError(
            f"no stations of network '{routes.network.name}' lie as far apart as its"
            f" {stops.size} stops",
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

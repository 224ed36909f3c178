"""Recordings on a network: which route each was driven over, cut where one route ends.

By satellite fixes (`trainlog.ingest.matching`), by stations that are stated, by kilometres
with the number of a line, or by the distances between stops (`trainlog.ingest.route_distances`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from estimators.matching import EdgeGraph
from trainlog.arrays import BoolArray, IntArray
from trainlog.display import counted
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.declared import thing_to_bytes
from trainlog.formats.files import sha256
from trainlog.ingest.clock import MAX_DROPPED
from trainlog.ingest.matching import (
    EdgeTracks,
    Passage,
    Passages,
    Unseen,
    edge_tracks,
    match_route,
)
from trainlog.ingest.motion import LATITUDE, LIKELY, POSITION
from trainlog.ingest.parts import part_of, with_cut_lines
from trainlog.ingest.placing import stops_of
from trainlog.ingest.receiver import Fixes, fixes_of
from trainlog.ingest.recording import Recording, Table
from trainlog.ingest.route_distances import (
    Placed,
    by_kilometres,
    by_stops,
    check_determined,
)
from trainlog.railway.line import Geometry, Leg, Line
from trainlog.railway.network import Edge, Network, Route
from trainlog.trip import Trip

AT_STATION = 250.0
"""A trip that begins or ends so near [m] to a station or a node begins or ends there."""

LEFT_BEHIND = 60.0
"""Time [s] off the network, before and after a route, from which on its rows are left out."""

NETWORK_INPUT = "network.json"
"""Name of the network among the inputs of a trip's provenance."""

STATIONS = "stations"
"""Metadata that states the stations of a trip, with commas between them."""


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
            if self._leads(places, legs):
                return Route(self.network, places, legs)
        middle = [f"{leg.edge}@{_km(self.network.edge(leg.edge), leg)}" for leg in legs]
        return Route(self.network, (ends[0], *middle, ends[1]), legs)

    def _leads(self, places: tuple[str, ...], legs: tuple[Leg, ...]) -> bool:
        try:
            return self.network.route(*places).legs == legs
        except InputError:
            return False

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
    places = stated_stations(routes, recording, metadata)
    if places:
        route = routes.network.route(*places)
        return [(recording, OnRoute(route, f"stated: {', '.join(places)}"))]
    if "/gnss/fix" in trip and trip["/gnss/fix"]["latitude"].count() > 1:
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
    found = by_kilometres(routes.network, routes.graph, table, words)
    route = _determined(routes, found)
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
    found = by_stops(routes.network, routes.graph, stops)
    evidence = found.words + _margin(routes, found.passage)
    return OnRoute(_determined(routes, found), evidence, "stations")


def _determined(routes: NetworkRoutes, found: Placed) -> Route:
    passage = found.passage
    check_determined(found, routes.words(passage.courses), routes.words(passage.other))
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
    off = _rows_off(table, spans)
    for number, (passage, span) in enumerate(zip(found.passages, spans, strict=True), start=1):
        name = f"{stem}-{number:02d}" if len(spans) > 1 else None
        part = recording if name is None else named(recording, name)
        try:
            part = _between(recording, table, span, name)
            if off and number == 1:
                part = replace(part, not_used=part.not_used | {off[0]: off[1]})
            joined = "".join(_joined_over(routes, unseen) for unseen in passage.unseen)
            if not passage.determined:
                raise _undetermined(routes, passage)
            route = routes.along(passage.courses, passage.start, passage.end)
            evidence = _evidence(routes, found, passage) + joined
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


def _undetermined(routes: NetworkRoutes, passage: Passage) -> InputError:
    return InputError(
        f"the fixes do not determine the route: over {routes.words(passage.courses)} is by a"
        f" log-likelihood of {passage.margin:.1f} better than over {routes.words(passage.other)},"
        f" {LIKELY:g} is needed",
        remedy="state the way: --stations with a place on the edge that was driven,"
        " such as A,edge@1.2,B",
    )


def _evidence(routes: NetworkRoutes, found: Passages, passage: Passage) -> str:
    share = found.on_network / max(found.near, 1)
    return f"fixes ({share:.0%} of {found.near} looked at)" + _margin(routes, passage)


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


def _rows_off(table: Table, spans: Sequence[tuple[int, int]]) -> tuple[str, int] | None:
    """How many rows belong to no route."""
    inside = np.zeros(len(table), dtype=np.bool_)
    for first, last in spans:
        inside |= (table.time >= first) & (table.time <= last)
    count = int(np.count_nonzero(~inside))
    return (f"{counted(count, 'row')} off the network", count) if count else None


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


def stated_stations(
    routes: NetworkRoutes, recording: Recording, metadata: Mapping[str, str]
) -> tuple[str, ...]:
    """Places of the route, where they are stated: for all recordings, or by this one."""
    words = metadata.get(STATIONS) or recording.metadata.get(STATIONS, "")
    return routes.stations or places_in(words)


def places_in(words: str) -> tuple[str, ...]:
    """Places with commas between them.

    Examples
    --------
    >>> places_in("Wil, Gossau,St. Gallen")
    ('Wil', 'Gossau', 'St. Gallen')
    """
    return tuple(word.strip() for word in words.split(",") if word.strip())

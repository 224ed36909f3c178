"""railML 2.0 to 2.5: infrastructure with tracks, their topology and elements along them.

Positions `pos` [m] count from a track's beginning; `absPos` is the operator's mileage [m]; slopes
in per mille and radii [m], right-hand bends positive, as seen along the track; speeds in km/h.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations, pairwise

import numpy as np

from trainlog.formats.tracks import (
    NOT_WGS84,
    SAME_PLACE,
    Infrastructure,
    Limit,
    LimitChoice,
    Stretch,
    TrackData,
    TrackEnd,
    TrackGraph,
    curvature_of,
    distinct_names,
)
from trainlog.formats.xml_tree import Element, numbers_in
from trainlog.railway import LineReference, Station

ELEMENTS_HELD = {
    "speedChanges", "gradientChanges", "radiusChanges", "geoMappings", "tunnels",
}  # fmt: skip
"""Containers of a track's elements that a network holds."""

TRANSITIONS = ("clothoid", "transition", "bloss", "cubic", "sinus", "cosinus", "mixed", "wiener")
"""Parts of the names of curves whose radius changes along them."""

UNDIRECTED = "speed changes without a direction, taken to hold in both"


@dataclass
class _Track:
    """A track of the file and the sections that its switches cut it into."""

    element: Element
    name: str
    begin: float
    length: float
    cuts: list[float] = field(default_factory=list)

    @property
    def edges(self) -> list[float]:
        """Positions [m] at which its sections begin and end."""
        return [0.0, *self.cuts, self.length]

    def section(self, number: int) -> str:
        """The name of a section."""
        return self.name if len(self.cuts) == 0 else f"{self.name}/{number + 1}"

    def around(self, cut: float) -> tuple[TrackEnd, TrackEnd]:
        """The end of the section before a cut, and the beginning of the one behind it."""
        number = self.cuts.index(cut)
        return TrackEnd(self.section(number), True), TrackEnd(self.section(number + 1), False)

    def at(self, element: Element) -> float:
        """Position [m] of an element from the track's beginning."""
        position = element.number("pos") - self.begin
        if not -1.0 <= position <= self.length + 1.0:
            raise element.error(
                f"pos {element.text('pos')} is not on track '{self.name}', which goes from"
                f" {self.begin:g} to {self.begin + self.length:g} m",
                "correct the position",
            )
        return min(max(position, 0.0), self.length)


def networks_of(root: Element, version: str, name: str, limits: LimitChoice) -> Infrastructure:
    """The networks of a railML 2 file, and an account of it; see `read_railml`."""
    infra = root.first("infrastructure")
    if infra is None or infra.first("tracks", "track") is None:
        raise root.error(
            "has no infrastructure with tracks", "export the infrastructure with its tracks"
        )
    return _File(infra, TrackGraph(infra.text("name") or name, f"railML {version}")).networks(
        limits
    )


@dataclass
class _File:
    """What is gathered of a file's infrastructure."""

    infra: Element
    graph: TrackGraph
    tracks: list[_Track] = field(default_factory=list)
    data: dict[str, TrackData] = field(default_factory=dict)
    ocps: dict[str, Element] = field(default_factory=dict)
    ocp_names: dict[str, str] = field(default_factory=dict)
    lines: dict[str, Element] = field(default_factory=dict)
    sides: dict[str, tuple[Element, list[TrackEnd]]] = field(default_factory=dict)
    crossings: list[dict[str, list[Element]]] = field(default_factory=list)

    def networks(self, limits: LimitChoice) -> Infrastructure:
        """The networks of the whole."""
        self.tracks = list(self._tracks())
        self.ocps = {
            each.text("id"): each for each in self.infra.all("operationControlPoints", "ocp")
        }
        named = [(each.text("name") or own, own) for own, each in self.ocps.items()]
        self.ocp_names = dict(zip(self.ocps, distinct_names(named), strict=True))
        self.lines = {
            reference.text("ref"): line
            for line in self.infra.all("trackGroups", "line")
            for reference in line.all("trackRef")
        }
        self.data = {track.name: self._whole(track) for track in self.tracks}
        self._connect()
        self._account()
        sections = {
            track.name: {track.section(n): ends for n, ends in enumerate(pairwise(track.edges))}
            for track in self.tracks
        }
        return self.graph.whole(self.data, limits, sections)

    # ---- tracks

    def _tracks(self) -> Iterator[_Track]:
        elements = list(self.infra.all("tracks", "track"))
        names = [each.text("name") or each.text("id") for each in elements]
        for element, name in zip(elements, names, strict=True):
            ends = [element.first("trackTopology", tag) for tag in ("trackBegin", "trackEnd")]
            if ends[0] is None or ends[1] is None:
                raise element.error(
                    "has no trackBegin and trackEnd", "give both in its trackTopology"
                )
            begin, end = ends[0].number("pos", 0.0), ends[1].number("pos")
            if end < begin:
                raise ends[1].error(
                    f"ends at pos {end:g}, before it begins at {begin:g}",
                    "pos counts from the track's beginning; absPos is the mileage",
                )
            own = name if names.count(name) == 1 else element.text("id") or name
            track = _Track(element, own, begin, end - begin)
            track.cuts = sorted({track.at(each) for each in _switches(element)})
            yield track

    def _whole(self, track: _Track) -> TrackData:
        """A whole track with what lies along it."""
        data = TrackData(track.name, track.length)
        data.gradients = self._changes(track, "gradient", "slope", 1e-3)
        data.curves = self._curves(track)
        data.limits = self._limits(track)
        data.tunnels = list(self._tunnels(track))
        data.stations = list(self._stations(track))
        data.course = list(self._course(track))
        data.course_quality = "coordinates of railML"
        data.reference = self._reference(track)
        return data

    def _elements(self, track: _Track, kind: str) -> list[Element]:
        found = track.element.all("trackElements", f"{kind}Changes", f"{kind}Change")
        return sorted(found, key=lambda each: each.number("pos"))

    def _changes(self, track: _Track, kind: str, what: str, factor: float) -> list[Stretch]:
        """What holds from each change to the next; changes for the other direction left out."""
        used = []
        for each in self._elements(track, kind):
            if each.text("dir") == "down":
                self.graph.account.left_out[f"{kind}Changes of the direction down"] += 1
            else:
                used.append(each)
        places = [*(track.at(each) for each in used), track.length]
        return [
            Stretch(start, end, factor * each.number(what))
            for each, (start, end) in zip(used, pairwise(places), strict=True)
        ]

    def _curves(self, track: _Track) -> list[Stretch]:
        """Curvature; between a transition curve's ends it changes in a straight line."""
        used = [each for each in self._elements(track, "radius") if each.text("dir") != "down"]
        stretches = self._changes(track, "radius", "radius", 1.0)
        bends = [Stretch(s.begin, s.end, curvature_of(s.value)) for s in stretches]
        for number, each in enumerate(used):
            curve = each.text("geometryElementDescription").lower()
            if any(word in curve for word in TRANSITIONS) and number + 1 < len(bends):
                # A transition that begins on straight track has the radius 0 there.
                bends[number] = bends[number]._replace(last=bends[number + 1].value)
        return bends

    def _limits(self, track: _Track) -> list[Limit]:
        """Limits by direction, each from its change to the next of the same trains.

        A change without a direction, which the schema allows and which then is not known, counts
        in both: along the track among those of "up", against it up to the next without one. Where
        one of "down" holds as well, the lower of both does.
        """
        found = list[Limit]()
        changes: dict[tuple[str, str], list[Element]] = {}
        for each in self._elements(track, "speed"):
            stated, category = each.text("dir"), self._category(each)
            if stated not in ("up", "down"):
                changes.setdefault(("", category), []).append(each)
                if stated != "both":
                    self.graph.account.assumed[UNDIRECTED] += 1
            way = "down" if stated == "down" else "up"
            changes.setdefault((way, category), []).append(each)
        for (way, category), used in changes.items():
            down = way == "down"
            if down:
                used.reverse()
            places = [*(track.at(each) for each in used), 0.0 if down else track.length]
            for each, (start, end) in zip(used, pairwise(places), strict=True):
                if each.text("vMax") == "end":
                    continue
                speed = each.speed("vMax")
                low, high = sorted((start, end))
                found.append(Limit(low, high, speed, way == "up", way != "up", category))
        return found

    def _category(self, change: Element) -> str:
        """The trains that a speed change is for: a category, or a profile; empty: all."""
        profile = change.text("profileRef")
        named = self.infra.all("speedProfiles", "speedProfile")
        words = next((x.text("name") for x in named if x.text("id") == profile), "") or profile
        kinds = (change.text("trainCategory"), change.text("etcsTrainCategory"), words)
        return " ".join(filter(None, kinds))

    def _tunnels(self, track: _Track) -> Iterator[Stretch]:
        """Tunnels, with their cross-section [m²]; NaN where it is not stated."""
        for each in track.element.all("trackElements", "tunnels", "tunnel"):
            length = each.number("length", 0.0)
            if length <= 0.0:
                self.graph.account.left_out["tunnels without a length"] += 1
                continue
            section = each.number("crossSection", 0.0)
            begin = track.at(each)
            yield Stretch(begin, begin + length, section if section > 0.0 else np.nan)

    def _stations(self, track: _Track) -> Iterator[Station]:
        """Operation control points on the track, by its cross-sections and its ends."""
        for each in track.element.all("trackTopology", "crossSections", "crossSection"):
            if each.text("ocpRef"):
                yield Station(self._ocp_name(each), track.at(each))
        for tag, at in (("trackBegin", 0.0), ("trackEnd", track.length)):
            for node in track.element.all("trackTopology", tag, "macroscopicNode"):
                yield Station(self._ocp_name(node), at)

    def _ocp_name(self, element: Element) -> str:
        reference = element.text("ocpRef")
        if reference not in self.ocps:
            raise element.missing("ocp", reference)
        return self.ocp_names[reference]

    def _course(self, track: _Track) -> Iterator[tuple[float, float, float]]:
        """Coordinates of the elements of a track that have a position."""
        for element in track.element.every():
            for coordinate in element.all("geoCoord"):
                if element.tag == "trackBegin":
                    at = 0.0
                elif "pos" in element.attributes:
                    at = track.at(element)
                else:
                    continue
                code = coordinate.text("epsgCode", "4326").rpartition(":")[2]
                words = coordinate.text("coord").split()
                if code != "4326" or len(words) < 2:
                    self.graph.account.left_out[NOT_WGS84] += 1
                    continue
                try:
                    latitude, longitude = float(words[0]), float(words[1])
                except ValueError:
                    raise coordinate.error(
                        f"coord '{coordinate.text('coord')}' is no latitude and longitude",
                        "give two numbers in degrees",
                    ) from None
                yield at, latitude, longitude

    def _reference(self, track: _Track) -> LineReference | None:
        """The operator's mileage by absPos of the track's ends and its mileage changes."""
        topology = track.element.first("trackTopology")
        assert topology is not None
        begin, end = topology.first("trackBegin"), topology.first("trackEnd")
        assert begin is not None
        assert end is not None
        if not (begin.text("absPos") and end.text("absPos")) or track.length <= SAME_PLACE:
            return None
        changes = sorted(
            topology.all("mileageChanges", "mileageChange"), key=lambda each: each.number("pos")
        )
        starts = [(0.0, begin.number("absPos"))]
        starts += [(track.at(each), each.number("absPos")) for each in changes]
        ends = [each.number("absPosIn", float("inf")) for each in changes]
        ends.append(end.number("absPos"))
        falling = end.number("absPos") < begin.number("absPos")
        rows = dict[float, tuple[float, float]]()
        for (at, km), out, stop in zip(
            starts, ends, [*(at for at, _ in starts[1:]), track.length], strict=True
        ):
            if stop > at:
                known = km + (stop - at) * (-1.0 if falling else 1.0)
                rows[at] = (km, known if out == float("inf") else out)
        line = self.lines.get(track.element.text("id"))
        name = (line.text("name") or line.text("id")) if line is not None else track.name
        table = np.array([(at, *rows[at]) for at in sorted(rows)])
        return LineReference(name, *table.T)

    # ---- topology

    def _connect(self) -> None:
        """Movements between tracks, by the connections that name each other."""
        macroscopic = dict[str, list[TrackEnd]]()
        for track in self.tracks:
            begin, last = TrackEnd(track.section(0), False), track.section(len(track.cuts))
            for tag, end in (("trackBegin", begin), ("trackEnd", TrackEnd(last, True))):
                place = track.element.first("trackTopology", tag)
                assert place is not None
                for each in place.children:
                    if each.tag == "connection":
                        self._add_side(each, [end])
                    elif each.tag == "macroscopicNode":
                        macroscopic.setdefault(each.text("ocpRef"), []).append(end)
                    elif each.tag in ("bufferStop", "openEnd") and each.text("id"):
                        self.graph.labels[end] = each.text("name") or each.text("id")
            for switch in _switches(track.element):
                self._add_switch(track, switch)
            for cut in track.cuts:
                self.graph.movements.append(track.around(cut))
        for ends in macroscopic.values():
            self.graph.movements += combinations(ends, 2)
        self._meet()

    def _add_side(self, element: Element, ends: list[TrackEnd]) -> None:
        own = element.text("id")
        if not own or own in self.sides:
            raise element.error(
                f"has the id of the one at line {self.sides[own][0].line}" if own else "has no id",
                "give each connection an id of its own",
            )
        self.sides[own] = (element, ends)

    def _add_switch(self, track: _Track, switch: Element) -> None:
        """The ends from which trains take the branches of a switch or crossing."""
        cut = track.at(switch)
        before, after = track.around(cut)
        label = switch.text("name") or switch.text("id") or f"{track.name} at {cut:g} m"
        for end in (before, after):
            self.graph.labels.setdefault(end, label)
        branches: dict[str, list[Element]] = {"incoming": [], "outgoing": []}
        for each in switch.all("connection"):
            way = each.text("orientation")
            if way not in branches:
                raise each.error(
                    f"orientation '{way}' is neither incoming nor outgoing",
                    "state on which side of the switch the other track is",
                )
            branches[way].append(each)
        if switch.tag == "switch":
            for way, end in (("incoming", after), ("outgoing", before)):
                for each in branches[way]:
                    self._add_side(each, [end])
            return
        kind = switch.text("type", "simpleCrossing")
        slips = kind in ("doubleSwitchCrossing", "simpleSwitchCrossing")
        if kind == "simpleSwitchCrossing":
            self.graph.account.left_out["single slips, held as crossings without a slip"] += 1
            slips = False
        for way, end in (("incoming", after), ("outgoing", before)):
            for each in branches[way]:
                self._add_side(each, [end] if slips else [])
        self.crossings.append(branches)

    def _meet(self) -> None:
        """Movements over connections that refer to each other, and across crossings."""
        for own, (element, ends) in self.sides.items():
            other = element.text("ref")
            if other not in self.sides:
                raise element.missing("connection", other)
            back = self.sides[other][0]
            if back.text("ref") != own:
                raise element.error(
                    f"refers to the connection '{other}' at line {back.line}, which refers to"
                    f" '{back.text('ref')}'",
                    "two connections must refer to each other",
                )
            if own < other:
                self.graph.movements += [(a, b) for a in ends for b in self.sides[other][1]]
        for branches in self.crossings:
            for one in branches["incoming"]:
                for two in branches["outgoing"]:
                    from_there, to_there = (self.sides[each.text("ref")][1] for each in (one, two))
                    self.graph.movements += [(a, b) for a in from_there for b in to_there]

    # ---- what is left out

    def _account(self) -> None:
        """Count what stands in the file and not in the network."""
        counts = self.graph.account.left_out
        for track in self.tracks:
            for part in ("trackElements", "ocsElements"):
                for container in track.element.all(part):
                    counts.update(numbers_in(container.children, ELEMENTS_HELD))
            if track.element.text("mainDir") not in ("", "both", "none", "unknown"):
                self.graph.account.assumed[
                    "tracks with a main direction, over which trains may run both ways"
                ] += 1
        used = {station.name for each in self.data.values() for station in each.stations}
        names = {each.text("name") or own for own, each in self.ocps.items()}
        counts["operation control points without a place on a track"] += sum(
            not any(known == name or known.startswith(f"{name} (") for known in used)
            for name in names
        )


def _switches(track: Element) -> Iterator[Element]:
    """Switches and crossings in a track."""
    for tag in ("switch", "crossing"):
        yield from track.all("trackTopology", "connections", tag)

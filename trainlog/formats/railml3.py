"""railML 3.1 to 3.3: infrastructure with a topology of net elements and things located on them.

A location is a net element with intrinsic coordinates (0 at its beginning, 1 at its end),
positions [m] from its beginning, or measures of a linear positioning system. Gradients in per
mille, radii [m] with right-hand bends positive as seen along the location, speeds in km/h; x is
longitude.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

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

FUNCTIONS_HELD = {
    "operationalPoints", "speeds", "switchesIS", "crossings", "bufferStops", "overCrossings",
}  # fmt: skip
"""Containers of the functional infrastructure that a network holds."""

_LINEAR = ("linearPositioningSystems", "linearPositioningSystem")

FINEST = ("micro", "meso", "macro")
"""Levels of description, the one that is taken first."""


@dataclass
class _NetElement:
    """A linear net element: a track."""

    element: Element
    length: float
    measures: dict[str, list[tuple[float, float]]]
    """Position and measure [m] by linear positioning system, in order of position."""

    def at_measure(self, system: str, measure: float) -> float | None:
        """Position [m] of a measure of a linear positioning system; None where it has none."""
        for (at, km), (end, last) in pairwise(self.measures.get(system, [])):
            low, high = sorted((km, last))
            if high > low and low - 1e-3 <= measure <= high + 1e-3:
                return at + (measure - km) / (last - km) * (end - at)
        return None


@dataclass(frozen=True)
class _Piece:
    """Where something lies on a net element, and as seen in which direction, if not in both."""

    name: str
    begin: float
    end: float
    turned: bool
    both: bool = False


def networks_of(root: Element, version: str, name: str, limits: LimitChoice) -> Infrastructure:
    """The networks of a railML 3 file, and an account of it; see `read_railml`."""
    infra = root.first("infrastructure")
    if infra is None or infra.first("topology", "netElements", "netElement") is None:
        raise root.error(
            "has no infrastructure with a topology of net elements",
            "export the infrastructure with its topology",
        )
    file = _File(root, infra, TrackGraph(_name(infra) or name, f"railML {version}"))
    return file.networks(limits)


@dataclass
class _File:
    """What is gathered of a file."""

    root: Element
    infra: Element
    graph: TrackGraph
    elements: dict[str, _NetElement] = field(default_factory=dict)
    others: set[str] = field(default_factory=set)
    wgs84: set[str] = field(default_factory=set)
    data: dict[str, TrackData] = field(default_factory=dict)

    def networks(self, limits: LimitChoice) -> Infrastructure:
        """The networks of the whole."""
        self.wgs84 = self._geographic_systems()
        self._find_elements()
        for name, each in self.elements.items():
            self.data[name] = TrackData(name, each.length, course=list(self._course(each)))
            self.data[name].course_quality = "coordinates of railML"
            self.data[name].reference = self._reference(each)
        for kind in ("gradient", "horizontal"):
            self._add_curves(kind)
        self._add_limits()
        self._add_tunnels()
        self._add_stations()
        self._connect()
        self._account()
        return self.graph.whole(self.data, limits)

    # ---- topology

    def _find_elements(self) -> None:
        """The linear net elements of the finest level."""
        topology = self.infra.first("topology")
        assert topology is not None
        levels: dict[str, set[str]] = {}
        for level in topology.all("networks", "network", "level"):
            parts = {each.text("ref") for each in level.all("networkResource")}
            levels.setdefault(level.text("descriptionLevel").lower(), set()).update(parts)
        chosen = next((levels[each] for each in FINEST if levels.get(each)), None)
        for each in topology.all("netElements", "netElement"):
            own = each.text("id")
            if not own or own in self.elements or own in self.others:
                raise each.error("needs an id of its own", "give each net element another id")
            collected = any(child.tag.startswith("elementCollection") for child in each.children)
            measures = dict(_measures(each))
            length = each.number("length", 0.0) or _extent(measures)
            if collected or (chosen is not None and own not in chosen) or length <= 0.0:
                self.others.add(own)
                continue
            for rows in measures.values():
                rows[:] = sorted((share * length, km) for share, km in rows)
            self.elements[own] = _NetElement(each, length, measures)
        if not self.elements:
            raise topology.error(
                "has no net element with a length",
                "export the micro level, with the length of each net element",
            )
        if self.others:
            self.graph.account.left_out[
                "net elements of other levels, collections, or without a length"
            ] = len(self.others)

    def _connect(self) -> None:
        """Movements by the relations that trains can pass over."""
        for relation in self.infra.all("topology", "netRelations", "netRelation"):
            ends = list[TrackEnd]()
            for side in "AB":
                part = relation.first(f"element{side}")
                own = "" if part is None else part.text("ref")
                if own not in self.elements and own not in self.others:
                    raise relation.missing("net element", own)
                position = relation.number(f"positionOn{side}")
                if position not in (0.0, 1.0):
                    raise relation.error(
                        f"positionOn{side} is {position:g}", "a relation is at 0 or at 1"
                    )
                ends.append(TrackEnd(own, position == 1.0))
            if any(end.track in self.others for end in ends):
                continue
            way = relation.text("navigability", "Both").lower()
            if way in ("ab", "ba"):
                self.graph.account.assumed[
                    "relations of one direction, over which trains may run both ways"
                ] += 1
            if way != "none":
                self.graph.movements.append((ends[0], ends[1]))
        self._label()

    def _label(self) -> None:
        """Name the ends of net elements by the switches and buffer stops that stand there."""
        functions = self.infra.first("functionalInfrastructure")
        kinds = ("switchesIS", "switchIS"), ("crossings", "crossing"), ("bufferStops", "bufferStop")
        for tags in kinds:
            for each in functions.all(*tags) if functions is not None else ():
                for place in self._spots(each):
                    length = self.elements[place.name].length
                    self.graph.label(place.name, length, place.begin, _name_or_id(each))

    # ---- locations

    def _net_element(self, reference: Element) -> _NetElement | None:
        """The net element that something refers to; None of one that is not held."""
        own = reference.text("netElementRef")
        if own in self.elements:
            return self.elements[own]
        if own in self.others:
            return None
        raise reference.missing("net element", own)

    def _spots(self, thing: Element) -> Iterator[_Piece]:
        """Its spot locations on net elements."""
        for spot in thing.all("spotLocation"):
            element = self._net_element(spot)
            if element is None:
                self.graph.account.left_out["locations on net elements that are not held"] += 1
                continue
            at = self._position(element, spot, "", "linearCoordinate")
            if at is None:
                raise spot.error(
                    "has neither intrinsicCoord nor pos nor a measure on its net element",
                    "give intrinsicCoord from 0 to 1",
                )
            turned = spot.text("applicationDirection") == "reverse"
            yield _Piece(spot.text("netElementRef"), at, at, turned)

    def _stretches(self, thing: Element) -> Iterator[_Piece]:
        """Its linear locations on net elements; spots are none."""
        for location in thing.all("linearLocation"):
            way = location.text("applicationDirection", "both")
            against, both = way == "reverse", way not in ("normal", "reverse")
            for each in location.all("associatedNetElement"):
                element = self._net_element(each)
                if element is None:
                    self.graph.account.left_out["locations on net elements that are not held"] += 1
                    continue
                ends = [
                    self._position(element, each, word, f"linearCoordinate{word}")
                    for word in ("Begin", "End")
                ]
                turned = each.text("keepsOrientation", "true") in ("false", "0")
                whole = (element.length, 0.0) if turned else (0.0, element.length)
                begin, end = (
                    default if at is None else at for at, default in zip(ends, whole, strict=True)
                )
                low, high = sorted((begin, end))
                yield _Piece(each.text("netElementRef"), low, high, turned != against, both)

    def _position(
        self, element: _NetElement, location: Element, word: str, coordinate: str
    ) -> float | None:
        """Position [m] on a net element: by intrinsic coordinate, position, or measure."""
        if location.text(f"intrinsicCoord{word}"):
            share = location.number(f"intrinsicCoord{word}")
            if not -1e-6 <= share <= 1.0 + 1e-6:
                raise location.error(
                    f"intrinsicCoord{word} {share:g} is not from 0 to 1",
                    "give the share of the net element's length",
                )
            return float(np.clip(share, 0.0, 1.0)) * element.length
        if location.text(f"pos{word}"):
            at = location.number(f"pos{word}")
            if not -1.0 <= at <= element.length + 1.0:
                raise location.error(
                    f"pos{word} {at:g} is not on its net element of {element.length:g} m",
                    "give the position from its beginning",
                )
            return float(np.clip(at, 0.0, element.length))
        for each in location.all(coordinate):
            found = element.at_measure(each.text("positioningSystemRef"), each.number("measure"))
            if found is None:
                raise each.error(
                    f"measure {each.text('measure')} is not on its net element",
                    "correct the measure, or give intrinsicCoord",
                )
            return found
        return None

    # ---- what lies along the tracks

    def _add_curves(self, kind: str) -> None:
        """Gradients or curvature; arcs between gradients, and transitions, by their neighbours."""
        open_pieces: dict[str, list[tuple[float, float]]] = {}
        for curve in self.infra.all("geometry", f"{kind}Curves", f"{kind}Curve"):
            value = self._value(curve, kind)
            for place in self._stretches(curve):
                if value is None:
                    open_pieces.setdefault(place.name, []).append((place.begin, place.end))
                    continue
                stretch = Stretch(place.begin, place.end, -value if place.turned else value)
                self._of(kind, place.name).append(stretch)
        for name, pieces in open_pieces.items():
            stated = self._of(kind, name)
            stated += [_between_neighbours(stated, *ends, kind) for ends in pieces]

    def _of(self, kind: str, name: str) -> list[Stretch]:
        track = self.data[name]
        return track.gradients if kind == "gradient" else track.curves

    @staticmethod
    def _value(curve: Element, kind: str) -> float | None:
        """The gradient, or the curvature [1/m], of a curve; None where it changes along it."""
        form = curve.text("curveType")
        if kind == "gradient":
            constant = bool(curve.text("gradient")) and form != "arc"
            return 1e-3 * curve.number("gradient") if constant else None
        if form == "straight":
            return 0.0
        if form != "arc":
            return None
        return curvature_of(curve.number("radius"))

    def _add_limits(self) -> None:
        counts = self.graph.account.left_out
        for section in self.infra.all("functionalInfrastructure", "speeds", "speedSection"):
            if section.text("isTemporary") in ("true", "1"):
                counts["temporary speed sections"] += 1
                continue
            if section.text("maxSpeed") == "end":
                continue
            speed = section.speed("maxSpeed")
            profiles = [
                self._named(each.text("ref"), "functionalInfrastructure", "speeds", "speedProfile")
                for each in section.all("validForSpeedProfile")
            ]
            for place in self._stretches(section):
                # As seen along the net element: a location may run against it.
                forward, against = (True, True) if place.both else (not place.turned, place.turned)
                self.data[place.name].limits += [
                    Limit(place.begin, place.end, speed, forward, against, category)
                    for category in profiles or [""]
                ]

    def _named(self, own: str, *path: str) -> str:
        """The name of the element of an id, by the tags that lead to it."""
        root = self.root if path[0] == "common" else self.infra
        return next((_name_or_id(each) for each in root.all(*path) if each.text("id") == own), own)

    def _add_tunnels(self) -> None:
        """Crossings over the railway that are built as tunnels; the others are counted."""
        counts = self.graph.account.left_out
        for each in self.infra.all("functionalInfrastructure", "overCrossings", "overCrossing"):
            if each.text("constructionType") != "tunnel":
                counts["overCrossings that are no tunnels"] += 1
                continue
            resistance = each.first("tunnelResistance")
            section = 0.0 if resistance is None else resistance.number("crossSection", 0.0)
            places = list(self._stretches(each))
            for place in places:
                value = section if section > 0.0 else np.nan
                self.data[place.name].tunnels.append(Stretch(place.begin, place.end, value))
            counts["tunnels without a stretch of track"] += not places

    def _add_stations(self) -> None:
        points = list(
            self.infra.all("functionalInfrastructure", "operationalPoints", "operationalPoint")
        )
        names = distinct_names((_name_or_id(each), each.text("id")) for each in points)
        for point, name in zip(points, names, strict=True):
            # An area or a stretch of the tracks is represented by its middle.
            places = [*self._spots(point), *self._stretches(point)]
            for place in places:
                at = 0.5 * (place.begin + place.end)
                self.data[place.name].stations.append(Station(name, at))
            if not places:
                self.graph.account.left_out["operational points without a place on a track"] += 1

    # ---- positioning

    def _geographic_systems(self) -> set[str]:
        """Geometric positioning systems that are WGS 84."""
        found = set()
        for each in self.root.all(
            "common", "positioning", "geometricPositioningSystems", "geometricPositioningSystem"
        ):
            if each.text("crsDefinition").rpartition(":")[2].strip() in ("4326", "CRS84", "84"):
                found.add(each.text("id"))
        return found

    def _course(self, element: _NetElement) -> Iterator[tuple[float, float, float]]:
        """Coordinates along a net element."""
        for place in element.element.all("associatedPositioningSystem", "intrinsicCoordinate"):
            share = place.number("intrinsicCoord")
            for each in place.all("geometricCoordinate"):
                if each.text("positioningSystemRef") not in self.wgs84:
                    self.graph.account.left_out[NOT_WGS84] += 1
                    continue
                yield share * element.length, each.number("y"), each.number("x")

    def _reference(self, element: _NetElement) -> LineReference | None:
        """The measures of its first linear positioning system."""
        for system, rows in element.measures.items():
            ends_known = rows[0][0] <= SAME_PLACE and rows[-1][0] >= element.length - SAME_PLACE
            if len(rows) > 1 and ends_known:
                starts = [(at, km) for at, km in rows[:-1]]
                return LineReference(
                    self._named(system, "common", "positioning", *_LINEAR),
                    np.array([at for at, _ in starts]),
                    np.array([km for _, km in starts]),
                    np.array([km for _, km in rows[1:]]),
                )
        return None

    def _account(self) -> None:
        """Count what stands in the file and not in the network."""
        counts = self.graph.account.left_out
        for container in self.infra.all("functionalInfrastructure"):
            counts.update(numbers_in(container.children, FUNCTIONS_HELD))


def _measures(element: Element) -> Iterator[tuple[str, list[tuple[float, float]]]]:
    """Share of its length and measure, by linear positioning system."""
    found: dict[str, list[tuple[float, float]]] = {}
    for place in element.all("associatedPositioningSystem", "intrinsicCoordinate"):
        for each in place.all("linearCoordinate"):
            rows = found.setdefault(each.text("positioningSystemRef"), [])
            rows.append((place.number("intrinsicCoord"), each.number("measure")))
    for system, rows in found.items():
        rows.sort()
        yield system, rows


def _extent(measures: dict[str, list[tuple[float, float]]]) -> float:
    """Length [m] by the measures of both ends; 0 where they are not known."""
    for rows in measures.values():
        if rows[0][0] == 0.0 and rows[-1][0] == 1.0:
            return abs(rows[-1][1] - rows[0][1])
    return 0.0


def _name(element: Element) -> str:
    """The name of an element, in the first language that it has one in."""
    known = element.first("name")
    return element.text("name") if known is None else known.text("name")


def _name_or_id(element: Element) -> str:
    return _name(element) or element.text("id")


def _between_neighbours(stated: list[Stretch], begin: float, end: float, kind: str) -> Stretch:
    """What lies between two stated stretches: the mean gradient, or a transition of curvature."""
    before = [each.value for each in stated if abs(each.end - begin) <= 1e-3]
    after = [each.value for each in stated if abs(each.begin - end) <= 1e-3]
    first, last = (found[0] if found else None for found in (before, after))
    if kind == "gradient":
        known = [each for each in (first, last) if each is not None]
        return Stretch(begin, end, float(np.mean(known)) if known else 0.0)
    return Stretch(begin, end, first or 0.0, last or 0.0)

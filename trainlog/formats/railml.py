"""railML 2.0 to 2.5 and 3.1 to 3.3: infrastructure as networks.

Version 2 has tracks with their topology, and elements along them: positions `pos` [m] count from a
track's beginning; `absPos` is the operator's mileage [m]; slopes in per mille and radii [m],
right-hand bends positive, as seen along the track; speeds in km/h.

Version 3 has a topology of net elements, and things located on them: a location is a net element
with intrinsic coordinates (0 at its beginning, 1 at its end), positions [m] from its beginning, or
measures of a linear positioning system. Gradients in per mille, radii [m] with right-hand bends
positive as seen along the location, speeds in km/h; x is longitude.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, ClassVar, Self
from xml.parsers import expat

import numpy as np

from trainlog.errors import InputError
from trainlog.formats.declared import built
from trainlog.formats.files import read_bytes
from trainlog.formats.tracks import (
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
    not_in_file,
)
from trainlog.railway import LineReference, Station
from trainlog.units import KMH


@dataclass(eq=False)
class Element:
    """An element of an XML file.

    Attributes
    ----------
    tag : str
        Without its namespace.
    namespace : str
    attributes : dict of str to str
    line : int
        At which it begins.
    children : list of Element
    content : str
        Text that stands directly in it.
    """

    tag: str
    namespace: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)
    content: str = ""

    def __repr__(self) -> str:
        return f"<{self.tag}> at line {self.line}, {len(self.children)} children"

    @property
    def place(self) -> str:
        """Where it stands, as errors state it."""
        own = self.attributes.get("id")
        return f"line {self.line}, {self.tag}" + (f" '{own}'" if own else "")

    def all(self, *path: str) -> Iterator[Element]:
        """Descendants by the tags that lead to them."""
        if not path:
            yield self
            return
        for child in self.children:
            if child.tag == path[0]:
                yield from child.all(*path[1:])

    def first(self, *path: str) -> Element | None:
        """The first of `all`, if there is one."""
        return next(self.all(*path), None)

    def every(self) -> Iterator[Element]:
        """The element and all that stand in it, in the order of the file."""
        todo = [self]
        while todo:
            element = todo.pop()
            yield element
            todo += reversed(element.children)

    def text(self, name: str, default: str = "") -> str:
        """An attribute, stripped."""
        return self.attributes.get(name, default).strip()

    def error(self, problem: str, remedy: str | None = None) -> InputError:
        """What is wrong with the element, with its place."""
        return InputError(problem, place=self.place, remedy=remedy)

    def number(self, name: str, default: float | None = None) -> float:
        """An attribute as a finite number.

        Raises
        ------
        InputError
            If it is none, or missing without a default.
        """
        found = self.text(name)
        if not found and default is not None:
            return default
        try:
            value = float(found)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            problem = f"{name} '{found}' is not a finite number" if found else f"has no {name}"
            raise self.error(problem, f"give {name} as a number")
        return value

    def speed(self, name: str) -> float:
        """An attribute in km/h that must be positive, as a speed limit [m/s]."""
        found = self.number(name)
        if found <= 0.0:
            raise self.error(f"{name} 0 could never be passed", "give the permitted speed")
        return found / KMH

    def missing(self, what: str, name: str) -> InputError:
        """The error for a reference to something that the file does not have."""
        return not_in_file(what, name, self.place)


def numbers_in(containers: Iterable[Element], held: Collection[str]) -> Counter[str]:
    """Numbers of what stands in containers whose tags are not among `held`, by tag."""
    counts = Counter[str]()
    for each in containers:
        if each.tag not in held:
            counts[each.tag] += len(each.children)
    return counts


def parsed_xml(data: bytes, path: str | Path) -> Element:
    """The root element of XML that stands in a file.

    Raises
    ------
    InputError
        If it is no XML, or declares entities.

    Examples
    --------
    >>> root = parsed_xml(b'<a xmlns="urn:x"><b n="2"/></a>', "small.xml")
    >>> root.tag, root.namespace, root.first("b").number("n")
    ('a', 'urn:x', 2.0)
    """
    parser = expat.ParserCreate(namespace_separator=" ")
    top = Element("", "", {}, 0)
    open_elements = [top]

    def start(name: str, attributes: dict[str, str]) -> None:
        namespace, _, tag = name.rpartition(" ")
        plain = {key.rpartition(" ")[2]: value for key, value in attributes.items()}
        element = Element(tag, namespace, plain, parser.CurrentLineNumber)
        open_elements[-1].children.append(element)
        open_elements.append(element)

    def end(_: str) -> None:
        open_elements.pop()

    def text(data: str) -> None:
        open_elements[-1].content += data

    def entity(name: str, *_: Any) -> None:
        raise InputError(
            f"declares the entity '{name}'",
            file=path,
            place=f"line {parser.CurrentLineNumber}",
            remedy="remove it: a file that grows while it is read is refused",
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = text
    parser.EntityDeclHandler = entity
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise InputError(
            f"is not XML: {expat.ErrorString(error.code)}",
            file=path,
            place=f"line {error.lineno}, column {error.offset + 1}",
            remedy="export it again; it may have been cut off",
        ) from error
    return top.children[0]


VERSIONS = {
    "2009": "2.0",
    "2011": "2.1",
    "2013": "2.2",
    "2016": "2.3",
    "2018": "2.4",
    "2021": "2.5",
}
"""Versions of railML 2 by the year in their namespace."""


def read_railml(path: str | Path, limits: LimitChoice) -> Infrastructure:
    """Read the infrastructure of a railML file, version 2 or 3, as a network.

    Tracks that follow each other without a choice are one edge. Stations are the operational points
    with a place on a track.

    Parameters
    ----------
    path : str or Path
    limits : LimitChoice
        Which of its speed limits hold.

    Raises
    ------
    InputError
        If the file is no railML 2 or 3, has no infrastructure, or no limits of a category, or
        refers to what it does not have.
    """
    root = parsed_xml(read_bytes(path), path)
    own = root.namespace.rstrip("/").rpartition("/")[2]
    version = root.text("version") or VERSIONS.get(own, own)
    if root.tag.lower() != "railml" or not version.startswith(("2.", "3.")):
        raise InputError(
            f"is not railML 2 or 3: its root is '{root.tag}'"
            + (f" of version {root.text('version')}" if root.text("version") else ""),
            file=path,
            remedy="export infrastructure as railML 2.2 to 2.5, or 3.1 to 3.3",
        )
    reader = _Railml2 if version.startswith("2") else _Railml3
    return built(lambda: reader.of(root, version, Path(path).stem).networks(limits), path)


QUALITY = "coordinates of railML"

NOT_WGS84 = "coordinates that are not those of WGS 84"
"""What is left out of a file with coordinates of another system."""

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
    first: Element
    last: Element
    begin: float
    length: float
    cuts: list[float] = field(default_factory=list)

    @property
    def ends(self) -> tuple[tuple[Element, float, TrackEnd], ...]:
        """What stands at its beginning and at its end, with the position [m] and the section."""
        begin, end = TrackEnd(self.section(0), False), TrackEnd(self.section(len(self.cuts)), True)
        return (self.first, 0.0, begin), (self.last, self.length, end)

    @property
    def edges(self) -> list[float]:
        """Positions [m] at which its sections begin and end."""
        return [0.0, *self.cuts, self.length]

    def section(self, number: int) -> str:
        """The name of a section."""
        return f"{self.name}/{number + 1}" if self.cuts else self.name

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


@dataclass
class _Railml:
    """What is known of a file while it is read.

    Attributes
    ----------
    root, infra : Element
    graph : TrackGraph
    data : dict of str to TrackData
        By the names of tracks, or of net elements.
    """

    root: Element
    infra: Element
    graph: TrackGraph
    data: dict[str, TrackData] = field(default_factory=dict)

    path: ClassVar[tuple[str, ...]]
    """To what the tracks are made of, in the infrastructure."""

    lacks: ClassVar[tuple[str, str]]
    """What is said of a file without these, and the remedy."""

    @classmethod
    def of(cls, root: Element, version: str, name: str) -> Self:
        """The file of a root element; `name` is what the network is called if it has no name."""
        infra = root.first("infrastructure")
        if infra is None or infra.first(*cls.path) is None:
            raise root.error(*cls.lacks)
        return cls(root, infra, TrackGraph(_name(infra) or name, f"railML {version}"))

    def left_out(self, what: str, number: int = 1) -> None:
        """Count what the network does not hold."""
        self.graph.account.left_out[what] += number

    def assume(self, what: str) -> None:
        """Count one of what is assumed."""
        self.graph.account.assumed[what] += 1


@dataclass
class _Railml2(_Railml):
    """What is gathered of a file's infrastructure."""

    path = ("tracks", "track")
    lacks = "has no infrastructure with tracks", "export the infrastructure with its tracks"

    tracks: list[_Track] = field(default_factory=list)
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
            first, last = (
                element.first("trackTopology", tag) for tag in ("trackBegin", "trackEnd")
            )
            if first is None or last is None:
                raise element.error(
                    "has no trackBegin and trackEnd", "give both in its trackTopology"
                )
            begin, end = first.number("pos", 0.0), last.number("pos")
            if end < begin:
                raise last.error(
                    f"ends at pos {end:g}, before it begins at {begin:g}",
                    "pos counts from the track's beginning; absPos is the mileage",
                )
            own = name if names.count(name) == 1 else element.text("id") or name
            track = _Track(element, own, first, last, begin, end - begin)
            track.cuts = sorted({track.at(each) for each in _switches(element)})
            yield track

    def _whole(self, track: _Track) -> TrackData:
        """A whole track with what lies along it."""
        return TrackData(
            name=track.name,
            length=track.length,
            gradients=self._stretches(track, "gradient", lambda each: 1e-3 * each.number("slope")),
            curves=self._curves(track),
            limits=self._limits(track),
            tunnels=list(self._tunnels(track)),
            stations=list(self._stations(track)),
            course=list(self._course(track)),
            course_quality=QUALITY,
            reference=self._reference(track),
        )

    def _changes(self, track: _Track, kind: str, both: bool = False) -> list[Element]:
        """The changes of a kind along a track; `both`: those for the other direction, too."""
        every = track.element.all("trackElements", f"{kind}Changes", f"{kind}Change")
        found = sorted(every, key=lambda each: each.number("pos"))
        used = [each for each in found if both or each.text("dir") != "down"]
        self.left_out(f"{kind}Changes of the direction down", len(found) - len(used))
        return used

    def _stretches(
        self, track: _Track, kind: str, value: Callable[[Element], float]
    ) -> list[Stretch]:
        """What holds from each change to the next."""
        used = self._changes(track, kind)
        places = [*(track.at(each) for each in used), track.length]
        return [
            Stretch(*ends, value(each)) for each, ends in zip(used, pairwise(places), strict=True)
        ]

    def _curves(self, track: _Track) -> list[Stretch]:
        """Curvature; between a transition curve's ends it changes in a straight line."""
        used = self._changes(track, "radius", both=True)
        curves = [
            each.text("geometryElementDescription").lower()
            for each in used
            if each.text("dir") != "down"
        ]
        bends = self._stretches(track, "radius", lambda each: curvature_of(each.number("radius")))
        for number, following in enumerate(bends[1:]):
            if any(word in curves[number] for word in TRANSITIONS):
                # A transition that begins on straight track has the radius 0 there.
                bends[number] = bends[number]._replace(last=following.value)
        return bends

    def _limits(self, track: _Track) -> list[Limit]:
        """Limits by direction, each from its change to the next of the same trains.

        A change without a direction, which the schema allows and which then is not known, counts
        in both: along the track among those of "up", against it up to the next without one. Where
        one of "down" holds as well, the lower of both does.
        """
        found = list[Limit]()
        changes: dict[tuple[str, str], list[Element]] = {}
        for each in self._changes(track, "speed", both=True):
            stated, category = each.text("dir"), self._category(each)
            if stated not in ("up", "down"):
                changes.setdefault(("", category), []).append(each)
                if stated != "both":
                    self.assume(UNDIRECTED)
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
                self.left_out("tunnels without a length")
                continue
            section = each.number("crossSection", 0.0)
            begin = track.at(each)
            yield Stretch(begin, begin + length, section if section > 0.0 else np.nan)

    def _stations(self, track: _Track) -> Iterator[Station]:
        """Operation control points on the track, by its cross-sections and its ends."""
        for each in track.element.all("trackTopology", "crossSections", "crossSection"):
            if each.text("ocpRef"):
                yield Station(self._ocp_name(each), track.at(each))
        for place, at, _ in track.ends:
            for node in place.all("macroscopicNode"):
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
                    self.left_out(NOT_WGS84)
                    continue
                try:
                    latitude, longitude = float(words[0]), float(words[1])
                except ValueError:
                    raise coordinate.error(
                        f"coord '{coordinate.text('coord')}' is not a latitude and longitude",
                        "give two numbers in degrees",
                    ) from None
                yield at, latitude, longitude

    def _reference(self, track: _Track) -> LineReference | None:
        """The operator's mileage by absPos of the track's ends and its mileage changes."""
        first, last = track.first, track.last
        if not (first.text("absPos") and last.text("absPos")) or track.length <= SAME_PLACE:
            return None
        changes = sorted(
            track.element.all("trackTopology", "mileageChanges", "mileageChange"),
            key=lambda each: each.number("pos"),
        )
        starts = [0.0, *(track.at(each) for each in changes), track.length]
        km = [each.number("absPos") for each in (first, *changes, last)]
        ends = [*(each.number("absPosIn", np.inf) for each in changes), km[-1]]
        sign = -1.0 if km[-1] < km[0] else 1.0
        rows = dict[float, tuple[float, float, float]]()
        for (at, stop), begin, end in zip(pairwise(starts), km, ends, strict=False):
            if stop > at:
                rows[at] = at, begin, begin + sign * (stop - at) if end == np.inf else end
        line = self.lines.get(track.element.text("id"))
        name = (line.text("name") or line.text("id")) if line is not None else track.name
        return LineReference(name, *np.array([rows[at] for at in sorted(rows)]).T)

    # ---- topology

    def _connect(self) -> None:
        """Movements between tracks, by the connections that name each other."""
        macroscopic = dict[str, list[TrackEnd]]()
        for track in self.tracks:
            for place, _, end in track.ends:
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
        kind = switch.text("type", "simpleCrossing")
        if switch.tag == "crossing" and kind == "simpleSwitchCrossing":
            self.left_out("single slips, held as crossings without a slip")
        connected = switch.tag == "switch" or kind == "doubleSwitchCrossing"
        for way, end in (("incoming", after), ("outgoing", before)):
            for each in branches[way]:
                self._add_side(each, [end] if connected else [])
        if switch.tag == "crossing":
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
                self.assume("tracks with a main direction, over which trains may run both ways")
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


@dataclass
class _Railml3(_Railml):
    """What is gathered of a file."""

    path = ("topology", "netElements", "netElement")
    lacks = (
        "has no infrastructure with a topology of net elements",
        "export the infrastructure with its topology",
    )

    elements: dict[str, _NetElement] = field(default_factory=dict)
    others: set[str] = field(default_factory=set)
    wgs84: set[str] = field(default_factory=set)

    def networks(self, limits: LimitChoice) -> Infrastructure:
        """The networks of the whole."""
        self.wgs84 = self._geographic_systems()
        self._find_elements()
        for name, each in self.elements.items():
            self.data[name] = TrackData(
                name,
                each.length,
                course=list(self._course(each)),
                course_quality=QUALITY,
                reference=self._reference(each),
            )
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
                self.assume("relations of one direction, over which trains may run both ways")
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
                self.left_out("locations on net elements that are not held")
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
                    self.left_out("locations on net elements that are not held")
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
        for name, most, slack, unit in (
            (f"intrinsicCoord{word}", 1.0, 1e-6, element.length),
            (f"pos{word}", element.length, 1.0, 1.0),
        ):
            if location.text(name):
                value = location.number(name)
                if not -slack <= value <= most + slack:
                    raise location.error(
                        f"{name} {value:g} is not from 0 to {most:g}",
                        "give the share of the length of its net element, or the position on it",
                    )
                return float(np.clip(value, 0.0, most)) * unit
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
                counts["overCrossings that are not tunnels"] += 1
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
                self.left_out("operational points without a place on a track")

    # ---- positioning

    def _geographic_systems(self) -> set[str]:
        """Geometric positioning systems that are WGS 84."""
        systems = ("geometricPositioningSystems", "geometricPositioningSystem")
        return {
            each.text("id")
            for each in self.root.all("common", "positioning", *systems)
            if each.text("crsDefinition").rpartition(":")[2].strip() in ("4326", "CRS84", "84")
        }

    def _course(self, element: _NetElement) -> Iterator[tuple[float, float, float]]:
        """Coordinates along a net element."""
        for place in element.element.all("associatedPositioningSystem", "intrinsicCoordinate"):
            share = place.number("intrinsicCoord")
            for each in place.all("geometricCoordinate"):
                if each.text("positioningSystemRef") not in self.wgs84:
                    self.left_out(NOT_WGS84)
                    continue
                yield share * element.length, each.number("y"), each.number("x")

    def _reference(self, element: _NetElement) -> LineReference | None:
        """The measures of its first linear positioning system."""
        for system, rows in element.measures.items():
            at, km = np.array(rows).T
            if len(rows) > 1 and at[0] <= SAME_PLACE and at[-1] >= element.length - SAME_PLACE:
                name = self._named(system, "common", "positioning", *_LINEAR)
                return LineReference(name, at[:-1], km[:-1], km[1:])
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

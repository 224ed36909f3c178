"""Tracks of an infrastructure file: what lies along each, and the network that they make.

`TrackData.line` makes a line of what a file states of a track; `TrackGraph` joins lines to a
network, in which tracks that follow each other without a choice are one edge. An `Account` states
the rest of the file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, combinations
from typing import NamedTuple

import numpy as np

from trainlog.arrays import BoolArray, FloatArray
from trainlog.errors import InputError
from trainlog.railway import CurvatureProfile, Line, LineReference, Station, StepProfile, Tunnel
from trainlog.railway.line import Geometry, composed
from trainlog.railway.network import (
    AT_END,
    Edge,
    Network,
    Node,
    NodeKind,
    assumed_on,
    connected,
    unused,
)
from trainlog.units import KMH

ASSUMED_LIMIT = 80.0 / KMH
"""Speed limit [m/s] of a file that states none at all."""

NO_CATEGORY = "none"
"""What chooses the speed limits for all trains alone."""

ASSUMED_SECTION = 50.0
"""Cross-section [m²] of a tunnel that a file states none of: one track's, whose resistance is
greater than that of the wider ones of two."""

SAME_PLACE = 1e-6
"""Positions [m] that lie nearer together are one: files have rounded sums."""


def not_in_file(what: str, name: str, place: str | None = None) -> InputError:
    """The error for a reference to something that the file does not have."""
    return InputError(
        f"refers to the {what} '{name}', which the file does not have",
        place=place,
        remedy=f"add the {what}, or correct the reference",
    )


def curvature_of(radius: float) -> float:
    """Curvature [1/m] of a radius [m]; a radius of 0 is that of straight track.

    Examples
    --------
    >>> curvature_of(500.0), curvature_of(0.0)
    (0.002, 0.0)
    """
    return 1.0 / radius if radius else 0.0


def distinct_names(named: Iterable[tuple[str, str]]) -> list[str]:
    """Names of things with their ids; those that share a name have their id in it.

    Examples
    --------
    >>> distinct_names([("Wil", "a"), ("Gossau", "b"), ("Wil", "c")])
    ['Wil (a)', 'Gossau', 'Wil (c)']
    """
    pairs = list(named)
    count = Counter(name for name, _ in pairs)
    return [name if count[name] == 1 else f"{name} ({own})" for name, own in pairs]


class Limit(NamedTuple):
    """A speed limit from `begin` to `end` [m] of a track.

    Attributes
    ----------
    begin, end : float [m]
    speed : float [m/s]
    forward, against : bool
        Whether it holds for trains along the track, and against it.
    category : str
        Of the trains that it holds for; empty: all.
    """

    begin: float
    end: float
    speed: float
    forward: bool = True
    against: bool = True
    category: str = ""


@dataclass(frozen=True)
class LimitChoice:
    """Which of a file's speed limits a network takes over.

    Attributes
    ----------
    category : str or None
        Of trains: their limits, elsewhere those for all trains; ``"none"``: those for all trains
        alone. None: the lowest of all categories.
    assumed : float [m/s] or None
        Where the file states none; None: the lowest of those that are chosen.
    """

    category: str | None = None
    assumed: float | None = None

    def among(self, tracks: Iterable[TrackData], account: Account) -> LimitChoice:
        """The choice for a file, with what is assumed where it states no limit.

        Raises
        ------
        InputError
            If the file has no limits of the category.

        Examples
        --------
        >>> limits = [Limit(0.0, 500.0, 20.0), Limit(0.0, 500.0, 15.0, category="freight")]
        >>> tracks, account = [TrackData("T1", 500.0, limits=limits)], Account()
        >>> LimitChoice().among(tracks, account).assumed, LimitChoice("none").among(
        ...     tracks, account
        ... ).assumed
        (15.0, 20.0)
        >>> account.assumed_words()
        ['the lowest speed limits of all categories of trains hold for all (freight): 1']
        """
        every = [each for track in tracks for each in track.limits]
        known = sorted({each.category for each in every} - {""})
        if self.category not in (None, NO_CATEGORY, *known):
            raise InputError(
                f"states no speed limits of the category '{self.category}'",
                remedy=f"it has {', '.join(known) or 'no categories'}; '{NO_CATEGORY}' takes those"
                " for all trains",
            )
        if known and self.category is None:
            names = ", ".join(known)
            account.assumed[
                f"the lowest speed limits of all categories of trains hold for all ({names})"
            ] += len(known)
        others = [name for name in known if self.category not in (None, name)]
        account.left_out[f"speed limits of other categories of trains ({', '.join(others)})"] += (
            len(others)
        )
        stated = [each.speed for each in every if self.takes(each)]
        lowest = min(stated, default=ASSUMED_LIMIT)
        return replace(self, assumed=lowest if self.assumed is None else self.assumed)

    def takes(self, limit: Limit) -> bool:
        """Whether a limit may hold."""
        return self.category is None or limit.category in ("", self.category)


EVERY_LIMIT = LimitChoice()
"""The lowest of all limits holds."""


class Stretch(NamedTuple):
    """What holds from `begin` to `end` [m] of a track; `last` at its end where it varies."""

    begin: float
    end: float
    value: float
    last: float | None = None


class Infrastructure(NamedTuple):
    """What a file of infrastructure became.

    Attributes
    ----------
    networks : list of Network
        One, but for tracks that nothing connects to the others: each part a network of its own.
    left_out : list of str
        What of the file they hold in part or not at all, with numbers, in words.
    assumed : list of str
        What the file leaves open and was assumed, with numbers, in words.
    """

    networks: list[Network]
    left_out: list[str]
    assumed: list[str]


@dataclass
class Account:
    """What of a file a network does not hold, and what was assumed.

    Attributes
    ----------
    left_out : Counter of str
        Numbers of what is held in part or not at all, in the plural: ``"signals"``; 0: what has
        none.
    assumed : Counter of str
        Numbers of what assumptions are of, in the plural.
    lengths : dict of (str, str) to float
        Length of track [m] that an assumption is of, by the field of a line that it fills, and a
        sentence.
    """

    left_out: Counter[str] = field(default_factory=Counter)
    assumed: Counter[str] = field(default_factory=Counter)
    lengths: dict[tuple[str, str], float] = field(default_factory=dict)

    def assume(self, filled: str, sentence: str, length: float) -> None:
        """Add a length [m] to what a sentence states of a field of a line."""
        self.lengths[filled, sentence] = self.lengths.get((filled, sentence), 0.0) + length

    def assumed_words(self, networks: Sequence[Network] = ()) -> list[str]:
        """What is assumed, in words, and on which edges of networks as `show` has it.

        Examples
        --------
        >>> account = Account()
        >>> account.assumed["relations of one direction"] += 2
        >>> account.assume("gradients", "level where no gradients are stated", 1_500.0)
        >>> account.assumed_words()
        ['relations of one direction: 2', 'level where no gradients are stated: 1.500 km of track']
        """
        words = [f"{what}: {number}" for what, number in self.assumed.items() if number]
        for (filled, sentence), length in self.lengths.items():
            edges = [edge for each in networks for edge in each.assumed.get(filled, ())]
            where = f", {assumed_on(edges)}" if edges else ""
            words.append(f"{sentence}: {length / 1e3:.3f} km of track{where}")
        return words

    def of(self, networks: list[Network]) -> Infrastructure:
        """The networks that a file became, with this account of it."""
        left_out = [f"{what}: {number}" for what, number in self.left_out.items() if number]
        return Infrastructure(networks, left_out, self.assumed_words(networks))


LEVEL = "level where no gradients are stated"
"""What is assumed of track without gradients, unless it is known to be so."""

UNLIKE_KILOMETRES = 0.2
"""Share of the length of a track by which its kilometres may differ from it without a word."""


@dataclass
class TrackData:
    """What a file states of a track, by position [m] from its beginning.

    Attributes
    ----------
    name : str
    length : float [m]
    gradients, curves : list of Stretch
        Rise over run; curvature [1/m]. Of stretches that overlap the later one holds.
    limits : list of Limit
        Of those that overlap the lowest holds, but that of a category goes before that for all.
    tunnels : list of Stretch
        Cross-section [m²]; NaN where it is not stated.
    stations : list of Station
    course : list of (position, latitude, longitude)
    course_quality : str
    reference : LineReference or None
    level_between : bool
        Whether the track is level where no gradient is stated, if any is.
    """

    name: str
    length: float
    gradients: list[Stretch] = field(default_factory=list)
    curves: list[Stretch] = field(default_factory=list)
    limits: list[Limit] = field(default_factory=list)
    tunnels: list[Stretch] = field(default_factory=list)
    stations: list[Station] = field(default_factory=list)
    course: list[tuple[float, float, float]] = field(default_factory=list)
    course_quality: str = ""
    reference: LineReference | None = None
    level_between: bool = False

    def line(self, account: Account, choice: LimitChoice) -> Line:
        """The track as a line."""
        assumed = []
        at, values = self._laid("gradients", self.gradients, account)[:2]
        unknown = np.isnan(values) if self.gradients or not self.level_between else ~np.isfinite(at)
        missing = float(np.diff(np.append(at, self.length))[unknown].sum())
        if not self.gradients or (missing > 1.0 and not self.level_between):
            assumed.append("gradients")
            account.assume("gradients", LEVEL, missing or self.length)
        gradients = _steps(at, np.where(np.isnan(values), 0.0, values))
        limits, against, unknown_limits = self._limits(account, choice)
        if unknown_limits:
            assumed.append("speed_limits")
        at, first, last = self._laid("curves", self.curves, account)
        curves = CurvatureProfile(at, np.nan_to_num(first), np.nan_to_num(last))
        tunnels = self._tunnels(account)
        if any(np.isnan(each.value) for each in self.tunnels):
            assumed.append("tunnel_cross_sections")
        if (known := self.reference) is not None:
            long = np.diff(known.positions, append=self.length)
            off = np.abs(np.abs(known.end - known.start) - long)
            if np.any(off > np.maximum(UNLIKE_KILOMETRES * long, AT_END)):
                account.assumed["tracks whose kilometres do not fit their length, as stated"] += 1
        return Line(
            name=self.name,
            length=self.length,
            stations=tuple(sorted(self.stations, key=lambda each: each.position)),
            speed_limits=limits,
            gradients=gradients,
            curvatures=curves if self.curves else None,
            tunnels=tunnels,
            geometry=self._geometry(),
            assumed=tuple(assumed),
            reference=self.reference,
            speed_limits_reverse=None if against == limits else against,
        )

    def _limits(
        self, account: Account, choice: LimitChoice
    ) -> tuple[StepProfile, StepProfile, bool]:
        """Limits along the track and against it, and whether a part of them is assumed."""
        assert choice.assumed is not None
        chosen = self._within(
            "limits", [Stretch(each.begin, each.end, each.speed) for each in self.limits], account
        )
        edges = self._edges(chosen)
        found, unknown = list[StepProfile](), list[BoolArray]()
        for way in ("forward", "against"):
            mine = [x for x in self.limits if choice.takes(x) and getattr(x, way)]
            values = self._lowest([x for x in mine if choice.category in (None, x.category)], edges)
            for_all = self._lowest([x for x in mine if not x.category], edges)
            values = np.where(np.isnan(values), for_all, values)
            unknown.append(np.isnan(values))
            found.append(_steps(edges[:-1], np.where(unknown[-1], choice.assumed, values)))
        words = f"{KMH * choice.assumed:.0f} km/h where no speed limits are stated"
        both, one = unknown[0] & unknown[1], unknown[0] ^ unknown[1]
        for which, where in ((both, ""), (one, " for one direction")):
            if which.any():
                account.assume("speed_limits", words + where, float(np.diff(edges)[which].sum()))
        return found[0], found[1], bool(both.any() or one.any())

    def _tunnels(self, account: Account) -> tuple[Tunnel, ...]:
        """The tunnels, those without a cross-section with `ASSUMED_SECTION`."""
        unknown = [bool(np.isnan(each.value)) for each in self.tunnels]
        given = [
            each._replace(value=ASSUMED_SECTION) if lacks else each
            for each, lacks in zip(self.tunnels, unknown, strict=True)
        ]
        at, sections = self._laid("tunnels", given, account)[:2]
        account.assumed[
            f"tunnels whose cross-section is not stated, taken as {ASSUMED_SECTION:g} m²"
        ] += sum(unknown)
        ends = np.append(at[1:], self.length)
        return tuple(
            Tunnel(float(begin), float(end - begin), float(section))
            for begin, end, section in zip(at, ends, sections, strict=True)
            if np.isfinite(section)
        )

    @staticmethod
    def _lowest(limits: Sequence[Limit], edges: FloatArray) -> FloatArray:
        """The lowest limit of each piece between edges [m/s]; NaN without any."""
        middle = 0.5 * (edges[:-1] + edges[1:])
        values = np.full(middle.size, np.nan)
        for each in limits:
            inside = (middle > each.begin) & (middle < each.end)
            values[inside] = np.fmin(values[inside], each.speed)
        return values

    def _within(self, what: str, stretches: Sequence[Stretch], account: Account) -> list[Stretch]:
        """The stretches that lie on the track; those that reach beyond it are counted."""
        found = list[Stretch]()
        for each in stretches:
            begin, end = max(each.begin, 0.0), min(each.end, self.length)
            if begin > each.begin + SAME_PLACE or end < each.end - SAME_PLACE:
                account.left_out[f"{what} that reach beyond their track, cut off there"] += 1
            if end - begin > SAME_PLACE:
                found.append(each)
        return found

    def _edges(self, stretches: Sequence[Stretch]) -> FloatArray:
        """Positions [m] at which something begins or ends, both ends of the track included."""
        ends = [0.0, self.length, *(x for each in stretches for x in (each.begin, each.end))]
        edges = np.unique(np.clip(ends, 0.0, self.length))
        edges = np.append(edges[:-1][np.diff(edges) > SAME_PLACE], self.length)
        edges[0] = 0.0
        return edges

    def _laid(
        self, what: str, given: Sequence[Stretch], account: Account
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Starts of pieces and what holds at their starts and ends; NaN where nothing is stated."""
        stretches = self._within(what, given, account)
        edges = self._edges(stretches)
        first, last = (np.full(edges.size - 1, np.nan) for _ in range(2))
        middle = 0.5 * (edges[:-1] + edges[1:])
        over = np.zeros(middle.size, dtype=np.int64)
        for each in stretches:
            inside = (middle > each.begin) & (middle < each.end)
            over += inside
            rate = ((each.value if each.last is None else each.last) - each.value) / (
                each.end - each.begin
            )
            first[inside] = each.value + rate * (edges[:-1] - each.begin)[inside]
            last[inside] = each.value + rate * (edges[1:] - each.begin)[inside]
        if np.any(over > 1):
            account.assumed[f"tracks with {what} that contradict each other, the later taken"] += 1
        return edges[:-1], first, last

    def _geometry(self) -> Geometry | None:
        points = {position: (latitude, longitude) for position, latitude, longitude in self.course}
        if len(points) < 2:
            return None
        at = sorted(points)
        coordinates = np.array([points[each] for each in at])
        return Geometry(np.array(at), coordinates[:, 0], coordinates[:, 1], self.course_quality)


def _steps(positions: FloatArray, values: FloatArray) -> StepProfile:
    """A profile without steps to the same value."""
    kept = np.append(True, np.diff(values) != 0.0)
    return StepProfile(positions[kept], values[kept])


# -------------------------------------------------------------------------- tracks as a network


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

    def whole(
        self,
        tracks: Mapping[str, TrackData],
        limits: LimitChoice,
        sections: Mapping[str, dict[str, tuple[float, float]]] | None = None,
    ) -> Infrastructure:
        """The networks of tracks, some cut into `sections` [m], and the account of their file.

        Sections without a length are left out: what they would join is.
        """
        chosen = limits.among(tracks.values(), self.account)
        for name, track in tracks.items():
            line = None if track.length <= SAME_PLACE else track.line(self.account, chosen)
            parts = (sections or {}).get(name, {name: (0.0, track.length)})
            for own, (start, end) in parts.items():
                if line is None or end - start <= SAME_PLACE:
                    self._pass_through(own)
                else:
                    whole = start == 0.0 and end == track.length
                    self._add(own, line if whole else line.section(start, end))
        return self.account.of(self.networks())

    def _add(self, name: str, line: Line) -> None:
        """Add a track, with the coordinates of its ends."""
        assumed = any(each.cross_section == ASSUMED_SECTION for each in line.tunnels)
        kept = tuple(x for x in line.assumed if assumed or x != "tunnel_cross_sections")
        self.tracks[name] = replace(line, name=name, assumed=kept)
        course = line.geometry
        for at_end, index, end in ((False, 0, 0.0), (True, -1, line.length)):
            if course is not None and abs(course.positions[index] - end) <= AT_END:
                corner = float(course.latitudes[index]), float(course.longitudes[index])
                self.corners.setdefault(TrackEnd(name, at_end), corner)

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
        at = {
            end: joined_name([each.track for each in chain])
            for chain in chains
            for end in (chain[0], chain[-1].other)
        }
        meeting = [(end, each) for end in at for each in near[end] if each in at]
        node_of = self._names([sorted(group) for group in connected(at, meeting)])
        edges = []
        for chain in chains:
            name = at[chain[0]]
            lines = [
                self.tracks[end.track].reversed() if end.at_end else self.tracks[end.track]
                for end in chain
            ]
            ends = node_of[chain[0]], node_of[chain[-1].other]
            edges.append(Edge(name, joined(lines, name, self.source), *ends))
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
                name = unused(" + ".join(dict.fromkeys(known)) or own, taken)
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
        ends = [(edge.start, edge.end) for edge in edges]
        groups = connected(dict.fromkeys(name for pair in ends for name in pair), ends)
        own = [[edge for edge in edges if edge.start in group] for group in map(set, groups)]
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
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> both = joined([line.section(0.0, 4e3), line.section(4e3, line.length)], "again", "")
    >>> both.length, bool(both.gradient(20e3) == line.gradient(20e3))
    (29556.1, True)
    """
    if len(lines) == 1:
        return replace(lines[0], name=name, source=source)
    begins = accumulate((line.length for line in lines), initial=0.0)
    placed = list(zip(begins, lines, strict=False))
    return replace(composed(name, placed), source=source)


def _station_at(end: TrackEnd, tracks: dict[str, Line]) -> str:
    """The station that stands at an end of an edge; empty without."""
    track = tracks[end.track]
    place = track.length if end.at_end else 0.0
    near = (each.name for each in track.stations if abs(each.position - place) <= AT_END)
    return next(near, "")


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

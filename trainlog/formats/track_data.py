"""What an infrastructure file states of its tracks, laid along each; and an account of the rest.

Lines come of it, `TrackData.line`, of which `trainlog.formats.track_graph` makes networks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from trainlog.arrays import BoolArray, FloatArray
from trainlog.errors import InputError
from trainlog.railway import CurvatureProfile, Line, LineReference, Station, StepProfile, Tunnel
from trainlog.railway.line import Geometry
from trainlog.railway.network import Network, assumed_on
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


NOT_WGS84 = "coordinates that are not those of WGS 84"
"""What is left out of a file with coordinates of another system."""


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

    @property
    def left_out_words(self) -> list[str]:
        """What is left out, in words."""
        return [f"{what}: {number}" for what, number in self.left_out.items() if number]

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
        return Infrastructure(networks, self.left_out_words, self.assumed_words(networks))


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
        missing = self._missing(at, unknown)
        if not self.gradients or (missing > 1.0 and not self.level_between):
            assumed.append("gradients")
            account.assume(
                "gradients", "level where no gradients are stated", missing or self.length
            )
        gradients = _steps(at, np.where(np.isnan(values), 0.0, values))
        limits, against, unknown_limits = self._limits(account, choice)
        if unknown_limits:
            assumed.append("speed_limits")
        at, first, last = self._laid("curves", self.curves, account)
        curves = CurvatureProfile(at, np.nan_to_num(first), np.nan_to_num(last))
        tunnels = self._tunnels(account)
        if any(np.isnan(each.value) for each in self.tunnels):
            assumed.append("tunnel_cross_sections")
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
        at, sections = self._laid(
            "tunnels",
            [
                each._replace(value=ASSUMED_SECTION) if np.isnan(each.value) else each
                for each in self.tunnels
            ],
            account,
        )[:2]
        unknown = sum(bool(np.isnan(each.value)) for each in self.tunnels)
        account.assumed[
            f"tunnels whose cross-section is not stated, taken as {ASSUMED_SECTION:g} m²"
        ] += unknown
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

    def _missing(self, at: FloatArray, unknown: BoolArray) -> float:
        """Length [m] of the pieces that are not known."""
        return float(np.diff(np.append(at, self.length))[unknown].sum())

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

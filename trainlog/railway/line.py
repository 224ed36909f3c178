"""A line: what lies under the train as a function of chainage.

Chainage `s` [m] runs from 0 to the line's length in the direction of travel; `Line.reversed`
gives the same line travelled the other way, `Line.section` a part of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray, IntArray, numbered
from trainlog.declaration import (
    INFINITY,
    POSITIVE,
    POSITIVE_FINITE,
    Column,
    Declared,
    Named,
    Part,
    Quantity,
    Table,
    Text,
)
from trainlog.display import counted, span
from trainlog.errors import InputError
from trainlog.railway.resistance import (
    CURVE_FORMULAS,
    LEAST_RADIUS,
    CurveFormula,
    curve_coefficients,
    curve_force_per_weight,
    specific_curve_resistance,
)
from trainlog.units import GRAVITY, KMH

TINY = 1e-6
"""Pieces that are shorter [m] do not come of a cut: positions are rounded to less."""


AT_JOINT = 1.0
"""Stations of one name that lie so near [m] where lines meet are one."""

POSITION = Column("position", "m", "m")
"""The first column of tables along a line."""


def _radius(end: str) -> Column:
    """The column of the radii at one end of each element."""
    return Column(f"radius_at_{end}", "m", "m", INFINITY, inverse=True)


class Profile(Declared):
    """A function along a line: elements, in each of which it changes in a straight line or not.

    Attributes
    ----------
    positions : (n,) array [m]
        Where each element begins; strictly increasing, the first is 0.
    start, end : (n,) array
        Values at the start and at the end of each element.
    """

    __slots__ = ()

    PLACE: ClassVar[str] = "values"
    """Of the rows in the file."""

    TURNED: ClassVar[float] = 1.0
    """Factor of the values as seen from the other end of the line."""

    positions: FloatArray
    start: FloatArray
    end: FloatArray

    def problems(self) -> Iterator[InputError]:
        """What no profile can be."""
        yield from _disorder(self.PLACE, self.positions, self.start, self.end)

    def with_rows(self, positions: FloatArray, start: FloatArray, end: FloatArray) -> Self:
        """The profile with other elements."""
        return replace(self, positions=positions, start=start, end=end)  # type: ignore[type-var]

    def ends(self, length: float = np.inf) -> FloatArray:
        """Where each element ends [m] on a line of `length` [m]; (n,)."""
        return np.append(self.positions[1:], max(length, float(self.positions[-1])))

    def element_at(self, position: ArrayLike) -> IntArray:
        """Number of the element that holds each position [m]; ends are extended."""
        return np.maximum(np.searchsorted(self.positions, position, side="right") - 1, 0)

    def at(self, position: ArrayLike, length: float) -> FloatArray:
        """The value at each position of a line of `length` [m]; ends are extended."""
        s = np.asarray(position, dtype=np.float64)
        index = self.element_at(s)
        width = np.maximum(self.ends(length) - self.positions, 1e-9)
        share = np.clip((s - self.positions[index]) / width[index], 0.0, 1.0)
        return np.asarray(self.start[index] + share * (self.end[index] - self.start[index]))

    def reversed(self, length: float, sign: float | None = None) -> Self:
        """The profile seen from the other end of a line of `length` [m], its values times `sign`.

        Without a sign they are what is the same in both directions of travel (`TURNED`).
        """
        factor = self.TURNED if sign is None else sign
        ends = np.append(self.positions[1:], length)
        return self.with_rows(
            (length - ends)[::-1], factor * self.end[::-1], factor * self.start[::-1]
        )

    def between(self, start: float, end: float, length: float = np.inf) -> Self:
        """The profile from `start` to `end` [m] of a line of `length` [m], counted from `start`.

        Examples
        --------
        >>> part = StepProfile([0.0, 500.0], [20.0, 30.0]).between(400.0, 900.0)
        >>> part.positions.tolist(), part.values.tolist()
        ([0.0, 100.0], [20.0, 30.0])
        """
        ends = self.ends(length)
        kept = (ends > start + TINY) & (self.positions < end - TINY)
        positions, ends, first, last = (
            each[kept] for each in (self.positions, ends, self.start, self.end)
        )
        cut = positions - start
        cut[0] = 0.0
        if self.start is not self.end:
            width, change = np.maximum(ends - positions, 1e-9), last - first
            last = np.where(ends <= end, last, first + (end - positions) / width * change)
            first = first + np.maximum(start - positions, 0.0) / width * change
        return self.with_rows(cut, first, last)

    @classmethod
    def joined(cls, parts: Sequence[tuple[float, Self]]) -> Self:
        """Profiles that follow each other, each with the position [m] at which it begins.

        Examples
        --------
        >>> limit = StepProfile([0.0], [20.0])
        >>> StepProfile.joined([(0.0, limit), (500.0, limit)]).positions.tolist()
        [0.0, 500.0]
        """
        return parts[0][1].with_rows(
            np.concatenate([at + each.positions for at, each in parts]),
            np.concatenate([each.start for _, each in parts]),
            np.concatenate([each.end for _, each in parts]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class StepProfile(Profile):
    """A piecewise constant quantity: each value holds from its position to the next.

    Attributes
    ----------
    positions : (n,) array [m]
        Strictly increasing, the first is 0.
    values : (n,) array

    Examples
    --------
    >>> limits = StepProfile([0.0, 500.0], [20.0, 30.0])
    >>> limits([100.0, 500.0, 900.0])
    array([20., 30., 30.])
    """

    positions: FloatArray
    values: FloatArray

    @property
    def start(self) -> FloatArray:  # type: ignore[override]
        """The values: they stay as they begin."""
        return self.values

    end = start

    def with_rows(self, positions: FloatArray, start: FloatArray, end: FloatArray) -> Self:  # noqa: ARG002
        """The profile with other elements; their values are those at the start."""
        return replace(self, positions=positions, values=start)

    def __repr__(self) -> str:
        low, high = float(self.values.min()), float(self.values.max())
        return f"StepProfile of {counted(self.values.size, 'step')}, {low:g} to {high:g}"

    def __call__(self, position: ArrayLike) -> FloatArray:
        """Value at each position; ends are extended."""
        return np.asarray(self.values[self.element_at(position)])

    def integral(self, position: ArrayLike, at_start: float = 0.0) -> FloatArray:
        """Integral from the line's start to each position [m], `at_start` added.

        Examples
        --------
        >>> StepProfile([0.0, 100.0], [20.0, 30.0]).integral([50.0, 150.0]).tolist()
        [1000.0, 3500.0]
        """
        s, edges, values = np.asarray(position, np.float64), self.positions, self.values
        at_edges = at_start + np.concatenate(([0.0], np.cumsum(values[:-1] * np.diff(edges))))
        index = self.element_at(s)
        return np.asarray(at_edges[index] + values[index] * (s - edges[index]))

    def mean(self, start: FloatArray, end: FloatArray) -> FloatArray:
        """Mean value over each interval from `start` to `end` [m], (m,) arrays, start < end.

        Examples
        --------
        >>> import numpy as np
        >>> profile = StepProfile(np.array([0.0, 100.0]), np.array([20.0, 30.0]))
        >>> profile.mean(np.array([50.0]), np.array([150.0])).tolist()
        [25.0]
        """
        return np.asarray((self.integral(end) - self.integral(start)) / (end - start))


@dataclass(frozen=True, slots=True, eq=False)
class CurvatureProfile(Profile):
    """Signed track curvature: circular arcs and, between them, linear transitions.

    Positive curvature bends to the right in the direction of travel; seen from the other end of the
    line it is a bend to the left.

    Attributes
    ----------
    positions : (n,) array [m]
        Start of each element; strictly increasing, the first is 0.
    start, end : (n,) array [1/m]
        Curvature at the start and at the end of each element.

    Examples
    --------
    >>> curve = CurvatureProfile([0.0, 100.0, 200.0], [0.0, 0.0, 2e-3], [0.0, 2e-3, 2e-3])
    >>> curve.at([50.0, 150.0, 250.0], 300.0)
    array([0.   , 0.001, 0.002])
    """

    TURNED: ClassVar[float] = -1.0

    positions: Annotated[FloatArray, POSITION]
    start: Annotated[FloatArray, _radius("start")]
    end: Annotated[FloatArray, _radius("end")]

    @property
    def words(self) -> str:
        """The least radius; ``"straight"`` where there is none."""
        least = self.least_radius
        return f"radius {least:.0f} m at least" if np.isfinite(least) else "straight"

    @property
    def least_radius(self) -> float:
        """Of the sharpest curve [m]; infinite where the track is straight."""
        sharpest = float(np.max(np.abs((self.start, self.end))))
        return 1.0 / sharpest if sharpest > 0.0 else np.inf

    def __repr__(self) -> str:
        return f"CurvatureProfile of {counted(self.start.size, 'element')}, {self.words}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LineReference(Profile):
    """How the operator of a line calls it and counts its kilometres.

    Kilometres may run against the chainage, and jump where the line was rebuilt.

    Attributes
    ----------
    name : str
        Of the line, often a number.
    positions : (n,) array [m]
        Chainage at which each piece starts; strictly increasing, the first is 0.
    start, end : (n,) array [m]
        The operator's kilometre at the start and at the end of each piece, in metres.

    Examples
    --------
    A line counted downwards from km 61.2, with a jump:

    >>> reference = LineReference("850", [0.0, 500.0], [61_200.0, 60_500.0], [60_700.0, 60_000.0])
    >>> reference.at([0.0, 250.0, 750.0], 1_000.0)
    array([61200., 60950., 60250.])
    """

    PLACE: ClassVar[str] = "kilometres.values"

    name: Annotated[str, Text(least=1)]
    positions: Annotated[FloatArray, Column("position", "m", "m", table="kilometres")]
    start: Annotated[FloatArray, Column("km_at_start", "km", "m", table="kilometres")]
    end: Annotated[FloatArray, Column("km_at_end", "km", "m", table="kilometres")]


def _disorder(place: str, positions: FloatArray, *columns: FloatArray) -> Iterator[InputError]:
    """What rows along a line cannot be, which increase from position 0."""
    if positions.ndim != 1 or any(each.shape != positions.shape for each in columns):
        yield InputError(
            "needs as many positions as values", place=place, remedy="give one value per position"
        )
    elif not all(np.all(np.isfinite(each)) for each in (positions, *columns)):
        yield InputError(
            "positions and values must be finite numbers",
            place=place,
            remedy="replace what is not a number",
        )
    else:
        if positions.size == 0 or positions[0] != 0.0:
            yield InputError(
                "the first row is not at position 0",
                place=place,
                remedy="give what holds from the line's start",
            )
        for row in np.flatnonzero(np.diff(positions) <= 0.0):
            yield InputError(
                f"position {positions[row + 1]:.12g} m follows {positions[row]:.12g} m",
                place=f"{place}[{row + 1}]",
                remedy="positions must increase",
            )


Metres = Annotated[float, Quantity("m", "m")]


@dataclass(frozen=True, slots=True)
class Tunnel(Declared):
    """A tunnel from `position` over `length` [m] with a `cross_section` [m²].

    Examples
    --------
    >>> tunnel = Tunnel(position=2_000.0, length=450.0, cross_section=46.0)
    >>> tunnel.position + tunnel.length
    2450.0
    """

    position: Metres
    length: Annotated[float, Quantity("m", "m", must=POSITIVE_FINITE)]
    cross_section: Annotated[float, Quantity("m^2", "m^2", must=POSITIVE_FINITE)]

    def reversed(self, length: float) -> Tunnel:
        """The tunnel on the line of `length` [m] travelled the other way."""
        return replace(self, position=length - self.position - self.length)

    def between(self, start: float, end: float) -> Tunnel | None:
        """The tunnel from `start` to `end` [m] of the line, counted from `start`."""
        first, last = max(start, self.position), min(end, self.position + self.length)
        inside = last - first > TINY
        return replace(self, position=first - start, length=last - first) if inside else None


@dataclass(frozen=True, slots=True)
class Station:
    """A stopping place: name and chainage [m].

    Examples
    --------
    >>> Station("Gossau", 10_500.0)
    Station(name='Gossau', position=10500.0)
    """

    name: str
    position: Metres

    def reversed(self, length: float) -> Station:
        """The station on the line of `length` [m] travelled the other way."""
        return Station(self.name, length - self.position)

    def between(self, start: float, end: float) -> Station | None:
        """The station where it lies from `start` to `end` [m] of the line, counted from `start`."""
        inside = start - TINY <= self.position <= end + TINY
        at = min(max(self.position - start, 0.0), end - start)
        return Station(self.name, at) if inside else None


@dataclass(frozen=True, slots=True, eq=False)
class Geometry(Declared):
    """Where the line lies on the earth (WGS 84).

    Attributes
    ----------
    positions : (n,) array [m]
    latitudes, longitudes : (n,) array [deg]
    quality : str
        How it was obtained: ``"surveyed"``, ``"reconstructed from curvature"`` ...

    Examples
    --------
    >>> course = Geometry([0.0, 1_000.0], [50.83, 50.82], [12.92, 12.92], "surveyed")
    >>> latitude, longitude = course.at([500.0])
    >>> latitude.round(3), longitude.round(3)
    (array([50.825]), array([12.92]))
    """

    ORDER: ClassVar[tuple[str, ...]] = ("quality",)

    positions: Annotated[FloatArray, Column("position", "m", "m", table="track")]
    latitudes: Annotated[FloatArray, Column("latitude", "deg", "deg", table="track")]
    longitudes: Annotated[FloatArray, Column("longitude", "deg", "deg", table="track")]
    quality: str

    def problems(self) -> Iterator[InputError]:
        """What no course can be."""
        if self.positions.shape != self.latitudes.shape or self.positions.size < 2:
            yield InputError(
                "needs at least two points, each with two coordinates",
                remedy="give pairs of latitude and longitude",
            )
            return
        since = self.positions - self.positions[0]
        yield from _disorder("track.values", since, self.latitudes, self.longitudes)
        if np.any(np.abs(self.latitudes) > 90.0) or np.any(np.abs(self.longitudes) > 180.0):
            yield InputError(
                "a coordinate is beyond 90° of latitude or 180° of longitude",
                remedy="give degrees, latitude first",
            )

    def __repr__(self) -> str:
        return (
            f"Geometry of {counted(self.positions.size, 'point')}, {self.quality or 'no quality'},"
            f" from {self.latitudes[0]:.5f}°, {self.longitudes[0]:.5f}°"
            f" to {self.latitudes[-1]:.5f}°, {self.longitudes[-1]:.5f}°"
        )

    def at(self, position: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude [deg] at each position."""
        s = np.asarray(position, dtype=np.float64)
        return (
            np.asarray(np.interp(s, self.positions, self.latitudes)),
            np.asarray(np.interp(s, self.positions, self.longitudes)),
        )

    def between(self, start: float, end: float) -> Geometry | None:
        """The course from `start` to `end` [m], counted from `start`; None where it has none."""
        first, last = max(start, self.positions[0]), min(end, self.positions[-1])
        if last - first <= TINY:
            return None
        inside = self.positions[(self.positions > first + TINY) & (self.positions < last - TINY)]
        positions = np.concatenate(([first], inside, [last]))
        return Geometry(positions - start, *self.at(positions), self.quality)

    def reversed(self, length: float) -> Geometry:
        """The same points counted from the other end."""
        return Geometry(
            (length - self.positions)[::-1],
            self.latitudes[::-1],
            self.longitudes[::-1],
            self.quality,
        )

    @staticmethod
    def joined(parts: Sequence[tuple[float, Geometry]]) -> Geometry:
        """Courses that follow each other, each with the position [m] at which its line begins.

        Where two meet, the course is in the middle between their ends.
        """
        positions = np.concatenate([at + each.positions for at, each in parts])
        latitudes = np.concatenate([each.latitudes for _, each in parts])
        longitudes = np.concatenate([each.longitudes for _, each in parts])
        same = np.flatnonzero(np.diff(positions) <= TINY)
        for values in (latitudes, longitudes):
            values[same] = 0.5 * (values[same] + values[same + 1])
        kept = np.setdiff1d(np.arange(positions.size), same + 1)
        quality = "; ".join(dict.fromkeys(each.quality for _, each in parts if each.quality))
        return Geometry(positions[kept], latitudes[kept], longitudes[kept], quality)


@dataclass(frozen=True, slots=True)
class Survey(Declared):
    """How well the gradients of a line are known.

    Attributes
    ----------
    gradient_std : float
        Standard deviation of their errors (rise over run).
    correlation_length : float [m] or None
        Over how long the same error holds; None: each gradient has one of its own.
    """

    gradient_std: Annotated[float, Quantity("permil", "1", must=POSITIVE_FINITE)]
    correlation_length: Annotated[float | None, Quantity("m", "m", must=POSITIVE_FINITE)] = None


@dataclass(frozen=True, slots=True)
class Leg:
    """A stretch of a line that runs over an edge of a network; see `trainlog.railway.network`.

    Attributes
    ----------
    edge : str
    position, length : float [m]
        Where it begins on the line, and how long it is.
    edge_start, edge_end : float [m]
        On the edge's own chainage; `edge_end` is less than `edge_start` where the edge is
        travelled against it.
    edge_length : float [m]
        Of the whole edge.

    Examples
    --------
    >>> leg = Leg("Wil-Gossau", 0.0, 5_000.0, 19_000.0, 14_000.0, 19_000.0)
    >>> leg.forward, leg.on_edge([0.0, 1_000.0]).tolist()
    (False, [19000.0, 18000.0])
    """

    edge: str
    position: Metres
    length: Metres
    edge_start: Metres
    edge_end: Metres
    edge_length: Metres

    def __post_init__(self) -> None:
        ends = sorted((self.edge_start, self.edge_end))
        if not (-TINY <= ends[0] < ends[1] <= self.edge_length + TINY):
            raise InputError(
                f"leg over '{self.edge}': from km {self.edge_start / 1e3:.3f} to km"
                f" {self.edge_end / 1e3:.3f} is not a stretch of {self.edge_length / 1e3:.3f} km",
                remedy="give two chainages within the edge that differ",
            )
        if abs(ends[1] - ends[0] - self.length) > 1e-3:
            raise InputError(
                f"leg over '{self.edge}': is {self.length:.3f} m on the line and"
                f" {ends[1] - ends[0]:.3f} m on the edge",
                remedy="both must be the same",
            )

    @property
    def forward(self) -> bool:
        """Whether the edge is travelled along its chainage."""
        return self.edge_end > self.edge_start

    @property
    def end(self) -> float:
        """Where it ends on the line [m]."""
        return self.position + self.length

    def on_edge(self, position: ArrayLike) -> FloatArray:
        """Chainage on the edge [m] of positions on the line."""
        along = np.asarray(position, dtype=np.float64) - self.position
        return np.asarray(self.edge_start + (along if self.forward else -along))

    def on_line(self, chainage: ArrayLike) -> FloatArray:
        """Positions on the line [m] of chainages on the edge."""
        along = np.asarray(chainage, dtype=np.float64) - self.edge_start
        return np.asarray(self.position + (along if self.forward else -along))

    def reversed(self, length: float) -> Leg:
        """The leg on the line of `length` [m] travelled the other way."""
        position = length - self.end
        return replace(
            self,
            position=position if position > TINY else 0.0,
            edge_start=self.edge_end,
            edge_end=self.edge_start,
        )

    def between(self, start: float, end: float) -> Leg | None:
        """What of the leg lies from `start` to `end` [m] of the line, counted from `start`."""
        first, last = max(start, self.position), min(end, self.end)
        if last - first <= TINY:
            return None
        ends = self.on_edge([first, last]).tolist()
        return replace(
            self, position=first - start, length=last - first, edge_start=ends[0], edge_end=ends[1]
        )


def route_words(legs: tuple[Leg, ...]) -> str:
    """The edges of a route in a few words.

    Examples
    --------
    >>> route_words((Leg("trunk", 0.0, 800.0, 0.0, 800.0, 800.0),))
    'trunk'
    """
    names = [leg.edge if leg.forward else f"{leg.edge} (against its chainage)" for leg in legs]
    more = f", ... ({len(names)} edges)" if len(names) > 4 else ""
    return ", ".join(names[:4]) + more


# ------------------------------------------------------------------ the line

STEEPEST, STEEP_OVER, STEEPEST_POINT = 0.2, 100.0, 1.0
"""Mean gradient over so many metres [m] that no railway has, and that no point of a survey has."""

LONGEST_PIECE = 5.0
"""Of a line averaged over a train [m]: where curves are, its mean is not linear between edges."""


_LENGTH = Quantity("km", "m", (0.02, 2e4, "lines have"))
_LIMIT = Quantity("km/h", "m/s", (1, 600, "speed limits are"))

STEEPEST_MEAN = 0.08
"""Mean size of the gradients of a whole line; only rack railways exceed it."""

LOWEST, HIGHEST = -1_000.0, 6_000.0
"""Altitudes [m] between which there are railways."""

LEAST_EXTENT = 0.005
"""Share of a line's length that its rows cover at least, where there are several."""


class Pieces(NamedTuple):
    """Pieces of a line as compiled code reads it; (n,) arrays.

    Attributes
    ----------
    start, width : [m]
    sine, climb : of the gradient's angle, [1/m]
        At the start, and its change along the piece: 0 unless it is averaged over a train.
    curvature, bend : [1/m], [1/m²]
        At the start, and its change along the piece.
    coefficient, offset : [m]
        Of the curve resistance; see `trainlog.railway.resistance.CURVE_FORMULAS`.
    """

    start: FloatArray
    width: FloatArray
    sine: FloatArray
    climb: FloatArray
    curvature: FloatArray
    bend: FloatArray
    coefficient: FloatArray
    offset: FloatArray


_LIMITS = (POSITION, Column("speed", "km/h", "m/s"))


@dataclass(frozen=True, eq=False, repr=False)
class Line(Declared):
    """A railway line between two ends.

    Attributes
    ----------
    name : str
    length : float [m]
        Position (chainage) runs from 0 to the length, in the forward direction.
    stations : tuple of Station
        Name and position, in the order of positions.
    speed_limits : StepProfile [m/s]
        Permitted from there on, up to the next row, in the direction in which the chainage grows.
    gradients : StepProfile
        Rise over run from there on, uphill positive; the first at position 0.
    curvatures : CurvatureProfile [1/m] or None
        Radii at begin and end of each element, positive to the right; straight track: "infinity".
    tunnels : tuple of Tunnel
        Position of the portal, length and cross-section.
    altitude : float [m]
        Of the track at position 0.
    geometry : Geometry or None
        Coordinates (WGS 84) by position; chainage is found from fixes with them.
    source : str
        Where the data come from.
    braking_parameters : dict of str to float
        ETCS braking parameters of the track by their published names and in published units.
    survey : Survey or None
        How well the gradients are known, where it is.
    assumed : tuple of str
        Fields that the source does not give, such as ``"gradients"``: they hold assumptions, and
        what needs them refuses the line.
    reference : LineReference or None
        What the operator calls the line, and its kilometres; None: they are the chainage.
    curve_resistance : {"proportional", "roeckl", "roeckl_small_radius"}
        Formula of the curve resistance, `trainlog.railway.resistance.CURVE_FORMULAS`.
    legs : tuple of Leg
        Of a route in a network: the edges that it runs over, without gaps; else none.
    speed_limits_reverse : StepProfile [m/s] or None
        Of the other direction, by the same chainage; None: the same. `reversed` exchanges both.

    Examples
    --------
    >>> from trainlog.railway import Station, StepProfile
    >>> line = Line(
    ...     name="short",
    ...     length=1_000.0,
    ...     stations=(Station("A", 0.0), Station("B", 1_000.0)),
    ...     speed_limits=StepProfile([0.0, 500.0], [20.0, 30.0]),
    ...     gradients=StepProfile([0.0], [0.005]),
    ... )
    >>> line.speed_limit([100.0, 600.0])
    array([20., 30.])
    >>> line.reversed().gradient(100.0).item()
    -0.005
    """

    charts_by: ClassVar[str] = "analysis.charts:line_charts"

    FORMAT: ClassVar[str] = "trainlog/line"
    VERSION: ClassVar[int] = 2
    ORDER: ClassVar[tuple[str, ...]] = (
        "name", "source", "length", "altitude", "stations", "speed_limits", "gradients", "survey",
        "curvatures", "tunnels", "braking_parameters", "geometry", "assumed",
    )  # fmt: skip

    name: Annotated[str, Text(least=1, usual="Example line")]
    length: Annotated[float, Quantity("m", "m", must=POSITIVE, usual=12_000.0)]
    stations: Annotated[
        tuple[Station, ...],
        Table(usual=(Station("Aach", 150.0), Station("Berg", 5_900.0), Station("Chur", 11_800.0))),
    ]
    speed_limits: Annotated[
        StepProfile,
        Table(
            _LIMITS,
            usual=StepProfile(
                np.array([0.0, 600.0, 5_400.0, 6_400.0]),
                np.array([60.0, 120.0, 80.0, 120.0]) / KMH,
            ),
        ),
    ]
    gradients: Annotated[
        StepProfile,
        Table(
            (POSITION, Column("gradient", "permil", "1")),
            usual=StepProfile(
                np.array([0.0, 1_500.0, 4_200.0, 9_000.0]), np.array([0.0, 0.008, -0.005, 0.0])
            ),
        ),
    ]
    curvatures: Annotated[
        CurvatureProfile | None,
        Table(
            usual=CurvatureProfile(
                np.array([0.0, 900.0, 1_300.0]),
                np.array([0.0, 2e-3, 0.0]),
                np.array([0.0, 2e-3, 0.0]),
            )
        ),
    ] = None
    tunnels: Annotated[tuple[Tunnel, ...], Table(usual=(Tunnel(4_300.0, 250.0, 45.0),))] = ()
    altitude: Annotated[float, Quantity("m", "m", stated="written", usual=430.0)] = 0.0
    geometry: Annotated[
        Geometry | None,
        Part(
            usual=Geometry(
                np.array([0.0, 12_000.0]),
                np.array([47.40, 47.44]),
                np.array([9.30, 9.43]),
                "how they were obtained",
            )
        ),
    ] = None
    source: Annotated[
        str, Text(stated="written", usual="template: replace every value by your line's")
    ] = ""
    braking_parameters: Annotated[
        dict[str, float], Named({"M_NVAVADH": Quantity("1", "1"), "Kt_int": Quantity("1", "1")})
    ] = field(default_factory=dict)
    survey: Survey | None = None
    assumed: tuple[str, ...] = ()
    reference: Annotated[
        LineReference | None,
        Part(usual=LineReference("850", np.zeros(1), np.array([61_200.0]), np.array([49_200.0]))),
    ] = None
    curve_resistance: CurveFormula = "proportional"
    legs: Annotated[tuple[Leg, ...], Table()] = ()
    speed_limits_reverse: Annotated[StepProfile | None, Table(_LIMITS)] = None

    @property
    def version_needed(self) -> int:
        """2 where limits differ by direction; older programs are to refuse the file for that."""
        return 1 if self.speed_limits_reverse is None else 2

    def problems(self) -> Iterator[InputError]:
        """What no line can be, besides fields beyond their bounds, one by one."""
        where = f"line '{self.name}'"
        if not self.length > 0.0:
            return

        def places(bad: FloatArray, problem: str, remedy: str = "") -> Iterator[InputError]:
            """The first of some places [m], and how many more there are."""
            if bad.size:
                more = f" (and {bad.size - 1} more)" if bad.size > 1 else ""
                at = f"km {bad[0] / 1e3:.3f}"
                yield InputError(f"{where}: {problem.format(at)}{more}", remedy=remedy or None)

        limits, against = self.speed_limits, self.limits_against
        every = (
            {"": limits} if against is limits else {"": limits, " of the other direction": against}
        )
        for words, each in every.items():
            yield from places(
                each.positions[each.values <= 0.0],
                f"speed limit{words} at {{}} is not positive",
                "a train could never pass; give the permitted speed there",
            )
        edges, over = self.gradients.positions, min(STEEP_OVER, self.length)
        first = np.clip(edges, 0.0, self.length - over)
        means = np.abs(self.gradients.mean(first, first + over))
        # A gradient of just so much stays one wherever its mean is rounded.
        most = STEEPEST * (1.0 + 1e-9)
        yield from places(
            edges[(means > most) | (np.abs(self.gradients.values) > STEEPEST_POINT)],
            "gradient at {} is steeper than 200 per mille",
            "check its unit: are per mille given as '%' or '1'?",
        )
        for name, positions in (
            ("speed limit", np.union1d(limits.positions, against.positions)),
            ("gradient", edges),
            ("station", np.array([station.position for station in self.stations])),
        ):
            yield from places(
                positions[(positions < 0.0) | (positions > self.length)],
                f"{name} at {{}} lies before the line's start or beyond the line's end at"
                f" km {self.length / 1e3:.3f}",
            )
        for before, station in pairwise(self.stations):
            if station.position < before.position:
                yield InputError(
                    f"{where}: stations are not in the order of their positions:"
                    f" '{station.name}' at km {station.position / 1e3:.3f} stands after"
                    f" '{before.name}' at km {before.position / 1e3:.3f}",
                    remedy="order the stations by position",
                )
        if self.curve_resistance in CURVE_FORMULAS and self.curvatures is not None:
            size = np.maximum(np.abs(self.curvatures.start), np.abs(self.curvatures.end))
            offset = curve_coefficients(size, self.curve_resistance)[1]
            sharp = np.flatnonzero(LEAST_RADIUS * offset * size > 1.0)
            for at in sharp[:1]:
                yield from places(
                    self.curvatures.positions[sharp],
                    f"the curve resistance '{self.curve_resistance}' does not hold for the radius"
                    f" of {1.0 / size[at]:.0f} m at {{}}",
                    f"it needs {LEAST_RADIUS * offset[at]:.0f} m; correct the radius, or state"
                    " 'proportional'",
                )
        for tunnel in self.tunnels:
            if tunnel.position < -TINY or tunnel.position + tunnel.length > self.length + TINY:
                yield InputError(
                    f"{where}: tunnel at km {tunnel.position / 1e3:.3f} leaves the line",
                    remedy="correct the tunnel's kilometres",
                )
        begins = [leg.position for leg in self.legs] + [self.length] * bool(self.legs)
        ends = [0.0] * bool(self.legs) + [leg.end for leg in self.legs]
        for begin, end in zip(begins, ends, strict=True):
            if abs(begin - end) > 1e-3:
                yield InputError(
                    f"{where}: its legs leave km {min(begin, end) / 1e3:.3f} to"
                    f" {max(begin, end) / 1e3:.3f} out or cover it twice",
                    remedy="each leg must begin where the one before ends",
                )

    @property
    def title(self) -> str:
        """Name and length."""
        return f"Line '{self.name}', {self.length / 1e3:.3f} km"

    def summary(self) -> dict[str, str]:
        """What lies along the line."""
        limits, slopes = self.speed_limits, self.gradients
        rows = {
            "stations": ", ".join(station.name for station in self.stations[:4])
            + "".join(f" ... {s.name} ({len(self.stations)})" for s in self.stations[4:][-1:])
            or "none",
            "limits": f"{span(limits.values, KMH)} km/h in {counted(limits.values.size, 'piece')}",
            "gradients": f"{span(slopes.values, 1e3, 1)} per mille in"
            f" {counted(slopes.values.size, 'piece')}",
        }
        if self.curvatures is not None:
            sharp = f", {self.curvatures.words}" if self.least_radius < np.inf else ""
            rows["curves"] = (
                f"{self.curvatures.positions.size} elements{sharp}"
                + f", resistance {self.curve_resistance}"
                * (self.curve_resistance != "proportional")
            )
        if self.speed_limits_reverse is not None:
            against = self.speed_limits_reverse
            rows["limits"] += f"; the other way {span(against.values, KMH)} km/h"
        if self.tunnels:
            rows["tunnels"] = f"{len(self.tunnels)}, {sum(t.length for t in self.tunnels):.0f} m"
        if self.geometry is not None:
            rows["geometry"] = f"{self.geometry.positions.size} points"
        if self.reference is not None:
            known = self.kilometre([0.0, self.length]) / 1e3
            rows["operator's"] = f"{self.reference.name}, km {known[0]:.3f} to {known[1]:.3f}"
        if self.legs:
            rows["route"] = route_words(self.legs)
        if self.assumed:
            rows["assumed"] = ", ".join(name.replace("_", " ") for name in self.assumed)
        return rows

    @classmethod
    def implausible(cls, values: Mapping[str, Any]) -> Iterator[InputError]:
        """What of the values of a file [SI] cannot be meant."""
        length = values.get("length") or 0.0
        yield from _LENGTH.implausible(length, "length")
        for name in ("speed_limits", "speed_limits_reverse"):
            if values.get(name) is not None:
                limits = values[name].values
                wild = [
                    problem
                    for row, limit in enumerate(limits.tolist())
                    for problem in _LIMIT.implausible(limit, f"{name}.values[{row}][1]")
                ]
                yield from wild[:1]
        altitude = values.get("altitude") or 0.0
        if not LOWEST <= altitude <= HIGHEST:
            yield InputError(
                f"{altitude:.6g} m is not plausible: railways lie between {LOWEST:g} and"
                f" {HIGHEST:g} m",
                place="altitude",
                remedy="check the value and its unit",
            )
        if values.get("gradients") is not None and length > 0.0:
            yield from _implausible_gradients(values["gradients"], length)
            yield from _implausible_chainage(values, length)

    @property
    def kilometres(self) -> LineReference:
        """The operator's kilometres, or the chainage."""
        ends = np.zeros(1), np.zeros(1), np.full(1, self.length)
        return self.reference or LineReference(self.name, *ends)

    def kilometre(self, position: ArrayLike) -> FloatArray:
        """The operator's kilometre, in metres, at each position [m]."""
        if self.reference is None:
            return np.asarray(position, dtype=np.float64)
        return self.reference.at(position, self.length)

    def speed_limit(self, position: ArrayLike) -> FloatArray:
        """Permitted speed [m/s] at each position [m]."""
        return self.speed_limits(position)

    @property
    def limits_against(self) -> StepProfile:
        """Speed limits [m/s] of a train that travels against the chainage, by this chainage."""
        return self.speed_limits_reverse or self.speed_limits

    @property
    def highest_limit(self) -> float:
        """The highest speed limit [m/s] of both directions: no train may exceed it anywhere."""
        return float(max(self.speed_limits.values.max(), self.limits_against.values.max()))

    @property
    def least_radius(self) -> float:
        """Of the sharpest curve [m]; infinite where the line is straight, or none is known."""
        return np.inf if self.curvatures is None else self.curvatures.least_radius

    def gradient(self, position: ArrayLike) -> FloatArray:
        """Gradient (rise over run) at each position [m]."""
        return self.gradients(position)

    def curvature(self, position: ArrayLike) -> FloatArray:
        """Signed curvature [1/m] at each position [m]; 0 where it is not known."""
        if self.curvatures is None:
            return np.zeros(np.shape(position))
        return self.curvatures.at(position, self.length)

    def track_acceleration(self, position: ArrayLike, train_length: float = 0.0) -> FloatArray:
        """Deceleration by the track itself [m/s²]: gradient and curves, for any mass.

        ``g (sin(alpha) + k / (R - b))``; Amirhosseini et al. (2024), eq. (6) and (7), with the
        line's `curve_resistance`.

        Parameters
        ----------
        position : array [m]
            Of the train's front.
        train_length : float [m]
            Length over which the mass is spread: gradient and curves are the mean of what lies
            under it, from the front backwards. 0: all of it is at the front.

        Examples
        --------
        >>> from trainlog.formats.railway import read_line
        >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
        >>> line.track_acceleration([1_000.0, 5_000.0]).round(4).tolist()
        [-0.0971, 0.0573]
        >>> line.track_acceleration([1_000.0, 5_000.0], train_length=400.0).round(4).tolist()
        [-0.1043, 0.0317]
        """
        s = np.asarray(position, dtype=np.float64)
        if train_length > 0.0:
            return np.asarray((self._work(s) - self._work(s - train_length)) / train_length)
        slope = self.gradient(s)
        sine = slope / np.sqrt(1.0 + slope**2)
        curves = curve_force_per_weight(self.curvature(s), self.curve_resistance)
        return np.asarray(GRAVITY * (sine + curves))

    def _work(self, position: FloatArray) -> FloatArray:
        """Integral of the track acceleration from the line's start [m²/s²].

        Before the start and beyond the end the line goes on as it begins and ends.
        """
        pieces, sums = self._summed
        row = np.maximum(np.searchsorted(pieces.start, position, side="right") - 1, 0)
        within = position - pieces.start[row]
        return np.asarray(sums[row] + within * self._mean(pieces, row, within))

    @cached_property
    def _summed(self) -> tuple[Pieces, FloatArray]:
        """Pieces without an inflection, and the work from the line's start to each."""
        pieces = self._pieces_between(self.edges())
        row = np.arange(pieces.start.size)
        works = pieces.width * self._mean(pieces, row, pieces.width)
        return pieces, np.concatenate(([0.0], np.cumsum(works)[:-1]))

    @staticmethod
    def _mean(pieces: Pieces, row: IntArray, width: FloatArray) -> FloatArray:
        """Mean track acceleration over the first `width` of pieces, by Gauss' three points."""
        found = pieces.sine[row].copy()
        # A train that reaches beyond an end finds the curvature of that end.
        inside = np.clip(width, 0.0, pieces.width[row])
        for point, weight in zip(*np.polynomial.legendre.leggauss(3), strict=True):
            bend = pieces.curvature[row] + pieces.bend[row] * inside * (0.5 + 0.5 * point)
            found += (
                0.5
                * weight
                * specific_curve_resistance(bend, pieces.coefficient[row], pieces.offset[row])
            )
        return np.asarray(GRAVITY * found)

    def tunnel_cross_section(self, position: ArrayLike) -> FloatArray:
        """Cross-section of the tunnel [m²] at each position; 0 in the open."""
        s = np.asarray(position, dtype=np.float64)
        section = np.zeros(s.shape)
        for tunnel in self.tunnels:
            inside = (s >= tunnel.position) & (s < tunnel.position + tunnel.length)
            section = np.where(inside, tunnel.cross_section, section)
        return section

    def altitudes(self, position: ArrayLike) -> FloatArray:
        """Altitude of the track [m] at each position [m]."""
        return self.gradients.integral(position, self.altitude)

    @cached_property
    def breakpoints(self) -> FloatArray:
        """Every position [m] at which a limit, gradient, curve element or tunnel begins or ends."""
        pieces = [
            np.array([0.0, self.length]),
            self.speed_limits.positions,
            self.gradients.positions,
        ]
        if self.curvatures is not None:
            pieces.append(self.curvatures.positions)
        pieces.extend(np.array([t.position, t.position + t.length]) for t in self.tunnels)
        points = np.unique(np.concatenate(pieces))
        return points[(points >= 0.0) & (points <= self.length)]

    def edges(self, train_length: float = 0.0) -> FloatArray:
        """Positions [m] between which the track acceleration is smooth.

        The breakpoints, where one bend turns into the opposite one, where another row of the
        curve resistance begins, and where the rear of a train passes all these.

        Examples
        --------
        >>> from trainlog.formats.railway import read_line
        >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
        >>> line.breakpoints.size, line.edges().size, line.edges(58.6).size
        (396, 396, 787)
        """
        points = np.concatenate((self.breakpoints, *map(self._crossings, self._steps())))
        if train_length > 0.0:
            points = np.concatenate((points, points + train_length))
        return np.unique(points[(points >= 0.0) & (points <= self.length)])

    def _steps(self) -> list[float]:
        """Signed curvatures at which the curve resistance changes its formula or its sign."""
        steps = [row[0] for row in CURVE_FORMULAS[self.curve_resistance][1:]]
        return [0.0, *steps, *(-step for step in steps)]

    def _crossings(self, curvature: float) -> FloatArray:
        """Positions [m] inside the curve elements at which they pass a curvature."""
        profile = self.curvatures
        if profile is None:
            return np.empty(0)
        first, last = profile.start - curvature, profile.end - curvature
        passes = first * last < 0.0
        first, last = first[passes], last[passes]
        ends = np.append(profile.positions[1:], self.length)[passes]
        begins = profile.positions[passes]
        return np.asarray(begins + (ends - begins) * first / (first - last))

    def pieces(self, train_length: float = 0.0) -> Pieces:
        """The line between its breakpoints, as compiled code reads it.

        Averaged over a train, the curves are part of the sine, which is linear in each piece.
        """
        if train_length > 0.0:
            # Pieces of at most `LONGEST_PIECE` between the edges, for a train of a length.
            edges = self.edges(train_length)
            counts = np.ceil(np.diff(edges) / LONGEST_PIECE).astype(np.int64)
            cell, number = numbered(counts)
            start = edges[cell] + number / counts[cell] * np.diff(edges)[cell]
            width = np.diff(np.append(start, self.length))
            sine = self.track_acceleration(np.append(start, self.length), train_length) / GRAVITY
            none = np.zeros(start.size)
            return Pieces(start, width, sine[:-1], np.diff(sine) / width, none, none, none, none)
        changes = [self._crossings(step) for step in self._steps()[1:]]
        return self._pieces_between(np.unique(np.concatenate((self.breakpoints, *changes))))

    def _pieces_between(self, edges: FloatArray) -> Pieces:
        start = edges[edges < self.length]
        width = np.diff(np.append(start, self.length))
        inside = start + 1e-6 * width
        nearly = start + (1.0 - 1e-6) * width
        slope = self.gradient(start)
        curvature = self.curvature(inside)
        bend = (self.curvature(nearly) - curvature) / (nearly - inside)
        of_curves = curve_coefficients(curvature + 0.5 * width * bend, self.curve_resistance)
        sine = slope / np.hypot(1.0, slope)
        return Pieces(start, width, sine, np.zeros(start.size), curvature, bend, *of_curves)

    def limits_over(self, train_length: float) -> StepProfile:
        """The speed limits [m/s] as a train meets them whose rear must have passed a restriction.

        Parameters
        ----------
        train_length : float [m]
            Length that a limit protects; 0: the limits of the train's front.

        Examples
        --------
        >>> from trainlog.formats.railway import read_line
        >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
        >>> line.speed_limits.positions[:3].round(1).tolist()
        [0.0, 49.6, 125.6]
        >>> line.limits_over(58.6).positions[:3].round(1).tolist()
        [0.0, 49.6, 58.6]
        """
        profile = self.speed_limits
        if train_length == 0.0:
            return profile
        edges = np.unique(np.concatenate((profile.positions, profile.positions + train_length)))
        # In the middle of each piece, where rounding does not decide what lies under the train.
        front = (edges + 0.5 * np.diff(edges, append=edges[-1] + 2.0))[:, None]
        under_train = (profile.positions < front) & (
            np.append(profile.positions[1:], np.inf) > front - train_length
        )
        return StepProfile(edges, np.where(under_train, profile.values, np.inf).min(axis=1))

    def reversed(self) -> Line:
        """The line travelled from its end to its start.

        Examples
        --------
        >>> from trainlog.formats.railway import read_line
        >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
        >>> line.reversed().stations[0].name
        'Wil'
        """

        def turned(found: Any) -> Any:
            if isinstance(found, tuple):
                return tuple(each.reversed(self.length) for each in reversed(found))
            return found and found.reversed(self.length)

        return replace(
            self,
            altitude=float(self.altitudes(self.length)),
            speed_limits=turned(self.limits_against),
            speed_limits_reverse=self.speed_limits_reverse and turned(self.speed_limits),
            gradients=self.gradients.reversed(self.length, sign=-1.0),
            **{name: turned(getattr(self, name)) for name in (*_THINGS, *_ELEMENTS)},
        )

    def travelled(self, direction: str | None) -> Line:
        """The line as a train of a direction meets it: from its end to its start in ``"reverse"``.

        Examples
        --------
        >>> from trainlog.formats.railway import read_line
        >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
        >>> line.travelled("forward") is line, line.travelled("reverse").stations[0].name
        (True, 'Wil')
        """
        return self.reversed() if direction == "reverse" else self

    def section(self, start: float, end: float) -> Line:
        """The line from `start` to `end` [m], its chainage counted from `start`.

        Raises
        ------
        InputError
            If this is no stretch of the line.

        Examples
        --------
        >>> from trainlog.formats.railway import read_line
        >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
        >>> part = line.section(5_000.0, 12_000.0)
        >>> part.length, bool(part.gradient(1_000.0) == line.gradient(6_000.0))
        (7000.0, True)
        """
        if not -TINY <= start < end <= self.length + TINY:
            raise InputError(
                f"line '{self.name}': km {start / 1e3:.3f} to {end / 1e3:.3f} is not a part of it",
                remedy=f"it is {self.length / 1e3:.3f} km long",
            )

        def cut(found: Any, *line: float) -> Any:
            if isinstance(found, tuple):
                return tuple(filter(None, (each.between(start, end) for each in found)))
            return found and found.between(start, end, *line)

        return replace(
            self,
            length=end - start,
            altitude=float(self.altitudes(start)),
            **{name: cut(getattr(self, name)) for name in (*_THINGS, *_STEPS)},
            **{name: cut(getattr(self, name), self.length) for name in _ELEMENTS},
        )


_THINGS = ("stations", "tunnels", "legs", "geometry")
_STEPS = ("speed_limits", "speed_limits_reverse", "gradients")
_ELEMENTS = ("curvatures", "reference")
"""Fields of a line that lie along it: what stands or lies at places; steps; elements."""


def _implausible_gradients(profile: StepProfile, length: float) -> Iterator[InputError]:
    """Gradients that no line has on its average, or that lift it beyond all mountains."""
    positions, gradients = profile.positions, profile.values
    if np.any(np.abs(gradients) > STEEPEST):
        return
    widths = np.diff(np.append(positions, max(length, positions[-1])))
    mean = float(np.sum(np.abs(gradients) * widths)) / max(float(np.sum(widths)), 1e-9)
    rise = np.cumsum(gradients * widths)
    if mean > STEEPEST_MEAN and length > 1e3:
        problem = f"are {1e3 * mean:.0f} per mille on the whole line's average"
    elif np.ptp(rise) > HIGHEST - LOWEST:
        problem = f"make the line rise by {np.ptp(rise):.0f} m"
    else:
        return
    yield InputError(
        f"{problem}: not plausible",
        place="gradients",
        remedy="were per mille meant where the unit states '%'?",
    )


def _implausible_chainage(values: Mapping[str, Any], length: float) -> Iterator[InputError]:
    """Rows of a line that all lie at its start: chainage in km whose unit states m."""
    tables = ("speed_limits", "speed_limits_reverse", "gradients", "curvatures")
    found = [values[name].positions for name in tables if values.get(name) is not None]
    points = [e.position for name in ("tunnels", "stations") for e in values.get(name) or ()]
    positions = np.concatenate([*found, points])
    if np.unique(positions).size >= 5 and np.max(positions) < LEAST_EXTENT * length:
        yield InputError(
            f"all positions lie within {np.max(positions):.6g} m of a line of {length:.6g} m:"
            " not plausible",
            place="units.position",
            remedy="were km meant where the unit states m?",
        )


def composed(
    name: str,
    placed: Sequence[tuple[float, Line]],
    stations: Sequence[Station] | None = None,
    legs: Sequence[Leg] = (),
) -> Line:
    """Lines that follow each other, in this order, as one.

    Limits, gradients, curves, tunnels and kilometres are those of the parts at each position. It
    has a geometry where all parts have one; gradients are known as well as on the part where they
    are known worst.

    Parameters
    ----------
    name : str
    placed : sequence of (float, Line)
        The parts, each with the position [m] at which it begins.
    stations : sequence of Station, optional
        On the whole; default: those of the parts. Where parts meet, each stands once.
    legs : sequence of Leg
        Of a route: the edges that the parts are.

    Raises
    ------
    InputError
        If parts state different formulas of the curve resistance.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> parts = [(0.0, line.section(0.0, 4e3)), (4e3, line.section(4e3, line.length))]
    >>> both = composed("again", parts)
    >>> both.length, both.stations == line.stations
    (29556.1, True)
    """
    parts = [part for _, part in placed]
    formulas = {part.curve_resistance: part.name for part in parts if part.curvatures is not None}
    if len(formulas) > 1:
        words = ", ".join(f"'{formula}' on '{edge}'" for formula, edge in formulas.items())
        raise InputError(
            f"route '{name}': edges state different curve resistances: {words}",
            remedy="state the same on all edges of a network",
        )
    straight = CurvatureProfile(np.zeros(1), np.zeros(1), np.zeros(1))
    otherwise: dict[str, Callable[[Line], Profile]] = {
        "curvatures": lambda _: straight,
        "reference": lambda part: part.kilometres,
        "speed_limits_reverse": lambda part: part.limits_against,
    }
    joined: dict[str, Any] = {}
    for field_name in ("speed_limits", "gradients", *otherwise):
        given = [(at, getattr(part, field_name), part) for at, part in placed]
        if any(each is not None for _, each, _ in given):
            whole = [(at, each or otherwise[field_name](part)) for at, each, part in given]
            joined[field_name] = type(whole[0][1]).joined(whole)
    if "reference" in joined:
        names = dict.fromkeys(part.reference.name for part in parts if part.reference is not None)
        joined["reference"] = replace(joined["reference"], name=" + ".join(names))
    if stations is None:
        every = [(at, each) for at, part in placed for each in part.stations]
        stations = [replace(each, position=at + each.position) for at, each in every]
    once = [
        each
        for number, each in enumerate(stations)
        if not number
        or each.name != stations[number - 1].name
        or each.position - stations[number - 1].position > AT_JOINT
    ]
    courses = [(at, part.geometry) for at, part in placed if part.geometry is not None]
    first, *others = (part.braking_parameters.items() for part in parts)
    return Line(
        name=name,
        length=placed[-1][0] + parts[-1].length,
        stations=tuple(once),
        tunnels=tuple(
            replace(each, position=at + each.position)
            for at, part in placed
            for each in part.tunnels
        ),
        altitude=parts[0].altitude,
        geometry=Geometry.joined(courses) if len(courses) == len(parts) else None,
        source="; ".join(dict.fromkeys(part.source for part in parts if part.source)),
        braking_parameters=dict(each for each in first if all(each in other for other in others)),
        survey=_joined_survey(parts),
        assumed=tuple(dict.fromkeys(name for part in parts for name in part.assumed)),
        curve_resistance=next(iter(formulas), "proportional"),
        legs=tuple(legs),
        **joined,
    )


def _joined_survey(parts: Sequence[Line]) -> Survey | None:
    """How well the gradients are known where they are known worst; None where one part has none.

    The longest stretch over which an error holds: of a part whose gradients have each one of
    their own, their mean length, the longer ones counting for more.
    """
    known = [part.survey for part in parts if part.survey is not None]
    if len(known) < len(parts):
        return None
    lengths = []
    for part, survey in zip(parts, known, strict=True):
        widths = np.diff(np.append(part.gradients.positions, part.length))
        lengths.append(survey.correlation_length or float(np.sum(widths**2) / part.length))
    alone = all(survey.correlation_length is None for survey in known)
    worst = max(survey.gradient_std for survey in known)
    return Survey(worst, None if alone else max(lengths))


# ------------------------------------------------------------------ kilometres
# Positions are chainage in metres everywhere else. Whatever shows a place in km or reads one goes
# through here, so that the same place has the same number in tables, in pictures and on the command
# line: the operator's kilometre, or the chainage of a line without.

ROUNDING = 1.0
"""How far [m] behind the ends of its pieces a line still has a kilometre: those shown are rounded
to a metre."""

AT_STATION = 100.0
"""What is nearer to a station lies at it [m]."""

STATION_REACH = 200.0
"""A train that stands so near to a station's chainage [m] has stopped there."""

STEPS = (1.0, 2.0, 5.0)
"""Of ticks, times a power of ten."""


def in_km(line: Line | None, position: ArrayLike) -> FloatArray:
    """Kilometres that a person reads for positions [m] of a line; none is a negative zero.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.railway import LineReference
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> in_km(line, 1_000.0).item(), in_km(None, 1_000.0).item()
    (1.0, 1.0)
    >>> down = LineReference("850", [0.0], [61_200.0], [61_200.0 - line.length])
    >>> in_km(replace(line, reference=down), 1_000.0).item()
    60.2
    >>> f"{in_km(line, -0.2).item():.3f}"
    '0.000'
    """
    places = np.asarray(position, dtype=np.float64)
    km = np.asarray((places if line is None else line.kilometre(places)) / 1e3)
    return np.where((km <= 0.0) & (km >= -5e-4), 0.0, km)


def km_words(line: Line | None, position: float) -> str:
    """A place as ``km 61.400``.

    Examples
    --------
    >>> km_words(None, 350.0)
    'km 0.350'
    """
    return f"km {float(in_km(line, position)):.3f}"


def position_of(line: Line | None, km: float) -> float:
    """Position [m] of a kilometre as a person types it, the reverse of `in_km`.

    Where the kilometres come twice, the first.

    Raises
    ------
    InputError
        If the line has no such kilometre.

    Examples
    --------
    >>> position_of(None, 3.2)
    3200.0
    """
    if line is None:
        return 1e3 * km
    if line.reference is None:
        if not -ROUNDING <= 1e3 * km <= line.length + ROUNDING:
            raise InputError(f"line '{line.name}' has no km {km:g}", remedy=_kilometres_of(line))
        return min(max(1e3 * km, 0.0), line.length)
    for first, last, start, end in _pieces(line):
        low, high = min(start, end), max(start, end)
        if low - ROUNDING <= 1e3 * km <= high + ROUNDING and high > low:
            share = (min(max(1e3 * km, low), high) - start) / (end - start)
            return first + share * (last - first)
    raise InputError(f"line '{line.name}' has no km {km:g}", remedy=_kilometres_of(line))


def section_of_km(
    line: Line | None, start: float | None, end: float | None
) -> tuple[float | None, float | None]:
    """Positions [m] of the ends of a section that a person types in km; None where it is open.

    Of a line with the operator's kilometres the ends may come in either order, for they may fall in
    the direction of travel; an open section has the kilometres above, or below, the one given.

    Raises
    ------
    InputError
        If the line has no such kilometre.

    Examples
    --------
    >>> section_of_km(None, 3.2, None)
    (3200.0, None)
    """
    ends = [None if each is None else position_of(line, each) for each in (start, end)]
    if line is None or line.reference is None:
        return ends[0], ends[1]
    first, last = ends
    if first is not None and last is not None:
        return min(first, last), max(first, last)
    falling = line.reference.end[-1] < line.reference.start[0]
    return (last, first) if falling else (first, last)


def near(line: Line | None, position: ArrayLike, within: float = AT_STATION) -> list[str]:
    """Where each position [m] lies, by the nearest station; empty without a line.

    At a station is what is less than `within` [m] away from it.

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> near(line, [20.0, 9_000.0])
    ['at St.Gallen', '0.3 km before Gossau SG']
    """
    at = np.asarray(position, dtype=np.float64)
    if line is None or not line.stations:
        return [""] * at.size
    places = np.array([each.position for each in line.stations])
    nearest = np.argmin(np.abs(places - at[:, None]), axis=1)
    beyond = at - places[nearest]
    return [
        f"at {line.stations[i].name}"
        if abs(by) < within
        else f"{abs(by) / 1e3:.1f} km {'after' if by > 0 else 'before'} {line.stations[i].name}"
        for i, by in zip(nearest.tolist(), beyond.tolist(), strict=True)
    ]


def station_at(line: Line, position: float, reach: float = STATION_REACH) -> str:
    """Name of the nearest station within `reach` [m] of a position; empty if there is none."""
    if not line.stations:
        return ""
    places = np.array([station.position for station in line.stations])
    nearest = int(np.argmin(np.abs(places - position)))
    near = abs(places[nearest] - position) <= reach
    return line.stations[nearest].name if near else ""


def km_ticks(
    line: Line | None, start: float, end: float, most: int = 10
) -> tuple[FloatArray, list[str]]:
    """Ticks of an axis over positions: where they stand [m], and their labels.

    They are at round kilometres, not at round positions.

    Parameters
    ----------
    line : Line or None
    start, end : float [m]
        Of the axis.
    most : int
        Ticks, about.

    Examples
    --------
    >>> places, labels = km_ticks(None, 0.0, 24_500.0, 6)
    >>> places.tolist(), labels
    ([0.0, 5000.0, 10000.0, 15000.0, 20000.0], ['0', '5', '10', '15', '20'])
    """
    step = _step(abs(end - start) / 1e3 / max(most, 1))
    digits = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    low, high = min(start, end), max(start, end)
    places, labels = list[float](), list[str]()
    pieces = _pieces(line) if line is not None else [(low, high, low, high)]
    for number, (first, last, at_first, at_last) in enumerate(pieces):
        if at_first == at_last:
            continue
        within = sorted((at_first / 1e3 / step, at_last / 1e3 / step))
        numbers = step * np.arange(np.ceil(within[0] - 1e-9), np.floor(within[1] + 1e-9) + 1.0)
        found = first + (1e3 * numbers - at_first) / (at_last - at_first) * (last - first)
        order = np.argsort(found)
        for place, km in zip(found[order].tolist(), numbers[order].tolist(), strict=True):
            ends_here = place >= last - 1e-6 and number + 1 < len(pieces)
            apart = not places or place - places[-1] > 300.0 * step
            if low - 1e-6 <= place <= high + 1e-6 and apart and not ends_here:
                places.append(place)
                labels.append(f"{km + 0.0:.{digits}f}")
    return np.array(places), labels


def _step(least: float) -> float:
    """The least round step that is not below."""
    power = 10.0 ** np.floor(np.log10(max(least, 1e-3)))
    return float(next(power * each for each in (*STEPS, 10.0) if power * each >= least * 0.999))


def _pieces(line: Line) -> list[tuple[float, float, float, float]]:
    """First and last position, and the kilometres there, of each piece [m]."""
    known = line.kilometres
    rows = (known.positions, known.ends(line.length), known.start, known.end)
    return list(zip(*(each.tolist() for each in rows), strict=True))


def _kilometres_of(line: Line) -> str:
    """From where to where a line's kilometres are, and which it has not."""
    pieces = _pieces(line)
    words = f"its kilometres are {pieces[0][2] / 1e3:.3f} to {pieces[-1][3] / 1e3:.3f}"
    jumps = [
        f"{before[3] / 1e3:.3f} to {after[2] / 1e3:.3f}"
        for before, after in pairwise(pieces)
        if abs(before[3] - after[2]) > ROUNDING
    ]
    return words + (f", with a jump from {', from '.join(jumps)}" if jumps else "")

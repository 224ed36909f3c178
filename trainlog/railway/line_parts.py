"""What a line is made of: profiles along its chainage, stations, tunnels, course, survey, legs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.declaration import INFINITY, POSITIVE_FINITE, Column, Declared, Quantity, Text
from trainlog.display import counted
from trainlog.errors import InputError

TINY = 1e-6
"""Pieces that are shorter [m] do not come of a cut: positions are rounded to less."""


POSITION = Column("position", "m", "m")
"""The first column of tables along a line."""


def _radius(end: str) -> Column:
    """The column of the radii at one end of each element."""
    return Column(f"radius_at_{end}", "m", "m", INFINITY, inverse=True)


@dataclass(frozen=True, slots=True, eq=False)
class StepProfile(Declared):
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

    def problems(self) -> Iterator[InputError]:
        """What no profile can be."""
        yield from _disorder("values", self.positions, self.values)

    def __repr__(self) -> str:
        low, high = float(self.values.min()), float(self.values.max())
        return f"StepProfile of {counted(self.values.size, 'step')}, {low:g} to {high:g}"

    def __call__(self, position: ArrayLike) -> FloatArray:
        """Value at each position; ends are extended."""
        index = np.searchsorted(self.positions, np.asarray(position), side="right") - 1
        return np.asarray(self.values[np.maximum(index, 0)])

    def reversed(self, length: float, sign: float = 1.0) -> StepProfile:
        """The profile seen from the other end of a line of `length` [m]."""
        ends = np.append(self.positions[1:], length)
        return StepProfile((length - ends)[::-1], sign * self.values[::-1])

    def between(self, start: float, end: float) -> StepProfile:
        """The profile from `start` to `end` [m], counted from `start`.

        Examples
        --------
        >>> part = StepProfile([0.0, 500.0], [20.0, 30.0]).between(400.0, 900.0)
        >>> part.positions.tolist(), part.values.tolist()
        ([0.0, 100.0], [20.0, 30.0])
        """
        kept = (self.positions > start + TINY) & (self.positions < end - TINY)
        first = max(int(np.searchsorted(self.positions, start + TINY, side="right")) - 1, 0)
        return StepProfile(
            np.concatenate(([0.0], self.positions[kept] - start)),
            np.concatenate(([self.values[first]], self.values[kept])),
        )

    def mean(self, start: FloatArray, end: FloatArray) -> FloatArray:
        """Mean value over each interval from `start` to `end` [m], (m,) arrays, start < end.

        Examples
        --------
        >>> import numpy as np
        >>> profile = StepProfile(np.array([0.0, 100.0]), np.array([20.0, 30.0]))
        >>> profile.mean(np.array([50.0]), np.array([150.0])).tolist()
        [25.0]
        """
        edges = np.append(self.positions, np.inf)
        widths = np.diff(edges[:-1])
        integral = np.concatenate(([0.0], np.cumsum(self.values[:-1] * widths)))

        def antiderivative(s: FloatArray) -> FloatArray:
            index = np.maximum(np.searchsorted(self.positions, s, side="right") - 1, 0)
            return np.asarray(integral[index] + self.values[index] * (s - self.positions[index]))

        return np.asarray((antiderivative(end) - antiderivative(start)) / (end - start))


class _Elements(Declared):
    """What varies in a straight line over each of several elements of a line."""

    __slots__ = ()

    PLACE: ClassVar[str] = "values"
    """Of the rows in the file."""

    TURNED: ClassVar[float] = 1.0
    """Factor of the values as seen from the other end of the line."""

    positions: FloatArray
    start: FloatArray
    end: FloatArray

    def problems(self) -> Iterator[InputError]:
        """What no such elements can be."""
        yield from _disorder(self.PLACE, self.positions, self.start, self.end)

    def at(self, position: ArrayLike, length: float) -> FloatArray:
        """The value at each position of a line of `length` [m]; ends are extended."""
        s = np.asarray(position, dtype=np.float64)
        index = np.maximum(np.searchsorted(self.positions, s, side="right") - 1, 0)
        ends = np.append(self.positions[1:], max(length, self.positions[-1]))
        width = np.maximum(ends - self.positions, 1e-9)
        share = np.clip((s - self.positions[index]) / width[index], 0.0, 1.0)
        return np.asarray(self.start[index] + share * (self.end[index] - self.start[index]))

    def reversed(self, length: float) -> Self:
        """The elements seen from the other end of a line of `length` [m]."""
        ends = np.append(self.positions[1:], length)
        return replace(  # type: ignore[type-var]
            self,
            positions=(length - ends)[::-1],
            start=self.TURNED * self.end[::-1],
            end=self.TURNED * self.start[::-1],
        )

    def between(self, start: float, end: float, length: float) -> Self:
        """The elements from `start` to `end` [m] of a line of `length` [m], from `start` on."""
        ends = np.append(self.positions[1:], max(length, float(self.positions[-1])))
        kept = (ends > start + TINY) & (self.positions < end - TINY)
        positions, ends = self.positions[kept], ends[kept]
        first, last = self.start[kept], self.end[kept]
        width, change = np.maximum(ends - positions, 1e-9), last - first
        cut = positions - start
        cut[0] = 0.0
        return replace(  # type: ignore[type-var]
            self,
            positions=cut,
            start=first + np.maximum(start - positions, 0.0) / width * change,
            end=np.where(ends <= end, last, first + (end - positions) / width * change),
        )


@dataclass(frozen=True, slots=True, eq=False)
class CurvatureProfile(_Elements):
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

    def __repr__(self) -> str:
        sharpest = float(max(np.abs(self.start).max(), np.abs(self.end).max()))
        radius = f"radius {1.0 / sharpest:.0f} m at least" if sharpest else "straight"
        return f"CurvatureProfile of {counted(self.start.size, 'element')}, {radius}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LineReference(_Elements):
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
        yield InputError("needs as many positions as values", place=place)
    elif not all(np.all(np.isfinite(each)) for each in (positions, *columns)):
        yield InputError("positions and values must be finite numbers", place=place)
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
            yield InputError("needs at least two points, each with two coordinates")
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


def tunnels_between(tunnels: tuple[Tunnel, ...], start: float, end: float) -> Iterator[Tunnel]:
    """What of the tunnels lies within a stretch, counted from its start."""
    for tunnel in tunnels:
        first, last = max(start, tunnel.position), min(end, tunnel.position + tunnel.length)
        if last - first > TINY:
            yield Tunnel(first - start, last - first, tunnel.cross_section)

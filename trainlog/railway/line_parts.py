"""What a line is made of besides its profiles: stations, tunnels, course, survey, legs."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.declaration import Column, Declared, Must, Quantity, check
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.railway.profiles import TINY, check_positions, hold_as_arrays

Metres = Annotated[float, Quantity("m", "m")]


@dataclass(frozen=True, slots=True)
class Tunnel:
    """A tunnel from `position` over `length` [m] with a `cross_section` [m²].

    Examples
    --------
    >>> tunnel = Tunnel(position=2_000.0, length=450.0, cross_section=46.0)
    >>> tunnel.position + tunnel.length
    2450.0
    """

    position: Metres
    length: Metres
    cross_section: Annotated[float, Quantity("m^2", "m^2")]


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

    def __post_init__(self) -> None:
        hold_as_arrays(self, "positions", "latitudes", "longitudes")
        if self.positions.shape != self.latitudes.shape or self.positions.size < 2:
            raise InputError("needs at least two points, each with two coordinates")
        check_positions("geometry", self.positions - self.positions[0], self.latitudes)
        check_positions("geometry", self.positions - self.positions[0], self.longitudes)
        if np.any(np.abs(self.latitudes) > 90.0) or np.any(np.abs(self.longitudes) > 180.0):
            raise InputError(
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
        return replace(
            self,
            positions=(length - self.positions)[::-1].copy(),
            latitudes=self.latitudes[::-1].copy(),
            longitudes=self.longitudes[::-1].copy(),
        )


_KNOWN = Must(
    "is not positive and finite",
    "give how far off gradients are, or leave the survey out",
    high=sys.float_info.max,
    above=True,
)


@dataclass(frozen=True, slots=True)
class Survey:
    """How well the gradients of a line are known.

    Attributes
    ----------
    gradient_std : float
        Standard deviation of their errors (rise over run).
    correlation_length : float [m] or None
        Over how long the same error holds; None: each gradient has one of its own.
    """

    gradient_std: Annotated[float, Quantity("permil", "1", must=_KNOWN)]
    correlation_length: Annotated[float | None, Quantity("m", "m", must=_KNOWN)] = None

    def __post_init__(self) -> None:
        check(self)


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

"""A line: what lies under the train as a function of chainage.

Chainage `s` [m] runs from 0 to the line's length in the direction of travel; `Line.reversed`
gives the same line travelled the other way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trainlog.display import as_html, as_text, counted, picture, span
from trainlog.errors import InputError
from trainlog.railway.profiles import (
    CurvatureProfile as CurvatureProfile,
    LineReference as LineReference,
    StepProfile as StepProfile,
    check_positions as check_positions,
    hold_as_arrays,
)
from trainlog.railway.resistance import curve_force_per_weight
from trainlog.units import GRAVITY, KMH

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Tunnel:
    """A tunnel from `position` over `length` [m] with a `cross_section` [m²].

    Examples
    --------
    >>> tunnel = Tunnel(position=2_000.0, length=450.0, cross_section=46.0)
    >>> tunnel.position + tunnel.length
    2450.0
    """

    position: float
    length: float
    cross_section: float


@dataclass(frozen=True, slots=True)
class Station:
    """A stopping place: name and chainage [m].

    Examples
    --------
    >>> Station("Gossau", 10_500.0)
    Station(name='Gossau', position=10500.0)
    """

    name: str
    position: float


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
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

    positions: FloatArray
    latitudes: FloatArray
    longitudes: FloatArray
    quality: str

    def __post_init__(self) -> None:
        hold_as_arrays(self, "positions", "latitudes", "longitudes")
        if self.positions.shape != self.latitudes.shape or self.positions.size < 2:
            raise InputError("geometry: needs at least two points, each with two coordinates")
        check_positions("geometry", self.positions - self.positions[0], self.latitudes)
        check_positions("geometry", self.positions - self.positions[0], self.longitudes)
        if np.any(np.abs(self.latitudes) > 90.0) or np.any(np.abs(self.longitudes) > 180.0):
            raise InputError(
                "geometry: a coordinate is beyond 90° of latitude or 180° of longitude",
                remedy="give degrees, latitude first",
            )

    def __repr__(self) -> str:
        return (
            f"Geometry of {counted(self.positions.size, 'point')}, {self.quality or 'no quality'},"
            f" from {self.latitudes[0]:.5f}°, {self.longitudes[0]:.5f}°"
            f" to {self.latitudes[-1]:.5f}°, {self.longitudes[-1]:.5f}°"
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Geometry) and bool(
            np.array_equal(self.positions, other.positions)
            and np.array_equal(self.latitudes, other.latitudes)
            and np.array_equal(self.longitudes, other.longitudes)
            and self.quality == other.quality
        )

    def at(self, position: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude [deg] at each position."""
        s = np.asarray(position, dtype=np.float64)
        return (
            np.asarray(np.interp(s, self.positions, self.latitudes)),
            np.asarray(np.interp(s, self.positions, self.longitudes)),
        )

    def reversed(self, length: float) -> Geometry:
        """The same points counted from the other end."""
        return replace(
            self,
            positions=(length - self.positions)[::-1].copy(),
            latitudes=self.latitudes[::-1].copy(),
            longitudes=self.longitudes[::-1].copy(),
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

    gradient_std: float
    correlation_length: float | None = None

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                raise InputError(
                    f"survey: {name.replace('_', ' ')} {value} is not positive",
                    remedy="give how far off gradients are, or leave the survey out",
                )


class Pieces(NamedTuple):
    """Pieces of a line in which gradient and tunnel are constant; (n,) arrays.

    Attributes
    ----------
    start, width : [m]
    sine : of the gradient's angle
    curvature, bend : [1/m], [1/m²]
        At the start, and its change along the piece.
    """

    start: FloatArray
    width: FloatArray
    sine: FloatArray
    curvature: FloatArray
    bend: FloatArray


@dataclass(frozen=True, repr=False)
class Line:
    """A railway line between two ends.

    Attributes
    ----------
    name : str
    length : float [m]
    stations : tuple of Station
        At least the two ends, ordered by position.
    speed_limits : StepProfile [m/s]
    gradients : StepProfile
        Rise over run, uphill positive.
    curvatures : CurvatureProfile [1/m] or None
    tunnels : tuple of Tunnel
    altitude : float [m]
        Of the track at position 0.
    geometry : Geometry or None
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

    name: str
    length: float
    stations: tuple[Station, ...]
    speed_limits: StepProfile
    gradients: StepProfile
    curvatures: CurvatureProfile | None = None
    tunnels: tuple[Tunnel, ...] = ()
    altitude: float = 0.0
    geometry: Geometry | None = None
    source: str = ""
    braking_parameters: dict[str, float] = field(default_factory=dict)
    survey: Survey | None = None
    assumed: tuple[str, ...] = ()
    reference: LineReference | None = None

    def __post_init__(self) -> None:
        problems = list(self._problems())
        if problems:
            raise InputError.listing(problems)

    def _problems(self) -> Iterator[InputError]:
        """What no line can be, one by one."""
        where = f"line '{self.name}'"
        if not self.length > 0.0:
            yield InputError(f"{where}: length {self.length} m is not positive")
            return
        stopped = self.speed_limits.positions[self.speed_limits.values <= 0.0]
        if stopped.size:
            yield InputError(
                f"{where}: speed limit at km {stopped[0] / 1e3:.3f} is not positive"
                f"{_and_more(stopped)}",
                remedy="a train could never pass; give the permitted speed there",
            )
        steep = self.gradients.positions[np.abs(self.gradients.values) > 0.2]
        if steep.size:
            yield InputError(
                f"{where}: gradient at km {steep[0] / 1e3:.3f} is steeper than 200 per mille"
                f"{_and_more(steep)}",
                remedy="check its unit: are per mille given as '%' or '1'?",
            )
        for name, positions in (
            ("speed limit", self.speed_limits.positions),
            ("gradient", self.gradients.positions),
            ("station", np.array([station.position for station in self.stations])),
        ):
            outside = positions[(positions < 0.0) | (positions > self.length)]
            if outside.size:
                yield InputError(
                    f"{where}: {name} at km {outside[0] / 1e3:.3f} lies before the line's start"
                    f" or beyond the line's end at km {self.length / 1e3:.3f}{_and_more(outside)}"
                )
        for before, station in pairwise(self.stations):
            if station.position < before.position:
                yield InputError(
                    f"{where}: stations are not in the order of their positions:"
                    f" '{station.name}' at km {station.position / 1e3:.3f} stands after"
                    f" '{before.name}' at km {before.position / 1e3:.3f}",
                    remedy="order the stations by position",
                )
        for tunnel in self.tunnels:
            if not (0.0 < tunnel.length < np.inf and 0.0 < tunnel.cross_section < np.inf):
                yield InputError(
                    f"{where}: tunnel at km {tunnel.position / 1e3:.3f} has a length of"
                    f" {tunnel.length:g} m and a cross-section of {tunnel.cross_section:g} m²",
                    remedy="both must be positive",
                )
            if tunnel.position < 0.0 or tunnel.position + tunnel.length > self.length:
                yield InputError(
                    f"{where}: tunnel at km {tunnel.position / 1e3:.3f} leaves the line"
                )

    def __repr__(self) -> str:
        return as_text(self._title, self._summary())

    def _repr_html_(self) -> str:
        s = np.linspace(0.0, self.length, 500)
        drawn = {
            "limit [km/h]": KMH * self.speed_limit(s),
            "altitude [m]": self.altitudes(s).round(1),
        }
        return as_html(self._title, self._summary(), picture(s, drawn, steps=("limit [km/h]",)))

    @property
    def _title(self) -> str:
        return f"Line '{self.name}', {self.length / 1e3:.3f} km"

    def _summary(self) -> dict[str, str]:
        limits, slopes = self.speed_limits, self.gradients
        rows = {
            "stations": ", ".join(station.name for station in self.stations[:4])
            + (f" ... {self.stations[-1].name} ({len(self.stations)})" * (len(self.stations) > 4)),
            "limits": f"{span(limits.values, KMH)} km/h in {limits.values.size} pieces",
            "gradients": f"{span(slopes.values, 1e3, 1)} per mille in {slopes.values.size} pieces",
        }
        if self.curvatures is not None:
            sharpest = float(np.max(np.abs([self.curvatures.start, self.curvatures.end])))
            rows["curves"] = (
                f"{self.curvatures.positions.size} elements"
                + f", radius {1.0 / sharpest:.0f} m at least" * (sharpest > 0.0)
            )
        if self.tunnels:
            rows["tunnels"] = f"{len(self.tunnels)}, {sum(t.length for t in self.tunnels):.0f} m"
        if self.geometry is not None:
            rows["geometry"] = f"{self.geometry.positions.size} points"
        if self.reference is not None:
            known = self.kilometre([0.0, self.length]) / 1e3
            rows["operator's"] = f"{self.reference.name}, km {known[0]:.3f} to {known[1]:.3f}"
        return rows

    def kilometre(self, position: ArrayLike) -> FloatArray:
        """The operator's kilometre, in metres, at each position [m]."""
        if self.reference is None:
            return np.asarray(position, dtype=np.float64)
        return self.reference.at(position, self.length)

    def speed_limit(self, position: ArrayLike) -> FloatArray:
        """Permitted speed [m/s] at each position [m]."""
        return self.speed_limits(position)

    def gradient(self, position: ArrayLike) -> FloatArray:
        """Gradient (rise over run) at each position [m]."""
        return self.gradients(position)

    def curvature(self, position: ArrayLike) -> FloatArray:
        """Signed curvature [1/m] at each position [m]; 0 where it is not known."""
        if self.curvatures is None:
            return np.zeros(np.shape(position))
        return self.curvatures.at(position, self.length)

    def track_acceleration(self, position: ArrayLike) -> FloatArray:
        """Deceleration by the track itself [m/s²]: gradient and curves, for any mass.

        ``g (sin(alpha) + k_C |curvature|)``; Amirhosseini et al. (2024), eq. (6) and (7).

        Examples
        --------
        >>> from trainlog.formats.line import read_line
        >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
        >>> line.track_acceleration([1_000.0, 5_000.0]).round(4).tolist()
        [-0.0971, 0.0573]
        """
        slope = self.gradient(position)
        sine = slope / np.sqrt(1.0 + slope**2)
        return np.asarray(GRAVITY * (sine + curve_force_per_weight(self.curvature(position))))

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
        edges, values = self.gradients.positions, self.gradients.values
        at_edges = self.altitude + np.concatenate(([0.0], np.cumsum(values[:-1] * np.diff(edges))))
        s = np.asarray(position, dtype=np.float64)
        index = np.maximum(np.searchsorted(edges, s, side="right") - 1, 0)
        return np.asarray(at_edges[index] + values[index] * (s - edges[index]))

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

    def pieces(self) -> Pieces:
        """The line between its breakpoints, as compiled code reads it."""
        start = self.breakpoints
        start = start[start < self.length]
        width = np.diff(np.append(start, self.length))
        inside = start + 1e-6 * width
        nearly = start + (1.0 - 1e-6) * width
        slope = self.gradient(start)
        curvature = self.curvature(inside)
        bend = (self.curvature(nearly) - curvature) / (nearly - inside)
        return Pieces(start, width, slope / np.hypot(1.0, slope), curvature, bend)

    def limits_over(self, train_length: float) -> StepProfile:
        """The speed limits [m/s] as a train meets them whose rear must have passed a restriction.

        Parameters
        ----------
        train_length : float [m]
            Length that a limit protects; 0: the limits of the train's front.

        Examples
        --------
        >>> from trainlog.formats.line import read_line
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
        >>> from trainlog.formats.line import read_line
        >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
        >>> line.reversed().stations[0].name
        'Wil'
        """
        return Line(
            name=self.name,
            length=self.length,
            stations=tuple(
                Station(station.name, self.length - station.position)
                for station in reversed(self.stations)
            ),
            speed_limits=self.speed_limits.reversed(self.length),
            gradients=self.gradients.reversed(self.length, sign=-1.0),
            curvatures=None if self.curvatures is None else self.curvatures.reversed(self.length),
            tunnels=tuple(
                Tunnel(self.length - t.position - t.length, t.length, t.cross_section)
                for t in reversed(self.tunnels)
            ),
            altitude=float(self.altitudes(self.length)),
            geometry=None if self.geometry is None else self.geometry.reversed(self.length),
            source=self.source,
            braking_parameters=self.braking_parameters,
            survey=self.survey,
            assumed=self.assumed,
            reference=None if self.reference is None else self.reference.reversed(self.length),
        )


def _and_more(places: FloatArray) -> str:
    """How many places there are besides the first."""
    return f" (and {places.size - 1} more)" if places.size > 1 else ""

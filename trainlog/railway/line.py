"""A line: what lies under the train as a function of chainage.

Chainage `s` [m] runs from 0 to the line's length in the direction of travel; `Line.reversed`
gives the same line travelled the other way, `Line.section` a part of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray, IntArray
from trainlog.declaration import (
    POSITIVE,
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
from trainlog.plotted import Plotted
from trainlog.railway.line_parts import (
    POSITION,
    TINY,
    CurvatureProfile as CurvatureProfile,
    Geometry as Geometry,
    Leg as Leg,
    LineReference as LineReference,
    Station as Station,
    StepProfile as StepProfile,
    Survey as Survey,
    Tunnel as Tunnel,
    route_words as route_words,
    tunnels_between,
)
from trainlog.railway.resistance import (
    CURVE_FORMULAS,
    LEAST_RADIUS,
    CurveFormula,
    curve_coefficients,
    curve_force_per_weight,
    specific_curve_resistance,
)
from trainlog.units import GRAVITY, KMH

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
class Line(Declared, Plotted):
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
        Part(
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
        backwards = self.limits_against
        for limits, words in ((self.speed_limits, ""), (backwards, " of the other direction")):
            stopped = limits.positions[limits.values <= 0.0]
            if stopped.size:
                yield InputError(
                    f"{where}: speed limit{words} at km {stopped[0] / 1e3:.3f} is not positive"
                    f"{_and_more(stopped)}",
                    remedy="a train could never pass; give the permitted speed there",
                )
            if self.speed_limits_reverse is None:
                break
        edges, over = self.gradients.positions, min(STEEP_OVER, self.length)
        first = np.clip(edges, 0.0, self.length - over)
        means = np.abs(self.gradients.mean(first, first + over))
        # A gradient of just so much stays one wherever its mean is rounded.
        most = STEEPEST * (1.0 + 1e-9)
        steep = edges[(means > most) | (np.abs(self.gradients.values) > STEEPEST_POINT)]
        if steep.size:
            yield InputError(
                f"{where}: gradient at km {steep[0] / 1e3:.3f} is steeper than 200 per mille"
                f"{_and_more(steep)}",
                remedy="check its unit: are per mille given as '%' or '1'?",
            )
        for name, positions in (
            ("speed limit", np.union1d(self.speed_limits.positions, backwards.positions)),
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
        yield from self._curve_problems(where)
        for tunnel in self.tunnels:
            if tunnel.position < -TINY or tunnel.position + tunnel.length > self.length + TINY:
                yield InputError(
                    f"{where}: tunnel at km {tunnel.position / 1e3:.3f} leaves the line"
                )
        yield from self._leg_problems(where)

    def _leg_problems(self, where: str) -> Iterator[InputError]:
        """Legs that leave a part of the line out, or lie over each other."""
        begins = [leg.position for leg in self.legs] + [self.length] * bool(self.legs)
        ends = [0.0] * bool(self.legs) + [leg.end for leg in self.legs]
        for begin, end in zip(begins, ends, strict=True):
            if abs(begin - end) > 1e-3:
                yield InputError(
                    f"{where}: its legs leave km {min(begin, end) / 1e3:.3f} to"
                    f" {max(begin, end) / 1e3:.3f} out or cover it twice",
                    remedy="each leg must begin where the one before ends",
                )

    def _curve_problems(self, where: str) -> Iterator[InputError]:
        """A formula that does not hold for the curves of the line."""
        if self.curve_resistance in CURVE_FORMULAS and self.curvatures is not None:
            size = np.maximum(np.abs(self.curvatures.start), np.abs(self.curvatures.end))
            offset = curve_coefficients(size, self.curve_resistance)[1]
            sharp = np.flatnonzero(LEAST_RADIUS * offset * size > 1.0)
            if sharp.size:
                at = sharp[0]
                yield InputError(
                    f"{where}: the curve resistance '{self.curve_resistance}' does not hold for the"
                    f" radius of {1.0 / size[at]:.0f} m at"
                    f" km {self.curvatures.positions[at] / 1e3:.3f}"
                    f"{_and_more(self.curvatures.positions[sharp])}",
                    remedy=f"it needs {LEAST_RADIUS * offset[at]:.0f} m; correct the radius, or"
                    " state 'proportional'",
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
            sharpest = float(np.max(np.abs([self.curvatures.start, self.curvatures.end])))
            rows["curves"] = (
                f"{self.curvatures.positions.size} elements"
                + (f", radius {1.0 / sharpest:.0f} m at least" if sharpest > 0.0 else "")
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
            return self._pieces_under(train_length)
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

    def _pieces_under(self, train_length: float) -> Pieces:
        """Pieces of at most `LONGEST_PIECE` between the edges, for a train of a length."""
        edges = self.edges(train_length)
        counts = np.ceil(np.diff(edges) / LONGEST_PIECE).astype(np.int64)
        first = np.repeat(np.cumsum(counts) - counts, counts)
        share = (np.arange(counts.sum()) - first) / np.repeat(counts, counts)
        start = np.repeat(edges[:-1], counts) + share * np.repeat(np.diff(edges), counts)
        width = np.diff(np.append(start, self.length))
        sine = self.track_acceleration(np.append(start, self.length), train_length) / GRAVITY
        none = np.zeros(start.size)
        return Pieces(start, width, sine[:-1], np.diff(sine) / width, none, none, none, none)

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
        return replace(
            self,
            stations=tuple(
                Station(station.name, self.length - station.position)
                for station in reversed(self.stations)
            ),
            speed_limits=self.limits_against.reversed(self.length),
            gradients=self.gradients.reversed(self.length, sign=-1.0),
            tunnels=tuple(
                Tunnel(self.length - t.position - t.length, t.length, t.cross_section)
                for t in reversed(self.tunnels)
            ),
            altitude=float(self.altitudes(self.length)),
            legs=tuple(leg.reversed(self.length) for leg in reversed(self.legs)),
            speed_limits_reverse=self.speed_limits_reverse
            and self.speed_limits.reversed(self.length),
            curvatures=self.curvatures and self.curvatures.reversed(self.length),
            geometry=self.geometry and self.geometry.reversed(self.length),
            reference=self.reference and self.reference.reversed(self.length),
        )

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
                f"line '{self.name}': km {start / 1e3:.3f} to {end / 1e3:.3f} is no stretch of it",
                remedy=f"it is {self.length / 1e3:.3f} km long",
            )
        length = end - start
        inside = (start - TINY, end + TINY)
        return replace(
            self,
            length=length,
            stations=tuple(
                Station(each.name, min(max(each.position - start, 0.0), length))
                for each in self.stations
                if inside[0] <= each.position <= inside[1]
            ),
            speed_limits=self.speed_limits.between(start, end),
            gradients=self.gradients.between(start, end),
            curvatures=self.curvatures and self.curvatures.between(start, end, self.length),
            tunnels=tuple(tunnels_between(self.tunnels, start, end)),
            altitude=float(self.altitudes(start)),
            geometry=self.geometry and self.geometry.between(start, end),
            reference=self.reference and self.reference.between(start, end, self.length),
            legs=tuple(filter(None, (leg.between(start, end) for leg in self.legs))),
            speed_limits_reverse=self.speed_limits_reverse
            and self.speed_limits_reverse.between(start, end),
        )


def _and_more(places: FloatArray) -> str:
    """How many places there are besides the first."""
    return f" (and {places.size - 1} more)" if places.size > 1 else ""


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

"""What stands in the file of a line, ``"trainlog/line"``; docs/formats.md describes its keys."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.formats.plausible import implausible_line
from trainlog.formats.schema import (
    INFINITY,
    Column,
    File,
    Named,
    Part,
    Quantity,
    Table,
    gathered,
    readable,
)
from trainlog.railway.line import (
    CurvatureProfile,
    Geometry,
    Leg,
    Line,
    LineReference,
    Station,
    StepProfile,
    Survey,
    Tunnel,
)
from trainlog.railway.resistance import CurveFormula

_POSITION = Column("position", "m", "m")
_Length = Annotated[float, Quantity("m", "m")]
_Stations = Annotated[tuple[Any, ...], Table((Column("name"), _POSITION))]
_Limits = Annotated[tuple[Any, ...], Table((_POSITION, Column("speed", "km/h", "m/s")))]
_Gradients = Annotated[tuple[Any, ...], Table((_POSITION, Column("gradient", "permil", "1")))]
_Curvatures = Annotated[
    tuple[Any, ...],
    Table(
        (
            _POSITION,
            Column("radius_at_start", "m", "m", INFINITY),
            Column("radius_at_end", "m", "m", INFINITY),
        )
    ),
]
_Tunnels = Annotated[
    tuple[Any, ...],
    Table((_POSITION, Column("length", "m", "m"), Column("cross_section", "m^2", "m^2"))),
]
_Braking = Annotated[
    dict[str, float], Named({"M_NVAVADH": Quantity("1", "1"), "Kt_int": Quantity("1", "1")})
]
_Track = Annotated[
    tuple[Any, ...],
    Table((_POSITION, Column("latitude", "deg", "deg"), Column("longitude", "deg", "deg"))),
]


_Kilometres = Annotated[
    tuple[Any, ...],
    Table((_POSITION, Column("km_at_start", "km", "m"), Column("km_at_end", "km", "m"))),
]


_Legs = Annotated[
    tuple[Any, ...],
    Table(
        (
            Column("edge"),
            _POSITION,
            *(Column(name, "m", "m") for name in ("length", "edge_start", "edge_end")),
            Column("edge_length", "m", "m"),
        )
    ),
]


class _Reference(Part):
    name: str = Field(min_length=1)
    kilometres: _Kilometres

    def reference(self) -> LineReference:
        _check_rows("reference.kilometres", self.kilometres[0])
        return LineReference(self.name, *self.kilometres)


class _Geometry(Part):
    quality: str
    track: _Track

    def geometry(self) -> Geometry:
        positions, latitudes, longitudes = self.track
        return Geometry(positions, latitudes, longitudes, self.quality)


class _Survey(Part):
    gradient_std: Annotated[float, Quantity("permil", "1")]
    correlation_length: _Length | None = None


class LineFile(File):
    """A line as it stands in its file."""

    FORMAT: ClassVar[str] = "trainlog/line"
    VERSION: ClassVar[int] = 2

    name: str = Field(min_length=1)
    source: str = ""
    length: _Length
    altitude: _Length = 0.0
    stations: _Stations
    speed_limits: _Limits
    gradients: _Gradients
    survey: _Survey | None = None
    curvatures: _Curvatures | None = None
    tunnels: _Tunnels | None = None
    braking_parameters: _Braking | None = None
    geometry: _Geometry | None = None
    assumed: list[str] | None = None
    reference: _Reference | None = None
    curve_resistance: CurveFormula | None = None
    legs: _Legs | None = None
    speed_limits_reverse: _Limits | None = None

    @property
    def version_needed(self) -> int:
        """2 where limits differ by direction; older programs are to refuse the file for that."""
        return 1 if self.speed_limits_reverse is None else 2

    def content(self) -> Line:
        """The line that the file describes."""
        return self.line()

    @classmethod
    def implausible(cls, values: dict[str, Any]) -> list[InputError]:
        """What of `values` cannot be meant; see `trainlog.formats.plausible`."""
        return list(implausible_line(values))

    def line(self) -> Line:
        """The line that the file describes."""
        limits, gradients, curvatures, geometry, survey, reference, route, against = gathered(
            lambda: profile("speed_limits", *self.speed_limits),
            lambda: profile("gradients", *self.gradients),
            lambda: None if self.curvatures is None else curvature_profile(*self.curvatures),
            lambda: None if self.geometry is None else self.geometry.geometry(),
            lambda: None if self.survey is None else Survey(**dict(self.survey)),
            lambda: None if self.reference is None else self.reference.reference(),
            lambda: legs(self.legs),
            lambda: (
                None
                if self.speed_limits_reverse is None
                else profile("speed_limits_reverse", *self.speed_limits_reverse)
            ),
        )
        return Line(
            name=self.name,
            length=self.length,
            stations=tuple(
                Station(name, float(at)) for name, at in zip(*self.stations, strict=True)
            ),
            speed_limits=limits,
            gradients=gradients,
            curvatures=curvatures,
            tunnels=tunnels(self.tunnels),
            altitude=self.altitude,
            geometry=geometry,
            source=self.source,
            braking_parameters=self.braking_parameters or {},
            survey=survey,
            assumed=tuple(self.assumed or ()),
            reference=reference,
            curve_resistance=self.curve_resistance or "proportional",
            legs=route,
            speed_limits_reverse=against,
        )

    @staticmethod
    def of(line: Line) -> LineFile:
        """The file that describes a line."""
        curves, geometry, limits = line.curvatures, line.geometry, line.speed_limits
        own, against = line.reference, line.speed_limits_reverse
        return LineFile.holding(
            line,
            stations=([s.name for s in line.stations], [s.position for s in line.stations]),
            speed_limits=(limits.positions, limits.values),
            speed_limits_reverse=None if against is None else (against.positions, against.values),
            gradients=(line.gradients.positions, line.gradients.values),
            survey=None if line.survey is None else _Survey.holding(line.survey),
            curvatures=None if curves is None else radii(curves),
            tunnels=tunnel_columns(line.tunnels),
            braking_parameters=line.braking_parameters or None,
            assumed=list(line.assumed) or None,
            curve_resistance=None
            if line.curve_resistance == "proportional"
            else line.curve_resistance,
            legs=leg_columns(line.legs),
            reference=None
            if own is None
            else _Reference.holding(own, kilometres=(own.positions, own.start, own.end)),
            geometry=None
            if geometry is None
            else _Geometry.holding(
                geometry,
                track=(geometry.positions, geometry.latitudes, geometry.longitudes),
            ),
        )


def profile(place: str, positions: FloatArray, values: FloatArray) -> StepProfile:
    """A step profile, whose errors name the row of the table at `place`."""
    _check_rows(place, positions)
    return StepProfile(positions, values)


def curvature_profile(
    positions: FloatArray, start_radii: FloatArray, end_radii: FloatArray
) -> CurvatureProfile:
    """Curvature from signed radii [m], infinite on straight track; errors name the row."""
    _check_rows("curvatures", positions)
    none = (start_radii == 0.0) | (end_radii == 0.0)
    if np.any(none):
        raise InputError(
            "the radius is 0 m",
            place=f"curvatures.values[{int(np.argmax(none))}]",
            remedy="straight track has the radius 'infinity'",
        )
    return CurvatureProfile(positions, 1.0 / start_radii, 1.0 / end_radii)


def tunnels(table: tuple[FloatArray, ...] | None) -> tuple[Tunnel, ...]:
    """Tunnels from the columns of their table."""
    if table is None:
        return ()
    return tuple(Tunnel(*map(float, row)) for row in zip(*table, strict=True))


def tunnel_columns(rows: tuple[Tunnel, ...]) -> tuple[list[float], ...] | None:
    """The columns of the table of tunnels, or None if there are none."""
    names = ("position", "length", "cross_section")
    return tuple([getattr(tunnel, name) for tunnel in rows] for name in names) if rows else None


def legs(table: tuple[Any, ...] | None) -> tuple[Leg, ...]:
    """Legs from the columns of their table."""
    if table is None:
        return ()
    return tuple(Leg(row[0], *map(float, row[1:])) for row in zip(*table, strict=True))


def leg_columns(rows: tuple[Leg, ...]) -> tuple[list[Any], ...] | None:
    """The columns of the table of legs, or None if there are none."""
    names = Leg.__dataclass_fields__
    return tuple([getattr(leg, name) for leg in rows] for name in names) if rows else None


def _check_rows(place: str, positions: FloatArray) -> None:
    problems = [
        InputError(
            f"position {positions[row + 1]:.12g} m follows {positions[row]:.12g} m",
            place=f"{place}.values[{row + 1}]",
            remedy="positions must increase",
        )
        for row in np.flatnonzero(np.diff(positions) <= 0.0)
    ]
    if positions.size == 0 or positions[0] != 0.0:
        first = InputError(
            "the first row is not at position 0",
            place=f"{place}.values",
            remedy="give what holds from the line's start",
        )
        problems.insert(0, first)
    if problems:
        raise InputError.listing(problems)


def radii(curves: CurvatureProfile) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions and signed radii [m] at start and end."""
    return curves.positions, _radii(curves.start), _radii(curves.end)


def _radii(curvature: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore", over="ignore"):
        return readable(curvature, 1.0 / curvature, lambda radius: 1.0 / radius)

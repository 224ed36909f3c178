"""The formats of lines and of journeys on them, ``"trainlog/line"`` and ``"trainlog/journey"``.

docs/formats.md describes their keys.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from trainlog.errors import InputError
from trainlog.formats.files import check_written, read_bytes, write_bytes
from trainlog.formats.plausible import implausible_line
from trainlog.formats.schema import (
    INFINITY,
    MISSING,
    Column,
    File,
    FloatArray,
    Named,
    Part,
    Quantity,
    Table,
    built,
    gathered,
    readable,
)
from trainlog.railway.journey import Journey, TimingPoint
from trainlog.railway.line import (
    CurvatureProfile,
    Geometry,
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


class _LineFile(File):
    FORMAT: ClassVar[str] = "trainlog/line"

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

    def content(self) -> Line:
        return self.line()

    @classmethod
    def implausible(cls, values: dict[str, Any]) -> list[InputError]:
        return list(implausible_line(values))

    def line(self) -> Line:
        """The line that the file describes."""
        limits, gradients, curvatures, geometry, survey, reference = gathered(
            lambda: profile("speed_limits", *self.speed_limits),
            lambda: profile("gradients", *self.gradients),
            lambda: None if self.curvatures is None else curvature_profile(*self.curvatures),
            lambda: None if self.geometry is None else self.geometry.geometry(),
            lambda: None if self.survey is None else Survey(**dict(self.survey)),
            lambda: None if self.reference is None else self.reference.reference(),
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
        )

    @staticmethod
    def of(line: Line) -> _LineFile:
        """The file that describes a line."""
        curves, geometry, limits = line.curvatures, line.geometry, line.speed_limits
        own = line.reference
        return _LineFile.holding(
            line,
            stations=([s.name for s in line.stations], [s.position for s in line.stations]),
            speed_limits=(limits.positions, limits.values),
            gradients=(line.gradients.positions, line.gradients.values),
            survey=None if line.survey is None else _Survey.holding(line.survey),
            curvatures=None if curves is None else radii(curves),
            tunnels=tunnel_columns(line.tunnels),
            braking_parameters=line.braking_parameters or None,
            assumed=list(line.assumed) or None,
            curve_resistance=None
            if line.curve_resistance == "proportional"
            else line.curve_resistance,
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


def line_from_bytes(data: bytes, *, file: str | Path = "line.json") -> Line:
    """The line in the bytes of a line file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a line file, naming the place and the remedy.

    Examples
    --------
    >>> line_from_bytes(read_bytes("sample_logs/CH_StGallen_Wil.line.json")).stations[0].position
    0.0
    >>> line_from_bytes(b"{}")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: line.json: is not a trainlog/line file: it has no key...
    """
    return built(_LineFile.from_bytes(data, file).line, file)


def line_to_bytes(line: Line) -> bytes:
    """The bytes of the line's file: the same line gives the same bytes.

    Examples
    --------
    >>> path = Path("sample_logs/CH_StGallen_Wil.line.json")
    >>> line_to_bytes(read_line(path)) == path.read_bytes()
    True
    """
    return _LineFile.of(line).to_bytes()


def line_content(line: Line) -> dict[str, Any]:
    """What stands in a line's file, as plain values.

    Examples
    --------
    >>> line_content(read_line("sample_logs/CH_StGallen_Wil.line.json"))["length"]
    {'value': 29556.1, 'unit': 'm'}
    """
    return _LineFile.of(line).file_content()


def read_line(path: str | Path) -> Line:
    """Read a line file, JSON or TOML.

    Raises
    ------
    InputError
        As `line_from_bytes`, if the file cannot be read, or if values cannot be meant: limits of
        1,000 km/h. All that is wrong is listed at once.

    Examples
    --------
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> line.name, line.length
    ('CH_StGallen_Wil', 29556.1)
    """
    line: Line = _LineFile.read(read_bytes(path), path)
    return line


def write_line(line: Line, path: str | Path) -> None:
    """Write a line file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_line(line, Path(folder) / "copy.line.json")
    ...     read_line(Path(folder) / "copy.line.json").name
    'CH_StGallen_Wil'
    """
    check_written(line, Line)
    write_bytes(path, _LineFile.of(line).bytes_for(path))


_Points = Annotated[
    tuple[Any, ...],
    Table(
        (
            Column("position", "m", "m"),
            Column("earliest", "s", "s", MISSING),
            Column("latest", "s", "s", MISSING),
            Column("lowest_speed", "km/h", "m/s", MISSING),
            Column("highest_speed", "km/h", "m/s", MISSING),
        )
    ),
]


class _JourneyFile(File):
    FORMAT: ClassVar[str] = "trainlog/journey"

    name: str = Field(min_length=1)
    source: str = ""
    line: str
    timing_points: _Points

    def content(self) -> Journey:
        return self.journey()

    def journey(self) -> Journey:
        """The journey that the file describes."""
        return Journey(self.name, self.line, timing_points(self.timing_points), self.source)

    @staticmethod
    def of(journey: Journey) -> _JourneyFile:
        """The file that describes a journey."""
        return _JourneyFile.holding(journey, timing_points=timing_columns(journey.points))


def timing_points(table: tuple[Any, ...]) -> tuple[TimingPoint, ...]:
    """Timing points from the columns of their table, NaN where there is no bound."""
    rows = np.column_stack(table)
    return tuple(
        TimingPoint(row[0], *(None if np.isnan(bound) else bound for bound in row[1:]))
        for row in rows.tolist()
    )


def timing_columns(points: tuple[TimingPoint, ...]) -> tuple[list[float], ...]:
    """The columns of the table of timing points, NaN where there is no bound."""
    names = TimingPoint.__dataclass_fields__
    cells = ([getattr(point, name) for point in points] for name in names)
    return tuple([np.nan if cell is None else cell for cell in column] for column in cells)


def journey_from_bytes(data: bytes, *, file: str | Path = "journey.json") -> Journey:
    """The journey in the bytes of a journey file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a journey file, naming the place and the remedy.

    Examples
    --------
    >>> journey = Journey("R 1", "short", (TimingPoint(0.0), TimingPoint(9e3, latest=600.0)))
    >>> journey_from_bytes(journey_to_bytes(journey)).points[1].latest
    600.0
    """
    return built(_JourneyFile.from_bytes(data, file).journey, file)


def journey_to_bytes(journey: Journey) -> bytes:
    """The bytes of the journey's file: the same journey gives the same bytes.

    Examples
    --------
    >>> journey = Journey("R 1", "short", (TimingPoint(0.0), TimingPoint(9e3, latest=600.0)))
    >>> len(journey_to_bytes(journey).splitlines()) > 5
    True
    """
    return _JourneyFile.of(journey).to_bytes()


def journey_content(journey: Journey) -> dict[str, Any]:
    """What stands in a journey's file, as plain values.

    Examples
    --------
    >>> journey = Journey("R 1", "short", (TimingPoint(0.0), TimingPoint(9e3, latest=600.0)))
    >>> journey_content(journey)["timing_points"]["values"][1]
    [9000, None, 600, None, None]
    """
    return _JourneyFile.of(journey).file_content()


def read_journey(path: str | Path) -> Journey:
    """Read a journey file, JSON or TOML.

    Raises
    ------
    InputError
        As `journey_from_bytes`, and if the file cannot be read.

    Examples
    --------
    >>> read_journey("absent.journey.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.journey.json: does not exist; check the path
    """
    journey: Journey = _JourneyFile.read(read_bytes(path), path)
    return journey


def write_journey(journey: Journey, path: str | Path) -> None:
    """Write a journey file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> journey = Journey("R 1", "short", (TimingPoint(0.0), TimingPoint(9e3, latest=600.0)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_journey(journey, Path(folder) / "r1.journey.json")
    ...     read_journey(Path(folder) / "r1.journey.json") == journey
    True
    """
    check_written(journey, Journey)
    write_bytes(path, _JourneyFile.of(journey).bytes_for(path))

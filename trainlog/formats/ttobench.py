"""TTOBench's tracks, trains and journeys: read from and written in the library's own layout.

D. Kouzoupis, I. Pendharkar, F. Corman: TTOBench - an Open-Source Library for Train Trajectory
Optimization. Operations Research Forum 4 (2023), 67. doi:10.1007/s43069-023-00248-x. The layout
is that of version 1.5, which has tunnels, ETCS braking data and journeys. The library has no file
of maximum adhesion along a track; the one here is laid out as its tracks are.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.declaration import (
    INFINITY,
    NOT_SET,
    POSITIVE,
    Array,
    Column,
    Declared,
    Named,
    Part,
    Quantity,
    Table,
    Text,
    content_of,
    entries,
    from_content,
)
from trainlog.errors import InputError
from trainlog.formats.declared import built
from trainlog.formats.files import read_json, to_bytes, write_bytes
from trainlog.railway.line import POSITION, CurvatureProfile, Line, Station, StepProfile, Tunnel
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import Axles, BrakingCurves, Train
from trainlog.railway.trajectory import Journey, TimingPoint
from trainlog.units import GRAVITY

LIBRARY_VERSION = "TTOBench v1.5"
"""The version of the layout, written into files that do not come from the library."""

_Length = Annotated[float, Quantity("m", "m")]
_Mass = Annotated[float, Quantity("kg", "kg", must=POSITIVE)]
_Speed = Annotated[float, Quantity("km/h", "m/s")]
_Acceleration = Annotated[float, Quantity("m/s^2", "m/s^2")]
_Power = Annotated[float, Quantity("kW", "W")]
_Force = Annotated[float, Quantity("kN", "N")]
_Linear = Annotated[float, Quantity("kN/(km/h)", "N/(m/s)")]
_Quadratic = Annotated[float, Quantity("kN/(km/h)^2", "N/(m/s)^2")]
_Share = Annotated[float, Quantity("%", "1")]
_Count = Annotated[float, Quantity("-", "1")]

_LENGTH_TABLE = (
    Column("position", "m", "m"),
    Column("length", "m", "m"),
    Column("cross section", "m^2", "m^2"),
)
_TUNNEL_RESISTANCE = (
    Column("cross section", "m^2", "m^2"),
    Column("coefficient", "kN/(km/h)^2", "N/(m/s)^2"),
)
_RADII = (
    POSITION,
    Column("radius at start", "m", "m", INFINITY, inverse=True),
    Column("radius at end", "m", "m", INFINITY, inverse=True),
)
_TIMING_POINTS = (
    Column("position", "m", "m"),
    Column("lower time constraint", "s", "s", NOT_SET),
    Column("upper time constraint", "s", "s", NOT_SET),
    Column("lower speed constraint", "km/h", "m/s", NOT_SET),
    Column("upper speed constraint", "km/h", "m/s", NOT_SET),
)
_DECELERATION = (Column("velocity", "m/s", "m/s"), Column("deceleration", "m/s^2", "m/s^2"))
_Pairs = tuple[tuple[float, float], ...]
_ETCS = "ETCS braking data"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Layout(Declared):
    """A file whose keys are words with spaces between."""

    SPACED: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Metadata(Layout):
    """Who made a file, and what it is called."""

    id: Annotated[str, Text(least=1)]
    library_version: str
    created_by: str | None = None
    license: str | None = None
    description: str | None = None
    associated_track: str | None = None

    @property
    def source(self) -> str:
        """Everything but the names, in words that `of` takes apart again."""
        if (self.library_version, self.created_by, self.license) == (LIBRARY_VERSION, None, None):
            return self.description or ""
        words = {
            "created by": self.created_by,
            "license": self.license,
            "description": self.description,
        }
        parts = [f"; {word} {value}" for word, value in words.items() if value is not None]
        return f"library {self.library_version}{''.join(parts)}"

    @staticmethod
    def of(name: str, source: str, track: str | None = None) -> Metadata:
        """The metadata of something called `name` with that source."""
        found = re.fullmatch(
            r"library (.*?)(?:; created by (.*?))?(?:; license (.*?))?(?:; description (.*))?",
            source,
        )
        version, author, licence, description = found.groups() if found else (None,) * 4
        return Metadata(
            id=name,
            library_version=version or LIBRARY_VERSION,
            created_by=author,
            license=licence,
            description=description if found else source or None,
            associated_track=track,
        )


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class TrackLayout(Layout):
    """A track."""

    metadata: Metadata
    altitude: _Length | None = None
    stops: Annotated[FloatArray, Array("m")]
    speed_limits: Annotated[StepProfile, Table((POSITION, Column("velocity", "km/h", "m/s")))]
    gradients: Annotated[StepProfile | None, Table((POSITION, Column("slope", "permil", "1")))] = (
        None
    )
    curvatures: Annotated[CurvatureProfile | None, Table(_RADII)] = None
    tunnels: Annotated[tuple[Tunnel, ...], Table(_LENGTH_TABLE)] = ()
    etcs: Annotated[
        dict[str, float] | None,
        Named({"M_NVAVADH": Quantity("-", "1"), "Kt_int": Quantity("-", "1")}, key=_ETCS),
    ] = None

    def thing(self) -> Line:
        """The line that the track is."""
        _check_stops(self.stops)
        return Line(
            name=self.metadata.id,
            length=float(self.stops[-1]),
            stations=tuple(Station(f"km {s / 1e3:.3f}", s) for s in self.stops.tolist()),
            speed_limits=self.speed_limits,
            gradients=self.gradients or _LEVEL,
            curvatures=self.curvatures,
            tunnels=self.tunnels,
            altitude=self.altitude or 0.0,
            source=self.metadata.source,
            braking_parameters=self.etcs or {},
        )

    @staticmethod
    def of(line: Line) -> TrackLayout:
        """The track that a line is."""
        stops = np.array([station.position for station in line.stations])
        if stops.size < 2 or stops[0] != 0.0 or stops[-1] != line.length:
            raise InputError(
                f"line '{line.name}' does not begin and end at a station, as a TTOBench track does",
                remedy="add stations at its ends",
            )
        return TrackLayout(
            metadata=Metadata.of(line.name, line.source),
            altitude=line.altitude,
            stops=stops,
            speed_limits=line.speed_limits,
            gradients=line.gradients,
            curvatures=line.curvatures,
            tunnels=line.tunnels,
            etcs=line.braking_parameters or None,
        )


_LEVEL = StepProfile(np.zeros(1), np.zeros(1))


def _check_stops(stops: FloatArray) -> None:
    if stops.size < 2 or stops[0] != 0.0:
        raise InputError(
            "needs at least two stops, the first at 0 m",
            place="stops.values",
            remedy="give both ends of the track",
        )
    falling = np.flatnonzero(np.diff(stops) <= 0.0)
    if falling.size:
        raise InputError(
            f"stop at {stops[falling[0] + 1]:.12g} m follows stop at {stops[falling[0]]:.12g} m",
            place=f"stops.values[{falling[0] + 1}]",
            remedy="positions must increase",
        )


@dataclass(frozen=True, eq=False, repr=False)
class Etcs(Declared):
    """ETCS braking data of a train."""

    emergency: Annotated[_Pairs, Table(_DECELERATION, key="A_brake_emergency")] = ()
    service: Annotated[_Pairs, Table(_DECELERATION, key="A_brake_service")] = ()
    dry: Annotated[float | None, Quantity("-", "1", key="K_dry_rst")] = None
    wet: Annotated[float | None, Quantity("-", "1", key="K_wet_rst")] = None
    cut_off: Annotated[float | None, Quantity("s", "s", key="T_traction")] = None
    build_up: Annotated[float | None, Quantity("s", "s", key="T_be")] = None
    service_build_up: Annotated[float | None, Quantity("s", "s", key="T_bs")] = None
    uncertainty: Annotated[float | None, Quantity("%", "%", key="v_uncertainty")] = None

    def curves(self) -> BrakingCurves:
        """The braking curves, and the constants by their published names."""
        constants = {name: getattr(self, field) for name, field in _published().items()}
        known = {name: value for name, value in constants.items() if value is not None}
        return BrakingCurves(self.emergency, self.service, known)

    @staticmethod
    def of(curves: BrakingCurves) -> Etcs:
        """The data that braking curves are."""
        published = _published()
        for name in curves.parameters:
            if name not in published:
                raise InputError(
                    f"braking parameter '{name}' is not known to TTOBench",
                    remedy=f"known are {', '.join(sorted(published))}",
                )
        constants = {published[name]: value for name, value in curves.parameters.items()}
        return Etcs(curves.emergency, curves.service, **constants)


def _published() -> dict[str, str]:
    """Fields of the constants of `Etcs` by their published names."""
    return {entry.key: entry.names[0] for entry in entries(Etcs) if entry.kind is float}


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class TrainLayout(Layout):
    """A train."""

    metadata: Metadata
    num_seats: _Count | None = None
    num_coaches: _Count | None = None
    length: _Length | None = None
    mass: _Mass
    rotating_mass_factor: Annotated[float | None, Quantity("%", "1", key="rho")] = None
    max_traction_power: _Power
    max_dynamic_braking_power: Annotated[float, Quantity("kW", "W", key="max reg braking power")]
    max_tractive_effort: Annotated[float, Quantity("kN", "N", key="max traction force")]
    max_dynamic_braking_effort: Annotated[float, Quantity("kN", "N", key="max reg braking force")]
    max_pneumatic_braking_effort: Annotated[
        float | None, Quantity("kN", "N", key="max pn braking force")
    ] = None
    max_acceleration: _Acceleration | None = None
    max_deceleration: _Acceleration | None = None
    max_speed: _Speed
    rolling_resistance_r0: _Force
    rolling_resistance_r1: _Linear
    rolling_resistance_r2: _Quadratic
    efficiency_traction: _Share | None = None
    efficiency_regeneration: Annotated[
        float | None, Quantity("%", "1", key="efficiency reg brake")
    ] = None
    tunnel_resistance: Annotated[_Pairs, Table(_TUNNEL_RESISTANCE)] = ()
    etcs: Annotated[Etcs | None, Part(key=_ETCS)] = None

    def thing(self) -> Train:
        """The train that the file describes."""
        rotating = self.rotating_mass_factor or 0.0
        if not 0.0 <= rotating < 1.0:
            raise InputError(
                f"the rotating parts would weigh {rotating:.12g} times the train",
                place="rho",
                remedy="give the part above 1, for example 0.06 or 6 %",
            )
        given = {n: each for n in _SHARED if (each := getattr(self, n)) is not None}
        # The accelerations that effort and mass allow, where nothing else limits them.
        inertia = self.mass * (1.0 + rotating)
        braking = self.max_dynamic_braking_effort + (self.max_pneumatic_braking_effort or 0.0)
        unlimited = {
            "max_acceleration": self.max_tractive_effort / inertia,
            "max_deceleration": braking / inertia,
        }
        return Train(
            **{"rotating_mass_factor": 0.0} | unlimited | given,
            name=self.metadata.id,
            source=self.metadata.source,
            resistance=RunningResistance(
                self.rolling_resistance_r0, self.rolling_resistance_r1, self.rolling_resistance_r2
            ),
            braking_curves=None if self.etcs is None else self.etcs.curves(),
            seats=_whole("num seats", self.num_seats),
            coaches=_whole("num coaches", self.num_coaches),
            axles=assumed_axles(
                self.mass, max(self.max_tractive_effort, self.max_dynamic_braking_effort), rotating
            ),
            assumed=(*(name for name in _SHARED if name not in given), *_NOT_IN_TTOBENCH),
        )

    @staticmethod
    def of(train: Train) -> TrainLayout:
        """The file that describes a train."""
        for name in ("traction_curve", "dynamic_braking_curve"):
            if getattr(train, name) is not None:
                raise InputError(
                    f"train '{train.name}': TTOBench has no place for its {name.replace('_', ' ')},"
                    " and the largest effort and power alone would promise more",
                    place=name,
                    remedy="write it without the curve if that is meant",
                )
        known = {
            name: getattr(train, name)
            for name in _SHARED
            if name not in train.assumed and not (name == "length" and train.length == 0.0)
        }
        constant, linear, quadratic = train.resistance.parabola
        return TrainLayout(
            metadata=Metadata.of(train.name, train.source),
            num_seats=train.seats,
            num_coaches=train.coaches,
            rolling_resistance_r0=constant,
            rolling_resistance_r1=linear,
            rolling_resistance_r2=quadratic,
            etcs=None if train.braking_curves is None else Etcs.of(train.braking_curves),
            **known,
        )


_OWN = {each.name for each in fields(Train)}
_SHARED = tuple(each.name for each in fields(TrainLayout) if each.name in _OWN)
"""Fields of a train that stand in a file of TTOBench."""

_NOT_IN_TTOBENCH = ("max_load", "axles", "brake")
"""Fields of a train that TTOBench does not know."""


UNPUBLISHED = (
    "max_dynamic_braking_effort",
    "max_dynamic_braking_power",
    "max_pneumatic_braking_effort",
    "efficiency_traction",
    "efficiency_regeneration",
)
"""Fields of a train that no project but TTOBench publishes."""

_AXLE_LOAD = 18_000.0
_ADHESION_IN_USE = 0.29
"""A powered axle carries so much [kg], and full effort uses so much adhesion at most, unless the
train is too light for that: what good dry rail allows."""

_POWERED_SHARE = 0.72
"""Of the rotating mass, at most this share is in the powered axles."""


def assumed_axles(mass: float, effort: float, rotating: float) -> Axles:
    """Powered axles that carry the published effort of the motors [N] without slip on dry rail.

    As many as that needs, each with `_AXLE_LOAD`; no more than the train weighs [kg]. Their
    rotating mass fits into the train's, which is `rotating` times its mass.
    """
    count = max(2, math.ceil(effort / (_ADHESION_IN_USE * GRAVITY * _AXLE_LOAD)))
    usual = Axles()
    if not mass > 0.0:
        return usual  # such a train is refused
    share = _POWERED_SHARE * rotating * mass / count
    return Axles(
        count=count,
        adhesive_mass=min(count * _AXLE_LOAD, mass),
        wheel_radius=usual.wheel_radius,
        rotating_mass=min(usual.rotating_mass, share) if share > 0.0 else usual.rotating_mass,
    )


def _whole(place: str, number: float | None) -> int | None:
    if number is None:
        return None
    if number != int(number) or number < 1:
        raise InputError(f"{number:.12g} is not a count", place=place, remedy="give 1 or more")
    return int(number)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class JourneyLayout(Layout):
    """A journey."""

    metadata: Metadata
    timing_points: Annotated[tuple[TimingPoint, ...], Table(_TIMING_POINTS)]

    def thing(self) -> Journey:
        """The journey that the file describes."""
        if self.metadata.associated_track is None:
            raise InputError(
                "'associated track' is missing", place="metadata", remedy="name the track's id"
            )
        return Journey(
            name=self.metadata.id,
            line=self.metadata.associated_track,
            points=self.timing_points,
            source=self.metadata.source,
        )

    @staticmethod
    def of(journey: Journey) -> JourneyLayout:
        """The file that describes a journey."""
        return JourneyLayout(
            metadata=Metadata.of(journey.name, journey.source, journey.line),
            timing_points=journey.points,
        )


Kind = Literal["track", "train", "journey"]

_TELLING_KEYS: dict[str, Kind] = {"timing points": "journey", "stops": "track", "mass": "train"}


def detect(path: str | Path) -> Kind:
    """Which kind of TTOBench file it is.

    Raises
    ------
    InputError
        If the file cannot be read or is none of the three.

    Examples
    --------
    >>> detect("sample_logs/CH_StGallen_Wil.line.json")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: ...line.json: is a trainlog/line file already; use it as it is
    """
    return _detect(read_json(path), path)


def import_file(path: str | Path) -> Line | Train | Journey:
    """Read a TTOBench file of any kind; errors as `detect` and as the reader of that kind.

    Examples
    --------
    >>> import_file("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    found: Line | Train | Journey = _read(path)
    return found


def read_track(path: str | Path) -> Line:
    """Read a track. Its stops have no names: they are called by their kilometre, "km 0.000".

    Raises
    ------
    InputError
        If the file cannot be read, a key is unknown or missing, a unit is of the wrong kind or a
        value is not possible; names the place.

    Examples
    --------
    >>> read_track("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    line: Line = _read(path, "track")
    return line


def read_train(path: str | Path) -> Train:
    """Read a train; what the file does not give is listed in the train's ``assumed``.

    Acceleration and deceleration without a limit are limited by the train's effort over its mass.

    Raises
    ------
    InputError
        As `read_track`; also for trains whose efficiency is a table of losses.

    Examples
    --------
    >>> read_train("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    train: Train = _read(path, "train")
    return train


def read_journey(path: str | Path) -> Journey:
    """Read a journey; errors as `read_track`.

    Examples
    --------
    >>> read_journey("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    journey: Journey = _read(path, "journey")
    return journey


def write_track(line: Line, path: str | Path) -> list[str]:
    """Write a line as a track.

    Returns
    -------
    list of str
        What the layout has no place for, and the file does not hold: names of stations,
        coordinates, the formula of the curve resistance where it is not the usual one, ...

    Raises
    ------
    InputError
        If the line does not begin and end at a station, as the layout demands, or the file cannot
        be written.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_track(line, Path(folder) / "track.json")
    ...     read_track(Path(folder) / "track.json").length
    ['names of stations', 'coordinates']
    29556.1
    """
    _write(TrackLayout.of(line), path)
    named = any(each.name != f"km {each.position / 1e3:.3f}" for each in line.stations)
    dropped = {
        "names of stations": named,
        "coordinates": line.geometry is not None,
        "speed limits of the other direction": line.speed_limits_reverse is not None,
        "its survey": line.survey is not None,
        "the operator's kilometres": line.reference is not None,
        f"curve resistance '{line.curve_resistance}': a reader takes its own": (
            line.curvatures is not None and line.curve_resistance != Line.curve_resistance
        ),
    }
    return [words for words, lost in dropped.items() if lost]


def write_train(train: Train, path: str | Path) -> list[str]:
    """Write a train, without the fields that are ``assumed``.

    Returns
    -------
    list of str
        What the layout has no place for, and the file does not hold: load, axles, the brake's
        delays, and mass model and acceleration limits where they are not the usual ones.

    Raises
    ------
    InputError
        If the train has a curve of effort over speed, for which there is no place either.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.formats.railway import read_train as read_own
    >>> train = read_own("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_train(train, Path(folder) / "train.json")
    ...     read_train(Path(folder) / "train.json").mass
    []
    122000.0
    """
    _write(TrainLayout.of(train), path)
    own = [name for name in _NOT_IN_TTOBENCH if name not in train.assumed]
    chosen = [
        f"{name.replace('_', ' ')} '{value}': a reader takes its own"
        for name in ("mass_model", "acceleration_limits")
        if (value := getattr(train, name)) != getattr(Train, name)
    ]
    return [*(name.replace("_", " ") for name in own), *chosen]


def write_journey(journey: Journey, path: str | Path) -> None:
    """Write a journey.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.railway.trajectory import TimingPoint
    >>> journey = Journey("R 1", "short", (TimingPoint(0.0), TimingPoint(9e3, latest=600.0)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_journey(journey, Path(folder) / "r1.json")
    ...     read_journey(Path(folder) / "r1.json") == journey
    True
    """
    _write(JourneyLayout.of(journey), path)


_LAYOUTS = {"track": TrackLayout, "train": TrainLayout, "journey": JourneyLayout}


def _read(path: str | Path, wanted: Kind | None = None) -> Any:
    content = read_json(path)
    found = _detect(content, path)
    if wanted is not None and found != wanted:
        raise InputError(
            f"is a TTOBench {found}, expected a {wanted}", file=path, remedy=f"give a {wanted}"
        )
    return built(lambda: from_content(_LAYOUTS[found], content).thing(), path)


def _write(layout: Layout, path: str | Path) -> None:
    write_bytes(path, to_bytes(content_of(layout)))


def _detect(content: Any, path: str | Path) -> Kind:
    if isinstance(content, dict):
        for key, kind in _TELLING_KEYS.items():
            if key in content:
                return kind
        if "format" in content:
            raise InputError(
                f"is a {content['format']} file already", file=path, remedy="use it as it is"
            )
    raise InputError(
        "is neither a track nor a train nor a journey of TTOBench",
        file=path,
        remedy="a track has 'stops', a train 'mass', a journey 'timing points'",
    )


# ------------------------------------------------------------- maximum adhesion along a track

_ADHESION_COLUMNS = (
    "maximum adhesion",
    "lower bound",
    "upper bound",
    "expected adhesion",
    "expected lower bound",
    "expected upper bound",
)
_ADHESION = (
    Column("position", "m", "m"),
    *(Column(name, "-", "1", NOT_SET) for name in _ADHESION_COLUMNS),
)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class AdhesionSections(Layout):
    """Maximum adhesion by section of a track, in one rail condition.

    Attributes
    ----------
    metadata : Metadata
        `Metadata.of` the track and the condition, with the track's name.
    rail_condition : str
    length : float [m]
        Of the track; the last section ends there.
    expected_at : str
        Time of the expected adhesion, ISO 8601; empty if none.
    adhesion : tuple of seven (n,) arrays
        Start of the section [m]; lasting maximum adhesion and the ends of its 95 % band; the
        expected one and those of its band. NaN where nothing was observed.
    """

    metadata: Metadata
    rail_condition: Annotated[str, Text(least=1)]
    length: _Length
    expected_at: Annotated[str, Text(stated="written")] = ""
    adhesion: Annotated[tuple[FloatArray, ...], Table(_ADHESION, fields=True)]


def write_adhesion(sections: AdhesionSections, path: str | Path) -> None:
    """Write maximum adhesion by section in the layout of a TTOBench track, whole or not at all.

    Examples
    --------
    >>> import tempfile
    >>> starts, unknown = np.array([0.0, 500.0]), np.full(2, np.nan)
    >>> named = Metadata.of("line wet", "10 trips", "line")
    >>> sections = AdhesionSections(
    ...     metadata=named, rail_condition="wet", length=900.0, adhesion=(starts, *[unknown] * 6)
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_adhesion(sections, f"{folder}/adhesion.json")
    ...     read_adhesion(f"{folder}/adhesion.json").metadata.associated_track
    'line'
    """
    _write(sections, path)


def read_adhesion(path: str | Path) -> AdhesionSections:
    """Read maximum adhesion by section, as `write_adhesion` writes it.

    Raises
    ------
    InputError
        If the file cannot be read, or is not of this layout; names the place.

    Examples
    --------
    >>> read_adhesion("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    return built(lambda: from_content(AdhesionSections, read_json(path)), path)

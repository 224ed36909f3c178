"""The formats of trains and consists, ``"trainlog/train"`` and ``"trainlog/consist"``.

docs/formats.md describes their keys.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, cast

import numpy as np
from pydantic import Field

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.formats.files import check_written, read_bytes, write_bytes
from trainlog.formats.plausible import implausible_train
from trainlog.formats.samples import DEFAULT_TRAIN, file_or_sample
from trainlog.formats.schema import Column, File, Named, Part, Quantity, Table, built, gathered
from trainlog.railway.axle_loads import AxleGeometry
from trainlog.railway.consist import Consist, Coupler, Vehicle
from trainlog.railway.effort import EffortCurve
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import (
    AccelerationLimits,
    Axles,
    Brake,
    BrakingCurves,
    MassModel,
    Train,
)

Mass = Annotated[float, Quantity("t", "kg")]
Effort = Annotated[float, Quantity("kN", "N")]
Power = Annotated[float, Quantity("kW", "W")]
Linear = Annotated[float, Quantity("kN/(km/h)", "N/(m/s)")]
Quadratic = Annotated[float, Quantity("kN/(km/h)^2", "N/(m/s)^2")]
Speed = Annotated[float, Quantity("km/h", "m/s")]
Acceleration = Annotated[float, Quantity("m/s^2", "m/s^2")]
Length = Annotated[float, Quantity("m", "m")]
Time = Annotated[float, Quantity("s", "s")]
Share = Annotated[float, Quantity("%", "1")]

_Tunnels = Annotated[
    tuple[Any, ...],
    Table(
        (Column("cross_section", "m^2", "m^2"), Column("coefficient", "kN/(km/h)^2", "N/(m/s)^2"))
    ),
]
_EffortCurve = Annotated[
    tuple[Any, ...], Table((Column("speed", "km/h", "m/s"), Column("effort", "kN", "N")))
]
_Curve = Annotated[
    tuple[Any, ...],
    Table((Column("speed", "km/h", "m/s"), Column("deceleration", "m/s^2", "m/s^2"))),
]
BRAKING_PARAMETERS = {
    "K_dry_rst": Quantity("1", "1"),
    "K_wet_rst": Quantity("1", "1"),
    "T_traction": Quantity("s", "s"),
    "T_be": Quantity("s", "s"),
    "v_uncertainty": Quantity("%", "%"),
    "T_bs": Quantity("s", "s"),
}
"""ETCS braking parameters of a train by their published names, in their published units."""


class _Resistance(Part):
    r0: Effort
    r1: Linear
    r2: Quadratic


class _AxleGeometry(Part):
    wheelbase: Length
    pivot_distance: Length
    link_height: Length
    coupler_height: Length
    centre_height: Length
    axles_per_bogie: int = Field(default=2, gt=1)
    powered_bogies: int = Field(default=2, gt=0, lt=3)


class _Axles(Part):
    count: int = Field(gt=0)
    adhesive_mass: Mass
    wheel_radius: Length
    rotating_mass: Mass
    geometry: _AxleGeometry | None = None

    def axles(self) -> Axles:
        """The axles that the file describes."""
        known = dict(self)
        if self.geometry is not None:
            known["geometry"] = AxleGeometry(**dict(self.geometry))
        return Axles(**known)


class _Brake(Part):
    dead_time: Time
    lag: Time


class _BrakingCurves(Part):
    emergency: _Curve | None = None
    service: _Curve | None = None
    parameters: Annotated[dict[str, float], Named(BRAKING_PARAMETERS)] | None = None


class _TrainFile(File):
    FORMAT: ClassVar[str] = "trainlog/train"

    name: str = Field(min_length=1)
    source: str = ""
    assumed: list[str] | None = None
    mass: Mass
    rotating_mass_factor: Share
    length: Length | None = None
    max_load: Mass | None = None
    seats: int | None = Field(default=None, gt=0)
    coaches: int | None = Field(default=None, gt=0)
    running_resistance: _Resistance
    tunnel_resistance: _Tunnels | None = None
    max_speed: Speed
    max_acceleration: Acceleration
    max_deceleration: Acceleration
    max_tractive_effort: Effort
    max_traction_power: Power
    max_dynamic_braking_effort: Effort
    max_dynamic_braking_power: Power
    max_pneumatic_braking_effort: Effort
    efficiency_traction: Share
    efficiency_regeneration: Share
    axles: _Axles
    brake: _Brake
    braking_curves: _BrakingCurves | None = None
    traction_curve: _EffortCurve | None = None
    dynamic_braking_curve: _EffortCurve | None = None
    mass_model: MassModel | None = None
    acceleration_limits: AccelerationLimits | None = None

    def content(self) -> Train:
        return self.train()

    @classmethod
    def implausible(cls, values: dict[str, Any]) -> list[InputError]:
        return list(implausible_train(values))

    def train(self) -> Train:
        """The train that the file describes."""
        given = {name: getattr(self, name) for name in _SAME}
        curves = self.braking_curves
        train, _ = gathered(
            lambda: Train(
                **given,
                length=self.length or 0.0,
                max_load=self.max_load or 0.0,
                mass_model=self.mass_model or "mass_point",
                acceleration_limits=self.acceleration_limits or "gross",
                assumed=tuple(self.assumed or ()),
                resistance=RunningResistance(**dict(self.running_resistance)),
                tunnel_resistance=pairs(self.tunnel_resistance),
                axles=self.axles.axles(),
                brake=Brake(**dict(self.brake)),
                braking_curves=None
                if curves is None
                else BrakingCurves(
                    pairs(curves.emergency), pairs(curves.service), curves.parameters or {}
                ),
                traction_curve=_curve("traction_curve", self.traction_curve),
                dynamic_braking_curve=_curve("dynamic_braking_curve", self.dynamic_braking_curve),
            ),
            lambda: _check_parts(self.axles, self.brake),
        )
        return cast(Train, train)

    @staticmethod
    def of(train: Train) -> _TrainFile:
        """The file that describes a train."""
        curves = train.braking_curves
        return _TrainFile.holding(
            train,
            length=train.length or None,
            max_load=train.max_load or None,
            mass_model=None if train.mass_model == "mass_point" else train.mass_model,
            acceleration_limits=None
            if train.acceleration_limits == "gross"
            else train.acceleration_limits,
            assumed=list(train.assumed) or None,
            running_resistance=_Resistance.holding(train.resistance),
            tunnel_resistance=columns(train.tunnel_resistance),
            axles=_Axles.holding(
                train.axles,
                geometry=None
                if train.axles.geometry is None
                else _AxleGeometry.holding(train.axles.geometry),
            ),
            brake=_Brake.holding(train.brake),
            braking_curves=None
            if curves is None
            else _BrakingCurves.holding(
                curves,
                emergency=columns(curves.emergency),
                service=columns(curves.service),
                parameters=curves.parameters or None,
            ),
            traction_curve=_table(train.traction_curve),
            dynamic_braking_curve=_table(train.dynamic_braking_curve),
        )


_SAME = {field.name for field in fields(Train)} & set(_TrainFile.model_fields) - {
    "length",
    "max_load",
    "assumed",
    "tunnel_resistance",
    "axles",
    "brake",
    "braking_curves",
    "traction_curve",
    "dynamic_braking_curve",
    "mass_model",
    "acceleration_limits",
}
"""Fields that are the same in the file and in the train."""


def _table(curve: EffortCurve | None) -> tuple[FloatArray, ...] | None:
    """The columns of a curve."""
    return None if curve is None else (curve.speeds, curve.efforts)


def _curve(place: str, table: tuple[FloatArray, ...] | None) -> EffortCurve | None:
    """The curve in a table of speeds and efforts; errors name the place."""
    if table is None:
        return None
    try:
        return EffortCurve(*table)
    except InputError as error:
        raise InputError(error.problem, place=place, remedy=error.remedy) from error


def pairs(table: tuple[FloatArray, ...] | None) -> tuple[tuple[float, float], ...]:
    """The rows of a table of two columns."""
    return () if table is None else tuple((float(x), float(y)) for x, y in zip(*table, strict=True))


def columns(rows: tuple[tuple[float, float], ...]) -> tuple[tuple[float, ...], ...] | None:
    """The two columns of a table, or None if it has no rows."""
    return tuple(zip(*rows, strict=True)) or None


def _check_parts(axles: _Axles, brake: _Brake) -> None:
    problems = [
        InputError("must be positive", place=f"axles.{name}", remedy="correct it")
        for name in ("adhesive_mass", "wheel_radius")
        if not getattr(axles, name) > 0.0
    ] + [
        InputError("must be 0 or more", place=f"brake.{name}", remedy="correct it")
        for name in ("dead_time", "lag")
        if getattr(brake, name) < 0.0
    ]
    if problems:
        raise InputError.listing(problems)


def train_from_bytes(data: bytes, *, file: str | Path = "train.json") -> Train:
    """The train in the bytes of a train file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a train file, naming the place and the remedy.

    Examples
    --------
    >>> data = read_bytes("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> train_from_bytes(data).max_tractive_effort
    200000.0
    """
    return built(_TrainFile.from_bytes(data, file).train, file)


def train_to_bytes(train: Train) -> bytes:
    """The bytes of the train's file: the same train gives the same bytes.

    Examples
    --------
    >>> path = Path("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> train_to_bytes(read_train(path)) == path.read_bytes()
    True
    """
    return _TrainFile.of(train).to_bytes()


def train_content(train: Train) -> dict[str, Any]:
    """What stands in a train's file, as plain values.

    Examples
    --------
    >>> train_content(read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json"))["mass"]
    {'value': 122, 'unit': 't'}
    """
    return _TrainFile.of(train).file_content()


def read_train(path: str | Path) -> Train:
    """Read a train file, JSON or TOML.

    Parameters
    ----------
    path : path
        Of a train file; or ``"sample"``: a Stadler FLIRT.

    Raises
    ------
    InputError
        As `train_from_bytes`, if the file cannot be read, or if values cannot be meant: a train of
        122 kg. All that is wrong is listed at once.

    Examples
    --------
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> train.name, train.mass
    ('CH_Stadler_FLIRT_TPF', 122000.0)
    """
    path = file_or_sample(path, DEFAULT_TRAIN)
    train: Train = _TrainFile.read(read_bytes(path), path)
    return train


def write_train(train: Train, path: str | Path) -> None:
    """Write a train file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_train(train, Path(folder) / "copy.train.json")
    ...     read_train(Path(folder) / "copy.train.json") == train
    True
    """
    check_written(train, Train)
    write_bytes(path, _TrainFile.of(train).bytes_for(path))


Stiffness = Annotated[float, Quantity("MN/m", "N/m")]
Nonlinearity = Annotated[float, Quantity("1/m^2", "1/m^2")]
Damping = Annotated[float, Quantity("kN*s/m", "N/(m/s)")]
Travel = Annotated[float, Quantity("mm", "m")]
Propagation = Annotated[float, Quantity("m/s", "m/s")]

Thing = TypeVar("Thing", Vehicle, Coupler)


class _Vehicle(Part):
    name: str = Field(min_length=1)
    count: int = Field(default=1, gt=0, le=1000)
    mass: Mass
    rotating_mass: Mass
    length: Length
    running_resistance: _Resistance
    max_tractive_effort: Effort | None = None
    max_traction_power: Power | None = None
    max_braking_effort: Effort | None = None

    def vehicle(self) -> Vehicle:
        power = self.max_traction_power
        return Vehicle(
            self.name,
            mass=self.mass,
            length=self.length,
            resistance=RunningResistance(**dict(self.running_resistance)),
            rotating_mass=self.rotating_mass,
            max_tractive_effort=self.max_tractive_effort or 0.0,
            max_traction_power=np.inf if power is None else power,
            max_braking_effort=self.max_braking_effort or 0.0,
        )

    @staticmethod
    def of(vehicle: Vehicle, count: int) -> _Vehicle:
        power = vehicle.max_traction_power
        return _Vehicle.holding(
            vehicle,
            count=count,
            running_resistance=_Resistance.holding(vehicle.resistance),
            max_tractive_effort=vehicle.max_tractive_effort or None,
            max_traction_power=power if np.isfinite(power) else None,
            max_braking_effort=vehicle.max_braking_effort or None,
        )


class _Coupler(Part):
    count: int = Field(default=1, gt=0, le=1000)
    stiffness: Stiffness
    nonlinearity: Nonlinearity
    damping: Damping
    slack: Travel
    buffing_stiffness: Stiffness | None = None
    buffing_nonlinearity: Nonlinearity | None = None

    def coupler(self) -> Coupler:
        return Coupler(**{name: value for name, value in self if name != "count"})

    @staticmethod
    def of(coupler: Coupler, count: int) -> _Coupler:
        return _Coupler.holding(coupler, count=count)


class _ConsistBrake(_Brake):
    propagation: Propagation | None = None


class _ConsistFile(File):
    FORMAT: ClassVar[str] = "trainlog/consist"

    name: str = Field(min_length=1)
    source: str = ""
    assumed: list[str] | None = None
    brake: _ConsistBrake
    vehicles: list[_Vehicle] = Field(min_length=1)
    couplers: list[_Coupler]

    def consist(self) -> Consist:
        """The consist that the file describes."""
        propagation = self.brake.propagation
        return Consist(
            self.name,
            _each("vehicles", [(entry.vehicle, entry.count) for entry in self.vehicles]),
            _each("couplers", [(entry.coupler, entry.count) for entry in self.couplers]),
            brake=Brake(self.brake.dead_time, self.brake.lag),
            brake_propagation=np.inf if propagation is None else propagation,
            source=self.source,
            assumed=tuple(self.assumed or ()),
        )

    @staticmethod
    def of(consist: Consist) -> _ConsistFile:
        """The file that describes a consist; equal neighbours share an entry."""
        brake, propagation = consist.brake, consist.brake_propagation
        return _ConsistFile.holding(
            consist,
            assumed=list(consist.assumed) or None,
            brake=_ConsistBrake.holding(
                brake, propagation=propagation if np.isfinite(propagation) else None
            ),
            vehicles=[_Vehicle.of(*run) for run in _runs(consist.vehicles)],
            couplers=[_Coupler.of(*run) for run in _runs(consist.couplers)],
        )


def _each(place: str, entries: list[tuple[Callable[[], Thing], int]]) -> tuple[Thing, ...]:
    """What the entries describe, as often as they say; errors name the entry."""
    found: list[Thing] = []
    for number, (make, count) in enumerate(entries):
        try:
            found += [make()] * count
        except InputError as error:
            where = f"{place}[{number}]"
            raise InputError(error.problem, place=where, remedy=error.remedy) from error
    return tuple(found)


def _runs(things: tuple[Thing, ...]) -> list[tuple[Thing, int]]:
    """Each thing that differs from the one before, and how often it comes."""
    return [(thing, len(list(group))) for thing, group in groupby(things)]


def consist_from_bytes(data: bytes, *, file: str | Path = "consist.json") -> Consist:
    """The consist in the bytes of a consist file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a consist file, naming the place and the remedy.

    Examples
    --------
    >>> len(consist_from_bytes(read_bytes("sample_logs/freight_24_wagons.consist.json")).couplers)
    24
    """
    return built(_ConsistFile.from_bytes(data, file).consist, file)


def consist_to_bytes(consist: Consist) -> bytes:
    """The bytes of the consist's file: the same consist gives the same bytes.

    Examples
    --------
    >>> path = Path("sample_logs/freight_24_wagons.consist.json")
    >>> consist_to_bytes(read_consist(path)) == path.read_bytes()
    True
    """
    return _ConsistFile.of(consist).to_bytes()


def read_consist(path: str | Path) -> Consist:
    """Read a consist file; errors as `consist_from_bytes`, and if the file cannot be read.

    Examples
    --------
    >>> consist = read_consist("sample_logs/freight_24_wagons.consist.json")
    >>> consist.name, len(consist.vehicles)
    ('freight train, 24 wagons', 25)
    """
    return consist_from_bytes(read_bytes(path), file=path)


def write_consist(consist: Consist, path: str | Path) -> None:
    """Write a consist file, whole or not at all.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> consist = read_consist("sample_logs/freight_24_wagons.consist.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_consist(consist, Path(folder) / "copy.consist.json")
    ...     read_consist(Path(folder) / "copy.consist.json").name
    'freight train, 24 wagons'
    """
    check_written(consist, Consist)
    write_bytes(path, consist_to_bytes(consist))

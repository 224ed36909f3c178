"""The consist format, ``"trainlog/consist"``; docs/formats.md describes its keys."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Annotated, ClassVar, TypeVar

import numpy as np
from pydantic import Field

from trainlog.errors import InputError
from trainlog.formats.files import read_bytes, write_bytes
from trainlog.formats.quantities import Quantity
from trainlog.formats.schema import File, Part, built
from trainlog.formats.train import Effort, Length, Linear, Mass, Power, Quadratic, Time
from trainlog.railway.consist import Consist, Coupler, Vehicle
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import Brake

Stiffness = Annotated[float, Quantity("MN/m", "N/m")]
Nonlinearity = Annotated[float, Quantity("1/m^2", "1/m^2")]
Damping = Annotated[float, Quantity("kN*s/m", "N/(m/s)")]
Travel = Annotated[float, Quantity("mm", "m")]
Propagation = Annotated[float, Quantity("m/s", "m/s")]

Thing = TypeVar("Thing", Vehicle, Coupler)


class _Resistance(Part):
    r0: Effort
    r1: Linear
    r2: Quadratic


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
        resistance, power = vehicle.resistance, vehicle.max_traction_power
        return _Vehicle.model_construct(
            name=vehicle.name,
            count=count,
            mass=vehicle.mass,
            rotating_mass=vehicle.rotating_mass,
            length=vehicle.length,
            running_resistance=_Resistance.model_construct(
                r0=resistance.r0, r1=resistance.r1, r2=resistance.r2
            ),
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
        given = {name: getattr(coupler, name) for name in _Coupler.model_fields if name != "count"}
        return _Coupler.model_construct(count=count, **given)


class _Brake(Part):
    dead_time: Time
    lag: Time
    propagation: Propagation | None = None


class _ConsistFile(File):
    FORMAT: ClassVar[str] = "trainlog/consist"

    name: str = Field(min_length=1)
    source: str = ""
    assumed: list[str] | None = None
    brake: _Brake
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
        return _ConsistFile.model_construct(
            name=consist.name,
            source=consist.source,
            assumed=list(consist.assumed) or None,
            brake=_Brake.model_construct(
                dead_time=brake.dead_time,
                lag=brake.lag,
                propagation=propagation if np.isfinite(propagation) else None,
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
    """
    return built(_ConsistFile.from_bytes(data, file).consist, file)


def consist_to_bytes(consist: Consist) -> bytes:
    """The bytes of the consist's file: the same consist gives the same bytes."""
    return _ConsistFile.of(consist).to_bytes()


def read_consist(path: str | Path) -> Consist:
    """Read a consist file; errors as `consist_from_bytes`, and if the file cannot be read."""
    return consist_from_bytes(read_bytes(path), file=path)


def write_consist(consist: Consist, path: str | Path) -> None:
    """Write a consist file, whole or not at all."""
    write_bytes(path, consist_to_bytes(consist))

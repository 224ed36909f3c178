"""The format of observed parameter sets, ``"trainlog/parameters"``; see docs/formats.md."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, JsonValue

from trainlog.errors import InputError
from trainlog.formats.files import read_bytes, write_bytes
from trainlog.formats.layout import plain, shortest
from trainlog.formats.quantities import FloatArray, Quantity
from trainlog.formats.schema import File, Part, built
from trainlog.railway.configuration import Configuration, ParameterSet
from trainlog.railway.resistance import RunningResistance
from trainlog.units import factor

_Mass = Annotated[float, Quantity("kg", "kg")]
_Power = Annotated[float, Quantity("W", "W")]
_Speed = Annotated[float, Quantity("m/s", "m/s")]
_UNITS = ("N", "N/(m/s)", "N/(m/s)^2")
Details = dict[str, JsonValue]
"""What was noted beside a result; any JSON."""


class ResistancePart(Part):
    """Running resistance ``R(v) = r0 + r1 v + r2 v²``."""

    r0: Annotated[float, Quantity(_UNITS[0], _UNITS[0])]
    r1: Annotated[float, Quantity(_UNITS[1], _UNITS[1])]
    r2: Annotated[float, Quantity(_UNITS[2], _UNITS[2])]

    def resistance(self) -> RunningResistance:
        """The running resistance that the part describes."""
        return RunningResistance(self.r0, self.r1, self.r2)

    @staticmethod
    def of(resistance: RunningResistance) -> ResistancePart:
        """The part that describes a running resistance."""
        return ResistancePart.model_construct(r0=resistance.r0, r1=resistance.r1, r2=resistance.r2)


class ConfigurationPart(Part):
    """One configuration of a train."""

    name: str
    mass: _Mass
    rotating_mass: _Mass
    max_power: _Power
    running_resistance: ResistancePart

    def configuration(self) -> Configuration:
        """The configuration that the part describes."""
        resistance = self.running_resistance.resistance()
        return Configuration(self.name, self.mass, self.rotating_mass, resistance, self.max_power)

    @staticmethod
    def of(configuration: Configuration) -> ConfigurationPart:
        """The part that describes a configuration."""
        return ConfigurationPart.model_construct(
            name=configuration.name,
            mass=configuration.mass,
            rotating_mass=configuration.rotating_mass,
            max_power=configuration.max_power,
            running_resistance=ResistancePart.of(configuration.resistance),
        )


class _CoefficientUnits(Part):
    r0: str
    r1: str
    r2: str


class _Covariance(Part):
    """Covariance of ``(r0, r1, r2)``; an entry's unit is that of its row times its column."""

    units: _CoefficientUnits
    values: list[list[float]]

    def matrix(self) -> FloatArray:
        """The (3, 3) covariance in SI units."""
        if [len(row) for row in self.values] != [3, 3, 3]:
            raise InputError(
                "needs 3 rows of 3 numbers", place="common_covariance.values", remedy="give 3 by 3"
            )
        declared_units = (self.units.r0, self.units.r1, self.units.r2)
        try:
            scale = [factor(u, si)[0] for u, si in zip(declared_units, _UNITS, strict=True)]
        except InputError as error:
            raise InputError(
                error.problem, place="common_covariance.units", remedy=error.remedy
            ) from error
        return np.array(self.values, dtype=np.float64) * np.outer(scale, scale)

    @staticmethod
    def of(matrix: FloatArray) -> _Covariance:
        """The part that describes a covariance in SI units."""
        r0, r1, r2 = _UNITS
        return _Covariance.model_construct(
            units=_CoefficientUnits(r0=r0, r1=r1, r2=r2), values=shortest(matrix.tolist())
        )


class _Range(Part):
    lowest: _Speed
    highest: _Speed


class _ParametersFile(File):
    FORMAT: ClassVar[str] = "trainlog/parameters"

    train: str
    speed_range: _Range
    configurations: list[ConfigurationPart]
    common: ResistancePart | None = None
    common_covariance: _Covariance | None = None
    details: list[Details] = Field(default_factory=list)
    provenance: Details = Field(default_factory=dict)
    cover: Details = Field(default_factory=dict)

    def parameters(self) -> ParameterSet:
        """The parameter set that the file describes."""
        covariance = self.common_covariance
        return ParameterSet(
            train=self.train,
            configurations=tuple(part.configuration() for part in self.configurations),
            common=None if self.common is None else self.common.resistance(),
            common_covariance=None if covariance is None else covariance.matrix(),
            speed_range=(self.speed_range.lowest, self.speed_range.highest),
            details=self.details,
            provenance=self.provenance,
            cover=self.cover,
        )

    @staticmethod
    def of(parameters: ParameterSet) -> _ParametersFile:
        """The file that describes a parameter set."""
        lowest, highest = parameters.speed_range
        common, covariance = parameters.common, parameters.common_covariance
        return _ParametersFile.model_construct(
            train=parameters.train,
            speed_range=_Range.model_construct(lowest=lowest, highest=highest),
            configurations=[ConfigurationPart.of(item) for item in parameters.configurations],
            common=None if common is None else ResistancePart.of(common),
            common_covariance=None if covariance is None else _Covariance.of(covariance),
            details=plain(parameters.details, "details"),
            provenance=plain(parameters.provenance, "provenance"),
            cover=plain(parameters.cover, "cover"),
        )


def parameters_from_bytes(data: bytes, *, file: str | Path = "parameters.json") -> ParameterSet:
    """The parameter set in the bytes of a parameters file.

    Raises
    ------
    InputError
        If they are not a parameters file, naming the place and the remedy.
    """
    return built(_ParametersFile.from_bytes(data, file).parameters, file)


def parameters_to_bytes(parameters: ParameterSet) -> bytes:
    """The bytes of the set's file: doubles exact, the same set gives the same bytes."""
    return _ParametersFile.of(parameters).to_bytes()


def read_parameters(path: str | Path) -> ParameterSet:
    """Read a parameters file; errors as `parameters_from_bytes`, and if it cannot be read."""
    return parameters_from_bytes(read_bytes(path), file=path)


def write_parameters(parameters: ParameterSet, path: str | Path) -> None:
    """Write a parameters file, whole or not at all."""
    write_bytes(path, parameters_to_bytes(parameters))

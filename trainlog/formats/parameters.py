"""The formats of learnt results, ``"trainlog/parameters"`` and ``"trainlog/coast-down"``.

Observed parameter sets and coast-down results; docs/formats.md describes their keys.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, JsonValue

from trainlog.arrays import FloatArray
from trainlog.display import counted, span
from trainlog.errors import InputError
from trainlog.formats.files import check_written, plain, read_bytes, shortest, write_bytes
from trainlog.formats.schema import Array, File, Part, Quantity, built
from trainlog.presentation import PLAIN, Band, Column, Presented, Said, WordTable, new_table
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import Configuration, ParameterSet
from trainlog.units import KMH, factor

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
        return ResistancePart.holding(resistance)


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
        resistance = ResistancePart.of(configuration.resistance)
        return ConfigurationPart.holding(configuration, running_resistance=resistance)


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
        return _ParametersFile.holding(
            parameters,
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

    Examples
    --------
    >>> data = b'{"format": "trainlog/parameters", "version": 2}'
    >>> parameters_from_bytes(data)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: parameters.json, version: version 2 is newer than...
    """
    return built(_ParametersFile.from_bytes(data, file).parameters, file)


def parameters_to_bytes(parameters: ParameterSet) -> bytes:
    """The bytes of the set's file: doubles exact, the same set gives the same bytes.

    Examples
    --------
    >>> from trainlog.railway.resistance import RunningResistance
    >>> resistance = RunningResistance(2000.0, 50.0, 8.0)
    >>> empty = Configuration("empty", 122e3, 9e3, resistance, 2.6e6)
    >>> found = ParameterSet("FLIRT", (empty,), speed_range=(5.0, 40.0))
    >>> parameters_from_bytes(parameters_to_bytes(found)).train
    'FLIRT'
    """
    return _ParametersFile.of(parameters).to_bytes()


def read_parameters(path: str | Path) -> ParameterSet:
    """Read a parameters file; errors as `parameters_from_bytes`, and if it cannot be read.

    Examples
    --------
    >>> read_parameters("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    return parameters_from_bytes(read_bytes(path), file=path)


def write_parameters(parameters: ParameterSet, path: str | Path) -> None:
    """Write a parameters file, whole or not at all.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> from trainlog.railway.resistance import RunningResistance
    >>> resistance = RunningResistance(2000.0, 50.0, 8.0)
    >>> empty = Configuration("empty", 122e3, 9e3, resistance, 2.6e6)
    >>> found = ParameterSet("FLIRT", (empty,), speed_range=(5.0, 40.0))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_parameters(found, Path(folder) / "flirt.parameters.json")
    ...     read_parameters(Path(folder) / "flirt.parameters.json").configurations[0].mass
    122000.0
    """
    check_written(parameters, ParameterSet)
    write_bytes(path, parameters_to_bytes(parameters))


Gradient = Literal["line", "unknown"]
"""Whether the gradient was taken from the line or was an unknown of its own."""


@dataclass(frozen=True, slots=True)
class Identified:
    """A quantity that the data determine, or the reason why they do not.

    Attributes
    ----------
    name, unit : str
    value, std : float or None
        None where the data do not determine it.
    reason : str or None
        Why not; or, with a value, where it comes from if not from the data.
    """

    name: str
    unit: str
    value: float | None
    std: float | None
    reason: str | None = None


@dataclass(frozen=True, eq=False)
class DragCurve:
    """Deceleration of the coasting train on level track, with its 95 % band; arrays (n,).

    Attributes
    ----------
    speeds : array [m/s]
        Those that the data support, increasing.
    deceleration, low, high : array [m/s²]
    """

    speeds: FloatArray
    deceleration: FloatArray
    low: FloatArray
    high: FloatArray

    def __repr__(self) -> str:
        return f"DragCurve: {span(self.speeds, KMH)} km/h, {span(self.deceleration, 1e3)} mm/s²"


def _value(quantity: Identified) -> Band | Said:
    if quantity.value is None or quantity.std is None:
        return Said(None, "not identified")
    return Band(quantity.value, quantity.std)


QUANTITY_COLUMNS = (
    Column("quantity", of="name"),
    Column("unit"),
    Column("value", PLAIN, band=True, of=_value),
    Column("", key="reason", of=lambda each: each.reason or ""),
)
"""Of an `Identified`."""


@dataclass(frozen=True, eq=False, repr=False)
class CoastDownResult(Presented):
    """What was learnt of running resistance from coasting.

    Attributes
    ----------
    train : str
        Empty where the recordings do not name it.
    gradient : {"line", "unknown"}
    quantities : tuple of Identified
        Those that were sought, identified or not.
    covariance : (p, p) array
        Of the quantities that have a value, in their order.
    curve : DragCurve or None
        None where it is not identified.
    trips : list of dict
        One a trip: segments, noise, SHA-256, or the reason of its refusal.
    pieces : list of dict
        With the gradient unknown: pieces of track and what was found of each.
    provenance : dict
    """

    charts_by: ClassVar[str] = "analysis.resistance.plot:result_charts"

    train: str
    gradient: Gradient
    quantities: tuple[Identified, ...]
    covariance: FloatArray
    curve: DragCurve | None = None
    trips: list[dict[str, Any]] = field(default_factory=list)
    pieces: list[dict[str, Any]] = field(default_factory=list)
    provenance: dict[str, Any] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Identified:
        """The quantity of that name; KeyError if there is none."""
        for quantity in self.quantities:
            if quantity.name == name:
                return quantity
        raise KeyError(name)

    @property
    def title(self) -> str:
        """Train, trips and whether the gradient was known."""
        train = f" of '{self.train}'" if self.train else ""
        return f"Coast-down{train}, {counted(len(self.trips), 'trip')}, gradient: {self.gradient}"

    def summary(self) -> dict[str, str]:
        """Each quantity with its standard deviation, or why it is not identified."""
        rows = {each.name: _in_words(each) for each in self.quantities}
        if self.curve is not None:
            rows["drag curve"] = f"{span(self.curve.speeds, KMH)} km/h"
        return rows

    def tables(self) -> list[WordTable]:
        """What is identified, and why the rest is not."""
        title = f"Running resistance over inertia, gradient {self.gradient}"
        return [new_table(title, *QUANTITY_COLUMNS, name="quantities").add_rows(self.quantities)]

    @property
    def notes(self) -> list[str]:
        """What it rests on, in sentences."""
        words = [f"{counted(len(self.pieces), 'piece')} of track coasted more than once."]
        words = words if self.gradient == "unknown" else []
        words += [f"refused: {trip['reason']}" for trip in self.trips if not trip["accepted"]]
        if self.curve is not None:
            low, high = (KMH * float(self.curve.speeds[end]) for end in (0, -1))
            words.append(f"The whole curve is supported from {low:.0f} to {high:.0f} km/h.")
        return words


def _in_words(quantity: Identified) -> str:
    if quantity.value is None:
        return f"not identified: {quantity.reason}"
    std = "" if quantity.std is None else f", standard deviation {quantity.std:.2g}"
    return f"{quantity.value:.5g} {quantity.unit}{std}"


class _QuantityPart(Part):
    name: str
    unit: str
    value: float | None = None
    std: float | None = None
    reason: str | None = None


class _CurvePart(Part):
    speeds: Annotated[FloatArray, Array("m/s")]
    deceleration: Annotated[FloatArray, Array("m/s^2")]
    low: Annotated[FloatArray, Array("m/s^2")]
    high: Annotated[FloatArray, Array("m/s^2")]


class _CoastDownFile(File):
    FORMAT: ClassVar[str] = "trainlog/coast-down"

    train: str
    gradient: Gradient
    quantities: list[_QuantityPart] = Field(min_length=1)
    covariance: list[list[float]]
    curve: _CurvePart | None = None
    trips: list[Details] = Field(default_factory=list)
    pieces: list[Details] = Field(default_factory=list)
    provenance: Details = Field(default_factory=dict)

    def result(self) -> CoastDownResult:
        """What the file describes."""
        known = [part for part in self.quantities if part.value is not None]
        if [len(row) for row in self.covariance] != len(known) * [len(known)]:
            raise InputError(
                f"needs {len(known)} rows of {len(known)} numbers, one for each quantity that has"
                " a value",
                place="covariance",
                remedy="give a row and a column for each of them",
            )
        curve = self.curve
        return CoastDownResult(
            train=self.train,
            gradient=self.gradient,
            quantities=tuple(Identified(**dict(part)) for part in self.quantities),
            covariance=np.array(self.covariance, dtype=np.float64).reshape(len(known), len(known)),
            curve=None if curve is None else DragCurve(**dict(curve)),
            trips=self.trips,
            pieces=self.pieces,
            provenance=self.provenance,
        )

    @staticmethod
    def of(result: CoastDownResult) -> _CoastDownFile:
        """The file that describes a result."""
        curve = result.curve
        return _CoastDownFile.holding(
            result,
            quantities=[_QuantityPart.holding(each) for each in result.quantities],
            covariance=shortest(result.covariance.tolist()),
            curve=None if curve is None else _CurvePart.holding(curve),
            trips=plain(result.trips, "trips"),
            pieces=plain(result.pieces, "pieces"),
            provenance=plain(result.provenance, "provenance"),
        )


def coast_down_from_bytes(data: bytes, *, file: str | Path = "coast-down.json") -> CoastDownResult:
    """The result in the bytes of a coast-down file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a coast-down file, naming the place and the remedy.

    Examples
    --------
    >>> coast_down_from_bytes(b"")
    Traceback (most recent call last):
    trainlog.errors.InputError: coast-down.json: is empty; expected JSON
    """
    return built(_CoastDownFile.from_bytes(data, file).result, file)


def coast_down_to_bytes(result: CoastDownResult) -> bytes:
    """The bytes of the file: doubles exact, the same result gives the same bytes.

    Examples
    --------
    >>> mass = Identified("mass", "kg", None, None, "coasting gives resistance by mass only")
    >>> result = CoastDownResult("FLIRT", "line", (mass,), np.zeros((0, 0)))
    >>> coast_down_from_bytes(coast_down_to_bytes(result))["mass"].reason
    'coasting gives resistance by mass only'
    """
    return _CoastDownFile.of(result).to_bytes()


def read_coast_down(path: str | Path) -> CoastDownResult:
    """Read a coast-down file; errors as `coast_down_from_bytes`, and if it cannot be read.

    Examples
    --------
    >>> read_coast_down("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    return coast_down_from_bytes(read_bytes(path), file=path)


def write_coast_down(result: CoastDownResult, path: str | Path) -> None:
    """Write a coast-down file, whole or not at all.

    Examples
    --------
    >>> import tempfile
    >>> mass = Identified("mass", "kg", None, None, "coasting gives resistance by mass only")
    >>> result = CoastDownResult("FLIRT", "line", (mass,), np.zeros((0, 0)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_coast_down(result, Path(folder) / "flirt.json")
    ...     read_coast_down(Path(folder) / "flirt.json").train
    'FLIRT'
    """
    write_bytes(path, coast_down_to_bytes(result))

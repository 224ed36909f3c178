"""The format of coast-down results, ``"trainlog/coast-down"``; see docs/formats.md."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from trainlog.errors import InputError
from trainlog.formats.files import read_bytes, write_bytes
from trainlog.formats.layout import plain, shortest
from trainlog.formats.parameters import Details
from trainlog.formats.quantities import Array, FloatArray
from trainlog.formats.schema import File, Part, built

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


@dataclass(frozen=True, eq=False)
class CoastDownResult:
    """What was learnt of running resistance from coasting.

    Attributes
    ----------
    train : str
        Empty where the recordings do not tell.
    gradient : {"line", "unknown"}
    quantities : tuple of Identified
        Those that were asked for, identified or not.
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
            )
        curve = self.curve
        return CoastDownResult(
            train=self.train,
            gradient=self.gradient,
            quantities=tuple(
                Identified(part.name, part.unit, part.value, part.std, part.reason)
                for part in self.quantities
            ),
            covariance=np.array(self.covariance, dtype=np.float64).reshape(len(known), len(known)),
            curve=None
            if curve is None
            else DragCurve(curve.speeds, curve.deceleration, curve.low, curve.high),
            trips=self.trips,
            pieces=self.pieces,
            provenance=self.provenance,
        )

    @staticmethod
    def of(result: CoastDownResult) -> _CoastDownFile:
        """The file that describes a result."""
        curve = result.curve
        return _CoastDownFile.model_construct(
            train=result.train,
            gradient=result.gradient,
            quantities=[
                _QuantityPart.model_construct(
                    name=each.name,
                    unit=each.unit,
                    value=each.value,
                    std=each.std,
                    reason=each.reason,
                )
                for each in result.quantities
            ],
            covariance=shortest(result.covariance.tolist()),
            curve=None
            if curve is None
            else _CurvePart.model_construct(
                speeds=curve.speeds,
                deceleration=curve.deceleration,
                low=curve.low,
                high=curve.high,
            ),
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
    """
    return built(_CoastDownFile.from_bytes(data, file).result, file)


def coast_down_to_bytes(result: CoastDownResult) -> bytes:
    """The bytes of the file: doubles exact, the same result gives the same bytes."""
    return _CoastDownFile.of(result).to_bytes()


def read_coast_down(path: str | Path) -> CoastDownResult:
    """Read a coast-down file; errors as `coast_down_from_bytes`, and if it cannot be read."""
    return coast_down_from_bytes(read_bytes(path), file=path)


def write_coast_down(result: CoastDownResult, path: str | Path) -> None:
    """Write a coast-down file, whole or not at all."""
    write_bytes(path, coast_down_to_bytes(result))

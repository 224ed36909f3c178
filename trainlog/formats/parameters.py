"""The formats of learnt results, ``"trainlog/parameters"`` and ``"trainlog/coast-down"``.

Observed parameter sets and coast-down results; docs/formats.md describes their keys.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from trainlog.arrays import FloatArray
from trainlog.declaration import Array, Declared, Json, Many, Matrix
from trainlog.display import counted, span
from trainlog.errors import InputError
from trainlog.formats.declared import read_thing, write_thing
from trainlog.presentation import PLAIN, Band, Column, Said, WordTable, new_table
from trainlog.railway.train import ParameterSet
from trainlog.units import KMH


def read_parameters(path: str | Path) -> ParameterSet:
    """Read a parameters file; errors as `read_thing`.

    Examples
    --------
    >>> read_parameters("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    return read_thing(ParameterSet, path)


def write_parameters(parameters: ParameterSet, path: str | Path) -> None:
    """Write a parameters file, whole or not at all.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> from trainlog import Configuration, RunningResistance
    >>> resistance = RunningResistance(2000.0, 50.0, 8.0)
    >>> empty = Configuration("empty", 122e3, 9e3, resistance, 2.6e6)
    >>> found = ParameterSet("FLIRT", (empty,), speed_range=(5.0, 40.0))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_parameters(found, Path(folder) / "flirt.parameters.json")
    ...     read_parameters(Path(folder) / "flirt.parameters.json").configurations[0].mass
    122000.0
    """
    write_thing(parameters, path, ParameterSet)


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
    value: float | None = None
    std: float | None = None
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

    speeds: Annotated[FloatArray, Array("m/s")]
    deceleration: Annotated[FloatArray, Array("m/s^2")]
    low: Annotated[FloatArray, Array("m/s^2")]
    high: Annotated[FloatArray, Array("m/s^2")]

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
class CoastDownResult(Declared):
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
    __hash__ = Declared.__hash__

    FORMAT: ClassVar[str] = "trainlog/coast-down"

    train: str
    gradient: Gradient
    quantities: Annotated[tuple[Identified, ...], Many(least=1)]
    covariance: Annotated[FloatArray, Matrix()]
    curve: DragCurve | None = None
    trips: Annotated[list[dict[str, Any]], Many(stated="written")] = field(default_factory=list)
    pieces: Annotated[list[dict[str, Any]], Many(stated="written")] = field(default_factory=list)
    provenance: Annotated[dict[str, Any], Json(stated="written")] = field(default_factory=dict)

    def problems(self) -> Iterator[InputError]:
        """A covariance that is not of the quantities."""
        known = sum(each.value is not None for each in self.quantities)
        if self.covariance.shape != (known, known):
            yield InputError(
                f"needs {known} rows of {known} numbers, one for each quantity that has a value",
                place="covariance",
                remedy="give a row and a column for each of them",
            )

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


def read_coast_down(path: str | Path) -> CoastDownResult:
    """Read a coast-down file; errors as `read_thing`.

    Examples
    --------
    >>> read_coast_down("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    return read_thing(CoastDownResult, path)


def write_coast_down(result: CoastDownResult, path: str | Path) -> None:
    """Write a coast-down file, whole or not at all.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> mass = Identified("mass", "kg", None, None, "coasting gives resistance by mass only")
    >>> result = CoastDownResult("FLIRT", "line", (mass,), np.zeros((0, 0)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_coast_down(result, Path(folder) / "flirt.json")
    ...     read_coast_down(Path(folder) / "flirt.json").train
    'FLIRT'
    """
    write_thing(result, path, CoastDownResult)

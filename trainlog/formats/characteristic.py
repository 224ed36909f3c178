"""The format ``"trainlog/characteristic"``: adhesion over slip; and its measured points as CSV."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from trainlog.declaration import Column, Declared, Form, Must, Quantity, Table, read_keys
from trainlog.errors import InputError
from trainlog.formats.csv_tables import HeadedTable, read_headed
from trainlog.formats.declared import built, file_content, read_thing, write_thing
from trainlog.railway.adhesion import (
    GREATEST_ADHESION,
    AdhesionCharacteristic,
    AdhesionPoints,
    AdhesionTable,
    CreepCurve,
    PolachCurve,
    SlipVariable,
    polach_curve,
)
from trainlog.units import to_si

_EXPECTED = (
    "give a header such as 'creepage [%];adhesion' or 'slip speed [m/s];adhesion;speed [km/h]'"
)

_BELOW = np.nextafter(GREATEST_ADHESION, 0.0)
_ADHESION = Column(
    "adhesion",
    "1",
    "1",
    must=Must(
        f"is not below {GREATEST_ADHESION:g}",
        "state its unit in the header, as in 'adhesion [%]', if it is in per cent",
        -_BELOW,
        _BELOW,
    ),
)

PRESETS = ("polach-dry", "polach-wet")
"""Names under which the characteristics of Polach (2005) can be given in place of a file."""


@dataclass(frozen=True)
class _Exponentials(Form):
    """The difference of two exponentials over one of the variables of slip."""

    variable: SlipVariable = "creepage"

    @property
    def _forms(self) -> dict[str, Quantity]:
        unit = "1" if self.variable == "creepage" else "s/m"
        return {"a": Quantity(unit, unit), "b": Quantity(unit, unit), "c": Quantity("1", "1")}

    def read(self, found: Any, kind: Any) -> CreepCurve:  # noqa: ARG002
        """The curve."""
        a, b, c = read_keys(found, **{n: form.read for n, form in self._forms.items()})
        return CreepCurve(a, b, c, c, self.variable)

    def write(self, value: Any, in_si: bool = False) -> Any:
        """Its three constants."""
        return {n: form.write(getattr(value, n), in_si) for n, form in self._forms.items()}


@dataclass(frozen=True)
class _Table(Table):
    """A table of adhesion over one of the variables of slip."""

    variable: SlipVariable = "creepage"

    def read(self, found: Any, kind: Any) -> AdhesionTable:  # noqa: ARG002
        """The table."""
        slips, adhesions = self.read_columns(found, self.columns)
        return AdhesionTable(slips, adhesions, self.variable)

    def write(self, value: Any, in_si: bool = False) -> Any:
        """Its two columns."""
        pair = Table(self.columns, fields=True)
        return pair.write((value.slips, value.adhesions), in_si)


_CREEPAGES = (Column("creepage", "%", "1"), _ADHESION)
_SLIP_SPEEDS = (Column("slip_speed", "m/s", "m/s"), _ADHESION)


@dataclass(frozen=True, eq=False, repr=False)
class CharacteristicFile(Declared):
    """One of the ways in which a file gives adhesion over slip; see `characteristic`."""

    FORMAT: ClassVar[str] = "trainlog/characteristic"

    exponentials_over_slip_speed: Annotated[
        CreepCurve | None, _Exponentials(variable="slip speed")
    ] = None
    exponentials_over_creepage: Annotated[CreepCurve | None, _Exponentials()] = None
    polach: PolachCurve | None = None
    table_over_creepage: Annotated[AdhesionTable | None, _Table(_CREEPAGES)] = None
    table_over_slip_speed: Annotated[
        AdhesionTable | None, _Table(_SLIP_SPEEDS, variable="slip speed")
    ] = None
    provenance: Annotated[dict[str, Any], Form(stated="written")] = field(default_factory=dict)

    def problems(self) -> Iterator[InputError]:
        """Not exactly one characteristic."""
        if len(given := self._given) != 1:
            yield InputError(
                f"describes {len(given)} characteristics, expected one",
                remedy=f"give one of {', '.join(_FAMILIES)}",
            )

    @property
    def _given(self) -> list[AdhesionCharacteristic]:
        every = [getattr(self, name) for name in _FAMILIES]
        return [each for each in every if each is not None]

    @property
    def characteristic(self) -> AdhesionCharacteristic:
        """The characteristic that the file describes."""
        return self._given[0]

    @staticmethod
    def of(
        characteristic: AdhesionCharacteristic, provenance: dict[str, Any]
    ) -> CharacteristicFile:
        """The file that describes a characteristic."""
        over = characteristic.variable.replace(" ", "_")
        names = {
            PolachCurve: "polach",
            AdhesionTable: f"table_over_{over}",
            CreepCurve: f"exponentials_over_{over}",
        }
        if type(characteristic) not in names:
            raise InputError(
                f"a {type(characteristic).__name__} cannot be written as a file",
                remedy="give an adhesion characteristic or a creep curve",
            )
        given: dict[str, Any] = {names[type(characteristic)]: characteristic}
        return CharacteristicFile(**given, provenance=provenance)


_FAMILIES = tuple(each.name for each in fields(CharacteristicFile) if each.name != "provenance")
"""Keys that describe a characteristic."""


def characteristic_content(characteristic: AdhesionCharacteristic) -> dict[str, Any]:
    """What stands in a characteristic's file, to stand in another."""
    return file_content(CharacteristicFile.of(characteristic, {}))


def read_characteristic(path: str | Path) -> AdhesionCharacteristic:
    """The adhesion characteristic in a file, or one of Polach (2005) by its name.

    Parameters
    ----------
    path : str or Path
        A file of the format ``trainlog/characteristic`` (JSON, TOML); measured points as CSV, which
        become a table (see `read_adhesion_points`); or ``polach-dry``, ``polach-wet``.

    Raises
    ------
    InputError
        If it is none of these, or cannot be read.

    Examples
    --------
    >>> read_characteristic("polach-wet").friction
    0.3
    """
    name = str(path)
    if name in PRESETS:
        return polach_curve("dry" if name.endswith("dry") else "wet")
    if Path(path).suffix.lower() == ".csv":
        return built(lambda: read_adhesion_points(path).table(), path)
    if not Path(path).exists() and not Path(path).suffix:
        raise InputError(
            f"adhesion characteristic '{name}' is unknown",
            remedy=f"give a file, or one of {', '.join(PRESETS)}",
        )
    return read_thing(CharacteristicFile, path).characteristic


def write_characteristic(
    characteristic: AdhesionCharacteristic,
    path: str | Path,
    provenance: dict[str, Any] | None = None,
) -> None:
    """Write an adhesion characteristic to a file, JSON or TOML, whole or not at all.

    Parameters
    ----------
    characteristic : AdhesionCharacteristic
    path : str or Path
    provenance : dict, optional
        Where it is from, any JSON.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_characteristic(polach_curve("dry"), Path(folder) / "dry.json")
    ...     read_characteristic(Path(folder) / "dry.json") == polach_curve("dry")
    True
    """
    write_thing(CharacteristicFile.of(characteristic, provenance or {}), path, CharacteristicFile)


def read_adhesion_points(path: str | Path) -> AdhesionPoints:
    r"""Measured points of adhesion over slip in a CSV file.

    The first column is the slip: creepage where its unit is a pure number (``[%]``, ``[1]``), slip
    speed where it is a speed. The second is the adhesion, a pure number where it has no unit; a
    third, if there is one, the train's speed. Columns are separated by semicolons, tabs or commas.
    Of points in braking, with negative slip and adhesion, the sizes are taken; points without slip
    are left out.

    Raises
    ------
    InputError
        If the file is not such a table; with the line and the remedy.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "curve.csv"
    ...     _ = path.write_text("creepage [%];adhesion\n0;0\n0,8;0,21\n1,6;0,31\n10;0,25\n")
    ...     points = read_adhesion_points(path)
    >>> points.variable, points.slips.tolist()
    ('creepage', [0.008, 0.016, 0.1])
    """
    table = read_headed(path, _EXPECTED)
    table.identify_in_order("slip", "adhesion", "speed")
    variable, si = _slip_variable(table)
    slips = table.quantity(Column("slip", "%", si), required=True)
    adhesions = table.quantity(_ADHESION, table.units[1] or "1", required=True)
    speeds = table.quantity(Column("speed", "km/h", "m/s"), required=len(table.names) == 3)
    for row in np.flatnonzero((slips * adhesions < 0.0) & (np.abs(adhesions) > 0.02)):
        remedy = "give both positive in traction, both negative in braking"
        table.note(table.rows[row][0], "slip and adhesion have opposite signs", remedy)
    table.check()
    used = slips != 0.0
    return built(
        lambda: AdhesionPoints(
            np.abs(slips[used]),
            (np.sign(slips) * adhesions)[used],
            variable,
            speeds[used] if len(table.names) == 3 else None,
        ),
        path,
    )


def _slip_variable(table: HeadedTable) -> tuple[SlipVariable, str]:
    """What the first column is, by its unit, and its SI unit."""
    unit = table.unit(0)
    try:
        to_si(1.0, unit, "1")
    except InputError:
        built(lambda: to_si(1.0, unit, "m/s"), table.path)
        return "slip speed", "m/s"
    return "creepage", "1"

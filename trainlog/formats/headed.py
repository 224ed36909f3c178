"""CSV tables that people write: one header line, the unit of each column in its name."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray
from trainlog.declaration import Column
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.formats.files import read_bytes, write_bytes
from trainlog.units import to_si

Value = TypeVar("Value")
Empty = TypeVar("Empty")

_UNIT = re.compile(r"^(?P<name>.*?)\s*[\[(]\s*(?P<unit>[^\])]+?)\s*[\])]\s*$")


@dataclass(frozen=True)
class HeadedTable:
    """The cells of a table as text.

    Attributes
    ----------
    path : str or Path
    expected : str
        The remedy where there is no such header.
    line : int
        Of the header.
    names : tuple of str
        Of the columns, as they stand.
    units : tuple of (str or None)
        In brackets or parentheses at the end of a name.
    rows : tuple of (int, tuple of str)
        Line and cells of each row; as many cells as names.
    separator : str
    columns : dict of str to int
        Numbers of the columns by what they are; see `identify`.
    problems : list of (int, InputError)
        Those of cells and rows that were noted, with their line; see `check`.
    """

    path: str | Path
    expected: str
    line: int
    names: tuple[str, ...]
    units: tuple[str | None, ...]
    rows: tuple[tuple[int, tuple[str, ...]], ...]
    separator: str
    columns: dict[str, int] = field(default_factory=dict)
    problems: list[tuple[int, InputError]] = field(default_factory=list)

    def identify(
        self, name_of: Callable[[str], str | None], required: Iterable[str], others: bool = False
    ) -> None:
        """Find the columns and refuse a table that lacks one, has one twice, or has no row.

        Parameters
        ----------
        name_of : callable
            The name of a column of which the header states that in small letters; None: unknown.
        required : iterable of str
        others : bool
            Whether unknown columns are passed over.
        """
        for number, stated in enumerate(self.names):
            name = name_of(self.bare_name(number).casefold())
            if name in self.columns:
                first = self.names[self.columns[name]]
                self.refuse(
                    f"columns '{first}' and '{stated}' are both of the {name}", "remove one"
                )
            if name is not None:
                self.columns[name] = number
            elif not others:
                self.refuse(f"column '{stated}' is not known", f"{self.expected}; or remove it")
        missing = [f"no column of the {name}" for name in required if name not in self.columns]
        if missing:
            place = f"line {self.line}"
            listed = [InputError(each, place=place, remedy=self.expected) for each in missing]
            raise InputError.listing(listed, file=self.path)
        if not self.rows:
            raise InputError("has no row", file=self.path, remedy="add one")

    def identify_in_order(self, *names: str, least: int = 2) -> None:
        """Take the columns for those of the names, at least so many, whatever they are called."""
        if not least <= len(self.names) <= len(names):
            columns = counted(len(self.names), "column")
            self.refuse(f"has {columns}, expected {' and '.join(names[:least])}")
        self.columns.update(zip(names, range(len(self.names)), strict=False))

    def bare_name(self, column: int) -> str:
        """The name of a column without its unit."""
        found = _UNIT.match(self.names[column])
        return (found["name"] if found else self.names[column]).strip()

    def unit(self, column: int) -> str:
        """The unit of a column, which must have one."""
        unit = self.units[column]
        if unit is None:
            self.refuse(f"column '{self.names[column]}' has no unit")
        return unit

    def refuse(self, problem: str, remedy: str | None = None, line: int | None = None) -> NoReturn:
        """Raise what is wrong with the header, or with a line."""
        place = f"line {line or self.line}"
        raise InputError(problem, file=self.path, place=place, remedy=remedy or self.expected)

    def note(self, line: int, problem: str, remedy: str | None, name: str = "") -> None:
        """Add what is wrong with a row, or with its cell in a column."""
        place = f"line {line}" + (
            f", column '{self.bare_name(self.columns[name])}'" if name else ""
        )
        self.problems.append((line, InputError(problem, place=place, remedy=remedy)))

    def check(self) -> None:
        """Raise all that was noted, in the order of the lines."""
        if self.problems:
            in_order = sorted(self.problems, key=lambda each: each[0])
            raise InputError.listing([each for _, each in in_order], file=self.path)

    def cells(
        self, name: str, read: Callable[[str], Value], empty: Empty, required: bool = False
    ) -> list[Value | Empty]:
        """A column as `read` makes it of the cells; `empty` where one is, or is wrong and noted."""
        found: list[Value | Empty] = []
        for line, cells in self.rows:
            cell = cells[self.columns[name]] if name in self.columns else ""
            value: Value | Empty = empty
            if not cell and required:
                self.note(line, f"has no {name}", "give one, or remove the row")
            try:
                value = read(cell) if cell else empty
            except InputError as error:
                self.note(line, error.problem, error.remedy, name)
            found.append(value)
        return found

    def quantity(
        self, column: Column, unit: str | None = None, required: bool = False
    ) -> FloatArray:
        """A column of numbers in SI, NaN where there is none; those beyond its bounds are noted."""
        name, must = column.name, column.must
        if name not in self.columns:
            return np.full(len(self.rows), np.nan)
        unit = unit or self.unit(self.columns[name])
        values = self.cells(name, self.number, np.nan, required)
        try:
            converted = to_si(values, unit, column.si)
        except InputError as error:
            self.refuse(f"column '{name}': {error.problem}", error.remedy)
        for row, value in enumerate(converted.tolist() if must is not None else ()):
            if must is not None and not (np.isnan(value) or must.holds(value)):
                line, cells = self.rows[row]
                shown = f"{cells[self.columns[name]]} {unit}".removesuffix(" 1")
                self.note(line, f"{shown} {must.otherwise}", must.remedy, name)
                converted[row] = np.nan
        return converted

    def number(self, cell: str) -> float:
        """A cell as a number, with a decimal comma where commas do not separate cells."""
        try:
            value = float(cell if self.separator == "," else cell.replace(",", "."))
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise InputError(f"'{cell}' is not a number", remedy="correct it or leave it empty")
        return value


def written_time(time: int) -> str:
    """A time [ns since 1970 UTC] as tables state it."""
    return pd.Timestamp(time, tz="UTC").isoformat().replace("+00:00", "Z")


def write_headed(
    path: str | Path, columns: Sequence[Column], rows: Iterable[Sequence[Any]]
) -> None:
    """Write a table, whole or not at all; NaN becomes an empty cell."""
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(f"{each.name} [{each.unit}]" if each.unit else each.name for each in columns)
    table.writerows(["" if cell != cell else cell for cell in row] for row in rows)
    write_bytes(path, text.getvalue().encode())


def read_headed(path: str | Path, expected: str) -> HeadedTable:
    r"""Read a table whose header gives names and units.

    Columns are separated by semicolons, tabs or commas; with the first two a decimal comma is read,
    too. Empty lines and lines that begin with ``#`` are passed over.

    Parameters
    ----------
    path : str or Path
    expected : str
        The remedy where there is no such header.

    Raises
    ------
    InputError
        If the file is no text or empty, or a row has other cells than the header.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "line.csv"
    ...     _ = path.write_text("km [km];gradient [permil]\n0;2,5\n")
    ...     table = read_headed(path, "give a header")
    >>> table.units, table.rows
    (('km', 'permil'), ((2, ('0', '2,5')),))
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError("is not text in UTF-8", file=path, remedy="save it as UTF-8") from error
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip(" \t;,") and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise InputError("is empty", file=path, remedy=expected)
    header = lines[0][1]
    separator = next((each for each in ";\t" if each in header), ",")
    names = _cells(header, separator)
    while names and not names[-1]:
        names.pop()
    rows = []
    for number, line in lines[1:]:
        cells = _cells(line, separator)
        while len(cells) > len(names) and not cells[-1]:
            cells.pop()
        if len(cells) > len(names):
            raise InputError(
                f"'{line.strip()}' has {len(cells)} cells, the header has {len(names)}",
                file=path,
                place=f"line {number}",
                remedy=f"separate cells by '{separator}'",
            )
        rows.append((number, tuple(cells + [""] * (len(names) - len(cells)))))
    found = [_UNIT.match(name) for name in names]
    units = tuple(None if each is None else each["unit"] for each in found)
    return HeadedTable(path, expected, lines[0][0], tuple(names), units, tuple(rows), separator)


def _cells(line: str, separator: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]

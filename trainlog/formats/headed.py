"""CSV tables that people write: one header line, the unit of each column in its name."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.formats.files import read_bytes

_UNIT = re.compile(r"^(?P<name>.*?)\s*[\[(]\s*(?P<unit>[^\])]+?)\s*[\])]\s*$")


@dataclass(frozen=True)
class HeadedTable:
    """The cells of a table as text.

    Attributes
    ----------
    path : str or Path
    line : int
        Of the header.
    names : tuple of str
        Of the columns, as they stand.
    units : tuple of (str or None)
        In brackets or parentheses at the end of a name.
    rows : tuple of (int, tuple of str)
        Line and cells of each row; as many cells as names.
    separator : str
    """

    path: str | Path
    line: int
    names: tuple[str, ...]
    units: tuple[str | None, ...]
    rows: tuple[tuple[int, tuple[str, ...]], ...]
    separator: str

    def bare_name(self, column: int) -> str:
        """The name of a column without its unit."""
        found = _UNIT.match(self.names[column])
        return (found["name"] if found else self.names[column]).strip()

    def unit(self, column: int, expected: str) -> str:
        """The unit of a column; `expected` is the remedy where it has none."""
        unit = self.units[column]
        if unit is None:
            raise InputError(
                f"column '{self.names[column]}' has no unit",
                file=self.path,
                place=f"line {self.line}",
                remedy=expected,
            )
        return unit

    def number(self, cell: str) -> float:
        """A cell as a number, with a decimal comma where commas do not separate cells."""
        return float(cell if self.separator == "," else cell.replace(",", "."))

    def numbers(self, first: str, second: str, expected: str, *, most: int = 2) -> FloatArray:
        """The rows as numbers, (rows, columns) array; every cell must be one.

        Parameters
        ----------
        first, second : str
            What the first two columns hold; there must be these two.
        expected : str
            The remedy where there are others.
        most : int, optional
            Columns that there may be.

        Raises
        ------
        InputError
            If the table has other columns, or a cell is no number; with the line.
        """
        if not 2 <= len(self.names) <= most:
            raise InputError(
                f"has {counted(len(self.names), 'column')}, expected {first} and {second}",
                file=self.path,
                place=f"line {self.line}",
                remedy=expected,
            )
        found = np.empty((len(self.rows), len(self.names)))
        for row, (line, cells) in enumerate(self.rows):
            try:
                found[row] = [self.number(cell) for cell in cells]
            except ValueError as error:
                raise InputError(
                    f"'{self.separator.join(cells)}' is not a {first} and an {second}",
                    file=self.path,
                    place=f"line {line}",
                    remedy=f"give numbers separated by '{self.separator}'",
                ) from error
        return found


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
    return HeadedTable(path, lines[0][0], tuple(names), units, tuple(rows), separator)


def _cells(line: str, separator: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]

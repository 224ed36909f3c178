"""Curves of effort over speed as CSV: two columns with their units in the header."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trainlog.errors import InputError
from trainlog.formats.headed import HeadedTable, read_headed
from trainlog.formats.schema import built
from trainlog.railway import EffortCurve
from trainlog.units import to_si

_EXPECTED = "give a header such as 'speed [km/h];effort [kN]'"


def read_effort_curve(path: str | Path) -> EffortCurve:
    r"""The curve in a CSV file: speeds in the first column, efforts in the second.

    Columns are separated by semicolons, tabs or commas; with the first two a decimal comma is read,
    too. Empty lines and lines that begin with ``#`` are passed over.

    Raises
    ------
    InputError
        If the file is not such a table; with the line and the remedy.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "curve.csv"
    ...     _ = path.write_text("speed [km/h];effort [kN]\n0;200\n50,4;150,5\n")
    ...     read_effort_curve(path).efforts.tolist()
    [200000.0, 150500.0]
    """
    table = read_headed(path, _EXPECTED)
    if len(table.names) != 2:
        raise InputError(
            f"has {len(table.names)} columns, expected speed and effort",
            file=path,
            place=f"line {table.line}",
            remedy=_EXPECTED,
        )
    units = [(table.unit(column, _EXPECTED), si) for column, si in enumerate(("m/s", "N"))]
    rows = [_row(table, number, cells) for number, cells in table.rows]
    numbers = np.array(rows, dtype=np.float64).reshape(-1, 2)
    return built(
        lambda: EffortCurve(
            *(to_si(column, *unit) for column, unit in zip(numbers.T, units, strict=True))
        ),
        path,
    )


def _row(table: HeadedTable, number: int, cells: tuple[str, ...]) -> list[float]:
    try:
        return [table.number(cell) for cell in cells]
    except ValueError as error:
        raise InputError(
            f"'{table.separator.join(cells)}' is not a speed and an effort",
            file=table.path,
            place=f"line {number}",
            remedy=f"give two numbers separated by '{table.separator}'",
        ) from error

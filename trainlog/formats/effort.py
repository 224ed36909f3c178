"""Curves of effort over speed as CSV: two columns with their units in the header."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np

from trainlog.errors import InputError
from trainlog.formats.files import read_bytes
from trainlog.formats.schema import built
from trainlog.railway import EffortCurve
from trainlog.units import to_si

_UNIT = re.compile(r"[\[(]\s*([^\])]+?)\s*[\])]\s*$")
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
        raise InputError("is empty", file=path, remedy=_EXPECTED)
    header = lines[0][1]
    separator = next((each for each in ";\t" if each in header), ",")
    names = [cell.strip() for cell in next(csv.reader([header], delimiter=separator))]
    while names and not names[-1]:
        names.pop()
    if len(names) != 2:
        raise InputError(
            f"has {len(names)} columns, expected speed and effort",
            file=path,
            place=f"line {lines[0][0]}",
            remedy=_EXPECTED,
        )
    units = []
    for name, si in zip(names, ("m/s", "N"), strict=True):
        found = _UNIT.search(name)
        if found is None:
            raise InputError(
                f"column '{name}' has no unit",
                file=path,
                place=f"line {lines[0][0]}",
                remedy=_EXPECTED,
            )
        units.append((found.group(1), si))
    rows = [_row(line, separator, number, path) for number, line in lines[1:]]
    table = np.array(rows, dtype=np.float64).reshape(-1, 2)
    return built(
        lambda: EffortCurve(
            *(to_si(column, *unit) for column, unit in zip(table.T, units, strict=True))
        ),
        path,
    )


def _row(line: str, separator: str, number: int, path: str | Path) -> list[float]:
    cells = [cell.strip() for cell in line.split(separator)]
    while len(cells) > 2 and not cells[-1]:
        cells.pop()
    try:
        first, second = cells
        return [
            float(cell if separator == "," else cell.replace(",", ".")) for cell in (first, second)
        ]
    except ValueError as error:
        raise InputError(
            f"'{line.strip()}' is not a speed and an effort",
            file=path,
            place=f"line {number}",
            remedy=f"give two numbers separated by '{separator}'",
        ) from error

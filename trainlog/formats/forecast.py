"""Forecasts of adhesion as CSV; docs/adhesion-forecast-verification.md defines the columns."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from trainlog.errors import InputError
from trainlog.formats.files import check_written, write_bytes
from trainlog.formats.headed import HeadedTable, read_headed
from trainlog.railway.forecast import AdhesionForecast
from trainlog.railway.weather import check_condition
from trainlog.spans import utc
from trainlog.units import to_si

REQUIRED = ("line", "from", "to", "valid from", "valid to")
OPTIONAL = ("layer", "issued")
LENGTHS = ("km", "m")
"""Units of a section's ends."""

_EXPECTED = (
    "give a header such as 'line,layer,from [km],to [km],valid from,valid to,"
    "quantile 0.05,quantile 0.5,quantile 0.95', or 'below 0.08' for a probability"
)
_NUMBERED = re.compile(r"^(quantile|below)\s+([0-9.eE+-]+)$")
_TIME = "write it as 2026-11-22T06:00:00Z"


def read_forecast(
    path: str | Path, line: str | None = None, length: float = np.inf
) -> AdhesionForecast:
    r"""Read a forecast of adhesion.

    Parameters
    ----------
    path : str or Path
    line : str, optional
        For which it must be; default: any.
    length : float [m]
        Beyond which no section may reach.

    Raises
    ------
    InputError
        If the file is not such a table. All that is wrong in its rows is listed, with line and
        remedy.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "forecast.csv"
    ...     _ = path.write_text(
    ...         "line,from [km],to [km],valid from,valid to,below 0.08\n"
    ...         "A-B,0,1.5,2026-11-22T00:00Z,2026-11-23T00:00Z,0.2\n"
    ...     )
    ...     read_forecast(path)
    Adhesion forecast for line 'A-B', 1 row
    """
    table = read_headed(path, _EXPECTED)
    names, shares, thresholds = _columns(table)
    if not table.rows:
        raise InputError("holds no forecast", file=path, remedy="give a row a section and time")
    rows = [_Row(table, number, row, names, shares, thresholds) for number, row in table.rows]
    for row in rows:
        row.check_line(line, length)
    problems = _of_several_lines(rows) if line is None else []
    problems += [problem for row in rows for problem in row.problems]
    sound = [row for row in rows if not row.problems]
    if not sound:
        raise InputError.listing(problems, file=path)
    cells, numbers = [row.values for row in sound], [row.number for row in sound]
    columns: dict[str, Any] = {key: [each[key] for each in cells] for key in cells[0]}
    found = AdhesionForecast(
        columns["line"][0],
        start=np.array(columns["from"]),
        end=np.array(columns["to"]),
        valid_from=np.array(columns["valid from"], dtype=np.int64),
        valid_to=np.array(columns["valid to"], dtype=np.int64),
        issued=np.array(columns["issued"], dtype=np.int64),
        layer=tuple(columns["layer"]),
        shares=np.array(list(shares)),
        quantiles=np.array(columns["quantiles"]).reshape(len(cells), -1),
        thresholds=np.array(list(thresholds)),
        below=np.array(columns["below"]).reshape(len(cells), -1),
        place=tuple(f"{Path(path).name}, line {number}" for number in numbers),
    )
    for index, number in enumerate(numbers):
        try:
            found.points(index)
        except InputError as error:
            problems.append(_refused(table, number, error.problem, error.remedy or ""))
    if problems:
        order = [0 if each.place is None else int(each.place.split()[-1]) for each in problems]
        in_order = [problems[each] for each in np.argsort(order, kind="stable").tolist()]
        raise InputError.listing(in_order, file=path)
    return found


def _of_several_lines(rows: list[_Row]) -> list[InputError]:
    lines = sorted({row.values["line"] for row in rows if row.values["line"]})
    if len(lines) < 2:
        return []
    words = f"is for {len(lines)} lines: {', '.join(lines[:3])}"
    return [InputError(words, remedy="give a file a line")]


def write_forecast(forecast: AdhesionForecast, path: str | Path) -> None:
    """Write a forecast of adhesion, whole or not at all; lengths in km, times in UTC.

    Examples
    --------
    >>> from pathlib import Path
    >>> from trainlog.railway.forecast import AdhesionForecast
    >>> import numpy as np
    >>> import tempfile
    >>> day = np.array([0]), np.array([86_400 * 10**9]), np.array([0])
    >>> forecast = AdhesionForecast(
    ...     "A-B", np.array([0.0]), np.array([500.0]), *day, ("wet",), np.array([0.05, 0.5]),
    ...     np.array([[0.08, 0.12]]), np.zeros(0), np.zeros((1, 0)),
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "forecast.csv"
    ...     write_forecast(forecast, path)
    ...     print(path.read_text().splitlines()[1])
    A-B,wet,0.000,0.500,1970-01-01T00:00:00Z,1970-01-02T00:00:00Z,1970-01-01T00:00:00Z,0.08,0.12
    """
    check_written(forecast, AdhesionForecast)
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(
        ["line", "layer", "from [km]", "to [km]", "valid from", "valid to", "issued"]
        + [f"quantile {share:g}" for share in forecast.shares]
        + [f"below {level:g}" for level in forecast.thresholds]
    )
    times = (forecast.valid_from, forecast.valid_to, forecast.issued)
    for row in range(forecast.start.size):
        stated = np.concatenate((forecast.quantiles[row], forecast.below[row]))
        table.writerow(
            [
                forecast.line,
                forecast.layer[row],
                f"{forecast.start[row] / 1e3:.3f}",
                f"{forecast.end[row] / 1e3:.3f}",
                *(_written(int(each[row])) for each in times),
                *("" if np.isnan(value) else f"{value:.6g}" for value in stated),
            ]
        )
    write_bytes(path, text.getvalue().encode("utf-8"))


def _written(time: int) -> str:
    return pd.Timestamp(time, tz="UTC").isoformat().replace("+00:00", "Z")


def _columns(table: HeadedTable) -> tuple[dict[str, int], dict[float, int], dict[float, int]]:
    """Columns by name, and those of quantiles and probabilities by their number, increasing."""
    names: dict[str, int] = {}
    numbered: dict[str, dict[float, int]] = {"quantile": {}, "below": {}}
    for column in range(len(table.names)):
        name = table.bare_name(column).lower()
        found = _NUMBERED.match(name)
        known: dict[Any, int] = names if found is None else numbered[found[1]]
        key: Any = name if found is None else _number(table, table.line, found[2], name)
        if found is None and name not in REQUIRED + OPTIONAL:
            raise _refused(table, table.line, f"column '{table.names[column]}' is not known")
        if key in known:
            raise _refused(table, table.line, f"column '{name}' is there twice")
        known[key] = column
    lacking = [name for name in REQUIRED if name not in names]
    if lacking:
        raise _refused(table, table.line, f"lacks the column '{lacking[0]}'")
    for kind, found_numbers in numbered.items():
        for number in found_numbers:
            if not 0.0 < number < 1.0:
                raise _refused(
                    table, table.line, f"column '{kind} {number:g}' must be between 0 and 1"
                )
    if not numbered["quantile"] and not numbered["below"]:
        raise _refused(table, table.line, "forecasts neither a quantile nor a probability")
    for name in ("from", "to"):
        if table.unit(names[name], _EXPECTED) not in LENGTHS:
            raise _refused(
                table,
                table.line,
                f"column '{table.names[names[name]]}' is in neither of {', '.join(LENGTHS)}",
                "convert the lengths, and name the columns 'from [km]' and 'to [km]'",
            )
    quantiles, below = (dict(sorted(each.items())) for each in numbered.values())
    return names, quantiles, below


def _number(table: HeadedTable, line: int, cell: str, name: str) -> float:
    try:
        value = table.number(cell)
        if not np.isfinite(value):
            raise ValueError(cell)
    except ValueError as error:
        raise _refused(
            table, line, f"{name}: '{cell}' is not a number", "give a number, or leave it empty"
        ) from error
    return value


def _refused(table: HeadedTable, line: int, problem: str, remedy: str = _EXPECTED) -> InputError:
    return InputError(problem, file=table.path, place=f"line {line}", remedy=remedy)


class _Row:
    """The cells of one row, and all that is wrong with them."""

    def __init__(
        self,
        table: HeadedTable,
        number: int,
        cells: tuple[str, ...],
        names: dict[str, int],
        shares: dict[float, int],
        thresholds: dict[float, int],
    ) -> None:
        self._table, self.number, self._cells, self._names = table, number, cells, names
        self.problems: list[InputError] = []
        line, layer = self._named("line"), self._cell("layer")
        if layer:
            self._layer(layer)
        start, end = self._length("from"), self._length("to")
        # A cell that cannot be read is NaN or None, and listed already.
        if start < 0.0 or start >= end or end < 0.0:
            self._wrong(
                f"a section from km {start / 1e3:g} to km {end / 1e3:g}",
                "it must end behind its beginning, and begin at km 0 or later",
            )
        first, last = self._time("valid from"), self._time("valid to")
        if first is not None and last is not None and first >= last:
            self._wrong("is valid to a time before its beginning", "correct the times")
        issued = self._time("issued") if self._cell("issued") else first
        if issued is not None and first is not None and issued > first:
            self._wrong(
                "was issued after it became valid",
                "a forecast is issued before; state as valid only what was left",
            )
        self.values: dict[str, Any] = {
            "line": line,
            "layer": layer,
            "from": start,
            "to": end,
            "valid from": first,
            "valid to": last,
            "issued": issued,
            "quantiles": [
                self._stated(column, f"quantile {share:g}", lambda x: 0.0 < x <= 1.0)
                for share, column in shares.items()
            ],
            "below": [
                self._stated(column, f"below {level:g}", lambda x: 0.0 <= x <= 1.0)
                for level, column in thresholds.items()
            ],
        }

    def check_line(self, line: str | None, length: float) -> None:
        """List it as a problem if the row is for another line, or reaches beyond the end."""
        own = self.values["line"]
        if line is not None and own and own != line:
            self._wrong(
                f"the forecast is for line '{own}', the trips ran on '{line}'",
                "give the forecast for the line of the trips",
            )
        elif self.values["to"] > length:
            self._wrong(
                f"the forecast reaches km {self.values['to'] / 1e3:.3f}, the line ends at"
                f" km {length / 1e3:.3f}",
                "count kilometres from the line's beginning",
            )

    def _cell(self, name: str) -> str:
        return self._cells[self._names[name]] if name in self._names else ""

    def _named(self, name: str) -> str:
        if not self._cell(name):
            self._wrong(f"names no {name}", f"give the {name}")
        return self._cell(name)

    def _layer(self, layer: str) -> None:
        try:
            check_condition(layer)
        except InputError as error:
            self._wrong(error.problem, error.remedy or "")

    def _length(self, name: str) -> float:
        column = self._names[name]
        value = self._value(column, name)
        return float(to_si(np.array([value]), self._table.unit(column, _EXPECTED), "m")[0])

    def _time(self, name: str) -> int | None:
        cell = self._named(name)
        try:
            return int(utc(cell).value) if cell else None
        except InputError as error:
            self._wrong(f"{name}: {error.problem}", _TIME)
            return None

    def _stated(self, column: int, name: str, holds: Callable[[float], bool]) -> float:
        value = self._value(column, name) if self._cells[column] else float("nan")
        if np.isfinite(value) and not holds(value):
            what = "an adhesion above 0" if name.startswith("quantile") else "a probability from 0"
            self._wrong(f"{name} is {value:g}", f"give {what} to 1, not in per cent")
        return value

    def _value(self, column: int, name: str) -> float:
        try:
            return _number(self._table, self.number, self._cells[column], name)
        except InputError as error:
            self.problems.append(error)
            return float("nan")

    def _wrong(self, problem: str, remedy: str) -> None:
        self.problems.append(_refused(self._table, self.number, problem, remedy))

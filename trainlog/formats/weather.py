"""Weather at a line as CSV: times, the rail's condition, temperature, humidity, precipitation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TypeVar
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.formats.files import write_bytes
from trainlog.formats.headed import HeadedTable, read_headed
from trainlog.railway.weather import (
    LONGEST_HOLD,
    MILLIMETRE_PER_HOUR,
    Weather,
    check_condition,
)
from trainlog.units import factor, to_si

Value = TypeVar("Value")

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

_EXPECTED = (
    "give a header such as"
    " 'time [UTC];condition;temperature [degC];humidity [%];precipitation [mm/h]'"
)


@dataclass(frozen=True, slots=True)
class _Quantity:
    """A column of numbers: its SI unit, and what is plausible in it."""

    si: str
    low: float
    high: float
    words: str


_QUANTITIES = {
    "temperature": _Quantity("K", 203.15, 333.15, "air has -70 to 60 degC"),
    "humidity": _Quantity("1", 0.0, 1.05, "relative humidity is 0 to 100 %"),
    "precipitation": _Quantity("m/s", 0.0, 500.0 * MILLIMETRE_PER_HOUR, "it rains 0 to 500 mm/h"),
}
_COLUMNS = ("time", "until", "condition", *_QUANTITIES)


def read_weather(path: str | Path) -> Weather:
    r"""Read a weather file.

    A row holds from its ``time`` to its ``until`` or, without one, to the next row, but for three
    hours at most. Times are ISO 8601 with an offset or ``Z``; without one they are of the zone that
    the column's name states: ``time [UTC]``, ``time [Europe/Zurich]``. An empty cell is not known.

    Raises
    ------
    InputError
        If the file is no such table. Rows that are wrong are listed, with line and remedy: a time
        without a zone, or that does not exist or comes twice when clocks are set; times out of
        order; a misspelt condition; a number that weather does not have.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> rows = "2026-10-24 06:00;wet;8,5\n2026-10-24 07:00;dry;9\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "weather.csv"
    ...     _ = path.write_text("time [Europe/Zurich];condition;temperature [degC]\n" + rows)
    ...     weather = read_weather(path)
    >>> weather.at(1_792_816_200 * 10**9).known()
    {'condition': 'wet', 'temperature': 281.65}
    """
    table = read_headed(path, _EXPECTED)
    columns = _columns(table)
    problems: list[InputError] = []
    times, ends = (
        _read(table, columns.get(name), _reader_of_times(table, columns.get(name)), problems)
        for name in ("time", "until")
    )
    conditions = _read(table, columns.get("condition"), check_condition, problems)
    numbers = [_numbers(table, columns.get(name), name, problems) for name in _QUANTITIES]
    if not problems:
        problems = _disorder(table, columns["time"], times, ends)
    if problems:
        raise InputError.listing(problems, file=path)
    starts = np.array(times, dtype=np.int64)
    words = tuple(each or "" for each in conditions)
    return Weather(starts, _ends(starts, ends), words, *numbers)


def write_weather(weather: Weather, path: str | Path) -> None:
    """Write weather as CSV; `read_weather` reads the same.

    Examples
    --------
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import tempfile
    >>> weather = Weather([0], [10**10], ("leaves",), [280.0], [0.9], [np.nan])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_weather(weather, Path(folder) / "weather.csv")
    ...     print((Path(folder) / "weather.csv").read_text(), end="")
    time [UTC],until [UTC],condition,temperature [K],humidity [1],precipitation [mm/h]
    1970-01-01T00:00:00Z,1970-01-01T00:00:10Z,leaves,280,0.9,
    """
    header = "time [UTC],until [UTC],condition,temperature [K],humidity [1],precipitation [mm/h]"
    fall = weather.precipitation / MILLIMETRE_PER_HOUR
    rows = [
        f"{_written(start)},{_written(end)},{condition},{_number(warm)},{_number(damp)},{_number(rain)}"
        for start, end, condition, warm, damp, rain in zip(
            weather.starts.tolist(),
            weather.ends.tolist(),
            weather.conditions,
            weather.temperature.tolist(),
            weather.humidity.tolist(),
            fall.tolist(),
            strict=True,
        )
    ]
    write_bytes(path, ("\n".join([header, *rows]) + "\n").encode())


def _columns(table: HeadedTable) -> dict[str, int]:
    """Number of each column by its name without unit."""

    def refused(problem: str, remedy: str = _EXPECTED) -> InputError:
        return InputError(problem, file=table.path, place=f"line {table.line}", remedy=remedy)

    found: dict[str, int] = {}
    for number in range(len(table.names)):
        name = table.bare_name(number).casefold()
        if name not in _COLUMNS:
            raise refused(
                f"column '{table.names[number]}' is not one of a weather file",
                f"name it one of {', '.join(_COLUMNS)}, or remove it",
            )
        if name in found:
            raise refused(f"column '{name}' comes twice", "remove one of them")
        found[name] = number
    if "time" not in found or not set(found) - {"time", "until"}:
        raise refused("needs the column 'time' and one besides")
    for name, quantity in _QUANTITIES.items():
        if name in found:
            try:
                factor(table.unit(found[name], _EXPECTED), quantity.si)
            except InputError as error:
                where = "" if error.place else f"column '{name}': "
                raise refused(where + error.problem, error.remedy or _EXPECTED) from error
    if not table.rows:
        raise InputError("has no row", file=table.path, remedy="give one row a time")
    return found


def _read(
    table: HeadedTable,
    column: int | None,
    read: Callable[[str], Value],
    problems: list[InputError],
) -> list[Value | None]:
    """A column's cells as they are read; None: empty, or wrong and listed in `problems`."""
    found: list[Value | None] = []
    for number, cells in table.rows:
        cell = "" if column is None else cells[column]
        try:
            found.append(read(cell) if cell else None)
        except InputError as error:
            found.append(None)
            problems.append(_at(table, number, column, error.problem, error.remedy))
    return found


def _at(
    table: HeadedTable, number: int, column: int | None, problem: str, remedy: str | None
) -> InputError:
    """A problem of a cell, or of a row."""
    name = "" if column is None else f", column '{table.bare_name(column)}'"
    return InputError(problem, place=f"line {number}{name}", remedy=remedy)


def _reader_of_times(table: HeadedTable, column: int | None) -> Callable[[str], int]:
    """Reads a time [ns since 1970 UTC] of a column in the zone that its name states."""
    name = None if column is None else table.units[column]
    try:
        zone = None if name is None else ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise InputError(
            f"'{name}' is no time zone",
            file=table.path,
            place=f"line {table.line}",
            remedy="name it as in 'time [UTC]' or 'time [Europe/Zurich]'",
        ) from error

    def read(cell: str) -> int:
        try:
            time = datetime.fromisoformat(cell)
        except ValueError:
            raise InputError(
                f"'{cell}' is no time", remedy="write it as 2026-10-24T06:00:00Z"
            ) from None
        if time.tzinfo is None:
            if zone is None:
                raise InputError(
                    f"'{cell}' has no time zone",
                    remedy="add 'Z' or an offset, or name the column 'time [Europe/Zurich]'",
                )
            time = time.replace(tzinfo=zone)
            if time.utcoffset() != time.replace(fold=1).utcoffset():
                raise InputError(
                    f"'{cell}' does not exist or comes twice in {name}: clocks are set then",
                    remedy="write the time with its offset, as in 2026-10-25T02:30+02:00",
                )
        return (time - EPOCH) // timedelta(microseconds=1) * 1000

    return read


def _numbers(
    table: HeadedTable, column: int | None, name: str, problems: list[InputError]
) -> FloatArray:
    """A column of numbers in SI; NaN: not known."""
    if column is None:
        return np.full(len(table.rows), np.nan)

    def read(cell: str) -> float:
        try:
            return table.number(cell)
        except ValueError:
            raise InputError(
                f"'{cell}' is no number", remedy="leave the cell empty where nothing is known"
            ) from None

    quantity, unit = _QUANTITIES[name], table.unit(column, _EXPECTED)
    found = _read(table, column, read, problems)
    given = np.array([each is not None for each in found])
    values = to_si([np.nan if each is None else each for each in found], unit, quantity.si)
    within = (values >= quantity.low) & (values <= quantity.high)
    for row in np.flatnonzero(given & ~within):
        number, cells = table.rows[row]
        problem = f"{cells[column]} {unit} is not plausible: {quantity.words}"
        problems.append(_at(table, number, column, problem, "check its unit in the header"))
    return np.asarray(np.minimum(values, 1.0) if name == "humidity" else values)


def _disorder(
    table: HeadedTable, column: int, times: list[int | None], ends: list[int | None]
) -> list[InputError]:
    """Rows that lack a time, are out of order, end before they begin or after the next begins."""
    found: list[InputError] = []
    before: int | None = None
    until: int | None = None
    for (number, cells), time, end in zip(table.rows, times, ends, strict=True):
        if time is None:
            found.append(_at(table, number, None, "has no time", "give one, or remove the row"))
            continue
        shown = cells[column]
        if before is not None and time <= before:
            words, remedy = f"'{shown}' is not after the row before", "sort the rows"
            found.append(_at(table, number, None, words, remedy))
        elif until is not None and time < until:
            words, remedy = f"'{shown}' is before the end of the row before", "let no rows overlap"
            found.append(_at(table, number, None, words, remedy))
        if end is not None and end <= time:
            words, remedy = "ends before it begins", "correct 'time' or 'until'"
            found.append(_at(table, number, None, words, remedy))
        before, until = time, end
    return found


def _ends(starts: IntArray, stated: list[int | None]) -> IntArray:
    """When each row ends: as stated, else with the next one, after `LONGEST_HOLD` at the latest."""
    following = np.append(starts[1:], np.iinfo(np.int64).max)
    ends = np.minimum(following, starts + LONGEST_HOLD)
    known = [row for row, end in enumerate(stated) if end is not None]
    ends[known] = [end for end in stated if end is not None]
    return np.asarray(ends, dtype=np.int64)


def _written(time: int) -> str:
    """A time [ns since 1970 UTC] in words, to the microsecond."""
    return (EPOCH + timedelta(microseconds=time // 1000)).isoformat().replace("+00:00", "Z")


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.15g}"

"""Weather at a line as CSV: times, the rail's condition, temperature, humidity, precipitation."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from trainlog.declaration import Column, Must
from trainlog.errors import InputError
from trainlog.formats.headed import HeadedTable, read_headed, write_headed, written_time
from trainlog.railway.weather import (
    LONGEST_HOLD,
    MILLIMETRE_PER_HOUR,
    Weather,
    check_condition,
)

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

_EXPECTED = (
    "give a header such as"
    " 'time [UTC];condition;temperature [degC];humidity [%];precipitation [mm/h]'"
)
_CHECK = "check its unit in the header"
_AIR = Must("is not plausible: air has -70 to 60 degC", _CHECK, 203.15, 333.15)
_DAMP = Must("is not plausible: relative humidity is 0 to 100 %", _CHECK, 0.0, 1.05)
_RAIN = Must("is not plausible: it rains 0 to 500 mm/h", _CHECK, 0.0, 500.0 * MILLIMETRE_PER_HOUR)
_WORDS = (Column("time", "UTC"), Column("until", "UTC"), Column("condition"))
_NUMBERS = (
    Column("temperature", "K", "K", must=_AIR),
    Column("humidity", "1", "1", must=_DAMP),
    Column("precipitation", "mm/h", "m/s", must=_RAIN),
)


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
    known = [each.name for each in (*_WORDS, *_NUMBERS)]
    table.identify(lambda name: name if name in known else None, ["time"])
    if set(table.columns) <= {"time", "until"}:
        table.refuse("needs the column 'time' and one besides")
    times = table.cells("time", _reader_of_times(table, "time"), None, required=True)
    stated = table.cells("until", _reader_of_times(table, "until"), None)
    conditions = table.cells("condition", check_condition, "")
    numbers = [table.quantity(each) for each in _NUMBERS]
    if not table.problems:
        _check_order(table, times, stated)
    table.check()
    starts = np.array(times, dtype=np.int64)
    # Rows without an end hold to the next one, but for `LONGEST_HOLD` at most.
    following = np.append(starts[1:], np.iinfo(np.int64).max)
    ends = np.minimum(following, starts + LONGEST_HOLD)
    ends = np.where([end is None for end in stated], ends, [end or 0 for end in stated])
    numbers[1] = np.minimum(numbers[1], 1.0)
    return Weather(starts, ends, tuple(conditions), *numbers)


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
    numbers = weather.temperature, weather.humidity, weather.precipitation / MILLIMETRE_PER_HOUR
    columns = (
        *(
            map(written_time, (times // 1000 * 1000).tolist())
            for times in (weather.starts, weather.ends)
        ),
        weather.conditions,
        *([f"{each:.15g}" if each == each else "" for each in known] for known in numbers),
    )
    write_headed(path, (*_WORDS, *_NUMBERS), zip(*columns, strict=True))


def _reader_of_times(table: HeadedTable, name: str) -> Callable[[str], int]:
    """Reads a time [ns since 1970 UTC] of a column in the zone that its name states."""
    stated = table.units[table.columns[name]] if name in table.columns else None
    try:
        zone = None if stated is None else ZoneInfo(stated)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        table.refuse(
            f"'{stated}' is no time zone", "name it as in 'time [UTC]' or 'time [Europe/Zurich]'"
        )

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
                    f"'{cell}' does not exist or comes twice in {stated}: clocks are set then",
                    remedy="write the time with its offset, as in 2026-10-25T02:30+02:00",
                )
        return (time - EPOCH) // timedelta(microseconds=1) * 1000

    return read


def _check_order(table: HeadedTable, times: list[int | None], ends: list[int | None]) -> None:
    """Note rows out of order, that end before they begin, or after the next begins."""
    before, until = -np.inf, -np.inf
    for (line, cells), time, end in zip(table.rows, times, ends, strict=True):
        assert time is not None
        shown = cells[table.columns["time"]]
        if time <= before:
            table.note(line, f"'{shown}' is not after the row before", "sort the rows")
        elif time < until:
            table.note(
                line, f"'{shown}' is before the end of the row before", "let no rows overlap"
            )
        if end is not None and end <= time:
            table.note(line, "ends before it begins", "correct 'time' or 'until'")
        before, until = time, -np.inf if end is None else end

"""Tables that people write as CSV: one header line, the unit of each column in its name.

`HeadedTable` reads any of them; here are those of lines, weather and forecasts.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray
from trainlog.declaration import Column, Must, check_plausible
from trainlog.display import counted, text_of_cell
from trainlog.errors import InputError
from trainlog.formats.declared import built
from trainlog.formats.files import check_written, csv_bytes, read_bytes, write_bytes
from trainlog.formats.tracks import Account, Limit, LimitChoice, Stretch, TrackData, curvature_of
from trainlog.railway import Line, Station
from trainlog.railway.condition import AdhesionForecast
from trainlog.railway.line import LineReference
from trainlog.railway.resistance import EffortCurve
from trainlog.railway.weather import LONGEST_HOLD, MILLIMETRE_PER_HOUR, Weather, check_condition
from trainlog.spans import ALWAYS, utc, zone_of
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
    heads = [f"{each.name} [{each.unit}]" if each.unit else each.name for each in columns]
    write_bytes(path, csv_bytes(pd.DataFrame(rows, columns=heads, dtype=object)))


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
    return [text_of_cell(cell.strip()) for cell in next(csv.reader([line], delimiter=separator))]


_CURVE_COLUMNS = Column("speed", "km/h", "m/s"), Column("effort", "kN", "N")
_CURVE_HEADER = "give a header such as 'speed [km/h];effort [kN]'"


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
    table = read_headed(path, _CURVE_HEADER)
    table.identify_in_order(*(each.name for each in _CURVE_COLUMNS))
    values = [table.quantity(each, required=True) for each in _CURVE_COLUMNS]
    table.check()
    return built(lambda: EffortCurve(*values), path)


LINE_COLUMNS = {
    "position": (
        "position chainage kilometre kilometer km pk mileage distance s weg strecke station_km"
        " kilometrierung abszisse abscisse"
    ),
    "gradient": "gradient slope grade neigung steigung laengsneigung längsneigung pente déclivité"
    " declivite rampe",
    "limit": "limit speed_limit speed vmax v_max v geschwindigkeit vitesse",
    "station": "station stop stations halt bahnhof haltestelle betriebsstelle gare arrêt arret",
    "radius": "radius radius_of_curve halbmesser bogenradius rayon",
    "latitude": "latitude lat breite breitengrad",
    "longitude": "longitude lon long länge laenge längengrad",
}
"""What people call the columns of a line's table, in English, German and French."""

_LINE_NUMBERS = (
    Column("position", "km", "m"),
    Column("gradient", "permil", "1"),
    Column("limit", "km/h", "m/s"),
    Column("radius", "m", "m"),
    Column("latitude", "deg", "deg"),
    Column("longitude", "deg", "deg"),
)
"""Those of numbers, with a unit to suggest."""

_LINE_HEADER = "give a header such as 'chainage [km];gradient [permil];limit [km/h];station'"


def read_line_table(path: str | Path, *, name: str | None = None) -> Line:
    r"""A line from a CSV table of its rows.

    Each row gives a chainage and what holds from there on; an empty cell leaves what held before. A
    row with a station names it. The last row is the line's end; what it states besides its chainage
    and station does not matter. Chainage that begins elsewhere or falls is counted from the first
    row; gradients and curves are those of a train that runs from the first row to the last.

    Parameters
    ----------
    path : str or Path
        Columns of chainage, gradient and speed limit, and, if known, station, radius of curves (0
        or empty at the first row: straight), latitude and longitude; units in the header.
    name : str, optional
        Of the line; default: that of the file.

    Raises
    ------
    InputError
        With the line of the file and the remedy.

    Examples
    --------
    >>> import tempfile
    >>> header = "chainage [km];gradient [permil];limit [km/h];station\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "A-B.csv"
    ...     _ = path.write_text(header + "0;2,5;80;A\n3,2;;100;\n9;;;B\n")
    ...     line = read_line_table(path)
    >>> line.length, line.gradient(5e3).item(), line.speed_limits.positions.tolist()
    (9000.0, 0.0025, [0.0, 3200.0])
    """
    table = read_headed(path, _LINE_HEADER)
    kinds = {word: kind for kind, words in LINE_COLUMNS.items() for word in words.split()}
    required = ("position", "gradient", "limit")
    table.identify(lambda word: kinds.get(word.replace(" ", "_")), required, others=True)
    known = {
        each.name: _line_numbers(table, each)
        for each in _LINE_NUMBERS
        if each.name in table.columns
    }
    at = known["position"]
    _check_positions(table, at)
    table.check()
    for kind in ("gradient", "limit"):
        if np.isnan(known[kind][0]):
            remedy = f"give the {kind} that holds from the first row on"
            table.refuse(f"no {kind} at the line's begin", remedy, table.rows[0][0])
    first, along = float(at[0]), np.abs(at - at[0])
    called, source = name or Path(path).stem.removesuffix(".line"), f"table {Path(path).name}"
    falling = at[-1] < first
    track = TrackData(called, float(along[-1]), course_quality=f"from {source}")
    if first:
        source += f"; position 0 is km {first / 1e3:.3f} of the table"
        source += ", whose kilometres fall" * bool(falling)
        ends = np.array([first]), np.array([at[-1]])
        track.reference = LineReference(called, np.zeros(1), *ends)
    at = along
    track.gradients = _stretches(at, known["gradient"])
    track.limits = [Limit(*each[:3]) for each in _stretches(at, known["limit"])]
    if "radius" in known:
        curvatures = np.array([curvature_of(each) for each in known["radius"].tolist()])
        curvatures[0] = np.nan_to_num(curvatures[0])
        track.curves = _stretches(at, curvatures)
    if {"latitude", "longitude"} <= known.keys():
        rows = zip(at, known["latitude"], known["longitude"], strict=True)
        track.course = [row for row in rows if np.all(np.isfinite(row))]
        if len(track.course) < 2:
            remedy = "give both in two rows or more, or remove the columns"
            table.refuse("needs at least two points, each with two coordinates", remedy)
    named = zip(table.cells("station", str, ""), at.tolist(), strict=True)
    track.stations = [Station(each, place) for each, place in named if each]
    choice = LimitChoice().among([track], Account())
    line = built(lambda: replace(track.line(Account(), choice), source=source), path)
    built(lambda: check_plausible(line), path)
    return line


def _stretches(at: FloatArray, values: FloatArray) -> list[Stretch]:
    """What holds from each row that gives it to the next one; the last row is the line's end."""
    rows = [*np.flatnonzero(np.isfinite(values[:-1])), -1]
    return [Stretch(float(at[a]), float(at[b]), float(values[a])) for a, b in pairwise(rows)]


def _line_numbers(table: HeadedTable, column: Column) -> FloatArray:
    """A column in SI, NaN where a cell is empty."""
    number = table.columns[column.name]
    bare, unit = table.bare_name(number), table.units[number]
    if unit is None and (bare.lower() == "km" or column.unit == "deg"):
        unit = column.unit
    if unit is None:
        table.refuse(f"column '{bare}' has no unit", f"write '{bare} [{column.unit}]'")
    return table.quantity(column, unit, required=column.name == "position")


def _check_positions(table: HeadedTable, at: FloatArray) -> None:
    """Note positions that turn back or stay, unless one is not known."""
    way, must = (-1.0, "fall") if at.size and at[-1] < at[0] else (1.0, "increase")
    if at.size < 2:
        problem, remedy = "has one row", "add a last row with the chainage of the line's end"
        table.note(table.line, problem, remedy)
    for row in np.flatnonzero(way * np.diff(at) <= 0.0):
        problem = f"chainage {at[row + 1]:.12g} m follows {at[row]:.12g} m"
        table.note(table.rows[row + 1][0], problem, f"chainage must {must}")


EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

_WEATHER_HEADER = (
    "give a header such as"
    " 'time [UTC];condition;temperature [degC];humidity [%];precipitation [mm/h]'"
)
_CHECK_UNIT = "check its unit in the header"
_AIR = Must("is not plausible: air has -70 to 60 degC", _CHECK_UNIT, 203.15, 333.15)
_DAMP = Must("is not plausible: relative humidity is 0 to 100 %", _CHECK_UNIT, 0.0, 1.05)
_RAIN = Must(
    "is not plausible: it rains 0 to 500 mm/h", _CHECK_UNIT, 0.0, 500.0 * MILLIMETRE_PER_HOUR
)
_WEATHER_WORDS = (Column("time", "UTC"), Column("until", "UTC"), Column("condition"))
_WEATHER_NUMBERS = (
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
    table = read_headed(path, _WEATHER_HEADER)
    known = [each.name for each in (*_WEATHER_WORDS, *_WEATHER_NUMBERS)]
    table.identify(lambda name: name if name in known else None, ["time"])
    if set(table.columns) <= {"time", "until"}:
        table.refuse("needs the column 'time' and one besides")
    times = table.cells("time", _reader_of_times(table, "time"), None, required=True)
    stated = table.cells("until", _reader_of_times(table, "until"), None)
    conditions = table.cells("condition", check_condition, "")
    numbers = [table.quantity(each) for each in _WEATHER_NUMBERS]
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
    write_headed(path, (*_WEATHER_WORDS, *_WEATHER_NUMBERS), zip(*columns, strict=True))


def _reader_of_times(table: HeadedTable, name: str) -> Callable[[str], int]:
    """Reads a time [ns since 1970 UTC] of a column in the zone that its name states."""
    stated = table.units[table.columns[name]] if name in table.columns else None
    try:
        zone = None if stated is None else zone_of(stated)
    except InputError:
        table.refuse(
            f"'{stated}' is not a time zone", "name it as in 'time [UTC]' or 'time [Europe/Zurich]'"
        )

    def read(cell: str) -> int:
        try:
            time = datetime.fromisoformat(cell)
        except ValueError:
            raise InputError(
                f"'{cell}' is not a time", remedy="write it as 2026-10-24T06:00:00Z"
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
        found = (time - EPOCH) // timedelta(microseconds=1) * 1000
        if not ALWAYS[0] < found < ALWAYS[1]:
            raise InputError(
                f"'{cell}' lies too far away", remedy="give a time between 1678 and 2262"
            )
        return found

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


_FORECAST_LENGTHS = Column("from", "km", "m"), Column("to", "km", "m")
_FORECAST_COLUMNS = (
    Column("line"),
    Column("layer"),
    *_FORECAST_LENGTHS,
    *map(Column, ("valid from", "valid to", "issued")),
)
_FORECAST_REQUIRED = ("line", "from", "to", "valid from", "valid to")
_FORECAST_MUST = {
    "quantile": Must(
        "is not plausible", "give an adhesion above 0 to 1, not in per cent", high=1.0, above=True
    ),
    "below": Must("is not plausible", "give a probability from 0 to 1, not in per cent", high=1.0),
}
"""Kinds of columns that have a number in their name, and what their values must be."""

_FORECAST_HEADER = (
    "give a header such as 'line,layer,from [km],to [km],valid from,valid to,"
    "quantile 0.05,quantile 0.5,quantile 0.95', or 'below 0.08' for a probability"
)
_NUMBERED = re.compile(r"(quantile|below)\s+(\d*\.?\d+(?:e[+-]?\d+)?)")


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
    table = read_headed(path, _FORECAST_HEADER)
    numbered: dict[str, dict[float, str]] = {"quantile": {}, "below": {}}

    def name_of(word: str) -> str | None:
        found = _NUMBERED.fullmatch(word)
        if found is None:
            return word if word in [each.name for each in _FORECAST_COLUMNS] else None
        number = float(found[2])
        if not 0.0 < number < 1.0:
            table.refuse(f"column '{word}' must be between 0 and 1")
        return numbered[found[1]].setdefault(number, f"{found[1]} {number!r}")

    table.identify(name_of, _FORECAST_REQUIRED)
    if not any(numbered.values()):
        table.refuse("forecasts neither a quantile nor a probability")
    for each in _FORECAST_LENGTHS:
        if table.unit(table.columns[each.name]) not in ("km", "m"):
            table.refuse(
                f"column '{each.name}' is in neither of km, m",
                "convert the lengths, and name the columns 'from [km]' and 'to [km]'",
            )
    lines = table.cells("line", str, "", required=True)
    layers = table.cells("layer", check_condition, "")
    start, end = (table.quantity(each, required=True) for each in _FORECAST_LENGTHS)

    @cache  # thousands of rows have a few times between them
    def time(cell: str) -> np.datetime64:
        try:
            return utc(cell).to_datetime64()
        except InputError as error:
            raise InputError(error.problem, remedy="write it as 2026-11-22T06:00:00Z") from error

    first, last, issued = (
        np.array(
            table.cells(name, time, np.datetime64("NaT"), name in _FORECAST_REQUIRED),
            dtype="M8[ns]",
        )
        for name in ("valid from", "valid to", "issued")
    )
    issued = np.where(np.isnat(issued), first, issued)
    several = sorted({*lines} - {""})
    if line is None and len(several) > 1:
        words = f"is for {len(several)} lines: {', '.join(several[:3])}"
        table.problems.append((0, InputError(words, remedy="give a file a line")))
    for row, (number, _) in enumerate(table.rows):
        if line is not None and lines[row] not in ("", line):
            words = f"the forecast is for line '{lines[row]}', the trips ran on '{line}'"
            table.note(number, words, "give the forecast for the line of the trips")
        elif end[row] > length:
            reach, km = end[row] / 1e3, length / 1e3
            words = f"the forecast reaches km {reach:.3f}, the line ends at km {km:.3f}"
            table.note(number, words, "count kilometres from the line's beginning")
        if start[row] < 0.0 or start[row] >= end[row] or end[row] < 0.0:
            words = f"a section from km {start[row] / 1e3:g} to km {end[row] / 1e3:g}"
            remedy = "it must end behind its beginning, and begin at km 0 or later"
            table.note(number, words, remedy)
        if first[row] >= last[row]:
            table.note(number, "is valid to a time before its beginning", "correct the times")
        if issued[row] > first[row]:
            remedy = "a forecast is issued before; state as valid only what was left"
            table.note(number, "was issued after it became valid", remedy)
    stated = {
        kind: np.reshape(
            [
                table.quantity(Column(known[each], "1", "1", must=_FORECAST_MUST[kind]), "1")
                for each in sorted(known)
            ],
            (-1, len(table.rows)),
        ).T
        for kind, known in numbered.items()
    }
    found = AdhesionForecast(
        several[0] if several else "",
        start,
        end,
        valid_from=first.view(np.int64),
        valid_to=last.view(np.int64),
        issued=issued.view(np.int64),
        layer=tuple(layers),
        shares=np.array(sorted(numbered["quantile"])),
        quantiles=stated["quantile"],
        thresholds=np.array(sorted(numbered["below"])),
        below=stated["below"],
        place=tuple(f"{Path(path).name}, line {number}" for number, _ in table.rows),
    )
    for row, (number, _) in enumerate(table.rows):
        try:
            found.points(row)
        except InputError as error:
            table.note(number, error.problem, error.remedy)
    table.check()
    return found


def write_forecast(forecast: AdhesionForecast, path: str | Path) -> None:
    """Write a forecast of adhesion, whole or not at all; lengths in km, times in UTC.

    Examples
    --------
    >>> from pathlib import Path
    >>> from trainlog.railway.condition import AdhesionForecast
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
    times = (forecast.valid_from, forecast.valid_to, forecast.issued)
    columns = [
        [forecast.line] * forecast.start.size,
        forecast.layer,
        *([f"{each / 1e3:.3f}" for each in ends] for ends in (forecast.start, forecast.end)),
        *([written_time(each) for each in known.tolist()] for known in times),
        *(
            ["" if np.isnan(each) else f"{each:.6g}" for each in stated]
            for stated in (*forecast.quantiles.T, *forecast.below.T)
        ),
    ]
    numbered = [
        *(Column(f"quantile {share:g}") for share in forecast.shares),
        *(Column(f"below {level:g}") for level in forecast.thresholds),
    ]
    write_headed(path, (*_FORECAST_COLUMNS, *numbered), zip(*columns, strict=True))

"""Columns of a file become fields of our topics and times in UTC, units SI: here, once."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.ingest.motion import SPAN
from trainlog.ingest.profile import WORDS, Column, Profile, TimeOptions
from trainlog.ingest.recording import (
    MOST,
    NO_TIME,
    TIME_CELL,
    Cells,
    Finding,
    Raw,
    Recording,
    Table,
)
from trainlog.topics import SLIP_PROTECTION
from trainlog.units import DAY, NANOSECONDS, to_si


def wanted_columns(profile: Profile, present: tuple[str, ...]) -> list[str]:
    """Names of the file's columns that the profile needs.

    Raises
    ------
    InputError
        If the profile lacks what a table needs: [time] and [columns].
    """
    if profile.time is None or not profile.columns:
        lacking = "[time]" if profile.time is None else "[columns]"
        raise InputError(
            f"profile '{profile.name}' has no {lacking} section",
            remedy="give time and the meaning of the columns; docs/ingest.md has an example",
        )
    names = list(profile.time.names)
    for column in profile.columns.values():
        if not (column.optional and not set(column.names) <= set(present)):
            names += column.names
    return list(dict.fromkeys([*names, *profile.trip.columns.names]))


def undescribed(problem: str, wanted: str = "that says which column is what") -> InputError:
    """The refusal of a file that no profile describes; `wanted`: what the profile has to have."""
    remedy = f"give a profile {wanted}; docs/ingest.md has an example"
    return InputError(problem, remedy=remedy)


def _left(profile: Profile, present: Iterable[str]) -> dict[str, int]:
    """The columns of a file that a profile does not use, as a `Recording` states them."""
    used = profile.sources | set(profile.trip.columns.names)
    left = [name for name in dict.fromkeys(present) if name and name not in used]
    return {f"columns that the profile does not map: {', '.join(left)}": len(left)} if left else {}


def recording_of(
    cells: Cells, profile: Profile, time: IntArray | None = None, columns: Iterable[str] = ()
) -> Recording:
    """The recording that a table of cells holds, as the profile describes it.

    Parameters
    ----------
    cells : Cells
        With the columns that `wanted_columns` names.
    time : (n,) int64 array [ns], optional
        Time of the rows, where the file itself gives it; default: as the profile says.
    columns : iterable of str
        All of the file: those that the profile does not use are stated.

    Raises
    ------
    InputError
        If a column holds no numbers, or no number at all is to be found.
    """
    raw = list(cells.raw)
    if time is None:
        assert profile.time is not None, "wanted_columns checks it"
        time = read_time(cells.table, profile.time, profile.file.decimal)
        raw += _unreadable_times(cells, profile.time.names, time)
    values: dict[str, FloatArray] = {}
    texts: dict[str, NDArray[np.object_]] = {}
    constants: dict[str, float | str] = {}
    findings = list(cells.findings)
    present = set(cells.table.column_names)
    times = set(profile.time.names) if profile.time is not None else set()
    for name, column in profile.columns.items():
        if column.optional and not set(column.names) <= present:
            continue
        if isinstance(column.value, str):
            constants[name] = column.value
        elif column.value is not None:
            constants[name] = float(in_si(name, column, np.asarray(column.value)))
        elif name in WORDS:
            texts[name] = words_in(cells.table[column.names[0]])
        else:
            found, met, garbled = _field(name, column, cells, profile)
            values |= found
            findings += met
            raw += [
                Raw(
                    "not_a_number", target, cells.rows[mask], _text(cells, source, mask), time[mask]
                )
                for target, source, mask in garbled
            ]
    if not texts and not any(np.isfinite(column).any() for column in values.values()):
        raise InputError(
            "none of the mapped columns holds a number",
            place=f"columns {', '.join(sorted(present - times))}",
            remedy="check the columns under [columns] of the profile",
        )
    _name_slip_protection(profile, texts, constants)
    table = Table(time, cells.rows, values, texts)
    names = profile.trip.columns.names
    about = {name: words_in(cells.table[name]) for name in names if name in present}
    left = _left(profile, columns)
    return Recording(
        (table,), cells.rows_read, tuple(findings), constants, {}, left, raw=tuple(raw), about=about
    )


def _name_slip_protection(
    profile: Profile, texts: dict[str, NDArray[np.object_]], constants: dict[str, float | str]
) -> None:
    """Name the events that report slip protection, in place."""
    messages = texts.get("/events.message")
    if messages is None or not profile.columns["/events.message"].slip_protection:
        return
    words = "|".join(map(re.escape, profile.columns["/events.message"].slip_protection))
    known = str(constants.pop("/events.name", ""))
    names = texts.get("/events.name", np.full(messages.size, known, dtype=np.object_))
    acts = pd.Series(messages, dtype="str").str.contains(words, case=False).to_numpy()
    texts["/events.name"] = np.where(acts, SLIP_PROTECTION, names)


def _unreadable_times(cells: Cells, names: tuple[str, ...], time: IntArray) -> list[Raw]:
    """What stood where a time should."""
    lost = time == NO_TIME
    if not lost.any():
        return []
    columns = [_text(cells, name, lost) for name in names]
    words = np.array([" ".join(parts) for parts in zip(*columns, strict=True)], dtype=np.object_)
    return [Raw("time_unreadable", TIME_CELL, cells.rows[lost], words)]


def _text(cells: Cells, column: str, rows: BoolArray) -> NDArray[np.object_]:
    """The text of some cells of a column; empty where there is none."""
    picked = pc.fill_null(pc.cast(cells.table[column].filter(pa.array(rows)), pa.string()), "")
    return np.asarray(picked.to_pylist(), dtype=np.object_)


def _field(
    name: str, column: Column, cells: Cells, profile: Profile
) -> tuple[dict[str, FloatArray], list[Finding], list[tuple[str, str, BoolArray]]]:
    """The values of one field, one entry an axle where it has several, and what was met.

    Also which cells of which column of ours and of the file are no numbers.
    """
    texts: list[tuple[str, str, BoolArray]] = []
    values: dict[str, FloatArray] = {}
    empty = np.zeros(0, dtype=np.int64)
    unreadable = empty
    for axle, source in enumerate(column.sources, start=1):
        if not source:
            values[f"{name}_{axle}"] = np.full(len(cells.table), np.nan)
            continue
        cell = cells.table[source]
        raw, absent, garbled = numbers(cell, profile.file.decimal, profile.file.thousands)
        _refuse_garbled(source, cells, raw, garbled, profile)
        target = f"{name}_{axle}" if column.columns else name
        scaled = column
        if column.integer_scale is not None and _whole(cell, profile.file.decimal):
            scaled = replace(column, scale=column.integer_scale)
        values[target] = in_si(name, scaled, raw)
        empty = np.append(empty, cells.rows[absent])
        unreadable = np.append(unreadable, cells.rows[garbled])
        if garbled.any():
            texts.append((target, source, garbled))
    findings = [*Finding.met("empty", empty, name), *Finding.met("not_a_number", unreadable, name)]
    return values, findings, texts


def _refuse_garbled(
    source: str, cells: Cells, raw: FloatArray, garbled: BoolArray, profile: Profile
) -> None:
    count, readable = np.count_nonzero(garbled), np.count_nonzero(np.isfinite(raw))
    if count <= MOST * (count + readable):
        return
    at = int(np.argmax(garbled))
    cell = str(cells.table[source][at].as_py())
    shown = cell if len(cell) <= 30 else cell[:27] + "..."
    decimal = profile.file.decimal
    marks = [mark for mark in THOUSANDS if re.match(grouped(decimal, mark), cell)]
    one_comma = decimal == "." and cell.count(",") == 1 and "." not in cell
    remedies = ['decimal = ","'] if one_comma else []
    remedies += [f'thousands = "{marks[0]}"'] if marks and marks[0] != decimal else []
    raise InputError(
        f"{count} cells are not numbers, the first is {shown!r}",
        place=f"row {cells.rows[at]}, column {source}",
        remedy=(
            f"set {' or '.join(remedies)} under [file] of the profile"
            if remedies
            else f"check which column it is, and delimiter {profile.file.delimiter!r}"
        ),
    )


def _whole(column: pa.ChunkedArray, decimal: str) -> bool:
    """Whether a column holds whole numbers only."""
    if is_text(column):
        return not pc.any(pc.match_substring(column, decimal)).as_py()
    return bool(pa.types.is_integer(column.type))


THOUSANDS = (",", ".", "'", "’", " ", "\u00a0", "\u202f")
"""Marks between thousands."""


def grouped(decimal: str, thousands: str) -> str:
    """The pattern of numbers whose thousands are parted by a mark."""
    return rf"^\s*[+-]?\d{{1,3}}([{thousands}]\d{{3}})+([{decimal}]\d*)?\s*$"


def numbers(
    column: pa.ChunkedArray, decimal: str, thousands: str = ""
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """A column as numbers.

    Returns
    -------
    values : (n,) array
        NaN where there is none.
    empty : (n,) bool array
        Cells without a value.
    garbled : (n,) bool array
        Cells with a value that is no finite number.
    """
    if pa.types.is_dictionary(column.type):
        column = pc.cast(column, column.type.value_type)
    text = is_text(column)
    if text and thousands:
        parted = pc.match_substring_regex(column, grouped(decimal, thousands))
        column = pc.if_else(parted, pc.replace_substring(column, thousands, ""), column)
    if text and decimal == ",":
        column = pc.replace_substring(column, ",", ".")
    try:
        cast = pc.cast(column, pa.float64())
        blank = np.zeros(len(column), dtype=np.bool_)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        # Text among the numbers: slower, cell by cell.
        words = pc.utf8_trim_whitespace(pc.cast(column, pa.string()))
        blank = pc.fill_null(pc.equal(words, ""), False).to_numpy()
        cast = pa.chunked_array([pd.to_numeric(words.to_pandas(), errors="coerce")])
    values = np.array(pc.fill_null(pc.cast(cast, pa.float64()), np.nan).to_numpy())
    empty = pc.is_null(column).to_numpy() | blank
    if pa.types.is_floating(column.type):
        empty |= np.isnan(values)
    garbled = ~np.isfinite(values) & ~empty
    values[garbled] = np.nan
    return values, empty, garbled


def is_text(column: pa.ChunkedArray) -> bool:
    """Whether a column holds texts."""
    return bool(pa.types.is_string(column.type) or pa.types.is_large_string(column.type))


def words_in(column: pa.ChunkedArray) -> NDArray[np.object_]:
    """The text of each cell without blanks around it; empty where there is none."""
    text = pc.fill_null(pc.cast(column, pa.string()), "")
    return np.asarray(pc.utf8_trim_whitespace(text).to_pylist(), dtype=np.object_)


def degrees_of(values: FloatArray) -> FloatArray:
    """Degrees of numbers such as 4728.513 (NMEA): 47 degrees and 28.513 minutes.

    Examples
    --------
    >>> degrees_of(np.array([4730.0, -915.0])).tolist()
    [47.5, -9.25]
    """
    size = np.abs(values)
    degrees = np.floor(size / 100.0)
    return np.asarray(np.sign(values) * (degrees + (size - 100.0 * degrees) / 60.0))


def in_si(name: str, column: Column, raw: FloatArray | FloatArray) -> FloatArray:
    """``sign * part(raw * scale + offset)`` in the column's unit, converted to SI."""
    scaled = degrees_of(raw) if column.notation == "degrees_minutes" else raw
    if column.scale != 1.0:
        # 1e-7 as a factor is not exact; dividing by 1e7 is.
        inverse = round(1.0 / column.scale) if 0.0 < abs(column.scale) < 1.0 else 0
        exact = inverse and abs(inverse * column.scale - 1.0) < 1e-12
        scaled = scaled / inverse if exact else scaled * column.scale
    if column.offset:
        scaled = scaled + column.offset
    if column.part == "positive":
        scaled = np.where(scaled > 0.0, scaled, np.where(np.isnan(scaled), np.nan, 0.0))
    elif column.part == "negative":
        scaled = np.where(scaled < 0.0, -scaled, np.where(np.isnan(scaled), np.nan, 0.0))
    if column.sign < 0:
        scaled = 0.0 - scaled
    item = column.field(name)
    unit = column.unit if column.unit is not None else item.unit
    return to_si(scaled, unit, item.unit) if item.unit else np.asarray(scaled, dtype=np.float64)


EARLIEST = pd.Timestamp("1980-01-06", tz="UTC").value
"""GPS time begins; an earlier instant [ns] is a clock that was never set."""

LATEST = pd.Timestamp("2100-01-01", tz="UTC").value

NANOSECONDS_PER = {"s": NANOSECONDS, "ms": 1_000_000, "us": 1_000, "ns": 1}

ZONE = r"(?:[Zz]|[+-]\d\d(?::?\d\d)?)"
"""How a time states its zone."""

_WITH_ZONE = rf"\d[Zz]$|:\d\d.*{ZONE}$"


def states_zone(time: str) -> bool:
    """Whether a time of any format states its zone.

    Examples
    --------
    >>> [states_zone(each) for each in ("06:00:00+02", "20240501T060000Z", "2024-05-01 06:00")]
    [True, True, False]
    """
    return re.search(_WITH_ZONE, time) is not None


UNDATED_PARTS = (1980, 1, 6)
"""Year, month and day that stand in for a date of zeros: the begin of GPS time."""

_NO_DATE = r"^\s*\d{4}-00-00"


def read_time(table: pa.Table, options: TimeOptions, decimal: str) -> IntArray:
    """Time of each row [ns] UTC, `NO_TIME` where it cannot be read or is not plausible.

    Parameters
    ----------
    table : pyarrow.Table
        Holds the columns that `options` names.
    decimal : str
        Decimal sign of the numbers in `table`.

    Raises
    ------
    InputError
        If a local time does not exist, or comes twice and no single step back shows which it is;
        if no time at all is plausible.
    """
    columns = [table[name] for name in options.names]
    undated = np.zeros(table.num_rows, dtype=np.bool_)
    if options.format == "parts":
        parts = [numbers(column, decimal)[0] for column in columns]
        undated = (parts[1] == 0.0) | (parts[2] == 0.0)
        for values, stand_in in zip(parts[:3], UNDATED_PARTS, strict=True):
            values[undated] = stand_in
        time = _localised(from_parts(parts), options.timezone)
    elif options.format in ("epoch", "elapsed"):
        time = _from_count(columns[0], options, decimal)
        if options.fraction is not None:
            beyond = numbers(columns[1], decimal)[0] * options.fraction
            known = (time != NO_TIME) & (beyond >= 0.0) & (beyond < 1.0)
            rest = np.round(np.where(known, beyond, 0.0) * NANOSECONDS).astype(np.int64)
            time = np.where(known, time + rest, NO_TIME)
    elif pa.types.is_timestamp(columns[0].type):
        zone = columns[0].type.tz
        time = pc.cast(pc.cast(columns[0], pa.timestamp("ns", zone)), pa.int64())
        time = pc.fill_null(time, NO_TIME).to_numpy()
        time = time if zone else _localised(time, options.timezone)
    else:
        if options.format == "iso" and len(columns) == 1 and is_text(columns[0]):
            undated = pc.fill_null(pc.match_substring_regex(columns[0], _NO_DATE), False).to_numpy()
            columns = [pc.replace_substring_regex(columns[0], _NO_DATE, "1980-01-06")]
        time = _from_text(columns, options, decimal)
    time = _with_time_of_day(time, undated)
    plausible = (time >= EARLIEST) & (time < LATEST)
    if not plausible.any() and np.any(time != NO_TIME):
        first = int(np.argmax(time != NO_TIME))
        raise InputError(
            f"the first time reads as {pd.Timestamp(time[first])}",
            place=f"column {options.names[0]}",
            remedy="check format, unit and start under [time] of the profile",
        )
    return np.where(plausible, time, NO_TIME)


def _with_time_of_day(time: IntArray, undated: BoolArray) -> IntArray:
    """Times of which those without a date are kept where their time of day leads to dated rows.

    They stand on the day that `UNDATED_PARTS` gives; the rule "clock_step" puts them on theirs.
    """
    if not undated.any():
        return time
    known = np.flatnonzero(time != NO_TIME)
    apart = np.abs(np.diff(time[known] % DAY))
    group = np.cumsum(np.concatenate(([0], np.minimum(apart, DAY - apart) > SPAN * NANOSECONDS)))
    dated = np.isin(group, group[~undated[known]])
    kept = time.copy()
    kept[known[~dated]] = NO_TIME
    return kept


def from_parts(parts: list[FloatArray]) -> IntArray:
    """Time from year, month, day, hour, minute, second; `NO_TIME` where there is no such day.

    Examples
    --------
    >>> parts = [np.array([float(part)]) for part in (2024, 5, 1, 8, 30, 15.5)]
    >>> pd.Timestamp(from_parts(parts)[0]).isoformat()
    '2024-05-01T08:30:15.500000'
    """
    bounds = ((1980, 2099), (1, 12), (1, 31), (0, 23), (0, 59), (0, 60.999999999))
    valid = np.ones(parts[0].size, dtype=np.bool_)
    for values, (low, high) in zip(parts, bounds, strict=True):
        valid &= (values >= low) & (values <= high)
    whole = [np.where(valid, values, low) for values, (low, _) in zip(parts, bounds, strict=True)]
    year, month, day, hour, minute = (values.astype(np.int64) for values in whole[:5])
    months = (year - 1970) * 12 + month - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]") + (day - 1)
    valid &= days.astype("datetime64[M]").astype(np.int64) == months
    seconds = np.round(whole[5] * NANOSECONDS).astype(np.int64)
    time = days.astype(np.int64) * DAY + (hour * 60 + minute) * 60_000_000_000 + seconds
    return np.where(valid, time, NO_TIME)


def _from_count(column: pa.ChunkedArray, options: TimeOptions, decimal: str) -> IntArray:
    """Time from a count of seconds or their fractions."""
    start = 0
    if isinstance(options.start, datetime.datetime):
        origin = pd.Timestamp(options.start)
        start = origin.value
        if origin.tzinfo is None:
            start = int(_localised(np.array([start]), options.timezone)[0])
    elapsed = elapsed_time(column, options, decimal)
    return np.where(elapsed != NO_TIME, start + elapsed, NO_TIME)


def elapsed_time(column: pa.ChunkedArray, options: TimeOptions, decimal: str) -> IntArray:
    """Time that a column counts [ns]: a number of units, or hours, minutes and seconds as text."""
    if is_text(column) and pc.any(pc.match_substring(column, ":")).as_py():
        return _hours_minutes_seconds(column, decimal)
    factor = NANOSECONDS_PER[options.unit]
    with suppress(pa.ArrowInvalid, pa.ArrowNotImplementedError):  # of whole numbers
        whole = pc.cast(column, pa.int64())
        values = pc.fill_null(whole, 0).to_numpy()
        sane = pc.is_valid(whole).to_numpy() & (np.abs(values) < LATEST // factor)
        return np.where(sane, np.where(sane, values, 0) * factor, NO_TIME)
    count = numbers(column, decimal)[0]
    sane = np.abs(count) < LATEST / factor  # False for NaN
    # A double holds today's seconds to a quarter of a microsecond: finer digits are noise.
    microseconds = np.round(np.where(sane, count, 0.0) * (factor / 1e3)).astype(np.int64)
    return np.where(sane, microseconds * 1_000, NO_TIME)


def _hours_minutes_seconds(text: pa.ChunkedArray, decimal: str) -> IntArray:
    """Time [ns] of ``H:MM:SS`` with up to nine decimals; `NO_TIME` where it is something else."""
    pattern = rf"^\s*(?P<h>\d{{1,5}}):(?P<m>\d\d):(?P<s>\d\d)(?:[{decimal}](?P<f>\d{{1,9}}))?\s*$"
    parts = pc.extract_regex(text, pattern)
    known = pc.is_valid(parts).to_numpy()
    hours, minutes, seconds, fraction = (pc.struct_field(parts, name) for name in "hmsf")
    fraction = pc.utf8_rpad(fraction, 9, "0")
    counts = [
        pc.fill_null(pc.cast(part, pa.int64()), 0).to_numpy()
        for part in (hours, minutes, seconds, fraction)
    ]
    whole = (counts[0] * 60 + counts[1]) * 60 + counts[2]
    return np.where(known, whole * NANOSECONDS_PER["s"] + counts[3], NO_TIME)


def _from_text(columns: list[pa.ChunkedArray], options: TimeOptions, decimal: str) -> IntArray:
    """Time from text, ISO 8601 or after a pattern."""
    texts = [column if is_text(column) else pc.cast(column, pa.string()) for column in columns]
    joined = [pc.utf8_trim_whitespace(text) for text in texts]
    text = joined[0] if len(joined) == 1 else pc.binary_join_element_wise(*joined, " ")
    if options.format == "iso":
        return _from_iso(text, options.timezone, decimal)
    series = text.to_pandas()
    if "%z" in options.format:
        return _nanoseconds(
            pd.to_datetime(series, format=options.format, utc=True, errors="coerce")
        )
    naive = _nanoseconds(pd.to_datetime(series, format=options.format, errors="coerce"))
    if options.date is not None:
        naive = _dated(naive, options.date)
    return _localised(naive, options.timezone)


def _from_iso(text: pa.ChunkedArray, timezone: str, decimal: str) -> IntArray:
    if decimal == ",":
        text = pc.replace_substring(text, ",", ".")
    text = pc.replace_substring_regex(text, "z$", "Z")
    series = text.to_pandas()
    aware = pc.fill_null(pc.match_substring_regex(text, _WITH_ZONE), False).to_numpy()
    if aware.all():
        return _nanoseconds(pd.to_datetime(series, format="ISO8601", utc=True, errors="coerce"))
    naive = pd.to_datetime(series.where(~aware), format="ISO8601", errors="coerce")
    time = _localised(_nanoseconds(naive), timezone)
    if aware.any():
        marked = pd.to_datetime(series.where(aware), format="ISO8601", utc=True, errors="coerce")
        time = np.where(aware, _nanoseconds(marked), time)
    return time


def _nanoseconds(series: pd.Series[Any]) -> IntArray:
    # Years outside 1700 to 2200 do not fit into nanoseconds; NaT stands for them too.
    seconds = pd.DatetimeIndex(series).as_unit("s").asi8
    fits = (seconds > -(2**33)) & (seconds < 2**33)
    whole = pd.DatetimeIndex(series.where(fits)).as_unit("ns")
    return np.asarray(whole.asi8)


def _dated(time: IntArray, first: datetime.date) -> IntArray:
    """Times of day, put on the date of the first row; a leap back of half a day is midnight."""
    known = time != NO_TIME
    of_day = time[known] % DAY
    days = np.cumsum(np.diff(of_day, prepend=of_day[:1]) < -DAY // 2)
    dated = time.copy()
    dated[known] = pd.Timestamp(first).value + of_day + days * DAY
    return dated


def _localised(time: IntArray, timezone: str) -> IntArray:
    """UTC [ns] of local times [ns]."""
    if timezone == "UTC":
        return time
    known = time != NO_TIME
    local = pd.DatetimeIndex(np.where(known, time, 0))
    aware = local.tz_localize(timezone, ambiguous="NaT", nonexistent="NaT")
    lost = np.asarray(aware.isna()) & known
    # A single step back at a time that comes twice shows when the clocks change.
    rows = np.flatnonzero(known)
    back = rows[1:][(np.diff(time[rows]) < -DAY // 48) & (lost[rows[1:]] | lost[rows[:-1]])]
    if back.size == 1:
        summer = np.arange(time.size) < back[0]
        aware = local.tz_localize(timezone, ambiguous=summer, nonexistent="NaT")
        lost = np.asarray(aware.isna()) & known
    if lost.any():
        raise InputError(
            f"local time {local[int(np.argmax(lost))]} comes twice or never in {timezone}"
            " (the clocks change)",
            remedy='give the offset that the recorder kept, for example timezone = "+01:00"',
        )
    return np.where(known, aware.asi8, NO_TIME)

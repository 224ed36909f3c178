"""Time as recorders write it, turned into nanoseconds UTC."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from trainlog.errors import InputError
from trainlog.ingest.profile import TimeOptions
from trainlog.ingest.recording import NO_TIME, FloatArray, IntArray

EARLIEST = pd.Timestamp("1980-01-06", tz="UTC").value
"""GPS time begins; an earlier instant [ns] is a clock that was never set."""

LATEST = pd.Timestamp("2100-01-01", tz="UTC").value

NANOSECONDS_PER = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}

DAY = 86_400 * 1_000_000_000

_WITH_OFFSET = r":\d\d.*(Z|z|[+-]\d\d(:?\d\d)?)$"


def read_time(table: pa.Table, options: TimeOptions, decimal: str, file: Path) -> IntArray:
    """Time of each row [ns] UTC, `NO_TIME` where it cannot be read or is not plausible.

    Parameters
    ----------
    table : pyarrow.Table
        Holds the columns that `options` names.
    decimal : str
        Decimal sign of the numbers in `table`.
    file : Path
        For messages.

    Raises
    ------
    InputError
        If a local time does not exist or comes twice, or no time at all is plausible.
    """
    columns = [table[name] for name in options.names]
    if options.format == "parts":
        time = from_parts([_number(column, decimal) for column in columns])
        time = _localised(time, options.timezone, file)
    elif options.format in ("epoch", "elapsed"):
        time = _from_count(columns[0], options, decimal, file)
    elif pa.types.is_timestamp(columns[0].type):
        time = _from_typed(columns[0], options.timezone, file)
    else:
        time = _from_text(columns, options, decimal, file)
    plausible = (time >= EARLIEST) & (time < LATEST)
    if not plausible.any() and np.any(time != NO_TIME):
        first = int(np.argmax(time != NO_TIME))
        raise InputError(
            f"the first time reads as {pd.Timestamp(time[first])}",
            file=file,
            place=f"column {options.names[0]}",
            remedy="check format, unit and start under [time] of the profile",
        )
    return np.where(plausible, time, NO_TIME)


def _number(column: pa.ChunkedArray, decimal: str) -> FloatArray:
    from trainlog.ingest.mapping import numbers

    return numbers(column, decimal)[0]


def from_parts(parts: list[FloatArray]) -> IntArray:
    """Time from year, month, day, hour, minute, second; `NO_TIME` where there is no such day."""
    bounds = ((1980, 2099), (1, 12), (1, 31), (0, 23), (0, 59), (0, 60.999999999))
    valid = np.ones(parts[0].size, dtype=np.bool_)
    for values, (low, high) in zip(parts, bounds, strict=True):
        valid &= (values >= low) & (values <= high)
    whole = [np.where(valid, values, low) for values, (low, _) in zip(parts, bounds, strict=True)]
    year, month, day, hour, minute = (values.astype(np.int64) for values in whole[:5])
    months = (year - 1970) * 12 + month - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]") + (day - 1)
    valid &= days.astype("datetime64[M]").astype(np.int64) == months
    seconds = np.round(whole[5] * 1e9).astype(np.int64)
    time = days.astype(np.int64) * DAY + (hour * 60 + minute) * 60_000_000_000 + seconds
    return np.where(valid, time, NO_TIME)


def _from_count(
    column: pa.ChunkedArray, options: TimeOptions, decimal: str, file: Path
) -> IntArray:
    """Time from a count of seconds or their fractions."""
    if options.start is not None:
        origin = pd.Timestamp(options.start)
        if origin.tzinfo is None:
            start = int(_localised(np.array([origin.value]), options.timezone, file)[0])
        else:
            start = origin.value
    else:
        start = 0
    factor = NANOSECONDS_PER[options.unit]
    whole = _whole_numbers(column)
    if whole is not None:
        values, present = whole
        sane = present & (np.abs(values) < LATEST // factor)
        return np.where(sane, start + np.where(sane, values, 0) * factor, NO_TIME)
    numbers = _number(column, decimal)
    sane = np.abs(numbers) < LATEST / factor  # False for NaN
    # A double holds today's seconds to a quarter of a microsecond: finer digits are noise.
    microseconds = np.round(np.where(sane, numbers, 0.0) * (factor / 1e3)).astype(np.int64)
    return np.where(sane, start + microseconds * 1_000, NO_TIME)


def _whole_numbers(column: pa.ChunkedArray) -> tuple[IntArray, Any] | None:
    """The column as integers, and which are present; None if it is not made of integers."""
    try:
        integers = pc.cast(column, pa.int64())
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        return None
    return pc.fill_null(integers, 0).to_numpy(), pc.is_valid(integers).to_numpy()


def _from_typed(column: pa.ChunkedArray, timezone: str, file: Path) -> IntArray:
    """Time from a column that the file itself types as a time stamp."""
    time = pc.cast(pc.cast(column, pa.timestamp("ns", column.type.tz)), pa.int64())
    nanoseconds = pc.fill_null(time, NO_TIME).to_numpy()
    return nanoseconds if column.type.tz else _localised(nanoseconds, timezone, file)


def _from_text(
    columns: list[pa.ChunkedArray], options: TimeOptions, decimal: str, file: Path
) -> IntArray:
    """Time from text, ISO 8601 or after a pattern."""
    texts = [column if _is_text(column) else pc.cast(column, pa.string()) for column in columns]
    joined = [pc.utf8_trim_whitespace(text) for text in texts]
    text = joined[0] if len(joined) == 1 else pc.binary_join_element_wise(*joined, " ")
    if options.format == "iso":
        return _from_iso(text, options.timezone, decimal, file)
    series = text.to_pandas()
    if "%z" in options.format:
        return _nanoseconds(
            pd.to_datetime(series, format=options.format, utc=True, errors="coerce")
        )
    naive = _nanoseconds(pd.to_datetime(series, format=options.format, errors="coerce"))
    if options.date is not None:
        naive = _dated(naive, options.date)
    return _localised(naive, options.timezone, file)


def _is_text(column: pa.ChunkedArray) -> bool:
    return bool(pa.types.is_string(column.type) or pa.types.is_large_string(column.type))


def _from_iso(text: pa.ChunkedArray, timezone: str, decimal: str, file: Path) -> IntArray:
    if decimal == ",":
        text = pc.replace_substring(text, ",", ".")
    series = text.to_pandas()
    aware = pc.fill_null(pc.match_substring_regex(text, _WITH_OFFSET), False).to_numpy()
    if aware.all():
        return _nanoseconds(pd.to_datetime(series, format="ISO8601", utc=True, errors="coerce"))
    naive = pd.to_datetime(series.where(~aware), format="ISO8601", errors="coerce")
    time = _localised(_nanoseconds(naive), timezone, file)
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


def _localised(time: IntArray, timezone: str, file: Path) -> IntArray:
    """UTC [ns] of local times [ns]."""
    if timezone == "UTC":
        return time
    known = time != NO_TIME
    local = pd.DatetimeIndex(np.where(known, time, 0))
    aware = local.tz_localize(timezone, ambiguous="NaT", nonexistent="NaT")
    lost = np.asarray(aware.isna()) & known
    if lost.any():
        raise InputError(
            f"local time {local[int(np.argmax(lost))]} comes twice or never in {timezone}"
            " (the clocks change)",
            file=file,
            remedy='give the offset that the recorder kept, for example timezone = "+01:00"',
        )
    return np.where(known, aware.asi8, NO_TIME)

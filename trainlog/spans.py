"""Spans of time: which samples of a trip lie between two times, or between two positions."""

from __future__ import annotations

import re
from datetime import tzinfo
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from trainlog.arrays import BoolArray, IntArray, numbered
from trainlog.errors import InputError, did_you_mean

Spans = IntArray
"""Spans of time, (k, 2): first and last instant of each [ns since 1970 UTC], both belonging to it;
in order, apart from each other."""

ALWAYS = (int(np.iinfo(np.int64).min), int(np.iinfo(np.int64).max))
"""The limits of a time that is open at both ends."""


def runs_of(flags: BoolArray) -> list[tuple[int, int]]:
    """First and one-past-last index of each run of True.

    Examples
    --------
    >>> runs_of(np.array([False, True, True, False, True]))
    [(1, 3), (4, 5)]
    """
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


_ISO = re.compile(
    r"\d{4}(-?)\d{2}\1\d{2}([T ]\d{2}(:?\d{2}(:?\d{2}([.,]\d+)?)?)?\s?(Z|[-+]\d{2}(:?\d{2})?)?)?",
    re.IGNORECASE,
)
"""What a time is written as, after ISO 8601: the day, the time of day, and its zone."""


def stamp_of(time: Any) -> pd.Timestamp:
    """A time as a stamp, in its own zone if it states one; a text is read by ISO 8601 alone.

    Of 04.10.2026 or 10/05/2026 nothing says which number is the day: they are refused.

    Raises
    ------
    InputError
        If it is no time.

    Examples
    --------
    >>> stamp_of("2026-10-04").day
    4
    >>> stamp_of("04.10.2026")
    Traceback (most recent call last):
    trainlog.errors.InputError: '04.10.2026' is not a time; write it as 2026-10-01 ...
    """
    try:
        if isinstance(time, str):
            text = time.strip()
            if _ISO.fullmatch(text) is None:
                raise ValueError("not of ISO 8601")
            stamp = pd.to_datetime(text, format="ISO8601")
        else:
            stamp = pd.Timestamp(time)
        if pd.isna(stamp):
            raise ValueError("no time")
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"'{time}' is not a time", remedy="write it as 2026-10-01 or 2026-10-01T06:30Z"
        ) from error
    return stamp


_OFFSET = re.compile(r"[-+]\d\d:?[0-5]\d(:?00)?")


def zone_of(name: str) -> tzinfo:
    """The time zone of a name, or of an offset as ``+02:00``.

    Raises
    ------
    InputError
        If it is not known; names the zones that are written nearly so.

    Examples
    --------
    >>> zone_of("+02:00")
    datetime.timezone(datetime.timedelta(seconds=7200))
    >>> zone_of("Europe/Zuerich")
    Traceback (most recent call last):
    trainlog.errors.InputError: 'Europe/Zuerich' is not a time zone; did you mean 'Europe/Zurich...
    """
    try:
        offset = str(name).removeprefix("UTC")
        if offset[:1] in ("+", "-") and _OFFSET.fullmatch(offset) is None:
            raise ValueError("not an offset in minutes")
        found = pd.Timestamp(0, tz=name).tzinfo
    except (LookupError, ValueError, TypeError, OSError) as error:
        from zoneinfo import available_timezones

        remedy = did_you_mean(
            name, sorted(available_timezones()), "name it as Europe/Zurich or +02:00"
        )
        raise InputError(f"'{name}' is not a time zone", remedy=remedy) from error
    assert found is not None
    return found


def utc(time: Any) -> pd.Timestamp:
    """A time in UTC, to the nanosecond; one without a time zone is UTC already.

    Raises
    ------
    InputError
        If it is no time, see `stamp_of`.

    Examples
    --------
    >>> utc("2024-05-01 08:00+02:00").isoformat()
    '2024-05-01T06:00:00+00:00'
    """
    stamp = stamp_of(time)
    try:
        aware = stamp.tz_localize("UTC") if stamp.tzinfo is None else stamp.tz_convert("UTC")
        return aware.as_unit("ns")
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"'{time}' is not a time that time stamps reach", remedy="give one from 1678 to 2261"
        ) from error


_DAY = re.compile(r"\d{4}-\d{2}-\d{2}|\d{8}")


def times_of(text: Any, zone: str | None = None) -> tuple[int, int]:
    """The first and last nanosecond that a time stands for: of a day all of it.

    Parameters
    ----------
    text : str, or anything that `pandas.Timestamp` takes
        A text as 2026-10-01 or 2026-10-01T06:30Z, see `stamp_of`.
    zone : str, optional
        Of a time that states none; default UTC.

    Raises
    ------
    InputError
        If it is no time, the zone is unknown, or the time is skipped or comes twice there.

    Examples
    --------
    >>> first, last = times_of("2026-10-01")
    >>> (last - first + 1) / 3600e9
    24.0
    >>> times_of("2026-10-25", "Europe/Zurich")[0] == times_of("2026-10-24T22:00Z")[0]
    True
    """
    day = isinstance(text, str) and _DAY.fullmatch(text.strip()) is not None
    if zone is not None:
        zone_of(zone)
    stamp = stamp_of(text)
    try:
        ends = [stamp, stamp + pd.Timedelta(days=1)] if day else [stamp]
        if stamp.tzinfo is None and zone is not None:
            ends = [each.tz_localize(zone) for each in ends]
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(
            f"'{text}' is not one time in the zone '{zone}'" if zone else f"'{text}' is not a time",
            remedy="write it as 2026-10-01T06:30Z, or with another offset",
        ) from error
    first, *following = (int(utc(each).value) for each in ends)
    return first, following[0] - 1 if following else first


def time_limits(start: Any = None, end: Any = None) -> tuple[int, int]:
    """First and last instant of a span of time [ns since 1970 UTC]; see `Trip.between`.

    Raises
    ------
    InputError
        If an end is no time, or the start is after the end.

    Examples
    --------
    >>> time_limits("1970-01-01T00:00:01", "1970-01-01T00:00:02")
    (1000000000, 2000000000)
    """
    first = ALWAYS[0] if start is None else utc(start).value
    last = ALWAYS[1] if end is None else utc(end).value
    if first > last:
        raise InputError(
            f"the time {utc(start).isoformat()} is after {utc(end).isoformat()}",
            remedy="give the earlier time first",
        )
    return first, last


def position_limits(start: float | None = None, end: float | None = None) -> tuple[float, float]:
    """Lowest and highest position of a slice [m]; see `Trip.within`.

    Raises
    ------
    InputError
        If an end is not a number, or the start is behind the end.

    Examples
    --------
    >>> position_limits(100, None)
    (100.0, inf)
    """
    try:
        first = -np.inf if start is None else float(start)
        last = np.inf if end is None else float(end)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"there is no stretch from {start!r} to {end!r}", remedy="give positions in metres"
        ) from error
    if not first <= last:
        raise InputError(
            f"there is no stretch from km {first / 1e3:.3f} to km {last / 1e3:.3f}",
            remedy="give the lower chainage first",
        )
    return first, last


def spans_within(time: ArrayLike, position: ArrayLike, start: float, end: float) -> Spans:
    """When a position was within limits, on a line between neighbouring samples.

    Parameters
    ----------
    time : (n,) int array [ns since 1970 UTC]
        Not decreasing.
    position : (n,) array [m]
        Samples whose position is not finite are passed over.
    start, end : float [m]
        Limits, both belonging to it; may be infinite.

    Returns
    -------
    (k, 2) int array
        First and last instant [ns] of each span; none begins before the first known sample or
        ends after the last.

    Examples
    --------
    >>> spans_within([0, 1000, 2000], [0.0, 10.0, 20.0], 5.0, 15.0).tolist()
    [[500, 1500]]
    """
    place = np.asarray(position, dtype=np.float64)
    known = np.isfinite(place)
    t, s = np.asarray(time, dtype=np.int64)[known], place[known]
    if t.size == 0:
        return np.empty((0, 2), dtype=np.int64)
    inside = (s >= start) & (s <= end)
    instants = np.column_stack((t, t))[inside]
    # Only a step with an end inside, or one that passes right through, has a span.
    side = (s > end).astype(np.int8) - (s < start).astype(np.int8)
    step = np.flatnonzero((np.diff(t) > 0) & (inside[1:] | inside[:-1] | (np.diff(side) != 0)))
    limits = np.clip([start, end], s.min() - 1.0, s.max() + 1.0)
    length = (t[step + 1] - t[step]).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        crossed = (limits - s[step, None]) / (s[step + 1] - s[step])[:, None] * length[:, None]
    first, last = np.nan_to_num(np.sort(crossed, axis=1)).T
    # A sample outside is never in a span, however near to the limit it lies.
    entered = t[step] + np.clip(np.ceil(first), 1.0, length).astype(np.int64)
    left = t[step] + np.clip(np.floor(last), 0.0, length - 1.0).astype(np.int64)
    spans = np.column_stack(
        (np.where(inside[step], t[step], entered), np.where(inside[step + 1], t[step + 1], left))
    )
    return merged_spans(np.concatenate((instants, spans[spans[:, 0] <= spans[:, 1]])))


def merged_spans(spans: Spans) -> Spans:
    """Spans of time in order; those that touch or overlap become one.

    Examples
    --------
    >>> merged_spans(np.array([[5, 9], [0, 3], [4, 6]])).tolist()
    [[0, 9]]
    """
    if len(spans) == 0:
        return spans
    ordered = spans[np.argsort(spans[:, 0], kind="stable")]
    reached = np.maximum.accumulate(ordered[:, 1])
    first = np.concatenate(([True], ordered[1:, 0] > reached[:-1] + 1))
    last = np.append(first[1:], True)
    return np.column_stack((ordered[first, 0], reached[last]))


def overlapping(spans: Spans, others: Spans) -> Spans:
    """The times that are in a span of both, (k, 2).

    Examples
    --------
    >>> overlapping(np.array([[0, 5], [8, 9]]), np.array([[4, 8]])).tolist()
    [[4, 5], [8, 8]]
    """
    if len(spans) == 0 or len(others) == 0:
        return np.empty((0, 2), dtype=np.int64)
    first = np.searchsorted(others[:, 1], spans[:, 0], side="left")
    beyond = np.searchsorted(others[:, 0], spans[:, 1], side="right")
    # Each span meets a run of the others, of which it cuts the first and the last.
    count = np.maximum(beyond - first, 0)
    mine, number = numbered(count)
    theirs = number + first[mine]
    begin = np.maximum(spans[mine, 0], others[theirs, 0])
    return np.column_stack((begin, np.minimum(spans[mine, 1], others[theirs, 1])))


def in_spans(time: IntArray, spans: Spans) -> BoolArray:
    """Whether each time [ns since 1970 UTC] is in one of the spans; (n,).

    Examples
    --------
    >>> in_spans(np.array([1, 4, 6]), np.array([[0, 3], [5, 9]])).tolist()
    [True, False, True]
    """
    if len(spans) == 0:
        return np.zeros(time.size, dtype=np.bool_)
    before = np.searchsorted(spans[:, 0], time, side="right") - 1
    return np.asarray((before >= 0) & (time <= spans[np.clip(before, 0, None), 1]))

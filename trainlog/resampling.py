"""Bringing a trip's topics onto one clock, without inventing data.

How a value between two samples is found stands in the table of topics: on the line between them,
held since the last, or not at all. Nothing is known before the first sample of a topic, after its
last, beside a sample that is not known, and in a gap longer than a stated time: there the result is
NaN. What has no value between samples (texts and codes) is never resampled.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import timedelta

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError, LogError
from trainlog.topics import Topic, column_field, topic_of_frame
from trainlog.trip import Trip
from trainlog.units import NANOSECONDS
from trainlog.version import __version__

Clock = pd.DatetimeIndex | pd.Timedelta | float
"""The times to resample to: as they are, or the step between them, a duration or in [s]."""


def interpolated(
    frame: pd.DataFrame, column: str, time: pd.DatetimeIndex, max_gap: float | None = None
) -> FloatArray:
    """The values of a column at other times, by the topic table's interpolation rule.

    Parameters
    ----------
    frame : DataFrame
        Of a topic, in the order of time.
    column : str
        One with a unit; texts and codes have no values between samples.
    time : (n,) DatetimeIndex
    max_gap : float [s], optional
        Samples further apart than this have nothing between them. Default: no limit.

    Returns
    -------
    (n,) array
        In the column's unit. A sample at exactly one of the times is found as it is, the last of
        several. NaN outside the recorded span, in gaps, and between two samples of which one is
        not known.

    Raises
    ------
    KeyError
        If the topic has no such column.
    InputError
        If its values cannot be interpolated.

    Examples
    --------
    >>> from trainlog.topics import TRAIN_STATE
    >>> from trainlog.trip import frame_of
    >>> frame = frame_of(TRAIN_STATE, [0, 2_000_000_000], {"speed": [3.0, 4.0]})
    >>> interpolated(frame, "speed", pd.DatetimeIndex(["1970-01-01T00:00:01Z"])).tolist()
    [3.5]
    """
    rule = column_field(topic_of_frame(frame.attrs), column).interpolation
    if rule == "none":
        raise InputError(
            f"{column} of {frame.attrs['topic']} has no values between its samples",
            remedy="take the rows as they are",
        )
    known = pd.DatetimeIndex(frame.index).as_unit("ns").asi8
    wanted = time.as_unit("ns").asi8
    values = frame[column].to_numpy(dtype=np.float64)
    if len(known) == 0:
        return np.full(len(wanted), np.nan)
    before = np.clip(np.searchsorted(known, wanted, side="right") - 1, 0, None)
    after = np.clip(before + 1, None, len(known) - 1)
    step = known[after] - known[before]
    since = np.clip(wanted - known[before], 0, step)
    found = values[before]
    if rule == "linear":
        found = np.where(since == 0, found, _on_line(found, values[after], since, step))
    unknown = (wanted < known[0]) | (wanted > known[-1])
    if max_gap is not None:
        unknown |= (since > 0) & (step > max_gap * NANOSECONDS)
    return np.where(unknown, np.nan, found)


def resampled(trip: Trip, clock: Clock, *, max_gap: float | None) -> Trip:
    """A trip with all its topics on one clock.

    Topics without values between samples (the events) keep their own rows; columns of that kind
    in other topics are left out.

    Parameters
    ----------
    trip : Trip
    clock : DatetimeIndex, Timedelta, or float [s]
        The times; or the step between them, from the first sample of the trip to its last.
    max_gap : float [s] or None
        Samples of a topic further apart than this have nothing between them; None: no limit.

    Returns
    -------
    Trip
        With one step of provenance more.

    Raises
    ------
    InputError
        If the clock is neither times nor a step, the step not positive, or its times do not
        increase; if `max_gap` is not positive.
    LogError
        If the trip holds no samples.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/stopping.mcap")
    >>> steady = resampled(trip, 0.5, max_gap=2.0)
    >>> len(steady["/gnss/fix"]), len(steady["/train/state"])
    (2828, 2828)
    """
    check_max_gap(max_gap)
    times = _times(trip, clock)
    texts = {name for name, frame in trip.topics.items() if _is_text(topic_of_frame(frame.attrs))}
    topics = {
        name: frame if name in texts else resampled_frame(frame, times, max_gap=max_gap)
        for name, frame in trip.topics.items()
    }
    step = None if isinstance(clock, pd.DatetimeIndex) else _step(clock)
    return replace(trip, topics=topics).with_step(
        "resample", software=f"trainlog {__version__}", seconds=step, max_gap=max_gap
    )


def resampled_frame(
    frame: pd.DataFrame, time: pd.DatetimeIndex, *, max_gap: float | None
) -> pd.DataFrame:
    """The frame of a topic at other times; see `interpolated`. Texts and codes are left out."""
    topic = topic_of_frame(frame.attrs)
    names = [name for name in frame.columns if column_field(topic, name).interpolation != "none"]
    # At its own times a topic is what it was, though one come twice.
    own = np.array_equal(_nanoseconds(frame), time.as_unit("ns").asi8)
    found = pd.DataFrame(
        {
            name: frame[name].to_numpy(np.float64).copy()
            if own
            else interpolated(frame, name, time, max_gap)
            for name in names
        },
        index=_named(time),
        columns=names,
        dtype=np.float64,
    )
    units = frame.attrs.get("units", {})
    found.attrs = {**frame.attrs, "units": {n: u for n, u in units.items() if n in names}}
    return found


def joined(
    trip: Trip, columns: Iterable[str], on: str | Clock, *, max_gap: float | None
) -> pd.DataFrame:
    """Columns of several topics on one clock, side by side.

    Parameters
    ----------
    trip : Trip
    columns : iterable of str
        As ``"/train/state.speed"``. A field with one value for each axle gives all its columns:
        ``"/train/axles.wheel_speed"``.
    on : str, DatetimeIndex, Timedelta, or float [s]
        Topic whose times are the clock; or the times; or the step between them.
    max_gap : float [s] or None
        Samples of a topic further apart than this have nothing between them; None: no limit.

    Returns
    -------
    DataFrame
        Indexed by time, one column a name, the units in ``attrs["units"]``.

    Raises
    ------
    LogError
        If the trip has no such topic, or the topic no such column.
    InputError
        If a name is not of the form ``topic.column``, comes twice, or its values cannot be
        interpolated; if the clock cannot be used; if `max_gap` is not positive.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/stopping.mcap")
    >>> names = ["/train/state.speed", "/train/controls.lever"]
    >>> table = joined(trip, names, on="/train/controls", max_gap=1.0)
    >>> table.shape, table.attrs["units"]["/train/state.speed"]
    ((14140, 2), 'm/s')
    """
    check_max_gap(max_gap)
    clock_topic = on if isinstance(on, str) else None
    times = pd.DatetimeIndex(trip[on].index) if isinstance(on, str) else _times(trip, on)
    found: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    for name in [columns] if isinstance(columns, str) else columns:
        topic, frame = _frame_of(trip, name)
        for column in _columns_of(frame, name):
            full = f"{topic}.{column}"
            if full in found:
                raise InputError(f"{full} is joined twice", remedy="name it once")
            values = interpolated(frame, column, times, max_gap)
            # At its own times a topic is what it was, though one come twice.
            own = topic == clock_topic
            found[full] = frame[column].to_numpy(np.float64).copy() if own else values
            units[full] = frame.attrs["units"][column]
    result = pd.DataFrame(found, index=_named(times), columns=list(found), dtype=np.float64)
    result.attrs = {"units": units}
    return result


def joined_pieces(
    pieces: Iterable[Trip], columns: Sequence[str], on: str, *, max_gap: float | None
) -> Iterator[pd.DataFrame]:
    """What `joined` gives, piece by piece, for trips larger than the memory.

    A row waits until every topic is known up to its time, or, past `max_gap`, will not be.

    Parameters
    ----------
    pieces : iterable of Trip
        In the order of time; each with every topic, without rows perhaps.
    columns : sequence of str
    on : str
        Topic whose times are the clock.
    max_gap : float [s] or None

    Yields
    ------
    DataFrame
        One after the other the rows of ``joined(whole, columns, on, max_gap=max_gap)``.

    Raises
    ------
    LogError, InputError
        As `joined`.
    """
    topics = {on, *(name.rpartition(".")[0] for name in columns)}
    patience = None if max_gap is None else int(max_gap * NANOSECONDS) + 1
    waiting: Trip | None = None
    newest = -1
    for piece in pieces:
        waiting = _behind(waiting, piece, topics)
        newest = max([newest, *map(_end, piece.topics.values())])
        oldest = -1 if patience is None else newest - patience
        known = min([newest, *(max(_end(waiting[name]), oldest) for name in topics - {on})])
        ready = int(np.searchsorted(_nanoseconds(waiting[on]), known, side="right"))
        if ready:
            yield _joined_rows(waiting, columns, on, slice(0, ready), max_gap)
            waiting = _remaining(waiting, on, ready)
    if waiting is not None:
        yield _joined_rows(waiting, columns, on, slice(0, None), max_gap)


def _joined_rows(
    trip: Trip, columns: Sequence[str], on: str, rows: slice, max_gap: float | None
) -> pd.DataFrame:
    return joined(trip.with_topic(_kept(trip[on], rows)), columns, on, max_gap=max_gap)


def _behind(waiting: Trip | None, piece: Trip, topics: set[str]) -> Trip:
    """The piece's topics behind the rows that wait."""
    if waiting is None:
        return replace(piece, topics={name: piece[name] for name in topics})
    frames = {}
    for name in topics:
        frames[name] = pd.concat([waiting[name], piece[name]])
        frames[name].attrs = piece[name].attrs
    return replace(waiting, topics=frames)


def _remaining(trip: Trip, on: str, done: int) -> Trip:
    """The rows that are still needed when the first rows of the clock are done."""
    reached = _nanoseconds(trip[on])[done - 1]
    frames = {}
    for name, frame in trip.topics.items():
        first = int(np.searchsorted(_nanoseconds(frame), reached, side="right")) - 1
        frames[name] = _kept(frame, slice(done if name == on else max(first, 0), None))
    return replace(trip, topics=frames)


def _kept(frame: pd.DataFrame, rows: slice) -> pd.DataFrame:
    kept = frame.iloc[rows]
    kept.attrs = frame.attrs
    return kept


def _end(frame: pd.DataFrame) -> int:
    return int(_nanoseconds(frame)[-1]) if len(frame) else -1


def _nanoseconds(frame: pd.DataFrame) -> IntArray:
    return pd.DatetimeIndex(frame.index).as_unit("ns").asi8


MOST_INSTANTS = 10**8
"""Of a clock: more are no clock but a slip of the unit."""


def regular_clock(start: pd.Timestamp, end: pd.Timestamp, step: float) -> pd.DatetimeIndex:
    """Times from `start` on, `step` seconds apart, none after `end`.

    Raises
    ------
    InputError
        If the step is shorter than a nanosecond, or makes more than `MOST_INSTANTS`.

    Examples
    --------
    >>> start = pd.Timestamp("2024-10-07T08:00Z")
    >>> len(regular_clock(start, start + pd.Timedelta("1s"), 0.25))
    5
    """
    nanoseconds = round(step * NANOSECONDS) if np.isfinite(step) else 0
    if nanoseconds < 1:
        raise InputError(f"a clock cannot go in steps of {step:g} s", remedy="give seconds above 0")
    first, last = start.as_unit("ns").value, end.as_unit("ns").value
    if (last - first) // nanoseconds > MOST_INSTANTS:
        raise InputError(
            f"a clock in steps of {step:g} s has {(last - first) // nanoseconds:,} instants"
            f" in {(last - first) / NANOSECONDS:.0f} s",
            remedy=f"take longer steps or a part of the trip: at most {MOST_INSTANTS:,}",
        )
    times = np.arange(first, last + 1, nanoseconds)
    return pd.DatetimeIndex(times.view("M8[ns]"), tz="UTC", name="time")


def _on_line(first: FloatArray, second: FloatArray, since: IntArray, step: IntArray) -> FloatArray:
    """Values on the lines from `first` to `second`, never beyond either."""
    with np.errstate(invalid="ignore", divide="ignore"):
        part = since / step
        # The weighted sum cannot overflow, as the difference of large values would.
        value = (1.0 - part) * first + part * second
        return np.clip(value, np.minimum(first, second), np.maximum(first, second))


def _times(trip: Trip, clock: Clock) -> pd.DatetimeIndex:
    """The clock's times in UTC, checked."""
    if not isinstance(clock, pd.DatetimeIndex):
        return regular_clock(trip.start, trip.end, _step(clock))
    if not clock.is_monotonic_increasing or clock.hasnans:
        raise InputError("the times of the clock do not increase", remedy="sort them")
    return clock.tz_localize("UTC") if clock.tz is None else clock.tz_convert("UTC")


_NUMBERS = (int, float, np.integer, np.floating)


def _step(clock: object) -> float:
    """The step of a clock [s]."""
    if isinstance(clock, timedelta | np.timedelta64):  # a Timedelta is a timedelta
        return pd.Timedelta(clock).total_seconds()
    if isinstance(clock, _NUMBERS) and not isinstance(clock, bool):
        return float(clock)
    raise InputError(
        f"{clock!r:.80} is no clock",
        remedy="give the times as a DatetimeIndex, or the step between them in seconds",
    )


def check_max_gap(max_gap: object) -> None:
    """Refuse a longest gap that is not a positive number of seconds.

    Raises
    ------
    InputError
    """
    if max_gap is None:
        return
    number = isinstance(max_gap, _NUMBERS) and not isinstance(max_gap, bool)
    if not (number and float(str(max_gap)) > 0):
        raise InputError(
            f"max_gap is {max_gap!r}",
            remedy="give seconds above 0, or None for gaps of any length",
        )


def _named(time: pd.DatetimeIndex) -> pd.DatetimeIndex:
    return time.as_unit("ns").rename("time")


def _is_text(topic: Topic) -> bool:
    return all(field.interpolation == "none" for field in topic.fields)


def _frame_of(trip: Trip, name: str) -> tuple[str, pd.DataFrame]:
    """Topic and frame that a name like ``/train/state.speed`` belongs to."""
    topic, dot, column = name.rpartition(".")
    if not (dot and topic and column):
        raise InputError(
            f"'{name}' is not a column of a topic", remedy="write it as /train/state.speed"
        )
    return topic, trip[topic]


def _columns_of(frame: pd.DataFrame, name: str) -> list[str]:
    """The column, or the columns of a field with one value for each axle."""
    wanted = name.rpartition(".")[2]
    topic = topic_of_frame(frame.attrs)
    found = [
        column for column in frame.columns if wanted in (column, _field_if_per_axle(topic, column))
    ]
    if not found:
        raise LogError(
            f"{topic.name} has no column {wanted}",
            remedy=f"its columns are {', '.join(frame.columns)}",
        )
    return found


def _field_if_per_axle(topic: Topic, column: str) -> str | None:
    field = column_field(topic, column)
    return field.name if field.per_axle else None

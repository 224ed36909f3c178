"""Which columns of an unknown table are its time, in which format and zone."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import pyarrow as pa

from trainlog.arrays import IntArray
from trainlog.errors import InputError
from trainlog.ingest.mapping import read_time
from trainlog.ingest.profile import TimeOptions
from trainlog.ingest.proposal.layout import Layout, Reading
from trainlog.ingest.proposal.vocabulary import (
    Meaning,
    language_of,
    vocabulary,
    words_of,
    zone_of,
)
from trainlog.ingest.recording import NO_TIME
from trainlog.units import NANOSECONDS

UNKNOWN_DAY = datetime.date(2000, 1, 1)
"""Day that stands for one that the file does not state."""

READABLE = 0.8
"""Share of the cells that a time format must read."""

FORWARD = 0.8
"""Share of the steps that must not go back in time."""

EPOCHS = (("s", 1e9, 2.6e9), ("ms", 1e12, 2.6e12), ("us", 1e15, 2.6e15), ("ns", 1e18, 2.6e18))
"""Counts since 1970 that lie between 2001 and 2052."""

QUARTER, NEAR = 900.0, 60.0
"""Time zones differ by quarters of an hour [s]; two clocks of a recorder by less than the other."""

_DATE = re.compile(r"^(\d{1,4})([-./ ])(\d{1,2})\2(\d{1,4})$")
_CLOCK = re.compile(
    r"^(?P<h>\d{1,3}):(?P<m>\d{2})(?::(?P<s>\d{2})(?P<f>[.,:]\d+)?)?(?P<p>\s*[AP]M)?"
    r"(?P<z>\s*(?:Z|[+-]\d{2}:?\d{2}))?$",
    re.I,
)
_BOTH = re.compile(r"^(?P<date>\S+?)(?P<sep>T|\s+|;)(?P<clock>\d{1,2}:\d{2}.*)$")
_ISO = re.compile(
    r"^\d{4}-\d{2}-\d{2}([T ]\d{2}:\d{2}(:\d{2}([.,]\d+)?)?\s?(Z|[+-]\d{2}:?\d{2})?)?$"
)
_FURTHER = (
    "%Y%m%dT%H%M%SZ", "%Y%m%dT%H%M%S", "%Y%m%dT%H%M%S.%f", "%Y%m%d%H%M%S", "%Y%m%d_%H%M%S",
    "%d-%b-%Y %H:%M:%S", "%d-%b-%Y %H:%M:%S.%f", "%d %b %Y %H:%M:%S", "%d %B %Y %H:%M:%S",
)  # fmt: skip
"""Formats of date and time in one column whose parts are known by their order alone."""

_DATE_IN_NAME = re.compile(r"(?<!\d)(20\d\d)[-_.]?([01]\d)[-_.]?([0-3]\d)(?!\d)")
_DAY_FIRST = re.compile(r"(?<!\d)([0-3]?\d)\.([01]?\d)\.(20\d\d)(?!\d)")


class NoRecordingError(InputError):
    """A table that holds no time at all: it lies beside recordings."""


@dataclass(frozen=True, eq=False)
class Clock:
    """The time of a table.

    Attributes
    ----------
    options : TimeOptions
    time : (n,) int64 array [ns]
        UTC; `NO_TIME` where a row has none.
    readings : tuple of Reading
    """

    options: TimeOptions
    time: IntArray
    readings: tuple[Reading, ...]

    @property
    def one_file(self) -> bool:
        """Whether the options state a day that holds for this file only."""
        return self.options.date is not None or self.options.start is not None


_Candidates = Iterator[tuple[TimeOptions, tuple[Reading, ...]]]
"""Ways in which the time may be written, the likelier first; what follows a `yield` of one is done
if the table cannot be read so."""


def clock_of(layout: Layout, meanings: dict[str, Meaning]) -> Clock:
    """The time of each row.

    Raises
    ------
    InputError
        If no column counts time forward; as `NoRecordingError`, if none is called a time either.
    """
    named = [n for n in layout.names if {"clock", "date"} & set(meanings[n].quantities)]
    order = [*named, *(name for name in layout.names if name not in named)]
    tried: list[str] = []
    candidates = chain(
        _typed(layout, order, tried),
        _parts(layout),
        _date_and_clock(layout, order),
        _epoch(layout, order),
        _elapsed(layout, meanings, tried),
    )
    found = _first(layout, candidates)
    if found is not None:
        return _zoned(layout, order, found)
    shown = ", ".join(layout.names[:12]) + (", ..." if len(layout.names) > 12 else "")
    noted = f" ({'; '.join(tried)})" if tried else ""
    kind = InputError if tried or named else NoRecordingError
    raise kind(
        f"is no recording of a trip: no column is a time that goes forward{noted}",
        file=layout.path,
        remedy=f"columns: {shown}; if one of them is the time, write a profile, see docs/ingest.md",
    )


def _zoned(layout: Layout, order: list[str], clock: Clock) -> Clock:
    """The clock with the zone that a column of Unix time beside it proves, where it was open."""
    zone = next((r for r in clock.readings if r.what == "time zone" and r.alternative), None)
    unix = None if zone is None else _first(layout, _epoch(layout, order))
    if zone is None or unix is None or unix.options.column in clock.options.names:
        return clock
    both = (clock.time != NO_TIME) & (unix.time != NO_TIME)
    local = _clock(layout, clock.options.model_copy(update={"timezone": "UTC"}), ())
    if local is None or not both.any():
        return clock
    ahead = (local.time - unix.time)[both] / NANOSECONDS
    quarters = round(float(np.median(ahead)) / QUARTER)
    if np.mean(np.abs(ahead - QUARTER * quarters) < NEAR) < READABLE or abs(quarters) > 56:
        return clock
    hours, minutes = divmod(abs(quarters) * 15, 60)
    offset = f"{'-' if quarters < 0 else '+'}{hours:02d}:{minutes:02d}" if quarters else "UTC"
    proven = Reading("time zone", offset, f"'{unix.options.column}' counts since 1970 beside it")
    options = clock.options.model_copy(update={"timezone": offset})
    found = _clock(layout, options, ())
    if found is None:
        return clock
    return replace(found, readings=tuple(proven if r is zone else r for r in clock.readings))


def _first(layout: Layout, candidates: _Candidates) -> Clock | None:
    """The first of the candidates with which the table reads."""
    clocks = (_clock(layout, options, readings) for options, readings in candidates)
    return next((clock for clock in clocks if clock is not None), None)


def _clock(layout: Layout, options: TimeOptions, readings: tuple[Reading, ...]) -> Clock | None:
    """The time so read; None unless most rows have one and most steps go forward."""
    try:
        time = read_time(layout.table, options, layout.options.decimal, layout.path)
    except (InputError, ValueError, OverflowError, pa.ArrowException):
        return None
    known = time[time != NO_TIME]
    filled = len(layout.table) - max(layout.table[name].null_count for name in options.names)
    if known.size < max(2.0, READABLE * filled):
        return None
    steps = np.diff(known)
    turned = bool(np.mean(steps <= 0) >= FORWARD and np.any(steps < 0))
    steps = -steps if turned else steps
    if known[0] == known[-1] or np.mean(steps >= 0) < FORWARD or not np.any(steps > 0):
        return None
    if turned:
        readings = (*readings, Reading("order", "the newest row first", "times fall"))
    return Clock(options, time, readings)


def _typed(layout: Layout, order: list[str], tried: list[str]) -> _Candidates:
    """Columns that the file types as time stamps."""
    for name in order:
        kind = layout.table[name].type
        if pa.types.is_timestamp(kind):
            zone, zoned = _zone(layout, (name,))
            if kind.tz:
                zone, zoned = "UTC", Reading("time zone", str(kind.tz), "the file states it")
            typed = Reading("time", name, "the file types it as time stamps")
            yield TimeOptions(column=name, timezone=zone), (typed, zoned)
            tried.append(f"'{name}' is a time stamp that does not go forward")


def _parts(layout: Layout) -> _Candidates:
    """Six columns: year, month, day, hour, minute, second."""
    found: dict[str, str] = {}
    for part, spellings in vocabulary()["parts"].items():
        for name in layout.names:
            if set(words_of(name)) & set(spellings) and name not in found.values():
                found.setdefault(part, name)
    if len(found) == 6:
        names = tuple(found[part] for part in ("year", "month", "day", "hour", "minute", "second"))
        zone, zoned = _zone(layout, names)
        named = Reading("time", ", ".join(names), "six columns named year to second")
        yield TimeOptions(columns=names, format="parts", timezone=zone), (named, zoned)


def _date_and_clock(layout: Layout, order: list[str]) -> _Candidates:
    """Text: date and time of day in one column, in two, or the time of day alone."""
    texts = {name: cells for name in layout.names if (cells := _cells(layout, name))}
    # Of several the one that states UTC, then the one whose name says time.
    order = sorted((name for name in order if name in texts), key=lambda n: zone_of(n) != "UTC")
    dates = [n for n in order if _share(_DATE, texts[n]) > READABLE or _compact_date(texts[n])]
    clocks = [n for n in order if _share(_CLOCK, texts[n]) > READABLE]
    for name in order:
        yield from _one_column(layout, name, texts[name])
    for clock in clocks:
        for date in dates:
            yield from _two_columns(layout, date, clock, texts)
    for clock in clocks:
        yield from _clock_alone(layout, clock, texts[clock])


def _cells(layout: Layout, name: str) -> list[str]:
    """Cells of a text column, up to 600 of them over the whole file."""
    column = layout.table[name]
    if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
        if not pa.types.is_date(column.type):
            return []
        column = column.cast(pa.string())
    every = max(1, len(column) // 600)
    picked = column.take(pa.array(np.arange(0, len(column), every)))
    return [cell.strip() for cell in picked.to_pylist() if cell is not None and cell.strip()]


def _share(pattern: re.Pattern[str], cells: list[str]) -> float:
    return sum(bool(pattern.match(cell)) for cell in cells) / len(cells) if cells else 0.0


def _one_column(layout: Layout, name: str, cells: list[str]) -> _Candidates:
    zone, zoned = _zone(layout, (name,))
    if re.search(r":\d\d.*(Z|[+-]\d\d:?\d\d)$", cells[0]):
        zone, zoned = "UTC", Reading("time zone", "as each cell states", f"'{cells[0]}'")
    if _share(_ISO, cells) > READABLE and any(":" in cell for cell in cells):
        iso = Reading("time", name, f"ISO 8601, '{cells[0]}'")
        yield TimeOptions(column=name, timezone=zone), (iso, zoned)
    for pattern in _FURTHER:
        if _reads(pattern, cells[0]):
            utc = Reading("time zone", "UTC", "the cells end in Z")
            where, shown = ("UTC", utc) if pattern.endswith("Z") else (zone, zoned)
            named = Reading("time", f"{name}, {pattern}", f"'{cells[0]}'")
            yield TimeOptions(column=name, format=pattern, timezone=where), (named, shown)
    if _share(_BOTH, cells) > READABLE:
        halves = [match for match in map(_BOTH.match, cells) if match]
        date, dated = _date_pattern(layout, [half["date"] for half in halves])
        clock = _clock_pattern([half["clock"] for half in halves])
        if date is not None and clock is not None:
            pattern = f"{date}{halves[0]['sep']}{clock}"
            named = Reading("time", f"{name}, {pattern}", f"'{cells[0]}'")
            yield TimeOptions(column=name, format=pattern, timezone=zone), (named, dated, zoned)


def _reads(pattern: str, cell: str) -> bool:
    try:
        return bool(datetime.datetime.strptime(cell, pattern))
    except ValueError:
        return False


def _two_columns(layout: Layout, date: str, clock: str, texts: dict[str, list[str]]) -> _Candidates:
    day, dated = _date_pattern(layout, texts[date])
    hour = _clock_pattern(texts[clock])
    if day is not None and hour is not None:
        zone, zoned = _zone(layout, (date, clock))
        if "%z" in hour:
            zoned = Reading("time zone", "as each cell states", f"'{texts[clock][0]}'")
        shown = f"'{texts[date][0]}' and '{texts[clock][0]}'"
        named = Reading("time", f"{date}, {clock}, {day} {hour}", shown)
        options = TimeOptions(columns=(date, clock), format=f"{day} {hour}", timezone=zone)
        yield options, (named, dated, zoned)


def _clock_alone(layout: Layout, name: str, cells: list[str]) -> _Candidates:
    """A time of day without date, or elapsed time that begins at zero."""
    pattern = _clock_pattern(cells)
    first = _CLOCK.match(cells[0])
    assert first is not None, "most cells match it"
    begins_at_zero = int(first["h"]) == 0 and int(first["m"]) == 0
    elapsed = begins_at_zero and bool({"elapsed", "laufzeit"} & set(words_of(name)))
    day, started = _started(layout)
    if pattern is None or elapsed or (begins_at_zero and not day and not first["p"]):
        named = Reading(
            "time", f"{name}, elapsed", f"'{cells[0]}' begins at zero", "the time of day"
        )
        options = TimeOptions(column=name, format="elapsed", start=_midnight(day))
        yield options, (named, started)
        return
    zone, zoned = _zone(layout, (name,))
    named = Reading("time", f"{name}, {pattern}", f"'{cells[0]}', without a date")
    options = TimeOptions(column=name, format=pattern, date=day or UNKNOWN_DAY, timezone=zone)
    yield options, (named, started, zoned)


def _midnight(day: datetime.date | None) -> datetime.datetime:
    return datetime.datetime.combine(day or UNKNOWN_DAY, datetime.time(), datetime.UTC)


def _started(layout: Layout) -> tuple[datetime.date | None, Reading]:
    """The day of the first row, if the file states it, and how that is known."""
    day, where = _day(layout)
    if day is not None:
        return day, Reading("day", day.isoformat(), where)
    return None, Reading(
        "day",
        UNKNOWN_DAY.isoformat(),
        "the file states no date; this day stands for one that is not known",
        "the day it was recorded: correct it in the profile",
    )


def _day(layout: Layout) -> tuple[datetime.date | None, str]:
    """The day that the lines above the header, a column of dates or the file's name state."""
    sources = [
        ("the lines above the header", layout.preamble),
        ("the file's name", layout.path.stem),
    ]
    for where, text in sources:
        match = _DATE_IN_NAME.search(text)
        parts = match.groups() if match else None
        german = None if parts else _DAY_FIRST.search(text)
        if german:
            parts = german.group(3), german.group(2), german.group(1)
        if parts:
            try:
                return datetime.date(*map(int, parts)), f"{where} state it"
            except ValueError:
                continue
    return None, ""


def _compact_date(cells: list[str]) -> bool:
    return _share(re.compile(r"^(19|20)\d\d[01]\d[0-3]\d$"), cells) > READABLE


def _date_pattern(layout: Layout, cells: list[str]) -> tuple[str | None, Reading]:
    """The pattern of dates; the order of day and month is decided by the data where they can."""
    if _compact_date(cells):
        return "%Y%m%d", Reading("date", "year, month, day", f"'{cells[0]}'")
    found = [match for match in map(_DATE.match, cells) if match]
    if not found:
        return None, Reading("date", "", "")
    mark = found[0].group(2)
    first, second, third = ([m.group(n) for m in found] for n in (1, 3, 4))
    if len(first[0]) == 4:
        return f"%Y{mark}%m{mark}%d", Reading("date", "year, month, day", f"'{cells[0]}'")
    year = "%Y" if len(third[0]) == 4 else "%y"
    day_first, why, other = _day_first(layout, mark, _whole(first), _whole(second))
    taken = "day, month, year" if day_first else "month, day, year"
    pattern = f"%d{mark}%m{mark}{year}" if day_first else f"%m{mark}%d{mark}{year}"
    return pattern, Reading("date", taken, f"'{cells[0]}': {why}", other)


def _whole(cells: Iterable[str]) -> list[int]:
    return [int(cell) for cell in cells]


def _day_first(
    layout: Layout, mark: str, first: list[int], second: list[int]
) -> tuple[bool, str, str]:
    """Whether the day stands before the month, why, and the alternative if the data allow it."""
    if max(first) > 12:
        return True, f"a month {max(first)} does not exist", ""
    if max(second) > 12:
        return False, f"a month {max(second)} does not exist", ""
    if first[0] == second[0] and len(set(first)) == 1 == len(set(second)):
        return True, "day and month are the same number", ""
    if mark == ".":
        return True, "dates with points have the day first", ""
    stated, where = _day(layout)
    if stated is not None and {stated.day, stated.month} == {first[0], second[0]}:
        return first[0] == stated.day, f"{where}: {stated.isoformat()}", ""
    # Within a trip midnight changes the day, not the month.
    if len(set(first)) != len(set(second)):
        return len(set(first)) > len(set(second)), "the number that changes at midnight", ""
    language = language_of(layout.names)
    if language in ("de", "fr"):
        return (
            True,
            f"the header is {'German' if language == 'de' else 'French'}",
            ("month, day, year"),
        )
    return True, "both numbers could be a month", "month, day, year"


def _clock_pattern(cells: list[str]) -> str | None:
    """The pattern of times of day."""
    found = [match for match in map(_CLOCK.match, cells) if match]
    if not found or max(int(match["h"]) for match in found) > 23:
        return None
    fractions = {(match["f"] or " ")[0] for match in found}
    if len(fractions) > 1:
        return None
    noon = bool(found[0]["p"])
    pattern = "%I:%M" if noon else "%H:%M"
    pattern += ":%S" if found[0]["s"] else ""
    mark = fractions.pop()
    pattern += f"{mark}%f" if mark != " " else ""
    if noon:
        pattern += " %p" if found[0]["p"].startswith(" ") else "%p"
    if found[0]["z"]:
        pattern += " %z" if found[0]["z"].startswith(" ") else "%z"
    return pattern


def _epoch(layout: Layout, order: list[str]) -> _Candidates:
    """Counts since 1970."""
    for name in order:
        values = layout.number(name)
        known = values[np.isfinite(values)]
        for unit, low, high in EPOCHS:
            if known.size >= 2 and low <= np.median(known) <= high and np.ptp(known) > 0.0:
                instant = datetime.datetime.fromtimestamp(known[0] / (low / 1e9), datetime.UTC)
                why = f"counts {unit} since 1970: the first is {instant:%Y-%m-%d %H:%M:%S} UTC"
                counted = Reading("time", f"{name}, epoch [{unit}]", why)
                yield TimeOptions(column=name, format="epoch", unit=unit), (counted,)


STEPS = {"s": (0.0005, 100.0), "ms": (0.5, 60_000.0), "us": (500.0, 6e7)}
"""Usual steps of recorders in each unit of a count."""


def _elapsed(layout: Layout, meanings: dict[str, Meaning], tried: list[str]) -> _Candidates:
    """Counts since the start."""
    for name in [n for n in layout.names if "clock" in meanings[n].quantities]:
        values = layout.number(name)
        steps = np.diff(values[np.isfinite(values)])
        if steps.size < 2 or np.mean(steps > 0) < 0.5:
            continue
        step = float(np.median(steps[steps > 0]))
        stated = meanings[name].unit
        if stated in ("min", "h"):
            tried.append(f"'{name}' counts in {stated}, which a profile cannot read")
            continue
        possible = [unit for unit, (low, high) in STEPS.items() if low <= step <= high]
        if stated in STEPS:
            unit, why, other = str(stated), f"the name states {stated}", ""
        elif not possible:
            continue
        else:
            unit = "ms" if step >= 20.0 and "ms" in possible else possible[0]
            unit = "us" if step >= 2e4 and "us" in possible else unit
            why = f"rows lie {step:g} apart"
            other = ", ".join(each for each in possible if each != unit)
        day, started = _started(layout)
        options = TimeOptions(column=name, format="elapsed", unit=unit, start=_midnight(day))
        yield options, (Reading("time", f"{name}, elapsed [{unit}]", why, other), started)


def _zone(layout: Layout, names: tuple[str, ...]) -> tuple[str, Reading]:
    """The zone of times that name no offset."""
    stated = [zone_of(name) for name in names]
    zone = next((each for each in stated if each is not None), None) or zone_of(layout.preamble)
    guess = {"de": "Europe/Berlin", "fr": "Europe/Paris"}.get(
        language_of(layout.names) or "", "UTC"
    )
    if zone == "local":
        why = "the name states local time; which one is guessed by the language of the columns"
        return guess, Reading("time zone", guess, why, "another zone: correct it in the profile")
    if zone is not None:
        return zone, Reading("time zone", zone, "the name states it")
    why = "the file does not state a zone"
    where = "Europe/London" if guess == "UTC" else guess
    other = f'local time, such as timezone = "{where}" (a guess): correct it in the profile'
    return "UTC", Reading("time zone", "UTC", why, other)

"""How an unknown table is written: encoding, delimiter, decimal mark, header, units, missing words.

Nothing here knows what the columns mean. A library that guesses (csv.Sniffer, charset detection)
would guess from letters; a recorder's file is decided by its numbers: the delimiter is the one that
leaves the most cells which are numbers or times, in rows of equal length. Which of its columns are
the time, in which format and zone, is found behind it.
"""

from __future__ import annotations

import csv
import datetime
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.formats.files import read_bytes
from trainlog.ingest.clock import QUARTER
from trainlog.ingest.mapping import (
    NANOSECONDS_PER,
    THOUSANDS,
    ZONE,
    grouped,
    is_text,
    numbers,
    read_time,
    states_zone,
)
from trainlog.ingest.profile import MISSING, Decimal, FileOptions, TimeOptions
from trainlog.ingest.proposal.vocabulary import (
    Meaning,
    language_of,
    unit_of,
    vocabulary,
    words_of,
    zone_of,
)
from trainlog.ingest.recording import NO_TIME
from trainlog.ingest.tabular import is_parquet, open_text, plain_text, readable_parquet
from trainlog.units import NANOSECONDS

DELIMITERS = (";", ",", "\t", "|", " ")

SAMPLE = 200
"""Lines that the layout is judged by: of the file's begin, middle and end."""

HEAD = 60
"""Lines in which the header must stand."""

CODECS = ("cp1252", "cp850", "latin-1")
"""Encodings of one byte a letter that recorders write, the likelier first."""

_LETTERS = "äöüÄÖÜßéèàçêâîôûëïùÉÈÀ°²³‰µ·"
"""What stands beyond ASCII in headers of these languages."""

_NUMBER: dict[Decimal, re.Pattern[str]] = {
    ".": re.compile(r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"),
    ",": re.compile(r"^[+-]?(\d+,?\d*|,\d+)([eE][+-]?\d+)?$"),
}
_TIME = re.compile(
    r"^\d{1,4}[-./]\d{1,2}[-./]\d{1,4}([T ][^;|\t]*)?$"
    r"|^\d{1,2}:\d{2}(:\d{2}([.,:]\d+)?)?\s*([AaPp][Mm])?"
    r"(Z|[+-]\d\d:?\d\d)?$|^\d{8}T\d{6}.*$|^\d{1,2}[- .]\w{3,4}[-. ]+\d{2,4}.*$"
)
_SENTINEL = re.compile(
    r"^-?(9{3,6}([.,]9+|[.,]0+)?|(327(67|68)|655(35|34))([.,]0+)?"
    r"|(3276[,.]7|6553[,.]5|655[,.]35|327[,.]67)0*)$"
)

EXTRA_MISSING = (
    "#N/A", "k.A.", "k. A.", "n.v.", "n.a.", "inf", "-inf", "----", "?", "***", "****", "*",
    "invalid", "INVALID", "ungültig", "ungueltig", "invalide", "error", "ERROR", "Fehler", "#",
    "undefined", "NULL", "none", "x",
)  # fmt: skip
"""Words that mean "no value" beyond those that every profile knows."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One thing that was read from the data.

    Attributes
    ----------
    what, taken, why : str
        What it is about, what was taken for it, and the numbers or words it rests on.
    alternative : str
        The other reading that the data allow; empty where they decide.
    """

    what: str
    taken: str
    why: str
    alternative: str = ""


@dataclass(frozen=True, eq=False)
class Layout:
    """A table whose cells can be read.

    Attributes
    ----------
    path : Path
    format : str
        ``"csv"`` or ``"parquet"``.
    options : FileOptions
    names, units : tuple of str
        Of the columns that can be named; a unit is empty where no line of units gives one.
    table : pyarrow.Table
    rows : (n,) int64 array
        Row of the file of each row of the table.
    preamble : str
        What stands before the header.
    readings : tuple of Reading
    unnamed : dict of str to str
        Columns that no profile can name, and why.
    """

    path: Path
    format: str
    options: FileOptions
    names: tuple[str, ...]
    units: tuple[str, ...]
    table: pa.Table
    rows: IntArray
    preamble: str = ""
    readings: tuple[Reading, ...] = ()
    unnamed: dict[str, str] = field(default_factory=dict)

    def number(self, name: str) -> FloatArray:
        """A column as numbers, NaN where a cell is none."""
        return self._numbers(name)[0]

    def share_of_numbers(self, name: str) -> float:
        """Share of the cells with a value that are numbers; 0 where there is no value."""
        values, empty, _ = self._numbers(name)
        return float(np.isfinite(values).sum() / max(1, np.count_nonzero(~empty)))

    def _numbers(self, name: str) -> tuple[FloatArray, BoolArray, BoolArray]:
        return numbers(self.table[name], self.options.decimal, self.options.thousands)


def layout_of(path: Path) -> Layout:
    """How a table is written, and its cells.

    Raises
    ------
    InputError
        If it is no table.
    """
    data = read_bytes(path)
    return _parquet_layout(path, data) if is_parquet(data[:8]) else _text_layout(path, data)


def looks_like_table(head: bytes) -> bool:
    r"""Whether the beginning of a text is rows of cells most of which are numbers or times.

    Examples
    --------
    >>> looks_like_table(b"t;v\n0;1\n1;2\n2;3\n3;4\n")
    True
    >>> looks_like_table(b"Words, and more words.\nAnd so on, for some.\nAnd on.\n")
    False
    """
    try:
        _, text, _ = _decoded(head)
        _separators(_sample(text.splitlines()))
    except InputError:
        return False
    return True


def _parquet_layout(path: Path, data: bytes) -> Layout:
    with readable_parquet():
        table = pa.parquet.read_table(pa.BufferReader(data))
    names = tuple(str(name) for name in table.schema.names)
    fields = [table.schema.field(name).metadata or {} for name in names]
    units = tuple(
        unit_of(each.get(b"unit", b"").decode("utf-8", "ignore")) or "" for each in fields
    )
    rows = np.arange(1, table.num_rows + 1, dtype=np.int64)
    known = Reading("file", "Parquet", f"{len(names)} columns, {table.num_rows:,} rows")
    return Layout(path, "parquet", FileOptions(), names, units, table, rows, "", (known,))


def _text_layout(path: Path, data: bytes) -> Layout:
    encoding, text, why = _decoded(data)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    sample = _sample(lines)
    delimiter, decimal, width, judged = _separators(sample)
    if delimiter == decimal:
        raise InputError(
            "has commas between its cells and in its numbers, which a profile cannot part",
            remedy="write it with semicolons between the cells",
        )
    header, units, first = _header(lines, delimiter, decimal, width, sample)
    cells = [cell for row in _rows(sample, delimiter) for cell in row]
    marks = [
        sum(bool(re.match(rf"^[+-]?\d*{mark}\d+$", c)) for c in cells) for mark in (r"\.", ",")
    ]
    seen = f"{marks[0]} cells of the sample have a point, {marks[1]} a comma"
    readings = [
        Reading("encoding", encoding, why),
        Reading("delimiter", repr(delimiter), judged),
        Reading("decimal mark", repr(decimal), seen),
    ]
    options = FileOptions(
        format="csv", delimiter=delimiter, decimal=decimal, encoding=encoding, header=header,
        skip_after_header=max(0, first - header - 1) if header else 0,
    )  # fmt: skip
    opened = open_text(path, options)
    counts = Counter(opened.names)
    unique = [name for name, count in counts.items() if name and count == 1]
    words, seen = _missing(opened.cells(unique).table, decimal)
    if words:
        options = replace(options, missing=(*MISSING, *words))
        opened = open_text(path, options)
        readings.append(Reading("missing values", " ".join(map(repr, words)), seen))
    table = opened.cells(unique)
    mark, seen = _thousands(table.table, decimal)
    if mark:
        options = replace(options, thousands=mark)
        readings.append(Reading("thousands mark", repr(mark), seen))
    spelt = dict(zip(opened.names, units, strict=False))
    where = f"line {header}" if header else "none: the columns are numbered"
    readings.append(Reading("header", where, f"{len(unique)} columns, {table.rows.size:,} rows"))
    if any(units):
        readings.append(Reading("units", f"line {header + 1}", " ".join(u or "-" for u in units)))
    unnamed = {
        name or "(no name)": f"the name stands {count} times in the header"
        for name, count in counts.items()
        if name and count > 1
    }
    return Layout(
        path, "csv", options, tuple(unique), tuple(spelt.get(name, "") for name in unique),
        table.table, table.rows, "\n".join(lines[: max(0, header - 1)]), tuple(readings), unnamed,
    )  # fmt: skip


def _decoded(data: bytes) -> tuple[str, str, str]:
    """The encoding, the text, and why."""
    head = data[:4096]
    codec, why = "utf-8", "valid UTF-8"
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        codec, why = "utf-16", "its byte order mark"
    elif head.count(b"\0") > len(head) // 3:
        codec = "utf-16-le" if head[1:2] == b"\0" else "utf-16-be"
        why = "every other byte is zero"
    else:
        data = plain_text(data, "give the recorder's table, not its binary file")
        why = "ASCII" if data.isascii() else why
    try:
        return codec, data.decode(codec).removeprefix("\ufeff"), why
    except UnicodeDecodeError as error:
        if codec != "utf-8":
            raise InputError(
                f"is not {codec} text", place=f"byte {error.start}", remedy="copy it again"
            ) from error
    texts = {}
    for codec in CODECS:
        with suppress(UnicodeDecodeError):
            texts[codec] = data.decode(codec)
    best = max(texts, key=lambda codec: sum(map(texts[codec].count, _LETTERS)))
    shown = " ".join(sorted(set(texts[best]) & set(_LETTERS)))
    return best, texts[best], f"not UTF-8; as {best} it holds {shown}"


def _sample(lines: list[str]) -> list[str]:
    """Lines of data to judge by: of the begin, without what may be a header, middle and end."""
    filled = [line for line in lines if line.strip() and not line.startswith("#")]
    body = filled[min(HEAD, len(filled) // 3) :]
    third, middle = SAMPLE // 3, len(body) // 2
    if len(body) <= SAMPLE:
        return body
    return [*body[:third], *body[middle : middle + third], *body[-third - 1 : -1]]


def _separators(sample: list[str]) -> tuple[str, Decimal, int, str]:
    """Delimiter, decimal mark, cells a row, and the shares that decide."""
    best, found = 0.2, None
    for delimiter in DELIMITERS:
        rows = _rows(sample, delimiter)
        width, count = Counter(map(len, rows)).most_common(1)[0] if rows else (0, 0)
        cells = [cell for row in rows if len(row) == width for cell in row if cell]
        for decimal in _NUMBER if width > 1 else ():
            if decimal == delimiter and not any(
                f'"{cell}"' in line for line in sample[:5] for cell in cells[:20]
            ):
                continue
            share = sum(_measured(cell, decimal) for cell in cells) / max(1, len(cells))
            even = count / len(rows)
            if even * share > best + 1e-6:
                best = even * share
                why = (
                    f"{even:.0%} of the rows have {width} cells,"
                    f" {share:.0%} of them numbers or times"
                )
                found = delimiter, decimal, width, why
    if found is None:
        raise InputError(
            "is not a table: no delimiter leaves rows of equal length with numbers in them",
            remedy="expected text with ';', ',', '|' or tabulators between the cells",
        )
    return found


def _measured(cell: str, decimal: Decimal) -> bool:
    return bool(_NUMBER[decimal].match(cell) or _TIME.match(cell))


def _rows(lines: list[str], delimiter: str) -> list[list[str]]:
    try:
        return [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter)]
    except csv.Error:
        return [[cell.strip() for cell in line.split(delimiter)] for line in lines]


def _header(
    lines: list[str], delimiter: str, decimal: Decimal, width: int, sample: list[str]
) -> tuple[int, tuple[str, ...], int]:
    """Line of the names (0: none), units of the columns, and line of the first row of data."""

    def mostly(cells: list[str]) -> bool:
        return sum(_measured(cell, decimal) for cell in cells) > 0.5 * len(cells)

    body = [row for row in _rows(sample, delimiter) if len(row) == width]
    numeric = [mostly([cell for cell in column if cell]) for column in zip(*body, strict=True)]
    names = 0
    units: tuple[str, ...] = ()
    for place, line in enumerate(lines[:HEAD], start=1):
        row = _rows([line], delimiter)[0] if line.strip() else []
        if len(row) < max(1, width - 1):
            continue
        if mostly([cell for cell, wanted in zip(row, numeric, strict=False) if wanted and cell]):
            return names, units, place
        words = [cell for cell in row if cell]
        spelt = tuple(unit_of(cell) or "" for cell in row)
        bracketed = sum(cell.startswith(("[", "(")) for cell in words)
        if names and words and sum(map(bool, spelt)) + bracketed > 0.6 * len(words):
            units = spelt
        elif len(words) >= max(2, width // 2):
            names, units = place, ()
    return 0, (), 1


def _missing(table: pa.Table, decimal: str) -> tuple[tuple[str, ...], str]:
    """Words and numbers that stand for "no value" in columns of numbers, and how often."""
    counts: Counter[str] = Counter()
    for name in table.column_names:
        values, _, garbled = numbers(table[name], decimal)
        good = np.isfinite(values)
        if not good.any() or np.count_nonzero(garbled) > np.count_nonzero(good):
            continue
        if garbled.any():
            words = table[name].filter(pa.array(garbled)).to_pylist()
            counts.update(word.strip() for word in words if word.strip() in EXTRA_MISSING)
        counts.update(_sentinels(table[name], values))
    found = tuple(sorted(counts))
    return found, ", ".join(f"{word!r} {counts[word]} times" for word in found)


def _thousands(table: pa.Table, decimal: str) -> tuple[str, str]:
    """The mark between thousands that a column has in all its larger numbers, and how often.

    A comma or a point could part decimals as well, of which there are three by chance: only beside
    a decimal mark, a second group, or numbers of three digits without it does it part thousands.
    """
    for mark in (each for each in THOUSANDS if each != decimal):
        for name in table.column_names:
            column = pc.drop_null(table[name])
            parted = pc.match_substring_regex(column, grouped(decimal, mark))
            cells = column.filter(parted).to_pylist()
            rest = column.filter(pc.invert(parted))
            if not cells or pc.any(pc.match_substring(rest, mark)).as_py():
                continue
            hundreds = pc.match_substring_regex(rest, rf"^\s*[+-]?\d{{3}}([{decimal}]\d*)?\s*$")
            sure = any(decimal in cell or cell.count(mark) > 1 for cell in cells)
            if sure or pc.any(hundreds).as_py():
                return mark, f"{len(cells)} cells of '{name}' such as {cells[-1]!r}"
    return "", ""


def _sentinels(column: pa.ChunkedArray, values: FloatArray) -> dict[str, int]:
    """Numbers such as 65535 that stand far beyond all others of a column."""
    known = values[np.isfinite(values)]
    size = np.abs(known)
    extreme = float(size.max())
    rest = size[size < extreme]
    if extreme < 300.0 or not rest.size or rest.size < 0.5 * size.size:
        return {}
    if extreme < 3.0 * max(float(np.percentile(rest, 99.9)), 1.0):
        return {}
    mask = np.abs(values) == extreme
    words = Counter(str(word).strip() for word in column.filter(pa.array(mask)).to_pylist())
    return {word: count for word, count in words.items() if _SENTINEL.match(word)}


# ------------------------------------------------------------------------------------------- time


UNKNOWN_DAY = datetime.date(2000, 1, 1)
"""Day that stands for one that the file does not state."""

MOST = 0.8
"""Share of the cells that a time format must read, or that are numbers in a column of numbers, and
of the steps that must not go back."""

EPOCHS = 1e9, 2.6e9
"""Seconds since 1970 that lie between 2001 and 2052."""

NEAR = 60.0
"""Two clocks of a recorder differ by less [s]."""

STEPS = {"s": (0.0005, 20.0), "ms": (0.5, 2e4), "us": (500.0, 6e7)}
"""Usual steps of recorders in each unit of a count."""

_YEAR_FIRST = re.compile(r"^((?:19|20)\d\d)([-./ ]?)([01]?\d)\2([0-3]?\d)$")
_YEAR_LAST = re.compile(r"^(\d{1,2})([-./ ])(\d{1,2})\2(\d{4}|\d{2})$")
_CLOCK = re.compile(
    r"^(?P<h>\d{1,3}):(?P<m>\d{2})(?::(?P<s>\d{2})(?P<f>[.,:]\d+)?)?(?P<p>\s*[AP]M)?"
    r"(?P<z>\s*(?:Z|[+-]\d{2}:?\d{2}))?$",
    re.I,
)
_BOTH = re.compile(r"^(?P<date>\S+?)(?P<sep>T|\s+|;)(?P<clock>\d{1,2}:\d{2}.*)$")
_ISO = re.compile(rf"^\d{{4}}-\d{{2}}-\d{{2}}[T ]\d{{2}}:\d{{2}}(:\d{{2}}([.,]\d+)?)?\s?{ZONE}?$")
_FURTHER = (
    "%Y%m%dT%H%M%SZ", "%Y%m%dT%H%M%S", "%Y%m%dT%H%M%S.%f", "%Y%m%d%H%M%S", "%Y%m%d_%H%M%S",
    "%d-%b-%Y %H:%M:%S", "%d-%b-%Y %H:%M:%S.%f", "%d %b %Y %H:%M:%S", "%d %B %Y %H:%M:%S",
)  # fmt: skip
"""Formats of date and time in one column whose parts are known by their order alone."""

_DAYS = (
    re.compile(r"(?<!\d)(?P<y>20\d\d)[-_.]?(?P<m>[01]\d)[-_.]?(?P<d>[0-3]\d)(?!\d)"),
    re.compile(r"(?<!\d)(?P<d>[0-3]?\d)\.(?P<m>[01]?\d)\.(?P<y>20\d\d)(?!\d)"),
)
"""Dates in the name of a file, and above the header."""


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
        _texts(layout, order),
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
        f"is not a recording of a trip: no column is a time that goes forward{noted}",
        remedy=f"columns: {shown}; if one of them is the time, write a profile, see docs/ingest.md",
    )


def _zoned(layout: Layout, order: list[str], clock: Clock) -> Clock:
    """The clock with the zone that a column of Unix time beside it proves, where it was open."""
    zone = next((r for r in clock.readings if r.what == "time zone" and r.alternative), None)
    unix = None if zone is None else _first(layout, _epoch(layout, order))
    in_utc = replace(clock.options, timezone="UTC")
    local = _clock(layout, in_utc, ())
    if unix is None or local is None or unix.options.column in clock.options.names:
        return clock
    both = (clock.time != NO_TIME) & (unix.time != NO_TIME)
    ahead = (local.time - unix.time)[both] / NANOSECONDS
    quarter = QUARTER / NANOSECONDS
    quarters = round(float(np.median(ahead)) / quarter) if both.any() else 0
    if not both.any() or np.mean(np.abs(ahead - quarter * quarters) < NEAR) < MOST:
        return clock
    hours, minutes = divmod(abs(quarters) * 15, 60)
    offset = f"{'-' if quarters < 0 else '+'}{hours:02d}:{minutes:02d}" if quarters else "UTC"
    proven = Reading("time zone", offset, f"'{unix.options.column}' counts since 1970 beside it")
    readings = tuple(proven if r is zone else r for r in clock.readings)
    found = _clock(layout, replace(clock.options, timezone=offset), ())
    return clock if found is None or hours > 14 else replace(found, readings=readings)


def _first(layout: Layout, candidates: _Candidates) -> Clock | None:
    """The first of the candidates with which the table reads."""
    clocks = (_clock(layout, options, readings) for options, readings in candidates)
    return next((clock for clock in clocks if clock is not None), None)


def _clock(layout: Layout, options: TimeOptions, readings: tuple[Reading, ...]) -> Clock | None:
    """The time so read; None unless most rows have one and most steps go forward."""
    try:
        time = read_time(layout.table, options, layout.options.decimal)
    except (InputError, ValueError, OverflowError, pa.ArrowException):
        if "/" not in options.timezone:
            return None
        why = f"in {options.timezone} a time comes twice or never"
        other = (
            'the offset that the recorder kept, such as timezone = "+01:00": correct the profile'
        )
        zoned = Reading("time zone", "UTC", why, other)
        readings = tuple(zoned if r.what == "time zone" else r for r in readings)
        return _clock(layout, replace(options, timezone="UTC"), readings)
    known = time[time != NO_TIME]
    filled = len(layout.table) - max(layout.table[name].null_count for name in options.names)
    if known.size < max(2.0, MOST * filled):
        return None
    steps = np.diff(known)
    if np.mean(steps <= 0) >= MOST and np.any(steps < 0):
        steps = -steps
        readings = (*readings, Reading("order", "the newest row first", "times fall"))
    if known[0] == known[-1] or np.mean(steps >= 0) < MOST or not np.any(steps > 0):
        return None
    return Clock(options, time, readings)


def _options(names: tuple[str, ...], **more: Any) -> TimeOptions:
    return TimeOptions(**({"columns": names} if len(names) > 1 else {"column": names[0]}), **more)


def _typed(layout: Layout, order: list[str], tried: list[str]) -> _Candidates:
    """Columns that the file types as time stamps."""
    for name in order:
        kind = layout.table[name].type
        if pa.types.is_timestamp(kind):
            zone, zoned = _zone(layout, (name,))
            if kind.tz:
                zone, zoned = "UTC", Reading("time zone", str(kind.tz), "the file states it")
            typed = Reading("time", name, "the file types it as time stamps")
            yield _options((name,), timezone=zone), (typed, zoned)
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
        yield _options(names, format="parts", timezone=zone), (named, zoned)


def _texts(layout: Layout, order: list[str]) -> _Candidates:
    """Text: date and time of day in one column, in two, or the time of day alone."""
    texts = {name: cells for name in layout.names if (cells := _cells(layout, name))}
    # Of several the one that states UTC, then the one whose name says time.
    order = sorted((name for name in order if name in texts), key=lambda n: zone_of(n) != "UTC")
    clocks = [n for n in order if _share(_CLOCK, texts[n]) > MOST]
    dates = [
        n for n in order if _share(_YEAR_FIRST, texts[n]) + _share(_YEAR_LAST, texts[n]) > MOST
    ]
    for names in [*((name,) for name in order), *product(dates, clocks)]:
        cells = [" ".join(parts) for parts in zip(*(texts[name] for name in names), strict=False)]
        zone, zoned = _zone(layout, names)
        if states_zone(cells[0]):
            zone, zoned = "UTC", Reading("time zone", "as each cell states", f"'{cells[0]}'")
        for pattern, dated in _patterns(layout, cells):
            named = Reading("time", ", ".join((*names, pattern)), f"'{cells[0]}'")
            yield _options(names, format=pattern, timezone=zone), (named, *dated, zoned)
    for clock in clocks:
        yield _clock_alone(layout, clock, texts[clock])


def _cells(layout: Layout, name: str) -> list[str]:
    """Cells of a text column, up to 600 of them over the whole file."""
    column = layout.table[name]
    if pa.types.is_date(column.type):
        column = column.cast(pa.string())
    if not is_text(column):
        return []
    picked = column.take(pa.array(np.arange(0, len(column), max(1, len(column) // 600))))
    return [cell.strip() for cell in picked.to_pylist() if cell is not None and cell.strip()]


def _share(pattern: re.Pattern[str], cells: list[str]) -> float:
    """Share of the cells that a pattern fits, by some fifty of them."""
    picked = cells[:: 1 + len(cells) // 50]
    return sum(bool(pattern.match(cell)) for cell in picked) / len(picked)


def _patterns(layout: Layout, cells: list[str]) -> Iterator[tuple[str, list[Reading]]]:
    """Formats of cells that hold date and time, with what the order of day and month rests on."""
    if _share(_ISO, cells) > MOST:
        yield "iso", []
    for pattern in _FURTHER:
        try:
            datetime.datetime.strptime(cells[0], pattern)
        except ValueError:
            continue
        yield pattern, []
    if _share(_BOTH, cells) > MOST:
        halves = [match for match in map(_BOTH.match, cells) if match]
        clock = _clock_pattern([half["clock"] for half in halves])
        for date, dated in _date_patterns(layout, [half["date"] for half in halves]):
            if clock is not None:
                yield f"{date}{halves[0]['sep']}{clock}", [dated]


def _date_patterns(layout: Layout, cells: list[str]) -> Iterator[tuple[str, Reading]]:
    """The pattern of dates; the order of day and month is decided by the data where they can."""
    if match := _YEAR_FIRST.match(cells[0]):
        yield f"%Y{match[2]}%m{match[2]}%d", Reading("date", "year, month, day", f"'{cells[0]}'")
    found = [match for match in map(_YEAR_LAST.match, cells) if match]
    if not found:
        return
    mark, year = found[0][2], "%Y" if len(found[0][4]) == 4 else "%y"
    first, second = ([int(match[number]) for match in found] for number in (1, 3))
    stated, where = _day(layout)
    changes = len(set(first)), len(set(second))
    rules = (
        (max(first) > 12, True, f"a month {max(first)} does not exist"),
        (max(second) > 12, False, f"a month {max(second)} does not exist"),
        (first == second and changes == (1, 1), True, "day and month are the same number"),
        (mark == ".", True, "dates with points have the day first"),
        (
            stated is not None and {stated.day, stated.month} == {first[0], second[0]},
            stated is not None and first[0] == stated.day,
            f"{where}: {stated}",
        ),
        # Within a trip midnight changes the day, not the month.
        (changes[0] != changes[1], changes[0] > changes[1], "the number that changes at midnight"),
        (True, True, "both numbers could be a month"),
    )
    number, (_, day_first, why) = next(each for each in enumerate(rules) if each[1][0])
    order = ("day", "month") if day_first else ("month", "day")
    other = "month, day, year" if number == len(rules) - 1 else ""
    pattern = mark.join([*("%d" if each == "day" else "%m" for each in order), year])
    yield pattern, Reading("date", ", ".join((*order, "year")), f"'{cells[0]}': {why}", other)


def _clock_pattern(cells: list[str]) -> str | None:
    """The pattern of times of day; None if there is none that reads all of them."""
    found = [match for match in map(_CLOCK.match, cells) if match]
    marks = {(match["f"] or "")[:1] for match in found}
    if len(marks) != 1 or max(int(match["h"]) for match in found) > 23:
        return None
    first, mark = found[0], marks.pop()
    blanks = {part: " " if (first[part] or "").startswith(" ") else "" for part in "pz"}
    pattern = "%I:%M" if first["p"] else "%H:%M"
    pattern += (":%S" if first["s"] else "") + (f"{mark}%f" if mark else "")
    pattern += f"{blanks['p']}%p" if first["p"] else ""
    return pattern + (f"{blanks['z']}%z" if first["z"] else "")


def _clock_alone(
    layout: Layout, name: str, cells: list[str]
) -> tuple[TimeOptions, tuple[Reading, ...]]:
    """A time of day without date, or elapsed time that begins at zero."""
    pattern = _clock_pattern(cells)
    begins_at_zero = bool(re.match(r"0+:00(?!.*M$)", cells[0], re.I))
    elapsed = begins_at_zero and bool({"elapsed", "laufzeit"} & set(words_of(name)))
    day, started = _started(layout)
    if pattern is None or elapsed or (begins_at_zero and started.alternative):
        why = f"'{cells[0]}' begins at zero"
        named = Reading("time", f"{name}, elapsed", why, "the time of day")
        return _options((name,), format="elapsed", start=_midnight(day)), (named, started)
    zone, zoned = _zone(layout, (name,))
    named = Reading("time", f"{name}, {pattern}", f"'{cells[0]}', without a date")
    options = _options((name,), format=pattern, date=day, timezone=zone)
    return options, (named, started, zoned)


def _midnight(day: datetime.date) -> datetime.datetime:
    return datetime.datetime.combine(day, datetime.time(), datetime.UTC)


def _started(layout: Layout) -> tuple[datetime.date, Reading]:
    """The day of the first row, and how it is known."""
    day, where = _day(layout)
    if day is not None:
        return day, Reading("day", day.isoformat(), where)
    why = "the file states no date; this day stands for one that is not known"
    other = "the day it was recorded: correct it in the profile"
    return UNKNOWN_DAY, Reading("day", UNKNOWN_DAY.isoformat(), why, other)


def _day(layout: Layout) -> tuple[datetime.date | None, str]:
    """The day that the lines above the header or the file's name state."""
    sources = {"the lines above the header": layout.preamble, "the file's name": layout.path.stem}
    for where, text in sources.items():
        for match in filter(None, (pattern.search(text) for pattern in _DAYS)):
            try:
                return datetime.date(*(int(match[part]) for part in "ymd")), f"{where} state it"
            except ValueError:
                continue
    return None, ""


def _epoch(layout: Layout, order: list[str]) -> _Candidates:
    """Counts since 1970."""
    for name in order:
        values = layout.number(name)
        known = values[np.isfinite(values)]
        for unit, nanoseconds in NANOSECONDS_PER.items():
            seconds = known * (nanoseconds / NANOSECONDS)
            if known.size >= 2 and EPOCHS[0] <= np.median(seconds) <= EPOCHS[1] and np.ptp(known):
                instant = datetime.datetime.fromtimestamp(seconds[0], datetime.UTC)
                why = f"counts {unit} since 1970: the first is {instant:%Y-%m-%d %H:%M:%S} UTC"
                counted = Reading("time", f"{name}, epoch [{unit}]", why)
                yield _options((name,), format="epoch", unit=unit), (counted,)


def _elapsed(layout: Layout, meanings: dict[str, Meaning], tried: list[str]) -> _Candidates:
    """Counts since the start."""
    for name in [n for n in layout.names if "clock" in meanings[n].quantities]:
        values = layout.number(name)
        steps = np.diff(values[np.isfinite(values)])
        # Of whole seconds several rows may have the same.
        if steps.size < 2 or np.mean(steps >= 0) < MOST or not np.any(steps > 0):
            continue
        step = float(np.median(steps[steps > 0]))
        stated = meanings[name].unit
        if stated in ("min", "h"):
            tried.append(f"'{name}' counts in {stated}, which a profile cannot read")
            continue
        # The longer unit goes first where a step is short for it.
        possible = [unit for unit, (low, high) in STEPS.items() if low <= step < high]
        if stated in STEPS:
            possible, why = [str(stated)], f"the name states {stated}"
        elif possible:
            why = f"rows lie {step:g} apart"
        else:
            continue
        day, started = _started(layout)
        options = _options((name,), format="elapsed", unit=possible[0], start=_midnight(day))
        counted = Reading("time", f"{name}, elapsed [{possible[0]}]", why, ", ".join(possible[1:]))
        yield options, (counted, started)


def _zone(layout: Layout, names: tuple[str, ...]) -> tuple[str, Reading]:
    """The zone of times that name no offset."""
    stated = [zone_of(text) for text in (*names, layout.preamble)]
    zone = next((each for each in stated if each is not None), None)
    language = language_of(layout.names) or ""
    guess = {"de": "Europe/Berlin", "fr": "Europe/Paris"}.get(language, "UTC")
    if zone == "local":
        why = "the name states local time; which one is guessed by the language of the columns"
        return guess, Reading("time zone", guess, why, "another zone: correct it in the profile")
    if zone is not None:
        return zone, Reading("time zone", zone, "the name states it")
    why = "the file does not state a zone"
    where = "Europe/London" if guess == "UTC" else guess
    other = f'local time, such as timezone = "{where}" (a guess): correct it in the profile'
    return "UTC", Reading("time zone", "UTC", why, other)

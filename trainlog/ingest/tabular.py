"""Formats ``csv``, ``parquet`` and ``mdf``: columns of any layout, described by a profile.

A table becomes columns of text (Parquet: of its own types), each row with its number in the file.

Measurement files of ASAM MDF are read by asammdf (extra ``recorders``). A channel of a name that
several groups have is written ``"2:Speed"``, with the number of its group. A column without a unit
takes the channel's own. Groups with clocks of their own become tables of their own, but for those
that hold fields of the same topic: these share a table with the instants of all.
"""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from trainlog.arrays import IntArray
from trainlog.errors import InputError, suggestion
from trainlog.formats.files import read_bytes
from trainlog.formats.trip_tables import called, opened_mdf
from trainlog.ingest.mapping import EARLIEST, LATEST, recording_of, undescribed, wanted_columns
from trainlog.ingest.profile import WORDS, Column, FileOptions, MismatchError, Profile
from trainlog.ingest.recording import (
    MOST,
    NO_TIME,
    SELDOM,
    Cells,
    Finding,
    Raw,
    Recording,
    field_of,
    together,
)
from trainlog.topics import RECORDED
from trainlog.units import NANOSECONDS, factor, si_unit

HABIT, FEWEST_WHOLE = 0.2, 2
"""Share of rows from which on those that end early at one cell are how the recorder writes, where
more rows than so many have all cells."""

LINE_FEED, QUOTE, BLANK = b'\n" '

UTF8_MARK = b"\xef\xbb\xbf"

DELIMITER_REMEDY = "check delimiter under [file] of the profile"


@dataclass
class Parsed:
    """Columns that were split into cells, and the rows that do not fit.

    Attributes
    ----------
    table : pyarrow.Table
    ragged : list of int
        Rows of the body with another number of cells.
    cells : list of int
        How many they have.
    """

    table: pa.Table = field(default_factory=lambda: pa.table({}))
    ragged: list[int] = field(default_factory=list)
    cells: list[int] = field(default_factory=list)

    def pass_over(self, row: pa.csv.InvalidRow) -> str:
        """Take note of a row that does not fit; what pyarrow is to do with it."""
        self.ragged.append(row.number - 1)
        self.cells.append(row.actual_columns)
        return "skip"


@dataclass(frozen=True, eq=False)
class TextFile:
    """A delimited text file whose header has been read.

    Attributes
    ----------
    options : FileOptions
    names : tuple of str
        Names of the columns.
    header : int
        Row of the header; 0 if there is none.
    body : bytes
        The rows of data, UTF-8, without comments and empty lines.
    rows : (n,) int64 array
        Row of the file for each row of the body.
    named : int
        How many columns there are up to the last that has a name or, in the first row, a value.
    """

    options: FileOptions
    names: tuple[str, ...]
    header: int
    body: bytes
    rows: IntArray
    named: int

    def cells(self, wanted: Iterable[str]) -> Cells:
        """The columns called `wanted`, as text; missing values are null.

        Raises
        ------
        InputError
            If columns are missing or come twice, or too many rows do not fit the header.
        """
        names = list(dict.fromkeys(wanted))
        problems = [found for name in names if (found := self._problem(name)) is not None]
        if problems:
            # Of a single column the delimiter is wrong, whatever is missing.
            alone = len(self.names) == 1
            kind = MismatchError if type(problems[0]) is MismatchError else InputError
            raise kind.listing(problems[:1] if alone else problems)
        parsed, cut = self._parsed(self.body, names), np.zeros(0, dtype=np.int64)
        short = 0 if parsed is None else sum(count < self.named for count in parsed.cells)
        # A few rows that were cut off need no second look.
        if parsed is None or short < len(parsed.ragged) or short > HABIT * self.rows.size:
            body, cut = self._evened()
            parsed = self._parsed(body, names)
        if parsed is None:
            raise InputError("cannot be split into rows and cells", remedy=self._delimiter_remedy())
        ragged = np.union1d(np.array(parsed.ragged, dtype=np.int64), cut)
        if ragged.size > MOST * self.rows.size:
            raise self._misfit(parsed, ragged.size)
        if not ragged.size:
            return Cells(parsed.table, self.rows, self.rows.size)
        table, rows = parsed.table, self.rows[ragged]
        if cut.size:
            fits = np.delete(np.arange(self.rows.size), parsed.ragged)
            table = table.filter(pa.array(~np.isin(fits, cut)))
        return Cells(
            table,
            np.delete(self.rows, ragged),
            self.rows.size,
            tuple(Finding.met("truncated_rows", rows)),
            Raw.lines("truncated_rows", rows, self._lines(ragged)),
        )

    def _lines(self, numbers: Iterable[int]) -> list[str]:
        """The text of the numbered rows of the body, in their order there."""
        wanted = set(numbers)
        every = enumerate(io.BytesIO(self.body))
        lines = (line for row, line in every if row in wanted)
        return [line.removesuffix(b"\n").decode("utf-8", errors="replace") for line in lines]

    def _evened(self) -> tuple[bytes, IntArray]:
        """The body with a cell for each column in all rows that hold every named one.

        Empty cells beyond these are taken away, or added. Rows that have fewer cells than others,
        as more than a share `HABIT` of all rows have, end at their last value: what is missing is
        empty. Also rows that have all named cells, but fewer empty ones than usual, as no more than
        `SELDOM` of the rows have: they were cut off, perhaps within their last cell.
        """
        body, mark, named = self.body, ord(self.options.delimiter), self.named
        buffer = np.frombuffer(body if body.endswith(b"\n") else body + b"\n", dtype=np.uint8)
        ends = np.flatnonzero(buffer == LINE_FEED)
        starts = np.append(0, ends[:-1] + 1)
        marks = np.flatnonzero(buffer == mark)
        quotes = np.flatnonzero(buffer == QUOTE)
        if quotes.size:
            # Delimiters between quotation marks of a row part no cells.
            row, first = np.searchsorted(ends, marks), np.searchsorted(quotes, starts)
            single = np.diff(first, append=quotes.size) % 2 == 1
            opened = np.searchsorted(quotes, marks) - first[row]
            marks = marks[single[row] | (opened % 2 == 0)]
        before = np.searchsorted(marks, starts)
        cells = np.searchsorted(marks, ends) - before + 1
        more = np.flatnonzero(cells > named)
        last, full = ends.copy(), ends.copy()
        last[more] = marks[before[more] + named - 1]
        while more.size:
            more = more[np.isin(buffer[full[more] - 1], (mark, BLANK))]
            full[more] -= 1
            more = more[full[more] > last[more]]
        whole = (cells > named) & (full <= last)
        counts = np.bincount(cells[whole | (cells == named)])
        usual = int(np.argmax(counts)) if counts.size else named
        seldom = np.flatnonzero(counts <= SELDOM * ends.size)
        short = (cells >= named) & (cells < usual) & np.isin(cells, seldom)
        cells[whole] = named
        counts = np.bincount(cells, minlength=named + 1)
        habit = (counts > HABIT * ends.size) & (counts[named] > FEWEST_WHOLE)
        left_out = (cells < named) & habit[cells]
        short &= not left_out.any()
        filled = left_out | (cells >= named) & (cells < len(self.names))
        # One is added wherever a row's kept part ends or its dropped part does.
        change = np.zeros(buffer.size + 1, dtype=np.int8)
        change[last[whole]] += 1
        change[ends[whole]] -= 1
        kept = np.cumsum(change[:-1], dtype=np.int8) == 0
        places = np.repeat(ends[filled], len(self.names) - cells[filled])
        evened = np.insert(buffer, places, mark)[np.insert(kept, places, True)]
        return evened.tobytes(), np.flatnonzero(short)

    def _parsed(self, body: bytes, wanted: list[str]) -> Parsed | None:
        """The named columns of the body and the rows that do not fit; None if that cannot be."""
        # A single quotation mark swallows line ends: then it is no more than a character.
        return self._parsed_once(body, wanted, '"') or self._parsed_once(body, wanted, False)

    def _parsed_once(
        self, body: bytes, wanted: list[str], quote: str | Literal[False]
    ) -> Parsed | None:
        """As `_parsed`; None if lines and rows do not correspond."""
        found = Parsed()
        try:
            found.table = pa.csv.read_csv(
                pa.BufferReader(body),
                # Without threads the handler is given the number of the row.
                read_options=pa.csv.ReadOptions(column_names=self.names, use_threads=False),
                parse_options=pa.csv.ParseOptions(
                    delimiter=self.options.delimiter,
                    quote_char=quote,
                    invalid_row_handler=found.pass_over,
                ),
                convert_options=pa.csv.ConvertOptions(
                    include_columns=wanted,
                    column_types=dict.fromkeys(wanted, pa.string()),
                    null_values=list(self.options.missing),
                    strings_can_be_null=True,
                    quoted_strings_can_be_null=True,
                ),
            )
        except pa.ArrowException:
            return None
        if found.table.num_rows + len(found.ragged) != self.rows.size:
            return None
        return found

    def _misfit(self, parsed: Parsed, count: int) -> InputError:
        """That too many rows do not fit the header, and why."""
        first = parsed.ragged[0] if parsed.ragged else 0
        usual, often = Counter(parsed.cells).most_common(1)[0]
        each = f"{usual} cells" if often == count else f"{usual} cells in {often} of them"
        remedy = self._delimiter_remedy()
        names = f"{self.named} columns" if self.header else f"{self.named} cells"
        if remedy == DELIMITER_REMEDY and usual > self.named:
            comma = self.options.delimiter == "," and usual >= 2 * self.named - 2
            remedy = (
                "are the numbers written with a decimal comma? Then the file needs another"
                " delimiter; write it with semicolons"
                if comma
                else f"name the {usual - self.named} columns that the header does not name, or"
                " set header under [file] of the profile"
            )
        elif remedy == DELIMITER_REMEDY and usual > 1:
            remedy = (
                f"the last name is '{self.names[self.named - 1]}', the first such row is"
                f" {self._lines([first])[0][:60]!r}: remove the {self.named - usual} names"
                " without a cell, or set header under [file] of the profile"
            )
        source = f"the header of row {self.header}" if self.header else "the first row"
        return InputError(
            f"{count} of {self.rows.size} rows do not fit {source}: it has {names}, they have"
            f" {each}",
            place=f"row {self.rows[first]}",
            remedy=remedy,
        )

    def _problem(self, name: str) -> InputError | None:
        """Why a column cannot be read by its name."""
        count = self.names.count(name)
        if count == 1:
            return None
        place = f"row {self.header}, the header" if self.header else None
        if count > 1:
            return InputError(
                f"column '{name}' comes {count} times",
                place=place,
                remedy="rename all but one of them in the file",
            )
        if name in self.options.aliases:
            spellings = self.options.aliases[name]
            return MismatchError(
                f"no column of the {name}",
                place=place,
                remedy=f"expected one called {' or '.join(spellings)}",
            )
        alone = len(self.names) == 1
        return MismatchError(
            f"no column '{name}'",
            place=place,
            remedy=self._delimiter_remedy() if alone else suggestion(name, self.names, "columns"),
        )

    def _delimiter_remedy(self) -> str:
        line = ",".join(self.names) if self.options.delimiter == "," else self.names[0]
        sample = line + self.body[:2000].decode("utf-8", errors="ignore")
        others = [mark for mark in ";\t|," if mark != self.options.delimiter]
        likely = max(others, key=sample.count)
        if sample.count(likely) > sample.count(self.options.delimiter):
            return f"set delimiter = {json.dumps(likely)} under [file] of the profile"
        return DELIMITER_REMEDY


def open_text(path: Path, options: FileOptions) -> TextFile:
    """Read a delimited text file up to its header.

    Raises
    ------
    InputError
        If the file is missing, empty, binary, in another encoding, or holds no row of data.
    """
    data = _utf8(read_bytes(path), options.encoding)
    start, header = _header_line(data, options)
    end = data.find(b"\n", start)
    line = data[start:] if end < 0 else data[start:end]
    names = _split(line, options.delimiter) if header else ()
    # Skip what stands between the header and the data.
    first_row = header + 1
    position = (len(data) if end < 0 else end + 1) if header else start
    for _ in range(options.skip_after_header):
        end = data.find(b"\n", position)
        position = len(data) if end < 0 else end + 1
        first_row += 1
    body, rows = _data_lines(data, position, first_row, options.comment)
    if not rows.size:
        raise InputError(
            "has no row of data" + (", only its header" if header else ""),
            place=f"row {header}" if header else None,
            remedy="record again; was the recorder stopped at once?",
        )
    first = _split(io.BytesIO(body).readline(), options.delimiter)
    # Columns without a name may hold values.
    used = [name or cell for name, cell in zip_longest(names, first[: len(names) or None])]
    named = max((number for number, text in enumerate(used, start=1) if text), default=0)
    if not header:
        names = tuple(str(number) for number in range(1, len(first) + 1))
    # Delimiters at the end of the header, of the rows of data or of both make no columns.
    if not any(names[len(first) :]) and not any(first[len(names) :]):
        names = (*names, *[""] * (len(first) - len(names)))[: max(len(first), named)]
    return TextFile(options, options.named(names), header, body, rows, named)


def _utf8(data: bytes, encoding: str) -> bytes:
    """The file's text as UTF-8, without byte order mark, each line ended by a line feed."""
    codec = encoding.lower().replace("_", "-")
    wide = codec.startswith(("utf-16", "utf-32", "utf16", "utf32"))
    if not wide and data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(
            f"is not {encoding} text: it begins with the mark of UTF-16",
            place="byte 0",
            remedy='set encoding = "utf-16" under [file] of the profile',
        )
    data = plain_text(data, "give the recorder's CSV, not its binary file", wide=wide)
    marked = not wide and data.startswith(UTF8_MARK)
    if marked:
        # The file states its encoding; recorders of one layout differ in it.
        encoding = "utf-8"
    try:
        if marked or codec in ("utf-8", "utf8", "utf-8-sig", "ascii"):
            data.decode("ascii" if codec == "ascii" and not marked else "utf-8")
            text = data.removeprefix(UTF8_MARK)
        else:
            text = data.decode(encoding).removeprefix("\ufeff").encode()
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"is not {encoding} text: byte 0x{data[error.start]:02x} cannot be read",
            place=f"row {row}, byte {error.start}",
            remedy='set encoding under [file] of the profile, for example "cp1252"',
        ) from error
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text


def plain_text(data: bytes, remedy: str, *, wide: bool = False) -> bytes:
    """A text without the zeros that a power cut leaves where there was no time for data.

    Parameters
    ----------
    data : bytes
    remedy : str
        Where it holds other zeros.
    wide : bool
        Whether its letters are of several bytes, so that zeros are text.

    Raises
    ------
    InputError
        If nothing is left, or it is not text.
    """
    if not wide:
        data = data.rstrip(b"\0")
    if not data or data.isspace():
        raise InputError("is empty", remedy="was the recorder stopped at once?")
    if not wide and b"\0" in data:
        raise InputError(
            "is not text: it holds zero bytes", place=f"byte {data.index(0)}", remedy=remedy
        )
    return data


def _header_line(data: bytes, options: FileOptions) -> tuple[int, int]:
    """Where the header starts, and its row; row 0 if there is none."""
    if options.header == 0:
        return 0, 0
    position, row = 0, 1
    comment = options.comment.encode()
    while position < len(data):
        begin = data[position : position + 1]
        wanted = options.header == row if options.header else begin not in (b"\n", comment)
        if wanted:
            return position, row
        end = data.find(b"\n", position)
        if end < 0:
            break
        position, row = end + 1, row + 1
    raise InputError(
        f"has no row {options.header} for the header" if options.header else "has no header",
        place=f"row {row}",
        remedy="check header under [file] of the profile",
    )


def _split(line: bytes, delimiter: str) -> tuple[str, ...]:
    cells = next(csv.reader([line.decode("utf-8")], delimiter=delimiter), [])
    return tuple(cell.strip() for cell in cells)


def _data_lines(data: bytes, position: int, first_row: int, comment: str) -> tuple[bytes, IntArray]:
    """The lines from `position` on that hold data, and the row of the file for each."""
    body = data[position:]
    mark = comment.encode()
    unclean = body[:1] in (b"\n", mark) or b"\n\n" in body or (mark and b"\n" + mark in body)
    if not unclean:
        count = body.count(b"\n") + (bool(body) and not body.endswith(b"\n"))
        return body, first_row + np.arange(count, dtype=np.int64)
    buffer = np.frombuffer(body, dtype=np.uint8)
    ends = np.flatnonzero(buffer == ord("\n")) + 1
    starts = np.concatenate(([0], ends))
    starts = starts[starts < buffer.size]
    lengths = np.diff(np.append(starts, buffer.size))
    passed_over = [ord("\n"), *mark]
    kept = ~np.isin(buffer[starts], passed_over)
    clean = buffer[np.repeat(kept, lengths)].tobytes()
    return clean, first_row + np.flatnonzero(kept)


def is_delimited(head: bytes) -> bool:
    """Whether a file may be delimited text: no zero bytes, or the byte order mark of UTF-16."""
    return head[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" not in head.rstrip(b"\0")


def read_delimited(path: Path, profile: Profile | None) -> Recording:
    """Read delimited text as `profile` describes it.

    Raises
    ------
    InputError
        If there is no profile, or the file does not fit it.
    """
    if profile is None:
        raise undescribed("is text of a layout that trainlog does not know")
    text = open_text(path, profile.file)
    cells = text.cells(wanted_columns(profile, text.names))
    return recording_of(cells, profile, columns=text.names)


MAGIC = b"PAR1"


def is_parquet(head: bytes) -> bool:
    """Whether a file begins as Parquet does."""
    return head.startswith(MAGIC)


def read_parquet(path: Path, profile: Profile | None) -> Recording:
    """Read a Parquet table as `profile` describes it; its rows count from 1.

    Raises
    ------
    InputError
        If there is no profile, the file is damaged, or does not fit the profile.
    """
    if profile is None:
        raise undescribed("is a Parquet table of a layout that trainlog does not know")
    data = pa.BufferReader(read_bytes(path))
    with readable_parquet():
        names = tuple(pa.parquet.read_schema(data).names)
        wanted = list(dict.fromkeys(wanted_columns(profile, names)))
        problems = [
            MismatchError(f"no column '{name}'", remedy=suggestion(name, names, "columns"))
            for name in wanted
            if name not in names
        ]
        if problems:
            raise MismatchError.listing(problems)
        data.seek(0)
        table = pa.parquet.read_table(data, columns=wanted)
    if not table.num_rows:
        raise InputError("has no row of data", remedy="record again")
    rows = np.arange(1, table.num_rows + 1, dtype=np.int64)
    return recording_of(Cells(table, rows, rows.size), profile, columns=names)


@contextmanager
def readable_parquet() -> Iterator[None]:
    """InputError where what is read of a Parquet table is damaged."""
    try:
        yield
    except (pa.ArrowException, OSError) as error:
        raise InputError(
            f"is not a readable Parquet table: {str(error).splitlines()[0][:120]}",
            remedy="copy the file again; was the recorder stopped while writing?",
        ) from error


# ------------------------------------------------------------------------------ measurement files


UNITS = {
    "°C": "degC",
    "C": "degC",
    "°": "deg",
    "°/s": "deg/s",
    "g": "standard_gravity",
    "m/s2": "m/s^2",
    "m/s²": "m/s^2",
    "kmh": "km/h",
    "km/std": "km/h",
}
"""How measurement files spell units that `trainlog.units` spells otherwise."""

LONGEST = 1e8
"""Time since the start [s], three years, beyond which it is no time."""

Place = tuple[int, int]
"""Number of a group, and of a channel in it."""


def is_mdf(head: bytes) -> bool:
    """Whether a file begins as MDF does; also if it was not finished."""
    return head.startswith((b"MDF     ", b"UnFinMF "))


def read_mdf(path: Path, profile: Profile | None) -> Recording:
    """Read the channels that `profile` maps.

    Raises
    ------
    InputError
        If there is no profile, asammdf is not installed or cannot read the file, a channel is
        missing, or its unit cannot be read.
    """
    if profile is None or not profile.columns:
        raise undescribed(
            "is a measurement file whose channels may mean anything",
            "that says which channel is what",
        )
    with opened_mdf(path) as mdf:
        start = _start(mdf, profile)
        places = _places(mdf, profile)
        every = {
            (group, index): channel.name
            for group, held in enumerate(mdf.groups)
            for index, channel in enumerate(held.channels)
            if mdf.masters_db.get(group) != index
        }
        found = [_recording(mdf, profile, part, start, path) for part in _parts(profile, places)]
    mapped = {place for channels in places.values() for place in channels}
    left = [name for place, name in every.items() if place not in mapped]
    others = f"channels that the profile does not map: {', '.join(left)}"
    return together(found, metadata={"clock": "MDF"}, not_used={others: len(left)} if left else {})


def _start(mdf: Any, profile: Profile) -> int:
    """Instant of the file's time 0 [ns]."""
    given = profile.time.start if profile.time is not None else None
    start = pd.Timestamp(mdf.header.start_time if given is None else given)
    start = start.tz_localize("UTC") if start.tzinfo is None else start
    if not EARLIEST <= start.value < LATEST:
        raise InputError(
            f"states that it was started at {start}",
            remedy="give the start: [time] column = 'time', format = 'elapsed', start = ...",
        )
    return int(start.value)


def _places(mdf: Any, profile: Profile) -> dict[str, list[Place]]:
    """Where the channels of each field are."""
    found: dict[str, list[Place]] = {}
    for name, column in profile.columns.items():
        if column.value is not None:
            continue
        places = [_place(mdf, channel, column.optional) for channel in column.names]
        if None not in places:
            found[name] = [place for place in places if place is not None]
    if not found:
        raise InputError("holds none of the channels", remedy="check [columns]")
    return found


def _place(mdf: Any, channel: str, optional: bool) -> Place | None:
    number, mark, plain = channel.partition(":")
    known = mdf.channels_db
    if mark and number.isdigit() and channel not in known:
        among = [place for place in known.get(plain, ()) if place[0] == int(number)]
    else:
        among = list(known.get(channel, ()))
    if len(among) == 1:
        return int(among[0][0]), int(among[0][1])
    if among:
        shown = " or ".join(f"'{group}:{plain or channel}'" for group, _ in among)
        raise InputError(f"channel '{channel}' is in {len(among)} groups", remedy=f"write {shown}")
    if optional:
        return None
    raise MismatchError(f"no channel '{channel}'", remedy=suggestion(channel, known, "channels"))


_Part = dict[str, list[Place]]
"""Fields that share a table, and where their channels are."""


def _parts(profile: Profile, places: dict[str, list[Place]]) -> list[_Part]:
    """Fields by table: those of a group together, and those of a topic."""
    parts: list[tuple[set[str], _Part]] = []
    for name, channels in places.items():
        keys = {field_of(name)[0].name, *(f"group {group}" for group, _ in channels)}
        mine = {name: channels}
        apart = []
        for known, fields in parts:
            if known & keys:
                keys |= known
                mine = fields | mine
            else:
                apart.append((known, fields))
        parts = [*apart, (keys, mine)]
    return [
        {name: fields[name] for name in profile.columns if name in fields} for _, fields in parts
    ]


def _recording(mdf: Any, profile: Profile, part: _Part, start: int, path: Path) -> Recording:
    """The recording of the channels of one table."""
    signals: dict[str, Any] = {}
    columns: dict[str, Column] = {
        name: column for name, column in profile.columns.items() if column.value is not None
    }
    for name, places in part.items():
        column = profile.columns[name]
        wanted = [(None, group, index) for group, index in places]
        # The numbers of a code, unless it is words that are wanted.
        numbers = name not in WORDS
        select = partial(mdf.select, wanted, ignore_value2text_conversions=numbers)
        read = list(called(path, select))
        channels = tuple(f"{group}:{index}" for group, index in places)
        signals |= dict(zip(channels, read, strict=True))
        columns[name] = _with_unit(name, column, read[0], channels)
    groups = sorted({group for places in part.values() for group, _ in places})
    clocks = {group: _clock(signals, group, start) for group in groups}
    time, rows = _instants(clocks)
    table = pa.table(
        {
            key: _cells(signal, rows[int(key.split(":")[0])], time.size)
            for key, signal in signals.items()
        }
    )
    cells = Cells(table, np.arange(1, time.size + 1, dtype=np.int64), time.size)
    mapped = replace(profile, columns=columns, time=None)
    found = recording_of(cells, mapped, time)
    # A channel has no value between its own instants: that is no empty cell.
    findings = (
        found.findings
        if len(groups) == 1
        else tuple(finding for finding in found.findings if finding.rule != "empty")
    )
    return replace(found, findings=findings)


def _clock(signals: dict[str, Any], group: int, start: int) -> IntArray:
    """Time of a group's samples [ns]; `NO_TIME` where the file holds none."""
    key = next(key for key in signals if key.startswith(f"{group}:"))
    seconds = np.asarray(signals[key].timestamps, dtype=np.float64)
    sane = np.abs(seconds) < LONGEST  # False for NaN
    since = np.round(np.where(sane, seconds, 0.0) * NANOSECONDS).astype(np.int64)
    return np.where(sane, start + since, NO_TIME)


def _instants(clocks: dict[int, IntArray]) -> tuple[IntArray, dict[int, IntArray]]:
    """The instants of a table [ns], and at which of them the samples of each group stand."""
    if len(clocks) == 1:
        ((group, time),) = clocks.items()
        return time, {group: np.arange(time.size, dtype=np.int64)}
    if all(np.all(np.diff(time) > 0) for time in clocks.values()):
        union = np.unique(np.concatenate(list(clocks.values())))
        return union, {group: np.searchsorted(union, time) for group, time in clocks.items()}
    # A clock that stands or runs back: every sample is kept, the rules of repair do the rest.
    every = np.concatenate(list(clocks.values()))
    order = np.argsort(every, kind="stable")
    place = np.empty(every.size, dtype=np.int64)
    place[order] = np.arange(every.size)
    edges = np.cumsum([0, *(time.size for time in clocks.values())])
    return every[order], {
        group: place[a:b] for group, a, b in zip(clocks, edges[:-1], edges[1:], strict=True)
    }


def _cells(signal: Any, rows: IntArray, count: int) -> pa.Array:
    """The samples of a channel, put at their instants."""
    samples = np.asarray(signal.samples)
    if samples.ndim != 1 or samples.dtype.fields is not None:
        raise InputError(
            f"channel '{signal.name}' holds {samples.ndim}-dimensional samples",
            remedy="map a channel with one value a sample",
        )
    absent = np.ones(count, dtype=np.bool_)
    absent[rows] = False
    if signal.invalidation_bits is not None:
        absent[rows] = np.asarray(signal.invalidation_bits, dtype=np.bool_)
    if samples.dtype.kind in "SUO":
        text = np.full(count, "", dtype=object)
        text[rows] = [
            word.decode(signal.encoding or "utf-8", "replace") if isinstance(word, bytes) else word
            for word in samples
        ]
        return pa.array(text, pa.string(), mask=absent)
    values = np.zeros(count, dtype=np.float64)
    values[rows] = samples
    return pa.array(values, pa.float64(), mask=absent)


def _with_unit(name: str, column: Column, signal: Any, channels: tuple[str, ...]) -> Column:
    """The column by the places of its channels, in the channel's own unit if it names none."""
    unit = column.unit
    item = column.field(name)
    if unit is None and name.startswith(RECORDED):
        unit = str(signal.unit or "").strip()
        unit = UNITS.get(unit, unit)
        si_unit(unit)
    elif unit is None and item.unit not in ("", "1"):
        stated = str(signal.unit or "").strip()
        unit = UNITS.get(stated, stated)
        try:
            factor(unit or "1", item.unit)
        except InputError as error:
            raise InputError(
                f"channel '{signal.name}' has the unit '{stated}',"
                f" which does not convert to {item.unit}",
                place=f"field {name}",
                remedy="give its unit in the profile",
            ) from error
    places: dict[str, Any] = {"columns": channels} if column.columns else {"column": channels[0]}
    return replace(column, unit=unit, optional=False, **places)

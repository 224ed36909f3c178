"""How an unknown table is written: encoding, delimiter, decimal mark, header, units, missing words.

Nothing here knows what the columns mean. A library that guesses (csv.Sniffer, charset detection)
would guess from letters; a recorder's file is decided by its numbers: the delimiter is the one that
leaves the most cells which are numbers or times, in rows of equal length.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.formats.files import read_bytes
from trainlog.ingest.mapping import THOUSANDS, grouped, numbers
from trainlog.ingest.profile import MISSING, Decimal, FileOptions
from trainlog.ingest.proposal.vocabulary import unit_of
from trainlog.ingest.tabular import is_parquet, open_text

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
    r"^-?(9{3,6}([.,]9+|[.,]0+)?|327(67|68)|3276[,.]7|655(35|34)|6553[,.]5|655[,.]35|327[,.]67)$"
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


def looks_like_table(head: bytes, path: Path) -> bool:
    r"""Whether the beginning of a text is rows of cells most of which are numbers or times.

    Examples
    --------
    >>> looks_like_table(b"t;v\n0;1\n1;2\n2;3\n3;4\n", Path("a.txt"))
    True
    >>> looks_like_table(b"Words, and more words.\nAnd so on, for some.\nAnd on.\n", Path("b.txt"))
    False
    """
    try:
        _, text, _ = _decoded(path, head)
        _separators(path, _sample(text.splitlines()))
    except InputError:
        return False
    return True


def _parquet_layout(path: Path, data: bytes) -> Layout:
    try:
        table = pa.parquet.read_table(pa.BufferReader(data))
    except (pa.ArrowException, OSError) as error:
        raise InputError(
            f"is not a readable Parquet table: {str(error).splitlines()[0][:120]}",
            file=path,
            remedy="copy the file again; was the recorder stopped while writing?",
        ) from error
    names = tuple(str(name) for name in table.schema.names)
    fields = [table.schema.field(name).metadata or {} for name in names]
    units = tuple(
        unit_of(each.get(b"unit", b"").decode("utf-8", "ignore")) or "" for each in fields
    )
    rows = np.arange(1, table.num_rows + 1, dtype=np.int64)
    known = Reading("file", "Parquet", f"{len(names)} columns, {table.num_rows:,} rows")
    return Layout(path, "parquet", FileOptions(), names, units, table, rows, "", (known,))


def _text_layout(path: Path, data: bytes) -> Layout:
    encoding, text, why = _decoded(path, data)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    sample = _sample(lines)
    delimiter, decimal, width, judged = _separators(path, sample)
    if delimiter == decimal:
        raise InputError(
            "has commas between its cells and in its numbers, which a profile cannot part",
            file=path,
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


def _decoded(path: Path, data: bytes) -> tuple[str, str, str]:
    """The encoding, the text, and why."""
    head = data[:4096]
    codec, why = "utf-8", "valid UTF-8"
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        codec, why = "utf-16", "its byte order mark"
    elif head.count(b"\0") > len(head) // 3:
        codec = "utf-16-le" if head[1:2] == b"\0" else "utf-16-be"
        why = "every other byte is zero"
    else:
        data = data.rstrip(b"\0")
        why = "ASCII" if data.isascii() else why
        if not data.strip():
            raise InputError("is empty", file=path, remedy="was the recorder stopped at once?")
        if b"\0" in data:
            raise InputError(
                "is not text: it holds zero bytes",
                file=path,
                place=f"byte {data.index(0)}",
                remedy="give the recorder's table, not its binary file",
            )
    try:
        return codec, data.decode(codec).removeprefix("\ufeff"), why
    except UnicodeDecodeError as error:
        if codec != "utf-8":
            raise InputError(
                f"is not {codec} text",
                file=path,
                place=f"byte {error.start}",
                remedy="copy it again",
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


def _separators(path: Path, sample: list[str]) -> tuple[str, Decimal, int, str]:
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
            file=path,
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

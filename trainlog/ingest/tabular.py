"""Formats ``csv`` and ``parquet``: tables of any layout, described by a profile.

A file becomes columns of text (Parquet: of its own types), each row with its number in the file.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from trainlog.errors import InputError
from trainlog.formats.files import read_bytes
from trainlog.ingest.mapping import recording_of, wanted_columns
from trainlog.ingest.profile import FileOptions, MismatchError, Profile, suggestion
from trainlog.ingest.recording import SHOWN_ROWS, Cells, Finding, IntArray, Raw, Recording

MAX_RAGGED = 0.5
"""Share of rows with the wrong number of cells beyond which the delimiter is doubted."""


@dataclass(frozen=True, eq=False)
class TextFile:
    """A delimited text file whose header has been read.

    Attributes
    ----------
    path : Path
    options : FileOptions
    names : tuple of str
        Names of the columns.
    header : int
        Row of the header; 0 if there is none.
    body : bytes
        The rows of data, UTF-8, without comments and empty lines.
    rows : (n,) int64 array
        Row of the file for each row of the body.
    """

    path: Path
    options: FileOptions
    names: tuple[str, ...]
    header: int
    body: bytes
    rows: IntArray

    def cells(self, wanted: Iterable[str]) -> Cells:
        """The columns called `wanted`, as text; missing values are null.

        Raises
        ------
        InputError
            If a column is missing or comes twice, or too many rows do not fit the header.
        """
        names = list(dict.fromkeys(wanted))
        for name in names:
            self._check(name)
        parsed = self._parsed(names, quotes=True)
        if parsed is None:
            # A single quotation mark swallowed line ends: then it is no more than a character.
            parsed = self._parsed(names, quotes=False)
        if parsed is None:
            raise InputError(
                "cannot be split into rows and cells",
                file=self.path,
                remedy=self._delimiter_remedy(),
            )
        table, ragged, found, lines = parsed
        if ragged.size > MAX_RAGGED * self.rows.size:
            raise InputError(
                f"{ragged.size} of {self.rows.size} rows do not have the header's"
                f" {len(self.names)} cells, the first has {found}",
                file=self.path,
                place=f"row {self.rows[ragged[0]]}",
                remedy=self._delimiter_remedy(),
            )
        first = tuple(int(row) for row in self.rows[ragged[:SHOWN_ROWS]])
        findings = (Finding("truncated_rows", ragged.size, first),) if ragged.size else ()
        raw = Raw("truncated_rows", "", self.rows[ragged], np.array(lines, dtype=np.object_))
        return Cells(
            table,
            np.delete(self.rows, ragged),
            self.rows.size,
            findings,
            (raw,) if ragged.size else (),
        )

    def _parsed(
        self, names: list[str], *, quotes: bool
    ) -> tuple[pa.Table, IntArray, int, list[str]] | None:
        """The named columns, the rows that do not fit, how many cells the first has, their text.

        None if lines and rows do not correspond.
        """
        ragged: list[int] = []
        lines: list[str] = []
        cells_found: list[int] = [0]

        def pass_over(row: pa.csv.InvalidRow) -> str:
            ragged.append(row.number - 1)
            lines.append(row.text or "")
            cells_found.append(row.actual_columns)
            return "skip"

        try:
            table = pa.csv.read_csv(
                pa.BufferReader(self.body),
                # Without threads the handler is given the number of the row.
                read_options=pa.csv.ReadOptions(column_names=self.names, use_threads=False),
                parse_options=pa.csv.ParseOptions(
                    delimiter=self.options.delimiter,
                    quote_char='"' if quotes else False,
                    invalid_row_handler=pass_over,
                ),
                convert_options=pa.csv.ConvertOptions(
                    include_columns=names,
                    column_types=dict.fromkeys(names, pa.string()),
                    null_values=list(self.options.missing),
                    strings_can_be_null=True,
                    quoted_strings_can_be_null=True,
                ),
            )
        except pa.ArrowException:
            return None
        if table.num_rows + len(ragged) != self.rows.size:
            return None
        return table, np.array(ragged, dtype=np.int64), cells_found[min(1, len(ragged))], lines

    def _check(self, name: str) -> None:
        count = self.names.count(name)
        if count == 1:
            return
        place = f"row {self.header}, the header" if self.header else None
        if count > 1:
            raise InputError(
                f"column '{name}' comes {count} times",
                file=self.path,
                place=place,
                remedy="rename all but one of them in the file",
            )
        if name in self.options.aliases:
            spellings = self.options.aliases[name]
            raise MismatchError(
                f"no column of the {name}",
                file=self.path,
                place=place,
                remedy=f"expected one called {' or '.join(spellings)}",
            )
        alone = len(self.names) == 1
        raise MismatchError(
            f"no column '{name}'",
            file=self.path,
            place=place,
            remedy=self._delimiter_remedy() if alone else suggestion(name, self.names, "columns"),
        )

    def _delimiter_remedy(self) -> str:
        line = ",".join(self.names) if self.options.delimiter == "," else self.names[0]
        sample = line + self.body[:2000].decode("utf-8", errors="ignore")
        others = [mark for mark in ";\t|," if mark != self.options.delimiter]
        likely = max(others, key=sample.count)
        if sample.count(likely) > sample.count(self.options.delimiter):
            return f"set delimiter = {_shown(likely)} under [file] of the profile"
        return "check delimiter under [file] of the profile"


def _shown(mark: str) -> str:
    return repr(mark).replace("'", '"')


def open_text(path: Path, options: FileOptions) -> TextFile:
    """Read a delimited text file up to its header.

    Raises
    ------
    InputError
        If the file is missing, empty, binary, in another encoding, or holds no row of data.
    """
    data = _utf8(path, read_bytes(path), options.encoding)
    start, header = _header_line(data, path, options)
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
            "holds no row of data" + (", only its header" if header else ""),
            file=path,
            place=f"row {header}" if header else None,
            remedy="record again; was the recorder stopped at once?",
        )
    first = _split(body[: _line_end(body)], options.delimiter)
    if not header:
        names = tuple(str(number) for number in range(1, len(first) + 1))
    # A delimiter at the end of every row of data, or of the header alone, makes no column.
    if len(names) == len(first) + 1 and not names[-1]:
        names = names[:-1]
    elif len(first) == len(names) + 1 and not first[-1]:
        names = (*names, "")
    return TextFile(path, options, options.named(names), header, body, rows)


def _utf8(path: Path, data: bytes, encoding: str) -> bytes:
    """The file's text as UTF-8, without byte order mark, each line ended by a line feed."""
    codec = encoding.lower().replace("_", "-")
    wide = codec.startswith(("utf-16", "utf-32", "utf16", "utf32"))
    if not wide:
        # A power cut leaves zeros where the file system had no time for data.
        data = data.rstrip(b"\0")
    if not data or data.isspace():
        raise InputError("is empty", file=path, remedy="was the recorder stopped at once?")
    if not wide and data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(
            f"is not {encoding} text: it begins with the mark of UTF-16",
            file=path,
            place="byte 0",
            remedy='set encoding = "utf-16" under [file] of the profile',
        )
    if not wide and b"\0" in data:
        raise InputError(
            "is not text: it holds zero bytes",
            file=path,
            place=f"byte {data.index(0)}",
            remedy="give the recorder's CSV, not its binary file",
        )
    try:
        if codec in ("utf-8", "utf8", "utf-8-sig", "ascii"):
            data.decode(encoding if codec == "ascii" else "utf-8")
            text = data.removeprefix(b"\xef\xbb\xbf")
        else:
            text = data.decode(encoding).removeprefix("\ufeff").encode()
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"is not {encoding} text: byte 0x{data[error.start]:02x} cannot be read",
            file=path,
            place=f"row {row}, byte {error.start}",
            remedy='set encoding under [file] of the profile, for example "cp1252"',
        ) from error
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text


def _header_line(data: bytes, path: Path, options: FileOptions) -> tuple[int, int]:
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
        file=path,
        place=f"row {row}",
        remedy="check header under [file] of the profile",
    )


def _line_end(data: bytes) -> int:
    end = data.find(b"\n")
    return len(data) if end < 0 else end


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
        raise InputError(
            "is text of a layout that trainlog does not know",
            file=path,
            remedy="give a profile that says which column is what; docs/ingest.md has an example",
        )
    text = open_text(path, profile.file)
    cells = text.cells(wanted_columns(profile, text.names, path))
    return recording_of(cells, profile, path)


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
        raise InputError(
            "is a Parquet table of a layout that trainlog does not know",
            file=path,
            remedy="give a profile that says which column is what; docs/ingest.md has an example",
        )
    data = pa.BufferReader(read_bytes(path))
    try:
        names = tuple(pa.parquet.read_schema(data).names)
        wanted = list(dict.fromkeys(wanted_columns(profile, names, path)))
        for name in wanted:
            if name not in names:
                raise MismatchError(
                    f"no column '{name}'", file=path, remedy=suggestion(name, names, "columns")
                )
        data.seek(0)
        table = pa.parquet.read_table(data, columns=wanted)
    except (pa.ArrowException, OSError) as error:
        raise InputError(
            f"is no Parquet table that can be read: {_first_line(error)}",
            file=path,
            remedy="copy the file again; was the recorder stopped while writing?",
        ) from error
    if not table.num_rows:
        raise InputError("holds no row of data", file=path, remedy="record again")
    rows = np.arange(1, table.num_rows + 1, dtype=np.int64)
    return recording_of(Cells(table, rows, rows.size), profile, path)


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:120]

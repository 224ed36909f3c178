"""A trip as a folder of tables, one a topic: Parquet for repeated analysis, CSV for any program.

Any reader of Parquet opens a topic's file: the time is a column of timestamps, units and meanings
are in the metadata of the columns, and pandas finds its index and ``attrs``. What is not known is
null. CSV files have the units in their header. ``trip.json`` holds the rest of the trip, and says
which file is which topic; docs/trip.md describes the folder.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq

from trainlog.arrays import IntArray
from trainlog.declaration import Declared, Form, Must
from trainlog.display import FORMULA
from trainlog.errors import InputError, LogError, in_file
from trainlog.extras import load
from trainlog.formats.declared import file_content, thing_from_bytes
from trainlog.formats.files import (
    LOOKED_AT,
    atomic_folder,
    atomic_write,
    check_written,
    read_bytes,
    refuse_reading,
    sha256,
)
from trainlog.topics import (
    RECORDED,
    SCHEMA_VERSION,
    TOPICS,
    Field as TopicField,
    Topic,
    column_field,
    topic_of_frame,
)
from trainlog.trip import Trip, nanoseconds, stacked
from trainlog.units import NANOSECONDS

INDEX_FILE = "trip.json"
"""The file that makes a folder a trip."""

ATTACHMENTS = "attachments"
"""The folder of the files carried along."""

TIME = "time"
"""The column of the times."""

COMPRESSION_LEVEL = 3
"""Of zstd."""

DICTIONARY = 0.25
"""Share of different values in a column up to which a dictionary of them is kept."""

ROWS = 131_072
"""Rows of a row group: what is compressed, and read, at a time."""

BLOCK = 2**22
"""Bytes of a CSV file that are read at a time."""

TYPES = {
    str(kind): kind
    for kind in (
        *(pa.int8(), pa.int16(), pa.int32(), pa.int64()),
        *(pa.uint8(), pa.uint16(), pa.uint32(), pa.uint64()),
        *(pa.float32(), pa.float64(), pa.bool_(), pa.string(), pa.large_string()),
    )
}
"""Types of values that a CSV file gives back as they were, by their name."""

AGAIN = "convert the log again"
"""The remedy for a file that is not as it was written."""

Selection = Iterable[str] | Mapping[str, Iterable[str] | None]
"""Topics, or the columns wanted of each topic (None: all of them)."""


# -------------------------------------------------------------------------- writing one topic


class TopicWriter:
    """The file of one topic being written, piece by piece.

    Parameters
    ----------
    topic : str
    path : path
    frame : DataFrame
        Whose columns and types all pieces have; its rows are not written yet.

    Raises
    ------
    LogError
        If the frame has no time, or a column that the file has no type for.
    """

    def __init__(self, topic: str, path: Path, frame: pd.DataFrame) -> None:
        self.path = path
        self._topic, self._attrs, self._columns = topic, frame.attrs, list(frame.columns)
        self._schema = _described(topic, _table_of(topic, frame).schema, frame.attrs)
        self._kinds = {item.name: str(item.type) for item in self._schema if item.name != TIME}
        self._last, self._rows = np.iinfo(np.int64).min, 0
        self._waiting: list[pa.Table] = []
        self._file: Any = None

    def add(self, frame: pd.DataFrame) -> None:
        """Append rows; LogError if the columns are not those of the first, or time runs back."""
        check_columns(self._topic, self._columns, frame)
        table = _table_of(self._topic, frame, self._schema)
        row = _backward(self._last, _times_of(table))
        if row is not None:
            raise LogError(
                f"time of {self._topic} runs backwards to {frame.index[row].isoformat()}",
                place=f"row {self._rows + row}",
                remedy="sort the rows by time",
            )
        if len(table):
            self._last = int(_times_of(table)[-1])
        self._rows += len(table)
        self._waiting.append(table)
        waiting = sum(map(len, self._waiting))
        if waiting >= ROWS:
            full = waiting - waiting % ROWS
            together = pa.concat_tables(self._waiting)
            self._store(together.slice(0, full))
            # A copy, so that the rest does not keep the whole in memory.
            self._waiting = [together.take(np.arange(full, waiting))]

    def close(self) -> None:
        """Write the rows that wait, and close the file."""
        rest, self._waiting = self._waiting, []
        if rest or self._file is None:
            self._store(pa.concat_tables([self._schema.empty_table(), *rest]))
        if self._file is not None:
            self._file.close()

    @property
    def entry(self) -> _TopicEntry:
        """What the index of the folder states of the closed file."""
        if self.path.suffix == CsvTripIndex.SUFFIX:
            columns, attrs = self._kinds, {str(k): each for k, each in self._attrs.items()}
            return _TopicEntry(self._topic, self.path.name, columns=columns, attrs=attrs)
        return _TopicEntry(self._topic, self.path.name, _footer_digest(self.path))

    def _store(self, table: pa.Table) -> None:
        together = table.combine_chunks()
        csv = self.path.suffix == CsvTripIndex.SUFFIX
        if self._file is None:
            self._file = self._csv_file() if csv else self._parquet_file(together.slice(0, ROWS))
        if csv:
            titles = [_title(self._schema.field(name)) for name in (TIME, *self._kinds)]
            together = together.select([TIME, *self._kinds]).rename_columns(titles)
            together = _texts(together.replace_schema_metadata(), f"({FORMULA})", r"'\1")
        if len(together):
            self._file.write_table(together, ROWS)

    def _parquet_file(self, first: pa.Table) -> pq.ParquetWriter:
        """The open file; the first row group decides how each column is best stored."""
        encodings = {name: _encoding(first[name]) for name in self._schema.names}
        return pq.ParquetWriter(
            self.path,
            self._schema,
            compression="zstd",
            compression_level=COMPRESSION_LEVEL,
            use_dictionary=[name for name, encoding in encodings.items() if encoding is None],
            column_encoding={name: each for name, each in encodings.items() if each},
            write_page_checksum=True,
        )

    def _csv_file(self) -> pa.csv.CSVWriter:
        """The open file, with the time first and the units in the header."""
        for name, kind in self._kinds.items():
            if kind not in TYPES:
                raise LogError(
                    f"{name} of {self._topic} is of the type {kind}, which CSV has no text for",
                    remedy="convert to Parquet, or leave the topic out with 'trainlog convert'",
                )
        items = [self._schema.field(name) for name in (TIME, *self._kinds)]
        header = pa.schema([pa.field(_title(item), item.type) for item in items])
        return pa.csv.CSVWriter(self.path, header)


def check_columns(topic: str, columns: Iterable[Any], frame: pd.DataFrame) -> None:
    """Refuse a piece of a topic whose columns are not those of the pieces before."""
    expected = list(columns)
    if list(frame.columns) != expected:
        raise LogError(
            f"{topic} changes its columns on the way",
            remedy=f"give every piece {', '.join(map(str, expected))}",
        )


def described_fields(
    topic: str, columns: Iterable[str], attrs: Mapping[Any, Any]
) -> tuple[Topic | None, dict[str, TopicField]]:
    """The topic as the table of topics, or the frame of a recorder's own, has it; its fields."""
    known = TOPICS.get(topic)
    if topic.startswith(RECORDED):
        known = topic_of_frame({**attrs, "topic": topic})
    if known is None:
        return None, {}
    return known, {name: column_field(known, name) for name in columns}


def joined_head(head: Trip | None, piece: Trip) -> Trip:
    """Metadata and attachments of the first piece with the provenance of the last.

    The last one knows what was lost on the way.
    """
    return replace(piece if head is None else head, topics={}, provenance=piece.provenance)


def _table_of(topic: str, frame: pd.DataFrame, schema: pa.Schema | None = None) -> pa.Table:
    """The frame as Arrow has it; NaN becomes null."""
    index = frame.index
    if not isinstance(index, pd.DatetimeIndex) or index.tz is None or index.hasnans:
        raise LogError(
            f"{topic} is not indexed by time with a time zone",
            remedy="build the frame with trainlog.trip.frame_of",
        )
    utc = frame.set_axis(index.tz_convert("UTC").as_unit("ns").rename(TIME), axis=0)
    utc.attrs = frame.attrs
    try:
        return pa.Table.from_pandas(utc, schema=schema)
    except (pa.ArrowException, TypeError, ValueError, OverflowError, KeyError) as error:
        raise LogError(
            f"{topic} has values that a table cannot hold: {_first_line(error, 120)}",
            remedy="give each column values of one type, and each another name",
        ) from error


def _described(topic: str, schema: pa.Schema, attrs: Mapping[Any, Any]) -> pa.Schema:
    """The schema with unit and meaning of each column; a column without values is one of text."""
    known, fields = described_fields(topic, [n for n in schema.names if n != TIME], attrs)
    columns = []
    for item in schema:
        field = fields.get(item.name)
        text = {} if field is None else {"unit": field.unit, "meaning": field.meaning}
        kind = pa.large_string() if pa.types.is_null(item.type) else item.type
        columns.append(pa.field(item.name, kind, metadata=text))
    metadata = {**(schema.metadata or {}), b"topic": topic.encode()}
    if known is not None:
        metadata[b"meaning"] = known.meaning.encode()
    return pa.schema(columns, metadata)


def _encoding(column: pa.ChunkedArray) -> str | None:
    """How the numbers of a column are best stored; None for a dictionary of the values.

    A recorder's numbers of few digits, and words, come again and again; what was measured or
    computed to the last digit does not.
    """
    kind = column.type
    if len(column) and pc.count_distinct(column).as_py() <= DICTIONARY * len(column):
        return None
    if pa.types.is_float64(kind) or pa.types.is_float32(kind):
        return "BYTE_STREAM_SPLIT"
    if pa.types.is_timestamp(kind) or pa.types.is_int64(kind):
        return "DELTA_BINARY_PACKED"
    return None


def _title(item: pa.Field) -> str:
    """The name of a column with its unit."""
    unit = (item.metadata or {}).get(b"unit", b"").decode()
    return f"{item.name} [{unit}]" if unit else str(item.name)


# -------------------------------------------------------------------------- reading one topic


def _frame_in(entry: _TopicEntry, path: Path, columns: list[str] | None) -> pd.DataFrame:
    """The frame of a topic's file, with those of the columns that it has; None: with all."""
    if entry.columns is None:
        table, attrs = _parquet_table(path, str(entry.footer), columns)
    else:
        table, attrs = _csv_table(path, entry.columns, columns), dict(entry.attrs or {})
    frame: pd.DataFrame = table.drop_columns([TIME]).to_pandas()
    frame.index = pd.DatetimeIndex(_times_of(table).view("M8[ns]"), tz="UTC", name=TIME)
    if isinstance(attrs.get("units"), dict):
        attrs["units"] = {name: unit for name, unit in attrs["units"].items() if name in frame}
    frame.attrs.update(attrs)
    return frame


def _chosen(names: Iterable[str], columns: list[str] | None) -> list[str]:
    """The names of the columns that are wanted, and of the time."""
    wanted = [name for name in names if columns is None or name in columns]
    return [*(name for name in wanted if name != TIME), TIME]


def _parquet_table(
    path: Path, footer: str, columns: list[str] | None
) -> tuple[pa.Table, dict[str, Any]]:
    """The rows of a Parquet file whose end has the digest `footer`, and the frame's attributes."""
    with _named(path, "is damaged", AGAIN):
        if _footer_digest(path) != footer:
            raise _damaged(path, "its end is another than was written")
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            found = file.read(_chosen(file.schema_arrow.names, columns))
            missing = file.metadata.num_rows - len(found)
    if missing:
        raise _damaged(path, f"{missing} rows are missing")
    kept = json.loads((found.schema.metadata or {}).get(b"pandas", b"{}"))
    return found, kept.get("attributes", {})


def _texts(table: pa.Table, pattern: str, replacement: str) -> pa.Table:
    """A table with the beginnings of its texts replaced."""
    for number, item in enumerate(table.schema):
        if pa.types.is_string(item.type) or pa.types.is_large_string(item.type):
            kept = pc.replace_substring_regex(table.column(number), f"^{pattern}", replacement)
            table = table.set_column(number, item, kept)
    return table


def _csv_table(path: Path, kinds: Mapping[str, str], columns: list[str] | None) -> pa.Table:
    """The rows of a CSV file with columns of the types `kinds`, in any order, and others."""
    unknown = [kind for kind in kinds.values() if kind not in TYPES]
    if unknown:
        raise LogError(f"states the unknown type '{unknown[0]}'", file=path, remedy="convert again")
    types = {name: TYPES[kind] for name, kind in kinds.items()} | {TIME: pa.timestamp("ns", "UTC")}
    wanted = pa.schema({name: types[name] for name in _chosen(kinds, columns)})
    with _named(path, "cannot be read", f"correct the row, or {AGAIN}"):
        with path.open(encoding="utf-8-sig", newline="") as file:
            titles = [title.strip().strip('"') for title in file.readline().strip().split(",")]
        names = [title.partition(" [")[0] for title in titles]
        lacking = [name for name in (TIME, *wanted.names) if name not in names]
        if lacking:
            raise LogError(
                f"has no column {lacking[0]}",
                file=path,
                place="row 1",
                remedy=f"it has {', '.join(names)}; {AGAIN}",
            )
        found = pa.csv.read_csv(
            path,
            pa.csv.ReadOptions(block_size=BLOCK, column_names=names, skip_rows=1),
            pa.csv.ParseOptions(newlines_in_values=True),
            pa.csv.ConvertOptions(
                column_types=wanted,
                include_columns=wanted.names,
                null_values=[""],
                strings_can_be_null=True,
                quoted_strings_can_be_null=False,
            ),
        )
    row = _backward(np.iinfo(np.int64).min, _times_of(found))
    if row is not None:
        raise LogError(
            "time runs backwards", file=path, place=f"row {row + 2}", remedy="sort the rows by time"
        )
    return _texts(found.cast(wanted), f"'({FORMULA})", r"\1")


@contextmanager
def _named(path: Path, said: str, remedy: str) -> Iterator[None]:
    """Turn the exceptions of Arrow into errors that name the file."""
    try:
        yield
    except FileNotFoundError as error:
        raise LogError("is missing", file=path, remedy=AGAIN) from error
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise LogError(f"{said}: {_first_line(error, 160)}", file=path, remedy=remedy) from error


def _damaged(path: Path, problem: str) -> LogError:
    """The error for a file that is not as it was written."""
    return LogError(f"is damaged: {problem}", file=path, remedy=AGAIN)


def _first_line(error: Exception, most: int) -> str:
    return str(error).splitlines()[0][:most]


def _footer_digest(path: Path) -> str:
    """SHA-256 of the end of a Parquet file, which describes all before it; errors as `open`."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - 8))
        length = int.from_bytes(file.read(4), "little")
        file.seek(max(0, size - 8 - length))
        return sha256(file.read())


def _times_of(table: pa.Table | pa.RecordBatch) -> IntArray:
    """The times of a table's rows [ns since 1970 UTC], (n,)."""
    return np.asarray(table[TIME].cast(pa.int64()).to_numpy())


def _backward(last: int, times: IntArray) -> int | None:
    """The first row whose time is before that of the row before it; None if there is none."""
    earlier = times < np.concatenate(([last], times[:-1]))
    return int(np.argmax(earlier)) if earlier.any() else None


# ----------------------------------------------------------------------------------- the index


@dataclass(frozen=True)
class _TopicEntry:
    """A topic's file: its name, and what else reading it needs.

    Attributes
    ----------
    topic, file : str
    footer : str
        Of Parquet: SHA-256 of the end of the file, which says where its pages are; each has a
        checksum.
    columns : dict
        Of CSV: type of each column by its name, as Arrow calls it.
    attrs : dict
        Of CSV: those of the frame, units and meanings.
    """

    topic: str
    file: str
    footer: str | None = None
    columns: dict[str, str] | None = None
    attrs: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.columns is None and self.footer is None:
            raise InputError("'footer' is missing", remedy=AGAIN)


@dataclass(frozen=True)
class _AttachmentEntry:
    name: str
    file: str
    sha256: str


_KNOWN_SCHEMAS = Must("is not a schema that is known", "update trainlog", 1.0, SCHEMA_VERSION)


@dataclass(frozen=True, eq=False, repr=False)
class TripIndex(Declared):
    """What ``trip.json`` of a folder of Parquet files holds."""

    FORMAT: ClassVar[str] = "trainlog/trip-parquet"
    SUFFIX: ClassVar[str] = ".parquet"

    schema_version: Annotated[int, Form(must=_KNOWN_SCHEMAS)]
    topics: tuple[_TopicEntry, ...]
    metadata: dict[str, str]
    provenance: list[dict[str, Any]]
    attachments: tuple[_AttachmentEntry, ...]


class CsvTripIndex(TripIndex):
    """What ``trip.json`` of a folder of CSV files holds."""

    FORMAT: ClassVar[str] = "trainlog/trip-csv"
    SUFFIX: ClassVar[str] = ".csv"


# ----------------------------------------------------------------------------- writing a trip


def write_parquet(trip: Trip, folder: str | Path) -> None:
    """Write a trip as a folder of Parquet files, whole or not at all.

    The same trip gives the same bytes.

    Parameters
    ----------
    trip : Trip
        Its frames may be of any topics and columns that Arrow has types for.
    folder : path
        Made, or replaced if it is such a folder.

    Raises
    ------
    LogError
        If the trip cannot be written: a frame without time, values of mixed types, provenance
        that is not JSON.
    InputError
        If the folder cannot be written, or something else is there.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.mcap import read_log
    >>> trip = read_log("sample_logs/nonstop.mcap")
    >>> with tempfile.TemporaryDirectory() as parent:
    ...     write_parquet(trip, f"{parent}/trip.parquet")
    ...     again = read_parquet(f"{parent}/trip.parquet", ["/train/state"])
    >>> again["/train/state"].equals(trip["/train/state"])
    True
    """
    check_written(trip, Trip)
    with folder_writer(folder) as writer:
        writer.add(trip)


@contextmanager
def folder_writer(folder: str | Path, kind: type[TripIndex] = TripIndex) -> Iterator[FolderWriter]:
    """Write a trip in pieces, in the order of time; as Parquet, or as CSV; see `write_parquet`."""
    with in_file(folder), atomic_folder(folder, INDEX_FILE) as temporary:
        writer = FolderWriter(temporary, kind)
        try:
            yield writer
        finally:
            writer.close()
        writer.describe()


class FolderWriter:
    """A folder of Parquet or CSV files being written; made by `folder_writer`."""

    def __init__(self, folder: Path, kind: type[TripIndex]) -> None:
        self._folder, self._kind = folder, kind
        self._topics: dict[str, TopicWriter] = {}
        self._trip: Trip | None = None

    def add(self, piece: Trip) -> None:
        """Append the rows of a piece, in which topics may be missing.

        Raises
        ------
        LogError
            If a frame has no time, or not the columns of the pieces before.
        """
        self._trip = joined_head(self._trip, piece)
        for topic, frame in piece.topics.items():
            if topic not in self._topics:
                # A file name like the topic's that no other has, whatever the case of letters.
                taken = {each.path.stem.lower() for each in self._topics.values()}
                name = _plain(topic.strip("/"))
                name = name if name.lower() not in taken else f"{name}-{len(taken) + 1}"
                path = self._folder / f"{name}{self._kind.SUFFIX}"
                self._topics[topic] = TopicWriter(topic, path, frame)
            self._topics[topic].add(frame)

    def close(self) -> None:
        """Write the rows that wait, and close the files."""
        for topic in self._topics.values():
            topic.close()

    def describe(self) -> None:
        """Write the attachments and ``trip.json``; LogError if the provenance is not JSON."""
        trip = Trip({}) if self._trip is None else self._trip
        (self._folder / ATTACHMENTS).mkdir()
        attached = []
        for number, (name, content) in enumerate(sorted(trip.attachments.items()), start=1):
            file = f"{ATTACHMENTS}/{number:04d}-{_plain(name)}"
            (self._folder / file).write_bytes(content)
            attached.append(_AttachmentEntry(name, file, sha256(content)))
        index = self._kind(
            SCHEMA_VERSION,
            tuple(each.entry for each in self._topics.values()),
            dict(sorted(trip.metadata.items())),
            list(trip.provenance),
            tuple(attached),
        )
        try:
            text = json.dumps(file_content(index), ensure_ascii=False, allow_nan=False, indent=1)
            (self._folder / INDEX_FILE).write_bytes(f"{text}\n".encode())
        except (TypeError, ValueError, InputError) as error:
            raise LogError(
                f"metadata or provenance cannot be written: {error}",
                remedy="use text, finite numbers, lists and dictionaries with text keys",
            ) from error


def _plain(name: str) -> str:
    """Like a name, of letters that every file system takes."""
    return re.sub(r"[^A-Za-z0-9.-]", "_", name)[:80]


# ----------------------------------------------------------------------------- reading a trip


def read_parquet(folder: str | Path, topics: Selection | None = None) -> Trip:
    """Read a trip from a folder that `write_parquet` made.

    Parameters
    ----------
    folder : path
    topics : iterable of str, or mapping of str to iterable of str or None; optional
        Topics to read, or columns by topic (None: all of them). What the folder does not have is
        left out. Default: everything.

    Raises
    ------
    LogError
        If a file of the folder is missing or damaged.
    InputError
        If there is no such folder, it holds no trip, or a later version wrote it.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.mcap import read_log
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_parquet(read_log("sample_logs/nonstop.mcap"), f"{folder}/trip")
    ...     trip = read_parquet(f"{folder}/trip", {"/train/state": ["speed"]})
    >>> list(trip), list(trip["/train/state"].columns)
    (['/train/state'], ['speed'])
    """
    folder = Path(folder)
    index = trip_index(folder)
    attachments = {}
    for entry in index.attachments:
        attachments[entry.name] = read_bytes(_inside(folder, entry.file), any_kind=True)
        if sha256(attachments[entry.name]) != entry.sha256:
            raise _damaged(folder / entry.file, "its checksum is another")
    wanted = _wanted(index, topics)
    frames = {
        each.topic: _frame_in(each, _inside(folder, each.file), wanted[each.topic])
        for each in index.topics
        if each.topic in wanted
    }
    return Trip(frames, index.metadata, tuple(index.provenance), attachments)


def trip_index(folder: str | Path) -> TripIndex:
    """What ``trip.json`` of a folder says.

    Raises
    ------
    InputError
        If there is no such folder, it holds no trip, or a later version wrote it.
    """
    path = Path(folder)
    if path.is_dir() and not (path / INDEX_FILE).exists():
        raise InputError(
            f"is not a trip in Parquet: it has no {INDEX_FILE}",
            file=folder,
            remedy="tables of other programs are brought in with 'trainlog ingest' and a profile",
        )
    if not path.is_dir():
        what = "is not a folder" if path.exists() else "does not exist"
        raise InputError(what, file=folder, remedy="name a folder that 'trainlog convert' made")
    data = read_bytes(path / INDEX_FILE)
    kind = CsvTripIndex if CsvTripIndex.FORMAT.encode() in data[:LOOKED_AT] else TripIndex
    return thing_from_bytes(kind, data, path / INDEX_FILE)


def _wanted(index: TripIndex, topics: Selection | None) -> dict[str, list[str] | None]:
    """The columns wanted of each topic, None for all."""
    if topics is None:
        return dict.fromkeys(each.topic for each in index.topics)
    if not isinstance(topics, Mapping):
        topics = dict.fromkeys(_several(topics))
    return {name: None if names is None else _several(names) for name, names in topics.items()}


def _several(names: Iterable[str]) -> list[str]:
    """Names as a list; a text is one name."""
    return [names] if isinstance(names, str) else list(names)


def _inside(folder: Path, file: str) -> Path:
    """A file that the index names, which must be one of the folder's own."""
    path = folder / file
    if not path.resolve().is_relative_to(folder.resolve()):
        raise LogError(
            f"names a file outside its folder: {file}", file=folder / INDEX_FILE, remedy=AGAIN
        )
    return path


INDEX = "trainlog.json"
"""Attachment that makes a measurement file a trip."""

FORMAT, VERSION = "trainlog/trip-mdf", 1

LONGEST = 2**53
"""Time [ns] since the start, 104 days, up to which the file's seconds give every nanosecond."""


@contextmanager
def mdf_writer(path: str | Path) -> Iterator[MdfWriter]:
    """Write a measurement file of pieces, which are held until the last; whole or not at all."""
    library = load("asammdf")
    writer = MdfWriter()
    yield writer
    with atomic_write(path) as temporary, closing(library.MDF(version="4.10")) as mdf:
        with in_file(path):
            _fill(mdf, library.Signal, writer.trip)
        with _quiet():
            made = Path(mdf.save(temporary, overwrite=True, compression=2))
        if made != temporary:
            made.replace(temporary)


class MdfWriter:
    """The pieces of a trip that becomes a measurement file; made by `mdf_writer`."""

    def __init__(self) -> None:
        self._head: Trip | None = None
        self._frames: dict[str, list[pd.DataFrame]] = {}

    def add(self, piece: Trip) -> None:
        """Append the rows of a piece; LogError if a topic changes its columns."""
        self._head = joined_head(self._head, piece)
        for topic, frame in piece.topics.items():
            pieces = self._frames.setdefault(topic, [])
            check_columns(topic, pieces[0].columns if pieces else frame.columns, frame)
            pieces.append(frame)

    @property
    def trip(self) -> Trip:
        """The whole trip."""
        head = Trip({}) if self._head is None else self._head
        whole = {topic: stacked(pieces) for topic, pieces in self._frames.items()}
        return replace(head, topics=whole)


def _fill(mdf: Any, signal: Callable[..., Any], trip: Trip) -> None:
    """Put a trip into a measurement file: a group of channels a topic, and an index of them."""
    starts = [frame.index[0] for frame in trip.topics.values() if len(frame)]
    first = min(starts).floor("s") if starts else pd.Timestamp(0, tz="UTC")
    mdf.header.start_time = first.to_pydatetime()
    start, topics = int(first.as_unit("ns").value), []
    for topic, frame in trip.topics.items():
        entry: dict[str, Any] = {"topic": topic, "group": None}
        entry["columns"] = {str(name): str(frame[name].dtype) for name in frame.columns}
        topics.append(entry | {"attrs": dict(frame.attrs)})
        if not len(frame):
            continue
        since = nanoseconds(frame) - start
        if since[-1] > LONGEST:
            raise LogError(
                f"{topic} is longer than the 104 days for which MDF gives every nanosecond",
                remedy="cut it, or convert to Parquet",
            )
        _, fields = described_fields(topic, map(str, frame.columns), frame.attrs)
        signals = []
        for name in map(str, frame.columns):
            samples = _samples(topic, frame[name])
            words = {"encoding": "utf-8"} if samples.dtype.kind == "S" else {}
            if name in fields:
                words |= {"unit": fields[name].unit, "comment": fields[name].meaning}
            signals.append(
                signal(samples=samples, timestamps=since / NANOSECONDS, name=name, **words)
            )
        topics[-1]["group"] = int(mdf.append(signals, acq_name=topic, common_timebase=True))
    index = {
        "format": FORMAT,
        "version": VERSION,
        "start": start,
        "topics": topics,
        "metadata": trip.metadata,
        "provenance": list(trip.provenance),
        "attachments": sorted(trip.attachments),
    }
    text = json.dumps(index, ensure_ascii=False, allow_nan=False).encode()
    for name, content in [*sorted(trip.attachments.items()), (INDEX, text)]:
        mdf.attach(content, file_name=name, compression=True, embedded=True)


def read_mdf_trip(path: str | Path) -> Trip:
    """Read the trip of a measurement file that trainlog wrote.

    Raises
    ------
    InputError
        If the file is missing, cannot be read, or another program wrote it.
    """
    path = Path(path)
    with opened_mdf(path) as mdf:
        attachments = {str(each.file_name): each.extract() for each in mdf.attachments}
        if INDEX not in attachments:
            raise InputError(
                "is a measurement file of another program",
                file=path,
                remedy="'trainlog ingest' makes a trip of it, with a profile of its channels",
            )
        index = json.loads(attachments[INDEX])
        frames = {
            entry["topic"]: _frame(mdf, entry, int(index["start"])) for entry in index["topics"]
        }
    wanted = {name: attachments[name] for name in index["attachments"]}
    return Trip(frames, index["metadata"], tuple(index["provenance"]), wanted)


@contextmanager
def opened_mdf(path: Path) -> Iterator[Any]:
    """The file as asammdf gives it; InputError if it cannot be read."""
    library = load("asammdf")
    try:
        stream = path.open("rb")
    except OSError as error:
        refuse_reading(path, error)
    with stream, closing(called(path, lambda: library.MDF(stream))) as mdf:
        yield mdf


def called(path: Path, call: Callable[[], Any]) -> Any:
    """What asammdf returns; one error for whatever it raises on a damaged file.

    Its messages, in the log and when the half-opened file is closed, are not passed on.
    """
    hook = sys.unraisablehook
    with _quiet():
        try:
            try:
                return call()
            except Exception as error:  # noqa: BLE001 - asammdf raises whatever a byte leads it to
                sys.unraisablehook = lambda _: None
                problem = f"{type(error).__name__}: {error}".splitlines()[0][:120]
            gc.collect()
        finally:
            sys.unraisablehook = hook
    raise InputError(
        f"is not a readable measurement file ({problem})",
        file=path,
        remedy="copy or convert it again; was the recorder stopped while writing?",
    )


def _frame(mdf: Any, entry: dict[str, Any], start: int) -> pd.DataFrame:
    """The frame of one topic."""
    columns: dict[str, Any] = {}
    time = np.empty(0, dtype=np.int64)
    for name, kind in entry["columns"].items():
        if entry["group"] is None:
            columns[name] = np.empty(0, dtype=object if kind in ("object", "str") else kind)
            continue
        signal = mdf.get(name, group=entry["group"])
        time = start + np.round(signal.timestamps * NANOSECONDS).astype(np.int64)
        samples = signal.samples
        if samples.dtype.kind == "S":
            columns[name] = pd.array([each.decode("utf-8") for each in samples], dtype=kind)
        else:
            columns[name] = samples.astype(kind)
    index = pd.DatetimeIndex(time.view("M8[ns]"), tz="UTC", name="time")
    frame = pd.DataFrame(columns, index=index)
    frame.attrs = entry["attrs"]
    return frame


def _samples(topic: str, column: pd.Series[Any]) -> np.ndarray:
    """The values of a column as asammdf takes them: numbers, or words in UTF-8."""
    if column.dtype.kind in "fiu":
        return column.to_numpy()
    if column.dtype.kind == "b":
        return column.to_numpy().astype(np.uint8)
    words = [str(each).encode() for each in column]
    if any(b"\0" in each for each in words):
        raise LogError(
            f"{topic} has a text with the character NUL, at which MDF ends it",
            remedy="convert to Parquet",
        )
    return np.array(words, dtype=f"S{max(1, *map(len, words))}")


@contextmanager
def _quiet() -> Iterator[None]:
    """Without asammdf's log."""
    log = logging.getLogger("asammdf")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(level)

"""A trip as a folder of Parquet files, one a topic, for repeated analysis.

Any Parquet reader opens a topic's file: the time is a column of timestamps, units and meanings are
in the metadata of the columns, and pandas finds its index and ``attrs``. What is not known is null.
``trip.json`` holds the rest of the trip, and says which file is which topic; docs/trip.md describes
the folder.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import Field

from trainlog.errors import InputError, LogError
from trainlog.formats.files import atomic_folder, check_written, read_bytes, sha256
from trainlog.formats.schema import File, Part
from trainlog.spans import Spans, overlapping, position_limits, spans_of_pieces, time_limits
from trainlog.topics import RECORDED, SCHEMA_VERSION, TOPICS, column_field, topic_of_frame
from trainlog.trip import NO_POSITION, POSITION_TOPICS, Trip

INDEX_FILE = "trip.json"
"""The file that makes a folder a trip."""

ATTACHMENTS = "attachments"
"""The folder of the files carried along."""

Selection = Iterable[str] | Mapping[str, Iterable[str] | None]
"""Topics, or the columns wanted of each topic (None: all of them)."""

TIME = "time"
"""The column of the times."""

COMPRESSION_LEVEL = 3
"""Of zstd."""

DICTIONARY = 0.25
"""Share of different values in a column up to which a dictionary of them is kept."""

ROWS = 131_072
"""Rows of a row group: what is compressed, and read, at a time."""


class _TopicEntry(Part):
    topic: str
    file: str
    footer: str
    """SHA-256 of the end of the file, which says where its pages are; each has a checksum."""


class _AttachmentEntry(Part):
    name: str
    file: str
    sha256: str


class TripIndex(File):
    """What ``trip.json`` holds."""

    FORMAT: ClassVar[str] = "trainlog/trip-parquet"

    schema_version: int = Field(ge=1, le=SCHEMA_VERSION)
    topics: list[_TopicEntry]
    metadata: dict[str, str]
    provenance: list[dict[str, Any]]
    attachments: list[_AttachmentEntry]


# ------------------------------------------------------------------------------------- writing


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
    with parquet_writer(folder) as writer:
        writer.add(trip)


@contextmanager
def parquet_writer(folder: str | Path) -> Iterator[ParquetWriter]:
    """Write a trip in pieces, in the order of time; see `write_parquet`."""
    try:
        with atomic_folder(folder, INDEX_FILE) as temporary:
            writer = ParquetWriter(temporary)
            try:
                yield writer
            finally:
                writer.close()
            writer.describe()
    except LogError as error:
        if error.file is not None:
            raise
        raise LogError(
            error.problem, file=folder, place=error.place, remedy=error.remedy
        ) from error


class ParquetWriter:
    """A folder of Parquet files being written; made by `parquet_writer`.

    Metadata and attachments are those of the first piece, the provenance is that of the last, which
    knows what was lost on the way.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._topics: dict[str, _TopicWriter] = {}
        self._trip: Trip | None = None

    def add(self, piece: Trip) -> None:
        """Append the rows of a piece, in which topics may be missing.

        Raises
        ------
        LogError
            If a frame has no time, or not the columns of the pieces before.
        """
        first = replace(piece, topics={}) if self._trip is None else self._trip
        self._trip = replace(first, provenance=piece.provenance)
        for topic, frame in piece.topics.items():
            if topic not in self._topics:
                path = self._folder / f"{self._free_name(topic)}.parquet"
                self._topics[topic] = _TopicWriter(topic, path, frame)
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
            attached.append({"name": name, "file": file, "sha256": sha256(content)})
        index = {
            "format": TripIndex.FORMAT,
            "version": TripIndex.VERSION,
            "schema_version": SCHEMA_VERSION,
            "topics": [
                {"topic": topic, "file": each.path.name, "footer": footer_digest(each.path)}
                for topic, each in self._topics.items()
            ],
            "metadata": dict(sorted(trip.metadata.items())),
            "provenance": trip.provenance,
            "attachments": attached,
        }
        (self._folder / INDEX_FILE).write_bytes(_json(index))

    def _free_name(self, topic: str) -> str:
        """A file name like the topic's that no other topic has, whatever the case of letters."""
        taken = {each.path.stem.lower() for each in self._topics.values()}
        name = _plain(topic.strip("/"))
        return name if name.lower() not in taken else f"{name}-{len(taken) + 1}"


def _plain(name: str) -> str:
    """Like a name, of letters that every file system takes."""
    return re.sub(r"[^A-Za-z0-9.-]", "_", name)[:80]


def _json(value: object) -> bytes:
    try:
        text = json.dumps(value, ensure_ascii=False, allow_nan=False, indent=1)
        return f"{text}\n".encode()
    except (TypeError, ValueError) as error:
        raise LogError(
            f"metadata or provenance cannot be written: {error}",
            remedy="use text, finite numbers, lists and dictionaries with text keys",
        ) from error


# ------------------------------------------------------------------------------------- reading


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
    with _opened(Path(folder), topics) as (trip, files):
        frames = {name: file.frame(file.read()) for name, file in files.items()}
    return replace(trip, topics=frames)


def stream_parquet(
    folder: str | Path,
    topics: Selection | None = None,
    *,
    time: tuple[Any, Any] | None = None,
    position: tuple[float | None, float | None] | None = None,
    rows: int = 1_000_000,
) -> Iterator[Trip]:
    """Read a trip piece by piece, in the order of time.

    Every row comes once. A piece has the rows of all topics in one span of time, so that rows of
    the same time stay together.

    Parameters
    ----------
    folder, topics
        As in `read_parquet`.
    time, position : (start, end), optional
        Only rows of this time, and at the times at which the train was within these positions; as
        in `Trip.between` and `Trip.within`.
    rows : int
        A piece has about as many rows, and memory holds about twice as many.

    Yields
    ------
    Trip
        With metadata, provenance and attachments of the whole, and all topics, some perhaps
        without rows. One piece at least.

    Raises
    ------
    LogError, InputError
        As `read_parquet`.
    """
    spans = np.array([time_limits(*(time or (None, None)))], dtype=np.int64)
    if position is not None:
        spans = overlapping(spans, _spans_within(Path(folder), position))
    with _opened(Path(folder), topics) as (trip, files):
        trip = trip.with_slice(time=time, position=position)
        batch = max(1, rows // max(1, len(files)))
        waiting = {
            name: _Waiting(file.schema, file.batches(batch, spans)) for name, file in files.items()
        }
        ends: list[int] = [0]
        while ends:
            for each in waiting.values():
                each.fill()
            # Up to where every topic has been read nothing more can come.
            ends = [each.end for each in waiting.values() if each.more]
            frames = {
                name: files[name].frame(each.taken(min(ends) if ends else None))
                for name, each in waiting.items()
            }
            yield replace(trip, topics=frames).cut(spans)


def _spans_within(folder: Path, position: tuple[float | None, float | None]) -> Spans:
    """When the train was within two positions."""
    limits = position_limits(*position)
    with _opened(folder, {name: ["position"] for name in POSITION_TOPICS}) as (trip, files):
        for topic in POSITION_TOPICS:
            if topic in files and files[topic].knows("position"):
                pieces = (
                    (times_of(rows), rows["position"].to_numpy())
                    for rows in files[topic].batches(ROWS)
                )
                return spans_of_pieces(pieces, *limits)
    raise LogError(
        f"trip '{trip.name}' does not know where the train was", file=folder, remedy=NO_POSITION
    )


def time_span(folder: str | Path) -> tuple[pd.Timestamp, pd.Timestamp] | None:
    """Times of the first and the last row of any topic; None if there are no rows.

    Raises
    ------
    LogError, InputError
        As `read_parquet`.
    """
    with _opened(Path(folder), None) as (_, files):
        spans = [file.spans() for file in files.values()]
    every = np.concatenate([np.empty((0, 2), dtype=np.int64), *spans])
    if len(every) == 0:
        return None
    return pd.Timestamp(every.min(), tz="UTC"), pd.Timestamp(every.max(), tz="UTC")


class _Waiting:
    """Rows of a topic that were read and not yet given out.

    Attributes
    ----------
    more : bool
        Whether the file may have more rows.
    end : int
        Time of the last row that was read [ns]; meaningful while there are more.
    """

    def __init__(self, schema: pa.Schema, batches: Iterator[pa.Table]) -> None:
        self._batches = batches
        self._rows = schema.empty_table()
        self.more, self.end = True, 0

    def fill(self) -> None:
        """Read on until there are rows before the last time read, or the file ends."""
        while self.more and not (
            len(self._rows) and times_of(self._rows.slice(0, 1))[0] < self.end
        ):
            batch = next(self._batches, None)
            if batch is None:
                self.more = False
            elif len(batch):
                self._rows = pa.concat_tables([self._rows, batch])
                self.end = int(times_of(batch)[-1])

    def taken(self, before: int | None) -> pa.Table:
        """Take out the rows before a time [ns]; all of them if it is None."""
        count = len(self._rows)
        if before is not None:
            count = int(np.searchsorted(times_of(self._rows), before, side="left"))
        rows, self._rows = self._rows.slice(0, count), self._rows.slice(count)
        return rows


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
            f"is no trip in Parquet: it has no {INDEX_FILE}",
            file=folder,
            remedy="tables of other programs are brought in with 'trainlog ingest' and a profile",
        )
    if not path.is_dir():
        what = "is not a folder" if path.exists() else "does not exist"
        raise InputError(what, file=folder, remedy="name a folder that 'trainlog convert' made")
    return TripIndex.from_bytes(read_bytes(path / INDEX_FILE), path / INDEX_FILE)


@contextmanager
def _opened(
    folder: Path, topics: Selection | None
) -> Iterator[tuple[Trip, dict[str, _TopicReader]]]:
    """The trip without its topics, and the open files of those wanted."""
    index = trip_index(folder)
    attachments = {}
    for entry in index.attachments:
        attachments[entry.name] = read_bytes(_inside(folder, entry.file))
        if sha256(attachments[entry.name]) != entry.sha256:
            raise _damaged(folder / entry.file, "its checksum is another")
    wanted = _wanted(index, topics)
    with ExitStack() as files:
        readers = {}
        for each in index.topics:
            if each.topic in wanted:
                path = _inside(folder, each.file)
                readers[each.topic] = _TopicReader(path, each.footer, wanted[each.topic])
                files.callback(readers[each.topic].close)
        yield Trip({}, index.metadata, tuple(index.provenance), attachments), readers


def _wanted(index: TripIndex, topics: Selection | None) -> dict[str, list[str] | None]:
    """The columns wanted of each topic, None for all."""
    if topics is None:
        return dict.fromkeys(each.topic for each in index.topics)
    if isinstance(topics, Mapping):
        return {name: None if names is None else list(names) for name, names in topics.items()}
    return dict.fromkeys([topics] if isinstance(topics, str) else topics)


def _inside(folder: Path, file: str) -> Path:
    """A file that the index names, which must be one of the folder's own."""
    path = folder / file
    if not path.resolve().is_relative_to(folder.resolve()):
        raise LogError(
            f"names a file outside its folder: {file}",
            file=folder / INDEX_FILE,
            remedy="convert the log again",
        )
    return path


# -------------------------------------------------------------------------- the files of the topics


class _TopicWriter:
    """The Parquet file of one topic being written.

    Parameters
    ----------
    topic : str
    path : path
    frame : DataFrame
        Whose columns and types all later pieces have; its rows are not written yet.

    Raises
    ------
    LogError
        If the frame has no time, or a column that Parquet has no type for.
    """

    def __init__(self, topic: str, path: Path, frame: pd.DataFrame) -> None:
        self.topic, self.path, self.rows = topic, path, 0
        self._columns = list(frame.columns)
        self._schema = _described(topic, _table(topic, frame).schema, frame.attrs)
        self._waiting: list[pa.Table] = []
        self._last = np.iinfo(np.int64).min
        self._file: pq.ParquetWriter | None = None

    def add(self, frame: pd.DataFrame) -> None:
        """Append rows; LogError if their columns are not those of the first."""
        if list(frame.columns) != self._columns:
            raise LogError(
                f"{self.topic} changes its columns on the way",
                remedy=f"give every piece {', '.join(map(str, self._columns))}",
            )
        table = _table(self.topic, frame, self._schema)
        times = np.concatenate(([self._last], times_of(table)))
        if np.any(times[1:] < times[:-1]):
            row = int(np.argmax(times[1:] < times[:-1]))
            raise LogError(
                f"time of {self.topic} runs backwards to {frame.index[row].isoformat()}",
                place=f"row {self.rows + row}",
                remedy="sort the rows by time",
            )
        self._last = int(times[-1])
        self.rows += len(table)
        self._waiting.append(table)
        waiting = sum(map(len, self._waiting))
        if waiting >= ROWS:
            full = waiting - waiting % ROWS
            together = pa.concat_tables(self._waiting)
            self._write(together.slice(0, full))
            # A copy, so that the rest does not keep the whole in memory.
            self._waiting = [together.take(np.arange(full, waiting))]

    def close(self) -> None:
        """Write the rows that wait for a full row group, and close the file."""
        rest, self._waiting = self._waiting, []
        if rest or self._file is None:
            self._write(pa.concat_tables([self._schema.empty_table(), *rest]))
        if self._file is not None:
            self._file.close()

    def _write(self, table: pa.Table) -> None:
        together = table.combine_chunks()
        if self._file is None:
            self._file = self._opened(together.slice(0, ROWS))
        if len(together):
            self._file.write_table(together, row_group_size=ROWS)

    def _opened(self, first: pa.Table) -> pq.ParquetWriter:
        """The file begun; the first row group decides how each column is best stored."""
        encodings = {field.name: _encoding(first[field.name]) for field in self._schema}
        return pq.ParquetWriter(
            self.path,
            self._schema,
            compression="zstd",
            compression_level=COMPRESSION_LEVEL,
            use_dictionary=[name for name, encoding in encodings.items() if encoding is None],
            column_encoding={name: each for name, each in encodings.items() if each},
            write_page_checksum=True,
        )


def _table(topic: str, frame: pd.DataFrame, schema: pa.Schema | None = None) -> pa.Table:
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
        table = pa.Table.from_pandas(utc, schema=schema)
    except (pa.ArrowException, TypeError, ValueError, OverflowError, KeyError) as error:
        raise LogError(
            f"{topic} has values that a table cannot hold: {str(error).splitlines()[0][:120]}",
            remedy="give each column values of one type, and each another name",
        ) from error
    return table


def _described(topic: str, schema: pa.Schema, attrs: Mapping[Any, Any]) -> pa.Schema:
    """The schema with unit and meaning of each column; a column without values is one of text."""
    known = TOPICS.get(topic)
    if topic.startswith(RECORDED):
        known = topic_of_frame({**attrs, "topic": topic})
    fields = []
    for item in schema:
        described = {}
        if known is not None and item.name != TIME:
            field = column_field(known, item.name)
            described = {"unit": field.unit, "meaning": field.meaning}
        kind = pa.large_string() if pa.types.is_null(item.type) else item.type
        fields.append(pa.field(item.name, kind, metadata=described))
    metadata = {**(schema.metadata or {}), b"topic": topic.encode()}
    if known is not None:
        metadata[b"meaning"] = known.meaning.encode()
    return pa.schema(fields, metadata)


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


class _TopicReader:
    """The Parquet file of one topic, open for reading.

    Parameters
    ----------
    path : path
    footer : str
        What `footer_digest` gave when the file was written.
    columns : list of str, optional
        To read, if they are there. Default: all.

    Raises
    ------
    LogError
        If the file is missing or damaged.
    """

    def __init__(self, path: Path, footer: str, columns: list[str] | None = None) -> None:
        self.path = path
        with self._named():
            if footer_digest(path) != footer:
                raise _damaged(path, "its end is another than was written")
            self._file = pq.ParquetFile(path, page_checksum_verification=True)
        self._schema: pa.Schema = self._file.schema_arrow
        names = [name for name in self._schema.names if name != TIME]
        self._columns = names if columns is None else [n for n in names if n in set(columns)]

    @property
    def schema(self) -> pa.Schema:
        """Of what is read."""
        fields = [self._schema.field(name) for name in (*self._columns, TIME)]
        return pa.schema(fields, self._schema.metadata)

    def read(self) -> pa.Table:
        """All rows."""
        with self._named():
            return self._file.read([*self._columns, TIME])

    def batches(self, rows: int, spans: Spans | None = None) -> Iterator[pa.Table]:
        """Rows in the order of the file, at most so many at a time.

        Row groups without any time in the spans are passed over.
        """
        groups = [
            number
            for number, span in enumerate(self.spans())
            if spans is None or len(overlapping(spans, span[None]))
        ]
        with self._named():
            for batch in self._file.iter_batches(
                rows, row_groups=groups, columns=[*self._columns, TIME]
            ):
                yield pa.Table.from_batches([batch], self.schema)

    def spans(self) -> Spans:
        """First and last time of each row group [ns], (k, 2)."""
        column = self._schema.names.index(TIME)
        found = []
        for number in range(self._file.num_row_groups):
            group = self._file.metadata.row_group(number).column(column).statistics
            found.append((group.min.value, group.max.value))
        return np.array(found, dtype=np.int64).reshape(-1, 2)

    def knows(self, name: str) -> bool:
        """Whether a column has any value."""
        if name not in self._columns:
            return False
        column = self._schema.names.index(name)
        groups = (self._file.metadata.row_group(n) for n in range(self._file.num_row_groups))
        return any(group.column(column).statistics.num_values > 0 for group in groups)

    def frame(self, table: pa.Table) -> pd.DataFrame:
        """The frame of rows that were read."""
        frame: pd.DataFrame = table.to_pandas()
        frame.index = pd.DatetimeIndex(times_of(table).view("M8[ns]"), tz="UTC", name=TIME)
        kept = json.loads((self._schema.metadata or {}).get(b"pandas", b"{}"))
        attrs = dict(kept.get("attributes", {}))
        if isinstance(attrs.get("units"), dict):
            attrs["units"] = {n: u for n, u in attrs["units"].items() if n in self._columns}
        frame.attrs = attrs
        return frame

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Turn the exceptions of Arrow into errors that name the file."""
        try:
            yield
        except FileNotFoundError as error:
            raise _damaged(self.path, "it is missing") from error
        except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
            raise _damaged(self.path, str(error).splitlines()[0][:120]) from error


def footer_digest(path: Path) -> str:
    """SHA-256 of the end of a Parquet file, which describes all before it; errors as `open`."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - 8))
        length = int.from_bytes(file.read(4), "little")
        file.seek(max(0, size - 8 - length))
        return sha256(file.read())


def times_of(table: pa.Table) -> np.ndarray:
    """The times of a table's rows [ns since 1970 UTC], (n,)."""
    return np.asarray(table[TIME].cast(pa.int64()).to_numpy())


def _damaged(path: Path, problem: str) -> LogError:
    """The error for a file that is not as it was written."""
    return LogError(f"is damaged: {problem}", file=path, remedy="convert the log again")

"""A trip as a folder of Parquet files, one a topic, for repeated analysis.

Any Parquet reader opens a topic's file: the time is a column of timestamps, units and meanings are
in the metadata of the columns, and pandas finds its index and ``attrs``. What is not known is null.
``trip.json`` holds the rest of the trip, and says which file is which topic; docs/trip.md describes
the folder.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pyarrow as pa
from pydantic import Field

from trainlog.errors import InputError, LogError
from trainlog.formats.files import LOOKED_AT, atomic_folder, check_written, read_bytes, sha256
from trainlog.formats.schema import File, Part
from trainlog.formats.topic_csv import CsvTopic, CsvTopicWriter
from trainlog.formats.topic_parquet import ROWS, ParquetTopic, ParquetTopicWriter, damaged, times_of
from trainlog.spans import Spans, overlapping, position_limits, spans_of_pieces, time_limits
from trainlog.topics import SCHEMA_VERSION
from trainlog.trip import NO_POSITION, POSITION_TOPICS, Trip

INDEX_FILE = "trip.json"
"""The file that makes a folder a trip."""

ATTACHMENTS = "attachments"
"""The folder of the files carried along."""

Selection = Iterable[str] | Mapping[str, Iterable[str] | None]
"""Topics, or the columns wanted of each topic (None: all of them)."""


class _TopicEntry(Part):
    topic: str
    file: str
    footer: str
    """SHA-256 of the end of the file, which says where its pages are; each has a checksum."""

    def reader(self, path: Path, columns: list[str] | None) -> ParquetTopic | CsvTopic:
        """The open file."""
        return ParquetTopic(path, self.footer, columns)


class _CsvEntry(Part):
    topic: str
    file: str
    columns: dict[str, str]
    """Type of each column by its name, as Arrow calls it."""
    attrs: dict[str, Any]
    """Of the frame: units, meanings."""

    def reader(self, path: Path, columns: list[str] | None) -> ParquetTopic | CsvTopic:
        """The open file."""
        return CsvTopic(path, self.columns, self.attrs, columns)


class _AttachmentEntry(Part):
    name: str
    file: str
    sha256: str


class TripIndex(File):
    """What ``trip.json`` of a folder of Parquet files holds."""

    FORMAT: ClassVar[str] = "trainlog/trip-parquet"
    SUFFIX: ClassVar[str] = ".parquet"
    WRITER: ClassVar[type[ParquetTopicWriter | CsvTopicWriter]] = ParquetTopicWriter

    schema_version: int = Field(ge=1, le=SCHEMA_VERSION)
    topics: Sequence[_TopicEntry | _CsvEntry]
    metadata: dict[str, str]
    provenance: list[dict[str, Any]]
    attachments: list[_AttachmentEntry]


class CsvTripIndex(TripIndex):
    """What ``trip.json`` of a folder of CSV files holds."""

    FORMAT: ClassVar[str] = "trainlog/trip-csv"
    SUFFIX: ClassVar[str] = ".csv"
    WRITER: ClassVar[type[ParquetTopicWriter | CsvTopicWriter]] = CsvTopicWriter


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
    with folder_writer(folder) as writer:
        writer.add(trip)


@contextmanager
def folder_writer(
    folder: str | Path, kind: type[TripIndex] | None = None
) -> Iterator[FolderWriter]:
    """Write a trip in pieces, in the order of time; as Parquet, or as CSV; see `write_parquet`."""
    kind = TripIndex if kind is None else kind
    try:
        with atomic_folder(folder, INDEX_FILE) as temporary:
            writer = FolderWriter(temporary, kind)
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


class FolderWriter:
    """A folder of Parquet or CSV files being written; made by `folder_writer`.

    Metadata and attachments are those of the first piece, the provenance is that of the last, which
    knows what was lost on the way.
    """

    def __init__(self, folder: Path, kind: type[TripIndex]) -> None:
        self._folder, self._kind = folder, kind
        self._topics: dict[str, ParquetTopicWriter | CsvTopicWriter] = {}
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
                path = self._folder / f"{self._free_name(topic)}{self._kind.SUFFIX}"
                self._topics[topic] = self._kind.WRITER(topic, path, frame)
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
            "format": self._kind.FORMAT,
            "version": self._kind.VERSION,
            "schema_version": SCHEMA_VERSION,
            "topics": [
                {"topic": topic, "file": each.path.name, **each.entry}
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
    data = read_bytes(path / INDEX_FILE)
    kind = CsvTripIndex if CsvTripIndex.FORMAT.encode() in data[:LOOKED_AT] else TripIndex
    return kind.from_bytes(data, path / INDEX_FILE)


@contextmanager
def _opened(
    folder: Path, topics: Selection | None
) -> Iterator[tuple[Trip, dict[str, ParquetTopic | CsvTopic]]]:
    """The trip without its topics, and the open files of those wanted."""
    index = trip_index(folder)
    attachments = {}
    for entry in index.attachments:
        attachments[entry.name] = read_bytes(_inside(folder, entry.file))
        if sha256(attachments[entry.name]) != entry.sha256:
            raise damaged(folder / entry.file, "its checksum is another")
    wanted = _wanted(index, topics)
    with ExitStack() as files:
        readers = {}
        for each in index.topics:
            if each.topic in wanted:
                path = _inside(folder, each.file)
                readers[each.topic] = each.reader(path, wanted[each.topic])
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

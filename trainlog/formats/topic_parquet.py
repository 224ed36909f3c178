"""The Parquet file of one topic of a trip, written and read in pieces."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from trainlog.errors import LogError
from trainlog.formats.files import sha256
from trainlog.spans import Spans, overlapping
from trainlog.topics import RECORDED, TOPICS, column_field, topic_of_frame

TIME = "time"
"""The column of the times."""

COMPRESSION_LEVEL = 3
"""Of zstd."""

DICTIONARY = 0.25
"""Share of different values in a column up to which a dictionary of them is kept."""

ROWS = 131_072
"""Rows of a row group: what is compressed, and read, at a time."""


class Pieces:
    """Pieces of one topic as tables: of the same columns and types, their times not decreasing.

    Parameters
    ----------
    topic : str
    frame : DataFrame
        Whose columns and types all pieces have.
    """

    def __init__(self, topic: str, frame: pd.DataFrame) -> None:
        self.topic, self.rows = topic, 0
        self.schema = described(topic, table_of(topic, frame).schema, frame.attrs)
        self._columns = list(frame.columns)
        self._last = np.iinfo(np.int64).min

    def table_of(self, frame: pd.DataFrame) -> pa.Table:
        """The next piece; LogError if its columns are not those of the first, or time runs back."""
        if list(frame.columns) != self._columns:
            raise LogError(
                f"{self.topic} changes its columns on the way",
                remedy=f"give every piece {', '.join(map(str, self._columns))}",
            )
        table = table_of(self.topic, frame, self.schema)
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
        return table


class ParquetTopicWriter:
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
        self.topic, self.path = topic, path
        self._pieces = Pieces(topic, frame)
        self._waiting: list[pa.Table] = []
        self._file: pq.ParquetWriter | None = None

    @property
    def entry(self) -> dict[str, Any]:
        """What the index of the folder states of the closed file."""
        return {"footer": footer_digest(self.path)}

    def add(self, frame: pd.DataFrame) -> None:
        """Append rows; LogError as of `Pieces.table_of`."""
        self._waiting.append(self._pieces.table_of(frame))
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
            self._write(pa.concat_tables([self._pieces.schema.empty_table(), *rest]))
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
        encodings = {field.name: _encoding(first[field.name]) for field in self._pieces.schema}
        return pq.ParquetWriter(
            self.path,
            self._pieces.schema,
            compression="zstd",
            compression_level=COMPRESSION_LEVEL,
            use_dictionary=[name for name, encoding in encodings.items() if encoding is None],
            column_encoding={name: each for name, each in encodings.items() if each},
            write_page_checksum=True,
        )


def table_of(topic: str, frame: pd.DataFrame, schema: pa.Schema | None = None) -> pa.Table:
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


def described(topic: str, schema: pa.Schema, attrs: Mapping[Any, Any]) -> pa.Schema:
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


class ParquetTopic:
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
                raise damaged(path, "its end is another than was written")
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
            raise damaged(self.path, "it is missing") from error
        except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
            raise damaged(self.path, str(error).splitlines()[0][:120]) from error


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


def damaged(path: Path, problem: str) -> LogError:
    """The error for a file that is not as it was written."""
    return LogError(f"is damaged: {problem}", file=path, remedy="convert the log again")

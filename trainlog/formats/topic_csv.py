"""The CSV file of one topic of a trip, units in its header, written and read in pieces."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv

from trainlog.errors import LogError
from trainlog.formats.topic_parquet import TIME, Pieces, times_of
from trainlog.spans import Spans

TYPES = {
    str(kind): kind
    for kind in (
        *(pa.int8(), pa.int16(), pa.int32(), pa.int64()),
        *(pa.uint8(), pa.uint16(), pa.uint32(), pa.uint64()),
        *(pa.float32(), pa.float64(), pa.bool_(), pa.string(), pa.large_string()),
    )
}
"""Types of values that a CSV file gives back as they were, by their name."""

INSTANT = pa.timestamp("ns", "UTC")

BLOCK = 2**22
"""Bytes of a file that are read at a time."""


class CsvTopicWriter:
    """The CSV file of one topic being written; as `ParquetTopicWriter`.

    Raises
    ------
    LogError
        If the frame has no time, or a column that CSV has no text for.
    """

    def __init__(self, topic: str, path: Path, frame: pd.DataFrame) -> None:
        self.topic, self.path = topic, path
        self._pieces, self._attrs = Pieces(topic, frame), frame.attrs
        self._schema = self._pieces.schema
        for item in self._schema:
            if item.name != TIME and str(item.type) not in TYPES:
                raise LogError(
                    f"{item.name} of {topic} is of the type {item.type}, which CSV has no text for",
                    remedy="convert to Parquet, or leave the topic out with 'trainlog convert'",
                )
        self._names = [TIME, *(name for name in self._schema.names if name != TIME)]
        header = pa.schema(
            [
                pa.field(
                    self._title(name), INSTANT if name == TIME else self._schema.field(name).type
                )
                for name in self._names
            ]
        )
        self._file = pa.csv.CSVWriter(path, header)
        self._header = header

    def _title(self, name: str) -> str:
        unit = (self._schema.field(name).metadata or {}).get(b"unit", b"").decode()
        return f"{name} [{unit}]" if unit else name

    @property
    def entry(self) -> dict[str, Any]:
        """What the index of the folder states of the file."""
        kinds = {name: str(self._schema.field(name).type) for name in self._names[1:]}
        return {"columns": kinds, "attrs": dict(self._attrs)}

    def add(self, frame: pd.DataFrame) -> None:
        """Append rows; LogError as of `Pieces.table_of`."""
        table = self._pieces.table_of(frame)
        self._file.write_table(
            table.select(self._names)
            .cast(
                pa.schema(
                    [
                        table.schema.field(n) if n != TIME else pa.field(TIME, INSTANT)
                        for n in self._names
                    ]
                )
            )
            .rename_columns(self._header.names)
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class CsvTopic:
    """The CSV file of one topic, open for reading; as `ParquetTopic`.

    Raises
    ------
    LogError
        If the file is missing, or does not hold the columns that the index names.
    """

    def __init__(
        self,
        path: Path,
        kinds: Mapping[str, str],
        attrs: dict[str, Any],
        columns: list[str] | None = None,
    ) -> None:
        self.path, self._attrs = path, attrs
        self._kinds = {TIME: INSTANT} | {name: _type(kind, path) for name, kind in kinds.items()}
        wanted = set(kinds) if columns is None else set(columns)
        self._columns = [name for name in kinds if name in wanted]
        self._known: dict[str, bool] = {}
        if not path.is_file():
            raise LogError("is missing", file=path, remedy="convert the log again")

    @property
    def schema(self) -> pa.Schema:
        """Of what is read."""
        return pa.schema([pa.field(name, self._kinds[name]) for name in (*self._columns, TIME)])

    def read(self) -> pa.Table:
        """All rows."""
        return pa.concat_tables([self.schema.empty_table(), *self.batches(2**31)])

    def batches(self, rows: int, spans: Spans | None = None) -> Iterator[pa.Table]:  # noqa: ARG002
        """Rows in the order of the file, at most so many at a time; those of all times.

        Raises
        ------
        LogError
            If a row is damaged, or the rows are not in the order of time.
        """
        last, count = np.iinfo(np.int64).min, 0
        with self._named():
            names = self._header()
            reader = pa.csv.open_csv(
                self.path,
                pa.csv.ReadOptions(block_size=BLOCK, column_names=names, skip_rows=1),
                pa.csv.ParseOptions(newlines_in_values=True),
                pa.csv.ConvertOptions(
                    column_types=self._kinds,
                    include_columns=[*self._columns, TIME],
                    null_values=[""],
                    strings_can_be_null=True,
                    quoted_strings_can_be_null=False,
                ),
            )
            for batch in reader:
                times = np.append(last, np.asarray(batch[TIME].cast(pa.int64()).to_numpy()))
                if np.any(times[1:] < times[:-1]):
                    row = count + int(np.argmax(times[1:] < times[:-1])) + 2
                    raise LogError(
                        "time runs backwards", file=self.path, place=f"row {row}",
                        remedy="sort the rows by time",
                    )  # fmt: skip
                last, count = int(times[-1]), count + len(batch)
                for first in range(0, len(batch), rows):
                    yield pa.Table.from_batches([batch.slice(first, rows)], self.schema)

    def _header(self) -> list[str]:
        """Names of the file's columns, without units."""
        with self.path.open(encoding="utf-8-sig", newline="") as file:
            line = file.readline().strip()
        titles = [title.strip().strip('"') for title in line.split(",")]
        names = [title.partition(" [")[0] for title in titles]
        lacking = [name for name in (TIME, *self._columns) if name not in names]
        if lacking:
            raise LogError(
                f"has no column {lacking[0]}", file=self.path, place="row 1",
                remedy=f"it has {', '.join(names)}; convert the log again",
            )  # fmt: skip
        if not names:
            raise LogError("is empty", file=self.path, remedy="convert the log again")
        return names

    def spans(self) -> Spans:
        """First and last time [ns], (1, 2); (0, 2) without rows."""
        ends = [times_of(batch)[[0, -1]] for batch in self.batches(2**31) if len(batch)]
        every = np.array(ends, dtype=np.int64).reshape(-1)
        return np.array([[every[0], every[-1]]] if every.size else np.empty((0, 2)), dtype=np.int64)

    def knows(self, name: str) -> bool:
        """Whether a column has any value."""
        if name not in self._columns:
            return False
        return any(batch[name].null_count < len(batch) for batch in self.batches(2**31))

    def frame(self, table: pa.Table) -> pd.DataFrame:
        """The frame of rows that were read."""
        frame: pd.DataFrame = table.drop_columns([TIME]).to_pandas()
        frame.index = pd.DatetimeIndex(times_of(table).view("M8[ns]"), tz="UTC", name=TIME)
        attrs: dict[Any, Any] = dict(self._attrs)
        if isinstance(attrs.get("units"), dict):
            attrs["units"] = {n: u for n, u in attrs["units"].items() if n in self._columns}
        frame.attrs = attrs
        return frame

    def close(self) -> None:
        """Nothing is open between two batches."""

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Turn the exceptions of Arrow into errors that name the file."""
        try:
            yield
        except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
            raise LogError(
                f"cannot be read: {str(error).splitlines()[0][:160]}",
                file=self.path,
                remedy="correct the row, or convert the log again",
            ) from error


def _type(kind: str, path: Path) -> pa.DataType:
    if kind not in TYPES:
        raise LogError(f"states the unknown type '{kind}'", file=path, remedy="convert again")
    return TYPES[kind]

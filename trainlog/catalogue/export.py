"""Trips of a catalogue as a file for other programs: CSV or Parquet."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from trainlog.catalogue.schema import TRIP_COLUMNS
from trainlog.errors import InputError
from trainlog.formats.files import atomic_write


def write_trips(frame: pd.DataFrame, path: str | Path) -> None:
    """Write a frame of trips, whole or not at all.

    Headings of CSV name the unit, as ``duration [s]``; in Parquet the fields' metadata do. What
    holds several values, as the topics do, is JSON.

    Parameters
    ----------
    frame : DataFrame
        As `Catalogue.query` gives it.
    path : path
        Ending in ``.csv`` or ``.parquet``.

    Raises
    ------
    InputError
        If the ending is another, or it cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.catalogue import open_catalogue
    >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
    ...     _ = catalogue.add("sample_logs")
    ...     write_trips(catalogue.query(columns=["name", "duration"]), Path(folder) / "trips.csv")
    ...     print((Path(folder) / "trips.csv").read_text(), end="")
    name,duration [s]
    trip-01,1183.1
    trip-03,1413.9
    """
    kind = Path(path).suffix
    if kind not in (".csv", ".parquet"):
        raise InputError(
            "is not the name of a .csv or .parquet file", file=path, remedy="end it in one of them"
        )
    columns = {each.name: each for each in TRIP_COLUMNS}
    shown = frame.copy()
    for name in shown:
        column = columns.get(str(name))
        if column is not None and column.kind == "json":
            texts = [None if each is None else _text(each) for each in shown[name]]
            shown[name] = pd.Series(texts, index=shown.index, dtype=object)
    units = {name: columns[name].unit for name in shown if name in columns}
    with atomic_write(path) as temporary:
        if kind == ".csv":
            for name in shown:
                if isinstance(shown[name].dtype, pd.DatetimeTZDtype):
                    shown[name] = [None if pd.isna(t) else t.isoformat() for t in shown[name]]
            headings = {name: f"{name} [{unit}]" for name, unit in units.items() if unit}
            shown.rename(columns=headings).to_csv(temporary, index=False)
            return
        table = pa.Table.from_pandas(shown, preserve_index=False).replace_schema_metadata(None)
        fields = [
            field.with_metadata({"unit": units[field.name]}) if units.get(field.name) else field
            for field in table.schema
        ]
        pq.write_table(table.cast(pa.schema(fields)), temporary, compression="zstd")


def _text(value: object) -> str:
    return json.dumps(value, sort_keys=True, ensure_ascii=False)

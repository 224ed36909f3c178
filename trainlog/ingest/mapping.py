"""Columns of a file become fields of our topics: numbers, signs, units. Converted here, once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from trainlog.errors import InputError
from trainlog.ingest.profile import WORDS, Column, Profile
from trainlog.ingest.recording import (
    NO_TIME,
    SHOWN_ROWS,
    TIME_CELL,
    BoolArray,
    Finding,
    FloatArray,
    IntArray,
    Raw,
    Recording,
    Table,
    field_of,
)
from trainlog.ingest.textfile import Cells
from trainlog.ingest.timestamps import read_time
from trainlog.units import to_si

MAX_UNREADABLE = 0.5
"""Share of the cells of a number column that may be text before the column is refused."""


def wanted_columns(profile: Profile, present: tuple[str, ...], file: Path) -> list[str]:
    """Names of the file's columns that the profile needs.

    Raises
    ------
    InputError
        If the profile lacks what a table needs: [time] and [columns].
    """
    if profile.time is None or not profile.columns:
        lacking = "[time]" if profile.time is None else "[columns]"
        raise InputError(
            f"profile '{profile.name}' has no {lacking} section",
            file=file,
            remedy="say where time stands and which column is what; docs/ingest.md has an example",
        )
    names = list(profile.time.names)
    for column in profile.columns.values():
        if not (column.optional and not set(column.names) <= set(present)):
            names += column.names
    return names


def recording_of(
    cells: Cells, profile: Profile, file: Path, time: IntArray | None = None
) -> Recording:
    """The recording that a table of cells holds, as the profile describes it.

    Parameters
    ----------
    cells : Cells
        With the columns that `wanted_columns` names.
    file : Path
        For messages.
    time : (n,) int64 array [ns], optional
        Time of the rows, where the file itself tells it; default: as the profile says.

    Raises
    ------
    InputError
        If a column holds no numbers, or no number at all is to be found.
    """
    raw = list(cells.raw)
    if time is None:
        assert profile.time is not None, "wanted_columns checks it"
        time = read_time(cells.table, profile.time, profile.file.decimal, file)
        raw += _unreadable_times(cells, profile.time.names, time)
    values: dict[str, FloatArray] = {}
    texts: dict[str, NDArray[np.object_]] = {}
    constants: dict[str, float | str] = {}
    findings = list(cells.findings)
    present = set(cells.table.column_names)
    times = set(profile.time.names) if profile.time is not None else set()
    for name, column in profile.columns.items():
        if column.optional and not set(column.names) <= present:
            continue
        if isinstance(column.value, str):
            constants[name] = column.value
        elif column.value is not None:
            constants[name] = float(in_si(name, column, np.asarray(column.value)))
        elif name in WORDS:
            texts[name] = _words(cells.table, column)
        else:
            found, met, garbled = _field(name, column, cells, profile, file)
            values |= found
            findings += met
            raw += [
                Raw(
                    "not_a_number", target, cells.rows[mask], _text(cells, source, mask), time[mask]
                )
                for target, source, mask in garbled
            ]
    if not texts and not any(np.isfinite(column).any() for column in values.values()):
        raise InputError(
            "none of the mapped columns holds a number",
            file=file,
            place=f"columns {', '.join(sorted(present - times))}",
            remedy="check the columns under [columns] of the profile",
        )
    table = Table(time, cells.rows, values, texts)
    return Recording((table,), cells.rows_read, tuple(findings), constants, raw=tuple(raw))


def _unreadable_times(cells: Cells, names: tuple[str, ...], time: IntArray) -> list[Raw]:
    """What stood where a time should."""
    lost = time == NO_TIME
    if not lost.any():
        return []
    columns = [_text(cells, name, lost) for name in names]
    words = np.array([" ".join(parts) for parts in zip(*columns, strict=True)], dtype=np.object_)
    return [Raw("time_unreadable", TIME_CELL, cells.rows[lost], words)]


def _text(cells: Cells, column: str, rows: BoolArray) -> NDArray[np.object_]:
    """The text of some cells of a column; empty where there is none."""
    picked = pc.fill_null(pc.cast(cells.table[column].filter(pa.array(rows)), pa.string()), "")
    return np.asarray(picked.to_pylist(), dtype=np.object_)


def _field(
    name: str, column: Column, cells: Cells, profile: Profile, file: Path
) -> tuple[dict[str, FloatArray], list[Finding], list[tuple[str, str, BoolArray]]]:
    """The values of one field, one entry an axle where it has several, and what was met.

    Also which cells of which column of ours and of the file are no numbers.
    """
    texts: list[tuple[str, str, BoolArray]] = []
    values: dict[str, FloatArray] = {}
    empty = np.zeros(0, dtype=np.int64)
    unreadable = empty
    for axle, source in enumerate(column.names, start=1):
        raw, absent, garbled = numbers(cells.table[source], profile.file.decimal)
        _refuse_garbled(source, cells, raw, garbled, profile, file)
        target = f"{name}_{axle}" if column.columns else name
        values[target] = in_si(name, column, raw)
        empty = np.append(empty, cells.rows[absent])
        unreadable = np.append(unreadable, cells.rows[garbled])
        if garbled.any():
            texts.append((target, source, garbled))
    findings = [
        Finding(rule, rows.size, tuple(int(row) for row in np.sort(rows)[:SHOWN_ROWS]), name)
        for rule, rows in (("empty", empty), ("not_a_number", unreadable))
        if rows.size
    ]
    return values, findings, texts


def _refuse_garbled(
    source: str,
    cells: Cells,
    raw: FloatArray,
    garbled: BoolArray,
    profile: Profile,
    file: Path,
) -> None:
    count, readable = np.count_nonzero(garbled), np.count_nonzero(np.isfinite(raw))
    if count <= MAX_UNREADABLE * (count + readable):
        return
    at = int(np.argmax(garbled))
    cell = str(cells.table[source][at].as_py())
    comma = profile.file.decimal == "." and "," in cell
    raise InputError(
        f"{count} cells are no numbers, the first is {_short(cell)!r}",
        file=file,
        place=f"row {cells.rows[at]}, column {source}",
        remedy=(
            'set decimal = "," under [file] of the profile'
            if comma
            else f"check which column it is, and delimiter {profile.file.delimiter!r}"
        ),
    )


def _short(text: str) -> str:
    return text if len(text) <= 30 else text[:27] + "..."


def numbers(column: pa.ChunkedArray, decimal: str) -> tuple[FloatArray, BoolArray, BoolArray]:
    """A column as numbers.

    Returns
    -------
    values : (n,) array
        NaN where there is none.
    empty : (n,) bool array
        Cells without a value.
    garbled : (n,) bool array
        Cells with a value that is no finite number.
    """
    if pa.types.is_dictionary(column.type):
        column = pc.cast(column, column.type.value_type)
    text = pa.types.is_string(column.type) or pa.types.is_large_string(column.type)
    if text and decimal == ",":
        column = pc.replace_substring(column, ",", ".")
    try:
        cast = pc.cast(column, pa.float64())
        blank = np.zeros(len(column), dtype=np.bool_)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        # Text among the numbers: slower, cell by cell.
        words = pc.utf8_trim_whitespace(pc.cast(column, pa.string()))
        blank = pc.fill_null(pc.equal(words, ""), False).to_numpy()
        cast = pa.chunked_array([pd.to_numeric(words.to_pandas(), errors="coerce")])
    values = np.array(pc.fill_null(pc.cast(cast, pa.float64()), np.nan).to_numpy())
    empty = pc.is_null(column).to_numpy() | blank
    if pa.types.is_floating(column.type):
        empty |= np.isnan(values)
    garbled = ~np.isfinite(values) & ~empty
    values[garbled] = np.nan
    return values, empty, garbled


def _words(table: pa.Table, column: Column) -> NDArray[np.object_]:
    text = pc.fill_null(pc.cast(table[column.names[0]], pa.string()), "")
    return np.asarray(pc.utf8_trim_whitespace(text).to_pylist(), dtype=np.object_)


def in_si(name: str, column: Column, raw: FloatArray | NDArray[np.float64]) -> FloatArray:
    """``sign * part(raw * scale + offset)`` in the column's unit, converted to SI."""
    scaled = raw
    if column.scale != 1.0:
        # 1e-7 as a factor is not exact; dividing by 1e7 is.
        inverse = round(1.0 / column.scale) if 0.0 < abs(column.scale) < 1.0 else 0
        exact = inverse and abs(inverse * column.scale - 1.0) < 1e-12
        scaled = raw / inverse if exact else raw * column.scale
    if column.offset:
        scaled = scaled + column.offset
    if column.part == "positive":
        scaled = np.where(scaled > 0.0, scaled, np.where(np.isnan(scaled), np.nan, 0.0))
    elif column.part == "negative":
        scaled = np.where(scaled < 0.0, -scaled, np.where(np.isnan(scaled), np.nan, 0.0))
    if column.sign < 0:
        scaled = 0.0 - scaled
    _, _, item = field_of(name)
    unit = column.unit if column.unit is not None else item.unit
    return to_si(scaled, unit, item.unit) if item.unit else np.asarray(scaled, dtype=np.float64)

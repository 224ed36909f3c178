"""Columns that are filled message by message, and what could not become a column."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pandas as pd

from trainlog.mcap.foreign_rows import Length, Message, Unexpanded, leaves

MOST_COLUMNS = 2_000
"""Columns of a topic; names that are made up message by message must not fill the memory."""

_TOO_MANY = f"beyond the first {MOST_COLUMNS:,} columns of the topic"
_TWICE = "named twice in a message; the first is kept"
_VARYING = "an array whose length changes, not expanded"
_MIXED = "numbers in some messages, text in others"


class _Column:
    """The values of one path; `rows` tells which messages have one."""

    def __init__(self) -> None:
        self.rows: list[int] = []
        self.values: list[Any] = []


class Columns:
    """The columns of a topic while its messages are added.

    Attributes
    ----------
    skipped : Counter of (str, str)
        How many messages had a field (path) that did not become a column, by its reason.
    """

    def __init__(self) -> None:
        self.skipped: Counter[tuple[str, str]] = Counter()
        self._columns: dict[str, _Column] = {}
        self._lengths: dict[str, Counter[int]] = {}

    def add(self, row: int, message: Message) -> None:
        """Add what a decoded message says as row `row`."""
        for path, value in leaves(message):
            if isinstance(value, Unexpanded):
                self._skip(path, value.reason)
            elif isinstance(value, Length):
                self._announce(path, value.count)
            else:
                self._put(row, path, value)

    def frame(self, count: int) -> dict[str, Any]:
        """The columns, each of `count` rows; absent values are NaN, or NA in whole numbers."""
        for path, lengths in self._lengths.items():
            if sum(1 for length in lengths if length) > 1:
                self._drop(f"{path}[")
                self.skipped[path, _VARYING] += lengths.total()
        found = {}
        for path, column in self._columns.items():
            values = _array(column, count)
            if values is None:
                self.skipped[path, _MIXED] += len(column.rows)
            else:
                found[path] = values
        return found

    def _put(self, row: int, path: str, value: Any) -> None:
        column = self._columns.get(path)
        if column is None:
            if len(self._columns) >= MOST_COLUMNS:
                self._skip("", _TOO_MANY)
                return
            column = self._columns[path] = _Column()
        elif column.rows[-1] == row:
            self._skip(path, _TWICE)
            return
        column.rows.append(row)
        column.values.append(value)

    def _announce(self, path: str, length: int) -> None:
        if path in self._lengths or len(self._lengths) < MOST_COLUMNS:
            self._lengths.setdefault(path, Counter())[length] += 1

    def _skip(self, path: str, reason: str) -> None:
        known = (path, reason) in self.skipped or len(self.skipped) < MOST_COLUMNS
        self.skipped[(path, reason) if known else ("", _TOO_MANY)] += 1

    def _drop(self, start: str) -> None:
        self._columns = {
            path: column for path, column in self._columns.items() if not path.startswith(start)
        }


def _array(column: _Column, count: int) -> Any:
    """A column as an array of `count` rows; None if it holds both numbers and text."""
    kinds = set(map(type, column.values))
    if str in kinds:
        return _texts(column, count) if kinds == {str} else None
    if kinds == {bool}:
        return _whole(column, count, np.bool_, "boolean")
    if float not in kinds:
        lowest, highest = min(column.values), max(column.values)
        if lowest >= -(2**63) and highest < 2**63:
            return _whole(column, count, np.int64, "Int64")
        if lowest >= 0 and highest < 2**64:
            return _whole(column, count, np.uint64, "UInt64")
    values = np.full(count, np.nan)
    values[column.rows] = [_as_float(value) for value in column.values]
    return values


def _whole(column: _Column, count: int, plain: type, nullable: Any) -> Any:
    """Whole numbers or flags; with NA, which leaves large ones exact, where there are none."""
    values: Any = np.zeros(count, dtype=plain)
    values[column.rows] = column.values
    if len(column.rows) == count:
        return values
    absent = np.ones(count, dtype=np.bool_)
    absent[column.rows] = False
    found: Any = pd.Series(values).astype(nullable).array
    found[absent] = pd.NA
    return found


def _texts(column: _Column, count: int) -> Any:
    texts: list[str | None] = [None] * count
    for row, text in zip(column.rows, column.values, strict=True):
        # JSON can name halves of surrogate pairs, which no file can be written with.
        texts[row] = text if text.isascii() else text.encode("utf-8", "replace").decode()
    return pd.array(texts, dtype="str")


def _as_float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:
        return np.inf if value > 0 else -np.inf

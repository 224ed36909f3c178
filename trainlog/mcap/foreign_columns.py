"""Columns that are filled from decoded messages, and what could not become a column.

Messages are taken in batches. As long as all of a batch have the same fields, which is the rule,
a batch is turned from rows into columns at once; what differs is taken value by value.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import chain
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd

from trainlog.mcap.foreign_rows import (
    DEEPEST,
    MOST_ELEMENTS,
    Length,
    Message,
    Unexpanded,
    leaves,
)

MOST_COLUMNS = 2_000
"""Columns of a topic; names that are made up message by message must not fill the memory."""

_BATCH = 1_024
"""Messages that are turned into columns at once."""

_BATCH_BYTES = 2**20
"""Length of these messages; as objects they take many times that."""

_PLAIN = {bool, int, float, str}

_TOO_MANY = f"beyond the first {MOST_COLUMNS:,} columns of the topic"
_TWICE = "named twice in a message; the first is kept"
_VARYING = "an array whose length changes, not expanded"
_MIXED = "numbers in some messages, text in others"


class _Column:
    """The values of one path; `rows` tells which messages have one."""

    def __init__(self) -> None:
        self.rows = array("q")
        self.kinds: set[type] = set()
        self.pieces: list[Any] = []

    def put(self, row: int, value: Any) -> None:
        """Add one value."""
        if not self.pieces or not isinstance(self.pieces[-1], list):
            self.pieces.append([])
        self.pieces[-1].append(value)
        self.rows.append(row)
        self.kinds.add(type(value))

    def extend(self, rows: Iterable[int], values: Sequence[Any], kinds: set[type]) -> None:
        """Add the values of many messages."""
        self.pieces.append(_packed(values, kinds))
        self.rows.extend(rows)
        self.kinds |= kinds

    def values(self) -> list[Any]:
        """All values, as they came."""
        return list(
            chain.from_iterable(
                piece if isinstance(piece, list) else piece.tolist() for piece in self.pieces
            )
        )


def _packed(values: Sequence[Any], kinds: set[type]) -> Any:
    """Numbers of one kind as an array, to save memory; everything else as a list."""
    try:
        if kinds == {float}:
            return np.array(values, dtype=np.float64)
        if kinds == {int}:
            return np.array(values, dtype=np.int64)
    except OverflowError:
        pass
    return list(values)


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
        self._batch: list[Message] = []
        self._waiting = 0
        self._count = 0

    def add(self, message: Message, size: int) -> None:
        """Add what a decoded message of `size` bytes says as the next row."""
        self._batch.append(message)
        self._waiting += size
        if len(self._batch) >= _BATCH or self._waiting >= _BATCH_BYTES:
            self._flush()

    def frame(self) -> dict[str, Any]:
        """The columns; absent values are NaN, or NA in whole numbers and flags."""
        self._flush()
        for path, lengths in self._lengths.items():
            if sum(1 for length in lengths if length) > 1:
                self._drop(f"{path}[")
                self.skipped[path, _VARYING] += lengths.total()
        found = {}
        for path, column in self._columns.items():
            values = _array(column, self._count)
            if values is None:
                self.skipped[path, _MIXED] += len(column.rows)
            else:
                found[path] = values
        return found

    def _flush(self) -> None:
        """Turn the messages that wait into columns."""
        batch, self._batch, self._waiting = self._batch, [], 0
        rows = range(self._count, self._count + len(batch))
        self._count = rows.stop
        if batch:
            self._spread(batch, rows, "", 0)

    def _spread(self, messages: Sequence[Message], rows: range, prefix: str, depth: int) -> None:
        """Take messages, or messages within them, that stand at the same path of all rows."""
        names = list(messages[0])
        if any(message.keys() != messages[0].keys() for message in messages):
            for row, message in zip(rows, messages, strict=True):
                self._take(row, message, prefix, depth)
            return
        for name in names:
            path = f"{prefix}.{name}" if prefix else name
            self._take_column(rows, path, list(map(itemgetter(name), messages)), depth)

    def _take_column(self, rows: range, path: str, values: Sequence[Any], depth: int) -> None:
        """Take what stands at the same path of all rows."""
        kinds = set(map(type, values))
        if kinds <= _PLAIN:
            self._extend(rows, path, values, kinds)
        elif kinds == {dict} and depth < DEEPEST:
            self._spread(values, rows, path, depth + 1)
        elif kinds == {list} and depth < DEEPEST and len(lengths := set(map(len, values))) == 1:
            (length,) = lengths
            if length > MOST_ELEMENTS:
                self._take_each(rows, path, values, depth)
                return
            self._announce(path, length, len(values))
            for at in range(length):
                elements = list(map(itemgetter(at), values))
                self._take_column(rows, f"{path}[{at}]", elements, depth + 1)
        else:
            self._take_each(rows, path, values, depth)

    def _take_each(self, rows: range, path: str, values: Sequence[Any], depth: int) -> None:
        for row, value in zip(rows, values, strict=True):
            self._take(row, {path: value}, "", depth)

    def _take(self, row: int, message: Message, prefix: str, depth: int) -> None:
        """Take what one message says."""
        for path, value in leaves(message, prefix, depth):
            if isinstance(value, Unexpanded):
                self._skip(path, value.reason)
            elif isinstance(value, Length):
                self._announce(path, value.count)
            elif (column := self._column(path, row)) is not None:
                column.put(row, value)

    def _extend(self, rows: range, path: str, values: Sequence[Any], kinds: set[type]) -> None:
        column = self._column(path, rows.start, len(rows))
        if column is not None:
            column.extend(rows, values, kinds)

    def _column(self, path: str, row: int, messages: int = 1) -> _Column | None:
        """The column at `path`, to take values from `row` on; None if it cannot."""
        column = self._columns.get(path)
        if column is None:
            if len(self._columns) >= MOST_COLUMNS:
                self._skip("", _TOO_MANY, messages)
                return None
            column = self._columns[path] = _Column()
        elif column.rows and column.rows[-1] >= row:
            self._skip(path, _TWICE, messages)
            return None
        return column

    def _announce(self, path: str, length: int, messages: int = 1) -> None:
        if path in self._lengths or len(self._lengths) < MOST_COLUMNS:
            self._lengths.setdefault(path, Counter())[length] += messages

    def _skip(self, path: str, reason: str, messages: int = 1) -> None:
        known = (path, reason) in self.skipped or len(self.skipped) < MOST_COLUMNS
        self.skipped[(path, reason) if known else ("", _TOO_MANY)] += messages

    def _drop(self, start: str) -> None:
        self._columns = {
            path: column for path, column in self._columns.items() if not path.startswith(start)
        }


def _array(column: _Column, count: int) -> Any:
    """A column as an array of `count` rows; None if it holds both numbers and text."""
    rows = np.frombuffer(column.rows, dtype=np.int64)
    if str in column.kinds:
        return _texts(column, count) if column.kinds == {str} else None
    if column.kinds == {bool}:
        return _whole(rows, np.array(column.values(), dtype=np.bool_), count, "boolean")
    if float not in column.kinds:
        whole = _whole_numbers(column)
        if whole is not None:
            return _whole(rows, whole, count, "Int64" if whole.dtype == np.int64 else "UInt64")
    values = np.full(count, np.nan)
    values[rows] = np.concatenate([_floats(piece) for piece in column.pieces])
    return values


def _whole_numbers(column: _Column) -> Any:
    """Whole numbers as int64 or uint64; None if they fit neither."""
    if all(isinstance(piece, np.ndarray) for piece in column.pieces):
        return np.concatenate(column.pieces)
    values = column.values()
    for kind in (np.int64, np.uint64):
        try:
            return np.array(values, dtype=kind)
        except OverflowError:
            continue
    return None


def _whole(rows: Any, found: Any, count: int, nullable: Any) -> Any:
    """Whole numbers or flags; with NA, which leaves large ones exact, where there are none."""
    if len(rows) == count:
        return found
    values = np.zeros(count, dtype=found.dtype)
    values[rows] = found
    absent = np.ones(count, dtype=np.bool_)
    absent[rows] = False
    series: Any = pd.Series(values).astype(nullable).array
    series[absent] = pd.NA
    return series


def _texts(column: _Column, count: int) -> Any:
    texts: list[str | None] = [None] * count
    for row, text in zip(column.rows, column.values(), strict=True):
        # JSON can name halves of surrogate pairs, which no file can be written with.
        texts[row] = text if text.isascii() else text.encode("utf-8", "replace").decode()
    return pd.array(texts, dtype="str")


def _floats(piece: Any) -> Any:
    if isinstance(piece, np.ndarray):
        return piece.astype(np.float64)
    return np.array([_as_float(value) for value in piece])


def _as_float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:
        return np.inf if value > 0 else -np.inf

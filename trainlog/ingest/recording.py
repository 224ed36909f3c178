"""What a recorded file holds before repair: tables of SI numbers, with the file's row numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.display import as_text, counted
from trainlog.topics import EVENTS, RECORDED, TOPICS, Field, Topic, column_field, recorded_topic
from trainlog.trip import frame_of

NO_TIME = int(np.iinfo(np.int64).min)
"""Time of a row whose clock could not be read."""

TIME_CELL = "time"
"""Column of a `Raw` that holds times which could not be read."""

METRES_PER_DEGREE = 111_195.0
"""Length of a degree of latitude [m]."""

INFO, WARNING = 2, 3
"""Levels of events; the first of those whose column gives none."""

SHOWN_ROWS = 5
"""How many of the rows concerned a finding names."""

SHOWN = 10
"""How many of many lines, files or topics are shown."""

SELDOM, MOST, NEARLY_ALL = 0.05, 0.5, 0.9
"""Share of rows up to which something is an exception; from which on it is usual, so that what is
wrong is not the rows but what is thought of them; from which on the others are exceptions."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One kind of defect in one column (or in whole rows), and how often it was met.

    Attributes
    ----------
    rule : str
        Name of the rule that dealt with it; see `trainlog.ingest.rules`.
    count : int
        Rows, cells or, for gaps, places.
    rows : tuple of int
        The first rows of the file concerned, as an editor counts them.
    column : str
        ``"/topic.field"``; empty if the rule deals with whole rows.
    note : str
        A figure that belongs to it, such as the longest gap.
    """

    rule: str
    count: int
    rows: tuple[int, ...] = ()
    column: str = ""
    note: str = ""

    @classmethod
    def met(cls, rule: str, rows: IntArray, column: str = "", note: str = "") -> list[Finding]:
        """The finding that a rule met rows of the file, in any order; none if there are none.

        Examples
        --------
        >>> Finding.met("empty", np.array([7, 3]))
        [Finding(rule='empty', count=2, rows=(3, 7), column='', note='')]
        """
        first = tuple(np.sort(rows)[:SHOWN_ROWS].tolist())
        return [cls(rule, rows.size, first, column, note)] if rows.size else []


@dataclass(frozen=True, eq=False)
class Table:
    """Samples that share a clock.

    Attributes
    ----------
    time : (n,) int64 array [ns]
        UTC since 1970; `NO_TIME` where it could not be read.
    rows : (n,) int64 array
        Row of the file that each sample comes from, as an editor counts them.
    signals : dict of str to (n,) array
        By ``"/topic.column"`` (``"/train/axles.wheel_speed_2"``), in SI; NaN where absent.
    texts : dict of str to (n,) object array
        The same for the fields that are words; empty where absent.
    samples : (n,) int64 array
        Number of each sample in the table as it was read; set by the table itself.

    Examples
    --------
    >>> time = 1_714_543_200_000_000_000 + 1_000_000_000 * np.arange(3)
    >>> Table(time, np.arange(1, 4), {"/train/state.speed": np.array([0.0, 0.4, 0.9])})
    Table: 3 rows of /train/state.speed
    """

    time: IntArray
    rows: IntArray
    signals: dict[str, FloatArray]
    texts: dict[str, NDArray[np.object_]] = field(default_factory=dict)
    samples: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        if self.samples.size != self.time.size:
            object.__setattr__(self, "samples", np.arange(self.time.size, dtype=np.int64))

    def __len__(self) -> int:
        return int(self.time.size)

    def __repr__(self) -> str:
        return f"Table: {counted(len(self), 'row')} of {', '.join([*self.signals, *self.texts])}"

    def take(self, index: IntArray | BoolArray) -> Table:
        """The table with the rows that `index` selects, in its order."""
        if index.dtype == np.bool_ and index.all():
            return self
        return Table(
            self.time[index],
            self.rows[index],
            {name: values[index] for name, values in self.signals.items()},
            {name: texts[index] for name, texts in self.texts.items()},
            self.samples[index],
        )

    def then(self, other: Table) -> Table:
        """These samples and behind them others; what one of them does not hold is absent there."""
        tables = (self, other)

        def of(kind: str, empty: Any) -> dict[str, Any]:
            names = dict.fromkeys((*getattr(self, kind), *getattr(other, kind)))
            return {
                name: np.concatenate(
                    [getattr(each, kind).get(name, np.full(len(each), empty)) for each in tables]
                )
                for name in names
            }

        return Table(
            np.concatenate((self.time, other.time)),
            np.concatenate((self.rows, other.rows)),
            of("signals", np.nan),
            {name: words.astype(np.object_) for name, words in of("texts", "").items()},
        )

    def at(self, time: IntArray) -> Table:
        """The same samples at other times [ns]."""
        return replace(self, time=time)

    def without(self, name: str, cells: BoolArray) -> Table:
        """The table in which the marked cells of a column are absent."""
        return self.with_values(name, np.where(cells, np.nan, self.signals[name]))

    def with_values(self, name: str, values: FloatArray) -> Table:
        """The table with other values in a column."""
        return replace(self, signals={**self.signals, name: values})

    def found(self, rule: str, cells: BoolArray, column: str = "", note: str = "") -> list[Finding]:
        """The finding that `rule` met the marked rows; none if there are none."""
        return Finding.met(rule, self.rows[cells], column, note)


@dataclass(frozen=True, eq=False)
class Raw:
    """What stood in rows or cells before a rule dealt with them.

    Attributes
    ----------
    rule : str
        Name of the rule.
    column : str
        ``"/topic.column"``, `TIME_CELL`, or empty for whole rows.
    rows : (n,) int64 array
        Rows of the file.
    text : (n,) object array, optional
        What stood there, where it could not be read.
    time, new_time : (n,) int64 array [ns], optional
        Of the rows before and after the rule, by default the same, `NO_TIME` where it could not be
        read; `NO_TIME` after the rule, but not before: the row was dropped.
    value, new_value : (n,) array, optional
        Before and after the rule, in SI; NaN: absent.
    """

    rule: str
    column: str
    rows: IntArray
    text: NDArray[np.object_] | None = None
    time: IntArray | None = None
    new_time: IntArray | None = None
    value: FloatArray | None = None
    new_value: FloatArray | None = None

    @classmethod
    def lines(cls, rule: str, rows: IntArray, text: Sequence[str]) -> tuple[Raw, ...]:
        """What stood in whole rows; none if there are none."""
        return (cls(rule, "", rows, np.array(text, dtype=np.object_)),) if rows.size else ()

    def take(self, index: slice | BoolArray) -> Raw:
        """The entries that `index` selects."""
        arrays: dict[str, Any] = {
            name: values[index]
            for name, values in vars(self).items()
            if isinstance(values, np.ndarray)
        }
        return replace(self, **arrays)


@dataclass(frozen=True, eq=False)
class Cells:
    """The columns of a file that are needed.

    Attributes
    ----------
    table : pyarrow.Table
        One column a name, of text or as the file types them.
    rows : (n,) int64 array
        Row of the file, as an editor counts them.
    rows_read : int
        `n` and the rows that could not be split into cells.
    findings : tuple of Finding
    raw : tuple of Raw
    """

    table: pa.Table
    rows: IntArray
    rows_read: int
    findings: tuple[Finding, ...] = ()
    raw: tuple[Raw, ...] = ()


@dataclass(frozen=True, eq=False)
class Recording:
    """What a format's reader hands over: SI units, nothing repaired that later rules repair.

    Attributes
    ----------
    tables : tuple of Table
        One a clock; no two tables hold columns of the same topic.
    rows_read : int
        Rows of data in the file, those included that could not be split into cells.
    findings : tuple of Finding
        What the reader itself met: ragged rows, cells that are empty or no number.
    constants : dict of str to float or str
        By ``"/topic.field"``, in SI: what does not change over the trip.
    metadata : dict of str to str
        What the file states of the trip, such as the recorder's clock. Where a file holds several
        recordings, ``"trip"`` names this one.
    not_used : dict of str to int
        What the file holds besides and was not used, such as messages of other kinds, by name,
        with how many there are.
    inputs : tuple of Path
        Further files that were read beside the one given.
    attachments : dict of str to bytes
        Files to be carried along with the trip.
    raw : tuple of Raw
        What stood where the reader met no number, no time or no whole row.
    about : dict of str to (n,) object array
        Cells of the columns that state facts of a trip, such as its number or load, by column; one
        a row of the first table.
    unplaced : tuple of (int, int) [ns]
        Times between which fixes lie on edges of a network without a course.

    Examples
    --------
    >>> table = Table(np.arange(2), np.arange(1, 3), {"/train/state.speed": np.zeros(2)})
    >>> Recording((table,), rows_read=2)
    Recording: 2 rows read
      table 0  Table: 2 rows of /train/state.speed
    """

    tables: tuple[Table, ...]
    rows_read: int
    findings: tuple[Finding, ...] = ()
    constants: dict[str, float | str] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    not_used: dict[str, int] = field(default_factory=dict)
    inputs: tuple[Path, ...] = ()
    attachments: dict[str, bytes] = field(default_factory=dict)
    raw: tuple[Raw, ...] = ()
    about: dict[str, NDArray[np.object_]] = field(default_factory=dict)
    unplaced: tuple[tuple[int, int], ...] = ()

    def __repr__(self) -> str:
        rows = {f"table {number}": repr(table) for number, table in enumerate(self.tables)}
        return as_text(f"Recording: {counted(self.rows_read, 'row')} read", rows)


def together(parts: Sequence[Recording], **more: Any) -> Recording:
    """The recording that several parts of a file make; `more` is given as to `Recording`."""
    constants: dict[str, float | str] = {}
    for part in parts:
        constants |= part.constants
    return Recording(
        tuple(table for part in parts for table in part.tables),
        sum(part.rows_read for part in parts),
        tuple(finding for part in parts for finding in part.findings),
        constants,
        raw=tuple(raw for part in parts for raw in part.raw),
        **more,
    )


def field_of(name: str) -> tuple[Topic, str, Field]:
    """Topic, column and field of ``"/topic.column"``.

    A field with one value an axle may be named with the number of an axle or, for all of them,
    without.

    Of a topic of the recorder's own only the names are known here.

    Raises
    ------
    KeyError
        If the table of topics has no such column.
    """
    topic_name, _, column = name.rpartition(".")
    if topic_name.startswith(RECORDED):
        own = recorded_topic(topic_name, [Field(column, "", "")])
        return own, column, own.fields[0]
    topic = TOPICS[topic_name]
    for item in topic.fields:
        if item.name == column:
            return topic, column, item
    return topic, column, column_field(topic, column)


def carried_on(words: NDArray[np.object_]) -> NDArray[np.object_]:
    """Words, and where there is none the one before.

    Examples
    --------
    >>> carried_on(np.array(["", "a", "", "b"], dtype=object)).tolist()
    ['', 'a', 'a', 'b']
    """
    return words[np.maximum.accumulate(np.where(words != "", np.arange(words.size), 0))]


def base_name(name: str) -> str:
    """``"/topic.field"`` of a column, without the number of the axle."""
    topic, _, item = field_of(name)
    return f"{topic.name}.{item.name}"


HORIZONTAL_PER_HDOP = 3.0
"""Standard deviation of each horizontal axis [m] at an HDOP of 1."""

VERTICAL_PER_VDOP = 4.2
"""Standard deviation of the altitude [m] at a VDOP of 1."""


def frames(
    tables: list[Table], constants: dict[str, float | str], own: Mapping[str, Topic]
) -> dict[str, pd.DataFrame]:
    """One frame a topic, in the order of the table of topics; behind them the recorder's `own`.

    A row without a value of a topic is no row of its frame. A constant fills the rows of its
    topic; where the topic has nothing else, it stands at both ends of the trip.
    """
    found: dict[str, pd.DataFrame] = {}
    for name, topic in {**TOPICS, **own}.items():
        fixed = _of_topic(constants, name)
        for table in tables:
            frame = _frame(topic, table, fixed)
            if frame is not None:
                found[name] = frame
        if fixed and name not in found:
            ends = np.array([min(t.time[0] for t in tables), max(t.time[-1] for t in tables)])
            found[name] = frame_of(topic, _index(ends), _filled(fixed, 2))
    return found


def _frame(topic: Topic, table: Table, fixed: dict[str, Any]) -> pd.DataFrame | None:
    """The frame of a topic that a table gives; None if it has no value of it."""
    signals = _of_topic(table.signals, topic.name)
    texts = _of_topic(table.texts, topic.name)
    present = _any([np.isfinite(values) for values in signals.values()], len(table))
    if texts:
        present = _any([words != "" for words in texts.values()], len(table))
    if not present.any():
        return None
    data = {name: column[present] for name, column in {**signals, **texts}.items()}
    count = int(present.sum())
    if topic is EVENTS:
        level = np.nan_to_num(data.get("level", np.full(count, INFO)), nan=INFO)
        data["level"] = level.astype(np.int64)
    return frame_of(topic, _index(table.time[present]), {**_filled(fixed, count), **data})


def _any(masks: list[BoolArray], count: int) -> BoolArray:
    return np.logical_or.reduce(masks) if masks else np.zeros(count, dtype=np.bool_)


def _filled(fixed: dict[str, Any], count: int) -> dict[str, Any]:
    return {name: np.full(count, value) for name, value in fixed.items()}


def _index(time: IntArray) -> pd.DatetimeIndex:
    return pd.DatetimeIndex(time.view("datetime64[ns]"), tz="UTC")


def _of_topic(columns: Mapping[str, Any], topic: str) -> dict[str, Any]:
    """The entries of one topic, by column instead of by ``"/topic.column"``."""
    located = {name: field_of(name) for name in columns}
    return {
        column: columns[name] for name, (owner, column, _) in located.items() if owner.name == topic
    }

"""What a recorded file holds before repair, and the report of what repair did to it.

It holds tables of SI numbers, with the file's row numbers. Of what was repaired the counts by rule
and column are kept in the trip's metadata and provenance, the raw values in an attachment. Each of
its entries is a cell or, where `column` is empty, a whole row, in the order in which the rules were
applied. Its time before and after the rule shows whether the row was moved; without a time after
it, the row was dropped.
"""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
from numpy.typing import NDArray

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.display import as_text, counted
from trainlog.errors import LogError
from trainlog.presentation import Presented
from trainlog.topics import EVENTS, RECORDED, TOPICS, Field, Topic, column_field, recorded_topic
from trainlog.trip import Trip, frame_of
from trainlog.units import EARTH_RADIUS

NO_TIME = int(np.iinfo(np.int64).min)
"""Time of a row whose clock could not be read."""

TIME_CELL = "time"
"""Column of a `Raw` that holds times which could not be read."""

METRES_PER_DEGREE = math.radians(EARTH_RADIUS)
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
    masks = [words != "" for words in texts.values()]
    masks = masks or [np.isfinite(values) for values in signals.values()]
    present = np.logical_or.reduce(np.reshape(masks, (len(masks), len(table))))
    if not present.any():
        return None
    data = {name: column[present] for name, column in {**signals, **texts}.items()}
    count = int(present.sum())
    if topic is EVENTS:
        level = np.nan_to_num(data.get("level", np.full(count, INFO)), nan=INFO)
        data["level"] = level.astype(np.int64)
    return frame_of(topic, _index(table.time[present]), {**_filled(fixed, count), **data})


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


# ------------------------------------------------------------------------------------- the report


CLOCK_RULES = (
    "clock_step",
    "clock_step_suspected",
    "clock_jump",
    "time_backwards",
    "position_steps",
)
"""Rules that show a clock that was set, or may do: a distance over its times is doubtful."""

STATED = ("clock_step_suspected", "position_steps", "unit_suspected", "quantised", "gaps")
"""Rules that state what they find and change nothing."""


@dataclass(frozen=True, eq=False, repr=False)
class Report(Presented):
    """What was read, kept and repaired.

    Attributes
    ----------
    rows_read, rows_kept : int
        Rows of data in the file, and those that became samples.
    findings : tuple of Finding
        In the order in which the rules were applied.
    switched_off : tuple of str
        Rules that the profile switches off.
    not_used : dict of str to int
        What the file, or the profile, holds besides and was not used, with how many there are.
    raw_kept : int
        Entries of `trainlog.ingest.repairs_of`: raw values of what was dropped, changed or moved.
    raw_beyond : int
        Entries beyond the bound, which are in the recorded file alone.
    """

    rows_read: int
    rows_kept: int
    findings: tuple[Finding, ...] = ()
    switched_off: tuple[str, ...] = ()
    not_used: dict[str, int] = field(default_factory=dict)
    raw_kept: int = 0
    raw_beyond: int = 0

    @property
    def rows_dropped(self) -> int:
        """Rows that did not become samples; each is counted by one of the rules."""
        return self.rows_read - self.rows_kept

    def count(self, rule: str, column: str | None = None) -> int:
        """How often `rule` was applied, over all columns or in one (``"/topic.field"``)."""
        return sum(
            finding.count
            for finding in self.findings
            if finding.rule == rule and column in (None, finding.column)
        )

    @property
    def counts(self) -> dict[str, int]:
        """How often each rule was applied that was applied at all."""
        total: Counter[str] = Counter()
        for finding in self.findings:
            total[finding.rule] += finding.count
        return dict(total)

    def metadata(self) -> dict[str, str]:
        """The report as metadata of a trip; rules that met nothing are left out."""
        found = {
            "rows.read": str(self.rows_read),
            "rows.kept": str(self.rows_kept),
            "rows.dropped": str(self.rows_dropped),
        }
        found |= {f"repair.{rule}": str(count) for rule, count in self.counts.items()}
        for finding in self.findings:
            if finding.column:
                found[f"repair.{finding.rule}.{finding.column}"] = str(finding.count)
            if finding.note and not finding.column:
                found[f"repair.{finding.rule}.note"] = finding.note
        if self.switched_off:
            found["repair.switched_off"] = ", ".join(self.switched_off)
        if self.raw_kept:
            found["repairs.kept"] = str(self.raw_kept)
        if self.raw_beyond:
            found["repairs.beyond"] = str(self.raw_beyond)
        return found | {f"not_used.{what}": str(count) for what, count in self.not_used.items()}

    def details(self) -> dict[str, Any]:
        """The report as an entry of provenance; `report_of` makes it a report again."""
        findings = [{**asdict(each), "rows": list(each.rows)} for each in self.findings]
        return asdict(self) | {"findings": findings, "switched_off": list(self.switched_off)}

    @property
    def title(self) -> str:
        """How many rows were kept."""
        return f"Report: {self.lines()[0]}"

    def summary(self) -> dict[str, str]:
        """The first of the other lines, by what they are about."""
        others = self.lines()[1:]
        rows: dict[str, str] = {}
        for number, line in enumerate(others[:SHOWN]):
            column = self.findings[number].column if number < len(self.findings) else ""
            about, _, what = line.replace(f" in {column}", "", 1).partition(": ")
            if about == "not used":
                about, _, what = line.rpartition(": ")
            rows[f"{about} {column}".rstrip()] = what
        if len(others) > SHOWN:
            rows["more"] = f"{len(others) - SHOWN} lines; see lines()"
        return rows

    def lines(self) -> list[str]:
        """The report in words, one line a finding."""
        shown = [f"{self.rows_read} rows read, {self.rows_kept} kept, {self.rows_dropped} dropped"]
        for finding in self.findings:
            where = f" in {finding.column}" if finding.column else ""
            more = ", ..." if finding.count > len(finding.rows) else ""
            rows = f" (rows {', '.join(map(str, finding.rows))}{more})" if finding.rows else ""
            note = f"; {finding.note}" if finding.note else ""
            shown.append(f"{finding.rule}: {finding.count}{where}{rows}{note}")
        if self.switched_off:
            shown.append(f"switched off: {', '.join(self.switched_off)}")
        if self.raw_kept:
            beyond = f", {self.raw_beyond} more are in the file alone" if self.raw_beyond else ""
            shown.append(f"raw values: {self.raw_kept} kept{beyond}")
        shown += [f"not used: {what}: {count}" for what, count in self.not_used.items()]
        return shown


def report_of(trip: Trip) -> Report:
    """The report of an ingested trip, also after it was written and read again.

    Raises
    ------
    LogError
        If the trip was not made by ingest.

    Examples
    --------
    >>> from trainlog.ingest import ingest
    >>> report_of(ingest("sample_logs/gnss.csv")).counts
    {'subsecond': 5477, 'spikes': 3, 'gaps': 1}
    """
    for entry in trip.provenance:
        if entry.get("step") == "ingest":
            stored = entry["report"]
            findings = tuple(
                Finding(**{**each, "rows": tuple(map(int, each["rows"]))})
                for each in stored["findings"]
            )
            switched_off = tuple(stored["switched_off"])
            return Report(**{**stored, "findings": findings, "switched_off": switched_off})
    raise LogError(
        f"trip '{trip.name}' was not made by ingest", remedy="simulated trips have no such report"
    )


REPAIRS_ATTACHMENT = "repairs.parquet"
"""Attachment that holds the entries of a trip."""

MOST_ENTRIES = 1_000_000
"""Entries that are kept of one rule; those beyond are counted."""

LONGEST_TEXT = 1_000
"""Characters that are kept of a text."""

STAMP = pa.timestamp("ns", "UTC")

SCHEMA = pa.schema(
    [
        ("row", pa.int64()),
        ("table", pa.int32()),
        ("column", pa.string()),
        ("rule", pa.string()),
        ("raw_time", STAMP),
        ("new_time", STAMP),
        ("raw_value", pa.float64()),
        ("new_value", pa.float64()),
        ("raw_text", pa.string()),
    ]
)
"""Columns of the attachment; values in SI."""


@dataclass
class Repairs:
    """The entries of a trip while they are gathered, at most `most` of a rule.

    Attributes
    ----------
    beyond : int
        Entries that were more than that, and are not kept.
    """

    most: int = MOST_ENTRIES
    beyond: int = 0
    kept: list[tuple[int, Raw]] = field(default_factory=list)
    by_rule: dict[str, int] = field(default_factory=dict)

    def add(self, table: int, found: Iterable[Raw]) -> None:
        """Take in what was done to the table of that number."""
        for change in found:
            already = self.by_rule.get(change.rule, 0)
            left = max(0, self.most - already)
            self.beyond += max(0, change.rows.size - left)
            self.by_rule[change.rule] = already + min(left, change.rows.size)
            if left:
                self.kept.append((table, change.take(slice(left))))

    def __len__(self) -> int:
        return sum(change.rows.size for _, change in self.kept)

    def to_bytes(self) -> bytes:
        """The entries as a Parquet file: same entries, same bytes."""
        parts = [_arrow(number, change) for number, change in self.kept]
        sink = io.BytesIO()
        counts = ["row", "table", "raw_time", "new_time"]
        pa.parquet.write_table(
            pa.concat_tables(parts),
            sink,
            compression="zstd",
            use_dictionary=["column", "rule", "raw_text"],
            column_encoding=dict.fromkeys(counts, "DELTA_BINARY_PACKED"),
        )
        return sink.getvalue()


def _arrow(number: int, raw: Raw) -> pa.Table:
    count = raw.rows.size
    text = pa.nulls(count, pa.string())
    if raw.text is not None:
        text = pa.array([str(word)[:LONGEST_TEXT] for word in raw.text], pa.string())
    time = np.full(count, NO_TIME) if raw.time is None else raw.time
    columns = [
        pa.array(raw.rows, pa.int64()),
        pa.array(np.full(count, number), pa.int32()),
        pa.array(np.full(count, raw.column, dtype=object), pa.string()),
        pa.array(np.full(count, raw.rule, dtype=object), pa.string()),
        _stamps(time),
        _stamps(time if raw.new_time is None else raw.new_time),
        _values(raw.value, count),
        _values(raw.new_value, count),
        text,
    ]
    return pa.table(columns, schema=SCHEMA)


def _stamps(time: IntArray) -> pa.Array:
    return pa.array(time, pa.int64(), mask=time == NO_TIME).cast(STAMP)


def _values(values: FloatArray | None, count: int) -> pa.Array:
    if values is None:
        return pa.nulls(count, pa.float64())
    return pa.array(values, pa.float64(), mask=np.isnan(values))


def repairs_of(trip: Trip) -> pd.DataFrame:
    """The raw values of a recorded trip: what the rules took away, changed or moved.

    Returns
    -------
    DataFrame
        One row an entry, in the order in which the rules were applied:

        ``row``
            Row of the file.
        ``table``
            Number of the table, for files that hold several with rows of their own.
        ``column``
            ``"/topic.column"``; ``"time"`` for a time that could not be read; empty for the whole
            row.
        ``rule``
        ``raw_time``, ``new_time``
            Time of the row before and after the rule; without `new_time`, but with `raw_time`, the
            row was dropped.
        ``raw_value``, ``new_value``
            The cell before and after the rule, SI; NaN: absent.
        ``raw_text``
            What stood in the file where it could not be read.

    Raises
    ------
    LogError
        If the trip was not made by ingest, or the attachment is damaged.

    Examples
    --------
    >>> from trainlog.ingest import ingest
    >>> repairs = repairs_of(ingest("sample_logs/gnss.csv"))
    >>> repairs[repairs["rule"] == "spikes"]["row"].tolist()
    [3240, 3505, 5172]
    """
    report_of(trip)
    data = trip.attachments.get(REPAIRS_ATTACHMENT)
    table = SCHEMA.empty_table()
    try:
        if data is not None:
            table = pa.parquet.read_table(pa.BufferReader(data))
    except (pa.ArrowException, OSError) as error:
        raise LogError(
            f"attachment {REPAIRS_ATTACHMENT} of trip '{trip.name}' cannot be read",
            remedy="ingest the recording again",
        ) from error
    frame: pd.DataFrame = table.to_pandas()
    return frame

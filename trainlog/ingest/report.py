"""What ingest repaired: counts by rule and column, and the raw values of what was changed.

The counts are kept in the trip's metadata and provenance, the raw values in an attachment.
Each entry is a cell or, where `column` is empty, a whole row, in the order in which the rules were
applied. Its time before and after the rule shows whether the row was moved; without a time after
it, the row was dropped.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import LogError
from trainlog.ingest.clock import longest_nondecreasing
from trainlog.ingest.recording import NO_TIME, SHOWN, Finding, Raw, Table
from trainlog.presentation import Presented
from trainlog.trip import Trip

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


def changes(rule: str, before: Table, after: Table) -> list[Raw]:
    """What `rule` did to a table."""
    if before is after:
        return []
    place = np.full(int(before.samples.max(initial=-1)) + 1, -1, dtype=np.int64)
    place[before.samples] = np.arange(len(before))
    source = place[after.samples]
    dropped = np.ones(len(before), dtype=np.bool_)
    dropped[source] = False
    found = _dropped(rule, before, dropped)
    rows, old, new = after.rows, before.time[source], after.time
    moved = old != new
    if np.any(np.diff(source) < 0):
        out_of_order = ~longest_nondecreasing(before.time)
        moved |= out_of_order[source]
    if moved.any():
        found.append(Raw(rule, "", rows[moved], None, old[moved], new[moved]))
    for name, values in after.signals.items():
        if values is before.signals[name]:
            continue
        raw = before.signals[name][source]
        cells = (raw != values) & ~(np.isnan(raw) & np.isnan(values))
        if cells.any():
            times = None, old[cells], new[cells]
            found.append(Raw(rule, name, rows[cells], *times, raw[cells], values[cells]))
    return found


def _dropped(rule: str, before: Table, dropped: BoolArray) -> list[Raw]:
    """The rows that a rule dropped, and every value in them."""
    if not dropped.any():
        return []
    time = before.time[dropped]
    none = np.full(time.size, NO_TIME)
    found = [Raw(rule, "", before.rows[dropped], None, time, none)]
    for name, values in before.signals.items():
        cells = dropped & np.isfinite(values)
        if cells.any():
            rows, time = before.rows[cells], before.time[cells]
            found.append(Raw(rule, name, rows, None, time, none[: rows.size], values[cells]))
    for name, texts in before.texts.items():
        cells = dropped & np.asarray(texts != "", dtype=np.bool_)
        if cells.any():
            rows, time = before.rows[cells], before.time[cells]
            found.append(Raw(rule, name, rows, texts[cells], time, none[: rows.size]))
    return found


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
    if data is None:
        return _frame(SCHEMA.empty_table())
    try:
        return _frame(pa.parquet.read_table(pa.BufferReader(data)))
    except (pa.ArrowException, OSError) as error:
        raise LogError(
            f"attachment {REPAIRS_ATTACHMENT} of trip '{trip.name}' cannot be read",
            remedy="ingest the recording again",
        ) from error


def _frame(table: pa.Table) -> pd.DataFrame:
    frame: pd.DataFrame = table.to_pandas()
    return frame

"""What ingest repaired: counts by rule and column, kept in the trip's metadata and provenance."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import Any

from trainlog.errors import LogError
from trainlog.ingest.recording import Finding
from trainlog.trip import Trip


@dataclass(frozen=True)
class Report:
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
        return {
            "rows_read": self.rows_read,
            "rows_kept": self.rows_kept,
            "findings": [
                {**asdict(finding), "rows": list(finding.rows)} for finding in self.findings
            ],
            "switched_off": list(self.switched_off),
            "not_used": dict(self.not_used),
            "raw_kept": self.raw_kept,
            "raw_beyond": self.raw_beyond,
        }

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
    """
    for entry in trip.provenance:
        if entry.get("step") == "ingest":
            told = entry["report"]
            return Report(
                int(told["rows_read"]),
                int(told["rows_kept"]),
                tuple(
                    Finding(**{**finding, "rows": tuple(int(row) for row in finding["rows"])})
                    for finding in told["findings"]
                ),
                tuple(told["switched_off"]),
                {what: int(count) for what, count in told.get("not_used", {}).items()},
                int(told.get("raw_kept", 0)),
                int(told.get("raw_beyond", 0)),
            )
    raise LogError(
        f"trip '{trip.name}' was not made by ingest", remedy="simulated trips have no such report"
    )

"""What became of recorded files, as a table."""

from __future__ import annotations

from rich.console import Group

from trainlog.ingest import Ingested, Outcome
from trainlog.presentation import new_table

MOST_PASSED_OVER = 10
"""Files that are listed as passed over; of more the number is stated."""


def ingest_table(result: Ingested) -> Group:
    """Each trip with its log and repairs, then what was refused and passed over, with reasons."""
    table = new_table(f"Logs in {result.output}", "recording", "log", "rows kept", "repaired")
    for each in result.of("made", "repaired", "unchanged"):
        kept = "" if each.report is None else f"{each.report.rows_kept:,}"
        log = "" if each.log is None else each.log.name
        table.add_row(_name(each), log, kept, _repairs(each))
    words = [f"refused: {_place(each)}{each.reason}" for each in result.of("refused")]
    words += [
        f"{_name(each)}: direction {evidence}"
        for each in result.of("made", "repaired", "unchanged")
        if "assumed" in (evidence := each.metadata.get("direction_evidence", ""))
    ]
    others = result.of("passed_over")
    words += [f"passed over: {each.file}: {each.reason}" for each in others[:MOST_PASSED_OVER]]
    if len(others) > MOST_PASSED_OVER:
        words.append(f"passed over: {len(others) - MOST_PASSED_OVER} more files")
    return Group(*([table] if table.rows else []), *words, f"{result.sentence}.")


def _name(each: Outcome) -> str:
    return f"{each.file.name}, {each.recording}" if each.recording else each.file.name


def _place(each: Outcome) -> str:
    """The recording, where the reason names the file alone."""
    return f"{each.recording}: " if each.recording else ""


def _repairs(each: Outcome) -> str:
    if each.state == "unchanged":
        return each.reason if each.reason.startswith("of") else "unchanged"
    return ", ".join(f"{rule} {count:,}" for rule, count in each.repairs.items()) or "nothing"

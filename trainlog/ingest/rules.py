"""The rules of repair, in the order in which they are applied; docs/ingest.md has the table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from trainlog.errors import InputError
from trainlog.ingest import checks, clock, clock_steps, suspicions, values
from trainlog.ingest.clock import Result
from trainlog.ingest.profile import Limits, Repair
from trainlog.ingest.recording import Finding, Table
from trainlog.ingest.repairs import Change, changes


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule of repair.

    Attributes
    ----------
    name : str
        As in [repair] of the profile and in the report.
    off : {"refuse", "keep"}
        What happens to the defect when the rule is switched off: the file is refused, or the
        defect stays.
    apply : callable, optional
        ``apply(table, limits)`` gives the table that is left and what was found; absent for rules
        that the format's reader applies while it splits the file.
    """

    name: str
    off: Literal["refuse", "keep"]
    apply: Callable[[Table, Limits], Result] | None = None


RULES = (
    Rule("truncated_rows", "refuse"),
    Rule("damaged_messages", "refuse"),
    Rule("not_a_number", "refuse"),
    Rule("empty", "refuse"),
    Rule("before_first_fix", "keep", clock.drop_before_first_fix),
    Rule("time_unreadable", "refuse", clock.drop_unreadable_time),
    Rule("clock_step", "keep", clock_steps.undo_clock_steps),
    Rule("clock_jump", "refuse", clock.drop_clock_jumps),
    Rule("time_backwards", "refuse", clock.sort_time),
    Rule("duplicates", "refuse", clock.drop_duplicates),
    Rule("subsecond", "keep", clock.rebuild_subsecond),
    Rule("same_time", "refuse", clock.merge_same_time),
    Rule("no_fix", "keep", values.blank_without_fix),
    Rule("out_of_limits", "keep", values.blank_out_of_limits),
    Rule("spikes", "keep", values.blank_spikes),
    Rule("inconsistent", "keep", checks.refuse_inconsistent),
    Rule("unit_suspected", "keep", suspicions.tell_units),
    Rule("quantised", "keep", suspicions.tell_quantised),
    Rule("gaps", "keep", clock.count_gaps),
    Rule("off_line", "keep"),
    Rule("slip", "keep"),
)
"""Every rule by the order of its application; the last two where chainage is estimated."""


def refuse_switched_off(findings: tuple[Finding, ...], repair: Repair) -> None:
    """Refuse what the reader repaired although its rule is switched off.

    Raises
    ------
    InputError
        With the first row concerned.
    """
    for rule in RULES:
        if rule.off == "refuse" and not getattr(repair, rule.name):
            for finding in findings:
                if finding.rule == rule.name:
                    _refuse(finding)


def repaired(
    table: Table, limits: Limits, repair: Repair, least: int = 2
) -> tuple[Table, list[Finding], list[Change]]:
    """Apply the rules, one after the other.

    Parameters
    ----------
    least : int
        Rows that have to be left: a trip needs 2, one table among several none.

    Returns
    -------
    Table, list of Finding, list of Change
        What is left, what was met, and how what was changed stood before.

    Raises
    ------
    InputError
        If a defect cannot be repaired, or its rule is switched off and it cannot stay.
    """
    findings: list[Finding] = []
    changed: list[Change] = []
    for rule in RULES:
        if rule.apply is None:
            continue
        wanted = getattr(repair, rule.name)
        if not wanted and rule.off == "keep":
            continue
        before = table
        table, found = rule.apply(before, limits)
        if found and not wanted:
            _refuse(found[0])
        findings += found
        changed += changes(rule.name, before, table)
        if len(table) < least:
            raise _too_short(before, table, rule.name)
        if not len(table):
            break
    return table, findings, changed


def _too_short(before: Table, table: Table, rule: str) -> InputError:
    every = f"rows {before.rows[0]} to {before.rows[-1]}" if len(before) else None
    if rule == "before_first_fix" and not len(table):
        return InputError(
            "no row has both a time and a satellite fix",
            place=every,
            remedy="the receiver never saw the sky; nothing can be made of this file",
        )
    if rule == "time_unreadable" and not len(table):
        return InputError(
            "no row has a time that can be read",
            place=every,
            remedy="check the columns, format and unit under [time] of the profile",
        )
    return InputError(
        f"{len(table)} row is left after rule '{rule}', a trip needs 2",
        place=f"row {table.rows[0]}" if len(table) else None,
        remedy="check the time column; was the recorder stopped at once?",
    )


def _refuse(finding: Finding) -> None:
    where = f", column {finding.column}" if finding.column else ""
    raise InputError(
        f"{finding.count} times '{finding.rule}', which the profile does not let be repaired",
        place=f"row {finding.rows[0]}{where}" if finding.rows else None,
        remedy=f"correct the file, or set {finding.rule} = true under [repair]",
    )

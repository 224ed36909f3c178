"""Tables of what is computed of a fleet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from analysis.fleet.update import Counts, FleetStatus, Problem
from analysis.tables import NUMBER, Column, WordTable, new_table


def update_table(counts: Mapping[str, Counts]) -> WordTable:
    """What an update computed, an analysis a row."""
    states = ("done", "refused", "failed", "known", "waiting")
    table = new_table("Computed", "analysis", *(Column(each, NUMBER) for each in states), "code")
    for each in counts.values():
        table.add_cells(each.analysis, *(getattr(each, state) for state in states), each.code)
    return table


def status_table(found: FleetStatus) -> WordTable:
    """How many trips of each analysis are in each state."""
    states = ("done", "refused", "failed", "pending")
    table = new_table("Computed by this code", "analysis", *(Column(s, NUMBER) for s in states))
    for name, each in found.analyses.items():
        table.add_cells(name, *(each[state] for state in states))
    return table


def problems_table(problems: Sequence[Problem]) -> WordTable:
    """Trips that gave no result, with the reasons; what several analyses state alike once."""
    together: dict[tuple[str, str, str], list[Problem]] = {}
    for each in problems:
        together.setdefault((each.key, each.state, each.reason), []).append(each)
    table = new_table("Without a result", "trip", "analysis", "state", "reason")
    for (key, state, reason), group in together.items():
        names = ", ".join(each.analysis for each in group if each.analysis)
        table.add_row(group[0].name or Path(group[0].path).stem or key[:12], names, state, reason)
    return table

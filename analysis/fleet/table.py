"""Tables of what is computed of a fleet."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from analysis.fleet.update import Problem
from trainlog.presentation import NUMBER, Column, WordTable, new_table

FEW = 5
"""Trips without a result up to which each has a row."""

_NUMBERS = re.compile(r"[-+]?\d+(?:[.,]\d+)*(?:e[-+]?\d+)?")
_QUOTED = re.compile(r"'[^']*'")
_PRESENT = re.compile(r"; topics present: .*")


def problems_table(problems: Sequence[Problem], most: int = FEW) -> WordTable:
    """Trips that gave no result, with the reasons; what several analyses state alike once.

    Of more than `most` trips those of one state and reason are one row, with their number; figures
    and names do not part reasons.
    """
    together: dict[tuple[str, str, str], list[Problem]] = {}
    for each in problems:
        together.setdefault((each.key, each.state, each.reason), []).append(each)
    if len({each.key for each in problems}) > most:
        return _by_reason(list(together.values()))
    table = new_table("Without a result", "trip", "analysis", "state", "reason", name="problems")
    for (_, state, reason), group in together.items():
        table.add_row(_trip_of(group[0]), _analyses_of(group), state, reason)
    return table


def _by_reason(groups: Sequence[Sequence[Problem]]) -> WordTable:
    """How many trips gave no result for each reason, the most first."""
    alike: dict[tuple[str, str, str], list[Problem]] = {}
    for group in groups:
        form = form_of_reason(group[0].reason)
        alike.setdefault((_analyses_of(group), group[0].state, form), []).append(group[0])
    table = new_table(
        "Without a result", "analysis", "state", Column("trips", NUMBER), "reason, of one of them",
        "this trip", name="problems",
    )  # fmt: skip
    for (names, state, _), rows in sorted(alike.items(), key=lambda each: -len(each[1])):
        table.add_cells(names, state, len(rows), rows[0].reason, _trip_of(rows[0]))
    return table


def form_of_reason(reason: str) -> str:
    """A reason without its figures, names and what else the log has, which part it from no other.

    Examples
    --------
    >>> form_of_reason("trip 'a' has 3 axles") == form_of_reason("trip 'b' has 12 axles")
    True
    """
    return _NUMBERS.sub("#", _QUOTED.sub("''", _PRESENT.sub("", reason)))


def _trip_of(problem: Problem) -> str:
    """The trip by its name, with that of its file where it is another."""
    path = Path(problem.path)
    if problem.name and problem.path and path.stem != problem.name:
        return f"{problem.name} ({path.name})"
    return problem.name or path.stem or problem.key[:12]


def _analyses_of(group: Sequence[Problem]) -> str:
    return ", ".join(each.analysis for each in group if each.analysis)

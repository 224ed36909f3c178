"""Tables of `analysis.studies.map_mpc`: what was reached beside what paper 000 published."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.table import Table

from analysis.report import new_table
from analysis.studies.map_mpc import Run
from analysis.studies.map_mpc_days import Days
from analysis.studies.map_mpc_scenarios import SCENARIOS, Outcome


def published_table() -> Table:
    """What paper 000 tells of its scenarios, for 78.2 t and a map that is lost."""
    table = new_table("Paper 000: published", "scenario", "errors of position and speed; h is (7)")
    for each in SCENARIOS:
        table.add_row(each.name, each.published)
    return table


def tracking_table(outcomes: Sequence[Outcome]) -> Table:
    """Errors and constraints of the trips with the map.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    table = new_table(
        "Paper 000, with the map: largest errors, and largest of each constraint (7) at any mass",
        "scenario",
        "mass t",
        "position m",
        "speed m/s",
        "safety m/s²",
        "traction m/s²",
        "speed m/s",
        "late at next stop s (least)",
        "latest s (least)",
    )
    for each in outcomes:
        found = each.informed
        late, worst = found.late, int(np.argmax(found.late))
        table.add_row(
            each.scenario.name,
            f"{found.mass / 1e3:.1f}",
            f"{np.abs(found.position_error).max():.2f}",
            f"{np.abs(found.speed_error).max():.2f}",
            *(f"{value:.3f}" for value in found.worst[:3]),
            f"{late[0]:.1f} ({each.bound[0]:.1f})",
            f"{late[worst]:.1f} ({each.bound[worst]:.1f})",
        )
    return table


def gain_table(outcomes: Sequence[Outcome]) -> Table:
    """What the map is worth: skidding and sliding with it and without.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    table = new_table(
        "With the map / without: the same trips, axle by axle",
        "scenario",
        "mass t",
        "axles that began to skid or slide",
        "slip protection",
        "work beyond the peak MJ",
        "all work of creep MJ",
        "latest s",
        "farthest from a stop m",
    )
    for each in outcomes:
        table.add_row(
            each.scenario.name,
            f"{each.informed.mass / 1e3:.1f}",
            *_beside(each.informed, each.blind),
        )
    return table


def days_table(days: Days) -> Table:
    """The second day, with the map that the first one taught, beside the first.

    Parameters
    ----------
    days : Days
    """
    table = new_table(
        "Bad rail: day 2, with the map of day 1's logs / day 1, without a map",
        "mass t",
        "axles that began to skid or slide",
        "slip protection",
        "work beyond the peak MJ",
        "all work of creep MJ",
        "latest s",
        "farthest from a stop m",
    )
    for before, after in zip(days.first, days.second, strict=True):
        table.add_row(f"{after.mass / 1e3:.1f}", *_beside(after, before))
    return table


def _beside(one: Run, other: Run) -> list[str]:
    pairs = (
        (one.slip_events, other.slip_events, "d"),
        (one.protections, other.protections, "d"),
        (one.skid_energy / 1e6, other.skid_energy / 1e6, ".2f"),
        (one.slip_energy / 1e6, other.slip_energy / 1e6, ".1f"),
        (one.late.max(), other.late.max(), ".1f"),
        (np.abs(one.stop_error).max(), np.abs(other.stop_error).max(), ".2f"),
    )
    return [f"{a:{form}} / {b:{form}}" for a, b, form in pairs]

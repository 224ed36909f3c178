"""Tables of `analysis.studies.map_mpc`: what was reached beside what paper 000 published."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.table import Table

from analysis.report import new_table
from analysis.studies.map_mpc import Run
from analysis.studies.map_mpc_days import Day, Days
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
    """Each day beside the first: slip, punctuality, and the map that it was driven by.

    Parameters
    ----------
    days : Days
    """
    table = new_table(
        f"Bad rail, {len(days.days[0].runs)} trips a day: the first without a map, each other one"
        " with the map of all logs before it",
        "day",
        "axles that began to skid or slide",
        "slip protection",
        "work beyond the peak MJ",
        "all work of creep MJ",
        "latest s",
        "mean s",
        "farthest from a stop m",
        "bins seen / borne / assumed",
        "map's error % (bias, rms)",
    )
    for day in days.days:
        late = days.late(day)
        table.add_row(
            f"{day.number}",
            f"{day.slip_events}",
            f"{sum(each.protections for each in day.runs)}",
            f"{day.skid_energy / 1e6:.2f}",
            f"{day.slip_energy / 1e6:.1f}",
            f"{late.max():.1f}",
            f"{late.mean():.2f}",
            f"{max(np.abs(each.stop_error).max() for each in day.runs):.2f}",
            _bins(day),
            _errors(day),
        )
    return table


def counted_on(days: Days) -> str:
    """What the days with a map assumed where it told nothing, in words."""
    told = [
        f"day {day.number}: {float(day.known.values[day.known.assumed].max()):.3f}"
        for day in days.days
        if day.known is not None and day.known.assumed.any()
    ]
    return (
        "assumed where the map tells nothing, from the middle one of the places where it does: "
        + ", ".join(told)
    )


def _bins(day: Day) -> str:
    known = day.known
    if known is None:
        return "-"
    return " / ".join(
        f"{np.count_nonzero(each)}" for each in (known.seen, known.borne, known.assumed)
    )


def _errors(day: Day) -> str:
    errors = 100.0 * day.map_errors
    if errors.size == 0:
        return "-"
    return f"{errors.mean():+.1f}, {np.sqrt(np.mean(errors**2)):.1f}"


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

"""Tables of `analysis.studies.hauck_2023.run`: what was reached beside what paper 000 published."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.table import Table

from analysis.studies.hauck_2023.days import Day, Days
from analysis.studies.hauck_2023.run import Plan, Run
from analysis.studies.hauck_2023.scenarios import SCENARIOS, Outcome
from analysis.studies.hauck_2023.section import fastest, least_time_unweighed
from analysis.tables import new_table
from trainlog.units import KMH


def published_table() -> Table:
    """What paper 000 tells of its scenarios, for 78.2 t and a map that is lost."""
    table = new_table("Paper 000: published", "scenario", "errors; every constraint h is kept")
    for each in SCENARIOS:
        table.add_row(each.name, each.published)
    return table


def references_table(plan: Plan) -> Table:
    """The references that are followed, and how much time each has.

    Parameters
    ----------
    plan : tuple of Reference
    """
    table = new_table(
        f"References, {plan[0].mass / 1e3:.1f} t: multiple shooting",
        "section",
        "km",
        "timetable s",
        "least of a reference s",
        "least of any driver s",
        "nodes",
        "iterations of IPOPT",
        "rollout off by mm",
        "nearest to a limit m/s²",
    )
    for each in plan:
        section = each.section
        table.add_row(
            section.name,
            f"{(section.destination.position - section.origin.position) / 1e3:.1f}",
            f"{each.duration:.0f}",
            f"{fastest(section, each.mass).duration:.1f}",
            f"{least_time_unweighed(section, each.mass):.1f}",
            f"{each.times.size}",
            f"{each.iterations}",
            f"{1e3 * each.rollout_error:.1f}",
            f"{-each.worst[:2].max():.2f}",
        )
    return table


def tracking_table(outcomes: Sequence[Outcome]) -> Table:
    """Errors of the trips with the map, the least there could be, and what was left of the limits.

    The lever changes from traction to braking or back; the reference's changes stand beside.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    table = new_table(
        "With the map: largest errors, and what was left of each limit at any mass (negative:"
        " broken)",
        "scenario",
        "mass t",
        "position m",
        "least of any driver as punctual m",
        "speed m/s",
        "left of comfort m/s²",
        "left of adhesion m/s²",
        "left of speed limit km/h",
        "stops off by m",
        "changes of the lever, all / most (reference)",
    )
    for each in outcomes:
        found = each.informed
        comfort, adhesion, speed = -found.worst[:3]
        table.add_row(
            each.scenario.name,
            f"{found.mass / 1e3:.1f}",
            f"{np.abs(found.position_error).max():.2f}",
            f"{each.deviation.max():.2f}",
            f"{np.abs(found.speed_error).max():.2f}",
            f"{comfort:.3f}",
            f"{adhesion:.3f}",
            f"{speed * KMH:.2f}",
            f"{np.abs(found.stop_error).max():.2f}",
            f"{found.lever_changes.sum()} / {found.lever_changes.max()}"
            f" ({found.planned_changes.sum()} / {found.planned_changes.max()})",
        )
    return table


def lateness_table(outcomes: Sequence[Outcome]) -> Table:
    """How late the trips with the map were, beside the least that is possible.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    table = new_table(
        "With the map: seconds late at the stops (negative: early), and the least there could be",
        "scenario",
        "mass t",
        "next stop",
        "least, mass not known",
        "least, mass known",
        "latest of all stops",
        "least there, mass not known",
    )
    for each in outcomes:
        late, worst = each.informed.late, int(np.argmax(each.informed.late))
        table.add_row(
            each.scenario.name,
            f"{each.informed.mass / 1e3:.1f}",
            f"{late[0]:.1f}",
            *(f"{max(least[0], 0.0):.1f}" for least in (each.unweighed, each.bound)),
            f"{late[worst]:.1f}",
            f"{max(each.unweighed[worst], 0.0):.1f}",
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
        "bins seen / demonstrated / assumed",
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
        f"{np.count_nonzero(each)}" for each in (known.seen, known.demonstrated, known.assumed)
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

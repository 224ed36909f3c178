"""Tables of `simulation`: what was reached beside what was published."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from analysis.studies.hauck_2023.scenarios import SCENARIOS, Day, Days, Outcome
from analysis.studies.hauck_2023.section import fastest, least_time_unweighed
from analysis.studies.hauck_2023.simulation import Plan, Run
from trainlog.presentation import WordTable, new_table
from trainlog.units import KMH

CONSTRAINTS = (
    "largest h1, h2 (comfort) [m/s²]",
    "largest h3, h4 (adhesion) [m/s²]",
    "largest h5 (speed limit) [m/s]",
)
"""Of eq. (7), at any mass and without reserve."""


def published_table() -> WordTable:
    """What Hauck et al. (2023) state of their scenarios, for 78.2 t and a map that is lost."""
    table = new_table(
        "Published (Hauck et al., 2023)", "scenario", "errors; every constraint h is kept"
    )
    for each in SCENARIOS:
        table.add_row(each.name, each.published)
    return table


def references_table(plan: Plan) -> WordTable:
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


def tracking_table(outcomes: Sequence[Outcome]) -> WordTable:
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


def lateness_table(outcomes: Sequence[Outcome]) -> WordTable:
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


def gain_table(outcomes: Sequence[Outcome]) -> WordTable:
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
            *([] if each.blind is None else _beside(each.informed, each.blind)),
        )
    return table


def difference_table(outcomes: Sequence[Outcome]) -> WordTable:
    """What is not as the paper has it, over all masses.

    Parameters
    ----------
    outcomes : sequence of Outcome
        Of the scenarios with several masses.
    """
    masses = [f"{mass / 1e3:.1f} t" for mass in dict.fromkeys(o.informed.mass for o in outcomes)]
    table = new_table("Differences from the paper", "figure", "published", *masses)
    good, bad, late = (
        [each.informed for each in outcomes if each.scenario is scenario] for scenario in SCENARIOS
    )
    rows: list[tuple[str, str, Sequence[Run], Callable[[Run], str]]] = [
        ("good track: largest error of position [m]", "about 5", good, _position_error),
        ("good track: largest error of speed [m/s]", "below 3", good, _speed_error),
        ("weather turns bad: largest error of position [m]", "about 5", bad, _position_error),
        ("40 s late: largest error of position [m]", "about 280", late, _position_error),
        ("40 s late: largest error of speed [m/s]", "not stated", late, _speed_error),
        ("40 s late: late at the next stop [s]", "19", late, lambda run: f"{run.late[0]:.1f}"),
        ("good track: farthest from a stop [m]", "not stated", good, _stop_error),
        ("weather turns bad: farthest from a stop [m]", "not stated", bad, _stop_error),
    ]
    for name, published, runs, figure in rows:
        table.add_row(name, published, *(figure(run) for run in runs))
    for number, name in enumerate(CONSTRAINTS):
        worst = [
            max(each.informed.worst[number] for each in outcomes if each.informed.mass == mass)
            for mass in dict.fromkeys(o.informed.mass for o in outcomes)
        ]
        table.add_row(f"{name}, all scenarios", "not above 0", *(f"{h:+.3f}" for h in worst))
    return table


def _position_error(run: Run) -> str:
    return f"{np.abs(run.position_error).max():.2f}"


def _stop_error(run: Run) -> str:
    return f"{np.abs(run.stop_error).max():.2f}"


def _speed_error(run: Run) -> str:
    return f"{np.abs(run.speed_error).max():.2f}"


def days_table(days: Days) -> WordTable:
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
        "largest h1, h2 / h3, h4 m/s²",
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
            f"{day.worst[0]:+.3f} / {day.worst[1]:+.3f}",
            _bins(day),
            _errors(day),
        )
    return table


def risks_table(driven: Mapping[str, Days]) -> WordTable:
    """What each way of reading the map cost and saved, on the days that had one.

    Parameters
    ----------
    driven : mapping of str to Days
        By how the map was read; the first day is that of all.
    """
    count = max(len(each.days) for each in driven.values())
    halves = [(2, min(3, count)), (4, count)] if count > 3 else [(2, count)]
    table = new_table(
        f"Changing rail, {len(next(iter(driven.values())).days[0].runs)} trips a day, by how the"
        " map is read",
        "map read with",
        "days driven",
        *(f"slips, days {a} to {b}" for a, b in halves),
        "work beyond the peak MJ",
        "all work of creep MJ",
        "latest s",
        "mean s",
        "bins seen that held less than counted on %",
    )
    for name, days in driven.items():
        later = days.days[1:]
        late = np.array([days.late(day) for day in later])
        table.add_row(
            name,
            f"{len(days.days)}",
            *(
                f"{sum(day.slip_events for day in later if a <= day.number <= b)}"
                for a, b in halves
            ),
            f"{sum(day.skid_energy for day in later) / 1e6:.2f}",
            f"{sum(day.slip_energy for day in later) / 1e6:.1f}",
            f"{late.max():.1f}" if late.size else "-",
            f"{late.mean():.2f}" if late.size else "-",
            _short(days),
        )
    return table


def _short(days: Days) -> str:
    """Share of the bins whose maximum was seen that held less than was counted on."""
    found = [
        day.rail(day.track.centres[day.known.seen]) < day.known.values[day.known.seen]
        for day in days.days
        if day.track is not None and day.known is not None
    ]
    return f"{100.0 * float(np.mean(np.concatenate(found))):.1f}" if found else "-"


def counted_on(days: Days) -> str:
    """What the days with a map assumed where it has no estimate, in words."""
    assumed = [
        f"day {day.number}: {float(day.known.values[day.known.assumed].max()):.3f}"
        for day in days.days
        if day.known is not None and day.known.assumed.any()
    ]
    return (
        "assumed where the map has no estimate, from the middle one of the places where it has: "
        + ", ".join(assumed)
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

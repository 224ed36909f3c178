"""Tables of `simulation`: what was reached beside what was published."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from analysis.studies.hauck_2023.reference import Reference
from analysis.studies.hauck_2023.scenarios import SCENARIOS, Day, Days, Outcome
from analysis.studies.hauck_2023.section import fastest, least_time_unweighed
from analysis.studies.hauck_2023.simulation import Plan, Run
from trainlog.arrays import FloatArray
from trainlog.presentation import Columns, WordTable, new_table, word_table
from trainlog.units import KMH

CONSTRAINTS = (
    "largest h1, h2 (comfort) [m/s²]",
    "largest h3, h4 (adhesion) [m/s²]",
    "largest h5 (speed limit) [m/s]",
)
"""Of eq. (7), at any mass and without reserve."""


_OF_OUTCOME: Columns[Outcome] = {
    "scenario": lambda each: each.scenario.name,
    "mass t": lambda each: f"{each.informed.mass / 1e3:.1f}",
}


def published_table() -> WordTable:
    """What Hauck et al. (2023) state of their scenarios, for 78.2 t and a map that is lost."""
    of = {
        "scenario": lambda each: each.name,
        "errors; every constraint h is kept": lambda each: each.published,
    }
    return word_table("Published (Hauck et al., 2023)", SCENARIOS, of)


def references_table(plan: Plan) -> WordTable:
    """The references that are followed, and how much time each has.

    Parameters
    ----------
    plan : tuple of Reference
    """
    of: Columns[Reference] = {
        "section": lambda each: each.section.name,
        "km": lambda each: (
            f"{(each.section.destination.position - each.section.origin.position) / 1e3:.1f}"
        ),
        "timetable s": lambda each: f"{each.duration:.0f}",
        "least of a reference s": lambda each: f"{fastest(each.section, each.mass).duration:.1f}",
        "least of any driver s": lambda each: (
            f"{least_time_unweighed(each.section, each.mass):.1f}"
        ),
        "nodes": lambda each: each.times.size,
        "iterations of IPOPT": lambda each: each.iterations,
        "rollout off by mm": lambda each: f"{1e3 * each.rollout_error:.1f}",
        "nearest to a limit m/s²": lambda each: f"{-each.worst[:2].max():.2f}",
    }
    return word_table(f"References, {plan[0].mass / 1e3:.1f} t: multiple shooting", plan, of)


def tracking_table(outcomes: Sequence[Outcome]) -> WordTable:
    """Errors of the trips with the map, the least there could be, and what was left of the limits.

    The lever changes from traction to braking or back; the reference's changes stand beside.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    of: Columns[Outcome] = _OF_OUTCOME | {
        "position m": lambda each: _largest(each.informed.position_error),
        "least of any driver as punctual m": lambda each: f"{each.deviation.max():.2f}",
        "speed m/s": lambda each: _largest(each.informed.speed_error),
        "left of comfort m/s²": lambda each: f"{-each.informed.worst[0]:.3f}",
        "left of adhesion m/s²": lambda each: f"{-each.informed.worst[1]:.3f}",
        "left of speed limit km/h": lambda each: f"{-KMH * each.informed.worst[2]:.2f}",
        "stops off by m": lambda each: _largest(each.informed.stop_error),
        "changes of the lever, all / most (reference)": lambda each: (
            f"{each.informed.lever_changes.sum()} / {each.informed.lever_changes.max()}"
            f" ({each.informed.planned_changes.sum()} / {each.informed.planned_changes.max()})"
        ),
    }
    title = "With the map: largest errors, and what was left of each limit at any mass"
    return word_table(f"{title} (negative: broken)", outcomes, of)


def lateness_table(outcomes: Sequence[Outcome]) -> WordTable:
    """How late the trips with the map were, beside the least that is possible.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    of: Columns[Outcome] = _OF_OUTCOME | {
        "next stop": lambda each: f"{each.informed.late[0]:.1f}",
        "least, mass not known": lambda each: f"{max(each.unweighed[0], 0.0):.1f}",
        "least, mass known": lambda each: f"{max(each.bound[0], 0.0):.1f}",
        "latest of all stops": lambda each: f"{each.informed.late.max():.1f}",
        "least there, mass not known": lambda each: (
            f"{max(each.unweighed[np.argmax(each.informed.late)], 0.0):.1f}"
        ),
    }
    title = (
        "With the map: seconds late at the stops (negative: early), and the least there could be"
    )
    return word_table(title, outcomes, of)


def gain_table(outcomes: Sequence[Outcome]) -> WordTable:
    """What the map is worth: skidding and sliding with it and without.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    figures: Columns[Run] = {
        "axles that began to skid or slide": lambda run: run.slip_events,
        "slip protection": lambda run: run.protections,
        "work beyond the peak MJ": lambda run: f"{run.skid_energy / 1e6:.2f}",
        "all work of creep MJ": lambda run: f"{run.slip_energy / 1e6:.1f}",
        "latest s": lambda run: f"{run.late.max():.1f}",
        "farthest from a stop m": lambda run: _largest(run.stop_error),
    }

    def both(figure: Callable[[Run], object]) -> Callable[[Outcome], str]:
        return lambda each: (
            "" if each.blind is None else f"{figure(each.informed)} / {figure(each.blind)}"
        )

    of = _OF_OUTCOME | {name: both(figure) for name, figure in figures.items()}
    return word_table("With the map / without: the same trips, axle by axle", outcomes, of)


def difference_table(outcomes: Sequence[Outcome]) -> WordTable:
    """What is not as the paper has it, over all masses.

    Parameters
    ----------
    outcomes : sequence of Outcome
        Of the scenarios with several masses.
    """
    masses = [*dict.fromkeys(each.informed.mass for each in outcomes)]
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
    heads = [f"{mass / 1e3:.1f} t" for mass in masses]
    table = new_table("Differences from the paper", "figure", "published", *heads)
    for name, published, runs, figure in rows:
        table.add_row(name, published, *map(figure, runs))
    for number, name in enumerate(CONSTRAINTS):
        worst = [
            max(each.informed.worst[number] for each in outcomes if each.informed.mass == mass)
            for mass in masses
        ]
        table.add_row(f"{name}, all scenarios", "not above 0", *(f"{h:+.3f}" for h in worst))
    return table


def _largest(errors: FloatArray) -> str:
    return f"{np.abs(errors).max():.2f}"


def _position_error(run: Run) -> str:
    return _largest(run.position_error)


def _stop_error(run: Run) -> str:
    return _largest(run.stop_error)


def _speed_error(run: Run) -> str:
    return _largest(run.speed_error)


def days_table(days: Days) -> WordTable:
    """Each day beside the first: slip, punctuality, and the map that it was driven by.

    Parameters
    ----------
    days : Days
    """
    of: Columns[Day] = {
        "day": lambda day: day.number,
        "axles that began to skid or slide": lambda day: day.slip_events,
        "slip protection": lambda day: sum(each.protections for each in day.runs),
        "work beyond the peak MJ": lambda day: f"{day.skid_energy / 1e6:.2f}",
        "all work of creep MJ": lambda day: f"{day.slip_energy / 1e6:.1f}",
        "latest s": lambda day: f"{days.late(day).max():.1f}",
        "mean s": lambda day: f"{days.late(day).mean():.2f}",
        "farthest from a stop m": lambda day: (
            f"{max(np.abs(each.stop_error).max() for each in day.runs):.2f}"
        ),
        "largest h1, h2 / h3, h4 m/s²": lambda day: f"{day.worst[0]:+.3f} / {day.worst[1]:+.3f}",
        "bins seen / demonstrated / assumed": _bins,
        "map's error % (bias, rms)": _errors,
    }
    trips = f"{len(days.days[0].runs)} trips a day: the first without a map, each other one"
    return word_table(f"Bad rail, {trips} with the map of all logs before it", days.days, of)


def risks_table(driven: Mapping[str, Days]) -> WordTable:
    """What each way of reading the map cost and saved, on the days that had one.

    Parameters
    ----------
    driven : mapping of str to Days
        By how the map was read; the first day is that of all.
    """
    count = max(len(each.days) for each in driven.values())
    halves = [(2, min(3, count)), (4, count)] if count > 3 else [(2, count)]

    def slips(first: int, last: int) -> Callable[[tuple[str, Days]], object]:
        return lambda row: sum(
            day.slip_events for day in row[1].days[1:] if first <= day.number <= last
        )

    def late(row: tuple[str, Days], figure: Callable[[FloatArray], float], digits: int) -> str:
        found = np.array([row[1].late(day) for day in row[1].days[1:]])
        return f"{figure(found):.{digits}f}" if found.size else "-"

    of: Columns[tuple[str, Days]] = {
        "map read with": lambda row: row[0],
        "days driven": lambda row: len(row[1].days),
        **{f"slips, days {a} to {b}": slips(a, b) for a, b in halves},
        "work beyond the peak MJ": lambda row: (
            f"{sum(day.skid_energy for day in row[1].days[1:]) / 1e6:.2f}"
        ),
        "all work of creep MJ": lambda row: (
            f"{sum(day.slip_energy for day in row[1].days[1:]) / 1e6:.1f}"
        ),
        "latest s": lambda row: late(row, np.max, 1),
        "mean s": lambda row: late(row, np.mean, 2),
        "bins seen that held less than counted on %": lambda row: _short(row[1]),
    }
    trips = f"{len(next(iter(driven.values())).days[0].runs)} trips a day"
    title = f"Changing rail, {trips}, by how the map is read"
    return word_table(title, driven.items(), of)


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

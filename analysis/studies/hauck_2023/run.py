"""The study of Hauck et al. (2023): its scenarios and days, as logs, pictures and tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    RED,
    Chart,
    Curve,
    Label,
    Panel,
    Rule,
    line_charts,
)
from analysis.studies.hauck_2023.model import NOMINAL_MASS, PUBLISHED_TRAIN
from analysis.studies.hauck_2023.reference import Reference, fastest, fastest_unweighed
from analysis.studies.hauck_2023.scenarios import (
    SCENARIOS,
    Day,
    Outcome,
    Setup,
    day_by_day,
    drawn_masses,
    outcome,
    prepared,
)
from analysis.studies.hauck_2023.simulation import Plan, Run, trip_of
from analysis.studies.report import StudyReport
from trainlog.arrays import FloatArray
from trainlog.errors import InfeasibleError, InputError
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
            f"{fastest_unweighed(each.section, each.mass).duration:.1f}"
        ),
        "nodes": lambda each: each.times.size,
        "iterations of IPOPT": lambda each: each.iterations,
        "rollout off by mm": lambda each: f"{1e3 * each.rollout_error:.1f}",
        "nearest to a limit m/s²": lambda each: f"{-each.worst[:2].max():.2f}",
    }
    return word_table(f"References, {plan[0].mass / 1e3:.1f} t: multiple shooting", plan, of)


def tracking_table(outcomes: Sequence[Outcome]) -> WordTable:
    """Errors of the trips with the map, the least there could be, and what was left of the limits.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    of: Columns[Outcome] = _OF_OUTCOME | {
        "position m": lambda each: _most(each.informed.position_error),
        "least of any driver as punctual m": lambda each: f"{each.deviation.max():.2f}",
        "speed m/s": lambda each: _most(each.informed.speed_error),
        "left of comfort m/s²": lambda each: f"{-each.informed.worst[0]:.3f}",
        "left of adhesion m/s²": lambda each: f"{-each.informed.worst[1]:.3f}",
        "left of speed limit km/h": lambda each: f"{-KMH * each.informed.worst[2]:.2f}",
        "stops off by m": lambda each: _most(each.informed.stop_error),
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
        "least there could be": lambda each: f"{max(each.bound[0], 0.0):.1f}",
        "latest of all stops": lambda each: f"{each.informed.late.max():.1f}",
        "least there": lambda each: f"{max(each.bound[np.argmax(each.informed.late)], 0.0):.1f}",
    }
    return word_table("With the map: seconds late at the stops (negative: early)", outcomes, of)


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
        "farthest from a stop m": lambda run: _most(run.stop_error),
    }

    def both(figure: Callable[[Run], object]) -> Callable[[tuple[Outcome, Run]], str]:
        return lambda row: f"{figure(row[0].informed)} / {figure(row[1])}"

    of: Columns[tuple[Outcome, Run]] = {
        "mass t": lambda row: f"{row[0].informed.mass / 1e3:.1f}",
        **{name: both(figure) for name, figure in figures.items()},
    }
    rows = [(each, each.blind) for each in outcomes if each.blind is not None]
    title = "Weather turns bad, with the map / without: the same trips, axle by axle"
    return word_table(title, rows, of)


def difference_table(outcomes: Sequence[Outcome]) -> WordTable:
    """What is not as the paper has it, over all masses.

    Parameters
    ----------
    outcomes : sequence of Outcome
        Of the scenarios with several masses.
    """
    masses = [*dict.fromkeys(each.informed.mass for each in outcomes)]
    good, bad, late, better = (
        [each for each in outcomes if each.scenario is scenario] for scenario in SCENARIOS
    )
    heads = [f"{mass / 1e3:.1f} t" for mass in masses]
    table = new_table("Differences from the paper", "figure", "published", *heads)

    def position(each: Outcome) -> str:
        return _most(each.informed.position_error)

    def speed(each: Outcome) -> str:
        return _most(each.informed.speed_error)

    def stop(each: Outcome) -> str:
        return _most(each.informed.stop_error)

    rows: list[tuple[str, str, Sequence[Outcome], Callable[[Outcome], str]]] = [
        ("good track: largest error of position [m]", "about 5", good, position),
        ("good track: largest error of speed [m/s]", "below 3", good, speed),
        ("good track: farthest from a stop [m]", "not stated", good, stop),
        ("weather turns bad: largest error of position [m]", "about 5", bad, position),
        ("weather turns bad: farthest from a stop [m]", "not stated", bad, stop),
        ("weather turns good: largest error of position [m]", "easily tracked", better, position),
        ("weather turns good: largest error of speed [m/s]", "easily tracked", better, speed),
        (
            "40 s late: time that eq. (8) lacks, at least [s]",
            "infeasible",
            late,
            lambda each: f"{each.bound[0]:.1f}",
        ),
        ("40 s late: error of position at departure [m]", "about 280", late, _departure_error),
        ("40 s late: largest error of position [m]", "not stated", late, position),
        ("40 s late: largest error of speed [m/s]", "not stated", late, speed),
        (
            "40 s late: late at the next stop [s]",
            "19",
            late,
            lambda each: f"{each.informed.late[0]:.1f}",
        ),
    ]
    for name, published, found, figure in rows:
        table.add_row(name, published, *map(figure, found))
    for number, name in enumerate(CONSTRAINTS):
        worst = [
            max(each.informed.worst[number] for each in outcomes if each.informed.mass == mass)
            for mass in masses
        ]
        table.add_row(f"{name}, all scenarios", "not above 0", *(f"{h:+.3f}" for h in worst))
    return table


def _most(errors: FloatArray) -> str:
    return f"{np.abs(errors).max():.2f}"


def _departure_error(each: Outcome) -> str:
    """By how far the reference has gone when the train, late, departs."""
    run = each.informed
    return f"{abs(float(run.position_error[np.argmax(run.speed > 0.0)])):.1f}"


def days_table(days: Sequence[Day]) -> WordTable:
    """Each day beside the first: slip, punctuality, and the map that it was driven by.

    Parameters
    ----------
    days : sequence of Day
    """
    of: Columns[Day] = {
        "day": lambda day: day.number,
        "axles that began to skid or slide": lambda day: day.slip_events,
        "slip protection": lambda day: sum(each.protections for each in day.runs),
        "work beyond the peak MJ": lambda day: f"{day.skid_energy / 1e6:.2f}",
        "all work of creep MJ": lambda day: f"{day.slip_energy / 1e6:.1f}",
        "latest s": lambda day: f"{day.late.max():.1f}",
        "mean s": lambda day: f"{day.late.mean():.2f}",
        "farthest from a stop m": lambda day: (
            f"{max(np.abs(each.stop_error).max() for each in day.runs):.2f}"
        ),
        "largest h1, h2 / h3, h4 m/s²": lambda day: f"{day.worst[0]:+.3f} / {day.worst[1]:+.3f}",
        "bins seen / demonstrated / assumed": _bins,
        "map's error % (bias, rms)": _map_errors,
    }
    trips = f"{len(days[0].runs)} trips a day: the first without a map, each other one"
    return word_table(f"Bad rail, {trips} with the map of all logs before it", days, of)


def _bins(day: Day) -> str:
    known = day.known
    if known is None:
        return "-"
    return " / ".join(
        f"{np.count_nonzero(each)}" for each in (known.seen, known.demonstrated, known.assumed)
    )


def _map_errors(day: Day) -> str:
    errors = 100.0 * day.map_errors
    if errors.size == 0:
        return "-"
    return f"{errors.mean():+.1f}, {np.sqrt(np.mean(errors**2)):.1f}"


SECTIONS = 3
"""Drawn of the speed, as in the paper."""

BIN = 100.0
"""Over which the largest constraint is drawn [m]."""

ZERO = [Rule(0.0, GREY)]


def study_charts(setup: Setup, outcomes: Sequence[Outcome]) -> dict[str, list[Chart]]:
    """The paper's figures by the names of their files.

    Parameters
    ----------
    setup : Setup
    outcomes : sequence of Outcome
        Of the scenarios, in their order.
    """
    good, bad, late, _ = (each.informed for each in outcomes)
    return {
        "figure-02-map.png": [_map(setup)],
        "figure-03-speed.png": [_speed(good)],
        "figure-04-errors.png": [_errors(good)],
        "figure-05-constraints-good.png": [_constraints(good, "Fig. 5  Constraints, good track")],
        "figure-06-constraints-bad.png": [_constraints(bad, "Fig. 6  Constraints, bad track")],
        "figure-07-delay.png": _delay(late, outcomes[2]),
    }


def _map(setup: Setup) -> Chart:
    """Fig. 2: limits, gradient and both rails."""
    line = setup.plan[0].section.line
    s = np.arange(0.0, line.length, 25.0)
    rails = [
        Curve(name, s / 1e3, setup.rails[name](s), colour, width=0.8)
        for name, colour in (("good", BLUE), ("bad", ORANGE))
    ]
    (chart,) = line_charts(line)
    panels = [*chart.panels, Panel("maximum adhesion", rails, from_zero=True)]
    return replace(chart, panels=panels, title="Fig. 2  Map (reconstruction)")


def _speed(run: Run) -> Chart:
    """Fig. 3: speed of the reference and of the train on the first sections."""
    rows = run.section < SECTIONS
    minutes, speed = run.time[rows] / 60.0, run.speed[rows]
    limit = np.where(speed > 0.0, run.line.speed_limit(run.position[rows]), np.nan)
    curves = [
        Curve("reference", minutes, KMH * run.target[rows, 1], PALE, width=4.0),
        Curve("train", minutes, KMH * speed, width=1.0),
        Curve("limit", minutes, KMH * limit, RED, width=0.8),
    ]
    title = f"Fig. 3  Speed, first {SECTIONS} sections, good track, {run.mass / 1e3:.1f} t"
    return Chart("min", [Panel("km/h", curves, 1.6, from_zero=True)], title=title)


def _errors(run: Run) -> Chart:
    """Fig. 4: errors of position and speed."""
    minutes = run.time / 60.0
    panels = [
        Panel("m", [Curve("", minutes, run.position_error, BLUE, width=0.8)],
              title="Position less the reference's"),
        Panel("m/s", [Curve("", minutes, run.speed_error, GREEN, width=0.8)],
              title="Speed less the reference's"),
    ]  # fmt: skip
    return Chart("min", panels, title=f"Fig. 4  Errors, {run.mass / 1e3:.1f} t, good track")


def _constraints(run: Run, title: str) -> Chart:
    """Figs. 5 and 6: the largest of the safety and of the traction constraints along the line."""
    comfort, adhesion, speed = (_largest(run, each) for each in run.constraints[:, :3].T)
    curves = [
        Curve("acceleration less 1 m/s² (h1, h2)", *comfort, BLUE, width=0.8),
        Curve("effort over mass less adhesion (h3, h4)", *adhesion, ORANGE, width=0.8),
    ]
    panels = [
        Panel("m/s²", curves, title="Comfort and traction", limits=(-1.5, 0.1), rules=ZERO),
        Panel("km/h", [Curve("", speed[0], KMH * speed[1], RED, width=0.8)],
              title="Speed less its limit (h5)", rules=ZERO),
    ]  # fmt: skip
    words = f"{title}, {run.mass / 1e3:.1f} t; kept where not above 0, for every mass"
    return Chart("km", panels, title=words)


def _delay(run: Run, outcome: Outcome) -> list[Chart]:
    """Fig. 7: error of position after a late departure, and lateness at the stops."""
    rows = run.section < SECTIONS
    error = Curve("", run.time[rows] / 60.0, run.position_error[rows], width=1.0)
    late = np.concatenate([[run.delay], run.late])
    numbers = np.arange(late.size)
    least = np.maximum(np.concatenate([[run.delay], outcome.bound]), 0.0)
    bound = Curve("least by the shortest times", numbers, least, ORANGE, width=3.0)
    low, high = min(float(late.min()), 0.0) - 5.0, 1.15 * float(late.max())
    margin = 0.03 * (high - low)
    panel = Panel(
        "s", [Curve("reached", numbers, late, kind="bars", width=0.5), bound],
        title="Lateness at the first departure, then on arrival; below 0: early",
        limits=(low, high),
        labels=[
            Label(number, f"{each:.1f}", each + np.copysign(margin, each))
            for number, each in enumerate(late.tolist())
        ],
    )  # fmt: skip
    title = f"Fig. 7  Position less the reference's, {run.delay:g} s late at first"
    return [
        Chart("min", [Panel("m", [error])], title=f"{title}, {run.mass / 1e3:.1f} t"),
        Chart("", [panel], ticks=[(n, stop.station) for n, stop in enumerate(run.stops)]),
    ]


def _largest(run: Run, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The largest value in each piece of the line, over km; NaN where there is none."""
    count = int(np.ceil(float(run.position.max()) / BIN))
    found = np.full(count, -np.inf)
    index = np.minimum((run.position / BIN).astype(np.int64), count - 1)
    np.maximum.at(found, index, np.where(np.isfinite(values), values, -np.inf))
    centres = (np.arange(count, dtype=np.float64) + 0.5) * BIN
    return centres / 1e3, np.where(np.isfinite(found), found, np.nan)


TRIPS = 3
"""A day, each with a mass of its own."""


@dataclass(frozen=True)
class MapOptions:
    """What is driven.

    Attributes
    ----------
    sections : int, optional
        Only the first of the line; default: all.
    days : int
        How many days the loop is driven; none as published.
    seed : int
        Of rails, masses and sensors.
    as_published : bool
        By eqs. (9) to (11) instead of the product's controller.
    """

    sections: int | None = None
    days: int = 2
    seed: int = 1
    as_published: bool = False


def main(report: StudyReport, options: MapOptions) -> None:
    """Drive the scenarios with and without a map, then the days; every trip is written at once."""
    watch = partial(report.track, description="references")
    known = prepared(options.seed, options.sections, watch)
    published = options.as_published
    report.show(references_table(known.plan))
    drawn = drawn_masses(options.seed, TRIPS).tolist()
    first = NOMINAL_MASS if published else drawn[0]
    outcomes: list[Outcome] = []
    for mass in report.track((first, PUBLISHED_TRAIN.light, PUBLISHED_TRAIN.heavy), "driving"):
        for scenario in report.track(SCENARIOS, f"{mass / 1e3:.1f} t"):
            found = outcome(known, scenario, mass, published=published)
            outcomes.append(found)
            weather = "dry" if scenario.weather == "good" else "wet"
            for run in (found.informed, found.blind) if mass == first else ():
                if run is not None:
                    report.log(trip_of(run, weather, options.seed))
        report.show(tracking_table(outcomes), lateness_table(outcomes))
        if not published:
            report.show(gain_table(outcomes))
    report.show(difference_table(outcomes))
    report.draw(study_charts(known, outcomes[: len(SCENARIOS)]))
    if not published:
        _drive_days(report, known, drawn, options)


def _drive_days(
    report: StudyReport, known: Setup, masses: list[float], options: MapOptions
) -> None:
    """Days in a row, until one has no map to be driven by."""
    rails = [known.rails["bad"]] * options.days
    following = day_by_day(known.plan, rails, masses, report.folder, options.seed)
    for number in report.track(range(1, options.days + 1), "driving days"):
        try:
            driven = next(following)
        except (InputError, InfeasibleError) as error:
            report.show(f"day {number} was not driven: {error}")
            break
        report.keep(*driven[-1].logs)
        report.show(days_table(driven))

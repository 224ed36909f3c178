"""The study of Hauck et al. (2023): its scenarios and days, as logs, pictures and tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

from analysis.studies.hauck_2023.controller import AS_PUBLISHED, EXTENDED
from analysis.studies.hauck_2023.figures import (
    counted_on,
    days_charts,
    days_table,
    difference_table,
    gain_table,
    lateness_table,
    published_table,
    references_table,
    risks_charts,
    risks_table,
    study_charts,
    tracking_table,
)
from analysis.studies.hauck_2023.model import NOMINAL_MASS, PUBLISHED_TRAIN
from analysis.studies.hauck_2023.reference import Reference
from analysis.studies.hauck_2023.scenarios import (
    SCENARIOS,
    SIGMAS,
    AdhesionPolicy,
    Days,
    Outcome,
    Setup,
    changing_rails,
    day_by_day,
    drawn_masses,
    exploring_policy,
    first_day,
    line,
    outcome,
    prepared,
    risk_policy,
    without_map,
)
from analysis.studies.hauck_2023.simulation import trip_of
from analysis.studies.report import StudyReport
from trainlog.errors import InfeasibleError, InputError

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
        By eqs. (9) to (11) alone; see `analysis.studies.hauck_2023.controller.Method`.
    risks : tuple of float
        Drive only the days, on a rail that changes from day to day: without a map, with the lasting
        estimate less a deviation, and with what is expected of each day at each of these risks.
        Where the map was not observed, the trains ask for all they want: only so does it learn.
    """

    sections: int | None = None
    days: int = 2
    seed: int = 1
    as_published: bool = False
    risks: tuple[float, ...] = ()


def main(report: StudyReport, options: MapOptions) -> None:
    """Drive the scenarios with and without a map, then the days; every trip is written at once."""
    known = prepared(
        options.seed, options.sections, partial(report.track, description="references")
    )
    if options.risks:
        _drive_risks(report, known, options)
        return
    report.show(published_table(), references_table(known.plan))
    method = AS_PUBLISHED if options.as_published else EXTENDED
    drawn = drawn_masses(options.seed, TRIPS).tolist()
    first = NOMINAL_MASS if options.as_published else drawn[0]
    masses = (first, PUBLISHED_TRAIN.mass, PUBLISHED_TRAIN.max_mass)
    outcomes: list[Outcome] = []
    for mass in report.track(masses, "driving"):
        for scenario in report.track(SCENARIOS, f"{mass / 1e3:.1f} t"):
            watch = _watched(report, scenario.name)
            outcomes.append(outcome(known, scenario, mass, method, watch))
            if mass == first:
                _log(report, outcomes[-1], options.seed)
        report.show(tracking_table(outcomes), lateness_table(outcomes))
        if not options.as_published:
            report.show(gain_table(outcomes))
    report.show(difference_table(outcomes))
    report.draw(study_charts(known, outcomes[: len(SCENARIOS)]))
    if not options.as_published:
        _drive_days(report, known, drawn, options)


def _watched(
    report: StudyReport, name: str
) -> Callable[[Iterable[Reference]], Iterable[Reference]]:
    return lambda plan: report.track(plan, f"{name}, sections")


def _log(report: StudyReport, found: Outcome, seed: int) -> None:
    weather = "dry" if found.scenario.weather == "good" else "wet"
    for run in (found.informed, found.blind):
        if run is not None:
            report.log(trip_of(run, weather, seed))


def _drive_days(
    report: StudyReport, known: Setup, masses: list[float], options: MapOptions
) -> None:
    """Days in a row, until one has no map to be driven by."""
    rails = [known.rails["bad"]] * options.days
    watch = _watched(report, "days")
    following = day_by_day(known.plan, rails, masses, report.folder, options.seed, track=watch)
    driven: Days | None = None
    for number in report.track(range(1, options.days + 1), "driving days"):
        try:
            driven = next(following)
        except (InputError, InfeasibleError) as error:
            report.show(f"day {number} was not driven: {error}")
            break
        report.keep(*driven.logs)
        report.show(days_table(driven))
    if driven is None:
        return
    if len(driven.days) > 1:
        report.show(counted_on(driven))
    report.draw({"two-days.png": days_charts(driven)})


def _drive_risks(report: StudyReport, known: Setup, options: MapOptions) -> None:
    """Days on a changing rail, by how the map is read; after each way of reading its table."""
    rails = changing_rails(line(), known.rails["bad"], options.days, options.seed)
    masses = drawn_masses(options.seed, TRIPS).tolist()
    watch = _watched(report, "days")
    first = first_day(known.plan, rails[0], masses, report.folder, options.seed, watch)
    report.keep(*first.logs)
    driven = {"no map": without_map(known.plan, rails, masses, first, watch)}
    policies: dict[str, AdhesionPolicy] = {f"{SIGMAS:g} deviation": exploring_policy}
    policies |= {f"risk {each:g}": partial(risk_policy, risk=each) for each in options.risks}
    for name, policy in report.track(policies.items(), "policies"):
        folder = report.folder / name.replace(" ", "-")
        folder.mkdir(exist_ok=True)
        days = day_by_day(known.plan, rails, masses, folder, options.seed, policy, watch, first)
        try:
            for driven[name] in days:
                pass
        except (InputError, InfeasibleError) as error:
            report.show(f"{name}: a day was not driven: {error}")
        report.keep(*driven[name].logs[len(first.logs) :])
        report.show(days_table(driven[name]))
    report.show(risks_table(driven))
    report.draw({"risks.png": risks_charts(driven)})

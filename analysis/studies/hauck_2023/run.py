"""The study of Hauck et al. (2023): its scenarios and days, as logs, pictures and tables."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from analysis.studies.hauck_2023.figures import (
    counted_on,
    days_charts,
    days_table,
    difference_table,
    gain_table,
    lateness_table,
    references_table,
    study_charts,
    tracking_table,
)
from analysis.studies.hauck_2023.model import NOMINAL_MASS, PUBLISHED_TRAIN
from analysis.studies.hauck_2023.scenarios import (
    SCENARIOS,
    Days,
    Outcome,
    Setup,
    day_by_day,
    drawn_masses,
    outcome,
    prepared,
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

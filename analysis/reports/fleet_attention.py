"""What of a fleet asks for attention: findings, missing results and recordings, with what to do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.fleet.channels import CHANNELS, raw_step
from analysis.fleet.trains import FleetTrains
from analysis.fleet.unlike import Step
from analysis.reports.page import Part, Warned
from trainlog.display import counted
from trainlog.presentation import NUMBER, Column, new_table

MOST_ROWS = 60
"""Rows of the table; the others are counted."""

MOST_NAMES = 3
"""Trains that a row names."""

TO_DO = {
    "dragging brake": "look for a friction brake that does not release",
    "running resistance": "check bearings and gears, and what was coupled or loaded",
    "mass": "weigh the train, or correct the empty mass in its file",
    "effort gain": "calibrate the recorded efforts",
    "wheel diameter": "set the diameter in the recorder; expected after wheels were turned or"
    " changed",
    "sensor delay": "check clock and filter of the recorded efforts",
    "speed noise": "check the speed sensor and its cable",
}
"""What to do about each known fault."""

UNKNOWN = "look at its trips before and after ('trainlog compare')"
"""What to do about a change that no known fault explains."""

NO_RESULT = {
    "resistance": "no curve is known of it: record longer trips with coasting and several speeds",
    "passport": "its gain, delay and mass are not known: see the reason below",
    "adhesion": "it adds nothing to the maps: record the speeds of its axles (/train/axles)",
    "driving": "its times and energy are not known: see the reason below",
    "checks": "its recordings are not checked: see the reason below",
}
"""What follows where an analysis has no result of any trip of a train, and what to do."""


@dataclass(frozen=True)
class FleetFacts:
    """What is looked through.

    Attributes
    ----------
    trips : DataFrame
        Of the catalogue.
    trains : FleetTrains or str
        What is known of the trains, or why nothing is.
    outcomes : mapping of str to DataFrame
        What became of each analysis of each trip.
    checks : DataFrame
        Results of the checks of the recordings.
    """

    trips: pd.DataFrame
    trains: FleetTrains | str
    outcomes: Mapping[str, pd.DataFrame]
    checks: pd.DataFrame


def attention_rows(facts: FleetFacts) -> list[Row]:
    """What asks for attention, what is most urgent first."""
    return [*_findings(facts), *_steps(facts), *_results(facts), *_recordings(facts)]


def attention_parts(facts: FleetFacts) -> list[Part]:
    """What asks for attention, what is most urgent first, each with what to do."""
    rows = attention_rows(facts)
    # Where little can be compared, no finding is no all-clear.
    few = "" if isinstance(facts.trains, str) else facts.trains.too_few
    warned: list[Part] = [Warned(few)] if few else []
    if not rows:
        words = (
            "every analysis has results of every train, no train has a finding or a step, no log is"
        )
        return [f"Nothing: {words} damaged.", *warned]
    more = len(rows) - MOST_ROWS
    table = new_table(
        "", "train", "what", "since", Column("trips", NUMBER), "what to do", name="attention",
        caption=f"{more:,} more" if more > 0 else None,
    )  # fmt: skip
    for train, what, since, trips, todo in rows[:MOST_ROWS]:
        table.add_cells(train, what, since, trips, todo)
    return [table, *warned]


Row = tuple[str, str, str, int | None, str]
"""Train, what, since when, in how many trips, what to do."""


def _findings(facts: FleetFacts) -> Iterator[Row]:
    if isinstance(facts.trains, str):
        yield "all", f"trains are not compared: {facts.trains}", "", None, "see the reason"
        return
    starts = facts.trips.groupby("train")["start"]
    by_train = {str(name): each for name, each in starts}
    for each in facts.trains.unlike.findings:
        causes = [each.explanation.cause, *each.explanation.others]
        known = [TO_DO[cause.what] for cause in causes if cause.what in TO_DO]
        todo = known if each.explanation.explained else [UNKNOWN]
        since = by_train.get(each.train, pd.Series(dtype="datetime64[ns, UTC]")) >= each.since
        yield (
            each.train, str(each.explanation), f"{each.since:%Y-%m-%d %H:%M}", int(since.sum()),
            "; or ".join(dict.fromkeys(todo)) or UNKNOWN,
        )  # fmt: skip


def _steps(facts: FleetFacts) -> Iterator[Row]:
    """Steps that are no finding, also of recordings that no train was compared by."""
    unlike = None if isinstance(facts.trains, str) else facts.trains.unlike
    steps = list(unlike.steps) if unlike else []
    stated = {each.train for each in steps if each.channel == SPEED.name}
    if unlike is not None:
        stated |= {each.train for each in unlike.findings if each.channel == SPEED.name}
    if "speed_scale" in facts.checks and "start" in facts.checks:
        known = facts.checks[np.isfinite(facts.checks["speed_scale"].to_numpy(np.float64))]
        for train, rows in known.sort_values("start").groupby("train"):
            seen = raw_step(np.log(rows["speed_scale"].to_numpy(np.float64)), SPEED.tolerance)
            if seen is not None and train not in stated:
                at, size, deviations = seen
                since, after = pd.Timestamp(rows["start"].iloc[at]), len(rows) - at
                steps.append(Step(str(train), SPEED.name, "1", size, deviations, since, after))
    for each in steps:
        yield each.train, str(each), f"{each.since:%Y-%m-%d %H:%M}", each.trips, UNKNOWN


SPEED = next(each for each in CHANNELS if each.name == "speed scale")


def _results(facts: FleetFacts) -> Iterator[Row]:
    """Results that are missing of all trips of a train, that failed, or are not computed yet."""
    for name, outcomes in facts.outcomes.items():
        pending = len(facts.trips) - len(outcomes)
        if pending:
            words = "not computed yet" if len(outcomes) else "not computed"
            yield "all", f"{name}: {words}", "", pending, "'trainlog fleet update' computes it"
        failed = outcomes[outcomes["state"] == "failed"]
        if len(failed):
            todo = "'trainlog fleet show --problems' lists them; a fault of trainlog: report it"
            yield _named(failed["train"]), f"{name}: failed", "", len(failed), todo
        done = (outcomes["state"] == "done").groupby(outcomes["train"].fillna("")).any()
        lacking = outcomes[outcomes["train"].fillna("").isin(done.index[~done])]
        if len(lacking):
            yield (
                _named(lacking["train"]), f"{name}: no trip gives a result", "", len(lacking),
                NO_RESULT.get(name, "see the reason below"),
            )  # fmt: skip


def _recordings(facts: FleetFacts) -> Iterator[Row]:
    rows = facts.checks
    if rows.empty:
        return
    doubts = {
        "damaged log": (rows["damage"] != "", "recover it: 'trainlog convert'"),
        "a channel repeats its value while the train moves": (
            rows["frozen"] != "", "check the sensor; its values are not used",
        ),
    }  # fmt: skip
    for what, (chosen, todo) in doubts.items():
        found = rows[chosen.to_numpy(bool)]
        if len(found):
            yield _named(found["train"]), what, "", len(found), todo


def _named(trains: pd.Series) -> str:
    """The trains, those with most trips first; of many a few and how many more."""
    names = [str(each) for each in trains.replace("", np.nan).dropna().value_counts().index]
    if not names:
        return "not stated"
    more = len(names) - MOST_NAMES
    words = ", ".join(sorted(names[:MOST_NAMES]))
    return words if more <= 0 else f"{words} and {counted(more, 'other')}"

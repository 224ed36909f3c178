"""Stops on low adhesion: slide protection in cases like those of EN 15595, and a sanding trial.

    python benchmarks/control/benchmark_slide_protection.py

**Cases.** Three trains stop on level track by full service braking, with each traction control: on
low and on very low adhesion all the way, where adhesion falls and where it comes back while the
train brakes, and where it changes every 30 m. Cases and values are chosen here; the standard's text
is not public. Used is the part of the adhesion that lay under the train's way which its
deceleration used, where the brake asked for more; slide is the largest of a powered wheel, locked
the share of the time that the slowest one stands while the train runs.

**Sanding.** A published trial of RSSB: from 55 mph (88.5 km/h) at step 3 (0.9 m/s2) on untreated
rail of adhesion 0.02 a unit stopped in more than 1,200 m without sand, about 800 with one fixed
sander, 650 with two fixed, 600 with one variable, and 400 with two variable ones. Sanders are not
simulated: found is the adhesion of the whole train, constant over the stop, that gives each
distance with the plant's own slide protection.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from benchmark_traction import CONTROLS, PAIRS, PATIENCE, Trial
from rich.console import Console

from analysis.control.traction import TractionName, with_traction
from trainlog.arrays import FloatArray
from trainlog.formats.ttobench import read_train
from trainlog.presentation import new_table
from trainlog.railway import Line, Station, StepProfile, Train
from trainlog.simulation import Scenario, draw_scenarios
from trainlog.simulation.drivers import AT_REST, PERIOD
from trainlog.units import GRAVITY, KMH

LENGTH, BEGIN = 8_000.0, 500.0
"""Of the level track, and where the train begins to brake [m]."""

FASTEST = 100.0 / KMH
"""From which the train is stopped in the cases [m/s]."""


def rail(*rows: tuple[float, float]) -> StepProfile:
    """Maximum adhesion from places behind the begin of braking on [m]."""
    at, values = np.array(rows).T
    return StepProfile(np.maximum(at, 0.0) + np.where(at > 0.0, BEGIN, 0.0), values)


CASES: dict[str, StepProfile] = {
    "low, 0.06": rail((0.0, 0.06)),
    "very low, 0.04": rail((0.0, 0.04)),
    "falls from 0.15 to 0.04 at 150 m": rail((0.0, 0.15), (150.0, 0.04)),
    "comes back from 0.04 to 0.15 at 300 m": rail((0.0, 0.04), (300.0, 0.15)),
    "0.03 and 0.10 every 30 m": rail(*((30.0 * k, 0.03 if k % 2 else 0.10) for k in range(200))),
}

SANDING = ((1_200.0, "no sand"), (800.0, "one fixed"), (650.0, "two fixed"),
           (600.0, "one variable"), (400.0, "two variable"))  # fmt: skip
"""Stopping distances of the trial [m], and with which sanders."""


@dataclass(frozen=True)
class Stop:
    """What a stop came to."""

    way: float
    used: float
    slide: float
    locked: float


def level() -> Line:
    """Level, straight track."""
    return Line(
        name="level",
        length=LENGTH,
        stations=(Station("A", 0.0), Station("B", LENGTH)),
        speed_limits=StepProfile(np.zeros(1), np.full(1, 160.0 / KMH)),
        gradients=StepProfile(np.zeros(1), np.zeros(1)),
    )


def scenario_on(train: Train, adhesion: StepProfile, control: TractionName | None) -> Scenario:
    """The train on this rail, which no control knows."""
    line = level()
    drawn = draw_scenarios(line, train, 1, seed=5)[0]
    found = replace(
        drawn, direction="forward", maximum_adhesion=adhesion, survey_error=None, weather="wet"
    )
    if control is None:
        return found
    return with_traction([found], control)[0]


def stopped(scenario: Scenario, speed: float, deceleration: float) -> Stop:
    """A stop with this demand."""
    trial = Trial(scenario, BEGIN, speed)
    effort = deceleration * (scenario.mass + scenario.train.rotating_mass)
    speeds, places = [speed], [BEGIN]
    slide, locked, ticks = 0.0, 0, 0
    while trial.state.speed > AT_REST and ticks < PATIENCE:
        trial.advance(0.0, effort)
        ticks += 1
        slowest, now = float(trial.state.wheel_speeds.min()), trial.state.speed
        slide = max(slide, now - slowest)
        locked += now > 10.0 / KMH and slowest < 0.5
        speeds.append(now)
        places.append(trial.state.position)
    return Stop(trial.way, used(scenario, places, speeds, deceleration), slide, locked / ticks)


def used(scenario: Scenario, places: list[float], speeds: list[float], demand: float) -> float:
    """Force between wheels and rail over what the rail gives, where it gives less than is asked.

    The brakes themselves slow what turns: it asks nothing of the rail.
    """
    at, v = np.array(places), np.array(speeds)
    found: FloatArray = -np.diff(v) / PERIOD - scenario.resistance(v[:-1]) / scenario.mass
    offered = scenario.maximum_adhesion(at[:-1]) * GRAVITY
    scarce = (offered < demand) & (v[:-1] > 5.0 / KMH)
    return float(found[scarce].sum() / offered[scarce].sum()) if scarce.any() else np.nan


def needed(train: Train, way: float) -> float:
    """Adhesion with which it stops in a distance from 55 mph at 0.9 m/s2."""
    low, high = 0.005, 0.2
    for _ in range(14):
        middle = 0.5 * (low + high)
        found = stopped(scenario_on(train, rail((0.0, middle)), None), 88.5 / KMH, 0.9)
        low, high = (middle, high) if found.way > way else (low, middle)
    return high


def main() -> None:
    """The command at the top."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--published", type=Path, default=Path("../shared/data/ttobench"))
    parser.add_argument("--trains", type=int, default=len(PAIRS))
    options = parser.parse_args()
    trains = [
        read_train(options.published / "trains" / f"{name}.json")
        for _, name in PAIRS[: options.trains]
    ]
    table = new_table(
        "Stops from 100 km/h", "rail", "train", "control", "way, m", "used", "slide, km/h", "locked"
    )
    for case, adhesion in CASES.items():
        for train in trains:
            for control in CONTROLS:
                scenario = scenario_on(train, adhesion, control)
                found = stopped(scenario, FASTEST, train.max_deceleration)
                row = (
                    case, train.name, control or "plant's own", f"{found.way:.0f}",
                    f"{found.used:.0%}", f"{KMH * found.slide:.1f}", f"{found.locked:.0%}",
                )  # fmt: skip
                print(*row, sep=" | ", flush=True)
                table.add_row(*row)
    names = [each.name for each in trains]
    trial = new_table("Adhesion for the stops of the sanding trial", "way, m", "sanders", *names)
    for way, sanders in SANDING:
        trial.add_row(f"{way:.0f}", sanders, *(f"{needed(each, way):.3f}" for each in trains))
    untreated = [
        stopped(scenario_on(each, rail((0.0, 0.02)), None), 88.5 / KMH, 0.9).way for each in trains
    ]
    console = Console(width=150)
    console.print(table, trial)
    console.print("on untreated rail of 0.02:", ", ".join(f"{way:.0f} m" for way in untreated))


if __name__ == "__main__":
    main()

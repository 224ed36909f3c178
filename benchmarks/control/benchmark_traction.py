"""Traction controls in the loop: cooperative on a map, plain re-adhesion, the plant's protection.

    python benchmarks/control/benchmark_traction.py [--places 8]

Three lines with three trains. At places along the line, the same for all controls, the train starts
with all tractive effort and runs up for 400 m, and is stopped from 80 km/h by full service braking:
the lever is at its end, so that the rail decides. The map is made by the package's own way from
trips with ordinary drivers on the same lasting rail (`adhesion_map`), each of which met other
passing spots; no controller knows the rail of its run.

Each rail is driven by each control: dry; wet; changing (wet, with dry stretches where the map says
wet); another than the map says (wet, at 70 per cent of the maximum on which the map was made); and
wheels and rail of another characteristic, Polach's with falling friction, which none of the
controls knows. Means over the places: work at the wheel rims and work lost in creep of a start; its
mean acceleration over the way; way of a stop; decisions that were not solved or late.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from analysis.adhesion.condition_map import adhesion_map
from analysis.control.traction import TractionName, with_traction
from trainlog.formats.ttobench import read_track, read_train
from trainlog.presentation import new_table
from trainlog.railway import Line, StepProfile, Train
from trainlog.railway.adhesion import polach_curve
from trainlog.railway.condition import TrackConditionMap
from trainlog.simulation import Scenario, draw_scenarios, simulate
from trainlog.simulation.drivers import AT_REST, PERIOD
from trainlog.units import JOULES_PER_KWH, KMH

PAIRS = (
    ("CH_StGallen_Wil", "CH_Stadler_FLIRT_TPF"),
    ("CH_Stadelhofen_Altstetten", "CH_Stadler_KISS_SBB"),
    ("00_reference", "NL_Intercity_VIRM6"),
)
"""Lines and trains."""

CONTROLS: tuple[TractionName | None, ...] = (None, "readhesion", "cooperative")

"""A kilowatt-hour [J]."""

FASTEST = 80.0 / KMH
"""From which the train is stopped [m/s]."""

RUN_UP = 400.0
"""Over which it starts [m]."""

PATIENCE = 3_000
"""Periods after which a start or a stop is given up."""

LEARNT_FROM = 16
"""Trips of ordinary drivers, half of them wet, of which the map is made."""


@dataclass(frozen=True)
class Found:
    """Of all starts and stops on one rail by one control; see the head of this file."""

    control: str
    tractive: float
    creep: float
    acceleration: float
    stopping: float
    unsolved: int
    late: int
    decisions: int


class Trial:
    """One start or stop of a scenario's train, by its own traction control."""

    def __init__(self, scenario: Scenario, position: float, speed: float) -> None:
        self.plant = scenario.plant()
        self.state = self.plant.at(position, speed)
        self.loop = scenario.traction_loop(self.plant)
        self._scenario, self._begin = scenario, position
        self._steps = round(PERIOD / self.plant.parameters.step)

    def advance(self, tractive: float, braking: float) -> None:
        """Let a driver's period pass."""
        if self.loop is None:
            self.plant.advance(self.state, tractive, braking, self._steps, self._steps)
        else:
            self.loop.advance(self.state, (tractive, braking), self._steps, self._steps)

    def start(self) -> None:
        """All effort, for `RUN_UP`."""
        train, ticks = self._scenario.train, 0
        while self.way < RUN_UP and ticks < PATIENCE:
            self.advance(float(train.tractive_effort_limit(self.state.speed)), 0.0)
            ticks += 1

    def stop(self) -> None:
        """Full service braking to a stand."""
        train, ticks = self._scenario.train, 0
        effort = train.max_deceleration * (self._scenario.mass + train.rotating_mass)
        while self.state.speed > AT_REST and ticks < PATIENCE:
            self.advance(0.0, effort)
            ticks += 1

    @property
    def way(self) -> float:
        """Since the beginning [m]."""
        return self.state.position - self._begin


def measured(scenario: Scenario, control: TractionName | None, places: np.ndarray) -> Found:
    """Start and stop at each place, and read the figures from what truly happened."""
    starts = [Trial(scenario, float(place), 0.0) for place in places]
    stops = [Trial(scenario, float(place), FASTEST) for place in places]
    for trial in starts:
        trial.start()
    for trial in stops:
        trial.stop()
    loops = [trial.loop for trial in starts + stops if trial.loop is not None]
    return Found(
        control or "plant's own",
        float(np.mean([trial.state.works["traction"] for trial in starts])) / JOULES_PER_KWH,
        float(np.mean([trial.state.works["slip"] for trial in starts])) / JOULES_PER_KWH,
        float(np.mean([trial.state.speed**2 / (2.0 * trial.way) for trial in starts])),
        float(np.mean([trial.way for trial in stops])),
        sum(len(loop.unsolved) for loop in loops),
        sum(loop.late for loop in loops),
        sum(loop.steps for loop in loops),
    )


def scaled(profile: StepProfile, factor: float) -> StepProfile:
    return StepProfile(profile.positions, profile.values * factor)


def patched(wet: StepProfile, dry: StepProfile) -> StepProfile:
    """Wet, with dry stretches of 200 m every 600 m."""
    places = wet.positions
    inside = np.mod(np.maximum(places, 0.0), 600.0) < 200.0
    return StepProfile(places, np.where(inside, dry(places), wet.values))


Rail = tuple[str, str, Callable[[Scenario, Scenario], Scenario]]
RAILS: tuple[Rail, ...] = (
    ("dry", "dry", lambda dry, _: dry),
    ("wet", "wet", lambda _, wet: wet),
    (
        "changing",
        "wet",
        lambda dry, wet: replace(
            wet, maximum_adhesion=patched(wet.maximum_adhesion, dry.maximum_adhesion)
        ),
    ),
    (
        "70 % of the map's",
        "wet",
        lambda _, wet: replace(wet, maximum_adhesion=scaled(wet.maximum_adhesion, 0.7)),
    ),
    ("Polach, wet", "wet", lambda _, wet: replace(wet, characteristic=polach_curve("wet"))),
)
"""Name, layer of the map, and how the scenario comes of a dry and of a wet one."""


def learnt(line: Line, train: Train) -> TrackConditionMap:
    """The map of trips with ordinary drivers."""
    trips = [simulate(each) for each in draw_scenarios(line, train, LEARNT_FROM, seed=5)]
    return adhesion_map(trips).track


def driven(
    line: Line, train: Train, count: int, rails: tuple[Rail, ...], controls: tuple
) -> Iterator[tuple[str, Found]]:
    """Every rail by every control."""
    track = learnt(line, train)
    drawn = draw_scenarios(line, train, LEARNT_FROM + 4, seed=5)[LEARNT_FROM:]
    dry, wet = drawn[0], drawn[2]
    places = np.linspace(0.06, 0.94, count) * (line.length - 1_500.0)
    for name, layer, make in rails:
        scenario = make(dry, wet)
        for control in controls:
            each = scenario
            if control is not None:
                each = with_traction([scenario], control, track, layer)[0]
            yield name, measured(each, control, places)


def rows_of(published: Path, places: int, rails: int, pair: tuple[str, str]) -> list[tuple]:
    """The rows of one line and train."""
    line_name, train_name = pair
    line = read_track(published / "tracks" / f"{line_name}.json")
    train = read_train(published / "trains" / f"{train_name}.json")
    rows = []
    for rail, found in driven(line, train, places, RAILS[:rails], CONTROLS):
        row = (
            f"{line_name}, {train_name}", rail, found.control, f"{found.tractive:.2f}",
            f"{found.creep:.3f}", f"{found.acceleration:.3f}",
            f"{found.stopping:.0f}",
            f"{found.unsolved} / {found.late} of {found.decisions}" if found.decisions else "",
        )  # fmt: skip
        print(*row, sep=" | ", flush=True)
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--published", type=Path, default=Path("../shared/data/ttobench"))
    parser.add_argument("--places", type=int, default=8)
    parser.add_argument("--pairs", type=int, default=len(PAIRS))
    parser.add_argument("--rails", type=int, default=len(RAILS))
    parser.add_argument("--processes", type=int, default=1, help="Lines driven at once.")
    options = parser.parse_args()
    make = partial(rows_of, options.published, options.places, options.rails)
    pairs = PAIRS[: options.pairs]
    table = new_table(
        "Traction controls in the loop", "line, train", "rail", "control", "tractive kWh",
        "creep kWh", "m/s²", "stop from 80 km/h, m",
        "unsolved / late",
    )  # fmt: skip
    with ProcessPoolExecutor(options.processes) as pool:
        for rows in pool.map(make, pairs):
            for row in rows:
                table.add_row(*row)
    Console(width=170).print(table)


if __name__ == "__main__":
    main()

"""Traction controls in the loop: cooperative on a map, plain re-adhesion, the plant's protection.

    python benchmarks/control/benchmark_traction.py [--published ../shared/data/ttobench] [--runs 6]

Three lines with three trains. A driver demands all tractive effort up to a speed, then full service
braking to a stop, over and over along the line (`FullEffort`); the lever is always at its end, so
that the rail decides. The map is made by the package's own way from trips with ordinary drivers on
the same lasting rail (`adhesion_map`), each of which met other passing spots; no controller knows
the rail of its run.

Each rail is driven by each control: dry; wet; changing (wet, with dry stretches where the map says
wet); another than the map says (wet, at 70 per cent of the maximum on which the map was made); and
wheels and rail of another characteristic, Polach's with falling friction, which none of the
controls knows. Per run: work at the wheel rims and work lost in creep, over the way; mean
acceleration while traction is demanded; way from the brake application to the stop, per speed
squared, as the way from 80 km/h; decisions that were not solved or late.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from analysis.adhesion.condition_map import adhesion_map
from analysis.control.traction import TractionName, with_traction
from analysis.tables import new_table
from trainlog.formats.ttobench import read_track, read_train
from trainlog.railway import Line, StepProfile, Train
from trainlog.railway.adhesion import polach_curve
from trainlog.railway.condition import TrackConditionMap
from trainlog.simulation import Demand, Observation, Scenario, draw_scenarios, drive, simulate
from trainlog.simulation.drivers import AT_REST
from trainlog.units import KMH

PAIRS = (
    ("CH_StGallen_Wil", "CH_Stadler_FLIRT_TPF"),
    ("CH_Stadelhofen_Altstetten", "CH_Stadler_KISS_SBB"),
    ("00_reference", "NL_Intercity_VIRM6"),
)
"""Lines and trains."""

CONTROLS: tuple[TractionName | None, ...] = (None, "readhesion", "cooperative")

KWH = 3.6e6
"""A kilowatt-hour [J]."""

FASTEST = 80.0 / KMH
"""From which the driver brakes [m/s]."""

LEARNT_FROM = 16
"""Trips of ordinary drivers, half of them wet, of which the map is made."""


@dataclass
class FullEffort:
    """Demands all effort up to a speed, then full braking to a stop, over and over.

    Attributes
    ----------
    line : Line
        In the direction of travel.
    train : Train
    mass : float [kg]
    starts : int
        How often.
    """

    line: Line
    train: Train
    mass: float
    starts: int
    done: int = 0
    braking: bool = False

    def demand(self, observation: Observation) -> Demand:
        """Full traction or full braking."""
        place, speed = observation.position, observation.speed
        ahead = self.line.length - place
        most = min(FASTEST, float(self.line.limits_over(self.train.length)(place)))
        if self.braking and speed < AT_REST:
            self.done += 1
            self.braking = False
        if speed >= most or ahead < 1_500.0:
            self.braking = True
        effort = self.train.max_deceleration * (self.mass + self.train.rotating_mass)
        if self.finished or self.braking:
            return Demand(0.0, effort)
        return Demand(float(self.train.tractive_effort_limit(speed)), 0.0)

    @property
    def finished(self) -> bool:
        """Whether all starts are done."""
        return self.done >= self.starts


@dataclass(frozen=True)
class Found:
    """Of one run; see the head of this file."""

    control: str
    tractive: float
    creep: float
    acceleration: float
    stopping: float
    adhesion: float
    unsolved: int
    decisions: int
    late: int


@dataclass(frozen=True, eq=False)
class Demanding(Scenario):
    """A scenario whose driver demands all, so many times."""

    starts: int = 6

    def driver(self) -> FullEffort:
        """Who drives."""
        return FullEffort(self.travelled, self.train, self.mass, self.starts)


def full_effort(scenario: Scenario, starts: int) -> Demanding:
    """The scenario with the driver who demands all."""
    known = {each.name: getattr(scenario, each.name) for each in fields(Scenario)}
    first, last = scenario.stops[0], scenario.stops[-1]
    known["stops"] = (first, replace(last, arrival=3_600.0, departure=3_600.0))
    known["sensors"] = replace(scenario.sensors, rate=50)
    return Demanding(**known, starts=starts)


def measured(scenario: Demanding, control: TractionName | None) -> Found:
    """Drive one scenario and read the figures from what truly happened."""
    run = drive(scenario)
    columns = dict(zip(scenario.plant().columns, run.samples.T, strict=True))
    speed, place = columns["speed"], columns["position"]
    numbers = range(1, scenario.train.axles.count + 1)
    wheels = np.column_stack([columns[f"wheel_speed_{i}"] for i in numbers])
    efforts = np.column_stack([columns[f"wheel_effort_{i}"] for i in numbers])
    step = float(run.seconds[1] - run.seconds[0])
    contact = efforts - scenario.train.axles.rotating_mass * np.gradient(wheels, step, axis=0)
    creep = float(np.sum(contact * (wheels - speed[:, None])) * step)
    pulling, braking = run.demands.T > 0.0
    gained = np.diff(speed)[pulling[:-1] & pulling[1:]]
    ways, squares = 0.0, 0.0
    for begin in np.flatnonzero(np.diff(braking.astype(np.int8)) > 0) + 1:
        stopped = np.flatnonzero(speed[begin:] < AT_REST)
        if stopped.size and speed[begin] > 5.0:
            ways += float(place[begin + stopped[0]] - place[begin])
            squares += float(speed[begin] ** 2)
    way = float(place[-1] - place[0]) / 1e3
    weight = scenario.train.adhesive_weight(scenario.load)
    loop = run.traction
    return Found(
        control or "plant's own",
        float(columns["energy"][-1]) / KWH / way,
        creep / KWH / way,
        float(np.mean(gained)) / step,
        ways / squares * FASTEST**2 if squares else np.nan,
        float(np.mean(contact[pulling].sum(axis=1))) / weight,
        0 if loop is None else len(loop.unsolved),
        0 if loop is None else loop.steps,
        0 if loop is None else loop.control.late,
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
    line: Line, train: Train, starts: int, rails: tuple[Rail, ...], controls: tuple
) -> Iterator[tuple[str, Found]]:
    """Every rail by every control."""
    track = learnt(line, train)
    drawn = draw_scenarios(line, train, LEARNT_FROM + 4, seed=5)[LEARNT_FROM:]
    dry, wet = drawn[0], drawn[2]
    for name, layer, make in rails:
        scenario = full_effort(make(dry, wet), starts)
        for control in controls:
            each = scenario
            if control is not None:
                each = with_traction([scenario], control, track, layer)[0]
            yield name, measured(each, control)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--published", type=Path, default=Path("../shared/data/ttobench"))
    parser.add_argument("--starts", type=int, default=6)
    parser.add_argument("--pairs", type=int, default=len(PAIRS))
    parser.add_argument("--rails", type=int, default=len(RAILS))
    options = parser.parse_args()
    table = new_table(
        "Traction controls in the loop", "line, train", "rail", "control", "tractive kWh/km",
        "creep kWh/km", "m/s² in traction", "adhesion used", "stop from 80 km/h, m",
        "unsolved / late",
    )  # fmt: skip
    for line_name, train_name in PAIRS[: options.pairs]:
        line = read_track(options.published / "tracks" / f"{line_name}.json")
        train = read_train(options.published / "trains" / f"{train_name}.json")
        for rail, found in driven(line, train, options.starts, RAILS[: options.rails], CONTROLS):
            row = (
                f"{line_name}, {train_name}", rail, found.control, f"{found.tractive:.2f}",
                f"{found.creep:.3f}", f"{found.acceleration:.3f}", f"{found.adhesion:.3f}",
                f"{found.stopping:.0f}",
                f"{found.unsolved} / {found.late} of {found.decisions}" if found.decisions else "",
            )  # fmt: skip
            print(*row, sep=" | ", flush=True)
            table.add_row(*row)
    Console(width=170).print(table)


if __name__ == "__main__":
    main()

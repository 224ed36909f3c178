"""Whether the bands of measured against calculated hold, and whether wrong train files are named.

    python benchmarks/recorded/benchmark_calculated.py [--published ../shared/data/ttobench]
        [--trips 8] [--seed 1300] [--wind 4] [--part bands|files]
        [--files nothing r0 ...] [--workers 2]

Three trains on three lines. A fit of some trips predicts others of another seed, all with a head
wind of their own, lasting noise of speeds and efforts, efforts up to 0.5 s late and 3 % off, the
load weighed or unknown, the wind recorded (0.7 m/s off, and gusts) or not. A row a pair and kind of
recording: share of the sections whose measured time, and measured work, lies in the 95 % band; half
the width of the bands over the value.

Then trips are judged by the train's file as it is, with one coefficient four times too large, or
the mass 10 % off, each by itself and four together: how often exactly that was named, named among
alternatives, missed, and how often the right file was called wrong.
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from benchmark_passport import recorded
from recordings import PAIRS, line_and_train

from analysis.comparison.calculated import Diagnosis, calculate, judged_together
from analysis.resistance.logs import fit
from trainlog.errors import TrainlogError
from trainlog.railway import RunningResistance, Train
from trainlog.simulation import Sensors, draw_scenarios, simulate
from trainlog.simulation.sensors import correlated
from trainlog.trip import Trip

KINDS = ("load weighed", "load unknown", "wind recorded")


@dataclass(frozen=True)
class Task:
    """Trips of a pair of line and train, recorded in one of the `KINDS`."""

    pair: int
    published: Path
    count: int
    seed: int
    wind: float
    kind: str
    files: tuple[str, ...] = ()


def trips(task: Task, seed: int) -> list[Trip]:
    """Recorded trips with wind, other noise, late efforts."""
    line, train = line_and_train(task.pair, task.published)
    sensors = Sensors(load_error=None if task.kind == "load unknown" else 0.025)
    found = []
    for number, scenario in enumerate(draw_scenarios(line, train, task.count, seed, sensors)):
        rng = np.random.default_rng([seed, number, 77])
        own, wind = scenario.resistance, rng.normal(0.0, task.wind)
        windy = RunningResistance(own.r0 + own.r2 * wind**2, own.r1 + 2.0 * own.r2 * wind, own.r2)
        trip = simulate(replace(scenario, resistance=windy))
        if task.kind == "wind recorded":
            trip = with_wind(trip, wind + rng.normal(0.0, 0.7), rng)
        gain, delay = rng.normal(1.0, 0.03), rng.uniform(0.0, 0.5)
        found.append(recorded(trip, 10, float(gain), float(delay), rng))
    return found


def with_wind(trip: Trip, wind: float, rng: np.random.Generator) -> Trip:
    """The trip with a recorded head wind [m/s] and gusts of 1.5 m/s."""
    frame = trip["/environment"]
    gusts = 1.5 * correlated(len(frame), 1.0, 10.0, rng)
    changed = frame.assign(head_wind=wind + gusts)
    changed.attrs = frame.attrs
    return trip.with_topic(changed)


def covered(task: Task) -> tuple[str, list[float]]:
    """Shares of sections in the bands, and the widths of these."""
    learnt = fit(trips(task, task.seed + task.pair))
    model = learnt.parameters
    rows = []
    for trip in trips(task, task.seed + 50 + task.pair):
        table = calculate(trip, model).table
        time, work = (
            (table[name] - table[f"calculated_{name}"]).abs() <= 1.96 * table[f"{name}_std"]
            for name in ("time", "work")
        )
        rows += zip(
            time,
            work,
            1.96 * table["time_std"] / table["calculated_time"],
            1.96 * table["work_std"] / table["calculated_work"],
            strict=True,
        )
    figures = np.array(rows, dtype=float)
    name = f"{PAIRS[task.pair]}, {task.kind}, {len(rows)} sections"
    return name, [*figures[:, :2].mean(axis=0), *np.median(figures[:, 2:], axis=0)]


def wrong_files(train: Train) -> dict[str, Train]:
    """Files of the train with one thing wrong."""
    own = train.resistance
    found = {"nothing": train}
    for name in ("r0", "r1", "r2"):
        if getattr(own, name) > 0.0:
            changed = replace(own, **{name: 4.0 * getattr(own, name)})
            found[name] = replace(train, resistance=changed)
    for factor in (1.1, 0.9):
        rotating = train.rotating_mass_factor / factor
        heavy = replace(train, mass=factor * train.mass, rotating_mass_factor=rotating)
        found[f"mass {factor:g}"] = heavy
    return found


def answer(diagnosis: Diagnosis, wrong: str) -> str:
    """How what was said of a file compares with what is wrong of it."""
    if diagnosis.not_judged:
        return "not judged"
    expected = wrong.partition(" ")[0]
    names = [each.name for each in diagnosis.wrong]
    others = [other for each in diagnosis.wrong for other in each.alternatives]
    if names == ([] if expected == "nothing" else [expected]):
        return "right"
    if expected in names + others or "running resistance" in names:
        return "found, with others"
    return "missed" if not names else "another: " + ", ".join(names)


def named(task: Task) -> list[tuple[str, str, str, str]]:
    """What is said of each file, by each trip and by four together."""
    _, train = line_and_train(task.pair, task.published)
    found, judged = [], trips(task, task.seed + 100 + task.pair)
    for wrong, file in wrong_files(train).items():
        if task.files and wrong not in task.files:
            continue
        calculations = []
        for trip in judged:
            try:
                calculations.append(calculate(trip, file))
            except TrainlogError as error:
                found.append((task.kind, "1", wrong, f"refused: {error}"[:60]))
                continue
            found.append((task.kind, "1", wrong, answer(calculations[-1].diagnosis, wrong)))
        for first in range(0, len(calculations) - 3, 4):
            together = judged_together(calculations[first : first + 4])
            found.append((task.kind, "4", wrong, answer(together, wrong)))
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--published", type=Path, default=Path("../shared/data/ttobench"))
    parser.add_argument("--trips", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1300)
    parser.add_argument("--wind", type=float, default=4.0, help="standard deviation [m/s]")
    parser.add_argument("--part", choices=("bands", "files"))
    parser.add_argument("--files", nargs="+", default=[], help="as nothing, r0, mass 1.1")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    tasks = [
        Task(
            pair,
            given.published,
            given.trips,
            given.seed,
            given.wind,
            kind,
            tuple(given.files),
        )
        for kind in KINDS
        for pair in range(len(PAIRS))
    ]
    with ProcessPoolExecutor(given.workers) as pool:
        if given.part != "files":
            print("time, work in the band; half width over time, over work")
            for name, figures in pool.map(covered, tasks):
                print(f"  {name}: " + " ".join(f"{figure:.3f}" for figure in figures), flush=True)
        if given.part != "bands":
            print("recording; trips judged together; what is wrong: what was said, how often")
            rows: Counter[tuple[str, str, str, str]] = Counter()
            for task, found in zip(tasks, pool.map(named, tasks), strict=True):
                rows.update(found)
                alarms = sum(each[1:3] == ("1", "nothing") and each[3] != "right" for each in found)
                print(f"  {PAIRS[task.pair]}, {task.kind}: {alarms} alarms", flush=True)
            for (kind, together, wrong, said), count in sorted(rows.items()):
                print(f"  {kind}; {together}; {wrong}: {said} {count}")


if __name__ == "__main__":
    main()

"""Whether the bands of measured against calculated hold, and whether wrong train files are named.

    python benchmarks/recorded/benchmark_calculated.py [--published ../shared/data/ttobench]
        [--trips 8] [--workers 2]

Three trains on three lines. A fit of some trips predicts others of another seed, all with a head
wind of their own (no estimator knows of it), lasting noise of speeds and efforts, efforts up to
0.5 s late and 3 % off (1 % where files are judged), the load weighed or unknown. A row a pair and
kind of load: share of the sections whose measured time, and measured work, lies in the 95 % band;
half the width of the bands over the value. Then each train's file with one coefficient four times
too large, or the mass 10 % off: how often exactly that was named, named among alternatives, and how
often the right file was called wrong.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmark_passport import recorded
from recordings import PAIRS, line_and_train

from analysis.comparison.calculated import calculate
from analysis.resistance.logs import fit
from trainlog.errors import TrainlogError
from trainlog.railway import RunningResistance, Train
from trainlog.simulation import Sensors, draw_scenarios, simulate
from trainlog.trip import Trip

WIND = 4.0
"""Standard deviation of a trip's head wind [m/s]."""


def trips(
    pair: int, published: Path, count: int, seed: int, weighed: bool, gain_std: float = 0.03
) -> list[Trip]:
    """Recorded trips with wind, other noise, late efforts."""
    line, train = line_and_train(pair, published)
    sensors = Sensors(load_error=0.025 if weighed else None)
    found = []
    for number, scenario in enumerate(draw_scenarios(line, train, count, seed, sensors)):
        rng = np.random.default_rng([seed, number, 77])
        own, wind = scenario.resistance, rng.normal(0.0, WIND)
        windy = RunningResistance(
            max(own.r0 + own.r2 * wind**2, 0.0), max(own.r1 + 2.0 * own.r2 * wind, 0.0), own.r2
        )
        trip = simulate(replace(scenario, resistance=windy))
        gain, delay = rng.normal(1.0, gain_std), rng.uniform(0.0, 0.5)
        found.append(recorded(trip, 10, float(gain), float(delay), rng))
    return found


def covered(task: tuple[int, Path, int, bool]) -> tuple[str, list[float]]:
    """Shares of sections in the bands, and the widths of these."""
    pair, published, count, weighed = task
    learnt = fit(trips(pair, published, count, 100 + pair, weighed))
    model = learnt.parameters
    rows = []
    for trip in trips(pair, published, count, 200 + pair, weighed):
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
    name = f"{PAIRS[pair]}, {'weighed' if weighed else 'load unknown'}, {len(rows)} sections"
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


def named(task: tuple[int, Path, int]) -> list[tuple[str, str]]:
    """What is named wrong of each file."""
    pair, published, count = task
    _, train = line_and_train(pair, published)
    found = []
    for trip in trips(pair, published, count, 300 + pair, True, 0.01):
        for wrong, file in wrong_files(train).items():
            try:
                diagnosis = calculate(trip, file).diagnosis
            except TrainlogError as error:
                found.append((wrong, f"refused: {error}"[:60]))
                continue
            expected = wrong.partition(" ")[0]
            names = [each.name for each in diagnosis.wrong]
            others = [other for each in diagnosis.wrong for other in each.alternatives]
            if diagnosis.reason:
                found.append((wrong, "not judged"))
            elif names == ([] if expected == "nothing" else [expected]):
                found.append((wrong, "right"))
            elif expected in names + others or "running resistance" in names:
                found.append((wrong, "found, with others"))
            else:
                found.append((wrong, "missed" if not names else "another: " + ", ".join(names)))
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--published", type=Path, default=Path("../shared/data/ttobench"))
    parser.add_argument("--trips", type=int, default=8)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    pairs = range(len(PAIRS))
    with ProcessPoolExecutor(options.workers) as pool:
        tasks = [
            (pair, options.published, options.trips, weighed)
            for pair in pairs
            for weighed in (True, False)
        ]
        print("time, work in the band; half width over time, over work")
        for name, figures in pool.map(covered, tasks):
            print(f"  {name}: " + " ".join(f"{figure:.3f}" for figure in figures), flush=True)
        counts: dict[tuple[str, str], int] = {}
        judging = [(pair, options.published, options.trips) for pair in pairs]
        for rows in pool.map(named, judging):
            for each in rows:
                counts[each] = counts.get(each, 0) + 1
    for (wrong, answer), number in sorted(counts.items()):
        print(f"  {wrong}: {answer} {number}")


if __name__ == "__main__":
    main()

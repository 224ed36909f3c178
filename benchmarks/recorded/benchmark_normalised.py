"""How well energies of trips with unlike loads compare, against driving them with the same load.

    python benchmarks/recorded/benchmark_normalised.py [--published ../shared/data/ttobench]
        [--trips 6]

Each of some simulated trips on two lines is driven twice by its driver, with two loads. The
tractive work of the first, at the load and running time of the second, is compared with that of the
second: root mean square of the difference before and after, half the 95 % band (median), and the
share of trips in it. The resistance is that of the train's file, not that of the trips.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from recordings import line_and_train

from analysis import compare
from trainlog.simulation import draw_scenarios, simulate


def main() -> None:
    """Print a row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--published", type=Path, default=Path("../shared/data/ttobench"))
    parser.add_argument("--trips", type=int, default=6)
    options = parser.parse_args()
    rows = []
    for pair in (0, 1):
        line, train = line_and_train(pair, options.published)
        for scenario in draw_scenarios(line, train, options.trips, seed=31):
            rng = np.random.default_rng(scenario.seed + 7)
            masses = train.mass + rng.uniform(0.0, train.max_load or 0.2 * train.mass, 2)
            first, second = (
                simulate(replace(scenario, name=f"{name}", mass=float(mass)))
                for name, mass in zip("ab", masses, strict=True)
            )
            found = compare([first, second], second)
            energy = found.trip("a").energy
            if energy is None:
                continue
            recorded, true = (found.trip(name).trip.sums["traction"][-1] for name in "ab")
            off = np.array([recorded, energy.value]) / true - 1.0
            reach = 1.96 * energy.std / true
            rows.append([*off, reach, abs(off[1]) < reach])
    table = np.array(rows, dtype=float)
    before, after = np.sqrt(np.mean(table[:, :2] ** 2, axis=0))
    held = table[:, 3].mean()
    print(f"{len(table)} pairs: {before:.1%} apart, {after:.1%} at one load and time;")
    print(f"half the band {np.median(table[:, 2]):.1%}, {held:.0%} in it")


if __name__ == "__main__":
    main()

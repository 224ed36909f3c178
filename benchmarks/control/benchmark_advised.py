"""Drivers who follow the advice, to the letter and as people do, beside the controller.

    python benchmarks/control/benchmark_advised.py [--lines 3] [--trains 3] [--reserves 3]

Three lines, three trains and three reserves make 27 plans for running resistances from 0.85 to
1.15 times the file's and two drawn configurations; each is driven in all four, on dry rail with
the plant's brakes and drives: 108 trips for each driver. The controller is the model predictive
one; `analysis.control.advised` follows the rows of the advice, to the letter, or with a reaction
time of 2 s, a dead band of 2 km/h and a speedometer that is 1 km/h off (standard deviation).
Energy is that at the wheels against the plan of the same configuration.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from outcome import outcome
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from trajectory_cases import FLIRT, FREIGHT, VIRM6, drawn, hilly_line, observed

from analysis.control.advised import EXACT, AdvisedDriver, Attention
from analysis.control.follow import MARGIN, Follower, Odometry
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.arrays import FloatArray
from trainlog.formats.railway import read_line
from trainlog.formats.samples import sample
from trainlog.railway import Axles, Line, Train, Trajectory
from trainlog.simulation import Scenario, drive, trajectory_scenarios
from trainlog.simulation.drivers import Driver
from trainlog.units import KMH

# Its 214 kN need more weight on powered axles than the model of its study states.
TRAINS = (FLIRT, replace(VIRM6, axles=Axles(count=8, adhesive_mass=180_000.0)), FREIGHT)

NAMES = ("CH_StGallen_Wil", "DE_Chemnitz_Cranzahl")
RESERVES = (0.04, 0.12, 0.4)


def figures(scenario: Scenario) -> FloatArray:
    """Lateness [s], energy over planned [%], over the limit [km/h], off the stop [m]."""
    found = outcome(scenario, drive(scenario))
    return np.array(
        [found.late, 100.0 * found.excess_work, KMH * found.overspeed, abs(found.off_stop)]
    )


def drivers(
    plan: Trajectory, line: Line, train: Train, seed: int
) -> dict[str, Callable[[], Driver]]:
    """Who drives, by name."""
    advised = partial(AdvisedDriver, plan, line, train, seed=seed)
    return {
        "controller": partial(Follower, plan, line, train, layer="dry", margin=MARGIN),
        "advice, to the letter": partial(advised, attention=EXACT),
        "advice, a person": partial(advised, attention=Attention()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lines", type=int, default=3)
    parser.add_argument("--trains", type=int, default=3)
    parser.add_argument("--reserves", type=int, default=3)
    arguments = parser.parse_args()
    lines = [hilly_line(), *(read_line(sample(f"{name}.line.json")) for name in NAMES)]
    trips: dict[str, list[FloatArray]] = {}
    for line in lines[: arguments.lines]:
        for train in TRAINS[: arguments.trains]:
            configurations = [*observed(train, 0.85, 1.15), *drawn(train, 2, seed=3)]
            for number, reserve in enumerate(RESERVES[: arguments.reserves]):
                plan = optimise(TrajectoryProblem(line, train, configurations, reserve=reserve))
                for name, follows in drivers(plan, line, train, number).items():
                    locates = Odometry if name == "controller" else None
                    every = trajectory_scenarios(
                        plan, line, train, plan.chosen("all"), follows, locates=locates,
                        weather="dry",
                    )  # fmt: skip
                    rows = [figures(each) for each in every]
                    trips.setdefault(name, []).extend(
                        np.append(row, 100.0 * row[0] / plan.running_time) for row in rows
                    )
                    mean = np.mean(rows, axis=0)
                    print(
                        f"{line.name} {train.name} {reserve:.0%} {name}: late {mean[0]:+.1f} s,"
                        f" energy {mean[1]:+.1f} %, over {mean[2]:+.1f} km/h",
                        flush=True,
                    )
    table = Table(
        "driver", "trips", "late, median", "late, at most", "of the time", "energy, mean",
        "energy, at most", "over the limit, 90 %", "at most", "off the stop, at most",
    )  # fmt: skip
    for name, rows in trips.items():
        late, energy, over, stop, share = np.array(rows).T
        table.add_row(
            name, f"{late.size}", f"{np.median(late):+.1f} s", f"{late.max():+.1f} s",
            f"{share.max():+.1f} %", f"{energy.mean():+.1f} %", f"{energy.max():+.1f} %",
            f"{np.quantile(over, 0.9):+.1f} km/h", f"{over.max():+.1f} km/h", f"{stop.max():.2f} m",
        )  # fmt: skip
    Console(width=160).print(table)


if __name__ == "__main__":
    main()

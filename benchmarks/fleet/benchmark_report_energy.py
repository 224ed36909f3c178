"""How much energy plans save with the resistance that each way of logging has taught.

    python benchmarks/fleet/benchmark_report_energy.py FOLDER CATALOGUE [...] [--reserve 0.08]

FOLDER is that of `trainlog simulate fleet`, each CATALOGUE one of `benchmark_reports.py`. A plan is
made for each train on a line of its own trips: with the resistance of its train file (nothing is
learned), with that which each catalogue states of the train (of a train without a fit: that of the
file), and with the true one. A train with the true resistance then follows each plan in the
simulator, on dry rail, and arrives as near to the same time as it can. Loads are known, and no plan
counts on the rail: a train whose effort it does not bear is late by all plans alike.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from fleet_truth import PARAMETERS, drawn_again
from judge_fleet import Judged, printed

from analysis.control.follow import Follower
from analysis.fleet.resistance import fleet_resistance
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.catalogue import open_catalogue
from trainlog.formats.railway import line_of, train_of
from trainlog.mcap import read_log
from trainlog.railway import Configuration, Line, RunningResistance, Train
from trainlog.simulation import drive, trajectory_scenarios
from trainlog.simulation.drivers import DEPARTURE

NOTHING, TRUTH = "nothing", "truth"


def learned(given: Judged) -> dict[str, RunningResistance]:
    """The resistance of each train that a catalogue has trips of."""
    found = fleet_resistance(given.summaries)
    return {one.train: one.resistance for kind in found for one in kind.trains}


def energy(
    problem: TrajectoryProblem, believed: Configuration, true: Configuration
) -> tuple[float, float]:
    """Work of traction [J] and lateness [s] of a true train that follows a believed one's plan."""
    plan = optimise(replace(problem, configurations=[believed]))
    line, train = problem.line, problem.train
    (scenario,) = trajectory_scenarios(
        plan, line, train, [believed.name], lambda: Follower(plan, line, train)
    )
    scenario = replace(
        scenario, mass=true.mass, rotating_mass=true.rotating_mass, resistance=true.resistance
    )
    run = drive(scenario)
    moved = dict(zip(scenario.plant().columns, run.samples.T, strict=True))
    arrival = float(run.seconds[np.flatnonzero(moved["speed"] > 0.0)[-1]]) + 0.1 - DEPARTURE
    work = float(np.sum(moved["tractive_effort"] * moved["speed"])) * 0.1
    return work, arrival - float(plan.times[0, -1])


def compared(
    line: Line, train: Train, load: float, ways: dict[str, RunningResistance], reserve: float
) -> dict[str, tuple[float, float]]:
    """Work and lateness by what is known of the train's resistance."""
    base = Configuration.of(train, load)
    true = replace(base, resistance=ways[TRUTH])
    asked = TrajectoryProblem(line, train, [true], reserve=reserve)
    least = float(fastest_run(asked).times.max())
    asked = replace(asked, running_time=(1.0 + reserve) * least)
    return {
        name: energy(asked, replace(base, resistance=known), true) for name, known in ways.items()
    }


def main() -> None:
    """The command at the top."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("catalogues", type=Path, nargs="+")
    parser.add_argument("--reserve", type=float, default=0.08)
    options = parser.parse_args()
    taught: dict[str, dict[str, RunningResistance]] = {}
    truths: dict[str, RunningResistance] = {}
    for where in options.catalogues:
        with open_catalogue(str(where)) as catalogue:
            given = Judged(options.folder, catalogue, drawn_again(options.folder), where)
            taught[where.name] = learned(given)
            for train, part in given.trips.groupby("train"):
                mean = given.truths.loc[part["key"], list(PARAMETERS)].mean()
                truths[str(train)] = RunningResistance(*mean.to_numpy(np.float64))
    rows, sums = [], defaultdict[str, list[tuple[float, float]]](list)
    for name, true in truths.items():
        log = min((options.folder / name).glob("*.mcap"))
        trip = read_log(log, topics=[])
        line, train = line_of(trip), train_of(trip)
        known = {where: found.get(name, train.resistance) for where, found in taught.items()}
        ways = {NOTHING: train.resistance, **known, TRUTH: true}
        load = 0.5 * train.max_load
        found = compared(line, train, load, ways, options.reserve)
        least = found[TRUTH][0]
        cells = [
            f"{100 * (work / least - 1):+.2f} %, {late:+.1f} s" for work, late in found.values()
        ]
        rows.append((name, f"{least / 3.6e6:.1f} kWh", *cells))
        for way, (work, late) in found.items():
            sums[way].append((work, late))
    totals = {way: np.array(each) for way, each in sums.items()}
    works = {way: float(each[:, 0].sum()) for way, each in totals.items()}
    rows.append(
        (
            "all",
            f"{works[TRUTH] / 3.6e6:.1f} kWh",
            *(
                f"{100 * (works[way] / works[TRUTH] - 1):+.2f} %, {each[:, 1].max():+.1f} s at most"
                for way, each in totals.items()
            ),
        )
    )
    printed(
        "work of traction over that of the plan that knows the truth, and lateness",
        ("train", TRUTH, *works),
        rows,
    )


if __name__ == "__main__":
    main()

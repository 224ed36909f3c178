"""What the observed set promises, judged by trips that it was not made from.

    python benchmarks/identification/benchmark_observed_set.py [--trips 80] [--held 80]

Trips over St.Gallen-Wil are drawn and simulated; a part of them is fitted, and the robust
trajectory is optimised for the observed set. The others, with their *true* mass, resistance and
power, then run by themselves as fast as they can, and follow the trajectory's traction, braking
as late as they may.
"""

from __future__ import annotations

import argparse
from time import process_time

import numpy as np

from analysis.resistance import TripFit, TripRefusedError, fit_trip, parameter_set
from analysis.trajectory.discretisation import Taper, discretise
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import TrajectoryProblem
from analysis.trajectory.rollout import cell_times, rollout
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.railway import Configuration, Line, ParameterSet, Train
from trainlog.simulation import draw_scenarios, simulate
from trainlog.units import JOULES_PER_KWH

RESERVE = 0.10
"""Of the timetable over the least time of the slowest configuration of the set."""


def fleet(
    line: Line, train: Train, count: int, fitted: int, seed: int
) -> tuple[list[TripFit], list[Configuration]]:
    """Fits of the first trips, and what is true of the others."""
    fits, true = [], []
    for number, drawn in enumerate(draw_scenarios(line, train, count, seed)):
        if number >= fitted:
            true.append(
                Configuration(
                    drawn.name, drawn.mass, drawn.rotating_mass, drawn.resistance, drawn.max_power
                )
            )
            continue
        try:
            fits.append(fit_trip(simulate(drawn)))
        except TripRefusedError as error:
            print(f"refused: {error}")
    return fits, true


def judge(line: Line, train: Train, found: ParameterSet, true: list[Configuration]) -> str:
    """One row: what the set promises, and what becomes of the others."""
    began = process_time()
    chosen = found.configurations
    trajectory = optimise(TrajectoryProblem(line, train, chosen, reserve=RESERVE))
    took = process_time() - began
    ours, others = (
        fastest_run(TrajectoryProblem(line, train, each)).times for each in (chosen, true)
    )
    run = TrajectoryProblem(line, train, true)
    even = discretise(run, trajectory.positions)
    fall = 0.5 * trajectory.tractive_effort_fall / even.reference
    problem = even.tapered(Taper(fall, np.zeros(fall.size)))
    plan = rollout(problem, trajectory.tractive_effort / problem.reference, None)
    arrival = cell_times(problem, plan).sum(axis=1)
    power = (plan.traction / problem.traction_by_power(plan.z)).max(axis=1)
    late = arrival - trajectory.running_time
    on_time, in_power = late <= 0.01, power <= 1.0 + 1e-4
    return (
        f"{len(chosen):4d} {found.cover['level']:8.1%}"
        f"{np.mean(others <= ours.max()):10.1%}{np.mean(on_time):10.1%}{np.mean(in_power):10.1%}"
        f"{np.mean(on_time & in_power):8.1%}{max(late.max(), 0.0):9.2f}"
        f"{100.0 * max(power.max() - 1.0, 0.0):9.2f}"
        f"{trajectory.certificate['energy'] / JOULES_PER_KWH:10.2f}"
        f"{trajectory.running_time:9.1f}{took:8.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trips", type=int, default=80)
    parser.add_argument("--held", type=int, default=80)
    parser.add_argument("--seed", type=int, default=7)
    arguments = parser.parse_args()
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    count = arguments.trips + arguments.held
    fits, true = fleet(line, train, count, arguments.trips, arguments.seed)
    report(line, train, fits, true)


def report(line: Line, train: Train, fits: list[TripFit], true: list[Configuration]) -> None:
    """The table, by how the set was asked for."""
    print(f"{len(fits)} trips fitted, {len(true)} others; share of the others")
    print(
        f"{'':14s}{'set':>4s}{'level':>9s}{'fastest':>10s}{'on time':>10s}{'in power':>10s}"
        f"{'both':>8s}{'late [s]':>9s}{'over [%]':>9s}{'kWh':>10s}{'time [s]':>9s}{'CPU [s]':>8s}"
    )
    for name, found in (
        ("all trips", parameter_set(fits, cover=1.0)),
        ("99 %", parameter_set(fits, cover=0.99)),
        ("95 %", parameter_set(fits)),
        ("80 %", parameter_set(fits, cover=0.80)),
        ("6 at most", parameter_set(fits, most=6)),
        ("12 trips", parameter_set(fits[:12])),
    ):
        print(f"{name:14s}{judge(line, train, found, true)}", flush=True)


if __name__ == "__main__":
    main()

"""Whether any finer plan lies below the bound that a certificate states.

    python benchmarks/trajectory/benchmark_certificate.py [--problems 24] [--first 0]
        [--fine 4000 8000] [--referee] [--limit 120] [--times TIMES] [-o runs.csv]

Random lines and trains of `benchmark_random`, with numbers that nothing else uses; every third
with three configurations, energy at the wheel and at the line in turn, reserves of 1 to 100 per
cent. Each is planned on the default cells, and then on many more, with cells as they come. A finer
plan is a trajectory like any other, driven by the audit: where its energy is below the bound that
the default plan came with, the bound was wrong. One that the time limit ends early counts, too.

With --referee IPOPT solves the cells of the default plan as one nonlinear program (CasADi),
from a start of its own. Its energy is not driven: it may be below the bound by the error of the
cells' times, as for half a kilometre.

With TIMES, the CSV of another run, the running times are taken from there: so the state of another
checkout (PYTHONPATH) answers the same questions. Times are of the processor.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_random import random_problem

from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from analysis.trajectory.referee import refereed
from trainlog.errors import TrainlogError
from trainlog.formats.files import atomic_write
from trainlog.railway import Configuration

FIRST = 50_000
"""Number of the first problem of `benchmark_random`; its own begin with 0."""

RESERVES = (0.01, 0.03, 0.07, 0.15, 0.4, 1.0)

IPOPT = "IPOPT"

ROUNDING = 1e-6
"""Relative; an audit leaves 1e-4 s."""


def question(number: int) -> TrajectoryProblem:
    """The problem of a number, without its running time."""
    found, random = random_problem(FIRST + number), np.random.default_rng([FIRST, number])
    train = found.train
    configurations: tuple[Configuration, ...] = (Configuration.of(train),)
    if number % 3 == 2:
        configurations = tuple(
            Configuration(
                f"c{each}",
                train.mass * (1.0 + random.uniform(0.0, 0.1)),
                train.rotating_mass,
                train.resistance.scaled(1.0 + random.uniform(-0.05, 0.05)),
                train.max_traction_power * (1.0 - random.uniform(0.0, 0.05)),
            )
            for each in range(3)
        )
    return replace(
        found,
        configurations=configurations,
        objective="line" if number % 2 else "wheel",
        braking="recourse",
        final_speed=0.0,
        reserve=float(random.choice(RESERVES)),
    )


def measured(
    number: int, running_time: float | None, fine: list[int], limit: float, *, referee: bool
) -> dict[str, Any]:
    """One problem: the default plan, the finer ones, and IPOPT's."""
    problem = question(number)
    row: dict[str, Any] = {
        "number": number, "km": problem.line.length / 1e3, "objective": problem.objective,
        "q": len(problem.configurations), "reserve": problem.reserve, "words": "",
    }  # fmt: skip
    try:
        least = float(fastest_run(problem).times.max())
        row["running_time"] = running_time or (1.0 + problem.reserve) * least
        problem = replace(problem, running_time=row["running_time"])
        begin = time.process_time()
        plan = optimise(problem)
        found = plan.certificate
        row["seconds"] = time.process_time() - begin
    except TrainlogError as refused:
        return row | {"words": str(refused)}
    row |= {"energy": found["energy"], "gap": found["gap"], "cells": found["grid"]["cells"]}
    row["bound"] = found["lower_bound"]
    for cells in fine:
        try:
            options = OptimiserOptions(cells, tolerance=np.inf, time_limit=limit)
            finer = optimise(problem, options).certificate
            row[f"at {cells}"] = finer["energy"]
        except TrainlogError as refused:
            row["words"] += f"{cells} cells: {refused}; "
    if referee:
        other, more = refereed(problem, plan)
        if other.solved:
            row[IPOPT] = found["energy"] / (1.0 + more)
        else:
            row["words"] += f"IPOPT: {other.status}"
    return row


def printed(row: dict[str, Any], challengers: list[str]) -> str:
    """One row of the table as text."""
    words = (
        f"{row['number']:4d} {row['km']:7.2f} km {row['objective']:5s} {row['q']:2d}"
        f" {row['reserve']:5.0%}"
    )
    if "energy" not in row:
        return f"{words}  {row['words']}"
    unit = max(abs(row["bound"]), 1.0)
    words += (
        f" {row['seconds']:6.2f} s {row['cells']:5d} cells {row['energy'] / 3.6e6:9.3f} kWh,"
        f" gap {row['gap']:.4%}; above the bound by"
    )
    for name in challengers:
        above = (row.get(name, np.nan) - row["bound"]) / unit
        words += f" {above:.4%}" + " BELOW" * (above < -ROUNDING)
    return f"{words} {row['words']}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=24)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--fine", type=int, nargs="*", default=[4000, 8000])
    parser.add_argument("--referee", action="store_true", help="IPOPT on the plan's cells, too")
    parser.add_argument("--limit", type=float, default=120.0, help="of a finer plan [s]")
    parser.add_argument("--times", type=Path)
    parser.add_argument("-o", "--output", type=Path, help="every run, as CSV")
    arguments = parser.parse_args()
    times: dict[int, float] = {}
    if arguments.times:
        with arguments.times.open(newline="") as file:
            rows = [each for each in csv.DictReader(file) if each.get("running_time")]
            times = {int(each["number"]): float(each["running_time"]) for each in rows}
    challengers = [f"at {cells}" for cells in arguments.fine] + [IPOPT] * arguments.referee
    # Compiled code is warm before anything is timed.
    optimise(replace(question(0), reserve=0.5), OptimiserOptions(60))
    runs = []
    for number in range(arguments.first, arguments.first + arguments.problems):
        asked = arguments.fine, arguments.limit
        runs.append(measured(number, times.get(number), *asked, referee=arguments.referee))
        print(printed(runs[-1], challengers), flush=True)
    below = sum(
        run.get(name, np.inf) < run["bound"] - ROUNDING * max(abs(run["bound"]), 1.0)
        for run in runs
        for name in challengers
        if "energy" in run
    )
    print(f"{sum('energy' in run for run in runs)} of {len(runs)} answered; {below} other plans"
          " below the bound")  # fmt: skip
    if arguments.output:
        names = list(dict.fromkeys(name for run in runs for name in run))
        with atomic_write(arguments.output) as path, path.open("w", newline="") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(runs)


if __name__ == "__main__":
    main()

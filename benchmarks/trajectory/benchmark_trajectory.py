"""Time and quality of robust trajectories, next to CasADi and IPOPT in the same run.

    python benchmarks/trajectory/benchmark_trajectory.py [--repeats 3] [--long]

Both solve the same cells with the same Runge-Kutta sub-steps. Ours includes grid, envelope, lower
bound, audit of every configuration and the active set; IPOPT is timed from a paced run to its
answer, program building included, and takes the configurations that the active set found. The
ratio compares processor times, which other programs on the machine disturb less.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from analysis.studies.cunillera_2022 import TRAIN as VIRM6
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from analysis.trajectory.referee import IpoptResult, refereed
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import sample
from trainlog.railway import Configuration, Line, Station, StepProfile, Train, Trajectory
from trainlog.units import JOULES_PER_KWH, KMH

LONGEST_FOR_IPOPT = 5
"""Active configurations beyond which IPOPT is not asked; it would take minutes."""

LEVEL = Line(
    name="level 48.5 km",
    length=48_531.0,
    stations=(Station("A", 0.0), Station("B", 48_531.0)),
    speed_limits=StepProfile(np.array([0.0]), np.array([140.0 / KMH])),
    gradients=StepProfile(np.array([0.0]), np.array([0.0])),
    source="TTOBench v1.5, 00_reference",
)


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    line: Line
    train: Train
    configurations: int
    cells: int
    question: dict[str, Any]

    def problem(self) -> TrajectoryProblem:
        """What is asked of the optimiser."""
        return TrajectoryProblem(self.line, self.train, self.observed(), **self.question)

    def observed(self) -> tuple[Configuration, ...]:
        """The nominal train alone, or as many as asked, drawn with a fixed seed."""
        if self.configurations == 1:
            return (Configuration.of(self.train),)
        random, train = np.random.default_rng(1), self.train
        return tuple(
            Configuration(
                f"c{number}",
                train.mass * (1.0 + random.uniform(0.0, 0.1)),
                train.rotating_mass,
                train.resistance.scaled(1.0 + random.uniform(-0.1, 0.1)),
                train.max_traction_power * (1.0 - random.uniform(0.0, 0.1)),
            )
            for number in range(self.configurations)
        )


def ours(case: Case, repeats: int) -> tuple[Trajectory, float, float]:
    """The trajectory, and the median times it took by the clock and of the processor [s]."""
    problem, options, seconds, spent = case.problem(), OptimiserOptions(case.cells), [], []
    for _ in range(repeats):
        begin, busy = time.perf_counter(), time.process_time()
        found = optimise(problem, options)
        seconds.append(time.perf_counter() - begin)
        spent.append(time.process_time() - busy)
    return found, statistics.median(seconds), statistics.median(spent)


def referee(case: Case, found: Trajectory, repeats: int) -> tuple[IpoptResult, float, float]:
    """IPOPT's answer, the median processor time [s], and how much more energy ours takes."""
    seconds = []
    for _ in range(repeats):
        begin = time.process_time()
        result, excess = refereed(case.problem(), found)
        seconds.append(time.process_time() - begin)
    return result, statistics.median(seconds), excess


def row(case: Case, repeats: int) -> str:
    """Measure one case."""
    found, seconds, spent = ours(case, repeats)
    certificate = found.certificate
    audit, solver = certificate["audit"], certificate["solver"]
    cells, active = certificate["grid"]["cells"], len(certificate["active"])
    words = [
        f"{case.line.name[:15]:15s} {case.question.get('objective', 'wheel'):6s}",
        f"{case.configurations:4d} {cells:6d} {active:6d} {solver['iterations']:4d}",
        f"{seconds:8.2f} {spent:8.2f}",
    ]
    if active <= LONGEST_FOR_IPOPT:
        result, other, difference = referee(case, found, max(1, repeats // 2))
        change = f"{difference:+9.1e}" if result.solved else f"{'failed':>9s}"
        words.append(f"{other:8.2f} {other / spent:6.1f} {change} ")
    else:
        words.append(f"{'-':>8s} {'-':>6s} {'-':>9s} ")
    words.append(
        f"{certificate['energy'] / JOULES_PER_KWH:9.3f} {100.0 * certificate['gap']:8.4f}"
        f" {audit['lateness']:+9.1e} {audit['overspeed']:+9.1e} {audit['power'] - 1.0:+9.1e}"
    )
    return " ".join(words)


def cases(long: bool) -> list[Case]:
    """What is measured."""
    line = read_line(sample("CH_StGallen_Wil.line.json"))
    flirt = read_train(sample("CH_Stadler_FLIRT_TPF.train.json"))
    timetable = {"running_time": 1541.0, "initial_speed": 1.0, "final_speed": 10.0}
    published = replace(
        VIRM6,
        max_traction_power=3_129_277.0,
        max_dynamic_braking_effort=213_900.0,
        max_dynamic_braking_power=3_129_277.0,
        max_pneumatic_braking_effort=0.0,
        max_deceleration=10.0,
        efficiency_traction=0.73,
        efficiency_regeneration=0.73,
    )
    slower = replace(
        LEVEL,
        name="level, 100 km/h",
        speed_limits=StepProfile(
            np.array([0.0, 25_000.0, 35_000.0]), np.array([140.0, 100.0, 140.0]) / KMH
        ),
    )
    found = [
        Case(LEVEL, VIRM6, 1, 500, timetable),
        Case(LEVEL, VIRM6, 1, 1000, timetable),
        Case(slower, published, 1, 500, {**timetable, "final_speed": 1.0, "objective": "line"}),
        Case(line, flirt, 1, 500, {}),
        Case(line, flirt, 1, 500, {"objective": "line"}),
        Case(line, flirt, 3, 500, {}),
        Case(line, flirt, 12, 500, {}),
        Case(line, flirt, 30, 1000, {}),
        Case(line, flirt, 500, 1000, {}),
    ]
    if long:
        found += [
            Case(line, flirt, 12, 500, {"objective": "line"}),
            Case(line, flirt, 1000, 1000, {}),
        ]
        found += [Case(LEVEL, VIRM6, 1, cells, timetable) for cells in (200, 2000, 4000)]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--long", action="store_true")
    arguments = parser.parse_args()
    measured = cases(arguments.long)
    # Compiled code and caches are warm before anything is timed.
    optimise(replace(measured[0].problem(), running_time=None), OptimiserOptions(60))
    print(
        f"{'line':15s} {'energy':6s} {'q':>4s} {'cells':>6s} {'active':>6s} {'QPs':>4s}"
        f" {'clock s':>8s} {'CPU s':>8s} {'IPOPT s':>8s} {'ratio':>6s} {'E/IPOPT':>9s}"
        f"  {'kWh':>9s} {'gap %':>8s}"
        f" {'late s':>9s} {'over m/s':>9s} {'power':>9s}"
    )
    for case in measured:
        print(row(case, arguments.repeats), flush=True)


if __name__ == "__main__":
    main()

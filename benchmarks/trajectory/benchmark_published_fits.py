"""One train as twelve published calibrations know it: the plan that all of them can follow.

    python benchmarks/trajectory/benchmark_published_fits.py [--reserve 0.1] [--cells 300]

ALTRIOS (NREL, BSD-3-Clause) calibrates the resistance of a heavy freight train on recorded trips:
drag area of a loaded car, rolling resistance over weight, resistance of an axle's bearings. Of the
twelve answers of `applications/calibration/train_sim_cal/res_df.csv` none is better in all
respects. They are an observed set: the trajectory of least energy that every one of them can
follow, beside the plan of each one alone. The file does not state the train; here it is 3
locomotives and 100 loaded cars on 60 km of gradients of up to 6 per mille (assumed).
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from trainlog.railway import (
    Configuration,
    Line,
    RunningResistance,
    Station,
    StepProfile,
    Train,
    Trajectory,
)
from trainlog.units import GRAVITY, KMH

CALIBRATIONS = (
    (1.758, 1.794e-3, 40.43), (2.748, 1.665e-3, 40.10), (1.085, 2.317e-3, 41.27),
    (1.195, 2.375e-3, 40.23), (1.520, 2.119e-3, 40.96), (2.089, 1.839e-3, 44.02),
    (1.733, 2.319e-3, 41.18), (2.785, 1.859e-3, 41.97), (1.790, 2.119e-3, 40.96),
    (1.003, 2.293e-3, 41.85), (2.835, 1.744e-3, 40.15), (1.037, 2.152e-3, 56.45),
)  # fmt: skip
"""Drag area of a loaded car [m2], rolling resistance over weight, resistance of a bearing [N]."""

CARS, CAR, LOCOMOTIVES, LOCOMOTIVE = 100, 130e3, 3, 196e3
"""How many, and their masses [kg]; cars have four axles, locomotives six. Assumed."""

AIR = 1.2
"""Density [kg/m3]."""

JOULES = 3.6e6


def train() -> Train:
    """The train with the first calibration."""
    mass = CARS * CAR + LOCOMOTIVES * LOCOMOTIVE
    return Train(
        name="heavy freight",
        mass=mass,
        rotating_mass_factor=0.03,
        resistance=resistance(*CALIBRATIONS[0]),
        max_tractive_effort=LOCOMOTIVES * 600e3,
        max_traction_power=LOCOMOTIVES * 3_200e3,
        max_dynamic_braking_effort=LOCOMOTIVES * 400e3,
        max_dynamic_braking_power=LOCOMOTIVES * 3_000e3,
        max_pneumatic_braking_effort=0.4 * mass,
        max_speed=80.0 / KMH,
        max_acceleration=0.3,
        max_deceleration=0.3,
    )


def resistance(area: float, rolling: float, bearing: float) -> RunningResistance:
    """Of the whole train."""
    mass = CARS * CAR + LOCOMOTIVES * LOCOMOTIVE
    axles = 4 * CARS + 6 * LOCOMOTIVES
    return RunningResistance(
        rolling * mass * GRAVITY + bearing * axles, 0.0, 0.5 * AIR * area * (CARS + LOCOMOTIVES)
    )


def line(seed: int = 17) -> Line:
    """60 km whose gradient changes every 1 to 4 km."""
    random = np.random.default_rng(seed)
    places = np.concatenate(([0.0], np.cumsum(random.uniform(1e3, 4e3, 40))))
    places = places[places < 58e3]
    slopes = random.uniform(-6e-3, 6e-3, places.size)
    slopes[0] = 0.0
    return Line(
        name="heavy haul",
        length=60e3,
        stations=(Station("A", 0.0), Station("B", 60e3)),
        speed_limits=StepProfile(np.array([0.0, 30e3, 34e3]), np.array([80.0, 60.0, 80.0]) / KMH),
        gradients=StepProfile(places, slopes),
    )


def energy_of(plan: Trajectory, row: int) -> float:
    """At the wheel rims, of one configuration [J]."""
    return float(
        (
            np.broadcast_to(plan.tractive_effort, plan.braking_effort.shape)[row]
            * np.diff(plan.positions)
        ).sum()
    )


def main() -> None:
    """The command at the top."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reserve", type=float, default=0.1)
    parser.add_argument("--cells", type=int, default=300)
    given = parser.parse_args()
    unit, track, options = train(), line(), OptimiserOptions(given.cells)
    every = [
        Configuration(
            f"{number}", unit.mass, unit.rotating_mass, resistance(*row), unit.max_traction_power
        )
        for number, row in enumerate(CALIBRATIONS, 1)
    ]
    began = time.process_time()
    together = optimise(TrajectoryProblem(track, unit, every, reserve=given.reserve), options)
    spent = time.process_time() - began
    seconds = together.running_time
    print(f"running time {seconds:.0f} s, gap {together.certificate['gap']:.2%}, {spent:.1f} s")
    print("calibration  R(20 km/h)  R(70 km/h)  least time  alone  together  loss")
    found = list[tuple[float, float]]()
    for row, each in enumerate(every):
        own = optimise(TrajectoryProblem(track, unit, [each], running_time=seconds), options)
        least, all_can = energy_of(own, 0) / JOULES, energy_of(together, row) / JOULES
        found.append((least, all_can))
        fastest = own.certificate["least_time"][0]
        low, high = (each.resistance(v / KMH) / 1e3 for v in (20.0, 70.0))
        print(
            f"{each.name:>11s}  {low:7.0f} kN  {high:7.0f} kN  {fastest:8.0f} s  {least:5.0f}"
            f"  {all_can:8.0f} kWh  {all_can / least - 1.0:5.2%}"
        )
    alone, shared = np.array(found).T
    print(f"spread of the least energies {alone.max() / alone.min() - 1.0:.1%}")
    print(f"worst of the common plan over the worst alone {shared.max() / alone.max() - 1.0:.2%}")


if __name__ == "__main__":
    main()

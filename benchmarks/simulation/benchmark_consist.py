"""How fast a consist is simulated, beside scipy's Runge-Kutta on the same equations.

    python benchmarks/simulation/benchmark_consist.py

CPU time, so that other programs on the machine do not count. scipy integrates one minute; its step
is adaptive, with tolerances that give about the same accuracy.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp

from trainlog.railway import RunningResistance
from trainlog.railway.train import Consist, ConsistBrake, Coupler, Vehicle
from trainlog.simulation.consist import ConsistPlant

STEP = 0.01
HOUR = 360_000
"""Steps in an hour."""

STEPS = (0.016, 0.008, 0.004, 0.002)
"""Whose order of convergence is shown [s]."""

WAGON = Vehicle(
    "wagon",
    mass=43_750.0,
    length=25.0,
    resistance=RunningResistance(261.0, 4.9, 0.084),
    max_tractive_effort=31_250.0,
    max_braking_effort=40_000.0,
)
COUPLER = Coupler(stiffness=10e6, nonlinearity=200.0, damping=200e3)


def consist(count: int) -> Consist:
    return Consist(f"{count} vehicles", (WAGON,) * count, (COUPLER,) * (count - 1))


def seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def peer(count: int, effort: float, duration: float) -> float:
    """CPU time of scipy's integrator [s]."""
    apart = -np.diff(consist(count).middles)

    def motion(_t: float, y: np.ndarray) -> np.ndarray:
        x, v = y[:count], y[count:]
        stretch = -np.diff(x) + apart
        force = COUPLER.force(stretch) - COUPLER.damping * np.diff(v)
        pull = effort / count - WAGON.resistance(v)
        pull[:-1] -= force
        pull[1:] += force
        return np.concatenate((v, pull / WAGON.inertia))

    begin = np.concatenate((-consist(count).middles, np.full(count, 1.0)))
    return seconds(
        lambda: solve_ivp(motion, (0.0, duration), begin, rtol=1e-8, atol=1e-8, max_step=0.05)
    )


def main() -> None:
    print(
        f"{'vehicles':>8s} {'1 h in':>8s} {'steps/s':>10s} {'vehicle-steps/s':>16s} {'scipy':>8s}"
    )
    for count in (1, 8, 40):
        plant = ConsistPlant(consist(count), step=STEP)
        plant.advance(plant.at(0.0, 1.0), 1e3, 0.0, 10)  # compiles
        effort = 0.5 * count * WAGON.max_tractive_effort

        def hour(plant: ConsistPlant = plant, effort: float = effort) -> None:
            plant.advance(plant.at(0.0, 1.0), effort, 0.0, HOUR)

        taken = min(seconds(hour) for _ in range(3))
        slow = peer(count, effort, 60.0) * 60.0
        print(
            f"{count:8d} {taken:7.2f} s {HOUR / taken / 1e6:8.2f} M"
            f" {count * HOUR / taken / 1e6:14.2f} M {slow / taken:6.0f} x"
        )

    print("\nstep    error of the speeds after 2 s, five vehicles")
    errors = [np.abs(speeds(step) - speeds(0.00025)).max() for step in STEPS]
    for row, (step, error) in enumerate(zip(STEPS, errors, strict=True)):
        order = "" if row == 0 else f"order {np.log2(errors[row - 1] / error):.2f}"
        print(f"{1e3 * step:4.0f} ms {error:10.2e} m/s  {order}")


def speeds(step: float) -> np.ndarray:
    """Of five vehicles of which the second begins to pull, with this step [m/s]."""
    plant = ConsistPlant(replace(consist(5), brake=ConsistBrake(0.0, 0.0)), step=step)
    state = plant.at(0.0, 10.0)
    plant.advance(state, [0.0, WAGON.max_tractive_effort, 0.0, 0.0, 0.0], 0.0, round(2.0 / step))
    return state.speeds


if __name__ == "__main__":
    main()

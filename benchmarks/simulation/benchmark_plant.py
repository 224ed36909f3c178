"""How fast the plant runs, beside SciPy's adaptive solvers on the same equations.

    python benchmarks/simulation/benchmark_plant.py [--seconds 600] [--repeats 5]

A loaded train accelerates over a line of changing gradients, without slip, so that a solver
without events can follow. Both are timed in turns in this process, by its CPU time; the figure is
the median. The end states are compared, so that the solvers are asked for no more accuracy than
the plant has. Last, whole trips with driver and sensors.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median

import numpy as np
from scipy.integrate import solve_ivp

from trainlog.railway import Line, RunningResistance, Station, StepProfile, Train
from trainlog.railway.adhesion import DRY
from trainlog.simulation import draw_scenarios, simulate
from trainlog.simulation.plant import Plant
from trainlog.units import GRAVITY

EFFORT = 60e3
MASS = 132e3


def line() -> Line:
    """Sixty kilometres with a new gradient every 600 m."""
    edges = np.arange(0.0, 60_000.0, 600.0)
    slopes = 0.006 * np.sin(edges / 2_100.0)
    return Line(
        name="waves",
        length=60_000.0,
        stations=(Station("A", 0.0), Station("B", 30_000.0), Station("C", 60_000.0)),
        speed_limits=StepProfile(np.zeros(1), np.array([44.0])),
        gradients=StepProfile(edges, slopes),
    )


def train() -> Train:
    return Train(
        name="unit",
        mass=122e3,
        rotating_mass_factor=0.1,
        resistance=RunningResistance(2_380.0, 61.0, 12.1),
        max_tractive_effort=200e3,
        max_traction_power=2.6e6,
        max_dynamic_braking_effort=200e3,
        max_dynamic_braking_power=2.6e6,
        max_pneumatic_braking_effort=1.2e6,
        length=58.6,
    )


def plant_run(seconds: float) -> tuple[np.ndarray, int]:
    """End state (position, speed, one wheel) and number of steps."""
    plant = Plant.of(line(), train(), mass=MASS)
    state = plant.at(0.0, 10.0)
    steps = round(seconds / plant.parameters.step)
    plant.advance(state, EFFORT, 0.0, steps, 20)
    return state.values[[0, 1, 3]], steps


def peer_run(seconds: float, method: str) -> np.ndarray:
    """The same with ``solve_ivp``: four equal axles, effort and power limits, gradients."""
    unit, track = train(), line()
    axles = unit.axles
    body = MASS + unit.rotating_mass - axles.count * axles.rotating_mass
    weight = GRAVITY * axles.adhesive_mass * MASS / unit.mass / axles.count
    edges, slopes = track.gradients.positions, track.gradients.values
    sines = GRAVITY * MASS * slopes / np.sqrt(1.0 + slopes**2)
    r0, r1, r2 = unit.resistance.r0, unit.resistance.r1, unit.resistance.r2
    power = unit.max_traction_power / axles.count

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        speed, wheels, lagged = y[1], y[2:6], y[6:]
        motor = np.minimum(lagged, power / np.maximum(wheels, 1e-3))
        slip = wheels - speed
        contact = (
            weight
            * np.sign(slip)
            * (DRY.c * np.exp(-DRY.a * np.abs(slip)) - DRY.d * np.exp(-DRY.b * np.abs(slip)))
        )
        along = sines[max(int(np.searchsorted(edges, y[0], side="right")) - 1, 0)]
        net = contact.sum() - (r0 + (r1 + r2 * speed) * speed) - along
        return np.concatenate(
            (
                [speed, net / body],
                (motor - contact) / axles.rotating_mass,
                (EFFORT / axles.count - lagged) / 0.1,
            )
        )

    start = np.array([0.0, 10.0, *[10.0] * axles.count, *[0.0] * axles.count])
    answer = solve_ivp(slope, (0.0, seconds), start, method=method, rtol=1e-6, atol=1e-6)
    return np.asarray(answer.y[:3, -1])


def timed(work: Callable[[], object], repeats: int) -> float:
    """Median CPU time of `work` [s]."""
    taken = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        taken.append(time.process_time() - begin)
    return median(taken)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    end, steps = plant_run(options.seconds)  # compiles
    own = timed(lambda: plant_run(options.seconds), options.repeats)
    print(f"plant: {steps / own / 1e6:.2f} M steps/s, {options.seconds / own:,.0f} x real time")
    for method in ("LSODA", "RK45", "DOP853"):
        peer_end = peer_run(options.seconds, method)
        peer = timed(lambda method=method: peer_run(options.seconds, method), options.repeats)
        difference = np.abs(peer_end - end)
        print(
            f"solve_ivp {method}: {options.seconds / peer:,.0f} x real time, {peer / own:.1f} times"
            f" slower; ends {difference[0]:.1e} m and {difference[1]:.1e} m/s apart"
        )
    scenarios = draw_scenarios(line(), train(), count=4, seed=1)
    simulate(scenarios[0])  # compiles
    for scenario in scenarios:
        begin = time.process_time()
        trip = simulate(scenario)
        taken = time.process_time() - begin
        print(f"{trip.name}: {trip.duration:.0f} s of trip, driver and sensors, in {taken:.2f} s")


if __name__ == "__main__":
    main()

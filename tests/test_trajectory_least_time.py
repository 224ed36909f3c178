"""Least times: those of closed forms, and of an integrator that shares nothing with the product."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq
from trajectory_cases import FLIRT, KMH, hilly_line, level_line, observed

from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.railway import Configuration, RunningResistance, Train

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "trajectory"))
from independent import least_time

MASS = 100e3


def train(effort: float, power: float, brake: float, brake_power: float) -> Train:
    """Efforts and powers over its mass, nothing that resists."""
    return Train(
        name="free",
        mass=MASS,
        rotating_mass_factor=0.0,
        resistance=RunningResistance(0.0, 0.0, 0.0),
        max_tractive_effort=effort * MASS,
        max_traction_power=power * MASS,
        max_dynamic_braking_effort=brake * MASS,
        max_dynamic_braking_power=brake_power * MASS,
        max_speed=100.0,
        max_acceleration=10.0,
        max_deceleration=10.0,
    )


def way_and_time(effort: float, power: float, speed: float) -> tuple[float, float]:
    """From standstill to a speed: constant effort, then constant power."""
    first = min(speed, power / effort)
    return (
        first**2 / (2.0 * effort) + (speed**3 - first**3) / (3.0 * power),
        first / effort + (speed**2 - first**2) / (2.0 * power),
    )


@pytest.mark.parametrize("length", [300.0, 3_000.0])
@pytest.mark.parametrize(("effort", "power"), [(1.0, 3.0), (0.8, 12.0), (0.2, 1.5)])
@pytest.mark.parametrize(("brake", "brake_power"), [(0.6, 1e3), (0.9, 4.0)])
def test_least_time_of_power_and_brake_alone(
    length: float, effort: float, power: float, brake: float, brake_power: float
) -> None:
    """Accelerating to one speed and braking at once, no limit and no resistance: a closed form."""
    pull, stop = (effort, power), (brake, brake_power)
    peak = brentq(
        lambda v: way_and_time(*pull, v)[0] + way_and_time(*stop, v)[0] - length, 0.1, 99.0
    )
    exact = way_and_time(*pull, peak)[1] + way_and_time(*stop, peak)[1]
    own = train(effort, power, brake, brake_power)
    run = TrajectoryProblem(level_line(length, (0, 360)), own, [Configuration.of(own)])
    assert fastest_run(run).times[0] == pytest.approx(exact, rel=2e-5)


def test_least_time_to_a_limit_and_to_another() -> None:
    """Constant effort up to 20 m/s, held, braked to 10 m/s at 800 m, and to the stop at 1 km."""
    own = train(0.5, 1e4, 0.8, 1e4)
    line = level_line(1_000.0, (0, 72), (800, 36))
    run = TrajectoryProblem(line, own, [Configuration.of(own)])
    braked = (20.0**2 - 10.0**2) / 1.6
    exact = 20.0 / 0.5 + (800.0 - 400.0 - braked) / 20.0 + 10.0 / 0.8
    exact += (200.0 - 10.0**2 / 1.6) / 10.0 + 10.0 / 0.8
    assert fastest_run(run).times[0] == pytest.approx(exact, rel=2e-5)


def test_least_time_with_gradients_bends_and_a_tunnel() -> None:
    """Against DOP853, which finds the instants at which one curve takes over from another."""
    short = replace(hilly_line(), tunnels=())
    for line in (hilly_line(), short):
        run = TrajectoryProblem(line, FLIRT, observed(FLIRT, 0.9, 1.2))
        exact = [least_time(run, each) for each in run.configurations]
        np.testing.assert_allclose(fastest_run(run).times, exact, rtol=2e-5)


def test_least_time_from_a_speed_to_a_speed() -> None:
    run = TrajectoryProblem(
        hilly_line(), FLIRT, observed(FLIRT, 1.0), initial_speed=40 / KMH, final_speed=60 / KMH
    )
    assert fastest_run(run).times[0] == pytest.approx(
        least_time(run, run.configurations[0]), rel=2e-5
    )

"""Trajectories against answers that are known from theory and from others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from trajectory_cases import FLIRT, VIRM6, drawn, hilly_line, level_line, observed, optimised, steps

from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.instructions import Phase, phases_of
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.railway import Configuration, RunningResistance, Train, Trajectory
from trainlog.units import JOULES_PER_KWH

pytestmark = pytest.mark.usefixtures("unrenewed")


@pytest.fixture(scope="module")
def reference() -> Trajectory:
    """The field's reference run: 48.5 km level, VIRM6, 1541 s, from 1 to 10 m/s, no losses."""
    return optimised(
        level_line(),
        VIRM6,
        observed(VIRM6, 1.0),
        running_time=1541.0,
        initial_speed=1.0,
        final_speed=10.0,
    )


def test_reference_run_costs_no_more_than_the_best_known(reference):
    per_mass = reference.certificate["energy"] / (1.06 * VIRM6.mass)
    assert per_mass <= 2802.9
    assert per_mass >= 2802.5, "less than every solver and the lower bound found"
    assert 0.0 <= reference.certificate["gap"] <= 5e-4
    assert reference.certificate["audit"]["end_speed"] <= 10.0 + 1e-5


def test_published_pseudospectral_solution():
    """440.141 kWh at the line, efficiency 0.73 both ways, dynamic brake only, from 1 to 1 m/s."""
    train = replace(
        VIRM6,
        max_traction_power=3_129_277.0,
        max_dynamic_braking_effort=213_900.0,
        max_dynamic_braking_power=3_129_277.0,
        max_pneumatic_braking_effort=0.0,
        max_deceleration=10.0,
        efficiency_traction=0.73,
        efficiency_regeneration=0.73,
    )
    line = level_line(48_531.0, (0.0, 140.0), (25_000.0, 100.0), (35_000.0, 140.0))
    found = optimised(
        line, train, observed(train, 1.0),
        running_time=1541.0, initial_speed=1.0, final_speed=1.0, objective="line",
    )  # fmt: skip
    energy = found.certificate["energy"] / JOULES_PER_KWH
    assert abs(energy / 440.141 - 1.0) <= 2e-4
    assert found.certificate["lower_bound"] / JOULES_PER_KWH <= 440.141


def test_cruising_speed_and_braking_speed_are_those_of_optimal_control(reference):
    """On level track: price of time ``V² R'(V)``; braking begins at ``V² R' / (R + V R')``."""
    resistance, phases = VIRM6.resistance, phases_of(reference, 0)
    cells = np.flatnonzero(phases == Phase.CRUISING)[5:-5]
    cruising = float(np.median(reference.speeds[0, cells]))
    slope = resistance.r1 + 2.0 * resistance.r2 * cruising
    price = cruising**2 * slope
    assert reference.certificate["time_price"]["x1"] == pytest.approx(price, rel=1e-3)
    first = int(np.argmax(phases >= Phase.PARTIAL_BRAKING))
    braking = price / (float(resistance(cruising)) + cruising * slope)
    assert reference.speeds[0, first] == pytest.approx(braking, rel=0.01)


def test_phases_come_in_the_order_of_the_textbook(reference):
    phases = phases_of(reference, 0)
    changes = [Phase(p) for p in phases[np.flatnonzero(np.diff(phases, prepend=-1))]]
    main = [p for p in changes if p is not Phase.PARTIAL_BRAKING]
    assert main == [
        Phase.MAXIMUM_TRACTION,
        Phase.CRUISING,
        Phase.COASTING,
        Phase.MAXIMUM_BRAKING,
    ]


def test_more_configurations_never_cost_less():
    configurations = drawn(FLIRT, 6, seed=3)
    certificates = [
        optimised(
            hilly_line(), FLIRT, configurations[:count], running_time=460.0, cells=120
        ).certificate
        for count in (1, 2, 6)
    ]
    energies = np.array([each["energy"] for each in certificates])
    bounds = np.array([each["lower_bound"] for each in certificates])
    # Equal answers differ by no more than the gap of the one for fewer.
    assert np.all(energies[1:] >= bounds[:-1])
    assert max(each["gap"] for each in certificates) < 2e-3
    assert np.all(np.diff(energies) >= -1e-4 * energies[0])
    assert energies[-1] > energies[0]


def test_the_least_time_together_is_hardly_above_that_of_the_slowest():
    """Those who can run ahead brake: at a speed below the slowest one's none takes its power."""
    line = replace(level_line(20_000.0), gradients=steps((0.0, 0.015)))
    train = replace(FLIRT, max_traction_power=0.25 * FLIRT.max_traction_power)
    runs = [Configuration.of(train, load, f"{load:g} kg") for load in (0.0, 12e3)]
    alone = fastest_run(TrajectoryProblem(line, train, runs)).times.max()
    found = optimised(line, train, runs, reserve=0.0, cells=100)
    assert alone <= found.running_time <= 1.005 * alone
    assert found.certificate["gap"] < 0.01


def test_lossless_train_gets_its_kinetic_energy_back():
    """Without resistance and losses, and with a brake that returns all, nothing is spent."""
    train: Train = replace(
        VIRM6,
        resistance=RunningResistance(0.0, 0.0, 0.0),
        max_dynamic_braking_effort=500_000.0,
        max_dynamic_braking_power=1e8,
        efficiency_traction=1.0,
        efficiency_regeneration=1.0,
    )
    found = optimised(
        level_line(10_000.0, (0.0, 100.0)), train, observed(train, 1.0),
        reserve=0.1, objective="line", cells=150,
    )  # fmt: skip
    top = 0.5 * 1.06 * train.mass * float(found.speeds.max()) ** 2
    assert abs(found.certificate["line_energy"][0]) <= 1e-4 * top


def test_traction_is_even_enough_to_be_driven():
    """No cell pulls alone between two that do not, but where full traction ends within a cell."""
    runs = [
        optimised(hilly_line(), FLIRT, observed(FLIRT, *spread), reserve=0.10, objective=objective)
        for spread in ((1.0,), (0.97, 1.0, 1.05))
        for objective in ("wheel", "line")
    ]
    for run in runs:
        effort = run.tractive_effort
        alone = effort[1:-1] - np.maximum(effort[2:], effort[:-2])
        assert np.count_nonzero(alone > 0.05 * effort.max()) <= 1

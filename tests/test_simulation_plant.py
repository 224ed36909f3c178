"""The plant obeys the laws it is made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from simulated_line import flirt, hilly_line, level_line, steps

from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN
from trainlog.errors import InputError
from trainlog.railway import Axles, Brake, EffortCurve, RunningResistance
from trainlog.simulation.dynamics import CUT, RECOVERING, protect
from trainlog.simulation.plant import Drive, Plant, PlantState
from trainlog.units import GRAVITY

NO_DRAG = RunningResistance(0.0, 0.0, 0.0)


def columns(plant: Plant, rows: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(plant.columns, rows.T, strict=True))


def rolling(plant: Plant, position: float, speed: float) -> PlantState:
    state = plant.at(position, speed)
    assert state.speed == speed
    return state


def released(plant: Plant, position: float = 0.0) -> PlantState:
    """A train at standstill whose friction brake is already off."""
    state = plant.at(position)
    state.values[2] = 0.0
    state.friction_delay[:] = 0.0
    return state


def test_gradient_curve_and_tunnel_forces():
    line, train = hilly_line(), flirt(resistance=NO_DRAG)
    plant = Plant.of(line, train, mass=140e3)
    inertia = 140e3 + train.rotating_mass
    for position in (500.0, 1_050.0, 1_500.0, 1_960.0, 2_600.0, 7_000.0, 9_000.0):
        state = rolling(plant, position, 20.0)
        plant.advance(state, 0.0, 0.0, 200, 200)
        rows = columns(plant, plant.advance(state, 0.0, 0.0, 1, 1))
        tunnel = 15.2 * rows["speed"][0] ** 2 if 2_200.0 <= position < 2_800.0 else 0.0
        force = 140e3 * float(line.track_acceleration(rows["position"][0])) + tunnel
        assert rows["acceleration"][0] == pytest.approx(-force / inertia, rel=2e-3, abs=1e-6)


def smooth_end(step: float) -> np.ndarray:
    """State after 20 s of soft traction with heavy axles, which allow coarse steps."""
    axles = Axles(count=4, adhesive_mass=64_000.0, rotating_mass=40_000.0)
    train = flirt(rotating_mass_factor=2.0, axles=axles)
    plant = Plant.of(level_line(), train, drive=Drive(motor_lag=2.0), step=step)
    state = rolling(plant, 0.0, 15.0)
    count = round(20.0 / step)
    plant.advance(state, 60e3, 0.0, count, count)
    return state.values[[0, 1, 3, 7, 11]]


def test_integration_is_of_fourth_order():
    exact = smooth_end(0.0125)
    errors = [np.abs(smooth_end(step) - exact) for step in (0.2, 0.1)]
    order = np.log2(errors[0] / errors[1])
    assert np.all(order > 3.7)
    assert np.all(order < 4.5)


def test_power_stays_within_its_limit_and_is_used():
    plant = Plant.of(level_line(), flirt(), max_power=2.4e6)
    rows = columns(plant, plant.advance(released(plant), 1e6, 0.0, 24_000, 5))
    power = sum(rows[f"wheel_effort_{axle}"] * rows[f"wheel_speed_{axle}"] for axle in range(1, 5))
    assert rows["tractive_effort"].max() <= flirt().max_tractive_effort * (1.0 + 1e-12)
    assert power.max() <= 2.4e6 * (1.0 + 1e-12)
    assert power[-1] == pytest.approx(2.4e6)


CURVE = EffortCurve(np.array([0.0, 5.0, 12.0, 25.0]), np.array([190e3, 170e3, 110e3, 60e3]))


def test_effort_stays_within_its_curve_at_every_sample():
    """The motors read it at the speed of their wheels, which is above the train's in traction."""
    train = replace(flirt(), traction_curve=CURVE, dynamic_braking_curve=CURVE)
    plant = Plant.of(level_line(), train, resistance=NO_DRAG)
    state = released(plant)
    up = columns(plant, plant.advance(state, 300e3, 0.0, 30_000, 10))
    down = columns(plant, plant.advance(state, 0.0, 100e3, 4_000, 10))
    assert up["speed"][-1] > 35.0
    for found, name in ((up, "tractive_effort"), (down, "dynamic_braking_effort")):
        wheels = np.array([found[f"wheel_speed_{axle + 1}"] for axle in range(plant.axles)])
        limit = CURVE(wheels).mean(axis=0)
        assert np.all(found[name] <= limit * (1.0 + 1e-9))
        # The lag of the drive apart, traction is all that the curve gives.
        if found is up:
            assert found[name][200:] == pytest.approx(limit[200:], rel=1e-9)
            assert np.all(found[name][200:] <= CURVE(found["speed"][200:]))


def test_friction_brake_has_dead_time_and_lag():
    """Amirhosseini et al. (2024), eq. (1): nothing for the dead time, then 1 - exp(-t/lag)."""
    train = flirt(max_dynamic_braking_effort=0.0, brake=Brake(dead_time=0.6, lag=0.4))
    plant = Plant.of(level_line(), train)
    state = rolling(plant, 0.0, 30.0)
    effort = columns(plant, plant.advance(state, 0.0, 50e3, 600, 1))["pneumatic_braking_effort"]
    time = 0.005 * np.arange(600)
    expected = np.where(time > 0.6, 50e3 * -np.expm1(-(time - 0.6) / 0.4), 0.0)
    np.testing.assert_allclose(effort, expected, atol=1.0)


def test_a_train_never_rolls_back_and_starts_when_it_can():
    train = flirt()
    plant = Plant.of(level_line(gradient=0.03), train)
    state = released(plant)
    needed = train.mass * GRAVITY * 0.03 / np.sqrt(1.0 + 0.03**2) + train.resistance.r0
    plant.advance(state, 0.98 * needed, 0.0, 2_000, 2_000)
    assert state.position == 0.0
    plant.advance(state, 1.02 * needed, 0.0, 2_000, 2_000)
    assert 0.0 < state.speed < 0.3
    plant.advance(state, 0.0, 0.0, 4_000, 4_000)
    assert state.speed == 0.0


@pytest.mark.parametrize("braking", [False, True])
@pytest.mark.parametrize(("effort", "peak"), [(110e3, 0.1), (150e3, 0.06), (200e3, 0.29)])
def test_slip_protection_catches_the_wheels(braking, effort, peak):
    train = flirt(max_traction_power=5e6, max_dynamic_braking_power=5e6)
    plant = Plant.of(level_line(), train, maximum_adhesion=steps((0.0, peak)))
    state = rolling(plant, 0.0, 20.0)
    rows = plant.advance(state, 0.0 if braking else effort, effort if braking else 0.0, 2_000, 5)
    found = columns(plant, rows)
    wheels = np.column_stack([found[f"wheel_speed_{axle + 1}"] for axle in range(plant.axles)])
    slip = wheels - found["speed"][:, None]
    size = np.abs(slip)
    assert 3.0 < size.max() < 7.0
    assert np.all(np.sign(slip[size > 1.5]) == (-1.0 if braking else 1.0))
    # Caught within two seconds each time.
    runaway = (size > 3.0).any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], runaway.astype(int), [0]))))
    assert len(edges) >= 2
    assert np.diff(edges)[::2].max() * 0.025 < 2.0
    assert found["protected_axles"].max() == 4.0


def test_the_friction_brake_uses_no_more_than_the_adhesion_of_the_trailing_axles():
    brake = Brake(dead_time=0.0, lag=0.1)
    train = flirt(resistance=NO_DRAG, max_dynamic_braking_effort=0.0, brake=brake)
    plant = Plant.of(level_line(), train, maximum_adhesion=steps((0.0, 0.05)))
    rows = columns(plant, plant.advance(rolling(plant, 0.0, 30.0), 0.0, 90e3, 1_000, 1))
    trailing = GRAVITY * (train.mass - train.axles.adhesive_mass)
    # The wheels of the powered axles are slowed by the rail.
    inertia = plant.parameters.body_inertia + plant.axles * plant.parameters.axle_inertia
    slowed = rows["acceleration"][500:]
    np.testing.assert_allclose(slowed, -0.05 * trailing / inertia, rtol=1e-3)


def test_effort_comes_back_once_the_wheel_has_come_back():
    """A wheel whose effort was cut has none while its slip is above the release."""
    plant = Plant.of(level_line(), flirt())
    state, p = plant.at(0.0, 15.0), plant.parameters
    mode, memory = np.full(plant.axles, CUT), np.zeros((3, plant.axles))
    memory[0] = 20e3
    command = np.full(plant.axles, np.nan)
    for part, expected in ((0.9 * p.slip_threshold, CUT), (1.1 * p.slip_release, CUT),
                           (0.9 * p.slip_release, RECOVERING), (0.0, RECOVERING)):  # fmt: skip
        state.values[3 : 3 + plant.axles] = 15.0 + part
        protect(state.values, 30e3, mode, memory, command, np.zeros((4, plant.axles)), p)
        assert np.all(mode == expected), part
        # Quickly up to a share of what it slipped at.
        quick = p.step * p.axle_effort * (part == 0.0)
        np.testing.assert_allclose(command, quick)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mass": -1.0}, "must be positive"),
        ({"max_power": 0.0}, "must be positive"),
        ({"step": 0.05}, "too coarse for axles of 2000 kg"),
        ({"step": -0.005}, "must be positive"),
        ({"rotating_mass": 7_000.0}, "exceed the train's 7000 kg"),
        ({"maximum_adhesion": steps((0.0, 0.3), (50.0, 0.0))}, "at km 0.050"),
        ({"axle_adhesion": np.ones(3)}, "needs 4 positive values"),
        ({"train": flirt(axles=Axles(adhesive_mass=2e5))}, "cannot rest on the powered axles"),
    ],
)
def test_impossible_trains_are_refused(arguments, message):
    train = arguments.pop("train", flirt())
    refused(InputError, message, Plant.of, level_line(), train, **arguments)


@pytest.mark.parametrize("gradient", [-0.04, 0.0, 0.03])
def test_a_holding_brake_keeps_a_train_without_friction_brake_until_it_pulls(gradient):
    """All axles driven, nothing but the dynamic brake: it rolls off unless it is held."""
    track, train = level_line(gradient=gradient), PUBLISHED_TRAIN.on_axles()
    held = Plant.of(track, train, drive=Drive(holding_speed=0.5))
    free = Plant.of(track, train)
    for plant, stays in ((held, True), (free, gradient >= 0.0)):
        state = plant.at(1_000.0)
        plant.advance(state, 0.0, 0.0, 2_000)
        assert (state.position == 1_000.0) is stays
    state = held.at(1_000.0)
    held.advance(state, 60e3, 0.0, 2_000)
    assert state.position > 1_010.0

"""The plant obeys its laws; drivers keep limits, stop where they should, and are on time."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from simulated_line import flirt, hilly_line, level_line, steps

from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN
from trainlog.errors import InfeasibleError, InputError
from trainlog.railway import Axles, Brake, EffortCurve, LineReference, RunningResistance
from trainlog.railway.motion import timetable_run
from trainlog.simulation import Run, Scenario, draw_scenarios, drive, sensors as measuring
from trainlog.simulation.drivers import Habits, Stop, TimetableDriver, plan
from trainlog.simulation.dynamics import CUT, RECOVERING, protect
from trainlog.simulation.plant import Drive, Plant, PlantState
from trainlog.simulation.rail import base_map
from trainlog.simulation.sensors import Sensors
from trainlog.units import EARTH_RADIUS, GRAVITY, NANOSECONDS

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


@pytest.mark.parametrize("powered", [0.2, 0.6, 1.0])
@pytest.mark.parametrize("dynamic", [0.0, 20e3])
def test_all_axles_brake_with_the_adhesion_of_all(powered, dynamic):
    """A train with every axle powered brakes as any other, with a dynamic brake or without."""
    train = flirt(
        resistance=NO_DRAG,
        max_dynamic_braking_effort=dynamic,
        axles=replace(flirt().axles, adhesive_mass=powered * flirt().mass),
        brake=Brake(dead_time=0.0, lag=0.1),
    )
    plant = Plant.of(level_line(), train, maximum_adhesion=steps((0.0, 0.05)))
    rows = columns(plant, plant.advance(rolling(plant, 0.0, 30.0), 0.0, 90e3, 1_000, 1))
    # The brakes slow the powered wheels, the rail all of the rest.
    slowed = -0.05 * GRAVITY * train.mass / plant.parameters.body_inertia
    np.testing.assert_allclose(rows["acceleration"][500:], slowed, rtol=1e-3)


def test_axles_that_slide_take_no_part_in_the_friction_brake():
    train = flirt(resistance=NO_DRAG, brake=Brake(dead_time=0.0, lag=0.1))
    plant = Plant.of(level_line(), train, maximum_adhesion=steps((0.0, 0.05)))
    rows = columns(plant, plant.advance(rolling(plant, 0.0, 30.0), 0.0, 180e3, 2_000, 1))
    wheels = np.column_stack([rows[f"wheel_speed_{axle + 1}"] for axle in range(plant.axles)])
    sliding = np.all(np.abs(wheels - rows["speed"][:, None]) > 3.0, axis=1)
    trailing = GRAVITY * (train.mass - train.axles.adhesive_mass)
    assert np.count_nonzero(sliding) > 20
    friction = rows["pneumatic_braking_effort"]
    np.testing.assert_allclose(friction[sliding], 0.05 * trailing, rtol=1e-3)
    assert np.all(rows["acceleration"] > -0.05 * GRAVITY)


@pytest.mark.parametrize("efforts", [None, np.full(4, -20e3)])
def test_the_friction_brake_gives_what_is_not_asked_of_the_motors(efforts):
    train = flirt(resistance=NO_DRAG, brake=Brake(dead_time=0.0, lag=0.1))
    plant = Plant.of(level_line(), train)
    state = rolling(plant, 0.0, 20.0)
    rows = columns(plant, plant.advance(state, 0.0, 90e3, 1_000, 1, efforts, most_dynamic=30e3))
    for name, share in (("dynamic", 30e3), ("pneumatic", 60e3)):
        np.testing.assert_allclose(rows[f"{name}_braking_effort"][500:], share, rtol=1e-3)


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


def test_without_a_rotating_mass_that_of_the_axles_is_part_of_the_mass():
    """As TTOBench states the subway of Beijing."""
    train = flirt(rotating_mass_factor=0.0)
    parameters = Plant.of(level_line(), train, mass=150e3).parameters
    inertia = parameters.body_inertia + train.axles.count * parameters.axle_inertia
    assert inertia == pytest.approx(150e3)
    refused(InputError, "exceed the train's 7900 kg", Plant.of, level_line(), train, mass=7_900.0)


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


def journey(line=None, adhesion: float = 0.3, **changes: object) -> Scenario:
    line = line or hilly_line()
    train = flirt()
    known: dict[str, object] = {
        "name": "journey",
        "line": line,
        "train": train,
        "direction": "forward",
        "weather": "dry",
        "mass": train.mass + 10_000.0,
        "rotating_mass": train.rotating_mass,
        "resistance": train.resistance,
        "max_power": train.max_traction_power,
        "maximum_adhesion": steps((0.0, adhesion)),
        "stops": plan(line, train, line.stations),
    }
    return Scenario(**{**known, **changes})


def columns_of(scenario: Scenario, run: Run) -> dict[str, np.ndarray]:
    return dict(zip(scenario.plant().columns, run.samples.T, strict=True))


@settings(max_examples=5)
@given(
    st.builds(
        Habits,
        lever=st.floats(0.4, 1.0),
        margin=st.floats(0.2, 1.5),
        deceleration=st.floats(0.4, 0.8),
        reaction=st.floats(0.2, 1.2),
        coasting=st.floats(0.0, 4.0),
    ),
    st.floats(0.0, 20_000.0),
)
def test_timetable_driver_keeps_limits_and_stops(habits, load):
    scenario = journey(habits=habits, mass=122_000.0 + load)
    found = columns_of(scenario, drive(scenario))
    limit = scenario.line.limits_over(scenario.train.length)(found["position"])
    assert np.max(found["speed"] - limit) <= 1.0 / 3.6
    wanted = [station.position for station in scenario.line.stations]
    stands = np.unique(found["position"][found["speed"] == 0.0])
    np.testing.assert_allclose(stands, wanted, atol=1.5)


def test_timetable_driver_waits_and_is_roughly_on_time():
    scenario = journey()
    run = drive(scenario)
    found = columns_of(scenario, run)
    for stop in scenario.stops[1:-1]:
        standing = run.seconds[
            (found["speed"] == 0.0) & (np.abs(found["position"] - stop.position) < 2.0)
        ]
        assert standing[-1] - standing[0] >= scenario.habits.dwell
        assert standing[-1] >= stop.departure - 0.2
        assert abs(standing[0] - stop.arrival) < 40.0


def test_a_train_that_cannot_climb_is_refused():
    line = replace(hilly_line(), gradients=steps((0.0, 0.0), (3_000.0, 0.06)))
    refused(InfeasibleError, "does not arrive; at km 3", drive, journey(line, adhesion=0.05))
    falling = LineReference("850", np.zeros(1), np.array([61e3]), np.array([50e3]))
    back = replace(line.reversed(), reference=falling)
    stops = plan(line, flirt(), line.stations)
    stuck = journey(back, adhesion=0.05, direction="reverse", stops=stops)
    refused(InfeasibleError, "does not arrive; at km 53", drive, stuck)


def test_running_time_of_a_level_run():
    """Constant acceleration, cruising and braking in closed form."""
    train = replace(flirt(), max_traction_power=1e9, max_tractive_effort=100e3, length=0.0)
    train = replace(train, resistance=type(train.resistance)(0.0, 0.0, 0.0))
    line = level_line(length=10_000.0, limit=25.0)
    a, b = 100e3 / (train.mass + train.rotating_mass), 0.5
    expected = 25.0 / a + 25.0 / b + (10_000.0 - 25.0**2 / (2 * a) - 25.0**2 / (2 * b)) / 25.0
    found = timetable_run(line, train, 0.0, 10_000.0, deceleration=b, lever=1.0).running_time
    assert found == pytest.approx(expected, rel=2e-3)


@given(
    starts=st.lists(st.floats(0.1, 11e3), min_size=1, max_size=6, unique=True),
    length=st.floats(0.1, 700.0),
)
def test_a_restriction_ends_where_the_rear_has_passed_it(starts, length):
    edges = [0.0, *sorted(starts)]
    speeds = [20.0 + 3.0 * (k * 7 % 5) for k in range(len(edges))]
    line = replace(level_line(length=12e3), speed_limits=steps(*zip(edges, speeds, strict=True)))
    found = line.limits_over(length)
    for front in np.linspace(1.0, 11.9e3, 37):
        if min(abs(front - np.array([*edges, *(e + length for e in edges)]))) > 1e-6:
            under = np.linspace(max(front - length, 0.0), front, 2000)
            places = np.append(under, [e for e in edges if front - length < e <= front])
            assert found(front) == line.speed_limit(places).min()


@pytest.mark.parametrize(
    ("stops", "message"),
    [
        ((Stop("A", 0.0, 0.0, 5.0),), "two stops at least"),
        ((Stop("A", 0.0, 0.0, 5.0), Stop("Z", 12e3, 500.0, 500.0)), "'Z' at km 12.000 lies"),
        ((Stop("A", 0.0, 0.0, 5.0), Stop("B", 4e3, 300.0, 200.0)), "departure is before arrival"),
        ((Stop("A", 4e3, 0.0, 5.0), Stop("B", 0.0, 300.0, 300.0)), "order of travel"),
        ((Stop("A", 0.0, 0.0, 90.0), Stop("B", 4e3, 80.0, 100.0)), "order of travel"),
    ],
)
def test_impossible_stops_are_refused(stops, message):
    refused(InputError, message, TimetableDriver, hilly_line(), flirt(), stops)


@cache
def drawn() -> tuple[Scenario, ...]:
    return tuple(draw_scenarios(hilly_line(), flirt(), count=12, seed=1))


def test_scenarios_vary_as_they_should():
    scenarios = drawn()
    assert [s.direction for s in scenarios] == ["forward", "reverse"] * 6
    assert sum(s.weather == "wet" for s in scenarios) == 6
    assert len({(s.direction, s.weather) for s in scenarios}) == 4
    loads = np.array([s.load for s in scenarios])
    assert np.all((loads >= 0.0) & (loads <= 20_000.0))
    assert np.ptp(loads) > 8_000.0
    nominal = flirt().resistance
    for name in ("r0", "r1", "r2"):
        factor = np.array([getattr(s.resistance, name) for s in scenarios]) / getattr(nominal, name)
        assert 0.03 < np.std(factor) < 0.12
        assert np.all(np.abs(factor - 1.0) <= 0.15 + 1e-12)
    assert len({len(s.stops) for s in scenarios}) > 1
    assert len({s.seed for s in scenarios}) == 12
    assert len({s.start for s in scenarios}) == 12


def test_slippery_places_stay_from_trip_to_trip():
    line = hilly_line()
    line_bins = np.arange(440) * 25.0
    for weather, base, low in (("dry", 0.325, 0.16), ("wet", 0.185, 0.13)):
        layer = base_map(line, weather, 1)
        assert np.median(layer) == pytest.approx(base, rel=0.1)
        spots = layer < low
        assert 0.02 < np.mean(spots) < 0.4
        assert np.all(layer > 0.05)
        for scenario in (s for s in drawn() if s.weather == weather):
            met = scenario.maximum_adhesion(line_bins)
            assert np.std(np.log(met / layer)) < 0.25
            assert np.mean(met[spots] < 1.2 * low) > 0.95
    assert not np.array_equal(base_map(line, "wet", 1), base_map(line, "wet", 2))


def test_bad_wishes_are_refused():
    refused(InputError, "cannot draw 0", draw_scenarios, hilly_line(), flirt(), count=0)
    bare = replace(hilly_line(), stations=())
    refused(InputError, "fewer than two stations", draw_scenarios, bare, flirt())
    train = replace(flirt(), max_dynamic_braking_effort=0.0, max_pneumatic_braking_effort=0.0)
    refused(InputError, "has no brake", draw_scenarios, hilly_line(), train, count=1)
    for rate in (5, 15, 30, 400):
        refused(InputError, f"rate {rate} Hz", Sensors, rate=rate)
    refused(InputError, "direction 'up' is unknown", replace, drawn()[0], direction="up")


COUNT = 20_000


def generator() -> np.random.Generator:
    return np.random.default_rng(11)


def on_grid(values: np.ndarray, resolution: float) -> bool:
    return bool(np.allclose(values / resolution, np.round(values / resolution), atol=1e-6))


def test_speed_noise_and_resolution():
    found = measuring.measured_speed(np.full(COUNT, 20.0), 1.0, Sensors(), generator())
    assert on_grid(found, 0.01)
    assert np.mean(found) == pytest.approx(20.0, abs=0.001)
    assert np.std(found) == pytest.approx(np.hypot(0.03, 0.01 / np.sqrt(12.0)), rel=0.03)


def test_effort_noise_is_proportional_and_quantised():
    found = measuring.measured_effort(np.full(COUNT, 80e3), Sensors(), generator())
    assert on_grid(found, 100.0)
    assert np.std(found) == pytest.approx(800.0, rel=0.03)
    assert np.all(measuring.measured_effort(np.zeros(100), Sensors(), generator()) == 0.0)


def test_wheel_diameters_err_together_and_apart():
    draws = [measuring.wheel_scales(4, Sensors(), np.random.default_rng(k)) for k in range(3_000)]
    common = np.array([draw[0] for draw in draws])
    apart = np.array([draw[1] for draw in draws]) - common[:, None]
    assert np.std(common) == pytest.approx(0.003, rel=0.05)
    assert np.std(apart) == pytest.approx(0.001, rel=0.05)
    assert abs(np.mean(common) - 1.0) < 2e-4


def test_odometry_is_set_right_at_balises():
    position = np.arange(0.0, 60_000.0, 2.5)
    found = measuring.odometry(position, 1.003, Sensors(), generator())
    error = found - position
    step = np.diff(error)
    corrections = np.flatnonzero(np.abs(step - 0.0075) > 0.05)
    spacing = np.diff(position[corrections])
    assert 40 <= len(corrections) <= 55
    assert np.all((spacing > 0.79 * 1_250.0) & (spacing < 1.21 * 1_250.0))
    after = error[corrections + 1]
    assert np.std(after) == pytest.approx(0.5, rel=0.4)
    # Between two balises it drifts by the wheel's error.
    assert np.max(np.abs(error)) < 1.21 * 1_250.0 * 0.003 + 4.0 * 0.5


def test_gnss_noise_rates_and_outages():
    line = hilly_line()
    time = 1_700_000_000 * NANOSECONDS + np.arange(36_000) * (NANOSECONDS // 10)
    position = np.linspace(0.0, 11_000.0, time.size)
    speed = np.full(time.size, 11_000.0 / 3_600.0)
    fix, motion, changes = measuring.gnss(
        line, time, position, speed, Sensors(), np.random.default_rng(5)
    )
    assert len(fix) == len(motion)
    steps = np.diff(fix.index.asi8) / NANOSECONDS
    assert np.min(steps) == pytest.approx(0.2)
    lost, found = (
        [when for when, text in changes if word in text] for word in ("lost", "found again")
    )
    assert len(lost) >= 2
    assert np.sum(steps > 0.3) == len(found)
    # In the tunnel there are no satellites.
    there = np.interp((fix.index.asi8 - time[0]).astype(float), (time - time[0]), position)
    assert not np.any((there >= 2_200.0) & (there < 2_800.0))
    latitude, longitude = line.geometry.at(there)
    north = np.radians(fix.latitude - latitude) * EARTH_RADIUS
    east = np.radians(fix.longitude - longitude) * EARTH_RADIUS
    east *= np.cos(np.radians(47.0))
    for error in (north, east):
        assert 1.8 < np.std(error) < 4.0
        # Neighbouring fixes share their error: half a minute of memory.
        assert np.corrcoef(error[1:], error[:-1])[0, 1] > 0.97
    assert np.std(motion.speed - speed[0]) == pytest.approx(0.083, rel=0.15)
    reported = np.sqrt(np.mean(fix.horizontal_accuracy**2))
    assert np.std(np.concatenate((north, east))) == pytest.approx(reported, rel=0.25)

"""A consist's run over a line: what the study shows is what the train did."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from simulated_line import level_line, steps

from analysis.studies import in_train_forces as study
from trainlog import InputError, read_consist, sample, write_consist, write_line
from trainlog.cli.main import run as command
from trainlog.railway import CurvatureProfile, RunningResistance, Tunnel
from trainlog.railway.train import Consist, ConsistBrake, Coupler, Vehicle
from trainlog.simulation.consist import ConsistPlant, ConsistState, Variation
from trainlog.units import GRAVITY

SHORT = replace(
    level_line(2_400.0),
    gradients=steps((0.0, 0.0), (600.0, 0.015), (900.0, -0.015), (1_200.0, 0.0)),
)


FREIGHT = read_consist(sample("freight_24_wagons.consist.json"))


def passenger(coaches: int = 2) -> Consist:
    whole = read_consist(sample("passenger_8_coaches.consist.json"))
    return replace(whole, vehicles=whole.vehicles[: coaches + 1], couplers=whole.couplers[:coaches])


@pytest.fixture(scope="module")
def run() -> study.ConsistRun:
    return study.run(passenger(), SHORT, speed=15.0)


def test_the_train_starts_brakes_halts_and_brakes_in_an_emergency(run):
    names = "start and run, full service braking, halt, start again, emergency braking, end"
    assert [name for _, name in run.phases] == names.split(", ")
    # It keeps the speed and gains on the descent what 4.5 m of height give at most.
    assert 14.0 < run.speeds.max() < np.sqrt(15.0**2 + 2.0 * 9.81 * 4.5)
    for name in ("halt", "end"):
        assert np.all(run.speeds[run.phase(name)][5:100] < 0.01)
    assert run.residual <= 1e-9


def test_the_couplers_carry_what_accelerates_the_vehicles_behind_them(run):
    """Newton's law for the last coach, from what is recorded alone."""
    coach = run.consist.vehicles[-1]
    calm = slice(200, 400)  # level, under traction
    acceleration = np.gradient(run.speeds[:, -1], run.time)[calm]
    needed = coach.inertia * acceleration + coach.resistance(run.speeds[calm, -1])
    np.testing.assert_allclose(run.forces[calm, -1], needed, atol=0.05 * needed.max())


def test_the_command_runs_a_file(tmp_path):
    file = tmp_path / "short.consist.json"
    write_consist(passenger(1), file)
    assert command(["show", str(file)]) == 0
    write_line(SHORT, tmp_path / "line.json")
    options = ["--line", str(tmp_path / "line.json"), "--speed", "60", "-o", str(tmp_path)]
    assert command(["study", "consist", str(file), *options]) == 0
    assert (tmp_path / "short.mcap").is_file()
    assert (tmp_path / "short.png").stat().st_size > 20_000


FRICTIONLESS = RunningResistance(0.0, 0.0, 0.0)
DRAG = RunningResistance(261.0, 4.9, 0.084)
EFFORTS = {"max_tractive_effort": 31_250.0, "max_braking_effort": 40_000.0}
WAGON = Vehicle("wagon", mass=43_750.0, length=25.0, resistance=DRAG, rotating_mass=2e3, **EFFORTS)
COUPLER = Coupler(stiffness=10e6, nonlinearity=200.0, damping=200e3)


def train(count: int = 8, coupler: Coupler = COUPLER, **changes: object) -> Consist:
    wagon = replace(WAGON, **changes)
    return Consist("train", (wagon,) * count, (coupler,) * (count - 1))


def residual(plant: ConsistPlant, state: ConsistState, before: float) -> float:
    """Energy that is unaccounted for, over all work done."""
    works = state.works
    gained = works["traction"] - sum(value for name, value in works.items() if name != "traction")
    return abs(plant.energy(state) - before - gained) / sum(abs(v) for v in works.values())


@settings(max_examples=8)
@given(
    count=st.integers(1, 10),
    nonlinearity=st.sampled_from([-20.0, 0.0, 200.0]),
    slack=st.sampled_from([0.0, 0.02]),
    demands=st.lists(
        st.tuples(st.floats(0.0, 1.0), st.booleans(), st.integers(1, 20)), min_size=3, max_size=8
    ),
)
def test_energy_is_accounted_for(count, nonlinearity, slack, demands):
    coupler = replace(COUPLER, nonlinearity=nonlinearity, slack=slack)
    hilly = replace(
        level_line(20_000.0), gradients=steps((0.0, 0.01), (400.0, -0.015), (900.0, 0.02))
    )
    # Slack makes corners in the force, which take shorter steps.
    step = 0.0005 if slack else 0.002
    plant = ConsistPlant(train(count, coupler), hilly, step=step)
    state = plant.at(300.0, 12.0)
    before = plant.energy(state)
    for share, pulls, seconds in demands:
        effort = share * 40_000.0 * count
        traction = min(effort, 31_250.0 * count) if pulls else 0.0
        plant.advance(state, traction, 0.0 if pulls else effort, round(seconds / step))
    assert residual(plant, state, before) <= 1e-9


def momentum(plant: ConsistPlant, state: ConsistState) -> float:
    """Of all vehicles with their rotating parts [kg m/s]."""
    inertia = [each.inertia for each in plant.consist.vehicles]
    return float(np.dot(inertia, state.speeds))


def test_momentum_is_kept_without_outer_forces():
    plant = ConsistPlant(train(8, resistance=FRICTIONLESS), step=0.002)
    state = plant.at(0.0, 20.0)
    state.values[8:16] += np.array([0.5, -0.3, 0.2, 0.0, -0.4, 0.3, 0.1, -0.2])
    before = momentum(plant, state)
    plant.advance(state, 0.0, 0.0, 50_000)
    assert momentum(plant, state) == pytest.approx(before, rel=1e-12)
    # The damping has brought the vehicles to a common speed.
    assert np.ptp(state.speeds) < 1e-6


def test_on_a_slope_each_coupler_carries_what_hangs_on_it():
    slope = 0.02
    climbing = replace(level_line(5_000.0), gradients=steps((0.0, slope)))
    consist = train(6, resistance=FRICTIONLESS, rotating_mass=0.0, max_tractive_effort=1e6)
    plant = ConsistPlant(consist, climbing, step=0.002)
    weight = GRAVITY * WAGON.mass * slope / np.hypot(1.0, slope)
    state = plant.at(1_000.0, 10.0)
    plant.advance(state, [6.0 * weight, 0.0, 0.0, 0.0, 0.0, 0.0], 0.0, 60_000)
    assert plant.coupler_forces(state) == pytest.approx(weight * np.arange(5, 0, -1), rel=1e-6)
    assert state.speeds == pytest.approx(10.0, abs=1e-3)


def test_the_track_acts_under_each_vehicle():
    """Only the vehicles that have passed the edge climb."""
    edge = replace(level_line(5_000.0), gradients=steps((0.0, 0.0), (1_000.0, 0.02)))
    plant = ConsistPlant(train(8, resistance=FRICTIONLESS), edge, step=0.001)
    state = plant.at(1_099.95, 10.0)  # four of eight are beyond km 1.0 on average
    before = momentum(plant, state)
    plant.advance(state, 0.0, 0.0, 10)
    pull = (before - momentum(plant, state)) / 0.01
    assert pull == pytest.approx(4 * GRAVITY * WAGON.mass * 0.02 / np.hypot(1.0, 0.02), rel=1e-6)


def test_curves_and_tunnels_resist_as_equation_6_says():
    length, radius = 800.0, 400.0
    curved = CurvatureProfile(*np.array([[0.0], [1.0 / radius], [1.0 / radius]]))
    tunnels = (Tunnel(1_000.0, length, 40.0),)
    bent = replace(level_line(5_000.0), curvatures=curved, tunnels=tunnels)
    plant = ConsistPlant(train(1, resistance=FRICTIONLESS), bent, step=0.001)
    for position, expected in ((500.0, 0.6 / radius), (1_200.0, 0.6 / radius + 1.3e-7 * length)):
        state = plant.at(position, 10.0)
        before = momentum(plant, state)
        plant.advance(state, 0.0, 0.0, 10)
        force = (before - momentum(plant, state)) / 0.01
        assert force == pytest.approx(GRAVITY * WAGON.mass * expected, rel=1e-9)


def test_the_demand_travels_along_the_train_pipe():
    """Each brake begins when the demand has come to the middle of its vehicle."""
    consist = replace(train(8), brake=ConsistBrake(0.6, 0.4, 250.0))
    plant = ConsistPlant(consist, step=0.005)
    state = plant.at(0.0, 30.0)
    begins = np.full(8, np.nan)
    for k in range(400):
        plant.advance(state, 0.0, 320_000.0, 1)
        begins[np.isnan(begins) & (state.braking_effort > 0.0)] = 0.005 * k
    np.testing.assert_allclose(begins, 0.6 + consist.middles / 250.0, atol=0.0026)
    # Meanwhile the rear runs up on the front, which brakes already.
    plant = ConsistPlant(replace(consist, brake=ConsistBrake(0.6, 0.4, 50.0)), step=0.005)
    state = plant.at(0.0, 30.0)
    plant.advance(state, 0.0, 320_000.0, 500)
    assert np.all(plant.coupler_forces(state) < -1e3)


def test_the_resistance_swings_as_named():
    vehicle = replace(WAGON, resistance=RunningResistance(10_000.0, 0.0, 0.0))
    plant = ConsistPlant(
        Consist("one", (vehicle,)), variation=Variation((0.5, 0.0, 0.0), 0.1), step=0.01
    )
    state = plant.at(0.0, 40.0)
    plant.advance(state, 0.0, 0.0, 3_000)
    lost = 10_000.0 * (30.0 + 0.5 * (1.0 - np.cos(3.0)) / 0.1) / vehicle.inertia
    assert state.speeds[0] == pytest.approx(40.0 - lost, rel=1e-10)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: replace(WAGON, mass=-1.0), "mass: -0.001 t is not positive"),
        (lambda: Coupler(0.0), "stiffness: 0 MN/m is not positive"),
        (lambda: replace(COUPLER, slack=-0.1), "slack: -100 mm is negative"),
        (lambda: Consist("x", (WAGON, WAGON)), "2 vehicles need 1 couplers, given are 0"),
        (lambda: Consist("x", ()), "at least one vehicle"),
        (lambda: ConsistPlant(train(), step=0.1), "too coarse for the couplers.*at most"),
        (lambda: ConsistPlant(train(1), step=0.0), "is not positive"),
        (lambda: ConsistPlant(train()).at(-1.0), "cannot start at km -0.001"),
        (lambda: study.run(passenger(0), SHORT, speed=15.0), "is a single particle: there are no"),
        (lambda: study.run(passenger(), SHORT, speed=0.0), "must be positive, not 0 km/h"),
        (lambda: study.run(FREIGHT, SHORT, speed=9.0), "is too short for a train of"),
        (
            lambda: replace(level_line(1_000.0), tunnels=(Tunnel(900.0, 200.0, 40.0),)),
            "tunnel at km 0.900 leaves the line",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    refused(InputError, words, make)


def test_efforts_that_a_vehicle_does_not_have_are_refused():
    plant = ConsistPlant(train(2))
    for efforts, words in (
        (([0.0, 99e3], 0.0), r"vehicle 2 .* tractive effort of 99\.0 kN.*31\.2 kN"),
        ((0.0, [1.0, 1.0, 1.0]), "3 braking efforts for 2 vehicles"),
    ):
        refused(InputError, words, plant.advance, plant.at(), *efforts, 1)


def test_a_softening_coupler_is_refused_beyond_its_validity():
    soft = replace(COUPLER, stiffness=1e6, nonlinearity=-200.0)
    assert soft.largest_stretch == pytest.approx((1.0 / np.sqrt(600.0),) * 2)
    plant = ConsistPlant(train(3, soft, max_tractive_effort=200e3), step=0.002)
    state = plant.at()
    with pytest.raises(InputError, match=r"coupler 1 .* valid to 41 mm"):
        plant.advance(state, [200e3, 0.0, 0.0], 0.0, 10_000)

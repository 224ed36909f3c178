"""Cooperative and re-adhesion control drive the simulated train, on rails that they do not know."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np
import pytest
from refusals import refused
from simulated_line import level_line

from analysis import CooperativeTraction, ReadhesionControl, with_traction
from analysis.control.traction import MAXIMA, TUNING, RailEstimator, drive_model, map_prior
from analysis.studies.zhao_2025 import runge_kutta
from trainlog.errors import InputError
from trainlog.formats.mapfile import read_map
from trainlog.formats.railway import read_line, read_train
from trainlog.railway import StepProfile, TrackConditionMap
from trainlog.railway.adhesion import creep_coefficients, polach_curve
from trainlog.simulation import (
    DriveReading,
    DriveSensors,
    Plant,
    TractionLoop,
    draw_scenarios,
    drive,
    recorded,
    simulate,
)
from trainlog.simulation.plant import PlantState

pytestmark = pytest.mark.usefixtures("remembered")

LINE = read_line("sample_logs/CH_StGallen_Wil.line.json")
TRAIN = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
MASS = 130e3


@cache
def known_map() -> TrackConditionMap:
    return read_map("sample_logs/CH_StGallen_Wil.map")


def plant(maximum=0.3, train=TRAIN, mass=MASS, characteristic=None) -> Plant:
    """On a rail of one maximum adhesion."""
    rail = StepProfile(np.zeros(1), np.array([maximum]))
    return Plant.of(LINE, train, mass=mass, maximum_adhesion=rail, characteristic=characteristic)


@dataclass(frozen=True)
class Driven:
    gained: float
    unsolved: int
    slip: np.ndarray


def driven(
    control, maximum, *, braking=False, start=12.0, seconds=15.0, layer="wet", **others
) -> Driven:
    """All effort is demanded on one rail; what the speed [m/s] at the start changes by."""
    unit, unsolved = plant(maximum, **others), []
    state, demand = unit.at(6_000.0, start), (0.0, 150e3) if braking else (200e3, 0.0)
    steps = round(seconds / unit.parameters.step)
    if control is None:
        rows = unit.advance(state, *demand, steps, 4)
    else:
        train, mass = others.get("train", TRAIN), others.get("mass", MASS)
        known = {"condition": known_map() if layer else None, "layer": layer or ""}
        made = ReadhesionControl(train)
        if control == "cooperative":
            made = CooperativeTraction(train, LINE, mass=mass, **known)
        loop = TractionLoop(made, unit, seed=1)
        rows, unsolved = loop.advance(state, demand, steps, 4), loop.unsolved
    slip = rows[:, -2 * unit.axles : -unit.axles] - rows[:, [1]]
    return Driven(abs(state.speed - start), len(unsolved), slip)


def test_on_a_dry_rail_all_controls_give_what_is_demanded():
    own = driven(None, 0.33).gained
    for control, layer in (("cooperative", "dry"), ("readhesion", "")):
        found = driven(control, 0.33, layer=layer)
        assert found.gained == pytest.approx(own, rel=0.02)
        assert found.unsolved == 0
    # Where the map has half of what the rail gives the control must first see that.
    assert driven("cooperative", 0.33, layer="wet").gained > 0.88 * own


def test_a_heavy_train_that_starts_slowly_stays_near_the_peak():
    """Little way is made: what is known of the rail must not fade with time and draw slip down."""
    mass, maximum = MASS + 260e3, 0.14
    train = replace(TRAIN, mass=TRAIN.mass + 260e3)
    found = driven("cooperative", maximum, train=train, mass=mass, start=1.0, seconds=25.0)
    weight = train.adhesive_weight(mass - train.mass)
    resistance = float(train.resistance(5.0)) + float(train.track_force(LINE, 6_100.0, mass))
    most = (min(maximum * weight, 190e3) - resistance) / (mass + train.rotating_mass) * 25.0
    assert found.unsolved == 0
    assert found.gained > 0.97 * most


@pytest.mark.parametrize("control", ["cooperative", "readhesion"])
def test_wheels_come_back_on_a_characteristic_that_no_control_knows(control):
    """Polach's curve peaks at another slip and falls with the train's speed."""
    found = driven(control, 0.13, characteristic=polach_curve("wet"))
    weight = TRAIN.adhesive_weight(MASS - TRAIN.mass)
    assert found.gained > 0.6 * 0.13 * weight / (MASS + TRAIN.rotating_mass) * 15.0
    assert np.mean(np.abs(found.slip[-500:])) < 4.0


@pytest.mark.parametrize("control", ["cooperative", "readhesion"])
def test_wheels_do_not_lock_in_braking(control):
    found, own = (
        driven(each, 0.09, braking=True, start=22.0, seconds=12.0) for each in (control, None)
    )
    # The plant's own protection lets wheels slip at 3 m/s, where such a rail happens to peak.
    assert found.gained > (0.9 if control == "cooperative" else 0.8) * own.gained
    moving = found.slip[: len(found.slip) // 2]
    assert np.mean(moving < -4.0) < 0.05


def test_without_a_map_the_rail_is_learnt():
    assert driven("cooperative", 0.12, layer=None).gained > 0.8 * driven("cooperative", 0.12).gained


def test_axles_on_a_better_rail_give_what_the_others_cannot():
    """In braking, without a map."""
    weight = TRAIN.adhesive_weight(MASS - TRAIN.mass) / 4
    rails = np.array([0.08, 0.24, 0.24, 0.08])
    total = 0.65 * float(rails.sum()) * weight
    control = CooperativeTraction(TRAIN, LINE, mass=MASS)
    model, period, rng = drive_model(TRAIN, MASS), control.period, np.random.default_rng(3)
    curves = np.array([creep_coefficients(each) for each in rails.tolist()])
    state, at_work, given = np.full(5, 25.0), np.zeros(4), []
    for k in range(round(10.0 / period)):
        seen = state + np.array([0.03, 0.01, 0.01, 0.01, 0.01]) * rng.standard_normal(5)
        efforts = at_work / model.wheel_radius
        reading = DriveReading(k * period, 6_000.0, seen[0], seen[1:], efforts, 0.0, total)
        given.append(control.efforts(reading))
        for _ in range(50):
            at_work += (given[-1] * model.wheel_radius - at_work) * (period / 50 / TUNING.lag)
            runge_kutta(state, at_work, curves, model.loads, model.constants, period / 50, 1)
    assert control.unsolved == 0
    settled = -np.array(given)[-100:]
    assert 0.25 * total > 0.08 * weight  # an even share would race two of the axles
    np.testing.assert_allclose(settled.sum(axis=1), total, rtol=0.01)
    assert np.all(settled < 1.1 * rails * weight)
    assert np.all(settled[:, [1, 2]].min(axis=1) > 1.5 * settled[:, [0, 3]].max(axis=1))
    assert np.all(np.abs(np.diff(settled, axis=0)) < 0.1 * settled.mean())


def test_a_map_moves_what_is_expected_and_what_was_learnt_with_it():
    model = drive_model(TRAIN, MASS)
    estimator = RailEstimator(model, TUNING, 0.03, 0.02)
    estimator.expect(np.full(4, np.log(0.25)), np.full(4, 0.1))
    assert estimator.estimate().maximum == pytest.approx(0.25, rel=0.05)
    a, b, c = creep_coefficients(0.12)
    for slip in np.linspace(0.1, 3.0, 80):
        adhesion = c * (np.exp(-a * slip) - np.exp(-b * slip))
        bearing = adhesion * model.loads / model.effort_per_torque
        found = estimator.update(15.0, np.full(4, 15.0 + slip), bearing)
    assert found.maximum == pytest.approx(0.12, rel=0.15)
    # Where the map is half as slippery again, so is the rail that was found.
    estimator.expect(np.full(4, np.log(0.375)), np.full(4, 0.1))
    assert estimator.estimate().maximum == pytest.approx(1.5 * found.maximum, rel=0.1)
    estimator.forget()
    assert estimator.estimate().maximum == pytest.approx(0.375, rel=0.1)


def test_what_no_map_says_is_not_taken_for_known():
    sure, vague = map_prior([np.log(0.2)] * 2, [0.05, np.inf])
    assert sure.max() > 5.0 * vague.max()
    assert MAXIMA[sure.argmax()] == pytest.approx(0.2, rel=0.05)
    refused(InputError, "no number", map_prior, [np.nan], [0.1])


def test_a_racing_wheel_loses_effort_gets_most_of_it_back_and_the_rest_slowly():
    control = ReadhesionControl(TRAIN)
    control.pause = 0.5
    effort, wheel = 40e3, np.full(4, 10.1)

    def step(slip: float, at_work: float) -> float:
        wheel[0] = 10.0 + slip
        efforts = np.array([at_work, effort, effort, effort])
        given = control.efforts(DriveReading(0.0, 0.0, 10.0, wheel, efforts, 4 * effort, 0.0))
        assert given[1:] == pytest.approx(effort)
        return float(given[0])

    assert step(0.1, effort) == effort
    slips = 0.1 + 4.0 * 0.02 * np.arange(1, 35)  # runs away with 4 m/s²
    given = [step(slip, effort) for slip in slips]
    used = effort - TRAIN.axles.rotating_mass * 4.0
    assert next(each for each in given if each < effort) == pytest.approx(0.6 * used, rel=0.25)
    assert min(given) < 0.5 * 0.6 * used  # as the wheel did not come back
    back = [step(0.1, 20e3) for _ in range(20)]
    assert back[5] == pytest.approx(0.95 / 0.6 * given[-1], rel=0.1)
    later = [step(0.1, back[5]) for _ in range(100)]
    assert back[5] < later[-1] < effort
    grown = later[-1] - later[-51]
    assert grown == pytest.approx(0.1 * TRAIN.max_tractive_effort / 4, rel=0.05)


def test_trips_are_driven_with_either_control_and_state_it():
    scenario = draw_scenarios(LINE, TRAIN, 4, seed=1)[2]
    for name in ("cooperative", "readhesion"):
        made = with_traction([scenario], name, known_map())[0].traction
        assert made().name == name
    refused(InputError, "unknown", with_traction, [scenario], "best")
    refused(
        InputError, "no layer", with_traction, [scenario], "cooperative", known_map(), layer="snow"
    )
    other = replace(scenario, line=replace(LINE, name="another"))
    refused(InputError, "another", with_traction, [other], "cooperative", known_map())


EXACT = DriveSensors(0.0, 0.0, 0.0, 0.0)


@dataclass
class Shared:
    """Shares the demand by weights; counts as unsolved what it is asked to."""

    weights: np.ndarray
    period: float = 0.02
    fails: Callable[[float], bool] = lambda _: False
    name: str = "shared"
    unsolved: int = 0
    seen: list[DriveReading] = field(default_factory=list)

    def efforts(self, reading: DriveReading) -> np.ndarray:
        self.seen.append(reading)
        self.unsolved += self.fails(reading.time)
        total = reading.tractive_effort - reading.braking_effort
        return total * self.weights / self.weights.sum()


def run(control, demands, adhesion=0.3) -> tuple[np.ndarray, Plant, PlantState]:
    unit = plant(adhesion)
    state = unit.at(500.0, 20.0)
    loop = None if control is None else TractionLoop(control, unit, EXACT)
    blocks = [
        unit.advance(state, traction, braking, steps, 20)
        if loop is None
        else loop.advance(state, (traction, braking), steps, 20)
        for traction, braking, steps in demands
    ]
    return np.concatenate(blocks), unit, state


DEMANDS = [(80e3, 0.0, 1_000), (0.0, 0.0, 300), (0.0, 90e3, 3_000)]


@pytest.mark.parametrize("period", [0.005, 0.02, 0.1, 0.15])
def test_an_even_share_drives_as_the_total_effort_does(period):
    """Without slip, in traction, coasting, dynamic and friction braking down to the stop."""
    expected, _, _ = run(None, DEMANDS)
    found, _, _ = run(Shared(np.ones(4), period=period), DEMANDS)
    if period in (0.005, 0.02, 0.1):
        np.testing.assert_array_equal(found, expected)
    else:  # decisions between two demands come late
        np.testing.assert_allclose(found[:, 1], expected[:, 1], atol=0.15)


@pytest.mark.parametrize("adhesion", [0.3, 0.09])
def test_energy_is_accounted_for_with_efforts_of_each_axle(adhesion):
    """Also where wheels spin and slide: nothing takes the effort off an axle."""
    weights = np.array([0.4, 0.3, 0.2, 0.1])
    _, unit, state = run(Shared(weights), [*DEMANDS[:1], (0.0, 90e3, 800)], adhesion)
    works, p = state.works, unit.parameters
    wheels = state.wheel_speeds
    before = 0.5 * (p.body_inertia + 4 * p.axle_inertia) * 20.0**2
    after = 0.5 * p.body_inertia * state.speed**2 + 0.5 * p.axle_inertia * float(wheels @ wheels)
    lost = sum(works[name] for name in works if name != "traction")
    assert after - before == pytest.approx(works["traction"] - lost, rel=1e-7, abs=1.0)
    assert (works["slip"] > 0.5e6) == (adhesion < 0.1)


def test_friction_makes_up_for_what_the_motors_do_not_brake():
    found, unit, _ = run(Shared(np.array([1.0, 0.0, 0.0, 0.0])), [(0.0, 120e3, 600)])
    # What the only motor will give after the friction brake's dead time and lag is counted on.
    assert 0.0 < found[-1, 4] <= unit.parameters.axle_braking_effort
    assert found[-1, 5] > 0.5 * 120e3
    assert found[-1, 4] + found[-1, 5] == pytest.approx(120e3, rel=0.06)


def test_no_motor_and_no_demand_is_exceeded_and_none_works_against_the_demand():
    unit = plant()
    state = unit.at(500.0, 20.0)
    rows = unit.advance(state, 40e3, 0.0, 400, 20, np.array([1e9, 1e9, -5e3, 1e3]))
    efforts = rows[-1, -4:]
    assert efforts.sum() == pytest.approx(40e3, rel=1e-6)
    assert efforts.min() >= 0.0
    assert efforts.max() <= unit.parameters.axle_effort


def test_what_the_drive_measures_has_the_noise_of_its_sensors_and_repeats_with_the_seed():
    unit = plant()
    seen = {}
    for seed in (1, 1, 2):
        control = Shared(np.ones(4))
        loop = TractionLoop(control, unit, DriveSensors(position_error=20.0), seed=seed)
        state = unit.at(500.0, 20.0)
        loop.advance(state, (20e3, 0.0), 2_000, 20)
        speeds = np.array([each.speed for each in control.seen])
        again = seen.setdefault(seed, speeds)
        np.testing.assert_array_equal(again, speeds)
        assert np.std(np.diff(speeds, 2)) == pytest.approx(0.03 * 6**0.5, rel=0.2)
        assert control.seen[0].position != 500.0
    assert not np.array_equal(seen[1], seen[2])


def test_a_simulated_trip_states_its_traction_control_and_what_it_did_not_solve():
    rail = StepProfile(np.zeros(1), np.array([0.35]))
    short = level_line(length=2_000.0, limit=20.0)
    scenario = replace(draw_scenarios(short, TRAIN, 1)[0], maximum_adhesion=rail)
    plain = drive(scenario)
    control = partial(Shared, np.ones(4), fails=lambda time: 50.0 <= time < 51.0 or time == 60.0)
    driven = replace(scenario, traction=control)
    trip = simulate(driven)
    assert trip.metadata["traction_control"] == "shared"
    assert trip.metadata["traction_unsolved"] == "51"
    assert int(trip.metadata["traction_decisions"]) > 5_000
    events = trip["/events"]
    texts = events.message[events.message.str.contains("traction control")].tolist()
    assert texts == [
        "traction control unsolved, 50 decisions",
        "traction control unsolved, 1 decisions",
    ]
    # On a dry rail an even share is what the plant does by itself.
    truth = trip["/truth"]["speed"].to_numpy()
    np.testing.assert_allclose(truth, plain.samples[:, 1], atol=1e-9)
    assert "traction_control" not in recorded(scenario, plain).metadata


def test_efforts_that_no_plant_can_give_and_periods_that_none_resolves_are_refused():
    unit = plant()
    for efforts in (np.ones(3), np.array([1.0, np.nan, 1.0, 1.0]), np.full((4, 1), 1.0)):
        refused(InputError, "finite", unit.advance, unit.at(), 1e4, 0.0, 1, 1, efforts)
    for period in (0.0, 0.001, 0.0125):
        refused(InputError, "period", TractionLoop, Shared(np.ones(4), period=period), unit)

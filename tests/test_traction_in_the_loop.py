"""Cooperative and re-adhesion control drive the simulated train, on rails that they do not know."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from refusals import refused

from analysis.control.rail_estimate import MAXIMA, RailEstimator, map_prior
from analysis.control.traction import (
    TUNING,
    CooperativeTraction,
    ReadhesionControl,
    drive_model,
    with_traction,
)
from analysis.studies.zhao_2025.simulation import runge_kutta
from trainlog.errors import InputError
from trainlog.formats.mapfile import read_map
from trainlog.formats.railway import read_line, read_train
from trainlog.railway import StepProfile, TrackConditionMap, Train
from trainlog.railway.adhesion import AdhesionCharacteristic, creep_coefficients, polach_curve
from trainlog.simulation import DriveReading, Plant, TractionLoop, draw_scenarios

pytestmark = pytest.mark.usefixtures("remembered")

LINE = read_line("sample_logs/CH_StGallen_Wil.line.json")
TRAIN = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
MASS = 130e3


@cache
def known_map() -> TrackConditionMap:
    return read_map("sample_logs/CH_StGallen_Wil.map")


@dataclass(frozen=True)
class Driven:
    gained: float
    creep: float
    unsolved: int
    slip: np.ndarray


def driven(
    control: str | None,
    maximum: float,
    *,
    braking: bool = False,
    characteristic: AdhesionCharacteristic | None = None,
    train: Train = TRAIN,
    seconds: float = 15.0,
    layer: str | None = "wet",
    mass: float = MASS,
    start: float | None = None,
) -> Driven:
    """All effort is demanded at 12 m/s on one rail; what the speed changes by."""
    rail = StepProfile(np.zeros(1), np.array([maximum]))
    unit = Plant.of(LINE, train, mass=mass, maximum_adhesion=rail, characteristic=characteristic)
    if start is None:
        start = 22.0 if braking else 12.0
    state = unit.at(6_000.0, start)
    demand = (0.0, 150e3) if braking else (200e3, 0.0)
    steps = round(seconds / unit.parameters.step)
    if control is None:
        rows = unit.advance(state, *demand, steps, 4)
        unsolved = 0
    else:
        made = (
            CooperativeTraction(
                train, LINE, condition=known_map() if layer else None, layer=layer or "", mass=mass
            )
            if control == "cooperative"
            else ReadhesionControl(train)
        )
        loop = TractionLoop(made, unit, seed=1)
        rows = loop.advance(state, demand, steps, 4)
        unsolved = len(loop.unsolved)
    n = unit.axles
    slip = rows[:, -2 * n : -n] - rows[:, [1]]
    return Driven(abs(state.speed - start), state.works["slip"], unsolved, slip)


def test_on_a_dry_rail_all_controls_give_what_is_demanded() -> None:
    own = driven(None, 0.33).gained
    for control, layer in (("cooperative", "dry"), ("readhesion", "")):
        found = driven(control, 0.33, layer=layer)
        assert found.gained == pytest.approx(own, rel=0.02)
        assert found.unsolved == 0
    # Where the map has half of what the rail gives the control must first see that.
    assert driven("cooperative", 0.33, layer="wet").gained > 0.88 * own


@pytest.mark.parametrize(
    "maximum", [0.10, *(pytest.param(each, marks=pytest.mark.long) for each in (0.14, 0.18))]
)
def test_on_a_slippery_rail_the_cooperative_control_pulls_as_much_as_the_rail_gives(
    maximum: float,
) -> None:
    """The map has .17 to .19 there: one rail is as the map has it, two are much worse."""
    found = driven("cooperative", maximum)
    weight = TRAIN.adhesive_weight(MASS - TRAIN.mass)
    inertia = MASS + TRAIN.rotating_mass
    resistance = float(TRAIN.resistance(15.0)) + float(TRAIN.track_force(LINE, 6_100.0, MASS))
    most = min(maximum * weight, 190e3) - resistance
    assert found.gained > 0.9 * most / inertia * 15.0
    assert found.unsolved == 0


@pytest.mark.parametrize("maximum", [0.14, pytest.param(0.17, marks=pytest.mark.long)])
def test_a_heavy_train_that_starts_slowly_stays_near_the_peak(maximum: float) -> None:
    """Little way is made: what is known of the rail must not fade with time and draw slip down."""
    mass = MASS + 260e3
    train = replace(TRAIN, mass=TRAIN.mass + 260e3)
    found = driven("cooperative", maximum, train=train, mass=mass, start=1.0, seconds=25.0)
    weight = train.adhesive_weight(mass - train.mass)
    resistance = float(train.resistance(5.0)) + float(train.track_force(LINE, 6_100.0, mass))
    most = (min(maximum * weight, 190e3) - resistance) / (mass + train.rotating_mass) * 25.0
    assert found.unsolved == 0
    assert found.gained > 0.97 * most


@pytest.mark.parametrize("control", ["cooperative", "readhesion"])
@pytest.mark.parametrize("condition", [pytest.param("dry", marks=pytest.mark.long), "wet"])
def test_wheels_come_back_on_a_characteristic_that_no_control_knows(
    control: str, condition: str
) -> None:
    """Polach's curve peaks at another slip and falls with the train's speed."""
    found = driven(control, 0.13, characteristic=polach_curve(condition))
    weight = TRAIN.adhesive_weight(MASS - TRAIN.mass)
    assert found.gained > 0.6 * 0.13 * weight / (MASS + TRAIN.rotating_mass) * 15.0
    assert np.mean(np.abs(found.slip[-500:])) < 4.0


@pytest.mark.parametrize("control", ["cooperative", "readhesion"])
def test_wheels_do_not_lock_in_braking(control: str) -> None:
    found = driven(control, 0.09, braking=True, seconds=12.0)
    own = driven(None, 0.09, braking=True, seconds=12.0)
    # The plant's own protection lets wheels slip at 3 m/s, where such a rail happens to peak.
    assert found.gained > (0.9 if control == "cooperative" else 0.8) * own.gained
    moving = found.slip[: len(found.slip) // 2]
    assert np.mean(moving < -4.0) < 0.05


def test_without_a_map_the_rail_is_learnt() -> None:
    assert driven("cooperative", 0.12, layer=None).gained > 0.8 * driven("cooperative", 0.12).gained


def shared(
    rails: list[float], total: float, direction: float, layer: str | None = None
) -> np.ndarray:
    """Efforts [N] of axles on rails of their own, by decision; None: without a map."""
    control = CooperativeTraction(
        TRAIN, LINE, condition=known_map() if layer else None, layer=layer or "", mass=MASS
    )
    model, period, rng = drive_model(TRAIN, MASS), control.period, np.random.default_rng(3)
    curves = np.array([creep_coefficients(each) for each in rails])
    state = np.full(5, 12.0 if direction > 0.0 else 25.0)
    at_work, given = np.zeros(4), []
    demand = (total, 0.0) if direction > 0.0 else (0.0, total)
    for k in range(round(10.0 / period)):
        noise = np.array([0.03, 0.01, 0.01, 0.01, 0.01]) * rng.standard_normal(5)
        seen = state + noise
        reading = DriveReading(
            k * period, 6_000.0, seen[0], seen[1:], at_work / model.wheel_radius, *demand
        )
        given.append(control.efforts(reading))
        for _ in range(50):
            at_work += (given[-1] * model.wheel_radius - at_work) * (period / 50 / TUNING.lag)
            runge_kutta(state, at_work, curves, model.loads, model.constants, period / 50, 1)
    assert control.unsolved == 0
    return direction * np.array(given)


@pytest.mark.parametrize("direction", [pytest.param(1.0, marks=pytest.mark.long), -1.0])
def test_axles_on_a_better_rail_give_what_the_others_cannot(direction: float) -> None:
    weight = TRAIN.adhesive_weight(MASS - TRAIN.mass) / 4
    rails = np.array([0.08, 0.24, 0.24, 0.08])
    total = 0.65 * float(rails.sum()) * weight
    settled = shared(rails.tolist(), total, direction)[-100:]
    assert 0.25 * total > 0.08 * weight  # an even share would race two of the axles
    np.testing.assert_allclose(settled.sum(axis=1), total, rtol=0.01)
    assert np.all(settled < 1.1 * rails * weight)
    assert np.all(settled[:, [1, 2]].min(axis=1) > 1.5 * settled[:, [0, 3]].max(axis=1))
    assert np.all(np.abs(np.diff(settled, axis=0)) < 0.1 * settled.mean())


def test_a_map_moves_what_is_expected_and_what_was_learnt_with_it() -> None:
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


def test_what_no_map_says_is_not_taken_for_known() -> None:
    sure, vague = map_prior([np.log(0.2)] * 2, [0.05, np.inf])
    assert sure.max() > 5.0 * vague.max()
    assert MAXIMA[sure.argmax()] == pytest.approx(0.2, rel=0.05)
    refused(InputError, "no number", map_prior, [np.nan], [0.1])


def test_a_racing_wheel_loses_effort_gets_most_of_it_back_and_the_rest_slowly() -> None:
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


def test_trips_are_driven_with_either_control_and_state_it() -> None:
    scenario = draw_scenarios(LINE, TRAIN, 4, seed=1)[2]
    for name in ("cooperative", "readhesion"):
        made = with_traction([scenario], name, known_map())[0].traction
        assert made is not None
        assert made().name == name
    refused(InputError, "unknown", with_traction, [scenario], "best")
    refused(
        InputError, "no layer", with_traction, [scenario], "cooperative", known_map(), layer="snow"
    )
    other = replace(scenario, line=replace(LINE, name="another"))
    refused(InputError, "another", with_traction, [other], "cooperative", known_map())

"""A traction control gives each axle its effort; the plant does what it is given, and accounts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from refusals import refused

from trainlog.errors import InputError
from trainlog.formats.railway import read_line, read_train
from trainlog.railway import StepProfile
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

LINE = read_line("sample_logs/CH_StGallen_Wil.line.json")
TRAIN = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
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


def plant(adhesion: float = 0.3) -> Plant:
    rail = StepProfile(np.zeros(1), np.array([adhesion]))
    return Plant.of(LINE, TRAIN, mass=130e3, maximum_adhesion=rail)


def run(
    control: Shared | None, demands: list[tuple[float, float, int]], adhesion: float = 0.3
) -> tuple[np.ndarray, Plant, object]:
    unit = plant(adhesion)
    state = unit.at(500.0, 20.0)
    loop = None if control is None else TractionLoop(control, unit, EXACT)
    blocks = []
    for traction, braking, steps in demands:
        if loop is None:
            blocks.append(unit.advance(state, traction, braking, steps, 20))
        else:
            blocks.append(loop.advance(state, (traction, braking), steps, 20))
    return np.concatenate(blocks), unit, state


DEMANDS = [(80e3, 0.0, 1_000), (0.0, 0.0, 300), (0.0, 90e3, 3_000)]


@pytest.mark.parametrize("period", [0.005, 0.02, 0.1, 0.15])
def test_an_even_share_drives_as_the_total_effort_does(period: float) -> None:
    """Without slip, in traction, coasting, dynamic and friction braking down to the stop."""
    expected, _, _ = run(None, DEMANDS)
    found, _, _ = run(Shared(np.ones(4), period=period), DEMANDS)
    if period in (0.005, 0.02, 0.1):
        np.testing.assert_array_equal(found, expected)
    else:  # decisions between two demands come late
        np.testing.assert_allclose(found[:, 1], expected[:, 1], atol=0.15)


def test_each_axle_gives_what_it_is_given_and_the_train_moves_as_by_their_sum() -> None:
    weights = np.array([0.5, 0.3, 0.2, 0.0])
    demand = [(40e3, 0.0, 1_000)]
    even, unit, _ = run(Shared(np.ones(4)), demand)
    found, _, _ = run(Shared(weights), demand)
    efforts = found[-1, -unit.axles :]
    np.testing.assert_allclose(efforts, [20e3, 12e3, 8e3, 0.0], rtol=1e-6, atol=1.0)
    assert found[-1, 1] == pytest.approx(even[-1, 1], abs=0.02)
    wheels = found[-1, -2 * unit.axles : -unit.axles] - found[-1, 1]
    assert np.all(np.diff(wheels) < 0.0)


@pytest.mark.parametrize("adhesion", [0.3, 0.09])
def test_energy_is_accounted_for_with_efforts_of_each_axle(adhesion: float) -> None:
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


def test_friction_makes_up_for_what_the_motors_do_not_brake() -> None:
    found, unit, _ = run(Shared(np.array([1.0, 0.0, 0.0, 0.0])), [(0.0, 120e3, 600)])
    # What the only motor will give after the friction brake's dead time and lag is counted on.
    assert 0.0 < found[-1, 4] <= unit.parameters.axle_braking_effort
    assert found[-1, 5] > 0.5 * 120e3
    assert found[-1, 4] + found[-1, 5] == pytest.approx(120e3, rel=0.06)


def test_no_motor_and_no_demand_is_exceeded_and_none_works_against_the_demand() -> None:
    unit = plant()
    state = unit.at(500.0, 20.0)
    rows = unit.advance(state, 40e3, 0.0, 400, 20, np.array([1e9, 1e9, -5e3, 1e3]))
    efforts = rows[-1, -4:]
    assert efforts.sum() == pytest.approx(40e3, rel=1e-6)
    assert efforts.min() >= 0.0
    assert efforts.max() <= unit.parameters.axle_effort


def test_what_the_drive_measures_has_the_noise_of_its_sensors_and_repeats_with_the_seed() -> None:
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


def test_a_simulated_trip_states_its_traction_control_and_what_it_did_not_solve() -> None:
    rail = StepProfile(np.zeros(1), np.array([0.35]))
    scenario = replace(draw_scenarios(LINE, TRAIN, 1)[0], maximum_adhesion=rail)
    plain = drive(scenario)
    failing = partial_shared(lambda time: 100.0 <= time < 101.0 or time == 200.0)
    driven = replace(scenario, traction=failing)
    trip = simulate(driven)
    assert trip.metadata["traction_control"] == "shared"
    assert trip.metadata["traction_unsolved"] == "51"
    assert int(trip.metadata["traction_decisions"]) > 50_000
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


def partial_shared(fails: Callable[[float], bool]) -> Callable[[], Shared]:
    return lambda: Shared(np.ones(4), fails=fails)


@pytest.mark.parametrize(
    "efforts", [np.ones(3), np.array([1.0, np.nan, 1.0, 1.0]), np.full((4, 1), 1.0)]
)
def test_efforts_that_no_plant_can_give_are_refused(efforts: np.ndarray) -> None:
    unit = plant()
    refused(InputError, "finite", unit.advance, unit.at(), 1e4, 0.0, 1, 1, efforts)


@pytest.mark.parametrize("period", [0.0, 0.001, 0.0125])
def test_a_period_that_the_plant_does_not_resolve_is_refused(period: float) -> None:
    refused(InputError, "period", TractionLoop, Shared(np.ones(4), period=period), plant())

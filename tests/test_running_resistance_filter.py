"""The filter of running resistance and mass: filterpy's numbers, honest bands, refusals."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from resistance_trips import RESISTANCE, TRAIN, constant_speed, recording

from analysis.resistance.recording import Recording
from estimators.running_resistance import RunningResistanceFilter
from estimators.running_resistance_recursion import UNIT_SPEED, UNKNOWN_SPEED
from trainlog.errors import InputError
from trainlog.railway import RunningResistance
from trainlog.units import GRAVITY

Array = NDArray[np.float64]

MASS = 130e3
SPEEDS = np.linspace(10.0, 33.0, 50)
POWERS = SPEEDS[:, None] ** np.arange(3)


def new(
    resistance: RunningResistance = RESISTANCE, mass: float = MASS, **changes: float
) -> RunningResistanceFilter:
    known: dict[str, float] = {"rotating_mass": TRAIN.rotating_mass, "speed_std": 0.03}
    return RunningResistanceFilter(
        mass, 0.1 * mass, resistance, speeds=(10.0, 33.0), **{**known, **changes}
    )


def learn(estimator: RunningResistanceFilter, trip: Recording, part: slice = slice(None)) -> None:
    estimator.update(*columns(trip, part))


def columns(trip: Recording, part: slice = slice(None)) -> tuple[Array, ...]:
    names = ("time", "speed", "effort", "track", "track_slope", "section", "usable")
    return tuple(np.asarray(getattr(trip, name)[part]) for name in names)


def rough(seed: int, **changes: object) -> Recording:
    """A trip on a map that is wrong: another offset on every 500 m."""
    trip = recording(noise=0.03, seed=seed, **changes)  # type: ignore[arg-type]
    wrong = 0.5e-3 * GRAVITY * np.random.default_rng(seed + 1000).standard_normal(200)
    return replace(trip, effort=trip.effort + MASS * wrong[trip.section])


class Peer(ExtendedKalmanFilter):  # type: ignore[misc]
    """The same equations for filterpy, with a dense covariance."""

    def __init__(self, estimator: RunningResistanceFilter) -> None:
        super().__init__(6, 1)
        self.x, self.P = estimator.x[:, None], estimator.P
        self.R = np.array([[0.03**2]])

    def move(self, step: float, effort: float) -> None:
        share, ratio = effort / MASS, TRAIN.rotating_mass / MASS
        x = self.x[:, 0]

        def acceleration(speed: float) -> float:
            s = speed / UNIT_SPEED
            given = x[2] * share - x[1] - x[3] - x[4] * s - x[5] * s**2
            return float(given / (1.0 + ratio * x[2]))

        half = x[0] + 0.5 * step * acceleration(x[0])
        a, s = acceleration(half), half / UNIT_SPEED
        weight = step / (1.0 + ratio * x[2])
        slope = np.array([0.0, -1.0, share - ratio * a, -1.0, -s, -(s**2)])
        slope[0] = -(x[4] + 2.0 * x[5] * s) / UNIT_SPEED
        self.F = np.eye(6)
        self.F[0] += weight * slope
        self.moved = x[0] + step * a
        self.Q = np.zeros((6, 6))
        self.Q[0, 0] = 1e-6 * step
        self.predict()

    def predict_x(self, u: float = 0) -> None:
        self.x[0, 0] = self.moved

    def new_offset(self, variance: float) -> None:
        self.x[1] = self.P[1] = self.P[:, 1] = 0.0
        self.P[1, 1] = variance


def test_the_compiled_block_gives_filterpys_numbers() -> None:
    trip = rough(1, duration=300.0)
    estimator = new(RESISTANCE.scaled(1.5), MASS)
    peer = Peer(estimator)
    learn(estimator, trip)
    for k in range(trip.time.size):
        if k > 0:
            if trip.section[k] != trip.section[k - 1]:
                peer.new_offset((0.5e-3 * GRAVITY) ** 2)
            step = trip.time[k] - trip.time[k - 1]
            if trip.usable[k] and trip.usable[k - 1]:
                peer.move(step, 0.5 * (trip.effort[k] + trip.effort[k - 1]))
            else:
                peer.P[0, 0] += UNKNOWN_SPEED**2
        peer.update(trip.speed[k], lambda _: np.eye(1, 6), lambda x: x[:1])
    std = np.sqrt(np.diag(peer.P))
    np.testing.assert_allclose(estimator.x, peer.x[:, 0], atol=1e-7 * std.max(), rtol=1e-7)
    np.testing.assert_allclose(
        estimator.P / np.outer(std, std), peer.P / np.outer(std, std), atol=1e-6
    )


def test_exact_data_give_the_exact_curve_and_mass() -> None:
    """On a perfect map without noise nothing is left but the tiny noise it must allow for."""
    estimator = new(RESISTANCE.scaled(2.0), 1.1 * MASS, speed_std=1e-4, gradient_std=1e-7)
    learn(estimator, recording(mass=MASS))
    found = estimator.result()
    assert found.valid
    assert found.estimate[3] == pytest.approx(MASS, rel=1e-3)
    np.testing.assert_allclose(POWERS @ found.estimate[:3], RESISTANCE(SPEEDS), rtol=3e-3)


def test_the_band_holds_the_truth_as_often_as_it_says() -> None:
    """Priors drawn as wide as they claim, maps wrong as they claim."""
    inside, errors = [], []
    for seed in range(40):
        draw = 1.0 + 0.5 * np.random.default_rng(seed).standard_normal(4)
        prior = [RESISTANCE.r0 * draw[0], RESISTANCE.r1 * draw[1], RESISTANCE.r2 * draw[2]]
        estimator = RunningResistanceFilter(
            MASS * (1.0 + 0.1 * (draw[3] - 1.0)),
            0.05 * MASS,
            RunningResistance(*prior),
            0.5 * np.array([RESISTANCE.r0, RESISTANCE.r1, RESISTANCE.r2]),
            speeds=(10.0, 33.0),
            rotating_mass=TRAIN.rotating_mass,
        )
        learn(estimator, rough(seed))
        found = estimator.result()
        std = np.sqrt(np.einsum("ni,ij,nj->n", POWERS, found.covariance[:3, :3], POWERS))
        error = POWERS @ found.estimate[:3] - RESISTANCE(SPEEDS)
        inside.append(np.abs(error) < 1.96 * std)
        errors.append(np.abs(found.estimate[3] - MASS) / np.sqrt(found.covariance[3, 3]))
    assert 0.88 < np.mean(inside) <= 1.0
    assert np.mean(np.array(errors) < 1.96) > 0.85
    assert np.max(errors) < 4.0


def test_constant_speed_is_never_valid_and_varied_speed_is() -> None:
    held, varied = new(), new()
    learn(held, recording(constant_speed, noise=0.03, duration=3000.0))
    learn(varied, rough(3))
    assert not held.result().valid
    assert held.result().curve_share > 0.2
    assert varied.result().valid
    assert held.result().excitation < varied.result().excitation
    assert not new().result().valid
    assert new().result().excitation == pytest.approx(0.0, abs=1e-12)


def test_efforts_that_are_not_known_teach_nothing() -> None:
    """What is recorded as effort under a mask does not matter at all."""
    trip = rough(4, duration=600.0)
    braked = (trip.time > 200.0) & (trip.time < 300.0)
    masked = replace(trip, usable=~braked)
    absurd = replace(masked, effort=np.where(braked, 1e9, trip.effort))
    results = []
    for each in (masked, absurd):
        estimator = new()
        learn(estimator, each)
        results.append(estimator.result())
    np.testing.assert_array_equal(results[0].estimate, results[1].estimate)


def test_a_burst_of_wrong_speeds_is_left_out_and_a_jump_does_not_lock_it_out() -> None:
    trip = rough(5)
    clean = new()
    learn(clean, trip)
    burst = trip.speed.copy()
    burst[6000:6005] += 8.0
    # The motion itself jumps: after some samples the filter follows.
    jump = replace(trip, speed=np.where(trip.time > 900.0, trip.speed + 1.0, burst))
    estimator = new()
    learn(estimator, jump)
    found, reference = estimator.result(), clean.result()
    assert 5 <= found.left_out <= 40
    assert found.speed == pytest.approx(jump.speed[-1], abs=0.2)
    curve, other = (POWERS @ each.estimate[:3] for each in (found, reference))
    std = np.sqrt(np.einsum("ni,ij,nj->n", POWERS, reference.covariance[:3, :3], POWERS))
    assert np.all(np.abs(curve - other) < 2.0 * std)


@settings(max_examples=20, deadline=None)
@given(cut=st.integers(1, 2998), other=st.integers(1, 2998))
def test_blocks_and_saved_states_change_nothing(cut: int, other: int) -> None:
    trip = rough(6, duration=300.0)
    whole = new()
    learn(whole, trip)
    parts = new()
    for part in np.split(np.arange(trip.time.size), sorted({cut, other})):
        learn(parts, trip, slice(part[0], part[-1] + 1))
        parts = RunningResistanceFilter.resume(json.loads(json.dumps(parts.state())))
    assert parts.state() == whole.state()
    np.testing.assert_array_equal(parts.result().covariance, whole.result().covariance)
    learn(parts, replace(trip, time=trip.time + 400.0), slice(0, 50))
    learn(whole, replace(trip, time=trip.time + 400.0), slice(0, 50))
    assert parts.state() == whole.state()


@pytest.mark.parametrize("effort", [0.0, 20e3])
def test_a_million_samples_of_nothing_new_keep_the_covariance_positive(effort: float) -> None:
    count = 1_000_000
    estimator = new(speed_std=1e-3)
    nothing = np.zeros(count)
    section = (np.arange(count) // 137).astype(np.float64)
    speed = 30.0 + 1e-3 * np.random.default_rng(7).standard_normal(count)
    estimator.update(0.1 * np.arange(count), speed, nothing + effort, nothing, nothing, section)
    assert np.all(np.linalg.eigvalsh(_scaled(estimator.P)) > 0.0)
    assert np.all(np.isfinite(estimator.x))


def _scaled(covariance: Array) -> Array:
    std = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(std, std))


def test_what_is_recorded_on_the_way_ends_with_the_result() -> None:
    trip = rough(8, duration=600.0)
    estimator, other = new(), new()
    track = estimator.record(*columns(trip))
    learn(other, trip)
    assert estimator.state() == other.state()
    found = estimator.result()
    np.testing.assert_allclose(track.estimate[-1], found.estimate, rtol=1e-12)
    np.testing.assert_allclose(track.resistance[-1], found.resistance(found.speed), rtol=1e-12)
    assert track.grade_offset[-1] == pytest.approx(found.grade_offset)
    powers = found.speed ** np.arange(3)
    std = np.sqrt(powers @ found.covariance[:3, :3] @ powers)
    assert track.resistance_std[-1] == pytest.approx(std, rel=1e-9)
    used = track.innovation[100:] / track.innovation_std[100:]
    assert 0.9 < np.sqrt(np.mean(used**2)) < 1.1


def test_reset_returns_to_the_beginning() -> None:
    estimator = new()
    learn(estimator, rough(9, duration=200.0))
    estimator.reset()
    np.testing.assert_array_equal(estimator.x, new().x)
    np.testing.assert_array_equal(estimator.P, new().P)
    assert (estimator.result().samples, estimator.result().resets) == (0, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": 0.0}, "mass 0"),
        ({"speed_std": -1.0}, "speed_std"),
        ({"gradient_std": np.nan}, "gradient_std"),
        ({"resistance": RunningResistance(1.0, 0.0, 1.0)}, "must be positive"),
        ({"resistance_std": [1.0, 1.0]}, "of r0, r1 and r2 each"),
        ({"speeds": (30.0, 10.0)}, "no range"),
    ],
)
def test_wrong_parameters_are_refused(change: dict[str, object], message: str) -> None:
    known: dict[str, object] = {
        "mass": MASS, "mass_std": 0.1 * MASS, "resistance": RESISTANCE, "speeds": (10.0, 33.0),
    }  # fmt: skip
    with pytest.raises(InputError, match=message):
        RunningResistanceFilter(**{**known, **change})  # type: ignore[arg-type]


def test_wrong_samples_are_refused() -> None:
    estimator = new()
    with pytest.raises(InputError, match="does not fit 3 times"):
        estimator.update([0.0, 0.1, 0.2], [1.0, 2.0], 0.0, 0.0)
    with pytest.raises(InputError, match="time must increase"):
        estimator.update([0.0, 0.2, 0.2], 1.0, 0.0, 0.0)
    with pytest.raises(InputError, match="not known where it is called usable"):
        estimator.update([0.0, 0.2], 1.0, [0.0, np.nan], 0.0)
    estimator.update(1.0, 1.0, np.nan, 0.0, usable=False)
    with pytest.raises(InputError, match="time must increase"):
        estimator.update(0.9, 1.0, 0.0, 0.0)
    with pytest.raises(InputError, match="needs 'trainlog/running-resistance'"):
        RunningResistanceFilter.resume({"format": "other", "version": 1})

"""The train's state online: filterpy's numbers, slip, outages, honest deviations, resuming."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimators.kalman import GRADIENT_STD, STATES
from estimators.train_state import Measurement, TrainStateFilter
from estimators.train_state_recursion import PATIENCE
from trainlog.errors import InputError
from trainlog.units import GRAVITY

Array = NDArray[np.float64]

AXLES = 4


@dataclass
class Run:
    """A run between two stations and what was measured of it, 10 Hz."""

    time: Array
    position: Array
    speed: Array
    acceleration: Array
    offset: Array
    measured: dict[str, Array]

    def z(self, estimator: TrainStateFilter, **changes: Array | float) -> Array:
        return estimator.measurements(self.time, **{**self.measured, **changes})


def run(seed: int = 0, duration: float = 400.0) -> Run:
    time = np.arange(0.0, duration, 0.1)
    acceleration = np.interp(
        time, [0, 20, 22, 60, 64, 250, 252, 290, 292, 400], [0, 0, 0.8, 0.3, 0, 0, -0.7, -0.7, 0, 0]
    )
    gained = 0.5 * (acceleration[1:] + acceleration[:-1]) * np.diff(time)
    speed = np.maximum(np.concatenate(([0.0], np.cumsum(gained))), 0.0)
    position = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))))
    rng = np.random.default_rng(seed)

    def noise(std: float, *shape: int) -> Array:
        return std * rng.standard_normal((time.size, *shape))

    offset = (GRADIENT_STD * rng.standard_normal(50))[(position // 800.0).astype(int)]
    lasting = np.empty(time.size)
    lasting[0] = noise(1.0)[0]
    for k, white in enumerate(noise(1.0)[1:]):
        lasting[k + 1] = np.exp(-0.1 / 30.0) * lasting[k] + np.sqrt(-np.expm1(-0.2 / 30.0)) * white
    felt = acceleration + GRAVITY * offset
    diameter = 1.0 + 0.01 * rng.standard_normal()
    return Run(
        time, position, speed, acceleration, offset,
        {
            "position": position + 2.5 * lasting + noise(0.5),
            "speed": np.abs(speed + noise(0.1)),
            "expected_acceleration": np.where(speed > 1.0, felt + noise(0.03), np.nan),
            "wheel_speed": np.where(speed > 0.0, diameter * speed + noise(0.03, AXLES).T, 0.0).T,
        },
    )  # fmt: skip


def test_predict_and_update_give_filterpys_numbers_and_so_does_a_block() -> None:
    trip = run(1, 120.0)
    single, block = TrainStateFilter(AXLES), TrainStateFilter(AXLES)
    z = trip.z(single)
    peer = KalmanFilter(dim_x=STATES, dim_z=z.shape[1])
    peer.x, peer.P = single.x[:, None], single.P
    for k in range(trip.time.size):
        if k > 0:
            single.predict(0.1)
            peer.F, peer.Q = single.F, single.Q
            peer.predict()
        single.update(z[k])
        known = ~np.isnan(single.z)
        peer.dim_z = int(known.sum())
        peer.update(single.z[known][:, None], R=single.R[np.ix_(known, known)], H=single.H[known])
        std = np.sqrt(np.diag(peer.P))
        np.testing.assert_allclose(single.x / std, peer.x[:, 0] / std, atol=1e-6)
        np.testing.assert_allclose(
            single.P / np.outer(std, std), peer.P / np.outer(std, std), atol=1e-7
        )
    assert single.result().left_out.sum() == 0
    means, covariances, means_p, covariances_p = block.batch_filter(z, trip.time)
    np.testing.assert_allclose(means[-1], single.x, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(covariances[-1], single.P, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(means_p[-1], peer.x_prior[:, 0], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(covariances_p[-1], peer.P_prior, rtol=1e-5, atol=1e-9)


def test_the_smoother_gives_filterpys_numbers() -> None:
    trip = run(2, 60.0)
    single = TrainStateFilter(AXLES)
    z = trip.z(single, position=trip.measured["position"])
    smooth = TrainStateFilter(AXLES).smooth(z, trip.time)
    filled = {name: [] for name in "zFQHR"}  # type: dict[str, list[Array]]
    for k in range(trip.time.size):
        if k > 0:
            single.predict(0.1)
        single.update(z[k])
        missing = np.isnan(single.z)
        noise = single.R.copy()
        noise[missing, missing] = 1e15
        for name, value in (
            ("z", np.nan_to_num(single.z)[:, None]), ("F", single.F), ("Q", single.Q),
            ("H", single.H), ("R", noise),
        ):  # fmt: skip
            filled[name].append(value)
    peer = KalmanFilter(dim_x=STATES, dim_z=z.shape[1])
    fresh = TrainStateFilter(AXLES)
    peer.x, peer.P = fresh.x[:, None], fresh.P
    found = peer.batch_filter(
        filled["z"], Fs=filled["F"], Qs=filled["Q"], Hs=filled["H"], Rs=filled["R"]
    )
    mean, covariance, _, _ = peer.rts_smoother(found[0], found[1], filled["F"], filled["Q"])
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(smooth.means / std, mean[:, :, 0] / std, atol=2e-3)
    np.testing.assert_allclose(np.sqrt(np.diagonal(smooth.covariances, axis1=1, axis2=2)), std,
                               rtol=2e-3)  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"position": np.nan, "speed": np.nan},
        {"wheel_speed": np.nan},
        {"expected_acceleration": np.nan},
    ],
)
def test_deviations_are_honest_whatever_is_measured(changes: dict[str, float]) -> None:
    """From everything down to wheels or satellites alone."""
    inside, tight = [], []
    for seed in range(8):
        trip = run(seed)
        estimator = TrainStateFilter(AXLES, position=0.0, position_std=1.0)
        states = estimator.update(trip.z(estimator, **changes), trip.time)
        truth = np.column_stack([trip.position, trip.speed, trip.acceleration, trip.offset])
        inside.append(np.abs(states.means[50:, :4] - truth[50:]) < 1.96 * states.std[50:])
        tight.append(states.std[50:, 1])
    covered = np.mean(inside, axis=(0, 1))
    assert np.all(covered[:3] > 0.85), covered
    assert np.median(tight) < 0.6


def test_a_minute_without_satellites_is_bridged_and_the_deviation_grows() -> None:
    errors, stds = [], []
    for seed in range(8):
        trip = run(seed)
        lost = (trip.time > 130.0) & (trip.time < 190.0)
        gone = {name: np.where(lost, np.nan, trip.measured[name]) for name in ("position", "speed")}
        estimator = TrainStateFilter(AXLES)
        states = estimator.update(trip.z(estimator, **gone), trip.time)
        last = np.flatnonzero(lost)[-1]
        errors.append(states.means[last, :2] - [trip.position[last], trip.speed[last]])
        stds.append(states.std[last, :2])
        assert np.all(states.std[last, :2] > states.std[np.flatnonzero(lost)[0] - 1, :2])
    normalised = np.array(errors) / np.array(stds)
    assert np.abs(normalised).max() < 3.5
    assert np.abs(np.array(errors)[:, 0]).max() < 30.0


def slipping(trip: Run, axles: list[int], start: float, sign: float) -> Array:
    """Wheel speeds in which some axles run up (or lock) over two seconds and come back."""
    wheels = trip.measured["wheel_speed"].copy()
    extra = np.interp(trip.time, [start, start + 1.5, start + 5.0, start + 6.0], [0, 4.0, 4.0, 0])
    wheels[:, axles] = np.maximum(wheels[:, axles] + sign * extra[:, None], 0.0)
    return wheels


@pytest.mark.parametrize("axles", [[0], [0, 1], [0, 1, 2, 3]])
@pytest.mark.parametrize(("start", "sign"), [(30.0, 1.0), (260.0, -1.0)])
@pytest.mark.parametrize("satellites", [True, False])
def test_slipping_axles_are_left_out_and_taken_back(
    axles: list[int], start: float, sign: float, satellites: bool
) -> None:
    """In traction and in braking; one axle, half of them, all together."""
    trip = run(3)
    away = {} if satellites else {"position": np.nan, "speed": np.nan}
    estimator = TrainStateFilter(AXLES, position=0.0, position_std=1.0)
    wheels = slipping(trip, axles, start, sign)
    states = estimator.update(trip.z(estimator, wheel_speed=wheels, **away), trip.time)
    during = (trip.time > start + 1.5) & (trip.time < start + 5.0)
    assert states.slipping[during][:, axles].all()
    others = [i for i in range(AXLES) if i not in axles]
    assert not states.slipping[:, others].any()
    error = np.abs(states.means[:, 1] - trip.speed)
    assert error[during].max() < (0.5 if satellites else 1.5)
    assert np.all(error[during] < 4.0 * states.std[during, 1])
    assert not states.slipping[trip.time > start + 15.0].any()
    assert estimator.result().left_out[4:][axles].min() > 30


def test_without_slip_nothing_is_left_out() -> None:
    for seed in range(5):
        trip = run(seed)
        estimator = TrainStateFilter(AXLES)
        states = estimator.update(trip.z(estimator), trip.time)
        assert not states.slipping.any()
        assert estimator.result().left_out[4:].sum() < 5


@pytest.mark.parametrize("what", ["speed", "position"])
def test_a_filter_that_went_wrong_finds_back(what: str) -> None:
    """Speeds, or chainages, jump for good: after the patience they are believed."""
    trip = run(4)
    late = trip.time > 120.0
    estimator = TrainStateFilter(AXLES)
    if what == "speed":
        wheels = trip.measured["wheel_speed"] + 12.0 * late[:, None]
        z = trip.z(estimator, position=np.nan, speed=np.nan, wheel_speed=wheels)
    else:
        z = trip.z(estimator, position=trip.measured["position"] + 500.0 * late)
    states = estimator.update(z, trip.time)
    soon = np.searchsorted(trip.time, 120.0 + PATIENCE + 10.0)
    error = states.means[:, :2] - np.column_stack([trip.position, trip.speed])
    if what == "speed":
        assert abs(error[soon, 1] - 12.0) < 1.5
    else:
        assert abs(error[soon, 0] - 500.0) < 10.0
    assert estimator.result().resets >= 1


def test_the_gradient_offset_is_told_by_efforts_or_accelerometer_and_refused_without() -> None:
    trip = run(5, 240.0)
    errors = {}
    for name, changes in {
        "effort": {},
        "accelerometer": {
            "expected_acceleration": np.nan,
            "specific_force": trip.acceleration + GRAVITY * trip.offset + 0.02,
        },
        "neither": {"expected_acceleration": np.nan},
    }.items():
        estimator = TrainStateFilter(AXLES, Measurement(specific_force=0.02))
        found = estimator.smooth(trip.z(estimator, **changes), trip.time)
        errors[name] = (found.gradient_offset - trip.offset)[trip.speed > 5.0]
        assert np.isnan(estimator.result().estimate[3]) == (name == "neither")
        if name == "neither":
            assert any("gradient offset" in why for why in estimator.result().reasons)
    assert np.isnan(errors["neither"]).all()
    for name in ("effort", "accelerometer"):
        assert np.mean(np.isfinite(errors[name])) > 0.3, name
        assert np.nanstd(errors[name]) < 0.7 * GRADIENT_STD, name


def test_what_was_not_measured_is_not_told() -> None:
    estimator = TrainStateFilter(2)
    nothing = estimator.result()
    assert np.isnan(nothing.estimate).all()
    assert not nothing.valid
    assert len(nothing.reasons) == 3
    time = np.arange(0.0, 10.0, 0.1)
    estimator.update(estimator.measurements(time, speed=20.0), time)
    found = estimator.result()
    assert found.valid
    assert np.isnan(found.estimate[0])
    assert found.estimate[1] == pytest.approx(20.0, abs=0.1)
    assert found.excitation > nothing.excitation == 0.0
    estimator.update(estimator.measurements(11.0 + time), 11.0 + time)
    assert not estimator.result().valid


@settings(max_examples=15, deadline=None)
@given(cut=st.integers(1, 1199), other=st.integers(1, 1199))
def test_blocks_and_saved_states_change_nothing(cut: int, other: int) -> None:
    trip = run(6, 120.0)
    whole, parts = TrainStateFilter(AXLES), TrainStateFilter(AXLES)
    z = trip.z(whole, wheel_speed=slipping(trip, [0, 2], 40.0, 1.0))
    whole.update(z, trip.time)
    for part in np.split(np.arange(trip.time.size), sorted({cut, other})):
        parts.update(z[part], trip.time[part])
        parts = TrainStateFilter.resume(json.loads(json.dumps(parts.state(), allow_nan=True)))
    assert parts.state() == whole.state()
    assert parts.result().left_out.sum() > 0


def test_a_million_samples_keep_the_covariance_positive() -> None:
    rng = np.random.default_rng(8)
    estimator = TrainStateFilter(2, Measurement(wheel=1e-3, speed=1e-3))
    for block in range(20):
        time = 0.1 * np.arange(50_000 * block, 50_000 * (block + 1))
        speed = 30.0 + 1e-3 * rng.standard_normal((time.size, 3))
        z = estimator.measurements(
            time, speed=speed[:, 0], wheel_speed=speed[:, 1:], expected_acceleration=0.0
        )
        estimator.update(z, time)
    std = np.sqrt(np.diag(estimator.P))
    assert np.all(np.linalg.eigvalsh(estimator.P / np.outer(std, std)) > 0.0)
    assert estimator.result().estimate[1] == pytest.approx(30.0, abs=0.01)


def test_reset_returns_to_the_beginning() -> None:
    trip = run(7, 60.0)
    estimator = TrainStateFilter(AXLES)
    estimator.update(trip.z(estimator), trip.time)
    estimator.reset()
    np.testing.assert_array_equal(estimator.P, TrainStateFilter(AXLES).P)
    assert (estimator.result().samples, estimator.result().resets) == (0, 1)
    estimator.update(trip.z(estimator), trip.time)


def test_bad_input_is_refused() -> None:
    estimator = TrainStateFilter(2)
    sample = estimator.measurements([0.0, 1.0], speed=1.0)
    with pytest.raises(InputError, match="holds 6 measurements"):
        estimator.update(np.zeros((2, 3)), [0.0, 1.0])
    with pytest.raises(InputError, match="needs the time of each"):
        estimator.update(sample)
    with pytest.raises(InputError, match="time must increase"):
        estimator.update(sample, [1.0, 1.0])
    with pytest.raises(InputError, match="2 finite times"):
        estimator.update(sample, [1.0, np.nan])
    with pytest.raises(InputError, match="variance is not positive"):
        estimator.update(sample, [0.0, 1.0], np.zeros(6))
    with pytest.raises(InputError, match="do not fit"):
        estimator.update(sample, [0.0, 1.0], np.ones(5))
    with pytest.raises(InputError, match="do not fit 2 times and 2 axles"):
        estimator.measurements([0.0, 1.0], wheel_speed=np.ones((2, 3)))
    with pytest.raises(InputError, match="positive standard deviations"):
        TrainStateFilter(2, Measurement(speed=0.0))
    with pytest.raises(InputError, match="cannot predict"):
        estimator.predict(-1.0)
    with pytest.raises(InputError, match="needs 'trainlog/train-state'"):
        TrainStateFilter.resume({"format": "trainlog/rls", "version": 1})
    assert estimator.update(np.empty((0, 6)), []).means.shape == (0, STATES)

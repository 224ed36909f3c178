"""Smoothing: exact cases, outages, honest deviations, the process noise against van Loan."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.common import van_loan_discretization
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimators.motion import ACCELERATION_STD, ACCELERATION_TIME, _singer, smooth_motion
from trainlog.errors import InputError

Array = NDArray[np.float64]


def run(duration: float = 400.0, step: float = 0.2) -> tuple[Array, Array, Array, Array]:
    """A run between two stations: time, position, speed, acceleration."""
    time = np.arange(0.0, duration, step)
    acceleration = np.interp(
        time,
        [0, 20, 22, 60, 64, 250, 252, 290, 292, 400],
        [0, 0, 0.8, 0.3, 0.0, 0.0, -0.7, -0.7, 0.0, 0.0],
    )
    speed = np.concatenate(
        ([0.0], np.cumsum(0.5 * (acceleration[1:] + acceleration[:-1]) * np.diff(time)))
    )
    position = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))))
    return time, position, speed, acceleration


@settings(max_examples=30, deadline=None)
@given(step=st.floats(0.02, 10.0))
def test_process_noise_is_van_loans(step: float) -> None:
    rate = 1.0 / ACCELERATION_TIME
    drift = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -rate]])
    drive = np.array([[0.0], [0.0], [np.sqrt(2.0 * rate) * ACCELERATION_STD]])
    transition, noise = _singer(np.array([step]))
    expected_transition, expected_noise = van_loan_discretization(drift, drive, step)
    np.testing.assert_allclose(transition[0], expected_transition, rtol=1e-9, atol=1e-9)
    scale = np.sqrt(np.diag(noise[0]))
    # The reference itself loses digits at short steps: relative to its largest entry.
    tolerance = 1e-5 + 1e-15 / scale.min() ** 2
    np.testing.assert_allclose(
        noise[0] / np.outer(scale, scale),
        expected_noise / np.outer(scale, scale),
        rtol=1e-5,
        atol=tolerance,
    )


def test_constant_speed_without_noise_is_exact() -> None:
    time = np.arange(0.0, 50.0, 0.1)
    motion = smooth_motion(time, np.full(time.size, 20.0), 1e-3, 100.0 + 20.0 * time, 1e-2)
    np.testing.assert_allclose(motion.speed, 20.0, atol=1e-6)
    np.testing.assert_allclose(motion.position, 100.0 + 20.0 * time, atol=1e-5)
    np.testing.assert_allclose(motion.acceleration, 0.0, atol=1e-4)


def test_smoothing_beats_the_measurement_and_the_deviations_are_honest() -> None:
    time, position, speed, acceleration = run()
    rng = np.random.default_rng(1)
    inside, errors = [], []
    for _ in range(5):
        motion = smooth_motion(time, speed + 0.1 * rng.standard_normal(time.size), 0.1)
        errors.append(motion.speed - speed)
        inside.append(np.abs(motion.speed - speed) <= 1.96 * motion.speed_std)
        assert np.abs(motion.position - position).max() < 4.0 * motion.position_std.max()
        assert np.sqrt(np.mean((motion.acceleration - acceleration) ** 2)) < 0.1
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert np.mean(inside) >= 0.93


def test_outage_is_bridged_and_the_deviation_says_so() -> None:
    time, position, speed, _ = run()
    rng = np.random.default_rng(2)
    measured = speed + 0.1 * rng.standard_normal(time.size)
    fix = position + 2.0 * rng.standard_normal(time.size)
    lost = (time > 120.0) & (time < 150.0)
    measured[lost] = np.nan
    fix[lost] = np.nan
    motion = smooth_motion(time, measured, 0.1, fix, 2.0)
    middle = np.abs(time - 135.0) < 1.0
    assert motion.speed_std[middle].min() > 5.0 * motion.speed_std[time < 100.0].mean()
    assert np.all(np.abs(motion.speed - speed) < 4.0 * motion.speed_std)
    assert np.all(np.abs(motion.position - position) < 4.0 * motion.position_std)
    assert np.abs(motion.speed - speed)[lost].max() < 1.0


def test_samples_without_measurement_change_nothing() -> None:
    """Asking at more times is not knowing more."""
    time, _, speed, _ = run(100.0, 1.0)
    coarse = smooth_motion(time, speed, 0.1)
    fine_time = np.arange(0.0, 99.01, 0.5)
    fine_speed = np.full(fine_time.size, np.nan)
    fine_speed[::2] = speed
    fine = smooth_motion(fine_time, fine_speed, 0.1)
    np.testing.assert_allclose(fine.speed[::2], coarse.speed, atol=1e-6)
    np.testing.assert_allclose(fine.acceleration_std[::2], coarse.acceleration_std, rtol=1e-6)


def test_time_reversed_motion_is_smoothed_alike() -> None:
    """The smoother looks both ways: a trip run backwards has the same speeds."""
    time, _, speed, _ = run(200.0, 0.5)
    measured = speed + 0.1 * np.random.default_rng(3).standard_normal(time.size)
    forward = smooth_motion(time, measured, 0.1)
    backward = smooth_motion(time, measured[::-1], 0.1)
    np.testing.assert_allclose(forward.speed, backward.speed[::-1], atol=1e-3)
    np.testing.assert_allclose(
        forward.acceleration[5:-5], -backward.acceleration[::-1][5:-5], atol=5e-3
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": [0.0, 1.0, 1.0]}, "does not increase"),
        ({"time": [0.0, 1.0, np.nan]}, "finite times"),
        ({"time": [0.0], "speed": [1.0]}, "at least two"),
        ({"speed": [1.0, 2.0]}, "must fit 3 times"),
        ({"speed": [np.nan] * 3}, "neither"),
        ({"speed_std": 0.0}, "must be positive"),
        ({"speed_std": [1.0, np.nan, 1.0]}, "must be positive"),
        ({"position": [0.0, 1.0, 2.0]}, "belong together"),
    ],
)
def test_bad_input_is_refused(change: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {
        "time": [0.0, 1.0, 2.0],
        "speed": [1.0, 1.0, 1.0],
        "speed_std": 0.1,
    }
    with pytest.raises(InputError, match=message):
        smooth_motion(**(arguments | change))  # type: ignore[arg-type]


def test_deviation_is_not_asked_for_where_nothing_was_measured() -> None:
    motion = smooth_motion([0.0, 1.0, 2.0], [1.0, np.nan, 1.0], [0.1, np.nan, 0.1])
    np.testing.assert_allclose(motion.speed[1], 1.0, atol=0.05)

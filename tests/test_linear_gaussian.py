"""The one linear-Gaussian filter and smoother: filterpy's numbers, known answers, gates, series."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings, strategies as st

from estimators.linear_gaussian import LinearGaussian, corrected, random_walk_slope
from estimators.motion import LastingError, smooth_motion
from trainlog.arrays import FloatArray


def drawn(seed: int, count: int = 40, rank: int = 3, channels: int = 2) -> tuple[FloatArray, ...]:
    """A stable model with steps of its own, known inputs, measurements, some missing."""
    rng = np.random.default_rng(seed)
    transition = np.eye(rank) + 0.2 * rng.standard_normal((count, rank, rank))
    transition /= 1.0 + np.abs(np.linalg.eigvals(transition)).max()
    roots = 0.3 * rng.standard_normal((count, rank, rank))
    noise = roots @ roots.transpose(0, 2, 1)
    observation = rng.standard_normal((count, channels, rank))
    shift = rng.standard_normal((count, 1, rank))
    measured = rng.standard_normal((count, channels))
    measured[rng.uniform(size=measured.shape) < 0.3] = np.nan
    variances = rng.uniform(0.1, 2.0, measured.shape)
    return transition, noise, observation, shift, measured, variances


def by_filterpy(
    drawn: tuple[FloatArray, ...], mean: FloatArray, covariance: FloatArray
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Filtered and smoothed means and covariances of the same model."""
    transition, noise, observation, shift, measured, variances = drawn
    peer = KalmanFilter(dim_x=mean.size, dim_z=1)
    peer.x, peer.P = mean.copy(), covariance.copy()
    means, covariances = np.empty((len(measured), mean.size)), np.empty((len(measured), 3, 3))
    for k, row in enumerate(measured):
        peer.predict(u=1.0, B=shift[k, 0], F=transition[k], Q=noise[k])
        for i in np.flatnonzero(~np.isnan(row)):
            peer.update(row[i], R=variances[k, i], H=observation[k, i : i + 1])
        means[k], covariances[k] = peer.x, peer.P
    # Its smoother has no inputs: Rauch, Tung and Striebel's step with the input in the prediction.
    smooth, spread = means.copy(), covariances.copy()
    for k in range(len(measured) - 2, -1, -1):
        ahead = transition[k + 1] @ means[k] + shift[k + 1, 0]
        predicted = transition[k + 1] @ covariances[k] @ transition[k + 1].T + noise[k + 1]
        gain = covariances[k] @ transition[k + 1].T @ np.linalg.inv(predicted)
        smooth[k] += gain @ (smooth[k + 1] - ahead)
        spread[k] += gain @ (spread[k + 1] - predicted) @ gain.T
    return (means, covariances), (smooth, spread)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_filter_and_smoother_give_filterpys_and_rauch_tung_striebels_numbers(seed):
    given_ = drawn(seed)
    transition, noise, observation, shift, measured, variances = given_
    mean, covariance = np.ones(3), np.diag([1.0, 4.0, 0.5])
    model = LinearGaussian(transition, noise, observation, shift=shift)
    filtered, smoothed = by_filterpy(given_, mean, covariance)
    for found, expected in (
        (model.filter(measured, variances, mean, covariance), filtered),
        (model.smooth(measured, variances, mean, covariance), smoothed),
    ):
        np.testing.assert_allclose(found.means, expected[0], atol=1e-9)
        np.testing.assert_allclose(found.covariances, expected[1], atol=1e-9)
    np.testing.assert_array_equal(np.isnan(found.used), np.isnan(measured))


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_a_step_is_the_filters_by_its_gain_and_knows_less_by_any_other(seed):
    rng = np.random.default_rng(seed)
    mean, row, root = rng.standard_normal(3), rng.standard_normal(3), rng.standard_normal((3, 3))
    covariance, value, noise = root @ root.T + 0.1 * np.eye(3), rng.standard_normal(), 0.5
    one = LinearGaussian(np.eye(3)[None], np.zeros((1, 3, 3)), row[None, None])
    expected = one.filter([[value]], noise, mean, covariance)
    gain = covariance @ row / (row @ covariance @ row + noise)
    best = corrected(mean, covariance, row, value - row @ mean, noise, gain)
    np.testing.assert_allclose(best[0], expected.means[0], atol=1e-9)
    np.testing.assert_allclose(best[1], expected.covariances[0], atol=1e-9)
    other = corrected(mean, covariance, row, 0.0, noise, gain + rng.standard_normal(3))
    assert np.linalg.eigvalsh(other[1] - best[1]).min() > -1e-9
    assert np.trace(other[1]) > np.trace(best[1])


def test_the_smoother_is_the_regression_over_all_samples():
    """A line without process noise: least squares, whose covariance no smoother can invert."""
    time = np.arange(20.0)
    measured = 3.0 + 0.5 * time + np.random.default_rng(1).standard_normal(20)
    transition, noise = random_walk_slope(np.diff(time, prepend=0.0), rate=0.0)
    model = LinearGaussian(transition, noise, np.array([[[1.0, 0.0]]]))
    found = model.smooth(measured[:, None], 1.0, np.zeros(2), 1e8 * np.eye(2))
    rows = np.column_stack([np.ones(20), time])
    beta = np.linalg.lstsq(rows, measured, rcond=None)[0]
    np.testing.assert_allclose(found.means[:, 0], rows @ beta, atol=1e-5)
    np.testing.assert_allclose(found.means[:, 1], beta[1], atol=1e-6)
    spread = np.einsum("ni,ij,nj->n", rows, np.linalg.inv(rows.T @ rows), rows)
    np.testing.assert_allclose(found.covariances[:, 0, 0], spread, atol=1e-5)


@pytest.mark.parametrize(("limit", "deviations", "kept"), [(5.0, 0.0, False), (5.0, 8.0, True)])
def test_a_gate_leaves_out_what_is_too_far_off(limit, deviations, kept):
    """The further of a distance and of standard deviations of the prediction decides."""
    model = LinearGaussian(
        np.ones((1, 1, 1)), np.zeros((1, 1, 1)), np.ones((1, 1, 1)), step=np.zeros(2, np.int64),
        gate=np.array([[limit, deviations]]),
    )  # fmt: skip
    measured = np.array([[6.0], [1.0]])
    found = model.smooth(measured, 1.0, [0.0], [[1.0]])
    assert np.isnan(found.used[0, 0]) != kept
    assert measured[0, 0] == 6.0
    without = model.smooth([[np.nan], [1.0]], 1.0, [0.0], [[1.0]])
    assert np.array_equal(found.means, without.means) != kept


def test_bands_hold_errors_that_last_and_only_with_them():
    """Errors are drawn for each trip: no averaging removes them."""
    time = np.arange(0.0, 200.0)
    truth, speed = 10.0 * time - 100.0 * np.sin(time / 20.0), 10.0 - 5.0 * np.cos(time / 20.0)
    held: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(60):
        rng = np.random.default_rng(seed)
        place = truth + 0.2 * rng.standard_normal(200) + rng.standard_normal()
        shown = speed + 0.2 * rng.standard_normal(200)
        for stated, within in held.items():
            errors = [LastingError(1.0, np.inf)] if stated else []
            found = smooth_motion(time, shown, 0.2, place, 0.2, errors=errors)
            within.append(np.mean(np.abs(found.position - truth) <= 1.96 * found.position_std))
    assert 0.9 < np.mean(held[True]) < 1.0
    assert np.mean(held[False]) < 0.5

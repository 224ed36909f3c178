"""Recursive least squares: the batch answer, positive definiteness, resets, saved state."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused

from estimators.regression import (
    RecursiveLeastSquares,
    RlsResult,
    edges_crossed,
    periods_elapsed,
    record_with_resets,
)
from trainlog.arrays import FloatArray
from trainlog.errors import InputError

PRIOR = np.array([100.0, 0.1, 0.01])
TRUE = np.array([2.09, 0.039, 0.000675])


def davis_samples(count: int, seed: int, noise: float = 0.05) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    speed = rng.uniform(0.0, 80.0, count)
    rows = np.column_stack([np.ones(count), speed, speed**2])
    return rows, rows @ TRUE + noise * rng.standard_normal(count)


def batch(
    rows: FloatArray, values: FloatArray, variance: FloatArray, weights: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Weighted least squares with the prior, by the normal equations."""
    inverse = np.diag(1.0 / PRIOR**2)
    weight = 1.0 / variance if weights is None else weights / variance
    covariance = np.linalg.inv(inverse + rows.T @ (rows * weight[:, None]))
    return covariance @ (rows.T @ (weight * values)), covariance


def assert_same(
    result: RlsResult, estimate: FloatArray, covariance: FloatArray, rtol: float = 1e-6
) -> None:
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(result.estimate / scale, estimate / scale, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(
        result.covariance / np.outer(scale, scale),
        covariance / np.outer(scale, scale),
        rtol=rtol,
        atol=rtol,
    )


def test_equals_weighted_least_squares():
    rows, values = davis_samples(300, seed=1)
    variance = np.random.default_rng(2).uniform(0.001, 0.01, 300)
    estimator = RecursiveLeastSquares(PRIOR)
    estimator.update(rows, values, variance)
    assert_same(estimator.result(), *batch(rows, values, variance))


def test_forgetting_weighs_samples_exponentially():
    """Amirhosseini et al. (2024), eqs. (19), (20): the sample k updates ago counts gamma^k."""
    gamma, count = 0.9, 400
    rows, values = davis_samples(count, seed=4)
    estimator = RecursiveLeastSquares(PRIOR, forgetting=gamma)
    estimator.update(rows, values)
    weights = gamma ** np.arange(count - 1, -1, -1)
    covariance = np.linalg.inv(
        gamma**count * np.diag(1.0 / PRIOR**2) + rows.T @ (rows * weights[:, None])
    )
    assert_same(estimator.result(), covariance @ (rows.T @ (weights * values)), covariance)


def test_random_walk_equals_the_kalman_recursion():
    rows, values = davis_samples(200, seed=5)
    walk = np.array([1e-2, 1e-4, 1e-6])
    estimator = RecursiveLeastSquares(PRIOR, random_walk_std=walk)
    estimator.update(rows, values, 0.01)
    estimate, covariance = np.zeros(3), np.diag(PRIOR**2)
    for row, value in zip(rows, values, strict=True):
        covariance = covariance + np.diag(walk**2)
        gain = covariance @ row / (0.01 + row @ covariance @ row)
        estimate = estimate + gain * (value - row @ estimate)
        remaining = np.eye(3) - np.outer(gain, row)
        covariance = remaining @ covariance @ remaining.T + 0.01 * np.outer(gain, gain)
    assert_same(estimator.result(), estimate, covariance)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@settings(max_examples=30)
@given(
    forgetting=st.one_of(st.sampled_from([0.9, 0.95, 0.99, 0.999, 1.0]), st.floats(0.9, 1.0)),
    walk=st.sampled_from([0.0, 1e-6, 1e-3, 10.0]),
    constant=st.booleans(),
    scale=st.floats(1e-3, 1e3),
    seed=st.integers(0, 2**31),
    resets=st.sampled_from([None, [1], [0, 2], [0, 1, 2]]),
)
def test_never_loses_positive_definiteness(dtype, forgetting, walk, constant, scale, seed, resets):
    """Where the conventional recursion does after some hundred samples (equations.md: 750)."""
    rng = np.random.default_rng(seed)
    count = 20_000
    speed = np.full(count, 30.0) if constant else rng.uniform(0.0, 80.0, count)
    rows = scale * np.column_stack([np.ones(count), speed, speed**2])
    estimator = RecursiveLeastSquares(
        PRIOR, forgetting=forgetting, random_walk_std=walk * PRIOR, dtype=dtype
    )
    for block in np.array_split(rows, 10):
        estimator.update(block, block @ TRUE + rng.standard_normal(len(block)))
        if resets is not None:
            estimator.reset(resets)
        # A unit triangle and positive weights are the factors of nothing else.
        state = estimator.state()
        upper, diagonal = np.array(state["upper"]), np.array(state["diagonal"])
        np.testing.assert_array_equal(np.tril(upper), np.eye(3))
        assert np.all(diagonal > 0.0)
        assert all(np.all(np.isfinite(each)) for each in (upper, diagonal, state["estimate"]))
        # In its worst direction the variance is that of the prior at most.
        scaled = estimator.result().covariance.astype(np.float64) / np.outer(PRIOR, PRIOR)
        assert np.linalg.eigvalsh(scaled)[-1] < 1.0 + (1e-9 if dtype is np.float64 else 1e-2)


TWO_SPEEDS = np.repeat([20.0, 40.0], 5_000)


@pytest.mark.parametrize("settings", [{}, {"forgetting": 0.999}, {"random_walk_std": 1e-5 * PRIOR}])
@pytest.mark.parametrize(
    ("speed", "valid"),
    [
        (np.full(10_000, 30.0), False),
        (30.0 + 0.03 * np.random.default_rng(1).standard_normal(10_000), False),
        (TWO_SPEEDS, False),
        (TWO_SPEEDS + 0.03 * np.random.default_rng(2).standard_normal(10_000), False),
        (np.linspace(0.0, 40.0, 10_000), True),
        (20.0 + 15.0 * np.sin(np.arange(10_000) / 100.0), True),
    ],
    ids=["constant", "constant, measured", "two speeds", "two, measured", "speeding up", "varied"],
)
def test_a_trip_is_valid_where_its_speed_varies(speed, valid, settings):
    rows = np.column_stack([np.ones(speed.size), speed, speed**2])
    estimator = RecursiveLeastSquares(PRIOR, **settings)
    noise = 0.05 * np.random.default_rng(3).standard_normal(speed.size)
    estimator.update(rows, rows @ TRUE + noise, 0.05**2)
    assert estimator.result().valid is valid


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"prior_std": [1.0, -1.0]}, "prior_std"),
        ({"prior_std": [1.0, np.nan]}, "prior_std"),
        ({"prior_std": [1.0], "forgetting": 0.0}, "forgetting"),
        ({"prior_std": [1.0], "forgetting": 1.1}, "forgetting"),
        ({"prior_std": [1.0], "random_walk_std": [-1.0]}, "random_walk_std"),
        ({"prior_std": [1.0, 1.0], "prior_mean": [0.0]}, "one value a parameter"),
    ],
)
def test_bad_settings_are_refused(arguments, message):
    refused(InputError, message, RecursiveLeastSquares, **arguments)


def test_bad_samples_are_refused_and_change_nothing():
    estimator = RecursiveLeastSquares(PRIOR)
    before = estimator.state()
    for rows, values, variance in (
        ([[1.0, 2.0]], [1.0], 1.0),
        ([[1.0, 2.0, np.nan]], [1.0], 1.0),
        ([[1.0, 2.0, 4.0]], [np.inf], 1.0),
        ([[1.0, 2.0, 4.0]], [1.0], 0.0),
        ([[1.0, 2.0, 4.0]], [1.0, 2.0], 1.0),
        ([[1.0, 2.0, 4.0]], [1.0], [1.0, 1.0]),
        ([[1.0, 2.0, 4.0]], [1.0], np.nan),
    ):
        refused(InputError, "", estimator.update, rows, values, variance)
    for nowhere in ([3], [-1], [0, 7]):
        refused(InputError, "cannot reset", estimator.reset, nowhere)
    assert estimator.state() == before


EDGES = np.array([0.0, 400.0, 1_000.0, 1_003.0])
DAVIS = np.array([0.039, 0.000675])


def trip(slopes: FloatArray, period: float = 0.5) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions, regressors and resistance plus slope of a train that speeds up and down."""
    time = np.arange(0.0, 120.0, period)
    speed = 20.0 + 15.0 * np.sin(time / 15.0)
    position = np.cumsum(np.concatenate(([0.0], period * 0.5 * (speed[1:] + speed[:-1])))) + 1.0
    rows = np.column_stack([np.ones(time.size), speed, speed**2])
    slope = slopes[np.searchsorted(EDGES, position, side="right") - 1]
    return position, rows, slope + rows[:, 1:] @ DAVIS


def test_an_edge_that_was_passed_while_the_position_was_unknown_is_not_lost():
    found = edges_crossed(EDGES, [390.0, np.nan, np.nan, 420.0, np.nan, 430.0])
    assert found.tolist() == [False, False, False, True, False, False]
    assert edges_crossed(EDGES, [np.nan, 420.0]).tolist() == [False, False]


def test_time_resets_fall_on_multiples_of_the_period_despite_rounding():
    times = 0.1 * np.arange(12_001)
    found = periods_elapsed(30.0, times)
    assert np.flatnonzero(found).tolist() == list(range(300, 12_001, 300))


@settings(max_examples=40)
@given(st.lists(st.floats(0.0, 1_100.0), min_size=2, max_size=40), st.integers(1, 39))
def test_blocks_do_not_matter(positions, cut):
    cut = min(cut, len(positions) - 1)
    whole = edges_crossed(EDGES, positions)
    parts = (
        edges_crossed(EDGES, positions[:cut]),
        edges_crossed(EDGES, positions[cut:], positions[cut - 1]),
    )
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    # One by one, as in a closed loop, and by the definition.
    for now, before, found in zip(positions[1:], positions[:-1], whole[1:], strict=True):
        low, high = sorted((before, now))
        assert found == np.any((low < EDGES) & (high >= EDGES))
        assert edges_crossed(EDGES, now, before)[0] == found


@pytest.mark.parametrize("parameters", [None, [0]])
def test_a_trip_at_once_equals_sample_by_sample(parameters):
    position, rows, values = trip(np.array([1.0, 5.0, -3.0, 2.0]))
    whole, single = RecursiveLeastSquares(PRIOR), RecursiveLeastSquares(PRIOR)
    due = edges_crossed(EDGES, position)
    estimates, covariances = record_with_resets(
        whole, due, rows, values, 0.01, parameters=parameters
    )
    for k in range(len(values)):
        if k and edges_crossed(EDGES, position[k], position[k - 1])[0]:
            single.reset(parameters)
        single.update(rows[k], values[k], 0.01)
        result = single.result()
        np.testing.assert_array_equal(result.estimate, estimates[k])
        np.testing.assert_allclose(result.covariance, covariances[k], rtol=1e-9, atol=1e-12)
    assert whole.state() == single.state()
    assert whole.result().resets == np.count_nonzero(due) == 3


def test_what_cannot_be_is_refused():
    refused(InputError, "increase", edges_crossed, [10.0, 5.0], [1.0])
    refused(InputError, "period", periods_elapsed, 0.0, [1.0])
    with pytest.raises(InputError, match="do not fit"):
        record_with_resets(RecursiveLeastSquares(PRIOR), [True], np.ones((2, 3)), np.ones(2))

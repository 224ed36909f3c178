"""Estimators: what the recursive ones have in common, filters, smoothers and regressions."""

import json
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings, strategies as st
from refusals import refused

from estimators import RecursiveLeastSquares, edges_crossed, periods_elapsed, record_with_resets
from estimators.adhesion import AdhesionObserver, SlipDetector
from estimators.interface import Estimator
from estimators.linear_gaussian import LinearGaussian, corrected, random_walk_slope
from estimators.motion import LastingError, OdometryFilter, smooth_motion
from estimators.regression import Cut, Free, regress
from trainlog.arrays import FloatArray
from trainlog.errors import InputError

COUNT = 400
RNG = np.random.default_rng(1)
TIME = 0.1 * np.arange(COUNT)
SPEED = 20.0 + 10.0 * np.sin(TIME / 5.0)
ROWS = np.column_stack([np.ones(COUNT), SPEED, SPEED**2])
WHEELS = SPEED[:, None] + np.where(RNG.uniform(size=(COUNT, 2)) < 0.1, 2.0, 0.0)
WHEELS[:-5][RNG.uniform(size=(COUNT - 5, 2)) < 0.05] = np.nan
EFFORTS = 2e4 + 1e3 * RNG.standard_normal((COUNT, 2))


@dataclass(frozen=True)
class Case:
    """How an estimator is made, and how it is fed the samples of a slice."""

    make: Callable[[], Estimator]
    feed: Callable[[Estimator, slice], object]


def locate(estimator: Estimator, part: slice) -> None:
    satellites = np.where(np.arange(COUNT) % 5, np.nan, SPEED)
    felt = 2.0 * np.cos(TIME / 5.0)
    for row in zip(TIME[part], felt[part], 1.01 * SPEED[part], satellites[part], strict=True):
        estimator.update(*row)


STD = [100.0, 1.0, 0.1]
CASES = {
    "least squares": Case(
        lambda: RecursiveLeastSquares(STD, forgetting=0.99, random_walk_std=[1e-3, 1e-5, 1e-6]),
        lambda estimator, part: estimator.update(ROWS[part], ROWS[part] @ [2.0, 0.04, 0.0007]),
    ),
    "least squares, single precision": Case(
        lambda: RecursiveLeastSquares(STD, forgetting=0.95, dtype=np.float32),
        lambda estimator, part: estimator.update(ROWS[part], ROWS[part] @ [2.0, 0.04, 0.0007]),
    ),
    "slip": Case(
        lambda: SlipDetector(2, 0.05),
        lambda estimator, part: estimator.update(WHEELS[part] - SPEED[part, None]),
    ),
    "adhesion": Case(
        lambda: AdhesionObserver(2, 3e3, 0.03, 2e4),
        lambda estimator, part: estimator.update(TIME[part], WHEELS[part], EFFORTS[part]),
    ),
    "odometry": Case(lambda: OdometryFilter(speed=20.0, speed_std=1.0), locate),
}  # every estimator stands here once


def same(one: FloatArray, other: FloatArray) -> None:
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
@settings(max_examples=3)
@given(cut=st.integers(0, COUNT))
def test_stopped_and_resumed_it_goes_on_bit_for_bit(case, cut):
    whole, part = case.make(), case.make()
    case.feed(whole, slice(0, COUNT))
    case.feed(part, slice(0, cut))
    saved = json.dumps(part.state(), allow_nan=False)
    resumed = type(part).resume(json.loads(saved))
    assert json.dumps(resumed.state(), allow_nan=False) == saved
    same(resumed.result().estimate, part.result().estimate)
    case.feed(resumed, slice(cut, COUNT))
    assert resumed.state() == whole.state()
    same(resumed.result().covariance, whole.result().covariance)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_it_says_how_far_the_data_determine_the_answer(case):
    estimator = case.make()
    nothing = estimator.result()
    assert (nothing.valid, nothing.samples, nothing.resets) == (False, 0, 0)
    assert nothing.excitation == pytest.approx(0.0, abs=1e-6)
    case.feed(estimator, slice(0, COUNT - 1))
    result = estimator.result()
    size = result.estimate.size
    assert result.estimate.shape == (size,)
    assert result.covariance.shape == (size, size)
    assert 0.0 < result.excitation <= 1.0
    assert result.samples == COUNT - 1
    estimator.reset()
    again = estimator.result()
    assert (again.valid, again.samples, again.resets) == (False, 0, 1)
    assert again.excitation == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_state_of_another_kind_or_incomplete_is_refused(case):
    estimator = case.make()
    case.feed(estimator, slice(0, 50))
    state, kind = estimator.state(), type(estimator)
    refused(InputError, "format 'other'", kind.resume, state | {"format": "other"})
    refused(InputError, "version 99", kind.resume, state | {"version": 99})
    for name in state:
        with pytest.raises(InputError):
            kind.resume({key: value for key, value in state.items() if key != name})
        refused(InputError, "", kind.resume, state | {name: "nonsense"})


PRIOR = np.array([100.0, 0.1, 0.01])
TRUE = np.array([2.09, 0.039, 0.000675])


def davis_samples(count: int, seed: int, noise: float = 0.05) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    speed = rng.uniform(0.0, 80.0, count)
    rows = np.column_stack([np.ones(count), speed, speed**2])
    return rows, rows @ TRUE + noise * rng.standard_normal(count)


def assert_same(result, estimate, covariance, rtol=1e-6):
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(result.estimate / scale, estimate / scale, rtol=rtol, atol=rtol)
    found, expected = (each / np.outer(scale, scale) for each in (result.covariance, covariance))
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol)


@pytest.mark.parametrize("gamma", [1.0, 0.9])
def test_it_is_least_squares_whose_weights_forgetting_lowers(gamma):
    """Amirhosseini et al. (2024), eqs. (19), (20): the sample k updates ago counts gamma^k."""
    count = 400
    rows, values = davis_samples(count, seed=4)
    variance = np.random.default_rng(2).uniform(0.001, 0.01, count)
    estimator = RecursiveLeastSquares(PRIOR, forgetting=gamma)
    estimator.update(rows, values, variance)
    weights = gamma ** np.arange(count - 1, -1, -1) / variance
    precision = gamma**count * np.diag(1.0 / PRIOR**2) + rows.T @ (rows * weights[:, None])
    covariance = np.linalg.inv(precision)
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
    options = {"forgetting": forgetting, "random_walk_std": walk * PRIOR, "dtype": dtype}
    estimator = RecursiveLeastSquares(PRIOR, **options)
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


def test_bad_settings_and_samples_are_refused_and_change_nothing():
    for message, wrong in (
        ("prior_std", {"prior_std": [1.0, -1.0]}),
        ("prior_std", {"prior_std": [1.0, np.nan]}),
        ("forgetting", {"prior_std": [1.0], "forgetting": 0.0}),
        ("forgetting", {"prior_std": [1.0], "forgetting": 1.1}),
        ("random_walk_std", {"prior_std": [1.0], "random_walk_std": [-1.0]}),
        ("one value a parameter", {"prior_std": [1.0, 1.0], "prior_mean": [0.0]}),
    ):
        refused(InputError, message, RecursiveLeastSquares, **wrong)
    refused(InputError, "increase", edges_crossed, [10.0, 5.0], [1.0])
    refused(InputError, "period", periods_elapsed, 0.0, [1.0])
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
    shorter = estimator, [True], np.ones((2, 3)), np.ones(2)
    refused(InputError, "do not fit", record_with_resets, *shorter)
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
    first = edges_crossed(EDGES, positions[:cut])
    rest = edges_crossed(EDGES, positions[cut:], positions[cut - 1])
    np.testing.assert_array_equal(np.concatenate((first, rest)), whole)
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
    reset = {"parameters": parameters}
    estimates, covariances = record_with_resets(whole, due, rows, values, 0.01, **reset)
    for k in range(len(values)):
        if k and edges_crossed(EDGES, position[k], position[k - 1])[0]:
            single.reset(parameters)
        single.update(rows[k], values[k], 0.01)
        result = single.result()
        np.testing.assert_array_equal(result.estimate, estimates[k])
        np.testing.assert_allclose(result.covariance, covariances[k], rtol=1e-9, atol=1e-12)
    assert whole.state() == single.state()
    assert whole.result().resets == np.count_nonzero(due) == 3


CURVE = np.array([2.0, -0.5])


def free(columns: FloatArray, mean: float = 0.0) -> list[Free]:
    return [Free("a", columns[:, 0], 3.0, mean), Free("b", columns[:, 1], 0.5)]


def rows(seed: int, count: int = 60) -> tuple[FloatArray, FloatArray]:
    """Columns, and a left-hand side with noise of unit variance."""
    generator = np.random.default_rng(seed)
    columns = generator.standard_normal((count, 2)) * [1.0, 1e-3]
    return columns, columns @ CURVE + generator.standard_normal(count)


def test_data_and_prior_weigh_as_their_variances_say():
    columns, left = rows(1)
    found = regress(left, free(columns, mean=1.5))
    precision = columns.T @ columns + np.diag([3.0**-2, 0.5**-2])
    expected = np.linalg.solve(precision, columns.T @ left + [1.5 / 9.0, 0.0])
    np.testing.assert_allclose(found.estimate, expected, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(precision), rtol=1e-9)
    np.testing.assert_allclose(found.residual, left - columns @ expected, rtol=1e-9)
    # Of the second parameter the rows say next to nothing.
    assert found.std("b") == pytest.approx(0.5, rel=1e-4)


def test_rows_far_off_are_left_out_and_no_others():
    columns, left = rows(2)
    off = [7, 9, 30]
    left[off] = columns[off] @ CURVE + [40.0, 30.0, -9.0]
    # One of neighbours in a round: numbers of rows change from round to round.
    found = regress(left, free(columns), Cut(5.0, apart=5, rounds=10))
    assert np.flatnonzero(~found.kept).tolist() == off
    without = regress(np.delete(left, off), free(np.delete(columns, off, axis=0)))
    np.testing.assert_allclose(found.estimate, without.estimate, rtol=1e-9)
    # In units of their own spread rows of any size are judged alike.
    larger = regress(100.0 * left, free(columns), Cut(5.0, rounds=10, own_scale=True))
    assert not larger.kept[off].any()
    assert larger.kept.sum() >= 55


def test_rows_that_err_together_widen_what_is_known():
    """Twenty clusters of thirty rows with an error in common: as much as estimates scatter."""
    errors, stated = [], []
    for seed in range(200):
        generator = np.random.default_rng(seed)
        column, cluster = np.ones(600), np.repeat(np.arange(20.0), 30)
        common = np.repeat(generator.standard_normal(20), 30)
        left = 2.0 * column + common + generator.standard_normal(600)
        other = np.tile([1.0, -1.0], 300)
        found = regress(left, [Free("a", column, 100.0), Free("b", other, 100.0)])
        each, mean, count = found.clustered(cluster)
        assert (count, mean) == (20, pytest.approx(each.mean(), rel=1e-6))
        stated.append(found.wider(np.sqrt(each)).std("a"))
        errors.append(found["a"] - 2.0)
    assert np.sqrt(np.mean(np.square(stated))) == pytest.approx(np.std(errors), rel=0.15)


def test_a_ratio_has_the_spread_of_both():
    columns = np.random.default_rng(3).standard_normal((200, 2))
    columns[:, 1] += 0.8 * columns[:, 0]
    ratios = []
    for seed in range(300):
        left = columns @ [3.0, 5.0] + np.random.default_rng(seed).standard_normal(200)
        found = regress(left, [Free(*each, 10.0) for each in zip("ab", columns.T, strict=True)])
        ratio, std = found.over("b", "a")
        ratios.append(ratio)
    assert std == pytest.approx(np.std(ratios), rel=0.15)


@pytest.mark.parametrize("rounds", [None, 1, 2, 3])
def test_each_round_but_the_last_leaves_out_what_is_far_off(rounds):
    """Rows one by one, where only the worst of all is left out in a round."""
    values = np.zeros(20)
    values[[3, 8, 11, 17]] = 1e3, 2e3, 3e3, 4e3
    cut = Cut(5.0, apart=41) if rounds is None else Cut(5.0, apart=41, rounds=rounds)
    found = regress(values, [Free("mean", np.ones(20), 1e-3)], cut)
    assert np.count_nonzero(~found.kept) == (4 if rounds is None else rounds) - 1
    assert found.kept[3]


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


def by_filterpy(drawn, mean, covariance):
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

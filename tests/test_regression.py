"""One regression with priors: beside sums written out, and on rows whose truth is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.regression import Cut, Free, regress
from trainlog.arrays import FloatArray

TRUE = np.array([2.0, -0.5])


def free(columns: FloatArray, mean: float = 0.0) -> list[Free]:
    return [Free("a", columns[:, 0], 3.0, mean), Free("b", columns[:, 1], 0.5)]


def rows(seed: int, count: int = 60) -> tuple[FloatArray, FloatArray]:
    """Columns, and a left-hand side with noise of unit variance."""
    generator = np.random.default_rng(seed)
    columns = generator.standard_normal((count, 2)) * [1.0, 1e-3]
    return columns, columns @ TRUE + generator.standard_normal(count)


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
    left[off] = columns[off] @ TRUE + [40.0, 30.0, -9.0]
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

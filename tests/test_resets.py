"""Where the line changes the recursion forgets, exactly there."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused

from estimators.rls import RecursiveLeastSquares, edges_crossed, periods_elapsed, record_with_resets
from trainlog.arrays import FloatArray
from trainlog.errors import InputError

EDGES = np.array([0.0, 400.0, 1_000.0, 1_003.0])
PRIOR = np.array([100.0, 0.1, 0.01])
DAVIS = np.array([0.039, 0.000675])


def trip(slopes: FloatArray, period: float = 0.5) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions, regressors and resistance plus slope of a train that speeds up and down."""
    time = np.arange(0.0, 120.0, period)
    speed = 20.0 + 15.0 * np.sin(time / 15.0)
    position = np.cumsum(np.concatenate(([0.0], period * 0.5 * (speed[1:] + speed[:-1])))) + 1.0
    rows = np.column_stack([np.ones(time.size), speed, speed**2])
    slope = slopes[np.searchsorted(EDGES, position, side="right") - 1]
    return position, rows, slope + rows[:, 1:] @ DAVIS


def test_an_edge_that_was_passed_while_the_position_was_unknown_is_not_lost() -> None:
    found = edges_crossed(EDGES, [390.0, np.nan, np.nan, 420.0, np.nan, 430.0])
    assert found.tolist() == [False, False, False, True, False, False]
    assert edges_crossed(EDGES, [np.nan, 420.0]).tolist() == [False, False]


def test_time_resets_fall_on_multiples_of_the_period_despite_rounding() -> None:
    times = 0.1 * np.arange(12_001)
    found = periods_elapsed(30.0, times)
    assert np.flatnonzero(found).tolist() == list(range(300, 12_001, 300))


@settings(max_examples=40)
@given(
    st.lists(st.floats(0.0, 1_100.0), min_size=2, max_size=40),
    st.integers(1, 39),
)
def test_blocks_do_not_matter(positions: list[float], cut: int) -> None:
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
def test_a_trip_at_once_equals_sample_by_sample(parameters: list[int] | None) -> None:
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


def test_a_partial_reset_at_the_edge_keeps_the_others_and_finds_the_new_slope_at_once() -> None:
    """Without noise: two samples beyond the edge the constant term is the new one."""
    position, rows, values = trip(np.array([1.0, 5.0, -3.0, 2.0]))
    due = edges_crossed(EDGES, position)
    edge = int(np.flatnonzero(due)[0])
    estimates, _ = record_with_resets(
        RecursiveLeastSquares(PRIOR), due, rows, values, 1e-6, parameters=[0]
    )
    np.testing.assert_allclose(estimates[edge - 1], [1.0, *DAVIS], rtol=1e-2)
    np.testing.assert_allclose(estimates[edge + 2], [5.0, *DAVIS], rtol=1e-2)
    never, _ = record_with_resets(
        RecursiveLeastSquares(PRIOR), np.zeros(len(values), dtype=bool), rows, values, 1e-6
    )
    assert abs(never[edge + 2, 0] - 5.0) > 1.0


def test_what_cannot_be_is_refused() -> None:
    refused(InputError, "increase", edges_crossed, [10.0, 5.0], [1.0])
    refused(InputError, "period", periods_elapsed, 0.0, [1.0])
    with pytest.raises(InputError, match="do not fit"):
        record_with_resets(RecursiveLeastSquares(PRIOR), [True], np.ones((2, 3)), np.ones(2))  # type: ignore[arg-type]

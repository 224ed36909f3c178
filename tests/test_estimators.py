"""What all recursive estimators have in common."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused

from estimators.adhesion import AdhesionObserver, SlipDetector
from estimators.interface import Estimator
from estimators.motion import OdometryFilter
from estimators.regression import RecursiveLeastSquares
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


CASES = {
    "least squares": Case(
        lambda: RecursiveLeastSquares(
            [100.0, 1.0, 0.1], forgetting=0.99, random_walk_std=[1e-3, 1e-5, 1e-6]
        ),
        lambda estimator, part: estimator.update(ROWS[part], ROWS[part] @ [2.0, 0.04, 0.0007]),
    ),
    "least squares, single precision": Case(
        lambda: RecursiveLeastSquares([100.0, 1.0, 0.1], forgetting=0.95, dtype=np.float32),
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
}
"""Every estimator stands here once."""


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

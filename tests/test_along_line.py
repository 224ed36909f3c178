"""Trips on a grid of positions: passing times, gaps, plans, differences."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from trainlog.errors import InputError
from trainlog.formats.railway import read_train
from trainlog.formats.samples import DEFAULT_TRAIN, sample
from trainlog.railway import Configuration, Trajectory
from trainlog.resampling import TimeDistance, difference, grid_over, on_grid, planned_time_distance
from trainlog.units import NANOSECONDS


def curve(seconds: np.ndarray, position: np.ndarray) -> TimeDistance:
    return TimeDistance(0, np.rint(seconds * NANOSECONDS).astype(np.int64), position)


def test_a_stop_lies_between_arrival_and_departure() -> None:
    stopping = curve(np.array([0.0, 10.0, 40.0, 50.0]), np.array([0.0, 200.0, 200.0, 400.0]))
    at = np.array([0.0, 100.0, 200.0, 300.0, 400.0])
    assert stopping.arrival_at(at) == pytest.approx([0.0, 5.0, 10.0, 45.0, 50.0])
    assert stopping.departure_at(at) == pytest.approx([0.0, 5.0, 40.0, 45.0, 50.0])


def test_places_passed_in_a_gap_of_the_recording_are_unknown() -> None:
    seconds = np.array([0.0, 1.0, 31.0, 32.0, 132.0, 133.0])
    position = np.array([0.0, 20.0, 620.0, 640.0, 640.0, 660.0])
    passed = on_grid(curve(seconds, position), np.arange(0.0, 661.0, 20.0))
    unknown = (passed.position > 20.0) & (passed.position < 620.0)
    assert (np.isnan(passed.time) == unknown).all()
    # It stood through the second gap, so that nothing is missing there.
    assert passed.time[-1] == 133.0


def test_stops_a_few_metres_apart_make_no_spike_of_lateness() -> None:
    seconds = np.arange(241.0)
    one, other = (
        curve(seconds, np.interp(seconds, [0.0, 100.0, 140.0, 240.0], [0.0, stop, stop, 2_000.0]))
        for stop in (1_003.0, 988.0)
    )
    grid = grid_over([one, other])
    for trip, reference in ((one, other), (other, one)):
        behind = difference(on_grid(trip, grid), on_grid(reference, grid))
        assert np.abs(behind.time).max() < 3.0


def test_a_plan_is_passed_as_constant_effort_moves_a_train() -> None:
    train = read_train(sample(DEFAULT_TRAIN))
    plan = Trajectory(
        "line",
        train.name,
        np.array([0.0, 500.0, 1000.0]),
        (Configuration.of(train),),
        np.array([[0.0, 20.0, 0.0]]),
        np.array([[0.0, 50.0, 100.0]]),
        np.array([53e3, 0.0]),
        np.array([[0.0, 53e3]]),
        100.0,
    )
    # Constant acceleration: s = a t^2 / 2 with a = 0.4 m/s^2.
    found = planned_time_distance(plan, 0)
    assert found.arrival_at([20.0, 125.0, 500.0]) == pytest.approx([10.0, 25.0, 50.0], abs=0.05)
    assert found.covered == (0.0, 1000.0)


def test_grids_that_cannot_be_are_refused() -> None:
    refused(InputError, "no trip has a position", grid_over, [curve(np.empty(0), np.empty(0))])
    refused(InputError, "steps of 0 m", grid_over, [curve(np.array([0.0]), np.array([0.0]))], 0.0)
    one = on_grid(curve(np.array([0.0, 1.0]), np.array([0.0, 10.0])), np.array([0.0, 10.0]))
    with pytest.raises(InputError, match="different grids"):
        difference(one, on_grid(curve(np.array([0.0]), np.array([0.0])), np.array([0.0])))

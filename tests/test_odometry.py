"""The motion while the train runs: outages of satellites, honest deviations, what is missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from refusals import refused

from estimators.motion import OdometryFilter, OdometryResult
from trainlog.arrays import FloatArray
from trainlog.errors import InputError


@dataclass
class Run:
    """A run between two stations and what was measured of it, 10 Hz."""

    time: FloatArray
    position: FloatArray
    speed: FloatArray
    measured: dict[str, FloatArray]

    def located(self, estimator: OdometryFilter, **changes: FloatArray) -> list[OdometryResult]:
        """What the filter gives after each sample, with some of the measurements changed."""
        columns = [{**self.measured, **changes}[name] for name in self.measured]
        return [estimator.update(*row) for row in zip(self.time, *columns, strict=True)]


def run(seed: int = 0) -> Run:
    time = np.arange(0.0, 400.0, 0.1)
    acceleration = np.interp(
        time, [0, 20, 22, 60, 64, 250, 252, 290, 292, 400], [0, 0, 0.8, 0.3, 0, 0, -0.7, -0.7, 0, 0]
    )
    gained = 0.5 * (acceleration[1:] + acceleration[:-1]) * np.diff(time)
    speed = np.maximum(np.concatenate(([0.0], np.cumsum(gained))), 0.0)
    position = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))))
    mean = np.concatenate(([0.0], np.diff(speed) / np.diff(time)))
    rng = np.random.default_rng(seed)
    wheel = (1.0 + 0.01 * rng.standard_normal()) * speed + 0.03 * rng.standard_normal(time.size)
    satellites = np.abs(speed + 0.1 * rng.standard_normal(time.size))
    passed = np.diff(position // 1_200.0, prepend=0.0) > 0.0
    return Run(
        time, position, speed,
        {
            "acceleration": mean + 0.03 * rng.standard_normal()
            + 0.02 * rng.standard_normal(time.size),
            "wheel_speed": np.where(speed > 0.0, np.maximum(wheel, 0.0), 0.0),
            "satellite_speed": np.where(np.arange(time.size) % 2, np.nan, satellites),
            "balise": np.where(passed, position + 0.5 * rng.standard_normal(time.size), np.nan),
        },
    )  # fmt: skip


def test_a_minute_without_satellites_is_bridged_and_the_deviation_grows():
    for seed in range(2):
        trip = run(seed)
        lost = (trip.time > 130.0) & (trip.time < 190.0)
        satellites = np.where(lost, np.nan, trip.measured["satellite_speed"])
        found = trip.located(
            OdometryFilter(),
            satellite_speed=satellites,
            balise=np.where(lost, np.nan, trip.measured["balise"]),
        )
        first, last = np.flatnonzero(lost)[[0, -1]]
        assert found[last].position_std > found[first - 1].position_std
        assert abs(found[last].position - trip.position[last]) < 4.0 * found[last].position_std
        assert abs(found[last].speed - trip.speed[last]) < 4.0 * found[last].speed_std
        assert abs(found[last].position - trip.position[last]) < 5.0
        assert found[last].valid


@pytest.mark.parametrize("missing", ["acceleration", "wheel_speed", "satellite_speed", "balise"])
def test_deviations_are_honest_whatever_is_missing(missing):
    inside = []
    for seed in range(2):
        trip = run(seed)
        found = trip.located(
            OdometryFilter(position_std=1.0), **{missing: np.full(trip.time.size, np.nan)}
        )
        off = np.array([[each.position, each.speed] for each in found])
        off -= np.column_stack([trip.position, trip.speed])
        std = np.array([[each.position_std, each.speed_std] for each in found])
        moving = trip.speed > 0.5
        inside.append(np.mean(np.abs(off[moving]) < 1.96 * std[moving], axis=0))
    assert np.all(np.mean(inside, axis=0) > 0.8), inside


def test_an_axle_that_locks_does_not_make_the_train_stand():
    """For 20 s all of the wheel's samples are 0 while the train runs at speed."""
    for missing in (None, "satellite_speed"):
        trip = run(1)
        locked = (trip.time > 100.0) & (trip.time < 120.0)
        changes = {"wheel_speed": np.where(locked, 0.0, trip.measured["wheel_speed"])}
        if missing:
            changes[missing] = np.full(trip.time.size, np.nan)
        found = trip.located(OdometryFilter(position_std=1.0), **changes)
        off = np.array([each.speed for each in found]) - trip.speed
        std = np.array([each.speed_std for each in found])
        assert not any(each.standing for each, slid in zip(found, locked, strict=True) if slid)
        assert np.abs(off[locked]).max() < 1.5
        assert np.mean(np.abs(off) < 3.0 * std + 0.05) > 0.9


@pytest.mark.parametrize(
    ("wrong", "missing", "within"),
    [(5.0, (), 10.0), (-8.0, (), 10.0), (5.0, ("satellite_speed",), 35.0)],
)
def test_a_filter_that_lost_the_train_follows_it_again(wrong, missing, within):
    """It begins with a wrong speed of which it is sure; all that is measured contradicts it."""
    trip = run(2)
    late = trip.time > 150.0
    begin = int(np.argmax(late))
    estimator = OdometryFilter(
        float(trip.position[begin]), 1.0, float(trip.speed[begin]) + wrong, 0.01
    )
    columns = [
        np.where(late, values, np.nan) if name not in missing else np.full(trip.time.size, np.nan)
        for name, values in trip.measured.items()
    ]
    rows = list(zip(trip.time, *columns, strict=True))[begin:]
    found = [estimator.update(*row) for row in rows]
    off = np.array([each.speed for each in found]) - trip.speed[begin:]
    again = trip.time[begin:] - trip.time[begin] > within
    assert np.abs(off[again]).max() < 1.0
    moving = again & (trip.speed[begin:] > 1.0)
    astray = np.array([each.position for each in found]) - trip.position[begin:]
    std = np.array([each.position_std for each in found])
    assert np.mean(np.abs(astray[moving]) <= 1.96 * std[moving]) > 0.9


def test_bad_input_is_refused():
    refused(InputError, "wheel_noise must be positive", OdometryFilter, wheel_noise=0.0)
    estimator = OdometryFilter()
    estimator.update(1.0, wheel_speed=0.0)
    refused(InputError, "time must increase, got 1", estimator.update, 1.0, wheel_speed=0.0)

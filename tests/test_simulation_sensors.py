"""Sensors err as much as they say, and no more."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from simulated_line import hilly_line

from trainlog.errors import InputError
from trainlog.simulation import sensors as measuring
from trainlog.simulation.sensors import Sensors
from trainlog.units import EARTH_RADIUS, NANOSECONDS

COUNT = 20_000


def ticks(count: int, rate: int = 10) -> np.ndarray:
    return 1_700_000_000 * NANOSECONDS + np.arange(count) * (NANOSECONDS // rate)


def generator() -> np.random.Generator:
    return np.random.default_rng(11)


def on_grid(values: np.ndarray, resolution: float) -> bool:
    return bool(np.allclose(values / resolution, np.round(values / resolution), atol=1e-6))


def test_speed_noise_and_resolution() -> None:
    found = measuring.measured_speed(np.full(COUNT, 20.0), 1.0, Sensors(), generator())
    assert on_grid(found, 0.01)
    assert np.mean(found) == pytest.approx(20.0, abs=0.001)
    assert np.std(found) == pytest.approx(np.hypot(0.03, 0.01 / np.sqrt(12.0)), rel=0.03)


def test_effort_noise_is_proportional_and_quantised() -> None:
    found = measuring.measured_effort(np.full(COUNT, 80e3), Sensors(), generator())
    assert on_grid(found, 100.0)
    assert np.std(found) == pytest.approx(800.0, rel=0.03)
    assert np.all(measuring.measured_effort(np.zeros(100), Sensors(), generator()) == 0.0)


def test_wheel_diameters_err_together_and_apart() -> None:
    draws = [measuring.wheel_scales(4, Sensors(), np.random.default_rng(k)) for k in range(3_000)]
    common = np.array([draw[0] for draw in draws])
    apart = np.array([draw[1] for draw in draws]) - common[:, None]
    assert np.std(common) == pytest.approx(0.003, rel=0.05)
    assert np.std(apart) == pytest.approx(0.001, rel=0.05)
    assert abs(np.mean(common) - 1.0) < 2e-4


def test_odometry_is_set_right_at_balises() -> None:
    position = np.arange(0.0, 60_000.0, 2.5)
    found = measuring.odometry(position, 1.003, Sensors(), generator())
    error = found - position
    step = np.diff(error)
    corrections = np.flatnonzero(np.abs(step - 0.0075) > 0.05)
    spacing = np.diff(position[corrections])
    assert 40 <= len(corrections) <= 55
    assert np.all((spacing > 0.79 * 1_250.0) & (spacing < 1.21 * 1_250.0))
    after = error[corrections + 1]
    assert np.std(after) == pytest.approx(0.5, rel=0.4)
    # Between two balises it drifts by the wheel's error.
    assert np.max(np.abs(error)) < 1.21 * 1_250.0 * 0.003 + 4.0 * 0.5


def test_gnss_noise_rates_and_outages() -> None:
    line = hilly_line()
    time = ticks(36_000)
    position = np.linspace(0.0, 11_000.0, time.size)
    speed = np.full(time.size, 11_000.0 / 3_600.0)
    fix, motion, changes = measuring.gnss(
        line, time, position, speed, Sensors(), np.random.default_rng(5)
    )
    assert fix is not None
    assert len(fix) == len(motion)
    steps = np.diff(fix.index.asi8) / NANOSECONDS
    assert np.min(steps) == pytest.approx(0.2)
    lost, found = (
        [when for when, text in changes if word in text] for word in ("lost", "found again")
    )
    assert len(lost) >= 2
    assert np.sum(steps > 0.3) == len(found)
    # In the tunnel there are no satellites.
    there = np.interp((fix.index.asi8 - time[0]).astype(float), (time - time[0]), position)
    assert not np.any((there >= 2_200.0) & (there < 2_800.0))
    latitude, longitude = line.geometry.at(there)  # type: ignore[union-attr]
    north = np.radians(fix.latitude - latitude) * EARTH_RADIUS
    east = np.radians(fix.longitude - longitude) * EARTH_RADIUS
    east *= np.cos(np.radians(47.0))
    for error in (north, east):
        assert 1.8 < np.std(error) < 4.0
        # Neighbouring fixes share their error: half a minute of memory.
        assert np.corrcoef(error[1:], error[:-1])[0, 1] > 0.97
    assert np.std(motion.speed - speed[0]) == pytest.approx(0.083, rel=0.15)
    reported = np.sqrt(np.mean(fix.horizontal_accuracy**2))
    assert np.std(np.concatenate((north, east))) == pytest.approx(reported, rel=0.25)


def test_environment_is_that_of_the_position() -> None:
    line = hilly_line()
    time = ticks(6_000)
    position = np.linspace(0.0, 11_000.0, 6_000)
    frame = measuring.environment(line, time, position, 283.0)
    assert len(frame) == 600
    assert np.all(np.diff(frame.index.asi8) == NANOSECONDS)
    at = np.interp((frame.index.asi8 - time[0]).astype(float), (time - time[0]), position)
    np.testing.assert_array_equal(frame.gradient, line.gradient(at))
    np.testing.assert_array_equal(frame.speed_limit, line.speed_limit(at))
    assert frame.air_temperature.iloc[0] == 283.0
    assert frame.head_wind.isna().all()


@pytest.mark.parametrize("rate", [5, 15, 30, 400])
def test_impossible_rates_are_refused(rate: int) -> None:
    refused(InputError, f"rate {rate} Hz", Sensors, rate=rate)

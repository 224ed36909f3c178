"""Where a train is and how fast it runs, by what its own instruments tell: a Kalman filter.

Between two samples the accelerometer carries on; an axle that neither pulls nor brakes, satellites
and balises set right. The state is position, speed, the accelerometer's bias, and what the wheel
tells too much of the speed, over the speed.

`estimators.train_state.TrainStateFilter` is for wheels that pull, which creep and slip: of such an
axle as here it believes too little (0.06 to 0.13 m/s of error on the same readings).
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator"

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from analysis.control.follow import Margin
from estimators.kalman import ACCELEROMETER_BIAS_STD, WHEEL_ERROR_STD
from trainlog.simulation.drivers import Observation
from trainlog.simulation.sensors import Reading, Sensors

FloatArray = NDArray[np.float64]

BIAS_TIME = 600.0
"""Over which an accelerometer's bias stays the same [s]."""

UNSTEADY = 0.05
"""What the model of a steady acceleration between two samples leaves out [m/s²]."""

GATE = 5.0
"""Measurements further off than this many standard deviations are left out."""

STANDING = 5
"""A train stands when its wheel has told 0 for so many samples."""

STILL = 1e-3
"""Standard deviation of the speed of a train that stands [m/s]."""

MARGIN = Margin(position=2.0, speed=0.05)
"""For a controller that knows of the train what `Odometry` tells: twice what its standard
deviations come to on most of the way, `balise_spacing` apart."""


class Odometry:
    """Position and speed of a train while it runs.

    Parameters
    ----------
    sensors : Sensors
        How good the instruments are.
    start : float [m]
        Where the train is taken to stand, to 10 m; the balise beneath it tells better.
    """

    def __init__(self, sensors: Sensors, start: float) -> None:
        self._sensors = sensors
        self._time = math.nan
        self._zeros = 0
        self._state = np.array([start, 0.0, 0.0, 0.0])
        spreads = (10.0, STILL, ACCELEROMETER_BIAS_STD, WHEEL_ERROR_STD)
        self._covariance = np.diag(np.square(spreads))
        quantised = math.sqrt(1.0 / 12.0)
        self._felt = math.hypot(
            sensors.acceleration_noise, quantised * sensors.acceleration_resolution, UNSTEADY
        )
        self._wheel = math.hypot(sensors.speed_noise, quantised * sensors.speed_resolution)

    def __call__(self, reading: Reading) -> Observation:
        """What is known of the train after one more sample."""
        x, covariance, sensors = self._state, self._covariance, self._sensors
        if not math.isnan(self._time):
            _carry_on(x, covariance, reading.acceleration, reading.time - self._time, self._felt)
        self._time = reading.time
        self._zeros = self._zeros + 1 if reading.wheel_speed == 0.0 else 0
        if self._zeros >= STANDING:
            _take(x, covariance, np.array([0.0, 1.0, 0.0, 0.0]), 0.0, STILL, math.inf)
        else:
            shown = np.array([0.0, 1.0 + x[3], 0.0, x[1]])
            told = reading.wheel_speed + x[1] * x[3]
            _take(x, covariance, shown, told, self._wheel, GATE)
        if not math.isnan(reading.satellite_speed) and x[1] > 2.0 * sensors.gnss_speed_noise:
            shown = np.array([0.0, 1.0, 0.0, 0.0])
            _take(x, covariance, shown, reading.satellite_speed, sensors.gnss_speed_noise, GATE)
        if not math.isnan(reading.balise):
            shown = np.array([1.0, 0.0, 0.0, 0.0])
            _take(x, covariance, shown, reading.balise, sensors.balise_error, math.inf)
        position, speed, bias, _ = x.tolist()
        return Observation(
            reading.time,
            position,
            max(speed, 0.0) if self._zeros < STANDING else 0.0,
            reading.acceleration - bias,
            position_std=math.sqrt(covariance[0, 0]),
            speed_std=math.sqrt(covariance[1, 1]),
        )


@njit(cache=True)
def _carry_on(
    x: FloatArray, covariance: FloatArray, felt: float, step: float, noise: float
) -> None:
    """Move state and covariance on by one step under the acceleration felt, in place."""
    a = felt - x[2]
    x[0] += (x[1] + 0.5 * a * step) * step
    x[1] += a * step
    motion = np.eye(4)
    motion[0, 1], motion[0, 2], motion[1, 2] = step, -0.5 * step * step, -step
    push = np.array([0.5 * step * step, step, 0.0, 0.0])
    covariance[:] = motion @ covariance @ motion.T + noise**2 * np.outer(push, push)
    covariance[2, 2] += 2.0 * ACCELEROMETER_BIAS_STD**2 * step / BIAS_TIME


@njit(cache=True)
def _take(
    x: FloatArray, covariance: FloatArray, shown: FloatArray, value: float, std: float, gate: float
) -> None:
    """Take in one measurement in place, unless it is too far off."""
    spread = covariance @ shown
    variance = shown @ spread + std * std
    surprise = value - shown @ x
    if abs(surprise) <= gate * math.sqrt(variance):
        gain = spread / variance
        x += gain * surprise
        change = np.eye(4) - np.outer(gain, shown)
        covariance[:] = change @ covariance @ change.T + std * std * np.outer(gain, gain)

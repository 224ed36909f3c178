"""A simulated train's own instruments, as a driver sees the train by them."""

from __future__ import annotations

import math

from analysis.control.route import Margin
from estimators.odometry import OdometryFilter
from trainlog.simulation.drivers import Observation
from trainlog.simulation.sensors import Reading, Sensors

MARGIN = Margin(position=2.0, speed=0.05)
"""For a controller that sees the train by `Odometry`: twice what its standard deviations come to
on most of the way, `balise_spacing` apart."""


class Odometry:
    """Position and speed of a train while it runs, by `estimators.odometry`.

    Parameters
    ----------
    sensors : Sensors
        How good the instruments are.
    start : float [m]
        Where the train is taken to stand, to 10 m; the balise beneath it corrects that.
    """

    def __init__(self, sensors: Sensors, start: float) -> None:
        quantised = math.sqrt(1.0 / 12.0)
        self._filter = OdometryFilter(
            start,
            acceleration_noise=math.hypot(
                sensors.acceleration_noise, quantised * sensors.acceleration_resolution
            ),
            wheel_noise=math.hypot(sensors.speed_noise, quantised * sensors.speed_resolution),
            satellite_noise=sensors.gnss_speed_noise,
            balise_noise=sensors.balise_error,
        )

    def __call__(self, reading: Reading) -> Observation:
        """The train's motion after one more sample."""
        seen = self._filter.update(
            reading.time,
            reading.acceleration,
            reading.wheel_speed,
            reading.satellite_speed,
            reading.balise,
        )
        return Observation(
            reading.time,
            seen.position,
            seen.speed,
            reading.acceleration - float(seen.estimate[2]),
            position_std=seen.position_std,
            speed_std=seen.speed_std,
        )

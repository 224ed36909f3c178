"""A simulated train's own instruments, as a driver sees the train by them."""

from __future__ import annotations

import math

import numpy as np
from filterpy.kalman import KalmanFilter

from analysis.control.prediction import TrainEstimate
from analysis.control.route import Margin, TrainLimits
from estimators.odometry import OdometryFilter
from trainlog.simulation.drivers import Observation
from trainlog.simulation.sensors import Reading, Sensors

NOISE = 0.02
"""Of an acceleration between two decisions [m/s²]."""

UNSURE = 0.05
"""Of an effort that acted, over the effort: drives lag, and wheels slip a little."""

DRIFT, DRIFT_LASTS = 0.015, 15.0
"""What nothing explains: standard deviation [m/s²], and how long it lasts [s]."""

LEAST_SPREAD = 0.02
"""The set is taken to be no narrower than this, relative."""

SURPRISE = 5.0
"""Standard deviations from which on a sample shows nothing of the train: wheels may slip."""


class Observer:
    """Finds gain, drag and drift (see `analysis.control.prediction`) from what the train does.

    Parameters
    ----------
    limits : TrainLimits
        The observed set, from whose spread it starts.
    """

    def __init__(self, limits: TrainLimits) -> None:
        inertias, drags = limits.corners[:, 1], limits.corners[:, 2:] @ (1.0, 20.0, 400.0)
        spreads = [np.ptp(values) / values.sum() * values.size for values in (inertias, drags)]
        gain, drag = (0.5 * max(float(spread), LEAST_SPREAD) for spread in spreads)
        self._filter = KalmanFilter(dim_x=3, dim_z=1)
        self._filter.x = np.array([1.0, 0.0, 0.0])
        self._filter.P = np.diag([gain**2, drag**2, DRIFT**2])

    @property
    def estimate(self) -> TrainEstimate:
        """What the train is estimated to be now."""
        return TrainEstimate(*self._filter.x.tolist())

    def update(
        self, acceleration: float, effort: float, drag: float, track: float, span: float
    ) -> None:
        """Take in what happened since the last decision.

        Parameters
        ----------
        acceleration : float [m/s²]
            Mean since then.
        effort : float [m/s²]
            Specific effort that acted, without gain.
        drag : float [m/s²]
            Running resistance of the middle of the set, over its inertia.
        track : float [m/s²]
            Deceleration by gradient and curves.
        span : float [s]
        """
        x, keep = self._filter, float(np.exp(-span / DRIFT_LASTS))
        x.predict(F=np.diag([1.0, 1.0, keep]), Q=np.diag([0.0, 0.0, (1.0 - keep**2) * DRIFT**2]))
        row = np.array([[effort, -drag, 1.0]])
        value, noise = acceleration + drag + track, NOISE**2 + (UNSURE * effort) ** 2
        spread = x.P @ row[0]
        variance = float(row[0] @ spread) + noise
        surprise, reach = value - float(row[0] @ x.x), SURPRISE * float(np.sqrt(variance))
        if abs(surprise) <= reach:
            x.update(value, noise, row)
            return
        # Wheels that slip show nothing of the train: what they show is drift, up to a limit.
        gain = np.array([0.0, 0.0, spread[2] / variance])
        change = np.eye(3) - np.outer(gain, row)
        x.x = x.x + gain * np.clip(surprise, -reach, reach)
        x.P = change @ x.P @ change.T + noise * np.outer(gain, gain)


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

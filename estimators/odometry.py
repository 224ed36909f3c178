"""Where a train is and how fast it runs, by its own instruments while it runs: odometry.

Between two samples the accelerometer carries the motion on; an axle that neither pulls nor brakes,
satellites' speed and positions that are known to be passed (balises) correct it. What is missing is
bridged, as satellites in a tunnel, and the standard deviations grow. The state is position, speed,
the accelerometer's bias, and by how much the wheel shows too high a speed, over the speed.

One sample comes at a time, ten times a second at most; whole trips are smoothed by
`estimators.motion`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from estimators.interface import Estimator, EstimatorResult
from estimators.linear_gaussian import corrected
from estimators.motion import WHEEL_ERROR_STD
from trainlog.errors import InputError

ACCELEROMETER_BIAS_STD = 0.03
"""Standard deviation of an accelerometer's constant error [m/s²]."""

BIAS_TIME = 600.0
"""Time over which an accelerometer's bias stays the same [s]."""

UNSTEADY = 0.05
"""What a steady acceleration between two samples leaves out [m/s²]."""

UNMEASURED = 0.5
"""Standard deviation of an acceleration that was not measured [m/s²]."""

GATE = 5.0
"""Speeds further than this many standard deviations from the expected one are left out."""

STANDING = 5
"""A train stands when its wheel has shown 0 for so many samples."""

STILL = 1e-3
"""Standard deviation of the speed of a train that stands [m/s]."""

LARGEST_SPEED_STD = 2.0
"""Standard deviation of the speed [m/s] beyond which it is not valid."""

ROLLING = 0.5
"""A wheel that shows 0 slides, where the train is faster than this [m/s] and than its deviation."""

LOCKED_OUT = 5.0
"""Where satellites and all else were left out for so long [s], the filter is wrong, not they."""

SLIDING = 30.0
"""The same where there is only the wheel [s], which may slip or slide for long."""

RECEIVER_STDS = 2.0
"""A receiver shows the size of the speed, so its noise never averages to 0: its speed is used where
the wheel shows more than this many of its standard deviations."""


_SPEED = (0.0, 1.0, 0.0, 0.0)
"""The row of a measurement of the speed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OdometryResult(EstimatorResult):
    """The motion now.

    Attributes
    ----------
    estimate : (4,) array
        Position [m], speed [m/s], accelerometer's bias [m/s²], wheel's error [1].
    covariance : (4, 4) array
    valid : bool
        Whether the speed is known to `LARGEST_SPEED_STD`.
    excitation : float
        Share of the prior's standard deviation of bias and wheel's error that was removed, of the
        one where it is less.
    standing : bool
        Whether the wheel has shown 0 for long.
    """

    standing: bool

    @property
    def position(self) -> float:
        """Position [m]."""
        return float(self.estimate[0])

    @property
    def speed(self) -> float:
        """Speed [m/s]; 0 where the train stands."""
        return 0.0 if self.standing else max(float(self.estimate[1]), 0.0)

    @property
    def position_std(self) -> float:
        """Standard deviation of the position [m]."""
        return math.sqrt(self.covariance[0, 0])

    @property
    def speed_std(self) -> float:
        """Standard deviation of the speed [m/s]."""
        return math.sqrt(self.covariance[1, 1])


class OdometryFilter(Estimator):
    """Kalman filter of a train's position and speed, sample by sample.

    Parameters
    ----------
    position, position_std : float [m]
        Known beforehand.
    speed, speed_std : float [m/s]
        Known beforehand; default: the train stands.
    acceleration_noise : float [m/s²]
        Of the accelerometer; standard deviation, as all that follow.
    wheel_noise : float [m/s]
    satellite_noise : float [m/s]
    balise_noise : float [m]

    Raises
    ------
    InputError
        If a standard deviation is not positive.

    Examples
    --------
    A train at 20 m/s whose wheel shows 1 % too much loses its satellites after a minute:

    >>> odometry = OdometryFilter(speed=20.0, speed_std=1.0)
    >>> for k in range(1200):
    ...     satellites = 20.0 if k < 600 else float("nan")
    ...     found = odometry.update(0.1 * k, 0.0, wheel_speed=20.2, satellite_speed=satellites)
    >>> print(f"{found.speed:.2f} ± {found.speed_std:.2f} m/s")
    20.00 ± 0.01 m/s
    """

    kind, version = "trainlog/odometry", 1
    settings = (
        "position", "position_std", "speed", "speed_std",
        "acceleration_noise", "wheel_noise", "satellite_noise", "balise_noise",
    )  # fmt: skip
    memory = ("mean", "covariance", "time", "zeros", "refusing")

    def __init__(
        self,
        position: float = 0.0,
        position_std: float = 10.0,
        speed: float = 0.0,
        speed_std: float = STILL,
        *,
        acceleration_noise: float = 0.02,
        wheel_noise: float = 0.03,
        satellite_noise: float = 0.1,
        balise_noise: float = 0.5,
    ) -> None:
        self._position, self._position_std = float(position), float(position_std)
        self._speed, self._speed_std = float(speed), float(speed_std)
        self._acceleration_noise, self._wheel_noise = float(acceleration_noise), float(wheel_noise)
        self._satellite_noise, self._balise_noise = float(satellite_noise), float(balise_noise)
        for name in self.settings:
            value = getattr(self, f"_{name}")
            if not np.isfinite(value) or (name not in ("position", "speed") and value <= 0.0):
                raise InputError(f"odometry: {name} must be positive and finite, got {value}")
        self._prior = np.square(
            [self._position_std, self._speed_std, ACCELEROMETER_BIAS_STD, WHEEL_ERROR_STD]
        )
        self.reset()

    def reset(self) -> None:
        """Forget everything but what was known beforehand."""
        self._mean = np.array([self._position, self._speed, 0.0, 0.0])
        self._covariance = np.diag(self._prior)
        self._time, self._zeros = np.array(np.nan), np.array(0)
        self._refusing = np.array(0.0)
        self._samples = 0
        self._resets += 1

    def update(
        self,
        time: float,
        acceleration: float = math.nan,
        wheel_speed: float = math.nan,
        satellite_speed: float = math.nan,
        balise: float = math.nan,
    ) -> OdometryResult:
        """Take in one sample; NaN is what was not measured.

        Parameters
        ----------
        time : float [s]
            Increasing from call to call.
        acceleration : float [m/s²]
            Along the track, mean since the sample before.
        wheel_speed, satellite_speed : float [m/s]
        balise : float [m]
            Position of a balise that was passed since the sample before.

        Returns
        -------
        OdometryResult
            As of `result`.

        Raises
        ------
        InputError
            If time does not increase.
        """
        if not math.isnan(self._time):
            if not time > self._time:
                raise InputError(f"odometry: time must increase, got {time} s after {self._time} s")
            self._predict(time - float(self._time), acceleration)
        step = 0.0 if math.isnan(self._time) else time - float(self._time)
        self._time, self._samples = np.array(time), self._samples + 1
        expected = ROLLING + GATE * math.sqrt(max(self._covariance[1, 1], 0.0))
        stands = wheel_speed == 0.0 and self._mean[1] < expected
        self._zeros = np.array(self._zeros + 1 if stands else 0)
        refused = []
        if self._zeros >= STANDING:
            self._correct(0.0, _SPEED, STILL, math.inf)
            self._refusing = np.array(0.0)
        else:
            # The wheel shows w = v (1 + e), linear about the state: w + v e = (1 + e) v + v e.
            _, speed, _, error = self._mean.tolist()
            row = (0.0, 1.0 + error, 0.0, speed)
            refused.append(self._correct(wheel_speed + speed * error, row, self._wheel_noise))
        clear = RECEIVER_STDS * self._satellite_noise
        alone = math.isnan(wheel_speed) and satellite_speed > expected + clear
        if self._mean[1] > clear or any(refused) or alone:
            refused.append(self._correct(satellite_speed, _SPEED, self._satellite_noise))
        self._follow(refused, step, wheel_speed, satellite_speed)
        self._correct(balise, (1.0, 0.0, 0.0, 0.0), self._balise_noise, math.inf)
        return self.result()

    def _follow(
        self, refused: list[bool | None], step: float, wheel_speed: float, satellite_speed: float
    ) -> None:
        """Trust the measurements again that were all left out for long: the filter lost the train.

        Its deviations grow by what they depart, and by the way that the train went meanwhile.
        """
        if False in refused:
            self._refusing = np.array(0.0)
        if False in refused or True not in refused:
            return
        self._refusing = self._refusing + step
        by_satellites = refused[-1] is True and len(refused) > 1
        if self._refusing < (LOCKED_OUT if by_satellites else SLIDING):
            return
        shown = satellite_speed if by_satellites else wheel_speed
        apart = shown - float(self._mean[1])
        self._covariance[1, 1] += apart**2
        self._covariance[0, 0] += (apart * float(self._refusing)) ** 2
        self._refusing = np.array(0.0)

    def _predict(self, step: float, acceleration: float) -> None:
        """The motion over a step under the acceleration felt, less the accelerometer's bias."""
        known = not math.isnan(acceleration)
        far, fast = 0.5 * step**2, step
        rough = math.hypot(self._acceleration_noise, UNSTEADY) if known else UNMEASURED
        wander = 2.0 * ACCELEROMETER_BIAS_STD**2 * step / BIAS_TIME
        transition = np.array(
            (
                (1.0, step, -far * known, 0.0),
                (0.0, 1.0, -fast * known, 0.0),
                (0.0, 0.0, 1.0, 0.0),
                (0.0, 0.0, 0.0, 1.0),
            )
        )
        noise = np.array(
            (
                (rough**2 * far * far, rough**2 * far * fast, 0.0, 0.0),
                (rough**2 * far * fast, rough**2 * fast * fast, 0.0, 0.0),
                (0.0, 0.0, wander, 0.0),
                (0.0, 0.0, 0.0, 0.0),
            )
        )
        push = np.array((far, fast, 0.0, 0.0)) * (acceleration if known else 0.0)
        self._mean = transition.dot(self._mean) + push
        self._covariance = transition.dot(self._covariance).dot(transition.T) + noise

    def _correct(
        self, value: float, shown: tuple[float, ...], std: float, gate: float = GATE
    ) -> bool | None:
        """Take in one measurement; whether it was left out as too far from the expected one.

        None where it is missing.
        """
        if math.isnan(value):
            return None
        row = np.array(shown)
        innovation, shared = value - float(row.dot(self._mean)), self._covariance.dot(row)
        variance = float(row.dot(shared)) + std**2
        if abs(innovation) > gate * math.sqrt(variance):
            return True
        self._mean, self._covariance = corrected(
            self._mean, self._covariance, row, innovation, std**2, shared * (1.0 / variance)
        )
        return False

    def result(self) -> OdometryResult:
        """Position, speed and the instruments' errors now."""
        _, speed, bias, error = np.diagonal(self._covariance).tolist()
        left = math.sqrt(max(bias / ACCELEROMETER_BIAS_STD**2, error / WHEEL_ERROR_STD**2))
        return OdometryResult(
            estimate=self._mean.copy(),
            covariance=self._covariance.copy(),
            valid=bool(self._samples > 0 and speed <= LARGEST_SPEED_STD**2),
            excitation=min(max(1.0 - left, 0.0), 1.0),
            standing=bool(self._zeros >= STANDING),
            samples=self._samples,
            resets=self._resets,
        )

"""A train's motion smoothed or filtered: position, speed, acceleration and their uncertainty.

The motion is a linear-Gaussian model (`estimators.linear_gaussian`) whose acceleration is a
first-order Markov process.

`OdometryFilter` is for a train that runs: where it is and how fast, by its own instruments.
Between two samples the accelerometer carries the motion on; an axle that neither pulls nor brakes,
satellites' speed and positions that are known to be passed (balises) correct it. What is missing is
bridged, as satellites in a tunnel, and the standard deviations grow. The state is position, speed,
the accelerometer's bias, and by how much the wheel shows too high a speed, over the speed.
One sample comes at a time, ten times a second at most.

References
----------
Singer, R. A. (1970), Estimating optimal tracking filter performance for manned maneuvering
targets, IEEE Trans. AES-6(4), eqs. (3)-(9).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from estimators.interface import Estimator, EstimatorResult
from estimators.linear_gaussian import LinearGaussian, corrected
from trainlog.arrays import FloatArray
from trainlog.errors import InputError

ACCELERATION_STD = 0.4
"""Standard deviation of a train's acceleration over a trip [m/s²]: stops at 0.5 to 1 m/s²,
between them long stretches near 0."""

ACCELERATION_TIME = 5.0
"""Correlation time of the acceleration [s]: between that of a brake application (1 s) and that of
a whole run-up (60 s)."""

LASTING_TIME = 30.0
"""Correlation time [s] of the part of a position's error that lasts: satellites that set,
reflections that come and go."""

WHEEL_ERROR_STD = 0.02
"""Standard deviation of the relative error of wheel speeds before it is known: worn wheels."""

CHANNELS = ("position", "speed", "wheel_speed")
"""What is measured."""

NO_SPEED_STD = 50.0
"""Standard deviation of the speed [m/s] before the first sample."""

NO_POSITION_STD = 1e4
"""Standard deviation of the position [m] before the first one is measured."""


NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)
"""Of the quadrature over a step."""


@dataclass(frozen=True, eq=False)
class MotionModel:
    """How a train moves.

    Attributes
    ----------
    acceleration_std : float [m/s²]
    acceleration_time : float [s]
        Over which the acceleration stays alike.
    drift : float [m/√s]
        Random walk of the position beyond the integral of the speed.
    unmeasured : (n,) array or None [1]
        Factor of the variance of the acceleration over each step: where nothing was measured for
        long, a train may have braked, stood and started.
    """

    acceleration_std: float = ACCELERATION_STD
    acceleration_time: float = ACCELERATION_TIME
    drift: float = 0.0
    unmeasured: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class LastingError:
    """A part of a measurement's error that lasts: a first-order Markov process.

    Attributes
    ----------
    std : float or (n,) array [unit of the measurement]
    time : float [s]
        Correlation time; infinite for an error that never changes.
    of : {"position", "speed", "wheel_speed"}
        The measurement.

    Examples
    --------
    Fixes of a standing train that may all be 3 m off; no number of them shows by how much:

    >>> import numpy as np
    >>> time, place, speed = np.arange(60.0), np.full(60, 100.0), np.zeros(60)
    >>> alone = smooth_motion(time, speed, 0.1, place, 2.0)
    >>> off = smooth_motion(time, speed, 0.1, place, 2.0, errors=[LastingError(3.0, np.inf)])
    >>> print(f"{alone.position_std[30]:.1f} m, {off.position_std[30]:.1f} m")
    0.3 m, 3.0 m
    """

    std: ArrayLike
    time: float = LASTING_TIME
    of: Literal["position", "speed", "wheel_speed"] = "position"


@dataclass(frozen=True, eq=False)
class SmoothedMotion:
    """A train's motion at the times of its samples; all (n,) arrays.

    Attributes
    ----------
    position, position_std : array [m]
        Chainage; the distance since the first sample if no position was given.
    speed, speed_std : array [m/s]
    acceleration, acceleration_std : array [m/s²]
    wheel_error : float
        By how much the wheels show too high a speed, over what they show; 0 without them.
    lasting : (n, k) array
        Each error that lasts, in its own standard deviations.
    """

    position: FloatArray
    position_std: FloatArray
    speed: FloatArray
    speed_std: FloatArray
    acceleration: FloatArray
    acceleration_std: FloatArray
    wheel_error: float = 0.0
    lasting: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))


def smooth_motion(
    time: ArrayLike,
    speed: ArrayLike,
    speed_std: ArrayLike,
    position: ArrayLike | None = None,
    position_std: ArrayLike | None = None,
    *,
    errors: Sequence[LastingError] = (),
    wheel_speed: ArrayLike | None = None,
    wheel_speed_std: ArrayLike | None = None,
    model: MotionModel | None = None,
) -> SmoothedMotion:
    """Smooth measured speed, and position where there is one, over a whole trip.

    The motion is modelled as position, speed and a first-order Markov acceleration (Singer); the
    noise of the measurements as white. Beside it they may have errors that last, and the wheels an
    unknown diameter. NaN marks a missing measurement; through an outage the model carries on and
    the standard deviations grow.

    Parameters
    ----------
    time : (n,) array [s]
        Strictly increasing; steps need not be equal.
    speed : (n,) array [m/s]
    speed_std : float or (n,) array [m/s]
    position : (n,) array [m], optional
    position_std : float or (n,) array [m], optional
        Needed with `position`.
    errors : sequence of LastingError, optional
    wheel_speed : (n,) array [m/s], optional
        A second speed, wrong by a constant factor of 1 with a standard deviation of
        `WHEEL_ERROR_STD`.
    wheel_speed_std : float or (n,) array [m/s], optional
        Needed with `wheel_speed`.
    model : MotionModel, optional

    Returns
    -------
    SmoothedMotion

    Raises
    ------
    InputError
        If shapes do not fit, time does not increase, a standard deviation is not positive, or
        nothing was measured.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(0.0, 60.0, 0.5)  # s
    >>> noise = 0.1 * np.random.default_rng(1).standard_normal(time.size)
    >>> motion = smooth_motion(time, np.minimum(0.5 * time, 15.0) + noise, 0.1)
    >>> print(f"{motion.speed[-20]:.2f} ± {motion.speed_std[-20]:.2f} m/s")
    14.99 ± 0.06 m/s
    """
    instants = _checked_times(time)
    given = ((position, position_std), (speed, speed_std), (wheel_speed, wheel_speed_std))
    values, variances = _checked(instants, given)
    model = MotionModel() if model is None else model
    lasting = list(errors)
    if wheel_speed is not None:
        # w = v / (1 - k) is linear in speed and error: w = v + w k.
        lasting.append(LastingError(WHEEL_ERROR_STD * values[:, 2], np.inf, "wheel_speed"))
    transition, noise = motion_model(np.diff(instants, prepend=instants[0]), model, lasting)
    observed = np.zeros((instants.size, 3, 3 + len(lasting)))
    observed[:, 0, 0] = observed[:, 1, 1] = observed[:, 2, 1] = 1.0
    for state, error in enumerate(lasting, 3):
        observed[:, CHANNELS.index(error.of), state] = np.nan_to_num(np.asarray(error.std))
    found = LinearGaussian(transition, noise, observed).smooth(
        values, variances, *_start(values, model, len(lasting), position is not None)
    )
    means, deviations = found.means, found.std
    return SmoothedMotion(
        position=means[:, 0],
        position_std=deviations[:, 0],
        speed=means[:, 1],
        speed_std=deviations[:, 1],
        acceleration=means[:, 2],
        acceleration_std=deviations[:, 2],
        wheel_error=0.0 if wheel_speed is None else WHEEL_ERROR_STD * float(means[-1, -1]),
        lasting=means[:, 3:],
    )


def reach(speeds: ArrayLike, time: float, starts: float, brakes: float) -> tuple[float, float]:
    """How far [m] a train may come in a time at least and at most, from one speed to another.

    Its speed falls as fast as it may and rises as fast, or the other way round, or to a stand.

    Parameters
    ----------
    speeds : (2,) array [m/s]
        At first and at last.
    time : float [s]
    starts, brakes : float [m/s²]
        How hard it may start and brake.

    Examples
    --------
    >>> reach((10.0, 10.0), 60.0, 1.0, 1.0), reach((10.0, 10.0), 10.0, 1.0, 1.0)
    ((100.0, 1500.0), (75.0, 125.0))
    """
    first, last = np.asarray(speeds, dtype=np.float64)
    way, gained = 0.5 * (first + last) * time, last - first
    if time <= 0.0:
        return float(way), float(way)
    beside = max(starts * time - gained, 0.0) * max(brakes * time + gained, 0.0)
    beside /= 2.0 * (starts + brakes)
    stands = first / brakes + last / starts < time
    stop = 0.5 * (first**2 / brakes + last**2 / starts)
    return float(stop if stands else way - beside), float(way + beside)


def _checked_times(time: ArrayLike) -> FloatArray:
    instants = np.asarray(time, dtype=np.float64)
    if instants.ndim != 1 or instants.size < 2 or not np.all(np.isfinite(instants)):
        raise InputError("smoothing: needs at least two finite times")
    if np.any(np.diff(instants) <= 0.0):
        at = int(np.argmax(np.diff(instants) <= 0.0)) + 1
        raise InputError(
            f"smoothing: time does not increase at {instants[at]:g} s",
            place=f"sample {at}",
            remedy="sort the samples and drop duplicates first",
        )
    return instants


def _checked(
    instants: FloatArray, given: Sequence[tuple[ArrayLike | None, ArrayLike | None]]
) -> tuple[FloatArray, FloatArray]:
    """Measurements (n, 3), NaN where there is none, and their variances (n, 3)."""
    values = np.full((instants.size, len(CHANNELS)), np.nan)
    variances = np.ones((instants.size, len(CHANNELS)))
    for column, (name, (value, std)) in enumerate(zip(CHANNELS, given, strict=True)):
        if (value is None) != (std is None):
            raise InputError(f"smoothing: {name} and {name}_std belong together")
        if value is None or std is None:
            continue
        try:
            values[:, column] = np.asarray(value, dtype=np.float64)
            deviation = np.broadcast_to(np.asarray(std, dtype=np.float64), instants.shape)
        except ValueError:
            raise InputError(
                f"smoothing: {name} and its standard deviation must fit {instants.size} times"
            ) from None
        known = np.isfinite(values[:, column])
        values[~known, column] = np.nan
        if not np.all(deviation[known] > 0.0) or not np.all(np.isfinite(deviation[known])):
            raise InputError(f"smoothing: {name}_std must be positive where {name} is known")
        variances[known, column] = deviation[known] ** 2
    if not np.any(np.isfinite(values)):
        raise InputError("smoothing: neither speed nor position was measured")
    return values, variances


def _start(
    values: FloatArray, model: MotionModel, errors: int, has_position: bool
) -> tuple[FloatArray, FloatArray]:
    """State and covariance before the first sample, weak unless position is only relative."""
    known = values[np.isfinite(values[:, 0]), 0]
    first = float(known[0]) if known.size else 0.0
    position_std = NO_POSITION_STD if has_position else 1e-3
    deviations = [position_std, NO_SPEED_STD, model.acceleration_std] + errors * [1.0]
    return np.array([first] + (2 + errors) * [0.0]), np.diag(np.square(deviations))


def motion_model(
    steps: FloatArray, model: MotionModel | None = None, errors: Sequence[LastingError] = ()
) -> tuple[FloatArray, FloatArray]:
    """Transition and process noise over each step.

    The state is position [m], speed [m/s], acceleration [m/s²], and each error that lasts over its
    standard deviation.

    Parameters
    ----------
    steps : (n,) array [s]
    model : MotionModel, optional
    errors : sequence of LastingError, optional

    Returns
    -------
    transition, process_noise : (n, d, d) array

    Examples
    --------
    >>> import numpy as np
    >>> transition, noise = motion_model(np.array([0.0, 1.0]))
    >>> transition[1, 0, :3].round(3)  # position after 1 s: x + v + 0.47 a
    array([1.   , 1.   , 0.468])
    """
    motion = MotionModel() if model is None else model
    transition, noise = np.zeros((2, steps.size, 3 + len(errors), 3 + len(errors)))
    # A recorder's steps are few different ones.
    different, which = np.unique(steps, return_inverse=True)
    transition[:, :3, :3], noise[:, :3, :3] = (part[which] for part in _singer(different, motion))
    if motion.unmeasured is not None:
        noise[:, :3, :3] *= motion.unmeasured[:, None, None]
    noise[:, 0, 0] += motion.drift**2 * steps
    for state, error in enumerate(errors, 3):
        transition[:, state, state] = np.exp(-steps / error.time)
        noise[:, state, state] = -np.expm1(-2.0 * steps / error.time)
    return transition, noise


def _singer(steps: FloatArray, motion: MotionModel) -> tuple[FloatArray, FloatArray]:
    """Transition (n, 3, 3) and process noise (n, 3, 3) of Singer's model over each step [s].

    The noise is ``∫ g(u) g(u)ᵀ q du`` over the step, ``g`` the response to an impulse of jerk,
    by Gauss-Legendre quadrature: the closed form cancels to nothing at short steps.
    """
    transition = np.zeros((steps.size, 3, 3))
    transition[:, 0, 0] = transition[:, 1, 1] = 1.0
    transition[:, 0, 1] = steps
    transition[:, :, 2] = _impulse_response(steps, motion.acceleration_time)
    response = _impulse_response(0.5 * steps[:, None] * (1.0 + NODES), motion.acceleration_time)
    spectral_density = 2.0 * motion.acceleration_std**2 / motion.acceleration_time
    noise = np.einsum("nqi,nqj,q,n->nij", response, response, WEIGHTS, 0.5 * steps)
    return transition, spectral_density * noise


def _impulse_response(delay: FloatArray, time: float) -> FloatArray:
    """Position, speed and acceleration (..., 3) a `delay` [s] after a unit step of acceleration."""
    share = delay / time
    decay = -np.expm1(-share)
    return np.stack(
        [
            time**2 * (share - decay),
            time * decay,
            1.0 - decay,
        ],
        axis=-1,
    )


# -------------------------------------------------------------------- odometry, while a train runs

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

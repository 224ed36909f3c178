"""Adhesion force of the powered axles, and the train's speed while they slip.

The force between wheel and rail is the unknown load of a known rotating mass. Everything is
referred to the wheel rim: a powered axle is a mass ``J`` [kg] (its inertia over the wheel radius
squared) that moves at the circumferential speed ``w`` [m/s], driven by the effort ``T`` [N] of its
motor and held by the adhesion force ``F`` [N]; Zhao et al. (2025), eqs. (4)-(9), become
``J dw/dt = T - F``. F wanders as a Brownian motion: a linear-Gaussian model of two states, which
`AdhesionObserver` filters and `smoothed_force` smooths. The smoother is that of
`estimators.linear_gaussian`; the filter is written out for the two states, all axles of a sample in
one pass, which is ten times as fast.

The momentum that efforts give to a train is known whether its wheels slip or not: what the motors
give and the wheels do not keep goes into the rail,
``M dv/dt = sum(T) - J d(sum w)/dt - brake - resistance``. So ``v - P/M``, with the impulse
``P = ∫(sum T - brake) dt - J sum w``, changes only by the running resistance and the gradient:
slowly, and the more surely the shorter a slip lasts. A linear-Gaussian model describes it as a line
with a wandering slope, which `train_speed` smooths over the trip. `SlipDetector` finds slips in the
slip speed with hysteresis.

A wheel shows the train's speed as far as its creep is small; its creep grows with the adhesion in
use and lasts, so it is no white noise and weighs little beside a satellite speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from estimators.interface import CALIBRATED, Estimator, EstimatorResult
from estimators.linear_gaussian import LinearGaussian, random_walk_slope
from trainlog.arrays import BoolArray, FloatArray
from trainlog.errors import InputError

NO_SPEED_STD = 100.0
"""Standard deviation of a wheel speed [m/s] that was not measured at first."""


@dataclass(frozen=True, slots=True)
class AdhesionForce:
    """Force between wheel and rail, signed like the effort, and its standard deviation [N]."""

    force: FloatArray
    std: FloatArray


class AdhesionObserver(Estimator):
    """Disturbance observer for the adhesion force of each axle: a Kalman filter.

    The effort is taken as linear between two samples, so speed and effort of one row must belong to
    the same instant: one sample of misalignment doubles the error.

    Parameters
    ----------
    axles : int
    rotating_mass : float [kg]
        Inertia of one axle with its motor over the wheel radius squared.
    speed_std : float [m/s]
        Noise of the wheel speed.
    force_rate : float [N/s^0.5]
        How fast the adhesion force may wander.

    Raises
    ------
    InputError
        If there is no axle, or another parameter is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(100) / 10.0  # s
    >>> effort, force = 30e3, 26e3  # N; what is left turns 1500 kg faster
    >>> wheel_speed = 10.0 + (effort - force) / 1_500.0 * time
    >>> observer = AdhesionObserver(1, 1_500.0, speed_std=0.03, force_rate=20e3)
    >>> _ = observer.update(time, wheel_speed[:, None], np.full((100, 1), effort))
    >>> print(f"{observer.result().estimate[0]:.0f} N")
    26000 N
    """

    kind, version = "trainlog/adhesion_observer", 2
    settings = ("axles", "rotating_mass", "speed_std", "force_rate")
    memory = ("mean", "covariance", "prior_variance", "effort", "time")

    def __init__(
        self, axles: int, rotating_mass: float, speed_std: float, force_rate: float
    ) -> None:
        if axles < 1:
            raise InputError(f"adhesion observer: needs axles, got {axles}")
        self._axles = axles
        self._rotating_mass, self._speed_std, self._force_rate = (
            float(rotating_mass), float(speed_std), float(force_rate)
        )  # fmt: skip
        for name, value in (
            ("rotating mass", rotating_mass),
            ("speed noise", speed_std),
            ("force rate", force_rate),
        ):
            if not (value > 0.0 and np.isfinite(value)):
                raise InputError(f"adhesion observer: {name} must be positive, got {value}")
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next sample starts anew."""
        self._mean = np.zeros((self._axles, 2))
        self._covariance = np.full((self._axles, 2, 2), np.nan)
        self._prior_variance = np.full(self._axles, np.nan)
        self._time = np.array(np.nan)
        self._effort = np.zeros(self._axles)
        self._samples = 0
        self._resets += 1

    def update(
        self, time: ArrayLike, wheel_speed: ArrayLike, wheel_effort: ArrayLike
    ) -> AdhesionForce:
        """Take one sample or the next samples in.

        Parameters
        ----------
        time : (n,) array or float [s]
            Increasing, also from call to call.
        wheel_speed : (n, axles) or (axles,) array [m/s]
            NaN where missing: the state is then only predicted.
        wheel_effort : (n, axles) or (axles,) array [N]
            Missing efforts are held.

        Returns
        -------
        AdhesionForce
            (n, axles) arrays, at each sample by that and the earlier ones.

        Raises
        ------
        InputError
            If shapes do not fit or time does not increase.
        """
        return self._run(time, wheel_speed, wheel_effort, smooth=False)

    def _run(
        self, time: ArrayLike, wheel_speed: ArrayLike, wheel_effort: ArrayLike, *, smooth: bool
    ) -> AdhesionForce:
        speed = samples_of("wheel speed", wheel_speed, self._axles)
        effort = samples_of("wheel effort", wheel_effort, self._axles)
        clock = _clock(time, speed, effort, float(self._time))
        if clock.size == 0:
            return AdhesionForce(np.empty((0, self._axles)), np.empty((0, self._axles)))
        before = clock[0] if self._samples == 0 else float(self._time)
        if self._samples == 0:
            speed = self._begin(speed, effort[0])
        steps = np.diff(clock, prepend=before)
        run = self._smoothed if smooth else self._filtered
        found = run(steps, speed, effort)
        self._time, self._samples = np.array(clock[-1]), self._samples + clock.size
        return found

    def _begin(self, speed: FloatArray, effort: FloatArray) -> FloatArray:
        """Start from the first sample; the speeds without it.

        All effort is taken to go into the rail, with an uncertainty as large as a second's
        wandering and the effort itself.
        """
        self._effort = np.nan_to_num(effort)
        known = ~np.isnan(speed[0])
        self._mean = np.column_stack([np.nan_to_num(speed[0]), self._effort])
        self._prior_variance = self._force_rate**2 + self._effort**2
        first = np.where(known, self._speed_std, NO_SPEED_STD) ** 2
        self._covariance = np.zeros((self._axles, 2, 2))
        self._covariance[:, 0, 0], self._covariance[:, 1, 1] = first, self._prior_variance
        rest = speed.copy()
        rest[0] = np.nan
        return rest

    def _filtered(self, steps: FloatArray, speed: FloatArray, effort: FloatArray) -> AdhesionForce:
        force, std = np.empty((2, *speed.shape))
        # What was handed out as state or result stays as it was.
        self._mean, self._covariance = self._mean.copy(), self._covariance.copy()
        self._effort = self._effort.copy()
        _observe(
            steps, speed, effort, self._rotating_mass, self._speed_std**2, self._force_rate**2,
            self._mean, self._covariance, self._effort, force, std,
        )  # fmt: skip
        return AdhesionForce(force, std)

    def _smoothed(self, steps: FloatArray, speed: FloatArray, effort: FloatArray) -> AdhesionForce:
        effort = _held(np.concatenate((self._effort[None], effort)))
        shift = np.zeros((*speed.shape, 2))
        shift[:, :, 0] = (0.5 * steps / self._rotating_mass)[:, None] * (effort[1:] + effort[:-1])
        transition, noise = random_walk_slope(steps, self._force_rate, -1.0 / self._rotating_mass)
        model = LinearGaussian(transition, noise, np.array([[[1.0, 0.0]]]), shift=shift)
        found = model.smooth(speed[:, :, None], self._speed_std**2, self._mean, self._covariance)
        return AdhesionForce(found.means[:, :, 1].copy(), found.std[:, :, 1])

    def result(self) -> EstimatorResult:
        """Force of each axle now, signed like the effort [N].

        It is valid where the wheel speeds determine the force of every axle: a speed that is
        missing for long leaves its force unknown. The excitation is the share of the force's first
        standard deviation that they removed, of the axle where it is least.
        """
        excitation, variance = 0.0, self._covariance[:, 1, 1]
        if self._samples:
            left = np.sqrt(np.max(variance / self._prior_variance))
            excitation = float(np.clip(1.0 - left, 0.0, 1.0))
        return EstimatorResult(
            estimate=self._mean[:, 1].copy(),
            covariance=np.diag(variance),
            valid=excitation >= CALIBRATED,
            excitation=excitation,
            samples=self._samples,
            resets=self._resets,
        )


def smoothed_force(
    time: FloatArray,
    wheel_speed: FloatArray,
    wheel_effort: FloatArray,
    rotating_mass: float,
    speed_std: float,
    force_rate: float,
) -> AdhesionForce:
    """Adhesion force with past and future samples: no lag, for analyses of a recorded trip.

    Parameters
    ----------
    time : (n,) array [s]
    wheel_speed, wheel_effort : (n, axles) array [m/s], [N]
    rotating_mass, speed_std, force_rate : float
        As for `AdhesionObserver`.

    Raises
    ------
    InputError
        If shapes do not fit or time does not increase.
    """
    axles = wheel_speed.shape[1] if wheel_speed.ndim == 2 else 1
    observer = AdhesionObserver(axles, rotating_mass, speed_std, force_rate)
    return observer._run(time, wheel_speed, wheel_effort, smooth=True)


def _clock(time: ArrayLike, speed: FloatArray, effort: FloatArray, last: float) -> FloatArray:
    clock = np.atleast_1d(np.asarray(time, dtype=np.float64))
    if clock.shape != speed.shape[:1] or effort.shape != speed.shape:
        raise InputError(
            f"adhesion observer: time {clock.shape}, speed {speed.shape}, effort {effort.shape}"
            " do not fit together"
        )
    steps = np.diff(clock) if np.isnan(last) else np.diff(clock, prepend=last)
    if not np.all(steps > 0.0):
        row = int(np.argmin(steps > 0.0))
        raise InputError(
            "adhesion observer: time must increase", place=f"row {row}", remedy="sort the samples"
        )
    return clock


def _held(values: FloatArray) -> FloatArray:
    """Rows in which a missing value is the last known one before; the first row has all."""
    known = np.where(np.isnan(values), 0, np.arange(len(values))[:, None])
    return np.take_along_axis(values, np.maximum.accumulate(known, axis=0), axis=0)


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _observe(
    steps: FloatArray,
    speed: FloatArray,
    effort: FloatArray,
    rotating_mass: float,
    speed_variance: float,
    force_variance: float,
    mean: FloatArray,
    covariance: FloatArray,
    held: FloatArray,
    force: FloatArray,
    std: FloatArray,
) -> None:
    """Filter speed and force of each axle.

    `mean`, `covariance` and `held` go on from sample to sample, `force` and `std` are filled.
    """
    for i in range(speed.shape[0]):
        turn = -steps[i] / rotating_mass
        q11 = force_variance * steps[i]
        q01 = 0.5 * turn * q11
        q00 = turn * turn * q11 / 3.0
        for s in range(speed.shape[1]):
            now = effort[i, s]
            if np.isnan(now):
                now = held[s]
            m1 = mean[s, 1]
            m0 = mean[s, 0] + turn * (m1 - 0.5 * (now + held[s]))
            held[s] = now
            p11 = covariance[s, 1, 1]
            p01 = covariance[s, 0, 1] + turn * p11
            p00 = covariance[s, 0, 0] + turn * (covariance[s, 0, 1] + p01) + q00
            p01 += q01
            p11 += q11
            measured = speed[i, s]
            if not np.isnan(measured):
                weight = 1.0 / (p00 + speed_variance)
                innovation = measured - m0
                m0 += p00 * weight * innovation
                m1 += p01 * weight * innovation
                p11 -= p01 * weight * p01
                p01 *= speed_variance * weight
                p00 *= speed_variance * weight
            mean[s, 0], mean[s, 1] = m0, m1
            covariance[s, 0, 0], covariance[s, 1, 1] = p00, p11
            covariance[s, 0, 1] = covariance[s, 1, 0] = p01
            force[i, s] = m1
            std[i, s] = np.sqrt(p11)


# ------------------------------------------------------------------------------------------- slip


SLOPE_RATE = 0.005
"""How fast what is not known of the efforts, over mass, may wander [m/s² per s^0.5], where the
friction brake is recorded: errors of resistance, gradient and mass are left."""

SLOPE_RATE_WITHOUT_BRAKE = 0.05
"""The same where the friction brake is not recorded and has to be found as well."""

CREEP_PER_ADHESION = 5.0
"""Creep speed over adhesion in use [m/s] that a wheel without slip may have, on wet rail; Zhao et
al. (2025), eq. (10)."""

CREEP_TIME = 5.0
"""Time over which creep stays the same [s]."""

HOLDING_GATE = 1.0
"""A wheel further than this from the expected train speed [m/s] is left out."""

HOLDING_STDS = 4.0
"""A wheel is left out only beyond this many standard deviations of the expected speed, too."""

UNKNOWN_SLOPE = 0.2
"""Standard deviation of what is not known of the efforts, over mass, at first [m/s²]."""

UNKNOWN_SPEED = 100.0
"""Standard deviation of the speed at first [m/s]."""

SLIP_THRESHOLD = 1.5
"""Slip speed [m/s] above which an axle is taken to slip, when the noise allows."""

NOISE_MULTIPLE = 5.0
"""The threshold is at least this many standard deviations of the slip speed."""

CONFIRMATION = 2
"""Samples in a row above the threshold before an axle is taken to slip."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SlipResult(EstimatorResult):
    """Slip after the samples so far.

    Attributes
    ----------
    estimate : (axles,) array [m/s]
        Slip speed of the last sample; NaN where it was missing.
    covariance : (axles, axles) array [m²/s²]
    slipping : (axles,) bool array
        Whether each axle slips now.
    valid : bool
        Whether every axle was seen often enough to confirm slip, and in the last sample.
    excitation : float
        One less the noise over the threshold where every axle was seen in the last sample, else 0.
    """

    slipping: BoolArray


class SlipDetector(Estimator):
    """Finds whether each axle slips: above the threshold twice running, until below half.

    Parameters
    ----------
    axles : int
    slip_std : float [m/s]
        Standard deviation of the slip speed; the threshold is
        ``max(1.5 m/s, 5 slip_std)``.

    Attributes
    ----------
    threshold : float [m/s]

    Raises
    ------
    InputError
        If there is no axle, or the noise is negative or no number.

    Examples
    --------
    >>> detector = SlipDetector(axles=2, slip_std=0.05)
    >>> detector.update([[0.1, 1.9], [0.0, 2.4]])  # two samples of both axles
    array([[False, False],
           [False,  True]])
    """

    kind, version = "trainlog/slip_detector", 2
    settings = ("axles", "slip_std")
    memory = ("above", "slipping", "seen", "last")

    def __init__(self, axles: int, slip_std: float) -> None:
        if axles < 1 or not 0.0 <= slip_std < np.inf:
            raise InputError(
                f"slip detector: needs axles and a noise of at least 0, got {axles}, {slip_std}"
            )
        self.threshold = max(SLIP_THRESHOLD, NOISE_MULTIPLE * slip_std)
        self._axles, self._slip_std = axles, float(slip_std)
        self.reset()

    def reset(self) -> None:
        """Forget everything: no axle slips."""
        self._above = np.zeros(self._axles, dtype=np.bool_)
        self._slipping = np.zeros(self._axles, dtype=np.bool_)
        self._seen = np.zeros(self._axles, dtype=np.int64)
        self._last = np.full(self._axles, np.nan)
        self._samples = 0
        self._resets += 1

    def update(self, slip_speed: ArrayLike) -> BoolArray:
        """Take one sample or the next samples in.

        Parameters
        ----------
        slip_speed : (n, axles) or (axles,) array [m/s]
            Wheel speed less train speed; NaN changes nothing.

        Returns
        -------
        (n, axles) bool array
            Whether the axle slips, as known at each sample: slip is confirmed one sample after
            the first above the threshold.

        Raises
        ------
        InputError
            If the shape does not fit the axles.
        """
        block = samples_of("slip speed", slip_speed, self._axles)
        found, self._above = _detect(block, self.threshold, self._above, self._slipping)
        if len(block):
            self._slipping = found[-1].copy()
            self._seen += np.count_nonzero(~np.isnan(block), axis=0)
            self._last = block[-1].copy()
            self._samples += len(block)
        return found

    def result(self) -> SlipResult:
        """Slip speed and slip of each axle now."""
        known = not np.any(np.isnan(self._last))
        return SlipResult(
            estimate=self._last.copy(),
            covariance=self._slip_std**2 * np.eye(self._axles),
            slipping=self._slipping.copy(),
            valid=known and bool(np.all(self._seen >= CONFIRMATION)),
            excitation=1.0 - self._slip_std / self.threshold if known else 0.0,
            samples=self._samples,
            resets=self._resets,
        )


def samples_of(what: str, values: ArrayLike, axles: int) -> FloatArray:
    """Samples of every axle, (n, axles), from a block or one sample; InputError if they do not fit.

    `what` is named in the message.
    """
    block = np.ascontiguousarray(values, dtype=np.float64)
    if block.shape == (axles,):
        block = block[None, :]
    if block.ndim != 2 or block.shape[1] != axles:
        raise InputError(f"{what}: needs shape (samples, {axles}), got {block.shape}")
    return block


def _detect(
    slip: FloatArray, threshold: float, above: BoolArray, slipping: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """Slip of each axle at each sample, (n, axles), and whether it was above the threshold last."""
    found, above = np.empty(slip.shape, dtype=np.bool_), above.copy()
    for axle in range(slip.shape[1]):
        known = np.flatnonzero(~np.isnan(slip[:, axle]))
        size = np.abs(slip[known, axle])
        high = np.concatenate((above[axle : axle + 1], size > threshold))
        begins, ends = high[1:] & high[:-1], size < 0.5 * threshold
        # The last beginning or end before each sample decides; before the first it is as it was.
        changes = np.concatenate(([0], known[begins | ends] + 1))
        states = np.concatenate((slipping[axle : axle + 1], begins[begins | ends]))
        at = np.searchsorted(changes, np.arange(1, len(slip) + 1), side="right") - 1
        found[:, axle] = states[at]
        above[axle] = high[-1]
    return found, above


@dataclass(frozen=True, slots=True)
class TrainSpeed:
    """Speed over ground and its standard deviation, (n,) arrays [m/s]."""

    speed: FloatArray
    std: FloatArray


def impulse(
    time: FloatArray,
    wheel_speed: FloatArray,
    wheel_effort: FloatArray,
    other_effort: FloatArray,
    rotating_mass: float,
) -> FloatArray:
    """Momentum that the efforts gave to the train since the first sample, less the axles' own.

    Parameters
    ----------
    time : (n,) array [s]
    wheel_speed, wheel_effort : (n, axles) array [m/s], [N]
        Without NaN.
    other_effort : (n,) array [N]
        Efforts on the train besides, negative in braking.
    rotating_mass : float [kg]
        Of one axle.

    Returns
    -------
    (n,) array [N s]

    Examples
    --------
    Half of the effort goes into the rail, half turns the wheel faster:

    >>> import numpy as np
    >>> impulse(np.array([0.0, 2.0]), np.array([[10.0], [14.0]]), np.full((2, 1), 8e3),
    ...         np.zeros(2), rotating_mass=2e3)
    array([   0., 8000.])
    """
    effort = wheel_effort.sum(axis=1) + other_effort
    given = np.concatenate(([0.0], np.cumsum(0.5 * (effort[1:] + effort[:-1]) * np.diff(time))))
    kept = rotating_mass * (wheel_speed - wheel_speed[0]).sum(axis=1)
    return np.asarray(given - kept)


def train_speed(
    time: FloatArray,
    wheel_speed: FloatArray,
    adhesion: FloatArray,
    wheel_std: float,
    gained: FloatArray,
    reference: FloatArray,
    reference_std: FloatArray,
    slope_rate: float = SLOPE_RATE,
) -> TrainSpeed:
    """Smoothed train speed.

    Parameters
    ----------
    time : (n,) array [s]
    wheel_speed : (n, axles) array [m/s]
        Corrected for the wheel diameters; NaN where missing.
    adhesion : (n, axles) array
        In use.
    wheel_std : float [m/s]
    gained : (n,) array [m/s]
        `impulse` over the train's mass.
    reference, reference_std : (n,) array [m/s]
        Satellite speed at the samples where there is one, else NaN.
    slope_rate : float [m/s^1.5]
        `SLOPE_RATE` or `SLOPE_RATE_WITHOUT_BRAKE`.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(0.0, 20.0, 0.1)  # s
    >>> speed = 5.0 + 0.3 * time  # m/s; both wheels slip for 2 s
    >>> wheels = np.column_stack([speed, speed]) + 3.0 * ((time > 8.0) & (time < 10.0))[:, None]
    >>> unknown = np.full(time.size, np.nan)
    >>> found = train_speed(time, wheels, 0.02 * np.ones(wheels.shape), 0.03, 0.3 * time,
    ...                     unknown, unknown)
    >>> print(f"{np.abs(found.speed - speed).max():.3f} m/s")
    0.000 m/s
    """
    if time.size == 0:
        return TrainSpeed(np.empty(0), np.empty(0))
    steps = np.diff(time, prepend=time[0])
    sampling = float(np.median(steps[1:])) if time.size > 1 else 1.0
    creep = wheel_std + CREEP_PER_ADHESION * np.abs(adhesion)
    known = np.column_stack([reference, wheel_speed]) - gained[:, None]
    variances = np.column_stack([reference_std, creep * np.sqrt(max(CREEP_TIME / sampling, 1.0))])
    variances **= 2
    known[np.isnan(variances)] = np.nan
    gate = np.tile([HOLDING_GATE, HOLDING_STDS], (known.shape[1], 1))
    gate[0] = np.inf
    row = np.tile([1.0, 0.0], (1, known.shape[1], 1))
    model = LinearGaussian(*random_walk_slope(steps, slope_rate), row, gate=gate)
    start = np.diag([UNKNOWN_SPEED**2, UNKNOWN_SLOPE**2])
    found = model.smooth(known, variances, np.zeros(2), start)
    return TrainSpeed(found.means[:, 0] + gained, found.std[:, 0])

"""Adhesion force of the powered axles, sample by sample and over a whole trip.

The force between wheel and rail is the unknown load of a known rotating mass. Everything is
referred to the wheel rim: a powered axle is a mass ``J`` [kg] (its inertia over the wheel radius
squared) that moves at the circumferential speed ``w`` [m/s], driven by the effort ``T`` [N] of its
motor and held by the adhesion force ``F`` [N]; Zhao et al. (2025), eqs. (4)-(9), become
``J dw/dt = T - F``. F wanders as a Brownian motion: a linear-Gaussian model of two states, which
`AdhesionObserver` filters and `smoothed_force` smooths. The smoother is that of
`estimators.linear_gaussian`; the filter is written out for the two states, all axles of a sample in
one pass, which is ten times as fast.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from estimators.interface import CALIBRATED, Estimator, EstimatorResult
from estimators.linear_gaussian import LinearGaussian, random_walk_slope
from estimators.slip import samples_of
from trainlog.arrays import FloatArray
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

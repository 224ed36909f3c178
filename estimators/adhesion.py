"""Adhesion of the powered axles, sample by sample.

A disturbance observer sees the force between wheel and rail as the unknown load of a known
rotating mass. `smoothed_force` is the observer run forwards and backwards over a recorded trip: no
lag, for analyses that need not be causal.

Everything is referred to the wheel rim: a powered axle is a mass ``J`` [kg] (its inertia over the
wheel radius squared) that moves at the circumferential speed ``w`` [m/s], driven by the effort
``T`` [N] of its motor and held by the adhesion force ``F`` [N]: paper 003, eq. (4)-(9) become
``J dw/dt = T - F``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from estimators.interface import (
    CALIBRATED,
    array_of,
    check_state,
    count_of,
    number_of,
    saved_state,
)
from estimators.slip import samples_of
from trainlog.errors import InputError

FloatArray = NDArray[np.float64]

STATE_KIND, STATE_VERSION = "trainlog/adhesion_observer", 1
"""Of a saved state; the version is raised when its meaning changes."""


@dataclass(frozen=True, slots=True)
class AdhesionForce:
    """Force between wheel and rail, signed like the effort, and its standard deviation [N]."""

    force: FloatArray
    std: FloatArray


@dataclass(frozen=True, eq=False)
class AdhesionResult:
    """What the observer knows after the samples so far.

    Attributes
    ----------
    estimate : (axles,) array [N]
        Force between wheel and rail of each axle, signed like the effort.
    covariance : (axles, axles) array [N²]
        NaN on the diagonal before the first sample.
    valid : bool
        Whether the wheel speeds determine the force of every axle: a speed that is missing for
        long leaves its force unknown.
    excitation : float
        Share of the standard deviation that the force began with which the wheel speeds removed,
        of the axle that they tell least about.
    samples, resets : int
        Samples since the last reset; resets so far.
    """

    estimate: FloatArray
    covariance: FloatArray
    valid: bool
    excitation: float
    samples: int
    resets: int


class AdhesionObserver:
    """Disturbance observer for the adhesion force of each axle: a Kalman filter.

    The state of an axle is its wheel speed and the adhesion force, which wanders as a Brownian
    motion: ``J dw/dt = T - F``, ``dF = force_rate dB``. The effort is taken as linear between two
    samples, so speed and effort of one row must belong to the same instant: one sample of
    misalignment doubles the error.

    Parameters
    ----------
    axles : int
    rotating_mass : float [kg]
        Inertia of one axle with its motor over the wheel radius squared.
    speed_std : float [m/s]
        Noise of the wheel speed.
    force_rate : float [N/s^0.5]
        How fast the adhesion force may wander.
    """

    def __init__(
        self, axles: int, rotating_mass: float, speed_std: float, force_rate: float
    ) -> None:
        check_observer(rotating_mass, speed_std, force_rate)
        if axles < 1:
            raise InputError(f"adhesion observer: needs axles, got {axles}")
        self._axles = axles
        self._model = (float(rotating_mass), float(speed_std), float(force_rate))
        self._resets = -1
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next sample starts anew."""
        self._mean = np.zeros((self._axles, 2))
        self._covariance = np.full((self._axles, 3), np.nan)
        self._prior_variance = np.full(self._axles, np.nan)
        self._time = np.nan
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
            (n, axles) arrays, as known at each sample.

        Raises
        ------
        InputError
            If shapes do not fit or time does not increase.
        """
        speed = samples_of("wheel speed", wheel_speed, self._axles)
        effort = samples_of("wheel effort", wheel_effort, self._axles).copy()
        clock = _clock(time, speed, effort, self._time)
        if clock.size == 0:
            return AdhesionForce(np.empty((0, self._axles)), np.empty((0, self._axles)))
        means, covariances = _filter(
            clock, speed, effort, *self._model,
            self._time, self._effort, self._mean, self._covariance,
        )  # fmt: skip
        if self._samples == 0:
            self._prior_variance = covariances[0, :, 2].copy()
        self._time = float(clock[-1])
        self._samples += clock.size
        return AdhesionForce(means[:, :, 1], np.sqrt(covariances[:, :, 2]))

    def result(self) -> AdhesionResult:
        """Force of each axle now."""
        excitation = 0.0
        if self._samples:
            left = np.sqrt(np.max(self._covariance[:, 2] / self._prior_variance))
            excitation = float(np.clip(1.0 - left, 0.0, 1.0))
        return AdhesionResult(
            estimate=self._mean[:, 1].copy(),
            covariance=np.diag(self._covariance[:, 2]),
            valid=excitation >= CALIBRATED,
            excitation=excitation,
            samples=self._samples,
            resets=self._resets,
        )

    def state(self) -> dict[str, Any]:
        """Everything needed to go on later, bit for bit; plain values that JSON can hold."""
        settings = dict(zip(_MODEL, self._model, strict=True))
        return saved_state(
            STATE_KIND,
            STATE_VERSION,
            settings | {name: getattr(self, f"_{name}") for name in (*_COUNTS, "time", *_ARRAYS)},
        )

    @classmethod
    def resume(cls, state: Mapping[str, Any]) -> Self:
        """The observer that `state` was taken from.

        Raises
        ------
        InputError
            If the state is of another kind or version, or incomplete.
        """
        check_state(state, STATE_KIND, STATE_VERSION, (*_MODEL, *_COUNTS, "time", *_ARRAYS))
        axles = count_of(state, "axles")
        observer = cls(axles, *(number_of(state, name) for name in _MODEL))
        observer._samples = count_of(state, "samples")
        observer._resets = count_of(state, "resets")
        observer._time = number_of(state, "time")
        for name, shape in _ARRAYS.items():
            setattr(observer, f"_{name}", array_of(state, name, (axles, *shape)))
        return observer


_MODEL = ("rotating_mass", "speed_std", "force_rate")
_COUNTS = ("axles", "samples", "resets")
_ARRAYS: dict[str, tuple[int, ...]] = {
    "mean": (2,),
    "covariance": (3,),
    "prior_variance": (),
    "effort": (),
}


def smoothed_force(
    time: FloatArray,
    wheel_speed: FloatArray,
    wheel_effort: FloatArray,
    rotating_mass: float,
    speed_std: float,
    force_rate: float,
) -> AdhesionForce:
    """Adhesion force with past and future samples: `AdhesionObserver`, then Rauch-Tung-Striebel.

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
    check_observer(rotating_mass, speed_std, force_rate)
    axles = wheel_speed.shape[1] if wheel_speed.ndim == 2 else 1
    speed = samples_of("wheel speed", wheel_speed, axles)
    held = samples_of("wheel effort", wheel_effort, axles).copy()
    clock = _clock(time, speed, held, np.nan)
    if clock.size == 0:
        return AdhesionForce(np.empty((0, axles)), np.empty((0, axles)))
    means, covariances = _filter(
        clock, speed, held, rotating_mass, speed_std, force_rate,
        np.nan, np.zeros(axles), np.zeros((axles, 2)), np.full((axles, 3), np.nan),
    )  # fmt: skip
    _smooth(clock, held, rotating_mass, force_rate, means, covariances)
    return AdhesionForce(means[:, :, 1].copy(), np.sqrt(covariances[:, :, 2]))


def check_observer(rotating_mass: float, speed_std: float, force_rate: float) -> None:
    """Refuse parameters that are not positive."""
    for name, value in (
        ("rotating mass", rotating_mass),
        ("speed noise", speed_std),
        ("force rate", force_rate),
    ):
        if not (value > 0.0 and np.isfinite(value)):
            raise InputError(f"adhesion observer: {name} must be positive, got {value}")


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


@njit(cache=True)
def _process_noise(step, rotating_mass, force_rate):  # type: ignore[no-untyped-def]
    """Covariance of (speed, force) that Brownian force adds in one step."""
    q = force_rate * force_rate
    return (
        q * step**3 / (3.0 * rotating_mass**2),
        -q * step**2 / (2.0 * rotating_mass),
        q * step,
    )


@njit(cache=True)
def _filter(  # type: ignore[no-untyped-def]
    time, speed, effort, rotating_mass, speed_std, force_rate,
    last_time, last_effort, mean, covariance,
):  # fmt: skip
    """Kalman filter of every axle; fills held efforts in and leaves the last state behind."""
    n, axles = speed.shape
    means = np.empty((n, axles, 2))
    covariances = np.empty((n, axles, 3))
    r = speed_std * speed_std
    for axle in range(axles):
        w, force = mean[axle]
        p_ww, p_wf, p_ff = covariance[axle]
        before, t = last_effort[axle], last_time
        for k in range(n):
            if np.isnan(effort[k, axle]):
                effort[k, axle] = before
            now, z = effort[k, axle], speed[k, axle]
            if np.isnan(p_ww):
                # The first sample: all effort is taken to go into the rail, with an uncertainty
                # as large as a second's wandering.
                w, force = (0.0 if np.isnan(z) else z), now
                p_ww = 1e4 if np.isnan(z) else r
                p_wf, p_ff = 0.0, force_rate * force_rate + now * now
            else:
                step = time[k] - t
                a = step / rotating_mass
                w += a * (0.5 * (before + now) - force)
                q_ww, q_wf, q_ff = _process_noise(step, rotating_mass, force_rate)
                p_ww += -2.0 * a * p_wf + a * a * p_ff + q_ww
                p_wf += -a * p_ff + q_wf
                p_ff += q_ff
                if not np.isnan(z):
                    g_w, g_f = p_ww / (p_ww + r), p_wf / (p_ww + r)
                    residual = z - w
                    w += g_w * residual
                    force += g_f * residual
                    p_ff -= g_f * p_wf
                    p_wf *= 1.0 - g_w
                    p_ww *= 1.0 - g_w
            before, t = now, time[k]
            means[k, axle, 0], means[k, axle, 1] = w, force
            covariances[k, axle, 0] = p_ww
            covariances[k, axle, 1] = p_wf
            covariances[k, axle, 2] = p_ff
        mean[axle, 0], mean[axle, 1] = w, force
        covariance[axle, 0], covariance[axle, 1], covariance[axle, 2] = p_ww, p_wf, p_ff
        last_effort[axle] = before
    return means, covariances


@njit(cache=True)
def _smooth(time, effort, rotating_mass, force_rate, means, covariances):  # type: ignore[no-untyped-def]
    """Rauch-Tung-Striebel recursion, in place."""
    n, axles = effort.shape
    for axle in range(axles):
        for k in range(n - 2, -1, -1):
            step = time[k + 1] - time[k]
            a = step / rotating_mass
            w, force = means[k, axle]
            p_ww, p_wf, p_ff = covariances[k, axle]
            q_ww, q_wf, q_ff = _process_noise(step, rotating_mass, force_rate)
            # Prediction to k + 1 and its cross-covariance with the state at k.
            m_ww = p_ww - 2.0 * a * p_wf + a * a * p_ff + q_ww
            m_wf = p_wf - a * p_ff + q_wf
            m_ff = p_ff + q_ff
            c_ww, c_wf = p_ww - a * p_wf, p_wf
            c_fw, c_ff = p_wf - a * p_ff, p_ff
            det = m_ww * m_ff - m_wf * m_wf
            g_ww = (c_ww * m_ff - c_wf * m_wf) / det
            g_wf = (c_wf * m_ww - c_ww * m_wf) / det
            g_fw = (c_fw * m_ff - c_ff * m_wf) / det
            g_ff = (c_ff * m_ww - c_fw * m_wf) / det
            d_w = means[k + 1, axle, 0] - (
                w + a * (0.5 * (effort[k, axle] + effort[k + 1, axle]) - force)
            )
            d_f = means[k + 1, axle, 1] - force
            means[k, axle, 0] = w + g_ww * d_w + g_wf * d_f
            means[k, axle, 1] = force + g_fw * d_w + g_ff * d_f
            e_ww = covariances[k + 1, axle, 0] - m_ww
            e_wf = covariances[k + 1, axle, 1] - m_wf
            e_ff = covariances[k + 1, axle, 2] - m_ff
            covariances[k, axle, 0] = p_ww + (
                g_ww * g_ww * e_ww + 2.0 * g_ww * g_wf * e_wf + g_wf * g_wf * e_ff
            )
            covariances[k, axle, 1] = p_wf + (
                g_ww * g_fw * e_ww + (g_ww * g_ff + g_wf * g_fw) * e_wf + g_wf * g_ff * e_ff
            )
            covariances[k, axle, 2] = p_ff + (
                g_fw * g_fw * e_ww + 2.0 * g_fw * g_ff * e_wf + g_ff * g_ff * e_ff
            )

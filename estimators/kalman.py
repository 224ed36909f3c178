"""Smoothing of a train's motion: position, speed and acceleration with their uncertainty.

Kalman filter forward, Rauch-Tung-Striebel smoother backward, both filterpy's. Its loops take
about 60 microseconds a sample: 0.5 s for 7,500 samples, 1.3 s for 20,000.

References
----------
Singer, R. A. (1970), Estimating optimal tracking filter performance for manned maneuvering
targets, IEEE Trans. AES-6(4), eqs. (3)-(9): acceleration as a first-order Markov process.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import ArrayLike, NDArray

from trainlog.errors import InputError

FloatArray = NDArray[np.float64]

ACCELERATION_STD = 0.4
"""Standard deviation of a train's acceleration over a trip [m/s²]: stops at 0.5 to 1 m/s²,
between them long stretches near 0."""

ACCELERATION_TIME = 5.0
"""Correlation time of the acceleration [s]: between that of a brake application (1 s) and that of
a whole run-up (60 s)."""

NO_SPEED_STD = 50.0
"""Standard deviation of the speed [m/s] before the first sample."""

NO_POSITION_STD = 1e4
"""Standard deviation of the position [m] before the first one is measured."""


@dataclass(frozen=True, eq=False)
class SmoothedMotion:
    """A train's motion at the times of its samples; all (n,) arrays.

    Attributes
    ----------
    position, position_std : array [m]
        Chainage; the distance since the first sample if no position was given.
    speed, speed_std : array [m/s]
    acceleration, acceleration_std : array [m/s²]
    """

    position: FloatArray
    position_std: FloatArray
    speed: FloatArray
    speed_std: FloatArray
    acceleration: FloatArray
    acceleration_std: FloatArray


def smooth_motion(
    time: ArrayLike,
    speed: ArrayLike,
    speed_std: ArrayLike,
    position: ArrayLike | None = None,
    position_std: ArrayLike | None = None,
) -> SmoothedMotion:
    """Smooth measured speed, and position where there is one, over a whole trip.

    The motion is modelled as position, speed and a first-order Markov acceleration (Singer) of
    `ACCELERATION_STD` and `ACCELERATION_TIME`; the noise of the measurements as white. NaN marks
    a missing measurement; through an outage the model carries on and the standard deviations
    grow.

    Parameters
    ----------
    time : (n,) array [s]
        Strictly increasing; steps need not be equal.
    speed : (n,) array [m/s]
    speed_std : float or (n,) array [m/s]
    position : (n,) array [m], optional
    position_std : float or (n,) array [m], optional
        Needed with `position`.

    Returns
    -------
    SmoothedMotion

    Raises
    ------
    InputError
        If shapes do not fit, time does not increase, a standard deviation is not positive, or
        nothing was measured.
    """
    instants, values, variances = _checked(time, speed, speed_std, position, position_std)
    present = np.isfinite(values)
    steps = np.diff(instants, prepend=instants[0])
    transition, noise = _singer(steps)
    motion = KalmanFilter(dim_x=3, dim_z=2)
    motion.x, motion.P = _start(values, position is not None)
    # A row of zeros in H makes a missing measurement say nothing, exactly.
    observed = np.where(present[:, :, None], np.eye(2, 3), 0.0)
    measured = np.where(present, values, 0.0)[:, :, None]
    spread = np.where(present, variances, 1.0)[:, :, None] * np.eye(2)
    means, covariances, _, _ = motion.batch_filter(
        measured, Fs=transition, Qs=noise, Hs=observed, Rs=spread
    )
    means, covariances, _, _ = motion.rts_smoother(means, covariances, Fs=transition, Qs=noise)
    deviations = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    return SmoothedMotion(
        position=means[:, 0, 0],
        position_std=deviations[:, 0],
        speed=means[:, 1, 0],
        speed_std=deviations[:, 1],
        acceleration=means[:, 2, 0],
        acceleration_std=deviations[:, 2],
    )


def _checked(
    time: ArrayLike,
    speed: ArrayLike,
    speed_std: ArrayLike,
    position: ArrayLike | None,
    position_std: ArrayLike | None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (n,), measurements (n, 2) of position and speed, and their variances (n, 2)."""
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
    if (position is None) != (position_std is None):
        raise InputError("smoothing: position and position_std belong together")
    values = np.full((instants.size, 2), np.nan)
    variances = np.ones((instants.size, 2))
    for column, name, value, std in (
        (0, "position", position, position_std),
        (1, "speed", speed, speed_std),
    ):
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
    return instants, values, variances


def _start(values: FloatArray, has_position: bool) -> tuple[FloatArray, FloatArray]:
    """State and covariance before the first sample, weak unless position is only relative."""
    known = values[np.isfinite(values[:, 0]), 0]
    first = float(known[0]) if known.size else 0.0
    position_std = NO_POSITION_STD if has_position else 1e-3
    state = np.array([[first], [0.0], [0.0]])
    return state, np.diag(np.square([position_std, NO_SPEED_STD, ACCELERATION_STD]))


def _singer(steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Transition (n, 3, 3) and process noise (n, 3, 3) of Singer's model over each step [s].

    The noise is ``∫ g(u) g(u)ᵀ q du`` over the step, ``g`` the response to an impulse of jerk,
    by Gauss-Legendre quadrature: the closed form cancels to nothing at short steps.
    """
    transition = np.zeros((steps.size, 3, 3))
    transition[:, 0, 0] = transition[:, 1, 1] = 1.0
    transition[:, 0, 1] = steps
    transition[:, :, 2] = _impulse_response(steps)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    response = _impulse_response(0.5 * steps[:, None] * (1.0 + nodes))
    spectral_density = 2.0 * ACCELERATION_STD**2 / ACCELERATION_TIME
    noise = np.einsum("nqi,nqj,q,n->nij", response, response, weights, 0.5 * steps)
    return transition, spectral_density * noise


def _impulse_response(delay: FloatArray) -> FloatArray:
    """Position, speed and acceleration (..., 3) a `delay` [s] after a unit step of acceleration."""
    share = delay / ACCELERATION_TIME
    decay = -np.expm1(-share)
    return np.stack(
        [
            ACCELERATION_TIME**2 * (share - decay),
            ACCELERATION_TIME * decay,
            1.0 - decay,
        ],
        axis=-1,
    )

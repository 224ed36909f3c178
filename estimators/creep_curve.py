"""Adhesion characteristic during slip: its maximum and slope, with their uncertainty.

While an axle slips, each sample shows one point of the adhesion characteristic (creep curve) of the
rail beneath it: slip speed and adhesion in use. An unscented Kalman filter (filterpy) learns the
curve from them, and its smoother looks both ways. The curve is Pacejka's,

    mu(s) = D sin(C atan(B s)),    1 < C < 2,

whose maximum D, slip speed of the maximum and fall beyond it are independent. The states are their
unbounded images; the maximum wanders, because the rail changes along the way.

References
----------
Julier, S. J., Uhlmann, J. K. (1997), A new extension of the Kalman filter to nonlinear systems.
van der Merwe, R. (2004), Sigma-point Kalman filters, PhD thesis: the sigma points. Pacejka, H. B.
(2012), Tire and vehicle dynamics, ch. 4: the curve; used for rails as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from trainlog.arrays import FloatArray

PRIOR_MEAN = (np.log(0.15), np.log(1.5), 0.3)
"""Of the states: log maximum, log slip speed [m/s] of the maximum, logit of C - 1."""

PRIOR_STD = (0.7, 1.0, 1.0)

RATE = (0.08, 0.1, 0.1)
"""How fast the states may wander [1/s^0.5]."""

REPEATED = 3.0
"""Errors of the adhesion last for about as many samples: their variance counts so many times."""

FEWEST = 5
"""Samples from which a curve is estimated."""

FORM_STD = 0.004
"""Standard deviation of the slope [s/m] between this family of curves and others."""

LEAST_SLIP, LEAST_ADHESION = 0.05, 0.01
"""Slip speed [m/s] and adhesion below which a sample shows nothing of the curve."""


@dataclass(frozen=True, eq=False)
class CreepCurves:
    """Adhesion characteristic under an axle at each sample; (n,) arrays, NaN where not estimated.

    Attributes
    ----------
    maximum, maximum_std : array
        Maximum adhesion.
    adhesion : array
        In use, of the curve at the sample's slip speed.
    optimum : array [m/s]
        Slip speed of the maximum.
    slope, slope_std : array [s/m]
        Change of adhesion with slip speed at the sample's slip speed: positive below the maximum,
        negative beyond.
    """

    maximum: FloatArray
    maximum_std: FloatArray
    adhesion: FloatArray
    optimum: FloatArray
    slope: FloatArray
    slope_std: FloatArray


def estimate_creep_curve(
    time: FloatArray,
    slip_speed: FloatArray,
    adhesion: FloatArray,
    adhesion_std: float,
    slip_std: float,
) -> CreepCurves:
    """Estimate the adhesion characteristic from the samples of one slip.

    Parameters
    ----------
    time : (n,) array [s]
    slip_speed : (n,) array [m/s]
        Signed like the adhesion of this slip: positive.
    adhesion : (n,) array
        In use, positive; from `estimators.adhesion.smoothed_force`. Samples without (NaN) are left
        out.
    adhesion_std : float
    slip_std : float [m/s]

    Returns
    -------
    CreepCurves
        NaN throughout where fewer than `FEWEST` samples show the curve, or the filter diverges.

    Examples
    --------
    A rail with a maximum of 0.20 at 1.5 m/s:

    >>> import numpy as np
    >>> time = 0.1 * np.arange(20)
    >>> slip = np.concatenate([np.linspace(0.1, 4.0, 10), np.linspace(4.0, 0.1, 10)])
    >>> used = 0.20 * np.sin(1.4 * np.arctan(np.tan(np.pi / 2.8) / 1.5 * slip))
    >>> found = estimate_creep_curve(time, slip, used, adhesion_std=0.002, slip_std=0.02)
    >>> print(f"{found.maximum[9]:.2f} ± {found.maximum_std[9]:.2f}, {found.slope[9]:.3f} s/m")
    0.21 ± 0.01, -0.006 s/m
    """
    found = CreepCurves(*np.full((6, time.size), np.nan))
    use = np.flatnonzero((slip_speed > LEAST_SLIP) & (adhesion > LEAST_ADHESION))
    if use.size < FEWEST:
        return found
    try:
        states, covariances = _smoothed(
            np.diff(time[use], prepend=time[use[0]]), slip_speed[use], adhesion[use],
            adhesion_std, slip_std,
        )  # fmt: skip
    except np.linalg.LinAlgError:  # a covariance that is not positive definite: it diverged
        return found
    found.maximum[use] = np.exp(states[:, 0])
    found.maximum_std[use] = found.maximum[use] * np.sqrt(covariances[:, 0, 0])
    found.adhesion[use] = _adhesion(states, slip_speed[use])
    found.optimum[use] = np.exp(states[:, 1])
    found.slope[use] = _slope(states, slip_speed[use])
    # The slope's gradient, by central differences of its logarithmic states.
    small = 1e-4
    gradient = np.stack(
        [
            (_slope(states + step, slip_speed[use]) - _slope(states - step, slip_speed[use]))
            for step in small * np.eye(3)
        ],
        axis=1,
    ) / (2.0 * small)
    variance = np.einsum("ni,nij,nj->n", gradient, covariances, gradient)
    found.slope_std[use] = np.hypot(np.sqrt(variance), FORM_STD)
    return found


def _smoothed(
    steps: FloatArray,
    slip_speed: FloatArray,
    adhesion: FloatArray,
    adhesion_std: float,
    slip_std: float,
) -> tuple[FloatArray, FloatArray]:
    """Smoothed states (n, 3) and covariances (n, 3, 3)."""
    points = MerweScaledSigmaPoints(3, alpha=0.5, beta=2.0, kappa=0.0)
    # A step leaves the state as it is, but for its noise.
    ukf = UnscentedKalmanFilter(
        3, 1, 1.0, hx=_adhesion, fx=lambda state, _step: state, points=points
    )
    ukf.x, ukf.P = np.array(PRIOR_MEAN), np.diag(np.square(PRIOR_STD))
    states, covariances = np.empty((steps.size, 3)), np.empty((steps.size, 3, 3))
    noises = np.square(RATE) * steps[:, None]
    for k, slip in enumerate(slip_speed):
        ukf.Q = np.diag(noises[k])
        ukf.predict()
        # What an error of the slip speed adds grows with the slope there.
        added = (float(_slope(ukf.x, slip)) * slip_std) ** 2
        ukf.R[0, 0] = REPEATED * adhesion_std**2 + added
        ukf.update(adhesion[k], slip=slip)
        states[k], covariances[k] = ukf.x, ukf.P
    states, covariances, _ = ukf.rts_smoother(states, covariances, noises[:, :, None] * np.eye(3))
    return states, covariances


def _shape(state: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """D, C and B [s/m] of a state (..., 3)."""
    form = 1.0 + 1.0 / (1.0 + np.exp(-state[..., 2]))
    stiffness = np.tan(np.pi / (2.0 * form)) / np.exp(state[..., 1])
    return np.exp(state[..., 0]), form, stiffness


def _adhesion(state: FloatArray, slip: FloatArray | float) -> FloatArray:
    """Adhesion of the curves of states (..., 3) at slip speeds, (1,) or (n,)."""
    maximum, form, stiffness = _shape(state)
    return np.atleast_1d(maximum * np.sin(form * np.arctan(stiffness * slip)))


def _slope(state: FloatArray, slip: FloatArray | float) -> FloatArray:
    """Slope [s/m] of the curves of states (..., 3) at slip speeds."""
    maximum, form, stiffness = _shape(state)
    angle = np.cos(form * np.arctan(stiffness * slip))
    return np.asarray(maximum * angle * form * stiffness / (1.0 + (stiffness * slip) ** 2))

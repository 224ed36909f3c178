"""The drag curve's uncertainty: standard deviation at a speed, and a band for the whole curve.

References
----------
Sun, J., Loader, C. R. (1994), Simultaneous confidence bands for linear regression and smoothing,
Annals of Statistics 22(3), eq. (1.5): the tube formula for a curve on the sphere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import stdtr

FloatArray = NDArray[np.float64]

CONFIDENCE = 0.95
"""Of every band."""


def powers(speed: ArrayLike) -> FloatArray:
    """``(1, v, v²)`` (..., 3) at each speed [m/s]."""
    v = np.asarray(speed, dtype=np.float64)
    return np.stack([np.ones(v.shape), v, v**2], axis=-1)


def curve_std(covariance: FloatArray, speed: ArrayLike) -> FloatArray:
    """Standard deviation [N] of ``r0 + r1 v + r2 v²`` at each speed [m/s].

    Parameters
    ----------
    covariance : (3, 3) array
        Of r0, r1, r2.
    speed : array [m/s]
    """
    basis = powers(speed)
    return np.asarray(np.sqrt(np.einsum("...i,ij,...j->...", basis, covariance, basis)))


def band_factor(covariance: FloatArray, speeds: tuple[float, float], freedom: float) -> float:
    """How many standard deviations to either side hold the whole true curve in 95 of 100 cases.

    A band that covers each single speed with 95 % misses some part of the curve more often than
    that; this one does not, between the two `speeds`.

    Parameters
    ----------
    covariance : (3, 3) array
    speeds : (float, float) [m/s]
    freedom : float
        Degrees of freedom of the noise's estimate.
    """
    # The path of the normalised curve on the unit sphere.
    root = np.linalg.cholesky(covariance)
    path = powers(np.linspace(*speeds, 201)) @ root
    path /= np.linalg.norm(path, axis=1, keepdims=True)
    length = float(np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)))

    def missed(factor: float) -> float:
        tube = length / np.pi * (1.0 + factor**2 / freedom) ** (-0.5 * freedom)
        return float(tube + 2.0 * stdtr(freedom, -factor) - (1.0 - CONFIDENCE))

    return float(brentq(missed, 0.5, 200.0))

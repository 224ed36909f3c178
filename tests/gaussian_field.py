"""A reference for the map: one Gaussian field for all days, its mode and Laplace spread.

`solve_field` makes of these sums a Gaussian process over position for the logarithm of the maximum
adhesion, with the exponential covariance of the Ornstein-Uhlenbeck process: it is Markov, so on
equal bins the precision matrix is tridiagonal. An onset of slip measures the maximum (Gaussian);
adhesion used without slip only says that the maximum is at least that much (censored, Tobit: Tobin
1958, Econometrica 26(1)). The posterior is log-concave; Newton's method finds its mode and
Laplace's approximation its spread (Rasmussen and Williams, Gaussian Processes for Machine Learning,
2006, section 3.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dptsv, dpttrf
from scipy.special import log_ndtr

from estimators.condition_field import Prior
from trainlog.arrays import FloatArray

ITERATIONS = 50
TOLERANCE = 1e-10


@dataclass(frozen=True, slots=True)
class Field:
    """Posterior of the log maximum adhesion a bin.

    Attributes
    ----------
    mean, std : (n,) array
    events_std : (n,) array
        What the standard deviation would be from the onsets of slip alone.
    """

    mean: FloatArray
    std: FloatArray
    events_std: FloatArray


def solve_field(
    prior: Prior,
    bin_length: float,
    weight: FloatArray,
    weighted_log: FloatArray,
    censored: FloatArray,
    log_levels: FloatArray,
    censored_std: float,
    common: FloatArray | None = None,
) -> Field:
    """Mode and Laplace spread of the log maximum adhesion.

    Parameters
    ----------
    prior : Prior
    bin_length : float [m]
    weight, weighted_log : (n,) array
        Sum of the weights (inverse variances) of the onsets measured in each bin, and of weight
        times log adhesion.
    censored : (n, k) array
        How many trips showed that the maximum in the bin is at least each level.
    log_levels : (k,) array
    censored_std : float
        Standard deviation of one trip's log maximum adhesion about the field.
    common : (n,) array, optional
        Sum of the squared weights times the variances of what all onsets of a trip err by alike.

    Notes
    -----
    With the posterior covariance ``K`` of independent errors, an error of variance ``s_i²`` that
    trip i makes everywhere alike adds ``sum_i s_i² (K w_i)²`` to the variance, ``w_i`` being its
    weights by bin. ``K`` has no negative element, so that by Minkowski's inequality this is at most
    ``(K sqrt(sum_i s_i² w_i²))²``, which sums over trips give: that is added.
    """
    bins = weight.size
    diagonal, off = prior.precision(bins, bin_length)
    rows, columns = np.nonzero(censored)
    evidence = _Evidence(
        weight,
        weighted_log,
        rows,
        censored[rows, columns],
        log_levels[columns],
        censored_std,
    )
    f = np.full(bins, prior.mean)
    value, gradient, curvature = _log_posterior(f, prior.mean, diagonal, off, evidence)
    for _ in range(ITERATIONS):
        step = _solve(diagonal + curvature, off, gradient)
        scale = 1.0
        while True:
            trial = f + scale * step
            new = _log_posterior(trial, prior.mean, diagonal, off, evidence)
            if new[0] >= value - 1e-9 * abs(value) or scale < 1e-6:
                break
            scale *= 0.5
        f = trial
        value, gradient, curvature = new
        if np.max(np.abs(scale * step)) < TOLERANCE:
            break
    variance = _inverse_diagonal(diagonal + curvature, off)
    if common is not None:
        variance = variance + _solve(diagonal + curvature, off, np.sqrt(common)) ** 2
    return Field(
        mean=f,
        std=np.sqrt(variance),
        events_std=np.sqrt(_inverse_diagonal(diagonal + weight, off)),
    )


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Onsets by bin; censored entries as (bin, count, log level) triples."""

    weight: FloatArray
    weighted_log: FloatArray
    bin: NDArray[np.intp]
    count: FloatArray
    log_level: FloatArray
    censored_std: float


def _log_posterior(
    f: FloatArray, mean: float, diagonal: FloatArray, off: float, evidence: _Evidence
) -> tuple[float, FloatArray, FloatArray]:
    """Value, gradient and negative second derivative (likelihood only) at `f`."""
    d = f - mean
    pull = diagonal * d
    pull[:-1] += off * d[1:]
    pull[1:] += off * d[:-1]
    std = evidence.censored_std
    z = (f[evidence.bin] - evidence.log_level) / std
    log_phi = log_ndtr(z)
    # The hazard phi(z) / Phi(z), computed in logarithms so that it is right far in the tail.
    hazard = np.exp(-0.5 * z**2 - 0.5 * np.log(2.0 * np.pi) - log_phi)
    rise = np.bincount(evidence.bin, evidence.count * hazard, minlength=f.size) / std
    bend = np.bincount(evidence.bin, evidence.count * hazard * (hazard + z), minlength=f.size)
    value = float(
        np.sum(f * evidence.weighted_log - 0.5 * evidence.weight * f**2 - 0.5 * d * pull)
        + np.sum(evidence.count * log_phi)
    )
    gradient = evidence.weighted_log - evidence.weight * f + rise - pull
    return value, gradient, evidence.weight + bend / std**2


def _solve(diagonal: FloatArray, off: float, right: FloatArray) -> FloatArray:
    """Solution of a symmetric positive definite system with a constant off-diagonal."""
    return np.asarray(dptsv(diagonal, np.full(max(diagonal.size - 1, 1), off), right)[2])


def _inverse_diagonal(diagonal: FloatArray, off: float) -> FloatArray:
    """Diagonal of the inverse of a symmetric tridiagonal matrix, from the pivots of both ends."""
    beside = np.full(max(diagonal.size - 1, 1), off)
    forward, backward = dpttrf(diagonal, beside)[0], dpttrf(diagonal[::-1], beside)[0][::-1]
    return np.asarray(1.0 / (forward + backward - diagonal))

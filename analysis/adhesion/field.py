"""Maximum adhesion along a line from measured onsets of slip and from adhesion used without slip.

A Gaussian process over position for the logarithm of the maximum adhesion, with the exponential
covariance of the Ornstein-Uhlenbeck process: it is Markov, so on equal bins the precision matrix
is tridiagonal. An onset of slip measures the maximum (Gaussian); adhesion used without slip only
says that the maximum is at least that much (censored, Tobit: Tobin 1958, Econometrica 26(1)). The
posterior is log-concave; Newton's method finds its mode and Laplace's approximation its spread
(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 3.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import log_ndtr

FloatArray = NDArray[np.float64]

ITERATIONS = 50
TOLERANCE = 1e-10


@dataclass(frozen=True, slots=True)
class Prior:
    """What is believed of the log maximum adhesion before any evidence.

    Attributes
    ----------
    mean, std : float
        Of the log maximum adhesion of a bin.
    correlation_length : float [m]
        Distance over which the correlation falls to 1/e.
    """

    mean: float
    std: float
    correlation_length: float

    def precision(self, bins: int, bin_length: float) -> tuple[FloatArray, float]:
        """Diagonal and (constant) off-diagonal of the precision matrix over `bins` bins."""
        rho = np.exp(-bin_length / self.correlation_length)
        innovation = self.std**2 * (1.0 - rho**2)
        diagonal = np.full(bins, (1.0 + rho**2) / innovation)
        diagonal[[0, -1]] = 1.0 / innovation
        if bins == 1:
            diagonal[0] = 1.0 / self.std**2
        return diagonal, float(-rho / innovation)


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
    return Field(
        mean=f,
        std=np.sqrt(_inverse_diagonal(diagonal + curvature, off)),
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


@njit(cache=True)
def _solve(diagonal, off, right):  # type: ignore[no-untyped-def]
    """Solution of a symmetric positive definite tridiagonal system, by elimination."""
    n = diagonal.size
    pivot, found = diagonal.copy(), right.copy()
    for i in range(1, n):
        share = off / pivot[i - 1]
        pivot[i] -= share * off
        found[i] -= share * found[i - 1]
    found[n - 1] /= pivot[n - 1]
    for i in range(n - 2, -1, -1):
        found[i] = (found[i] - off * found[i + 1]) / pivot[i]
    return found


@njit(cache=True)
def _inverse_diagonal(diagonal, off):  # type: ignore[no-untyped-def]
    """Diagonal of the inverse of a symmetric tridiagonal matrix, from the pivots of both ends."""
    n = diagonal.size
    forward, backward = diagonal.copy(), diagonal.copy()
    for i in range(1, n):
        forward[i] -= off * off / forward[i - 1]
        backward[n - 1 - i] -= off * off / backward[n - i]
    return 1.0 / (forward + backward - diagonal)

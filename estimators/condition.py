"""What the onsets of slip of a line determine, were the field Gaussian.

With the exponential covariance of the Ornstein-Uhlenbeck process the field is Markov, so that on
equal bins the precision matrix is tridiagonal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dptsv, dpttrf

from trainlog.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Prior:
    """What is assumed of the log maximum adhesion before any evidence.

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


def onset_std(prior: Prior, bin_length: float, weight: FloatArray) -> FloatArray:
    """Standard deviation that the onsets of slip alone leave, by bin; (n,) array.

    Parameters
    ----------
    prior : Prior
    bin_length : float [m]
    weight : (n,) array
        Sum of the weights (inverse variances) of the onsets in each bin.
    """
    diagonal, off = prior.precision(weight.size, bin_length)
    return np.asarray(np.sqrt(_inverse_diagonal(diagonal + weight, off)))


def common_std(
    prior: Prior, bin_length: float, weight: FloatArray, common: FloatArray
) -> FloatArray:
    """Standard deviation from what all onsets of a trip err by alike, by bin; (n,) array.

    Parameters
    ----------
    prior : Prior
    bin_length : float [m]
    weight : (n,) array
    common : (n,) array
        Sum over the trips of the squared weights times the variances of that error.

    Notes
    -----
    With the posterior covariance ``K`` of independent errors, an error of variance ``s_i²`` that
    trip i makes everywhere alike adds ``sum_i s_i² (K w_i)²`` to the variance, ``w_i`` being its
    weights by bin. ``K`` has no negative element, so that by Minkowski's inequality this is at most
    ``(K sqrt(sum_i s_i² w_i²))²``, which sums over trips give.
    """
    diagonal, off = prior.precision(weight.size, bin_length)
    return _solve(diagonal + weight, off, np.sqrt(common))


def _solve(diagonal: FloatArray, off: float, right: FloatArray) -> FloatArray:
    """Solution of a symmetric positive definite system with a constant off-diagonal."""
    return np.asarray(dptsv(diagonal, np.full(max(diagonal.size - 1, 1), off), right)[2])


def _inverse_diagonal(diagonal: FloatArray, off: float) -> FloatArray:
    """Diagonal of the inverse of a symmetric tridiagonal matrix, from the pivots of both ends."""
    beside = np.full(max(diagonal.size - 1, 1), off)
    forward, backward = dpttrf(diagonal, beside)[0], dpttrf(diagonal[::-1], beside)[0][::-1]
    return np.asarray(1.0 / (forward + backward - diagonal))

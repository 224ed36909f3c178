"""Trips that differ: their mean, how much they differ, and the best estimate of each.

Each trip's parameters are a draw from a normal distribution around the mean, seen with that
trip's own covariance:

    single_i ~ N(mean, between),    value_i ~ N(single_i, variance_i).

`between` is found by restricted maximum likelihood with a weak prior, by expectation maximisation
in compiled sums over the trips; its steps, which shrink geometrically, are extrapolated.

References
----------
Laird, N. M., Ware, J. H. (1982), Random-effects models for longitudinal data, Biometrics 38(4),
eqs. (3.2)-(3.6).
Varadhan, R., Roland, C. (2008), Simple and globally convergent methods for accelerating the
convergence of any EM algorithm, Scandinavian Journal of Statistics 35(2), scheme S3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

ROUNDS = 200
"""Most rounds of the expectation maximisation, each three steps."""

TOLERANCE = 1e-9
"""Relative change of the variance between trips in a step that ends the search."""


@dataclass(frozen=True, eq=False)
class Effects:
    """What trips have in common, and each of them.

    Attributes
    ----------
    mean : (3,) array
    variance : (3, 3) array
        Of the mean.
    between : (3, 3) array
        Of one trip around the mean.
    single, single_variance : (k, 3), (k, 3, 3) array
        Each trip drawn towards the mean by as much as its own variance warrants.
    """

    mean: FloatArray
    variance: FloatArray
    between: FloatArray
    single: FloatArray
    single_variance: FloatArray


def random_effects(
    values: FloatArray, variances: FloatArray, expected: FloatArray, trust: float
) -> Effects:
    """Mean of trips that differ, and the best estimate of each.

    Parameters
    ----------
    values : (k, 3) array
        Of about the same size in every column; sums go over the trips as they stand.
    variances : (k, 3, 3) array
    expected : (3, 3) array
        Variance between trips that is expected beforehand.
    trust : float
        This expectation counts as much as so many trips.
    """
    between = expected.copy()
    for _ in range(ROUNDS):
        first = _step(values, variances, between, expected, trust)
        second = _step(values, variances, first, expected, trust)
        if np.max(np.abs(second - first)) <= TOLERANCE * np.max(np.abs(first)):
            between = second
            break
        change, bend = first - between, second - 2.0 * first + between
        length = -float(np.linalg.norm(change) / max(float(np.linalg.norm(bend)), 1e-300))
        leap = between - 2.0 * length * change + length**2 * bend
        # A leap that leaves the covariances is not made.
        sound = np.all(np.linalg.eigvalsh(leap) > 1e-6 * np.linalg.eigvalsh(second)[0])
        between = _step(values, variances, leap, expected, trust) if sound else second
    mean, variance = _mean(values, variances, between)
    single, single_variance = _single(values, variances, between, mean, variance)
    return Effects(mean, variance, between, single, single_variance)


def _step(
    values: FloatArray,
    variances: FloatArray,
    between: FloatArray,
    expected: FloatArray,
    trust: float,
) -> FloatArray:
    """One step of the expectation maximisation; Laird and Ware (1982), eq. (3.4)."""
    mean, variance = _mean(values, variances, between)
    total = _spread(values, variances, between, mean, variance)
    total = 0.5 * (total + total.T)
    return np.asarray((total + trust * expected) / (len(values) + trust))


def _mean(
    values: FloatArray, variances: FloatArray, between: FloatArray
) -> tuple[FloatArray, FloatArray]:
    information, pulled = _information(values, variances, between)
    variance = np.linalg.inv(information)
    variance = 0.5 * (variance + variance.T)
    return variance @ pulled, variance


@njit(cache=True, inline="always")  # type: ignore[untyped-decorator]
def _weight(variance: FloatArray, between: FloatArray) -> tuple[float, ...]:
    """Upper triangle of the inverse of ``variance + between``, by its cofactors."""
    a, b = variance[0, 0] + between[0, 0], variance[0, 1] + between[0, 1]
    c = variance[0, 2] + between[0, 2]
    d, e = variance[1, 1] + between[1, 1], variance[1, 2] + between[1, 2]
    f = variance[2, 2] + between[2, 2]
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * first + b * second + c * third)
    return (
        first * scale,
        second * scale,
        third * scale,
        (a * f - c * c) * scale,
        (b * c - a * e) * scale,
        (a * d - b * b) * scale,
    )


@njit(cache=True)  # type: ignore[untyped-decorator]
def _information(
    values: FloatArray, variances: FloatArray, between: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Sums over the trips of their weights and of their weighted values."""
    total, pulled = np.zeros(6), np.zeros(3)
    for k in range(len(values)):
        a, b, c, d, e, f = _weight(variances[k], between)
        x, y, z = values[k, 0], values[k, 1], values[k, 2]
        total[0] += a
        total[1] += b
        total[2] += c
        total[3] += d
        total[4] += e
        total[5] += f
        pulled[0] += a * x + b * y + c * z
        pulled[1] += b * x + d * y + e * z
        pulled[2] += c * x + e * y + f * z
    return _full(total), pulled


@njit(cache=True)  # type: ignore[untyped-decorator]
def _spread(
    values: FloatArray,
    variances: FloatArray,
    between: FloatArray,
    mean: FloatArray,
    variance: FloatArray,
) -> FloatArray:
    """Sum over the trips of the expected square of their distance from the mean.

    With w the weight of a trip, it is ``between + between s between`` where
    ``s = w d d' w - w + w variance w`` and d is the value less the mean.
    """
    total = np.zeros(6)
    p, q, r = variance[0, 0], variance[0, 1], variance[0, 2]
    s, t, u = variance[1, 1], variance[1, 2], variance[2, 2]
    for k in range(len(values)):
        a, b, c, d, e, f = _weight(variances[k], between)
        x, y, z = values[k, 0] - mean[0], values[k, 1] - mean[1], values[k, 2] - mean[2]
        g, h, i = a * x + b * y + c * z, b * x + d * y + e * z, c * x + e * y + f * z
        # Rows of w variance.
        a0, a1, a2 = a * p + b * q + c * r, a * q + b * s + c * t, a * r + b * t + c * u
        b0, b1, b2 = b * p + d * q + e * r, b * q + d * s + e * t, b * r + d * t + e * u
        c0, c1, c2 = c * p + e * q + f * r, c * q + e * s + f * t, c * r + e * t + f * u
        total[0] += g * g - a + a0 * a + a1 * b + a2 * c
        total[1] += g * h - b + a0 * b + a1 * d + a2 * e
        total[2] += g * i - c + a0 * c + a1 * e + a2 * f
        total[3] += h * h - d + b0 * b + b1 * d + b2 * e
        total[4] += h * i - e + b0 * c + b1 * e + b2 * f
        total[5] += i * i - f + c0 * c + c1 * e + c2 * f
    out: FloatArray = len(values) * between + between @ _full(total) @ between
    return out


@njit(cache=True)  # type: ignore[untyped-decorator]
def _full(triangle: FloatArray) -> FloatArray:
    """The symmetric matrix of which this is the upper triangle, row by row."""
    out = np.empty((3, 3))
    out[0, 0], out[1, 1], out[2, 2] = triangle[0], triangle[3], triangle[5]
    out[0, 1] = out[1, 0] = triangle[1]
    out[0, 2] = out[2, 0] = triangle[2]
    out[1, 2] = out[2, 1] = triangle[4]
    return out


@njit(cache=True)  # type: ignore[untyped-decorator]
def _single(
    values: FloatArray,
    variances: FloatArray,
    between: FloatArray,
    mean: FloatArray,
    variance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Each trip drawn towards the mean, and its variance; Laird and Ware (1982), eq. (3.2)."""
    count, triangle = len(values), np.empty(6)
    single, single_variance = np.empty((count, 3)), np.empty((count, 3, 3))
    one = np.eye(3)
    for k in range(count):
        for n, entry in enumerate(_weight(variances[k], between)):
            triangle[n] = entry
        gain = between @ _full(triangle)
        rest = one - gain
        single[k] = mean + gain @ (values[k] - mean)
        found = between - gain @ between + rest @ variance @ rest.T
        single_variance[k] = 0.5 * (found + found.T)
    return single, single_variance

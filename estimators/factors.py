"""Updates of a covariance that is kept as ``P = U D Uᵀ``; those of each sample compiled, in place.

U is unit upper triangular and D diagonal and positive: whatever is done to the factors here, the
covariance stays positive definite. Sums of positive terms only, products and quotients of positive
ones; no difference of covariances is ever taken.

References
----------
Bierman, G. J. (1977), Factorization Methods for Discrete Sequential Estimation, ch. V (measurement
update) and ch. VI (time update).
Agee, W. S. and Turner, R. H. (1972), Triangular decomposition of a positive definite matrix plus a
symmetric dyad, White Sands Missile Range, TR-38.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numba import njit

from trainlog.arrays import FloatArray


@njit(inline="always")  # type: ignore[untyped-decorator]
def measure(
    size: int,
    estimate: FloatArray,
    upper: FloatArray,
    diagonal: FloatArray,
    gain: FloatArray,
    row: FloatArray,
    innovation: float,
    variance: float,
) -> None:
    """Bierman's update of the factors and the estimate by one sample of `variance`.

    `gain` (p,) is scratch.
    """
    tiny = np.finfo(estimate.dtype).tiny
    before = variance
    inverse = 1.0 / before
    for j in range(size):
        # f = Uᵀ x, component j; the columns to the right are not touched yet.
        f = row[j]
        for i in range(j):
            f += upper[i, j] * row[i]
        weighted = diagonal[j] * f
        alpha = before + f * weighted
        slope = -f * inverse
        inverse = 1.0 / alpha
        diagonal[j] = max(diagonal[j] * (before * inverse), tiny)
        for i in range(j):
            old = upper[i, j]
            upper[i, j] = old + slope * gain[i]
            gain[i] += weighted * old
        gain[j] = weighted
        before = alpha
    scale = innovation * inverse
    for i in range(size):
        estimate[i] += gain[i] * scale


@njit(inline="always")  # type: ignore[untyped-decorator]
def update_parameter(
    size: int,
    upper: FloatArray,
    diagonal: FloatArray,
    gain: FloatArray,
    which: int,
    information: float,
) -> None:
    """Bierman's update by a sample of the one parameter `which` that confirms its estimate.

    `information` is one over the variance of that sample, by which all is multiplied here.
    """
    tiny = np.finfo(diagonal.dtype).tiny
    before = 1.0
    inverse = 1.0
    for i in range(which):
        gain[i] = 0.0
    for j in range(which, size):
        f = information * upper[which, j]
        weighted = diagonal[j] * upper[which, j]
        alpha = before + f * weighted
        slope = -f * inverse
        inverse = 1.0 / alpha
        diagonal[j] = max(diagonal[j] * (before * inverse), tiny)
        for i in range(j):
            old = upper[i, j]
            upper[i, j] = old + slope * gain[i]
            gain[i] += weighted * old
        gain[j] = weighted
        before = alpha


@njit(inline="always")  # type: ignore[untyped-decorator]
def add_variance(
    upper: FloatArray,
    diagonal: FloatArray,
    dyad: FloatArray,
    which: int,
    variance: float,
) -> None:
    """Add `variance` to that of the one parameter `which`: Agee and Turner's rank-one update.

    `dyad` (p,) is scratch: the vector of the dyad, at first the unit vector `which`, so
    that the columns to the right of it stay as they are.
    """
    for i in range(which):
        dyad[i] = 0.0
    dyad[which] = 1.0
    for j in range(which, -1, -1):
        here = dyad[j]
        old = diagonal[j]
        inverse = 1.0 / (old + variance * here * here)
        diagonal[j] = old + variance * here * here
        share = variance * here * inverse
        for i in range(j):
            dyad[i] -= here * upper[i, j]
            upper[i, j] += share * dyad[i]
        variance *= old * inverse


@njit(inline="always")  # type: ignore[untyped-decorator]
def trace(size: int, upper: FloatArray, diagonal: FloatArray, weights: FloatArray) -> float:
    """Sum of the variances of the parameters, each times its weight."""
    total = 0.0
    for i in range(size):
        variance = diagonal[i]
        for j in range(i + 1, size):
            variance += upper[i, j] * upper[i, j] * diagonal[j]
        total += variance * weights[i]
    return total


@njit(inline="always")  # type: ignore[untyped-decorator]
def product(size: int, upper: FloatArray, diagonal: FloatArray, covariance: FloatArray) -> None:
    """Write ``U D Uᵀ`` into `covariance`."""
    for i in range(size):
        for j in range(i, size):
            total = upper[i, j] * diagonal[j]
            for m in range(j + 1, size):
                total += upper[i, m] * diagonal[m] * upper[j, m]
            covariance[i, j] = total
            covariance[j, i] = total


def transform(
    upper: FloatArray, diagonal: FloatArray, keep: FloatArray, added: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Factors after ``x <- keep * x + w``, ``w ~ (0, diag(added))``.

    The square roots of both parts stand side by side and are made triangular by reflections, from
    the last row up. Where `keep` is 0 a parameter starts anew, with the variance `added`.
    """
    roots = np.hstack([keep[:, None] * upper * np.sqrt(diagonal), np.diag(np.sqrt(added))])
    triangular = np.asarray(np.linalg.qr(roots[::-1].T, mode="r")).T[::-1, ::-1]
    scale = np.diagonal(triangular)
    floor = np.finfo(diagonal.dtype).tiny
    return np.ascontiguousarray(triangular / scale), np.maximum(scale**2, floor)


@cache
def recursion(size: int) -> Callable[..., FloatArray]:
    """The compiled recursion for `size` parameters, over a block in place.

    Loops of constant length compile to straight code, five times as fast. The compiled function
    returns the innovations, and records estimate and covariance after each sample where the last
    two arrays have rows.
    """

    def run(
        estimate: FloatArray,
        upper: FloatArray,
        diagonal: FloatArray,
        prior: FloatArray,
        walk: FloatArray,
        forgetting: float,
        rows: FloatArray,
        values: FloatArray,
        noise: FloatArray,
        estimate_after: FloatArray,
        covariance_after: FloatArray,
    ) -> FloatArray:
        innovations = np.empty_like(values)
        scratch, weights, leak = np.empty_like(prior), np.empty_like(prior), np.empty_like(prior)
        inverse = 1.0 / forgetting
        walks, forgets = False, forgetting < 1.0
        # Before the guard the covariance is at most (prior + walk) / forgetting: this information
        # brings it back to the prior. The trace bounds what it is in any direction.
        for i in range(size):
            weights[i] = 1.0 / prior[i]
            leak[i] = (prior[i] * (1.0 - forgetting) + walk[i]) / (prior[i] * (prior[i] + walk[i]))
            walks = walks or walk[i] > 0.0
        for k in range(len(rows)):
            if walks:
                for i in range(size):
                    add_variance(upper, diagonal, scratch, i, walk[i])
            if forgets:
                for i in range(size):
                    diagonal[i] *= inverse
            if (walks or forgets) and trace(size, upper, diagonal, weights) > 1.0:
                for i in range(size):
                    update_parameter(size, upper, diagonal, scratch, i, leak[i])
            # A variance that is the same for all samples comes once.
            variance = noise[k] if len(noise) > 1 else noise[0]
            innovation = values[k]
            for i in range(size):
                innovation -= rows[k, i] * estimate[i]
            innovations[k] = innovation
            measure(size, estimate, upper, diagonal, scratch, rows[k], innovation, variance)
            if k < estimate_after.shape[0]:
                for i in range(size):
                    estimate_after[k, i] = estimate[i]
                product(size, upper, diagonal, covariance_after[k])
        return innovations

    # Numba knows a cached function by its name: two sizes of one name, compiled by two processes,
    # are taken for each other in a third.
    run.__name__ = run.__qualname__ = f"recursion_{size}"
    compiled: Callable[..., FloatArray] = njit(cache=True)(run)
    return compiled

"""Updates a second of recursive least squares with three parameters, against peers in one run.

    python benchmarks/identification/benchmark_rls.py

All run the same samples, and give the same answer. The best of many runs counts, so that other
work on the machine does not.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from filterpy.kalman import KalmanFilter
from padasip.filters import FilterRLS
from statsmodels.regression.recursive_ls import RecursiveLS

from estimators.regression import RecursiveLeastSquares
from trainlog.arrays import FloatArray

PRIOR = np.array([100.0, 1.0, 0.1])
VARIANCE = 0.01
AGREEMENT = 1e-6
"""Relative difference of the answers up to which they are the same."""

COUNT = 20_000
"""Samples of a block; the peers take that many seconds for what takes the blocks milliseconds."""


def samples(*, constant: bool = False) -> tuple[FloatArray, FloatArray]:
    generator = np.random.default_rng(1)
    speed = np.full(COUNT, 30.0) if constant else generator.uniform(0.0, 55.0, COUNT)
    rows = np.column_stack([np.ones(COUNT), speed, speed**2])
    values = rows @ np.array([2.09, 0.039, 0.000675])
    return rows, values + np.sqrt(VARIANCE) * generator.standard_normal(COUNT)


def compiled(rows: FloatArray, values: FloatArray) -> FloatArray:
    recursion = RecursiveLeastSquares(PRIOR)
    recursion.update(rows, values, VARIANCE)
    return np.asarray(recursion.result().estimate)


def numpy_loop(rows: FloatArray, values: FloatArray) -> FloatArray:
    """The conventional recursion, Amirhosseini et al. (2024), eqs. (15)-(17)."""
    theta, covariance = np.zeros(3), np.diag(PRIOR**2)
    for row, value in zip(rows, values, strict=True):
        product = covariance @ row
        gain = product / (VARIANCE + row @ product)
        theta = theta + gain * (value - row @ theta)
        covariance = covariance - np.outer(gain, product)
    return theta


def filterpy_filter(rows: FloatArray, values: FloatArray) -> FloatArray:
    """A Kalman filter of constant parameters."""
    peer = KalmanFilter(dim_x=3, dim_z=1)
    peer.P, peer.Q, peer.R = np.diag(PRIOR**2), np.zeros((3, 3)), np.array([[VARIANCE]])
    peer.F = np.eye(3)
    for row, value in zip(rows, values, strict=True):
        peer.predict()
        peer.update(value, H=row[None, :])
    return np.asarray(peer.x[:, 0])


def padasip_filter(rows: FloatArray, values: FloatArray) -> FloatArray:
    """Its prior is a multiple of the unit matrix, so that the regressors are scaled."""
    peer = FilterRLS(3, mu=1.0, eps=VARIANCE, w="zeros")
    peer.run(values, rows * PRIOR)
    return np.asarray(peer.w * PRIOR)


def statsmodels_fit(rows: FloatArray, values: FloatArray) -> FloatArray:
    """As its users call it; the prior is diffuse, which 20,000 samples outweigh."""
    return np.asarray(RecursiveLS(values, rows).fit().params)


def statsmodels_filter(rows: FloatArray, values: FloatArray) -> FloatArray:
    """Its compiled filter alone, without the smoother and the results of its `fit`."""
    found = RecursiveLS(values, rows).filter(return_ssm=True)
    return np.asarray(found.filtered_state[:, -1])


PEERS = (numpy_loop, filterpy_filter, padasip_filter, statsmodels_fit, statsmodels_filter)


def rate(
    run: Callable[[FloatArray, FloatArray], object],
    rows: FloatArray,
    values: FloatArray,
    repeats: int,
) -> float:
    """Million updates a second: the best of several runs."""
    run(rows[:10], values[:10])
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        run(rows, values)
        times.append(time.perf_counter() - began)
    return len(values) / min(times) / 1e6


def check_answers() -> None:
    rows, values = samples()
    answer = compiled(rows, values)
    for peer in PEERS:
        difference = float(np.abs(peer(rows, values) / answer - 1.0).max())
        print(f"{peer.__name__}: same answer within {difference:.1e}")
        if difference > AGREEMENT:
            raise SystemExit(f"{peer.__name__} gives another answer")


def main() -> None:
    check_answers()
    walk = 1e-6 * PRIOR
    modes: dict[str, dict[str, object]] = {
        "plain": {},
        "forgetting 0.99": {"forgetting": 0.99},
        "random walk": {"random_walk_std": walk},
        "both": {"forgetting": 0.99, "random_walk_std": walk},
    }
    print(f"\n{'UD, compiled blocks':34s}{'million updates/s':>18s}")
    found: dict[str, float] = {}
    for constant in (False, True):
        for dtype in (np.float64, np.float32):
            rows, values = (each.astype(dtype) for each in samples(constant=constant))
            for mode, settings in modes.items():
                recursion = RecursiveLeastSquares(PRIOR, dtype=dtype, **settings)  # type: ignore[arg-type]
                name = f"{mode}, {dtype.__name__}{', constant' if constant else ''}"
                found[name] = rate(
                    lambda x, y, into=recursion: into.update(x, y, VARIANCE), rows, values, 500
                )
                print(f"{name:34s}{found[name]:18.1f}")
    best, slowest = found["plain, float64"], min(found.values())
    print(f"\n{'peer':34s}{'million updates/s':>18s}{'plain is faster':>18s}{'slowest mode':>14s}")
    for peer in PEERS:
        theirs = rate(peer, *samples(), repeats=3)
        print(f"{peer.__name__:34s}{theirs:18.4f}{best / theirs:18.0f}{slowest / theirs:14.0f}")


if __name__ == "__main__":
    main()

"""Updates a second of recursive least squares with three parameters, against peers in one run.

    python benchmarks/identification/benchmark_rls.py

The peers run fewer samples: they are that much slower. All give the same answer on those.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from estimators.rls import RecursiveLeastSquares

FloatArray = NDArray[np.float64]

PRIOR = np.array([100.0, 1.0, 0.1])
VARIANCE = 0.01


def samples(count: int) -> tuple[FloatArray, FloatArray]:
    generator = np.random.default_rng(1)
    speed = generator.uniform(0.0, 55.0, count)
    rows = np.column_stack([np.ones(count), speed, speed**2])
    values = rows @ np.array([2.09, 0.039, 0.000675])
    return rows, values + np.sqrt(VARIANCE) * generator.standard_normal(count)


def compiled(rows: FloatArray, values: FloatArray, **settings: object) -> FloatArray:
    recursion = RecursiveLeastSquares(PRIOR, **settings)  # type: ignore[arg-type]
    recursion.update(rows, values, VARIANCE)
    return np.asarray(recursion.result().estimate, dtype=np.float64)


def numpy_loop(rows: FloatArray, values: FloatArray) -> FloatArray:
    """The conventional recursion, paper 004, eqs. (15)-(17)."""
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


def rate(run: Callable[[FloatArray, FloatArray], FloatArray], count: int) -> float:
    """Million updates a second: the best of three runs."""
    rows, values = samples(count)
    run(rows[:10], values[:10])
    times = []
    for _ in range(3):
        began = time.perf_counter()
        run(rows, values)
        times.append(time.perf_counter() - began)
    return count / min(times) / 1e6


def main() -> None:
    rows, values = samples(20_000)
    answer = compiled(rows, values)
    for peer in (numpy_loop, filterpy_filter):
        difference = np.abs(peer(rows, values) / answer - 1.0).max()
        print(f"{peer.__name__}: same answer within {difference:.1e}")
    runs: dict[str, tuple[Callable[[FloatArray, FloatArray], FloatArray], int]] = {
        "UD, compiled blocks": (compiled, 1_000_000),
        "  float32": (lambda x, y: compiled(x, y, dtype=np.float32), 1_000_000),
        "  forgetting 0.99": (lambda x, y: compiled(x, y, forgetting=0.99), 1_000_000),
        "  random walk": (lambda x, y: compiled(x, y, random_walk_std=1e-6 * PRIOR), 1_000_000),
        "numpy loop": (numpy_loop, 20_000),
        "filterpy KalmanFilter": (filterpy_filter, 20_000),
    }
    rates = {name: rate(run, count) for name, (run, count) in runs.items()}
    best = rates["UD, compiled blocks"]
    print(f"\n{'':26s}{'million updates/s':>18s}{'slower by':>12s}")
    for name, found in rates.items():
        print(f"{name:26s}{found:18.3f}{best / found:12.1f}")


if __name__ == "__main__":
    main()

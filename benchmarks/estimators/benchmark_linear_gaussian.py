"""Samples a second of the linear-Gaussian smoother, beside filterpy in one run.

    python benchmarks/estimators/benchmark_linear_gaussian.py

A trip's speed and position at 10 Hz, smoothed with the motion model of five states. The peer is
filterpy's KalmanFilter with its `rts_smoother` over the same arrays; both give the same answer
(processor time, the best of some runs).
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from filterpy.kalman import KalmanFilter

from estimators.linear_gaussian import LinearGaussian
from estimators.motion import ACCELERATION_STD, LastingError, motion_model
from trainlog.arrays import FloatArray

COUNT = 5_000
STD = np.array([3.0, 0.1])
START = np.zeros(6)
SPREAD = np.diag(np.square([10.0, 50.0, ACCELERATION_STD, 1.0, 1.0, 1.0]))
LASTING = (LastingError(1.0), LastingError(0.1, of="speed"), LastingError(1.0, np.inf))


def samples() -> tuple[FloatArray, FloatArray]:
    """Steps [s], and position and speed as measured."""
    clock = 0.1 * np.arange(COUNT)
    speed = 20.0 + 10.0 * np.sin(clock / 40.0)
    position = 20.0 * clock + 400.0 * (1.0 - np.cos(clock / 40.0))
    noise = STD * np.random.default_rng(1).standard_normal((COUNT, 2))
    return np.diff(clock, prepend=clock[0]), np.column_stack([position, speed]) + noise


def observation() -> FloatArray:
    shown = np.zeros((1, 2, 6))
    shown[0, 0, 0] = shown[0, 1, 1] = 1.0
    return shown


def own(steps: FloatArray, measured: FloatArray) -> FloatArray:
    """The smoothed states, (n, 6)."""
    model = LinearGaussian(*motion_model(steps, errors=LASTING), observation())
    return model.smooth(measured, STD**2, START, SPREAD).means


def by_filterpy(steps: FloatArray, measured: FloatArray) -> FloatArray:
    """The same by filterpy."""
    transition, noise = motion_model(steps, errors=LASTING)
    peer = KalmanFilter(dim_x=6, dim_z=2)
    peer.x, peer.P, peer.H, peer.R = START.copy(), SPREAD.copy(), observation()[0], np.diag(STD**2)
    means, covariances, _, _ = peer.batch_filter(measured, Fs=list(transition), Qs=list(noise))
    smooth, *_ = peer.rts_smoother(means, covariances, list(transition), list(noise))
    return np.asarray(smooth)


def rate(run: Callable[[FloatArray, FloatArray], FloatArray], repeats: int) -> float:
    """Samples a second."""
    times = []
    for _ in range(repeats):
        began = time.process_time()
        run(*samples())
        times.append(time.process_time() - began)
    return COUNT / min(times)


def main() -> None:
    difference = np.abs(own(*samples()) - by_filterpy(*samples()))[:, :3].max()
    print(f"same position, speed and acceleration within {difference:.1e}")
    rates = {"compiled": rate(own, 10), "filterpy": rate(by_filterpy, 2)}
    for name, found in rates.items():
        print(f"{name:10s}{found:12.0f} samples a second")
    print(f"{rates['compiled'] / rates['filterpy']:.0f} times as many")


if __name__ == "__main__":
    main()

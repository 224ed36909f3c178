"""Axle-samples a second of the adhesion observer, beside filterpy in one run.

    python benchmarks/estimators/benchmark_adhesion_observer.py

Wheel speeds and efforts of four axles at 10 Hz with uneven steps and gaps. The peer is filterpy's
KalmanFilter, one an axle, with the same model; both give the same force (processor time, the best
of some runs; the peer over the first samples only). The time that the first call takes longer, with
an empty cache of numba, is that of compiling.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from filterpy.kalman import KalmanFilter

from estimators.adhesion import AdhesionObserver
from estimators.linear_gaussian import random_walk_slope
from trainlog.arrays import FloatArray

AXLES, FEW = 4, 2_000
ROTATING_MASS, SPEED_STD, FORCE_RATE = 1_500.0, 0.03, 20e3


def samples(count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time [s], wheel speeds [m/s] and wheel efforts [N]; one speed in a hundred is missing."""
    generator = np.random.default_rng(1)
    clock = np.cumsum(0.1 + 0.02 * generator.random(count))
    noise = generator.standard_normal((2, count, AXLES))
    speed = 20.0 + 5.0 * np.sin(clock / 40.0)[:, None] + SPEED_STD * noise[0]
    speed[generator.random(speed.shape) < 0.01] = np.nan
    return clock, speed, 30e3 * np.cos(clock / 40.0)[:, None] + 100.0 * noise[1]


def by_filterpy(clock: FloatArray, speed: FloatArray, effort: FloatArray) -> FloatArray:
    """Forces [N] by one KalmanFilter an axle."""
    steps = np.diff(clock)
    transition, noise = random_walk_slope(steps, FORCE_RATE, -1.0 / ROTATING_MASS)
    force = np.empty_like(speed)
    for axle in range(speed.shape[1]):
        peer = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
        first = effort[0, axle]
        peer.x = np.array([[np.nan_to_num(speed[0, axle])], [first]])
        peer.P = np.diag([SPEED_STD**2, FORCE_RATE**2 + first**2])
        peer.H, peer.R = np.array([[1.0, 0.0]]), np.array([[SPEED_STD**2]])
        force[0, axle] = first
        for i, step in enumerate(steps):
            mean = 0.5 * (effort[i, axle] + effort[i + 1, axle])
            turn = np.array([[step / ROTATING_MASS], [0.0]])
            peer.predict(u=np.array([[mean]]), B=turn, F=transition[i], Q=noise[i])
            measured = speed[i + 1, axle]
            peer.update(None if np.isnan(measured) else measured)
            force[i + 1, axle] = peer.x[1, 0]
    return force


def observed(clock: FloatArray, speed: FloatArray, effort: FloatArray) -> FloatArray:
    """The same by the observer."""
    observer = AdhesionObserver(AXLES, ROTATING_MASS, SPEED_STD, FORCE_RATE)
    return observer.update(clock, speed, effort).force


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=100_000)
    options = parser.parse_args()
    few, many = samples(FEW), samples(options.samples)
    for given in (few, many):
        given[1][0] = 20.0
    began = time.process_time()
    own = observed(*few)
    first = time.process_time() - began
    began = time.process_time()
    peer = by_filterpy(*few)
    slow = few[1].size / (time.process_time() - began)
    print(f"same force within {np.abs(own - peer).max() / np.abs(peer).max():.1e} of the largest")
    times = []
    for _ in range(20):
        began = time.process_time()
        observed(*many)
        times.append(time.process_time() - began)
    fast = many[1].size / min(times)
    print(f"first call {first:.2f} s")
    print(f"observer {fast / 1e6:8.1f} million axle-samples a second")
    print(f"filterpy {slow / 1e6:8.3f} million")
    print(f"{fast / slow:.0f} times as many")


if __name__ == "__main__":
    main()

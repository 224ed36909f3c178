"""Samples a second of the filter of running resistance, beside filterpy in one run.

    python benchmarks/estimators/benchmark_running_resistance.py

The peer is filterpy's ExtendedKalmanFilter over the same equations with a dense covariance; both
give the same answer on the trip of the identification study that they filter.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray

from analysis.resistance.recording import Recording
from estimators.running_resistance import RunningResistanceFilter
from estimators.running_resistance_recursion import FORCE_NOISE, UNIT_SPEED, UNKNOWN_SPEED
from trainlog.units import GRAVITY

sys.path.insert(0, str(Path(__file__).parents[1] / "identification"))
from monte_carlo import PAPER, Study, draw, recording

FloatArray = NDArray[np.float64]

MASS = Study().mass
CHAINAGE_STD, REACH, SPEED_STD = 10.0, 10.0, 0.03


def new() -> RunningResistanceFilter:
    return RunningResistanceFilter(MASS, 0.1 * MASS, PAPER, speeds=(10.0, 55.0))


class Peer(ExtendedKalmanFilter):  # type: ignore[misc]
    """The equation of motion for filterpy."""

    moved = 0.0

    def predict_x(self, u: float = 0) -> None:  # noqa: ARG002 - filterpy calls it so
        """Move by the equation of motion, which is not linear."""
        self.x[0, 0] = self.moved


def filterpy_filter(trip: Recording) -> FloatArray:
    fresh = new()
    peer = Peer(6, 1)
    peer.x, peer.P, peer.R = fresh.x[:, None], fresh.P, np.array([[SPEED_STD**2]])
    for k in range(trip.time.size):
        if k > 0 and trip.section[k] != trip.section[k - 1]:
            peer.x[1] = peer.P[1] = peer.P[:, 1] = 0.0
            peer.P[1, 1] = (0.5e-3 * GRAVITY) ** 2
        if k > 0 and trip.usable[k] and trip.usable[k - 1]:
            step = trip.time[k] - trip.time[k - 1]
            share = 0.5 * (trip.effort[k] + trip.effort[k - 1]) / MASS
            track = 0.5 * (trip.track[k] + trip.track[k - 1])
            slope = 0.5 * (trip.track_slope[k] + trip.track_slope[k - 1])
            x, s = peer.x[:, 0], peer.x[0, 0] / UNIT_SPEED
            given = x[2] * share - track - x[1] - x[3]
            s = (x[0] + 0.5 * step * (given - x[4] * s - x[5] * s**2)) / UNIT_SPEED
            peer.moved = x[0] + step * (given - x[4] * s - x[5] * s**2)
            peer.F = np.eye(6)
            peer.F[0, 0] -= step * (x[4] + 2.0 * x[5] * s) / UNIT_SPEED
            peer.F[0, 1:] = step * np.array([-1.0, share, -1.0, -s, -(s**2)])
            misplaced = slope**2 * 2.0 * REACH * CHAINAGE_STD**2 / max(x[0], 1.0)
            peer.Q = np.zeros((6, 6))
            peer.Q[0, 0] = (misplaced + FORCE_NOISE**2) * step
            peer.predict()
        elif k > 0:
            peer.P[0, 0] += UNKNOWN_SPEED**2
        peer.update(trip.speed[k], lambda _: np.eye(1, 6), lambda x: x[:1])
    return np.asarray(peer.x[:, 0])


def compiled(trip: Recording) -> FloatArray:
    estimator = new()
    estimator.update(
        trip.time,
        trip.speed,
        trip.effort,
        trip.track,
        trip.track_slope,
        trip.section,
        trip.usable,
    )
    return estimator.x


def main() -> None:
    trip = recording(draw(Study(), 1))
    std = np.sqrt(np.diag(new().P))
    difference = np.abs(compiled(trip) - filterpy_filter(trip)) / std
    print(f"same answer within {difference.max():.1e} of the prior's standard deviations")
    rates = {}
    for name, run, repeats in (("compiled", compiled, 5), ("filterpy", filterpy_filter, 2)):
        times = []
        for _ in range(repeats):
            began = time.process_time()
            run(trip)
            times.append(time.process_time() - began)
        rates[name] = trip.time.size / min(times)
        print(f"{name:10s}{rates[name] / 1e6:10.4f} million samples a second")
    print(f"{rates['compiled'] / rates['filterpy']:.0f} times as many")


if __name__ == "__main__":
    main()

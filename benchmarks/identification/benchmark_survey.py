"""Errors of the line that trips share: whether their mean is known as well as is stated.

    python benchmarks/identification/benchmark_survey.py [--series 24]

Each series is twelve simulated trips of the sample train over the sample line, whose gradients are
wrong by 0.1 per mille, the same for all of them. Of the fits' mean error in r0, r1 and r2 stands
the mean square in the metric of its covariance, with the line's errors shared and without: 1 if it
is honest, more if bands are too narrow. Single trips: how often the whole true curve from 18 km/h
to line speed lies in the 95 % band.
"""

from __future__ import annotations

import argparse

import numpy as np

from analysis.resistance import TripFit, fit_trip
from analysis.resistance.combination import shared_variance
from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import NotIdentifiableError
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.railway import RunningResistance
from trainlog.railway.resistance import basis
from trainlog.simulation import draw_scenarios, simulate


def in_band(fit: TripFit, true: RunningResistance) -> bool:
    """Whether the whole true curve lies in the band."""
    speed = np.linspace(5.0, fit.asked[1], 61)
    low, high = fit.band(speed)
    return bool(np.all((low <= true(speed)) & (true(speed) <= high)))


def judged(
    errors: FloatArray, variances: FloatArray, surveys: FloatArray, line: IntArray
) -> tuple[float, float]:
    """Mean square of the mean error in the metric of its variance: shared, and independent."""
    count = len(errors)
    mean = errors.mean(axis=0)
    apart = variances.sum(axis=0) / count**2
    shared = shared_variance(np.tile(np.eye(3) / count, (count, 1, 1)), surveys, line)
    with_shared, without = (
        float(mean @ np.linalg.solve(variance, mean)) / 3.0 for variance in (apart + shared, apart)
    )
    return with_shared, without


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--series", type=int, default=24)
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    nodes = basis(np.linspace(0.0, float(line.speed_limits.values.max()), 3))
    # Each over its usual size: values at three speeds are far better conditioned.
    nodes /= train.resistance(np.linspace(0.0, float(line.speed_limits.values.max()), 3))[:, None]
    found: dict[str, list[tuple[float, float]]] = {"forward": [], "reverse": [], "both": []}
    inside: list[bool] = []
    for seed in range(1, parser.parse_args().series + 1):
        fits, errors, forward = [], [], []
        for scenario in draw_scenarios(line, train, 12, seed):
            try:
                fit = fit_trip(simulate(scenario))
            except NotIdentifiableError:
                continue
            true = scenario.resistance
            inside.append(in_band(fit, true))
            fits.append(fit)
            errors.append(nodes @ (fit.beta - [true.r0, true.r1, true.r2]))
            forward.append(scenario.direction == "forward")
        way = np.array(forward)
        variances = nodes @ np.array([fit.covariance[:3, :3] for fit in fits]) @ nodes.T
        surveys = nodes @ np.array([fit.survey[:3, :3] for fit in fits]) @ nodes.T
        for name, kept in (("forward", way), ("reverse", ~way), ("both", way | True)):
            found[name].append(
                judged(
                    np.array(errors)[kept],
                    variances[kept],
                    surveys[kept],
                    way[kept].astype(np.int64),
                )
            )
    print("direction   shared  independent")
    for name, pairs in found.items():
        shared, apart = np.mean(pairs, axis=0)
        print(f"{name:10s}{shared:8.2f}{apart:13.2f}")
    print(f"whole curve in the band: {sum(inside)} of {len(inside)}")


if __name__ == "__main__":
    main()

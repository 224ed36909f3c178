"""Combining trips from their summaries: time and memory, beside the same sums in plain numpy.

    python benchmarks/identification/benchmark_combination.py [--trips 1000000]

Summaries are made up: curves that differ by 5 % from trip to trip, each with its own covariance,
loads of up to 24 t, powers that differ by 2 %. Both peers run the expectation maximisation of
Laird and Ware until it stands as still as ours does: one trip after the other on fewer trips, and
all trips at a time in stacked matrices. CPU time.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pandas as pd

from analysis.resistance import combine, parameter_set
from analysis.resistance.combination import BETWEEN_TRIPS, PRIOR_TRIPS, TOLERANCE, pooled
from trainlog.arrays import FloatArray
from trainlog.formats.summaries import (
    COLUMNS,
    COVARIANCE,
    PARAMETERS,
    read_summaries,
    write_summaries,
)
from trainlog.railway.resistance import basis

TOP = 35.0
COMMON = np.array([2400.0, 60.0, 11.5])


def made_up(count: int, seed: int = 1) -> pd.DataFrame:
    """Summaries of trips that never were."""
    generator = np.random.default_rng(seed)
    nodes = basis(np.linspace(0.0, TOP, 3))
    back = np.linalg.inv(nodes)
    curve = nodes @ COMMON
    size = curve * generator.uniform(0.01, 0.05, (count, 1))
    mixing = np.eye(3) + 0.3 * generator.standard_normal((count, 3, 3))
    roots = back @ (size[:, :, None] * mixing)
    covariance = np.zeros((count, 4, 4))
    covariance[:, :3, :3] = roots @ roots.transpose(0, 2, 1)
    covariance[:, 3, 3] = 100.0**2
    single = curve * (1.0 + 0.05 * generator.standard_normal((count, 3)))
    noise = np.einsum("kij,kj->ki", roots, generator.standard_normal((count, 3)))
    mass = 122e3 + generator.uniform(0.0, 24e3, count)
    limit = 2.6e6 * (1.0 - 0.02 * generator.standard_normal(count))
    values: dict[str, Any] = {
        column.name: {"text": "", "count": 100, "number": 1.0}[column.kind] for column in COLUMNS
    }
    values |= dict(zip(PARAMETERS, (*(single @ back.T + noise).T, mass), strict=True))
    rows, columns = np.triu_indices(4)
    values |= dict(zip(COVARIANCE, covariance[:, rows, columns].T, strict=True))
    values |= {
        "trip": [f"trip-{number:07d}" for number in range(count)],
        "sha256": [f"{number:064x}" for number in range(count)],
        "train": "unit",
        "software": "made up",
        "rotating_mass": 12e3,
        "max_power": np.where(generator.uniform(size=count) < 0.3, limit, np.nan),
        "asked_lowest": 10.0,
        "asked_highest": TOP,
        "speed_lowest": 5.0,
        "speed_highest": 34.0,
    }
    return pd.DataFrame(values)


def plain_loop(values: FloatArray, variances: FloatArray, expected: FloatArray) -> FloatArray:
    """The same sums, one trip after the other."""
    between = expected
    while True:
        weights = [np.linalg.inv(between + variance) for variance in variances]
        variance = np.linalg.inv(sum(weights))
        mean = variance @ sum(w @ value for w, value in zip(weights, values, strict=True))
        total = PRIOR_TRIPS * expected
        for weight, value in zip(weights, values, strict=True):
            gain = between @ weight
            effect = gain @ (value - mean)
            total = total + np.outer(effect, effect)
            total = total + between - gain @ between + gain @ variance @ gain.T
        previous, between = between, total / (len(values) + PRIOR_TRIPS)
        if np.max(np.abs(between - previous)) <= TOLERANCE * np.max(np.abs(previous)):
            return between


def stacked(values: FloatArray, variances: FloatArray, expected: FloatArray) -> FloatArray:
    """The same sums with all trips at a time."""
    between = expected
    while True:
        weight = np.linalg.inv(between + variances)
        variance = np.linalg.inv(weight.sum(axis=0))
        mean = variance @ np.einsum("kij,kj->i", weight, values)
        gain = between @ weight
        effect = np.einsum("kij,kj->ki", gain, values - mean)
        rest = between - gain @ between + gain @ variance @ gain.transpose(0, 2, 1)
        total = np.einsum("ki,kj->ij", effect, effect) + rest.sum(axis=0)
        previous = between
        between = (total + PRIOR_TRIPS * expected) / (len(values) + PRIOR_TRIPS)
        if np.max(np.abs(between - previous)) <= TOLERANCE * np.max(np.abs(previous)):
            return between


def ours_alone(values: FloatArray, variances: FloatArray, _expected: FloatArray) -> FloatArray:
    """As the product combines trips."""
    return pooled(values, variances).within


def timed(action: Callable[[], Any]) -> tuple[float, Any]:
    began = process_time()
    found = action()
    return process_time() - began, found


def memory() -> float:
    """Most memory so far [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trips", type=int, default=1_000_000)
    parser.add_argument("--fewer", type=int, default=1000)
    arguments = parser.parse_args()
    combine(made_up(10))  # compiled

    every = made_up(arguments.trips)
    print(f"{arguments.trips} summaries, {memory():.2f} GB")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "summaries.parquet"
        time, _ = timed(lambda: write_summaries(every, path))
        size = path.stat().st_size
        print(f"written in {time:.1f} s, {size / 1e6:.0f} MB, {size / arguments.trips:.0f} B each")
        time, every = timed(lambda: read_summaries(path))
        print(f"read in {time:.1f} s; {memory():.2f} GB")
    time, common = timed(lambda: combine(every))
    print(f"combined in {time:.1f} s; {memory():.2f} GB")
    off = common.resistance(30.0) / (basis(30.0) @ COMMON) - 1.0
    print(f"  curve at 30 m/s off by {100 * off:.4f} %, 2σ {200 * common.std(30.0) / 13e3:.4f} %")
    time, found = timed(lambda: parameter_set(every))
    print(
        f"observed set in {time:.1f} s: {len(found.configurations)} configurations bound"
        f" {found.cover['level']:.1%}; {memory():.2f} GB"
    )

    expected = BETWEEN_TRIPS**2 * np.eye(3)
    print("\nvariance between trips alone, per trip")
    ours = 0.0
    for name, peer, count in (
        ("this", ours_alone, arguments.trips),
        ("numpy, stacked", stacked, min(arguments.trips, 100 * arguments.fewer)),
        ("numpy, a loop", plain_loop, arguments.fewer),
    ):
        fewer = made_up(count)
        nodes = basis(np.linspace(0.0, TOP, 3))
        nodes = nodes / (nodes @ COMMON)[:, None]
        values = fewer[["r0", "r1", "r2"]].to_numpy() @ nodes.T
        triangle = fewer[list(COVARIANCE)].to_numpy()
        full = np.empty((count, 4, 4))
        rows, columns = np.triu_indices(4)
        full[:, rows, columns] = full[:, columns, rows] = triangle
        variances = nodes @ full[:, :3, :3] @ nodes.T
        time, between = timed(lambda p=peer, v=values, s=variances: p(v, s, expected))
        ours = ours or time / count
        std = np.sqrt(np.diag(between))
        print(
            f"{name:16s}{count:9d} trips {time:8.2f} s {1e6 * time / count:10.2f} µs a trip"
            f" {time / count / ours:8.1f} times ours   std {np.round(100 * std, 3)} %"
        )


if __name__ == "__main__":
    main()

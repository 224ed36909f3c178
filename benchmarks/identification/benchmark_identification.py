"""The identification study: error of the drag curve by estimator and number of trips.

    python benchmarks/identification/benchmark_identification.py [--trips 100]

Peers in the same run: recursive least squares on differenced speed with the mass fixed (paper
004, eqs. 21-24) and ordinary least squares on the same integral windows. The error is the root
mean square over 5 to 55 m/s of the curve's relative error.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from monte_carlo import CONSTANT, PERFECT, Drawn, Study, draw, recording
from numpy.typing import NDArray

from analysis.resistance.curve import band_factor, curve_std, powers
from analysis.resistance.fit import LARGEST_CONDITION
from analysis.resistance.regression import Regression, regress
from analysis.resistance.windows import Windows, build_windows
from estimators.rls import RecursiveLeastSquares

FloatArray = NDArray[np.float64]

SPEEDS = np.linspace(5.0, 55.0, 101)


def error(beta: FloatArray, study: Study) -> float:
    """Relative error of the curve, RMS over `SPEEDS` [%]."""
    truth = study.resistance(SPEEDS)
    return float(100.0 * np.sqrt(np.mean((powers(SPEEDS) @ beta / truth - 1.0) ** 2)))


def differenced(trip: Drawn, study: Study) -> FloatArray:
    """Paper 004, eqs. (21)-(24), with the mass as told and the map's gradient taken off."""
    speed = trip.speed
    known = ~trip.braking[:-1]
    track = trip.line.track_acceleration(trip.position[:-1])
    left = study.mass * (np.diff(speed) / np.diff(trip.time) + track) - trip.effort[:-1]
    right = -np.column_stack([np.ones(speed.size - 1), speed[:-1], speed[:-1] ** 2])
    recursion = RecursiveLeastSquares([1e6, 1e5, 1e4])
    recursion.update(right[known], left[known], 1e8)
    return np.asarray(recursion.result().estimate, dtype=np.float64)


def ordinary(windows: Windows) -> FloatArray:
    """Ordinary least squares on the windows."""
    scale = np.linalg.norm(windows.x, axis=0)
    theta = np.linalg.lstsq(windows.x / scale, windows.y, rcond=None)[0] / scale
    return np.asarray(theta[1:] / theta[0])


def together(fits: list[Regression]) -> FloatArray:
    """Trips of one and the same train, in information form."""
    information = [np.linalg.inv(fit.covariance[:3, :3]) for fit in fits]
    weighted = [w @ fit.beta[:3] for w, fit in zip(information, fits, strict=True)]
    return np.asarray(np.linalg.solve(np.sum(information, axis=0), np.sum(weighted, axis=0)))


def groups(betas: list[FloatArray], size: int) -> list[list[int]]:
    return [list(range(k, k + size)) for k in range(0, len(betas) - size + 1, size)]


def rows(study: Study, trips: int) -> tuple[dict[str, list[str]], list[Regression]]:
    """Errors by estimator, for 1, 10 and 100 trips together."""
    betas: dict[str, list[FloatArray]] = {"differenced, mass fixed (RLS)": [], "integral (OLS)": []}
    fits: list[Regression] = []
    for seed in range(trips):
        trip = draw(study, seed)
        windows = build_windows(recording(trip))
        betas["differenced, mass fixed (RLS)"].append(differenced(trip, study))
        betas["integral (OLS)"].append(ordinary(windows))
        fits.append(regress(windows, study.mass, 0.1 * study.mass))
    table = {}
    for name, found in betas.items():
        table[name] = [
            cell(
                [
                    error(np.mean([found[k] for k in group], axis=0), study)
                    for group in groups(found, n)
                ]
            )
            for n in (1, 10, 100)
        ]
    table["integral, offsets random, mass free (UD-RLS)"] = [
        cell([error(together([fits[k] for k in group]), study) for group in groups(fits, n)])
        for n in (1, 10, 100)
    ]
    return table, fits


def cell(errors: list[float]) -> str:
    if not errors:
        return "-"
    if len(errors) == 1:
        return f"{errors[0]:.2f}"
    return f"{np.median(errors):.2f} ({np.quantile(errors, 0.9):.1f})"


def coverage(fits: list[Regression], study: Study) -> tuple[float, float, float]:
    """Share covered: single speeds by 1.96 sigma, whole curves by the band; bias of r1 [%]."""
    truth = study.resistance(SPEEDS)
    single, whole = [], []
    for fit in fits:
        covariance = fit.covariance[:3, :3]
        z = np.abs(powers(SPEEDS) @ fit.beta[:3] - truth) / curve_std(covariance, SPEEDS)
        single.append(np.mean(z < 1.96))
        whole.append(np.all(z < band_factor(covariance, (5.0, 55.0), fit.residual.size - 4)))
    bias = 100.0 * (together(fits)[1] / study.resistance.r1 - 1.0)
    return float(np.mean(single)), float(np.mean(whole)), float(bias)


def refused(study: Study, trips: int) -> int:
    """How many trips the condition number refuses."""
    found = [
        regress(build_windows(recording(draw(study, seed))), study.mass, 0.1 * study.mass)
        for seed in range(trips)
    ]
    return sum(fit.condition > LARGEST_CONDITION for fit in found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trips", type=int, default=100)
    trips = parser.parse_args().trips
    began = time.perf_counter()
    study = Study()
    table, fits = rows(study, trips)
    print(f"error of the drag curve [%]: median of {trips} trips of 60 km (90th percentile)\n")
    print(f"{'estimator':46s}{'1 trip':>14s}{'10 trips':>14s}{'100 trips':>14s}")
    for name, cells in table.items():
        print(f"{name:46s}" + "".join(f"{text:>14s}" for text in cells))
    single, whole, bias = coverage(fits, study)
    print(f"\ncoverage of the 95 % band: single speeds {single:.3f}, whole curves {whole:.3f}")
    print(f"bias of r1, all trips together: {bias:.1f} %")
    perfect, _ = rows(PERFECT, min(trips, 20))
    name = "integral, offsets random, mass free (UD-RLS)"
    print(f"perfect map, edges and mass: {perfect[name][0]} % for one trip")
    print(
        f"condition over {LARGEST_CONDITION:.0f}: {refused(CONSTANT, 20)} of 20 at one speed,",
        end=" ",
    )
    print(f"{sum(fit.condition > LARGEST_CONDITION for fit in fits)} of {trips} varied")
    rougher = replace(study, pieces=(300.0, 2000.0))
    print(f"longer pieces of gradient, 0.3 to 2 km: {rows(rougher, min(trips, 50))[0][name]}")
    print(f"\n{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()

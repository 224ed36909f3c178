"""The identification study: error of the drag curve by estimator and number of trips.

    python benchmarks/identification/benchmark_identification.py [--trips 100]

The filter for use while the train runs (`estimators.running_resistance`) is told the sizes of the
noise, which the integral methods estimate. It runs twice: with next to nothing known of the curve,
and with a weak prior: each coefficient drawn 100 % off the truth, and taken to be.

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
from analysis.resistance.recording import POSITION_STEP
from analysis.resistance.regression import Regression, regress
from analysis.resistance.windows import Windows, build_windows
from estimators.rls import RecursiveLeastSquares
from estimators.running_resistance import RunningResistanceFilter, RunningResistanceResult
from trainlog.railway import RunningResistance

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


WEAK = 1.0
"""Relative standard deviation of each coefficient of the weak prior."""

NOTHING = (1.0, 0.1, 0.01)
"""Standard deviation of r0, r1 and r2 over mass where next to nothing is known."""


def online(trip: Drawn, study: Study, seed: int, weak: bool) -> RunningResistanceResult:
    """What the extended Kalman filter knows at the end of a trip."""
    r = study.resistance
    true = np.array([r.r0, r.r1, r.r2])
    drawn = true * (1.0 + WEAK * np.random.default_rng([seed, 1]).standard_normal(3))
    known = recording(trip)
    estimator = RunningResistanceFilter(
        study.mass,
        0.1 * study.mass,
        RunningResistance(*drawn.tolist()) if weak else RunningResistance(0.0, 0.0, 0.0),
        WEAK * true if weak else study.mass * np.array(NOTHING),
        speeds=(float(SPEEDS[0]), float(SPEEDS[-1])),
        speed_std=float(np.hypot(study.speed_noise, study.speed_resolution / np.sqrt(12.0))),
        gradient_std=0.5e-3,
        chainage_std=20.0 / np.sqrt(3.0),
        reach=POSITION_STEP,
    )
    estimator.update(
        known.time,
        known.speed,
        known.effort,
        known.track,
        known.track_slope,
        known.section,
        known.usable,
    )
    return estimator.result()


def online_rows(study: Study, trips: int) -> None:
    """Print the errors of the filter, its coverage, and how many trips it calls valid."""
    truth = study.resistance(SPEEDS)
    for name, weak in (("nothing known", False), ("weak prior", True)):
        found = [online(draw(study, seed), study, seed, weak) for seed in range(trips)]
        cells = [cell([error(each.estimate[:3], study) for each in found]), "-", "-"]
        if not weak:
            betas = [each.estimate[:3] for each in found]
            information = [np.linalg.inv(each.covariance[:3, :3]) for each in found]
            cells[1:] = [
                cell(
                    [
                        error(
                            np.linalg.solve(
                                np.sum([information[k] for k in group], axis=0),
                                np.sum([information[k] @ betas[k] for k in group], axis=0),
                            ),
                            study,
                        )
                        for group in groups(betas, n)
                    ]
                )
                for n in (10, 100)
            ]
        off = [np.abs(powers(SPEEDS) @ each.estimate[:3] - truth) for each in found]
        std = [curve_std(each.covariance[:3, :3], SPEEDS) for each in found]
        covered = np.mean(np.array(off) < 1.96 * np.array(std))
        print(
            f"{f'EKF, online ({name})':46s}"
            + "".join(f"{text:>14s}" for text in cells)
            + f"   covers {covered:.3f}, valid {sum(each.valid for each in found)}"
        )
    held = [online(draw(CONSTANT, seed), CONSTANT, seed, True).valid for seed in range(20)]
    print(f"{'EKF, online, at one speed':46s}   valid {sum(held)} of {len(held)}")


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
    online_rows(study, trips)
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

"""The identification study: error of the drag curve by estimator and number of trips.

    python benchmarks/identification/benchmark_identification.py [--trips 400] [--picture study.png]

Trips are drawn, fitted and combined as the product does it (`study.py`). Peers in the same run:
recursive least squares on differenced speed with the mass fixed (Amirhosseini et al., 2024, eqs.
21-24) and ordinary least squares on integral windows of ten seconds. The error is the root mean
square over 5 to 55 m/s of the curve's relative error; the bound is that of Cramér and Rao
(`bound.py`), below which no unbiased estimator comes. Medians of few groups scatter: beside the
bound stands the range in which half of the groups would lie if nothing at all were lost.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from monte_carlo import CONSTANT, PERFECT, Study
from study import (
    ASKED,
    Outcome,
    at_the_bound,
    beta_of,
    common,
    covered,
    error,
    excess,
    grouped,
    known_to,
    processes,
    run,
)

from trainlog.arrays import FloatArray
from trainlog.units import KMH

SIZES = (1, 10, 100)

TARGETS = {1: 4.8, 10: 1.2, 100: 0.35}
"""Largest median errors that are asked for [%]."""

FINE = replace(Study(), pieces=(50.0, 50.001))
"""A map of elements of 50 m, each wrong for itself."""

FINE_SLOW = replace(FINE, speeds=(3.0, 58.0))
"""The same, and speeds down to walking pace."""

LONG = replace(Study(), pieces=(300.0, 2000.0))
"""Pieces as a line's longitudinal section has them: fifty errors on a trip instead of 400."""

STOPPING = replace(Study(), limits=(800.0, 3000.0))
"""Speed changes every two kilometres; more is braked."""

Combination = Callable[[list[Outcome]], FloatArray]


ESTIMATORS: dict[str, Combination] = {
    "differenced, mass fixed (RLS)": lambda group: np.mean([o.differenced for o in group], axis=0),
    "windows of 10 s (OLS)": lambda group: np.mean([o.ordinary for o in group], axis=0),
    "fit_trip and combine": lambda group: beta_of(common(group)),
}


def cells(outcomes: list[Outcome], study: Study, estimate: Combination) -> list[str]:
    """Median error of groups of each size, and the 90th percentile."""
    out = []
    for size in SIZES:
        errors = [error(estimate(group), study) for group in grouped(outcomes, size)]
        shown = f"{np.median(errors):.2f}" if errors else "-"
        out.append(shown + (f" ({np.quantile(errors, 0.9):.1f})" if len(errors) > 9 else ""))
    return out


def bound_cells(outcomes: list[Outcome], study: Study) -> list[str]:
    """Median at the bound, and between what half of the groups would lie."""
    bounds = [one.bound for one in outcomes if one.bound is not None]
    out = []
    for size in SIZES:
        low, middle, high = np.quantile(at_the_bound(bounds, study, size), [0.25, 0.5, 0.75])
        out.append(f"{middle:.2f} [{low:.2f}, {high:.2f}]")
    return out


def row(name: str, cells_: list[str]) -> str:
    return f"{name:44s}" + "".join(f"{cell:>20s}" for cell in cells_)


def show_study(outcomes: list[Outcome], study: Study) -> None:
    """The table of the study as it is asked for."""
    print(row("asked for", [f"{TARGETS[size]:.2f}" for size in SIZES]))
    for name, estimate in ESTIMATORS.items():
        print(row(name, cells(outcomes, study, estimate)))
    alone = np.median([error(one.beta, study) for one in outcomes])
    print(row("fit_trip alone, negative coefficients let be", [f"{alone:.2f}", "-", "-"]))
    print(row("Cramér-Rao bound [half of the groups]", bound_cells(outcomes, study)))
    bounds = [one.bound for one in outcomes if one.bound is not None]
    shares = [np.mean(at_the_bound(bounds, study, size) <= TARGETS[size]) for size in SIZES]
    print(row("groups within what is asked, at the bound", [f"{s:.0%}" for s in shares]))
    print(f"\nvariance of single trips over the bound's: {excess(outcomes, study):.2f}")


def show_coverage(outcomes: list[Outcome], study: Study) -> list[tuple[int, float, float]]:
    """Coverage by number of trips, and the bias."""
    found = [
        (
            1,
            float(np.mean([o.single for o in outcomes])),
            float(np.mean([o.whole for o in outcomes])),
        )
    ]
    for size in SIZES[1:]:
        inside = [covered(common(group), study) for group in grouped(outcomes, size)]
        if inside:
            found.append((size, *np.mean(inside, axis=0).tolist()))
    for size, single, whole in found:
        print(
            f"coverage of the 95 % band, {size:3d} trips: single speeds {single:.3f},"
            f" whole curves {whole:.3f} of {len(outcomes) // size}"
        )
    r1 = study.resistance.r1
    every = common(outcomes)
    sets = grouped(outcomes, min(100, len(outcomes)))
    biases = [100.0 * (common(g).resistance.r1 / r1 - 1.0) for g in sets]
    std = 100.0 * np.sqrt(every.covariance[1, 1]) / r1
    print(
        f"bias of r1: {np.mean(biases):+.1f} % (mean of {len(biases)} groups of {len(sets[0])},"
        f" one of which scatters by {np.sqrt(len(outcomes) / len(sets[0])) * std:.1f} %);"
        f" all {len(outcomes)} together {every.resistance.r1 / r1 * 100.0 - 100.0:+.1f} %"
    )
    print(f"error of all {len(outcomes)} together: {error(beta_of(every), study):.2f} %")
    return found


def show_refusals(outcomes: list[Outcome], constant: list[Outcome], study: Study) -> None:
    reasons = {one.refused for one in constant if one.refused}
    print(
        f"refused, asked from {KMH * ASKED[0]:.0f} to {KMH * ASKED[1]:.0f} km/h:"
        f" {sum(bool(o.refused) for o in constant)} of {len(constant)} at one speed"
        f" ({', '.join(sorted(reasons))}),"
        f" {sum(bool(o.refused) for o in outcomes)} of {len(outcomes)} varied"
    )
    kept = [one for one in outcomes if not one.refused]
    vague = np.mean(known_to(kept, 10.0, study) > 0.1)
    print(f"known to worse than 10 % at 36 km/h: {100.0 * vague:.0f} % of the varied")


def draw_study(
    outcomes: list[Outcome],
    study: Study,
    coverage: list[tuple[int, float, float]],
    path: Path,
) -> None:
    """Draw error over number of trips, with the bound, and the coverage."""
    from analysis.charts import BLUE, GREEN, GREY, INK, ORANGE, RED, dress, new_figure, write_figure

    figure = new_figure(10.0, 4.4)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    sizes = [n for n in (1, 2, 5, 10, 20, 50, 100, 200) if 2 * n <= len(outcomes)]
    colours = dict(zip(ESTIMATORS, (GREY, ORANGE, GREEN, BLUE), strict=True))
    for name, estimate in ESTIMATORS.items():
        errors = [[error(estimate(g), study) for g in grouped(outcomes, n)] for n in sizes]
        left.plot(sizes, [np.median(e) for e in errors], "o-", color=colours[name], label=name)
    bounds = [one.bound for one in outcomes if one.bound is not None]
    at_bound = [np.quantile(at_the_bound(bounds, study, n), [0.25, 0.5, 0.75]) for n in sizes]
    low, middle, high = np.transpose(at_bound)
    left.fill_between(sizes, low, high, color=INK, alpha=0.12, linewidth=0)
    left.plot(sizes, middle, "--", color=INK, label="Cramér-Rao bound, half of the groups")
    left.plot(list(TARGETS), list(TARGETS.values()), "x", color=RED, label="asked for")
    left.set_xscale("log")
    left.set_yscale("log")
    dress(left, x="trips of 60 km together", y="error of the curve [%]", title="median error")
    left.legend(fontsize=8, frameon=False)
    for column, (label, colour) in enumerate((("single speeds", ORANGE), ("whole curve", BLUE))):
        right.plot(
            [str(c[0]) for c in coverage],
            [100.0 * c[1 + column] for c in coverage],
            "o-",
            color=colour,
            label=label,
        )
    right.axhline(95.0, color=INK, linestyle="--", linewidth=1.0)
    right.axhline(90.0, color=RED, linewidth=1.0, label="asked for, at least")
    right.set_ylim(80.0, 101.0)
    dress(right, x="trips together", y="share [%]", title="truth inside the 95 % band")
    right.legend(fontsize=8, frameon=False, loc="lower left")
    write_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trips", type=int, default=400)
    parser.add_argument("--picture", type=Path, help="draw the study into this PNG")
    arguments = parser.parse_args()
    trips = max(arguments.trips, 20)
    few = min(trips, 40)
    began = time.perf_counter()
    study = Study()
    pool = processes()
    varied = run(pool, study, trips, bounds=few, peers=True)
    outcomes = [one for one in varied if not one.refused]
    print(f"error of the drag curve [%]: median of {trips} trips of 60 km (90th percentile)\n")
    print(row("", ["1 trip", "10 trips", "100 trips"]))
    show_study(outcomes, study)
    coverage = show_coverage(outcomes, study)
    show_refusals(varied, run(pool, CONSTANT, 20, peers=True), study)
    seconds = 1e3 * np.median([one.seconds for one in outcomes])
    print(f"one fit: {seconds:.0f} ms of processor time")
    print("\nwhat the study does not say of its trips, and what it changes\n")
    product = ESTIMATORS["fit_trip and combine"]
    for name, other, count in (
        ("map of 50 m elements", FINE, trips // 2),
        ("map of 50 m elements, speeds from 3 m/s", FINE_SLOW, trips // 2),
        ("pieces of 0.3 to 2 km", LONG, few),
        ("speed changes every 0.8 to 3 km", STOPPING, few),
        ("perfect map and mass (asked for: 0.50)", PERFECT, few),
    ):
        found = [one for one in run(pool, other, count, bounds=20) if not one.refused]
        print(row(f"{name}, {len(found)} trips", cells(found, other, product)))
        if other is not PERFECT:
            print(row("  Cramér-Rao bound", bound_cells(found, other)))
    pool.shutdown()
    if arguments.picture:
        draw_study(outcomes, study, coverage, arguments.picture)
    print(f"\n{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()

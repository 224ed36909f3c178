"""How well adhesion characteristics are fitted to measured points, and whether their bands hold.

    python benchmarks/map/characteristics.py [--curves 450] [--seed 0]

First CONTACT's curves of the Eurosprinter, by family, beside the curve that the simulation scales
to their maximum. Then random curves of Pacejka's form, which no family has, with noise, 8 to 60
points, some of them short of the maximum: how far off maximum and optimum are, and the share of
them within the 95 % bands.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

from analysis.adhesion.characteristic import NAMES, fit_adhesion_characteristic
from trainlog.errors import NotIdentifiableError
from trainlog.railway.adhesion import AdhesionPoints, CreepCurve, creep_coefficients

CURVES = (
    Path(__file__).resolve().parent / "../../../shared/data/creep/eurosprinter_creep_curves.csv"
)


def eurosprinter(curve: str) -> AdhesionPoints:
    with CURVES.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["curve"] == curve]
    columns = ("long_creepage", "traction_coeff", "rolling_speed_mps")
    creepage, adhesion, speed = (np.array([float(r[name]) for r in rows]) for name in columns)
    return AdhesionPoints(creepage, adhesion, "creepage", speed)


def print_eurosprinter() -> None:
    print("curve  form                                          RMS   maximum           optimum")
    for curve in ("1", "2"):
        points = eurosprinter(curve)
        for family in ("polach", "exponentials"):
            fit = fit_adhesion_characteristic(points, family)
            print(
                f"{curve:5s}  {NAMES[family]:43s} {fit.rms[family]:6.2%}"
                f"  {fit.maximum:.4f} ± {1.96 * fit.maximum_std:.4f}  {fit.optimum_in_words()}"
            )
        top = points.adhesions.max()
        a, b, scale = creep_coefficients(top)
        plant = CreepCurve(a, b, scale, scale)
        rms = np.sqrt(np.mean((plant(points.slips * 10.0) - points.adhesions) ** 2)) / top
        print(
            f"{curve:5s}  {'Zhao et al. (2025), scaled to the maximum':43s} {rms:6.2%}  {top:.4f}"
            f"           {100.0 * float(plant.optimal_creepage(10.0)):.3g} %"
        )


def drawn(rng: np.random.Generator) -> tuple[AdhesionPoints, float, float, float]:
    """Points of a random curve, its maximum and optimum, and the noise over the maximum."""
    maximum, form = rng.uniform(0.05, 0.4), rng.uniform(1.2, 1.85)
    optimum = np.exp(rng.uniform(np.log(0.005), np.log(0.08)))
    count, end = int(rng.integers(8, 60)), optimum * rng.uniform(1.2, 12.0)
    slips = np.linspace(0.05 * optimum, end, count)
    if rng.random() < 0.5:
        slips = np.sort(np.exp(rng.uniform(np.log(0.05 * optimum), np.log(end), count)))
    noise = float(rng.choice([0.0, 0.01, 0.03]))
    uneven = rng.uniform(0.3, 2.0, count) if rng.random() < 0.33 else 1.0
    stiffness = np.tan(np.pi / (2.0 * form)) / optimum
    adhesions = maximum * np.sin(form * np.arctan(stiffness * slips))
    adhesions += noise * maximum * uneven * rng.standard_normal(count)
    speeds = np.full(count, rng.uniform(5.0, 40.0))
    return AdhesionPoints(slips, adhesions, "creepage", speeds), maximum, optimum, noise


def print_bands(curves: int, seed: int) -> None:
    rng, rows, refused = np.random.default_rng(seed), [], 0
    for _ in range(curves):
        points, maximum, optimum, noise = drawn(rng)
        try:
            fit = fit_adhesion_characteristic(points)
        except NotIdentifiableError:
            refused += 1
            continue
        low, high = fit.optimal_band
        half = 1.96 * fit.maximum_std
        error = abs(fit.maximum - maximum)
        rows.append([noise, error / maximum, half / maximum, error < half, low < optimum < high])
    found = np.array(rows, dtype=np.float64)
    print("\nnoise  curves  maximum off  half band  in band  optimum in band")
    for noise in np.unique(found[:, 0]):
        own = found[found[:, 0] == noise]
        print(
            f"{noise:5.0%}  {len(own):6d}  {np.median(own[:, 1]):11.2%}"
            f"  {np.median(own[:, 2]):9.2%}"
            f"  {own[:, 3].mean():7.3f}  {own[:, 4].mean():15.3f}"
        )
    print(
        f"  all  {len(found):6d}  {'':22s}  {found[:, 3].mean():7.3f}  {found[:, 4].mean():15.3f}"
    )
    print(f"refused: {refused}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--curves", type=int, default=450)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print_eurosprinter()
    print_bands(options.curves, options.seed)


if __name__ == "__main__":
    main()

"""Picture of an adhesion characteristic."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analysis.charts import (
    BLUE,
    GREY,
    PALE,
    RED,
    dress,
    headline,
    legend,
    new_figure,
    write_figure,
)
from trainlog.units import KMH

if TYPE_CHECKING:
    from analysis.adhesion.characteristic import CharacteristicFit


def draw_characteristic(fit: CharacteristicFit, path: str | Path) -> None:
    """Draw measured points of adhesion over slip, the curve fitted to them, and its maximum.

    Parameters
    ----------
    fit : CharacteristicFit
    path : path
        PNG file.
    """
    from analysis.adhesion.characteristic import NAMES

    points = fit.points
    over_creepage = points.variable == "creepage"
    scale, unit = (100.0, "%") if over_creepage else (KMH, "km/h")
    speed = None if np.isnan(fit.speed) else fit.speed
    last = 1.02 * float(points.slips.max())
    near = min(4.0 * fit.optimal_slip, last)
    slips = np.unique(np.concatenate([np.linspace(0.0, end, 400) for end in (near, last)]))
    curve = fit.characteristic
    adhesion = curve.over_creepage(slips, speed or 1.0) if over_creepage else curve(slips, speed)
    figure = new_figure(11.0, 4.2)
    places = figure.subplots(1, 2, sharey=True)
    low, high = fit.optimal_band
    for axes, end in zip(places, (near, last), strict=True):
        axes.axvspan(
            scale * low, scale * min(high, end), color=PALE, alpha=0.45, linewidth=0,
            label="optimum, 95 % band",
        )  # fmt: skip
        axes.plot(scale * points.slips, points.adhesions, ".", color=GREY, label="measured")
        axes.plot(scale * slips, adhesion, color=BLUE, linewidth=1.4, label=NAMES[fit.family])
        axes.errorbar(
            scale * fit.optimal_slip, fit.maximum, 1.96 * fit.maximum_std, fmt="o", color=RED,
            markersize=4, capsize=3, label="maximum, 95 % band",
        )  # fmt: skip
        axes.set_xlim(0.0, scale * end)
    places[0].set_ylim(0.0, 1.15 * max(fit.maximum, float(points.adhesions.max())))
    dress(places[0], x=f"{points.variable} [{unit}]", y="adhesion", title="up to the maximum")
    dress(places[1], x=f"{points.variable} [{unit}]", y="", title="all points")
    legend(places[1], "lower right")
    at = f" at {KMH * speed:.0f} km/h" if speed is not None else ""
    headline(
        figure,
        f"Adhesion characteristic: maximum {fit.maximum:.3f} ± {1.96 * fit.maximum_std:.3f},"
        f" optimal {points.variable} {fit.optimum_in_words()}{at}",
    )
    write_figure(figure, path)

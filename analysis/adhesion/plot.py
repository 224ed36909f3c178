"""Charts of an adhesion characteristic."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.charts import BLUE, GREY, RED, Chart, Curve, Panel, Span
from trainlog.units import KMH

if TYPE_CHECKING:
    from analysis.adhesion.characteristic import CharacteristicFit


def characteristic_charts(fit: CharacteristicFit) -> list[Chart]:
    """Measured points of adhesion over slip, the curve fitted to them, and its maximum."""
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
    low, high = fit.optimal_band
    reach = 1.96 * fit.maximum_std
    curves = [
        Curve("measured", scale * points.slips, points.adhesions, GREY, "points", width=1.6),
        Curve(NAMES[fit.family], scale * slips, adhesion, BLUE, width=1.4),
        Curve("maximum, 95 % band", [scale * fit.optimal_slip], [fit.maximum], RED, "points",
              [fit.maximum - reach], [fit.maximum + reach], width=2.5),
    ]  # fmt: skip
    top = 1.15 * max(fit.maximum, float(points.adhesions.max()))
    at = f" at {KMH * speed:.0f} km/h" if speed is not None else ""
    title = (
        f"Adhesion characteristic: maximum {fit.maximum:.3f} ± {reach:.3f},"
        f" optimal {points.variable} {fit.optimum_in_words()}{at}"
    )
    return [
        Chart(
            f"{points.variable} [{unit}]",
            [
                Panel(
                    "adhesion", curves, 1.1, words, limits=(0.0, top),
                    spans=[Span(scale * low, scale * min(high, end), label="optimum, 95 % band")],
                )
            ],
            f"Adhesion over {points.variable}, {words}.",
            span=(0.0, scale * end), title="" if number else title, width=0.5, beside=number > 0,
        )
        for number, (words, end) in enumerate((("up to the maximum", near), ("all points", last)))
    ]  # fmt: skip

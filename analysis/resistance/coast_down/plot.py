"""Pictures of the coast-down: where the train coasted, and the curve with its band."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from analysis.plotting import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    RED,
    SKY,
    dress,
    new_figure,
    write_figure,
)
from analysis.resistance.coast_down import CoastDown
from analysis.resistance.coast_down.fit import TripCoastDown
from trainlog.formats.parameters import CoastDownResult
from trainlog.units import KMH

SHOWN = 4
"""Trips whose speed is drawn."""


def draw_coast_down(found: CoastDown, path: str | Path) -> None:
    """Draw the coasting segments over speed and distance, the curve, its band and the windows."""
    shown = sorted(found.trips, key=lambda fit: -fit.coasted)[:SHOWN]
    figure = new_figure(12.0, max(5.2, 1.5 * len(shown) + 1.0))
    grid = figure.add_gridspec(len(shown), 2, width_ratios=(3, 2))
    for row, fit in enumerate(shown):
        axes = figure.add_subplot(grid[row, 0])
        _segments(axes, fit)
        dress(
            axes,
            x="chainage [km]" if row == len(shown) - 1 else "",
            y="speed [km/h]",
            title=f"{fit.trip}: coasting for {fit.coasted:.0f} s",
        )
        if row == 0:
            axes.legend(fontsize=8, frameon=False, loc="lower left", ncols=3)
    _curve(figure.add_subplot(grid[:, 1]), found)
    refused = f", {len(found.refused)} refused" if found.refused else ""
    count = len(found.trips)
    figure.suptitle(
        f"{found.train or 'train'}: running resistance from the coasting of"
        f" {count} trip{'s' if count > 1 else ''}{refused}",
        x=0.01,
        ha="left",
        fontsize=11,
        color=INK,
    )
    write_figure(figure, path)


def draw_without_gradient(result: CoastDownResult, path: str | Path) -> None:
    """Draw what is identified with the gradient unknown: each piece's sum, and the curve if any."""
    figure = new_figure(11.0, 5.2)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    for way, colour in (("forward", BLUE), ("reverse", ORANGE)):
        pieces = [piece for piece in result.pieces if piece["direction"] == way]
        if pieces:
            left.errorbar(
                [np.mean(piece["position"]) / 1e3 for piece in pieces],
                [piece["deceleration"] for piece in pieces],
                yerr=[1.96 * piece["std"] for piece in pieces],
                fmt=".",
                color=colour,
                elinewidth=0.8,
                label=f"{pieces[0]['quantity']}, {way}, 95 %",
            )
    dress(left, x="chainage [km]", y="deceleration [m/s²]", title="of each piece of track")
    left.legend(fontsize=8, frameon=False, loc="upper left")
    _told(right, result)
    figure.suptitle("Coasting with the gradient unknown", x=0.01, ha="left", fontsize=11, color=INK)
    write_figure(figure, path)


def _told(axes: Axes, result: CoastDownResult) -> None:
    """The curve, or what it is without its constant part."""
    curve = result.curve
    if curve is not None:
        speed, value, low, high = curve.speeds, curve.deceleration, curve.low, curve.high
        what, title = "running resistance over inertia [m/s²]", "pieces coasted both ways tell all"
    else:
        c1, c2 = result["c1"].value or 0.0, result["c2"].value or 0.0
        ends = np.array([piece["speed"] for piece in result.pieces])
        lowest = float(ends.min())
        speed = np.linspace(lowest, float(ends.max()), 81)
        basis = np.stack([speed - lowest, speed**2 - lowest**2], axis=-1)
        value = basis @ [c1, c2]
        std = np.sqrt(np.einsum("ni,ij,nj->n", basis, result.covariance, basis))
        low, high = value - 1.96 * std, value + 1.96 * std
        what = f"more than at {KMH * lowest:.0f} km/h [m/s²]"
        title = "growth with speed; c0 is merged with the gradient"
    axes.fill_between(KMH * speed, low, high, color=BLUE, alpha=0.25, linewidth=0, label="95 %")
    axes.plot(KMH * speed, value, color=BLUE, linewidth=1.8)
    axes.legend(fontsize=8, frameon=False, loc="upper left")
    dress(axes, x="speed [km/h]", y=what, title=title)


def _segments(axes: Axes, fit: TripCoastDown) -> None:
    motion = fit.motion
    kilometre, speed = motion.position / 1e3, KMH * motion.speed
    axes.plot(kilometre, speed, color=GREY, linewidth=0.7, label="speed")
    for segments, colour, label in (
        (fit.segments, BLUE, "coasting"),
        (fit.strays, RED, "left out: contradicts the others"),
    ):
        for number, segment in enumerate(segments):
            inside = (motion.time >= segment.start) & (motion.time <= segment.end)
            axes.plot(
                kilometre[inside],
                speed[inside],
                color=colour,
                linewidth=2.2,
                label=label if number == 0 else None,
            )
    axes.set_ylim(bottom=0.0)


def _curve(axes: Axes, found: CoastDown) -> None:
    curve = found.curve
    _windows(axes, found.trips)
    low, high = curve.covered
    speed = np.linspace(low, high, 120)
    below, above = curve.band(speed)
    axes.fill_between(
        KMH * speed, below, above, color=BLUE, alpha=0.25, linewidth=0, label="95 % band of it all"
    )
    axes.plot(KMH * speed, curve(speed), color=SKY, linewidth=1.2, linestyle="--")
    if curve.supported is not None:
        known = np.linspace(*curve.supported, 120)
        axes.plot(
            KMH * known,
            curve(known),
            color=BLUE,
            linewidth=2.0,
            label=f"curve, supported {KMH * known[0]:.0f} to {KMH * known[-1]:.0f} km/h",
        )
    axes.set_ylim(0.0, 1.6 * float(np.max(curve(speed))))
    ratio = found.ratio
    dress(
        axes,
        x="speed [km/h]",
        y="running resistance over inertia [m/s²]",
        title=f"mass over inertia {ratio.value:.3f} ± {1.96 * ratio.std:.3f} ({ratio.source})",
    )
    axes.legend(fontsize=8, frameon=False, loc="upper left")


def _windows(axes: Axes, trips: Sequence[TripCoastDown]) -> None:
    speed, value, std, used = (
        np.concatenate([getattr(fit.points, name) for fit in trips])
        for name in ("speed", "deceleration", "std", "used")
    )
    axes.errorbar(
        KMH * speed[used],
        value[used],
        yerr=std[used],
        fmt=".",
        color=GREY,
        elinewidth=0.4,
        markersize=3,
        alpha=0.6 if len(trips) < 4 else 0.3,
        label=f"{int(used.sum())} windows of 10 s and less, with the speed's noise",
    )
    if not np.all(used):
        axes.plot(KMH * speed[~used], value[~used], "x", color=ORANGE, label="outliers, left out")

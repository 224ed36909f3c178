"""Pictures of one trip: its fit and what the residuals say of it, or why it was refused."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.special import ndtri

from analysis.plotting import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    dress,
    new_figure,
    write_figure,
)
from analysis.resistance.diagnostics import LAGS, Residuals, diagnosed
from analysis.resistance.fit import TripFit
from analysis.resistance.logs import Fits
from analysis.resistance.plot import (
    KILONEWTON,
    TONNE,
    draw_correlation,
    draw_curve,
    resistance_limits,
    speeds_to_draw,
)
from analysis.resistance.refusal import Timeline, TripRefusedError
from trainlog.units import KMH

FloatArray = NDArray[np.float64]

MASKS = {"gap": GREY, "standstill": GREEN, "braking": ORANGE, "slip": PURPLE}
"""Colour of what is masked, by reason."""


def draw_each(fits: Fits, folder: Path) -> list[Path]:
    """Draw every trip that was fitted or refused now, a file each; returns their paths."""
    paths = []
    for fit in fits.trips:
        paths.append(folder / f"{_file_name(fit.trip)}.png")
        draw_trip(fit, paths[-1])
    return paths + draw_each_refused(fits.refused, folder)


def draw_each_refused(refused: Mapping[str, TripRefusedError], folder: Path) -> list[Path]:
    """Draw every trip that was refused now, a file each; returns their paths."""
    paths = []
    for trip, refusal in refused.items():
        paths.append(folder / f"{_file_name(trip)}.png")
        draw_refused(trip, refusal, paths[-1])
    return paths


def _file_name(trip: str) -> str:
    """The trip's name, as far as a file can have it."""
    return re.sub(r"[^\w .()+-]", "_", trip) or "trip"


def draw_trip(fit: TripFit, path: str | Path) -> None:
    """Draw one trip.

    Curve with its band, what was learnt as the trip went on; residuals over time and speed, their
    correlation and distribution; correlation of the parameters; what was masked.
    """
    figure = new_figure(13.0, 13.5)
    grid = figure.add_gridspec(4, 3, width_ratios=(2.0, 2.0, 2.0), height_ratios=(4, 2.6, 2.8, 2.4))
    _data(figure.add_subplot(grid[0, :2]), fit)
    _learning(figure.add_subplot(grid[0, 2]), fit)
    diagnosis, residuals = diagnosed(fit.residuals), fit.residuals
    over_time = figure.add_subplot(grid[1, :2])
    over_time.plot(residuals.time / 60.0, residuals.value, ".", color=SKY, markersize=3)
    _in_bounds(over_time)
    dress(over_time, x="time [min]", y="residual [σ]", title=_told(diagnosis.doubts))
    draw_correlation(figure.add_subplot(grid[1, 2]), fit.covariance, "correlation")
    over_speed = figure.add_subplot(grid[2, 0])
    over_speed.plot(KMH * residuals.speed, residuals.value, ".", color=SKY, markersize=3)
    _in_bounds(over_speed)
    dress(over_speed, x="speed [km/h]", y="residual [σ]", title=_p(diagnosis.flatness, "flat"))
    _neighbours(
        figure.add_subplot(grid[2, 1]), residuals, _p(diagnosis.independence, "independent")
    )
    _distribution(figure.add_subplot(grid[2, 2]), residuals, _p(diagnosis.normality, "normal"))
    draw_timeline(figure.add_subplot(grid[3, :]), fit.timeline)
    figure.suptitle(
        f"{fit.train}, {fit.trip}: running resistance", x=0.01, ha="left", fontsize=11, color=INK
    )
    write_figure(figure, path)


def draw_refused(trip: str, refusal: TripRefusedError, path: str | Path) -> None:
    """Draw why a trip was refused: the reason, and what was masked over the trip."""
    figure = new_figure(11.0, 4.2)
    axes = figure.add_subplot()
    if refusal.timeline is None or not refusal.timeline.time.size:
        axes.set_axis_off()
    else:
        draw_timeline(axes, refusal.timeline)
    title = f"{trip}: refused, {refusal.reason}\n{textwrap.fill(str(refusal), 130)}"
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, color=RED)
    write_figure(figure, path)


def draw_timeline(axes: Axes, timeline: Timeline) -> None:
    """Speed over time, and below it what was masked, a bar for each reason."""
    minutes = timeline.time / 60.0
    speed = KMH * timeline.speed
    top = max(float(np.max(speed, initial=1.0)), 1.0)
    axes.plot(minutes, speed, color=BLUE, linewidth=1.0)
    height = 0.08 * top
    for number, (reason, mask) in enumerate(timeline.masks.items(), start=1):
        low = -(number + 0.4) * height
        axes.fill_between(
            minutes,
            low,
            low + 0.8 * height,
            where=mask.tolist(),
            color=MASKS.get(reason, GREY),
            step="post",
            linewidth=0,
            label=f"{reason} {float(mask.mean()):.0%}",
        )
    axes.set_ylim(-(len(timeline.masks) + 1) * height, 1.08 * top)
    axes.set_yticks([tick for tick in axes.get_yticks() if 0.0 <= tick <= top])
    dress(axes, x="time [min]", y="speed [km/h]", title="what was masked, and why")
    axes.legend(fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4)


def _data(axes: Axes, fit: TripFit) -> None:
    speed = speeds_to_draw(fit.asked)
    points, used = fit.points, fit.points.used
    axes.errorbar(
        KMH * points.speed[used],
        points.resistance[used] / KILONEWTON,
        yerr=points.std[used] / KILONEWTON,
        fmt=".",
        color=GREY,
        elinewidth=0.5,
        markersize=4,
        label=f"{int(used.sum())} means over 10 s, with their noise",
    )
    if not used.all():
        axes.plot(
            KMH * points.speed[~used],
            points.resistance[~used] / KILONEWTON,
            "x",
            color=RED,
            label=f"{int((~used).sum())} outliers, axes out",
        )
    draw_curve(axes, fit, speed, BLUE, "fitted, 95 % band of the whole curve")
    axes.set_ylim(*resistance_limits(fit.resistance(speed), points.resistance[used]))
    dress(axes, x="speed [km/h]", y="running resistance [kN]", title=_summary(fit))
    axes.legend(fontsize=8, frameon=False, loc="upper left")


def _learning(axes: Axes, fit: TripFit) -> None:
    """Resistance at the highest speed asked for and mass, as the recursion learnt them."""
    top = fit.asked[1]
    basis = np.array([1.0, top, top**2])
    history = fit.history
    minutes = np.asarray((history.time - history.time[0]).total_seconds()) / 60.0
    drag = history.beta[:, :3] @ basis
    std = np.sqrt(np.einsum("i,nij,j->n", basis, history.covariance[:, :3, :3], basis))
    final = float(fit.resistance(top))
    axes.fill_between(
        minutes,
        (drag - 2.0 * std) / final,
        (drag + 2.0 * std) / final,
        color=BLUE,
        alpha=0.2,
        linewidth=0,
    )
    axes.plot(minutes, drag / final, color=BLUE, label=f"resistance at {KMH * top:.0f} km/h, ±2σ")
    axes.plot(
        minutes,
        history.beta[:, 3] / fit.mass,
        color=ORANGE,
        label=f"mass ({fit.mass / TONNE:.1f} t)",
    )
    axes.set_ylim(0.7, 1.3)
    dress(axes, x="time [min]", y="over the final estimate", title="learnt as the trip went on")
    axes.legend(fontsize=8, frameon=False, loc="upper right")


def _summary(fit: TripFit) -> str:
    r = fit.resistance
    return (
        f"{r.r0:.0f} N + {r.r1:.1f} N/(m/s) v + {r.r2:.2f} N/(m/s)² v²,"
        f" mass {fit.mass / TONNE:.1f} ± {1.96 * fit.mass_std / TONNE:.1f} t"
    )


def _in_bounds(axes: Axes) -> None:
    """Lines that 95 of 100 normal residuals keep."""
    axes.axhline(0.0, color=INK, linewidth=0.8)
    for bound in (-1.96, 1.96):
        axes.axhline(bound, color=GREY, linewidth=0.8, linestyle="--")


def _neighbours(axes: Axes, residuals: Residuals, title: str) -> None:
    """Autocorrelation, with the bounds that 95 of 100 independent residuals keep."""
    correlation = residuals.correlation(2 * LAGS)
    axes.bar(np.arange(1, correlation.size + 1), correlation, color=SKY)
    bound = 1.96 / np.sqrt(max(residuals.value.size, 1))
    for each in (-bound, bound):
        axes.axhline(each, color=GREY, linewidth=0.8, linestyle="--")
    axes.axhline(0.0, color=INK, linewidth=0.8)
    reach = max(0.2, 1.1 * float(np.max(np.abs(correlation), initial=0.0)))
    axes.set_ylim(-reach, reach)
    dress(axes, x="lag [windows]", y="autocorrelation", title=title)


def _distribution(axes: Axes, residuals: Residuals, title: str) -> None:
    """Quantiles of the residuals over those of the normal distribution."""
    value = np.sort(residuals.value)
    expected = ndtri((np.arange(value.size) + 0.5) / value.size)
    axes.plot(expected, value, ".", color=SKY, markersize=3)
    reach = float(np.max(np.abs(expected), initial=1.0))
    axes.plot([-reach, reach], [-reach, reach], color=INK, linewidth=0.8)
    dress(axes, x="normal quantile", y="residual [σ]", title=title)


def _told(doubts: tuple[str, ...]) -> str:
    return "\n".join(doubts) or "residuals as the noise model expects them"


def _p(probability: float, what: str) -> str:
    return f"{what}: p = {probability:.2g}"

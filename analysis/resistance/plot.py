"""Pictures of the running resistance: the data, each trip's curve, all of them together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from analysis.plotting import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    PALE,
    SKY,
    dress,
    new_figure,
    write_figure,
)
from analysis.resistance.combination import CommonFit
from analysis.resistance.curve import powers
from analysis.resistance.fit import TripFit
from analysis.resistance.logs import Fits
from trainlog.formats.summaries import parameters_of
from trainlog.units import KMH

FloatArray = NDArray[np.float64]

KILONEWTON, TONNE = 1e3, 1e3

MOST_DRAWN = 300
"""More curves than this are not drawn."""

MOST_NAMED = 40
"""More trips than this are not named one by one."""


def draw_fits(fits: Fits, path: str | Path) -> None:
    """Draw what a set of trips says.

    Curves with the common band; the observed configurations over all trips; mass and power of
    each trip; correlation of the coefficients.
    """
    figure = new_figure(11.0, 9.0)
    (left, right), (below, corner) = figure.subplots(2, 2, width_ratios=(3, 2))
    _together(left, fits)
    _observed(right, fits)
    _per_trip(below, fits)
    draw_correlation(corner, fits.common.covariance, "correlation of the mean's coefficients")
    count = len(fits.summaries) - len(fits.common.trips)
    refused = f", {count} refused" if count else ""
    figure.suptitle(
        f"{fits.common.train}: running resistance from {len(fits.common.trips)} trips{refused}",
        x=0.01,
        ha="left",
        fontsize=11,
        color=INK,
    )
    write_figure(figure, path)


def _together(axes: Axes, fits: Fits) -> None:
    """Windows of the trips fitted now, each trip's curve, the common one with its band."""
    common = fits.common
    speed = speeds_to_draw(common.asked)
    drag = common.resistance(speed)
    if fits.trips:
        seen = np.concatenate([fit.points.speed[fit.points.used] for fit in fits.trips])
        drag = np.concatenate([fit.points.resistance[fit.points.used] for fit in fits.trips])
        axes.plot(
            KMH * seen,
            drag / KILONEWTON,
            ".",
            color=GREY,
            alpha=0.35,
            markersize=3,
            markeredgewidth=0,
            label=f"{seen.size} means over 10 s",
        )
    accepted = fits.summaries[fits.summaries["refused"] == ""]
    curves = parameters_of(accepted)[_some(len(accepted)), :3] @ powers(speed).T
    lines = axes.plot(KMH * speed, curves.T / KILONEWTON, color=SKY, linewidth=0.8)
    lines[0].set_label(_counted("each trip", len(curves), len(accepted)))
    draw_curve(axes, common, speed, BLUE, "all trips: mean and its 95 % band")
    axes.set_ylim(*resistance_limits(common.resistance(speed), drag))
    dress(axes, x="speed [km/h]", y="running resistance [kN]")
    axes.legend(fontsize=8, frameon=False, loc="upper left", markerscale=2)


def _observed(axes: Axes, fits: Fits) -> None:
    """The configurations' curves over the common one, and those of all trips."""
    common, found = fits.common, fits.parameters
    speed = speeds_to_draw(common.asked)
    mean = common.resistance(speed)
    spread = 100.0 * common.spread(speed) / mean
    axes.fill_between(
        KMH * speed,
        -spread,
        spread,
        color=ORANGE,
        alpha=0.2,
        linewidth=0,
        label="between trips, 1σ",
    )
    betas = common.betas[_some(len(common.betas))]
    lines = axes.plot(
        KMH * speed, 100.0 * ((betas @ powers(speed).T) / mean - 1.0).T, color=PALE, linewidth=0.8
    )
    lines[0].set_label(_counted("each trip, drawn to the mean", len(betas), len(common.betas)))
    chosen = np.array([each.resistance(speed) for each in found.configurations])
    lines = axes.plot(KMH * speed, 100.0 * (chosen / mean - 1.0).T, color=BLUE, linewidth=0.9)
    lines[0].set_label("observed configurations")
    axes.axhline(0.0, color=INK, linewidth=0.8)
    title = (
        f"{len(chosen)} configurations, worst case of {100.0 * found.cover['level']:.1f} % of trips"
    )
    dress(axes, x="speed [km/h]", y="difference from the mean [%]", title=title)
    low, high = axes.get_ylim()
    axes.set_ylim(low - 0.25 * (high - low), high)  # room for the legend
    low, high = axes.get_ylim()
    axes.set_ylim(low - 0.25 * (high - low), high)  # room for the legend
    axes.legend(fontsize=8, frameon=False, loc="lower left")


def _per_trip(axes: Axes, fits: Fits) -> None:
    """Mass and power of each trip with their 95 % bands; of many trips the distribution."""
    accepted = fits.summaries[fits.summaries["refused"] == ""]
    mass = accepted["mass"].to_numpy(np.float64) / TONNE
    reach = 1.96 * np.sqrt(accepted["covariance_mass_mass"].to_numpy(np.float64)) / TONNE
    if len(accepted) > MOST_NAMED:
        axes.hist(mass, bins=40, color=SKY)
        dress(axes, x="mass [t]", y="trips", title=f"mass of {len(accepted)} trips")
        return
    rows = np.arange(len(accepted))
    axes.errorbar(
        mass, rows, xerr=reach, fmt="o", color=BLUE, markersize=3, elinewidth=1.2, label="mass"
    )
    axes.set_yticks(rows, accepted["trip"].tolist(), fontsize=7)
    axes.invert_yaxis()
    dress(axes, x="mass [t], 95 % band", y="", title="mass, and power where its limit was reached")
    axes.tick_params(axis="y", labelsize=7)
    power = accepted["max_power"].to_numpy(np.float64) / 1e3
    if np.isfinite(power).any():
        above = axes.twiny()
        above.errorbar(
            power,
            rows,
            xerr=1.96 * accepted["max_power_std"].to_numpy(np.float64) / 1e3,
            fmt="s",
            color=ORANGE,
            markersize=3,
            elinewidth=1.2,
        )
        above.set_xlabel("power [kW]", color=ORANGE, fontsize=9)
        above.tick_params(axis="x", colors=ORANGE, labelsize=8)
        above.spines[["right", "top"]].set_visible(False)


def draw_correlation(axes: Axes, covariance: FloatArray, title: str) -> None:
    """Heat map of the correlation that a covariance (p, p) of r0, r1, r2, mass says."""
    std = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(std, std)
    names = ("r0", "r1", "r2", "mass")[: std.size]
    axes.imshow(correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    for i, j in np.ndindex(correlation.shape):
        value = correlation[i, j]
        colour = "white" if abs(value) > 0.6 else INK
        axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=8, color=colour)
    axes.set_xticks(range(std.size), names)
    axes.set_yticks(range(std.size), names)
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.tick_params(colors=INK, labelsize=9, length=0)
    for side in axes.spines.values():
        side.set_visible(False)


def _some(count: int) -> NDArray[np.int64]:
    """Rows to draw: all, or `MOST_DRAWN` evenly spaced ones."""
    spaced = np.linspace(0, count - 1, min(count, MOST_DRAWN))
    return np.unique(np.round(spaced).astype(np.int64))


def _counted(what: str, drawn: int, count: int) -> str:
    return what if drawn == count else f"{what} ({drawn} of {count} drawn)"


def draw_curve(
    axes: Axes, fit: TripFit | CommonFit, speed: FloatArray, colour: str, label: str
) -> None:
    """A drag curve over the speed with its band."""
    low, high = fit.band(speed)
    axes.fill_between(
        KMH * speed, low / KILONEWTON, high / KILONEWTON, color=colour, alpha=0.25, linewidth=0
    )
    axes.plot(
        KMH * speed, fit.resistance(speed) / KILONEWTON, color=colour, linewidth=1.8, label=label
    )


def resistance_limits(curve: FloatArray, points: FloatArray) -> tuple[float, float]:
    """Range of the axis [kN]: the curve and nearly all points."""
    low, high = np.quantile(points, [0.02, 0.98])
    top = max(float(high), 1.15 * float(curve.max()))
    return min(float(low), 0.0) / KILONEWTON, top / KILONEWTON


def speeds_to_draw(asked: tuple[float, float]) -> FloatArray:
    """From standstill to the highest speed asked for [m/s]."""
    return np.linspace(0.0, asked[1], 120)

"""Pictures of the running resistance: the data, each trip's curve, all of them together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from analysis.pictures.style import (
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
from analysis.resistance.combination import CommonFit
from analysis.resistance.fit import TripFit
from analysis.resistance.logs import Fits
from trainlog.units import KMH

FloatArray = NDArray[np.float64]

KILONEWTON, TONNE = 1e3, 1e3


def draw_fits(fits: Fits, path: str | Path) -> None:
    """Draw what a set of trips says: curves with the common band, and how trips differ."""
    figure = new_figure(11.0, 5.2)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _together(left, fits)
    _differences(right, fits)
    refused = f", {len(fits.refused)} refused" if fits.refused else ""
    figure.suptitle(
        f"{fits.common.train}: running resistance from {len(fits.trips)} trips{refused}",
        x=0.01,
        ha="left",
        fontsize=11,
        color=INK,
    )
    write_figure(figure, path)


def draw_trip(fit: TripFit, path: str | Path) -> None:
    """Draw one trip: windows, curve with its band, what was learnt as the trip went on."""
    figure = new_figure(11.0, 5.2)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    speed = _speeds(fit.asked)
    points, used = fit.points, fit.points.used
    left.errorbar(
        KMH * points.speed[used],
        points.resistance[used] / KILONEWTON,
        yerr=points.std[used] / KILONEWTON,
        fmt=".",
        color=GREY,
        elinewidth=0.5,
        markersize=4,
        label=f"{int(used.sum())} windows, with their noise",
    )
    if not used.all():
        left.plot(
            KMH * points.speed[~used],
            points.resistance[~used] / KILONEWTON,
            "x",
            color=RED,
            label=f"{int((~used).sum())} outliers, left out",
        )
    _curve(left, fit, speed, BLUE, "fitted, 95 % band of the whole curve")
    left.set_ylim(*_limits(fit.resistance(speed), points.resistance[used]))
    dress(left, x="speed [km/h]", y="running resistance [kN]", title=_summary(fit))
    left.legend(fontsize=8, frameon=False, loc="upper left")
    _learning(right, fit)
    figure.suptitle(
        f"{fit.train}, {fit.trip}: running resistance", x=0.01, ha="left", fontsize=11, color=INK
    )
    write_figure(figure, path)


def _together(axes: Axes, fits: Fits) -> None:
    common = fits.common
    speed = _speeds(common.asked)
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
        label=f"{seen.size} windows of 10 s",
    )
    for number, fit in enumerate(fits.trips):
        axes.plot(
            KMH * speed,
            fit.resistance(speed) / KILONEWTON,
            color=SKY,
            linewidth=0.8,
            label="each trip" if number == 0 else None,
        )
    _curve(axes, common, speed, BLUE, "all trips: mean and its 95 % band")
    axes.set_ylim(*_limits(common.resistance(speed), drag))
    dress(axes, x="speed [km/h]", y="running resistance [kN]")
    axes.legend(fontsize=8, frameon=False, loc="upper left", markerscale=2)


def _differences(axes: Axes, fits: Fits) -> None:
    """Each configuration's curve over the common one, with one standard deviation."""
    common = fits.common
    speed = _speeds(common.asked)
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
    for number, configuration in enumerate(fits.parameters.configurations):
        axes.plot(
            KMH * speed,
            100.0 * (configuration.resistance(speed) / mean - 1.0),
            color=SKY,
            linewidth=0.9,
            label="observed configurations" if number == 0 else None,
        )
    axes.axhline(0.0, color=BLUE, linewidth=1.5)
    dress(axes, x="speed [km/h]", y="difference from the mean [%]")
    axes.legend(fontsize=8, frameon=False, loc="lower left")


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


def _curve(
    axes: Axes, fit: TripFit | CommonFit, speed: FloatArray, colour: str, label: str
) -> None:
    low, high = fit.band(speed)
    axes.fill_between(
        KMH * speed, low / KILONEWTON, high / KILONEWTON, color=colour, alpha=0.25, linewidth=0
    )
    axes.plot(
        KMH * speed, fit.resistance(speed) / KILONEWTON, color=colour, linewidth=1.8, label=label
    )


def _summary(fit: TripFit) -> str:
    r = fit.resistance
    return (
        f"{r.r0:.0f} N + {r.r1:.1f} N/(m/s) v + {r.r2:.2f} N/(m/s)² v²,"
        f" mass {fit.mass / TONNE:.1f} ± {fit.mass_std / TONNE:.1f} t"
    )


def _limits(curve: FloatArray, points: FloatArray) -> tuple[float, float]:
    """Range of the axis [kN]: the curve and nearly all points."""
    low, high = np.quantile(points, [0.02, 0.98])
    top = max(float(high), 1.15 * float(curve.max()))
    return min(float(low), 0.0) / KILONEWTON, top / KILONEWTON


def _speeds(asked: tuple[float, float]) -> FloatArray:
    """From standstill to the highest speed asked for [m/s]."""
    return np.linspace(0.0, asked[1], 120)

"""Pictures of the running resistance: the data, each trip's curve, all of them together.

---

Pictures of one trip: its fit and what the residuals say of it, or why it was refused.

---

Pictures of the coast-down: where the train coasted, and the curve with its band.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from scipy.special import ndtri

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    PURPLE,
    RED,
    SKY,
    dress,
    headline,
    legend,
    new_figure,
    write_figure,
)
from analysis.resistance.coast_down import CoastDown
from analysis.resistance.coasting_fit import TripCoastDown
from analysis.resistance.combination import CommonFit
from analysis.resistance.fit import TripFit
from analysis.resistance.logs import Fits
from analysis.resistance.recording import Timeline, TripRefusedError
from analysis.resistance.regression import LAGS, Residuals, diagnosed, powers
from trainlog.arrays import FloatArray, IntArray
from trainlog.display import counted
from trainlog.formats.parameters import CoastDownResult
from trainlog.formats.summaries import parameters_of
from trainlog.units import KMH

KILONEWTON, TONNE = 1e3, 1e3

MOST_DRAWN = 300
"""More curves than this are not drawn."""

ON_PALE = "#1a1a1a"
"""Text on a coloured ground, which stays what it is where a page turns dark."""

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
    trips = counted(len(fits.common.trips), "trip")
    count = len(fits.drives) - len(fits.common.trips) - len(fits.same)
    refused = f", {count} refused" if count else ""
    headline(figure, f"{fits.common.train}: running resistance from {trips}{refused}")
    write_figure(figure, path)


def _together(axes: Axes, fits: Fits) -> None:
    """Windows of the trips fitted now, each trip's curve, the common one with its band."""
    common = fits.common
    speed = speeds_to_draw(common.asked)
    drag = common.resistance(speed)
    if fits.trips:
        seen = np.concatenate([fit.points.speed[fit.points.used] for fit in fits.trips])
        drag = np.concatenate([fit.points.value[fit.points.used] for fit in fits.trips])
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
    accepted = fits.drives[fits.drives["refused"] == ""]
    curves = parameters_of(accepted)[_some(len(accepted)), :3] @ powers(speed).T
    lines = axes.plot(KMH * speed, curves.T / KILONEWTON, color=SKY, linewidth=0.8)
    lines[0].set_label(_counted("each trip", len(curves), len(accepted)))
    draw_curve(axes, common, speed, BLUE, "all trips: mean and its 95 % band")
    axes.set_ylim(*resistance_limits(common.resistance(speed), drag))
    dress(axes, x="speed [km/h]", y="running resistance [kN]")
    legend(axes, "upper left", markerscale=2)


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
    axes.set_ylim(low - 0.25 * (high - low), high)  # space for the legend
    low, high = axes.get_ylim()
    axes.set_ylim(low - 0.25 * (high - low), high)  # space for the legend
    legend(axes, "lower left")


def _per_trip(axes: Axes, fits: Fits) -> None:
    """Mass and power of each trip with their 95 % bands; of many trips the distribution."""
    accepted = fits.drives[fits.drives["refused"] == ""]
    mass = accepted["mass"].to_numpy(np.float64) / TONNE
    reach = 1.96 * np.sqrt(accepted["covariance_mass_mass"].to_numpy(np.float64)) / TONNE
    if len(accepted) > MOST_NAMED:
        axes.hist(mass, bins=40, color=SKY)
        dress(axes, x="mass [t]", y="trips", title=f"mass of {counted(len(accepted), 'trip')}")
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
        colour = "white" if abs(value) > 0.6 else ON_PALE
        axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=8, color=colour)
    axes.set_xticks(range(std.size), names)
    axes.set_yticks(range(std.size), names)
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.tick_params(colors=INK, labelsize=9, length=0)
    for side in axes.spines.values():
        side.set_visible(False)


def _some(count: int) -> IntArray:
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
    doubts = "\n".join(diagnosis.doubts) or "residuals as the noise model expects them"
    dress(over_time, x="time [min]", y="residual [σ]", title=doubts)
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
    headline(figure, f"{fit.train}, {fit.trip}: running resistance")
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
    headline(figure, title, colour=RED, size=10.0)
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
    legend(axes, "lower right", bbox_to_anchor=(1.0, 1.0), ncols=4)


def _data(axes: Axes, fit: TripFit) -> None:
    speed = speeds_to_draw(fit.asked)
    points, used = fit.points, fit.points.used
    axes.errorbar(
        KMH * points.speed[used],
        points.value[used] / KILONEWTON,
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
            points.value[~used] / KILONEWTON,
            "x",
            color=RED,
            label=f"{int((~used).sum())} outliers, axes out",
        )
    draw_curve(axes, fit, speed, BLUE, "fitted, 95 % band of the whole curve")
    axes.set_ylim(*resistance_limits(fit.resistance(speed), points.value[used]))
    dress(axes, x="speed [km/h]", y="running resistance [kN]", title=_summary(fit))
    legend(axes, "upper left")


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
    legend(axes, "upper right")


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


def _p(probability: float, what: str) -> str:
    return f"{what}: p = {probability:.2g}"


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
            legend(axes, "lower left", ncols=3)
    _curve(figure.add_subplot(grid[:, 1]), found)
    refused = f", {len(found.refused)} refused" if found.refused else ""
    count = len(found.trips)
    headline(
        figure,
        f"{found.train or 'train'}: running resistance from the coasting of"
        f" {count} trip{'s' if count > 1 else ''}{refused}",
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
    legend(left, "upper left")
    _curve_without_gradient(right, result)
    headline(figure, "Coasting with the gradient unknown")
    write_figure(figure, path)


def _curve_without_gradient(axes: Axes, result: CoastDownResult) -> None:
    """The curve, or what it is without its constant part."""
    curve = result.curve
    if curve is not None:
        speed, value, low, high = curve.speeds, curve.deceleration, curve.low, curve.high
        what, title = (
            "running resistance over inertia [m/s²]",
            "all of it, by pieces coasted both ways",
        )
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
    legend(axes, "upper left")
    dress(axes, x="speed [km/h]", y=what, title=title)


def _segments(axes: Axes, fit: TripCoastDown) -> None:
    motion = fit.motion
    kilometre, speed = motion.position / 1e3, KMH * motion.speed
    axes.plot(kilometre, speed, color=GREY, linewidth=0.7, label="speed")
    for segments, colour, label in (
        (fit.segments, BLUE, "coasting"),
        (fit.outlier_segments, RED, "left out: contradicts the others"),
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
    legend(axes, "upper left")


def _windows(axes: Axes, trips: Sequence[TripCoastDown]) -> None:
    speed, value, std, used = (
        np.concatenate([getattr(fit.points, name) for fit in trips])
        for name in ("speed", "value", "std", "used")
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

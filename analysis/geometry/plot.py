"""Picture of a line built from satellite fixes: where it goes, how it bends, what it rests on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from analysis.charts import (
    BLUE,
    GREY,
    ORANGE,
    RED,
    SKY,
    dress,
    headline,
    new_figure,
    write_figure,
)
from analysis.geometry.centre_line import CentreLine
from trainlog.display import counted
from trainlog.railway.geometry import to_plane
from trainlog.trip import Trip
from trainlog.units import PER_MILLE

KILOMETRE = 1e3


def draw_centre_line(centre_line: CentreLine, trips: Sequence[Trip], path: str | Path) -> None:
    """Draw a surveyed line: plan with the fixes, curvature with its band, support.

    Parameters
    ----------
    centre_line : CentreLine
    trips : sequence of Trip
        That it was made from.
    path : path
        Of the PNG.
    """
    climbs = centre_line.heights is not None
    figure = new_figure(11.0, 9.5 if climbs else 7.5)
    grid = figure.add_gridspec(4 if climbs else 3, 1, height_ratios=(4, 2, *[2] * climbs, 1))
    _plan(figure.add_subplot(grid[0]), centre_line, trips)
    bend = figure.add_subplot(grid[1])
    _curvature(bend, centre_line)
    if climbs:
        _gradient(figure.add_subplot(grid[2], sharex=bend), centre_line)
    _support(figure.add_subplot(grid[-1], sharex=bend), centre_line)
    refused = f", {len(centre_line.refused)} refused" if centre_line.refused else ""
    used = counted(len(centre_line.used), "trip")
    headline(
        figure,
        f"{centre_line.length / KILOMETRE:.3f} km from {used}{refused},"
        f" {centre_line.fixes} fixes, {centre_line.rejected} of them set aside",
    )
    write_figure(figure, path)


def _plan(axes: Axes, centre_line: CentreLine, trips: Sequence[Trip]) -> None:
    origin = (float(centre_line.latitude.mean()), float(centre_line.longitude.mean()))
    for number, trip in enumerate(t for t in trips if t.name in centre_line.used):
        fix = trip["/gnss/fix"]
        points = to_plane(fix["latitude"].to_numpy(), fix["longitude"].to_numpy(), origin)
        name = "fixes" if number == 0 else None
        axes.plot(
            points.real / KILOMETRE, points.imag / KILOMETRE, ".", color=GREY, ms=2, label=name
        )
    line = to_plane(centre_line.latitude, centre_line.longitude, origin) / KILOMETRE
    axes.plot(line.real, line.imag, color=BLUE, lw=1.2, label="line")
    for number, (start, end) in enumerate(centre_line.unsupported):
        bridged = (centre_line.position >= start) & (centre_line.position <= end)
        name = "no fixes" if number == 0 else None
        axes.plot(line[bridged].real, line[bridged].imag, color=RED, lw=2.5, label=name)
    axes.plot(line[0].real, line[0].imag, "o", color=ORANGE, ms=7, label="km 0")
    axes.set_aspect("equal", adjustable="datalim")
    dress(axes, x="east [km]", y="north [km]")
    axes.legend(frameon=False, fontsize=8)


def _curvature(axes: Axes, centre_line: CentreLine) -> None:
    at = centre_line.position / KILOMETRE
    known = np.where(centre_line.support > 0, 1.0, np.nan) * KILOMETRE
    bend, std = centre_line.curvature * known, centre_line.curvature_std * known
    axes.fill_between(at, bend - 1.96 * std, bend + 1.96 * std, color=SKY, alpha=0.4, lw=0)
    axes.plot(at, bend, color=BLUE, lw=0.9)
    dress(axes, x="", y="curvature [1/km]", title="Curvature, to the right positive; 95 % band")


def _gradient(axes: Axes, centre_line: CentreLine) -> None:
    heights = centre_line.heights
    assert heights is not None
    at = heights.position / KILOMETRE
    known = np.where(heights.known, PER_MILLE, np.nan)
    slope, std = heights.gradient * known, heights.gradient_std * known
    axes.fill_between(at, slope - 1.96 * std, slope + 1.96 * std, color=SKY, alpha=0.4, lw=0)
    axes.plot(at, slope, color=BLUE, lw=0.9)
    title = "Gradient over 500 m, from the trips' altitudes; 95 % band"
    dress(axes, x="", y="gradient [‰]", title=title)


def _support(axes: Axes, centre_line: CentreLine) -> None:
    axes.fill_between(
        centre_line.position / KILOMETRE,
        centre_line.support,
        step="mid",
        color=SKY,
        lw=0,
        alpha=0.7,
    )
    axes.set_ylim(bottom=0.0)
    dress(axes, x="chainage [km]", y="trips")

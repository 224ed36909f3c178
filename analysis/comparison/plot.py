"""Picture of a comparison: speeds, time lost and its causes, energy along the line."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

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
    km_axis,
    legend,
    new_figure,
)
from analysis.comparison.compare import ComparedDirection, ComparedTrip
from analysis.comparison.losses import CAUSES
from trainlog.units import JOULES_PER_KWH, KMH

TRIP_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)

CAUSE_COLOURS = {
    "start": "#5b5b5b",
    "dwell": BLUE,
    "stop": SKY,
    "held": RED,
    "limit": ORANGE,
    "slip": PURPLE,
    "full effort": "#b8860b",
    "slower": "#9a9a9a",
    "faster": GREEN,
    "recording": "#e8c8c8",
}

MOST = 6
"""Trips whose speeds are drawn one by one; of more, those that lost most."""


def comparison_figure(found: ComparedDirection) -> Figure:
    """Trips of a direction by position: speed, time lost, causes by section, energy.

    Parameters
    ----------
    found : ComparedDirection
    """
    shown = _shown(found)
    energy = any("traction" in each.trip.sums for each in shown)
    heights = [3.0, 2.0, *([1.6] if energy else []), 2.4]
    figure = new_figure(11.0, 1.15 * sum(heights))
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    top = figure.add_subplot(grid[0])
    axes = [top, *(figure.add_subplot(grid[row], sharex=top) for row in range(1, len(heights) - 1))]
    _speeds(axes[0], found, shown)
    _behind(axes[1], shown)
    if energy:
        _work(axes[2], shown)
    for each in axes:
        _stations(each, found)
        each.set_xlim(*(found.sections.edges[[0, -1]] / 1e3))
    for each in axes[:-1]:
        each.tick_params(labelbottom=False)
    km_axis(axes[-1], found.line, "km in the direction of travel")
    _causes(figure.add_subplot(grid[-1]), shown)
    reference = "the trajectory" if found.reference.planned else f"'{found.reference.name}'"
    more = f", {len(shown)} of them shown" if len(shown) < len(found.trips) else ""
    headline(
        figure,
        f"{found.line.name}, {found.direction}: {len(found.trips)} trips against {reference}{more}",
    )
    return figure


def _shown(found: ComparedDirection) -> list[ComparedTrip]:
    """The reference, and the trips that lost most."""
    others = [each for each in found.trips if each.trip is not found.reference]
    others.sort(key=lambda each: 0.0 if each.lost is None else -abs(each.lost.total))
    own = [each for each in found.trips if each.trip is found.reference]
    return [*own, *others[: MOST - len(own)]]


def _colour(row: int) -> str:
    return TRIP_COLOURS[row % len(TRIP_COLOURS)]


def _speeds(axes: Axes, found: ComparedDirection, shown: list[ComparedTrip]) -> None:
    dress(axes, x="", y="speed [km/h]")
    first, last = found.sections.edges[[0, -1]].tolist()
    place = np.linspace(first, last, 2000)
    limit = KMH * found.reference.permitted(place)
    axes.step(place / 1e3, limit, where="post", color=GREY, linewidth=1.0, label="limit")
    if found.reference.planned:
        reference = found.reference
        axes.plot(reference.position / 1e3, KMH * reference.speed, color=INK, linewidth=1.6,
                  linestyle="--", label="trajectory")  # fmt: skip
    for row, each in enumerate(shown):
        axes.plot(
            each.trip.position / 1e3,
            KMH * each.trip.drawn_speed,
            color=_colour(row),
            linewidth=1.2,
            label=each.name,
        )
        lower = each.trip.signals.get("limit")
        if lower is not None:
            below = lower < each.trip.permitted(each.trip.position) - 0.5
            if below.any():
                axes.plot(
                    each.trip.position / 1e3,
                    np.where(below, KMH * lower, np.nan),
                    color=_colour(row),
                    linestyle=":",
                    linewidth=1.8,
                    label=f"lower limit of {each.name}",
                )
    axes.set_ylim(0.0, 1.35 * float(limit.max()))
    legend(axes, ncols=4)


def _behind(axes: Axes, shown: list[ComparedTrip]) -> None:
    dress(axes, x="", y="behind the\nreference [s]")
    axes.axhline(0.0, color=INK, linewidth=0.8)
    for row, each in enumerate(shown):
        if each.lost is not None:
            axes.plot(each.lost.position / 1e3, each.lost.behind, color=_colour(row), linewidth=1.3)


def _work(axes: Axes, shown: list[ComparedTrip]) -> None:
    dress(axes, x="", y="tractive work\n[kWh]")
    for row, each in enumerate(shown):
        work = each.trip.sums.get("traction")
        if work is not None:
            axes.plot(
                each.trip.position / 1e3,
                work / JOULES_PER_KWH,
                color=_colour(row),
                linewidth=1.3,
            )


def _stations(axes: Axes, found: ComparedDirection) -> None:
    for place in found.sections.edges:
        axes.axvline(place / 1e3, color=PALE, linewidth=1.0, zorder=0)
    if axes.get_ylabel().startswith("speed"):
        top = axes.get_ylim()[1]
        for name, place in zip(found.sections.ends, found.sections.edges, strict=True):
            last = place == found.sections.edges[-1]
            axes.text(
                place / 1e3,
                1.01 * top,
                name,
                fontsize=8,
                color=INK,
                ha="right" if last else "left",
                va="bottom",
            )


def _causes(axes: Axes, shown: list[ComparedTrip]) -> None:
    """Seconds lost and gained by each trip, stacked by cause."""
    dress(axes, x="lost [s] (left of 0: gained)", y="")
    compared = [each for each in shown if each.lost is not None]
    used: list[str] = []
    for row, each in enumerate(compared):
        assert each.lost is not None
        ends = {True: 0.0, False: 0.0}
        for cause in CAUSES:
            seconds = each.lost.by_cause().get(cause, 0.0)
            if abs(seconds) < 0.05:
                continue
            positive = seconds > 0.0
            axes.barh(row, seconds, left=ends[positive], height=0.62, color=CAUSE_COLOURS[cause])
            ends[positive] += seconds
            used.append(cause)
        axes.text(
            ends[True], row, f"  {each.lost.total:+.0f} s", va="center", fontsize=8, color=INK
        )
    axes.axvline(0.0, color=INK, linewidth=0.8)
    axes.set_yticks(range(len(compared)), [each.name for each in compared])
    axes.invert_yaxis()
    axes.margins(x=0.12)
    axes.grid(visible=False, axis="y")
    handles = [Patch(color=CAUSE_COLOURS[cause], label=cause) for cause in CAUSES if cause in used]
    axes.legend(
        handles=handles,
        fontsize=8,
        frameon=False,
        ncols=len(handles),
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
    )

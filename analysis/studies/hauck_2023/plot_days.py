"""One picture of two days on a bad rail: what the map knew, where axles slipped, who was late."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from analysis.plotting import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    RED,
    dress,
    new_figure,
    write_figure,
)
from analysis.studies.hauck_2023.days import Day, Days
from trainlog.errors import InputError

FloatArray = NDArray[np.float64]

PIECE = 500.0
"""Over which slips are counted [m]."""

MARGIN = 0.5
"""On either side of the line [km]."""

FIRST, LAST = RED, BLUE
"""Colours of the first and of the last day."""


def draw_days(days: Days, path: Path) -> None:
    """Draw the first and the last of the days above each other along the line.

    Parameters
    ----------
    days : Days
        Two at least.
    path : path
        PNG file.

    Raises
    ------
    InputError
        If there is only one day.
    """
    if len(days.days) < 2:
        raise InputError("one day alone shows no gain", remedy="drive two days at least")
    first, last = days.days[0], days.days[-1]
    figure = new_figure(11.0, 9.5)
    places = figure.subplots(3, 1, sharex=True, height_ratios=(1.3, 1.0, 1.0))
    _draw_rail(places[0], last)
    _draw_slips(places[1], first, last)
    _draw_lateness(places[2], days, first, last)
    for axes in places:
        for stop in days.stops:
            axes.axvline(stop.position / 1e3, color=PALE, linewidth=0.6, zorder=0)
    places[2].set_xlim(-MARGIN, days.stops[-1].position / 1e3 + MARGIN)
    below = places[2].secondary_xaxis(-0.16)
    below.set_xticks(
        [stop.position / 1e3 for stop in days.stops],
        [stop.station for stop in days.stops],
        rotation=40, ha="right", rotation_mode="anchor", fontsize=6.5, color=GREY,
    )  # fmt: skip
    below.tick_params(length=0)
    below.spines["bottom"].set_visible(False)
    write_figure(figure, path)


def _draw_rail(axes: Axes, day: Day) -> None:
    """The rail as it was, and what the day's controllers counted on."""
    track, known = day.track, day.known
    if track is None or known is None:
        raise InputError("the last day was driven without a map", remedy="give it the first's")
    km = track.centres / 1e3
    axes.plot(km, day.rail(track.centres), color=GREY, linewidth=0.7, label="the rail as it is")
    for where, colour, mark, size, label in (
        (known.assumed, ORANGE, "_", 4.0, "assumed"),
        (known.demonstrated, GREEN, "o", 3.0, "used without slip"),
        (known.seen, BLUE, "o", 4.0, "seen: slip has shown the maximum"),
    ):
        if not where.any():
            continue
        axes.plot(
            km[where], known.values[where], color=colour, linestyle="", marker=mark,
            markersize=size, label=f"{label}, {np.count_nonzero(where)} bins",
        )  # fmt: skip
    axes.legend(frameon=False, fontsize=8, ncols=4, loc="upper left")
    axes.set_ylim(0.03, 0.145)
    dress(
        axes, x="", y="maximum adhesion",
        title=f"What day {day.number} counts on, from the logs of the days before",
    )  # fmt: skip


def _draw_slips(axes: Axes, first: Day, last: Day) -> None:
    """How often axles began to slip along the line: the first day up, the last one down."""
    for day, sign, colour in ((first, 1.0, FIRST), (last, -1.0, LAST)):
        edges, counts = slips_along(day)
        axes.bar(
            edges[:-1] / 1e3, sign * counts, PIECE / 1e3, align="edge", color=colour,
            label=f"day {day.number}: {day.slip_events} times,"
            f" {day.skid_energy / 1e6:.2f} MJ beyond the peak",
        )  # fmt: skip
    top = max(float(slips_along(first)[1].max()), 5.0)
    low = max(float(slips_along(last)[1].max()), 0.2 * top)
    axes.set_ylim(-1.15 * low, 1.15 * top)
    axes.yaxis.set_major_formatter(lambda value, _: f"{abs(value):.0f}")
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper right")
    dress(
        axes, x="", y=f"axles, in {PIECE:.0f} m",
        title=f"Axles that begin to skid or slide, {len(first.runs)} trips a day:"
        f" day {first.number} upwards, day {last.number} downwards",
    )  # fmt: skip


def _draw_lateness(axes: Axes, days: Days, first: Day, last: Day) -> None:
    """The latest of the trips at every stop."""
    km = np.array([stop.position for stop in days.stops[1:]]) / 1e3
    width = 0.006 * (days.stops[-1].position - days.stops[0].position) / 1e3
    for day, side, colour in ((first, -0.5, FIRST), (last, 0.5, LAST)):
        late = days.late(day)
        axes.bar(
            km + side * width, late.max(axis=0), 0.95 * width, color=colour,
            label=f"day {day.number}: latest {late.max():.1f} s, mean {late.mean():.1f} s",
        )  # fmt: skip
    worst = [days.late(day).max(axis=0) for day in (first, last)]
    axes.set_ylim(min(0.0, float(np.min(worst))), 1.3 * max(0.5, float(np.max(worst))))
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper right")
    dress(axes, x="km", y="s", title="Late at the stops, the latest of the trips; below 0: early")


def slips_along(day: Day) -> tuple[FloatArray, FloatArray]:
    """Edges [m] of equal pieces of the line, and how often an axle began to slip in each."""
    length = day.runs[0].line.length
    edges = PIECE * np.arange(int(np.ceil(length / PIECE)) + 1, dtype=np.float64)
    counts = np.zeros(edges.size - 1)
    for each in day.runs:
        begun = np.diff(each.slipping.astype(np.int8), axis=0, prepend=0) > 0
        counts += np.histogram(each.position, edges, weights=begun.sum(axis=1))[0]
    return edges, counts

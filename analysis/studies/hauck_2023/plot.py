"""The figures of Hauck et al. (2023), and a picture of days in a row on a bad rail."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    PURPLE,
    RED,
    SKY,
    dress,
    legend,
    new_figure,
    write_figure,
)
from analysis.studies.hauck_2023.scenarios import Day, Days, Outcome, Setup
from analysis.studies.hauck_2023.simulation import Run
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.units import KMH, PER_MILLE

PICTURES = (
    "figure-02-map.png",
    "figure-03-speed.png",
    "figure-04-errors.png",
    "figure-05-constraints-good.png",
    "figure-06-constraints-bad.png",
    "figure-07-delay.png",
    "with-and-without-map.png",
)

SECTIONS = 3
"""Drawn of the speed, as in the paper."""

BIN = 100.0
"""Over which the largest constraint is drawn [m]."""


def draw_study(setup: Setup, outcomes: Sequence[Outcome], folder: Path) -> list[Path]:
    """Draw the paper's figures; returns the pictures' paths.

    Parameters
    ----------
    setup : Setup
    outcomes : sequence of Outcome
        Of the three scenarios, in their order.
    folder : path
    """
    good, bad, late = (each.informed for each in outcomes)
    bad_blind = outcomes[1].blind
    paths = [folder / name for name in PICTURES]
    _draw_map(setup, paths[0])
    _draw_speed(good, paths[1])
    _draw_errors(good, paths[2])
    _draw_constraints(good, "Fig. 5  Constraints, good track", paths[3])
    _draw_constraints(bad, "Fig. 6  Constraints, bad track", paths[4])
    _draw_delay(late, outcomes[2], paths[5])
    if bad_blind is not None:
        _draw_gain(bad, bad_blind, ("with the map", "without the map"), paths[6])
    return [path for path in paths if bad_blind is not None or path != paths[6]]


def _draw_map(setup: Setup, path: Path) -> None:
    """Fig. 2: limits, gradient and both rails."""
    figure = new_figure(10.0, 8.0)
    places = figure.subplots(3, 1, sharex=True)
    line = setup.plan[0].section.line
    s = np.arange(0.0, line.length, 25.0)
    places[0].plot(s / 1e3, line.speed_limit(s) * KMH, color=RED, drawstyle="steps-post")
    for station in line.stations:
        places[0].axvline(station.position / 1e3, color=GREY, linewidth=1.0, linestyle=":")
    dress(
        places[0],
        x="",
        y="km/h",
        title="Fig. 2  Map (reconstruction): speed limits; stations dotted",
    )
    places[1].plot(s / 1e3, line.gradient(s) * PER_MILLE, color=GREEN, drawstyle="steps-post")
    dress(places[1], x="", y="per mille", title="Gradient")
    for name, colour in (("good", BLUE), ("bad", ORANGE)):
        places[2].plot(s / 1e3, setup.rails[name](s), color=colour, linewidth=0.8, label=name)
    places[2].legend(frameon=False, fontsize=8, ncols=2)
    dress(places[2], x="km", y="maximum adhesion", title="Maximum adhesion")
    places[2].set_ylim(0.0)
    write_figure(figure, path)


def _draw_speed(run: Run, path: Path) -> None:
    """Fig. 3: speed of the reference and of the train on the first sections."""
    figure = new_figure(10.0, 4.5)
    axes = figure.subplots()
    rows = run.section < SECTIONS
    minutes = run.time[rows] / 60.0
    axes.plot(minutes, run.target[rows, 1] * KMH, color=PALE, linewidth=4.0, label="reference")
    axes.plot(minutes, run.speed[rows] * KMH, color=BLUE, linewidth=1.0, label="train")
    limit = np.where(run.speed[rows] > 0.0, run.line.speed_limit(run.position[rows]), np.nan)
    axes.plot(minutes, limit * KMH, color=RED, linewidth=0.8, label="limit")
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="upper right")
    axes.set_ylim(-2.0, 115.0)
    title = f"Fig. 3  Speed, first {SECTIONS} sections, good track, {run.mass / 1e3:.1f} t"
    dress(axes, x="min", y="km/h", title=title)
    write_figure(figure, path)


def _draw_errors(run: Run, path: Path) -> None:
    """Fig. 4: errors of position and speed."""
    figure = new_figure(10.0, 6.0)
    first, second = figure.subplots(2, 1, sharex=True)
    first.plot(run.time / 60.0, run.position_error, color=BLUE, linewidth=0.8)
    dress(
        first, x="", y="m",
        title=f"Fig. 4  Position less the reference's, {run.mass / 1e3:.1f} t, good track",
    )  # fmt: skip
    second.plot(run.time / 60.0, run.speed_error, color=GREEN, linewidth=0.8)
    dress(second, x="min", y="m/s", title="Speed less the reference's")
    write_figure(figure, path)


def _draw_constraints(run: Run, title: str, path: Path) -> None:
    """Figs. 5 and 6: the largest of the safety and of the traction constraints along the line."""
    figure = new_figure(10.0, 6.0)
    first, second = figure.subplots(2, 1, sharex=True)
    for column, colour, label in (
        (0, BLUE, "comfort: acceleration less 1 m/s² (safety, h1 and h2)"),
        (1, ORANGE, "adhesion: effort over mass less what the rail bears (traction, h3 and h4)"),
    ):
        x, y = _largest(run, run.constraints[:, column])
        first.plot(x / 1e3, y, color=colour, linewidth=0.8, label=label)
    first.legend(edgecolor="none", framealpha=1.0, fontsize=8, loc="lower left")
    first.set_ylim(-1.5, 0.1)
    dress(
        first, x="", y="m/s²",
        title=f"{title}, {run.mass / 1e3:.1f} t; kept where not above 0, for every mass",
    )  # fmt: skip
    x, y = _largest(run, run.constraints[:, 2])
    second.plot(x / 1e3, y * KMH, color=RED, linewidth=0.8)
    dress(second, x="km", y="km/h", title="Speed less its limit (h5)")
    for axes in (first, second):
        axes.axhline(0.0, color=GREY, linewidth=1.0)
    write_figure(figure, path)


def _draw_delay(run: Run, outcome: Outcome, path: Path) -> None:
    """Fig. 7: error of position after a late departure, and lateness at the stops."""
    figure = new_figure(10.0, 6.0)
    first, second = figure.subplots(2, 1)
    rows = run.section < SECTIONS
    first.plot(run.time[rows] / 60.0, run.position_error[rows], color=BLUE, linewidth=1.0)
    title = f"Fig. 7  Position less the reference's, {run.delay:g} s late at first"
    dress(first, x="min", y="m", title=f"{title}, {run.mass / 1e3:.1f} t")
    late = np.concatenate([[run.delay], run.late])
    numbers = np.arange(late.size)
    second.bar_label(
        second.bar(numbers, late, 0.5, color=BLUE, label="reached"),
        fmt="%.1f",
        padding=4,
        fontsize=7,
    )
    for bound, colour, width, label in (
        (outcome.unweighed, ORANGE, 3.0, "least by the shortest times, mass not known"),
        (outcome.bound, GREY, 1.0, "least, mass known"),
    ):
        least = np.maximum(np.concatenate([[run.delay], bound]), 0.0)
        second.plot(numbers, least, color=colour, linewidth=width, marker=".", label=label)
    second.legend(frameon=False, fontsize=8)
    second.set_ylim(min(float(late.min()), 0.0) - 5.0, 1.15 * float(late.max()))
    second.set_xticks(numbers)
    names = [stop.station for stop in run.stops]
    second.set_xticklabels(names, rotation=40, ha="right", fontsize=7)
    dress(
        second,
        x="",
        y="s",
        title="Lateness at the first departure, then on arrival; below 0: early",
    )
    write_figure(figure, path)


def _draw_gain(one: Run, other: Run, names: tuple[str, str], path: Path) -> None:
    """Slip with the map and without it."""
    figure = new_figure(10.0, 6.0)
    places = figure.subplots(2, 1, sharex=True, sharey=True)
    for axes, run, name in zip(places, (one, other), names, strict=True):
        _slips(axes, (run,))
        dress(
            axes, x="", y="largest slip [m/s]",
            title=f"Bad track, {name}: {run.slip_events} times an axle skids or slides,"
            f" {run.skid_energy / 1e6:.2f} MJ beyond the peak",
        )  # fmt: skip
    places[1].set_xlabel("km")
    places[1].set_xlim(0.0, float(one.places[-1]) / 1e3)
    write_figure(figure, path)


def _slips(axes: Axes, runs: Sequence[Run]) -> None:
    """Largest slip along the line: stable creep as grey lines, beyond the peak as red dots."""
    axes.plot([], color=GREY, linewidth=0.5, label="stable creep")
    axes.plot([], color=RED, linestyle="", marker=".", label="beyond the peak")
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper right")
    for run in runs:
        slip = np.abs(run.slip_speed)
        x, y = _largest(run, np.max(slip, axis=1, initial=-np.inf, where=~run.slipping))
        axes.plot(x / 1e3, y, color=GREY, linewidth=0.5)
        x, y = _largest(run, np.max(slip, axis=1, initial=-np.inf, where=run.slipping))
        axes.plot(x / 1e3, y, color=RED, linestyle="", marker=".", markersize=4.0)


def _largest(run: Run, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The largest value in each piece of the line; NaN where there is none."""
    count = int(np.ceil(run.line.length / BIN))
    found = np.full(count, -np.inf)
    index = np.minimum((run.position / BIN).astype(np.int64), count - 1)
    np.maximum.at(found, index, np.where(np.isfinite(values), values, -np.inf))
    centres = (np.arange(count, dtype=np.float64) + 0.5) * BIN
    return centres, np.where(np.isfinite(found), found, np.nan)


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
        Of one day alone its slips and its lateness are drawn.
    path : path
        PNG file.
    """
    shown = (days.days[0],) if len(days.days) == 1 else (days.days[0], days.days[-1])
    figure = new_figure(11.0, 9.5 if len(shown) > 1 else 6.5)
    if len(shown) > 1:
        places = list(figure.subplots(3, 1, sharex=True, height_ratios=(1.3, 1.0, 1.0)))
        _draw_rail(places[0], shown[-1])
    else:
        places = list(figure.subplots(2, 1, sharex=True))
    _draw_slips(places[-2], shown)
    _draw_lateness(places[-1], days, shown)
    for axes in places:
        for stop in days.stops:
            axes.axvline(stop.position / 1e3, color=PALE, linewidth=0.6, zorder=0)
    places[-1].set_xlim(-MARGIN, days.stops[-1].position / 1e3 + MARGIN)
    below = places[-1].secondary_xaxis(-0.16)
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
        raise InputError(
            "the last day was driven without a map", remedy="give it the map of the first"
        )
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


def _draw_slips(axes: Axes, shown: Sequence[Day]) -> None:
    """How often axles began to slip along the line: the first day up, the last one down."""
    first, last = shown[0], shown[-1]
    for day, sign, colour in zip(shown, (1.0, -1.0), (FIRST, LAST), strict=False):
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
        title=f"Axles that begin to skid or slide, {len(first.runs)} trips a day"
        + (f": day {first.number} upwards, day {last.number} downwards" if len(shown) > 1 else ""),
    )  # fmt: skip


def _draw_lateness(axes: Axes, days: Days, shown: Sequence[Day]) -> None:
    """The latest of the trips at every stop."""
    km = np.array([stop.position for stop in days.stops[1:]]) / 1e3
    width = 0.006 * (days.stops[-1].position - days.stops[0].position) / 1e3
    for day, side, colour in zip(shown, (-0.5, 0.5), (FIRST, LAST), strict=False):
        late = days.late(day)
        axes.bar(
            km + side * width, late.max(axis=0), 0.95 * width, color=colour,
            label=f"day {day.number}: latest {late.max():.1f} s, mean {late.mean():.1f} s",
        )  # fmt: skip
    worst = [days.late(day).max(axis=0) for day in shown]
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


def draw_risks(driven: Mapping[str, Days], path: Path) -> None:
    """Draw slips, work of creep and lateness day by day, by how the map was read.

    Parameters
    ----------
    driven : mapping of str to Days
    path : path
        PNG file.
    """
    figure = new_figure(9.0, 8.0)
    places = figure.subplots(3, 1, sharex=True)
    colours = (GREY, ORANGE, GREEN, BLUE, RED, PURPLE, SKY)
    for (name, days), colour in zip(driven.items(), colours, strict=False):
        number = [day.number for day in days.days]
        rows = (
            [day.slip_events for day in days.days],
            [day.slip_energy / 1e6 for day in days.days],
            [days.late(day).max() for day in days.days],
        )
        for axes, values in zip(places, rows, strict=True):
            axes.plot(number, values, ".-", color=colour, label=name, linewidth=1.0)
    titles = (
        ("axles", "Axles that begin to skid or slide, all trips of the day"),
        ("MJ", "All work of creep"),
        ("s", "Latest arrival at any stop"),
    )
    for axes, (y, title) in zip(places, titles, strict=True):
        dress(axes, x="", y=y, title=title)
    places[0].set_ylim(bottom=0.0)
    legend(places[0], "upper right", ncols=3)
    places[-1].set_xlabel("day; the first is driven without a map")
    places[-1].xaxis.get_major_locator().set_params(integer=True)
    write_figure(figure, path)

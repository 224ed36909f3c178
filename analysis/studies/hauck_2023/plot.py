"""The figures of paper 000, drawn from runs of `analysis.studies.hauck_2023.run`."""

from __future__ import annotations

from collections.abc import Sequence
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
from analysis.studies.hauck_2023.run import Run
from analysis.studies.hauck_2023.scenarios import Outcome, World
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


def draw_study(world: World, outcomes: Sequence[Outcome], folder: Path) -> list[Path]:
    """Draw the paper's figures; returns the pictures' paths.

    Parameters
    ----------
    world : World
    outcomes : sequence of Outcome
        Of the three scenarios, in their order.
    folder : path
    """
    good, bad, late = (each.informed for each in outcomes)
    paths = [folder / name for name in PICTURES]
    _draw_map(world, paths[0])
    _draw_speed(good, paths[1])
    _draw_errors(good, paths[2])
    _draw_constraints(good, "Fig. 5  Constraints, good track", paths[3])
    _draw_constraints(bad, "Fig. 6  Constraints, bad track", paths[4])
    _draw_delay(late, outcomes[2], paths[5])
    _draw_gain(
        outcomes[1].informed, outcomes[1].blind, ("with the map", "without the map"), paths[6]
    )
    return paths


def _draw_map(world: World, path: Path) -> None:
    """Fig. 2: limits, gradient and both rails."""
    figure = new_figure(10.0, 8.0)
    places = figure.subplots(3, 1, sharex=True)
    line = world.plan[0].section.line
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
        places[2].plot(s / 1e3, world.rails[name](s), color=colour, linewidth=0.8, label=name)
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


def _largest(
    run: Run, values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The largest value in each piece of the line; NaN where there is none."""
    count = int(np.ceil(run.line.length / BIN))
    found = np.full(count, -np.inf)
    index = np.minimum((run.position / BIN).astype(np.int64), count - 1)
    np.maximum.at(found, index, np.where(np.isfinite(values), values, -np.inf))
    centres = (np.arange(count, dtype=np.float64) + 0.5) * BIN
    return centres, np.where(np.isfinite(found), found, np.nan)

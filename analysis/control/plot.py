"""Picture of trips that followed a trajectory: reference and reality over km."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from analysis.adhesion.events import protection_onsets
from analysis.plotting import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    PALE,
    RED,
    dress,
    new_figure,
    write_figure,
)
from trainlog.errors import LogError
from trainlog.formats.attached import line_of
from trainlog.railway import Line
from trainlog.trip import Trip
from trainlog.units import KMH

FloatArray = NDArray[np.float64]

TOPICS = ("/train/state", "/train/controls", "/reference", "/events")
"""What the picture is drawn from."""


def draw_following(trips: Sequence[Trip], path: str | Path) -> None:
    """Draw trips that followed one trajectory.

    Speed of all of them over the reference and the limits, with the places where wheels slipped;
    efforts of the first and of the last; how far behind the reference they were; their speed less
    the reference's.

    Parameters
    ----------
    trips : sequence of Trip
        With the `TOPICS`, on one line and in one direction.
    path : path
        PNG file.

    Raises
    ------
    LogError
        If there is no trip, or one has no reference.
    """
    if not trips:
        raise LogError("no trip to draw", remedy="give one that followed a trajectory")
    for trip in trips:
        if "/reference" not in trip:
            raise LogError(
                f"trip '{trip.name}' followed no trajectory: it has no /reference",
                remedy="give the trips of 'trainlog simulate --trajectory'",
            )
    forward = trips[0].metadata.get("direction", "forward") == "forward"
    line = line_of(trips[0]) if forward else line_of(trips[0]).reversed()
    figure = new_figure(11.0, 9.5)
    places = figure.subplots(4, 1, sharex=True, height_ratios=[3.0, 1.4, 1.0, 1.0])
    _draw_speeds(places[0], trips, line)
    _draw_efforts(places[1], trips)
    for trip in trips:
        km = _km(trip)
        places[2].plot(km, _under_way(trip, trip["/reference"]["lateness"]), color=BLUE, lw=0.6)
        error = trip["/train/state"]["speed"] - trip["/reference"]["speed"]
        places[3].plot(km, KMH * _under_way(trip, error), color=BLUE, lw=0.4, alpha=0.5)
    dress(places[2], x="", y="s", title="Behind the reference")
    dress(places[3], x="", y="km/h", title="Speed, as measured, less the reference's")
    for axes in places[2:]:
        axes.axhline(0.0, color=INK, linewidth=0.6)
    places[-1].set_xlabel("km", color=INK)
    places[-1].set_xlim(0.0, line.length / 1e3)
    figure.align_ylabels(places)
    write_figure(figure, path)


def _km(trip: Trip) -> FloatArray:
    return trip["/train/state"]["position"].to_numpy() / 1e3


def _under_way(trip: Trip, values: object) -> FloatArray:
    """Values while the train moves, NaN while it stands."""
    moving = trip["/train/state"]["speed"].to_numpy() > 0.0
    return np.where(moving, np.asarray(values, dtype=np.float64), np.nan)


def _draw_speeds(axes: Axes, trips: Sequence[Trip], line: Line) -> None:
    edges = np.append(line.speed_limits.positions, line.length)
    axes.stairs(
        KMH * line.speed_limits.values, edges / 1e3, baseline=None, color=INK, linewidth=1.2,
        label="permitted speed",
    )  # fmt: skip
    reference = KMH * trips[0]["/reference"]["speed"].to_numpy()
    axes.plot(_km(trips[0]), reference, color=ORANGE, linewidth=3.0, label="reference")
    slips, recorded = 0, True
    for number, trip in enumerate(trips):
        speed = KMH * trip["/train/state"]["speed"].to_numpy()
        axes.plot(
            _km(trip), speed, color=BLUE, linewidth=0.6, label="trains" if number == 0 else None
        )
        when = protection_onsets(trip)
        recorded &= when is not None
        rows = trip["/train/state"].index.searchsorted([] if when is None else when)
        slips += len(rows)
        if len(rows):
            axes.plot(_km(trip)[rows], speed[rows], color=RED, linestyle="", marker=".")
    for station in line.stations:
        axes.axvline(station.position / 1e3, color=PALE, linewidth=0.8, zorder=0)
    acted = f"slip protection acted {slips} times" if recorded else "slip protection not recorded"
    title = f"{len(trips)} trip{'s' * (len(trips) > 1)}; {acted}"
    dress(axes, x="", y="km/h", title=f"Speed, {title}{' (red)' * (slips > 0)}")
    axes.legend(fontsize=8, frameon=False, ncols=3, loc="lower center")


def _draw_efforts(axes: Axes, trips: Sequence[Trip]) -> None:
    chosen = {0: BLUE, len(trips) - 1: GREY}
    for number, colour in sorted(chosen.items(), reverse=True):
        controls = trips[number]["/train/controls"]
        wanted = controls["tractive_effort_demand"] - controls["braking_effort_demand"]
        net = _under_way(trips[number], wanted) / 1e3
        name = trips[number].metadata.get("configuration", trips[number].name)
        axes.plot(_km(trips[number]), net, color=colour, linewidth=0.8, label=name)
    axes.axhline(0.0, color=INK, linewidth=0.6)
    axes.legend(fontsize=8, frameon=False, ncols=2)
    dress(axes, x="", y="kN", title="Tractive effort asked for, braking effort below")

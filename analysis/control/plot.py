"""Pictures over km: trips that followed a trajectory, and a trip of a traction control."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba

from analysis.adhesion.events import protection_onsets
from analysis.adhesion.slip import slip
from analysis.charts import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    PALE,
    RED,
    dress,
    km_axis,
    new_figure,
    write_figure,
)
from trainlog.arrays import FloatArray
from trainlog.errors import LogError
from trainlog.formats.attached import line_of
from trainlog.railway import Line, TrackConditionMap
from trainlog.trip import LINE_ATTACHMENT, Trip
from trainlog.units import KMH

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
                remedy="give the trips of 'trainlog simulate follow'",
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
    km_axis(places[-1], line)
    places[-1].set_xlim(0.0, line.length / 1e3)
    figure.align_ylabels(places)
    write_figure(figure, path)


def draw_traction(
    trip: Trip,
    path: str | Path,
    condition: TrackConditionMap | None = None,
    layer: str | None = None,
) -> None:
    """Draw what a traction control made of the rail.

    Speed; slip speeds of the powered axles, by the true speed; their efforts; the adhesion that
    each used, by an observer, with the rail's true maximum and the map's
    estimate where it was observed.

    Parameters
    ----------
    trip : Trip
        Simulated.
    path : path
        PNG file.
    condition : TrackConditionMap, optional
        That the control knew.
    layer : str, optional
        Of the map; default: the trip's weather.

    Raises
    ------
    LogError
        If the trip has no ``/truth`` or not each axle's speed and effort.
    """
    for topic in ("/truth", "/train/axles"):
        if topic not in trip:
            raise LogError(
                f"trip '{trip.name}' has no {topic}",
                remedy="give a trip of 'trainlog simulate drive --traction'",
            )
    truth = trip["/truth"]
    found = slip(trip)
    clock = found.time.as_unit("ns").asi8
    own = pd.DatetimeIndex(truth.index).as_unit("ns").asi8
    km = np.interp(clock, own, truth["position"]) / 1e3
    speed = np.interp(clock, own, truth["speed"])
    axles = trip["/train/axles"]
    n = found.slip_speed.shape[1]
    wheels = axles[[f"wheel_speed_{i + 1}" for i in range(n)]].to_numpy()
    efforts = axles[[f"wheel_effort_{i + 1}" for i in range(n)]].to_numpy()
    moving = (speed > 0.1)[:, None]
    figure = new_figure(11.0, 9.5)
    places = figure.subplots(4, 1, sharex=True, height_ratios=[1.0, 1.4, 1.2, 2.2])
    places[0].plot(km, KMH * speed, color=INK, linewidth=0.8)
    slips = np.where(moving, wheels / found.wheel_factor - speed[:, None], np.nan)
    colours = axle_colours(n)
    for i in range(n):
        style = {"color": colours[i], "linewidth": 0.5}
        places[1].plot(km, slips[:, i], **style)
        places[2].plot(km, efforts[:, i] / 1e3, **style)
        used = np.where(moving[:, 0], np.abs(found.adhesion[:, i]), np.nan)
        places[3].plot(km, used, **style, label=f"in use, axle {i + 1}")
    rail, adhesion = places[3], "Adhesion"
    if condition is not None:
        adhesion += _draw_known(rail, condition, layer or trip.metadata.get("weather", "dry"))
    rail.plot(
        truth["position"] / 1e3, truth["maximum_adhesion"], color=RED, linewidth=1.0,
        label="maximum, true",
    )  # fmt: skip
    known_as = trip.metadata.get("traction_control", "the plant's own slip protection")
    dress(places[0], x="", y="km/h", title=f"Speed; traction control: {known_as}")
    dress(places[1], x="", y="m/s", title="Slip speed of each powered axle")
    dress(places[2], x="", y="kN", title="Effort of each powered axle")
    dress(rail, x="", y="", title=adhesion)
    km_axis(rail, line_of(trip) if LINE_ATTACHMENT in trip.attachments else None)
    rail.set_ylim(0.0, None)
    rail.legend(fontsize=8, frameon=False, ncols=7, loc="upper center", bbox_to_anchor=(0.5, -0.2))
    rail.set_xlim(float(km.min()), float(km.max()))
    figure.align_ylabels(places)
    write_figure(figure, path)


def _draw_known(axes: Axes, condition: TrackConditionMap, layer: str) -> str:
    """The map's estimate with one deviation where it was observed; what it is, in words."""
    km = condition.centres / 1e3
    bands = np.array([condition.likely(layer, condition.centres, k) for k in (0.0, 1.0, -1.0)])
    observed = condition.layers[layer].observed
    likely, low, high = np.where(observed, bands, np.nan)
    axes.fill_between(km, low, high, color=PALE, zorder=0, step="mid", label="map, one deviation")
    axes.plot(km, likely, color=GREY, linewidth=1.2, marker=".", markersize=3.0, label="map")
    return (
        f"; map: layer {layer}, lasting condition, where observed"
        f" ({100.0 * np.mean(observed):.0f} % of the line)"
    )


def axle_colours(n: int) -> list[tuple[float, float, float, float]]:
    """A colour for each axle, from dark to light blue."""
    dark, light = np.array(to_rgba(INK)), np.array(to_rgba(BLUE))
    shares = np.linspace(0.0, 1.0, n)[:, None] if n > 1 else np.ones((1, 1))
    return [tuple(map(float, each)) for each in dark + shares * (light - dark)]  # type: ignore[misc]


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

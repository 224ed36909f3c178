"""Charts over km: trips that followed a trajectory, and a trip of a traction control."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from analysis.adhesion.axles import protection_onsets
from analysis.adhesion.slip import slip
from analysis.charts import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    PALE,
    RED,
    Chart,
    Curve,
    Panel,
    Rule,
    limit_curve,
    shades,
)
from analysis.comparison.groups import lateness_of
from trainlog.arrays import FloatArray
from trainlog.display import counted
from trainlog.errors import LogError
from trainlog.formats.railway import line_of
from trainlog.railway import Line, TrackConditionMap
from trainlog.trip import LINE_ATTACHMENT, Trip
from trainlog.units import KMH

ZERO = [Rule(0.0, width=0.6)]


def following_charts(trips: Sequence[Trip]) -> list[Chart]:
    """Trips that followed one trajectory.

    Speed of all of them over the reference and the limits, with the places where wheels slipped;
    efforts of the first and of the last; how far behind the reference they were; their speed less
    the reference's.

    Parameters
    ----------
    trips : sequence of Trip
        With ``/train/state``, ``/train/controls``, ``/reference`` and ``/events``, on one line and
        in one direction.

    Raises
    ------
    LogError
        If there is no trip, or one has no reference.
    """
    if not trips:
        raise LogError("no trip to draw", remedy="give one that followed a trajectory")
    for trip in trips:
        lateness_of(trip)  # refuses a trip that followed none
    line = line_of(trips[0])
    late, error = list[Curve](), list[Curve]()
    for trip in trips:
        off = KMH * (trip["/train/state"]["speed"] - trip["/reference"]["speed"])
        behind = trip["/reference"]["lateness"]
        late.append(Curve("", _km(trip), _under_way(trip, behind), width=0.6))
        error.append(Curve("", _km(trip), _under_way(trip, off), width=0.4, opacity=0.5))
    panels = [
        _speeds(trips, line),
        _efforts(trips),
        Panel("s", late, 0.7, "Behind the reference", rules=ZERO),
        Panel("km/h", error, 0.7, "Speed, as measured, less the reference's", rules=ZERO),
    ]
    return [Chart("km", panels, span=(0.0, line.length / 1e3), line=line)]


def _km(trip: Trip) -> FloatArray:
    return trip["/train/state"]["position"].to_numpy() / 1e3


def _under_way(trip: Trip, values: object) -> FloatArray:
    """Values while the train moves, NaN while it stands."""
    moving = trip["/train/state"]["speed"].to_numpy() > 0.0
    return np.where(moving, np.asarray(values, dtype=np.float64), np.nan)


def _speeds(trips: Sequence[Trip], line: Line) -> Panel:
    reference = KMH * trips[0]["/reference"]["speed"]
    curves = [
        limit_curve(line, 0.0, line.length),
        Curve("reference", _km(trips[0]), reference, ORANGE, width=3.0),
    ]
    slips, recorded = list[Curve](), True
    for trip in trips:
        speed = KMH * trip["/train/state"]["speed"].to_numpy()
        curves.append(Curve("trains", _km(trip), speed, width=0.6))
        when = protection_onsets(trip)
        recorded &= when is not None
        rows = trip["/train/state"].index.searchsorted([] if when is None else when)
        slips.append(Curve("", _km(trip)[rows], speed[rows], RED, "points", width=2.0))
    count = sum(np.size(each.x) for each in slips)
    acted = (
        f"slip protection acted {counted(count, 'time')}"
        if recorded
        else "slip protection not recorded"
    )
    title = f"Speed, {counted(len(trips), 'trip')}; {acted}{' (red)' * (count > 0)}"
    return Panel("km/h", [*curves, *slips], 1.5, title, from_zero=True)


def _efforts(trips: Sequence[Trip]) -> Panel:
    chosen = {len(trips) - 1: GREY, 0: BLUE}
    curves = list[Curve]()
    for number, colour in chosen.items():
        trip = trips[number]
        controls = trip["/train/controls"]
        wanted = controls["tractive_effort_demand"] - controls["braking_effort_demand"]
        name = trip.metadata.get("configuration", trip.name)
        curves.append(Curve(name, _km(trip), _under_way(trip, wanted) / 1e3, colour, width=0.8))
    return Panel("kN", curves, 0.9, "Tractive effort asked for, braking effort below", rules=ZERO)


def traction_charts(trip: Trip, condition: TrackConditionMap | None = None) -> list[Chart]:
    """The rail as a traction control used it.

    Speed; slip speeds of the powered axles, by the true speed; their efforts; the adhesion that
    each used, by an observer, with the rail's true maximum and the map's
    estimate where it was observed.

    Parameters
    ----------
    trip : Trip
        Simulated.
    condition : TrackConditionMap, optional
        That the control knew; its layer of the trip's weather is drawn.

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
    truth, axles, found = trip["/truth"], trip["/train/axles"], slip(trip)
    clock = found.time.as_unit("ns").asi8
    own = pd.DatetimeIndex(truth.index).as_unit("ns").asi8
    km, speed = (
        np.interp(clock, own, truth["position"]) / 1e3,
        np.interp(clock, own, truth["speed"]),
    )
    used, title = list[Curve](), "Adhesion"
    if condition is not None:
        layer = trip.metadata.get("weather", "dry")
        observed = condition.layers[layer].observed
        likely, low, high = (
            np.where(
                observed, condition.lower_bound(layer, condition.centres, each, likely=True), np.nan
            )
            for each in (0.0, 1.0, -1.0)
        )
        at = condition.centres / 1e3
        used = [
            Curve("map, one deviation", at, high, PALE, "area", low),
            Curve("map", at, likely, GREY, width=1.2),
        ]
        title += f"; map, {layer}: where observed ({np.mean(observed):.0%} of the line)"
    slips, efforts = list[Curve](), list[Curve]()
    count = found.slip_speed.shape[1]
    # From dark to light blue.
    colours = shades(np.linspace(1.0, 0.4, count), "Blues", (0.0, 1.0))
    for i, colour in enumerate(colours.tolist()):
        wheel, effort = (axles[f"wheel_{name}_{i + 1}"].to_numpy() for name in ("speed", "effort"))
        relative = np.where(speed > 0.1, wheel / found.wheel_factor[i] - speed, np.nan)
        in_use = np.where(speed > 0.1, np.abs(found.adhesion[:, i]), np.nan)
        slips.append(Curve(f"axle {i + 1}", km, relative, colour, width=0.5))
        efforts.append(Curve("", km, effort / 1e3, colour, width=0.5))
        used.append(Curve("in use", km, in_use, colour, width=0.5))
    used.append(
        Curve("maximum, true", truth["position"] / 1e3, truth["maximum_adhesion"], RED, width=1.0)
    )
    known_as = trip.metadata.get("traction_control", "the plant's own slip protection")
    panels = [
        Panel("km/h", [Curve("", km, KMH * speed, INK, width=0.8)], 0.7,
              f"Speed; traction control: {known_as}", from_zero=True),
        Panel("m/s", slips, 1.0, "Slip speed of each powered axle"),
        Panel("kN", efforts, 0.8, "Effort of each powered axle"),
        Panel("", used, 1.5, title, from_zero=True),
    ]  # fmt: skip
    line = line_of(trip) if LINE_ATTACHMENT in trip.attachments else None
    return [Chart("km", panels, span=(float(km.min()), float(km.max())), line=line)]

"""The line beside the trips: track, stations, track condition, and the planned trajectory."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr
from matplotlib import colormaps
from numpy.typing import NDArray

from trainlog.errors import InputError
from trainlog.railway import Geometry, Line, TrackConditionMap, Trajectory
from trainlog.replay.clock import Clock, FloatArray, Instants, Nanoseconds
from trainlog.replay.curves import PLANNED, TRUE, Colour
from trainlog.replay.samples import Samples
from trainlog.replay.stream import path_of, send_curve, send_dots, send_static
from trainlog.units import KMH

TRACK: Colour = (95, 100, 115)
STATION: Colour = (235, 235, 235)
LAYERS: dict[str, Colour] = {"dry": (245, 205, 70), "wet": (90, 180, 240)}
"""Colours of the layers of a track-condition map; others are white."""

SECOND, OUTAGE = 1_000_000_000, 15_000_000_000
"""A second, and how long fixes are missing until their way is interrupted [ns]."""

LOWEST, HIGHEST = 0.05, 0.40
"""Maximum adhesion at the ends of the map's colour scale."""

TRACK_WIDTH, STATION_SIZE, BIN_SIZE = 2.5, 6.0, 4.0
"""Half width of the track, radius of a station and of a bin on the map, in points."""


def draw_line(recording: Any, line: Line, condition: TrackConditionMap | None) -> None:
    """Draw a line in its own direction on the map; nothing without coordinates.

    With a track-condition map each layer is one more entity: a dot for each observed bin, its
    colour the maximum adhesion.
    """
    geometry = line.geometry
    if geometry is None:
        return
    send_static(
        recording,
        path_of("lines", line.name, "track"),
        rr.GeoLineStrings(
            lat_lon=[np.column_stack((geometry.latitudes, geometry.longitudes))],
            radii=rr.Radius.ui_points(TRACK_WIDTH),
            colors=np.array([TRACK], dtype=np.uint8),
        ),
    )
    if condition is not None:
        for name in condition.layers:
            _draw_layer(recording, line.name, geometry, condition, name)
    for station in line.stations:
        latitude, longitude = geometry.at(station.position)
        send_static(
            recording,
            path_of("lines", line.name, "stations", station.name),
            rr.GeoPoints(
                lat_lon=[(float(latitude), float(longitude))],
                radii=rr.Radius.ui_points(STATION_SIZE),
                colors=np.array([STATION]),
            ),
        )


def draw_way(recording: Any, entity: str, time: Nanoseconds, fixes: FloatArray) -> None:
    """Draw the way along fixes [deg], (n, 2), taken at `time` [ns], interrupted at outages."""
    chosen = each_second(time)
    outages = np.flatnonzero(np.diff(time[chosen]) > OUTAGE) + 1
    parts = [part for part in np.split(fixes[chosen], outages) if len(part) > 1]
    if not parts:
        return
    send_static(
        recording,
        entity,
        rr.GeoLineStrings(
            lat_lon=parts,
            radii=rr.Radius.ui_points(TRACK_WIDTH),
            colors=np.array([TRACK], dtype=np.uint8),
        ),
    )


def each_second(time: Nanoseconds) -> NDArray[np.int64]:
    """Index of the first instant [ns] of each second: often enough to see a train move."""
    return np.asarray(np.unique(time // SECOND, return_index=True)[1])


def draw_condition(
    recording: Any,
    entity: str,
    clock: Clock,
    condition: TrackConditionMap,
    layer: str,
    *,
    backwards: bool,
    whole: bool,
) -> bool:
    """Draw the maximum adhesion under a trip: each bin when the train was there.

    Parameters
    ----------
    backwards : bool
        The trip runs against the line's own direction, in which the map is counted.
    whole : bool
        Bins that the trip did not reach too; they stand at the trip's ends in time.

    Returns
    -------
    bool
        Whether there was anything to draw.
    """
    chosen = condition.layer(layer)
    edges = np.arange(condition.bins + 1) * condition.bin_length
    value, deviation = chosen.maximum_adhesion, chosen.maximum_adhesion * chosen.log_std
    if backwards:
        edges, value, deviation = condition.length - edges[::-1], value[::-1], deviation[::-1]
    reached = clock.position
    shown = np.isfinite(value)
    if not whole and reached.size:
        shown &= (edges[1:] > reached[0]) & (edges[:-1] < reached[-1])
    if reached.size == 0 or not shown.any():
        return False
    name, colour = f"map, {layer}", LAYERS.get(layer, TRUE)
    # A bin is a stretch of the line: a level line from its start to its end, then a break. A dot
    # in its middle is what can be seen of it when the whole line is shown.
    start, end, value, deviation = (
        edges[:-1][shown],
        edges[1:][shown],
        value[shown],
        deviation[shown],
    )
    ends = np.column_stack((start, end, end)).ravel()
    blank = np.full(value.size, np.nan)
    time = _passing(clock, ends)
    send_curve(
        recording,
        f"{entity}/bins",
        Instants(clock.start, time, ends),
        Samples(
            time,
            np.column_stack((value, value, blank)).reshape(-1, 1),
            np.column_stack((deviation, deviation, blank)).reshape(-1, 1) ** 2,
        ),
        names=[name],
        colours=[colour],
    )
    middle = 0.5 * (start + end)
    send_dots(
        recording,
        f"{entity}/dots",
        Instants(clock.start, _passing(clock, middle), middle),
        value,
        name=name,
        colour=colour,
    )
    return True


def draw_trajectory(recording: Any, trajectory: Trajectory, start: int) -> None:
    """Draw a trajectory as if it departed at `start` [ns since 1970 UTC]."""
    seconds = trajectory.times.mean(axis=0)
    time = start + np.round(seconds * 1e9).astype(np.int64)
    slowest, fastest = trajectory.speeds.min(axis=0), trajectory.speeds.max(axis=0)
    instants = Instants(start, time, trajectory.positions)
    _send_span(recording, path_of("trajectory", "speed"), instants, slowest, fastest)


def draw_plan(recording: Any, entity: str, clock: Clock, trajectory: Trajectory) -> bool:
    """Draw what a trajectory plans where a trip is at each instant, whenever that is.

    Returns
    -------
    bool
        Whether the trip was where the trajectory is.
    """
    first, last = trajectory.positions[[0, -1]]
    inside = (clock.position >= first) & (clock.position <= last)
    if not inside.any():
        return False
    instants = clock.instants(clock.time[inside])
    rows = range(len(trajectory.configurations))
    speeds = np.stack([trajectory.speed_at(row, instants.position) for row in rows])
    _send_span(recording, entity, instants, speeds.min(axis=0), speeds.max(axis=0))
    return True


def _send_span(
    recording: Any, entity: str, instants: Instants, slowest: FloatArray, fastest: FloatArray
) -> None:
    """Send the middle between two speeds [m/s] as a line, with a band that reaches to both."""
    middle, half = 0.5 * KMH * (slowest + fastest), 0.5 * KMH * (fastest - slowest)
    send_curve(
        recording,
        entity,
        instants,
        Samples(instants.time, middle[:, None], half[:, None] ** 2),
        names=["trajectory"],
        colours=[PLANNED],
    )


def check_line(condition: TrackConditionMap, line: Line, trip: str) -> None:
    """Refuse a track-condition map of another line.

    Raises
    ------
    InputError
    """
    if condition.line != line.name or abs(condition.length - line.length) > condition.bin_length:
        raise InputError(
            f"the track-condition map is of line '{condition.line}', {condition.length:.0f} m;"
            f" trip '{trip}' ran on '{line.name}', {line.length:.0f} m",
            remedy="give the map of that line, or none",
        )


def _passing(clock: Clock, position: FloatArray) -> Nanoseconds:
    """When the train was at each position [ns]."""
    seconds = np.interp(position, clock.position, (clock.time - clock.start) / 1e9)
    return clock.start + np.round(seconds * 1e9).astype(np.int64)


def _draw_layer(
    recording: Any, line: str, geometry: Geometry, condition: TrackConditionMap, layer: str
) -> None:
    """The observed bins of a layer as dots, dark to light from low to high maximum adhesion."""
    adhesion = condition.layer(layer).maximum_adhesion
    seen = np.isfinite(adhesion)
    if not seen.any():
        return
    share = np.clip((adhesion[seen] - LOWEST) / (HIGHEST - LOWEST), 0.0, 1.0)
    send_static(
        recording,
        path_of("lines", line, "condition", layer),
        rr.GeoPoints(
            lat_lon=np.column_stack(geometry.at(condition.centres[seen])),
            radii=rr.Radius.ui_points(BIN_SIZE),
            colors=np.rint(255 * colormaps["plasma"](share)[:, :3]).astype(np.uint8),
        ),
    )

"""Trips as one Rerun recording, with the layout that shows them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from trainlog.errors import InputError
from trainlog.formats.attached import line_of
from trainlog.formats.files import write_bytes
from trainlog.railway import Line, TrackConditionMap, Trajectory
from trainlog.replay.clock import Clock, FloatArray, clock_of, nanoseconds
from trainlog.replay.curves import CURVES, SATELLITES, TRIPS, Colour, legend
from trainlog.replay.layout import Shown, blueprint
from trainlog.replay.lineside import (
    check_line,
    draw_condition,
    draw_line,
    draw_plan,
    draw_trajectory,
    draw_way,
    each_second,
)
from trainlog.replay.samples import phases, samples_of, with_slip
from trainlog.replay.stream import (
    path_of,
    send_curve,
    send_points,
    send_rows,
    send_static,
)
from trainlog.topics import EVENTS, GNSS_FIX, REFERENCE
from trainlog.trip import LINE_ATTACHMENT, Trip

APPLICATION = "trainlog"
"""Rerun's application id: a layout made for it fits every replay."""

LEVELS = {1: "DEBUG", 2: "INFO", 3: "WARN", 4: "ERROR", 5: "CRITICAL"}
"""Levels of foxglove.Log in Rerun's words."""

PHASES: dict[str, Colour] = {
    "traction": (45, 140, 75),
    "coasting": (95, 100, 120),
    "braking": (185, 85, 45),
    "standstill": (45, 45, 50),
}
"""Driving phases and their colours."""

KEYS = ("train", "line", "direction", "load", "weather", "start")
"""What of a trip's metadata is told first."""

SMALL, LARGE = 5.0, 9.0
"""Radius of a satellite fix and of a train on the map, in points."""

USUAL, HEADROOM = 0.999, 1.1
"""Share of the values that a plot shows, and its top over the highest of them: outliers do not
flatten the rest."""


def record_replay(
    trips: Sequence[Trip],
    path: str | Path,
    *,
    trajectory: Trajectory | None = None,
    condition_map: TrackConditionMap | None = None,
) -> None:
    """Write trips, and what is known of their line, as one Rerun recording with its layout.

    The same trips give the same content; Rerun's own row numbers differ from file to file.

    Parameters
    ----------
    trips : sequence of Trip
        At least one. Topics that are missing or empty are left out.
    path : path
        Ends in ``.rrd``; written whole or not at all.
    trajectory : Trajectory, optional
        What it plans is drawn where each trip is.
    condition_map : TrackConditionMap, optional
        Drawn along the line, and under each trip.

    Raises
    ------
    InputError
        If there is no trip, the path ends otherwise or cannot be written, or the map is of
        another line.
    LogError
        If a trip holds no samples.
    """
    if Path(path).suffix != ".rrd":
        raise InputError("is not the name of a Rerun recording", file=path, remedy="end it in .rrd")
    if not trips:
        raise InputError("there is no trip to replay", file=path, remedy="name at least one log")
    # Whatever can be refused is refused before anything is drawn.
    clocks = [clock_of(trip) for trip in trips]
    lines = _lines(trips, condition_map)
    recording = rr.RecordingStream(
        APPLICATION,
        recording_id=content_id(trips, trajectory, condition_map),
        send_properties=False,
    )
    stream = recording.binary_stream()
    names = _distinct([trip.name for trip in trips])
    others = f" and {len(names) - 1} more" if len(names) > 1 else ""
    recording.send_recording_name(names[0] + others)
    recording.send_recording_start_time_nanos(clocks[0].start)
    for first in lines:
        _draw_line(recording, trips[first], clocks[first], condition_map)
    shown = [
        _draw_trip(
            *(recording, with_slip(trip), clock, name, TRIPS[i % len(TRIPS)]),
            trajectory,
            condition_map,
        )
        for i, (trip, clock, name) in enumerate(zip(trips, clocks, names, strict=True))
    ]
    if trajectory is not None and len(trips) > 1:
        draw_trajectory(recording, trajectory, clocks[0].start)
    layout = blueprint(shown, trajectory is not None, _observed(condition_map))
    recording.send_blueprint(layout)
    write_bytes(path, stream.read())


def content_id(
    trips: Iterable[Trip], trajectory: Trajectory | None, condition: TrackConditionMap | None
) -> str:
    """The recording's id: a digest of all that is drawn, so that the viewer mixes no two."""
    digest = hashlib.sha256()
    for trip in trips:
        digest.update(json.dumps(trip.metadata, sort_keys=True).encode())
        for topic, frame in sorted(trip.topics.items()):
            digest.update(topic.encode() + nanoseconds(frame).tobytes())
            for column in frame.columns:
                values = frame[column]
                numbers = values.dtype.kind in "fiub"
                text = (
                    values.to_numpy().tobytes()
                    if numbers
                    else "\n".join(values.astype(str)).encode()
                )
                digest.update(column.encode() + text)
    if trajectory is not None:
        digest.update(trajectory.speeds.tobytes() + trajectory.positions.tobytes())
    for name, layer in sorted(condition.layers.items()) if condition is not None else ():
        digest.update(name.encode() + layer.log_mean.tobytes() + layer.observed.tobytes())
    return digest.hexdigest()[:32]


def _distinct(names: Sequence[str]) -> list[str]:
    """Names with a number behind each that came before."""
    seen: dict[str, int] = {}
    distinct = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        distinct.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return distinct


def _lines(trips: Sequence[Trip], condition: TrackConditionMap | None) -> list[int]:
    """Which is the first trip on each line; refuses a map of another line."""
    found: dict[str, int] = {}
    for number, trip in enumerate(trips):
        line = _line(trip)
        if line is None:
            continue
        if condition is not None:
            check_line(condition, line, trip.name)
        found.setdefault(line.name, number)
    return list(found.values())


def _draw_line(
    recording: Any, trip: Trip, clock: Clock, condition: TrackConditionMap | None
) -> None:
    """The line of a trip, and its condition when that trip was there."""
    line, backwards = line_of(trip), _backwards(trip)
    draw_line(recording, line.reversed() if backwards else line, condition)
    if condition is None:
        return
    for layer in _observed(condition):
        draw_condition(
            recording,
            path_of("lines", line.name, "maximum_adhesion", layer),
            clock,
            condition,
            layer,
            backwards=backwards,
            whole=True,
        )


def _draw_trip(
    recording: Any,
    trip: Trip,
    clock: Clock,
    name: str,
    colour: Colour,
    trajectory: Trajectory | None,
    condition: TrackConditionMap | None,
) -> Shown:
    """Everything of one trip, below its own path."""
    root, line = path_of("trips", name), _line(trip)
    entities: set[str] = set()
    tops: dict[str, float] = {}
    for curve in CURVES:
        points = samples_of(curve, trip)
        if points is None:
            continue
        names, colours = legend(curve, points.ordinates.shape[1])
        send_curve(
            recording,
            f"{root}/{curve.entity}",
            clock.instants(points.time),
            points,
            names=names,
            colours=colours,
            width=curve.width,
            held=curve.held,
        )
        entities.add(curve.entity)
        highest = HEADROOM * float(np.nanquantile(points.ordinates, USUAL))
        tops[curve.panel] = max(tops.get(curve.panel, 0.0), highest)
    # A trip that followed a trajectory carries it as its reference, in its own configuration.
    planned = None if REFERENCE.name in trip or _backwards(trip) else trajectory
    if planned is not None and draw_plan(recording, f"{root}/speed/trajectory", clock, planned):
        entities.add("speed/trajectory")
    layer = "" if line is None else _layer(trip, condition)
    if layer and condition is not None:
        backwards = _backwards(trip)
        entity = f"{root}/adhesion/map"
        if draw_condition(
            recording, entity, clock, condition, layer, backwards=backwards, whole=False
        ):
            entities.add("adhesion/map")
    entities |= _draw_phases(recording, trip, root, clock)
    entities |= _draw_events(recording, trip, root, clock)
    places, extent = _draw_places(recording, trip, root, clock, line, colour)
    entities |= places
    send_static(
        recording, f"{root}/about", rr.TextDocument(_about(trip, name), media_type="text/markdown")
    )
    return Shown(
        name=name,
        root=root,
        direction=trip.metadata.get("direction", "forward"),
        line="" if line is None else path_of("lines", line.name),
        colour=colour,
        entities=frozenset(entities),
        layer=layer,
        tops=tops,
        extent=extent,
    )


def _draw_phases(recording: Any, trip: Trip, root: str, clock: Clock) -> set[str]:
    found = phases(trip)
    if found is None:
        return set()
    time, phase = found
    colours = np.array(list(PHASES.values()), dtype=np.uint8)
    send_static(
        recording, f"{root}/phase", rr.StateConfiguration(values=list(PHASES), colors=colours)
    )
    send_rows(
        recording,
        f"{root}/phase",
        clock.instants(time),
        lambda rows: rr.StateChange.columns(state=phase[rows].tolist()),
    )
    return {"phase"}


def _draw_events(recording: Any, trip: Trip, root: str, clock: Clock) -> set[str]:
    if EVENTS.name not in trip or trip[EVENTS.name].empty:
        return set()
    frame = trip[EVENTS.name]
    texts = [
        f"{name}: {message}" if name else message
        for name, message in zip(frame["name"], frame["message"], strict=True)
    ]
    levels = [LEVELS.get(level, "INFO") for level in frame["level"]]
    send_rows(
        recording,
        f"{root}/events",
        clock.instants(nanoseconds(frame)),
        lambda rows: rr.TextLog.columns(text=texts[rows], level=levels[rows]),
    )
    return {"events"}


def _draw_places(
    recording: Any, trip: Trip, root: str, clock: Clock, line: Line | None, colour: Colour
) -> tuple[set[str], FloatArray | None]:
    """The satellite fixes, and the train on its line, as points on the map; and its extent.

    Where the line has no coordinates, the way along the fixes stands for it.
    """
    drawn: set[str] = set()
    extent = None
    geometry = None if line is None else line.geometry
    if GNSS_FIX.name in trip:
        frame = trip[GNSS_FIX.name]
        fixes = frame[["latitude", "longitude"]].to_numpy(dtype=np.float64)
        known = np.all(np.isfinite(fixes), axis=1)
        fixes, time = fixes[known], nanoseconds(frame)[known]
        if time.size:
            entity = f"{root}/place/satellites"
            instants = clock.instants(time)
            send_points(recording, entity, instants, fixes, colour=SATELLITES, radius=SMALL)
            drawn.add("place/satellites")
            extent = np.quantile(fixes, (0.01, 0.99), axis=0).T
        if time.size and geometry is None:
            draw_way(recording, f"{root}/place/way", time, fixes)
            drawn.add("place/way")
    if geometry is not None:
        track = np.column_stack((geometry.latitudes, geometry.longitudes))
        extent = np.column_stack((track.min(axis=0), track.max(axis=0)))
    if geometry is not None and clock.time.size:
        instants = clock.instants(clock.time[each_second(clock.time)])
        places = np.column_stack(geometry.at(instants.position))
        entity = f"{root}/place/train"
        send_points(recording, entity, instants, places, colour=colour, radius=LARGE)
        drawn.add("place/train")
    return drawn, extent


def _line(trip: Trip) -> Line | None:
    """The trip's line as travelled; None if it carries none."""
    return line_of(trip) if LINE_ATTACHMENT in trip.attachments else None


def _backwards(trip: Trip) -> bool:
    return trip.metadata.get("direction") == "reverse"


def _observed(condition: TrackConditionMap | None) -> list[str]:
    """Layers that have something to show."""
    layers = {} if condition is None else condition.layers
    return [name for name, layer in layers.items() if layer.observed.any()]


def _layer(trip: Trip, condition: TrackConditionMap | None) -> str:
    """The layer of the map for the trip's weather, the first if that is not known; else empty."""
    observed = _observed(condition)
    if "weather" in trip.metadata:
        return trip.metadata["weather"] if trip.metadata["weather"] in observed else ""
    return observed[0] if observed else ""


def _about(trip: Trip, name: str) -> str:
    """What is known of the trip, as Markdown."""
    keys = sorted(
        trip.metadata, key=lambda key: (KEYS.index(key) if key in KEYS else len(KEYS), key)
    )
    rows = [f"| {key} | {trip.metadata[key]} |" for key in keys if key != "trip"]
    steps = [f"{i}. {step['step']}" for i, step in enumerate(trip.provenance, start=1)]
    table = "\n".join([f"# {name}", "", "| | |", "|---|---|", *rows])
    return table + ("\n\nMade by\n\n" + "\n".join(steps) if steps else "") + "\n"

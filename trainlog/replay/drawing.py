"""One trip of a replay, drawn piece by piece."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import rerun as rr

from trainlog.railway import TrackConditionMap, Trajectory
from trainlog.replay.clock import FloatArray, nanoseconds
from trainlog.replay.curves import CURVES, SATELLITES, Colour, Curve, legend
from trainlog.replay.layout import Shown
from trainlog.replay.lineside import (
    draw_condition,
    draw_line,
    draw_plan,
    draw_way,
    each_second,
)
from trainlog.replay.samples import Pen, phases, with_slip
from trainlog.replay.stream import (
    path_of,
    send_curve,
    send_places,
    send_points,
    send_rows,
    send_samples,
    send_static,
)
from trainlog.replay.survey import Survey
from trainlog.topics import EVENTS, GNSS_FIX, REFERENCE
from trainlog.trip import Trip

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

HEADROOM = 1.1
"""Top of a plot over nearly all of its values."""


class Drawing:
    """One trip below its own path, of which the pieces come in the order of time.

    Parameters
    ----------
    recording : rerun.RecordingStream
    known : Survey
    name : str
        Of the trip, among the others.
    colour : Colour
    """

    def __init__(self, recording: Any, known: Survey, name: str, colour: Colour) -> None:
        self._recording = recording
        self._known = known
        self._name = name
        self._colour = colour
        self._root = path_of("trips", name)
        self._pens = {curve.entity: Pen(curve) for curve in CURVES}
        self._entities: set[str] = set()
        self._phase = ""

    def add(self, piece: Trip, state: pd.DataFrame | None) -> None:
        """Draw the next piece; `state` as `neighboured` gives it."""
        drawn = with_slip(piece, state)
        for curve in CURVES:
            self._add_curve(curve, drawn)
        self._add_phases(piece, state)
        self._add_events(piece)
        self._add_fixes(piece)

    def finish(self, trajectory: Trajectory | None, condition: TrackConditionMap | None) -> Shown:
        """Draw what is known of the trip as a whole, and tell what there is to show."""
        known, root, bare = self._known, self._root, self._known.bare
        # A trip that followed a trajectory carries it as its reference, in its own configuration.
        planned = None if REFERENCE.name in bare else trajectory
        if planned is not None and _backwards(bare) != (planned.direction == "reverse"):
            planned = None
        if planned is not None and draw_plan(
            self._recording, f"{root}/speed/trajectory", known.clock, planned
        ):
            self._entities.add("speed/trajectory")
        layer = "" if known.line is None else _layer(bare, condition)
        if layer and condition is not None:
            entity, backwards = f"{root}/adhesion/map", _backwards(bare)
            if draw_condition(
                *(self._recording, entity, known.clock, condition, layer),
                backwards=backwards,
                whole=False,
            ):
                self._entities.add("adhesion/map")
        extent = self._draw_places()
        about = rr.TextDocument(_about(bare, self._name), media_type="text/markdown")
        send_static(self._recording, f"{root}/about", about)
        return Shown(
            name=self._name,
            root=root,
            direction=bare.metadata.get("direction", "forward"),
            line="" if known.line is None else path_of("lines", known.line.name),
            colour=self._colour,
            entities=frozenset(self._entities),
            layer=layer,
            tops=self._tops(),
            extent=extent,
        )

    def _tops(self) -> dict[str, float]:
        tops: dict[str, float] = {}
        for curve in CURVES:
            if curve.entity in self._known.tops:
                top = HEADROOM * self._known.tops[curve.entity]
                tops[curve.panel] = max(tops.get(curve.panel, 0.0), top)
        return tops

    def _add_curve(self, curve: Curve, piece: Trip) -> None:
        points = self._pens[curve.entity].samples(piece)
        if points is None:
            return
        entity = f"{self._root}/{curve.entity}"
        instants = self._known.clock.instants(points.time)
        if curve.entity in self._entities:
            send_samples(self._recording, entity, instants, points)
            return
        names, colours = legend(curve, points.ordinates.shape[1])
        send_curve(
            *(self._recording, entity, instants, points),
            names=names,
            colours=colours,
            width=curve.width,
            held=curve.held,
        )
        self._entities.add(curve.entity)

    def _add_phases(self, piece: Trip, state: pd.DataFrame | None) -> None:
        found = phases(piece, state, self._known.pulls)
        if found is None:
            return
        time, phase = found
        entity = f"{self._root}/phase"
        if "phase" not in self._entities:
            colours = np.array(list(PHASES.values()), dtype=np.uint8)
            style = rr.StateConfiguration(values=list(PHASES), colors=colours)
            send_static(self._recording, entity, style)
        elif phase[0] == self._phase:
            time, phase = time[1:], phase[1:]
        if time.size:
            self._phase = str(phase[-1])
        send_rows(
            self._recording,
            entity,
            self._known.clock.instants(time),
            lambda rows: rr.StateChange.columns(state=phase[rows].tolist()),
        )
        self._entities.add("phase")

    def _add_events(self, piece: Trip) -> None:
        if EVENTS.name not in piece or piece[EVENTS.name].empty:
            return
        frame = piece[EVENTS.name]
        texts = [
            f"{name}: {message}" if name else message
            for name, message in zip(frame["name"], frame["message"], strict=True)
        ]
        levels = [LEVELS.get(level, "INFO") for level in frame["level"]]
        send_rows(
            self._recording,
            f"{self._root}/events",
            self._known.clock.instants(nanoseconds(frame)),
            lambda rows: rr.TextLog.columns(text=texts[rows], level=levels[rows]),
        )
        self._entities.add("events")

    def _add_fixes(self, piece: Trip) -> None:
        if GNSS_FIX.name not in piece:
            return
        frame = piece[GNSS_FIX.name]
        fixes = frame[["latitude", "longitude"]].to_numpy(dtype=np.float64)
        known = np.all(np.isfinite(fixes), axis=1)
        if not known.any():
            return
        instants = self._known.clock.instants(nanoseconds(frame)[known])
        entity = f"{self._root}/place/satellites"
        drawn = (self._recording, entity, instants, fixes[known])
        if "place/satellites" in self._entities:
            send_places(*drawn)
            return
        send_points(*drawn, colour=SATELLITES, radius=SMALL)
        self._entities.add("place/satellites")

    def _draw_places(self) -> FloatArray | None:
        """The train on its line on the map; and the map's extent.

        Where the line has no coordinates, the way along the fixes stands for it.
        """
        known, extent = self._known, None
        geometry = None if known.line is None else known.line.geometry
        if known.fixes is not None:
            time, fixes = known.fixes
            extent = np.quantile(fixes, (0.01, 0.99), axis=0).T
            if geometry is None:
                draw_way(self._recording, f"{self._root}/place/way", time, fixes)
                self._entities.add("place/way")
        if geometry is None:
            return extent
        if known.clock.time.size:
            instants = known.clock.instants(known.clock.time[each_second(known.clock.time)])
            places = np.column_stack(geometry.at(instants.position))
            entity = f"{self._root}/place/train"
            send_points(
                *(self._recording, entity, instants, places), colour=self._colour, radius=LARGE
            )
            self._entities.add("place/train")
        track = np.column_stack((geometry.latitudes, geometry.longitudes))
        return np.column_stack((track.min(axis=0), track.max(axis=0)))


def draw_line_of(recording: Any, known: Survey, condition: TrackConditionMap | None) -> None:
    """Draw the line of a trip, if it has one, and its condition when that trip was there."""
    line, backwards = known.line, _backwards(known.bare)
    if line is None:
        return
    draw_line(recording, line.reversed() if backwards else line, condition)
    if condition is None:
        return
    for layer in observed(condition):
        draw_condition(
            recording,
            path_of("lines", line.name, "maximum_adhesion", layer),
            known.clock,
            condition,
            layer,
            backwards=backwards,
            whole=True,
        )


def _backwards(trip: Trip) -> bool:
    return trip.metadata.get("direction") == "reverse"


def observed(condition: TrackConditionMap | None) -> list[str]:
    """Layers that have something to show."""
    layers = {} if condition is None else condition.layers
    return [name for name, layer in layers.items() if layer.observed.any()]


def _layer(trip: Trip, condition: TrackConditionMap | None) -> str:
    """The layer of the map for the trip's weather, the first if that is not known; else empty."""
    layers = observed(condition)
    if "weather" in trip.metadata:
        return trip.metadata["weather"] if trip.metadata["weather"] in layers else ""
    return layers[0] if layers else ""


def _about(trip: Trip, name: str) -> str:
    """What is known of the trip, as Markdown."""
    keys = sorted(
        trip.metadata, key=lambda key: (KEYS.index(key) if key in KEYS else len(KEYS), key)
    )
    rows = [f"| {key} | {trip.metadata[key]} |" for key in keys if key != "trip"]
    steps = [f"{i}. {step['step']}" for i, step in enumerate(trip.provenance, start=1)]
    table = "\n".join([f"# {name}", "", "| | |", "|---|---|", *rows])
    return table + ("\n\nMade by\n\n" + "\n".join(steps) if steps else "") + "\n"

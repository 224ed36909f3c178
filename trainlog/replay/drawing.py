"""What a replay draws: a trip piece by piece, its line, the track condition, the trajectory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import rerun as rr

from trainlog.arrays import FloatArray, IntArray
from trainlog.railway import Line, TrackConditionMap, Trajectory
from trainlog.replay.chart import Chart, chart_of
from trainlog.replay.clock import Clock, Instants, Nanoseconds, nanoseconds
from trainlog.replay.condition import (
    Passage,
    draw_bins_on_map,
    draw_condition,
    draw_spots_on_map,
    observed,
)
from trainlog.replay.curves import (
    COLOURS,
    PHASES,
    SPEEDS_SHOWN,
    Colour,
    Curve,
    curves_of,
    legend,
    panels_of,
)
from trainlog.replay.layout import PHASE_LETTERS, Shown
from trainlog.replay.overlay import Reference, draw_difference
from trainlog.replay.samples import (
    Pen,
    Samples,
    path_of,
    phases,
    send_curve,
    send_rows,
    send_samples,
    send_static,
    with_slip,
)
from trainlog.replay.survey import Survey
from trainlog.replay.track import Whereabouts, draw_lanes, draw_profile
from trainlog.topics import EVENTS, GNSS_FIX, REFERENCE
from trainlog.trip import Trip
from trainlog.units import KMH, NANOSECONDS

TRACK: Colour = (95, 100, 115)
STATION: Colour = (160, 160, 160)
SECOND, OUTAGE = NANOSECONDS, 15_000_000_000
"""A second, and how long fixes are missing until the line along them is interrupted [ns]."""

TRACK_WIDTH, STATION_SIZE = 2.5, 6.0
"""Half width of the track and radius of a station on the map, in points."""


def draw_line(recording: Any, line: Line, chart: Chart) -> None:
    """Draw a line in its own direction on the chart; nothing without coordinates."""
    geometry = line.geometry
    if geometry is None:
        return
    track = np.column_stack((geometry.latitudes, geometry.longitudes))
    chart.strips(recording, path_of("lines", line.name, "track"), [track], TRACK, TRACK_WIDTH)
    for station in line.stations:
        place = np.column_stack(geometry.at(np.array([station.position])))
        entity = path_of("lines", line.name, "stations", station.name)
        chart.dots(recording, entity, place, np.array([STATION]), STATION_SIZE, station.name)


def fixed_path(time: Nanoseconds, fixes: FloatArray) -> list[FloatArray]:
    """The line along fixes [deg], (n, 2), taken at `time` [ns], in parts between outages."""
    chosen = each_second(time)
    outages = np.flatnonzero(np.diff(time[chosen]) > OUTAGE) + 1
    return [part for part in np.split(fixes[chosen], outages) if len(part) > 1]


def each_second(time: Nanoseconds) -> IntArray:
    """Index of the first instant [ns] of each second: often enough to see a train move."""
    return np.asarray(np.unique(time // SECOND, return_index=True)[1])


def draw_trajectory(recording: Any, trajectory: Trajectory, start: int) -> None:
    """Draw a trajectory as if it departed at `start` [ns since 1970 UTC]."""
    seconds = trajectory.times.mean(axis=0)
    time = start + np.round(seconds * NANOSECONDS).astype(np.int64)
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
        colours=[COLOURS["planned"]],
    )


LEVELS = {1: "DEBUG", 2: "INFO", 3: "WARN", 4: "ERROR", 5: "CRITICAL"}
"""Levels of foxglove.Log and their names in Rerun."""

KEYS = ("train", "line", "direction", "load", "weather", "start")
"""Keys of a trip's metadata that are listed first."""

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
    chart : Chart, optional
        The one of all trips. Default: one for this trip.
    brief : bool
        Without what is shown of a trip alone: particulars, lanes, where it was each second.
    """

    def __init__(
        self,
        recording: Any,
        known: Survey,
        name: str,
        colour: Colour,
        *,
        chart: Chart | None = None,
        brief: bool = False,
    ) -> None:
        self._recording = recording
        self._known = known
        self._name = name
        self._colour = colour
        self._chart = chart or chart_of([known.line], [known.fixes])
        self._brief = brief
        self._root = path_of("trips", name)
        self._curves = curves_of(known.bare)
        self._pens = {curve.entity: Pen(curve) for curve in self._curves}
        self._entities: set[str] = set()
        self._phase = self._reference = ""
        self._where = Whereabouts(recording, f"{self._root}/cursor", known.line, known.clock)

    def add(self, piece: Trip, state: pd.DataFrame | None) -> None:
        """Draw the next piece; `state` as `neighboured` gives it."""
        drawn = with_slip(piece, state)
        for curve in self._curves:
            if not self._brief or curve.entity in SPEEDS_SHOWN:
                self._add_curve(curve, drawn)
        self._add_phases(piece, state)
        self._add_events(piece)
        self._add_fixes(piece)
        if not self._brief and self._where.add(piece):
            self._entities.add("cursor")

    def compare(self, reference: Reference) -> None:
        """Draw how far the trip is behind a reference along the line, and how much faster."""
        drawn = draw_difference(
            self._recording, self._root, self._name, self._colour, self._known, reference
        )
        self._entities |= drawn
        self._reference = reference.name if drawn else ""

    def finish(self, trajectory: Trajectory | None, condition: TrackConditionMap | None) -> Shown:
        """Draw what is known of the trip as a whole; return what there is to show."""
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
            passage = Passage(known.clock, condition, layer, _backwards(bare), whole=False)
            paths = {name: f"{root}/adhesion/{name}" for name in ("map", "expected", "spots")}
            found = draw_condition(self._recording, passage, paths)
            self._entities |= {f"adhesion/{name}" for name in found}
            if known.line is not None:
                entity, line = f"{root}/place/spots", self._laid_out(known.line)
                draw_spots_on_map(self._recording, entity, line, passage, self._chart)
        extent = self._draw_places()
        if not self._brief:
            if known.line is not None:
                drawn = (self._recording, root, known.line, known.clock, self._entities)
                self._entities |= draw_profile(*drawn)
            self._entities |= draw_lanes(self._recording, root, known.line, known.clock)
            about = rr.TextDocument(_about(bare, self._name), media_type="text/markdown")
            send_static(self._recording, f"{root}/about", about)
            self._entities.add("about")
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
            panels=panels_of(bare),
            brief=self._brief,
            reference=self._reference,
        )

    def _laid_out(self, line: Line) -> Line:
        return self._chart.laid_out(line, _backwards(self._known.bare))

    def so_far(self, known: Survey) -> Shown:
        """What there is to show of a trip that is still recorded; draws `known`, its last part."""
        before, entities, self._known = self._known, set(self._entities), known
        try:
            return self.finish(None, None)
        finally:
            self._known, self._entities = before, entities

    def _tops(self) -> dict[str, float]:
        tops: dict[str, float] = {}
        for curve in self._curves:
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
            letters = [PHASE_LETTERS[phase] for phase in PHASES]
            style = rr.StateConfiguration(values=list(PHASES), labels=letters, colors=colours)
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
            self._chart.move(*drawn)
            return
        self._chart.moving(*drawn, colour=COLOURS["satellites"], radius=SMALL)
        self._entities.add("place/satellites")

    def _draw_places(self) -> FloatArray | None:
        """The train on its line on the map; and the map's extent.

        Where the line has no coordinates, the line along the fixes stands for it.
        """
        known, extent = self._known, None
        geometry = None if known.line is None else self._laid_out(known.line).geometry
        if known.fixes is not None:
            time, fixes = known.fixes
            extent = np.quantile(fixes, (0.01, 0.99), axis=0).T
            path = fixed_path(time, fixes) if geometry is None else []
            if path:
                entity = f"{self._root}/place/path"
                self._chart.strips(self._recording, entity, path, TRACK, TRACK_WIDTH)
                self._entities.add("place/path")
        if geometry is None:
            return extent
        if known.clock.time.size:
            instants = known.clock.instants(known.clock.time[each_second(known.clock.time)])
            places = np.column_stack(geometry.at(instants.position))
            entity = f"{self._root}/place/train"
            self._chart.moving(
                *(self._recording, entity, instants, places), colour=self._colour, radius=LARGE
            )
            self._entities.add("place/train")
        track = np.column_stack((geometry.latitudes, geometry.longitudes))
        return np.column_stack((track.min(axis=0), track.max(axis=0)))


def draw_line_of(
    recording: Any, known: Survey, condition: TrackConditionMap | None, chart: Chart
) -> None:
    """Draw the line of a trip, if it has one, and its condition when that trip was there."""
    line, backwards = known.line, _backwards(known.bare)
    if line is None:
        return
    own = chart.laid_out(line.reversed() if backwards else line, backwards=False)
    draw_line(recording, own, chart)
    if condition is None:
        return
    for layer in observed(condition):
        passage = Passage(known.clock, condition, layer, backwards, whole=True)
        if own.geometry is not None:
            draw_bins_on_map(recording, own.name, own.geometry, passage, chart)
        path = path_of("lines", line.name, "maximum_adhesion", layer)
        paths = {"map": path} | {name: f"{path}/{name}" for name in ("expected", "spots")}
        draw_condition(recording, passage, paths)


def _backwards(trip: Trip) -> bool:
    return trip.metadata.get("direction") == "reverse"


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
    # A list, not a table: next to one long value a table's columns leave the narrow panel.
    shown = trip.metadata | ({"load": _tonnes(trip.metadata["load"])} if "load" in keys else {})
    rows = [f"- **{key}**: {shown[key]}" for key in keys if key != "trip"]
    steps = [f"{i}. {step['step']}" for i, step in enumerate(trip.provenance, start=1)]
    parts = [f"### {name}", "\n".join(rows), *(["Made by", "\n".join(steps)] if steps else [])]
    return "\n\n".join(part for part in parts if part) + "\n"


def _tonnes(load: str) -> str:
    """A load [kg] as it is shown; as it stands if it is no number."""
    try:
        return f"{float(load) / 1e3:.1f} t"
    except ValueError:
        return load

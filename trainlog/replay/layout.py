"""Layouts for the viewer: of a replay, and of a log that Rerun opens as it is.

A replay has one tab a trip, and one that lays the trips over each other. Rerun also reads MCAP
itself: fixes and events show at once; a ``trainlog.*`` message arrives as one structure with all
its fields, which a plot takes apart only with a layout that names them. `write_layout` writes that
layout, one for all logs; `scalars` takes the fields out for further work in Python. Values stay in
SI units there, and there is no timeline over position: for that a recording has to be made, see
`trainlog.replay.write_replay`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping
from rerun.chunk import DeriveLens, McapReader

from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.replay.clock import ELAPSED, POSITION, TIME, FloatArray
from trainlog.replay.curves import PANELS, Colour, Panel
from trainlog.replay.samples import path_of
from trainlog.topics import EVENTS, GNSS_FIX, TOPICS, Field, Topic

SHARED_AXIS = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"
"""Where Rerun keeps the time axis that linked plots share (its GLOBAL_VIEW_ID)."""

PLAYBACK_SPEED = 20.0
"""Seconds of a trip shown in one second."""

PLAYBACK_POSITION = 400_000.0
"""Millimetres of a line shown in one second, when playing over position."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What of a trip there is to show.

    Attributes
    ----------
    name : str
    root : str
        Its entities lie below this path.
    direction : str
    line : str
        Path of its line's entities; empty without coordinates.
    colour : Colour
        On the map and where trips lie over each other.
    entities : frozenset of str
        Paths below `root` that hold data.
    layer : str
        Layer of the track-condition map under it; empty without one.
    tops : dict of str to float
        Upper end of each panel's axis, in its unit.
    extent : (2, 2) array [deg] or None
        Least and greatest latitude, least and greatest longitude; None without coordinates.
    panels : tuple of Panel
        The plots that it can have.
    """

    name: str
    root: str
    direction: str
    line: str
    colour: Colour
    entities: frozenset[str]
    layer: str
    tops: dict[str, float]
    extent: FloatArray | None
    panels: tuple[Panel, ...] = PANELS

    def shows(self, panel: str) -> bool:
        """Whether there is anything below the panel's entity."""
        return any(entity.partition("/")[0] == panel for entity in self.entities)


SIDE_MAP, LARGE_MAP = (350.0, 330.0), (800.0, 480.0)
"""Height and width that the map of one trip, and that of all, have on a common screen [points]."""


class SharedAxis:
    """The shared time axis, from end to end of whichever timeline is shown.

    Stands where a blueprint keeps a panel: Rerun has no part of its own for it.
    """

    def _log_to_stream(self, stream: Any) -> None:
        whole = rr.TimeRange(
            start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
        )
        stream.log(SHARED_AXIS, rrb.TimeAxis(view_range=whole))


def blueprint(trips: Sequence[Shown], planned: str | None, layers: Sequence[str]) -> Any:
    """The layout for these trips, as Rerun's blueprint.

    Parameters
    ----------
    trips : sequence of Shown
    planned : str or None
        Direction of the trajectory, if there is one.
    layers : sequence of str
        Of the track-condition map.
    """
    tabs = [_trip(trip) for trip in trips]
    if len(tabs) == 1:
        root = tabs[0]
    else:
        root = rrb.Tabs(_overview(trips, planned, layers), *tabs, active_tab=1)
    several = len(trips) > 1
    made = rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed",
            timeline=ELAPSED if several else TIME,
            playback_speed=PLAYBACK_SPEED,
            fps=PLAYBACK_POSITION,
            play_state="paused",
        ),
    )
    made.top_panel = SharedAxis()
    return made


def _trip(trip: Shown) -> Any:
    """Plots on the left, place, events and particulars on the right."""
    shown = [panel for panel in trip.panels if trip.shows(panel.entity)]
    rows = [_panel(trip, panel) for panel in shown if not panel.beside]
    shares = [panel.share for panel in shown if not panel.beside]
    others = [panel for panel in shown if panel.beside]
    if trip.shows("phase"):
        lane = rrb.StateTimelineView(
            origin=f"{trip.root}/phase", name="Driving phase", time_view=_axis()
        )
        rows.insert(1, lane)
        shares.insert(1, 1.1)
    side = [
        view for view in (_map([trip], trip.layer, SIDE_MAP), _events(trip), _about(trip)) if view
    ]
    beside = rrb.Vertical(*side, row_shares=[3.0, 2.0, 2.0][-len(side) :])
    plots = [rrb.Vertical(*rows, row_shares=shares, name="Driving")] if rows else []
    if others:
        drawn, heights = [_panel(trip, each) for each in others], [each.share for each in others]
        plots.append(rrb.Vertical(*drawn, row_shares=heights, name="Recorder"))
    if not plots:
        return rrb.Horizontal(beside, name=trip.name)
    both = plots[0] if len(plots) == 1 else rrb.Tabs(*plots, active_tab=0)
    return rrb.Horizontal(both, beside, column_shares=[3.0, 1.0], name=trip.name)


def _panel(trip: Shown, panel: Panel) -> Any:
    title = panel.title
    if panel.entity == "speed":
        title = f"{trip.name}: {title[0].lower()}{title[1:]}"
    top = trip.tops.get(panel.entity) if panel.from_zero else None
    return plot([f"{trip.root}/{panel.entity}/**"], title, top)


def _overview(trips: Sequence[Shown], planned: str | None, layers: Sequence[str]) -> Any:
    """Speeds of all trips over each other, one plot a direction; the line's condition; the map."""
    rows = []
    for direction in dict.fromkeys(trip.direction for trip in trips):
        group = {trip: _speed(trip) for trip in trips if trip.direction == direction}
        coloured = {
            entity: rr.SeriesLines(names=trip.name, colors=[trip.colour]).visualizer()
            for trip, entity in group.items()
            if entity
        }
        limits = [f"{trip.root}/speed/limit" for trip in group if "speed/limit" in trip.entities]
        plan = ["/trajectory/speed"] if direction == planned else []
        top = max(trip.tops.get("speed", 1.0) for trip in group)
        if coloured:
            title = f"Speed {direction} [km/h]"
            rows.append(plot([*coloured, *limits[:1], *plan], title, top, coloured))
    rows.extend(
        plot(
            [f"{line}/maximum_adhesion/{path_of(layer)[1:]}/**" for layer in layers],
            "Maximum adhesion along the line, in its own direction [1]",
        )
        for line in dict.fromkeys(trip.line for trip in trips if trip.layer)
    )
    chart = _map(trips, trips[0].layer, LARGE_MAP)
    plots = rrb.Vertical(*rows)
    if chart is None:
        return rrb.Horizontal(plots, name="All trips")
    return rrb.Horizontal(plots, chart, column_shares=[2.0, 1.0], name="All trips")


def plot(
    contents: list[str],
    title: str,
    top: float | None = None,
    overrides: dict[str, Any] | None = None,
) -> Any:
    """A plot of entities on the shared time axis.

    Parameters
    ----------
    contents : list of str
        Entity paths.
    title : str
        With the unit.
    top : float, optional
        Upper end of the axis, which then begins at 0.
    overrides : dict, optional
        How single entities are drawn, by path.
    """
    return rrb.TimeSeriesView(
        contents=contents,
        name=title,
        axis_x=_axis(),
        axis_y=None if top is None else rrb.ScalarAxis(range=(0.0, top)),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
        overrides=overrides,
    )


def _axis() -> Any:
    return rrb.TimeAxis(link="LinkToGlobal")


def _speed(trip: Shown) -> str:
    """The entity with the trip's own speed; empty without one."""
    for entity in ("speed/measured", "speed/satellites"):
        if entity in trip.entities:
            return f"{trip.root}/{entity}"
    return ""


def _map(trips: Sequence[Shown], layer: str, size: tuple[float, float]) -> Any | None:
    """The line, the stations and the trains; None without coordinates."""
    placed = [trip for trip in trips if trip.extent is not None]
    if not placed:
        return None
    contents = [f"{trip.root}/place/**" for trip in placed]
    title = "Line" if any(trip.line for trip in placed) else "Satellite fixes"
    for line in dict.fromkeys(trip.line for trip in placed if trip.line):
        contents += [f"{line}/track", f"{line}/stations/**"]
        if layer:
            contents.append(f"{line}/condition/{path_of(layer)[1:]}")
            title = f"Line and its maximum adhesion, {layer}"
    extent = np.stack([trip.extent for trip in placed if trip.extent is not None])
    whole = np.column_stack((extent[:, :, 0].min(axis=0), extent[:, :, 1].max(axis=0)))
    return rrb.MapView(contents=contents, name=title, zoom=_zoom(whole, size))


def _zoom(extent: FloatArray, size: tuple[float, float]) -> float:
    """The map's zoom level at which `extent` fills `size` (height, width in points).

    At level z the equator is 256 times 2^z points long (Web Mercator).
    """
    (south, north), (west, east) = extent
    height, width = size
    across = np.array([(north - south) / np.cos(np.radians(0.5 * (north + south))), east - west])
    levels = np.log2(np.array([height, width]) * 360.0 / (256.0 * np.maximum(across, 1e-4)))
    return float(np.clip(levels.min(), 1.0, 18.0))


def _events(trip: Shown) -> Any | None:
    if not trip.shows("events"):
        return None
    return rrb.TextLogView(
        origin=f"{trip.root}/events",
        name="Events",
        columns=rrb.TextLogColumns(
            timeline_columns=[ELAPSED, POSITION],
            text_log_columns=["LogLevel", "Body"],
        ),
    )


def _about(trip: Shown) -> Any:
    return rrb.TextDocumentView(origin=f"{trip.root}/about", name="Trip")


SCALARS = "Scalars:scalars"
"""What a plot draws, by Rerun's name."""

DRAWN = tuple(topic for topic in TOPICS.values() if not topic.foxglove)
"""Topics whose fields are plotted; the others are points on the map and text."""


def write_layout(path: str | Path, application: str) -> None:
    """Write the layout with which Rerun shows a log's own messages, as an ``.rbl`` file.

    Parameters
    ----------
    path : path
        Ends in ``.rbl``; written whole or not at all.
    application : str
        Rerun's id of what it fits: for a log opened directly the file's name without ``.mcap``;
        for a log converted by ``rerun mcap convert`` what was given as ``--application-id``.

    Raises
    ------
    InputError
        If the path ends otherwise or cannot be written.

    Examples
    --------
    >>> import trainlog
    >>> trainlog.write_layout("nonstop.rbl", "nonstop")
    """
    if Path(path).suffix != ".rbl":
        raise InputError("is not the name of a Rerun layout", file=path, remedy="end it in .rbl")
    tabs = [_tab(topic) for topic in DRAWN]
    beside = rrb.Vertical(
        rrb.MapView(origin=GNSS_FIX.name, name="Satellite fix", zoom=12.0),
        rrb.TextLogView(origin=EVENTS.name, name="Events"),
    )
    layout = rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(*tabs), beside, column_shares=[3.0, 1.0]), collapse_panels=True
    )
    layout.top_panel = SharedAxis()
    with atomic_write(path) as temporary:
        layout.save(application, temporary)


def scalars(log: str | Path, topic: str, field: str) -> Any:
    """One field of a log as a lazy stream of Rerun chunks with scalars, on the log's own clocks.

    Parameters
    ----------
    log : path
    topic : str
        A ``trainlog.*`` topic.
    field : str
        Field of it; one ``per_axle`` gives as many scalars a row.

    Returns
    -------
    rerun.chunk.LazyChunkStream
        Its entity is ``topic/field``.

    Raises
    ------
    InputError
        If there is no such topic or field.

    Examples
    --------
    >>> import trainlog
    >>> stream = trainlog.scalars("sample_logs/nonstop.mcap", "/train/state", "speed")
    >>> sum(chunk.num_rows for chunk in stream.to_chunks())
    11832
    """
    found = next((each for each in DRAWN if each.name == topic), None)
    if found is None or field not in {each.name for each in found.fields}:
        raise InputError(
            f"no field {field} of topic {topic} to plot",
            remedy=f"topics: {', '.join(each.name for each in DRAWN)}",
        )
    lens = DeriveLens(_message(found), output_entity=f"{topic}/{field}").to_component(
        rr.Scalars.descriptor_scalars(), _selector(found.field(field))
    )
    return McapReader(log, include_topic_regex=[f"^{topic}$"]).stream().lenses([lens])


def _tab(topic: Topic) -> Any:
    """The fields of a topic, one plot a unit."""
    fields = sorted(topic.fields, key=lambda field: field.unit)
    plots = [
        plot(
            [topic.name],
            f"{', '.join(field.name for field in group)} [{unit}]",
            overrides={topic.name: [_line(topic, field) for field in group]},
        )
        for unit, group in ((u, list(g)) for u, g in groupby(fields, key=lambda each: each.unit))
    ]
    return rrb.Vertical(*plots, name=topic.name[1:])


def _line(topic: Topic, field: Field) -> Any:
    """How a plot takes a field out of its message."""
    source = VisualizerComponentMapping(
        SCALARS,
        ComponentSourceKind.SourceComponent,
        source_component=_message(topic),
        selector=_selector(field),
    )
    return rr.SeriesLines(names=field.name).visualizer(mappings=[source])


def _message(topic: Topic) -> str:
    return f"{topic.message}:message"


def _selector(field: Field) -> str:
    """Rerun's path to a field; brackets take a list apart."""
    return f".{field.name}[]" if field.per_axle else f".{field.name}"

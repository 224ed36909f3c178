"""The named views of a replay: which panels each has, and how they are laid out.

Each view is a tab: *overview*, *driving*, *traction*, *identification*, *map*, and *recorder* for
what else a train's recorder has. A view is there if the trips hold what it is about, and a panel if
there is something to draw in it.

Rerun reads MCAP itself: fixes and events show at once; a ``trainlog.*`` message arrives as one
structure with all its fields, which a plot takes apart only with a layout that names them.
`write_layout` writes that layout, one for all logs; `scalars` takes the fields out for further work
in Python. Values stay in SI units there, and there is no timeline over position: for that a
recording has to be made, see `trainlog.replay.write_replay`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping
from rerun.chunk import DeriveLens, McapReader

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.replay.drawing import COLOURS_IN_WORDS, PHASE_LETTERS, Chart, Shown
from trainlog.replay.samples import ELAPSED, POSITION, SPEEDS_SHOWN, TIME, Panel, path_of
from trainlog.replay.survey import BEHIND, SLOWER
from trainlog.topics import EVENTS, GNSS_FIX, TOPICS, Field, Topic

SHARED_AXIS = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"
"""Where Rerun keeps the time axis that linked plots share (its GLOBAL_VIEW_ID)."""

PLAYBACK_SPEED = 20.0
"""Seconds of a trip shown in one second."""

PLAYBACK_POSITION = 400.0
"""Metres of a line shown in one second, when playing over position."""

VIEWS = ("overview", "driving", "traction", "identification", "map", "recorder")
"""Names of the views, in the order of their tabs."""

OVERVIEW = ("speed", "efforts", "slip", "gradient")
DRIVING = ("speed", "efforts", "couplers", "gradient")
TRACTION = ("speed", "efforts", "slip", "adhesion", "couplers")
IDENTIFICATION = ("speed", "efforts", "resistance", "gradient")
"""Panels of the views of one trip, if there is something in them.

Few enough for a window 900 points high: Rerun makes none lower than about 100 points, and lets the
last stand below the window's edge.
"""

DIFFERENCES: dict[tuple[str, ...], int] = {OVERVIEW: 1, DRIVING: 2}
"""How many of the differences to the reference stand among the panels of a view."""

NEEDED = {"traction": ("slip", "adhesion"), "identification": ("resistance",)}
"""A view of one trip is there if one of these panels is."""

_NAMED = ", ".join(f"{letter} {phase}" for phase, letter in PHASE_LETTERS.items())

LANES = {"kilometre": "kilometre", "phase": f"driving phase ({_NAMED})", "section": "section"}
"""Entities of a trip that are drawn as blocks under the plots, in Rerun's order; their titles."""

LANE_HEIGHT, LANES_HEIGHT, COMMON_HEIGHT = 40.0, 56.0, 800.0
"""Of a lane, of what lanes have in common, and of all rows on a common screen [points]."""

MOST_NAMED = 12
"""With more trips over each other, a legend would cover the plot."""


@dataclass(frozen=True, eq=False)
class Contents:
    """What a replay holds besides its trips.

    Attributes
    ----------
    planned : str or None
        Direction of the trajectory, if there is one.
    layers : sequence of str
        Of the track-condition map.
    chart : Chart
        What places are drawn on.
    adhesion : float
        Upper end of the axis of that map.
    live : bool
        Whether the trip is still recorded: the cursor stays at its end.
    """

    planned: str | None = None
    layers: Sequence[str] = field(default=())
    chart: Chart = field(default_factory=Chart)
    adhesion: float = 0.4
    live: bool = False


SIDE_MAP, LARGE_MAP = (350.0, 330.0), (460.0, 1100.0)
"""Greatest height and width of the map beside plots, and alone, on a common screen [points]."""

LEAST_MAP, TITLE = 90.0, 30.0
"""Least height of a map, and that of the title of a panel [points]."""

CURSOR_HEIGHT, EVENTS_HEIGHT, ABOUT_HEIGHT = 190.0, 200.0, 260.0
"""Of the panels beside the plots, on a common screen [points]; what is left over they share."""

Row = tuple[Any, float]
"""A view and its height: relative to the other plots, or [points] of panels beside them."""


MARGIN = 0.12
"""Around a plan, for the names of stations at its edge, against its larger side."""


class SharedAxis:
    """The shared time axis, from end to end of whichever timeline is shown.

    Stands where a blueprint keeps a panel: Rerun has no part of its own for it.
    """

    def _log_to_stream(self, stream: Any) -> None:
        whole = rr.TimeRange(
            start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
        )
        stream.log(SHARED_AXIS, rrb.TimeAxis(view_range=whole))


def blueprint(trips: Sequence[Shown], contents: Contents, view: str | None = None) -> Any:
    """The layout for these trips, as Rerun's blueprint.

    Parameters
    ----------
    trips : sequence of Shown
    contents : Contents
    view : str, optional
        Which of `VIEWS` is shown first. Default: the overview.

    Raises
    ------
    InputError
        If there is no view of that name, or these trips hold nothing for it.
    """
    views = _views(trips, contents)
    shown = view or VIEWS[0]
    check_view(shown)
    if shown not in views:
        raise InputError(
            f"the trips hold nothing for the view '{shown}'",
            remedy=f"they have the views {', '.join(views)}",
        )
    tabs = [views[name] for name in VIEWS if name in views]
    # Trips lie over each other by position; one alone, or one after the other, run in time.
    several = len(trips) > 1
    timeline = ELAPSED if several else TIME
    if shown == "map" or (shown == "overview" and several):
        timeline = POSITION
    made = rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=list(views).index(shown)),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed",
            timeline=timeline,
            playback_speed=PLAYBACK_SPEED,
            fps=PLAYBACK_POSITION,
            play_state="following" if contents.live else "paused",
        ),
    )
    made.top_panel = SharedAxis()
    return made


def check_view(view: str) -> None:
    """Refuse a view that no replay has.

    Raises
    ------
    InputError
    """
    if view not in VIEWS:
        raise InputError(f"there is no view '{view}'", remedy=f"views are {', '.join(VIEWS)}")


def _views(trips: Sequence[Shown], contents: Contents) -> dict[str, Any]:
    """The views that these trips have, each a container with its name."""
    whole = [trip for trip in trips if not trip.brief]
    one = len(trips) == 1
    first = _page(trips[0], OVERVIEW, contents) if one else _together(trips, contents)
    views = {"overview": first}
    for name, panels in (
        ("driving", DRIVING),
        ("traction", TRACTION),
        ("identification", IDENTIFICATION),
    ):
        held = [trip for trip in whole if any(map(trip.shows, NEEDED.get(name, panels)))]
        views[name] = _tabbed([_page(trip, panels, contents) for trip in held], name)
    views["map"] = _places(trips, contents)
    views["recorder"] = _tabbed([_recorder(trip) for trip in whole], "recorder")
    made = {name: view for name, view in views.items() if view is not None}
    for name, view in made.items():
        view.name = name.capitalize()
    return made


def _tabbed(pages: Sequence[Any], name: str) -> Any | None:
    """A page, or one tab a trip; None without any."""
    found = [page for page in pages if page is not None]
    if not found:
        return None
    return found[0] if len(found) == 1 else rrb.Tabs(*found, active_tab=0, name=name)


def _page(trip: Shown, panels: tuple[str, ...], contents: Contents) -> Any:
    """Some panels of a trip, with lanes under the first; where it is, its events, particulars."""
    rows = [
        (_panel(trip, panel), panel.share)
        for panel in trip.panels
        if panel.entity in panels and trip.shows(panel.entity)
    ]
    at = min(1, len(rows))
    differences = _differences(trip.reference) if trip.reference else ()
    rows[at:at] = [
        (plot([f"{trip.root}/{entity}"], title), 1.1)
        for entity, title in differences[: DIFFERENCES.get(panels, 0)]
    ]
    _add_lanes(rows, at, trip, tuple(LANES))
    place = _chart([trip], contents, trip.layer, SIDE_MAP)
    return _beside(rows, [place, _cursor(trip), _events(trip), _about([trip])], trip.name)


def _differences(reference: str) -> tuple[tuple[str, str], ...]:
    """Entities of the differences and their titles, from the top down."""
    return (
        (BEHIND, f"Lateness against {reference} [s]: late above 0, early below"),
        (SLOWER, f"Speed minus that of {reference} [km/h]"),
    )


def _stacked(rows: Sequence[Row], name: str | None = None) -> Any:
    """Views below each other."""
    views, heights = zip(*rows, strict=True)
    return rrb.Vertical(*views, row_shares=list(heights), name=name)


def _beside(rows: list[Row], side: Sequence[Row | None], name: str) -> Any:
    """Plots on the left, the rest on the right."""
    found = [each for each in side if each is not None]
    if not (rows and found):
        return rrb.Vertical(_stacked(rows), name=name) if rows else _stacked(found, name)
    return rrb.Horizontal(_stacked(rows), _stacked(found), column_shares=[2.6, 1.0], name=name)


def _add_lanes(rows: list[Row], at: int, trip: Shown, lanes: Sequence[str]) -> None:
    """Put the lanes of a trip between the rows, as high as they need."""
    found = [lane for lane in lanes if trip.shows(lane)]
    if not found:
        return
    title = ", ".join(LANES[lane] for lane in found)
    view = rrb.StateTimelineView(
        contents=[f"{trip.root}/{lane}" for lane in found],
        name=f"{title[0].upper()}{title[1:]}",
        time_view=_axis(),
    )
    height = LANES_HEIGHT + LANE_HEIGHT * len(found)
    others = max(sum(share for _, share in rows), 1.0)
    rows.insert(at, (view, others * height / (COMMON_HEIGHT - height)))


def _panel(trip: Shown, panel: Panel) -> Any:
    title = panel.title
    if panel.entity == "speed":
        title = f"{trip.name}: {title[0].lower()}{title[1:]}"
    top = trip.tops.get(panel.entity) if panel.from_zero else None
    return plot([f"{trip.root}/{panel.entity}/**"], title, top)


def _recorder(trip: Shown) -> Any | None:
    """What else a train's recorder has."""
    others = [each for each in trip.panels if each.beside and trip.shows(each.entity)]
    if not others:
        return None
    return _stacked([(_panel(trip, each), each.share) for each in others], trip.name)


def _together(trips: Sequence[Shown], contents: Contents) -> Any:
    """Trips over each other, each direction apart: speeds, and differences to the reference."""
    rows = list[Row]()
    named = len(trips) <= MOST_NAMED
    for direction in dict.fromkeys(trip.direction for trip in trips):
        group = [trip for trip in trips if trip.direction == direction]
        coloured = {
            entity: rr.SeriesLines(names=trip.name, colors=[trip.colour]).visualizer()
            for trip, entity in ((each, _speed(each)) for each in group)
            if entity
        }
        limits = [f"{trip.root}/speed/limit" for trip in group if "speed/limit" in trip.entities]
        plan = ["/trajectory/speed"] if direction == contents.planned else []
        top = max(trip.tops.get("speed", 1.0) for trip in group)
        if coloured:
            title = f"Speed {direction} [km/h]"
            drawn = [*coloured, *limits[:1], *plan]
            rows.append((plot(drawn, title, top, coloured, legend=named), 2.0))
        for reference in dict.fromkeys(trip.reference for trip in group if trip.reference):
            compared = [trip for trip in group if trip.reference == reference]
            for entity, title in _differences(reference):
                found = [f"{trip.root}/{entity}" for trip in compared if entity in trip.entities]
                if found:
                    rows.append((plot(found, title, legend=False), 1.2))
    first = next((trip for trip in trips if trip.shows("kilometre")), trips[0])
    _add_lanes(rows, len(rows), first, ("kilometre", "section"))
    place = _chart(trips, contents, trips[0].layer, SIDE_MAP)
    return _beside(rows, [place, _cursor(first), _about(trips)], "All trips")


def _places(trips: Sequence[Shown], contents: Contents) -> Any | None:
    """The chart, large, and the maximum adhesion along each line; None without a place."""
    title = "Maximum adhesion along the line, in its own direction [1]"
    layers = [f"maximum_adhesion/{path_of(layer)[1:]}/**" for layer in contents.layers]
    rows = [
        (plot([f"{line}/{layer}" for layer in layers], title, contents.adhesion), 1.0)
        for line in dict.fromkeys(trip.line for trip in trips if trip.layer)
    ]
    layer = next((trip.layer for trip in trips if trip.layer), "")
    place = _chart(trips, contents, layer, LARGE_MAP)
    if place is None and not rows:
        return None
    first = next((trip for trip in trips if trip.shows("cursor")), None)
    if place is not None:
        view, height = place
        rows.insert(0, (view, height * max(len(rows), 1) / (COMMON_HEIGHT - height)))
    side = [_about(trips)]
    if first is not None:
        _add_lanes(rows, len(rows), first, ("kilometre", "section"))
        side = [_cursor(first), _events(first), *side]
    return _beside(rows, side, "Map")


def plot(
    contents: list[str],
    title: str,
    top: float | None = None,
    overrides: dict[str, Any] | None = None,
    *,
    legend: bool = True,
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
    legend : bool
        Whether the lines are named in it; a line under the pointer is named in any case.
    """
    return rrb.TimeSeriesView(
        contents=contents,
        name=title,
        axis_x=_axis(),
        axis_y=None if top is None else rrb.ScalarAxis(range=(0.0, top)),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
        overrides=overrides,
    )


def _axis() -> Any:
    return rrb.TimeAxis(link="LinkToGlobal")


def _speed(trip: Shown) -> str:
    """The entity with the trip's own speed; empty without one."""
    for entity in SPEEDS_SHOWN:
        if entity in trip.entities:
            return f"{trip.root}/{entity}"
    return ""


def _chart(
    trips: Sequence[Shown], contents: Contents, layer: str, size: tuple[float, float]
) -> Row | None:
    """The line, the stations and the trains from above; None without a place.

    As high as it needs in its width, and at most as `size` has it.
    """
    placed = [trip for trip in trips if trip.extent is not None]
    if not placed:
        return None
    drawn = [f"{trip.root}/place/**" for trip in placed]
    title = "Line" if any(trip.line for trip in placed) else "Satellite fixes"
    for line in dict.fromkeys(trip.line for trip in placed if trip.line):
        drawn += [f"{line}/track", f"{line}/stations/**"]
        if layer:
            drawn.append(f"{line}/condition/{path_of(layer)[1:]}/**")
            title = f"Line and its maximum adhesion, {layer}"
            title += f": {COLOURS_IN_WORDS}" * contents.chart.tiles
    extent = np.stack([trip.extent for trip in placed if trip.extent is not None])
    whole = np.column_stack((extent[:, :, 0].min(axis=0), extent[:, :, 1].max(axis=0)))
    if not contents.chart.tiles:
        x, y = np.sort(contents.chart.plan(whole.T), axis=0).T
        margin = MARGIN * max(np.ptp(x), np.ptp(y), 1.0)
        bounds = rrb.VisualBounds2D(
            x_range=(x[0] - margin, x[1] + margin), y_range=(y[0] - margin, y[1] + margin)
        )
        view = rrb.Spatial2DView(contents=drawn, name=title, visual_bounds=bounds)
        high = size[1] * (np.ptp(y) + 2.0 * margin) / (np.ptp(x) + 2.0 * margin)
        return view, TITLE + float(np.clip(high, LEAST_MAP, size[0]))
    return rrb.MapView(contents=drawn, name=title, zoom=_zoom(whole, size)), size[0]


def _zoom(extent: FloatArray, size: tuple[float, float]) -> float:
    """The map's zoom level at which `extent` fills `size` (height, width in points).

    At level z the equator is 256 times 2^z points long (Web Mercator).
    """
    (south, north), (west, east) = extent
    height, width = size
    across = np.array([(north - south) / np.cos(np.radians(0.5 * (north + south))), east - west])
    levels = np.log2(np.array([height, width]) * 360.0 / (256.0 * np.maximum(across, 1e-4)))
    return float(np.clip(levels.min(), 1.0, 18.0))


def _events(trip: Shown) -> Row | None:
    if not trip.shows("events"):
        return None
    # Where the train was then the cursor's panel states; the texts need the width.
    columns = rrb.TextLogColumns(timeline_columns=[ELAPSED], text_log_columns=["LogLevel", "Body"])
    view = rrb.TextLogView(origin=f"{trip.root}/events", name="Events", columns=columns)
    return view, EVENTS_HEIGHT


def _cursor(trip: Shown) -> Row | None:
    if not trip.shows("cursor"):
        return None
    name = f"At the cursor: {trip.name}"
    return rrb.TextDocumentView(origin=f"{trip.root}/cursor", name=name), CURSOR_HEIGHT


def _about(trips: Sequence[Shown]) -> Row | None:
    """Particulars of trips, of several one tab each."""
    views = [
        rrb.TextDocumentView(origin=f"{trip.root}/about", name=f"Trip {trip.name}")
        for trip in trips
        if trip.shows("about")
    ]
    if not views:
        return None
    return views[0] if len(views) == 1 else rrb.Tabs(*views, active_tab=0), ABOUT_HEIGHT


# -------------------------------------------------------------- logs that Rerun opens as they are


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

"""Pictures of a network: its stations and edges, coloured by what is known along them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from analysis.charts import GREY, INK, PALE, headline, new_figure, write_figure
from trainlog.arrays import FloatArray
from trainlog.extras import require
from trainlog.railway.network import Edge, Network

if TYPE_CHECKING:
    from matplotlib.figure import Figure


KM_OF_DEGREE = 111.195
"""Of latitude."""

PIECES = 48
"""Of a course that is drawn as a bow or a circle."""


@dataclass(frozen=True, eq=False)
class AlongEdge:
    """What is shown along an edge.

    Attributes
    ----------
    bounds : (n + 1,) array [m]
        Of bins, on the edge's chainage.
    values : (n,) array
        NaN: not known, drawn grey.
    certainty : (n,) array, optional
        From 0 to 1: how wide a bin is drawn.

    Examples
    --------
    >>> import numpy as np
    >>> AlongEdge(np.array([0.0, 500.0]), np.array([0.3])).values.tolist()
    [0.3]
    """

    bounds: FloatArray
    values: FloatArray
    certainty: FloatArray | None = None


def draw_network(
    network: Network,
    path: str | Path | None = None,
    *,
    shown: Mapping[str, AlongEdge] | None = None,
    label: str = "",
    title: str = "",
    colours: str = "viridis",
    span: tuple[float, float] | None = None,
) -> Figure:
    """Draw a network by the course of its edges on the earth.

    Where it has no coordinates, nodes are placed by how long the edges between them are.

    Parameters
    ----------
    network : Network
    path : path, optional
        Where to write it (.png, .svg).
    shown : mapping of edge to AlongEdge, optional
        What colours the edges.
    label : str
        Of the colours, with the unit.
    title : str
        Default: the network's name.
    colours : str
        Colour map of matplotlib.
    span : (float, float), optional
        Values at its ends.

    Returns
    -------
    Figure

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> nodes = (trainlog.Node("St. Gallen"), trainlog.Node("Wil"))
    >>> edge = trainlog.Edge("850", line, "St. Gallen", "Wil")
    >>> figure = draw_network(trainlog.Network("one", nodes, (edge,)))
    >>> figure.axes[0].get_xlabel()
    'east [km]'
    """
    courses = edge_courses(network)
    every = np.concatenate([points for _, points in courses.values()])
    wide, high = np.maximum(np.ptp(every, axis=0), 1e-9).tolist()
    figure = new_figure(9.0, float(np.clip(8.0 * high / wide + 1.5, 3.5, 9.0)))
    axes = figure.add_subplot()
    drawn = _draw_edges(axes, network, courses, shown or {}, (colours, span))
    _draw_nodes(axes, network, courses)
    _draw_stations(axes, network, courses)
    on_earth = _placed(network) is not None
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    straight = any(edge.line.geometry is None for edge in network.edges)
    east = f"east [km]{'; dashed: without coordinates of its own' * straight}"
    axes.set_xlabel(east if on_earth else "no coordinates: distances are not true", color=INK)
    axes.set_ylabel("north [km]" if on_earth else "", color=INK)
    if not on_earth:
        axes.set_xticks([])
        axes.set_yticks([])
    axes.tick_params(colors=INK, labelsize=9)
    if on_earth:
        axes.grid(visible=True, color=PALE, linewidth=0.5)
    axes.set_axisbelow(True)
    for side in axes.spines.values():
        side.set_color(PALE)
    if drawn is not None:
        bar = figure.colorbar(drawn, ax=axes, shrink=0.8, pad=0.02)
        bar.set_label(label, color=INK)
        bar.outline.set_visible(False)
    headline(figure, title or f"{network.name}, {network.length / 1e3:.1f} km of line")
    if path is not None:
        write_figure(figure, path)
    return figure


def _draw_edges(
    axes: Axes,
    network: Network,
    courses: Mapping[str, tuple[FloatArray, FloatArray]],
    shown: Mapping[str, AlongEdge],
    scale: tuple[str, tuple[float, float] | None],
) -> LineCollection | None:
    """Draw the edges; what carries the colours, if something is shown."""
    segments, values, widths = [], [], []
    on_earth = _placed(network) is not None
    for edge in network.edges:
        positions, points = courses[edge.name]
        colour = PALE if edge.name in shown else GREY
        style = (0, (4, 1.5)) if on_earth and edge.line.geometry is None else "-"
        axes.plot(*points.T, color=colour, linewidth=2.0, linestyle=style, zorder=1)
        known = shown.get(edge.name)
        if known is None:
            continue
        for number in np.flatnonzero(np.isfinite(known.values)):
            segments.append(_stretch(positions, points, *known.bounds[number : number + 2]))
            values.append(known.values[number])
            sure = 1.0 if known.certainty is None else float(known.certainty[number])
            widths.append(1.5 + 4.5 * min(max(sure, 0.0), 1.0))
    if not segments:
        return None
    drawn = LineCollection(segments, linewidths=widths, cmap=scale[0], zorder=2)
    drawn.set_array(np.array(values))
    if scale[1] is not None:
        drawn.set_clim(*scale[1])
    axes.add_collection(drawn)
    return drawn


def _stretch(positions: FloatArray, points: FloatArray, start: float, end: float) -> FloatArray:
    """The course from one chainage to another."""
    inside = positions[(positions > start) & (positions < end)]
    at = np.concatenate(([start], inside, [end]))
    return np.column_stack([np.interp(at, positions, points[:, axis]) for axis in (0, 1)])


def _draw_nodes(
    axes: Axes, network: Network, courses: Mapping[str, tuple[FloatArray, FloatArray]]
) -> None:
    """Mark the nodes, and name the stations; labels stand on the side where fewer edges are."""
    places: dict[str, FloatArray] = {}
    away: dict[str, list[FloatArray]] = {}
    for edge in network.edges:
        _, points = courses[edge.name]
        quarter = max(len(points) // 4, 1)
        for name, end, inner in (
            (edge.start, points[0], points[quarter]),
            (edge.end, points[-1], points[-1 - quarter]),
        ):
            places[name] = end
            way = inner - end
            away.setdefault(name, []).append(way / max(float(np.hypot(*way)), 1e-9))
    for node in network.nodes:
        place = places[node.name]
        station = node.kind == "station"
        axes.plot(
            *place,
            marker="o",
            markersize=6.0 if station else 3.5,
            color="white" if station else INK,
            markeredgecolor=INK,
            markeredgewidth=1.2,
            zorder=3,
        )
        if station:
            free = -np.sum(away[node.name], axis=0)
            axes.annotate(
                node.name,
                (float(place[0]), float(place[1])),
                xytext=(8.0 if free[0] >= 0.0 else -8.0, 7.0 if free[1] >= 0.0 else -7.0),
                textcoords="offset points",
                ha="left" if free[0] >= 0.0 else "right",
                va="bottom" if free[1] >= 0.0 else "top",
                fontsize=8,
                color=INK,
                zorder=4,
            )


def _draw_stations(
    axes: Axes, network: Network, courses: Mapping[str, tuple[FloatArray, FloatArray]]
) -> None:
    """Mark the stations inside edges, and name each once: one may lie on several tracks."""
    places: dict[str, list[FloatArray]] = {}
    nodes = {node.name for node in network.nodes}
    for edge in network.edges:
        positions, points = courses[edge.name]
        for station in edge.line.stations:
            if station.name not in nodes:
                at = [np.interp(station.position, positions, points[:, axis]) for axis in (0, 1)]
                places.setdefault(station.name, []).append(np.array(at))
    for number, (name, found) in enumerate(places.items()):
        for place in found:
            axes.plot(*place, marker="|", markersize=10.0, markeredgewidth=1.6, color=INK, zorder=3)
        # Above and below in turn: neighbours on one line do not run into each other.
        middle, above = np.mean(found, axis=0), number % 2 == 0
        axes.annotate(
            name,
            (float(middle[0]), float(middle[1])),
            xytext=(0.0, 9.0 if above else -9.0),
            textcoords="offset points",
            ha="center",
            va="bottom" if above else "top",
            fontsize=8,
            color=INK,
            zorder=4,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
        )


def edge_courses(network: Network) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Where each edge is drawn: chainage [m], (n,), and places [km], (n, 2), east and north."""
    placed = _placed(network)
    geometries = {
        edge.name: edge.line.geometry for edge in network.edges if edge.line.geometry is not None
    }
    nodes = _laid_out(network) if placed is None else placed[0]
    found: dict[str, tuple[FloatArray, FloatArray]] = {}
    alike: dict[frozenset[str], int] = {}
    for edge in network.edges:
        geometry = geometries.get(edge.name)
        if geometry is not None and placed is not None:
            points = _projected(geometry.latitudes, geometry.longitudes, placed[1])
            found[edge.name] = (geometry.positions, points)
            continue
        pair = frozenset((edge.start, edge.end))
        number = alike.get(pair, 0)
        alike[pair] = number + 1
        points = _bow(nodes[edge.start], nodes[edge.end], edge, number)
        found[edge.name] = (np.linspace(0.0, edge.line.length, len(points)), points)
    return found


def _placed(network: Network) -> tuple[dict[str, FloatArray], tuple[float, float]] | None:
    """Nodes on the earth, and the middle of the projection; None where one has no place."""
    known: dict[str, tuple[float, float]] = {}
    for edge in network.edges:
        geometry = edge.line.geometry
        if geometry is not None:
            for name, at in ((edge.start, 0), (edge.end, -1)):
                where = (float(geometry.latitudes[at]), float(geometry.longitudes[at]))
                known.setdefault(name, where)
    for node in network.nodes:
        if node.latitude is not None and node.longitude is not None:
            known[node.name] = (node.latitude, node.longitude)
    if any(node.name not in known for node in network.nodes):
        return None
    every = np.array(list(known.values()))
    middle = (float(every[:, 0].mean()), float(every[:, 1].mean()))
    places = {
        name: _projected(np.array([where[0]]), np.array([where[1]]), middle)[0]
        for name, where in known.items()
    }
    return places, middle


def _projected(
    latitudes: FloatArray, longitudes: FloatArray, middle: tuple[float, float]
) -> FloatArray:
    """East and north of the middle [km], (n, 2): small beside the earth."""
    east = (longitudes - middle[1]) * KM_OF_DEGREE * np.cos(np.radians(middle[0]))
    return np.column_stack((east, (latitudes - middle[0]) * KM_OF_DEGREE))


def _laid_out(network: Network) -> dict[str, FloatArray]:
    """Places for the nodes of a network without coordinates."""
    require("networkx")
    import networkx

    graph: Any = networkx.Graph()
    graph.add_nodes_from(node.name for node in network.nodes)
    for edge in network.edges:
        if edge.start != edge.end:
            graph.add_edge(edge.start, edge.end, weight=edge.line.length / 1e3)
    size = sum(edge.line.length for edge in network.edges) / 1e3 / 4.0
    places = networkx.kamada_kawai_layout(graph, weight="weight", scale=size)
    return {name: np.asarray(place, dtype=np.float64) for name, place in places.items()}


def _bow(start: FloatArray, end: FloatArray, edge: Edge, number: int) -> FloatArray:
    """A course between two places: straight, bowed where there are several, a circle for a loop."""
    share = np.linspace(0.0, 1.0, PIECES + 1)[:, None]
    if edge.start == edge.end:
        radius = edge.line.length / 1e3 / (2.0 * np.pi)
        angle = 2.0 * np.pi * share[:, 0]
        return start + radius * np.column_stack((np.sin(angle), 1.0 - np.cos(angle)))
    across = np.array([start[1] - end[1], end[0] - start[0]])
    side = 1.0 if edge.start < edge.end else -1.0
    height = side * (number + 1) // 2 * (-1) ** number * 0.15 if number else 0.0
    return np.asarray(start + share * (end - start) + 4.0 * height * share * (1 - share) * across)

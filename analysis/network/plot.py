"""Charts of a network: its stations and edges, and what the maps of its edges know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from analysis.adhesion.condition_table import bins_table
from analysis.adhesion.map_plot import detail, low_by_bin, lowest_bins, strip_cells
from analysis.charts import GREY, INK, PALE, Chart, Curve, Label, Panel
from trainlog.arrays import FloatArray
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.extras import require
from trainlog.railway.condition import ADHESION_CLASSES, ADHESION_COLOURS, adhesion_class
from trainlog.railway.network import Edge, Network
from trainlog.spans import runs_of

if TYPE_CHECKING:
    from analysis.network.maps import NetworkMap

KM_OF_DEGREE = 111.195
"""Of latitude."""

PIECES = 48
"""Of a course that is drawn as a bow or a circle."""

LEAST_SHOWN = 0.005
"""Share of a network's extent that an observed piece takes at least: to be seen."""

MOST_STRIPS = 40
"""Edges of a rail condition that are drawn as strips."""


def network_charts(
    network: Network,
    *,
    shown: Mapping[str, tuple[FloatArray, FloatArray]] | None = None,
    places: Sequence[tuple[str, float]] = (),
    title: str = "",
) -> list[Chart]:
    """A network by the course of its edges on the earth.

    Where it has no coordinates, nodes are placed by how long the edges between them are.

    Parameters
    ----------
    network : Network
    shown : mapping of edge to ((n + 1,) array [m], (n,) array), optional
        Bins on the edge's chainage, and their maximum adhesion, which colours them; NaN: not known.
    places : sequence of (edge, chainage [m])
        Are numbered.
    title : str
        Default: the network's name.

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> nodes = (trainlog.Node("St. Gallen"), trainlog.Node("Wil"))
    >>> edge = trainlog.Edge("850", line, "St. Gallen", "Wil")
    >>> network_charts(trainlog.Network("one", nodes, (edge,)))[0].x
    'east [km]'
    """
    courses = edge_courses(network)
    every = np.concatenate([points for _, points in courses.values()])
    low, wide = every.min(axis=0), np.maximum(np.ptp(every, axis=0), 1e-9)
    on_earth = _placed(network) is not None
    straight = on_earth and any(edge.line.geometry is None for edge in network.edges)
    curves = [
        _through("", courses[edge.name][1], GREY if shown is None else PALE, 2.0,
                 dash="--" if on_earth and edge.line.geometry is None else "")
        for edge in network.edges
    ]  # fmt: skip
    for number, (name, colour) in enumerate(zip(ADHESION_CLASSES, ADHESION_COLOURS, strict=True)):
        pieces = [
            np.append(_stretch(*courses[edge], *bounds[[begin, end]]), [[np.nan, np.nan]], axis=0)
            for edge, (bounds, values) in (shown or {}).items()
            for begin, end in runs_of(np.isfinite(values) & (adhesion_class(values) == number))
        ]
        if pieces:
            curves.append(_through(name, np.concatenate(pieces), colour, 4.5))
    labels = [
        Label(x, f"  {number}", y, size=9.0, side="left")
        for number, (edge, place) in enumerate(places, start=1)
        for x, y in [_at(courses[edge], place)]
    ]
    nodes, names = _nodes(network, courses, 0.02 * float(wide.max()))
    stations, others = _stations(network, courses, 0.03 * float(wide.max()))
    margin = 0.08 * float(wide.max())
    panel = Panel(
        "north [km]" * on_earth, [*curves, *nodes, *stations],
        float(np.clip(3.7 * wide[1] / wide[0], 1.0, 3.5)),
        labels=[*names, *others, *labels], bare=not on_earth,
        limits=(low[1] - margin, low[1] + wide[1] + margin),
    )  # fmt: skip
    dashed = "; dashed: without coordinates of its own" * straight
    return [
        Chart(
            f"east [km]{dashed}" if on_earth else "no coordinates: distances are not true",
            [panel],
            span=(low[0] - margin, low[0] + wide[0] + margin),
            title=title or f"{network.name}, {network.length / 1e3:.1f} km of line",
            ticks=() if on_earth else [(float(low[0]), "")],
            equal=True,
        )
    ]


def network_map_charts(
    maps: NetworkMap,
    *,
    at: pd.Timestamp | None = None,
    layers: Sequence[str] = (),
    network: Network | None = None,
) -> list[Chart]:
    """The network and a strip for each edge, by rail condition; and details of the lowest places.

    Colours are those of the map of a line: the lower end of the 95 % band of what is expected.

    Parameters
    ----------
    maps : NetworkMap
    at : Timestamp, optional
        Only evidence of the days before counts. Default: right after the last evidence.
    layers : sequence of str
        Rail conditions; default: all.
    network : Network, optional
        Default: that of the folder; without one the strips are drawn alone.

    Raises
    ------
    InputError
        If no edge has a layer that is asked for.
    """
    known = maps if at is None else maps.known_before(at)
    chosen = [name for name in known.layers if not layers or name in layers]
    if not chosen:
        raise InputError(
            f"no edge has a layer '{', '.join(layers) or 'dry'}'",
            file=maps.folder,
            remedy=f"layers there are: {', '.join(known.layers) or 'none'}",
        )
    tracks = {edge: each for edge, each in known.maps.items() if set(each.layers) & set(chosen)}
    bins = pd.concat(
        [
            bins_table(each, None, at, [x for x in chosen if x in each.layers]).assign(line=edge)
            for edge, each in tracks.items()
        ]
    )
    lowest = lowest_bins(bins)
    middle = 0.5 * (lowest["start_m"] + lowest["end_m"])
    places = list(zip(lowest["line"], middle.tolist(), strict=True))
    when = "" if at is None else f" on {at:%Y-%m-%d %H:%M} UTC"
    network, charts = network or maps.network, list[Chart]()
    for name in chosen:
        title = f"Maximum adhesion to count on, {name} rail{when}; grey: not observed"
        own = {edge: each for edge, each in tracks.items() if name in each.layers}
        of_layer = bins[bins["layer"] == name]
        low = {
            edge: low_by_bin(each, of_layer[of_layer["line"] == edge]) for edge, each in own.items()
        }
        if network is not None:
            shown = {
                edge.name: (own[edge.name].edges, low[edge.name])
                for edge in network.edges
                if edge.name in own
            }
            numbers = [each for each in places if each[0] in shown]
            charts += network_charts(network, shown=shown, places=numbers, title=title)
        seen = [edge for edge, values in low.items() if np.isfinite(values).any()]
        if seen:
            more = len(seen) - MOST_STRIPS
            title += f"; {counted(more, 'more edge')} observed" if more > 0 else ""
            drawn = {edge: own[edge] for edge in seen[:MOST_STRIPS]}
            charts.append(_strips(drawn, low, places, title))
    details = [
        detail(tracks[edge], number, place, bins[bins["line"] == edge], None, edge)
        for number, (edge, place) in enumerate(places, start=1)
    ]
    return [*charts, *details]


def _strips(
    tracks: Mapping[str, Any],
    low: Mapping[str, FloatArray],
    places: Sequence[tuple[str, float]],
    title: str,
) -> Chart:
    """Edges below each other, each coloured where it was observed."""
    longest = max(each.length for each in tracks.values())
    edges = list(tracks)
    cells = [
        strip_cells(each, low[edge], LEAST_SHOWN * longest, (row - 0.3, row + 0.3))
        for row, (edge, each) in enumerate(tracks.items())
    ]
    ground = [
        Curve("not observed" * (row == 0), [each.length / 1e3], [row], PALE, "bars", width=0.6,
              across=True)
        for row, each in enumerate(tracks.values())
    ]  # fmt: skip
    labels = [
        Label(place / 1e3, f" {number}", edges.index(edge) - 0.42, size=8.0)
        for number, (edge, place) in enumerate(places, start=1)
        if edge in edges and np.isfinite(low[edge][tracks[edge].bin_of(place)])
    ]
    panel = Panel("", [*ground, *cells], 0.3 + 0.12 * len(edges), rows=edges, labels=labels)
    return Chart("km on the edge", [panel], span=(0.0, longest / 1e3), title=title)


def _at(course: tuple[FloatArray, FloatArray], position: float) -> tuple[float, float]:
    """East and north [km] of a chainage [m]."""
    east, north = (float(np.interp(position, course[0], each)) for each in course[1].T)
    return east, north


def _stretch(positions: FloatArray, points: FloatArray, start: float, end: float) -> FloatArray:
    """The course from one chainage to another."""
    inside = positions[(positions > start) & (positions < end)]
    at = np.concatenate(([start], inside, [end]))
    return np.column_stack([np.interp(at, positions, each) for each in points.T])


def _nodes(
    network: Network, courses: Mapping[str, tuple[FloatArray, FloatArray]], apart: float
) -> tuple[list[Curve], list[Label]]:
    """The nodes, and the names of stations on the side where fewer edges are."""
    places: dict[str, FloatArray] = {}
    away: dict[str, FloatArray] = {}
    for edge in network.edges:
        _, points = courses[edge.name]
        quarter = max(len(points) // 4, 1)
        for name, end, inner in (
            (edge.start, points[0], points[quarter]),
            (edge.end, points[-1], points[-1 - quarter]),
        ):
            places[name] = end
            way = inner - end
            away[name] = away.get(name, 0.0) + way / max(float(np.hypot(*way)), 1e-9)
    curves, labels = list[Curve](), list[Label]()
    for kind, width in (("station", 3.2), ("junction", 1.8)):
        of_kind = [
            each.name for each in network.nodes if (each.kind == "station") == (kind == "station")
        ]
        if of_kind:
            every = np.array([places[name] for name in of_kind])
            curves.append(_through("", every, INK, width, kind="points"))
        for name in of_kind if kind == "station" else ():
            (x, y), right = places[name], away[name][0] <= 0.0
            up = apart if away[name][1] <= 0.0 else -apart
            words = f"  {name}" if right else f"{name}  "
            labels.append(Label(x, words, y + up, side="left" if right else "right", size=8.0))
    return curves, labels


def _stations(
    network: Network, courses: Mapping[str, tuple[FloatArray, FloatArray]], apart: float
) -> tuple[list[Curve], list[Label]]:
    """The stations inside edges, each named once: one may lie on several tracks."""
    places: dict[str, list[tuple[float, float]]] = {}
    nodes = {node.name for node in network.nodes}
    for edge in network.edges:
        for station in edge.line.stations:
            if station.name not in nodes:
                at = _at(courses[edge.name], station.position)
                places.setdefault(station.name, []).append(at)
    if not places:
        return [], []
    every = np.array([place for found in places.values() for place in found])
    # Above and below in turn: neighbours on one line do not run into each other.
    labels = [
        Label(x, name, y + (apart if number % 2 == 0 else -apart), size=8.0)
        for number, (name, found) in enumerate(places.items())
        for x, y in [np.mean(found, axis=0).tolist()]
    ]
    return [_through("", every, INK, 3.0, kind="points", mark="|")], labels


def _through(label: str, points: FloatArray, colour: str, width: float, **options: Any) -> Curve:
    """A curve through places, (n, 2)."""
    return Curve(label, points[:, 0], points[:, 1], colour, width=width, **options)


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

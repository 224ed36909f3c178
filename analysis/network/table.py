"""A network, and a route in it, as tables."""

from __future__ import annotations

import numpy as np

from trainlog.display import counted, span
from trainlog.presentation import POSITION, SPEED, Column, Quantity, Said, WordTable, new_table
from trainlog.railway import Line
from trainlog.railway.network import Edge, Network, Route, assumed_on
from trainlog.units import KMH

HEIGHT = Quantity("m", "m")
RADIUS = Quantity("m", "m", 1.0, 0)


def network_tables(network: Network) -> list[WordTable | str]:
    """A network as a person reads it: its edges, its nodes, and what is not known of it."""
    stations = [_stations(network)] if any(e.line.stations for e in network.edges) else []
    source = [network.source] if network.source else []
    return [*source, _edges(network), *stations, _nodes(network), *_unknown(network)]


def _edges(network: Network) -> WordTable:
    table = new_table(
        f"Edges of {network.name}: {len(network.edges)}, {network.length / 1e3:.3f} km",
        Column("edge"),
        Column("from"),
        Column("to"),
        Column("length", POSITION),
        Column("rise", HEIGHT),
        Column("fall", HEIGHT),
        Column("limits", SPEED, key="lowest_limit"),
        Column("radius", RADIUS, key="least_radius"),
        name="edges",
    )
    for edge in network.edges:
        rise, fall = climbs(edge.line)
        table.add_cells(
            edge.name,
            edge.start,
            edge.end,
            edge.line.length,
            rise,
            fall,
            _limits(edge.line),
            _least_radius(edge.line),
        )
    return table


def _stations(network: Network) -> WordTable:
    table = new_table(
        "Stations", Column("station"), Column("edge"), Column("at", POSITION), name="stations"
    )
    for edge in network.edges:
        for station in edge.line.stations:
            table.add_cells(station.name, edge.name, station.position)
    return table


def _nodes(network: Network) -> WordTable:
    table = new_table(
        "Nodes", Column("node"), Column("kind"), Column("edges"), Column("turns"), name="nodes"
    )
    for node in network.nodes:
        there = [edge.name for edge in network.edges if node.name in (edge.start, edge.end)]
        turns = network.turns.get(node.name)
        every = "all" if len(there) > 1 else ""
        words = every if turns is None else ", ".join(f"{a} and {b}" for a, b in turns)
        table.add_cells(node.name, node.kind, ", ".join(there), words)
    return table


def _unknown(network: Network) -> list[str]:
    """Sentences on what is assumed, and on edges without coordinates."""
    found = []
    for name, edges in network.assumed.items():
        which = "all edges" if len(edges) == len(network.edges) else _names(edges)
        found.append(f"{name.replace('_', ' ')} assumed {assumed_on(edges)}: {which}")
    drawn = [edge for edge in network.edges if edge.line.geometry is None]
    if drawn:
        found.append(f"without coordinates: {_names(drawn)}")
    return found


def _names(edges: list[Edge]) -> str:
    return ", ".join(edge.name for edge in edges)


def route_tables(route: Route) -> list[WordTable | str]:
    """A route as a person reads it: its legs, its stations, its length and climbs."""
    line = route.line
    table = new_table(
        f"Legs of {route.name}",
        Column("edge"),
        Column("from", POSITION, key="position"),
        Column("length", POSITION),
        Column("on the edge from", POSITION, key="edge_start"),
        Column("to", POSITION, key="edge_end"),
        Column("direction"),
        name="legs",
    )
    for leg in route.legs:
        table.add_cells(
            leg.edge,
            leg.position,
            leg.length,
            leg.edge_start,
            leg.edge_end,
            "along its chainage" if leg.forward else "against it",
        )
    stations = new_table("Stations", Column("station"), Column("at", POSITION), name="stations")
    for station in line.stations:
        stations.add_cells(station.name, station.position)
    rise, fall = climbs(line)
    limits = line.speed_limits.values * KMH
    words = (
        f"{line.length / 1e3:.3f} km over {counted(len(route.legs), 'edge')}, rising {rise:.1f} m"
        f" and falling {fall:.1f} m, limits {span(limits)} km/h"
    )
    assumed = f"assumed on a part of it: {_assumed(line)}" if line.assumed else ""
    return [words, table, stations, *([assumed] if assumed else [])]


def climbs(line: Line) -> tuple[float, float]:
    """How far a line rises and falls altogether [m], both positive.

    Examples
    --------
    >>> from trainlog.formats.line import read_line
    >>> rise, fall = climbs(read_line("sample_logs/CH_StGallen_Wil.line.json"))
    >>> round(rise, 1), round(fall, 1)
    (40.2, 144.5)
    """
    edges = np.append(line.gradients.positions, line.length)
    steps = line.gradients.values * np.diff(edges)
    return float(steps[steps > 0.0].sum()), float(np.abs(steps[steps < 0.0]).sum())


def _limits(line: Line) -> Said:
    """The lowest limit of both directions, shown with the highest."""
    values = np.concatenate([line.speed_limits.values, line.limits_against.values])
    low, high = float(values.min()), float(values.max())
    one = f"{low * KMH:.0f}"
    return Said(low, one if low == high else f"{one} to {high * KMH:.0f}")


def _least_radius(line: Line) -> float:
    if line.curvatures is None:
        return np.nan
    sharpest = float(max(np.abs(line.curvatures.start).max(), np.abs(line.curvatures.end).max()))
    return 1.0 / sharpest if sharpest > 0.0 else np.nan


def _assumed(line: Line) -> str:
    return ", ".join(name.replace("_", " ") for name in line.assumed)

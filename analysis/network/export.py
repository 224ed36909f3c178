"""A network for other programs: GeoJSON."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from analysis.adhesion.export import course_of, point_of, write_features
from trainlog.errors import InputError
from trainlog.railway import Line
from trainlog.railway.network import Edge, Network, Node, climbs
from trainlog.units import KMH
from trainlog.version import __version__


@dataclass(frozen=True)
class Exported:
    """What a file holds of a network.

    Attributes
    ----------
    edges, nodes, stations : int
    left_out : tuple of str
        Edges, nodes and stations without coordinates.
    """

    edges: int
    nodes: int
    stations: int
    left_out: tuple[str, ...]


def export_network(network: Network, path: str | Path) -> Exported:
    """Write a network as GeoJSON (RFC 7946, WGS 84), whole or not at all.

    Edges are lines with their length, climbs, limits and least radius; nodes, and stations inside
    edges, are points. What has no coordinates is left out and listed.

    Raises
    ------
    InputError
        If nothing of the network has coordinates, or the file is not to be GeoJSON.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> nodes = (Node("St. Gallen"), Node("Wil"))
    >>> network = Network("one", nodes, (Edge("only", line, "St. Gallen", "Wil"),))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     export_network(network, Path(folder) / "one.geojson").left_out
    ("node 'St. Gallen'", "node 'Wil'")
    """
    if Path(path).suffix.lower() not in (".geojson", ".json"):
        raise InputError(
            "a network is not exported to files of this kind",
            file=path,
            remedy="end it in .geojson",
        )
    features, left_out = list[dict[str, Any]](), list[str]()
    numbers = {"edge": 0, "node": 0, "station": 0}

    def add(kind: str, name: str, course: Any, properties: dict[str, Any]) -> None:
        if course is None:
            left_out.append(f"{kind} '{name}'")
            return
        numbers[kind] += 1
        shape = {"type": "LineString", "coordinates": course.tolist()}
        if kind != "edge":
            shape = {"type": "Point", "coordinates": course[0].tolist()}
        about = {"kind": kind, "name": name, **properties}
        features.append({"type": "Feature", "geometry": shape, "properties": about})

    for edge in network.edges:
        course = course_of(edge.line, 0.0, edge.line.length)
        add("edge", edge.name, course, _properties(edge))
    for node in network.nodes:
        add("node", node.name, _place(node), {"node_kind": node.kind})
    for edge in network.edges:
        for station in edge.line.stations:
            add(
                "station",
                station.name,
                point_of(edge.line, station.position),
                {"edge": edge.name, "position_m": station.position},
            )
    if not features:
        raise InputError(
            f"nothing of network '{network.name}' has coordinates",
            file=path,
            remedy="add geometry to its lines, such as from fixes with 'trainlog new line --from'",
        )
    about = {
        "network": network.name,
        "source": network.source,
        "software": f"trainlog {__version__}",
    }
    write_features(path, features, about)
    return Exported(numbers["edge"], numbers["node"], numbers["station"], tuple(left_out))


def _properties(edge: Edge) -> dict[str, Any]:
    line: Line = edge.line
    rise, fall = climbs(line)
    bends = line.curvatures
    limits = np.concatenate([line.speed_limits.values, line.limits_against.values])
    sharpest = 0.0 if bends is None else float(max(abs(bends.start).max(), abs(bends.end).max()))
    return {
        "start": edge.start,
        "end": edge.end,
        "length_m": line.length,
        "rise_m": round(rise, 3),
        "fall_m": round(fall, 3),
        "lowest_limit_km_h": round(float(limits.min()) * KMH, 3),
        "highest_limit_km_h": round(float(limits.max()) * KMH, 3),
        "least_radius_m": round(1.0 / sharpest, 3) if sharpest > 0.0 else None,
        "assumed": ", ".join(line.assumed),
        "operators_line": "" if line.reference is None else line.reference.name,
    }


def _place(node: Node) -> Any:
    if node.latitude is None or node.longitude is None:
        return None
    return np.array([[node.longitude, node.latitude]]).round(7)

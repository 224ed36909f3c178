"""What a network is made of: nodes, edges between them, places where trains can be sent."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

from trainlog.declaration import Quantity, Text
from trainlog.railway.line import Line

NodeKind = Literal["station", "junction"]

AT_END = 1.0
"""Stations so near [m] to an end of an edge stand at its node."""


@dataclass(frozen=True, slots=True)
class Node:
    """Where edges meet or end.

    Attributes
    ----------
    name : str
    kind : {"station", "junction"}
        At a station trains stop, and a route may turn back.
    latitude, longitude : float [deg] or None

    Examples
    --------
    >>> Node("Wil", latitude=47.462, longitude=9.041).kind
    'station'
    """

    name: str
    kind: NodeKind = "station"
    latitude: Annotated[float | None, Quantity("deg", "deg")] = None
    longitude: Annotated[float | None, Quantity("deg", "deg")] = None


@dataclass(frozen=True, slots=True)
class Edge:
    """A line between two nodes, with a chainage of its own from `start` to `end`.

    Attributes
    ----------
    name : str
        Also that of its line.
    line : Line
    start, end : str
        Nodes at chainage 0 and at the line's length. Both may be the same: a balloon loop.

    Examples
    --------
    >>> from trainlog.formats.line import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> Edge("850", line, "St. Gallen", "Wil").line.name
    '850'
    """

    ORDER: ClassVar[tuple[str, ...]] = ("name", "start", "end")

    name: Annotated[str, Text(stated="read")]
    line: Line
    start: str
    end: str

    def __post_init__(self) -> None:
        if self.line.name != self.name:
            object.__setattr__(self, "line", replace(self.line, name=self.name))


@dataclass(frozen=True, slots=True)
class Place:
    """Where a train can be sent: a node, or a point of an edge.

    Attributes
    ----------
    node : str
        Its name; empty inside an edge.
    edge : str
    position : float [m]
        On the edge's chainage.
    station : bool
        Whether trains stop, and may turn back.
    """

    node: str = ""
    edge: str = ""
    position: float = 0.0
    station: bool = True

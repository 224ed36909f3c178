"""The edges of a network that a trip ran over; an ordinary line is one edge, itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.adhesion.slip import SlipAnalysis
from trainlog.railway.line import Line

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch of a line that lies on an edge.

    Attributes
    ----------
    first, last : float [m]
        On the line.
    edge_first, edge_last : float [m]
        The same places on the edge's own chainage; it falls where the line runs against it.
    """

    first: float
    last: float
    edge_first: float
    edge_last: float

    def holds(self, position: ArrayLike) -> BoolArray:
        """Which positions [m] of the line lie in it."""
        s = np.asarray(position, dtype=np.float64)
        return np.asarray((s >= self.first) & (s < self.last))

    def on_edge(self, position: ArrayLike) -> FloatArray:
        """Chainage on the edge [m] of positions of the line [m]."""
        sign = -1.0 if self.backwards else 1.0
        s = np.asarray(position, dtype=np.float64)
        return np.asarray(self.edge_first + sign * (s - max(self.first, 0.0)))

    @property
    def backwards(self) -> bool:
        """Whether the line runs against the edge's chainage."""
        return self.edge_last < self.edge_first


@dataclass(frozen=True, slots=True)
class EdgeOfLine:
    """An edge with the stretches of a line that run over it.

    Attributes
    ----------
    name : str
    length : float [m]
        Of the whole edge.
    stretches : tuple of Stretch
    whole : bool
        Whether the edge is the line itself.
    """

    name: str
    length: float
    stretches: tuple[Stretch, ...]
    whole: bool = False


def edges_of(line: Line, *, backwards: bool = False) -> tuple[EdgeOfLine, ...]:
    """The edges that a line runs over, in the order in which it reaches them.

    Parameters
    ----------
    line : Line
    backwards : bool
        Whether an ordinary line is given reversed, as a trip against its chainage travels it.

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> [(edge.name, edge.length) for edge in edges_of(line)]
    [('CH_StGallen_Wil', 29500.0)]
    """
    legs: tuple[Any, ...] = getattr(line, "legs", ())
    if not legs:
        ends = (line.length, 0.0) if backwards else (0.0, line.length)
        whole = Stretch(-np.inf, np.inf, *ends)
        return (EdgeOfLine(line.name, line.length, (whole,), whole=True),)
    found: dict[str, EdgeOfLine] = {}
    for number, leg in enumerate(legs):
        # The end of the line belongs to its last leg.
        end = np.inf if number == len(legs) - 1 else leg.position + leg.length
        stretch = Stretch(leg.position, end, leg.edge_start, leg.edge_end)
        before = found.get(leg.edge)
        known = () if before is None else before.stretches
        found[leg.edge] = EdgeOfLine(leg.edge, leg.edge_length, (*known, stretch))
    return tuple(found.values())


def on_edge(analysis: SlipAnalysis, edge: EdgeOfLine) -> SlipAnalysis:
    """What a slip analysis shows on an edge: its samples and events there, by the edge's chainage.

    Parameters
    ----------
    analysis : SlipAnalysis
        With positions on the line in its own direction.
    edge : EdgeOfLine
        Of that line.
    """
    if edge.whole:
        return analysis
    position, rows = _moved(analysis.position, edge)
    places, kept = _moved(analysis.events["position"].to_numpy(np.float64), edge)
    names = ("speed", "speed_std", "slip_speed", "adhesion", "adhesion_std", "slipping", "time")
    return replace(
        analysis,
        trip=f"{analysis.trip}@{edge.name}",
        position=position[rows],
        events=analysis.events.assign(position=places)[kept],
        **{name: getattr(analysis, name)[rows] for name in names},
    )


def _moved(position: FloatArray, edge: EdgeOfLine) -> tuple[FloatArray, BoolArray]:
    """Chainage on the edge, and which of the positions lie on it."""
    found, there = np.full(position.size, np.nan), np.zeros(position.size, dtype=np.bool_)
    for stretch in edge.stretches:
        inside = stretch.holds(position)
        found[inside] = stretch.on_edge(position[inside])
        there |= inside
    return found, there

"""The shortest way of a train through places of a network, over the turns that it allows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from networkx import DiGraph

Stretch = tuple[str, float, float]
"""Of an edge, by its name, from one chainage [m] to another."""

Point = tuple[str, str, float]
"""A node by its name, or of an edge, by its name, a chainage [m]."""

_State = tuple[int, str, int, int]
"""Towards which place, over which edge, which piece of it, in which direction (1 or -1)."""


class EdgeEnds(NamedTuple):
    """The nodes at which an edge begins and ends, and its length [m]."""

    start: str
    end: str
    length: float


class RouteSearch:
    """The shortest way through places, as a graph of pieces of edges that are travelled.

    Edges are cut where places lie inside them; the graph has each piece once for each direction
    and for each place that the train is on its way to.

    Parameters
    ----------
    edges : dict of str to EdgeEnds
    turns : dict of str to sequence of (str, str)
        By node, pairs of edges between which trains pass; see `trainlog.railway.network.Network`.
    stages : sequence of dict
        Of each place in the order of travel: its points, and whether trains turn back there.

    Examples
    --------
    >>> edges = {"a": EdgeEnds("X", "Y", 800.0), "b": EdgeEnds("Y", "Z", 500.0)}
    >>> stages = [{("Z", "", 0.0): True}, {("", "a", 300.0): True}]
    >>> RouteSearch(edges, {}, stages).stretches()
    [('b', 500.0, 0.0), ('a', 800.0, 300.0)]
    """

    def __init__(
        self,
        edges: Mapping[str, EdgeEnds],
        turns: Mapping[str, Sequence[tuple[str, str]]],
        stages: Sequence[Mapping[Point, bool]],
    ) -> None:
        self.edges, self.turns, self.stages = edges, turns, stages
        cuts = {name: [0.0, edge.length] for name, edge in edges.items()}
        for _, name, position in {point for stage in stages for point in stage if not point[0]}:
            cuts[name].append(position)
        self.cuts = {name: sorted(set(found)) for name, found in cuts.items()}
        self.departures: dict[str, list[tuple[str, int, int]]] = {}
        for name, edge in edges.items():
            last = len(self.cuts[name]) - 2
            self.departures.setdefault(edge.start, []).append((name, 0, 1))
            self.departures.setdefault(edge.end, []).append((name, last, -1))

    def stretches(self) -> list[Stretch] | int:
        """Stretches of edges of the shortest way, or the place behind which there is none."""
        import networkx

        graph = self._graph()
        try:
            states = networkx.dijkstra_path(graph, "start", "end")[1:-1]
        except (networkx.NetworkXNoPath, networkx.NodeNotFound):
            reached = networkx.descendants(graph, "start") if "start" in graph else set()
            return max((state[0] for state in reached if isinstance(state, tuple)), default=0)
        return self._joined(states)

    def _graph(self) -> DiGraph[Any]:
        import networkx

        graph: DiGraph[Any] = networkx.DiGraph()
        last = len(self.stages) - 1
        for key in self.stages[0]:
            for first in self._departing(key):
                graph.add_edge("start", (0, *first), weight=0.0)
        for layer in range(last):
            for name, cuts in self.cuts.items():
                for piece in range(len(cuts) - 1):
                    length = cuts[piece + 1] - cuts[piece]
                    for way in (1, -1):
                        state = (layer, name, piece, way)
                        for following in self._following(state, last):
                            graph.add_edge(state, following, weight=length)
        return graph

    def _following(self, state: _State, last: int) -> Iterator[_State | str]:
        """States that can follow one."""
        layer, name, piece, way = state
        key = self._end(name, piece, way)
        onward = list(self._onward(name, piece, way, key))
        yield from ((layer, *each) for each in onward)
        station = self.stages[layer + 1].get(key)
        if station is None:
            return
        if layer + 1 == last:
            yield "end"
            return
        for each in self._departing(key) if station else onward:
            yield (layer + 1, *each)

    def _end(self, name: str, piece: int, way: int) -> Point:
        """The place at which a piece ends."""
        at = piece + (way > 0)
        edge = self.edges[name]
        if at == 0:
            return edge.start, "", 0.0
        if at == len(self.cuts[name]) - 1:
            return edge.end, "", 0.0
        return "", name, self.cuts[name][at]

    def _departing(self, key: Point) -> list[tuple[str, int, int]]:
        """Pieces over which a train can leave a place, whichever way it came."""
        node, name, position = key
        if node:
            return self.departures.get(node, [])
        at = self.cuts[name].index(position)
        return [(name, at, 1), (name, at - 1, -1)]

    def _onward(
        self, name: str, piece: int, way: int, key: Point
    ) -> Iterator[tuple[str, int, int]]:
        """Pieces onto which a train passes without turning back."""
        node = key[0]
        if not node:
            yield name, piece + way, way
            return
        allowed = self.turns.get(node)
        for other in self.departures.get(node, []):
            if other == (name, piece, -way):
                continue
            pair = (name, other[0])
            if allowed is None or pair in allowed or pair[::-1] in allowed:
                yield other

    def _joined(self, states: Sequence[_State]) -> list[Stretch]:
        """Stretches of pieces; those that continue each other are one."""
        stretches: list[Stretch] = []
        for _, name, piece, way in states:
            ends = self.cuts[name][piece : piece + 2][::way]
            if stretches and stretches[-1][0] == name and _continues(stretches[-1], ends):
                stretches[-1] = (name, stretches[-1][1], ends[1])
            else:
                stretches.append((name, ends[0], ends[1]))
        return stretches


def _continues(before: Stretch, ends: Sequence[float]) -> bool:
    """Whether a piece goes on where the one before ends, in the same direction."""
    return before[2] == ends[0] and (before[2] > before[1]) == (ends[1] > ends[0])

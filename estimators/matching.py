"""Which route fixes took through a graph of edges: the best chain of the places they may mean.

Viterbi's algorithm over the candidates of each fix on the edges. A train passes from edge to edge
where a turn is permitted, and turns round where it stood. Fixes that fit no chain are left out, and
a train that was away from all edges may come back elsewhere. A line is a graph of one edge.

References
----------
Newson, P., Krumm, J. (2009), Hidden Markov map matching through noise and sparseness, ACM GIS:
the distance along the road against that between the fixes, where no speed was measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from trainlog.arrays import BoolArray, FloatArray, IntArray

REWARD = 2.5
"""What a fix in the chain is worth, in units of log-likelihood: 2.2 standard deviations."""

LOOK_BACK = 100
"""Fixes that may be left out between two of the chain."""

FASTEST = 110.0
"""No train is faster than this [m/s]: fixes that are do not belong to one train."""

TURN_SHARE, IDLE_SPEED = 0.3, 2.0
"""Without a speed the distance driven is that between the fixes with a standard deviation of this
share of it, and of this [m/s] for a train that went and came or hardly moved."""

STEP_PENALTY, STEP_LENGTH = 8.0, 50.0
"""What a link forward costs at most, in the unit of `REWARD`: the first and, for every so many
metres by which it departs from the distance driven, 1 more. Speeds may be wrong and receivers
step; fixes in a row that go with each other outweigh that."""

REVERSAL, ABSENCE = 8.0, 15.0
"""What it costs, in the unit of `REWARD`, to turn round where the train stood, and to come back
elsewhere after an absence from all edges."""

AWAY = 3
"""Fixes without a candidate, one after the other but for chance, that show an absence."""

LONGEST_LINK = 600.0
"""Time [s] without fixes after which a train may be anywhere, too."""

ALONG, REVERSED, ABSENT = 0, 1, 2
"""How a fix of the chain is reached from the one before it."""


class EdgeGraph(NamedTuple):
    """Edges by number, and where a train passes from one to another.

    Each edge `e` is travelled two ways: as course ``2 e`` along its chainage, as course ``2 e + 1``
    against it.

    Attributes
    ----------
    lengths : (e,) array [m]
    turns : (k, 2) int array
        Courses of which the second may follow the first.
    """

    lengths: FloatArray
    turns: IntArray


class Between(NamedTuple):
    """Shortest distances between courses.

    Attributes
    ----------
    row : (2 e,) int array
        Row of each course in `distance`; -1 for courses from which none was asked for.
    distance : (r, 2 e) array [m]
        From the end of a course to the beginning of another; infinite where no turns lead there.
    previous : (r, 2 e) int array
        The course before, on the shortest path; negative at its beginning.
    """

    row: IntArray
    distance: FloatArray
    previous: IntArray

    def path(self, first: int, last: int) -> list[int]:
        """The courses between two, both left out."""
        found, row = list[int](), int(self.row[first])
        at = int(self.previous[row, last])
        while at >= 0:
            found.append(at)
            at = int(self.previous[row, at])
        return found[::-1]


def distances(graph: EdgeGraph, edges: IntArray, without: int = -1) -> Between:
    """Distances from both courses of the given edges to all courses, one course left out.

    Examples
    --------
    A junction: edge 0 leads to edges 1 and 2, of 100 m each; edge 3 begins where 2 ends.

    >>> import numpy as np
    >>> turns = np.array([[0, 2], [0, 4], [4, 6], [3, 1], [5, 1], [7, 5]])
    >>> graph = EdgeGraph(np.full(4, 100.0), turns)
    >>> between = distances(graph, np.arange(4))
    >>> between.distance[0, [2, 4, 6]].round(3), between.path(0, 6)
    (array([  0.,   0., 100.]), [4])
    """
    count = 2 * graph.lengths.size
    turns = graph.turns[(graph.turns != without).all(axis=1)]
    # From a node of each course's own, at its end, its successors are at no distance.
    starts = np.concatenate((turns[:, 0], count + turns[:, 0]))
    ends = np.concatenate((turns[:, 1], turns[:, 1]))
    weights = np.concatenate((graph.lengths[turns[:, 0] // 2], np.full(len(turns), 1e-9)))
    matrix = csr_matrix((weights, (starts, ends)), shape=(2 * count, 2 * count))
    courses = np.concatenate((2 * edges, 2 * edges + 1))
    found, before = dijkstra(matrix, indices=count + courses, return_predecessors=True)
    row = np.full(count, -1, dtype=np.int64)
    row[courses] = np.arange(courses.size)
    before = np.where(before >= count, -1, before).astype(np.int64)
    return Between(row, np.ascontiguousarray(found[:, :count]), before[:, :count])


class EdgeNodes(NamedTuple):
    """Fixes that may be in the chain, and their candidates on the edges.

    Attributes
    ----------
    seconds : (n,) array [s]
    east, north : (n,) arrays [m]
    std : (n,) array [m]
    driven, driven_variance : (n,) arrays [m], [m²]
        Distance driven since the first, NaN throughout where no speed is known; its variance,
        growing.
    stood : (n,) bool array
        Whether the train may have stood between the fix before and this one.
    first : (n + 1,) int array
        Number of the first candidate of each fix.
    edge : (m,) int array
    chainage, distance : (m,) arrays [m]
        Of the candidates on their edges, and how far from the fix.
    """

    seconds: FloatArray
    east: FloatArray
    north: FloatArray
    std: FloatArray
    driven: FloatArray
    driven_variance: FloatArray
    stood: BoolArray
    first: IntArray
    edge: IntArray
    chainage: FloatArray
    distance: FloatArray

    def between(self, first: int, last: int) -> EdgeNodes:
        """The fixes from one to before another."""
        low, high = int(self.first[first]), int(self.first[last])
        of_fix = ("seconds", "east", "north", "std", "driven", "driven_variance", "stood")
        return EdgeNodes(
            **{name: getattr(self, name)[first:last] for name in of_fix},
            first=self.first[first : last + 1] - low,
            **{name: getattr(self, name)[low:high] for name in ("edge", "chainage", "distance")},
        )


@dataclass(frozen=True, eq=False)
class Chain:
    """The chosen candidates in order of time.

    Attributes
    ----------
    worth : float
        What the chain is worth in units of log-likelihood.
    node, candidate, course : (k,) int arrays
    link : (k,) int array
        `ALONG`, `REVERSED` or `ABSENT`, from the one before.
    without : bool array (k,)
        Whether the way from the one before does without the course that was left out.
    """

    worth: float
    node: IntArray
    candidate: IntArray
    course: IntArray
    link: IntArray
    without: BoolArray


class LeftOut(NamedTuple):
    """A course that a chain may not use between two times [s], both included."""

    course: int
    begin: float
    end: float
    between: Between


def best_chain(
    graph: EdgeGraph,
    nodes: EdgeNodes,
    between: Between,
    left_out: LeftOut | None = None,
    *,
    absence: float = ABSENCE,
    reward: float = REWARD,
) -> Chain:
    """The chain of candidates that fits best, and what it is worth.

    Each fix in the chain is worth `reward`, less half its squared distance from the edge and half
    the squared difference between chainage gained and distance driven, both over their variances;
    passing junctions costs nothing. Fixes left out are worth nothing.

    Parameters
    ----------
    graph : EdgeGraph
    nodes : EdgeNodes
    between : Between
        Of the edges that have candidates.
    left_out : LeftOut, optional
    absence : float
        What an absence costs; infinite where none is possible.
    reward : float
        What a fix in the chain is worth.

    Examples
    --------
    A train passes from edge 0 to edge 2; the fix behind the junction is as near to edge 1.

    >>> import numpy as np
    >>> turns = np.array([[0, 2], [0, 4], [3, 1], [5, 1]])
    >>> graph = EdgeGraph(np.full(3, 100.0), turns)
    >>> x = np.array([20.0, 60.0, 110.0, 160.0])
    >>> nodes = EdgeNodes(
    ...     seconds=np.arange(4.0), east=x, north=np.zeros(4), std=np.full(4, 3.0), driven=x,
    ...     driven_variance=np.arange(4.0), stood=np.zeros(4, dtype=bool),
    ...     first=np.array([0, 1, 2, 4, 6]), edge=np.array([0, 0, 1, 2, 1, 2]),
    ...     chainage=np.array([20.0, 60.0, 10.0, 10.0, 60.0, 60.0]),
    ...     distance=np.array([0.0, 0.0, 1.0, 1.0, 9.0, 1.0]),
    ... )
    >>> chain = best_chain(graph, nodes, distances(graph, np.arange(3)))
    >>> chain.course
    array([0, 0, 4, 4])
    """
    n, other = nodes, left_out or LeftOut(-1, np.inf, -np.inf, between)
    worth, before, link = _viterbi(graph.lengths, n, between, other, absence, reward)
    owner = np.repeat(np.arange(n.seconds.size), np.diff(n.first))
    states = list[int]()
    at = int(np.argmax(worth)) if worth.size else -1
    best = float(worth[at]) if worth.size else 0.0
    while at >= 0:
        states.append(at)
        at = int(before[at])
    state = np.array(states[::-1], dtype=np.int64)
    candidate = state // 2
    node = owner[candidate]
    previous = np.concatenate((node[:1], node[:-1]))
    overlaps = (n.seconds[node] >= other.begin) & (n.seconds[previous] <= other.end)
    return Chain(
        best, node, candidate, 2 * n.edge[candidate] + state % 2, link[state], overlaps
    )  # fmt: skip


@njit(cache=True)  # type: ignore[untyped-decorator]
def _viterbi(
    lengths: FloatArray,
    nodes: EdgeNodes,
    between: Between,
    other: LeftOut,
    absence: float,
    reward: float,
) -> tuple[FloatArray, IntArray, IntArray]:
    seconds, east, north, std, driven, driven_variance, stands, first, edge, chainage, distance = (
        nodes
    )
    row, ahead, _ = between
    left_out, begin, end, (other_row, other_ahead, _) = other
    stood = np.cumsum(stands.astype(np.int64))
    away = np.cumsum((np.diff(first) == 0).astype(np.int64))
    worth = np.full(2 * chainage.size, -np.inf)
    before = np.full(2 * chainage.size, -1, dtype=np.int64)
    link = np.zeros(2 * chainage.size, dtype=np.int64)
    for i in range(seconds.size):
        for c in range(first[i], first[i + 1]):
            own = reward - 0.5 * (distance[c] / std[i]) ** 2
            for way in range(2):
                if 2 * edge[c] + way != left_out or not begin <= seconds[i] <= end:
                    worth[2 * c + way] = own
        seen = 0
        for j in range(i - 1, -1, -1):
            if first[j + 1] == first[j]:
                continue
            seen += 1
            if seen > LOOK_BACK:
                break
            elapsed = seconds[i] - seconds[j]
            noise = std[i] ** 2 + std[j] ** 2
            variance = noise
            if np.isnan(driven[i]):
                step = np.hypot(east[i] - east[j], north[i] - north[j])
                variance += (TURN_SHARE * step) ** 2 + (IDLE_SPEED * elapsed) ** 2
            else:
                step = driven[i] - driven[j]
                variance += driven_variance[i] - driven_variance[j]
            behind = -3.0 * np.sqrt(noise)
            most = FASTEST * elapsed + 4.0 * np.sqrt(variance)
            may_turn = stood[i] > stood[j]
            absent = away[i] - away[j] >= AWAY or elapsed > LONGEST_LINK
            without = seconds[i] >= begin and seconds[j] <= end
            for c in range(first[i], first[i + 1]):
                e = edge[c]
                own = reward - 0.5 * (distance[c] / std[i]) ** 2
                for d in range(first[j], first[j + 1]):
                    f = edge[d]
                    for way in range(2):
                        to = 2 * c + way
                        if 2 * e + way == left_out and begin <= seconds[i] <= end:
                            continue
                        for was in range(2):
                            source = worth[2 * d + was]
                            if own + source <= worth[to]:
                                continue
                            kind = 0
                            gained = np.inf
                            turned = 0.0
                            if e == f and not (without and 2 * e + way == left_out):
                                along = chainage[c] - chainage[d]
                                if way == 1:
                                    along = -along
                                if way == was:
                                    if along > behind:
                                        gained = along
                                elif may_turn:
                                    kind = 1
                                    turned = REVERSAL
                                    # Where it turned round is not known: it drove at least this.
                                    gained = max(abs(along), step)
                            if gained == np.inf:
                                rest = chainage[d] if was == 1 else lengths[f] - chainage[d]
                                begun = lengths[e] - chainage[c] if way == 1 else chainage[c]
                                if without:
                                    gap = other_ahead[other_row[2 * f + was], 2 * e + way]
                                else:
                                    gap = ahead[row[2 * f + was], 2 * e + way]
                                gained = rest + gap + begun
                            if gained <= most:
                                penalty = 0.5 * (gained - step) ** 2 / variance
                                if gained > behind:
                                    cap = STEP_PENALTY + np.abs(gained - step) / STEP_LENGTH
                                    penalty = min(penalty, cap)
                                penalty += turned
                            elif absent:
                                kind = 2
                                penalty = absence
                            else:
                                continue
                            if absent and penalty > absence:
                                kind = 2
                                penalty = absence
                            value = own + source - penalty
                            if value > worth[to]:
                                worth[to] = value
                                before[to] = 2 * d + was
                                link[to] = kind
    return worth, before, link

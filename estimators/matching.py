"""Which way a train took among the places its fixes may mean: the best chain of candidates.

Viterbi's algorithm over the candidates of each fix, with the fixes that fit no chain left out.

References
----------
Newson, P., Krumm, J. (2009), Hidden Markov map matching through noise and sparseness, ACM GIS:
the distance along the road against that between the fixes, where no speed was measured.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit

from trainlog.arrays import FloatArray, IntArray

REWARD = 2.5
"""What a fix in the chain is worth, in units of log-likelihood: 2.2 standard deviations."""

LOOK_BACK = 100
"""Fixes that may be left out between two of the chain."""

FASTEST = 100.0
"""No train gains more chainage than this [m/s]."""

TURN_SHARE, IDLE_SPEED = 0.3, 2.0
"""Without a speed the distance driven is that between the fixes with a standard deviation of this
share of it, and of this [m/s] for a train that went and came or hardly moved."""


STEP_PENALTY, STEP_LENGTH = 8.0, 50.0
"""What a link forward costs at most, in the unit of `REWARD`: the first and, for every so many
metres by which it departs from the distance driven, 1 more. Speeds may be wrong and receivers
step; fixes in a row that go with each other outweigh that."""


OFF_PENALTY, OFF_REWARD = 8.0, 1.1
"""What it costs that a receiver holds, replays or reflects its fixes for a while, and what each fix
of it is worth: they go with each other, if not with the train, nearly as well as others do, which
are worth 1.5 in the mean."""

SURE_WAY = 200.0
"""Standard deviation of a distance driven [m] beyond which it shows nothing of a receiver."""

DELAY = 2.0
"""Standard deviation of the delay of a speed [s], before it is known."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """Fixes that may be in the chain, and their candidates.

    Attributes
    ----------
    seconds : (n,) array [s]
    east, north : (n,) arrays [m]
    std : (n,) array [m]
    driven : (n,) array [m]
        Distance driven since the first; NaN throughout where no speed is known.
    driven_variance : (n,) array [m²]
        Of `driven`, growing.
    pace : (n,) array [m/s]
        The speed; NaN where none is known.
    first : (n + 1,) int array
        Number of the first candidate of each fix.
    chainage, distance : (m,) arrays [m]
        Of the candidates, and how far from the fix.
    """

    seconds: FloatArray
    east: FloatArray
    north: FloatArray
    std: FloatArray
    driven: FloatArray
    driven_variance: FloatArray
    pace: FloatArray
    first: IntArray
    chainage: FloatArray
    distance: FloatArray


def best_chain(nodes: Nodes, way: float) -> tuple[float, IntArray]:
    """The chain of candidates that fits best, and what it is worth.

    Each fix in the chain is worth `REWARD`, less half its squared distance from the line and half
    the squared difference between chainage gained and distance driven, both over their variances.
    Fixes left out are worth nothing, or, where many follow each other, as much as others less what
    it costs that a receiver is off for a while.

    Parameters
    ----------
    nodes : Nodes
    way : float
        1.0 where chainage grows in the direction of travel, -1.0 where it falls.

    Returns
    -------
    worth : float
    chosen : (n,) int array
        Number of the candidate of each fix, -1 for fixes left out.

    Examples
    --------
    Three fixes 20 m apart; the second may lie on a track that comes close 5 km ahead:

    >>> import numpy as np
    >>> nodes = Nodes(
    ...     seconds=np.array([0.0, 1.0, 2.0]), east=np.array([0.0, 20.0, 40.0]), north=np.zeros(3),
    ...     std=np.full(3, 3.0), driven=np.array([0.0, 20.0, 40.0]), driven_variance=np.zeros(3),
    ...     pace=np.full(3, 20.0),
    ...     first=np.array([0, 1, 3, 4]), chainage=np.array([100.0, 5_120.0, 120.0, 140.0]),
    ...     distance=np.array([1.0, 0.5, 1.0, 1.0]),
    ... )
    >>> best_chain(nodes, way=1.0)[1]
    array([0, 2, 3])
    """
    n = nodes
    worth, before = _viterbi(
        n.seconds, n.east, n.north, n.std, n.driven, n.driven_variance, n.pace,
        n.first, n.chainage, n.distance, way,
    )  # fmt: skip
    chosen = np.full(n.seconds.size, -1, dtype=np.int64)
    if not worth.size:
        return 0.0, chosen
    at = int(np.argmax(worth))
    best = float(worth[at])
    owner = np.repeat(np.arange(n.seconds.size), np.diff(n.first))
    while at >= 0:
        chosen[owner[at]] = at
        at = int(before[at])
    return best, chosen


def off_between(nodes: Nodes, chosen: IntArray) -> Iterator[tuple[int, int]]:
    """Pairs of fixes of a chain, forward, between which the receiver was off.

    It was where so many fixes are left out that this is likelier than their being wrong one by one,
    and distance and speed agree from the one before to the one after.
    """
    if np.isnan(nodes.driven).any():
        return
    inside = np.flatnonzero(chosen >= 0)
    eligible = np.cumsum(np.diff(nodes.first) > 0)
    for before, after in pairwise(inside.tolist()):
        left_out = int(eligible[after] - eligible[before]) - 1
        if left_out * OFF_REWARD <= OFF_PENALTY:
            continue
        gained = nodes.chainage[chosen[after]] - nodes.chainage[chosen[before]]
        apart = gained - (nodes.driven[after] - nodes.driven[before])
        variance = nodes.std[before] ** 2 + nodes.std[after] ** 2
        variance += nodes.driven_variance[after] - nodes.driven_variance[before]
        variance += (DELAY * (nodes.pace[after] - nodes.pace[before])) ** 2
        if variance < SURE_WAY**2 and 0.5 * apart**2 < (OFF_PENALTY + REWARD) * variance:
            yield before, after


@njit(cache=True)  # type: ignore[untyped-decorator]
def _viterbi(
    seconds: FloatArray,
    east: FloatArray,
    north: FloatArray,
    std: FloatArray,
    driven: FloatArray,
    driven_variance: FloatArray,
    pace: FloatArray,
    first: IntArray,
    chainage: FloatArray,
    distance: FloatArray,
    way: float,
) -> tuple[FloatArray, IntArray]:
    worth = np.zeros(chainage.size)
    before = np.full(chainage.size, -1, dtype=np.int64)
    for i in range(seconds.size):
        for c in range(first[i], first[i + 1]):
            own = REWARD - 0.5 * (distance[c] / std[i]) ** 2
            best = 0.0
            seen = 0
            for j in range(i - 1, -1, -1):
                if first[j + 1] == first[j]:
                    continue
                seen += 1
                if seen > LOOK_BACK:
                    break
                elapsed = seconds[i] - seconds[j]
                variance = std[i] ** 2 + std[j] ** 2
                left_out = 0.0
                if np.isnan(driven[i]):
                    step = np.hypot(east[i] - east[j], north[i] - north[j])
                    variance += (TURN_SHARE * step) ** 2 + (IDLE_SPEED * elapsed) ** 2
                else:
                    step = driven[i] - driven[j]
                    variance += driven_variance[i] - driven_variance[j]
                    variance += (DELAY * (pace[i] - pace[j])) ** 2
                    if variance < SURE_WAY**2:
                        left_out = max((seen - 1) * OFF_REWARD - OFF_PENALTY, 0.0)
                for d in range(first[j], first[j + 1]):
                    gained = way * (chainage[c] - chainage[d])
                    if gained > FASTEST * elapsed + 4.0 * np.sqrt(variance):
                        continue
                    # A receiver is off for a while only if fixes and speed agree across it.
                    penalty = 0.5 * (gained - step) ** 2 / variance - left_out
                    if gained > -3.0 * np.sqrt(std[i] ** 2 + std[j] ** 2):
                        most = STEP_PENALTY + np.abs(gained - step) / STEP_LENGTH
                        penalty = min(penalty, most)
                    value = worth[d] - penalty
                    if value > best:
                        best = value
                        before[c] = d
            worth[c] = own + best
    return worth, before

"""The grid of a trajectory: fine where the speed changes, through every breakpoint of the line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_SPEED_SHARE = 0.65
"""Share of the cells that goes where the speed changes."""

BRAKING_WEIGHT, REGAINING_WEIGHT = 0.25, 1.3
"""Cells for a loss of speed over those for a gain: constant braking effort is exact in any cell,
but wastes power of a dynamic brake that feeds back. Chosen with `_SPEED_SHARE` for the least gap on
five lines."""


def graded_mesh(
    breakpoints: FloatArray,
    positions: FloatArray,
    speeds: FloatArray,
    cells: int,
    braking_weight: float = BRAKING_WEIGHT,
) -> FloatArray:
    """Positions of the nodes: some cells even in position, more even in the change of speed.

    Near a standstill cells of equal speed change are short (below 1 m at the start): without them
    the time of the first metres is wrong.

    Parameters
    ----------
    breakpoints : (m,) array [m]
        Nodes that there must be, from the start to the end.
    positions, speeds : (k,) array [m], [m/s]
        The speed envelope.
    cells : int
        How many cells there should be; if the breakpoints alone make nearly as many, a quarter
        of it on top of theirs.
    braking_weight : float
        Cells for a loss of speed over those for a gain.

    Returns
    -------
    (n + 1,) array [m]
    """
    change = np.diff(speeds)
    change = np.where(change > 0.0, change, -braking_weight * change)
    even = np.diff(positions) / (positions[-1] - positions[0])
    share = even
    if change.sum() > 0.0:
        share = (1.0 - _SPEED_SHARE) * even + _SPEED_SHARE * change / change.sum()
    mass = np.concatenate(([0.0], np.cumsum(share)))
    at = np.interp(breakpoints, positions, mass)
    counts = _allot(np.diff(at), max(cells, breakpoints.size - 1 + cells // 4))
    # Inside an interval the nodes are even in the mass, so the cells grow with the speed.
    inner = [
        np.interp(np.linspace(low, high, count + 1)[1:-1], mass, positions)
        for low, high, count in zip(at[:-1], at[1:], counts, strict=True)
        if count > 1
    ]
    return np.unique(np.concatenate((breakpoints, *inner)))


def _allot(mass: FloatArray, cells: int) -> NDArray[np.int64]:
    """Cells for each interval: proportional to its mass, at least one, `cells` in all."""
    low, high = 0.0, 4.0 * cells / max(float(mass.sum()), 1e-12)
    for _ in range(60):
        middle = 0.5 * (low + high)
        if np.maximum(np.ceil(middle * mass), 1.0).sum() > cells:
            high = middle
        else:
            low = middle
    return np.maximum(np.ceil(low * mass), 1.0).astype(np.int64)

"""The train's motion through a cell of constant effort, compiled.

``z = v²/2`` follows ``dz/ds = effort - drag0 - drag1 v - drag2 v²``, all over the configuration's
inertia. Runge-Kutta of order four in a few sub-steps; ``drag0`` is given at their ends and linear
between them, as curvature is. The time of a sub-step is that of constant
acceleration, ``2 ds / (v + v')``, which stays finite from standstill and to standstill, once over
the whole and once over its halves, extrapolated to order four.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SUBSTEPS = 4
"""Runge-Kutta sub-steps a cell; the audit takes many more."""

_FEWEST_ROWS = 16
"""Configurations for which a second thread pays."""


def in_parts(rows: int, work: Callable[[slice], tuple[FloatArray, ...]]) -> tuple[FloatArray, ...]:
    """What `work` makes of all configurations, done in parts on every core.

    Parameters
    ----------
    rows : int
        Number of configurations.
    work : callable
        From some configurations to arrays whose first axis counts them; must leave Python's lock
        to the others while it computes.
    """
    threads = min(os.cpu_count() or 1, rows // _FEWEST_ROWS)
    if threads < 2:
        return work(slice(0, rows))
    edges = np.linspace(0, rows, threads + 1).astype(int).tolist()
    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(work, (slice(*pair) for pair in pairwise(edges))))
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))


@njit(cache=True)  # type: ignore[untyped-decorator]
def speed_of(z: float) -> float:
    """Speed [m/s] of ``z = v²/2``; 0 below 0, where a train has stopped."""
    return float(np.sqrt(2.0 * z)) if z > 0.0 else 0.0


@njit(cache=True)  # type: ignore[untyped-decorator]
def _slope(z: float, net: float, drag1: float, drag2: float) -> float:
    return float(net - drag1 * speed_of(z) - 2.0 * drag2 * z)


@njit(cache=True)  # type: ignore[untyped-decorator]
def advance(
    z: float, effort: float, drag0: FloatArray, drag1: float, drag2: float, step: float
) -> tuple[float, float]:
    """``z`` at the end of a cell and the time spent in it [s]; infinite if the train stops."""
    h = step / SUBSTEPS
    time = 0.0
    for j in range(SUBSTEPS):
        first, last = effort - drag0[j], effort - drag0[j + 1]
        mean = 0.5 * (first + last)
        k1 = _slope(z, first, drag1, drag2)
        k2 = _slope(z + 0.5 * h * k1, mean, drag1, drag2)
        k3 = _slope(z + 0.5 * h * k2, mean, drag1, drag2)
        k4 = _slope(z + h * k3, last, drag1, drag2)
        following = z + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        middle = 0.5 * (z + following) + 0.125 * h * (k1 - _slope(following, last, drag1, drag2))
        v, v_middle, v_following = speed_of(z), speed_of(middle), speed_of(following)
        if v + v_following <= 0.0:
            return following, np.inf
        whole = 2.0 * h / (v + v_following)
        halves = h / (v + v_middle) + h / (v_middle + v_following) if v_middle > 0.0 else whole
        time += (4.0 * halves - whole) / 3.0
        z = following
    return z, time


@njit(cache=True)  # type: ignore[untyped-decorator]
def landing(
    z: float, target: float, drag0: FloatArray, drag1: float, drag2: float, step: float
) -> float:
    """The effort that brings the train from ``z`` to ``target`` over a cell."""
    mean = 0.5 * (speed_of(z) + speed_of(target))
    effort = (
        (target - z) / step + 0.5 * (drag0[0] + drag0[-1]) + drag1 * mean + drag2 * (z + target)
    )
    for _ in range(4):
        reached, _ = advance(z, effort, drag0, drag1, drag2, step)
        effort += (target - reached) / step
    return float(effort)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def traverse(
    z: FloatArray,
    effort: FloatArray,
    drag0: FloatArray,
    drag1: FloatArray,
    drag2: FloatArray,
    step: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Each cell on its own, from its first node: where it ends and how long it takes.

    Parameters
    ----------
    z : (q, n + 1) array
    effort, drag2 : (q, n) array
    drag0 : (q, n, SUBSTEPS + 1) array
    drag1 : (q,) array
    step : (n,) array

    Returns
    -------
    end, time : (q, n) array
    """
    end, time = np.empty_like(effort), np.empty_like(effort)
    for a in range(effort.shape[0]):
        for k in range(effort.shape[1]):
            end[a, k], time[a, k] = advance(
                z[a, k], effort[a, k], drag0[a, k], drag1[a], drag2[a, k], step[k]
            )
    return end, time


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def brake_backwards(
    ceiling: FloatArray, final: float, traction: FloatArray, gain: FloatArray,
    braking: FloatArray, friction: FloatArray, dynamic: FloatArray, dynamic_power: float,
    drag0: FloatArray, drag1: FloatArray, drag2: FloatArray, step: FloatArray,
) -> FloatArray:  # fmt: skip
    """Full braking backwards from the end, below every ceiling: the highest ``z`` at each node.

    The common `traction` is braked against. The brake's power counts at the higher speed, that of
    the cell's first node.
    """
    q, n = drag2.shape
    curve = np.empty((q, n + 1))
    for a in range(q):
        curve[a, n] = min(final, ceiling[a, n])
        for k in range(n - 1, -1, -1):
            z, effort = curve[a, k + 1], -1.0
            for _ in range(6):
                by_power = dynamic_power / max(speed_of(z), 1e-6)
                limit = min(braking[a, k], friction[a, k] + min(dynamic[a, k], by_power))
                if limit == effort:
                    break
                # Motion backwards along the line: the same equation with the sign of ds turned.
                effort = limit
                net = gain[a] * (effort - traction[k])
                z = _back(curve[a, k + 1], net, drag0[a, k], drag1[a], drag2[a, k], step[k])
            curve[a, k] = max(min(z, ceiling[a, k]), 0.0)
    return curve


@njit(cache=True)  # type: ignore[untyped-decorator]
def _back(
    z: float, effort: float, drag0: FloatArray, drag1: float, drag2: float, step: float
) -> float:
    """``z`` one cell earlier, where braking effort and resistance slow the train down."""
    h = step / SUBSTEPS
    for j in range(SUBSTEPS, 0, -1):
        last, first = effort + drag0[j], effort + drag0[j - 1]
        mean = 0.5 * (last + first)
        k1 = last + drag1 * speed_of(z) + 2.0 * drag2 * z
        y = z + 0.5 * h * k1
        k2 = mean + drag1 * speed_of(y) + 2.0 * drag2 * y
        y = z + 0.5 * h * k2
        k3 = mean + drag1 * speed_of(y) + 2.0 * drag2 * y
        y = z + h * k3
        k4 = first + drag1 * speed_of(y) + 2.0 * drag2 * y
        z += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return z


@njit(cache=True)  # type: ignore[untyped-decorator]
def _pull(
    z: float, effort: float, power: float, gain: float, drag0: float, drag1: float, drag2: float
) -> float:
    """Slope of ``z`` under full traction: the effort limit, then the power limit."""
    v = speed_of(z)
    traction = min(effort, power / v) if v > 0.0 else effort
    return float(gain * traction - drag0 - drag1 * v - 2.0 * drag2 * z)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def pull_forwards(
    curve: FloatArray, initial: float, traction: FloatArray, gain: FloatArray, power: FloatArray,
    drag0: FloatArray, drag1: FloatArray, drag2: FloatArray, step: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Full traction from the start, each configuration by itself, below its braking `curve`.

    Effort limit, then power limit, at every speed. Returns ``z`` at the nodes, and the cell in
    which a configuration comes to a stand, or -1.
    """
    q, n = drag0.shape
    z = np.empty((q, n + 1))
    stalled = np.full(q, -1)
    for a in range(q):
        z[a, 0] = initial
        for k in range(n):
            y, h = z[a, k], 0.5 * step[k]
            arguments = (traction[k], power[a], gain[a], drag0[a, k], drag1[a], drag2[a, k])
            for _ in range(2):
                k1 = _pull(y, *arguments)
                k2 = _pull(y + 0.5 * h * k1, *arguments)
                k3 = _pull(y + 0.5 * h * k2, *arguments)
                k4 = _pull(y + h * k3, *arguments)
                y += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            if y <= 0.0 and curve[a, k + 1] > 0.0 and stalled[a] < 0:
                stalled[a] = k
            z[a, k + 1] = max(min(y, curve[a, k + 1]), 0.0)
    return z, stalled

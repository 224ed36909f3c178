"""How the remaining time is spread over the remaining way: the reference of the next seconds.

The trajectory's speeds, all times one factor, are run ahead with what the train can do: full
traction, coasting where traction is still to come, the ceiling of the speed. The factor is the one
that arrives on time.
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from analysis.control.prediction import TrainEstimate, expected_deceleration
from analysis.control.route import (
    GRID,
    SHARE,
    RouteTables,
    TrainLimits,
    ceiling_square,
    effort_limits,
    value,
)

FloatArray = NDArray[np.float64]

NEAR = 1_000.0
"""As far ahead [m] the run is kept in steps of `GRID`; beyond in coarser ones."""

COARSE = 4
"""Of them in one step further on."""

LAST = 10.0
"""Before the stop [m] the steps are of half a metre."""

SLOWEST, FASTEST = 0.6, 3.0
"""Bounds of the factor."""

CRAWL = 0.3
"""Least speed on the way [m/s]."""

SETTLED = 0.02
"""To which the arrival is met [s]."""


@njit(cache=True)
def rollout(
    factor: float,
    p: float,
    v: float,
    rows: FloatArray,
    estimate: TrainEstimate,
    route: RouteTables,
    limits: TrainLimits,
) -> tuple[float, int]:
    """Run ahead from a state to the stop.

    Parameters
    ----------
    factor : float
        Of the trajectory's speeds.
    rows : (k, 4) array
        Filled with position, speed, time and specific effort of the first steps.

    Returns
    -------
    time : float [s]
        Until the stop.
    count : int
        Of the rows filled.
    """
    time, square, count = 0.0, v * v, 0
    start = p
    while route.end - p > 1e-6:
        speed = math.sqrt(square)
        left = route.end - p
        step = 0.5 if left <= LAST else GRID
        if p - start > NEAR and left > LAST + COARSE * GRID:
            step = COARSE * GRID
        elif left > LAST:
            step = min(step, left - LAST)
        step = min(step, left)
        q = p + step
        if left - step < 1e-6:
            q = route.end
        pull, brake = effort_limits(q, speed, route, limits)
        back = expected_deceleration(0.5 * (p + q), speed, estimate, route, limits)
        most = square + 2.0 * step * (estimate.gain * pull / limits.inertia - back)
        least = square - 2.0 * step * back
        if p >= route.last_pull:
            least -= 2.0 * step * estimate.gain * SHARE * brake / limits.inertia
        goal = factor * factor * max(value(route.goal, route.origin, q), 0.0)
        found = min(max(min(goal, most), least), ceiling_square(q, route))
        if q < route.end:
            # Where it would stall it crawls: the time tells, and the train pulls all it can.
            found = max(found, CRAWL * CRAWL)
        after = math.sqrt(max(found, 0.0))
        if count < rows.shape[0] - 1:
            rows[count, 0], rows[count, 1], rows[count, 2] = p, speed, time
            rows[count, 3] = ((found - square) / (2.0 * step) + back) / estimate.gain
            count += 1
        time += 2.0 * step / max(speed + after, 1e-9)
        p, square = q, found
    rows[count, 0], rows[count, 1], rows[count, 2], rows[count, 3] = p, 0.0, time, 0.0
    return time, count + 1


@njit(cache=True)
def pace_to_arrive(
    left: float,
    guess: float,
    p: float,
    v: float,
    rows: FloatArray,
    estimate: TrainEstimate,
    route: RouteTables,
    limits: TrainLimits,
) -> tuple[float, float, int]:
    """The factor with which the train arrives in `left` seconds, or the nearest to it.

    Returns
    -------
    factor, time : float
        And how long the run takes with it [s].
    count : int
        Of the rows filled; see `ahead`.
    """
    time, count = rollout(guess, p, v, rows, estimate, route, limits)
    if abs(time - left) <= SETTLED:
        return guess, time, count
    reach = 0.004
    low, high, slow, fast = guess, guess, time, time
    while slow < left and low > SLOWEST:
        low = max(low - reach, SLOWEST)
        slow, _ = rollout(low, p, v, rows, estimate, route, limits)
        reach *= 4.0
    while fast > left and high < FASTEST:
        high = min(high + reach, FASTEST)
        fast, _ = rollout(high, p, v, rows, estimate, route, limits)
        reach *= 4.0
    factor = low if slow < left else high
    if slow >= left >= fast:
        for turn in range(20):
            # Regula falsi and bisection in turns: the time has kinks.
            share = 0.5
            if turn % 2 == 0:
                share = min(max((slow - left) / max(slow - fast, 1e-9), 0.05), 0.95)
            factor = low + share * (high - low)
            time, count = rollout(factor, p, v, rows, estimate, route, limits)
            if abs(time - left) <= SETTLED or high - low < 1e-5:
                return factor, time, count
            if time > left:
                low, slow = factor, time
            else:
                high, fast = factor, time
    time, count = rollout(factor, p, v, rows, estimate, route, limits)
    return factor, time, count


@njit(cache=True)
def sampled(rows: FloatArray, count: int, spans: int, span: float) -> tuple[Any, ...]:
    """The run ahead at equal times: (spans + 1, 2) positions and speeds, (spans,) efforts."""
    states, efforts = np.empty((spans + 1, 2)), np.zeros(spans)
    i = 0
    for k in range(2 * spans + 1):
        time = 0.5 * k * span
        while i < count - 1 and rows[i + 1, 2] <= time:
            i += 1
        p, v = rows[i, 0], rows[i, 1]
        if i < count - 1:
            since, lasts = time - rows[i, 2], rows[i + 1, 2] - rows[i, 2]
            a = (rows[i + 1, 1] - v) / max(lasts, 1e-9)
            p += (v + 0.5 * a * since) * since
            v += a * since
        if k % 2 == 0:
            states[k // 2, 0], states[k // 2, 1] = p, v
        else:
            efforts[k // 2] = rows[i, 3]
    return states, efforts

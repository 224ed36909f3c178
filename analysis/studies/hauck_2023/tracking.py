"""The compiled part of the tracking controllers: linearisation, condensing, and the guard."""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from analysis.control.prediction import AHEAD
from analysis.control.qp import speed_rows, terminal_weight, tracking_cost
from analysis.control.route import rate, value
from analysis.studies.hauck_2023.model import (
    Constants,
    Tables,
    acceleration,
    drift,
    full_effort,
    lever_bounds,
)
from trainlog.arrays import FloatArray
from trainlog.units import GRAVITY

SUBSTEPS = 10
"""Of the prediction in one sampling period."""

HELD = 1.0
"""For this long a lever that the guard lets through could be held under the ceiling [s]."""

LAG = 0.1
"""With which efforts follow their demand [s]."""

LOOKS, HALVINGS = 5, 20
"""Of the guard: steps of its look ahead, and of its search for a lever."""

BELOW = 0.02
"""The program stays this far below the ceiling [m/s], so that the guard has little to do."""


@njit(cache=True)
def exact_step(a21: float, a22: float, b2: float, span: float) -> tuple[Any, ...]:
    """Eq. (10): A and b of the sampled system, by the exponential of ``[[A, b], [0, 0]] span``.

    Scaling by 2^-6, the series until it no longer changes, and squaring.
    """
    h = span / 64.0
    m = np.zeros((3, 3))
    m[0, 1], m[1, 0], m[1, 1], m[1, 2] = h, a21 * h, a22 * h, b2 * h
    found, term = np.eye(3), np.eye(3)
    for k in range(1, 13):
        term = term @ m / k
        found += term
    for _ in range(6):
        found = found @ found
    return found[:2, :2].copy(), found[:2, 2].copy()


@njit(cache=True)
def step(p: float, v: float, u: float, span: float, m: float, t: Tables, c: Constants) -> Any:
    """One sampling period under a held lever; a train that comes to rest does not roll back."""
    h = span / SUBSTEPS
    for _ in range(SUBSTEPS):
        a1 = acceleration(v, u, value(t.sine, t.origin, p), m, c)
        w = max(v + 0.5 * h * a1, 0.0)
        a2 = acceleration(w, u, value(t.sine, t.origin, p + 0.5 * h * v), m, c)
        p += h * w
        v = max(v + h * a2, 0.0)
    return p, v


@njit(cache=True)
def bounds_over(
    p: float, v: float, q: float, w: float, t: Tables, c: Constants
) -> tuple[float, float]:
    """Lever that (4), (5) and its range allow at every mass from a state (p, v) to (q, w)."""
    low, high = -1.0, 1.0
    for k in range(5):
        x, speed = p + 0.25 * k * (q - p), v + 0.25 * k * (w - v)
        grip = min(value(t.adhesion, t.origin, x), value(t.adhesion, t.origin, x + AHEAD * speed))
        least, most = lever_bounds(speed, value(t.sine, t.origin, x), grip, c)
        low, high = max(low, least), min(high, most)
    return low, high


@njit(cache=True)
def predicted(
    p: float, v: float, levers: FloatArray, span: float, m: float, t: Tables, c: Constants
) -> tuple[Any, ...]:
    """States under levers that are kept within their bounds, and those levers."""
    n = levers.size
    states, kept = np.empty((n + 1, 2)), levers.copy()
    states[0, 0], states[0, 1] = p, v
    for k in range(n):
        p, v = states[k, 0], states[k, 1]
        low, high = bounds_over(p, v, p + v * span, v, t, c)
        kept[k] = min(max(levers[k], low), high)
        states[k + 1, 0], states[k + 1, 1] = step(p, v, kept[k], span, m, t, c)
    return states, kept


@njit(cache=True)
def condensed(
    states: FloatArray, levers: FloatArray, deviation: FloatArray, target: FloatArray,
    aim: FloatArray, weight: float, effort: float, span: float, m: float, t: Tables, c: Constants,
) -> tuple[Any, ...]:  # fmt: skip
    """The program (11) in the changes of the lever alone.

    Parameters
    ----------
    states, levers : (n + 1, 2), (n,) arrays
        About which the motion is linearised.
    deviation : (2,) array
        Of the measured state from the first of them.
    target, aim : (n + 1, 2), (n,) arrays
        Positions and speeds, and levers, of the reference.
    weight, effort : float
        Q and R.

    Returns
    -------
    H, f : (n, n), (n,) arrays
    A : (2n, n) array
        Rows of the ceiling of the speed, then of standing or going forward.
    upper, lower : (3n,) arrays
        Bounds of the changes, then of the rows.
    """
    n = levers.size
    response = np.zeros((n + 1, 2, n))
    free = np.zeros((n + 1, 2))
    free[0] = deviation
    last_a, last_b = np.eye(2), np.zeros(2)
    least, most = np.empty(n), np.empty(n)
    for k in range(n):
        p, v, u = states[k, 0], states[k, 1], levers[k]
        full = full_effort(v, c)
        a22 = -(2.0 * c.drag * v + c.k2 * (full - c.k3) * u) / m
        a21 = -GRAVITY * rate(t.sine, t.origin, p)
        last_a, last_b = exact_step(a21, a22, full / m, span)
        free[k + 1] = last_a @ free[k]
        for j in range(k):
            response[k + 1, 0, j] = (
                last_a[0, 0] * response[k, 0, j] + last_a[0, 1] * response[k, 1, j]
            )
            response[k + 1, 1, j] = (
                last_a[1, 0] * response[k, 0, j] + last_a[1, 1] * response[k, 1, j]
            )
        response[k + 1, 0, k], response[k + 1, 1, k] = last_b[0], last_b[1]
        low, high = bounds_over(p, v, states[k + 1, 0], states[k + 1, 1], t, c)
        least[k], most[k] = low - u, high - u
    squares, slopes = np.empty(n + 1), np.empty(n + 1)
    for k in range(n + 1):
        p, v = states[k, 0], states[k, 1]
        squares[k] = value(t.ceiling, t.origin, p) - 2.0 * v * BELOW
        slopes[k] = rate(t.ceiling, t.origin, p)
    terminal = terminal_weight(last_a, last_b, weight, effort)
    h, f = tracking_cost(response, states + free - target, levers - aim, terminal, weight, effort)
    rows, upper, lower = speed_rows(least, most, response, states, free, squares, slopes)
    return h, f, rows, upper, lower


@njit(cache=True)
def stride(p: float, v: float, u: float, h: float, m: float, t: Tables, c: Constants) -> Any:
    """One step of the midpoint rule under a held lever; see `step`."""
    a1 = acceleration(v, u, value(t.sine, t.origin, p), m, c)
    w = max(v + 0.5 * h * a1, 0.0)
    a2 = acceleration(w, u, value(t.sine, t.origin, p + 0.5 * h * v), m, c)
    return p + h * w, max(v + h * a2, 0.0)


@njit(cache=True)
def below_ceiling(
    p: float, v: float, u: float, last: float, light: float, heavy: float, t: Tables, c: Constants
) -> bool:
    """Whether a train of either mass stays below the ceiling with the lever held for `HELD`."""
    # A train that is too fast already may take the time to become slow enough.
    over = max(v - math.sqrt(value(t.ceiling, t.origin, p)), 0.0)
    for m in (light, heavy):
        # What the motors still give of the last lever.
        x, w = p, v + LAG * max(last - u, 0.0) * full_effort(v, c) / m
        for k in range(1, LOOKS + 1):
            x, w = stride(x, w, u, HELD / LOOKS, m, t, c)
            allowed = math.sqrt(value(t.ceiling, t.origin, x))
            if w > allowed + over * (1.0 - k / LOOKS) + 1e-9:
                return False
    return True


@njit(cache=True)
def held_bounds(
    p: float, v: float, u: float, span: float, light: float, heavy: float, t: Tables, c: Constants
) -> tuple[float, float]:
    """Lever that (4), (5) and its range allow while `u` is held for `span`, for every mass."""
    low, high = -1.0, 1.0
    for m in (light, heavy):
        x, w = p, v
        for _ in range(LOOKS + 1):
            least, most = bounds_over(x, w, x, w, t, c)
            low, high = max(low, least), min(high, most)
            x, w = stride(x, w, u, span / LOOKS, m, t, c)
    return low, high


@njit(cache=True)
def guarded(
    p: float, v: float, u: float, last: float, span: float, light: float, heavy: float,
    t: Tables, c: Constants,
) -> float:  # fmt: skip
    """The lever next to `u` that keeps (7) until the next sample whatever the train weighs.

    Parameters
    ----------
    last : float
        Lever that was held until now.
    span : float [s]
        For which the lever will be held.
    light, heavy : float [kg]
        Between which the mass of the motion is.

    Comfort and adhesion come first: full braking beyond them stops no train sooner.
    """
    low, high = bounds_over(p, v, p, v, t, c)
    low, high = min(low, 0.0), max(high, 0.0)
    u = min(max(u, low), high)
    if u > 0.0:
        u = _nearest(0, p, v, 0.0, u, last, span, light, heavy, t, c)
    u = _nearest(1, p, v, low, u, last, span, light, heavy, t, c)
    if u < 0.0:
        u = _nearest(2, p, v, 0.0, u, last, span, light, heavy, t, c)
    return u


@njit(cache=True)
def _kept(
    rule: int, p: float, v: float, u: float, last: float, span: float, light: float, heavy: float,
    t: Tables, c: Constants,
) -> bool:  # fmt: skip
    """Whether a lever keeps what limits traction (0), the ceiling (1), or what limits braking."""
    if rule == 1:
        return below_ceiling(p, v, u, last, light, heavy, t, c)
    low, high = held_bounds(p, v, u, span, light, heavy, t, c)
    return u <= high if rule == 0 else u >= low


@njit(cache=True)
def _nearest(
    rule: int, p: float, v: float, good: float, wanted: float, last: float, span: float,
    light: float, heavy: float, t: Tables, c: Constants,
) -> float:  # fmt: skip
    """The lever next to `wanted`, on the way from `good`, that keeps a rule; `good` if none."""
    if _kept(rule, p, v, wanted, last, span, light, heavy, t, c):
        return wanted
    bad = wanted
    for _ in range(HALVINGS):
        middle = 0.5 * (good + bad)
        if _kept(rule, p, v, middle, last, span, light, heavy, t, c):
            good = middle
        else:
            bad = middle
    return good


@njit(cache=True)
def stopping_lever(
    p: float, v: float, left: float, end: float, m: float, t: Tables, c: Constants
) -> float:
    """The lever of an even deceleration to the speed `end` over what is `left` [m]."""
    needed = (end * end - v * v) / (2.0 * max(left, 1e-3))
    return (needed - drift(v, value(t.sine, t.origin, p), m, c)) * m / full_effort(v, c)

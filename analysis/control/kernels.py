"""The compiled part of the controller that follows a trajectory: prediction, program, guard.

The controller thinks in specific effort: effort over the inertia of the middle of the set, traction
positive, braking negative [m/s²]. The motion it expects is

    dv/dt = gain (q - f) - (1 + drag) R(v) / M - m/M g_track(p) + drift

with `q` what acts at once, traction and dynamic brake, and `f` the friction brake, which follows
its demand after a dead time and a lag. `gain`, `drag` and `drift` are what the train was found to
be on its way (`analysis.control.observer`).
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from analysis.control.route import (
    MARGIN,
    Able,
    Way,
    at_once,
    bounds,
    held_back,
    highest,
)
from analysis.control.tracking_kernels import AHEAD, terminal_weight
from analysis.studies.hauck_2023.dynamics import rate, value

FloatArray = NDArray[np.float64]

TICK = 0.1
"""Step of the prediction [s]; dead times are whole numbers of it."""


CREEP = 3.0
"""Slip speed of wheels on wet rail that gives all it has [m/s] (paper 003, eq. 10)."""


class Belief(NamedTuple):
    """What the train is taken to be: see the equation above."""

    gain: float
    drag: float
    drift: float


class Weights(NamedTuple):
    """Of the program: position error [1/m²], deviation from the reference's effort, and change."""

    position: float
    effort: float
    change: float


@njit(cache=True)
def resisted(p: float, v: float, b: Belief, w: Way, can: Able) -> float:
    """Deceleration without effort as believed [m/s²]."""
    drag = can.r0 + (can.r1 + (can.r2 + value(w.tunnel, w.origin, p)) * v) * v
    along = can.mass * value(w.track, w.origin, p)
    return ((1.0 + b.drag) * drag + along) / can.inertia - b.drift


@njit(cache=True)
def split(u: float, v: float, can: Able) -> tuple[float, float]:
    """What acts at once of a specific effort, and what the friction brake is asked for."""
    quick = at_once(v, can) / can.inertia
    if u >= -quick:
        return u, 0.0
    return -quick, -u - quick


@njit(cache=True)
def allowed(p: float, v: float, q: float, w: Way, can: Able) -> tuple[float, float]:
    """Lowest and highest specific effort on the way from p to q and a little further."""
    pull, brake = bounds(p, v, w, can)
    for place in (0.5 * (p + q), q, q + AHEAD * v):
        more, harder = bounds(place, v, w, can)
        pull, brake = min(pull, more), min(brake, harder)
    return -brake / can.inertia, pull / can.inertia


@njit(cache=True)
def linearised(
    p: float, v: float, f: float, past: FloatArray, plan: FloatArray, ticks: int,
    b: Belief, w: Way, can: Able,
) -> tuple[Any, ...]:  # fmt: skip
    """Predict the motion under a plan, and how it answers to changes of it.

    Parameters
    ----------
    p, v, f : float [m], [m/s], [m/s²]
        Position, speed, and specific effort of the friction brake.
    past : (k,) array [m/s²]
        Friction braking asked for in the last dead time, a tick each, oldest first.
    plan : (n,) array [m/s²]
        Specific efforts, each held for `ticks` ticks.

    Returns
    -------
    states : (n + 1, 2) array
    response : (n + 1, 2, n) array
        Change of position and speed with each effort.
    kept : (n,) array
        The plan within its bounds.
    low, high : (n,) arrays
    """
    n, dead = plan.size, past.size
    states, response = np.empty((n + 1, 2)), np.zeros((n + 1, 2, n))
    kept, low, high = plan.copy(), np.empty(n), np.empty(n)
    asked, slow = np.zeros(n * ticks), np.zeros(n * ticks, dtype=np.bool_)
    dp, dv, df = np.zeros(n), np.zeros(n), np.zeros(n)
    fade = math.exp(-TICK / can.lag)
    # Of the friction brake at the middle of a tick, from the beginning to the end of it.
    share = 0.5
    states[0, 0], states[0, 1] = p, v
    for k in range(n):
        low[k], high[k] = allowed(p, v, p + v * ticks * TICK, w, can)
        kept[k] = min(max(plan[k], low[k]), high[k])
        braking = kept[k] <= 0.0 and at_once(v, can) <= 0.0
        for j in range(ticks):
            i = k * ticks + j
            quick, asked[i] = split(kept[k], v, can)
            slow[i] = asked[i] > 0.0 or braking
            late = past[i] if i < dead else asked[i - dead]
            before = f
            f = late + (f - late) * fade
            friction = before + share * (f - before)
            a22 = (
                -(1.0 + b.drag)
                * (can.r1 + 2.0 * (can.r2 + value(w.tunnel, w.origin, p)) * v)
                / can.inertia
            )
            a21 = -can.mass / can.inertia * rate(w.track, w.origin, p)
            a = b.gain * (quick - friction) - resisted(p, v, b, w, can)
            a += 0.5 * TICK * (a21 * v + a22 * a)
            stops = v + TICK * a < 0.0
            for c in range(k + 1):
                push = 0.0
                if c == k and not slow[i]:
                    push = b.gain
                old = df[c]
                goal = 0.0
                if i >= dead and (i - dead) // ticks == c and slow[i - dead]:
                    goal = -1.0
                df[c] = goal + (old - goal) * fade
                push -= b.gain * (old + share * (df[c] - old))
                da = a21 * dp[c] + a22 * dv[c] + push
                da += 0.5 * TICK * (a21 * dv[c] + a22 * da)
                dp[c] += TICK * dv[c] + 0.5 * TICK * TICK * da
                dv[c] = 0.0 if stops else dv[c] + TICK * da
            if stops:
                p += 0.5 * v * v / max(-a, 1e-9)
                v = 0.0
            else:
                p += TICK * v + 0.5 * TICK * TICK * a
                v += TICK * a
        states[k + 1, 0], states[k + 1, 1] = p, v
        response[k + 1, 0], response[k + 1, 1] = dp, dv
    return states, response, kept, low, high


@njit(cache=True)
def condensed(
    states: FloatArray, response: FloatArray, kept: FloatArray, low: FloatArray, high: FloatArray,
    target: FloatArray, aim: FloatArray, before: float, weight: Weights, span: float,
    b: Belief, w: Way,
) -> tuple[Any, ...]:  # fmt: skip
    """The program ``min 1/2 x'Hx + f'x`` in changes x of the specific efforts.

    Parameters
    ----------
    target : (n + 1, 2) array
        Positions and speeds of the reference.
    aim : (n,) array
        Its specific efforts.
    before : float
        The effort of now.

    Returns
    -------
    H, f : (n, n), (n,) arrays
    rows : (2n, n) array
        Ceiling of the speed, then of standing or going forward.
    upper, lower : (3n,) arrays
        Of the changes, then of the rows.
    """
    n = kept.size
    h, f = np.zeros((n, n)), np.zeros(n)
    for k in range(1, n + 1):
        gone = states[k, 0] - target[k, 0]
        for i in range(n):
            x = weight.position * response[k, 0, i]
            f[i] += x * gone
            for j in range(i + 1):
                h[i, j] += x * response[k, 0, j]
    a = np.array([[1.0, span], [0.0, 1.0]])
    end = terminal_weight(
        a, b.gain * np.array([0.5 * span * span, span]), weight.position, weight.effort
    )
    end[0, 0] -= weight.position
    gap = states[n] - target[n]
    last = response[n]
    for i in range(n):
        x = end[0, 0] * last[0, i] + end[0, 1] * last[1, i]
        y = end[1, 0] * last[0, i] + end[1, 1] * last[1, i]
        f[i] += x * gap[0] + y * gap[1] + weight.effort * (kept[i] - aim[i])
        h[i, i] += weight.effort
        for j in range(i + 1):
            h[i, j] += x * last[0, j] + y * last[1, j]
    for i in range(n):
        # Changes are weighed as changes beyond those of the reference.
        earlier = before - aim[0] if i == 0 else kept[i - 1] - aim[i - 1]
        step = kept[i] - aim[i] - earlier
        h[i, i] += weight.change
        f[i] += weight.change * step
        if i > 0:
            h[i - 1, i - 1] += weight.change
            h[i, i - 1] -= weight.change
            f[i - 1] -= weight.change * step
    for i in range(n):
        for j in range(i):
            h[j, i] = h[i, j]
    rows, upper, lower = np.empty((2 * n, n)), np.empty(3 * n), np.full(3 * n, -1e30)
    upper[:n], lower[:n] = high - kept, low - kept
    for k in range(1, n + 1):
        p, v = states[k, 0], states[k, 1]
        slope = rate(w.ceiling, w.origin, p)
        for j in range(n):
            rows[k - 1, j] = 2.0 * v * response[k, 1, j] - slope * response[k, 0, j]
            rows[n + k - 1, j] = response[k, 1, j]
        upper[n + k - 1] = highest(p, w) - v * v
        upper[2 * n + k - 1] = 1e30
        lower[2 * n + k - 1] = -v
    return h, f, rows, upper, lower


@njit(cache=True)
def spun(u: float, p: float, w: Way, can: Able) -> float:
    """Momentum [kg m/s] that the powered axles hold by turning faster than the train rolls.

    Under a specific effort `u`; when the traction ends it goes into the train.
    """
    share = max(u, 0.0) * can.inertia / (value(w.pulling, w.origin, p) * can.on_powered)
    return can.spinning * CREEP * min(share, 1.0) ** 2


@njit(cache=True)
def keeps(
    p: float, v: float, f: float, past: FloatArray, before: float, u: float, held: int,
    ticks: int, w: Way, can: Able,
) -> bool:  # fmt: skip
    """Whether every train of the set keeps its speed for so many ticks.

    The specific effort goes from `before` to `u`, which takes the drive a tick, and is held for
    some of them; after that the train brakes with all it has. What the wheels gave to creep comes
    back as the effort goes.
    """
    over = max(v - math.sqrt(highest(p, w)) - MARGIN, 0.0)
    fade, dead = math.exp(-TICK / can.lag), past.size
    now, later = spun(before, p, w, can), spun(u, p, w, can)
    for row in can.corners:
        place, speed, friction = p, v + max(now - later, 0.0) / row[1], f
        gain = can.inertia / row[1]
        for i in range(ticks):
            wanted = u
            if i == held:
                speed += later / row[1]
            if i >= held:
                wanted = min(u, -bounds(place, speed, w, can)[1] / can.inertia)
            quick, asked = split(wanted, speed, can)
            if i == 0:
                quick = max(quick, before)
            late = asked
            if i < dead:
                late = past[i]
            elif i - dead < held:
                late = split(u, speed, can)[1]
            earlier = friction
            friction = late + (friction - late) * fade
            a = gain * (quick - 0.5 * (earlier + friction)) - held_back(place, speed, row, w)
            after = max(speed + TICK * a, 0.0)
            place += 0.5 * TICK * (speed + after)
            speed = after
            # Who is too fast already may take the time to become slow enough.
            most = math.sqrt(highest(place, w)) + MARGIN + over * (1.0 - (i + 1) / ticks)
            if speed > most + 1e-9 and place < w.end:
                return False
    return True


@njit(cache=True)
def guarded(
    p: float, v: float, f: float, past: FloatArray, before: float, u: float, held: int,
    ticks: int, w: Way, can: Able,
) -> float:  # fmt: skip
    """The specific effort next to `u` that keeps limits, adhesion and comfort for every train.

    Parameters
    ----------
    before : float
        The effort of now.
    held, ticks : int
        For how many ticks it is held, and how far is looked ahead.
    """
    low, high = allowed(p, v, p + v * held * TICK, w, can)
    u = min(max(u, low), high)
    if keeps(p, v, f, past, before, u, held, ticks, w, can):
        return u
    if not keeps(p, v, f, past, before, low, held, ticks, w, can):
        return low
    good, bad = low, u
    for _ in range(14):
        middle = 0.5 * (good + bad)
        if keeps(p, v, f, past, before, middle, held, ticks, w, can):
            good = middle
        else:
            bad = middle
    return good

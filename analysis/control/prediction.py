"""The compiled part of the controller that follows a trajectory: prediction, program, guard.

The controller thinks in specific effort: effort over the inertia of the middle of the set, traction
positive, braking negative [m/s²]. The motion it expects is

    dv/dt = gain (q - f) - (1 + drag) R(v) / M - m/M g_track(p) + drift

with `q` what acts at once, traction and dynamic brake, and `f` the friction brake, which follows
its demand after a dead time and a lag. `gain`, `drag` and `drift` are what the train was found to
be on its way (`analysis.control.follow`).

The reference of the next seconds spreads the remaining time over the remaining way: the speeds of
the trajectory, all times one factor, are run ahead with what the train can do (`rollout`). The
factor is the one that arrives on time (`pace_to_arrive`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from analysis.control.route import (
    AHEAD,
    GRID,
    MARGIN,
    SHARE,
    RouteTables,
    TrainLimits,
    ceiling_square,
    compiled,
    creep_momentum,
    cruising_square,
    dynamic_braking,
    effort_limits,
    free_deceleration,
    rate,
    value,
)
from trainlog.arrays import FloatArray

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator"


SOFTNESS = 1e-7
"""Of the rows of a program: one over their quadratic weight."""

UNBOUNDED = 1e30
"""Bound of a row on the side on which it has none, as DAQP has it."""


@dataclass(frozen=True, eq=False)
class QPSubproblem:
    """``min 1/2 x'Hx + f'x`` in changes x of the inputs about which the motion is linearised.

    Attributes
    ----------
    hessian, gradient : (n, n), (n,) arrays
    rows : (m, n) array
        Of linear constraints.
    upper, lower : (n + m,) arrays
        Of the changes, hard; then of the rows.
    inputs : (n,) array
        About which the motion is linearised.
    soft : bool
        Whether the rows may be broken at a price (`SOFTNESS`).
    """

    hessian: FloatArray
    gradient: FloatArray
    rows: FloatArray
    upper: FloatArray
    lower: FloatArray
    inputs: FloatArray
    soft: bool = True


def solve(program: QPSubproblem) -> tuple[FloatArray, int]:
    """Solve a program by DAQP.

    Parameters
    ----------
    program : QPSubproblem

    Returns
    -------
    change : (n,) array
    status : int
        Positive where the optimum was found.

    Examples
    --------
    >>> import numpy as np
    >>> one = np.array([1.0])
    >>> program = QPSubproblem(np.eye(1), -one, np.ones((1, 1)), 0.5 * np.ones(2), -np.ones(2), one)
    >>> change, status = solve(program)
    >>> change.round(3).tolist(), status > 0
    ([0.5], True)
    """
    import daqp

    sense: NDArray[np.int32] = np.zeros(program.upper.size, dtype=np.int32)
    if program.soft:
        sense[program.gradient.size :] = 8
    answer: tuple[Any, ...] = daqp.solve(
        program.hessian, program.gradient, program.rows, program.upper, program.lower, sense,
        rho_soft=SOFTNESS,
    )  # fmt: skip
    return np.asarray(answer[0]), int(answer[2])


@njit(cache=True)
def terminal_weight(a: FloatArray, b: FloatArray, weight: float, effort: float) -> FloatArray:
    """Cost to go of the unconstrained regulator, by iterating Riccati's equation.

    Of ``x[k+1] = A x[k] + b u[k]`` with the stage cost ``weight x[0]² + effort u²``; (2, 2) array.
    """
    # In scalars: the products of arrays would take seconds to compile.
    a00, a01, a10, a11 = a[0, 0], a[0, 1], a[1, 0], a[1, 1]
    b0, b1 = b[0], b[1]
    p00, p01, p11 = weight, 0.0, 0.0
    for _ in range(60):
        # P A, then A' P A and A' P b; P is symmetric.
        x00, x01 = p00 * a00 + p01 * a10, p00 * a01 + p01 * a11
        x10, x11 = p01 * a00 + p11 * a10, p01 * a01 + p11 * a11
        c0, c1 = x00 * b0 + x10 * b1, x01 * b0 + x11 * b1
        over = effort + b0 * (p00 * b0 + p01 * b1) + b1 * (p01 * b0 + p11 * b1)
        n00 = a00 * x00 + a10 * x10 - c0 * c0 / over + weight
        n01 = a00 * x01 + a10 * x11 - c0 * c1 / over
        n11 = a01 * x01 + a11 * x11 - c1 * c1 / over
        change = max(abs(n00 - p00), abs(n01 - p01), abs(n11 - p11))
        if change < 1e-9 * max(abs(n00), abs(n01), abs(n11)):
            break
        p00, p01, p11 = n00, n01, n11
    p = np.empty((2, 2))
    p[0, 0], p[0, 1], p[1, 0], p[1, 1] = p00, p01, p01, p11
    return p


@njit(cache=True)
def tracking_cost(
    response: FloatArray, error: FloatArray, deviation: FloatArray, terminal: FloatArray,
    weight: float, effort: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Hessian and gradient of the cost of following a reference.

    ``sum weight (position error)² + effort (input less its reference)²``, and the terminal cost.

    Parameters
    ----------
    response : (n + 1, 2, n) array
        Change of position and speed at each step with each input.
    error : (n + 1, 2) array
        Predicted states less those of the reference.
    deviation : (n,) array
        Inputs less those of the reference.
    terminal : (2, 2) array
        See `terminal_weight`.
    weight, effort : float

    Returns
    -------
    hessian, gradient : (n, n), (n,) arrays
    """
    n = deviation.size
    h, f = np.zeros((n, n)), np.zeros(n)
    for k in range(1, n + 1):
        for i in range(n):
            x = weight * response[k, 0, i]
            f[i] += x * error[k, 0]
            for j in range(i + 1):
                h[i, j] += x * response[k, 0, j]
    # The last position is in the terminal cost.
    first = terminal[0, 0] - weight
    last, gap = response[n], error[n]
    for i in range(n):
        x = first * last[0, i] + terminal[0, 1] * last[1, i]
        y = terminal[1, 0] * last[0, i] + terminal[1, 1] * last[1, i]
        f[i] += x * gap[0] + y * gap[1] + effort * deviation[i]
        h[i, i] += effort
        for j in range(i + 1):
            h[i, j] += x * last[0, j] + y * last[1, j]
            h[j, i] = h[i, j]
    return h, f


@njit(cache=True)
def speed_rows(
    least: FloatArray, most: FloatArray, response: FloatArray, states: FloatArray,
    free: FloatArray, squares: FloatArray, slopes: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Rows that keep the square of the speed below a ceiling, and the speed from below 0.

    Parameters
    ----------
    least, most : (n,) arrays
        Bounds of the changes of the inputs.
    response : (n + 1, 2, n) array
    states : (n + 1, 2) array
        About which the motion is linearised.
    free : (n + 1, 2) array
        How far the motion without any change of the inputs is from there.
    squares : (n + 1,) array [m²/s²]
        Of the ceiling, at each state.
    slopes : (n + 1,) array [m/s²]
        How it changes with the position.

    Returns
    -------
    rows : (2n, n) array
    upper, lower : (3n,) arrays
        Bounds of the changes, then of the rows.
    """
    n = states.shape[0] - 1
    rows, upper, lower = np.empty((2 * n, n)), np.empty(3 * n), np.empty(3 * n)
    for k in range(n):
        upper[k], lower[k] = most[k], least[k]
    for k in range(1, n + 1):
        v, slope = states[k, 1], slopes[k]
        for j in range(n):
            rows[k - 1, j] = 2.0 * v * response[k, 1, j] - slope * response[k, 0, j]
            rows[n + k - 1, j] = response[k, 1, j]
        upper[n + k - 1] = squares[k] - v * v - 2.0 * v * free[k, 1] + slope * free[k, 0]
        lower[n + k - 1] = -UNBOUNDED
        upper[2 * n + k - 1] = UNBOUNDED
        lower[2 * n + k - 1] = -(v + free[k, 1])
    return rows, upper, lower


# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"


TICK = 0.1
"""Step of the prediction [s]; dead times are whole numbers of it."""

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


class TrainEstimate(NamedTuple):
    """What the train is estimated to be: see the equation above."""

    gain: float
    drag: float
    drift: float


class Weights(NamedTuple):
    """Of the program: position error [1/m²], deviation from the reference's effort, and change."""

    position: float
    effort: float
    change: float


@compiled
def expected_deceleration(
    p: float, v: float, estimate: TrainEstimate, route: RouteTables, limits: TrainLimits
) -> float:
    """Deceleration without effort as estimated [m/s²]."""
    square = limits.quadratic + value(route.tunnel, route.origin, p)
    drag = limits.constant + (limits.linear + square * v) * v
    along = limits.mass * value(route.track, route.origin, p)
    return ((1.0 + estimate.drag) * drag + along) / limits.inertia - estimate.drift


@compiled
def split(
    u: float, p: float, v: float, route: RouteTables, limits: TrainLimits
) -> tuple[float, float]:
    """What acts at once of a specific effort, and what the friction brake is asked for."""
    quick = dynamic_braking(p, v, route, limits) / limits.inertia
    if u >= -quick:
        return u, 0.0
    return -quick, -u - quick


@compiled
def effort_bounds(
    p: float, v: float, q: float, route: RouteTables, limits: TrainLimits
) -> tuple[float, float]:
    """Lowest and highest specific effort on the way from p to q and a little further."""
    pull, brake = effort_limits(p, v, route, limits)
    for place in (0.5 * (p + q), q, q + AHEAD * v):
        more, harder = effort_limits(place, v, route, limits)
        pull, brake = min(pull, more), min(brake, harder)
    return -brake / limits.inertia, pull / limits.inertia


@njit(cache=True)
def linearised(
    p: float, v: float, f: float, past: FloatArray, plan: FloatArray, ticks: int,
    estimate: TrainEstimate, route: RouteTables, limits: TrainLimits,
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
    kept, low, high = np.empty(n), np.empty(n), np.empty(n)
    asked, slow = np.zeros(n * ticks), np.zeros(n * ticks, dtype=np.bool_)
    dp, dv, df = np.zeros(n), np.zeros(n), np.zeros(n)
    fade = math.exp(-TICK / limits.lag)
    # Of the friction brake at the middle of a tick, from the beginning to the end of it.
    share = 0.5
    states[0, 0], states[0, 1] = p, v
    for k in range(n):
        low[k], high[k] = effort_bounds(p, v, p + v * ticks * TICK, route, limits)
        kept[k] = min(max(plan[k], low[k]), high[k])
        braking = kept[k] <= 0.0 and dynamic_braking(p, v, route, limits) <= 0.0
        for j in range(ticks):
            i = k * ticks + j
            quick, asked[i] = split(kept[k], p, v, route, limits)
            slow[i] = asked[i] > 0.0 or braking
            late = past[i] if i < dead else asked[i - dead]
            before = f
            f = late + (f - late) * fade
            friction = before + share * (f - before)
            square = limits.quadratic + value(route.tunnel, route.origin, p)
            a22 = -(1.0 + estimate.drag) * (limits.linear + 2.0 * square * v) / limits.inertia
            a21 = -limits.mass / limits.inertia * rate(route.track, route.origin, p)
            a = estimate.gain * (quick - friction) - expected_deceleration(
                p, v, estimate, route, limits
            )
            a += 0.5 * TICK * (a21 * v + a22 * a)
            stops = v + TICK * a < 0.0
            for c in range(k + 1):
                push = 0.0
                if c == k and not slow[i]:
                    push = estimate.gain
                old = df[c]
                goal = 0.0
                if i >= dead and (i - dead) // ticks == c and slow[i - dead]:
                    goal = -1.0
                df[c] = goal + (old - goal) * fade
                push -= estimate.gain * (old + share * (df[c] - old))
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
        for c in range(n):
            response[k + 1, 0, c], response[k + 1, 1, c] = dp[c], dv[c]
    return states, response, kept, low, high


@njit(cache=True)
def condensed(
    states: FloatArray, response: FloatArray, kept: FloatArray, low: FloatArray, high: FloatArray,
    target: FloatArray, aim: FloatArray, before: float, weight: Weights, span: float,
    estimate: TrainEstimate, route: RouteTables,
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
    a, push = np.zeros((2, 2)), np.empty(2)
    a[0, 0], a[0, 1], a[1, 1] = 1.0, span, 1.0
    push[0], push[1] = estimate.gain * (0.5 * span * span), estimate.gain * span
    terminal = terminal_weight(a, push, weight.position, weight.effort)
    # Element by element: assignments of arrays and slices would take seconds to compile.
    error, deviation = np.empty((n + 1, 2)), np.empty(n)
    for k in range(n + 1):
        error[k, 0], error[k, 1] = states[k, 0] - target[k, 0], states[k, 1] - target[k, 1]
    least, most = np.empty(n), np.empty(n)
    for i in range(n):
        deviation[i] = kept[i] - aim[i]
        least[i], most[i] = low[i] - kept[i], high[i] - kept[i]
    h, f = tracking_cost(response, error, deviation, terminal, weight.position, weight.effort)
    for i in range(n):
        # Changes are weighed as changes beyond those of the reference.
        earlier = before - aim[0] if i == 0 else deviation[i - 1]
        step = deviation[i] - earlier
        h[i, i] += weight.change
        f[i] += weight.change * step
        if i > 0:
            h[i - 1, i - 1] += weight.change
            h[i, i - 1] -= weight.change
            h[i - 1, i] -= weight.change
            f[i - 1] -= weight.change * step
    squares, slopes = np.empty(n + 1), np.empty(n + 1)
    for k in range(n + 1):
        squares[k] = cruising_square(states[k, 0], route)
        slopes[k] = rate(route.cruising, route.origin, states[k, 0])
    free = np.zeros((n + 1, 2))
    rows, upper, lower = speed_rows(least, most, response, states, free, squares, slopes)
    return h, f, rows, upper, lower


@compiled
def excess_over_ceiling(
    p: float, v: float, f: float, past: FloatArray, before: float, u: float, held: int,
    ticks: int, route: RouteTables, limits: TrainLimits,
) -> float:  # fmt: skip
    """How far any train of the set comes above its speed within so many ticks [m/s]; 0 if none.

    The specific effort goes from `before` to `u`, which takes the drive a tick, and is held for
    some of them; after that the train brakes with all it has. What the wheels gave to creep comes
    back as the effort goes. Who is too fast already, with what the wheels hold now, may take the
    time to become slow enough.
    """
    highest = math.sqrt(ceiling_square(p, route)) + MARGIN
    fade, dead = math.exp(-TICK / limits.lag), past.size
    now, later = creep_momentum(before, p, route, limits), creep_momentum(u, p, route, limits)
    excess = 0.0
    for row in limits.corners:
        place, speed, friction = p, v + max(now - later, 0.0) / row[1], f
        over = max(v + now / row[1] - highest, 0.0)
        gain = limits.inertia / row[1]
        for i in range(ticks):
            wanted = u
            if i == held:
                speed += later / row[1]
            if i >= held:
                wanted = min(u, -effort_limits(place, speed, route, limits)[1] / limits.inertia)
            quick, asked = split(wanted, place, speed, route, limits)
            if i == 0:
                quick = max(quick, before)
            late = asked
            if i < dead:
                late = past[i]
            elif i - dead < held:
                late = split(u, place, speed, route, limits)[1]
            earlier = friction
            friction = late + (friction - late) * fade
            a = gain * (quick - 0.5 * (earlier + friction)) - free_deceleration(
                place, speed, row, route
            )
            after = max(speed + TICK * a, 0.0)
            place += 0.5 * TICK * (speed + after)
            speed = after
            most = math.sqrt(ceiling_square(place, route)) + MARGIN + over * (1.0 - (i + 1) / ticks)
            if place < route.end:
                excess = max(excess, speed - most)
    return excess


@compiled
def guarded(
    p: float, v: float, f: float, past: FloatArray, before: float, u: float, held: int,
    ticks: int, route: RouteTables, limits: TrainLimits,
) -> float:  # fmt: skip
    """The specific effort next to `u` that keeps limits, adhesion and comfort for every train.

    Where no effort keeps them all, such as in the first tick, in which the effort of now still
    acts, it is the one next to `u` that exceeds them by no more than the hardest braking: so the
    effort changes by as much as what is to be corrected, also where measured speeds scatter about
    the ceiling.

    Parameters
    ----------
    before : float
        The effort of now.
    held, ticks : int
        For how many ticks it is held, and how far is looked ahead.
    """
    low, high = effort_bounds(p, v, p + v * held * TICK, route, limits)
    u = min(max(u, low), high)
    wanted = excess_over_ceiling(p, v, f, past, before, u, held, ticks, route, limits)
    if wanted <= 1e-9:
        return u
    most = excess_over_ceiling(p, v, f, past, before, low, held, ticks, route, limits) + 1e-9
    if wanted <= most:
        return u
    good, bad = low, u
    for _ in range(14):
        middle = 0.5 * (good + bad)
        if excess_over_ceiling(p, v, f, past, before, middle, held, ticks, route, limits) <= most:
            good = middle
        else:
            bad = middle
    return good


# ---- how the remaining time is spread over the remaining way ------------------------------------


@compiled
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
        found = min(max(min(goal, most), least), cruising_square(q, route))
        if q < route.end:
            # Where it would stall it crawls: the time shows it, and the train pulls all it can.
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


@compiled
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

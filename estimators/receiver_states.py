"""What a receiver does at each fix: it measures, replays old fixes, shows late or wrong ones.

The hidden variable is the *age* of a fix: a fix at time t shows the place at t - age. A receiver
that measures has age 0; one that holds its place grows older by a second a second; one that works
off what it kept while it saw no sky begins as old as the gap was long, and either stays so or
catches up; one that filters is late by some seconds that change slowly. With the integral D of a
speed the place at t - age is known but for an offset,

    c[i] = D(t[i] - age[i]) + b[i] + v[i],

whose offset b walks as the integral errs. `receiver_states` finds the sequence of ages that is the
most probable: Viterbi's algorithm over whole seconds of age and three phases (steady, catching up,
off), each path with its own Kalman filter of b. Where the positions are off and b is the same
afterwards, the positions were wrong; where b is another one, the speed was.

`lateness` is for receivers that are late throughout: age is a slow Markov process then, c is linear
in it, and the likelihoods of a late receiver and of one that is not decide which it is.

References
----------
Raheli, R., Polydoros, A., Tzou, C. (1995), Per-survivor processing, IEEE Trans. Communications
43(2/3/4): each path of Viterbi's algorithm carries its own estimate. Ackerson, G., Fu, K. (1970),
On state estimation in switching environments, IEEE Trans. AC-15(1).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from estimators.linear_gaussian import LinearGaussian
from trainlog.arrays import BoolArray, FloatArray, IntArray

OLDEST = 70
"""Largest age [s] that is looked for; ages are whole seconds."""

SPACING = 2.0
"""Time [s] within which one fix is judged for all."""

INDEPENDENT = 10.0
"""Time [s] after which errors of positions are independent; closer fixes count as a part of one."""

LEAST_GAP = 4.0
"""Gap [s] after which a receiver may replay what it kept."""

WALK = 1.0
"""Random walk of the integral of a speed that is good [m²/s]."""

REPLAY, RETURN, CATCH_UP, DRIFT, LEAP, WRONG, DOUBT = 5.0, 5.0, 3.0, 4.0, 14.0, 6.0, 8.0
"""How improbable (minus the logarithm) it is that a receiver begins to replay after a gap, returns
to measuring, begins to catch up, becomes a second older or younger, shows any other age all at
once, shows wrong places, and that the speed was wrong meanwhile."""

OTHER = 4.0
"""The same, on top of `REPLAY`, of an age that is not that of the gap."""

OLD_RATE, CATCHING_RATE, WRONG_RATE = 0.01, 0.05, 0.3
"""The same, a second [1/s], of going on to show old, younger and wrong places."""

FASTEST = 3
"""Seconds of age that a receiver makes up for in a second: it replays four times as fast."""

UNSURE, OUTLIER = 2.0, 10.0
"""What a fix costs at most where it is not known where it should be, and where it is elsewhere."""

DOUBTED_STD = 3_000.0
"""Standard deviation [m] of what a wrong speed changes the offset by."""

SURE_OFFSET = 200.0
"""Standard deviation [m] of the offset up to which it shows that places were wrong."""

BEAM = 30.0
"""Paths that are so much less probable than the best one are given up."""

STEADY, CATCHING, OFF = 0, 1, 2

LATE, LATE_STD, LATE_TIME = 3.0, 3.0, 600.0
"""Mean, standard deviation and correlation time of the lateness of a late receiver [s]."""

PUNCTUAL_STD = 0.1, 0.3
"""Standard deviations of the lateness of one that is not late [s]."""

LATE_WALK = 0.3
"""Random walk of the integral of the speed, where lateness is compared [m²/s]."""

LASTING = 20.0
"""Correlation time [s] of a position's own error."""

MARGIN = 10.0
"""How much likelier (logarithm) a late receiver must be."""

LEAST_LATE = 1.0
"""Mean lateness [s] from which on a receiver is called late."""


class ReceiverStates(NamedTuple):
    """What the receiver did at each fix; (n,) arrays, 0 and False where there is none.

    Attributes
    ----------
    age : int array [s]
    wrong : bool array
        The place was wrong: the offset before and after is the same.
    doubted : bool array
        Positions and speed contradict each other, and the offset is another one afterwards.
    """

    age: IntArray
    wrong: BoolArray
    doubted: BoolArray


def receiver_states(
    seconds: FloatArray,
    along: FloatArray,
    std: FloatArray,
    driven: FloatArray,
    unsure: FloatArray,
) -> ReceiverStates:
    """The most probable ages of fixes, with the distance driven by a speed.

    Parameters
    ----------
    seconds : (n,) array [s]
        From 0 on, growing.
    along : (n,) array [m]
        Place of each fix along the line, NaN where there is none.
    std : (n,) array [m]
        Of each fix.
    driven : (n,) array [m]
        Integral of the speed.
    unsure : (n,) array [m²]
        Variance of that since the first row, growing, where the speed is missing.

    Examples
    --------
    A receiver that sees nothing for 30 s, and then shows for a minute what it did not show before:

    >>> import numpy as np
    >>> time = np.arange(0.0, 300.0)
    >>> driven = 15.0 * time - 150.0 * np.cos(time / 15.0)
    >>> age = np.where((time >= 130.0) & (time < 190.0), 30.0, 0.0)
    >>> along = np.interp(time - age, time, driven)
    >>> along[100:130] = np.nan
    >>> found = receiver_states(time, along, np.full(300, 4.0), driven, np.zeros(300))
    >>> found.age[[99, 130, 160, 189, 190]]
    array([ 0, 30, 30, 30,  0])
    """
    none = np.zeros(seconds.size, dtype=np.int64)
    known = np.flatnonzero(np.isfinite(along))
    if known.size < 2:
        return ReceiverStates(none, none > 0, none > 0)
    _, first = np.unique(np.floor(seconds[known] / SPACING), return_index=True)
    rows = known[first]
    apart = np.diff(seconds[rows], prepend=seconds[rows[0]])
    usual = float(np.median(apart))
    gap = np.where(apart > max(LEAST_GAP, 2.5 * usual), apart, 0.0)
    weight = np.minimum(np.maximum(apart, SPACING) / INDEPENDENT, 1.0)
    even = np.arange(0.0, seconds[-1] + 2.0)
    distance, variance = (np.interp(even, seconds, each) for each in (driven, unsure))
    count = int(min(OLDEST, max(float(gap.max()) + 5.0, 12.0)))
    age, phase, doubtful = _best_path(
        seconds[rows], along[rows], std[rows] ** 2, weight, gap, distance,
        variance + WALK * even, count,
    )  # fmt: skip
    # Each fix is in the state of the last one that was judged.
    owner = np.maximum(np.searchsorted(rows, known, side="right") - 1, 0)
    ages, off, doubts = (np.zeros(seconds.size, dtype=np.int64) for _ in range(3))
    ages[known], off[known], doubts[known] = age[owner], (phase == OFF)[owner], doubtful[owner]
    return ReceiverStates(ages, (off > 0) & (doubts == 0), doubts > 0)


class Lateness(NamedTuple):
    """By how much fixes are late, and its standard deviation; (n,) arrays [s]."""

    value: FloatArray
    std: FloatArray


def lateness(
    seconds: FloatArray,
    off: FloatArray,
    speed: FloatArray,
    unsure: FloatArray,
    std: FloatArray,
    *,
    evident: bool = False,
) -> Lateness | None:
    """By how much the fixes of a receiver are late throughout; None if they are not.

    ``off = b - a v + e``: an offset b that walks, the lateness a times the speed v, and errors e
    that last. A train that stands shows b, one that changes its speed shows a.

    Parameters
    ----------
    seconds : (n,) array [s]
    off : (n,) array [m]
        Places less the integral of the speed, NaN where there is none.
    speed : (n,) array [m/s]
    unsure : (n,) array [m²]
        Variance of the integral, growing, where the speed is missing.
    std : (n,) array [m]
        Of each fix.
    evident : bool
        Whether something else shows already that they are late.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(0.0, 900.0, 2.0)
    >>> speed = np.clip(20.0 * np.sin(time / 40.0), 0.0, 15.0)
    >>> noise = 3.0 * np.random.default_rng(1).standard_normal(time.size)
    >>> found = lateness(time, -4.0 * speed + noise, speed, np.zeros(450), np.full(450, 3.0))
    >>> bool(abs(np.mean(found.value) - 4.0) < 0.3)
    True
    >>> lateness(time, noise, speed, np.zeros(450), np.full(450, 3.0)) is None
    True
    """
    known = np.isfinite(off)
    if np.count_nonzero(known) < 2:
        return None
    steps = np.diff(seconds, prepend=seconds[0])
    walk = np.maximum(np.diff(unsure, prepend=unsure[0]), 0.0) + LATE_WALK * steps
    keep = np.exp(-steps / LATE_TIME), np.exp(-steps / LASTING)
    transition, noise = np.zeros((2, seconds.size, 3, 3))
    transition[:, 0, 0], transition[:, 1, 1], transition[:, 2, 2] = 1.0, keep[0], keep[1]
    observed = np.zeros((seconds.size, 1, 3))
    observed[:, 0, 0], observed[:, 0, 1], observed[:, 0, 2] = 1.0, -speed, std
    noise[:, 0, 0], noise[:, 2, 2] = walk, 1.0 - keep[1] ** 2
    likelihood = []
    for mean, spread in ((0.0, PUNCTUAL_STD[0]), (0.0, PUNCTUAL_STD[1]), (LATE, LATE_STD)):
        noise[:, 1, 1] = spread**2 * (1.0 - keep[0] ** 2)
        model = LinearGaussian(transition, noise, observed, gate=np.array([[40.0, 5.0]]))
        values = (off + mean * speed)[:, None]
        first = float(np.median(values[known][:5]))
        start = np.array([first, 0.0, 0.0]), np.diag([100.0**2, spread**2, 1.0])
        likelihood.append(model.filter(values, 1.0, *start).log_likelihood(OUTLIER))
    if likelihood[2] < max(likelihood[:2]) + MARGIN and not evident:
        return None
    found = model.smooth(values, 1.0, *start)
    value, moving = mean + found.means[:, 1], speed > 2.0
    if not moving.any() or float(np.mean(value[moving])) < LEAST_LATE:
        return None
    return Lateness(np.maximum(value, 0.0), found.std[:, 1])


@njit(cache=True)  # type: ignore[untyped-decorator]
def _at(grid: FloatArray, seconds: float) -> float:
    """A value of a grid of whole seconds, linear between them."""
    low = int(np.floor(seconds))
    if low < 0:
        return float(grid[0])
    if low >= grid.size - 1:
        return float(grid[-1])
    return float(grid[low] + (seconds - low) * (grid[low + 1] - grid[low]))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _sources(
    age: int,
    phase: int,
    step: float,
    gap: float,
    cost: FloatArray,
    likeliest: int,
    limit: float,
    source: IntArray,
    price: FloatArray,
) -> int:
    """From which states one is reached, and for what; how many there are.

    State ``3 age + phase``; a path whose offset is another one begins with a source below 0.
    """
    found = 0
    count = cost.size // 3
    replay = REPLAY if age > gap - 4.0 else REPLAY + OTHER
    replays = gap > 0.0 and age <= gap + 3.0
    seconds = int(np.round(step))
    if phase == STEADY:
        for before in range(3):
            source[found], price[found] = 3 * age + before, 0.0
            found += 1
        source[found], price[found] = -1 - (3 * age + OFF), DOUBT
        found += 1
        for other in (age - 1, age + 1):
            if 0 <= other < count:
                source[found], price[found] = 3 * other, DRIFT
                found += 1
        source[found] = likeliest
        price[found] = RETURN if age == 0 else (replay if replays else LEAP)
        found += 1
    elif phase == CATCHING:
        if seconds <= 3:
            for more in range(0, FASTEST * max(seconds, 1) + 1):
                if age + more >= count:
                    break
                source[found], price[found] = 3 * (age + more) + CATCHING, CATCHING_RATE * step
                found += 1
                if more:
                    source[found], price[found] = 3 * (age + more), CATCH_UP
                    found += 1
        if seconds > 0 and age >= seconds:
            for before in (STEADY, CATCHING):
                source[found], price[found] = 3 * (age - seconds) + before, DRIFT
                found += 1
        if replays and age > 0:
            source[found], price[found] = likeliest, replay + 1.0
            found += 1
    else:
        for before in (STEADY, CATCHING):
            source[found], price[found] = 3 * age + before, WRONG
            found += 1
        source[found], price[found] = 3 * age + OFF, WRONG_RATE * step
        found += 1
    kept = 0
    for k in range(found):
        state = source[k] if source[k] >= 0 else -1 - source[k]
        if cost[state] < limit:
            source[kept], price[kept] = source[k], price[k]
            kept += 1
    return kept


@njit(cache=True)  # type: ignore[untyped-decorator]
def _best_path(
    seconds: FloatArray,
    along: FloatArray,
    variance: FloatArray,
    weight: FloatArray,
    gap: FloatArray,
    driven: FloatArray,
    unsure: FloatArray,
    count: int,
) -> IntArray:
    """Age, phase, and whether the speed was wrong, of each fix on the best path, (3, n)."""
    n, states = seconds.size, 3 * count
    before = np.full((n, states), -1, dtype=np.int32)
    doubts = np.zeros((n, states), dtype=np.bool_)
    cost, offset, spread, shown = (
        np.zeros(states), np.zeros(states), np.zeros(states), np.zeros(states)
    )  # fmt: skip
    next_cost, next_offset, next_spread, next_shown = (
        np.zeros(states), np.zeros(states), np.zeros(states), np.zeros(states)
    )  # fmt: skip
    source, price = np.zeros(64, dtype=np.int64), np.zeros(64)
    for state in range(states):
        cost[state] = np.inf
        if state % 3 == STEADY:
            cost[state] = 0.0 if state == 0 else 8.0
            shown[state] = seconds[0] - state // 3
            offset[state] = along[0] - _at(driven, shown[state])
            spread[state] = variance[0]
    for i in range(1, n):
        step = seconds[i] - seconds[i - 1]
        likeliest = int(np.argmin(cost))
        limit = cost[likeliest] + BEAM
        for state in range(states):
            next_cost[state] = np.inf
            age, phase = state // 3, state % 3
            here = seconds[i] - age
            found = _sources(age, phase, step, gap[i], cost, likeliest, limit, source, price)
            for k in range(found):
                loose = source[k] < 0
                origin = -1 - source[k] if loose else source[k]
                total = cost[origin] + price[k] + (OLD_RATE * step if age > 0 else 0.0)
                if total >= next_cost[state]:
                    continue
                if phase == OFF:
                    next_cost[state], next_offset[state] = total, offset[origin]
                    next_spread[state], next_shown[state] = spread[origin], shown[origin]
                    before[i, state], doubts[i, state] = origin, False
                    continue
                # The place that is shown does not go back in time.
                if here < shown[origin] - 0.5:
                    continue
                own = variance[i]
                if phase == CATCHING:
                    # Ages between whole seconds.
                    own += (_at(driven, here + 0.5) - _at(driven, here - 0.5)) ** 2 / 12.0
                grown = max(_at(unsure, here) - _at(unsure, shown[origin]), 0.0)
                prior = spread[origin] + grown + (DOUBTED_STD**2 if loose else 0.0)
                innovation = along[i] - _at(driven, here) - offset[origin]
                both = prior + own
                misfit = 0.5 * innovation**2 / both
                # A single fix may be off, but not the one that shows another state.
                if misfit >= OUTLIER and origin != state:
                    continue
                # An offset that was hardly known before is not known to be the same.
                if origin % 3 == OFF and not loose and prior > SURE_OFFSET**2:
                    continue
                total += weight[i] * (
                    min(misfit, OUTLIER) + min(0.5 * np.log(both / variance[i]), UNSURE)
                )
                if total >= next_cost[state]:
                    continue
                gain = prior / both if misfit < OUTLIER else 0.0
                next_cost[state] = total
                next_offset[state] = offset[origin] + gain * innovation
                next_spread[state] = (1.0 - gain) * prior
                next_shown[state] = max(here, shown[origin])
                before[i, state], doubts[i, state] = origin, loose
        cost, next_cost = next_cost, cost
        offset, next_offset = next_offset, offset
        spread, next_spread = next_spread, spread
        shown, next_shown = next_shown, shown
    path = np.zeros((3, n), dtype=np.int64)
    state = int(np.argmin(cost))
    doubting = True
    for i in range(n - 1, -1, -1):
        path[0, i], path[1, i] = state // 3, state % 3
        path[2, i] = doubting and state % 3 == OFF
        if state % 3 != OFF:
            doubting = doubts[i, state]
        state = before[i, state]
    return path

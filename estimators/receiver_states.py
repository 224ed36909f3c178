"""What a receiver does at each fix: it measures, replays old fixes, shows late or wrong ones.

The hidden variable is the *age* of a fix: a fix at time t shows the place at t - age. A receiver
that measures has age 0; one that holds its place grows older by a second a second; one that works
off what it kept while it saw no sky begins as old as the gap was long, and either stays so or
catches up; one that filters is late by some seconds that change slowly. With the integral D of a
speed, or D growing evenly at the usual speed where none is measured,

    c[i] = D(s[i]) + b(s[i]) + v[i],  s[i] = t[i] - age[i],  db = w ds + walk.

The offset b walks as the integral errs; its rate w, by how much the train is faster than usual, is
a first-order Markov process, and 0 where a speed is measured. `receiver_states` finds the sequence
of ages that is the most probable: Viterbi's algorithm over whole seconds of age and four phases
(steady, catching up, off, back), each path with its own Kalman filter of b and w that runs in the
time s that is shown. Where the positions are off and b is the same afterwards, the positions were
wrong; where b is another one, the speed was. A path that comes back from wrong places is kept
beside the one that was never off until it knows its rate.

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
from estimators.motion import reach
from trainlog.arrays import BoolArray, FloatArray, IntArray

OLDEST = 70
"""Largest age [s] that is looked for; ages are whole seconds."""

SPACING = 2.0
"""Time [s] within which one fix is judged for all."""

INDEPENDENT = 10.0
"""Time [s] after which errors of positions are independent; closer fixes count as a part of one,
but for how far the train came between them."""

LEAST_GAP, LEAST_STEPS = 4.0, 1.8
"""Gap [s], and in usual steps, after which a receiver may replay what it kept."""

WALK = 1.0
"""Random walk of the integral of a speed that is good [m²/s]."""

REPLAY, RETURN, CATCH_UP, DRIFT, LEAP, WRONG, DOUBT = 5.0, 5.0, 3.0, 4.0, 14.0, 6.0, 16.0
"""How improbable (minus the logarithm) it is that a receiver begins to replay after a gap, returns
to measuring, begins to catch up, becomes a second older or younger, shows any other age all at
once, shows wrong places (of fixes that count in full), and that the speed was wrong meanwhile."""

OTHER = 4.0
"""The same, on top of `REPLAY`, of an age that is not that of the gap."""

OLD_RATE, CATCHING_RATE, WRONG_RATE = 0.01, 0.05, 0.35
"""The same, a second [1/s], of going on to show old, younger and wrong places."""

BRAKING, STARTING = 1.3, 1.0
"""Deceleration and acceleration [m/s²] that no train exceeds while nothing is received."""

EDGE, UNSTEADY = 4.0, 0.25
"""Time [s] over which the speed beside a gap is taken, and how much it changes [m/s²]."""

FASTEST = 3
"""Seconds of age that a receiver makes up for in a second: it replays four times as fast."""

UNSURE, OUTLIER = 2.0, 10.0
"""What a fix costs at most where it is not known where it should be; what makes it a wrong one."""

DOUBTED_STD = 3_000.0
"""Standard deviation [m] of what a wrong speed changes the offset by."""

SURE_OFFSET = 200.0
"""Standard deviation [m] of the offset up to which it shows that places were wrong."""

BEAM = 30.0
"""Paths that are so much less probable than the best one are given up."""

STEADY, CATCHING, OFF, BACK, PHASES = 0, 1, 2, 3, 4

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
    speed_std: float = 0.0,
    speed_time: float = 1.0,
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
    speed_std, speed_time : float [m/s], [s]
        Where no speed was measured: how much the train's departs from that of `driven`, and for
        how long it stays alike.

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

    The same without a speed, but for the usual one of 15 m/s:

    >>> even, std, none = 15.0 * time, np.full(300, 4.0), np.zeros(300)
    >>> found = receiver_states(time, along, std, even, none, speed_std=7.0, speed_time=20.0)
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
    gap = np.where(apart > max(LEAST_GAP, LEAST_STEPS * usual), apart, 0.0)
    weight = np.minimum(np.maximum(apart, SPACING) / INDEPENDENT, 1.0)
    halted = np.zeros(rows.size)
    if speed_std > 0.0:
        halted = _halted(seconds[rows], along[rows], std[rows], gap)
    even = np.arange(0.0, seconds[-1] + 2.0)
    distance, variance = (np.interp(even, seconds, each) for each in (driven, unsure))
    count = int(min(OLDEST, max(float(gap.max()) + 5.0, 12.0)))
    age, phase, doubtful = _best_path(
        seconds[rows], along[rows], std[rows] ** 2, weight, gap, halted, distance,
        variance + WALK * even, speed_std, speed_time, count,
    )  # fmt: skip
    # Each fix is in the state of the last one that was judged.
    owner = np.maximum(np.searchsorted(rows, known, side="right") - 1, 0)
    ages, off, doubts = (np.zeros(seconds.size, dtype=np.int64) for _ in range(3))
    ages[known], off[known], doubts[known] = age[owner], (phase == OFF)[owner], doubtful[owner]
    return ReceiverStates(ages, (off > 0) & (doubts == 0), doubts > 0)


def _halted(seconds: FloatArray, along: FloatArray, std: FloatArray, gap: FloatArray) -> FloatArray:
    """How improbable the way across each gap is by what it takes to brake and to start again.

    A train that is shown where it was before the gap, and as fast, can hardly have stopped there.
    """
    costs = np.zeros(seconds.size)
    for after in np.flatnonzero(gap):
        before = after - 1
        first = np.searchsorted(seconds, seconds[before] - EDGE)
        last = min(int(np.searchsorted(seconds, seconds[after] + EDGE)), seconds.size - 1)
        if gap[first + 1 : after].any() or gap[after + 1 : last + 1].any() or first == before:
            continue
        spans = seconds[before] - seconds[first], seconds[last] - seconds[after]
        if min(spans) <= 0.0:
            continue
        pace = (along[before] - along[first]) / spans[0], (along[last] - along[after]) / spans[1]
        unsure = [np.hypot(0.5 * std[after] / span, UNSTEADY * span) for span in spans]
        if min(pace) <= 0.0:
            continue
        took = gap[after]
        least, _ = reach(pace, took, STARTING, BRAKING)
        short = least - (along[after] - along[before])
        # How long it brakes and starts: an error of its speeds is one of the way for as long.
        braking = np.clip((pace[0] - pace[1] + STARTING * took) / (STARTING + BRAKING), 0.0, took)
        braking = min(braking, pace[0] / BRAKING)
        starting = min(took - braking, pace[1] / STARTING)
        spread = np.sqrt(
            2.0 * std[after] ** 2 + (braking * unsure[0]) ** 2 + (starting * unsure[1]) ** 2
        )
        costs[after] = min(0.5 * (max(short, 0.0) / spread) ** 2, OUTLIER)
    return costs


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
    # Replayed fixes are no more probable if all may be a little late.
    if likelihood[1] < likelihood[0] + MARGIN:
        return None
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
    weight: float,
    cost: FloatArray,
    likeliest: int,
    limit: float,
    source: IntArray,
    price: FloatArray,
) -> int:
    """From which states one is reached, and for what; how many there are.

    State ``4 age + phase``; a path whose offset is another one begins with a source below 0.
    """
    found = 0
    count = cost.size // PHASES
    own = PHASES * age
    replay = REPLAY if age > gap - 4.0 else REPLAY + OTHER
    replays = gap > 0.0 and age <= gap + 3.0
    seconds = int(np.round(step))
    if phase in (STEADY, BACK):
        source[0], price[0] = own + phase, 0.0
        source[1], price[1] = own + (CATCHING if phase == STEADY else OFF), 0.0
        source[2], price[2] = (own + BACK, 0.0) if phase == STEADY else (-1 - (own + OFF), DOUBT)
        found = 3
    if phase == STEADY:
        for other in (age - 1, age + 1):
            if 0 <= other < count:
                source[found], price[found] = PHASES * other, DRIFT
                found += 1
        if age == 0:
            for other in range(1, count):
                for before in (STEADY, CATCHING, BACK):
                    source[found], price[found] = PHASES * other + before, RETURN
                    found += 1
        else:
            source[found], price[found] = likeliest, replay if replays else LEAP
            found += 1
    elif phase == CATCHING:
        for more in range(0, FASTEST * max(seconds, 1) + 1):
            if age + more >= count:
                break
            before = own + PHASES * more
            source[found], price[found] = before + CATCHING, CATCHING_RATE * step
            found += 1
            if more:
                source[found], price[found] = before, CATCH_UP
                found += 1
        if seconds > 0 and age >= seconds:
            for before in (STEADY, CATCHING):
                source[found], price[found] = own - PHASES * seconds + before, DRIFT
                found += 1
        if replays and age > 0:
            source[found], price[found] = likeliest, replay + 1.0
            found += 1
    elif phase == OFF:
        for before in (STEADY, CATCHING, BACK):
            source[found], price[found] = own + before, WRONG * weight
            found += 1
        source[found], price[found] = own + OFF, WRONG_RATE * step
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
    halted: FloatArray,
    driven: FloatArray,
    unsure: FloatArray,
    speed_std: float,
    speed_time: float,
    count: int,
) -> IntArray:
    """Age, phase, and whether the speed was wrong, of each fix on the best path, (3, n).

    Of each path: the time that was last shown, offset, rate, and their covariance (00, 01, 11).
    """
    n, states = seconds.size, PHASES * count
    before = np.full((n, states), -1, dtype=np.int32)
    doubts = np.zeros((n, states), dtype=np.bool_)
    cost, next_cost = np.zeros(states), np.zeros(states)
    paths, next_paths = np.zeros((states, 6)), np.zeros((states, 6))
    source, price = np.zeros(2 * states, dtype=np.int64), np.zeros(2 * states)
    for state in range(states):
        cost[state] = np.inf
        if state % PHASES == STEADY:
            cost[state] = 0.0 if state == 0 else 8.0
            here = seconds[0] - state // PHASES
            paths[state, 0], paths[state, 1] = here, along[0] - _at(driven, here)
            paths[state, 3] = variance[0]
            paths[state, 5] = speed_std**2
    for i in range(1, n):
        step = seconds[i] - seconds[i - 1]
        likeliest = int(np.argmin(cost))
        limit = cost[likeliest] + BEAM
        for state in range(states):
            next_cost[state] = np.inf
            age, phase = state // PHASES, state % PHASES
            here = seconds[i] - age
            found = _sources(
                age, phase, step, gap[i], np.sqrt(weight[i]), cost, likeliest, limit, source, price
            )
            for k in range(found):
                loose = source[k] < 0
                origin = -1 - source[k] if loose else source[k]
                total = cost[origin] + price[k] + (OLD_RATE * step if age > 0 else 0.0)
                if total >= next_cost[state]:
                    continue
                if phase == OFF:
                    next_cost[state], next_paths[state] = total, paths[origin]
                    before[i, state], doubts[i, state] = origin, False
                    continue
                since, offset, rate, spread, shared, rate_spread = paths[origin]
                # The place that is shown does not go back in time.
                if here < since - 0.5:
                    continue
                own = variance[i]
                if phase == CATCHING:
                    # Ages between whole seconds.
                    pace = _at(driven, here + 0.5) - _at(driven, here - 0.5) + rate
                    own += pace**2 / 12.0
                lasts = max(here - since, 0.0)
                if lasts > 0.5 * step and origin % PHASES != OFF:
                    total += halted[i]
                spread += max(_at(unsure, here) - _at(unsure, since), 0.0)
                if speed_std > 0.0:
                    keep = np.exp(-lasts / speed_time)
                    way = speed_time * (1.0 - keep)
                    offset += way * rate
                    rate *= keep
                    spread += way * (2.0 * shared + way * rate_spread)
                    spread += speed_std**2 * (2.0 * speed_time * (lasts - way) - way**2)
                    shared = (
                        keep * (shared + way * rate_spread) + (speed_std * way) ** 2 / speed_time
                    )
                    rate_spread = keep**2 * rate_spread + speed_std**2 * (1.0 - keep**2)
                # An offset, or a rate, that is hardly known is not known to be the same.
                measured = speed_std == 0.0
                if origin % PHASES == OFF and measured and not loose and spread > SURE_OFFSET**2:
                    continue
                if origin % PHASES == BACK and phase == STEADY and 2.0 * rate_spread > speed_std**2:
                    continue
                if loose:
                    spread += DOUBTED_STD**2
                innovation = along[i] - _at(driven, here) - offset
                both = spread + own
                misfit = 0.5 * innovation**2 / both
                if misfit >= OUTLIER:
                    continue
                # Errors of close fixes are alike, how far a train came between them is not.
                counts = weight[i] + (1.0 - weight[i]) * (spread / both) ** 2
                total += counts * misfit
                total += weight[i] * min(0.5 * np.log(both / variance[i]), UNSURE)
                if total >= next_cost[state]:
                    continue
                next_cost[state] = total
                path = next_paths[state]
                path[0], path[1], path[2] = max(here, since), offset, rate
                path[3], path[4], path[5] = spread, shared, rate_spread
                gain, rate_gain = spread / both, shared / both
                path[1] += gain * innovation
                path[2] += rate_gain * innovation
                path[3] -= gain * spread
                path[4] -= gain * shared
                path[5] -= rate_gain * shared
                before[i, state], doubts[i, state] = origin, loose
        cost, next_cost = next_cost, cost
        paths, next_paths = next_paths, paths
    found = np.zeros((3, n), dtype=np.int64)
    state = int(np.argmin(cost))
    doubting = True
    for i in range(n - 1, -1, -1):
        found[0, i], found[1, i] = state // PHASES, state % PHASES
        found[2, i] = doubting and state % PHASES == OFF
        if state % PHASES != OFF:
            doubting = doubts[i, state]
        state = before[i, state]
    return found

"""A lower bound from multipliers: weak duality, evaluated for the relaxation without solving it.

Whatever the multipliers are, the least value of the Lagrange function over the relaxation's
remaining limits (see `relaxation`) is below the energy of every trajectory. With the multipliers
of an optimum it comes as close as the relaxation itself. Given the multipliers the function falls
apart: efforts into single cells, where the least value stands in a corner, and each
configuration's speeds into one convex chain, which a few Newton steps minimise.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from analysis.trajectory.convex import power_cells
from analysis.trajectory.linearised import Multipliers
from analysis.trajectory.problem import Problem
from analysis.trajectory.relaxation import MEAN_SPEED

FloatArray = NDArray[np.float64]

_NEWTON_STEPS = 60


def lower_bound(
    problem: Problem,
    multipliers: Multipliers,
    speeds: FloatArray,
    running_time: float,
    spare: FloatArray,
) -> float:
    """No trajectory of the discretised problem has less worst-case energy than this [J/kg].

    Parameters
    ----------
    problem : Problem
    multipliers : Multipliers
        Of any plan; those of the optimum give the highest bound.
    speeds : (q, n + 1) array [m/s]
        Where the search for the least value of the speeds begins.
    running_time : float [s]
    spare : (q,) array [s]
        By how much the cells' mean speeds may make a configuration seem later than it is, and
        where it must not pass earlier than some time, earlier.

    Returns
    -------
    float
        May be any amount below the energy, ``-inf`` included, if the multipliers are bad.
    """
    step, train, multipliers = problem.step, problem.run.train, multipliers.convex()
    decay = 2.0 * problem.drag2 * step
    mean = np.where(np.abs(decay) > 1e-9, -np.expm1(-decay) / np.where(decay, decay, 1.0), 1.0)
    push = step * mean
    motion = multipliers.pull / (push * problem.gain[:, None])
    power, dynamic_power, tau = _time_left(problem, multipliers)

    price, regained = step, np.zeros(problem.shape)
    if problem.run.at_line:
        price = step / train.efficiency_traction
        share = multipliers.share / max(float(multipliers.share.sum()), 1e-300)
        regained = train.efficiency_regeneration * share[:, None] * step
    effort = price - multipliers.pull.sum(axis=0) + power.sum(axis=0)
    total = float((problem.traction * np.minimum(effort, 0.0)).sum())
    total += _brakes(problem, multipliers.pull, dynamic_power - regained)
    total += float((motion * push * problem.mean_drag0).sum())
    total -= float(multipliers.time @ (running_time + spare))
    for price, latest in zip(multipliers.passing.T, problem.latest.tolist(), strict=True):
        if latest < np.inf:
            total -= float(price @ (latest + spare))
    for price, earliest in zip(multipliers.opening.T, problem.earliest.tolist(), strict=True):
        if earliest > -np.inf:
            total += float(price @ (earliest - spare))

    square = np.zeros(speeds.shape)
    square[:, 1:] += motion
    square[:, :-1] -= np.exp(-decay) * motion
    linear = np.zeros(speeds.shape)
    half = 0.5 * problem.drag1[:, None] * push * motion
    linear[:, 1:] += half
    linear[:, :-1] += half
    ceiling = np.append(problem.ceiling[:-1], problem.final_ceiling)
    low, high = np.zeros(speeds.shape), np.tile(np.sqrt(2.0 * ceiling), (problem.shape[0], 1))
    low[:] = np.minimum(np.sqrt(2.0 * problem.floor), high)
    low[:, 0] = high[:, 0] = np.sqrt(2.0 * problem.initial)
    # A positive weight of z drives it down to the square of w, a negative one up to its limit;
    # but no speed is below its square over the limit, so that w is then not below z's chord.
    linear[:, 1:] += 0.5 * np.minimum(square, 0.0)[:, 1:] * high[:, 1:]
    total += float(square[:, 0].sum() * problem.initial)
    square[:, 0] = 0.0
    for a in range(problem.shape[0]):
        total += _chain(
            np.clip(speeds[a], low[a], high[a]), np.maximum(square[a], 0.0), linear[a], tau[a],
            low[a], high[a], _NEWTON_STEPS,
        )  # fmt: skip
    return total


def _time_left(
    problem: Problem, multipliers: Multipliers
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Multipliers of the power limits, lowered where they would outweigh the time's.

    Returns them and what is left of the time's multiplier for each cell, (q, n) arrays.
    """
    time = multipliers.cell_prices(problem) * problem.step
    allowed, braked = np.zeros(problem.shape), np.zeros(problem.shape)
    for a, power in enumerate(problem.power.tolist()):
        at = power_cells(problem, power, problem.traction)
        allowed[a, at] = multipliers.power[a, at]
        at = power_cells(problem, problem.dynamic_power, problem.dynamic[a])
        braked[a, at] = multipliers.dynamic_power[a, at]
    used = problem.power[:, None] * allowed + problem.dynamic_power * braked
    share = np.minimum(1.0, time / np.maximum(used, 1e-300))
    return share * allowed, share * braked, np.maximum(time - share * used, 0.0)


def _brakes(problem: Problem, pull: FloatArray, dynamic: FloatArray) -> float:
    """Least value of ``pull · braking + dynamic · dynamic brake``: in a corner of each cell."""
    spare = MEAN_SPEED * (problem.drag1 / problem.gain)[:, None]
    most, friction = problem.braking + spare, problem.friction + spare
    most = np.minimum(most, problem.dynamic + friction)
    if problem.common:
        most = np.broadcast_to(most.min(axis=0), most.shape)
    corners = [np.zeros(problem.shape), most, *problem.dynamic[:, None], *friction[:, None]]
    if not problem.common:
        corners = [np.zeros(problem.shape), most, problem.dynamic, friction]
    values = []
    for corner in corners:
        braking = np.clip(np.broadcast_to(corner, problem.shape), 0.0, most)
        least = np.maximum(braking - friction, 0.0)
        largest = np.minimum(braking, problem.dynamic)
        value = pull * braking + np.minimum(dynamic * least, dynamic * largest)
        values.append(value.sum(axis=0) if problem.common else value)
    return float(np.min(values, axis=0).sum())


@njit(cache=True)  # type: ignore[untyped-decorator]
def _slopes(
    w: FloatArray, square: FloatArray, linear: FloatArray, tau: FloatArray
) -> tuple[float, FloatArray]:
    """Value and gradient of ``sum square w²/2 + linear w + 2 tau / (w + w')``."""
    n = tau.size
    value, gradient = 0.0, square * w + linear
    for k in range(n + 1):
        value += (0.5 * square[k] * w[k] + linear[k]) * w[k]
    for k in range(n):
        if tau[k] > 0.0:
            both = max(w[k] + w[k + 1], 1e-12)
            value += 2.0 * tau[k] / both
            gradient[k] -= 2.0 * tau[k] / both**2
            gradient[k + 1] -= 2.0 * tau[k] / both**2
    return value, gradient


@njit(cache=True)  # type: ignore[untyped-decorator]
def _chain(
    w: FloatArray, square: FloatArray, linear: FloatArray, tau: FloatArray,
    low: FloatArray, high: FloatArray, steps: int,
) -> float:  # fmt: skip
    """A value that the least of the chain's function between the bounds is not below.

    Newton's method on the speeds that are not held by a bound; the function is convex, so its
    tangent anywhere bounds it, and the tangent's least value is what is returned.
    """
    n = tau.size
    best = -np.inf
    for _ in range(steps):
        value, gradient = _slopes(w, square, linear, tau)
        certain = value
        for k in range(n + 1):
            reach = low[k] - w[k] if gradient[k] > 0.0 else high[k] - w[k]
            certain += gradient[k] * reach
        best = max(best, certain)
        if value - certain <= 1e-9 * (abs(value) + 1.0):
            break
        diagonal, beside = square.copy(), np.zeros(n)
        for k in range(n):
            bend = 4.0 * tau[k] / max(w[k] + w[k + 1], 1e-12) ** 3
            diagonal[k] += bend
            diagonal[k + 1] += bend
            beside[k] = bend
        right = -gradient
        for k in range(n + 1):
            held = (w[k] <= low[k] and gradient[k] > 0.0) or (w[k] >= high[k] and gradient[k] < 0.0)
            if held or high[k] <= low[k]:
                diagonal[k], right[k] = 1.0, 0.0
                if k > 0:
                    beside[k - 1] = 0.0
                if k < n:
                    beside[k] = 0.0
        diagonal[0] = max(diagonal[0], 1e-12)
        for k in range(n):
            factor = beside[k] / diagonal[k]
            diagonal[k + 1] = max(diagonal[k + 1] - factor * beside[k], 1e-12)
            right[k + 1] -= factor * right[k]
        right[n] /= diagonal[n]
        for k in range(n - 1, -1, -1):
            right[k] = (right[k] - beside[k] * right[k + 1]) / diagonal[k]
        size = 1.0
        for _again in range(30):
            trial = np.minimum(np.maximum(w + size * right, low), high)
            reached, _g = _slopes(trial, square, linear, tau)
            if reached <= value:
                break
            size *= 0.5
        w = trial
    return best

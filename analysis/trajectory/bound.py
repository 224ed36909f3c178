"""A lower bound of the energy from multipliers: weak duality, without solving anything.

The bound is evaluated for the relaxation (see `convex`). Whatever the multipliers are, the least
value of the Lagrange function over the relaxation's remaining limits is below the energy of every
trajectory. With the multipliers of an optimum it comes as close as the relaxation itself. Given the
multipliers the function falls apart: efforts into single cells, where the least value stands in a
corner, and each configuration's speeds into one convex chain, which a few Newton steps minimise.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dptsv

from analysis.trajectory.convex import MEAN_SPEED, SLOW, Multipliers, power_cells, reachable
from analysis.trajectory.curves import Bounds, Curves
from analysis.trajectory.discretisation import DiscreteProblem, Plan
from analysis.trajectory.rollout import cell_times, realise
from trainlog.arrays import FloatArray

_NEWTON_STEPS = 60


def lower_bound(
    problem: DiscreteProblem,
    multipliers: Multipliers,
    speeds: FloatArray,
    running_time: float,
    spare: FloatArray,
    fastest: FloatArray | None = None,
) -> float:
    """No trajectory of the discretised problem has less worst-case energy than this [J/kg].

    Parameters as `_lower_bound`; the higher of the bounds by either tangent of curves of effort,
    which need not hold beyond the speeds of the `fastest` run of each configuration.
    """
    curved = problem.curves is not None or problem.dynamic_curves is not None
    reach = reachable(problem, fastest)
    return max(
        _lower_bound(problem, multipliers, speeds, running_time, spare, reach, squares)
        for squares in ((False, True) if curved else (False,))
    )


def _lower_bound(
    problem: DiscreteProblem,
    multipliers: Multipliers,
    speeds: FloatArray,
    running_time: float,
    spare: FloatArray,
    reach: FloatArray,
    squares: bool,
) -> float:
    """The bound with one kind of tangents, see `lower_bound`.

    Parameters
    ----------
    problem : DiscreteProblem
    multipliers : Multipliers
        Of any plan; those of the optimum give the highest bound.
    speeds : (q, n + 1) array [m/s]
        Where the search for the least value of the speeds begins.
    running_time : float [s]
    spare : (q,) array [s]
        By how much the cells' mean speeds may make a configuration seem later than it is, and
        where it must not pass earlier than some time, earlier.
    reach : (q, n + 1) array [m/s]
        Speeds that no configuration exceeds.
    squares : bool
        See `Curves.bounds`.

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
    pull, brake = (
        bounds(problem, speeds, reach, multipliers, squares)
        for bounds in (_traction_bounds, _dynamic_bounds)
    )
    power, dynamic_power, tau = _time_left(problem, multipliers, pull, brake)

    price, regained = step, np.zeros(problem.shape)
    if problem.run.at_line:
        price = step / train.efficiency_traction
        share = multipliers.share / max(float(multipliers.share.sum()), 1e-300)
        regained = train.efficiency_regeneration * share[:, None] * step
    effort = price - multipliers.pull.sum(axis=0) + power.sum(axis=0)
    total = float((problem.traction * np.minimum(effort, 0.0)).sum())
    total += _brakes(problem, multipliers.pull, dynamic_power - regained)
    total -= float((power * pull.offset).sum() + (dynamic_power * brake.offset).sum())
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
    by_square = power * pull.square + dynamic_power * brake.square
    square[:, 1:] -= 0.5 * by_square
    square[:, :-1] -= 0.5 * by_square
    linear = np.zeros(speeds.shape)
    half = 0.5 * problem.drag1[:, None] * push * motion
    half = half - 0.5 * (power * pull.slope + dynamic_power * brake.slope)
    linear[:, 1:] += half
    linear[:, :-1] += half
    ceiling = np.append(problem.ceiling[:-1], problem.final_ceiling)
    low, high = np.zeros(speeds.shape), np.tile(np.sqrt(2.0 * ceiling), (problem.shape[0], 1))
    high = np.minimum(high, reach)
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
            low[a], high[a],
        )  # fmt: skip
    return total


def _traction_bounds(
    problem: DiscreteProblem,
    speeds: FloatArray,
    reach: FloatArray,
    multipliers: Multipliers,
    squares: bool,
) -> Bounds:
    """Of traction by power or curve, the lower at speeds (q, n + 1); (q, n) arrays."""
    power = np.broadcast_to(problem.power[:, None], problem.shape)
    time = multipliers.cell_prices(problem) * problem.step
    most = time / np.maximum(multipliers.power, 1e-300)
    return _bounds_of(problem.curves, power, speeds, reach, most, squares)


def _dynamic_bounds(
    problem: DiscreteProblem,
    speeds: FloatArray,
    reach: FloatArray,
    multipliers: Multipliers,
    squares: bool,
) -> Bounds:
    """Of the dynamic brake."""
    power = np.full(problem.shape, problem.dynamic_power)
    time = multipliers.cell_prices(problem) * problem.step
    most = time / np.maximum(multipliers.dynamic_power, 1e-300)
    return _bounds_of(problem.dynamic_curves, power, speeds, reach, most, squares)


def _bounds_of(
    curves: Curves | None,
    power: FloatArray,
    speeds: FloatArray,
    reach: FloatArray,
    most: FloatArray,
    squares: bool,
) -> Bounds:
    none = np.zeros(power.shape)
    by_power = Bounds(none, power, none, none)
    if curves is None:
        return by_power
    mean = np.maximum(0.5 * (speeds[:, :-1] + speeds[:, 1:]), SLOW)
    reach = np.maximum(reach[:, :-1], reach[:, 1:])
    rows = [
        curves.bounds(row, v, reach[row], most[row], squares=squares) for row, v in enumerate(mean)
    ]
    found = Bounds(*(np.array(each) for each in zip(*rows, strict=True)))
    lower = (found.at(mean) < by_power.at(mean)) | (power > most)
    return Bounds(*(np.where(lower, *pair) for pair in zip(found, by_power, strict=True)))


def _time_left(
    problem: DiscreteProblem, multipliers: Multipliers, pull: Bounds, brake: Bounds
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Multipliers of the power limits, lowered where they would outweigh the time's.

    Returns them and what is left of the time's multiplier for each cell, (q, n) arrays.
    """
    time = multipliers.cell_prices(problem) * problem.step
    allowed, braked = np.zeros(problem.shape), np.zeros(problem.shape)
    for a, power in enumerate(problem.power.tolist()):
        at = power_cells(problem, power, problem.traction)
        if problem.curves is not None:
            at = np.arange(problem.shape[1])
        allowed[a, at] = multipliers.power[a, at]
        at = power_cells(problem, problem.dynamic_power, problem.dynamic[a])
        if problem.dynamic_curves is not None:
            at = np.arange(problem.shape[1])
        braked[a, at] = multipliers.dynamic_power[a, at]
    used = pull.power * allowed + brake.power * braked
    share = np.minimum(1.0, time / np.maximum(used, 1e-300))
    return share * allowed, share * braked, np.maximum(time - share * used, 0.0)


def _brakes(problem: DiscreteProblem, pull: FloatArray, dynamic: FloatArray) -> float:
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


def _slopes(
    w: FloatArray, square: FloatArray, linear: FloatArray, tau: FloatArray
) -> tuple[float, FloatArray]:
    """Value and gradient of ``sum square w²/2 + linear w + 2 tau / (w + w')``."""
    both = np.maximum(w[:-1] + w[1:], 1e-12)
    times = 2.0 * tau / both
    gradient = square * w + linear
    gradient[:-1] -= times / both
    gradient[1:] -= times / both
    return float((0.5 * square * w + linear) @ w + times.sum()), gradient


def _chain(
    w: FloatArray,
    square: FloatArray,
    linear: FloatArray,
    tau: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> float:
    """A value that the least of the chain's function between the bounds is not below.

    Newton's method on the speeds that are not held by a bound; the function is convex, so its
    tangent anywhere bounds it, and the tangent's least value is what is returned.
    """
    best = -np.inf
    for _ in range(_NEWTON_STEPS):
        value, gradient = _slopes(w, square, linear, tau)
        certain = value + float(gradient @ (np.where(gradient > 0.0, low, high) - w))
        best = max(best, certain)
        if value - certain <= 1e-9 * (abs(value) + 1.0):
            break
        step = _newton_step(w, square, gradient, tau, low, high)
        for size in 0.5 ** np.arange(30.0):
            trial = np.clip(w + size * step, low, high)
            if _slopes(trial, square, linear, tau)[0] <= value:
                break
        w = trial
    return best


def _newton_step(
    w: FloatArray,
    square: FloatArray,
    gradient: FloatArray,
    tau: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """The step to where the gradient of the speeds that no bound holds is zero."""
    bend = 4.0 * tau / np.maximum(w[:-1] + w[1:], 1e-12) ** 3
    diagonal = square + np.append(bend, 0.0) + np.insert(bend, 0, 0.0)
    held = ((w <= low) & (gradient > 0.0)) | ((w >= high) & (gradient < 0.0)) | (high <= low)
    beside = np.where(held[:-1] | held[1:], 0.0, bend)
    # A little more than it is, that speeds on which nothing depends do not make it singular.
    diagonal = np.where(held, 1.0, diagonal * (1.0 + 1e-12) + 1e-12)
    _, _, step, failed = dptsv(diagonal, beside, np.where(held, 0.0, -gradient))
    return -gradient / diagonal if failed else np.asarray(step)


def spare_times(problem: DiscreteProblem, plan: Plan) -> FloatArray:
    """By how much the true times are shorter than those by the mean speeds of the cells [s].

    The bounds take the latter; they pay for the difference.
    """
    driven = realise(problem, plan)
    speed = np.sqrt(2.0 * driven.z)
    model = 2.0 * problem.step / (speed[:, :-1] + speed[:, 1:])
    ahead = np.cumsum(model - cell_times(problem, driven), axis=1)
    if np.isfinite(problem.earliest).any():
        ahead = np.abs(ahead)
    return np.asarray(np.maximum(ahead.max(axis=1), 0.0))

"""The configurations driven under a common traction: rollouts and delays.

All configurations share the traction; each brakes for itself, or all alike. A run at a given pace
(full traction up to a cruising speed, hold it, brake at the last moment) is where the optimiser
starts; how a configuration drives that was not optimised for is rolled out under the traction
found.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from analysis.trajectory.discretisation import DiscreteProblem, Plan, taper_along
from analysis.trajectory.envelope import braking_curves, motion_of
from trainlog.arrays import FloatArray
from trainlog.railway.motion import (
    Motion,
    advance,
    advance_all,
    cell_of,
    effort_at,
    landing,
    landing_all,
    speed_of,
    traverse,
)
from trainlog.railway.resistance import NO_CURVE

_TRIALS = 6
"""Of how much friction a configuration has to brake with to arrive in time."""

_TAPERINGS = 2
"""How often traction is tapered along a run."""

_FALSI = 24
"""Most turns of the search for the traction that power allows in a cell."""

_CRAWL = 0.5 * 0.3**2
"""``z`` that a common brake leaves to the slowest configuration between the stops [m²/s²]."""

_ROUNDING = 1e-6
"""What a time that is computed has to spare, relative."""

LEAST_TIME_MARGIN = 1.5e-4
"""What a least time has to spare, relative: next to it a millisecond costs a thousandth of the
energy, and neither plan nor bound can follow."""


def paced_run(problem: DiscreteProblem, running_time: float, halvings: int = 12) -> Plan:
    """The run at the slowest cruising speed that keeps `running_time` [s], or the fastest one.

    The speed is found by so many `halvings` of the interval that it is in.
    """
    curves = braking_curves(problem)
    slow, fast = 1.0, float(np.sqrt(2.0 * problem.ceiling.max()))
    plan = _run_at(problem, curves, fast)
    if duration(problem, plan) >= running_time:
        return plan
    for _ in range(halvings):
        middle = 0.5 * (slow + fast)
        trial = _run_at(problem, curves, middle)
        if duration(problem, trial) > running_time:
            slow = middle
        else:
            fast, plan = middle, trial
    return plan


def run_together(problem: DiscreteProblem, speeds: FloatArray) -> tuple[DiscreteProblem, Plan]:
    """The fastest run of all below given speeds, with the traction tapered along it.

    Where each brakes for itself nobody is faster than the slowest could be, so that no other's
    power limits it more than it has to.

    Parameters
    ----------
    problem : DiscreteProblem
        Not tapered.
    speeds : (q, n + 1) array [m/s]
        Of a run of each configuration by itself.

    Returns
    -------
    DiscreteProblem, Plan
        The tapered problem, and the run in it.
    """
    times = (2.0 * problem.step / (speeds[:, :-1] + speeds[:, 1:])).sum(axis=1)
    v = np.broadcast_to(speeds.min(axis=0), speeds.shape)
    plan = _plan_of(problem, v, int(np.argmax(times)))
    for _ in range(_TAPERINGS):
        tapered = problem.tapered(taper_along(problem, plan))
        curves = braking_curves(tapered)
        if not problem.common:
            curves = np.minimum(curves, 0.5 * v**2)
        plan = _run_at(tapered, curves, float(v.max()))
    return tapered, plan


def least_time_together(problem: DiscreteProblem, speeds: FloatArray) -> float:
    """Time [s] in which all arrive under one common traction.

    Slightly above that of the fastest run of the slowest by itself, whose traction follows the
    power from metre to metre.

    Parameters
    ----------
    problem : DiscreteProblem
        Not tapered.
    speeds : (q, n + 1) array [m/s]
        Of the fastest run of each configuration.
    """
    fastest = paced_run(problem, 0.0)
    tapered = problem.tapered(taper_along(problem, fastest))
    times = [duration(each, paced_run(each, 0.0)) for each in (problem, tapered)]
    # One that runs ahead of the slowest would leave it less power.
    times.append(duration(*run_together(problem, speeds)))
    return min(times) * (1.0 + _ROUNDING)


def capped_run(
    problem: DiscreteProblem, speeds: FloatArray, running_time: float
) -> tuple[Plan, FloatArray]:
    """The fastest run cut off at a cruising speed, and about what a second of it is worth.

    It keeps the running time and the speed limits, and takes what efforts that needs: where the
    iterations of the optimiser begin.

    Parameters
    ----------
    speeds : (q, n + 1) array [m/s]
        Of the fastest run of each configuration.
    running_time : float [s]

    Returns
    -------
    plan : Plan
    price : (q,) array [J/(kg s)]
        That of the slowest configuration; 0 for the others.
    """

    def times(cruising: float) -> FloatArray:
        v = np.minimum(speeds, cruising)
        return np.asarray((2.0 * problem.step / (v[:, :-1] + v[:, 1:])).sum(axis=1))

    slow, fast = 0.5, float(speeds.max())
    for _ in range(40):
        middle = 0.5 * (slow + fast)
        slow, fast = (middle, fast) if times(middle).max() > running_time else (slow, middle)
    slowest = int(np.argmax(times(fast)))
    plan = _plan_of(problem, np.minimum(speeds, fast), slowest)
    slower = _plan_of(problem, np.minimum(speeds, 0.98 * fast), slowest)
    saved = float(problem.step @ (plan.traction - slower.traction))
    price = np.zeros(problem.shape[0])
    before, after = float(times(fast)[slowest]), float(times(0.98 * fast)[slowest])
    gained = after - before if before < np.inf else np.inf
    # At standstill on the way, or with no speed left to lose, no second has a price.
    price[slowest] = max(saved, 0.0) / gained if 0.0 < gained < np.inf else 0.0
    return plan, price


def _plan_of(problem: DiscreteProblem, speeds: FloatArray, row: int) -> Plan:
    """The efforts that given speeds take, the common traction after the configuration `row`."""
    z, mean = 0.5 * speeds**2, 0.5 * (speeds[:, :-1] + speeds[:, 1:])
    drag = problem.mean_drag0 + problem.drag1[:, None] * mean
    drag += problem.drag2 * (z[:, :-1] + z[:, 1:])
    net = (np.diff(z, axis=1) / problem.step + drag) / problem.gain[:, None]
    traction = np.clip(net[row], 0.0, problem.traction)
    braking = np.clip(traction - net, 0.0, problem.braking)
    if problem.common:
        braking = np.broadcast_to(braking[row], braking.shape)
    return Plan(z, traction, braking, dynamic_share(problem, z, braking))


def duration(problem: DiscreteProblem, plan: Plan) -> float:
    """Running time [s] of the slowest configuration."""
    return float(cell_times(problem, plan).sum(axis=1).max())


def delays(
    problem: DiscreteProblem, plan: Plan, running_time: float
) -> tuple[FloatArray, FloatArray]:
    """How late and how early each configuration is at worst [s], (q,) arrays; negative if in time.

    At the end, and at the passing points.
    """
    times = np.cumsum(cell_times(problem, plan), axis=1)
    passing = times[:, problem.passed - 1]
    # One that stands before a point that may be passed at any time is late at the end alone.
    bounded = np.isfinite(problem.latest)
    tardy = passing[:, bounded] - problem.latest[bounded]
    late = np.column_stack((times[:, -1] - running_time, tardy))
    early = np.column_stack((np.full(times.shape[0], -np.inf), problem.earliest - passing))
    return late.max(axis=1), early.max(axis=1)


def cell_times(problem: DiscreteProblem, plan: Plan) -> FloatArray:
    """Time [s] of each configuration in each cell, (q, n)."""
    return integrate_cells(problem, plan)[1]


def integrate_cells(problem: DiscreteProblem, plan: Plan) -> tuple[FloatArray, FloatArray]:
    """Each cell by itself: ``z`` at its end, and the time in it [s]; (q, n)."""
    effort = problem.gain[:, None] * (plan.traction - plan.braking)
    reached, times = traverse(plan.z, effort, motion_of(problem))
    return reached, times


def drive(problem: DiscreteProblem, plan: Plan) -> Plan:
    """Drive the plan: common traction as planned, the brake as it takes to meet planned speeds.

    With common braking the plan's effort is applied as it is. Where a configuration does not
    brake its speed is what the traction makes it.
    """
    none = np.full(plan.z.shape, np.inf)
    if problem.common:
        z, _ = _brake_below(problem, none, plan.traction - plan.braking)
        braking = np.array(plan.braking)
    else:
        none[:, 1:][plan.braking > 0.0] = plan.z[:, 1:][plan.braking > 0.0]
        z, braking = _brake_below(problem, none, np.tile(plan.traction, (plan.z.shape[0], 1)))
    return Plan(z, plan.traction, braking, np.minimum(plan.dynamic, braking))


def realise(problem: DiscreteProblem, plan: Plan) -> Plan:
    """The plan as it is driven.

    With common braking the efforts are applied as they are. Otherwise each configuration makes the
    best of the common traction and brakes as late as it may; unless this would return less energy
    to the line than the worst planned, or it must not pass too early: then it keeps to the planned
    speeds.
    """
    if problem.common:
        return drive(problem, plan)
    late = rollout(problem, plan.traction, None)
    # A configuration that brakes as late as possible may pass too early.
    early = np.isfinite(problem.earliest).any()
    if problem.run.at_line or early:
        driven = drive(problem, plan)
        planned, found = driven.dynamic @ problem.step, late.dynamic @ problem.step
        least = planned if problem.run.objective == "expected" else planned.min()
        rows = np.full(found.shape, early) | (found < least)
        late.put(rows, driven, rows)
    return late


def rollout(problem: DiscreteProblem, traction: FloatArray, braking: FloatArray | None) -> Plan:
    """How each configuration runs under a given common traction, braking as late as it may.

    Parameters
    ----------
    traction : (n,) array [m/s²]
    braking : (n,) array [m/s²] or None
        The common braking effort; None where each configuration brakes for itself.
    """
    q, n = problem.shape
    if braking is not None:
        everyone = np.broadcast_to(braking, (q, n))
        z = np.broadcast_to(problem.ceiling, (q, n + 1)).copy()
        z[:, 0] = problem.initial
        return drive(problem, Plan(z, traction, everyone, np.minimum(everyone, problem.dynamic)))
    return _rollout_below(problem, traction, braking_curves(problem, traction))


def rollout_gently(problem: DiscreteProblem, driven: Plan, running_time: float) -> Plan:
    """How each configuration runs under the same traction, with little friction and in time.

    It brakes the earlier the less friction there is, and the dynamic brake takes more: with the
    least share of it, from 0 to 1, with which it is in time.

    Parameters
    ----------
    problem : DiscreteProblem
    driven : Plan
    running_time : float [s]
    """
    traction, q = driven.traction, problem.shape[0]
    curves = braking_curves(problem, traction)
    found = _rollout_below(problem, traction, curves)
    low, high = np.zeros(q), np.ones(q)
    for turn in range(_TRIALS):
        share = low if turn == 0 else 0.5 * (low + high)
        gentle = _dynamic_brake_curves(problem, traction, curves, share)
        trial = _rollout_below(problem, traction, gentle)
        late = delays(problem, trial, running_time)[0] > 0.0
        found.put(~late, trial, ~late)
        if turn == 0:
            high = np.where(late, high, 0.0)
            continue
        low, high = np.where(late, share, low), np.where(late, high, share)
    return found


def _dynamic_brake_curves(
    problem: DiscreteProblem,
    traction: FloatArray,
    curves: FloatArray,
    friction: FloatArray,
) -> FloatArray:
    """The braking curves of the dynamic brake, for those that it can bring to a stand.

    With a share of the `friction` brake besides, (q,).
    """
    others = friction[:, None] * problem.friction
    limit = np.minimum(problem.braking, problem.dynamic + others)
    gentle = braking_curves(replace(problem, braking=limit, friction=others), traction)
    able = np.all(gentle[:, 1:-1] > 0.0, axis=1) & (gentle[:, 0] >= problem.initial)
    return np.where(able[:, None], gentle, curves)


def rollout_at(problem: DiscreteProblem, driven: Plan, planned: FloatArray) -> Plan:
    """How each configuration runs under the same traction, nowhere faster than planned.

    Parameters
    ----------
    problem : DiscreteProblem
    driven : Plan
    planned : (q, n + 1) array [m²/s²]
    """
    curves = braking_curves(problem, driven.traction)
    return _rollout_below(problem, driven.traction, np.minimum(curves, planned))


def _rollout_below(problem: DiscreteProblem, traction: FloatArray, curves: FloatArray) -> Plan:
    """Given traction, and the brake as late as the `curves` allow."""
    z, braking = _brake_below(problem, curves, np.tile(traction, (problem.shape[0], 1)))
    return Plan(z, traction, braking, dynamic_share(problem, z, braking))


def _brake_below(
    problem: DiscreteProblem, curves: FloatArray, effort: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``z`` under given efforts, (q, n), and what the brake adds to stay below the `curves`."""
    z, braking = brake_below(curves, effort, problem.initial, motion_of(problem))
    return z, braking


def energy_of(problem: DiscreteProblem, plan: Plan) -> float:
    """What the run minimises of a plan as it is driven: worst or expected energy [J/kg]."""
    run = problem.run
    wheel = float(plan.traction @ problem.step)
    if not run.at_line:
        return wheel
    train = run.train
    regained = train.efficiency_regeneration * (plan.dynamic @ problem.step)
    least = problem.weights @ regained if run.objective == "expected" else regained.min()
    return float(wheel / train.efficiency_traction - least)


def dynamic_share(problem: DiscreteProblem, z: FloatArray, braking: FloatArray) -> FloatArray:
    """The most of `braking` that the dynamic brake can take at these speeds, (q, n) [m/s²]."""
    by_speed = problem.dynamic_by_speed(z, 1e-12)
    return np.asarray(np.minimum(np.minimum(braking, problem.dynamic), by_speed))


def _run_at(problem: DiscreteProblem, curves: FloatArray, cruising_speed: float) -> Plan:
    z, traction, braking = cruise(
        curves, cruising_speed, problem.common, problem.initial, problem.traction, problem.gain,
        problem.power, *_curve_arrays(problem), problem.taper.fall, problem.taper.crest,
        problem.usable_braking, problem.drag0, problem.drag1, problem.drag2, problem.step,
    )  # fmt: skip
    return Plan(z, traction, braking, dynamic_share(problem, z, braking))


def _curve_arrays(problem: DiscreteProblem) -> tuple[FloatArray, FloatArray]:
    """Speeds of each configuration's curve, (q, m), and efforts, (m,), for compiled code."""
    if problem.curves is not None:
        return problem.curves.arrays
    speeds, efforts = NO_CURVE
    return np.tile(speeds, (problem.shape[0], 1)), efforts


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _most_traction(
    z: float, begin: float, highest: float, limits: tuple[float, float, float], speeds: FloatArray,
    efforts: FloatArray, gain: float, drag0: FloatArray, drag1: float, drag2: float, step: float,
) -> float:  # fmt: skip
    """The most traction up to `begin` that the power allows where a cell ends: regula falsi.

    The more it is the faster the cell ends, and the less is allowed; the brake keeps it from being
    faster than `highest` [m²/s²] there. `limits` are the power, the
    part of the curve of effort, and the fall of the taper.
    """
    low, high, under, over = 0.0, begin, 0.0, 0.0
    u = begin
    for turn in range(_FALSI):
        reached, _t = advance(z, gain * u, drag0, drag1, drag2, step)
        v = speed_of(min(reached, highest))
        limit = min(limits[0] / max(v, 1e-9), limits[1] * effort_at(v, speeds, efforts))
        left = min(limit + limits[2], 2.0 * begin) - u
        if left >= 0.0:
            if turn == 0 or left <= 1e-9 * begin:
                return u
            low, under = u, left
            over *= 0.5
        else:
            high, over = u, left
            under *= 0.5
        if turn == 0 or turn % 3 == 2 or under - over <= 0.0:
            u = 0.5 * (low + high)
        else:
            u = low + (high - low) * under / (under - over)
    return low


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def cruise(
    curves: FloatArray, cruising_speed: float, common: bool, initial: float,
    traction: FloatArray, gain: FloatArray, power: FloatArray, speeds: FloatArray,
    efforts: FloatArray, fall: FloatArray, crest: FloatArray, braking: FloatArray,
    drag0: FloatArray, drag1: FloatArray, drag2: FloatArray, step: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """All together: full traction to the cruising speed, hold it, brake along the `curves`.

    Traction tapers by `fall`, and stays below the power by `crest` (see `problem.Taper`).

    Returns ``z`` at the nodes, the common traction, and the braking efforts.
    """
    q, n = drag2.shape
    z = np.empty((q, n + 1))
    z[:, 0] = initial
    effort, brake = np.empty(n), np.zeros((q, n))
    for k in range(n):
        most, hold = traction[k] - abs(fall[k]), abs(fall[k])
        for a in range(q):
            y, cell = z[a, k], (drag0[a, k], drag1[a], drag2[a, k], step[k])
            # Power counts at both ends of the cell.
            usable = power[a] * (1.0 - crest[k])
            part, v = 1.0 - crest[k], speed_of(y)
            limit = min(usable / max(v, 1e-9), part * effort_at(v, speeds[a], efforts))
            begin = min(traction[k] - abs(fall[k]), limit - fall[k])
            highest = np.inf if common else curves[a, k + 1]
            u = _most_traction(
                y, begin, highest, (usable, part, fall[k]), speeds[a], efforts, gain[a], *cell
            )
            most = min(most, u)
            safe = landing(y, curves[a, k + 1], *cell) / gain[a]
            most = min(most, braking[a, k] + safe)
            target = min(curves[a, k + 1], 0.5 * cruising_speed**2)
            hold = max(hold, landing(y, target, *cell) / gain[a])
        effort[k] = max(min(most, hold), 0.0)
        need, leave = 0.0, np.inf
        for a in range(q):
            y, cell = z[a, k], (drag0[a, k], drag1[a], drag2[a, k], step[k])
            reached, _t = advance(y, gain[a] * effort[k], *cell)
            if reached > curves[a, k + 1]:
                safe = landing(y, curves[a, k + 1], *cell) / gain[a]
                brake[a, k] = max(effort[k] - safe, 0.0)
            need = max(need, brake[a, k])
            slowest = landing(y, _CRAWL, *cell) / gain[a]
            leave = min(leave, effort[k] - slowest)
        for a in range(q):
            if common:
                brake[a, k] = max(min(need, leave), 0.0)
            cell = (drag0[a, k], drag1[a], drag2[a, k], step[k])
            z[a, k + 1], _t = advance(z[a, k], gain[a] * (effort[k] - brake[a, k]), *cell)
            if not common:
                z[a, k + 1] = min(z[a, k + 1], curves[a, k + 1])
            z[a, k + 1] = max(z[a, k + 1], 0.0)
    return z, effort, brake


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def brake_below(
    curves: FloatArray, effort: FloatArray, initial: float, motion: Motion
) -> tuple[FloatArray, FloatArray]:
    """Given efforts, and what a brake adds not to come above the `curves`.

    Returns ``z`` at the nodes, and that braking; (q, n + 1) and (q, n) arrays.
    """
    gain, (q, n) = motion.gain, motion.drag2.shape
    z, brake = np.empty((q, n + 1)), np.zeros((q, n))
    y, reached, other = np.full(q, initial), np.empty(q), np.empty(q)
    z[:, 0] = initial
    for k in range(n):
        cell, given, highest = cell_of(motion, k), effort[:, k].copy(), curves[:, k + 1].copy()
        advance_all(y, gain * given, cell, reached, other)
        rows = np.flatnonzero(reached > highest)
        if rows.size:
            landing_all(y, highest, cell, rows, other)
            for a in rows:
                brake[a, k] = max(given[a] - other[a] / gain[a], 0.0)
                reached[a] = highest[a]
        y[:] = np.maximum(reached, 0.0)
        z[:, k + 1] = y
    return z, brake

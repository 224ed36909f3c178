"""A run at a given pace: full traction up to a cruising speed, hold it, brake at the last moment.

All configurations ride together under the common traction. It is where the optimiser starts, and
how a configuration that was not optimised for would drive.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.dynamics import follow_plan, keep_pace, ride_late, traverse
from analysis.trajectory.envelope import braking_curves
from analysis.trajectory.problem import Plan, Problem

FloatArray = NDArray[np.float64]


def paced_run(problem: Problem, running_time: float) -> Plan:
    """The run at the slowest cruising speed that keeps `running_time` [s], or the fastest one."""
    curves = braking_curves(problem)
    slow, fast = 1.0, float(np.sqrt(2.0 * problem.ceiling.max()))
    plan = _run_at(problem, curves, fast)
    if duration(problem, plan) >= running_time:
        return plan
    for _ in range(24):
        middle = 0.5 * (slow + fast)
        trial = _run_at(problem, curves, middle)
        if duration(problem, trial) > running_time:
            slow = middle
        else:
            fast, plan = middle, trial
    return plan


def duration(problem: Problem, plan: Plan) -> float:
    """Running time [s] of the slowest configuration."""
    return float(cell_times(problem, plan).sum(axis=1).max())


def cell_times(problem: Problem, plan: Plan) -> FloatArray:
    """Time [s] of each configuration in each cell, (q, n)."""
    return cross(problem, plan)[1]


def cross(problem: Problem, plan: Plan) -> tuple[FloatArray, FloatArray]:
    """Each cell by itself: ``z`` at its end, and the time in it [s]; (q, n)."""
    effort = problem.gain[:, None] * (plan.traction - plan.braking)
    reached, times = traverse(
        plan.z, effort, problem.drag0, problem.drag1, problem.drag2, problem.step
    )
    return np.asarray(reached), np.asarray(times)


def drive(problem: Problem, plan: Plan) -> Plan:
    """Drive the plan: common traction as planned, the brake as it takes to meet planned speeds.

    With common braking the plan's effort is applied as it is. Where a configuration does not
    brake its speed is what the traction makes it.
    """
    z, braking = follow_plan(
        plan.z, plan.traction, plan.braking, problem.common, problem.gain, problem.drag0,
        problem.drag1, problem.drag2, problem.step,
    )  # fmt: skip
    return Plan(z, plan.traction, braking, np.minimum(plan.dynamic, braking))


def realise(problem: Problem, plan: Plan) -> Plan:
    """The plan as it is driven.

    With common braking the efforts are applied as they are. Otherwise each configuration makes the
    best of the common traction and brakes as late as it may; unless this would return less energy
    to the line than the worst planned, then it keeps to the planned speeds.
    """
    driven = drive(problem, plan)
    if problem.common:
        return driven
    riding = ride_along(problem, plan.traction, None)
    if problem.run.objective == "line":
        planned, found = driven.dynamic @ problem.step, riding.dynamic @ problem.step
        rows = found < planned.min()
        for name in ("z", "braking", "dynamic"):
            getattr(riding, name)[rows] = getattr(driven, name)[rows]
    return riding


def ride_along(problem: Problem, traction: FloatArray, braking: FloatArray | None) -> Plan:
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
    z, braking = ride_late(
        braking_curves(problem, traction), traction, problem.initial, problem.gain, problem.drag0,
        problem.drag1, problem.drag2, problem.step,
    )  # fmt: skip
    return Plan(z, traction, braking, dynamic_share(problem, z, braking))


def dynamic_share(problem: Problem, z: FloatArray, braking: FloatArray) -> FloatArray:
    """The most of `braking` that the dynamic brake can take at these speeds, (q, n) [m/s²]."""
    highest = np.sqrt(2.0 * (np.maximum(z[:, :-1], z[:, 1:]) + problem.bulge + 1e-12))
    by_power = problem.dynamic_power / highest
    return np.asarray(np.minimum(np.minimum(braking, problem.dynamic), by_power))


def _run_at(problem: Problem, curves: FloatArray, cruising_speed: float) -> Plan:
    z, traction, braking = keep_pace(
        curves, cruising_speed, problem.common, problem.initial, problem.traction, problem.gain,
        problem.power, problem.braking, problem.drag0, problem.drag1, problem.drag2, problem.step,
    )  # fmt: skip
    return Plan(z, traction, braking, dynamic_share(problem, z, braking))

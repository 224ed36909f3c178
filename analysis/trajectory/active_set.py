"""Active set over the configurations: optimise for a few, let all ride along, add who cannot.

The optimum for some configurations that all the others can follow is the optimum for all, and the
lower bound for some is one for all. Few are ever active: the slowest, and those short of power.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.convex import NoSolutionError
from analysis.trajectory.minimax import Solution, minimise
from analysis.trajectory.pace import cell_times, paced_run, realise, ride_along
from analysis.trajectory.problem import Plan, Problem
from analysis.trajectory.relaxation import Relaxation
from trainlog.errors import InfeasibleError
from trainlog.units import KMH

FloatArray = NDArray[np.float64]

_LATE = 5e-5
"""Lateness that makes a configuration active [s]."""

_OVER = 5e-7
"""Excess over power, brake, speed or energy that makes a configuration active, relative."""


@dataclass(frozen=True, eq=False)
class Answer:
    """The best plan for all configurations.

    Attributes
    ----------
    plan : Plan
    active : tuple of int
        Rows of the configurations that it was optimised for.
    bound : float [J/kg]
        Lower bound of the worst-case energy, per unit reference inertia.
    bound_status : str
    solution : Solution
        Of the active configurations.
    turns : int
        How often configurations were added, and once more.
    """

    plan: Plan
    active: tuple[int, ...]
    bound: float
    bound_status: str
    solution: Solution
    turns: int


def search(problem: Problem, least_times: FloatArray, running_time: float) -> Answer:
    """The robust optimum.

    Parameters
    ----------
    problem : Problem
        With all configurations.
    least_times : (q,) array [s]
        Of each configuration by itself.
    running_time : float [s]

    Raises
    ------
    InfeasibleError
        If there is no such trajectory; with the figures.
    """
    active = {int(np.argmax(least_times))}
    if problem.common:
        active |= {int(np.argmin(least_times)), int(np.argmin(problem.power))}
    turns = 0
    while True:
        turns += 1
        rows = sorted(active)
        part = problem.select(rows)
        relaxation = Relaxation(part, paced_run(part, running_time))
        try:
            relaxed = relaxation.least_energy(running_time)
        except NoSolutionError as word:
            raise _explained(part, relaxation, running_time, str(word)) from None
        try:
            solution = minimise(part, relaxed.plan, relaxed.time_price, running_time)
        except NoSolutionError as word:
            raise InfeasibleError(
                f"no trajectory found in {running_time:.1f} s on {part.shape[1]} cells: a convex"
                f" step is {word}",
                remedy="allow more time or more cells",
            ) from None
        if solution.lateness > _LATE:
            raise InfeasibleError(
                f"{running_time:.2f} s are {solution.lateness:.2f} s too short for"
                f" {_names(part)} together on {part.shape[1]} cells",
                remedy="allow more time or more cells",
            )
        plan = _all_ride(problem, rows, part, solution.plan)
        new = _violators(problem, plan, running_time, rows)
        if not new:
            # The bound's time is that of constant acceleration in a cell; where the true time is
            # shorter the bound pays for the difference.
            model = _model_times(part, realise(part, solution.plan))
            spare = np.maximum(
                model - cell_times(part, realise(part, solution.plan)).sum(axis=1), 0
            )
            bound = relaxed.bound - float(relaxed.time_price @ spare)
            return Answer(plan, tuple(rows), bound, relaxed.status, solution, turns)
        active |= new


def _all_ride(problem: Problem, rows: list[int], part: Problem, optimum: Plan) -> Plan:
    """The optimum for the active configurations, and how the others follow it."""
    common = optimum.braking[0] if problem.common else None
    riding, driven = ride_along(problem, optimum.traction, common), realise(part, optimum)
    for name in ("z", "braking", "dynamic"):
        getattr(riding, name)[rows] = getattr(driven, name)
    return riding


def _violators(problem: Problem, plan: Plan, running_time: float, active: list[int]) -> set[int]:
    """The worst of the others of each kind: late, short of power or brake, too fast, too dear."""
    fastest = np.sqrt(2.0 * (np.maximum(plan.z[:, :-1], plan.z[:, 1:]) + problem.bulge))
    by_power = problem.dynamic_power / np.maximum(fastest, 1e-6)
    brakes = np.minimum(problem.braking, problem.friction + np.minimum(problem.dynamic, by_power))
    ceiling = np.append(problem.ceiling[:-1], problem.final_ceiling)
    excesses = [
        (cell_times(problem, plan).sum(axis=1) - running_time) * (_OVER / _LATE),
        (plan.traction * fastest).max(axis=1) / problem.power - 1.0,
        ((plan.braking - brakes) / problem.braking.max()).max(axis=1),
        ((plan.z - ceiling) / problem.ceiling.max()).max(axis=1),
    ]
    if problem.run.objective == "line":
        spent = -(plan.dynamic @ problem.step)
        excesses.append((spent - np.median(spent)) / (plan.traction @ problem.step))
    found = set()
    for excess in excesses:
        excess[active] = -np.inf
        if excess.max() > _OVER:
            found.add(int(np.argmax(excess)))
    return found


def _model_times(problem: Problem, plan: Plan) -> FloatArray:
    speed = np.sqrt(2.0 * plan.z)
    return np.asarray((2.0 * problem.step / (speed[:, :-1] + speed[:, 1:])).sum(axis=1))


def _explained(
    problem: Problem, relaxation: Relaxation, running_time: float, word: str
) -> InfeasibleError:
    """Why the relaxation, and so the problem, has no solution."""
    names = _names(problem)
    if problem.common:
        try:
            speed = relaxation.least_end_speed(running_time)
        except NoSolutionError:
            pass
        else:
            return InfeasibleError(
                f"with one braking effort for all, {names} cannot all end below"
                f" {KMH * speed:.1f} km/h, asked for are {KMH * problem.run.final_speed:.1f} km/h",
                remedy="let each configuration brake for itself (recourse), or end faster",
            )
    try:
        time = relaxation.least_time()
    except NoSolutionError:
        return InfeasibleError(f"{names} cannot make this run together: the relaxation is {word}")
    if time <= running_time:
        return InfeasibleError(
            f"the solver of the lower bound gave up: {word}", remedy="more cells"
        )
    return InfeasibleError(
        f"under one common traction {names} need at least {time:.1f} s, the timetable gives"
        f" {running_time:.1f} s: {time - running_time:.1f} s are missing",
        remedy=f"allow at least {np.ceil(time):.0f} s",
    )


def _names(problem: Problem) -> str:
    names = [f"'{configuration.name}'" for configuration in problem.run.configurations]
    return f"configuration{'s' * (len(names) > 1)} {', '.join(names)}"

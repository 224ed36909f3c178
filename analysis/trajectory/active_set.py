"""Active set over the configurations: optimise for a few, let all ride along, add who cannot.

The optimum for some configurations that all the others can follow is the optimum for all, and the
lower bound for some is one for all. Few are ever active: the slowest, and those short of power.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.convex import NoSolutionError
from analysis.trajectory.minimax import Solution, minimise
from analysis.trajectory.pace import cell_times, paced_run, realise, ride_along
from analysis.trajectory.problem import Plan, Problem
from analysis.trajectory.relaxation import Relaxation, Relaxed
from trainlog.errors import InfeasibleError
from trainlog.units import KMH

FloatArray = NDArray[np.float64]

_LATE = 5e-5
"""Lateness that makes a configuration active [s]."""

_FAR_BEHIND = 0.5
"""Lateness that makes a configuration active before the optimum is refined [s]."""

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
    active = {int(np.argmax(least_times)), _dearest(problem, least_times)}
    if problem.common:
        active |= {int(np.argmin(least_times)), int(np.argmin(problem.power))}
    turns = 0
    while True:
        turns += 1
        rows = sorted(active)
        part = problem.select(rows)
        relaxed = _relaxed(part, running_time)
        late = cell_times(problem, _all_ride(problem, rows, part, relaxed.plan)).sum(axis=1)
        if late.max() > max(running_time, late[rows].max()) + _FAR_BEHIND:
            active |= _worst(late, running_time)
            continue
        solution = _optimum(part, relaxed, running_time)
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
    found: set[int] = set()
    for excess in excesses:
        excess[active] = -np.inf
        found |= _worst(excess, _OVER)
    return found


def _worst(amounts: FloatArray, limit: float) -> set[int]:
    """The worst configuration beyond `limit`, and the next if it is nearly half as bad."""
    first, second = np.argsort(-amounts)[:2] if amounts.size > 1 else (0, 0)
    excess = amounts - limit
    if excess[first] <= 0.0:
        return set()
    return {int(first), int(second)} if excess[second] > 0.4 * excess[first] else {int(first)}


def _model_times(problem: Problem, plan: Plan) -> FloatArray:
    speed = np.sqrt(2.0 * plan.z)
    return np.asarray((2.0 * problem.step / (speed[:, :-1] + speed[:, 1:])).sum(axis=1))


def _dearest(problem: Problem, least_times: FloatArray) -> int:
    """The configuration of the highest resistance at the mean speed of the fastest runs."""
    speed = float(problem.step.sum()) / float(np.median(least_times))
    drag = problem.drag1 * speed + problem.drag2.mean(axis=1) * speed**2
    drag += (problem.mean_drag0 @ problem.step) / problem.step.sum()
    return int(np.argmax(drag / problem.gain))


def _relaxed(problem: Problem, running_time: float) -> Relaxed:
    """The relaxation for these configurations.

    Raises
    ------
    InfeasibleError
        With what is missing: time, or with common braking a higher speed at the end.
    """
    relaxation = Relaxation(problem, paced_run(problem, running_time))
    try:
        return relaxation.least_energy(running_time)
    except NoSolutionError as word:
        if problem.common:
            raise _brakes_explained(problem, running_time) from None
        raise _time_explained(problem, relaxation, running_time, str(word)) from None


def _optimum(problem: Problem, relaxed: Relaxed, running_time: float) -> Solution:
    """The optimum for these configurations, from their relaxation.

    Raises
    ------
    InfeasibleError
        As `_relaxed`, where the relaxation has a solution and the problem none.
    """
    try:
        solution = minimise(problem, relaxed.plan, relaxed.time_price, running_time)
        word = f"{solution.lateness:.2f} s are missing"
    except NoSolutionError as failure:
        solution, word = None, f"a convex step is {failure}"
    if solution is not None and solution.lateness <= _LATE:
        return solution
    if problem.common:
        raise _brakes_explained(problem, running_time)
    raise InfeasibleError(
        f"{running_time:.2f} s are not enough for {_names(problem)} under one common traction on"
        f" {problem.shape[1]} cells: {word}",
        remedy="allow more time or more cells",
    )


def _time_explained(
    problem: Problem, relaxation: Relaxation, running_time: float, word: str
) -> InfeasibleError:
    """Why the relaxation, and so the problem, has no solution."""
    names = _names(problem)
    try:
        time = relaxation.least_time()
    except NoSolutionError:
        return InfeasibleError(f"no common run of {names}: the relaxation is {word}")
    if time <= running_time:
        return InfeasibleError(f"the convex solver gave up: {word}", remedy="allow more cells")
    return InfeasibleError(
        f"under one common traction, in {problem.shape[1]} cells, at least {time:.1f} s are needed"
        f" by {names}; the timetable gives {running_time:.1f} s, {time - running_time:.1f} s are"
        " missing",
        remedy=f"allow at least {np.ceil(time):.0f} s",
    )


def _brakes_explained(problem: Problem, running_time: float) -> InfeasibleError:
    """The lowest speed to which one braking effort brings them all, to 0.05 m/s."""
    names = _names(problem)

    def reached(speed: float) -> bool:
        trial = replace(problem, final=0.5 * speed**2)
        try:
            relaxed = Relaxation(trial, paced_run(trial, running_time)).least_energy(running_time)
            solution = minimise(trial, relaxed.plan, relaxed.time_price, running_time, rounds=12)
        except NoSolutionError:
            return False
        return solution.lateness <= _LATE

    low, high = float(np.sqrt(2.0 * problem.final)), float(np.sqrt(2.0 * problem.ceiling[-1]))
    if not reached(high):
        return InfeasibleError(
            f"with one braking effort for all, {names} cannot keep {running_time:.1f} s whatever"
            " their speed at the end",
            remedy="allow more time, or let each configuration brake for itself (recourse)",
        )
    while high - low > 0.05:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if reached(middle) else (middle, high)
    return InfeasibleError(
        f"with one braking effort for all, {names} cannot all end below {KMH * high:.1f} km/h in"
        f" {running_time:.1f} s; asked for are {KMH * problem.run.final_speed:.1f} km/h",
        remedy="let each configuration brake for itself (recourse), or end faster",
    )


def _names(problem: Problem) -> str:
    names = [f"'{configuration.name}'" for configuration in problem.run.configurations]
    return f"configuration{'s' * (len(names) > 1)} {', '.join(names)}"

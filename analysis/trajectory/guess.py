"""Where the search for a trajectory begins, and what it ends with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.trajectory.discretisation import DiscreteProblem, Plan
from analysis.trajectory.rollout import (
    capped_run,
)
from analysis.trajectory.sqp import (
    Solution,
)
from trainlog.arrays import FloatArray

INACTIVE = 1e-3
"""Switching function below which a configuration is inactive, and leaves a prepared set."""


@dataclass(frozen=True, eq=False)
class Guess:
    """Where a search begins: some configurations, their plan, and what a second is worth to each.

    Attributes
    ----------
    rows : tuple of int
    plan : Plan
        Of these configurations, as the price.
    price : (rows,) array [J/(kg s)]
    statuses : tuple of str
        The solver's status of every program so far.
    """

    rows: tuple[int, ...]
    plan: Plan
    price: FloatArray
    statuses: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Answer:
    """The best plan for all configurations.

    Attributes
    ----------
    problem : DiscreteProblem
        With the traction tapered as the plan has it.
    plan : Plan
    active : tuple of int
        Rows of the configurations that it was optimised for.
    solution : Solution
        Of the active configurations.
    turns : int
        How often configurations were added, and once more.
    statuses : tuple of str
        The solver's status of every program.
    """

    problem: DiscreteProblem
    plan: Plan
    active: tuple[int, ...]
    solution: Solution
    turns: int
    statuses: tuple[str, ...]


def initial_guess(problem: DiscreteProblem, speeds: FloatArray, running_time: float) -> Guess:
    """The slowest configuration and that of the highest resistance, their fastest run cut off.

    Where a window of time opens on the way, the fastest too; all, where all count.

    Parameters
    ----------
    speeds : (q, n + 1) array [m/s]
        Of the fastest run of each configuration.
    """
    times = (2.0 * problem.step / (speeds[:, :-1] + speeds[:, 1:])).sum(axis=1)
    rows = {int(np.argmax(times)), _highest_resistance(problem, times)}
    if problem.common:
        rows |= {int(np.argmin(times)), int(np.argmin(problem.power))}
    if np.isfinite(problem.earliest).any():
        rows |= {int(np.argmin(times))}
    if problem.run.objective == "expected":
        rows |= set(np.flatnonzero(problem.weights).tolist())
    chosen = tuple(sorted(rows))
    part = problem.select(chosen)
    return Guess(chosen, *capped_run(part, speeds[list(chosen)], running_time))


def interpolated_guess(answer: Answer, coarse: FloatArray, problem: DiscreteProblem) -> Guess:
    """What was found on one grid, interpolated to another one.

    Parameters
    ----------
    answer : Answer
        For all configurations.
    coarse : (m + 1,) array [m]
        Its grid.
    problem : DiscreteProblem
    """
    solution, positions = answer.solution, problem.positions
    influence = np.abs(solution.multipliers.pull / np.diff(coarse)).max(axis=1)
    active = np.flatnonzero(influence > INACTIVE)
    if active.size == 0 or problem.common or problem.run.objective == "expected":
        active = np.arange(len(answer.active))
    plan = solution.plan
    cell = np.searchsorted(coarse, 0.5 * (positions[1:] + positions[:-1])) - 1
    cell = np.clip(cell, 0, coarse.size - 2)
    z = np.array([np.interp(positions, coarse, plan.z[row]) for row in active])
    guess = Plan(
        z, plan.traction[cell], *(e[active][:, cell] for e in (plan.braking, plan.dynamic))
    )
    chosen = tuple(answer.active[row] for row in active)
    return Guess(chosen, guess, solution.time_price[active], answer.statuses)


def _highest_resistance(problem: DiscreteProblem, least_times: FloatArray) -> int:
    """The configuration of the highest resistance at the mean speed of the fastest runs."""
    speed = float(problem.step.sum()) / float(np.median(least_times))
    drag = problem.drag1 * speed + problem.drag2.mean(axis=1) * speed**2
    drag += (problem.mean_drag0 @ problem.step) / problem.step.sum()
    return int(np.argmax(drag / problem.gain))

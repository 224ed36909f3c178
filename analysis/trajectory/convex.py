"""What the quadratic programs and the cone relaxation share: the solver, and the common limits."""

from __future__ import annotations

import warnings
from typing import Any

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.problem import Problem

FloatArray = NDArray[np.float64]

SLOW = 0.2
"""Speeds below this are scaled as if they were this [m/s]."""


class NoSolutionError(Exception):
    """The solver's word when it is not a solution: infeasible, unbounded, or a failure."""


def solve(objective: Any, rules: list[Any]) -> tuple[cp.Problem, str]:
    """Minimise, and accept nothing but a solution.

    Raises
    ------
    NoSolutionError
        With the solver's word.
    """
    program = cp.Problem(cp.Minimize(objective), [rule for rule in rules if rule.size])
    try:
        with warnings.catch_warnings():
            # The status says what the warning would, and the certificate carries it.
            warnings.filterwarnings("ignore", "Solution may be inaccurate", UserWarning)
            program.solve(solver=cp.CLARABEL)
    except cp.SolverError as error:
        raise NoSolutionError(f"failed: {error}") from error
    if program.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise NoSolutionError(str(program.status))
    return program, str(program.status)


def effort(problem: Problem, traction: cp.Variable, braking: cp.Variable) -> Any:
    """Common traction less the brakes, (q, n)."""
    q, n = problem.shape
    ones = np.ones((q, 1))
    return ones @ cp.reshape(traction, (1, n), order="C") - each_brakes(problem, braking)


def each_brakes(problem: Problem, braking: cp.Variable) -> Any:
    """Braking effort of each configuration, (q, n)."""
    return np.ones((problem.shape[0], 1)) @ braking if problem.common else braking


def worst_energy(problem: Problem, traction: cp.Variable, dynamic: cp.Variable | None) -> Any:
    """Eq. (9), energy at the wheel; or at the line, of the worst configuration, eq. (1)."""
    train, spent = problem.run.train, problem.step @ traction
    if problem.run.objective == "wheel" or dynamic is None:
        return spent
    regained = train.efficiency_regeneration * cp.min(dynamic @ problem.step)
    return spent / train.efficiency_traction - regained


def effort_rules(
    problem: Problem,
    traction: cp.Variable,
    braking: cp.Variable,
    dynamic: cp.Variable | None,
    spare: FloatArray,
) -> list[Any]:
    """Eq. (6) and (7), and how dynamic and friction brake share the effort.

    Parameters
    ----------
    spare : (q, 1) array [m/s²]
        What the brake may do beyond its limits, and against its sense where negative.
    """
    low, high = np.minimum(spare, 0.0), problem.braking + np.maximum(spare, 0.0)
    if problem.common:
        low, high = low.min(axis=0, keepdims=True), high.min(axis=0, keepdims=True)
    rules = [traction >= 0.0, traction <= problem.traction, braking >= low, braking <= high]
    if dynamic is None:
        return rules
    brakes = each_brakes(problem, braking)
    return [
        *rules,
        dynamic >= 0.0,
        dynamic <= problem.dynamic,
        dynamic <= brakes + np.maximum(-spare, 0.0),
        brakes - dynamic <= problem.friction + np.maximum(spare, 0.0),
    ]


def tells_dynamic(problem: Problem) -> bool:
    """Whether the dynamic brake must be told apart: for its energy, or for its power limit."""
    return problem.run.objective == "line" or bool(np.any(problem.friction < problem.braking))


def power_cells(problem: Problem, power: float, most: FloatArray) -> NDArray[np.int64]:
    """Cells in which a power limit can be stricter than the effort limit `most`."""
    fastest = np.sqrt(2.0 * np.maximum(problem.ceiling[:-1], problem.ceiling[1:]))
    return np.flatnonzero(power / fastest < most)

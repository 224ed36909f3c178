"""Sequential convex programming for the robust minimax problem; paper 002, eq. (1)-(10).

Each round lets CVXPY solve a quadratic program about the last plan, until nothing changes any more.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.convex import NoSolutionError
from analysis.trajectory.linearised import Round, Solution
from analysis.trajectory.pace import delays, realise
from analysis.trajectory.problem import Plan, Problem, taper_for

FloatArray = NDArray[np.float64]

NEXT_TO_NOTHING = 1e-3
"""Energy next to which differences are not told [J/kg]: that of a train at 5 cm/s."""

_LATENESS_PRICE = 100.0
"""Price of lateness over the multiplier of the time; more than a feasible run would pay."""

_FREE_ROUNDS = 10
"""Rounds before the steps are made to shrink."""

EVENNESS = 7e-4
"""Price of the squared change of effort from cell to cell [s²/m]."""


def minimise(
    problem: Problem,
    start: Plan,
    time_price: FloatArray,
    running_time: float,
    *,
    rounds: int = 40,
    tolerance: float = 2e-6,
    lateness: float = 3e-5,
    evenness: float = EVENNESS,
) -> Solution:
    """Minimise the worst-case energy, beginning from a plan.

    The time may be exceeded at a price that a feasible problem never pays; what remains tells how
    far from feasible a problem is.

    Parameters
    ----------
    start : Plan
    time_price : (q,) array [J/(kg s)]
        Multiplier of the running time, about.
    running_time : float [s]
    rounds : int
        Most quadratic programs to solve.
    tolerance : float
        Relative change of energy below which a round is the last.
    lateness : float [s]
        That may be left besides.
    evenness : float [s²/m]
        Price of the squared change of effort from cell to cell.

    Raises
    ------
    NoSolutionError
        If the solver finds a round infeasible, or fails.
    """
    plan = start
    price = np.repeat(time_price[:, None], problem.shape[1], axis=1)
    lateness_price = _LATENESS_PRICE * max(float(price.max()), 1.0)
    radius, energy = 1.0, np.inf
    statuses: list[str] = []
    while True:
        tapered = problem.tapered(taper_for(problem, plan))
        program = Round(tapered, plan, price)
        solution = program.solve(running_time, radius, lateness_price, evenness=evenness)
        statuses.extend(solution.statuses)
        plan, price = solution.plan, solution.multipliers.cell_prices(problem)
        late, early = delays(tapered, realise(tapered, plan), running_time)
        off = max(float(late.max()), float(early.max())) - solution.lateness
        changed = min(abs(solution.energy - energy), solution.moved)
        settled = changed <= tolerance * max(solution.energy, NEXT_TO_NOTHING) and off <= lateness
        if settled or len(statuses) == rounds:
            return replace(solution, statuses=tuple(statuses), settled=settled)
        energy = solution.energy
        # The rounds contract by themselves; where they do not, ever smaller steps make them.
        if len(statuses) >= _FREE_ROUNDS:
            radius *= 0.7


def with_costates(problem: Problem, solution: Solution, running_time: float) -> Solution:
    """A solution with the multipliers of its program as it stands, without a price of evenness.

    They are the costates of the robust maximum principle, and give the lower bound. Where the
    solver does not vouch for them, the solution keeps those it has.

    Parameters
    ----------
    solution : Solution
        As `minimise` found it.
    running_time : float [s]
    """
    plan, price = solution.plan, solution.multipliers.cell_prices(problem)
    program = Round(problem, plan, price)
    lateness_price = _LATENESS_PRICE * max(float(price.max()), 1.0)
    try:
        found = program.solve(running_time, 1.0, lateness_price, evenness=0.0)
    except NoSolutionError:
        return solution
    return replace(
        solution,
        multipliers=found.multipliers,
        switching=found.switching,
        statuses=(*solution.statuses, *found.statuses),
    )

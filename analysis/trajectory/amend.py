"""The last fraction of a second: a plan that is nearly in time made to be so, without a program.

At an optimum all cells of partial traction are worth the same: what little is missing may be made
up for in any of them at the price of the optimum, to first order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.pace import delays, realise
from analysis.trajectory.problem import Plan, Problem, most_traction

FloatArray = NDArray[np.float64]

_LATEST = 2e-5
"""Lateness that is left [s]."""

_SOONEST = 5e-4
"""Earliness that is left, worth less than what the programs leave [s]."""

_TRIALS = 8

_FIRST = 0.05
"""Share of its room by which the traction is changed first."""


def amended(problem: Problem, plan: Plan, running_time: float) -> FloatArray | None:
    """A common traction under which all of `problem` are in time, or None if that takes more.

    Parameters
    ----------
    problem : Problem
        Of the configurations that a plan was optimised for.
    plan : Plan
        Nearly in time.
    running_time : float [s]

    Returns
    -------
    (n,) array [m/s²] or None
    """
    room = _room(problem, plan)

    def late(share: float) -> float:
        driven = realise(problem, replace(plan, traction=plan.traction + share * room))
        return float(delays(problem, driven, running_time)[0].max())

    share = _in_time(late)
    return None if share is None else plan.traction + share * room


def _room(problem: Problem, plan: Plan) -> FloatArray:
    """By how much each cell of partial traction may change, (n,) [m/s²]."""
    most, least = most_traction(problem, plan.z), np.abs(problem.taper.fall)
    return np.asarray(np.maximum(np.minimum(plan.traction - least, most - plan.traction), 0.0))


def _in_time(late: Callable[[float], float]) -> float | None:
    """The share at which the lateness is between its bounds, by secants."""
    share, value, slope = 0.0, late(0.0), np.nan
    for _ in range(_TRIALS):
        if -_SOONEST <= value <= _LATEST:
            return share
        # The first step is a guess, later ones follow the slope that was met.
        change = _FIRST * float(np.sign(value)) if np.isnan(slope) else -(value + _LATEST) / slope
        reached = late(share + change) if abs(share + change) <= 1.0 else np.inf
        if not np.isfinite(reached) or reached == value:
            return None
        slope = (reached - value) / change
        share, value = share + change, reached
    return None

"""The lower bound of all trajectories from multipliers of an optimum on cells.

By the least Hamiltonian under the costate that the multipliers are the means of; for a single
configuration with much time, by a value function of second order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.trajectory.convex import Multipliers
from analysis.trajectory.costate import costate_of, held_or_partial
from analysis.trajectory.curvature import applies, least_by_stretch
from analysis.trajectory.discretisation import DiscreteProblem, Plan
from analysis.trajectory.envelope import Envelope
from analysis.trajectory.hamiltonian import Hamiltonian, Prices, Segments
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.arrays import FloatArray

_POINTS = 4
"""Of Gauss and Legendre in each segment."""

_MANY_VALUES = 400_000
"""Of the Hamiltonian, from which half of the points have to do."""

_CLOSE = 5e-4
"""Excess of a plan over the bound, relative, up to which none by curvature is looked for."""

_CHEAP_TIME = 0.5
"""What the running time is worth over the energy, up to which there is much time."""


@dataclass(frozen=True, eq=False)
class ContinuousBound:
    """What no trajectory comes below, however its controls change.

    Attributes
    ----------
    value : float [J/kg]
    excess : (n,) array [J/kg]
        By how much the plan is above it in each cell; where it is large cells are too long.
    """

    value: float
    excess: FloatArray


def continuous_bound(
    problem: DiscreteProblem,
    plan: Plan,
    multipliers: Multipliers,
    fastest: Envelope,
    running_time: float,
    run: TrajectoryProblem,
) -> ContinuousBound:
    """Lower bound of the energy of all trajectories, on these cells or any others.

    Parameters
    ----------
    problem : DiscreteProblem
    plan : Plan
        The optimum of the problem on its cells.
    multipliers : Multipliers
        Its multipliers.
    fastest : Envelope
        Of the same configurations; no trajectory is faster anywhere.
    running_time : float [s]
    run : TrajectoryProblem
        With all configurations, whose traction is one; the problem may be of some of them.
    """
    prices = Prices.of(problem, multipliers.convex())
    points = _POINTS if problem.drag2.size * _POINTS <= _MANY_VALUES else _POINTS // 2
    whole = Segments.of(problem, np.arange(problem.shape[1]), problem.positions, points)
    costate = costate_of(Hamiltonian(problem, plan, prices, fastest, run, whole), multipliers)
    segments, times = costate.segments, prices.of_times(problem, running_time)
    hamiltonian = Hamiltonian(problem, plan, prices, fastest, run, segments)
    values, slopes = costate.along(hamiltonian)
    least, spent = hamiltonian.least(values, slopes), hamiltonian.of_plan(values, slopes)
    energy = float((spent * segments.weights).sum()) + costate.at_nodes - times
    away = float(((spent - least) * segments.weights).sum())
    slack = times <= _CHEAP_TIME * abs(energy) and away > _CLOSE * abs(energy)
    if slack and applies(hamiltonian):
        partial = held_or_partial(hamiltonian, multipliers)
        least = least_by_stretch(hamiltonian, (values, slopes, least), partial)
    total = float((least * segments.weights).sum()) + costate.at_nodes - times
    excess = ((spent - least) * segments.weights).sum(axis=1)
    excess = np.maximum(np.bincount(segments.cell, excess), 0.0)
    # A bound by curvature is one of what takes less than the plan.
    return ContinuousBound(min(total, energy) if slack else total, excess)

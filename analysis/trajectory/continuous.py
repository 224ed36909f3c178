"""The lower bound of all trajectories from multipliers of an optimum on cells.

By the least Hamiltonian under the costate that the multipliers are the means of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.trajectory.convex import Multipliers
from analysis.trajectory.costate import costate_of
from analysis.trajectory.discretisation import DiscreteProblem, Plan
from analysis.trajectory.envelope import Envelope
from analysis.trajectory.hamiltonian import Hamiltonian, Prices, Segments
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.arrays import FloatArray

_POINTS = 4
"""Of Gauss and Legendre in each cell."""


@dataclass(frozen=True, eq=False)
class ContinuousBound:
    """What no trajectory comes below, however its controls change.

    Attributes
    ----------
    value : float [J/kg]
    excess : (n,) array [J/kg]
        By how much the plan is above it in each cell; where it is large cells are too long.
    source : str
        Where its multipliers come from.
    """

    value: float
    excess: FloatArray
    source: str = "multipliers"


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
    segments, times = Segments.of(problem, _POINTS), prices.of_times(problem, running_time)
    hamiltonian = Hamiltonian(problem, plan, prices, fastest, run, segments)
    costate = costate_of(hamiltonian, multipliers)
    values, slopes = costate.along(hamiltonian)
    least, spent = hamiltonian.least(values, slopes), hamiltonian.of_plan(values, slopes)
    total = float((least * segments.weights).sum()) + costate.at_nodes - times
    excess = ((spent - least) * segments.weights).sum(axis=1)
    return ContinuousBound(total, np.maximum(excess, 0.0))

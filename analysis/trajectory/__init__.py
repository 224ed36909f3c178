"""Robust minimax trajectories with a certificate; Cunillera et al. (2022)."""

# The extra is checked before the modules that import it.
# ruff: noqa: E402

from trainlog.extras import require

require("casadi", "cvxpy", "piqp")

from analysis.trajectory.journey import JourneyPlan, optimise_journey
from analysis.trajectory.optimiser import Front, energy_against_time, optimise
from analysis.trajectory.phases import (
    AdvicePoint,
    Phase,
    advice,
    phases_of,
    with_advice,
    write_advice,
)
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem

__all__ = [
    "AdvicePoint",
    "Front",
    "JourneyPlan",
    "OptimiserOptions",
    "Phase",
    "TrajectoryProblem",
    "advice",
    "energy_against_time",
    "optimise",
    "optimise_journey",
    "phases_of",
    "with_advice",
    "write_advice",
]

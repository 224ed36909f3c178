"""Robust minimax trajectories with a certificate; Cunillera et al. (2022)."""

# The extra is checked before the modules that import it.
# ruff: noqa: E402

from trainlog.extras import require

require("casadi", "cvxpy", "piqp")

from analysis.trajectory.journey import JourneyPlan, optimise_journey
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.phases import Phase, phases_of

__all__ = ["JourneyPlan", "Phase", "optimise", "optimise_journey", "phases_of"]

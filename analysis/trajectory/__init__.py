"""Robust minimax trajectories with a certificate; paper 002."""

from analysis.trajectory.journey import JourneyPlan, optimise_journey
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.phases import Phase, phases_of

__all__ = ["JourneyPlan", "Phase", "optimise", "optimise_journey", "phases_of"]

"""Robust minimax trajectories with a certificate; paper 002."""

from analysis.trajectory.optimiser import optimise
from analysis.trajectory.phases import Phase, phases_of

__all__ = ["Phase", "optimise", "phases_of"]

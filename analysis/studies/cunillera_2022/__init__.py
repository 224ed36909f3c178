"""Cunillera et al. (2022): robust minimax trajectories over an observed set."""

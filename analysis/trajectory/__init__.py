"""Robust trajectories."""

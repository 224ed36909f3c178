"""Analyses: what is computed from trips and maps."""

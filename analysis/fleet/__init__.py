"""Analyses of a fleet: one reading of a log for all of them, on engines that exist."""

"""Trips in the Rerun viewer."""

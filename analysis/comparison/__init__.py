"""Trips beside each other: running time, energy and slip."""

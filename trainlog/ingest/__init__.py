"""Recorded formats become trips."""

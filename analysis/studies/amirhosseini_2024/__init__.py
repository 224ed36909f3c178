"""Amirhosseini et al. (2024): recursive least squares and sliding-mode control of a train."""

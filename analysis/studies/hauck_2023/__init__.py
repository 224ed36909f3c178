"""Hauck et al. (2023): map-based model predictive control of a train."""

"""Robust minimax trajectories with a certificate; Cunillera et al. (2022)."""

from trainlog.extras import require

require("casadi", "cvxpy", "piqp")

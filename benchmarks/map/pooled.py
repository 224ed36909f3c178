"""How maps were estimated before they had two time scales: one Gaussian field for all days.

The mode and Laplace spread of an Ornstein-Uhlenbeck process of the log maximum adhesion along the
line, from onsets (Gaussian) and adhesion used without slip (Tobit). Kept for benchmarks to compare
with; its numbers are those that were typed in then.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded
from scipy.special import log_ndtr

from trainlog.railway.adhesion import DRY, WET
from trainlog.railway.condition import AdhesionEstimate, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence

PRIOR = {"dry": DRY.peak, "wet": WET.peak}
OTHER = float(np.sqrt(DRY.peak * WET.peak))
PRIOR_STD, LENGTH, TRIP_STD, MODEL_STD, OBSERVED = 0.4, 120.0, 0.12, 0.04, 0.5


def pooled_estimate(track: TrackConditionMap, layer: str, known: DailyEvidence) -> AdhesionEstimate:
    """The estimate of a layer from all its evidence alike, whatever the day."""
    bins, mean = track.bins, np.log(PRIOR.get(layer, OTHER))
    weight, weighted = known.by_bin("weight"), known.by_bin("weighted_log")
    rows, columns = np.nonzero(known.censored)
    count, level = known.censored[rows, columns], np.log(track.levels)[columns]
    rho = np.exp(-track.bin_length / LENGTH)
    innovation = PRIOR_STD**2 * (1.0 - rho**2)
    prior = np.zeros((2, bins))
    prior[0, 1:] = -rho / innovation
    prior[1] = (1.0 + rho**2) / innovation
    prior[1, [0, -1]] = 1.0 / innovation

    def slopes(field):
        z = (field[rows] - level) / TRIP_STD
        hazard = np.exp(-0.5 * z**2 - 0.5 * np.log(2.0 * np.pi) - log_ndtr(z))
        rise = np.bincount(rows, count * hazard, minlength=bins) / TRIP_STD
        bend = np.bincount(rows, count * hazard * (hazard + z), minlength=bins) / TRIP_STD**2
        d = field - mean
        pull = prior[1] * d
        pull[:-1] += prior[0, 1:] * d[1:]
        pull[1:] += prior[0, 1:] * d[:-1]
        return weighted - weight * field + rise - pull, weight + bend

    field = np.full(bins, mean)
    for _ in range(60):
        gradient, curvature = slopes(field)
        step = solveh_banded(prior + np.array([np.zeros(bins), curvature]), gradient)
        # The posterior is log-concave: a step of at most a quarter keeps Newton's method going.
        field = field + step * min(1.0, 0.25 / max(np.max(np.abs(step)), 1e-12))
        if np.max(np.abs(step)) < 1e-9:
            break
    curvature = slopes(field)[1]
    common = solveh_banded(
        prior + np.array([np.zeros(bins), curvature]), np.sqrt(known.by_bin("common"))
    )
    std = np.sqrt(variance(prior, curvature) + common**2 + MODEL_STD**2)
    observed = (known.by_bin("events") > 0) | (
        np.sqrt(variance(prior, weight)) <= OBSERVED * PRIOR_STD
    )
    return AdhesionEstimate(field, std, observed)


def variance(prior, curvature):
    """Diagonal of the inverse of a tridiagonal matrix, from the pivots of both ends."""
    diagonal, off = prior[1] + curvature, prior[0, 1:]
    forward, backward = diagonal.copy(), diagonal.copy()
    for i in range(1, diagonal.size):
        forward[i] -= off[i - 1] ** 2 / forward[i - 1]
        backward[-1 - i] -= off[-i] ** 2 / backward[-i]
    return 1.0 / (forward + backward - diagonal)

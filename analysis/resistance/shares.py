"""What the sizes of the noise mean for the parameters' covariance.

The covariance C of generalised least squares hangs on the sizes of the noise's causes
(`analysis.resistance.noise`), and these are estimates themselves. From how C and the likelihood
change with the logarithm of each size follow

- how well the sizes are known, and with them C: as many degrees of freedom as a chi-squared
  variable of C's relative variance has. Thousands of windows on a hundred pieces of gradient know
  the map's error from a hundred draws, not from thousands;
- what part of C each cause brings in: with V = sum of sigma_c² V_c,

      C X' V^-1 (sigma_c² V_c) V^-1 X C = 1/2 dC / d ln(sigma_c).

References
----------
Satterthwaite, F. E. (1946), An approximate distribution of estimates of variance components,
Biometrics Bulletin 2(6).
Giesbrecht, F. G., Burns, J. C. (1985), Two-stage analysis based on a mixed model, Biometrics
41(2): the same for restricted likelihood, with its information matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.resistance.noise import CAUSES, Likelihood, NoiseModel

FloatArray = NDArray[np.float64]

STEP = 0.25
"""Of the differences, in standard deviations of what is expected of a size."""

ASKED = 4
"""The first so many parameters are asked for; those after them are nuisances."""


@dataclass(frozen=True, eq=False)
class Shares:
    """How well a covariance is known, and what the map's errors bring into it.

    Attributes
    ----------
    freedom : float
        Degrees of freedom.
    survey : (p, p) array
        The part of the covariance that errors of the map's gradients bring in, and of where they
        change.
    """

    freedom: float
    survey: FloatArray


def shares(likelihood: Likelihood, noise: NoiseModel) -> Shares:
    """The shares at the sizes found.

    Parameters
    ----------
    likelihood : Likelihood
    noise : NoiseModel
        Where it is greatest.
    """
    centre, unit = likelihood.place(noise), STEP * np.eye(len(CAUSES))
    here = likelihood.deviance(centre)
    ahead, behind = ([_judged(likelihood, z) for z in centre + sign * unit] for sign in (1.0, -1.0))
    curvature = np.empty(unit.shape)
    change = np.empty(len(CAUSES))
    survey = np.zeros_like(ahead[0][1])
    for k, cause in enumerate(CAUSES):
        (up, larger), (down, smaller) = ahead[k], behind[k]
        curvature[k, k] = (up - 2.0 * here + down) / STEP**2
        change[k] = (_size(larger) - _size(smaller)) / (2.0 * STEP)
        if cause in ("gradient", "position"):
            survey += (larger - smaller) / (4.0 * STEP * likelihood.width[k])
        for other in range(k):
            both = likelihood.deviance(centre + unit[k] + unit[other])
            cross = both - ahead[k][0] - ahead[other][0] + here
            curvature[k, other] = curvature[other, k] = cross / STEP**2
    # No less is known than before the trip.
    values, vectors = np.linalg.eigh(curvature)
    variance = float(np.sum((vectors.T @ change) ** 2 / np.maximum(values, 1.0)))
    return Shares(2.0 / max(variance, 1e-12), survey)


def _judged(likelihood: Likelihood, place: FloatArray) -> tuple[float, FloatArray]:
    """The deviance, and the covariance (p, p) of all parameters."""
    square, log_determinant = likelihood.square(place)
    size = np.sqrt(np.diag(square)[:-1])
    both = np.outer(size, size)
    covariance = np.linalg.inv(square[:-1, :-1] / both) / both
    return likelihood.deviance_of(place, square, log_determinant), covariance


def _size(covariance: FloatArray) -> float:
    """Logarithm of a covariance's size: mean over the parameters that are asked for."""
    return float(np.linalg.slogdet(covariance[:ASKED, :ASKED])[1]) / ASKED

"""Whether the residuals are what the noise model takes them for, and what it means if not.

Whitened residuals should be independent, normal, of unit variance, and have nothing to do with
speed. Where they are not, the band is not to be trusted as far as it says; the words tell which
way.

References
----------
Ljung, G. M., Box, G. E. P. (1978), On a measure of lack of fit in time series models, Biometrika
65(2): the statistic over several lags.
Jarque, C. M., Bera, A. K. (1987), A test for normality of observations and regression residuals,
International Statistical Review 55(2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LAGS = 10
"""Neighbours over which correlation is looked for."""

DOUBTFUL = 1e-3
"""Probability below which a property is called missing; trips are many, false alarms few."""

UNEVEN = (0.7, 1.4)
"""Standard deviation outside this range means that the noise is not as large as estimated."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Whitened residuals of the windows used; (n,) arrays.

    Attributes
    ----------
    time : array [s]
        End of the window since the trip's first sample.
    position : array [m]
    speed : array [m/s]
        Mean over the window.
    value : array [1]
    """

    time: FloatArray
    position: FloatArray
    speed: FloatArray
    value: FloatArray

    def correlation(self, lags: int = LAGS) -> FloatArray:
        """Autocorrelation (lags,) of the residuals, from lag 1."""
        value = self.value - self.value.mean()
        power = max(float(value @ value), 1e-300)
        lags = min(lags, value.size - 1)
        return np.array([value[k:] @ value[:-k] / power for k in range(1, lags + 1)])


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What the residuals of a trip say about its fit.

    Attributes
    ----------
    std : float
        Should be 1.
    independence, normality, flatness : float
        Probability of residuals at least so strange, if they are independent (Ljung and Box),
        normal (Jarque and Bera), and do not rise or fall with speed (Spearman).
    doubts : tuple of str
        What is missing, in words; empty if nothing is.
    """

    std: float
    independence: float
    normality: float
    flatness: float
    doubts: tuple[str, ...]


def diagnosed(residuals: Residuals) -> Diagnosis:
    """What the residuals say; at least three of them."""
    value = residuals.value
    count = value.size
    std = float(np.sqrt(np.mean(value**2)))
    from scipy.stats import chi2, jarque_bera, spearmanr

    correlation = residuals.correlation()
    lags = np.arange(1, correlation.size + 1)
    statistic = count * (count + 2.0) * float(np.sum(correlation**2 / (count - lags)))
    independence = float(chi2.sf(statistic, correlation.size))
    spread = float(np.ptp(value)) > 0.0
    normality = float(jarque_bera(value).pvalue) if spread else 1.0
    moving = spread and float(np.ptp(residuals.speed)) > 0.0
    flatness = float(spearmanr(residuals.speed, value).pvalue) if moving else 1.0
    doubts = []
    if not UNEVEN[0] <= std <= UNEVEN[1]:
        doubts.append(f"residuals of {std:.2f} standard deviations: the noise is misjudged")
    if independence < DOUBTFUL:
        doubts.append(
            "neighbouring windows err together: something lasting is left out (wind, map, effort)"
        )
    if normality < DOUBTFUL:
        doubts.append("residuals are not normal: a few windows are far off")
    if flatness < DOUBTFUL:
        doubts.append("residuals change with speed: the curve is not a parabola, or speed is off")
    return Diagnosis(std, independence, normality, flatness, tuple(doubts))

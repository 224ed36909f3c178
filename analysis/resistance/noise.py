"""Noise of the windows: what it consists of, and how large each part is on this trip.

Four independent causes, each of one unknown size, make the windows' errors correlated:

- noise of the measured speed: two windows that share an end share its error, with opposite signs;
- gradient errors of the map: one random offset for every piece of the gradient profile;
- position errors: one random shift for every change of gradient;
- noise of the recorded effort, in proportion to it.

The sizes are found by restricted maximum likelihood with a weak prior, so that a trip on a
perfect map is not charged for the map's errors, nor the other way round. Windows far apart have
nothing in common: the covariance is banded, and all work is linear in the length of the trip.

References
----------
Patterson, H. D., Thompson, R. (1971), Recovery of inter-block information when block sizes are
unequal, Biometrika 58(3): restricted likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import minimize

from analysis.resistance.windows import Windows
from trainlog.units import GRAVITY

FloatArray = NDArray[np.float64]

FLOOR = 1e-4
"""Smallest standard deviation of a window [m/s], so that exact data stay solvable."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Standard deviation of each cause of noise.

    Attributes
    ----------
    speed : float [m/s]
        Of the speed averaged at a window's end.
    gradient : float
        Of the gradient of one piece of the profile.
    position : float [m]
        Of the chainage at a change of gradient.
    effort : float
        Of one sample's effort, over the effort.
    """

    speed: float
    gradient: float
    position: float
    effort: float

    @property
    def sizes(self) -> tuple[float, ...]:
        """The four of them, in this order."""
        return tuple(float(getattr(self, item.name)) for item in fields(self))


PRIOR = NoiseModel(speed=0.01, gradient=0.5e-3, position=10.0, effort=0.01)
"""Where the search begins: an ordinary survey and odometer."""

PRIOR_WIDTH = NoiseModel(speed=0.5, gradient=1.5, position=1.5, effort=1.0)
"""Standard deviation of the natural logarithm of each size around `PRIOR`."""


@dataclass(frozen=True, eq=False)
class NoiseParts:
    """Covariance of the windows that each cause has at unit size, as bands.

    Attributes
    ----------
    bands : (4, n, w) array
        ``bands[c, k, d]`` is the covariance of windows k and k - d by cause c.
    """

    bands: FloatArray

    @staticmethod
    def of(windows: Windows, mass: float) -> NoiseParts:
        """The parts for these windows.

        Parameters
        ----------
        windows : Windows
        mass : float [kg]
            To turn effort into acceleration; 10 % off does not matter.
        """
        gradient = GRAVITY**2 * (windows.sections @ windows.sections.T).tocoo()
        position = (windows.edges @ windows.edges.T).tocoo()
        reach = max(
            int(np.max(part.row - part.col, initial=min(1, windows.count - 1)))
            for part in (gradient, position)
        )
        bands = np.zeros((4, windows.count, reach + 1))
        bands[0, :, 0] = 2.0
        joined = np.flatnonzero(windows.start[1:] - windows.end[:-1] < 1e-6) + 1
        bands[0, joined, 1:2] = -1.0
        for band, part in ((bands[1], gradient), (bands[2], position)):
            lower = part.row >= part.col
            band[part.row[lower], (part.row - part.col)[lower]] = part.data[lower]
        bands[3, :, 0] = windows.effort_square / mass**2
        return NoiseParts(bands)

    def covariance(self, noise: NoiseModel) -> FloatArray:
        """Covariance of the windows (n, w) [(m/s)²] as bands, for noise of these sizes."""
        total = np.einsum("c,cnw->nw", np.square(noise.sizes), self.bands)
        total[:, 0] += FLOOR**2
        return np.asarray(total)

    def whiten(self, noise: NoiseModel, columns: FloatArray) -> FloatArray:
        """Columns (n, c) of the regression, their noise made independent and of unit variance.

        A whitened row depends on that window and earlier ones only, so that least squares over
        the first k rows is the answer after k windows.
        """
        return np.asarray(_whitened(self.covariance(noise), columns)[0])


def estimate_noise(parts: NoiseParts, columns: FloatArray, prior: FloatArray) -> NoiseModel:
    """Size of each cause of noise by restricted maximum likelihood.

    Parameters
    ----------
    parts : NoiseParts
    columns : (n, p + 1) array
        Regressors, and last the left-hand side.
    prior : (p, p + 1) array
        What is known of the parameters, as further rows of unit variance.
    """
    centre, width = np.log(PRIOR.sizes), np.array(PRIOR_WIDTH.sizes)

    def penalised(z: FloatArray) -> float:
        sizes = NoiseModel(*np.exp(centre + width * z).tolist())
        whitened, log_determinant = _whitened(parts.covariance(sizes), columns)
        # The triangle of [X y]: its last entry is the norm of the residual.
        triangle = np.abs(np.diag(np.linalg.qr(np.vstack([whitened, prior]), mode="r")))
        logarithms = np.log(np.maximum(triangle[:-1], np.finfo(np.float64).tiny))
        deviance = log_determinant + np.sum(logarithms) + 0.5 * triangle[-1] ** 2
        return float(deviance + 0.5 * z @ z)

    start = np.concatenate((np.zeros((1, 4)), -0.5 * np.eye(4)))
    found = minimize(
        penalised,
        start[0],
        method="Nelder-Mead",
        options={"xatol": 0.02, "fatol": 0.02, "maxfev": 400, "initial_simplex": start},
    )
    return NoiseModel(*np.exp(centre + width * found.x).tolist())


@njit(cache=True)  # type: ignore[untyped-decorator]
def _whitened(bands: FloatArray, columns: FloatArray) -> tuple[FloatArray, float]:
    """Banded Cholesky factor solved against the columns, and the sum of the log diagonal."""
    count, width = bands.shape
    factor = np.zeros_like(bands)
    out = columns.copy()
    logarithm = 0.0
    for k in range(count):
        first = max(0, k - width + 1)
        for j in range(first, k + 1):
            total = bands[k, k - j]
            for m in range(max(first, j - width + 1), j):
                total -= factor[k, k - m] * factor[j, j - m]
            if j < k:
                factor[k, k - j] = total / factor[j, 0]
            else:
                factor[k, 0] = np.sqrt(total)
        logarithm += np.log(factor[k, 0])
        for c in range(out.shape[1]):
            value = out[k, c]
            for m in range(first, k):
                value -= factor[k, k - m] * out[m, c]
            out[k, c] = value / factor[k, 0]
    return out, logarithm

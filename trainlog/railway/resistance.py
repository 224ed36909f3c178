"""Running resistance, curve resistance and tunnel resistance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trainlog.errors import InputError

CURVE_COEFFICIENT = 0.6
"""k_C [m]: curve resistance is weight times k_C over the radius; Amirhosseini et al. (2024),
eq. (6), corrected."""


TUNNEL_COEFFICIENT = 1.3e-7
"""k_T [1/m]: tunnel resistance is weight times k_T times the tunnel's length, where no coefficient
of the train itself is known; Amirhosseini et al. (2024), eq. (6), corrected."""


@dataclass(frozen=True, slots=True)
class RunningResistance:
    """Davis formula ``R(v) = r0 + r1 v + r2 v²`` [N] on straight, level, open track.

    Attributes
    ----------
    r0 : float [N]
    r1 : float [N/(m/s)]
    r2 : float [N/(m/s)²]

    Examples
    --------
    >>> resistance = RunningResistance(r0=2_000.0, r1=50.0, r2=5.0)
    >>> resistance([0.0, 10.0, 20.0])
    array([2000., 3000., 5000.])
    """

    r0: float
    r1: float
    r2: float

    def __post_init__(self) -> None:
        if not all(np.isfinite((self.r0, self.r1, self.r2))):
            raise InputError("running resistance: coefficients must be finite numbers")

    def __call__(self, speed: ArrayLike) -> NDArray[np.float64]:
        """Resistance [N] at each speed [m/s], for positive speeds."""
        v = np.asarray(speed, dtype=np.float64)
        return np.asarray(self.r0 + (self.r1 + self.r2 * v) * v)

    def __add__(self, other: RunningResistance) -> RunningResistance:
        """Both together."""
        return RunningResistance(self.r0 + other.r0, self.r1 + other.r1, self.r2 + other.r2)

    def scaled(self, factor: float) -> RunningResistance:
        """All three coefficients times `factor`.

        Examples
        --------
        >>> RunningResistance(2000.0, 50.0, 10.0).scaled(0.5)(20.0).item()
        3500.0
        """
        return RunningResistance(self.r0 * factor, self.r1 * factor, self.r2 * factor)


def curve_force_per_weight(curvature: ArrayLike) -> NDArray[np.float64]:
    """Curve resistance over weight, ``k_C |curvature|``.

    Source: Amirhosseini et al. (2024), eq. (6) as corrected.

    Parameters
    ----------
    curvature : array [1/m]

    Examples
    --------
    >>> curve_force_per_weight(1.0 / 300.0).item()
    0.002
    """
    return np.asarray(CURVE_COEFFICIENT * np.abs(np.asarray(curvature, dtype=np.float64)))


def tunnel_force_per_weight(length: ArrayLike) -> NDArray[np.float64]:
    """Resistance of a tunnel over weight, ``k_T L_T``.

    Source: Amirhosseini et al. (2024), eq. (6) as corrected.

    Parameters
    ----------
    length : array [m]
        Of the tunnel.

    Examples
    --------
    >>> round(tunnel_force_per_weight(2_000.0).item(), 6)
    0.00026
    """
    return np.asarray(TUNNEL_COEFFICIENT * np.asarray(length, dtype=np.float64))

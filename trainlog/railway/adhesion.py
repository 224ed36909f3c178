"""Adhesion between wheel and rail as a function of slip speed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trainlog.errors import InputError


@dataclass(frozen=True)
class CreepCurve:
    """Adhesion coefficient ``mu(v_s) = c exp(-a v_s) - d exp(-b v_s)``.

    Source: Zhao et al. (2025), eq. (10).

    ``v_s`` [m/s] is wheel speed minus train speed; the curve is odd in it. It rises from 0 to
    its maximum, the maximum adhesion, and falls beyond.

    Attributes
    ----------
    a, b : float [s/m]
    c, d : float
        Equal, so that no slip means no force.
    """

    a: float
    b: float
    c: float
    d: float

    def __post_init__(self) -> None:
        if not (0.0 < self.a < self.b and self.c == self.d and self.c > 0.0):
            raise InputError("creep curve: needs 0 < a < b and c = d > 0")

    def __call__(self, slip_speed: ArrayLike) -> NDArray[np.float64]:
        """Adhesion coefficient, signed like the slip speed [m/s]."""
        slip = np.asarray(slip_speed, dtype=np.float64)
        size = np.abs(slip)
        return np.asarray(
            np.sign(slip) * (self.c * np.exp(-self.a * size) - self.d * np.exp(-self.b * size))
        )

    @cached_property
    def peak_slip(self) -> float:
        """Slip speed of maximum adhesion [m/s]."""
        return float(np.log(self.d * self.b / (self.c * self.a)) / (self.b - self.a))

    @cached_property
    def peak(self) -> float:
        """Maximum adhesion."""
        return float(self(self.peak_slip))


DRY = CreepCurve(a=0.54, b=1.2, c=1.0, d=1.0)
"""Dry rail; Zhao et al. (2025), table 1."""

WET = CreepCurve(a=0.19, b=0.54, c=0.4, d=0.4)
"""Wet rail; Zhao et al. (2025), table 1."""


def creep_coefficients(maximum: ArrayLike) -> NDArray[np.float64]:
    """a, b and c = d of the creep curve of a rail with a given maximum adhesion, eq. (10).

    The shape goes from the wet rail's (maximum 0.147 and below) to the dry rail's (0.286 and
    above) with the maximum; the curve is scaled to it.

    Parameters
    ----------
    maximum : (...) array
        Between 0 and 1.

    Returns
    -------
    (..., 3) array
        a and b [s/m], and the common factor of both exponentials.

    Raises
    ------
    InputError
        If a maximum is not between 0 and 1.

    Examples
    --------
    >>> a, b, scale = creep_coefficients(0.2)
    >>> curve = CreepCurve(a, b, scale, scale)
    >>> round(curve.peak, 6), round(curve.peak_slip, 2)
    (0.2, 1.91)
    """
    peak = np.asarray(maximum, dtype=np.float64)
    if not np.all((peak > 0.0) & (peak < 1.0)):
        bad = peak[~((peak > 0.0) & (peak < 1.0))]
        raise InputError(f"maximum adhesion {bad.flat[0]} is not between 0 and 1")
    dryness = np.clip((peak - WET.peak) / (DRY.peak - WET.peak), 0.0, 1.0)
    a = WET.a + dryness * (DRY.a - WET.a)
    b = WET.b + dryness * (DRY.b - WET.b)
    at_peak = np.log(b / a) / (b - a)
    scale = peak / (np.exp(-a * at_peak) - np.exp(-b * at_peak))
    return np.stack([a, b, scale], axis=-1)

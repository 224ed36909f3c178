"""Adhesion between wheel and rail as a function of slip speed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trainlog.errors import InputError


@dataclass(frozen=True)
class CreepCurve:
    """Adhesion coefficient ``mu(v_s) = c exp(-a v_s) - d exp(-b v_s)``; paper 003, eq. (10).

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
"""Dry rail; paper 003, table 1."""

WET = CreepCurve(a=0.19, b=0.54, c=0.4, d=0.4)
"""Wet rail; paper 003, table 1."""

"""Running resistance, curve resistance and tunnel resistance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.declaration import Quantity
from trainlog.errors import InputError

CurveFormula = Literal["proportional", "roeckl", "roeckl_small_radius"]

CURVE_FORMULAS: dict[CurveFormula, tuple[tuple[float, float, float], ...]] = {
    "proportional": ((0.0, 0.6, 0.0),),
    "roeckl": ((0.0, 0.65, 55.0), (1.0 / 300.0, 0.5, 30.0)),
    "roeckl_small_radius": ((0.0, 0.5, 30.0),),
}
"""Curve resistance over weight, ``k / (R - b)`` of the radius R: rows of the curvature [1/m] beyond
which it holds, k [m] and b [m].

``proportional``: 0.6/R; Amirhosseini et al. (2024), eq. (6), corrected. ``roeckl``: 0.65/(R - 55)
from a radius of 300 m on, 0.5/(R - 30) below it; Roeckl's formula as in Wende, D. (2003),
*Fahrdynamik des Schienenverkehrs*. ``roeckl_small_radius``: 0.5/(R - 30) for every radius.
"""

LEAST_RADIUS = 2.0
"""Radius over b of a formula up to which it holds: nearer to its pole it means nothing."""

TUNNEL_COEFFICIENT = 1.3e-7
"""k_T [1/m]: tunnel resistance is weight times k_T times the tunnel's length, where no coefficient
of the train itself is known; Amirhosseini et al. (2024), eq. (6), corrected."""

LARGEST_STD = 0.10
"""Standard deviation of a curve, over the curve, up to which it is known at a speed."""


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

    r0: Annotated[float, Quantity("kN", "N")]
    r1: Annotated[float, Quantity("kN/(km/h)", "N/(m/s)")]
    r2: Annotated[float, Quantity("kN/(km/h)^2", "N/(m/s)^2")]

    def __post_init__(self) -> None:
        if not all(np.isfinite((self.r0, self.r1, self.r2))):
            raise InputError("running resistance: coefficients must be finite numbers")

    @property
    def coefficients(self) -> FloatArray:
        """r0, r1 and r2 as an array (3,).

        Examples
        --------
        >>> RunningResistance(2000.0, 50.0, 10.0).coefficients.tolist()
        [2000.0, 50.0, 10.0]
        """
        return np.array([self.r0, self.r1, self.r2])

    @overload
    def __call__(self, speed: float) -> np.float64: ...

    @overload
    def __call__(self, speed: ArrayLike) -> FloatArray: ...

    def __call__(self, speed: ArrayLike) -> FloatArray | np.float64:
        """Resistance [N] at each speed [m/s], a number at a single one.

        The polynomial is evaluated at any speed. It is the resistance of a train that moves
        forward: not below zero, and not far beyond the speeds that it was fitted to (the
        ``speed_range`` of a fit or a parameter set).

        Examples
        --------
        >>> curve = RunningResistance(2000.0, 50.0, 10.0)
        >>> float(curve(20.0)), curve([0.0, 20.0]).tolist()
        (7000.0, [2000.0, 7000.0])
        """
        v = np.asarray(speed, dtype=np.float64)
        value = np.asarray(self.r0 + (self.r1 + self.r2 * v) * v)
        return value if value.ndim else np.float64(value)

    def __str__(self) -> str:
        return f"{self.r0:.0f} N + {self.r1:.1f} N/(m/s) v + {self.r2:.2f} N/(m/s)² v²"

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


def specific_curve_resistance(curvature: Any, coefficient: Any, offset: Any) -> Any:
    """Curve resistance over weight, ``k / (R - b)``; of arrays, and compiled of single values.

    Parameters
    ----------
    curvature : [1/m]
    coefficient, offset : [m]
        k and b of a formula.

    Examples
    --------
    >>> round(specific_curve_resistance(-1.0 / 305.0, 0.65, 55.0), 9)
    0.0026
    """
    size = abs(curvature)
    return coefficient * size / (1.0 - offset * size)


def curve_coefficients(
    curvature: ArrayLike, formula: CurveFormula = "proportional"
) -> tuple[FloatArray, FloatArray]:
    """Coefficients k and b [m] of a formula at each curvature [1/m].

    Examples
    --------
    >>> curve_coefficients([1.0 / 300.0, 1.0 / 299.0], "roeckl")
    (array([0.65, 0.5 ]), array([55., 30.]))
    """
    beyond, coefficient, offset = np.array(CURVE_FORMULAS[formula]).T
    row = np.searchsorted(beyond[1:], np.abs(np.asarray(curvature, dtype=np.float64)))
    return coefficient[row], offset[row]


def curve_force_per_weight(
    curvature: ArrayLike, formula: CurveFormula = "proportional"
) -> FloatArray:
    """Curve resistance over weight by one of the `CURVE_FORMULAS`.

    Parameters
    ----------
    curvature : array [1/m]
    formula : {"proportional", "roeckl", "roeckl_small_radius"}

    Examples
    --------
    >>> curve_force_per_weight(1.0 / 300.0).item()
    0.002
    >>> round(curve_force_per_weight(1.0 / 300.0, "roeckl").item(), 6)
    0.002653
    """
    bend = np.asarray(curvature, dtype=np.float64)
    return np.asarray(specific_curve_resistance(bend, *curve_coefficients(bend, formula)))


def tunnel_force_per_weight(length: ArrayLike) -> FloatArray:
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

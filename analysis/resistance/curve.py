"""A running resistance with its uncertainty: at a speed, and of the whole curve.

References
----------
Sun, J., Loader, C. R. (1994), Simultaneous confidence bands for linear regression and smoothing,
Annals of Statistics 22(3), eq. (1.5): the tube formula for a curve on the sphere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import nnls
from scipy.special import stdtr

from trainlog.arrays import FloatArray
from trainlog.presentation import FORCE, Band, Column, Quantity
from trainlog.railway.resistance import SUFFIXES, TERMS, RunningResistance, basis
from trainlog.units import KMH

CONFIDENCE = 0.95
"""Of every band."""

STATED_AT = 80.0 / KMH
"""Speed [m/s] at which tables state the resistance."""


HEAD_WIND = 5.0
"""Standard deviation of a trip's head wind that is not known [m/s]."""


def curve_std(covariance: FloatArray, speed: ArrayLike) -> FloatArray:
    """Standard deviation [N] of a curve at each speed [m/s].

    Parameters
    ----------
    covariance : (p, p) array
        Of its coefficients.
    speed : array [m/s]
    """
    at = basis(speed)
    return np.asarray(np.sqrt(np.einsum("...i,ij,...j->...", at, covariance, at)))


def band_factor(covariance: FloatArray, speeds: tuple[float, float], freedom: float) -> float:
    """How many standard deviations to either side hold the whole true curve in 95 of 100 cases.

    A band that covers each single speed with 95 % misses some part of the curve more often than
    that; this one does not, between the two `speeds`.

    Parameters
    ----------
    covariance : (p, p) array
    speeds : (float, float) [m/s]
    freedom : float
        Degrees of freedom of the noise's estimate.
    """
    from scipy.optimize import brentq

    # The path of the normalised curve on the unit sphere.
    root = np.linalg.cholesky(covariance)
    path = basis(np.linspace(*speeds, 201)) @ root
    path /= np.linalg.norm(path, axis=1, keepdims=True)
    length = float(np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)))

    def missed(factor: float) -> float:
        tube = length / np.pi * (1.0 + factor**2 / freedom) ** (-0.5 * freedom)
        return float(tube + 2.0 * stdtr(freedom, -factor) - (1.0 - CONFIDENCE))

    return float(brentq(missed, 0.5, 200.0))


def nearest_physical(beta: FloatArray, covariance: FloatArray) -> RunningResistance:
    """The likeliest running resistance of which no coefficient is negative.

    Where the coefficients can hardly be separated one of them may come out negative; the nearest
    physical ones, measured by the covariance, give nearly the same curve.
    """
    scale = np.sqrt(np.diag(covariance))
    half = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(scale, scale)))
    nearest, _ = nnls(half, half @ (beta / scale))
    return RunningResistance.of(nearest * scale)


class DragCurve:
    """A running resistance with its uncertainty; results that are one derive from it.

    Attributes
    ----------
    resistance : RunningResistance
        Of straight, level, open track.
    covariance : (p, p) array
        Of the coefficients first.
    freedom : float
        Degrees of freedom of the covariance.
    asked : (float, float) [m/s]
        Speeds between which it is asked for.
    """

    resistance: RunningResistance
    covariance: FloatArray
    freedom: float
    asked: tuple[float, float]

    @property
    def own_covariance(self) -> FloatArray:
        """Covariance of the coefficients alone."""
        return self.covariance[: len(TERMS), : len(TERMS)]

    @property
    def band_range(self) -> tuple[float, float]:
        """Speeds [m/s] between which the band holds the whole curve."""
        return 0.0, self.asked[1]

    @property
    def beta(self) -> FloatArray:
        """The coefficients as an array."""
        return self.resistance.coefficients

    def std(self, speed: ArrayLike) -> FloatArray:
        """Standard deviation of the curve [N] at each speed [m/s]."""
        return curve_std(self.own_covariance, speed)

    def band(self, speed: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Lower and upper end [N] of the 95 % band of the whole curve at each speed [m/s].

        It holds the true curve, all of it from standstill to the highest speed asked for, in 95
        of 100 cases.
        """
        factor = band_factor(self.own_covariance, self.band_range, self.freedom)
        value, reach = self.resistance(speed), factor * self.std(speed)
        return value - reach, value + reach

    @property
    def words(self) -> str:
        """The coefficients, and the value at the highest speed asked for."""
        curve, top = self.resistance, self.asked[1]
        value, reach = float(curve(top)) / 1e3, 1.96 * float(self.std(top)) / 1e3
        return f"{curve}, {value:.2f} ± {reach:.2f} kN at {KMH * top:.0f} km/h"


def _coefficient(number: int) -> Callable[[DragCurve], Band]:
    """Of a curve and of its standard deviation, by the power of speed."""
    return lambda curve: Band(
        float(curve.beta[number]), float(np.sqrt(curve.covariance[number, number]))
    )


CURVE_COLUMNS = (
    *(
        Column(name, Quantity(suffix, ""), band=True, of=_coefficient(number), rank=1)
        for number, (name, suffix) in enumerate(zip(TERMS, SUFFIXES, strict=True))
    ),
)
RESISTANCE_COLUMN = Column(
    "kN at 80 km/h",
    replace(FORCE, unit=""),
    key="resistance_at_80_km_h",
    band=True,
    of=lambda curve: Band(float(curve.resistance(STATED_AT)), float(curve.std(STATED_AT))),
)

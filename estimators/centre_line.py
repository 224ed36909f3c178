"""A smooth plane curve through scattered points that are ordered along it.

Points of the plane are complex numbers, east + i north [m]. The curve is a cubic spline in
position, whose curvature is continuous and piecewise linear, as that of straights, arcs and
clothoids is; its third derivative, the rate of change of curvature, is the random quantity.

References
----------
Eilers, P. H. C., Marx, B. D. (1996), Flexible smoothing with B-splines and penalties,
Statistical Science 11(2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.sparse import csr_array, diags_array

from trainlog.arrays import ComplexArray, FloatArray
from trainlog.errors import InputError

KNOTS = 25.0
"""Distance between the knots of the spline [m]."""

CURVATURE_CHANGE = 5e-9
"""Spectral density of the rate of change of curvature [1/m³]: transitions of 80 m to radii of
500 m on a tenth of the line."""

FREEDOM = 4.0
"""Degrees of freedom of Student's t, the distribution that the points are taken to have."""

TURNS = 8
"""Times the weights of the points are computed from their distances."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve and how well it is known.

    Attributes
    ----------
    spline : BSpline
        Position [m] to point [m].
    covariance : (m, m) array [m²]
        Of its coefficients, in east and in north each.
    start, end : float [m]
    """

    spline: BSpline
    covariance: FloatArray
    start: float
    end: float

    def at(self, position: FloatArray) -> ComplexArray:
        """Points [m]."""
        return np.asarray(self.spline(position))

    def curvature(self, position: FloatArray) -> FloatArray:
        """Curvature [1/m], positive where the curve bends to the right."""
        ahead, bend = self.spline(position, 1), self.spline(position, 2)
        return np.asarray(-(np.conj(ahead) * bend).imag / np.abs(ahead) ** 3)

    def std(self, position: FloatArray) -> FloatArray:
        """Standard deviation of the curve's place in each direction [m]."""
        rows = BSpline.design_matrix(position, self.spline.t, 3)
        return _spread(rows, self.covariance)

    def curvature_std(self, position: FloatArray) -> FloatArray:
        """Standard deviation of the curvature [1/m]."""
        # The second derivative of a cubic spline is a spline of degree 1 of second differences.
        rows = BSpline.design_matrix(position, self.spline.t[2:-2], 1)
        size = self.covariance.shape[0]
        second = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(size - 2, size))
        return _spread(rows @ second.tocsr() / KNOTS**2, self.covariance)


def _spread(rows: csr_array, covariance: FloatArray) -> FloatArray:
    variance = np.asarray(rows.multiply(rows @ covariance).sum(axis=1)).ravel()
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def fitted_curve(
    position: FloatArray, points: ComplexArray, std: FloatArray
) -> tuple[Curve, FloatArray]:
    """The smoothest curve that goes near the points.

    Parameters
    ----------
    position : (n,) array [m]
        Where along the curve each point lies, in any order.
    points : (n,) complex array [m]
    std : (n,) array [m]
        In each direction of the plane.

    Returns
    -------
    curve : Curve
    weight : (n,) array
        Of each point, 1 or a little more where it lies on the curve, 0 far away.

    Raises
    ------
    InputError
        If the points lie all at one place.

    Examples
    --------
    Points on a right-hand curve of a radius of 500 m:

    >>> import numpy as np
    >>> position = np.linspace(0.0, 600.0, 200)
    >>> points = 500.0 * (1.0 - np.exp(-1j * position / 500.0))
    >>> curve, weight = fitted_curve(position, points, np.full(200, 0.5))
    >>> print(f"{1.0 / curve.curvature(np.array([300.0]))[0]:.0f} m")
    500 m
    """
    start, end = float(position.min()), float(position.max())
    if end - start < KNOTS:
        raise InputError(
            f"the points reach over {end - start:.0f} m", remedy="a line needs a train that moves"
        )
    knots = start + KNOTS * np.arange(-3, np.ceil((end - start) / KNOTS) + 4)
    basis = BSpline.design_matrix(position, knots, 3, extrapolate=True)
    size = knots.size - 4
    third = diags_array(
        [-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(size - 3, size)
    ).tocsr()
    penalty = third.T @ third / (CURVATURE_CHANGE * KNOTS**5)
    weight = np.ones(position.size)
    for _ in range(TURNS):
        weighted = basis.multiply((weight / std**2)[:, None]).tocsr()
        banded = _bands(basis.T @ weighted + penalty)
        right = weighted.T @ points
        coefficients = solveh_banded(banded, np.column_stack([right.real, right.imag]), lower=True)
        spline = BSpline(knots, coefficients @ np.array([1.0, 1j]), 3)
        distance = np.abs(points - spline(position)) / std
        weight = (FREEDOM + 2.0) / (FREEDOM + distance**2)
    covariance = solveh_banded(banded, np.eye(size), lower=True)
    return Curve(spline, covariance, start, end), weight


def _bands(matrix: csr_array) -> FloatArray:
    """The diagonal and the three below it, as `solveh_banded` takes them."""
    size = matrix.shape[0]
    banded = np.zeros((4, size))
    for k in range(4):
        banded[k, : size - k] = matrix.diagonal(-k)
    return banded

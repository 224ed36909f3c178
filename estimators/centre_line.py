"""The course of a line in the plane, its height and its gradient, from rides along it.

Points of the plane are complex numbers, east + i north [m]. The course is a smooth curve through
scattered points that are ordered along it: a cubic spline in position, whose curvature is
continuous and piecewise linear, as that of straights, arcs and clothoids is; its third derivative,
the rate of change of curvature, is the random quantity.

A receiver's altitude errs by metres, for minutes: its errors last in *time*. The line's height is
the same for all rides, and its gradient lasts along the *line*. With h(s) the height, b_i the mean
error of ride i and e_i(t) the rest of it,

    z_i(t) = h(s_i(t)) + b_i + e_i(t),    g = dh/ds,

e_i an Ornstein-Uhlenbeck process in time (standard deviation sigma, lasting tau) times r_i(t), by
how much worse than usual the receiver states the altitude to be (as after a cold start), g one
along the line (gamma, lambda). With u = e / r, u_k - rho_k u_{k-1}, rho_k = exp(-(t_k - t_{k-1}) /
tau), are independent, so that the heights of knots follow from a sparse system of normal equations.
The four sizes maximise the marginal likelihood with weak priors. Whether the rides err in this way
is checked against how they differ from the common height: the covariance of the gradients is
compared with its cluster-robust estimate, the rides being the clusters, and widened by it.

References
----------
Eilers, P. H. C., Marx, B. D. (1996), Flexible smoothing with B-splines and penalties,
Statistical Science 11(2).
Rasmussen, C. E., Williams, C. K. I. (2006), Gaussian Processes for Machine Learning, section 5.4.1:
marginal likelihood.
Rue, H., Held, L. (2005), Gaussian Markov Random Fields, chapter 2: sparse precision matrices.
Liang, K.-Y., Zeger, S. L. (1986), Longitudinal data analysis using generalized linear models,
Biometrika 73(1), eq. (2.5): covariance that is robust to the correlation within a cluster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.optimize import minimize
from scipy.sparse import csc_array, csr_array, diags_array, vstack
from scipy.sparse.linalg import SuperLU, splu

from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray
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
        matrix = basis.T @ weighted + penalty
        # The diagonal and the three below it, as `solveh_banded` takes them.
        banded = np.array([np.pad(matrix.diagonal(-k), (0, k)) for k in range(4)])
        right = weighted.T @ points
        coefficients = solveh_banded(banded, np.column_stack([right.real, right.imag]), lower=True)
        spline = BSpline(knots, coefficients @ np.array([1.0, 1j]), 3)
        distance = np.abs(points - spline(position)) / std
        weight = (FREEDOM + 2.0) / (FREEDOM + distance**2)
    covariance = solveh_banded(banded, np.eye(size), lower=True)
    return Curve(spline, covariance, start, end), weight


# -------------------------------------------------------------------------- heights and gradients


HEIGHT_KNOTS = 50.0
"""Distance between the knots of the height [m]."""

OVER = 500.0
"""Length over which gradients are averaged [m]: a receiver's altitudes show nothing shorter."""

APART = 5.0
"""Altitudes of a ride are averaged over so long [s]: their errors last longer."""

MEAN_ERROR = 20.0
"""Standard deviation of a ride's mean error [m]: height above the ellipsoid or the sea, antenna."""

SIZES = np.log([5.0, 60.0, 8e-3, 500.0])
"""What is expected of sigma [m], tau [s], gamma and lambda [m], as logarithms."""

SIZES_STD = np.array([1.0, 1.0, 0.7, 0.7])
"""Standard deviation of these logarithms."""

USUAL = 0.25
"""Quantile of the accuracies stated that is the usual one: cold starts may last for half a ride."""

FEWEST = 3
"""Least number of rides: how they differ shows how they err."""

LARGEST_STD = 4e-3
"""A gradient with a larger standard deviation is not known: half of what gradients vary by."""


@dataclass(frozen=True, eq=False)
class Ride:
    """Altitudes of one ride; (n,) arrays.

    Attributes
    ----------
    time : array [s]
        Increasing.
    position : array [m]
        Along the line, from 0.
    altitude : array [m]
    accuracy : array [m]
        Stated by the receiver; NaN, or no array, where it states none.
    """

    time: FloatArray
    position: FloatArray
    altitude: FloatArray
    accuracy: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class HeightProfile:
    """The height of a line and its mean gradients over `OVER`; (k,) arrays.

    Attributes
    ----------
    position : array [m]
        Middle of each stretch of `OVER`.
    gradient, gradient_std : array
        Rise over run of the stretch.
    known : bool array
        Whether the altitudes show it, to `LARGEST_STD`; else it is what is expected of any line.
    knots, height : (n,) array [m]
        Where, and how high the line is.
    sigma, tau : float [m], [s]
        Size of the rides' altitude errors, and how long they last.
    widened : float
        By which the rides differ more than such errors explain; 1 where they do not.
    """

    position: FloatArray
    gradient: FloatArray
    gradient_std: FloatArray
    known: BoolArray
    knots: FloatArray
    height: FloatArray
    sigma: float
    tau: float
    widened: float


def height_profile(rides: Sequence[Ride], length: float) -> HeightProfile:
    """Height and gradients of a line from rides along it, in either direction.

    Parameters
    ----------
    rides : sequence of Ride
    length : float [m]
        Of the line.

    Raises
    ------
    InputError
        If there are fewer than `FEWEST` rides, or the line is shorter than two stretches.

    Examples
    --------
    Ten rides over a line that climbs by 5 per mille; their altitudes err by 3 m for a minute:

    >>> import numpy as np
    >>> rng, time = np.random.default_rng(1), np.arange(0.0, 400.0, 5.0)
    >>> lasting = np.exp(-np.abs(time[:, None] - time) / 60.0)
    >>> errors = 3.0 * np.linalg.cholesky(lasting) @ rng.standard_normal((80, 10))
    >>> rides = [Ride(time, 20.0 * time, 500.0 + 0.1 * time + error) for error in errors.T]
    >>> profile = height_profile(rides, 8_000.0)
    >>> print(f"{1e3 * np.mean(profile.gradient):.1f} per mille, sigma {profile.sigma:.0f} m")
    4.6 per mille, sigma 3 m
    """
    if len(rides) < FEWEST:
        raise InputError(
            "one ride with altitudes does not show how much these err"
            if len(rides) == 1
            else f"{len(rides)} rides with altitudes do not show how much these err"
            if rides
            else "no ride has altitudes",
            remedy=f"give {FEWEST} or more along the line",
        )
    if length < 2.0 * OVER:
        raise InputError(
            f"a line of {length:.0f} m is too short for gradients from altitudes",
            remedy=f"give a line of {2.0 * OVER:.0f} m or more",
        )
    system = _System.of([_averaged(ride) for ride in rides], length)
    found = minimize(
        lambda place: system.solved(place).deviance,
        np.zeros(4),
        method="Nelder-Mead",
        options={
            "xatol": 0.05,
            "fatol": 0.1,
            "maxfev": 150,
            "initial_simplex": np.vstack([np.zeros(4), 0.5 * np.eye(4)]),
        },
    )
    return _profile(system, system.solved(np.asarray(found.x)))


def _averaged(ride: Ride) -> Ride:
    """The ride with one altitude every `APART` seconds: the median, which no spike moves."""
    known = np.isfinite(ride.position) & np.isfinite(ride.altitude)
    time, position, altitude = ride.time[known], ride.position[known], ride.altitude[known]
    _, first = np.unique(np.floor(time / APART), return_index=True)
    parts = zip(first, np.append(first[1:], time.size), strict=True)
    stated = ride.accuracy[known] if ride.accuracy.size else np.full(time.size, np.nan)
    rows = [
        (time[a:b].mean(), position[a:b].mean(), np.median(altitude[a:b]), np.median(stated[a:b]))
        for a, b in parts
        if b > a
    ]
    return Ride(*np.array(rows, dtype=np.float64).reshape(-1, 4).T)


@dataclass(frozen=True, eq=False)
class _Solved:
    """Heights and mean errors for some sizes of the noise."""

    sizes: FloatArray
    deviance: float
    heights: FloatArray
    factor: SuperLU
    whitened: csr_array
    values: FloatArray


@dataclass(frozen=True, eq=False)
class _System:
    """The altitudes as linear functions of the heights of the knots and the rides' mean errors.

    The rides one below the other: `starts` are their first rows, `apart` the seconds since the row
    before, infinite at those. `before` is `matrix` one row further down, with nothing at `starts`.
    """

    count: int
    origin: float
    starts: IntArray
    apart: FloatArray
    matrix: csr_array
    before: csr_array
    altitude: FloatArray

    @staticmethod
    def of(rides: Sequence[Ride], length: float) -> _System:
        count = int(np.ceil(length / HEIGHT_KNOTS)) + 1
        origin = float(np.median(np.concatenate([ride.altitude for ride in rides])))
        accuracies = np.concatenate([ride.accuracy for ride in rides])
        stated = accuracies[np.isfinite(accuracies)]
        usual = np.quantile(stated, USUAL) if stated.size else np.nan
        rows = []
        for number, ride in enumerate(rides):
            # Stated to be worse than usual, it is; stated to be better, it need not be.
            weight = 1.0 / np.maximum(np.nan_to_num(ride.accuracy / usual, nan=1.0), 1.0)
            place = np.clip(ride.position / HEIGHT_KNOTS, 0.0, count - 1.0)
            knot = np.minimum(place.astype(np.int64), count - 2)
            share, one = place - knot, np.arange(ride.time.size)
            matrix = csr_array(
                (
                    np.concatenate((1.0 - share, share, np.ones(one.size))),
                    (np.tile(one, 3), np.concatenate((knot, knot + 1, 0 * one + count + number))),
                ),
                shape=(one.size, count + len(rides)),
            )
            weighted = (diags_array(weight) @ matrix).tocsr()
            rows.append((ride.time, weighted, weight * (ride.altitude - origin)))
        rows = [row for row in rows if row[0].size > 1]
        sizes = [time.size for time, _, _ in rows]
        starts = np.cumsum([0, *sizes[:-1]])
        apart = np.concatenate([np.diff(time, prepend=-np.inf) for time, _, _ in rows])
        matrix = vstack([each for _, each, _ in rows]).tocsr()
        follows = np.isfinite(apart).astype(np.float64)
        back = diags_array([follows[1:]], offsets=[-1], shape=(follows.size, follows.size))
        altitude = np.concatenate([each for _, _, each in rows])
        return _System(count, origin, starts, apart, matrix, (back @ matrix).tocsr(), altitude)

    def solved(self, place: FloatArray) -> _Solved:
        """The heights for the sizes at `place`, standard deviations from what is expected."""
        sizes = np.exp(SIZES + SIZES_STD * place)
        sigma, tau, gamma, lasting = sizes
        rho = np.exp(-self.apart / tau)
        std = sigma * np.sqrt(1.0 - rho**2)
        back = rho[1:] * self.altitude[:-1]
        values = (self.altitude - np.concatenate(([0.0], back))) / std
        whitened = (
            diags_array(1.0 / std) @ self.matrix - diags_array(rho / std) @ self.before
        ).tocsr()
        logarithm = 2.0 * float(np.sum(np.log(std)))
        # What is expected of gradients and mean errors, as rows of unit variance.
        first, after, before, others = self._expected
        keep = np.exp(-HEIGHT_KNOTS / lasting)
        change = (after - keep * before) / (gamma * np.sqrt(1.0 - keep**2))
        prior = vstack([first / gamma, change, others]).tocsr()
        logarithm += (self.count - 2) * np.log(gamma**2 * (1.0 - keep**2)) + 2.0 * np.log(gamma)
        left = vstack([whitened, prior]).tocsc()
        right = np.concatenate([values, np.zeros(prior.shape[0])])
        factor = splu(csc_array(left.T @ left))
        heights = factor.solve(left.T @ right)
        residual = right - left @ heights
        determinant = float(np.sum(np.log(np.abs(factor.U.diagonal()))))
        deviance = 0.5 * (logarithm + determinant + residual @ residual + place @ place)
        return _Solved(sizes, float(deviance), heights, factor, whitened, values)

    @cached_property
    def _expected(self) -> tuple[csr_array, csr_array, csr_array, csr_array]:
        """Rows of the first gradient, of those after another, of the others, and of mean errors."""
        count, size = self.count, self.matrix.shape[1]
        gradient = (
            diags_array([-1.0, 1.0], offsets=[0, 1], shape=(count - 1, size)).tocsr() / HEIGHT_KNOTS
        )
        errors = np.arange(size - count)
        mean = csr_array(
            (np.full(errors.size, 1.0 / MEAN_ERROR), (errors, count + errors)),
            shape=(errors.size, size),
        )
        # The height of the whole is only known as well as the mean errors are.
        anchor = csr_array(([1e-3], ([0], [0])), shape=(1, size))
        return gradient[[0]], gradient[1:], gradient[:-1], vstack([mean, anchor]).tocsr()


def _profile(system: _System, solved: _Solved) -> HeightProfile:
    """The gradients of stretches of `OVER`, their bands widened where the rides ask for it."""
    across = round(OVER / HEIGHT_KNOTS)
    starts = np.arange(0, system.count - across, across // 2)
    columns = np.arange(starts.size)
    mean = np.zeros((solved.heights.size, starts.size))
    mean[starts + across, columns], mean[starts, columns] = 1.0 / OVER, -1.0 / OVER
    solution = solved.factor.solve(mean)
    variance = np.sum(mean * solution, axis=0)
    effect = solved.whitened @ solution
    model = np.sum(effect**2, axis=0)
    residual = solved.values - solved.whitened @ solved.heights
    robust = np.sum(np.add.reduceat(residual[:, None] * effect, system.starts) ** 2, axis=0)
    rides = system.starts.size
    widened = max(1.0, float(np.sqrt(robust.mean() / model.mean() * rides / (rides - 1.0))))
    gradient = mean.T @ solved.heights
    std = np.sqrt(variance + (widened**2 - 1.0) * model)
    return HeightProfile(
        position=np.asarray(HEIGHT_KNOTS * (starts + 0.5 * across), dtype=np.float64),
        gradient=gradient,
        gradient_std=std,
        known=std < LARGEST_STD,
        knots=np.asarray(HEIGHT_KNOTS * np.arange(system.count), dtype=np.float64),
        height=solved.heights[: system.count] + system.origin,
        sigma=float(solved.sizes[0]),
        tau=float(solved.sizes[1]),
        widened=widened,
    )

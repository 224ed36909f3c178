"""One linear regression of rows of data on free parameters, each with what is known of it before.

Delay, gain, mass, coefficients of a curve, a gradient's offset: all are columns. A parameter of
which nothing is known has a wide prior, one that is known a narrow one; where the data say nothing
the prior is what is left. Rows far off are left out by one rule (`Cut`), and where neighbouring
rows err together `clustered` says by how much the covariance is too small.

The rows with those of the prior below them are made triangular by reflections: no products of
columns are taken, so that columns of very unlike size do no harm.

`RecursiveLeastSquares` takes the rows one by one. Its covariance is kept as ``P = U D Uᵀ`` (U unit
upper triangular, D diagonal) and only the factors are updated, so that it stays positive definite
whatever the data: the conventional recursion (Amirhosseini et al. (2024), eqs. 15-17) loses that
property after some hundred samples. In single precision, too; and its loops of constant length run
several times as fast as those of `estimators.linear_gaussian`, of which it is a special case (F =
1).

Forgetting and random walk make the covariance grow where the data say nothing. Windup is guarded
against: the covariance never exceeds the prior's in any direction. While it could, each sample is
followed by just so much confirmation of the estimate that an unexcited direction stays at its
prior variance, ``P⁻¹ <- gamma P⁻¹ + (1 - gamma) P₀⁻¹``; while the data hold it well below the
prior (the variances over their priors sum up to less than 1) the recursion is the plain one.

A recursion has to forget where what it learns jumps. Amirhosseini et al. learn the sum of a
constant resistance and the gradient's force as one parameter: where the gradient changes, what was
learnt of it holds no longer. The recursion is reset where the map has an edge (spatial reset), in
full as there, or for the constant term alone, which keeps what was learnt about the others. A reset
every so many seconds (time reset) needs no map and does worse.

References
----------
Bierman, G. J. (1977), Factorization Methods for Discrete Sequential Estimation, ch. IV: the
square-root information of data and prior.
Liang, K.-Y., Zeger, S. L. (1986), Longitudinal data analysis using generalized linear models,
Biometrika 73(1), eq. (6).
Amirhosseini, A. et al. (2024), eqs. (16), (19), (20) with the forgetting factor as corrected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, DTypeLike, NDArray

from estimators.interface import CALIBRATED, Estimator, EstimatorResult
from trainlog.arrays import BoolArray, FloatArray, robust_std
from trainlog.errors import InputError


@dataclass(frozen=True, eq=False)
class Free:
    """A free parameter.

    Attributes
    ----------
    name : str
    column : (n,) array
        What a unit of it does to each row.
    std : float
        Standard deviation of what is known of it beforehand.
    mean : float
        What is expected of it.
    """

    name: str
    column: FloatArray
    std: float
    mean: float = 0.0


@dataclass(frozen=True, slots=True)
class Cut:
    """Rows that are left out: a loss that is a square up to a limit, and nothing beyond it.

    Attributes
    ----------
    limit : float
        Standard deviations of a residual beyond which its row is left out.
    apart : int
        Of so many consecutive rows only the worst is left out in one round: an outlier spoils its
        neighbours where errors are correlated.
    rounds : int
        Most rounds; what is still far off after so many stays in.
    own_scale : bool
        Whether the residuals' own spread is the unit, or that of the rows.
    """

    limit: float
    apart: int = 1
    rounds: int = 4
    own_scale: bool = False

    def far(self, residual: FloatArray) -> BoolArray:
        """Which rows are too far off now."""
        from scipy.ndimage import maximum_filter1d

        size = np.abs(residual)
        unit = max(robust_std(residual), 1e-9) if self.own_scale else 1.0
        return np.asarray((size > self.limit * unit) & (size == maximum_filter1d(size, self.apart)))


@dataclass(frozen=True, eq=False)
class Regression:
    """The parameters that explain the rows.

    Attributes
    ----------
    names : tuple of str
    estimate, covariance : (p,), (p, p) array
        The covariance for rows whose noise is as large as they say.
    rows : (k, p + 1) array
        That were used: regressors, and last the left-hand side.
    residual : (k,) array
    kept : (n,) bool array
        Which rows were used.
    """

    names: tuple[str, ...]
    estimate: FloatArray
    covariance: FloatArray
    rows: FloatArray
    residual: FloatArray
    kept: BoolArray

    def place(self, name: str) -> int:
        """Number of a parameter."""
        return self.names.index(name)

    def __getitem__(self, name: str) -> float:
        """The estimate of a parameter."""
        return float(self.estimate[self.place(name)])

    def std(self, name: str) -> float:
        """Standard deviation of a parameter."""
        place = self.place(name)
        return float(np.sqrt(self.covariance[place, place]))

    def over(self, name: str, other: str) -> tuple[float, float]:
        """A parameter over another one, and its standard deviation."""
        one, two = self.place(name), self.place(other)
        ratio, c = self[name] / self[other], self.covariance
        variance = c[one, one] - 2.0 * ratio * c[one, two] + ratio**2 * c[two, two]
        return ratio, float(np.sqrt(max(variance, 0.0))) / abs(self[other])

    def wider(self, factor: FloatArray | float) -> Regression:
        """The same with each standard deviation times a factor."""
        larger = np.broadcast_to(factor, self.estimate.shape)
        return replace(self, covariance=self.covariance * np.outer(larger, larger))

    def clustered(self, begin: FloatArray) -> tuple[FloatArray, float, int]:
        """How much larger variances are if rows of a cluster err together; eq. (6) of 1986.

        Parameters
        ----------
        begin : (k,) array
            Number of the cluster of each row that was used, not decreasing.

        Returns
        -------
        each : (p,) array
            Cluster-robust variance of each parameter over that of `covariance`.
        mean : float
            The same over all directions.
        count : int
            Number of clusters; of a single one nothing is known, and the ratios are 1.
        """
        first = np.flatnonzero(np.diff(begin, prepend=-np.inf))
        count = first.size
        if count < 2:
            return np.ones(self.estimate.size), 1.0, count
        scale = np.sqrt(np.diag(self.covariance))
        root = np.linalg.cholesky(self.covariance / np.outer(scale, scale))
        scores = np.add.reduceat(self.rows[:, :-1] * self.residual[:, None], first, axis=0)
        scores = (scores * scale) @ root * np.sqrt(count / (count - 1))
        each = np.sum((scores @ root.T) ** 2, axis=0)
        return each, float(np.sum(scores**2) / scale.size), count


def regress(
    rows: Callable[[BoolArray], FloatArray] | FloatArray,
    free: Sequence[Free],
    cut: Cut | None = None,
) -> Regression:
    """Explain the left-hand side of rows by free parameters with priors.

    Parameters
    ----------
    rows : (n,) array, or function of which rows are used, (n,) bool array
        The left-hand side, with noise of unit variance; or a function that gives regressors and
        left-hand side (k, p + 1) with their noise made independent and of unit variance, which may
        depend on what is used.
    free : sequence of Free
    cut : Cut, optional
        Which rows are left out; default: none.

    Examples
    --------
    A mass that moves under an effort against a constant resistance, one row far off:

    >>> effort = np.array([10.0, 20.0, 30.0, 40.0, 50.0, 60.0])
    >>> change = effort / 4.0 - 2.0
    >>> change[3] += 40.0
    >>> free = [Free("1/m", effort, 1.0), Free("r/m", -np.ones(6), 10.0)]
    >>> found = regress(change, free, Cut(5.0, apart=9, rounds=2))
    >>> found.kept.tolist()
    [True, True, True, False, True, True]
    >>> round(found["1/m"], 2), round(found.over("r/m", "1/m")[0], 1)
    (0.25, 7.9)
    """
    mean, std = (np.array([getattr(each, name) for each in free]) for name in ("mean", "std"))
    kept = np.ones(free[0].column.size, dtype=bool)
    size = std.size
    prior = np.eye(size, size + 1)
    for left in reversed(range(1 if cut is None else cut.rounds)):
        if callable(rows):
            used = rows(kept)
        else:
            used = np.column_stack([each.column[kept] for each in free] + [rows[kept]])
        # In units of what is known beforehand, about what is expected.
        scaled = np.column_stack([used[:, :-1] * std, used[:, -1] - used[:, :-1] @ mean])
        triangle = np.asarray(np.linalg.qr(np.vstack([scaled, prior]), mode="r"))
        root = np.linalg.inv(triangle[:size, :size])
        estimate = mean + std * (root @ triangle[:size, -1])
        residual = used[:, -1] - used[:, :-1] @ estimate
        if cut is None or left == 0 or not np.any(far := cut.far(residual)):
            break
        kept[np.flatnonzero(kept)[far]] = False
    covariance = (root @ root.T) * np.outer(std, std)
    return Regression(tuple(each.name for each in free), estimate, covariance, used, residual, kept)


# --------------------------------------------------------------------------------------- recursive


@njit(inline="always")  # type: ignore[untyped-decorator]
def measure(
    size: int,
    estimate: FloatArray,
    upper: FloatArray,
    diagonal: FloatArray,
    gain: FloatArray,
    row: FloatArray,
    innovation: float,
    variance: float,
) -> None:
    """Bierman's update of the factors and the estimate by one sample of `variance`.

    `gain` (p,) is scratch.
    """
    tiny = np.finfo(estimate.dtype).tiny
    before = variance
    inverse = 1.0 / before
    for j in range(size):
        # f = Uᵀ x, component j; the columns to the right are not touched yet.
        f = row[j]
        for i in range(j):
            f += upper[i, j] * row[i]
        weighted = diagonal[j] * f
        alpha = before + f * weighted
        slope = -f * inverse
        inverse = 1.0 / alpha
        diagonal[j] = max(diagonal[j] * (before * inverse), tiny)
        for i in range(j):
            old = upper[i, j]
            upper[i, j] = old + slope * gain[i]
            gain[i] += weighted * old
        gain[j] = weighted
        before = alpha
    scale = innovation * inverse
    for i in range(size):
        estimate[i] += gain[i] * scale


@njit(inline="always")  # type: ignore[untyped-decorator]
def add_variance(
    upper: FloatArray,
    diagonal: FloatArray,
    dyad: FloatArray,
    which: int,
    variance: float,
) -> None:
    """Add `variance` to that of the one parameter `which`: Agee and Turner's rank-one update.

    `dyad` (p,) is scratch: the vector of the dyad, at first the unit vector `which`, so
    that the columns to the right of it stay as they are.
    """
    for i in range(which):
        dyad[i] = 0.0
    dyad[which] = 1.0
    for j in range(which, -1, -1):
        here = dyad[j]
        old = diagonal[j]
        inverse = 1.0 / (old + variance * here * here)
        diagonal[j] = old + variance * here * here
        share = variance * here * inverse
        for i in range(j):
            dyad[i] -= here * upper[i, j]
            upper[i, j] += share * dyad[i]
        variance *= old * inverse


@njit(inline="always")  # type: ignore[untyped-decorator]
def trace(size: int, upper: FloatArray, diagonal: FloatArray, weights: FloatArray) -> float:
    """Sum of the variances of the parameters, each times its weight."""
    total = 0.0
    for i in range(size):
        variance = diagonal[i]
        for j in range(i + 1, size):
            variance += upper[i, j] * upper[i, j] * diagonal[j]
        total += variance * weights[i]
    return total


@njit(inline="always")  # type: ignore[untyped-decorator]
def product(size: int, upper: FloatArray, diagonal: FloatArray, covariance: FloatArray) -> None:
    """Write ``U D Uᵀ`` into `covariance`."""
    for i in range(size):
        for j in range(i, size):
            total = upper[i, j] * diagonal[j]
            for m in range(j + 1, size):
                total += upper[i, m] * diagonal[m] * upper[j, m]
            covariance[i, j] = total
            covariance[j, i] = total


def transform(
    upper: FloatArray, diagonal: FloatArray, keep: FloatArray, added: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Factors after ``x <- keep * x + w``, ``w ~ (0, diag(added))``.

    The square roots of both parts stand side by side and are made triangular by reflections, from
    the last row up. Where `keep` is 0 a parameter starts anew, with the variance `added`.
    """
    roots = np.hstack([keep[:, None] * upper * np.sqrt(diagonal), np.diag(np.sqrt(added))])
    triangular = np.asarray(np.linalg.qr(roots[::-1].T, mode="r")).T[::-1, ::-1]
    scale = np.diagonal(triangular)
    floor = np.finfo(diagonal.dtype).tiny
    return np.ascontiguousarray(triangular / scale), np.maximum(scale**2, floor)


@cache
def recursion(size: int) -> Callable[..., FloatArray]:
    """The compiled recursion for `size` parameters, over a block in place.

    Loops of constant length compile to straight code, five times as fast. The compiled function
    returns the innovations, and records estimate and covariance after each sample where the last
    two arrays have rows.
    """

    def run(
        estimate: FloatArray,
        upper: FloatArray,
        diagonal: FloatArray,
        prior: FloatArray,
        walk: FloatArray,
        forgetting: float,
        rows: FloatArray,
        values: FloatArray,
        noise: FloatArray,
        estimate_after: FloatArray,
        covariance_after: FloatArray,
    ) -> FloatArray:
        innovations = np.empty_like(values)
        scratch, weights, leak = np.empty_like(prior), np.empty_like(prior), np.empty_like(prior)
        only = np.zeros_like(prior)
        inverse = 1.0 / forgetting
        walks, forgets = False, forgetting < 1.0
        # Before the guard the covariance is at most (prior + walk) / forgetting: this information
        # brings it back to the prior. The trace bounds what it is in any direction.
        for i in range(size):
            weights[i] = 1.0 / prior[i]
            leak[i] = (prior[i] * (1.0 - forgetting) + walk[i]) / (prior[i] * (prior[i] + walk[i]))
            walks = walks or walk[i] > 0.0
        for k in range(len(rows)):
            if walks:
                for i in range(size):
                    add_variance(upper, diagonal, scratch, i, walk[i])
            if forgets:
                for i in range(size):
                    diagonal[i] *= inverse
            if (walks or forgets) and trace(size, upper, diagonal, weights) > 1.0:
                for i in range(size):
                    if leak[i] > 0.0:
                        # A sample of the one parameter that confirms its estimate.
                        only[i] = 1.0
                        measure(size, estimate, upper, diagonal, scratch, only, 0.0, 1.0 / leak[i])
                        only[i] = 0.0
            # A variance that is the same for all samples comes once.
            variance = noise[k] if len(noise) > 1 else noise[0]
            innovation = values[k]
            for i in range(size):
                innovation -= rows[k, i] * estimate[i]
            innovations[k] = innovation
            measure(size, estimate, upper, diagonal, scratch, rows[k], innovation, variance)
            if k < estimate_after.shape[0]:
                for i in range(size):
                    estimate_after[k, i] = estimate[i]
                product(size, upper, diagonal, covariance_after[k])
        return innovations

    # Numba knows a cached function by its name: two sizes of one name, compiled by two processes,
    # are taken for each other in a third.
    run.__name__ = run.__qualname__ = f"recursion_{size}"
    compiled: Callable[..., FloatArray] = njit(cache=True)(run)
    return compiled


WELL_CONDITIONED = 300.0
"""Condition number up to which a result counts as valid: beyond it noise of the regressors, which
the recursion takes as exact, passes for excitation."""

ROUNDING = 1e-9
"""Of a period, by which a time may miss its multiple and still count as there."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RlsResult(EstimatorResult):
    """The parameters after the samples so far.

    Attributes
    ----------
    estimate : (p,) array
        Estimated parameters.
    covariance : (p, p) array
        In units of the measurement variance that was given with the samples.
    valid : bool
        Whether the data, rather than the prior, determine every direction of the estimate: at
        least as many samples as parameters, an excitation of at least 0.5, and a condition number
        of at most 300.
    excitation : float
        Share of the prior's standard deviation that the data have removed in the direction where
        it is least: 0 nothing was learnt there, 1 everything.
    condition : float
        Condition number of the information with its columns normalised.
    """

    condition: float


class RecursiveLeastSquares(Estimator):
    """Recursive least squares for ``y = xᵀ theta + e``, UD-factorised and compiled.

    Parameters
    ----------
    prior_std : (p,) array
        Standard deviation of each parameter before the first sample.
    prior_mean : (p,) array, optional
        Default 0.
    forgetting : float
        Forgetting factor gamma of Amirhosseini et al. (2024), eq. (19), in (0, 1]. A direction that
        the data do not excite is forgotten at most up to its prior variance (no windup).
    random_walk_std : (p,) array, optional
        Standard deviation of the change of each parameter between two samples. It follows slow
        changes without winding up and is to be preferred to forgetting.
    dtype : {float64, float32}

    Raises
    ------
    InputError
        If a parameter is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> speed = np.linspace(5.0, 30.0, 200)  # m/s
    >>> rows = np.column_stack([np.ones(200), speed, speed**2])
    >>> recursion = RecursiveLeastSquares(prior_std=[1e4, 1e3, 10.0])
    >>> _ = recursion.update(rows, rows @ [2_000.0, 40.0, 0.7], variance=1.0)
    >>> recursion.result().estimate.round(1)
    array([2.e+03, 4.e+01, 7.e-01])
    """

    kind, version = "trainlog/rls", 3
    settings = ("prior_std", "prior_mean", "forgetting", "random_walk_std", "dtype")
    memory = ("estimate", "upper", "diagonal")

    def __init__(
        self,
        prior_std: ArrayLike,
        *,
        prior_mean: ArrayLike | None = None,
        forgetting: float = 1.0,
        random_walk_std: ArrayLike | None = None,
        dtype: DTypeLike = np.float64,
    ) -> None:
        if np.dtype(dtype) not in (np.float64, np.float32):
            raise InputError(f"recursive least squares: dtype {dtype} is not float64 or float32")
        spread = np.atleast_1d(np.asarray(prior_std, dtype=dtype))
        size = spread.size
        mean, walk = (
            np.zeros(size, dtype) if each is None else np.atleast_1d(np.asarray(each, dtype=dtype))
            for each in (prior_mean, random_walk_std)
        )
        if spread.ndim != 1 or mean.shape != (size,) or walk.shape != (size,):
            raise InputError("recursive least squares: priors and noise need one value a parameter")
        if not (np.all(np.isfinite(spread)) and np.all(spread > 0.0)):
            raise InputError("recursive least squares: prior_std must be positive and finite")
        if not 0.0 < forgetting <= 1.0:
            raise InputError(
                f"recursive least squares: forgetting factor {forgetting} is not in (0, 1]"
            )
        if not (np.all(np.isfinite(walk)) and np.all(walk >= 0.0)):
            raise InputError("recursive least squares: random_walk_std must not be negative")
        self._prior_std, self._prior_mean, self._random_walk_std = spread, mean, walk
        self._forgetting, self._dtype = float(forgetting), np.dtype(dtype).name
        self._prior_variance, self._walk = spread**2, walk**2
        self._estimate = mean.copy()
        self._upper = np.eye(size, dtype=dtype)
        self._diagonal = self._prior_variance.copy()
        self._samples = self._resets = 0

    @property
    def size(self) -> int:
        """Number of parameters."""
        return int(self._estimate.size)

    def reset(self, parameters: Sequence[int] | None = None, *, keep_estimate: bool = True) -> None:
        """Return to the prior uncertainty: of all parameters, or of some.

        A partial reset leaves the marginal covariance of the other parameters as it is: what was
        learnt about them is kept. Where the gradient changes, Amirhosseini et al. (2024) reset in
        full.

        Parameters
        ----------
        parameters : sequence of int, optional
            Which ones; default all.
        keep_estimate : bool
            Whether the estimate stays (as there) or returns to the prior mean.

        Raises
        ------
        InputError
            If there is no such parameter.
        """
        chosen = np.ones(self.size, dtype=bool)
        if parameters is not None:
            if not all(0 <= which < self.size for which in parameters):
                raise InputError(
                    f"recursive least squares: cannot reset parameters {list(parameters)} of"
                    f" {self.size}, counted from 0"
                )
            chosen[:] = False
            chosen[list(parameters)] = True
        dtype = self._estimate.dtype
        self._upper, self._diagonal = transform(
            self._upper,
            self._diagonal,
            np.where(chosen, 0.0, 1.0).astype(dtype),
            np.where(chosen, self._prior_variance, 0.0).astype(dtype),
        )
        if not keep_estimate:
            self._estimate[chosen] = self._prior_mean[chosen]
        if chosen.all():
            self._samples = 0
        self._resets += 1

    def update(
        self, regressors: ArrayLike, measurements: ArrayLike, variance: ArrayLike = 1.0
    ) -> FloatArray:
        """Learn from one sample or from a block of them.

        Parameters
        ----------
        regressors : (n, p) or (p,) array
        measurements : (n,) array or float
        variance : (n,) array or float
            Variance of the measurements.

        Returns
        -------
        innovations : (n,) array
            Each measurement minus its prediction before it was used.

        Raises
        ------
        InputError
            If shapes do not fit, or a value is not finite, or a variance not positive.
        """
        rows, values, noise = self._checked(regressors, measurements, variance)
        nothing = np.empty((0, self.size), dtype=rows.dtype)
        return self._run(
            rows, values, noise, nothing, np.empty((0, *self._upper.shape), rows.dtype)
        )

    def record(
        self, regressors: ArrayLike, measurements: ArrayLike, variance: ArrayLike = 1.0
    ) -> tuple[FloatArray, FloatArray]:
        """`update`, keeping the estimate after each sample.

        Returns
        -------
        estimate : (n, p) array
        covariance : (n, p, p) array
        """
        rows, values, noise = self._checked(regressors, measurements, variance)
        estimate = np.empty(rows.shape, dtype=rows.dtype)
        covariance = np.empty((len(rows), self.size, self.size), dtype=rows.dtype)
        self._run(rows, values, noise, estimate, covariance)
        return estimate, covariance

    def result(self) -> RlsResult:
        """The estimate with its covariance, validity and excitation."""
        upper = self._upper.astype(np.float64)
        root = upper * np.sqrt(self._diagonal.astype(np.float64))
        scaled = root / np.sqrt(self._prior_variance.astype(np.float64))[:, None]
        excitation = float(np.clip(1.0 - np.linalg.svd(scaled, compute_uv=False)[0], 0.0, 1.0))
        square_root_information = np.linalg.inv(root)
        columns = square_root_information / np.linalg.norm(square_root_information, axis=0)
        singular = np.linalg.svd(columns, compute_uv=False)
        condition = float(singular[0] / max(singular[-1], np.finfo(np.float64).tiny))
        return RlsResult(
            estimate=self._estimate.copy(),
            covariance=np.asarray(root @ root.T, dtype=self._estimate.dtype),
            valid=(
                self._samples >= self.size
                and excitation >= CALIBRATED
                and condition <= WELL_CONDITIONED
            ),
            excitation=excitation,
            condition=condition,
            samples=self._samples,
            resets=self._resets,
        )

    def _checked(
        self, regressors: ArrayLike, measurements: ArrayLike, variance: ArrayLike
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        dtype = self._estimate.dtype
        rows = np.ascontiguousarray(np.atleast_2d(np.asarray(regressors, dtype=dtype)))
        values = np.ascontiguousarray(np.atleast_1d(np.asarray(measurements, dtype=dtype)))
        noise = np.ascontiguousarray(np.atleast_1d(np.asarray(variance, dtype=dtype)))
        if rows.shape != (values.size, self.size) or values.ndim != 1:
            raise InputError(
                f"recursive least squares: regressors of shape {rows.shape} do not fit"
                f" {values.size} measurements of {self.size} parameters"
            )
        if noise.shape not in ((1,), values.shape):
            raise InputError(
                f"recursive least squares: {noise.shape} variances do not fit"
                f" {values.size} measurements"
            )
        if not (np.isfinite(rows).all() and np.isfinite(values).all()):
            raise InputError("recursive least squares: a sample is not finite")
        if not np.all((noise > 0.0) & (noise < np.inf)):
            raise InputError("recursive least squares: a variance is not positive and finite")
        return rows, values, noise

    def _run(
        self,
        rows: FloatArray,
        values: FloatArray,
        noise: FloatArray,
        estimates: FloatArray,
        covariances: FloatArray,
    ) -> FloatArray:
        self._samples += len(values)
        return recursion(self.size)(
            self._estimate,
            self._upper,
            self._diagonal,
            self._prior_variance,
            self._walk,
            self._estimate.dtype.type(self._forgetting),
            rows,
            values,
            noise,
            estimates,
            covariances,
        )


def edges_crossed(edges: ArrayLike, positions: ArrayLike, before: float = np.nan) -> BoolArray:
    """Whether an edge of the map lies between each sample and the one before.

    Parameters
    ----------
    edges : (m,) array [m]
        Chainages where the gradient changes, increasing: the positions of a line's gradients.
    positions : (n,) array or float [m]
        Of the samples, in either direction. NaN is unknown; an edge passed meanwhile counts at the
        next sample that is known. They should be smoothed: noise about an edge crosses it often.
    before : float [m]
        Of the sample before the first, when positions come in blocks; NaN if there was none.

    Returns
    -------
    (n,) bool array
        An edge counts as reached by a sample that stands on it.

    Raises
    ------
    InputError
        If edges are not finite or do not increase.

    Examples
    --------
    >>> edges_crossed([0.0, 500.0], [480.0, 495.0, 510.0, 530.0])
    array([False, False,  True, False])
    """
    places = np.atleast_1d(np.asarray(edges, dtype=np.float64))
    if places.ndim != 1 or not (np.all(np.isfinite(places)) and np.all(np.diff(places) > 0.0)):
        raise InputError("resets: edges must be finite and increase", remedy="sort the edges")
    return _changes(
        np.concatenate(([before], np.atleast_1d(np.asarray(positions, dtype=np.float64)))),
        lambda known: np.searchsorted(places, known, side="right"),
    )


def periods_elapsed(period: float, times: ArrayLike, before: float = np.nan) -> BoolArray:
    """Whether a multiple of a period lies between each sample and the one before.

    Parameters
    ----------
    period : float [s]
    times : (n,) array or float [s]
        Since the recursion began.
    before : float [s]
        Of the sample before the first, NaN if there was none.

    Returns
    -------
    (n,) bool array

    Raises
    ------
    InputError
        If the period is not positive.

    Examples
    --------
    >>> periods_elapsed(1.0, [0.0, 0.6, 1.2, 1.8])
    array([False, False,  True, False])
    """
    if not (period > 0.0 and np.isfinite(period)):
        raise InputError(f"resets: a period of {period} s is not positive")
    return _changes(
        np.concatenate(([before], np.atleast_1d(np.asarray(times, dtype=np.float64)))),
        lambda known: np.floor(known / period + ROUNDING),
    )


def record_with_resets(
    estimator: RecursiveLeastSquares,
    due: BoolArray,
    regressors: ArrayLike,
    measurements: ArrayLike,
    variance: ArrayLike = 1.0,
    *,
    parameters: Sequence[int] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Learn from a whole trip, resetting before each sample where a reset is due.

    Parameters
    ----------
    estimator : RecursiveLeastSquares
    due : (n,) bool array
        From `edges_crossed` or `periods_elapsed`.
    regressors, measurements, variance
        As for `RecursiveLeastSquares.update`: (n, p), (n,) and (n,) or a float.
    parameters : sequence of int, optional
        Which ones are reset; default all.

    Returns
    -------
    estimate : (n, p) array
        After each sample.
    covariance : (n, p, p) array

    Raises
    ------
    InputError
        If shapes do not fit or a sample cannot be used.

    Examples
    --------
    A constant that jumps after the third sample:

    >>> import numpy as np
    >>> recursion = RecursiveLeastSquares(prior_std=[10.0])
    >>> estimates, _ = record_with_resets(
    ...     recursion, np.arange(6) == 3, np.ones((6, 1)), [1.0, 1.0, 1.0, 4.0, 4.0, 4.0]
    ... )
    >>> estimates[:, 0].round(1)
    array([1., 1., 1., 4., 4., 4.])
    """
    rows = np.atleast_2d(np.asarray(regressors))
    values = np.atleast_1d(np.asarray(measurements))
    if np.shape(due) != values.shape or len(rows) != values.size:
        raise InputError(
            f"resets: {np.shape(due)} flags and {rows.shape} regressors do not fit"
            f" {values.size} measurements"
        )
    noise = np.broadcast_to(np.asarray(variance), values.shape)
    begins = np.unique(np.concatenate(([0], np.flatnonzero(due))))
    parts = []
    for begin, end in zip(begins, (*begins[1:], values.size), strict=True):
        if values.size and due[begin]:
            estimator.reset(parameters)
        part = slice(begin, end)
        parts.append(estimator.record(rows[part], values[part], noise[part]))
    estimates, covariances = zip(*parts, strict=True)
    return np.concatenate(estimates), np.concatenate(covariances)


def _changes(values: FloatArray, count: Callable[[Any], NDArray[Any]]) -> BoolArray:
    """Where `count` of a known value differs from that of the last known one before."""
    known = np.flatnonzero(np.isfinite(values))
    changed = np.zeros(values.size, dtype=np.bool_)
    changed[known[1:]] = np.diff(count(values[known])) != 0
    return changed[1:]

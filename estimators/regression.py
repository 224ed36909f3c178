"""One linear regression of rows of data on free parameters, each with what is known of it before.

Delay, gain, mass, coefficients of a curve, a gradient's offset: all are columns. A parameter of
which nothing is known has a wide prior, one that is known a narrow one; where the data say nothing
the prior is what is left. Rows far off are left out by one rule (`Cut`), and where neighbouring
rows err together `clustered` says by how much the covariance is too small.

The rows with those of the prior below them are made triangular by reflections: no products of
columns are taken, so that columns of very unlike size do no harm.

References
----------
Bierman, G. J. (1977), Factorization Methods for Discrete Sequential Estimation, ch. IV: the
square-root information of data and prior.
Liang, K.-Y., Zeger, S. L. (1986), Longitudinal data analysis using generalized linear models,
Biometrika 73(1), eq. (6).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trainlog.arrays import BoolArray, FloatArray, robust_std


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

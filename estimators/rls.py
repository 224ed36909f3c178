"""Recursive least squares in factorised form.

The covariance is kept as ``P = U D Uᵀ`` (U unit upper triangular, D diagonal) and only the
factors are updated (`estimators.factors`), so that it stays positive definite whatever the data:
the conventional recursion (paper 004, eqs. 15-17) loses that property after some hundred samples.

Forgetting and random walk make the covariance grow where the data say nothing. Windup is guarded
against: the covariance never exceeds the prior's in any direction. While it could, each sample is
followed by just so much confirmation of the estimate that an unexcited direction stays at its
prior variance, ``P⁻¹ <- gamma P⁻¹ + (1 - gamma) P₀⁻¹``; while the data hold it well below the
prior (the variances over their priors sum up to less than 1) the recursion is the plain one.

References
----------
Paper 004, eqs. (16), (19), (20) with the forgetting factor as corrected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from estimators.factors import all_finite, recursion, transform
from estimators.interface import (
    CALIBRATED,
    FloatArray,
    array_of,
    check_state,
    count_of,
    number_of,
    saved_state,
)
from trainlog.errors import InputError

STATE_KIND, STATE_VERSION = "trainlog/rls", 2
"""Of a saved state; the version is raised when its meaning changes."""

WELL_CONDITIONED = 300.0
"""Condition number up to which a result counts as valid: beyond it noise of the regressors, which
the recursion takes as exact, passes for excitation."""


@dataclass(frozen=True, eq=False)
class RlsResult:
    """What the recursion knows after the samples so far.

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
        Share of the prior's standard deviation that the data have removed in the direction that
        they tell least about: 0 nothing was learnt there, 1 everything.
    condition : float
        Condition number of the information with its columns normalised.
    samples : int
        Samples since the last full reset.
    resets : int
        Resets so far, full and partial.
    """

    estimate: FloatArray
    covariance: FloatArray
    valid: bool
    excitation: float
    condition: float
    samples: int
    resets: int


class RecursiveLeastSquares:
    """Recursive least squares for ``y = xᵀ theta + e``, UD-factorised and compiled.

    Parameters
    ----------
    prior_std : (p,) array
        Standard deviation of each parameter before the first sample.
    prior_mean : (p,) array, optional
        Default 0.
    forgetting : float
        Forgetting factor gamma of paper 004, eq. (19), in (0, 1]. A direction that the data do
        not excite is forgotten at most up to its prior variance (no windup).
    random_walk_std : (p,) array, optional
        Standard deviation of the change of each parameter between two samples. It follows slow
        changes without winding up and is to be preferred to forgetting.
    dtype : {float64, float32}

    Raises
    ------
    InputError
        If a parameter is out of range.
    """

    def __init__(
        self,
        prior_std: ArrayLike,
        *,
        prior_mean: ArrayLike | None = None,
        forgetting: float = 1.0,
        random_walk_std: ArrayLike | None = None,
        dtype: DTypeLike = np.float64,
    ) -> None:
        spread = np.atleast_1d(np.asarray(prior_std, dtype=dtype))
        size = spread.size
        mean = np.zeros(size) if prior_mean is None else np.atleast_1d(prior_mean)
        walk = np.zeros(size) if random_walk_std is None else np.atleast_1d(random_walk_std)
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
        self._prior_mean = mean.astype(dtype)
        self._prior_variance = spread**2
        self._forgetting = float(forgetting)
        self._walk = walk.astype(dtype) ** 2
        self._estimate = self._prior_mean.copy()
        self._upper = np.eye(size, dtype=dtype)
        self._diagonal = self._prior_variance.copy()
        self._samples = 0
        self._resets = 0

    @property
    def size(self) -> int:
        """Number of parameters."""
        return int(self._estimate.size)

    def reset(self, parameters: Sequence[int] | None = None, *, keep_estimate: bool = True) -> None:
        """Return to the prior uncertainty: of all parameters, or of some.

        A partial reset leaves the marginal covariance of the other parameters as it is: what was
        learnt about them is kept. Paper 004 resets in full where the gradient changes.

        Parameters
        ----------
        parameters : sequence of int, optional
            Which ones; default all.
        keep_estimate : bool
            Whether the estimate stays (as in the paper) or returns to the prior mean.

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
        transform(
            self._upper,
            self._diagonal,
            np.where(chosen, 0.0, 1.0).astype(self._estimate.dtype),
            np.where(chosen, self._prior_variance, 0.0).astype(self._estimate.dtype),
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

    def state(self) -> dict[str, Any]:
        """Everything needed to go on later, bit for bit; plain values that JSON can hold."""
        return saved_state(
            STATE_KIND,
            STATE_VERSION,
            {
                "dtype": self._estimate.dtype.name,
                "forgetting": self._forgetting,
                "samples": self._samples,
                "resets": self._resets,
                **{name: getattr(self, f"_{name}") for name in _STATE_ARRAYS},
            },
        )

    @classmethod
    def resume(cls, state: Mapping[str, Any]) -> Self:
        """The estimator that `state` was taken from.

        Raises
        ------
        InputError
            If the state is of another kind or version, or incomplete.
        """
        settings = ("dtype", "forgetting", "samples", "resets")
        check_state(state, STATE_KIND, STATE_VERSION, (*settings, *_STATE_ARRAYS))
        if state["dtype"] not in ("float64", "float32"):
            raise InputError(f"state of {STATE_KIND!r}: dtype {state['dtype']!r} is not known")
        dtype, size = np.dtype(state["dtype"]), np.size(state["estimate"])
        arrays = {
            name: array_of(state, name, (size, size) if name == "upper" else (size,), dtype)
            for name in _STATE_ARRAYS
        }
        estimator = cls(
            np.sqrt(arrays["prior_variance"]),
            forgetting=number_of(state, "forgetting"),
            dtype=dtype,
        )
        estimator._samples = count_of(state, "samples")
        estimator._resets = count_of(state, "resets")
        for name, array in arrays.items():
            setattr(estimator, f"_{name}", array)
        return estimator

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
        if not (all_finite(rows) and all_finite(values)):
            raise InputError("recursive least squares: a sample is not finite")
        if not (all_finite(noise) and np.all(noise > 0.0)):
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


_STATE_ARRAYS = ("prior_mean", "prior_variance", "walk", "estimate", "upper", "diagonal")

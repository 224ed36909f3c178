"""Linear-Gaussian models: the one filter and the one smoother of all of them.

    x[i] = F x[i-1] + u[i] + w,   w ~ N(0, Q)
    z[i] = H x[i] + v,            v ~ N(0, diag(R))

A model is data: arrays of F, Q, u, H and R, which may differ from sample to sample. The filter runs
forward and takes the measurements one by one, so that nothing is ever inverted; what is missing, or
further from its prediction than its gate allows, is left out. The smoother runs backward over what
the filter left behind: Bierman's modified form of Bryson and Frazier's, which gives the numbers of
Rauch, Tung and Striebel without inverting a covariance, so that states without noise are no
exception. Both are compiled once, for one signature, whatever the model.

References
----------
Bierman, G. J. (1977), Factorization methods for discrete sequential estimation, ch. X: the
smoother, eqs. (X.2.13)-(X.2.20). Rauch, H. E., Tung, F., Striebel, C. T. (1965), Maximum likelihood
estimates of linear dynamic systems, AIAA Journal 3(8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from trainlog.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class LinearGaussian:
    """A linear-Gaussian model over n samples, for one or more series that it holds for alike.

    Attributes
    ----------
    transition, process_noise : (m, d, d) array
        F and Q.
    observation : (n, k, d) or (1, k, d) array
        H: what of the state each of the k measurements of a sample shows.
    step : (n,) int array, optional
        Which of the m transitions leads to each sample; default: sample i has its own, number i.
    shift : (n, series, d) array, optional
        u: known changes of the state, by inputs; default none.
    gate : (k, 2) array, optional
        A measurement is left out where it departs from its prediction by more than
        ``max(gate[k, 0], gate[k, 1] * std)``, std that of the prediction without the measurement's
        own noise; default never.
    """

    transition: FloatArray
    process_noise: FloatArray
    observation: FloatArray
    step: IntArray | None = None
    shift: FloatArray | None = None
    gate: FloatArray | None = None

    def filter(
        self, measured: ArrayLike, variances: ArrayLike, mean: ArrayLike, covariance: ArrayLike
    ) -> Filtered:
        """Run the filter forward.

        Parameters
        ----------
        measured : (n, series, k) or (n, k) array
            NaN what is missing.
        variances : array that broadcasts to the shape of `measured`
            R, of the measurements' noise.
        mean : (series, d) or (d,) array
            Of the state before the first transition.
        covariance : (series, d, d) or (d, d) array

        Returns
        -------
        Filtered
            Without the axis of the series where `measured` has none.

        Examples
        --------
        A constant, measured twice:

        >>> import numpy as np
        >>> model = LinearGaussian(np.ones((1, 1, 1)), np.zeros((1, 1, 1)), np.ones((1, 1, 1)),
        ...                        step=np.zeros(2, dtype=int))
        >>> found = model.filter([[2.0], [4.0]], 1.0, [0.0], [[1e6]])
        >>> found.means[:, 0].round(3), found.covariances[:, 0, 0].round(3)
        (array([2., 3.]), array([1. , 0.5]))
        """
        return self._forward(measured, variances, mean, covariance)[0]

    def smooth(
        self, measured: ArrayLike, variances: ArrayLike, mean: ArrayLike, covariance: ArrayLike
    ) -> Filtered:
        """Estimate each state from all measurements, earlier and later ones.

        Parameters are those of `filter`.

        Examples
        --------
        The first of two states of a random walk, when only the second was measured:

        >>> import numpy as np
        >>> model = LinearGaussian(np.ones((2, 1, 1)), np.array([[[0.0]], [[1.0]]]),
        ...                        np.ones((1, 1, 1)))
        >>> found = model.smooth([[np.nan], [3.0]], 1.0, [0.0], [[1.0]])
        >>> found.means[:, 0].round(3), found.covariances[:, 0, 0].round(3)
        (array([1., 2.]), array([0.667, 0.667]))
        """
        found, (transition, step, observation, *rest) = self._forward(
            measured, variances, mean, covariance
        )
        several = found.means.ndim == 3
        means, covariances, used = (
            each if several else each[:, None]
            for each in (found.means, found.covariances, found.used)
        )
        _backward(transition, step, observation, used, *rest, means, covariances)
        return found

    def _forward(
        self, measured: ArrayLike, variances: ArrayLike, mean: ArrayLike, covariance: ArrayLike
    ) -> tuple[Filtered, tuple[NDArray[np.generic], ...]]:
        used = np.array(measured, dtype=np.float64, order="C")
        single = used.ndim == 2
        if single:
            used = used[:, None]
        count, series, channels = used.shape
        spread = np.asarray(variances, dtype=np.float64)
        if single and spread.ndim == 2:
            spread = spread[:, None]
        spread = np.ascontiguousarray(np.broadcast_to(spread, used.shape))
        rank = self.transition.shape[-1]
        start = np.array(mean, dtype=np.float64).reshape(series, rank)
        spread_at_start = np.array(covariance, dtype=np.float64).reshape(series, rank, rank)
        step = np.arange(count) if self.step is None else self.step
        shift = np.zeros((1, series, rank)) if self.shift is None else self.shift
        gate = np.full((channels, 2), np.inf) if self.gate is None else self.gate
        transition, process_noise, observation = (
            np.ascontiguousarray(each, dtype=np.float64)
            for each in (self.transition, self.process_noise, self.observation)
        )
        step = np.ascontiguousarray(step, dtype=np.int64)
        means = np.empty((count, series, rank))
        covariances = np.empty((count, series, rank, rank))
        innovations, sums = np.zeros(used.shape), np.ones(used.shape)
        gains = np.zeros((*used.shape, rank))
        _forward(
            transition, step, process_noise, np.ascontiguousarray(shift, dtype=np.float64),
            observation, used, spread, np.ascontiguousarray(gate, dtype=np.float64),
            start, spread_at_start, means, covariances, innovations, sums, gains,
        )  # fmt: skip
        asked = np.asarray(measured, dtype=np.float64).reshape(used.shape)
        parts = (means, covariances, asked, used, innovations, sums)
        found = Filtered(*(each[:, 0] if single else each for each in parts))
        return found, (transition, step, observation, innovations, sums, gains)


@dataclass(frozen=True, eq=False)
class Filtered:
    """States after each sample.

    Attributes
    ----------
    means : (n, series, d) or (n, d) array
    covariances : (n, series, d, d) or (n, d, d) array
    measured, used : (n, series, k) or (n, k) array
        The measurements; those used are NaN where one was missing or left out.
    innovations, sums : (n, series, k) or (n, k) array
        How far each departed from its prediction, and the variance of that.
    """

    means: FloatArray
    covariances: FloatArray
    measured: FloatArray
    used: FloatArray
    innovations: FloatArray
    sums: FloatArray

    @property
    def std(self) -> FloatArray:
        """Standard deviation of each state, shaped like `means`."""
        variances = np.diagonal(self.covariances, axis1=-2, axis2=-1)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))

    def log_likelihood(self, outlier: float = np.inf) -> float:
        """Logarithm of the likelihood of the measurements, up to a constant a measurement.

        Parameters
        ----------
        outlier : float
            What a measurement that departs from its prediction costs at most, and what one costs
            that was left out.

        Examples
        --------
        >>> import numpy as np
        >>> model = LinearGaussian(np.ones((2, 1, 1)), np.zeros((2, 1, 1)), np.ones((1, 1, 1)))
        >>> found = model.filter([[2.0], [4.0]], 1.0, [0.0], [[1.0]])
        >>> round(found.log_likelihood(), 3)  # -(4/2 + 9/1.5 + log 3) / 2
        -4.549
        """
        used = np.isfinite(self.used)
        left_out = np.isfinite(self.measured) & ~used
        sums = self.sums[used]
        cost = np.minimum(0.5 * self.innovations[used] ** 2 / sums, outlier)
        unseen = float(np.count_nonzero(left_out))
        usual = 0.5 * float(np.median(np.log(sums))) if sums.size else 0.0
        seen = float(np.sum(cost + 0.5 * np.log(sums)))
        return -seen - (unseen * (outlier + usual) if unseen else 0.0)


def random_walk_slope(
    steps: FloatArray, rate: float, factor: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Transition and process noise of ``dx/dt = factor b``, ``db = rate dB``, a Brownian motion.

    Parameters
    ----------
    steps : (n,) array [s]
    rate : float [unit of b/s^0.5]
    factor : float

    Returns
    -------
    transition, process_noise : (n, 2, 2) array
        Of x and b over each step.

    Examples
    --------
    >>> import numpy as np
    >>> transition, noise = random_walk_slope(np.array([2.0]), rate=1.0)
    >>> transition[0].tolist(), noise[0].round(3).tolist()
    ([[1.0, 2.0], [0.0, 1.0]], [[2.667, 2.0], [2.0, 2.0]])
    """
    transition, noise = np.zeros((2, steps.size, 2, 2))
    transition[:, 0, 0] = transition[:, 1, 1] = 1.0
    transition[:, 0, 1] = factor * steps
    noise[:, 0, 0] = factor**2 * steps**3 / 3.0
    noise[:, 0, 1] = noise[:, 1, 0] = factor * steps**2 / 2.0
    noise[:, 1, 1] = steps
    return transition, rate**2 * noise


def corrected(
    mean: FloatArray,
    covariance: FloatArray,
    row: FloatArray,
    innovation: float,
    noise: float,
    gain: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of a state after one measurement, for filters that run sample by sample.

    Parameters
    ----------
    mean, covariance : (d,), (d, d) array
    row : (d,) array
        What of the state the measurement shows.
    innovation : float
        How far it departs from its prediction.
    noise : float
        Variance of its noise.
    gain : (d,) array
        Any; the covariance is Joseph's, which holds for all.

    Examples
    --------
    >>> import numpy as np
    >>> corrected(np.zeros(1), np.eye(1), np.ones(1), 3.0, 2.0, np.ones(1) / 3.0)
    (array([1.]), array([[0.66666667]]))
    """
    change = np.eye(mean.size) - gain[:, None] * row
    spread = change.dot(covariance).dot(change.T) + (noise * gain)[:, None] * gain
    return mean + gain * innovation, spread


# Plain loops over scalars: each compiles in a tenth of the time that array expressions take, and
# the matrices are too small for calls of BLAS to pay.


@njit(cache=True)  # type: ignore[untyped-decorator]
def _turn(matrix: FloatArray, inner: FloatArray, half: FloatArray, transposed: bool) -> None:
    """``inner <- M inner Mᵀ`` in place, M being `matrix` or its transpose; `half` is scratch."""
    rank = inner.shape[0]
    for i in range(rank):
        for j in range(rank):
            half[i, j] = 0.0
        for m in range(rank):
            weight = matrix[m, i] if transposed else matrix[i, m]
            if weight != 0.0:
                for j in range(rank):
                    half[i, j] += weight * inner[m, j]
    for i in range(rank):
        for j in range(i, rank):
            total = 0.0
            for m in range(rank):
                weight = matrix[m, j] if transposed else matrix[j, m]
                if weight != 0.0:
                    total += half[i, m] * weight
            inner[i, j] = total
            inner[j, i] = total


@njit(cache=True)  # type: ignore[untyped-decorator]
def _forward(
    transition: FloatArray,
    step: IntArray,
    noise: FloatArray,
    shift: FloatArray,
    observation: FloatArray,
    measured: FloatArray,
    variances: FloatArray,
    gate: FloatArray,
    start: FloatArray,
    start_covariance: FloatArray,
    means: FloatArray,
    covariances: FloatArray,
    innovations: FloatArray,
    sums: FloatArray,
    gains: FloatArray,
) -> None:
    """Filter; what is left out becomes NaN in `measured`."""
    count, series, channels = measured.shape
    rank = start.shape[1]
    half, shared, before = np.empty((rank, rank)), np.empty(rank), np.empty(rank)
    for s in range(series):
        mean, covariance = start[s], start_covariance[s]
        for i in range(count):
            at = step[i]
            for a in range(rank):
                before[a] = mean[a]
            for a in range(rank):
                total = shift[min(i, shift.shape[0] - 1), s, a]
                for b in range(rank):
                    total += transition[at, a, b] * before[b]
                mean[a] = total
            _turn(transition[at], covariance, half, False)
            for a in range(rank):
                for b in range(rank):
                    covariance[a, b] += noise[at, a, b]
            row = min(i, observation.shape[0] - 1)
            for k in range(channels):
                if np.isnan(measured[i, s, k]):
                    continue
                innovation, spread = measured[i, s, k], 0.0
                for a in range(rank):
                    total = 0.0
                    for b in range(rank):
                        total += covariance[a, b] * observation[row, k, b]
                    shared[a] = total
                    spread += observation[row, k, a] * total
                    innovation -= observation[row, k, a] * mean[a]
                if abs(innovation) > max(gate[k, 0], gate[k, 1] * np.sqrt(max(spread, 0.0))):
                    measured[i, s, k] = np.nan
                    continue
                spread += variances[i, s, k]
                innovations[i, s, k], sums[i, s, k] = innovation, spread
                for a in range(rank):
                    gain = shared[a] / spread
                    gains[i, s, k, a] = gain
                    mean[a] += gain * innovation
                    for b in range(a, rank):
                        covariance[a, b] -= gain * shared[b]
                        covariance[b, a] = covariance[a, b]
            for a in range(rank):
                means[i, s, a] = mean[a]
                for b in range(rank):
                    covariances[i, s, a, b] = covariance[a, b]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _backward(
    transition: FloatArray,
    step: IntArray,
    observation: FloatArray,
    used: FloatArray,
    innovations: FloatArray,
    sums: FloatArray,
    gains: FloatArray,
    means: FloatArray,
    covariances: FloatArray,
) -> None:
    """Smoother, in place of what the filter left: the adjoint state and its covariance."""
    count, series, channels = used.shape
    rank = means.shape[2]
    half, pulled, product = np.empty((rank, rank)), np.empty(rank), np.empty((rank, rank))
    adjoint, information = np.empty(rank), np.empty((rank, rank))
    for s in range(series):
        for a in range(rank):
            adjoint[a] = 0.0
            for b in range(rank):
                information[a, b] = 0.0
        for i in range(count - 1, -1, -1):
            for a in range(rank):
                for b in range(rank):
                    means[i, s, a] -= covariances[i, s, a, b] * adjoint[b]
                    product[a, b] = information[a, b]
            _turn(covariances[i, s], product, half, False)
            for a in range(rank):
                for b in range(rank):
                    covariances[i, s, a, b] -= product[a, b]
            row = min(i, observation.shape[0] - 1)
            for k in range(channels - 1, -1, -1):
                if np.isnan(used[i, s, k]):
                    continue
                weight = 1.0 / sums[i, s, k]
                force = innovations[i, s, k] * weight
                for a in range(rank):
                    force += gains[i, s, k, a] * adjoint[a]
                    total = 0.0
                    for b in range(rank):
                        total += information[a, b] * gains[i, s, k, b]
                    pulled[a] = total
                    weight += gains[i, s, k, a] * total
                for a in range(rank):
                    shown = observation[row, k, a]
                    adjoint[a] -= shown * force
                    for b in range(rank):
                        other = observation[row, k, b]
                        information[a, b] += (
                            shown * other * weight - shown * pulled[b] - pulled[a] * other
                        )
            at = step[i]
            for a in range(rank):
                total = 0.0
                for b in range(rank):
                    total += transition[at, b, a] * adjoint[b]
                pulled[a] = total
            for a in range(rank):
                adjoint[a] = pulled[a]
            _turn(transition[at], information, half, True)

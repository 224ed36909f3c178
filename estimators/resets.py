"""When a recursion has to forget: where the line changes, or every so often.

Paper 004 learns the sum of a constant resistance and the gradient's force as one parameter. Where
the gradient changes that parameter jumps, and what was learnt of it holds no longer: the recursion
is reset where the map has an edge (spatial reset), in full as in the paper, or for the constant
term alone, which keeps what was learnt about the others. A reset every so many seconds (time
reset) needs no map and does worse.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.interface import FloatArray
from estimators.rls import RecursiveLeastSquares
from trainlog.errors import InputError

BoolArray = NDArray[np.bool_]

ROUNDING = 1e-9
"""Of a period, by which a time may miss its multiple and still count as there."""


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


def _changes(values: NDArray[np.float64], count: Callable[[Any], NDArray[Any]]) -> BoolArray:
    """Where what `count` says of the known values differs from the last known one before."""
    known = np.flatnonzero(np.isfinite(values))
    changed = np.zeros(values.size, dtype=np.bool_)
    changed[known[1:]] = np.diff(count(values[known])) != 0
    return changed[1:]

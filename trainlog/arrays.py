"""Names of array types, and what is asked of any array."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex128]
UintArray = NDArray[np.uint64]

MEDIAN_TO_STD = 1.4826
"""Standard deviation of normal noise over the median of its size."""


def robust_std(deviations: ArrayLike) -> float:
    """Standard deviation of normal noise from the median of its size; outliers do not move it.

    Parameters
    ----------
    deviations : array_like
        From the middle of the series, at least one.

    References
    ----------
    Rousseeuw, P. J., Croux, C. (1993). Alternatives to the median absolute deviation. Journal of
    the American Statistical Association 88, 1273-1283.

    Examples
    --------
    >>> round(robust_std([-1.0, 0.5, 1.0, 200.0]), 4)
    1.4826
    """
    size = np.asarray(np.abs(deviations), dtype=np.float64).ravel()
    if not size.size or np.isnan(size).any():
        return float("nan")
    # As `numpy.median`, whose checks take longer than a short series does.
    half = size.size // 2
    ordered = np.partition(size, half if size.size % 2 else (half - 1, half))
    middle = ordered[half] if size.size % 2 else 0.5 * (ordered[half - 1] + ordered[half])
    return MEDIAN_TO_STD * float(middle)


def numbered(counts: IntArray) -> tuple[IntArray, IntArray]:
    """Rows of which each of several owners has so many: the owner, and the number among its own.

    Examples
    --------
    >>> numbered(np.array([2, 0, 3]))
    (array([0, 0, 2, 2, 2]), array([0, 1, 0, 1, 2]))
    """
    owner = np.repeat(np.arange(counts.size), counts)
    return owner, np.arange(owner.size) - np.repeat(np.cumsum(counts) - counts, counts)


def same_values(first: Any, second: Any) -> bool:
    """Whether two values are of one type and equal, number for number; NaN equals NaN.

    Examples
    --------
    >>> same_values({"speed": np.array([1.0, np.nan])}, {"speed": np.array([1.0, np.nan])})
    True
    >>> same_values(np.zeros(2), np.zeros(3))
    False
    """
    if first is second:
        return True
    if isinstance(first, float | np.floating) and isinstance(second, float | np.floating):
        return bool(first == second or (np.isnan(first) and np.isnan(second)))
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return first.keys() == second.keys() and all(
            same_values(value, second[key]) for key, value in first.items()
        )
    import pandas as pd  # takes a while, and the help of the commands needs none of it

    if type(first) is not type(second):
        return False
    if isinstance(first, np.ndarray):
        return np.array_equal(first, second, equal_nan=first.dtype.kind in "fc")
    if isinstance(first, pd.DataFrame | pd.Series | pd.Index):
        return bool(first.equals(second))
    if hasattr(first, "tocoo"):  # a sparse array of SciPy, which need not be installed
        return bool(first.shape == second.shape and (first != second).nnz == 0)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(same_values, first, second))
    if is_dataclass(first):
        names = [each.name for each in fields(first) if each.compare]
        return all(same_values(getattr(first, name), getattr(second, name)) for name in names)
    by_identity: Any = object.__eq__
    if type(first).__eq__ is by_identity and hasattr(first, "__dict__"):
        return same_values(vars(first), vars(second))
    return bool(first == second)

"""Names of array types, and the robust scale of a series: needs NumPy only."""

from __future__ import annotations

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
    return MEDIAN_TO_STD * float(np.median(np.abs(deviations)))

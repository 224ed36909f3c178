"""The errors of a satellite receiver, sized on its own trip: how large, and how long they last.

Errors are taken from series of one value a second. Half the mean square of their differences over
a lag (the structure function) is the variance that does not last so long; white noise and a
first-order Markov process are fitted to it. A position's errors are seen beside the track, where a
train on rails cannot be; those of a speed where its integral departs from the positions by more
than these explain.

References
----------
Allan, D. W. (1966), Statistics of atomic frequency standards, Proc. IEEE 54(2): differences over
lags separate noise from what wanders.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

BLOCK = 1.0
"""Samples within this time [s] are one value of a series: receivers filter over a second."""

LAGS = np.array([1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0])
"""Lags of the structure function [s]."""

TIMES = np.array([2.0, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0])
"""Correlation times that are tried [s]."""

WINSOR = 4.5
"""Differences beyond this many of their median sizes count as this many."""

MEDIAN_TO_STD = 1.4826
"""Standard deviation of normal noise over the median of its size."""

LEAST_SHARE, ENOUGH = 0.1, 30.0
"""Part of the largest structure function that adds to the uncertainty of each, and the number of
independent pairs beyond which more of them do not make a lag count more."""

LEAST_PAIRS = 20
"""Pairs of values from which on a lag is used."""


@dataclass(frozen=True)
class ReceiverNoise:
    """Noise of a measurement: white, and a part that lasts.

    Attributes
    ----------
    white : float
        Standard deviation of the mean over a `BLOCK`.
    lasting : float
        Standard deviation of the part that lasts.
    time : float [s]
        Correlation time of that part.
    """

    white: float
    lasting: float
    time: float

    @property
    def std(self) -> float:
        """Standard deviation of both parts together."""
        return float(np.hypot(self.white, self.lasting))


@dataclass(frozen=True, eq=False)
class Series:
    """Means over blocks; (n,) arrays.

    Attributes
    ----------
    seconds : array [s]
    values : array
    count : int array
        Samples in each block.
    owner : (m,) int array
        Block of each sample; -1 for samples that are in none.
    """

    seconds: FloatArray
    values: NDArray[Any]
    count: IntArray
    owner: IntArray


def series_of(seconds: FloatArray, values: NDArray[Any], block: float = BLOCK) -> Series:
    """Means of samples over blocks of time; what is not finite is left out.

    Examples
    --------
    >>> import numpy as np
    >>> found = series_of(np.array([0.0, 0.5, 1.0, 7.0]), np.array([1.0, 3.0, 5.0, np.nan]))
    >>> found.values, found.count
    (array([2., 5.]), array([2, 1]))
    """
    known = np.flatnonzero(np.isfinite(values))
    _, number, count = np.unique(
        np.floor(seconds[known] / block), return_inverse=True, return_counts=True
    )
    owner = np.full(values.size, -1, dtype=np.int64)
    owner[known] = number
    part = values[known]
    means = np.bincount(number, part.real) / count
    if np.iscomplexobj(part):
        means = means + 1j * np.bincount(number, part.imag) / count
    return Series(np.bincount(number, seconds[known]) / count, means, count, owner)


def pairs_at(seconds: FloatArray, lag: float) -> tuple[IntArray, IntArray]:
    """Numbers of the values a lag apart, to within half a block or an eighth of the lag.

    Examples
    --------
    >>> import numpy as np
    >>> pairs_at(np.array([0.0, 1.0, 2.0, 9.0]), 2.0)
    (array([0]), array([2]))
    """
    slack = max(0.5 * BLOCK, lag / 8.0)
    later = np.searchsorted(seconds, seconds + lag - slack)
    first = np.flatnonzero(later < seconds.size)
    second = later[first]
    close = seconds[second] - seconds[first] <= lag + slack
    # Of several, the one nearest to the lag.
    nearest = np.minimum(np.searchsorted(seconds, seconds[first] + lag), seconds.size - 1)
    nearer = np.abs(seconds[nearest] - seconds[first] - lag) < np.abs(
        seconds[second] - seconds[first] - lag
    )
    second = np.where(nearer, nearest, second)
    kept = close & (second > first)
    return first[kept], second[kept]


def mean_square(values: FloatArray) -> float:
    """Mean square in which values beyond `WINSOR` usual sizes count as these.

    Examples
    --------
    >>> import numpy as np
    >>> round(mean_square(np.array([1.0, -1.0, 1.0, 1000.0])), 1)
    11.9
    """
    if not values.size:
        return 0.0
    size = np.abs(values)
    usual = MEDIAN_TO_STD * float(np.median(size))
    bound = WINSOR * usual if usual > 0.0 else np.inf
    return float(np.mean(np.minimum(size, bound) ** 2))


def position_noise(seconds: FloatArray, beside: FloatArray) -> ReceiverNoise:
    """Noise of positions from their distances beside the track.

    Parameters
    ----------
    seconds, beside : (n,) arrays [s], [m]
        One value a block, without gaps filled.

    Returns
    -------
    ReceiverNoise
        In the unit of `beside`; the parts' variances sum up to at least that over the longest lag.

    Examples
    --------
    >>> import numpy as np
    >>> noise = 3.0 * np.random.default_rng(1).standard_normal(2_000)
    >>> found = position_noise(np.arange(2_000.0), noise)
    >>> bool(2.8 < found.std < 3.2), bool(found.lasting < 1.0)
    (True, True)
    """
    lags, halves, counts = structure(seconds, beside)
    if not lags.size:
        return ReceiverNoise(0.0, float(np.sqrt(mean_square(beside))), float(TIMES[4]))
    best, noise = np.inf, ReceiverNoise(0.0, 0.0, 1.0)
    # Errors that change smoothly begin with less than any such process: the long lags decide.
    unsure = halves + LEAST_SHARE * float(halves.max()) + 1e-12
    weight = np.sqrt(np.minimum(np.minimum(counts, np.ptp(seconds) / lags), ENOUGH)) / unsure
    for time in TIMES[lags[0] <= TIMES] if lags[0] < TIMES[-1] else TIMES[-1:]:
        shape = np.column_stack([np.ones(lags.size), -np.expm1(-lags / time)])
        parts, misfit = nnls(shape * weight[:, None], halves * weight)
        if misfit < best:
            best = misfit
            noise = ReceiverNoise(float(np.sqrt(parts[0])), float(np.sqrt(parts[1])), float(time))
    return noise


def structure(seconds: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lags, half the mean squares of differences over them, and the number of pairs.

    Examples
    --------
    >>> import numpy as np
    >>> lags, halves, counts = structure(np.arange(40.0), np.tile([1.0, -1.0], 20))
    >>> lags[:2], halves[:2], counts[:2]
    (array([1., 2.]), array([2., 0.]), array([39., 38.]))
    """
    found = []
    for lag in LAGS:
        first, second = pairs_at(seconds, lag)
        if first.size >= LEAST_PAIRS:
            apart = float(np.mean(seconds[second] - seconds[first]))
            half = 0.5 * mean_square(values[second] - values[first])
            found.append((apart, half, float(first.size)))
    lags, halves, counts = np.array(found).T if found else np.zeros((3, 0))
    return lags, halves, counts


def speed_noise(
    seconds: FloatArray,
    along: FloatArray,
    whole: FloatArray,
    beside: tuple[FloatArray, FloatArray],
    white: float,
) -> ReceiverNoise:
    """Noise of speeds from how far their integral departs from positions.

    Parameters
    ----------
    seconds : (n,) array [s]
    along : (n,) array [m]
        Positions less the integral of the speed.
    whole : (n,) array
        Grows where the speed is missing: only pairs of the same value are compared.
    beside : (lags, halves) [s], [m²]
        Structure function of the positions' own errors, of the distances beside the track.
    white : float [m/s]
        White noise of the speeds, from their own differences.

    Examples
    --------
    Speeds 0.4 m/s wrong for 20 s at a time, positions good to 2 m:

    >>> import numpy as np
    >>> generator = np.random.default_rng(1)
    >>> wrong = np.repeat(0.4 * generator.standard_normal(200), 20)
    >>> along = np.cumsum(wrong) + 2.0 * generator.standard_normal(4_000)
    >>> noise = np.array([1.0, 320.0]), np.array([4.0, 4.0])
    >>> found = speed_noise(np.arange(4_000.0), along, np.zeros(4_000), noise, 0.01)
    >>> bool(0.25 < found.lasting < 0.5)
    True
    """
    found = []
    for lag in LAGS[LAGS >= 4.0]:
        first, second = pairs_at(seconds, lag)
        kept = whole[first] == whole[second]
        first, second = first[kept], second[kept]
        if first.size < LEAST_PAIRS:
            continue
        apart = float(np.mean(seconds[second] - seconds[first]))
        square = mean_square(along[second] - along[first])
        fixes = 2.0 * float(np.interp(apart, *beside)) if beside[0].size else 0.0
        independent = min(first.size, np.ptp(seconds) / apart)
        # What cannot be excluded counts by half.
        unsure = square / np.sqrt(independent) + 1e-6 * apart
        excess = square - fixes - white**2 * apart + 0.5 * unsure
        found.append((apart, excess, unsure))
    if not found:
        return ReceiverNoise(white, 0.0, 10.0)
    lags, excess, unsure = np.array(found).T
    best, noise = np.inf, ReceiverNoise(white, 0.0, 10.0)
    for time in TIMES[TIMES <= 160.0]:
        share = lags / time
        shape = 2.0 * time**2 * (share + np.expm1(-share))
        parts, misfit = nnls((shape / unsure)[:, None], excess / unsure)
        if misfit < best:
            best, noise = misfit, ReceiverNoise(white, float(np.sqrt(parts[0])), float(time))
    return noise


def white_noise(values: FloatArray) -> float:
    """Standard deviation of white noise on a smooth series, from its second differences.

    Examples
    --------
    >>> import numpy as np
    >>> noise = 0.1 * np.random.default_rng(1).standard_normal(5_000)
    >>> round(white_noise(np.arange(5_000) / 50.0 + noise), 2)
    0.1
    """
    second = np.diff(values, 2)
    second = second[np.isfinite(second)]
    if not second.size:
        return 0.0
    # Most are small where values repeat, some large where a train begins to brake.
    size = np.minimum(np.abs(second), np.quantile(np.abs(second), 0.99))
    return float(np.sqrt(np.mean(size**2) / 6.0))

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
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import nnls

from trainlog.arrays import FloatArray, IntArray, robust_std

BLOCK = 1.0
"""Samples within this time [s] are one value of a series: receivers filter over a second."""

LAGS = np.array([1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0])
"""Lags of the structure function [s]."""

TIMES = np.array([2.0, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0])
"""Correlation times that are tried [s]."""

WINSOR = 4.5
"""Differences beyond this many of their median sizes count as this many."""

LEAST_SHARE, ENOUGH = 0.1, 30.0
"""Part of the largest structure function that adds to the uncertainty of each, and the number of
independent pairs beyond which more of them do not make a lag count more."""

HELD = 1.5
"""Times a value is repeated on average from which on values are held."""

LEAST_PAIRS = 20
"""Pairs of values from which on a lag is used."""

SLOPE_TIME = 1.0
"""Half the time [s] over which the wheels' acceleration is taken."""

DELAY_SPEED = 3.0
"""Speed [m/s] from which on delays are sought: slower, receivers state a standstill."""

CREEP_STD = 0.005
"""Standard deviation of the wheels' creep over their acceleration [s²/m], beforehand."""

DELAY_BLOCK = 20.0
"""Time [s] over which errors of speeds may last where their delay is sought."""

OUTLIER = 4.685
"""Residuals beyond this many standard deviations have no weight (Tukey's biweight)."""

LARGEST_GAP, WIDEST_GAP = 2.5, 30.0
"""Between speeds further apart [s], and than so many steps, none is interpolated; nor between those
further apart than the second, however wide the steps: a train stops and starts meanwhile."""

DELAY_TURNS, REWEIGHTED = 12, 5
"""Times the delay is sought around the one found, and the residuals are weighted anew each time."""

LEAST_DELAYED, LEAST_BLOCKS = 60, 8
"""Values, and blocks of time that hold them, from which on a delay is sought."""

LATEST_DELAY = 3.0
"""Largest delay [s] that is sought."""


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


@dataclass(frozen=True)
class Delay:
    """A delay and its standard deviation [s]."""

    value: float
    std: float


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
    usual = robust_std(size)
    bound = WINSOR * usual if usual > 0.0 else np.inf
    return float(np.mean(np.minimum(size, bound) ** 2))


def integral(seconds: FloatArray, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Integral of a speed [m] at every sample, and how long it was missing until then [s].

    Across gaps of the speed the integral goes on a line; a gap is longer than 2.5 s and 2.5 steps,
    or than 30 s.

    Examples
    --------
    >>> import numpy as np
    >>> integral(np.array([0.0, 1.0, 2.0]), np.array([4.0, np.nan, 6.0]))
    (array([ 0.,  5., 10.]), array([0., 0., 0.]))
    """
    known = np.flatnonzero(np.isfinite(speed))
    if known.size < 2:
        return np.full(speed.size, np.nan), np.zeros(speed.size)
    time, value = seconds[known], speed[known]
    steps = np.diff(time)
    late = steps > min(LARGEST_GAP * max(1.0, float(np.median(steps))), WIDEST_GAP)
    driven = cumulative_trapezoid(value, time, initial=0.0)
    missing = np.concatenate(([0.0], np.cumsum(np.where(late, steps, 0.0))))
    outside = np.maximum(seconds - time[-1], 0.0) - np.maximum(time[0] - seconds, 0.0)
    return (
        np.interp(seconds, time, driven) + np.where(outside > 0.0, value[-1], value[0]) * outside,
        np.interp(seconds, time, missing) + outside,
    )


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


def white_noise(values: FloatArray, hold: float = 1.0) -> float:
    """Standard deviation of white noise on a smooth series, from its second differences.

    Where each value is repeated `hold` times on average, so is its error: that of white noise which
    says as much taken together. A value that is held makes two second differences, not three.

    Examples
    --------
    >>> import numpy as np
    >>> noise = 0.1 * np.random.default_rng(1).standard_normal(5_000)
    >>> round(white_noise(np.arange(5_000) / 50.0 + noise), 2)
    0.1
    >>> held = np.repeat(noise, 4)
    >>> round(white_noise(held, 4.0), 2), round(0.1 * 4.0**0.5, 2)
    (0.2, 0.2)
    """
    second = np.diff(values, 2)
    second = second[np.isfinite(second)]
    if not second.size:
        return 0.0
    # Most are small where values repeat, some large where a train begins to brake.
    size = np.minimum(np.abs(second), np.quantile(np.abs(second), 0.99))
    repeats = np.sqrt(1.5) * hold if hold > HELD else 1.0
    return float(repeats * np.sqrt(np.mean(size**2) / 6.0))


@dataclass(frozen=True, eq=False)
class WheelSpeeds:
    """Speeds of the wheels, all of them finite; (n,) arrays.

    Attributes
    ----------
    seconds : array [s]
        Growing.
    speed : array [m/s]
    """

    seconds: FloatArray
    speed: FloatArray

    def at(self, seconds: FloatArray) -> FloatArray:
        """Speed [m/s] at any times [s], NaN in gaps longer than 2.5 s and outside."""
        after = np.searchsorted(self.seconds, seconds)
        after = np.clip(after, 1, self.seconds.size - 1)
        whole = self.seconds[after] - self.seconds[after - 1] <= LARGEST_GAP
        values = np.interp(seconds, self.seconds, self.speed, left=np.nan, right=np.nan)
        return np.where(whole, values, np.nan)

    def delay_of(self, seconds: FloatArray, speed: FloatArray) -> Delay | None:
        """By how much a satellite speed comes later than the wheels'; None if that is not known.

        Least squares of s(t) = (c + k a) w(t - d) for the delay d, the scale c of the wheels w and
        their creep k with the acceleration a, with Tukey's biweight against slip, iterated around
        the delay found. The standard deviation is that of errors which last over 20 s (the sandwich
        estimator with blocks), whatever their distribution.

        Examples
        --------
        >>> import numpy as np
        >>> time = np.arange(0.0, 600.0, 0.2)
        >>> wheels = WheelSpeeds(time, 12.0 + 8.0 * np.sin(time / 20.0))
        >>> noise = 0.05 * np.random.default_rng(1).standard_normal(time.size)
        >>> late = 12.0 + 8.0 * np.sin((time - 0.4) / 20.0)
        >>> found = wheels.delay_of(time, 1.01 * late + noise)
        >>> round(found.value, 1), found.std < 0.03
        (0.4, True)
        """
        if self.seconds.size < 2:
            return None
        delay, found = 0.0, None
        for _ in range(DELAY_TURNS):
            at = seconds - delay
            # What a scale, a delay and a creep of 1 add to the speed.
            own = self.at(at)
            slope = (self.at(at + SLOPE_TIME) - self.at(at - SLOPE_TIME)) / (2.0 * SLOPE_TIME)
            terms = np.column_stack([own, -slope, slope * own])
            kept = np.isfinite(terms).all(axis=1) & (speed > DELAY_SPEED)
            kept &= terms[:, 0] > DELAY_SPEED
            if np.count_nonzero(kept) < LEAST_DELAYED:
                return None
            found = _delay_in(terms[kept], speed[kept], at[kept])
            if found is None or abs(delay + found.value) > LATEST_DELAY:
                return None
            delay += found.value
            if abs(found.value) < max(1e-3, 0.1 * found.std):
                return Delay(delay, found.std)
        return None

    def delay_left(self, seconds: FloatArray, along: FloatArray, delay: float) -> Delay | None:
        """By how much positions come later still than a delay [s]; None if that is not known.

        From the distances between positions [m] 20 s apart and the integral of the wheels' speed.

        Examples
        --------
        >>> import numpy as np
        >>> time = np.arange(0.0, 600.0)
        >>> wheels = WheelSpeeds(time, 12.0 + 8.0 * np.sin(time / 20.0))
        >>> along = 12.0 * (time - 0.4) - 160.0 * np.cos((time - 0.4) / 20.0)
        >>> round(wheels.delay_left(time, along, 0.1).value, 1)
        0.3
        """
        fixes = series_of(seconds, along)
        if self.seconds.size < 2 or fixes.values.size < LEAST_DELAYED:
            return None
        at = fixes.seconds - delay
        driven, missing = integral(self.seconds, self.speed)
        speed = self.at(at)
        sums = np.column_stack(
            [np.interp(at, self.seconds, driven), -speed, 0.5 * speed**2, fixes.values]
        )
        absent = np.interp(at, self.seconds, missing)
        first, second = pairs_at(fixes.seconds, DELAY_BLOCK)
        change = sums[second] - sums[first]
        kept = np.isfinite(change).all(axis=1) & (absent[second] == absent[first])
        kept &= change[:, 0] > DELAY_SPEED * DELAY_BLOCK
        if np.count_nonzero(kept) < LEAST_DELAYED:
            return None
        return _delay_in(change[kept, :3], change[kept, 3], at[first[kept]], 2.0 * DELAY_BLOCK)


def _delay_in(
    terms: FloatArray, values: FloatArray, seconds: FloatArray, block: float = DELAY_BLOCK
) -> Delay | None:
    """The factor of the second of three terms, of scale, delay and creep, in some values."""
    factors = np.array([float(np.median(values / terms[:, 0])), 0.0, 0.0])
    prior = np.zeros((3, 3))
    inverse = np.eye(3)
    for _ in range(REWEIGHTED):
        residual = values - terms @ factors
        std = max(robust_std(residual), 1e-6)
        weight = np.maximum(1.0 - (residual / (OUTLIER * std)) ** 2, 0.0) ** 2
        prior[2, 2] = (std / CREEP_STD) ** 2
        weighted = terms * weight[:, None]
        normal = weighted.T @ terms + prior
        if np.linalg.matrix_rank(normal) < 3:
            return None
        inverse = np.linalg.inv(normal)
        factors = inverse @ (weighted.T @ values)
    residual = values - terms @ factors
    number = np.unique(np.floor(seconds / block), return_inverse=True)[1]
    if number.max() < LEAST_BLOCKS:
        return None
    scores = weighted * residual[:, None]
    sums = np.column_stack([np.bincount(number, scores[:, i]) for i in range(3)])
    spread = sums.T @ sums * len(sums) / (len(sums) - 3.0) + std**2 * prior
    return Delay(float(factors[1]), float(np.sqrt((inverse @ spread @ inverse)[1, 1])))

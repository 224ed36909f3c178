"""Whether the trips of a layer agree: the factor by which each finds more or less than the others.

Every trip finds the level of a place times a factor of its own, near 1. The level of a place is the
median over trips; a trip's factor is a posterior mean on a grid, from its onsets of slip and from
what it used without slip where others slipped. Both take turns (median polish: Tukey 1977,
Exploratory Data Analysis, chapter 11). Single places, as those where a spot passed, weigh little:
their error has a wide share.

A trip whose factor no ordinary spread between trips explains is of another rail condition than its
label. Where factors differ more than errors do, each trip's own is what its onsets have in common.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtr

from trainlog.arrays import BoolArray, FloatArray, IntArray, robust_std

ERROR = 0.09
"""Standard deviation of a trip's log adhesion about level and factor, beside its own."""

WIDE, OFTEN = 4.0, 0.15
"""Single places scatter by this factor more, and how often."""

ASTRAY = 0.02
"""Probability of any adhesion at a place, whatever its level: a spot, another place."""

ALIKE = 0.5
"""Weight of a bin: neighbours are of one slip."""

GRID = np.arange(-1.2, 1.201, 0.03)
"""Logarithms of factors that are tried."""

UNCHANGED = [GRID.size // 2]
"""Of them, the one of no change."""

PRIOR = 0.5
"""Standard deviation of the logarithm of a factor before any evidence."""

ORDINARY = 0.05
"""Standard deviation of the logarithm of factors that is in the spread between trips anyway."""

LEAST = 0.25
"""Logarithm of a factor below which a trip is of its condition."""

DOUBT = 3.0
"""Log likelihood ratio of such a factor to an ordinary one from which a trip is set aside."""

SPREAD = 6.0
"""Log likelihood ratio from which factors are taken to differ."""

APART = 0.12
"""Logarithm of the ratio of two directions from which they are taken to differ."""

LAGS = np.arange(-6, 7)
"""Bins by which a trip may be placed off the others."""

PLACED = 5.0
"""Log likelihood ratio to none from which on a lag counts."""

MOST = 60
"""Of more trips lags are not looked for, nor distributions of factors that are plainly ordinary."""

CHANGED = 8.0
"""Log likelihood ratio from which on all trips since one are taken to meet a changed line."""

STRANGERS = 10.0
"""Of so many trips one is of another condition, before any evidence."""

SIZES = 10
"""Classes of the standard deviations of onsets."""

SURE = 3
"""Bins in which a trip meets others from which on they show its factor."""

PLAIN = 0.12
"""Logarithm of a factor up to which a trip is plainly ordinary."""

ROUNDS = 6


@dataclass(frozen=True, eq=False)
class TripRows:
    """Evidence of the trips of one rail condition, as plain arrays.

    Attributes
    ----------
    trips, bins : int
    trip, bin : (m,) int array
        One row a trip and bin with onsets of slip.
    log, variance : (m,) array
        Log adhesion there, and the variance of its error.
    used_trip, used_bin : (n,) int array
    used_log : (n,) array
        Log adhesion that was used without slip.
    """

    trips: int
    bins: int
    trip: IntArray
    bin: IntArray
    log: FloatArray
    variance: FloatArray
    used_trip: IntArray
    used_bin: IntArray
    used_log: FloatArray

    def moved(self, lag: FloatArray) -> TripRows:
        """With each trip so many bins further; what leaves the line is left out."""
        step = np.rint(lag).astype(np.int64)
        place, used = self.bin + step[self.trip], self.used_bin + step[self.used_trip]
        own, levels = ((each >= 0) & (each < self.bins) for each in (place, used))
        return replace(self, bin=place, used_bin=used)._where(own, levels)

    def of(self, trips: BoolArray) -> TripRows:
        """Those of some trips; their numbers stay."""
        return self._where(trips[self.trip], trips[self.used_trip])

    def _where(self, own: BoolArray, used: BoolArray) -> TripRows:
        """Some rows with onsets, and some of what was used."""
        kept: dict[str, Any] = {
            name: column[used if name.startswith("used_") else own]
            for name, column in vars(self).items()
            if isinstance(column, np.ndarray)
        }
        return replace(self, **kept)


@dataclass(frozen=True, eq=False)
class Factors:
    """Factors of trips; arrays (trips,).

    Attributes
    ----------
    log, std : array
        Logarithm of the factor and its standard deviation.
    doubt : array
        Log likelihood ratio of the likeliest factor to the likeliest ordinary one.
    places : array
        Bins in which the trip meets others.
    """

    log: FloatArray
    std: FloatArray
    doubt: FloatArray
    places: FloatArray


def median_by(group: IntArray, values: FloatArray, size: int) -> FloatArray:
    """Median of the values of each group; NaN where there is none; (size,).

    Examples
    --------
    >>> median_by(np.array([0, 0, 0, 2]), np.array([1.0, 5.0, 2.0, 4.0]), 3)
    array([ 2., nan,  4.])
    """
    found = pd.Series(values).groupby(group).median()
    return np.asarray(found.reindex(np.arange(size)), dtype=np.float64)


def likelihoods(
    rows: TripRows, level: FloatArray, own: BoolArray, error: float, plain: float = 0.0
) -> FloatArray:
    """Log likelihood of each trip by its factor, (trips, grid).

    Rows count by how far they are off, in steps of the grid: a map has millions of them.

    Parameters
    ----------
    rows : TripRows
    level : (bins,) array
        Log level of each bin; NaN where it is not known.
    own : (m,) bool array
        Rows with onsets that count.
    error : float
        Standard deviation of a trip's log adhesion about level and factor, beside its own.
    plain : float
        Share of the places at which a trip finds the level itself, as where part of a line changed.
    """
    step, most = float(GRID[1] - GRID[0]), GRID.size
    off = step * np.arange(-most, most + 1)

    def cells(values: FloatArray) -> IntArray:
        found: IntArray = np.clip(np.rint(values / step), -most, most).astype(np.int64) + most
        return found

    std = np.hypot(error, np.sqrt(rows.variance[own]))
    size = np.minimum((np.log(std / error) / 0.2).astype(np.int64), SIZES - 1)
    cell = cells((rows.log - level[rows.bin])[own])
    place = (rows.trip[own] * SIZES + size) * off.size + cell
    count = np.bincount(place, minlength=rows.trips * SIZES * off.size)
    found = np.zeros((rows.trips, GRID.size))
    for number, counted in enumerate(count.reshape(rows.trips, SIZES, off.size).swapaxes(0, 1)):
        width = error * np.exp(0.2 * (number + 0.5 * (number > 0)))
        away, value = off[:, None] - GRID, np.full((off.size, GRID.size), ASTRAY)
        for share, wide in ((1.0 - OFTEN, width), (OFTEN, WIDE * width)):
            height = share / (np.sqrt(2.0 * np.pi) * wide)
            value = value + height * np.exp(-0.5 * (away / wide) ** 2)
        found += ALIKE * counted @ np.log((1.0 - plain) * value + plain * value[:, UNCHANGED])
    known = np.isfinite(level[rows.used_bin])
    cell = cells((level[rows.used_bin] - rows.used_log)[known])
    place = rows.used_trip[known] * off.size + cell
    count = np.bincount(place, minlength=rows.trips * off.size).reshape(rows.trips, off.size)
    borne = np.asarray(ndtr((off[:, None] + GRID) / error))
    borne = (1.0 - plain) * borne + plain * borne[:, UNCHANGED]
    return np.asarray(found + ALIKE * count @ np.log(ASTRAY + (1.0 - ASTRAY) * borne))


def factors_of(rows: TripRows, ordinary: BoolArray | None = None) -> tuple[Factors, FloatArray]:
    """Factor of each trip, and the level of each bin, (bins,).

    Parameters
    ----------
    rows : TripRows
    ordinary : (trips,) bool array, optional
        Trips that make the levels where any of them is; default: all.
    """
    makes = np.ones(rows.trips, dtype=np.bool_) if ordinary is None else ordinary
    own, log = makes[rows.trip], np.zeros(rows.trips)
    count = np.bincount(rows.bin[own], minlength=rows.bins)
    # A trip does not judge itself.
    several = count[rows.bin] - own > 0
    met = np.bincount(rows.trip[several], minlength=rows.trips)
    for _ in range(ROUNDS):
        level = median_by(rows.bin[own], (rows.log - log[rows.trip])[own], rows.bins)
        away = (rows.log - level[rows.bin])[several]
        log = np.nan_to_num(median_by(rows.trip[several], away, rows.trips))
        sure = makes & (met >= SURE)
        log = np.where(met >= SURE, log - (np.median(log[sure]) if sure.any() else 0.0), 0.0)
    left = np.abs(rows.log - level[rows.bin] - log[rows.trip])
    # The median of few is near each of them.
    left = (left * np.sqrt(count / np.maximum(count - 1.0, 0.5))[rows.bin])[several]
    error = ERROR
    if left.size >= SURE:
        error = float(np.clip(np.quantile(left, 0.7) / 1.04, ERROR, PRIOR))
    above = rows.used_log - level[rows.used_bin]
    # Where more trips used more without slip than slipped, these met a spot: the median trip's
    # level is higher, and not known.
    passed = (above - log[rows.used_trip] > ERROR) & makes[rows.used_trip]
    spots = np.bincount(rows.used_bin[passed], minlength=rows.bins) > count
    rows = rows._where(np.ones(rows.trip.size, dtype=np.bool_), ~spots[rows.used_bin])
    above = rows.used_log - level[rows.used_bin]
    known = np.isfinite(above)
    used = np.bincount(rows.used_trip[known], minlength=rows.trips)
    over = np.bincount(rows.used_trip[known], above[known] > PLAIN, minlength=rows.trips)
    # Of many trips those that are plainly ordinary need no distribution.
    strange = np.maximum(np.abs(log) / PLAIN, over / np.maximum(0.2 * used, 1.0)) + (met < SURE)
    asked = np.ones(rows.trips, dtype=np.bool_)
    if rows.trips > MOST:
        least = np.partition(strange, rows.trips - MOST)[rows.trips - MOST]
        asked = (strange > 1.0) & (strange >= least)
    std = np.where(met >= SURE, error / np.sqrt(ALIKE * np.maximum(met, 1)), PRIOR)
    some = rows.of(asked)
    likelihood, partly = (
        likelihoods(some, level, several[asked[rows.trip]], error, plain) for plain in (0.0, 0.5)
    )
    posterior = likelihood - 0.5 * (GRID / PRIOR) ** 2
    weight = np.exp(posterior - posterior.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    mean = weight @ GRID
    std = np.where(asked, np.sqrt(np.maximum(weight @ GRID**2 - mean**2, 1e-4)), std)
    sure = makes & (std < 0.5 * PRIOR)
    middle = float(np.median(np.where(asked, mean, log)[sure])) if sure.any() else 0.0
    log = np.where(std < 0.5 * PRIOR, np.where(asked, mean, log) - middle, 0.0)
    near = np.abs(GRID) <= max(LEAST - 0.05, 0.15)
    doubt = likelihood.max(axis=1) - likelihood[:, near].max(axis=1)
    # Where it differs at some places only, these changed or had a spot.
    doubt[likelihood.max(axis=1) < partly.max(axis=1) - DOUBT] = 0.0
    places = met + used
    return Factors(log, std, doubt, places.astype(np.float64)), level


def lags_of(rows: TripRows, factor: FloatArray) -> FloatArray:
    """Bins by which each trip is placed off the middle of all; 0 where that does not show.

    Each two trips are compared at all lags between them, and the lags are those that fit all pairs
    best.

    Parameters
    ----------
    rows : TripRows
    factor : (trips,) array
        Logarithms of the trips' factors.
    """
    lag = np.zeros(rows.trips)
    count = np.bincount(rows.trip, minlength=rows.trips)
    some = np.flatnonzero(count > 0)
    if not 2 <= some.size <= MOST:
        return lag
    pairs = _pairs(rows, factor, some)
    pairs = pairs + pairs.transpose(1, 0, 2)[:, :, ::-1]
    everyone, none = np.arange(some.size), np.zeros(some.size, dtype=np.int64)

    def by_lag(lags: IntArray) -> FloatArray:
        """Log likelihood of each trip at each lag, the others at theirs, (k, lags)."""
        apart = np.clip(LAGS[None, :] - lags[:, None], LAGS[0], LAGS[-1]) - LAGS[0]
        return np.asarray(pairs[:, everyone[:, None], apart].sum(axis=1))

    def total(lags: IntArray) -> float:
        return 0.5 * float(by_lag(lags)[everyone, lags - LAGS[0]].sum())

    best, most = none, total(none)
    for reference in everyone:
        lags = LAGS[np.argmax(pairs[:, reference], axis=1)]
        lags[reference] = 0
        for _ in range(ROUNDS):
            before = lags.copy()
            for trip in everyone:
                apart = np.clip(LAGS[None, :] - lags[:, None], LAGS[0], LAGS[-1]) - LAGS[0]
                value = pairs[trip, everyone[:, None], apart].sum(axis=0)
                lags[trip] = LAGS[int(np.argmax(value))]
            if np.array_equal(before, lags):
                break
        if (value_of := total(lags)) > most:
            best, most = lags, value_of
    # Each row counts once for every other trip.
    if (most - total(none)) / some.size <= PLACED:
        return lag
    best = best - int(np.median(best))
    # A trip that hardly shows its lag stays as near to the middle as it may be.
    value = by_lag(best) / some.size
    near = value >= value.max(axis=1, keepdims=True) - 1.0
    best = LAGS[np.argmin(np.where(near, np.abs(LAGS), np.inf), axis=1)]
    if np.abs(best).max() > 1 and (total(best) - total(none)) / some.size > PLACED:
        lag[some] = best
    return lag


def _pairs(rows: TripRows, factor: FloatArray, trips: IntArray) -> FloatArray:
    """Log likelihood of onsets of one trip beside another placed before it, (k, k, lags)."""
    onset, used = (np.full((rows.trips, rows.bins), np.nan) for _ in range(2))
    onset[rows.trip, rows.bin] = rows.log - factor[rows.trip]
    used[rows.used_trip, rows.used_bin] = rows.used_log - factor[rows.used_trip]
    variance = np.zeros((rows.trips, rows.bins))
    variance[rows.trip, rows.bin] = rows.variance
    onset, used, variance = (each[trips] for each in (onset, used, variance))
    found = np.zeros((trips.size, trips.size, LAGS.size))
    for trip in range(trips.size):
        own = np.flatnonzero(np.isfinite(onset[trip]))
        level, error = onset[trip, own], 2.0 * ERROR**2 + variance[trip, own]
        for number, step in enumerate(LAGS):
            place = own - step
            inside = (place >= 0) & (place < rows.bins)
            there = place[inside]
            std = np.sqrt(error[inside] + variance[:, there])
            away = (level[inside] - onset[:, there]) / std
            value = ASTRAY + (1.0 - OFTEN) * np.exp(-0.5 * away**2) / (np.sqrt(2.0 * np.pi) * std)
            wide = WIDE * np.sqrt(2.0 * np.pi) * std
            value += OFTEN * np.exp(-0.5 * (away / WIDE) ** 2) / wide
            borne = ndtr((level[inside] - used[:, there]) / (np.sqrt(2.0) * ERROR))
            # Onsets of two trips are met twice.
            both = 0.5 * np.nan_to_num(np.log(value))
            both += np.nan_to_num(np.log(ASTRAY + (1.0 - ASTRAY) * borne))
            found[trip, :, number] = ALIKE * both.sum(axis=1)
        found[trip, trip] = 0.0
    return found


def _placing_variance(rows: TripRows, level: FloatArray, lag: FloatArray) -> FloatArray:
    """Variance of log levels, (bins,), if any trip may be the one that is placed right."""
    if not lag.any():
        return np.zeros(rows.bins)
    used = np.full(rows.bins, -np.inf)
    np.maximum.at(used, rows.used_bin, rows.used_log)
    whole = np.where(np.isfinite(level), level, np.maximum(used, np.nanmedian(level)))
    places = np.arange(rows.bins)
    found = np.zeros(rows.bins)
    steps, count = np.unique(np.subtract.outer(lag, lag), return_counts=True)
    for step, share in zip(steps, count / count.sum(), strict=True):
        moved = np.clip(places + int(step), 0, rows.bins - 1)
        found += share * (whole[moved] - whole) ** 2
    return found


@dataclass(frozen=True, eq=False)
class Agreement:
    """How the trips of a rail condition go together.

    Attributes
    ----------
    apart : float
        Logarithm of what trips in the second direction find over those in the first; 0 where they
        agree.
    aside : (trips,) bool array
        Trips of another condition.
    factors : Factors
        Beside trips of their direction that are not set aside.
    spread : float
        Standard deviation of the logarithm of the others' factors; 0 where errors explain it.
    lag : (trips,) array
        Bins by which each is placed off the middle of the others of its direction; 0 where that
        does not show.
    placing : (2, bins) array
        Variance of the logarithm of the level of a bin by what trips of the first, and of the
        second direction are placed off one another.
    """

    apart: float
    aside: BoolArray
    factors: Factors
    spread: float
    lag: FloatArray
    placing: FloatArray


def agreement_of(rows: TripRows, second: BoolArray, order: IntArray, day: IntArray) -> Agreement:
    """How trips go together.

    Parameters
    ----------
    rows : TripRows
    second : (trips,) bool array
        Trips in the second of two directions.
    order, day : (trips,) int array
        By time, and of which day.
    """
    apart = _apart(rows, second)
    groups = [~second, second] if apart else [np.ones(rows.trips, dtype=np.bool_)]
    aside = np.zeros(rows.trips, dtype=np.bool_)
    columns, lag = np.zeros((4, rows.trips)), np.zeros(rows.trips)
    placing = np.zeros((2, rows.bins))
    time = np.argsort(order, kind="stable")
    for group in groups:
        own = rows.of(group)
        lag[group] = lags_of(own, factors_of(own)[0].log)[group]
        periods = _periods(factors_of(own.moved(-lag))[0], time[group[time]], day)
        for period in periods:
            part = np.isin(np.arange(rows.trips), period)
            several = own.of(part)
            if len(periods) > 1:
                lag[part] = lags_of(several, factors_of(several)[0].log)[part]
            several = several.moved(-lag)
            # Factors of some trips, which are of another condition, and the others' levels.
            others = np.zeros(own.trips, dtype=np.bool_)
            found, level = factors_of(several)
            for _ in range(ROUNDS):
                # Where several are of another condition, one more is no surprise.
                least = DOUBT if others.sum() < 2 else DOUBT / 2.0
                new = part & (np.abs(found.log) > LEAST) & (found.doubt > least)
                if np.array_equal(new, others) or 2 * new.sum() >= part.sum():
                    break
                others = new
                found, level = factors_of(several, ~others)
            aside |= others
            columns[:, part] = np.array(astuple(found))[:, part]
        own = own.moved(-lag)
        within = [bool((group & ~second).any()), bool((group & second).any())]
        placing[within] = _placing_variance(own, level, lag[group & ~aside])
    factors = Factors(*columns)
    spread = _spread(factors, ~aside & (factors.places > 0))
    return Agreement(apart, aside, factors, spread, lag, placing)


def _apart(rows: TripRows, second: BoolArray) -> float:
    """Logarithm of what the second direction finds over the first; 0 where they agree."""
    sides = []
    for first in (~second, second):
        found, _ = factors_of(rows, first)
        side = found.log[~first & (found.places > 0) & (found.std < 0.5 * PRIOR)]
        if side.size < 2:
            return 0.0
        middle = float(np.median(side))
        spread = max(robust_std(side - middle), ORDINARY)
        if abs(middle) < max(APART, 4.0 * spread / np.sqrt(side.size)):
            return 0.0
        sides.append(middle)
    return 0.5 * (sides[0] - sides[1]) if sides[0] * sides[1] < 0.0 else 0.0


def _periods(found: Factors, trips: IntArray, day: IntArray) -> list[IntArray]:
    """Trips in order of time, divided where all later ones meet a changed line.

    The likeliest division (Jackson et al. 2005, IEEE Signal Process. Lett. 12), each trip being of
    another condition now and then. A period between two others, and one that begins with a rise, is
    of two days or more: a single day is more likely labelled wrong.

    Parameters
    ----------
    found : Factors
    trips : (n,) int array
        In order of time.
    day : (trips,) int array
    """
    known = trips[(found.places[trips] > 0) & (found.std[trips] < 0.5 * PRIOR)]
    size = known.size
    if size < 3:
        return [trips]
    log, when = found.log[known], day[known]
    usual = max(robust_std(np.diff(log)) / np.sqrt(2.0), ORDINARY)
    std = np.hypot(found.std[known], usual)
    far = np.abs(log - np.median(log)) > max(LEAST, 3.0 * usual)
    strangers = (np.count_nonzero(np.diff(far, append=False)) / 2.0 + 1.0) / (size + STRANGERS)
    away = log[:, None] - GRID
    height = (1.0 - strangers) * np.exp(-0.5 * (away / std[:, None]) ** 2) / std[:, None]
    height += strangers * np.exp(-0.5 * (away / PRIOR) ** 2) / PRIOR
    total = np.vstack((np.zeros(GRID.size), np.cumsum(np.log(height), axis=0)))
    best, begin = np.zeros(size + 1), np.zeros(size + 1, dtype=np.int64)
    for end in range(1, size + 1):
        levels = total[end] - total[:end]
        value = best[:end] + levels.max(axis=1) - CHANGED * (np.arange(end) > 0)
        value[(when[:end] == when[end - 1]) & (np.arange(end) > 0) & (end < size)] = -np.inf
        begin[end] = int(np.argmax(value))
        best[end] = value[begin[end]]
    cuts = [size]
    while cuts[0] > 0:
        cuts.insert(0, int(begin[cuts[0]]))
    if len(cuts) > 2 and when[cuts[-2]] == when[-1]:
        before, after = (np.median(log[a:b]) for a, b in pairwise(cuts[-3:]))
        cuts = cuts[:-2] + cuts[-1:] if after > before else cuts
    # Latest trips that find less count for themselves until others contradict them.
    last = log[cuts[-2] :]
    ordinary = np.flatnonzero(last >= np.median(last) - LEAST)
    if ordinary[-1] + 1 < last.size:
        cuts.insert(-1, cuts[-2] + int(ordinary[-1]) + 1)
    return np.split(trips, np.flatnonzero(np.isin(trips, known[cuts[1:-1]])))


def _spread(found: Factors, chosen: BoolArray) -> float:
    """Standard deviation of factors beyond their errors; 0 where these explain them."""
    log, std = found.log[chosen], np.hypot(found.std[chosen], ORDINARY)
    if log.size < 3:
        return 0.0
    tried = np.append(0.0, np.exp(np.linspace(np.log(0.02), np.log(0.6), 40)))
    total = std[:, None] ** 2 + tried**2
    value = -0.5 * np.sum(np.log(total) + log[:, None] ** 2 / total, axis=0)
    best = int(np.argmax(value))
    return float(tried[best]) if value[best] - value[0] > SPREAD else 0.0

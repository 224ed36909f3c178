"""What trips showed of a line's maximum adhesion, as sums by day and bin.

Onsets of slip measure the maximum; adhesion used without slip bounds it from below. Only what is
not zero is kept. All sums are of fixed-point numbers, so that they are exact: evidence adds up in
any order and grouping to the same rows, byte for byte.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pandas import Timestamp

from trainlog.arrays import BoolArray, FloatArray, IntArray, same_values
from trainlog.errors import InputError

_KEYS = ("day", "bin")
_USED_KEYS = ("used_day", "used_bin", "used_level")
_SUMS = ("trips", "events", "weight", "weighted_log", "weighted_square", "common")


FIXED_POINT = 2.0**-20
"""Weights and weighted logarithms are whole multiples of this, so that their sums are exact."""


def fixed(values: FloatArray) -> FloatArray:
    """Values as whole multiples of `FIXED_POINT`.

    Examples
    --------
    >>> fixed(np.array([0.1])) * 2.0**20
    array([104858.])
    """
    return np.asarray(np.round(values / FIXED_POINT) * FIXED_POINT)


def day_of(time: Timestamp) -> int:
    """The day of a time, counted from 1970-01-01 in UTC; without a zone it is taken for UTC.

    Examples
    --------
    >>> day_of(Timestamp("1970-01-03T01:00+02:00"))
    1
    """
    zoned = time.tz_localize("UTC") if time.tzinfo is None else time
    return int(zoned.timestamp() // 86_400)


@dataclass(frozen=True, eq=False)
class DailyEvidence:
    """Evidence of one layer, or of one trip.

    Attributes
    ----------
    bins, levels : int
        Of the map.
    day, bin : (m,) int array
        One row a day and bin with measured onsets, in this order; days are counted from 1970-01-01
        in UTC.
    trips : (m,) array
        That measured an onset there on that day.
    events : (m,) array
        Onsets measured.
    weight, weighted_log, weighted_square : (m,) array
        Sums over the trips of the weight (inverse variance), and of weight times log adhesion and
        its square.
    common : (m,) array
        Sum over the trips of the squared weight times the variance of the error that all onsets of
        a trip share, from a load and a gain of the efforts that are not known.
    used_day, used_bin, used_level : (k,) int array
        One row a day, bin and level (its number in the map's `levels`), in this order.
    used_trips : (k,) array
        That used this level there on that day without slip: the maximum is at least this.
    """

    bins: int
    levels: int
    day: IntArray
    bin: IntArray
    trips: FloatArray
    events: FloatArray
    weight: FloatArray
    weighted_log: FloatArray
    weighted_square: FloatArray
    common: FloatArray
    used_day: IntArray
    used_bin: IntArray
    used_level: IntArray
    used_trips: FloatArray

    def __eq__(self, other: object) -> bool:
        return same_values(self, other) if isinstance(other, DailyEvidence) else NotImplemented

    __hash__ = None  # type: ignore[assignment]

    @staticmethod
    def none(bins: int, levels: int) -> DailyEvidence:
        """No evidence at all."""
        whole, real = np.zeros(0, dtype=np.int64), np.zeros(0)
        columns: dict[str, Any] = dict.fromkeys((*_KEYS, *_USED_KEYS), whole)
        columns |= dict.fromkeys((*_SUMS, "used_trips"), real)
        return DailyEvidence(bins, levels, **columns)

    @staticmethod
    def of_bins(
        day: ArrayLike,
        events: FloatArray,
        weight: FloatArray,
        weighted_log: FloatArray,
        censored: FloatArray,
        *,
        weighted_square: FloatArray | None = None,
        common: FloatArray | None = None,
    ) -> DailyEvidence:
        """Evidence of one trip from arrays over all bins of a line.

        Parameters
        ----------
        day : int or (n,) int array
            On which each bin was passed.
        events, weight, weighted_log : (n,) array
        censored : (n, k) array
            Trips by level that was used without slip.
        weighted_square : (n,) array, optional
            Default: of one trip, ``weighted_log²/weight``.
        common : (n,) array, optional

        Examples
        --------
        An onset at 0.12 in the second of three bins, 0.05 used in the last:

        >>> import numpy as np
        >>> weight = np.array([0.0, 64.0, 0.0])
        >>> used = np.zeros((3, 2))
        >>> used[2, 1] = 1.0
        >>> found = DailyEvidence.of_bins(20_000, weight > 0, weight, weight * np.log(0.12), used)
        >>> found.bin.tolist(), found.used_bin.tolist(), found.used_level.tolist()
        ([1], [2], [1])
        """
        bins = weight.size
        days = np.broadcast_to(np.asarray(day, dtype=np.int64), (bins,))
        seen = np.flatnonzero((weight > 0.0) | (np.asarray(events) > 0))
        if weighted_square is None:
            weighted_square = weighted_log**2 / np.where(weight > 0.0, weight, 1.0)
        common = np.zeros(bins) if common is None else common
        rows, level = np.nonzero(censored)
        found = DailyEvidence(
            bins,
            censored.shape[1],
            days[seen],
            seen.astype(np.int64),
            np.ones(seen.size),
            np.asarray(events, dtype=np.float64)[seen],
            weight[seen],
            weighted_log[seen],
            weighted_square[seen],
            common[seen],
            days[rows],
            rows.astype(np.int64),
            level.astype(np.int64),
            censored[rows, level],
        )
        return DailyEvidence.total([found])

    @staticmethod
    def total(pieces: Iterable[DailyEvidence]) -> DailyEvidence:
        """The sum of one or more, whose rows are in order.

        Raises
        ------
        InputError
            If there is none, or they are of different bins or levels.
        """
        given = list(pieces)
        if not given:
            raise InputError("evidence: nothing to add up", remedy="give one piece at least")
        first = given[0]
        for piece in given:
            if (piece.bins, piece.levels) != (first.bins, first.levels):
                raise InputError(
                    f"evidence of {piece.bins} bins and {piece.levels} levels cannot be added to"
                    f" evidence of {first.bins} and {first.levels}",
                    remedy="use one bin length and one set of levels",
                )
        return DailyEvidence(
            first.bins,
            first.levels,
            **_added(given, _KEYS, _SUMS, (first.bins,)),
            **_added(given, _USED_KEYS, ("used_trips",), (first.bins, first.levels)),
        )

    def between(self, first: int, last: int) -> DailyEvidence:
        """That of the days from `first` to `last`, both included."""
        own = (self.day >= first) & (self.day <= last)
        used = (self.used_day >= first) & (self.used_day <= last)
        return self if own.all() and used.all() else self.chosen(own, used)

    def chosen(self, own: BoolArray | IntArray, used: BoolArray | IntArray) -> DailyEvidence:
        """Some rows of onsets, and some of adhesion used without slip, by choice or number."""
        return replace(
            self,
            **{name: getattr(self, name)[own] for name in (*_KEYS, *_SUMS)},
            **{name: getattr(self, name)[used] for name in (*_USED_KEYS, "used_trips")},
        )

    def by_period(self, until: int, length: int) -> DailyEvidence:
        """With days in periods that end by a day as the last day of each.

        Parameters
        ----------
        until : int
            Day.
        length : int
            Of a period [days], counted from 1970-01-01.

        Examples
        --------
        >>> weight = np.ones(1)
        >>> days = [DailyEvidence.of_bins(n, weight, weight, -weight, np.zeros((1, 2)))
        ...         for n in (2, 5, 9)]
        >>> found = DailyEvidence.total(days).by_period(8, 7)
        >>> found.day.tolist(), found.events.tolist()
        ([6, 9], [2.0, 1.0])
        """

        def ends(day: IntArray) -> IntArray:
            last = day // length * length + length - 1
            return np.where(last <= until, last, day)

        own, used = ends(self.day), ends(self.used_day)
        order = np.lexsort((self.bin, own))
        by_level = np.lexsort((self.used_level, self.used_bin, used))
        moved = replace(self, day=own, used_day=used).chosen(order, by_level)
        return DailyEvidence.total([moved])

    def moved(self, step: int) -> DailyEvidence:
        """That of a trip that was placed wrong, so many bins further along the line."""
        place, used = self.bin + step, self.used_bin + step
        found = replace(self, bin=place, used_bin=used)
        return found.chosen(*((each >= 0) & (each < self.bins) for each in (place, used)))

    def scaled(
        self, log_factor: float, variance: FloatArray, log_levels: FloatArray
    ) -> DailyEvidence:
        """That of a trip with all adhesion divided by a factor.

        Parameters
        ----------
        log_factor : float
            Logarithm of the factor.
        variance : (m,) array
            Of an error that the onsets have in common, by row.
        log_levels : (k,) array
            Logarithms of the map's levels.
        """
        shift = log_factor * self.weight
        level = np.searchsorted(log_levels, log_levels[self.used_level] - log_factor, "right") - 1
        found = replace(
            self,
            weighted_log=fixed(self.weighted_log - shift),
            weighted_square=fixed(
                self.weighted_square - log_factor * (2.0 * self.weighted_log - shift)
            ),
            common=fixed(self.common + variance * self.weight**2),
            used_level=np.maximum(level, 0).astype(np.int64),
        )
        return DailyEvidence.total([found.chosen(self.weight >= 0.0, level >= 0)])

    @property
    def days(self) -> IntArray:
        """Days with evidence, increasing."""
        return np.union1d(self.day, self.used_day).astype(np.int64)

    def by_bin(self, name: str) -> FloatArray:
        """Sum of a column over all days; (bins,) array.

        Parameters
        ----------
        name : {"trips", "events", "weight", "weighted_log", "weighted_square", "common"}
        """
        return np.bincount(self.bin, getattr(self, name), minlength=self.bins).astype(np.float64)

    @cached_property
    def censored(self) -> FloatArray:
        """Trips by bin and level that was used without slip; (bins, levels) array."""
        place = self.used_bin * self.levels + self.used_level
        flat = np.bincount(place, self.used_trips, minlength=self.bins * self.levels)
        return flat.reshape(self.bins, self.levels).astype(np.float64)


def _added(
    pieces: Sequence[DailyEvidence],
    keys: tuple[str, ...],
    columns: tuple[str, ...],
    sizes: tuple[int, ...],
) -> dict[str, Any]:
    """Keys and sums of the rows of all pieces, in the keys' order; sizes are those of the last."""
    rows = {
        name: np.concatenate([getattr(piece, name) for piece in pieces])
        for name in (*keys, *columns)
    }
    place = rows[keys[0]]
    for name, size in zip(keys[1:], sizes, strict=True):
        place = place * size + rows[name]
    _, first, row = np.unique(place, return_index=True, return_inverse=True)
    found = {name: rows[name][first] for name in keys}
    return found | {
        name: np.bincount(row, rows[name], first.size).astype(np.float64) for name in columns
    }

"""Evidence by day and bin, as the estimate of the track condition takes it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trainlog.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class FieldEvidence:
    """Evidence as plain arrays.

    Attributes
    ----------
    bins : int
    bin_length : float [m]
    log_levels : (levels,) array
        Of what was used without slip.
    day, bin : (m,) int array
    trips, mean, scatter, variance : (m,) array
        Trips with onsets on a day in a bin; mean of their log adhesion, variance about it, and
        mean variance of the error of one.
    used_day, used_bin, used_level : (n,) int array
    used_trips : (n,) array
    """

    bins: int
    bin_length: float
    log_levels: FloatArray
    day: IntArray
    bin: IntArray
    trips: FloatArray
    mean: FloatArray
    scatter: FloatArray
    variance: FloatArray
    used_day: IntArray
    used_bin: IntArray
    used_level: IntArray
    used_trips: FloatArray

    def between(self, bins: IntArray, first: int, last: int) -> FieldEvidence:
        """All evidence of other bins; of these only that of the days from `first` to `last`."""
        own = ~np.isin(self.bin, bins) | ((self.day >= first) & (self.day <= last))
        used = ~np.isin(self.used_bin, bins) | ((self.used_day >= first) & (self.used_day <= last))
        onset = ("day", "bin", "trips", "mean", "scatter", "variance")
        level = ("used_day", "used_bin", "used_level", "used_trips")
        return replace(
            self,
            **{name: getattr(self, name)[own] for name in onset},
            **{name: getattr(self, name)[used] for name in level},
        )


@dataclass(frozen=True, eq=False)
class EvidenceRows:
    """Days of the bins with onsets."""

    bins: IntArray
    start: IntArray
    bin: IntArray
    day: IntArray
    onset: FloatArray
    used_start: IntArray
    used_level: IntArray
    used_trips: FloatArray
    order: IntArray

    @staticmethod
    def of(known: FieldEvidence) -> EvidenceRows:
        """Rows of the evidence, by bin and day."""
        bins = np.unique(known.bin)
        base = int(min(known.day.min(initial=2**40), known.used_day.min(initial=2**40)))
        span = int(max(known.day.max(initial=0), known.used_day.max(initial=0))) - base + 1
        kept = np.isin(known.used_bin, bins)
        used_key = known.used_bin[kept] * span + known.used_day[kept] - base
        key = known.bin * span + known.day - base
        rows = np.union1d(key, used_key)
        onset = np.zeros((rows.size, 4))
        onset[np.searchsorted(rows, key)] = np.column_stack(
            (known.trips, known.mean, known.scatter, known.variance)
        )
        by_row = np.argsort(used_key, kind="stable")
        place = np.searchsorted(rows, used_key[by_row])
        bin_, day = rows // span, rows % span + base
        return EvidenceRows(
            bins,
            np.append(np.searchsorted(bin_, bins), rows.size),
            bin_,
            day,
            onset,
            np.searchsorted(place, np.arange(rows.size + 1)),
            known.used_level[kept][by_row],
            known.used_trips[kept][by_row],
            np.lexsort((bin_, day)),
        )

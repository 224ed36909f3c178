"""What trips met in each bin, as forecasts are compared with it, and how much they asked for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.railway.evidence import DailyEvidence

NOON = pd.Timedelta(hours=12)


@dataclass(frozen=True, eq=False)
class Passages:
    """What the trips of one day, or one trip, met in one rail condition.

    Attributes
    ----------
    layer : str
        Rail condition.
    time : Timestamp
        For which a forecast is asked; UTC.
    day : int
        Counted from 1970-01-01 in UTC.
    onset_bin : (m,) int array
        One row a trip and bin in which its slip measured the maximum.
    onset_adhesion : (m,) array
    used_bin, used_level : (k,) int array
        One row a bin and level that was used without slip.
    used_trips : (k,) array
    """

    layer: str
    time: pd.Timestamp
    day: int
    onset_bin: IntArray
    onset_adhesion: FloatArray
    used_bin: IntArray
    used_level: IntArray
    used_trips: FloatArray

    def by_bin(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Bins that were passed, how many trips did, and how many of them slipped; (n,) arrays."""
        bins = np.union1d(self.onset_bin, self.used_bin).astype(np.int64)
        if bins.size == 0:
            return bins, np.zeros(0), np.zeros(0)
        place, other = np.searchsorted(bins, self.onset_bin), np.searchsorted(bins, self.used_bin)
        slipped = np.bincount(place, minlength=bins.size).astype(np.float64)
        used = np.bincount(other, self.used_trips, minlength=bins.size).astype(np.float64)
        return bins, slipped + used, slipped


def passages_of(
    layer: str, evidence: DailyEvidence, time: pd.Timestamp | None = None
) -> Iterator[Passages]:
    """What the evidence of a layer shows, a day at a time.

    Evidence holds sums over the trips of a day, from which the maxima that one or two trips
    measured in a bin follow exactly; of more trips they are taken as evenly spread as those of a
    normal distribution, with the same mean and variance.

    Parameters
    ----------
    layer : str
    evidence : DailyEvidence
    time : Timestamp, optional
        For which a forecast is asked; default: noon of each day.

    Examples
    --------
    >>> weight = np.array([0.0, 64.0])
    >>> shown = DailyEvidence.of_bins(
    ...     20_000, weight > 0, weight, weight * np.log(0.1), np.zeros((2, 3))
    ... )
    >>> (day,) = passages_of("wet", shown)
    >>> day.onset_bin.tolist(), day.onset_adhesion.round(6).tolist()
    ([1], [0.1])
    """
    for day in evidence.days.tolist():
        own, used = evidence.day == day, evidence.used_day == day
        measured = own & (evidence.weight > 0.0)
        bins, adhesion = _measured(evidence, measured)
        yield Passages(
            layer,
            time_of(day) if time is None else time,
            int(day),
            bins,
            adhesion,
            evidence.used_bin[used],
            evidence.used_level[used],
            evidence.used_trips[used],
        )


def time_of(day: int) -> pd.Timestamp:
    """Noon of a day counted from 1970-01-01 in UTC."""
    return pd.Timestamp(int(day), unit="D", tz="UTC") + NOON


def _measured(evidence: DailyEvidence, rows: BoolArray) -> tuple[IntArray, FloatArray]:
    """Bin and maximum of each trip's onsets, from the sums over trips."""
    weight = evidence.weight[rows]
    mean = evidence.weighted_log[rows] / weight
    variance = np.maximum(evidence.weighted_square[rows] / weight - mean**2, 0.0)
    trips = np.maximum(np.round(evidence.trips[rows]), 1.0).astype(np.int64)
    bins, logs = [], []
    for count in np.unique(trips).tolist():
        some = trips == count
        spread = _spread(count)
        values = mean[some, None] + np.sqrt(variance[some, None]) * spread
        bins.append(np.repeat(evidence.bin[rows][some], count))
        logs.append(values.ravel())
    if not bins:
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    return np.concatenate(bins), np.exp(np.concatenate(logs))


def _spread(count: int) -> FloatArray:
    """So many values of zero mean and unit variance, placed as those of a normal distribution."""
    from scipy.special import ndtri

    if count == 1:
        return np.zeros(1)
    values = ndtri((np.arange(count) + 0.5) / count)
    return np.asarray(values / np.sqrt(np.mean(values**2)), dtype=np.float64)


def asked_adhesion(levels: FloatArray) -> FloatArray:
    """What a trip asked for whose use fell to each level: the middle to the next; (k,) array."""
    ratio = levels[-1] / levels[-2] if levels.size > 1 else 1.0
    return np.asarray(levels * np.sqrt(np.append(levels[1:] / levels[:-1], ratio)))


class Demand:
    """The adhesion that trips ask for in each bin, from all days but the one that is scored.

    A trip that does not slip shows its demand; one that slips shows that it asked for more than the
    maximum that it met. Its part is spread over the levels above as the demand of the whole line is
    (product-limit estimate of Kaplan and Meier, 1958; redistribution to the right, Efron, 1967).
    Rail conditions are taken together, and a day's own trips never count for it, so that whether
    they slipped cannot be seen from it.

    Parameters
    ----------
    evidence : iterable of DailyEvidence
        Everything that is known, before and after: the demand is not what is forecast.
    levels : (k,) array
    """

    def __init__(self, evidence: Iterable[DailyEvidence], levels: FloatArray) -> None:
        self.levels = levels
        every = list(evidence)
        self._bins = every[0].bins if every else 0
        rows = [np.concatenate(columns) for columns in zip(*map(self._rows, every), strict=True)]
        if not rows:
            rows = [np.zeros(0)] * 5
        self._day, self._bin, self._level = (each.astype(np.int64) for each in rows[:3])
        self._used, self._slipped = (each.astype(np.float64) for each in rows[3:])

    def _rows(self, known: DailyEvidence) -> tuple[FloatArray | IntArray, ...]:
        measured = known.weight > 0.0
        bins, adhesion = _measured(known, measured)
        trips = np.maximum(np.round(known.trips[measured]), 1.0).astype(np.int64)
        # In the order of `_measured`: by number of trips.
        order = np.argsort(trips, kind="stable")
        days = np.repeat(known.day[measured][order], trips[order])
        level = np.clip(
            np.searchsorted(self.levels, adhesion, side="right") - 1, 0, self.levels.size - 1
        )
        nothing, one = np.zeros(known.used_bin.size), np.ones(bins.size)
        return (
            np.concatenate((days, known.used_day)),
            np.concatenate((bins, known.used_bin)),
            np.concatenate((level, known.used_level)),
            np.concatenate((np.zeros(bins.size), known.used_trips)),
            np.concatenate((one, nothing)),
        )

    def without(self, day: int, bins: IntArray) -> FloatArray:
        """Shares of the levels asked for in some bins on all other days; (n, k) array.

        Rows of NaN: no trip passed there on another day.

        Parameters
        ----------
        day : int
        bins : (n,) int array
        """
        other = self._day != day
        k = self.levels.size
        place = (self._bin * k + self._level)[other]
        size = self._bins * k
        used = np.bincount(place, self._used[other], minlength=size).reshape(-1, k)
        slipped = np.bincount(place, self._slipped[other], minlength=size).reshape(-1, k)
        beyond = _beyond(used.sum(axis=0), slipped.sum(axis=0))
        found = used[bins] + slipped[bins] @ beyond
        total = found.sum(axis=1, keepdims=True)
        return np.asarray(np.where(total > 0.0, found / np.where(total > 0.0, total, 1.0), np.nan))


def _beyond(used: FloatArray, slipped: FloatArray) -> FloatArray:
    """How the demand of a trip that slipped at each level spreads over the levels; (k, k)."""
    k = used.size
    exposed = np.cumsum((used + slipped)[::-1])[::-1]
    kept = 1.0 - used / np.where(exposed > 0.0, exposed, 1.0)
    share = np.cumprod(np.append(1.0, kept[:-1])) * (1.0 - kept)
    above = np.triu(np.ones((k, k)), 1) * share
    total = above.sum(axis=1, keepdims=True)
    # Above the highest level that anyone used without slip: the next one.
    highest = np.eye(k, k, 1)
    highest[-1, -1] = 1.0
    return np.where(total > 0.0, above / np.where(total > 0.0, total, 1.0), highest)

"""Changes of the lasting condition: stretches of bins that hold another level from a day on.

Where the days before and after one are likelier with two lasting levels than with one, the lasting
condition changed (generalised likelihood ratio: Basseville and Nikiforov 1993, section 2.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from estimators.condition_evidence import EvidenceRows
from trainlog.arrays import FloatArray

CHANGE_RATE = 1e-3
"""Changes of the lasting condition that are expected on a kilometre a day."""

CHANGE_ODDS = float(np.log(19.0))
"""Log odds from which a change counts: it is then as probable as a 95 % band is to hold."""

CHANGE_GAP = 0.02
"""Log odds against a change, for each bin without onsets within it."""


@dataclass(frozen=True, slots=True)
class FieldChange:
    """A change of the lasting condition of the bins from `first` to `last`, both included.

    Attributes
    ----------
    first, last : int
    day, earliest, latest : int
        First day after it with evidence, most probably and in the 95 % band.
    log_odds : float
        That there was one.
    before, before_std, after, after_std : float
        Log maximum adhesion, the mean over the bins.
    """

    first: int
    last: int
    day: int
    earliest: int
    latest: int
    log_odds: float
    before: float = np.nan
    before_std: float = np.nan
    after: float = np.nan
    after_std: float = np.nan


def changes_of(rows: EvidenceRows, cut: FloatArray, bin_length: float) -> list[FieldChange]:
    """Stretches of bins, none in two, whose lasting level is likelier to have changed on a day."""
    days = np.unique(rows.day)
    score = np.zeros((days.size, rows.bins.size))
    for number in range(rows.bins.size):
        first, last = rows.start[number], rows.start[number + 1]
        row = np.searchsorted(rows.day[first:last], days)
        inside = (row > 0) & (row < last - first)
        score[inside, number] = cut[first + row[inside]]
    price = -float(np.log(CHANGE_RATE * bin_length / 1000.0))
    gaps = CHANGE_GAP * np.diff(rows.bins, prepend=rows.bins[:1]).astype(np.float64)
    changes: list[FieldChange] = []
    while True:
        odds, day, first, last = _best_stretch(score, gaps)
        if odds <= price + CHANGE_ODDS:
            break
        profile = score[:, first : last + 1].sum(axis=1)
        share = np.cumsum(np.exp(profile - logsumexp(profile)))
        changes.append(
            FieldChange(
                int(rows.bins[first]),
                int(rows.bins[last]),
                int(days[day]),
                int(days[np.searchsorted(share, 0.025)]),
                int(days[np.clip(np.searchsorted(share, 0.975), 0, days.size - 1)]),
                odds - price,
            )
        )
        score[:, first : last + 1] = -np.inf
    return sorted(changes, key=lambda change: change.first)


def _best_stretch(score: FloatArray, gaps: FloatArray) -> tuple[float, int, int, int]:
    """Largest sum over adjoining columns of a row (Kadane); its row, first and last column."""
    total = np.full(score.shape[0], -np.inf)
    begin = np.zeros(score.shape[0], dtype=np.int64)
    best = (-np.inf, 0, 0, 0)
    for column in range(score.shape[1]):
        goes_on = total - gaps[column] > 0.0
        begin = np.where(goes_on, begin, column)
        total = np.where(goes_on, total - gaps[column], 0.0) + score[:, column]
        day = int(np.argmax(total))
        if total[day] > best[0]:
            best = (float(total[day]), day, int(begin[day]), column)
    return best

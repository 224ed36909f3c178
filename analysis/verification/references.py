"""Forecasts that anyone can make, which a forecast must beat.

Climatology, by the rail condition alone; persistence; and the place alone, whatever the weather.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from trainlog.arrays import FloatArray, IntArray
from trainlog.condition import prior_of, setting
from trainlog.railway.condition import AdhesionEstimate, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence

GRID = np.linspace(np.log(0.01), 0.0, 185)
"""Logarithms of adhesion on which a reference forecast is laid out."""

USUAL_DIFFERENCE, LEAST_DIFFERENCE = 0.17, 0.04
"""Standard deviation of the logarithm between what a bin showed last and shows next: until there
are `ENOUGH` pairs, and the least that is taken."""

ENOUGH = 10


def climatology(track: TrackConditionMap, layer: str) -> AdhesionEstimate:
    """The prior of a layer, the same in each bin: what holds of the rail condition anywhere.

    Parameters
    ----------
    track : TrackConditionMap
        Whose settings and bins are used; it may be empty.
    layer : str

    Examples
    --------
    >>> from trainlog.formats.condition import read_map
    >>> track = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> climatology(track, "wet").quantile(0.5)[:1].round(3).tolist()
    [0.147]
    """
    prior = prior_of(track, layer)
    std = np.hypot(prior.std, setting(track, "trip_std"))
    return AdhesionEstimate(
        np.full(track.bins, prior.mean), np.full(track.bins, std), np.ones(track.bins, dtype=bool)
    )


def persistence(track: TrackConditionMap, layer: str, evidence: DailyEvidence) -> AdhesionEstimate:
    """Each bin as it was last seen.

    Where slip measured the maximum last, the next is expected there, with the spread that such
    pairs of measurements of one bin show in the evidence. Where adhesion was used without slip
    last, the climatology given that the maximum was at least this, with the same spread; where
    there is no evidence, the climatology.

    Parameters
    ----------
    track : TrackConditionMap
        Whose settings, bins and levels are used.
    layer : str
    evidence : DailyEvidence
        Of all days before.
    """
    prior = climatology(track, layer)
    known = evidence.weight > 0.0
    day, place = evidence.day[known], evidence.bin[known]
    log = evidence.weighted_log[known] / evidence.weight[known]
    spread = _difference(place, log)
    slip_day, slip_log = _last(place, day, log, track.bins)
    used_day, used_level = _last(
        evidence.used_bin, evidence.used_day, evidence.used_level.astype(np.float64), track.bins
    )
    first = prior.at_bins([0])
    density = np.exp(-0.5 * ((GRID - first.log_mean) / first.log_std) ** 2)
    at_least = density * ndtr((GRID - np.log(track.levels)[:, None]) / spread)
    found = np.broadcast_to(density, (track.bins, GRID.size)).copy()
    used = (used_day >= 0) & (used_day > slip_day)
    found[used] = at_least[used_level[used].astype(np.int64)]
    slipped = (slip_day >= 0) & ~used
    found[slipped] = np.exp(-0.5 * ((GRID - slip_log[slipped, None]) / spread) ** 2) + 1e-300
    found /= found.sum(axis=1, keepdims=True)
    mean = found @ GRID
    std = np.sqrt(np.maximum(found @ GRID**2 - mean**2, 1e-12))
    return AdhesionEstimate(mean, std, np.ones(track.bins, dtype=bool), GRID, found)


def place_alone(track: TrackConditionMap, layer: str, evidence: DailyEvidence) -> AdhesionEstimate:
    """Each bin as it was on average, whatever the rail condition.

    Normal, about the mean of a bin's measurements, drawn to that of the line as far as they are few
    for their spread (shrinkage of group means: Efron and Morris 1975, JASA 70); where nothing was
    measured on the line, the climatology.

    Parameters
    ----------
    track : TrackConditionMap
        Whose settings and bins are used.
    layer : str
        Whose climatology holds where nothing was measured.
    evidence : DailyEvidence
        Of all days before, of all rail conditions together.

    Examples
    --------
    >>> from trainlog.formats.condition import read_map
    >>> track = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> both = DailyEvidence.total(each.evidence for each in track.layers.values())
    >>> found, usual = place_alone(track, "dry", both), climatology(track, "dry")
    >>> bool(found.log_std[0] > 0.0), bool(found.log_mean[0] != usual.log_mean[0])
    (True, True)
    """
    known = evidence.weight > 0.0
    trips, place = evidence.trips[known], evidence.bin[known]
    if trips.sum() < ENOUGH:
        return climatology(track, layer)
    log = evidence.weighted_log[known] / evidence.weight[known]
    count = np.bincount(place, trips, minlength=track.bins)
    mean = np.bincount(place, trips * log, minlength=track.bins) / np.maximum(count, 1.0)
    whole = float(trips @ log / trips.sum())
    within = float(trips @ (log - mean[place]) ** 2) / max(trips.sum() - (count > 0).sum(), 1.0)
    within = max(within, LEAST_DIFFERENCE**2)
    between = float(np.average((mean - whole) ** 2, weights=count))
    share = count * between / (count * between + within)
    variance = within + between * (1.0 - share)
    return AdhesionEstimate(
        whole + share * (mean - whole), np.sqrt(variance), np.ones(track.bins, dtype=bool)
    )


def _difference(place: IntArray, log: FloatArray) -> float:
    """Standard deviation between measurements of one bin that follow each other."""
    order = np.argsort(place, kind="stable")
    step = np.diff(log[order])[np.diff(place[order]) == 0]
    if step.size < ENOUGH:
        return USUAL_DIFFERENCE
    return max(float(np.sqrt(np.mean(step**2))), LEAST_DIFFERENCE)


def _last(
    place: IntArray, day: IntArray, value: FloatArray, bins: int
) -> tuple[IntArray, FloatArray]:
    """Last day by bin, -1 if none, and the largest value of that day; rows are in order of days."""
    last = np.full(bins, -1, dtype=np.int64)
    np.maximum.at(last, place, day)
    found = np.full(bins, -np.inf)
    newest = day == last[place]
    np.maximum.at(found, place[newest], value[newest])
    return last, found

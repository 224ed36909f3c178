"""Scoring rules for forecasts of adhesion, on arrays.

A trip that slips measures the maximum adhesion. One that does not shows only that the maximum is at
least what it used: an observation censored from the right. What is computed here allows for that.

Sources: T. Gneiting and A. E. Raftery, Strictly proper scoring rules, prediction, and estimation,
J. Am. Stat. Assoc. 102 (2007); D. Rindt et al., Survival regression with proper scoring rules,
AISTATS 2022 (the likelihood of censored observations is proper); G. W. Brier, Mon. Weather Rev.
78 (1950); A. H. Murphy, J. Appl. Meteorol. 12 (1973); E. L. Kaplan and P. Meier, J. Am. Stat.
Assoc. 53 (1958).

Beside them stand the forecasts that anyone can make, which a forecast must beat: climatology, by
the rail condition alone; persistence; and the place alone, whatever the weather.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from trainlog.arrays import FloatArray, IntArray
from trainlog.condition import prior_of, setting
from trainlog.errors import InputError
from trainlog.railway.condition import AdhesionEstimate, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence

CONTAMINATION = 1e-4
"""Share of a uniform distribution that is mixed into every forecast before its logarithm is taken,
so that one adhesion held for impossible does not outweigh all others."""

LEAST, MOST = 0.01, 1.0
"""Ends of that uniform distribution of the logarithm of adhesion."""

CLASSES = np.array([0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
"""Edges of the classes of forecast probability; narrow where most forecasts of a rare event are."""


def onset_score(estimate: AdhesionEstimate, adhesion: ArrayLike) -> FloatArray:
    """Logarithmic score of measured maxima: log density of the log adhesion [nat]; (n,) array.

    Parameters
    ----------
    estimate : AdhesionEstimate
        Of n passages.
    adhesion : (n,) array
        Measured at the onset of slip.

    Examples
    --------
    >>> sure = AdhesionEstimate(np.log([0.1]), np.array([0.1]), np.array([True]))
    >>> onset_score(sure, [0.1]).round(3).tolist(), onset_score(sure, [0.2]).round(1).tolist()
    ([1.384], [-10.7])
    """
    log = np.log(np.asarray(adhesion, dtype=np.float64))
    width = np.log(MOST / LEAST)
    uniform = np.where((log >= np.log(LEAST)) & (log <= np.log(MOST)), CONTAMINATION / width, 1e-12)
    density = (1.0 - CONTAMINATION) * np.exp(estimate.log_density(adhesion))
    return np.asarray(np.log(density + uniform))


def used_score(estimate: AdhesionEstimate, adhesion: ArrayLike) -> FloatArray:
    """Logarithmic score of adhesion used without slip: log P(maximum at least this); (n,) array.

    Parameters
    ----------
    estimate : AdhesionEstimate
        Of n passages.
    adhesion : (n,) array
        Used.

    Examples
    --------
    >>> sure = AdhesionEstimate(np.log([0.1]), np.array([0.1]), np.array([True]))
    >>> used_score(sure, [0.1]).round(3).tolist()
    [-0.693]
    """
    log = np.log(np.asarray(adhesion, dtype=np.float64))
    uniform = np.clip((np.log(MOST) - log) / np.log(MOST / LEAST), 1e-9, 1.0)
    survival = 1.0 - estimate.below(adhesion)
    return np.asarray(np.log((1.0 - CONTAMINATION) * survival + CONTAMINATION * uniform))


STEPS = 600
"""Of an integral over adhesion from 0.001 to 2."""


def crps(estimate: AdhesionEstimate, adhesion: ArrayLike) -> FloatArray:
    """Continuous ranked probability score of measured maxima, in log adhesion; (n,) array.

    ``integral of (F(y) - 1{y >= x})² dy``: 0 at best; of a forecast without spread the distance.

    Parameters
    ----------
    estimate : AdhesionEstimate
        Of n passages.
    adhesion : (n,) array
        Measured.

    Examples
    --------
    >>> sharp = AdhesionEstimate(np.log([0.1]), np.array([1e-6]), np.array([True]))
    >>> bool(abs(crps(sharp, [0.2])[0] - np.log(2.0)) < 0.02)
    True
    """
    value = np.log(np.asarray(adhesion, dtype=np.float64))
    edges = np.linspace(np.log(1e-3), np.log(2.0), STEPS + 1)
    step = edges[1] - edges[0]
    passed = np.clip((edges[1:] - value[:, None]) / step, 0.0, 1.0)
    below = estimate.below(np.exp(0.5 * (edges[1:] + edges[:-1]))[:, None]).T
    error = passed * (below - 1.0) ** 2 + (1.0 - passed) * below**2
    return np.asarray(step * error.sum(axis=1))


@dataclass(frozen=True, eq=False)
class BrierScore:
    """Brier score of a probability and its parts; arrays of the shape of the sums given.

    ``score = reliability - resolution + uncertainty + within``.

    Attributes
    ----------
    score : array
        Mean of (p - o)²: 0 at best.
    reliability : array
        How far the share of events in each class of forecasts is from the forecasts': 0 at best.
    resolution : array
        How far it is from the share of events over all: the more the better.
    uncertainty : array
        Score of the constant forecast of the share of events.
    within : array
        What forecasts of one class differ among each other; 0 where classes hold one value each.
    """

    score: FloatArray
    reliability: FloatArray
    resolution: FloatArray
    uncertainty: FloatArray
    within: FloatArray

    @property
    def skill(self) -> FloatArray:
        """Part of the uncertainty that the forecast removes: 1 at best, 0 for the constant one."""
        safe = np.where(self.uncertainty > 0.0, self.uncertainty, np.nan)
        return np.asarray(1.0 - self.score / safe)


def brier_sums(probability: FloatArray, trips: FloatArray, events: FloatArray) -> FloatArray:
    """What a Brier score is made of, by class; (4, classes) array that adds up over days.

    Rows: trips, events, sum of the probabilities and of their squares less twice those of events.

    Parameters
    ----------
    probability : (n,) array
    trips, events : (n,) array
        For which the probability was forecast, and of these those on which the event came.
    """
    count = CLASSES.size - 1
    place = np.clip(np.searchsorted(CLASSES, probability, side="right") - 1, 0, count - 1)
    rows = (
        trips,
        events,
        trips * probability,
        trips * probability**2 - 2.0 * events * probability,
    )
    return np.array([np.bincount(place, row, minlength=count) for row in rows], dtype=np.float64)


def brier_score(sums: FloatArray) -> BrierScore:
    """Brier score and its decomposition after Murphy (1973) from `brier_sums`.

    Parameters
    ----------
    sums : (..., 4, classes) array

    Examples
    --------
    Half of the days rain was forecast with .8, and came on four of five; else with .1, on one of
    ten:

    >>> sums = brier_sums(np.array([0.8, 0.1]), np.array([10.0, 10.0]), np.array([8.0, 1.0]))
    >>> found = brier_score(sums)
    >>> [round(float(part), 4) for part in (found.score, found.reliability, found.resolution)]
    [0.125, 0.0, 0.1225]
    """
    trips, events, forecast, square = np.moveaxis(sums, -2, 0)
    total = trips.sum(axis=-1)
    safe_total = np.where(total > 0.0, total, np.nan)
    safe = np.where(trips > 0.0, trips, 1.0)
    mean, share = forecast / safe, events / safe
    rate = events.sum(axis=-1) / safe_total
    score = (square + events).sum(axis=-1) / safe_total
    reliability = (trips * (mean - share) ** 2).sum(axis=-1) / safe_total
    resolution = (trips * (share - rate[..., None]) ** 2).sum(axis=-1) / safe_total
    uncertainty = rate * (1.0 - rate)
    within = score - reliability + resolution - uncertainty
    return BrierScore(score, reliability, resolution, uncertainty, within)


LEVELS_OF_PIT = np.linspace(0.0, 1.0, 201)
"""Edges between which values of the forecast distribution function are counted."""


def pit_sums(below: FloatArray, trips: FloatArray, measured: bool) -> FloatArray:
    """Counts of the forecast distribution's value at what was observed; (2, cells) array.

    The first row counts measured maxima, the second those known only to lie above.

    Parameters
    ----------
    below : (n,) array
        Value of the forecast's distribution function at each observation.
    trips : (n,) array
    measured : bool
        Whether the maximum was measured there, or is at least this.
    """
    cells = LEVELS_OF_PIT.size - 1
    place = np.clip(np.searchsorted(LEVELS_OF_PIT, below, side="right") - 1, 0, cells - 1)
    counts = np.bincount(place, trips, minlength=cells).astype(np.float64)
    nothing = np.zeros(cells)
    return np.array([counts, nothing] if measured else [nothing, counts])


def observed_shares(sums: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Share of maxima that lay below each quantile of their forecasts, and trips that show it.

    The product-limit estimate of Kaplan and Meier (1958) of the distribution of the probability
    integral transform, by the actuarial rule within a cell: where forecasts are reliable, the share
    equals the quantile's. It needs that the adhesion asked for does not depend on the maximum.

    Parameters
    ----------
    sums : (..., 2, cells) array
        From `pit_sums`.

    Returns
    -------
    share : (..., cells + 1) array
        By `LEVELS_OF_PIT`; NaN beyond the highest that any trip asked for.
    trips : (..., cells + 1) array
        That asked for at least as much, or slipped there.

    Examples
    --------
    Four trips slip at the quarters of their forecasts; four more asked for next to nothing:

    >>> sums = pit_sums(np.array([0.125, 0.375, 0.625, 0.875]), np.ones(4), True)
    >>> sums += pit_sums(np.zeros(4), np.ones(4), False)
    >>> observed_shares(sums)[0][[50, 100, 150, 200]].tolist()
    [0.25, 0.5, 0.75, 1.0]
    """
    slipped, censored = np.moveaxis(sums, -2, 0)
    after = np.cumsum((slipped + censored)[..., ::-1], axis=-1)[..., ::-1]
    exposed = after - 0.5 * censored
    kept = np.where(exposed > 0.0, 1.0 - slipped / np.where(exposed > 0.0, exposed, 1.0), 1.0)
    share = 1.0 - np.cumprod(np.clip(kept, 0.0, 1.0), axis=-1)
    share = np.where(after > 0.0, share, np.nan)
    # Once everyone has slipped nothing more can be said, and nothing more needs to be.
    done = np.maximum.accumulate(np.nan_to_num(share), axis=-1) >= 1.0
    share = np.where(np.isnan(share) & done, 1.0, share)
    first = np.zeros((*share.shape[:-1], 1))
    return (
        np.concatenate((first, share), axis=-1),
        np.concatenate((after, np.zeros_like(first)), axis=-1),
    )


def day_weights(days: int, draws: int) -> FloatArray:
    """How often each day is drawn in a bootstrap by day; (draws, days) array.

    What is met on one day hangs together over bins and trips, so that days are what is drawn with
    replacement (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 8.6).

    Raises
    ------
    InputError
        If there is no day.
    """
    if days < 1:
        raise InputError("there is no day to draw from", remedy="give trips of one day at least")
    drawn = np.random.default_rng(0).multinomial(days, np.full(days, 1.0 / days), size=draws)
    return np.asarray(drawn, dtype=np.float64)


# ------------------------------------------------------------------------------------- references


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
    >>> from trainlog.formats.mapfile import read_map
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
    >>> from trainlog.formats.mapfile import read_map
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

"""Lasting condition of a line, its changes and its passing spots, from evidence by day and bin.

The passes over places and days (`estimators.condition_passes`) exchange messages; the parameters
are estimated between them (`estimators.condition_parameters`). Where the lasting condition changed
(`estimators.condition_changes`) only what was seen since then counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.special import log_ndtr

from estimators.condition_changes import FieldChange, changes_of
from estimators.condition_evidence import EvidenceRows, FieldEvidence
from estimators.condition_levels import FINE, LEVELS, LevelGrid, normal_on_grid
from estimators.condition_parameters import (
    CHANGES_OF_CLASS,
    NEWTON,
    POSITION_STD,
    Expected,
    FieldParameters,
    grid_for,
    improved,
    newton_step,
    passes_along,
    places_of,
    placing_variance,
    source_of,
    switches_of,
)
from estimators.condition_passes import beside, emissions, over_days
from trainlog.arrays import FloatArray

ASTRAY = POSITION_STD * float(np.sqrt(2.0 / np.pi))
"""Share of onsets that were in a neighbour of their bin, times the length of a bin [m]."""

ROUNDS = 10
"""Of the messages between the chains of places and days, and of the parameters."""

PASSES = 3
"""Changes that a place may have had, at most."""

BEGUN = 2.0
"""Weight of the assumed mean of normal rail where the rounds begin, as so many onsets."""

DOUBT = 0.06
"""Probability that the onsets of a single day in a bin are not of what lasts, at least."""


@dataclass(frozen=True, eq=False)
class FieldPosterior:
    """What the evidence says of a line.

    Attributes
    ----------
    parameters : FieldParameters
    origin : dict
        Standard deviation of each parameter, and ``"estimated"`` or ``"assumed"``.
    probability : (n, k) array
        Of each of `LEVELS`, by bin.
    slippery : (n,) array
        Probability that the bin is in a slippery place.
    rows : EvidenceRows
    present, long : (r,) array
        Probability of a spot in each row, and of one that lasts.
    state : (m, s) array
        Of a lasting spot of each level at the last evidence of the rows' bins.
    cut : (r,) array
        Log likelihood ratio of another lasting level from the row on.
    changes : tuple of FieldChange
    """

    parameters: FieldParameters
    origin: dict[str, tuple[float, str]]
    probability: FloatArray
    slippery: FloatArray
    rows: EvidenceRows
    present: FloatArray
    long: FloatArray
    state: FloatArray
    cut: FloatArray
    changes: tuple[FieldChange, ...] = ()


def solve(known: FieldEvidence, assumed: FieldParameters) -> FieldPosterior:
    """Posterior of the lasting condition and the passing spots, and the parameters behind it.

    Parameters
    ----------
    known : FieldEvidence
    assumed : FieldParameters
        What holds until there is evidence.
    """
    found = _settled(known, assumed, ROUNDS)
    changes: list[FieldChange] = []
    for _ in range(PASSES):
        new = changes_of(found.rows, found.cut, known.bin_length)
        if not new:
            break
        kept = known
        for change in new:
            bins = np.arange(change.first, change.last + 1)
            kept = kept.between(bins, change.day, np.iinfo(np.int64).max)
        earlier = known
        for change in new:
            bins = np.arange(change.first, change.last + 1)
            earlier = earlier.between(bins, 0, change.day - 1)
        before = _settled(earlier, assumed, ROUNDS)
        known, found = kept, _settled(kept, assumed, ROUNDS)
        changes += [_described(change, before, found) for change in new]
    return replace(found, changes=tuple(changes))


def _described(change: FieldChange, before: FieldPosterior, after: FieldPosterior) -> FieldChange:
    """With the levels before and after."""
    place = slice(change.first, change.last + 1)
    moments = []
    for each in (before, after):
        probability = each.probability[place]
        mean = probability @ LEVELS
        variance = np.maximum(probability @ LEVELS**2 - mean**2, 0.0)
        moments += [float(mean.mean()), float(np.sqrt(variance.mean()))]
    return replace(
        change, before=moments[0], before_std=moments[1], after=moments[2], after_std=moments[3]
    )


def _settled(known: FieldEvidence, assumed: FieldParameters, rounds: int) -> FieldPosterior:
    """Messages and parameters after so many rounds, with one lasting level a bin."""
    rows = EvidenceRows.of(known)
    # Sparse also because the linear algebra's threads cost more than they bring here.
    used = csr_array(
        (known.used_trips, (known.used_bin, known.used_level)),
        shape=(known.bins, known.log_levels.size),
    )
    asked = known.used_bin[known.log_levels[known.used_level] > assumed.slippery_mean]
    flat = np.ones(known.bins, dtype=np.bool_)
    flat[rows.bins] = False
    flat[asked] = False
    first = np.append(0.0, np.cumsum(rows.used_trips))
    trips = rows.onset[:, 0] + np.diff(first[rows.used_start])
    level = np.where(rows.onset[:, 0] > 0, rows.onset[:, 1], np.nan)
    now, switch = _begun(assumed, rows), switches_of(known.bin_length, assumed)
    likely = switch
    message, present, long = (
        np.zeros(rows.day.size),
        np.zeros(rows.day.size),
        np.zeros(rows.day.size),
    )
    origin = dict.fromkeys(FieldParameters.__slots__, (0.0, "assumed"))
    deviations: dict[str, tuple[float, str]] = {}
    cavity: FloatArray | None = None
    before: FloatArray | None = None
    placing = np.zeros(known.bins)
    own = np.searchsorted(rows.bins, rows.bin)
    for turn in range(rounds):
        grid = FINE if turn == rounds - 1 else grid_for(now, known.bin_length)
        levels = grid.levels
        tail = log_ndtr((levels[None, :] - known.log_levels[:, None]) / now.trip_std)
        lasting = (1.0 - now.slippery_share) * normal_on_grid(now.mean, now.std, levels)
        lasting += now.slippery_share * normal_on_grid(now.slippery_mean, now.slippery_std, levels)
        if cavity is None:
            cavity = np.tile(lasting, (known.bins, 1))
        cavity = grid.of(cavity)
        near = _near(before, rows, grid, lasting)
        onset = rows.onset.copy()
        onset[:, 3] += placing[rows.bin]
        plain, short, number = emissions(
            onset, rows.used_start, rows.used_level, rows.used_trips, tail, levels,
            normal_on_grid(now.spot_mean, now.spot_std, levels), now.trip_std, now.met,
            near, own, ASTRAY / known.bin_length,
        )  # fmt: skip
        short += (_of_short(message, present, long, rows) - message)[:, None]
        log_like, present, long, state, turnover, cut = over_days(
            rows.start, rows.day.astype(np.float64), plain, short, message,
            np.ascontiguousarray(cavity[rows.bins]), levels, grid.cells,
            normal_on_grid(now.spot_mean, now.spot_std, levels[grid.cells]),
            now.occupied, now.life, lasting, turn == rounds - 1,
        )  # fmt: skip
        likelihood = used @ tail
        likelihood[rows.bins] = log_like
        likelihood = np.exp(np.maximum(likelihood - likelihood.max(axis=1, keepdims=True), -90.0))
        _, cavity, slippery, moves, held = passes_along(
            likelihood, flat, now, switch, known.bin_length, grid
        )
        posterior = cavity * likelihood
        posterior /= posterior.sum(axis=1, keepdims=True)
        before, placing = posterior, placing_variance(posterior, levels, known.bin_length)
        if turn == rounds - 1:
            posterior = _doubted(posterior, slippery, rows, used @ tail, lasting)
            break
        prior = np.clip(now.occupied + now.met * trips, 1e-6, 0.5)
        known_odds = np.clip(present, 1e-9, 1.0 - 1e-9)
        odds = np.log(known_odds / (1.0 - known_odds)) - message - np.log(prior / (1.0 - prior))
        noise = (now.trip_std**2 + rows.onset[:, 3]) / np.maximum(rows.onset[:, 0], 1.0)
        fresh = beside(
            rows.order, rows.day, rows.bin, odds, prior, level, noise,
            float(np.exp(-known.bin_length / now.spot_length)), now.spot_mean, now.spot_std,
        )  # fmt: skip
        # The mean of the rounds, since messages may go back and forth; but for the first, in which
        # no bin knows of its neighbours yet.
        message += (fresh - message) / (turn + 1.0) * min(turn, 1)
        met = (present - long) * (posterior[rows.bin] * number).sum(axis=1)
        expected = Expected(grid, posterior, present, held, turnover, met)
        switch = moves + CHANGES_OF_CLASS[:, None] * likely
        switch /= switch.sum(axis=1, keepdims=True)
        new, origin = improved(now, assumed, known, rows, used, expected)
        trial = now
        for name in NEWTON[turn % len(NEWTON)]:
            new[name], deviations[name] = newton_step(
                name, likelihood, flat, trial, assumed, switch, known.bin_length, grid
            )
            trial = replace(trial, **{name: new[name]})
        origin |= deviations
        for name, value, count, weight in places_of(switch, moves, known.bin_length):
            new[name] = value
            origin[name] = (value / np.sqrt(count + weight), source_of(count, weight))
        if turn < rounds - 2:
            # Expectation and maximisation go a small part of the way where much is not seen.
            new["met"] *= min(max(new["met"] / now.met, 0.3), 3.0)
        now = replace(now, **new)
    return FieldPosterior(now, origin, posterior, slippery, rows, present, long, state, cut)


def _near(
    posterior: FloatArray | None, rows: EvidenceRows, grid: LevelGrid, lasting: FloatArray
) -> FloatArray:
    """Distribution of the level in the neighbours of bins with onsets.

    What the onsets of one trip show there may be the very slip that is looked at.
    """
    if posterior is None:
        return np.tile(lasting, (rows.bins.size, 1))
    trips = np.bincount(rows.bin, rows.onset[:, 0], minlength=posterior.shape[0])
    known = np.where(trips[:, None] > 1.0, grid.of(posterior), lasting)
    last = trips.size - 1
    before = np.clip(np.abs(rows.bins - 1), 0, last)
    after = np.clip(last - np.abs(last - rows.bins - 1), 0, last)
    return np.ascontiguousarray(0.5 * (known[before] + known[after]))


def _of_short(
    message: FloatArray, present: FloatArray, long: FloatArray, rows: EvidenceRows
) -> FloatArray:
    """Log odds that a row's neighbours on its day give a short spot: as far as theirs is short."""
    order = rows.order
    total, brief = np.full(message.size, 1e-9), np.full(message.size, 1e-9)
    same = rows.day[order[1:]] == rows.day[order[:-1]]
    for own, other in ((order[1:][same], order[:-1][same]), (order[:-1][same], order[1:][same])):
        total[own] += present[other]
        brief[own] += present[other] - long[other]
    share = np.clip(brief / total, 1e-9, 1.0)
    return np.asarray(np.logaddexp(np.log1p(1e-12 - share), np.log(share) + message))


def _doubted(
    posterior: FloatArray,
    slippery: FloatArray,
    rows: EvidenceRows,
    bearing: FloatArray,
    lasting: FloatArray,
) -> FloatArray:
    """With some probability that the onsets of a single day say nothing of what lasts.

    However many trips measured a low adhesion, what was met on one day alone may be gone the next:
    only the assumed rates of spots and slippery places separate them. Messages between neighbouring
    bins that one trip alone has met go round in circles, too, and are too sure of themselves. A
    share of what holds without them bounds that (contaminated priors: Berger 1985, Statistical
    Decision Theory and Bayesian Analysis, section 4.7); of several trips that is done as far as the
    bin is held for slippery, since spots only lower what the rail bears.
    """
    seen = rows.onset[:, 0] > 0.0
    days = np.bincount(rows.bin[seen], minlength=posterior.shape[0])
    trips = np.bincount(rows.bin, rows.onset[:, 0], minlength=posterior.shape[0])
    single = np.flatnonzero(days == 1)
    share = DOUBT * np.where(trips[single] == 1.0, 1.0, slippery[single])[:, None]
    without = lasting * np.exp(bearing[single] - bearing[single].max(axis=1, keepdims=True))
    without /= without.sum(axis=1, keepdims=True)
    posterior[single] = (1.0 - share) * posterior[single] + share * without
    return posterior


def _begun(assumed: FieldParameters, rows: EvidenceRows) -> FieldParameters:
    """Where the rounds begin: normal rail is where the higher ones of all onsets are."""
    levels = rows.onset[rows.onset[:, 0] > 0, 1]
    if levels.size == 0:
        return assumed
    weight = BEGUN
    high = float(np.quantile(levels, 0.9))
    mean = (levels.size * max(high, assumed.mean) + weight * assumed.mean) / (levels.size + weight)
    return replace(assumed, mean=mean)

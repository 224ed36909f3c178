"""Lasting condition of a line, its changes and its passing spots, from evidence by day and bin.

The passes over places and days (`estimators.condition_passes`) exchange messages; the parameters
are estimated between them, by expectation and maximisation (Dempster, Laird and Rubin 1977), and by
Newton's method where that would take many rounds, with the assumed ones as weak prior.

Where the days before and after one are likelier with two lasting levels than with one, the lasting
condition changed (generalised likelihood ratio: Basseville and Nikiforov 1993, section 2.4): only
what was seen since then counts.

Beside it stands what the onsets of slip of a line determine, were the field Gaussian. With the
exponential covariance of the Ornstein-Uhlenbeck process it is Markov, so that on equal bins the
precision matrix is tridiagonal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg.lapack import dptsv, dpttrf
from scipy.sparse import csr_array
from scipy.special import log_ndtr, logsumexp

from estimators.condition_passes import (
    OFTEN,
    WIDE,
    along_line,
    beside,
    diagonals_of,
    emissions,
    over_days,
)
from trainlog.arrays import BoolArray, FloatArray, IntArray

# ----------------------------------------------------------------------------------------- levels


STEP = 0.025
"""Of the grid of log adhesion."""

LEVELS = np.arange(np.log(0.015), np.log(0.75), STEP)
"""Grid of log adhesion."""

SPOT_CELLS = np.arange(4, LEVELS.size, 6)
"""Cells of the grid that are levels of lasting spots."""


@dataclass(frozen=True, eq=False)
class LevelGrid:
    """Levels of log adhesion, and which of them are levels of lasting spots."""

    levels: FloatArray
    cells: IntArray

    def of(self, probability: FloatArray) -> FloatArray:
        """Rows of probabilities on the other grid, on this one."""
        if probability.shape[1] == self.levels.size:
            return probability
        found = np.empty((probability.shape[0], self.levels.size))
        if self.levels.size < probability.shape[1]:
            found[:] = probability[:, ::2]
        else:
            found[:, ::2] = probability
            found[:, 1::2] = np.sqrt(probability[:, :-1] * probability[:, 1:])
        return np.asarray(found / found.sum(axis=1, keepdims=True))


FINE = LevelGrid(LEVELS, SPOT_CELLS)

COARSE = LevelGrid(np.ascontiguousarray(LEVELS[::2]), SPOT_CELLS // 2)
"""On which messages and parameters are found: sums over either grid agree where what is added up is
smooth over a step."""


def normal_on_grid(mean: float, std: float, levels: FloatArray) -> FloatArray:
    """A normal distribution on the grid."""
    density = np.exp(-0.5 * ((levels - mean) / std) ** 2) + 1e-12
    return np.asarray(density / density.sum())


@lru_cache(maxsize=4)
def level_kernel(mean: float, std: float, rho: float, grid: LevelGrid) -> FloatArray:
    """Transition of an Ornstein-Uhlenbeck process from bin to bin; not to be changed."""
    levels = grid.levels
    spread = std * np.sqrt(1.0 - rho**2)
    target = mean + rho * (levels[:, None] - mean)
    away = (levels[None, :] - target) / spread
    inside, matrix = np.abs(away) < 3.7, np.zeros(away.shape)
    matrix[inside] = np.exp(-0.5 * away[inside] ** 2)
    matrix[np.arange(levels.size), np.argmin(np.abs(away), axis=1)] += 1e-300
    return np.asarray(matrix / matrix.sum(axis=1, keepdims=True))


# --------------------------------------------------------------------------------------- evidence


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


# --------------------------------------------------------------------------------- Gaussian field


@dataclass(frozen=True, slots=True)
class Prior:
    """What is assumed of the log maximum adhesion before any evidence.

    Attributes
    ----------
    mean, std : float
        Of the log maximum adhesion of a bin.
    correlation_length : float [m]
        Distance over which the correlation falls to 1/e.
    """

    mean: float
    std: float
    correlation_length: float

    def precision(self, bins: int, bin_length: float) -> tuple[FloatArray, float]:
        """Diagonal and (constant) off-diagonal of the precision matrix over `bins` bins."""
        rho = np.exp(-bin_length / self.correlation_length)
        innovation = self.std**2 * (1.0 - rho**2)
        diagonal = np.full(bins, (1.0 + rho**2) / innovation)
        diagonal[[0, -1]] = 1.0 / innovation
        if bins == 1:
            diagonal[0] = 1.0 / self.std**2
        return diagonal, float(-rho / innovation)


def onset_std(prior: Prior, bin_length: float, weight: FloatArray) -> FloatArray:
    """Standard deviation that the onsets of slip alone leave, by bin; (n,) array.

    Parameters
    ----------
    prior : Prior
    bin_length : float [m]
    weight : (n,) array
        Sum of the weights (inverse variances) of the onsets in each bin.
    """
    diagonal, off = prior.precision(weight.size, bin_length)
    # Diagonal of the inverse of a symmetric tridiagonal matrix, from the pivots of both ends.
    pivots, beside = diagonal + weight, np.full(max(weight.size - 1, 1), off)
    forward, backward = dpttrf(pivots, beside)[0], dpttrf(pivots[::-1], beside)[0][::-1]
    return np.asarray(np.sqrt(1.0 / (forward + backward - pivots)))


def common_std(
    prior: Prior, bin_length: float, weight: FloatArray, common: FloatArray
) -> FloatArray:
    """Standard deviation from what all onsets of a trip err by alike, by bin; (n,) array.

    Parameters
    ----------
    prior : Prior
    bin_length : float [m]
    weight : (n,) array
    common : (n,) array
        Sum over the trips of the squared weights times the variances of that error.

    Notes
    -----
    With the posterior covariance ``K`` of independent errors, an error of variance ``s_i²`` that
    trip i makes everywhere alike adds ``sum_i s_i² (K w_i)²`` to the variance, ``w_i`` being its
    weights by bin. ``K`` has no negative element, so that by Minkowski's inequality this is at most
    ``(K sqrt(sum_i s_i² w_i²))²``, which sums over trips give.
    """
    diagonal, off = prior.precision(weight.size, bin_length)
    beside = np.full(max(weight.size - 1, 1), off)
    return np.asarray(dptsv(diagonal + weight, beside, np.sqrt(common))[2])


# ---------------------------------------------------------------------------------------- changes


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
        place = int(rows.bins[first]), int(rows.bins[last])
        dated = _days_of(score[:, first : last + 1].sum(axis=1), days) | {"day": int(days[day])}
        changes.append(FieldChange(*place, **dated, log_odds=odds - price))
        score[:, first : last + 1] = -np.inf
    return sorted(changes, key=lambda change: change.first)


def _days_of(profile: FloatArray, days: IntArray) -> dict[str, int]:
    """The likeliest day of a change, and the first and last of its 95 % band."""
    share = np.cumsum(np.exp(profile - logsumexp(profile)))
    first, last = np.minimum(np.searchsorted(share, (0.025, 0.975)), days.size - 1)
    likely = int(np.argmax(profile))
    return {"day": int(days[likely]), "earliest": int(days[first]), "latest": int(days[last])}


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


# ------------------------------------------------------------------------------------- parameters


SMOOTH = 0.9
"""Steps of the coarse grid by which the level scatters from bin to bin, for it to be used."""

POSITION_STD = 10.0
"""Error of the place of an onset [m]: position of the train, and of the axle in it."""

PLACES = {"slippery_mean": 4.0, "slippery_std": 4.0}
"""Weight of the assumed parameters, as so many independent places."""

WITNESSED = {"trip_std": 8.0, "spot_mean": 8.0, "spot_std": 8.0, "life": 6.0, "occupied": 2.0}
"""Weight of the assumed parameters, as so many measurements, spots, deaths and births."""

TRIPS_BY_BIN = 200.0
"""Weight of the assumed rate of short spots, as so many trips through a bin."""

STEPS = {
    "mean": ("plain", 0.05, 0.2),
    "std": ("log", 0.3, 0.5),
    "length": ("log", 0.4, 0.5),
}
"""Of Newton's method: scale, step, and deviation of what is assumed."""

NEWTON = (("mean", "std"), ("mean", "std"), ("length",))
"""Parameters that a step is taken for, round by round."""

CHANGES_OF_CLASS = np.array([200.0, 60.0, 30.0])
"""Weight of the assumed transitions along the line, as so many bins of each class."""

FRESH = np.array([[False, False, True], [False, False, True], [True, True, False]])
"""Between which classes the level is drawn anew."""

REGION = 3000.0
"""Length of stretches with and without slippery places [m], to begin with."""


@dataclass(frozen=True, slots=True)
class FieldParameters:
    """Parameters of the lasting condition and of what passes.

    Attributes
    ----------
    mean, std : float
        Of log maximum adhesion of normal rail.
    length : float [m]
        Over which its correlation falls to 1/e.
    slippery_share, slippery_mean, slippery_std, slippery_length : float
        Of the line, slippery places: their share, log maximum adhesion, and expected length [m].
    trip_std : float
        Of the logarithm from trip to trip at one place.
    met : float
        Short spots that a trip meets in a bin.
    occupied : float
        Share of the time in which a spot that lasts lies in a bin.
    life : float [days]
        Of such a spot.
    spot_mean, spot_std : float
        Of the log maximum adhesion in spots.
    spot_length : float [m]
    """

    mean: float
    std: float
    length: float
    slippery_share: float
    slippery_mean: float
    slippery_std: float
    slippery_length: float
    trip_std: float
    met: float
    occupied: float
    life: float
    spot_mean: float
    spot_std: float
    spot_length: float


def grid_for(now: FieldParameters, bin_length: float) -> LevelGrid:
    """The coarse grid where it holds the transitions along the line."""
    rho = float(np.exp(-bin_length / now.length))
    smooth = now.std * np.sqrt(1.0 - rho**2) > SMOOTH * 2.0 * STEP
    return COARSE if smooth else FINE


def switches_of(bin_length: float, assumed: FieldParameters) -> FloatArray:
    """Transitions from bin to bin between rail without and with slippery places near, and these.

    Bins longer than a slippery place, or half a stretch, do not know of the bin before.
    """
    leave = min(bin_length / assumed.slippery_length, 1.0)
    enter = assumed.slippery_share / (1.0 - assumed.slippery_share) * leave
    turn = min(bin_length / REGION, 0.5)
    return np.array(
        [
            [1.0 - turn - 0.2 * enter, turn, 0.2 * enter],
            [turn, 1.0 - turn - 2.0 * enter, 2.0 * enter],
            [0.1 * leave, 0.9 * leave, 1.0 - leave],
        ]
    )


@dataclass(frozen=True, eq=False)
class Expected:
    """Sufficient statistics of one round."""

    grid: LevelGrid
    posterior: FloatArray
    present: FloatArray
    held: FloatArray
    turnover: FloatArray
    met: FloatArray


def placing_variance(posterior: FloatArray, levels: FloatArray, bin_length: float) -> FloatArray:
    """Variance of an onset's log adhesion from the error of its place, by bin."""
    slope = np.gradient(posterior @ levels) if posterior.shape[0] > 1 else np.zeros(1)
    return np.asarray((POSITION_STD / bin_length * slope) ** 2)


def passes_along(
    likelihood: FloatArray,
    flat: BoolArray,
    now: FieldParameters,
    switch: FloatArray,
    bin_length: float,
    grid: LevelGrid,
    *,
    likelihood_only: bool = False,
) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
    """`estimators.condition_passes.along_line` with these parameters."""
    rho = float(np.exp(-bin_length / now.length))
    normal = level_kernel(now.mean, now.std, rho, grid)
    # In a slippery place the level changes as slowly as the place is long.
    rho_low = float(np.exp(-bin_length / now.slippery_length))
    low = level_kernel(now.slippery_mean, now.slippery_std, rho_low, grid)
    start = [normal_on_grid(now.mean, now.std, grid.levels)] * 2
    start += [normal_on_grid(now.slippery_mean, now.slippery_std, grid.levels)]
    half, diagonals = diagonals_of(np.array([normal, normal, low]))
    return along_line(  # type: ignore[no-any-return]
        likelihood, flat, stationary_share(switch), np.array(start), half, diagonals, switch, FRESH,
        likelihood_only,
    )  # fmt: skip


def stationary_share(switch: FloatArray) -> FloatArray:
    """Stationary probability of each class."""
    system = np.vstack((switch.T - np.eye(3), np.ones(3)))
    share = np.clip(np.linalg.lstsq(system, np.array([0.0, 0.0, 0.0, 1.0]))[0], 1e-9, 1.0)
    return np.asarray(share / share.sum())


def source_of(count: float, weight: float) -> str:
    """Whether a parameter rests more on what was seen than on what is assumed."""
    return "estimated" if count > weight else "assumed"


def places_of(
    switch: FloatArray, moves: FloatArray, bin_length: float
) -> list[tuple[str, float, float, float]]:
    """Share and length of slippery places, the transitions they are from, and those assumed."""
    left = float(moves[2, :2].sum())
    weight = float(CHANGES_OF_CLASS[2] * bin_length / 200.0)
    return [
        ("slippery_share", float(stationary_share(switch)[2]), left, weight),
        ("slippery_length", float(bin_length / switch[2, :2].sum()), left, weight),
    ]


def newton_step(
    name: str,
    likelihood: FloatArray,
    flat: BoolArray,
    now: FieldParameters,
    assumed: FieldParameters,
    switch: FloatArray,
    bin_length: float,
    grid: LevelGrid,
) -> tuple[float, tuple[float, str]]:
    """A parameter by a step of Newton's method on the log likelihood, and its deviation.

    Where most bins only bound the level, expectation and maximisation would take many rounds.
    """
    scale, width, weak = STEPS[name]
    forward = np.log if scale == "log" else float
    back = np.exp if scale == "log" else float
    place = float(forward(getattr(now, name))) + width * np.array([-1.0, 0.0, 1.0])
    value = np.array(
        [
            passes_along(
                likelihood,
                flat,
                replace(now, **{name: float(back(each))}),
                switch,
                bin_length,
                grid,
                likelihood_only=True,
            )[0]
            for each in place
        ]
    )
    value -= 0.5 * ((place - float(forward(getattr(assumed, name)))) / weak) ** 2
    slope = (value[2] - value[0]) / (2.0 * width)
    bend = max(-(value[2] - 2.0 * value[1] + value[0]) / width**2, 0.5 / weak**2)
    found = float(back(place[1] + float(np.clip(slope / bend, -width, width))))
    std = (found if scale == "log" else 1.0) / float(np.sqrt(bend))
    return found, (std, source_of(float(bend), 2.0 / weak**2))


def improved(
    now: FieldParameters,
    assumed: FieldParameters,
    known: FieldEvidence,
    rows: EvidenceRows,
    used: csr_array,
    expected: Expected,
) -> tuple[dict[str, float], dict[str, tuple[float, str]]]:
    """Parameters that make what is expected likeliest; each with its deviation and source."""
    new: dict[str, float] = {}
    origin: dict[str, tuple[float, str]] = dict.fromkeys(
        FieldParameters.__slots__, (0.0, "assumed")
    )

    def normal(mean: str, std: str, count: float, values: FloatArray, weights: FloatArray) -> None:
        """Mean and deviation of values, `count` of them independent."""
        total = max(float(weights.sum()), 1e-12)
        weight = PLACES.get(mean, WITNESSED.get(mean, 1.0))
        centre = (count * float(weights @ values) / total + weight * getattr(assumed, mean)) / (
            count + weight
        )
        square = float(weights @ (values - centre) ** 2) / total
        narrow = PLACES.get(std, WITNESSED.get(std, 1.0))
        spread = np.sqrt((count * square + narrow * getattr(assumed, std) ** 2) / (count + narrow))
        new[mean], new[std] = float(centre), float(spread)
        origin[mean] = (float(spread / np.sqrt(count + weight)), source_of(count, weight))
        origin[std] = (float(spread / np.sqrt(2 * (count + narrow))), source_of(count, narrow))

    levels = expected.grid.levels
    independent = known.bin_length / (2.0 * now.length)
    low = expected.held[2]
    normal("slippery_mean", "slippery_std", float(low.sum()) * independent, levels, low)
    seen = rows.onset[:, 0] > 0
    present, onset = expected.present[seen], rows.onset[seen]
    alike = known.bin_length / now.spot_length
    normal("spot_mean", "spot_std", float(present.sum()) * alike, onset[:, 1], present)
    new["trip_std"], origin["trip_std"] = _trip_std(assumed, expected, rows, known, used)
    share = normal_on_grid(new["spot_mean"], new["spot_std"], levels)
    share = np.cumsum(share) - 0.5 * share
    # Trips that would have met a spot, had there been one.
    # One trip alone cannot show what passes.
    trips = used.sum(axis=1) + np.bincount(rows.bin, rows.onset[:, 0], minlength=known.bins)
    known_twice = trips > 1.0
    shown = known_twice[rows.bin[seen]]
    exposed = float((used @ np.interp(known.log_levels, levels, share))[known_twice].sum())
    exposed += float(onset[shown, 0].sum())
    short = float(expected.met[seen][shown].sum())
    new["met"] = (short + TRIPS_BY_BIN * assumed.met) / (exposed + TRIPS_BY_BIN)
    found = short * alike + TRIPS_BY_BIN * assumed.met
    origin["met"] = (
        float(new["met"] / np.sqrt(found)),
        source_of(short * alike, TRIPS_BY_BIN * assumed.met),
    )
    births, calm, deaths, alive = (float(each) for each in expected.turnover * alike)
    born, died = WITNESSED["occupied"], WITNESSED["life"]
    rate = (births + born) / (calm + born * assumed.life / assumed.occupied)
    new["life"] = (alive + died * assumed.life) / (deaths + died)
    new["occupied"] = min(rate * new["life"], 0.3)
    origin["life"] = (new["life"] / np.sqrt(deaths + died), source_of(deaths, died))
    origin["occupied"] = (new["occupied"] / np.sqrt(births + born), source_of(births, born))
    return new, origin


def _trip_std(
    assumed: FieldParameters,
    expected: Expected,
    rows: EvidenceRows,
    known: FieldEvidence,
    used: csr_array,
) -> tuple[float, tuple[float, str]]:
    """Spread from trip to trip, where the place is known well and no spot was met.

    What trips used without slip counts, too: without it the levels, which it raises the more the
    wider the spread is, lie above the onsets, which widens the spread further.
    """
    seen = rows.onset[:, 0] > 0
    count, mean, scatter, variance = rows.onset[seen].T
    place, levels = rows.bin[seen], expected.grid.levels
    variance = variance + placing_variance(expected.posterior, levels, known.bin_length)[place]
    posterior = expected.posterior[place]
    first = posterior @ levels
    second = posterior @ levels**2 - first**2
    weight = (1.0 - expected.present[seen]) * count * (second < 0.15**2)
    square = (mean - first) ** 2 + scatter
    tried = np.exp(np.linspace(np.log(0.02), np.log(0.3), 60))
    narrow = tried[:, None] ** 2 + variance
    wide = (WIDE * tried[:, None]) ** 2 + variance
    value = (
        np.logaddexp(
            np.log(1.0 - OFTEN) - 0.5 * (np.log(narrow) + square / narrow),
            np.log(OFTEN) - 0.5 * (np.log(wide) + square / wide),
        )
        @ weight
    )
    # How far levels lie above what was used without slip, and for how many expected trips.
    cell = np.rint((levels - known.log_levels[:, None]) / (0.5 * STEP)).astype(np.int64)
    lowest = int(cell.min())
    trips = np.bincount((cell - lowest).ravel(), np.asarray(used.T @ expected.posterior).ravel())
    held = np.flatnonzero(trips)
    value += log_ndtr(0.5 * STEP * (held + lowest) / tried[:, None]) @ trips[held]
    few = WITNESSED["trip_std"]
    value -= 0.5 * few * (2.0 * np.log(tried) + assumed.trip_std**2 / tried**2)
    best = float(tried[np.argmax(value)])
    total = float(weight.sum())
    return best, (best / float(np.sqrt(2.0 * (total + few))), source_of(total, few))


# --------------------------------------------------------------------------------------- solution


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
    found = _settled(known, assumed)
    changes: list[FieldChange] = []
    for _ in range(PASSES):
        new = changes_of(found.rows, found.cut, known.bin_length)
        if not new:
            break
        earlier, later = _divided(known, new)
        before, found = _settled(earlier, assumed), _settled(later, assumed)
        dated = [_dated(change, known, before, found) for change in new]
        if any(one.day != other.day for one, other in zip(new, dated, strict=True)):
            earlier, later = _divided(known, dated)
            before, found = _settled(earlier, assumed), _settled(later, assumed)
        known = later
        changes += [_described(change, before, found) for change in dated]
    return replace(found, changes=tuple(changes))


def _divided(
    known: FieldEvidence, changes: list[FieldChange]
) -> tuple[FieldEvidence, FieldEvidence]:
    """Evidence of before, and of since the changes of their bins; that of other bins is in both."""
    earlier = known
    for change in changes:
        bins = np.arange(change.first, change.last + 1)
        known = known.between(bins, change.day, np.iinfo(np.int64).max)
        earlier = earlier.between(bins, 0, change.day - 1)
    return earlier, known


def _dated(
    change: FieldChange, known: FieldEvidence, before: FieldPosterior, after: FieldPosterior
) -> FieldChange:
    """With the day that parts the two levels best, where that is clearly another.

    While one level was assumed a lower one of before was held for spots, which part as well on any
    of their days.
    """
    own = (known.bin >= change.first) & (known.bin <= change.last)
    used = (known.used_bin >= change.first) & (known.used_bin <= change.last)
    days = np.unique(np.concatenate((known.day[own], known.used_day[used])))
    value = np.zeros(days.size)
    for sign, each in ((1.0, after), (-1.0, before)):
        mean = each.probability @ LEVELS
        spread = each.probability @ LEVELS**2 - mean**2 + each.parameters.trip_std**2
        place, borne = known.bin[own], known.used_bin[used]
        std = np.sqrt(spread[place] + known.variance[own])
        away = ((known.mean[own] - mean[place]) / std) ** 2
        onset = np.logaddexp(
            np.log(1.0 - OFTEN) - 0.5 * away - np.log(std),
            np.log(OFTEN / WIDE) - 0.5 * away / WIDE**2 - np.log(std),
        )
        held = log_ndtr(
            (mean[borne] - known.log_levels[known.used_level[used]]) / np.sqrt(spread[borne])
        )
        for day, gain in ((known.day[own], onset), (known.used_day[used], np.maximum(held, -4.0))):
            value += sign * np.bincount(np.searchsorted(days, day), gain, minlength=days.size)
    since = np.cumsum(value[::-1])[::-1][1:]
    now = max(int(np.searchsorted(days, change.day)) - 1, 0)
    if days.size < 3 or since.max() - since[now] <= CHANGE_ODDS:
        return change
    return replace(change, **_days_of(since, days[1:]))


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


def _settled(known: FieldEvidence, assumed: FieldParameters) -> FieldPosterior:
    """Messages and parameters after all rounds, with one lasting level a bin."""
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
    message, present, long = np.zeros((3, rows.day.size))
    origin = dict.fromkeys(FieldParameters.__slots__, (0.0, "assumed"))
    deviations: dict[str, tuple[float, str]] = {}
    cavity: FloatArray | None = None
    before: FloatArray | None = None
    placing = np.zeros(known.bins)
    own = np.searchsorted(rows.bins, rows.bin)
    for turn in range(ROUNDS):
        grid = FINE if turn == ROUNDS - 1 else grid_for(now, known.bin_length)
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
            now.occupied, now.life, lasting, turn == ROUNDS - 1,
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
        if turn == ROUNDS - 1:
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
        if turn < ROUNDS - 2:
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

"""Parameters of the lasting condition and of what passes, and how they are estimated.

By expectation and maximisation (Dempster, Laird and Rubin 1977), and by Newton's method where that
would take many rounds, with the assumed ones as weak prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.special import log_ndtr

from estimators.condition_evidence import EvidenceRows, FieldEvidence
from estimators.condition_levels import COARSE, FINE, STEP, LevelGrid, level_kernel, normal_on_grid
from estimators.condition_passes import OFTEN, WIDE, along_line, diagonals_of
from trainlog.arrays import BoolArray, FloatArray

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
    """Transitions from bin to bin between rail without and with slippery places near, and these."""
    leave = bin_length / assumed.slippery_length
    enter = assumed.slippery_share / (1.0 - assumed.slippery_share) * leave
    turn = bin_length / REGION
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
    normal = level_kernel(now.mean, now.std, rho, grid.levels)
    # In a slippery place the level changes as slowly as the place is long.
    rho_low = float(np.exp(-bin_length / now.slippery_length))
    low = level_kernel(now.slippery_mean, now.slippery_std, rho_low, grid.levels)
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
    new["trip_std"], origin["trip_std"] = _trip_std(
        assumed, onset, present, expected, rows, seen, known, used
    )
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
    onset: FloatArray,
    present: FloatArray,
    expected: Expected,
    rows: EvidenceRows,
    seen: BoolArray,
    known: FieldEvidence,
    used: csr_array,
) -> tuple[float, tuple[float, str]]:
    """Spread from trip to trip, where the place is known well and no spot was met.

    What trips used without slip counts, too: without it the levels, which it raises the more the
    wider the spread is, lie above the onsets, which widens the spread further.
    """
    count, mean, scatter, variance = onset.T
    place, levels = rows.bin[seen], expected.grid.levels
    variance = variance + placing_variance(expected.posterior, levels, known.bin_length)[place]
    posterior = expected.posterior[place]
    first = posterior @ levels
    second = posterior @ levels**2 - first**2
    weight = (1.0 - present) * count * (second < 0.15**2)
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
    above, trips = _above_used(used, known.log_levels, expected.posterior, levels)
    value += log_ndtr(above / tried[:, None]) @ trips
    few = WITNESSED["trip_std"]
    value -= 0.5 * few * (2.0 * np.log(tried) + assumed.trip_std**2 / tried**2)
    best = float(tried[np.argmax(value)])
    total = float(weight.sum())
    return best, (best / float(np.sqrt(2.0 * (total + few))), source_of(total, few))


def _above_used(
    used: csr_array, log_levels: FloatArray, posterior: FloatArray, levels: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How far levels lie above what was used without slip, and for how many expected trips."""
    trips = np.asarray(used.T @ posterior)
    cell = np.rint((levels - log_levels[:, None]) / (0.5 * STEP)).astype(np.int64)
    lowest = int(cell.min())
    count = np.bincount((cell - lowest).ravel(), trips.ravel()).astype(np.float64)
    held = np.flatnonzero(count)
    return np.asarray(0.5 * STEP * (held + lowest), dtype=np.float64), count[held]

"""Where a train coasted, found from its motion and the line's gradient alone.

Over two neighbouring blocks of a few seconds each the equation of motion per unit of inertia reads

    (V2 - V1) / T = f - k a_track - c0 - c1 v - c2 v²,        k = m / (m + rotating mass),

all of it averaged alike. While the train coasts f is nought and the speed obeys one curve c(v)
whatever the gradient does: a driver who holds his speed moves his lever at each change of gradient,
a train that coasts changes its acceleration. `hidden_effort` holds f as hidden; the curve is found
along with it by expectation maximisation (Baum and Welch) from several beginnings, the likeliest of
which is taken. A trip that is explained as well without any coasting has none.

References
----------
Rabiner (1989), see `hidden_effort`; Dempster, Laird, Rubin (1977), J. R. Statist. Soc. B 39(1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.resistance.coast_down.hidden_effort import Levels, posterior, rates
from analysis.resistance.coast_down.motion import Motion
from trainlog.errors import NotIdentifiableError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

RESOLUTION = 0.012
"""Noise of the acceleration over two blocks [m/s²] that their length aims at."""

SHORTEST_BLOCK, LONGEST_BLOCK = 1.0, 5.0
"""Length of a block [s]."""

TYPICAL = (0.014, 5e-4, 5e-5)
"""c0 [m/s²], c1 [1/s], c2 [1/m] of a train that might be any train; beginnings are multiples."""

TYPICAL_STD = (0.007, 7e-4, 4e-5)
"""How far trains are from it: weak, only to keep the curve from what no train has."""

BEGINNINGS = (0.4, 0.6, 0.8, 1.0, 1.3, 1.7, 2.3, 3.0)
"""Multiples of `TYPICAL` from which the search begins."""

ROUNDS = 40
"""Most rounds of expectation maximisation."""

MAP_STD = 0.004
"""Standard deviation of the track's deceleration as the map tells it [m/s²]: 0.4 per mille."""

CURVE_STD = 0.05
"""How much one trip's curve differs from the common one, over the curve: load, wind, weather."""

CERTAIN = 0.95
"""A block belongs to a coasting segment if it is coasting with this probability."""

SHORTEST = 8.0
"""Segments shorter than this [s] are not used: a moment without effort proves nothing."""

LEVELS = Levels.usual()
"""What coasting is told from."""

LEAST_DENSITY = 1e-6
"""Density [s²/m] of what no level explains."""

EVIDENCE = 6.0
"""Least gain in log-likelihood that coasting must bring over a world without coasting."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Neighbouring blocks of a trip in pairs, one row a pair; (n,) arrays.

    Attributes
    ----------
    start, end : array [s]
        Of the pair.
    acceleration : array [m/s²]
        Change of mean speed from one block to the next over its length.
    track : array [m/s²]
        Deceleration by the track where the map is known, averaged alike.
    speed, square : array [m/s], [m²/s²]
        Mean of v and v², averaged alike.
    noise : float [m/s²]
        Standard deviation of `acceleration` from the speed's noise.
    length : float [s]
        Of a block.
    fresh : bool array
        True where a stretch begins.
    """

    start: FloatArray
    end: FloatArray
    acceleration: FloatArray
    track: FloatArray
    speed: FloatArray
    square: FloatArray
    noise: float
    length: float
    fresh: BoolArray


@dataclass(frozen=True, slots=True)
class Segment:
    """A coasting segment of one trip.

    Attributes
    ----------
    start, end : float [s]
        On the trip's clock.
    probability : float
        Mean probability of coasting over its blocks.
    """

    start: float
    end: float
    probability: float

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.end - self.start


@dataclass(frozen=True, eq=False)
class Detection:
    """Where the trips coasted.

    Attributes
    ----------
    segments : tuple of tuple of Segment
        For each trip.
    blocks : tuple of Blocks
    probability : tuple of array
        Of coasting, for each pair of blocks.
    theta : (4,) array
        k, c0, c1, c2 as far as the detection needed them; not the answer.
    evidence : float
        Gain in log-likelihood over a world without coasting.
    """

    segments: tuple[tuple[Segment, ...], ...]
    blocks: tuple[Blocks, ...]
    probability: tuple[FloatArray, ...]
    theta: FloatArray
    evidence: float


def blocks_of(motion: Motion, track: FloatArray) -> Blocks:
    """Pairs of blocks over the usable stretches of a motion.

    Parameters
    ----------
    motion : Motion
    track : (n,) array [m/s²]
        Deceleration by the track at each sample.
    """
    density = motion.noise * np.sqrt(motion.period)
    length = float(
        np.clip((np.sqrt(2.0) * density / RESOLUTION) ** (2.0 / 3.0), SHORTEST_BLOCK, LONGEST_BLOCK)
    )
    length = max(length, 2.0 * motion.period)
    usable = motion.usable & np.isfinite(track)
    stretch = np.cumsum(np.diff(usable.astype(np.int64), prepend=0) == 1)
    numbers = stretch[usable]
    time = motion.time[usable]
    begins = time[np.unique(numbers, return_index=True)[1]] if time.size else np.empty(0)
    block = np.floor((time - begins[numbers - 1]) / length).astype(np.int64)
    key, member, samples = np.unique(
        numbers * 1_000_000 + block, return_inverse=True, return_counts=True
    )
    values = np.column_stack([time, motion.speed[usable], motion.speed[usable] ** 2, track[usable]])
    sums = [np.bincount(member, column, minlength=key.size) for column in values.T]
    means: FloatArray = np.column_stack(sums) / np.maximum(samples, 1)[:, None]
    full = samples >= max(0.6 * length / motion.period, 1.0)
    pair = np.flatnonzero((np.diff(key) == 1) & full[1:] & full[:-1])
    begin = begins[key[pair] // 1_000_000 - 1] + (key[pair] % 1_000_000) * length
    step = means[pair + 1, 0] - means[pair, 0]
    mean: FloatArray = 0.5 * (means[pair] + means[pair + 1])
    per_block = max(length / motion.period, 1.0)
    return Blocks(
        start=begin,
        end=begin + 2.0 * length,
        acceleration=(means[pair + 1, 1] - means[pair, 1]) / step,
        track=mean[:, 3],
        speed=mean[:, 1],
        square=mean[:, 2],
        noise=float(np.sqrt(2.0 / per_block) * motion.noise / length),
        length=length,
        fresh=np.diff(pair, prepend=-2) != 1,
    )


def detect(blocks: Sequence[Blocks], ratio: tuple[float, float]) -> Detection:
    """Find where the trips of one train coasted.

    Parameters
    ----------
    blocks : sequence of Blocks
        One a trip.
    ratio : (float, float)
        Mass over inertia, and its standard deviation.

    Raises
    ------
    NotIdentifiableError
        If nothing can be used, or no coasting is found.
    """
    filled = [each for each in blocks if each.start.size]
    if not filled:
        raise NotIdentifiableError(
            "the train never ran long enough without a gap in its speed and its place to look for"
            " coasting",
            remedy="give a recording with fewer gaps and, for the gradient, with chainage",
        )
    mean = np.array([ratio[0], *TYPICAL])
    spread = np.array([ratio[1], *TYPICAL_STD])
    without = sum(_posterior(each, mean, coasts=0.0)[1] for each in filled)
    best: tuple[float, FloatArray] | None = None
    for beginning in BEGINNINGS:
        start = np.array([ratio[0], *(beginning * np.array(TYPICAL))])
        theta, likelihood = _maximised(filled, start, mean, spread)
        worth = likelihood - 0.5 * float(np.sum(((theta - mean) / spread) ** 2))
        if best is None or worth > best[0]:
            best = (worth, theta)
    assert best is not None
    evidence, theta = best[0] - without, best[1]
    probabilities = tuple(
        _posterior(each, theta)[0] if each.start.size else np.empty(0) for each in blocks
    )
    segments = tuple(
        _segments(each, probability)
        for each, probability in zip(blocks, probabilities, strict=True)
    )
    if evidence >= EVIDENCE and not any(segments):
        raise NotIdentifiableError(
            f"coasting was found, but never for {SHORTEST:.0f} s and with certainty",
            remedy="give a recording in which the train rolls freely for tens of seconds",
        )
    if evidence < EVIDENCE:
        raise NotIdentifiableError(
            "no coasting was found: the motion is explained as well by a driver who always held"
            f" some effort (log-likelihood gained by coasting {evidence:.1f}, needed"
            f" {EVIDENCE:.0f})",
            remedy="give a recording in which the train rolls freely for tens of seconds",
        )
    return Detection(segments, tuple(blocks), probabilities, theta, evidence)


def _rows(blocks: Blocks) -> FloatArray:
    """Regressors (n, 4) of the acceleration: what k, c0, c1, c2 do to it."""
    return -np.column_stack([blocks.track, np.ones(blocks.track.size), blocks.speed, blocks.square])


def _spread(blocks: Blocks, curve: FloatArray) -> FloatArray:
    """Standard deviation (n,) of the effort that a pair of blocks tells."""
    return np.sqrt(blocks.noise**2 + MAP_STD**2 + (CURVE_STD * curve) ** 2)


def _posterior(
    blocks: Blocks, theta: FloatArray, *, coasts: float = 1.0
) -> tuple[FloatArray, float]:
    """Probability (n,) of coasting, and the log-likelihood."""
    rows = _rows(blocks)
    effort = blocks.acceleration - rows @ theta
    noise = _spread(blocks, rows[:, 1:] @ theta[1:])
    # An outlier is unlikely at every level, impossible at none.
    resting = _density(effort, noise) + LEAST_DENSITY
    spread = np.hypot(noise[:, None], LEVELS.spread)
    working = _density(effort[:, None] - LEVELS.values, spread) + LEAST_DENSITY
    probability, likelihood = posterior(
        resting, working, blocks.fresh, LEVELS.share, rates(blocks.length, coasts=coasts)
    )
    return probability, float(likelihood)


def _density(difference: FloatArray, spread: FloatArray) -> FloatArray:
    """Normal density."""
    return np.asarray(np.exp(-0.5 * (difference / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi)))


def _maximised(
    trips: Sequence[Blocks], theta: FloatArray, mean: FloatArray, spread: FloatArray
) -> tuple[FloatArray, float]:
    """Expectation maximisation from a beginning: the curve and its log-likelihood."""
    previous = likelihood = -np.inf
    for _ in range(ROUNDS):
        information, vector = np.diag(1.0 / spread**2), mean / spread**2
        likelihood = 0.0
        for each in trips:
            probability, part = _posterior(each, theta)
            likelihood += part
            rows = _rows(each)
            weight = probability / _spread(each, rows[:, 1:] @ theta[1:]) ** 2
            information += (rows * weight[:, None]).T @ rows
            vector += rows.T @ (weight * each.acceleration)
        theta = np.asarray(np.linalg.solve(information, vector), dtype=np.float64)
        if likelihood - previous < 1e-3:
            break
        previous = likelihood
    return theta, likelihood


def _segments(blocks: Blocks, probability: FloatArray) -> tuple[Segment, ...]:
    """Runs of pairs that are coasting with certainty.

    A pair hardly weighs what happens in its outer quarters, half a block at either end of a run.
    """
    sure = probability > CERTAIN
    edge = np.concatenate(([True], blocks.fresh[1:])) if sure.size else np.empty(0, dtype=bool)
    run = np.cumsum((np.diff(sure, prepend=False) != 0) | edge)
    found = []
    for number in np.unique(run[sure]):
        inside = np.flatnonzero((run == number) & sure)
        start = float(blocks.start[inside[0]]) + 0.5 * blocks.length
        end = float(blocks.end[inside[-1]]) - 0.5 * blocks.length
        if end - start >= SHORTEST:
            found.append(Segment(start, end, float(np.mean(probability[inside]))))
    return tuple(found)

"""Where a train coasted, found from its motion and the line's gradient alone.

Over two neighbouring blocks of a few seconds each the equation of motion per unit of inertia reads

    (V2 - V1) / T = f - k a_track - c0 - c1 v - c2 v²,        k = m / (m + rotating mass),

all of it averaged alike. While the train coasts f is nought and the speed obeys one curve c(v)
whatever the gradient does: a driver who holds his speed moves his lever at each change of gradient,
a train that coasts changes its acceleration. `posterior` holds f as hidden; the curve is found
along with it by expectation maximisation (Baum and Welch) from several beginnings, the likeliest of
which is taken. A trip that is explained as well without any coasting has none.

Effort over inertia is a hidden Markov process: nothing at all (a lever at rest), or one of many
levels between full braking and full traction, and it lasts. The levels stand as close to each other
as the noise lets them be distinguished, so that "no effort" competes on equal terms with "the same
little effort all the time".

References
----------
Rabiner, L. R. (1989), A tutorial on hidden Markov models and selected applications in speech
recognition, Proc. IEEE 77(2), eqs. (19)-(27) with the scaling of section V.A.
Dempster, A. P., Laird, N. M., Rubin, D. B. (1977), Maximum likelihood from incomplete data via the
EM algorithm, Journal of the Royal Statistical Society B 39(1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from analysis.resistance.motion import Motion
from trainlog.arrays import BoolArray, FloatArray
from trainlog.errors import NotIdentifiableError
from trainlog.railway.resistance import basis

SPACING = 0.008
"""Distance between levels of effort over inertia [m/s²]: a tenth of the running resistance of a
passenger train at speed, and what a gradient 0.8 per mille off looks like."""

EVEN = 0.12
"""Up to here [m/s²] levels are equally far apart; beyond, each gap is a quarter larger."""

LARGEST_EFFORT = 1.5
"""Largest effort over inertia [m/s²]."""

USUAL_EFFORT = 0.3
"""Scale of the efforts that trains make [m/s²]; larger ones are rarer."""

COASTING_TIME, EFFORT_TIME = 30.0, 30.0
"""How long coasting usually lasts, and how long it takes until a driver coasts again [s]."""

HELD_TIME = 15.0
"""How long a lever is held before it goes somewhere else [s]."""

DRIFT_TIME = 6.0
"""How long an effort stays on its level before it drifts to the next [s]."""


@njit(cache=True)  # type: ignore[untyped-decorator]
def posterior(
    resting: FloatArray,
    working: FloatArray,
    fresh: BoolArray,
    share: FloatArray,
    rates: tuple[float, float, float, float],
) -> tuple[FloatArray, float]:
    """Probability (n,) of coasting at each step given all steps, and the log-likelihood.

    Parameters
    ----------
    resting : (n,) array
        Density of each observation while coasting.
    working : (n, k) array
        The same at each level of effort.
    fresh : (n,) bool array
        True where a stretch begins that owes nothing to what was before.
    share : (k,) array
        Where a lever goes that is moved.
    rates : (float, float, float, float)
        Probability in a step of ending to coast, of beginning to, of moving the lever, and of
        drifting to a neighbouring level.
    """
    count, kinds = working.shape
    leave, rest, move, drift = rates
    forward = np.zeros((count, kinds + 1))
    scale = np.ones(count)
    prior = rest / (rest + leave) if rest > 0.0 else 0.0
    logarithm = 0.0
    for n in range(count):
        idle = prior
        if fresh[n]:
            for j in range(kinds):
                forward[n, j] = (1.0 - prior) * share[j] * working[n, j]
        else:
            before = forward[n - 1]
            idle = before[kinds] * (1.0 - leave) + (1.0 - before[kinds]) * rest
            moved = (1.0 - before[kinds]) * (1.0 - rest) * move + before[kinds] * leave
            kept = (1.0 - rest) * (1.0 - move)
            for j in range(kinds):
                below = before[max(j - 1, 0)]
                above = before[min(j + 1, kinds - 1)]
                held = (1.0 - drift) * before[j] + 0.5 * drift * (below + above)
                forward[n, j] = (kept * held + moved * share[j]) * working[n, j]
        forward[n, kinds] = idle * resting[n]
        total = 0.0
        for j in range(kinds + 1):
            total += forward[n, j]
        forward[n] /= total
        scale[n] = total
        logarithm += np.log(total)
    coasting = np.empty(count)
    backward = np.ones(kinds + 1)
    ahead = np.empty(kinds + 1)
    for n in range(count - 1, -1, -1):
        coasting[n] = forward[n, kinds] * backward[kinds]
        if fresh[n]:
            backward[:] = 1.0
            continue
        anywhere = 0.0
        for j in range(kinds):
            ahead[j] = working[n, j] * backward[j] / scale[n]
            anywhere += share[j] * ahead[j]
        ahead[kinds] = resting[n] * backward[kinds] / scale[n]
        kept = (1.0 - rest) * (1.0 - move)
        for j in range(kinds):
            beside = 0.5 * drift * (ahead[max(j - 1, 0)] + ahead[min(j + 1, kinds - 1)])
            held = (1.0 - drift) * ahead[j] + beside
            backward[j] = kept * held + (1.0 - rest) * move * anywhere + rest * ahead[kinds]
        backward[kinds] = (1.0 - leave) * ahead[kinds] + leave * anywhere
    return coasting, logarithm


def rates(step: float, *, coasts: float = 1.0) -> tuple[float, float, float, float]:
    """What `posterior` needs to know of a step [s]; with `coasts` 0 nobody ever coasts."""
    leave, rest, move, drift = (
        float(-np.expm1(-step / time))
        for time in (COASTING_TIME, EFFORT_TIME, HELD_TIME, DRIFT_TIME)
    )
    return leave, coasts * rest, move, drift


RESOLUTION = 0.012
"""Noise of the acceleration over two blocks [m/s²] that their length aims at."""

SHORTEST_BLOCK, LONGEST_BLOCK = 1.0, 5.0
"""Length of a block [s]."""

TYPICAL = (0.014, 5e-4, 5e-5)
"""Coefficients over inertia of a train that might be any train; beginnings are multiples."""

TYPICAL_STD = (0.007, 7e-4, 4e-5)
"""How far trains are from it: weak, only to keep the curve from what no train has."""

BEGINNINGS = (0.4, 0.6, 0.8, 1.0, 1.3, 1.7, 2.3, 3.0)
"""Multiples of `TYPICAL` from which the search begins."""

ROUNDS = 40
"""Most rounds of expectation maximisation."""

MAP_STD = 0.004
"""Standard deviation of the track's deceleration by the map [m/s²]: 0.4 per mille."""

CURVE_STD = 0.05
"""How much one trip's curve differs from the common one, over the curve: load, wind, weather."""

CERTAIN = 0.95
"""A block belongs to a coasting segment if it is coasting with this probability."""

SHORTEST = 8.0
"""Segments shorter than this [s] are not used: a moment without effort is no evidence."""

_GAPS = [SPACING] * round(EVEN / SPACING)
while sum(_GAPS) < LARGEST_EFFORT:
    _GAPS.append(1.25 * _GAPS[-1])

LEVELS = np.concatenate((-np.cumsum(_GAPS)[::-1], np.cumsum(_GAPS)))
"""Efforts over inertia that coasting is distinguished from [m/s²], increasing."""

_WIDTH = np.array([*_GAPS[::-1], *_GAPS])

LEVEL_STD = 0.5 * _WIDTH
"""Standard deviation within a level [m/s²]: half a gap wide, neighbours add up to an even density,
and no effort is favoured."""

_SHARE = _WIDTH * np.exp(-np.abs(LEVELS) / USUAL_EFFORT)

LEVEL_SHARE = _SHARE / _SHARE.sum()
"""Where a lever goes that is moved: it is as likely at any notch, levels weigh as they are wide."""

LEAST_DENSITY = 1e-6
"""Density [s²/m] of what no level explains."""

EVIDENCE = 6.0
"""Least gain in log-likelihood that coasting must bring over no coasting at all."""


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
    curve : (n, p) array
        What each coefficient of the curve is multiplied by, averaged alike.
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
    curve: FloatArray
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
    speed = motion.speed[usable]
    values = np.column_stack([time, speed, track[usable], basis(speed)])
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
        track=mean[:, 2],
        curve=mean[:, 3:],
        noise=float(np.sqrt(2.0 / per_block) * motion.noise / length),
        length=length,
        fresh=np.diff(pair, prepend=-2) != 1,
    )


def detect(
    blocks: Sequence[Blocks], ratio: tuple[float, float]
) -> tuple[list[tuple[Segment, ...]], float]:
    """Where the trips of one train coasted, and the gain in log-likelihood over no coasting at all.

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
    starts = (np.array([ratio[0], *(times * np.array(TYPICAL))]) for times in BEGINNINGS)
    found = [_maximised(filled, start, mean, spread) for start in starts]
    worth = [likely - 0.5 * float(np.sum(((at - mean) / spread) ** 2)) for at, likely in found]
    best = int(np.argmax(worth))
    evidence, theta = worth[best] - without, found[best][0]
    segments = [
        _segments(each, _posterior(each, theta)[0]) if each.start.size else () for each in blocks
    ]
    if evidence >= EVIDENCE and not any(segments):
        raise NotIdentifiableError(
            f"coasting was found, but never for {SHORTEST:.0f} s and with certainty",
            remedy="give a recording in which the train rolls freely for tens of seconds",
        )
    if evidence < EVIDENCE:
        raise NotIdentifiableError(
            "no coasting was found: coasting could not be distinguished from slight traction"
            f" or braking (gain in log-likelihood {evidence:.1f}, at least"
            f" {EVIDENCE:.0f} is needed)",
            remedy="give a recording in which the train rolls freely for tens of seconds",
        )
    return segments, evidence


def _rows(blocks: Blocks) -> FloatArray:
    """Regressors (n, 1 + p) of the acceleration: what k and the curve's coefficients do to it."""
    return -np.column_stack([blocks.track, blocks.curve])


def _spread(blocks: Blocks, curve: FloatArray) -> FloatArray:
    """Standard deviation (n,) of the effort that a pair of blocks shows."""
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
    spread = np.hypot(noise[:, None], LEVEL_STD)
    working = _density(effort[:, None] - LEVELS, spread) + LEAST_DENSITY
    probability, likelihood = posterior(
        resting, working, blocks.fresh, LEVEL_SHARE, rates(blocks.length, coasts=coasts)
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

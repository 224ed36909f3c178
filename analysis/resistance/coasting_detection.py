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
import pandas as pd
from numba import njit

from analysis.resistance.noise import integral_between
from analysis.resistance.recording import SpeedScale, increasing_seconds, speed_scale
from estimators.motion import smooth_motion
from estimators.regression import Free, regress
from trainlog.arrays import BoolArray, FloatArray, robust_std
from trainlog.errors import NotIdentifiableError
from trainlog.railway.resistance import TYPICAL, TYPICAL_STD, basis
from trainlog.trip import POSITION_TOPICS, Trip, seconds

TOPICS = ("/gnss/motion", "/train/state", "/estimates/state")
"""What is read of a trip; efforts are not looked at, even if they were recorded."""

LOWEST_SPEED = 5.0
"""Slower than this [m/s] no coasting is looked for: a train that creeps up to a signal or a buffer
is braked, however gently."""

LEAST_NOISE = 1e-4
"""Smallest noise of a speed [m/s] that is assumed: exact data stay solvable."""

LONGEST_PERIOD = 2.5
"""Longest time between two samples of the speed [s] from which coasting can be detected."""

GAP_PERIODS = 2.6
"""A pause of more than so many sampling periods is a gap."""

OUTLIER = 8.0
"""A speed that is so many standard deviations off the smoothed motion is not used."""


@dataclass(frozen=True, eq=False)
class Motion:
    """How a train moved, by its speed and chainage alone; all arrays (n,).

    Attributes
    ----------
    trip : str
    start : Timestamp
    source : str
        Topic of the speed.
    time : array [s]
        Since `start`, strictly increasing.
    speed : array [m/s]
        Measured, true to scale.
    position : array [m]
        Chainage in the direction of travel; NaN where it is not known.
    usable : bool array
        False at standstill, when creeping, in gaps and at outliers.
    noise : float [m/s]
        Standard deviation of one speed.
    period : float [s]
        Usual time between two samples.
    scale : SpeedScale
        What the measured speed was divided by.
    """

    trip: str
    start: pd.Timestamp
    source: str
    time: FloatArray
    speed: FloatArray
    position: FloatArray
    usable: BoolArray
    noise: float
    period: float
    scale: SpeedScale


def motion_of(trip: Trip) -> Motion:
    """The motion that a trip recorded: of the wheels' and the satellites' speed the less noisy.

    Parameters
    ----------
    trip : Trip
        With ``/gnss/motion`` or ``/train/state``; chainage from ``/estimates/state`` or
        ``/train/state`` where there is one.

    Raises
    ------
    NotIdentifiableError
        If no speed was recorded, or too seldom.
    LogError
        If time does not increase.
    """
    known = {topic: trip[topic].dropna(subset="speed") for topic in TOPICS[:2] if topic in trip}
    found = [
        _Speed(topic, increasing_seconds(frame, trip.name), frame["speed"].to_numpy(np.float64))
        for topic, frame in known.items()
        if len(frame) > 2
    ]
    if not found:
        raise NotIdentifiableError(
            f"trip '{trip.name}': no speed was recorded",
            place="topics /gnss/motion and /train/state",
            remedy="coast-down needs the receiver's own (Doppler) speed or the wheels' speed;"
            " differences of positions are too coarse",
        )
    # What averaging over a second leaves of the noise.
    best = min(found, key=lambda each: each.noise**2 * each.period)
    if best.period > LONGEST_PERIOD:
        raise NotIdentifiableError(
            f"trip '{trip.name}': a speed every {best.period:.1f} s only",
            place=f"topic {best.topic}",
            remedy=f"coasting can be detected from speeds at most {LONGEST_PERIOD} s apart",
        )
    start = pd.DatetimeIndex(known[best.topic].index)[0]
    position = _position(trip, best.time, start)
    scale = SpeedScale(1.0, 0.0, "GNSS speed")
    if best.topic == "/train/state":
        scale = speed_scale(trip.with_topic(known[best.topic]), best.time, best.value, position)
    speed = best.value / scale.factor
    return Motion(
        trip.name, start, best.topic, best.time, speed, position, _usable(best, speed),
        best.noise, best.period, scale,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Speed:
    """A recorded speed: its topic, when it was measured [s], and what [m/s]."""

    topic: str
    time: FloatArray
    value: FloatArray

    @property
    def period(self) -> float:
        """Usual time between two samples [s]."""
        return float(np.median(np.diff(self.time)))

    @property
    def noise(self) -> float:
        """Standard deviation of white noise on a smooth speed [m/s], by third differences."""
        moving = self.value > LOWEST_SPEED
        third = np.diff(self.value, 3)[moving[3:] & moving[:-3]]
        return max(robust_std(third) / np.sqrt(20.0) if third.size else 0.0, LEAST_NOISE)


def smoothed_over(time: FloatArray, values: FloatArray, reach: float) -> FloatArray:
    """Mean of sampled values (n,) over `reach` [s] before and after each sample.

    Speed and what acts on it are averaged alike, so that the equation of motion still holds.
    """
    low, high = np.maximum(time - reach, time[0]), np.minimum(time + reach, time[-1])
    column = values[:, None]
    return np.asarray(integral_between(time, column, low, high)[:, 0] / (high - low))


def _position(trip: Trip, time: FloatArray, start: pd.Timestamp) -> FloatArray:
    """Chainage at the given times; NaN before it is first known and after it was last."""
    for topic in POSITION_TOPICS:
        if topic in trip and len(known := trip[topic].dropna(subset="position")) > 1:
            values = known["position"].to_numpy(np.float64)
            there = seconds(known, start)
            return np.asarray(np.interp(time, there, values, left=np.nan, right=np.nan))
    return np.full(time.size, np.nan)


def _usable(recorded: _Speed, speed: FloatArray) -> BoolArray:
    """Samples that belong to an uninterrupted motion at more than `LOWEST_SPEED`."""
    noise = max(recorded.noise, 0.01)
    motion = smooth_motion(recorded.time, speed, noise)
    near = np.abs(speed - motion.speed) < OUTLIER * np.hypot(motion.speed_std, noise)
    usable = (motion.speed > LOWEST_SPEED) & near
    pause = np.diff(recorded.time) > GAP_PERIODS * recorded.period
    usable[1:] &= ~pause
    usable[:-1] &= ~pause
    return np.asarray(usable)


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


RESOLUTION = 0.012
"""Noise of the acceleration over two blocks [m/s²] that their length aims at."""

SHORTEST_BLOCK, LONGEST_BLOCK = 1.0, 5.0
"""Length of a block [s]."""

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
    start : array [s]
        Of the pair.
    acceleration : array [m/s²]
        Change of mean speed from one block to the next over its length.
    rows : (n, 1 + p) array
        What mass over inertia (by the track) and the curve's coefficients do to it.
    noise : float [m/s²]
        Standard deviation of `acceleration` from the speed's noise.
    length : float [s]
        Of a block.
    fresh : bool array
        True where a stretch begins.
    """

    start: FloatArray
    acceleration: FloatArray
    rows: FloatArray
    noise: float
    length: float
    fresh: BoolArray

    def spread(self, theta: FloatArray) -> FloatArray:
        """Standard deviation (n,) of the effort that a pair shows."""
        curve = CURVE_STD * (self.rows[:, 1:] @ theta[1:])
        return np.sqrt(self.noise**2 + MAP_STD**2 + curve**2)

    def posterior(self, theta: FloatArray, *, coasts: float = 1.0) -> tuple[FloatArray, float]:
        """Probability (n,) of coasting, and the log-likelihood; with `coasts` 0 nobody does."""
        effort, noise = self.acceleration - self.rows @ theta, self.spread(theta)
        # An outlier is unlikely at every level, impossible at none.
        resting = _density(effort, noise) + LEAST_DENSITY
        spread = np.hypot(noise[:, None], LEVEL_STD)
        working = _density(effort[:, None] - LEVELS, spread) + LEAST_DENSITY
        times = (COASTING_TIME, EFFORT_TIME, HELD_TIME, DRIFT_TIME)
        leave, rest, move, drift = (float(-np.expm1(-self.length / time)) for time in times)
        rates = leave, coasts * rest, move, drift
        probability, likelihood = posterior(resting, working, self.fresh, LEVEL_SHARE, rates)
        return probability, float(likelihood)

    def segments(self, theta: FloatArray) -> tuple[Segment, ...]:
        """Runs of pairs that are coasting with certainty.

        A pair hardly weighs what happens in its outer quarters, half a block at either end of a
        run.
        """
        if not self.start.size:
            return ()
        probability = self.posterior(theta)[0]
        sure = probability > CERTAIN
        number = np.cumsum((np.diff(sure, prepend=False) != 0) | self.fresh)
        runs = [np.flatnonzero(sure & (number == run)) for run in np.unique(number[sure])]
        half = 0.5 * self.length
        found = [
            Segment(
                float(self.start[run[0]]) + half,
                float(self.start[run[-1]]) + 3.0 * half,
                float(np.mean(probability[run])),
            )
            for run in runs
        ]
        return tuple(each for each in found if each.duration >= SHORTEST)


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
        Deceleration by the track at each sample; NaN where it is not known.
    """
    density = motion.noise * np.sqrt(motion.period)
    length = (np.sqrt(2.0) * density / RESOLUTION) ** (2.0 / 3.0)
    length = max(float(np.clip(length, SHORTEST_BLOCK, LONGEST_BLOCK)), 2.0 * motion.period)
    usable = motion.usable & np.isfinite(track)
    stretch = np.cumsum(np.diff(usable.astype(np.int64), prepend=0) == 1)[usable]
    time, speed = motion.time[usable], motion.speed[usable]
    begins = time[np.unique(stretch, return_index=True)[1]]
    block = np.floor((time - begins[stretch - 1]) / length).astype(np.int64)
    key, member, samples = np.unique(
        stretch * 1_000_000 + block, return_inverse=True, return_counts=True
    )
    values = np.column_stack([time, speed, -track[usable], -basis(speed)])
    sums = [np.bincount(member, column, minlength=key.size) for column in values.T]
    means: FloatArray = np.column_stack(sums) / samples[:, None]
    per_block = max(length / motion.period, 1.0)
    full = samples >= max(0.6 * per_block, 1.0)
    pair = np.flatnonzero((np.diff(key) == 1) & full[1:] & full[:-1])
    change = means[pair + 1] - means[pair]
    return Blocks(
        start=begins[key[pair] // 1_000_000 - 1] + (key[pair] % 1_000_000) * length,
        acceleration=change[:, 1] / change[:, 0],
        rows=0.5 * (means[pair] + means[pair + 1])[:, 2:],
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
    mean, spread = np.array([[ratio[0], *TYPICAL], [ratio[1], *TYPICAL_STD]])
    without = sum(each.posterior(mean, coasts=0.0)[1] for each in filled)
    starts = (np.append(ratio[0], times * np.array(TYPICAL)) for times in BEGINNINGS)
    found = [_maximised(filled, start, mean, spread) for start in starts]
    worth = [likely - 0.5 * float(np.sum(((at - mean) / spread) ** 2)) for at, likely in found]
    best = int(np.argmax(worth))
    evidence, theta = worth[best] - without, found[best][0]
    segments = [each.segments(theta) for each in blocks]
    problem = ""
    if evidence < EVIDENCE:
        problem = (
            "no coasting was found: coasting could not be distinguished from slight traction"
            f" or braking (gain in log-likelihood {evidence:.1f}, at least"
            f" {EVIDENCE:.0f} is needed)"
        )
    elif not any(segments):
        problem = f"coasting was found, but never for {SHORTEST:.0f} s and with certainty"
    if problem:
        raise NotIdentifiableError(
            problem,
            remedy="give a recording in which the train rolls freely for tens of seconds",
        )
    return segments, evidence


def _density(difference: FloatArray, spread: FloatArray) -> FloatArray:
    """Normal density."""
    return np.asarray(np.exp(-0.5 * (difference / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi)))


def _maximised(
    trips: Sequence[Blocks], theta: FloatArray, mean: FloatArray, spread: FloatArray
) -> tuple[FloatArray, float]:
    """Expectation maximisation from a beginning: the curve and its log-likelihood."""
    previous = likelihood = -np.inf
    for _ in range(ROUNDS):
        likelihood, rows = 0.0, []
        for each in trips:
            probability, part = each.posterior(theta)
            likelihood += part
            weight = np.sqrt(probability) / each.spread(theta)
            rows.append(weight[:, None] * np.column_stack([each.rows, each.acceleration]))
        *columns, left = np.concatenate(rows).T
        known = zip(columns, spread.tolist(), mean.tolist(), strict=True)
        theta = regress(left, [Free("", *each) for each in known]).estimate
        if likelihood - previous < 1e-3:
            break
        previous = likelihood
    return theta, likelihood

"""What each trip shows of its train's state, in one number each: the channels.

A channel is a series of numbers with variances, one a trip: a constant part of the running
resistance, the size of the whole curve, the gain and the delay of the recorded efforts, the scale
of the speed, its noise. Of each number that is taken off which other trains of the kind, on that
line and in that period, show too; what is left is the train's own.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import gammaln, stdtr

from analysis.fleet.resistance import FEWEST_TRAINS, KindResistance, periods_of, positive, ways_of
from analysis.resistance.recording import RECORDED_DISTANCE
from estimators.mixed import TAIL, Group, MixedEffects, mixed_effects
from trainlog.arrays import BoolArray, FloatArray, IntArray, robust_std


@dataclass(frozen=True)
class Channel:
    """What a channel is.

    Attributes
    ----------
    name : str
    unit : str
        ``"N"``, ``"s"`` or ``"1"`` (a share).
    tolerance : float
        A change that is smaller is none that counts.
    between, trips, periods : float
        How much trains, trips and days are expected to differ.
    about : str
        What it is, in words.
    """

    name: str
    unit: str
    tolerance: float
    between: float
    trips: float
    periods: float
    about: str


CHANNEL_UNITS = {"1": (100.0, "%"), "N": (1e-3, "kN"), "s": (1.0, "s")}
"""How a channel's numbers are shown: factor and unit, by the SI unit."""

CHANNELS = (
    Channel("constant resistance", "N", 300.0, 400.0, 300.0, 150.0, "force that no speed changes"),
    Channel(
        "size of the curve", "1", 0.03, 0.04, 0.03, 0.015, "running resistance over the kind's"
    ),
    Channel("effort gain", "1", 0.01, 0.02, 0.006, 0.002, "recorded over true effort, load known"),
    Channel("effort over mass", "1", 0.02, 0.03, 0.04, 0.005, "the same where no load is recorded"),
    Channel("power", "1", 0.02, 0.02, 0.03, 0.005, "largest power reached"),
    Channel("speed scale", "1", 0.002, 0.003, 0.0005, 0.0002, "recorded over true speed"),
    Channel("effort delay", "s", 0.05, 0.05, 0.02, 0.005, "of recorded efforts against the speed"),
    Channel("speed noise", "1", 0.25, 0.2, 0.1, 0.03, "of the recorded speed, over the kind's"),
)
"""The tolerances are what a workshop would not act on."""

LEVEL_CHANGE = 1e-4
"""A train's level is taken as changed, where that is sought so that its trips' noise is not judged
by the change, if noise alone would show such a change with this probability."""

FEWEST_AT_LEVEL = 3
"""A level holds for at least so many trips."""

LONGEST_AWAY = 200
"""A level that goes back to the one before is sought over at most so many trips."""

RAW_STEP = 5.0
"""A step of so many of the trips' own deviations is stated, whether or not it is a finding."""

OUTLYING = 4.0
"""Trips further from their neighbours than so many deviations are drawn in to that distance while
changes of the level are sought."""

PRIOR = 3.0
"""What is expected of trains, trips and days counts as so many of them."""

WHOLE_POWER = 0.12
"""Powers further from the highest of the kind than this share are not the train's limit."""

FEWEST_TRIPS = 8
"""A kind with fewer trips that show a channel does not show how trips differ in it."""


@dataclass(frozen=True, eq=False)
class Series:
    """A channel of all trips of a kind that show it, in order of start.

    Attributes
    ----------
    channel : Channel
    rows : (k,) int array
        Of the trips in the kind's table.
    value : (k,) array
        As it was found.
    own : (k,) array
        Less what the other trains show.
    std : (k,) array
        Of a trip around its train's level.
    between : float
        Scale of trains around the kind, and of the common part's uncertainty.
    freedom : float
        Degrees of freedom of that.
    tail : float
        Degrees of freedom of the trips' deviations over `std`.
    wander : float
        Variance by which a train's level changes in a day.
    common : bool
        Whether the trips of other trains were there to compare with.
    """

    channel: Channel
    rows: IntArray
    value: FloatArray
    own: FloatArray
    std: FloatArray
    between: float
    freedom: float
    tail: float
    wander: float
    common: bool


def channel_table(
    kind: KindResistance, trips: pd.DataFrame
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Values and variances of each channel for every trip, NaN where a trip does not show it.

    Parameters
    ----------
    kind : KindResistance
    trips : DataFrame
        Of the kind: summaries joined with passports, in order of start; see
        `analysis.fleet.trains.joined`.
    """

    def column(name: str) -> FloatArray:
        if name not in trips:
            return np.full(len(trips), np.nan)
        return trips[name].to_numpy(np.float64)

    def text(name: str) -> NDArray[np.str_]:
        return trips[name].fillna("").to_numpy(str) if name in trips else np.full(len(trips), "")

    found = _resistance_channels(kind, trips)
    gain, ratio = column("effort_gain"), column("effort_over_mass")
    shown = text("effort_gain_source") == "estimated"
    weighed = shown & (text("load_source") == "recorded")
    found["effort gain"] = _logarithm(gain, column("effort_gain_std"), weighed)
    unweighed = (text("load_source") != "recorded") & (
        text("effort_over_mass_source") == "estimated"
    )
    found["effort over mass"] = _logarithm(ratio, column("effort_over_mass_std"), unweighed)
    accepted = text("refused") == ""
    power = column("max_power")
    # A driver who does not ask for all of it shows a lower limit that is not the train's.
    highest = np.quantile(power[np.isfinite(power)], 0.9) if np.isfinite(power).any() else np.nan
    whole = accepted & (np.abs(power / highest - 1.0) < WHOLE_POWER)
    found["power"] = _logarithm(power, column("max_power_std"), whole)
    scaled = np.isin(text("speed_scale_source"), ("GNSS speed", RECORDED_DISTANCE))
    found["speed scale"] = _logarithm(column("speed_scale"), column("speed_scale_std"), scaled)
    timed = text("effort_delay_source") == "estimated"
    delay = np.where(timed, column("effort_delay"), np.nan)
    # What all trips of a train err by alike is in none of their differences.
    shared = np.nan_to_num(column("effort_delay_shared_std"))
    variance = np.maximum(column("effort_delay_std") ** 2 - shared**2, 0.0)
    found["effort delay"] = delay, np.where(timed, variance, np.nan)
    noise = column("speed_noise") if "speed_noise" in trips else column("noise_speed")
    found["speed noise"] = _logarithm(noise, 0.03 * noise, noise > 0.0)
    return found


def _logarithm(
    value: FloatArray, std: FloatArray, shown: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Logarithm and its variance, NaN where it is not shown."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return (
            np.where(shown, np.log(value), np.nan),
            np.where(shown, (std / value) ** 2, np.nan),
        )


def _resistance_channels(
    kind: KindResistance, trips: pd.DataFrame
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """The constant part of a trip's curve, and its size, by generalised least squares."""
    curves, found = kind.curves, kind.effects
    variances = positive(curves.variances)
    trust = np.linalg.inv(variances + found.within)
    off = curves.values - found.mean
    place = np.flatnonzero((trips["refused"] == "").to_numpy())
    constant = curves.nodes[:, 0]
    channels = {}
    for name, direction in (("constant resistance", constant), ("size of the curve", found.mean)):
        weight = np.einsum("i,kij,j->k", direction, trust, direction)
        value, variance = np.full(len(trips), np.nan), np.full(len(trips), np.nan)
        value[place] = np.einsum("i,kij,kj->k", direction, trust, off) / weight
        # Without the part of the trips' own deviations, which the series finds anew.
        own = np.einsum("i,kij,kjl,klm,m->k", direction, trust, variances, trust, direction)
        variance[place] = own / weight**2
        channels[name] = value, variance
    return channels


def series_of(
    channel: Channel,
    values: tuple[FloatArray, FloatArray],
    trips: pd.DataFrame,
) -> Series | None:
    """A channel's series; None where too few trips show it."""
    value, variance = values
    rows = np.flatnonzero(np.isfinite(value) & np.isfinite(variance))
    if rows.size < FEWEST_TRIPS:
        return None
    used = trips.iloc[rows]
    names, train = np.unique(used["train"].to_numpy(str), return_inverse=True)
    common = names.size >= FEWEST_TRAINS
    number, periods = periods_of(used["start"])
    line = ways_of(used)
    unit = np.eye(1)
    y, v = value[rows, None] / channel.between, variance[rows, None, None] / channel.between**2
    relative = channel.trips / channel.between, channel.periods / channel.between
    lines = int(line.max()) + 1
    others = (
        Group(
            number if common else np.full(rows.size, -1),
            periods if common else 0,
            None,
            relative[1] ** 2 * unit,
            PRIOR,
        ),
        Group(line, lines, None, relative[0] ** 2 * unit, PRIOR),
    )

    def fitted(level: IntArray) -> MixedEffects:
        trains = Group(level, int(level.max()) + 1, None, unit, PRIOR, heavy=True)
        return mixed_effects(y, v, (trains, *others), relative[0] ** 2 * unit, PRIOR)

    found = fitted(train)
    # A change of a train's level is no noise of its trips: each level is an effect of its own.
    level = _levels(y[:, 0] - found.without(0)[:, 0], np.sqrt(v[:, 0, 0]), train)
    changed = int(level.max()) + 1 > names.size
    within = fitted(level) if changed else found
    expected = np.empty(rows.size)
    for each in range(names.size):
        mine = train == each
        if names.size > 1:
            expected[mine] = found.left_out(mine)[:, 0]
        else:
            expected[mine] = found.without(0)[:, 0]
    own = y[:, 0] - expected
    std = np.sqrt(v[:, 0, 0] + within.within[0, 0])
    mean_variance = float(found.block(0, 0)[0, 0])
    steady = own - pd.Series(own).groupby(level).transform("median").to_numpy() if changed else own
    tail, size = _tail(steady / std, train)
    days = (used["start"] - used["start"].min()) / pd.Timedelta(days=1)
    wander = _wander(own, train, days.to_numpy(np.float64))
    scale = channel.between
    return Series(
        channel=channel,
        rows=rows,
        value=value[rows],
        own=own * scale,
        std=std * size * scale,
        between=float(np.sqrt(found.spreads[0][0, 0] + mean_variance)) * scale,
        freedom=min(names.size - 1 + PRIOR, TAIL),
        tail=tail,
        wander=wander * scale**2,
        common=names.size > 1,
    )


def _levels(own: FloatArray, known: FloatArray, train: IntArray) -> IntArray:
    """Number of the level at which each trip is: a train's trips between two of its changes.

    By repeated parting in two (Scott and Knott 1974), with the Student test of two means, the noise
    being that around the two: so that neither a change nor a false scale of the noise decides.
    """
    level = np.zeros(own.size, dtype=np.int64)
    count = 0
    for each in range(int(train.max()) + 1):
        mine = np.flatnonzero(train == each)
        value = _without_outliers(own[mine])
        parts = [(0, mine.size)]
        while parts:
            first, end = parts.pop()
            cuts = _parting(value[first:end], known[mine[first:end]])
            if cuts:
                borders = [first, *(first + cut for cut in cuts), end]
                parts += reversed(list(pairwise(borders)))
            else:
                level[mine[first:end]] = count
                count += 1
    return level


def _without_outliers(value: FloatArray) -> FloatArray:
    """Values, those far from the median of their neighbours drawn in."""
    near = medians(value, 2, 2)
    apart = value - near
    reach = OUTLYING * robust_std(apart[apart != 0.0]) if apart.any() else 0.0
    return np.asarray(near + np.clip(apart, -reach, reach))


def medians(x: FloatArray, before: int, after: int = 0) -> FloatArray:
    """Median, (n,), of each value, up to `before` earlier ones and up to `after` later ones.

    Examples
    --------
    >>> medians(np.array([1.0, 9.0, 2.0, 3.0]), 2).tolist()
    [1.0, 5.0, 2.0, 3.0]
    """
    if x.size == 0:
        return x
    padded = np.pad(x, (before, after), constant_values=np.inf)
    ordered = np.sort(np.lib.stride_tricks.sliding_window_view(padded, before + 1 + after), axis=1)
    each = np.arange(x.size)
    count = np.minimum(each, before) + 1 + np.minimum(x.size - 1 - each, after)
    return np.asarray(0.5 * (ordered[each, (count - 1) // 2] + ordered[each, count // 2]))


def _parting(value: FloatArray, known: FloatArray) -> tuple[int, ...]:
    """The trips at which the level changes; where it does not once, to where and back, if it does.

    Olshen et al. (2004) part a circle, so that a change which goes again is found.
    """
    n = value.size
    if n < 2 * FEWEST_AT_LEVEL:
        return ()
    # Values that are all alike show no smaller noise than each is known with.
    least = float(np.median(known)) / np.sqrt(n)
    at, t, _ = _parted(value, least)
    chance = 2.0 * (n - 2 * FEWEST_AT_LEVEL + 1) * float(beyond(np.array([t]), n - 2.0)[0])
    if chance < LEVEL_CHANGE:
        return (at,)
    longest = min(n - 2 * FEWEST_AT_LEVEL, LONGEST_AWAY)
    value = value - np.median(value)
    sums, square = np.append(0.0, np.cumsum(value)), float(value @ value)
    best, tried = (0.0, 0, 0), 0
    for length in range(FEWEST_AT_LEVEL, longest + 1):
        inside = sums[length:] - sums[:-length]
        outside = (sums[-1] - inside) / (n - length)
        rest = square - inside**2 / length - (n - length) * outside**2
        deviation = np.sqrt(np.maximum(rest / (n - 2), least**2))
        apart = np.abs(inside / length - outside)
        t = apart / (deviation * np.sqrt(1.0 / length + 1.0 / (n - length)))
        inner = t[FEWEST_AT_LEVEL : n - length - FEWEST_AT_LEVEL + 1]
        tried += inner.size
        if inner.size and float(inner.max()) > best[0]:
            start = FEWEST_AT_LEVEL + int(np.argmax(inner))
            best = float(inner.max()), start, start + length
    chance = 2.0 * max(tried, 1) * float(beyond(np.array([best[0]]), n - 2.0)[0])
    return best[1:] if chance < LEVEL_CHANGE else ()


def _parted(value: FloatArray, least: float) -> tuple[int, float, float]:
    """Where values part best in two levels, Student's t of these, deviation (`least`) around."""
    n = value.size
    before = np.arange(1, n)
    value = value - np.median(value)
    sums, squares = np.cumsum(value), np.cumsum(value**2)
    one, other = sums[:-1] / before, (sums[-1] - sums[:-1]) / (n - before)
    rest = squares[-1] - before * one**2 - (n - before) * other**2
    deviation = np.sqrt(np.maximum(rest / (n - 2), least**2))
    t = np.abs(other - one) / (deviation * np.sqrt(1.0 / before + 1.0 / (n - before)))
    t[: FEWEST_AT_LEVEL - 1] = t[n - FEWEST_AT_LEVEL :] = 0.0
    at = int(np.argmax(t))
    return at + 1, float(t[at]), float(deviation[at])


def raw_step(value: FloatArray, tolerance: float) -> tuple[int, float, float] | None:
    """The step of a train's trips that is seen without any comparison; None where there is none.

    Parameters
    ----------
    value : (k,) array
        In order of start, without NaN.
    tolerance : float
        Steps that are smaller do not count; the trips' deviations are not taken for smaller than a
        tenth of it.

    Returns
    -------
    tuple or None
        First trip after it, its size, and this over the trips' deviations before and after.

    Examples
    --------
    >>> raw_step(np.array([0.1, -0.1, 0.0, 0.1, 2.0, 2.1, 1.9]), 0.2)[0]
    4
    """
    if value.size < 2 * FEWEST_AT_LEVEL:
        return None
    at, _, deviation = _parted(_without_outliers(value), 0.1 * tolerance)
    size = float(np.median(value[at:]) - np.median(value[:at]))
    if abs(size) < max(tolerance, RAW_STEP * deviation):
        return None
    return at, size, abs(size) / deviation


TAILS = np.array([2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 20.0, 60.0])

NEIGHBOURS = 10
"""Trips of the same train, before, whose median a trip is compared with to see how trips differ."""

FEWEST = 4
"""Fewer trips before are not compared with."""

ALIKE = 1e-6
"""Scatter of trips, over the expected one, below which it is that of rounding."""

CHI_SQUARE_QUARTILE = 0.1015
"""A quarter of squares of one degree of freedom are below it."""


def _tail(deviation: FloatArray, train: IntArray) -> tuple[float, float]:
    """Degrees of freedom and scale of a Student distribution of trips around their neighbours."""
    parts = [deviation[train == each] for each in range(int(train.max()) + 1)]
    apart = np.concatenate(
        [own[FEWEST:] - medians(own, NEIGHBOURS - 1)[FEWEST - 1 : -1] for own in parts]
    )
    # Values that are alike, as of a recorder that rounds, do not show how far others may be.
    if apart.size < 3 * NEIGHBOURS or robust_std(apart) < ALIKE:
        return TAIL, 1.2
    best = (-np.inf, TAIL, 1.0)
    for tail in TAILS:
        scale = robust_std(apart)
        for _ in range(30):
            weight = (tail + 1.0) / (tail + (apart / scale) ** 2)
            scale = float(np.sqrt(np.mean(weight * apart**2)))
        likelihood = _log_student(apart / scale, float(tail)).sum() - apart.size * np.log(scale)
        best = max(best, (float(likelihood), float(tail), scale))
    return best[1], best[2]


def _log_student(x: FloatArray, tail: float) -> FloatArray:
    constant = gammaln(0.5 * (tail + 1.0)) - gammaln(0.5 * tail) - 0.5 * np.log(tail * np.pi)
    return np.asarray(constant - 0.5 * (tail + 1.0) * np.log1p(x**2 / tail))


def _wander(own: FloatArray, train: IntArray, days: FloatArray) -> float:
    """Variance a day by which levels of trains change, by the lower quartile of changes."""
    rates, count = [], 0
    for each in range(int(train.max()) + 1):
        smooth, day = medians(own[train == each], 4)[4:], days[train == each][4:]
        gap = day[15:-5] - day[:-20]
        apart = gap > 0.0
        if apart.any():
            # The smaller ones: half of the pairs may lie on both sides of a jump.
            far, near = (
                np.quantile(np.square(smooth[20:] - earlier)[apart], 0.25)
                for earlier in (smooth[:-20], smooth[15:-5])
            )
            rates.append((far - near) / np.median(gap[apart]))
            count += int(apart.sum())
    if count < 30:
        return 0.0
    # By the train in the middle: one that jumped does not make all others wander. Less what the
    # trains differ by: noise alone must not look like wandering.
    rate = np.array(rates)
    middle = float(np.median(rate))
    doubt = robust_std(rate - middle) * np.sqrt(0.5 * np.pi / rate.size)
    return float(max(middle - 2.0 * doubt, 0.0) / CHI_SQUARE_QUARTILE)


def beyond(x: FloatArray, tail: float) -> FloatArray:
    """Probability that a Student distribution is beyond x."""
    return np.asarray(stdtr(tail, -x))

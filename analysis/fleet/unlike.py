"""Trains that are not like the others, or like themselves before, with a stated false-alarm rate.

Each channel of a train (`analysis.fleet.channels`) is watched for a change: the median of the last
trips is compared with the level that the train had before, and that level, once, with the kind's.
A median of n values is beyond x only if half of them are, so that its probability follows from
that of a single trip by the binomial distribution; single trips follow the Student distribution
that the fleet's own trips show. The probability of an alarm on a healthy train within a month is
shared out among all that is looked at in a month (Bonferroni): overlapping windows are counted as
if each were another chance, so that the true rate is below the stated one.

What changed is named afterwards: a fault moves several channels in a known proportion, and the one
that explains all of them best is stated, with those that explain them about as well.

References
----------
Willsky, A. S., Jones, H. L. (1976), A generalized likelihood ratio approach to the detection and
estimation of jumps in linear systems, IEEE Transactions on Automatic Control 21(1).
David, H. A., Nagaraja, H. N. (2003), Order Statistics, 3rd ed., eq. (2.1.3).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
from scipy.special import betainc, gammaincc, stdtrit

from analysis.fleet.channels import (
    CHANNEL_UNITS,
    CHANNELS,
    FEWEST_TRIPS,
    Channel,
    Series,
    beyond,
    channel_table,
    medians,
    raw_step,
    series_of,
)
from analysis.fleet.resistance import KindResistance
from trainlog.arrays import BoolArray, FloatArray, IntArray, robust_std
from trainlog.display import counted

PROBABLE = 0.05
"""Other faults at least as probable as this are stated beside the likeliest."""

UNEXPLAINED = 1e-4
"""A fault that explains the channels no better than this is not what it is."""

SLACK = 0.5
"""Channels of a healthy train move by this share of their tolerance."""


@dataclass(frozen=True)
class Shift:
    """By how much a channel of a train moved, and the variance of that."""

    channel: Channel
    size: float
    variance: float


@dataclass(frozen=True)
class Cause:
    """A fault that may be it.

    Attributes
    ----------
    what : str
    size, std : float
        In `unit`, with its standard deviation.
    unit : str
    probability : float
        Among the faults that are known, all equally probable beforehand.
    """

    what: str
    size: float
    std: float
    unit: str
    probability: float

    def __str__(self) -> str:
        reach = 1.96 * self.std
        factor, unit = CHANNEL_UNITS[self.unit]
        digits = 1 if unit == "%" else 2
        size, reach = factor * self.size, factor * reach
        return f"{self.what} {size:+.{digits}f} ± {reach:.{digits}f} {unit}"


@dataclass(frozen=True)
class Explanation:
    """What changed.

    Attributes
    ----------
    cause : Cause
        The likeliest.
    others : tuple of Cause
        That fit about as well.
    explained : bool
        Whether it explains all channels.
    """

    cause: Cause
    others: tuple[Cause, ...]
    explained: bool

    @property
    def what(self) -> str:
        """The likeliest fault's name, or that none of them is it."""
        return self.cause.what if self.explained else "unlike, no known fault"

    def __str__(self) -> str:
        words = str(self.cause) if self.explained else f"no known fault; nearest is {self.cause}"
        if self.others:
            words += ", or " + ", or ".join(str(each) for each in self.others)
        return words


Direction = dict[str, float]
"""What a fault of size one does to each channel."""


def faults_of(kind: KindResistance, trips: pd.DataFrame) -> dict[str, tuple[str, Direction]]:
    """Unit and direction of each known fault, on a train of a kind.

    Parameters
    ----------
    kind : KindResistance
    trips : DataFrame
        Of the train: its loads say how much of the mass is the empty train's.
    """
    # What one of a force [N] adds to the size of the curve, and the curve to the force [N].
    own_force, own_curve, both = _products(kind)
    force, curve = both / own_curve, both / own_force
    empty = 1.0
    if "load" in trips:
        share = ((trips["mass"] - trips["load"]) / trips["mass"]).median()
        empty = float(share) if np.isfinite(share) else 1.0
    weighed = "load_source" in trips and bool((trips["load_source"] == "recorded").mean() > 0.5)
    if weighed:
        mass_moves = {
            "effort gain": empty,
            "size of the curve": -empty,
            "constant resistance": -empty * curve,
            "power": -empty,
        }
        gain_moves = {"effort gain": 1.0}
    else:
        # Efforts are not corrected by a gain that nothing shows.
        mass_moves = {"effort over mass": empty}
        gain_moves = {
            "effort over mass": 1.0,
            "size of the curve": 1.0,
            "constant resistance": curve,
            "power": 1.0,
        }
    return {
        "dragging brake": ("N", {"constant resistance": 1.0, "size of the curve": force}),
        "running resistance": ("1", {"constant resistance": curve, "size of the curve": 1.0}),
        "mass": ("1", mass_moves),
        "effort gain": ("1", gain_moves),
        "wheel diameter": ("1", {"speed scale": -1.0}),
        "sensor delay": ("s", {"effort delay": 1.0}),
        "speed noise": ("1", {"speed noise": 1.0}),
    }


def _products(kind: KindResistance) -> tuple[float, float, float]:
    """Products of a constant force and the kind's curve: each with itself, and both.

    By generalised least squares with the typical trip's variance.
    """
    curves, found = kind.curves, kind.effects
    trust = np.linalg.inv(np.median(curves.variances, axis=0) + found.within)
    constant, mean = curves.nodes[:, 0], found.mean
    pairs = ((constant, constant), (mean, mean), (constant, mean))
    own_force, own_curve, both = (float(one @ trust @ other) for one, other in pairs)
    return own_force, own_curve, both


def explained(
    shifts: Sequence[Shift], kind: KindResistance, trips: pd.DataFrame, seen: str
) -> Explanation:
    """The faults that explain the shifts of a train's channels.

    Parameters
    ----------
    shifts : sequence of Shift
    kind : KindResistance
    trips : DataFrame
        Of the train.
    seen : str
        Channel that raised the alarm; the cause must move it.
    """
    names = [shift.channel.name for shift in shifts]
    size = np.array([shift.size for shift in shifts])
    slack = np.array([SLACK * shift.channel.tolerance for shift in shifts])
    covariance = np.diag(np.array([shift.variance for shift in shifts]) + slack**2)
    pair = ("constant resistance", "size of the curve")
    if set(pair) <= set(names):
        # Errors of the two channels of one curve go together.
        own_force, own_curve, both = _products(kind)
        alike = both / np.sqrt(own_force * own_curve)
        one, other = (names.index(each) for each in pair)
        shared = alike * np.sqrt(covariance[one, one] * covariance[other, other])
        covariance[one, other] = covariance[other, one] = 0.999 * shared
    trust = np.linalg.inv(covariance)
    causes, distances = [], []
    for what, (unit, moves) in faults_of(kind, trips).items():
        direction = np.array([moves.get(name, 0.0) for name in names])
        if seen not in names or moves.get(seen, 0.0) == 0.0:
            continue
        weight = float(direction @ trust @ direction)
        amount = float(direction @ trust @ size) / weight
        rest = size - amount * direction
        distance = float(rest @ trust @ rest)
        if what == "dragging brake" and amount < 0.0:
            continue
        causes.append(Cause(what, amount, weight**-0.5, unit, 0.0))
        distances.append(distance)
    order = np.argsort(distances, kind="stable")
    probability = np.exp(-0.5 * (np.array(distances) - distances[order[0]]))
    probability /= probability.sum()
    ranked = [
        replace(causes[number], probability=float(probability[number])) for number in order.tolist()
    ]
    left = max(len(shifts) - 1, 1)
    fits = float(gammaincc(0.5 * left, 0.5 * distances[order[0]])) > UNEXPLAINED
    others = tuple(each for each in ranked[1:] if each.probability >= PROBABLE)
    return Explanation(ranked[0], others, fits)


MISSING = {
    "effort gain": "no trip with a recorded load shows it",
    "speed scale": "neither satellites nor distance show the train's true speed",
    "effort delay": "no trip with line, train and efforts shows it",
}
"""Why no trip shows a channel."""

FALSE_ALARMS = 0.01
"""Probability of an alarm on a healthy train within a month."""

MONTH = pd.Timedelta(days=30)

WINDOWS = (3, 5, 9, 15, 31)
"""Trips whose median is taken."""

BEFORE = 40
"""At most so many trips before a change show the level that the train had."""

FEWEST_BEFORE = 3
"""A level that fewer trips show is not compared with."""

NORMAL_BEFORE = 6
"""The median of so many trips is as far off as a normal distribution states; of fewer it is judged
by the trips' own distribution."""

NEAR = 1.5
"""Deviations of one trip, over the root of their number, below which a median is not looked at: it
is that far off in one case of ten."""

APART = 3.0
"""Deviations of one trip from which on two levels are separated trip by trip."""

ALIKE = 1.5, 0.25
"""Trips around two levels scatter by at most so many of their deviations, or by this share of what
the levels differ by; or there are others."""

SOMETIMES = 0.15
"""Trips at the other level that are fewer than this share of a stretch between two changes are far
off by chance."""

ALWAYS = 0.85
"""A fault that shows on more of the trips than this shows on all of them: some are far off."""

GONE = 0.01
"""A fault has gone if its share of trips leaves out the last ones with a smaller probability."""

_STEPS = 30
"""Of the search for a level, each of which weighs the trips anew."""

_SHARES = np.linspace(0.1, 0.9, 17)

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(21)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


@dataclass(frozen=True)
class Finding:
    """A train that is unlike the others of its kind, or unlike itself before.

    Attributes
    ----------
    train, kind : str
    explanation : Explanation
        What it is, how large, and what else it may be.
    since : Timestamp
        Start of the first trip that shows it.
    trip : str
        This trip.
    between : (Timestamp, Timestamp)
        When it began: not before the first, not after the second, with 95 %.
    noticed : Timestamp
        Start of the trip after which it was seen.
    trips : int
        Trips from the change to that one.
    against : {"own past", "kind"}
        What it was compared with when it was seen.
    channel : str
        That showed it first.
    p : float
        Probability that a healthy train shows as much, in that one comparison.
    until : Timestamp or None
        Start of the first trip after it had gone again; None if it has not.
    share : float
        Of the trips from then to there on which it shows.
    """

    train: str
    kind: str
    explanation: Explanation
    since: pd.Timestamp
    trip: str
    between: tuple[pd.Timestamp, pd.Timestamp]
    noticed: pd.Timestamp
    trips: int
    against: str
    channel: str
    p: float
    until: pd.Timestamp | None = None
    share: float = 1.0

    @property
    def what(self) -> str:
        """The fault's name."""
        return self.explanation.what

    def lasts(self, start: pd.Series) -> BoolArray:
        """Which trips, by their starts, are from its first to its last one, (n,)."""
        return np.asarray((start >= self.since) & (self.until is None or start < self.until))

    def __str__(self) -> str:
        since = f"since {self.since:%Y-%m-%d %H:%M} (trip {self.trip})"
        if self.against == "kind":
            since = "since its first trip, against its kind"
        if self.until is not None:
            since += f" until {self.until:%Y-%m-%d %H:%M}"
        if self.share < 1.0:
            since += f", on {100.0 * self.share:.0f} % of its trips"
        return f"{self.train}: {self.explanation}, {since}; seen within {self.trips} trips"


@dataclass(frozen=True)
class Limit:
    """What would not be seen on a train.

    Attributes
    ----------
    train, channel : str
    unit : str
    change : float
        Smallest change that is seen within five trips, nine times in ten; NaN where none is.
    constant : float
        Smallest difference from the kind, from the first trip on, that is seen; NaN where none is.
    reason : str
        Why none is seen.
    """

    train: str
    channel: str
    unit: str
    change: float
    constant: float
    reason: str = ""


@dataclass(frozen=True)
class Step:
    """A step that a train's trips show, but for which no finding accounts.

    Attributes
    ----------
    train, channel, unit : str
    size : float
    deviations : float
        Size over the deviations of the trips before and after.
    since : Timestamp
        Start of the first trip after it.
    trips : int
        After it.
    """

    train: str
    channel: str
    unit: str
    size: float
    deviations: float
    since: pd.Timestamp
    trips: int

    def __str__(self) -> str:
        factor, unit = CHANNEL_UNITS[self.unit]
        return (
            f"{self.channel}: step of {factor * self.size:+.2g} {unit}, {self.deviations:.0f} times"
            " the trips' own deviation; no finding"
        )


@dataclass(frozen=True, eq=False)
class UnlikeTrains:
    """What was looked for among trains, and found.

    Attributes
    ----------
    findings : tuple of Finding
        By train and time.
    limits : tuple of Limit
        Of each train and channel.
    rate : float
        Stated probability of an alarm on a healthy train within a month, at most.
    train_months : float
        Months of trains that were looked at.
    steps : tuple of Step
        That are seen in the trips without any comparison, and are no finding.
    """

    findings: tuple[Finding, ...]
    limits: tuple[Limit, ...]
    rate: float
    train_months: float
    series: dict[str, dict[str, Series]] = field(default_factory=dict)
    steps: tuple[Step, ...] = ()


@dataclass(frozen=True, eq=False)
class _Watched:
    """A channel of one train: its trips in order, and what they are compared with."""

    series: Series
    place: IntArray
    own: FloatArray
    std: FloatArray
    days: FloatArray

    def of(self, rows: BoolArray | slice) -> _Watched:
        """Some of the trips."""
        return _Watched(
            self.series, self.place[rows], self.own[rows], self.std[rows], self.days[rows]
        )

    def between(self, first: int, end: int) -> _Watched:
        """The trips from one on, before another."""
        return self.of((self.place >= first) & (self.place < end))


Alarm = tuple[int, float, str]
"""The trip that raised it, the probability that a healthy train does, and the channel."""


def unlike_trains(
    kinds: Iterable[tuple[KindResistance, pd.DataFrame]], rate: float = FALSE_ALARMS
) -> UnlikeTrains:
    """Trains that are not like the others of their kind, or like themselves before.

    Parameters
    ----------
    kinds : iterable of (KindResistance, DataFrame)
        Each kind, and its trips: summaries joined with passports in order of start.
    rate : float
        Probability of an alarm on a healthy train within a month, at most.
    """
    findings: list[Finding] = []
    limits: list[Limit] = []
    steps: list[Step] = []
    every: dict[str, dict[str, Series]] = {}
    months = 0.0
    for kind, trips in kinds:
        table = channel_table(kind, trips)
        found = {
            channel.name: series
            for channel in CHANNELS
            if (series := series_of(channel, table[channel.name], trips)) is not None
        }
        every[kind.kind] = found
        shown = {name: int(np.isfinite(value).sum()) for name, (value, _) in table.items()}
        for train, rows in trips.groupby("train", sort=True):
            months += months_of(rows["start"])
            watch = _Watch(str(train), kind, trips, found, rate)
            mine = watch.findings()
            findings += mine
            steps += watch.steps(mine)
            limits += watch.limits(shown)
    return UnlikeTrains(tuple(findings), tuple(limits), rate, months, every, tuple(steps))


def months_of(start: pd.Series) -> float:
    """Months that the trips of a train span; a day at least."""
    return max(float((start.max() - start.min()) / MONTH), 1.0 / 30.0)


class _Watch:
    """One train, all its channels."""

    def __init__(
        self,
        train: str,
        kind: KindResistance,
        trips: pd.DataFrame,
        series: dict[str, Series],
        rate: float,
    ) -> None:
        self.train, self.kind, self.trips, self.series = train, kind, trips, series
        self.mine = trips["train"].to_numpy(str) == train
        day = pd.Timedelta(days=1)
        self.days = ((trips["start"] - trips["start"].min()) / day).to_numpy(np.float64)
        self.watched: dict[str, _Watched] = {}
        for name, each in series.items():
            has = self.mine[each.rows]
            place = each.rows[has]
            self.watched[name] = _Watched(
                each, place, each.own[has], each.std[has], self.days[place]
            )
        own = self.days[self.mine]
        span = max(float(own[-1] - own[0]), 1.0) if own.size else 1.0
        # Comparisons in a month: each window at each trip, in each channel, upwards and downwards.
        a_month = max(own.size * 30.0 / max(span, 30.0), 1.0)
        tests = 2.0 * len(CHANNELS) * (len(WINDOWS) * a_month + 1.0)
        self.level = 0.5 * rate / tests
        self.once = 0.5 * rate / (2.0 * len(CHANNELS))

    def findings(self) -> list[Finding]:
        """What was found, in order of time."""
        places = np.flatnonzero(self.mine)
        start, end = -1, int(places[-1]) + 1
        changes: list[tuple[Alarm, tuple[int, int, int]]] = []
        while alarm := self._alarm(_changes, self.level, start, end):
            changes.append((alarm, self._came(alarm, start)))
            start = changes[-1][1][1]
        borders = [-1, *(came[1] for _, came in changes), end]
        found, number = [], 0
        while number < len(changes):
            change, within, on = changes[number], (borders[number], borders[number + 2]), None
            if number + 1 < len(changes):
                on = self._comes_and_goes(change[0], borders[number:])
            number += 1
            if on is not None:
                within = within[0], end
                # Changes while it comes and goes are its own, and that by which it goes.
                gone = places[places > np.flatnonzero(on)[-1]][:FEWEST_BEFORE]
                last = int(gone[-1]) if gone.size else end
                number += sum(came <= last for came in borders[number + 1 : -1])
            found.append(self._finding(*change, within, "own past", on))
        if self.kind.compared:
            alarm = self._alarm(_against_kind, self.once, -1, borders[1], lasting=True)
            if alarm is not None:
                came = (int(places[0]),) * 3
                found.insert(0, self._finding(alarm, came, (-1, borders[1]), "kind"))
        return found

    def _comes_and_goes(self, alarm: Alarm, borders: Sequence[int]) -> BoolArray | None:
        """On which of the kind's trips a fault shows that comes and goes, (n,); None if none does.

        All that a channel shows after its first change is then at one of two levels: that before
        it, or another one. Where these are far apart the trips are sorted one by one, else by the
        stretches between changes.
        """
        seen, _, name = alarm
        one, on = self.watched[name], np.zeros(len(self.trips), dtype=np.bool_)
        before, after = one.between(*borders[:2]), one.between(borders[1], borders[-1])
        usual, _ = _level(before.of(slice(-BEFORE, None)))
        other, _ = _level(one.between(borders[1], seen + 1))
        stretch = np.searchsorted(np.array(borders[1:-1]), after.place, side="right")
        medians_of = pd.Series(after.own).groupby(stretch).transform("median").to_numpy()
        for _ in range(_STEPS):
            apart = abs(other - usual) / float(np.median(after.std))
            shown = after.own if apart > APART else medians_of
            shows = np.abs(shown - other) < np.abs(shown - usual)
            if not shows.any():
                return None
            other = float(np.median(after.own[shows]))
        if not np.any(np.abs(medians_of - usual) < np.abs(medians_of - other)):
            return None
        rest = robust_std(after.own - np.where(shows, other, usual))
        often = pd.Series(shows).groupby(stretch).transform("mean").to_numpy() > SOMETIMES
        on[after.place[shows & often]] = True
        size, noise = abs(other - usual), float(np.median(after.std))
        two = rest < max(ALIKE[0] * noise, ALIKE[1] * size)
        return on if on.any() and two and size > one.series.channel.tolerance else None

    def _alarm(
        self,
        chance_of: Callable[[_Watched], FloatArray],
        level: float,
        start: int,
        end: int,
        *,
        lasting: bool = False,
    ) -> Alarm | None:
        """The first alarm of any channel from one trip on, before another.

        A `lasting` one must stand at the last of these trips, too.
        """
        found: list[Alarm] = []
        for name, one in self.watched.items():
            if name == "power":
                continue
            part = one.between(start, end)
            chance = chance_of(part)
            alarms = np.flatnonzero(chance < level)
            if alarms.size and not (lasting and chance[-1] >= level):
                found.append((int(part.place[alarms[0]]), float(chance[alarms[0]]), name))
        return min(found, default=None)

    def _came(self, alarm: Alarm, start: int) -> tuple[int, int, int]:
        """The trips at which a change came: not before the first, likeliest, not after the last.

        With 95 %. It may have begun in trips that were compared at the alarm: in all the earlier
        ones the level may wander, which is no step.
        """
        seen, _, name = alarm
        part = self.watched[name].between(start, seen + 1).of(slice(-(BEFORE + WINDOWS[-1]), None))
        likelihood, starts = _step_likelihood(part)
        if starts.size == 0:
            return (int(part.place[0]),) * 3
        weight = np.exp(likelihood - likelihood.max())
        shares = np.cumsum(weight) / weight.sum()
        low, high = np.minimum(np.searchsorted(shares, (0.025, 0.975)), starts.size - 1)
        earliest, likeliest, latest = part.place[
            starts[[low, np.argmax(likelihood), high]]
        ].tolist()
        return earliest, likeliest, latest

    def _finding(
        self,
        alarm: Alarm,
        came: tuple[int, int, int],
        within: tuple[int, int],
        against: str,
        on: BoolArray | None = None,
    ) -> Finding:
        """What an alarm is of, by the trips from one on, before another, on which it shows."""
        (seen, p, name), (earliest, since, latest) = alarm, came
        places, start = np.flatnonzero(self.mine), self.trips["start"]
        until, share = None, 1.0
        if on is not None:
            shown = self.watched[name].place
            shown = shown[shown >= since]
            last = int(np.flatnonzero(on[shown])[-1])
            share = float(np.mean(on[shown[: last + 1]]))
            quiet = shown.size - 1 - last
            if quiet >= FEWEST_BEFORE and (1.0 - share) ** quiet < GONE:
                until = start.iloc[int(shown[last + 1])]
        shifts = [self._shift(one, since, within, against, on) for one in self.watched.values()]
        known = [each for each in shifts if each is not None]
        return Finding(
            train=self.train,
            kind=self.kind.kind,
            explanation=explained(known, self.kind, self.trips.iloc[places], name),
            since=start.iloc[since],
            trip=str(self.trips["trip"].iloc[since]),
            between=(start.iloc[earliest], start.iloc[latest]),
            noticed=start.iloc[seen],
            trips=int(np.count_nonzero((places >= since) & (places <= seen))),
            against=against,
            channel=name,
            p=p,
            until=until,
            share=1.0 if share > ALWAYS else share,
        )

    def _shift(
        self,
        one: _Watched,
        since: int,
        within: tuple[int, int],
        against: str,
        on: BoolArray | None,
    ) -> Shift | None:
        """By how much a channel moved, with its standard deviation."""
        before, after = one.between(within[0], since), one.between(since, within[1])
        after = after if on is None else after.of(on[after.place])
        channel = one.series.channel
        if after.own.size < (2 if channel.name == "power" else 1):
            return None
        value, variance = _level(after)
        if against == "kind":
            between = one.series.between**2
            return Shift(channel, value, variance + between) if one.series.common else None
        if before.own.size < FEWEST_BEFORE:
            return None
        past, past_variance = _level(before.of(slice(-BEFORE, None)))
        return Shift(channel, value - past, variance + past_variance)

    def steps(self, findings: list[Finding]) -> list[Step]:
        """Steps that the trips show and no finding explains."""
        own = self.trips["start"][self.mine]
        known = [int((own < each.since).sum()) for each in findings]
        came_and_went = any(each.share < 1.0 or each.until is not None for each in findings)
        found = []
        for name, one in self.watched.items():
            seen = None if name == "power" else raw_step(one.own, one.series.channel.tolerance)
            if seen is None:
                continue
            at, size, deviations = seen
            since = self.trips["start"].iloc[int(one.place[at])]
            place = int((own < since).sum())
            if came_and_went or any(abs(place - each) <= FEWEST_BEFORE for each in known):
                continue
            unit, after = one.series.channel.unit, one.own.size - at
            found.append(Step(self.train, name, unit, size, deviations, since, after))
        return found

    def limits(self, shown: dict[str, int]) -> list[Limit]:
        """What would not be seen on this train; `shown` are the trips of the kind by channel."""
        found = []
        for channel in CHANNELS:
            if channel.name in ("power", "effort over mass"):
                continue
            name, one = channel.name, self.watched.get(channel.name)
            if one is None or one.place.size == 0:
                reason = MISSING.get(name, "no trip shows it")
                if one is None and shown[name]:
                    trips = counted(shown[name], "trip")
                    which = " with recorded load" if name == "effort gain" else ""
                    reason = f"only {trips} of the kind{which}, fewer than {FEWEST_TRIPS}"
                found.append(Limit(self.train, name, channel.unit, np.nan, np.nan, reason))
                continue
            std = float(np.median(one.std))
            change = np.nan
            count = min(one.place.size, BEFORE)
            if one.place.size >= FEWEST_BEFORE:
                change = _least_change(one.series, std, count, self.level)
            constant = np.nan
            if one.series.common and self.kind.compared:
                spread = np.hypot(one.series.between, 1.25 * std / np.sqrt(5.0))
                quantile = float(-stdtrit(one.series.freedom, self.once))
                constant = channel.tolerance + spread * (quantile + 1.3)
            reason = "" if np.isfinite(change) else f"fewer than {FEWEST_BEFORE} trips show it"
            found.append(Limit(self.train, name, channel.unit, change, float(constant), reason))
        return found


def _level(one: _Watched) -> tuple[float, float]:
    """Level of trips by the likelihood of their Student distribution, and its variance.

    That of a few trips has wider tails than Fisher's information says: by 1.6 over tail and number,
    which holds to 5 % for three trips or more.
    """
    own, std, tail = one.own, one.std, one.series.tail
    level = float(np.median(own))
    for _ in range(_STEPS):
        weight = (tail + 1.0) / (tail + ((own - level) / std) ** 2) / std**2
        level = float(weight @ own / weight.sum())
    information = (tail + 1.0) / (tail + 3.0) * float(np.sum(std**-2.0))
    return level, (1.0 + 1.6 / (tail * own.size)) ** 2 / information


def _changes(one: _Watched) -> FloatArray:
    """Least probability over the windows that end at each trip."""
    series, own, std, days = one.series, one.own, one.std, one.days
    best = np.ones(own.size)
    if own.size < WINDOWS[0] + FEWEST_BEFORE:
        return best
    past, typical, centre = medians(own, BEFORE - 1), medians(std, BEFORE - 1), _means(days, BEFORE)
    count = np.minimum(np.arange(1.0, own.size + 1.0), BEFORE)
    for window in WINDOWS:
        if own.size < window + FEWEST_BEFORE:
            break
        now = slice(window + FEWEST_BEFORE - 1, None)
        earlier = slice(FEWEST_BEFORE - 1, own.size - window)
        size, before = medians(std, window - 1)[now], count[earlier]
        apart = np.abs(medians(own, window - 1)[now] - past[earlier]) - series.channel.tolerance
        gap = _means(days, window)[now] - centre[earlier]
        known = 0.5 * np.pi * typical[earlier] ** 2 / before
        uncertain = np.sqrt(known + series.wander * gap)
        p = _median_beyond(apart / size, uncertain / size, window, series.tail)
        few = before < NORMAL_BEFORE
        scale = typical[earlier] / size
        p[few] = _medians_apart((apart / size)[few], scale[few], before[few], window, series.tail)
        best[now] = np.minimum(best[now], p)
    return best


def _means(x: FloatArray, window: int) -> FloatArray:
    """Mean of the last values up to each, (n,): of so many, or of all that there are."""
    total = np.concatenate([np.zeros(window), np.cumsum(x)])
    return np.asarray(
        (total[window:] - total[:-window]) / np.minimum(np.arange(x.size) + 1, window)
    )


def _medians_apart(
    x: FloatArray, scale: FloatArray, before: FloatArray, window: int, tail: float
) -> FloatArray:
    """Bound of the probability that two medians are x apart.

    One of them must be beyond a share of x, or the other beyond the rest (Boole's inequality): of
    all shares the least bound. The trips of the first deviate `scale` times as much.
    """
    share = _SHARES[:, None]
    after = _half_beyond(share * x, window, tail)
    rest = _half_beyond((1.0 - share) * x / scale, before, tail)
    best = np.minimum(np.min(after + rest, axis=0), 1.0)
    return np.where(x > 0.0, best, 1.0)


def _half_beyond(x: FloatArray, count: FloatArray | float, tail: float) -> FloatArray:
    """Probability that the median of trips may be beyond x: half of them are."""
    half = np.ceil(0.5 * np.asarray(count, dtype=np.float64))
    return np.asarray(betainc(half, count - half + 1.0, beyond(x, tail)))


def _median_beyond(x: FloatArray, uncertain: FloatArray, window: int, tail: float) -> FloatArray:
    """Probability that a median of trips is beyond x, the level known to `uncertain`.

    1 where it is above a tenth: nothing is seen there.
    """
    half, found = 0.5 * (window + 1), np.ones(x.size)
    far = x * np.sqrt(window) > NEAR
    single = beyond(x[far] - _NODES[:, None] * uncertain[far], tail)
    found[far] = np.sum(_WEIGHTS[:, None] * betainc(half, half, single), axis=0)
    return found


def _against_kind(one: _Watched) -> FloatArray:
    """Probability of a level as far from the kind's, by the trips up to each."""
    series, own, std = one.series, one.own, one.std
    if own.size < WINDOWS[0] or not series.common:
        return np.ones(own.size)
    level = pd.Series(own).expanding(WINDOWS[0]).median().to_numpy()
    count = np.arange(1, own.size + 1)
    variance = 0.5 * np.pi * pd.Series(std).expanding().median().to_numpy() ** 2 / count
    spread = np.sqrt(variance + series.between**2)
    p = beyond((np.abs(level) - series.channel.tolerance) / spread, series.freedom)
    return np.where(np.isfinite(p), p, 1.0)


def _step_likelihood(one: _Watched) -> tuple[FloatArray, IntArray]:
    """Log likelihood of a step at each trip, and these trips."""
    own, std, tail = one.own, one.std, one.series.tail
    if own.size < WINDOWS[0]:
        return np.zeros(0), np.zeros(0, dtype=np.int64)
    starts = np.arange(min(WINDOWS[0], own.size - 2), own.size)
    last = min(2, own.size - 1)
    starts = starts[starts <= own.size - last]
    found = []
    for start in starts:
        before, after = np.median(own[max(start - BEFORE, 0) : start]), np.median(own[start:])
        rest = np.concatenate([own[:start] - before, own[start:] - after]) / std
        found.append(-0.5 * (tail + 1.0) * float(np.sum(np.log1p(rest**2 / tail))))
    return np.array(found), starts


def _least_change(series: Series, std: float, count: int, level: float) -> float:
    """Smallest change that is seen within five trips in nine cases of ten."""
    x = np.linspace(0.05, 60.0, 1200)

    def is_seen(place: int) -> bool:
        here, one = x[place : place + 1], np.ones(1)
        if count < NORMAL_BEFORE:
            return bool(_medians_apart(here, one, count * one, 5, series.tail)[0] < level)
        uncertain = np.sqrt(0.5 * np.pi / count) * one
        return bool(_median_beyond(here, uncertain, 5, series.tail)[0] < level)

    # The probability falls with the size of the change.
    first = bisect_left(range(x.size), True, key=is_seen)
    seen = x[first] if first < x.size else np.nan
    # The median of five trips is below its mean by this much in one case of ten.
    return float(series.channel.tolerance + std * (seen + 1.3 * np.sqrt(0.5 * np.pi / 5.0)))

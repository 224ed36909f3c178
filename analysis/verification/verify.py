"""A forecast of adhesion compared with what trips met later: the scores, with their bands.

Every figure is made of sums by day, so that a bootstrap by day needs no second pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from analysis.verification.scores import (
    CLASSES,
    LEVELS_OF_PIT,
    BrierScore,
    brier_score,
    brier_sums,
    climatology,
    crps,
    day_weights,
    observed_shares,
    onset_score,
    persistence,
    pit_sums,
    place_alone,
    used_score,
)
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.presentation import (
    ADHESION,
    NUMBER,
    PLAIN,
    SHARE,
    Column,
    Ends,
    Quantity,
    WordTable,
    new_table,
)
from trainlog.railway.condition import AdhesionEstimate, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence

Forecaster = Callable[[str, pd.Timestamp], AdhesionEstimate | None]
"""The adhesion forecast for a rail condition and a time, by bin; None: unknown everywhere."""

History = Callable[[str, int], DailyEvidence]
"""What was known of a rail condition before a day; of ``""``, of all of them together."""

FORECASTS = ("forecast", "prior", "persistence", "place")
"""That are scored on the same passages: the one under verification, and those that anyone can make:
by the rail condition alone, as last seen, and by the place alone, whatever the rail condition."""

ALARMS = np.array([0.003, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9])
"""Probabilities of slip from which on an alarm is given."""

USUAL_ALARM = 0.1
"""The one that the table shows."""

DRAWS = 500
"""Of the bootstrap by day."""

FEWEST_DAYS = 5
"""With fewer days on which the forecast is known no band is stated: so few do not show how days
differ."""

BAND = (0.025, 0.975)

_KNOWN, _UNKNOWN = 0, 1


class Alarm(NamedTuple):
    """What alarms bring that are given wherever slip is at least so probable.

    Attributes
    ----------
    probability : float
    foreseen : Ends
        Share of all slips; those where the forecast is unknown count as not foreseen.
    foreseen_known : Ends
        Share of the slips where the forecast is known.
    false_alarms : Ends
        Per train-km on which the forecast is known, and with it the probability of slip.
    """

    probability: float
    foreseen: Ends
    foreseen_known: Ends
    false_alarms: Ends


@dataclass(frozen=True, eq=False)
class Verification:
    """What became of a forecast; everything is summed by day.

    Attributes
    ----------
    name : str
    bin_length : float [m]
    days : (d,) int array
        Counted from 1970-01-01 in UTC.
    counts : (d, 2, 2) array
        Trips and bins with slip and without, where the forecast was known and where it was unknown.
    scores : (d, 4, 3) array
        By the forecasts of `FORECASTS`: sums of the log scores of onsets and of used adhesion, and
        of the CRPS of onsets; where the forecast under verification was known.
    inside : (d,) array
        Onsets within the forecast's 95 % band.
    pit : (d, 2, cells) array
        See `analysis.verification.scores.pit_sums`.
    brier : (d, 4, 4, classes) array
        By these forecasts; see `analysis.verification.scores.brier_sums`.
    alarms : (d, 2, t) array
        Slips foreseen and false alarms by the thresholds `ALARMS`.
    slips : (d,) array
        That an alarm could have been given for, known or unknown; the others have no demand of
        other days.
    no_demand : (d,) array
        Passages of bins in which no trip of another day shows how much is asked for.
    """

    name: str
    bin_length: float
    days: IntArray
    counts: FloatArray
    scores: FloatArray
    inside: FloatArray
    pit: FloatArray
    brier: FloatArray
    alarms: FloatArray
    slips: FloatArray
    no_demand: FloatArray

    @staticmethod
    def together(several: Mapping[str, Verification]) -> Verification:
        """Rail conditions together, added up by day."""
        every = list(several.values())
        days = np.unique(np.concatenate([each.days for each in every]))

        def total(arrays: list[FloatArray]) -> FloatArray:
            found = np.zeros((days.size, *arrays[0].shape[1:]))
            for each, values in zip(every, arrays, strict=True):
                found[np.searchsorted(days, each.days)] += values
            return found

        sums = {key: total([getattr(each, key) for each in every]) for key in SIZES}
        return Verification(every[0].name, every[0].bin_length, days, **sums)

    @cached_property
    def _weights(self) -> FloatArray:
        """How often each day counts: once in the first row, as drawn in the others."""
        once = np.ones((1, self.days.size))
        if self.known_days < FEWEST_DAYS:
            return once
        return np.concatenate((once, day_weights(self.days.size, DRAWS)))

    def _sum(self, by_day: FloatArray) -> FloatArray:
        return np.asarray(np.tensordot(self._weights, by_day, axes=1))

    def _figure(self, drawn: FloatArray) -> Ends:
        value = float(drawn[0])
        others = drawn[1:][np.isfinite(drawn[1:])]
        if others.size < 0.9 * DRAWS or not np.isfinite(value):
            return Ends(value)
        low, high = np.quantile(others, BAND)
        return Ends(value, float(low), float(high))

    @property
    def onsets(self) -> int:
        """Measured where the forecast was known."""
        return int(self.counts[:, _KNOWN, 0].sum())

    @property
    def used(self) -> int:
        """Passages without slip where the forecast was known."""
        return int(self.counts[:, _KNOWN, 1].sum())

    @property
    def unknown_onsets(self) -> int:
        """Measured where the forecast was unknown."""
        return int(self.counts[:, _UNKNOWN, 0].sum())

    @property
    def unknown_used(self) -> int:
        """Passages without slip where the forecast was unknown."""
        return int(self.counts[:, _UNKNOWN, 1].sum())

    @property
    def known_days(self) -> int:
        """Days with a passage where the forecast was known."""
        return int(np.count_nonzero(self.counts[:, _KNOWN].sum(axis=1)))

    @property
    def train_km(self) -> float:
        """Run with adhesion in use."""
        return float(self.counts.sum()) * self.bin_length / 1e3

    @property
    def known_train_km(self) -> float:
        """Of these, where the forecast was known."""
        return float(self.counts[:, _KNOWN].sum()) * self.bin_length / 1e3

    @property
    def alarm_train_km(self) -> float:
        """Of these, where the probability of slip was scored: an alarm could have been given."""
        return float(self.brier[:, 0, 0].sum()) * self.bin_length / 1e3

    def log_score(self, what: str = "onsets", over: str | None = None) -> Ends:
        """Mean log score [nat]: of onsets, of used adhesion, or of all; or its gain over another.

        Parameters
        ----------
        what : {"onsets", "used", "all"}
        over : {"prior", "persistence", "place"}, optional
        """
        columns = {"onsets": (0,), "used": (1,), "all": (0, 1)}[what]
        one = self.scores[:, 0]
        if over is not None:
            one = one - self.scores[:, FORECASTS.index(over)]
        total = self._sum(sum(one[:, each] for each in columns))  # type: ignore[arg-type]
        return self._figure(_ratio(total, self._sum(_columns(self.counts[:, _KNOWN], columns))))

    def crps(self, name: str = "forecast") -> Ends:
        """Mean CRPS of the onsets, in log adhesion."""
        found = self.scores[:, FORECASTS.index(name), 2]
        return self._figure(_ratio(self._sum(found), self._sum(self.counts[:, _KNOWN, 0])))

    @property
    def onsets_in_band(self) -> Ends:
        """Share of measured onsets in the 95 % band of their forecasts."""
        return self._figure(_ratio(self._sum(self.inside), self._sum(self.counts[:, _KNOWN, 0])))

    @property
    def coverage(self) -> Ends:
        """Share of maxima in the 95 % band: that of onsets, allowing for trips that asked for less.

        NaN where no trip asked for enough to know the upper end.
        """
        low, high = (self._reached(each) for each in BAND)
        return self._figure(high - low)

    def _reached(self, quantile: float) -> FloatArray:
        share, _ = observed_shares(self._sum(self.pit))
        return np.array([np.interp(quantile, LEVELS_OF_PIT, row) for row in share])

    def reliability(
        self, quantiles: Sequence[float] = (0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975)
    ) -> list[tuple[float, Ends, int]]:
        """Of each quantile forecast: share of maxima below, and trips that asked for as much."""
        _, trips = observed_shares(self.pit.sum(axis=0))
        return [
            (each, self._figure(self._reached(each)), round(np.interp(each, LEVELS_OF_PIT, trips)))
            for each in quantiles
        ]

    def brier_score(self, name: str = "forecast") -> BrierScore:
        """Of the probability of slip; arrays: all days first, then the draws of the bootstrap."""
        return brier_score(self._sum(self.brier[:, FORECASTS.index(name)]))

    def brier_figure(self, part: str, name: str = "forecast") -> Ends:
        """One part of `brier_score`, or ``"skill"``."""
        return self._figure(np.asarray(getattr(self.brier_score(name), part)))

    def brier_gain(self, over: str) -> Ends:
        """Skill of the Brier score over another forecast's: 1 at best, 0: no better."""
        own, other = self.brier_score().score, self.brier_score(over).score
        return self._figure(1.0 - _ratio(own, other))

    def classes(self) -> list[tuple[float, float, float, float]]:
        """Of each class of slip forecasts: mean forecast, share that slipped, trips and slips."""
        trips, events, forecast, _ = self.brier[:, 0].sum(axis=0)
        return [
            (f / n, e / n, n, e) for n, e, f in zip(trips, events, forecast, strict=True) if n > 0
        ]

    def alarm_curve(self) -> list[Alarm]:
        """Slips foreseen and false alarms by the threshold of alarms; NaN where not known."""
        found, slips = self._sum(self.alarms), self._sum(self.slips)
        passages, known_slips = (self._sum(self.brier[:, 0, row].sum(axis=-1)) for row in (0, 1))
        km = passages * self.bin_length / 1e3
        return [
            Alarm(
                float(level),
                self._figure(_ratio(found[:, 0, i], slips)),
                self._figure(_ratio(found[:, 0, i], known_slips)),
                self._figure(_ratio(found[:, 1, i], km)),
            )
            for i, level in enumerate(ALARMS)
        ]

    def alarm(self, level: float = USUAL_ALARM) -> Alarm:
        """Slips foreseen and false alarms at one of the thresholds."""
        return next(each for each in self.alarm_curve() if each.probability == level)

    def details(self) -> dict[str, Any]:
        """All figures, as JSON has them, by the keys of `FIGURES`."""
        return {key: value for each in FIGURES for key, value in each.data(each.cell(self)).items()}

    def tables(self) -> list[WordTable]:
        """Reliability, alarms by their threshold, and slips by the classes of their forecasts."""
        below = "Reliability: share of maxima below a quantile of their forecast"
        least = "Alarm where the probability of slip is at least"
        return [
            new_table(below, *RELIABILITY, name="reliability").add_rows(self.reliability()),
            new_table(least, *ALARM, name="alarms").add_rows(self.alarm_curve()),
            new_table(
                "Slips by class of forecast", *SLIP_CLASSES, name="slip_classes", usual=False
            ).add_rows(self.classes()),
        ]


def _for_each(
    names: Iterable[str],
    heading: str,
    quantity: Quantity,
    key: str,
    figure: Callable[[Verification, str], Ends],
) -> Iterator[Column]:
    """A column for each of some names, of a figure that takes it."""
    for name in names:
        of = partial(_figure_of, figure, name)
        yield Column(heading.format(name), quantity, key.format(name), of=of)


def _figure_of(figure: Callable[[Verification, str], Ends], name: str, found: Verification) -> Ends:
    return figure(found, name)


def _log_scores(what: str) -> Iterator[Column]:
    key = f"log_score_{what}"
    yield from _for_each([what], "log score, {}", NAT, "log_score_{}", Verification.log_score)
    yield from _for_each(
        FORECASTS[1:],
        "  gain over {}",
        NAT,
        f"{key}_gain_over_{{}}",
        lambda found, over: found.log_score(what, over),
    )


NAT = Quantity("", "nat", 1.0, 3)
FINE = Quantity("", "", 1.0, 4)

ALARM = (
    Column("probability", ADHESION),
    Column("slips foreseen", SHARE, "foreseen"),
    Column("  of those where known", SHARE, "foreseen_known"),
    Column("false alarms per known train-km", ADHESION, "false_alarms"),
)

FIGURES = (
    Column("days", NUMBER, of=lambda v: v.days.size),
    Column("  on which the forecast is known", NUMBER, "days_known", of="known_days"),
    Column("train-km", NUMBER, "train_km"),
    Column("  where the forecast is known", PLAIN, "train_km_known", of="known_train_km"),
    Column("  where alarms are possible", PLAIN, "train_km_of_alarms", of="alarm_train_km"),
    Column("onsets of slip scored", NUMBER, "onsets"),
    Column("  where the forecast is unknown", NUMBER, "unknown_onsets"),
    Column("passages without slip scored", NUMBER, "used"),
    Column("  where the forecast is unknown", NUMBER, "unknown_used"),
    Column("  whose demand is unknown", NUMBER, "no_demand", of=lambda v: int(v.no_demand.sum())),
    *_log_scores("onsets"),
    *_log_scores("used"),
    *_log_scores("all"),
    *_for_each(FORECASTS, "CRPS of {}, log adhesion", ADHESION, "crps_{}", Verification.crps),
    Column("maxima in the 95 % band", SHARE, "maxima_in_band", of="coverage"),
    Column("measured onsets in it", SHARE, "onsets_in_band"),
    *_for_each(
        ("score", "reliability", "resolution", "uncertainty", "within", "skill"),
        "Brier score: {}",
        FINE,
        "brier_{}",
        Verification.brier_figure,
    ),
    *_for_each(
        FORECASTS[1:], "  skill over {}", FINE, "brier_skill_over_{}", Verification.brier_gain
    ),
    *(
        replace(
            each,
            of=partial(_figure_of, lambda found, name: getattr(found.alarm(), name), each.name),
        )
        for each in ALARM[1:]
    ),
)
"""Of a forecast: what is stated in tables and in JSON."""

RELIABILITY = (
    Column("quantile", SHARE, of=lambda row: row[0]),
    Column("observed", SHARE, of=lambda row: row[1]),
    Column("trips", NUMBER, of=lambda row: row[2]),
)
SLIP_CLASSES = (
    Column("forecast", SHARE, of=lambda row: row[0]),
    Column("observed", SHARE, of=lambda row: row[1]),
    Column("passages", NUMBER, of=lambda row: row[2]),
    Column("slips", NUMBER, of=lambda row: row[3]),
)


def _columns(values: FloatArray, columns: Iterable[int]) -> FloatArray:
    return np.asarray(values[:, list(columns)].sum(axis=1))


def _ratio(above: FloatArray, below: FloatArray) -> FloatArray:
    safe = np.where(below > 0.0, below, 1.0)
    return np.asarray(np.where(below > 0.0, above / safe, np.nan))


def verify(
    name: str,
    track: TrackConditionMap,
    passages: Iterable[Passages],
    forecaster: Forecaster,
    history: History,
    demand: Demand,
) -> dict[str, Verification]:
    """Score a forecast, beside those that anyone can make, on what trips met, by rail condition.

    Parameters
    ----------
    name : str
        Of the forecast.
    track : TrackConditionMap
        Whose bins, levels and settings are used; it may be empty.
    passages : iterable of Passages
        Not of a day that the forecast knows.
    forecaster : callable
    history : callable
        What persistence and the place alone know.
    demand : Demand

    Raises
    ------
    InputError
        If there are no passages.

    Examples
    --------
    The prior gains nothing over itself:

    >>> from analysis.verification.verify import passages_of
    >>> from trainlog.formats.mapfile import read_map
    >>> track = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> known = track.layer("wet").evidence
    >>> days = list(passages_of("wet", known))
    >>> found = verify(
    ...     "prior", track, days, lambda layer, time: climatology(track, layer),
    ...     lambda layer, day: known.between(-1, day - 1), Demand([known], track.levels),
    ... )
    >>> found["wet"].log_score("onsets", over="prior").value
    0.0
    """
    every = sorted(passages, key=lambda each: (each.day, each.time, each.layer))
    if not every:
        raise InputError(
            f"{name}: no trip to compare it with", remedy="give trips of days that it does not know"
        )
    sums: dict[str, dict[int, Sums]] = {}
    references = _References(track, history)
    asked = asked_adhesion(track.levels)
    for each in every:
        forecast = forecaster(each.layer, each.time)
        if forecast is None:
            forecast = _unknown(track.bins)
        several = {"forecast": forecast, **references(each.layer, each.day)}
        none = {key: np.zeros(shape) for key, shape in SIZES.items()}
        into = sums.setdefault(each.layer, {}).setdefault(each.day, none)
        _add_scores(into, each, several, track.levels, asked)
        _add_slips(into, each, several, demand, asked)
    return {
        layer: Verification(
            name,
            track.bin_length,
            np.array(list(days), dtype=np.int64),
            **{key: np.array([each[key] for each in days.values()]) for key in SIZES},
        )
        for layer, days in sums.items()
    }


class _References:
    """Climatology and persistence, made once a layer and day."""

    def __init__(self, track: TrackConditionMap, history: History) -> None:
        self._track, self._history = track, history
        self._made: dict[tuple[str, int], dict[str, AdhesionEstimate]] = {}

    def __call__(self, layer: str, day: int) -> dict[str, AdhesionEstimate]:
        if (layer, day) not in self._made:
            known = self._history(layer, day)
            self._made = {
                (layer, day): {
                    "prior": climatology(self._track, layer),
                    "persistence": persistence(self._track, layer, known),
                    "place": place_alone(self._track, layer, self._history("", day)),
                }
            }
        return self._made[layer, day]


def _unknown(bins: int) -> AdhesionEstimate:
    return AdhesionEstimate(np.zeros(bins), np.ones(bins), np.zeros(bins, dtype=np.bool_))


Sums = dict[str, FloatArray]
"""What a `Verification` is made of, of one day."""

SIZES: dict[str, tuple[int, ...]] = {
    "counts": (2, 2),
    "scores": (len(FORECASTS), 3),
    "inside": (),
    "pit": (2, LEVELS_OF_PIT.size - 1),
    "brier": (len(FORECASTS), 4, CLASSES.size - 1),
    "alarms": (2, ALARMS.size),
    "slips": (),
    "no_demand": (),
}


def _add_scores(
    into: Sums,
    met: Passages,
    several: Mapping[str, AdhesionEstimate],
    levels: FloatArray,
    asked: FloatArray,
) -> None:
    """Score onsets and used adhesion where the forecast was known; count where it was not."""
    forecast = several["forecast"]
    measured, bore = forecast.observed[met.onset_bin], forecast.observed[met.used_bin]
    for row, (slip, used) in enumerate(((measured, bore), (~measured, ~bore))):
        into["counts"][row] += (np.count_nonzero(slip), met.used_trips[used].sum())
    place, value = met.onset_bin[measured], met.onset_adhesion[measured]
    rows, level, trips = met.used_bin[bore], met.used_level[bore], met.used_trips[bore]
    for number, name in enumerate(FORECASTS):
        here, there = several[name].at_bins(place), several[name].at_bins(rows)
        into["scores"][number] += (
            onset_score(here, value).sum(),
            (trips * used_score(there, levels[level])).sum(),
            crps(here, value).sum(),
        )
    below = forecast.at_bins(place).below(value)
    into["inside"] += np.count_nonzero((below >= BAND[0]) & (below <= BAND[1]))
    into["pit"] += pit_sums(below, np.ones(place.size), True)
    into["pit"] += pit_sums(forecast.at_bins(rows).below(asked[level]), trips, False)


def _add_slips(
    into: Sums,
    met: Passages,
    several: Mapping[str, AdhesionEstimate],
    demand: Demand,
    asked: FloatArray,
) -> None:
    """Score the probability of slip, given what trips of other days asked for."""
    bins, trips, slipped = met.by_bin()
    shares = demand.without(met.day, bins)
    usual = np.isfinite(shares[:, 0])
    into["no_demand"] += trips[~usual].sum()
    into["slips"] += slipped[usual].sum()
    known = usual & several["forecast"].observed[bins]
    bins, trips, slipped, shares = bins[known], trips[known], slipped[known], shares[known]
    for number, name in enumerate(FORECASTS):
        chance = slip_probability(several[name].at_bins(bins), shares, asked)
        into["brier"][number] += brier_sums(chance, trips, slipped)
        if name == "forecast":
            alarmed = chance[:, None] >= ALARMS
            into["alarms"][0] += slipped @ alarmed
            into["alarms"][1] += (trips - slipped) @ alarmed


def slip_probability(
    estimate: AdhesionEstimate, shares: FloatArray, asked: FloatArray
) -> FloatArray:
    """Probability that a trip asks for more than the maximum; (n,) array.

    Parameters
    ----------
    estimate : AdhesionEstimate
        Of n bins.
    shares : (n, k) array
        Of the levels asked for in each bin; rows sum up to 1.
    asked : (k,) array
        Adhesion of each level.

    Examples
    --------
    >>> bad = AdhesionEstimate(np.log([0.1]), np.array([1e-9]), np.array([True]))
    >>> slip_probability(bad, np.array([[0.75, 0.25]]), np.array([0.08, 0.12])).tolist()
    [0.25]
    """
    below = estimate.below(np.asarray(asked)[:, None]).T
    return np.asarray(np.clip((shares * below).sum(axis=1), 0.0, 1.0))


# --------------------------------------------------------------------------------------- passages


NOON = pd.Timedelta(hours=12)


@dataclass(frozen=True, eq=False)
class Passages:
    """What the trips of one day, or one trip, met in one rail condition.

    Attributes
    ----------
    layer : str
        Rail condition.
    time : Timestamp
        For which a forecast is asked; UTC.
    day : int
        Counted from 1970-01-01 in UTC.
    onset_bin : (m,) int array
        One row a trip and bin in which its slip measured the maximum.
    onset_adhesion : (m,) array
    used_bin, used_level : (k,) int array
        One row a bin and level that was used without slip.
    used_trips : (k,) array
    """

    layer: str
    time: pd.Timestamp
    day: int
    onset_bin: IntArray
    onset_adhesion: FloatArray
    used_bin: IntArray
    used_level: IntArray
    used_trips: FloatArray

    def by_bin(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Bins that were passed, how many trips did, and how many of them slipped; (n,) arrays."""
        bins = np.union1d(self.onset_bin, self.used_bin).astype(np.int64)
        if bins.size == 0:
            return bins, np.zeros(0), np.zeros(0)
        place, other = np.searchsorted(bins, self.onset_bin), np.searchsorted(bins, self.used_bin)
        slipped = np.bincount(place, minlength=bins.size).astype(np.float64)
        used = np.bincount(other, self.used_trips, minlength=bins.size).astype(np.float64)
        return bins, slipped + used, slipped


def passages_of(
    layer: str, evidence: DailyEvidence, time: pd.Timestamp | None = None
) -> Iterator[Passages]:
    """What the evidence of a layer shows, a day at a time.

    Evidence holds sums over the trips of a day, from which the maxima that one or two trips
    measured in a bin follow exactly; of more trips they are taken as evenly spread as those of a
    normal distribution, with the same mean and variance.

    Parameters
    ----------
    layer : str
    evidence : DailyEvidence
    time : Timestamp, optional
        For which a forecast is asked; default: noon of each day.

    Examples
    --------
    >>> weight = np.array([0.0, 64.0])
    >>> shown = DailyEvidence.of_bins(
    ...     20_000, weight > 0, weight, weight * np.log(0.1), np.zeros((2, 3))
    ... )
    >>> (day,) = passages_of("wet", shown)
    >>> day.onset_bin.tolist(), day.onset_adhesion.round(6).tolist()
    ([1], [0.1])
    """
    for day in evidence.days.tolist():
        own, used = evidence.day == day, evidence.used_day == day
        measured = own & (evidence.weight > 0.0)
        bins, adhesion = _measured(evidence, measured)
        yield Passages(
            layer,
            time_of(day) if time is None else time,
            int(day),
            bins,
            adhesion,
            evidence.used_bin[used],
            evidence.used_level[used],
            evidence.used_trips[used],
        )


def time_of(day: int) -> pd.Timestamp:
    """Noon of a day counted from 1970-01-01 in UTC."""
    return pd.Timestamp(int(day), unit="D", tz="UTC") + NOON


def _measured(evidence: DailyEvidence, rows: BoolArray) -> tuple[IntArray, FloatArray]:
    """Bin and maximum of each trip's onsets, from the sums over trips."""
    weight = evidence.weight[rows]
    mean = evidence.weighted_log[rows] / weight
    variance = np.maximum(evidence.weighted_square[rows] / weight - mean**2, 0.0)
    trips = np.maximum(np.round(evidence.trips[rows]), 1.0).astype(np.int64)
    bins, logs = [], []
    for count in np.unique(trips).tolist():
        some = trips == count
        spread = _spread(count)
        values = mean[some, None] + np.sqrt(variance[some, None]) * spread
        bins.append(np.repeat(evidence.bin[rows][some], count))
        logs.append(values.ravel())
    if not bins:
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    return np.concatenate(bins), np.exp(np.concatenate(logs))


def _spread(count: int) -> FloatArray:
    """So many values of zero mean and unit variance, placed as those of a normal distribution."""
    from scipy.special import ndtri

    if count == 1:
        return np.zeros(1)
    values = ndtri((np.arange(count) + 0.5) / count)
    return np.asarray(values / np.sqrt(np.mean(values**2)), dtype=np.float64)


def asked_adhesion(levels: FloatArray) -> FloatArray:
    """What a trip asked for whose use fell to each level: the middle to the next; (k,) array."""
    ratio = levels[-1] / levels[-2] if levels.size > 1 else 1.0
    return np.asarray(levels * np.sqrt(np.append(levels[1:] / levels[:-1], ratio)))


class Demand:
    """The adhesion that trips ask for in each bin, from all days but the one that is scored.

    A trip that does not slip shows its demand; one that slips shows that it asked for more than the
    maximum that it met. Its part is spread over the levels above as the demand of the whole line is
    (product-limit estimate of Kaplan and Meier, 1958; redistribution to the right, Efron, 1967).
    Rail conditions are taken together, and a day's own trips never count for it, so that whether
    they slipped cannot be seen from it.

    Parameters
    ----------
    evidence : iterable of DailyEvidence
        Everything that is known, before and after: the demand is not what is forecast.
    levels : (k,) array
    """

    def __init__(self, evidence: Iterable[DailyEvidence], levels: FloatArray) -> None:
        self.levels = levels
        every = list(evidence)
        self._bins = every[0].bins if every else 0
        rows = [np.concatenate(columns) for columns in zip(*map(self._rows, every), strict=True)]
        if not rows:
            rows = [np.zeros(0)] * 5
        self._day, self._bin, self._level = (each.astype(np.int64) for each in rows[:3])
        self._used, self._slipped = (each.astype(np.float64) for each in rows[3:])

    def _rows(self, known: DailyEvidence) -> tuple[FloatArray | IntArray, ...]:
        measured = known.weight > 0.0
        bins, adhesion = _measured(known, measured)
        trips = np.maximum(np.round(known.trips[measured]), 1.0).astype(np.int64)
        # In the order of `_measured`: by number of trips.
        order = np.argsort(trips, kind="stable")
        days = np.repeat(known.day[measured][order], trips[order])
        level = np.clip(
            np.searchsorted(self.levels, adhesion, side="right") - 1, 0, self.levels.size - 1
        )
        nothing, one = np.zeros(known.used_bin.size), np.ones(bins.size)
        return (
            np.concatenate((days, known.used_day)),
            np.concatenate((bins, known.used_bin)),
            np.concatenate((level, known.used_level)),
            np.concatenate((np.zeros(bins.size), known.used_trips)),
            np.concatenate((one, nothing)),
        )

    def without(self, day: int, bins: IntArray) -> FloatArray:
        """Shares of the levels asked for in some bins on all other days; (n, k) array.

        Rows of NaN: no trip passed there on another day.

        Parameters
        ----------
        day : int
        bins : (n,) int array
        """
        other = self._day != day
        k = self.levels.size
        place = (self._bin * k + self._level)[other]
        size = self._bins * k
        used = np.bincount(place, self._used[other], minlength=size).reshape(-1, k)
        slipped = np.bincount(place, self._slipped[other], minlength=size).reshape(-1, k)
        beyond = _beyond(used.sum(axis=0), slipped.sum(axis=0))
        found = used[bins] + slipped[bins] @ beyond
        total = found.sum(axis=1, keepdims=True)
        return np.asarray(np.where(total > 0.0, found / np.where(total > 0.0, total, 1.0), np.nan))


def _beyond(used: FloatArray, slipped: FloatArray) -> FloatArray:
    """How the demand of a trip that slipped at each level spreads over the levels; (k, k)."""
    k = used.size
    exposed = np.cumsum((used + slipped)[::-1])[::-1]
    kept = 1.0 - used / np.where(exposed > 0.0, exposed, 1.0)
    share = np.cumprod(np.append(1.0, kept[:-1])) * (1.0 - kept)
    above = np.triu(np.ones((k, k)), 1) * share
    total = above.sum(axis=1, keepdims=True)
    # Above the highest level that anyone used without slip: the next one.
    highest = np.eye(k, k, 1)
    highest[-1, -1] = 1.0
    return np.where(total > 0.0, above / np.where(total > 0.0, total, 1.0), highest)

"""What changed between two dates or two maps, bin by bin; and one place over time.

Of one place: the evidence of each day, and the estimates that followed from it.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from scipy.special import ndtr, ndtri

from analysis.adhesion.condition_table import (
    ADHESIONS,
    LAYER,
    MAY_BE_CHANGE,
    NEAR,
    SPAN,
    changes_table,
    dates,
    day_name,
    kilometres,
    met_words,
    probability_words,
    shown,
    spots_table,
    with_ends,
)
from trainlog.arrays import FloatArray, IntArray
from trainlog.condition import estimated, layer_before
from trainlog.display import counted, few
from trainlog.errors import InputError
from trainlog.presentation import (
    ADHESION,
    NUMBER,
    SHARE,
    Cell,
    Column,
    Ends,
    Presented,
    Said,
    WordTable,
    frame_table,
    new_table,
)
from trainlog.railway.condition import ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence
from trainlog.railway.line import Line, near

RATE = 0.05
"""Share of the bins called changed that may be so by chance (false discovery rate)."""

LEAST = 0.01
"""Difference of maximum adhesion whose probability is stated."""

GAP = 2
"""Bins without a significant change between two of one section, at most."""

POWER = 0.8
"""Probability with which a change of the detectable ratio is found."""

LISTED = 5
"""Trips under different rail conditions that are listed by name."""

_EVER = int(np.iinfo(np.int32).max)
_SUMS = ("trips", "events", "weight", "weighted_log", "weighted_square", "common", "used_trips")


@dataclass(frozen=True, eq=False, repr=False)
class MapDifference(Presented):
    """How the lasting maximum adhesion differs between two bodies of evidence.

    Attributes
    ----------
    line, before, after : str
        The line, and what is compared, in words.
    bins : DataFrame
        A row a layer and bin observed in both: the two estimates with their 95 % bands,
        ``difference``, ``probability`` (that it is larger than `least`, whichever its sign),
        ``q_value``, whether it is ``significant``, and the ``detectable_ratio``: by which factor
        a bin must change alone, up or down, to be found with a probability of 80 %.
    sections : DataFrame
        Neighbouring significant bins of one sign together.
    newly_observed : dict of str to int
        Bins by layer that only the second observed.
    rate : float
        False discovery rate up to which a bin is significant.
    least : float
    notes : tuple of str
        What the comparison leaves out, in sentences.
    """

    charts_by: ClassVar[str] = "analysis.adhesion.map_plot:difference_charts"

    line: str
    before: str
    after: str
    bins: pd.DataFrame
    sections: pd.DataFrame
    newly_observed: dict[str, int]
    rate: float
    least: float
    notes: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Line, and what is compared."""
        return f"{self.line}: {self.before}, and {self.after}"

    def summary(self) -> dict[str, str]:
        """The outcome."""
        return {"outcome": self.sentence}

    @property
    def changed(self) -> bool:
        """Whether any bin differs significantly."""
        return not self.sections.empty

    @property
    def sentence(self) -> str:
        """The outcome in one sentence."""
        by_layer = self.detectable
        each = ", ".join(f"{name} {bins}" for name, (bins, _) in by_layer.items())
        tested = counted(len(self.bins), "bin")
        if self.bins.empty:
            return "Nothing was compared: no bin was observed by both."
        if not self.changed:
            ratios = ", ".join(f"{ratio:.2f} ({name})" for name, (_, ratio) in by_layer.items())
            return (
                f"No significant change in {tested} that both observed ({each}). A change of one"
                f" bin, up or down, is found with {POWER:.0%} probability from the factor {ratios}"
                " on, in the middle one of these bins; smaller ones may have gone unseen."
            )
        several = counted(len(self.sections), "section")
        count = int(self.bins["significant"].sum())
        return (
            f"{several} changed: {count} of {tested} that both observed ({each}); of these at most"
            f" {self.rate:.0%} by chance."
        )

    @property
    def detectable(self) -> dict[str, tuple[int, float]]:
        """By layer the number of bins compared, and the median of their detectable ratios."""
        return {
            str(name): (len(rows), float(rows["detectable_ratio"].median()))
            for name, rows in self.bins.groupby("layer", sort=False)
        }

    def facts(self) -> dict[str, Any]:
        """What was compared, and how well a change would have been found."""
        return {
            "line": self.line,
            "before": self.before,
            "after": self.after,
            "changed": self.changed,
            "false_discovery_rate": self.rate,
            "least": self.least,
            "tested_bins": len(self.bins),
            "layers": {
                name: {"bins": bins, "detectable_ratio": ratio}
                for name, (bins, ratio) in self.detectable.items()
            },
            "newly_observed_bins": self.newly_observed,
        }

    def tables(self) -> list[WordTable]:
        """What changed, section by section, the largest difference first."""
        sections = new_table(
            self.title,
            LAYER,
            SPAN,
            NEAR,
            with_ends("before", "before"),
            with_ends("after", "after"),
            Column(f"differs by more than {self.least:g}", SHARE, each=True, of="probability"),
            Column("q", of=lambda row: f"{row['q_value']:.2g}", rank=1),
            name="sections",
            frame=self.sections,
        )
        ranked = self.sections.sort_values(
            "difference", key=lambda each: -each.abs(), kind="stable"
        )
        sections.add_rows(ranked.to_dict("records"))
        return [sections, frame_table("bins", self.bins)]

    def sentences(self) -> list[str]:
        """What was compared, the outcome, and what was left out."""
        fresh = [f"{name} {count}" for name, count in self.newly_observed.items() if count]
        words = [f"Observed for the first time (bins): {', '.join(fresh)}."] if fresh else []
        return [*([] if self.changed else [self.title]), *super().sentences(), *words]


def map_difference(
    first: TrackConditionMap,
    second: TrackConditionMap | None = None,
    *,
    since: int | None = None,
    until: int | None = None,
    line: Line | None = None,
    layers: Sequence[str] | None = None,
    rate: float = RATE,
    least: float = LEAST,
) -> MapDifference:
    """What changed between two maps, or between two dates of one.

    The second body of evidence is what the first lacks, so that the two are independent: of two
    maps the trips that only the second counts, of one map the days after `since` up to `until`.
    Each gives an estimate of its own. The difference of their logarithms over its standard
    deviation is normal where nothing changed; bins are called changed so that among them the
    share of those by chance is at most `rate` (Benjamini & Hochberg, 1995; valid for estimates
    that depend on each other positively, as those of neighbouring bins do: Benjamini & Yekutieli,
    2001).

    Parameters
    ----------
    first, second : TrackConditionMap
        Of one line with the same bins; without `second` two dates of the first.
    since, until : int, optional
        Days counted from 1970-01-01 in UTC; default of `until`: the last.
    line : Line, optional
        Gives the operator's kilometres and the stations.
    layers : sequence of str, optional
        Default: all that both have.
    rate, least : float

    Raises
    ------
    InputError
        If the maps are of different lines or bins, neither a second map nor a date is given, one
        side has no evidence, or a number is not between 0 and 1.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> map_difference(track, track)
    Traceback (most recent call last):
    trainlog.errors.InputError: both maps count the same trips; give two maps of different trips
    """
    for name, value in (("rate", rate), ("least", least)):
        if not 0.0 < value < 1.0:
            raise InputError(
                f"map difference: {name} must be between 0 and 1, got {value:g}",
                remedy="write 0.05 for 5 %",
            )
    if line is not None:
        first.check_line(line.name, line.length)
    if second is None:
        pair = _of_dates(first, since, until)
    elif since is not None or until is not None:
        raise InputError(
            "two maps and dates are given", remedy="give two maps, or one and two dates"
        )
    else:
        pair = _of_maps(first, second)
    names = [name for name in pair.one if name in pair.other]
    for name in layers or ():
        first.layer(name)
        if name not in names:
            raise InputError(
                f"only one side has evidence of layer '{name}'",
                remedy=f"both have {', '.join(names) or 'none in common'}",
            )
    chosen = names if layers is None else list(layers)
    if not chosen:
        raise InputError(
            f"nothing to compare: {pair.before} and {pair.after} have no layer in common",
            remedy="choose other dates or maps",
        )
    sides = [
        estimated(replace(first, layers={name: side[name] for name in chosen}))
        for side in (pair.one, pair.other)
    ]
    bins = _bins(sides[0], sides[1], line, least)
    bins["q_value"] = q_values(bins.pop("p_value").to_numpy())
    bins["significant"] = bins["q_value"] <= rate
    bins["detectable_ratio"] = detectable_ratio(bins.pop("log_std").to_numpy(), rate)
    fresh = {
        name: int((sides[1].layer(name).observed & ~sides[0].layer(name).observed).sum())
        for name in chosen
    }
    sections = _sections(bins, line)
    return MapDifference(
        first.line, pair.before, pair.after, bins, sections, fresh, rate, least, pair.notes
    )


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two independent bodies of evidence, by layer, and what they are called."""

    one: dict[str, ConditionLayer]
    other: dict[str, ConditionLayer]
    before: str
    after: str
    notes: tuple[str, ...] = ()


def _of_dates(track: TrackConditionMap, since: int | None, until: int | None) -> _Pair:
    if since is None:
        raise InputError(
            "one map is given", remedy="give a second one, or the date to compare from"
        )
    last = int(track.days[-1]) if track.days.size else since
    until = last if until is None else until
    if until <= since:
        raise InputError(
            f"the second date, {day_name(until)}, must be after the first, {day_name(since)}",
            remedy=f"the last day with evidence is {day_name(last)}",
        )
    notes: tuple[str, ...] = ()
    if until > last:
        notes = (f"The evidence ends on {day_name(last)}, before the date {day_name(until)}.",)
        until = last
    one = {name: each.evidence.between(-_EVER, since) for name, each in track.layers.items()}
    other = {name: each.evidence.between(since + 1, until) for name, each in track.layers.items()}
    return _Pair(
        _known(one),
        _known(other),
        f"evidence up to {day_name(since)}",
        f"evidence after it up to {day_name(until)}",
        notes,
    )


def _of_maps(first: TrackConditionMap, second: TrackConditionMap) -> _Pair:
    for name in ("line", "length", "bin_length", "levels"):
        if not np.array_equal(getattr(first, name), getattr(second, name)):
            raise InputError(
                f"the maps differ in {name}: {getattr(first, name)} and {getattr(second, name)}",
                remedy="compare maps of one line with the same bins",
            )
    one, other = set(_trips(first)), set(_trips(second))
    both = one & other
    evidence = [
        {name: each.evidence for name, each in track.layers.items()} for track in (first, second)
    ]
    words = [f"the first map ({counted(len(one), 'trip')})"]
    notes = tuple(_elsewhere(first, second))
    if both == one == other:
        if notes:
            raise InputError(
                "both maps count the same trips, some under another rail condition",
                remedy=f"take them out of one (trainlog map remove): {notes[0]}",
            )
        raise InputError(
            "both maps count the same trips", remedy="give two maps of different trips"
        )
    # What a trip showed is not among the sums of another layer: they cannot be subtracted.
    if both == one and not notes:
        evidence[1] = {
            name: _less(each, evidence[0].get(name)) for name, each in evidence[1].items()
        }
        words.append(f"what the second adds ({counted(len(other - both), 'trip')})")
    elif both == other and not notes:
        evidence[0] = {
            name: _less(each, evidence[1].get(name)) for name, each in evidence[0].items()
        }
        words = [f"what only the first has ({counted(len(one - both), 'trip')})"]
        words.append(f"the second map ({counted(len(other), 'trip')})")
    else:
        words.append(f"the second map ({counted(len(other), 'trip')})")
        if both:
            evidence[1] = {
                name: _other_days(each, evidence[0].get(name)) for name, each in evidence[1].items()
            }
            notes += (
                f"Both maps count {counted(len(both), 'trip')}: of the second only the days are"
                " compared on which the first has no evidence.",
            )
    return _Pair(_known(evidence[0]), _known(evidence[1]), words[0], words[1], notes)


def _trips(track: TrackConditionMap) -> dict[str, dict[str, Any]]:
    """Each trip by what identifies it: what was recorded, its log's digest, or its name."""
    return {
        str(trip.get("identity") or trip.get("sha256") or trip.get("trip")): trip
        for trip in track.trips
    }


def _elsewhere(first: TrackConditionMap, second: TrackConditionMap) -> Iterator[str]:
    """A sentence on the trips that two maps count under different rail conditions, if any."""
    one, other = _trips(first), _trips(second)
    found = [
        f"{one[key]['trip']} ({one[key]['layer']}, {other[key]['layer']})"
        for key in one
        if key in other and one[key]["layer"] != other[key]["layer"]
    ]
    if found:
        yield (
            f"The maps count {counted(len(found), 'trip')} under different rail conditions (first,"
            f" second): {few(found, LISTED)}; one of the two is wrong."
        )


def _known(evidence: dict[str, DailyEvidence]) -> dict[str, ConditionLayer]:
    """The layers of which there is any evidence, not yet estimated."""
    return {
        name: ConditionLayer.unestimated(each) for name, each in evidence.items() if each.days.size
    }


def _less(whole: DailyEvidence, part: DailyEvidence | None) -> DailyEvidence:
    """Evidence without that of some of its trips; the sums are exact."""
    if part is None:
        return whole
    negative = replace(part, **{name: -getattr(part, name) for name in _SUMS})
    rest = DailyEvidence.total([whole, negative])
    return rest.chosen(rest.trips > 0.0, rest.used_trips > 0.0)


def _other_days(evidence: DailyEvidence, first: DailyEvidence | None) -> DailyEvidence:
    days = np.zeros(0) if first is None else first.days
    return evidence.chosen(~np.isin(evidence.day, days), ~np.isin(evidence.used_day, days))


def _bins(
    one: TrackConditionMap, other: TrackConditionMap, line: Line | None, least: float
) -> pd.DataFrame:
    """Both estimates and their difference in the bins that both observed, layer by layer."""
    edges = one.edges
    where = kilometres(line, edges[:-1], edges[1:])
    parts = []
    for name in one.layers:
        old, new = one.layer(name), other.layer(name)
        seen = old.observed & new.observed
        deviation = np.hypot(old.log_std, new.log_std)[seen]
        columns: dict[str, Any] = {"line": one.line, "layer": name, "bin": np.flatnonzero(seen)}
        columns |= {key: np.asarray(values)[seen] for key, values in where.items()}
        spread = np.zeros(deviation.size)
        for side, layer in (("before", old), ("after", new)):
            names = (side, f"{side}_low", f"{side}_high")
            columns |= {name: x[seen] for name, x in zip(names, shown(layer), strict=True)}
            spread = np.hypot(spread, columns[side] * layer.log_std[seen])
        difference = columns["after"] - columns["before"]
        beyond = ndtr((-least - difference) / spread) + ndtr((difference - least) / spread)
        score = (new.log_mean - old.log_mean)[seen] / deviation
        columns |= {"difference": difference, "difference_std": spread}
        columns |= {"probability": beyond, "p_value": 2.0 * ndtr(-np.abs(score))}
        columns |= {"log_std": deviation}
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def q_values(p: FloatArray) -> FloatArray:
    """Least false discovery rate at which each of several tests is called a discovery.

    Y. Benjamini, Y. Hochberg: Controlling the false discovery rate. J. R. Stat. Soc. B 57 (1995),
    289-300.

    Parameters
    ----------
    p : (n,) array
        Probability of a result at least as extreme by chance.

    Examples
    --------
    >>> import numpy as np
    >>> q_values(np.array([0.01, 0.04, 0.5])).tolist()
    [0.03, 0.06, 0.5]
    """
    order = np.argsort(p, kind="stable")
    raw = p[order] * p.size / np.arange(1, p.size + 1)
    least = np.minimum.accumulate(raw[::-1])[::-1]
    found = np.empty(p.size)
    found[order] = np.minimum(least, 1.0)
    return found


def detectable_ratio(log_std: FloatArray, rate: float) -> FloatArray:
    """Factor by which a bin must change, alone among all, to be found with a probability of 80 %.

    A single discovery among n bins needs a probability by chance of `rate` / n (the first step of
    Benjamini & Hochberg, 1995); where many bins change, each is found from less on.

    Parameters
    ----------
    log_std : (n,) array
        Standard deviation of the difference of the logarithms, of all bins compared.
    rate : float
        False discovery rate.

    Examples
    --------
    >>> detectable_ratio(np.array([0.05, 0.2]), 0.05).round(2).tolist()
    [1.17, 1.85]
    """
    if log_std.size == 0:
        return np.empty(0)
    least = -ndtri(0.5 * rate / log_std.size) + ndtri(POWER)
    return np.asarray(np.exp(least * log_std), dtype=np.float64)


def _sections(bins: pd.DataFrame, line: Line | None) -> pd.DataFrame:
    """Neighbouring significant bins of one sign, joined."""
    chosen = bins[bins["significant"]]
    sign = np.sign(chosen["difference"])
    step = chosen["bin"].diff()
    new = (
        ~((step > 0) & (step <= 1 + GAP))
        | (sign.diff() != 0)
        | (chosen["layer"] != chosen["layer"].shift())
    )
    rows = []
    for _, each in chosen.groupby(new.cumsum()):
        weight = each["difference_std"] ** -2.0 / (each["difference_std"] ** -2.0).sum()
        first, last = each.iloc[0], each.iloc[-1]
        rows.append(
            {
                **{name: first[name] for name in ("line", "layer", "start_m")},
                "end_m": last["end_m"],
                "start_km": first["start_km"],
                "end_km": last["end_km"],
                "near": near(line, [0.5 * (first["start_m"] + last["end_m"])])[0],
                "bins": len(each),
                **{name: float((weight * each[name]).sum()) for name in _AVERAGED},
                "probability": float(each["probability"].max()),
                "q_value": float(each["q_value"].min()),
            }
        )
    names = ["line", "layer", "start_m", "end_m", "start_km", "end_km", "near", "bins"]
    return pd.DataFrame(rows, columns=[*names, *_AVERAGED, "probability", "q_value"])


_AVERAGED = (
    *("before", "before_low", "before_high", "after", "after_low", "after_high"),
    "difference",
)


# ----------------------------------------------------------------------------- one place over time

MOST_DAYS = 12
"""Days that get the estimate of then, unless more are asked for."""

REACH = 500.0
"""A day counts for a place if it has evidence no further from it than this [m]."""

SPOT = [
    *("first_day", "last_day", "checked_day"),
    *("adhesion", "low", "high", "present", "life", "may_be_change"),
]
CHANGE = ["day", "earliest", "latest", "before", "after"]
"""Of passing spots and lasting changes, what a history has."""

MOST_DAYS_LISTED = 15
"""Days that a table lists: the last."""


@dataclass(frozen=True, eq=False, repr=False)
class PlaceHistory(Presented):
    """The history of one bin in one layer.

    Attributes
    ----------
    line, layer : str
    start, end : float [m]
        Of the bin.
    start_km, end_km : float
        The operator's kilometres of its ends.
    near : str
        Its place by the nearest station; empty without a line.
    onsets : DataFrame
        A row a day on which a slip measured the maximum there: ``day``, ``trips``, ``events``,
        ``adhesion`` and its 95 % band from the measurement alone.
    used : DataFrame
        A row a day: the highest ``level`` that was used without slip, and by how many ``trips``.
    known : DataFrame
        The estimate as it was known at the end of ``day``, made of the evidence up to then:
        whether the bin was ``observed``, the lasting ``adhesion``, ``low``, ``high``, and what was
        ``expected`` right after, with its band; NaN where it was not observed. Empty where no
        slip was measured there up to now.
    spots, changes : DataFrame
        Passing spots and lasting changes there, as known now, with their dates.
    days : int
        Days with evidence there or nearby, of which `known` has all or some.
    """

    charts_by: ClassVar[str] = "analysis.adhesion.map_plot:history_charts"

    line: str
    layer: str
    start: float
    end: float
    start_km: float
    end_km: float
    near: str
    onsets: pd.DataFrame
    used: pd.DataFrame
    known: pd.DataFrame
    spots: pd.DataFrame
    changes: pd.DataFrame
    days: int = 0

    def summary(self) -> dict[str, str]:
        """How often slip began there, and how often it did not."""
        return {
            "onsets": f"{int(self.onsets['events'].sum())} of slip on {len(self.onsets)} days",
            "used": f"without slip on {len(self.used)} days",
        }

    @property
    def unmeasured(self) -> str:
        """What is known where no slip was measured, in a sentence; else empty."""
        if not self.onsets.empty or self.known["observed"].any():
            return ""
        words = "No slip was measured here: the maximum is not known"
        if not self.used.empty:
            words += f" (used without slip up to {self.used['level'].max():.2f})"
        return f"{words}."

    @property
    def notes(self) -> tuple[str, ...]:
        """What is not shown or not known, in sentences."""
        thinned = (
            f"The estimate as known then was made for {len(self.known)} of"
            f" {self.days} days with evidence nearby, chosen evenly (--days sets how many)."
        )
        said = (thinned if self.thinned else "", self.unmeasured)
        spots = (_spot_in_words(each) for each in self.spots.to_dict("records"))
        changes = (
            f"Lasting change on {each.day:%Y-%m-%d} ({each.earliest:%Y-%m-%d} to"
            f" {each.latest:%Y-%m-%d}): {each.before:.3f} to {each.after:.3f}."
            for each in self.changes.itertuples()
        )
        return tuple(filter(None, (*said, *spots, *changes)))

    @property
    def thinned(self) -> bool:
        """Whether `known` leaves days out."""
        return 0 < len(self.known) < self.days

    @property
    def title(self) -> str:
        """Line, place and layer in words."""
        place = f"km {self.start_km:.3f} to {self.end_km:.3f}" + f", {self.near}" * bool(self.near)
        return f"{self.line}, {place}, {self.layer}"

    def facts(self) -> dict[str, Any]:
        """The place."""
        return {
            "line": self.line,
            "layer": self.layer,
            "start_m": self.start,
            "end_m": self.end,
            "start_km": self.start_km,
            "end_km": self.end_km,
            "near": self.near,
            "thinned": self.thinned,
        }

    def tables(self) -> list[WordTable]:
        """What is known by day, the last days of it; and what it is made of as data."""
        earlier = len(self._days) - MOST_DAYS_LISTED
        hidden = f"{earlier} earlier days are not listed." if earlier > 0 else None
        table = new_table(self.title, *DAY_COLUMNS, name="days", caption=hidden)
        names = ("onsets", "used", "known", "spots", "changes")
        parts = [frame_table(name, getattr(self, name)) for name in names]
        return [table.add_rows(self._days[-MOST_DAYS_LISTED:]), *parts]

    @property
    def _days(self) -> list[dict[str, Any]]:
        """What is known of each day."""
        of = {
            name: {row["day"]: row for row in getattr(self, name).to_dict("records")}
            for name in ("onsets", "used", "known")
        }
        days = sorted({day for rows in of.values() for day in rows})
        return [{"day": day} | {name: rows.get(day) for name, rows in of.items()} for day in days]


def map_history(
    track: TrackConditionMap,
    position: float,
    layer: str,
    *,
    line: Line | None = None,
    days: int = MOST_DAYS,
) -> PlaceHistory:
    """The history of the bin at a position: its evidence, and the estimate as it was known by day.

    Parameters
    ----------
    track : TrackConditionMap
    position : float [m]
        Chainage.
    layer : str
    line : Line, optional
        Gives the operator's kilometres and the stations.
    days : int
        At most so many days get the estimate of then, which each takes as long as an update of the
        layer; of more they are chosen evenly, the last among them.

    Raises
    ------
    InputError
        If the position is not on the line, the map lacks the layer, the line is another, or there
        are to be no days.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> found = map_history(track, 9_680.0, "wet")
    >>> [str(day.date()) for day in found.onsets["day"]], found.onsets["adhesion"].round(2).tolist()
    (['2024-10-07'], [0.07])
    """
    if not 0.0 <= position <= track.length:
        raise InputError(
            f"km {position / 1e3:g} is not on line '{track.line}'",
            remedy=f"it reaches from km 0 to {track.length / 1e3:.3f}",
        )
    if line is not None:
        track.check_line(line.name, line.length)
    if days < 1:
        raise InputError(
            f"map history: days must be 1 or more, got {days}", remedy="give 1 or more days"
        )
    chosen = track.layer(layer)
    row = int(track.bin_of(position))
    start = row * track.bin_length
    end = min(start + track.bin_length, track.length)
    where = pd.DataFrame(kilometres(line, np.array([start]), np.array([end]))).iloc[0]
    known, reach = chosen.evidence, int(np.ceil(REACH / track.bin_length))
    # Days with evidence in the bin or near it.
    own, used = (np.abs(each - row) <= reach for each in (known.bin, known.used_bin))
    when = np.union1d(known.day[own], known.used_day[used]).astype(np.int64)
    onsets = _onsets(chosen, row)
    if onsets.empty and np.isfinite(chosen.log_mean[row]) and not chosen.observed[row]:
        # Less evidence did not show it either.
        when = when[:0]
    evenly = np.linspace(when.size - 1, 0, min(days, when.size)).astype(int)
    shown = when[evenly[::-1]]
    spots = spots_table(track, layers=[layer]).sort_values("first_day", kind="stable")
    spots = spots.rename(columns={"present_when_checked": "present", "life_days": "life"})
    return PlaceHistory(
        line=track.line,
        layer=layer,
        start=start,
        end=end,
        start_km=float(where["start_km"]),
        end_km=float(where["end_km"]),
        near=str(where["near"]),
        onsets=onsets,
        used=_used(track, chosen, row),
        known=_known_over(track, layer, row, shown),
        spots=_there(spots, start, end, SPOT),
        changes=_there(changes_table(track, layers=[layer]), start, end, CHANGE),
        days=int(when.size),
    )


def _onsets(layer: ConditionLayer, row: int) -> pd.DataFrame:
    known = layer.evidence
    there = (known.bin == row) & (known.weight > 0.0)
    weight = known.weight[there]
    mean = known.weighted_log[there] / weight
    # What all onsets of a trip share does not average out within the trip.
    std = np.sqrt(1.0 / weight + known.common[there] / weight**2)
    return pd.DataFrame(
        {
            "day": dates(known.day[there]),
            "trips": known.trips[there].astype(np.int64),
            "events": known.events[there].astype(np.int64),
            "adhesion": np.exp(mean),
            "low": np.exp(mean - 1.96 * std),
            "high": np.exp(mean + 1.96 * std),
        }
    )


def _used(track: TrackConditionMap, layer: ConditionLayer, row: int) -> pd.DataFrame:
    known = layer.evidence
    there = known.used_bin == row
    rows = pd.DataFrame(
        {
            "day": dates(known.used_day[there]),
            "level": track.levels[known.used_level[there]],
            "trips": known.used_trips[there].astype(np.int64),
        }
    )
    # The rows of a day are in the order of the levels.
    return rows.groupby("day", as_index=False).last()


def _known_over(track: TrackConditionMap, name: str, row: int, days: IntArray) -> pd.DataFrame:
    """The estimate in a bin as it was known at the end of each day."""
    rows = []
    for day in days.tolist():
        layer = layer_before(track, day + 1, name)
        assert layer is not None
        known = (each[row] for one in (layer, layer.expected()) for each in shown(one))
        rows.append((day, layer.observed[row], *known))
    table = pd.DataFrame(rows, columns=["day", "observed", *ADHESIONS])
    table["day"] = dates(days)
    return table


def _there(rows: pd.DataFrame, start: float, end: float, columns: Sequence[str]) -> pd.DataFrame:
    """Columns of the rows of a table that lie on a part of the line, from its beginning on."""
    there = rows[(rows["start_m"] < end) & (rows["end_m"] > start)]
    return there.sort_values("start_m", kind="stable")[columns].reset_index(drop=True)


def _spot_in_words(spot: Mapping[Hashable, Any]) -> str:
    share = probability_words(spot["present"])
    still = share if share.startswith("gone") else f"still there with {share}"
    met = met_words(spot["first_day"], spot["last_day"])
    end = f"; {MAY_BE_CHANGE}" if spot["may_be_change"] else "."
    on = f"{spot['checked_day']:%Y-%m-%d}"
    return f"Passing spot: {spot['adhesion']:.3f}, met {met}; on {on} {still}{end}"


def _of(name: str, value: str, ends: tuple[str, str]) -> Callable[[Mapping[str, Any]], Cell]:
    """An adhesion with its band as it was known on a day; empty where it was not."""

    def cell(day: Mapping[str, Any]) -> Cell:
        row = day[name]
        if row is None or not np.isfinite(row[value]):
            return Said(None, "")
        return Ends(row[value], *(row[each] for each in ends))

    return cell


DAY_COLUMNS = (
    Column("day", of=lambda day: f"{day['day']:%Y-%m-%d}"),
    Column("onsets", NUMBER, of=lambda day: (day["onsets"] or {}).get("events", "")),
    Column("measured (95 % band)", ADHESION, key="measured", rank=1,
           of=_of("onsets", "adhesion", ("low", "high"))),
    Column("used without slip", replace(ADHESION, digits=2), rank=1,
           of=lambda day: (day["used"] or {}).get("level", "")),
    Column("lasting (95 % band)", ADHESION, key="lasting",
           of=_of("known", "adhesion", ("low", "high"))),
    Column("expected (95 % band)", ADHESION, key="expected",
           of=_of("known", "expected", ("expected_low", "expected_high"))),
)  # fmt: skip
"""Of what is known of a place on a day."""

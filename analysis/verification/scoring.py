"""Maps and forecasts scored on logs, or maps on their own days: `trainlog map score`."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import pandas as pd

from analysis.adhesion.condition_map import empty_map, refusal_of
from analysis.adhesion.evidence import Evidence, evidence_of_log, own_line
from analysis.network.maps import LogOnEdges, NetworkMap
from analysis.verification.forecasts import map_forecast, reach, rolling_forecast, stated_forecast
from analysis.verification.verify import (
    FEWEST_DAYS,
    FIGURES,
    FORECASTS,
    NOON,
    USUAL_ALARM,
    Demand,
    Forecaster,
    History,
    Passages,
    Verification,
    passages_of,
    time_of,
    verify,
)
from trainlog.display import counted, few
from trainlog.errors import MOST_LISTED, InputError, TrainlogError
from trainlog.formats.files import sha256_of
from trainlog.identity import Known, same_drives
from trainlog.mcap import read_log
from trainlog.presentation import Presented, WordTable, new_table
from trainlog.railway.condition import AdhesionEstimate, AdhesionForecast, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence, day_of
from trainlog.railway.weather import Weather, check_condition

MOST_NAMED = 3
"""Trips that are named of those which one sentence is about."""


class LeftOut(NamedTuple):
    """A trip that was not scored, and why."""

    trip: str
    reason: str


def by_reason(left_out: Iterable[LeftOut]) -> list[str]:
    """One sentence a reason, with the number of trips and the first names.

    Examples
    --------
    >>> by_reason(LeftOut(name, "ran before: not scored") for name in "abcde")
    ["5 trips ('a', 'b', 'c' and 2 more): ran before: not scored"]
    """
    trips: dict[str, list[str]] = {}
    for each in left_out:
        trips.setdefault(each.reason, []).append(each.trip)
    return [f"{_named(names)}: {reason}" for reason, names in trips.items()]


def _named(trips: Sequence[str]) -> str:
    if len(trips) == 1:
        return f"trip '{trips[0]}'"
    named = few([f"'{each}'" for each in trips], MOST_NAMED)
    return f"{counted(len(trips), 'trip')} ({named})"


OF_EDGES = (
    "onsets",
    *(f"log_score_onsets_gain_over_{each}" for each in FORECASTS[1:]),
    "crps_forecast",
    "maxima_in_band",
    "onsets_in_band",
)
"""Figures that are stated of each edge."""


@dataclass(frozen=True, eq=False, repr=False)
class Score(Presented):
    """How good a forecast was.

    Attributes
    ----------
    line, name : str
        Of the line, and of what was scored.
    layers : dict of str to Verification
        By rail condition; ``"all"`` has all of them together.
    left_out : tuple of LeftOut
        Trips that were not scored, with the reason.
    refused : tuple of str
        Logs that could not be used, with the reason.
    limits : tuple of str
        What the forecast does not cover, and what else the trips must be read with.
    edges : dict of str to Verification
        Of a network each edge by itself, all rail conditions together.
    """

    charts_by: ClassVar[str] = "analysis.verification.plot:score_charts"

    line: str
    name: str
    layers: dict[str, Verification]
    left_out: tuple[LeftOut, ...] = ()
    refused: tuple[str, ...] = ()
    limits: tuple[str, ...] = ()
    edges: Mapping[str, Verification] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """What was scored on which line."""
        return f"Score of {self.name} on line '{self.line}'"

    def summary(self) -> dict[str, str]:
        """Days, onsets and the gain over the prior."""
        whole = self.layers["all"]
        gain = whole.log_score("onsets", over="prior")
        days = counted(whole.days.size, "day")
        return {"scored": f"{days}, {whole.onsets} onsets: {gain.value:+.2f} nat over the prior"}

    def tables(self) -> list[WordTable]:
        """Scores by rail condition with their 95 % bands, reliability, alarms, and edges."""
        names = [name for name in self.layers if name != "all"]
        shown = names if len(names) == 1 else [*names, "all"]
        title = f"Score of {self.name} on {self.line} (95 % band by day)"
        table = new_table(title, f"alarm at {USUAL_ALARM:.0%}", *shown, name="score")
        for row in FIGURES:
            table.add_row(row.heading, *(row.words(row.cell(self.layers[each])) for each in shown))
        found = [table, *self.layers["all"].tables()]
        if self.edges:
            columns = (each for each in FIGURES if each.key in OF_EDGES)
            edges = new_table("By edge (95 % band by day)", "edge", *columns, name="edges")
            for name, each in self.edges.items():
                edges.add_cells(name, *(column.cell(each) for column in edges.forms[1:]))
            found.append(edges)
        return found

    @property
    def notes(self) -> tuple[str, ...]:
        """What could not be stated, and why, in sentences."""
        whole, words = self.layers["all"], list(self.limits)
        if whole.known_days < FEWEST_DAYS:
            days = counted(int(whole.days.size), "day")
            if whole.known_days < whole.days.size:
                days = f"forecast known on {whole.known_days} of {days}"
            words.append(f"{days}: too few for bands, which need {FEWEST_DAYS}")
        missing = int(whole.no_demand.sum())
        if missing:
            words.append(
                f"{counted(missing, 'passage')} of bins without a trip on another day: how much is"
                " asked for there is not known, so that the probability of slip is not scored"
            )
        return tuple(words)

    def facts(self) -> dict[str, Any]:
        """All figures."""
        every = {
            layer: {table.name: table.data for table in each.tables()}
            for layer, each in self.layers.items()
        }
        return {
            "line": self.line,
            "scored": self.name,
            "layers": {name: each.details() for name, each in self.layers.items()},
            **{name: {each: rows[name] for each, rows in every.items()} for name in every["all"]},
            "edges": [{"edge": name} | each.details() for name, each in self.edges.items()],
            "left_out": [f"trip '{each.trip}': {each.reason}" for each in self.left_out],
            "refused": list(self.refused),
        }


@dataclass
class ScoredTrips:
    """What the logs hold: evidence of each trip, and what could not be used."""

    track: TrackConditionMap
    pieces: list[Evidence] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    limits: list[str] = field(default_factory=list)

    @property
    def evidence(self) -> list[DailyEvidence]:
        """Of each trip, by rail condition."""
        return [known for piece in self.pieces for known in piece.layers.values()]

    def passages(self) -> list[Passages]:
        """What each trip met, a day at a time."""
        return [
            day
            for piece in self.pieces
            for layer, known in piece.layers.items()
            for day in passages_of(layer, known, _middle(piece))
        ]

    def limit_layers(self, forecast: Iterable[str]) -> None:
        """State for which of the rail conditions met there is no forecast."""
        lacking = sorted({name for piece in self.pieces for name in piece.layers} - set(forecast))
        if lacking:
            named = ", ".join(f"'{name}'" for name in lacking)
            self.limits.append(f"no forecast for rail condition {named}: there all is unknown")

    def limit_time(self, forecast: AdhesionForecast) -> None:
        """State how many days and trips lie outside the forecast's validity."""
        outside = [not forecast.in_force(_middle(piece)).any() for piece in self.pieces]
        if not any(outside):
            return
        days = [day_of(_middle(piece)) for piece in self.pieces]
        every, inside = set(days), {day for day, out in zip(days, outside, strict=True) if not out}
        start, end = (
            pd.Timestamp(each, tz="UTC").strftime("%Y-%m-%dT%H:%MZ")
            for each in (forecast.valid_from.min(), forecast.valid_to.max())
        )
        self.limits.append(
            f"{len(every - inside)} of {counted(len(every), 'day')} ({sum(outside)} of"
            f" {counted(len(outside), 'trip')}) lie outside the forecast's validity, {start} to"
            f" {end}: there all is unknown"
        )


def _middle(piece: Evidence) -> pd.Timestamp:
    """Of the time of a trip."""
    return pd.Timestamp(sum(piece.span) // 2, tz="UTC")


def score_rolling(
    track: TrackConditionMap,
    layers: Sequence[str] | None = None,
    report: Callable[[int, int], None] | None = None,
    forecaster: Forecaster | None = None,
) -> Score:
    """Score what a map would have expected of each of its days from the days before alone.

    Parameters
    ----------
    track : TrackConditionMap
    layers : sequence of str, optional
        Rail conditions to score; default: all of the map.
    report : callable, optional
        Called before each day that is forecast, with its number and that of all.
    forecaster : callable, optional
        That forecasts; default: `analysis.verification.forecasts.rolling_forecast` of the map.

    Raises
    ------
    InputError
        If the map has no such layer, or no evidence of two days.

    Examples
    --------
    >>> from trainlog import InputError
    >>> from trainlog.formats.mapfile import read_map
    >>> track = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> try:
    ...     score_rolling(track)
    ... except InputError as error:
    ...     print(error.problem)
    the map holds evidence of one day: no day can be forecast from the days before
    """
    days = {day for layer in track.layers.values() for day in layer.evidence.days.tolist()}
    if len(days) < 2:
        raise InputError(
            f"the map holds evidence of {'one day' if days else 'no day'}: no day can be forecast"
            " from the days before",
            remedy="count in trips of several days, or give later trips to score it on",
        )
    chosen = {name: track.layer(name).evidence for name in layers or track.layers}
    every = [passages for name, known in chosen.items() for passages in passages_of(name, known)]
    demand = Demand([layer.evidence for layer in track.layers.values()], track.levels)
    first = min(days)
    scored = [each for each in every if each.day > first]
    forecaster = _reporting(forecaster or rolling_forecast(track), scored, report)
    known = _with_all({name: layer.evidence for name, layer in track.layers.items()})
    return _scored("the map, day by day", track, scored, forecaster,
                   lambda layer, day: known[layer].between(first, day - 1), demand)  # fmt: skip


def _with_all(held: dict[str, DailyEvidence]) -> dict[str, DailyEvidence]:
    """Evidence by rail condition, and under ``""`` that of all together."""
    return held | {"": DailyEvidence.total(held.values())} if held else held


def _reporting(
    forecaster: Forecaster, scored: list[Passages], report: Callable[[int, int], None] | None
) -> Forecaster:
    """The forecaster, which reports each day that it comes to."""
    days = sorted({each.day for each in scored})

    def expected(layer: str, time: pd.Timestamp) -> AdhesionEstimate | None:
        if report is not None:
            report(bisect_right(days, day_of(time)), len(days))
        return forecaster(layer, time)

    return expected


def score_map(
    track: TrackConditionMap,
    logs: Iterable[str | Path],
    layer: str | None = None,
    weather: Weather | None = None,
) -> Score:
    """Score a map on later trips, which it does not hold; trips of its own days are left out.

    Parameters
    ----------
    track : TrackConditionMap
    logs : iterable of path
    layer : str, optional
        Rail condition of the trips; default: what each states.
    weather : Weather, optional
        Condition of trips that state none.

    Raises
    ------
    InputError
        If the map has no such layer, or there is no later trip.

    Examples
    --------
    >>> from trainlog import InputError
    >>> from trainlog.formats.mapfile import read_map
    >>> track = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> try:
    ...     score_map(track, ["sample_logs/stopping.mcap"])
    ... except InputError as error:
    ...     print(error.problem.partition(": ")[2])
    trip 'trip-03': ran on a day of which the map holds evidence, or before: not scored
    """
    if layer is not None:
        track.layer(layer)
    return score_map_on(track, _trips(logs, track, layer, weather))


def score_map_on(track: TrackConditionMap, trips: ScoredTrips) -> Score:
    """As `score_map`, on trips whose evidence is known."""
    last = int(track.days[-1]) if track.days.size else -1
    later = []
    for piece in trips.pieces:
        if _middle(piece) < time_of(last) + NOON:
            reason = "ran on a day of which the map holds evidence, or before: not scored"
            trips.left_out.append(LeftOut(piece.trip, reason))
        else:
            later.append(piece)
    trips.pieces = later
    trips.limit_layers(track.layers)
    nothing = DailyEvidence.none(track.bins, track.levels.size)
    demand = Demand(
        [*(each.evidence for each in track.layers.values()), *trips.evidence], track.levels
    )
    held = _with_all({name: each.evidence for name, each in track.layers.items()})
    return _scored("the map", track, trips.passages(), map_forecast(track),
                   lambda layer, _: held.get(layer, nothing), demand, trips)  # fmt: skip


def score_forecast(
    forecast: AdhesionForecast,
    logs: Iterable[str | Path],
    layer: str | None = None,
    weather: Weather | None = None,
) -> Score:
    """Score the forecast of anyone on trips; persistence knows the earlier of these trips.

    Parameters
    ----------
    forecast : AdhesionForecast
    logs, layer, weather
        As of `score_map`.

    Raises
    ------
    InputError
        If the forecast is for another line, or has no row for the layer.

    Examples
    --------
    >>> from trainlog.railway.condition import AdhesionForecast
    >>> import numpy as np
    >>> import pandas as pd
    >>> span = [np.array([pd.Timestamp(f"2024-10-{day}").value]) for day in ("07", "08", "06")]
    >>> forecast = AdhesionForecast(
    ...     "CH_StGallen_Wil", np.array([0.0]), np.array([29_500.0]), *span, ("wet",),
    ...     np.array([0.05, 0.5]), np.array([[0.08, 0.14]]), np.zeros(0), np.zeros((1, 0)),
    ... )
    >>> day = score_forecast(forecast, ["sample_logs/stopping.mcap"]).layers["wet"]
    >>> day.onsets > 0, bool(np.isfinite(day.log_score("onsets", over="prior").value))
    (True, True)
    """
    named = sorted(set(forecast.layer) - {""})
    anyone = "" in forecast.layer
    if layer is not None and check_condition(layer, named) not in named and not anyone:
        raise InputError(
            f"the forecast has no row for rail condition '{layer}'",
            remedy=f"rail conditions present: {', '.join(named)}",
        )
    trips = _trips(logs, None, layer, weather)
    track = trips.track
    trips.limit_time(forecast)
    if not anyone:
        trips.limit_layers(named)
    every = [item for piece in trips.pieces for item in piece.layers.items()]
    held = {
        name: DailyEvidence.total(known for each, known in every if each == name)
        for name, _ in every
    }
    held = _with_all(held)
    return _scored("the forecast", track, trips.passages(), stated_forecast(forecast, track),
                   lambda layer, day: held[layer].between(-1, day - 1),
                   Demand(trips.evidence, track.levels), trips)  # fmt: skip


def _scored(
    name: str,
    track: TrackConditionMap,
    passages: list[Passages],
    forecaster: Forecaster,
    history: History,
    demand: Demand,
    trips: ScoredTrips | None = None,
) -> Score:
    if trips is not None and not passages:
        why = [*by_reason(trips.left_out), *trips.refused]
        more = f"; and {len(why) - MOST_LISTED} more" if len(why) > MOST_LISTED else ""
        raise InputError(
            "no trip to score the forecast on"
            + (f": {'; '.join(why[:MOST_LISTED])}{more}" if why else ""),
            remedy="give logs of days that the forecast does not know",
        )
    by_day = sorted(passages, key=lambda each: each.day)
    found = verify(name, track, by_day, forecaster, history, demand)
    names = sorted({each.layer for each in passages})
    layers = {each: found[each] for each in names} | {"all": Verification.together(found)}
    if trips is None:
        return Score(track.line, name, layers)
    others = tuple(trips.left_out), tuple(trips.refused), tuple(trips.limits)
    return Score(track.line, name, layers, *others)


def line_of_logs(logs: Iterable[str | Path]) -> tuple[str | None, float]:
    """Line of the first log that can be read, and the chainage to which a forecast may reach [m].

    Without such a log: none, without end.

    Examples
    --------
    >>> line_of_logs(["sample_logs/README.md", "sample_logs/stopping.mcap"])[0]
    'CH_StGallen_Wil'
    """
    for path in logs:
        try:
            track = empty_map(own_line(read_log(path, topics=[])))
        except TrainlogError:
            continue  # stated when it is scored
        return track.line, reach(track)
    return None, float("inf")


def _trips(
    logs: Iterable[str | Path],
    track: TrackConditionMap | None,
    layer: str | None,
    weather: Weather | None,
) -> ScoredTrips:
    """Evidence of each trip, a drive once; a log that cannot be used does not stop the others."""
    found: list[Evidence] = []
    refused, digests, stated = [], set[str](), dict[str, str]()
    for path in map(Path, logs):
        try:
            digest = sha256_of(path)
            if digest in digests:
                continue
            if track is None:
                track = empty_map(own_line(read_log(path, topics=[])))
            found.append(evidence_of_log(path, track, layer, weather, sha256=digest))
            digests.add(digest)
            if layer is not None:
                stated[digest] = read_log(path, topics=[]).metadata.get("weather", "")
        except TrainlogError as error:
            refused.append(refusal_of(error, path))
    if track is None:
        raise InputError(
            "no log could be used" + (f": {refused[0]}" if refused else ""),
            remedy="give logs of trips",
        )
    return counted_once(track, found, refused, stated, layer)


def counted_once(
    track: TrackConditionMap,
    found: Sequence[Evidence],
    refused: list[str],
    stated: Mapping[str, str],
    layer: str | None,
) -> ScoredTrips:
    """Trips of which each drive counts once.

    Parameters
    ----------
    track : TrackConditionMap
    found : sequence of Evidence
    refused : list of str
    stated : mapping of str to str
        Rail condition that logs state, by their digest, where `layer` is given in its place.
    layer : str or None
    """
    known = [
        Known(each.trip, each.recorded, (each.steps, each.sha256, each.trip), digest=each.sha256)
        for each in found
    ]
    same = {
        each.number: each.sentence.removeprefix(f"trip '{found[each.number].trip}' ")
        for each in same_drives(known)
    }
    pieces = [each for number, each in enumerate(found) if number not in same]
    left_out = [LeftOut(found[number].trip, words) for number, words in same.items()]
    other = [each for each in pieces if stated.get(each.sha256, "") not in ("", layer)]
    limits = []
    if other:
        conditions = ", ".join(f"'{name}'" for name in sorted({stated[e.sha256] for e in other}))
        named = _named([each.trip for each in other])
        limits.append(f"{named}: scored in '{layer}' as given; the log states {conditions}")
    return ScoredTrips(track, pieces, left_out, refused, limits)


# -------------------------------------------------------------------------------------- a network


def score_network(
    maps: NetworkMap,
    layers: list[str] | None = None,
    report: Callable[[int, int], None] | None = None,
    forecasters: Mapping[str, Forecaster] | None = None,
) -> tuple[Score, dict[str, Score]]:
    """Score what the maps of a network would have expected of each day from the days before alone.

    Parameters
    ----------
    maps : NetworkMap
    layers : list of str, optional
        Rail conditions to score; default: all.
    report : callable, optional
        Called with the number of edges done and that of all.
    forecasters : mapping of str to callable, optional
        By edge, what forecasts; default: its map from the days before.

    Returns
    -------
    whole : Score
        Of all edges together, added up by day: its bands are of days, as weather is alike on all.
    edges : dict of str to Score
        By edge, those that have evidence of two days.

    Raises
    ------
    InputError
        If no edge has evidence of two days.
    """
    found: dict[str, Score] = {}
    short = []
    for number, (name, track) in enumerate(maps.maps.items(), start=1):
        chosen = None if layers is None else [each for each in layers if each in track.layers]
        if track.days.size < 2 or chosen == []:
            short.append(name)
        else:
            forecaster = None if forecasters is None else forecasters[name]
            found[name] = score_rolling(track, chosen, None, forecaster)
        if report is not None:
            report(number, len(maps.maps))
    if not found:
        raise InputError(
            "no edge has evidence of two days: no day can be forecast from the days before",
            file=maps.folder,
            remedy="count in trips of several days",
        )
    limits = [f"{counted(len(short), 'edge')} without evidence of two days: not scored"] * bool(
        short
    )
    return _whole(maps, "the maps, day by day", found, limits), found


def score_network_on(
    maps: NetworkMap,
    logs: Iterable[str | Path],
    layer: str | None = None,
    weather: Weather | None = None,
) -> tuple[Score, dict[str, Score]]:
    """Score the maps of a network on later trips, each edge that a trip ran over by its own map.

    Trips of days of which an edge's map holds evidence are left out there. A trip that cannot be
    used on one edge is refused there alone.

    Parameters
    ----------
    maps : NetworkMap
    logs : iterable of path
    layer : str, optional
        Rail condition of the trips; default: what each states of the edge.
    weather : Weather, optional
        Condition of trips that state none.

    Returns
    -------
    whole : Score
        Of all edges together, added up by day.
    edges : dict of str to Score

    Raises
    ------
    InputError
        If there is no later trip on an edge with a map.
    """
    pieces: dict[str, list[Evidence]] = {}
    refused: list[str] = []
    digests: set[str] = set()
    stated: dict[str, str] = {}
    without: dict[str, int] = {}
    for path in map(Path, logs):
        try:
            digest = sha256_of(path)
            if digest in digests:
                continue
            digests.add(digest)
            given = LogOnEdges(path, maps.network)
            edges = given.edges
            if layer is not None:
                stated[digest] = given.trip.metadata.get("weather", "")
        except TrainlogError as error:
            refused.append(refusal_of(error, path))
            continue
        for edge in edges:
            track = maps.maps.get(edge.name)
            if track is None:
                without[edge.name] = without.get(edge.name, 0) + 1
                continue
            try:
                piece = given.evidence_on(edge, track, layer, weather, digest)
            except TrainlogError as error:
                refused.append(f"edge '{edge.name}': {refusal_of(error, path)}")
            else:
                pieces.setdefault(edge.name, []).append(piece)
    limits = [
        f"edge '{name}' has no map: {counted(count, 'trip')} not scored there"
        for name, count in sorted(without.items())
    ]
    found: dict[str, Score] = {}
    for name, some in sorted(pieces.items()):
        trips = counted_once(maps.maps[name], some, [], stated, layer)
        try:
            found[name] = score_map_on(maps.maps[name], trips)
        except InputError as error:
            limits.append(f"edge '{name}': {error.problem}")
    if not found:
        why = [*limits, *refused]
        raise InputError(
            "no later trip on an edge with a map" + (f": {'; '.join(why[:4])}" if why else ""),
            file=maps.folder,
            remedy="give logs of trips of days that the maps do not hold",
        )
    return _whole(maps, "the maps", found, limits, refused), found


def _whole(
    maps: NetworkMap,
    name: str,
    found: Mapping[str, Score],
    limits: Iterable[str],
    refused: Iterable[str] = (),
) -> Score:
    """All edges together, added up by day and rail condition."""
    names = sorted({each for score in found.values() for each in score.layers} - {"all"})
    pooled = {
        layer: Verification.together(
            {edge: each.layers[layer] for edge, each in found.items() if layer in each.layers}
        )
        for layer in [*names, "all"]
    }
    network = maps.network.name if maps.network is not None else maps.folder.name
    left_out: dict[LeftOut, None] = {}
    for score in found.values():
        left_out |= dict.fromkeys(score.left_out)
    own = {f"edge '{edge}': {words}": None for edge, each in found.items() for words in each.limits}
    return Score(
        f"network {network}",
        name,
        pooled,
        tuple(left_out),
        tuple(refused),
        (*limits, *own),
        {edge: each.layers["all"] for edge, each in found.items()},
    )

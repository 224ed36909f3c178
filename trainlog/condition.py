"""The estimate of a track-condition map, from its evidence and settings alone.

Two time scales: the lasting condition of each bin, and spots that pass
(`estimators.condition_field`). The same evidence gives the same estimate, byte for byte, in
whatever order trips were counted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pandas import Timestamp

from estimators.condition_field import (
    DOUBT,
    LEVELS,
    POSITION_STD,
    SPOT_CELLS,
    FieldChange,
    FieldEvidence,
    FieldParameters,
    FieldPosterior,
    Prior,
    common_std,
    onset_std,
    solve,
)
from estimators.condition_passes import OFTEN, blurred
from estimators.trip_agreement import Agreement, TripRows, agreement_of
from trainlog.arrays import FloatArray, IntArray
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.railway.condition import (
    DIRECTIONS,
    SET_ASIDE,
    ConditionChange,
    ConditionLayer,
    ModelParameter,
    PassingSpot,
    TrackConditionMap,
    band_of,
    condition_of_layer,
    layer_of,
)
from trainlog.railway.evidence import DailyEvidence, day_of
from trainlog.units import DAY

UNITS = {"length": "m", "slippery_length": "m", "spot_length": "m", "life": "days"}

NAMES = {
    "mean": "mean",
    "std": "std",
    "length": "correlation_length",
    "slippery_share": "slippery_share",
    "slippery_mean": "slippery_mean",
    "slippery_std": "slippery_std",
    "slippery_length": "slippery_length",
    "trip_std": "trip_std",
    "met": "spots_met",
    "occupied": "spot_share",
    "life": "spot_life",
    "spot_mean": "spot_mean",
    "spot_std": "spot_std",
    "spot_length": "spot_length",
}
"""Names in the model of a layer of the `FieldParameters`."""


def estimated(track: TrackConditionMap) -> TrackConditionMap:
    """The map with the estimate of each layer made anew of its evidence and the map's settings.

    Parameters
    ----------
    track : TrackConditionMap

    Raises
    ------
    InputError
        If the map lacks a setting.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> sorted(estimated(track).layers)
    ['dry', 'wet']
    """
    layers = {name: _estimated(track, name) for name in sorted(track.layers)}
    return replace(track, layers=layers)


def known_before(track: TrackConditionMap, time: Timestamp) -> TrackConditionMap:
    """The map as it was before the day of a time (UTC), made of the evidence of the days before.

    Layers without evidence until then are left out, and trips whose middle is not known to be of a
    day before. It is the map itself if no evidence is later.

    Parameters
    ----------
    track : TrackConditionMap
    time : Timestamp
        Without a zone it is taken for UTC.

    Raises
    ------
    InputError
        If no evidence is of a day before.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> known_before(track, Timestamp("2024-10-08")) is track
    True
    >>> try:
    ...     known_before(track, Timestamp("2024-10-07T20:00"))
    ... except InputError as error:
    ...     print(error.problem)
    map of line 'CH_StGallen_Wil' has no evidence of a day before 2024-10-07
    """
    if not later_evidence(track, time):
        return track
    day = day_of(time)
    known = {name: each.evidence.between(-1, day - 1) for name, each in track.layers.items()}
    layers = {
        name: ConditionLayer.unestimated(each) for name, each in known.items() if each.days.size
    }
    if not layers:
        first = int(track.days[0])
        raise InputError(
            f"map of line '{track.line}' has no evidence of a day before {np.datetime64(day, 'D')}",
            remedy=f"give {np.datetime64(first + 1, 'D')} or later, or no time",
        )
    trips = tuple(each for each in track.trips if (ran := day_of_trip(each)) and ran < day)
    return estimated(replace(track, layers=layers, trips=trips))


def layer_before(track: TrackConditionMap, day: int, layer: str) -> ConditionLayer | None:
    """A layer of the map as it was before a day; None if there was no evidence until then.

    Parameters
    ----------
    track : TrackConditionMap
    day : int
        Counted from 1970-01-01 in UTC.
    layer : str

    Examples
    --------
    >>> from trainlog.formats.mapfile import read_map
    >>> track = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> layer_before(track, 0, "wet") is None
    True
    """
    known = track.layer(layer).evidence.between(-1, day - 1)
    if not known.days.size:
        return None
    alone = replace(track, layers={layer: ConditionLayer.unestimated(known)}, trips=())
    return estimated(alone).layer(layer)


def day_of_trip(entry: Mapping[str, Any]) -> int | None:
    """Day of a trip of a map (its middle), counted from 1970-01-01 in UTC; None if not known.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> {day_of_trip(each) for each in track.trips}
    {20003}
    """
    time = entry.get("weather", {}).get("time")
    return None if time is None else day_of(Timestamp(time))


def left_out(track: TrackConditionMap, time: Timestamp | None) -> str:
    """Which evidence `known_before` leaves out, in words; empty: none.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> left_out(track, Timestamp("2024-10-07T08:00"))
    'without the evidence of 1 day, 2024-10-07, which is not from before 2024-10-07 (UTC)'
    """
    later = "" if time is None else later_evidence(track, time)
    if time is None or not later:
        return ""
    day = np.datetime64(day_of(time), "D")
    return f"without the {later}, which is not from before {day} (UTC)"


def later_evidence(track: TrackConditionMap, time: Timestamp) -> str:
    """Which evidence of a map is of the day of a time (UTC) or later, in words; empty: none.

    `ConditionLayer.expected` counts it, too: what is expected of that time with the evidence of all
    days. `known_before` leaves it out.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> later_evidence(track, Timestamp("2024-10-07T08:00"))
    'evidence of 1 day, 2024-10-07'
    >>> later_evidence(track, Timestamp("2024-10-08"))
    ''
    """
    first = day_of(time)
    later = track.days[track.days >= first]
    if not later.size:
        return ""
    ends = [str(np.datetime64(int(each), "D")) for each in (later[0], later[-1])]
    return f"evidence of {counted(later.size, 'day')}, {' to '.join(dict.fromkeys(ends))}"


@dataclass(frozen=True, eq=False)
class TripEvidence:
    """Evidence of one trip in a layer, to be compared with that of others.

    Attributes
    ----------
    key : str
    direction : str
        ``"forward"`` or ``"reverse"``; empty: not known.
    start : int [ns since 1970 UTC]
        -1: not known.
    evidence : DailyEvidence
    """

    key: str
    direction: str
    start: int
    evidence: DailyEvidence

    @property
    def time(self) -> int:
        """Its start; where that is not known, the first day of its evidence [ns since 1970 UTC]."""
        days = self.evidence.days
        return self.start if self.start > 0 or not days.size else int(days[0]) * DAY


@dataclass(frozen=True, eq=False)
class Reconciled:
    """Evidence of a layer whose trips do not all agree.

    Attributes
    ----------
    evidence : dict of str to DailyEvidence
        What counts of each trip, by key; not of those set aside.
    notes : dict of str to str
        Why trips are set aside, or what was made of them, by key.
    layers : dict of str to str
        In which each of these counts, by key: one, or one for each direction (`layer_of`).
    """

    evidence: dict[str, DailyEvidence]
    notes: dict[str, str]
    layers: dict[str, str]


LONGEST_APART = 5 * 365
"""Days without any trip in a map, at most: what lies beyond is taken for a wrong date."""


def reconciled(
    track: TrackConditionMap, layer: str, trips: Sequence[TripEvidence], *, apart: bool = False
) -> Reconciled | None:
    """What counts of the trips of a layer; None if all of them agree.

    Trips that find another level than the others there, or are dated years from them, are set
    aside. Where those of one direction find more than those of the other, as on the two tracks of a
    double line, each direction has a layer. Where factors of trips differ by more than errors,
    each trip's is taken out of its evidence, and its error is common to the trip's onsets.

    Parameters
    ----------
    track : TrackConditionMap
        Of which levels and settings are used.
    layer : str
    trips : sequence of TripEvidence
        In an order that does not depend on how they came.
    apart : bool
        Whether the directions are known to differ.
    """
    notes = _misdated(trips)
    dated = [each for each in trips if each.key not in notes]
    second = np.array([each.direction == DIRECTIONS[1] for each in dated], dtype=np.bool_)
    found = None
    if len(dated) > 1:
        order = np.array([each.time for each in dated], dtype=np.int64)
        found = agreement_of(_trip_rows(track, dated), second, order, order // DAY)
    agree = found is None or not (
        found.apart or found.spread or found.aside.any() or found.lag.any()
    )
    if agree and not notes and not apart:
        return None
    layers: dict[str, str] = {}
    pieces: dict[str, list[tuple[int, DailyEvidence]]] = {}
    for number, each in enumerate(dated):
        own, piece = layer, each.evidence
        if each.direction and (apart or (found is not None and found.apart)):
            own = layer_of(layer, each.direction)
        if found is not None:
            said = _note_of(track, layer, found, number)
            notes |= {each.key: said} if said else {}
            piece = piece.moved(-int(found.lag[number])) if found.lag[number] else piece
        if not notes.get(each.key, "").startswith(SET_ASIDE):
            layers[each.key] = own
            pieces.setdefault(own, []).append((number, piece))
    evidence = {
        dated[number].key: given
        if found is None
        else _corrected(track, found, number, given, every, second=bool(second[number]))
        for _, every in sorted(pieces.items())
        for number, given in every
    }
    return Reconciled(evidence, notes, layers)


def _note_of(track: TrackConditionMap, layer: str, found: Agreement, number: int) -> str:
    """What is to be stated of a trip beside the others; empty: nothing."""
    factors, words = found.factors, []
    if found.aside[number]:
        return (
            f"{SET_ASIDE}{np.exp(factors.log[number]):.2f} times the adhesion of the other"
            f" '{layer}' trips in {factors.places[number]:.0f} bins; is it of that rail condition?"
        )
    if found.apart:
        words.append(
            f"the directions differ: reverse trips find {np.exp(found.apart):.2f} times the"
            " adhesion of forward ones; each has its layer"
        )
    if found.lag[number]:
        away = found.lag[number] * track.bin_length
        words.append(
            f"slips {away:+.0f} m from where the others do: moved there, and the band is wider;"
            " correct its position"
        )
    return "; ".join(words)


def _corrected(
    track: TrackConditionMap,
    found: Agreement,
    number: int,
    piece: DailyEvidence,
    every: Sequence[tuple[int, DailyEvidence]],
    *,
    second: bool,
) -> DailyEvidence:
    """The evidence of a trip beside `every` other of its layer, without the trip's own factor."""
    placing = found.placing[int(second)]
    if not found.spread and not placing.any():
        return piece
    log, std = float(found.factors.log[number]), float(found.factors.std[number])
    share = found.spread**2 / (found.spread**2 + std**2)
    # Trips that are placed wrong do not become right with their number.
    trips = np.bincount(np.concatenate([each.bin for _, each in every]), minlength=track.bins)
    variance = share * std**2 + (placing * trips)[piece.bin]
    return piece.scaled(share * log, variance, np.log(track.levels))


def _misdated(trips: Sequence[TripEvidence]) -> dict[str, str]:
    """Why trips are dated wrong, by key: the fewer, or the earlier, of two groups years apart."""
    dated = sorted(
        (int(each.evidence.days[0]), each.key) for each in trips if each.evidence.days.size
    )
    if len(dated) < 2:
        return {}
    days = np.array([day for day, _ in dated])
    group = np.cumsum(np.diff(days, prepend=days[0]) > LONGEST_APART)
    size = np.bincount(group)
    usual = int(np.flatnonzero(size == size.max())[-1])
    ends = [np.datetime64(int(each), "D") for each in days[group == usual][[0, -1]]]
    return {
        key: f"{SET_ASIDE}dated {np.datetime64(day, 'D')}, years from trips of {ends[0]} to"
        f" {ends[1]}; correct the recorder's clock and ingest it again"
        for (day, key), own in zip(dated, group.tolist(), strict=True)
        if own != usual
    }


def _trip_rows(track: TrackConditionMap, trips: Sequence[TripEvidence]) -> TripRows:
    """Evidence of trips as the estimator takes it, each bin of a trip once."""
    levels, own = np.log(track.levels), setting(track, "trip_std") ** 2

    def joined(name: str) -> Any:
        return np.concatenate([getattr(each.evidence, name) for each in trips])

    def number(name: str) -> IntArray:
        sizes = [getattr(each.evidence, name).size for each in trips]
        return np.repeat(np.arange(len(trips)), sizes)

    weight = joined("weight")
    return TripRows(
        len(trips),
        track.bins,
        number("bin"),
        joined("bin"),
        joined("weighted_log") / weight,
        np.maximum(1.0 / weight - own, 1e-4) + joined("common") / weight**2,
        number("used_bin"),
        joined("used_bin"),
        levels[joined("used_level")],
    )


def assumed_parameters(track: TrackConditionMap, name: str) -> FieldParameters:
    """What holds for a layer until there is evidence.

    Slippery places hold two thirds of normal rail, spots half; one tenth of a line is slippery,
    and of 250 bins that a trip passes one has a spot.
    """
    prior = prior_of(track, name)
    return FieldParameters(
        mean=prior.mean,
        std=0.15,
        length=prior.correlation_length,
        slippery_share=0.1,
        slippery_mean=prior.mean + float(np.log(0.65)),
        slippery_std=prior.std,
        slippery_length=200.0,
        trip_std=setting(track, "trip_std"),
        met=0.004,
        occupied=0.002,
        life=3.0,
        spot_mean=prior.mean + float(np.log(0.5)),
        spot_std=0.45,
        spot_length=100.0,
    )


def _estimated(track: TrackConditionMap, name: str) -> ConditionLayer:
    prior, known = prior_of(track, name), track.layers[name].evidence
    found = solve(_plain(track, known), assumed_parameters(track, name))
    weight = known.by_bin("weight")
    slope = np.gradient(found.probability @ LEVELS) if known.bins > 1 else np.zeros(known.bins)
    std = np.sqrt(
        setting(track, "model_std") ** 2
        + (POSITION_STD / track.bin_length * slope) ** 2
        + common_std(prior, track.bin_length, weight, known.by_bin("common")) ** 2
    )
    step = float(LEVELS[1] - LEVELS[0])
    probability = blurred(found.probability, std, step)
    log_mean, log_std = band_of(probability, LEVELS)
    return ConditionLayer(
        log_mean=log_mean,
        log_std=log_std,
        observed=(known.by_bin("events") > 0)
        | (
            onset_std(prior, track.bin_length, weight)
            <= setting(track, "observed_share") * prior.std
        ),
        log_levels=LEVELS,
        probability=probability,
        evidence=known,
        spots=_spots(track, found),
        changes=tuple(_change(track, each) for each in found.changes),
        model=_model(track, found),
        passing=_passing(known, found),
    )


def _plain(track: TrackConditionMap, known: DailyEvidence) -> FieldEvidence:
    """The evidence as the solver takes it: without the trip's own deviation in its variances."""
    mean = known.weighted_log / known.weight
    own = known.trips / known.weight - setting(track, "trip_std") ** 2
    return FieldEvidence(
        bins=known.bins,
        bin_length=track.bin_length,
        # What was used without slip was counted at the lower end of a step.
        log_levels=np.log(track.levels + 0.5 * np.gradient(track.levels)),
        day=known.day,
        bin=known.bin,
        trips=known.trips,
        mean=mean,
        scatter=np.maximum(known.weighted_square / known.weight - mean**2, 0.0),
        variance=np.maximum(own, 1e-4),
        used_day=known.used_day,
        used_bin=known.used_bin,
        used_level=known.used_level,
        used_trips=known.used_trips,
    )


def _model(track: TrackConditionMap, found: FieldPosterior) -> dict[str, ModelParameter]:
    """The parameters, with their deviations and where they are from, and the constants in use."""
    parameters = [
        ModelParameter(
            name, UNITS.get(own, "1"), float(getattr(found.parameters, own)), *found.origin[own]
        )
        for own, name in NAMES.items()
    ]
    constants = (
        ("onset_position_std", "m", POSITION_STD),
        ("onsets_of_wide_error", "1", OFTEN),
        ("single_day_doubt", "1", DOUBT),
        ("model_std", "1", setting(track, "model_std")),
    )
    parameters += [ModelParameter(*each, std=0.0, source="assumed") for each in constants]
    return {each.name: each for each in parameters}


def _change(track: TrackConditionMap, found: FieldChange) -> ConditionChange:
    return ConditionChange(
        start=found.first * track.bin_length,
        end=min((found.last + 1) * track.bin_length, track.length),
        day=found.day,
        earliest=found.earliest,
        latest=found.latest,
        before=float(np.exp(found.before)),
        after=float(np.exp(found.after)),
        before_std=found.before_std,
        after_std=found.after_std,
        significance=found.log_odds,
    )


def _passing(known: DailyEvidence, found: FieldPosterior) -> FloatArray:
    """Spots as the last evidence of each bin left them."""
    last = np.zeros(known.bins, dtype=np.int64)
    np.maximum.at(last, known.bin, known.day)
    np.maximum.at(last, known.used_bin, known.used_day)
    parameters = found.parameters
    present = np.full(known.bins, parameters.occupied)
    log_mean = np.full(known.bins, parameters.spot_mean)
    log_std = np.full(known.bins, parameters.spot_std)
    levels = LEVELS[SPOT_CELLS]
    weight = found.state.sum(axis=1)
    safe = np.maximum(weight, 1e-12)
    first = found.state @ levels / safe
    second = np.maximum(found.state @ levels**2 / safe - first**2, 0.05**2)
    present[found.rows.bins] = weight
    log_mean[found.rows.bins] = np.where(weight > 1e-6, first, parameters.spot_mean)
    log_std[found.rows.bins] = np.where(weight > 1e-6, np.sqrt(second), parameters.spot_std)
    return np.array([last.astype(np.float64), present, log_mean, log_std])


SEPARATE = 2
"""Bins between two onsets of one spot, at most."""


def _spots(track: TrackConditionMap, found: FieldPosterior) -> tuple[PassingSpot, ...]:
    """Onsets that are more likely of spots than not, joined by place and day."""
    rows, life = found.rows, found.parameters.life
    likely = np.flatnonzero((rows.onset[:, 0] > 0) & (found.present > 0.5))
    order = likely[np.lexsort((rows.bin[likely], rows.day[likely]))]
    groups: list[list[int]] = []
    for row in order.tolist():
        for group in groups:
            near = any(
                abs(rows.bin[row] - rows.bin[other]) <= SEPARATE
                and rows.day[row] - rows.day[other] <= max(life, 1.0)
                for other in group
            )
            if near:
                group.append(row)
                break
        else:
            groups.append([row])
    made = [_spot(track, found, np.array(group)) for group in groups]
    return tuple(sorted(made, key=lambda spot: (spot.start, spot.first)))


def _spot(track: TrackConditionMap, found: FieldPosterior, group: IntArray) -> PassingSpot:
    rows, parameters = found.rows, found.parameters
    bins = np.unique(rows.bin[group])
    place = np.searchsorted(rows.bins, bins)
    mean = rows.onset[group, 1]
    variance = parameters.trip_std**2 + rows.onset[group, 3]
    level = float(np.average(mean, weights=1.0 / variance))
    spread = float(np.sqrt(np.average((mean - level) ** 2 + variance, weights=1.0 / variance)))
    ends = rows.start[place + 1] - 1
    checked = int(rows.day[ends].max())
    return PassingSpot(
        start=float(bins[0] * track.bin_length),
        end=float(min((bins[-1] + 1) * track.bin_length, track.length)),
        adhesion=float(np.exp(level)),
        low=float(np.exp(level - 1.96 * spread)),
        high=float(np.exp(level + 1.96 * spread)),
        first=int(rows.day[group].min()),
        last=int(rows.day[group].max()),
        checked=checked,
        present=float(found.state[place].sum(axis=1).max()),
        life=float(parameters.life),
    )


def prior_of(track: TrackConditionMap, layer: str) -> Prior:
    """What the map's settings say of a layer before any evidence."""
    condition = condition_of_layer(layer)
    known = condition if condition in ("dry", "wet") else "other"
    return Prior(
        float(np.log(setting(track, f"prior_{known}"))),
        setting(track, "prior_std"),
        setting(track, "correlation_length"),
    )


def setting(track: TrackConditionMap, name: str) -> float:
    """One of the numbers that say how a map is made.

    Raises
    ------
    InputError
        If the map does not have it.
    """
    try:
        return track.settings[name]
    except KeyError:
        raise InputError(
            f"track-condition map of line '{track.line}' lacks the setting '{name}'",
            remedy="begin a new map from the logs",
        ) from None

"""The track-condition map: maximum adhesion along a line, learnt from trips.

Each trip gives additive evidence a bin (`evidence`). `update` adds it to a map and solves for the
estimate (`trainlog.condition`). All sums are exact: trips can be processed apart, in any
order and grouping, and give the same map, byte for byte.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from analysis.adhesion.covariates import TOPICS as COVARIATE_TOPICS, covariates
from analysis.adhesion.empty_map import (
    LEVELS as LEVELS,
    SETTINGS as SETTINGS,
    empty_map as empty_map,
    empty_map_of as empty_map_of,
)
from analysis.adhesion.evidence import (
    Evidence,
    check_line,
    condition_of,
    evidence,
    evidence_of_parts,
)
from analysis.adhesion.slip import TOPICS, SlipAnalysis, slip
from analysis.given import Given, each_given
from trainlog import __version__
from trainlog.condition import estimated
from trainlog.display import counted
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.files import sha256_of
from trainlog.formats.railway import line_of
from trainlog.identity import (
    COLUMNS,
    Known,
    TripIdentity,
    identity_from_text,
    identity_of,
    same_drives,
    text_of,
)
from trainlog.mcap import read_log
from trainlog.mcap.reader import identity_of_log, stretches
from trainlog.presentation import NUMBER, POSITION, Column, Presented, Said, WordTable, new_table
from trainlog.railway.condition import ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence
from trainlog.railway.line import Line
from trainlog.railway.weather import Weather, given_condition
from trainlog.trip import Trip

SPOT_SEPARATION = 250.0
"""Two low spots count as two when they are at least this far from each other [m]."""


def update(
    track: TrackConditionMap, pieces: Iterable[Evidence]
) -> tuple[TrackConditionMap, tuple[str, ...]]:
    """Add the evidence of trips to a map.

    Parameters
    ----------
    track : TrackConditionMap
    pieces : iterable of Evidence
        In any order.

    Returns
    -------
    track : TrackConditionMap
        Solved.
    skipped : tuple of str
        Names of the trips that were not counted: of logs and drives that the map held already, or
        that came in a fuller recording.

    Raises
    ------
    InputError
        If evidence belongs to another line or other bins.
    """
    given = list(pieces)
    for piece in given:
        _check_fits(track, piece)
    left_out = _left_out(track, _of_pieces(given))
    sums = {name: [layer.evidence] for name, layer in track.layers.items()}
    trips = list(track.trips)
    for number, piece in enumerate(given):
        if number in left_out:
            continue
        trips.append(entry_of(piece))
        for name, daily in piece.layers.items():
            sums.setdefault(name, []).append(daily)
    return _solved(track, sums, trips), tuple(given[number].trip for number in left_out)


def entry_of(piece: Evidence) -> dict[str, Any]:
    """What a map keeps of a trip."""
    return {
        "trip": piece.trip,
        "sha256": piece.sha256,
        "layer": piece.layer,
        **({"further_layers": list(piece.further)} if piece.further else {}),
        "software": f"trainlog {__version__}",
        "identity": text_of(piece.recorded),
        **piece.details,
    }


class _Log(NamedTuple):
    """What a trip is known by."""

    trip: str
    sha256: str
    identity: TripIdentity | None
    steps: int = 0

    @property
    def key(self) -> tuple[str, str]:
        """What identifies the log by itself: its SHA-256, or what was recorded, or the name."""
        if self.sha256:
            return "", self.sha256
        return (self.trip, "") if self.identity is None else ("", self.identity.text)


def _logs(track: TrackConditionMap) -> list[_Log]:
    """The trips that a map holds; of those of older maps the identity is not known."""
    return [
        _Log(str(trip["trip"]), str(trip.get("sha256") or ""), identity_from_text(text))
        for trip in track.trips
        for text in [str(trip.get("identity") or "")]
    ]


def _of_pieces(pieces: Iterable[Evidence]) -> list[_Log]:
    return [_Log(piece.trip, piece.sha256, piece.recorded, piece.steps) for piece in pieces]


def _left_out(track: TrackConditionMap, logs: Sequence[_Log]) -> dict[int, str]:
    """The trips that are not to be counted, by number, with the reason; see `same_drives`."""
    held = _logs(track)
    found: dict[int, str] = {}
    counted = {log.key for log in held}
    for number, log in enumerate(logs):
        if log.key in counted or (not log.sha256 and (log.trip, "") in counted):
            found[number] = f"trip '{log.trip}': in the map already, not counted again"
        counted.add(log.key)
    known = [Known(log.trip, log.identity, held=True, digest=log.sha256) for log in held]
    known += [
        Known(
            log.trip,
            None if number in found else log.identity,
            (log.steps, log.sha256, log.trip),
            digest=log.sha256,
        )
        for number, log in enumerate(logs)
    ]
    found |= {same.number - len(held): same.sentence for same in same_drives(known)}
    return dict(sorted(found.items()))


def _spots_in_words(layer: LayerSummary) -> str:
    spots = [
        f"km {spot.position / 1e3:.3f}: {spot.adhesion:.3f} ({spot.low:.3f} to {spot.high:.3f})"
        for spot in layer.lowest
    ]
    return "\n".join(spots) or "nothing observed"


def _observed(layer: LayerSummary) -> Said:
    share = layer.observed_bins / layer.bins
    words = f"{layer.observed_length / 1e3:.1f} km, {share:.0%}"
    return Said(layer.observed_length, words)


LAYER_COLUMNS = (
    Column("rail\ncondition", key="layer"),
    Column("trips", NUMBER),
    Column("onsets measured", NUMBER, key="onsets", of="events"),
    Column("observed", POSITION, each=True, of=_observed),
    Column("lowest maximum adhesion (95 % band)", key="lowest", of=_spots_in_words, rank=1),
)


@dataclass(frozen=True, eq=False, repr=False)
class UpdatedMap(Presented):
    """A track-condition map to which trips were added.

    Attributes
    ----------
    track : TrackConditionMap
    skipped : tuple of str
        Names of the trips that were not counted: the map held them already, or a fuller recording
        of the same drive was given.
    reasons : tuple of str
        Why each was not counted.
    """

    track: TrackConditionMap
    skipped: tuple[str, ...]
    reasons: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The map."""
        return self.track.title

    def summary(self) -> dict[str, str]:
        """That of the map, and which trips it held already."""
        skipped = ", ".join(self.skipped[:4]) + (" and more" if len(self.skipped) > 4 else "")
        return self.track.summary() | ({"held already": skipped} if skipped else {})

    def tables(self) -> list[WordTable]:
        """What the map knows, layer by layer, with its lowest spots."""
        title = f"Track condition of {self.track.line}, {self.track.bin_length:.0f} m bins"
        return [new_table(title, *LAYER_COLUMNS, name="layers").add_rows(self.layers)]

    @property
    def notes(self) -> list[str]:
        """What holds where nothing was observed, and what the recorders lacked."""
        return map_words(self.track)

    @property
    def layers(self) -> tuple[LayerSummary, ...]:
        """What each layer amounts to, with its lowest spots."""
        return summary(self.track)


def adhesion_map(
    trips: Given | Iterable[Given],
    known: TrackConditionMap | None = None,
    layer: str | None = None,
    weather: Weather | None = None,
) -> UpdatedMap:
    """Learn maximum adhesion along a line from trips, or add trips to a map.

    Each drive is counted once, in its fullest recording (`trainlog.identity`); one that the map
    holds already is not counted again, be it from another file. A log too long for the memory is
    analysed in stretches: what is taken from a whole trip, the sizes of the noise and
    the wheel diameters, is then that of the stretch.

    Parameters
    ----------
    trips : Trip, path, or iterable of them
        Trips at hand, logs and folders of logs.
    known : TrackConditionMap, optional
        Default: a new one, on the line of the first trip.
    layer : str, optional
        Rail condition of all trips, one that is known or ``"new:grease"``; default: what each
        states (metadata ``weather``).
    weather : Weather, optional
        At the line: the rail's condition where neither the call nor the trip states it. Where it
        changes on the way, what was seen counts for the condition that held then. Temperature,
        humidity and rain are kept with each trip.

    Raises
    ------
    TrainlogError
        If a trip cannot be used; the message names the file of a log.

    Examples
    --------
    >>> found = adhesion_map("sample_logs/nonstop.mcap")
    >>> [(each.layer, each.trips) for each in found.layers]
    [('dry', 1)]
    """
    if layer is not None:
        layer = given_condition(layer, () if known is None else known.layers)
    track = known
    pieces: list[Evidence] = []
    held: list[tuple[str, str]] = []
    for given in each_given(trips):
        path = None if isinstance(given, Trip) else given
        trip = given if isinstance(given, Trip) else read_log(given, topics=COVARIATE_TOPICS)
        try:
            if track is None:
                track = empty_map(own_line(trip))
            condition_of(trip, track, layer, weather)
            digest = "" if path is None else sha256_of(path)
            recorded = identity_of(trip) if path is None else identity_of_log(path)
            why = _left_out(track, [_Log(trip.name, digest, recorded)])
            if why:
                held.append((trip.name, why[0]))
                continue
            pieces.append(
                evidence(trip, track, layer=layer, weather=weather)
                if path is None
                else evidence_of_log(path, track, layer, weather, sha256=digest)
            )
        except TrainlogError as error:
            if path is None:
                raise
            raise type(error)(error.problem, file=path, remedy=error.remedy) from error
    if track is None:
        raise InputError("no trip was given", remedy="name trips or logs to build the map from")
    left_out = _left_out(track, _of_pieces(pieces))
    held += [(pieces[number].trip, why) for number, why in left_out.items()]
    used = [piece for number, piece in enumerate(pieces) if number not in left_out]
    return UpdatedMap(
        update(track, used)[0],
        tuple(name for name, _ in held),
        tuple(why for _, why in held),
    )


def evidence_of_log(
    path: Path,
    track: TrackConditionMap,
    layer: str | None = None,
    weather: Weather | None = None,
    *,
    sha256: str = "",
) -> Evidence:
    """What the trip of a log says of the maximum adhesion; a long log is analysed in stretches.

    Parameters and errors are those of `analysis.adhesion.evidence.evidence`, for a log.
    """
    trip = read_log(path, topics=COVARIATE_TOPICS)
    condition = condition_of(trip, track, layer, weather)
    recorded: list[TripIdentity | None] = []

    def analysed() -> Iterator[SlipAnalysis]:
        for stretch in stretches(path, TOPICS):
            if stretch.count == 1 and _decides(stretch.trip):
                recorded.append(identity_of(stretch.trip))
            # A stretch in which the axles were not recorded has no slip.
            if stretch.count == 1 or len(stretch.trip["/train/axles"]) > 1:
                yield slip(stretch.trip).part(stretch.span)

    piece = evidence_of_parts(analysed(), track, condition, sha256=sha256)
    found = recorded[0] if recorded else identity_of_log(path)
    details = piece.details | covariates(trip, piece.span, weather)
    return replace(piece, recorded=found, steps=len(trip.provenance), details=details)


def slips_of_log(path: Path) -> Iterator[SlipAnalysis]:
    """The slip analysis of a log; of a long log stretch by stretch."""
    for stretch in stretches(path, TOPICS):
        # A stretch in which the axles were not recorded has no slip.
        if stretch.count == 1 or len(stretch.trip["/train/axles"]) > 1:
            yield slip(stretch.trip).part(stretch.span)


def _decides(trip: Trip) -> bool:
    """Whether the topics that slip needs hold the column that identifies the drive."""
    topic, column, _ = COLUMNS[0]
    frame = trip.topics.get(topic)
    return frame is not None and column in frame and bool(frame[column].notna().any())


def own_line(trip: Trip) -> Line:
    """The line of a trip in its own direction."""
    line = line_of(trip)
    return line.reversed() if trip.metadata.get("direction") == "reverse" else line


def merge(first: TrackConditionMap, second: TrackConditionMap) -> TrackConditionMap:
    """One map from two that were made of different trips.

    Raises
    ------
    InputError
        If the maps differ in line, bins or settings, or count a trip in both.
    """
    for name in ("line", "length", "bin_length", "settings", "levels"):
        if not np.array_equal(getattr(first, name), getattr(second, name)):
            raise InputError(
                f"track-condition maps differ in {name}:"
                f" {getattr(first, name)} and {getattr(second, name)}",
                remedy="merge maps of one line that were made with the same settings",
            )
    more = _logs(second)
    both = _left_out(first, more)
    if both:
        names = sorted(more[number].trip for number in both)
        raise InputError(
            f"both track-condition maps count trip '{names[0]}' ({len(both)} in common)",
            remedy="build one map from the logs instead",
        )
    sums = {name: [layer.evidence] for name, layer in first.layers.items()}
    for name, layer in second.layers.items():
        sums.setdefault(name, []).append(layer.evidence)
    return _solved(first, sums, [*first.trips, *second.trips])


def _solved(
    track: TrackConditionMap, sums: dict[str, list[DailyEvidence]], trips: list[dict[str, Any]]
) -> TrackConditionMap:
    layers = {
        name: ConditionLayer.unestimated(DailyEvidence.total(sums[name])) for name in sorted(sums)
    }
    keys = ("layer", "trip", "sha256", "identity")
    ordered = tuple(sorted(trips, key=lambda trip: [trip.get(key, "") for key in keys]))
    return estimated(replace(track, layers=layers, trips=ordered))


def _check_fits(track: TrackConditionMap, piece: Evidence) -> None:
    check_line(track, piece.trip, piece.line, piece.length)
    if piece.bin_length != track.bin_length or piece.daily.levels != track.levels.size:
        raise InputError(
            f"trip '{piece.trip}': evidence in bins of {piece.bin_length:g} m does not fit the"
            f" map's {track.bin_length:g} m",
            remedy="make the evidence with the map's bin length",
        )


@dataclass(frozen=True, slots=True)
class Spot:
    """A low spot: chainage [m], maximum adhesion there and the ends of its 95 % band."""

    position: float
    adhesion: float
    low: float
    high: float


UNMEASURED = (
    "in them the axle's effort neither fell nor was cut, or it is not known, or is known of the"
    " whole train only and another axle had slipped just before"
)
"""Why slip events do not show the maximum."""


@dataclass(frozen=True, slots=True)
class LayerSummary:
    """What a layer of a map amounts to.

    Attributes
    ----------
    layer : str
    trips : int
    observed_bins, bins : int
    observed_length : float [m]
    events : int
        Onsets of slip that measured the maximum.
    lowest : tuple of Spot
        Least adhesion first, at least `SPOT_SEPARATION` apart.
    unmeasured : int
        Slip events that did not show the maximum (`UNMEASURED`).
    incomplete : int
        Trips on which slips may have gone unseen.
    notes : dict of str to tuple of str
        What the recorders of the trips lacked, as first met, with the trips of which that holds.
    """

    layer: str
    trips: int
    observed_bins: int
    bins: int
    observed_length: float
    events: int
    lowest: tuple[Spot, ...]
    unmeasured: int = 0
    incomplete: int = 0
    notes: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def elsewhere(self) -> str:
        """What holds where nothing was observed, in words."""
        if not self.unmeasured and not self.incomplete:
            return "Where nothing was observed, demand never met the limit: no estimate."
        words = "Where nothing was observed, the map has no estimate"
        if self.unmeasured:
            measured = counted(self.events, "onset")
            words += f"; {measured} of slip measured the maximum, {self.unmeasured} others did not"
            words += f" ({UNMEASURED})"
        if self.incomplete:
            words += f"; on {counted(self.incomplete, 'trip')} slips may have gone unseen"
        return words + "."


def summary(track: TrackConditionMap, spots: int = 5) -> tuple[LayerSummary, ...]:
    """What each layer of a map amounts to, with its lowest spots."""
    return tuple(
        LayerSummary(
            layer=name,
            trips=sum(trip["layer"] == name for trip in track.trips),
            observed_bins=int(np.count_nonzero(layer.observed)),
            bins=track.bins,
            observed_length=_observed_length(track, layer),
            events=int(layer.events.sum()),
            lowest=_lowest(track, layer, spots),
            **_recorded(track, name),
        )
        for name, layer in track.layers.items()
    )


def _recorded(track: TrackConditionMap, layer: str) -> dict[str, Any]:
    """What the trips of a layer lacked: the last fields of `LayerSummary`."""
    trips = [trip for trip in track.trips if trip["layer"] == layer]
    first: dict[str, str] = {}
    found: dict[str, list[str]] = {}
    for trip in trips:
        for note in trip.get("notes", ()):
            # Notes of one kind differ in their numbers only.
            kind = "".join(re.split(r"[-\d., ]+", note))
            found.setdefault(first.setdefault(kind, note), []).append(str(trip["trip"]))
    return {
        "unmeasured": sum(int(trip.get("unmeasured", 0)) for trip in trips),
        "incomplete": sum(trip.get("complete") is False for trip in trips),
        "notes": {note: tuple(names) for note, names in found.items()},
    }


def _observed_length(track: TrackConditionMap, layer: ConditionLayer) -> float:
    """Length of the observed bins [m]; the last bin ends with the line."""
    widths = np.diff(np.minimum(np.arange(track.bins + 1) * track.bin_length, track.length))
    return float(widths[layer.observed].sum())


def _lowest(track: TrackConditionMap, layer: ConditionLayer, spots: int) -> tuple[Spot, ...]:
    chosen: list[int] = []
    candidates = np.flatnonzero(layer.observed)
    for i in candidates[np.argsort(layer.log_mean[candidates], kind="stable")]:
        if all(abs(i - j) * track.bin_length >= SPOT_SEPARATION for j in chosen):
            chosen.append(int(i))
        if len(chosen) == spots:
            break
    band = 1.96 * layer.log_std
    return tuple(
        Spot(
            position=float(track.centres[i]),
            adhesion=float(np.exp(layer.log_mean[i])),
            low=float(np.exp(layer.log_mean[i] - band[i])),
            high=float(np.exp(layer.log_mean[i] + band[i])),
        )
        for i in chosen
    )


def map_words(track: TrackConditionMap) -> list[str]:
    """What holds where nothing was observed, and what the recorders lacked, in sentences."""
    every = summary(track)
    words = [
        each.elsewhere if len(every) == 1 else f"{each.layer}: {each.elsewhere}" for each in every
    ]
    if len({each.elsewhere for each in every}) <= 1:
        words = [each.elsewhere for each in every[:1]]
    for each in every:
        for note, trips in each.notes.items():
            more = f" and {len(trips) - 1} more" if len(trips) > 1 else ""
            words.append(f"{each.layer}, {trips[0]}{more}: {note}")
    return words

"""The track-condition map: maximum adhesion along a line, learnt from trips.

Each trip gives additive evidence a bin (`analysis.adhesion.evidence`); the map's ledger
(`trainlog.formats.mapfile`) decides which recordings count and adds their evidence up; the estimate
(`trainlog.condition`) is made of the sums. All sums are exact: trips can be processed apart, in any
order and grouping, and give the same map, byte for byte. The file of a map takes trips one after
the other, as they come: each is on the disk when it is reported. Logs are known by their content,
so that the same folder can be given again and again: what the map holds is neither read nor counted
again.
"""

from __future__ import annotations

import pickle
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from os import stat_result
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from trainlog.display import counted
from trainlog.errors import InputError, LogError, NotRecordedError, TrainlogError
from trainlog.formats.files import logs_of, refuse_reading, sha256, sha256_of
from trainlog.formats.mapfile import MapFile, Recording, Refusal, reasons_of
from trainlog.identity import text_of
from trainlog.presentation import Column, Presented, Said, WordTable, new_table
from trainlog.railway.adhesion import DRY, WET
from trainlog.railway.condition import BIN_LENGTH, TrackConditionMap
from trainlog.railway.line import Line
from trainlog.railway.weather import given_condition, stated_condition
from trainlog.trip import Trip
from trainlog.version import __version__, code_version

if TYPE_CHECKING:
    from analysis.adhesion.evidence import Evidence
    from analysis.adhesion.map_state import LayerSummary
    from analysis.network.maps import LogOnEdges
    from analysis.view import Given
    from trainlog.railway.weather import Weather

# What analyses logs is imported with the first one that the map does not hold: most of the time of
# an update that finds nothing new would be spent on it.

LEVELS = np.round(np.arange(0.02, 0.601, 0.01), 2)
"""Adhesion levels of the censoring histograms."""

SETTINGS: dict[str, float] = {
    "prior_dry": DRY.peak,
    "prior_wet": WET.peak,
    "prior_other": float(np.sqrt(DRY.peak * WET.peak)),
    "prior_std": 0.4,
    "correlation_length": 120.0,
    "trip_std": 0.12,
    "model_std": 0.04,
    "observed_share": 0.5,
}
"""How a map is made; every map records its own.

prior_dry, prior_wet, prior_other
    Maximum adhesion expected of a layer before any evidence (Zhao et al., 2025, table 1; between
    the two for layers of any other name).
prior_std, correlation_length [m]
    Of the logarithm of the maximum adhesion along a line.
trip_std
    Of the same from trip to trip at one place, leaves and other passing spots included.
model_std
    Least standard deviation that is published, for what the model leaves out.
observed_share
    A bin is observed where an onset was measured in it, or where onsets nearby bring the standard
    deviation, by themselves, to this share of prior_std.
"""


def empty_map(
    line: Line, bin_length: float = BIN_LENGTH, settings: dict[str, float] | None = None
) -> TrackConditionMap:
    """A map without layers.

    Parameters
    ----------
    line : Line
        In its own direction.
    bin_length : float [m]
    settings : dict, optional
        Replaces entries of `SETTINGS`.

    Raises
    ------
    InputError
        If the bin length or a setting is not positive, or a setting unknown.
    """
    return empty_map_of(line.name, line.length, bin_length, settings)


def empty_map_of(
    line: str,
    length: float,
    bin_length: float = BIN_LENGTH,
    settings: dict[str, float] | None = None,
) -> TrackConditionMap:
    """A map without layers of a line, or an edge of a network, of which only this is known.

    Parameters are those of `empty_map`, with the name and the length [m] in place of the line.
    """
    chosen = {**SETTINGS, **(settings or {})}
    for name, value in {"bin_length": bin_length, **chosen}.items():
        if name not in SETTINGS and name != "bin_length":
            raise InputError(
                f"track-condition map: unknown setting '{name}'",
                remedy=f"settings: {', '.join(SETTINGS)}",
            )
        if not (value > 0.0 and np.isfinite(value)):
            raise InputError(
                f"track-condition map: {name} must be positive, got {value}",
                remedy="give a value above 0",
            )
    return TrackConditionMap(
        line=line,
        length=length,
        bin_length=bin_length,
        levels=LEVELS,
        layers={},
        settings=chosen,
    )


_SETTLED = 2_000_000_000
"""A file that was changed so shortly before [ns] may change again within one step of its clock."""

Outcome = Literal["added", "held", "same drive", "not recorded", "refused", "refused before"]

OUTCOMES: dict[Outcome, str] = {
    "added": "",
    "held": "held already",
    "same drive": "of a drive that counts already",
    "not recorded": "without axle speeds",
    "refused": "refused",
    "refused before": "refused before (--retry states why)",
}
"""Of logs that are given to a map, with the words for their number; those that are added come
first."""


# ----------------------------------------------------------------------------- a map at hand


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
    found, left_out = _updated(track, given)
    return found, tuple(given[number].trip for number in left_out)


def _updated(
    track: TrackConditionMap, pieces: list[Evidence]
) -> tuple[TrackConditionMap, dict[int, str]]:
    """The map with the evidence of trips, and why some do not count, by number."""
    for piece in pieces:
        track.check_line(piece.line, piece.length, 0.0, f"trip '{piece.trip}'")
        if piece.bin_length != track.bin_length or piece.daily.levels != track.levels.size:
            raise InputError(
                f"trip '{piece.trip}': evidence in bins of {piece.bin_length:g} m does not fit the"
                f" map's {track.bin_length:g} m",
                remedy="make the evidence with the map's bin length",
            )
    with MapFile.of_map(track) as ledger:
        left_out = {}
        for number, recording in enumerate(map(recording_of, pieces)):
            if why := ledger.reason(recording):
                left_out[number] = why
            ledger.append(recording)
        reasons = reasons_of(ledger.rows())
        for number, recording in enumerate(map(recording_of, pieces)):
            if number not in left_out and recording.key in reasons:
                left_out[number] = reasons[recording.key]
        return ledger.read(), dict(sorted(left_out.items()))


def recording_of(piece: Evidence, **details: Any) -> Recording:
    """What a map keeps of a trip, with its evidence."""
    entry = {
        "trip": piece.trip,
        "sha256": piece.sha256,
        "layer": piece.layer,
        **({"further_layers": list(piece.further)} if piece.further else {}),
        "software": f"trainlog {__version__}",
        "identity": text_of(piece.recorded),
        **piece.details,
        **details,
    }
    return Recording(piece.layer, entry, piece.recorded, piece.steps, piece.layers)


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
        from analysis.adhesion.map_state import LAYER_COLUMNS

        title = f"Track condition of {self.track.line}, {self.track.bin_length:.0f} m bins"
        return [new_table(title, *LAYER_COLUMNS, name="layers").add_rows(self.layers)]

    @property
    def notes(self) -> list[str]:
        """What holds where nothing was observed, and what the recorders lacked."""
        from analysis.adhesion.map_state import map_words

        return map_words(self.track)

    @property
    def layers(self) -> tuple[LayerSummary, ...]:
        """What each layer amounts to, with its lowest spots."""
        from analysis.adhesion.map_state import summary

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
    from analysis.adhesion.evidence import evidence, evidence_of_log
    from analysis.view import each_given, view_of

    if layer is not None:
        layer = given_condition(layer, () if known is None else known.layers)
    track = known
    pieces: list[Evidence] = []
    held: list[tuple[str, str]] = []
    for given in each_given(trips):
        path = given if isinstance(given, Path) else None
        try:
            view = view_of(given, [])
            if track is None:
                track = empty_map(view.own_line)
            digest = "" if path is None else sha256_of(path)
            with MapFile.of_map(replace(track, layers={})) as ledger:
                log = {"trip": view.name, "sha256": digest}
                why = ledger.reason(Recording("", log, view.identity))
            if why:
                held.append((view.name, why))
                continue
            pieces.append(
                evidence(view, track, layer=layer, weather=weather)
                if path is None
                else evidence_of_log(path, track, layer, weather, sha256=digest)
            )
        except TrainlogError as error:
            if path is None:
                raise
            raise type(error)(error.problem, file=path, remedy=error.remedy) from error
    if track is None:
        raise InputError("no trip was given", remedy="name trips or logs to build the map from")
    found, left_out = _updated(track, pieces)
    held += [(pieces[number].trip, why) for number, why in left_out.items()]
    return UpdatedMap(found, tuple(name for name, _ in held), tuple(why for _, why in held))


# ------------------------------------------------------------------------------ a map's file


@dataclass(frozen=True, slots=True)
class LogOutcome:
    """What became of a log that was given to a map.

    Attributes
    ----------
    log : str
        Its path.
    outcome : {"added", "held", "same drive", "not recorded", "refused", "refused before"}
        Counted from now on; this very log was there already; kept, but a fuller recording of the
        drive counts; whole, but its recorder never recorded what the map is made of; not usable;
        not added for the reason that an earlier update reported.
    trip, layer : str
        Empty where that is not known.
    reason : str
        Why it does not count, is held under another layer than the one given, or has no evidence.
    replaced : tuple of str
        Trips that counted until now, of which this is a fuller recording.
    damage : str
        What of the log is lost; empty if it is whole.
    recorded : str
        Rail condition that the trip itself states, where another was given; else empty.
    """

    log: str
    outcome: Outcome
    trip: str = ""
    layer: str = ""
    reason: str = ""
    replaced: tuple[str, ...] = ()
    damage: str = ""
    recorded: str = ""

    @property
    def sentence(self) -> str:
        """It in words."""
        name = f"trip '{self.trip}'"
        if self.outcome == "added":
            more = f", in place of {', '.join(self.replaced)}" if self.replaced else ""
            lost = f"; the log {self.damage}" if self.damage else ""
            other = f", though it states '{self.recorded}'" if self.recorded else ""
            none = f": {self.reason}" if self.reason else ""
            return f"{name} added to '{self.layer}'{other}{more}{lost}{none}"
        if self.outcome == "held":
            return f"{name}: in the map already, not counted again" + (
                f"; {self.reason}" if self.reason else ""
            )
        return self.reason


@dataclass(frozen=True, eq=False, repr=False)
class MapUpdate(Presented):
    """What became of the logs that were given to a map, and what the map holds now.

    Attributes
    ----------
    path : Path
    logs : tuple of LogOutcome
    trips, days : int
        That the map counts, and the days on which they ran.
    made : bool
        Whether there is a map file: none is begun without a trip.
    """

    path: Path
    logs: tuple[LogOutcome, ...]
    trips: int
    days: int
    made: bool = True

    @property
    def title(self) -> str:
        """What became of the logs."""
        return f"Update of {self.path}: {self.sentence}"

    def summary(self) -> dict[str, str]:
        """The first log that was refused."""
        return {each.outcome: each.sentence for each in self.refused[:1]}

    def facts(self) -> dict[str, Any]:
        """How many logs were added, held and refused."""
        numbers = {each.replace(" ", "_"): len(self.of(each)) for each in OUTCOMES}
        of_map = {"trips": self.trips, "days": self.days, "made": self.made}
        return {"map": str(self.path), **numbers, **of_map}

    def tables(self) -> list[WordTable]:
        """What became of each log."""
        columns = (
            *map(Column, ("log", "outcome", "trip", "layer", "reason")),
            Column("replaced", of=lambda log: Said(list(log.replaced), ", ".join(log.replaced))),
            *map(Column, ("damage", "recorded")),
        )
        title = f"Update of {self.path}"
        return [new_table(title, *columns, name="logs", usual=False).add_rows(self.logs)]

    @property
    def notes(self) -> list[str]:
        """What to do about logs without axle speeds."""
        remedy = "record wheel speeds, or name their columns in the profile and ingest again"
        return [f"a map needs the speed of a powered axle: {remedy}"] * bool(
            self.of("not recorded")
        )

    def of(self, *outcomes: Outcome) -> tuple[LogOutcome, ...]:
        """The logs with one of some outcomes; see `LogOutcome`."""
        return tuple(each for each in self.logs if each.outcome in outcomes)

    @property
    def added(self) -> tuple[LogOutcome, ...]:
        """The logs whose trips count from now on."""
        return self.of("added")

    @property
    def refused(self) -> tuple[LogOutcome, ...]:
        """The logs that could not be used, and that no earlier update reported."""
        return self.of("refused")

    @property
    def elsewhere(self) -> tuple[LogOutcome, ...]:
        """The logs that the map holds under another rail condition than the one given."""
        return tuple(each for each in self.of("held") if each.reason)

    @property
    def sentence(self) -> str:
        """The update in one sentence."""
        parts = [f"{counted(len(self.added), 'trip')} added"]
        for outcome, words in OUTCOMES.items():
            number = len(self.of(outcome)) if words else 0
            parts += [f"{number} {words}"] if number else []
            if outcome == "held" and self.elsewhere:
                parts[-1] += f" ({len(self.elsewhere)} under another rail condition)"
        stated = Counter((each.recorded, each.layer) for each in self.logs if each.recorded)
        parts += [
            f"{counted(number, 'trip')} that state{'s' * (number == 1)} '{recorded}'"
            f" count{'s' * (number == 1)} as '{layer}', as given"
            for (recorded, layer), number in sorted(stated.items())
        ]
        held = f"the map holds {counted(self.trips, 'trip')} of {counted(self.days, 'day')}"
        return f"{', '.join(parts)}; {held if self.made else 'no map was made'}"


def update_map(
    logs: str | Path | Iterable[str | Path],
    path: str | Path,
    layer: str | None = None,
    weather: Weather | None = None,
    *,
    retry: bool = False,
    report: Callable[[LogOutcome], None] | None = None,
) -> MapUpdate:
    """Add the trips of logs to the file of a track-condition map.

    Several processes may do so at once. A trip is on the disk, once, when it is reported; whatever
    interrupts the update afterwards, giving the same logs again adds the others. What counts does
    not depend on the order in which logs come: of several recordings of one drive the fullest, in
    place of a poorer one that was there (see `trainlog.identity`). A log that cannot be used is
    reported and does not keep the others from being added. The map remembers it by its content:
    later updates state it as ``"refused before"``, and try it again where code, `layer` or
    `weather` are others.

    Parameters
    ----------
    logs : path or iterable of paths
        Logs, and folders of logs.
    path : path
        The map's file (``.map``); begun on the line of the first log if it does not exist.
    layer : str, optional
        Rail condition of all trips, one that is known or ``"new:grease"``; default: what each
        states (metadata ``weather``). That it is another than a trip states is reported.
    weather : Weather, optional
        At the line: the rail's condition where neither the call nor the trip states it, and what
        is kept with each trip.
    retry : bool, optional
        Try logs that were refused before again, and report those that are refused as new.
    report : callable, optional
        Is given the outcome of each log.

    Returns
    -------
    MapUpdate

    Raises
    ------
    InputError
        If the map cannot be read or written, or no log was given.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     first = update_map("sample_logs", Path(folder) / "wil.map")
    ...     again = update_map("sample_logs/nonstop.mcap", Path(folder) / "wil.map")
    >>> first.sentence
    '2 trips added; the map holds 2 trips of 1 day'
    >>> again.sentence
    '0 trips added, 1 held already; the map holds 2 trips of 1 day'
    """
    if layer is not None:
        layer = given_condition(layer, known_layers(Path(path)))
    update = FileUpdate(Path(path), layer, weather, retry)
    try:
        outcomes = outcomes_of(logs, update.outcome, report)
        trips, days = update.file.amount() if update.file else (0, 0)
    finally:
        update.close()
    return MapUpdate(update.path, outcomes, trips, days, made=update.file is not None)


def outcomes_of(
    logs: str | Path | Iterable[str | Path],
    outcome: Callable[[Path], LogOutcome],
    report: Callable[[LogOutcome], None] | None,
) -> tuple[LogOutcome, ...]:
    """What became of each log, and of each of the logs in folders; reported as it is known."""
    found: list[LogOutcome] = []
    given = [logs] if isinstance(logs, str | Path) else [*logs]
    if isinstance(logs, Trip) or not all(isinstance(each, str | Path) for each in given):
        raise InputError(
            "a map is updated from logs, by which it knows what it holds",
            remedy="write the trip first, with trainlog.write",
        )
    for log in (log for each in given for log in logs_of(Path(each))):
        found.append(outcome(log))
        if report is not None:
            report(found[-1])
    if not found:
        raise InputError("no log was given", remedy="name logs, or folders of logs")
    return tuple(found)


def refusal_of(error: TrainlogError, log: Path) -> str:
    """Why a log cannot be used, with its path."""
    return str(error if error.file else type(error)(error.problem, file=log, remedy=error.remedy))


def known_layers(path: Path) -> Iterator[str]:
    """The rail conditions of a map's file, read when they are asked for; none without a file."""
    if path.exists():
        with MapFile(path) as file:
            yield from file.contents()


class FileUpdate:
    """An update of a map's file, which is begun with the first trip if it is not there.

    Parameters
    ----------
    path : Path
    layer, weather, retry
        As of `update_map`.
    edge : str
        Of a network, that the map is of; its logs are given with their edges.
    """

    def __init__(
        self,
        path: Path,
        layer: str | None,
        weather: Weather | None,
        retry: bool,
        edge: str = "",
    ) -> None:
        self.path, self.layer, self.weather, self.retry = path, layer, weather, retry
        self.edge = edge
        self.file = MapFile(path) if path.exists() else None
        self._refusals: dict[str, Refusal] = {}
        """Not in the file yet, by SHA-256."""

    def close(self) -> None:
        """Close the file, with what is to be remembered."""
        if self.file is None:
            return
        try:
            if self._refusals:
                self.file.remember_refusals(self._refusals.values())
        finally:
            self.file.close()

    def outcome(
        self, log: Path, digest: str = "", on_edges: LogOnEdges | None = None
    ) -> LogOutcome:
        """Add a log's trip, if it is usable and new; `digest`: its SHA-256, if it is known."""
        try:
            state = _state(log)
            known = self.file.digest_of(log, state) if self.file else ""
            digest = known or digest or sha256_of(log)
        except TrainlogError as error:
            return LogOutcome(str(log), "refused", reason=str(error))
        found = _held(self.file, log, digest, self.layer) or self._refused_before(log, digest)
        found = found or self._tried(log, state, digest, on_edges)
        remembered = found.outcome != "refused" or digest in self._refusals
        # Then a later change of the file would show in the time of its last one.
        settled = time.time_ns() - state.st_mtime_ns > _SETTLED
        if self.file and not known and remembered and settled:
            self.file.remember(log, state, digest)
        return found

    def _tried(
        self, log: Path, state: stat_result, digest: str, on_edges: LogOnEdges | None
    ) -> LogOutcome:
        """The outcome of a log that the map does not hold."""
        try:
            piece, track, damage = self.analysed(log, digest, on_edges)
        except TrainlogError as error:
            if _has_changed(log, state) or isinstance(error.__cause__, OSError):
                # Not because of what the log holds.
                return LogOutcome(str(log), "refused", reason=str(error))
            return self._refused(log, digest, error)
        if _has_changed(log, state):
            remedy = "give it again when its recording has ended"
            changed = InputError("changed while it was read", file=log, remedy=remedy)
            return LogOutcome(str(log), "refused", piece.trip, piece.layer, str(changed))
        self.file = self.file or MapFile(self.path, track)
        recorded = self._stated(log, on_edges) if self.layer is not None else ""
        found = _added(self.file, log, piece, damage)
        return found if recorded in ("", self.layer) else replace(found, recorded=recorded)

    def _stated(self, log: Path, on_edges: LogOnEdges | None) -> str:
        """The rail condition that the trip of a log states itself; empty if it states none."""
        from trainlog.mcap import read_log

        trip = read_log(log, topics=[]) if on_edges is None else on_edges.trip
        return stated_condition(trip.metadata, self.edge)

    def analysed(
        self, log: Path, digest: str, on_edges: LogOnEdges | None = None
    ) -> tuple[Evidence, TrackConditionMap, str]:
        """The evidence of a log, the map that it is for, without trips, and what of it is lost.

        Raises
        ------
        TrainlogError
            If the log cannot be used, naming its file.
        """
        from analysis.adhesion.evidence import evidence_of_log, own_line
        from trainlog.mcap import read_log

        with naming_log(log) as losses:
            known = self.file.without_evidence if self.file else None
            given = (self.layer, self.weather)
            if on_edges is None:
                track = known or empty_map(own_line(read_log(log, topics=[])))
                piece = evidence_of_log(log, track, *given, sha256=digest)
            else:
                edge = next(each for each in on_edges.edges if each.name == self.edge)
                track = known or empty_map_of(edge.name, edge.length)
                piece = on_edges.evidence_on(edge, track, *given, digest)
        return piece, track, losses[-1] if losses else ""

    def _refused_before(self, log: Path, digest: str) -> LogOutcome | None:
        """The outcome of a log that was refused when nothing else was given; else None."""
        found = self.file.refusal(digest) if self.file and not self.retry else None
        if found is None or found.tried != self._conditions:
            return None
        return LogOutcome(str(log), "refused before", reason=found.reason)

    def _refused(self, log: Path, digest: str, error: TrainlogError) -> LogOutcome:
        """The outcome of a log that is refused now, which is remembered."""
        reason = str(error)
        new = Refusal(digest, str(log), reason, self._conditions)
        earlier = self.file.refusal(digest) if self.file else None
        self._refusals[digest] = new
        again = earlier is not None and not self.retry and earlier.is_repeated_by(new)
        kind: Outcome = "not recorded" if isinstance(error, NotRecordedError) else "refused"
        return LogOutcome(str(log), "refused before" if again else kind, reason=reason)

    @cached_property
    def _conditions(self) -> str:
        """What the outcome of a log depends on besides what it holds."""
        known = "" if self.weather is None else sha256(pickle.dumps(astuple(self.weather)))
        return f"{code_version()} {self.layer or ''} {known}"


def _state(log: Path) -> stat_result:
    try:
        return log.stat()
    except OSError as error:
        refuse_reading(log, error)


def _has_changed(log: Path, before: stat_result) -> bool:
    now = _state(log)
    return (now.st_size, now.st_mtime_ns) != (before.st_size, before.st_mtime_ns)


def _held(file: MapFile | None, log: Path, digest: str, layer: str | None) -> LogOutcome | None:
    """The outcome of a log that the map holds; None if it does not."""
    row = file.held(digest) if file else None
    if row is None:
        return None
    known = row.known
    other = f"as '{row.layer}', not as '{layer}': take it out first (trainlog map remove)"
    reason = other if layer is not None and layer != row.layer else ""
    return LogOutcome(str(log), "held", known.name, row.layer, reason)


@contextmanager
def naming_log(log: Path) -> Iterator[list[str]]:
    """Name the log in errors; gives what of it is lost, in sentences, once the block has run."""
    losses: list[str] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield losses
    except TrainlogError as error:
        kind = type(error)
        if isinstance(error, NotRecordedError) and (
            _losses(caught) or _holds_topic(log, error.topic)
        ):
            kind = LogError  # what it lacks may be what is lost, or was not read
        if error.file and kind is type(error):
            raise
        raise kind(error.problem, file=log, remedy=error.remedy) from error
    for each in caught:
        warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    losses += _losses(caught)


def _holds_topic(log: Path, topic: str) -> bool:
    """Whether a log has a channel of the topic, so that it was recorded."""
    from trainlog.mcap import read_log

    return bool(topic) and topic in read_log(log, topics=[topic])


def _losses(caught: Iterable[warnings.WarningMessage]) -> list[str]:
    """What is lost of a log, by the warnings of reading it."""
    from trainlog.mcap import DamageWarning

    return [
        each.message.account.sentence for each in caught if isinstance(each.message, DamageWarning)
    ]


def _added(file: MapFile, log: Path, piece: Evidence, damage: str) -> LogOutcome:
    details = {"damage": damage} if damage else {}
    found = file.append(recording_of(piece, **details))
    outcome: Outcome = "held" if found.held else "added" if found.counted else "same drive"
    reason = found.reason
    if outcome == "added" and not any(each.days.size for each in piece.layers.values()):
        reason = "; ".join(["no evidence", *piece.details.get("notes", ())])
    return LogOutcome(str(log), outcome, piece.trip, piece.layer, reason, found.replaced, damage)

"""What one trip shows of a line's maximum adhesion, bin by bin.

Onsets of slip measure the maximum adhesion; adhesion used without slip bounds it from below.
Weights and weighted logarithms are fixed-point numbers, so that sums over trips are exact whatever
their order.

`trainlog.condition` makes the estimate of these sums.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from analysis.adhesion.slip import TOPICS, SlipAnalysis, joined_details, slip
from analysis.view import TripView, view_of, views_of
from trainlog.arrays import FloatArray, IntArray
from trainlog.condition import setting
from trainlog.errors import LogError, NotRecordedError
from trainlog.formats.railway import line_of
from trainlog.identity import TripIdentity
from trainlog.mcap import read_log
from trainlog.mcap.reader import identity_of_log
from trainlog.railway.condition import DIRECTIONS, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence, fixed
from trainlog.railway.line import Line
from trainlog.railway.weather import Weather, check_condition, stated_condition, sun_elevation
from trainlog.trip import LINE_ATTACHMENT, Trip
from trainlog.units import DAY, NANOSECONDS

COVARIATE_TOPICS = ("/environment",)
"""What `covariates` takes of a log."""

STEP = 60 * NANOSECONDS
"""Weather is averaged over a trip in steps of a minute."""

EARLIEST = pd.Timestamp("1990-01-01", tz="UTC")
"""No log of a train's axles is older."""

LONGEST_TRIP = 60 * DAY
"""A log whose samples lie further apart has a clock that jumped [ns]."""

ONE_WAY = 0.8
"""Share of its places that a trip in one direction lies between its ends."""

POSITION_MARGIN = 5.0
"""Samples this close to the edge of a bin [m] bound no maximum: they may belong to the next."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What one trip says of a line's maximum adhesion, by bin.

    Attributes
    ----------
    line : str
    length, bin_length : float [m]
    layer : str
        Rail condition; where it changed on the way the one that held longest.
    trip : str
    sha256 : str
        Of the log; empty where there is no file.
    daily : DailyEvidence
        In that rail condition, by the day on which each bin was passed.
    details : dict
        What the map keeps of the trip beside its name: see `SlipAnalysis.details`.
    recorded : TripIdentity, optional
        Which drive the trip is; None: not known.
    steps : int
        Of processing since it was recorded: of equally full recordings of a drive that of the
        fewest is counted.
    further : dict of str to DailyEvidence
        In other rail conditions, where the weather changed on the way.
    span : (int, int) [ns since 1970 UTC]
        First and last sample.
    """

    line: str
    length: float
    bin_length: float
    layer: str
    trip: str
    sha256: str
    daily: DailyEvidence
    details: dict[str, Any] = field(default_factory=dict)
    recorded: TripIdentity | None = None
    steps: int = 0
    further: dict[str, DailyEvidence] = field(default_factory=dict)
    span: tuple[int, int] = (0, 0)

    @property
    def layers(self) -> dict[str, DailyEvidence]:
        """All evidence by rail condition."""
        return {self.layer: self.daily, **self.further}


def evidence(
    trip: Trip | TripView,
    track: TrackConditionMap,
    *,
    sha256: str = "",
    layer: str | None = None,
    weather: Weather | None = None,
) -> Evidence:
    """What a trip that carries its line and its train says of the maximum adhesion.

    Parameters
    ----------
    trip : Trip or TripView
    track : TrackConditionMap
        Whose bins and settings are used; it may be empty (`empty_map`).
    sha256 : str
        Of the log file, so that it is never counted twice.
    layer : str, optional
        Rail condition; see `condition_of`.
    weather : Weather, optional
        At the line: the rail's condition where neither the call nor the trip states it, and what
        is kept beside the evidence.

    Raises
    ------
    LogError
        If the rail condition is not known, or slip cannot be analysed
        (`analysis.adhesion.slip.slip`).
    """
    view = view_of(trip)
    found = slip(view)  # what the recording lacks goes before a condition that is not stated
    condition = condition_of(view.trip, track, layer, weather)
    return with_details([found], view.trip, track, condition, weather, sha256=sha256,
                        recorded=view.identity)  # fmt: skip


def evidence_of_log(
    path: Path,
    track: TrackConditionMap,
    layer: str | None = None,
    weather: Weather | None = None,
    *,
    sha256: str = "",
) -> Evidence:
    """What the trip of a log says of the maximum adhesion, of a long log all its parts together.

    Parameters and errors are those of `evidence`, for a log.
    """
    views = views_of(path, (*TOPICS, *COVARIATE_TOPICS))
    first = next(views)
    if first.count == 1:
        return evidence(first, track, sha256=sha256, layer=layer, weather=weather)
    trip = read_log(path, topics=COVARIATE_TOPICS)
    condition = condition_of(trip, track, layer, weather)
    found = with_details(slips_of(chain([first], views)), trip, track, condition, weather,
                         sha256=sha256, recorded=identity_of_log(path))  # fmt: skip
    return replace(found, trip=trip.name)


def slips_of(views: Iterable[TripView]) -> Iterator[SlipAnalysis]:
    """The slip analysis of a trip, or of each part of it in which axles were recorded."""
    for view in views:
        if view.count == 1 or len(view.trip["/train/axles"]) > 1:
            yield slip(view)


def with_details(
    parts: Iterable[SlipAnalysis],
    trip: Trip,
    track: TrackConditionMap,
    layer: str | Weather,
    weather: Weather | None = None,
    *,
    sha256: str = "",
    recorded: TripIdentity | None = None,
) -> Evidence:
    """As `evidence_of`, with the drive, the steps and the weather of the trip."""
    found = evidence_of(parts, track, layer, sha256=sha256)
    details = found.details | covariates(trip, found.span, weather)
    return replace(found, recorded=recorded, steps=len(trip.provenance), details=details)


def own_line(trip: Trip) -> Line:
    """The line of a trip in its own direction."""
    return view_of(trip).own_line


def condition_of(
    trip: Trip,
    track: TrackConditionMap,
    layer: str | None = None,
    weather: Weather | None = None,
    edge: str = "",
) -> str | Weather:
    """The rail condition of a trip on the map's line, or the weather that states it over time.

    The first of these that there is: the `layer` given; what the trip itself states (metadata
    ``weather``, or ``weather_by_edge`` of an `edge` of its route), which who drove or recorded it
    saw; the `weather` at the line.

    Raises
    ------
    LogError
        If none of them is known.
    InputError
        If the trip is on another line, or the condition cannot be one or is misspelt
        (`trainlog.railway.weather.check_condition`).
    """
    line = line_of(trip)
    track.check_line(line.name, line.length, 0.0, f"trip '{trip.name}'")
    condition = layer or stated_condition(trip.metadata, edge)
    if condition:
        return check_condition(condition, track.layers)
    if weather is not None:
        return weather
    raise LogError(
        f"trip '{trip.name}' does not state the rail's condition, such as dry or wet",
        remedy="give the layer (--layer wet) or a weather file (--weather), or ingest the recording"
        " with --set weather=wet",
    )


def evidence_of(
    analysed: SlipAnalysis | Iterable[SlipAnalysis],
    track: TrackConditionMap,
    layer: str | Weather,
    *,
    sha256: str = "",
) -> Evidence:
    """Evidence of a trip that was analysed, whole or part by part; arguments as for `evidence`.

    All onsets of one bin are one measurement of that trip: their mean, with what they differ by
    and the trip's own deviation. A bin without one counts once, at the highest level that was used
    in it (less one standard deviation, since the highest of noisy values is too high).

    Where weather states the rail's condition, what was seen counts for the condition that held
    then. What was seen while it states none is left out, with a note.

    Raises
    ------
    LogError
        If weather states no condition for any of the trip.
    """
    sums: dict[str, _Sums] = {}
    trip, details, clocks = "", dict[str, Any](), []
    places: list[FloatArray] = []
    for part in [analysed] if isinstance(analysed, SlipAnalysis) else analysed:
        trip, details = part.trip, joined_details(details, part.details)
        clocks.append(part.time.as_unit("ns").asi8[[0, -1] if part.time.size else []])
        places.append(part.position[np.isfinite(part.position)])
        for condition, seen in _by_condition(part, layer):
            sums.setdefault(condition, _Sums(track)).add(seen)
    left_out = sums.pop("", None)
    if not clocks:
        raise NotRecordedError(
            "no speed of a powered axle is recorded in it",
            remedy="record wheel speeds, or name their columns in the profile",
        )
    times = np.concatenate(clocks)
    start, end = (int(times.min()), int(times.max())) if times.size else (0, 0)
    _check_dates(trip, start, end)
    if not sums:
        first, last = (f"{pd.Timestamp(each):%Y-%m-%d %H:%M}" for each in (start, end))
        raise LogError(
            f"trip '{trip}': the weather states no rail condition from {first} to {last} UTC",
            remedy="extend the weather file, or give the layer (--layer wet)",
        )
    if left_out is not None:
        words = f"rail condition not known for {left_out.seconds / 60.0:.0f} min: left out"
        details = joined_details(details, {"notes": [words]})
    if direction := _direction_of(np.concatenate(places)):
        details = details | {"direction": direction}
    # Of two that held equally long the first by name.
    longest = min(sums, key=lambda name: (-sums[name].seconds, name))
    return Evidence(
        line=track.line,
        length=track.length,
        bin_length=track.bin_length,
        layer=longest,
        trip=trip,
        sha256=sha256,
        daily=sums[longest].evidence(),
        details=details,
        further={name: each.evidence() for name, each in sorted(sums.items()) if name != longest},
        span=(start, end),
    )


def _direction_of(position: FloatArray) -> str:
    """The direction in which a trip passed most of its places (n,); empty if it ran both ways."""
    if position.size < 2:
        return ""
    way = float(position[-1] - position[0])
    if abs(way) < ONE_WAY * float(np.ptp(position)):
        return ""
    return DIRECTIONS[0] if way > 0.0 else DIRECTIONS[1]


def _check_dates(trip: str, start: int, end: int) -> None:
    """Refuse a trip whose dates no recorder can have had: its days would be those of the evidence.

    Raises
    ------
    LogError
    """
    first, last = (pd.Timestamp(each, tz="UTC") for each in (start, end))
    if start and (first < EARLIEST or end - start > LONGEST_TRIP):
        raise LogError(
            f"trip '{trip}' is dated {first:%Y-%m-%d} to {last:%Y-%m-%d}",
            remedy="correct the recorder's clock: ingest the recording again with the day before"
            " which the recorder did not exist in its profile (not_before in [limits])",
        )


def _by_condition(part: SlipAnalysis, layer: str | Weather) -> Iterator[tuple[str, SlipAnalysis]]:
    """A part of a trip, cut where the rail's condition changes."""
    if isinstance(layer, str) or not part.time.size:
        yield layer if isinstance(layer, str) else "", part
        return
    clock = part.time.as_unit("ns").asi8
    # An onset may have been detected with the last sample.
    for start, end, condition in layer.spans(int(clock[0]), int(clock[-1]) + 1):
        yield condition, part.part((start, end))


class _Sums:
    """What is gathered of one trip in one rail condition."""

    def __init__(self, track: TrackConditionMap) -> None:
        self.track = track
        self.highest = np.zeros(track.bins)
        self.day = np.full(track.bins, -1, dtype=np.int64)
        self.onsets: list[pd.DataFrame] = []
        self.common_std, self.passage_std, self.seconds = 0.0, 0.0, 0.0

    def add(self, part: SlipAnalysis) -> None:
        """Gather what one part shows."""
        events = part.events
        known = events["measured"] & events["position"].between(0.0, self.track.length)
        self.onsets.append(events[known])
        self.highest = np.maximum(self.highest, _highest(part, self.track))
        self.day = np.maximum(self.day, _last_day(part, self.track))
        self.common_std = max(self.common_std, part.common_std)
        self.passage_std = max(self.passage_std, part.passage_std)
        if part.time.size:
            self.seconds += (part.time[-1] - part.time[0]).total_seconds()

    def evidence(self) -> DailyEvidence:
        """What it amounts to."""
        track, onsets = self.track, pd.concat(self.onsets)
        place = track.bin_of(onsets["position"])
        log_adhesion = np.log(onsets["adhesion"].to_numpy())
        precision = (onsets["adhesion"] / onsets["adhesion_std"]).to_numpy() ** 2

        def summed(values: FloatArray | None) -> FloatArray:
            return np.bincount(place, values, minlength=track.bins).astype(np.float64)

        events, total = summed(None), summed(precision)
        seen = events > 0
        safe = np.where(seen, total, 1.0)
        passage = np.hypot(setting(track, "trip_std"), self.passage_std)
        spread = np.hypot(passage, np.sqrt(1.0 / safe))
        weight = np.where(seen, fixed(spread**-2), 0.0)
        # What all onsets of the trip err by alike does not become less with their number.
        alike = np.hypot(onsets["delay_std"], onsets["transfer_std"]) / onsets["adhesion"]
        shared = summed(precision * alike.to_numpy()) / safe
        mean = summed(precision * log_adhesion) / safe
        # The level that each bin without a measured onset was seen to bear, as a histogram.
        level = np.searchsorted(track.levels, self.highest, side="right") - 1
        rows = np.flatnonzero((level >= 0) & ~seen)
        censored = np.zeros((track.bins, track.levels.size))
        censored[rows, level[rows]] = 1.0
        return DailyEvidence.of_bins(
            self.day,
            events,
            weight,
            fixed(weight * mean),
            censored,
            weighted_square=fixed(weight * mean**2),
            common=fixed(weight**2 * (self.common_std**2 + shared**2)),
        )


def _last_day(analysis: SlipAnalysis, track: TrackConditionMap) -> IntArray:
    """Day on which each bin was passed, counted from 1970-01-01 in UTC; -1: not passed; (bins,)."""
    day = np.full(track.bins, -1, dtype=np.int64)
    known = (analysis.position >= 0.0) & (analysis.position <= track.length)
    passed = analysis.time[known].as_unit("ns").asi8 // DAY
    np.maximum.at(day, track.bin_of(analysis.position[known]), passed)
    onsets = analysis.events[analysis.events["position"].between(0.0, track.length)]
    start = pd.DatetimeIndex(onsets["start"]).as_unit("ns").asi8 // DAY
    np.maximum.at(day, track.bin_of(onsets["position"]), start)
    return day


def _highest(analysis: SlipAnalysis, track: TrackConditionMap) -> FloatArray:
    """Highest adhesion that each bin was seen to bear, (bins,)."""
    size = np.abs(analysis.adhesion)
    alike = np.hypot(analysis.common_std, analysis.passage_std)
    spread = np.hypot(analysis.adhesion_std, alike * size)
    # An axle that was not recorded says nothing.
    used = np.fmax.reduce(size - spread, axis=1)
    margin = min(POSITION_MARGIN, 0.25 * track.bin_length)
    within = np.mod(analysis.position, track.bin_length)
    known = np.isfinite(used) & (within >= margin) & (within <= track.bin_length - margin)
    known &= (analysis.position >= 0.0) & (analysis.position <= track.length)
    highest = np.zeros(track.bins)
    np.maximum.at(highest, track.bin_of(analysis.position[known]), used[known])
    return highest


# ---------------------------------------------------------------------------------- weather


def covariates(trip: Trip, span: tuple[int, int], weather: Weather | None = None) -> dict[str, Any]:
    """Weather of a trip, as the map keeps it: the entry ``weather``, in SI units.

    The air temperature is what the train measured (topic ``/environment``), else that of the
    weather; humidity, precipitation and time since rain are the weather's. What is not known is
    left out.

    Parameters
    ----------
    trip : Trip
        Of which the topics `COVARIATE_TOPICS` are used, if it has them.
    span : (int, int) [ns since 1970 UTC]
        First and last sample of its evidence.
    weather : Weather, optional
        At the line.

    Returns
    -------
    dict
        ``weather``: ``time``, the middle of the trip; means over the trip ``temperature`` [K],
        ``temperature_source`` (``log``, ``weather``), ``head_wind`` [m/s], ``humidity``,
        ``precipitation`` [m/s]; at its middle ``since_rain`` [s], ``condition`` of the rail as the
        weather states it, and ``sun_elevation`` [deg], where the line knows where it lies.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/nonstop.mcap", topics=COVARIATE_TOPICS)
    >>> kept = covariates(trip, (trip.start.value, trip.end.value))["weather"]
    >>> kept["temperature"], kept["temperature_source"], kept["time"]
    (283.86, 'log', '2024-10-07T06:09:52Z')
    """
    start, end = span
    middle = (start + end) // 2
    found: dict[str, Any] = {
        "time": f"{pd.Timestamp(middle, tz='UTC').round('s'):%Y-%m-%dT%H:%M:%SZ}"
    }
    for column, name in (("air_temperature", "temperature"), ("head_wind", "head_wind")):
        values = _measured(trip, column)
        if values.size:
            found[name] = round(float(values.mean()), 2)
    if "temperature" in found:
        found["temperature_source"] = "log"
    if weather is not None:
        found = _of_weather(weather, start, end) | found
    position = line_of(trip).geometry if LINE_ATTACHMENT in trip.attachments else None
    if position is not None:
        place = float(np.mean(position.latitudes)), float(np.mean(position.longitudes))
        found["sun_elevation"] = round(sun_elevation(middle, *place), 1)
    return {"weather": dict(sorted(found.items()))}


def _measured(trip: Trip, column: str) -> FloatArray:
    """What the train measured of its surroundings, where it did, (n,)."""
    if "/environment" not in trip:
        return np.empty(0)
    values = trip["/environment"][column].to_numpy(np.float64)
    return np.asarray(values[np.isfinite(values)])


def _of_weather(weather: Weather, start: int, end: int) -> dict[str, Any]:
    """What the weather states of a trip."""
    rows = weather.row_at(np.arange(start, end + 1, STEP, dtype=np.int64))
    rows = rows[rows >= 0]
    found: dict[str, Any] = {}
    for name, digits in (("temperature", 2), ("humidity", 3), ("precipitation", 12)):
        values = getattr(weather, name)[rows]
        if np.isfinite(values).any():
            found[name] = round(float(np.nanmean(values)), digits)
    if "temperature" in found:
        found["temperature_source"] = "weather"
    there = weather.at((start + end) // 2)
    if there is not None:
        known = there.known()
        found |= {name: known[name] for name in ("condition", "since_rain") if name in known}
    return found

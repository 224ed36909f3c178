"""Sections of a report on one trip: course, stops, energy, slip, recording and provenance."""

from __future__ import annotations

import shlex
from collections.abc import Hashable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from analysis.adhesion.slip import SlipAnalysis, slip
from analysis.charts import (
    BLUE,
    GREEN,
    PURPLE,
    RED,
    SKY,
    Chart,
    Curve,
    Panel,
    gradient_panel,
    limit_curve,
    rows_to_draw,
    worded,
)
from analysis.comparison.groups import RECORDED_PART, TripCost, trip_cost
from analysis.reports.answers import Verdict, slip_words, summary_section, verdict
from analysis.reports.page import Part, Section, Warned
from analysis.view import SHORTEST_STOP, TOPICS, TripView, view_of
from trainlog.arrays import FloatArray
from trainlog.display import counted, lateness
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.railway import line_of, passport_of
from trainlog.ingest.recording import report_of
from trainlog.mcap import describe
from trainlog.mcap.description import LogDescription, recorded_fields
from trainlog.presentation import Columns, WordTable, facts_table, kwh, word_table
from trainlog.railway import Line
from trainlog.railway.line import in_km, station_at
from trainlog.resampling import interpolated
from trainlog.spans import runs_of, zone_of
from trainlog.topics import REFERENCE, STANDSTILL, TRAIN_CONTROLS
from trainlog.trip import POSITION_TOPICS, Trip
from trainlog.units import KMH, PER_MILLE, clock

MOST_EVENTS = 20
"""Slip events that are listed one by one."""

_READ = tuple(dict.fromkeys((*POSITION_TOPICS, *TOPICS)))


@dataclass(frozen=True)
class Zone:
    """The clock in which times are stated, that of the timetable.

    Attributes
    ----------
    name : str
        Such as ``"Europe/Zurich"``.
    """

    name: str = "UTC"

    def time(self, moment: pd.Timestamp) -> str:
        """The time of day, to the second.

        Examples
        --------
        >>> Zone("Europe/Zurich").time(pd.Timestamp("2024-10-07T06:00:16.7Z"))
        '08:00:17'
        """
        return f"{self._local(moment):%H:%M:%S}"

    def date(self, moment: pd.Timestamp) -> str:
        """Day and time of day, to the second."""
        return f"{self._local(moment):%Y-%m-%d %H:%M:%S}"

    def times(self, moments: pd.DatetimeIndex) -> list[str]:
        """The times of day of many moments."""
        # Local times come twice, or never, where clocks are set: round before.
        return [f"{each:%H:%M:%S}" for each in moments.round("s").tz_convert(self.name)]

    def _local(self, moment: pd.Timestamp) -> pd.Timestamp:
        return moment.round("s").tz_convert(self.name)


def known_zone(name: str) -> Zone:
    """The clock of a zone.

    Raises
    ------
    InputError
        If there is no such zone.

    Examples
    --------
    >>> known_zone("Europe/Zurich").name
    'Europe/Zurich'
    """
    zone_of(name)
    return Zone(name)


@dataclass(frozen=True)
class StationCall:
    """A station, or a place on the line, where a train stops or that it passes.

    Attributes
    ----------
    name : str
        Of the station; empty where the train stood between stations.
    position : float [m]
        Chainage in the direction of travel.
    arrival, departure : Timestamp or None
        Both the same where it is passed; None at the ends of the trip.
    stopped : bool
    """

    name: str
    position: float
    arrival: pd.Timestamp | None
    departure: pd.Timestamp | None
    stopped: bool

    @property
    def dwell(self) -> float | None:
        """How long it stood there [s]; None at the ends of the trip, and where it did not."""
        if not self.stopped or self.arrival is None or self.departure is None:
            return None
        return float((self.departure - self.arrival).total_seconds())


@dataclass(frozen=True, eq=False)
class Motion:
    """Where a train was when, and how fast: the samples of which all is known.

    Attributes
    ----------
    time : (n,) DatetimeIndex
    position : (n,) array [m]
    speed : (n,) array [m/s]
    """

    time: pd.DatetimeIndex
    position: FloatArray
    speed: FloatArray

    @staticmethod
    def of(trip: Trip) -> Motion:
        """From the first topic that knows a position and a speed; empty if none does."""
        for name in reversed(POSITION_TOPICS):
            frame = trip.topics.get(name)
            if frame is None or not {"position", "speed"} <= set(frame.columns):
                continue
            place, speed = (frame[each].to_numpy(np.float64) for each in ("position", "speed"))
            known = np.isfinite(place) & np.isfinite(speed)
            if known.any():
                time = pd.DatetimeIndex(frame.index)[known]
                return Motion(time, place[known], speed[known])
        nothing = np.empty(0)
        return Motion(pd.DatetimeIndex([], tz="UTC"), nothing, nothing)


def station_calls(motion: Motion, line: Line | None) -> tuple[StationCall, ...]:
    """Where a trip began and ended, stopped and passed, in the order of time.

    Parameters
    ----------
    motion : Motion
    line : Line, optional
        As the train met it; without it the stops have no names.

    Examples
    --------
    >>> import trainlog
    >>> from trainlog.formats.railway import line_of
    >>> trip = trainlog.read("sample_logs/stopping.mcap")
    >>> calls = station_calls(Motion.of(trip), line_of(trip))
    >>> [(call.name, call.dwell) for call in calls if call.dwell]
    [('Gossau SG', 41.5), ('Flawil', 44.7), ('Uzwil', 41.0)]
    """
    if not motion.position.size:
        return ()
    stations = () if line is None else line.stations
    calls = list(_stops(motion, line))
    stopped = {call.name for call in calls}
    for station in stations:
        beyond = motion.position >= station.position
        if station.name in stopped or not beyond.any() or beyond[0]:
            continue
        when = motion.time[int(np.argmax(beyond))]
        calls.append(StationCall(station.name, station.position, when, when, stopped=False))
    return tuple(sorted(calls, key=lambda call: call.arrival or motion.time[0]))


def _stops(motion: Motion, line: Line | None) -> Iterator[StationCall]:
    standing = motion.speed <= STANDSTILL
    last = motion.time.size - 1
    spans = runs_of(standing)
    if not spans or spans[0][0] > 0:
        spans.insert(0, (0, 0))
    if spans[-1][1] <= last:
        spans.append((last, last + 1))
    for begin, end in spans:
        moves = motion.time[max(end - 1, begin)]
        lasts = (moves - motion.time[begin]).total_seconds()
        first, final = begin == 0, end > last
        if lasts < SHORTEST_STOP and not (first or final):
            continue
        place = float(motion.position[begin])
        name = "" if line is None else station_at(line, place)
        arrival = None if first else motion.time[begin]
        yield StationCall(name, place, arrival, None if final else moves, stopped=True)


# -------------------------------------------------------------------------------- the sections


def recorded_trip(log: Path) -> tuple[LogDescription, TripView, Verdict]:
    """A log's description, its trip with the topics that a report shows, and the verdict on it.

    Raises
    ------
    LogError
        If the file is no log, or holds no trip.
    """
    description = describe(log)
    held = {topic.name for topic in description.topics}
    damage = "" if description.account.whole else description.account.sentence
    view = replace(view_of(log, [name for name in _READ if name in held]), damage=damage)
    return description, view, verdict(view)


def trip_sections(log: Path, zone: Zone = Zone()) -> list[Section]:
    """What a report shows of the trip in a log.

    Raises
    ------
    LogError
        If the file is no log, or holds no trip.
    """
    description, view, judged = recorded_trip(log)
    trip = view.trip
    line = _line(trip)
    motion = Motion.of(trip)
    cost = _tried(lambda: trip_cost(view))
    slipped = _tried(lambda: slip(view))
    course = _tried(lambda: trip_charts(trip, zone=zone))
    course = [Warned(f"{course}.")] if isinstance(course, TrainlogError) else course
    # What follows from what the trip shows.
    name = shlex.quote(log.name)
    steps = ["see what is doubtful under Recording"] if judged.level else []
    if line is None:
        steps.append(f"{name} has no line: trainlog ingest RECORDING --line LINE -o FOLDER adds it")
    if isinstance(slipped, SlipAnalysis) and len(slipped.events) and line is not None:
        steps.append(f"add its slip to a map: trainlog map update {name} --map LINE.map")
    if judged.level < 2 and line is not None:
        steps.append(f"fit the running resistance: trainlog fit {name} -o parameters.json")
    steps.append(f"look at it over time and position: trainlog replay {name}")
    sections = [
        summary_section(
            _driven(trip, motion, line, zone, cost),
            str(judged),
            slip_words(slipped, line),
            _cost_words(cost),
            steps,
        ),
        Section("Speed and efforts", course),
        Section("Stops and stations", _stops_part(trip, motion, line, zone), folded=True),
        Section("Energy and time", _energy(cost), folded=True),
        Section("Slip", _slip(slipped, view, zone), folded=True),
        Section(
            "Recording",
            [
                *([Warned(view.damage)] if view.damage else []),
                *_quality(trip),
                *replace(
                    description, path=Path(log.name), recorded=recorded_fields(description)
                ).shown(),
            ],
            folded=True,
        ),
    ]
    return [section for section in sections if section.parts]


def _tried(made: Any) -> Any:
    """What a function returns, or the error that states why it cannot."""
    try:
        return made()
    except TrainlogError as error:
        return error


def _line(trip: Trip) -> Line | None:
    with suppress(TrainlogError):
        return line_of(trip)
    return None


def _driven(trip: Trip, motion: Motion, line: Line | None, zone: Zone, cost: object) -> list[str]:
    """From where to where, when, how far, how long, by which train."""
    calls = station_calls(motion, line)
    ends = [each.name for each in calls if each.stopped and each.name]
    words = [f"{ends[0]} to {ends[-1]}"] if len(ends) > 1 else []
    if isinstance(cost, TripCost):
        stops = counted(cost.stops, "stop") + " on the way"
        words.append(
            f"{cost.distance / 1e3:.1f} km in {clock(cost.running_time + cost.dwell)}, {stops}"
        )
    rail = trip.metadata.get("weather", "")
    by = ", ".join(filter(None, [trip.metadata.get("train", ""), f"{rail} rail" if rail else ""]))
    when = f"{zone.date(motion.time[0])} {zone.name}" if motion.time.size else ""
    return [": ".join(filter(None, [trip.name, ", ".join(words)])), by, when]


def _cost_words(cost: object) -> list[str]:
    if not isinstance(cost, TripCost):
        return [f"not known: {cost}"]
    if cost.unknown:
        there = ", not known there"
        gaps = [each.replace(there, "") for each in cost.notes if there in each]
        gaps += [each for each in cost.notes if each.startswith(RECORDED_PART)]
        words = [f"energy not known: {'; '.join(gaps) or 'efforts are missing'}"]
    else:
        drawn = "unknown energy" if np.isnan(cost.line) else kwh(cost.line)
        words = [f"{kwh(cost.traction)} of traction at the wheel rims; {drawn} from the line"]
        if cost.distance > 0.0:
            per_km = cost.traction / 3.6e6 / (cost.distance / 1e3)
            words.append(f"{per_km:.1f} kWh of traction per km")
    if cost.late is not None:
        words.append(f"on arrival {lateness(cost.late)}, against the trajectory")
    return words


def trip_charts(trip: Trip, *, zone: Zone = Zone()) -> list[Chart]:
    """Speed and efforts of a trip over km, and its speed over time.

    Parameters
    ----------
    trip : Trip
    zone : Zone
        The clock in which times are stated.

    Raises
    ------
    InputError
        If no speed with a position is recorded.

    Examples
    --------
    >>> import trainlog
    >>> [chart.x for chart in trip_charts(trainlog.read("sample_logs/stopping.mcap"))]
    ['km in the direction of travel', 'minutes since 08:00:00 UTC']
    """
    motion, line = Motion.of(trip), _line(trip)
    if not motion.position.size:
        raise InputError(
            f"trip '{trip.name}': no speed with a position is recorded",
            remedy="there is no course to draw: ingest the recording with the line",
        )
    efforts = _efforts(trip, motion.time)
    rows = rows_to_draw(motion.speed, *(values for _, _, values, _ in efforts[:2]))
    part = Motion(motion.time[rows], motion.position[rows], motion.speed[rows])
    forward, km = bool(np.all(np.diff(part.position) >= -50.0)), part.position / 1e3
    ends = float(motion.position.min()), float(motion.position.max())
    speeds = [] if line is None else [limit_curve(line, *ends)]
    speeds.append(_speed_curve(km, part, line, zone))
    areas = [
        Curve(label, km, values[rows] / 1e3, colour, "area", base[rows] / 1e3)
        for label, colour, values, base in efforts
    ]
    late = list[Panel]()
    reference = trip.topics.get(REFERENCE.name)
    if reference is not None and not reference.empty:
        speed, behind = (
            interpolated(reference, name, part.time, 5.0) for name in ("speed", "lateness")
        )
        speeds.append(Curve("trajectory", km, KMH * speed, GREEN, width=1.2))
        late = [Panel("s", [Curve("behind the trajectory", km, behind, PURPLE)], 0.5)]
    over_km = Chart(
        "km in the direction of travel",
        [
            Panel("km/h", speeds, 1.5, from_zero=True),
            *([Panel("kN", areas, 0.8)] if areas else []),
            *late,
            *([] if line is None else [gradient_panel(line, *ends)]),
        ],
        caption="Speed against the permitted speed; tractive effort above zero, braking below.",
        line=line,
    )
    minutes = (part.time - motion.time[0]).total_seconds().to_numpy() / 60.0
    over_time = Chart(
        f"minutes since {zone.time(motion.time[0])} {zone.name}",
        [Panel("km/h", [_speed_curve(minutes, part, line, zone)], 1.0, from_zero=True)],
    )
    return [over_km, over_time] if forward else [over_time]


def _speed_curve(x: FloatArray, part: Motion, line: Line | None, zone: Zone) -> Curve:
    hover = {
        "km": worded("{:.3f}", in_km(line, part.position)),
        "time": zone.times(part.time),
        "speed": worded("{:.1f} km/h", KMH * part.speed),
    }
    if line is not None:
        within = np.clip(part.position, 0.0, line.length)
        hover["permitted"] = worded("{:.0f} km/h", KMH * line.speed_limit(within))
        hover["gradient"] = worded("{:+.1f} ‰", PER_MILLE * line.gradient(within))
    return Curve("speed", x, KMH * part.speed, BLUE, hover=hover)


def _efforts(trip: Trip, time: pd.DatetimeIndex) -> list[tuple[str, str, FloatArray, FloatArray]]:
    """Tractive and braking efforts, as far as recorded: the latter below zero, one on the other.

    Of each its name, its colour, the effort [N] at each time, and where its area begins.
    """
    frame = trip.topics.get(TRAIN_CONTROLS.name)
    if frame is None or frame.empty:
        return []
    found, base = list[tuple[str, str, FloatArray, FloatArray]](), np.zeros(time.size)
    for label, name, sign, colour in (
        ("traction", "tractive_effort", 1.0, RED),
        ("dynamic brake", "dynamic_braking_effort", -1.0, BLUE),
        ("friction brake", "pneumatic_braking_effort", -1.0, SKY),
    ):
        if name in frame.columns and np.isfinite(frame[name].to_numpy(np.float64)).any():
            values = base + sign * interpolated(frame, name, time, 2.0)
            found.append((label, colour, values, base))
            base = values if sign < 0.0 else base
    return found


def _km_heading(trip: Trip, line: Line | None) -> str:
    """Heading of kilometres, which on a reverse trip need not be the line's."""
    counted_back = trip.metadata.get("direction") == "reverse"
    own = line is not None and line.reference is not None
    return "km in the direction of travel" if counted_back and not own else "km"


def _stops_part(trip: Trip, motion: Motion, line: Line | None, zone: Zone) -> list[Part]:
    calls = station_calls(motion, line)
    if not calls:
        return []

    def at(time: pd.Timestamp | None) -> str:
        return "" if time is None else zone.time(time)

    of: Columns[StationCall] = {
        "station": lambda call: call.name or "on the line",
        _km_heading(trip, line): lambda call: f"{float(in_km(line, call.position)):.3f}",
        f"arrival ({zone.name})": lambda call: at(call.arrival) if call.stopped else "",
        "departure": lambda call: at(call.departure),
        "dwell": lambda call: "" if call.dwell is None else f"{call.dwell:.0f} s",
        "": lambda call: "" if call.stopped else "passes",
    }
    return [word_table("", calls, of)]


def _energy(cost: object) -> list[Part]:
    if isinstance(cost, TrainlogError):
        return [f"Not known: {cost}."]
    assert isinstance(cost, TripCost)
    stops = counted(cost.stops, "stop")
    rows = {
        "distance": f"{cost.distance / 1e3:.3f} km",
        "running time": f"{cost.times}; {stops} on the way",
        "top speed": f"{KMH * cost.top_speed:.0f} km/h",
        "traction at the wheel rims": kwh(cost.traction),
        "taken by the dynamic brake": kwh(cost.dynamic_braking),
        "from the line, with the train's efficiencies, less what is fed back": kwh(cost.line),
        "mass, loaded": "not known" if np.isnan(cost.mass) else f"{cost.mass / 1e3:.1f} t",
    }
    if cost.distance > 0.0 and not np.isnan(cost.mass) and not cost.unknown:
        work = cost.mass / 1e3 * cost.distance / 1e3
        rows["traction per tonne and kilometre"] = f"{cost.traction / 3.6e3 / work:.1f} Wh/(t km)"
    if cost.late is not None:
        rows["behind the trajectory on arrival"] = f"{cost.late:+.1f} s"
    if cost.slips is not None:
        rows["slip protection"] = f"acted {cost.slips} times"
    return [facts_table("", rows), *cost.notes]


def _slip(found: object, view: TripView, zone: Zone) -> list[Part]:
    if isinstance(found, TrainlogError):
        return [f"Not known: {found}."]
    assert isinstance(found, SlipAnalysis)
    parts: list[Part] = [facts_table("", found.summary())]
    if len(found.events):
        line = view.own_line
        parts.append(_slip_table(found, line, _km_heading(view.trip, line), zone))
    return parts


def _slip_table(found: SlipAnalysis, line: Line, km: str, zone: Zone) -> WordTable:
    events = found.events
    worst = events["peak_slip"].abs().nlargest(MOST_EVENTS).index
    chosen = events.loc[worst].sort_values("start")
    more = len(events) - len(chosen)

    def adhesion(row: dict[Hashable, Any]) -> str:
        words = f"{abs(row['adhesion']):.3f} ± {1.96 * row['adhesion_std']:.3f}"
        return words if row["measured"] else f"{words} (not the maximum)"

    of: Columns[dict[Hashable, Any]] = {
        f"time ({zone.name})": lambda row: zone.time(row["start"]),
        km: lambda row: f"{float(in_km(line, row['position'])):.3f}",
        "axle": lambda row: row["axle"],
        "in": lambda row: row["kind"],
        "lasts": lambda row: f"{row['duration']:.1f} s",
        "largest slip": lambda row: f"{KMH * abs(row['peak_slip']):.1f} km/h",
        "adhesion": adhesion,
    }
    table = word_table("Slip events", chosen.to_dict("records"), of)
    table.caption = f"the {len(chosen)} of the largest slip; {more} more" if more else None
    return table


def _quality(trip: Trip) -> list[Part]:
    """What ingest repaired and what was found of the recorder."""
    parts: list[Part] = []
    with suppress(TrainlogError):
        lines = enumerate(report_of(trip).lines(), start=1)
        parts.append(facts_table("Read, kept and repaired", {str(n): words for n, words in lines}))
    known = passport_of(trip)
    if known is not None:
        parts.append(facts_table("Passport of the recorder", known.summary()))
    return parts

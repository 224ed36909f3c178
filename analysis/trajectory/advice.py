"""Advice to a driver: when to depart and arrive, and what to do where.

A journey is one trajectory, or several from stop to stop. Places are named by the operator's
kilometre and by the nearest station, times in the clock of the timetable. Terminal, page and CSV
show the same rows. Beside a log the advice is its ``/reference`` topic: what the trajectory asks
for where the train is, and how late it is.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from analysis.trajectory.instructions import Instruction, instructions
from analysis.view import with_chainage
from trainlog import __version__
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.formats.declared import thing_to_bytes
from trainlog.formats.files import csv_bytes, sha256, write_bytes
from trainlog.formats.railway import line_of_plan
from trainlog.presentation import Presented, WordTable, new_table
from trainlog.railway import Line, StepProfile, Trajectory
from trainlog.railway.line import in_km, near, station_at
from trainlog.simulation.recording import reference_frame
from trainlog.topics import REFERENCE, TRAIN_STATE
from trainlog.trip import Trip
from trainlog.units import KMH

OPENING = "event,km,station,place,time,"
"""How the advice as CSV begins."""

JOINS = 1.0
"""So near [m] a section begins to where the one before ends."""

_AT_STATION = 50.0
"""What is nearer [m] to a station lies at it: distances are stated to 0.1 km."""

_DAY = 86_400

Event = Literal["departs", "arrives", "passes", "changes"]


@dataclass(frozen=True, slots=True)
class AdviceRow:
    """What happens, or is to be done, at one place of a journey.

    Attributes
    ----------
    event : {"departs", "arrives", "passes", "changes"}
        At a station, or where the way of driving changes.
    position : float [m]
        In the direction of travel.
    km : float
        The operator's kilometre.
    station : str
        Empty where the way of driving changes between stations.
    place : str
        By the nearest station: ``"1.2 km before Uzwil"``.
    time : float [s]
        Since the first departure, as planned for the configuration that arrives last.
    timetable : float or None [s]
        When the timetable has it; None where it says nothing.
    speed : float [m/s]
        There.
    stated : float [m/s]
        The same as the words of the row before have it.
    permitted : float or None [m/s]
        There, where something is to be done.
    instruction : Instruction or None
    to_km : float
        The operator's kilometre of the next change.
    words : str
        What is to be done: ``"brake to 90 km/h by km 18.679"``.
    """

    event: Event
    position: float
    km: float
    station: str
    place: str
    time: float
    timetable: float | None
    speed: float
    stated: float
    permitted: float | None
    instruction: Instruction | None
    to_km: float
    words: str


@dataclass(frozen=True, eq=False, repr=False)
class JourneyAdvice(Presented):
    """Advice for a journey, in the order of its kilometres.

    Its table is the advice as a driver reads it.

    Attributes
    ----------
    line : Line
        As travelled.
    rows : tuple of AdviceRow
    sections : tuple of Trajectory
    departures : (m,) array [s]
        Of the sections, since the first one.
    start : float or None [s]
        Time of day of the first departure; None where it is not known.

    Examples
    --------
    >>> import trainlog
    >>> from analysis import OptimiserOptions, TrajectoryProblem, optimise
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> nominal = [trainlog.Configuration.of(train)]
    >>> plan = optimise(
    ...     TrajectoryProblem(line, train, nominal, end=9_286.1), OptimiserOptions(cells=60)
    ... )
    >>> found = journey_advice([plan], line, start=time_of_day("07:12"))
    >>> found.rows[0].station, found.time(found.rows[0].time), found.rows[-1].place
    ('St.Gallen', '07:12:00', 'at Gossau SG')
    """

    line: Line
    rows: tuple[AdviceRow, ...]
    sections: tuple[Trajectory, ...]
    departures: FloatArray
    start: float | None = None

    def time(self, seconds: float | None) -> str:
        """A time of the journey [s] in the clock of the timetable; since departure without one."""
        if seconds is None:
            return ""
        whole = round((self.start or 0.0) + seconds)
        whole = whole % _DAY if self.start is not None else whole
        minutes, rest = divmod(whole, 60)
        hours, minutes = divmod(minutes, 60)
        return f"{hours:02d}:{minutes:02d}:{rest:02d}"

    @property
    def train(self) -> str:
        """Name of the train."""
        return self.sections[0].train

    @property
    def title(self) -> str:
        """Train and line."""
        return f"Advice for {self.train} on {self.line.name}"

    def tables(self) -> list[WordTable]:
        """The journey as a driver reads it."""
        return [driver_table(self)]

    def facts(self) -> dict[str, Any]:
        """The advice as data: numbers in SI units, the operator's kilometre beside the position."""
        rows = [
            {
                "event": row.event,
                "position_m": row.position,
                "at_km": row.km,
                "station": row.station,
                "place": row.place,
                "time_s": row.time,
                "clock": self.time(row.time),
                "timetable_s": row.timetable,
                "speed_m_s": row.stated,
                "permitted_m_s": row.permitted,
                "advice": row.words,
                "target_m_s": row.instruction and row.instruction.stated_target,
                "to_km": row.instruction and row.to_km,
                "lowest_m_s": row.instruction and row.instruction.lowest,
                "highest_m_s": row.instruction and row.instruction.highest,
            }
            for row in self.rows
        ]
        return {
            "line": self.line.name,
            "train": self.train,
            "departure_s": self.start,
            "limits_kept_over_m": min(each.protected_length for each in self.sections),
            "advice": rows,
        }

    def sentences(self) -> list[str]:
        """Where the speed limits are kept, unless over the whole train."""
        if all(each.protected_length for each in self.sections):
            return []
        return [
            "Speed limits are kept at the train's front: where a higher one begins, the driver"
            " waits until the whole train has passed."
        ]


def time_of_day(word: str) -> float:
    """A time of day as ``07:12`` or ``07:12:30`` [s since midnight].

    Raises
    ------
    InputError
        If it is none.

    Examples
    --------
    >>> time_of_day("07:12")
    25920.0
    """
    found = re.fullmatch(r"(\d{1,2}):(\d{2})(?::(\d{2}))?", word.strip())
    hours, minutes, seconds = (int(each or 0) for each in found.groups()) if found else (99, 0, 0)
    if hours > 23 or minutes > 59 or seconds > 59:
        raise InputError(
            f"'{word}' is not a valid time of day", remedy="write it as 07:12 or 07:12:30"
        )
    return 3600.0 * hours + 60.0 * minutes + seconds


def with_times(
    sections: Sequence[Trajectory], departures: ArrayLike, name: str
) -> tuple[Trajectory, ...]:
    """Sections of a journey that know when they depart, which their files keep.

    Parameters
    ----------
    sections : sequence of m Trajectory
    departures : (m,) array [s]
    name : str
        Of the journey.
    """
    times = np.asarray(departures, dtype=np.float64).tolist()
    return tuple(
        replace(each, provenance={**each.provenance, "journey": {"name": name, "departure": time}})
        for each, time in zip(sections, times, strict=True)
    )


def journey_advice(
    sections: Sequence[Trajectory],
    line: Line | None = None,
    *,
    start: float | None = None,
    dwell: float = 0.0,
) -> JourneyAdvice:
    """Advice for a journey from its sections.

    Parameters
    ----------
    sections : sequence of Trajectory
        From stop to stop, in any order; a single one is a journey, too. Those that
        ``trainlog plan --stops`` wrote know when they depart.
    line : Line, optional
        As travelled; default: the one that the sections were planned on.
    start : float [s], optional
        Time of day of the first departure (`time_of_day`).
    dwell : float [s]
        Standing time at the stops on the way, of sections that do not know when they depart.

    Raises
    ------
    InputError
        If the sections are not of one line, train and direction, do not follow each other, do not
        come from `optimise`, or do not hold their line and none is given.

    Examples
    --------
    >>> journey_advice([])
    Traceback (most recent call last):
    trainlog.errors.InputError: no trajectory was given; give those of the journey's sections
    """
    if not sections:
        raise InputError("no trajectory was given", remedy="give those of the journey's sections")
    ordered = sorted(sections, key=lambda each: float(each.positions[0]))
    _check_sections(ordered)
    line = line_of_plan(ordered[-1]) if line is None else line
    if line is None:
        raise InputError(
            f"the trajectory does not hold its line '{ordered[-1].line}', and none is given",
            remedy="give the line's file with --line",
        )
    departures = _departures(ordered, dwell)
    rows = [
        row
        for section, departure in zip(ordered, departures.tolist(), strict=True)
        for row in _rows(section, departure, line)
    ]
    return JourneyAdvice(line, tuple(rows), tuple(ordered), departures, start)


def _check_sections(sections: Sequence[Trajectory]) -> None:
    first = sections[0]
    for before, each in pairwise(sections):
        if (each.line, each.train, each.direction) != (first.line, first.train, first.direction):
            raise InputError(
                f"the sections are not of one journey: {first.train} on {first.line}"
                f" {first.direction}, {each.train} on {each.line} {each.direction}",
                remedy="give the sections of one journey",
            )
        ends, begins = float(before.positions[-1]), float(each.positions[0])
        if abs(begins - ends) > JOINS:
            raise InputError(
                f"a section ends at km {ends / 1e3:.3f}, the next begins at km {begins / 1e3:.3f}",
                remedy="give all sections of the journey, each once",
            )


def _departures(sections: Sequence[Trajectory], dwell: float) -> FloatArray:
    """Of each section, since the first [s]: as their files know them, else one after the other."""
    stated = [each.provenance.get("journey", {}).get("departure") for each in sections]
    if len(sections) > 1 and all(isinstance(each, int | float) for each in stated):
        times = np.array(stated, dtype=np.float64)
        ends = times + [each.running_time for each in sections]
        if np.any(times[1:] < ends[:-1] - 1.0):
            raise InputError(
                "the sections are of different plans: one departs before the one before arrives",
                remedy="give the sections that one 'trainlog plan --stops' wrote",
            )
        return np.asarray(times - times[0])
    lasts = [each.running_time + dwell for each in sections[:-1]]
    return np.concatenate(([0.0], np.cumsum(lasts)))


def _rows(section: Trajectory, departure: float, line: Line) -> Iterator[AdviceRow]:
    """Of one section: its departure, changes and stations in order, its arrival."""
    limits, (first, last) = limits_of(section, line), section.positions[[0, -1]].tolist()
    ends = [station_at(line, place) for place in (first, last)]
    rows: list[tuple[Event, float, str, Instruction | None]] = [
        ("changes", each.position, "", each) for each in instructions(section, limits)
    ]
    rows += [
        ("passes", each.position, each.name, None)
        for each in line.stations
        if each.name not in ends and first + JOINS < each.position < last - JOINS
    ]
    rows.sort(key=lambda each: each[1])
    rows = [("departs", first, ends[0], None), *rows, ("arrives", last, ends[1], None)]
    timetable = {"departs": departure, "arrives": departure + section.running_time}
    asked: Instruction | None = None
    for event, position, station, own in rows:
        time, speed = (
            float(np.interp(position, section.positions, each[section.latest]))
            for each in (section.times, section.speeds)
        )
        stated = speed
        if asked is not None and (asked.hold or own is not None):
            stated = asked.target if own is None else asked.stated_until
        asked = own or asked
        km = float(in_km(line, position))
        yield AdviceRow(
            event, position, km, station, near(line, [position], _AT_STATION)[0],
            departure + time, timetable.get(event), speed, stated,
            permitted=None if own is None else float(limits(position)),
            instruction=own,
            to_km=km if own is None else float(in_km(line, own.end)),
            words=event * (event != "passes") if own is None else own.words(line),
        )  # fmt: skip


def limits_of(section: Trajectory, line: Line) -> StepProfile:
    """The line's limits [m/s], as the section was planned for them."""
    return line.limits_over(section.protected_length)


_CSV = {
    "event": ("event", "{}"), "km": ("at_km", "{:.3f}"), "station": ("station", "{}"),
    "place": ("place", "{}"), "time": ("clock", "{}"), "seconds": ("time_s", "{:.1f}"),
    "timetable": ("timetable", "{}"), "speed_kmh": ("speed_m_s", "{:.0f}"),
    "permitted_kmh": ("permitted_m_s", "{:.1f}"), "advice": ("advice", "{}"),
    "target_kmh": ("target_m_s", "{:.0f}"), "to_km": ("to_km", "{:.3f}"),
    "lowest_kmh": ("lowest_m_s", "{:.1f}"), "highest_kmh": ("highest_m_s", "{:.1f}"),
}  # fmt: skip
"""Columns of the advice as CSV: of which data, in which form."""


def write_journey_advice(found: JourneyAdvice, path: str | Path) -> None:
    """Write the advice as CSV, whole or not at all."""

    def words(row: dict[str, Any], name: str, form: str) -> str:
        value: Any = found.time(row["timetable_s"]) if name == "timetable" else row[name]
        return "" if value is None else form.format(KMH * value if "_m_s" in name else value)

    rows = [
        {heading: words(row, *of) for heading, of in _CSV.items()}
        for row in found.facts()["advice"]
    ]
    write_bytes(path, csv_bytes(pd.DataFrame(rows)))


def stations_table(found: JourneyAdvice) -> WordTable:
    """Arrivals, departures and passing times of a journey, a row a station."""
    table = new_table("", "station", "km", "arrives", "departs", "notes")
    calls: dict[float, dict[str, AdviceRow]] = {}
    for row in found.rows:
        if row.event != "changes":
            calls.setdefault(round(row.position), {})[row.event] = row
    for events in calls.values():
        first = next(iter(events.values()))
        times = [
            found.time(events[name].time) if name in events else ""
            for name in ("arrives", "departs")
        ]
        notes = []
        if "passes" in events:
            notes.append(f"passes at {found.time(first.time)}")
        arrives = events.get("arrives")
        if arrives is not None and found.time(arrives.time) != found.time(arrives.timetable):
            notes.append(f"timetable {found.time(arrives.timetable)}")
        table.add_row(first.station or "-", f"{first.km:.3f}", *times, ", ".join(notes))
    return table


def driver_table(found: JourneyAdvice) -> WordTable:
    """The journey as a driver reads it: kilometre, place, time, what to do."""
    table = new_table("", "km", "where", "time", "speed\n[km/h]", "limit\n[km/h]", "advice")
    begins: AdviceRow | None = None
    for row in found.rows:
        if row.event == "departs":
            begins = row
            continue
        place, words, speed = row.station or row.place, row.words, f"{KMH * row.stated:.0f}"
        if begins is not None and row.position <= begins.position + JOINS:
            place, words, speed = begins.station or begins.place, f"departs: {words}", ""
        begins = None
        speed = "" if row.event == "arrives" else speed
        permitted = "" if row.permitted is None else f"{KMH * row.permitted:.0f}"
        when = found.time(row.time)
        table.add_row(f"{row.km:.3f}", place, when, speed, permitted, words or "passes")
        if row.event == "arrives":
            table.add_section()
    return table


def with_advice(trip: Trip, trajectory: Trajectory) -> Trip:
    """A trip with what the trajectory advises beside it, as its ``/reference`` topic.

    Parameters
    ----------
    trip : Trip
        With the train's position; its clock starts with the first movement inside the trajectory.
    trajectory : Trajectory
        Of which the configuration counts that arrives last.

    Raises
    ------
    InputError
        If trip and trajectory are of different lines or directions, the trip is never where the
        trajectory is, or it followed a trajectory already.
    """
    name, line = trip.name, trip.metadata.get("line", trajectory.line)
    way = trip.metadata.get("direction", "forward")
    if line != trajectory.line or way != trajectory.direction:
        raise InputError(
            f"the trajectory is for line '{trajectory.line}' {trajectory.direction},"
            f" trip '{name}' ran on '{line}' {way}",
            remedy="give the trajectory of that line and direction",
        )
    if REFERENCE.name in trip:
        raise InputError(
            f"trip '{name}' carries a reference already: it followed a trajectory",
            remedy="give the trip of a driver, without a reference",
        )
    chosen = trajectory.latest
    recorded = TRAIN_STATE.name in trip
    state = with_chainage(trip)[TRAIN_STATE.name] if recorded else trip.located()
    position = state["position"].to_numpy(dtype=np.float64)
    first, last = trajectory.positions[[0, -1]]
    inside = np.isfinite(position) & (position >= first) & (position <= last)
    if not inside.any():
        raise InputError(
            f"trip '{name}' is never between km {first / 1e3:.3f} and km {last / 1e3:.3f}",
            remedy="give a trip over the trajectory's section",
        )
    index, position = state.index[inside], position[inside]
    seconds = (index - index[0]).total_seconds().to_numpy()
    moved = np.flatnonzero(position > position[0] + 1.0)
    departed = float(seconds[max(int(moved[0]) - 1, 0)]) if moved.size else 0.0
    since = float(np.interp(position[0], trajectory.positions, trajectory.times[chosen]))
    frame = reference_frame(trajectory, chosen, index, position, seconds - departed + since)
    return trip.with_topic(frame).with_step(
        "advise",
        software=f"trainlog {__version__}",
        configuration=trajectory.configurations[chosen].name,
        inputs={"trajectory": sha256(thing_to_bytes(trajectory))},
    )

"""Days on a bad rail: the first without a map, each further one with what the logs have taught."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.adhesion.condition_map import adhesion_map
from analysis.adhesion.demonstrated import UsableAdhesion, typical_adhesion, usable_adhesion
from analysis.studies.hauck_2023.reference import reference
from analysis.studies.hauck_2023.run import NO_MAP, SHORTEST_DWELL, Plan, Run, run, with_map
from analysis.studies.hauck_2023.section import PLANNING, Section, fastest, section_of
from analysis.studies.hauck_2023.trips import START, trip_of
from trainlog.mcap import write_log
from trainlog.railway import StepProfile, TrackConditionMap
from trainlog.simulation.drivers import Stop

FloatArray = NDArray[np.float64]

LAYER = "wet"
"""Of the map, and weather of the logs."""

SIGMAS = 1.0
"""Below the map's estimate."""

ON_THE_MAP = replace(PLANNING, adhesion=0.85)
"""Of a reference made on the map: its adhesion is a cautious one already."""

SPARE = 0.01
"""Least reserve of a section over its shortest time."""

CHANGED = 0.02
"""A reference is made anew where more than this share of the adhesion counted on has changed."""

DAY, APART = 86_400 * 10**9, 2 * 3_600 * 10**9
"""Of the logs: from day to day, and from trip to trip [ns]."""


@dataclass(frozen=True, eq=False)
class Day:
    """One day's trips, and what their controllers knew.

    Attributes
    ----------
    number : int
    track : TrackConditionMap or None
        Made of the logs of all days before; None on the first.
    known : UsableAdhesion or None
        What the controllers counted on.
    plan : tuple of Reference
        That they followed.
    rail : StepProfile
        As it truly was.
    runs : tuple of Run
        In the order of the masses.
    logs : tuple of path
    """

    number: int
    track: TrackConditionMap | None
    known: UsableAdhesion | None
    plan: Plan
    rail: StepProfile
    runs: tuple[Run, ...]
    logs: tuple[Path, ...]

    @property
    def slip_events(self) -> int:
        """How often an axle began to skid or slide."""
        return sum(each.slip_events for each in self.runs)

    @property
    def skid_energy(self) -> float:
        """Work beyond the peak of the creep curve [J]."""
        return sum(each.skid_energy for each in self.runs)

    @property
    def slip_energy(self) -> float:
        """All work of creep [J]."""
        return sum(each.slip_energy for each in self.runs)

    @property
    def map_errors(self) -> FloatArray:
        """Estimate over truth less one, of the bins whose maximum the map has seen."""
        if self.track is None or self.known is None:
            return np.zeros(0)
        estimate = self.track.layer(LAYER).maximum_adhesion[self.known.seen]
        return np.asarray(estimate / self.rail(self.track.centres[self.known.seen]) - 1.0)


@dataclass(frozen=True, eq=False)
class Days:
    """Days in a row under one timetable.

    Attributes
    ----------
    days : tuple of Day
    stops : tuple of Stop
        The timetable.
    """

    days: tuple[Day, ...]
    stops: tuple[Stop, ...]

    @property
    def logs(self) -> tuple[Path, ...]:
        """Of all days."""
        return tuple(path for day in self.days for path in day.logs)

    def late(self, day: Day) -> FloatArray:
        """Arrivals after the timetable's [s]; (trips, stops but the first) array."""
        return np.array([each.late for each in day.runs])


Counting = Callable[[TrackConditionMap], UsableAdhesion]
"""What a day's controllers count on when they have a map."""


def cautious(track: TrackConditionMap, sigmas: float = SIGMAS) -> UsableAdhesion:
    """The map's cautious estimate; elsewhere what was demonstrated, or what is typical of the line.

    Raises
    ------
    InputError
        If no maximum was seen anywhere.
    """
    typical = typical_adhesion(track, LAYER, sigmas)
    return usable_adhesion(track, LAYER, sigmas=sigmas, assumed=typical)


def trying(track: TrackConditionMap) -> UsableAdhesion:
    """The map's cautious estimate; elsewhere whatever the train can ask for, to see what holds."""
    return usable_adhesion(track, LAYER, sigmas=SIGMAS, assumed=float(NO_MAP.values[0]))


def first_day(
    plan: Plan, rail: StepProfile, masses: Sequence[float], folder: Path, seed: int
) -> Day:
    """Trips without a map, by the references of the good rail.

    Parameters
    ----------
    plan : tuple of Reference
    rail : StepProfile
        As it truly is.
    masses : sequence of float [kg]
    folder : path
        Where the logs go.
    seed : int
        Of the sensors' noise.
    """
    blind = with_map(plan, NO_MAP)
    runs = tuple(run(_name(1, mass), blind, rail, mass) for mass in masses)
    return Day(1, None, None, plan, rail, runs, _written(runs, 1, folder, seed))


def next_day(
    before: Day, plan: Plan, rail: StepProfile, folder: Path, seed: int,
    counting: Counting = cautious,
) -> Day:  # fmt: skip
    """The same trips on the day after, with the map of all logs so far.

    Parameters
    ----------
    before : Day
    plan : tuple of Reference
        Of the good rail: what the timetable asks for.
    rail : StepProfile
        As it truly is now.
    folder : path
    seed : int
        Of the sensors' noise.
    counting : callable
    """
    number = before.number + 1
    track = adhesion_map(before.logs, before.track, LAYER).track
    known = counting(track)
    made = replanned(plan, known.profile, before.plan if before.known else ())
    asked = timetable_of(plan)
    runs = tuple(
        run(_name(number, each.mass), made, rail, each.mass, timetable=asked)
        for each in before.runs
    )
    logs = _written(runs, number, folder, seed)
    return Day(number, track, known, made, rail, runs, logs)


def drive_days(
    plan: Plan,
    rails: Sequence[StepProfile],
    masses: Sequence[float],
    folder: Path,
    seed: int,
    counting: Counting = cautious,
) -> Days:
    """One day on each rail; arguments as for `first_day` and `next_day`."""
    *_, driven = day_by_day(plan, rails, masses, folder, seed, counting)
    return driven


def day_by_day(
    plan: Plan,
    rails: Sequence[StepProfile],
    masses: Sequence[float],
    folder: Path,
    seed: int,
    counting: Counting = cautious,
) -> Iterator[Days]:
    """After each day the days so far; arguments as for `drive_days`."""
    stops = timetable_of(plan)
    days = [first_day(plan, rails[0], masses, folder, seed)]
    yield Days(tuple(days), stops)
    for rail in rails[1:]:
        days.append(next_day(days[-1], plan, rail, folder, seed, counting))
        yield Days(tuple(days), stops)


def timetable_of(plan: Plan) -> tuple[Stop, ...]:
    """The stops of a plan."""
    return (plan[0].section.origin, *(each.section.destination for each in plan))


def replanned(plan: Plan, rail: StepProfile, earlier: Plan = ()) -> Plan:
    """References for the same timetable on a rail that is known before departure.

    Where a section cannot be run in its time, the train arrives as soon as it can, leaves after
    the shortest dwell and makes it up as early as it can.

    Parameters
    ----------
    plan : tuple of Reference
        As the timetable has it.
    rail : StepProfile
        What may be counted on.
    earlier : tuple of Reference
        Made before for the same timetable; those on which little has changed are kept.
    """
    made, origin = [], plan[0].section.origin
    for number, each in enumerate(plan):
        section = _in_time(each.section, rail, origin)
        kept = earlier[number] if earlier else None
        if kept is not None and _alike(kept.section, section):
            made.append(replace(kept, section=_on(kept.section, rail)))
        else:
            made.append(reference(section))
        origin = made[-1].section.destination
    return tuple(made)


def _in_time(section: Section, rail: StepProfile, origin: Stop) -> Section:
    """The section on another rail, with the arrival put off as far as it must be."""
    known = replace(section, origin=origin)
    planned = section.destination
    least = (1.0 + SPARE) * fastest(_on(known, rail)).duration
    arrival = max(planned.arrival, float(np.ceil(origin.departure + least)))
    departure = max(planned.departure, arrival + SHORTEST_DWELL)
    late = Stop(planned.station, planned.position, arrival, departure)
    return _on(replace(known, destination=late), rail)


def _on(section: Section, rail: StepProfile) -> Section:
    return section_of(
        section.line, section.train, rail, section.origin, section.destination,
        section.driving, ON_THE_MAP,
    )  # fmt: skip


def _alike(one: Section, other: Section) -> bool:
    """Whether the same times are asked for, and nearly the same adhesion counted on."""
    if (one.origin, one.destination) != (other.origin, other.destination):
        return False
    change = np.abs(other.tables.adhesion / one.tables.adhesion - 1.0)
    return bool(change.max() <= CHANGED)


def _name(number: int, mass: float) -> str:
    return f"day {number}, {mass / 1e3:.1f} t"


def _written(runs: Sequence[Run], number: int, folder: Path, seed: int) -> tuple[Path, ...]:
    paths = []
    for count, each in enumerate(runs):
        start = START + (number - 1) * DAY + count * APART
        trip = trip_of(each, LAYER, seed + 100 * (number - 1) + count, start)
        paths.append(folder / f"{trip.metadata['trip']}.mcap")
        write_log(trip, paths[-1])
    return tuple(paths)

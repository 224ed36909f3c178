"""Line, rails, timetable and scenarios of Hauck et al. (2023), section 4, and days in a row.

The paper's map is lost. Line and stations are those of the sample line Chemnitz-Cranzahl; the
timetable and both rails are made here, from the shortest running times and from a seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from analysis.adhesion.condition_map import adhesion_map
from analysis.adhesion.map_state import UsableAdhesion, typical_adhesion, usable_adhesion
from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN, LeverTrain
from analysis.studies.hauck_2023.reference import (
    NO_LIMIT,
    PLANNING,
    Section,
    check_timetable,
    fastest,
    fastest_unweighed,
    reference,
    section_of,
    sections_of,
)
from analysis.studies.hauck_2023.simulation import SHORTEST_DWELL, Plan, Run, run, trip_of, with_map
from analysis.studies.report import START
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.formats.railway import read_line
from trainlog.formats.samples import sample
from trainlog.mcap import write_log
from trainlog.railway import Line, StepProfile, TrackConditionMap
from trainlog.railway.condition import BIN_LENGTH
from trainlog.simulation.drivers import Stop
from trainlog.simulation.rail import base_map, bin_centres, likely_places, smooth_variation, spot
from trainlog.units import DAY, NANOSECONDS

LINE = "DE_Chemnitz_Cranzahl.line.json"

RESERVE = 0.07
"""Of the timetable over the shortest running times of a reference."""

DWELL = 36.0
"""Planned at each station [s]."""

FIRST_DEPARTURE = 10.0
"""After the beginning of the trip [s]."""

BAD_MEDIAN, BAD_SPREAD, BAD_SPOTS = 0.095, 0.08, (0.055, 0.075)
"""Maximum adhesion of leaves or frost: its median, the standard deviation of its logarithm, and
what is found where it is worst. At a_max of 1 m/s² adhesion above 0.102 never binds."""


@cache
def line() -> Line:
    """The sample line Chemnitz-Cranzahl."""
    return read_line(sample(LINE))


def good_rail(track: Line, seed: int = 1) -> StepProfile:
    """The dry rail of the simulation, slippery places included."""
    return _profile(base_map(track, "dry", seed))


def bad_rail(track: Line, seed: int = 1) -> StepProfile:
    """A rail with leaves or frost, worst where the dry rail is worst, too."""
    where = np.random.default_rng([seed, 1])
    generator = np.random.default_rng([seed, 6])
    centres = bin_centres(math.ceil(track.length / BIN_LENGTH))
    logarithm = np.log(BAD_MEDIAN) + BAD_SPREAD * smooth_variation(centres.size, generator)
    for start in likely_places(track, where):
        length = where.uniform(100.0, 300.0)
        depth = generator.uniform(*BAD_SPOTS)
        logarithm = np.minimum(logarithm, spot(centres, start, length, depth))
    return _profile(np.exp(logarithm))


def timetable(
    track: Line, train: LeverTrain = PUBLISHED_TRAIN, rail: StepProfile | None = None
) -> tuple[Stop, ...]:
    """Calls at every station, in whole seconds.

    Parameters
    ----------
    track : Line
    train : LeverTrain
    rail : StepProfile, optional
        For which the times are made; default: `good_rail`.
    """
    rail = rail or good_rail(track)
    first, *others = track.stations
    stops = [Stop(first.name, first.position, 0.0, FIRST_DEPARTURE)]
    for station in others:
        before = stops[-1]
        ample = before.departure + 1e5
        to = Stop(station.name, station.position, ample, ample)
        least = fastest(section_of(track, train, rail, before, to)).duration
        arrival = before.departure + 6.0 * math.ceil(least * (1.0 + RESERVE) / 6.0)
        stops.append(Stop(station.name, station.position, arrival, arrival + DWELL))
    return tuple(stops)


def _profile(values: FloatArray) -> StepProfile:
    starts = BIN_LENGTH * np.arange(values.size, dtype=np.float64)
    return StepProfile(starts, np.minimum(values, 0.5))


def least_lateness(sections: Sequence[Section], mass: float, delay: float) -> FloatArray:
    """Bound on how late [s] any driver arrives who left the first stop late.

    From the runs of `fastest_unweighed` and the shortest dwell; below 0 where he could be early.

    Parameters
    ----------
    sections : sequence of Section
    mass : float [kg]
    delay : float [s]
    """
    late, bound = delay, []
    for section in sections:
        least = fastest_unweighed(section, mass, _rotating(section)).duration
        bound.append(late + least - section.duration)
        planned = section.destination.departure - section.destination.arrival
        late = max(bound[-1] + SHORTEST_DWELL - planned, 0.0)
    return np.array(bound, dtype=np.float64)


def least_deviation(plan: Plan, run: Run) -> FloatArray:
    """Bound on the largest distance [m] from its reference, section by section.

    Of any driver who leaves when `run` did, does not know the mass, and arrives no later than the
    timetable or `run`, whichever is later. Nobody is faster anywhere than the fastest run; so
    nobody is ahead of it, nor behind the one like it that leaves as late as it may. What of the
    reference lies outside these two cannot be reached.

    Parameters
    ----------
    plan : tuple of Reference
        With the map of the rail that the train met.
    run : Run

    Returns
    -------
    (k,) array
        0 where the reference lies between them.
    """
    found = []
    for number, each in enumerate(plan):
        section = each.section
        begins, here = section.origin.departure, run.section == number
        fast = fastest_unweighed(section, run.mass, _rotating(section))
        time, aim = run.time[here] - begins, run.target[here, 0]
        leaves = run.departures[number] - begins
        arrives = max(section.duration, run.arrivals[number + 1] - begins, leaves + fast.duration)
        most = np.interp(time - leaves, fast.times, fast.positions)
        least = np.interp(time - (arrives - fast.duration), fast.times, fast.positions)
        found.append(max(float(np.max(aim - most)), float(np.max(least - aim)), 0.0))
    return np.array(found, dtype=np.float64)


def _rotating(section: Section) -> float:
    """Of the simulated train [kg]."""
    return section.train.on_axles().rotating_mass


Watch = Callable[[Iterable[Section]], Iterable[Section]]

DELAY = 40.0
"""Of the third scenario [s]."""


@dataclass(frozen=True)
class Scenario:
    """One of the paper's.

    Attributes
    ----------
    name : str
    weather : {"good", "bad"}
        Of the rail.
    delay : float [s]
        Of the first departure.
    planned : {"good", "bad"}
        Weather that the references are made for.
    """

    name: str
    weather: str
    delay: float = 0.0
    planned: str = "good"


SCENARIOS = (
    Scenario("good track", "good"),
    Scenario("weather turns bad", "bad"),
    Scenario("40 s late", "good", DELAY),
    Scenario("weather turns good", "good", planned="bad"),
)
"""The last is the paper's other change of weather, which it does not run."""


@dataclass(frozen=True, eq=False)
class Setup:
    """Line, timetable, rails and references, which the scenarios share.

    Attributes
    ----------
    plans : dict of str to tuple of Reference
        By the weather that they are made for; for the nominal mass.
    rails : dict of str to StepProfile
        By weather.
    """

    plans: dict[str, Plan]
    rails: dict[str, StepProfile]

    @property
    def plan(self) -> Plan:
        """For the good rail."""
        return self.plans["good"]


@dataclass(frozen=True, eq=False)
class Outcome:
    """One scenario with one mass.

    Attributes
    ----------
    scenario : Scenario
    informed : Run
        By the controller with the map.
    blind : Run, optional
        By the one without, on the bad rail; not as published.
    bound : (k,) array [s]
        How late a train of this mass must be at each stop, whoever drives it; see `least_lateness`.
    deviation : (k,) array [m]
        How far from its reference `informed` must be at some time in each section.
    """

    scenario: Scenario
    informed: Run
    blind: Run | None
    bound: FloatArray
    deviation: FloatArray


def prepared(seed: int, sections: int | None = None, track: Watch = iter) -> Setup:
    """Line, timetable, rails and references.

    Parameters
    ----------
    seed : int
        Of the rails.
    sections : int, optional
        Only the first of the line; default: all.
    track : callable
        Wraps the sections while they are solved, to show progress.

    Raises
    ------
    InputError
        If the line has fewer sections.
    InfeasibleError
        If the timetable cannot be kept.
    """
    whole = line()
    rails = {"good": good_rail(whole, seed), "bad": bad_rail(whole, seed)}
    stops = timetable(whole, rail=rails["good"])
    if sections is not None and sections >= len(stops):
        raise InputError(
            f"line '{whole.name}' has {len(stops) - 1} sections, not {sections}",
            remedy=f"ask for 1 to {len(stops) - 1}, or for all",
        )
    every = sections_of(whole, PUBLISHED_TRAIN, rails["good"], stops)[:sections]
    check_timetable(every)
    plan = tuple(reference(section) for section in track(every))
    return Setup({"good": plan, "bad": replanned(plan, rails["bad"])}, rails)


def drawn_masses(seed: int, count: int) -> FloatArray:
    """Masses [kg] from the range of eq. (6), in tenths of tonnes; the controller learns none."""
    generator = np.random.default_rng([seed, 7])
    least, most = PUBLISHED_TRAIN.light, PUBLISHED_TRAIN.heavy
    drawn = generator.uniform(least, most, count)
    return np.asarray(np.clip(np.round(drawn, -2), least, most))


def outcome(known: Setup, scenario: Scenario, mass: float, *, published: bool = False) -> Outcome:
    """Drive a scenario with the map, and on the bad rail, unless as published, without one.

    Parameters
    ----------
    known : Setup
    scenario : Scenario
    mass : float [kg]
    published : bool
        By the controller of the paper.
    """
    rail, plan = known.rails[scenario.weather], known.plans[scenario.planned]
    informed = with_map(plan, rail)
    name, delay = f"{scenario.name}, {mass / 1e3:.1f} t", scenario.delay
    driven = run(name, informed, rail, mass, delay=delay, published=published)
    without = None
    if not published and scenario.weather == "bad":
        blind = with_map(plan, NO_LIMIT)
        without = run(f"{name}, no map", blind, rail, mass, delay=delay)
    bound = least_lateness([each.section for each in informed], mass, delay)
    return Outcome(scenario, driven, without, bound, least_deviation(informed, driven))


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

APART = 2 * 3_600 * NANOSECONDS
"""Of the logs: from trip to trip [ns]."""


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
    def late(self) -> FloatArray:
        """Arrivals after the timetable's [s]; (trips, stops but the first) array."""
        return np.array([each.late for each in self.runs])

    @property
    def worst(self) -> FloatArray:
        """Largest constraints of all trips; see `Run.worst`."""
        return np.asarray(np.max([each.worst for each in self.runs], axis=0))

    @property
    def map_errors(self) -> FloatArray:
        """Estimate over truth less one, of the bins whose maximum the map has seen."""
        if self.track is None or self.known is None:
            return np.zeros(0)
        estimate = self.track.layer(LAYER).maximum_adhesion[self.known.seen]
        return np.asarray(estimate / self.rail(self.track.centres[self.known.seen]) - 1.0)


def cautious_adhesion(track: TrackConditionMap, sigmas: float = SIGMAS) -> UsableAdhesion:
    """The map's cautious estimate of what lasts; elsewhere what was demonstrated, or is typical.

    Raises
    ------
    InputError
        If no maximum was seen anywhere.
    """
    typical = typical_adhesion(track, LAYER, sigmas)
    return usable_adhesion(track, LAYER, sigmas=sigmas, assumed=typical)


def first_day(
    plan: Plan,
    rail: StepProfile,
    masses: Sequence[float],
    folder: Path,
    seed: int,
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
    blind = with_map(plan, NO_LIMIT)
    runs = tuple(run(_name(1, mass), blind, rail, mass) for mass in masses)
    return Day(1, None, None, plan, rail, runs, _written(runs, 1, folder, seed))


def next_day(before: Day, plan: Plan, rail: StepProfile, folder: Path, seed: int) -> Day:
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
    """
    number = before.number + 1
    learnt = adhesion_map(before.logs, before.track, LAYER).track
    known = cautious_adhesion(learnt)
    made = replanned(plan, known.profile, before.plan if before.known else ())
    asked = timetable_of(plan)
    runs = tuple(
        run(_name(number, each.mass), made, rail, each.mass, timetable=asked)
        for each in before.runs
    )
    logs = _written(runs, number, folder, seed)
    return Day(number, learnt, known, made, rail, runs, logs)


def day_by_day(
    plan: Plan, rails: Sequence[StepProfile], masses: Sequence[float], folder: Path, seed: int,
) -> Iterator[list[Day]]:  # fmt: skip
    """After each day the days so far; arguments as for `first_day` and `next_day`.

    Raises
    ------
    InputError
        Before a day whose map shows no maximum adhesion anywhere.
    """
    days = [first_day(plan, rails[0], masses, folder, seed)]
    yield [*days]
    for rail in rails[1:]:
        days.append(next_day(days[-1], plan, rail, folder, seed))
        yield [*days]


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
        section.line, section.train, rail, section.origin, section.destination, ON_THE_MAP
    )


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

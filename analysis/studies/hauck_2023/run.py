"""Line, rails, timetable and scenarios of Hauck et al. (2023), section 4, and days in a row.

The paper's map is lost. Line and stations are those of the sample line Chemnitz-Cranzahl; the
timetable and both rails are made here, from the shortest running times and from a seed.

"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from analysis.adhesion.condition_map import adhesion_map
from analysis.adhesion.map_state import UsableAdhesion, typical_adhesion, usable_adhesion
from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    RED,
    Chart,
    Curve,
    Label,
    Panel,
    Rule,
    line_charts,
)
from analysis.studies.hauck_2023.model import NOMINAL_MASS, PUBLISHED_TRAIN, LeverTrain
from analysis.studies.hauck_2023.reference import (
    NO_LIMIT,
    PLANNING,
    Reference,
    Section,
    check_timetable,
    fastest,
    fastest_unweighed,
    reference,
    section_of,
    sections_of,
)
from analysis.studies.hauck_2023.simulation import SHORTEST_DWELL, Plan, Run, run, trip_of, with_map
from analysis.studies.report import START, StudyReport
from trainlog.arrays import FloatArray
from trainlog.errors import InfeasibleError, InputError
from trainlog.formats.railway import read_line
from trainlog.formats.samples import sample
from trainlog.mcap import write_log
from trainlog.presentation import Columns, WordTable, new_table, word_table
from trainlog.railway import Line, StepProfile, TrackConditionMap
from trainlog.railway.condition import BIN_LENGTH
from trainlog.simulation.drivers import Stop
from trainlog.simulation.rail import base_map, bin_centres, likely_places, smooth_variation, spot
from trainlog.units import DAY, KMH, NANOSECONDS

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


# -------------------------------------------------------------------- as logs, pictures and tables

CONSTRAINTS = (
    "largest h1, h2 (comfort) [m/s²]",
    "largest h3, h4 (adhesion) [m/s²]",
    "largest h5 (speed limit) [m/s]",
)
"""Of eq. (7), at any mass and without reserve."""


_OF_OUTCOME: Columns[Outcome] = {
    "scenario": lambda each: each.scenario.name,
    "mass t": lambda each: f"{each.informed.mass / 1e3:.1f}",
}


def references_table(plan: Plan) -> WordTable:
    """The references that are followed, and how much time each has.

    Parameters
    ----------
    plan : tuple of Reference
    """
    of: Columns[Reference] = {
        "section": lambda each: each.section.name,
        "km": lambda each: (
            f"{(each.section.destination.position - each.section.origin.position) / 1e3:.1f}"
        ),
        "timetable s": lambda each: f"{each.duration:.0f}",
        "least of a reference s": lambda each: f"{fastest(each.section, each.mass).duration:.1f}",
        "least of any driver s": lambda each: (
            f"{fastest_unweighed(each.section, each.mass).duration:.1f}"
        ),
        "nodes": lambda each: each.times.size,
        "iterations of IPOPT": lambda each: each.iterations,
        "rollout off by mm": lambda each: f"{1e3 * each.rollout_error:.1f}",
        "nearest to a limit m/s²": lambda each: f"{-each.worst[:2].max():.2f}",
    }
    return word_table(f"References, {plan[0].mass / 1e3:.1f} t: multiple shooting", plan, of)


def tracking_table(outcomes: Sequence[Outcome]) -> WordTable:
    """Errors of the trips with the map, the least there could be, and what was left of the limits.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    of: Columns[Outcome] = _OF_OUTCOME | {
        "position m": lambda each: _most(each.informed.position_error),
        "least of any driver as punctual m": lambda each: f"{each.deviation.max():.2f}",
        "speed m/s": lambda each: _most(each.informed.speed_error),
        "left of comfort m/s²": lambda each: f"{-each.informed.worst[0]:.3f}",
        "left of adhesion m/s²": lambda each: f"{-each.informed.worst[1]:.3f}",
        "left of speed limit km/h": lambda each: f"{-KMH * each.informed.worst[2]:.2f}",
        "stops off by m": lambda each: _most(each.informed.stop_error),
    }
    title = "With the map: largest errors, and what was left of each limit at any mass"
    return word_table(f"{title} (negative: broken)", outcomes, of)


def lateness_table(outcomes: Sequence[Outcome]) -> WordTable:
    """How late the trips with the map were, beside the least that is possible.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    of: Columns[Outcome] = _OF_OUTCOME | {
        "next stop": lambda each: f"{each.informed.late[0]:.1f}",
        "least there could be": lambda each: f"{max(each.bound[0], 0.0):.1f}",
        "latest of all stops": lambda each: f"{each.informed.late.max():.1f}",
        "least there": lambda each: f"{max(each.bound[np.argmax(each.informed.late)], 0.0):.1f}",
    }
    return word_table("With the map: seconds late at the stops (negative: early)", outcomes, of)


def gain_table(outcomes: Sequence[Outcome]) -> WordTable:
    """What the map is worth: skidding and sliding with it and without.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    figures: Columns[Run] = {
        "axles that began to skid or slide": lambda run: run.slip_events,
        "slip protection": lambda run: run.protections,
        "work beyond the peak MJ": lambda run: f"{run.skid_energy / 1e6:.2f}",
        "all work of creep MJ": lambda run: f"{run.slip_energy / 1e6:.1f}",
        "latest s": lambda run: f"{run.late.max():.1f}",
        "farthest from a stop m": lambda run: _most(run.stop_error),
    }

    def both(figure: Callable[[Run], object]) -> Callable[[tuple[Outcome, Run]], str]:
        return lambda row: f"{figure(row[0].informed)} / {figure(row[1])}"

    of: Columns[tuple[Outcome, Run]] = {
        "mass t": lambda row: f"{row[0].informed.mass / 1e3:.1f}",
        **{name: both(figure) for name, figure in figures.items()},
    }
    rows = [(each, each.blind) for each in outcomes if each.blind is not None]
    title = "Weather turns bad, with the map / without: the same trips, axle by axle"
    return word_table(title, rows, of)


def difference_table(outcomes: Sequence[Outcome]) -> WordTable:
    """What is not as the paper has it, over all masses.

    Parameters
    ----------
    outcomes : sequence of Outcome
        Of the scenarios with several masses.
    """
    masses = [*dict.fromkeys(each.informed.mass for each in outcomes)]
    good, bad, late, better = (
        [each for each in outcomes if each.scenario is scenario] for scenario in SCENARIOS
    )
    heads = [f"{mass / 1e3:.1f} t" for mass in masses]
    table = new_table("Differences from the paper", "figure", "published", *heads)

    def position(each: Outcome) -> str:
        return _most(each.informed.position_error)

    def speed(each: Outcome) -> str:
        return _most(each.informed.speed_error)

    def stop(each: Outcome) -> str:
        return _most(each.informed.stop_error)

    rows: list[tuple[str, str, Sequence[Outcome], Callable[[Outcome], str]]] = [
        ("good track: largest error of position [m]", "about 5", good, position),
        ("good track: largest error of speed [m/s]", "below 3", good, speed),
        ("good track: farthest from a stop [m]", "not stated", good, stop),
        ("weather turns bad: largest error of position [m]", "about 5", bad, position),
        ("weather turns bad: farthest from a stop [m]", "not stated", bad, stop),
        ("weather turns good: largest error of position [m]", "easily tracked", better, position),
        ("weather turns good: largest error of speed [m/s]", "easily tracked", better, speed),
        (
            "40 s late: time that eq. (8) lacks, at least [s]",
            "infeasible",
            late,
            lambda each: f"{each.bound[0]:.1f}",
        ),
        ("40 s late: error of position at departure [m]", "about 280", late, _departure_error),
        ("40 s late: largest error of position [m]", "not stated", late, position),
        ("40 s late: largest error of speed [m/s]", "not stated", late, speed),
        (
            "40 s late: late at the next stop [s]",
            "19",
            late,
            lambda each: f"{each.informed.late[0]:.1f}",
        ),
    ]
    for name, published, found, figure in rows:
        table.add_row(name, published, *map(figure, found))
    for number, name in enumerate(CONSTRAINTS):
        worst = [
            max(each.informed.worst[number] for each in outcomes if each.informed.mass == mass)
            for mass in masses
        ]
        table.add_row(f"{name}, all scenarios", "not above 0", *(f"{h:+.3f}" for h in worst))
    return table


def _most(errors: FloatArray) -> str:
    return f"{np.abs(errors).max():.2f}"


def _departure_error(each: Outcome) -> str:
    """By how far the reference has gone when the train, late, departs."""
    run = each.informed
    return f"{abs(float(run.position_error[np.argmax(run.speed > 0.0)])):.1f}"


def days_table(days: Sequence[Day]) -> WordTable:
    """Each day beside the first: slip, punctuality, and the map that it was driven by.

    Parameters
    ----------
    days : sequence of Day
    """
    of: Columns[Day] = {
        "day": lambda day: day.number,
        "axles that began to skid or slide": lambda day: day.slip_events,
        "slip protection": lambda day: sum(each.protections for each in day.runs),
        "work beyond the peak MJ": lambda day: f"{day.skid_energy / 1e6:.2f}",
        "all work of creep MJ": lambda day: f"{day.slip_energy / 1e6:.1f}",
        "latest s": lambda day: f"{day.late.max():.1f}",
        "mean s": lambda day: f"{day.late.mean():.2f}",
        "farthest from a stop m": lambda day: (
            f"{max(np.abs(each.stop_error).max() for each in day.runs):.2f}"
        ),
        "largest h1, h2 / h3, h4 m/s²": lambda day: f"{day.worst[0]:+.3f} / {day.worst[1]:+.3f}",
        "bins seen / demonstrated / assumed": _bins,
        "map's error % (bias, rms)": _map_errors,
    }
    trips = f"{len(days[0].runs)} trips a day: the first without a map, each other one"
    return word_table(f"Bad rail, {trips} with the map of all logs before it", days, of)


def _bins(day: Day) -> str:
    known = day.known
    if known is None:
        return "-"
    return " / ".join(
        f"{np.count_nonzero(each)}" for each in (known.seen, known.demonstrated, known.assumed)
    )


def _map_errors(day: Day) -> str:
    errors = 100.0 * day.map_errors
    if errors.size == 0:
        return "-"
    return f"{errors.mean():+.1f}, {np.sqrt(np.mean(errors**2)):.1f}"


SECTIONS = 3
"""Drawn of the speed, as in the paper."""

BIN = 100.0
"""Over which the largest constraint is drawn [m]."""

ZERO = [Rule(0.0, GREY)]


def study_charts(setup: Setup, outcomes: Sequence[Outcome]) -> dict[str, list[Chart]]:
    """The paper's figures by the names of their files.

    Parameters
    ----------
    setup : Setup
    outcomes : sequence of Outcome
        Of the scenarios, in their order.
    """
    good, bad, late, _ = (each.informed for each in outcomes)
    return {
        "figure-02-map.png": [_map(setup)],
        "figure-03-speed.png": [_speed(good)],
        "figure-04-errors.png": [_errors(good)],
        "figure-05-constraints-good.png": [_constraints(good, "Fig. 5  Constraints, good track")],
        "figure-06-constraints-bad.png": [_constraints(bad, "Fig. 6  Constraints, bad track")],
        "figure-07-delay.png": _delay(late, outcomes[2]),
    }


def _map(setup: Setup) -> Chart:
    """Fig. 2: limits, gradient and both rails."""
    line = setup.plan[0].section.line
    s = np.arange(0.0, line.length, 25.0)
    rails = [
        Curve(name, s / 1e3, setup.rails[name](s), colour, width=0.8)
        for name, colour in (("good", BLUE), ("bad", ORANGE))
    ]
    (chart,) = line_charts(line)
    panels = [*chart.panels, Panel("maximum adhesion", rails, from_zero=True)]
    return replace(chart, panels=panels, title="Fig. 2  Map (reconstruction)")


def _speed(run: Run) -> Chart:
    """Fig. 3: speed of the reference and of the train on the first sections."""
    rows = run.section < SECTIONS
    minutes, speed = run.time[rows] / 60.0, run.speed[rows]
    limit = np.where(speed > 0.0, run.line.speed_limit(run.position[rows]), np.nan)
    curves = [
        Curve("reference", minutes, KMH * run.target[rows, 1], PALE, width=4.0),
        Curve("train", minutes, KMH * speed, width=1.0),
        Curve("limit", minutes, KMH * limit, RED, width=0.8),
    ]
    title = f"Fig. 3  Speed, first {SECTIONS} sections, good track, {run.mass / 1e3:.1f} t"
    return Chart("min", [Panel("km/h", curves, 1.6, from_zero=True)], title=title)


def _errors(run: Run) -> Chart:
    """Fig. 4: errors of position and speed."""
    minutes = run.time / 60.0
    panels = [
        Panel("m", [Curve("", minutes, run.position_error, BLUE, width=0.8)],
              title="Position less the reference's"),
        Panel("m/s", [Curve("", minutes, run.speed_error, GREEN, width=0.8)],
              title="Speed less the reference's"),
    ]  # fmt: skip
    return Chart("min", panels, title=f"Fig. 4  Errors, {run.mass / 1e3:.1f} t, good track")


def _constraints(run: Run, title: str) -> Chart:
    """Figs. 5 and 6: the largest of the safety and of the traction constraints along the line."""
    comfort, adhesion, speed = (_largest(run, each) for each in run.constraints[:, :3].T)
    curves = [
        Curve("acceleration less 1 m/s² (h1, h2)", *comfort, BLUE, width=0.8),
        Curve("effort over mass less adhesion (h3, h4)", *adhesion, ORANGE, width=0.8),
    ]
    panels = [
        Panel("m/s²", curves, title="Comfort and traction", limits=(-1.5, 0.1), rules=ZERO),
        Panel("km/h", [Curve("", speed[0], KMH * speed[1], RED, width=0.8)],
              title="Speed less its limit (h5)", rules=ZERO),
    ]  # fmt: skip
    words = f"{title}, {run.mass / 1e3:.1f} t; kept where not above 0, for every mass"
    return Chart("km", panels, title=words)


def _delay(run: Run, outcome: Outcome) -> list[Chart]:
    """Fig. 7: error of position after a late departure, and lateness at the stops."""
    rows = run.section < SECTIONS
    error = Curve("", run.time[rows] / 60.0, run.position_error[rows], width=1.0)
    late = np.concatenate([[run.delay], run.late])
    numbers = np.arange(late.size)
    least = np.maximum(np.concatenate([[run.delay], outcome.bound]), 0.0)
    bound = Curve("least by the shortest times", numbers, least, ORANGE, width=3.0)
    low, high = min(float(late.min()), 0.0) - 5.0, 1.15 * float(late.max())
    margin = 0.03 * (high - low)
    panel = Panel(
        "s", [Curve("reached", numbers, late, kind="bars", width=0.5), bound],
        title="Lateness at the first departure, then on arrival; below 0: early",
        limits=(low, high),
        labels=[
            Label(number, f"{each:.1f}", each + np.copysign(margin, each))
            for number, each in enumerate(late.tolist())
        ],
    )  # fmt: skip
    title = f"Fig. 7  Position less the reference's, {run.delay:g} s late at first"
    return [
        Chart("min", [Panel("m", [error])], title=f"{title}, {run.mass / 1e3:.1f} t"),
        Chart("", [panel], ticks=[(n, stop.station) for n, stop in enumerate(run.stops)]),
    ]


def _largest(run: Run, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The largest value in each piece of the line, over km; NaN where there is none."""
    count = int(np.ceil(float(run.position.max()) / BIN))
    found = np.full(count, -np.inf)
    index = np.minimum((run.position / BIN).astype(np.int64), count - 1)
    np.maximum.at(found, index, np.where(np.isfinite(values), values, -np.inf))
    centres = (np.arange(count, dtype=np.float64) + 0.5) * BIN
    return centres / 1e3, np.where(np.isfinite(found), found, np.nan)


TRIPS = 3
"""A day, each with a mass of its own."""


@dataclass(frozen=True)
class MapOptions:
    """What is driven.

    Attributes
    ----------
    sections : int, optional
        Only the first of the line; default: all.
    days : int
        How many days the loop is driven; none as published.
    seed : int
        Of rails, masses and sensors.
    as_published : bool
        By eqs. (9) to (11) instead of the product's controller.
    """

    sections: int | None = None
    days: int = 2
    seed: int = 1
    as_published: bool = False


def main(report: StudyReport, options: MapOptions) -> None:
    """Drive the scenarios with and without a map, then the days; every trip is written at once."""
    watch = partial(report.track, description="references")
    known = prepared(options.seed, options.sections, watch)
    published = options.as_published
    report.show(references_table(known.plan))
    drawn = drawn_masses(options.seed, TRIPS).tolist()
    first = NOMINAL_MASS if published else drawn[0]
    outcomes: list[Outcome] = []
    for mass in report.track((first, PUBLISHED_TRAIN.light, PUBLISHED_TRAIN.heavy), "driving"):
        for scenario in report.track(SCENARIOS, f"{mass / 1e3:.1f} t"):
            found = outcome(known, scenario, mass, published=published)
            outcomes.append(found)
            weather = "dry" if scenario.weather == "good" else "wet"
            for each in (found.informed, found.blind) if mass == first else ():
                if each is not None:
                    report.log(trip_of(each, weather, options.seed))
        report.show(tracking_table(outcomes), lateness_table(outcomes))
        if not published:
            report.show(gain_table(outcomes))
    report.show(difference_table(outcomes))
    report.draw(study_charts(known, outcomes[: len(SCENARIOS)]))
    if not published:
        _drive_days(report, known, drawn, options)


def _drive_days(
    report: StudyReport, known: Setup, masses: list[float], options: MapOptions
) -> None:
    """Days in a row, until one has no map to be driven by."""
    rails = [known.rails["bad"]] * options.days
    following = day_by_day(known.plan, rails, masses, report.folder, options.seed)
    for number in report.track(range(1, options.days + 1), "driving days"):
        try:
            driven = next(following)
        except (InputError, InfeasibleError) as error:
            report.show(f"day {number} was not driven: {error}")
            break
        report.keep(*driven[-1].logs)
        report.show(days_table(driven))

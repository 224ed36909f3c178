"""The three scenarios of paper 000, each with a map and without one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.studies.hauck_2023 import world as world
from analysis.studies.hauck_2023.bounds import least_deviation, least_lateness
from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN
from analysis.studies.hauck_2023.reference import reference
from analysis.studies.hauck_2023.run import NO_MAP, Plan, Run, run, with_map
from analysis.studies.hauck_2023.section import (
    Section,
    check_timetable,
    least_time_unweighed,
    sections_of,
)
from trainlog.errors import InputError
from trainlog.railway import StepProfile

FloatArray = NDArray[np.float64]
Progress = Callable[[Iterable[Section]], Iterable[Section]]

DELAY = 40.0
"""Of the third scenario [s]."""


@dataclass(frozen=True)
class Scenario:
    """One of the paper's.

    Attributes
    ----------
    name : str
    weather : {"good", "bad"}
        Of the rail; the references are always those of the good one.
    delay : float [s]
        Of the first departure.
    published : str
        What the paper tells of it.
    """

    name: str
    weather: str
    delay: float
    published: str


SCENARIOS = (
    Scenario("good track", "good", 0.0, "about 5 m at most, below 3 m/s, all h <= 0"),
    Scenario("weather turns bad", "bad", 0.0, "no significant change, all h <= 0"),
    Scenario("40 s late", "good", DELAY, "about 280 m, 19 s late at the next stop, all h <= 0"),
)


@dataclass(frozen=True, eq=False)
class World:
    """What the scenarios share.

    Attributes
    ----------
    plan : tuple of Reference
        For the good rail and the nominal mass.
    rails : dict of str to StepProfile
        By weather.
    """

    plan: Plan
    rails: dict[str, StepProfile]


@dataclass(frozen=True, eq=False)
class Outcome:
    """One scenario with one mass.

    Attributes
    ----------
    scenario : Scenario
    informed, blind : Run
        By the controller with the map, and by the one without.
    bound, unweighed : (k,) array [s]
        How late a train of this mass must be at each stop, whoever drives it: by a driver who
        knows the mass, and by one who does not.
    deviation : (k,) array [m]
        How far from its reference `informed` must be at some time in each section.
    """

    scenario: Scenario
    informed: Run
    blind: Run
    bound: FloatArray
    unweighed: FloatArray
    deviation: FloatArray


def prepared(seed: int, sections: int | None = None, watched: Progress = iter) -> World:
    """Line, timetable, rails and references.

    Parameters
    ----------
    seed : int
        Of the rails.
    sections : int, optional
        Only the first of the line; default: all.
    watched : callable
        Wraps the sections while they are solved, to show progress.

    Raises
    ------
    InputError
        If the line has fewer sections.
    InfeasibleError
        If the timetable cannot be kept.
    """
    track = world.line()
    rails = {"good": world.good_rail(track, seed), "bad": world.bad_rail(track, seed)}
    stops = world.timetable(track, rail=rails["good"])
    if sections is not None and sections >= len(stops):
        raise InputError(
            f"line '{track.name}' has {len(stops) - 1} sections, not {sections}",
            remedy=f"ask for 1 to {len(stops) - 1}, or for all",
        )
    every = sections_of(track, PUBLISHED_TRAIN, rails["good"], stops)[:sections]
    check_timetable(every)
    return World(tuple(reference(section) for section in watched(every)), rails)


def drawn_masses(seed: int, count: int) -> FloatArray:
    """Masses [kg] from the range of eq. (6), in tenths of tonnes; the controller learns none."""
    generator = np.random.default_rng([seed, 7])
    drawn = generator.uniform(PUBLISHED_TRAIN.mass, PUBLISHED_TRAIN.max_mass, count)
    return np.asarray(np.clip(np.round(drawn, -2), PUBLISHED_TRAIN.mass, PUBLISHED_TRAIN.max_mass))


def outcome(known: World, scenario: Scenario, mass: float) -> Outcome:
    """Drive a scenario with the map and without one."""
    rail = known.rails[scenario.weather]
    informed = with_map(known.plan, rail)
    blind = with_map(known.plan, NO_MAP)
    sections = [each.section for each in informed]
    name = f"{scenario.name}, {mass / 1e3:.1f} t"
    driven = run(name, informed, rail, mass, delay=scenario.delay)
    return Outcome(
        scenario,
        driven,
        run(f"{name}, no map", blind, rail, mass, delay=scenario.delay),
        least_lateness(sections, mass, scenario.delay),
        least_lateness(sections, mass, scenario.delay, least_time_unweighed),
        least_deviation(informed, driven),
    )

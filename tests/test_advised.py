"""Simulated drivers who follow the rows of an advice, and a trip compared with its advice."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from trajectory_cases import FLIRT, FREIGHT, drawn, hilly_line, observed, optimised

from analysis.comparison.compare import compare
from analysis.control.advised import EXACT, AdvisedDriver, Attention, obeyed_trip
from analysis.control.follow import outcome
from trainlog.arrays import FloatArray
from trainlog.railway import Train, Trajectory
from trainlog.simulation import drive, trajectory_scenarios
from trainlog.units import JOULES_PER_KWH, KMH

LINE = hilly_line()


def plan_of(train: Train, reserve: float = 0.1) -> Trajectory:
    configurations = [*observed(train, 0.85, 1.15), *drawn(train, 1, seed=3)]
    return optimised(LINE, train, configurations, reserve=reserve, cells=100)


def driven(plan: Trajectory, train: Train, attention: Attention, seed: int = 1) -> FloatArray:
    """Lateness [s], energy over planned, over the limit [m/s], off the stop [m], of each."""
    follows = partial(AdvisedDriver, plan, LINE, train, attention=attention, seed=seed)
    scenarios = trajectory_scenarios(plan, LINE, train, plan.chosen("all"), follows)
    return np.array([outcome(each, drive(each))[:4] for each in scenarios])


@pytest.mark.parametrize(("train", "reserve"), [(FLIRT, 0.1), (FREIGHT, 0.3)])
def test_who_obeys_to_the_letter_keeps_limits_time_and_stop(train: Train, reserve: float) -> None:
    """With brakes that take their time, which the plan does not know."""
    plan = plan_of(train, reserve)
    late, energy, over, stop = driven(plan, train, EXACT).T
    assert np.all(over < 2.0 / KMH)
    assert np.all(late < 0.1 * plan.running_time)  # freight slips at its start
    assert np.all(np.abs(stop) < 0.3)
    assert np.all(energy < 0.03)


def test_a_person_is_further_off_than_who_obeys_to_the_letter() -> None:
    plan = plan_of(FLIRT)
    exact = driven(plan, FLIRT, EXACT)
    persons = [driven(plan, FLIRT, Attention(), seed) for seed in range(4)]
    late, _, over, stop = np.concatenate(persons).T
    assert np.std([each[:, 0] for each in persons], axis=0).max() > 1.0
    assert exact[:, 2].max() < over.max() < 8.0 / KMH
    assert np.all(np.abs(stop) < 0.3)
    assert np.all(late < 0.1 * plan.running_time)


def test_a_trip_is_compared_with_its_advice() -> None:
    """Energies of the trip, of the plan and of the advice stand in one table."""
    plan = plan_of(FLIRT)
    trip = obeyed_trip(plan, LINE, FLIRT)
    found = compare(trip, plan)
    (direction,) = found.directions
    table = next(each for each in found.tables() if each.name == "trips")
    assert [row[0] for row in table.rows] == ["driven-x1.15", "trajectory", "advice, to the letter"]
    assert direction.obeyed is not None
    letter = direction.obeyed.sums["traction"][-1]
    planned = plan.certificate["wheel_energy"][plan.latest]
    assert letter == pytest.approx(planned, rel=0.1)
    assert abs(letter - direction.trips[0].sum("traction")) < 0.2 * JOULES_PER_KWH
    assert direction.trips[0].within_advice > 0.6
    # A log that holds no advice is compared with the speeds of the plan, here of another one.
    bare = replace(trip, topics={n: f for n, f in trip.topics.items() if n != "/reference"})
    other = compare(bare, plan_of(FLIRT, 0.5)).directions[0].trips[0]
    assert other.within_advice < 0.5 * direction.trips[0].within_advice


def test_where_a_plan_gives_no_advice_the_rest_is_compared() -> None:
    plan = plan_of(FLIRT)
    trip = obeyed_trip(plan, LINE, FLIRT)
    nameless = replace(plan, certificate={})
    found = compare(trip, nameless)
    assert found.directions[0].obeyed is None
    (said,) = [note for note in found.notes if "to the letter" in note]
    assert said.startswith("left out: advice, to the letter: ")
    assert found.facts()["left_out"] == (said.removeprefix("left out: "),)

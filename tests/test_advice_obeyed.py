"""Whoever obeys every row of the advice keeps the limits and arrives, with any configuration."""

import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from trajectory_cases import (
    FLIRT,
    FREIGHT,
    VIRM6,
    drawn,
    hilly_line,
    level_line,
    observed,
    optimised,
    optimised_journey,
)
from trip_parts import without

from analysis.comparison.compare import compare
from analysis.control.advised import EXACT, AdvisedDriver, Attention, obeyed_trip
from analysis.trajectory.advice import journey_advice, limits_of
from analysis.trajectory.instructions import Phase, instructions
from trainlog import InputError, Train, Trajectory, read_line, sample, trajectory_scenarios
from trainlog.arrays import FloatArray
from trainlog.railway.trajectory import Journey, TimingPoint
from trainlog.simulation import drive
from trainlog.units import JOULES_PER_KWH, KMH

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "control"))
from outcome import outcome

TRAINS = {"flirt": FLIRT, "virm": VIRM6, "freight": FREIGHT}


def test_speeds_are_whole_rounded_down_and_below_each_limit_of_the_row():
    limits = (0.0, 120.0), (5_000.0, 57 * 1.609344), (8_000.0, 130.0)
    line = replace(level_line(12_000.0, *limits), name="miles")
    plan = optimised(line, FLIRT, observed(FLIRT, 1.0, 1.1), reserve=0.03, cells=100)
    found = journey_advice([plan], line)
    for row in found.rows:
        point = row.instruction
        if point is None:
            continue
        assert KMH * point.target == pytest.approx(round(KMH * point.target), abs=1e-6)
        places = np.linspace(point.position, point.end - 1e-3, 200)
        limits = line.speed_limits(places)
        assert row.permitted == pytest.approx(limits[0])
        if point.phase is Phase.COASTING:
            continue
        # The target, and what is stated beside it of limits on the way.
        most = np.full(200, point.target)
        for cap in point.caps:
            inside = (places >= cap.start) & (places <= cap.end)
            most[inside] = np.minimum(most[inside], cap.speed)
        assert np.all(most <= limits + 1e-3) or point.phase > Phase.COASTING
    words = [row.words for row in found.rows]
    assert "brake to 91 km/h by km 5.000" in words


LINE = hilly_line()
LINES = {"hilly": LINE} | {
    name: read_line(sample(f"{name}.line.json"))
    for name in ("CH_StGallen_Wil", "DE_Chemnitz_Cranzahl")
}


@cache
def plan_of(name: str, reserve: float = 0.1, line: str = "hilly") -> Trajectory:
    train = TRAINS[name]
    configurations = [*observed(train, 0.85, 1.15), *drawn(train, 1, seed=3)]
    return optimised(LINES[line], train, configurations, reserve=reserve, cells=60)


def outcomes(plan: Trajectory, train: Train, attention: Attention, seed: int = 1) -> FloatArray:
    """Lateness [s], energy over planned, over the limit [m/s], off the stop [m], of each."""
    line = next(each for each in LINES.values() if each.name == plan.line)
    follows = partial(AdvisedDriver, plan, line, train, attention=attention, seed=seed)
    scenarios = trajectory_scenarios(plan, line, train, plan.chosen("all"), follows)
    return np.array([outcome(each, drive(each))[:4] for each in scenarios])


@cache
def to_the_letter(train: str, reserve: float = 0.1, line: str = "hilly") -> FloatArray:
    return outcomes(plan_of(train, reserve, line), TRAINS[train], EXACT)


@pytest.mark.parametrize(
    ("train", "reserve", "line"),
    [
        ("flirt", 0.1, "hilly"),
        ("flirt", 0.04, "hilly"),
        ("freight", 0.3, "hilly"),
        ("freight", 0.12, "hilly"),
        ("virm", 0.12, "DE_Chemnitz_Cranzahl"),
        pytest.param("virm", 0.04, "CH_StGallen_Wil", marks=pytest.mark.long),
        pytest.param("flirt", 0.4, "CH_StGallen_Wil", marks=pytest.mark.long),
    ],
)
def test_who_obeys_to_the_letter_keeps_limits_time_and_stop(train, reserve, line):
    """With brakes that take their time, which the plan does not know."""
    plan = plan_of(train, reserve, line)
    late, energy, over, stop = to_the_letter(train, reserve, line).T
    assert np.all(over < 0.6 / KMH)
    # Freight slips at its start.
    most = 0.1 * plan.running_time if train == "freight" else 0.02 * plan.running_time + 10.0
    assert np.all(late <= most)
    assert np.all(np.abs(stop) < 0.3)
    assert np.all(energy < 0.03)


def test_who_coasts_over_hills_and_dips_does_not_drive_for_a_speed_of_the_next_one():
    line, train = read_line(sample("CH_StGallen_Wil.line.json")), TRAINS["freight"]
    plan = optimised(line, train, observed(train, 1.15), reserve=0.4, cells=200)
    row = next(each for each in instructions(plan, limits_of(plan, line)) if len(each.course) > 6)
    assert row.phase is Phase.COASTING
    assert row.end - row.position > 15e3
    speeds = np.interp(row.turns, plan.positions, plan.speeds[0])
    np.testing.assert_allclose(speeds, row.course, atol=1e-6)
    follows = partial(AdvisedDriver, plan, line, train)
    (scenario,) = trajectory_scenarios(plan, line, train, plan.chosen("all"), follows)
    late, energy = outcome(scenario, drive(scenario))[:2]
    assert -0.02 * plan.running_time < late < 0.03 * plan.running_time
    assert abs(energy) < 0.05


def test_a_person_is_further_off_than_who_obeys_to_the_letter():
    plan = plan_of("flirt")
    exact = to_the_letter("flirt")
    persons = [outcomes(plan, FLIRT, Attention(), seed) for seed in range(2)]
    late, _, over, stop = np.concatenate(persons).T
    assert np.std([each[:, 0] for each in persons], axis=0).max() > 1.0
    assert exact[:, 2].max() < over.max() < 8.0 / KMH
    assert np.all(np.abs(stop) < 0.3)
    assert np.all(late < 0.1 * plan.running_time)


def test_a_trip_is_compared_with_its_advice():
    plan = plan_of("flirt")
    trip = obeyed_trip(plan, LINE, FLIRT)
    found = compare(trip, plan)
    (direction,) = found.directions
    table = next(each for each in found.tables() if each.name == "trips")
    assert [row[0] for row in table.rows] == ["driven-x1.15", "trajectory", "advice obeyed"]
    letter = direction.obeyed.sums["traction"][-1]
    planned = plan.certificate["wheel_energy"][plan.latest]
    assert letter == pytest.approx(planned, rel=0.1)
    assert abs(letter - direction.trips[0].sum("traction")) < 0.2 * JOULES_PER_KWH
    assert direction.trips[0].within_advice > 0.6
    # A log that holds no advice is compared with the speeds of the plan, here of another one.
    bare = without(trip, "/reference")
    other = compare(bare, plan_of("flirt", 0.5)).directions[0].trips[0]
    assert other.within_advice < 0.5 * direction.trips[0].within_advice
    # Where a plan gives no advice the rest is compared.
    nameless = compare(trip, replace(plan, certificate={}))
    assert nameless.directions[0].obeyed is None
    (note,) = [each for each in nameless.notes if "advice obeyed" in each]
    assert note.startswith("left out: advice obeyed: ")
    assert nameless.facts()["left_out"] == (note.removeprefix("left out: "),)


def test_a_trip_is_compared_with_the_plan_of_its_whole_journey():
    still = {"lowest_speed": 0.0, "highest_speed": 0.0}
    stops = [TimingPoint(each.position, **still) for each in LINE.stations]
    stops[0] = replace(stops[0], earliest=0.0, latest=0.0)
    journey = Journey("stopping", LINE.name, tuple(stops))
    loads = observed(FLIRT, 1.0, 1.1)
    plan = optimised_journey(LINE, FLIRT, loads, journey, dwell=40.0, cells=100, reserve=0.1)
    first, second = (obeyed_trip(each, LINE, FLIRT) for each in plan.sections)
    for reference in (plan, plan.sections[::-1]):
        found = compare([first, second], reference)
        (direction,) = found.directions
        whole = direction.reference
        assert whole.duration == pytest.approx(plan.running_time, abs=0.1)
        assert [(each.station, each.duration) for each in whole.stands] == [
            ("A", 0.0), ("B", pytest.approx(40.0, abs=0.1)), ("C", 0.0)
        ]  # fmt: skip
        work = sum(each.certificate["wheel_energy"][each.latest] for each in plan.sections)
        assert whole.sums["traction"][-1] == pytest.approx(work, rel=1e-6)
        assert whole.running[-1] == pytest.approx(whole.duration - 40.0, abs=0.1)
        assert direction.obeyed.covered[1] == pytest.approx(LINE.length, abs=5.0)
        assert direction.obeyed.sums["traction"][-1] == pytest.approx(work, rel=0.1)
        slips = [each.trip.slips.size for each in direction.trips]
        assert direction.obeyed.slips.size == sum(slips)
        assert [each.within_advice > 0.6 for each in direction.trips] == [True, True]
        # Each trip drove one section: it lost what the advice of that section loses.
        for trip, section in zip(direction.trips, plan.sections, strict=True):
            late = trip.trip.duration - section.times[section.latest, -1]
            assert trip.lost.total == pytest.approx(late, abs=3.0)
    refused(InputError, "no trajectory was given", compare, first, [])

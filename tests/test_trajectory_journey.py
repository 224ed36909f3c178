"""Passing points and journeys: windows are kept, prices agree, what cannot be is explained."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from refusals import refused
from simulated_line import steps
from trajectory_cases import (
    FLIRT,
    drawn,
    hilly_line,
    level_line,
    observed,
    optimised,
    optimised_journey,
)

from analysis.trajectory.journey import JourneyPlan, sections_of
from trainlog.errors import InfeasibleError, InputError
from trainlog.railway import Journey, TimingPoint, Trajectory

OPTIONS = {"running_time": 450.0, "cells": 100}
PLACE = 6_000.0


def run(*windows: TimingPoint, **options: object) -> Trajectory:
    question: dict[str, object] = {**OPTIONS, **options}
    return optimised(hilly_line(), FLIRT, observed(FLIRT, 1.0), windows=windows, **question)


def passing(found: Trajectory, place: float = PLACE) -> tuple[float, float]:
    node = int(np.flatnonzero(found.positions == place)[0])
    return float(found.times[0, node]), float(found.speeds[0, node])


@pytest.fixture(scope="module")
def free() -> Trajectory:
    return run(TimingPoint(PLACE))


@pytest.mark.parametrize("change", [-15.0, 15.0])
def test_windows_of_time_are_kept_and_cost(free, change):
    time = passing(free)[0] + change
    bound = {"latest": time} if change < 0.0 else {"earliest": time}
    window = TimingPoint(PLACE, **bound)
    found = run(window)
    assert passing(found)[0] == pytest.approx(time, abs=1e-3)
    certificate = found.certificate
    assert certificate["energy"] > 1.001 * free.certificate["energy"]
    assert certificate["gap"] <= 1e-3
    assert certificate["lower_bound"] > free.certificate["energy"]
    assert certificate["bound_holds_for"] == "all trajectories"


@pytest.mark.usefixtures("unrenewed")
def test_time_that_has_to_be_lost_is_left_out_of_the_bound(free):
    """Early at one point, late at the next: between them the train has to brake for nothing."""
    later = passing(free)[0] + 15.0
    found = run(TimingPoint(3_000.0, latest=150.0), TimingPoint(PLACE, earliest=later))
    assert passing(found)[0] >= later - 1e-4
    assert "early passing allowed" in found.certificate["bound_holds_for"]
    assert found.certificate["lower_bound"] < found.certificate["energy"]


def test_windows_of_speed_are_kept_and_certified(free):
    speed = passing(free)[1]
    fast = run(TimingPoint(PLACE, lowest_speed=speed + 2.0))
    slow = run(TimingPoint(PLACE, highest_speed=speed - 5.0))
    assert passing(fast)[1] >= speed + 2.0 - 1e-5
    assert passing(slow)[1] <= speed - 5.0 + 1e-5
    for found in (fast, slow):
        assert found.certificate["energy"] > free.certificate["energy"]
        assert found.certificate["gap"] <= 1e-3


def test_a_point_is_passed_at_just_one_speed_while_the_train_pulls_with_all_its_power():
    fastest = run()
    place = round(float(fastest.positions[np.argmax(fastest.tractive_effort_fall)])) + 20.0
    speed = float(fastest.speed_at(0, place)) - 1.0
    found = run(TimingPoint(place, lowest_speed=speed, highest_speed=speed))
    assert found.speed_at(0, place) == pytest.approx(speed, abs=1e-4)
    assert found.certificate["gap"] < 2e-3


def test_every_configuration_keeps_the_windows(free):
    configurations = drawn(FLIRT, 5, seed=3, spread=0.04)
    time = passing(free)[0]
    window = TimingPoint(PLACE, earliest=time, latest=time + 5.0)
    found = optimised(
        hilly_line(), FLIRT, configurations, running_time=450.0, windows=[window], cells=100
    )
    node = int(np.flatnonzero(found.positions == PLACE)[0])
    assert np.all(found.times[:, node] >= time - 1e-4)
    assert np.all(found.times[:, node] <= time + 5.0 + 1e-4)


@pytest.mark.parametrize(
    ("windows", "words"),
    [
        ((TimingPoint(5_000.0), TimingPoint(4_000.0)), "does not come after km 5.000"),
        ((TimingPoint(9_000.0),), "does not come after"),
        ((TimingPoint(4_000.0, highest_speed=0.0),), "stands at km 4.000, in the run"),
    ],
)
def test_passing_points_that_are_none_are_refused(windows, words):
    refused(InputError, words, run, *windows)


def stop(place: float, earliest: float | None = None, latest: float | None = None) -> TimingPoint:
    return TimingPoint(place, earliest, latest, 0.0, 0.0)


STOPS = Journey("stops", "hilly", (stop(0.0, 0.0, 0.0), stop(5_000.0), stop(8_000.0)))
ASKED = (hilly_line(), FLIRT, drawn(FLIRT, 2, seed=3))


@cache
def with_stops(objective: str) -> JourneyPlan:
    options = {"dwell": 30.0, "reserve": 0.12, "cells": 40, "objective": objective}
    return optimised_journey(*ASKED, STOPS, **options)


def test_reserve_is_shared_so_that_a_second_is_worth_the_same_everywhere():
    options = {"dwell": 30.0, "reserve": 0.12, "cells": 150}
    plan = optimised_journey(hilly_line(), FLIRT, observed(FLIRT, 1.0), STOPS, **options)
    assert plan.departures[1] >= plan.arrivals[0] + 30.0 - 1e-6
    least = sum(plan.certificate["least_running_times"])
    assert plan.arrivals[-1] == pytest.approx(30.0 + 1.12 * least)
    prices = [sum(each.certificate["time_price"].values()) for each in plan.sections]
    assert prices[0] == pytest.approx(prices[1], rel=0.15)
    assert plan.certificate["other_times_might_save"] <= 2e-4
    # Any other share costs more.
    for shift in (-6.0, 6.0):
        parts = [
            optimised(
                hilly_line(), FLIRT, observed(FLIRT, 1.0), start=start, end=end,
                running_time=time, cells=150,
            ).certificate["energy"]
            for start, end, time in (
                (0.0, 5_000.0, plan.arrivals[0] + shift),
                (5_000.0, 8_000.0, plan.arrivals[1] - plan.departures[1] - shift),
            )
        ]  # fmt: skip
        assert sum(parts) > plan.certificate["energy"]


def test_a_section_that_feeds_back_more_than_it_takes_gets_its_reserve():
    line = replace(level_line(6_000.0, (0.0, 90.0)), gradients=steps((0.0, 0.0), (3_500.0, -0.03)))
    journey = Journey("down", line.name, (stop(0.0, 0.0, 0.0), stop(3_000.0), stop(6_000.0)))
    options = {"reserve": 0.1, "cells": 60, "objective": "line"}
    plan = optimised_journey(line, FLIRT, observed(FLIRT, 1.0), journey, **options)
    assert plan.sections[1].certificate["energy"] < 0.0
    prices = [sum(each.certificate["time_price"].values()) for each in plan.sections]
    assert prices[0] == pytest.approx(prices[1], rel=0.15)


@pytest.mark.usefixtures("unrenewed")
def test_a_journey_at_the_line_is_worst_for_one_configuration_in_all_its_sections():
    """The worst of each section, added up, is more than any train takes."""
    plan = with_stops("line")
    certificate, times = plan.certificate, plan.arrivals - plan.departures
    apart = [
        optimised(*ASKED, start=start, end=end, running_time=time, cells=40, objective="line")
        for (start, end), time in zip(((0.0, 5e3), (5e3, 8e3)), times.tolist(), strict=True)
    ]
    together = sum(np.array(each.certificate["line_energy"]) for each in apart)
    assert certificate["energy"] <= np.max(together) * (1.0 + 2e-4)
    assert certificate["energy"] < sum(each.certificate["energy"] for each in apart)
    # Whatever the mixture, the expected energy of any plan is above its bound.
    mixture = [certificate["mixture"].get(each.name, 0.0) for each in ASKED[2]]
    assert sum(mixture) == pytest.approx(1.0)
    assert np.dot(mixture, together) >= certificate["lower_bound"]


def test_the_worst_mixture_of_two_plans_is_where_they_cost_the_same():
    """A plan x costs x² + 1 or (x - 1)² + 1.5: at worst least where both are the same."""
    from analysis.trajectory.journey import worst_mixture

    def energies(mixture: np.ndarray) -> np.ndarray:
        x = float(mixture[1])  # least expected cost of mixture[0] x² + mixture[1] (x - 1)²
        return np.array([x**2 + 1.0, (x - 1.0) ** 2 + 1.5, 0.5])

    found = worst_mixture(energies, np.array([1.0, 0.0, 0.0]))
    # x² + 1 = (x - 1)² + 1.5 at x = 0.75
    assert found == pytest.approx([0.25, 0.75, 0.0], abs=5e-3)


def test_arrivals_keep_their_windows_at_both_ends():
    points = (stop(0.0, 0.0, 0.0), stop(5_000.0, 250.0, 260.0), stop(5_000.0, 290.0, 300.0),
              stop(8_000.0, None, 470.0))  # fmt: skip
    journey = Journey("timed", "hilly", points)
    configurations = observed(FLIRT, 0.9, 1.1)
    plan = optimised_journey(hilly_line(), FLIRT, configurations, journey, cells=150)
    arrivals = plan.departures[0] + plan.sections[0].times[:, -1]
    assert np.all((arrivals >= 250.0 - 1e-3) & (arrivals <= 260.0 + 1e-3))
    assert 290.0 - 1e-6 <= plan.departures[1] <= 300.0 + 1e-6
    assert plan.departures[1] + plan.sections[1].times[:, -1].max() <= 470.0 + 1e-3


def test_journeys_that_cannot_be_are_explained():
    train = (hilly_line(), FLIRT, observed(FLIRT, 1.0))
    points = (stop(0.0, 0.0, 0.0), stop(5_000.0), stop(8_000.0, None, 300.0))
    with pytest.raises(InfeasibleError, match=r"is at km 8\.000 \(C\) after \d+\.\d s at the"):
        optimised_journey(*train, Journey("late", "hilly", points))
    with pytest.raises(InputError, match="is on line 'other', not on 'hilly'"):
        optimised_journey(*train, Journey("else", "other", points))
    with pytest.raises(InputError, match=r"ends at km 9\.000, the line at km 8\.000"):
        optimised_journey(*train, Journey("long", "hilly", (*points[:2], stop(9_000.0))))
    with pytest.raises(InputError, match="more than an arrival and a departure"):
        sections_of(Journey("thrice", "hilly", (points[0], *[points[1]] * 3, points[2])))


def test_two_points_at_one_position_are_a_stop_without_any_speed():
    """As the template has them: arrival, then departure."""
    points = (TimingPoint(0.0), TimingPoint(4e3, latest=300.0), TimingPoint(4e3, earliest=330.0))
    journey = Journey("a stop", "level", (*points, TimingPoint(8e3)))
    first, second = sections_of(journey)
    assert (first.arrival.latest, second.departure.earliest) == (300.0, 330.0)
    assert first.passing == second.passing == ()
    running = replace(points[1], highest_speed=20.0)
    with pytest.raises(InputError, match=r"stops at km 4\.000, where two points stand"):
        sections_of(replace(journey, points=(points[0], running, *journey.points[2:])))

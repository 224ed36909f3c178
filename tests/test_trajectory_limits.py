"""Limits, passing points and journeys are kept; what fails is solved again or not returned."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from refusals import refused
from trajectory_cases import (
    FLIRT,
    VIRM6,
    drawn,
    hilly_line,
    level_line,
    observed,
    optimised,
    optimised_journey,
    slippery,
    steps,
)

from analysis.studies.cunillera_2022 import phases_by_switching
from analysis.trajectory import active_set, convex, optimiser, sqp
from analysis.trajectory.active_set import Answer, initial_guess, searched
from analysis.trajectory.audit import Audit, audit
from analysis.trajectory.convex import NoSolutionError, power_cells
from analysis.trajectory.discretisation import discretise, graded_mesh
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.instructions import Phase, phase_letters, phases_by_control
from analysis.trajectory.journey import JourneyPlan, sections_of
from analysis.trajectory.optimiser import GAP_TOLERANCE, optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from analysis.trajectory.rollout import run_together
from analysis.trajectory.sqp import Solution
from trainlog.arrays import FloatArray
from trainlog.errors import InfeasibleError, InputError, TrainlogError
from trainlog.formats.railway import read_line, read_train, read_trajectory, write_trajectory
from trainlog.formats.samples import sample
from trainlog.railway import (
    Configuration,
    CurvatureProfile,
    EffortCurve,
    Journey,
    Line,
    TimingPoint,
    TrackConditionMap,
    Train,
    Trajectory,
)


def test_all_the_power_is_used_inside_the_cells():
    """Traction that is constant in a cell would waste half of what the speed gains there."""
    train = Configuration.of(FLIRT)
    found = optimised(configurations=[train], reserve=0.05, cells=120, tolerance=np.inf)
    middle = 0.5 * (found.positions[1:] + found.positions[:-1])
    speed = np.interp(middle, found.positions, found.speeds[0] ** 2) ** 0.5
    used = found.tractive_effort_at(middle) * speed / train.max_power
    gains = np.diff(found.speeds[0]) / np.maximum(found.speeds[0, :-1], 1.0)
    pulling = (used > 0.99) & (gains > 0.015)
    assert pulling.sum() >= 20
    assert used[pulling].max() <= 1.0
    assert np.all(1.0 - used[pulling] < 0.02 * gains[pulling])


def test_the_map_limits_the_efforts_where_it_was_observed():
    line = level_line(8_000.0, (0.0, 100.0))
    condition = slippery(line, (0.0, 400.0, 0.10), (7_800.0, 8_000.0, 0.06))
    nothing = np.zeros(condition.bins, dtype=bool)
    blind = replace(condition, layers={"wet": replace(condition.layers["wet"], observed=nothing)})
    found, free, unaware = (
        optimised(
            line, FLIRT, observed(FLIRT, 1.0), running_time=420.0, condition_map=known, cells=120
        )
        for known in (condition, None, blind)
    )
    starting = found.positions[:-1] < 350.0
    cautious = 0.10 * np.exp(-0.1)
    assert found.tractive_effort[starting].max() == pytest.approx(
        cautious * FLIRT.adhesive_weight(), rel=1e-6
    )
    assert found.certificate["audit"]["adhesion"] <= 1.0 + 1e-6
    assert free.certificate["energy"] < found.certificate["energy"]
    assert np.array_equal(unaware.tractive_effort, free.tractive_effort)


@pytest.mark.parametrize("seed", range(4))
def test_a_common_brake_is_within_what_the_weakest_can_do(seed):
    """The lightest keeps its deceleration with less effort than the heaviest has."""
    run = TrajectoryProblem(
        hilly_line(), FLIRT, drawn(FLIRT, 4, seed=seed, spread=0.2), braking="common",
        final_speed=8.0,
    )  # fmt: skip
    fastest = fastest_run(run)
    problem = discretise(run, np.linspace(0.0, 8_000.0, 161))
    tapered, plan = run_together(problem, fastest.at(problem.positions))
    braking, most = plan.braking, tapered.most_braking(plan.z)
    assert braking.max() > 0.9 * most.min(axis=0).max()
    assert np.all(braking <= most * (1.0 + 1e-9))


@pytest.mark.parametrize(
    "line", [level_line(10_000.0, (0.0, 100.0), (4_000.0, 70.0)), hilly_line()]
)
def test_one_brake_for_all_costs_no_less_and_its_bound_is_close(line):
    asked = (line, FLIRT, observed(FLIRT, 0.97, 1.0, 1.03))
    options = {"final_speed": 10.0, "cells": 150}
    common = optimised(*asked, braking="common", reserve=0.1, **options)
    own = optimised(*asked, running_time=common.running_time, **options)
    assert len(common.certificate["active"]) == 2
    assert common.certificate["gap"] <= 5e-4
    assert np.array_equal(common.braking_effort[0], common.braking_effort[2])
    assert np.all(common.speeds[:, -1] <= 10.0 + 1e-5)
    assert common.certificate["energy"] >= own.certificate["energy"] * (1.0 - 1e-6)


@pytest.mark.usefixtures("unrenewed")
def test_limits_and_power_are_kept_and_few_configurations_decide():
    """From standstill to standstill, the power at both ends of every cell."""
    line, configurations = hilly_line(), drawn(FLIRT, 12, seed=1)
    found = optimised(line, FLIRT, configurations, reserve=0.1, cells=150)
    middle = 0.5 * (found.positions[1:] + found.positions[:-1])
    limit = line.speed_limit(middle)
    power = np.array([[c.max_power] for c in configurations]) * (1.0 + 1e-6)
    for half, nodes in ((0.5, slice(0, -1)), (-0.5, slice(1, None))):
        effort = found.tractive_effort + half * found.tractive_effort_fall
        assert np.all(found.speeds[:, nodes] <= limit + 1e-5)
        assert np.all(effort * found.speeds[:, nodes] <= power)
    assert np.all(found.speeds[:, [0, -1]] == 0.0)
    assert np.diff(found.positions)[0] < 1.0
    assert -5e-3 <= found.times[:, -1].max() - found.running_time <= 1e-4
    times = 2.0 * np.diff(found.positions) / (found.speeds[:, 1:] + found.speeds[:, :-1])
    assert np.diff(found.times, axis=1) == pytest.approx(times, rel=2e-3)
    certificate = found.certificate
    assert len(certificate["audit"]["arrival"]) == len(certificate["phases"]) == 12
    assert {len(letters) for letters in certificate["phases"]} == {found.positions.size - 1}
    assert 1 <= len(certificate["active"]) <= 5
    assert certificate["gap"] <= 5e-3
    alone = optimised(
        line, FLIRT, [c for c in configurations if c.name in certificate["active"]],
        running_time=found.running_time, cells=150,
    )  # fmt: skip
    # Limits that all share, as the comfort of the lightest, are left out here: never costlier.
    assert alone.certificate["energy"] <= certificate["energy"] * (1.0 + 2e-5)


@pytest.mark.usefixtures("unrenewed")
def test_same_question_same_answer(tmp_path):
    for name in ("a.json", "b.json"):
        found = optimised(configurations=drawn(FLIRT, 3, seed=2), cells=100)
        write_trajectory(found, tmp_path / name)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    again = read_trajectory(tmp_path / "a.json")
    assert np.array_equal(again.speeds, found.speeds)
    assert again.certificate["gap"] == found.certificate["gap"]


def unreadable(line: Line) -> TrackConditionMap:
    """A map that marks a bin as observed and has no value there."""
    condition = slippery(line)
    layer = condition.layers["wet"]
    log_mean = layer.log_mean.copy()
    log_mean[5] = np.nan
    return replace(condition, layers={"wet": replace(layer, log_mean=log_mean)})


def test_a_limit_below_walking_pace_is_refused_before_any_solver_runs():
    line = level_line(8_000.0, (0.0, 80.0), (3_000.0, 0.04), (4_000.0, 80.0))
    with pytest.raises(InputError, match=r"0\.04 km/h permitted at km 3\.000 is not a speed"):
        optimised(line, FLIRT, observed(FLIRT, 1.0))


def test_expected_energy_is_least_for_the_weights_that_are_given():
    options = {"reserve": 0.1, "cells": 120, "tolerance": 1e-4}
    options["configurations"] = observed(FLIRT, 0.9, 1.0, 1.1)
    found = {
        weights: optimised(objective="expected", weights=weights, **options)
        for weights in ((), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    }
    energies = {key: np.array(each.certificate["line_energy"]) for key, each in found.items()}
    for weights, answer in found.items():
        share = np.array(weights or np.ones(3)) / (sum(weights) or 3.0)
        least = share @ energies[weights]
        assert answer.certificate["energy"] == pytest.approx(least)
        assert all(share @ other >= least * (1.0 - 1e-6) for other in energies.values())
        assert answer.certificate["gap"] <= 2e-3
    worst = optimised(objective="line", **options)
    assert worst.certificate["energy"] <= energies[()].max() * (1.0 + 1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"configurations": []}, "no parameter configuration"),
        ({"configurations": observed(FLIRT, 1.0, 1.0)}, "two configurations are called 'x1'"),
        ({"start": 5_000.0, "end": 4_000.0}, "is not a section"),
        ({"start": 0.0, "end": 1e-6}, "would run 1e-06 m, less than 10 m; give an end farther"),
        ({"start": 0.0, "end": 2.0}, "would run 2 m, less than 10 m"),
        ({"initial_speed": -1.0}, "must be finite and not negative"),
        ({"initial_speed": 30.0}, "above the 90.0 km/h permitted"),
        ({"braking": "none"}, "no such braking 'none'"),
        ({"objective": "time"}, "objective 'time'"),
        ({"tolerance": -1e-3}, "tolerance of the gap must be 0 or more"),
        ({"cells": 3}, "must have 20 to 20000 cells, not 3; give"),
        ({"cells": 10**8}, "must have 20 to 20000 cells"),
        ({"reserve": -0.1}, "the reserve must be 0 to 500%, not -10%"),
        ({"reserve": 7.0}, "the reserve must be 0 to 500%, not 700%"),
        ({"running_time": np.nan}, "running time must be above 0 and finite, not nan s"),
        ({"running_time": -5.0}, "not -5.0 s; give the timetable's"),
        ({"condition_map": slippery(level_line(5_000.0))}, "is of line '"),
        *(
            (
                {"condition_map": replace(slippery(hilly_line()), length=length)},
                f", {length:g} m, not",
            )
            for length in (5_000.0, hilly_line().length + 0.5)
        ),
        ({"condition_map": slippery(hilly_line()), "layer": "icy"}, "no layer 'icy'"),
        (
            {"condition_map": slippery(hilly_line()), "sigmas": -2.0},
            "map must be 0 or more, not -2.0",
        ),
        ({"condition_map": unreadable(hilly_line())}, r"has no adhesion at km 0\.\d+, which it"),
        ({"protected_length": -1.0}, "the protected length must be 0 or more, not -1.0 m"),
        ({"running_time": 8e3}, r"is 2\d\.\d times the least, .* from km 0\.000 \(A\)"),
        ({"running_time": 1e9}, r"is 3\.\d+e\+06 times the least, .*let it wait at a station"),
        ({"objective": "expected", "weights": [1.0, 2.0]}, "2 weights for 1 configuration"),
        ({"objective": "expected", "weights": [-1.0]}, "must be 0 or more, not -1"),
        ({"objective": "expected", "weights": [np.nan]}, "must be 0 or more, not nan"),
        ({"objective": "expected", "weights": [0.0]}, "the weights add up to 0"),
    ],
)
def test_bad_input_is_refused(changes, words):
    question: dict[str, object] = {"configurations": observed(FLIRT, 1.0), **changes}
    refused(InputError, words, optimised, hilly_line(), FLIRT, **question)


def test_weights_of_many_are_kept_and_those_without_weight_have_no_say():
    """Ten configurations of which three count: the same as the expected energy of these."""
    weights = np.zeros(10)
    weights[[3, 5, 8]] = 0.5, 0.3, 0.2
    question = {"objective": "expected", "weights": weights.tolist(), "reserve": 0.1, "cells": 80}
    certificate = optimised(configurations=drawn(FLIRT, 10, seed=2), **question).certificate
    assert certificate["energy"] == pytest.approx(weights @ certificate["line_energy"])
    assert certificate["certified"]


def test_few_decide_at_the_line_where_the_dynamic_brake_is_weak():
    """Whoever has time brakes early, without friction: no reason to optimise for all of them."""
    question = {"objective": "line", "reserve": 0.07, "cells": 80}
    found = optimised(train=VIRM6, configurations=drawn(VIRM6, 8, seed=1), **question).certificate
    assert len(found["active"]) <= 6
    assert found["solver"]["iterations"] <= 40
    assert found["energy"] == max(found["line_energy"])
    assert found["gap"] < 5e-3


@pytest.mark.parametrize("objective", ["wheel", "line"])
def test_few_decide_where_a_point_is_passed_no_earlier(objective, unrenewed):
    """Whoever would be too soon brakes by itself: no reason to optimise for all of them."""
    line, configurations = hilly_line(), drawn(FLIRT, 12, seed=3)
    free = TrajectoryProblem(line, FLIRT, configurations, reserve=0.5, objective=objective)
    passed = 0.5 * line.length
    times = fastest_run(free).times_at([passed])[:, 0]
    points = (TimingPoint(passed, earliest=1.4 * times.max(), latest=1.4 * times.max() + 15.0),)
    found = optimise(replace(free, windows=points), OptimiserOptions(150)).certificate
    assert len(found["active"]) <= 4


def test_when_the_time_is_over_the_best_so_far_is_the_answer_with_its_gap(unrenewed):
    problem = TrajectoryProblem(
        hilly_line(), VIRM6, drawn(VIRM6, 4, seed=1), objective="line", reserve=0.07
    )
    soon, whole = (
        optimise(problem, OptimiserOptions(80, time_limit=limit)).certificate
        for limit in (1e-3, None)
    )
    assert "time limit" in soon["solver"]["statuses"]
    assert "time limit" not in whole["solver"]["statuses"]
    assert soon["audit"]["passed"]
    assert soon["gap"] > whole["gap"]
    assert not soon["certified"]
    assert soon["lower_bound"] <= whole["energy"] < soon["energy"]


PLACE = 6_000.0


def run(*windows: TimingPoint, **options: object) -> Trajectory:
    question: dict[str, object] = {"running_time": 450.0, "cells": 100, **options}
    return optimised(windows=windows, **question)


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
            optimised(start=start, end=end, running_time=time, cells=150).certificate["energy"]
            for start, end, time in (
                (0.0, 5_000.0, plan.arrivals[0] + shift),
                (5_000.0, 8_000.0, plan.arrivals[1] - plan.departures[1] - shift),
            )
        ]  # fmt: skip
        assert sum(parts) > plan.certificate["energy"]


def test_a_section_that_feeds_back_more_than_it_takes_gets_its_reserve():
    line = level_line(6_000.0, (0.0, 90.0), gradients=steps((0.0, 0.0), (3_500.0, -0.03)))
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


OPTIONS: dict[str, Any] = {"reserve": 0.1, "cells": 120, "tolerance": np.inf}


@pytest.fixture(scope="module")
def usual() -> Trajectory:
    return optimised(configurations=observed(FLIRT, 1.0, 1.05), **OPTIONS)


def same(found: Trajectory, usual: Trajectory) -> bool:
    """Whether an audited answer is the usual one, to what the programs leave."""
    assert found.certificate["audit"]["passed"]
    least = usual.certificate["energy"]
    return bool(abs(found.certificate["energy"] / least - 1.0) <= 3e-5)


def test_the_answer_of_a_solver_that_stops_early_is_solved_again(usual, monkeypatch):
    monkeypatch.setitem(convex._SETTINGS, "max_iter", 3)
    found = optimised(configurations=observed(FLIRT, 1.0, 1.05), **OPTIONS)
    assert {word.split()[0] for word in found.certificate["solver"]["statuses"]} == {"CLARABEL"}
    assert same(found, usual)


@pytest.mark.parametrize("shift", [0, 5])
def test_a_program_solved_about_a_point_loses_little_of_the_whole(shift, usual, monkeypatch):
    """Whether the point is near its optimum, or has its efforts and speeds elsewhere."""
    whole, seen = convex.solve, []

    def both(*arguments: Any, near: convex.Near | None = None, **options: Any) -> Any:
        if near is not None:
            near = near._replace(point=np.roll(near.point, shift))
        about = whole(*arguments, near=near, **options)
        if near is not None and arguments[0].size > 2_000:
            lost = about.value / whole(*arguments, **options).value - 1.0
            found = isinstance(about.loose, np.ndarray)
            seen.append((lost, min(max(1e-6, 0.03 * near.changed), 1e-3), found))
        return about

    monkeypatch.setattr(sqp, "solve", both)
    train = read_train(sample("CH_Stadler_FLIRT_TPF.train.json"))
    line = read_line(sample("CH_StGallen_Wil.line.json"))
    optimised(line, train, drawn(train, 30, seed=1), reserve=0.05, cells=1_000)
    lost, may_lose, found = np.transpose(seen)
    assert lost.size > 2
    assert shift > 0 or np.all(found)
    assert np.all(np.abs(lost) <= may_lose)
    assert abs(lost[-1]) <= 1e-6


@pytest.mark.parametrize("wrong", ["no solution", "not converged"])
def test_iterations_that_fail_begin_again_from_the_cone_relaxation(wrong, usual, monkeypatch):
    minimise, seen = active_set.minimise, []

    def fails_first(*arguments: Any, **options: Any) -> Solution:
        seen.append(True)
        if wrong == "no solution" and len(seen) == 1:
            raise NoSolutionError("user_limit")
        return replace(minimise(*arguments, **options), converged=len(seen) > 1)

    monkeypatch.setattr(active_set, "minimise", fails_first)
    found = optimised(configurations=observed(FLIRT, 1.0, 1.05), **OPTIONS)
    assert found.certificate["solver"]["statuses"][0].startswith("CLARABEL")
    assert same(found, usual)


@pytest.mark.parametrize(
    ("factor", "words"), [(0.98, "arrives late"), (1.05, "(is too fast|exceeds the)")]
)
def test_an_answer_that_was_tampered_with_is_not_returned(factor, words, monkeypatch):
    search = active_set.search

    def tampered(*arguments: Any, **options: Any) -> Answer:
        answer = search(*arguments, **options)
        plan = answer.plan
        return replace(answer, plan=replace(plan, traction=factor * plan.traction))

    monkeypatch.setattr(active_set, "search", tampered)
    monkeypatch.setattr(optimiser, "_paced", lambda *_: None)
    with pytest.raises(TrainlogError, match=f"does not pass its audit: .* {words}"):
        optimised(reserve=0.1, cells=40)


@pytest.mark.usefixtures("unrenewed")
def test_a_grid_too_coarse_for_the_timetable_is_made_finer():
    line, train = hilly_line(), observed(FLIRT, 1.0)
    least = optimised(line, FLIRT, train, reserve=0.0, cells=120).running_time
    found = optimised(line, FLIRT, train, running_time=least, cells=80)
    assert found.positions.size - 1 > 80


@pytest.mark.usefixtures("unrenewed")
def test_a_run_without_reserve_is_the_fastest():
    times = []
    for cells in (60, 120):
        found = optimised(configurations=drawn(FLIRT, 2, seed=2), reserve=0.0, cells=cells)
        times.append(found.running_time / max(found.certificate["least_time"]) - 1.0)
    # None is faster than alone under traction that follows the power; finer cells come closer.
    assert 0.0 < times[1] < times[0] < 5e-3


def test_a_run_on_next_to_no_energy_is_certified_all_the_same():
    down = level_line(3_000.0, (0.0, 43.2), gradients=steps((0.0, -0.0234)))
    found = optimised(down, FLIRT, drawn(FLIRT, 2, seed=0), reserve=0.5, cells=80)
    certificate = found.certificate
    assert certificate["lower_bound"] <= certificate["energy"] < 1.0
    assert certificate["certified"]
    assert len(certificate["solver"]["statuses"]) <= 15
    assert np.all(found.speeds[:, 1:-1] > 0.0)


def test_cells_too_long_to_be_passed_within_their_limit_have_no_power():
    """At 5 km/h through a transition of 1.5 km in one cell: the train is faster inside."""
    bends = CurvatureProfile([0.0, 1_000.0, 2_500.0], [0.0, 0.0, 5e-3], [0.0, 5e-3, 5e-3])
    line = level_line(3_000.0, (0.0, 5.0), curvatures=bends)
    problem = TrajectoryProblem(line, FLIRT, observed(FLIRT, 1.0))
    cells = discretise(problem, np.array([0.0, 500.0, 1_000.0, 2_500.0, 2_750.0, 3_000.0]))
    assert np.flatnonzero(cells.ceiling < 0.0).tolist() == [2, 3]
    assert power_cells(cells, 0.5, np.ones(5)).tolist() == [0, 1, 3, 4]


def test_a_stop_within_one_long_cell_is_driven_to_the_millimetre():
    """Steps near the standstill are inexact: the train stops short, unless the cell is split."""
    run = TrajectoryProblem(level_line(8_000.0, (0.0, 120.0)), FLIRT, observed(FLIRT, 1.0))
    fastest = fastest_run(run)
    ramp = np.array([0.0, 2.0, 6.0, 15.0, 40.0, 100.0, 250.0, 600.0])
    problem = discretise(run, np.append(ramp, np.arange(1_000.0, 8_001.0, 500.0)))
    time = 1.1 * float(fastest.times[0])
    guess = initial_guess(problem, fastest.at(problem.positions), time)
    answer, found, _ = searched(problem, guess, fastest, time)
    assert found.failures(run, time) == []
    assert answer.problem.step[-1] < 0.5 * problem.step[-1]


def test_phases_by_control():
    traction = np.array([100.0, 60.0, 0.0, 0.0, 0.0, 40.0])
    braking = np.array([0.0, 0.0, 0.0, 30.0, 50.0, 25.0])
    phases = phases_by_control(traction, braking, np.full(6, 100.0), np.full(6, 50.0))
    assert phase_letters(phases) == "TPCHBP"
    switching = np.array([1.5, 1.0, 0.5, 0.0, -0.5, 1.0])
    assert phase_letters(phases_by_switching(switching)) == "TPCHBP"
    assert Phase.MAXIMUM_TRACTION.label == "maximum traction"


def test_mesh_goes_through_every_breakpoint_and_is_fine_where_speed_changes():
    positions = np.linspace(0.0, 1_000.0, 1_001)
    speeds = np.minimum(np.sqrt(2.0 * positions), 20.0)
    breakpoints = np.array([0.0, 333.3, 777.7, 1_000.0])
    mesh = graded_mesh(breakpoints, positions, speeds, 100)
    assert np.isin(breakpoints, mesh).all()
    assert abs(mesh.size - 1 - 100) <= 3
    assert np.diff(mesh)[0] < 0.2 * np.diff(mesh)[-1]
    # Cells are to spare on a line of many breakpoints.
    assert graded_mesh(positions[::10], positions, speeds, 80).size - 1 >= 118


LINES = {"level": level_line(12_000.0, (0, 140), (5_000, 90), (9_000, 120)), "hilly": hilly_line()}


def curve(*points: tuple[float, float]) -> EffortCurve:
    """Points in km/h and kN."""
    speeds, efforts = np.array(points).T
    return EffortCurve(speeds / 3.6, 1e3 * efforts)


LINEAR = curve((0, 200), (47, 190), (72, 120), (108, 60), (160, 35))
"""Falls faster than a power lets it."""

STEPPED = curve((0, 200), (36, 195), (43, 150), (90, 100), (94, 60), (165, 52))
FADING = curve((0, 0), (7, 100), (29, 150), (72, 110), (162, 50))
"""A dynamic brake that fades towards the stop, too."""

BUMPED = curve((0, 180), (36, 120), (72, 80), (90, 95), (108, 80), (162, 35))
"""Rises once, as no plan may count on in a cell that it passes."""

TRAINS = {
    "linear": replace(FLIRT, traction_curve=LINEAR),
    "stepped": replace(FLIRT, traction_curve=STEPPED, dynamic_braking_curve=FADING),
    "bumped": replace(VIRM6, traction_curve=BUMPED, dynamic_braking_curve=BUMPED),
}


def within(train: Train, trajectory: Trajectory) -> FloatArray:
    """Largest traction over what each configuration's own curve gives, at both ends of cells."""
    ends = [
        (trajectory.tractive_effort + half * trajectory.tractive_effort_fall, nodes)
        for half, nodes in ((0.5, slice(0, -1)), (-0.5, slice(1, None)))
    ]
    return np.array(
        [
            max(
                float((effort / train.tractive_effort_limit(speeds[nodes], each.max_power)).max())
                for effort, nodes in ends
            )
            for each, speeds in zip(trajectory.configurations, trajectory.speeds, strict=True)
        ]
    )


@pytest.mark.parametrize(
    ("train", "line"), [("linear", "hilly"), ("stepped", "level"), ("bumped", "level")]
)
def test_plans_stay_within_the_curve_and_pass_their_audit(train, line):
    configurations = drawn(TRAINS[train], 2, seed=3, spread=0.05)
    trajectory = optimised(LINES[line], TRAINS[train], configurations, reserve=0.1, cells=80)
    certificate = trajectory.certificate
    assert max(certificate["audit"][name] for name in ("effort", "braking")) <= 1.0 + 1e-6
    # A plan leaves out what rises again, which the bound counts; the certificate states it.
    assert -1e-6 <= certificate["gap"] <= (5e-3 if train == "bumped" else GAP_TOLERANCE)
    excess = certificate["energy"] - certificate["lower_bound"]
    assert certificate["certified"] == (excess <= certificate["tolerance"])
    assert np.all(within(TRAINS[train], trajectory) <= 1.0 + 1e-6)


@pytest.mark.usefixtures("unrenewed")
@pytest.mark.parametrize("kind", ["effort", "braking"])
def test_what_an_audit_finds_beyond_a_curve_is_taken_off_it(kind, monkeypatch):
    """As for a train that gives a ten-thousandth less than its curve states."""

    def less(answer: active_set.Answer) -> Audit:
        found = driven(answer)
        return replace(found, **{kind: 1.0001 * getattr(found, kind)})

    driven = active_set.driven
    monkeypatch.setattr(active_set, "driven", less)
    # All braking is dynamic, and goes with its curve at high speeds.
    train = replace(
        FLIRT, traction_curve=LINEAR, dynamic_braking_curve=curve((0, 90), (60, 60), (162, 20)),
        max_pneumatic_braking_effort=1.0,
    )  # fmt: skip
    trajectory = optimised(LINES["level"], train, drawn(train, 2, seed=3), reserve=0.1, cells=80)
    used = within(train, trajectory).max()
    if kind == "braking":
        fastest = np.maximum(trajectory.speeds[:, :-1], trajectory.speeds[:, 1:])
        most = 1.0 + train.dynamic_braking_effort_limit(fastest)
        used = (trajectory.braking_effort / most).max()
    assert 0.999 < used <= 1.0 / 1.0001 + 1e-6


def test_a_common_brake_stops_a_train_whose_dynamic_brake_fades():
    train = TRAINS["stepped"]
    trajectory = optimised(
        LINES["hilly"], train, [Configuration.of(train)], reserve=0.08, braking="common", cells=100
    )
    assert trajectory.certificate["certified"]
    assert np.all(within(train, trajectory) <= 1.0 + 1e-6)


@pytest.mark.usefixtures("unrenewed")
def test_without_its_curve_a_train_would_be_asked_for_more_than_it_gives():
    """Effort and power alone ask this train for 54 kN where it gives 48."""
    known = replace(
        FLIRT,
        max_tractive_effort=100e3,
        max_traction_power=1.35e6,
        traction_curve=curve((0, 100), (36, 96), (90, 48), (140, 26)),
    )
    at = 25.0
    alone = replace(known, traction_curve=None)
    assert float(alone.tractive_effort_limit(at)) == pytest.approx(54e3)
    assert float(known.tractive_effort_limit(at)) == pytest.approx(48e3)
    configurations = [Configuration.of(known)]
    line = LINES["level"]
    blind = optimised(line, alone, configurations, reserve=0.05, cells=80)
    run = TrajectoryProblem(line, known, configurations)
    refused = audit(
        run, blind.positions, blind.tractive_effort, 0.5 * blind.tractive_effort_fall,
        blind.braking_effort,
    )  # fmt: skip
    assert refused.effort[0] > 1.1
    assert any("exceeds the traction" in each for each in refused.failures(run, np.inf))
    seeing = optimised(line, known, configurations, reserve=0.05, cells=80)
    assert np.all(within(known, seeing) <= 1.0 + 1e-6)
    assert seeing.certificate["audit"]["effort"] <= 1.0 + 1e-6


@pytest.mark.usefixtures("unrenewed")
def test_a_curve_that_is_the_hyperbola_gives_what_effort_and_power_give():
    speeds = np.linspace(0.0, 50.0, 501)
    hyperbola = EffortCurve(speeds, FLIRT.tractive_effort_limit(speeds))
    same = replace(FLIRT, traction_curve=hyperbola, max_traction_power=3.0 * 2.6e6)
    results = []
    for train in (FLIRT, same):
        run = TrajectoryProblem(LINES["hilly"], train, [Configuration.of(train)])
        plan = optimised(
            LINES["hilly"], train, [Configuration.of(train)], running_time=400.0, cells=60
        )
        results.append((float(fastest_run(run).times[0]), plan.certificate["energy"]))
    assert results[1] == pytest.approx(results[0], rel=2e-4)


def test_the_fastest_run_of_a_linear_curve_is_that_of_its_closed_form():
    """Without resistance ``dv/dt = a (1 - v/w)``: after t the speed is ``w (1 - exp(-a t/w))``."""
    train = replace(
        FLIRT,
        resistance=replace(FLIRT.resistance, r0=0.0, r1=0.0, r2=0.0),
        traction_curve=curve((0, 100), (200, 0)),
        max_speed=50.0,
    )
    line = level_line(6_000.0, (0, 180))
    run = TrajectoryProblem(line, train, [Configuration.of(train)], final_speed=50.0)
    fastest = fastest_run(run)
    a, w = 100e3 / (train.mass + train.rotating_mass), 200.0 / 3.6
    v = fastest.speeds[0, 1:]
    needed = -w / a * (v + w * np.log1p(-v / w))
    np.testing.assert_allclose(needed[40:500], fastest.positions[41:501], rtol=1e-6)

"""What a trajectory has to keep to: limits, adhesion, stops, brakes, the file it is written to."""

from __future__ import annotations

from dataclasses import replace

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
    slippery,
)

from analysis.trajectory.discretisation import discretise
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from analysis.trajectory.rollout import run_together
from trainlog.errors import InputError
from trainlog.formats.railway import read_trajectory, write_trajectory
from trainlog.railway import Configuration, Line, TimingPoint, TrackConditionMap


def test_all_the_power_is_used_inside_the_cells():
    """Traction that is constant in a cell would waste half of what the speed gains there."""
    train = Configuration.of(FLIRT)
    found = optimised(hilly_line(), FLIRT, [train], reserve=0.05, cells=120, tolerance=np.inf)
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


def test_common_brakes_are_common_and_cost_no_less():
    options = {"running_time": 1541.0, "initial_speed": 1.0, "final_speed": 15.0, "cells": 150}
    configurations = observed(VIRM6, 0.97, 1.0, 1.03)
    common = optimised(level_line(), VIRM6, configurations, braking="common", **options)
    own = optimised(level_line(), VIRM6, configurations, **options)
    assert np.array_equal(common.braking_effort[0], common.braking_effort[2])
    assert np.all(common.speeds[:, -1] <= 15.0 + 1e-5)
    assert common.certificate["energy"] >= own.certificate["energy"] * (1.0 - 1e-6)


@pytest.mark.parametrize(
    "line", [level_line(10_000.0, (0.0, 100.0), (4_000.0, 70.0)), hilly_line()]
)
def test_the_bound_is_close_where_one_brakes_for_others(line):
    options = {"braking": "common", "final_speed": 10.0, "reserve": 0.1, "cells": 150}
    found = optimised(line, FLIRT, observed(FLIRT, 0.97, 1.0, 1.03), **options).certificate
    assert len(found["active"]) == 2
    assert found["gap"] <= 5e-4


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
        found = optimised(hilly_line(), FLIRT, drawn(FLIRT, 3, seed=2), cells=100)
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
    configurations = observed(FLIRT, 0.9, 1.0, 1.1)
    found = {
        weights: optimised(
            hilly_line(), FLIRT, configurations, objective="expected", weights=weights, **options
        )
        for weights in ((), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    }
    energies = {key: np.array(each.certificate["line_energy"]) for key, each in found.items()}
    for weights, answer in found.items():
        share = np.array(weights or np.ones(3)) / (sum(weights) or 3.0)
        least = share @ energies[weights]
        assert answer.certificate["energy"] == pytest.approx(least)
        assert all(share @ other >= least * (1.0 - 1e-6) for other in energies.values())
        assert answer.certificate["gap"] <= 2e-3
        assert answer.certificate["audit"]["passed"]
    worst = optimised(hilly_line(), FLIRT, configurations, objective="line", **options)
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


OPTIONS = {"reserve": 0.1, "cells": 80}


def test_weights_of_many_are_kept_and_those_without_weight_have_no_say():
    """Ten configurations of which three count: the same as the expected energy of these."""
    configurations = drawn(FLIRT, 10, seed=2)
    weights = np.zeros(10)
    weights[[3, 5, 8]] = 0.5, 0.3, 0.2
    found = optimised(
        hilly_line(), FLIRT, configurations, objective="expected", weights=weights.tolist(),
        **OPTIONS,
    )  # fmt: skip
    certificate = found.certificate
    assert certificate["energy"] == pytest.approx(weights @ certificate["line_energy"])
    assert certificate["certified"]
    assert certificate["audit"]["passed"]


def test_few_decide_at_the_line_where_the_dynamic_brake_is_weak():
    """Whoever has time brakes early, without friction: no reason to optimise for all of them."""
    configurations = drawn(VIRM6, 8, seed=1)
    found = optimised(
        hilly_line(), VIRM6, configurations, objective="line", reserve=0.07, cells=80
    ).certificate
    assert found["audit"]["passed"]
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
    assert found["audit"]["passed"]
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

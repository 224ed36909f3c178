"""Many configurations at the line: few stand for the others, and the bound holds for all."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from trajectory_cases import FLIRT, VIRM6, drawn, hilly_line, level_line, optimised

from analysis.trajectory import representatives
from analysis.trajectory.discretisation import discretise
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from trainlog.errors import InputError

OPTIONS = {"reserve": 0.1, "cells": 80}


def test_few_stand_for_many_in_the_expected_energy(monkeypatch: pytest.MonkeyPatch) -> None:
    configurations = drawn(FLIRT, 24, seed=2, spread=0.03)
    found = {}
    for few in (12, 24):
        monkeypatch.setattr(representatives, "MOST_EXPLICIT", few)
        found[few] = optimised(
            hilly_line(),
            FLIRT,
            configurations,
            objective="expected",
            reserve=0.2,
            cells=80,
            tolerance=np.inf,
        ).certificate
    some, everyone = found[12], found[24]
    assert len(some["active"]) < 16
    assert len(everyone["active"]) == 24
    assert some["audit"]["passed"]
    mean = float(np.mean(some["line_energy"]))
    assert some["energy"] == pytest.approx(mean)
    # Not less than the optimum of all, not much more, and bounded from below by the truth.
    assert some["energy"] >= everyone["lower_bound"]
    assert some["energy"] <= 1.002 * everyone["energy"]
    assert some["lower_bound"] <= everyone["energy"]
    assert some["gap"] <= representatives.REPRESENTED


def test_configurations_that_few_cannot_represent_enter_the_program() -> None:
    """Short of time and of the dynamic brake's power, on a level line: a per cent was wasted."""
    configurations = drawn(FLIRT, 24, seed=2)
    found = optimised(level_line(8_000.0), FLIRT, configurations, objective="expected", **OPTIONS)  # type: ignore[arg-type]
    certificate = found.certificate
    assert certificate["gap"] <= representatives.REPRESENTED
    assert certificate["certified"]
    assert certificate["audit"]["passed"]


def test_weights_of_many_are_kept_and_those_without_weight_have_no_say() -> None:
    """Twenty configurations of which three count: the same as the expected energy of these."""
    configurations = drawn(FLIRT, 20, seed=2)
    weights = np.zeros(20)
    weights[[3, 8, 15]] = 0.5, 0.3, 0.2
    found = optimised(
        hilly_line(), FLIRT, configurations, objective="expected", weights=weights.tolist(),
        **OPTIONS,  # type: ignore[arg-type]
    )  # fmt: skip
    certificate = found.certificate
    assert certificate["energy"] == pytest.approx(weights @ certificate["line_energy"])
    assert certificate["certified"]
    assert certificate["audit"]["passed"]


def test_a_gentle_brake_takes_no_more_than_the_few_that_decide_at_the_line() -> None:
    configurations = drawn(FLIRT, 30, seed=2)
    many = optimised(hilly_line(), FLIRT, configurations, objective="line", **OPTIONS)  # type: ignore[arg-type]
    certificate = many.certificate
    # The worst case is that of all, as audited, whoever was optimised for.
    assert len(certificate["line_energy"]) == len(certificate["audit"]["arrival"]) == 30
    assert certificate["energy"] == max(certificate["line_energy"])
    assert certificate["audit"]["passed"]
    assert certificate["certified"]
    assert len(certificate["active"]) <= 8
    # Those that decided need as much without the others, but for the lightest and the heaviest,
    # by which the largest common traction and the efforts are measured.
    extremes = [pick(configurations, key=lambda each: each.mass) for pick in (min, max)]
    names = {*certificate["active"], *(each.name for each in extremes)}
    deciding = [each for each in configurations if each.name in names]
    few = optimised(
        hilly_line(), FLIRT, deciding, objective="line", running_time=many.running_time, cells=80
    ).certificate
    assert few["energy"] == pytest.approx(certificate["energy"], rel=2e-4)


def test_few_decide_at_the_line_where_the_dynamic_brake_is_weak() -> None:
    """Whoever has time brakes early, without friction: no reason to optimise for all of them."""
    configurations = drawn(VIRM6, 13, seed=1)
    found = optimised(
        hilly_line(), VIRM6, configurations, objective="line", reserve=0.07, cells=80
    ).certificate
    assert found["audit"]["passed"]
    assert len(found["active"]) <= 6
    assert found["solver"]["iterations"] <= 25
    assert found["energy"] == max(found["line_energy"])
    assert found["gap"] < 5e-3


def test_when_the_time_is_over_the_best_so_far_is_the_answer_with_its_gap(unrenewed: None) -> None:
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


def test_a_time_limit_is_some_time() -> None:
    refused(InputError, "time limit must be more than 0 s", OptimiserOptions, time_limit=0.0)


def test_shares_add_up_and_the_slowest_stands_for_itself() -> None:
    configurations = tuple(drawn(FLIRT, 20, seed=4))
    line = hilly_line()
    weights = tuple(np.arange(1.0, 21.0).tolist())
    run = TrajectoryProblem(line, FLIRT, configurations, weights=weights)
    problem = discretise(run, run.breakpoints)
    rows = representatives.representatives(problem, [7])
    assert len(rows) == 1 + representatives.REPRESENTATIVES
    assert len(set(rows)) == len(rows)
    shares = representatives.shares_of(problem, rows, {7})
    assert shares.parts.sum(axis=1) == pytest.approx(1.0)
    assert shares.parts.min() >= 0.0
    assert shares.weights.sum() == pytest.approx(1.0)
    assert shares.weights[rows.index(7)] == pytest.approx(problem.weights[7])

"""Many configurations at the line: few decide, and the bound holds for all."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from trajectory_cases import FLIRT, VIRM6, drawn, hilly_line, level_line, optimised

from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from trainlog.errors import InputError

OPTIONS = {"reserve": 0.1, "cells": 80}


@pytest.mark.long
def test_all_that_count_are_in_the_program_of_the_expected_energy() -> None:
    """Short of time and of the dynamic brake's power, on a level line."""
    configurations = drawn(FLIRT, 24, seed=2)
    found = optimised(level_line(8_000.0), FLIRT, configurations, objective="expected", **OPTIONS)  # type: ignore[arg-type]
    certificate = found.certificate
    assert len(certificate["active"]) == 24
    assert certificate["energy"] == pytest.approx(float(np.mean(certificate["line_energy"])))
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


@pytest.mark.long
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
    assert found["solver"]["iterations"] <= 40
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

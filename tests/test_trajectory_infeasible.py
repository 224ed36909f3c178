"""Problems without a solution are explained with figures, and the figures are right."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import cvxpy as cp
import pytest
from refusals import refused
from trajectory_cases import (
    FLIRT,
    KMH,
    VIRM6,
    hilly_line,
    level_line,
    observed,
    optimised,
    slippery,
    steps,
)

from analysis.trajectory import active_set, convex, optimiser
from analysis.trajectory.convex import NoSolutionError, Relaxation
from analysis.trajectory.discretisation import DiscreteProblem
from analysis.trajectory.feasibility import UnprovenError
from trainlog.cli.main import run
from trainlog.errors import InfeasibleError, InputError
from trainlog.formats.samples import sample
from trainlog.railway import Configuration, RunningResistance, TimingPoint

pytestmark = pytest.mark.usefixtures("unrenewed")


def reported(words: str, error: pytest.ExceptionInfo[InfeasibleError]) -> float:
    found = re.search(words, str(error.value))
    assert found is not None, str(error.value)
    return float(found.group(1))


def test_too_little_time_names_the_slowest_and_what_is_missing():
    with pytest.raises(InfeasibleError, match=r"configuration 'x1\.1' needs at least") as error:
        optimised(hilly_line(), FLIRT, observed(FLIRT, 0.9, 1.0, 1.1), running_time=200.0)
    least = reported(r"at least (\d+\.\d) s", error)
    missing = reported(r"(\d+\.\d) s are missing", error)
    assert least == pytest.approx(200.0 + missing, abs=0.11)
    found = optimised(
        hilly_line(), FLIRT, observed(FLIRT, 0.9, 1.0, 1.1), running_time=1.01 * least
    )
    assert found.certificate["audit"]["passed"]


def test_trains_too_different_for_one_brake_are_refused_whatever_the_time():
    """No time helps, and the refusal does not ask for more: the relaxation proves it."""
    run = level_line(40_000.0, (0.0, 120.0), (20_000.0, 60.0)), FLIRT, observed(FLIRT, 0.5, 1.5)
    for reserve in (0.1, 1.5):
        with pytest.raises(InfeasibleError, match="whatever the time") as error:
            optimised(*run, braking="common", final_speed=8.0, reserve=reserve, cells=60)
        assert "allow" not in str(error.value)
    found = optimised(*run, final_speed=8.0, reserve=0.1, cells=60)
    assert found.certificate["audit"]["passed"]


def test_common_brakes_cannot_stop_them_all_and_say_how_slow_they_can():
    options = {"running_time": 1541.0, "initial_speed": 1.0, "braking": "common", "cells": 50}
    configurations = observed(VIRM6, 0.97, 1.0, 1.03)
    with pytest.raises(InfeasibleError, match="with one braking effort for all") as error:
        optimised(level_line(), VIRM6, configurations, final_speed=0.0, **options)
    assert not isinstance(error.value, UnprovenError)
    reachable = reported(r"the lowest speed found is (\d+\.\d) km/h", error) / KMH
    assert 5.0 < reachable < 10.0
    with pytest.raises(InfeasibleError):
        optimised(level_line(), VIRM6, configurations, final_speed=reachable - 0.3, **options)
    found = optimised(level_line(), VIRM6, configurations, final_speed=reachable + 0.1, **options)
    assert found.certificate["audit"]["passed"]


def test_a_common_brake_that_ends_too_fast_is_a_proof_where_solvers_do_not_settle(monkeypatch):
    """Asked for a stop the relaxation has no inside; left to end as it may it never stops."""

    def unsettled(relaxation):
        raise NoSolutionError("infeasible_inaccurate")

    monkeypatch.setattr(Relaxation, "least_time", unsettled)
    question = {"running_time": 1541.0, "initial_speed": 1.0, "braking": "common", "cells": 50}
    with pytest.raises(InfeasibleError, match=r"cannot all end at 0\.0 km/h") as error:
        optimised(level_line(), VIRM6, observed(VIRM6, 0.97, 1.0, 1.03), **question)
    assert not isinstance(error.value, UnprovenError)


def test_a_time_that_no_solver_found_is_not_asked_for(monkeypatch):
    """The speed at the end is proven out of reach; that more time would help is not."""
    least_time = Relaxation.least_time

    def without_end(relaxation: Relaxation) -> float:
        if relaxation.problem.final > 1.0:
            raise NoSolutionError("user_limit")
        return least_time(relaxation)

    monkeypatch.setattr(Relaxation, "least_time", without_end)
    with pytest.raises(InfeasibleError, match=r"cannot all end at 0\.0 km/h") as error:
        optimised(
            level_line(), VIRM6, observed(VIRM6, 0.97, 1.0, 1.03), running_time=1541.0,
            initial_speed=1.0, final_speed=0.0, braking="common", cells=50,
        )  # fmt: skip
    assert "inf" not in str(error.value)


def test_a_start_too_fast_to_stop():
    with pytest.raises(
        InfeasibleError, match=r"starts at 72\.0 km/h and cannot brake in time"
    ) as e:
        optimised(level_line(1_000.0), FLIRT, observed(FLIRT, 1.0), start=900.0, initial_speed=20.0)
    limit = reported(r"at most (\d+\.\d) km/h", e) / KMH
    assert limit == pytest.approx((2.0 * 1.1 * 100.0) ** 0.5, rel=0.03)


SLOPES = {
    change: replace(level_line(5_000.0), gradients=steps((0.0, 0.0), (2_000.0, change)))
    for change in (0.15, -0.19)
}
SLIPPERY = replace(level_line(5_000.0), gradients=steps((0.0, 0.03)))
FAST = level_line(20_000.0, (0.0, 900.0))
LATE = {"line": hilly_line(), "running_time": 450.0}


@pytest.mark.parametrize(
    ("question", "words"),
    [
        (
            {"line": SLOPES[0.15], "configurations": observed(FLIRT, 1.0, load=400_000.0)},
            r"comes to a stand at km 2\.\d+: full traction",
        ),
        ({"line": SLOPES[-0.19]}, "cannot brake on the slope"),
        (
            {"line": SLIPPERY, "condition_map": slippery(SLIPPERY, (0.0, 5_000.0, 0.03))},
            "comes to a stand",
        ),
        (
            {"line": level_line(5_000.0), "running_time": 100.0}
            | {"condition_map": slippery(level_line(5_000.0), (0.0, 5_000.0, 0.05))},
            r"\d+ % (of the time )?at the adhesion of the map",
        ),
        (
            {"line": level_line(20_000.0, (0.0, 60.0)), "running_time": 100.0},
            "9\\d % of the time at the limits or the train's own top speed",
        ),
        (
            {"line": FAST, "running_time": 100.0, "train": replace(FLIRT, max_speed=900.0 / KMH)},
            r"100\.0 s \(1:40 min\) .* from km 0\.000 \(A\) to km 20\.000 \(B\).*at full power",
        ),
        (
            LATE | {"windows": [TimingPoint(3e3, earliest=200.0), TimingPoint(6e3, latest=230.0)]},
            r"needs at least \d+\.\d s from km 3\.000 to km 6\.000",
        ),
        (
            LATE | {"windows": [TimingPoint(4e3, lowest_speed=30.0)]},
            r"the limit is the 80 km/h permitted there",
        ),
        (
            LATE | {"windows": [TimingPoint(6e3, latest=150.0)]},
            r"after \d+\.\d s at the earliest, .* window closes",
        ),
        (
            LATE | {"windows": [TimingPoint(6e3, earliest=440.0)]},
            r"needs at least \d+\.\d s from km 6\.000",
        ),
        (
            LATE | {"windows": [TimingPoint(6e3, lowest_speed=40.0)]},
            r"km/h at most, 144\.0 km/h are required",
        ),
    ],
)
def test_the_reason_and_its_place_are_named(question, words):
    asked = {"train": FLIRT, "configurations": observed(FLIRT, 1.0), "cells": 60} | question
    with pytest.raises(InfeasibleError, match=words):
        optimised(**asked)


@pytest.mark.parametrize(("r1", "r2", "name"), [(-100.0, 30.0, "r1 = -100"), (2e2, -0.5, "r2 = -")])
def test_a_resistance_that_falls_with_the_speed_is_refused(r1, r2, name):
    resistance = RunningResistance(FLIRT.resistance.r0, r1, r2)
    odd = replace(Configuration.of(FLIRT, name="odd"), resistance=resistance)
    refused(InputError, f"'odd' has a negative part, {name}", optimised, hilly_line(), FLIRT, [odd])


def test_a_solver_that_breaks_off_reports_no_settings_of_its_own(monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise cp.SolverError("Try another solver, or solve with verbose=True")

    monkeypatch.setattr(cp.Problem, "solve", broken)
    monkeypatch.setattr(convex, "_by_piqp", lambda *_, **__: None)
    monkeypatch.setattr(active_set, "descend", lambda *_: None)
    monkeypatch.setattr(optimiser, "_paced", lambda *_: None)
    with pytest.raises(InfeasibleError, match="beyond the solver's arithmetic") as refusal:
        optimised(hilly_line(), FLIRT, observed(FLIRT, 1.0), reserve=0.1, cells=40)
    assert "verbose" not in str(refusal.value)


def test_the_time_that_a_refusal_names_is_accepted():
    asked = (hilly_line(), FLIRT, observed(FLIRT, 0.9, 1.1))
    least = max(optimised(*asked, reserve=0.0, cells=40).certificate["least_time"])
    named = set()
    for share in (0.5, 1.0 + 1e-7):
        with pytest.raises(InfeasibleError) as refusal:
            optimised(*asked, running_time=share * least, cells=40)
        named.add(refusal.value.remedy or "")
    (words,) = named
    time = re.fullmatch(r"allow at least (\d+) s", words)
    assert time
    found = optimised(*asked, running_time=float(time[1]), cells=40)
    assert found.certificate["audit"]["lateness"] <= 1e-4


def test_limits_for_a_train_without_length_are_refused(tmp_path):
    content = json.loads(sample("CH_Stadler_FLIRT_TPF.train.json").read_text("utf-8"))
    del content["length"]
    (tmp_path / "short.train.json").write_text(json.dumps(content))
    arguments = ["plan", "--train", str(tmp_path / "short.train.json"), "--set", "protect=train"]
    arguments += ["--line", "sample"]
    with pytest.raises(InputError, match="not known; state its length in the train's file"):
        run([*arguments, "-o", str(tmp_path / "a.json")])


@pytest.mark.parametrize("braking", ["common", "recourse"])
def test_a_search_that_the_time_limit_ends_is_refused_without_a_proof(braking, monkeypatch):
    """A common brake cannot stop them all; and under one common traction no reserve is left.

    No finer grid is tried then: each would take longer than the last.
    """
    grids = list[int]()

    def seen(problem: DiscreteProblem, *given: Any) -> Any:
        grids.append(problem.shape[1])
        return active_set.searched(problem, *given)

    monkeypatch.setattr(optimiser, "searched", seen)
    question = {"initial_speed": 1.0, "braking": braking, "cells": 50, "time_limit": 1e-6}
    question |= {"running_time": 1541.0} if braking == "common" else {"reserve": 1e-9}
    configurations = observed(VIRM6, 0.97, 1.0, 1.03)
    words = "none was proven impossible: the relaxation is stopped by the time limit"
    refused(InfeasibleError, words, optimised, level_line(), VIRM6, configurations, **question)
    assert max(grids) == grids[0]

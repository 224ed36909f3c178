"""Random problems and known hard ones: answered, and driven by an integrator of its own."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused
from trajectory_cases import FLIRT, KMH, hilly_line, level_line, observed, steps

from analysis.trajectory.convex import NoSolutionError, Unknowns, bounded
from analysis.trajectory.discretisation import Plan, discretise
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from analysis.trajectory.rollout import cell_times
from analysis.trajectory.sqp import Motion, QPSubproblem
from trainlog.errors import InfeasibleError
from trainlog.railway import Configuration, RunningResistance, Train, Trajectory

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "trajectory"))
from benchmark_certificate import question
from benchmark_random import problem_of_kind, random_problem
from independent import driven, least_time


def answered(problem: TrajectoryProblem, cells: int = 200) -> Trajectory:
    """The answer, once the independent integrator has nothing against it."""
    found = optimise(problem, OptimiserOptions(cells))
    assert not driven(problem, found).faults(problem, found)
    return found


@pytest.mark.parametrize(
    "number", [1004, 1008, *(pytest.param(each, marks=pytest.mark.long) for each in (1002, 1005))]
)
def test_random_problems_are_answered_and_the_answers_hold(number: int) -> None:
    problem = random_problem(number)
    found = answered(problem)
    exact = least_time(problem, problem.configurations[0])
    assert found.certificate["least_time"][0] == pytest.approx(exact, rel=2e-4)


def test_one_that_all_but_stands_at_the_end_is_bounded() -> None:
    """It might pass the end at 13 km/h as the others do: its costate is not that of a stop."""
    problem = random_problem(9)
    few = replace(problem, configurations=problem.configurations[:4])
    assert optimise(few, OptimiserOptions(200)).certificate["gap"] <= 1e-3


def test_cells_of_a_kilometre_do_not_add_up_to_a_train_that_never_stops() -> None:
    """Plan and audit part by 5e-5 m²/s² in a cell: by half a decimetre a second at the end."""
    problem = problem_of_kind(9102)
    answered(replace(problem, configurations=problem.configurations[1:]))


@pytest.mark.long
def test_cells_are_laid_anew_while_the_energy_still_falls() -> None:
    """Over 115 km it falls by a sixth, and last by .6 %, when the gap is just certified."""
    problem = question(411)
    least = float(fastest_run(problem).times.max())
    found = optimise(replace(problem, running_time=(1.0 + problem.reserve) * least))
    assert found.certificate["gap"] <= 1e-3


@pytest.mark.parametrize(
    ("count", "reserves"),
    [
        (3, (1.0,)),
        pytest.param(3, (0.6, 1.0), marks=pytest.mark.long),
        pytest.param(11, (0.2, 0.4, 0.6, 0.8, 1.0), marks=pytest.mark.long),
    ],
)
def test_more_time_is_never_refused_and_never_costs_more(
    count: int, reserves: tuple[float, ...]
) -> None:
    """Weak trains on 45 per mille, at 1.5 m/s: in long cells they would stand, or lose minutes."""
    problem = random_problem(32)
    few = replace(problem, configurations=problem.configurations[-count:])
    found = [optimise(replace(few, reserve=each), OptimiserOptions()) for each in reserves]
    energies = np.array([each.certificate["energy"] for each in found])
    assert np.all(energies[1:] <= energies[:-1] * (1.0 + 1e-4))
    assert all(each.certificate["certified"] for each in found)


@pytest.mark.usefixtures("unrenewed")
def test_the_judge_sees_what_is_wrong() -> None:
    """Less traction: late or short; a little more: too fast; another energy: named."""
    problem = TrajectoryProblem(hilly_line(), FLIRT, observed(FLIRT, 1.0), end=4_000.0, reserve=0.1)
    found = answered(problem, 60)
    for factor, words in ((0.99, "short|late"), (1.01, "over|past")):
        other = replace(found, tractive_effort=factor * found.tractive_effort)
        faults = driven(problem, other).faults(problem, other)
        assert any(word in fault for fault in faults for word in words.split("|"))
    energy = found.certificate | {"energy": 1.002 * found.certificate["energy"]}
    wrong = replace(found, certificate=energy)
    assert driven(problem, wrong).faults(problem, wrong) == ["energy wrong by 0.002"]


def test_a_plan_that_stalls_has_a_finite_program() -> None:
    """Without linear resistance, times that are infinite times it are no numbers."""
    train = replace(FLIRT, resistance=RunningResistance(9_000.0, 0.0, 12.0))
    run = TrajectoryProblem(hilly_line(), train, observed(train, 1.0))
    problem = discretise(run, run.breakpoints)
    z = np.full((1, problem.positions.size), 1e-5)
    none = np.zeros(problem.shape)
    plan = Plan(z, none[0], none, none)
    assert np.isinf(cell_times(problem, plan)).any()
    motion = Motion.about(problem, plan)
    for each in (motion.times, motion.keep, motion.push):
        assert np.all(np.isfinite(each))
    found = QPSubproblem(problem, plan, none).solve(400.0, 1.0, 100.0, 0.0)
    assert np.all(np.isfinite(found.plan.z))


def test_bounds_that_exclude_each_other_are_no_crash() -> None:
    run = TrajectoryProblem(hilly_line(), FLIRT, observed(FLIRT, 1.0))
    unknowns = Unknowns(discretise(run, run.breakpoints))
    unknowns.low[unknowns.z[0, 3]], unknowns.high[unknowns.z[0, 3]] = 2.0, 1.0
    refused(NoSolutionError, "infeasible", bounded, unknowns)


def test_no_linear_resistance_and_much_time() -> None:
    """Where a train all but stands on the way, no time of its is infinite times no resistance."""
    train = replace(FLIRT, resistance=RunningResistance(9_000.0, 0.0, 12.0))
    line = replace(
        level_line(20_000.0, (0.0, 80.0)),
        gradients=steps((0.0, 0.0), (4_000.0, 0.04), (6_000.0, -0.02), (12_000.0, 0.03)),
    )
    problem = TrajectoryProblem(line, train, observed(train, 1.0, 1.1), reserve=3.5)
    assert answered(problem).certificate["gap"] < 5e-3


def weak_train() -> Train:
    """A tenth of a watt a kilogram above what holds it at 1.6 m/s on 40 per mille."""
    return replace(
        FLIRT,
        mass=170_000.0,
        max_tractive_effort=170_000.0,
        max_traction_power=120_000.0,
        max_speed=75.0 / KMH,
    )


def test_a_weak_train_climbs_at_walking_pace() -> None:
    """On cells as long as elsewhere it would stall on paper: it gains power as it slows down."""
    line = replace(
        level_line(4_000.0, (0.0, 75.0)),
        gradients=steps((0.0, 0.0), (1_500.0, 0.04), (1_800.0, -0.01)),
    )
    train = weak_train()
    answered(TrajectoryProblem(line, train, observed(train, 0.9, 1.1), reserve=1.0))


@pytest.mark.usefixtures("unrenewed")
def test_a_time_just_above_the_least_is_no_refusal() -> None:
    """300 m with 3 W/kg, 0.1 per cent above the least time of its closed form."""
    mass = 100e3
    train = Train(
        name="weak", mass=mass, rotating_mass_factor=0.0,
        resistance=RunningResistance(0.0, 0.0, 0.0), max_tractive_effort=mass,
        max_traction_power=3.0 * mass, max_pneumatic_braking_effort=mass, max_speed=100.0,
    )  # fmt: skip
    line = level_line(300.0, (0, 360))
    problem = TrajectoryProblem(line, train, [Configuration.of(train)])
    least = least_time(problem, problem.configurations[0])
    found = answered(replace(problem, running_time=1.001 * least))
    assert found.certificate["gap"] < 5e-3
    with pytest.raises(InfeasibleError):
        optimise(replace(problem, running_time=0.9999 * least), OptimiserOptions(200))


def test_seven_hours_are_kept_to_the_millisecond() -> None:
    """The times of thousands of metres at walking pace add up; none is refused for the last one."""
    line = replace(
        level_line(60_000.0, (0.0, 30.0), (2_000.0, 8.0), (55_000.0, 30.0)),
        gradients=steps((0.0, 0.004), (9_000.0, -0.006), (30_000.0, 0.005)),
    )
    problem = TrajectoryProblem(line, FLIRT, observed(FLIRT, 1.0), reserve=0.0)
    found = answered(problem)
    assert found.running_time > 24_000.0
    assert found.certificate["gap"] < 5e-3


@pytest.mark.parametrize(("objective", "length"), [("wheel", 1_200.0), ("line", 8_000.0)])
def test_least_time_runs_are_close_to_their_bound(objective: Any, length: float) -> None:
    line = replace(level_line(length, (0, 80), (0.7 * length, 50)), gradients=steps((0.0, 0.01)))
    problem = TrajectoryProblem(line, FLIRT, observed(FLIRT, 1.0), reserve=0.0, objective=objective)
    found = answered(problem, 250)
    assert found.running_time == pytest.approx(
        least_time(problem, problem.configurations[0]), rel=3e-4
    )
    assert found.certificate["gap"] < 5e-3


@pytest.mark.usefixtures("unrenewed")
def test_one_configuration_with_a_common_brake_has_a_brake_of_its_own() -> None:
    """Next to the least time, where efforts that are applied as they are go past every limit."""
    asked = TrajectoryProblem(
        hilly_line(), FLIRT, observed(FLIRT, 1.0), end=6_000.0, reserve=4e-4, braking="recourse"
    )
    own, common = (
        answered(replace(asked, braking=each), 120)  # type: ignore[arg-type]
        for each in ("recourse", "common")
    )
    np.testing.assert_allclose(common.speeds, own.speeds)
    assert common.provenance["settings"]["braking"] == "common"

"""Weak duality: whatever the multipliers are, the bound is below every trajectory's energy."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from trajectory_cases import FLIRT, VIRM6, hilly_line, observed, optimised

from analysis.trajectory.active_set import search
from analysis.trajectory.bound import lower_bound
from analysis.trajectory.convex import Relaxation
from analysis.trajectory.discretisation import DiscreteProblem, discretise, graded_mesh
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.guess import initial_guess, interpolated_guess
from analysis.trajectory.problem import TrajectoryProblem
from analysis.trajectory.sqp import Solution, minimise
from trainlog.formats.railway import read_line
from trainlog.formats.samples import sample

TIME = 450.0


@cache
def solved(objective: str) -> tuple[DiscreteProblem, Solution, np.ndarray]:
    line = hilly_line()
    run = TrajectoryProblem(
        line, FLIRT, tuple(observed(FLIRT, 1.0, 1.05)),
        objective=objective,  # type: ignore[arg-type]
    )  # fmt: skip
    fastest = fastest_run(run)
    mesh = graded_mesh(run.breakpoints, fastest.positions, fastest.speeds[1], 120)
    problem = discretise(run, mesh)
    guess = initial_guess(problem, fastest.at(mesh), TIME)
    part = problem.select(guess.rows)
    return part, minimise(part, guess.plan, guess.price, TIME), fastest.at(mesh)[list(guess.rows)]


CASES = ("wheel", "line", "expected")


def bounded(problem: DiscreteProblem, solution: Solution) -> float:
    speeds = np.sqrt(2.0 * solution.plan.z)
    # A hundredth of a second is far more than the cells' mean speeds can be wrong by.
    spare = np.full(problem.shape[0], 0.01)
    return lower_bound(problem, solution.multipliers, speeds, TIME, spare)


@pytest.mark.parametrize("objective", CASES)
def test_multipliers_of_the_optimum_bound_it_closely(objective: str) -> None:
    problem, solution, speeds = solved(objective)
    bound = bounded(problem, solution)
    assert bound <= solution.energy
    assert bound >= 0.995 * solution.energy
    # The relaxation's own minimum is the best that any multipliers can give.
    assert bound <= Relaxation(problem, speeds).least_energy(TIME).bound * (1.0 + 1e-6)


@settings(max_examples=60)
@given(
    st.sampled_from(CASES),
    st.integers(0, 2**31),
    st.sampled_from([1e-4, 1e-2, 0.3, 3.0]),
)
def test_no_multipliers_bound_it_from_above(objective: str, seed: int, size: float) -> None:
    problem, solution, _ = solved(objective)
    random, known = np.random.default_rng(seed), solution.multipliers

    def disturbed(values: np.ndarray) -> np.ndarray:
        factor = 1.0 + size * random.standard_normal(values.shape)
        return values * np.maximum(factor, 0.0)

    names = ("pull", "time", "power", "dynamic_power")
    wrong = replace(known, **{name: disturbed(getattr(known, name)) for name in names})
    assert bounded(problem, replace(solution, multipliers=wrong)) <= solution.energy * (1.0 + 1e-9)


def test_resistance_counts_where_time_is_worth_next_to_nothing() -> None:
    """Down to Wil in three times the least time: the bound keeps the speeds' linear resistance."""
    line = read_line(sample("CH_StGallen_Wil.line.json"))
    slack = optimised(line, VIRM6, observed(VIRM6, 1.0), reserve=2.0, cells=200).certificate
    assert slack["audit"]["passed"]
    assert slack["lower_bound"] <= slack["energy"]
    assert slack["gap"] <= 0.06
    # It gives more back than it takes: the gap is a part of that, too.
    back = optimised(
        line, VIRM6, observed(VIRM6, 1.0), reserve=2.0, cells=200, objective="line"
    ).certificate
    assert back["energy"] < 0.0
    assert 0.0 <= back["gap"] <= 0.02


def test_multipliers_of_a_coarse_grid_bound_the_energy_on_a_fine_one() -> None:
    """What an answer's gap rests on when the time ends before the fine grid has a program."""
    run = TrajectoryProblem(hilly_line(), FLIRT, observed(FLIRT, 0.95, 1.05), reserve=0.1)
    fastest = fastest_run(run)
    running_time = 1.1 * float(fastest.times.max())
    coarse, fine = (
        discretise(run, graded_mesh(run.breakpoints, fastest.positions, fastest.speeds[1], cells))
        for cells in (60, 240)
    )
    begun = initial_guess(coarse, fastest.at(coarse.positions), running_time)
    answer = search(coarse, begun, fastest.at(coarse.positions), running_time)
    guess = interpolated_guess(answer, coarse.positions, fine, range(2))
    found = search(fine, guess, fastest.at(fine.positions), running_time)
    rows, speeds = list(guess.rows), fastest.at(fine.positions)
    assert guess.multipliers is not None
    part = fine.select(rows)
    start = np.sqrt(2.0 * guess.plan.z)
    bound = lower_bound(
        part, guess.multipliers, start, running_time, np.zeros(len(rows)), speeds[rows]
    )
    assert 0.88 * found.solution.energy < bound <= found.solution.energy

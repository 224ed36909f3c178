"""A certificate that means what it says: no finer plan lies below the bound of all trajectories."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from rich.console import Console
from trajectory_cases import FLIRT, VIRM6, drawn, hilly_line, level_line, observed, optimised

from analysis.trajectory.active_set import search
from analysis.trajectory.continuous import continuous_bound
from analysis.trajectory.costate import costate_of
from analysis.trajectory.curvature import least_curved
from analysis.trajectory.discretisation import discretise, graded_mesh
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.guess import initial_guess
from analysis.trajectory.hamiltonian import Hamiltonian, Prices, Segments
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from analysis.trajectory.table import trajectory_table
from trainlog.errors import InputError
from trainlog.formats.railway import read_trajectory, write_trajectory
from trainlog.railway import Trajectory

FINE = 1_200
"""Cells of plans that are to lie above the bounds of coarse ones."""

CASES: dict[str, dict[str, Any]] = {
    "line": {"objective": "line", "reserve": 0.1},
    "wheel": {"objective": "wheel", "reserve": 0.05},
}


@cache
def planned(case: str, cells: int, tolerance: float = np.inf, q: int = 1) -> Trajectory:
    """The intercity on the hilly line, or as many as asked, always in the same time."""
    configurations = observed(VIRM6, 1.0) if q == 1 else drawn(VIRM6, q, seed=5, spread=0.03)
    question = CASES[case] | {"running_time": planned_time(case, q), "reserve": 0.0}
    return optimised(
        hilly_line(), VIRM6, configurations, cells=cells, tolerance=tolerance, **question
    )


@cache
def planned_time(case: str, q: int) -> float:
    configurations = observed(VIRM6, 1.0) if q == 1 else drawn(VIRM6, q, seed=5, spread=0.03)
    run = TrajectoryProblem(hilly_line(), VIRM6, configurations)
    return float(fastest_run(run).times.max() * (1.0 + CASES[case]["reserve"]))


@pytest.mark.parametrize(("case", "q"), [("line", 1), ("wheel", 1), ("line", 3)])
def test_a_finer_plan_lies_above_the_bound_of_all(case: str, q: int) -> None:
    fine = planned(case, FINE, q=q).certificate
    for cells in (60, 150):
        coarse = planned(case, cells, q=q).certificate
        assert fine["energy"] >= coarse["continuous_bound"] * (1.0 - 1e-6)
        assert coarse["continuous_bound"] <= coarse["lower_bound"] <= coarse["energy"]
        assert coarse["total_gap"] == pytest.approx(coarse["gap"] + coarse["cells_cost"])
        # The other way about: what was stated that finer cells could gain, they do not exceed.
        gained = coarse["energy"] / fine["energy"] - 1.0
        assert gained <= coarse["total_gap"] + 1e-6


def test_a_bound_on_cells_is_none_for_finer_cells() -> None:
    """What the certificate stated alone before: on 60 cells a plan, and a bound above the truth."""
    coarse, fine = (planned("line", cells).certificate for cells in (60, FINE))
    assert coarse["lower_bound"] > fine["energy"] * (1.0 + 1e-4)
    assert coarse["cells_cost"] >= coarse["lower_bound"] / fine["energy"] - 1.0


@pytest.mark.parametrize("case", CASES)
def test_cells_follow_the_plan_until_the_total_gap_is_small(case: str) -> None:
    first, renewed = planned(case, 100), planned(case, 100, 5e-4)
    assert first.certificate["total_gap"] > 5e-4
    assert renewed.certificate["total_gap"] <= 0.6 * first.certificate["total_gap"]
    assert renewed.certificate["energy"] <= first.certificate["energy"]
    assert renewed.positions.size <= 1.1 * first.positions.size
    assert renewed.certificate["certified"]


def test_certified_is_the_total() -> None:
    """An answer that is the best on its cells by 0.1 per cent, and wasted more by these."""
    coarse = planned("line", 60).certificate
    assert coarse["gap"] <= 2e-3 < coarse["total_gap"]
    assert not coarse["certified"]


@cache
def solved(objective: str) -> tuple[Any, ...]:
    run = TrajectoryProblem(
        hilly_line(), FLIRT, observed(FLIRT, 1.0, 1.05), objective=objective  # type: ignore[arg-type]
    )  # fmt: skip
    fastest, time = fastest_run(run), 450.0
    mesh = graded_mesh(run.breakpoints, fastest.positions, fastest.speeds[1], 120)
    problem = discretise(run, mesh)
    guess = initial_guess(problem, fastest.at(mesh), time)
    answer = search(problem, guess, fastest.at(mesh), time)
    rows = list(answer.active)
    own = replace(fastest, speeds=fastest.speeds[rows], elapsed=fastest.elapsed[rows])
    fine = optimised(
        hilly_line(), FLIRT, observed(FLIRT, 1.0, 1.05), objective=objective, cells=600,
        running_time=time, tolerance=np.inf,
    ).certificate["energy"]  # fmt: skip
    return answer, answer.problem.select(rows), own, time, fine / problem.reference


@settings(max_examples=40)
@given(
    st.sampled_from(("wheel", "line", "expected")),
    st.integers(0, 2**31),
    st.sampled_from([1e-4, 1e-2, 0.3, 3.0]),
)
def test_no_multipliers_bound_a_finer_plan_from_above(
    objective: str, seed: int, size: float
) -> None:
    answer, part, fastest, time, energy = solved(objective)
    random, known = np.random.default_rng(seed), answer.solution.multipliers

    def disturbed(values: np.ndarray) -> np.ndarray:
        factor = 1.0 + size * random.standard_normal(values.shape)
        return values * np.maximum(factor, 0.0)

    names = ("pull", "time", "power", "dynamic_power")
    wrong = replace(known, **{name: disturbed(getattr(known, name)) for name in names})
    run = answer.problem.run
    bound = continuous_bound(part, answer.solution.plan, wrong, fastest, time, run)
    assert bound.value <= energy * (1.0 + 1e-6)


@cache
def with_much_time(objective: Any = "wheel") -> tuple[Any, ...]:
    """The intercity on the hilly line in three times its least time: it coasts most of the way."""
    run = TrajectoryProblem(hilly_line(), VIRM6, observed(VIRM6, 1.0), objective=objective)
    fastest = fastest_run(run)
    time = 3.0 * float(fastest.times[0])
    mesh = graded_mesh(run.breakpoints, fastest.positions, fastest.speeds[0], 150)
    problem = discretise(run, mesh)
    answer = search(problem, initial_guess(problem, fastest.at(mesh), time), fastest.at(mesh), time)
    fine = optimised(
        hilly_line(),
        VIRM6,
        observed(VIRM6, 1.0),
        cells=1_000,
        running_time=time,
        objective=objective,
        tolerance=np.inf,
    ).certificate["energy"]
    return answer, fastest, time, fine / problem.reference


def hamiltonian_of(answer: Any, fastest: Any) -> tuple[Hamiltonian, np.ndarray, np.ndarray]:
    """With its costate and the slope of that."""
    problem, plan, multipliers = answer.problem, answer.solution.plan, answer.solution.multipliers
    prices = Prices.of(problem, multipliers)
    whole = Segments.of(problem, np.arange(problem.shape[1]), problem.positions, 4)
    costate = costate_of(
        Hamiltonian(problem, plan, prices, fastest, problem.run, whole), multipliers
    )
    found = Hamiltonian(problem, plan, prices, fastest, problem.run, costate.segments)
    return found, *costate.along(found)


@pytest.mark.parametrize("size", [1e-6, 1e-4, 1e-2])
def test_no_speed_and_control_has_less_than_the_bound_by_curvature(size: float) -> None:
    """Drawn at random, and the function written out anew: forces, efforts, derivatives."""
    answer, fastest, _, _ = with_much_time()
    hamiltonian, costate, slope = hamiltonian_of(answer, fastest)
    problem, random = answer.problem, np.random.default_rng(3)
    ends = size * random.uniform(0.0, 1.0, (2, problem.shape[1]))
    least = least_curved(hamiltonian, costate, slope, (ends[0], ends[1]))
    cell, at = hamiltonian.segments.cell, hamiltonian.segments.positions
    part = (at - problem.positions[cell, None]) / problem.step[cell, None]
    kappa = ends[0][cell, None] * (1.0 - part) + ends[1][cell, None] * part
    rise = ((ends[1] - ends[0]) / problem.step)[cell, None]
    (z,), (change,) = (each.reshape(1, *at.shape) for each in hamiltonian.of_motion)
    gain, price = problem.gain[0], answer.solution.multipliers.time[0]
    resistance = VIRM6.resistance
    for _ in range(400):
        v = hamiltonian.highest[0] * random.uniform(1e-3, 1.0, at.shape) ** random.choice([1, 3])
        away = 0.5 * v**2 - z
        pull = np.minimum(hamiltonian.traction, problem.power[0] / v) * random.choice([0, 0.5, 1])
        brake = hamiltonian.braking[0] * random.choice([0, 0.5, 1])
        inertia = problem.run.configurations[0].inertia
        drag = hamiltonian.drag0[0] + (resistance.r1 * v + resistance.r2 * v**2) / inertia
        rate = gain * (pull - brake) - drag
        by_place = -slope[0] * 0.5 * v**2 - 0.5 * rise * away**2 + kappa * away * change
        own = pull + price / v + by_place - (costate[0] + kappa * away) * rate
        assert np.all(least <= own + 1e-9)


@pytest.mark.parametrize("objective", ["wheel", pytest.param("line", marks=pytest.mark.long)])
def test_a_run_in_three_times_the_least_time_is_bounded_by_curvature(objective: str) -> None:
    answer, fastest, time, fine = with_much_time(objective)
    multipliers, run = answer.solution.multipliers, answer.problem.run
    plan = answer.solution.plan
    found = continuous_bound(answer.problem, plan, multipliers, fastest, time, run).value
    hamiltonian, costate, slope = hamiltonian_of(answer, fastest)
    least, spent = hamiltonian.least(costate, slope), hamiltonian.of_plan(costate, slope)
    affine = answer.solution.energy
    affine -= float(((spent - least) * hamiltonian.segments.weights).sum())
    assert found <= fine + 1e-6 * abs(fine)
    assert found > affine or objective == "line"
    random = np.random.default_rng(5)
    for size in (1e-4, 1e-2, 0.3):
        for _ in range(3):
            factor = np.maximum(1.0 + size * random.standard_normal(multipliers.pull.shape), 0.0)
            wrong = replace(multipliers, pull=factor * multipliers.pull)
            bound = continuous_bound(answer.problem, plan, wrong, fastest, time, run)
            assert bound.value <= fine + 1e-6 * abs(fine)


def test_the_excess_of_the_cells_adds_up_to_the_total() -> None:
    answer, part, fastest, time, _ = solved("wheel")
    multipliers, run = answer.solution.multipliers, answer.problem.run
    bound = continuous_bound(part, answer.solution.plan, multipliers, fastest, time, run)
    assert bound.excess.min() >= 0.0
    total = answer.solution.energy - bound.value
    assert bound.excess.sum() == pytest.approx(total, rel=0.05, abs=1e-4 * bound.value)


def test_a_level_run_is_bounded_to_a_ten_thousandth() -> None:
    found = optimised(level_line(12_000.0, (0.0, 100.0)), FLIRT, observed(FLIRT, 1.0), reserve=0.1)
    assert 0.0 <= found.certificate["total_gap"] <= 1e-4


def test_long_ways_at_walking_pace_are_bounded() -> None:
    """Kilometres at 5 km/h, where the train is at its fastest all the time, are no stopping."""
    line = level_line(5_000.0, (0.0, 60.0), (2_000.0, 5.0))
    found = optimised(line, FLIRT, observed(FLIRT, 1.0), reserve=0.07, cells=200)
    assert 0.0 <= found.certificate["total_gap"] <= 5e-4


def test_a_run_in_its_least_time_has_cells_until_it_is_certified() -> None:
    """A second is worth a hundred times what it usually is, and so is a change of control."""
    run = TrajectoryProblem(hilly_line(), FLIRT, observed(FLIRT, 1.0), reserve=0.0)
    found = optimise(run, OptimiserOptions(60))
    assert found.certificate["total_gap"] <= 2e-3
    assert found.positions.size > 61
    kept = optimise(run, OptimiserOptions(60, tolerance=np.inf))
    assert kept.certificate["total_gap"] > 2e-3


def test_a_negative_tolerance_is_refused() -> None:
    with pytest.raises(InputError, match="tolerance of the total gap must be 0 or more"):
        OptimiserOptions(tolerance=-1e-3)


def shown(trajectory: Trajectory) -> str:
    console = Console(file=StringIO(), width=160)
    console.print(*trajectory_table(trajectory))
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_a_file_keeps_what_cells_cost_and_one_without_it_is_read(tmp_path: Path) -> None:
    found = planned("line", 60)
    write_trajectory(found, tmp_path / "new.json")
    again = read_trajectory(tmp_path / "new.json")
    for name in ("continuous_bound", "cells_cost", "total_gap", "gap", "certified"):
        assert again.certificate[name] == found.certificate[name]
    assert "above the theoretical minimum" in repr(again)
    new = ("continuous_bound", "cells_cost", "total_gap")
    kept = {name: value for name, value in found.certificate.items() if name not in new}
    write_trajectory(replace(found, certificate=kept), tmp_path / "old.json")
    old = read_trajectory(tmp_path / "old.json")
    assert "above the minimum on these cells" in repr(old)
    assert "what the cells cost is not known" in shown(old)
    assert "for the cells" in shown(again)

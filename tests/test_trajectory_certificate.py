"""A certificate that means what it says: no finer plan lies below the bound of all trajectories."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from trajectory_cases import (
    FLIRT,
    FREIGHT,
    VIRM6,
    drawn,
    hilly_line,
    level_line,
    observed,
    optimised,
)

from analysis.trajectory import optimiser
from analysis.trajectory.active_set import initial_guess, search
from analysis.trajectory.bound import (
    COSTATES,
    ContinuousBound,
    Hamiltonian,
    Segments,
    _CostateProgram,
    closest_bound,
    continuous_bound,
    reached,
)
from analysis.trajectory.discretisation import discretise, graded_mesh
from analysis.trajectory.envelope import closer, fastest_run, floor_of
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from trainlog.arrays import FloatArray
from trainlog.railway import RunningResistance, TimingPoint, Train, Trajectory

FINE = 1_200
"""Cells of plans that are to lie above the bounds of coarse ones."""

CASES: dict[str, dict[str, Any]] = {
    "line": {"objective": "line", "reserve": 0.1},
    "wheel": {"objective": "wheel", "reserve": 0.05},
}


@cache
def planned(case: str, cells: int, tolerance: float = np.inf) -> Trajectory:
    """The intercity on the hilly line, always in the same time."""
    return optimised(
        hilly_line(), VIRM6, observed(VIRM6, 1.0), cells=cells, tolerance=tolerance, **CASES[case]
    )


@pytest.mark.parametrize("case", CASES)
def test_a_finer_plan_lies_above_the_bound_of_all(case):
    fine = planned(case, FINE).certificate
    for cells in (60, 150):
        coarse = planned(case, cells).certificate
        assert fine["energy"] >= coarse["lower_bound"] * (1.0 - 1e-6)
        assert coarse["lower_bound"] <= coarse["energy"]
        # The other way about: what was stated that finer cells could gain, they do not exceed.
        gained = coarse["energy"] / fine["energy"] - 1.0
        assert gained <= coarse["gap"] + 1e-6


@pytest.mark.parametrize("case", CASES)
def test_cells_follow_the_plan_until_the_gap_is_small(case):
    first, renewed = planned(case, 100), planned(case, 100, 5e-4)
    assert first.certificate["gap"] > 5e-4
    assert renewed.certificate["gap"] <= 0.6 * first.certificate["gap"]
    assert renewed.certificate["energy"] <= first.certificate["energy"]
    assert renewed.positions.size <= 2.1 * first.positions.size
    assert renewed.certificate["certified"]


@pytest.mark.parametrize("objective", ["expected", "line", "wheel"])
def test_long_cells_of_partial_traction_cost_the_bound_little(objective):
    """The sum of the costates stays at its level there; at its neighbours', 1 to 2.5 %."""
    reserve, count, gap = {
        "expected": (2.0, 4, 0.01), "line": (0.3, 3, 5e-3), "wheel": (0.5, 3, 0.012),
    }[objective]  # fmt: skip
    question = {"objective": objective, "reserve": reserve, "tolerance": np.inf}
    coarse, fine = (
        optimised(
            hilly_line(), FLIRT, drawn(FLIRT, count, seed=1, spread=0.3), cells=cells, **question
        ).certificate
        for cells in (40, FINE // 2)
    )
    assert coarse["gap"] < gap
    assert coarse["lower_bound"] <= fine["energy"] * (1.0 + 1e-6)


def test_a_bound_above_the_plan_certifies_nothing(monkeypatch):
    given = optimiser.continuous_bound

    def wrong(*args: Any, **options: Any) -> Any:
        found = given(*args, **options)
        return replace(found, value=1.1 * found.value)

    monkeypatch.setattr(optimiser, "continuous_bound", wrong)
    found = optimised(hilly_line(), VIRM6, observed(VIRM6, 1.0), cells=61, reserve=0.1).certificate
    assert found["lower_bound"] > found["energy"]
    assert not found["certified"]
    assert found["bound_holds_for"] == "no trajectories: this one takes less"


TIMED = (TimingPoint(3_000.0, latest=165.0), TimingPoint(6_000.0, earliest=311.0))
"""Sooner, and later, than a train that is free passes them by itself."""


@cache
def solved(case: str) -> tuple[Any, ...]:
    question: dict[str, Any] = {"objective": case.split()[-1]}
    question["windows"] = TIMED if case.startswith("timed") else ()
    run = TrajectoryProblem(hilly_line(), FLIRT, observed(FLIRT, 1.0, 1.05), **question)
    fastest, time = fastest_run(run), 450.0
    if case.startswith("tight"):
        time = 1.01 * float(fastest.times.max())
    mesh = graded_mesh(run.breakpoints, fastest.positions, fastest.speeds[1], 120)
    problem = discretise(run, mesh)
    guess = initial_guess(problem, fastest.at(mesh), time)
    answer = search(problem, guess, fastest.at(mesh), time)
    rows = list(answer.active)
    own = closer(run, fastest, tuple(rows))
    fine = optimised(
        hilly_line(), FLIRT, observed(FLIRT, 1.0, 1.05), cells=400, running_time=time,
        tolerance=np.inf, **question,
    ).certificate["energy"]  # fmt: skip
    return answer, answer.problem.select(rows), own, time, fine / problem.reference


@settings(max_examples=24)
@given(
    st.sampled_from(("wheel", "line", "timed wheel", "tight line")),
    st.integers(0, 2**31),
    st.sampled_from([1e-4, 1e-2, 0.3, 3.0]),
)
def test_no_multipliers_bound_a_finer_plan_from_above(case, seed, size):
    answer, part, fastest, time, energy = solved(case)
    random, known = np.random.default_rng(seed), answer.solution.multipliers

    def disturbed(values: np.ndarray) -> np.ndarray:
        factor = 1.0 + size * random.standard_normal(values.shape)
        return values * np.maximum(factor, 0.0)

    names = ("pull", "time", "power", "dynamic_power", "passing", "opening")
    wrong = replace(known, **{name: disturbed(getattr(known, name)) for name in names})
    run = answer.problem.run
    floor = floor_of(part.run, fastest, tuple(range(part.shape[0])), time)
    for slowest in (None, floor):
        given = part, answer.solution.plan, wrong, fastest, time, run, slowest
        bound = continuous_bound(*given, jointly=True)
        assert continuous_bound(*given).value <= bound.value
        assert bound.value <= energy * (1.0 + 1e-6)


@cache
def program(case: str) -> tuple[_CostateProgram, FloatArray, float]:
    """The program of two costates about the plan of a case, its unknowns, and a finer energy."""
    answer, part, fastest, time, energy = solved(case)
    run = answer.problem.run
    floor = floor_of(part.run, fastest, tuple(range(part.shape[0])), time)
    points = Hamiltonian(part, answer.solution.plan, fastest, run, Segments.of(part, 4), floor)
    made = _CostateProgram(points, time)
    found = made.solved()
    assert found is not None
    return made, found, energy


@settings(max_examples=40)
@given(
    st.sampled_from(("wheel", "line", "timed wheel", "tight line")),
    st.integers(0, 2**31),
    st.sampled_from([0.0, 1e-4, 1e-2, 0.3, 3.0]),
)
def test_no_two_costates_bound_a_finer_plan_from_above(case, seed, size):
    """Whatever the program leaves them at: its numbers are only where they are good."""
    made, found, energy = program(case)
    wrong = found * (1.0 + size * np.random.default_rng(seed).standard_normal(found.size))
    dual = made.dual(wrong)
    bound = ContinuousBound.of(made.points, dual, made.points.least(dual), COSTATES)
    assert bound.value <= energy * (1.0 + 1e-6)


@pytest.mark.parametrize("case", ["wheel", "line", "timed wheel", "tight line"])
def test_the_best_costates_come_close_without_any_multipliers(case):
    answer, part, fastest, time, energy = solved(case)
    floor = floor_of(part.run, fastest, tuple(range(part.shape[0])), time)
    given = part, answer.solution.plan, fastest, time, answer.problem.run, floor
    bound = closest_bound(*given)
    assert bound is not None
    assert 0.99 * energy < bound.value <= energy * (1.0 + 1e-6)


@pytest.mark.parametrize(
    ("train", "reserve"),
    [(FLIRT, 3.0), (VIRM6, 2.0), (VIRM6, 3.0), (FREIGHT, 2.0)],
    ids=lambda each: str(getattr(each, "name", each)),
)
def test_with_much_time_in_hand_two_costates_are_close(train, reserve):
    """Resistance that is linear in the speed: one costate misses 1 to 5 % of the energy."""
    constant, linear, square = train.resistance.parabola
    linear += 0.0 if train is FLIRT else 4e-4 * train.mass
    train = replace(train, resistance=RunningResistance(constant, linear, square))
    found, finer = (
        optimised(
            hilly_line(), train, observed(train, 1.0), cells=cells, reserve=reserve
        ).certificate
        for cells in (300, FINE)
    )
    assert found["certified"]
    assert found["gap"] < 1e-3
    assert found["solver"]["bound"] == COSTATES
    assert finer["energy"] >= found["lower_bound"] * (1.0 - 1e-6)


def test_costates_may_rise_or_fall_where_no_train_is_faster_or_slower():
    """By hand, at four nodes: the plan at its limit, free, at a lowest speed; and at the end."""
    made = program("wheel")[0].points
    limit = np.array([[50.0, 50.0, 50.0, 30.0, 20.0]])
    made = copy(made)
    made.problem = replace(made.problem, final=18.0)
    made.plan = replace(made.plan, z=np.array([[0.0, 50.0, 40.0, 25.0, 16.0]]))
    with pytest.MonkeyPatch.context() as patched:
        floor = np.array([0.0, 0.0, 0.0, 25.0, 0.0])
        patched.setattr("analysis.trajectory.bound.node_limits", lambda _: (limit, floor))
        rise, fall = np.array([1.0, 2.0, 3.0, 4.0]), np.array([4.0, 3.0, 2.0, 1.0])
        both = np.array([rise, fall])[:, None]
        np.testing.assert_allclose(made.at_nodes(both, both), [0, 0, 0, 0, -64])
        np.testing.assert_allclose(made.at_nodes(both, both + 3.0), [0, -100, -80, 0, -112])
        np.testing.assert_allclose(made.at_nodes(both, both - 3.0), [0, 0, -20, -10, -16])
        np.testing.assert_allclose(made.at_nodes(both, both - 6.0), [0, 0, -50, -25, -10])


@pytest.mark.parametrize("case", ["wheel", "timed wheel"])
def test_the_excess_of_the_cells_adds_up_to_the_total(case):
    answer, part, fastest, time, _ = solved(case)
    multipliers, run = answer.solution.multipliers, answer.problem.run
    bound = continuous_bound(part, answer.solution.plan, multipliers, fastest, time, run)
    assert bound.excess.min() >= 0.0
    total = answer.solution.energy - bound.value
    assert bound.excess.sum() == pytest.approx(total, rel=0.05, abs=1e-4 * bound.value)
    assert total < 0.005 * bound.value


def test_the_least_speed_is_that_of_its_closed_form():
    """Slower by d on the way costs d² / 2v times what slowing down and speeding up each take."""
    mass, pull, brake, top = 100e3, 0.5, 0.8, 20.0
    train = Train(
        name="plain", mass=mass, rotating_mass_factor=0.0,
        resistance=RunningResistance(0.0, 0.0, 0.0), max_tractive_effort=pull * mass,
        max_traction_power=1e9, max_pneumatic_braking_effort=brake * mass, max_speed=top,
    )  # fmt: skip
    run = TrajectoryProblem(level_line(6_000.0, (0.0, 3.6 * top)), train, observed(train, 1.0))
    fastest, in_hand = fastest_run(run), 3.0
    floor = floor_of(run, fastest, (0,), float(fastest.times[0]) + in_hand)
    least = top - np.sqrt(2.0 * top * in_hand / (1.0 / pull + 1.0 / brake))
    found = floor.at(np.array([2_000.0, 3_000.0, 4_000.0]))
    # What the solver may err by is given to the train, and the speed is found to a part in 128.
    assert np.all(found <= least)
    assert np.all(found >= least - 1.2)
    assert np.all(floor_of(run, fastest, (0,), 2.0 * float(fastest.times[0])).z == 0.0)


def test_the_highest_speed_is_that_of_its_closed_form():
    """Also where traction ends in braking for a limit, within a cell of any grid."""
    mass, pull, brake, power = 100e3, 0.5, 0.8, 6.0
    train = Train(
        name="plain", mass=mass, rotating_mass_factor=0.0,
        resistance=RunningResistance(0.0, 0.0, 0.0), max_tractive_effort=pull * mass,
        max_traction_power=power * mass, max_pneumatic_braking_effort=brake * mass, max_speed=90.0,
    )  # fmt: skip
    limit, places = 10.0, np.linspace(0.0, 6_000.0, 90_001)[1:-1]
    for turn in np.random.default_rng(3).uniform(1_990.0, 2_010.0, 5).tolist():
        line = level_line(6_000.0, (0.0, 400.0), (turn, 3.6 * limit))
        run = TrajectoryProblem(line, train, observed(train, 1.0))
        found = reached(closer(run, fastest_run(run), (0,)), places)[0]

        def fastest(s: FloatArray, begin: float) -> FloatArray:
            at_effort = np.sqrt(begin**2 + 2.0 * pull * s)
            from_power = max(power / pull, begin)
            left = np.maximum(s - max((from_power**2 - begin**2) / (2.0 * pull), 0.0), 0.0)
            return np.minimum(at_effort, np.cbrt(from_power**3 + 3.0 * power * left))

        before = np.minimum(
            fastest(places, 0.0), np.sqrt(limit**2 + 2.0 * brake * np.maximum(turn - places, 0.0))
        )
        stops = np.sqrt(2.0 * brake * (6_000.0 - places))
        exact = np.where(places <= turn, before, np.minimum(limit, stops))
        assert np.all(found >= exact * (1.0 - 1e-9))
        assert np.all(found <= exact * (1.0 + 3e-5) + 2e-6)


def test_no_plan_in_time_is_below_the_least_speeds():
    answer, part, fastest, time, _ = solved("tight line")
    floor = floor_of(part.run, fastest, tuple(range(part.shape[0])), time)
    lowest, speeds = floor.at(part.positions), np.sqrt(2.0 * answer.solution.plan.z)
    assert np.median(lowest) > 0.5 * np.median(speeds)
    assert np.all(speeds >= lowest)


def test_a_run_in_its_least_time_has_cells_until_it_is_certified():
    """A second is worth a hundred times what it usually is, and so is a change of control."""
    run = TrajectoryProblem(hilly_line(), FLIRT, observed(FLIRT, 1.0), reserve=0.0)
    found = optimise(run, OptimiserOptions(60))
    assert found.certificate["certified"]
    assert found.positions.size > 61
    kept = optimise(run, OptimiserOptions(60, tolerance=np.inf))
    assert kept.certificate["gap"] > 2e-3

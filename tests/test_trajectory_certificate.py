"""The bound of all trajectories: no finer plan is below it; its Hamiltonian beside all tried."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp
from trajectory_cases import (
    FLIRT,
    FREIGHT,
    VIRM6,
    drawn,
    free_train,
    hilly_line,
    level_line,
    observed,
    optimised,
    slippery,
)

from analysis.trajectory import bound, optimiser
from analysis.trajectory.active_set import initial_guess, search
from analysis.trajectory.bound import (
    COSTATES,
    ContinuousBound,
    Costate,
    Dual,
    Hamiltonian,
    Prices,
    Segments,
    _CostateProgram,
    _Piece,
    closest_bound,
    continuous_bound,
    joined,
    reached,
)
from analysis.trajectory.convex import Multipliers
from analysis.trajectory.discretisation import (
    Curves,
    Plan,
    Taper,
    discretise,
    effort_limits,
    graded_mesh,
)
from analysis.trajectory.envelope import closer, fastest_run, floor_of
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from analysis.trajectory.rollout import run_together
from trainlog.arrays import FloatArray
from trainlog.railway import EffortCurve, RunningResistance, TimingPoint, Trajectory

FINE = 1_200
"""Cells of plans that are to lie above the bounds of coarse ones."""

CASES: dict[str, dict[str, Any]] = {
    "line": {"objective": "line", "reserve": 0.1},
    "wheel": {"objective": "wheel", "reserve": 0.05},
}


@cache
def planned(case: str, cells: int, tolerance: float = np.inf) -> Trajectory:
    """The intercity on the hilly line, always in the same time."""
    return optimised(train=VIRM6, cells=cells, tolerance=tolerance, **CASES[case])


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
    question["configurations"] = drawn(FLIRT, count, seed=1, spread=0.3)
    coarse, fine = (optimised(cells=cells, **question).certificate for cells in (40, FINE // 2))
    assert coarse["gap"] < gap
    assert coarse["lower_bound"] <= fine["energy"] * (1.0 + 1e-6)


def test_a_bound_above_the_plan_certifies_nothing(monkeypatch):
    given = optimiser.continuous_bound

    def wrong(*args: Any, **options: Any) -> Any:
        found = given(*args, **options)
        return replace(found, value=1.1 * found.value)

    monkeypatch.setattr(optimiser, "continuous_bound", wrong)
    found = optimised(train=VIRM6, cells=61, reserve=0.1).certificate
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
    question |= {"running_time": time, "tolerance": np.inf}
    fine = optimised(configurations=run.configurations, cells=400, **question).certificate["energy"]
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
        optimised(train=train, cells=cells, reserve=reserve).certificate for cells in (300, FINE)
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
    pull, brake, top = 0.5, 0.8, 20.0
    train = free_train(pull, 1e4, brake, max_speed=top)
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
    pull, brake, power = 0.5, 0.8, 6.0
    train = free_train(pull, power, brake, max_speed=90.0)
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


POINTS = 3
TRACTION = EffortCurve(
    np.array([0.0, 10.0, 16.0, 25.0, 60.0]), 1e3 * np.array([200, 180, 90, 80, 30.0])
)
BRAKE = EffortCurve(np.array([0.0, 3.0, 12.0, 60.0]), 1e3 * np.array([0, 150, 120, 40.0]))
CROSSED = replace(FLIRT, traction_curve=TRACTION, dynamic_braking_curve=BRAKE)
CURVED = replace(
    CROSSED, max_traction_power=2e7, max_dynamic_braking_power=2e7, max_acceleration=2.0,
    max_deceleration=2.0,
)  # fmt: skip
"""No other limit is below the curves at some speeds only."""

WEAK = replace(FLIRT, max_dynamic_braking_power=9e5, max_pneumatic_braking_effort=6e4)
STRONG = replace(FLIRT, max_dynamic_braking_power=9e5)
SHORT = replace(STRONG, max_dynamic_braking_effort=6e4)
"""Friction alone does more than the dynamic brake."""

SLIPPERY = slippery(hilly_line(), (900.0, 2_600.0, 0.06))

HAMILTONIANS: dict[str, tuple[Any, dict[str, Any]]] = {
    "line": (WEAK, {"objective": "line"}),
    "wheel": (FLIRT, {"objective": "wheel"}),
    "friction": (WEAK, {"objective": "wheel"}),
    "curves": (CURVED, {"objective": "line"}),
    "crossed curves": (CROSSED, {"objective": "line"}),
    "strong friction": (STRONG, {"objective": "line"}),
    "slippery": (FLIRT, {"objective": "line", "condition_map": SLIPPERY}),
    "common": (SHORT, {"objective": "line", "braking": "common"}),
}


@cache
def of(case: str) -> tuple[Hamiltonian, Prices, FloatArray, FloatArray]:
    """A plan of two configurations, any prices, and any two costates with any slopes."""
    train, asked = HAMILTONIANS[case]
    run = TrajectoryProblem(hilly_line(), train, drawn(train, 2, seed=2, spread=0.3), **asked)
    fastest, rng = fastest_run(run), np.random.default_rng(1)
    problem = discretise(run, np.unique([*run.breakpoints, 40.0, 300.0]))
    q, n = problem.shape
    problem = problem.tapered(Taper(rng.uniform(0.0, 0.05, n), np.zeros(n)))
    z = rng.uniform(0.2, 0.8, (q, n + 1)) * 0.5 * fastest.at(problem.positions) ** 2
    braking = rng.uniform(0.0, 0.5, (q, n)) * problem.braking
    traction = rng.uniform(0.1, 0.8, n) * problem.traction
    plan = Plan(z, traction, braking, np.minimum(0.5 * braking, problem.dynamic))
    time, share = rng.uniform(0.5, 6.0, (q, n)), rng.dirichlet(np.ones(q), n).T
    regained = rng.uniform(0.2, 0.5, q) * run.at_line
    dynamic = rng.uniform(0.0, 1.0, (q, n)) * regained[:, None]
    prices = Prices(1.1, regained, time, 0.0, share, dynamic)
    segments = Segments.of(problem, POINTS)
    shape = (2, q, n, POINTS)
    costate, slope = rng.uniform(-0.6, 1.6, shape), rng.uniform(-1e-2, 1e-2, shape)
    return Hamiltonian(problem, plan, fastest, run, segments), prices, costate, slope


def duals(case: str) -> dict[str, Dual]:
    """One costate, with the prices that its limits lead to, and two with any prices."""
    made, prices, costate, slope = of(case)
    rng, nodes = np.random.default_rng(3), np.zeros(0)
    efforts = made.priced(prices, costate[0])
    traction = rng.uniform(-0.5, 1.5, costate[0].shape)
    traction += (prices.traction - traction.sum(axis=0)) / len(traction)
    braking = np.zeros(traction.shape)
    if made.problem.common:
        braking = rng.uniform(-0.5, 0.5, traction.shape)
        braking -= braking.mean(axis=0)
    return {
        "one": Dual(prices, costate[:1], slope[:1], *efforts, nodes),
        "two": Dual(prices, costate, slope, traction, braking, nodes),
    }


def tried(made: Hamiltonian, dual: Dual, each: int, speed: FloatArray) -> list[FloatArray]:
    """The Hamiltonian of each configuration by a costate, at speeds (m, q, n, p).

    Without traction and with the most of it, each with the best of its brakes.
    """
    run, reference, prices = made.problem.run, made.problem.reference, dual.prices
    train, s = run.train, made.segments.positions
    limits = effort_limits(run, s.reshape(-1, 1), run.adhesion_at(s.ravel()))
    most_pull, most, friction, most_dynamic = (
        (value / reference).reshape(-1, *s.shape)
        for value in (limits.traction, limits.braking, limits.friction, limits.dynamic)
    )
    if run.braking == "common":
        most = np.broadcast_to(most.min(axis=0), most.shape)
    tunnel = train.tunnel_coefficient(run.line.tunnel_cross_section(s))
    found = [np.empty(speed.shape), np.empty(speed.shape)]
    for row, own in enumerate(run.configurations):
        v, gain, costate = speed[:, row], reference / own.inertia, dual.costate[each, row]
        drag = own.resistance(v) + own.mass * run.track_acceleration(s) + tunnel * v**2
        pull = np.minimum(most_pull.min(axis=0), own.max_power / reference / v)
        brake = np.minimum(most_dynamic[row], train.max_dynamic_braking_power / reference / v)
        if train.traction_curve is not None:
            part = own.max_power / train.max_traction_power
            pull = np.minimum(pull, train.traction_curve(v / part) / reference)
            brake = np.minimum(brake, train.dynamic_braking_curve(v) / reference)
        # In a corner of what is fed back, and of how much all brakes do besides.
        least = np.full(v.shape, np.inf)
        braked = costate * gain + np.broadcast_to(dual.braking, dual.costate[each].shape)[row]
        for dynamic in (0.0 * brake, brake, np.clip(most[row] - friction[row], 0.0, brake)):
            fed_back = np.minimum(dynamic, most[row])
            for total in (fed_back, np.minimum(most[row], friction[row] + fed_back)):
                least = np.minimum(least, braked * total - prices.regained[row] * fed_back)
        moved = costate * (drag / own.inertia + made.rise[row])
        away = dual.slope[each, row] * (0.5 * v**2 - made.z[row])
        found[0][:, row] = prices.time[row][:, None] / v + least + moved - away
        found[1][:, row] = found[0][:, row] + (dual.traction[row] - costate * gain) * pull
    return found


def speeds_of(made: Hamiltonian, count: int) -> FloatArray:
    """Up to the highest at each point, (m, q, n, p)."""
    parts = (np.geomspace(1e-3, 1.0, count)[:-1], np.linspace(1.0, 60.0, 10 * count) / 60.0)
    return np.maximum(
        np.unique(np.concatenate(parts))[:, None, None, None] * made.highest, bound.LEAST_SPEED
    )


@pytest.mark.parametrize("number", ["one", "two"])
@pytest.mark.parametrize("case", HAMILTONIANS)
def test_the_least_is_that_of_all_speeds_and_controls(case, number):
    """By the costate of the speeds below the plan's, and by that of the speeds above."""
    made, *_ = of(case)
    dual, speed = duals(case)[number], speeds_of(made, 300)
    own = np.full(made.speed.shape, np.inf)
    for each in range(len(dual.costate)):
        value = np.minimum(*tried(made, dual, each, speed))
        if number == "two":
            value[(speed < made.speed) if each else (speed > made.speed)] = np.inf
        at_plan = np.minimum(*tried(made, dual, each, made.speed[None]))[0]
        own = np.minimum(own, np.minimum(value.min(axis=0), at_plan))
    least, found = own.sum(axis=0), made.least(dual)
    assert np.all(found <= least + 1e-9)
    # Less than the least where limits cross between the speeds at which one of them bends.
    assert np.all(found >= least - 0.3)
    train = made.problem.run.train
    crossed = case in ("crossed curves", "common") or (train is WEAK)
    error = (least - found) / (1.0 + np.abs(least))
    assert np.quantile(error, 0.5 if crossed else 0.8) < 1e-3
    assert np.all((error < 1e-3) | crossed)


@pytest.mark.parametrize("case", HAMILTONIANS)
def test_together_no_traction_is_more_than_the_speeds_of_all_allow(case):
    """The least over pairs of speeds, each with the traction that is the most for both."""
    made, prices, costate, _ = of(case)
    dual = duals(case)["one"]
    least = made.least(dual)
    raised = made.raised(least, dual)
    speed = speeds_of(made, 60)
    free, _ = tried(made, dual, 0, speed)
    # As if all that traction is worth were each configuration's own.
    own = costate[0] * made.gain
    worth = np.maximum(own.sum(axis=0) - prices.traction, 0.0)
    _, limited = tried(made, replace(dual, traction=own - worth), 0, speed)
    by_both = np.full(least.shape, np.inf)
    for each, pulled in zip(free[:, 0], (limited - free)[:, 0], strict=True):
        pair = each + free[:, 1] + np.maximum(pulled, (limited - free)[:, 1])
        by_both = np.minimum(by_both, pair.min(axis=0))
    assert np.all(raised >= least)
    assert np.all(raised <= by_both + 1e-9 * (1.0 + np.abs(by_both)))
    missed, before = by_both - raised, by_both - least
    higher = before > 0.05
    assert higher.sum() > 0.1 * higher.size
    assert np.median(missed[higher] / before[higher]) < 0.25


@pytest.mark.parametrize("case", HAMILTONIANS)
def test_the_costate_changes_as_the_least_does_with_the_speed(case):
    """The adjoint equation: with its slopes the Hamiltonian is level about the plan's speeds."""
    made, prices, costate, _ = of(case)
    dual, step = duals(case)["one"], 1e-4
    level = replace(dual, slope=np.zeros_like(dual.slope))
    around = np.stack([made.speed - step, made.speed + step])
    rise = np.minimum(*tried(made, level, 0, around))
    expected = (rise[1] - rise[0]) / (2.0 * step) / made.speed
    np.testing.assert_allclose(made.slopes(prices, costate[0]), expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("case", HAMILTONIANS)
def test_a_plan_costs_what_its_efforts_and_its_time_are_worth(case):
    made, prices, _, _ = of(case)
    problem, plan = made.problem, made.plan
    place, fall = made.segments.place, problem.taper.fall[:, None]
    total = prices.traction * (plan.traction[:, None] + fall - 2.0 * fall * place)
    for row in range(problem.shape[0]):
        total = total + prices.time[row][:, None] / made.speed[row]
        total = total - prices.regained[row] * plan.dynamic[row][:, None]
    np.testing.assert_allclose(made.of_plan(prices), total, rtol=1e-10)


@pytest.mark.parametrize("case", HAMILTONIANS)
def test_prices_of_common_efforts_add_up_to_what_they_cost(case):
    """Each configuration has the share of its limit, and one brake for all costs nothing more."""
    made, prices, costate, _ = of(case)
    traction, braking = made.priced(prices, costate[0])
    np.testing.assert_allclose(traction.sum(axis=0), prices.traction)
    np.testing.assert_allclose(braking.sum(axis=0), 0.0, atol=1e-12)
    own = costate[0] * made.gain
    worth = own.sum(axis=0) - prices.traction
    np.testing.assert_allclose(own - traction, prices.share[:, :, None] * worth, atol=1e-12)


@pytest.mark.parametrize("train", [FLIRT, VIRM6, FREIGHT], ids=lambda train: train.name)
def test_inside_its_cells_a_plan_has_the_speeds_that_its_efforts_lead_to(train):
    """In long cells, with bends that begin and end in them, and traction that falls; by DOP853."""
    run = TrajectoryProblem(hilly_line(), train, drawn(train, 2, seed=2, spread=0.3))
    fastest, positions = fastest_run(run), np.union1d(run.breakpoints, [10.0, 50.0, 200.0, 400.0])
    problem, plan = run_together(discretise(run, positions), fastest.at(positions))
    made = Hamiltonian(problem, plan, fastest, run, Segments.of(problem, 4))
    line, fall, step = run.line, problem.taper.fall, problem.step
    for row, each in enumerate(run.configurations):
        for cell in range(1, step.size - 1):

            def force(s, z, row=row, each=each, cell=cell):
                place = (s - positions[cell]) / step[cell]
                pull = plan.traction[cell] + fall[cell] * (1.0 - 2.0 * place)
                v, where = np.sqrt(2.0 * z), np.array([s])
                drag = each.resistance(v) + each.mass * run.track_acceleration(where)
                drag += run.train.tunnel_coefficient(line.tunnel_cross_section(where)) * v**2
                return problem.reference * (pull - plan.braking[row, cell]) / each.inertia - (
                    drag / each.inertia
                )

            span, at = positions[cell : cell + 2], made.segments.positions[cell]
            begin = [plan.z[row, cell]]
            found = solve_ivp(force, span, begin, "DOP853", at, rtol=1e-9, max_step=step[cell] / 8)
            v = np.sqrt(2.0 * found.y[0])
            np.testing.assert_allclose(made.speed[row, cell], v, rtol=3e-4)
            change = np.ravel([force(*pair) for pair in zip(at, found.y[0], strict=True)])
            assert np.abs(made.rise[row, cell] - change).max() < 2e-3


def test_what_traction_is_worth_at_its_limit_is_shared_by_whose_power_limits_it():
    """By all alike where the effort limits it; so is what is fed back, by the multipliers."""
    problem = of("line")[0].problem
    q, n = problem.shape
    none, power = np.zeros((q, n)), np.array([[0.75], [0.25]]) * np.linspace(0.5, 2.0, n)
    power[:, : n // 2] = 0.0
    of_times = np.zeros((q, 0))
    made = Multipliers(none, np.ones(q), of_times, of_times, power, none, np.array([3.0, 1.0]))
    prices = Prices.of(problem, made, 100.0)
    np.testing.assert_allclose(prices.share[:, n // 2 :], np.tile([[0.75], [0.25]], n - n // 2))
    np.testing.assert_allclose(prices.share[:, : n // 2], 0.5)
    regained = problem.run.train.efficiency_regeneration * np.array([0.75, 0.25])
    np.testing.assert_allclose(prices.regained, regained)
    assert prices.traction == 1.0 / problem.run.train.efficiency_traction
    assert prices.allowed == 200.0


def test_quadrature_is_exact_for_what_time_and_costate_are_made_of():
    """Polynomials; and the root of the way from a standstill and to one."""
    made, *_ = of("line")
    segments, length = made.segments, made.problem.step
    inner = slice(1, -1)
    for power in range(2 * POINTS):
        whole = (segments.weights * segments.place**power).sum(axis=1)[inner]
        np.testing.assert_allclose(whole, length[inner] / (power + 1.0))
    for power in range(POINTS):
        so_far = segments.gathered(segments.place**power) / length[:, None]
        np.testing.assert_allclose(
            so_far[inner], segments.place[inner] ** (power + 1) / (power + 1)
        )
    start, end = segments.place[0], 1.0 - segments.place[-1]
    for weights, way, whole in (
        (segments.weights[0], start, length[0]),
        (segments.weights[-1], end, length[-1]),
    ):
        np.testing.assert_allclose(weights @ way**-0.5, 2.0 * whole)
    np.testing.assert_allclose(
        segments.positions, made.problem.positions[:-1, None] + length[:, None] * segments.place
    )


@pytest.mark.parametrize("even", [True, False])
def test_a_costate_joins_its_ends(even):
    made, prices, (costate, _), _ = of("line")
    begin, end = costate[:, :, 0], costate[:, :, -1]
    line = Costate(made.segments, begin, end, np.full(begin.shape, even))
    values, slopes = line.along(made, prices)
    segments, inner = made.segments, slice(1, -1)
    np.testing.assert_allclose(
        (slopes * segments.weights).sum(axis=2), end - begin, rtol=1e-9, atol=1e-9
    )
    # The slopes of its values, and where it is not even those of the adjoint equation but for one
    # constant in each cell.
    powers = np.arange(POINTS)
    fit = np.linalg.inv(segments.place[:, :, None] ** powers)
    own = np.einsum("nkp,qnp->qnk", fit, slopes)[:, inner, None, :]
    place = segments.place[inner][:, :, None] ** (powers + 1) / (powers + 1)
    rise = (own * place).sum(axis=3) * segments.length[inner][:, None]
    np.testing.assert_allclose(values[:, inner], begin[:, inner, None] + rise, rtol=1e-9, atol=1e-9)
    straight = begin[:, :, None] + (end - begin)[:, :, None] * segments.place
    if even:
        np.testing.assert_allclose(values, straight)
    else:
        apart = slopes - made.slopes(prices, straight)
        assert np.ptp(apart, axis=2).max() < 1e-9 * np.abs(slopes).max()


@pytest.mark.parametrize("case", HAMILTONIANS)
def test_on_each_stretch_the_better_costate_counts(case):
    """Two that are the same in every third cell: the best of all ways to put them together."""
    made, prices, (costate, _), (slope, _) = of(case)
    n, random = costate.shape[1], np.random.default_rng(4)
    same = np.arange(n) % 3 == 2
    other = np.where(same[:, None], costate, costate + random.uniform(-0.1, 0.1, costate.shape))
    at_nodes = random.uniform(-0.5, 0.5, n + 1)
    # A node between two cells that are the same is, too.
    at_others = at_nodes + random.uniform(-40.0, 40.0, n + 1) * ~(
        np.append(same, True) & np.insert(same, 0, True)
    )
    one, two = (
        Dual(prices, each[None], slope[None], *made.priced(prices, each), nodes)
        for each, nodes in ((costate, at_nodes), (other, at_others))
    )
    least, weights = (made.least(one), made.least(two)), made.segments.weights

    def value(dual: Dual, lowest: FloatArray) -> float:
        return float((lowest * weights).sum() + dual.at_nodes.sum())

    dual, found = joined(weights, one, two, least)
    best = value(one, least[0])
    for begin in range(0, n, 3):
        cells, nodes = slice(begin, begin + 2), slice(begin, min(begin + 3, n + 1))
        gain = ((least[1] - least[0]) * weights)[cells].sum()
        best += max(float(gain + (at_others - at_nodes)[nodes].sum()), 0.0)
    assert value(dual, found) == pytest.approx(best)
    assert value(dual, found) > max(value(one, least[0]), value(two, least[1]))
    np.testing.assert_allclose(found, made.least(dual))


@pytest.mark.parametrize("signs", [(1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (0, 1), (-1, 0)])
def test_what_a_cell_costs_is_bounded_whatever_the_sizes_of_its_terms(signs):
    rng = np.random.default_rng(5)
    a, b, c = 10.0 ** rng.uniform(-2.0, 1.5, (3, 400)) * [[signs[0]], [1.0], [signs[1] * 0.01]]
    b *= rng.choice([-1.0, 1.0], 400)
    low = rng.uniform(0.3, 10.0, 400)
    high = low + rng.uniform(0.1, 30.0, 400)
    v = low + (high - low) * np.linspace(0.0, 1.0, 4_001)[:, None]
    least = (a / v + b * v + c * v**2).min(axis=0)
    found = bound._least(a, b, c, (low, high), rng.uniform(low, high))
    assert np.all(found <= least + 1e-9 * np.maximum(np.abs(least), 1.0))
    assert np.max(least - found) < 1e-4


@pytest.mark.parametrize("curve", [TRACTION, BRAKE], ids=["traction", "brake"])
def test_an_effort_is_the_lowest_of_its_limits_at_each_speed(curve):
    """Beyond the curve's last point, too, where it goes on at the power of that."""
    share = np.array([1.0, 0.8])
    own = EffortCurve(curve.speeds, curve.efforts / 1e5)
    curves = Curves.of(own, share, 100.0)
    speed = np.tile(np.linspace(0.3, 1.6 * own.speeds[-1], 400)[:, None], (2, 1, 1))
    speed = speed.reshape(2, 400, 1)
    for effort, power in ((1.3, 18.0), (5.0, 1e3), (0.4, 1e3), (5.0, 12.0)):
        limits = np.full(speed.shape, effort), np.full(speed.shape, power)
        plain = _Piece.of(*limits, None, speed).at(speed)
        np.testing.assert_allclose(plain, np.minimum(effort, power / speed))
        expected = np.minimum(plain, own(speed / share[:, None, None]))
        np.testing.assert_allclose(_Piece.of(*limits, curves, speed).at(speed), expected)


def test_between_two_nodes_a_run_may_turn_from_one_slope_to_the_other():
    """By hand: slopes of 6, 4, 1, -2 and -5 of half the square of the speed, over 1 m each."""
    z = np.array([1.0, 7.0, 11.0, 12.0, 10.0, 5.0])
    run = replace(
        fastest_run(of("line")[0].problem.run),
        positions=np.arange(6.0),
        speeds=np.sqrt(2.0 * z)[None],
    )
    found = reached(run, np.arange(5) + 0.5)[0]
    np.testing.assert_allclose(0.5 * found**2, [4.5, 10.25, 13.0, 12.5, 8.25], rtol=1e-3)

"""The tracking MPC of Hauck et al. (2023): exact steps, solved programs, constraints kept."""

from __future__ import annotations

from functools import cache

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from scipy.linalg import expm, solve_discrete_are

from analysis.control.qp import SOFTNESS, solve, terminal_weight
from analysis.control.route import value
from analysis.studies.hauck_2023 import model as dynamics, tracking as kernels
from analysis.studies.hauck_2023.controller import (
    HOLDING_SPEED,
    RETURN_ACCELERATION,
    Method,
    TrackingController,
    Tuning,
    latest,
    returning,
    with_lead,
)
from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN
from analysis.studies.hauck_2023.reference import SAMPLING, Reference, reference
from analysis.studies.hauck_2023.section import least_time_unweighed, section_of
from trainlog.errors import InputError
from trainlog.railway import Line, Station, StepProfile
from trainlog.simulation.drivers import Stop
from trainlog.simulation.plant import HOLDING

LIGHT, NOMINAL, HEAVY = PUBLISHED_TRAIN.mass, 78_200.0, PUBLISHED_TRAIN.max_mass


@pytest.fixture(scope="module")
def plan() -> Reference:
    return _short_plan()


@cache
def _short_plan() -> Reference:
    track = Line(
        name="short",
        length=2_600.0,
        stations=(Station("A", 100.0), Station("B", 2_000.0)),
        speed_limits=StepProfile(np.array([0.0, 1_000.0]), np.array([70.0, 55.0]) / 3.6),
        gradients=StepProfile(np.array([0.0, 500.0, 900.0]), np.array([0.0, 0.01, 0.0])),
    )
    rail = StepProfile(np.array([0.0, 150.0, 250.0]), np.array([0.3, 0.08, 0.3]))
    stops = Stop("A", 100.0, 0.0, 0.0), Stop("B", 2_000.0, 180.0, 180.0)
    return reference(section_of(track, PUBLISHED_TRAIN, rail, *stops))


def driven(
    plan: Reference, mass: float, about: str = "prediction", delay: float = 0.0, *, guard: bool
) -> np.ndarray:
    """Rows of time, position, speed, lever ten times a second of the model of eq. (3)."""
    controller = TrackingController(plan, Method(about))
    t, c = plan.section.tables, plan.section.constants
    p, v, now = plan.section.origin.position, 0.0, delay
    rows = []
    while now < plan.duration + delay + 60.0:
        lever = controller.lever(now, p, v)
        if guard:
            lever = controller.guarded(lever, p, v)
        for _ in range(10):
            rows.append((now, p, v, lever))
            p, v = kernels.step(p, v, lever, 0.1, mass, t, c)
            now += 0.1
        if v == 0.0 and p > plan.section.destination.position - 0.5:
            break
    assert controller.unsolved == 0
    return np.array(rows)


def worst(plan: Reference, rows: np.ndarray) -> np.ndarray:
    """Largest comfort, traction, speed and lever constraint, without any reserve."""
    section = plan.section
    found = []
    for _, p, v, u in rows[rows[:, 2] > 0.0]:
        sine = value(section.tables.sine, section.tables.origin, p)
        grip, limit = float(section.maximum_adhesion(p)), float(section.line.speed_limit(p))
        c = section.constants
        found.append((*dynamics.constraint_values(v, u, sine, grip, limit, c), abs(u) - 1.0))
    return np.max(np.array(found), axis=0)


@given(a21=st.floats(-0.02, 0.02), a22=st.floats(-0.6, 0.6), b2=st.floats(0.0, 3.0))
def test_the_sampled_system_is_the_matrix_exponential(a21: float, a22: float, b2: float) -> None:
    whole = np.array([[0.0, 1.0, 0.0], [a21, a22, b2], [0.0, 0.0, 0.0]])
    exact = expm(whole)
    a, b = kernels.exact_step(a21, a22, b2, 1.0)
    np.testing.assert_allclose(a, exact[:2, :2], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(b, exact[:2, 2], rtol=1e-12, atol=1e-14)


def test_the_condensed_program_is_the_sum_of_the_costs(plan: Reference) -> None:
    """Stage by stage with the linear model; the terminal cost is what the regulator would pay."""
    controller = TrackingController(plan, Method("reference"))
    program = controller.program(40.0, plan.at(40.0)[0] - 3.0, plan.at(40.0)[1] + 0.2)
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, program.inputs.size)) * 0.05

    def cost(change: np.ndarray) -> float:
        return 0.5 * change @ program.hessian @ change + program.gradient @ change

    # Convex, and the answer is where the gradient vanishes if no bound is met.
    assert cost(0.5 * (x + y)) < 0.5 * (cost(x) + cost(y))
    assert np.linalg.eigvalsh(program.hessian).min() >= 0.01 - 1e-9
    free = np.linalg.solve(program.hessian, -program.gradient)
    assert cost(free) <= min(cost(x), cost(y))


def test_terminal_cost_is_the_fixed_point_of_riccati() -> None:
    a, b = kernels.exact_step(0.0, -0.02, 0.6, 1.0)
    p = terminal_weight(a, b, 1.0, 0.01)
    q, r = np.diag([1.0, 0.0]), 0.01
    gain = (b @ p @ a) / (r + b @ p @ b)
    np.testing.assert_allclose(p, q + a.T @ p @ a - np.outer(a.T @ p @ b, gain), rtol=1e-6)


@pytest.mark.parametrize("gain", [0.8, 1.0, 1.2])
def test_terminal_cost_is_that_of_the_stationary_regulator(gain: float) -> None:
    a, b = np.array([[1.0, 0.9], [-0.02, 0.95]]), gain * np.array([0.5, 1.0])
    expected = solve_discrete_are(a, b[:, None], np.diag([2.0, 0.0]), np.array([[0.1]]))
    np.testing.assert_allclose(terminal_weight(a, b, 2.0, 0.1), expected, rtol=1e-6)


@settings(max_examples=25)
@given(seed=st.integers(0, 1000))
def test_the_solver_finds_what_another_solver_finds(seed: int) -> None:
    """Clarabel on the same program, with rules that may be broken at the same price a row.

    DAQP counts what a row is broken by over the row's norm, so that the two may differ by what
    the softness allows.
    """
    plan = _short_plan()
    rng = np.random.default_rng(seed)
    now = float(rng.integers(2, 150))
    p, v, _ = plan.at(now)
    controller = TrackingController(plan)
    program = controller.program(now, p + rng.normal() * 5.0, max(v + rng.normal() * 0.5, 0.0))
    change, status = solve(program)
    assert status > 0
    n = change.size
    x = cp.Variable(n)
    over = 1e-3 * cp.Variable(len(program.rows), nonneg=True)
    price = 0.5e-6 * cp.sum_squares(1e3 * over) / SOFTNESS
    hessian = cp.psd_wrap(0.5 * (program.hessian + program.hessian.T))
    rules = [x <= program.upper[:n], x >= program.lower[:n]]
    above, below = np.isfinite(program.upper[n:]), np.isfinite(program.lower[n:])
    rules.append(program.rows[above] @ x <= program.upper[n:][above] + over[above])
    rules.append(program.rows[below] @ x >= program.lower[n:][below] - over[below])
    cost = 0.5 * cp.quad_form(x, hessian) + program.gradient @ x + price
    cp.Problem(cp.Minimize(cost), [rule for rule in rules if rule.size]).solve(solver=cp.CLARABEL)
    # The first lever is the one that is pulled; the last ones cost next to nothing.
    assert change[0] == pytest.approx(x.value[0], abs=1e-5)
    np.testing.assert_allclose(change, x.value, atol=5e-3)


def test_on_time_both_linearisations_stay_within_a_metre(plan: Reference) -> None:
    for about in ("reference", "prediction"):
        rows = driven(plan, NOMINAL, about, guard=False)
        errors = rows[:, 1] - [plan.at(float(now))[0] for now in rows[:, 0]]
        assert np.abs(errors).max() < 1.0


@pytest.mark.parametrize("mass", [LIGHT, NOMINAL, HEAVY])
@pytest.mark.parametrize("delay", [0.0, 30.0])
def test_every_constraint_is_kept_at_every_mass_on_time_and_late(
    plan: Reference, mass: float, delay: float
) -> None:
    rows = driven(plan, mass, delay=delay, guard=True)
    assert worst(plan, rows).max() <= 1e-6
    assert abs(rows[-1, 1] - 2_000.0) < 0.6


def test_after_a_delay_only_the_real_time_iteration_keeps_comfort(plan: Reference) -> None:
    """The paper's own linearisation takes the bounds of where the train ought to be."""
    paper = driven(plan, NOMINAL, "reference", delay=30.0, guard=False)
    iterated = driven(plan, NOMINAL, "prediction", delay=30.0, guard=False)
    assert worst(plan, paper)[0] > 0.1
    assert worst(plan, iterated)[0] <= 1e-6


def test_the_guard_leaves_a_safe_lever_alone_and_cuts_an_unsafe_one(plan: Reference) -> None:
    controller = TrackingController(plan)
    assert controller.guarded(0.1, 600.0, 10.0) == pytest.approx(0.1)
    # A slippery place begins at 150 m; what it bears is that of the lightest train.
    cut = controller.guarded(1.0, 145.0, 5.0)
    assert 0.8 < float(PUBLISHED_TRAIN.full_effort(5.0)) * cut / (0.08 * 9.81 * LIGHT) < 1.0
    ceiling = np.sqrt(value(plan.section.tables.ceiling, plan.section.tables.origin, 700))
    assert controller.guarded(1.0, 700.0, float(ceiling)) < 0.4  # what holds on the climb


@pytest.mark.parametrize("mass", [LIGHT, HEAVY])
def test_a_late_driver_arrives_near_the_least_time_that_an_unknown_mass_allows(
    plan: Reference, mass: float
) -> None:
    """Ten levers a second; with what is learnt of the mass the ceiling rises."""
    controller = TrackingController(plan)
    section = plan.section
    t, c = section.tables, section.constants
    p, v, now = section.origin.position, 0.0, 70.0
    rows = []
    while not (v == 0.0 and p > section.destination.position - 0.5):
        lever = controller.drive(now, p, v)
        if v < HOLDING_SPEED and lever <= 0.0:
            v = max(v - 0.1 * HOLDING, 0.0)
        rows.append((now, p, v, lever))
        p, v = kernels.step(p, v, lever, 0.1, mass, t, c)
        now += 0.1
        assert now < 400.0
    found = np.array(rows)
    assert worst(plan, found).max() <= 1e-6
    assert abs(p - section.destination.position) < 0.2
    low, high = controller.mass
    assert low <= mass <= high
    assert high - low < 5e3
    least = least_time_unweighed(section, mass)
    assert least <= now - 70.0 < least + 2.5


@given(off=st.floats(-600.0, 600.0))
def test_a_train_that_is_off_returns_without_a_jerk(off: float) -> None:
    """Never past its target, at a speed that never changes faster than is gentle."""
    left, rate = returning(off, 300).T
    assert np.all(np.abs(np.diff(rate)) <= RETURN_ACCELERATION * SAMPLING + 1e-9)
    assert np.all(left * np.sign(off) >= 0.0)
    assert abs(left[0]) <= abs(off) + 1e-9
    assert abs(left[-1]) < 0.01
    moved = np.diff(left)
    np.testing.assert_allclose(moved, 0.5 * (rate[1:] + rate[:-1]) * SAMPLING, atol=2e-3)


def test_a_reference_is_led_where_it_would_be_late_and_nowhere_else(plan: Reference) -> None:
    section = plan.section
    stop = section.destination.position
    run = dynamics.fastest_run(
        section.origin.position, 0.0, stop, 5.0, np.inf, NOMINAL, 1.0,
        section.tables, section.driving_constants,
    )  # fmt: skip
    rows = plan.sampled()
    in_time = latest(run, plan.duration, len(rows))
    assert in_time[-1, 0] == stop
    np.testing.assert_array_equal(with_lead(rows, in_time), rows)
    hurried = latest(run, run[2][-1] / 0.98, len(rows))
    led = with_lead(rows, hurried)
    assert np.all(led[:, 0] >= np.maximum(rows[:, 0], hurried[:, 0]))
    assert np.any(led[:, 0] > rows[:, 0] + 5.0)
    assert np.all(np.diff(led[:, 0]) >= -1e-9)


def test_a_train_that_is_late_but_can_be_in_time_is_neither_late_nor_early(
    plan: Reference,
) -> None:
    """It takes all the time that is left, and brakes for the lower limit and the stop alone."""
    controller = TrackingController(plan)
    section = plan.section
    t, c = section.tables, section.constants
    now = float(np.floor(plan.duration - 1.02 * least_time_unweighed(section, NOMINAL)))
    p, v, levers = section.origin.position, 0.0, []
    assert now > 10.0
    while not (v == 0.0 and p > section.destination.position - 0.5):
        lever = controller.drive(now, p, v)
        if v < HOLDING_SPEED and lever <= 0.0:
            v = max(v - 0.1 * HOLDING, 0.0)
        levers.append(lever)
        p, v = kernels.step(p, v, lever, 0.1, NOMINAL, t, c)
        now += 0.1
        assert now < 400.0
    assert abs(now - plan.duration) < 1.0
    at_work = np.array(levers)[np.abs(levers) > 0.02]
    assert np.count_nonzero(np.diff(np.sign(at_work))) == 3


def test_a_tuning_that_is_not_positive_is_refused() -> None:
    refused(InputError, "lever 0", Tuning, lever=0.0)


def test_an_unknown_linearisation_is_refused(plan: Reference) -> None:
    refused(InputError, "about 'nothing' is unknown", Method, "nothing")


def test_a_late_train_that_stands_short_of_its_stop_goes_on_to_it(plan: Reference) -> None:
    controller = TrackingController(plan)
    stop, now = plan.section.destination.position, plan.duration + 5.0
    p, v = stop - 1.1, 0.0
    while p < stop - 0.5 and now < plan.duration + 60.0:
        lever = controller.drive(now, p, v)
        p, v = kernels.step(p, v, lever, 0.1, NOMINAL, plan.section.tables, plan.section.constants)
        now += 0.1
    assert stop - 0.5 <= p < stop + 0.5

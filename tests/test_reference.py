"""References by multiple shooting: known answers, constraints, and what no solver is asked."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from scipy.linalg import expm, solve_discrete_are
from simulated_line import level_line, steps

from analysis.control.prediction import SOFTNESS, solve, terminal_weight
from analysis.studies.hauck_2023 import model, model as dynamics, reference as shooting
from analysis.studies.hauck_2023.model import NOMINAL_MASS, PUBLISHED_TRAIN
from analysis.studies.hauck_2023.reference import (
    SAMPLING,
    Reference,
    Section,
    check_timetable,
    fastest,
    fastest_unweighed,
    reference,
    section_of,
)
from analysis.studies.hauck_2023.simulation import (
    Controller,
    MapController,
    PublishedController,
    sampled_system,
)
from trainlog import InfeasibleError, InputError, Line, Station, StepProfile, read_line, sample
from trainlog.formats.railway import line_to_bytes
from trainlog.simulation.drivers import PERIOD, Stop
from trainlog.simulation.plant import HOLDING
from trainlog.units import GRAVITY

GRIP = StepProfile(np.zeros(1), np.array([0.3]))


def line(slope: float = 0.0, limit: float = 80.0, length: float = 3_000.0) -> Line:
    limits = (0.0, limit / 3.6), (900.0, 0.7 * limit / 3.6), (1_300.0, limit / 3.6)
    return level_line(
        length,
        stations=(Station("A", 100.0), Station("B", length - 500.0)),
        speed_limits=steps(*limits),
        gradients=steps((0.0, 0.0), (600.0, slope), (1_500.0, 0.0)),
    )


def section(time: float, grip: StepProfile = GRIP, **given: Any) -> Section:
    track = line(**given)
    start, end = (each.position for each in track.stations)
    stops = Stop("A", start, 0.0, 0.0), Stop("B", end, time, time)
    return section_of(track, PUBLISHED_TRAIN, grip, *stops)


@pytest.fixture(scope="module")
def solved() -> shooting.Reference:
    slippery = StepProfile(np.array([0.0, 200.0, 300.0]), np.array([0.3, 0.07, 0.3]))
    return reference(section(200.0, slippery, slope=0.012))


def test_the_train_arrives_in_time_and_stands(solved):
    assert solved.duration == 200.0
    assert solved.fine[-1, 0] == pytest.approx(2_500.0, abs=0.3)
    assert solved.fine[-1, 1] < 0.1
    assert solved.rollout_error < 0.3


def test_no_constraint_is_broken_between_the_nodes_at_any_mass(solved):
    assert solved.worst.max() <= 0.0
    track = solved.section.line
    for position, speed, lever in solved.fine:
        slope = float(track.gradient(position))
        grip = float(solved.section.maximum_adhesion(position))
        for mass in (PUBLISHED_TRAIN.light, 78_200.0, PUBLISHED_TRAIN.heavy):
            pull = float(PUBLISHED_TRAIN.full_effort(speed)) * lever / mass
            free = dynamics.drift(speed, slope / np.hypot(1.0, slope), mass, PUBLISHED_TRAIN)
            assert abs(pull) <= 9.81 * grip
            # The controller's gradient is that of 50 m of track.
            assert abs(pull + free) <= 1.0 + 9.81 * 0.012
        assert speed <= float(track.speed_limit(position))


def test_on_the_level_without_limits_the_answer_is_the_analytic_one():
    """With constant effort and no resistance the lever falls on a straight line: cubic motion."""
    train = PUBLISHED_TRAIN._replace(k1=0.0, k3=60e3, drag=0.0, rolling=0.0)
    track = level_line(3_000.0, limit=80.0)
    time, way, mass = 180.0, 1_500.0, 78_200.0
    stops = Stop("A", 100.0, 0.0, 0.0), Stop("B", 100.0 + way, time, time)
    found = reference(section_of(track, train, GRIP, *stops), mass)
    expected = mass / 60e3 * 6.0 * way / time**2 * (1.0 - 2.0 * found.times / time)
    np.testing.assert_allclose(found.levers, expected, atol=2e-3)
    assert found.cost == pytest.approx(6.0 * (mass / 60e3 * way) ** 2 / time**3, rel=1e-3)


def test_a_timetable_that_cannot_be_kept_is_explained_before_any_solver(monkeypatch):
    def never(*_: object) -> None:
        raise AssertionError("a solver was asked")

    monkeypatch.setattr(shooting, "_solve", never)
    tight = section(120.0)
    e = refused(InfeasibleError, r"A - B: the timetable allows 120 s, .* needs", reference, tight)
    assert "later or more" in e.remedy


def test_a_train_that_stalls_is_refused_with_the_place():
    icy = StepProfile(np.array([0.0, 650.0, 1_500.0]), np.array([0.3, 0.003, 0.3]))
    said = r"comes to a stand at km 1\.[0-4]\d\d"
    refused(InfeasibleError, said, check_timetable, (section(600.0, icy, slope=0.03),))


def test_the_fastest_run_bounds_every_reference_and_is_slower_with_more_mass():
    planned = section(200.0, slope=0.01)
    assert fastest_unweighed(planned).duration < fastest(planned).duration
    light, heavy = (fastest_unweighed(planned, mass) for mass in (LIGHT, HEAVY))
    assert light.duration < heavy.duration
    assert light.duration < fastest_unweighed(planned, LIGHT, 4_800.0).duration


def test_what_the_lightest_train_may_do_bounds_the_fastest_run():
    """On the level without a limit: comfort of the light train, until it may run a little on."""
    c = PUBLISHED_TRAIN._replace(drag=0.0, rolling=0.0)
    track = level_line(3_000.0, limit=80.0)
    stops = Stop("A", 100.0, 0.0, 0.0), Stop("B", 180.0, 100.0, 100.0)
    found = fastest_unweighed(section_of(track, c, GRIP, *stops), c.heavy)
    # 1 m/s² of the light train is 0.77 of the heavy one, in traction and in braking.
    assert found.duration == pytest.approx(2.0 * np.sqrt(80.0 * c.heavy / c.light), rel=0.03)


def test_what_breaks_a_constraint_between_its_checks_is_solved_with_more_of_them(monkeypatch):
    spot = StepProfile(np.array([0.0, 230.0, 238.0]), np.array([0.3, 0.02, 0.3]))
    asked = section(95.0, spot, slope=0.012, length=1_500.0)
    monkeypatch.setattr(shooting, "CHECKS", (1,))
    refused(InfeasibleError, "rollout of the solution breaks a constraint", reference, asked)
    monkeypatch.setattr(shooting, "CHECKS", (1, 4))
    assert reference(asked).worst.max() <= 0.0


LIGHT, HEAVY = PUBLISHED_TRAIN.light, PUBLISHED_TRAIN.heavy


@pytest.fixture(scope="module")
def plan() -> Reference:
    limits = steps((0.0, 70.0 / 3.6), (1_000.0, 55.0 / 3.6))
    slopes = steps((0.0, 0.0), (500.0, 0.01), (900.0, 0.0))
    track = level_line(2_600.0, speed_limits=limits, gradients=slopes)
    rail = steps((0.0, 0.3), (150.0, 0.08), (250.0, 0.3))
    stops = Stop("A", 100.0, 0.0, 0.0), Stop("B", 2_000.0, 180.0, 180.0)
    return reference(section_of(track, PUBLISHED_TRAIN, rail, *stops))


def driven(plan: Reference, controller: Controller, mass: float, delay: float = 0.0) -> np.ndarray:
    """Rows of time, position, speed, lever ten times a second of the model of eq. (3)."""
    section = plan.section
    p, v, now = section.origin.position, 0.0, delay
    rows = []
    while now < plan.duration + delay + 60.0:
        lever = controller.lever(now, p, v)
        if v < 0.5 and lever <= 0.0:  # the holding brake
            v = max(v - PERIOD * HOLDING, 0.0)
        rows.append((now, p, v, lever))
        p, v, _ = model.roll(p, v, lever, lever, PERIOD, 1, mass, section.tables, section.train)[-1]
        now += PERIOD
        if v == 0.0 and p > section.destination.position - 0.5:
            break
    assert controller.unsolved == 0
    return np.array(rows)


def worst(plan: Reference, rows: np.ndarray) -> np.ndarray:
    """Largest comfort, traction, speed and lever constraint, without any reserve."""
    section, t = plan.section, plan.section.tables
    _, p, v, u = rows[rows[:, 2] > 0.0].T
    grip, limit = section.maximum_adhesion(p), section.line.speed_limit(p)
    return model.constraints(v, u, t.at(t.sine, p), grip, limit, section.train).max(axis=0)


def test_the_sampled_system_is_the_exponential_of_the_slopes_of_the_motion(plan):
    t, c = plan.section.tables, plan.section.train
    p, v, u, h = 640.0, 12.0, 0.3, 1e-4

    def rate(position: float, speed: float, lever: float) -> float:
        sine = float(t.at(t.sine, position))
        return float(model.acceleration(speed, lever, sine, NOMINAL_MASS, c))

    system = np.zeros((3, 3))
    system[0, 1] = 1.0
    for column, step in enumerate(np.diag([h, h, h])):
        low, high = ([p, v, u] + sign * step for sign in (-1.0, 1.0))
        system[1, column] = (rate(*high) - rate(*low)) / (2.0 * h)
    a, b = sampled_system(*(np.array([each]) for each in (p, v, u)), t, c)
    exact = expm(SAMPLING * system)
    np.testing.assert_allclose(a[0], exact[:2, :2], atol=1e-8)
    np.testing.assert_allclose(b[0], exact[:2, 2], atol=1e-8)


@pytest.mark.parametrize("gain", [0.8, 1.0, 1.2])
def test_terminal_cost_is_that_of_the_stationary_regulator(gain):
    a, b = np.array([[1.0, 0.9], [-0.02, 0.95]]), gain * np.array([0.5, 1.0])
    expected = solve_discrete_are(a, b[:, None], np.diag([2.0, 0.0]), np.array([[0.1]]))
    np.testing.assert_allclose(terminal_weight(a, b, 2.0, 0.1), expected, rtol=1e-6)


@settings(max_examples=12)
@given(seed=st.integers(0, 1000))
def test_the_solver_finds_what_another_solver_finds(plan, seed):
    """Clarabel on the same program, with rules that may be broken at the same price a row.

    DAQP counts what a row is broken by over the row's norm, so that the two may differ by what
    the softness allows.
    """
    rng = np.random.default_rng(seed)
    now = float(rng.integers(2, 150))
    p, v, _ = plan.at(now)
    program = PublishedController(plan).program(
        now, p + rng.normal() * 5.0, max(v + rng.normal() * 0.5, 0.0)
    )
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


@pytest.mark.parametrize(("delay", "mass"), [(0.0, HEAVY), (70.0, LIGHT)])
def test_the_products_controller_keeps_every_constraint_on_time_and_late(plan, mass, delay):
    rows = driven(plan, MapController(plan), mass, delay)
    assert worst(plan, rows).max() <= 1e-6
    assert abs(rows[-1, 1] - 2_000.0) < 0.6
    least = fastest_unweighed(plan.section, mass).duration
    took = rows[-1, 0] - delay
    assert least <= took < max(least, plan.duration - delay) + 6.0


LINE = "DE_Chemnitz_Cranzahl.line.json"


def test_resistance_on_a_gradient_by_hand():
    sine, speed, mass = 0.01, 20.0, 78_200.0
    cosine = np.sqrt(1.0 - sine**2)
    by_hand = 0.5 * 1.2041 * 0.85 * 10.0 * speed**2 + mass * GRAVITY * (sine + 0.002 * cosine)
    assert -mass * dynamics.drift(speed, sine, mass, PUBLISHED_TRAIN) == pytest.approx(by_hand)
    refused(InputError, "cannot weigh 90 t", PUBLISHED_TRAIN.check_mass, 90_000.0)


@settings(max_examples=40)
@given(
    speed=st.floats(0.0, 33.0),
    sine=st.floats(-0.03, 0.03),
    grip=st.floats(0.03, 0.4),
    share=st.floats(0.0, 1.0),
    load=st.floats(0.0, 1.0),
)
def test_levers_within_the_bounds_keep_the_constraints_at_every_mass(
    speed, sine, grip, share, load
):
    low, high = dynamics.lever_bounds(speed, sine, grip, PUBLISHED_TRAIN)
    lever = low + share * (high - low)
    mass = PUBLISHED_TRAIN.light + load * (PUBLISHED_TRAIN.heavy - PUBLISHED_TRAIN.light)
    gained = dynamics.acceleration(speed, lever, sine, mass, PUBLISHED_TRAIN)
    held = float(PUBLISHED_TRAIN.full_effort(speed)) * abs(lever) / mass
    assert abs(gained) <= PUBLISHED_TRAIN.comfort + 1e-9
    assert held <= grip * GRAVITY + 1e-9
    assert abs(lever) <= 1.0


def test_the_reconstructed_line_is_made_again_byte_for_byte():
    script = Path(__file__).parents[1] / "sample_logs" / "make_reconstruction.py"
    made = runpy.run_path(str(script))["reconstruction"]()
    assert line_to_bytes(made) == sample(LINE).read_bytes()


def test_the_reconstructed_line_says_what_it_is_and_keeps_the_published_facts():
    line = read_line(sample(LINE))
    assert line.source.startswith("reconstruction, not the data of Hauck et al. (2023)")
    altitudes = {each.name: float(line.altitudes(each.position)) for each in line.stations}
    assert altitudes["Zschopau"] == pytest.approx(336.0, abs=0.5)
    assert altitudes["Cranzahl"] == pytest.approx(654.0, abs=0.5)
    assert line.speed_limits.values.max() * 3.6 == pytest.approx(100.0)
    assert np.abs(line.gradients.values).max() < 0.018
    assert len(line.stations) == 22

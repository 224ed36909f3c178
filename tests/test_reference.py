"""References by multiple shooting: known answers, constraints, and what no solver is asked."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from refusals import refused
from simulated_line import level_line, steps

from analysis.studies.hauck_2023 import model as dynamics, reference as shooting
from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN
from analysis.studies.hauck_2023.reference import reference
from analysis.studies.hauck_2023.section import (
    Section,
    check_timetable,
    fastest,
    fastest_unweighed,
    section_of,
)
from trainlog.errors import InfeasibleError
from trainlog.railway import Line, Station, StepProfile
from trainlog.simulation.drivers import Stop

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
    with pytest.raises(InfeasibleError, match=r"comes to a stand at km 1\.[0-4]\d\d"):
        check_timetable((section(600.0, icy, slope=0.03),))


def test_the_fastest_run_bounds_every_reference_and_is_slower_with_more_mass():
    planned = section(200.0, slope=0.01)
    assert fastest_unweighed(planned).duration < fastest(planned).duration
    light, heavy = (
        fastest_unweighed(planned, mass) for mass in (PUBLISHED_TRAIN.light, PUBLISHED_TRAIN.heavy)
    )
    assert light.duration < heavy.duration
    assert light.duration < fastest_unweighed(planned, PUBLISHED_TRAIN.light, 4_800.0).duration


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

"""The one motion of a train, against laws that have closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from trainlog.railway import EffortCurve
from trainlog.railway.motion import (
    SUBSTEPS,
    Brakes,
    Motion,
    Traction,
    brake_backwards,
    braking_curve,
    pull_forwards,
)

LENGTH, CELLS = 4_000.0, 800


def motion(drag0: float = 0.0, drag1: float = 0.0, drag2: float = 0.0) -> Motion:
    return Motion(
        np.ones(1),
        np.full((1, CELLS, SUBSTEPS + 1), drag0),
        np.array([drag1]),
        np.full((1, CELLS), drag2),
        np.full(CELLS, LENGTH / CELLS),
    )


POSITIONS = np.linspace(0.0, LENGTH, CELLS + 1)
FREE = np.full((1, CELLS + 1), np.inf)


@settings(max_examples=40)
@given(st.floats(0.1, 2.0), st.floats(0.0, 0.09), st.sampled_from([1, 4]))
def test_constant_effort_gives_constant_acceleration(a, drag, order):
    pull = Traction.of(np.full(CELLS, a), np.array([np.inf]))
    z, stalled = pull_forwards(FREE, 0.0, pull, motion(drag), order, 0.0)
    np.testing.assert_allclose(z[0], (a - drag) * POSITIONS, rtol=1e-9, atol=1e-9)
    assert stalled[0] == -1


def test_constant_power_lets_the_cube_of_the_speed_grow_with_the_distance():
    power, begin = 20.0, 10.0
    pull = Traction.of(np.full(CELLS, np.inf), np.array([power]))
    z, _ = pull_forwards(FREE, 0.5 * begin**2, pull, motion(), 4, 0.0)
    np.testing.assert_allclose(np.sqrt(2.0 * z[0]) ** 3, begin**3 + 3.0 * power * POSITIONS, 1e-6)


def test_an_effort_that_falls_with_the_speed_follows_its_curve():
    """``dv/dt = a (1 - v/w)``: the distance to a speed is ``-w/a (v + w ln(1 - v/w))``."""
    a, w = 0.8, 40.0
    curve = EffortCurve(np.array([0.0, w]), np.array([a, 0.0]))
    pull = Traction.of(np.full(CELLS, np.inf), np.array([np.inf]), curve)
    z, _ = pull_forwards(FREE, 0.0, pull, motion(), 4, 0.0)
    v = np.sqrt(2.0 * z[0, 1:])
    needed = -w / a * (v + w * np.log(1.0 - v / w))
    np.testing.assert_allclose(needed[20:], POSITIONS[21:], rtol=2e-3)
    assert needed[-1] == pytest.approx(LENGTH, rel=1e-4)


def test_steps_of_first_order_converge_to_those_of_fourth():
    pull = Traction.of(np.full(CELLS, 0.9), np.array([15.0]))
    ends = [
        pull_forwards(FREE, 0.0, pull, motion(0.02, 1e-3, 1e-4), order, 0.0)[0][0, -1]
        for order in (1, 4)
    ]
    assert ends[0] == pytest.approx(ends[1], rel=2e-3)
    assert ends[0] != ends[1]


def test_a_train_that_drag_overcomes_stalls_or_crawls():
    pull = Traction.of(np.full(CELLS, 0.1), np.array([np.inf]))
    z, stalled = pull_forwards(FREE, 10.0, pull, motion(0.2), 4, 0.0)
    assert stalled[0] == np.flatnonzero(z[0] == 0.0)[0] - 1 == 19
    z, stalled = pull_forwards(FREE, 10.0, pull, motion(0.2), 4, 0.125)
    assert stalled[0] == -1
    assert z[0, -1] == 0.125


@settings(max_examples=40)
@given(st.floats(0.2, 1.5), st.floats(0.0, 0.1), st.floats(0.0, 0.1))
def test_full_braking_backwards_adds_brake_and_drag(b, drag, pull):
    most = np.full((1, CELLS), b)
    brakes = Brakes(most, most, np.zeros_like(most), 0.0)
    z = brake_backwards(FREE, 0.0, np.full(CELLS, pull), brakes, motion(drag))
    np.testing.assert_allclose(z[0], (b + drag - pull) * (LENGTH - POSITIONS), rtol=1e-9, atol=1e-9)


def test_a_dynamic_brake_is_limited_by_its_power():
    """Power is force times speed, here that of the beginning of each cell."""
    none, power = np.zeros((1, CELLS)), 10.0
    brakes = Brakes(none + 9.0, none, none + 1.0, power)
    z = brake_backwards(FREE, 0.0, np.zeros(CELLS), brakes, motion())
    v = np.sqrt(2.0 * z[0])
    braked = -np.diff(z[0]) / np.diff(POSITIONS)
    np.testing.assert_allclose(braked, np.minimum(1.0, power / v[:-1]), rtol=1e-3)


def test_the_braking_curve_of_one_deceleration_meets_the_limits():
    limits = np.where(POSITIONS < 2_000.0, 30.0, 10.0)
    curve = braking_curve(POSITIONS, limits, 0.5)
    before = POSITIONS < 2_000.0
    expected = np.minimum(30.0, np.sqrt(10.0**2 + 2.0 * 0.5 * (2_000.0 - POSITIONS[before])))
    np.testing.assert_allclose(curve[before], expected)
    np.testing.assert_allclose(curve[~before], 10.0)

"""The one motion of a train, against laws that have closed forms."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from analysis.trajectory.rollout import brake_below
from trainlog.arrays import FloatArray
from trainlog.railway import EffortCurve
from trainlog.railway.motion import (
    SUBSTEPS,
    Brakes,
    Motion,
    Traction,
    advance,
    brake_backwards,
    braking_curve,
    landing,
    pull_forwards,
    traverse,
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


def pulled(pull: float, power: float, drag: float, least: float = 0.0, **given: Any) -> FloatArray:
    """``z`` of full traction from standstill, without a ceiling."""
    cells = given.get("cells", CELLS)
    traction = Traction.of(np.full(cells, pull), np.array([power]), given.get("curve"))
    drag0, none = np.full(cells, drag), np.zeros(cells)
    step = np.full(cells, LENGTH / cells)
    return pull_forwards(np.full(cells + 1, np.inf), traction, drag0, 0.0, none, step, least)


def off_by(law: Callable[[FloatArray], FloatArray], **given: Any) -> list[float]:
    """Largest error of the speed with steps, and with half of them [m/s]."""
    found = []
    for cells in (CELLS, 2 * CELLS):
        exact = law(np.linspace(0.0, LENGTH, cells + 1))
        z = pulled(**given, cells=cells)
        found.append(float(np.abs(np.sqrt(2.0 * z) - exact)[cells // 8 :].max()))
    return found


@settings(max_examples=40)
@given(st.floats(0.1, 2.0), st.floats(0.0, 0.09))
def test_constant_effort_gives_constant_acceleration(a, drag):
    z = pulled(a, np.inf, drag)
    np.testing.assert_allclose(z, (a - drag) * POSITIONS, rtol=1e-9, atol=1e-9)


def test_constant_power_lets_the_cube_of_the_speed_grow_with_the_distance():
    pull, power = 1.0, 10.0
    reached = power / pull
    begin = 0.5 * reached**2 / pull

    def law(s: FloatArray) -> FloatArray:
        by_power = np.cbrt(reached**3 + 3.0 * power * np.maximum(s - begin, 0.0))
        return np.where(s < begin, np.sqrt(2.0 * pull * s), by_power)

    whole, half = off_by(law, pull=pull, power=power, drag=0.0)
    assert whole < 0.05
    assert half == pytest.approx(0.5 * whole, rel=0.05)


def test_an_effort_that_falls_with_the_speed_follows_its_curve():
    """``dv/dt = a (1 - v/w)``: the distance to a speed is ``-w/a (v + w ln(1 - v/w))``."""
    a, w = 0.8, 40.0
    curve = EffortCurve(np.array([0.0, w]), np.array([a, 0.0]))
    speeds = np.linspace(0.0, 0.999 * w, 20_000)
    needed = -w / a * (speeds + w * np.log(1.0 - speeds / w))
    whole, half = off_by(
        lambda s: np.interp(s, needed, speeds), pull=np.inf, power=np.inf, drag=0.0, curve=curve
    )
    assert whole < 0.05
    assert half == pytest.approx(0.5 * whole, rel=0.05)


def test_a_train_that_drag_overcomes_stands_or_crawls():
    assert pulled(0.1, np.inf, 0.2).max() == 0.0
    np.testing.assert_array_equal(pulled(0.1, np.inf, 0.2, 0.125)[1:], 0.125)


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


@settings(max_examples=20)
@given(st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_trains_side_by_side_move_as_each_alone(q, seed):
    """Those too that come to a stand in a cell, or begin with none."""
    same = partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12)
    random, n = np.random.default_rng(seed), 12
    many = Motion(
        random.uniform(0.5, 1.5, q),
        random.uniform(-0.3, 0.6, (q, n, SUBSTEPS + 1)),
        random.uniform(0.0, 0.01, q),
        random.uniform(0.0, 1e-4, (q, n)),
        random.uniform(0.5, 300.0, n),
    )
    z = random.uniform(0.0, 300.0, (q, n + 1)) * random.integers(0, 2, (q, n + 1))
    effort, highest = random.uniform(-0.2, 1.0, (q, n)), random.uniform(20.0, 90.0, (q, n + 1))
    reached, seconds = traverse(z, effort, many)
    limit = random.uniform(0.2, 1.0, (3, q, n))
    curves = brake_backwards(highest, 0.0, effort[0], Brakes(*limit, 20.0), many)
    driven, braking = brake_below(curves, effort, 50.0, many)
    for a in range(q):
        one = Motion(many.gain[[a]], many.drag0[[a]], many.drag1[[a]], many.drag2[[a]], many.step)
        for k in range(n):
            cell = one.drag0[0, k], one.drag1[0], one.drag2[0, k], one.step[k]
            same((reached[a, k], seconds[a, k]), advance(z[a, k], effort[a, k], *cell))
            if braking[a, k] > 0.0:
                met = landing(driven[a, k], driven[a, k + 1], *cell) / one.gain[0]
                same(braking[a, k], effort[a, k] - met)
        brakes = Brakes(*limit[:, [a]], 20.0)
        same(curves[[a]], brake_backwards(highest[[a]], 0.0, effort[0], brakes, one))
        alone = brake_below(curves[[a]], effort[[a]], 50.0, one)
        same(driven[[a]], alone[0])
        same(braking[[a]], alone[1])

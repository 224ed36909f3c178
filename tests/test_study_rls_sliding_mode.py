"""The study of Amirhosseini et al. (2024) reaches what the paper published."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.studies import amirhosseini_2024 as study
from analysis.studies.amirhosseini_2024 import SlidingModeController, Target, trip_of


def test_the_scalar_estimator_reaches_the_published_figures():
    run = study.run(next(each for each in study.VARIANTS if each.name == "scalar"))
    position, speed, stop = run.figures
    assert 0.78 <= position <= 0.84
    assert 0.215 <= speed <= 0.23
    assert stop <= 0.005
    assert trip_of(run, seed=1).provenance[-1]["variant"] == "scalar"


def test_additional_resistance_by_hand_and_by_the_product():
    """Eq. (6): a curve of 400 m weighs as 1.5 per mille, a tunnel of 3 km as 0.39."""
    assert study.additional_resistance(1e3, 0.01) == pytest.approx(98.1)
    assert study.additional_resistance(1e3, 0.0, radius=400.0) == pytest.approx(14.715)
    assert study.additional_resistance(1e3, 0.0, tunnel=3_000.0) == pytest.approx(3.8259)
    way = study.line(curved_tunnel=True).gradients
    assert way(31e3) - study.line().gradients(31e3) == pytest.approx(0.00189)
    assert way(34e3) == study.line().gradients(34e3)


def test_on_the_sliding_surface_the_error_decays_as_designed():
    """With exact knowledge s stays 0, and a position error decays with lambda."""
    controller = SlidingModeController(100e3, switching_effort=0.0)
    position, speed = 10.0, 20.0 - 0.5 * 10.0  # s = 0: the speed error is -lambda times the error
    step = 1e-3
    for k in range(4_000):
        goal = Target(20.0 * k * step, 20.0, 0.0)
        effort = controller.effort(position, speed, goal, resistance=5e3)
        speed += step * (effort - 5e3) / 100e3
        position += step * speed
    assert position - 20.0 * 4.0 == pytest.approx(10.0 * np.exp(-2.0), rel=2e-3)


def test_switching_draws_back_to_the_surface_within_the_effort_limit():
    controller = SlidingModeController(100e3)
    goal = Target(0.0, 0.0, 0.0)
    assert controller.effort(100.0, 10.0, goal, 0.0) == -250e3
    assert controller.effort(-100.0, -10.0, goal, 0.0) == 250e3
    within = controller.effort(2.0, 0.0, goal, 0.0)
    assert within == pytest.approx(-180e3 * 0.5 * 2.0 / 5.0)

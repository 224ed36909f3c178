"""The mass that is learnt under way, and what a driver gains by it."""

from __future__ import annotations

import numpy as np
from hypothesis import given, strategies as st

from analysis.studies.hauck_2023 import controller as tracking_mass, model as dynamics
from analysis.studies.hauck_2023.controller import ObservedMass, window
from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN

LIGHT, HEAVY = PUBLISHED_TRAIN.mass, PUBLISHED_TRAIN.max_mass
CONSTANTS = dynamics.constants(PUBLISHED_TRAIN)
FLAT = dynamics.Tables(0.0, np.zeros(400), np.full(400, 0.3), np.full(400, 900.0))

masses = st.floats(LIGHT, HEAVY)
rotating = st.floats(0.0, tracking_mass.ROTATING)
weights = st.floats(-0.15, 0.2)


@given(mass=masses, share=rotating, motions=st.lists(st.tuples(weights, st.floats(-0.9, 0.9))))
def test_the_true_mass_is_never_excluded(
    mass: float, share: float, motions: list[tuple[float, float]]
) -> None:
    """Efforts that a train of `mass` and its rotating parts need for what it did."""
    found = ObservedMass(LIGHT, HEAVY)
    turning = share * LIGHT
    for weight, acceleration in motions:
        pull = (mass + turning) * acceleration + mass * weight
        found.observe(pull, acceleration, weight)
        assert found.low <= mass + turning <= found.high


def test_a_second_of_traction_halves_what_was_not_known() -> None:
    found = ObservedMass(LIGHT, HEAVY)
    before = found.high - found.low
    assert found.observe(0.8 * 80e3, 0.8, 0.0)
    assert found.low <= 80e3 <= found.high
    assert found.high - found.low < 0.5 * before


def test_coasting_shows_nothing() -> None:
    found = ObservedMass(LIGHT, HEAVY)
    assert not found.observe(-500.0, -0.03, 0.02)
    assert (found.low, found.high) == (LIGHT, HEAVY * (1.0 + tracking_mass.ROTATING))


def test_observations_that_contradict_each_other_open_all_again() -> None:
    found = ObservedMass(LIGHT, HEAVY)
    found.observe(0.8 * 72e3, 0.8, 0.0)
    found.observe(0.8 * 90e3, 0.8, 0.0)
    assert (found.low, found.high) == (LIGHT, HEAVY * (1.0 + tracking_mass.ROTATING))


def test_a_window_gives_the_mass_that_moved() -> None:
    """States of the model itself; a lever that jumps, or a rail that changes, shows nothing."""
    states = dynamics.roll(500.0, 5.0, 0.4, 0.4, 1.0, 10, 80e3, FLAT, CONSTANTS)
    past = [tuple(row) for row in states]
    observed = window(past, 0.1, FLAT, CONSTANTS)
    assert observed is not None
    pull, acceleration, weight = observed
    assert abs(pull / (acceleration + weight) - 80e3) < 50.0
    jumped = [*past[:-1], (*past[-1][:2], 0.6)]
    assert window(jumped, 0.1, FLAT, CONSTANTS) is None
    uneven = np.where(np.arange(400) < 101, 0.3, 0.1)
    assert window(past, 0.1, FLAT._replace(adhesion=uneven), CONSTANTS) is None

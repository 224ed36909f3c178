"""The adhesion characteristic during slip, on curves of another family than the estimator's."""

from __future__ import annotations

import numpy as np
import pytest
from test_adhesion import AXLE_LOAD, FORCE_RATE, ROTATING_MASS, climb

from estimators.adhesion import smoothed_force
from estimators.creep_curve import estimate_creep_curve
from trainlog.arrays import FloatArray


def polach(slip: FloatArray, friction: float, floor: float, decay: float) -> FloatArray:
    """Adhesion by Polach (2005), Wear 258, eqs. (1)-(5): friction falls with the slip speed."""
    falling = friction * ((1.0 - floor) * np.exp(-decay * slip) + floor)
    strain = 1.0 * slip / falling
    return 2.0 * falling / np.pi * (strain / (1.0 + strain**2) + np.arctan(0.4 * strain))


@pytest.mark.parametrize("friction", [0.2, 0.25, 0.3])
@pytest.mark.parametrize(("floor", "decay"), [(0.4, 0.2), (0.4, 0.6), (0.6, 0.3)])
def test_the_maximum_of_polachs_curves_is_found(
    friction: float, floor: float, decay: float
) -> None:
    slip = np.linspace(0.0, 6.0, 300)
    curve = polach(slip, friction, floor, decay)
    time = np.arange(0.0, 14.0, 0.1)
    wheel, _, effort = climb(slip, curve, time)
    rng = np.random.default_rng(3)
    wheel = wheel + 0.02 * rng.standard_normal(wheel.shape)
    force = smoothed_force(time, wheel, effort, ROTATING_MASS, 0.02, FORCE_RATE)
    slip_speed = wheel[:, 0] - 10.0
    peak = int(np.argmax(slip_speed))
    part = slice(max(peak - 20, 0), peak + 5)
    found = estimate_creep_curve(
        time[part], slip_speed[part], force.force[part, 0] / AXLE_LOAD, 0.005, 0.04
    )
    middle = int(np.argmin(np.abs(slip_speed[part] - slip[np.argmax(curve)])))
    error = found.maximum[middle] - curve.max()
    assert abs(error) < 0.12 * curve.max()
    assert abs(error) < 3.0 * found.maximum_std[middle]
    top = int(np.argmax(slip_speed[part]))
    slope = float(np.interp(slip_speed[part][top], slip, np.gradient(curve, slip)))
    assert abs(found.slope[top] - slope) < 3.0 * found.slope_std[top]


def test_a_rail_on_which_less_slip_was_seen_is_less_well_known() -> None:
    time = 0.1 * np.arange(30)
    slip = np.linspace(0.1, 4.0, 30)
    used = 0.2 * np.sin(1.4 * np.arctan(np.tan(np.pi / 2.8) / 1.5 * slip))
    whole = estimate_creep_curve(time, slip, used, 0.005, 0.05)
    rising = estimate_creep_curve(time[:8], slip[:8], used[:8], 0.005, 0.05)
    assert rising.maximum_std[-1] > 1.5 * whole.maximum_std.min()
    assert abs(rising.maximum[-1] - 0.2) < 3.0 * rising.maximum_std[-1]
    assert rising.slope[-1] > 0.0 > whole.slope[-1]

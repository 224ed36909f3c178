"""Lines, trains, resistance and creep curves as data and pure functions."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, strategies as st
from refusals import refused
from simulated_line import level_line, steps

from trainlog.errors import InputError
from trainlog.railway import (
    Configuration,
    CreepCurve,
    CurvatureProfile,
    RunningResistance,
    Station,
    StepProfile,
    Train,
    Tunnel,
)

LINE = level_line(
    1000.0,
    name="test",
    speed_limits=steps((0.0, 20.0), (400.0, 30.0)),
    gradients=steps((0.0, 0.01), (250.0, -0.02), (500.0, 0.0)),
    curvatures=CurvatureProfile(
        np.array([0.0, 100.0, 200.0]), np.array([0.0, 0.0, 0.002]), np.array([0.0, 0.002, 0.002])
    ),
    tunnels=(Tunnel(300.0, 200.0, 40.0),),
    altitude=500.0,
)

TRAIN = Train(
    name="test",
    mass=100_000.0,
    rotating_mass_factor=0.1,
    resistance=RunningResistance(2000.0, 50.0, 10.0),
    max_tractive_effort=200e3,
    max_traction_power=2e6,
    tunnel_resistance=((24.0, 15.0), (40.0, 7.0)),
)


def test_the_axles_of_a_train_are_not_shown_as_its_length():
    rows = dict(line.split(maxsplit=1) for line in str(TRAIN).splitlines()[1:])
    assert rows["axles"] == "4 powered axles"
    assert "length" not in rows


def test_profiles_take_lists_and_refuse_what_is_no_number():
    made = StepProfile([0.0, 400.0], [20.0, 30.0])
    assert made == LINE.speed_limits
    refused(InputError, "values must be numbers", StepProfile, [0.0], ["fast"])


@pytest.mark.parametrize(
    ("quantity", "at", "expected"),
    [
        # A step holds from its position to the next.
        (LINE.speed_limit, [0.0, 399.9, 400.0, 999.0], [20, 20, 30, 30]),
        (LINE.altitudes, [0.0, 250.0, 400.0, 1000.0], [500, 502.5, 499.5, 497.5]),
        # Linear in transitions and constant in arcs.
        (LINE.curvature, [50.0, 150.0, 600.0], [0.0, 0.001, 0.002]),
        (LINE.track_acceleration, [10.0, 600.0], [0.0981 / np.hypot(1.0, 0.01), 9.81 * 0.0012]),
        (TRAIN.tunnel_coefficient, [24.0, 30.0, 40.0, 0.0], [15.0, 11.0, 7.0, 0.0]),
        (TRAIN.tractive_effort_limit, [0.0, 5.0, 20.0], [200e3, 200e3, 100e3]),
    ],
)
def test_quantities_are_those_that_a_hand_calculation_gives(quantity, at, expected):
    np.testing.assert_allclose(quantity(at), expected)


@given(st.floats(0.001, 999.9))
def test_the_reversed_line_is_the_same_line(position):
    other = LINE.reversed()
    if np.min(np.abs(LINE.breakpoints - position)) < 1e-6:
        return
    there = LINE.length - position
    assert other.speed_limit(there) == LINE.speed_limit(position)
    assert other.gradient(there) == -LINE.gradient(position)
    assert other.curvature(there) == pytest.approx(-LINE.curvature(position), abs=1e-15)
    assert other.tunnel_cross_section(there) == LINE.tunnel_cross_section(position)
    assert other.altitudes(there) == pytest.approx(LINE.altitudes(position))


def test_nonsensical_lines_and_trains_are_refused_with_the_place():
    line = partial(level_line, 1000.0)
    for words, changes in (
        (
            r"speed limit at km 0\.400 is not positive",
            {"speed_limits": ((0.0, 20.0), (400.0, 0.0))},
        ),
        ("steeper than 200 per mille", {"gradients": ((0.0, 11.9),)}),
        ("beyond the line's end", {"speed_limits": ((0.0, 20.0), (1500.0, 30.0))}),
    ):
        refused(InputError, words, line, **{name: steps(*rows) for name, rows in changes.items()})
    # Just the steepest gradient stays one where its mean over a distance is rounded up.
    line(gradients=steps((0.0, 0.06), (66.3, -0.2)))
    refused(InputError, "not in the order", line, stations=(Station("B", 900.0), Station("A", 0.0)))
    refused(InputError, "leaves the line", line, tunnels=(Tunnel(900.0, 200.0, 40.0),))
    for length, section in ((-200.0, 40.0), (0.0, 40.0), (200.0, 0.0), (200.0, np.nan)):
        refused(InputError, "is not positive and finite", Tunnel, 300.0, length, section)
    said = r"values\[2\]: position 5 m follows 10 m; positions must increase"
    refused(InputError, said, StepProfile, np.array([0.0, 10.0, 5.0]), np.zeros(3))
    refused(InputError, "finite", StepProfile, np.array([0.0]), np.array([np.nan]))
    # Curves that do not rise from zero, and resistance that is negative at some speed.
    for curve in ((1.2, 0.54, 1.0, 1.0), (0.5, 1.2, 1.0, 0.9), (-0.1, 1.0, 1.0, 1.0)):
        refused(InputError, "creep curve", CreepCurve, *curve)
    negative = RunningResistance(1000.0, -200.0, 0.1)
    said = "running resistance is negative at"
    refused(InputError, said, Configuration, "c", 1e5, 1e4, negative, 1e6)

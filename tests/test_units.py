"""Units are converted once, exactly, and wrong ones are refused."""

import re

import pytest
from hypothesis import given, strategies as st
from refusals import refused

from trainlog.errors import InputError
from trainlog.units import (
    _FACTORS,
    _KEPT_IN,
    _NAMED,
    _OFFSETS,
    DISTANCE,
    FORCE,
    KILOMETRE,
    MASS,
    PERCENT,
    SHARE,
    SPEED,
    TIME,
    _registry,
    _spelled,
    clock,
    factor,
    si_unit,
    to_si,
)


@pytest.mark.parametrize(
    ("value", "unit", "si", "expected"),
    [
        (36.0, "km/h", "m/s", 10.0),
        (11.9, "permil", "1", 0.0119),
        (11.9, "‰", "1", 0.0119),
        (10.0, "%", "1", 0.1),
        (0.5, "-", "1", 0.5),
        (200.0, "kN", "N", 200_000.0),
        (0.00093264, "kN/(km/h)^2", "N/(m/s)^2", 0.93264 * 3.6**2),
        (0.01698165, "kN/(km/h)", "N/(m/s)", 16.98165 * 3.6),
        (20.0, "degC", "K", 293.15),
        (68.0, "t", "kg", 68_000.0),
        (2600.0, "kW", "W", 2.6e6),
        (1.1, "m/s²", "m/s^2", 1.1),
    ],
)
def test_known_conversions(value, unit, si, expected):
    assert to_si(value, unit, si) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("unit", ["kg", "furlong per", "", "km", "m/s/", "[m]"])
def test_wrong_units_are_refused_with_the_unit_named(unit):
    said = rf"'{re.escape(unit)}' cannot be read as m/s; declare a unit"
    refused(InputError, said, to_si, 1.0, unit, "m/s")


@pytest.mark.parametrize(
    ("unit", "meant"), [("kmh", "km/h"), ("m/s2", "m/s^2"), ("promille", "permil")]
)
def test_a_misspelt_unit_is_answered_with_the_common_spelling(unit, meant):
    refused(InputError, f"did you mean '{re.escape(meant)}'", si_unit, unit)
    kind = si_unit(meant)
    refused(InputError, f"did you mean '{re.escape(meant)}'", factor, unit, kind)
    with pytest.raises(
        InputError, match=f"declare a unit of that kind, for example '{re.escape(kind)}'"
    ):
        factor("kg", kind)


def test_units_that_need_no_registry_are_converted_as_all_others():
    """Those of files of one's own, and of the profiles that come along."""
    registry = _registry()
    for unit, si in _FACTORS:
        source, target = (registry.parse_units(_spelled(each)) for each in (unit, si))
        known = float(registry.Quantity(1.0, source).to(target).magnitude)
        assert factor(unit, si) == (known, 0.0), unit
    for unit, si in _KEPT_IN.items():
        given = registry.Quantity(1.0, registry.parse_units(_spelled(unit)))
        kinds = (registry.parse_units(_spelled(each)) for each in _NAMED)
        assert _NAMED[[given.is_compatible_with(each) for each in kinds].index(True)] == si
    for (unit, si), offset in _OFFSETS.items():
        source, target = (registry.parse_units(_spelled(each)) for each in (unit, si))
        shown = [registry.Quantity(each, source).to(target).magnitude for each in (0.0, 1.0)]
        assert shown == [offset, offset + 1.0]


@pytest.mark.parametrize(
    ("measure", "written", "value"),
    [
        (PERCENT, "7%", 0.07),
        (PERCENT, "7", 0.07),
        (SHARE, "7 %", 0.07),
        (TIME, "17:30", 1_050.0),
        (TIME, "1:06:40 h", 4_000.0),
        (TIME, "0.5h", 1_800.0),
        (TIME, "0", 0.0),
        (SPEED, "80km/h", 80 / 3.6),
        (SPEED, "80 kmh", 80 / 3.6),
        (SPEED, "22m/s", 22.0),
        (MASS, "12t", 12_000.0),
        (MASS, "12000", 12_000.0),
        (KILOMETRE, "10 km", 10.0),
        (KILOMETRE, "-0.5", -0.5),
        (KILOMETRE, "500m", 0.5),
        (FORCE, "2kN", 2_000.0),
    ],
)
def test_values_are_read_as_people_write_them(measure, written, value):
    assert measure.read(written) == pytest.approx(value, rel=1e-15)
    assert measure.read(f" {written} ", "--name") == measure.read(measure.read(written))


@pytest.mark.parametrize(
    "written",
    ["", "soon", "nan", "inf", "1,5", "12 apples", "1:75", "3:2:1:0", "--5", "7%%", "1 2"],
)
@pytest.mark.parametrize("measure", [TIME, SPEED, SHARE, MASS, DISTANCE])
def test_what_is_no_value_is_answered_with_how_it_is_written(measure, written):
    caught = refused(InputError, "", measure.read, written, "--name")
    assert str(caught).startswith(f"--name '{written}' is not a valid {measure.noun}; write")
    assert ("decimals after a point" in str(caught)) == (written == "1,5")


@pytest.mark.parametrize(
    ("measure", "written", "words"),
    [
        (TIME.between(0.0), "-5", "must be at least 0 s"),
        (SPEED.above(0.0, 100.0), "0", "must be above 0 km/h and at most 360 km/h"),
        (PERCENT.between(0.01, 0.99), "100%", "must be between 1 % and 99 %"),
    ],
)
def test_bounds_are_stated_in_the_usual_unit(measure, written, words):
    refused(InputError, words, measure.read, written)


@given(
    st.integers(0, 9),
    st.integers(0, 59),
    st.integers(0, 59),
    st.sampled_from(
        ["{h} h {m} min {s} s", "{h}h{m}min{s}s", "{h}h {m}min {s}s", "{h}:{m:02}:{s:02}"]
    ),
)
def test_a_time_is_read_in_hours_minutes_and_seconds(h, m, s, form):
    assert TIME.read(form.format(h=h, m=m, s=s), "t") == 3600.0 * h + 60.0 * m + s
    assert TIME.read(f"{m} min {s} s", "t") == 60.0 * m + s
    assert TIME.read(clock(60.0 * m + s), "t") == 60.0 * m + s

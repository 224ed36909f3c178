"""Units are converted once, exactly, and wrong ones are refused."""

import re

import pytest

from trainlog.errors import InputError
from trainlog.units import _FACTORS, _registry, _spelled, factor, si_unit, to_si


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
def test_known_conversions(value: float, unit: str, si: str, expected: float) -> None:
    assert to_si(value, unit, si) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("unit", ["kg", "furlong per", "", "km", "m/s/", "[m]"])
def test_wrong_units_are_refused_with_the_unit_named(unit: str) -> None:
    with pytest.raises(InputError, match="cannot be read as m/s") as caught:
        to_si(1.0, unit, "m/s")
    assert f"'{unit}'" in str(caught.value)
    assert "declare a unit" in str(caught.value)


@pytest.mark.parametrize(
    ("unit", "meant"), [("kmh", "km/h"), ("m/s2", "m/s^2"), ("promille", "permil")]
)
def test_a_misspelt_unit_is_answered_with_the_common_spelling(unit: str, meant: str) -> None:
    with pytest.raises(InputError, match=f"did you mean '{re.escape(meant)}'"):
        si_unit(unit)
    kind = si_unit(meant)
    with pytest.raises(InputError, match=f"did you mean '{re.escape(meant)}'"):
        factor(unit, kind)
    with pytest.raises(
        InputError, match=f"declare a unit of that kind, for example '{re.escape(kind)}'"
    ):
        factor("kg", kind)


@pytest.mark.parametrize(("unit", "si"), _FACTORS)
def test_units_of_own_files_are_converted_as_all_others(unit: str, si: str) -> None:
    registry = _registry()
    source, target = (registry.parse_units(_spelled(each)) for each in (unit, si))
    assert factor(unit, si) == (float(registry.Quantity(1.0, source).to(target).magnitude), 0.0)

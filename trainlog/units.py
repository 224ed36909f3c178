"""Conversion to SI, done once, where data enter or leave.

Files declare the unit of every quantity. `to_si` converts numbers with such a declared unit and
refuses units of the wrong dimension. Inside trainlog everything is SI; `KMH` and `PER_MILLE` are
for showing results in the units railway people use.
"""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.errors import InputError

if TYPE_CHECKING:
    from pint import UnitRegistry

KMH = 3.6
"""Kilometres per hour in one metre per second."""

PER_MILLE = 1e3
"""Per mille in one (rise over run)."""

NANOSECONDS = 1_000_000_000
"""In a second: times of logs are whole nanoseconds since 1970 UTC."""

DAY = 86_400 * NANOSECONDS
"""Nanoseconds of a day."""

JOULES_PER_KWH = 3.6e6
"""Joules in one kilowatt hour."""

EARTH_RADIUS = 6_371_008.8
"""Mean radius of the earth [m]."""

GRAVITY = 9.81
"""Acceleration of gravity [m/s²], as in TTOBench and in all the studies but one."""


def clock(seconds: float) -> str:
    """A duration [s] as timetables show it: minutes and seconds, hours where there are any.

    Examples
    --------
    >>> clock(754.0), clock(4000.0)
    ('12:34 min', '1:06:40 h')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d} h" if hours else f"{minutes}:{rest:02d} min"


@cache
def _registry() -> UnitRegistry[Any]:
    import pint

    registry: UnitRegistry[Any] = pint.UnitRegistry()
    for name in ("permil", "per_mille"):
        registry.define(f"{name} = 1e-3")
    return registry


_FACTORS = {
    (unit, unit): 1.0 for unit in ("%", "1", "A", "deg", "m", "m/s", "m/s^2", "m^2", "s", "kg", "N")
} | {
    ("%", "1"): 0.01,
    ("bar", "Pa"): 100000.0,
    ("km", "m"): 1000.0,
    ("km/h", "m/s"): 0.2777777777777778,
    ("kN", "N"): 1000.0,
    ("kV", "V"): 1000.0,
    ("kN/(km/h)", "N/(m/s)"): 3600.0,
    ("kN/(km/h)^2", "N/(m/s)^2"): 12960.0,
    ("kW", "W"): 1000.0,
    ("permil", "1"): 0.001,
    ("t", "kg"): 1000.0,
}
"""Multipliers of the units in trainlog's own files: reading these must not wait for all others."""


@cache
def factor(unit: str, si: str) -> tuple[float, float]:
    """Multiplier and offset that turn a number in `unit` into the SI unit `si`.

    Raises
    ------
    InputError
        If `unit` is unknown or has another dimension than `si`.

    Examples
    --------
    >>> factor("kN", "N")
    (1000.0, 0.0)
    >>> factor("kmh", "m/s")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: unit 'kmh' cannot be read as m/s; declare a unit...'km/h'?
    >>> factor("kg", "m/s")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: unit 'kg' cannot be read as m/s; declare a unit...
    """
    if (unit, si) in _FACTORS:
        return _FACTORS[unit, si], 0.0
    registry = _registry()
    try:
        source = registry.parse_units(_spelled(unit))
        target = registry.parse_units(_spelled(si))
        quantity = registry.Quantity
        offset = float(quantity(0.0, source).to(target).magnitude)
        slope = float(quantity(1.0, source).to(target).magnitude) - offset
    except Exception as error:  # pint's parser raises whatever its tokens lead it to
        raise InputError(
            f"unit '{unit}' cannot be read as {'a pure number' if si == '1' else si}",
            remedy="declare a unit of that kind"
            + (_meant(unit, si, ": ") or f", for example '{si}'"),
        ) from error
    return slope, offset


_NAMED = (
    "1", "m", "s", "kg", "m/s", "m/s^2", "N", "Pa", "W", "J", "V", "A", "K", "Hz", "rad", "rad/s",
    "m^2", "m^3", "m^3/s", "kg/s", "N*m", "ohm", "C", "F", "T", "lx", "1/m",
)  # fmt: skip
"""SI units by the names under which they are kept."""


@cache
def si_unit(unit: str) -> str:
    """The SI unit in which numbers of any unit are kept.

    Raises
    ------
    InputError
        If the unit is unknown.

    Examples
    --------
    >>> si_unit("kV"), si_unit("bar"), si_unit("degC"), si_unit("%"), si_unit("l/h")
    ('V', 'Pa', 'K', '1', 'm^3/s')
    >>> si_unit("1/km"), si_unit("kohm"), si_unit("mm^2/s")
    ('1/m', 'ohm', 'm^2/s')
    """
    registry = _registry()
    try:
        given = registry.Quantity(1.0, registry.parse_units(_spelled(unit)))
        for name in _NAMED:
            if given.is_compatible_with(registry.parse_units(_spelled(name))):
                return name
        return f"{given.to_base_units().units:~C}".replace("**", "^")
    except Exception as error:  # pint's parser raises whatever its tokens lead it to
        raise InputError(
            f"unit '{unit}' is not known",
            remedy=_meant(unit) or "write it as 'kV', 'bar', 'degC' or '%'",
        ) from error


_COMMON = (
    "km/h", "m/s", "m/s^2", "m", "km", "mm", "s", "ms", "kg", "t", "N", "kN", "W", "kW", "MW", "J",
    "kWh", "V", "kV", "A", "Pa", "kPa", "bar", "degC", "K", "%", "permil", "Hz", "rad", "rad/s",
    "rpm",
)  # fmt: skip
"""Spellings that recorders' units mostly have."""


def _meant(unit: str, si: str | None = None, before: str = "") -> str:
    """The question whether a common spelling was meant, of the kind of `si`; empty if none is."""
    registry = _registry()
    of_kind = [
        each
        for each in _COMMON
        if si is None
        or registry.parse_units(_spelled(each)).is_compatible_with(
            registry.parse_units(_spelled(si))
        )
    ]
    lowered = {each.casefold(): each for each in reversed(of_kind)}
    close = get_close_matches(unit.strip().casefold(), list(lowered), n=1, cutoff=0.7)
    return f"{before}did you mean '{lowered[close[0]]}'?" if close else ""


def to_si(value: ArrayLike, unit: str, si: str) -> FloatArray:
    """Convert `value`, declared in `unit`, to the SI unit `si`.

    Conversions that are a division by an integer (km/h, per mille) are done as one, so that a
    file's 110 km/h reads and writes as 110 km/h.

    Examples
    --------
    >>> to_si([36.0, 110.0], "km/h", "m/s").round(3)
    array([10.   , 30.556])
    """
    slope, offset = factor(unit, si)
    numbers = np.asarray(value, dtype=np.float64)
    inverse = 1.0 / slope if slope else np.inf
    if slope < 1.0 and abs(inverse - round(inverse, 9)) <= 1e-12 * inverse:
        converted = numbers / round(inverse, 9)
    else:
        converted = numbers * slope
    return np.asarray(converted + offset if offset else converted, dtype=np.float64)


def _spelled(unit: str) -> str:
    """The unit in pint's spelling: '-' and '1' are pure numbers, '%' and '‰' have names."""
    cleaned = unit.strip().replace("²", "^2").replace("³", "^3").replace("·", "*")
    named = {"-": "", "1": "", "%": "percent", "‰": "permil", "permille": "permil", "t": "tonne"}
    return named.get(cleaned, cleaned)

"""Conversion to SI, done once, where data enter or leave.

Files declare the unit of every quantity. `to_si` converts numbers with such a declared unit and
refuses units of the wrong dimension. Inside trainlog everything is SI; `KMH` and `PER_MILLE` are
for showing results in the units railway people use. A `Measure` reads values as people write them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.errors import InputError, similar

if TYPE_CHECKING:
    from pint import UnitRegistry

KMH = 3.6
"""Kilometres per hour in one metre per second."""

PER_MILLE = 1e3
"""Per mille in one (rise over run)."""

NANOSECONDS = 1_000_000_000
"""In a second: times of logs are whole nanoseconds since 1970 UTC."""

MINUTE, DAY = 60 * NANOSECONDS, 86_400 * NANOSECONDS
"""Nanoseconds of a minute, of a day."""

JOULES_PER_KWH = 3.6e6
"""Joules in one kilowatt hour."""

EARTH_RADIUS = 6_371_008.8
"""Mean radius of the earth [m]."""

GRAVITY = 9.81
"""Acceleration of gravity [m/s²], as in TTOBench and in all the studies but one."""


def clock(seconds: float) -> str:
    """A duration [s] as timetables show it: minutes and seconds, hours and days if there are any.

    Examples
    --------
    >>> clock(754.0), clock(4000.0), clock(100_000.0)
    ('12:34 min', '1:06:40 h', '1 d 3:46:40 h')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if not hours:
        return f"{minutes}:{rest:02d} min"
    days, hours = divmod(hours, 24)
    return f"{days:,} d " * (days > 0) + f"{hours}:{minutes:02d}:{rest:02d} h"


def lasted(seconds: float) -> str:
    """How long a recording is [s]: as `clock`, below a minute to a tenth of a second.

    Examples
    --------
    >>> lasted(42.31), lasted(754.0)
    ('42.3 s', '12:34 min')
    """
    return f"{seconds:.1f} s" if seconds < 60.0 else clock(seconds)


@cache
def _registry() -> UnitRegistry[Any]:
    import pint

    registry: UnitRegistry[Any] = pint.UnitRegistry()
    for name in ("permil", "per_mille"):
        registry.define(f"{name} = 1e-3")
    return registry


_FACTORS = {
    (unit, unit): 1.0
    for unit in (
        *("%", "1", "A", "deg", "m", "m/s", "m/s^2", "m^2", "s", "kg", "N", "W", "Pa", "K"),
        *("N/(m/s)", "N/(m/s)^2"),
    )
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
    ("km", "km"): 1.0,
    ("h", "h"): 1.0,
    ("m", "km"): 0.001,
    ("ms", "s"): 0.001,
    ("min", "s"): 60.0,
    ("h", "s"): 3600.0,
    ("mm", "m"): 0.001,
    ("mm/s", "m/s"): 0.001,
    ("deg/s", "rad/s"): 0.017453292519943295,
    ("rad", "deg"): 57.29577951308232,
    ("rad", "1"): 1.0,
    ("standard_gravity", "m/s^2"): 9.80665,
    ("kWh", "J"): 3600000.0,
}
"""Multipliers of the units in trainlog's own files: reading these must not wait for all others."""

_OFFSETS = {("degC", "K"): 273.15}
"""Offsets of such units."""

_KEPT_IN = {"rad": "1", "km": "m", "km/h": "m/s", "kW": "W", "kWh": "J"} | {
    unit: unit for unit in ("1", "m/s", "W", "Pa")
}
"""SI units in which such units are kept."""


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
    if (unit, si) in _OFFSETS:
        return 1.0, _OFFSETS[unit, si]
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
    if unit in _KEPT_IN:
        return _KEPT_IN[unit]
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
    close = similar(unit, reversed(of_kind), 1)
    return f"{before}did you mean '{close[0]}'?" if close else ""


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


_NUMBER = re.compile(
    r"(?P<number>[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>[%‰]|[^\W\d_][\w/^²³*·]*)?"
)
_CLOCK = re.compile(r"(?:(?P<h>\d+):(?=\d+:))?(?P<min>\d+):(?P<s>[0-5]\d(?:\.\d+)?)(?: (?:min|h))?")
"""As `clock` writes durations."""

_SPOKEN = re.compile(r"(?:(?P<h>\d+) ?h ?)?(?:(?P<min>\d+) ?min ?)?(?:(?P<s>\d+(?:\.\d+)?) ?s)?")
"""Durations in several units: ``17 min 30 s``."""


@dataclass(frozen=True, slots=True)
class Measure:
    """A kind of value that people give: how it is read, and what it may be.

    Attributes
    ----------
    noun : str
        For messages: ``"speed"``.
    unit : str
        Of what is returned.
    usual : str
        Unit of a number that is given without one; empty: a unit is required.
    examples : str
        How it is written.
    low, high : float
        Least and largest value [`unit`].
    open : bool
        Whether the least value itself is excluded.
    whole : bool
        Whether it is a whole number.

    Examples
    --------
    >>> SPEED.read("80km/h") == SPEED.read("80"), MASS.read("12 t"), TIME.read("17:30")
    (True, 12000.0, 1050.0)
    >>> SHARE.read("7%"), SHARE.read("0.07"), PERCENT.read("7"), DISTANCE.read("10 km")
    (0.07, 0.07, 0.07, 10000.0)
    >>> SPEED.read("12 t", "--speed")
    Traceback (most recent call last):
    trainlog.errors.InputError: --speed '12 t' is not a valid speed; write it as 80, 80km/h or 22m/s
    >>> PERCENT.between(0.0, 1.0).read("-5", "--reserve")
    Traceback (most recent call last):
    trainlog.errors.InputError: --reserve '-5' must be between 0 % and 100 %; write it as 7 or 7%
    """

    noun: str
    unit: str
    usual: str
    examples: str
    low: float = -math.inf
    high: float = math.inf
    open: bool = False
    whole: bool = False

    def between(self, low: float, high: float = math.inf) -> Measure:
        """The same kind of value, from `low` to `high` [`unit`]."""
        return replace(self, low=low, high=high)

    def above(self, low: float, high: float = math.inf) -> Measure:
        """The same kind of value, above `low` and up to `high` [`unit`]."""
        return replace(self, low=low, high=high, open=True)

    def read(self, given: str | float, name: str = "") -> float:
        """The value [`unit`] of a text; a number at hand is in that unit already.

        Parameters
        ----------
        given : str or float
        name : str
            What it is the value of, for messages: ``"--speed"``.

        Raises
        ------
        InputError
            If it is not such a value, or not within the bounds.
        """
        named = f"{name} '{given}'".lstrip()
        value = given if isinstance(given, int | float) else self._parsed(given.strip())
        if value is None or not math.isfinite(value) or (self.whole and value % 1.0):
            comma = isinstance(given, str) and re.search(r"\d,\d", given)
            raise InputError(
                f"{named} is not a valid {self.noun}",
                remedy=f"write it as {self.examples}" + ", decimals after a point" * bool(comma),
            )
        if not (self.low < value if self.open else self.low <= value) or value > self.high:
            raise InputError(
                f"{named} must be {self._bounds}", remedy=f"write it as {self.examples}"
            )
        return float(value)

    def _parsed(self, text: str) -> float | None:
        text = text.replace("\N{MINUS SIGN}", "-")
        time = None
        if self.unit == "s" and text:
            time = _CLOCK.fullmatch(text) or _SPOKEN.fullmatch(text)
        if time is not None:
            hours, minutes, seconds = (time[name] or 0 for name in ("h", "min", "s"))
            return 3600.0 * float(hours) + 60.0 * float(minutes) + float(seconds)
        found = _NUMBER.fullmatch(text)
        if found is None or not (found["unit"] or self.usual):
            return None
        try:
            unit = _WRITTEN.get((found["unit"] or "").lower(), found["unit"] or self.usual)
            if unit not in _GIVEN:  # of which "hh" would be hectohours
                return None
            return float(to_si(float(found["number"]), unit, self.unit))
        except InputError:
            return None

    def shown(self, value: float) -> str:
        """A value [`unit`] in the usual unit.

        Examples
        --------
        >>> SPEED.shown(25.0), SHARE.shown(0.05)
        ('90 km/h', '0.05')
        """
        slope, offset = factor(self.usual, self.unit)
        unit = "" if self.usual == "1" else f" {self.usual}"
        return f"{(value - offset) / slope:.6g}{unit}"

    @property
    def _bounds(self) -> str:
        low, high = self.shown(self.low), self.shown(self.high)
        if self.high == math.inf:
            return f"above {low}" if self.open else f"at least {low}"
        if self.low == -math.inf:
            return f"at most {high}"
        return f"above {low} and at most {high}" if self.open else f"between {low} and {high}"


_WRITTEN = {"kmh": "km/h", "kph": "km/h"}
"""Units as people write them, too."""

_GIVEN = frozenset((*_COMMON, "1", "min", "h", "mph", "‰"))
"""Units that values may be given in."""

TIME = Measure("time", "s", "s", "90, 90s, 15min, 17min 30s or 17:30")
HOURS = Measure("time", "h", "h", "24, 24h or 90min")
SPEED = Measure("speed", "m/s", "km/h", "80, 80km/h or 22m/s")
SHARE = Measure("share", "1", "1", "0.07 or 7%")
PERCENT = Measure("share", "1", "%", "7 or 7%")
NUMBER = Measure("number", "1", "1", "0.1 or 10%")
COUNT = Measure("whole number", "1", "1", "500", whole=True)
DISTANCE = Measure("distance", "m", "m", "250, 250m or 0.25km")
KILOMETRE = Measure("kilometre", "km", "km", "12.3, 12.3km or 12300m")
MASS = Measure("mass", "kg", "kg", "12000, 12000kg or 12t")
FORCE = Measure("force", "N", "N", "2000, 2000N or 2kN")


def keyed(parts: Iterable[str], known: Collection[str], what: str, remedy: str) -> dict[str, str]:
    """Values that are given as ``key=value``, by their keys.

    Parameters
    ----------
    parts : iterable of str
    known : collection of str
        The keys that there are.
    what, remedy : str
        For messages: what is given, and how it is written.

    Raises
    ------
    InputError
        If a part is not of that form, or its key is unknown or given twice.

    Examples
    --------
    >>> keyed("km=10:14,factor=1.3".split(","), ("km", "factor"), "change", "")
    {'km': '10:14', 'factor': '1.3'}
    >>> keyed(["weathr=wet"], ("trip", "weather"), "--set", "")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: --set: 'weathr=wet' is not understood; did you mean weather?...
    """
    found: dict[str, str] = {}
    for part in parts:
        key, _, value = (each.strip() for each in part.partition("="))
        if key not in known or not value:
            near = similar(key, known, 1)
            meant = f"did you mean {near[0]}? " if near and near[0] != key else ""
            raise InputError(
                f"{what}: '{part}' is not understood",
                remedy=f"{meant}{remedy}; keys: {', '.join(known)}",
            )
        if key in found:
            raise InputError(f"{what}: '{key}' is given twice", remedy="give it once")
        found[key] = value
    return found


def _spelled(unit: str) -> str:
    """The unit in pint's spelling: '-' and '1' are pure numbers, '%' and '‰' have names."""
    cleaned = unit.strip().replace("²", "^2").replace("³", "^3").replace("·", "*")
    named = {"-": "", "1": "", "%": "percent", "‰": "permil", "permille": "permil", "t": "tonne"}
    return named.get(cleaned, cleaned)

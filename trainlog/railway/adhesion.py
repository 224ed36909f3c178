"""Adhesion between wheel and rail as a function of slip: adhesion characteristics.

An adhesion characteristic (traction characteristic, creep curve) gives the adhesion in use over the
slip of a wheel. Slip is either creepage, slip speed over train speed, as in contact mechanics, or
slip speed itself, as in traction control. All families have one interface,
`AdhesionCharacteristic`: at the train's speed each can be asked for either.

References
----------
Zhao et al. (2025), eq. (10); the same form over creepage goes back to Ishikawa and Kawamura (1997).
Polach, O. (2005), Creep forces in simulations of traction vehicles running on adhesion limit, Wear
258, 992-1000, eqs. (2) to (6), table 1.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.declaration import Declared, Quantity, hold_arrays
from trainlog.errors import InputError

SlipVariable = Literal["creepage", "slip speed"]
"""What a characteristic is a function of."""

LEAST_SPEED = 2.0
"""Train speed [m/s] below which creepage is slip speed over this speed: over its own it would grow
beyond all limits at standstill."""

GREATEST_ADHESION = 1.5
"""Adhesions are below this; what is above it is in another unit."""

LARGEST_CREEPAGE = 1.0
"""Creepage beyond which adhesion stays: a wheel at twice the train's speed."""

_SEARCHED = {"creepage": (1e-6, LARGEST_CREEPAGE), "slip speed": (1e-5, 30.0)}
"""Where a maximum is looked for: least and largest slip, [1] or [m/s]."""

_SAMPLES = 400
"""Slips at which a maximum is looked for, before it is refined."""


class AdhesionCharacteristic(ABC):
    """Adhesion in use over slip: odd, rising from 0 to its maximum, then flat or falling.

    A family states what it is a function of (`variable`) and its `adhesion_over` that variable.

    Examples
    --------
    >>> from trainlog.railway.adhesion import WET
    >>> rails: list[AdhesionCharacteristic] = [WET, polach_curve("wet")]
    >>> [round(float(rail.optimal_slip_speed(20.0)), 2) for rail in rails]
    [2.98, 1.0]
    """

    variable: SlipVariable

    @abstractmethod
    def adhesion_over(self, slip: FloatArray, speed: FloatArray) -> FloatArray:
        """Adhesion at slips that are not negative, in the family's own variable.

        Parameters
        ----------
        slip : array [1] or [m/s]
        speed : array [m/s]
            Of the train, at least `LEAST_SPEED` where the variable is creepage; NaN if not given.
            A family that does not depend on it need not broadcast with it.
        """

    def __call__(self, slip_speed: ArrayLike, speed: ArrayLike | None = None) -> FloatArray:
        """Adhesion coefficient, signed like the slip speed [m/s], at a train speed [m/s].

        Raises
        ------
        InputError
            If the characteristic depends on the train's speed and none is given.
        """
        slip = np.asarray(slip_speed, dtype=np.float64)
        reference, unit = self._reference(speed)
        return np.asarray(np.sign(slip) * self.adhesion_at(np.abs(slip) / unit, reference))

    def adhesion_at(self, slip: FloatArray, speed: FloatArray) -> FloatArray:
        """`adhesion_over`, held beyond `LARGEST_CREEPAGE`, which no measurement reaches."""
        if self.variable == "creepage":
            slip = np.minimum(slip, LARGEST_CREEPAGE)
        shape = np.broadcast_shapes(np.shape(slip), np.shape(speed))
        return np.broadcast_to(self.adhesion_over(slip, speed), shape)

    def over_creepage(self, creepage: ArrayLike, speed: ArrayLike | None = None) -> FloatArray:
        """Adhesion coefficient, signed like the creepage, at a train speed [m/s]."""
        slip = np.asarray(creepage, dtype=np.float64)
        reference, _ = self._reference(speed)
        unit = 1.0 if self.variable == "creepage" else _at_least(speed, "creepage")
        return np.asarray(np.sign(slip) * self.adhesion_at(np.abs(slip) * unit, reference))

    def slope(self, slip_speed: ArrayLike, speed: ArrayLike | None = None) -> FloatArray:
        """Change of adhesion with slip speed [s/m] at slip speeds [m/s]; the same on both sides.

        Positive below the maximum, negative beyond; at 0 it is the creep stiffness.
        """
        size = np.abs(np.asarray(slip_speed, dtype=np.float64))
        reference, unit = self._reference(speed)
        least, _ = _SEARCHED[self.variable]
        low = np.maximum(size / unit * (1.0 - 1e-4) - 1e-2 * least, 0.0)
        high = size / unit * (1.0 + 1e-4) + 1e-2 * least
        rise = self.adhesion_at(high, reference) - self.adhesion_at(low, reference)
        return np.asarray(rise / (high - low) / unit)

    def maximum(self, speed: ArrayLike | None = None) -> FloatArray:
        """Maximum adhesion at train speeds [m/s]."""
        return self._optimum(speed)[1]

    def optimal_slip_speed(self, speed: ArrayLike | None = None) -> FloatArray:
        """Least slip speed [m/s] at which the adhesion is greatest, at train speeds [m/s]."""
        slip = self._optimum(speed)[0]
        return np.asarray(slip * self._reference(speed)[1])

    def optimal_creepage(self, speed: ArrayLike | None = None) -> FloatArray:
        """Least creepage at which the adhesion is greatest, at train speeds [m/s]."""
        slip = self._optimum(speed)[0]
        return slip if self.variable == "creepage" else slip / _at_least(speed, "creepage")

    @property
    def needs_speed(self) -> bool:
        """Whether the adhesion at a slip of its own variable depends on the train's speed."""
        return False

    def _reference(self, speed: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
        """Train speed, and the slip speed of a slip of 1 in the family's own variable [m/s]."""
        if self.variable == "creepage":
            found = _at_least(speed, "an adhesion characteristic over creepage")
            return found, found
        given = np.nan if speed is None else speed
        return np.asarray(given, dtype=np.float64), np.ones(())

    def _optimum(self, speed: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
        """Least slip, in the own variable, of the greatest adhesion, and that adhesion."""
        given = speed
        if speed is None and not self.needs_speed:
            given = 1.0  # the optimum is the same at any speed
        reference, _ = self._reference(given)
        # A few speeds at a time: each is looked at over many slips.
        parts = np.array_split(np.ravel(reference), reference.size // 256 + 1)
        slip, adhesion = np.concatenate([self._optima(part) for part in parts], axis=1)
        return slip.reshape(reference.shape), adhesion.reshape(reference.shape)

    def _optima(self, speeds: FloatArray) -> FloatArray:
        """Least slips of the greatest adhesion, and that adhesion, at (n,) train speeds: (2, n)."""
        slips = np.geomspace(*_SEARCHED[self.variable], _SAMPLES)[None, :]
        for _ in range(3):
            found = self.adhesion_at(slips, speeds[:, None])
            # Where it stays at its maximum for good, where it first comes within rounding of it.
            near = found >= found.max(axis=1, keepdims=True) * (1.0 - 1e-12)
            best = np.argmax(near, axis=1)[:, None]
            grid = np.broadcast_to(slips, found.shape)
            low = np.take_along_axis(grid, np.maximum(best - 1, 0), 1)
            high = np.take_along_axis(grid, np.minimum(best + 1, _SAMPLES - 1), 1)
            slips = low + (high - low) * np.linspace(0.0, 1.0, _SAMPLES)
        return np.stack([np.take_along_axis(each, best, 1)[:, 0] for each in (grid, found)])


def _at_least(speed: ArrayLike | None, what: str) -> FloatArray:
    """Train speeds, not below `LEAST_SPEED`."""
    if speed is None:
        raise InputError(f"{what} needs the train's speed", remedy="give the speed [m/s]")
    return np.maximum(np.asarray(speed, dtype=np.float64), LEAST_SPEED)


@dataclass(frozen=True)
class CreepCurve(AdhesionCharacteristic):
    """Adhesion coefficient ``mu(s) = c exp(-a s) - d exp(-b s)``.

    Source: Zhao et al. (2025), eq. (10), over slip speed; Ishikawa and Kawamura (1997).

    It rises from 0 to its maximum, the maximum adhesion, and falls beyond to nothing.

    Attributes
    ----------
    a, b : float [s/m] or [1]
    c, d : float
        Equal, so that no slip means no force.
    variable : {"slip speed", "creepage"}

    Examples
    --------
    >>> steep = CreepCurve(a=2.46, b=203.0, c=0.325, d=0.325, variable="creepage")
    >>> round(float(steep.maximum(10.0)), 4), round(float(steep.optimal_creepage(10.0)), 3)
    (0.3041, 0.022)
    """

    a: float
    b: float
    c: float
    d: float
    variable: SlipVariable = "slip speed"

    def __post_init__(self) -> None:
        if not (0.0 < self.a < self.b and self.c == self.d and self.c > 0.0):
            raise InputError(
                "creep curve: needs 0 < a < b and c = d > 0",
                remedy="correct the curve's parameters",
            )
        _check_variable(self.variable)

    def adhesion_over(self, slip: FloatArray, speed: FloatArray) -> FloatArray:  # noqa: ARG002
        """Adhesion at slips that are not negative."""
        return np.asarray(self.c * np.exp(-self.a * slip) - self.d * np.exp(-self.b * slip))

    def slope(self, slip_speed: ArrayLike, speed: ArrayLike | None = None) -> FloatArray:
        """Change of adhesion with slip speed [s/m] at slip speeds [m/s]."""
        _, unit = self._reference(speed)
        slip = np.abs(np.asarray(slip_speed, dtype=np.float64)) / unit
        rise = self.d * self.b * np.exp(-self.b * slip) - self.c * self.a * np.exp(-self.a * slip)
        return np.asarray(rise / unit)

    @cached_property
    def peak_slip(self) -> float:
        """Slip of maximum adhesion, in its variable: slip speed [m/s] or creepage."""
        return float(np.log(self.d * self.b / (self.c * self.a)) / (self.b - self.a))

    @cached_property
    def peak(self) -> float:
        """Maximum adhesion."""
        return float(self.adhesion_over(np.asarray(self.peak_slip), np.asarray(np.nan)))

    def _optimum(self, speed: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
        shape = np.shape(speed) if speed is not None else ()
        return np.full(shape, self.peak_slip), np.full(shape, self.peak)


@dataclass(frozen=True)
class PolachCurve(AdhesionCharacteristic):
    """Adhesion after Polach (2005) with friction that falls with the slip speed.

    Source: Polach (2005), eqs. (2) to (6), for longitudinal creepage s at train speed v::

        mu_f = mu_0 ((1 - A) exp(-B s v) + A)
        eps  = (pi / 4) k s / mu_f
        mu   = (2 mu_f / pi) (k_A eps / (1 + (k_A eps)²) + arctan(k_S eps))

    Attributes
    ----------
    stiffness : float
        k: slope of a clean contact over creepage in Kalker's linear theory, G a b c_11 / Q.
    adhesion_factor, slip_factor : float
        k_A, k_S: reduction of the stiffness in the areas of adhesion and of slip, k_S <= k_A <= 1.
    friction : float
        mu_0: friction coefficient at no slip.
    friction_ratio : float
        A: friction at much slip over that at none.
    friction_decay : float [s/m]
        B.

    Examples
    --------
    >>> wet = polach_curve("wet")
    >>> [round(float(wet.maximum(v)), 3) for v in (5.0, 20.0, 40.0)]
    [0.269, 0.242, 0.224]
    """

    stiffness: Annotated[float, Quantity("1", "1")]
    adhesion_factor: Annotated[float, Quantity("1", "1")]
    slip_factor: Annotated[float, Quantity("1", "1")]
    friction: Annotated[float, Quantity("1", "1")]
    friction_ratio: Annotated[float, Quantity("1", "1", stated="required")] = 1.0
    friction_decay: Annotated[float, Quantity("s/m", "s/m", stated="required")] = 0.0
    variable: SlipVariable = field(default="creepage", init=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.slip_factor <= self.adhesion_factor <= 1.0:
            raise InputError(
                "Polach's curve: needs 0 < slip factor <= adhesion factor <= 1",
                remedy="correct the curve's factors",
            )
        if not (0.0 < self.friction < 1.5 and 0.0 < self.friction_ratio <= 1.0):
            raise InputError(
                "Polach's curve: needs a friction between 0 and 1.5 and 0 < friction ratio <= 1",
                remedy="correct the curve's friction",
            )
        if not (self.friction_decay >= 0.0 and 0.0 < self.stiffness < np.inf):
            raise InputError(
                "Polach's curve: needs a friction decay >= 0 and a stiffness > 0",
                remedy="correct the curve's decay and stiffness",
            )

    def adhesion_over(self, slip: FloatArray, speed: FloatArray) -> FloatArray:
        """Adhesion at creepages that are not negative."""
        ratio = self.friction_ratio
        falling = (1.0 - ratio) * np.exp(-self.friction_decay * slip * speed) + ratio
        friction = self.friction * falling
        strain = 0.25 * np.pi * self.stiffness * slip / friction
        held = self.adhesion_factor * strain
        carried = held / (1.0 + held**2) + np.arctan(self.slip_factor * strain)
        return np.asarray(2.0 / np.pi * friction * carried)

    @property
    def needs_speed(self) -> bool:
        """Whether the friction falls with the slip speed."""
        return self.friction_ratio < 1.0 and self.friction_decay > 0.0


CLEAN_STIFFNESS = 300.0
"""Kalker's slope of a clean contact over creepage, G a b c_11 / Q, at a wheel load of 50 kN.

It falls with the cube root of the load (Hertz): CONTACT's curve of the Eurosprinter on clean rail
has 231 at 106.7 kN."""

_POLACH = {"dry": (1.0, 0.4, 0.55, 0.4, 0.6), "wet": (0.3, 0.1, 0.3, 0.4, 0.2)}
"""k_A, k_S, mu_0, A and B [s/m]; Polach (2005), table 1."""


def polach_curve(condition: Literal["dry", "wet"]) -> PolachCurve:
    """Polach's curve of a dry or a wet rail, with the parameters that Polach (2005) recommends.

    Parameters
    ----------
    condition : {"dry", "wet"}

    Raises
    ------
    InputError
        If the condition is another.

    Examples
    --------
    >>> dry = polach_curve("dry")
    >>> bool(dry.optimal_creepage(10.0) < polach_curve("wet").optimal_creepage(10.0))
    True
    """
    if condition not in _POLACH:
        raise InputError(f"rail condition '{condition}' is unknown", remedy="give dry or wet")
    return PolachCurve(CLEAN_STIFFNESS, *_POLACH[condition])


@dataclass(frozen=True, eq=False)
class AdhesionTable(AdhesionCharacteristic):
    """Measured points of an adhesion characteristic, joined by a curve that keeps their shape.

    Between the points a piecewise cubic Hermite polynomial (Fritsch and Carlson, 1980) that is
    monotone where they are, from no adhesion at no slip; beyond the last point its adhesion.

    Attributes
    ----------
    slips : (n,) array [1] or [m/s]
        Strictly increasing, positive.
    adhesions : (n,) array
        Positive.
    variable : {"slip speed", "creepage"}

    Examples
    --------
    >>> import numpy as np
    >>> points = [0.004, 0.010, 0.016, 0.05, 0.25], [0.201, 0.301, 0.312, 0.285, 0.188]
    >>> rail = AdhesionTable(*map(np.array, points), variable="creepage")
    >>> round(float(rail.maximum(10.0)), 3), round(float(rail.optimal_slip_speed(10.0)), 2)
    (0.312, 0.16)
    """

    slips: FloatArray
    adhesions: FloatArray
    variable: SlipVariable = "creepage"

    def __post_init__(self) -> None:
        hold_arrays(self)
        _check_variable(self.variable)
        x, y = self.slips, self.adhesions
        if x.ndim != 1 or x.shape != y.shape or x.size < 3:
            raise InputError(
                "adhesion characteristic: needs three pairs of slip and adhesion or more",
                remedy="give more pairs",
            )
        if not (np.all(np.isfinite(x)) and x[0] > 0.0 and np.all(np.diff(x) > 0.0)):
            raise InputError(
                "adhesion characteristic: slips do not grow from above 0",
                remedy="order the points by slip; no slip without adhesion is understood",
            )
        if not np.all((y > 0.0) & (y < GREATEST_ADHESION)):
            raise InputError(
                "adhesion characteristic: an adhesion is not between 0 and 1.5",
                remedy="give adhesion as a share of the load, such as 0.2",
            )

    __eq__ = Declared.__eq__
    __hash__ = Declared.__hash__

    def adhesion_over(self, slip: FloatArray, speed: FloatArray) -> FloatArray:  # noqa: ARG002
        """Adhesion at slips that are not negative."""
        return np.asarray(self._curve(np.minimum(slip, self.slips[-1])))

    @cached_property
    def _curve(self):  # type: ignore[no-untyped-def]
        from scipy.interpolate import PchipInterpolator

        return PchipInterpolator(np.append(0.0, self.slips), np.append(0.0, self.adhesions))


@dataclass(frozen=True, eq=False)
class AdhesionPoints:
    """Measured points of adhesion over slip, in any order, with noise, several at one slip.

    Attributes
    ----------
    slips : (n,) array [1] or [m/s]
        Positive.
    adhesions : (n,) array
    variable : {"slip speed", "creepage"}
    speeds : (n,) array [m/s] or None
        Train speeds, where known.

    Raises
    ------
    InputError
        If a value is none, or can only come of a confused unit.

    Examples
    --------
    >>> import numpy as np
    >>> points = AdhesionPoints(np.array([0.016, 0.004, 0.05]), np.array([0.31, 0.20, 0.28]))
    >>> points.table().slips.tolist()
    [0.004, 0.016, 0.05]
    """

    slips: FloatArray
    adhesions: FloatArray
    variable: SlipVariable = "creepage"
    speeds: FloatArray | None = None

    def __post_init__(self) -> None:
        _check_variable(self.variable)
        hold_arrays(self)
        arrays = [self.slips, self.adhesions]
        if self.speeds is not None:
            object.__setattr__(self, "speeds", np.asarray(self.speeds, dtype=np.float64))
            arrays.append(self.speeds)
        slips, speeds = self.slips, np.ones(1) if self.speeds is None else self.speeds
        paired = slips.ndim == 1 and all(each.shape == slips.shape for each in arrays)
        known = all(np.all(np.isfinite(each)) for each in arrays)
        largest, of = {"creepage": (2.0, "2 (200 %)"), "slip speed": (50.0, "50 m/s")}[
            self.variable
        ]
        unit = "state its unit in the header, such as"
        for right, problem, remedy in (
            (paired, "need pairs of slip and adhesion", "give one adhesion per slip"),
            (known, "a value is not a finite number", "remove pairs that are not numbers"),
            (
                np.all(slips > 0.0),
                "a slip is not positive",
                "give the sizes of slip and adhesion, for braking, too",
            ),
            (np.all(speeds > 0.0), "a train speed is not positive", "give speeds above 0 m/s"),
            (
                np.all(np.abs(self.adhesions) < GREATEST_ADHESION),
                f"an adhesion is not below {GREATEST_ADHESION:g}",
                f"{unit} 'adhesion [%]'",
            ),
            (
                np.all(slips <= largest),
                f"a {self.variable} is beyond {of}",
                f"{unit} 'creepage [%]'",
            ),
        ):
            if not right:
                raise InputError(f"points of adhesion: {problem}", remedy=remedy)

    def table(self) -> AdhesionTable:
        """The points themselves as a characteristic.

        Raises
        ------
        InputError
            If there are several at one slip, or too few.
        """
        order = np.argsort(self.slips, kind="stable")
        slips = self.slips[order]
        if np.any(np.diff(slips) <= 0.0):
            raise InputError(
                "points of adhesion: several have one slip",
                remedy="fit adhesion a curve to them: trainlog fit",
            )
        return AdhesionTable(slips, self.adhesions[order], self.variable)


def _check_variable(variable: str) -> None:
    if variable not in _SEARCHED:
        raise InputError(
            f"adhesion characteristic over '{variable}' is unknown",
            remedy="give 'creepage' or 'slip speed'",
        )


DRY = CreepCurve(a=0.54, b=1.2, c=1.0, d=1.0)
"""Dry rail; Zhao et al. (2025), table 1."""

WET = CreepCurve(a=0.19, b=0.54, c=0.4, d=0.4)
"""Wet rail; Zhao et al. (2025), table 1."""


def creep_coefficients(maximum: ArrayLike) -> FloatArray:
    """a, b and c = d of the creep curve of a rail with a given maximum adhesion, eq. (10).

    The shape goes from the wet rail's (maximum 0.147 and below) to the dry rail's (0.286 and
    above) with the maximum; the curve is scaled to it.

    Parameters
    ----------
    maximum : (...) array
        Between 0 and 1.

    Returns
    -------
    (..., 3) array
        a and b [s/m], and the common factor of both exponentials.

    Raises
    ------
    InputError
        If a maximum is not between 0 and 1.

    Examples
    --------
    >>> a, b, scale = creep_coefficients(0.2)
    >>> curve = CreepCurve(a, b, scale, scale)
    >>> round(curve.peak, 6), round(curve.peak_slip, 2)
    (0.2, 1.91)
    """
    peak = np.asarray(maximum, dtype=np.float64)
    if not np.all((peak > 0.0) & (peak < 1.0)):
        bad = peak[~((peak > 0.0) & (peak < 1.0))]
        raise InputError(
            f"maximum adhesion {bad.flat[0]} is not between 0 and 1",
            remedy="give values such as 0.2",
        )
    dryness = np.clip((peak - WET.peak) / (DRY.peak - WET.peak), 0.0, 1.0)
    a = WET.a + dryness * (DRY.a - WET.a)
    b = WET.b + dryness * (DRY.b - WET.b)
    at_peak = np.log(b / a) / (b - a)
    scale = peak / (np.exp(-a * at_peak) - np.exp(-b * at_peak))
    return np.stack([a, b, scale], axis=-1)

"""Forces over speed and curvature: running, curve and tunnel resistance, and curves of effort.

A table of effort over speed is kept as it was published, and read on lines between its points. Two
approximations of it serve the optimiser: one from below that does not rise (or, for a brake, rises
and then does not rise), inside which a plan is safe, and tangents from above, ``effort <= offset +
power / v`` at every speed, on which a bound can rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Annotated, Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.declaration import Column, Declared, Quantity
from trainlog.errors import InputError

CurveFormula = Literal["proportional", "roeckl", "roeckl_small_radius"]

CURVE_FORMULAS: dict[CurveFormula, tuple[tuple[float, float, float], ...]] = {
    "proportional": ((0.0, 0.6, 0.0),),
    "roeckl": ((0.0, 0.65, 55.0), (1.0 / 300.0, 0.5, 30.0)),
    "roeckl_small_radius": ((0.0, 0.5, 30.0),),
}
"""Curve resistance over weight, ``k / (R - b)`` of the radius R: rows of the curvature [1/m] beyond
which it holds, k [m] and b [m].

``proportional``: 0.6/R; Amirhosseini et al. (2024), eq. (6), corrected. ``roeckl``: 0.65/(R - 55)
from a radius of 300 m on, 0.5/(R - 30) below it; Roeckl's formula as in Wende, D. (2003),
*Fahrdynamik des Schienenverkehrs*. ``roeckl_small_radius``: 0.5/(R - 30) for every radius.
"""

LEAST_RADIUS = 2.0
"""Radius over b of a formula up to which it holds: nearer to its pole it means nothing."""

TUNNEL_COEFFICIENT = 1.3e-7
"""k_T [1/m]: tunnel resistance is weight times k_T times the tunnel's length, where no coefficient
of the train itself is known; Amirhosseini et al. (2024), eq. (6), corrected."""

PUBLISHED_TUNNELS = ((27.0, 16.0), (87.0, 2.4))
"""Cross-section [m²] and extra quadratic resistance [N/(m/s)²] of the narrowest and the widest of
ten tunnels, from the records of a train's control unit; Hansen, H. S., Nawaz, M. U., Olsson, N.
(2017), Using operational data to estimate the running resistance of trains: estimation of the
resistance in a set of Norwegian tunnels, Journal of Rail Transport Planning & Management 7."""

LARGEST_STD = 0.10
"""Standard deviation of a curve, over the curve, up to which it is known at a speed."""


@dataclass(frozen=True, slots=True)
class RunningResistance:
    """Davis formula ``R(v) = r0 + r1 v + r2 v²`` [N] on straight, level, open track.

    Attributes
    ----------
    r0 : float [N]
    r1 : float [N/(m/s)]
    r2 : float [N/(m/s)²]

    Examples
    --------
    >>> resistance = RunningResistance(r0=2_000.0, r1=50.0, r2=5.0)
    >>> resistance([0.0, 10.0, 20.0])
    array([2000., 3000., 5000.])
    """

    r0: Annotated[float, Quantity("kN", "N")]
    r1: Annotated[float, Quantity("kN/(km/h)", "N/(m/s)")]
    r2: Annotated[float, Quantity("kN/(km/h)^2", "N/(m/s)^2")]

    def __post_init__(self) -> None:
        if not np.isfinite(self.coefficients).all():
            raise InputError(
                "running resistance: coefficients must be finite numbers",
                remedy="replace what is not a number",
            )

    @property
    def coefficients(self) -> FloatArray:
        """All coefficients, in their order, as an array (`TERMS`,).

        Examples
        --------
        >>> RunningResistance(2000.0, 50.0, 10.0).coefficients.tolist()
        [2000.0, 50.0, 10.0]
        """
        return np.array([getattr(self, name) for name in TERMS])

    @staticmethod
    def of(coefficients: Iterable[float]) -> RunningResistance:
        """The resistance with these coefficients, in the order of `TERMS`.

        Examples
        --------
        >>> RunningResistance.of([2000.0, 50.0, 10.0]).r1
        50.0
        """
        return RunningResistance(*map(float, coefficients))

    @property
    def terms(self) -> dict[str, float]:
        """Each coefficient by its name."""
        return {name: getattr(self, name) for name in TERMS}

    @property
    def parabola(self) -> tuple[float, float, float]:
        """Constant, linear and quadratic coefficient of the parabola that this curve is.

        For what moves a train along a parabola: plans, controllers, files of other programs. A
        curve with further terms gives one that is nowhere below it.
        """
        return self.r0, self.r1, self.r2

    @overload
    def __call__(self, speed: float) -> np.float64: ...

    @overload
    def __call__(self, speed: ArrayLike) -> FloatArray: ...

    def __call__(self, speed: ArrayLike) -> FloatArray | np.float64:
        """Resistance [N] at each speed [m/s], a number at a single one.

        The polynomial is evaluated at any speed. It is the resistance of a train that moves
        forward: not below zero, and not far beyond the speeds that it was fitted to (the
        ``speed_range`` of a fit or a parameter set).

        Examples
        --------
        >>> curve = RunningResistance(2000.0, 50.0, 10.0)
        >>> float(curve(20.0)), curve([0.0, 20.0]).tolist()
        (7000.0, [2000.0, 7000.0])
        """
        v = np.asarray(speed, dtype=np.float64)
        value: FloatArray = np.zeros(v.shape)
        for coefficient in reversed(self.terms.values()):
            value = np.asarray(value * v + coefficient)
        return value if value.ndim else np.float64(value)

    def __str__(self) -> str:
        values = (f"{value:.{power}f}" for power, value in enumerate(self.coefficients))
        return polynomial_in_words(values, UNITS)

    def __add__(self, other: RunningResistance) -> RunningResistance:
        """Both together."""
        return RunningResistance.of(self.coefficients + other.coefficients)

    def scaled(self, *factors: float) -> RunningResistance:
        """The coefficients times factors: one for all, or one for each, those left over times 1.

        Examples
        --------
        >>> RunningResistance(2000.0, 50.0, 10.0).scaled(0.5)(20.0).item()
        3500.0
        >>> RunningResistance(2000.0, 50.0, 10.0).scaled(1.0, 1.0, 2.0).r2
        20.0
        """
        every = np.full(len(TERMS), factors[0] if len(factors) == 1 else 1.0)
        every[: len(factors)] = factors
        return RunningResistance.of(self.coefficients * every)

    def in_wind(self, head_wind: float) -> RunningResistance:
        """Against a wind [m/s]: the air's part is that of speed and wind together, r2 (v + w)²."""
        more = self.r2 * head_wind**2, 2.0 * self.r2 * head_wind
        return replace(self, r0=self.r0 + more[0], r1=self.r1 + more[1])


TERMS = tuple(each.name for each in fields(RunningResistance))
"""Names of the coefficients."""

UNITS = ("N", "N/(m/s)", "N/(m/s)^2")
"""Of the coefficients, in files."""

OVER_INERTIA = (("c0", "m/s^2"), ("c1", "1/s"), ("c2", "1/m"))
"""Names and units of the coefficients over the inertia."""

SUFFIXES = ("N", "N_s_m", "N_s2_m2")
"""Units of the coefficients at the end of a column's name."""

OVER_MASS_STD = (1.0, 0.1, 0.01)
"""Standard deviation of each coefficient over mass, in SI units: any train, many times."""

TYPICAL = (0.014, 5e-4, 5e-5)
"""Coefficients over inertia, in SI units, of a train that might be any train."""

TYPICAL_STD = (0.007, 7e-4, 4e-5)
"""How far trains are from it."""


def polynomial_in_words(coefficients: Iterable[str], units: Iterable[str]) -> str:
    """Coefficients with their units, each with its power of speed.

    Examples
    --------
    >>> polynomial_in_words(["2000", "50.0", "10.00"], UNITS)
    '2000 N + 50.0 N/(m/s) v + 10.00 N/(m/s)² v²'
    """
    powers = ("", " v", *(f" v^{power}" for power in range(2, len(TERMS))))
    parts = zip(coefficients, units, powers, strict=True)
    words = " + ".join(f"{value} {unit}{power}" for value, unit, power in parts)
    return words.replace("^2", "²").replace("^3", "³")


def basis(speed: ArrayLike, head_wind: ArrayLike = 0.0) -> FloatArray:
    """What each coefficient is multiplied by (..., `TERMS`) at speeds [m/s], in a wind [m/s].

    Examples
    --------
    >>> basis([0.0, 10.0]).tolist()
    [[1.0, 0.0, 0.0], [1.0, 10.0, 100.0]]
    """
    v = np.asarray(speed, dtype=np.float64)
    air = v + np.asarray(head_wind, dtype=np.float64)
    return np.stack([np.ones(v.shape), v, air * np.abs(air)], axis=-1)


def specific_curve_resistance(curvature: Any, coefficient: Any, offset: Any) -> Any:
    """Curve resistance over weight, ``k / (R - b)``; of arrays, and compiled of single values.

    Parameters
    ----------
    curvature : [1/m]
    coefficient, offset : [m]
        k and b of a formula.

    Examples
    --------
    >>> round(specific_curve_resistance(-1.0 / 305.0, 0.65, 55.0), 9)
    0.0026
    """
    size = abs(curvature)
    return coefficient * size / (1.0 - offset * size)


def curve_coefficients(
    curvature: ArrayLike, formula: CurveFormula = "proportional"
) -> tuple[FloatArray, FloatArray]:
    """Coefficients k and b [m] of a formula at each curvature [1/m].

    Examples
    --------
    >>> curve_coefficients([1.0 / 300.0, 1.0 / 299.0], "roeckl")
    (array([0.65, 0.5 ]), array([55., 30.]))
    """
    beyond, coefficient, offset = np.array(CURVE_FORMULAS[formula]).T
    row = np.searchsorted(beyond[1:], np.abs(np.asarray(curvature, dtype=np.float64)))
    return coefficient[row], offset[row]


def curve_force_per_weight(
    curvature: ArrayLike, formula: CurveFormula = "proportional"
) -> FloatArray:
    """Curve resistance over weight by one of the `CURVE_FORMULAS`.

    Parameters
    ----------
    curvature : array [1/m]
    formula : {"proportional", "roeckl", "roeckl_small_radius"}

    Examples
    --------
    >>> curve_force_per_weight(1.0 / 300.0).item()
    0.002
    >>> round(curve_force_per_weight(1.0 / 300.0, "roeckl").item(), 6)
    0.002653
    """
    bend = np.asarray(curvature, dtype=np.float64)
    return np.asarray(specific_curve_resistance(bend, *curve_coefficients(bend, formula)))


def published_tunnel_coefficient(cross_section: ArrayLike) -> FloatArray:
    """Extra quadratic resistance [N/(m/s)²] that was measured in tunnels of each section [m²].

    By the power of the section that joins `PUBLISHED_TUNNELS`; 0 in the open (section 0). That of
    another train may be the half or the double.

    Examples
    --------
    >>> published_tunnel_coefficient([0.0, 27.0, 45.0, 87.0]).round(1).tolist()
    [0.0, 16.0, 7.0, 2.4]
    """
    (narrow, most), (wide, least) = PUBLISHED_TUNNELS
    power = np.log(most / least) / np.log(wide / narrow)
    section = np.asarray(cross_section, dtype=np.float64)
    found = most * (narrow / np.maximum(section, 1e-9)) ** power
    return np.where(section > 0.0, found, 0.0)


def tunnel_force_per_weight(length: ArrayLike) -> FloatArray:
    """Resistance of a tunnel over weight, ``k_T L_T``.

    Source: Amirhosseini et al. (2024), eq. (6) as corrected.

    Parameters
    ----------
    length : array [m]
        Of the tunnel.

    Examples
    --------
    >>> round(tunnel_force_per_weight(2_000.0).item(), 6)
    0.00026
    """
    return np.asarray(TUNNEL_COEFFICIENT * np.asarray(length, dtype=np.float64))


# ------------------------------------------------------------------ curves of effort

_PARTS = 8
"""Of a piece of a table, at whose ends its envelope is sampled."""

_SLOW = 0.05
"""Speed [m/s] below which the envelope is that of the largest effort there."""


@dataclass(frozen=True, eq=False, repr=False)
class EffortCurve(Declared):
    """Effort over speed, on lines between its points; beyond the last at the power of the last.

    Attributes
    ----------
    speeds : (n,) array [m/s]
        Strictly increasing from 0.
    efforts : (n,) array [N]
        Not negative.

    Raises
    ------
    InputError
        If the points are not such a curve.

    Examples
    --------
    >>> curve = EffortCurve(np.array([0.0, 10.0, 30.0]), np.array([100e3, 80e3, 20e3]))
    >>> curve([5.0, 20.0, 60.0]).tolist()
    [90000.0, 50000.0, 10000.0]
    """

    speeds: Annotated[FloatArray, Column("speed", "km/h", "m/s")]
    efforts: Annotated[FloatArray, Column("effort", "kN", "N")]

    def problems(self) -> Iterator[InputError]:
        """What no curve of effort can be."""
        if self.speeds.ndim != 1 or self.speeds.size < 2 or self.speeds.shape != self.efforts.shape:
            yield InputError(
                "tractive effort: needs pairs of speed and effort, two at least",
                remedy="give the effort at standstill and at the highest speed",
            )
        elif not np.all(np.isfinite(self.speeds) & np.isfinite(self.efforts)):
            yield InputError(
                "tractive effort: a speed or an effort is not a finite number",
                remedy="give numbers",
            )
        elif self.speeds[0] != 0.0 or np.any(np.diff(self.speeds) <= 0.0):
            yield InputError(
                "tractive effort: speeds do not grow from 0",
                remedy="order the pairs by speed, the first at standstill",
            )
        elif not np.all(self.efforts >= 0.0):
            yield InputError("tractive effort: an effort is negative", remedy="give 0 or more")

    def __call__(self, speed: ArrayLike) -> FloatArray:
        """Largest effort [N] at each speed [m/s]."""
        v = np.asarray(speed, dtype=np.float64)
        last = self.speeds[-1]
        within = np.interp(v, self.speeds, self.efforts)
        return np.asarray(within * np.minimum(last / np.maximum(v, last), 1.0))

    @cached_property
    def peak_power(self) -> float:
        """Largest product of effort and speed [W]: at a point, or inside a falling piece."""
        v, f = self.speeds, self.efforts
        slope = np.diff(f) / np.diff(v)
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = 0.5 * (v[:-1] - f[:-1] / slope)
        inside = np.where(slope < 0.0, np.clip(inside, v[:-1], v[1:]), v[1:])
        return float(max((v * f).max(), (inside * self(inside)).max(initial=0.0)))

    def stretched(self, share: float) -> EffortCurve:
        """The curve at this share of the power: the same efforts, each at this share of its speed.

        Where effort is limited by power alone, ``P / v``, it becomes ``share P / v``.
        """
        return EffortCurve(self.speeds * share, self.efforts)

    def over(self, unit: float) -> EffortCurve:
        """The efforts over an inertia [kg], or in another unit."""
        return EffortCurve(self.speeds, self.efforts / unit)

    @property
    def without_rise(self) -> EffortCurve:
        """The highest curve below this one that does not rise with the speed."""
        return EffortCurve(*_without_rise(self.speeds, self.efforts))

    @property
    def without_dip(self) -> EffortCurve:
        """The highest curve below this one that rises to its peak and does not rise after it."""
        top = int(np.argmax(self.efforts))
        after = _without_rise(self.speeds[top:], self.efforts[top:])
        before = _without_rise(-self.speeds[top::-1], self.efforts[top::-1])
        return EffortCurve(
            np.concatenate((-before[0][:0:-1], after[0])),
            np.concatenate((before[1][:0:-1], after[1])),
        )

    def slope(self, speed: ArrayLike) -> FloatArray:
        """Change of effort with speed [N/(m/s)]; at a point that of the piece above it."""
        v = np.asarray(speed, dtype=np.float64)
        piece = np.searchsorted(self.speeds, v, side="right") - 1
        slopes = np.append(np.diff(self.efforts) / np.diff(self.speeds), 0.0)
        beyond = -self.efforts[-1] * self.speeds[-1] / np.maximum(v, 1e-9) ** 2
        return np.where(piece >= self.speeds.size - 1, beyond, slopes[np.maximum(piece, 0)])

    def speed_at(self, effort: ArrayLike) -> FloatArray:
        """Highest speed [m/s] at which a curve that does not rise gives the effort [N].

        Infinite for no effort, 0 for more than there is.
        """
        wanted = np.asarray(effort, dtype=np.float64)
        v, f = self.speeds, self.efforts
        # The last point that still gives it, and the next.
        last = f.size - 1 - np.searchsorted(f[::-1], wanted)
        low, high = np.clip(last, 0, f.size - 1), np.clip(last + 1, 0, f.size - 1)
        fall = f[low] - f[high]
        share = np.where(fall > 0.0, (f[low] - wanted) / np.where(fall > 0.0, fall, 1.0), 0.0)
        found = v[low] + share * (v[high] - v[low])
        beyond = f[-1] * v[-1] / np.maximum(wanted, 1e-300)
        found = np.where(last == f.size - 1, np.maximum(beyond, v[-1]), found)
        return np.where(last < 0, 0.0, np.where(wanted > 0.0, found, np.inf))

    def tangents(self, fastest: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Upper bounds ``offset + power / v`` that hold at every speed up to the fastest.

        They are the sides of the least concave curve above this one over ``1 / v``, the time that
        a metre takes.

        Parameters
        ----------
        fastest : float [m/s]

        Returns
        -------
        speeds, offsets, powers : (m,) arrays [m/s], [N], [W]
            Each bound with the lowest speed of its side, from high speeds to low ones.
        """
        fastest = max(fastest, 2.0 * _SLOW)
        knots = np.unique(np.clip(np.append(self.speeds, fastest), _SLOW, fastest))
        parts = np.linspace(0.0, 1.0, _PARTS + 1)[:-1]
        v = np.append((knots[:-1, None] + np.diff(knots)[:, None] * parts).ravel(), knots[-1])
        efforts = self(v)
        efforts[0] = max(efforts[0], self.efforts[self.speeds <= _SLOW].max())
        x = 1.0 / v[::-1]
        y = efforts[::-1]
        kept: list[int] = []
        for i in range(x.size):
            while len(kept) > 1:
                a, b = kept[-2], kept[-1]
                if (y[b] - y[a]) * (x[i] - x[a]) > (y[i] - y[a]) * (x[b] - x[a]):
                    break
                kept.pop()
            kept.append(i)
        side = np.array(kept, dtype=np.int64)
        tau, top = 1.0 / v[::-1][side], efforts[::-1][side]
        powers = np.diff(top) / np.diff(tau)
        rising = powers > 0.0
        powers, tau, top = powers[rising], tau[1:][rising], top[1:][rising]
        offsets = top - powers * tau
        # Inside a piece that falls, effort is above the chord of what was sampled.
        low, high = knots[:-1], knots[1:]
        start, fall = self(low), -(self(high) - self(low)) / (high - low)
        within = low < self.speeds[-1]
        low, high, start, fall = low[within], high[within], start[within], fall[within]
        with np.errstate(over="ignore"):
            worst = np.sqrt(powers[:, None] / np.maximum(fall, 1e-300))
        worst = np.clip(worst, low, high)
        excess = start - fall * (worst - low) - offsets[:, None] - powers[:, None] / worst
        offsets = offsets + np.maximum(excess.max(axis=1, initial=0.0), 0.0)
        flat = np.full(1, self.efforts.max())
        return np.append(1.0 / tau, 0.0), np.append(offsets, flat), np.append(powers, 0.0)


def _without_rise(x: FloatArray, efforts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points of the highest curve below one that does not rise with `x`."""
    least = np.minimum.accumulate(efforts)
    # Where a piece falls below the least before it there is a point more.
    at = np.flatnonzero((efforts[:-1] > least[:-1]) & (efforts[1:] < least[:-1]))
    share = (efforts[at] - least[at]) / (efforts[at] - efforts[at + 1])
    crossing = x[at] + share * (x[at + 1] - x[at])
    order = np.argsort(np.concatenate((x, crossing)), kind="stable")
    every = np.concatenate((x, crossing))[order]
    kept = np.append(True, np.diff(every) > 0.0)
    return every[kept], np.concatenate((least, least[at]))[order][kept]


NO_CURVE = (np.ones(1), np.full(1, np.inf))
"""Speeds and efforts of a train without a table, for compiled code: no limit."""


def arrays_of(curve: EffortCurve | None) -> tuple[FloatArray, FloatArray]:
    """Speeds [m/s] and efforts [N] of a curve for compiled code; `NO_CURVE` without one."""
    return NO_CURVE if curve is None else (curve.speeds, curve.efforts)

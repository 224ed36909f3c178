"""Curves of effort over speed in a trajectory problem: what plans keep, and what bounds rest on.

A plan keeps to the highest curve below the train's own that falls with the speed (of the dynamic
brake: that rises to its peak and falls after it), so that the ends of a cell decide for all of it.
A lower bound takes tangents of the train's own curve from above instead, linear in what the
relaxation is linear in: the time that a metre takes, as the limit of power is, the speed, and half
its square. A speed, its inverse and its square lie on curves that bend one way: there is a tangent
at every speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.railway import EffortCurve

_STEEPNESS = (0.0, 0.2, 0.34, 0.5, 0.7, 0.85, 1.0, 1.25, 1.6, 2.2, 3.0, 4.0, 6.0, 9.0)
"""Powers of bounds over that of the effort at their speed: the lowest bound there is the best."""

SPARE = 0.1
"""By which a cell's mean speed may exceed the mean of its ends [m/s]."""

_SPAN = 0.25
"""Of speeds, at whose ends a curve and its bounds are compared [m/s]."""


class Bounds(NamedTuple):
    """``effort <= offset + power / v + slope v + square v²/2`` at every speed; arrays of one shape.

    Attributes
    ----------
    offset, power, slope, square : array [m/s²], [W/kg], [1/s], [1/m]
    """

    offset: FloatArray
    power: FloatArray
    slope: FloatArray
    square: FloatArray

    def at(self, speed: FloatArray) -> FloatArray:
        """The bound at speeds [m/s²]."""
        found = self.offset + self.power / speed + self.slope * speed
        return np.asarray(found + 0.5 * self.square * speed**2)

    def raised(self, by: FloatArray) -> Bounds:
        """The bound, so much higher [m/s²]."""
        return self._replace(offset=self.offset + by)


@dataclass(frozen=True, eq=False)
class Curves:
    """One curve of effort for q configurations, per unit reference inertia.

    Attributes
    ----------
    own : EffortCurve
        As published.
    kept : EffortCurve
        The curve below it that plans keep to.
    share : (q,) array
        Of the speeds, by which the curve is that of each configuration.
    offsets, powers, begins : (m,) array [m/s²], [W/kg], [m/s]
        Tangents from above without slope, and the lowest speed of each one's side.
    fastest : float [m/s]
        Up to which the bounds hold.
    """

    own: EffortCurve
    kept: EffortCurve
    share: FloatArray
    offsets: FloatArray
    powers: FloatArray
    begins: FloatArray
    fastest: float

    @staticmethod
    def of(
        curve: EffortCurve | None, share: FloatArray, fastest: float, *, brake: bool = False
    ) -> Curves | None:
        """Of a curve [m/s²] up to the fastest speed [m/s]; None without one."""
        if curve is None:
            return None
        fastest = fastest / float(share.min())
        begins, offsets, powers = curve.tangents(fastest)
        kept = curve.without_dip if brake else curve.without_rise
        return Curves(curve, kept, share, offsets, powers, begins, fastest)

    def select(self, rows: Sequence[int]) -> Curves:
        """Those of some of the configurations."""
        return replace(self, share=self.share[list(rows)])

    @property
    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Speeds of each configuration's curve that plans keep to, (q, m), and efforts, (m,)."""
        return self.share[:, None] * self.kept.speeds, self.kept.efforts

    @property
    def own_arrays(self) -> tuple[FloatArray, FloatArray]:
        """The same of the curves as published."""
        return self.share[:, None] * self.own.speeds, self.own.efforts

    def at(self, speed: FloatArray) -> FloatArray:
        """Effort of each configuration at its speeds [m/s], (..., q, n) [m/s²]."""
        return self.kept(speed / self.share[:, None])

    def speed_at(self, effort: FloatArray) -> FloatArray:
        """Highest speed [m/s] at which each configuration has efforts, (q, n)."""
        return self.kept.speed_at(effort) * self.share[:, None]

    def line(self, row: int, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Effort and slope of a configuration's curve at speeds, (n,)."""
        share = float(self.share[row])
        return self.kept(speed / share), self.kept.slope(speed / share) / share

    def bounds(
        self,
        row: int,
        speed: FloatArray,
        fastest: FloatArray | float = np.inf,
    ) -> Bounds:
        """Upper bounds of a configuration's effort at speeds up to the fastest, low at given ones.

        Parameters
        ----------
        row : int
        speed : (n,) array [m/s]
            Where each bound is to be low; above 0.
        fastest : (n,) array [m/s]
            Speeds that the configuration cannot exceed.
        """
        share = float(self.share[row])
        v = speed / share
        reach = np.minimum(np.broadcast_to(fastest, v.shape) / share, self.fastest)
        effort, fall = self.kept(v), self.kept.slope(v)
        best = self._tangent(v)
        lowest = best.at(v)
        none = np.zeros(v.size)
        for steepness, alone in product(_STEEPNESS, (False, True)):
            bend = steepness * np.maximum(effort, -fall * v)
            power, slope = bend * v, none if alone else fall + bend / v
            rising = slope > 0.0
            found = Bounds(
                none, power, np.where(rising, 0.0, slope), np.where(rising, slope / v, 0.0)
            )
            found = found.raised(effort - found.at(v))
            # The mean speed of a cell may be above that of its ends.
            found = found.raised(
                self._excess(found, reach) + SPARE * np.where(rising, found.square * v, 0.0)
            )
            value = found.at(v)
            better = value < lowest
            lowest = np.where(better, value, lowest)
            best = Bounds(*(np.where(better, *pair) for pair in zip(found, best, strict=True)))
        return Bounds(best.offset, best.power * share, best.slope / share, best.square / share**2)

    def _excess(self, bound: Bounds, reach: FloatArray) -> FloatArray:
        """By how much the curve is above bounds at most, up to the speeds `reach`, (n,) [m/s²].

        At the ends of short spans, and what it can rise above them in between.
        """
        offset, power, slope, square = (each[:, None] for each in bound)
        knots = self.own.speeds[self.own.speeds < self.fastest]
        v = np.unique(np.concatenate((knots, np.arange(0.0, self.fastest, _SPAN), [self.fastest])))
        low, high = v[1:-1], v[2:]
        f = self.own(v)
        above = f[1:] - offset - power / v[1:] - slope * v[1:] - 0.5 * square * v[1:] ** 2
        bend = 2.0 * power / low**3 + np.maximum(square, 0.0)
        between = np.maximum(above[:, :-1], above[:, 1:]) + 0.125 * bend * (high - low) ** 2
        between = np.where(low < reach[:, None], between, -np.inf)
        first = v[1]
        start = f[:2].max() - offset - power / first
        start = start - np.minimum(slope, 0.0) * first - 0.5 * np.minimum(square, 0.0) * first**2
        return np.asarray(np.maximum(np.maximum(between.max(axis=1), start[:, 0]), 0.0))

    def _tangent(self, v: FloatArray) -> Bounds:
        """The bound by power alone that is lowest at speeds of the curve."""
        at = np.searchsorted(-self.begins, -v)
        at = np.clip(at, 0, self.begins.size - 1)
        none = np.zeros(v.size)
        return Bounds(self.offsets[at], self.powers[at], none, none)

"""Curves of effort over speed in a trajectory problem: what plans keep, and what bounds rest on.

A plan keeps to the highest curve below the train's own that falls with the speed (of the dynamic
brake: that rises to its peak and falls after it), so that the ends of a cell decide for all of it.
A lower bound takes ``effort <= offset + power / v`` instead, tangents of the train's own curve from
above: linear in the time that a metre takes, as the limit of power is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trainlog.railway import EffortCurve

FloatArray = NDArray[np.float64]

_BESIDE = 0.5
"""Change of speed [m/s] within which a piece that begins beside a speed limits it, too."""


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
        Tangents from above, and the lowest speed of each one's side.
    """

    own: EffortCurve
    kept: EffortCurve
    share: FloatArray
    offsets: FloatArray
    powers: FloatArray
    begins: FloatArray

    @staticmethod
    def of(
        curve: EffortCurve | None, share: FloatArray, fastest: float, *, brake: bool = False
    ) -> Curves | None:
        """Of a curve [m/s²] up to the fastest speed [m/s]; None without one."""
        if curve is None:
            return None
        begins, offsets, powers = curve.tangents(fastest / float(share.min()))
        kept = curve.without_dip if brake else curve.without_rise
        return Curves(curve, kept, share, offsets, powers, begins)

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

    def lines(self, row: int, speed: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Effort and slope at speeds (n,) of the lines of a configuration that limit it there.

        That of the curve, and where it bends down at a point nearby that of the piece beyond. Where
        one is far from its speeds its effort is infinite.
        """
        share = float(self.share[row])
        v, f = self.kept.speeds * share, self.kept.efforts
        yield self.kept(speed / share), self.kept.slope(speed / share) / share
        last = v.size - 1
        slopes = np.append(np.diff(f) / np.diff(v), -f[-1] / v[-1])
        piece = np.clip(np.searchsorted(v, speed, side="right") - 1, 0, last)
        for beyond, point in ((piece - 1, piece), (piece + 1, piece + 1)):
            there = (beyond >= 0) & (beyond <= last) & (point >= 1) & (point <= last)
            beyond, point = np.clip(beyond, 0, last), np.clip(point, 1, last)
            there &= np.abs(speed - v[point]) < _BESIDE
            there &= slopes[point] < slopes[point - 1]
            effort = f[point] + slopes[beyond] * (speed - v[point])
            yield np.where(there, effort, np.inf), slopes[beyond]

    def limit_and_fall(
        self, row: int, speed: FloatArray, power: float
    ) -> tuple[FloatArray, FloatArray]:
        """The least of curve and power at speeds of a configuration, and how fast it falls."""
        share = float(self.share[row])
        by_curve, by_power = self.kept(speed / share), power / speed
        fall = -self.kept.slope(speed / share) / share
        curve = by_curve < by_power
        return np.where(curve, by_curve, by_power), np.where(curve, fall, by_power / speed)

    def tangent(self, row: int, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Offset and power of the bound that is lowest at speeds of a configuration."""
        share = float(self.share[row])
        at = np.searchsorted(-self.begins, -speed / share)
        at = np.clip(at, 0, self.begins.size - 1)
        return self.offsets[at], self.powers[at] * share

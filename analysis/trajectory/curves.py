"""Curves of effort over speed in a trajectory problem: what plans keep, and what bounds rest on.

A plan keeps to the highest curve below the train's own that falls with the speed (of the dynamic
brake: that rises to its peak and falls after it), so that the ends of a cell decide for all of it.
A lower bound takes ``effort <= offset + power / v + slope v`` instead, tangents of the train's own
curve from above: linear in the time that a metre takes, as the limit of power is, and in the speed.
Since a speed and its inverse lie on a curve that bends one way, there is a tangent at every speed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trainlog.railway import EffortCurve

FloatArray = NDArray[np.float64]

_STEEPNESS = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0)
"""By which bounds bend up beside the speed of their tangent, over the effort there: the least that
is above the curve is the best."""

SPARE = 0.1
"""By which a cell's mean speed may exceed the mean of its ends [m/s]."""

_STANDSTILL = 1e-6
"""Speed below which bounds are not looked at [m/s]."""

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

    def bounds(self, row: int, speed: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Upper bounds ``offset + power / v + slope v`` of a configuration's effort at any speed.

        Parameters
        ----------
        row : int
        speed : (n,) array [m/s]
            Where each bound is to be low; above 0.

        Returns
        -------
        offset, power, slope : (n,) arrays [m/s²], [W/kg], [1/s]
        """
        share = float(self.share[row])
        v = speed / share
        effort, fall = self.kept(v), self.kept.slope(v)
        best = self._tangent(v)
        lowest = best[0] + best[1] / v + SPARE * np.maximum(best[2], 0.0)
        for steepness in _STEEPNESS:
            bend = steepness * effort
            power, slope = bend * v, fall + bend / v
            offset = effort - fall * v - 2.0 * bend
            offset = offset + self._excess(offset, power, slope)
            value = offset + power / v + slope * v + SPARE * np.maximum(slope, 0.0)
            better = value < lowest
            lowest = np.where(better, value, lowest)
            best = tuple(
                np.where(better, new, old)
                for new, old in zip((offset, power, slope), best, strict=True)
            )
        offset, power, slope = best
        # The mean speed of a cell may be above that of its ends.
        return offset + SPARE * np.maximum(slope, 0.0) / share, power * share, slope / share

    def _excess(self, offset: FloatArray, power: FloatArray, slope: FloatArray) -> FloatArray:
        """By how much the curve is above ``offset + power / v + slope v`` at most, (n,) [m/s²].

        Over a straight piece the difference is concave: its peak is known.
        """
        v = np.append(self.own.speeds, max(self.fastest, self.own.speeds[-1] * (1.0 + 1e-9)))
        f = self.own(v)
        low, high = np.maximum(v[:-1], _STANDSTILL), np.maximum(v[1:], _STANDSTILL)
        change = np.diff(f) / np.diff(v)
        # Beyond the last point the power stays: below the chord of it in between.
        net = change - slope[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            peak = np.sqrt(power[:, None] / -net)
        peak = np.clip(np.where(net < 0.0, peak, high), low, high)
        start = f[:-1] + change * (peak - v[:-1])
        bound = offset[:, None] + power[:, None] / peak + slope[:, None] * peak
        return np.asarray(np.maximum((start - bound).max(axis=1), 0.0))

    def _tangent(self, v: FloatArray) -> tuple[FloatArray, ...]:
        """The bound without slope that is lowest at speeds of the curve."""
        at = np.searchsorted(-self.begins, -v)
        at = np.clip(at, 0, self.begins.size - 1)
        return self.offsets[at], self.powers[at], np.zeros(v.size)

"""Effort over speed, as manufacturers publish it: a table, read on lines between its points.

A table is kept as it was published. Two approximations of it serve the optimiser: one from below
that does not rise (or, for a brake, rises and then does not rise), inside which a plan is safe, and
tangents from above, ``effort <= offset + power / v`` at every speed, on which a bound can rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray, IntArray
from trainlog.declaration import Column, Declared
from trainlog.errors import InputError

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
        side = _concave_hull(1.0 / v[::-1], efforts[::-1])
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


def _concave_hull(x: FloatArray, y: FloatArray) -> IntArray:
    """Indices of the points of the least concave curve above points that grow in `x`."""
    kept: list[int] = []
    for i in range(x.size):
        while len(kept) > 1:
            a, b = kept[-2], kept[-1]
            if (y[b] - y[a]) * (x[i] - x[a]) > (y[i] - y[a]) * (x[b] - x[a]):
                break
            kept.pop()
        kept.append(i)
    return np.array(kept, dtype=np.int64)


NO_CURVE = (np.ones(1), np.full(1, np.inf))
"""Speeds and efforts of a train without a table, for compiled code: no limit."""


def arrays_of(curve: EffortCurve | None) -> tuple[FloatArray, FloatArray]:
    """Speeds [m/s] and efforts [N] of a curve for compiled code; `NO_CURVE` without one."""
    return NO_CURVE if curve is None else (curve.speeds, curve.efforts)

"""What a change of several channels is: the fault that explains all of them best.

A fault moves the channels of a trip in a known proportion. A dragging brake adds a force at every
speed. A train heavier than its file says makes the efforts look too large by as much, and the curve
and the power that are computed with them too small; a converter that overstates its effort makes
them look too large, too, but leaves the rest. Of each fault the size that fits best is found by
least squares, and how well it fits; of faults that fit about as well none is ruled out, and
all are stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.special import gammaincc

from analysis.fleet.channels import Channel
from analysis.fleet.resistance import KindResistance
from trainlog.arrays import FloatArray

PROBABLE = 0.05
"""Other faults at least as probable as this are stated beside the likeliest."""

UNEXPLAINED = 1e-4
"""A fault that explains the channels no better than this is not what it is."""

SLACK = 0.5
"""Channels of a healthy train move by this share of their tolerance."""


@dataclass(frozen=True)
class Shift:
    """By how much a channel of a train moved, and the variance of that."""

    channel: Channel
    size: float
    variance: float


@dataclass(frozen=True)
class Cause:
    """A fault that may be it.

    Attributes
    ----------
    what : str
    size, std : float
        In `unit`, with its standard deviation.
    unit : str
    probability : float
        Among the faults that are known, all equally probable beforehand.
    """

    what: str
    size: float
    std: float
    unit: str
    probability: float

    def __str__(self) -> str:
        reach = 1.96 * self.std
        if self.unit == "N":
            return f"{self.what} {self.size / 1e3:+.2f} ± {reach / 1e3:.2f} kN"
        if self.unit == "s":
            return f"{self.what} {self.size:+.2f} ± {reach:.2f} s"
        return f"{self.what} {100.0 * self.size:+.1f} ± {100.0 * reach:.1f} %"


@dataclass(frozen=True)
class Explanation:
    """What changed.

    Attributes
    ----------
    cause : Cause
        The likeliest.
    others : tuple of Cause
        That fit about as well.
    explained : bool
        Whether it explains all channels.
    """

    cause: Cause
    others: tuple[Cause, ...]
    explained: bool

    @property
    def what(self) -> str:
        """The likeliest fault's name, or that none of them is it."""
        return self.cause.what if self.explained else "unlike, no known fault"

    def __str__(self) -> str:
        words = str(self.cause) if self.explained else f"no known fault; nearest is {self.cause}"
        if self.others:
            words += ", or " + ", or ".join(str(each) for each in self.others)
        return words


Direction = dict[str, float]
"""What a fault of size one does to each channel."""


def faults_of(kind: KindResistance, trips: pd.DataFrame) -> dict[str, tuple[str, Direction]]:
    """Unit and direction of each known fault, on a train of a kind.

    Parameters
    ----------
    kind : KindResistance
    trips : DataFrame
        Of the train: its loads say how much of the mass is the empty train's.
    """
    steepness = _projections(kind)
    empty = 1.0
    if "load" in trips:
        share = ((trips["mass"] - trips["load"]) / trips["mass"]).median()
        empty = float(share) if np.isfinite(share) else 1.0
    weighed = "load_source" in trips and bool((trips["load_source"] == "recorded").mean() > 0.5)
    curve, force = steepness["curve"], steepness["force"]
    if weighed:
        mass_moves = {
            "effort gain": empty,
            "size of the curve": -empty,
            "constant resistance": -empty * curve,
            "power": -empty,
        }
        gain_moves = {"effort gain": 1.0}
    else:
        # Efforts are not corrected by a gain that nothing shows.
        mass_moves = {"effort over mass": empty}
        gain_moves = {
            "effort over mass": 1.0,
            "size of the curve": 1.0,
            "constant resistance": curve,
            "power": 1.0,
        }
    return {
        "dragging brake": ("N", {"constant resistance": 1.0, "size of the curve": force}),
        "running resistance": ("1", {"constant resistance": curve, "size of the curve": 1.0}),
        "mass": ("1", mass_moves),
        "effort gain": ("1", gain_moves),
        "wheel diameter": ("1", {"speed scale": -1.0}),
        "sensor delay": ("s", {"effort delay": 1.0}),
        "speed noise": ("1", {"speed noise": 1.0}),
    }


def _projections(kind: KindResistance) -> dict[str, float]:
    """What one of a force [N] adds to the size of the curve, and the curve to the force [N].

    Both by generalised least squares with the typical trip's variance.
    """
    curves, found = kind.curves, kind.effects
    trust = np.linalg.inv(np.median(curves.variances, axis=0) + found.within)
    constant, mean = curves.nodes[:, 0], found.mean
    return {
        "force": float(mean @ trust @ constant / (mean @ trust @ mean)),
        "curve": float(constant @ trust @ mean / (constant @ trust @ constant)),
    }


def explained(
    shifts: Sequence[Shift], kind: KindResistance, trips: pd.DataFrame, seen: str
) -> Explanation:
    """The faults that explain the shifts of a train's channels.

    Parameters
    ----------
    shifts : sequence of Shift
    kind : KindResistance
    trips : DataFrame
        Of the train.
    seen : str
        Channel that raised the alarm; the cause must move it.
    """
    names = [shift.channel.name for shift in shifts]
    size = np.array([shift.size for shift in shifts])
    slack = np.array([SLACK * shift.channel.tolerance for shift in shifts])
    covariance = np.diag(np.array([shift.variance for shift in shifts]) + slack**2)
    _correlate(covariance, names, kind)
    trust = np.linalg.inv(covariance)
    causes, distances = [], []
    for what, (unit, moves) in faults_of(kind, trips).items():
        direction = np.array([moves.get(name, 0.0) for name in names])
        if seen not in names or moves.get(seen, 0.0) == 0.0:
            continue
        weight = float(direction @ trust @ direction)
        amount = float(direction @ trust @ size) / weight
        rest = size - amount * direction
        distance = float(rest @ trust @ rest)
        if what == "dragging brake" and amount < 0.0:
            continue
        causes.append(Cause(what, amount, weight**-0.5, unit, 0.0))
        distances.append(distance)
    order = np.argsort(distances, kind="stable")
    probability = np.exp(-0.5 * (np.array(distances) - distances[order[0]]))
    probability /= probability.sum()
    ranked = [
        Cause(c.what, c.size, c.std, c.unit, float(probability[n]))
        for n, c in ((int(n), causes[int(n)]) for n in order)
    ]
    left = max(len(shifts) - 1, 1)
    fits = float(gammaincc(0.5 * left, 0.5 * distances[order[0]])) > UNEXPLAINED
    others = tuple(each for each in ranked[1:] if each.probability >= PROBABLE)
    return Explanation(ranked[0], others, fits)


def _correlate(covariance: FloatArray, names: list[str], kind: KindResistance) -> None:
    """Errors of the two channels of one curve go together; in place."""
    pair = ("constant resistance", "size of the curve")
    if not set(pair) <= set(names):
        return
    curves, found = kind.curves, kind.effects
    trust = np.linalg.inv(np.median(curves.variances, axis=0) + found.within)
    constant, mean = curves.nodes[:, 0], found.mean
    alike = constant @ trust @ mean
    alike /= np.sqrt((constant @ trust @ constant) * (mean @ trust @ mean))
    one, other = (names.index(each) for each in pair)
    shared = alike * np.sqrt(covariance[one, one] * covariance[other, other])
    covariance[one, other] = covariance[other, one] = 0.999 * shared

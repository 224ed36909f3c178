"""How heavy a train is that its driver never weighed: an interval that shrinks under way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.control.route import value
from analysis.studies.hauck_2023 import dynamics as dynamics
from trainlog.units import GRAVITY

TOLERANCE = 0.015
"""How far measured and modelled acceleration may differ [m/s²]: lag, creep, the rail's bends."""

EXCITATION = 0.25
"""Less acceleration by the effort than this tells nothing of the mass [m/s²]."""

ROTATING = 0.08
"""What rotating parts add to the mass of the motion, at most, as a share of it."""

SETTLING = 3
"""Samples of each window in which the motors still follow the lever."""

STEADY = 0.03
"""How far the lever may move in a window that tells of the mass."""

SLOWEST = 2.0
"""Speed at which a train still tells of its mass: creep takes a share of slower ones [m/s]."""

EVEN = 1.1
"""How far the rail's adhesion may change in a window: wheels gain slip where it falls."""


@dataclass
class ObservedMass:
    """Every mass of the motion, rotating parts included, that agrees with all that was felt.

    Set membership: each observation bounds the mass, and what is left is the intersection. Where
    the observations contradict each other, as when wheels slip, all is open again.

    Attributes
    ----------
    lightest, heaviest : float [kg]
        Before anything was felt.
    low, high : float [kg]
    """

    lightest: float
    heaviest: float
    low: float = 0.0
    high: float = np.inf

    def __post_init__(self) -> None:
        self._forget()

    @property
    def middle(self) -> float:
        """Of the interval [kg]."""
        return 0.5 * (self.low + self.high)

    def observe(self, pull: float, acceleration: float, weight: float) -> bool:
        """Take in what a train did; says whether the interval became smaller.

        Parameters
        ----------
        pull : float [N]
            Effort less the drag of the air; negative in braking.
        acceleration : float [m/s²]
        weight : float [m/s²]
            What gravity and rolling resistance take from every kilogram that does not rotate.
        """
        gained = acceleration + weight
        if abs(gained) < EXCITATION or gained * pull <= 0.0:
            return False
        rotating = ROTATING * self.lightest * np.array([0.0, 1.0])
        found = (pull + rotating[:, None] * weight) / (gained + TOLERANCE * np.array([-1.0, 1.0]))
        low, high = max(self.low, float(found.min())), min(self.high, float(found.max()))
        if low > high:
            self._forget()
            return True
        smaller = low > self.low or high < self.high
        self.low, self.high = low, high
        return smaller

    def _forget(self) -> None:
        self.low, self.high = self.lightest, self.heaviest * (1.0 + ROTATING)


def window(
    past: Sequence[tuple[float, float, float]],
    period: float,
    t: dynamics.Tables,
    c: dynamics.Constants,
) -> tuple[float, float, float] | None:
    """What `ObservedMass.observe` needs from a second under way; None where it tells nothing.

    Parameters
    ----------
    past : sequence of tuple
        Position [m], speed [m/s], and the lever that led there.
    period : float [s]
        Between two samples.
    """
    if len(past) < SETTLING + 2:
        return None
    position, speed, lever = np.array(past).T
    if np.ptp(lever[1:]) > STEADY or speed[-1] < SLOWEST:
        return None
    position, speed, lever = position[SETTLING:], speed[SETTLING:], lever[SETTLING + 1 :]
    grip = [value(t.adhesion, t.origin, p) for p in position]
    if max(grip) > EVEN * min(grip):
        return None
    sine = np.array([value(t.sine, t.origin, p) for p in position])
    weight = GRAVITY * float(np.mean(sine + c.rolling * np.sqrt(1.0 - sine**2)))
    mean = 0.5 * (speed[1:] + speed[:-1])
    effort = lever * (c.k1 * np.exp(-c.k2 * mean) + c.k3)
    pull = float(np.mean(effort - c.drag * mean**2))
    return pull, float(speed[-1] - speed[0]) / (period * len(mean)), weight

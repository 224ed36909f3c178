"""Paper 003 without its knowledge of the rail: learnt while driving, from a map, or assumed.

The paper takes the rail under each axle for known. Here the speeds are measured with noise, and
the controller has what a locomotive could have.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.studies.zhao_2025.controller import coefficients
from analysis.studies.zhao_2025.rail import RailEstimator, rail_ahead
from analysis.studies.zhao_2025.run import (
    AXLES,
    CASES,
    SCARCE,
    SENSIBLE,
    Belief,
    Case,
    Informed,
    Knowledge,
    Noise,
    Preset,
    Run,
    Seen,
    creep_maximum,
    run,
)
from trainlog.errors import InputError
from trainlog.railway import StepProfile
from trainlog.railway.adhesion import DRY, WET, CreepCurve

FloatArray = NDArray[np.float64]

MEASURED = Noise(speed=0.05, wheel_speed=0.02)
"""A radar or satellites for the train speed, a pulse encoder for each wheel [m/s]."""

LEAVES = Case(
    number=5,
    name="leaves on the rail, here and there",
    wet=(),
    fails=False,
    published="",
    places=StepProfile(
        np.array([0.0, 25.0, 37.0, 60.0, 66.0, 90.0, 115.0, 140.0, 152.0]),
        np.array([DRY.peak, 0.10, DRY.peak, 0.08, DRY.peak, 0.12, DRY.peak, 0.08, DRY.peak]),
    ),
)
"""Patches of which some are shorter than the locomotive; not of the paper."""


STEEP = replace(
    CASES[2],
    number=6,
    name="axles 3 and 4 dry, another wet, dry",
    published="",
    wet_curve=CreepCurve(a=0.8, b=3.5, c=0.2935, d=0.2935),
)
"""Case 3 on a wet rail whose peak lies at 0.55 m/s instead of 3 m/s; not of the paper."""


@dataclass
class Learning:
    """The rail is learnt while driving."""

    estimator: RailEstimator

    def belief(self, seen: Seen) -> Belief:
        """What was learnt up to the sample."""
        found = self.estimator.update(seen.speed, seen.wheel_speeds, seen.torques)
        return Belief(found.rail, found.maximum, found.reference)


@dataclass(frozen=True)
class Mapped:
    """A map tells the maximum adhesion ahead."""

    maximum_adhesion: StepProfile
    preset: Preset

    def belief(self, seen: Seen) -> Belief:
        """The map's rail over the horizon."""
        tuning = self.preset.tuning
        ahead = rail_ahead(self.maximum_adhesion, seen.position, seen.speed, AXLES, tuning)
        return Belief(ahead, creep_maximum(*ahead[0].T))


@dataclass(frozen=True)
class Assumed:
    """The rail is taken for one and the same everywhere."""

    curve: CreepCurve

    def belief(self, seen: Seen) -> Belief:
        """That rail under every axle."""
        del seen
        return Belief(coefficients([self.curve] * 4), np.full(4, self.curve.peak))


def mapped(case: Case, preset: Preset) -> Knowledge:
    """What a map of the case's rail tells.

    Raises
    ------
    InputError
        If the rail of the case changes with time: no map holds that.
    """
    if case.places is None:
        raise InputError(f"case {case.number}: its rail changes with time, no map holds that")
    return Mapped(case.places, preset)


KNOWLEDGE: dict[str, Callable[[Case, Preset], Knowledge]] = {
    "known": lambda case, _: Informed(case),
    "map": mapped,
    "learnt": lambda _, preset: Learning(
        RailEstimator(preset.locomotive, preset.tuning, MEASURED.speed, MEASURED.wheel_speed)
    ),
    "taken for dry": lambda *_: Assumed(DRY),
    "taken for wet": lambda *_: Assumed(WET),
}
"""Ways to know the rail."""

UNKNOWN = (CASES[0], CASES[1], LEAVES, STEEP)
"""Cases in which the rail is not known."""

ASKED = (SENSIBLE.locomotive.total_torque, SCARCE)
"""Of all motors together [N m]."""


def by_knowledge(seed: int) -> dict[str, list[Run | None]]:
    """The cases with 85 t and speeds that are measured, by what is known of the rail.

    Parameters
    ----------
    seed : int
        Of the noise.

    Returns
    -------
    dict of str to list of Run or None
        The same runs in the same order; None where no map can hold the rail.
    """
    plans = [(case, total) for total in ASKED for case in UNKNOWN]
    return {name: [driven(name, *plan, seed) for plan in plans] for name in KNOWLEDGE}


def driven(name: str, case: Case, total: float, seed: int) -> Run | None:
    """One run with 85 t and one way to know the rail; see `by_knowledge`."""
    if name == "map" and case.places is None:
        return None
    known = KNOWLEDGE[name](case, SENSIBLE)
    return run(case, SENSIBLE, total, knowledge=known, noise=MEASURED, seed=seed)

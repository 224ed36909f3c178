"""What a controller knows of the rail under each axle: learnt under way, mapped or assumed.

Zhao et al. (2025) take the rail for known; `analysis.control.rail_estimate` learns it. Speeds are
then measured with noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from analysis.control.cooperative import adhesion_at, coefficients, peak_slips
from analysis.control.rail_estimate import RailEstimator, rail_ahead
from analysis.studies.zhao_2025.simulation import (
    AXLES,
    CASES,
    SCARCE,
    SENSIBLE,
    AssumedRail,
    Case,
    KnownRail,
    Measurement,
    Noise,
    Preset,
    RailSource,
    Run,
    run,
)
from trainlog.errors import InputError
from trainlog.railway import StepProfile
from trainlog.railway.adhesion import DRY, WET, CreepCurve

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
class LearntRail:
    """The rail is learnt while driving."""

    estimator: RailEstimator

    def rail(self, measured: Measurement) -> AssumedRail:
        """What was learnt up to the sample."""
        found = self.estimator.update(measured.speed, measured.wheel_speeds, measured.torques)
        return AssumedRail(found.rail, found.maximum, found.reference)


@dataclass(frozen=True)
class MappedRail:
    """A map gives the maximum adhesion ahead."""

    maximum_adhesion: StepProfile
    preset: Preset

    def rail(self, measured: Measurement) -> AssumedRail:
        """The map's rail over the horizon."""
        tuning = self.preset.tuning
        ahead = rail_ahead(self.maximum_adhesion, measured.position, measured.speed, AXLES, tuning)
        return AssumedRail(ahead, adhesion_at(peak_slips(ahead[0]), ahead[0]))


@dataclass(frozen=True)
class UniformRail:
    """The rail is taken for one and the same everywhere."""

    curve: CreepCurve

    def rail(self, measured: Measurement) -> AssumedRail:
        """That rail under every axle."""
        del measured
        return AssumedRail(coefficients([self.curve] * 4), np.full(4, self.curve.peak))


def mapped(case: Case, preset: Preset) -> RailSource:
    """The rail of a case from a map.

    Raises
    ------
    InputError
        If the rail of the case changes with time: no map holds that.
    """
    if case.places is None:
        raise InputError(f"case {case.number}: its rail changes with time, no map holds that")
    return MappedRail(case.places, preset)


RAIL_SOURCES: dict[str, Callable[[Case, Preset], RailSource]] = {
    "known": lambda case, _: KnownRail(case),
    "map": mapped,
    "learnt": lambda _, preset: LearntRail(
        RailEstimator(preset.locomotive, preset.tuning, MEASURED.speed, MEASURED.wheel_speed)
    ),
    "taken for dry": lambda *_: UniformRail(DRY),
    "taken for wet": lambda *_: UniformRail(WET),
}
"""From where a controller may know the rail, by name."""

UNKNOWN = (CASES[0], CASES[1], LEAVES, STEEP)
"""Cases in which the rail is not known."""

ASKED = (SENSIBLE.locomotive.total_torque, SCARCE)
"""Of all motors together [N m]."""


def by_knowledge(name: str, seed: int) -> list[Run | None]:
    """The cases with 85 t and speeds that are measured, by what is known of the rail.

    Parameters
    ----------
    name : str
        One of `RAIL_SOURCES`.
    seed : int
        Of the noise.

    Returns
    -------
    list of Run or None
        None where no map can hold the rail.
    """
    return [driven(name, case, total, seed) for total in ASKED for case in UNKNOWN]


def driven(name: str, case: Case, total: float, seed: int) -> Run | None:
    """One run with 85 t and one way to know the rail; see `by_knowledge`."""
    if name == "map" and case.places is None:
        return None
    known = RAIL_SOURCES[name](case, SENSIBLE)
    return run(case, SENSIBLE, total, knowledge=known, noise=MEASURED, seed=seed)

"""What a controller knows of the rail under each axle: learnt under way, mapped or assumed.

Zhao et al. (2025) take the rail for known; `analysis.control.rail_estimate` learns it. Speeds are
then measured with noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from analysis.control.cooperative import Demand, adhesion_at, coefficients, peak_slips
from analysis.control.multi_motor import MultiMotorLocomotive
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
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway import StepProfile
from trainlog.railway.adhesion import DRY, WET, CreepCurve

BANDWIDTH = 6.0
"""Of a slip controller [rad/s]: of those from 1 to 8 the one that takes a locomotive farthest."""


@dataclass
class NoSlipControl:
    """Every motor has its share of the total and gives it, whatever its wheels do."""

    locomotive: MultiMotorLocomotive

    def torques(self, speed: float, wheel_speeds: FloatArray, demand: Demand) -> FloatArray:
        """Torques until the next sample, (n,) [N m]; see `CooperativeController.torques`."""
        del speed, wheel_speeds
        return _share(demand)


@dataclass
class AxleByAxle:
    """Every motor has its share of the total and a slip controller of its own."""

    locomotive: MultiMotorLocomotive
    period: float

    def __post_init__(self) -> None:
        self._memory = np.zeros(self.locomotive.axles)

    def torques(self, speed: float, wheel_speeds: FloatArray, demand: Demand) -> FloatArray:
        """Torques until the next sample, (n,) [N m]; see `CooperativeController.torques`."""
        error = demand.reference[0] - (wheel_speeds - speed)
        torque, self._memory = _controlled(
            self.locomotive, self.period, error, self._memory, _share(demand)
        )
        return torque


@dataclass
class EqualTorque:
    """All motors get one torque, as from one inverter; the axle that slips most decides on it."""

    locomotive: MultiMotorLocomotive
    period: float

    def __post_init__(self) -> None:
        self._memory = np.zeros(1)

    def torques(self, speed: float, wheel_speeds: FloatArray, demand: Demand) -> FloatArray:
        """Torques until the next sample, (n,) [N m]; see `CooperativeController.torques`."""
        error = demand.reference[0] - (wheel_speeds - speed)
        worst, most = error.min(keepdims=True), _share(demand).min(keepdims=True)
        torque, self._memory = _controlled(self.locomotive, self.period, worst, self._memory, most)
        return np.full(self.locomotive.axles, torque[0])


def _share(demand: Demand) -> FloatArray:
    return np.minimum(demand.total / demand.limits.size, demand.limits)


def _controlled(
    locomotive: MultiMotorLocomotive,
    period: float,
    error: FloatArray,
    memory: FloatArray,
    most: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Proportional and integral control of slip errors [m/s]: torques and memory [N m]."""
    gain = locomotive.effort_per_torque / locomotive.rotating_mass
    proportional = 2.0 * BANDWIDTH / gain * error
    grown = memory + period * BANDWIDTH**2 / gain * error
    torque = np.clip(proportional + grown, 0.0, most)
    # Beyond a limit the memory may only move back.
    outward = (proportional + grown - torque) * error > 0.0
    return np.asarray(torque), np.where(outward, memory, grown)


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

"""What Zhao et al. (2025) is compared with: slip controllers that know nothing of each other.

They are proportional and integral: a wheel under torque is an integrator of slip speed near the
peak of the creep curve, and their gains put both poles at `BANDWIDTH`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.control.cooperative import Demand
from analysis.control.multi_motor import MultiMotorLocomotive
from trainlog.arrays import FloatArray

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

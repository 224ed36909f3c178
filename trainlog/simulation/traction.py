"""Traction control: who gives each powered axle its effort, and what of the train he sees.

By default the plant shares the demand evenly and its compiled slip protection
(`trainlog.simulation.dynamics.protect`) takes the effort off an axle that slips. A controller from
elsewhere takes its place when it implements `TractionControl`: it gets what the drive of a vehicle
measures, at its own period, and gives the effort of each axle. Friction brakes make up for what is
missing of a braking effort.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import NamedTuple, Protocol

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.declaration import NotNegative, check
from trainlog.errors import InputError
from trainlog.simulation.plant import Plant, PlantState


class DriveReading(NamedTuple):
    """What the drive of a train measures at one instant.

    Attributes
    ----------
    time : float [s]
        Since the beginning of the trip.
    position, speed : float [m], [m/s]
        Estimates of the train's.
    wheel_speeds : (n,) array [m/s]
        Circumferential, of the powered axles.
    efforts : (n,) array [N]
        At work at the wheel rims, negative in braking; the motors lag behind their demand.
    tractive_effort, braking_effort : float [N]
        Demanded of the whole train.
    """

    time: float
    position: float
    speed: float
    wheel_speeds: FloatArray
    efforts: FloatArray
    tractive_effort: float
    braking_effort: float


class TractionControl(Protocol):
    """Gives each powered axle its effort."""

    @property
    def name(self) -> str:
        """As it stands in the log."""
        ...

    @property
    def period(self) -> float:
        """Time from one decision to the next [s]."""
        ...

    @property
    def unsolved(self) -> int:
        """Decisions so far for which it had to fall back on something simpler."""
        ...

    def efforts(self, reading: DriveReading) -> FloatArray:
        """Efforts of the axles until the next decision, (n,) [N], negative in braking."""
        ...


@dataclass(frozen=True, slots=True)
class DriveSensors:
    """How well the drive of a train knows its motion.

    Attributes
    ----------
    wheel_speed_noise : float [m/s]
        Of each axle, by a pulse encoder.
    speed_noise : float [m/s]
        Of the train's speed, from axles without motors, radar or satellites, filtered.
    diameter_error : float
        Standard deviation of the diameter of each wheel over the one taken for true.
    position_error : float [m]
        Standard deviation of the position, constant over the trip.
    """

    wheel_speed_noise: NotNegative = 0.01
    speed_noise: NotNegative = 0.03
    diameter_error: NotNegative = 0.001
    position_error: NotNegative = 5.0

    def __post_init__(self) -> None:
        check(self)


@dataclass
class TractionLoop:
    """A traction control at work on a plant.

    Attributes
    ----------
    control : TractionControl
    plant : Plant
    sensors : DriveSensors
    seed : int
        Of the sensors.
    unsolved : list of float [s]
        When the control had to fall back on something simpler.
    steps : int
        Decisions so far.
    late : int
        Of them, those that took longer than the control's period, by the clock on the wall: not
        those of the log, which must be the same on a machine with other work. The first decision
        loads compiled code and does not count.
    longest : float [s]
        The longest decision but the first.

    Raises
    ------
    InputError
        If the control's period is not a multiple of the plant's step.
    """

    control: TractionControl
    plant: Plant
    sensors: DriveSensors = field(default_factory=DriveSensors)
    seed: int = 0
    unsolved: list[float] = field(default_factory=list)
    steps: int = 0
    late: int = 0
    longest: float = 0.0

    def __post_init__(self) -> None:
        step = self.plant.parameters.step
        self._hold = round(self.control.period / step)
        if self._hold < 1 or abs(self._hold * step - self.control.period) > 1e-9:
            raise InputError(
                f"traction control '{self.control.name}': its period of {self.control.period} s is"
                f" not a multiple of the plant's step of {step} s",
                remedy="give a period of whole steps",
            )
        # Numbers of its own: those of the other sensors stay as they are.
        self._random = np.random.default_rng([self.seed, 13])
        n = self.plant.axles
        self._scale = 1.0 + self.sensors.diameter_error * self._random.standard_normal(n)
        self._offset = self.sensors.position_error * float(self._random.standard_normal())
        self._done, self._given = 0, np.zeros(n)

    def advance(
        self,
        state: PlantState,
        demand: tuple[float, float],
        steps: int,
        every: int,
        most_dynamic: float = np.inf,
    ) -> FloatArray:
        """As `Plant.advance`, with the efforts of the control.

        Parameters
        ----------
        state : PlantState
        demand : tuple of float [N]
            Tractive and braking effort of the whole train.
        steps, every : int
        most_dynamic : float [N]
        """
        blocks, left = [], steps
        while left:
            into = self._done % self._hold
            if into == 0:
                self._given = self._decided(state, demand)
            now = min(self._hold - into, left)
            # Only samples on the common grid are kept: not all blocks are as long as `every`.
            each = int(np.gcd(now, every))
            block = self.plant.advance(state, *demand, now, each, self._given, most_dynamic)
            first = steps - left
            blocks.append(block[(first + each * np.arange(len(block))) % every == 0])
            self._done += now
            left -= now
        return np.concatenate(blocks)

    def _decided(self, state: PlantState, demand: tuple[float, float]) -> FloatArray:
        before = self.control.unsolved
        time = self._done * self.plant.parameters.step
        # What the drive measures; what stands is seen to stand.
        sensors, n = self.sensors, self.plant.axles
        noise = self._random.standard_normal(n + 1)
        wheels = state.wheel_speeds
        seen = wheels * self._scale + sensors.wheel_speed_noise * noise[1:]
        speed = max(state.speed + sensors.speed_noise * float(noise[0]), 0.0)
        reading = DriveReading(
            time,
            max(state.position + self._offset, 0.0),
            speed if state.speed > 0.0 else 0.0,
            np.where(wheels > 0.0, np.maximum(seen, 0.0), 0.0),
            state.motor_efforts.copy(),
            *demand,
        )
        begun = perf_counter()
        found = self.control.efforts(reading)
        if self.steps > 0:
            taken = perf_counter() - begun
            self.late += taken > self.control.period
            self.longest = max(self.longest, taken)
        self.steps += 1
        if self.control.unsolved > before:
            self.unsolved.append(time)
        return found


TractionMaker = Callable[[], TractionControl]
"""Makes the traction control of a trip."""

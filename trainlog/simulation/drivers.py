"""Drivers: who asks the train for effort.

A driver is anything with a ``demand`` method: it is shown the train ten times a second and
answers with the efforts it wants. Controllers elsewhere implement the same protocol.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from trainlog.errors import InputError
from trainlog.railway import Line, RunningResistance, Train, Trajectory
from trainlog.units import GRAVITY

FloatArray = NDArray[np.float64]

PERIOD = 0.1
"""Time between two demands of a driver [s]."""

GRID = 5.0
"""Spacing of a driver's route knowledge [m]."""


@dataclass(frozen=True, slots=True)
class Observation:
    """What a driver sees: time since the trip began [s], position [m], speed [m/s] and
    acceleration [m/s²] of the train. What lies ahead he knows from the line.
    """

    time: float
    position: float
    speed: float
    acceleration: float


@dataclass(frozen=True, slots=True)
class Demand:
    """Tractive and braking effort of the whole train [N], both not negative."""

    tractive_effort: float = 0.0
    braking_effort: float = 0.0


class Driver(Protocol):
    """Asks the train for effort."""

    def demand(self, observation: Observation) -> Demand:
        """The efforts wanted until the next observation."""
        ...

    @property
    def finished(self) -> bool:
        """Whether the train stands at its destination."""
        ...


@dataclass(frozen=True, slots=True)
class Stop:
    """A timetabled stop.

    Attributes
    ----------
    station : str
    position : float [m]
        Where the train's front comes to stand.
    arrival, departure : float [s]
        Since the beginning of the trip.
    """

    station: str
    position: float
    arrival: float
    departure: float


@dataclass(frozen=True, slots=True)
class Habits:
    """How one driver drives.

    Attributes
    ----------
    lever : float
        Share of the tractive effort used to accelerate.
    lever_rate : float [1/s]
        How fast the lever is moved.
    margin : float [m/s]
        Kept below the permitted speed.
    deceleration : float [m/s²]
        Of service braking.
    reaction : float [s]
        From seeing to acting.
    coasting : float [m/s]
        Speed given away when coasting before the power is put on again; 0 never coasts.
    coasting_spacing : float [m]
        Distance from one coasting to the next.
    dwell : float [s]
        Shortest time for doors and passengers.
    """

    lever: float = 0.8
    lever_rate: float = 0.25
    margin: float = 0.7
    deceleration: float = 0.6
    reaction: float = 0.8
    coasting: float = 2.5
    coasting_spacing: float = 4000.0
    dwell: float = 30.0


def permitted_speeds(line: Line, train_length: float, grid: FloatArray) -> FloatArray:
    """Permitted speed [m/s] for a whole train, whose rear must also have passed a restriction."""
    edges, values = line.speed_limits.positions, line.speed_limits.values
    ends = np.append(edges[1:], np.inf)
    allowed = np.full(grid.shape, np.inf)
    for start, end, value in zip(edges, ends, values, strict=True):
        touched = (grid >= start) & (grid - train_length < end)
        allowed[touched] = np.minimum(allowed[touched], value)
    return allowed


def braking_ceiling(grid: FloatArray, limits: FloatArray, deceleration: float) -> FloatArray:
    """Highest speed [m/s] at each grid point from which every limit ahead can be kept."""
    energy = limits**2 + 2.0 * deceleration * grid
    reachable = np.minimum.accumulate(energy[::-1])[::-1] - 2.0 * deceleration * grid
    return np.asarray(np.sqrt(np.maximum(reachable, 0.0)))


class TimetableDriver:
    """A driver at the lever: timetable in hand, route known, with habits of his own.

    He accelerates with his lever habit, keeps a margin below the limits, coasts now and then,
    brakes in time for lower limits and for his stops, corrects by feel, reacts late by his
    reaction time, and when early drives more slowly.

    Parameters
    ----------
    line : Line
        As travelled.
    train : Train
    stops : sequence of Stop
        In order; the first is where the train stands, the last its destination.
    habits : Habits
    mass : float [kg], optional
        What the train's load-dependent brake weighs; default: the empty train.

    Raises
    ------
    InputError
        If there are fewer than two stops, or one lies beyond the line, or they are out of order.
    """

    def __init__(
        self,
        line: Line,
        train: Train,
        stops: tuple[Stop, ...],
        habits: Habits | None = None,
        mass: float | None = None,
    ) -> None:
        check_stops(line, stops)
        self.habits = habits or Habits()
        self.train = train
        self.stops = stops
        self.inertia = (train.mass if mass is None else mass) + train.rotating_mass
        self.mass = train.mass if mass is None else mass
        grid = np.arange(0.0, line.length + 2.0 * GRID, GRID)
        limits = np.minimum(permitted_speeds(line, train.length, grid), train.max_speed)
        self._limits = limits
        self._ceiling = braking_ceiling(
            grid, np.maximum(limits - self.habits.margin, 1.0), self.habits.deceleration
        )
        self._slope = line.track_acceleration(np.minimum(grid, line.length))
        self._time_to_go = self._running_times(grid)
        self._leg = 0
        self._lever = 0.0
        self._wanted = 0.0
        self._decided = -math.inf
        self._integral = 0.0
        self._coasting_until: float | None = None
        self._next_coasting = stops[0].position + self.habits.coasting_spacing
        self._braking = False
        self._standing_since: float | None = 0.0

    @property
    def finished(self) -> bool:
        """Whether the train stands at its destination."""
        return self._leg == len(self.stops) - 1

    def demand(self, observation: Observation) -> Demand:
        """The efforts wanted now."""
        if self._standing_since is not None and not self._departs(observation):
            self._lever = 0.0
            return Demand(0.0, 0.4 * self.inertia)
        stop = self.stops[self._leg + 1]
        distance = stop.position - observation.position
        if observation.speed < 0.02 and distance < 3.0:
            self._arrive(observation.time)
            return Demand(0.0, 0.4 * self.inertia)
        stopping = self._stopping_deceleration(observation, distance)
        if stopping > 0.0:
            return self._brake(observation, stopping)
        if observation.time - self._decided >= self.habits.reaction:
            self._decided = observation.time
            self._wanted = self._decide(observation, distance)
        change = self.habits.lever_rate * PERIOD
        if self._wanted < 0.0 and self._lever > 0.0:
            change *= 3.0
        self._lever += min(max(self._wanted - self._lever, -change), change)
        if self._lever >= 0.0:
            return Demand(self._lever * self._traction(observation.speed), 0.0)
        return Demand(0.0, -self._lever * self.train.max_deceleration * self.inertia)

    def _traction(self, speed: float) -> float:
        """Tractive effort of the full lever [N]."""
        train = self.train
        return min(train.max_tractive_effort, train.max_traction_power / max(speed, 0.1))

    def _departs(self, seen: Observation) -> bool:
        since = self._standing_since
        stop = self.stops[self._leg]
        if self.finished or since is None:
            return False
        dwell = self.habits.dwell if self._leg else 0.0
        if seen.time < max(stop.departure, since + dwell):
            return False
        self._standing_since = None
        self._wanted = self._integral = 0.0
        self._decided = seen.time
        self._next_coasting = seen.position + self.habits.coasting_spacing
        return True

    def _arrive(self, time: float) -> None:
        self._leg += 1
        self._standing_since = time
        self._lever = 0.0
        self._braking = False
        self._coasting_until = None

    def _stopping_deceleration(self, seen: Observation, distance: float) -> float:
        """Deceleration [m/s²] that the next stop asks for now; 0 while there is still time."""
        brake = self.train.brake
        lead = brake.dead_time + brake.lag if not self._braking else 0.0
        left = max(distance - 0.3 - seen.speed * lead, 0.05)
        needed = 0.5 * seen.speed**2 / left
        if not self._braking and needed < self.habits.deceleration:
            return 0.0
        self._braking = True
        # A light touch at the end, and no creeping in: below walking pace let it roll.
        if needed < 0.5 * self.habits.deceleration and distance > 5.0 and seen.speed < 8.0:
            self._braking = False
            return 0.0
        return min(needed, 1.2 * self.train.max_deceleration)

    def _brake(self, seen: Observation, deceleration: float) -> Demand:
        """Braking effort for a deceleration, the gradient known, corrected by feel."""
        index = int(seen.position / GRID)
        effort = self.inertia * deceleration - self.mass * float(self._slope[index])
        missing = deceleration + seen.acceleration
        self._integral = min(max(self._integral + 0.3 * missing * PERIOD, -0.2), 0.4)
        effort += self.inertia * (self._integral + 0.2 * missing)
        target = -max(effort, 0.0) / (self.train.max_deceleration * self.inertia)
        change = 4.0 * self.habits.lever_rate * PERIOD
        self._lever += min(max(target - self._lever, -change), change)
        self._lever = min(self._lever, 0.0) if seen.speed < 30.0 else self._lever
        if self._lever > 0.0:
            return Demand(self._lever * self._traction(seen.speed), 0.0)
        return Demand(0.0, -self._lever * self.train.max_deceleration * self.inertia)

    def _decide(self, seen: Observation, distance: float) -> float:
        """Where the lever should go: traction positive, braking negative."""
        habits = self.habits
        speed = seen.speed
        index = min(int(seen.position / GRID), self._ceiling.size - 2)
        ahead = min(
            int((seen.position + speed * (habits.reaction + 1.5)) / GRID), self._ceiling.size - 1
        )
        ceiling = min(float(self._ceiling[index]), float(self._ceiling[ahead]))
        here = float(self._limits[index]) - habits.margin
        target = min(ceiling, max(here * self._pace(seen), 5.0))
        slope = float(self._slope[index])
        resistance = self.train.resistance
        holding = resistance.r0 + (resistance.r1 + resistance.r2 * speed) * speed
        holding += self.mass * slope
        over = speed - ceiling
        if over > 0.3 or (over > -0.2 and ceiling < here - 0.1):
            # Braking for a lower limit or on a falling gradient.
            wanted = habits.deceleration if ceiling < here - 0.1 else 0.5 * over
            effort = self.inertia * (wanted + 0.4 * over) - holding
            self._integral = 0.0
            return min(-max(effort, 0.0) / (self.train.max_deceleration * self.inertia), 0.0)
        if self._coasts(seen, target, distance):
            return 0.0
        missing = target - speed
        if missing > 2.0:
            self._integral = 0.0
            return habits.lever
        self._integral = min(max(self._integral + 0.02 * missing * habits.reaction, -0.1), 0.2)
        effort = holding + self.inertia * (0.15 * missing + self._integral)
        if effort >= 0.0:
            lever = min(effort / self._traction(speed), habits.lever)
            return lever if abs(lever - self._lever) > 0.03 else self._lever
        if missing > 0.5:
            return 0.0
        return max(effort / (self.train.max_deceleration * self.inertia), -0.5)

    def _coasts(self, seen: Observation, target: float, distance: float) -> bool:
        """Whether he lets the train roll: now and then, and before a stop."""
        habits = self.habits
        if habits.coasting <= 0.0:
            return False
        if self._coasting_until is not None:
            if seen.speed > self._coasting_until and seen.speed > 0.5 * target:
                return True
            self._coasting_until = None
            self._next_coasting = seen.position + habits.coasting_spacing
            return False
        braking_distance = 0.5 * seen.speed**2 / habits.deceleration
        near_stop = distance < braking_distance + 250.0 * habits.coasting
        at_speed = seen.speed > target - 1.0
        if near_stop and seen.speed > 12.0 and seen.speed > target - 4.0 * habits.coasting:
            return True
        if at_speed and seen.speed > 12.0 and seen.position > self._next_coasting:
            self._coasting_until = seen.speed - habits.coasting
            return True
        return False

    def _pace(self, seen: Observation) -> float:
        """Share of the permitted speed he drives at: less when early, all of it when late."""
        stop = self.stops[self._leg + 1]
        index = min(int(seen.position / GRID), self._time_to_go.size - 1)
        last = min(int(stop.position / GRID), self._time_to_go.size - 1)
        to_go = float(self._time_to_go[index] - self._time_to_go[last])
        spare = stop.arrival - seen.time - to_go - 15.0
        if to_go <= 0.0 or spare <= 0.0:
            return 1.0
        return max(to_go / (to_go + spare), 0.85)

    def _running_times(self, grid: FloatArray) -> FloatArray:
        """Time from each grid point to the line's end at the ceiling speed [s]."""
        pace = np.maximum(self._ceiling, 3.0)
        step = GRID / (0.5 * (pace[1:] + pace[:-1]))
        return np.concatenate((np.cumsum(step[::-1])[::-1], [0.0]))


class TrajectoryDriver:
    """Follows a robust trajectory: common traction by position, the brake closes the loop.

    Parameters
    ----------
    trajectory : Trajectory
    row : int
        The configuration that the train is in.

    Raises
    ------
    InputError
        If the trajectory has no such row.
    """

    def __init__(self, trajectory: Trajectory, row: int) -> None:
        if not 0 <= row < len(trajectory.configurations):
            raise InputError(
                f"trajectory has no configuration number {row}",
                remedy=f"it has {len(trajectory.configurations)}, counted from 0",
            )
        self.trajectory = trajectory
        self.row = row
        self.inertia = trajectory.configurations[row].inertia
        self._positions = trajectory.positions
        self._squares = trajectory.speeds[row] ** 2
        self._end = float(trajectory.positions[-1])
        self._arrived = False

    @property
    def finished(self) -> bool:
        """Whether the train stands at the trajectory's end."""
        return self._arrived

    def demand(self, observation: Observation) -> Demand:
        """The efforts wanted now."""
        distance = self._end - observation.position
        if self._arrived or (observation.speed < 0.02 and distance < 3.0):
            self._arrived = True
            return Demand(0.0, 0.4 * self.inertia)
        positions = self._positions
        cell = int(np.searchsorted(positions, observation.position, side="right")) - 1
        cell = min(max(cell, 0), positions.size - 2)
        traction = float(self.trajectory.tractive_effort[cell])
        braking = float(self.trajectory.braking_effort[self.row, cell])
        share = (observation.position - positions[cell]) / (positions[cell + 1] - positions[cell])
        square = self._squares[cell] + min(max(share, 0.0), 1.0) * (
            self._squares[cell + 1] - self._squares[cell]
        )
        over = observation.speed - math.sqrt(max(float(square), 0.0))
        if braking > 0.0 or over > 0.15:
            braking += self.inertia * 0.5 * over
            traction = 0.0 if braking > 0.0 else traction
        return Demand(traction, max(braking, 0.0))


def check_stops(line: Line, stops: tuple[Stop, ...]) -> None:
    """Refuse stops that no train can make.

    Raises
    ------
    InputError
    """
    if len(stops) < 2:
        raise InputError(f"line '{line.name}': a trip needs two stops at least")
    for stop in stops:
        if not 0.0 <= stop.position <= line.length:
            raise InputError(
                f"line '{line.name}': stop '{stop.station}' at km {stop.position / 1e3:.3f} lies"
                f" beyond the line's end at km {line.length / 1e3:.3f}"
            )
        if stop.departure < stop.arrival:
            raise InputError(f"stop '{stop.station}': departure is before arrival")
    for first, second in zip(stops, stops[1:], strict=False):
        if second.position <= first.position or second.arrival <= first.departure:
            raise InputError(
                f"stops '{first.station}' and '{second.station}' are not in the order of travel"
            )


def nominal_deceleration(resistance: RunningResistance, speed: float, mass: float) -> float:
    """Deceleration of a rolling train on level track [m/s²]."""
    return float(resistance(speed)) / (mass * GRAVITY) * GRAVITY

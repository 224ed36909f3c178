"""Drivers: who asks the train for effort.

A driver is anything with a ``demand`` method: it is shown the train ten times a second and
answers with the efforts it wants. Controllers elsewhere implement the same protocol.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway import Line, Station, Train
from trainlog.railway.motion import braking_curve, timetable_run
from trainlog.simulation.plant import HOLDING

GRID = 5.0
"""Spacing of a driver's route knowledge [m]."""

COUNTED_ON = 0.9
"""Of full service braking a driver counts on at most so much, whatever his habit."""

PERIOD = 0.1
"""Time between two demands of a driver [s]."""

DEPARTURE = 5.0
"""When a train that follows a trajectory departs, after the beginning of the trip [s]."""

AT_REST = 0.02
"""Below this speed [m/s] a train counts as standing."""

STOPPING_ERROR = 3.0
"""A train that stands within this distance [m] of its stop has arrived."""


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


def check_stops(line: Line, stops: tuple[Stop, ...]) -> None:
    """Refuse stops that no train can make.

    Raises
    ------
    InputError
        If there are fewer than two, one lies beyond the line, or they are out of order.
    """
    if len(stops) < 2:
        raise InputError(
            f"line '{line.name}': a trip needs two stops at least",
            remedy="name a departure and an arrival",
        )
    for stop in stops:
        if not 0.0 <= stop.position <= line.length:
            raise InputError(
                f"line '{line.name}': stop '{stop.station}' at km {stop.position / 1e3:.3f} lies"
                f" beyond the line's end at km {line.length / 1e3:.3f}",
                remedy="give stops on the line",
            )
        if stop.departure < stop.arrival:
            raise InputError(
                f"stop '{stop.station}': departure is before arrival", remedy="exchange its times"
            )
    for first, second in pairwise(stops):
        if second.position <= first.position or second.arrival <= first.departure:
            raise InputError(
                f"stops '{first.station}' and '{second.station}' are not in the order of travel",
                remedy="order the stops as they are passed",
            )


def plan(
    line: Line,
    train: Train,
    stations: tuple[Station, ...],
    *,
    reserve: float = 0.1,
    dwell: float = 42.0,
    first_departure: float = 15.0,
) -> tuple[Stop, ...]:
    """A timetable: shortest running times with a reserve, rounded up to tenths of a minute.

    Parameters
    ----------
    line : Line
        As travelled.
    stations : tuple of Station
        Where the train stops, both ends included.
    reserve : float
        Added to the shortest running time, as a share of it.
    dwell : float [s]
        Planned at each stop between the ends.
    first_departure : float [s]
        After the beginning of the trip.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.formats.railway import read_train
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> [round(stop.arrival) for stop in plan(line, train, line.stations)]
    [0, 375, 639, 945, 1401]
    """
    stops = [Stop(stations[0].name, stations[0].position, 0.0, first_departure)]
    for station in stations[1:]:
        shortest = timetable_run(line, train, stops[-1].position, station.position).running_time
        arrival = stops[-1].departure + 6.0 * math.ceil(shortest * (1.0 + reserve) / 6.0)
        stops.append(Stop(station.name, station.position, arrival, arrival + dwell))
    return tuple(stops)


class Observation(NamedTuple):
    """What a driver sees of the train; what lies ahead he knows from the line.

    Attributes
    ----------
    time : float [s]
        Since the beginning of the trip.
    position : float [m]
    speed : float [m/s]
    acceleration : float [m/s²]
    position_std, speed_std : float [m], [m/s]
        How well they are known; 0 where they are the true ones.
    """

    time: float
    position: float
    speed: float
    acceleration: float
    position_std: float = 0.0
    speed_std: float = 0.0


class Demand(NamedTuple):
    """Tractive and braking effort of the whole train [N], both not negative.

    Of the braking effort the dynamic brake gives as much as it can up to `most_dynamic` [N], the
    friction brake the rest.
    """

    tractive_effort: float = 0.0
    braking_effort: float = 0.0
    most_dynamic: float = math.inf


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
        From one look at the speed to the next.
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


def full_traction(train: Train, power: float, speed: float) -> float:
    """Tractive effort of the full lever [N] of a train with so much power [W] at a speed [m/s]."""
    most = min(train.max_tractive_effort, power / max(speed, 0.1))
    curve = train.traction_curve
    return most if curve is None else min(most, float(curve(speed)))


class Lever:
    """The lever of traction and brake: 1 is full traction, -1 full braking; 0 where it begins."""

    def __init__(self) -> None:
        self.position = 0.0

    def moved(self, target: float, rate: float, traction: float, braking: float) -> Demand:
        """What it asks for when it has moved towards a target for `PERIOD`.

        Parameters
        ----------
        target : float
        rate : float [1/s]
            How fast it moves.
        traction, braking : float [N]
            Efforts at its ends.
        """
        change = rate * PERIOD
        self.position += min(max(target - self.position, -change), change)
        return Demand(max(self.position, 0.0) * traction, max(-self.position, 0.0) * braking)


class StoppingBrake:
    """Brakes to a stop at a point, as drivers and automatic train operation do.

    It asks for the deceleration ``v²/(2 d)`` that the remaining distance `d` needs now, knows the
    gradient, and corrects what the train gives less or more.

    Parameters
    ----------
    mass, inertia : float [kg]
        Without and with the rotating part.
    slope : (n,) array [m/s²]
        Deceleration by the track every `GRID` metres.
    largest : float [m/s²]
        Largest deceleration asked for.
    short : float [m]
        Aimed short of the place by this much: nobody wants to stand beyond the signal.
    """

    def __init__(
        self, mass: float, inertia: float, slope: FloatArray, largest: float, short: float
    ) -> None:
        self._mass = mass
        self._inertia = inertia
        self._slope = slope
        self._largest = largest
        self._short = short
        self._correction = 0.0

    def reset(self) -> None:
        """Forget the correction of the last stop."""
        self._correction = 0.0

    def needed(self, seen: Observation, distance: float, lead: float = 0.0) -> float:
        """Deceleration [m/s²] that stops the train `distance` ahead, acting after `lead` [s]."""
        return 0.5 * seen.speed**2 / max(distance - self._short - seen.speed * lead, 0.05)

    def effort(self, seen: Observation, deceleration: float) -> float:
        """Braking effort [N] for a deceleration [m/s²]."""
        if seen.speed < 1.0:
            # A light touch at the end: what little is left needs no more.
            return self._inertia * min(deceleration, 0.5)
        wanted = min(deceleration, self._largest)
        missing = wanted + seen.acceleration
        self._correction = min(max(self._correction + 0.3 * missing * PERIOD, -0.2), 0.4)
        along = self._mass * float(
            self._slope[min(int(seen.position / GRID), len(self._slope) - 1)]
        )
        effort = self._inertia * (wanted + self._correction + 0.2 * missing) - along
        return min(max(effort, 0.0), self._inertia * self._largest)


class TimetableDriver:
    """A driver at the lever: timetable in hand, route known, with habits of his own.

    He accelerates with his lever habit, keeps a margin below the limits, coasts now and then,
    brakes in time for lower limits and for his stops, looks at the speed once in his reaction
    time, and when early drives more slowly.

    Parameters
    ----------
    line : Line
        As travelled.
    train : Train
    stops : tuple of Stop
        In order; the first is where the train stands, the last its destination.
    habits : Habits, optional
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
        habits = habits or Habits()
        most = COUNTED_ON * train.max_deceleration
        self.habits = replace(habits, deceleration=min(habits.deceleration, most))
        self.train = train
        self.stops = stops
        self.mass = train.mass if mass is None else mass
        self.inertia = self.mass + train.rotating_mass
        grid = np.arange(0.0, line.length + 2.0 * GRID, GRID)
        limits = np.minimum(line.limits_over(train.length)(grid), train.max_speed)
        self._limits = limits
        self._ceiling = braking_curve(
            grid, np.maximum(limits - self.habits.margin, 1.0), self.habits.deceleration
        )
        self._slope = line.track_acceleration(np.minimum(grid, line.length), train.strip_length)
        # Time [s] from each grid point to the line's end at the ceiling speed.
        lasting = GRID / (0.5 * (self._ceiling[1:] + self._ceiling[:-1]))
        self._time_to_end = np.append(np.cumsum(lasting[::-1])[::-1], 0.0)
        self._brake = StoppingBrake(
            self.mass, self.inertia, self._slope, train.max_deceleration, short=0.3
        )
        self._leg = 0
        self._lever = Lever()
        self._wanted = 0.0
        self._looked = -math.inf
        self._integral = 0.0
        self._coasting_down_to: float | None = None
        self._next_coasting = 0.0
        self._stopping = False
        self._standing_since: float | None = 0.0

    @property
    def finished(self) -> bool:
        """Whether the train stands at its destination."""
        return self._leg == len(self.stops) - 1

    def demand(self, observation: Observation) -> Demand:
        """The efforts wanted now."""
        if self._standing_since is not None and not self._departs(observation):
            return Demand(0.0, HOLDING * self.mass)
        distance = self.stops[self._leg + 1].position - observation.position
        if observation.speed < AT_REST and distance < STOPPING_ERROR:
            self._leg += 1
            self._standing_since = observation.time
            self._lever.position = 0.0
            return Demand(0.0, HOLDING * self.mass)
        usual = self.habits.deceleration
        if self._stopping:
            # Too early after all: let go, roll on, and brake again when it is time.
            rolls_on = self._brake.needed(observation, distance) < 0.4 * usual and distance > 5.0
            self._stopping = not rolls_on
        else:
            lead = self.train.brake.dead_time + self.train.brake.lag
            self._stopping = self._brake.needed(observation, distance, lead) > usual
            if self._stopping:
                self._brake.reset()
        if self._stopping:
            needed = self._brake.needed(observation, distance)
            effort = self._brake.effort(observation, needed)
            return self._moved(-self._share(effort), 1.0, observation.speed)
        if observation.time - self._looked >= self.habits.reaction:
            self._looked = observation.time
            self._wanted = self._decide(observation, distance)
        released = self._wanted < 0.0 < self._lever.position
        return self._moved(
            self._wanted, self.habits.lever_rate * (3.0 if released else 1.0), observation.speed
        )

    def _moved(self, target: float, rate: float, speed: float) -> Demand:
        braking = self.train.max_deceleration * self.inertia
        return self._lever.moved(target, rate, self._traction(speed), braking)

    def _traction(self, speed: float) -> float:
        """Tractive effort of the full lever [N]."""
        return full_traction(self.train, self.train.max_traction_power, speed)

    def _share(self, braking_effort: float) -> float:
        """A braking effort [N] as a share of full service braking."""
        return braking_effort / (self.train.max_deceleration * self.inertia)

    def _departs(self, seen: Observation) -> bool:
        since = self._standing_since
        if self.finished or since is None:
            return False
        dwell = self.habits.dwell if self._leg else 0.0
        if seen.time < max(self.stops[self._leg].departure, since + dwell):
            return False
        self._standing_since = None
        self._stopping = False
        self._wanted = self._integral = 0.0
        self._looked = -math.inf
        self._coasting_down_to = None
        self._next_coasting = seen.position + self.habits.coasting_spacing
        return True

    def _decide(self, seen: Observation, distance: float) -> float:
        """Where the lever should go: traction positive, braking negative."""
        habits = self.habits
        speed = seen.speed
        index = min(int(seen.position / GRID), self._ceiling.size - 1)
        reach = seen.position + speed * (habits.reaction + 1.5)
        ahead = min(int(reach / GRID), self._ceiling.size - 1)
        ceiling = min(float(self._ceiling[index]), float(self._ceiling[ahead]))
        free = float(self._limits[index]) - habits.margin
        target = min(ceiling, max(free * self._pace(seen), 5.0))
        holding = float(self.train.resistance(speed))
        holding += self.mass * float(self._slope[index])
        over = speed - ceiling
        restricted = ceiling < free - 0.1
        if over > 0.3 or (restricted and over > -0.2):
            self._integral = 0.0
            wanted = (habits.deceleration if restricted else 0.5 * over) + 0.4 * over
            return -self._share(max(self.inertia * wanted - holding, 0.0))
        if self._coasts(seen, target, distance):
            return 0.0
        if distance < 100.0:
            # Close to the stop no more than it takes to move up.
            target = min(target, math.sqrt(habits.deceleration * max(distance, 0.0)))
        missing = target - speed
        if missing > 2.0:
            self._integral = 0.0
            return habits.lever
        self._integral = min(max(self._integral + 0.02 * missing * habits.reaction, -0.1), 0.2)
        effort = holding + self.inertia * (0.15 * missing + self._integral)
        if effort >= 0.0:
            lever = min(effort / self._traction(speed), habits.lever)
            here = self._lever.position
            return lever if abs(lever - here) > 0.03 else here
        return 0.0 if missing > 0.5 else -self._share(-effort)

    def _coasts(self, seen: Observation, target: float, distance: float) -> bool:
        """Whether he lets the train roll: now and then, and before a stop."""
        habits = self.habits
        speed = seen.speed
        if habits.coasting <= 0.0 or speed < 12.0:
            return False
        if self._coasting_down_to is not None:
            if speed > max(self._coasting_down_to, 0.5 * target):
                return True
            self._coasting_down_to = None
            self._next_coasting = seen.position + habits.coasting_spacing
            return False
        braking_distance = 0.5 * speed**2 / habits.deceleration
        if distance < braking_distance + 250.0 * habits.coasting:
            return speed > target - 4.0 * habits.coasting
        if speed > target - 1.0 and seen.position > self._next_coasting:
            self._coasting_down_to = speed - habits.coasting
            return True
        return False

    def _pace(self, seen: Observation) -> float:
        """Share of the permitted speed he drives at: less when early, all of it when late."""
        stop = self.stops[self._leg + 1]
        last = self._time_to_end.size - 1
        here, there = (min(int(s / GRID), last) for s in (seen.position, stop.position))
        cruising = float(self._ceiling[here])
        to_go = float(self._time_to_end[here] - self._time_to_end[there])
        to_go += 0.5 * cruising / self.habits.deceleration
        to_go += max(cruising - seen.speed, 0.0) ** 2 / cruising
        spare = stop.arrival - seen.time - to_go
        return 1.0 if spare <= 0.0 else max(to_go / (to_go + spare), 0.85)

"""A driver who does what the rows of the advice say, as well as a person can.

He reads a row at its place, looks at the speedometer now and then, leaves a speed alone that is
near the one advised, and reads all speeds with an error. He knows the rows, the limits of the line
and, at the lever, what the train needs to hold a speed; he knows neither the plan nor the
configuration. Without reaction, dead band and error he follows the advice to the letter.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from analysis.control.follow import ARRIVING, STOPPING_TOLERANCE, run_of
from analysis.trajectory.advice import limits_of
from analysis.trajectory.instructions import Instruction, Phase, instructions
from trainlog.declaration import NotNegative, Positive, check
from trainlog.railway import Configuration, Line, Train, Trajectory
from trainlog.railway.motion import braking_curve
from trainlog.simulation import simulate, trajectory_scenarios
from trainlog.simulation.drivers import (
    AT_REST,
    DEPARTURE,
    GRID,
    PERIOD,
    Demand,
    Lever,
    Observation,
    StoppingBrake,
    full_traction,
)
from trainlog.simulation.plant import HOLDING
from trainlog.trip import Trip
from trainlog.units import KMH

SETTLING = 3.0
"""Time within which a speed that is off is brought back [s]."""

STARTING = 0.3
"""Acceleration [m/s²] with which a train moves on that has come to a stand on its way."""

EARLY = 0.3
"""Deceleration [m/s²] from which a driver brakes for a speed not to exceed further on."""

BRAKE_RATE = 1.0
"""How fast the lever moves at least in braking for a stop [1/s]."""

NEARLY = 0.25
"""Part of the dead band within which a speed is brought back."""

SHORT = 0.15
"""Aimed short of the stop by this much [m]."""


@dataclass(frozen=True, slots=True)
class Attention:
    """How well a driver follows.

    Attributes
    ----------
    reaction : float [s]
        From one look at table and speedometer to the next.
    dead_band : float [m/s]
        A speed that is off by no more is left as it is.
    reading_std : float [m/s]
        Standard deviation of the error of the speedometer as he reads it, the same for a trip.
    lever_rate : float [1/s]
        How fast the lever moves, in parts of its way.

    Examples
    --------
    >>> Attention(reaction=-1.0)
    Traceback (most recent call last):
    trainlog.errors.InputError: reaction: -1.0 is negative; give 0 or more
    """

    reaction: NotNegative = 2.0
    dead_band: NotNegative = 2.0 / KMH
    reading_std: NotNegative = 1.0 / KMH
    lever_rate: Positive = 0.25

    def __post_init__(self) -> None:
        check(self)


EXACT = Attention(0.0, 0.0, 0.0, math.inf)
"""To the letter."""


class AdvisedDriver:
    """Drives by the rows of an advice; a `trainlog.simulation.drivers.Driver`.

    Parameters
    ----------
    trajectory : Trajectory
        From standstill to standstill.
    line : Line
        In the direction of travel.
    train : Train
    attention : Attention
    seed : int
        Of the error with which he reads speeds.

    Raises
    ------
    InputError
        See `analysis.control.follow.run_of`; or the trajectory does not come from `optimise`.

    Examples
    --------
    >>> from analysis import OptimiserOptions, TrajectoryProblem, optimise
    >>> from trainlog import Configuration, read_line, read_train
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> problem = TrajectoryProblem(line, train, [Configuration.of(train)], end=2_500.0)
    >>> plan = optimise(problem, OptimiserOptions(cells=80))
    >>> AdvisedDriver(plan, line, train).demand(Observation(6.0, 0.0, 0.0, 0.0)).braking_effort
    0.0
    """

    def __init__(
        self,
        trajectory: Trajectory,
        line: Line,
        train: Train,
        *,
        attention: Attention = EXACT,
        seed: int = 1,
    ) -> None:
        run = run_of(trajectory, line, train)
        limits = limits_of(trajectory, line)
        self.attention, self.train = attention, train
        self._rows = instructions(trajectory, limits)
        self._end = float(trajectory.positions[-1])
        # What the lever does: as on the train that arrives last.
        self._felt: Configuration = trajectory.configurations[trajectory.latest]
        grid = np.arange(0.0, line.length + 2.0 * GRID, GRID)
        within = np.minimum(grid, line.length)
        self._slope = line.track_acceleration(within, train.strip_length)
        self._hardest = min(
            0.9 * train.max_deceleration, train.max_braking_effort / self._felt.inertia
        )
        # Limits are known by heart; who reads too low a speed keeps them by the train protection.
        self._ceiling = braking_curve(grid, run.permitted_speed(within), 0.8 * self._hardest)
        self._brake = StoppingBrake(
            self._felt.mass, self._felt.inertia, self._slope, self._hardest, SHORT
        )
        # Until half of the traction is gone.
        self._eases_in = max(attention.reaction + 0.5 / attention.lever_rate, 1e-3)
        # Until half of the brake acts.
        self._brakes_in = train.brake.dead_time + train.brake.lag + 0.5 / attention.lever_rate
        random = np.random.default_rng([seed, 11])
        self._error = attention.reading_std * float(random.standard_normal())
        self._row, self._lever = self._rows[0], Lever()
        self._wanted: float | None = 0.0
        self._looked, self._stopping, self._arrived = -math.inf, False, False
        self._corrects = True

    @property
    def finished(self) -> bool:
        """Whether the train stands at the end of the advice."""
        return self._arrived

    def demand(self, observation: Observation) -> Demand:
        """The efforts wanted now."""
        seen = observation
        left = self._end - seen.position
        if seen.speed < ARRIVING and left <= STOPPING_TOLERANCE:
            self._arrived = True
        if self._arrived or seen.time < DEPARTURE - 1e-9:
            return Demand(0.0, HOLDING * self._felt.mass)
        if seen.time - self._looked >= self.attention.reaction - 1e-6:
            self._look(seen)
        if self._stops(seen, left):
            effort = -self._brake.effort(seen, self._brake.needed(seen, left))
            return self._moved(effort, seen.speed, max(self.attention.lever_rate, BRAKE_RATE))
        if self._wanted is None:
            return self._moved(0.0, seen.speed, self.attention.lever_rate)
        effort = self._felt.inertia * self._wanted + self._needed(seen)
        return self._moved(effort, seen.speed, self.attention.lever_rate)

    def _look(self, seen: Observation) -> None:
        """Read the table and the speedometer, and decide on an acceleration."""
        self._looked = seen.time
        # He reads a row before its place, and acts as often early as late; a brake takes its time.
        place = seen.position + 0.5 * self.attention.reaction * seen.speed
        soon = place + self._brakes_in * seen.speed
        rows = [
            each
            for each in self._rows
            if each.position <= (soon if each.phase > Phase.COASTING else place) + 1e-6
        ]
        row = rows[-1] if rows else self._rows[0]
        self._corrects |= row is not self._row
        self._row = row
        speed = max(seen.speed + self._error, 0.0)
        rolls = -self._needed(seen) / self._felt.inertia
        asked, most = self._asked(row, seen.position, speed), self._most(row, seen, speed)
        if asked is not None and asked < 0.0 and not row.hold:
            asked = min(asked, rolls)
        self._wanted = asked if asked is None else min(asked, most)
        if asked is None and rolls > most:
            self._wanted = most

    def _asked(self, row: Instruction, place: float, speed: float) -> float | None:
        """The acceleration that a row asks for [m/s²]; None: no effort at all."""
        if speed < 0.5 and place < self._end - STOPPING_TOLERANCE:
            return STARTING
        off = row.target - speed
        # A speed that he has begun to correct he brings to that of the row.
        enough = self.attention.dead_band * (NEARLY if self._corrects else 1.0)
        self._corrects = abs(off) > enough
        towards = off / SETTLING if self._corrects else 0.0
        ahead = (row.target**2 - speed**2) / (2.0 * max(row.by - place, 0.5))
        if row.hold:
            return towards
        if row.phase is Phase.MAXIMUM_TRACTION:
            return off / self._eases_in if off > enough else towards
        if row.phase is Phase.CRUISING:
            return ahead
        if row.phase is Phase.COASTING:
            short = self._lowest(row, place) - self.attention.dead_band - 0.5 / KMH - speed
            return STARTING if short > 0.0 else None
        return ahead if off < 0.0 else None

    def _lowest(self, row: Instruction, place: float) -> float:
        """Speed [m/s] below which a train that coasts does not fall, by the row at its place."""
        turn = bisect.bisect_right(row.turns, place)
        if not 0 < turn < len(row.turns) or row.course[turn] > row.course[turn - 1]:
            return 0.0
        return row.course[turn]

    def _most(self, row: Instruction, seen: Observation, speed: float) -> float:
        """The largest acceleration below the limits, and the speeds not to exceed of a row."""
        ahead = seen.position + seen.speed * (self.attention.reaction + self._brakes_in + PERIOD)
        places = np.minimum([seen.position / GRID + 1, ahead / GRID + 1], self._ceiling.size - 1)
        ceiling = float(self._ceiling[places.astype(np.int64)].min())
        below = ceiling - speed
        most = below / (self._eases_in if below > 0.5 else SETTLING)
        for cap in row.caps:
            away = cap.start - seen.position
            if away <= 0.0 <= cap.end - seen.position:
                most = min(most, (cap.speed - speed) / SETTLING)
            elif away > 0.0 and speed > cap.speed:
                needed = (cap.speed**2 - speed**2) / (2.0 * away)
                most = min(most, needed) if needed < -EARLY else most
        return most

    def _needed(self, seen: Observation) -> float:
        """Effort [N] that holds the speed."""
        track = float(self._slope[min(int(seen.position / GRID), self._slope.size - 1)])
        return float(self._felt.resistance(seen.speed)) + self._felt.mass * track

    def _stops(self, seen: Observation, left: float) -> bool:
        """Whether it brakes for the stop now: by the last row, or as nothing else stops it."""
        if not self._stopping:
            by_row = self._row is self._rows[-1] and self._row.target < AT_REST
            usual = 0.5 * self._hardest if by_row else 0.9 * self._hardest
            lead = self.train.brake.dead_time + self.train.brake.lag
            self._stopping = self._brake.needed(seen, left, lead) > usual
            if by_row and self._row.phase > Phase.COASTING:
                planned = 0.5 * self._row.speed**2 / max(self._row.end - self._row.position, 0.5)
                self._stopping |= self._brake.needed(seen, left, lead) > planned
            if self._stopping:
                self._brake.reset()
        elif seen.speed < AT_REST and left > STOPPING_TOLERANCE:
            self._stopping = False
        return self._stopping

    def _moved(self, effort: float, speed: float, rate: float) -> Demand:
        """Move the lever towards an effort [N]."""
        train, felt = self.train, self._felt
        pull = full_traction(train, felt.max_power, speed)
        pull = min(pull, felt.inertia * train.max_acceleration + felt.resistance(speed))
        brake = self._hardest * felt.inertia
        target = min(effort / pull, 1.0) if effort >= 0.0 else max(effort / brake, -1.0)
        return self._lever.moved(target, rate, pull, brake)


def obeyed_trip(trajectory: Trajectory, line: Line, train: Train) -> Trip:
    """The trip of a driver who follows the advice of a trajectory to the letter, on dry rail.

    Parameters
    ----------
    trajectory : Trajectory
        From standstill to standstill; the train is in the configuration that arrives last.
    line : Line
        In its own direction.
    train : Train

    Raises
    ------
    InputError
        See `AdvisedDriver`.
    """
    follows = partial(AdvisedDriver, trajectory, line.travelled(trajectory.direction), train)
    names = [trajectory.configurations[trajectory.latest].name]
    return simulate(trajectory_scenarios(trajectory, line, train, names, follows)[0])

"""What the forces in a train do: a consist over a line, with full and with emergency braking.

The train starts, keeps a speed over the line's gradients, brakes to a stand with full service
braking, starts again, and brakes to a stand in an emergency. Beside it runs the single-particle
train (Amirhosseini et al. (2024), eq. 10) under the same demands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.errors import InfeasibleError, InputError
from trainlog.railway import Line, Station, StepProfile
from trainlog.railway.train import Consist
from trainlog.simulation.consist import ConsistPlant, ConsistState
from trainlog.units import KMH

PERIOD = 0.05
"""Of control and of what is recorded [s]."""

STEP = 0.001
"""Of the integration [s]: what couplers do at the ends of their slack takes short steps."""

BUILD_UP = 10.0
"""In which the driver brings the traction to its full effort [s]."""

PIPE_FALL = 6.0
"""In which the pressure of the train pipe falls to that of full service braking [s]."""

SERVICE_AT, EMERGENCY_AT = 0.55, 0.85
"""Where the brakes are asked for: share of the line."""

HALT = 30.0
"""Between the stop and the next start, and after the last stop [s]."""

BAND = 1.5
"""Below the speed to keep, over which the traction fades [m/s]."""

PATIENCE = 3.0
"""Longest time on the way, over that at the speed to keep."""


@dataclass(frozen=True, eq=False)
class ConsistRun:
    """What a consist of n vehicles did; (m,) arrays with one value a sample unless said otherwise.

    Attributes
    ----------
    consist : Consist
    line : Line
    speed_to_keep : float [m/s]
    time : [s]
    tractive_demand, braking_demand : [N]
        For the whole train.
    positions, speeds : (m, n) array [m], [m/s]
        Of the vehicles' middles.
    tractive_efforts, braking_efforts : (m, n) array [N]
    forces, stretches : (m, n - 1) array [N], [m]
        Of the couplers, positive when pulled apart.
    phases : tuple of (first sample, name)
    alone : (m, 2) array [m], [m/s]
        Way and speed of the single-particle train.
    residual : float
        Energy that is unaccounted for, over all work done.
    """

    consist: Consist
    line: Line
    speed_to_keep: float
    time: FloatArray
    tractive_demand: FloatArray
    braking_demand: FloatArray
    positions: FloatArray
    speeds: FloatArray
    tractive_efforts: FloatArray
    braking_efforts: FloatArray
    forces: FloatArray
    stretches: FloatArray
    phases: tuple[tuple[int, str], ...]
    alone: FloatArray
    residual: float

    @property
    def front(self) -> FloatArray:
        """Chainage of the train's front [m]."""
        return np.asarray(self.positions[:, 0] + 0.5 * self.consist.vehicles[0].length)

    @property
    def way(self) -> FloatArray:
        """Of the centre of mass since the beginning [m]."""
        masses = np.array([vehicle.mass for vehicle in self.consist.vehicles])
        centre = self.positions @ masses / masses.sum()
        return np.asarray(centre - centre[0])

    @property
    def ahead(self) -> FloatArray:
        """Way of the consist less that of the single-particle train [m]."""
        return np.asarray(self.way - self.alone[:, 0])

    def phase(self, name: str) -> slice:
        """The samples of the phase called `name`."""
        starts = [first for first, _ in self.phases] + [self.time.size]
        number = [each for _, each in self.phases].index(name)
        return slice(starts[number], starts[number + 1])


def crest_and_sag() -> Line:
    """Twelve kilometres: level, 8 per mille up, 10 down, 10 up, level."""
    return Line(
        name="crest and sag",
        length=12_000.0,
        stations=(Station("start", 0.0), Station("end", 12_000.0)),
        speed_limits=StepProfile(np.zeros(1), np.array([160.0 / KMH])),
        gradients=StepProfile(
            np.array([0.0, 1_500.0, 3_000.0, 4_200.0, 5_400.0]),
            np.array([0.0, 8.0, -10.0, 10.0, 0.0]) / 1e3,
        ),
        source="made up to show what a crest and a sag do to a train",
    )


def run(consist: Consist, line: Line, *, speed: float) -> ConsistRun:
    """Drive a consist over a line.

    Parameters
    ----------
    consist : Consist
        Of two vehicles or more.
    line : Line
        As travelled; from its beginning.
    speed : float [m/s]
        To keep; the line's lowest speed limit if that is less.

    Raises
    ------
    InputError
        If there is no coupler, no traction or no brake, or the line is shorter than six trains.
    InfeasibleError
        If the train does not get over the line.
    """
    _check(consist, line, speed)
    kept = min(speed, float(line.speed_limits.values.min()))
    plant = ConsistPlant(consist, line, step=STEP)
    one = ConsistPlant(consist.as_one(), line, step=STEP)
    # The whole train stands on the line.
    state, alone = plant.at(consist.length), one.at(consist.length)
    begin, origin = plant.energy(state), float(alone.positions[0])
    driver = _Driver(consist, line, kept)
    rows: list[tuple[float, ...]] = []
    seen: list[FloatArray] = []
    steps = round(PERIOD / STEP)
    while not driver.finished:
        pull, brake = driver.demand(state, len(rows))
        rows.append((state.time, pull, brake, alone.positions[0] - origin, alone.speeds[0]))
        seen.append(np.stack((state.positions, state.speeds, state.braking_effort)))
        plant.advance(state, pull, brake, steps)
        one.advance(alone, pull, brake, steps)
    table, motion = np.array(rows), np.stack(seen)
    positions, speeds = motion[:, 0], motion[:, 1]
    return ConsistRun(
        consist=consist,
        line=line,
        speed_to_keep=kept,
        time=table[:, 0],
        tractive_demand=table[:, 1],
        braking_demand=table[:, 2],
        positions=positions,
        speeds=speeds,
        tractive_efforts=_tractive(consist, table[:, 1], speeds),
        braking_efforts=motion[:, 2],
        forces=plant.forces_between(positions, speeds),
        stretches=plant.stretches_between(positions),
        phases=tuple(driver.phases),
        alone=table[:, 3:],
        residual=_residual(plant, state, begin),
    )


class _Driver:
    """Starts, keeps the speed, brakes, halts, starts again, and brakes in an emergency."""

    def __init__(self, consist: Consist, line: Line, speed: float) -> None:
        self.phases: list[tuple[int, str]] = [(0, "start and run")]
        self.finished = False
        self._consist, self._line, self._speed = consist, line, speed
        self._pull = self._brake = 0.0
        self._since = 0.0

    def demand(self, state: ConsistState, row: int) -> tuple[float, float]:
        """Tractive and braking effort [N] until the next sample."""
        consist, phase = self._consist, self.phases[-1][1]
        position, speed = float(state.positions[0]), float(state.speeds[0])
        if phase in ("start and run", "start again"):
            again = phase == "start again"
            self._brake = 0.0
            share = min(max((self._speed - speed) / BAND, 0.0), 1.0)
            most = consist.max_tractive_effort
            self._pull = min(share * most, self._pull + most * PERIOD / BUILD_UP)
            if position > (EMERGENCY_AT if again else SERVICE_AT) * self._line.length:
                self._next("emergency braking" if again else "full service braking", state, row)
        if self.phases[-1][1] in ("full service braking", "emergency braking"):
            sudden = self.phases[-1][1] == "emergency braking"
            fall = consist.max_braking_effort * (1.0 if sudden else PERIOD / PIPE_FALL)
            self._pull = 0.0
            self._brake = min(self._brake + fall, consist.max_braking_effort)
            if np.all(state.speeds == 0.0):
                self._next("end" if sudden else "halt", state, row)
        elif phase in ("halt", "end") and state.time > self._since + HALT:
            self.finished = phase == "end"
            if not self.finished:
                self._next("start again", state, row)
        patience = PATIENCE * self._line.length / self._speed + 4.0 * HALT
        if state.time > patience or speed < -1.0:
            raise InfeasibleError(
                f"consist '{consist.name}' does not get over line '{self._line.name}': at km"
                f" {position / 1e3:.3f} after {state.time:.0f} s",
                remedy="a lighter train, more traction or an easier line",
            )
        return self._pull, self._brake

    def _next(self, phase: str, state: ConsistState, row: int) -> None:
        self.phases.append((row, phase))
        self._since = state.time


def _check(consist: Consist, line: Line, speed: float) -> None:
    """Refuse what cannot be driven."""
    if len(consist.vehicles) < 2:
        raise InputError(
            f"consist '{consist.name}' is a single particle: there are no forces in it",
            remedy="choose one of two vehicles or more",
        )
    for what, effort in (
        ("traction", consist.max_tractive_effort),
        ("brake", consist.max_braking_effort),
    ):
        if not effort > 0.0:
            raise InputError(f"consist '{consist.name}' has no {what}")
    if not speed > 0.0:
        raise InputError(f"the speed to keep must be positive, not {speed * KMH:g} km/h")
    if line.length < 6.0 * consist.length:
        raise InputError(
            f"line '{line.name}' of {line.length:.0f} m is too short for a train of"
            f" {consist.length:.0f} m",
            remedy="choose one of at least six times the train's length",
        )


def _tractive(consist: Consist, demand: FloatArray, speeds: FloatArray) -> FloatArray:
    """Tractive effort of each vehicle at work [N], within its power; (m, n) array."""
    most = np.array([vehicle.max_tractive_effort for vehicle in consist.vehicles])
    power = np.array([vehicle.max_traction_power for vehicle in consist.vehicles])
    return np.minimum(np.outer(demand, most / most.sum()), power / np.maximum(speeds, 1e-3))


def _residual(plant: ConsistPlant, state: ConsistState, before: float) -> float:
    works = state.works
    gained = works["traction"] - sum(work for name, work in works.items() if name != "traction")
    total = sum(abs(work) for work in works.values())
    return abs(plant.energy(state) - before - gained) / total

"""A consist on a line: every vehicle a particle, joined by nonlinear couplers.

Source: Amirhosseini et al. (2024).

The single-particle model is a consist of one vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.railway import Line
from trainlog.railway.resistance import tunnel_force_per_weight
from trainlog.railway.train import Consist
from trainlog.simulation.dynamics import curve_resistance
from trainlog.units import GRAVITY

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"


WORKS = ("traction", "braking", "running_resistance", "track", "damping")
"""The works [J] at the end of the state vector, in this order; all but `track` only grow."""

MASS, INERTIA, R0, R1, R2, PULL, POWER, BRAKE, LENGTH = range(9)
"""Columns of the table of vehicles."""

DRAFT, BUFF, DAMPING, SLACK, APART = 0, 3, 6, 7, 8
"""Columns of the table of couplers: where the spring in draft and that in buff begin, each with
stiffness, nonlinearity and the stretch up to which it is valid; APART is the distance of the
middles at rest [m]."""

STIFFNESS, NONLINEARITY, LARGEST = range(3)
"""Columns of a spring, from where it begins."""

START, OFFSET, SINE, CURVATURE, BEND, TUNNEL, COEFFICIENT, RADIUS_OFFSET = range(8)
"""Columns of the table of the track: a piece from START [m] to that of the next row, in which the
height is ``OFFSET + SINE x`` [m], the curvature ``CURVATURE + BEND x`` [1/m], and a tunnel resists
with TUNNEL over weight; the last two are k and b [m] of the curve resistance. The first piece
begins at minus infinity; a row at infinity ends it."""

TAKE_UP = 0.005
"""Travel behind the slack [m] over which a coupler's damper takes hold."""

FRICTION_SPEED = 0.01
"""Below this speed [m/s] friction fades, so that it never drives; a train that nothing moves is
stopped there, and the brakes take what kinetic energy is left."""


@njit(cache=True, error_model="numpy")
def locate(y: FloatArray, vehicles: FloatArray, track: FloatArray, places: IntArray) -> None:
    """Find the pieces of the track under front, rear and middle of every vehicle.

    Walks from where they were; within the step the derivative looks at the neighbours alone.
    """
    for i in range(vehicles.shape[0]):
        half = 0.5 * vehicles[i, LENGTH]
        for end in range(3):
            position = y[i] + (half if end == 0 else -half if end == 1 else 0.0)
            k = places[i, end]
            while position < track[k, START]:
                k -= 1
            while position >= track[k + 1, START]:
                k += 1
            places[i, end] = k


@njit(cache=True, error_model="numpy")
def passed(position: float, start: float, end: float) -> int:
    """1 if `position` lies beyond a piece of the track, -1 if before it, 0 on it."""
    return int(position >= end) - int(position < start)


@njit(cache=True, error_model="numpy")
def coupler_force(couplers: FloatArray, i: int, stretch: float, rate: float) -> tuple[float, float]:
    """Force of coupler `i` [N], positive when pulled apart, and the damper's part of it.

    A damper behind slack takes hold over `TAKE_UP`, so that the force has no steps.
    """
    slack = couplers[i, SLACK]
    spring, beyond = DRAFT, max(stretch - slack, 0.0)
    if stretch < 0.0:
        spring, beyond = BUFF, min(stretch + slack, 0.0)
    damper = couplers[i, DAMPING] * rate
    if slack > 0.0:
        damper *= min(abs(beyond) / TAKE_UP, 1.0)
    hardening = 1.0 + couplers[i, spring + NONLINEARITY] * beyond * beyond
    return couplers[i, spring + STIFFNESS] * hardening * beyond + damper, damper


@njit(cache=True, error_model="numpy")
def coupler_forces(couplers: FloatArray, stretch: FloatArray, rate: FloatArray) -> FloatArray:
    """Force of every coupler [N] at several instants; (m, n - 1) arrays."""
    forces = np.empty_like(stretch)
    for row in range(stretch.shape[0]):
        for i in range(stretch.shape[1]):
            forces[row, i] = coupler_force(couplers, i, stretch[row, i], rate[row, i])[0]
    return forces


@njit(cache=True, error_model="numpy", inline="always")
def derivative(
    y: FloatArray,
    out: FloatArray,
    pull: FloatArray,
    brake: FloatArray,
    vehicles: FloatArray,
    couplers: FloatArray,
    track: FloatArray,
    places: IntArray,
    scale: tuple[float, float, float],
) -> None:
    """Time derivative of the state: positions, speeds, works."""
    n = vehicles.shape[0]
    traction, braking, running, along, damping = 0.0, 0.0, 0.0, 0.0, 0.0
    behind = 0.0
    for i in range(n):
        x, v = y[i], y[n + i]
        half = 0.5 * vehicles[i, LENGTH]
        j, k, m = places[i, 0], places[i, 1], places[i, 2]
        j += passed(x + half, track[j, START], track[j + 1, START])
        k += passed(x - half, track[k, START], track[k + 1, START])
        m += passed(x, track[m, START], track[m + 1, START])
        rise = track[k, SINE]
        if j != k:
            above = track[j, OFFSET] + track[j, SINE] * (x + half)
            below = track[k, OFFSET] + track[k, SINE] * (x - half)
            rise = (above - below) / vehicles[i, LENGTH]
        bend = track[m, CURVATURE] + track[m, BEND] * x
        resisting = track[m, TUNNEL] + curve_resistance(
            bend, track[m, COEFFICIENT], track[m, RADIUS_OFFSET]
        )
        effort = pull[i]
        if effort * v > vehicles[i, POWER]:
            effort = vehicles[i, POWER] / v
        # Friction and brakes act against the motion.
        speed = abs(v)
        sense = 1.0 if v > 0.0 else -1.0
        if speed < FRICTION_SPEED:
            sense = v / FRICTION_SPEED
        weight = GRAVITY * vehicles[i, MASS]
        own = sense * (
            vehicles[i, R0] * scale[0]
            + vehicles[i, R1] * scale[1] * speed
            + vehicles[i, R2] * scale[2] * speed * speed
        )
        held = sense * brake[i]
        load = weight * (rise + sense * resisting)
        # What the coupler in front pulls, found with the vehicle before.
        force = behind
        behind = 0.0
        if i + 1 < n:
            rate = v - y[n + i + 1]
            behind, damper = coupler_force(couplers, i, x - y[i + 1] - couplers[i, APART], rate)
            damping += damper * rate
        out[i] = v
        out[n + i] = (effort - held - own - load + force - behind) / vehicles[i, INERTIA]
        traction += effort * v
        braking += held * v
        running += own * v
        along += load * v
    out[2 * n] = traction
    out[2 * n + 1] = braking
    out[2 * n + 2] = running
    out[2 * n + 3] = along
    out[2 * n + 4] = damping


@njit(cache=True, error_model="numpy")
def advance(
    y: FloatArray,
    time: float,
    pull: FloatArray,
    demand: FloatArray,
    brake: FloatArray,
    delay: FloatArray,
    late: IntArray,
    cursor: int,
    lag: float,
    step: float,
    steps: int,
    vehicles: FloatArray,
    couplers: FloatArray,
    track: FloatArray,
    places: IntArray,
    variation: FloatArray,
    angular_frequency: float,
    stretch: FloatArray,
) -> int:
    """Let `steps` steps pass under constant demands; everything is changed in place.

    Parameters
    ----------
    y : (2 n + 5,) array
        Positions [m], speeds [m/s], works [J].
    pull, demand : (n,) array [N]
        Tractive effort, and braking effort asked for.
    brake : (n,) array [N]
        Braking effort at work.
    delay : (d, n) array [N]
        Ring buffer of the demands of the last dead time; the next goes to row `cursor`.
    late : (n,) array
        Dead time of each vehicle's brake in steps, less than d.
    variation : (3,) array
        Amplitude, relative to its mean, with which each coefficient of the running resistance
        swings with `angular_frequency` [rad/s] of time.
    stretch : (n - 1, 2) array [m]
        Most that each coupler was pulled apart and pushed together so far, both positive; beyond
        what is valid the motion ends.

    Returns
    -------
    cursor : int
    """
    n = vehicles.shape[0]
    size, rows = y.size, delay.shape[0]
    slopes, trial, moved = np.empty(size), np.empty(size), np.empty(size)
    decay = np.exp(-step / lag) if lag > 0.0 else 0.0
    swings = variation[0] != 0.0 or variation[1] != 0.0 or variation[2] != 0.0
    scale = (1.0, 1.0, 1.0)
    for _ in range(steps):
        for i in range(n):
            delay[cursor, i] = demand[i]
            oldest = cursor - late[i]
            wanted = delay[oldest if oldest >= 0 else oldest + rows, i]
            brake[i] = wanted + (brake[i] - wanted) * decay
        cursor = cursor + 1 if cursor + 1 < rows else 0

        if abs(y[n]) <= FRICTION_SPEED and _stands(y, pull, brake, vehicles, track, places):
            for i in range(n):
                y[2 * n + 1] += 0.5 * vehicles[i, INERTIA] * y[n + i] ** 2
                y[n + i] = 0.0
            time += step
            continue

        locate(y, vehicles, track, places)
        # The four stages in one loop, so that the compiler can unite it with the derivative.
        for i in range(size):
            trial[i] = y[i]
            moved[i] = y[i]
        for stage in range(4):
            outer = stage == 0 or stage == 3
            if swings:
                into = 0.5 * ((stage + 1) // 2) * step
                scale = _scaled(variation, angular_frequency * (time + into))
            derivative(trial, slopes, pull, brake, vehicles, couplers, track, places, scale)
            share = step / 6.0 if outer else step / 3.0
            reach = 0.5 * step if stage < 2 else step
            for i in range(size):
                moved[i] += share * slopes[i]
                trial[i] = y[i] + reach * slopes[i]
        for i in range(size):
            y[i] = moved[i]

        for i in range(n - 1):
            apart = y[i] - y[i + 1] - couplers[i, APART]
            side = 0 if apart >= 0.0 else 1
            stretch[i, side] = max(stretch[i, side], abs(apart))
            if abs(apart) >= couplers[i, (DRAFT if side == 0 else BUFF) + LARGEST]:
                return cursor
        time += step
    return cursor


@njit(cache=True, error_model="numpy")
def _scaled(variation: FloatArray, angle: float) -> tuple[float, float, float]:
    """What each coefficient of the running resistance is multiplied with."""
    swing = np.sin(angle)
    return 1.0 + variation[0] * swing, 1.0 + variation[1] * swing, 1.0 + variation[2] * swing


@njit(cache=True, error_model="numpy")
def _stands(
    y: FloatArray,
    pull: FloatArray,
    brake: FloatArray,
    vehicles: FloatArray,
    track: FloatArray,
    places: IntArray,
) -> bool:
    """Whether no vehicle moves and what drives the train is less than what holds it."""
    n = vehicles.shape[0]
    for i in range(n):
        if abs(y[n + i]) > FRICTION_SPEED:
            return False
    locate(y, vehicles, track, places)
    drive, hold = 0.0, 0.0
    for i in range(n):
        j, k, m = places[i, 0], places[i, 1], places[i, 2]
        length, weight = vehicles[i, LENGTH], GRAVITY * vehicles[i, MASS]
        above = track[j, OFFSET] + track[j, SINE] * (y[i] + 0.5 * length)
        below = track[k, OFFSET] + track[k, SINE] * (y[i] - 0.5 * length)
        bend = track[m, CURVATURE] + track[m, BEND] * y[i]
        drive += pull[i] - weight * (above - below) / length
        hold += brake[i] + vehicles[i, R0]
        curves = curve_resistance(bend, track[m, COEFFICIENT], track[m, RADIUS_OFFSET])
        hold += weight * (curves + track[m, TUNNEL])
    return abs(drive) <= hold


LEVEL_TRACK = np.array([[start] + 7 * [0.0] for start in (-np.inf, np.inf)])
"""Table of a track without gradients, curves and tunnels."""

FINEST = 1.0
"""Largest product of the integration step and a coupler's natural angular frequency, and half the
product of the step and its damping rate: beyond, the motion is not resolved."""


@dataclass(frozen=True, slots=True)
class Variation:
    """Slow swing of the running resistance: each coefficient times ``1 + amplitude sin(w t)``.

    Attributes
    ----------
    amplitudes : tuple of three float
        Of the coefficients of running resistance, relative.
    angular_frequency : float [rad/s]
    """

    amplitudes: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular_frequency: float = 0.0


@dataclass(eq=False)
class ConsistState:
    """Where a consist is; `ConsistPlant.advance` changes it in place.

    Attributes
    ----------
    time : float [s]
    values : (2 n + 5,) array
        Positions of the vehicles' middles [m], their speeds [m/s], and the works [J].
    braking_effort : (n,) array [N]
    delay : (d, n) array [N]
        Braking efforts asked for within the dead times; `cursor` is where the next one goes.
    places : (n, 3) array
        Piece of the track under the front, the rear and the middle of each vehicle.
    largest_stretch : (n - 1, 2) array [m]
        Most that each coupler was pulled apart, and pushed together, since the beginning.
    """

    time: float
    values: FloatArray
    braking_effort: FloatArray
    delay: FloatArray
    cursor: int
    places: IntArray
    largest_stretch: FloatArray

    @property
    def _count(self) -> int:
        return self.braking_effort.size

    @property
    def positions(self) -> FloatArray:
        """Of the vehicles' middles [m], front first."""
        return self.values[: self._count].copy()

    @property
    def speeds(self) -> FloatArray:
        """Of the vehicles [m/s], front first."""
        return self.values[self._count : 2 * self._count].copy()

    @property
    def works(self) -> dict[str, float]:
        """Work of each kind of force since the beginning [J]; see `WORKS`."""
        return dict(zip(WORKS, self.values[2 * self._count :].tolist(), strict=True))


class ConsistPlant:
    """A consist, ready to run.

    Parameters
    ----------
    consist : Consist
    line : Line, optional
        As travelled; without it the track is straight and level.
    variation : Variation
        Of the running resistance.
    step : float [s]
        Of the integration.

    Raises
    ------
    InputError
        If the step is too coarse for the couplers or for the brake.

    Examples
    --------
    >>> import trainlog
    >>> consist = trainlog.read_consist("sample_logs/freight_24_wagons.consist.json")
    >>> plant = ConsistPlant(consist)
    >>> state = plant.at(speed=20.0)
    >>> plant.coupler_forces(state).size == state.speeds.size - 1
    True
    """

    def __init__(
        self,
        consist: Consist,
        line: Line | None = None,
        *,
        variation: Variation | None = None,
        step: float = 0.01,
    ) -> None:
        self.consist = consist
        self.variation = variation or Variation()
        self.step = step
        self._line = line
        self._track = LEVEL_TRACK if line is None else track_table(line)
        self._vehicles = np.array(
            [
                [
                    each.mass,
                    each.inertia,
                    *each.resistance.parabola,
                    each.max_tractive_effort,
                    each.max_traction_power,
                    each.max_braking_effort,
                    each.length,
                ]
                for each in consist.vehicles
            ]
        )
        apart = np.diff(consist.middles)
        self._couplers = np.array(
            [
                [
                    *each.draft,
                    each.largest_stretch[0],
                    *each.buff,
                    each.largest_stretch[1],
                    each.damping,
                    each.slack,
                    distance,
                ]
                for each, distance in zip(consist.couplers, apart, strict=True)
            ]
        ).reshape(-1, 9)
        self._check_step()
        self._late = np.round(consist.dead_times / step).astype(np.int64)

    def at(self, position: float = 0.0, speed: float = 0.0) -> ConsistState:
        """The state of a consist whose front is at `position` [m], rolling at `speed` [m/s].

        Couplers are at rest, brakes are off. The rear may stand before the line's beginning, where
        the track goes on as it begins.

        Raises
        ------
        InputError
            If the front is not on the line, or the speed is negative.
        """
        end = np.inf if self._line is None else self._line.length
        if not (0.0 <= position <= end and speed >= 0.0 and np.isfinite(position + speed)):
            raise InputError(
                f"consist '{self.consist.name}' cannot start at km {position / 1e3:.3f} with"
                f" {speed} m/s",
                remedy=f"the line ends at km {end / 1e3:.3f}; speed must not be negative",
            )
        n = len(self.consist.vehicles)
        values = np.zeros(2 * n + len(WORKS))
        values[:n] = position - self.consist.middles
        values[n : 2 * n] = speed
        return ConsistState(
            0.0,
            values,
            np.zeros(n),
            np.zeros((int(self._late.max()) + 1, n)),
            0,
            np.zeros((n, 3), dtype=np.int64),
            np.zeros((n - 1, 2)),
        )

    def advance(
        self,
        state: ConsistState,
        tractive_efforts: ArrayLike,
        braking_efforts: ArrayLike,
        steps: int,
    ) -> None:
        """Let `steps` integration steps pass under constant demands.

        Parameters
        ----------
        state : ConsistState
            Changed in place.
        tractive_efforts, braking_efforts : (n,) array or float [N]
            Of each vehicle, or of the whole consist: then shared in proportion to what each vehicle
            can do. Tractive efforts are bounded by the vehicle's power.
        steps : int

        Raises
        ------
        InputError
            If there is less than no step, an effort is negative or more than a vehicle has, if a
            softening coupler is stretched beyond its validity, or the motion is not finite.

        Examples
        --------
        >>> from trainlog.formats.railway import read_consist
        >>> plant = ConsistPlant(read_consist("sample_logs/passenger_8_coaches.consist.json"))
        >>> state = plant.at(position=300.0)
        >>> plant.advance(state, tractive_efforts=100e3, braking_efforts=0.0, steps=1_000)
        >>> f"{state.speeds[0]:.2f} m/s"
        '1.51 m/s'
        """
        if steps < 0:
            raise InputError(
                f"{steps} steps: their number must not be negative", remedy="give 0 steps or more"
            )
        pull = self._shared(tractive_efforts, PULL, "tractive")
        demand = self._shared(braking_efforts, BRAKE, "braking")
        state.cursor = advance(
            state.values, state.time, pull, demand, state.braking_effort, state.delay,
            self._late, state.cursor, self.consist.brake.lag, self.step, steps, self._vehicles,
            self._couplers, self._track, state.places, np.array(self.variation.amplitudes),
            self.variation.angular_frequency, state.largest_stretch,
        )  # fmt: skip
        state.time += steps * self.step
        valid = self._couplers[:, [DRAFT + LARGEST, BUFF + LARGEST]]
        for number, side in np.argwhere(state.largest_stretch >= valid):
            raise InputError(
                f"coupler {number + 1} of consist '{self.consist.name}' was"
                f" {('pulled apart', 'pushed together')[side]} by"
                f" {1e3 * state.largest_stretch[number, side]:.0f} mm; its softening spring is"
                f" valid to {1e3 * valid[number, side]:.0f} mm",
                remedy="give it a smaller |epsilon| or more stiffness, or lower the efforts",
            )
        if not np.all(np.isfinite(state.values)):
            raise InputError(
                f"the motion of consist '{self.consist.name}' is not finite after"
                f" {state.time:.1f} s",
                remedy="use a smaller step",
            )

    def coupler_forces(self, state: ConsistState) -> FloatArray:
        """Force in each coupler [N], positive when pulled apart; (n - 1,) array."""
        return np.asarray(self.forces_between(state.positions[None], state.speeds[None])[0])

    def forces_between(self, positions: FloatArray, speeds: FloatArray) -> FloatArray:
        """Force in each coupler [N], positive when pulled apart.

        Parameters
        ----------
        positions, speeds : (m, n) array [m], [m/s]
            Of the vehicles' middles at several instants.

        Returns
        -------
        (m, n - 1) array
        """
        stretch, rate = self.stretches_between(positions), -np.diff(speeds)
        return np.asarray(coupler_forces(self._couplers, stretch, rate))

    def stretches(self, state: ConsistState) -> FloatArray:
        """How far each coupler is pulled apart [m], negative when pushed together; (n - 1,)."""
        return self.stretches_between(state.positions)

    def stretches_between(self, positions: FloatArray) -> FloatArray:
        """The same for positions of the vehicles' middles [m]; (..., n) to (..., n - 1)."""
        return np.asarray(-np.diff(positions) - self._couplers[:, APART])

    def energy(self, state: ConsistState) -> float:
        """Kinetic energy of the vehicles and energy stored in the couplers [J]."""
        stretch = self.stretches(state)
        stored = sum(
            float(coupler.energy(each))
            for coupler, each in zip(self.consist.couplers, stretch, strict=True)
        )
        return stored + 0.5 * float(self._vehicles[:, INERTIA] @ state.speeds**2)

    def _shared(self, efforts: ArrayLike, column: int, what: str) -> FloatArray:
        most = self._vehicles[:, column]
        each = np.asarray(efforts, dtype=np.float64)
        if each.ndim == 0:
            total = most.sum()
            each = most * (each / total) if total > 0.0 else np.full(most.shape, each)
        if each.shape != most.shape:
            raise InputError(
                f"consist '{self.consist.name}': {each.size} {what} efforts for"
                f" {most.size} vehicles",
                remedy="give one effort per vehicle",
            )
        if not np.all((each >= 0.0) & (each <= most * (1.0 + 1e-12))):
            row = int(np.argmin((each >= 0.0) & (each <= most * (1.0 + 1e-12))))
            raise InputError(
                f"vehicle {row + 1} of consist '{self.consist.name}' cannot give a {what} effort of"
                f" {each[row] / 1e3:.1f} kN",
                remedy=f"it has 0 to {most[row] / 1e3:.1f} kN",
            )
        return np.ascontiguousarray(each)

    def _check_step(self) -> None:
        if not (self.step > 0.0 and np.isfinite(self.step)):
            raise InputError(
                f"a time step of {self.step} s is not positive", remedy="give a step above 0 s"
            )
        name = self.consist.name
        inertia = self._vehicles[:, INERTIA]
        reduced = 1.0 / (1.0 / inertia[:-1] + 1.0 / inertia[1:])
        # A vehicle between two couplers swings up to twice as fast as a pair of them.
        stiffest = self._couplers[:, [DRAFT, BUFF]].max(axis=1, initial=0.0)
        frequency = 2.0 * np.sqrt(stiffest / reduced)
        rate = 2.0 * self._couplers[:, DAMPING] / reduced
        fastest = max(frequency.max(initial=0.0), 0.5 * rate.max(initial=0.0))
        if self.step * fastest > FINEST:
            raise InputError(
                f"step of {1e3 * self.step:g} ms is too coarse for the couplers of consist"
                f" '{name}'",
                remedy=f"use at most {1e3 * FINEST / fastest:.1f} ms",
            )
        # What can bring a vehicle to rest within one step.
        held = self._vehicles[:, BRAKE] + self._vehicles[:, R0]
        strongest = float((held / inertia).max())
        if self.step * strongest > 2.0 * FRICTION_SPEED:
            raise InputError(
                f"step of {1e3 * self.step:g} ms is too coarse for consist '{name}': its brakes"
                f" and its resistance take {strongest:.1f} m/s²",
                remedy=f"use at most {2e3 * FRICTION_SPEED / strongest:.1f} ms",
            )


def track_table(line: Line) -> FloatArray:
    """Track of a line as the compiled motion reads it: one row a piece between two breakpoints.

    Before its beginning and after its end the line goes on as it begins and ends.

    Returns
    -------
    (n + 1, 8) array
        Columns `START` to `RADIUS_OFFSET`.
    """
    start, width, sine, _, curvature, bend, coefficient, offset = line.pieces()
    height = np.concatenate(([0.0], np.cumsum(sine * width)[:-1]))
    tunnel = np.zeros(start.size)
    for each in line.tunnels:
        here = (start >= each.position) & (start < each.position + each.length)
        tunnel[here] = tunnel_force_per_weight(each.length)
    table = np.column_stack(
        (
            start, height - sine * start, sine, curvature - bend * start, bend, tunnel,
            coefficient, offset,
        )
    )  # fmt: skip
    table[0, START] = -np.inf
    return np.ascontiguousarray(np.vstack([table, LEVEL_TRACK[-1]]))

"""A consist on a line: every vehicle a particle, joined by nonlinear couplers.

Source: Amirhosseini et al. (2024).

The single-particle model is a consist of one vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.railway import Line
from trainlog.railway.resistance import tunnel_force_per_weight
from trainlog.railway.train import Consist
from trainlog.simulation import particles
from trainlog.simulation.particles import WORKS

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
        """Work of each kind of force since the beginning [J]; see `particles.WORKS`."""
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
        pull = self._shared(tractive_efforts, particles.PULL, "tractive")
        demand = self._shared(braking_efforts, particles.BRAKE, "braking")
        state.cursor = particles.advance(
            state.values, state.time, pull, demand, state.braking_effort, state.delay,
            self._late, state.cursor, self.consist.brake.lag, self.step, steps, self._vehicles,
            self._couplers, self._track, state.places, np.array(self.variation.amplitudes),
            self.variation.angular_frequency, state.largest_stretch,
        )  # fmt: skip
        state.time += steps * self.step
        self._check_motion(state)

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
        return np.asarray(particles.coupler_forces(self._couplers, stretch, rate))

    def stretches(self, state: ConsistState) -> FloatArray:
        """How far each coupler is pulled apart [m], negative when pushed together; (n - 1,)."""
        return self.stretches_between(state.positions)

    def stretches_between(self, positions: FloatArray) -> FloatArray:
        """The same for positions of the vehicles' middles [m]; (..., n) to (..., n - 1)."""
        return np.asarray(-np.diff(positions) - self._couplers[:, particles.APART])

    def energy(self, state: ConsistState) -> float:
        """Kinetic energy of the vehicles and energy stored in the couplers [J]."""
        stretch = self.stretches(state)
        stored = sum(
            float(coupler.energy(each))
            for coupler, each in zip(self.consist.couplers, stretch, strict=True)
        )
        return stored + 0.5 * float(self._vehicles[:, particles.INERTIA] @ state.speeds**2)

    def momentum(self, state: ConsistState) -> float:
        """Of all vehicles with their rotating parts [kg m/s]."""
        return float(self._vehicles[:, particles.INERTIA] @ state.speeds)

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
        inertia = self._vehicles[:, particles.INERTIA]
        reduced = 1.0 / (1.0 / inertia[:-1] + 1.0 / inertia[1:])
        # A vehicle between two couplers swings up to twice as fast as a pair of them.
        stiffest = self._couplers[:, [particles.DRAFT, particles.BUFF]].max(axis=1, initial=0.0)
        frequency = 2.0 * np.sqrt(stiffest / reduced)
        rate = 2.0 * self._couplers[:, particles.DAMPING] / reduced
        fastest = max(frequency.max(initial=0.0), 0.5 * rate.max(initial=0.0))
        if self.step * fastest > FINEST:
            raise InputError(
                f"step of {1e3 * self.step:g} ms is too coarse for the couplers of consist"
                f" '{name}'",
                remedy=f"use at most {1e3 * FINEST / fastest:.1f} ms",
            )
        # What can bring a vehicle to rest within one step.
        held = self._vehicles[:, particles.BRAKE] + self._vehicles[:, particles.R0]
        strongest = float((held / inertia).max())
        if self.step * strongest > 2.0 * particles.FRICTION_SPEED:
            raise InputError(
                f"step of {1e3 * self.step:g} ms is too coarse for consist '{name}': its brakes"
                f" and its resistance take {strongest:.1f} m/s²",
                remedy=f"use at most {2e3 * particles.FRICTION_SPEED / strongest:.1f} ms",
            )

    def _check_motion(self, state: ConsistState) -> None:
        valid = self._couplers[
            :, [particles.DRAFT + particles.LARGEST, particles.BUFF + particles.LARGEST]
        ]
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


def track_table(line: Line) -> FloatArray:
    """Track of a line as `particles` reads it: one row a piece between two breakpoints.

    Before its beginning and after its end the line goes on as it begins and ends.

    Returns
    -------
    (n + 1, 8) array
        Columns `particles.START` to `particles.RADIUS_OFFSET`.
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
    table[0, particles.START] = -np.inf
    return np.ascontiguousarray(np.vstack([table, LEVEL_TRACK[-1]]))

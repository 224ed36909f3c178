"""The train of Hauck et al. (2023) and its motion: eqs. (1) to (7), braking envelope, fastest run.

Tables along a section lie on a grid of `GRID` metres and are read on a line between two nodes:
sine of the gradient, maximum adhesion, and the square of the highest speed.
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from analysis.control.route import GRID, value
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import Axles, Train
from trainlog.units import GRAVITY, KMH


class LeverTrain(NamedTuple):
    """``m dv/dt = -F_r(v) + F_train(v) u``, the lever u in [-1, 1]; eq. (1) to (3).

    Attributes
    ----------
    drag : float [N/(m/s)²]
        ``1/2 rho c A``.
    rolling : float
        c_R, rolling resistance over weight.
    k1, k2, k3 : float [N], [s/m], [N]
        Of the effort at full lever, ``F_train(v) = k1 exp(-k2 v) + k3``, traction and braking.
    light, heavy : float [kg]
        The ends of eq. (6): empty and loaded.
    comfort : float [m/s²]
        a_max of eq. (4), in traction and in braking.
    lever : float
        The largest that is used.
    """

    drag: float
    rolling: float
    k1: float
    k2: float
    k3: float
    light: float
    heavy: float
    comfort: float = 1.0
    lever: float = 1.0

    def full_effort(self, speed: ArrayLike) -> FloatArray:
        """Effort of the full lever, F_train [N], at each speed [m/s]."""
        return np.asarray(self.k1 * np.exp(-self.k2 * np.asarray(speed, dtype=float)) + self.k3)

    def resistance(self, mass: float) -> RunningResistance:
        """Running resistance on level track at a mass [kg], eq. (2) without wind."""
        return RunningResistance(self.rolling * mass * GRAVITY, 0.0, self.drag)

    def check_mass(self, mass: float) -> None:
        """Refuse a mass [kg] that the train cannot have.

        Raises
        ------
        InputError
        """
        if not self.light <= mass <= self.heavy:
            raise InputError(
                f"the train of Hauck et al. (2023) cannot weigh {mass / 1e3:g} t",
                remedy=f"it weighs {self.light / 1e3:g} t empty and {self.heavy / 1e3:g} t full",
            )

    def on_axles(self, axles: int = 6, rotating_mass: float = 800.0) -> Train:
        """The same train with driven and braked axles, for simulation.

        Eq. (5) lets the whole weight count as adhesive, so all axles are driven, and the dynamic
        brake gives all of the effort. Power is the most that the lever's curve asks for.

        Parameters
        ----------
        axles : int
        rotating_mass : float [kg]
            Of each axle.
        """
        speeds = np.linspace(0.0, TOP_SPEED, 400)
        power = float(np.max(speeds * self.full_effort(speeds)))
        effort = self.k1 + self.k3
        return Train(
            name="train of Hauck et al. (2023)",
            mass=self.light,
            rotating_mass_factor=axles * rotating_mass / self.light,
            resistance=self.resistance(self.light),
            max_tractive_effort=effort,
            max_traction_power=power,
            max_dynamic_braking_effort=effort,
            max_dynamic_braking_power=power,
            max_speed=TOP_SPEED,
            max_acceleration=self.comfort,
            max_deceleration=self.comfort,
            max_load=self.heavy - self.light,
            axles=Axles(count=axles, adhesive_mass=self.light, rotating_mass=rotating_mass),
            source="Hauck et al. (2023), Table I; a_max is not published, 1 m/s² chosen",
            assumed=("axles", "rotating_mass_factor", "max_speed"),
        )


TOP_SPEED = 120.0 / KMH
"""Of the train [m/s]; not published."""

PUBLISHED_TRAIN = LeverTrain(
    drag=0.5 * 1.2041 * 0.85 * 10.0,
    rolling=0.002,
    k1=1.516e5,
    k2=0.1147,
    k3=1.564e4,
    light=68_200.0,
    heavy=68_200.0 + 20_500.0,
)
"""Table I, with density and drag coefficient in their places."""

NOMINAL_MASS = 78_200.0
"""What the paper's controller takes the train to weigh [kg]."""


class Tables(NamedTuple):
    """Tables of a section, (n,) arrays from `origin` [m] on.

    Attributes
    ----------
    sine : of the gradient's angle
    adhesion : maximum adhesion, never above the map's
    ceiling : [m²/s²]
        Square of the highest speed from which all that lies ahead can be kept.
    """

    origin: float
    sine: FloatArray
    adhesion: FloatArray
    ceiling: FloatArray

    def at(self, table: FloatArray, positions: FloatArray | float) -> FloatArray:
        """One of the tables at positions [m]; ends are extended."""
        return np.asarray(np.interp(positions, self.origin + GRID * np.arange(table.size), table))

    def slope(self, table: FloatArray, positions: FloatArray) -> FloatArray:
        """How fast one of the tables changes at positions [1/m]."""
        cell = ((positions - self.origin) / GRID).astype(np.int64).clip(0, table.size - 2)
        return np.asarray(np.diff(table)[cell] / GRID)


@njit(cache=True)
def full_effort(v: Any, c: LeverTrain) -> Any:
    """F_train [N]."""
    return c.k1 * np.exp(-c.k2 * v) + c.k3


@njit(cache=True)
def drift(v: Any, sine: Any, m: float, c: LeverTrain) -> Any:
    """f_2 of eq. (3) [m/s²]: what happens with the lever at 0."""
    weight = sine + c.rolling * np.sqrt(1.0 - sine * sine)
    return -c.drag * v * np.abs(v) / m - GRAVITY * weight


@njit(cache=True)
def acceleration(v: Any, u: Any, sine: Any, m: float, c: LeverTrain) -> Any:
    """Eq. (3) [m/s²]."""
    return drift(v, sine, m, c) + full_effort(v, c) * u / m


def constraints(v: Any, u: Any, sine: Any, adhesion: Any, limit: Any, c: LeverTrain) -> FloatArray:
    """Eq. (7): largest of h_1 and h_2, of h_3 and h_4, h_5, of h_6 and h_7; (n, 4) array.

    Over both ends of the mass, [m/s²], [m/s²], [m/s] and [1]; arguments of (n,) values.
    """
    masses = (c.light, c.heavy)
    comfort = [np.abs(acceleration(v, u, sine, m, c)) - c.comfort for m in masses]
    traction = np.abs(full_effort(v, c) * u) / c.light - adhesion * GRAVITY
    return np.column_stack([np.maximum(*comfort), traction, v - limit, np.abs(u) - 1.0])


@njit(cache=True)
def lever_bounds(v: Any, sine: Any, adhesion: Any, c: LeverTrain) -> tuple[Any, Any]:
    """Lowest and highest lever that (4), (5) and the range of the lever allow for every mass.

    The constraints are affine in 1/m, so that both ends of the mass imply all between them.
    """
    full = full_effort(v, c)
    light, heavy = drift(v, sine, c.light, c), drift(v, sine, c.heavy, c)
    most = np.minimum(adhesion * GRAVITY * c.light / full, c.lever)
    high = np.minimum((c.comfort - light) * c.light, (c.comfort - heavy) * c.heavy) / full
    low = np.maximum((-c.comfort - light) * c.light, (-c.comfort - heavy) * c.heavy) / full
    return np.maximum(low, -most), np.minimum(high, most)


@njit(cache=True)
def limited_rise(squares: FloatArray, most: float) -> FloatArray:
    """Squares of speeds that rise by at most `most` [m/s²] along the grid: no train gains more."""
    found = squares.copy()
    for i in range(1, found.size):
        found[i] = min(found[i], found[i - 1] + 2.0 * most * GRID)
    return found


@njit(cache=True)
def braking_envelope(
    squares: FloatArray, sine: FloatArray, adhesion: FloatArray, share: float,
    light: float, heavy: float, inertia: float, c: LeverTrain,
) -> FloatArray:  # fmt: skip
    """Squares of speeds from which the speeds ahead can be kept with a share of the brake.

    The lever is limited as for every mass of `c`; the deceleration is the worse of the two masses
    `light` and `heavy`, divided by the rotating-mass factor `inertia`.
    """
    found = squares.copy()
    for i in range(found.size - 2, -1, -1):
        ahead = found[i + 1]
        best = ahead
        for _ in range(2):
            v = math.sqrt(0.5 * (ahead + best))
            slope, grip = 0.5 * (sine[i] + sine[i + 1]), min(adhesion[i], adhesion[i + 1])
            lever = share * min(lever_bounds(v, slope, grip, c)[0], 0.0)
            worst = -max(
                acceleration(v, lever, slope, light, c), acceleration(v, lever, slope, heavy, c)
            )
            best = ahead + 2.0 * GRID * max(worst / inertia, 0.0)
        found[i] = min(found[i], best)
    return found


@njit(cache=True)
def fastest_run(
    start: float, end: float, step: float, most: float, m: float, inertia: float, t: Tables,
    c: LeverTrain,
) -> tuple[Any, ...]:  # fmt: skip
    """The run to rest at `end` [m] as fast as the lever, the ceiling and `most` allow.

    The motion is that of the mass `m` and the rotating-mass factor `inertia`.

    Returns positions, speeds, times and levers; the speeds end early where the train stalls.
    """
    count = max(math.ceil((end - start) / step), 2)
    width = (end - start) / count
    positions = start + width * np.arange(count + 1)
    speeds, times, levers = np.zeros(count + 1), np.zeros(count + 1), np.zeros(count + 1)
    for i in range(count):
        v, place = speeds[i], positions[i]
        gain = 0.0
        square = v * v
        for _ in range(2):
            mean = 0.5 * (v + math.sqrt(square))
            slope = value(t.sine, t.origin, place + 0.5 * width)
            high = lever_bounds(mean, slope, value(t.adhesion, t.origin, place), c)[1]
            gain = acceleration(mean, high, slope, m, c) / inertia
            square = max(v * v + 2.0 * gain * width, 0.0)
        ceiling = min(value(t.ceiling, t.origin, positions[i + 1]), most * most)
        if i == count - 1:
            ceiling = 0.0
        square = min(square, ceiling)
        if square <= 0.0 and i < count - 1:
            return positions[: i + 1], speeds[: i + 1], times[: i + 1], levers[: i + 1]
        speeds[i + 1] = math.sqrt(square)
        mean = 0.5 * (v + speeds[i + 1])
        times[i + 1] = times[i] + width / mean
        slope = value(t.sine, t.origin, place + 0.5 * width)
        reached = inertia * (square - v * v) / (2.0 * width)
        levers[i] = (reached - drift(mean, slope, m, c)) * m / full_effort(mean, c)
    levers[-1] = levers[-2]
    return positions, speeds, times, levers


@njit(cache=True)
def roll(
    p: float, v: float, u0: float, u1: float, span: float, steps: int, m: float,
    t: Tables, c: LeverTrain,
) -> FloatArray:  # fmt: skip
    """States under a lever that goes from `u0` to `u1`; (steps + 1, 3) array of p, v, u.

    Classical Runge-Kutta; a train that comes to rest does not roll back.
    """
    out = np.empty((steps + 1, 3))
    h = span / steps
    for k in range(steps + 1):
        u = u0 + (u1 - u0) * k / steps
        out[k, 0], out[k, 1], out[k, 2] = p, v, u
        if k == steps:
            break
        middle, after = u + 0.5 * (u1 - u0) / steps, u + (u1 - u0) / steps
        a1 = acceleration(v, u, value(t.sine, t.origin, p), m, c)
        v2 = max(v + 0.5 * h * a1, 0.0)
        a2 = acceleration(v2, middle, value(t.sine, t.origin, p + 0.5 * h * v), m, c)
        v3 = max(v + 0.5 * h * a2, 0.0)
        a3 = acceleration(v3, middle, value(t.sine, t.origin, p + 0.5 * h * v2), m, c)
        v4 = max(v + h * a3, 0.0)
        a4 = acceleration(v4, after, value(t.sine, t.origin, p + h * v3), m, c)
        p += h * (v + 2.0 * v2 + 2.0 * v3 + v4) / 6.0
        v = max(v + h * (a1 + 2.0 * a2 + 2.0 * a3 + a4) / 6.0, 0.0)
    return out

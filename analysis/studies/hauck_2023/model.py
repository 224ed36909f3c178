"""The train of Hauck et al. (2023) and its motion: eqs. (1) to (7), braking envelope, fastest run.

Tables along a section lie on a grid of `GRID` metres and are read on a line between two nodes:
sine of the gradient, maximum adhesion, and the square of the highest speed.
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"

from __future__ import annotations

import math
from dataclasses import dataclass
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


@dataclass(frozen=True, slots=True)
class LeverTrain:
    """``m dv/dt = -F_r(v) + F_train(v) u``, the lever u in [-1, 1]; eq. (1) to (3).

    Attributes
    ----------
    name : str
    mass : float [kg]
        Empty, the least of eq. (6).
    max_load : float [kg]
    air_density : float [kg/m³]
    drag_coefficient : float
    frontal_area : float [m²]
    rolling_coefficient : float
        c_R, rolling resistance over weight.
    k1, k2, k3 : float [N], [s/m], [N]
        Of the effort at full lever, ``F_train(v) = k1 exp(-k2 v) + k3``, traction and braking.
    max_acceleration : float [m/s²]
        a_max of eq. (4), comfort in traction and in braking.
    max_speed : float [m/s]
    source : str

    Raises
    ------
    InputError
        If a value is negative, or one that must be positive is not.
    """

    name: str
    mass: float
    max_load: float
    air_density: float
    drag_coefficient: float
    frontal_area: float
    rolling_coefficient: float
    k1: float
    k2: float
    k3: float
    max_acceleration: float = 1.0
    max_speed: float = 120.0 / KMH
    source: str = ""

    def __post_init__(self) -> None:
        where = f"train '{self.name}'"
        for name in ("mass", "k3", "max_acceleration", "max_speed"):
            if not (getattr(self, name) > 0.0 and np.isfinite(getattr(self, name))):
                raise InputError(f"{where}: {name} {getattr(self, name)} is not positive")
        for name in ("max_load", "k1", "k2"):
            if not (getattr(self, name) >= 0.0 and np.isfinite(getattr(self, name))):
                raise InputError(f"{where}: {name} {getattr(self, name)} is negative")
        for name in ("air_density", "drag_coefficient", "frontal_area", "rolling_coefficient"):
            if not (getattr(self, name) >= 0.0 and np.isfinite(getattr(self, name))):
                raise InputError(
                    f"{where}: {name} {getattr(self, name)} is negative",
                    remedy="running resistance never drives a train; check sign and unit",
                )

    @property
    def max_mass(self) -> float:
        """Loaded, the greatest of eq. (6) [kg]."""
        return self.mass + self.max_load

    @property
    def drag(self) -> float:
        """``1/2 rho c A`` [N/(m/s)²]."""
        return 0.5 * self.air_density * self.drag_coefficient * self.frontal_area

    def full_effort(self, speed: ArrayLike) -> FloatArray:
        """Effort of the full lever, F_train [N], at each speed [m/s]."""
        return np.asarray(self.k1 * np.exp(-self.k2 * np.asarray(speed, dtype=float)) + self.k3)

    def resistance(self, mass: float) -> RunningResistance:
        """Running resistance on level track at a mass [kg], eq. (2) without wind."""
        return RunningResistance(self.rolling_coefficient * mass * GRAVITY, 0.0, self.drag)

    def check_mass(self, mass: float) -> None:
        """Refuse a mass [kg] that the train cannot have.

        Raises
        ------
        InputError
        """
        if not self.mass <= mass <= self.max_mass:
            raise InputError(
                f"train '{self.name}' cannot weigh {mass / 1e3:g} t",
                remedy=f"it weighs {self.mass / 1e3:g} t empty and {self.max_mass / 1e3:g} t full",
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
        speeds = np.linspace(0.0, self.max_speed, 400)
        power = float(np.max(speeds * self.full_effort(speeds)))
        effort = self.k1 + self.k3
        return Train(
            name=self.name,
            mass=self.mass,
            rotating_mass_factor=axles * rotating_mass / self.mass,
            resistance=self.resistance(self.mass),
            max_tractive_effort=effort,
            max_traction_power=power,
            max_dynamic_braking_effort=effort,
            max_dynamic_braking_power=power,
            max_speed=self.max_speed,
            max_acceleration=self.max_acceleration,
            max_deceleration=self.max_acceleration,
            max_load=self.max_load,
            axles=Axles(count=axles, adhesive_mass=self.mass, rotating_mass=rotating_mass),
            source=self.source,
            assumed=("axles", "rotating_mass_factor", "max_speed"),
        )


PUBLISHED_TRAIN = LeverTrain(
    name="train of Hauck et al. (2023)",
    mass=68_200.0,
    max_load=20_500.0,
    air_density=1.2041,
    drag_coefficient=0.85,
    frontal_area=10.0,
    rolling_coefficient=0.002,
    k1=1.516e5,
    k2=0.1147,
    k3=1.564e4,
    source="Hauck et al. (2023), Table I; a_max is not published, 1 m/s² chosen",
)
"""Table I, with density and drag coefficient in their places."""

NOMINAL_MASS = 78_200.0
"""What the paper's controller takes the train to weigh [kg]."""


class Constants(NamedTuple):
    """A `LeverTrain` for the compiled code.

    `light` and `heavy` are the ends of eq. (6), `lever` is the largest that is used.
    """

    drag: float
    rolling: float
    k1: float
    k2: float
    k3: float
    light: float
    heavy: float
    comfort: float
    lever: float = 1.0


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


def constants(train: LeverTrain) -> Constants:
    """What the compiled code needs to know of a train."""
    return Constants(
        train.drag, train.rolling_coefficient, train.k1, train.k2, train.k3,
        train.mass, train.max_mass, train.max_acceleration,
    )  # fmt: skip


@njit(cache=True)
def full_effort(v: float, c: Constants) -> float:
    """F_train [N]."""
    return c.k1 * math.exp(-c.k2 * v) + c.k3


@njit(cache=True)
def drift(v: float, sine: float, m: float, c: Constants) -> float:
    """f_2 of eq. (3) [m/s²]: what happens with the lever at 0."""
    weight = sine + c.rolling * math.sqrt(1.0 - sine * sine)
    return -c.drag * v * abs(v) / m - GRAVITY * weight


@njit(cache=True)
def acceleration(v: float, u: float, sine: float, m: float, c: Constants) -> float:
    """Eq. (3) [m/s²]."""
    return drift(v, sine, m, c) + full_effort(v, c) * u / m


@njit(cache=True)
def constraint_values(
    v: float, u: float, sine: float, adhesion: float, limit: float, c: Constants
) -> tuple[float, float, float]:
    """Largest of h_1 and h_2, of h_3 and h_4, and h_5 of eq. (7), over both ends of the mass."""
    safety, traction = -np.inf, -np.inf
    for m in (c.light, c.heavy):
        safety = max(safety, abs(acceleration(v, u, sine, m, c)) - c.comfort)
        traction = max(traction, abs(full_effort(v, c) * u) / m - adhesion * GRAVITY)
    return safety, traction, v - limit


@njit(cache=True)
def lever_bounds(v: float, sine: float, adhesion: float, c: Constants) -> tuple[float, float]:
    """Lowest and highest lever that (4), (5) and the range of the lever allow for every mass.

    The constraints are affine in 1/m, so that both ends of the mass imply all between them.
    """
    full = full_effort(v, c)
    low, high = -c.lever, c.lever
    for m in (c.light, c.heavy):
        free = drift(v, sine, m, c)
        grip = adhesion * GRAVITY * m / full
        high = min(high, (c.comfort - free) * m / full, grip)
        low = max(low, (-c.comfort - free) * m / full, -grip)
    return low, high


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
    light: float, heavy: float, inertia: float, c: Constants,
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
    start: float, speed: float, end: float, step: float, most: float, m: float, inertia: float,
    t: Tables, c: Constants,
) -> tuple[Any, ...]:  # fmt: skip
    """The run to rest at `end` [m] as fast as the lever, the ceiling and `most` allow.

    The motion is that of the mass `m` and the rotating-mass factor `inertia`.

    Returns positions, speeds, times and levers; the speeds end early where the train stalls.
    """
    count = max(math.ceil((end - start) / step), 2)
    width = (end - start) / count
    positions = start + width * np.arange(count + 1)
    speeds, times, levers = np.zeros(count + 1), np.zeros(count + 1), np.zeros(count + 1)
    speeds[0] = speed
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
    t: Tables, c: Constants,
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


@njit(cache=True)
def worst_constraints(states: FloatArray, t: Tables, c: Constants) -> FloatArray:
    """Largest `constraint_values` and |u| - 1 over (n, 3) rows of p, v, u against the tables."""
    worst = np.full(4, -np.inf)
    for p, v, u in states:
        found = constraint_values(
            v, u, value(t.sine, t.origin, p), value(t.adhesion, t.origin, p),
            math.sqrt(value(t.ceiling, t.origin, p)), c,
        )  # fmt: skip
        for k in range(3):
            worst[k] = max(worst[k], found[k])
        worst[3] = max(worst[3], abs(u) - 1.0)
    return worst

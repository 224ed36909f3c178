"""A locomotive with a motor for each axle, its motion and its prediction, after Zhao et al. (2025).

State of a locomotive with n driven axles: its speed and the circumferential speeds of its wheels,
``x = [v, w_1 … w_n]`` [m/s]. ``rail[k, i]`` holds a, b and c of the creep curve under axle i in
step k; ``constants`` are those of `MultiMotorLocomotive.constants`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainlog.errors import InputError
from trainlog.railway.resistance import RunningResistance

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class MultiMotorLocomotive:
    """A locomotive with a motor for each axle, and what it pulls.

    Attributes
    ----------
    name : str
    mass : float [kg]
        Of locomotive and train, without the rotating part; M of eq. (1).
    axle_loads : tuple of float [N]
        Weight on each driven axle, W g of eq. (2).
    inertia : float [kg m²]
        Of one axle with its motor, at the motor; J_eq of eq. (9).
    gear_ratio : float
        Motor speed over axle speed, R_g.
    wheel_radius : float [m]
    resistance : RunningResistance
        F_d, eq. (3).
    torque_limit, total_torque : float [N m]
        The most that a motor, and that all of them together may give.
    """

    name: str
    mass: float
    axle_loads: tuple[float, ...]
    inertia: float
    gear_ratio: float
    wheel_radius: float
    resistance: RunningResistance
    torque_limit: float
    total_torque: float

    def __post_init__(self) -> None:
        for name in (
            "mass", "inertia", "gear_ratio", "wheel_radius", "torque_limit", "total_torque",
        ):  # fmt: skip
            if not (getattr(self, name) > 0.0 and np.isfinite(getattr(self, name))):
                raise InputError(
                    f"locomotive '{self.name}': {name} {getattr(self, name)} is not positive"
                )
        if not self.axle_loads or not all(load > 0.0 for load in self.axle_loads):
            raise InputError(
                f"locomotive '{self.name}': needs driven axles, each with a positive load"
            )

    @property
    def axles(self) -> int:
        """Number of driven axles."""
        return len(self.axle_loads)

    @property
    def effort_per_torque(self) -> float:
        """Effort at the wheel rims for each newton metre at the motor [1/m]."""
        return self.gear_ratio / self.wheel_radius

    @property
    def rotating_mass(self) -> float:
        """Inertia of one axle with its motor, as a mass at the wheel rims [kg]."""
        return self.inertia * self.effort_per_torque**2

    @property
    def loads(self) -> FloatArray:
        """`axle_loads` as an array, (n,) [N]."""
        return np.array(self.axle_loads, dtype=np.float64)

    @property
    def constants(self) -> tuple[float, float, float, float, float, float]:
        """What the compiled code needs: masses [kg], effort per torque [1/m], r0, r1, r2."""
        r = self.resistance
        return (self.mass, self.rotating_mass, self.effort_per_torque, r.r0, r.r1, r.r2)


@njit(cache=True)
def creep(slip, curve):  # type: ignore[no-untyped-def]
    """Adhesion coefficient and its slope over slip speed; eq. (10), made odd."""
    a, b, c = curve
    size = abs(slip)
    one, other = np.exp(-a * size), np.exp(-b * size)
    value = c * (one - other)
    return (value if slip >= 0.0 else -value), c * (b * other - a * one)


@njit(cache=True)
def rates(state, torque, rail, loads, constants, out):  # type: ignore[no-untyped-def]
    """Rates of change of the state [m/s²]; eqs. (1), (3) and (8). A train at rest stays there."""
    mass, rotating, ratio, r0, r1, r2 = constants
    v = state[0]
    pull = 0.0
    for i in range(loads.size):
        force = loads[i] * creep(state[1 + i] - v, rail[i])[0]
        pull += force
        out[1 + i] = (ratio * torque[i] - force) / rotating
    out[0] = (pull - r0 - (r1 + r2 * v) * v) / mass
    if v <= 0.0 and out[0] < 0.0:
        out[0] = 0.0


@njit(cache=True)
def euler(state, torque, rail, loads, constants, step, steps):  # type: ignore[no-untyped-def]
    """Explicit Euler steps, in place; eq. (15)."""
    rate = np.empty(state.size)
    for _ in range(steps):
        rates(state, torque, rail, loads, constants, rate)
        state += step * rate
        state[0] = max(state[0], 0.0)


@njit(cache=True)
def runge_kutta(state, torque, rail, loads, constants, step, steps):  # type: ignore[no-untyped-def]
    """Classical Runge-Kutta steps of fourth order, in place."""
    size = state.size
    k1, k2, k3, k4 = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    for _ in range(steps):
        rates(state, torque, rail, loads, constants, k1)
        rates(state + 0.5 * step * k1, torque, rail, loads, constants, k2)
        rates(state + 0.5 * step * k2, torque, rail, loads, constants, k3)
        rates(state + step * k3, torque, rail, loads, constants, k4)
        state += step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        state[0] = max(state[0], 0.0)


@njit(cache=True)
def predicted(state, plan, rail, loads, constants, period, substeps):  # type: ignore[no-untyped-def]
    """Slip speeds over the horizon and how they change with the plan's torques.

    Parameters
    ----------
    plan : (control horizon, n) array [N m]
        Held beyond its end.
    rail : (horizon, n, 3) array

    Returns
    -------
    slip : (horizon * n,) array [m/s]
    change : (horizon * n, control horizon * n) array [m/s per N m]
    """
    mass, rotating, ratio, _, r1, r2 = constants
    horizon, n = rail.shape[0], loads.size
    moves = plan.shape[0]
    step = period / substeps
    x = state.copy()
    rate = np.empty(n + 1)
    grow = np.zeros((n + 1, moves * n))
    slope = np.empty(n)
    slip = np.empty(horizon * n)
    change = np.empty((horizon * n, moves * n))
    for k in range(horizon):
        j = min(k, moves - 1)
        used = (j + 1) * n
        for _ in range(substeps):
            rates(x, plan[j], rail[k], loads, constants, rate)
            moving = x[0] > 0.0 or rate[0] > 0.0
            for i in range(n):
                slope[i] = loads[i] * creep(x[1 + i] - x[0], rail[k, i])[1]
            drag = r1 + 2.0 * r2 * x[0]
            for column in range(used):
                of_speed = grow[0, column]
                pull = -drag * of_speed
                for i in range(n):
                    force = slope[i] * (grow[1 + i, column] - of_speed)
                    pull += force
                    grow[1 + i, column] -= step / rotating * force
                if moving:
                    grow[0, column] += step / mass * pull
            for i in range(n):
                grow[1 + i, j * n + i] += step * ratio / rotating
            x += step * rate
            x[0] = max(x[0], 0.0)
        for i in range(n):
            slip[k * n + i] = x[1 + i] - x[0]
            change[k * n + i] = grow[1 + i] - grow[0]
    return slip, change

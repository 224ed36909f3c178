"""A train with a motor for each powered axle, its motion and its prediction (Zhao et al., 2025).

State of a train with n powered axles: its speed and the circumferential speeds of its wheels,
``x = [v, w_1 … w_n]`` [m/s]. ``rail[k, i]`` holds a, b and c of the creep curve under axle i in
step k; ``constants`` are those of `MultiMotorLocomotive.constants`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from trainlog.arrays import FloatArray
from trainlog.declaration import PositiveFinite, check
from trainlog.errors import InputError
from trainlog.railway.resistance import RunningResistance


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
    mass: PositiveFinite
    axle_loads: tuple[float, ...]
    inertia: PositiveFinite
    gear_ratio: PositiveFinite
    wheel_radius: PositiveFinite
    resistance: RunningResistance
    torque_limit: PositiveFinite
    total_torque: PositiveFinite

    def __post_init__(self) -> None:
        check(self)
        if not self.axle_loads or not all(load > 0.0 for load in self.axle_loads):
            raise InputError(
                f"locomotive '{self.name}': needs driven axles, each with a positive load",
                remedy="give the load of each driven axle in N",
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
        """What the compiled code needs: masses [kg], effort per torque [1/m], resistance."""
        r = self.resistance
        return (self.mass, self.rotating_mass, self.effort_per_torque, *r.parabola)


class Prediction(NamedTuple):
    """How the motion is predicted, for the compiled code.

    Attributes
    ----------
    period : float [s]
        Over which a torque is held.
    substeps : int
        Within it.
    lag : float [s]
        Of the motors; 0: they give at once what is asked.
    direction : float
        1 in traction; -1 in braking, where slip speeds, torques and forces count against the train.
    exact : float
        1: each substep takes the exponential of its linearised slip (below); 0: explicit Euler.
    """

    period: float
    substeps: int
    lag: float
    direction: float
    exact: float


@njit(cache=True)
def creep(slip, curve):  # type: ignore[no-untyped-def]
    """Adhesion coefficient and its slope over slip speed; eq. (10), made odd."""
    a, b, c = curve
    size = abs(slip)
    one, other = np.exp(-a * size), np.exp(-b * size)
    value = c * (one - other)
    return (value if slip >= 0.0 else -value), c * (b * other - a * one)


LARGEST_EXPONENT = 2.0
"""Growth of slip within a substep beyond the peak: no substep is that long where it matters."""


@njit(cache=True)
def exponential_weight(z):  # type: ignore[no-untyped-def]
    """``(exp(z) - 1) / z`` and its derivative."""
    if z > LARGEST_EXPONENT:
        return (np.exp(LARGEST_EXPONENT) - 1.0) / LARGEST_EXPONENT, 0.0
    if abs(z) < 1e-2:
        return 1.0 + z * (0.5 + z * (1.0 / 6.0 + z / 24.0)), 0.5 + z * (1.0 / 3.0 + z / 8.0)
    grown = np.exp(z)
    value = (grown - 1.0) / z
    return value, (grown - value) / z


@njit(cache=True)
def predicted(state, begun, plan, rail, loads, constants, how, sensitive):  # type: ignore[no-untyped-def]
    """Slip speeds over the horizon and how they change with the plan's torques.

    Within a substep the slip speed of an axle relaxes to that at which creep bears its torque, with
    the rate that the slope of its creep curve gives (an exponential Rosenbrock step): so a steep
    curve needs no shorter steps, where an explicit step would be unstable.

    Parameters
    ----------
    state : (1 + n,) array [m/s]
    begun : (n,) array [N m]
        Torques at work at the beginning; of no weight without lag.
    plan : (control horizon, n) array [N m]
        Held beyond its end.
    rail : (horizon, n, 3) array
    how : Prediction
    sensitive : bool
        Whether `change` is wanted.

    Returns
    -------
    slip : (horizon * n,) array [m/s]
    change : (horizon * n, control horizon * n) array [m/s per N m]
    """
    mass, rotating, ratio, still, linear, square = constants
    horizon, n = rail.shape[0], loads.size
    moves = plan.shape[0]
    step = how.period / how.substeps
    keep = np.exp(-step / how.lag) if how.lag > 0.0 else 0.0
    size = moves * n if sensitive else 0
    v = state[0]
    s = how.direction * (state[1:] - v)
    torque = begun.copy()
    share = np.zeros(moves)
    grow, of_speed, pull = np.zeros((n, size)), np.zeros(size), np.zeros(size)
    force, slope, bend = np.empty(n), np.empty(n), np.empty(n)
    slip = np.empty(horizon * n)
    change = np.empty((horizon * n if sensitive else 0, size))
    for k in range(horizon):
        j = min(k, moves - 1)
        used = (j + 1) * n if sensitive else 0
        for _ in range(how.substeps):
            total = 0.0
            for i in range(n):
                a, b, c = rail[k, i]
                x = abs(s[i])
                one, other = c * np.exp(-a * x), c * np.exp(-b * x)
                sign = 1.0 if s[i] >= 0.0 else -1.0
                force[i] = sign * loads[i] * (one - other)
                slope[i] = loads[i] * (b * other - a * one)
                bend[i] = sign * loads[i] * (a * a * one - b * b * other)
                total += force[i]
            gain = (total - how.direction * (still + (linear + square * v) * v)) / mass
            drag = how.direction * (linear + 2.0 * square * v) / mass
            at_rest = v <= 0.0 and how.direction * gain < 0.0
            if at_rest:
                gain = drag = 0.0
            for column in range(used):
                pull[column] = -drag * of_speed[column]
            if not at_rest:
                for i in range(n):
                    part = slope[i] / mass
                    for column in range(used):
                        pull[column] += part * grow[i, column]
            for m in range(moves):
                share[m] *= keep
            share[j] += 1.0 - keep
            for i in range(n):
                torque[i] = keep * torque[i] + (1.0 - keep) * plan[j, i]
                rate = (ratio * torque[i] - force[i]) / rotating - gain
                z = -step * slope[i] / rotating * how.exact
                weight, of_z = exponential_weight(z)
                reach = step * weight
                own = 1.0 - reach * slope[i] / rotating
                own -= rate * step * step * of_z * bend[i] / rotating * how.exact
                if how.exact > 0.0 and s[i] * (s[i] + reach * rate) < 0.0:
                    # The slope here is not that where creep turns round: the one there is taken.
                    a, b, c = rail[k, i]
                    stiff = loads[i] * c * (b - a) / rotating
                    own = np.exp(-step * stiff)
                    reach = (1.0 - own) / stiff
                    rate = ratio * torque[i] / rotating - gain - stiff * s[i]
                for column in range(used):
                    grow[i, column] = own * grow[i, column] - reach * pull[column]
                if sensitive:
                    for m in range(j + 1):
                        grow[i, m * n + i] += reach * ratio / rotating * share[m]
                s[i] += reach * rate
            for column in range(used):
                of_speed[column] += step * how.direction * pull[column]
            v = max(v + step * how.direction * gain, 0.0)
        for i in range(n):
            slip[k * n + i] = s[i]
            if sensitive:
                for column in range(size):
                    change[k * n + i, column] = grow[i, column]
    return slip, change


@njit(cache=True)
def tracking_plan(state, begun, reference, rail, loads, constants, how, limits, total, moves):  # type: ignore[no-untyped-def]
    """A plan that brings each axle to its slip speed and keeps it there, (moves, n) [N m].

    Found forwards, torque by torque, with half of the error of slip taken back in a period. Not
    optimal, but sound from any state: also where the plan of another rail would let wheels race.
    """
    mass, rotating, ratio, still, linear, square = constants
    n = loads.size
    plan = np.zeros((moves, n))
    now, at_work = state.copy(), begun.copy()
    one = np.empty((1, n))
    keep = np.exp(-how.period / how.lag) if how.lag > 0.0 else 0.0
    for j in range(moves):
        v = now[0]
        pull = 0.0
        for i in range(n):
            pull += loads[i] * creep(how.direction * (now[1 + i] - v), rail[j, i])[0]
        gain = (pull - how.direction * (still + (linear + square * v) * v)) / mass
        if v <= 0.0 and how.direction * gain < 0.0:
            gain = 0.0
        total_given = 0.0
        for i in range(n):
            s = how.direction * (now[1 + i] - v)
            aim = 0.5 * (s + reference[j * n + i])
            bearing = loads[i] * creep(aim, rail[j, i])[0]
            wanted = bearing + rotating * ((aim - s) / how.period + gain)
            one[0, i] = min(max(wanted / ratio, 0.0), limits[i])
            total_given += one[0, i]
        scale = min(total / total_given, 1.0) if total_given > 0.0 else 1.0
        for i in range(n):
            plan[j, i] = one[0, i] = scale * one[0, i]
        slip, _ = predicted(now, at_work, one, rail[j : j + 1], loads, constants, how, False)
        v = max(v + how.period * how.direction * gain, 0.0)
        now[0] = v
        for i in range(n):
            now[1 + i] = v + how.direction * slip[i]
            at_work[i] = keep * at_work[i] + (1.0 - keep) * one[0, i]
    return plan

"""The longitudinal dynamics of a consist in compiled code: one particle a vehicle.

    M_i dv_i/dt = P_i - B_i - R_i(v_i) - m_i g (dh_i/L_i + (k_C |kappa| + k_T L_T)(x_i))
                  - C_i + C_{i-1}
    C_i         = k0 (1 + eps d²) d + b dv,     d = x_i - x_{i+1} less the distance at rest

(paper 004, eqs. 1-10 as corrected: the forces of a coupler act on its two vehicles with opposite
signs, and the track acts on every vehicle at its own position.) `M` moves with the vehicle; `P` is
its tractive effort, `B` the braking effort, which follows its demand after a dead time and with a
first-order lag (eq. 1). `dh/L` is the rise of the track from the vehicle's rear to its front over
its length: the slope under it, which changes steadily as it passes an edge. One vehicle is the
single-particle model (10).

Classical Runge-Kutta of fourth order with a fixed step; the works of all forces are integrated
beside the motion, so that the energy balance can be checked.
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainlog.railway.resistance import CURVE_COEFFICIENT
from trainlog.units import GRAVITY

FloatArray = NDArray[np.float64]

WORKS = ("traction", "braking", "running_resistance", "track", "damping")
"""The works [J] at the end of the state vector, in this order; all but `track` only grow."""

MASS, INERTIA, R0, R1, R2, PULL, POWER, BRAKE, LENGTH = range(9)
"""Columns of the table of vehicles."""

STIFFNESS, NONLINEARITY, DAMPING, SLACK, APART, LARGEST = range(6)
"""Columns of the table of couplers; APART is the distance of the middles at rest [m], LARGEST the
stretch up to which the spring is valid."""

START, HEIGHT, SINE, CURVATURE, BEND, TUNNEL = range(6)
"""Columns of the table of the track: piece from START [m] on, HEIGHT [m] there; TUNNEL is
resistance over weight."""

TAKE_UP = 0.005
"""Travel behind the slack [m] over which a coupler's damper takes hold."""

AT_REST = 0.01
"""Below this speed [m/s] friction fades, so that it never drives; a train that nothing moves is
stopped there, and the brakes take what kinetic energy is left."""


@njit(cache=True)
def piece(track: FloatArray, position: float, guess: int) -> int:
    """Number of the track's piece at `position`, searched from the last one."""
    k = guess
    while k > 0 and position < track[k, START]:
        k -= 1
    while k + 1 < track.shape[0] and position >= track[k + 1, START]:
        k += 1
    return k


@njit(cache=True)
def slope(track: FloatArray, position: float, length: float, ends: NDArray[np.int64]) -> float:
    """Rise over length under a vehicle; `ends` are the pieces of its front and rear."""
    front, rear = position + 0.5 * length, position - 0.5 * length
    j = piece(track, front, ends[0])
    k = piece(track, rear, ends[1])
    ends[0], ends[1] = j, k
    if j == k:
        return track[j, SINE]
    above = track[j, HEIGHT] + track[j, SINE] * (front - track[j, START])
    below = track[k, HEIGHT] + track[k, SINE] * (rear - track[k, START])
    return (above - below) / length


@njit(cache=True)
def bends_and_tunnels(track: FloatArray, k: int, position: float) -> float:
    """Curve and tunnel resistance over weight in piece `k`; paper 004, eq. (6) as corrected."""
    bend = track[k, CURVATURE] + track[k, BEND] * (position - track[k, START])
    return CURVE_COEFFICIENT * abs(bend) + track[k, TUNNEL]


@njit(cache=True)
def derivative(
    y: FloatArray,
    out: FloatArray,
    pull: FloatArray,
    brake: FloatArray,
    vehicles: FloatArray,
    couplers: FloatArray,
    track: FloatArray,
    places: NDArray[np.int64],
    scale: tuple[float, float, float],
) -> None:
    """Time derivative of the state: positions, speeds, works."""
    n = vehicles.shape[0]
    works = 2 * n
    for i in range(works, works + 5):
        out[i] = 0.0
    for i in range(n):
        v = y[n + i]
        k = piece(track, y[i], places[i, 2])
        places[i, 2] = k
        rise = slope(track, y[i], vehicles[i, LENGTH], places[i])
        effort = min(pull[i], vehicles[i, POWER] / max(v, 1e-3))
        # Friction and brakes act against the motion.
        way = min(max(v / AT_REST, -1.0), 1.0)
        speed = abs(v)
        weight = GRAVITY * vehicles[i, MASS]
        own = way * (
            vehicles[i, R0] * scale[0]
            + vehicles[i, R1] * scale[1] * speed
            + vehicles[i, R2] * scale[2] * speed * speed
        )
        held = way * brake[i]
        load = weight * (rise + way * bends_and_tunnels(track, k, y[i]))
        out[i] = v
        out[n + i] = effort - held - own - load
        out[works] += effort * v
        out[works + 1] += held * v
        out[works + 2] += own * v
        out[works + 3] += load * v
    for i in range(n - 1):
        stretch = y[i] - y[i + 1] - couplers[i, APART]
        beyond = max(abs(stretch) - couplers[i, SLACK], 0.0)
        if stretch < 0.0:
            beyond = -beyond
        rate = y[n + i] - y[n + i + 1]
        damper = couplers[i, DAMPING] * rate
        if couplers[i, SLACK] > 0.0:
            damper *= min(abs(beyond) / TAKE_UP, 1.0)
        force = couplers[i, STIFFNESS] * (1.0 + couplers[i, NONLINEARITY] * beyond * beyond)
        force = force * beyond + damper
        out[n + i] -= force
        out[n + i + 1] += force
        out[works + 4] += damper * rate
    for i in range(n):
        out[n + i] /= vehicles[i, INERTIA]


@njit(cache=True)
def advance(
    y: FloatArray,
    time: float,
    pull: FloatArray,
    demand: FloatArray,
    brake: FloatArray,
    delay: FloatArray,
    cursor: int,
    lag: float,
    step: float,
    steps: int,
    vehicles: FloatArray,
    couplers: FloatArray,
    track: FloatArray,
    places: NDArray[np.int64],
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
        Ring buffer of the demands of the last dead time; `cursor` is its oldest row.
    variation : (3,) array
        Amplitude, relative to its mean, with which each coefficient of the running resistance
        swings with `angular_frequency` [rad/s] of time.
    stretch : (n - 1,) array [m]
        Largest stretch of each coupler so far; beyond what is valid the motion ends.

    Returns
    -------
    cursor : int
    """
    n = vehicles.shape[0]
    work = np.empty((5, y.size))
    decay = np.exp(-step / lag) if lag > 0.0 else 0.0
    for _ in range(steps):
        for i in range(n):
            wanted = demand[i]
            if delay.shape[0] > 0:
                wanted = delay[cursor, i]
                delay[cursor, i] = demand[i]
            brake[i] = wanted + (brake[i] - wanted) * decay
        if delay.shape[0] > 0:
            cursor = (cursor + 1) % delay.shape[0]

        if _stands(y, pull, brake, vehicles, track, places):
            for i in range(n):
                y[2 * n + 1] += 0.5 * vehicles[i, INERTIA] * y[n + i] ** 2
                y[n + i] = 0.0
            time += step
            continue

        _step(
            y, time, step, pull, brake, vehicles, couplers, track, places, variation,
            angular_frequency, work,
        )  # fmt: skip
        for i in range(n - 1):
            stretch[i] = max(stretch[i], abs(y[i] - y[i + 1] - couplers[i, APART]))
            if stretch[i] >= couplers[i, LARGEST]:
                return cursor
        time += step
    return cursor


@njit(cache=True)
def _step(
    y: FloatArray,
    time: float,
    step: float,
    pull: FloatArray,
    brake: FloatArray,
    vehicles: FloatArray,
    couplers: FloatArray,
    track: FloatArray,
    places: NDArray[np.int64],
    variation: FloatArray,
    angular_frequency: float,
    work: FloatArray,
) -> None:
    """One step of Runge and Kutta, in place."""
    k1, k2, k3, k4, trial = work[0], work[1], work[2], work[3], work[4]
    scale = _scaled(variation, angular_frequency * time)
    derivative(y, k1, pull, brake, vehicles, couplers, track, places, scale)
    scale = _scaled(variation, angular_frequency * (time + 0.5 * step))
    for i in range(y.size):
        trial[i] = y[i] + 0.5 * step * k1[i]
    derivative(trial, k2, pull, brake, vehicles, couplers, track, places, scale)
    for i in range(y.size):
        trial[i] = y[i] + 0.5 * step * k2[i]
    derivative(trial, k3, pull, brake, vehicles, couplers, track, places, scale)
    scale = _scaled(variation, angular_frequency * (time + step))
    for i in range(y.size):
        trial[i] = y[i] + step * k3[i]
    derivative(trial, k4, pull, brake, vehicles, couplers, track, places, scale)
    for i in range(y.size):
        y[i] += step / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])


@njit(cache=True)
def _scaled(variation: FloatArray, angle: float) -> tuple[float, float, float]:
    """What each coefficient of the running resistance is multiplied with."""
    if variation[0] == 0.0 and variation[1] == 0.0 and variation[2] == 0.0:
        return 1.0, 1.0, 1.0
    swing = np.sin(angle)
    return 1.0 + variation[0] * swing, 1.0 + variation[1] * swing, 1.0 + variation[2] * swing


@njit(cache=True)
def _stands(
    y: FloatArray,
    pull: FloatArray,
    brake: FloatArray,
    vehicles: FloatArray,
    track: FloatArray,
    places: NDArray[np.int64],
) -> bool:
    """Whether no vehicle moves and what drives the train is less than what holds it."""
    n = vehicles.shape[0]
    drive, hold = 0.0, 0.0
    for i in range(n):
        if abs(y[n + i]) > AT_REST:
            return False
        k = piece(track, y[i], places[i, 2])
        weight = GRAVITY * vehicles[i, MASS]
        drive += pull[i] - weight * slope(track, y[i], vehicles[i, LENGTH], places[i])
        hold += brake[i] + vehicles[i, R0] + weight * bends_and_tunnels(track, k, y[i])
    return abs(drive) <= hold

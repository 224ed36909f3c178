"""The longitudinal dynamics of a consist in compiled code: one particle a vehicle.

    M_i dv_i/dt = P_i - B_i - R_i(v_i) - m_i g (dh_i/L_i + (k_C |kappa| + k_T L_T)(x_i))
                  - C_i + C_{i-1}
    C_i         = k0 (1 + eps d²) d + b dv,     d = x_i - x_{i+1} less the distance at rest

(Amirhosseini et al. (2024), eqs. 1-10 as corrected: the forces of a coupler act on its two vehicles
with opposite signs, and the track acts on every vehicle at its own position.) `M` moves with the
vehicle; `P` is its tractive effort, `B` the braking effort, which follows its demand after the
vehicle's own dead time and with a first-order lag (eq. 1). `k0` and `eps` may differ between draft
and buff. `dh/L` is the rise of the track from the vehicle's rear to its front over its length: the
slope under it, which changes steadily as it passes an edge. One vehicle is the single-particle
model (10).

Classical Runge-Kutta of fourth order with a fixed step; the works of all forces are integrated
beside the motion, so that the energy balance can be checked.
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"

from __future__ import annotations

import numpy as np
from numba import njit

from trainlog.arrays import FloatArray, IntArray
from trainlog.simulation.dynamics import curve_resistance
from trainlog.units import GRAVITY

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

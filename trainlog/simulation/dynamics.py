"""The longitudinal dynamics in compiled code: one train, its powered axles, its brakes.

The train is a single particle; each powered axle has its own wheel speed and pulls the train only
through the adhesion between wheel and rail:

    M dv/dt   = sum F_i - R(v) - m g (sin alpha + k / (R - b)) - r_T v² - F_B
    J dw_i/dt = T_i - F_i,        F_i = mu(w_i - v; mu_max(s)) W

(Zhao et al. (2025), eq. 1, 8, 10; Amirhosseini et al. (2024), eq. 1, 5, 6, 10). `M` moves with the
train, `J` is the inertia of one powered axle, both as masses at the wheel rim; `T_i` is the motor
torque over the wheel radius. The efforts follow their demand with a first-order lag, the friction
brake after a dead time as well; it acts on all axles, within the adhesion that the motors leave,
but not on one that slides. The efforts of the axles are those that a traction control gives, or an
even share of the demand under the slip protection of each axle (`protect`).
Classical Runge-Kutta of fourth order with a fixed step; the works of all forces are integrated
beside the motion, so that the energy balance can be checked.

The state is one vector: position, train speed, friction braking effort, the wheel speeds, the
lagged efforts of the motors, and the works listed in `WORKS`.
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple

from trainlog.arrays import FloatArray, IntArray
from trainlog.railway.resistance import specific_curve_resistance
from trainlog.railway.train import LEAST_LOAD
from trainlog.units import GRAVITY

POSITION, SPEED, FRICTION, WHEELS = 0, 1, 2, 3
"""Where the state vector holds position, speed, friction braking effort and the first wheel."""

WORKS = ("traction", "dynamic_braking", "friction_braking", "running_resistance", "track", "slip")
"""The works [J] at the end of the state vector, in this order; all but `track` only grow."""

SAMPLE = (
    "position",
    "speed",
    "acceleration",
    "tractive_effort",
    "dynamic_braking_effort",
    "pneumatic_braking_effort",
    "running_resistance",
    "maximum_adhesion",
    "energy",
    "protected_axles",
)
"""Columns of a recorded sample; the wheel speeds and the wheel efforts of the axles follow."""

RUNAWAY = 1.4
"""Slip speed over the threshold at which the slip protection does not wait."""

QUICK_REAPPLICATION = 1.0
"""Quick re-application after a slip: share of the largest effort, a second."""

SETTLING = 8
"""Rounds in which the axle loads of a first step come to agree with the forces that they bear."""

HEAVIEST = 1.4
"""Load of an axle over its static load that steep characteristics are resolved for."""

NORMAL, CUT, RECOVERING = 0, 1, 2
"""What the slip protection of an axle is doing."""


class PlantParameters(NamedTuple):
    """A train on one trip as the compiled plant sees it, in SI units.

    Efforts, powers and inertia are those of one powered axle where so named; the `trailing`
    weight rests on the other axles. Lags, dead time and delay are in seconds, the `step` is that of
    the integration.
    """

    mass: float
    body_inertia: float
    axle_inertia: float
    axle_weight: float
    trailing_weight: float
    r0: float
    r1: float
    r2: float
    axle_effort: float
    axle_power: float
    axle_braking_effort: float
    axle_braking_power: float
    braking_fade_speed: float
    motor_lag: float
    friction_effort: float
    friction_dead_time: float
    friction_lag: float
    holding_effort: float
    holding_speed: float
    slip_threshold: float
    slip_delay: float
    slip_release: float
    slip_reapply: float
    slip_ramp: float
    step: float


CONSTANTS = len(PlantParameters._fields)


class Step(NamedTuple):
    """What holds throughout a step of integration.

    Attributes
    ----------
    command : (n,) array [N]
        Effort asked of each axle.
    friction_demand : float [N]
    track, rail : arrays
        Rows of the tables under the train.
    curve : array
        Row of the characteristic's table; empty: the row of the rail is the curve.
    loads : (n,) array [N]
        Of the axles, each times its adhesion.
    contacts : (n,) array [N]
        Pull of each axle, as scratch (see `forces`).
    pieces : (4, n) array
        See `find_pieces`.
    end, at : arrays
        States, as scratch: the end of a Runge-Kutta step is left in `end`.
    p : PlantParameters
    """

    command: FloatArray
    friction_demand: float
    track: FloatArray
    rail: FloatArray
    curve: FloatArray
    loads: FloatArray
    contacts: FloatArray
    pieces: FloatArray
    end: FloatArray
    at: FloatArray
    p: PlantParameters


CURVE = ("speed", "unit", "stiffness")
"""Where a row of the table of a characteristic begins: train speed [m/s], slip speed of a slip of 1
[m/s] at it, and greatest change of the relative adhesion with slip. The relative adhesions follow,
at the slips ``LEAST_SLIP (exp(i SLIP_STEP) - 1)``, the last at all greater ones."""

LEAST_SLIP, SLIP_STEP, SLIPS = 1e-4, 0.03, 430
"""Slips [1] or [m/s] at which a characteristic is tabulated: from 0 to 39."""


curve_resistance = njit(cache=True, error_model="numpy")(specific_curve_resistance)


@njit(cache=True, error_model="numpy")
def adhesion(slip: float, rail: FloatArray, curve: FloatArray) -> float:
    """Adhesion at a slip speed [m/s] on one row of the rail table (start, mu_max, a, b, scale).

    `curve` is a row of the characteristic's table; without one, the row of the rail is the curve.
    """
    size = abs(slip)
    if curve.size == 0:
        found = rail[4] * (np.exp(-rail[2] * size) - np.exp(-rail[3] * size))
    else:
        place = np.log1p(size / (curve[1] * LEAST_SLIP)) * (1.0 / SLIP_STEP)
        i = min(int(place), SLIPS - 2)
        share = min(place - i, 1.0)
        found = rail[1] * (curve[3 + i] + share * (curve[4 + i] - curve[3 + i]))
    return found if slip >= 0.0 else -found


@njit(cache=True, error_model="numpy")
def find_curve(table: FloatArray, speed: float, over_creepage: bool, curve: FloatArray) -> None:
    """Fill `curve` with the characteristic at a train speed: between the rows of its table."""
    last = table.shape[0] - 1
    k = 0
    while k < last - 1 and speed >= table[k + 1, 0]:
        k += 1
    share = 0.0
    if last > 0:
        share = (speed - table[k, 0]) / (table[k + 1, 0] - table[k, 0])
        share = min(max(share, 0.0), 1.0)
    following = min(k + 1, last)
    for j in range(2, curve.size):
        curve[j] = table[k, j] + share * (table[following, j] - table[k, j])
    curve[0] = speed
    curve[1] = max(speed, table[0, 1]) if over_creepage else 1.0


@njit(cache=True, error_model="numpy")
def piece_of(curve: FloatArray, speed: float) -> tuple[float, float]:
    """The line that a curve of effort follows at a speed: effort at standstill [N], and slope.

    Beyond the last point, where the power stays, the tangent.
    """
    v = max(speed, 0.0)
    low, high = 0, curve.shape[1] - 1
    if v >= curve[0, high]:
        effort = curve[1, high] * curve[0, high] / v
        return 2.0 * effort, -effort / v
    while high - low > 1:
        middle = (low + high) // 2
        if v < curve[0, middle]:
            high = middle
        else:
            low = middle
    slope = (curve[1, high] - curve[1, low]) / (curve[0, high] - curve[0, low])
    return curve[1, low] - slope * curve[0, low], slope


@njit(cache=True, error_model="numpy")
def find_pieces(
    y: FloatArray, traction_curve: FloatArray, braking_curve: FloatArray, pieces: FloatArray
) -> None:
    """Fill `pieces` with the lines of both curves at each axle's wheel speed.

    Found once in a step: so the stages of Runge-Kutta stay a loop over axles without branches.
    """
    for i in range(pieces.shape[1]):
        if traction_curve.shape[1] > 1:
            pieces[0, i], pieces[1, i] = piece_of(traction_curve, y[3 + i])
        if braking_curve.shape[1] > 1:
            pieces[2, i], pieces[3, i] = piece_of(braking_curve, y[3 + i])


@njit(cache=True, error_model="numpy")
def motor_effort(
    lagged: float, wheel: float, pieces: FloatArray, i: int, p: PlantParameters
) -> float:
    """Effort of one axle's motor [N] within power and curve; braking fades out at low speed."""
    if lagged >= 0.0:
        by_curve = pieces[0, i] + pieces[1, i] * wheel
        return min(lagged, p.axle_power / max(wheel, 1e-3), by_curve)
    by_curve = pieces[2, i] + pieces[3, i] * wheel
    return -min(-lagged, braking_limit(wheel, p), by_curve)


@njit(cache=True, error_model="numpy")
def braking_limit(speed: float, p: PlantParameters) -> float:
    """Largest dynamic braking effort of one axle [N] that effort, fade and power allow."""
    fade = min(1.0, max(speed, 0.0) / p.braking_fade_speed)
    return min(p.axle_braking_effort * fade, p.axle_braking_power / max(speed, 1e-3))


@njit(cache=True, error_model="numpy")
def holding_effort(speed: float, command: FloatArray, p: PlantParameters) -> float:
    """Effort of the holding brake [N]: applied below its speed unless a motor is to pull."""
    if speed >= p.holding_speed:
        return 0.0
    for each in command:
        if each > 0.0:
            return 0.0
    return p.holding_effort


@njit(cache=True, error_model="numpy")
def forces(y: FloatArray, v: float, now: Step) -> tuple[float, float, float, float]:
    """Pull of all powered axles, running resistance, force along the track, friction braking [N].

    `now.contacts` is filled with the pull of each axle.
    """
    p, track, rail, loads, contacts = now.p, now.track, now.rail, now.loads, now.contacts
    pull, left = 0.0, rail[1] * p.trailing_weight
    for i in range(loads.size):
        slip = y[3 + i] - v
        contacts[i] = adhesion(slip, rail, now.curve) * loads[i]
        pull += contacts[i]
        if abs(slip) <= p.slip_threshold:
            left += rail[1] * loads[i] + contacts[i]
    resistance = p.r0 + (p.r1 + (p.r2 + track[4]) * v) * v
    within = y[0] - track[0]
    curves = curve_resistance(track[2] + track[3] * within, track[6], track[7])
    along = p.mass * GRAVITY * (track[1] + track[5] * within + curves)
    return pull, resistance, along, min(y[2] + holding_effort(y[1], now.command, p), left)


@njit(cache=True, error_model="numpy")
def net_force(y: FloatArray, now: Step) -> float:
    """Net force on a train that moves or is about to [N]."""
    pull, resistance, along, friction = forces(y, y[1], now)
    return pull - resistance - along - friction


@njit(cache=True, error_model="numpy")
def shift_loads(y: FloatArray, now: Step, weights: FloatArray, transfer: FloatArray) -> None:
    """Loads of the axles under their present forces [N], times the adhesion of each.

    The forces are those of the loads a step before: the suspension needs longer than that.
    """
    n, loads, track = weights.size, now.loads, now.track
    net = net_force(y, now)
    # At rest the brakes hold what is left over.
    acceleration = net / now.p.body_inertia if y[1] > 0.0 or net > 0.0 else 0.0
    specific = acceleration + GRAVITY * (track[1] + track[5] * (y[0] - track[0]))
    for i in range(n):
        change = transfer[i, n] * specific
        for j in range(n):
            change += transfer[i, j] * now.contacts[j]
        share = 1.0 + change / now.p.axle_weight
        loads[i] = weights[i] * max(share, LEAST_LOAD)


@njit(cache=True, error_model="numpy", inline="always")
def stage(y: FloatArray, share: float, reach: float, moving: bool, now: Step) -> None:
    """One stage of Runge-Kutta: the right-hand side at `now.at`, used as it is found.

    `now.end` gains `share` times it, and `now.at` becomes `y` and `reach` times it; the works of
    `now.at` are left alone, as nothing depends on them. Unless `moving`, the brakes and the
    resistances hold the train where it stands.
    """
    command, contacts, pieces, end, at, p = (
        now.command,
        now.contacts,
        now.pieces,
        now.end,
        now.at,
        now.p,
    )
    n = contacts.size
    v = at[1] if moving else 0.0
    works = 3 + 2 * n
    pull, resistance, along, friction = forces(at, v, now)
    traction = 0.0
    braking = 0.0
    slip_power = 0.0
    for i in range(n):
        wheel = at[3 + i]
        lagged = at[3 + n + i]
        effort = motor_effort(lagged, wheel, pieces, i, p)
        change = (effort - contacts[i]) / p.axle_inertia
        end[3 + i] += share * change
        at[3 + i] = y[3 + i] + reach * change
        change = (command[i] - lagged) / p.motor_lag
        end[3 + n + i] += share * change
        at[3 + n + i] = y[3 + n + i] + reach * change
        slip_power += contacts[i] * (wheel - v)
        if effort >= 0.0:
            traction += effort * wheel
        else:
            braking -= effort * wheel
    acceleration = (pull - resistance - along - friction) / p.body_inertia if moving else 0.0
    change = (now.friction_demand - at[2]) / p.friction_lag
    end[0] += share * v
    end[1] += share * acceleration
    end[2] += share * change
    at[0] = y[0] + reach * v
    at[1] = y[1] + reach * acceleration
    at[2] = y[2] + reach * change
    end[works] += share * traction
    end[works + 1] += share * braking
    end[works + 2] += share * (friction * v)
    end[works + 3] += share * (resistance * v)
    end[works + 4] += share * (along * v)
    end[works + 5] += share * slip_power


@njit(cache=True, error_model="numpy")
def runge_kutta(y: FloatArray, h: float, moving: bool, now: Step) -> None:
    """One classical Runge-Kutta step of `h` [s] from `y` into `now.end`."""
    end, at = now.end, now.at
    for j in range(y.size):
        end[j] = at[j] = y[j]
    for k in range(4):
        share = h / 6.0 if k in (0, 3) else h / 3.0
        reach = h if k == 2 else 0.5 * h
        stage(y, share, reach, moving, now)


@njit(cache=True, error_model="numpy")
def protect(
    y: FloatArray,
    wanted: float,
    mode: IntArray,
    memory: FloatArray,
    command: FloatArray,
    pieces: FloatArray,
    p: PlantParameters,
) -> None:
    """Anti-slip control of every axle: the effort commanded [N], from the effort wanted.

    A wheel that slips beyond the threshold for longer than the delay, or that runs away, has its
    effort taken off; once it is back the effort is re-applied, quickly up to a share of that at
    which it slipped, then slowly up to what is wanted. The rows of `memory` are the effort at the
    last slip, the present cap, and how long the wheel has been slipping.
    """
    n = command.size
    slipped, cap, lasting = memory[0], memory[1], memory[2]
    for i in range(n):
        slip = abs(y[3 + i] - y[1])
        lasting[i] = lasting[i] + p.step if slip > p.slip_threshold else 0.0
        if mode[i] != CUT and (lasting[i] > p.slip_delay or slip > RUNAWAY * p.slip_threshold):
            mode[i] = CUT
            slipped[i] = abs(motor_effort(y[3 + n + i], y[3 + i], pieces, i, p))
            cap[i] = 0.0
        elif mode[i] == CUT and slip < p.slip_release:
            mode[i] = RECOVERING
        elif mode[i] == RECOVERING:
            fast = cap[i] < p.slip_reapply * slipped[i]
            cap[i] += p.step * p.axle_effort * (QUICK_REAPPLICATION if fast else p.slip_ramp)
            if cap[i] >= abs(wanted):
                mode[i] = NORMAL
        held = abs(wanted) if mode[i] == NORMAL else min(cap[i], abs(wanted))
        command[i] = held if wanted >= 0.0 else -held


@njit(cache=True, error_model="numpy")
def locate(table: FloatArray, position: float, index: int) -> int:
    """Row of `table` (first column: start) that holds `position`, walking from `index`."""
    last = table.shape[0] - 1
    while index < last and position >= table[index + 1, 0]:
        index += 1
    while index > 0 and position < table[index, 0]:
        index -= 1
    return index


@njit(cache=True, error_model="numpy")
def dynamic_limit(speed: float, curve: FloatArray, p: PlantParameters) -> float:
    """Largest dynamic braking effort of one axle [N] at a speed [m/s]."""
    limit = braking_limit(speed, p)
    if curve.shape[1] > 1:
        start, slope = piece_of(curve, speed)
        limit = min(limit, start + slope * max(speed, 0.0))
    return limit


@njit(cache=True, error_model="numpy")
def move(y: FloatArray, step: float, now: Step) -> None:
    """Advance the state by `step` [s], in place; a train that comes to rest stays at rest."""
    end = now.end
    moving = y[1] > 0.0 or net_force(y, now) > 0.0
    runge_kutta(y, step, moving, now)
    if moving and end[1] <= 0.0:
        if y[1] <= 0.0:
            # Not the literal False: numba would compile the step once more for it.
            runge_kutta(y, step, not moving, now)
        else:
            stop(y, step, now)
    for j in range(y.size):
        y[j] = end[j]


@njit(cache=True, error_model="numpy")
def stop(y: FloatArray, step: float, now: Step) -> None:
    """A step within which the train stops: find the instant (secant), then hold the train there.

    `now.end` holds the end of the whole step with the train moving, and is overwritten.
    """
    end, moving = now.end, y[1] > 0.0
    before, after = 0.0, step
    v_before, v_after = y[1], end[1]
    instant = after
    for _ in range(40):
        instant = before + (after - before) * v_before / (v_before - v_after)
        runge_kutta(y, instant, moving, now)
        if abs(end[1]) < 1e-13:
            break
        if end[1] > 0.0:
            before, v_before = instant, end[1]
        else:
            after, v_after = instant, end[1]
    for j in range(y.size):
        y[j] = end[j]
    y[1] = 0.0
    runge_kutta(y, step - instant, not moving, now)


@njit(cache=True, error_model="numpy")
def sample(y: FloatArray, out: FloatArray, modes: IntArray, now: Step) -> None:
    """Write what `SAMPLE` lists, then wheel speeds and wheel efforts, into `out`."""
    p, n = now.p, now.loads.size
    pull, resistance, along, friction = forces(y, y[1], now)
    net = pull - resistance - along - friction
    out[0] = y[0]
    out[1] = y[1]
    out[2] = net / p.body_inertia if y[1] > 0.0 or net > 0.0 else 0.0
    out[3] = out[4] = 0.0
    for i in range(n):
        effort = motor_effort(y[3 + n + i], y[3 + i], now.pieces, i, p)
        if effort > 0.0:
            out[3] += effort
        else:
            out[4] -= effort
        out[10 + i] = y[3 + i]
        out[10 + n + i] = effort + 0.0  # no negative zero
    out[5] = friction
    out[6] = p.r0 + (p.r1 + p.r2 * y[1]) * y[1] if y[1] > 0.0 else 0.0
    out[7] = now.rail[1]
    out[8] = y[3 + 2 * n]
    out[9] = 0.0
    for mode in modes:
        if mode == CUT:
            out[9] += 1.0


@njit(cache=True, error_model="numpy")
def advance(
    y: FloatArray,
    tractive_effort: float,
    braking_effort: float,
    most_dynamic: float,
    efforts: FloatArray,
    steps: int,
    every: int,
    out: FloatArray,
    track_table: FloatArray,
    rail_table: FloatArray,
    curve_table: FloatArray,
    over_creepage: bool,
    weights: FloatArray,
    transfer: FloatArray,
    memory: FloatArray,
    delay: FloatArray,
    places: IntArray,
    traction_curve: FloatArray,
    braking_curve: FloatArray,
    constants: FloatArray,
) -> None:
    """Advance the state by `steps` steps under one demand, recording before every `every`-th.

    Parameters
    ----------
    y : (3 + 2n + 6,) array
        State, changed in place.
    tractive_effort, braking_effort : float [N]
        Demanded of the whole train.
    most_dynamic : float [N]
        The part of the braking effort that the motors give at most.
    efforts : (n,) or (0,) array [N]
        Of each axle, negative in braking, from a traction control; empty: the train's own slip
        protection shares the demand evenly.
    out : (ceil(steps / every), 10 + 2n) array
    curve_table : (k, 3 + SLIPS) array
        Of the adhesion characteristic, one row a train speed (see `CURVE`); without rows the rail
        table holds the curves.
    over_creepage : bool
        Whether its slips are creepages.
    weights : (n,) array [N]
        Static loads, each times the adhesion of its axle.
    transfer : (n, n + 1) or (0, 1) array
        Of `trainlog.railway.train.load_transfer`; without rows the loads stay.
    memory : (3, n) array
        Of the slip protection of each axle (see `protect`), changed in place.
    delay : (k,) array [N]
        Friction braking demands of the last dead time, a ring, changed in place.
    places : (3 + n,) array
        Rows under the train in the two tables, head of the ring, and mode of each axle's slip
        protection; changed in place.
    traction_curve, braking_curve : (2, m) array [m/s], [N]
        Speeds and efforts of one axle; a single point is no limit.
    constants : (25,) array
        The `PlantParameters`: an array crosses into compiled code faster than a tuple does.
    """
    p = PlantParameters(*to_fixed_tuple(constants, CONSTANTS))
    n = weights.size
    loads = weights.copy()
    end, at = np.empty(y.size), np.empty(y.size)
    command, contacts, pieces = np.empty(n), np.empty(n), np.zeros((4, n))
    for i in range(n):
        pieces[0, i] = pieces[2, i] = np.inf
    curve = np.empty(curve_table.shape[1] if curve_table.shape[0] > 0 else 0)
    heaviest = weights.max() * (1.0 if transfer.shape[0] == 0 else HEAVIEST)
    stiffness = heaviest * (1.0 / p.axle_inertia + 1.0 / p.body_inertia)
    parts, part = 1, p.step
    traction = min(max(tractive_effort, 0.0) / n, p.axle_effort)
    braking = max(braking_effort, 0.0)
    dynamic = min(braking, most_dynamic) / n
    dead_time = p.friction_dead_time + p.friction_lag
    for k in range(steps):
        places[0] = locate(track_table, y[0], places[0])
        places[1] = locate(rail_table, y[0], places[1])
        track = track_table[places[0]]
        rail = rail_table[places[1]]
        find_pieces(y, traction_curve, braking_curve, pieces)
        if curve.size > 0:
            # Steep characteristics at low speed need shorter steps than the plant's.
            find_curve(curve_table, y[1], over_creepage, curve)
            parts = max(int(np.ceil(p.step * stiffness * rail[1] * curve[2] / curve[1])), 1)
            part = p.step / parts
        wanted = traction
        friction_demand = 0.0
        if braking > 0.0:
            wanted = -min(dynamic, dynamic_limit(y[1], braking_curve, p))
        if efforts.size == 0:
            protect(y, wanted, places[3:], memory, command, pieces, p)
        else:
            lowest = -dynamic_limit(y[1], braking_curve, p) if braking > 0.0 else 0.0
            for i in range(n):
                command[i] = max(efforts[i], lowest)
        if braking > 0.0:
            # The friction brake is asked in time for what the dynamic brake will have lost.
            ahead = max(y[1] - braking / p.body_inertia * dead_time, 0.0)
            soon = min(dynamic, dynamic_limit(ahead, braking_curve, p))
            friction_demand = braking
            for i in range(n):
                if efforts.size > 0:
                    friction_demand -= min(soon, -efforts[i])
                else:
                    friction_demand -= soon if places[3 + i] == NORMAL else min(soon, memory[1, i])
            friction_demand = min(max(friction_demand, 0.0), p.friction_effort)
        if delay.size > 0:
            head = places[2]
            delayed = delay[head]
            delay[head] = friction_demand
            places[2] = (head + 1) % delay.size
            friction_demand = delayed
        now = Step(
            command, friction_demand, track, rail, curve, loads, contacts, pieces, end, at, p
        )
        for _ in range(SETTLING if k == 0 else 1):
            if transfer.shape[0] > 0:
                shift_loads(y, now, weights, transfer)
        if k % every == 0:
            sample(y, out[k // every], places[3:], now)
        for _ in range(parts):
            move(y, part, now)

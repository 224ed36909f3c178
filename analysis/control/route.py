"""What a driver on a trajectory knows: the way ahead, and what every configuration can do on it.

Tables along the run lie on a grid of `GRID` metres and are read on a line between two nodes. The
train is known as far as the observed set goes: the hull of its configurations, whose corners
decide what is safe, and from whose middle the controller starts.
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from pandas import Timestamp

from analysis.trajectory.problem import TrajectoryProblem, read_words
from trainlog.arrays import FloatArray
from trainlog.declaration import NotNegative, check
from trainlog.railway import TrackConditionMap, Trajectory
from trainlog.railway.motion import effort_at
from trainlog.railway.resistance import arrays_of
from trainlog.units import GRAVITY

GRID = 5.0
"""Spacing of tables along a route [m]."""

MARGIN = 0.04
"""The controller stays this far below the permitted speed [m/s]; the guard may use it."""

SHARE = 0.96
"""Of the brake that is counted on ahead of lower limits and of the stop; the rest corrects."""

BLENDING = 0.995
"""Of the largest braking effort; while the dynamic brake takes over, friction lags behind."""

ADHESION_SHARE = 0.95
"""Of the map's adhesion that is used: the powered axles do not share the effort alike."""

UNSEEN_SIGMAS = 1.0
"""Standard deviations taken off what a map makes likely where it was not observed, in braking."""

PULLING_SIGMAS = 0.5
"""Standard deviations taken off what a map makes likely, in traction: who slips there loses a
little time, who is cautious loses it everywhere."""

ASSUMED = {"dry": (0.3, 0.15), "wet": (0.15, 0.08)}
"""Adhesion in traction, and in braking ahead of what must be kept, without a map."""

LOWEST_ASSUMED = (0.05, 0.05)
"""The same on rail of any other condition, such as leaves: that of low adhesion."""

SETTLING, SETTLING_SHARE = 10.0, 0.75
"""In the last metres before the stop [m] less is counted on: dynamic brakes fade there."""

CREEP = 3.0
"""Slip speed of wheels on wet rail that gives all it has [m/s] (Zhao et al. (2025), eq. 10)."""

SLOWEST_SHARE = 0.95
"""Of the ceiling that is cruised at, however much the wheels hold."""

AHEAD = 0.5
"""Adhesion is looked up this much further on [s]: efforts follow their demand with a lag."""

PARTS = 5
"""Of a cell, at which limits and adhesion are looked up."""

compiled = njit(cache=True, _nrt=False)
"""Compiles functions that make no arrays, without counting references to the arrays of tables:
numba spent three quarters of the time on that."""


@dataclass(frozen=True, slots=True)
class Margin:
    """Kept for what a train does not know of itself; the defaults are for the true motion.

    Attributes
    ----------
    position : float [m]
        Limits begin so much earlier, and end so much later.
    speed : float [m/s]
        Limits are so much lower.
    """

    position: NotNegative = 0.0
    speed: NotNegative = 0.0

    def __post_init__(self) -> None:
        check(self)


NO_MARGIN = Margin()
"""Of a driver that knows the true motion."""


class TrainLimits(NamedTuple):
    """What every train of the set can do, for the compiled code.

    Attributes
    ----------
    traction, power : float [N], [W]
        The most that each of them can do with comfort.
    braking : float [N]
        All brakes together.
    dynamic, dynamic_power : float [N], [W]
        The part of it that acts at once.
    friction : float [N]
        The other part.
    pull_curve, brake_curve : (2, m) array [m/s], [N]
        Speeds and efforts of traction and dynamic brake; a single point is no limit.
    on_powered, on_all : float [N]
        Weight on the powered axles, and on all of them.
    mass, inertia, constant, linear, quadratic : float
        Of the middle of the set.
    lag, release : float [s]
        Of the friction brake: its lag, and how long it acts on after it is released.
    spinning : float [kg]
        Rotating mass of the powered axles.
    corners : (4, 5) array
        Mass, inertia, constant, linear, quadratic of light and heavy trains with little and much
        resistance.
    net_pull, net_brake : float [N]
        What gives the lightest train its largest acceleration and deceleration where nothing
        resists, if they limit its own acceleration; else infinite.
    """

    traction: float
    power: float
    braking: float
    dynamic: float
    dynamic_power: float
    friction: float
    pull_curve: FloatArray
    brake_curve: FloatArray
    on_powered: float
    on_all: float
    mass: float
    inertia: float
    constant: float
    linear: float
    quadratic: float
    lag: float
    release: float
    spinning: float
    corners: FloatArray
    net_pull: float = np.inf
    net_brake: float = np.inf


class RouteTables(NamedTuple):
    """Tables from `origin` [m] to the stop at `end`, (n,) arrays.

    Attributes
    ----------
    track : [m/s²]
        Deceleration by gradient and curves.
    tunnel : [N/(m/s)²]
        Added to the quadratic term.
    pulling, adhesion
        Maximum adhesion that is counted on in traction and in braking.
    ceiling : [m²/s²]
        Square of the speed from which all that lies ahead can be kept.
    cruising : [m²/s²]
        The same less the speed that the wheels give back to the train when the effort ends that
        holds the speed; runs ahead and programs stay below it, so that the guard need not act.
    goal : [m²/s²]
        Square of the trajectory's speed, of the configuration that arrives last.
    last_pull : float [m]
        Where the trajectory pulls no more.
    """

    origin: float
    end: float
    track: FloatArray
    tunnel: FloatArray
    pulling: FloatArray
    adhesion: FloatArray
    ceiling: FloatArray
    cruising: FloatArray
    goal: FloatArray
    last_pull: float


@compiled
def value(table: FloatArray, origin: float, position: float) -> float:
    """A table at a position [m]; ends are extended."""
    x = (position - origin) / GRID
    if x <= 0.0:
        return table[0]
    if x >= table.size - 1:
        return table[-1]
    i = int(x)
    return table[i] + (x - i) * (table[i + 1] - table[i])


@compiled
def rate(table: FloatArray, origin: float, position: float) -> float:
    """How fast a table changes at a position [1/m]."""
    i = min(max(int((position - origin) / GRID), 0), table.size - 2)
    return (table[i + 1] - table[i]) / GRID


def train_limits(run: TrajectoryProblem) -> TrainLimits:
    """What all configurations of a run can do; limits as those of the trajectory."""
    train, every = run.train, run.configurations
    masses = [pick(c.mass for c in every) for pick in (min, max)]
    inertias = [pick(c.inertia for c in every) for pick in (min, max)]
    drags = np.array([each.resistance.parabola for each in every])
    corners = [
        (mass, inertia, *drag)
        for mass, inertia in zip(masses, inertias, strict=True)
        for drag in (drags.min(axis=0), drags.max(axis=0))
    ]
    constant, linear, quadratic = (0.5 * (drags.min(axis=0) + drags.max(axis=0))).tolist()
    least = min(c.max_power for c in every)
    pull, brake = train.traction_curve_with(least), train.dynamic_braking_curve
    net = train.acceleration_limits == "net"
    most = train.max_acceleration * inertias[0], train.max_deceleration * inertias[0]
    return TrainLimits(
        traction=train.max_tractive_effort if net else min(train.max_tractive_effort, most[0]),
        power=least,
        braking=BLENDING
        * (train.max_braking_effort if net else min(train.max_braking_effort, most[1])),
        dynamic=train.max_dynamic_braking_effort,
        dynamic_power=train.max_dynamic_braking_power,
        friction=train.max_pneumatic_braking_effort,
        pull_curve=np.stack(arrays_of(None if pull is None else pull.without_rise)),
        brake_curve=np.stack(arrays_of(None if brake is None else brake.without_dip)),
        on_powered=train.adhesive_weight(masses[0] - train.mass),
        on_all=GRAVITY * masses[0],
        mass=0.5 * sum(masses),
        inertia=0.5 * sum(inertias),
        constant=constant,
        linear=linear,
        quadratic=quadratic,
        lag=max(train.brake.lag, 1e-3),
        release=train.brake.dead_time + train.brake.lag,
        spinning=train.axles.count * train.axles.rotating_mass,
        corners=np.array(corners, dtype=np.float64),
        net_pull=most[0] if net else np.inf,
        net_brake=BLENDING * most[1] if net else np.inf,
    )


def route_tables(
    run: TrajectoryProblem, trajectory: Trajectory, limits: TrainLimits, margin: Margin = NO_MARGIN
) -> RouteTables:
    """Tables of a run from its start to its end."""
    around, below = margin.position, margin.speed
    count = math.ceil((run.end - run.start) / GRID) + 1
    origin = run.end - GRID * (count - 1)  # the stop is a node
    places = np.clip(origin + GRID * np.arange(count), 0.0, run.line.length)
    # The lowest of both cells at a node: read on a line, no table is above what it stands for.
    fine = origin + GRID * (np.arange(PARTS * (count + 1)) + 0.5 - PARTS) / PARTS
    fine = np.clip(fine, 0.0, run.line.length)
    near = np.clip(fine + np.array([[-around], [0.0], [around]]), 0.0, run.line.length)
    limit = _lowest_around(run.permitted_speed(near).min(axis=0))
    highest = np.maximum(limit - MARGIN - below, 0.5 * limit) ** 2
    highest[-1] = 0.0
    pulling, braking = _adhesion(run, fine)
    goal = np.interp(places, trajectory.positions, trajectory.speeds[trajectory.latest] ** 2)
    pulls = np.flatnonzero(trajectory.tractive_effort > 1e-3 * trajectory.tractive_effort.max())
    found = RouteTables(
        origin=origin,
        end=run.end,
        track=run.track_acceleration(places),
        tunnel=run.train.tunnel_coefficient(run.line.tunnel_cross_section(places)),
        pulling=ADHESION_SHARE * _lowest_around(pulling),
        adhesion=ADHESION_SHARE * _lowest_around(braking),
        ceiling=highest,
        cruising=highest.copy(),
        goal=goal,
        last_pull=float(trajectory.positions[pulls[-1] + 1]),
    )
    brake_ahead(found.ceiling, found, limits)
    found.cruising[:] = found.ceiling
    leave_for_creep(found.cruising, found, limits)
    return found


def _adhesion(run: TrajectoryProblem, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Maximum adhesion that the driver counts on in traction and in braking.

    Where the map was not observed he expects what its own places and neighbours make likely
    (`TrackConditionMap.likely`), which a plan must not rest on; he sees slip and eases off. A risk
    holds for traction and braking, and where nothing was observed. Without a map he knows what is
    usual in such weather.
    """
    if run.condition_map is None:
        usual = ASSUMED.get(run.layer, LOWEST_ASSUMED)
        return np.full(positions.shape, usual[0]), np.full(positions.shape, usual[1])
    own = run.line.length - positions if run.direction == "reverse" else positions
    known = run.adhesion_at(positions)
    likely, pulling = (
        run.condition_map.lower_bound(
            run.layer, own, sigmas, risk=run.risk, time=run.time, likely=True
        )
        for sigmas in (UNSEEN_SIGMAS, PULLING_SIGMAS)
    )
    return pulling, np.where(np.isfinite(known), known, likely)


def counted_on(
    track: TrackConditionMap | None,
    layer: str,
    risk: float | None = None,
    time: Timestamp | None = None,
) -> str:
    """What adhesion a train that follows counts on, in words.

    Examples
    --------
    >>> counted_on(None, "leaves").partition(";")[0]
    'adhesion: leaves rail without a map, low adhesion assumed: 0.05 in traction, 0.05 in braking'
    """
    if track is None:
        pulling, braking = ASSUMED.get(layer, LOWEST_ASSUMED)
        what = "assumed" if layer in ASSUMED else "low adhesion assumed"
        return (
            f"adhesion: {layer} rail without a map, {what}: {pulling:g} in traction, {braking:g} in"
            " braking; slippery spots are not known"
        )
    less = (
        f"less {PULLING_SIGMAS:g} standard deviations in traction, {TrajectoryProblem.sigmas:g} in"
        f" braking ({UNSEEN_SIGMAS:g} where not observed)"
    )
    return f"adhesion: layer {layer}, {read_words(risk, time, less)}"


def _lowest_around(fine: FloatArray) -> FloatArray:
    """The lowest value in the two cells around each node, and of a part beyond."""
    beside = np.pad(fine, 1, mode="edge")
    fine = np.minimum(fine, np.minimum(beside[:-2], beside[2:]))
    cells = fine.reshape(-1, PARTS).min(axis=1)
    return np.asarray(np.minimum(cells[:-1], cells[1:]))


@compiled
def effort_limits(
    p: float, v: float, route: RouteTables, limits: TrainLimits
) -> tuple[float, float]:
    """Largest tractive and braking effort [N] that machine, comfort and adhesion allow."""
    grip = value(route.adhesion, route.origin, p)
    pulling = value(route.pulling, route.origin, p) * limits.on_powered
    pull = min(limits.traction, pulling, limits.power / max(v, 0.1))
    if limits.pull_curve.shape[1] > 1:
        pull = min(pull, effort_at(v, limits.pull_curve[0], limits.pull_curve[1]))
    brake = min(limits.braking, grip * limits.on_all)
    if limits.net_pull < np.inf:
        mass, _, still, linear, square = limits.corners[1]
        along = mass * value(route.track, route.origin, p)
        pull = min(pull, max(limits.net_pull + along + limits.corners[0, 2], 0.0))
        brake = min(brake, max(limits.net_brake - along - still - (linear + square * v) * v, 0.0))
    quick = dynamic_braking(p, v, route, limits)
    return pull, min(brake, BLENDING * (limits.friction + quick))


@compiled
def powered_adhesion(p: float, v: float, route: RouteTables, limits: TrainLimits) -> float:
    """Braking effort [N] that the rail is counted on to bear under the powered axles."""
    ahead = value(route.adhesion, route.origin, p + AHEAD * v)
    return min(value(route.adhesion, route.origin, p), ahead) * limits.on_powered


@compiled
def dynamic_braking(p: float, v: float, route: RouteTables, limits: TrainLimits) -> float:
    """Braking effort [N] that needs no friction brake: it acts on the powered axles alone."""
    most = min(limits.dynamic, limits.dynamic_power / max(v, 0.1))
    if limits.brake_curve.shape[1] > 1:
        most = min(most, effort_at(v, limits.brake_curve[0], limits.brake_curve[1]))
    return min(most, powered_adhesion(p, v, route, limits))


@compiled
def free_deceleration(p: float, v: float, row: FloatArray, route: RouteTables) -> float:
    """Deceleration [m/s²] of a train without effort; a row as of `TrainLimits.corners`."""
    drag = row[2] + (row[3] + (row[4] + value(route.tunnel, route.origin, p)) * v) * v
    return (drag + row[0] * value(route.track, route.origin, p)) / row[1]


@compiled
def brake_ahead(squares: FloatArray, route: RouteTables, limits: TrainLimits) -> None:
    """Lower `squares` to those from which all ahead can be kept by the train that brakes worst.

    The friction brake is released before a lower limit begins, so that it does not act beyond.
    """
    left = np.inf
    for i in range(squares.size - 2, -1, -1):
        place = route.origin + GRID * i
        ahead, best = squares[i + 1], squares[i + 1]
        for _ in range(2):
            v = math.sqrt(0.5 * (ahead + best))
            share = SETTLING_SHARE if route.end - place < SETTLING else SHARE
            brake = share * min(
                effort_limits(place, v, route, limits)[1],
                effort_limits(place + GRID, v, route, limits)[1],
            )
            quick = dynamic_braking(place, v, route, limits)
            if left < limits.release and quick > 0.0:
                brake = min(brake, share * quick)
            worst = 1e9
            for row in limits.corners:
                worst = min(
                    worst, brake / row[1] + free_deceleration(place + 0.5 * GRID, v, row, route)
                )
            best = ahead + 2.0 * GRID * max(worst, 0.0)
        left = left + GRID / max(v, 0.1) if best < squares[i] else 0.0
        squares[i] = min(squares[i], best)


@compiled
def ceiling_square(p: float, route: RouteTables) -> float:
    """Square of the highest speed [m²/s²] at a position."""
    return max(value(route.ceiling, route.origin, p), 0.0)


@compiled
def cruising_square(p: float, route: RouteTables) -> float:
    """Square of the highest speed [m²/s²] at a position that a pulling train can hold."""
    return max(value(route.cruising, route.origin, p), 0.0)


@compiled
def creep_momentum(u: float, p: float, route: RouteTables, limits: TrainLimits) -> float:
    """Momentum [kg m/s] that the powered axles hold by turning faster than the train rolls.

    Under a specific effort `u`; when the traction ends it goes into the train.
    """
    share = (
        max(u, 0.0) * limits.inertia / (value(route.pulling, route.origin, p) * limits.on_powered)
    )
    return limits.spinning * CREEP * min(share, 1.0) ** 2


@compiled
def leave_for_creep(squares: FloatArray, route: RouteTables, limits: TrainLimits) -> None:
    """Lower `squares` by what the wheels hold under the effort that keeps the speed there."""
    for i in range(squares.size):
        place, v = route.origin + GRID * i, math.sqrt(squares[i])
        pull = effort_limits(place, v, route, limits)[0]
        held = 0.0
        for row in limits.corners:
            effort = min(max(row[1] * free_deceleration(place, v, row, route), 0.0), pull)
            momentum = creep_momentum(effort / limits.inertia, place, route, limits)
            held = max(held, momentum / row[1])
        squares[i] = max(v - held, SLOWEST_SHARE * v) ** 2

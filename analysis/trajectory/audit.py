"""Independent audit: every configuration driven along the trajectory's efforts on a fine grid.

It shares no model with the optimiser, only line, train and configurations. Forces are in
newtons, evaluated along the line itself; the efforts are applied as they stand, without feedback.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from analysis.trajectory.discretisation import inside
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.arrays import FloatArray
from trainlog.railway import EffortCurve
from trainlog.units import GRAVITY

_PARTS, _FEWEST, _MOST = 12_000, 8, 24
"""Runge-Kutta sub-steps over the whole grid, and the fewest and the most of a cell, at first."""

_DOUBLINGS, _EXACT = 4, 1e-4
"""How often sub-steps are halved, and the change of an arrival up to which they are short enough
[s]. A train that creeps for minutes passes many changes of the gradient in a cell."""

ARRIVAL_TOLERANCE = 1e-4
"""Lateness that an audited trajectory may have [s]."""

SPEED_TOLERANCE, POINT_TOLERANCE = 1e-6, 1e-5
"""Excess over the permitted speed, and beyond a speed at a passing point [m/s]."""

EFFORT_TOLERANCE = 1e-6
"""Excess over a limit of power, effort or adhesion, relative."""

END_TOLERANCE = 1e-3
"""Excess over the speed required at the end [m/s]: at standstill less than a thousandth mm."""

STOPPING_TOLERANCE = 1e-3
"""Distance by which a train may stop short of the end [m]."""


@dataclass(frozen=True, eq=False)
class Audit:
    """What the rollout of each configuration showed; (q,) arrays unless stated otherwise.

    Attributes
    ----------
    substeps : int
        Of each cell.
    speeds, times : (q, n + 1) array [m/s], [s]
        At the nodes.
    end_speed : [m/s]
    shortfall : [m]
        Distance to the end at which a train stopped too early; 0 if it arrived.
    overspeed : [m/s]
        Largest excess over the permitted speed, negative if it was never reached.
    power, effort, braking, adhesion : largest use of the limit, 1 is all of it
    wheel_energy, line_energy : [J]
        Traction at the wheel rims; taken from the line less what the dynamic brake returns.
    early, tardy : [s]
        By how much it passes a point on the way outside its window of time, at worst.
    slow : [m/s]
        By how much it passes such a point too slowly or too fast.
    """

    substeps: int
    speeds: FloatArray
    times: FloatArray
    end_speed: FloatArray
    shortfall: FloatArray
    overspeed: FloatArray
    power: FloatArray
    effort: FloatArray
    braking: FloatArray
    adhesion: FloatArray
    wheel_energy: FloatArray
    line_energy: FloatArray
    early: FloatArray
    tardy: FloatArray
    slow: FloatArray

    @property
    def arrival(self) -> FloatArray:
        """Running time of each configuration [s]."""
        return np.asarray(self.times[:, -1])

    def failures(self, run: TrajectoryProblem, running_time: float) -> list[str]:
        """Every test that a configuration did not pass, in words."""
        checks = (
            ("arrives late by [s]", self.arrival - running_time, ARRIVAL_TOLERANCE),
            ("passes too early by [s]", self.early, ARRIVAL_TOLERANCE),
            ("passes too late by [s]", self.tardy, ARRIVAL_TOLERANCE),
            ("passes too slowly or too fast by [m/s]", self.slow, POINT_TOLERANCE),
            ("stops short by [m]", self.shortfall, STOPPING_TOLERANCE),
            ("is too fast at the end by [m/s]", self.end_speed - run.final_speed, END_TOLERANCE),
            ("exceeds the permitted speed by [m/s]", self.overspeed, SPEED_TOLERANCE),
            ("exceeds the power by a part of", self.power - 1.0, EFFORT_TOLERANCE),
            ("exceeds the traction by a part of", self.effort - 1.0, EFFORT_TOLERANCE),
            ("exceeds the brake by a part of", self.braking - 1.0, EFFORT_TOLERANCE),
            ("exceeds the adhesion by a part of", self.adhesion - 1.0, EFFORT_TOLERANCE),
        )
        return [
            f"configuration '{run.configurations[row].name}' {what} {excess[row]:.3g}"
            for what, excess, tolerance in checks
            for row in np.flatnonzero(~(excess <= tolerance)).tolist()
        ]


def audit(
    run: TrajectoryProblem,
    positions: FloatArray,
    traction: FloatArray,
    taper: FloatArray,
    braking: FloatArray,
) -> Audit:
    """Drive every configuration of `run` along the given efforts.

    Parameters
    ----------
    positions : (n + 1,) array [m]
    traction : (n,) array [N]
        Mean of each cell.
    taper : (n,) array [N]
        By how much traction is above its mean where a cell begins, and below where it ends.
    braking : (q, n) array [N]
    """
    train, line = run.train, run.line
    step = np.diff(positions)
    # A limit of the train's own acceleration is no limit of its efforts.
    gross = 1.0 if train.acceleration_limits == "gross" else np.inf
    constants = np.array(
        [
            [
                c.mass,
                c.inertia,
                *c.resistance.parabola,
                c.max_power,
                train.adhesive_weight(c.mass - train.mass),
                GRAVITY * c.mass,
                min(train.max_tractive_effort, gross * train.max_acceleration * c.inertia),
                min(train.max_braking_effort, gross * train.max_deceleration * c.inertia),
                np.inf if gross == 1.0 else train.max_acceleration,
                np.inf if gross == 1.0 else train.max_deceleration,
            ]
            for c in run.configurations
        ]
    )
    brakes = np.array(
        [
            train.max_dynamic_braking_effort,
            train.max_dynamic_braking_power,
            train.max_pneumatic_braking_effort,
        ]
    )
    pull_speeds, pull_efforts = _table(train.traction_curve)
    shares = np.array([[c.max_power / train.max_traction_power] for c in run.configurations])
    brake_table = np.stack(_table(train.dynamic_braking_curve))
    substeps, arrival = int(np.clip(_PARTS // step.size, _FEWEST, _MOST)) // 2, np.inf
    for _ in range(_DOUBLINGS + 2):
        track = line.track_acceleration(inside(positions, 2 * substeps), train.strip_length)
        points = positions[:-1, None] + step[:, None] * (np.arange(substeps) + 0.5) / substeps
        tunnel = train.tunnel_coefficient(line.tunnel_cross_section(points))
        speeds, times, found = _roll(
            run.initial_speed, step, traction, taper, braking, constants, brakes, track, tunnel,
            run.permitted_speed(points), run.adhesion_at(points), shares * pull_speeds,
            pull_efforts, brake_table,
        )  # fmt: skip
        before, arrival = arrival, times[:, -1]
        if np.allclose(before, arrival, rtol=0.0, atol=_EXACT):
            break
        substeps *= 2
    early, tardy, slow = _passed(run, positions, speeds, times)
    wheel = np.full(len(run.configurations), float(traction @ step))
    regained = train.efficiency_regeneration * found[:, 6]
    return Audit(
        substeps=tunnel.shape[1],
        speeds=speeds,
        times=times,
        end_speed=speeds[:, -1],
        shortfall=found[:, 0],
        overspeed=found[:, 1],
        power=found[:, 2],
        effort=found[:, 3],
        braking=found[:, 4],
        adhesion=found[:, 5],
        wheel_energy=wheel,
        line_energy=wheel / train.efficiency_traction - regained,
        early=early,
        tardy=tardy,
        slow=slow,
    )


def _passed(
    run: TrajectoryProblem, positions: FloatArray, speeds: FloatArray, times: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far each configuration leaves the windows of the passing points, at worst."""
    early, tardy, slow = (np.full(speeds.shape[0], -np.inf) for _ in range(3))
    for point in run.windows:
        node = int(np.argmin(np.abs(positions - point.position)))
        if point.earliest is not None:
            early = np.maximum(early, point.earliest - times[:, node])
        if point.latest is not None:
            tardy = np.maximum(tardy, times[:, node] - point.latest)
        fastest, slowest = point.highest_speed, point.lowest_speed
        slow = np.maximum(slow, (slowest or 0.0) - speeds[:, node])
        if fastest is not None:
            slow = np.maximum(slow, speeds[:, node] - fastest)
    return early, tardy, slow


def _table(curve: EffortCurve | None) -> tuple[FloatArray, FloatArray]:
    """Speeds [m/s] and efforts [N] of a train's own curve; without one no effort limits."""
    if curve is None:
        return np.array([0.0, 1.0]), np.full(2, np.inf)
    return curve.speeds, curve.efforts


@njit(cache=True)  # type: ignore[untyped-decorator]
def _in_table(v: float, speeds: FloatArray, efforts: FloatArray) -> float:
    """Effort in a table at a speed, by going through its rows; beyond it the power stays."""
    if v >= speeds[-1]:
        return float(efforts[-1] * speeds[-1] / v)
    k = 1
    while speeds[k] < v:
        k += 1
    if efforts[k] == np.inf:
        return np.inf
    share = (speeds[k] - v) / (speeds[k] - speeds[k - 1])
    return float(efforts[k] + (efforts[k - 1] - efforts[k]) * share)


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _roll(
    initial_speed: float, step: FloatArray, traction: FloatArray, taper: FloatArray,
    braking: FloatArray, constants: FloatArray, brakes: FloatArray, track: FloatArray,
    tunnel: FloatArray, limit: FloatArray, adhesion: FloatArray, pull_speeds: FloatArray,
    pull_efforts: FloatArray, brake_table: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Runge-Kutta on half the squared speed; the time of a sub-step is 2 h / (v + v')."""
    q, n = braking.shape
    substeps = tunnel.shape[1]
    speeds, times = np.zeros((q, n + 1)), np.zeros((q, n + 1))
    found = np.zeros((7, q))
    found[1] = -np.inf
    speeds[:, 0] = initial_speed
    mass, inertia, still, linear, square, power, adhesive, weight, pull, brake, most, least = (
        constants.T.copy()
    )
    per = 1.0 / inertia
    half, time, moving = np.full(q, 0.5 * initial_speed**2), np.zeros(q), np.ones(q)
    v, after, k1, part, b = np.empty(q), np.empty(q), np.empty(q), np.empty(q), np.empty(q)
    for k in range(n):
        h, fall = step[k] / substeps, 2.0 * taper[k] / substeps
        b[:] = braking[:, k]
        for j in range(substeps):
            begun = traction[k] + taper[k] - j * fall
            ended = begun - fall
            t0, t1, t2 = track[k, 2 * j], track[k, 2 * j + 1], track[k, 2 * j + 2]
            tun = tunnel[k, j]
            # All configurations in turn: the processor works at several of them at once.
            for a in range(q):
                effort = begun - b[a]
                first = effort - mass[a] * t0 - still[a]
                middle = effort - 0.5 * fall - mass[a] * t1 - still[a]
                last = effort - fall - mass[a] * t2 - still[a]
                drag = square[a] + tun
                y = 2.0 * half[a]
                w = np.sqrt(y)
                c1 = (first - (linear[a] + drag * w) * w) * per[a]
                u = np.sqrt(max(y + h * c1, 0.0))
                c2 = (middle - (linear[a] + drag * u) * u) * per[a]
                u = np.sqrt(max(y + h * c2, 0.0))
                c3 = (middle - (linear[a] + drag * u) * u) * per[a]
                u = np.sqrt(max(y + 2.0 * h * c3, 0.0))
                c4 = (last - (linear[a] + drag * u) * u) * per[a]
                change = h / 6.0 * (c1 + 2.0 * c2 + 2.0 * c3 + c4)
                # It stops within this sub-step: the rest of the way is not travelled.
                stops = half[a] + change <= 0.0
                share = half[a] / -change if change < 0.0 else 0.0
                part[a] = (share if stops else 1.0) * moving[a]
                z = (half[a] + change if half[a] + change > 0.0 else 0.0) * moving[a]
                moving[a] = 1.0 if part[a] >= 1.0 else 0.0
                x = np.sqrt(2.0 * z)
                way = part[a] * h
                whole = 2.0 * way / (w + x)
                inside = 0.25 * (y + 2.0 * z) + 0.125 * way * (c1 - c4)
                between = np.sqrt(2.0 * max(inside, 0.0))
                halves = way / (w + between) + way / (between + x)
                halves = halves if inside > 0.0 else whole
                whole += 4.0 / 3.0 * (halves - whole)
                time[a] += whole if w + x > 0.0 else 0.0
                half[a] = z
                v[a], after[a], k1[a] = w, x, c1
                found[0, a] += (1.0 - part[a]) * h
                fast = w if w > x else x
                fast -= limit[k, j]
                found[1, a] = fast if fast > found[1, a] else found[1, a]
            for a in range(q):
                if part[a] <= 0.0:
                    continue
                if begun > 1.0:
                    found[3, a] = max(found[3, a], k1[a] / most[a])
                if max(begun, ended) > 0.0:
                    found[2, a] = max(found[2, a], max(begun * v[a], ended * after[a]) / power[a])
                    found[3, a] = max(found[3, a], (traction[k] + abs(taper[k])) / pull[a])
                    for value, speed in ((begun, v[a]), (ended, after[a])):
                        given = _in_table(speed, pull_speeds[a], pull_efforts)
                        found[3, a] = max(found[3, a], value / max(given, 1.0))
                    used = max(begun, ended) / (adhesion[k, j] * adhesive[a])
                    found[5, a] = max(found[5, a], used)
                if b[a] > 0.0:
                    dynamic = min(brakes[0], brakes[1] / max(v[a], after[a], 1e-6))
                    dynamic = min(dynamic, adhesion[k, j] * adhesive[a])
                    for each in (v[a], after[a]):
                        dynamic = min(dynamic, _in_table(each, brake_table[0], brake_table[1]))
                    if b[a] > 1e-6 * brake[a]:
                        found[4, a] = max(found[4, a], -k1[a] / least[a])
                    given = max(min(brake[a], dynamic + brakes[2]), 1.0)
                    found[4, a] = max(found[4, a], b[a] / given)
                    found[5, a] = max(found[5, a], b[a] / (adhesion[k, j] * weight[a]))
                    found[6, a] += min(b[a], dynamic) * h * part[a]
        speeds[:, k + 1], times[:, k + 1] = after, time
    return speeds, times, found.T

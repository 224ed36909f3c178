"""Trajectories driven, and least times found, by scipy's DOP853: a judge of the optimiser.

Nothing here is shared with the optimiser or its audit: the forces are made from the numbers of
line, train and configurations, the motion is integrated with step-size control, and the instants at
which a train meets a limit or stops are events of the integrator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from analysis.trajectory.problem import TrajectoryProblem
from trainlog.arrays import FloatArray
from trainlog.railway import Configuration, Trajectory

_G = 9.81
_CURVE = 0.6  # [m]: curve resistance over weight, times the radius
_ACCURACY = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
_SLOW = 1.0
"""Speed below which a cell is integrated in time, not in position [m/s]."""

_TRANSITION = 20.0
"""Length of the pieces of a line with bends [m]."""

_LONGEST = 1e5
"""Time beyond which a cell counts as never left [s]."""


@dataclass(frozen=True)
class Piece:
    """A piece of line on which nothing changes but the curvature, which is linear.

    `start` and `end` [m], permitted speed [m/s], gradient force over weight, curvature at both ends
    [1/m], cross-section of a tunnel [m²].
    """

    start: float
    end: float
    limit: float
    slope: float
    bends: tuple[float, float]
    tunnel: float

    def track(self, s: Any) -> Any:
        """Gradient and curve [m/s²] at a position."""
        share = (s - self.start) / (self.end - self.start)
        bend = abs(self.bends[0] * (1.0 - share) + self.bends[1] * share)
        return _G * (self.slope + _CURVE * bend)


def pieces_of(run: TrajectoryProblem, points: FloatArray | None = None) -> list[Piece]:
    """The run between all places where something changes, and further `points`."""
    line, curves = run.line, run.line.curvatures
    edges = [line.speed_limits.positions, line.gradients.positions, [run.start, run.end]]
    edges += [] if curves is None else [curves.positions]
    edges += [[t.position, t.position + t.length] for t in line.tunnels]
    edges += [] if points is None else [points]
    places = np.unique(np.concatenate(edges))
    if curves is not None:
        # What a train at a limit can pull against changes through a transition.
        parts = np.arange(run.start, run.end, _TRANSITION)
        apart = np.abs(parts[:, None] - places).min(axis=1) > 0.1
        places = np.union1d(places, parts[apart])
    places = places[(places >= run.start) & (places <= run.end)]
    found = []
    for a, b in pairwise(places.tolist()):
        middle = 0.5 * (a + b)
        rise = _step(line.gradients.positions, line.gradients.values, middle)
        bends = (0.0, 0.0)
        if curves is not None:
            k = max(int(np.searchsorted(curves.positions, middle, side="right")) - 1, 0)
            last = curves.positions[k + 1] if k + 1 < curves.positions.size else line.length
            width = float(last - curves.positions[k])
            shares = [(s - float(curves.positions[k])) / width for s in (a, b)]
            first, second = (
                float(curves.start[k] + (curves.end[k] - curves.start[k]) * share)
                for share in shares
            )
            bends = (first, second)
        inside = [t for t in line.tunnels if t.position <= middle < t.position + t.length]
        limit = min(_step(line.speed_limits.positions, line.speed_limits.values, middle),
                    run.train.max_speed)  # fmt: skip
        slope = float(rise / np.hypot(1.0, rise))
        found.append(Piece(a, b, limit, slope, bends, inside[-1].cross_section if inside else 0.0))
    return found


def _step(positions: FloatArray, values: FloatArray, s: float) -> float:
    return float(values[max(int(np.searchsorted(positions, s, side="right")) - 1, 0)])


class Forces:
    """Forces on one configuration [N] or on several, whose numbers are then arrays."""

    def __init__(self, run: TrajectoryProblem, which: list[Configuration]) -> None:
        self.train = run.train
        one = len(which) == 1

        def number(values: list[float]) -> Any:
            return values[0] if one else np.array(values)

        self.mass = number([c.mass for c in which])
        self.inertia = number([c.mass + c.rotating_mass for c in which])
        self.r0, self.r1, self.r2 = (
            number([getattr(c.resistance, name) for c in which]) for name in ("r0", "r1", "r2")
        )
        self.power = number([c.max_power for c in which])
        # Traction is common: what the lightest may accelerate with is the most for all.
        lightest = min(c.mass + c.rotating_mass for c in run.configurations)
        most = run.train.max_acceleration * lightest
        self.most_traction = min(run.train.max_tractive_effort, most)

    def resistance(self, piece: Piece, s: Any, v: Any) -> Any:
        """All that resists."""
        quadratic = self.r2
        if piece.tunnel > 0.0:
            quadratic = quadratic + float(self.train.tunnel_coefficient(piece.tunnel))
        return self.r0 + (self.r1 + quadratic * v) * v + self.mass * piece.track(s)

    def traction(self, v: Any) -> Any:
        """Most tractive effort."""
        found = np.minimum(self.most_traction, self.power / np.maximum(v, 1e-9))
        curve = self.train.traction_curve
        if curve is not None:
            share = self.power / self.train.max_traction_power
            found = np.minimum(found, _curve(curve, v / share))
        return found

    def dynamic(self, v: Any) -> Any:
        """Most effort of the dynamic brake."""
        most = np.minimum(
            self.train.max_dynamic_braking_effort, self.train.max_deceleration * self.inertia
        )
        found = np.minimum(most, self.train.max_dynamic_braking_power / np.maximum(v, 1e-9))
        curve = self.train.dynamic_braking_curve
        return found if curve is None else np.minimum(found, _curve(curve, v))

    def brake(self, v: Any) -> Any:
        """Most effort of all brakes."""
        comfort = self.train.max_deceleration * self.inertia
        return np.minimum(
            comfort, np.minimum(self.train.max_pneumatic_braking_effort, comfort) + self.dynamic(v)
        )

    def used(self, v: Any, traction: float, braking: Any) -> Any:
        """Traction or brake over the most that it may be, the larger."""
        return np.maximum(traction / self.traction(v), braking / np.maximum(self.brake(v), 1.0))


def _curve(curve: Any, v: Any) -> Any:
    """Effort of a curve over speed; beyond its end the power stays."""
    last = curve.speeds[-1]
    return np.interp(v, curve.speeds, curve.efforts) * last / np.maximum(v, last)


@dataclass(frozen=True)
class Driven:
    """How the configurations ran under the efforts of a trajectory; (q,) arrays.

    `arrival` [s], `shortfall` [m] before the end at which one stood, `end_speed` [m/s],
    `overspeed` [m/s] above the permitted speed, `excess` of traction or brake over what power and
    machine give (relative), `wheel` and `line` energy [J], `passing` (points, q) [s] times at the
    passing points.
    """

    arrival: FloatArray
    shortfall: FloatArray
    end_speed: FloatArray
    overspeed: FloatArray
    excess: FloatArray
    wheel: FloatArray
    line: FloatArray
    passing: FloatArray

    def faults(self, run: TrajectoryProblem, found: Trajectory) -> list[str]:
        """Everything that does not hold, in words; empty if all does."""
        certificate = found.certificate
        weights = np.array(run.weights or np.ones(self.wheel.size))
        mine = self.wheel if run.objective == "wheel" else self.line
        energy = float(mine.max())
        if run.objective == "expected":
            energy = float(weights @ mine / weights.sum())
        scale = max(abs(energy), 0.01 * float(self.wheel.max()), 1.0)
        # What little speed is left at the end, as the way that it still takes to brake.
        past = float((self.end_speed**2).max() - run.final_speed**2) / 2.0
        past /= min(run.train.max_deceleration, 0.5)
        early, tardy = 0.0, 0.0
        for point, times in zip(run.windows, self.passing, strict=True):
            if point.earliest is not None:
                early = max(early, point.earliest - float(times.min()))
            if point.latest is not None:
                tardy = max(tardy, float(times.max()) - point.latest)
        checks = (
            ("early at a passing point [s]", early, 1e-2),
            ("late at a passing point [s]", tardy, 1e-2),
            ("late [s]", float((self.arrival - found.running_time).max()), 1e-3),
            ("short of the end [m]", float(self.shortfall.max()), 2e-3),
            ("past the end [m]", past, 2e-3),
            ("over the limit [m/s]", float(self.overspeed.max()), 1e-6),
            ("over power or effort", float(self.excess.max()), 1e-5),
            ("energy wrong by", abs(certificate["energy"] - energy) / scale, 1e-3),
        )
        return [f"{what} {value:.2g}" for what, value, most in checks if not value <= most]


def driven(run: TrajectoryProblem, found: Trajectory) -> Driven:
    """Drive every configuration along a trajectory's efforts, open loop."""
    q = len(run.configurations)
    everyone = Forces(run, list(run.configurations))
    each = [Forces(run, [configuration]) for configuration in run.configurations]
    pieces = pieces_of(run, found.positions)
    cells = np.searchsorted(found.positions, [0.5 * (p.start + p.end) for p in pieces]) - 1
    state = np.zeros((3, q))  # speed, time, regained energy
    state[0] = run.initial_speed
    shortfall, over, excess = np.zeros(q), np.full(q, -np.inf), np.zeros(q)
    moving, passed = np.ones(q, dtype=bool), dict[float, FloatArray]()
    for piece, k in zip(pieces, cells.tolist(), strict=True):
        traction, braking = _efforts(found, k)
        slow = (found.speeds[:, k] < _SLOW) | (found.speeds[:, k + 1] < _SLOW)
        slow |= state[0] < _SLOW
        for row in np.flatnonzero(slow & moving).tolist():
            state[:, row], end, extremes = _in_time(
                piece, each[row], state[:, row], traction, float(braking[row])
            )
            moving[row] = end >= piece.end
            if not moving[row]:
                shortfall[row] = run.end - end
            over[row], excess[row] = np.maximum((over[row], excess[row]), extremes)
        rows = np.flatnonzero(~slow & moving)
        if rows.size:
            part = everyone if rows.size == q and q > 1 else Forces(
                run, [run.configurations[row] for row in rows.tolist()]
            )  # fmt: skip
            state[:, rows], extremes = _in_position(
                piece, part, state[:, rows], traction, braking[rows]
            )
            over[rows], excess[rows] = np.maximum((over[rows], excess[rows]), extremes)
        passed[piece.end] = state[1].copy()
    step = np.diff(found.positions)
    wheel = np.full(q, float(found.tractive_effort @ step))
    train = run.train
    line = wheel / train.efficiency_traction - train.efficiency_regeneration * state[2]
    ends = np.array(list(passed))
    nearest = [ends[np.argmin(np.abs(ends - point.position))] for point in run.windows]
    passing = np.array([passed[float(at)] for at in nearest]).reshape(-1, q)
    return Driven(state[1], shortfall, state[0], over, excess, wheel, line, passing)


def _efforts(found: Trajectory, k: int) -> tuple[Callable[[Any], Any], FloatArray]:
    start, width = float(found.positions[k]), float(found.positions[k + 1] - found.positions[k])
    mean, fall = float(found.tractive_effort[k]), float(found.tractive_effort_fall[k])
    return lambda s: mean + fall * (0.5 - (s - start) / width), found.braking_effort[:, k]


def _in_position(
    piece: Piece, forces: Forces, state: FloatArray, traction: Callable[[Any], Any],
    braking: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """A cell at speed, all configurations at once: ``z = v²/2``, time and regained energy."""
    q = braking.size

    def slopes(s: float, y: FloatArray) -> FloatArray:
        v = np.sqrt(2.0 * np.maximum(y[:q], 1e-12))
        net = traction(s) - braking - forces.resistance(piece, s, v)
        regained = np.minimum(braking, forces.dynamic(v))
        return np.concatenate((net / forces.inertia, 1.0 / v, regained / forces.inertia))

    begin = np.concatenate((0.5 * state[0] ** 2, np.zeros(2 * q)))
    places = np.linspace(piece.start, piece.end, 7)
    found = solve_ivp(slopes, (piece.start, piece.end), begin, t_eval=places, **_ACCURACY)
    z, last = found.y[:q], found.y[:, -1]
    v = np.sqrt(2.0 * np.maximum(z, 0.0))
    pull = np.maximum(traction(places), 0.0)
    used = np.array([forces.used(v[:, j], float(pull[j]), braking) for j in range(places.size)])
    after = np.stack((v[:, -1], state[1] + last[q : 2 * q],
                      state[2] + forces.inertia * last[2 * q :]))  # fmt: skip
    return after, np.stack((v.max(axis=1) - piece.limit, used.max(axis=0) - 1.0))


def _in_time(
    piece: Piece, forces: Forces, state: FloatArray, traction: Callable[[Any], Any], braking: float
) -> tuple[FloatArray, float, FloatArray]:
    """A cell that is slow somewhere, one configuration: where it ends, which may be before."""

    def slopes(_t: float, y: FloatArray) -> list[float]:
        s, v = y[0], max(y[1], 0.0)
        net = traction(s) - braking - forces.resistance(piece, s, v)
        return [v, net / forces.inertia, min(braking, forces.dynamic(v)) * v / forces.inertia]

    def leaves(_t: float, y: FloatArray) -> float:
        return float(y[0] - piece.end)

    def stands(_t: float, y: FloatArray) -> float:
        return float(y[1])

    leaves.terminal, leaves.direction = True, 1.0  # type: ignore[attr-defined]
    stands.terminal, stands.direction = True, -1.0  # type: ignore[attr-defined]
    v = float(state[0])
    if v <= 0.0 and slopes(0.0, np.array([piece.start, 0.0, 0.0]))[1] <= 0.0:
        return state, piece.start, np.array([-np.inf, 0.0])
    found = solve_ivp(slopes, (0.0, _LONGEST), [piece.start, v, 0.0],
                      events=(leaves, stands), **_ACCURACY)  # fmt: skip
    s, v, regained = found.y[:, -1]
    over = float(found.y[1].max()) - piece.limit
    used = [float(forces.used(b, float(traction(a)), braking)) for a, b in found.y[:2].T]
    after = np.array([max(v, 0.0), state[1] + found.t[-1], state[2] + forces.inertia * regained])
    end = piece.end if len(found.t_events[0]) else float(s)
    return after, end, np.array([over, max(used) - 1.0])


class CannotRunError(Exception):
    """A configuration cannot run here at all, whatever its time."""


_ON = 1e-9
"""Relative distance from the braking curve at which a run is on it."""


def least_time(run: TrajectoryProblem, configuration: Configuration) -> float:
    """Least time [s] of one configuration by itself, to the accuracy of the integrator.

    Raises
    ------
    CannotRunError
        If it stalls, or cannot brake for a limit or for the end.
    """
    forces, pieces = Forces(run, [configuration]), pieces_of(run)
    curves = _braking(run, forces, pieces)
    v, time = run.initial_speed, 0.0
    for piece, (ceiling, reached, curve) in zip(pieces, curves, strict=True):
        s = piece.start
        while s < piece.end:
            # Before `reached` the ceiling holds, from there on the braking curve.
            most = ceiling if s < reached else float(curve(s))
            if 0.5 * v * v < most * (1.0 - _ON) - 1e-12:
                s, v, spent = _pulled(piece, forces, s, v, (ceiling, reached, curve))
            elif s < reached:
                v = float(np.sqrt(2.0 * ceiling))
                if float(forces.traction(v)) < forces.resistance(piece, s, v):
                    s, v, spent = _pulled(piece, forces, s, v, (ceiling, reached, curve))
                else:
                    s, spent = reached, (reached - s) / v
            else:
                s, v, spent = _braked(piece, forces, s, float(np.sqrt(2.0 * most)))
            time += spent
    return time


def _braking(
    run: TrajectoryProblem, forces: Forces, pieces: list[Piece]
) -> list[tuple[float, float, Callable[[float], Any]]]:
    """Of each piece: the permitted z, and from where on the train brakes along which curve."""
    z, found = 0.5 * run.final_speed**2, []
    for piece in reversed(pieces):
        ceiling = 0.5 * piece.limit**2
        z = min(z, ceiling)

        def slopes(back: float, y: FloatArray, piece: Piece = piece) -> list[float]:
            v = float(np.sqrt(2.0 * max(y[0], 0.0)))
            slowing = forces.brake(v) + forces.resistance(piece, piece.end - back, v)
            return [slowing / forces.inertia]

        def meets(_back: float, y: FloatArray, ceiling: float = ceiling) -> float:
            return float(y[0] - ceiling)

        def ends(_back: float, y: FloatArray) -> float:
            return float(y[0])

        meets.terminal, meets.direction = True, 1.0  # type: ignore[attr-defined]
        ends.terminal, ends.direction = True, -1.0  # type: ignore[attr-defined]
        width, begin = piece.end - piece.start, slopes(0.0, np.array([z]))[0]
        if z >= ceiling * (1.0 - 1e-12) and begin >= 0.0:
            found.append((ceiling, piece.end, lambda _s, z=ceiling: z))
            z = ceiling
            continue
        if z <= 0.0 and begin <= 0.0:
            raise CannotRunError(f"cannot stop at km {piece.end / 1e3:.3f}")
        arc = solve_ivp(slopes, (0.0, width), [z], events=(meets, ends),
                        dense_output=True, **_ACCURACY)  # fmt: skip
        if len(arc.t_events[1]):
            raise CannotRunError(f"cannot brake on the slope at km {piece.end / 1e3:.3f}")
        reached = piece.end - float(arc.t[-1]) if len(arc.t_events[0]) else piece.start
        found.append((ceiling, reached, lambda s, arc=arc, end=piece.end: arc.sol(end - s)[0]))
        z = float(arc.y[0, -1])
    if 0.5 * run.initial_speed**2 > z * (1.0 + 1e-9) + 1e-9:
        raise CannotRunError("starts too fast to brake in time")
    return found[::-1]


def _pulled(
    piece: Piece, forces: Forces, s: float, v: float,
    curve: tuple[float, float, Callable[[float], Any]],
) -> tuple[float, float, float]:  # fmt: skip
    """Full traction until the piece ends or the braking curve is met: position, speed, time."""
    ceiling, reached, braking = curve

    def slopes(_t: float, y: FloatArray) -> list[float]:
        speed = max(y[1], 0.0)
        net = float(forces.traction(speed)) - forces.resistance(piece, y[0], speed)
        return [speed, net / forces.inertia]

    def most(s: float) -> float:
        return ceiling if s < reached else float(braking(min(s, piece.end)))

    def leaves(_t: float, y: FloatArray) -> float:
        return float(y[0] - piece.end)

    def stands(_t: float, y: FloatArray) -> float:
        return float(y[1])

    def meets(_t: float, y: FloatArray) -> float:
        return float(0.5 * y[1] ** 2 - most(y[0]))

    for event, direction in ((leaves, 1.0), (stands, -1.0), (meets, 1.0)):
        event.terminal, event.direction = True, direction  # type: ignore[attr-defined]
    if v <= 0.0 and slopes(0.0, np.array([s, 0.0]))[1] <= 0.0:
        raise CannotRunError(f"cannot start at km {s / 1e3:.3f}")
    found = solve_ivp(slopes, (0.0, _LONGEST), [s, v], events=(leaves, stands, meets),
                      **_ACCURACY)  # fmt: skip
    if len(found.t_events[1]) or found.t[-1] >= _LONGEST:
        raise CannotRunError(f"stalls at km {found.y[0, -1] / 1e3:.3f}")
    end = piece.end if len(found.t_events[0]) else float(found.y[0, -1])
    return end, float(found.y[1, -1]), float(found.t[-1])


def _braked(piece: Piece, forces: Forces, s: float, v: float) -> tuple[float, float, float]:
    """Full braking to the end of the piece, or to the stop there: position, speed, time."""

    def slopes(_t: float, y: FloatArray) -> list[float]:
        speed = max(y[1], 0.0)
        slowing = float(forces.brake(speed)) + forces.resistance(piece, y[0], speed)
        return [speed, -slowing / forces.inertia]

    def leaves(_t: float, y: FloatArray) -> float:
        return float(y[0] - piece.end)

    def stands(_t: float, y: FloatArray) -> float:
        return float(y[1])

    for event, direction in ((leaves, 1.0), (stands, -1.0)):
        event.terminal, event.direction = True, direction  # type: ignore[attr-defined]
    found = solve_ivp(slopes, (0.0, _LONGEST), [s, v], events=(leaves, stands), **_ACCURACY)
    return piece.end, max(float(found.y[1, -1]), 0.0), float(found.t[-1])

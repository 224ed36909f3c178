"""Lower bound of the problem that is not cut into cells: the Hamiltonian's least value by place.

Weak duality for the continuous problem of Cunillera et al. (2022), eq. (1) to (10). With any price
of time ``mu`` and any costate ``lambda``, a function of the position that is continuous except
where the speed is limited, no trajectory takes less energy than::

    integral of min H(s, v, u) ds over v and u  -  mu T  +  what the ends add,

    H = c u_f - eta u_d + mu / v + lambda (drag(v) - gain (u_f - u_b)) - lambda' v²/2

with ``c`` the price of traction and ``eta`` that of what the dynamic brake feeds back. Controls may
change anywhere, and the least value over the speed is a global one; nothing depends on cells. The
costates of an optimum on cells, interpolated such that they satisfy the adjoint equation along its
speeds, make the bound as close as the optimum on cells is to that without. The Hamiltonian of the
plan less the least one, in each cell, states what the cell costs, and where cells must be shorter.

A multiplier is the mean of the costate over its cell. Between, the costate follows the adjoint
equation along the plan, but where it stands at the level of a partial control.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from analysis.trajectory.convex import Multipliers, work
from analysis.trajectory.discretisation import (
    Curves,
    DiscreteProblem,
    Plan,
    Taper,
    effort_limits,
    most_efforts,
)
from analysis.trajectory.envelope import Envelope, Floor
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.arrays import BoolArray, FloatArray, IntArray

_NEWTON_STEPS = 8

_REACH, _ROUNDING = 1e-5, 1e-6
"""By which the fastest run may be faster than its grid has it, relative and [m/s]."""

LEAST_SPEED = 1e-6

_ROUNDED = 1e-9
"""Of a Hamiltonian that is computed, relative."""

_LITTLE = 1e-8
"""Part of the bound that a point may miss, and is not looked at again."""

_RANGES, _HALVINGS = (0.0, 1.003, 1.03, 1.3, np.inf), 8
"""Ranges of traction, as multiples of the plan's, and how often one is halved at most."""

_BY_POINT = (
    *("drag0", "drag2", "time", "share", "by_dynamic", "braking", "friction", "dynamic"),
    *("lowest", "highest", "speed", "traction", "pulled"),
)
"""What a Hamiltonian has of each point."""


@dataclass(frozen=True, eq=False)
class Prices:
    """What traction, regained energy, time and limits are worth.

    Attributes
    ----------
    traction : float
    regained : (q,) array
    time : (q, n) array [J/(kg s)]
    share : (q, n) array
        Of what traction is worth at its limit, by whose power limits it; the rest is the effort's.
    dynamic : (q, n) array
        Of the dynamic brake at its power limit.
    multipliers : Multipliers
    """

    traction: float
    regained: FloatArray
    time: FloatArray
    share: FloatArray
    dynamic: FloatArray
    multipliers: Multipliers

    @staticmethod
    def of(problem: DiscreteProblem, multipliers: Multipliers) -> Prices:
        """By multipliers."""
        train, (q, _) = problem.run.train, problem.shape
        traction, regained = 1.0, np.zeros(q)
        if problem.run.at_line:
            traction = 1.0 / train.efficiency_traction
            share = multipliers.share / max(float(multipliers.share.sum()), 1e-300)
            regained = train.efficiency_regeneration * share
        # What traction is worth at its limit; the limit by effort has the rest of it.
        worth = multipliers.pull.sum(axis=0) - traction * problem.step
        limited = np.maximum(multipliers.power.sum(axis=0), worth)
        share = multipliers.power / np.maximum(limited, 1e-300)
        if q == 1:
            share = np.ones_like(share)
        dynamic = np.clip(multipliers.dynamic_power / problem.step, 0.0, regained[:, None])
        time = multipliers.cell_prices(problem)
        return Prices(traction, regained, time, share, dynamic, multipliers)

    def of_times(self, problem: DiscreteProblem, running_time: float) -> float:
        """Times allowed, each at its price [J/kg]."""
        found = self.multipliers
        total = running_time * float(found.time.sum())
        for prices, times, sign in (
            (found.passing, problem.latest, 1.0),
            (found.opening, problem.earliest, -1.0),
        ):
            bounded = np.isfinite(times)
            total += sign * float(prices.sum(axis=0)[bounded] @ times[bounded])
        return total


@dataclass(frozen=True, eq=False)
class Segments:
    """The cells with points of a quadrature.

    Attributes
    ----------
    length : (n,) array [m]
    place : (n, p) array
        Of the points, as parts of the cell's length.
    weights : (n, p) array [m]
    positions : (n, p) array [m]
    gathering : (p, p) array
        Integrals from the beginning of a cell to each point, of values times their weights.
    """

    length: FloatArray
    place: FloatArray
    weights: FloatArray
    positions: FloatArray
    gathering: FloatArray

    def gathered(self, values: FloatArray) -> FloatArray:
        """Integrals of values at the points, from the beginning of the cell, (..., n, p)."""
        return np.asarray((values * self.weights) @ self.gathering.T)

    def mean(self, values: FloatArray) -> FloatArray:
        """Of values at the points, over each cell, (..., n)."""
        return np.asarray((values * self.weights).sum(axis=-1) / self.length)

    @staticmethod
    def of(problem: DiscreteProblem, points: int) -> Segments:
        """With so many points in each cell."""
        nodes, weights = np.polynomial.legendre.leggauss(points)
        nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
        length, powers = problem.step, np.arange(points)
        rising = nodes[:, None] ** (powers + 1) / (powers + 1)
        gathering = rising @ np.linalg.inv(nodes[:, None] ** powers) / weights
        place, part = np.tile(nodes, (length.size, 1)), np.tile(weights, (length.size, 1))
        # Time goes with the root of the way from or to a standstill; so do the points.
        if problem.initial == 0.0:
            place[0], part[0] = nodes**2, 2.0 * nodes * weights
        if problem.final == 0.0:
            place[-1], part[-1] = 1.0 - (1.0 - nodes) ** 2, 2.0 * (1.0 - nodes) * weights
        positions = problem.positions[:-1, None] + length[:, None] * place
        return Segments(length, place, length[:, None] * part, positions, gathering)


@dataclass(frozen=True, eq=False)
class _Piece:
    """``offset + power / v + slope v``: an effort over a range of speeds."""

    offset: FloatArray
    power: FloatArray
    slope: FloatArray

    @staticmethod
    def of(
        effort: FloatArray, power: FloatArray, curves: Curves | None, speed: FloatArray
    ) -> _Piece:
        """The limit by effort, power or curve that is lowest at the speeds; none is below it."""
        none = np.zeros(speed.shape)
        by_power = power < effort * speed
        offset = np.where(by_power, 0.0, effort)
        found = _Piece(offset, np.where(by_power, power, 0.0), none)
        if curves is None:
            return found
        share = curves.share[:, None, None]
        v, f = curves.own.speeds, curves.own.efforts
        slopes = np.append(np.diff(f) / np.diff(v), 0.0)
        at = np.clip(np.searchsorted(v, speed / share, side="right") - 1, 0, v.size - 1)
        beyond = at == v.size - 1
        last = np.where(beyond, f[-1] * v[-1] * share, 0.0)
        line = np.where(beyond, 0.0, f[at] - slopes[at] * v[at])
        own = _Piece(line, last, np.where(beyond, 0.0, slopes[at] / share))
        lower = own.at(speed) < found.at(speed)
        names = ("offset", "power", "slope")
        return _Piece(*(np.where(lower, getattr(own, n), getattr(found, n)) for n in names))

    def at(self, speed: FloatArray) -> FloatArray:
        return np.asarray(self.offset + self.power / speed + self.slope * speed)


class Hamiltonian:
    """The Hamiltonian at the points of cells, for q configurations; arrays (q, n, p)."""

    def __init__(
        self,
        problem: DiscreteProblem,
        plan: Plan,
        prices: Prices,
        fastest: Envelope,
        run: TrajectoryProblem,
        segments: Segments,
        floor: Floor | None = None,
    ) -> None:
        self.problem, self.plan, self.prices, self.segments = problem, plan, prices, segments
        self.fastest = fastest
        s = segments.positions
        coefficients = np.array(
            [[c.mass, c.inertia, *c.resistance.parabola[::2]] for c in problem.run.configurations]
        )
        mass, inertia, constant, square = coefficients.T[:, :, None, None]
        tunnel = run.train.tunnel_coefficient(run.line.tunnel_cross_section(s))
        self.drag0 = (constant + mass * problem.run.track_acceleration(s)) / inertia
        self.drag1, self.drag2 = problem.drag1[:, None, None], (square + tunnel) / inertia
        self.gain, self.time = problem.gain[:, None, None], prices.time[:, :, None]
        self.share, self.regained = prices.share[:, :, None], prices.regained[:, None, None]
        self.power = problem.power[:, None, None]
        self.by_dynamic = prices.dynamic[:, :, None]
        self.traction = _limits_at(run, problem.reference, s)[0].min(axis=0)
        brakes = _limits_at(problem.run, problem.reference, s)[1:]
        self.braking, self.friction, self.dynamic = brakes
        self.highest = np.minimum(run.permitted_speed(s), reached(fastest, s))
        self.highest = np.maximum(self.highest, LEAST_SPEED)
        lowest = 0.0 if floor is None else floor.at(s)
        self.lowest = np.minimum(np.maximum(lowest, LEAST_SPEED), self.highest)
        part, step, fall = segments.place, problem.step[:, None], problem.taper.fall[:, None]
        z = plan.z[:, :-1, None] + np.diff(plan.z, axis=1)[:, :, None] * part
        z = z + self.gain * fall * step * part * (1.0 - part)
        # Resistance that changes inside a cell bends it, too.
        v = np.sqrt(2.0 * np.maximum(z, 0.0))
        drag = self.drag0 + self.drag1 * v + self.drag2 * v**2
        z = z - segments.gathered(drag - segments.mean(drag)[:, :, None])
        self.speed = np.clip(np.sqrt(2.0 * np.maximum(z, 0.0)), self.lowest, self.highest)
        self.pulled = plan.traction[:, None] + fall * (1.0 - 2.0 * part)

    def slopes(self, costate: FloatArray) -> FloatArray:
        """The adjoint equation: what the costate changes by along the plan's speeds."""
        a, b, c, _ = self.along(costate, self.speed)
        return np.asarray((b - a / self.speed**2) / self.speed + 2.0 * c)

    def least(self, costate: FloatArray, slope: FloatArray) -> FloatArray:
        """The least Hamiltonian over all speeds and controls, (n, p) [J/(kg m)].

        Each configuration at its own least, where their limits share what traction is worth.
        """
        return np.asarray(self._least_apart(costate, slope) + self._braked(costate))

    def raised(self, least: FloatArray, costate: FloatArray, slope: FloatArray) -> FloatArray:
        """That least, higher where no traction is more than the speeds of all allow together."""
        brake, plan = self._braked(costate), self.of_plan(costate, slope)
        missing = (plan - least) * self.segments.weights
        little = _LITTLE * np.abs((least * self.segments.weights).sum())
        at = np.nonzero(self._worth(costate) * self.share.sum(axis=0) * (missing > little) > 0.0)
        found, brake = least.copy(), np.broadcast_to(brake, least.shape)[at]
        jointly = self._least_jointly(at, costate, slope, plan[at] - brake)
        found[at] = np.maximum(found[at], jointly + brake)
        return found

    def _worth(self, costate: FloatArray) -> FloatArray:
        """How much more than its price traction is worth, if it is."""
        worth = (costate * self.gain).sum(axis=0) - self.prices.traction
        return np.asarray(np.maximum(worth, 0.0))

    def _least_apart(self, costate: FloatArray, slope: FloatArray) -> FloatArray:
        """The least without a common brake."""
        edges, found = self._edges(costate.shape), np.full(costate.shape, np.inf)
        v = np.clip(self.speed, self.lowest, self.highest)
        a, b, c, constant = self.along(costate, v)
        enough = a / v + b * v + (c - 0.5 * slope) * v**2 + constant
        enough += _ROUNDED * (1.0 + np.abs(enough))
        for low, high in pairwise(edges):
            a, b, c, constant = self.along(costate, 0.5 * (low + high))
            c = c - 0.5 * slope
            # Each term at its better end: a piece of a curve that has more than the plan is passed.
            ends = a / np.where(a > 0.0, high, low) + b * np.where(b > 0.0, low, high)
            ends += c * np.where(c > 0.0, low, high) ** 2 + constant
            near = (high > low) & (ends <= enough)
            span = low[near], high[near]
            value = _least(a[near], b[near], c[near], span, v[near]) + constant[near]
            found[near] = np.minimum(found[near], np.maximum(value, ends[near]))
        alone = np.maximum(1.0 - self.share.sum(axis=0), 0.0) * self.traction
        return np.asarray(found.sum(axis=0) - alone * self._worth(costate))

    def _least_jointly(
        self,
        at: tuple[Any, ...],
        costate: FloatArray,
        slope: FloatArray,
        enough: FloatArray,
    ) -> FloatArray:
        """The least at some points where no traction is more than all of the speeds allow.

        Apart, the train whose power limits the traction would slow down for the others to have
        more of it. Here the traction is in one of several ranges: in each all are slow enough for
        the least of it, and have no more than the most. The range with the least value is halved
        until it is `enough`.
        """

        def least(points: IntArray, low: FloatArray, high: FloatArray) -> FloatArray:
            places: tuple[Any, ...] = tuple(each[points] for each in at)
            part, empty = self._at(places)._pulling(low[:, None], high[:, None])
            its = (each[:, *places][:, :, None] for each in (costate, slope))
            return np.asarray(np.where(empty, np.inf, part._least_apart(*its))[:, 0])

        every, pulled = np.arange(enough.size), np.maximum(self.pulled[at], LEAST_SPEED)
        ranges = [(pulled * low, pulled * high) for low, high in pairwise(_RANGES)]
        value = np.array([least(every, *each) for each in ranges])
        low, high = (np.array(each) for each in zip(*ranges, strict=True))
        for _ in range(_HALVINGS):
            lowest = value.argmin(axis=0)
            short = np.flatnonzero(value[lowest, every] < enough)
            if not short.size:
                break
            halved = lowest[short], short
            begin, end = np.maximum(low[halved], pulled[short]), high[halved]
            middle = np.sqrt(begin * np.minimum(end, 4.0 * begin))
            upper = [np.full(enough.size, np.inf) for _ in range(3)]
            for row, values in zip(upper, (middle, end, least(short, middle, end)), strict=True):
                row[short] = values
            value[halved], high[halved] = least(short, low[halved], middle), middle
            low, high, value = (
                np.vstack(each) for each in zip((low, high, value), upper, strict=True)
            )
        return np.asarray(value.min(axis=0))

    def _at(self, places: tuple[Any, ...]) -> Hamiltonian:
        """The same at some points alone, (q, m, 1)."""
        found, shape = copy(self), self.speed.shape
        for name in _BY_POINT:
            values = np.broadcast_to(getattr(self, name), shape[-np.ndim(getattr(self, name)) :])
            setattr(found, name, values[..., *places][..., None])
        return found

    def _pulling(self, low: FloatArray, high: FloatArray) -> tuple[Hamiltonian, BoolArray]:
        """The same where all have a traction of at least `low` and none of more than `high`.

        And where there is none.
        """
        found = copy(self)
        found.traction = np.minimum(self.traction, high)
        highest = np.minimum(self.highest, self._reach(low))
        found.highest = np.maximum(highest, self.lowest)
        return found, (low > self.traction) | (highest < self.lowest).any(axis=0)

    def _reach(self, effort: FloatArray) -> FloatArray:
        """The highest speed at which power and curve leave so much traction, (q, ...) [m/s]."""
        effort = np.maximum(effort * (1.0 - _ROUNDED), 1e-12)
        curves = self.problem.curves
        if curves is None:
            return np.asarray(self.power / effort)
        v, f = curves.own.speeds, curves.own.efforts
        falling = np.maximum.accumulate(f[::-1])
        own = np.where(effort <= f[-1], f[-1] * v[-1] / effort, np.interp(effort, falling, v[::-1]))
        return np.minimum(self.power / effort, own * curves.share[:, None, None])

    def of_plan(self, costate: FloatArray, slope: FloatArray) -> FloatArray:
        """The plan's own Hamiltonian, (n, p) [J/(kg m)]."""
        v = self.speed
        drag = self.drag0 + self.drag1 * v + self.drag2 * v**2
        braking = self.gain * self.plan.braking[:, :, None]
        own = self.time / v + costate * (drag + braking) - 0.5 * slope * v**2
        own = own - self.regained * self.plan.dynamic[:, :, None]
        worth = self.prices.traction - (costate * self.gain).sum(axis=0)
        return np.asarray(own.sum(axis=0) + worth * self.pulled)

    def excess(self, along: tuple[FloatArray, FloatArray], least: FloatArray) -> FloatArray:
        """By how much the plan's Hamiltonian is above a least one, in each cell [J/kg]."""
        missing = (self.of_plan(*along) - least) * self.segments.weights
        return np.asarray(np.maximum(missing.sum(axis=1), 0.0))

    def _edges(self, shape: tuple[int, ...]) -> FloatArray:
        """Speeds between which each limit is one of effort, power, or a line of a curve."""
        problem = self.problem
        least = self.lowest
        found = [least, self.power / np.maximum(self.traction, 1e-12)]
        if problem.curves is not None:
            found.append(self._reach(self.traction))
        if problem.run.at_line or np.any(problem.friction < problem.braking):
            found.append(problem.dynamic_power / np.maximum(self.dynamic, 1e-12))
        for curves in (problem.curves, problem.dynamic_curves):
            if curves is not None:
                knots = curves.own.speeds[curves.own.speeds < curves.fastest]
                found += [knot * curves.share[:, None, None] for knot in knots[1:].tolist()]
        found.append(self.highest)
        clipped = [np.clip(np.broadcast_to(e, shape), least, self.highest) for e in found]
        return np.sort(np.stack(clipped), axis=0)

    def along(
        self, costate: FloatArray, speed: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The least over the controls, ``a / v + b v + c v² + constant`` about the speeds."""
        worth = self._worth(costate)
        pull = _Piece.of(self.traction, self.power, self.problem.curves, speed)
        by_pull, own = worth * self.share, costate * self.gain
        a = self.time - by_pull * pull.power
        b = costate * self.drag1 - by_pull * pull.slope
        constant = costate * self.drag0 - by_pull * pull.offset
        power = np.asarray(self.problem.dynamic_power)
        brake = _Piece.of(self.dynamic, power, self.problem.dynamic_curves, speed)
        if self.problem.common:
            by_brake = self.by_dynamic
        else:
            # Against a costate below zero all brakes are worth more than what one regains.
            short = self.friction + brake.at(speed) < self.braking
            by_brake = np.maximum(self.regained - np.where(short, own, np.maximum(own, 0.0)), 0.0)
            most = np.where(short, self.friction, self.braking)
            constant = constant + np.minimum(own, 0.0) * most
        return (
            a - by_brake * brake.power,
            b - by_brake * brake.slope,
            costate * self.drag2,
            constant - by_brake * brake.offset,
        )

    def _braked(self, costate: FloatArray) -> FloatArray:
        """The least of a braking effort for all: in a corner of its limits, (n, p)."""
        if not self.problem.common:
            return np.zeros(1)
        most = self.braking.min(axis=0)
        worth = (costate * self.gain).sum(axis=0)
        left = self.regained - self.by_dynamic
        least = np.zeros(most.shape)
        for corner in (most, *np.broadcast_to(self.dynamic, costate.shape)):
            effort = np.minimum(corner, most)
            value = worth * effort - (left * np.minimum(effort, self.dynamic)).sum(axis=0)
            least = np.minimum(least, value)
        return least


def reached(fastest: Envelope, positions: FloatArray) -> FloatArray:
    """Speeds that no trajectory exceeds, (q, ...) [m/s].

    Between the nodes of the fastest run its ``z`` is at most what the slopes of the cells on either
    side lead to: it may turn from traction to the brake there.
    """
    s, z, place = fastest.positions, 0.5 * fastest.speeds**2, positions.ravel()
    cell = np.clip(np.searchsorted(s, place, side="right") - 1, 0, s.size - 2)
    slopes = np.diff(z, axis=1) / np.diff(s)
    before, after = np.maximum(cell - 1, 0), np.minimum(cell + 1, s.size - 2)
    bend = np.maximum(slopes[:, before], slopes[:, cell]) - np.minimum(
        slopes[:, after], slopes[:, cell]
    )
    length = s[cell + 1] - s[cell]
    away = place - s[cell]
    highest = z[:, cell] + slopes[:, cell] * away + bend * away * (length - away) / length
    found = np.sqrt(2.0 * np.maximum(highest, 0.0)) * (1.0 + _REACH) + _ROUNDING
    return np.asarray(found.reshape(-1, *positions.shape))


def _limits_at(
    run: TrajectoryProblem, reference: float, positions: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Limits of traction, all brakes, friction and dynamic brake at positions, (q, n, p) [m/s²]."""
    places, size = positions.reshape(-1, 1), (len(run.configurations), positions.size)
    if run.condition_map is None and run.train.acceleration_limits == "gross":
        places = places[:1]
    limits = effort_limits(run, places, run.adhesion_at(places[:, 0]))
    traction, braking, friction, dynamic = (
        np.broadcast_to(each / reference, size).reshape(-1, *positions.shape)
        for each in (limits.traction, limits.braking, limits.friction, limits.dynamic)
    )
    return traction, braking, friction, dynamic


def _least(
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    span: tuple[FloatArray, FloatArray],
    start: FloatArray,
) -> FloatArray:
    """What ``a / v + b v + c v²`` is not below in a span of speeds.

    It bends one way up to some speed and the other way beyond. Where it is concave the least is at
    an end; where it is convex any tangent bounds it, and Newton's method finds a close one.
    """
    low, high = span
    turn = np.cbrt(np.abs(a) / np.maximum(np.abs(c), 1e-300))
    begin = np.where((a < 0.0) & (c > 0.0), np.clip(turn, low, high), low)
    end = np.where((a > 0.0) & (c < 0.0), np.clip(turn, low, high), high)
    concave = (a <= 0.0) & (c <= 0.0)
    v, best = np.clip(_below(a, b, c, start), begin, end), np.full(a.shape, -np.inf)
    for _ in range(_NEWTON_STEPS):
        slope = b - a / v**2 + 2.0 * c * v
        down = np.minimum(slope * (begin - v), slope * (end - v))
        best = np.maximum(best, a / v + b * v + c * v**2 + down)
        bend = np.maximum(2.0 * (a / v**3 + c), 1e-12)
        v = np.clip(v - slope / bend, begin, end)
    ends = np.minimum(*(a / at + b * at + c * at**2 for at in span))
    return np.asarray(np.where(concave, ends, np.minimum(ends, best)))


def _below(a: FloatArray, b: FloatArray, c: FloatArray, start: FloatArray) -> FloatArray:
    """A speed a little below where ``a / v + b v + c v²`` is least: from there Newton converges.

    For the root of ``b v² + 2 c v³ = a``, by the terms alone; the start where `a` is not positive.
    """
    a = np.maximum(a, 0.0)
    linear, cubic = np.maximum(b, 1e-300), np.maximum(c, 1e-300)
    both = np.minimum(np.sqrt(0.5 * a / linear), np.cbrt(0.25 * a / cubic))
    falling = np.maximum(np.cbrt(0.5 * a / cubic), 0.5 * np.maximum(-b, 0.0) / cubic)
    found = np.where(c > 0.0, np.where(b > 0.0, both, falling), np.sqrt(a / linear))
    return np.asarray(np.where(a > 0.0, found, start))


_CREEPING = 2.0
"""Speed below which a train that starts or stops does so at its fastest [m/s]."""

_AT_FASTEST = 3e-3
"""Part of the fastest run's ``z`` within which a plan is at it."""

_AT_LIMIT = 1e-5
"""Part of the permitted ``z`` within which a plan is at its limit."""

_LEVEL = 1e-5
"""Within which a costate is at the level where a control is partial."""

_INSIDE, _NEAR_LEVEL = 1e-3, 1e-2
"""Part of its limit by which a control is inside, and within which its costate is at the level."""

_STANDING = 0.1
"""Speed below which a plan that could go faster all but stands [m/s]."""


@dataclass(frozen=True, eq=False)
class Costate:
    """The costate as a function of the position: its values at the ends of cells.

    Attributes
    ----------
    segments : Segments
    begin, end : (q, n) array
    even : (q, n) array of bool
        Where it is linear; elsewhere it follows the adjoint equation.
    give : (q, n) array
        By which part each gives way where the sum of the costates is level.
    at_nodes : (n + 1,) array [J/kg]
        What its jumps and its values at both ends of the run add to the bound.
    """

    segments: Segments
    begin: FloatArray
    end: FloatArray
    even: BoolArray
    give: FloatArray
    at_nodes: FloatArray

    def along(self, hamiltonian: Hamiltonian) -> tuple[FloatArray, FloatArray]:
        """Its values and slopes at the points of its segments, (q, n, p)."""
        segments, change = self.segments, self.end - self.begin
        line = self.begin[:, :, None] + change[:, :, None] * segments.place
        shape = np.where(self.even[:, :, None], 0.0, hamiltonian.slopes(line))
        shape = _together(shape, self.give, hamiltonian.problem.gain)
        slope = shape + (change / segments.length - segments.mean(shape))[:, :, None]
        curve = self.begin[:, :, None] + segments.gathered(slope)
        return np.where(self.even[:, :, None], line, curve), slope


def costate_of(
    hamiltonian: Hamiltonian,
    multipliers: Multipliers,
    near: float = _NEAR_LEVEL,
    pulled: BoolArray | bool = False,
    braked: BoolArray | bool = False,
) -> Costate:
    """The multipliers of cells as a function of the position.

    A multiplier is the mean of the costate over its cell. Where a control is partial the costate
    stands at a level, or joins its neighbours along the adjoint equation.

    Parameters
    ----------
    hamiltonian : Hamiltonian
    multipliers : Multipliers
    near : float
        Within which of its level a costate counts as there.
    pulled, braked : (n,) array of bool
        Where it is kept at the level of partial traction (the sum of all), and of a partial brake,
        whatever the cells beside ask for.
    """
    problem, plan, step = hamiltonian.problem, hamiltonian.plan, hamiltonian.problem.step
    mean = multipliers.pull / (step * problem.gain[:, None])
    shape = hamiltonian.slopes(np.broadcast_to(mean[:, :, None], hamiltonian.speed.shape))
    limit, floor = node_limits(hamiltonian)
    limited = plan.z >= np.minimum(limit, problem.ceiling) * (1.0 - _AT_LIMIT)
    held = limited[:, :-1] & limited[:, 1:]
    shared, pulls, own = partial_cells(hamiltonian, mean, near)
    alone = ~np.isnan(own)
    partial = shared | alone
    flat = alone | (held & (shape.mean(axis=2) < 0.0))
    flat |= _standing(hamiltonian)
    creeping = _creeping(problem, hamiltonian.fastest, plan)
    base = np.where(flat[:, :, None], 0.0, shape)
    give = _giving(mean, (shared & ~alone, alone, held))
    base = _together(base, give, problem.gain)
    flat |= give > 0.0
    whole = hamiltonian.segments
    change, gain = whole.mean(base) * step, problem.gain[:, None]
    begin = mean - whole.mean(whole.gathered(base))
    end = begin + change
    # Between two cells; the one that follows the adjoint equation knows better.
    trust = np.where(partial, 1e-6, 1.0) * np.where(creeping, 1e-12, 1.0) / step**2
    left, right = end[:, :-1], begin[:, 1:]
    middle = (trust[:, :-1] * left + trust[:, 1:] * right) / (trust[:, :-1] + trust[:, 1:])
    give = np.where(pulled & pulls, give, 0.0)
    levels = _Levels(give, np.where(braked, own, np.nan), hamiltonian.prices.traction, gain)
    begin, end = levels.kept(begin), levels.kept(end)
    left, right = end[:, :-1], begin[:, 1:]
    middle = levels.of(slice(None, -1)).kept(middle)
    middle = levels.of(slice(1, None)).kept(middle)
    free = limited[:, 1:-1] & (right > left)
    slow = (floor > 0.0) & (plan.z <= floor * (1.0 + _AT_LIMIT))
    free |= slow[:, 1:-1] & (right < left)
    first = np.column_stack((begin[:, :1], np.where(free, right, middle)))
    last = np.column_stack((np.where(free, left, middle), end[:, -1:]))
    first[:, 1:] = levels.of(slice(1, None), free).kept(first[:, 1:])
    last[:, :-1] = levels.of(slice(None, -1), free).kept(last[:, :-1])
    _level_out(creeping, first, last)
    jump = first[:, 1:] - last[:, :-1]
    inner = -(np.maximum(jump, 0.0) * limit[:, 1:-1] + np.minimum(jump, 0.0) * floor[1:-1])
    ends = -first[:, 0] * problem.initial
    stop = np.minimum(last[:, -1], 0.0) * np.minimum(problem.final, limit[:, -1])
    added = np.column_stack((ends, inner, stop)).sum(axis=0)
    # One that leaves its level in the cell follows the adjoint equation there.
    leaves = partial & (np.maximum(np.abs(first - begin), np.abs(last - end)) > _LEVEL)
    even = creeping | (flat & ~leaves)
    return Costate(whole, first, last, even, _parts(give * ~even), added)


def node_limits(hamiltonian: Hamiltonian) -> tuple[FloatArray, FloatArray]:
    """Largest ``z`` at the nodes, (q, n + 1), and the least, (n + 1,) [m²/s²]."""
    problem, run = hamiltonian.problem, hamiltonian.problem.run
    positions = problem.positions
    limit = run.permitted_speed(positions[:-1] + 0.5 * problem.step)
    lowest = np.asarray(np.minimum(np.append(limit, np.inf), np.insert(limit, 0, np.inf)))
    for node, point in zip(problem.passed.tolist(), run.windows, strict=True):
        if point.highest_speed is not None:
            lowest[node] = min(lowest[node], point.highest_speed)
    own = reached(hamiltonian.fastest, positions)
    return 0.5 * np.minimum(lowest, own) ** 2, problem.floor


def partial_cells(
    hamiltonian: Hamiltonian, mean: FloatArray, near: float
) -> tuple[BoolArray, BoolArray, FloatArray]:
    """Where a control is partial that all share, and where one that each has by itself.

    Returns
    -------
    shared : (n,) array of bool
        Of common traction, or a common brake: the sum of the costates is at a level.
    pulls : (n,) array of bool
        Those of them in which traction is well inside its limits.
    level : (q, n) array
        Of the costate times the gain where each has its own; elsewhere NaN.
    """
    problem, prices, plan = hamiltonian.problem, hamiltonian.prices, hamiltonian.plan
    own, regained = mean * problem.gain[:, None], prices.regained[:, None]
    worth = np.asarray(own.sum(axis=0))
    pull, brake = most_efforts(problem, plan)
    # Multipliers are less exact than controls: where one is inside its limits a level is wide.
    pulls = _inside(plan.traction, pull)
    shared = np.abs(worth - prices.traction) < np.where(pulls, near, _LEVEL)
    braked = np.where(_inside(plan.braking, brake), near, _LEVEL)
    level = np.full(own.shape, np.nan)
    if problem.common:
        shared |= (np.abs(worth) < braked[0]) | (np.abs(worth - regained.sum()) < braked[0])
    else:
        for each in (regained, np.zeros((1, 1))):
            level = np.where(np.abs(own - each) < braked, each, level)
    return np.asarray(shared), np.asarray(pulls & shared), level


def _inside(effort: FloatArray, most: FloatArray) -> BoolArray:
    """Where an effort is well above none and well below the most."""
    return np.asarray((effort > _INSIDE * most) & (effort < (1.0 - _INSIDE) * most))


@dataclass(frozen=True, eq=False)
class _Levels:
    """Levels at which costates are kept in some cells.

    Attributes
    ----------
    give : (q, n) array
        By which part each gives way where the sum is kept; elsewhere 0.
    own : (q, n) array
        Each by itself; NaN where it is not kept.
    total : float
        The sum; all levels are of the costate times the gain.
    gain : (q, 1) array
    """

    give: FloatArray
    own: FloatArray
    total: float
    gain: FloatArray

    def of(self, cells: slice, free: BoolArray | None = None) -> _Levels:
        """Those of some of the cells; of the sum by what is `free` to change there alone."""
        give, own = self.give[:, cells], self.own[:, cells]
        if free is not None:
            give, own = _parts(give * free), np.full(own.shape, np.nan)
        return replace(self, give=give, own=own)

    def kept(self, costate: FloatArray) -> FloatArray:
        """A costate at its levels."""
        found = np.where(np.isnan(self.own), costate * self.gain, self.own)
        found = found + self.give * (self.total - found.sum(axis=0))
        return np.asarray(found / self.gain)


def _giving(worth: FloatArray, kinds: tuple[BoolArray, BoolArray, BoolArray]) -> FloatArray:
    """By which part each gives way where a common control is partial, (q, n); elsewhere 0.

    A configuration at its limit takes what the others leave: it stays there under any costate that
    falls less than the adjoint equation asks for. Where there is none all share it, by what effort
    is `worth` to them, (q, n).
    """
    shared, alone, held = kinds
    able = np.asarray(held & ~alone)
    able = np.where(able.any(axis=0), able, ~alone) & shared
    weight = np.where(able, np.abs(worth) + 1e-12, 0.0)
    return _parts(weight)


def _parts(weight: FloatArray) -> FloatArray:
    """Of each, of the sum over the configurations; 0 where there is none."""
    return np.asarray(weight / np.maximum(weight.sum(axis=0), 1e-300))


def _together(slopes: FloatArray, give: FloatArray, gain: FloatArray) -> FloatArray:
    """Slopes such that the sum of the costates is level where some `give` way, (q, n, p)."""
    excess = (gain[:, None, None] * slopes).sum(axis=0)
    return np.asarray(slopes - (give / gain[:, None])[:, :, None] * excess)


def _standing(hamiltonian: Hamiltonian) -> BoolArray:
    """Cells at whose end a plan all but stands, though not as the fastest run does, (q, n).

    The adjoint equation grows beyond all bounds there; the mean over the cell is as good as any.
    """
    problem, plan = hamiltonian.problem, hamiltonian.plan
    own = 0.5 * hamiltonian.fastest.at(problem.positions) ** 2
    found = (plan.z < 0.5 * _STANDING**2) & (plan.z < (1.0 - _AT_FASTEST) * own)
    return np.asarray(found[:, 1:] | found[:, :-1])


def _creeping(problem: DiscreteProblem, fastest: Envelope, plan: Plan) -> BoolArray:
    """Cells in which a train starts or stops at its fastest, (q, n).

    There any costate that falls less than the adjoint equation asks for leads to the same speed; by
    the equation it grows beyond all bounds towards a standstill.
    """
    own = 0.5 * fastest.at(problem.positions) ** 2
    free = (plan.z > 0.5 * _CREEPING**2) | (plan.z < (1.0 - _AT_FASTEST) * own)
    free |= own >= problem.ceiling * (1.0 - _AT_LIMIT)
    found = np.zeros(problem.shape, dtype=np.bool_)
    n = problem.shape[1]
    for row in np.flatnonzero(free[:, 1:-1].any(axis=1)).tolist():
        nodes = np.flatnonzero(free[row])
        if problem.initial == 0.0:
            found[row, : min(max(int(nodes[0]) - 1, 1), n - 1)] = True
        if problem.final == 0.0:
            found[row, max(min(int(nodes[-1]) + 1, n - 1), 1) :] = True
    return found


def _level_out(creeping: BoolArray, first: FloatArray, last: FloatArray) -> None:
    """Keep the costate level where a train creeps, as it is beside, in place."""
    n = creeping.shape[1]
    for row in np.flatnonzero(creeping.any(axis=1)).tolist():
        moves = np.flatnonzero(~creeping[row])
        if not moves.size:
            continue
        begins, ends = int(moves[0]), int(moves[-1]) + 1
        first[row, :begins] = last[row, :begins] = first[row, begins]
        if ends < n:
            first[row, ends:] = last[row, ends:] = last[row, ends - 1]


_POINTS = 4
"""Of Gauss and Legendre in each cell."""


CLOSE = 5e-4
"""Gap up to which no better bound is looked for."""

MULTIPLIERS = "multipliers"
"""Those of the plan's own optimum, as a bound's source."""


@dataclass(frozen=True, eq=False)
class ContinuousBound:
    """What no trajectory comes below, however its controls change.

    Attributes
    ----------
    value : float [J/kg]
    excess : (n,) array [J/kg]
        By how much the plan is above it in each cell; where it is large cells are too long.
    source : str
        Where its multipliers come from.
    """

    value: float
    excess: FloatArray
    source: str = MULTIPLIERS


@work()
def continuous_bound(
    problem: DiscreteProblem,
    plan: Plan,
    multipliers: Multipliers,
    fastest: Envelope,
    running_time: float,
    run: TrajectoryProblem,
    floor: Floor | None = None,
    *,
    jointly: bool = False,
) -> ContinuousBound:
    """Lower bound of the energy of all trajectories, on these cells or any others.

    Parameters
    ----------
    problem : DiscreteProblem
    plan : Plan
        The optimum of the problem on its cells.
    multipliers : Multipliers
        Its multipliers.
    fastest : Envelope
        Of the same configurations, on close cells (`closer`); no trajectory is faster anywhere.
    running_time : float [s]
    run : TrajectoryProblem
        With all configurations, whose traction is one; the problem may be of some of them.
    floor : Floor, optional
        Of the same configurations; no trajectory in time is slower anywhere.
    jointly : bool
        Whether the speeds of several are looked at together where the traction is at a limit; it
        takes ten times as long.
    """

    def bounded(problem: DiscreteProblem, plan: Plan, multipliers: Multipliers) -> _Bounded:
        prices, segments = Prices.of(problem, multipliers.convex()), Segments.of(problem, _POINTS)
        hamiltonian = Hamiltonian(problem, plan, prices, fastest, run, segments, floor)
        return _Bounded.of(hamiltonian, multipliers, prices.of_times(problem, running_time))

    found = bounded(problem, plan, multipliers)
    falls = _falls(found.hamiltonian, multipliers)
    positions, first = np.union1d(problem.positions, falls), np.arange(problem.step.size)
    if positions.size > problem.positions.size:
        other = bounded(*_split(problem, plan, multipliers, positions))
        if other.value > found.value:
            found, first = other, np.searchsorted(positions, problem.positions[:-1])
    if jointly:
        found = found.raised()
    return ContinuousBound(found.value, np.add.reduceat(found.excess, first))


@dataclass(frozen=True, eq=False)
class _Bounded:
    """The bound by a costate on these cells.

    Attributes
    ----------
    hamiltonian : Hamiltonian
    along : ((q, n, p) array, (q, n, p) array)
        The costate and its slopes.
    least : (n, p) array [J/(kg m)]
        Of the Hamiltonian.
    at_nodes : (n + 1,) array [J/kg]
        See `Costate`.
    times : float [J/kg]
        What the times allowed are worth.
    """

    hamiltonian: Hamiltonian
    along: tuple[FloatArray, FloatArray]
    least: FloatArray
    at_nodes: FloatArray
    times: float

    @staticmethod
    def of(hamiltonian: Hamiltonian, multipliers: Multipliers, times: float) -> _Bounded:
        """By the best of several costates on each stretch."""

        def bounded(near: float, *level: BoolArray | bool) -> _Bounded:
            costate = costate_of(hamiltonian, multipliers, near, *level)
            along = costate.along(hamiltonian)
            return _Bounded(hamiltonian, along, hamiltonian.least(*along), costate.at_nodes, times)

        near = bounded(_NEAR_LEVEL)
        found = near.joined(bounded(_LEVEL))
        if found.excess.sum() > CLOSE * abs(found.value):
            # A level helps in long cells; in the next ones the costate has to follow it.
            levels = [bounded(_NEAR_LEVEL, *each) for each in ((True, False), (False, True))]
            gains = [each.cells - near.cells for each in levels]
            helps = [np.convolve(gain, np.ones(3), mode="same") > 0.0 for gain in gains]
            for each in (*levels, bounded(_NEAR_LEVEL, *helps)):
                found = found.joined(each)
        return found

    @property
    def cells(self) -> FloatArray:
        """What each cell adds to the bound, (n,) [J/kg]."""
        return np.asarray((self.least * self.hamiltonian.segments.weights).sum(axis=1))

    @property
    def value(self) -> float:
        """The bound [J/kg]."""
        return float(self.cells.sum() + self.at_nodes.sum()) - self.times

    @property
    def excess(self) -> FloatArray:
        """See `ContinuousBound`, (n,) [J/kg]."""
        return self.hamiltonian.excess(self.along, self.least)

    def joined(self, other: _Bounded) -> _Bounded:
        """The better of two on each stretch of cells on whose both sides they are the same."""
        pairs = list(zip(self.along, other.along, strict=True))
        differ = np.any([np.any(a != b, axis=(0, 2)) for a, b in pairs], axis=0)
        stretch = np.cumsum(np.diff(differ, prepend=False) & differ) * differ
        at_node = np.maximum(np.append(stretch, 0), np.insert(stretch, 0, 0))
        gain = np.bincount(stretch, other.cells - self.cells)
        gain += np.bincount(at_node, other.at_nodes - self.at_nodes, gain.size)
        better = (gain > 0.0) & (np.arange(gain.size) > 0)
        cells = better[stretch][:, None]
        lam, slope = (np.where(cells, b, a) for a, b in pairs)
        least = np.where(cells, other.least, self.least)
        at_nodes = np.where(better[at_node], other.at_nodes, self.at_nodes)
        return replace(self, along=(lam, slope), least=least, at_nodes=at_nodes)

    def raised(self) -> _Bounded:
        """The same where no traction is more than the speeds of all allow together."""
        if self.along[0].shape[0] == 1 or self.excess.sum() <= CLOSE * abs(self.value):
            return self
        return replace(self, least=self.hamiltonian.raised(self.least, *self.along))


def _falls(hamiltonian: Hamiltonian, multipliers: Multipliers) -> FloatArray:
    """Where the costate of a train at its limit has to fall from one level to a lower one [m].

    It may fall as fast there as the adjoint equation has it, so within a short way, on which the
    controls are not those that it asks for; on either side of the node between the two cells.
    """
    problem, step = hamiltonian.problem, hamiltonian.problem.step
    mean = multipliers.pull / (step * problem.gain[:, None])
    shape = hamiltonian.slopes(np.broadcast_to(mean[:, :, None], hamiltonian.speed.shape))
    rate = np.maximum(-shape.mean(axis=2), 0.0)
    limited = hamiltonian.plan.z >= node_limits(hamiltonian)[0] * (1.0 - _AT_LIMIT)
    fall = np.where(limited[:, 1:-1], mean[:, :-1] - mean[:, 1:], 0.0)
    node = problem.positions[1:-1]
    found = []
    for cells, side in ((slice(None, -1), -1.0), (slice(1, None), 1.0)):
        way = fall / np.maximum(rate[:, cells], 1e-300)
        row, at = np.nonzero((fall > _LEVEL) & (way < _HALF * step[cells]))
        found.append(node[at] + side * way[row, at])
    return np.concatenate(found)


_HALF = 0.5
"""Part of a cell beyond which a fall of the costate is not worth a cell of its own."""


def _split(
    problem: DiscreteProblem, plan: Plan, multipliers: Multipliers, positions: FloatArray
) -> tuple[DiscreteProblem, Plan, Multipliers]:
    """The same on more cells: controls, limits and costates as in the cells that are split."""
    cell = np.searchsorted(problem.positions, 0.5 * (positions[1:] + positions[:-1])) - 1
    step = np.diff(positions)
    part = step / problem.step[cell]
    middle = 0.5 * (positions[1:] + positions[:-1]) - problem.positions[cell]
    fall = problem.taper.fall[cell]
    by_cell = {
        name: getattr(problem, name)[..., cell]
        for name in ("drag2", "bulge", "traction", "braking", "friction", "dynamic")
    }
    floor = np.zeros(positions.size)
    floor[np.searchsorted(positions, problem.positions)] = problem.floor
    fine = replace(
        problem,
        positions=positions,
        step=step,
        drag0=problem.drag0[:, cell],
        ceiling=np.interp(positions, problem.positions, problem.ceiling),
        floor=floor,
        passed=np.searchsorted(positions, problem.positions[problem.passed]),
        taper=Taper(fall * part, problem.taper.crest[cell]),
        **by_cell,
    )
    driven = Plan(
        np.array([np.interp(positions, problem.positions, row) for row in plan.z]),
        plan.traction[cell] + fall * (1.0 - 2.0 * middle / problem.step[cell]),
        plan.braking[:, cell],
        plan.dynamic[:, cell],
    )
    shared = {
        name: getattr(multipliers, name)[:, cell] * part
        for name in ("pull", "power", "dynamic_power")
    }
    return fine, driven, replace(multipliers, **shared)

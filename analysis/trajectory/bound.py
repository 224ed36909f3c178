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

One costate is a tangent of the value of kinetic energy, and above it at other speeds where that is
concave, as with resistance that is linear in the speed and much time in hand. `closest_bound` has
one for the speeds below the plan's and another for those above (see `Hamiltonian`), and finds the
best of all by a program that needs no multipliers.
"""

from __future__ import annotations

import time
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp

from analysis.trajectory.convex import Multipliers, Numbering, Rows, optimum_about, spent, work
from analysis.trajectory.discretisation import (
    Curves,
    DiscreteProblem,
    Plan,
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
    *("drag0", "drag2", "braking", "friction", "dynamic", "lowest", "highest", "speed"),
    *("z", "rise", "traction", "pulled"),
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
    allowed : float [J/kg]
        What the times allowed are worth, each at its price.
    share : (q, n) array
        Of what traction is worth at its limit, by whose power limits it.
    dynamic : (q, n) array
        Price of the dynamic brake at its power limit.
    """

    traction: float
    regained: FloatArray
    time: FloatArray
    allowed: float
    share: FloatArray
    dynamic: FloatArray

    @staticmethod
    def of(problem: DiscreteProblem, multipliers: Multipliers, running_time: float) -> Prices:
        """By multipliers; a limit of traction that is nobody's power is shared by all alike."""
        found, (traction, fed_back) = multipliers.convex(), problem.run.effort_prices
        regained = fed_back * found.share / max(float(found.share.sum()), 1e-300)
        power = found.power + 1e-300
        dynamic = np.clip(found.dynamic_power / problem.step, 0.0, regained[:, None])
        time = found.cell_prices(problem)
        allowed = running_time * float(found.time.sum())
        for prices, times, sign in (
            (found.passing, problem.latest, 1.0),
            (found.opening, problem.earliest, -1.0),
        ):
            bounded = np.isfinite(times)
            allowed += sign * float(prices.sum(axis=0)[bounded] @ times[bounded])
        return Prices(traction, regained, time, allowed, power / power.sum(axis=0), dynamic)


@dataclass(frozen=True, eq=False)
class Dual:
    """Prices and costates at the points of cells: with them, a bound.

    Attributes
    ----------
    prices : Prices
    costate, slope : (k, q, n, p) array
        Of all speeds, or of those that are slower than the plan's, and of the faster ones.
    traction, braking : (q, n, p) array
        What a common effort costs each configuration; in all the price of traction, and nothing.
    at_nodes : (n + 1,) array [J/kg]
        What jumps of the costate and its values at the end of the run add to the bound.
    """

    prices: Prices
    costate: FloatArray
    slope: FloatArray
    traction: FloatArray
    braking: FloatArray
    at_nodes: FloatArray

    def at(self, places: tuple[Any, ...]) -> Dual:
        """The same at m points, by cell and number, as cells of one point each."""
        prices = replace(self.prices, time=self.prices.time[:, places[0]])
        names = ("costate", "slope", "traction", "braking")
        shape = self.costate.shape
        values = (np.broadcast_to(v, shape[-v.ndim :]) for v in (getattr(self, n) for n in names))
        costate, slope, *efforts = (v[..., *places][..., None] for v in values)
        return Dual(prices, costate, slope, efforts[0], efforts[1], self.at_nodes)


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
    """The Hamiltonian at the points of cells, for q configurations; arrays (q, n, p).

    Relative to the plan: ``V(s, z) = W(s) - lambda (z - z_plan)`` with one costate for the speeds
    below the plan's and another above leaves::

        -W' = min of  c u_f - eta u_d + mu / v - lambda (z' - z_plan') - lambda' (z - z_plan)
    """

    def __init__(
        self,
        problem: DiscreteProblem,
        plan: Plan,
        fastest: Envelope,
        run: TrajectoryProblem,
        segments: Segments,
        floor: Floor | None = None,
    ) -> None:
        self.problem, self.plan, self.segments = problem, plan, segments
        self.fastest = fastest
        s = segments.positions
        coefficients = np.array(
            [[c.mass, c.inertia, *c.resistance.parabola[::2]] for c in problem.run.configurations]
        )
        mass, inertia, constant, square = coefficients.T[:, :, None, None]
        tunnel = run.train.tunnel_coefficient(run.line.tunnel_cross_section(s))
        self.drag0 = (constant + mass * problem.run.track_acceleration(s)) / inertia
        self.drag1, self.drag2 = problem.drag1[:, None, None], (square + tunnel) / inertia
        self.gain, self.power = problem.gain[:, None, None], problem.power[:, None, None]
        self.traction = _limits_at(run, problem.reference, s)[0].min(axis=0)
        braking, self.friction, dynamic = _limits_at(problem.run, problem.reference, s)[1:]
        self.braking = braking.min(axis=0, keepdims=True) if problem.common else braking
        self.dynamic = np.minimum(dynamic, self.braking)
        self.highest = np.minimum(run.permitted_speed(s), reached(fastest, s))
        self.highest = np.maximum(self.highest, LEAST_SPEED)
        lowest = 0.0 if floor is None else floor.at(s)
        lowest = np.minimum(np.maximum(lowest, LEAST_SPEED), self.highest)
        self.lowest = np.broadcast_to((1.0 - _ROUNDED) * lowest, self.highest.shape)
        part, step, fall = segments.place, problem.step[:, None], problem.taper.fall[:, None]
        change = np.diff(plan.z, axis=1)[:, :, None]
        z = plan.z[:, :-1, None] + change * part
        z = z + self.gain * fall * step * part * (1.0 - part)
        # Resistance that changes inside a cell bends it, too.
        drag = self.drag(np.sqrt(2.0 * np.maximum(z, 0.0)))
        bend = drag - segments.mean(drag)[:, :, None]
        self.z = z - segments.gathered(bend)
        self.rise = change / step + self.gain * fall * (1.0 - 2.0 * part) - bend
        self.speed = np.clip(np.sqrt(2.0 * np.maximum(self.z, 0.0)), self.lowest, self.highest)
        self.pulled = plan.traction[:, None] + fall * (1.0 - 2.0 * part)

    def drag(self, speed: FloatArray) -> FloatArray:
        """Of resistance and gradient [m/s²]."""
        return np.asarray(self.drag0 + self.drag1 * speed + self.drag2 * speed**2)

    def priced(self, prices: Prices, costate: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What common efforts cost each, by whose limits they are at; twice (q, n, p)."""
        own, q = costate * self.gain, costate.shape[0]
        worth = own.sum(axis=0) - prices.traction
        traction = own - prices.share[:, :, None] * worth
        if not self.problem.common:
            return traction, np.zeros((q, 1, 1))
        level = (prices.regained[:, None] - prices.dynamic)[:, :, None]
        return traction, level + (own.sum(axis=0) - level.sum(axis=0)) / q - own

    def slopes(self, prices: Prices, costate: FloatArray) -> FloatArray:
        """The adjoint equation: what the costate changes by along the plan's speeds."""
        a, b, c, _ = self.along(prices, costate, self.priced(prices, costate), self.speed)
        return np.asarray((b - a / self.speed**2) / self.speed + 2.0 * c)

    def least(self, dual: Dual) -> FloatArray:
        """The least Hamiltonian over all speeds and controls, (n, p) [J/(kg m)].

        Each configuration at its own least, where their limits share what traction is worth.
        """
        efforts, found = (dual.traction, dual.braking), np.full(self.speed.shape, np.inf)
        edges = [self.lowest, *[self.speed] * (len(dual.costate) - 1), self.highest]
        for low, high, costate, slope in zip(
            edges, edges[1:], dual.costate, dual.slope, strict=False
        ):
            own = self._least_of(dual.prices, costate, slope, efforts, (low, high))
            found = np.minimum(found, own + costate * self.rise + slope * self.z)
        return np.asarray(found.sum(axis=0))

    def _least_of(
        self,
        prices: Prices,
        costate: FloatArray,
        slope: FloatArray,
        efforts: tuple[FloatArray, FloatArray],
        within: tuple[FloatArray, FloatArray],
    ) -> FloatArray:
        """The least within a range of speeds, but for what the plan's own speed adds."""
        found, v = np.full(costate.shape, np.inf), np.clip(self.speed, *within)
        a, b, c, constant = self.along(prices, costate, efforts, v)
        enough = a / v + b * v + (c - 0.5 * slope) * v**2 + constant
        enough += _ROUNDED * (1.0 + np.abs(enough))
        for low, high in pairwise(self._edges(*within)):
            a, b, c, constant = self.along(prices, costate, efforts, 0.5 * (low + high))
            c = c - 0.5 * slope
            # Each term at its better end: a piece of a curve that has more than the plan is passed.
            ends = a / np.where(a > 0.0, high, low) + b * np.where(b > 0.0, low, high)
            ends += c * np.where(c > 0.0, low, high) ** 2 + constant
            near = (high > low) & (ends <= enough)
            span = low[near], high[near]
            value = _least(a[near], b[near], c[near], span, v[near]) + constant[near]
            found[near] = np.minimum(found[near], np.maximum(value, ends[near]))
        return found

    def raised(self, least: FloatArray, dual: Dual) -> FloatArray:
        """That least, higher where no traction is more than the speeds of all allow together.

        With one costate. Apart, the train whose power limits the traction would slow down for the
        others to have more of it. Here the traction is in one of several ranges: in each all are
        slow enough for the least of it, and have no more than the most. The range with the least
        value is halved until it is that of the plan.
        """
        plan = self.of_plan(dual.prices)
        worth = (dual.costate[0] * self.gain).sum(axis=0) - dual.prices.traction
        missing = (plan - least) * self.segments.weights
        little = _LITTLE * np.abs((least * self.segments.weights).sum())
        at = np.nonzero((worth > 0.0) & (missing > little))
        enough, few = plan[at], dual.at(at)

        def within(points: IntArray, low: FloatArray, high: FloatArray) -> FloatArray:
            part, empty = self._at(tuple(each[points] for each in at))._pulling(
                low[:, None], high[:, None]
            )
            value = part.least(few.at((points, np.zeros_like(points))))
            return np.asarray(np.where(empty, np.inf, value)[:, 0])

        every, pulled = np.arange(enough.size), np.maximum(self.pulled[at], LEAST_SPEED)
        ranges = [(pulled * low, pulled * high) for low, high in pairwise(_RANGES)]
        value = np.array([within(every, *each) for each in ranges])
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
            for row, values in zip(upper, (middle, end, within(short, middle, end)), strict=True):
                row[short] = values
            value[halved], high[halved] = within(short, low[halved], middle), middle
            low, high, value = (
                np.vstack(each) for each in zip((low, high, value), upper, strict=True)
            )
        found = least.copy()
        found[at] = np.maximum(found[at], value.min(axis=0))
        return found

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

    def of_plan(self, prices: Prices) -> FloatArray:
        """The plan's own Hamiltonian, (n, p) [J/(kg m)]; no costate changes it."""
        regained = prices.regained[:, None, None] * self.plan.dynamic[:, :, None]
        own = prices.time[:, :, None] / self.speed - regained
        return np.asarray(own.sum(axis=0) + prices.traction * self.pulled)

    def excess(self, prices: Prices, least: FloatArray) -> FloatArray:
        """By how much the plan's Hamiltonian is above a least one, in each cell [J/kg]."""
        missing = (self.of_plan(prices) - least) * self.segments.weights
        return np.asarray(np.maximum(missing.sum(axis=1), 0.0))

    def _edges(self, lowest: FloatArray, highest: FloatArray) -> FloatArray:
        """Speeds between which each limit is one of effort, power, or a line of a curve."""
        problem = self.problem
        found = [lowest, self.power / np.maximum(self.traction, 1e-12)]
        if problem.curves is not None:
            found.append(self._reach(self.traction))
        if problem.run.at_line or np.any(problem.friction < problem.braking):
            found.append(problem.dynamic_power / np.maximum(self.dynamic, 1e-12))
        for curves in (problem.curves, problem.dynamic_curves):
            if curves is not None:
                knots = curves.own.speeds[curves.own.speeds < curves.fastest]
                found += [knot * curves.share[:, None, None] for knot in knots[1:].tolist()]
        found.append(highest)
        clipped = [np.clip(np.broadcast_to(e, highest.shape), lowest, highest) for e in found]
        return np.sort(np.stack(clipped), axis=0)

    def limits(self, speed: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The most traction, the most of all brakes, and of the dynamic one, at speeds."""
        problem, power = self.problem, np.asarray(self.problem.dynamic_power)
        pull = _Piece.of(self.traction, self.power, problem.curves, speed).at(speed)
        dynamic = _Piece.of(self.dynamic, power, problem.dynamic_curves, speed).at(speed)
        return pull, np.minimum(self.braking, self.friction + dynamic), dynamic

    def along(
        self,
        prices: Prices,
        costate: FloatArray,
        efforts: tuple[FloatArray, FloatArray],
        speed: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The least over the controls, ``a / v + b v + c v² + constant`` about the speeds."""
        problem, own = self.problem, costate * self.gain
        worth = np.maximum(own - efforts[0], 0.0)
        pull = _Piece.of(self.traction, self.power, problem.curves, speed)
        power = np.asarray(problem.dynamic_power)
        brake = _Piece.of(self.dynamic, power, problem.dynamic_curves, speed)
        # Against a costate below zero all brakes are worth more than what one regains.
        own = own + efforts[1]
        short = self.friction + brake.at(speed) < self.braking
        by_brake = prices.regained[:, None, None] - np.where(short, own, np.maximum(own, 0.0))
        by_brake = np.maximum(by_brake, 0.0)
        braked = np.minimum(own, 0.0) * np.where(short, self.friction, self.braking)
        return (
            prices.time[:, :, None] - worth * pull.power - by_brake * brake.power,
            costate * self.drag1 - worth * pull.slope - by_brake * brake.slope,
            costate * self.drag2,
            costate * self.drag0 - worth * pull.offset - by_brake * brake.offset + braked,
        )

    def at_nodes(self, begin: FloatArray, end: FloatArray) -> FloatArray:
        """What jumps between costates, (k, q, n) at the ends of cells, add; (n + 1,) [J/kg].

        That of slower speeds may rise for nothing, that of faster ones fall, and each may do
        anything where no trajectory is slower, or faster.
        """
        (limit, floor), z = node_limits(self), self.plan.z
        jump = begin[:, :, 1:] - end[:, :, :-1]
        below, above = np.maximum(z - floor, 0.0)[:, 1:-1], np.maximum(limit - z, 0.0)[:, 1:-1]
        inner = np.minimum(jump[0], 0.0) * below - np.maximum(jump[-1], 0.0) * above
        final = np.minimum(self.problem.final, limit[:, -1]) - z[:, -1]
        stop = np.where(final > 0.0, end[-1, :, -1], end[0, :, -1]) * final
        stop = np.minimum(np.minimum(-end[0, :, -1] * z[:, -1], stop), 0.0)
        return np.concatenate(([0.0], inner.sum(axis=0), [stop.sum()]))


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
    """

    segments: Segments
    begin: FloatArray
    end: FloatArray
    even: BoolArray

    def along(self, hamiltonian: Hamiltonian, prices: Prices) -> tuple[FloatArray, FloatArray]:
        """Its values and slopes at the points of its segments, (q, n, p)."""
        segments, change = self.segments, self.end - self.begin
        line = self.begin[:, :, None] + change[:, :, None] * segments.place
        shape = np.where(self.even[:, :, None], 0.0, hamiltonian.slopes(prices, line))
        slope = shape + (change / segments.length - segments.mean(shape))[:, :, None]
        curve = self.begin[:, :, None] + segments.gathered(slope)
        return np.where(self.even[:, :, None], line, curve), slope

    def dual(self, hamiltonian: Hamiltonian, prices: Prices) -> Dual:
        """With what the common efforts cost each by it."""
        costate, slope = self.along(hamiltonian, prices)
        nodes = hamiltonian.at_nodes(self.begin[None], self.end[None])
        efforts = hamiltonian.priced(prices, costate)
        return Dual(prices, costate[None], slope[None], *efforts, nodes)


def costate_of(
    hamiltonian: Hamiltonian, prices: Prices, multipliers: Multipliers, near: float
) -> Costate:
    """The multipliers of cells as a function of the position.

    A multiplier is the mean of the costate over its cell. Where a control is partial, and the
    costate `near` its level, it stands there, or joins its neighbours along the adjoint equation.
    """
    problem, plan, step = hamiltonian.problem, hamiltonian.plan, hamiltonian.problem.step
    mean = multipliers.pull / (step * problem.gain[:, None])
    shape = np.broadcast_to(mean[:, :, None], hamiltonian.speed.shape)
    shape = hamiltonian.slopes(prices, shape)
    limit, floor = node_limits(hamiltonian)
    limited = plan.z >= np.minimum(limit, problem.ceiling) * (1.0 - _AT_LIMIT)
    held = limited[:, :-1] & limited[:, 1:]
    shared, alone = partial_cells(hamiltonian, prices, mean, near)
    partial = shared | alone
    flat = alone | (held & (shape.mean(axis=2) < 0.0))
    flat |= _standing(hamiltonian)
    creeping = _creeping(problem, hamiltonian.fastest, plan)
    base = np.where(flat[:, :, None], 0.0, shape)
    give = _giving(mean, (shared & ~alone, alone, held))
    base = _together(base, give, problem.gain)
    flat |= give > 0.0
    whole = hamiltonian.segments
    begin = mean - whole.mean(whole.gathered(base))
    end = begin + whole.mean(base) * step
    # Between two cells; the one that follows the adjoint equation knows better.
    trust = np.where(partial, 1e-6, 1.0) * np.where(creeping, 1e-12, 1.0) / step**2
    left, right = end[:, :-1], begin[:, 1:]
    middle = (trust[:, :-1] * left + trust[:, 1:] * right) / (trust[:, :-1] + trust[:, 1:])
    free = limited[:, 1:-1] & (right > left)
    slow = (floor > 0.0) & (plan.z <= floor * (1.0 + _AT_LIMIT))
    free |= slow[:, 1:-1] & (right < left)
    first = np.column_stack((begin[:, :1], np.where(free, right, middle)))
    last = np.column_stack((np.where(free, left, middle), end[:, -1:]))
    _level_out(creeping, first, last)
    # One that leaves its level in the cell follows the adjoint equation there.
    leaves = partial & (np.maximum(np.abs(first - begin), np.abs(last - end)) > _LEVEL)
    even = creeping | (flat & ~leaves)
    return Costate(whole, first, last, even)


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
    hamiltonian: Hamiltonian, prices: Prices, mean: FloatArray, near: float
) -> tuple[BoolArray, BoolArray]:
    """Where a control is partial that all share, (n,), and where one that each has, (q, n).

    Of common traction, or a common brake, the sum of the costates is at a level; of its own brake
    the costate of a configuration.
    """
    problem, plan = hamiltonian.problem, hamiltonian.plan
    own, regained = mean * problem.gain[:, None], prices.regained[:, None]
    worth = np.asarray(own.sum(axis=0))
    pull, brake = most_efforts(problem, plan)
    # Multipliers are less exact than controls: where one is inside its limits a level is wide.
    pulled = np.where(_inside(plan.traction, pull), near, _LEVEL)
    braked = np.where(_inside(plan.braking, brake), near, _LEVEL)
    shared = np.abs(worth - prices.traction) < pulled
    if problem.common:
        shared |= (np.abs(worth) < braked[0]) | (np.abs(worth - regained.sum()) < braked[0])
        return np.asarray(shared), np.zeros(own.shape, dtype=np.bool_)
    return np.asarray(shared), (np.abs(own - regained) < braked) | (np.abs(own) < braked)


def _inside(effort: FloatArray, most: FloatArray) -> BoolArray:
    """Where an effort is well above none and well below the most."""
    return np.asarray((effort > _INSIDE * most) & (effort < (1.0 - _INSIDE) * most))


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

MULTIPLIERS, COSTATES = "multipliers", "two costates"
"""Those of the plan's own optimum, and the best about it: a bound's source."""


@dataclass(frozen=True, eq=False)
class ContinuousBound:
    """What no trajectory comes below, however its controls change.

    Attributes
    ----------
    value : float [J/kg]
    excess : (n,) array [J/kg]
        By how much the plan is above it in each cell; where it is large cells are too long.
    source : str
        Where its costates come from.
    """

    value: float
    excess: FloatArray
    source: str = MULTIPLIERS

    @staticmethod
    def of(hamiltonian: Hamiltonian, dual: Dual, least: FloatArray, source: str) -> ContinuousBound:
        """By prices, costates, and the least Hamiltonians that they lead to."""
        value = float((least * hamiltonian.segments.weights).sum() + dual.at_nodes.sum())
        excess = hamiltonian.excess(dual.prices, least)
        return ContinuousBound(value - dual.prices.allowed, excess, source)


def joined(
    weights: FloatArray, one: Dual, other: Dual, least: tuple[FloatArray, FloatArray]
) -> tuple[Dual, FloatArray]:
    """The better of two on each stretch of cells on whose both sides they are the same.

    Parameters
    ----------
    weights : (n, p) array [m]
    one, other : Dual
        At the same prices.
    least : ((n, p) array, (n, p) array)
        The least Hamiltonians by each.
    """
    names = ("costate", "slope", "traction", "braking")
    pairs = [(getattr(one, name), getattr(other, name)) for name in names]
    differ = np.any([np.any(a != b, axis=(0, 1, 3)) for a, b in pairs[:2]], axis=0)
    stretch = np.cumsum(np.diff(differ, prepend=False) & differ) * differ
    at_node = np.maximum(np.append(stretch, 0), np.insert(stretch, 0, 0))
    gain = np.bincount(stretch, ((least[1] - least[0]) * weights).sum(axis=1))
    gain += np.bincount(at_node, other.at_nodes - one.at_nodes, gain.size)
    better = (gain > 0.0) & (np.arange(gain.size) > 0)
    cells = better[stretch][:, None]
    values = [np.where(cells, b, a) for a, b in pairs]
    at_nodes = np.where(better[at_node], other.at_nodes, one.at_nodes)
    dual = Dual(one.prices, values[0], values[1], values[2], values[3], at_nodes)
    return dual, np.where(cells, least[1], least[0])


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
    segments = Segments.of(problem, _POINTS)
    hamiltonian = Hamiltonian(problem, plan, fastest, run, segments, floor)
    prices = Prices.of(problem, multipliers, running_time)
    one, other = (
        costate_of(hamiltonian, prices, multipliers, near).dual(hamiltonian, prices)
        for near in (_NEAR_LEVEL, _LEVEL)
    )
    both = hamiltonian.least(one), hamiltonian.least(other)
    dual, least = joined(segments.weights, one, other, both)
    found = ContinuousBound.of(hamiltonian, dual, least, MULTIPLIERS)
    if not jointly or problem.shape[0] == 1 or found.excess.sum() <= CLOSE * abs(found.value):
        return found
    return ContinuousBound.of(hamiltonian, dual, hamiltonian.raised(least, dual), MULTIPLIERS)


@work()
def closest_bound(
    problem: DiscreteProblem,
    plan: Plan,
    fastest: Envelope,
    running_time: float,
    run: TrajectoryProblem,
    floor: Floor | None = None,
    *,
    enough: float = 0.0,
    seconds: float = np.inf,
) -> ContinuousBound | None:
    """The highest lower bound that two costates about a plan lead to.

    A program chooses all prices, and the costates of slower and of faster speeds at the ends of
    cells, such that the Hamiltonian's least values are as high as can be at the points of each
    cell. It knows them at some speeds; those at which they were too high are added to the next.

    Parameters
    ----------
    problem, plan, fastest, running_time, run, floor
        See `continuous_bound`.
    enough : float [J/kg]
        Excess of the plan up to which no better bound is looked for.
    seconds : float
        Processor time after about which no further program starts.

    Returns
    -------
    ContinuousBound or None
        None where the solver finds nothing.
    """
    points = Hamiltonian(problem, plan, fastest, run, Segments.of(problem, _POINTS), floor)
    program, best, begun = _CostateProgram(points, running_time), None, time.process_time()
    for _ in range(_ROUNDS):
        found = program.solved()
        if found is None:
            break
        dual = program.dual(found)
        bound = ContinuousBound.of(points, dual, points.least(dual), COSTATES)
        best = bound if best is None else max(best, bound, key=lambda each: each.value)
        # The next one takes about as long.
        late = time.process_time() - begun > _IN_TIME * seconds
        if late or best.excess.sum() <= enough or not program.extended(found, dual, enough):
            break
    return best


def costate_seconds(problem: DiscreteProblem) -> float:
    """About how long the first of such programs takes, by the last one of a search [s]."""
    return _OVER_PROGRAM * spent() * problem.drag0.size


_OVER_PROGRAM, _IN_TIME = 12.0, 0.6
"""Times the time that a program of a search takes per unknown, for each cell and configuration;
part of the time after which no further one starts."""

_ROUNDS, _SPEEDS, _FIRST, _SLOWEST = 8, 12, (4, 11), 0.03
"""Programs at most; how many speeds on either side of the plan's they may know, the plan's own the
first; which ones the first program knows besides; and the slowest, as a part of the plan's."""

_TOGETHER, _APART, _MISSED, _WORTH = 1e-3, 1e-4, 0.2, 0.1
"""What costates that differ cost, as a part of what the plan costs; speeds that differ [m/s]; the
part of what is enough that may be missing; and of the mean, what a speed lacks to be added."""


class _CostateProgram:
    """The program of prices and of costates about a plan.

    Attributes
    ----------
    points : Hamiltonian
        At the points of cells.
    begin, end : (2, q, n) array of int
        The costates, of slower speeds and of faster ones, at the ends of each cell.
    traction, braking : (2, q, n) array of int
        What a common effort costs each there; of a brake that each has by itself there is none.
    least : (q, n, p) array of int
        The least Hamiltonians.
    time, share : (q,) array of int
        Of the running time, and of the energy that is regained.
    passing, opening : (q, windows) array of int
        Of latest and earliest times at passing points.
    speed : (2, k, q, n, p) array [m/s]
        Those that are looked at, from the plan's on downwards and upwards.
    pull, brake, dynamic, change : (4, 2, k, q, n, p) array
        With full traction, none, the dynamic brake, all brakes: efforts, and what they change the
        plan's distance in ``z`` by.
    known, possible : (4, 2, k, q, n, p) array of bool
        What the program knows of, and what differs from the plan.
    """

    def __init__(self, points: Hamiltonian, running_time: float) -> None:
        problem, self.points, self.running_time = points.problem, points, running_time
        (q, n), self.unknowns = problem.shape, Numbering()
        more, ends = self.unknowns.more, (2, q, n)
        self.begin, self.end, self.traction = more(ends), more(ends), more(ends)
        self.braking = more(ends) if problem.common else None
        self.least = more(points.speed.shape)
        self.time, self.share = more((q,), 0.0), more((q,), 0.0)
        self.passing, self.opening = (
            more((q, times.size), 0.0, np.where(np.isfinite(times), np.inf, 0.0))
            for times in (problem.latest, problem.earliest)
        )
        part = np.linspace(0.0, 1.0, _SPEEDS)[:, None, None, None] ** 1.5
        slowest = np.minimum(np.maximum(points.lowest, _SLOWEST * points.speed), points.speed)
        farthest = np.stack((slowest, points.highest))
        self.speed = points.speed + (farthest[:, None] - points.speed) * part
        most = [points.limits(each) for each in self.speed.reshape(-1, *points.speed.shape)]
        pull, brake, dynamic = np.array(most).swapaxes(0, 1).reshape(3, *self.speed.shape)
        none, drawn = np.zeros_like(pull), np.minimum(dynamic, brake)
        self.pull = np.stack((pull, none, none, none))
        self.brake = np.stack((none, none, drawn, brake))
        self.dynamic = np.stack((none, none, drawn, drawn))
        drag = points.drag(self.speed) + points.rise
        self.change = points.gain * (self.pull - self.brake) - drag
        self.apart = 0.5 * self.speed**2 - points.z
        away = np.abs(self.speed - points.speed) > _APART
        away[:, 0] = True
        self.possible = np.broadcast_to(away, self.change.shape).copy()
        if not problem.run.at_line:
            # It is worth what all brakes are.
            self.possible[2] = False
        self.known = self._known(pull[0, 0, :, :, 0], brake[0, 0, :, :, 0])
        self.cost, self.curvature = self._cost(), self._curvature()
        self.equal, self.nodes = self._equations(), self._at_nodes()

    def _known(self, pull: FloatArray, brake: FloatArray) -> BoolArray:
        """At the plan's speed its efforts and those beside, or all of several trains."""
        plan, at_line = self.points.plan, self.points.problem.run.at_line
        drawn = plan.dynamic > _INSIDE * brake
        braked = plan.braking > _INSIDE * brake + at_line * plan.dynamic
        of_plan = np.where(plan.traction > _INSIDE * pull, 0, 1)
        of_plan = np.where(braked, 3, np.where(drawn, 2, of_plan))
        away = np.abs(of_plan - np.arange(4)[:, None, None])[:, None, :, :, None]
        known = np.zeros(self.possible.shape, dtype=np.bool_)
        known[:, :, 0] = away <= (4 if len(plan.z) > 1 else 1 if at_line else 2)
        for each in _FIRST:
            known[:, :, each] = away == 0
        return np.asarray(known & self.possible)

    def solved(self) -> FloatArray | None:
        """The unknowns; None if the solver finds none."""
        below = self.nodes, self._in_cells()
        return optimum_about(self.unknowns, self.curvature, self.cost, self.equal, below)

    def _cost(self) -> FloatArray:
        """Times allowed at their prices, less the least Hamiltonians."""
        problem, cost = self.points.problem, np.zeros(self.unknowns.size)
        cost[self.least], cost[self.time] = -self.points.segments.weights, self.running_time
        for unknowns, times in ((self.passing, problem.latest), (self.opening, -problem.earliest)):
            bounded = np.isfinite(times)
            cost[unknowns[:, bounded]] = times[bounded]
        return cost

    def _curvature(self) -> sp.csc_array:
        """Next to nothing; it keeps both costates together where nothing else does."""
        points, apart = self.points, Rows()
        whole = points.segments.length.sum()
        used = float((points.segments.weights * points.pulled).sum()) + 1e-4 * whole
        weight = np.sqrt(_TOGETHER * used / whole * points.segments.length)
        for each in (self.begin, self.end):
            apart.add(np.zeros(each[0].shape), (each[0], weight), (each[1], -weight))
        rows = apart.matrix(self.unknowns.size)
        return sp.csc_array(rows.T @ rows)

    def _equations(self) -> Rows:
        """Common efforts cost what they cost, and all shares are one."""
        run, n, rows = self.points.problem.run, self.points.problem.step.size, Rows()
        for unknowns, total in ((self.traction, run.effort_prices[0]), (self.braking, 0.0)):
            if unknowns is not None:
                rows.add(np.full((2, n), total), (unknowns.swapaxes(1, 2), 1.0))
        if run.objective == "expected":
            rows.add(self.points.problem.weights, (self.share, 1.0))
        else:
            rows.add(np.ones(1), (self.share[None], 1.0))
        return rows

    def _at_nodes(self) -> Rows:
        """Costates rise and fall at nodes, and end, where that costs nothing."""
        points, problem, rows = self.points, self.points.problem, Rows()
        limit, floor = (each[..., 1:-1] for each in node_limits(points))
        z, begin, end = points.plan.z, self.begin[:, :, 1:], self.end[:, :, :-1]
        slowest = (floor > 0.0) & (z[:, 1:-1] <= floor * (1.0 + _AT_LIMIT))
        fastest = z[:, 1:-1] >= limit * (1.0 - _AT_LIMIT)
        for each, sign, free in ((0, 1.0, slowest), (1, -1.0, fastest)):
            before, behind = end[each][~free], begin[each][~free]
            rows.add(np.zeros(before.size), (before, sign), (behind, -sign))
        if problem.final > 0.0:
            slow = z[:, -1] < problem.final * (1.0 - _AT_LIMIT)
            for numbers, sign in ((self.end[0, :, -1], 1.0), (self.end[1, slow, -1], -1.0)):
                rows.add(np.zeros(numbers.size), (numbers, sign))
        return rows

    def _in_cells(self) -> Rows:
        """No least Hamiltonian is above one that is known."""
        points, problem, rows = self.points, self.points.problem, Rows()
        at = np.nonzero(self.known)
        _, costate, _, row, cell, point = at
        place = points.segments.place[cell, point]
        ends = ((0, 1.0 - place), (1, place))
        apart = self.apart[at[1:]] / problem.step[cell]
        slow = -1.0 / self.speed[at[1:]]
        before = (cell[:, None] < problem.passed) * slow[:, None]
        terms = [
            (self.least[row, cell, point], np.ones(row.size)),
            (self.begin[costate, row, cell], self.change[at] * (1.0 - place) - apart),
            (self.end[costate, row, cell], self.change[at] * place + apart),
            (self.time[row], slow),
            (self.passing[row], before),
            (self.opening[row], -before),
            (self.share[row], problem.run.effort_prices[1] * self.dynamic[at]),
            *((self.traction[end, row, cell], -self.pull[at] * part) for end, part in ends),
        ]
        if self.braking is not None:
            numbers = self.braking
            terms += [(numbers[end, row, cell], -self.brake[at] * part) for end, part in ends]
        rows.add(np.zeros(row.size), *terms)
        return rows

    def extended(self, found: FloatArray, dual: Dual, enough: float) -> bool:
        """Add the speeds at which least values are too high; False if by next to nothing."""
        points = self.points
        prices, costate, slope = dual.prices, dual.costate[:, None], dual.slope[:, None]
        own = dual.traction * self.pull + dual.braking * self.brake
        own += prices.time[:, :, None] / self.speed - costate * self.change - slope * self.apart
        own -= prices.regained[:, None, None] * self.dynamic
        own = np.where(self.possible, own, np.inf)
        # At each point, of each kind of effort and each costate the speed that lacks most.
        weights = points.segments.weights
        missing = (found[self.least] - own.min(axis=2)) * weights
        lacking = np.maximum(missing.max(axis=(0, 1)), 0.0)
        if lacking.sum() <= _MISSED * enough:
            return False
        at = np.nonzero(missing > _WORTH * lacking.mean())
        self.known[at[0], at[1], own.argmin(axis=2)[at], *at[2:]] = True
        return True

    def dual(self, found: FloatArray) -> Dual:
        """With prices that are positive, and add up to what they have to."""
        points, problem = self.points, self.points.problem
        place, none = points.segments.place, np.zeros(problem.shape)
        names = (self.time, self.passing, self.opening)
        time, passing, opening = (np.maximum(found[each], 0.0) for each in names)
        share = np.maximum(found[self.share], 1e-12)
        given = Multipliers(none, time, passing, opening, none, none, share)
        prices = Prices.of(problem, given, self.running_time)

        def inside(begin: FloatArray, end: FloatArray) -> FloatArray:
            return np.asarray(begin[..., None] + (end - begin)[..., None] * place)

        traction, braking = inside(*found[self.traction]), np.zeros((len(none), 1, 1))
        if self.braking is not None:
            braking = inside(*found[self.braking])
        traction += (prices.traction - traction.sum(axis=0)) / len(none)
        begin, end = found[self.begin], found[self.end]
        costate, slope = inside(begin, end), (end - begin) / problem.step
        return Dual(
            prices,
            costate,
            np.broadcast_to(slope[..., None], costate.shape),
            traction,
            braking - braking.mean(axis=0),
            points.at_nodes(begin, end),
        )

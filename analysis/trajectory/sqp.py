"""Sequential quadratic programming for the robust minimax problem.

Cunillera et al. (2022), eq. (1) to (10). Each iteration lets CVXPY solve a quadratic program about
the last plan, until nothing changes any more. The motion through every cell is linearised about the
plan, the power bounded by a tangent (a global under-estimator, so power is never exceeded). Running
time is convex in ``z``: its constraint is linearised, and its curvature, weighted with the
multiplier of the time, goes into the objective.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from analysis.trajectory.convex import (
    SLOW,
    Multipliers,
    Near,
    OutOfTimeError,
    Rows,
    Unknowns,
    brake_limits,
    energy_cost,
    power_cells,
    solve,
)
from analysis.trajectory.discretisation import Curves, DiscreteProblem, Plan, Taper, taper_along
from analysis.trajectory.rollout import delays, integrate_cells, realise
from trainlog.arrays import BoolArray, FloatArray, IntArray

_Limited = tuple[int, IntArray, IntArray]
"""A configuration, cells in which its power is limited, and the rows of these limits."""

_LEAST_Z, _LEAST_SLOPE = 1e-2, 2e-3
"""Smallest ``z`` between the two ends [m²/s²], and its slope from and to them [m/s²].

A model about a train that all but stands is good for nothing, and less speed saves no energy.
"""

_STANDING, _LONGER = 1e-3, 4.0
"""Sum of a cell's end speeds that counts as standing [m/s]; and the most that the time of a cell
counts, over that of its end speeds: efforts under which a train stands have none."""

_NEAR_POWER = 1.5
"""A power limit above this many times the largest effort is left out of a program."""

_LEAST_SHARE = 0.02
"""Curvature of a configuration that is not short of time, over that of the one that is.

It damps configurations whose speed the optimum leaves open; at the fixed point it weighs nothing.
"""


_SHORT_CELL = 20.0
"""Length of cells up to which uneven efforts cost little by themselves [m]."""

_LEAST_POWER = 0.02
"""The same over the mean power; where a timetable is so slack that time is worth nothing."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the iterations ended.

    Attributes
    ----------
    plan : Plan
    taper : Taper
        Of the common traction in this plan.
    energy : float [J/kg]
        Worst case, per unit reference inertia.
    multipliers : Multipliers
    switching : (n,) array
        Switching function of the robust maximum principle: ``sum of lambda_v / v`` over the
        configurations; above 1 traction pays, below 0 braking does.
    lateness : float [s]
        By which the timetable cannot be kept; 0 in a feasible run.
    moved : float [J/kg]
        What the last changes weigh by the curvature of the time: another iteration would gain far
        less.
    statuses : tuple of str
        The solver's status of each program.
    converged : bool
        Whether the last iteration changed nothing any more.
    loose : (size,) array of bool, or False
        Unknowns of the last program that a closer solution of it would move off their bounds.
    """

    plan: Plan
    taper: Taper
    energy: float
    multipliers: Multipliers
    switching: FloatArray
    lateness: float
    moved: float = np.inf
    statuses: tuple[str, ...] = ()
    converged: bool = False
    loose: BoolArray | bool = False

    def select(self, rows: Sequence[int]) -> Solution:
        """Of some of the configurations: the others had no part in it."""
        chosen = list(rows)
        plan, multipliers = self.plan.select(chosen), self.multipliers.select(chosen)
        return replace(self, plan=plan, multipliers=multipliers)

    @property
    def time_price(self) -> FloatArray:
        """What a second less on the way costs each configuration, (q,) [J/(kg s)]."""
        return np.asarray(self.multipliers.time + self.multipliers.passing.sum(axis=1))

    @property
    def departure_price(self) -> FloatArray:
        """What a second later departure costs; less where windows of time open on the way."""
        return np.asarray(self.time_price - self.multipliers.opening.sum(axis=1))


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion through each cell and its derivatives, (q, n) arrays.

    The resistance that depends on speed makes a disturbance of ``z`` decay by
    ``exp(-drag1 t - 2 drag2 ds)`` over a cell, whatever the speed does in it.

    Attributes
    ----------
    reached : ``z`` at the end of the cell, from the plan's ``z`` at its start
    times : running time [s]
    keep : derivative of `reached` by ``z``
    push : derivative of `reached` by the common effort
    """

    reached: FloatArray
    times: FloatArray
    keep: FloatArray
    push: FloatArray

    @staticmethod
    def about(problem: DiscreteProblem, plan: Plan) -> Motion:
        """Linearise about `plan`; where a train stands its time is that of the planned speeds."""
        reached, times = integrate_cells(problem, plan)
        speed = np.sqrt(2.0 * plan.z)
        planned = 2.0 * problem.step / np.maximum(speed[:, :-1] + speed[:, 1:], _STANDING)
        times = np.minimum(times, _LONGER * planned)
        decay = problem.drag1[:, None] * times + 2.0 * problem.drag2 * problem.step
        mean = np.where(np.abs(decay) > 1e-9, -np.expm1(-decay) / np.where(decay, decay, 1.0), 1.0)
        push = problem.gain[:, None] * problem.step * mean
        return Motion(reached, times, np.exp(-decay), push)


class QPSubproblem:
    """One quadratic program about a plan.

    The unknowns are changes of speed to first order, ``dz = scale · change``, and the efforts.
    """

    def __init__(
        self,
        problem: DiscreteProblem,
        plan: Plan,
        price: FloatArray,
        *,
        given: bool = False,
        spare: float = 0.0,
    ) -> None:
        """With a common traction that is `given` as the plan has it only the brakes are free.

        All times are kept with so many seconds to `spare`.
        """
        self.problem, self.plan, self.price, self.given = problem, plan, price, given
        self.spare = spare
        self.motion = Motion.about(problem, plan)
        self.speed = np.sqrt(2.0 * plan.z)
        self.scale = np.maximum(self.speed, SLOW)
        self.unknowns = Unknowns(problem)
        self.late = int(self.unknowns.more((1,), 0.0)[0])
        self.equal, self.below = Rows(), Rows()

    def solve(
        self,
        running_time: float,
        radius: float,
        lateness_price: float,
        smoothing: float,
        changed: float = np.inf,
        loose: BoolArray | bool = False,
    ) -> Solution:
        """The optimum of the program.

        Parameters
        ----------
        running_time : float [s]
        radius : float
            Part of the speed by which it may change.
        lateness_price : float [J/(kg s)]
        smoothing : float [s²/m]
            Price of the squared change of effort from cell to cell.
        changed : float
            By which the last program changed the energy, relative.
        loose : (size,) array of bool, or False
            Unknowns at a bound in the last program that may leave it.

        Raises
        ------
        NoSolutionError
            If the solver finds none, or fails.
        """
        problem, plan, unknowns = self.problem, self.plan, self.unknowns
        q, n = problem.shape
        weight = 1.0 / self.scale[:, 1:]
        motion = self._motion(weight)
        gradient, curvature = self._time(running_time)
        arrival = self._not_after(n, running_time, gradient)
        passing = [
            (number, self._not_after(int(problem.passed[number]), latest, gradient))
            for number, latest in enumerate(problem.latest.tolist())
            if latest < np.inf
        ]
        opening = [
            (number, self._not_before(int(problem.passed[number]), earliest, gradient))
            for number, earliest in enumerate(problem.earliest.tolist())
            if earliest > -np.inf
        ]
        cost, shares = energy_cost(problem, unknowns, self.below)
        brake_limits(problem, unknowns, self.below, np.zeros((q, 1)))
        power, dynamic = self._power()
        self._speeds(radius)
        # Where traction is tapered neither end of the cell leaves what it may be.
        spare = np.abs(problem.taper.fall)
        unknowns.low[unknowns.traction] = spare
        unknowns.high[unknowns.traction] = np.maximum(problem.traction - spare, spare)
        if self.given:
            unknowns.low[unknowns.traction] = unknowns.high[unknowns.traction] = plan.traction
        priced = cost.copy()
        priced[self.late] = lateness_price
        bends = curvature + smoothing * self._effort_changes()
        # Where the worst of several regains least another plan shows too little of the optimum.
        shown = unknowns.regained is None or q == 1 or changed < _SETTLED
        near = Near(self._planned(), loose, changed) if shown else None
        found = solve(unknowns, priced, self.equal, self.below, curvature=bends, near=near)
        x, duals = found.unknowns, found.below
        braking = np.maximum(x[unknowns.braking], 0.0)
        share = braking
        if unknowns.dynamic is not None:
            share = np.clip(x[unknowns.dynamic], 0.0, braking)
        multipliers = Multipliers(
            pull=found.equal[motion] * weight * self.motion.push,
            time=np.maximum(duals[arrival], 0.0),
            passing=_by_point(duals, passing, (q, problem.passed.size)),
            opening=_by_point(duals, opening, (q, problem.passed.size)),
            power=_gathered(duals, power, (q, n)),
            dynamic_power=_gathered(duals, dynamic, (q, n)),
            share=problem.weights if shares is None else np.maximum(duals[shares], 0.0),
        )
        return Solution(
            plan=Plan(
                np.maximum(plan.z + self.scale * x[unknowns.z], 0.0),
                np.maximum(x[unknowns.traction], 0.0),
                braking,
                share,
            ),
            taper=problem.taper,
            energy=float(cost @ x),
            multipliers=multipliers,
            switching=multipliers.pull.sum(axis=0) / problem.step,
            lateness=float(max(x[self.late], 0.0)),
            moved=float(0.5 * (x @ (curvature @ x))),
            statuses=(found.status,),
            loose=found.loose,
        )

    def _planned(self) -> FloatArray:
        """The unknowns as they are planned: no change of speed."""
        plan, unknowns = self.plan, self.unknowns
        planned = np.zeros(unknowns.size)
        planned[unknowns.traction], planned[unknowns.braking] = plan.traction, plan.braking
        if unknowns.dynamic is not None:
            planned[unknowns.dynamic] = plan.dynamic
        if unknowns.regained is not None:
            planned[unknowns.regained] = float(plan.dynamic[0] @ self.problem.step)
        return planned

    def _not_after(self, node: int, latest: float, gradient: FloatArray) -> IntArray:
        """Eq. (3) and (8), linearised: no configuration passes `node` later than it may."""
        left = latest - self.spare - self.motion.times[:, :node].sum(axis=1)
        late = np.full(left.shape, self.late)
        slopes = (self.unknowns.z[:, : node + 1], _until(gradient, node))
        return self.below.add(left, slopes, (late, -1.0))

    def _not_before(self, node: int, earliest: float, gradient: FloatArray) -> IntArray:
        """Nor earlier: the tangent of a constraint that is not convex."""
        over = self.motion.times[:, :node].sum(axis=1) - earliest - self.spare
        late = np.full(over.shape, self.late)
        slopes = (self.unknowns.z[:, : node + 1], -_until(gradient, node))
        return self.below.add(over, slopes, (late, -1.0))

    def _motion(self, weight: FloatArray) -> IntArray:
        """Eq. (2), linearised about the plan; its dual is the costate."""
        problem, plan, motion, unknowns = self.problem, self.plan, self.motion, self.unknowns
        push = motion.push * weight
        jump = (motion.reached - plan.z[:, 1:]) * weight - push * (plan.traction - plan.braking)
        return self.equal.add(
            jump,
            (unknowns.z[:, 1:], 1.0),
            (unknowns.z[:, :-1], -motion.keep * self.scale[:, :-1] * weight),
            (np.broadcast_to(unknowns.traction, problem.shape), -push),
            (unknowns.braking, push),
        )

    def _time(self, running_time: float) -> tuple[FloatArray, sp.csc_array]:
        """Gradient of each cell's time by the changes, and the priced second derivatives.

        With ``t = 2 ds / (v + v')`` a cell: the gradient is ``-t / (v + v')`` by either speed, the
        Hessian a square of the sum of both changes plus, as ``v`` is concave in ``z``, a square
        of each.
        """
        speed, step, z = self.speed, self.problem.step, self.unknowns.z
        total = np.maximum(speed[:, :-1] + speed[:, 1:], _STANDING)
        slope = 2.0 * step / total**2
        # A fixed node at standstill does not move; elsewhere dv = dz / v.
        ratio = np.where(speed > 0.25 * SLOW, self.scale / np.maximum(speed, 0.25 * SLOW), 0.0)
        power = float(self.problem.step @ self.plan.traction) / running_time
        highest = max(float(self.price.max()), 0.0)
        least = max(_LEAST_SHARE * highest, _LEAST_POWER * power)
        price = np.maximum(self.price, least)
        both = np.zeros_like(speed)
        both[:, :-1] += price * slope
        both[:, 1:] += price * slope
        pair = price * 2.0 * slope / total
        bend = both / np.maximum(speed, 0.25 * SLOW)
        bend[:, :-1] += pair
        bend[:, 1:] += pair
        cross_terms = (pair * ratio[:, :-1] * ratio[:, 1:]).ravel()
        here, there, size = z[:, :-1].ravel(), z[:, 1:].ravel(), self.unknowns.size
        values = np.concatenate(((bend * ratio**2).ravel(), cross_terms, cross_terms))
        rows = np.concatenate((z.ravel(), here, there))
        columns = np.concatenate((z.ravel(), there, here))
        gradient = np.stack((-slope * ratio[:, :-1], -slope * ratio[:, 1:]))
        return gradient, sp.csc_array((values, (rows, columns)), shape=(size, size))

    def _effort_changes(self) -> sp.csc_array:
        """Squares of what the efforts change by from cell to cell.

        Speeds that are alternately higher and lower from node to node cost next to nothing, as
        time and resistance of a cell depend on the sum of both its ends. No driver could do so.
        """
        step, unknowns = self.problem.step, self.unknowns
        weight = np.minimum(step[1:] * step[:-1] / (step[1:] + step[:-1]), _SHORT_CELL)
        before, after = (
            np.concatenate((unknowns.traction[part], unknowns.braking[:, part].ravel()))
            for part in (slice(None, -1), slice(1, None))
        )
        weights = np.tile(weight, 1 + unknowns.braking.shape[0])
        values = np.concatenate((weights, weights, -weights, -weights))
        rows = np.concatenate((before, after, before, after))
        columns = np.concatenate((before, after, after, before))
        return sp.csc_array((values, (rows, columns)), shape=(unknowns.size, unknowns.size))

    def _speeds(self, radius: float) -> None:
        """Speed limits, initial and final speed, and the region where the model is trusted."""
        problem, z = self.problem, self.plan.z
        nearer = np.maximum(self.speed - radius * self.scale, 0.5 * self.speed)
        least = least_z(problem)
        high = np.minimum(problem.ceiling, 0.5 * (self.speed + radius * self.scale) ** 2)
        low = np.maximum(np.minimum(0.5 * nearer**2, high), np.minimum(least, problem.ceiling))
        low = np.maximum(low, problem.floor)
        high = np.maximum(high, low)
        low[:, 0] = high[:, 0] = problem.initial
        low[:, -1], high[:, -1] = 0.0, problem.final_ceiling
        self.unknowns.low[self.unknowns.z] = (low - z) / self.scale
        self.unknowns.high[self.unknowns.z] = (high - z) / self.scale

    def _power(self) -> tuple[list[_Limited], list[_Limited]]:
        """Eq. (5) of traction and of the dynamic brake, at both ends of each cell."""
        problem, unknowns, n = self.problem, self.unknowns, self.problem.shape[1]
        taper, level = problem.taper, np.zeros(n)
        pulled, braked = [], []
        for a, power in enumerate(problem.power.tolist()):
            usable, effort = power * (1.0 - taper.crest), unknowns.traction
            most = problem.traction
            for nodes, above in ((slice(0, n), taper.fall), (slice(1, n + 1), -taper.fall)):
                pulled.append(self._below(a, nodes, usable, effort, most, above))
                pulled += self._below_curve(
                    problem.curves, a, nodes, effort, most, above, 1.0 - taper.crest
                )
                if unknowns.dynamic is not None:
                    usable_brake, own = np.full(n, problem.dynamic_power), unknowns.dynamic[a]
                    limit = problem.dynamic[a]
                    braked.append(self._below(a, nodes, usable_brake, own, limit, level))
                    braked += self._below_curve(
                        problem.dynamic_curves, a, nodes, own, limit, level, level + 1.0
                    )
        return pulled, braked

    def _below(
        self,
        a: int,
        nodes: slice,
        power: FloatArray,
        effort: IntArray,
        most: FloatArray,
        above: FloatArray,
    ) -> _Limited:
        """Effort below the tangent of ``power / v`` in z, where that is not far above `most`.

        At the node the effort is so much `above` its mean in the cell.
        """
        highest = np.sqrt(self.speed[a, nodes] ** 2 + 2.0 * self.problem.bulge)
        v = np.maximum(highest, SLOW)
        at = power_cells(self.problem, float(power.min()), most)
        at = at[power[at] / v[at] < _NEAR_POWER * most[at]]
        slope = (power * self.scale[a, nodes] / v**3)[at]
        change, right = self.unknowns.z[a, nodes][at], (power / v - above)[at]
        return a, at, self.below.add(right, (effort[at], 1.0), (change, slope))

    def _below_curve(
        self, curves: Curves | None, a: int, nodes: slice, effort: IntArray,
        most: FloatArray, above: FloatArray, part: FloatArray,
    ) -> list[_Limited]:  # fmt: skip
        """Effort below a part of a curve's tangent in z, as `_below`."""
        if curves is None:
            return []
        v = np.sqrt(self.speed[a, nodes] ** 2 + 2.0 * self.problem.bulge)
        found = []
        for value, slope in curves.lines(a, v):
            at = np.flatnonzero(value * part < _NEAR_POWER * most)
            gained = (part * slope * self.scale[a, nodes] / np.maximum(v, SLOW))[at]
            change, right = self.unknowns.z[a, nodes][at], (value * part - above)[at]
            found.append((a, at, self.below.add(right, (effort[at], 1.0), (change, -gained))))
        return found


def least_z(problem: DiscreteProblem) -> FloatArray:
    """Least ``z`` that programs allow at the nodes, (n + 1,) [m²/s²]; 0 at both ends."""
    left = problem.positions - problem.positions[0], problem.positions[-1] - problem.positions
    return np.asarray(np.minimum(_LEAST_Z, _LEAST_SLOPE * np.minimum(*left)))


def _until(gradient: FloatArray, node: int) -> FloatArray:
    """Gradient of the time up to a node by the changes up to there, from that of every cell."""
    found = np.zeros((gradient.shape[1], node + 1))
    found[:, :-1] += gradient[0, :, :node]
    found[:, 1:] += gradient[1, :, :node]
    return found


def _by_point(
    duals: FloatArray, limits: list[tuple[int, IntArray]], shape: tuple[int, int]
) -> FloatArray:
    """Duals of the rows by configuration and passing point."""
    found = np.zeros(shape)
    for number, rows in limits:
        found[:, number] = np.maximum(duals[rows], 0.0)
    return found


def _gathered(duals: FloatArray, limits: list[_Limited], shape: tuple[int, int]) -> FloatArray:
    """Duals of the rows by configuration and cell, those of both ends together."""
    total = np.zeros(shape)
    for row, at, rows in limits:
        total[row, at] += np.maximum(duals[rows], 0.0)
    return total


NEGLIGIBLE_ENERGY = 1e-3
"""Energy beside which differences do not count [J/kg]: that of a train at 5 cm/s."""

_EXCESS = 1e-6
"""By which a plan may exceed speed limits or power as it is driven, relative."""

LATENESS_PRICE = 100.0
"""Price of lateness over the multiplier of the time; more than a feasible run would pay."""

_MORE = 1.1
"""Times what the next program would leave of a delay, by which it is to be earlier."""

_SETTLED = 1e-4
"""Part of the energy that a program changed, up to which its plan is near the next optimum."""

_NEARLY = 2
"""Times the iterations that a search takes at most that has nearly ended."""

_FREE_ITERATIONS = 10
"""Iterations before the steps are made to shrink."""


@dataclass(frozen=True)
class Tolerances:
    """What quadratic programs leave when they end.

    Attributes
    ----------
    energy : float
        Relative change of energy below which an iteration is the last.
    lateness : float [s]
        That may be left besides.
    smoothing : float [s²/m]
        Price of the squared change of effort from cell to cell.
    """

    energy: float
    lateness: float
    smoothing: float = 7e-4


EXACT = Tolerances(energy=2e-6, lateness=3e-5)
"""Where nothing corrects what is left."""


def minimise(
    problem: DiscreteProblem,
    start: Plan,
    time_price: FloatArray,
    running_time: float,
    tolerances: Tolerances = EXACT,
    *,
    iterations: int = 40,
    given: bool = False,
) -> Solution:
    """Minimise the worst-case energy, beginning from a plan.

    The time may be exceeded at a price that a feasible problem never pays; what remains shows how
    far from feasible a problem is.

    Parameters
    ----------
    start : Plan
    time_price : (q,) array [J/(kg s)]
        Multiplier of the running time, about.
    running_time : float [s]
    tolerances : Tolerances
    iterations : int
        Most quadratic programs to solve; twice as many where the last changed little.
    given : bool
        Whether the common traction stays as it is, and only the brakes are free.

    Raises
    ------
    NoSolutionError
        If the solver finds a quadratic program infeasible, or fails.
    OutOfTimeError
        If no time is left; with the last solution.
    """
    plan = start
    price = np.repeat(time_price[:, None], problem.shape[1], axis=1)
    lateness_price = LATENESS_PRICE * max(float(price.max()), 1.0)
    radius, energy, spare, last, part = 1.0, np.inf, 0.0, np.inf, np.inf
    statuses: list[str] = []
    solution: Solution | None = None
    loose: BoolArray | bool = False
    while True:
        tapered = problem if given else problem.tapered(taper_along(problem, plan))
        program = QPSubproblem(tapered, plan, price, given=given, spare=spare)
        try:
            solution = program.solve(
                running_time, radius, lateness_price, tolerances.smoothing, part, loose
            )
        except OutOfTimeError:
            raise OutOfTimeError(solution) from None
        statuses.extend(solution.statuses)
        plan, price = solution.plan, solution.multipliers.cell_prices(problem)
        driven = realise(tapered, plan)
        late, early = delays(tapered, driven, running_time)
        off = max(float(late.max()), float(early.max())) - solution.lateness
        changed = min(abs(solution.energy - energy), solution.moved)
        enough = tolerances.energy * max(solution.energy, NEGLIGIBLE_ENERGY)
        # One that stands on the way as it is driven is late by no number of seconds.
        if changed <= enough and tolerances.lateness < off < np.inf:
            # What is left of a delay dies out slowly; a plan that much earlier is in time at once.
            spare += _MORE * off * min(off / last, 1.0)
        converged = changed <= enough and off <= tolerances.lateness
        # With a brake of its own each keeps to the limits however far from them its plan is.
        converged = converged and not (problem.common and _excess(tapered, driven) > _EXCESS)
        goes_on = changed < _SETTLED * energy and len(statuses) < _NEARLY * iterations
        if converged or (len(statuses) >= iterations and (given or not goes_on)):
            return replace(solution, statuses=tuple(statuses), converged=converged)
        energy, last = solution.energy, max(off, tolerances.lateness)
        part, loose = changed / max(abs(energy), NEGLIGIBLE_ENERGY), solution.loose
        # The iterations contract by themselves; where they do not, ever smaller steps make them.
        if len(statuses) >= _FREE_ITERATIONS:
            radius *= 0.7


def _excess(problem: DiscreteProblem, driven: Plan) -> float:
    """By how much a driven plan is too fast or takes too much power, relative."""
    ceiling = np.append(problem.ceiling[:-1], problem.final_ceiling)
    fast = float(((driven.z - ceiling) / problem.ceiling.max()).max())
    return max(fast, float((driven.traction / problem.traction_by_power(driven.z)).max()) - 1.0)

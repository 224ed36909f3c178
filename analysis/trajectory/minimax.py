"""Sequential convex programming for the robust minimax problem; paper 002, eq. (1)-(10).

Each round linearises the motion through every cell about the last plan, bounds the power by a
tangent (a global under-estimator, so power is never exceeded), and lets CVXPY solve a quadratic
program in the changes of speed. Running time is convex in ``z``: its constraint is linearised, and
its curvature, weighted with the multiplier of the time, goes into the objective.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from analysis.trajectory.convex import (
    SLOW,
    Rows,
    Unknowns,
    brake_limits,
    energy_cost,
    power_cells,
    solve,
)
from analysis.trajectory.pace import cross, duration, realise
from analysis.trajectory.problem import Plan, Problem

FloatArray = NDArray[np.float64]

_Limited = tuple[int, NDArray[np.int64], NDArray[np.int64]]
"""A configuration, cells in which its power is limited, and the rows that say so."""

_FLOOR = 1e-5
"""Smallest ``z`` between the two ends [m²/s²]."""

_LATENESS_PRICE = 100.0
"""Price of lateness over the multiplier of the time; more than a feasible run would pay."""

_FREE_ROUNDS = 10
"""Rounds before the steps are made to shrink."""

_NEAR_POWER = 1.5
"""A power limit above this many times the largest effort is left out of a round."""

_LEAST_SHARE = 0.02
"""Curvature of a configuration that is not short of time, over that of the one that is.

It damps configurations whose speed the optimum leaves open; at the fixed point it weighs nothing.
"""


@dataclass(frozen=True, eq=False)
class Multipliers:
    """Lagrange multipliers of an optimum, per unit reference inertia.

    Attributes
    ----------
    pull : (q, n) array
        Of the motion through a cell, times what the common effort does to it: energy that a unit
        of effort is worth in the cell. Its sum over the configurations is ``step · switching``.
    time : (q,) array [J/(kg s)]
        Of the running time.
    power, dynamic_power : (q, n) array
        Of the limits of power, both ends of a cell together.
    share : (q,) array
        Of the energy that is regained; it weighs the configurations, the worst alone as a rule.
    """

    pull: FloatArray
    time: FloatArray
    power: FloatArray
    dynamic_power: FloatArray
    share: FloatArray


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the rounds ended.

    Attributes
    ----------
    plan : Plan
    energy : float [J/kg]
        Worst case, per unit reference inertia.
    multipliers : Multipliers
    switching : (n,) array
        Switching function of the robust maximum principle: ``sum of lambda_v / v`` over the
        configurations; above 1 traction pays, below 0 braking does.
    lateness : float [s]
        By which the timetable cannot be kept; 0 in a feasible run.
    statuses : tuple of str
        The solver's word on each round.
    settled : bool
        Whether the last round changed nothing any more.
    """

    plan: Plan
    energy: float
    multipliers: Multipliers
    switching: FloatArray
    lateness: float
    statuses: tuple[str, ...] = ()
    settled: bool = False

    @property
    def time_price(self) -> FloatArray:
        """What a second is worth to each configuration, (q,) [J/(kg s)]."""
        return self.multipliers.time


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
    def about(problem: Problem, plan: Plan) -> Motion:
        """Linearise about `plan`."""
        reached, times = cross(problem, plan)
        decay = problem.drag1[:, None] * times + 2.0 * problem.drag2 * problem.step
        mean = np.where(np.abs(decay) > 1e-9, -np.expm1(-decay) / np.where(decay, decay, 1.0), 1.0)
        push = problem.gain[:, None] * problem.step * mean
        return Motion(reached, times, np.exp(-decay), push)


def minimise(
    problem: Problem,
    start: Plan,
    time_price: FloatArray,
    running_time: float,
    *,
    rounds: int = 40,
    tolerance: float = 2e-6,
) -> Solution:
    """Minimise the worst-case energy, beginning from a plan.

    The time may be exceeded at a price that a feasible problem never pays; what remains tells how
    far from feasible a problem is.

    Parameters
    ----------
    start : Plan
    time_price : (q,) array [J/(kg s)]
        Multiplier of the running time, about.
    running_time : float [s]
    rounds : int
        Most quadratic programs to solve.
    tolerance : float
        Relative change of energy below which a round is the last.

    Raises
    ------
    NoSolutionError
        If the solver finds a round infeasible, or fails.
    """
    plan, price, motion = start, time_price, Motion.about(problem, start)
    lateness_price = _LATENESS_PRICE * max(float(price.max()), 1.0)
    radius, energy = 1.0, np.inf
    statuses: list[str] = []
    while True:
        solution = _Round(problem, plan, motion, price).solve(running_time, radius, lateness_price)
        statuses.extend(solution.statuses)
        plan, price = solution.plan, solution.time_price
        motion = Motion.about(problem, plan)
        late = duration(problem, realise(problem, plan)) - running_time - solution.lateness
        settled = abs(solution.energy - energy) <= tolerance * abs(energy)
        settled = settled and late <= 15.0 * tolerance
        if settled or len(statuses) == rounds:
            return replace(solution, statuses=tuple(statuses), settled=settled)
        energy = solution.energy
        # The rounds contract by themselves; where they do not, ever smaller steps make them.
        if len(statuses) >= _FREE_ROUNDS:
            radius *= 0.7


class _Round:
    """One quadratic program about a plan.

    The unknowns are changes of speed to first order, ``dz = scale · change``, and the efforts.
    """

    def __init__(self, problem: Problem, plan: Plan, motion: Motion, price: FloatArray) -> None:
        self.problem, self.plan, self.motion, self.price = problem, plan, motion, price
        self.speed = np.sqrt(2.0 * plan.z)
        self.scale = np.maximum(self.speed, SLOW)
        self.unknowns = Unknowns(problem)
        self.late = int(self.unknowns.more((1,), 0.0)[0])
        self.equal, self.below = Rows(), Rows()

    def solve(self, running_time: float, radius: float, lateness_price: float) -> Solution:
        problem, plan, unknowns = self.problem, self.plan, self.unknowns
        q, n = problem.shape
        weight = 1.0 / self.scale[:, 1:]
        motion = self._motion(weight)
        gradient, curvature = self._time()
        left = running_time - self.motion.times.sum(axis=1)
        late = np.full(q, self.late)
        arrival = self.below.add(left, (unknowns.z, gradient), (late, -1.0))
        cost, shares = energy_cost(problem, unknowns, self.below)
        brake_limits(problem, unknowns, self.below, np.zeros((q, 1)))
        power, dynamic = self._power()
        self._speeds(radius)
        priced = cost.copy()
        priced[self.late] = lateness_price
        found = solve(unknowns, priced, self.equal, self.below, curvature=curvature)
        x, duals = found.unknowns, found.below
        braking = np.maximum(x[unknowns.braking], 0.0)
        share = braking
        if unknowns.dynamic is not None:
            share = np.clip(x[unknowns.dynamic], 0.0, braking)
        multipliers = Multipliers(
            pull=found.equal[motion] * weight * self.motion.push,
            time=np.maximum(duals[arrival], 0.0),
            power=_gathered(duals, power, (q, n)),
            dynamic_power=_gathered(duals, dynamic, (q, n)),
            share=np.zeros(q) if shares is None else np.maximum(duals[shares], 0.0),
        )
        return Solution(
            plan=Plan(
                np.maximum(plan.z + self.scale * x[unknowns.z], 0.0),
                np.maximum(x[unknowns.traction], 0.0),
                braking,
                share,
            ),
            energy=float(cost @ x),
            multipliers=multipliers,
            switching=multipliers.pull.sum(axis=0) / problem.step,
            lateness=float(max(x[self.late], 0.0)),
            statuses=(found.status,),
        )

    def _motion(self, weight: FloatArray) -> NDArray[np.int64]:
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

    def _time(self) -> tuple[FloatArray, sp.csc_array]:
        """Gradient of the running time by the changes, and its priced second derivatives.

        With ``t = 2 ds / (v + v')`` a cell: the gradient is ``-t / (v + v')`` by either speed, the
        Hessian a square of the sum of both changes plus, as ``v`` is concave in ``z``, a square
        of each.
        """
        speed, step, z = self.speed, self.problem.step, self.unknowns.z
        total = speed[:, :-1] + speed[:, 1:]
        slope = 2.0 * step / total**2
        # A fixed node at standstill does not move; elsewhere dv = dz / v.
        ratio = np.where(speed > 0.25 * SLOW, self.scale / np.maximum(speed, 0.25 * SLOW), 0.0)
        both = np.zeros_like(speed)
        both[:, :-1] += slope
        both[:, 1:] += slope
        price = np.maximum(self.price, _LEAST_SHARE * self.price.max())[:, None]
        pair = price * 2.0 * slope / total
        bend = price * both / np.maximum(speed, 0.25 * SLOW)
        bend[:, :-1] += pair
        bend[:, 1:] += pair
        cross_terms = (pair * ratio[:, :-1] * ratio[:, 1:]).ravel()
        here, there, size = z[:, :-1].ravel(), z[:, 1:].ravel(), self.unknowns.size
        values = np.concatenate(((bend * ratio**2).ravel(), cross_terms, cross_terms))
        rows = np.concatenate((z.ravel(), here, there))
        columns = np.concatenate((z.ravel(), there, here))
        return -both * ratio, sp.csc_array((values, (rows, columns)), shape=(size, size))

    def _speeds(self, radius: float) -> None:
        """Speed limits, initial and final speed, and the region where the model is trusted."""
        problem, z = self.problem, self.plan.z
        nearer = np.maximum(self.speed - radius * self.scale, 0.5 * self.speed)
        low = np.maximum(0.5 * nearer**2, _FLOOR)
        high = np.minimum(problem.ceiling, 0.5 * (self.speed + radius * self.scale) ** 2)
        low[:, 0] = high[:, 0] = problem.initial
        low[:, -1], high[:, -1] = 0.0, problem.final_ceiling
        self.unknowns.low[self.unknowns.z] = (low - z) / self.scale
        self.unknowns.high[self.unknowns.z] = (high - z) / self.scale

    def _power(self) -> tuple[list[_Limited], list[_Limited]]:
        """Eq. (5) at both ends of each cell, of traction and of the dynamic brake."""
        problem, unknowns, n = self.problem, self.unknowns, self.problem.shape[1]
        pulled, braked = [], []
        for nodes in (slice(0, n), slice(1, n + 1)):
            for a, power in enumerate(problem.power.tolist()):
                pulled.append(self._below(a, nodes, power, unknowns.traction, problem.traction))
                if unknowns.dynamic is not None:
                    power, effort = problem.dynamic_power, unknowns.dynamic[a]
                    braked.append(self._below(a, nodes, power, effort, problem.dynamic[a]))
        return pulled, braked

    def _below(
        self, a: int, nodes: slice, power: float, effort: NDArray[np.int64], most: FloatArray
    ) -> _Limited:
        """Effort below the tangent of ``power / v`` in z, where that is not far above `most`."""
        highest = np.sqrt(self.speed[a, nodes] ** 2 + 2.0 * self.problem.bulge)
        v = np.maximum(highest, SLOW)
        at = power_cells(self.problem, power, most)
        at = at[power / v[at] < _NEAR_POWER * most[at]]
        slope = power * (self.scale[a, nodes] / v**3)[at]
        change = self.unknowns.z[a, nodes][at]
        return a, at, self.below.add(power / v[at], (effort[at], 1.0), (change, slope))


def _gathered(duals: FloatArray, told: list[_Limited], shape: tuple[int, int]) -> FloatArray:
    """Duals of the rows by configuration and cell, those of both ends together."""
    total = np.zeros(shape)
    for row, at, rows in told:
        total[row, at] += np.maximum(duals[rows], 0.0)
    return total

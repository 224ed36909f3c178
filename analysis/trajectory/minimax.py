"""Sequential convex programming for the robust minimax problem; paper 002, eq. (1)-(10).

Each round linearises the motion through every cell about the last plan, bounds the power by a
tangent (a global under-estimator, so power is never exceeded), and lets CVXPY solve a quadratic
program in the changes of speed. Running time is convex in ``z``: its constraint is linearised, and
its curvature, weighted with the multiplier of the time, goes into the objective.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.convex import (
    SLOW,
    effort,
    effort_rules,
    power_cells,
    solve,
    tells_dynamic,
    worst_energy,
)
from analysis.trajectory.pace import cross, duration, realise
from analysis.trajectory.problem import Plan, Problem

FloatArray = NDArray[np.float64]

_FLOOR = 1e-5
"""Smallest ``z`` between the two ends [m²/s²]."""

_LATENESS_PRICE = 100.0
"""Price of lateness over the multiplier of the time; more than a feasible run would pay."""

_FREE_ROUNDS = 10
"""Rounds before the steps are made to shrink."""

_LEAST_SHARE = 0.02
"""Curvature of a configuration that is not short of time, over that of the one that is.

It damps configurations whose speed the optimum leaves open; at the fixed point it weighs nothing.
"""


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the rounds ended.

    Attributes
    ----------
    plan : Plan
    energy : float [J/kg]
        Worst case, per unit reference inertia.
    time_price : (q,) array [J/(kg s)]
        Multiplier of the running time of each configuration.
    switching : (n,) array
        Switching function of the robust maximum principle: ``sum of lambda_v / v`` over the
        configurations; above 1 traction pays, below 0 braking does.
    lateness : float [s]
        By which the timetable cannot be kept; 0 in a feasible run.
    statuses : tuple of str
        The solver's word on each round.
    """

    plan: Plan
    energy: float
    time_price: FloatArray
    switching: FloatArray
    lateness: float
    statuses: tuple[str, ...] = ()


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
        settled = abs(solution.energy - energy) <= 2e-6 * abs(energy) and late <= 3e-5
        if settled or len(statuses) == rounds:
            return replace(solution, statuses=tuple(statuses))
        energy = solution.energy
        # The rounds contract by themselves; where they do not, ever smaller steps make them.
        if len(statuses) >= _FREE_ROUNDS:
            radius *= 0.7


class _Round:
    """One quadratic program about a plan.

    The variables are changes of speed to first order, ``dz = scale · change``, and the efforts.
    """

    def __init__(self, problem: Problem, plan: Plan, motion: Motion, price: FloatArray) -> None:
        q, n = problem.shape
        self.problem, self.plan, self.motion, self.price = problem, plan, motion, price
        self.speed = np.sqrt(2.0 * plan.z)
        self.scale = np.maximum(self.speed, SLOW)
        self.change = cp.Variable((q, n + 1))
        self.traction = cp.Variable(n)
        self.braking = cp.Variable((1 if problem.common else q, n))
        self.dynamic = cp.Variable((q, n)) if tells_dynamic(problem) else None
        self.late = cp.Variable(nonneg=True)

    def solve(self, running_time: float, radius: float, lateness_price: float) -> Solution:
        problem, plan = self.problem, self.plan
        q, n = problem.shape
        weight = 1.0 / self.scale[:, 1:]
        motion = self._motion(weight)
        gradient, curvature = self._time()
        arrival = (
            self.motion.times.sum(axis=1) + cp.sum(cp.multiply(gradient, self.change), axis=1)
            <= running_time + self.late
        )
        energy = worst_energy(problem, self.traction, self.dynamic)
        nothing = np.zeros((q, 1))
        efforts = effort_rules(problem, self.traction, self.braking, self.dynamic, nothing)
        _, status = solve(
            energy + curvature + lateness_price * self.late,
            [motion, arrival, *self._speeds(radius), *efforts, *self._power()],
        )
        braking = np.broadcast_to(np.maximum(self.braking.value, 0.0), (q, n)).copy()
        share = braking if self.dynamic is None else np.clip(self.dynamic.value, 0.0, braking)
        costate = motion.dual_value * weight
        return Solution(
            plan=Plan(
                np.maximum(plan.z + self.scale * self.change.value, 0.0),
                np.maximum(self.traction.value, 0.0),
                braking,
                share,
            ),
            energy=float(energy.value),
            time_price=np.asarray(arrival.dual_value, dtype=np.float64).reshape(q),
            switching=(costate * self.motion.push / problem.step).sum(axis=0),
            lateness=float(self.late.value),
            statuses=(status,),
        )

    def _motion(self, weight: FloatArray) -> Any:
        """Eq. (2), linearised about the plan; its dual is the costate."""
        problem, plan, motion = self.problem, self.plan, self.motion
        push = motion.push * weight
        jump = (motion.reached - plan.z[:, 1:]) * weight - push * (plan.traction - plan.braking)
        return (
            self.change[:, 1:]
            - cp.multiply(motion.keep * self.scale[:, :-1] * weight, self.change[:, :-1])
            - cp.multiply(push, effort(problem, self.traction, self.braking))
            == jump
        )

    def _time(self) -> tuple[FloatArray, Any]:
        """Gradient of the running time by the changes, and its priced second-order term.

        With ``t = 2 ds / (v + v')`` a cell: the gradient is ``-t / (v + v')`` by either speed, the
        Hessian a square of the sum of both changes plus, as ``v`` is concave in ``z``, a square
        of each.
        """
        speed, step = self.speed, self.problem.step
        total = speed[:, :-1] + speed[:, 1:]
        slope = 2.0 * step / total**2
        # A fixed node at standstill does not move; elsewhere dv = dz / v.
        ratio = np.where(speed > 0.25 * SLOW, self.scale / np.maximum(speed, 0.25 * SLOW), 0.0)
        both = np.zeros_like(speed)
        both[:, :-1] += slope
        both[:, 1:] += slope
        price = np.maximum(self.price, _LEAST_SHARE * self.price.max())[:, None]
        bend = np.sqrt(price * both / np.maximum(speed, 0.25 * SLOW)) * ratio
        pair = np.sqrt(price * 2.0 * slope / total)
        moved = cp.multiply(ratio, self.change)
        squares = cp.sum_squares(cp.multiply(pair, moved[:, :-1] + moved[:, 1:]))
        return -both * ratio, 0.5 * (squares + cp.sum_squares(cp.multiply(bend, self.change)))

    def _speeds(self, radius: float) -> list[Any]:
        """Speed limits, initial and final speed, and the region where the model is trusted."""
        problem, z = self.problem, self.plan.z
        n = problem.shape[1]
        nearer = np.maximum(self.speed - radius * self.scale, 0.5 * self.speed)
        low = np.maximum(0.5 * nearer**2, _FLOOR)
        high = np.minimum(problem.ceiling, 0.5 * (self.speed + radius * self.scale) ** 2)
        inner = slice(1, n)
        at_end = z[:, n] + cp.multiply(self.scale[:, n], self.change[:, n])
        return [
            self.change[:, 0] == (problem.initial - z[:, 0]) / self.scale[:, 0],
            self.change[:, inner] >= ((low - z) / self.scale)[:, inner],
            self.change[:, inner] <= ((high - z) / self.scale)[:, inner],
            at_end >= 0.0,
            at_end <= problem.final_ceiling,
        ]

    def _power(self) -> list[Any]:
        """Eq. (5) at both ends of each cell: effort below the tangent of ``power / v`` in z."""
        problem, rules = self.problem, []
        n = problem.shape[1]
        for nodes in (slice(0, n), slice(1, n + 1)):
            highest = np.sqrt(self.speed[:, nodes] ** 2 + 2.0 * problem.bulge)
            v = np.maximum(highest, SLOW)
            inverse = 1.0 / v - cp.multiply(self.scale[:, nodes] / v**3, self.change[:, nodes])
            for row, power in enumerate(problem.power):
                at = power_cells(problem, power, problem.traction)
                rules.append(self.traction[at] <= power * inverse[row, at])
                if self.dynamic is not None:
                    at = power_cells(problem, problem.dynamic_power, problem.dynamic[row])
                    rules.append(self.dynamic[row, at] <= problem.dynamic_power * inverse[row, at])
        return rules

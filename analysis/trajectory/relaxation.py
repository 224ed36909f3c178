"""The convex relaxation of the discretised problem: a lower bound, and a plan to begin with.

Next to ``z`` each node has a speed ``w`` with ``w² <= 2 z``, and each cell a time per metre ``tau``
with ``tau (w + w') / 2 >= 1``; both are second-order cones that stay regular at standstill. The
linear part of the running resistance acts on ``w``, and the power limit reads ``u <= power tau``.
Every feasible trajectory of the discretised problem satisfies all of it, so none needs less than
the minimum; nor is ``w`` below the chord of ``sqrt(2 z)`` up to the limit. What is lost is small
where time is worth something: the power limit sees a cell's mean speed, where the trajectory
has to keep it at the faster end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.convex import (
    SLOW,
    Found,
    Rows,
    Unknowns,
    bounded,
    brake_limits,
    energy_cost,
    power_cells,
    solve,
)
from analysis.trajectory.pace import dynamic_share
from analysis.trajectory.problem import Plan, Problem

FloatArray = NDArray[np.float64]

MEAN_SPEED = 0.1
"""By which a cell's mean speed may exceed the mean of its ends [m/s]; the brake absorbs it."""


@dataclass(frozen=True, eq=False)
class Relaxed:
    """Minimum of the relaxation.

    Attributes
    ----------
    bound : float [J/kg]
        No trajectory of the discretised problem has less worst-case energy.
    plan : Plan
        Feasible but for the power limit, by the change of speed over a cell.
    time_price : (q,) array [J/(kg s)]
    status : str
        The solver's word.
    """

    bound: float
    plan: Plan
    time_price: FloatArray
    status: str


class Relaxation:
    """The relaxed problem, scaled by speeds.

    Parameters
    ----------
    problem : Problem
    speeds : (q, n + 1) array [m/s]
        Anything plausible; it scales the variables and changes no result.
    """

    def __init__(self, problem: Problem, speeds: FloatArray) -> None:
        q, n = problem.shape
        self.problem = problem
        self.scale = np.maximum(speeds, SLOW)
        self.total = self.scale[:, :-1] + self.scale[:, 1:]
        self.unknowns = Unknowns(problem)  # z over scale² / 2
        self.w = self.unknowns.more((q, n + 1))  # speed over scale
        self.tau = self.unknowns.more((q, n))  # time per metre, times the mean of the scales
        self.longest = int(self.unknowns.more((1,))[0])
        self.equal, self.below = Rows(), Rows()
        self._motion()
        # The resistance acts on the mean of a cell's end speeds, which the true mean exceeds by a
        # trifle; the brake gets that much more room, so that no trajectory is excluded.
        spare = MEAN_SPEED * (problem.drag1 / problem.gain)[:, None]
        brake_limits(problem, self.unknowns, self.below, spare)
        self._power()
        self.cost, _ = energy_cost(problem, self.unknowns, self.below)
        last = np.full(q, self.longest)
        seconds = 2.0 * problem.step / self.total
        self.arrival = self.below.add(np.zeros(q), (self.tau, seconds), (last, -1.0))
        self.passing = [
            self.below.add(np.full(q, latest), (self.tau[:, :node], seconds[:, :node]))
            for node, latest in zip(problem.passed.tolist(), problem.latest.tolist(), strict=True)
            if latest < np.inf
        ]
        # Not before a time, and at the end by another: the rest takes no more than what is left.
        self.passing += [
            self.below.add(
                np.full(q, -earliest), (self.tau[:, node:], seconds[:, node:]), (last, -1.0)
            )
            for node, earliest in zip(
                problem.passed.tolist(), problem.earliest.tolist(), strict=True
            )
            if earliest > -np.inf
        ]

    def least_energy(self, running_time: float) -> Relaxed:
        """Minimise the worst-case energy within `running_time` [s].

        Raises
        ------
        NoSolutionError
            If there is no such trajectory, which proves that the problem has none either.
        """
        problem, unknowns = self.problem, self.unknowns
        unknowns.high[self.longest] = running_time
        found = self._solved(self.cost)
        z = np.maximum(0.5 * self.scale**2 * found.unknowns[unknowns.z], 0.0)
        traction = np.maximum(found.unknowns[unknowns.traction], 0.0)
        braking = np.maximum(found.unknowns[unknowns.braking], 0.0)
        plan = Plan(z, traction, braking, dynamic_share(problem, z, braking))
        rows = [self.arrival, *self.passing]
        price = np.sum([np.maximum(found.below[each], 0.0) for each in rows], axis=0)
        return Relaxed(found.value, plan, price, found.status)

    def least_time(self) -> float:
        """No trajectory takes less time than this [s], whatever its energy.

        Raises
        ------
        NoSolutionError
            If no trajectory exists for any time.
        """
        self.unknowns.high[self.longest] = np.inf
        time = np.zeros(self.unknowns.size)
        time[self.longest] = 1.0
        return self._solved(time).value

    def _solved(self, cost: FloatArray) -> Found:
        x = bounded(self.unknowns)
        cones = self._cones(x)
        return solve(self.unknowns, cost, self.equal, self.below, cones=cones, variable=x)

    def _motion(self) -> None:
        """Eq. (2) over a cell, exact for the quadratic resistance; rows scaled by the speed."""
        problem, step, unknowns = self.problem, self.problem.step, self.unknowns
        z, w = unknowns.z, self.w
        decay = 2.0 * problem.drag2 * step
        mean = np.where(np.abs(decay) > 1e-9, -np.expm1(-decay) / np.where(decay, decay, 1.0), 1.0)
        row = 1.0 / self.scale[:, 1:]
        push, half = step * mean * row, 0.5 * self.scale**2
        ceiling = np.append(problem.ceiling[:-1], problem.final_ceiling)
        linear, pull = 0.5 * push * problem.drag1[:, None], push * problem.gain[:, None]
        self.equal.add(
            -push * problem.mean_drag0,
            (z[:, 1:], half[:, 1:] * row),
            (z[:, :-1], -half[:, :-1] * np.exp(-decay) * row),
            (np.broadcast_to(unknowns.traction, push.shape), -pull),
            (unknowns.braking, pull),
            (w[:, :-1], linear * self.scale[:, :-1]),
            (w[:, 1:], linear * self.scale[:, 1:]),
        )
        unknowns.high[z[:, 1:]] = (ceiling / half)[:, 1:]
        unknowns.low[z[:, 1:]] = (problem.floor / half)[:, 1:]
        unknowns.low[w[:, 1:]] = (np.sqrt(2.0 * problem.floor) / self.scale)[:, 1:]
        unknowns.low[z[:, 0]] = unknowns.high[z[:, 0]] = problem.initial / half[:, 0]
        speed = np.sqrt(2.0 * problem.initial) / self.scale[:, 0]
        unknowns.low[w[:, 0]] = unknowns.high[w[:, 0]] = speed
        # No speed is below its square over the limit: z's chord, where w² <= 2 z leaves it free.
        limited = np.flatnonzero(ceiling > 0.0)[1:]
        shares = self.scale[:, limited] / np.sqrt(2.0 * ceiling[limited])
        self.below.add(np.zeros(shares.shape), (z[:, limited], shares), (w[:, limited], -1.0))
        if self._stops:
            unknowns.low[z[:, -1]] = unknowns.low[w[:, -1]] = unknowns.high[w[:, -1]] = 0.0

    @property
    def _stops(self) -> bool:
        """At standstill the cone has no inside; such a node has speed 0 instead."""
        return self.problem.final_ceiling == 0.0 and not self.problem.common

    def _cones(self, x: cp.Variable) -> list[Any]:
        """``w² <= z`` at the nodes, and ``tau`` times the mean speed of a cell at least 1."""
        n = self.problem.shape[1]
        last = n if self._stops else n + 1
        squares = x[self.unknowns.z[:, 1:last].ravel()]
        speeds = x[self.w[:, 1:last].ravel()]
        q = self.w.shape[0]
        mean = Rows()
        mean.add(
            np.zeros((q, n)),
            (self.w[:, :-1], self.scale[:, :-1] / self.total),
            (self.w[:, 1:], self.scale[:, 1:] / self.total),
        )
        means, taus = mean.matrix(self.unknowns.size) @ x, x[self.tau.ravel()]
        return [
            cp.SOC(squares + 1.0, cp.vstack([2.0 * speeds, squares - 1.0]), axis=0),
            cp.SOC(taus + means, cp.vstack([taus - means, np.full(q * n, 2.0)]), axis=0),
        ]

    def _power(self) -> None:
        """Eq. (5), with the cell's time per metre in the place of ``1 / v``."""
        problem, unknowns, inverse = self.problem, self.unknowns, 2.0 / self.total
        for a, power in enumerate(problem.power):
            limits = [(unknowns.traction, float(power), problem.traction)]
            if unknowns.dynamic is not None:
                limits.append((unknowns.dynamic[a], problem.dynamic_power, problem.dynamic[a]))
            for effort, most, ceiling in limits:
                at = power_cells(problem, most, ceiling)
                slope = -most * inverse[a, at]
                self.below.add(np.zeros(at.size), (effort[at], 1.0), (self.tau[a, at], slope))

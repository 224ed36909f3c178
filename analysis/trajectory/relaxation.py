"""The convex relaxation of the discretised problem: a lower bound, and a plan to begin with.

Next to ``z`` each node has a speed ``w`` with ``w² <= 2 z``, and each cell a time per metre ``tau``
with ``tau (w + w') / 2 >= 1``; both are second-order cones that stay regular at standstill. The
linear part of the running resistance acts on ``w``, and the power limit reads ``u <= power tau``.
Every feasible trajectory of the discretised problem satisfies all of it, so none needs less than
the minimum. What is lost is small: the power limit sees a cell's mean speed, where the trajectory
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
    effort,
    effort_rules,
    power_cells,
    solve,
    tells_dynamic,
    worst_energy,
)
from analysis.trajectory.pace import dynamic_share
from analysis.trajectory.problem import Plan, Problem

FloatArray = NDArray[np.float64]

_MEAN_SPEED = 0.1
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
    """The relaxed problem, scaled by a plan.

    Parameters
    ----------
    problem : Problem
    plan : Plan
        Any plan with plausible speeds; it scales the variables and changes no result.
    """

    def __init__(self, problem: Problem, plan: Plan) -> None:
        q, n = problem.shape
        self.problem = problem
        speed = np.sqrt(2.0 * plan.z)
        self.scale = np.maximum(speed, SLOW)
        self.total = self.scale[:, :-1] + self.scale[:, 1:]
        self.square = cp.Variable((q, n + 1))  # z over scale² / 2
        self.w = cp.Variable((q, n + 1))  # speed over scale
        self.tau = cp.Variable((q, n))  # time per metre, times the mean of the scales
        self.traction = cp.Variable(n)
        self.braking = cp.Variable((1 if problem.common else q, n))
        self.dynamic = cp.Variable((q, n)) if tells_dynamic(problem) else None
        self.time = cp.sum(cp.multiply(2.0 * problem.step / self.total, self.tau), axis=1)
        # The resistance acts on the mean of a cell's end speeds, which the true mean exceeds by a
        # trifle; the brake gets that much more room, so that no trajectory is excluded.
        spare = _MEAN_SPEED * (problem.drag1 / problem.gain)[:, None]
        efforts = effort_rules(problem, self.traction, self.braking, self.dynamic, spare)
        self.rules = [*self._motion(), *self._cones(), *efforts, *self._power()]

    def least_energy(self, running_time: float) -> Relaxed:
        """Minimise the worst-case energy within `running_time` [s].

        Raises
        ------
        NoSolutionError
            If there is no such trajectory, which proves that the problem has none either.
        """
        problem = self.problem
        arrival = self.time <= running_time
        energy = worst_energy(problem, self.traction, self.dynamic)
        program, status = solve(energy, [*self.rules, arrival])
        z = np.maximum(0.5 * self.scale**2 * self.square.value, 0.0)
        traction = np.maximum(self.traction.value, 0.0)
        braking = np.broadcast_to(np.maximum(self.braking.value, 0.0), problem.shape).copy()
        price = np.asarray(arrival.dual_value, dtype=np.float64).reshape(-1)
        plan = Plan(z, traction, braking, dynamic_share(problem, z, braking))
        return Relaxed(float(program.value), plan, price, status)

    def least_time(self) -> float:
        """No trajectory takes less time than this [s], whatever its energy.

        Raises
        ------
        NoSolutionError
            If no trajectory exists for any time.
        """
        program, _ = solve(cp.max(self.time), self.rules)
        return float(program.value)

    def _motion(self) -> list[Any]:
        """Eq. (2) over a cell, exact for the quadratic resistance; rows scaled by the speed."""
        problem, step = self.problem, self.problem.step
        decay = 2.0 * problem.drag2 * step
        mean = np.where(np.abs(decay) > 1e-9, -np.expm1(-decay) / np.where(decay, decay, 1.0), 1.0)
        row = 1.0 / self.scale[:, 1:]
        push, half = step * mean * row, 0.5 * self.scale**2
        ceiling = np.append(problem.ceiling[:-1], problem.final_ceiling)
        linear = 0.5 * push * problem.drag1[:, None]
        return [
            cp.multiply(half[:, 1:] * row, self.square[:, 1:])
            - cp.multiply(half[:, :-1] * np.exp(-decay) * row, self.square[:, :-1])
            - cp.multiply(
                push * problem.gain[:, None], effort(problem, self.traction, self.braking)
            )
            + cp.multiply(linear * self.scale[:, :-1], self.w[:, :-1])
            + cp.multiply(linear * self.scale[:, 1:], self.w[:, 1:])
            == -push * problem.mean_drag0,
            self.square[:, 0] == problem.initial / half[:, 0],
            self.w[:, 0] == np.sqrt(2.0 * problem.initial) / self.scale[:, 0],
            self.square[:, 1:] <= (ceiling / half)[:, 1:],
        ]

    def _cones(self) -> list[Any]:
        n = self.problem.shape[1]
        # At standstill the cone has no inside; such a node has speed 0 instead.
        stops = self.problem.final_ceiling == 0.0 and not self.problem.common
        last = n if stops else n + 1
        mean = cp.multiply(self.scale[:, :-1] / self.total, self.w[:, :-1]) + cp.multiply(
            self.scale[:, 1:] / self.total, self.w[:, 1:]
        )
        cones = [
            _below_root(self.square[:, 1:last], self.w[:, 1:last]),
            _above_inverse(self.tau, mean),
        ]
        return [*cones, self.square[:, n] >= 0.0, self.w[:, n] == 0.0] if stops else cones

    def _power(self) -> list[Any]:
        """Eq. (5), with the cell's time per metre in the place of ``1 / v``."""
        problem, rules = self.problem, []
        inverse = 2.0 / self.total
        for row, power in enumerate(problem.power):
            at = power_cells(problem, power, problem.traction)
            rules.append(
                self.traction[at] <= cp.multiply(power * inverse[row, at], self.tau[row, at])
            )
            if self.dynamic is not None:
                power = problem.dynamic_power
                at = power_cells(problem, power, problem.dynamic[row])
                rules.append(
                    self.dynamic[row, at]
                    <= cp.multiply(power * inverse[row, at], self.tau[row, at])
                )
        return rules


def _below_root(square: Any, w: Any) -> Any:
    """``w² <= square``, elementwise."""
    t, x = cp.vec(square, order="C"), cp.vec(w, order="C")
    return cp.SOC(t + 1.0, cp.vstack([2.0 * x, t - 1.0]), axis=0)


def _above_inverse(a: Any, b: Any) -> Any:
    """``a b >= 1``, elementwise."""
    x, y = cp.vec(a, order="C"), cp.vec(b, order="C")
    return cp.SOC(x + y, cp.vstack([x - y, np.full(x.size, 2.0)]), axis=0)

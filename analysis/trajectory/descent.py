"""A safe search: from one plan that is driven in time to a better one.

The iterations of `sqp` need a start that is near enough, and pass through plans that no train can
drive. Where they do not settle, these do: they begin from a run at a constant pace, which any
feasible problem has, each program begins from a plan as it is driven, so that it has a solution,
and its own plan counts only if it is better once it is driven, too. A trust region shrinks until
it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.trajectory.convex import Multipliers, NoSolutionError, OutOfTimeError
from analysis.trajectory.discretisation import DiscreteProblem, Plan, taper_along
from analysis.trajectory.rollout import (
    delays,
    energy_of,
    realise,
    run_together,
)
from analysis.trajectory.sqp import (
    EXACT,
    LATENESS_PRICE,
    NEGLIGIBLE_ENERGY,
    QPSubproblem,
    Solution,
    Tolerances,
)
from trainlog.arrays import FloatArray

_FIRST_RADIUS, _LEAST_RADIUS = 0.5, 1e-3
"""Part of the speed by which a step may change it: the first, and the last."""

_FAILED, _WIDER = 0.25, 2.0
"""Times the radius after a step that is no better, and after one that is."""


@dataclass(frozen=True, eq=False)
class DrivenPlan:
    """A plan as it is driven.

    Attributes
    ----------
    problem : DiscreteProblem
        With the traction tapered along the plan.
    plan : Plan
    late : float [s]
        Of the slowest; infinite where one stands on the way, or does not keep the speed required
        at the end or at a passing point.
    """

    problem: DiscreteProblem
    plan: Plan
    late: float

    @staticmethod
    def of(problem: DiscreteProblem, plan: Plan, running_time: float) -> DrivenPlan:
        """Drive a plan of the untapered `problem`."""
        tapered = problem.tapered(taper_along(problem, plan))
        spare = np.abs(tapered.taper.fall)
        traction = np.clip(plan.traction, spare, np.maximum(problem.traction - spare, spare))
        return DrivenPlan.along(tapered, replace(plan, traction=traction), running_time)

    @staticmethod
    def along(problem: DiscreteProblem, plan: Plan, running_time: float) -> DrivenPlan:
        """Drive a plan of a problem that is tapered already."""
        driven = realise(problem, plan)
        z = driven.z
        late = max(float(each.max()) for each in delays(problem, driven, running_time))
        kept = z[:, -1].max() <= problem.final_ceiling + _SPARE_Z
        kept &= bool(np.all(z >= problem.floor - _SPARE_Z) and np.all(z[:, 1:-1] > 0.0))
        return DrivenPlan(problem, driven, late if kept else np.inf)

    @staticmethod
    def together(problem: DiscreteProblem, speeds: FloatArray, running_time: float) -> DrivenPlan:
        """The run of all below given speeds, (q, n + 1) [m/s], of each by itself."""
        return DrivenPlan.along(*run_together(problem, speeds), running_time)

    @staticmethod
    def of_rows(every: Callable[[], DrivenPlan], rows: Sequence[int]) -> DrivenPlan:
        """The same for some of the configurations."""
        whole = every()
        return DrivenPlan(whole.problem.select(rows), whole.plan.select(rows), whole.late)

    def merit(self, lateness_price: float) -> float:
        """Energy, and what lateness is charged [J/kg]."""
        if not np.isfinite(self.late):
            return np.inf
        return energy_of(self.problem, self.plan) + lateness_price * max(self.late, 0.0)


_SPARE_Z = 1e-9
"""Rounding of ``z`` [m²/s²]."""


def descend(
    problem: DiscreteProblem,
    start: DrivenPlan,
    running_time: float,
    tolerances: Tolerances = EXACT,
    *,
    iterations: int = 40,
) -> Solution | None:
    """Minimise the worst-case energy, from one plan that is driven in time to the next.

    Parameters
    ----------
    problem : DiscreteProblem
        Not tapered.
    start : DrivenPlan
    running_time : float [s]
    tolerances : Tolerances
    iterations : int
        Most quadratic programs to solve.

    Returns
    -------
    Solution or None
        None if the start is not in time.
    """
    if start.late > tolerances.lateness:
        return None
    centre, found = start, unpriced(start)
    power = float(problem.step @ start.plan.traction) / running_time
    price = np.full(problem.shape, power)
    lateness_price = LATENESS_PRICE * max(power, 1.0)
    best, value = start, start.merit(lateness_price)
    radius, statuses = _FIRST_RADIUS, list[str]()
    while len(statuses) < iterations and radius > _LEAST_RADIUS:
        program = QPSubproblem(centre.problem, centre.plan, price)
        try:
            solution = program.solve(running_time, radius, lateness_price, tolerances.smoothing)
        except NoSolutionError as failure:
            statuses.append(str(failure))
            radius *= _FAILED
            continue
        except OutOfTimeError:
            if best is start:
                raise
            break
        statuses.extend(solution.statuses)
        # Traction tapered anew may ask for more power than there is, and the brake then stops it.
        trial = min(
            DrivenPlan.of(problem, solution.plan, running_time),
            DrivenPlan.along(centre.problem, solution.plan, running_time),
            key=lambda each: each.merit(lateness_price),
        )
        gained = value - trial.merit(lateness_price)
        if not gained > 0.0:
            radius *= _FAILED
            continue
        centre, value = trial, value - gained
        found, price = solution, solution.multipliers.cell_prices(problem)
        best = centre if centre.late <= tolerances.lateness else best
        radius = min(_WIDER * radius, 1.0)
        if gained <= tolerances.energy * max(value, NEGLIGIBLE_ENERGY):
            break
    return replace(
        found,
        plan=best.plan,
        taper=best.problem.taper,
        energy=energy_of(best.problem, best.plan),
        lateness=0.0,
        statuses=tuple(statuses),
        converged=True,
    )


def unpriced(driven: DrivenPlan) -> Solution:
    """A driven plan as a solution without multipliers."""
    problem, points = driven.problem, driven.problem.passed.size
    q, n = problem.shape
    return Solution(
        plan=driven.plan,
        taper=problem.taper,
        energy=energy_of(problem, driven.plan),
        multipliers=Multipliers(
            pull=np.zeros((q, n)),
            time=np.zeros(q),
            passing=np.zeros((q, points)),
            opening=np.zeros((q, points)),
            power=np.zeros((q, n)),
            dynamic_power=np.zeros((q, n)),
            share=problem.weights,
        ),
        switching=np.zeros(n),
        lateness=0.0,
        converged=True,
    )

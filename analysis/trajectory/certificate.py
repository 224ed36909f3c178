"""How good a trajectory is: the best lower bound at hand, and the certificate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from analysis.trajectory.active_set import priced_rows
from analysis.trajectory.audit import Audit
from analysis.trajectory.bound import lower_bound, spare_times
from analysis.trajectory.continuous import ContinuousBound, continuous_bound
from analysis.trajectory.convex import (
    NoSolutionError,
    OutOfTimeError,
    Relaxation,
    time_left,
    time_limit,
)
from analysis.trajectory.discretisation import DiscreteProblem, Plan, most_traction
from analysis.trajectory.envelope import Envelope
from analysis.trajectory.guess import Answer
from analysis.trajectory.phases import agreement, phase_letters, phases_by_control
from analysis.trajectory.problem import TrajectoryProblem
from analysis.trajectory.representatives import multipliers_for_all, shares_of
from analysis.trajectory.sqp import NEGLIGIBLE_ENERGY, Solution, with_costates
from trainlog.arrays import FloatArray

_CONE_TOLERANCE = 1e-8
"""Of the cone solver's value, absolute [J/kg] and relative."""

_BOUND_TIME = 2.0
"""Time that a relaxation has at least [s], that an answer has its gap."""

_CLOSE = 0.1
"""Gap on cells, times their number, above which a better bound is looked for."""

OF_OPTIMUM = "multipliers"
"""Source of bounds that rest on the multipliers of the optimum itself."""

OF_SHORT = "multipliers of those short of time"
"""Source of bounds that rest on those of an optimum for some configurations."""

_CLOSE_TOTAL, _NEAR_TOTAL = 1e-4, 5e-4
"""Total gap up to which none is, and up to which none is by a cone relaxation."""


@dataclass(frozen=True, eq=False)
class LowerBounds:
    """Lower bounds of the energy of all trajectories.

    Attributes
    ----------
    cells : float [J/kg]
        Of those on the cells of a problem.
    continuous : float [J/kg]
        Of all, wherever their controls change; not above the other.
    excess : (n,) array [J/kg]
        What each cell adds to the difference between a plan and the latter.
    source : str
        Where the bound on the cells comes from.
    """

    cells: float
    continuous: float
    excess: FloatArray
    source: str

    def total_gap(self, energy: float) -> float:
        """By how much an energy [J/kg] is above that of any trajectory at most, relative."""
        return _relative_gap(energy, self.continuous)

    def gap(self, energy: float) -> float:
        """By how much an energy [J/kg] is above that of any trajectory on these cells, relative."""
        return _relative_gap(energy, self.cells)

    def by_cells(self, energy: float, tolerance: float, part: float = 0.5) -> bool:
        """Whether it is the cells that leave an energy more than a tolerance above the bound."""
        # Else it is what the relaxation leaves out, where the multipliers did not come close.
        cost = self.total_gap(energy) - _relative_gap(energy, self.cells)
        return self.source == OF_OPTIMUM or cost > part * tolerance


def _relative_gap(energy: float, bound: float) -> float:
    # Down a hill next to no energy may be needed: a part of it would mean nothing.
    return (energy - bound) / max(abs(bound), NEGLIGIBLE_ENERGY)


def best_bounds(answer: Answer, fastest: Envelope, running_time: float) -> LowerBounds:
    """Lower bounds of the energy, and how they were found.

    The multipliers of an optimum for the configurations alone to which time is worth something give
    them, for the bound on cells cannot hold the power of others; or those of the optimum for all
    that are active; or, if none of this comes close, the cone relaxation.
    """
    problem, solution = answer.problem, answer.solution
    part, rows = problem.select(answer.active), list(answer.active)
    speeds = fastest.at(problem.positions)
    expected = problem.run.objective == "expected"
    if expected and not set(np.flatnonzero(problem.weights).tolist()) <= set(answer.active):
        shares = shares_of(problem, answer.active, answer.alone)
        every = multipliers_for_all(problem, shares, solution.multipliers)
        spare, start = spare_times(problem, answer.plan), np.sqrt(2.0 * answer.plan.z)
        bound = lower_bound(problem, every, start, running_time, spare, speeds)
        whole = continuous_bound(problem, answer.plan, every, fastest, running_time, problem.run)
        return _together(bound, whole, "shared multipliers")
    priced, best = priced_rows(part, solution), None
    if len(priced) < len(rows):
        some = [answer.active[row] for row in priced]
        few = problem.select(some)
        alone = with_costates(few, solution.select(priced), running_time)
        bound = _bounded(few, alone, running_time, speeds[some])
        whole = _continuous(answer, alone, fastest, some, running_time)
        best = _together(bound, whole, OF_SHORT)
        if _close(best, solution.energy, problem, _CLOSE_TOTAL):
            return best
        solution = with_costates(part, solution, running_time)
    bound = _bounded(part, solution, running_time, speeds[rows])
    whole = _continuous(answer, solution, fastest, rows, running_time)
    best = _best_of(_together(bound, whole, OF_OPTIMUM), best)
    if _close(best, solution.energy, problem, _NEAR_TOTAL):
        return best
    # Those that are not short of time still limit the common traction and brake.
    try:
        with time_limit(max(time_left(), _BOUND_TIME)):
            relaxed = Relaxation(part, speeds[rows], speeds[rows]).least_energy(running_time)
    except (NoSolutionError, OutOfTimeError):
        return best
    spare = spare_times(part, answer.solution.plan)
    # The cone solver's value may be above the least by what it stops at.
    value = relaxed.bound - _CONE_TOLERANCE * (1.0 + abs(relaxed.bound))
    relaxation = value - float(relaxed.time_price @ spare)
    found = replace(answer.solution, multipliers=relaxed.multipliers)
    other = _continuous(answer, found, fastest, rows, running_time)
    return _best_of(_together(relaxation, other, f"cone relaxation: {relaxed.status}"), best)


def _best_of(latest: LowerBounds, before: LowerBounds | None) -> LowerBounds:
    """The higher of either bound, with what belongs to it."""
    if before is None:
        return latest
    first, second = sorted((latest, before), key=lambda each: each.continuous)
    source = max(latest, before, key=lambda each: each.cells).source
    return replace(second, cells=max(first.cells, second.cells), source=source)


def _together(cells: float, whole: ContinuousBound, source: str) -> LowerBounds:
    # What holds for all trajectories holds for those on the cells.
    return LowerBounds(max(cells, whole.value), whole.value, whole.excess, source)


def _close(bounds: LowerBounds, energy: float, problem: DiscreteProblem, total: float) -> bool:
    """Whether bounds come so close to an energy that no others are looked for."""
    on_cells = _relative_gap(energy, bounds.cells) <= _CLOSE / problem.shape[1]
    return on_cells or bounds.total_gap(energy) <= total


def _continuous(
    answer: Answer, solution: Solution, fastest: Envelope, rows: list[int], running_time: float
) -> ContinuousBound:
    """By a solution for some of the configurations."""
    part, run = answer.problem.select(rows), answer.problem.run
    own = replace(fastest, speeds=fastest.speeds[rows], elapsed=fastest.elapsed[rows])
    return continuous_bound(part, solution.plan, solution.multipliers, own, running_time, run)


def _bounded(
    problem: DiscreteProblem, solution: Solution, running_time: float, fastest: FloatArray
) -> float:
    speeds, spare = np.sqrt(2.0 * solution.plan.z), spare_times(problem, solution.plan)
    return lower_bound(problem, solution.multipliers, speeds, running_time, spare, fastest)


GAP_TOLERANCE = 2e-3
"""Largest total gap between energy and lower bound that is called certified."""


def energy_of_audit(answer: Answer, rollout: Audit) -> float:
    """What a run minimises, as its audit found it [J]."""
    run = answer.problem.run
    energies = rollout.line_energy if run.at_line else rollout.wheel_energy
    if run.objective == "expected":
        return float(answer.problem.weights @ energies)
    return float(energies.max())


def certificate_of(
    answer: Answer,
    bounds: LowerBounds,
    fastest: Envelope,
    rollout: Audit,
    running_time: float,
    coarser: tuple[int, float] | None,
) -> dict[str, Any]:
    """What was found, how, and how good it is; plain numbers, energies in joules.

    `coarser` are the cells of the grid that was searched before, and the energy there [J/kg].
    """
    problem, run, solution = answer.problem, answer.problem.run, answer.solution
    energy = energy_of_audit(answer, rollout)
    per_mass = energy / problem.reference
    gap, total = _relative_gap(per_mass, bounds.cells), bounds.total_gap(per_mass)
    names = [configuration.name for configuration in run.configurations]
    return {
        "energy": energy,
        "lower_bound": bounds.cells * problem.reference,
        "gap": gap,
        "continuous_bound": bounds.continuous * problem.reference,
        "cells_cost": total - gap,
        "total_gap": total,
        "certified": total <= GAP_TOLERANCE,
        "bound_holds_for": "the problem cut into these cells" + _left_out(answer),
        "wheel_energy": rollout.wheel_energy.tolist(),
        "line_energy": rollout.line_energy.tolist(),
        "hardest": names[int(np.argmax(rollout.arrival))],
        "least_time": fastest.times.tolist(),
        "reserve": running_time / float(fastest.times.max()) - 1.0,
        "audit": {
            "passed": True,
            "substeps": rollout.substeps,
            "arrival": rollout.arrival.tolist(),
            "lateness": float(rollout.arrival.max()) - running_time,
            "shortfall": float(rollout.shortfall.max()),
            "end_speed": float(rollout.end_speed.max()),
            "overspeed": float(rollout.overspeed.max()),
            "power": float(rollout.power.max()),
            "effort": float(rollout.effort.max()),
            "braking": float(rollout.braking.max()),
            "adhesion": float(rollout.adhesion.max()),
            **_passings(run, rollout),
        },
        "solver": {
            "statuses": list(answer.statuses),
            "bound": bounds.source,
            "iterations": len(answer.statuses),
            "turns": answer.turns,
        },
        "active": [names[row] for row in answer.active],
        "time_price": {
            names[row]: float(price) * problem.reference
            for row, price in zip(answer.active, solution.multipliers.time, strict=True)
        },
        "departure_price": float(solution.departure_price.sum()) * problem.reference,
        "grid": {
            "cells": problem.shape[1],
            "shortest": float(problem.step.min()),
            "longest": float(problem.step.max()),
        },
        "convergence": _convergence(energy, coarser, problem.reference),
        "costates": {
            names[row]: costate.tolist()
            for row, costate in zip(
                answer.active, solution.multipliers.pull / problem.step, strict=True
            )
        },
        "switching": solution.switching.tolist(),
        "switching_levels": _levels(run),
        "agreement": _agreement(problem, answer),
        "phases": _phases(problem, answer),
    }


def _left_out(answer: Answer) -> str:
    """What the bound cannot hold: time that the train has to lose, where a second costs nothing."""
    multipliers = answer.solution.multipliers
    left = multipliers.opening - multipliers.convex().opening
    if left.max(initial=0.0) <= 1e-3 * float(answer.solution.time_price.max()):
        return ""
    return ", early passing allowed where the train has to lose time"


def _convergence(
    energy: float, coarser: tuple[int, float] | None, reference: float
) -> dict[str, float] | None:
    """The energy on the coarser grid, and what the finer one changed; None where there was none."""
    if coarser is None:
        return None
    before = coarser[1] * reference
    change = (energy - before) / max(before, NEGLIGIBLE_ENERGY * reference)
    return {"cells": coarser[0], "energy": before, "change": change}


def _levels(run: TrajectoryProblem) -> dict[str, float]:
    """Above the one traction pays, below the other the brake."""
    if not run.at_line:
        return {"traction": 1.0, "braking": 0.0}
    train = run.train
    return {"traction": 1.0 / train.efficiency_traction, "braking": train.efficiency_regeneration}


def _agreement(problem: DiscreteProblem, answer: Answer) -> dict[str, float]:
    """Share of the cells in which the controls are those that the switching function asks for.

    The brake of each active configuration by its own part of the function; where the dynamic brake
    feeds back it pays at two levels, and is left out.
    """
    run, solution, part = problem.run, answer.solution, problem.select(answer.active)
    pull, brake = _most(part, solution.plan)
    level = _levels(run)["traction"]
    found = {"traction": agreement(solution.plan.traction, pull, solution.switching - level)}
    if not run.at_line:
        own = -solution.multipliers.pull / part.step
        braking = solution.plan.braking
        if problem.common:
            own, braking, brake = own.sum(axis=0), braking[0], brake[0]
        found["braking"] = agreement(braking, brake, own)
    return found


def _passings(run: TrajectoryProblem, rollout: Audit) -> dict[str, float]:
    """The worst that the audit found at the passing points, where there are any."""
    if not run.windows:
        return {}
    worst = {"early": rollout.early, "tardy": rollout.tardy, "slow": rollout.slow}
    return {name: float(values.max()) for name, values in worst.items() if values.max() > -np.inf}


def _most(problem: DiscreteProblem, plan: Plan) -> tuple[FloatArray, FloatArray]:
    """The most that common traction, (n,), and each brake, (q, n), can do at the plan's speeds."""
    pull, by_speed = most_traction(problem, plan.z), problem.dynamic_by_speed(plan.z, 1e-9)
    brake = np.minimum(problem.braking, problem.friction + np.minimum(problem.dynamic, by_speed))
    if problem.common:
        brake = np.broadcast_to(brake.min(axis=0), brake.shape)
    return pull, brake


def _phases(problem: DiscreteProblem, answer: Answer) -> list[str]:
    """The phase of each cell for each configuration, one letter a cell."""
    plan = answer.plan
    pull, brake = _most(problem, plan)
    return [
        phase_letters(phases_by_control(plan.traction, plan.braking[row], pull, brake[row]))
        for row in range(problem.shape[0])
    ]

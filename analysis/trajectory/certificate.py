"""The certificate of a trajectory: what was found, how, and how good it is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.active_set import Answer
from analysis.trajectory.audit import Audit
from analysis.trajectory.envelope import Envelope
from analysis.trajectory.minimax import NEXT_TO_NOTHING
from analysis.trajectory.pace import paced_run
from analysis.trajectory.phases import agreement, phases_by_control, spelled
from analysis.trajectory.problem import Plan, Problem, most_traction
from analysis.trajectory.referee import second_opinion
from analysis.trajectory.run import Run

FloatArray = NDArray[np.float64]

GAP_TOLERANCE = 2e-3
"""Largest gap between energy and lower bound that is called certified."""


def certificate_of(
    problem: Problem,
    answer: Answer,
    lower: tuple[float, str],
    fastest: Envelope,
    rollout: Audit,
    running_time: float,
    coarser: tuple[int, float] | None,
) -> dict[str, Any]:
    """What was found, how, and how good it is; plain numbers, energies in joules.

    `coarser` are the cells of the grid that was searched before, and the energy there [J/kg].
    """
    run, solution = problem.run, answer.solution
    energies = rollout.line_energy if run.at_line else rollout.wheel_energy
    energy, bound = float(energies.max()), lower[0] * problem.reference
    if run.objective == "expected":
        energy = float(problem.weights @ energies)
    # Down a hill there may be next to nothing to spend, and no part of it to tell.
    gap = (energy - bound) / max(abs(bound), NEXT_TO_NOTHING * problem.reference)
    names = [configuration.name for configuration in run.configurations]
    return {
        "energy": energy,
        "lower_bound": bound,
        "gap": gap,
        "certified": gap <= GAP_TOLERANCE,
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
            "bound": lower[1],
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
    change = (energy - before) / max(before, NEXT_TO_NOTHING * reference)
    return {"cells": coarser[0], "energy": before, "change": change}


def _levels(run: Run) -> dict[str, float]:
    """Above the one traction pays, below the other the brake."""
    if not run.at_line:
        return {"traction": 1.0, "braking": 0.0}
    train = run.train
    return {"traction": 1.0 / train.efficiency_traction, "braking": train.efficiency_regeneration}


def _agreement(problem: Problem, answer: Answer) -> dict[str, float]:
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


def _passings(run: Run, rollout: Audit) -> dict[str, float]:
    """The worst that the audit found at the passing points, where there are any."""
    if not run.windows:
        return {}
    worst = {"early": rollout.early, "tardy": rollout.tardy, "slow": rollout.slow}
    return {name: float(values.max()) for name, values in worst.items() if values.max() > -np.inf}


def refereed(problem: Problem, answer: Answer, running_time: float) -> dict[str, Any]:
    """What IPOPT makes of the active configurations, beginning from a paced run."""
    part = problem.select(answer.active)
    opinion = second_opinion(part, paced_run(part, running_time), running_time)
    return {
        "name": "IPOPT",
        "energy": opinion.energy * problem.reference,
        "difference": answer.solution.energy / opinion.energy - 1.0,
        "status": opinion.status,
        "iterations": opinion.iterations,
    }


def _most(problem: Problem, plan: Plan) -> tuple[FloatArray, FloatArray]:
    """The most that common traction, (n,), and each brake, (q, n), can do at the plan's speeds."""
    fastest = np.sqrt(2.0 * (np.maximum(plan.z[:, :-1], plan.z[:, 1:]) + problem.bulge + 1e-9))
    pull = most_traction(problem, plan.z)
    by_power = problem.dynamic_power / fastest
    brake = np.minimum(problem.braking, problem.friction + np.minimum(problem.dynamic, by_power))
    if problem.common:
        brake = np.broadcast_to(brake.min(axis=0), brake.shape)
    return pull, brake


def _phases(problem: Problem, answer: Answer) -> list[str]:
    """The phase of each cell for each configuration, one letter a cell."""
    plan = answer.plan
    pull, brake = _most(problem, plan)
    return [
        spelled(phases_by_control(plan.traction, plan.braking[row], pull, brake[row]))
        for row in range(problem.shape[0])
    ]

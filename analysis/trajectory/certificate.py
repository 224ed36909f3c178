"""How good a trajectory is: the lower bound, and the certificate."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from analysis.trajectory.active_set import Answer
from analysis.trajectory.audit import Audit
from analysis.trajectory.bound import CLOSE, ContinuousBound, continuous_bound
from analysis.trajectory.convex import (
    Multipliers,
    NoSolutionError,
    OutOfTimeError,
    Relaxation,
    relaxation_seconds,
    time_left,
    time_limit,
)
from analysis.trajectory.discretisation import DiscreteProblem, Plan, most_efforts
from analysis.trajectory.envelope import Envelope, Floor, closer, floor_of
from analysis.trajectory.instructions import agreement, phase_letters, phases_by_control
from analysis.trajectory.problem import TrajectoryProblem
from analysis.trajectory.sqp import NEGLIGIBLE_ENERGY

_BOUND_TIME = 2.0
"""Time that a relaxation has at least [s], that an answer has its gap."""


def gap_of(energy: float, bound: float) -> float:
    """By how much an energy is above a lower bound at most, relative; both in J/kg."""
    # Down a hill next to no energy may be needed: a part of it would mean nothing.
    return (energy - bound) / max(abs(bound), NEGLIGIBLE_ENERGY)


def best_bound(
    answer: Answer, fastest: Envelope, running_time: float, seconds: float = np.inf
) -> ContinuousBound:
    """Lower bound of the energy of all trajectories, by what multipliers give the highest.

    Those of the optimum for the configurations that are active; where it does not come close, those
    of the cone relaxation, if it is likely to end within so many seconds.
    """
    problem, solution, rows = answer.problem, answer.solution, list(answer.active)
    part, speeds = problem.select(rows), fastest.at(problem.positions)[rows]
    counted = problem.weights > 0.0
    counted[rows] = False
    stand_in = problem.run.objective == "expected" and bool(counted.any())
    bounded = range(problem.shape[0]) if stand_in else rows
    own = closer(problem.run, fastest, tuple(bounded))

    def bound(
        multipliers: Multipliers,
        plan: Plan = solution.plan,
        floor: Floor | None = None,
        *,
        jointly: bool = False,
    ) -> ContinuousBound:
        of, driven = part, plan
        if stand_in:
            of, driven, floor = problem, answer.plan, None
            multipliers = _of_all(problem, rows, multipliers)
        return continuous_bound(
            of, driven, multipliers, own, running_time, problem.run, floor, jointly=jointly
        )

    found = bound(solution.multipliers)
    if gap_of(solution.energy, found.value) <= CLOSE:
        return found
    floor = floor_of(problem.run, fastest, answer.active, running_time)
    found = bound(solution.multipliers, floor=floor, jointly=True)
    if gap_of(solution.energy, found.value) <= CLOSE or not is_relaxed_within(answer, seconds):
        return found
    try:
        with time_limit(max(time_left(), _BOUND_TIME)):
            # Alone none is slow where it is short of power: there the floor only adds kinks.
            slowest = floor.at(problem.positions) if len(rows) > 1 else None
            relaxed = Relaxation(part, speeds, slowest).least_energy(running_time)
    except (NoSolutionError, OutOfTimeError):
        return found
    # The costate between the cells is that of a plan: of this one, or of the relaxed one.
    plans = (solution.plan, relaxed.plan)
    others = [bound(relaxed.multipliers, plan, floor) for plan in plans]
    if part.shape[0] > 1:
        number = int(others[1].value > others[0].value)
        others[number] = bound(relaxed.multipliers, plans[number], floor, jointly=True)
    best = max(others, key=lambda each: each.value)
    best = replace(best, excess=others[0].excess, source=f"cone relaxation: {relaxed.status}")
    return max(found, best, key=lambda each: each.value)


def is_relaxed_within(answer: Answer, seconds: float) -> bool:
    """Whether the cone relaxation for what is active is likely to end within so many seconds."""
    return relaxation_seconds(answer.problem.select(list(answer.active))) <= seconds


def _of_all(problem: DiscreteProblem, rows: list[int], multipliers: Multipliers) -> Multipliers:
    """Those of all configurations: each has its share of those of the one that stood for it."""
    at = problem.nearest(rows)
    share = problem.weights / np.maximum(np.bincount(at, problem.weights)[at], 1e-300)
    found = {
        name: values[at] * share.reshape(-1, *(1,) * (values.ndim - 1))
        for name, values in vars(multipliers).items()
    }
    return Multipliers(**found)


GAP_TOLERANCE = 2e-3
"""Largest gap between energy and lower bound that is called certified."""

_FLOOR = 5e-3
"""Part of the kinetic energy at top speed within which an energy is certified, however little it
is itself: nobody plans below a hundredth of a kWh."""


_INEXACT, _BROKEN = 1e-4, "no trajectories: this one takes less"
"""Part of the bound by which its quadrature may be above a plan, and the scope of one that is
farther above."""


def tolerated(bound: float, fastest: Envelope) -> float:
    """By how much an energy may exceed its lower bound and be called certified; all in J/kg."""
    return max(GAP_TOLERANCE * abs(bound), _FLOOR * 0.5 * float(fastest.speeds.max()) ** 2)


def energy_of_audit(answer: Answer, rollout: Audit) -> float:
    """What a run minimises, as its audit found it [J]."""
    run = answer.problem.run
    energies = rollout.line_energy if run.at_line else rollout.wheel_energy
    if run.objective == "expected":
        return float(answer.problem.weights @ energies)
    return float(energies.max())


WORST = ("shortfall", "end_speed", "overspeed", "power", "effort", "braking", "adhesion")
"""What the audit states of each configuration, and the certificate of the worst."""


def certificate_of(
    answer: Answer,
    bound: ContinuousBound,
    fastest: Envelope,
    rollout: Audit,
    running_time: float,
) -> dict[str, Any]:
    """What was found, how, and how good it is; plain numbers, energies in joules."""
    problem, run, solution = answer.problem, answer.problem.run, answer.solution
    energy = energy_of_audit(answer, rollout)
    gap = gap_of(energy / problem.reference, bound.value)
    names = [configuration.name for configuration in run.configurations]
    enough = tolerated(bound.value, fastest)
    missing = energy / problem.reference - bound.value
    broken = missing < -_INEXACT * abs(bound.value)
    return {
        "energy": energy,
        "lower_bound": bound.value * problem.reference,
        "gap": gap,
        "tolerance": enough * problem.reference,
        "certified": bool(missing <= enough and not broken),
        "bound_holds_for": _BROKEN if broken else "all trajectories" + _left_out(answer),
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
            **{name: float(getattr(rollout, name).max()) for name in WORST},
            **_passings(run, rollout),
        },
        "solver": {
            "statuses": list(answer.statuses),
            "bound": bound.source,
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
    pull, brake = most_efforts(part, solution.plan)
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


def _phases(problem: DiscreteProblem, answer: Answer) -> list[str]:
    """The phase of each cell for each configuration, one letter a cell."""
    plan = answer.plan
    pull, brake = most_efforts(problem, plan)
    return [
        phase_letters(phases_by_control(plan.traction, plan.braking[row], pull, brake[row]))
        for row in range(problem.shape[0])
    ]

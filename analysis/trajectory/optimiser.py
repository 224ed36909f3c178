"""A robust trajectory with its certificate: the room's front door."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.active_set import (
    Answer,
    best_bound,
    finer_guess,
    first_guess,
    outstanding,
    search,
)
from analysis.trajectory.audit import SUBSTEPS, Audit, audit
from analysis.trajectory.envelope import Envelope, fastest_run
from analysis.trajectory.mesh import graded_mesh
from analysis.trajectory.pace import paced_run
from analysis.trajectory.phases import agreement, phases_by_control, spelled
from analysis.trajectory.problem import (
    Braking,
    Direction,
    Objective,
    Plan,
    Problem,
    Run,
    discretise,
)
from analysis.trajectory.referee import second_opinion
from trainlog.errors import InfeasibleError, InputError, TrainlogError
from trainlog.railway import Configuration, Line, TimingPoint, TrackConditionMap, Train, Trajectory
from trainlog.units import KMH

FloatArray = NDArray[np.float64]

FEWEST_CELLS, MOST_CELLS = 20, 20_000
"""Of the grid; far more than a line has metres to tell apart costs hours and gains nothing."""

SLACKEST = 5.0
"""Times the least time, beyond which a timetable is refused."""

SCOUTING_CELLS = 120
"""Of the coarse grid on which the active configurations are found."""

REFINEMENTS = 3
"""How often a grid whose answer does not pass the audit is made twice as fine."""

GAP_TOLERANCE = 2e-3
"""Largest gap between energy and lower bound that is called certified."""


def optimise(
    line: Line,
    train: Train,
    configurations: Sequence[Configuration],
    *,
    running_time: float | None = None,
    reserve: float = 0.07,
    start: float = 0.0,
    end: float | None = None,
    initial_speed: float = 0.0,
    final_speed: float = 0.0,
    braking: Braking = "recourse",
    objective: Objective = "wheel",
    condition_map: TrackConditionMap | None = None,
    layer: str = "wet",
    sigmas: float = 2.0,
    protected_length: float = 0.0,
    weights: Sequence[float] = (),
    windows: Sequence[TimingPoint] = (),
    direction: Direction = "forward",
    cells: int = 500,
    referee: bool = False,
) -> Trajectory:
    """Trajectory of least worst-case energy that every configuration can follow; paper 002.

    Parameters
    ----------
    line : Line
        In the direction of travel.
    train : Train
    configurations : sequence of Configuration
        The observed set.
    running_time : float, optional [s]
        What the timetable allows. Without it, the least time of the slowest configuration and
        `reserve` on top.
    reserve : float
        Part of the least time.
    start, end : float, optional [m]
        Section of the line; without them the whole line.
    initial_speed, final_speed : float [m/s]
    braking : {"recourse", "common"}
        Each configuration brakes for itself, or all brake alike as the paper has it.
    objective : {"wheel", "line", "expected"}
        Energy at the wheel rims without regeneration, as the paper has it; or energy from the
        line with the train's efficiencies and its dynamic brake, of the worst configuration or as
        expected with `weights`. All configurations then have a say: it takes as long as they are
        many.
    weights : sequence of float
        Of the configurations, for the expected energy; equal without them.
    condition_map : TrackConditionMap, optional
        Limits efforts to the adhesion that the map cautiously promises where it was observed.
    layer : str
        Rail condition to read from the map.
    sigmas : float
        Standard deviations taken off the map's estimate.
    protected_length : float [m]
        Length of train that a speed limit protects: 0 for its front, ``train.length`` for all.
    windows : sequence of TimingPoint
        When and how fast it may pass points on the way; times count from the start of the run.
        Earlier than asked is not convex: a bound leaves it out, and is lower where it decides.
    direction : {"forward", "reverse"}
        Of travel against the chainage of the line's file. `line` is given in the direction of
        travel all the same (`Line.reversed`), and so is every position here.
    cells : int
        Cells of the grid, about; a line with many breakpoints gets more.
    referee : bool
        Have IPOPT solve the same problem too, and put what it found into the certificate.

    Returns
    -------
    Trajectory
        With a certificate: the audit of every configuration, the lower bound and the gap.

    Raises
    ------
    InfeasibleError
        If no trajectory keeps the timetable or the speeds asked for; with the figures.
    InputError
        If an argument makes no sense.
    TrainlogError
        If the result does not pass its own audit.

    Notes
    -----
    The lower bound holds for the problem cut into these cells. With common braking,
    configurations that differ by a few per cent in resistance cannot all stop at one place; the
    error tells the lowest end speed they can all reach.
    """
    _check_arguments(running_time, reserve, cells)
    run = Run(
        line, train, tuple(configurations), start, line.length if end is None else end,
        initial_speed, final_speed, braking, objective,
        condition_map, layer, sigmas, protected_length, tuple(windows),
        tuple(weights), direction,
    )  # fmt: skip
    fastest = fastest_run(run)
    slowest = int(np.argmax(fastest.times))
    least_time = float(fastest.times[slowest])
    if running_time is None:
        running_time = (1.0 + reserve) * least_time
    _check_time(run, fastest, running_time)

    problem, answer, rollout = _audited(run, fastest, running_time, cells)
    bound = best_bound(problem, answer, fastest.at(problem.positions), running_time)
    traction = answer.plan.traction * problem.reference
    brakes = answer.plan.braking * problem.reference
    certificate = _certificate(problem, answer, bound, fastest, rollout, running_time)
    if referee:
        certificate["referee"] = _refereed(problem, answer, running_time)
    speeds = rollout.speeds
    if final_speed == 0.0:
        speeds[:, -1] = 0.0  # the audit found them to stand there
    return Trajectory(
        line=line.name,
        train=train.name,
        positions=problem.positions,
        configurations=run.configurations,
        speeds=speeds,
        times=rollout.times,
        tractive_effort=traction,
        braking_effort=brakes,
        running_time=running_time,
        direction=direction,
        certificate=certificate,
        provenance={
            "method": "cone relaxation and sequential quadratic programs, paper 002",
            "settings": {
                "start": run.start,
                "end": run.end,
                "initial_speed": initial_speed,
                "final_speed": final_speed,
                "braking": braking,
                "objective": objective,
                "weights": list(run.weights),
                "adhesion": None if condition_map is None else {"layer": layer, "sigmas": sigmas},
                "protected_length": protected_length,
                "windows": [asdict(point) for point in run.windows],
                "cells": cells,
            },
        },
    )


def _audited(
    run: Run, fastest: Envelope, running_time: float, cells: int
) -> tuple[Problem, Answer, Audit]:
    """The problem on its grid, its answer, and the audit that the answer passed.

    A grid too coarse for the line shows in the audit; then it is made finer.
    """
    speeds = fastest.speeds[int(np.argmax(fastest.times))]
    sketch = graded_mesh(run.breakpoints, fastest.positions, speeds, SCOUTING_CELLS)
    found = None
    finer = [cells * 2**times for times in range(REFINEMENTS + 1)]
    for count in [each for each in finer if each <= MOST_CELLS]:
        positions = graded_mesh(run.breakpoints, fastest.positions, speeds, count)
        problem, envelope = discretise(run, positions), fastest.at(positions)
        if found is None and sketch.size < 0.6 * positions.size:
            found = _scouted(run, fastest, sketch, running_time)
        guess = first_guess(problem, envelope, running_time)
        if found is not None:
            guess = finer_guess(found, sketch, problem, range(problem.shape[0]))
        answer = search(problem, guess, envelope, running_time)
        traction = answer.plan.traction * problem.reference
        rollout = audit(run, positions, traction, answer.plan.braking * problem.reference)
        failures = rollout.failures(run, running_time)
        if not failures:
            return problem, answer, rollout
    raise TrainlogError(
        f"the trajectory does not pass its audit: {failures[0]}"
        + (f" and {len(failures) - 1} more" if len(failures) > 1 else ""),
        remedy="more cells, or more reserve",
    )


def _scouted(
    run: Run, fastest: Envelope, positions: FloatArray, running_time: float
) -> Answer | None:
    """The optimum on a coarse grid: first for the configurations that stand out, then for all.

    None if it has no optimum: that of the fine grid may have one, and else it explains itself.
    """
    problem, speeds = discretise(run, positions), fastest.at(positions)
    rows = outstanding(problem, fastest.times)
    some = problem.select(rows)
    try:
        guess = first_guess(some, speeds[rows], running_time)
        answer = search(some, guess, speeds[rows], running_time, coarse=True)
        if len(rows) == problem.shape[0]:
            return answer
        guess = finer_guess(answer, positions, problem, rows)
        return search(problem, guess, speeds, running_time, coarse=True)
    except InfeasibleError:
        return None


def _check_arguments(running_time: float | None, reserve: float, cells: int) -> None:
    """Refuse numbers that no timetable and no grid has."""
    if running_time is not None and not (running_time > 0.0 and np.isfinite(running_time)):
        raise InputError(
            f"trajectory: a running time of {running_time} s makes no sense",
            remedy="give the timetable's running time in seconds",
        )
    if not (reserve >= 0.0 and np.isfinite(reserve)):
        raise InputError(
            f"trajectory: a reserve of {reserve:.0%} makes no sense", remedy="give 0 or more"
        )
    if not FEWEST_CELLS <= cells <= MOST_CELLS:
        raise InputError(
            f"trajectory: {cells} cells make no sense",
            remedy=f"give {FEWEST_CELLS} to {MOST_CELLS}",
        )


def _check_time(run: Run, fastest: Envelope, running_time: float) -> None:
    """Refuse a timetable that the slowest configuration cannot keep by itself."""
    slowest = int(np.argmax(fastest.times))
    least = float(fastest.times[slowest])
    if running_time > SLACKEST * least:
        raise InputError(
            f"trajectory: a running time of {running_time:.1f} s is"
            f" {running_time / least:.3g} times the least, {least:.1f} s: a train that slow would"
            " stand on the way",
            remedy=f"give at most {SLACKEST * least:.0f} s, and let it wait at a station",
        )
    if running_time < least:
        late = [
            configuration.name
            for configuration, time in zip(run.configurations, fastest.times, strict=True)
            if time > running_time
        ]
        raise InfeasibleError(
            f"{running_time:.1f} s are not enough: configuration"
            f" '{run.configurations[slowest].name}' needs at least {least:.1f} s,"
            f" {least - running_time:.1f} s are missing"
            f" ({len(late)} of {len(run.configurations)} configurations would be late)",
            remedy=f"allow at least {np.ceil(least):.0f} s",
        )
    _check_windows(run, fastest, running_time)


def _check_windows(run: Run, fastest: Envelope, running_time: float) -> None:
    """Refuse windows that a configuration cannot keep even on its fastest run."""
    times = fastest.times_at([point.position for point in run.windows])
    for point, found in zip(run.windows, times.T, strict=True):
        slowest = int(np.argmax(found))
        name, place = run.configurations[slowest].name, f"km {point.position / 1e3:.3f}"
        if point.latest is not None and found[slowest] > point.latest:
            raise InfeasibleError(
                f"configuration '{name}' passes {place} after {found[slowest]:.1f} s at the"
                f" earliest, {found[slowest] - point.latest:.1f} s after its window closes",
                remedy=f"let it pass until {np.ceil(found[slowest]):.0f} s after departure",
            )
        left = running_time - (point.earliest or 0.0) - (fastest.times - found)
        slowest = int(np.argmin(left))
        if left[slowest] < 0.0:
            raise InfeasibleError(
                f"configuration '{run.configurations[slowest].name}' needs at least"
                f" {fastest.times[slowest] - found[slowest]:.1f} s from {place} to the end;"
                f" passed after {point.earliest or 0.0:.1f} s or later, {-left[slowest]:.1f} s are"
                " missing",
                remedy="let it pass earlier, or arrive later",
            )
        speeds = fastest.at(np.array([point.position]))[:, 0]
        slowest = int(np.argmin(speeds))
        if point.lowest_speed is not None and speeds[slowest] < point.lowest_speed:
            raise InfeasibleError(
                f"configuration '{run.configurations[slowest].name}' passes {place} at"
                f" {KMH * speeds[slowest]:.1f} km/h at most, {KMH * point.lowest_speed:.1f} km/h"
                " are asked for",
                remedy="lower what is asked for",
            )


def _certificate(
    problem: Problem,
    answer: Answer,
    lower: tuple[float, str],
    fastest: Envelope,
    rollout: Audit,
    running_time: float,
) -> dict[str, Any]:
    """What was found, how, and how good it is; plain numbers, energies in joules."""
    run, solution = problem.run, answer.solution
    energies = rollout.line_energy if run.at_line else rollout.wheel_energy
    energy, bound = float(energies.max()), lower[0] * problem.reference
    if run.objective == "expected":
        energy = float(problem.weights @ energies)
    gap = energy / bound - 1.0
    names = [configuration.name for configuration in run.configurations]
    return {
        "energy": energy,
        "lower_bound": bound,
        "gap": gap,
        "certified": gap <= GAP_TOLERANCE,
        "bound_holds_for": "the problem cut into these cells"
        + (", early passing allowed" if np.isfinite(problem.earliest).any() else ""),
        "wheel_energy": rollout.wheel_energy.tolist(),
        "line_energy": rollout.line_energy.tolist(),
        "hardest": names[int(np.argmax(rollout.arrival))],
        "least_time": fastest.times.tolist(),
        "reserve": running_time / float(fastest.times.max()) - 1.0,
        "audit": {
            "passed": True,
            "substeps": SUBSTEPS,
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
        "switching": solution.switching.tolist(),
        "switching_levels": _levels(run),
        "agreement": _agreement(problem, answer),
        "phases": _phases(problem, answer),
    }


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


def _refereed(problem: Problem, answer: Answer, running_time: float) -> dict[str, Any]:
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
    pull = np.minimum(problem.traction, (problem.power[:, None] / fastest).min(axis=0))
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

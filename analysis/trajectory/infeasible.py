"""Why a search found nothing: least time, or the lowest speed at the end that all can reach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.convex import NoSolutionError
from analysis.trajectory.feasibility import seconds
from analysis.trajectory.minimax import minimise
from analysis.trajectory.problem import Problem
from analysis.trajectory.relaxation import Relaxation
from trainlog.errors import InfeasibleError
from trainlog.units import KMH

FloatArray = NDArray[np.float64]

LATE = 5e-5
"""Lateness that counts [s]."""


def time_explained(
    problem: Problem, relaxation: Relaxation, running_time: float, word: str
) -> InfeasibleError:
    """Why the relaxation, and so the problem, has no solution."""
    names = names_of(problem)
    try:
        time = relaxation.least_time()
    except NoSolutionError:
        return InfeasibleError(f"no common run of {names}: the relaxation is {word}")
    if time <= running_time:
        return unsettled(problem, running_time, f"the relaxation is {word}")
    return InfeasibleError(
        f"under one common traction, in {problem.shape[1]} cells, at least {time:.1f} s are needed"
        f" by {names}; the timetable gives {running_time:.1f} s, {seconds(time - running_time)} are"
        " missing",
        remedy=f"allow at least {np.ceil(time):.0f} s",
    )


def still_late(problem: Problem, running_time: float, late: float) -> InfeasibleError:
    """Why nothing was found where the programs settle on a plan that is late by some seconds."""
    return InfeasibleError(
        f"{running_time:.2f} s are not enough for {names_of(problem)} under one common traction on"
        f" {problem.shape[1]} cells: {seconds(late)} are missing",
        remedy=f"allow {seconds(1.1 * late)} more, or more cells",
    )


def unsettled(problem: Problem, running_time: float, word: str) -> InfeasibleError:
    """Why nothing was found where the programs do not settle; that nothing exists is not proven."""
    return InfeasibleError(
        f"no trajectory of {names_of(problem)} was found for {running_time:.1f} s on"
        f" {problem.shape[1]} cells, and none was proven impossible: {word}",
        remedy="try more cells, or another running time",
    )


def brakes_explained(problem: Problem, speeds: FloatArray, running_time: float) -> InfeasibleError:
    """Why one braking effort does not bring them all to the speed asked for at the end."""
    names = names_of(problem)
    lowest = lowest_end_speed(problem, speeds, running_time)
    if lowest is None:
        return InfeasibleError(
            f"with one braking effort for all, {names} cannot keep {running_time:.1f} s whatever"
            " their speed at the end",
            remedy="allow more time, or let each configuration brake for itself (recourse)",
        )
    return InfeasibleError(
        f"with one braking effort for all, {names} cannot all end below {KMH * lowest:.1f} km/h in"
        f" {running_time:.1f} s; asked for are {KMH * problem.run.final_speed:.1f} km/h",
        remedy="let each configuration brake for itself (recourse), or end faster",
    )


def lowest_end_speed(problem: Problem, speeds: FloatArray, running_time: float) -> float | None:
    """The lowest speed [m/s] at the end that all configurations can keep, to 0.05 m/s.

    With common braking the one that runs most easily decides how hard all brake, and the others
    must not come to a stand before the end.

    Parameters
    ----------
    problem : Problem
        Its own speed at the end is taken to be out of reach.
    speeds : (q, n + 1) array [m/s]
        Of the fastest run of each configuration.
    running_time : float [s]

    Returns
    -------
    float or None
        None if the running time cannot be kept at any speed.
    """

    def reached(speed: float) -> bool:
        trial = replace(problem, final=0.5 * speed**2)
        try:
            relaxed = Relaxation(trial, speeds).least_energy(running_time)
            solution = minimise(trial, relaxed.plan, relaxed.time_price, running_time, rounds=12)
        except NoSolutionError:
            return False
        return solution.lateness <= LATE

    low, high = float(np.sqrt(2.0 * problem.final)), float(np.sqrt(2.0 * problem.ceiling[-1]))
    if not reached(high):
        return None
    while high - low > 0.05:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if reached(middle) else (middle, high)
    return high


def names_of(problem: Problem) -> str:
    """The configurations by their names, for a message."""
    names = [f"'{configuration.name}'" for configuration in problem.run.configurations]
    return f"configuration{'s' * (len(names) > 1)} {', '.join(names)}"

"""Why a timetable cannot be kept: by the fastest runs before any solver runs, or after a search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from analysis.trajectory.convex import NoSolutionError, OutOfTimeError, Relaxation, worked
from analysis.trajectory.discretisation import DiscreteProblem, discretise
from analysis.trajectory.envelope import Envelope
from analysis.trajectory.problem import TrajectoryProblem
from analysis.trajectory.sqp import minimise
from trainlog.arrays import FloatArray
from trainlog.errors import InfeasibleError, InputError
from trainlog.railway import Line, TimingPoint
from trainlog.railway.line import km_words
from trainlog.units import KMH, clock

MOST_TIME = 5.0
"""Times the least time, beyond which a timetable is refused."""

_AT_STATION = 50.0
"""From a station's position, within which a place is called by its name [m]."""

_NEARLY = 0.98
"""Part of a limit from which a run is held by it."""


def place_of(line: Line, position: float) -> str:
    """A place on the line as people call it: its km, and the station that is there."""
    name = next((s.name for s in line.stations if abs(s.position - position) <= _AT_STATION), "")
    return km_words(line, position) + (f" ({name})" if name else "")


def seconds(time: float) -> str:
    """What is missing of a time: tenths of a second, or its first significant figure."""
    return f"{time:.1f} s" if time >= 0.1 else f"{time:.1g} s"


def check_time(run: TrajectoryProblem, fastest: Envelope, running_time: float) -> None:
    """Refuse a timetable or windows that some configuration cannot keep by itself.

    Parameters
    ----------
    run : TrajectoryProblem
    fastest : Envelope
        Of every configuration.
    running_time : float [s]

    Raises
    ------
    InfeasibleError
        With the section, the configuration, what is missing and what holds it back.
    InputError
        If so much time is given that the train would stand on the way.
    """
    slowest = int(np.argmax(fastest.times))
    least = float(fastest.times[slowest])
    section = f"{place_of(run.line, run.start)} to {place_of(run.line, run.end)}"
    if running_time > MOST_TIME * least:
        raise InputError(
            f"trajectory: a running time of {running_time:.1f} s is"
            f" {running_time / least:.3g} times the least, {least:.1f} s ({clock(least)}) from"
            f" {section}: a train that slow would stand on the way",
            remedy=f"give at most {MOST_TIME * least:.0f} s, and let it wait at a station",
        )
    if running_time < least:
        late = np.flatnonzero(fastest.times > running_time).size
        raise InfeasibleError(
            f"{running_time:.1f} s ({clock(running_time)}) are not enough from {section}:"
            f" configuration '{run.configurations[slowest].name}' needs at least {least:.1f} s"
            f" ({clock(least)}), {seconds(least - running_time)} are missing ({late} of"
            f" {len(run.configurations)} configurations would be late)"
            f"; its fastest run is {limiting_factors(run, fastest, slowest)}",
            remedy=f"allow at least {np.ceil(least):.0f} s",
        )
    _check_times(run, fastest, running_time)
    check_speeds(run, fastest)


def limiting_factors(run: TrajectoryProblem, fastest: Envelope, row: int) -> str:
    """What holds a configuration's fastest run, and for how much of its time.

    Parameters
    ----------
    run : TrajectoryProblem
    fastest : Envelope
    row : int
        Configuration.

    Returns
    -------
    str
        Such as "62 % of the time at the limits or the train's own top speed, 30 % at full power,
        8 % braking".
    """
    alone = replace(run, configurations=run.configurations[row : row + 1], weights=())
    problem = discretise(alone, fastest.positions)
    v = fastest.speeds[row]
    z, mean = 0.5 * v**2, 0.5 * (v[:-1] + v[1:])
    times = problem.step / np.maximum(mean, 1e-9)
    drag = problem.mean_drag0[0] + problem.drag1[0] * mean + problem.drag2[0] * mean**2
    effort = np.diff(z) / problem.step + drag
    at_limit = z >= _NEARLY**2 * problem.ceiling
    limited = at_limit[:-1] & at_limit[1:]
    adhesive = np.isfinite(run.adhesion(fastest.positions))
    adhesive &= problem.traction < _NEARLY * _without_map(alone, fastest.positions)
    full = effort >= _NEARLY * problem.traction
    held = {
        "at the limits or the train's own top speed": limited,
        "braking": effort < 0.0,
        "at the adhesion of the map": full & adhesive,
        "at full tractive effort": full,
        "at full power": np.ones(times.size, dtype=bool),
    }
    left, found = np.ones(times.size, dtype=bool), []
    for words, cells in held.items():
        share = float(times[cells & left].sum() / times.sum())
        left &= ~cells
        found.append((share, words))
    shares = sorted((each for each in found if each[0] >= 0.005), reverse=True)
    spent = [f"{100.0 * share:.0f} % {words}" for share, words in shares]
    return ", ".join([spent[0].replace("%", "% of the time", 1), *spent[1:]])


def _without_map(run: TrajectoryProblem, positions: FloatArray) -> FloatArray:
    """The largest tractive effort if the rail were good, (n,) [m/s²]."""
    return discretise(replace(run, condition_map=None), positions).traction


def _check_times(run: TrajectoryProblem, fastest: Envelope, running_time: float) -> None:
    """Refuse windows of time that a configuration cannot keep even on its fastest run.

    Between any two of them, departure and arrival included: passed at the earliest at the first,
    at the latest at the other.
    """
    points = (
        TimingPoint(run.start, earliest=0.0),
        *run.windows,
        TimingPoint(run.end, latest=running_time),
    )
    times = fastest.times_at([point.position for point in points])
    for first, last in combinations(range(len(points)), 2):
        opens, closes = points[first].earliest or 0.0, points[last].latest
        if closes is None:
            continue
        spent = times[:, last] - times[:, first]
        slowest = int(np.argmax(spent))
        missing = opens + float(spent[slowest]) - closes
        if missing > 0.0:
            raise InfeasibleError(
                _windows_explained(
                    run, points, (first, last), slowest, float(spent[slowest]), missing
                ),
                remedy="open the windows longer, or allow more time",
            )


def _windows_explained(
    run: TrajectoryProblem,
    points: Sequence[TimingPoint],
    pair: tuple[int, int],
    row: int,
    spent: float,
    missing: float,
) -> str:
    """Why two times cannot both be kept."""
    first, last = (points[number] for number in pair)
    name, there = run.configurations[row].name, place_of(run.line, last.position)
    if pair[0] == 0:
        return (
            f"configuration '{name}' passes {there} after {spent:.1f} s at the earliest,"
            f" {seconds(missing)} after its window closes ({clock(spent - missing)})"
        )
    end = "the end" if pair[1] == len(points) - 1 else there
    return (
        f"configuration '{name}' needs at least {spent:.1f} s from"
        f" {place_of(run.line, first.position)} to {end} ({clock(spent)}); passed after"
        f" {first.earliest or 0.0:.1f} s or later, {seconds(missing)} are missing"
    )


def check_speeds(run: TrajectoryProblem, fastest: Envelope) -> None:
    """Refuse windows of speed above what a configuration reaches there."""
    for point in run.windows:
        if point.lowest_speed is None:
            continue
        speeds = fastest.at(np.array([point.position]))[:, 0]
        slowest = int(np.argmin(speeds))
        if speeds[slowest] >= point.lowest_speed:
            continue
        sides = np.nextafter(point.position, (-np.inf, np.inf))
        permitted = float(run.permitted_speed(sides).min())
        why = "what the train and the line allow before and after it"
        if speeds[slowest] >= 0.999 * permitted:
            why = f"the {KMH * permitted:.0f} km/h permitted there"
        raise InfeasibleError(
            f"configuration '{run.configurations[slowest].name}' passes"
            f" {place_of(run.line, point.position)} at {KMH * speeds[slowest]:.1f} km/h at most,"
            f" {KMH * point.lowest_speed:.1f} km/h are required; the limit is {why}",
            remedy="lower the required speed",
        )


LATE = 5e-5
"""Lateness that counts [s]."""

_FASTER = 0.1
"""By which the relaxation ends faster than is asked where that is a proof [m/s]."""

_SOUGHT = 4.0
"""Processor time after which no lower speed at the end is looked for [s]."""


class UnprovenError(InfeasibleError):
    """No trajectory was found, and none was proven impossible.

    Every other refusal is a proof: by the fastest runs, or by the relaxation on the plan's cells.
    """


def time_explained(
    problem: DiscreteProblem, relaxation: Relaxation, running_time: float, status: str
) -> InfeasibleError:
    """Why the relaxation, and so the problem, has no solution."""
    names = names_of(problem)
    time, other = _relaxed_time(relaxation)
    if other == "infeasible":
        return InfeasibleError(
            f"no common run of {names}: the relaxation is {status}",
            remedy="allow more time, or plan for fewer configurations",
        )
    if other:
        return unsettled(problem, running_time, f"the relaxation is {other}")
    if time <= running_time:
        return unsettled(problem, running_time, f"the relaxation is {status}")
    return InfeasibleError(
        f"under one common traction, in {problem.shape[1]} cells, at least {time:.1f} s are needed"
        f" by {names}; the timetable gives {running_time:.1f} s, {seconds(time - running_time)} are"
        " missing",
        remedy=f"allow at least {np.ceil(time):.0f} s",
    )


def still_late(problem: DiscreteProblem, running_time: float, late: float) -> UnprovenError:
    """Why nothing was found where the programs settle on a plan that is late by some seconds."""
    return UnprovenError(
        f"{running_time:.2f} s are not enough for {names_of(problem)} under one common traction on"
        f" {problem.shape[1]} cells: {seconds(late)} are missing",
        remedy=f"allow {seconds(1.1 * late)} more, or more cells",
    )


def unsettled(problem: DiscreteProblem, running_time: float, reason: str) -> UnprovenError:
    """Why nothing was found where the programs do not settle."""
    return UnprovenError(
        f"no trajectory of {names_of(problem)} was found for {running_time:.1f} s on"
        f" {problem.shape[1]} cells, and none was proven impossible: {reason}",
        remedy="try more cells, another running time, or a longer time limit",
    )


def brakes_explained(
    problem: DiscreteProblem, speeds: FloatArray, running_time: float
) -> InfeasibleError:
    """Why one braking effort does not bring them all to the required speed at the end.

    The relaxation holds every trajectory on these cells: where it has none, there is none.

    Parameters
    ----------
    problem : DiscreteProblem
    speeds : (q, n + 1) array [m/s]
        Of the fastest run of each configuration.
    running_time : float [s]
    """
    names = names_of(problem)
    least, status = _relaxed_time(Relaxation(problem, speeds, np.zeros_like(speeds)))
    if least <= running_time:
        return unsettled(problem, running_time, "one braking effort for all leaves little choice")
    fast = replace(problem, final=float(problem.ceiling[-1]))
    if status not in ("", "infeasible") and not _ends_too_fast(fast, speeds, running_time, problem):
        return unsettled(problem, running_time, f"the relaxation is {status}")
    free = Relaxation(fast, speeds)
    time, status = _relaxed_time(free)
    if status == "infeasible":
        return InfeasibleError(
            f"with one braking effort for all, {names} cannot run together, whatever the time and"
            " their speed at the end: where one has to brake another comes to a stand (a convex"
            " relaxation on these cells has no solution)",
            remedy="let each configuration brake for itself (recourse), or plan for configurations"
            " that differ less, or for a shorter section",
        )
    if running_time < time < np.inf:
        return InfeasibleError(
            f"with one braking effort for all, {names} need at least {time:.1f} s, whatever their"
            f" speed at the end; the timetable gives {running_time:.1f} s,"
            f" {seconds(time - running_time)} are missing",
            remedy=f"allow at least {np.ceil(time):.0f} s, or let each configuration brake for"
            " itself (recourse)",
        )
    words = f"with one braking effort for all, {names} cannot all end at"
    words += f" {KMH * problem.run.final_speed:.1f} km/h in {running_time:.1f} s"
    lowest = lowest_end_speed(problem, speeds, running_time)
    if lowest is not None:
        words += f"; the lowest speed found is {KMH * lowest:.1f} km/h"
    return InfeasibleError(
        words, remedy="let each configuration brake for itself (recourse), or end faster"
    )


def _ends_too_fast(
    free: DiscreteProblem, speeds: FloatArray, running_time: float, asked: DiscreteProblem
) -> bool:
    """Whether the relaxation, with its end `free`, never ends as slowly as is `asked`.

    Where it is asked for, all but without an inside, solvers do not settle.
    """
    try:
        least = Relaxation(free, speeds, np.zeros_like(speeds)).least_end(running_time)
    except NoSolutionError as status:
        return str(status) == "infeasible"
    except OutOfTimeError:
        return False
    return bool(np.sqrt(2.0 * max(least, 0.0)) > np.sqrt(2.0 * asked.final_ceiling) + _FASTER)


def _relaxed_time(relaxation: Relaxation) -> tuple[float, str]:
    """The least time [s] of a relaxation; or infinity, and the solver's status."""
    try:
        return relaxation.least_time(), ""
    except NoSolutionError as status:
        return np.inf, str(status)
    except OutOfTimeError:
        return np.inf, "stopped by the time limit"


def lowest_end_speed(
    problem: DiscreteProblem, speeds: FloatArray, running_time: float
) -> float | None:
    """The lowest speed [m/s] at the end that a plan was found for, to 0.05 m/s, in `_SOUGHT`.

    With common braking the one that runs most easily decides how hard all brake, and the others
    must not come to a stand before the end.

    Parameters
    ----------
    problem : DiscreteProblem
        Its own speed at the end is taken to be out of reach.
    speeds : (q, n + 1) array [m/s]
        Of the fastest run of each configuration.
    running_time : float [s]

    Returns
    -------
    float or None
        None if no speed was found that keeps the running time.
    """

    def reached(speed: float) -> bool:
        trial = replace(problem, final=0.5 * speed**2)
        try:
            relaxed = Relaxation(trial, speeds).least_energy(running_time)
            solution = minimise(
                trial, relaxed.plan, relaxed.time_price, running_time, iterations=12
            )
        except (NoSolutionError, OutOfTimeError):
            return False
        return solution.lateness <= LATE

    low, high = float(np.sqrt(2.0 * problem.final)), float(np.sqrt(2.0 * problem.ceiling[-1]))
    begun = worked()
    if not reached(high):
        return None
    while high - low > 0.05 and worked() - begun < _SOUGHT:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if reached(middle) else (middle, high)
    return high


def names_of(problem: DiscreteProblem) -> str:
    """The configurations by their names, for a message."""
    names = [f"'{configuration.name}'" for configuration in problem.run.configurations]
    return f"configuration{'s' * (len(names) > 1)} {', '.join(names)}"

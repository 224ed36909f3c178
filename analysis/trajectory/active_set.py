"""Active set over the configurations: optimise for a few, roll out all, add those that fail.

The optimum for some configurations that all the others can follow is the optimum for all, and the
lower bound for some is one for all. Few are ever active: the slowest, those short of power, and at
the line those that regain least. How the others drive the optimum leaves open; those that do not
decide leave the program, and are judged by the best that they can make of the common traction. In
the expected energy every configuration that has a weight counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import count

import numpy as np

from analysis.trajectory.convex import (
    NoSolutionError,
    OutOfTimeError,
    Relaxation,
    time_left,
    time_limit,
)
from analysis.trajectory.descent import DrivenPlan, descend, unpriced
from analysis.trajectory.discretisation import DiscreteProblem, Plan
from analysis.trajectory.feasibility import (
    LATE,
    brakes_explained,
    still_late,
    time_explained,
    unsettled,
)
from analysis.trajectory.guess import INACTIVE, Answer, Guess
from analysis.trajectory.rollout import (
    delays,
    energy_of,
    paced_run,
    realise,
    rollout,
    rollout_at,
    rollout_gently,
)
from analysis.trajectory.sqp import (
    EXACT,
    Solution,
    Tolerances,
    minimise,
)
from trainlog.arrays import FloatArray
from trainlog.progress import note

_COARSE = Tolerances(energy=1e-4, lateness=0.05, smoothing=0.0)
"""On the coarse grid, where a search only prepares another."""

_RESPONSE = Tolerances(energy=1e-4, lateness=0.02)
"""Where the brakes of configurations are sought that are not in the program."""

_VIOLATION = 5e-7
"""Excess over power, brake, speed or energy that makes a configuration active, relative."""

_HALVINGS = 6
"""Of the interval of cruising speeds, where no time is left."""

_MIXTURES = 16
"""Parts in which a run in time is mixed into a plan until all are in time."""

_COARSE_TIME, _SEARCH_TIME = 0.25, 0.8
"""Parts of the time that is left, for a search on the coarse grid and on the other."""


def search(
    problem: DiscreteProblem,
    guess: Guess,
    speeds: FloatArray,
    running_time: float,
    *,
    coarse: bool = False,
) -> Answer:
    """The robust optimum, or the best of what is found in the time left (`convex.time_limit`).

    Parameters
    ----------
    problem : DiscreteProblem
        With all configurations.
    guess : Guess
    speeds : (q, n + 1) array [m/s]
        Of the fastest run of each configuration.
    running_time : float [s]
    coarse : bool
        Whether it only prepares another search, with wider tolerances.

    Raises
    ------
    InfeasibleError
        If there is no such trajectory; with the figures.
    """
    with time_limit((_COARSE_TIME if coarse else _SEARCH_TIME) * time_left()):
        return _searched(problem, guess, speeds, running_time, coarse)


def _searched(
    problem: DiscreteProblem,
    guess: Guess,
    speeds: FloatArray,
    running_time: float,
    coarse: bool,
) -> Answer:
    rows, plan, price = list(guess.rows), guess.plan, guess.price
    statuses, tolerances = list(guess.statuses), _COARSE if coarse else EXACT
    again, even = set[int](), problem
    together = cache(partial(DrivenPlan.together, problem, speeds, running_time))
    for turns in count(1):
        grid = f"{problem.shape[1]} cells" + ", to begin with" * coarse
        note(f"round {turns}: {len(rows)} of {problem.shape[0]} decide, {grid}")
        part = even.select(rows)
        start = partial(DrivenPlan.of_rows, together, tuple(rows))
        try:
            solution = _optimum(part, plan, price, speeds[rows], running_time, tolerances, start)
        except OutOfTimeError as stop:
            last = stop.found or unpriced(DrivenPlan(part, plan, np.inf))
            words = (*statuses, *last.statuses, "time limit")
            stopped = Answer(even, plan, tuple(rows), last, turns, words)
            if coarse:
                return stopped
            answer = _stopped(stopped, together(), running_time)
            if answer is not None:
                return answer
            # Nothing is known that all can drive: it goes on until there is.
            with time_limit(None):
                return _searched(even, guess, speeds, running_time, coarse)
        statuses.extend(solution.statuses)
        kept = _deciding(part, solution, [row in again for row in rows])
        if len(kept) < len(rows):
            again |= {row for each, row in enumerate(rows) if each not in kept}
            rows, part, solution = (
                [rows[each] for each in kept],
                part.select(kept),
                solution.select(kept),
            )
        problem, part = even.tapered(solution.taper), part.tapered(solution.taper)
        everyone = _roll_out(problem, rows, part, solution.plan)
        late = delays(part, everyone.select(rows), running_time)[0]
        overdue = max(float(late.max()), 0.0) if coarse else 0.0
        everyone = _brake_gently(problem, rows, everyone, running_time + overdue)
        new = _violators(problem, everyone, running_time + overdue, rows) - set(rows)
        if not new:
            return Answer(problem, everyone, tuple(rows), solution, turns, tuple(statuses))
        price = np.append(solution.time_price, np.zeros(len(new)))
        plan = solution.plan.joined(everyone.select(sorted(new)))
        rows += sorted(new)
    raise AssertionError  # it adds at least one configuration in each turn


def _stopped(last: Answer, fast: DrivenPlan, running_time: float) -> Answer | None:
    """The best that all can drive of what a search has when its time is over.

    The traction of the last program, with as little of the run of all at one pace as brings all in
    time; or the fastest run. The bound is that of the last program's multipliers.

    Parameters
    ----------
    last : Answer
        Of an untapered problem; its plan need not be one for all.
    fast : DrivenPlan
        The fastest run of all together.
    running_time : float [s]

    Returns
    -------
    Answer or None
        None if there is none, as with common braking.
    """
    if last.problem.common:
        return None
    able = [(fast.problem, fast.plan)] * (fast.late <= LATE)
    tapered, planned = last.problem.tapered(last.solution.taper), last.solution.plan.traction
    paced = paced_run(tapered, running_time, _HALVINGS).traction
    for share in np.linspace(0.0, 1.0, _MIXTURES + 1).tolist():
        plan = rollout(tapered, (1.0 - share) * planned + share * paced, None)
        gentle = rollout_gently(tapered, plan, running_time)
        if np.max(_excesses(tapered, gentle, running_time)) <= _VIOLATION:
            able.append((tapered, gentle))
            break
    if not able:
        return None
    tapered, plan = min(able, key=lambda each: energy_of(*each))
    return replace(last, problem=tapered, plan=plan)


def _deciding(problem: DiscreteProblem, solution: Solution, settled: Sequence[bool]) -> list[int]:
    """Which of the program's configurations decide the optimum, and those `settled` to be in it.

    The others need not be in it: the optimum leaves open how they drive, and programs would not
    settle on it. How they drive best is found afterwards.
    """
    everyone = list(range(problem.shape[0]))
    if problem.common or problem.run.objective == "expected" or np.isfinite(problem.earliest).any():
        return everyone
    influence = np.abs(solution.multipliers.pull / problem.step).max(axis=1)
    active = influence > INACTIVE
    return [row for row in everyone if active[row] or settled[row]] if active.any() else everyone


def _brake_gently(
    problem: DiscreteProblem, rows: list[int], driven: Plan, running_time: float
) -> Plan:
    """The same traction; one that regains less than all in the program regains what it can.

    Only at the line, and where each brakes for itself. A configuration that brakes late regains
    less than it could, no reason to optimise for it. First by what a rollout finds, then, where the
    worst counts, by a program for the brakes of those that still seem to regain too little.
    """
    if not problem.run.at_line or problem.common:
        return driven
    expected = problem.run.objective == "expected"
    least = np.inf if expected else (driven.dynamic @ problem.step)[rows].min()
    for respond in (rollout_gently,) if expected else (rollout_gently, _best_responses):
        little = driven.dynamic @ problem.step < least
        little[rows] = False
        found = np.flatnonzero(little)
        if not found.size:
            break
        some, own = problem.select(found.tolist()), driven.select(found.tolist())
        gentle = respond(some, own, running_time)
        better = gentle.dynamic @ problem.step > own.dynamic @ problem.step
        better &= np.max(_excesses(some, gentle, running_time), axis=0) <= _VIOLATION
        driven.put(found[better], gentle, better)
    return driven


def _best_responses(problem: DiscreteProblem, driven: Plan, running_time: float) -> Plan:
    """How each regains most under the traction that all have, by one program for them all."""
    q = problem.shape[0]
    apart = replace(
        problem,
        run=replace(problem.run, objective="expected", weights=()),
        weights=np.full(q, 1.0 / q),
    )
    sooner = running_time - _RESPONSE.lateness
    try:
        best = minimise(apart, driven, np.zeros(q), sooner, _RESPONSE, iterations=5, given=True)
    except NoSolutionError:
        return driven
    except OutOfTimeError as stop:
        best = stop.found
    return driven if best is None else rollout_at(problem, driven, best.plan.z)


def _roll_out(
    problem: DiscreteProblem, rows: list[int], part: DiscreteProblem, optimum: Plan
) -> Plan:
    """The optimum for the active configurations, and how the others follow it."""
    common = optimum.braking[0] if problem.common else None
    everyone = rollout(problem, optimum.traction, common)
    everyone.put(rows, realise(part, optimum))
    return everyone


def _violators(
    problem: DiscreteProblem,
    plan: Plan,
    running_time: float,
    active: list[int],
) -> set[int]:
    """The worst of the others of each kind: late, short of power or brake, too fast, too costly."""
    excesses = _excesses(problem, plan, running_time)
    if problem.run.objective == "line" and active:
        spent = -(plan.dynamic @ problem.step)
        excesses.append((spent - spent[active].max()) / (plan.traction @ problem.step))
    found: set[int] = set()
    for excess in excesses:
        excess[active] = -np.inf
        found |= _worst(excess, _VIOLATION)
    return found


def _excesses(problem: DiscreteProblem, plan: Plan, running_time: float) -> list[FloatArray]:
    """By how much each is late, early, too slow, short of power or brake, or too fast; (q,)."""
    by_speed = problem.dynamic_by_speed(plan.z)
    brakes = np.minimum(problem.braking, problem.friction + np.minimum(problem.dynamic, by_speed))
    ceiling = np.append(problem.ceiling[:-1], problem.final_ceiling)
    late, soon = delays(problem, plan, running_time)
    return [
        late * (_VIOLATION / LATE),
        soon * (_VIOLATION / LATE),
        ((problem.floor - plan.z) / problem.ceiling.max()).max(axis=1),
        (plan.traction / problem.traction_by_power(plan.z)).max(axis=1) - 1.0,
        ((plan.braking - brakes) / problem.braking.max()).max(axis=1),
        ((plan.z - ceiling) / problem.ceiling.max()).max(axis=1),
    ]


def _worst(amounts: FloatArray, limit: float) -> set[int]:
    """The worst configuration beyond `limit`, and the next if it is nearly half as bad."""
    first, second = np.argsort(-amounts)[:2] if amounts.size > 1 else (0, 0)
    excess = amounts - limit
    if excess[first] <= 0.0:
        return set()
    return {int(first), int(second)} if excess[second] > 0.4 * excess[first] else {int(first)}


def _optimum(
    problem: DiscreteProblem,
    plan: Plan,
    price: FloatArray,
    speeds: FloatArray,
    running_time: float,
    tolerances: Tolerances,
    start: Callable[[], DrivenPlan],
) -> Solution:
    """The optimum for these configurations, from a plan, or else from their relaxation.

    Where both do not settle, what is found from a plan that is driven in time, `start`.

    Raises
    ------
    InfeasibleError
        With what is missing: time, or with common braking a higher speed at the end.
    """
    try:
        solution = minimise(problem, plan, price, running_time, tolerances, iterations=12)
        if solution.converged and solution.lateness <= max(LATE, tolerances.lateness):
            return solution
    except NoSolutionError:
        pass
    relaxation = Relaxation(problem, speeds)
    try:
        relaxed = relaxation.least_energy(running_time)
    except NoSolutionError as status:
        safe = descend(problem, start(), running_time, tolerances)
        if safe is not None:
            return safe
        if problem.common:
            raise brakes_explained(problem, speeds, running_time) from None
        raise time_explained(problem, relaxation, running_time, str(status)) from None
    try:
        solution = minimise(problem, relaxed.plan, relaxed.time_price, running_time, tolerances)
        if solution.lateness <= max(LATE, tolerances.lateness):
            return replace(solution, statuses=(relaxed.status, *solution.statuses))
        refusal = still_late(problem, running_time, solution.lateness)
    except NoSolutionError as failure:
        refusal = unsettled(problem, running_time, f"a convex step is {failure}")
    safe = descend(problem, start(), running_time, tolerances)
    if safe is not None:
        return replace(safe, statuses=(relaxed.status, *safe.statuses))
    if problem.common:
        raise brakes_explained(problem, speeds, running_time)
    raise refusal

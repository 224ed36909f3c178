"""Active set over the configurations: optimise for a few, let all ride along, add who cannot.

The optimum for some configurations that all the others can follow is the optimum for all, and the
lower bound for some is one for all. Few are ever active: the slowest, and those short of power.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count, product

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.amend import amended
from analysis.trajectory.bound import lower_bound
from analysis.trajectory.convex import NoSolutionError
from analysis.trajectory.infeasible import (
    LATE,
    brakes_explained,
    still_late,
    time_explained,
    unsettled,
)
from analysis.trajectory.linearised import Solution
from analysis.trajectory.minimax import EVENNESS, minimise, with_costates
from analysis.trajectory.pace import (
    capped_run,
    cell_times,
    delays,
    energy_of,
    realise,
    ride_along,
    ride_behind,
)
from analysis.trajectory.problem import Plan, Problem
from analysis.trajectory.relaxation import Relaxation
from analysis.trajectory.representatives import (
    kinds,
    multipliers_for_all,
    shared,
    short_of_time,
)

FloatArray = NDArray[np.float64]

_OVER = 5e-7
"""Excess over power, brake, speed or energy that makes a configuration active, relative."""

_WIDER = 50.0
"""Times the tolerances for others, in a search that only prepares another."""

_EXACT = (2e-6, 3e-5, EVENNESS)
"""Relative change of energy and lateness [s] that programs leave where nothing is amended, and the
price of evenness."""

_NEARLY = (3e-5, 0.05, EVENNESS)
"""The same where what they leave is amended."""

_ROUGHLY = (1e-4, 0.05, 0.0)
"""The same in a search that only prepares another."""

_DEARER = 1e-5
"""Relative loss for which nothing is amended."""

_IDLE = 1e-3
"""Switching function below which a configuration has no say, and leaves a prepared set."""

_SHORT = 0.05
"""Price of time over the highest, from which a configuration counts as short of it."""

_MANY = 40
"""Configurations above which only those that stand out are scouted with."""

_CONE_TOLERANCE = 1e-8
"""Of the cone solver's value, absolute [J/kg] and relative."""

_CLOSE = 0.1
"""Gap, times the number of cells, above which a better bound is looked for."""


@dataclass(frozen=True, eq=False)
class Guess:
    """Where a search begins: some configurations, their plan, and what a second is worth to each.

    Attributes
    ----------
    rows : tuple of int
    plan : Plan
        Of these configurations, as the price.
    price : (rows,) array [J/(kg s)]
    statuses : tuple of str
        The solver's words on the way here.
    alone : frozenset of int
        Rows that stand for themselves only in the expected energy.
    """

    rows: tuple[int, ...]
    plan: Plan
    price: FloatArray
    statuses: tuple[str, ...] = ()
    alone: frozenset[int] = frozenset()


@dataclass(frozen=True, eq=False)
class Answer:
    """The best plan for all configurations.

    Attributes
    ----------
    problem : Problem
        With the traction tapered as the plan has it.
    plan : Plan
    active : tuple of int
        Rows of the configurations that it was optimised for.
    solution : Solution
        Of the active configurations.
    turns : int
        How often configurations were added, and once more.
    statuses : tuple of str
        The solver's word on every program.
    alone : frozenset of int
        Rows that stand for themselves only in the expected energy.
    """

    problem: Problem
    plan: Plan
    active: tuple[int, ...]
    solution: Solution
    turns: int
    statuses: tuple[str, ...]
    alone: frozenset[int] = frozenset()


def outstanding(problem: Problem, least_times: FloatArray) -> list[int]:
    """Rows of the configurations that may decide: the extreme ones by any mix of properties.

    Whoever decides all the same shows when everybody rides along; here few are looked at.
    """
    q = problem.shape[0]
    speed = float(problem.step.sum()) / float(np.median(least_times))
    drag = np.column_stack(
        (
            problem.mean_drag0 @ problem.step / problem.step.sum(),
            problem.drag1 * speed + problem.drag2.mean(axis=1) * speed**2,
            problem.power,
            problem.gain,
            least_times,
        )
    )
    spread = np.ptp(drag, axis=0)
    unit = (drag - drag.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
    mixes = np.array(list(product((-1.0, 0.0, 1.0), repeat=unit.shape[1])))
    found = set(np.argmax(unit @ mixes.T, axis=0).tolist())
    some = q > _MANY and problem.run.objective != "expected"
    return sorted(found) if some else list(range(q))


def first_guess(problem: Problem, speeds: FloatArray, running_time: float) -> Guess:
    """The slowest and the dearest configuration, and their fastest run cut off.

    Where a window of time opens on the way, the fastest too; all, where all have a say.

    Parameters
    ----------
    speeds : (q, n + 1) array [m/s]
        Of the fastest run of each configuration.
    """
    times = (2.0 * problem.step / (speeds[:, :-1] + speeds[:, 1:])).sum(axis=1)
    rows = {int(np.argmax(times)), _dearest(problem, times)}
    if problem.common:
        rows |= {int(np.argmin(times)), int(np.argmin(problem.power))}
    if np.isfinite(problem.earliest).any():
        rows |= {int(np.argmin(times))}
    chosen = tuple(sorted(rows))
    if problem.run.objective == "expected":
        chosen = tuple(sorted(rows | set(kinds(problem, int(np.argmax(times))))))
    part = problem.select(chosen)
    return Guess(chosen, *capped_run(part, speeds[list(chosen)], running_time))


def finer_guess(answer: Answer, coarse: FloatArray, problem: Problem, rows: Sequence[int]) -> Guess:
    """What was found on one grid, on another one.

    Parameters
    ----------
    answer : Answer
        For the configurations `rows` of `problem`.
    coarse : (m + 1,) array [m]
        Its grid.
    problem : Problem
    """
    solution, positions = answer.solution, problem.positions
    influence = np.abs(solution.multipliers.pull / np.diff(coarse)).max(axis=1)
    active = np.flatnonzero(influence > _IDLE)
    if active.size == 0 or problem.common or problem.run.objective == "expected":
        active = np.arange(len(answer.active))
    plan = solution.plan
    cell = np.searchsorted(coarse, 0.5 * (positions[1:] + positions[:-1])) - 1
    cell = np.clip(cell, 0, coarse.size - 2)
    z = np.array([np.interp(positions, coarse, plan.z[row]) for row in active])
    guess = Plan(
        z, plan.traction[cell], *(e[active][:, cell] for e in (plan.braking, plan.dynamic))
    )
    chosen = tuple(rows[answer.active[row]] for row in active)
    alone = frozenset(rows[row] for row in answer.alone)
    return Guess(chosen, guess, solution.time_price[active], answer.statuses, alone)


def search(
    problem: Problem, guess: Guess, speeds: FloatArray, running_time: float, *, coarse: bool = False
) -> Answer:
    """The robust optimum.

    Parameters
    ----------
    problem : Problem
        With all configurations.
    guess : Guess
    speeds : (q, n + 1) array [m/s]
        Of the fastest run of each configuration.
    running_time : float [s]
    coarse : bool
        Whether it only prepares another search: its tolerances are wider.

    Raises
    ------
    InfeasibleError
        If there is no such trajectory; with the figures.
    """
    rows, plan, price = list(guess.rows), guess.plan, guess.price
    wider, statuses = (_WIDER if coarse else 1.0), list(guess.statuses)
    nearly = _ROUGHLY if coarse else _NEARLY
    # What may be amended afterwards the programs need not find to the last digit.
    exact = problem.common or bool(np.isfinite(problem.earliest).any())
    exact = exact or problem.run.objective == "expected"
    alone, even = guess.alone | {_slowest(problem, speeds)}, problem
    for turns in count(1):
        part, accuracy = _program(even, rows, alone), _EXACT if exact else nearly
        solution = _optimum(part, plan, price, speeds[rows], running_time, *accuracy)
        problem, part = even.tapered(solution.taper), part.tapered(solution.taper)
        statuses.extend(solution.statuses)
        everyone = _all_ride(problem, rows, part, solution.plan)
        own = delays(part, everyone.select(rows), running_time)[0]
        overdue = max(float(own.max()), 0.0)
        short = frozenset[int]()
        if problem.run.objective == "expected" and (
            len(rows) < problem.shape[0] or not problem.weights.all()
        ):
            everyone = _all_follow(problem, rows, alone, everyone, running_time)
            short = alone | short_of_time(part, rows, solution.multipliers)
        everyone = _dearer_follow(problem, rows, solution, everyone, running_time + overdue)
        new = sorted(_violators(problem, everyone, running_time + overdue, rows, wider) - set(rows))
        owed = solution.energy + overdue * float(solution.time_price.sum())
        if coarse:
            solution = replace(solution, energy=owed)
        found = (solution, everyone) if not (new or short > alone) and (coarse or exact) else None
        alone |= short
        if not (new or coarse or exact):
            found = _amended(problem, rows, solution, running_time, owed)
        if found is not None:
            solution, everyone = found
            if not coarse:
                solution = with_costates(part, solution, running_time)
                statuses.append(solution.statuses[-1])
            return Answer(problem, everyone, tuple(rows), solution, turns, tuple(statuses), alone)
        exact = exact or not new
        price = np.append(solution.time_price, np.zeros(len(new)))
        plan = solution.plan.joined(everyone.select(new))
        rows += new
    raise AssertionError  # for ever is long enough


def _amended(
    problem: Problem, rows: list[int], solution: Solution, running_time: float, owed: float
) -> tuple[Solution, Plan] | None:
    """The solution made exact without another program, and how all ride.

    None where that is not possible, or costs more than the energy `owed` anyway.
    """
    part = problem.select(rows)
    traction = amended(part, solution.plan, running_time)
    if traction is None:
        return None
    everyone = _all_ride(problem, rows, part, replace(solution.plan, traction=traction))
    everyone = _dearer_follow(problem, rows, solution, everyone, running_time)
    driven = everyone.select(rows)
    others = _violators(problem, everyone, running_time, rows, 1.0)
    energy = energy_of(part, driven)
    if others or _violators(part, driven, running_time, [], 1.0) or energy > owed * (1.0 + _DEARER):
        return None
    return replace(solution, plan=driven, energy=energy), everyone


def best_bound(
    problem: Problem, answer: Answer, speeds: FloatArray, running_time: float
) -> tuple[float, str]:
    """Lower bound of the worst-case energy [J/kg], and how it was found.

    The multipliers of the optimum give it; or those of an optimum for the configurations alone to
    which time is worth something, for the bound cannot hold the power of others; or, if none of
    this comes close, the cone relaxation.
    """
    part, solution = problem.select(answer.active), answer.solution
    expected = problem.run.objective == "expected"
    if expected and not set(np.flatnonzero(problem.weights).tolist()) <= set(answer.active):
        shares = shared(problem, answer.active, answer.alone)
        every = multipliers_for_all(problem, shares, solution.multipliers)
        spare, start = _spare(problem, answer.plan), np.sqrt(2.0 * answer.plan.z)
        return lower_bound(problem, every, start, running_time, spare), "shared multipliers"
    close = 1.0 - _CLOSE / problem.shape[1]
    bound = _bounded(part, solution, running_time)
    if bound >= close * solution.energy:
        return bound, "multipliers"
    said = solution.time_price > _SHORT * solution.time_price.max()
    priced = np.flatnonzero(said | (expected & (part.weights > 0.0))).tolist()
    rows = [answer.active[row] for row in priced]
    if len(priced) < len(answer.active):
        part = problem.select(rows)
        told = solution.multipliers.select(priced)
        alone = replace(solution, plan=solution.plan.select(priced), multipliers=told)
        solution = with_costates(part, alone, running_time)
        bound = max(bound, _bounded(part, solution, running_time))
        if bound >= close * answer.solution.energy:
            return bound, "multipliers of those short of time"
    try:
        relaxed = Relaxation(part, speeds[rows]).least_energy(running_time)
    except NoSolutionError:
        return bound, "multipliers"
    spare = _spare(part, solution.plan)
    # The cone solver's value may be above the least by what it stops at.
    value = relaxed.bound - _CONE_TOLERANCE * (1.0 + abs(relaxed.bound))
    relaxation = value - float(relaxed.time_price @ spare)
    return max(bound, relaxation), f"cone relaxation: {relaxed.status}"


def _bounded(problem: Problem, solution: Solution, running_time: float) -> float:
    speeds, spare = np.sqrt(2.0 * solution.plan.z), _spare(problem, solution.plan)
    return lower_bound(problem, solution.multipliers, speeds, running_time, spare)


def _spare(problem: Problem, plan: Plan) -> FloatArray:
    """By how much the true times are shorter than those by the mean speeds of the cells [s].

    The bounds take the latter; they pay for the difference.
    """
    driven = realise(problem, plan)
    speed = np.sqrt(2.0 * driven.z)
    model = 2.0 * problem.step / (speed[:, :-1] + speed[:, 1:])
    ahead = np.cumsum(model - cell_times(problem, driven), axis=1)
    if np.isfinite(problem.earliest).any():
        ahead = np.abs(ahead)
    return np.asarray(np.maximum(ahead.max(axis=1), 0.0))


def _slowest(problem: Problem, speeds: FloatArray) -> int:
    """The configuration that takes longest on its fastest run."""
    return int(np.argmax((problem.step / (speeds[:, :-1] + speeds[:, 1:])).sum(axis=1)))


def _program(problem: Problem, rows: Sequence[int], alone: frozenset[int]) -> Problem:
    """The problem of few configurations, each with the weight of those that it stands for."""
    part = problem.select(rows)
    if problem.run.objective != "expected":
        return part
    return replace(part, weights=shared(problem, rows, alone).weights)


def _all_follow(
    problem: Problem, rows: list[int], alone: frozenset[int], riding: Plan, running_time: float
) -> Plan:
    """The same traction; who is not in the program brakes as gently as those that stand for it.

    So does who is in it without weight, for its limits alone, where that regains more.
    """
    ahead = shared(problem, rows, alone).parts @ riding.z[rows]
    idle = problem.weights == 0.0
    ahead[idle] = problem.weights @ ahead
    found = ride_behind(problem, riding.traction, ahead, running_time)
    kept = np.zeros(idle.size, dtype=bool)
    kept[rows] = True
    kept &= ~idle | (riding.dynamic @ problem.step > found.dynamic @ problem.step)
    found.put(kept, riding, kept)
    return found


def _dearer_follow(
    problem: Problem, rows: list[int], solution: Solution, riding: Plan, running_time: float
) -> Plan:
    """The same traction; who regains less than all in the program brakes as gently as the leader.

    That is who is shortest of time. Only at the line, and where each brakes for itself. Who brakes
    late regains less than it could, which is no reason to optimise for it.
    """
    regained = riding.dynamic @ problem.step
    dearer = np.flatnonzero(regained < regained[rows].min()).tolist()
    if problem.run.objective != "line" or problem.common or not dearer:
        return riding
    some = problem.select(dearer)
    leader = rows[int(np.argmax(solution.time_price))]
    ahead = np.broadcast_to(riding.z[leader], (len(dearer), riding.z.shape[1]))
    behind = ride_behind(some, riding.traction, ahead, running_time)
    better = behind.dynamic @ problem.step > regained[dearer]
    riding.put(np.asarray(dearer)[better], behind, better)
    return riding


def _all_ride(problem: Problem, rows: list[int], part: Problem, optimum: Plan) -> Plan:
    """The optimum for the active configurations, and how the others follow it."""
    common = optimum.braking[0] if problem.common else None
    riding, driven = ride_along(problem, optimum.traction, common), realise(part, optimum)
    riding.put(rows, driven)
    return riding


def _violators(
    problem: Problem, plan: Plan, running_time: float, active: list[int], wider: float
) -> set[int]:
    """The worst of the others of each kind: late, short of power or brake, too fast, too dear."""
    fastest = np.sqrt(2.0 * (np.maximum(plan.z[:, :-1], plan.z[:, 1:]) + problem.bulge))
    by_power = problem.dynamic_power / np.maximum(fastest, 1e-6)
    brakes = np.minimum(problem.braking, problem.friction + np.minimum(problem.dynamic, by_power))
    ceiling = np.append(problem.ceiling[:-1], problem.final_ceiling)
    late, soon = delays(problem, plan, running_time)
    excesses = [
        late * (_OVER / LATE),
        soon * (_OVER / LATE),
        ((problem.floor - plan.z) / problem.ceiling.max()).max(axis=1),
        (plan.traction / problem.traction_by_power(plan.z)).max(axis=1) - 1.0,
        ((plan.braking - brakes) / problem.braking.max()).max(axis=1),
        ((plan.z - ceiling) / problem.ceiling.max()).max(axis=1),
    ]
    if problem.run.objective == "line" and active:
        spent = -(plan.dynamic @ problem.step)
        excesses.append((spent - spent[active].max()) / (plan.traction @ problem.step))
    found: set[int] = set()
    for excess in excesses:
        excess[active] = -np.inf
        found |= _worst(excess, wider * _OVER)
    return found


def _worst(amounts: FloatArray, limit: float) -> set[int]:
    """The worst configuration beyond `limit`, and the next if it is nearly half as bad."""
    first, second = np.argsort(-amounts)[:2] if amounts.size > 1 else (0, 0)
    excess = amounts - limit
    if excess[first] <= 0.0:
        return set()
    return {int(first), int(second)} if excess[second] > 0.4 * excess[first] else {int(first)}


def _dearest(problem: Problem, least_times: FloatArray) -> int:
    """The configuration of the highest resistance at the mean speed of the fastest runs."""
    speed = float(problem.step.sum()) / float(np.median(least_times))
    drag = problem.drag1 * speed + problem.drag2.mean(axis=1) * speed**2
    drag += (problem.mean_drag0 @ problem.step) / problem.step.sum()
    return int(np.argmax(drag / problem.gain))


def _optimum(
    problem: Problem,
    plan: Plan,
    price: FloatArray,
    speeds: FloatArray,
    running_time: float,
    tolerance: float,
    late: float,
    evenness: float,
) -> Solution:
    """The optimum for these configurations, from a plan, or else from their relaxation.

    Raises
    ------
    InfeasibleError
        With what is missing: time, or with common braking a higher speed at the end.
    """
    try:
        solution = minimise(
            problem,
            plan,
            price,
            running_time,
            rounds=12,
            tolerance=tolerance,
            lateness=late,
            evenness=evenness,
        )
        if solution.settled and solution.lateness <= max(LATE, late):
            return solution
    except NoSolutionError:
        pass
    relaxation = Relaxation(problem, speeds)
    try:
        relaxed = relaxation.least_energy(running_time)
    except NoSolutionError as word:
        if problem.common:
            raise brakes_explained(problem, speeds, running_time) from None
        raise time_explained(problem, relaxation, running_time, str(word)) from None
    try:
        solution = minimise(
            problem, relaxed.plan, relaxed.time_price, running_time, tolerance=tolerance,
            lateness=late, evenness=evenness,
        )  # fmt: skip
        if solution.lateness <= max(LATE, late):
            return replace(solution, statuses=(relaxed.status, *solution.statuses))
        refusal = still_late(problem, running_time, solution.lateness)
    except NoSolutionError as failure:
        refusal = unsettled(problem, running_time, f"a convex step is {failure}")
    if problem.common:
        raise brakes_explained(problem, speeds, running_time)
    raise refusal

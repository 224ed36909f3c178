"""Active set over the configurations: optimise for a few, roll out all, add those that fail.

The optimum for some configurations that all the others can follow is the optimum for all, and the
lower bound for some is one for all. Few are ever active: the slowest, those short of power, and at
the line those that regain least. How the others drive the optimum leaves open; those that do not
decide leave the program, and are judged by the best that they can make of the common traction. In
the expected energy every configuration that has a weight counts.

An answer is driven by the audit. What it finds beyond a limit by little is rounding, of the
programs or of the integration: the same search within slightly stricter limits removes it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import count

import numpy as np

from analysis.trajectory.audit import END_TOLERANCE, STOPPING_TOLERANCE, Audit, audit
from analysis.trajectory.convex import (
    Multipliers,
    NoSolutionError,
    OutOfTimeError,
    Relaxation,
    time_left,
    time_limit,
)
from analysis.trajectory.discretisation import DiscreteProblem, Plan, discretise, taper_along
from analysis.trajectory.envelope import Envelope
from analysis.trajectory.feasibility import (
    LATE,
    brakes_explained,
    still_late,
    time_explained,
    unsettled,
)
from analysis.trajectory.problem import MOST_CELLS, TrajectoryProblem
from analysis.trajectory.rollout import (
    capped_run,
    cell_times,
    delays,
    energy_of,
    integrate_cells,
    paced_run,
    realise,
    rollout,
    rollout_at,
    rollout_gently,
    run_together,
)
from analysis.trajectory.sqp import (
    EXACT,
    LATENESS_PRICE,
    NEGLIGIBLE_ENERGY,
    QPSubproblem,
    Solution,
    Tolerances,
    minimise,
)
from trainlog.arrays import FloatArray
from trainlog.display import few
from trainlog.errors import InfeasibleError, TrainlogError
from trainlog.progress import note

_COARSE = Tolerances(energy=1e-4, lateness=0.05, smoothing=0.0)
"""On the coarse grid, where a search only prepares another."""

_STAND_IN = Tolerances(energy=1e-4, lateness=0.05)
"""Where some configurations stand for others in an expected energy."""

_LARGE, _OF_LARGE = 5_000, replace(EXACT, energy=2e-5)
"""Cells of all configurations in a program from which each further one costs seconds."""

_RESPONSE = Tolerances(energy=1e-4, lateness=0.02)
"""Where the brakes of configurations are sought that are not in the program."""

_VIOLATION = 5e-7
"""Excess over power, brake, speed or energy that makes a configuration active, relative."""

_REPRESENTATIVES = 8
"""Configurations that an expected energy is taken over at first, each for those most like it."""

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
    expected = problem.run.objective == "expected"
    counted = set(np.flatnonzero(problem.weights).tolist()) if expected else set[int]()
    together = cache(partial(DrivenPlan.together, problem, speeds, running_time))
    for turns in count(1):
        grid = f"{problem.shape[1]} cells" + ", to begin with" * coarse
        note(f"round {turns}: {len(rows)} of {problem.shape[0]} decide, {grid}")
        part = even.select(rows)
        start = partial(DrivenPlan.of_rows, together, tuple(rows))
        left_out = counted - set(rows)
        wide = _STAND_IN if left_out and not coarse else tolerances
        if wide is EXACT and len(rows) * problem.shape[1] > _LARGE:
            wide = _OF_LARGE
        try:
            solution = _optimum(part, plan, price, speeds[rows], running_time, wide, start)
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
        overdue = max(float(late.max()), 0.0) if coarse or left_out else 0.0
        everyone = _brake_gently(problem, rows, everyone, running_time + overdue)
        new = _violators(problem, everyone, running_time + overdue, rows) - set(rows)
        if left_out and not coarse:
            # Those that stood for others have led near the optimum; now each counts by itself.
            new |= left_out
            others = sorted(left_out)
            everyone.put(others, solution.plan, problem.nearest(rows)[others])
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
    """The same traction; one that is too soon, or regains less than all in the program, brakes so.

    Only where each brakes for itself. A configuration that brakes late regains less than it could,
    and passes a point earlier than it need: no reasons to optimise for it. First by what a rollout
    finds, then, where the worst counts, by a program for the brakes of those that are still too
    soon or seem to regain too little.
    """
    timed = np.isfinite(problem.earliest).any()
    if problem.common or not (problem.run.at_line or timed):
        return driven
    expected, least = problem.run.objective == "expected", -np.inf
    if problem.run.at_line:
        least = np.inf if expected else (driven.dynamic @ problem.step)[rows].min()
    for respond in (rollout_gently,) if expected else (rollout_gently, _best_responses):
        soon = delays(problem, driven, running_time)[1] > LATE
        little = (driven.dynamic @ problem.step < least) | (soon & (respond is _best_responses))
        little[rows] = False
        found = np.flatnonzero(little)
        if not found.size:
            continue
        some, own = problem.select(found.tolist()), driven.select(found.tolist())
        # As one in the program drives is nearer to what is sought than to pass too soon.
        nearest = np.array(rows)[problem.nearest(rows)]
        like = np.where(soon, nearest, np.arange(soon.size))[found].tolist()
        gentle = respond(some, driven.select(like), running_time)
        better = soon[found] | (gentle.dynamic @ problem.step > own.dynamic @ problem.step)
        better &= np.max(_excesses(some, gentle, running_time), axis=0) <= _VIOLATION
        driven.put(found[better], gentle, better)
    return driven


def _best_responses(problem: DiscreteProblem, driven: Plan, running_time: float) -> Plan:
    """How each regains most under the traction that all have, by programs for its brakes alone.

    In one program for all, the one that settles last would keep all the others waiting.
    """
    sooner = running_time - _RESPONSE.lateness
    planned = driven.z.copy()
    for row in range(problem.shape[0]):
        own, start = problem.select([row]), driven.select([row])
        apart = replace(own, run=replace(own.run, objective="expected"), weights=np.ones(1))
        best: Solution | None = None
        try:
            best = minimise(apart, start, np.zeros(1), sooner, _RESPONSE, iterations=15, given=True)
        except NoSolutionError:
            pass
        except OutOfTimeError as stop:
            best = stop.found
        if best is not None:
            planned[row] = best.plan.z[0]
    # The plan that it began from may be another's, whose speeds are not its own.
    return rollout_at(problem, driven, planned)


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
        drawn = max(float(plan.traction @ problem.step), NEGLIGIBLE_ENERGY)
        excesses.append((spent - spent[active].max()) / drawn)
    found: set[int] = set()
    for excess in excesses:
        excess[active] = -np.inf
        found |= _worst(excess, _VIOLATION)
    return found


def _excesses(problem: DiscreteProblem, plan: Plan, running_time: float) -> list[FloatArray]:
    """By how much each is late, early, too slow, short of power or brake, or too fast; (q,)."""
    brakes = problem.most_braking(plan.z)
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
    why: Callable[[], InfeasibleError]
    settled = False
    try:
        solution = minimise(problem, plan, price, running_time, tolerances, iterations=12)
        settled = solution.converged
        if settled and solution.lateness <= max(LATE, tolerances.lateness):
            return solution
    except NoSolutionError:
        pass
    if problem.common:
        # Next to the least time the relaxation takes long to state that it has no inside, and
        # what begins at its optimum settles as late.
        safe = descend(problem, start(), running_time, tolerances)
        if safe is not None:
            return safe
        if settled:
            why = partial(brakes_explained, problem, speeds, running_time)
            raise NotFoundError(why, solution.lateness)
    relaxation = Relaxation(problem, speeds)
    try:
        relaxed = relaxation.least_energy(running_time)
    except NoSolutionError as status:
        safe = descend(problem, start(), running_time, tolerances)
        if safe is not None:
            return safe
        why = partial(time_explained, problem, relaxation, running_time, str(status))
        if problem.common:
            why = partial(brakes_explained, problem, speeds, running_time)
        raise NotFoundError(why) from None
    try:
        solution = minimise(problem, relaxed.plan, relaxed.time_price, running_time, tolerances)
        if solution.lateness <= max(LATE, tolerances.lateness):
            return replace(solution, statuses=(relaxed.status, *solution.statuses))
        why = partial(still_late, problem, running_time, solution.lateness)
    except NoSolutionError as failure:
        why = partial(unsettled, problem, running_time, f"a convex step is {failure}")
    safe = descend(problem, start(), running_time, tolerances)
    if safe is not None:
        return replace(safe, statuses=(relaxed.status, *safe.statuses))
    if problem.common:
        why = partial(brakes_explained, problem, speeds, running_time)
    raise NotFoundError(why)


class NotFoundError(InfeasibleError):
    """No plan was found; `why` looks for the reason, which may take longer than the search did.

    `late` is how late the programs settled [s], if they did.
    """

    def __init__(self, why: Callable[[], InfeasibleError], late: float = np.nan) -> None:
        super().__init__("no trajectory was found")
        self.why, self.late = why, late


INACTIVE = 1e-3
"""Switching function below which a configuration is inactive, and leaves a prepared set."""


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
        The solver's status of every program so far.
    """

    rows: tuple[int, ...]
    plan: Plan
    price: FloatArray
    statuses: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Answer:
    """The best plan for all configurations.

    Attributes
    ----------
    problem : DiscreteProblem
        With the traction tapered as the plan has it.
    plan : Plan
    active : tuple of int
        Rows of the configurations that it was optimised for.
    solution : Solution
        Of the active configurations.
    turns : int
        How often configurations were added, and once more.
    statuses : tuple of str
        The solver's status of every program.
    """

    problem: DiscreteProblem
    plan: Plan
    active: tuple[int, ...]
    solution: Solution
    turns: int
    statuses: tuple[str, ...]


def initial_guess(problem: DiscreteProblem, speeds: FloatArray, running_time: float) -> Guess:
    """The slowest configuration and that of the highest resistance, their fastest run cut off.

    Where a window of time opens on the way, the fastest too; all, where all count.

    Parameters
    ----------
    speeds : (q, n + 1) array [m/s]
        Of the fastest run of each configuration.
    """
    times = (2.0 * problem.step / (speeds[:, :-1] + speeds[:, 1:])).sum(axis=1)
    rows = {int(np.argmax(times)), _highest_resistance(problem, times)}
    if problem.common:
        rows |= {int(np.argmin(times)), int(np.argmin(problem.power))}
    if np.isfinite(problem.earliest).any():
        rows |= {int(np.argmin(times))}
    if problem.run.objective == "expected":
        rows |= _representatives(problem, rows)
    chosen = tuple(sorted(rows))
    part = problem.select(chosen)
    return Guess(chosen, *capped_run(part, speeds[list(chosen)], running_time))


def _representatives(problem: DiscreteProblem, rows: set[int]) -> set[int]:
    """Of those that count all, or of many those that are least alike, one after another."""
    own, counted, found = problem.alike, problem.weights > 0.0, sorted(rows)
    if np.count_nonzero(counted) <= _REPRESENTATIVES:
        return set(np.flatnonzero(counted).tolist())
    while len(found) < _REPRESENTATIVES:
        away = ((own[:, None] - own[found]) ** 2).sum(axis=2).min(axis=1)
        found.append(int(np.argmax(np.where(counted, away, -1.0))))
    return set(found)


def interpolated_guess(answer: Answer, coarse: FloatArray, problem: DiscreteProblem) -> Guess:
    """What was found on one grid, interpolated to another one.

    Parameters
    ----------
    answer : Answer
        For all configurations.
    coarse : (m + 1,) array [m]
        Its grid.
    problem : DiscreteProblem
    """
    solution, positions = answer.solution, problem.positions
    influence = np.abs(solution.multipliers.pull / np.diff(coarse)).max(axis=1)
    active = np.flatnonzero(influence > INACTIVE)
    if active.size == 0 or problem.common or problem.run.objective == "expected":
        active = np.arange(len(answer.active))
    plan = solution.plan
    cell = np.searchsorted(coarse, 0.5 * (positions[1:] + positions[:-1])) - 1
    cell = np.clip(cell, 0, coarse.size - 2)
    z = np.array([np.interp(positions, coarse, plan.z[row]) for row in active])
    guess = Plan(
        z, plan.traction[cell], *(e[active][:, cell] for e in (plan.braking, plan.dynamic))
    )
    chosen = tuple(answer.active[row] for row in active)
    return Guess(chosen, guess, solution.time_price[active], answer.statuses)


def _highest_resistance(problem: DiscreteProblem, least_times: FloatArray) -> int:
    """The configuration of the highest resistance at the mean speed of the fastest runs."""
    speed = float(problem.step.sum()) / float(np.median(least_times))
    drag = problem.drag1 * speed + problem.drag2.mean(axis=1) * speed**2
    drag += (problem.mean_drag0 @ problem.step) / problem.step.sum()
    return int(np.argmax(drag / problem.gain))


_CORRECTIONS = 3
"""How often limits are made stricter by what an audit found beyond them."""

_LITTLE = 1e-3
"""Part of a limit up to which an excess is corrected so."""

_TIMES, _LEAST = 4.0, 1e-3
"""Ratio of ``z`` at both ends from which a cell is split, and the least ``z`` that counts."""

_SPLITS, _LOST = 5, 0.3
"""How often cells are split that cost a run at a constant pace time; and what each may cost, over
an even share of the time in hand."""

_PARTED, _MOST_PARTS = 1e-7, 8
"""Difference of ``z`` [m²/s²] at the end of a cell, of plan and audit, from which the cell is
split; and the most parts."""

_MORE = 1.5
"""Times the excess by which a limit becomes stricter."""


def driven(answer: Answer) -> Audit:
    """The audit of an answer."""
    problem, unit = answer.problem, answer.problem.reference
    plan, fall = answer.plan, problem.taper.fall * unit
    return audit(problem.run, problem.positions, plan.traction * unit, fall, plan.braking * unit)


def searched(
    problem: DiscreteProblem,
    guess: Guess,
    envelope: Envelope,
    running_time: float,
    in_hand: float = 0.0,
) -> tuple[Answer, Audit, float]:
    """The optimum, if need be within stricter limits and on more cells, so that it can be driven.

    Parameters
    ----------
    problem : DiscreteProblem
        With all configurations, not tapered.
    guess : Guess
    envelope : Envelope
        Fast runs of each configuration.
    running_time : float [s]
    in_hand : float [s]
        By how much the audit is likely to arrive later than the programs do.

    Returns
    -------
    answer : Answer
    audit : Audit
    later : float [s]
        By how much the audit did.

    Raises
    ------
    InfeasibleError
        If the search finds no trajectory.
    TrainlogError
        If the one that it finds does not pass.
    """
    strict, asked = problem, running_time - in_hand
    for _ in range(_CORRECTIONS + 1):
        answer = search(strict, guess, envelope.at(strict.positions), asked)
        found = driven(answer)
        failures = found.failures(problem.run, running_time)
        if not failures:
            # The bound is to hold for the limits as they are.
            later = max(float(found.arrival.max()) - asked, 0.0)
            return replace(answer, problem=problem.tapered(answer.problem.taper)), found, later
        late = float(found.arrival.max()) - running_time
        split = split_where_slow(problem.positions, answer.plan.z)
        if _ends_elsewhere(found, problem.run):
            parted = split_where_long(answer, found)
            split = np.union1d(split, parted) if parted.size <= MOST_CELLS else split
        if split.size > problem.positions.size:
            problem = strict = discretise(problem.run, split)
        elif _is_little(found, problem.run, late / running_time):
            strict, asked = _stricter(strict, found), asked - max(_MORE * late, 0.0)
        else:
            break
        guess = interpolated_guess(answer, answer.problem.positions, strict)
    raise _not_passed(failures)


def split_where_slow(positions: FloatArray, z: FloatArray) -> FloatArray:
    """A grid with cells split in which the speed changes by more than a factor of two.

    Near a standstill on the way the resistance changes within metres. New nodes are where ``z``,
    taken as linear, is four times, sixteen times ... what it is at the slower end.

    Parameters
    ----------
    positions : (n + 1,) array [m]
    z : (q, n + 1) array [m²/s²]
        Of a plan.
    """
    low, high = np.minimum(z[:, 1:-2], z[:, 2:-1]), np.maximum(z[:, 1:-2], z[:, 2:-1])
    ratio = high / np.maximum(low, _LEAST)
    row, cells = np.argmax(ratio, axis=0), np.arange(ratio.shape[1])
    found = [positions]
    for k in cells[ratio[row, cells] > 1.5 * _TIMES].tolist():
        a, begin, end = row[k], positions[k + 1], positions[k + 2]
        count = int(np.ceil(np.log(ratio[a, k]) / np.log(_TIMES)))
        least, most = max(low[a, k], _LEAST), high[a, k]
        share = (least * (most / least) ** (np.arange(1, count) / count) - least) / (most - least)
        slow_first = z[a, k + 1] < z[a, k + 2]
        found.append(begin + share * (end - begin) if slow_first else end - share * (end - begin))
    return np.unique(np.concatenate(found))


def split_where_long(answer: Answer, found: Audit) -> FloatArray:
    """A grid with cells split so long that the plan leaves them otherwise than the audit does.

    Integrated by the same steps in parts of the cell, an error falls with their fourth power.

    Parameters
    ----------
    answer : Answer
    found : Audit
        Of this answer.
    """
    problem, z = answer.problem, 0.5 * found.speeds**2
    reached = integrate_cells(problem, replace(answer.plan, z=z))[0]
    # Where the audit stands it shows nothing more: what it lacks to the end would have been left.
    error = np.where(z[:, 1:] > 0.0, np.abs(reached - z[:, 1:]), 0.0).max(axis=0)
    error[-1] += float((found.shortfall * z[:, -2]).max()) / problem.step[-1]
    error /= _PARTED
    parts = np.clip(np.ceil(error**0.25), 1, _MOST_PARTS).astype(int)
    shares = np.concatenate([np.arange(count) / count for count in parts.tolist()])
    cell = np.repeat(np.arange(parts.size), parts)
    split = problem.positions[cell] + shares * problem.step[cell]
    return np.append(split, problem.positions[-1])


def _ends_elsewhere(found: Audit, run: TrajectoryProblem) -> bool:
    """Whether an audit stops short of the end, or is too fast there."""
    fast = float(found.end_speed.max()) - run.final_speed
    return fast > END_TOLERANCE or float(found.shortfall.max()) > STOPPING_TOLERANCE


def _is_little(found: Audit, run: TrajectoryProblem, late: float) -> bool:
    """Whether every excess is so small that slightly stricter limits remove it."""
    worst = (late, *(float(each.max()) - 1.0 for each in _used(found)))
    way = float(found.shortfall.max()) / (run.end - run.start)
    end = float(found.end_speed.max()) - run.final_speed
    over = float(found.overspeed.max()) / float(found.speeds.max())
    return max(*worst, way, over) <= _LITTLE and end <= 0.1


def _used(found: Audit) -> tuple[FloatArray, ...]:
    return found.power, found.effort, found.braking, found.adhesion


def _stricter(problem: DiscreteProblem, found: Audit) -> DiscreteProblem:
    """The problem with limits lowered by what the audit found beyond them."""
    power, effort, braking, adhesion = (
        1.0 - _MORE * max(float(each.max()) - 1.0, 0.0) for each in _used(found)
    )
    over = _MORE * max(float(found.overspeed.max()), 0.0)
    ceiling = problem.ceiling - over * np.sqrt(2.0 * np.maximum(problem.ceiling, 0.0))
    ceiling[0] = max(ceiling[0], problem.initial)
    pull, brake = min(effort, adhesion), min(braking, adhesion)
    curves, dynamic_curves = problem.curves, problem.dynamic_curves
    return replace(
        problem,
        curves=None if curves is None else curves.kept_to(effort),
        dynamic_curves=None if dynamic_curves is None else dynamic_curves.kept_to(braking),
        power=power * problem.power,
        traction=pull * problem.traction,
        braking=brake * problem.braking,
        friction=brake * problem.friction,
        dynamic=brake * problem.dynamic,
        dynamic_power=brake * problem.dynamic_power,
        ceiling=np.maximum(ceiling, np.minimum(problem.floor, problem.ceiling)),
    )


def paced_grid(
    run: TrajectoryProblem, positions: FloatArray, paced: Envelope, running_time: float
) -> DiscreteProblem | None:
    """The problem on a grid on which all can follow the slowest in time; None if that is not found.

    Under power, on a climb on which they hardly move, trains lose minutes in cells whose traction
    is constant, or stand: such cells are split in halves.

    Parameters
    ----------
    run : TrajectoryProblem
    positions : (n + 1,) array [m]
        Where it begins.
    paced : Envelope
        Runs at one pace, in time.
    running_time : float [s]
    """
    most = min(MOST_CELLS, 4 * positions.size)
    for _ in range(_SPLITS):
        problem, speeds = discretise(run, positions), paced.at(positions)
        driven = DrivenPlan.together(problem, speeds, running_time)
        if driven.late <= 0.0:
            return problem
        slowest = np.diff(paced.times_behind_slowest(positions))
        lost = cell_times(driven.problem, driven.plan).max(axis=0) - slowest
        spare = running_time - float(slowest.sum())
        split = lost > max(_LOST * spare / lost.size, float(np.median(lost)))
        positions = np.union1d(positions, 0.5 * (positions[1:] + positions[:-1])[split])
        if not split.any() or positions.size > most:
            break
    return None


def _not_passed(failures: list[str]) -> TrainlogError:
    return TrainlogError(
        f"the trajectory does not pass its audit: {few(failures, 1)}",
        remedy="more cells, or another running time",
    )


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
        if problem.common:
            beyond = driven.braking - problem.most_braking(z)
            kept &= bool(beyond.max() <= _VIOLATION * problem.braking.max())
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

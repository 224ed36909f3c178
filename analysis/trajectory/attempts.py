"""Attempts at an answer on one grid: searched, driven by the audit, corrected.

What the audit finds beyond a limit by little is rounding, of the programs or of the integration:
the same search within slightly stricter limits removes it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from analysis.trajectory.active_set import search
from analysis.trajectory.audit import Audit, audit
from analysis.trajectory.descent import DrivenPlan
from analysis.trajectory.discretisation import DiscreteProblem, discretise
from analysis.trajectory.envelope import Envelope
from analysis.trajectory.guess import Answer, Guess, interpolated_guess
from analysis.trajectory.problem import MOST_CELLS, TrajectoryProblem
from analysis.trajectory.rollout import cell_times
from trainlog.arrays import FloatArray
from trainlog.errors import TrainlogError

_CORRECTIONS = 3
"""How often limits are made stricter by what an audit found beyond them."""

_LITTLE = 1e-3
"""Part of a limit up to which an excess is corrected so."""

_TIMES, _LEAST = 4.0, 1e-3
"""Ratio of ``z`` at both ends from which a cell is split, and the least ``z`` that counts."""

_SPLITS, _LOST = 5, 0.3
"""How often cells are split that cost a run at a constant pace time; and what each may cost, over
an even share of the time in hand."""

_MORE = 1.5
"""Times the excess by which a limit becomes stricter."""


def driven(answer: Answer) -> Audit:
    """The audit of an answer."""
    problem, unit = answer.problem, answer.problem.reference
    plan, fall = answer.plan, problem.taper.fall * unit
    return audit(problem.run, problem.positions, plan.traction * unit, fall, plan.braking * unit)


def searched(
    problem: DiscreteProblem, guess: Guess, envelope: Envelope, running_time: float
) -> tuple[Answer, Audit]:
    """The optimum, if need be within stricter limits and on more cells, so that it can be driven.

    Parameters
    ----------
    problem : DiscreteProblem
        With all configurations, not tapered.
    guess : Guess
    envelope : Envelope
        Fast runs of each configuration.
    running_time : float [s]

    Raises
    ------
    InfeasibleError
        If the search finds no trajectory.
    TrainlogError
        If the one that it finds does not pass.
    """
    strict, asked = problem, running_time
    for _ in range(_CORRECTIONS + 1):
        answer = search(strict, guess, envelope.at(strict.positions), asked)
        found = driven(answer)
        failures = found.failures(problem.run, running_time)
        if not failures:
            # The bound is to hold for the limits as they are.
            return replace(answer, problem=problem.tapered(answer.problem.taper)), found
        late = float(found.arrival.max()) - running_time
        split = split_where_slow(problem.positions, answer.plan.z)
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
    ceiling = problem.ceiling - over * np.sqrt(2.0 * problem.ceiling)
    ceiling[0] = max(ceiling[0], problem.initial)
    pull, brake = min(effort, adhesion), min(braking, adhesion)
    return replace(
        problem,
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
    words = failures[0] + (f" and {len(failures) - 1} more" if len(failures) > 1 else "")
    return TrainlogError(
        f"the trajectory does not pass its audit: {words}",
        remedy="more cells, or another running time",
    )

"""Expected energy of many configurations: few stand for those like them.

What a configuration regains depends smoothly on its properties. A program for few of them, each
with the weight of all that it stands for, finds nearly the same traction; what the others regain
under it is driven and counted one by one, and the bound holds for all of them: a configuration
takes its share of the multipliers of the one that stands for it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from analysis.trajectory.linearised import Multipliers
from analysis.trajectory.problem import Problem

FloatArray = NDArray[np.float64]

FEW = 12
"""Configurations up to which each is in the program itself."""

KINDS = 10
"""Configurations that stand for others, where there are more."""

_SHORT = 1.1
"""Worth of traction over the usual, from which a configuration is short of time."""

_SUM = 30.0
"""How strictly shares add up to 1, over how well they match the properties."""


@dataclass(frozen=True, eq=False)
class Shares:
    """Who stands for whom.

    Attributes
    ----------
    rows : tuple of r int
        Configurations of the program.
    parts : (q, r) array
        How each configuration is mixed of them; each row adds up to 1.
    weights : (r,) array
        Probability that each of them stands for.
    """

    rows: tuple[int, ...]
    parts: FloatArray
    weights: FloatArray


def kinds(problem: Problem, slowest: int) -> list[int]:
    """Rows of few configurations that differ most, the slowest among them (farthest first).

    Those without weight have no say in what is expected.
    """
    counted = np.flatnonzero(problem.weights > 0.0)
    if counted.size <= FEW:
        return counted.tolist()
    unit, found = _properties(problem)[counted], [slowest]
    others = _properties(problem)[found]
    while len(found) <= KINDS:
        away = np.linalg.norm(unit[:, None] - others, axis=2).min(axis=1)
        found.append(int(counted[np.argmax(away)]))
        others = np.vstack((others, unit[np.argmax(away)]))
    return found


def shared(problem: Problem, rows: Sequence[int], alone: Collection[int]) -> Shares:
    """Mix every configuration of `rows`, by its properties.

    Those `alone` stand for themselves only: they are short of time, which the others are not.
    """
    unit, chosen = _properties(problem), list(rows)
    others = [number for number, row in enumerate(chosen) if row not in alone] or [0]
    corners = np.vstack((unit[[chosen[number] for number in others]].T, np.full(len(others), _SUM)))
    parts = np.zeros((unit.shape[0], len(chosen)))
    for row, each in enumerate(unit):
        found, _ = nnls(corners, np.append(each, _SUM))
        parts[row, others] = found / found.sum()
    parts[chosen] = np.eye(len(chosen))
    return Shares(tuple(chosen), parts, problem.weights @ parts)


def short_of_time(problem: Problem, rows: Sequence[int], found: Multipliers) -> set[int]:
    """Those of `rows` to which traction is worth more than to the others, being short of time.

    Where the common traction is more than a configuration needs it brakes a little, and to all
    that do traction is worth what braking regains. Who never does cannot stand for them.

    Parameters
    ----------
    problem : Problem
        Of `rows`, each with the weight of all that it stands for.
    found : Multipliers
        Of its optimum.
    """
    worth = found.pull.sum(axis=1) / np.maximum(problem.weights, 1e-300)
    weighty = problem.weights > 0.0
    usual = float(np.median(worth[weighty]))
    short = np.flatnonzero(weighty & (worth > _SHORT * usual)).tolist()
    return {rows[each] for each in short}


def multipliers_for_all(problem: Problem, shares: Shares, found: Multipliers) -> Multipliers:
    """Each configuration's share of the multipliers of those that stand for it.

    Parameters
    ----------
    problem : Problem
        With all configurations and their own weights.
    shares : Shares
    found : Multipliers
        Of the program for few.
    """
    part = problem.weights[:, None] * shares.parts / np.maximum(shares.weights, 1e-300)
    # Who stands for nothing, active for its limits alone, keeps what it has.
    for number in np.flatnonzero(shares.weights == 0.0):
        part[shares.rows[number], number] = 1.0
    return Multipliers(
        pull=part @ found.pull,
        time=part @ found.time,
        passing=part @ found.passing,
        opening=part @ found.opening,
        power=part @ found.power,
        dynamic_power=part @ found.dynamic_power,
        share=problem.weights,
    )


def _properties(problem: Problem) -> FloatArray:
    """Inertia, resistance at two speeds and power, each over its range, (q, 4)."""
    configurations = problem.run.configurations
    fast = float(np.sqrt(2.0 * problem.ceiling.max()))
    values = np.array(
        [
            [c.inertia, float(c.resistance(0.5 * fast)), float(c.resistance(fast)), c.max_power]
            for c in configurations
        ]
    )
    spread = np.ptp(values, axis=0)
    return np.asarray((values - values.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0))

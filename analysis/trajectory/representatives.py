"""Few configurations that represent the others in the expected energy.

What one regains depends smoothly on its properties: a program for few representatives, each with
the weight of all that it represents, finds nearly the same traction; what the others regain under
it is driven and counted one by one, and the bound holds for all of them: a configuration takes its
share of the multipliers of its representatives. Where energy and bound lie apart more enter the
program, up to all.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from analysis.trajectory.convex import (
    Multipliers,
)
from analysis.trajectory.discretisation import DiscreteProblem
from trainlog.arrays import FloatArray

MOST_EXPLICIT = 12
"""Configurations up to which each is in the program itself."""

REPRESENTATIVES = 10
"""Configurations that represent the others, where there are more."""

REPRESENTED = 2e-3
"""Gap between energy and bound up to which representatives are enough, relative."""

_NEARLY_ALL = 1.5
"""Times the representatives, up to which it takes hardly longer to have all in the program."""

_SHORT = 1.1
"""Worth of traction over the usual, from which a configuration is short of time."""

_SUM = 30.0
"""How strictly shares add up to 1, over how well they match the properties."""


@dataclass(frozen=True, eq=False)
class Shares:
    """Which configurations represent which.

    Attributes
    ----------
    rows : tuple of r int
        Configurations of the program.
    parts : (q, r) array
        How each configuration is mixed of them; each row adds up to 1.
    weights : (r,) array
        Probability that each of them represents.
    """

    rows: tuple[int, ...]
    parts: FloatArray
    weights: FloatArray


def representatives(
    problem: DiscreteProblem, begin: Sequence[int], count: int = REPRESENTATIVES + 1
) -> list[int]:
    """Rows of `count` configurations that differ most, those to `begin` with among them.

    Farthest first. Those without weight do not count in what is expected; where it would be nearly
    all that do, it is all of them.
    """
    counted = np.flatnonzero(problem.weights > 0.0)
    if counted.size <= max(MOST_EXPLICIT, _NEARLY_ALL * count):
        return sorted({*begin, *counted.tolist()})
    unit, found = _properties(problem)[counted], list(begin)
    others = _properties(problem)[found]
    while len(found) < count:
        away = np.linalg.norm(unit[:, None] - others, axis=2).min(axis=1)
        found.append(int(counted[np.argmax(away)]))
        others = np.vstack((others, unit[np.argmax(away)]))
    return found


def shares_of(problem: DiscreteProblem, rows: Sequence[int], alone: Collection[int]) -> Shares:
    """Mix every configuration of `rows`, by its properties.

    Those `alone` represent only themselves: they are short of time, which the others are not.
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


def short_of_time(problem: DiscreteProblem, rows: Sequence[int], found: Multipliers) -> set[int]:
    """Those of `rows` to which traction is worth more than to the others, being short of time.

    Where the common traction is more than a configuration needs it brakes a little, and to all
    that do traction is worth what braking regains. One that never does cannot represent them.

    Parameters
    ----------
    problem : DiscreteProblem
        Of `rows`, each with the weight of all that it represents.
    found : Multipliers
        Of its optimum.
    """
    worth = found.pull.sum(axis=1) / np.maximum(problem.weights, 1e-300)
    weighty = problem.weights > 0.0
    usual = float(np.median(worth[weighty]))
    short = np.flatnonzero(weighty & (worth > _SHORT * usual)).tolist()
    return {rows[each] for each in short}


def multipliers_for_all(
    problem: DiscreteProblem, shares: Shares, found: Multipliers
) -> Multipliers:
    """Each configuration's share of the multipliers of its representatives.

    Parameters
    ----------
    problem : DiscreteProblem
        With all configurations and their own weights.
    shares : Shares
    found : Multipliers
        Of the program for few.
    """
    part = problem.weights[:, None] * shares.parts / np.maximum(shares.weights, 1e-300)
    # One that represents nothing, active for its limits alone, keeps what it has.
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


def _properties(problem: DiscreteProblem) -> FloatArray:
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

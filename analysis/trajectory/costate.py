"""The costate as a function of the position, from the multipliers of an optimum on cells.

A multiplier is the mean of the costate over its cell. Between, the costate follows the adjoint
equation along the plan, but where it stands at the level of a partial control.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.trajectory.convex import Multipliers
from analysis.trajectory.discretisation import DiscreteProblem, Plan
from analysis.trajectory.envelope import Envelope
from analysis.trajectory.hamiltonian import Hamiltonian, Segments, reached
from trainlog.arrays import BoolArray, FloatArray

_CREEPING = 2.0
"""Speed below which a train that starts or stops does so at its fastest [m/s]."""

_AT_FASTEST = 3e-3
"""Part of the fastest run's ``z`` within which a plan is at it."""

_AT_LIMIT = 1e-5
"""Part of the permitted ``z`` within which a plan is at its limit."""

_LEVEL = 1e-5
"""Within which a costate is at the level where a control is partial."""

_STANDING = 0.1
"""Speed below which a plan that could go faster all but stands [m/s]."""


@dataclass(frozen=True, eq=False)
class Costate:
    """The costate as a function of the position: its values at the ends of cells.

    Attributes
    ----------
    segments : Segments
    begin, end : (q, n) array
    even : (q, n) array of bool
        Where it is linear; elsewhere it follows the adjoint equation.
    at_nodes : float [J/kg]
        What its jumps and its values at both ends of the run add to the bound.
    """

    segments: Segments
    begin: FloatArray
    end: FloatArray
    even: BoolArray
    at_nodes: float

    def along(self, hamiltonian: Hamiltonian) -> tuple[FloatArray, FloatArray]:
        """Its values and slopes at the points of its segments, (q, n, p)."""
        segments, change = self.segments, self.end - self.begin
        line = self.begin[:, :, None] + change[:, :, None] * segments.place
        shape = np.where(self.even[:, :, None], 0.0, hamiltonian.slopes(line))
        part = segments.weights / segments.length[:, None]
        rest = change / segments.length - (shape * part).sum(axis=2)
        slope = shape + rest[:, :, None]
        step = segments.length[:, None] * (slope @ segments.gathering.T)
        return np.where(self.even[:, :, None], line, self.begin[:, :, None] + step), slope


def costate_of(hamiltonian: Hamiltonian, multipliers: Multipliers) -> Costate:
    """The multipliers of cells as a function of the position.

    A multiplier is the mean of the costate over its cell. Where a control is partial the costate
    stands at a level, or joins its neighbours along the adjoint equation.
    """
    problem, plan, step = hamiltonian.problem, hamiltonian.plan, hamiltonian.problem.step
    mean = multipliers.pull / (step * problem.gain[:, None])
    shape = hamiltonian.slopes(np.broadcast_to(mean[:, :, None], hamiltonian.speed.shape))
    limit, floor = node_limits(hamiltonian)
    limited = plan.z >= np.minimum(limit, problem.ceiling) * (1.0 - _AT_LIMIT)
    held = limited[:, :-1] & limited[:, 1:]
    partial, alone = partial_cells(hamiltonian, mean)
    flat = alone | (held & (shape.mean(axis=2) < 0.0))
    flat |= _standing(hamiltonian)
    base = np.where(flat[:, :, None], 0.0, shape)
    base, even = _together(base, mean, problem.gain, (partial & ~alone, alone, held))
    flat |= even
    whole = hamiltonian.segments
    change = (base * whole.weights).sum(axis=2)
    gathered = whole.length[:, None] * (base @ whole.gathering.T)
    begin = mean - (gathered * whole.weights).sum(axis=2) / step
    end = begin + change
    # Between two cells; the one that follows the adjoint equation knows better.
    trust = np.where(partial, 1e-6, 1.0) / step**2
    left, right = end[:, :-1], begin[:, 1:]
    middle = (trust[:, :-1] * left + trust[:, 1:] * right) / (trust[:, :-1] + trust[:, 1:])
    free = limited[:, 1:-1] & (right > left)
    slow = (floor > 0.0) & (plan.z <= floor * (1.0 + _AT_LIMIT))
    free |= slow[:, 1:-1] & (right < left)
    first = np.column_stack((begin[:, :1], np.where(free, right, middle)))
    last = np.column_stack((np.where(free, left, middle), end[:, -1:]))
    creeping = _creep(problem, hamiltonian.fastest, plan, first, last)
    jump = first[:, 1:] - last[:, :-1]
    added = -(np.maximum(jump, 0.0) * limit[:, 1:-1] + np.minimum(jump, 0.0) * floor[1:-1]).sum()
    added -= float((first[:, 0] * problem.initial).sum())
    added += float((np.minimum(last[:, -1], 0.0) * np.minimum(problem.final, limit[:, -1])).sum())
    # One that leaves its level in the cell follows the adjoint equation there.
    leaves = partial & (np.maximum(np.abs(first - begin), np.abs(last - end)) > _LEVEL)
    return Costate(whole, first, last, creeping | (flat & ~leaves), float(added))


def node_limits(hamiltonian: Hamiltonian) -> tuple[FloatArray, FloatArray]:
    """Largest ``z`` at the nodes, (q, n + 1), and the least, (n + 1,) [m²/s²]."""
    problem, run = hamiltonian.problem, hamiltonian.problem.run
    positions = problem.positions
    limit = run.permitted_speed(positions[:-1] + 0.5 * problem.step)
    lowest = np.asarray(np.minimum(np.append(limit, np.inf), np.insert(limit, 0, np.inf)))
    for node, point in zip(problem.passed.tolist(), run.windows, strict=True):
        if point.highest_speed is not None:
            lowest[node] = min(lowest[node], point.highest_speed)
    own = reached(hamiltonian.fastest, positions)
    return 0.5 * np.minimum(lowest, own) ** 2, problem.floor


def partial_cells(hamiltonian: Hamiltonian, mean: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Cells in which a control is partial, (q, n); and those in which the costate itself is level.

    By common traction, or a common brake, that is the sum of the costates.
    """
    problem, prices = hamiltonian.problem, hamiltonian.prices
    own, regained = mean * problem.gain[:, None], prices.regained[:, None]
    worth = np.asarray(own.sum(axis=0))
    shared = np.abs(worth - prices.traction) < _LEVEL
    if problem.common:
        shared |= (np.abs(worth) < _LEVEL) | (np.abs(worth - regained.sum()) < _LEVEL)
        alone = np.zeros(own.shape, dtype=np.bool_)
    else:
        alone = np.asarray((np.abs(own) < _LEVEL) | (np.abs(own - regained) < _LEVEL))
    return np.asarray(shared | alone), alone


def _together(
    base: FloatArray,
    worth: FloatArray,
    gain: FloatArray,
    kinds: tuple[BoolArray, BoolArray, BoolArray],
) -> tuple[FloatArray, BoolArray]:
    """Slopes such that the sum of the costates is level where a common control is partial.

    A configuration at its limit takes what the others leave: it stays there under any costate that
    falls less than the adjoint equation asks for. Where there is none all share it, by what effort
    is `worth` to them, (q, n).

    Returns
    -------
    base : (q, n, p) array
    even : (q, n) array of bool
        Whose slope was changed.
    """
    shared, alone, held = kinds
    able = np.asarray(held & ~alone)
    able = np.where(able.any(axis=0), able, ~alone) & shared
    weight = np.where(able, np.abs(worth) + 1e-12, 0.0)
    part = weight / np.maximum(weight.sum(axis=0), 1e-300) / gain[:, None]
    excess = (gain[:, None, None] * base).sum(axis=0)
    return base - part[:, :, None] * excess, np.asarray(able)


def _standing(hamiltonian: Hamiltonian) -> BoolArray:
    """Cells at whose end a plan all but stands, though not as the fastest run does, (q, n).

    The adjoint equation grows beyond all bounds there; the mean over the cell is as good as any.
    """
    problem, plan = hamiltonian.problem, hamiltonian.plan
    own = 0.5 * hamiltonian.fastest.at(problem.positions) ** 2
    found = (plan.z < 0.5 * _STANDING**2) & (plan.z < (1.0 - _AT_FASTEST) * own)
    return np.asarray(found[:, 1:] | found[:, :-1])


def _creep(
    problem: DiscreteProblem, fastest: Envelope, plan: Plan, first: FloatArray, last: FloatArray
) -> BoolArray:
    """Keep the costate level, in place, where a train starts or stops at its fastest.

    There any costate that falls less than the adjoint equation asks for leads to the same speed; by
    the equation it grows beyond all bounds towards a standstill.
    """
    own = 0.5 * fastest.at(problem.positions) ** 2
    free = (plan.z > 0.5 * _CREEPING**2) | (plan.z < (1.0 - _AT_FASTEST) * own)
    free |= own >= problem.ceiling * (1.0 - _AT_LIMIT)
    found = np.zeros(problem.shape, dtype=np.bool_)
    n = problem.shape[1]
    for row in np.flatnonzero(free[:, 1:-1].any(axis=1)).tolist():
        nodes = np.flatnonzero(free[row])
        if problem.initial == 0.0:
            begins = min(max(int(nodes[0]) - 1, 1), n - 1)
            found[row, :begins] = True
            first[row, :begins] = last[row, :begins] = first[row, begins]
        if problem.final == 0.0:
            ends = max(min(int(nodes[-1]) + 1, n - 1), 1)
            found[row, ends:] = True
            first[row, ends:] = last[row, ends:] = last[row, ends - 1]
    return found

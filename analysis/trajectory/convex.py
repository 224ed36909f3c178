"""What the quadratic programs and the cone relaxation share: unknowns, rows, limits, the solvers.

A program is written as sparse arrays at once, cell by cell, and given to CVXPY as one vector of
unknowns between its bounds: that saves most of the time that modelling with expressions takes.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from analysis.trajectory.problem import Problem

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SLOW = 0.2
"""Speeds below this are scaled as if they were this [m/s]."""


_SETTINGS: dict[str, dict[str, Any]] = {
    cp.PIQP: {
        "eps_abs": 1e-7,
        "eps_rel": 1e-8,
        "eps_duality_gap_rel": 1e-8,
        "max_iter": 150,
        # Regularised less, the last steps of programs of several configurations drown in
        # rounding, and the solver stands still.
        "reg_finetune_lower_limit": 1e-11,
    }
}
"""What the solvers stop at: beyond it the rounding of large programs makes some of them stall."""


BEYOND = "beyond the solver's arithmetic (numbers too far apart: check the lengths and the masses)"
"""Said where a solver breaks off; its own words speak of its settings."""


class NoSolutionError(Exception):
    """The solver's word when it is not a solution: infeasible, unbounded, or a failure."""


class Rows:
    """Linear equations or inequalities, collected entry by entry."""

    def __init__(self) -> None:
        self._entries: list[tuple[IntArray, IntArray, FloatArray]] = []
        self._right: list[FloatArray] = []
        self.count = 0

    def add(self, right: ArrayLike, *terms: tuple[IntArray, ArrayLike]) -> IntArray:
        """One row for each entry of `right`; of a term with one axis more, a row is its sum.

        Parameters
        ----------
        right : array
            Right-hand sides.
        *terms : (index of unknowns, coefficients)
            As large as `right`, or with one axis more.

        Returns
        -------
        array as `right`
            Numbers of the new rows.
        """
        values = np.asarray(right, dtype=np.float64)
        rows = self.count + np.arange(values.size).reshape(values.shape)
        for index, coefficients in terms:
            numbers = rows if index.ndim <= rows.ndim else rows[..., None]
            found = np.broadcast_arrays(numbers, index, np.asarray(coefficients, dtype=np.float64))
            self._entries.append(tuple(each.ravel() for each in found))  # type: ignore[arg-type]
        self._right.append(values.ravel())
        self.count += values.size
        return rows

    @property
    def right(self) -> FloatArray:
        """All right-hand sides, (rows,)."""
        return np.concatenate(self._right)

    def matrix(self, unknowns: int) -> sp.csc_array:
        """All coefficients, (rows, unknowns)."""
        row, column, value = (np.concatenate(each) for each in zip(*self._entries, strict=True))
        return sp.csc_array((value, (row, column)), shape=(self.count, unknowns))


class Unknowns:
    """Where the unknowns of a program stand in one vector, and their bounds.

    Attributes
    ----------
    z : (q, n + 1) array of int
        Of each program's own measure of ``z``.
    traction : (n,) array of int
    braking : (q, n) array of int
        With common braking every row is the same.
    dynamic : (q, n) array of int, or None where the dynamic brake need not be told apart
    regained : int or None
        The least energy that a configuration regains, where it counts.
    low, high : (size,) array
    """

    def __init__(self, problem: Problem) -> None:
        q, n = problem.shape
        self.low, self.high = np.empty(0), np.empty(0)
        self.z = self.more((q, n + 1))
        self.traction = self.more((n,), 0.0, problem.traction)
        rows = (1 if problem.common else q, n)
        self.braking = np.broadcast_to(self.more(rows, 0.0), (q, n))
        self.dynamic = self.more((q, n), 0.0, problem.dynamic) if tells_dynamic(problem) else None
        worst = problem.run.objective == "line"
        self.regained = int(self.more((1,))[0]) if worst else None

    @property
    def size(self) -> int:
        """How many there are."""
        return self.low.size

    def more(
        self, shape: tuple[int, ...], low: ArrayLike = -np.inf, high: ArrayLike = np.inf
    ) -> IntArray:
        """Indices of further unknowns between bounds."""
        index = self.size + np.arange(int(np.prod(shape))).reshape(shape)
        self.low = np.append(self.low, np.broadcast_to(low, shape))
        self.high = np.append(self.high, np.broadcast_to(high, shape))
        return index


@dataclass(frozen=True, eq=False)
class Found:
    """A solution: the unknowns, the duals of the rows, the least value, the solver's word."""

    unknowns: FloatArray
    equal: FloatArray
    below: FloatArray
    value: float
    status: str


def solve(
    unknowns: Unknowns,
    cost: FloatArray,
    equal: Rows,
    below: Rows,
    *,
    curvature: sp.csc_array | None = None,
    cones: Sequence[Any] = (),
    variable: cp.Variable | None = None,
) -> Found:
    """Minimise ``cost x + x curvature x / 2``, and accept nothing but a solution.

    Programs without cones go to PIQP, and to Clarabel where PIQP does not vouch for its answer.

    Raises
    ------
    NoSolutionError
        With the solver's word, or `BEYOND`.
    """
    x = bounded(unknowns) if variable is None else variable
    objective = cost @ x
    if curvature is not None:
        objective = objective + 0.5 * cp.quad_form(x, curvature, assume_PSD=True)
    equations = equal.matrix(unknowns.size) @ x == equal.right
    limits = below.matrix(unknowns.size) @ x <= below.right
    word = ""
    for solver in (cp.CLARABEL,) if cones else (cp.PIQP, cp.CLARABEL):
        program = cp.Problem(cp.Minimize(objective), [equations, limits, *cones])
        try:
            with warnings.catch_warnings():
                # The status says what the warning would, and the certificate carries it.
                warnings.filterwarnings("ignore", "Solution may be inaccurate", UserWarning)
                program.solve(solver=solver, **_SETTINGS.get(solver, {}))
        except cp.SolverError:
            word = BEYOND
            continue
        word = str(program.status)
        good = (cp.OPTIMAL,) if solver == cp.PIQP else (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
        if word in good and np.all(np.isfinite(x.value)):
            return Found(
                np.asarray(x.value),
                np.asarray(equations.dual_value),
                np.asarray(limits.dual_value),
                float(program.value),
                f"{solver} {word}",
            )
    raise NoSolutionError(word)


def bounded(unknowns: Unknowns) -> cp.Variable:
    """All unknowns as one variable of CVXPY, between their bounds."""
    return cp.Variable(unknowns.size, bounds=[unknowns.low, unknowns.high])


def energy_cost(problem: Problem, unknowns: Unknowns, below: Rows) -> tuple[FloatArray, Any]:
    """Eq. (9), energy at the wheel; or at the line: the expected, or the worst, eq. (1).

    Returns
    -------
    cost : (size,) array
    rows : (q,) array of int or None
        Rows whose duals weigh the configurations, where regained energy counts.
    """
    train, cost = problem.run.train, np.zeros(unknowns.size)
    cost[unknowns.traction] = problem.step
    if not problem.run.at_line:
        return cost, None
    cost[unknowns.traction] /= train.efficiency_traction
    if unknowns.regained is None:
        shares = problem.weights[:, None] * problem.step
        cost[unknowns.dynamic] = -train.efficiency_regeneration * shares
        return cost, None
    cost[unknowns.regained] = -train.efficiency_regeneration
    everyone = np.full(problem.shape[0], unknowns.regained)
    assert unknowns.dynamic is not None
    rows = below.add(np.zeros(everyone.size), (everyone, 1.0), (unknowns.dynamic, -problem.step))
    return cost, rows


def brake_limits(problem: Problem, unknowns: Unknowns, below: Rows, spare: FloatArray) -> None:
    """Eq. (7), and how dynamic and friction brake share the effort.

    Parameters
    ----------
    spare : (q, 1) array [m/s²]
        What the brake may do beyond its limits.
    """
    most = problem.braking + spare
    if problem.common:
        most = np.broadcast_to(most.min(axis=0), most.shape)
    unknowns.high[unknowns.braking] = most
    if unknowns.dynamic is not None:
        below.add(np.zeros(most.shape), (unknowns.dynamic, 1.0), (unknowns.braking, -1.0))
        below.add(problem.friction + spare, (unknowns.braking, 1.0), (unknowns.dynamic, -1.0))


def tells_dynamic(problem: Problem) -> bool:
    """Whether the dynamic brake must be told apart: for its energy, or for its power limit."""
    return problem.run.at_line or bool(np.any(problem.friction < problem.braking))


def power_cells(problem: Problem, power: float, most: FloatArray) -> NDArray[np.int64]:
    """Cells in which a power limit can be stricter than the effort limit `most`."""
    fastest = np.sqrt(2.0 * np.maximum(problem.ceiling[:-1], problem.ceiling[1:]))
    return np.flatnonzero(power / fastest < most)

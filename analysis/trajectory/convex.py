"""Convex programs: what they share, their solvers, and the convex relaxation of the problem.

A program is written as sparse arrays at once, cell by cell, and stated to CVXPY as one vector of
unknowns between its bounds: that saves most of the time that modelling with expressions takes. A
search solves many programs, each about the solution of the one before; CVXPY states the first of
all, the others give PIQP their arrays as they are.

In the relaxation each node has, next to ``z``, a speed ``w`` with ``w² <= 2 z``, and each cell a
time per metre ``tau`` with ``tau (w + w') / 2 >= 1``; both are second-order cones that stay
regular at standstill. The linear part of the running resistance acts on ``w``, and the power limit
reads ``u <= power tau``. Every feasible trajectory of the discretised problem satisfies all of it,
so none needs less than the minimum; nor is ``w`` below the chord of ``sqrt(2 z)`` up to the limit.
What is lost is small where time is worth something: the power limit sees a cell's mean speed, where
the trajectory has to keep it at the faster end.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np
import piqp
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter1d

from analysis.trajectory.discretisation import SPARE, Bounds, Curves, DiscreteProblem, Plan
from analysis.trajectory.rollout import dynamic_share
from trainlog.arrays import BoolArray, FloatArray, IntArray

SLOW = 0.2
"""Speeds below this are scaled as if they were this [m/s]."""


_SETTINGS: dict[str, Any] = {
    "eps_abs": 1e-7,
    "eps_rel": 1e-8,
    "eps_duality_gap_rel": 1e-8,
    "max_iter": 150,
    # Regularised less, the last steps of programs of several configurations drown in
    # rounding, and the solver stands still.
    "reg_finetune_lower_limit": 1e-11,
}
"""What PIQP stops at: beyond it the rounding of large programs makes it stall."""

_ABOUT_SETTINGS: dict[str, Any] = {
    "eps_abs": 1e-8,
    "eps_rel": 1e-6,
    "max_iter": 60,
    "kkt_solver": piqp.KKTSolver.sparse_ldlt_ineq_cond,
}
"""What PIQP stops at where any numbers do: more steps come closer, but for more time."""

_ENERGY_SETTINGS = {"tol_gap_abs": 1e-6, "tol_gap_rel": 1e-6, "tol_feas": 1e-7}
"""What Clarabel stops at where the multipliers give a bound: closer ones do not raise it."""

_LONGEST = 15.0
"""Time after which a program with cones is given up [s]: it has no inside, or nearly none."""

_FEW = 2_000
"""Unknowns up to which a program is solved as a whole whatever is known of its optimum."""

_AT_BOUND, _AROUND_CELLS = 1e-4, 6
"""Part of its range within which an effort counts as at a bound; and to how many cells on either
side the same has to apply."""

_NEAR_BOUND, _NEAR_ROW, _NEAR_EFFORT, _DENSE = 2.0, 0.2, 0.02, 4
"""Distances within which bounds of the speed count, relative, and rows: part of their right-hand
side, and effort [m/s²]. Rows of more entries count always."""

_FEW_NEAR = 4
"""Configurations up to which bounds are left out: of more so little can be left out that one whole
program takes less time than several that follow one another."""

_ROUNDS, _EXCEEDED, _LOST, _PART_LOST, _MOST_LOST = 3, 1e-7, 3e-7, 0.03, 1e-3
"""How often what was fixed or left out wrongly is added; by how much bounds and rows may be
exceeded; what fixed efforts may cost, relative, of what the last program changed, and at most."""

_ROUNDING = 1e-9
"""By which rounding may have a lower bound exceed the upper one."""

SOLVER_FAILED = (
    "beyond the solver's arithmetic (numbers too far apart: check the lengths and the masses)"
)
"""Reported where a solver breaks off; its own message is about its settings."""


class NoSolutionError(Exception):
    """The solver's status where it found no solution: infeasible, unbounded, or a failure."""


class OutOfTimeError(Exception):
    """The time that a search may take is over; with what was found so far, if anything."""

    def __init__(self, found: Any = None) -> None:
        super().__init__("time limit")
        self.found = found


_Optimum = tuple[FloatArray, FloatArray, FloatArray]
"""The unknowns, and the duals of equations and of inequalities."""

_DEADLINE = ContextVar("deadline", default=np.inf)

_PACE, _SPENT = ContextVar("pace", default=0.0), ContextVar("spent", default=0.0)
"""Time of the last program per unknown [s], by the clock and of the processor."""

_WORKED = ContextVar("worked", default=0.0)
"""Processor time that programs have taken so far [s]."""

_STATED = ContextVar("stated", default=False)
"""Whether CVXPY has stated a program: then the others are given to PIQP as they are."""


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Start no program in here that would not end within so many seconds; None: no limit."""
    token = _DEADLINE.set(np.inf if seconds is None else time.monotonic() + seconds)
    try:
        yield
    finally:
        _DEADLINE.reset(token)


def worked() -> float:
    """Processor time of programs and bounds so far [s]; what is compiled once does not count."""
    return _WORKED.get()


def spent() -> float:
    """Processor time that the last program took per unknown [s]."""
    return _SPENT.get()


def time_left() -> float:
    """Time that is left [s]; not positive where it is over."""
    return float(_DEADLINE.get() - time.monotonic())


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
        found = sp.csc_array((value, (row, column)), shape=(self.count, unknowns))
        found.eliminate_zeros()
        return found


class Numbering:
    """Where unknowns stand in one vector, and their bounds.

    Attributes
    ----------
    low, high : (size,) array
    """

    def __init__(self) -> None:
        self.low, self.high = np.empty(0), np.empty(0)

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


class Unknowns(Numbering):
    """Those of a program of a search.

    Attributes
    ----------
    z : (q, n + 1) array of int
        Of each program's own measure of ``z``.
    traction : (n,) array of int
    braking : (q, n) array of int
        With common braking every row is the same.
    dynamic : (q, n) array of int, or None where the dynamic brake needs no effort of its own
    regained : int or None
        The least energy that a configuration regains, where it counts.
    """

    def __init__(self, problem: DiscreteProblem) -> None:
        super().__init__()
        q, n = problem.shape
        self.z = self.more((q, n + 1))
        self.traction = self.more((n,), 0.0, problem.traction)
        rows = (1 if problem.common else q, n)
        self.braking = np.broadcast_to(self.more(rows, 0.0), (q, n))
        self.dynamic = (
            self.more((q, n), 0.0, problem.dynamic) if separates_dynamic_brake(problem) else None
        )
        worst = problem.run.objective == "line"
        self.regained = int(self.more((1,))[0]) if worst else None

    @property
    def efforts(self) -> tuple[IntArray, IntArray]:
        """Of the traction, (1, 1, n), and of each configuration's brakes, (1 or 2, q, n)."""
        brakes = (self.braking,) if self.dynamic is None else (self.braking, self.dynamic)
        return self.traction[None, None], np.stack(brakes)


@dataclass(frozen=True, eq=False)
class ProgramSolution:
    """A solution: the unknowns, the duals of the rows, the least value, the solver's status.

    `loose` are unknowns at a bound that a closer solution would move off it.
    """

    unknowns: FloatArray
    equal: FloatArray
    below: FloatArray
    value: float
    status: str
    loose: BoolArray | bool = False


class Near(NamedTuple):
    """A point that is likely to be near an optimum; it costs nothing but time where it is not.

    Attributes
    ----------
    point : (size,) array
    loose : (size,) array of bool, or False
        What is not to stay at its bound there.
    changed : float
        By which the last program changed its value, relative: the answer may lose a small part.
    """

    point: FloatArray
    loose: BoolArray | bool
    changed: float


@contextmanager
def work() -> Iterator[None]:
    """Count the processor time that a program or a bound takes; see `worked`."""
    begun = time.process_time()
    try:
        yield
    finally:
        _WORKED.set(_WORKED.get() + time.process_time() - begun)


@work()
def solve(
    unknowns: Unknowns,
    cost: FloatArray,
    equal: Rows,
    below: Rows,
    *,
    curvature: sp.csc_array | None = None,
    cones: Sequence[Any] = (),
    variable: cp.Variable | None = None,
    near: Near | None = None,
    settings: dict[str, float] | None = None,
) -> ProgramSolution:
    """Minimise ``cost x + x curvature x / 2``, and accept nothing but a solution.

    Programs without cones go to PIQP, and to Clarabel where PIQP does not end with an optimum.

    Parameters
    ----------
    near : Near, optional
    settings : dict, optional
        Of Clarabel.

    Raises
    ------
    NoSolutionError
        With the solver's status, or `SOLVER_FAILED`.
    OutOfTimeError
        If no time is left.
    """
    # PIQP cannot be stopped, Clarabel can.
    if time_left() <= (0.0 if cones else _PACE.get() * unknowns.size):
        raise OutOfTimeError
    begin, stated = time.monotonic(), not cones and _STATED.get()
    if stated:
        found = _by_piqp(unknowns, cost, equal, below, curvature, near)
        _PACE.set((time.monotonic() - begin) / unknowns.size)
        if found is not None:
            return found
    x = bounded(unknowns) if variable is None else variable
    objective = cost @ x
    if curvature is not None:
        objective = objective + 0.5 * cp.quad_form(x, curvature, assume_PSD=True)
    equations = equal.matrix(unknowns.size) @ x == equal.right
    limits = below.matrix(unknowns.size) @ x <= below.right
    program = cp.Problem(cp.Minimize(objective), [equations, limits, *cones])
    status = ""
    for solver in (cp.CLARABEL,) if cones or stated else (cp.PIQP, cp.CLARABEL):
        begin, left = time.monotonic(), time_left()
        if left <= 0.0:
            raise OutOfTimeError
        own = _SETTINGS
        if solver == cp.CLARABEL:
            own = {"time_limit": min(left, _LONGEST), **(settings or {})}
        try:
            with warnings.catch_warnings():
                # The status states what the warning would, and the certificate carries it.
                warnings.filterwarnings("ignore", "Solution may be inaccurate", UserWarning)
                program.solve(solver=solver, **own)
        except (cp.SolverError, ValueError, ArithmeticError):
            # Numbers that are none, or too large, are refused before any solver runs.
            status = SOLVER_FAILED
            continue
        if not cones:
            _PACE.set((time.monotonic() - begin) / unknowns.size)
        status = str(program.status)
        good = (cp.OPTIMAL,) if solver == cp.PIQP else (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
        if status in good and np.all(np.isfinite(x.value)):
            _STATED.set(_STATED.get() or not cones)
            return ProgramSolution(
                np.asarray(x.value),
                np.asarray(equations.dual_value),
                np.asarray(limits.dual_value),
                float(program.value),
                f"{solver} {status}",
            )
    if time_left() <= 0.0:
        raise OutOfTimeError
    raise NoSolutionError(status)


class _Program(NamedTuple):
    """Minimise ``c x + x P x / 2`` where ``A x = b``, ``G x <= h_u`` and ``x_l <= x <= x_u``."""

    P: sp.csc_array
    c: FloatArray
    A: sp.csc_array
    b: FloatArray
    G: sp.csc_array
    h_u: FloatArray
    x_l: FloatArray
    x_u: FloatArray

    def solved(self, settings: dict[str, Any]) -> tuple[Any, Any]:
        """PIQP's status and result."""
        solver = piqp.SparseSolver()
        for name, value in settings.items():
            setattr(solver.settings, name, value)
        solver.setup(**self._asdict())
        return solver.solve(), solver.result

    def optimum(self) -> _Optimum | None:
        """By PIQP; None if it finds none."""
        busy = time.process_time()
        # Rounding of the factors alone makes it call some programs unbounded; none is.
        for refined in (False, True):
            status, result = self.solved(
                {"iterative_refinement_always_enabled": refined, **_SETTINGS}
            )
            if status in (piqp.PIQP_SOLVED, piqp.PIQP_PRIMAL_INFEASIBLE):
                break
        _SPENT.set((time.process_time() - busy) / self.c.size)
        x = np.clip(result.x, self.x_l, self.x_u)
        if status != piqp.PIQP_SOLVED or not np.all(np.isfinite(x)):
            return None
        return x, np.array(result.y), np.array(result.z_u)

    def value(self, x: FloatArray) -> float:
        """What is minimised."""
        return float(self.c @ x + 0.5 * (x @ (self.P @ x)))

    def optimum_near(
        self, near: Near, efforts: Sequence[IntArray], z: IntArray
    ) -> tuple[_Optimum, BoolArray] | None:
        """The same, where a point near the optimum shows most of the bounds that it is at.

        Efforts at a bound there, in the cells around too, stay at it; other bounds and rows that
        are far away are left out. The optimum of what remains is checked: reduced costs bound what
        fixed efforts cost, and what is exceeded or costs anything is added.

        Parameters
        ----------
        near : Near
        efforts : sequence of (k, q, n) array of int
            Of k efforts in the same cells, which are fixed together.
        z : (q, n + 1) array of int

        Returns
        -------
        tuple of _Optimum and (size,) array of bool, or None
            And the efforts that stayed at their bounds, though they cost a little there. None if
            there is no optimum, or it is not the whole program's after some rounds.
        """
        low, high, width = self.x_l, self.x_u, self.x_u - self.x_l
        rows, sizes, positive = self.G.tocsr(), abs(self.G).tocsr(), self.G.tocsr().maximum(0.0)
        # Of many, all but what has one value: a traction that is given couples them.
        side, bounded, kept = (
            np.zeros(low.size),
            np.full(low.size, True),
            np.full(rows.shape[0], True),
        )
        if z.shape[0] <= _FEW_NEAR:
            point = near.point
            for sign, away in ((-1.0, point - low), (1.0, high - point)):
                apart = near.loose | (away > _AT_BOUND * width)
                for each in efforts:
                    side[each[:, ~_widened(np.any(apart[each], axis=0))]] = sign
            bounded = np.minimum(point - low, high - point) < _NEAR_BOUND
            bounded[np.concatenate([each.ravel() for each in efforts])] = True
            kept = self.h_u - rows @ point < _NEAR_ROW * np.abs(self.h_u) + _NEAR_EFFORT
            kept |= np.diff(rows.indptr) > _DENSE
        enough = min(max(_LOST, _PART_LOST * near.changed), _MOST_LOST)
        for _ in range(_ROUNDS):
            fixed = (side != 0.0) | (width <= 0.0)
            x, free = np.where(fixed, np.where(side > 0.0, high, low), 0.0), np.flatnonzero(~fixed)
            open_ = sizes @ ~fixed > 0.0
            some = kept & open_
            found = _Program(
                self.P[:, free][free],
                (self.c + self.P @ x)[free],
                self.A[:, free],
                self.b - self.A @ x,
                rows[some][:, free].tocsc(),
                (self.h_u - rows @ x)[some],
                np.where(bounded, low, -np.inf)[free],
                np.where(bounded, high, np.inf)[free],
            ).optimum()
            if found is None:
                return None
            below = np.zeros(kept.size)
            x[free], y, below[some] = found
            over = rows @ x - self.h_u
            reduced = self.c + self.P @ x + self.A.T @ y + self.G.T @ below
            # A row between efforts that are all fixed has the dual that the one at 0 needs.
            tight = ~open_ & (over > -_EXCEEDED)
            below[tight] = positive[tight] @ np.where(side < 0.0, np.maximum(-reduced, 0.0), 0.0)
            reduced += self.G.T @ np.where(tight, below, 0.0)
            wrong = side * reduced > 0.0
            outside = ~bounded & (np.maximum(low - x, x - high) > _EXCEEDED)
            exceeded = ~some & (over > _EXCEEDED)
            lost = float(np.abs(reduced[wrong]) @ width[wrong])
            if not (outside.any() or exceeded.any()) and lost <= enough * abs(self.value(x)):
                return (x, y, below), wrong
            for each in efforts:
                side[each[:, _widened(np.any(wrong[each], axis=0))]] = 0.0
            bounded[z[_widened(outside[z])]] = True
            kept |= _widened(exceeded)
        return None


def optimum_about(
    unknowns: Numbering,
    curvature: sp.csc_array,
    cost: FloatArray,
    equal: Rows,
    below: Sequence[Rows],
) -> FloatArray | None:
    """About where ``cost x + x curvature x / 2`` is least, by PIQP; None if it breaks off.

    For what is right with any numbers, and the better the closer they are.
    """
    size = unknowns.size
    limits = sp.vstack([each.matrix(size) for each in below]).tocsc()
    right = np.concatenate([each.right for each in below])
    equations = equal.matrix(size), equal.right
    program = _Program(curvature, cost, *equations, limits, right, unknowns.low, unknowns.high)
    status, result = program.solved(_ABOUT_SETTINGS)
    found = np.array(result.x)
    ended = status in (piqp.PIQP_SOLVED, piqp.PIQP_MAX_ITER_REACHED)
    return found if ended and np.all(np.isfinite(found)) else None


def _widened(marked: BoolArray) -> BoolArray:
    """What is marked along the last axis, and the cells around."""
    return np.asarray(maximum_filter1d(marked, 2 * _AROUND_CELLS + 1, mode="constant"))


def _by_piqp(
    unknowns: Unknowns,
    cost: FloatArray,
    equal: Rows,
    below: Rows,
    curvature: sp.csc_array | None,
    near: Near | None,
) -> ProgramSolution | None:
    """The optimum of a program as CVXPY has stated one before; None if PIQP finds none."""
    _settle_bounds(unknowns)
    size = unknowns.size
    program = _Program(
        sp.csc_array((size, size)) if curvature is None else curvature,
        cost,
        equal.matrix(size),
        equal.right,
        below.matrix(size),
        below.right,
        unknowns.low,
        unknowns.high,
    )
    entries = (value.data if sp.issparse(value) else value for value in program[:6])
    if not all(np.all(np.isfinite(each)) for each in entries):
        return None
    found: _Optimum | None = None
    loose: BoolArray | bool = False
    if near is not None and size > _FEW:
        found, loose = program.optimum_near(near, unknowns.efforts, unknowns.z) or (found, loose)
    found = found or program.optimum()
    if found is None:
        return None
    return ProgramSolution(*found, program.value(found[0]), "PIQP optimal", loose)


def bounded(unknowns: Unknowns) -> cp.Variable:
    """All unknowns as one variable of CVXPY, between their bounds.

    Raises
    ------
    NoSolutionError
        If bounds exclude each other by more than rounding, or are no numbers.
    """
    _settle_bounds(unknowns)
    return cp.Variable(unknowns.size, bounds=[unknowns.low, unknowns.high])


def _settle_bounds(unknowns: Unknowns) -> None:
    """Lift upper bounds that rounding has put below the lower ones; others are refused."""
    apart = unknowns.low - unknowns.high
    if not np.all(apart <= _ROUNDING):
        raise NoSolutionError("infeasible")
    unknowns.high = np.maximum(unknowns.low, unknowns.high)


def energy_cost(
    problem: DiscreteProblem, unknowns: Unknowns, below: Rows
) -> tuple[FloatArray, Any]:
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


def brake_limits(
    problem: DiscreteProblem, unknowns: Unknowns, below: Rows, spare: FloatArray
) -> None:
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


def separates_dynamic_brake(problem: DiscreteProblem) -> bool:
    """Whether the dynamic brake needs an effort of its own: for its energy, or its power limit."""
    return problem.run.at_line or bool(np.any(problem.friction < problem.braking))


def power_cells(problem: DiscreteProblem, power: float, most: FloatArray) -> IntArray:
    """Cells in which a power limit can be stricter than the effort limit `most`."""
    ceiling = np.maximum(problem.ceiling[:-1], problem.ceiling[1:])
    # Cells so long that nothing can pass them have a ceiling below 0.
    return np.flatnonzero(power < most * np.sqrt(2.0 * np.maximum(ceiling, 0.0)))


@dataclass(frozen=True, eq=False)
class Multipliers:
    """Lagrange multipliers of an optimum, per unit reference inertia.

    Attributes
    ----------
    pull : (q, n) array
        Of the motion through a cell, times what the common effort does to it: energy that a unit
        of effort is worth in the cell. Its sum over the configurations is ``step · switching``.
    time : (q,) array [J/(kg s)]
        Of the running time.
    passing : (q, p) array [J/(kg s)]
        Of the latest times at the passing points.
    opening : (q, p) array [J/(kg s)]
        Of the earliest times there.
    power, dynamic_power : (q, n) array
        Of the limits of power, both ends of a cell together.
    share : (q,) array
        Of the energy that is regained; it weighs the configurations, the worst alone as a rule.
    """

    pull: FloatArray
    time: FloatArray
    passing: FloatArray
    opening: FloatArray
    power: FloatArray
    dynamic_power: FloatArray
    share: FloatArray

    def cell_prices(self, problem: DiscreteProblem) -> FloatArray:
        """What a second in each cell is worth: that of all it makes late, (q, n) [J/(kg s)].

        Less than nothing where the train must lose time, before a point not to be passed earlier.
        """
        before = np.arange(problem.shape[1]) < problem.passed[:, None]
        return np.asarray(self.time[:, None] + (self.passing - self.opening) @ before)

    def select(self, rows: Sequence[int]) -> Multipliers:
        """Those of some of the configurations."""
        chosen = list(rows)
        return Multipliers(**{name: values[chosen] for name, values in vars(self).items()})

    def convex(self) -> Multipliers:
        """The same with no more on the earliest times than leaves every second worth something.

        ``t(point) >= earliest`` is not convex, but with ``t(end) <= T`` it means that the rest
        takes at most ``T - earliest``, which is: price on price, the Lagrange function is the
        same as long as no cell's price is negative.
        """
        left, opening = self.time.copy(), self.opening.copy()
        for point in range(opening.shape[1] - 1, -1, -1):
            left += self.passing[:, point]
            opening[:, point] = np.minimum(opening[:, point], left)
            left -= opening[:, point]
        return replace(self, opening=opening)


_AROUND = (0.7, 0.85, 0.93, 1.0, 1.07, 1.15)
"""Times the speeds, at which the relaxation bounds a curve of effort."""

_ALIKE = 0.1
"""Width of the classes of speed in each of which a curve has one bound [m/s]."""

_MEAN_SPEED = SPARE
"""By which a cell's mean speed may exceed the mean of its ends [m/s]; the brake absorbs it."""


@dataclass(frozen=True, eq=False)
class Relaxed:
    """Minimum of the relaxation.

    Attributes
    ----------
    plan : Plan
        Feasible but for the power limit, by the change of speed over a cell.
    multipliers : Multipliers
    time_price : (q,) array [J/(kg s)]
    status : str
        The solver's status.
    """

    plan: Plan
    multipliers: Multipliers
    time_price: FloatArray
    status: str


_OVER_PROGRAM = 5.0
"""Times the time that a program without cones takes per unknown."""

_REACH = 1e-3
"""By which a configuration's fastest run may be slower than another run of it, relative."""


def relaxation_seconds(problem: DiscreteProblem) -> float:
    """About how long the relaxation takes, by how long the last program of a search took [s]."""
    q, n = problem.shape
    return _OVER_PROGRAM * _SPENT.get() * (Unknowns(problem).size + q * (2 * n + 1) + 1)


class Relaxation:
    """The relaxed problem, scaled by speeds.

    Parameters
    ----------
    problem : DiscreteProblem
    speeds : (q, n + 1) array [m/s]
        Of the fastest run of each configuration; they scale the variables, and bounds of curves of
        effort need not hold beyond.
    slowest : (q, n + 1) array, optional [m/s]
        Speeds below which no trajectory in time is.
    """

    def __init__(
        self, problem: DiscreteProblem, speeds: FloatArray, slowest: FloatArray | None = None
    ) -> None:
        q, n = problem.shape
        self.problem = problem
        # Without curves nothing rests on it, and other speeds may be given.
        curved = problem.curves is not None or problem.dynamic_curves is not None
        self.fastest = speeds * (1.0 + _REACH) + _REACH if curved else np.full((q, n + 1), np.inf)
        self.scale = np.maximum(speeds, SLOW)
        self.total = self.scale[:, :-1] + self.scale[:, 1:]
        self.unknowns = Unknowns(problem)  # z over scale² / 2
        self.w = self.unknowns.more((q, n + 1))  # speed over scale
        self.tau = self.unknowns.more((q, n))  # time per metre, times the mean of the scales
        self.longest = int(self.unknowns.more((1,))[0])
        self.equal, self.below = Rows(), Rows()
        self.motion, self.pull = self._motion()
        if slowest is not None:
            self._keep_between(slowest, speeds * (1.0 + _REACH) + _REACH)
        # The resistance acts on the mean of a cell's end speeds, which the true mean slightly
        # exceeds; the brake gets that much more, so that no trajectory is excluded.
        spare = _MEAN_SPEED * (problem.drag1 / problem.gain)[:, None]
        brake_limits(problem, self.unknowns, self.below, spare)
        self.pulled: list[tuple[int, IntArray, IntArray]] = []
        self.braked: list[tuple[int, IntArray, IntArray]] = []
        self._power()
        self.cost, self.shares = energy_cost(problem, self.unknowns, self.below)
        last = np.full(q, self.longest)
        seconds = 2.0 * problem.step / self.total
        self.arrival = self.below.add(np.zeros(q), (self.tau, seconds), (last, -1.0))
        self.passing = {
            number: self.below.add(
                np.full(q, problem.latest[number]), (self.tau[:, :node], seconds[:, :node])
            )
            for number, node in enumerate(problem.passed.tolist())
            if problem.latest[number] < np.inf
        }
        # Not before a time, and at the end by another: the rest takes no more than what is left.
        self.opening = {
            number: self.below.add(
                np.full(q, -problem.earliest[number]),
                (self.tau[:, node:], seconds[:, node:]),
                (last, -1.0),
            )
            for number, node in enumerate(problem.passed.tolist())
            if problem.earliest[number] > -np.inf
        }

    def least_energy(self, running_time: float) -> Relaxed:
        """Minimise the worst-case energy within `running_time` [s].

        Raises
        ------
        NoSolutionError
            If there is no such trajectory, which proves that the problem has none either.
        """
        problem, unknowns = self.problem, self.unknowns
        unknowns.high[self.longest] = running_time
        found = self._solved(self.cost, _ENERGY_SETTINGS)
        z = np.maximum(0.5 * self.scale**2 * found.unknowns[unknowns.z], 0.0)
        traction = np.maximum(found.unknowns[unknowns.traction], 0.0)
        braking = np.maximum(found.unknowns[unknowns.braking], 0.0)
        plan = Plan(z, traction, braking, dynamic_share(problem, z, braking))
        multipliers = self._multipliers(found)
        price = multipliers.time + multipliers.passing.sum(axis=1)
        return Relaxed(plan, multipliers, np.asarray(price), found.status)

    def _multipliers(self, found: ProgramSolution) -> Multipliers:
        """The duals of its rows, in the measures of the problem."""
        problem, duals = self.problem, np.maximum(found.below, 0.0)
        points = (problem.shape[0], problem.passed.size)
        passing, opening = np.zeros(points), np.zeros(points)
        for number, rows in self.passing.items():
            passing[:, number] = duals[rows]
        for number, rows in self.opening.items():
            opening[:, number] = duals[rows]
        power, dynamic_power = np.zeros(problem.shape), np.zeros(problem.shape)
        for limits, into in ((self.pulled, power), (self.braked, dynamic_power)):
            for row, at, rows in limits:
                into[row, at] += duals[rows]
        return Multipliers(
            pull=found.equal[self.motion] * self.pull,
            # What is left of the way from a point takes no more than what is left of the time.
            time=duals[self.arrival] + opening.sum(axis=1),
            passing=passing,
            opening=opening,
            power=power,
            dynamic_power=dynamic_power,
            share=problem.weights if self.shares is None else duals[self.shares],
        )

    def least_time(self) -> float:
        """No trajectory takes less time than this [s], whatever its energy.

        Raises
        ------
        NoSolutionError
            If no trajectory exists for any time.
        """
        self.unknowns.high[self.longest] = np.inf
        time = np.zeros(self.unknowns.size)
        time[self.longest] = 1.0
        return self._solved(time).value

    def least_end(self, running_time: float) -> float:
        """No trajectory within `running_time` [s] ends slower than at this ``z`` [m²/s²].

        To be asked once, and where the speed at the end is left free.

        Raises
        ------
        NoSolutionError
            If no trajectory exists in that time, or the solver does not settle.
        """
        self.unknowns.high[self.longest] = running_time
        half, highest = 0.5 * self.scale[:, -1] ** 2, int(self.unknowns.more((1,), 0.0)[0])
        each = np.full(half.size, highest)
        self.below.add(np.zeros(half.size), (self.unknowns.z[:, -1], half), (each, -half.max()))
        cost = np.zeros(self.unknowns.size)
        cost[highest] = 1.0
        return self._solved(cost).value * float(half.max())

    def _solved(
        self, cost: FloatArray, settings: dict[str, float] | None = None
    ) -> ProgramSolution:
        x = bounded(self.unknowns)
        return solve(
            self.unknowns,
            cost,
            self.equal,
            self.below,
            cones=self._cones(x),
            variable=x,
            settings=settings,
        )

    def _motion(self) -> tuple[IntArray, FloatArray]:
        """Eq. (2) over a cell, exact for the quadratic resistance; rows scaled by the speed.

        Returns the rows, and what a unit of effort does in each.
        """
        problem, step, unknowns = self.problem, self.problem.step, self.unknowns
        z, w = unknowns.z, self.w
        decay = 2.0 * problem.drag2 * step
        mean = np.where(np.abs(decay) > 1e-9, -np.expm1(-decay) / np.where(decay, decay, 1.0), 1.0)
        row = 1.0 / self.scale[:, 1:]
        push, half = step * mean * row, 0.5 * self.scale**2
        ceiling = np.append(problem.ceiling[:-1], problem.final_ceiling)
        linear, pull = 0.5 * push * problem.drag1[:, None], push * problem.gain[:, None]
        rows = self.equal.add(
            -push * problem.mean_drag0,
            (z[:, 1:], half[:, 1:] * row),
            (z[:, :-1], -half[:, :-1] * np.exp(-decay) * row),
            (np.broadcast_to(unknowns.traction, push.shape), -pull),
            (unknowns.braking, pull),
            (w[:, :-1], linear * self.scale[:, :-1]),
            (w[:, 1:], linear * self.scale[:, 1:]),
        )
        unknowns.high[z[:, 1:]] = (np.minimum(ceiling, 0.5 * self.fastest**2) / half)[:, 1:]
        unknowns.low[z[:, 1:]] = (problem.floor / half)[:, 1:]
        unknowns.low[w[:, 1:]] = (np.sqrt(2.0 * problem.floor) / self.scale)[:, 1:]
        unknowns.low[z[:, 0]] = unknowns.high[z[:, 0]] = problem.initial / half[:, 0]
        speed = np.sqrt(2.0 * problem.initial) / self.scale[:, 0]
        unknowns.low[w[:, 0]] = unknowns.high[w[:, 0]] = speed
        # No speed is below its square over the limit: z's chord, where w² <= 2 z leaves it free.
        limited = np.flatnonzero(ceiling > 0.0)[1:]
        shares = self.scale[:, limited] / np.sqrt(2.0 * ceiling[limited])
        self.below.add(np.zeros(shares.shape), (z[:, limited], shares), (w[:, limited], -1.0))
        if self._stops:
            unknowns.low[z[:, -1]] = unknowns.low[w[:, -1]] = unknowns.high[w[:, -1]] = 0.0
        return rows, pull

    def _keep_between(self, slowest: FloatArray, fastest: FloatArray) -> None:
        """No speed beyond these: so its square and the time per metre are below their chords."""
        z, w, tau, scale = self.unknowns.z[:, 1:-1], self.w[:, 1:-1], self.tau, self.scale
        low, high = slowest[:, 1:-1] / scale[:, 1:-1], fastest[:, 1:-1] / scale[:, 1:-1]
        self.unknowns.low[z] = np.maximum(self.unknowns.low[z], low**2)
        self.below.add(-low * high, (z, 1.0), (w, -low - high))
        least = np.minimum(slowest[:, :-1], slowest[:, 1:])
        most = np.maximum(fastest[:, :-1], fastest[:, 1:])
        row, cell = np.nonzero(least > 0.0)
        low, high = least[row, cell], most[row, cell]
        half = 0.5 * low * high
        self.below.add(
            low + high,
            (tau[row, cell], half * 4.0 / self.total[row, cell]),
            (self.w[row, cell], 0.5 * scale[row, cell]),
            (self.w[row, cell + 1], 0.5 * scale[row, cell + 1]),
        )

    @property
    def _stops(self) -> bool:
        """At standstill the cone has no inside; such a node has speed 0 instead."""
        return self.problem.final_ceiling == 0.0 and not self.problem.common

    def _cones(self, x: cp.Variable) -> list[Any]:
        """``w² <= z`` at the nodes, and ``tau`` times the mean speed of a cell at least 1."""
        n = self.problem.shape[1]
        last = n if self._stops else n + 1
        squares = x[self.unknowns.z[:, 1:last].ravel()]
        speeds = x[self.w[:, 1:last].ravel()]
        q = self.w.shape[0]
        mean = Rows()
        mean.add(
            np.zeros((q, n)),
            (self.w[:, :-1], self.scale[:, :-1] / self.total),
            (self.w[:, 1:], self.scale[:, 1:] / self.total),
        )
        means, taus = mean.matrix(self.unknowns.size) @ x, x[self.tau.ravel()]
        return [
            cp.SOC(squares + 1.0, cp.vstack([2.0 * speeds, squares - 1.0]), axis=0),
            cp.SOC(taus + means, cp.vstack([taus - means, np.full(q * n, 2.0)]), axis=0),
        ]

    def _power(self) -> None:
        """Eq. (5), with the cell's time per metre in the place of ``1 / v``; so with the curves."""
        problem, unknowns, inverse = self.problem, self.unknowns, 2.0 / self.total
        for a in range(problem.shape[0]):
            self.pulled += self._tangents(problem.curves, a, unknowns.traction)
            if unknowns.dynamic is not None:
                self.braked += self._tangents(problem.dynamic_curves, a, unknowns.dynamic[a])
        for a, power in enumerate(problem.power):
            limits = [(self.pulled, unknowns.traction, float(power), problem.traction)]
            if unknowns.dynamic is not None:
                own = unknowns.dynamic[a], problem.dynamic_power, problem.dynamic[a]
                limits.append((self.braked, *own))
            for into, effort, most, ceiling in limits:
                at = power_cells(problem, most, ceiling)
                terms = (effort[at], 1.0), (self.tau[a, at], -most * inverse[a, at])
                into.append((a, at, self.below.add(np.zeros(at.size), *terms)))

    def _tangents(
        self, curves: Curves | None, row: int, effort: IntArray
    ) -> list[tuple[int, IntArray, IntArray]]:
        """Bounds of a curve's effort, ``offset + power / v``, tangent at the speeds and around."""
        if curves is None:
            return []
        found = []
        speeds = 0.5 * self.total[row]
        inverse = 1.0 / speeds
        reach = np.maximum(self.fastest[row, :-1], self.fastest[row, 1:])
        for factor in _AROUND:
            at = np.maximum(np.minimum(factor * speeds, reach), SLOW)
            # Cells of nearly the same speed share a bound.
            near = np.column_stack((np.round(at / _ALIKE), np.ceil(reach / _ALIKE)))
            few, own = np.unique(np.maximum(near, 1.0), axis=0, return_inverse=True)
            bound = Bounds(*(each[own] for each in curves.bounds(row, *(_ALIKE * few).T)))
            half = -0.5 * bound.slope
            rows = self.below.add(
                bound.offset,
                (effort, 1.0),
                (self.tau[row], -bound.power * inverse),
                (self.w[row, :-1], half * self.scale[row, :-1]),
                (self.w[row, 1:], half * self.scale[row, 1:]),
                (self.unknowns.z[row, :-1], -0.25 * bound.square * self.scale[row, :-1] ** 2),
                (self.unknowns.z[row, 1:], -0.25 * bound.square * self.scale[row, 1:] ** 2),
            )
            found.append((row, np.arange(effort.size), rows))
        return found

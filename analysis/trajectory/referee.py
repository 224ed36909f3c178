"""A second result: the same transcription as one nonlinear program, solved by CasADi and IPOPT.

It shares cells, Runge-Kutta sub-steps and limits with the optimiser, but neither its linearisation
nor its solver. ``trainlog plan --set referee=yes`` states what it finds beside the certificate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from analysis.trajectory.convex import power_cells, separates_dynamic_brake
from analysis.trajectory.discretisation import (
    Curves,
    DiscreteProblem,
    Plan,
    discretise,
    taper_along,
)
from analysis.trajectory.problem import TrajectoryProblem
from analysis.trajectory.rollout import paced_run
from analysis.trajectory.sqp import least_z
from trainlog.arrays import FloatArray
from trainlog.railway import Trajectory
from trainlog.railway.motion import SUBSTEPS

_ROUNDED = 1e-8
"""Added to ``v²`` under the root, so that its slope is finite at standstill [m²/s²]."""

LONGEST = 60.0
"""Processor time after which IPOPT is stopped [s]."""


@dataclass(frozen=True, eq=False)
class IpoptResult:
    """What IPOPT found.

    Attributes
    ----------
    energy : float [J/kg]
        Worst case, per unit reference inertia.
    z : (q, n + 1) array [m²/s²]
    traction : (n,) array [m/s²]
    status : str
    iterations : int
    """

    energy: float
    z: FloatArray
    traction: FloatArray
    status: str
    iterations: int

    @property
    def solved(self) -> bool:
        """Whether IPOPT found it to be optimal."""
        return self.status in ("Solve_Succeeded", "Solved_To_Acceptable_Level")


def refereed(run: TrajectoryProblem, found: Trajectory) -> tuple[IpoptResult, float]:
    """What IPOPT makes of a trajectory's cells and active configurations, from a paced run.

    Beside it stands how much more energy the trajectory takes, relative.
    """
    names = [configuration.name for configuration in run.configurations]
    rows = [names.index(name) for name in found.certificate["active"]]
    problem = discretise(run, found.positions).select(rows)
    braking = found.braking_effort[rows] / problem.reference
    speeds, traction = found.speeds[rows], found.tractive_effort / problem.reference
    plan = Plan(0.5 * speeds**2, traction, braking, braking)
    problem = problem.tapered(taper_along(problem, plan))
    start = paced_run(problem, found.running_time)
    result = solve_with_ipopt(problem, start, found.running_time)
    return result, found.certificate["energy"] / (result.energy * problem.reference) - 1.0


def with_referee(run: TrajectoryProblem, found: Trajectory) -> Trajectory:
    """The trajectory with what IPOPT makes of its cells in the certificate, under ``referee``.

    ``energy`` [J] is IPOPT's worst case, ``excess`` what the trajectory takes more, relative;
    ``status`` and ``iterations`` are those of IPOPT, and ``solved`` whether it found an optimum.

    Examples
    --------
    >>> from analysis import OptimiserOptions, TrajectoryProblem, optimise
    >>> from trainlog.formats.railway import read_line, read_train
    >>> from trainlog.railway import Configuration
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> problem = TrajectoryProblem(line, train, [Configuration.of(train)], end=2_500.0)
    >>> judged = with_referee(problem, optimise(problem, OptimiserOptions(cells=60)))
    >>> abs(judged.certificate["referee"]["excess"]) < 1e-4
    True
    """
    result, excess = refereed(run, found)
    stated = {
        "energy": found.certificate["energy"] / (1.0 + excess),
        "excess": excess,
        "solved": result.solved,
        "status": result.status,
        "iterations": result.iterations,
    }
    return replace(found, certificate={**found.certificate, "referee": stated})


def solve_with_ipopt(problem: DiscreteProblem, start: Plan, running_time: float) -> IpoptResult:
    """Minimise the worst-case energy from `start` within `running_time` [s]."""
    q, n = problem.shape
    rows = 1 if problem.common else q
    z, traction = ca.MX.sym("z", n + 1, q), ca.MX.sym("traction", n)
    braking = ca.MX.sym("braking", n, rows)
    dynamic = ca.MX.sym("dynamic", n, q if separates_dynamic_brake(problem) else 0)
    worst = ca.MX.sym("worst")
    constraints: list[tuple[Any, float, float]] = []  # expression, least, most
    cell = _cell().map(n)
    bulge, fall = ca.DM(problem.bulge), ca.DM(problem.taper.fall)
    train, expected = problem.run.train, ca.MX(0.0)
    for a in range(q):
        brakes = braking[:, 0 if problem.common else a]
        reached, times = cell(
            z[:-1, a].T,
            problem.gain[a] * (traction - brakes).T,
            problem.drag0[a].T,
            problem.drag1[a],
            problem.drag2[a],
            problem.step,
        )
        constraints += [(reached.T - z[1:, a], 0.0, 0.0), (ca.sum2(times), -np.inf, running_time)]
        constraints += [
            (ca.sum2(times[:, : int(node)]), float(earliest), float(latest))
            for node, earliest, latest in zip(
                problem.passed, problem.earliest, problem.latest, strict=True
            )
        ]
        usable = problem.power[a] * (1.0 - problem.taper.crest)
        for nodes, above in ((slice(0, n), fall), (slice(1, n + 1), -fall)):
            at = power_cells(problem, problem.power[a], problem.traction).tolist()
            v = _speed(z[nodes, a] + bulge)
            constraints.append((((traction + above)[at] * v[at]) / usable[at], -np.inf, 1.0))
            if dynamic.numel():
                at = power_cells(problem, problem.dynamic_power, problem.dynamic[a]).tolist()
                constraints.append((dynamic[at, a] * v[at], -np.inf, problem.dynamic_power))
            if problem.curves is not None:
                most = _within(problem.curves, a, v) * (1.0 - problem.taper.crest)
                constraints.append((traction + above - most, -np.inf, 0.0))
            if dynamic.numel() and problem.dynamic_curves is not None:
                most = _within(problem.dynamic_curves, a, v)
                constraints.append((dynamic[:, a] - most, -np.inf, 0.0))
        spent = ca.dot(problem.step, traction)
        if dynamic.numel():
            constraints.append((brakes - dynamic[:, a], 0.0, problem.friction[a]))
        regained: Any = 0.0
        if problem.run.at_line:
            spent = spent / train.efficiency_traction
            regained = ca.dot(problem.step, dynamic[:, a]) * train.efficiency_regeneration
            expected += problem.weights[a] * (spent - regained)
        if problem.run.objective != "expected":
            constraints.append((worst - spent + regained, 0.0, np.inf))
    if problem.run.objective == "expected":
        constraints.append((worst - expected, 0.0, np.inf))
    unknowns, low, high, first = _bounded(problem, start, z, traction, braking, dynamic, worst)
    return _solved(problem, worst, unknowns, constraints, low, high, first)


def _within(curves: Curves, row: int, speed: Any) -> Any:
    """Effort of a configuration's curve at speeds, on the lines between its points."""
    share, own = float(curves.share[row]), curves.kept
    v = np.append(own.speeds, own.speeds[-1] * np.linspace(1.1, 2.0, 10))
    table = ca.interpolant("effort", "linear", [v.tolist()], own(v).tolist())
    return table(speed.T / share).T


def _cell() -> ca.Function:
    """Motion through one cell as in `motion.advance`: ``z`` at its end, and the time in it."""
    z0, effort, drag0 = ca.SX.sym("z"), ca.SX.sym("effort"), ca.SX.sym("drag0", SUBSTEPS + 1)
    drag1, drag2, step = ca.SX.sym("drag1"), ca.SX.sym("drag2"), ca.SX.sym("step")

    def slope(z: Any, constant: Any) -> Any:
        return effort - constant - drag1 * _speed(z) - 2.0 * drag2 * z

    z, time, h = z0, 0.0, step / SUBSTEPS
    for j in range(SUBSTEPS):
        first, last = drag0[j], drag0[j + 1]
        mean = 0.5 * (first + last)
        k1 = slope(z, first)
        k2 = slope(z + 0.5 * h * k1, mean)
        k3 = slope(z + 0.5 * h * k2, mean)
        k4 = slope(z + h * k3, last)
        following = z + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        middle = 0.5 * (z + following) + 0.125 * h * (k1 - slope(following, last))
        v, v_middle, v_following = _speed(z), _speed(middle), _speed(following)
        whole = 2.0 * h / (v + v_following)
        halves = h / (v + v_middle) + h / (v_middle + v_following)
        time += (4.0 * halves - whole) / 3.0
        z = following
    return ca.Function("cell", [z0, effort, drag0, drag1, drag2, step], [z, time])


def _speed(z: Any) -> Any:
    return ca.sqrt(ca.fmax(2.0 * z, 0.0) + _ROUNDED)


def _bounded(
    problem: DiscreteProblem,
    start: Plan,
    z: Any,
    traction: Any,
    braking: Any,
    dynamic: Any,
    worst: Any,
) -> tuple[Any, FloatArray, FloatArray, FloatArray]:
    """All unknowns in one vector, with their bounds and where they start."""
    q, n = problem.shape
    low_z = np.tile(np.maximum(problem.floor, least_z(problem)), (q, 1))
    high_z = np.tile(problem.ceiling, (q, 1))
    low_z[:, 0] = high_z[:, 0] = problem.initial
    low_z[:, n], high_z[:, n] = 0.0, problem.final_ceiling
    brakes = problem.usable_braking[:1] if problem.common else problem.braking
    most_dynamic = problem.dynamic if dynamic.numel() else np.empty((0, n))
    unknowns = ca.veccat(z, traction, braking, dynamic, worst)
    zeros, spare = np.zeros(brakes.size + most_dynamic.size), np.abs(problem.taper.fall)
    low = np.concatenate((low_z.ravel(), spare, zeros, [-np.inf]))
    pull = np.maximum(problem.traction - spare, spare)
    high = np.concatenate((high_z.ravel(), pull, brakes.ravel(), most_dynamic.ravel(), [np.inf]))
    first = np.concatenate(
        (
            start.z.ravel(),
            start.traction,
            start.braking[: brakes.shape[0]].ravel(),
            start.dynamic[: most_dynamic.shape[0]].ravel(),
            [float(problem.step @ start.traction)],
        )
    )
    return unknowns, low, high, first


def _solved(
    problem: DiscreteProblem,
    objective: Any,
    unknowns: Any,
    constraints: list[tuple[Any, float, float]],
    low: FloatArray,
    high: FloatArray,
    first: FloatArray,
) -> IpoptResult:
    q, n = problem.shape
    sizes = [expression.numel() for expression, _, _ in constraints]
    least = np.concatenate(
        [np.broadcast_to(b, s) for (_, b, _), s in zip(constraints, sizes, strict=True)]
    )
    most = np.concatenate(
        [np.broadcast_to(b, s) for (_, _, b), s in zip(constraints, sizes, strict=True)]
    )
    program: dict[str, Any] = {
        "x": unknowns,
        "f": objective,
        "g": ca.vertcat(*(ca.vec(expression) for expression, _, _ in constraints)),
    }
    settings: dict[str, Any] = {
        "print_time": False,
        "show_eval_warnings": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.max_iter": 300,
        "ipopt.max_cpu_time": LONGEST,
    }
    # From a standstill either strategy ends without an optimum on some lines.
    for barrier in ("adaptive", "monotone"):
        settings["ipopt.mu_strategy"] = barrier
        solver = ca.nlpsol("referee", "ipopt", program, settings)
        found = solver(x0=first, lbx=low, ubx=high, lbg=least, ubg=most)
        values, statistics = np.asarray(found["x"]).ravel(), solver.stats()
        result = IpoptResult(
            energy=float(values[-1]),
            z=values[: q * (n + 1)].reshape(q, n + 1),
            traction=values[q * (n + 1) : q * (n + 1) + n],
            status=str(statistics["return_status"]),
            iterations=int(statistics["iter_count"]),
        )
        if result.solved:
            break
    return result

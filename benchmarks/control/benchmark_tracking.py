"""One step of the tracking MPC of Hauck et al. (2023): DAQP beside CVXPY and IPOPT.

    python benchmarks/control/benchmark_tracking.py

All solve the same program at the same states along one section; the peers have their structure
built before the clock starts. Times are the processor's, the median over the states; the answers
are compared by the first lever.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import casadi as ca
import cvxpy as cp
import numpy as np
from rich.console import Console
from rich.table import Table

from analysis.control.prediction import SOFTNESS, QPSubproblem, solve
from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN
from analysis.studies.hauck_2023.reference import Reference, reference, section_of
from analysis.studies.hauck_2023.simulation import PublishedController
from trainlog.railway import Line, Station, StepProfile
from trainlog.simulation.drivers import Stop
from trainlog.units import KMH

COUNT, REPEATS = 40, 20
N = 20


def section() -> Reference:
    track = Line(
        name="benchmark",
        length=4_000.0,
        stations=(Station("A", 100.0), Station("B", 3_500.0)),
        speed_limits=StepProfile(np.array([0.0, 1_500.0]), np.array([80.0, 60.0]) / KMH),
        gradients=StepProfile(np.array([0.0, 800.0, 2_000.0]), np.array([0.0, 0.01, 0.0])),
    )
    rail = StepProfile(np.array([0.0, 1_200.0, 1_400.0]), np.array([0.3, 0.08, 0.3]))
    stops = Stop("A", 100.0, 0.0, 0.0), Stop("B", 3_500.0, 300.0, 300.0)
    return reference(section_of(track, PUBLISHED_TRAIN, rail, *stops))


def states(plan: Reference) -> list[tuple[float, float, float]]:
    """Times and states a little off the reference, where the horizon is full."""
    generator = np.random.default_rng(1)
    times = np.linspace(3.0, plan.duration - N - 5.0, COUNT).round()
    found = []
    for now in times:
        p, v, _ = plan.at(float(now))
        off = generator.normal(size=2)
        found.append((float(now), p - abs(off[0]), max(v + 0.1 * off[1], 0.1)))
    return found


def peer_cvxpy() -> Callable[[QPSubproblem], float]:
    """The program with parameters, compiled once; the square root of H keeps it DPP."""
    root, linear = cp.Parameter((N, N)), cp.Parameter(N)
    rows, low, high = cp.Parameter((2 * N, N)), cp.Parameter(3 * N), cp.Parameter(3 * N)
    x, slack = cp.Variable(N), cp.Variable(2 * N)
    cost = 0.5 * cp.sum_squares(root @ x) + linear @ x + 0.5 / SOFTNESS * cp.sum_squares(slack)
    kept = [x >= low[:N], x <= high[:N], rows @ x + slack >= low[N:], rows @ x + slack <= high[N:]]
    problem = cp.Problem(cp.Minimize(cost), kept)

    def step(program: QPSubproblem) -> float:
        root.value = np.linalg.cholesky(program.hessian).T
        linear.value, rows.value = program.gradient, program.rows
        low.value, high.value = np.maximum(program.lower, -1e6), np.minimum(program.upper, 1e6)
        problem.solve(solver=cp.CLARABEL)
        assert problem.status in ("optimal", "optimal_inaccurate"), problem.status
        return float(program.inputs[0] + x.value[0])

    return step


def peer_ipopt() -> Callable[[QPSubproblem], float]:
    x, slack = ca.MX.sym("x", N), ca.MX.sym("s", 2 * N)
    given = ca.MX.sym("p", N * N + N + 2 * N * N)
    h = ca.reshape(given[: N * N], N, N)
    f = given[N * N : N * N + N]
    rows = ca.reshape(given[N * N + N :], 2 * N, N)
    problem = {
        "x": ca.vertcat(x, slack),
        "p": given,
        "f": 0.5 * ca.bilin(h, x, x) + ca.dot(f, x) + 0.5 / SOFTNESS * ca.sumsqr(slack),
        "g": rows @ x + slack,
    }
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
    solver = ca.nlpsol("step", "ipopt", problem, options)

    def step(program: QPSubproblem) -> float:
        free = np.full(2 * N, np.inf)
        answer = solver(
            p=np.concatenate([
                program.hessian.ravel(order="F"), program.gradient, program.rows.ravel(order="F"),
            ]),
            lbx=np.concatenate([program.lower[:N], -free]),
            ubx=np.concatenate([program.upper[:N], free]),
            lbg=program.lower[N:],
            ubg=program.upper[N:],
        )  # fmt: skip
        assert solver.stats()["success"]
        return float(program.inputs[0] + np.asarray(answer["x"])[0, 0])

    return step


def own(program: QPSubproblem) -> float:
    change, status = solve(program)
    assert status > 0
    return float(program.inputs[0] + change[0])


def timed(work: Callable[[], object], repeats: int) -> float:
    """Processor time of one call [ms], the best of three batches."""
    best = np.inf
    for _ in range(3):
        begun = time.process_time()
        for _ in range(repeats):
            work()
        best = min(best, 1e3 * (time.process_time() - begun) / repeats)
    return float(best)


def main() -> None:
    plan = section()
    places = states(plan)
    controller = PublishedController(plan)
    table = Table("step", "ms, median", "ms, largest", "first lever differs by, at most")
    programs = [controller.program(*s) for s in places]
    times = [timed(lambda s=s: own(controller.program(*s)), REPEATS) for s in places]
    table.add_row("all of a step", f"{np.median(times):.3f}", f"{max(times):.3f}", "")
    answers = [own(each) for each in programs]
    for name, peer, repeats in (
        ("the program alone: DAQP", own, REPEATS),
        ("the program alone: CVXPY with parameters, Clarabel", peer_cvxpy(), 3),
        ("the program alone: CasADi, IPOPT", peer_ipopt(), 3),
    ):
        gap = max(abs(peer(each) - mine) for each, mine in zip(programs, answers, strict=True))
        times = [timed(lambda p=each, f=peer: f(p), repeats) for each in programs]
        table.add_row(name, f"{np.median(times):.3f}", f"{max(times):.3f}", f"{gap:.1e}")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()

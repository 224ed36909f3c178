"""One step of the cooperative MPC of Zhao et al. (2025): a real-time iteration beside IPOPT.

    python benchmarks/control/benchmark_cooperative.py

Both get the same states along the paper's cases, the same plan of the last sample to begin from,
and the same limits; IPOPT has its structure built before the clock starts. Times are the
processor's; the answers are compared by the first torques. A change of the rail is met by one
linearisation about a plan made for another rail, so the second after it is listed apart.
"""

from __future__ import annotations

import numpy as np
from benchmark_tracking import timed
from rich.console import Console
from rich.table import Table

from analysis.control.qp import solve
from analysis.studies.zhao_2025 import model as model
from analysis.studies.zhao_2025.controller import CooperativeController, Demand, NonlinearReferee
from analysis.studies.zhao_2025.simulation import (
    CASES,
    DURATION,
    PRESETS,
    RESTORED,
    STEP,
    WET_SPAN,
    Case,
    Preset,
)

EVERY = 5
"""Samples between two that are compared."""

SETTLING = 1.0
"""After a change of rail or motor [s]."""


def states(case: Case, preset: Preset) -> list[tuple[float, np.ndarray, np.ndarray, Demand]]:
    """Time, state, plan of the last sample and demand along one case."""
    locomotive, period = preset.locomotive, preset.tuning.period
    controller = CooperativeController(locomotive, preset.tuning)
    state, found = np.zeros(1 + locomotive.axles), []
    for k in range(round(DURATION / period)):
        now = k * period
        rail = case.rail(now)
        demand = controller.demand(rail, case.limits(now, preset))
        if k % EVERY == 0:
            found.append((now, state.copy(), controller.guess(demand), demand))
        torques = controller.torques(float(state[0]), state[1:], demand)
        steps = round(period / STEP)
        model.runge_kutta(state, torques, rail, locomotive.loads, locomotive.constants, STEP, steps)
    return found


def compared(preset: Preset, table: Table) -> None:
    """Add a preset's rows to the table."""
    controller = CooperativeController(preset.locomotive, preset.tuning)
    referee = NonlinearReferee(preset.locomotive, preset.tuning)
    scale = preset.locomotive.torque_limit
    own: list[float] = []
    peer: list[float] = []
    gaps: dict[bool, list[float]] = {True: [], False: []}
    changes = (0.0, *WET_SPAN, RESTORED)
    for case in CASES:
        for now, state, guess, demand in states(case, preset):

            def step(state=state, guess=guess, demand=demand) -> np.ndarray:
                change, status = solve(controller.program(state, guess, demand))
                assert status > 0
                return guess[0] + scale * change[: guess.shape[1]]

            def best(state=state, guess=guess, demand=demand) -> np.ndarray:
                return referee.plan(float(state[0]), state[1:], guess, demand)[0]

            gap = float(np.abs(step() - best()).max())
            gaps[any(0.0 <= now - each < SETTLING for each in changes)].append(gap)
            own.append(timed(step, 5))
            peer.append(timed(best, 1))
    for name, times in (("real-time iteration, DAQP", own), ("CasADi, IPOPT", peer)):
        table.add_row(
            preset.key, name, f"{np.median(times):.2f}", f"{max(times):.2f}",
            f"{np.median(peer) / np.median(times):.0f}",
            *(f"{np.median(gaps[k]):.1e} / {max(gaps[k]):.1e}" for k in (False, True)),
        )  # fmt: skip


def main() -> None:
    table = Table(
        "preset", "step", "ms, median", "ms, largest", "times faster than IPOPT",
        "torques differ by, N m: settled, median / largest", "in the second after a change",
    )  # fmt: skip
    for preset in PRESETS:
        compared(preset, table)
    Console(width=130).print(table)


if __name__ == "__main__":
    main()

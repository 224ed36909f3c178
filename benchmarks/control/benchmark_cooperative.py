"""One step of the cooperative MPC of Zhao et al. (2025): sequential programming beside IPOPT.

    python benchmarks/control/benchmark_cooperative.py [--no-ipopt]

First the paper's cases. Controller and IPOPT get the same states, the same plan of the last sample
to begin from, and the same limits; IPOPT has its structure built before the clock starts. Times are
the processor's and of whole steps; the answers are compared by the first torques. The second after
a change of rail or motor is listed apart.

Then locomotives of 4 to 12 axles on creep curves of different steepness, dry, wet, half wet and dry
again: the adhesion that they use over what the rail gives, how many steps were not solved,
and the same times and differences.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np
from benchmark_tracking import timed
from cooperative_referee import NonlinearReferee
from rich.console import Console
from rich.table import Table

from analysis.control.cooperative import CooperativeController, Demand, adhesion_at
from analysis.studies.zhao_2025 import (
    CASES,
    DURATION,
    PRESETS,
    RESTORED,
    SENSIBLE,
    STEP,
    WET_SPAN,
    Case,
    Preset,
    demand_on,
    runge_kutta,
)
from trainlog.errors import InputError
from trainlog.railway.adhesion import DRY, WET

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
        demand = demand_on(controller, rail, case.limits(now, preset))
        if k % EVERY == 0:
            found.append((now, state.copy(), controller.guess(demand), demand))
        torques = controller.torques(float(state[0]), state[1:], demand)
        steps = round(period / STEP)
        runge_kutta(state, torques, rail, locomotive.loads, locomotive.constants, STEP, steps)
    return found


@dataclass(eq=False)
class Compared:
    """Times [ms] and differences of first torques [N m] of a run."""

    own: list[float]
    peer: list[float]
    settled: list[float]
    changing: list[float]
    failed: int = 0

    def cells(self) -> list[str]:
        """Of a row of a table."""
        cells = [f"{np.median(self.own):.2f} / {max(self.own):.2f}"]
        cells.append(f"{np.median(self.peer):.0f}" if self.peer else "")
        cells[-1] += f", {self.failed} failed" if self.failed else ""
        return cells + [
            f"{np.median(gaps):.1e} / {max(gaps):.1e}" if gaps else ""
            for gaps in (self.settled, self.changing)
        ]


def add(
    found: Compared, preset: Preset, changes: tuple[float, ...], visited: list, peer: bool
) -> None:
    """Time and compare the steps of one run."""
    referee = NonlinearReferee(preset.locomotive, preset.tuning) if peer else None
    controller = CooperativeController(preset.locomotive, preset.tuning)
    for now, state, plan, demand in visited:

        def step(state=state, plan=plan, demand=demand) -> np.ndarray:
            controller.guess = lambda _: plan
            return controller.torques(float(state[0]), state[1:], demand)

        found.own.append(timed(step, 5))
        if referee is None:
            continue

        def best(state=state, plan=plan, demand=demand, referee=referee) -> np.ndarray:
            return referee.plan(float(state[0]), state[1:], plan, demand)[0]

        try:
            gap = float(np.abs(step() - best()).max())
        except InputError:
            # Where the plan of another rail lets the wheels race, IPOPT does not recover.
            found.failed += 1
            continue
        settling = any(0.0 <= now - each < SETTLING for each in changes)
        (found.changing if settling else found.settled).append(gap)
        found.peer.append(timed(best, 1))


def cases(table: Table, peer: bool) -> None:
    """The paper's cases."""
    for preset in PRESETS:
        found = Compared([], [], [], [])
        for case in CASES:
            add(found, preset, (0.0, *WET_SPAN, RESTORED), states(case, preset), peer)
        table.add_row(preset.key, "4", "as published", "", "", *found.cells())


CHANGES = (0.0, 5.0, 10.0, 15.0)
"""When the rail is dry, wet, half wet, dry again [s]."""

PEAKS = (1.2, 0.55, 0.22, 0.1)
"""Slip speeds of maximum adhesion [m/s]."""


def steep(peak_slip: float, maximum: float) -> np.ndarray:
    """A creep curve with its maximum at a slip speed [m/s], half as steep beyond as before it."""
    a = np.log(4.0) / 3.0 / peak_slip
    return np.array([a, 4.0 * a, maximum / (np.exp(-a * peak_slip) - np.exp(-4.0 * a * peak_slip))])


def locomotive_of(axles: int) -> Preset:
    """The locomotive of 85 t with more axles, and with a longer train."""
    four = SENSIBLE.locomotive
    more = replace(
        four,
        name=f"{axles} axles",
        mass=four.mass / 4.0 * axles,
        axle_loads=four.axle_loads[:1] * axles,
        total_torque=four.total_torque / 4.0 * axles,
    )
    return replace(SENSIBLE, key=f"{axles} axles", locomotive=more)


def driven(table: Table, axles: int, peak_slip: float, peer: bool) -> None:
    """A run of 20 s on creep curves with that peak."""
    preset = locomotive_of(axles)
    locomotive, tuning = preset.locomotive, preset.tuning
    controller = CooperativeController(locomotive, tuning)
    dry, wet = (np.tile(steep(peak_slip, each.peak), (axles, 1)) for each in (DRY, WET))
    half = np.where(np.arange(axles)[:, None] < axles // 2, dry, wet)
    state, visited, used = np.zeros(1 + axles), [], []
    fine = min(STEP, 0.01 * peak_slip)
    for k in range(round((CHANGES[-1] + 5.0) / tuning.period)):
        now = k * tuning.period
        rail = (dry, wet, half, dry)[int(np.searchsorted(CHANGES, now, side="right")) - 1]
        demand = demand_on(controller, rail)
        if k % EVERY == 0:
            visited.append((now, state.copy(), controller.guess(demand), demand))
        torques = controller.torques(float(state[0]), state[1:], demand)
        steps = int(np.ceil(tuning.period / fine))
        runge_kutta(
            state, torques, rail, locomotive.loads, locomotive.constants,
            tuning.period / steps, steps,
        )  # fmt: skip
        force = float((adhesion_at(state[1:] - state[0], rail) * locomotive.loads).sum())
        ratio = locomotive.effort_per_torque
        most = min(
            float((adhesion_at(peak_slip, rail) * locomotive.loads).sum()),
            ratio * locomotive.total_torque,
        )
        if now >= 1.0:
            used.append(force / most)
    found = Compared([], [], [], [])
    add(found, preset, CHANGES, visited, peer)
    table.add_row(
        "85-t", str(axles), f"peak at {peak_slip:g} m/s", f"{100.0 * np.mean(used):.1f}",
        f"{controller.unsolved} of {controller.steps}", *found.cells(),
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--no-ipopt", action="store_true", help="Times of the controller only.")
    peer = not parser.parse_args().no_ipopt
    table = Table(
        "preset", "axles", "creep", "adhesion used %", "unsolved", "ms, median / largest",
        "IPOPT ms", "torques differ by, N m: settled, median / largest",
        "in the second after a change",
    )  # fmt: skip
    cases(table, peer)
    for axles in (4, 6, 8, 12):
        for peak_slip in PEAKS:
            # IPOPT takes long to build for many axles; four of them show the differences.
            driven(table, axles, peak_slip, peer and axles == 4)
    Console(width=150).print(table)


if __name__ == "__main__":
    main()

"""The forces in a train along it and over time, beside its speed and the line, as charts."""

from __future__ import annotations

import numpy as np

from analysis.charts import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    RED,
    Cells,
    Chart,
    Curve,
    Label,
    Panel,
    Rule,
    shades,
)
from analysis.studies.in_train_forces.simulation import ConsistRun
from trainlog.units import KMH, PER_MILLE

COLUMNS = 1_200
"""Instants of the forces along the train; of those in between the largest force is shown."""


def run_charts(run: ConsistRun) -> list[Chart]:
    """Speed and gradient, forces along the train, envelope, single particle."""
    gradient = run.line.gradient(np.minimum(run.front, run.line.length)) * PER_MILLE
    speeds = [
        Curve("first vehicle", run.time, KMH * run.speeds[:, 0]),
        Curve("last vehicle", run.time, KMH * run.speeds[:, -1], ORANGE, width=0.8),
    ]
    begins = [(float(run.time[first]), name) for first, name in run.phases]
    ahead = Curve("", run.time, run.ahead, PURPLE)
    over_time = Chart(
        "time [s]",
        [
            Panel("km/h", speeds, 1.3, limits=(0.0, 1.7 * KMH * float(run.speeds.max())),
                  rules=[Rule(at, GREY, upright=True, width=0.6) for at, _ in begins],
                  labels=[Label(at, f" {name}", upright=True, side="left") for at, name in begins]),
            Panel("‰", [Curve("", run.time, gradient, GREY, "step")], 0.5,
                  "Gradient under the front"),
            _forces(run),
            Panel("m", [ahead], 0.7,
                  "Way of the consist less that of a single particle under the same demands"),
        ],
        span=(0.0, float(run.time[-1])), title=f"{run.consist.name} on {run.line.name}",
    )  # fmt: skip
    return [over_time, _envelope(run)]


def _forces(run: ConsistRun) -> Panel:
    """Couplers from the front (top) to the rear, over time."""
    edges = np.linspace(0, run.time.size, min(COLUMNS, run.time.size) + 1).astype(int)
    high = np.maximum.reduceat(run.forces, edges[:-1], axis=0)
    low = np.minimum.reduceat(run.forces, edges[:-1], axis=0)
    shown = np.where(high >= -low, high, low) / 1e3
    most = max(float(np.abs(shown).max()), 1e-3)
    times = np.append(run.time, 2.0 * run.time[-1] - run.time[-2])[edges]
    count = run.forces.shape[1]
    levels = most * np.linspace(-1.0, 1.0, 5)
    names = {
        f"{level:.0f} kN": str(shades([level], "RdBu_r", (-most, most))[0]) for level in levels
    }
    cells = Cells(
        times, np.arange(count + 1) + 0.5, shades(shown.T, "RdBu_r", (-most, most)), names
    )
    title = "In-train force: draft red, buff blue"
    return Panel("coupler, from the front", [cells], 1.5, title, limits=(count + 0.5, 0.5))


def _envelope(run: ConsistRun) -> Chart:
    """Largest draft and buff of each coupler, and where they come from."""
    numbers = np.arange(1, run.forces.shape[1] + 1)
    draft, buff = run.forces.max(axis=0) / 1e3, run.forces.min(axis=0) / 1e3
    curves = [
        Curve("draft, whole run", numbers, np.maximum(draft, 0.0), RED, "bars", width=0.8),
        Curve("buff, whole run", numbers, np.minimum(buff, 0.0), BLUE, "bars", width=0.8),
    ]
    for name, mark in (("full service braking", "o"), ("emergency braking", "s")):
        during = run.forces[run.phase(name)].min(axis=0) / 1e3
        curves += [
            Curve("", numbers, during, INK, width=0.8),
            Curve(f"least in {name}", numbers, during, INK, "points", width=1.7, mark=mark),
        ]
    panel = Panel("kN", curves, 1.1, "Largest forces of each coupler", rules=[Rule(0.0, GREY)])
    return Chart("coupler, from the front", [panel])

"""What a consist does, as a table."""

from __future__ import annotations

import numpy as np

from analysis.studies.in_train_forces.simulation import ConsistRun
from trainlog.arrays import FloatArray
from trainlog.presentation import WordTable, new_table
from trainlog.units import KMH


def forces_tables(run: ConsistRun) -> tuple[WordTable, WordTable]:
    """The largest forces of each coupler, phase by phase, and what they mean for the trip."""
    names = [name for _, name in run.phases if name not in ("halt", "end")]
    table = new_table(
        "In-train forces, kN: largest in draft / in buff", "coupler", "whole run", *names
    )
    for coupler, forces in enumerate(run.forces.T / 1e3, start=1):
        parts = (forces, *(forces[run.phase(name)] for name in names))
        table.add_row(str(coupler), *(_extremes(part) for part in parts))
    summary = new_table("In-train forces: where, and beside a single particle", "", "")
    draft = np.unravel_index(np.argmax(run.forces), run.forces.shape)
    buff = np.unravel_index(np.argmin(run.forces), run.forces.shape)
    for what, (row, which) in (("largest draft", draft), ("largest buff", buff)):
        summary.add_row(
            what,
            f"{abs(run.forces[row, which]) / 1e3:.0f} kN in coupler {which + 1} at"
            f" km {run.front[row] / 1e3:.3f}, {run.time[row]:.1f} s,"
            f" {run.speeds[row, 0] * KMH:.0f} km/h",
        )
    summary.add_row("energy unaccounted for", f"{run.residual:.1e} of all work done")
    summary.add_row("beside one particle", _beside(run))
    return table, summary


def _beside(run: ConsistRun) -> str:
    """Where and when the single-particle train is under the same demands."""
    stops = []
    for name in ("full service braking", "emergency braking"):
        during = run.phase(name)
        first = during.start
        distance = run.way[during.stop] - run.way[first]
        alone = run.alone[during.stop :, 0][0] - run.alone[first, 0]
        stops.append(f"{name} {distance:.1f} m, {alone:.1f} m as one")
    first = run.phase("full service braking").start
    delay = run.time[first] - float(np.interp(run.way[first], run.alone[:, 0], run.time))
    furthest = float(run.ahead[np.argmax(np.abs(run.ahead))])
    return (
        f"{'later' if delay > 0.0 else 'earlier'} by {abs(delay):.2f} s at the first braking; at"
        f" most {abs(furthest):.2f} m {'ahead' if furthest > 0.0 else 'behind'}; {'; '.join(stops)}"
    )


def _extremes(forces: FloatArray) -> str:
    draft, buff = np.maximum([forces.max(), -forces.min()], 0.0) + 0.0  # no -0
    return f"{draft:.0f} / {buff:.0f}"

"""The study of in-train forces: one consist over one line, as a log, a picture and tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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
from analysis.studies.in_train_forces.simulation import STEP, ConsistRun, crest_and_sag, run
from analysis.studies.report import StudyReport, study_trip
from trainlog.arrays import FloatArray
from trainlog.formats.declared import thing_to_bytes
from trainlog.formats.railway import read_consist, read_line
from trainlog.formats.samples import sample
from trainlog.presentation import WordTable, new_table
from trainlog.topics import (
    ENVIRONMENT,
    TRAIN_CONTROLS,
    TRAIN_COUPLERS,
    TRAIN_STATE,
    TRAIN_VEHICLES,
)
from trainlog.trip import Trip
from trainlog.units import KMH, PER_MILLE


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


DEFAULT_CONSIST = "freight_24_wagons.consist.json"
"""The sample that is run where none is named."""

CONSIST_ATTACHMENT = "consist.json"
"""The consist that a trip was simulated with."""


@dataclass(frozen=True)
class ConsistOptions:
    """What is driven.

    Attributes
    ----------
    consist, line : Path, optional
        Files; default: the freight train of the samples, and `crest_and_sag`.
    speed : float [m/s]
        To keep.
    """

    consist: Path | None = None
    line: Path | None = None
    speed: float = 80.0 / KMH


def main(report: StudyReport, options: ConsistOptions) -> None:
    """Drive a consist, write the run as a log, draw it and print its forces."""
    source = options.consist or sample(DEFAULT_CONSIST)
    train = read_consist(source)
    line = crest_and_sag() if options.line is None else read_line(options.line)
    for _ in report.track([train], f"driving {train.name}"):
        found = run(train, line, speed=options.speed)
    name = source.name.removesuffix(".json").removesuffix(".consist")
    report.log(consist_trip(found), name)
    report.draw({f"{name}.png": run_charts(found)})
    report.show(*forces_tables(found))


def consist_trip(run: ConsistRun) -> Trip:
    """The log of a consist's run: vehicles and couplers one by one, and the train as a whole."""
    consist, line = run.consist, run.line
    front = np.minimum(run.front, line.length)
    return study_trip(
        consist.name,
        consist.name,
        line,
        run.time,
        {
            TRAIN_STATE: {"position": run.front, "speed": run.speeds[:, 0]},
            TRAIN_CONTROLS: {
                "tractive_effort_demand": run.tractive_demand,
                "braking_effort_demand": run.braking_demand,
                "tractive_effort": run.tractive_efforts.sum(axis=1),
                "dynamic_braking_effort": 0.0,
                "pneumatic_braking_effort": run.braking_efforts.sum(axis=1),
            },
            TRAIN_VEHICLES: {
                "chainage": run.positions,
                "speed": run.speeds,
                "tractive_effort": run.tractive_efforts,
                "braking_effort": run.braking_efforts,
            },
            TRAIN_COUPLERS: {"force": run.forces, "stretch": run.stretches},
            ENVIRONMENT: {"gradient": line.gradient(front), "speed_limit": line.speed_limit(front)},
        },
        ("study consist", {"speed": run.speed_to_keep, "integration_step": STEP}),
        events=[(float(run.time[first]), name, "driver") for first, name in run.phases],
        attachments={CONSIST_ATTACHMENT: thing_to_bytes(consist)},
    )

"""The study of in-train forces: one consist over one line, as a log, a picture and tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from analysis.studies.in_train_forces.figures import forces_tables, run_charts
from analysis.studies.in_train_forces.simulation import STEP, ConsistRun, crest_and_sag, run
from analysis.studies.report import START, StudyReport, study_trip
from trainlog.formats.declared import thing_to_bytes
from trainlog.formats.railway import read_consist, read_line
from trainlog.formats.samples import sample
from trainlog.mcap import write_log
from trainlog.topics import (
    ENVIRONMENT,
    EVENTS,
    TRAIN_CONTROLS,
    TRAIN_COUPLERS,
    TRAIN_STATE,
    TRAIN_VEHICLES,
)
from trainlog.trip import Trip, frame_of
from trainlog.units import KMH, NANOSECONDS

DEFAULT_CONSIST = "freight_24_wagons.consist.json"
"""The sample that is run where none is named."""

CONSIST_ATTACHMENT = "consist.json"
"""The consist that a trip was simulated with."""

INFO = 2
"""Level of an event, see `trainlog.topics.EVENTS`."""


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
    write_log(consist_trip(found), report.folder / f"{name}.mcap")
    report.keep(report.folder / f"{name}.mcap")
    report.draw({f"{name}.png": run_charts(found)})
    report.show(*forces_tables(found))


def consist_trip(run: ConsistRun) -> Trip:
    """The log of a consist's run: vehicles and couplers one by one, and the train as a whole."""
    consist, line = run.consist, run.line
    time = START + np.round(run.time * NANOSECONDS).astype(np.int64)
    front = np.minimum(run.front, line.length)
    frames = (
        frame_of(TRAIN_STATE, time, {"position": run.front, "speed": run.speeds[:, 0]}),
        frame_of(
            TRAIN_CONTROLS,
            time,
            {
                "tractive_effort_demand": run.tractive_demand,
                "braking_effort_demand": run.braking_demand,
                "tractive_effort": run.tractive_efforts.sum(axis=1),
                "dynamic_braking_effort": np.zeros(time.size),
                "pneumatic_braking_effort": run.braking_efforts.sum(axis=1),
            },
        ),
        frame_of(
            TRAIN_VEHICLES,
            time,
            {
                "chainage": run.positions,
                "speed": run.speeds,
                "tractive_effort": run.tractive_efforts,
                "braking_effort": run.braking_efforts,
            },
        ),
        frame_of(TRAIN_COUPLERS, time, {"force": run.forces, "stretch": run.stretches}),
        frame_of(
            ENVIRONMENT,
            time,
            {"gradient": line.gradient(front), "speed_limit": line.speed_limit(front)},
        ),
        frame_of(
            EVENTS,
            time[[first for first, _ in run.phases]],
            {
                "level": np.full(len(run.phases), INFO),
                "message": np.array([name for _, name in run.phases], dtype=object),
                "name": np.full(len(run.phases), "driver", dtype=object),
            },
        ),
    )
    return study_trip(
        consist.name,
        consist.name,
        line,
        frames,
        ("study consist", {"speed": run.speed_to_keep, "integration_step": STEP}),
        attachments={CONSIST_ATTACHMENT: thing_to_bytes(consist)},
    )

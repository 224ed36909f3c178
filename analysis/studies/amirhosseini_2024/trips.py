"""The runs of the studies as trips."""

from __future__ import annotations

import numpy as np
import pandas as pd

from analysis.studies.amirhosseini_2024 import run as study
from analysis.studies.amirhosseini_2024.run import Run
from analysis.studies.in_train_forces import run as in_train_forces
from analysis.studies.in_train_forces.run import ConsistRun
from trainlog import __version__
from trainlog.formats.files import sha256
from trainlog.formats.line import line_to_bytes
from trainlog.formats.train import consist_to_bytes
from trainlog.topics import (
    ENVIRONMENT,
    ESTIMATED_RESISTANCE,
    EVENTS,
    REFERENCE,
    TRAIN_CONTROLS,
    TRAIN_COUPLERS,
    TRAIN_STATE,
    TRAIN_VEHICLES,
    TRUTH,
)
from trainlog.trip import LINE_ATTACHMENT, Trip, frame_of

START = 1_735_689_600 * 10**9
"""When the runs begin [ns]: 2025-01-01, so that the same run gives the same bytes."""


CONSIST_ATTACHMENT = "consist.json"
"""The consist that a trip was simulated with."""

INFO = 2
"""Level of an event, see `trainlog.topics.EVENTS`."""


def trip_of(run: Run, seed: int) -> Trip:
    """The log of one run.

    In ``/estimates/running_resistance`` ``r0`` is the estimate of a0 + f2, the slope included, as
    eq. (24) has it; the scalar variant knows only the sum, which stands in ``resistance``.
    """
    time = START + np.round(run.time * 1e9).astype(np.int64)
    slopes = study.line(run.shift)
    estimates = {"resistance": run.estimate}
    if run.variant.parameters == 3:
        estimates |= dict(zip(("r0", "r1", "r2"), run.theta.T, strict=True))
    else:
        estimates["resistance_std"] = run.theta_std[:, 0]
    traction, braking = np.maximum(run.effort, 0.0), np.maximum(-run.effort, 0.0)
    running = run.resistance - run.slope_force
    targets = [study.target(now) for now in run.time]
    needed = study.MASS * np.array([each.acceleration for each in targets]) + run.resistance
    frames: tuple[pd.DataFrame, ...] = (
        frame_of(TRAIN_STATE, time, {"position": run.position, "speed": run.measured_speed}),
        frame_of(
            TRAIN_CONTROLS,
            time,
            {
                "tractive_effort_demand": traction,
                "braking_effort_demand": braking,
                "tractive_effort": traction,
                "dynamic_braking_effort": braking,
                "pneumatic_braking_effort": np.zeros_like(braking),
            },
        ),
        frame_of(
            ENVIRONMENT,
            time,
            {
                "gradient": slopes.gradient(run.position),
                "speed_limit": slopes.speed_limit(run.position),
            },
        ),
        frame_of(ESTIMATED_RESISTANCE, time, estimates | {"mass": np.full(time.size, study.MASS)}),
        frame_of(
            REFERENCE,
            time,
            {
                "speed": run.target_speed,
                "tractive_effort": np.maximum(needed, 0.0),
                "braking_effort": np.maximum(-needed, 0.0),
            },
        ),
        frame_of(
            TRUTH,
            time,
            {"position": run.position, "speed": run.speed, "running_resistance": running},
        ),
    )
    if run.train.couplers:
        frames += (frame_of(TRAIN_COUPLERS, time, {"force": run.coupler_forces}),)
    attachments = {
        LINE_ATTACHMENT: line_to_bytes(slopes),
        CONSIST_ATTACHMENT: consist_to_bytes(run.train),
    }
    metadata = {
        "trip": name_of(run),
        "train": run.train.name,
        "line": slopes.name,
        "direction": "forward",
        "clock": "UTC, simulated",
        "start": "2025-01-01T00:00:00+00:00",
        "software": f"trainlog {__version__}",
        "seed": str(seed),
        "study": "paper 004, section 5",
    }
    trip = Trip({frame.attrs["topic"]: frame for frame in frames}, metadata, (), attachments)
    return trip.with_step(
        "study rls-sliding-mode",
        software=f"trainlog {__version__}",
        seed=seed,
        variant=run.variant.name,
        speed_noise=run.noise,
        slope_shift=run.shift,
        inputs={name: sha256(data) for name, data in attachments.items()},
    )


def name_of(run: Run) -> str:
    """Name of a run: its variant, whether its train has couplers, and whether speed is measured."""
    name = run.variant.name.replace(" ", "-")
    if run.train.couplers:
        alone = any(each.max_tractive_effort == 0.0 for each in run.train.vehicles)
        name += "-8-wagons-first-pulls" if alone else "-8-wagons"
    return f"{name}-measured" if run.noise else name


def consist_trip(run: ConsistRun) -> Trip:
    """The log of a consist's run: vehicles and couplers one by one, and the train as a whole."""
    consist, line = run.consist, run.line
    time = START + np.round(run.time * 1e9).astype(np.int64)
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
    attachments = {
        LINE_ATTACHMENT: line_to_bytes(line),
        CONSIST_ATTACHMENT: consist_to_bytes(consist),
    }
    metadata = {
        "trip": consist.name,
        "train": consist.name,
        "line": line.name,
        "direction": "forward",
        "clock": "UTC, simulated",
        "start": "2025-01-01T00:00:00+00:00",
        "software": f"trainlog {__version__}",
    }
    trip = Trip({frame.attrs["topic"]: frame for frame in frames}, metadata, (), attachments)
    return trip.with_step(
        "study consist",
        software=f"trainlog {__version__}",
        speed=run.speed_to_keep,
        integration_step=in_train_forces.STEP,
        inputs={name: sha256(data) for name, data in attachments.items()},
    )

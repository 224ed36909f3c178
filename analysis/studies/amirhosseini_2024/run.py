"""The study of Amirhosseini et al. (2024): its runs, as logs, pictures and tables."""

from __future__ import annotations

import numpy as np
import pandas as pd

from analysis.studies.amirhosseini_2024 import simulation as study
from analysis.studies.amirhosseini_2024.figures import (
    claims_table,
    coefficients_table,
    eight_wagons_table,
    errors_table,
    study_charts,
)
from analysis.studies.amirhosseini_2024.simulation import SPEED_NOISE, VARIANTS, Run
from analysis.studies.report import START, StudyReport, study_trip
from trainlog.formats.declared import thing_to_bytes
from trainlog.railway.resistance import TERMS
from trainlog.topics import (
    ENVIRONMENT,
    ESTIMATED_RESISTANCE,
    REFERENCE,
    TRAIN_CONTROLS,
    TRAIN_COUPLERS,
    TRAIN_STATE,
    TRUTH,
)
from trainlog.trip import Trip, frame_of
from trainlog.units import NANOSECONDS

SHIFTS = 5
"""Positions of the slopes within one sample."""


def main(report: StudyReport, seed: int) -> None:
    """Run every estimator with exact and with measured speed, shifted slopes, and eight wagons."""
    scalar, spatial = VARIANTS[:2]
    tracks = [study.line(float(shift)) for shift in study.edge_shifts(SHIFTS)[1:]]
    plans = [
        *((variant, 0.0, None) for variant in VARIANTS),
        *((variant, SPEED_NOISE, None) for variant in VARIANTS),
        *((spatial, 0.0, track) for track in tracks),
        (scalar, 0.0, study.line(curved_tunnel=True)),
    ]
    runs = [
        study.run(variant, noise=noise, track=track, seed=seed)
        for variant, noise, track in report.track(plans, "driving")
    ]
    count = len(VARIANTS)
    exact = {run.variant.name: run for run in runs[:count]}
    measured = {run.variant.name: run for run in runs[count : 2 * count]}
    trains = [study.eight_wagons(), study.eight_wagons(first_pulls=True)]
    softening = study.eight_wagons(first_pulls=True, softening=True)
    coupled = [
        study.run(variant, train=train, seed=seed)
        for variant, train in report.track(
            [*((variant, each) for variant in (scalar, spatial) for each in trains),
             (scalar, softening)],
            "driving eight wagons",
        )
    ]  # fmt: skip
    for run in (*runs[: 2 * count], *coupled):
        report.log(trip_of(run, seed))
    report.draw(study_charts(exact))
    shifted = [exact[spatial.name], *runs[2 * count : -1]]
    report.show(
        errors_table(exact, measured, {spatial.name: shifted}),
        claims_table(exact, runs[-1]),
        coefficients_table(exact, measured),
        eight_wagons_table(exact, coupled),
    )


def trip_of(run: Run, seed: int) -> Trip:
    """The log of one run.

    In ``/estimates/running_resistance`` ``r0`` is the estimate of a0 + f2, the slope included, as
    eq. (24) has it; the scalar variant knows only the sum, which stands in ``resistance``.
    """
    time = START + np.round(run.time * NANOSECONDS).astype(np.int64)
    slopes = run.track
    estimates = {"resistance": run.estimate}
    if run.variant.parameters == 3:
        estimates |= dict(zip(TERMS, run.theta.T, strict=True))
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
    return study_trip(
        name_of(run),
        run.train.name,
        slopes,
        frames,
        (
            "study rls-sliding-mode",
            {
                "seed": seed,
                "variant": run.variant.name,
                "speed_noise": run.noise,
            },
        ),
        attachments={"consist.json": thing_to_bytes(run.train)},
        metadata={"seed": str(seed), "study": "Amirhosseini et al. (2024), section 5"},
    )


def name_of(run: Run) -> str:
    """Name of a run: its variant, whether its train has couplers, and whether speed is measured."""
    name = run.variant.name.replace(" ", "-")
    if run.train.couplers:
        alone = any(each.max_tractive_effort == 0.0 for each in run.train.vehicles)
        name += "-8-wagons-first-pulls" if alone else "-8-wagons"
        name += "-softening" if run.train.couplers[0].nonlinearity < 0.0 else ""
    return f"{name}-measured" if run.noise else name

"""The study of Zhao et al. (2025): its runs, as logs, pictures and tables."""

from __future__ import annotations

import numpy as np
import pandas as pd

from analysis.studies.report import START, StudyReport, study_trip
from analysis.studies.zhao_2025 import simulation as study
from analysis.studies.zhao_2025.figures import (
    gain_table,
    knowledge_table,
    published_table,
    start_table,
    study_charts,
    torque_table,
)
from analysis.studies.zhao_2025.rail import RAIL_SOURCES, by_knowledge
from analysis.studies.zhao_2025.simulation import DURATION, RESTORED, WET_SPAN, Case, Preset, Run
from trainlog.formats.railway import train_to_bytes
from trainlog.railway import Line, Station, StepProfile
from trainlog.railway.train import Axles, Train
from trainlog.topics import (
    ENVIRONMENT,
    ESTIMATED_ADHESION,
    EVENTS,
    GNSS_MOTION,
    TRAIN_AXLES,
    TRAIN_CONTROLS,
    TRAIN_STATE,
    TRUTH,
)
from trainlog.trip import TRAIN_ATTACHMENT, Trip, frame_of
from trainlog.units import GRAVITY, KMH, NANOSECONDS

LENGTH = 2_500.0
"""Of the line [m]; the paper's locomotive comes about 1,000 m far."""

TOP_SPEED = 200.0 / KMH
"""Of line and locomotive [m/s]; the runs know no limit but the motors'."""

SPEED_STD = 0.01
"""Stated of the train speed [m/s], which the controller knows exactly."""

INFO, WARNING = 2, 3
"""Levels of foxglove.Log."""


def main(report: StudyReport, seed: int) -> None:
    """Run the cases as published, without cooperation, and on rails that are not known."""
    runs = [
        study.run(case, preset, integration=integration)
        for case, preset, integration in report.track(study.PLANS, "driving")
    ]
    for run in runs:
        report.log(trip_of(run))
    assumed = study.run(study.CASES[0], integration="euler", first=study.FIRST_TORQUE)
    compared = {
        strategy: [study.run(*plan, strategy=strategy) for plan in study.COMPARED]
        for strategy in report.track(study.STRATEGIES, "comparing")
    }
    known = {
        name: by_knowledge(name, seed)
        for name in report.track(RAIL_SOURCES, "driving on rails that are not known")
    }
    report.draw(study_charts(runs))
    report.show(
        published_table(), start_table(runs[0], assumed), torque_table(runs), gain_table(compared),
        knowledge_table(known),
    )  # fmt: skip


def trip_of(run: Run) -> Trip:
    """The log of one run.

    The train speed that the controller sees stands in ``/gnss/motion``: all axles are driven, and
    ``/train/state`` has the mean of their wheels. ``/estimates/adhesion`` holds what the
    controller knows, here the truth.
    """
    locomotive = run.preset.locomotive
    time = START + np.round(run.time * NANOSECONDS).astype(np.int64)
    effort = locomotive.effort_per_torque * run.torque
    total = effort.sum(axis=1)
    asked = np.full(time.size, locomotive.effort_per_torque * locomotive.total_torque)
    zero = np.zeros(time.size)
    rate = np.diff(run.time, prepend=0.0)
    energy = np.cumsum(np.r_[0.0, (effort * run.wheel_speed).sum(axis=1)[:-1]] * rate)
    frames = (
        frame_of(
            TRAIN_STATE,
            time,
            {
                "position": run.position,
                "speed": run.wheel_speed.mean(axis=1),
                "acceleration": run.acceleration,
            },
        ),
        frame_of(
            TRAIN_CONTROLS,
            time,
            {
                "tractive_effort_demand": asked,
                "braking_effort_demand": zero,
                "tractive_effort": total,
                "dynamic_braking_effort": zero,
                "pneumatic_braking_effort": zero,
            },
        ),
        frame_of(TRAIN_AXLES, time, {"wheel_speed": run.wheel_speed, "wheel_effort": effort}),
        frame_of(
            GNSS_MOTION,
            time,
            {"speed": run.speed, "speed_accuracy": np.full(time.size, SPEED_STD)},
        ),
        frame_of(
            ENVIRONMENT,
            time,
            {"speed_limit": np.full(time.size, TOP_SPEED), "gradient": zero, "curvature": zero},
        ),
        _events(run),
        frame_of(ESTIMATED_ADHESION, time, {"adhesion": run.adhesion, "slip_speed": run.slip}),
        frame_of(
            TRUTH,
            time,
            {
                "position": run.position,
                "speed": run.speed,
                "acceleration": run.acceleration,
                "running_resistance": locomotive.resistance(run.speed),
                "maximum_adhesion": run.maximum_adhesion.mean(axis=1),
                "energy": energy,
            },
        ),
    )
    return study_trip(
        name_of(run),
        locomotive.name,
        line(),
        frames,
        (
            "study cooperative-adhesion",
            {
                "case": run.case.number,
                "preset": run.preset.key,
                "strategy": run.strategy,
                "integration": run.integration,
            },
        ),
        attachments={TRAIN_ATTACHMENT: train_to_bytes(train(run.preset))},
        metadata={
            "load": "0",
            "traction_control": run.strategy,
            "traction_decisions": str(run.decisions),
            "traction_unsolved": str(run.unsolved),
            "study": "Zhao et al. (2025), section 4",
        },
    )


def name_of(run: Run) -> str:
    """Name of a run: its case, its preset, and what is unusual of it."""
    words = [f"case-{run.case.number}", run.preset.key]
    if run.strategy != "cooperative":
        words.append(run.strategy.replace(" ", "-"))
    if run.integration == "euler":
        words.append("euler")
    return "-".join(words)


def line() -> Line:
    """Straight and level."""
    return Line(
        name="straight and level",
        length=LENGTH,
        stations=(Station("start", 0.0), Station("end", LENGTH)),
        speed_limits=StepProfile(np.zeros(1), np.array([TOP_SPEED])),
        gradients=StepProfile(np.zeros(1), np.zeros(1)),
        source="Zhao et al. (2025), which states no line",
    )


def train(preset: Preset) -> Train:
    """Locomotive and train as one train file: axles, resistance, limits at the wheel rims."""
    locomotive = preset.locomotive
    effort = locomotive.effort_per_torque * locomotive.total_torque
    rotating = locomotive.axles * locomotive.rotating_mass
    return Train(
        name=locomotive.name,
        mass=locomotive.mass,
        rotating_mass_factor=rotating / locomotive.mass,
        resistance=locomotive.resistance,
        max_tractive_effort=effort,
        max_traction_power=effort * TOP_SPEED,
        max_speed=TOP_SPEED,
        max_acceleration=3.0,
        length=20.0,
        axles=Axles(
            count=locomotive.axles,
            adhesive_mass=float(locomotive.loads.sum()) / GRAVITY,
            wheel_radius=locomotive.wheel_radius,
            rotating_mass=locomotive.rotating_mass,
        ),
        source="Zhao et al. (2025), table 2, and what is chosen beside it",
    )


def _events(run: Run) -> pd.DataFrame:
    found = _event_rows(run.case)
    when = START + np.round(np.array([time for time, *_ in found]) * NANOSECONDS).astype(np.int64)
    return frame_of(
        EVENTS,
        when,
        {
            "level": np.array([level for _, level, *_ in found]),
            "message": np.array([text for *_, text, _ in found], dtype=object),
            "name": np.array([name for *_, name in found], dtype=object),
        },
    )


def _event_rows(case: Case) -> list[tuple[float, int, str, str]]:
    axles = "axle" if len(case.wet) == 1 else "axles"
    which = f"{axles} {', '.join(str(axle) for axle in case.wet)}"
    found = [
        (0.0, INFO, "departure", "train"),
        (WET_SPAN[0], WARNING, f"wet rail under {which}", "rail"),
        (WET_SPAN[1], INFO, f"dry rail under {which}", "rail"),
    ]
    if case.fails:
        found += [
            (WET_SPAN[0], WARNING, "motor 4 fails", "drive"),
            (RESTORED, INFO, "motor 4 works again", "drive"),
        ]
    return sorted(each for each in found if each[0] < DURATION)

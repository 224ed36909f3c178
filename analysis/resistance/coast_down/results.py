"""What coasting showed, as it is written to a file."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from analysis.resistance.coast_down.detection import Segment
from analysis.resistance.coast_down.fit import TripCoastDown
from analysis.resistance.coast_down.motion import Motion
from analysis.resistance.coast_down.together import CoastDown
from trainlog.formats.parameters import CoastDownResult, DragCurve, Identified

NAMES = (("mass_ratio", "1"), ("c0", "m/s^2"), ("c1", "1/s"), ("c2", "1/m"))
"""Parameters of the curve, in the order of its covariance, with their units."""

SPEEDS = 25
"""Rows of the curve's table."""


def result_of(found: CoastDown) -> CoastDownResult:
    """The file's content; the provenance is added by whoever read the files."""
    curve = found.curve
    std = np.sqrt(np.diag(curve.covariance))
    told = None if found.ratio.source == "data" else f"expected: {found.ratio.source}"
    return CoastDownResult(
        train=found.train,
        gradient="line",
        quantities=tuple(
            Identified(name, unit, float(value), float(deviation), told if not number else None)
            for number, ((name, unit), value, deviation) in enumerate(
                zip(NAMES, curve.theta, std, strict=True)
            )
        ),
        covariance=curve.covariance,
        curve=table_of(found),
        trips=[trip_detail(fit) for fit in found.trips] + refusals(found.refused),
    )


def table_of(found: CoastDown) -> DragCurve | None:
    """The curve over the speeds that the data support."""
    supported = found.curve.supported
    if supported is None:
        return None
    speed = np.linspace(*supported, SPEEDS)
    low, high = found.curve.band(speed)
    return DragCurve(speed, found.curve(speed), low, high)


def trip_detail(fit: TripCoastDown) -> dict[str, Any]:
    """What is noted of a trip that was fitted."""
    motion = fit.motion
    return {
        "trip": fit.trip,
        "accepted": True,
        "speed_from": fit.source,
        "coasted": fit.coasted,
        "covered": list(fit.curve.covered),
        "supported": None if fit.curve.supported is None else list(fit.curve.supported),
        "fitted": {
            name: float(value) for (name, _), value in zip(NAMES, fit.curve.theta, strict=True)
        },
        "fitted_std": {
            name: float(value)
            for (name, _), value in zip(NAMES, np.sqrt(np.diag(fit.curve.covariance)), strict=True)
        },
        "windows": fit.windows,
        "noise": fit.noise,
        "cluster_factor": fit.cluster_factor,
        "residual_std": fit.residual_std,
        "segments": [segment_detail(motion, segment) for segment in fit.segments],
        "strays": [segment_detail(motion, segment) for segment in fit.strays],
    }


def segment_detail(motion: Motion, segment: Segment) -> dict[str, Any]:
    """When, where and how fast a coasting segment was."""
    ends = np.array([segment.start, segment.end])
    speed = np.interp(ends, motion.time, motion.speed)
    position = np.interp(ends, motion.time, motion.position)
    return {
        "start": str((motion.start + pd.Timedelta(seconds=round(segment.start, 3))).isoformat()),
        "duration": round(segment.duration, 3),
        "position": np.round(position, 1).tolist(),
        "speed": np.round(speed, 3).tolist(),
        "probability": round(segment.probability, 4),
    }


def refusals(refused: dict[str, str]) -> list[dict[str, Any]]:
    """What is noted of trips that contribute nothing."""
    return [
        {"trip": name, "accepted": False, "reason": reason}
        for name, reason in sorted(refused.items())
    ]

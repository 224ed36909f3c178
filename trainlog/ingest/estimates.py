"""Smoothed state of an ingested trip: speed and chainage with their standard deviations.

Satellite fixes become chainage where the line's geometry is known; speed and position then come
from the smoother of `estimators.kalman`, never from differences of raw values.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from estimators.kalman import SmoothedMotion, smooth_motion
from trainlog.ingest.chainage import Fixes, Matched, chainage_of
from trainlog.ingest.profile import Profile
from trainlog.ingest.recording import Finding, FloatArray
from trainlog.railway.line import Line
from trainlog.topics import ESTIMATED_STATE
from trainlog.trip import Trip, frame_of

SPEED_STD = 0.5
"""Standard deviation of a satellite speed [m/s] where the receiver gives none."""

STANDSTILL_STDS = 2.0
"""A receiver tells the size of the speed, so its noise never averages to 0: below this many
standard deviations the train is taken to stand."""

SMALLEST_SPEED_STD = 0.03
"""What no receiver undercuts [m/s], whatever it says."""

ODOMETER_STD = 0.1
"""Standard deviation of the speed from the wheels [m/s]."""

FIX_STD = 5.0
"""Standard deviation of a fix along the track [m] where the receiver gives none."""

GEOMETRY_STD = 2.0
"""Standard deviation of a good line's own geometry [m]."""

MULTIPATH_TIME = 30.0
"""Time over which the error of a fix stays the same [s]: fixes closer together say less each."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """What could be estimated: the frame, if any, what was found, and what to tell of it."""

    frame: pd.DataFrame | None = None
    findings: tuple[Finding, ...] = ()
    metadata: dict[str, str] = field(default_factory=dict)


def estimated_state(trip: Trip, line: Line | None, profile: Profile) -> Estimate:
    """The ``/estimates/state`` frame of a trip, if its data give one.

    From fixes and satellite speed on a line with geometry; else from the wheels' speed and the
    profile's start position, where no position was recorded.

    Parameters
    ----------
    line : Line or None
        As travelled.

    Raises
    ------
    InputError
        If the fixes lie elsewhere, or run against the line.
    """
    geometry = line.geometry if line is not None else None
    if geometry is not None and "/gnss/fix" in trip and trip["/gnss/fix"]["latitude"].count() > 1:
        fixes = _fixes(trip)
        matched = chainage_of(geometry, fixes, gated=profile.repair.off_line)
        off = int(np.count_nonzero(matched.rejected))
        findings = (Finding("off_line", off, (), "/gnss/fix"),) if off else ()
        told = {"line.misfit": f"{matched.misfit:.1f}"}
        usable = np.isfinite(matched.chainage).sum() > 1
        return Estimate(_smoothed_fixes(fixes, matched) if usable else None, findings, told)
    start = profile.trip.start_position
    if start is None or "/train/state" not in trip:
        return Estimate()
    state = trip["/train/state"]
    if state["position"].notna().any() or not state["speed"].notna().any():
        return Estimate()
    index = pd.DatetimeIndex(state.index)
    motion = smooth_motion(_seconds(index), state["speed"].to_numpy(), ODOMETER_STD)
    return Estimate(_frame(index, motion, start.si("m")))


def _seconds(index: pd.DatetimeIndex) -> FloatArray:
    return np.asarray((index.asi8 - index.asi8[0]) / 1e9)


def _fixes(trip: Trip) -> Fixes:
    """Fixes and satellite speeds of a trip on one clock."""
    frame = trip["/gnss/fix"]
    if "/gnss/motion" in trip:
        frame = frame.join(trip["/gnss/motion"], how="outer")
    absent = np.full(len(frame), np.nan)
    columns = {name: frame[name].to_numpy(np.float64) for name in frame.columns}
    accuracy = columns["horizontal_accuracy"]
    told = columns.get("speed_accuracy", absent)
    speed_std = np.maximum(np.where(told > 0.0, told, SPEED_STD), SMALLEST_SPEED_STD)
    speed = columns.get("speed", absent)
    return Fixes(
        index=pd.DatetimeIndex(frame.index),
        seconds=_seconds(pd.DatetimeIndex(frame.index)),
        latitude=columns["latitude"],
        longitude=columns["longitude"],
        std=np.where(accuracy > 0.0, accuracy, FIX_STD),
        speed=np.where(speed < STANDSTILL_STDS * speed_std, 0.0, speed),
        speed_std=speed_std,
    )


def _smoothed_fixes(fixes: Fixes, matched: Matched) -> pd.DataFrame:
    """Smoothed motion from chainage and speed, over the span in which fixes were matched."""
    known = np.flatnonzero(np.isfinite(matched.chainage))
    span = slice(int(known[0]), int(known[-1]) + 1)
    step = float(np.median(np.diff(fixes.seconds[known])))
    # White noise of this size says as much, taken together, as errors that last.
    inflation = np.sqrt(max(1.0, 2.0 * MULTIPATH_TIME / step))
    motion = smooth_motion(
        fixes.seconds[span],
        fixes.speed[span],
        fixes.speed_std[span],
        matched.chainage[span],
        np.hypot(fixes.std[span], GEOMETRY_STD) * inflation,
    )
    # Where the line itself is misplaced no number of fixes helps.
    std = np.hypot(motion.position_std, matched.misfit)
    return _frame(fixes.index[span], replace(motion, position_std=std), 0.0)


def _frame(index: pd.DatetimeIndex, motion: SmoothedMotion, start: float) -> pd.DataFrame:
    """The topic's frame; a train on its trip does not roll back."""
    return frame_of(
        ESTIMATED_STATE,
        index,
        {
            "position": np.maximum.accumulate(motion.position) + start,
            "position_std": motion.position_std,
            "speed": np.maximum(motion.speed, 0.0),
            "speed_std": motion.speed_std,
            "acceleration": motion.acceleration,
            "acceleration_std": motion.acceleration_std,
        },
    )

"""Smoothed state of an ingested trip: speed and chainage with their standard deviations.

Satellite fixes become chainage where the line's geometry is known; speed and position then come
from the smoother of `estimators.motion`, never from differences of raw values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from estimators.motion import SmoothedMotion, smooth_motion
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.ingest.chainage import Matched, chainage_of
from trainlog.ingest.clock import Result
from trainlog.ingest.fixes import Fixes, held_fixes
from trainlog.ingest.profile import Profile, Quantity
from trainlog.ingest.recording import Finding, Table
from trainlog.ingest.rules import LONGEST_GAP_IN_CHORD, POSITION, quantum
from trainlog.railway.line import Line
from trainlog.topics import ESTIMATED_STATE
from trainlog.trip import Trip, frame_of
from trainlog.units import NANOSECONDS

SPEED_STD = 0.5
"""Standard deviation of a satellite speed [m/s] where the receiver gives none."""

STANDSTILL_STDS = 2.0
"""A receiver gives the size of the speed, so its noise never averages to 0: below this many
standard deviations the train is taken to stand."""

SMALLEST_SPEED_STD = 0.03
"""What no receiver undercuts [m/s], whatever it states."""

ODOMETER_STD = 0.1
"""Standard deviation of the speed from the wheels [m/s]."""

FIX_STD = 5.0
"""Standard deviation of a fix along the track [m] where the receiver gives none."""

LONGEST_OUTAGE = 600.0
"""Through longer gaps [s] nothing is estimated: the train may have been anywhere."""

OFFSET, OFFSET_STDS = 30.0, 5.0
"""A recorded position further than this [m], and than so many standard deviations, from the
chainage of the fixes contradicts it."""

DRIFT = 0.005
"""Share of the distance by which an odometer drifts."""

CLOCKS = 1.0
"""Time [s] by which odometer and receiver may be apart."""

CONSTANT = 0.95
"""Share of the samples that have an offset which is called constant."""

MOST_CONTRADICTING = 0.5
"""Share of the positions that may contradict the fixes; of more none is used."""

LEAST_COMPARED = 10
"""Samples that it takes to compare position and fixes."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """What could be estimated: the frame, if any, what was found, and the metadata of it."""

    frame: pd.DataFrame | None = None
    findings: tuple[Finding, ...] = ()
    metadata: dict[str, str] = field(default_factory=dict)


def estimated_state(
    trip: Trip,
    line: Line | None,
    profile: Profile,
    unplaced: Sequence[tuple[int, int]] = (),
) -> Estimate:
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
        If the fixes lie elsewhere, or, as `AgainstLineError`, run against the line.
    """
    geometry = line.geometry if line is not None else None
    if geometry is not None and "/gnss/fix" in trip and trip["/gnss/fix"]["latitude"].count() > 1:
        fixes = _placed(fixes_of(trip), unplaced)
        matched = chainage_of(
            geometry,
            fixes,
            gated=profile.repair.off_line,
            slip_aware=profile.repair.slip,
            speed_aware=profile.repair.contradicted,
        )
        metadata = _noise_of(matched)
        if fixes.row_time:
            metadata["receiver.held_rows"] = f"{fixes.row_time:g}"
        usable = np.isfinite(matched.chainage).sum() > 1
        frame = _smoothed_fixes(fixes, matched) if usable else None
        return Estimate(frame, _findings(fixes, matched), metadata)
    start = profile.trip.start_position
    if not isinstance(start, Quantity) or "/train/state" not in trip:
        return Estimate()
    state = trip["/train/state"]
    if state["position"].notna().any() or not state["speed"].notna().any():
        return Estimate()
    index = pd.DatetimeIndex(state.index)
    motion = smooth_motion(_seconds(index), state["speed"].to_numpy(), ODOMETER_STD)
    return Estimate(_frame(index, motion, start.si("m")))


def position_offset(table: Table, estimate: pd.DataFrame) -> Result:
    """Shift recorded positions by a constant offset from the fixes; take away what contradicts.

    An odometer that drifts by up to `DRIFT` of the distance does not contradict the fixes.

    Parameters
    ----------
    table : Table
        In order of time.
    estimate : DataFrame
        ``/estimates/state`` from the fixes.
    """
    position = table.signals.get(POSITION)
    if position is None:
        return table, []
    known = pd.DatetimeIndex(estimate.index).as_unit("ns").asi8
    rows = np.flatnonzero(np.isfinite(position) & _near(table.time, known))
    if rows.size < LEAST_COMPARED:
        return table, []
    chainage, std, speed = (
        np.interp(table.time[rows], known, estimate[name].to_numpy())
        for name in ("position", "position_std", "speed")
    )
    off = position[rows] - chainage
    least = np.maximum(OFFSET, OFFSET_STDS * std) + (quantum(position) or 0.0)
    drifted = least + DRIFT * np.ptp(chainage) + CLOCKS * speed
    shift = _constant(off, least, drifted)
    wrong = np.abs(off - shift) > drifted
    if not (shift or wrong.any()):
        return table, []
    away = np.interp(table.time, table.time[rows], wrong) >= 0.5
    if shift:
        size = "too large" if shift > 0.0 else "too small"
        note = f"the distance was {abs(shift) / 1e3:.3f} km off the fixes, {size}; put back"
    else:
        note = (
            f"the distance is {np.min(off) / 1e3:+.3f} to {np.max(off) / 1e3:+.3f} km off the"
            " fixes, by no constant offset"
        )
    if np.mean(wrong) > MOST_CONTRADICTING:
        away[:] = True
        note += "; none of it is used"
    elif away.any():
        note += "; it is absent where it contradicts them"
    moved = np.where(away, np.nan, position - shift)
    changed = np.isfinite(position) & (moved != position)
    return table.with_values(POSITION, moved), table.found(
        "position_offset", changed, POSITION, note
    )


def _near(time: IntArray, known: IntArray) -> BoolArray:
    """Which times lie in no gap of the estimate, and neither before nor after it."""
    after = np.searchsorted(known, time)
    inside = (after > 0) & (after < known.size)
    after = np.clip(after, 1, known.size - 1)
    return inside & (known[after] - known[after - 1] <= LONGEST_GAP_IN_CHORD * NANOSECONDS)


def _constant(off: FloatArray, least: FloatArray, drifted: FloatArray) -> float:
    """The offset [m] that nearly all differences have, up to drift; 0 if there is none."""
    offset = float(np.median(off))
    beyond = float(np.mean(np.sign(offset) * off > least))
    agreeing = float(np.mean(np.abs(off - offset) <= drifted))
    return offset if min(beyond, agreeing) >= CONSTANT else 0.0


def _seconds(index: pd.DatetimeIndex) -> FloatArray:
    return np.asarray((index.asi8 - index.asi8[0]) / NANOSECONDS)


def _placed(fixes: Fixes, unplaced: Sequence[tuple[int, int]]) -> Fixes:
    """The fixes without positions between some times [ns]."""
    time = fixes.index.as_unit("ns").asi8
    lost = np.zeros(time.size, dtype=np.bool_)
    for first, last in unplaced:
        lost |= (time >= first) & (time <= last)
    if not lost.any():
        return fixes
    latitude, longitude = (
        np.where(lost, np.nan, each) for each in (fixes.latitude, fixes.longitude)
    )
    return replace(fixes, latitude=latitude, longitude=longitude)


def fixes_of(trip: Trip) -> Fixes:
    """Fixes, satellite speeds and wheel speeds of a trip on one clock, rows in its outages too.

    Parameters
    ----------
    trip : Trip
        With ``/gnss/fix``.

    Examples
    --------
    >>> from trainlog.ingest import ingest
    >>> fixes = fixes_of(ingest("sample_logs/gnss.csv"))
    >>> fixes.seconds.size >= 6847
    True
    """
    frame = trip["/gnss/fix"]
    if "/gnss/motion" in trip:
        frame = frame.join(trip["/gnss/motion"], how="outer")
    frame, row_time = _first_of_held(frame)
    index = pd.DatetimeIndex(frame.index)
    wheels = _wheels(trip, index)
    if wheels is not None:
        index = index.union(pd.DatetimeIndex(wheels.index))
    index = _bridged(index)
    frame = frame.reindex(index)
    absent = np.full(len(frame), np.nan)
    columns = {name: frame[name].to_numpy(np.float64) for name in frame.columns}
    accuracy = columns["horizontal_accuracy"]
    stated = columns.get("speed_accuracy", absent)
    speed_std = np.maximum(np.where(stated > 0.0, stated, SPEED_STD), SMALLEST_SPEED_STD)
    speed = columns.get("speed", absent)
    turning = None
    if wheels is not None:
        turning = np.asarray(wheels.reindex(index), dtype=np.float64)
    return Fixes(
        index=index,
        seconds=_seconds(index),
        latitude=columns["latitude"],
        longitude=columns["longitude"],
        std=np.where(accuracy > 0.0, accuracy, FIX_STD),
        speed=np.where(speed < STANDSTILL_STDS * speed_std, 0.0, speed),
        speed_std=speed_std,
        wheel_speed=turning,
        wheel_speed_std=None if turning is None else np.full(turning.size, ODOMETER_STD),
        row_time=row_time,
    )


def _first_of_held(frame: pd.DataFrame) -> tuple[pd.DataFrame, float]:
    """Fixes and speeds without those that only repeat the fix before; the time between rows [s]."""
    coordinates = [frame[name].to_numpy(np.float64) for name in ("latitude", "longitude")]
    repeated, row_time = held_fixes(_seconds(pd.DatetimeIndex(frame.index)), *coordinates)
    if not repeated.any():
        return frame, 0.0
    frame = frame.copy()
    if "speed" in frame:
        again = frame["speed"].to_numpy() == frame["speed"].shift().to_numpy()
        frame.loc[repeated & again, "speed"] = np.nan
    frame.loc[repeated, ["latitude", "longitude"]] = np.nan
    return frame, row_time


def _wheels(trip: Trip, index: pd.DatetimeIndex) -> pd.Series[float] | None:
    """Speed from the wheels from the first to the last fix, if the trip has one."""
    if "/train/state" not in trip:
        return None
    speed = trip["/train/state"]["speed"].loc[index[0] : index[-1]]
    return speed if speed.notna().any() else None


def _bridged(index: pd.DatetimeIndex) -> pd.DatetimeIndex:
    """The times, and further ones in the gaps between them, a usual step and at most 1 s apart."""
    time = index.as_unit("ns").asi8
    steps = np.diff(time)
    usual = min(int(np.median(steps)), NANOSECONDS)
    lost = np.flatnonzero((steps > 2 * usual) & (steps <= LONGEST_OUTAGE * NANOSECONDS))
    count = -(-steps[lost] // usual)
    start, width = np.repeat(time[lost], count), np.repeat(steps[lost] / count, count)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    extra = start + (within * width).astype(np.int64)
    return pd.DatetimeIndex(np.union1d(time, extra), tz="UTC", name=index.name)


def _findings(fixes: Fixes, matched: Matched) -> tuple[Finding, ...]:
    """What was set aside, by rule."""
    count = int(np.count_nonzero(matched.extrapolated))
    computed = f"{count} extrapolated, held or replayed by the receiver" if count else ""
    # A delay of fixes and speeds together concerns every speed.
    late = np.isfinite(fixes.speed) & (matched.common_delay.value > 0.0)
    counts = (
        ("contradicted", matched.contradicted | late, "/gnss/motion.speed", matched.reasons),
        ("off_line", matched.rejected | matched.extrapolated, "/gnss/fix", computed),
        ("slip", matched.slipping, "/train/state.speed", ""),
    )
    return tuple(
        Finding(rule, int(np.count_nonzero(flags)), (), column, note)
        for rule, flags, column, note in counts
        if flags.any()
    )


def _noise_of(matched: Matched) -> dict[str, str]:
    """What was found of the receiver and the line, as metadata."""
    noise = matched.position_noise
    found = {
        "line.misfit": f"{matched.misfit:.1f}",
        "receiver.position_std": f"{noise.std:.1f}",
        "receiver.position_time": f"{noise.time:.0f}",
    }
    if matched.along_std:
        found["receiver.along_std"] = f"{matched.along_std:.0f}"
    if matched.speed_noise is not None:
        found["receiver.speed_std"] = f"{matched.speed_noise.std:.2f}"
        found["receiver.speed_time"] = f"{matched.speed_noise.time:.0f}"
    if matched.delay:
        found["receiver.speed_delay"] = f"{matched.delay:g}"
    if matched.common_delay.value > 0.0:
        found["receiver.delay"] = f"{matched.common_delay.value:.2f}"
        found["receiver.delay_std"] = f"{matched.common_delay.std:.2f}"
    elif np.isnan(matched.common_delay.value):
        found["receiver.delay"] = "not known"
    return found


def _smoothed_fixes(fixes: Fixes, matched: Matched) -> pd.DataFrame:
    """Smoothed motion over the span in which fixes were matched."""
    known = np.flatnonzero(np.isfinite(matched.chainage))
    span = slice(int(known[0]), int(known[-1]) + 1)
    # Where the line itself is misplaced no number of fixes helps.
    motion = _on_time(fixes.seconds, matched)
    std = np.hypot(motion.position_std, matched.misfit)
    return _frame(fixes.index, replace(motion, position_std=std), 0.0).iloc[span]


def _on_time(seconds: FloatArray, matched: Matched) -> SmoothedMotion:
    """The motion on the table's clock, its band wider by what is not known of the delay."""
    motion, late = matched.motion, matched.common_delay
    if not late.value > 0.0:
        return motion
    at = seconds + late.value

    def earlier(values: FloatArray) -> FloatArray:
        return np.asarray(np.interp(at, seconds, values))

    beyond = np.maximum(at - seconds[-1], 0.0)
    speed, acceleration = earlier(motion.speed), earlier(motion.acceleration)
    return replace(
        motion,
        position=earlier(motion.position) + speed * beyond,
        position_std=np.hypot(earlier(motion.position_std), late.std * speed),
        speed=speed,
        speed_std=np.hypot(earlier(motion.speed_std), late.std * acceleration),
        acceleration=acceleration,
        acceleration_std=earlier(motion.acceleration_std),
    )


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

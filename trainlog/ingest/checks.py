"""Columns that measure the same thing must agree: what tells a wrong unit from a fault."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from trainlog.errors import InputError
from trainlog.ingest.clock import Result, gap_threshold
from trainlog.ingest.profile import Limits
from trainlog.ingest.recording import BoolArray, FloatArray, Table

SHORTEST = 500.0
"""Distance [m] from which on position and speed are compared."""

MOVING = 5.0
"""Speed [m/s] from which on two speeds are compared."""

FACTOR = 2.0
"""Ratio of two columns beyond which they cannot be of the units that the profile gives."""

CHORD = 10.0
"""Time [s] between two fixes whose distance is compared with the distance driven."""

AGAINST = -0.5
"""Correlation of effort and acceleration below which the sign of the effort is wrong."""

LONGEST_GAP_IN_CHORD = 3.0
"""Gap [s] beyond which fixes say nothing of the distance in between."""

LEAST_EFFORT = 0.2
"""Share of the largest effort from which on acceleration is expected to follow it."""

LEAST_SECONDS = 60.0
"""Time [s] with such efforts that it takes to judge their sign."""

POSITION, SPEED = "/train/state.position", "/train/state.speed"
GNSS_SPEED = "/gnss/motion.speed"
LATITUDE, LONGITUDE = "/gnss/fix.latitude", "/gnss/fix.longitude"

METRES_PER_DEGREE = 111_195.0


def refuse_inconsistent(table: Table, limits: Limits) -> Result:
    """Refuse a table whose columns contradict each other by a factor, or by sign.

    Raises
    ------
    InputError
        If distance and speed, or two speeds, differ by more than `FACTOR`, position runs against
        the direction of travel, or the train slows down whenever it is driven.
    """
    for _, ratio, problem in ratios(table, limits):
        if not 1.0 / FACTOR <= ratio <= FACTOR:
            raise InputError(
                problem,
                remedy="check the units of the two columns in the profile (km/h, m/s, km, m)",
            )
    _refuse_sign(table)
    return table, []


def ratios(table: Table, limits: Limits) -> Iterator[tuple[str, float, str]]:
    """Ratios of columns that should measure the same, each with the column and in words.

    Raises
    ------
    InputError
        If position runs against the direction of travel.
    """
    speed = table.signals.get(SPEED)
    if speed is not None:
        position = table.signals.get(POSITION)
        if position is not None:
            yield from _distance_ratio(table, position, speed, limits)
        for name, other in table.signals.items():
            if name == GNSS_SPEED or name.startswith("/train/axles.wheel_speed"):
                both = (speed > MOVING) & np.isfinite(other)
                if np.count_nonzero(both) >= 10:
                    ratio = float(np.median(other[both] / speed[both]))
                    yield name, ratio, f"{name} is {ratio:.4g} times {SPEED}"
    for name in (GNSS_SPEED, SPEED):
        if name in table.signals and LATITUDE in table.signals and LONGITUDE in table.signals:
            yield from _fix_ratio(table, name)


def _distance_ratio(
    table: Table, position: FloatArray, speed: FloatArray, limits: Limits
) -> Iterator[tuple[str, float, str]]:
    """Compare the change of position with the integral of speed, gaps left out."""
    known = np.isfinite(position) & np.isfinite(speed)
    seconds = table.time[known] / 1e9
    step = np.diff(seconds)
    whole = step <= gap_threshold(table.time, limits)
    moved = float(np.sum(np.diff(position[known])[whole]))
    mean = 0.5 * (speed[known][1:] + speed[known][:-1])
    driven = float(np.sum((mean * step)[whole]))
    if driven < SHORTEST:
        return
    if moved < -SHORTEST:
        raise InputError(
            f"{POSITION} falls by {-moved:.0f} m while the train drives {driven:.0f} m",
            remedy="position grows in the direction of travel: set sign = -1, and offset to"
            " minus the line's length, for its column in the profile",
        )
    yield POSITION, moved / driven, f"{POSITION} moves {moved:.0f} m, {SPEED} says {driven:.0f} m"


def _fix_ratio(table: Table, name: str) -> Iterator[tuple[str, float, str]]:
    """Compare the distances between fixes `CHORD` apart with the integral of a speed."""
    latitude, longitude = table.signals[LATITUDE], table.signals[LONGITUDE]
    speed = table.signals[name]
    fixed = np.isfinite(latitude) & np.isfinite(longitude)
    if np.count_nonzero(fixed) < 3 or np.count_nonzero(np.isfinite(speed)) < 3:
        return
    seconds = (table.time - table.time[0]) / 1e9
    told = np.isfinite(speed)
    at, speeds = seconds[told], speed[told]
    distance = np.concatenate(([0.0], np.cumsum(np.diff(at) * 0.5 * (speeds[1:] + speeds[:-1]))))
    marks = np.arange(max(at[0], seconds[fixed][0]), min(at[-1], seconds[fixed][-1]), CHORD)
    if marks.size < 2:
        return
    driven = np.diff(np.interp(marks, at, distance))
    north = np.interp(marks, seconds[fixed], latitude[fixed]) * METRES_PER_DEGREE
    scale = METRES_PER_DEGREE * np.cos(np.radians(float(np.median(latitude[fixed]))))
    east = np.interp(marks, seconds[fixed], longitude[fixed]) * scale
    chord = np.hypot(np.diff(north), np.diff(east))
    whole = _without_gap(marks, seconds[fixed]) & _without_gap(marks, at)
    whole &= driven > CHORD * MOVING
    if float(np.sum(driven[whole])) < SHORTEST:
        return
    ratio = float(np.median(driven[whole] / np.maximum(chord[whole], 1.0)))
    yield name, ratio, f"{name} is {ratio:.4g} times the speed at which the fixes move"


def _without_gap(marks: FloatArray, known: FloatArray) -> BoolArray:
    """Between which marks no gap lies in the samples `known` [s]."""
    late = np.flatnonzero(np.diff(known) > LONGEST_GAP_IN_CHORD)
    if not late.size:
        return np.ones(marks.size - 1, dtype=np.bool_)
    begins, ends = known[late], known[late + 1]
    # The first gap that ends after the chord begins; does it begin before the chord ends?
    first = np.searchsorted(ends, marks[:-1], side="right")
    inside = first < begins.size
    return ~(inside & (begins[np.minimum(first, begins.size - 1)] < marks[1:]))


def _refuse_sign(table: Table) -> None:
    """Refuse efforts, or a lever, that the train's acceleration runs against."""
    speed = table.signals.get(SPEED)
    if speed is None:
        return
    prefix = "/train/controls."
    efforts = {
        f"{prefix}tractive_effort": 1.0,
        f"{prefix}dynamic_braking_effort": -1.0,
        f"{prefix}pneumatic_braking_effort": -1.0,
    }
    present = [name for name in efforts if name in table.signals]
    if f"{prefix}tractive_effort" in present:
        net = sum(efforts[name] * np.nan_to_num(table.signals[name]) for name in present)
        _refuse_against(table, speed, np.asarray(net), " and ".join(present))
    lever = table.signals.get(f"{prefix}lever")
    if lever is not None:
        _refuse_against(table, speed, np.nan_to_num(lever), f"{prefix}lever")


def _refuse_against(table: Table, speed: FloatArray, push: FloatArray, name: str) -> None:
    seconds = (table.time - table.time[0]) / 1e9
    told = np.isfinite(speed)
    if np.count_nonzero(told) < 3:
        return
    ahead, behind = (
        np.interp(seconds + shift, seconds[told], speed[told]) for shift in (2.5, -2.5)
    )
    acceleration = (ahead - behind) / 5.0
    strong = np.abs(push) >= LEAST_EFFORT * np.max(np.abs(push))
    strong &= (speed > 1.0) & (np.max(np.abs(push)) > 0.0)
    held = np.diff(seconds, append=seconds[-1])
    if float(np.sum(np.minimum(held, 1.0)[strong])) < LEAST_SECONDS:
        return
    a, b = acceleration[strong], push[strong]
    if np.std(a) < 0.05 or np.std(b) == 0.0:
        return
    agreement = float(np.corrcoef(a, b)[0, 1])
    if agreement < AGAINST:
        raise InputError(
            f"the train slows down whenever {name} would drive it (correlation {agreement:.2f})",
            remedy="check sign and part of the columns of the efforts and of the lever in the"
            " profile: traction speeds a train up",
        )

"""Columns that measure the same thing must agree: what tells a wrong unit from a fault."""

from __future__ import annotations

import numpy as np

from trainlog.errors import InputError
from trainlog.ingest.clock import Result, gap_threshold
from trainlog.ingest.profile import Limits
from trainlog.ingest.recording import FloatArray, Table

SHORTEST = 500.0
"""Distance [m] from which on position and speed are compared."""

MOVING = 5.0
"""Speed [m/s] from which on two speeds are compared."""

FACTOR = 2.0
"""Ratio of two columns beyond which they cannot be of the units that the profile gives."""


def refuse_inconsistent(table: Table, limits: Limits) -> Result:
    """Refuse a table in which distance and speed, or two speeds, differ by a factor.

    Raises
    ------
    InputError
        If they differ by more than `FACTOR`, or position runs against the direction of travel.
    """
    speed = table.signals.get("/train/state.speed")
    if speed is None:
        return table, []
    position = table.signals.get("/train/state.position")
    if position is not None:
        _compare_distance(table, position, speed, limits)
    for name, other in table.signals.items():
        if name == "/gnss/motion.speed" or name.startswith("/train/axles.wheel_speed"):
            both = (speed > MOVING) & np.isfinite(other)
            if np.count_nonzero(both) >= 10:
                ratio = float(np.median(other[both] / speed[both]))
                _refuse_ratio(ratio, f"{name} is {ratio:.4g} times /train/state.speed")
    return table, []


def _compare_distance(
    table: Table, position: FloatArray, speed: FloatArray, limits: Limits
) -> None:
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
            f"/train/state.position falls by {-moved:.0f} m while the train drives {driven:.0f} m",
            remedy="position grows in the direction of travel: set sign = -1, and offset to the"
            " line's length, for its column in the profile",
        )
    ratio = moved / driven
    _refuse_ratio(
        ratio, f"/train/state.position moves {moved:.0f} m, /train/state.speed says {driven:.0f} m"
    )


def _refuse_ratio(ratio: float, problem: str) -> None:
    if not 1.0 / FACTOR <= ratio <= FACTOR:
        raise InputError(
            problem, remedy="check the units of the two columns in the profile (km/h, m/s, km, m)"
        )

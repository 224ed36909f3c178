"""Where the train was at each instant: the three timelines of a replay.

``time`` is the log's UTC clock, ``elapsed`` the time since the trip began, ``position_mm`` the
chainage in whole millimetres, counted in the direction of travel. Every entity of a trip is put on
all three, so that no view goes blank when the timeline is changed.

A timeline runs one way: what holds until the next sample (a limit, a driving phase) would else
hold over the wrong stretch. Recorded chainage does not: a standing train's wavers by millimetres,
an odometer's is set back by metres at a balise. The position timeline is therefore the
non-decreasing line nearest to what was recorded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import rerun as rr
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from trainlog.topics import ESTIMATED_STATE, GNSS_FIX, GNSS_MOTION, TRAIN_STATE
from trainlog.trip import Trip
from trainlog.units import EARTH_RADIUS, NANOSECONDS

FloatArray = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

TIME, ELAPSED, POSITION = "time", "elapsed", "position_mm"
"""Names of the timelines."""

MILLIMETRES = 1e3
"""In one metre."""

CLOCKS: tuple[tuple[str, ...], ...] = (
    (ESTIMATED_STATE.name, "position"),
    (TRAIN_STATE.name, "position"),
    (GNSS_MOTION.name, "speed"),
    (GNSS_FIX.name, "latitude", "longitude"),
)
"""Topics, and columns of them, from which a trip's position is known, the best first."""


@dataclass(frozen=True, eq=False)
class Instants:
    """When and where samples were taken.

    Attributes
    ----------
    start : int [ns since 1970 UTC]
        From which ``elapsed`` counts.
    time : (n,) int array [ns since 1970 UTC]
    position : (n,) array [m]
    """

    start: int
    time: Nanoseconds
    position: FloatArray

    def __len__(self) -> int:
        return int(self.time.size)

    def columns(self, rows: slice) -> list[Any]:
        """Rerun's time columns of these rows, one a timeline."""
        time = self.time[rows]
        millimetres = np.rint(self.position[rows] * MILLIMETRES).astype(np.int64)
        return [
            rr.TimeColumn(TIME, timestamp=time.astype("datetime64[ns]")),
            rr.TimeColumn(ELAPSED, duration=(time - self.start).astype("timedelta64[ns]")),
            rr.TimeColumn(POSITION, sequence=millimetres),
        ]


@dataclass(frozen=True, eq=False)
class Clock:
    """A trip's time and place.

    Attributes
    ----------
    start : int [ns since 1970 UTC]
        First sample of the trip.
    time : (n,) int array [ns since 1970 UTC]
        When the position was recorded.
    position : (n,) array [m]
        Never decreasing.
    """

    start: int
    time: Nanoseconds
    position: FloatArray

    def position_at(self, time: Nanoseconds) -> FloatArray:
        """Chainage [m] at each instant [ns]; held before the first and after the last."""
        if self.time.size == 0:
            return np.zeros(time.size)
        return np.interp(
            (time - self.start).astype(np.float64),
            (self.time - self.start).astype(np.float64),
            self.position,
        )

    def instants(self, time: Nanoseconds) -> Instants:
        """Time and place of samples taken at `time` [ns]."""
        return Instants(self.start, time, self.position_at(time))


def nanoseconds(frame: pd.DataFrame) -> Nanoseconds:
    """Time of each row [ns since 1970 UTC]."""
    return np.asarray(pd.DatetimeIndex(frame.index).as_unit("ns").asi8)


def clock_of(trip: Trip) -> Clock:
    """The trip's clock, with the best position that it holds.

    Estimated chainage before the train's own; without either, the distance since the first sample,
    from the satellites' speed or else from their fixes. A trip without any of them stays at 0. A
    line's chainage begins at 0, so what lies before is noise and is put there.

    Raises
    ------
    LogError
        If the trip holds no samples.
    """
    start = int(trip.start.as_unit("ns").value)
    found = {candidate: known_rows(trip, *candidate) for candidate in CLOCKS}
    return clock_from(start, {key: rows for key, rows in found.items() if rows is not None})


def clock_from(start: int, known: Mapping[tuple[str, ...], tuple[Any, ...]]) -> Clock:
    """The clock of a trip that began at `start` [ns], with its positions in `known`.

    Parameters
    ----------
    start : int [ns since 1970 UTC]
    known : mapping of tuple of str to tuple of arrays
        By one of `CLOCKS`: time [ns] and columns of the rows in which all of them are known.
    """
    for candidate in CLOCKS[:2]:
        if candidate in known:
            time, position = known[candidate]
            forward = isotonic_regression(np.maximum(position, 0.0)).x
            return Clock(start, time, np.asarray(forward, dtype=np.float64))
    if CLOCKS[2] in known:
        time, speed = known[CLOCKS[2]]
        steps = np.diff(time) / NANOSECONDS * 0.5 * (speed[1:] + speed[:-1])
        return Clock(start, time, np.concatenate(([0.0], np.cumsum(steps))))
    if CLOCKS[3] in known:
        time, latitude, longitude = known[CLOCKS[3]]
        return Clock(start, time, _run(latitude, longitude))
    return Clock(start, np.empty(0, np.int64), np.empty(0))


def known_rows(trip: Trip, topic: str, *names: str) -> tuple[Any, ...] | None:
    """Time and columns of the rows of `topic` in which all of `names` are known; None if none."""
    if topic not in trip:
        return None
    frame = trip[topic]
    values = [frame[name].to_numpy(dtype=np.float64) for name in names]
    known = np.all(np.isfinite(values), axis=0)
    if not known.any():
        return None
    return nanoseconds(frame)[known], *(column[known] for column in values)


def _run(latitude: FloatArray, longitude: FloatArray) -> FloatArray:
    """Distance run along fixes [deg] since the first [m], on a sphere and from fix to fix."""
    north = np.radians(np.diff(latitude))
    east = np.radians(np.diff(longitude)) * np.cos(np.radians(latitude[:-1]))
    return np.concatenate(([0.0], np.cumsum(EARTH_RADIUS * np.hypot(north, east))))

"""Where the train was at each instant: the three timelines of a replay.

``time`` is the log's UTC clock, ``elapsed`` the time since the trip began, ``position_m`` the
chainage in whole metres, counted in the direction of travel: Rerun counts in whole numbers, and of
metres it shows ``#10 123`` at km 10.123. Every entity of a trip is put on
all three, so that no view goes blank when the timeline is changed.

A timeline runs one way: what holds until the next sample (a limit, a driving phase) would else
hold over the wrong stretch. The position timeline is that of `trainlog.resampling.TimeDistance`,
which never decreases.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from trainlog.arrays import FloatArray
from trainlog.resampling import (
    POSITION_SOURCES as POSITION_SOURCES,
    Nanoseconds as Nanoseconds,
    TimeDistance,
    known_rows as known_rows,
    time_distance,
    time_distance_of,
)
from trainlog.trip import Trip, nanoseconds as nanoseconds

TIME, ELAPSED, POSITION = "time", "elapsed", "position_m"
"""Names of the timelines."""


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
        metres = np.rint(self.position[rows]).astype(np.int64)
        return [
            rr.TimeColumn(TIME, timestamp=time.astype("datetime64[ns]")),
            rr.TimeColumn(ELAPSED, duration=(time - self.start).astype("timedelta64[ns]")),
            rr.TimeColumn(POSITION, sequence=metres),
        ]


@dataclass(frozen=True, eq=False)
class Clock(TimeDistance):
    """A trip's time and place, as Rerun's timelines have them."""

    def instants(self, time: Nanoseconds) -> Instants:
        """Time and place of samples taken at `time` [ns]."""
        return Instants(self.start, time, self.position_at(time))


def clock_of(trip: Trip) -> Clock:
    """The trip's clock; see `trainlog.resampling.time_distance_of`."""
    return _clock(time_distance_of(trip))


def clock_from(start: int, known: Mapping[tuple[str, ...], tuple[Any, ...]]) -> Clock:
    """The clock of a trip that began at `start`; see `trainlog.resampling.time_distance`."""
    return _clock(time_distance(start, known))


def _clock(curve: TimeDistance) -> Clock:
    return Clock(curve.start, curve.time, curve.position)

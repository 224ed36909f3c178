"""How satellite positions are written: which column is which, and in what scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.ingest.mapping import degrees_of
from trainlog.ingest.proposal.checks import Fixes, Motion

SCALES: dict[str, tuple[float, float]] = {
    "degrees": (1.0, 0.0),
    "1e-7 degrees": (1e-7, 0.0),
    "1e-6 degrees": (1e-6, 0.0),
    "1e-5 degrees": (1e-5, 1.0),
    "degrees and minutes": (np.nan, 0.0),
    "radians": (180.0 / np.pi, 1.5),
    "seconds of arc": (1.0 / 3600.0, 4.0),
    "milliseconds of arc": (1.0 / 3.6e6, 4.0),
    "semicircles": (180.0 / 2.0**31, 4.0),
}
"""Scales of latitude and longitude [degrees], with the cost of each."""

SWAPPED = 1.5
"""Cost of taking latitude for longitude against the columns' names."""

FASTEST = 110.0
"""Speed [m/s] beyond which fixes do not belong to one train."""


@dataclass(frozen=True, eq=False)
class Position:
    """Latitude and longitude as they are read.

    Attributes
    ----------
    latitude, longitude : str
        Columns.
    scale : str
        One of `SCALES`.
    fixes : Fixes
    speed : float [m/s]
        At which the fixes move.
    swapped : bool
        Whether the names of the columns say the opposite.
    cost : float
        What the reading leaves unexplained.
    """

    latitude: str
    longitude: str
    scale: str
    fixes: Fixes
    speed: float
    swapped: bool
    cost: float

    @property
    def words(self) -> str:
        """The reading in words."""
        return f"{self.scale}, latitude and longitude {'swapped' if self.swapped else 'as named'}"


def in_degrees(scale: str) -> Callable[[FloatArray], FloatArray]:
    """What turns numbers of a scale into degrees."""
    if scale == "degrees and minutes":
        return degrees_of
    size = SCALES[scale][0]
    return lambda values: values * size


def positions_of(
    motion: Motion,
    columns: tuple[tuple[str, FloatArray], tuple[str, FloatArray]],
    speed: FloatArray | None,
) -> list[Position]:
    """The scales and orders of two columns that are possible, the likeliest first.

    Parameters
    ----------
    columns : ((name, values), (name, values))
        What the names say are latitude and longitude.
    speed : (n,) array, optional
        A speed in any unit.
    """
    found: list[Position] = []
    for swapped in (False, True):
        (north, first), (east, second) = columns if not swapped else columns[::-1]
        for scale, (_, charge) in SCALES.items():
            latitude, longitude = (in_degrees(scale)(values) for values in (first, second))
            if not _possible(scale, first, second, latitude, longitude):
                continue
            fixes = Fixes.of(motion, latitude, longitude)
            cost = charge + SWAPPED * swapped + _cost(motion, fixes, speed)
            found.append(Position(north, east, scale, fixes, fixes.speed, swapped, cost))
    return sorted(found, key=lambda each: each.cost)


def _possible(
    scale: str,
    first: FloatArray,
    second: FloatArray,
    latitude: FloatArray,
    longitude: FloatArray,
) -> bool:
    known = np.isfinite(first) & np.isfinite(second)
    # Rows without a fix hold zeros.
    known &= (first != 0.0) | (second != 0.0)
    if not known.any():
        return False
    counted = scale.startswith("1e-") or scale in ("semicircles", "milliseconds of arc")
    if counted and not all(
        np.all(each[known] == np.round(each[known])) for each in (first, second)
    ):
        return False
    if scale == "degrees and minutes":
        minutes = np.concatenate([np.abs(first[known]) % 100.0, np.abs(second[known]) % 100.0])
        if float(np.max(minutes)) >= 60.001 or float(np.median(np.abs(first[known]))) < 100.0:
            return False
    north = float(np.percentile(np.abs(latitude[known]), 99))
    east = float(np.percentile(np.abs(longitude[known]), 99))
    return north <= 90.0 and east <= 180.0


def _cost(motion: Motion, fixes: Fixes, speed: FloatArray | None) -> float:
    """What the motion of the fixes leaves unexplained, whatever the unit of the speed."""
    cost = 0.0
    fastest = fixes.speed
    if not np.isfinite(fastest):
        return 0.0
    for bound, charge in ((0.1, 4.0), (1.0, 3.0), (5.0, 0.8)):
        cost += charge * (fastest < bound)
    for bound, charge in ((100.0, 2.0), (200.0, 1.0)):
        cost += charge * (fastest > bound)
    if speed is None:
        return cost
    ratio = fixes.ratio(motion, np.abs(speed))
    if np.isfinite(ratio.value) and ratio.windows >= 5:
        cost += 15.0 * min(ratio.scatter, 1.0)
    return cost

"""Weather at a line over time: the rail's condition, temperature, humidity, precipitation.

A rail condition is a label (``"dry"``, ``"wet"``, ``"leaves"``, ``"frost"`` ...): the layer of the
track-condition map that trips in it belong to. What is not known is empty or NaN; between rows
nothing is interpolated, and where no row holds nothing is known.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trainlog.errors import InputError
from trainlog.units import NANOSECONDS

FloatArray = NDArray[np.float64]

LONGEST_HOLD = 3 * 3600 * NANOSECONDS
"""A row whose end is not stated holds at most so long [ns]: stations report every three hours."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """Weather at one time.

    Attributes
    ----------
    condition : str
        Of the rail; empty: not known.
    temperature : float [K]
        Of the air; NaN: not known, as in the others.
    humidity : float
        Relative, 0 to 1.
    precipitation : float [mm/h]
    since_rain : float [s]
        Since it last rained; 0 while it does.
    """

    condition: str
    temperature: float = np.nan
    humidity: float = np.nan
    precipitation: float = np.nan
    since_rain: float = np.nan

    def known(self) -> dict[str, str | float]:
        """What is known of it, by name."""
        return {
            name: value for name, value in asdict(self).items() if value == value and value != ""
        }


@dataclass(frozen=True, eq=False)
class Weather:
    """Weather at a line over time, row by row.

    Attributes
    ----------
    starts, ends : (n,) int array [ns since 1970 UTC]
        A row holds from its start until before its end; rows are ordered and do not overlap.
    conditions : tuple of str
        Of the rail; empty: not known.
    temperature : (n,) array [K]
    humidity : (n,) array
        Relative, 0 to 1.
    precipitation : (n,) array [mm/h]
        NaN in these three: not known.
    """

    starts: NDArray[np.int64]
    ends: NDArray[np.int64]
    conditions: tuple[str, ...]
    temperature: FloatArray
    humidity: FloatArray
    precipitation: FloatArray

    def __post_init__(self) -> None:
        sizes = {len(getattr(self, name)) for name in self.__dataclass_fields__}
        if len(sizes) != 1:
            raise InputError("weather: its columns differ in length")
        if np.any(self.ends <= self.starts) or np.any(self.starts[1:] < self.ends[:-1]):
            raise InputError("weather: rows must be ordered by time and must not overlap")

    def row_at(self, time: ArrayLike) -> NDArray[np.int64]:
        """Index of the row that holds at each time [ns since 1970 UTC]; -1 where none does."""
        when = np.asarray(time, dtype=np.int64)
        row = np.searchsorted(self.starts, when, side="right") - 1
        holds = (row >= 0) & (when < self.ends[np.maximum(row, 0)])
        return np.asarray(np.where(holds, row, -1), dtype=np.int64)

    def at(self, time: int) -> Conditions | None:
        """Weather at a time [ns since 1970 UTC]; None where no row holds."""
        row = int(self.row_at(time))
        if row < 0:
            return None
        return Conditions(
            self.conditions[row],
            float(self.temperature[row]),
            float(self.humidity[row]),
            float(self.precipitation[row]),
            self._since_rain(row, time),
        )

    def _since_rain(self, row: int, time: int) -> float:
        """Time since it last rained [s]; NaN where a gap or an unknown row lies between."""
        for each in range(row, -1, -1):
            amount = self.precipitation[each]
            if not np.isfinite(amount):
                return float(np.nan)
            if amount > 0.0:
                return 0.0 if each == row else (time - int(self.ends[each])) / NANOSECONDS
            if each > 0 and self.ends[each - 1] != self.starts[each]:
                break
        return float(np.nan)

"""Departures and arrivals of a journey's sections: which are cheapest, by cuts.

The least energy of a section is convex in its departure and arrival, and the multipliers of a
solution are its slopes: each solution cuts away what cannot be cheaper, and a linear program over
the cuts and the windows chooses the next times (Kelley, 1960).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from trainlog.errors import InfeasibleError
from trainlog.railway import Trajectory

FloatArray = NDArray[np.float64]

_TURNS = 12
_CLOSE = 2e-4
"""Energy that other times might still save, relative, when the search for them ends."""

_LEAST_MARGIN = 1.01
"""Least running time over that of the slowest configuration by itself."""


class Schedule:
    """Departures and arrivals that keep the windows, and the linear programs over them."""

    def __init__(self, least: FloatArray, low: FloatArray, high: FloatArray, dwell: float) -> None:
        self.least, self.low, self.high, self.dwell = least, low, high, dwell
        m = least.size
        self.rows: list[FloatArray] = []
        self.right: list[float] = []
        self.cuts: list[FloatArray] = []
        self.levels: list[float] = []
        for number in range(m - 1):
            # departure of the next section not before this arrival and the dwell time
            row = np.zeros(3 * m + 1)
            row[2 * number + 1], row[2 * number + 2] = 1.0, -1.0
            self.rows.append(row)
            self.right.append(-dwell)

    @property
    def count(self) -> int:
        """How many sections."""
        return self.least.size

    def anew(self) -> Schedule:
        """The same without its cuts."""
        return Schedule(self.least, self.low, self.high, self.dwell)

    def even(self) -> FloatArray:
        """Times that give every section the same reserve over its least time, (m, 2) [s]."""
        m = self.count
        rows, right = list(self.rows), list(self.right)
        for number in range(m):
            row = np.zeros(3 * m + 1)
            row[2 * number], row[2 * number + 1], row[-1] = 1.0, -1.0, self.least[number]
            rows.append(row)
            right.append(-float(self.least[number]))
        cost = np.zeros(3 * m + 1)
        cost[-1] = -1.0
        bounds = [*self._bounds(), *[(0.0, 0.0)] * m, (-0.5, 3.0)]
        return self._solved(cost, rows, right, bounds)[0]

    def cheapest(self) -> tuple[FloatArray, float]:
        """Times of the least energy that the cuts allow, (m, 2) [s], and that energy [J]."""
        m = self.count
        rows, right = list(self.rows), list(self.right)
        for number in range(m):
            row = np.zeros(3 * m + 1)
            row[2 * number], row[2 * number + 1] = 1.0, -1.0
            rows.append(row)
            right.append(-_LEAST_MARGIN * float(self.least[number]))
        cost = np.zeros(3 * m + 1)
        cost[2 * m : 3 * m] = 1.0
        bounds = [*self._bounds(), *[(0.0, None)] * m, (0.0, 0.0)]
        return self._solved(cost, [*rows, *self.cuts], [*right, *self.levels], bounds)

    def cut(self, number: int, times: FloatArray, energy: float, slopes: FloatArray) -> None:
        """Energy of a section is at least that at `times` and what the slopes add."""
        row = np.zeros(3 * self.count + 1)
        row[2 * number : 2 * number + 2] = slopes / 1e6
        row[2 * self.count + number] = -1.0
        self.cuts.append(row)
        self.levels.append(float(slopes @ times - energy) / 1e6)

    def _bounds(self) -> list[tuple[float, float | None]]:
        pairs = zip(self.low.ravel().tolist(), self.high.ravel().tolist(), strict=True)
        return [(low, None if high == np.inf else high) for low, high in pairs]

    def _solved(
        self, cost: FloatArray, rows: list[FloatArray], right: list[float], bounds: Any
    ) -> tuple[FloatArray, float]:
        found = linprog(cost, A_ub=np.array(rows), b_ub=np.array(right), bounds=bounds)
        if found.status != 0:
            raise InfeasibleError(
                "journey: the windows leave no times for the slowest configuration",
                remedy="open the windows longer",
            )
        return np.asarray(found.x[: 2 * self.count]).reshape(-1, 2), 1e6 * float(found.fun)


def best_times(
    schedule: Schedule, solve: Callable[[int, FloatArray], Trajectory], start: FloatArray
) -> tuple[FloatArray, float]:
    """Times of least energy, and what others might still save, relative.

    Parameters
    ----------
    schedule : Schedule
        Without cuts.
    solve : callable
        From a section's number and its times, (2,) [s], to its trajectory.
    start : (m, 2) array [s]
        Where the search begins.
    """
    times, best, chosen, saving = start, np.inf, start, np.inf
    for _ in range(_TURNS):
        energy = 0.0
        for number in range(schedule.count):
            certificate = solve(number, times[number]).certificate
            energy += certificate["energy"]
            arriving = sum(certificate["time_price"].values())
            slopes = np.array([certificate["departure_price"], -arriving])
            schedule.cut(number, times[number], certificate["energy"], slopes)
        if energy < best:
            best, chosen = energy, times
        times, least = schedule.cheapest()
        saving = max((best - least) / max(abs(best), 1.0), 0.0)
        if saving <= _CLOSE:
            break
        # Half way to the cuts' optimum: cuts far from it mislead.
        times = 0.5 * (times + chosen)
    return chosen, saving

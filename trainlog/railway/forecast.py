"""Forecasts of the maximum adhesion along a line, from whoever makes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.display import counted
from trainlog.errors import InputError


@dataclass(frozen=True, eq=False)
class AdhesionForecast:
    """What is expected of sections of a line, in spans of time; (n,) arrays, a row each.

    Attributes
    ----------
    line : str
    start, end : (n,) array [m]
        Chainage.
    valid_from, valid_to : (n,) int array [ns since 1970 UTC]
        The end does not belong to it.
    issued : (n,) int array [ns since 1970 UTC]
        When the row was issued.
    layer : tuple of str
        Rail condition for which each holds; empty: for any.
    shares : (k,) array
        Increasing, between 0 and 1.
    quantiles : (n, k) array
        Adhesion below which the maximum lies with the probability `shares`; NaN: not stated.
    thresholds : (j,) array
        Increasing adhesion.
    below : (n, j) array
        Probability that the maximum is below `thresholds`; NaN: not stated. A row that states
        nothing is a forecast of unknown.
    place : tuple of str
        Where each row stands in its file.
    """

    line: str
    start: FloatArray
    end: FloatArray
    valid_from: IntArray
    valid_to: IntArray
    issued: IntArray
    layer: tuple[str, ...]
    shares: FloatArray
    quantiles: FloatArray
    thresholds: FloatArray
    below: FloatArray
    place: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"Adhesion forecast for line '{self.line}', {counted(self.start.size, 'row')}"

    def in_force(self, time: pd.Timestamp) -> BoolArray:
        """Which rows are valid at a time and were issued by then; (n,) array.

        Examples
        --------
        >>> day = np.array([0]), np.array([86_400 * 10**9]), np.array([0])
        >>> forecast = AdhesionForecast(
        ...     "A-B", np.array([0.0]), np.array([500.0]), *day, ("wet",), np.array([0.5]),
        ...     np.array([[0.1]]), np.zeros(0), np.zeros((1, 0)),
        ... )
        >>> [forecast.in_force(pd.Timestamp(hours, unit="h")).tolist() for hours in (23, 24)]
        [[True], [False]]
        """
        now = time.as_unit("ns").value
        return np.asarray(
            (self.valid_from <= now) & (now < self.valid_to) & (self.issued <= now), dtype=np.bool_
        )

    def rows_at(self, layer: str, time: pd.Timestamp, positions: FloatArray) -> IntArray:
        """The row that holds at each position; (m,) int array, -1 where there is none.

        Rows for the rail condition go before those for any; of several the one issued last counts,
        if it was issued by then.

        Parameters
        ----------
        layer : str
        time : Timestamp
        positions : (m,) array [m]

        Raises
        ------
        InputError
            If two rows say different things of one place and time.
        """
        own = np.array([each in ("", layer) for each in self.layer], dtype=np.bool_)
        rows = np.flatnonzero(own & self.in_force(time))
        special = np.array([self.layer[row] != "" for row in rows.tolist()], dtype=np.bool_)
        rows = rows[np.lexsort((self.issued[rows], special))]
        found = np.full(positions.size, -1, dtype=np.int64)
        for row in rows.tolist():
            here = (positions >= self.start[row]) & (positions < self.end[row])
            for other in np.unique(found[here & (found >= 0)]).tolist():
                if self.layer[row] == self.layer[other] and self.issued[row] == self.issued[other]:
                    raise InputError(
                        f"forecast for line '{self.line}': {self._place(row)} and"
                        f" {self._place(other)} both hold at {time.isoformat()} from"
                        f" km {max(self.start[row], self.start[other]) / 1e3:.3f}",
                        remedy="leave one out, or state when each was issued",
                    )
            found[here] = row
        return found

    def _place(self, row: int) -> str:
        return self.place[row] if self.place else f"row {row + 1}"

    def points(self, row: int) -> tuple[FloatArray, FloatArray]:
        """Adhesion and the probability that the maximum is below it, as a row states; increasing.

        Raises
        ------
        InputError
            If more adhesion is stated with less probability.

        Examples
        --------
        >>> day = np.array([0]), np.array([86_400 * 10**9]), np.array([0])
        >>> forecast = AdhesionForecast(
        ...     "A-B", np.array([0.0]), np.array([500.0]), *day, ("wet",), np.array([0.05, 0.5]),
        ...     np.array([[0.08, 0.12]]), np.array([0.1]), np.array([[0.2]]),
        ... )
        >>> [each.tolist() for each in forecast.points(0)]
        [[0.08, 0.1, 0.12], [0.05, 0.2, 0.5]]
        """
        adhesion = np.concatenate((self.quantiles[row], self.thresholds))
        probability = np.concatenate((self.shares, self.below[row]))
        stated = np.isfinite(adhesion) & np.isfinite(probability)
        adhesion, probability = adhesion[stated], probability[stated]
        order = np.lexsort((probability, adhesion))
        adhesion, probability = adhesion[order], probability[order]
        falls = np.flatnonzero(np.diff(probability) < 0.0)
        if falls.size:
            at = int(falls[0])
            raise InputError(
                f"states probability {probability[at]:g} of less than {adhesion[at]:g}, and"
                f" {probability[at + 1]:g} of less than {adhesion[at + 1]:g}",
                place=self._place(row),
                remedy="quantiles and probabilities must grow with the adhesion",
            )
        return adhesion, probability

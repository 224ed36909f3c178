"""The grid of levels on which the track condition is solved, and distributions on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainlog.arrays import FloatArray, IntArray

STEP = 0.025
"""Of the grid of log adhesion."""

LEVELS = np.arange(np.log(0.015), np.log(0.75), STEP)
"""Grid of log adhesion."""

SPOT_CELLS = np.arange(4, LEVELS.size, 6)
"""Cells of the grid that are levels of lasting spots."""


@dataclass(frozen=True, eq=False)
class LevelGrid:
    """Levels of log adhesion, and which of them are levels of lasting spots."""

    levels: FloatArray
    cells: IntArray

    def of(self, probability: FloatArray) -> FloatArray:
        """Rows of probabilities on the other grid, on this one."""
        if probability.shape[1] == self.levels.size:
            return probability
        found = np.empty((probability.shape[0], self.levels.size))
        if self.levels.size < probability.shape[1]:
            found[:] = probability[:, ::2]
        else:
            found[:, ::2] = probability
            found[:, 1::2] = np.sqrt(probability[:, :-1] * probability[:, 1:])
        return np.asarray(found / found.sum(axis=1, keepdims=True))


FINE = LevelGrid(LEVELS, SPOT_CELLS)

COARSE = LevelGrid(np.ascontiguousarray(LEVELS[::2]), SPOT_CELLS // 2)
"""On which messages and parameters are found: sums over either grid agree where what is added up is
smooth over a step."""


def normal_on_grid(mean: float, std: float, levels: FloatArray) -> FloatArray:
    """A normal distribution on the grid."""
    density = np.exp(-0.5 * ((levels - mean) / std) ** 2) + 1e-12
    return np.asarray(density / density.sum())


def level_kernel(mean: float, std: float, rho: float, levels: FloatArray) -> FloatArray:
    """Transition of an Ornstein-Uhlenbeck process from bin to bin."""
    spread = std * np.sqrt(1.0 - rho**2)
    target = mean + rho * (levels[:, None] - mean)
    away = (levels[None, :] - target) / spread
    inside = np.abs(away) < 3.7
    matrix = np.where(inside, np.exp(-0.5 * away**2), 0.0)
    matrix[np.arange(levels.size), np.argmin(np.abs(away), axis=1)] += 1e-300
    return np.asarray(matrix / matrix.sum(axis=1, keepdims=True))

"""The worst mixture: whose energy a whole journey has to keep low.

A configuration is the same in all sections of a journey, so that what is spent at worst is
``max over configurations of the sum over sections``. By the minimax theorem it is the highest, over
mixtures of the configurations, of the least energy expected under the mixture; and each section's
least expected energy can be found by itself. Every mixture gives a lower bound.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

FloatArray = NDArray[np.float64]

_TURNS = 10
_CLOSE = 1e-4
"""Part of the energy by which the worst may be above what its mixture expects, at the end."""

_LITTLE = 0.05
"""Part of a mixture that is enough for a configuration to have its own brakes optimised."""

_LEAST_PART = 2e-3
"""Part of a mixture below which a configuration is left out of it."""


def worst_mixture(energies: Callable[[FloatArray], FloatArray], start: FloatArray) -> FloatArray:
    """The mixture under which the least expected energy is highest, about.

    Parameters
    ----------
    energies : callable
        From a mixture to the energies of all configurations, (q,) [J], under the plan of least
        expected energy.
    start : (q,) array
        Where the search begins; parts that add up to 1.

    Returns
    -------
    (q,) array
        Parts that add up to 1: the mixture whose plan has the least worst energy of those tried.
    """
    mixture, chosen, best, least = start, start, np.inf, -np.inf
    seen = list[FloatArray]()
    for _ in range(_TURNS):
        found = energies(mixture)
        seen.append(found)
        least = max(least, float(mixture @ found))
        if found.max() < best:
            best, chosen = float(found.max()), mixture
        scale = float(np.abs(seen).max())
        if best - least <= _CLOSE * scale:
            break
        before, mixture = mixture, _rounded(_next(np.array(seen) / scale, chosen))
        if np.abs(mixture - before).max() < _LEAST_PART:
            break
    return chosen


def _next(seen: FloatArray, chosen: FloatArray) -> FloatArray:
    """First a little of all that are dearer than the mixture expects, then what the cuts say."""
    if seen.shape[0] == 1:
        dearer = (seen[0] > chosen @ seen[0]) & (chosen == 0.0)
        if dearer.any():
            return np.asarray((1.0 - _LITTLE) * chosen + _LITTLE * dearer / dearer.sum())
    # Half way to the cuts' optimum: cuts far from it mislead.
    return np.asarray(0.5 * (_highest(seen) + chosen))


def _highest(seen: FloatArray) -> FloatArray:
    """The mixture under which the least of the energies seen is highest."""
    count = seen.shape[1]
    found = linprog(
        np.append(np.zeros(count), -1.0),
        A_ub=np.column_stack((-seen, np.ones(seen.shape[0]))),
        b_ub=np.zeros(seen.shape[0]),
        A_eq=np.append(np.ones(count), 0.0)[None],
        b_eq=np.ones(1),
        bounds=[*[(0.0, 1.0)] * count, (None, None)],
    )
    return np.asarray(found.x[:count])


def _rounded(mixture: FloatArray) -> FloatArray:
    """Without those that hardly count: who has no part needs no place in the program."""
    kept = np.where(mixture < _LEAST_PART, 0.0, mixture)
    return np.asarray(kept / kept.sum())

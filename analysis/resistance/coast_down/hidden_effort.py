"""Effort over inertia as a hidden Markov process: nothing at all, or one of many levels.

A driver's lever rests at nought for a while and elsewhere for another: effort is exactly zero
(coasting) or anything between full braking and full traction, and it lasts. The levels stand as
close to each other as the noise lets them be told apart, so that "no effort" competes on equal
terms with "the same little effort all the time".

References
----------
Rabiner, L. R. (1989), A tutorial on hidden Markov models and selected applications in speech
recognition, Proc. IEEE 77(2), eqs. (19)-(27) with the scaling of section V.A.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SPACING = 0.008
"""Distance between levels of effort over inertia [m/s²]: a tenth of the running resistance of a
passenger train at speed, and what a gradient 0.8 per mille off looks like."""

EVEN = 0.12
"""Up to here [m/s²] levels are equally far apart; beyond, each gap is a quarter larger."""

LARGEST_EFFORT = 1.5
"""Largest effort over inertia [m/s²]."""

USUAL_EFFORT = 0.3
"""Scale of the efforts that trains make [m/s²]; larger ones are rarer."""

COASTING_TIME, EFFORT_TIME = 30.0, 30.0
"""How long coasting usually lasts, and how long it takes until a driver coasts again [s]."""

HELD_TIME = 15.0
"""How long a lever is held before it goes somewhere else [s]."""

DRIFT_TIME = 6.0
"""How long an effort stays on its level before it drifts to the next [s]."""


@dataclass(frozen=True, eq=False)
class Levels:
    """Efforts over inertia other than nought, and how they change; arrays (k,).

    Attributes
    ----------
    values : array [m/s²]
        Increasing.
    spread : array [m/s²]
        Standard deviation within a level.
    share : array
        Where a lever goes that is moved.
    """

    values: FloatArray
    spread: FloatArray
    share: FloatArray

    @staticmethod
    def usual() -> Levels:
        """The levels described in this module."""
        gaps = [SPACING] * round(EVEN / SPACING)
        while sum(gaps) < LARGEST_EFFORT:
            gaps.append(1.25 * gaps[-1])
        ladder = np.cumsum(gaps)
        values = np.concatenate((-ladder[::-1], ladder))
        width = np.concatenate((np.array(gaps)[::-1], np.array(gaps)))
        # A lever is as likely at any notch: levels weigh as much as they are wide.
        share = width * np.exp(-np.abs(values) / USUAL_EFFORT)
        # Half a gap wide, neighbours add up to an even density: no effort is favoured.
        return Levels(values, 0.5 * width, share / share.sum())


@njit(cache=True)  # type: ignore[untyped-decorator]
def posterior(
    resting: FloatArray,
    working: FloatArray,
    fresh: NDArray[np.bool_],
    share: FloatArray,
    rates: tuple[float, float, float, float],
) -> tuple[FloatArray, float]:
    """Probability (n,) of coasting at each step given all steps, and the log-likelihood.

    Parameters
    ----------
    resting : (n,) array
        Density of each observation while coasting.
    working : (n, k) array
        The same at each level of effort.
    fresh : (n,) bool array
        True where a stretch begins that owes nothing to what was before.
    share : (k,) array
        Where a lever goes that is moved.
    rates : (float, float, float, float)
        Probability in a step of ending to coast, of beginning to, of moving the lever, and of
        drifting to a neighbouring level.
    """
    count, kinds = working.shape
    leave, rest, move, drift = rates
    forward = np.zeros((count, kinds + 1))
    scale = np.ones(count)
    prior = rest / (rest + leave) if rest > 0.0 else 0.0
    logarithm = 0.0
    for n in range(count):
        idle = prior
        if fresh[n]:
            for j in range(kinds):
                forward[n, j] = (1.0 - prior) * share[j] * working[n, j]
        else:
            before = forward[n - 1]
            idle = before[kinds] * (1.0 - leave) + (1.0 - before[kinds]) * rest
            moved = (1.0 - before[kinds]) * (1.0 - rest) * move + before[kinds] * leave
            kept = (1.0 - rest) * (1.0 - move)
            for j in range(kinds):
                below = before[max(j - 1, 0)]
                above = before[min(j + 1, kinds - 1)]
                held = (1.0 - drift) * before[j] + 0.5 * drift * (below + above)
                forward[n, j] = (kept * held + moved * share[j]) * working[n, j]
        forward[n, kinds] = idle * resting[n]
        total = 0.0
        for j in range(kinds + 1):
            total += forward[n, j]
        forward[n] /= total
        scale[n] = total
        logarithm += np.log(total)
    coasting = np.empty(count)
    backward = np.ones(kinds + 1)
    ahead = np.empty(kinds + 1)
    for n in range(count - 1, -1, -1):
        coasting[n] = forward[n, kinds] * backward[kinds]
        if fresh[n]:
            backward[:] = 1.0
            continue
        anywhere = 0.0
        for j in range(kinds):
            ahead[j] = working[n, j] * backward[j] / scale[n]
            anywhere += share[j] * ahead[j]
        ahead[kinds] = resting[n] * backward[kinds] / scale[n]
        kept = (1.0 - rest) * (1.0 - move)
        for j in range(kinds):
            beside = 0.5 * drift * (ahead[max(j - 1, 0)] + ahead[min(j + 1, kinds - 1)])
            held = (1.0 - drift) * ahead[j] + beside
            backward[j] = kept * held + (1.0 - rest) * move * anywhere + rest * ahead[kinds]
        backward[kinds] = (1.0 - leave) * ahead[kinds] + leave * anywhere
    return coasting, logarithm


def rates(step: float, *, coasts: float = 1.0) -> tuple[float, float, float, float]:
    """What `posterior` needs to know of a step [s]; with `coasts` 0 nobody ever coasts."""
    leave, rest, move, drift = (
        float(-np.expm1(-step / time))
        for time in (COASTING_TIME, EFFORT_TIME, HELD_TIME, DRIFT_TIME)
    )
    return leave, coasts * rest, move, drift

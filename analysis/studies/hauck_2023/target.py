"""What a tracking controller follows where the reference itself cannot be followed.

Rows of position [m], speed [m/s] and lever, one every `SAMPLING`. A *run* is the fastest one by
(n,) arrays of positions, speeds, times and levers, as `reference_dynamics.fastest_run` gives it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.studies.hauck_2023.reference import SAMPLING

FloatArray = NDArray[np.float64]
Fast = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

LATEST = 0.97
"""Where the fastest run takes this share of the time that is left no train should be behind."""

RETURN = 20.0
"""Time constant of leads, and with which a train that is near its target returns to it [s]."""

GENTLE = 0.05
"""With which the speed of a train that returns comes back to the target's, at most [m/s²]."""

NEAR = 1.0
"""A train within this [m] of its target is the program's own affair."""


def latest(run: Fast, due: float, count: int) -> FloatArray:
    """Where a train must be, second by second, to arrive in time with a little in hand.

    At each place the fastest run takes `LATEST` of the time that is left from there; what is in
    hand shrinks to nothing at the stop, where the train arrives on the second.

    Parameters
    ----------
    run : Fast
        From departure to stop.
    due : float [s]
        Arrival, from the departure of the timetable.
    count : int

    Returns
    -------
    (count, 3) array
    """
    left = due - SAMPLING * np.arange(count, dtype=np.float64)
    now = run[2][-1] - LATEST * left
    return _rows(run, now, LATEST, (now > 0.0) & (left > 0.0))


def with_lead(rows: FloatArray, least: FloatArray) -> FloatArray:
    """Rows of a reference, brought ahead of it where it would fall behind `least`.

    The lead grows by `RETURN` towards the place where it is needed, so that a train need not brake
    with its reference and pull again.

    Parameters
    ----------
    rows, least : (n, 3) arrays

    Returns
    -------
    (n, 3) array
    """
    lead = np.maximum(least[:, 0] - rows[:, 0], 0.0)
    fading = np.exp(-SAMPLING / RETURN)
    for k in range(lead.size - 2, -1, -1):
        lead[k] = max(lead[k], fading * lead[k + 1])
    found = rows.copy()
    found[:, 0] += lead
    found[:-1, 1] += np.diff(lead) / SAMPLING
    held = (lead > 0.0) & (least[:, 0] > found[:, 0] - 1e-6)
    found[held] = least[held]
    return found


def paced(run: Fast, pace: float, steps: int) -> FloatArray:
    """The fastest run slowed so that it takes 1/pace of its time.

    Parameters
    ----------
    run : Fast
        From where the train is.
    pace : float
        Not above 1.
    steps : int

    Returns
    -------
    (steps + 1, 3) array
    """
    now = pace * SAMPLING * np.arange(steps + 1, dtype=np.float64)
    return _rows(run, now, pace, now >= 0.0)


def returning(off: float, steps: int) -> FloatArray:
    """How a train that is off its target returns to it: what is left, and its rate.

    By `RETURN` near the target; from farther away its speed changes by `GENTLE`. Within `NEAR`
    nothing is left: a program that is told to hold a distance cannot make up for what no model
    knows.

    Parameters
    ----------
    off : float [m]
        Position less the target's.
    steps : int

    Returns
    -------
    (steps + 1, 2) array [m], [m/s]
    """
    time = SAMPLING * np.arange(steps + 1, dtype=np.float64)
    size = abs(off) ** 3 / (off**2 + NEAR**2)
    near = min(size, GENTLE * RETURN**2)
    rate = np.sqrt((near / RETURN) ** 2 + 2.0 * GENTLE * (size - near))
    begun = (rate - near / RETURN) / GENTLE
    far = size - rate * time + 0.5 * GENTLE * time**2
    fading = near * np.exp(-(time - begun) / RETURN)
    left = np.where(time < begun, far, fading)
    change = np.where(time < begun, rate - GENTLE * time, fading / RETURN)
    return np.asarray(np.sign(off) * np.column_stack([left, -change]))


def _rows(run: Fast, now: FloatArray, pace: float, moving: NDArray[np.bool_]) -> FloatArray:
    """A run at times of its own [s]; a lever is held for a second, and its middle stands for it."""
    positions, speeds, times, levers = run
    return np.column_stack([
        np.interp(now, times, positions),
        pace * np.interp(now, times, speeds) * moving,
        np.interp(now + 0.5 * pace * SAMPLING, times, levers),
    ])  # fmt: skip

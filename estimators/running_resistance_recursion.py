"""The recursion of the filter of running resistance: compiled, in place, sample by sample.

The covariance is ``U D Uᵀ`` with the speed first and the grade offset second; see
`estimators.running_resistance`, which is its face, for what is modelled.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainlog.units import GRAVITY

FloatArray = NDArray[np.float64]

UNIT_SPEED = 30.0
"""Speed [m/s] at which the parts of the drag are counted, so that all are of like size."""

FORCE_NOISE = 1e-3
"""Noise of the motion that nothing else explains [m/s per s^0.5]: wind, rounded efforts."""

UNKNOWN_SPEED = 10.0
"""How far the speed may have changed [m/s] over a step whose force is not known."""

LONGEST_STEP = 2.0
"""A longer step [s] is one whose force is not known."""

GATE = 5.0
"""A measurement further off than this many standard deviations is left out."""

MOST_LEFT_OUT = 10
"""After so many in a row it is the motion that was wrong: the speed starts anew."""


@njit(cache=True)  # type: ignore[untyped-decorator]
def run_block(
    rows: FloatArray,
    settings: FloatArray,
    prior_std: FloatArray,
    mean: FloatArray,
    upper: FloatArray,
    diagonal: FloatArray,
    last: FloatArray,
    counts: NDArray[np.int64],
    kept: FloatArray,
) -> None:
    """Run the filter over a block in place; record it where `kept` has rows."""
    gain, row = np.zeros(6), np.zeros(6)
    variance = settings[3] ** 2
    for k in range(rows.shape[0]):
        if not np.isnan(last[0]):
            step = rows[k, 0] - last[0]
            if rows[k, 5] != last[4]:
                _new_section(mean, upper, diagonal, prior_std[1] ** 2)
            known = rows[k, 6] > 0.0 and last[5] > 0.0 and step <= LONGEST_STEP
            if known:
                effort = 0.5 * (rows[k, 2] + last[1])
                track = 0.5 * (rows[k, 3] + last[2])
                slope = 0.5 * (rows[k, 4] + last[3])
                _move(mean, upper, diagonal, row, step, effort, track, slope, settings)
            else:
                diagonal[0] += UNKNOWN_SPEED**2
        last[0] = rows[k, 0]
        for column in range(1, 6):
            last[column] = rows[k, column + 1]
        counts[0] += 1
        innovation, spread = np.nan, np.nan
        if not np.isnan(rows[k, 1]):
            innovation = rows[k, 1] - mean[0]
            spread = variance
            for j in range(6):
                spread += upper[0, j] ** 2 * diagonal[j]
            if innovation**2 > GATE**2 * spread and last[6] < MOST_LEFT_OUT:
                last[6] += 1.0
                counts[1] += 1
            else:
                if last[6] >= MOST_LEFT_OUT:
                    diagonal[0] += UNKNOWN_SPEED**2
                last[6] = 0.0
                _measure(mean, upper, diagonal, gain, innovation, variance)
        if k < kept.shape[0]:
            _record(kept[k], mean, upper, diagonal, row, settings[0])
            kept[k, 7], kept[k, 8] = innovation, np.sqrt(spread)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _new_section(mean: FloatArray, upper: FloatArray, diagonal: FloatArray, prior: float) -> None:
    """The grade offset returns to its prior; what is known of all else stays as it is."""
    diagonal[0] += diagonal[1] * upper[0, 1] ** 2
    upper[0, 1] = 0.0
    upper[1, 2:] = 0.0
    diagonal[1] = prior
    mean[1] = 0.0


@njit(cache=True)  # type: ignore[untyped-decorator]
def _move(
    mean: FloatArray,
    upper: FloatArray,
    diagonal: FloatArray,
    row: FloatArray,
    step: float,
    effort: float,
    track: float,
    slope: float,
    settings: FloatArray,
) -> None:
    """One step of the equation of motion, by the midpoint rule, and of its covariance."""
    share = effort / settings[0]
    inertia = 1.0 + settings[2] / settings[0] * mean[2]
    before = mean[0]
    given = mean[2] * share - track - mean[1] - mean[3]
    speed = before / UNIT_SPEED
    acceleration = (given - (mean[4] + mean[5] * speed) * speed) / inertia
    speed = (before + 0.5 * step * acceleration) / UNIT_SPEED
    acceleration = (given - (mean[4] + mean[5] * speed) * speed) / inertia
    mean[0] = before + step * acceleration
    # Row of the transition's derivative; all other rows are those of the identity.
    weight = step / inertia
    keep = 1.0 - weight * (mean[4] + 2.0 * mean[5] * speed) / UNIT_SPEED
    row[1] = -weight
    row[2] = weight * (share - settings[2] / settings[0] * acceleration)
    row[3] = -weight
    row[4] = -weight * speed
    row[5] = -weight * speed * speed
    for j in range(5, 0, -1):
        total = keep * upper[0, j] + row[j]
        for i in range(1, j):
            total += row[i] * upper[i, j]
        upper[0, j] = total
    # A change of gradient passes within 2 reach/v; misplaced by x it gives slope 2 reach x/v.
    misplaced = slope**2 * 2.0 * settings[6] * settings[5] ** 2 / max(before, 1.0)
    diagonal[0] = keep**2 * diagonal[0] + (misplaced + FORCE_NOISE**2) * step


@njit(cache=True)  # type: ignore[untyped-decorator]
def _measure(
    mean: FloatArray,
    upper: FloatArray,
    diagonal: FloatArray,
    gain: FloatArray,
    innovation: float,
    variance: float,
) -> None:
    """Bierman's update by a measured speed, in place."""
    alpha = variance
    for j in range(6):
        f = upper[0, j]
        weighted = diagonal[j] * f
        before = alpha
        alpha += f * weighted
        diagonal[j] *= before / alpha
        slope = -f / before
        for i in range(j):
            old = upper[i, j]
            upper[i, j] = old + slope * gain[i]
            gain[i] += weighted * old
        gain[j] = weighted
    for i in range(6):
        mean[i] += gain[i] * (innovation / alpha)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _record(
    kept: FloatArray,
    mean: FloatArray,
    upper: FloatArray,
    diagonal: FloatArray,
    row: FloatArray,
    expected_mass: float,
) -> None:
    """Coefficients and mass, the curve at the present speed with its deviation, the offset."""
    mass = expected_mass / mean[2]
    speed = max(mean[0], 0.0) / UNIT_SPEED
    curve = mean[3] + (mean[4] + mean[5] * speed) * speed
    row[0] = row[1] = 0.0
    row[2] = -curve / mean[2]
    row[3], row[4], row[5] = 1.0, speed, speed * speed
    variance = 0.0
    for j in range(6):
        product = 0.0
        for i in range(j + 1):
            product += row[i] * upper[i, j]
        variance += product**2 * diagonal[j]
    kept[0] = mass * mean[3]
    kept[1] = mass * mean[4] / UNIT_SPEED
    kept[2] = mass * mean[5] / UNIT_SPEED**2
    kept[3] = mass
    kept[4] = mass * curve
    kept[5] = mass * np.sqrt(variance)
    kept[6] = mean[1] / GRAVITY

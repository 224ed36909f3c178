"""Largest traction power, from the stretches on which the train was at its limit."""

from __future__ import annotations

import numpy as np
import pandas as pd

from analysis.resistance.recording import Prepared
from trainlog.railway.train import Train
from trainlog.resampling import interpolated
from trainlog.trip import Trip

SHORTEST = 5.0
"""Shorter time at the limit than this [s] tells nothing."""

LOWEST_SPEED = 8.0
"""Below this speed [m/s] effort is limited by adhesion or by the motors, not by power."""

PLATEAU = 0.03
"""Power within this share of the highest counts as the same limit."""

SPEED_RANGE = 2.0
"""Power must stay the same while speed changes by this [m/s]; a limit of effort does not."""

WEAKEST = 0.5
"""Share of the train's stated power below which another limit (adhesion, a fault) is at work."""


def power_limit(trip: Trip, prepared: Prepared, train: Train) -> float | None:
    """Traction power at the wheel rims [W] where more effort was asked for than was given.

    Efforts are averaged over two seconds; wheels that slip and transients are left out. The
    wheels' own speed counts where it is recorded: it is the motors that are limited.

    Returns
    -------
    float or None
        None if the train was not at its power limit for `SHORTEST` at least.
    """
    controls = trip["/train/controls"]
    index, recording = prepared.index, prepared.recording
    step = float(np.median(np.diff(recording.time)))
    width = max(1, round(2.0 / step))
    demand, effort = (
        _moving_average(interpolated(controls, name, index), width)
        for name in ("tractive_effort_demand", "tractive_effort")
    )
    power = _moving_average(_power(trip, index, prepared), width)
    limited = recording.usable & (recording.speed > LOWEST_SPEED) & np.isfinite(power)
    limited &= demand > 1.01 * effort
    # A limit that lasts: true for the whole averaging time around the sample.
    limited &= _moving_average(limited.astype(np.float64), width) > 0.999
    if np.count_nonzero(limited) * step < SHORTEST:
        return None
    highest = float(np.quantile(power[limited], 0.98))
    plateau = limited & (power > (1.0 - PLATEAU) * highest)
    found, speeds = float(np.median(power[plateau])), recording.speed[plateau]
    lasts = np.count_nonzero(plateau) * step >= SHORTEST and np.ptp(speeds) >= SPEED_RANGE
    return found if lasts and found > WEAKEST * train.max_traction_power else None


def _power(trip: Trip, index: pd.DatetimeIndex, prepared: Prepared) -> np.ndarray:
    """Power of the motors [W] at each sample."""
    if "/train/axles" in trip:
        axles = trip["/train/axles"]
        numbers = [n.rpartition("_")[2] for n in axles.columns if n.startswith("wheel_effort_")]
        products = [
            interpolated(axles, f"wheel_effort_{n}", index)
            * interpolated(axles, f"wheel_speed_{n}", index)
            for n in numbers
        ]
        if products and np.isfinite(np.sum(products, axis=0)).any():
            return np.asarray(np.sum(products, axis=0) / prepared.scale.factor)
    effort = interpolated(trip["/train/controls"], "tractive_effort", index)
    return np.asarray(effort * prepared.recording.speed)


def _moving_average(values: np.ndarray, width: int) -> np.ndarray:
    """Centred mean over `width` samples; NaN where it would reach beyond the data."""
    out = np.full(values.size, np.nan)
    if values.size < width:
        return out
    sums = np.convolve(values, np.ones(width) / width, mode="valid")
    first = width // 2
    out[first : first + sums.size] = sums
    return out

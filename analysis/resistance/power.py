"""Largest traction power, from the stretches on which the train was at its limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.resistance.recording import Prepared
from trainlog.arrays import FloatArray, robust_std
from trainlog.railway.resistance import EffortCurve
from trainlog.railway.train import Train
from trainlog.resampling import interpolated
from trainlog.trip import Trip

SHORTEST = 5.0
"""Shorter time at the limit than this [s] is not used."""

LOWEST_SPEED = 8.0
"""Below this speed [m/s] effort is limited by adhesion or by the motors, not by power."""

AVERAGED = 2.0
"""Efforts are averaged over this time [s]."""

LASTING = 6.0
"""Averages that lie so far apart [s] count as independent: then 39 of 40 simulated limits lie
within their 95 % band."""

PLATEAU = 0.03
"""Power within this share of the highest counts as the same limit."""

SPEED_RANGE = 2.0
"""Power must stay the same while speed changes by this [m/s]; a limit of effort does not."""

STEEP = 0.5
"""Relative fall of a curve of effort over the relative rise of speed, from which its efforts show
the power; where power alone limits it is 1."""

UNEVEN = 0.08
"""Relative scatter of the power that efforts on a curve show, beyond which several limits acted."""

FULL_LEVER = 0.99
"""From this lever position on all the traction there is is asked for."""

WEAKEST = 0.5
"""Share of the train's stated power below which another limit (adhesion, a fault) is at work."""


@dataclass(frozen=True, slots=True)
class PowerLimit:
    """Largest traction power at the wheel rims and its standard deviation [W], seen for [s]."""

    power: float
    std: float
    time: float


def power_limit(
    trip: Trip, prepared: Prepared, train: Train, scale_std: float
) -> PowerLimit | None:
    """Traction power at the wheel rims where the train was at its limit.

    More effort was asked for there than was given. Efforts are averaged; wheels that slip and
    transients are left out. The wheels' own speed counts where it is recorded: it is the motors
    that are limited. Where no effort demand is recorded, a full lever asks for more than is given;
    what the effort of adhesion or of the motors limits then is left out, as its power is not the
    same at all speeds.

    Parameters
    ----------
    trip : Trip
        Its efforts in time and size.
    prepared : Prepared
    train : Train
    scale_std : float
        Standard deviation of the speed scale; the power has the same on top.

    Returns
    -------
    PowerLimit or None
        None if the train was not at its power limit for `SHORTEST` at least.
    """
    controls, index = trip["/train/controls"], prepared.index
    step = float(np.median(np.diff(prepared.time)))
    width = max(1, round(AVERAGED / step))
    power = _moving_average(_power(trip, index, prepared, train), width)
    steady = prepared.usable & (prepared.slip_momentum == 0.0)
    limited = steady & (prepared.speed > LOWEST_SPEED) & np.isfinite(power)
    if controls["tractive_effort_demand"].notna().any():
        demand, effort = (
            _moving_average(interpolated(controls, name, index), width)
            for name in ("tractive_effort_demand", "tractive_effort")
        )
        limited &= demand > 1.01 * effort
    else:
        limited &= interpolated(controls, "lever", index) >= FULL_LEVER
    # A limit that lasts: true for the whole averaging time around the sample.
    limited &= _moving_average(limited.astype(np.float64), width) > 0.999
    power, speed = power[limited], prepared.speed[limited]
    if train.traction_curve is not None:
        power, speed = _equivalent_power(power, speed, train, train.traction_curve.without_rise)
    if power.size * step < SHORTEST:
        return None
    plateau = power > (1.0 - PLATEAU) * float(np.quantile(power, 0.98))
    if train.traction_curve is not None and power.size:
        # All of it shows the same share, and more scattered: the highest would be the noise's.
        middle = float(np.median(power))
        spread = robust_std(power - middle)
        if spread > UNEVEN * middle:
            return None
        plateau = np.abs(power - middle) < max(PLATEAU * middle, 3.0 * spread)
    found, speeds = float(np.median(power[plateau])), speed[plateau]
    time = float(np.count_nonzero(plateau) * step)
    lasts = time >= SHORTEST and np.ptp(speeds) >= SPEED_RANGE
    if not lasts or found <= WEAKEST * train.max_traction_power:
        return None
    scatter = robust_std(power[plateau] - found)
    # Averages overlap, and what scatters lasts longer than one of them.
    own = 1.2533 * scatter / np.sqrt(max(time / LASTING, 1.0))
    return PowerLimit(found, float(np.hypot(own, scale_std * found)), time)


def _equivalent_power(
    power: FloatArray, speed: FloatArray, train: Train, curve: EffortCurve
) -> tuple[FloatArray, FloatArray]:
    """Power [W] of a train whose curve gives the effort of each sample, and the speeds [m/s].

    The curve of a train with a share of the power has each effort at that share of its speed. Where
    effort hardly falls with the speed it says nothing of the power, and is left out.
    """
    power, speed = power[power > 0.0], speed[power > 0.0]
    effort = power / speed
    reached = curve.speed_at(effort)
    known = (reached > 0.0) & (-curve.slope(reached) * reached >= STEEP * effort)
    share = speed[known] / reached[known]
    # Whichever limits more needs the larger share: the curve or the stated power.
    return np.maximum(share * train.max_traction_power, power[known]), speed[known]


def _power(trip: Trip, index: pd.DatetimeIndex, prepared: Prepared, train: Train) -> np.ndarray:
    """Power of the motors [W] at each sample; by the axles if speed and effort of all are there."""
    if "/train/axles" in trip:
        axles = trip["/train/axles"]
        efforts = [n.rpartition("_")[2] for n in axles.columns if n.startswith("wheel_effort_")]
        numbers = [n for n in efforts if f"wheel_speed_{n}" in axles]
        products = [
            interpolated(axles, f"wheel_effort_{n}", index)
            * interpolated(axles, f"wheel_speed_{n}", index)
            for n in numbers
        ]
        if (
            len(products) >= max(train.axles.count, 1)
            and np.isfinite(np.sum(products, axis=0)).any()
        ):
            return np.asarray(np.sum(products, axis=0) / prepared.scale.factor)
    effort = interpolated(trip["/train/controls"], "tractive_effort", index)
    return np.asarray(effort * prepared.speed)


def _moving_average(values: np.ndarray, width: int) -> np.ndarray:
    """Centred mean over `width` samples; NaN where it would reach beyond the data."""
    out = np.full(values.size, np.nan)
    if values.size < width:
        return out
    sums = np.convolve(values, np.ones(width) / width, mode="valid")
    first = width // 2
    out[first : first + sums.size] = sums
    return out

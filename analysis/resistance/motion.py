"""A trip's motion, without its efforts: speed, chainage, and how noisy the speed is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.resistance.recording import SpeedScale, speed_scale
from analysis.resistance.windows import integral_between
from estimators.motion import smooth_motion
from trainlog.arrays import BoolArray, FloatArray, robust_std
from trainlog.errors import LogError, NotIdentifiableError
from trainlog.trip import POSITION_TOPICS, Trip, seconds
from trainlog.units import NANOSECONDS

TOPICS = ("/gnss/motion", "/train/state", "/estimates/state")
"""What is read of a trip; efforts are not looked at, even if they were recorded."""

LOWEST_SPEED = 5.0
"""Slower than this [m/s] no coasting is looked for: a train that creeps up to a signal or a buffer
is braked, however gently."""

LEAST_NOISE = 1e-4
"""Smallest noise of a speed [m/s] that is assumed: exact data stay solvable."""

LONGEST_PERIOD = 2.5
"""Longest time between two samples of the speed [s] from which coasting can be detected."""

GAP_PERIODS = 2.6
"""A pause of more than so many sampling periods is a gap."""

OUTLIER = 8.0
"""A speed that is so many standard deviations off the smoothed motion is not used."""


@dataclass(frozen=True, eq=False)
class Motion:
    """How a train moved; all arrays (n,).

    Attributes
    ----------
    trip : str
    start : Timestamp
    source : str
        Topic of the speed.
    time : array [s]
        Since `start`, strictly increasing.
    speed : array [m/s]
        Measured, true to scale.
    position : array [m]
        Chainage in the direction of travel; NaN where it is not known.
    usable : bool array
        False at standstill, when creeping, in gaps and at outliers.
    noise : float [m/s]
        Standard deviation of one speed.
    period : float [s]
        Usual time between two samples.
    scale : SpeedScale
        What the measured speed was divided by.
    """

    trip: str
    start: pd.Timestamp
    source: str
    time: FloatArray
    speed: FloatArray
    position: FloatArray
    usable: BoolArray
    noise: float
    period: float
    scale: SpeedScale

    @property
    def has_position(self) -> bool:
        """Whether chainage is known at most usable samples."""
        known = np.isfinite(self.position[self.usable])
        return bool(known.size) and bool(np.mean(known) > 0.5)


def motion_of(trip: Trip) -> Motion:
    """The motion that a trip recorded: of the wheels' and the satellites' speed the less noisy.

    Parameters
    ----------
    trip : Trip
        With ``/gnss/motion`` or ``/train/state``; chainage from ``/estimates/state`` or
        ``/train/state`` where there is one.

    Raises
    ------
    NotIdentifiableError
        If no speed was recorded, or too seldom.
    LogError
        If time does not increase.
    """
    found = [each for each in (_speed(trip, topic) for topic in TOPICS[:2]) if each is not None]
    if not found:
        raise NotIdentifiableError(
            f"trip '{trip.name}': no speed was recorded",
            place="topics /gnss/motion and /train/state",
            remedy="coast-down needs the receiver's own (Doppler) speed or the wheels' speed;"
            " differences of positions are too coarse",
        )
    topic, index, speed = min(found, key=lambda each: _noise_density(*each[1:]))
    time = _seconds(index, index[0])
    period = float(np.median(np.diff(time)))
    if period > LONGEST_PERIOD:
        raise NotIdentifiableError(
            f"trip '{trip.name}': a speed every {period:.1f} s only",
            place=f"topic {topic}",
            remedy=f"coasting can be detected from speeds at most {LONGEST_PERIOD} s apart",
        )
    position = _position(trip, index)
    scale = SpeedScale(1.0, 0.0, "GNSS speed")
    if topic == "/train/state":
        scale = speed_scale(trip, time, speed, position)
    noise = max(_white_noise(speed), LEAST_NOISE)
    speed = speed / scale.factor
    return Motion(
        trip=trip.name,
        start=index[0],
        source=topic,
        time=time,
        speed=speed,
        position=position,
        usable=_usable(time, speed, noise, period),
        noise=noise,
        period=period,
        scale=scale,
    )


def smoothed_over(time: FloatArray, values: FloatArray, reach: float) -> FloatArray:
    """Mean of sampled values (n,) over `reach` [s] before and after each sample.

    Speed and what acts on it are averaged alike, so that the equation of motion still holds.
    """
    low, high = np.maximum(time - reach, time[0]), np.minimum(time + reach, time[-1])
    column = values[:, None]
    return np.asarray(integral_between(time, column, low, high)[:, 0] / (high - low))


def _speed(trip: Trip, topic: str) -> tuple[str, pd.DatetimeIndex, FloatArray] | None:
    """Known speeds of a topic and when they were measured."""
    if topic not in trip:
        return None
    frame = trip[topic]
    values = frame["speed"].to_numpy(dtype=np.float64)
    known = np.isfinite(values)
    if np.count_nonzero(known) < 3:
        return None
    index = pd.DatetimeIndex(frame.index)[known]
    steps = np.diff(index.as_unit("ns").asi8)
    if np.any(steps <= 0):
        raise LogError(
            f"trip '{trip.name}': time does not increase",
            place=f"topic {topic}, row {int(np.argmax(steps <= 0)) + 1}",
            remedy="ingest the recording again; that repairs it",
        )
    return topic, index, values[known]


def _position(trip: Trip, index: pd.DatetimeIndex) -> FloatArray:
    """Chainage at the given times; NaN before it is first known and after it was last."""
    for topic in POSITION_TOPICS:
        if topic not in trip:
            continue
        frame = trip[topic]
        known = frame["position"].notna().to_numpy()
        if np.count_nonzero(known) > 1:
            there = seconds(frame, index[0])[known]
            values = frame["position"].to_numpy(dtype=np.float64)[known]
            at = _seconds(index, index[0])
            return np.asarray(np.interp(at, there, values, left=np.nan, right=np.nan))
    return np.full(len(index), np.nan)


def _seconds(index: pd.DatetimeIndex, origin: pd.Timestamp) -> FloatArray:
    return np.asarray((index - origin) / pd.Timedelta(seconds=1), dtype=np.float64)


def _noise_density(index: pd.DatetimeIndex, speed: FloatArray) -> float:
    """Variance of the noise times the sampling period: what averaging over a second leaves."""
    period = float(np.median(np.diff(index.as_unit("ns").asi8))) / NANOSECONDS
    return max(_white_noise(speed), LEAST_NOISE) ** 2 * period


def _white_noise(speed: FloatArray) -> float:
    """Standard deviation of white noise on a smooth speed [m/s], from its third differences."""
    moving = speed > LOWEST_SPEED
    third = np.diff(speed, 3)
    third = third[moving[3:] & moving[:-3]]
    return robust_std(third) / np.sqrt(20.0) if third.size else 0.0


def _usable(time: FloatArray, speed: FloatArray, noise: float, period: float) -> BoolArray:
    """Samples that belong to an uninterrupted motion at more than `LOWEST_SPEED`."""
    motion = smooth_motion(time, speed, max(noise, 0.01))
    spread = np.hypot(motion.speed_std, max(noise, 0.01))
    usable = (motion.speed > LOWEST_SPEED) & (np.abs(speed - motion.speed) < OUTLIER * spread)
    pause = np.diff(time) > GAP_PERIODS * period
    usable[1:] &= ~pause
    usable[:-1] &= ~pause
    return np.asarray(usable)

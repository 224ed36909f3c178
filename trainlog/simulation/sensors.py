"""What a train's sensors make of a true motion.

Everything here turns the plant's exact samples into what a real train would have recorded: noise,
quantisation, wheel diameters that are not what the odometer believes, chainage that drifts and is
set right at balises, satellites that are lost.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.railway import Line
from trainlog.topics import ENVIRONMENT, GNSS_FIX, GNSS_MOTION, TRAIN_STATE
from trainlog.trip import frame_of
from trainlog.units import EARTH_RADIUS, NANOSECONDS


@dataclass(frozen=True, slots=True)
class Sensors:
    """How good the sensors of a train are.

    Attributes
    ----------
    rate : int [Hz]
        Of the on-board topics; a multiple of 10 that divides 200.
    speed_noise, speed_resolution : float [m/s]
    acceleration_noise, acceleration_resolution : float [m/s²]
    effort_noise : float
        Standard deviation over the effort itself.
    effort_resolution : float [N]
    diameter_error : float
        Standard deviation of the wheel diameter over the believed one, common to the trip; a
        third of it again from axle to axle.
    balise_spacing, balise_error : float [m]
        Mean distance between balises, and standard deviation of the chainage after one.
    gnss_position_noise : float [m]
        Standard deviation of each horizontal axis, correlated over half a minute.
    gnss_speed_noise : float [m/s]
    outages : float [1/s]
        Satellite outages begin at this rate, each lasting 10 to 60 s.
    load_error : float or None
        Standard deviation of the load that the air springs show, over the largest load; None where
        nothing weighs it and the log states no load.
    wheel_factors : tuple of float
        Believed over true diameter that lasts from trip to trip: of the odometer's axle, then of
        each powered axle; empty: all 1.
    effort_gain : float
        Recorded over true effort.
    effort_delay : float [s]
        By how much recorded efforts are late.
    """

    rate: int = 10
    speed_noise: float = 0.03
    speed_resolution: float = 0.01
    acceleration_noise: float = 0.03
    acceleration_resolution: float = 0.01
    effort_noise: float = 0.01
    effort_resolution: float = 100.0
    diameter_error: float = 0.003
    balise_spacing: float = 1250.0
    balise_error: float = 0.5
    gnss_position_noise: float = 2.5
    gnss_speed_noise: float = 0.08
    outages: float = 1.0 / 600.0
    load_error: float | None = 0.025
    wheel_factors: tuple[float, ...] = ()
    effort_gain: float = 1.0
    effort_delay: float = 0.0

    def __post_init__(self) -> None:
        if self.rate < 10 or self.rate % 10 or 200 % self.rate:
            raise InputError(
                f"sensors: rate {self.rate} Hz does not divide the simulation's 200 Hz",
                remedy="use 10, 20, 40, 50, 100 or 200 Hz",
            )
        for name in self.__slots__:
            value = getattr(self, name)
            if value is not None and not np.all(np.asarray(value) >= 0.0):
                raise InputError(f"sensors: {name} {value} is negative", remedy="give 0 or more")

    def known(self) -> dict[str, Any]:
        """All fields by name, but those of a single train that are as of any other."""
        found = asdict(self)
        usual = {"wheel_factors": (), "effort_gain": 1.0, "effort_delay": 0.0}
        return {key: value for key, value in found.items() if value != usual.get(key, math.nan)}


def rounded(values: FloatArray, resolution: float) -> FloatArray:
    """Values as a display with that resolution shows them; 0 means infinitely fine."""
    if resolution == 0.0:
        return values
    # Dividing by the whole number of steps a unit gives 12.34, not 12.340000000000002.
    per_unit = 1.0 / resolution
    if abs(per_unit - round(per_unit)) < 1e-9 * per_unit:
        return np.asarray(np.round(values * round(per_unit)) / round(per_unit) + 0.0)
    return np.asarray(np.round(values / resolution) * resolution + 0.0)


def wheel_scales(
    axles: int, sensors: Sensors, generator: np.random.Generator
) -> tuple[float, FloatArray]:
    """Believed over true wheel diameter: of the odometer's axle, and of each powered axle."""
    common = 1.0 + sensors.diameter_error * generator.standard_normal()
    own = common + sensors.diameter_error / 3.0 * generator.standard_normal(axles)
    if sensors.wheel_factors:
        common *= sensors.wheel_factors[0]
        own *= np.array(sensors.wheel_factors[1:])
    return common, own


def measured_speed(
    speed: FloatArray, scale: float | FloatArray, sensors: Sensors, generator: np.random.Generator
) -> FloatArray:
    """Speed from turning wheels [m/s]: never negative, exactly 0 when they stand."""
    noisy = speed * scale + sensors.speed_noise * generator.standard_normal(speed.shape)
    noisy = np.where(speed > 0.0, np.maximum(noisy, 0.0), 0.0)
    return rounded(noisy, sensors.speed_resolution)


def measured_effort(
    effort: FloatArray, sensors: Sensors, generator: np.random.Generator
) -> FloatArray:
    """Effort [N] from the converter's torque estimate: proportional noise, quantised."""
    noise = 1.0 + sensors.effort_noise * generator.standard_normal(effort.shape)
    noisy = sensors.effort_gain * effort * noise
    return rounded(noisy, sensors.effort_resolution)


def weighed_load(load: float, largest: float, sensors: Sensors, seed: int) -> tuple[float, float]:
    """Load [kg] that the air springs show before departure, and its standard deviation [kg].

    Parameters
    ----------
    load, largest : float [kg]
        As it is, and the largest.
    sensors : Sensors
        Whose `load_error` is not None.
    seed : int
        Of the trip.
    """
    std = (sensors.load_error or 0.0) * largest
    # Numbers of its own: those of the other sensors stay as they are.
    error = std * float(np.random.default_rng([seed, 11]).standard_normal())
    return max(load + error, 0.0), std


def odometry(
    position: FloatArray, scale: float, sensors: Sensors, generator: np.random.Generator
) -> FloatArray:
    """Chainage [m] as the train believes it: dead reckoning, set right at each balise."""
    start, end = float(position[0]), float(position[-1])
    count = int((end - start) / max(sensors.balise_spacing, 1.0)) + 2
    spacing = sensors.balise_spacing * generator.uniform(0.8, 1.2, count)
    balises = np.concatenate(([start], start + np.cumsum(spacing)))
    error = sensors.balise_error * generator.standard_normal(balises.size)
    index = np.clip(np.searchsorted(balises, position, side="right") - 1, 0, balises.size - 1)
    # The train learns of a balise at the first sample beyond it.
    last = balises[index]
    return np.asarray(np.round(last + error[index] + (position - last) * scale, 2))


def train_state(
    time: IntArray,
    position: FloatArray,
    speed: FloatArray,
    acceleration: FloatArray,
    scale: float,
    sensors: Sensors,
    generator: np.random.Generator,
) -> pd.DataFrame:
    """What the odometry says: the ``/train/state`` topic."""
    noisy = acceleration + sensors.acceleration_noise * generator.standard_normal(time.size)
    return frame_of(
        TRAIN_STATE,
        time,
        {
            "position": odometry(position, scale, sensors, generator),
            "speed": measured_speed(speed, scale, sensors, generator),
            "acceleration": rounded(noisy, sensors.acceleration_resolution),
        },
    )


def correlated(
    count: int, period: float, memory: float, generator: np.random.Generator
) -> FloatArray:
    """Ornstein-Uhlenbeck noise of unit variance at `count` instants or places `period` apart."""
    from scipy.signal import lfilter

    keep = np.exp(-period / memory)
    white = generator.standard_normal(count)
    white[1:] *= np.sqrt(1.0 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white))


def outage_mask(
    seconds: FloatArray, hidden: BoolArray, sensors: Sensors, generator: np.random.Generator
) -> BoolArray:
    """Where the satellites are seen: not in tunnels (`hidden`), nor in random outages."""
    seen = ~hidden
    expected = sensors.outages * float(seconds[-1] - seconds[0])
    for _ in range(int(generator.poisson(expected))):
        begin = generator.uniform(seconds[0], seconds[-1])
        seen &= (seconds < begin) | (seconds >= begin + generator.uniform(10.0, 60.0))
    seen[0] = True
    return np.asarray(seen)


def gnss(
    line: Line,
    time: IntArray,
    position: FloatArray,
    speed: FloatArray,
    sensors: Sensors,
    generator: np.random.Generator,
) -> tuple[pd.DataFrame | None, pd.DataFrame, list[tuple[int, str]]]:
    """Satellite fixes at 5 Hz.

    Parameters
    ----------
    line : Line
        As travelled.
    time : (n,) int array [ns]
        Of the true samples.
    position, speed : (n,) array [m], [m/s]

    Returns
    -------
    fix : DataFrame or None
        ``/gnss/fix``; None where the line's place on the earth is not known.
    motion : DataFrame
        ``/gnss/motion``.
    changes : list of (time [ns], text)
        When the satellites were lost and found again.
    """
    period = NANOSECONDS // 5
    ticks = np.arange(time[0], time[-1] + 1, period, dtype=np.int64)
    s = np.interp(ticks - time[0], time - time[0], position)
    v = np.interp(ticks - time[0], time - time[0], speed)
    seen = outage_mask(
        (ticks - ticks[0]) / NANOSECONDS, line.tunnel_cross_section(s) > 0.0, sensors, generator
    )
    count = ticks.size
    quality = np.exp(0.25 * correlated(count, 0.2, 60.0, generator))
    east, north, up = (
        sensors.gnss_position_noise * quality * correlated(count, 0.2, 30.0, generator)
        for _ in range(3)
    )
    satellites = np.clip(np.round(11.0 - 4.0 * (quality - 1.0)), 4, 16)
    noisy = np.abs(v + sensors.gnss_speed_noise * quality * generator.standard_normal(count))
    motion = frame_of(
        GNSS_MOTION,
        ticks[seen],
        {
            "speed": np.round(noisy, 3)[seen],
            "speed_accuracy": np.round(sensors.gnss_speed_noise * quality, 3)[seen],
            "satellites": satellites[seen],
            "pdop": np.round(1.6 * quality, 2)[seen],
        },
    )
    edges = np.flatnonzero(np.diff(seen.astype(np.int8))) + 1
    words = {True: "satellites found again", False: "satellites lost"}
    changes = [(int(ticks[edge]), words[bool(seen[edge])]) for edge in edges]
    if line.geometry is None:
        return None, motion, changes
    latitude, longitude = line.geometry.at(s)
    metre = np.degrees(1.0 / EARTH_RADIUS)
    fix = frame_of(
        GNSS_FIX,
        ticks[seen],
        {
            "latitude": np.round(latitude + north * metre, 7)[seen],
            "longitude": np.round(longitude + east * metre / np.cos(np.radians(latitude)), 7)[seen],
            "altitude": np.round(line.altitudes(s) + 1.5 * up, 3)[seen],
            "horizontal_accuracy": np.round(sensors.gnss_position_noise * quality, 3)[seen],
            "vertical_accuracy": np.round(1.5 * sensors.gnss_position_noise * quality, 3)[seen],
        },
    )
    return fix, motion, changes


def environment(
    line: Line, time: IntArray, position: FloatArray, temperature: float
) -> pd.DataFrame:
    """The line under the train once a second: the ``/environment`` topic.

    Parameters
    ----------
    position : (n,) array [m]
        As the train believes it.
    temperature : float [K]
        Of the air; it warms by a degree an hour.
    """
    ticks = np.arange(time[0], time[-1] + 1, NANOSECONDS, dtype=np.int64)
    elapsed = (ticks - time[0]).astype(np.float64)
    s = np.interp(elapsed, (time - time[0]).astype(np.float64), position)
    s = np.clip(s, 0.0, line.length)
    return frame_of(
        ENVIRONMENT,
        ticks,
        {
            "speed_limit": line.speed_limit(s),
            "gradient": line.gradient(s),
            "curvature": line.curvature(s),
            "air_temperature": np.round(temperature + elapsed / NANOSECONDS / 3600.0, 1),
        },
    )


STATION_BALISES = (150.0, 25.0)
"""Balises lie so far before every station [m], besides those along the line: a train is to stop at
a point."""

SATELLITES_EVERY = 2
"""Samples from one satellite speed to the next."""

OUTAGE = (10.0, 60.0)
"""How long satellites are out of sight [s]."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One sample of a train's instruments; NaN where one shows nothing.

    Attributes
    ----------
    time : float [s]
    wheel_speed : float [m/s]
        Of an axle that neither pulls nor brakes, by the diameter that it is believed to have.
    acceleration : float [m/s²]
        Mean since the last sample.
    satellite_speed : float [m/s]
    balise : float [m]
        Chainage by a balise that was passed since the last sample.
    """

    time: float
    wheel_speed: float
    acceleration: float
    satellite_speed: float
    balise: float


class Instruments:
    """Of one train on one trip.

    Parameters
    ----------
    line : Line
        As travelled.
    sensors : Sensors
    start : float [m]
        Where the train stands, over a balise.
    scale : float
        Believed over true diameter of the wheel.
    generator : numpy.random.Generator
    """

    def __init__(
        self,
        line: Line,
        sensors: Sensors,
        start: float,
        scale: float,
        generator: np.random.Generator,
    ) -> None:
        self._line = line
        self._sensors = sensors
        self._scale = scale
        self._generator = generator
        self._balises = balises(line, sensors, start, generator)
        self._passed = 0
        self._samples = 0
        self._lost_until = -math.inf
        self._last = 0.0

    def read(self, time: float, position: float, speed: float, acceleration: float) -> Reading:
        """What the instruments show of a true motion; times and positions do not go back."""
        sensors = self._sensors
        noise = self._generator.standard_normal(4)
        wheel = 0.0
        if speed > 0.0:
            wheel = max(speed * self._scale + sensors.speed_noise * float(noise[0]), 0.0)
        felt = acceleration + sensors.acceleration_noise * float(noise[1])
        by_satellite = math.nan
        if self._samples % SATELLITES_EVERY == 0 and self._seen(time, position):
            by_satellite = abs(speed + sensors.gnss_speed_noise * float(noise[2]))
        balise = math.nan
        while self._passed < self._balises.size and position >= self._balises[self._passed]:
            balise = position + sensors.balise_error * float(noise[3])
            self._passed += 1
        self._samples += 1
        return Reading(
            time,
            _shown(wheel, sensors.speed_resolution),
            _shown(felt, sensors.acceleration_resolution),
            by_satellite,
            balise,
        )

    def _seen(self, time: float, position: float) -> bool:
        """Whether there are satellites: not in tunnels, nor in outages."""
        since, self._last = time - self._last, time
        if self._generator.uniform() < self._sensors.outages * since:
            self._lost_until = time + self._generator.uniform(*OUTAGE)
        place = min(position, self._line.length)
        return time >= self._lost_until and not self._line.tunnel_cross_section(place) > 0.0


def balises(
    line: Line, sensors: Sensors, start: float, generator: np.random.Generator
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Where a train that starts at `start` [m] passes balises, the first beneath it, (n,) [m]."""
    spacing = max(sensors.balise_spacing, 1.0)
    count = int((line.length - start) / (0.8 * spacing)) + 1
    along = start + np.cumsum(spacing * generator.uniform(0.8, 1.2, count))
    stations = np.array([station.position for station in line.stations])
    before = np.ravel(stations[:, None] - np.array(STATION_BALISES))
    found = np.unique(np.concatenate(([start], along, before)))
    return np.asarray(found[(found >= start) & (found <= line.length)])


def _shown(value: float, resolution: float) -> float:
    """A value as a display with that resolution shows it."""
    return round(value / resolution) * resolution if resolution > 0.0 else value

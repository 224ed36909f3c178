"""What a train's instruments tell those on board while it runs.

The errors are those of `trainlog.simulation.sensors`, one sample at a time: what a controller sees
does not wait for the trip's end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trainlog.railway import Line
from trainlog.simulation.sensors import Sensors

STATION_BALISES = (150.0, 25.0)
"""Balises lie so far before every station [m], besides those along the line: a train is to stop at
a point."""

SATELLITES_EVERY = 2
"""Samples from one satellite speed to the next."""

OUTAGE = (10.0, 60.0)
"""How long satellites are out of sight [s]."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One sample of a train's instruments; NaN where one tells nothing.

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
        """What the instruments tell of a true motion; times and positions do not go back."""
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

"""Weather drawn hour by hour: spells of rain, damp and dry days, frosty nights, falling leaves.

It follows the calendar of a temperate climate: leaves fall from October to the beginning of
December, most at the turn of October, and nights freeze when the season and the clear sky allow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.railway.weather import MILLIMETRE_PER_HOUR, Weather
from trainlog.units import NANOSECONDS

HOUR = 3600 * NANOSECONDS

DRY_SPELL, RAIN_SPELL, WIND_SPELL = (20.0, 0.8), (9.0, 0.7), (24.0, 0.6)
"""Median [h] and standard deviation of the logarithm of how long a spell lasts."""

MEAN_TEMPERATURE, YEARLY_SWING, DAILY_SWING = 281.5, 9.5, 5.0
"""Of the air [K]; the swings are amplitudes."""

FREEZING = 273.65
"""At this air temperature [K] and below, damp air leaves frost on the rail: it is colder."""

LEAF_FALL, LEAF_SEASON = 305.0, 34.0
"""Day of the year at which most leaves fall, and how many days before it the first fall."""

MANY_LEAVES = 1.2
"""Falling leaves, relative to a calm day at their peak, that make damp rail a leaf-covered one."""


@dataclass(frozen=True, eq=False)
class DrawnWeather:
    """Weather hour by hour, and how many leaves fall.

    Attributes
    ----------
    table : Weather
    falling : (n,) array
        Leaves that fall in each hour, relative to a calm day at the peak of their season.
    """

    table: Weather
    falling: FloatArray

    def rain_until(self, time: IntArray) -> FloatArray:
        """Rain since the first hour up to each time [m]."""
        starts = self.table.starts
        edges = np.append(starts, self.table.ends[-1])
        total = np.concatenate(([0.0], np.cumsum(3600.0 * self.table.precipitation)))
        return np.asarray(
            np.interp((time - starts[0]).astype(float), (edges - starts[0]).astype(float), total)
        )


def draw_weather(start: int, hours: int, generator: np.random.Generator) -> DrawnWeather:
    """Draw weather from `start` [ns since 1970 UTC] on.

    Parameters
    ----------
    start : int
    hours : int
    generator : numpy.random.Generator

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> start = pd.Timestamp("2026-10-01T00:00Z").value
    >>> drawn = draw_weather(start, 24 * 60, np.random.default_rng(1))
    >>> sorted(set(drawn.table.conditions))
    ['dry', 'frost', 'leaves', 'wet']
    """
    starts = start + HOUR * np.arange(hours, dtype=np.int64)
    stamps = pd.DatetimeIndex(starts, tz="UTC")
    hour, day = stamps.hour.to_numpy(), stamps.day_of_year.to_numpy().astype(float)
    raining = _spells(hours, DRY_SPELL, RAIN_SPELL, generator)
    amount = np.round(generator.gamma(0.8, 1.4, hours), 1)
    rain = np.where(raining & (generator.uniform(size=hours) < 0.8), amount, 0.0)
    since = _hours_since(rain > 0.0)
    drying = np.repeat(generator.uniform(1.0, 6.0, hours // 12 + 1), 12)[:hours]
    air = 0.93 - 0.3 * np.clip(np.sin(2.0 * np.pi * (hour - 8.0) / 24.0) + 0.4, 0.0, 1.0)
    humidity = np.where(raining, 0.95, air + generator.triangular(-0.1, 0.0, 0.05, hours))
    temperature = _temperature(hour, day, raining, generator)
    windy = _spells(hours, (48.0, 0.7), WIND_SPELL, generator)
    season = np.maximum(0.0, 1.0 - np.abs((day - LEAF_FALL) / LEAF_SEASON) ** 1.5)
    falling = season * np.where(windy, 4.0, 0.6)
    return _drawn(starts, rain, since <= drying, humidity, temperature, falling)


def local_weather(
    region: DrawnWeather, lag: int, warmer: float, generator: np.random.Generator
) -> DrawnWeather:
    """The weather of one area of a region: later, colder or warmer, with showers of its own.

    Parameters
    ----------
    region : DrawnWeather
    lag : int [h]
        By which the region's weather comes later.
    warmer : float [K]
    generator : numpy.random.Generator

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> start = pd.Timestamp("2026-10-01T00:00Z").value
    >>> region = draw_weather(start, 24 * 30, np.random.default_rng(1))
    >>> area = local_weather(region, 1, -1.5, np.random.default_rng(2))
    >>> same = np.mean([a == b for a, b in zip(area.table.conditions, region.table.conditions)])
    >>> bool(0.7 < same < 1.0)
    True
    """
    table = region.table
    hours = table.starts.size
    before = np.maximum(np.arange(hours) - lag, 0)
    rain = (table.precipitation / MILLIMETRE_PER_HOUR)[before]
    rain = rain * np.exp(0.35 * generator.standard_normal(hours))
    rain = np.where(generator.uniform(size=hours) > 0.1, rain, 0.0)
    shower = (table.humidity[before] > 0.9) & (generator.uniform(size=hours) < 0.05)
    rain = np.where(shower & (rain == 0.0), generator.gamma(0.8, 1.0, hours), rain).round(1)
    days = hours // 24 + 1
    humidity = table.humidity[before] + np.repeat(generator.uniform(-0.03, 0.03, days), 24)[:hours]
    humidity = np.where(rain > 0.0, 0.95, humidity)
    temperature = (
        table.temperature + warmer + np.repeat(generator.uniform(-0.6, 0.6, days), 24)[:hours]
    )
    drying = np.repeat(generator.uniform(1.0, 6.0, hours // 12 + 1), 12)[:hours]
    falling = region.falling[before] * generator.uniform(0.85, 1.15)
    lately = _hours_since(rain > 0.0) <= drying
    return _drawn(table.starts, rain, lately, humidity, temperature, falling)


def _drawn(
    starts: IntArray,
    rain: FloatArray,
    lately: BoolArray,
    humidity: FloatArray,
    temperature: FloatArray,
    falling: FloatArray,
) -> DrawnWeather:
    """Weather by the hour, with the rail condition that follows from it; (n,) arrays.

    `rain` is in mm/h, and `lately` is where it has not dried since the last.
    """
    damp = lately | (humidity > 0.9)
    frosty = (temperature <= FREEZING) & (rain == 0.0) & (humidity > 0.75)
    conditions = np.select(
        [frosty, rain > 0.0, damp & (falling > MANY_LEAVES), lately],
        ["frost", "wet", "leaves", "wet"],
        "dry",
    )
    table = Weather(
        starts,
        starts + HOUR,
        tuple(str(each) for each in conditions),
        np.round(temperature, 1),
        np.asarray(np.round(np.clip(humidity, 0.2, 1.0), 2), dtype=np.float64),
        MILLIMETRE_PER_HOUR * rain,
    )
    return DrawnWeather(table, falling)


def _spells(
    hours: int,
    off: tuple[float, float],
    on: tuple[float, float],
    generator: np.random.Generator,
) -> BoolArray:
    """Alternating spells of lognormal length, in which something holds or does not, (hours,)."""
    count = 2 * (hours // 4 + 2)
    median, spread = np.array([off, on]).T
    lengths = np.tile(median, count // 2) * np.exp(
        np.tile(spread, count // 2) * generator.standard_normal(count)
    )
    ends = np.cumsum(np.maximum(np.round(lengths), 1.0)) - generator.integers(int(off[0]))
    return np.asarray(np.searchsorted(ends, np.arange(hours), side="right") % 2 == 1)


def _hours_since(event: BoolArray) -> FloatArray:
    """Hours since the last one in which something happened; many where none did, (n,)."""
    index = np.arange(event.size)
    last = np.maximum.accumulate(np.where(event, index, -1000))
    return np.asarray(index - last, dtype=np.float64)


def _temperature(
    hour: NDArray[np.int32],
    day: FloatArray,
    raining: BoolArray,
    generator: np.random.Generator,
) -> FloatArray:
    """Of the air [K], (n,): season, days that resemble their neighbours, warm noons."""
    from scipy.signal import lfilter

    pushes = generator.uniform(-2.5, 2.5, day.size // 24 + 1)
    daily = lfilter([1.0], [1.0, -0.7], pushes)
    at_noon = np.interp(np.arange(day.size), 24.0 * np.arange(daily.size) + 12.0, daily)
    yearly = -YEARLY_SWING * np.cos(2.0 * np.pi * (day - 20.0) / 365.25)
    swing = np.where(raining, 0.3, 1.0) * DAILY_SWING
    return np.asarray(
        MEAN_TEMPERATURE + yearly + at_noon - swing * np.cos(2.0 * np.pi * (hour - 3.0) / 24.0)
    )

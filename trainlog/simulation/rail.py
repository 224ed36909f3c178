"""The rail: maximum adhesion along a line, for single trips and over the days of a calendar.

`base_map` and `trip_profile` draw what lasts of a line, and what one trip meets of it.

A `Rail` lives in time. What lasts is drawn once a rail condition (`draw_weather`),
and changes at stated dates. Passing spots have a place, a birth, a depth and a decay: leaves under
trees while they fall, contamination near stations, frost at night. Rain washes them away in part.
Lives are lognormal, their decay is log-logistic (it holds, then falls, with a long tail), births
are clustered in place and time, levels of sections step. Estimators must not assume these shapes.

The weather is drawn hour by hour and follows the calendar of a temperate climate: leaves fall from
October to the beginning of December, most at the turn of October, and nights freeze when the season
and the clear sky allow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.display import as_text, counted
from trainlog.errors import InputError
from trainlog.railway import Line, StepProfile
from trainlog.railway.condition import BIN_LENGTH
from trainlog.railway.weather import MILLIMETRE_PER_HOUR, Conditions, Weather
from trainlog.simulation.sensors import correlated
from trainlog.spans import utc
from trainlog.units import DAY, NANOSECONDS

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
    # Of the air [K], (n,): season, days that resemble their neighbours, warm noons.
    from scipy.signal import lfilter

    pushes = generator.uniform(-2.5, 2.5, day.size // 24 + 1)
    daily = lfilter([1.0], [1.0, -0.7], pushes)
    at_noon = np.interp(np.arange(day.size), 24.0 * np.arange(daily.size) + 12.0, daily)
    yearly = -YEARLY_SWING * np.cos(2.0 * np.pi * (day - 20.0) / 365.25)
    swing = np.where(raining, 0.3, 1.0) * DAILY_SWING
    temperature = np.asarray(
        MEAN_TEMPERATURE + yearly + at_noon - swing * np.cos(2.0 * np.pi * (hour - 3.0) / 24.0)
    )
    windy = _spells(hours, (48.0, 0.7), WIND_SPELL, generator)
    season = np.maximum(0.0, 1.0 - np.abs((day - LEAF_FALL) / LEAF_SEASON) ** 1.5)
    falling = season * np.where(windy, 4.0, 0.6)
    return _weather_of(starts, rain, since <= drying, humidity, temperature, falling)


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
    return _weather_of(table.starts, rain, lately, humidity, temperature, falling)


def _weather_of(
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


# ------------------------------------------------------------------------------------------- rails

CORRELATION_LENGTH = 120.0
"""Distance over which adhesion varies [m] (Ornstein-Uhlenbeck)."""

BASE = {"dry": (0.325, 0.04), "wet": (0.175, 0.08)}
"""Median of the base map, standard deviation of its logarithm, by weather; a new one goes last."""

SPOTS = {"dry": (0.1, 0.16), "wet": (0.06, 0.12)}
"""Range of the maximum adhesion in slippery spots, by weather."""


def bin_centres(count: int) -> FloatArray:
    """Centres [m] of the first `count` bins of a line."""
    return np.asarray((np.arange(count) + 0.5) * BIN_LENGTH, dtype=np.float64)


def smooth_variation(count: int, generator: np.random.Generator) -> FloatArray:
    """Ornstein-Uhlenbeck process of unit variance over `count` bins."""
    return correlated(count, BIN_LENGTH, CORRELATION_LENGTH, generator)


def spot(centres: FloatArray, start: float, length: float, depth: float) -> FloatArray:
    """Upper bound of the logarithm of adhesion that a spot imposes; its ends fade over 50 m."""
    outside = np.maximum(np.maximum(start - centres, centres - (start + length)), 0.0)
    return np.asarray(np.where(outside < 75.0, np.log(depth) + outside / 50.0, np.inf))


def likely_places(line: Line, generator: np.random.Generator) -> FloatArray:
    """Where persistent spots begin [m]: around the stations and on the climbs.

    Each station has one or more on either side, where trains brake and leave; some climbs have one.
    """
    around = [
        station.position + side * generator.uniform(100.0, 550.0)
        for station in line.stations
        for side in (-1.0, -1.0, 1.0, 1.0)
        if generator.uniform() < 0.4
    ]
    edges, slopes = line.gradients.positions, line.gradients.values
    climbs = edges[(np.abs(slopes) > 0.008) & (generator.uniform(size=edges.size) < 0.08)]
    places = np.concatenate((np.array(around), climbs + generator.uniform(0.0, 200.0, climbs.size)))
    return places[(places > 50.0) & (places < line.length - 350.0)]


def base_map(line: Line, weather: str, seed: int) -> FloatArray:
    """Maximum adhesion a bin of the line that every trip in that weather meets.

    Parameters
    ----------
    line : Line
        In its own direction.
    weather : {"dry", "wet"}
    seed : int

    Returns
    -------
    (bins,) array
    """
    # The same places are slippery in the dry and in the wet, more so in the wet.
    where = np.random.default_rng([seed, 1])
    generator = np.random.default_rng([seed, 2, list(BASE).index(weather)])
    centres = bin_centres(int(np.ceil(line.length / BIN_LENGTH)))
    median, spread = BASE[weather]
    logarithm = np.log(median) + spread * smooth_variation(centres.size, generator)
    for start in likely_places(line, where):
        length = where.uniform(100.0, 300.0)
        depth = generator.uniform(*SPOTS[weather])
        logarithm = np.minimum(logarithm, spot(centres, start, length, depth))
    return np.asarray(np.exp(logarithm))


def trip_profile(
    line: Line, base: FloatArray, weather: str, generator: np.random.Generator
) -> StepProfile:
    """The base map as one trip meets it: 4 % of variation and now and then a new spot.

    Returns
    -------
    StepProfile
        In the line's own direction.
    """
    centres = bin_centres(base.size)
    logarithm = np.log(base) + 0.04 * smooth_variation(base.size, generator)
    for _ in range(int(generator.poisson(2.0 if weather == "wet" else 0.5))):
        start = generator.uniform(0.0, line.length)
        length = generator.uniform(50.0, 150.0)
        depth = generator.uniform(*SPOTS[weather])
        logarithm = np.minimum(logarithm, spot(centres, start, length, depth))
    edges = centres - 0.5 * BIN_LENGTH
    return StepProfile(edges, np.asarray(np.minimum(np.exp(logarithm), 0.5)))


STEP = 10.0
"""Length of the pieces in which the adhesion of a `Rail` is constant [m]."""

LASTING = {"dry": (0.325, 0.04), "wet": (0.175, 0.08), "leaves": (0.16, 0.1), "frost": (0.2, 0.07)}
"""Median of what lasts and standard deviation of its logarithm, by rail condition."""

TREES = {"dry": 1.0, "wet": 0.97, "leaves": 0.8, "frost": 0.95}
"""What lasts under trees, relative to the open line."""

DEEPEST = {"dry": SPOTS["dry"], "wet": SPOTS["wet"], "leaves": (0.06, 0.11), "frost": (0.08, 0.13)}
"""Range of the maximum adhesion in lasting spots, by rail condition."""

WARM_UP = 21
"""Days before the first in which spots are born that it may still meet."""

FADED = 0.02
"""A spot of which less is left is counted as gone."""

DAY_SPREAD, TRIP_SPREAD = 0.025, 0.03
"""Standard deviations of the logarithm of adhesion: between days, and between a day's trips."""


class Kind(NamedTuple):
    """A kind of passing spot.

    Attributes
    ----------
    rate : float [1/km/d]
        Births where and when they are neither many nor few.
    life : (median [h], std of the logarithm, shortest [h], longest [h])
        Time after which half of the depth is left.
    length : (shortest, likeliest, longest) [m]
    dry, wet : (lowest, highest)
        Maximum adhesion in a fresh spot on dry and on any other rail.
    wash : (least, most) [h/mm]
        By how much a millimetre of rain ages it.
    """

    rate: float
    life: tuple[float, float, float, float]
    length: tuple[float, float, float]
    dry: tuple[float, float]
    wet: tuple[float, float]
    wash: tuple[float, float]


KINDS = {
    "leaves": Kind(
        0.09, (34.0, 0.9, 4.0, 336.0), (60.0, 130.0, 300.0), (0.1, 0.18), (0.05, 0.1), (0.0, 3.0)
    ),
    "contamination": Kind(
        0.03, (20.0, 1.1, 3.0, 336.0), (30.0, 60.0, 150.0), (0.12, 0.2), (0.07, 0.12), (1.0, 8.0)
    ),
    "frost": Kind(
        0.5, (3.5, 0.4, 1.5, 8.0), (50.0, 100.0, 200.0), (0.1, 0.15), (0.08, 0.13), (0.0, 0.0)
    ),
}
"""Passing spots by kind."""


@dataclass(frozen=True, slots=True)
class Change:
    """A lasting change of the rail over a section.

    Rail that is ground holds more (`factor` above 1), where trees have grown it holds less and more
    leaves fall (`factor` below 1, `births` above 1), where they are cut the other way round. A
    place at which trains brake that moves is two changes.

    Attributes
    ----------
    start, end : float [m]
        Of the section, along the line in its own direction.
    time : int [ns since 1970 UTC]
        From which it holds.
    factor : float
        Of the lasting maximum adhesion, in every rail condition.
    births : float
        Of how often passing spots come.

    Examples
    --------
    >>> import trainlog
    >>> import pandas as pd
    >>> start = pd.Timestamp("2026-10-15T02:00Z").value
    >>> ground = trainlog.RailChange(10e3, 14e3, start, factor=1.3)
    >>> ground.births
    1.0
    """

    start: float
    end: float
    time: int
    factor: float = 1.0
    births: float = 1.0

    def __post_init__(self) -> None:
        place = f"change at km {self.start / 1e3:g} to {self.end / 1e3:g}"
        if not 0.0 <= self.start < self.end < np.inf:
            raise InputError(
                f"{place}: a section ends after it starts, from km 0 on", remedy="write km=10:14"
            )
        if not 0.1 <= self.factor <= 10.0:
            raise InputError(
                f"{place}: factor {self.factor:g} is not between 0.1 and 10",
                remedy="write factor=0.7 for 30 % less adhesion",
            )
        if not 0.0 <= self.births <= 100.0:
            raise InputError(
                f"{place}: births {self.births:g} is not between 0 and 100",
                remedy="write spots=0.2 for a fifth of the usual ones",
            )


@dataclass(frozen=True, eq=False)
class RailState:
    """What a rail was on one trip, beside the adhesion that results.

    Attributes
    ----------
    lasting : StepProfile
        Maximum adhesion that lasts in the rail condition of the trip, along the line in its own
        direction.
    weather : Conditions
    spots : DataFrame
        Passing spots that were there: as in `Rail.spots`, and ``left``, the share of its depth.
    """

    lasting: StepProfile
    weather: Conditions
    spots: pd.DataFrame


@dataclass(frozen=True, eq=False, repr=False)
class Rail:
    """The rail of a line over the days of a calendar.

    Attributes
    ----------
    line : Line
    start : int [ns since 1970 UTC]
        Midnight of the first day.
    days : int
    seed : int
    drawn : DrawnWeather
        From `WARM_UP` days before the first to a day after the last.
    trees : (n,) bool array
        Whether the line runs under trees, in pieces of `STEP`.
    base : dict of str to (n,) array
        Maximum adhesion that lasts before any change, by rail condition.
    spots : DataFrame
        One row a passing spot, in order of birth: ``kind``, ``start`` and ``length`` [m], ``birth``
        [ns since 1970 UTC], ``life`` [s], ``sharpness`` of its decay, ``dry`` and ``wet``: its
        maximum adhesion when fresh on dry and on other rail, ``wash`` [s/m].
    changes : tuple of Change

    Examples
    --------
    >>> import pandas as pd
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> rail = Rail.draw(line, days=30, start="2026-10-01", seed=1)
    >>> morning = pd.Timestamp("2026-10-04T06:00Z").value
    >>> rail.weather(morning).condition
    'wet'
    >>> bool(rail.profile(morning, 1)([5_000.0])[0] > 0.1)
    True
    """

    line: Line
    start: int
    days: int
    seed: int
    drawn: DrawnWeather
    trees: BoolArray
    base: dict[str, FloatArray]
    spots: pd.DataFrame
    changes: tuple[Change, ...] = ()

    @classmethod
    def draw(
        cls,
        line: Line,
        days: int,
        start: int | str | pd.Timestamp,
        seed: int,
        changes: Sequence[Change] = (),
        weather: DrawnWeather | None = None,
    ) -> Rail:
        """Draw a rail; the same seed draws the same one.

        Parameters
        ----------
        line : Line
        days : int
        start : int [ns since 1970 UTC], or a date
        seed : int
        changes : sequence of Change
        weather : DrawnWeather, optional
            From `WARM_UP` days before the first to a day after the last; default: drawn, too.

        Raises
        ------
        InputError
            If `days` is not positive, or a change lies beyond the line or the days.
        """
        if days < 1:
            raise InputError(f"cannot draw {days} days", remedy="give 1 day or more")
        first = midnight(start)
        for each in changes:
            place = f"change at km {each.start / 1e3:g} to {each.end / 1e3:g}"
            if each.end > line.length + 1.0:
                raise InputError(
                    f"{place}: line '{line.name}' ends at km {line.length / 1e3:.3f}",
                    remedy="give a section of the line",
                )
            if not first <= each.time < first + days * DAY:
                when = pd.Timestamp(each.time, tz="UTC")
                raise InputError(
                    f"{place}: {when} is not one of the days simulated",
                    remedy="give a date from the first to the last day",
                )
        if weather is None:
            warm, hours = first - WARM_UP * DAY, 24 * (WARM_UP + days + 1)
            weather = draw_weather(warm, hours, np.random.default_rng([seed, 11]))
        trees = _stretches(_pieces(line), 700.0, np.random.default_rng([seed, 12])) < 0.35
        lasting = _lasting(line, trees, seed)
        spots = _spots(line, weather, trees, changes, np.random.default_rng([seed, 14]))
        return cls(line, first, days, seed, weather, trees, lasting, spots, tuple(changes))

    def __repr__(self) -> str:
        end = pd.Timestamp(self.start + (self.days - 1) * DAY, tz="UTC")
        start = pd.Timestamp(self.start, tz="UTC")
        kinds = self.spots["kind"][self.spots["birth"] >= self.start].value_counts()
        rows = {
            "line": self.line.name,
            "days": f"{self.days}, {start:%Y-%m-%d} to {end:%Y-%m-%d}",
            "spots": ", ".join(f"{number} {kind}" for kind, number in kinds.items()) or "none",
            "changes": counted(len(self.changes), "lasting change"),
        }
        return as_text(f"Rail, seed {self.seed}", rows)

    def weather(self, time: int) -> Conditions:
        """Weather at a time [ns since 1970 UTC].

        Raises
        ------
        InputError
            If it is none of the days drawn.
        """
        found = self.drawn.table.at(int(time))
        if found is None:
            raise InputError(
                f"{pd.Timestamp(time, tz='UTC')} is not one of the days drawn for this rail",
                remedy="draw it over more days",
            )
        return found

    @property
    def table(self) -> Weather:
        """Weather of its days, and of the day after: the last trains arrive then."""
        known = self.drawn.table
        rows = known.starts >= self.start
        first = int(np.argmax(rows))
        columns = (known.temperature, known.humidity, known.precipitation)
        return Weather(
            known.starts[rows],
            known.ends[rows],
            known.conditions[first:],
            *(each[rows] for each in columns),
        )

    def lasting(self, condition: str, time: int) -> StepProfile:
        """Maximum adhesion that lasts in a rail condition, with the changes made until `time`."""
        if condition not in self.base:
            raise InputError(
                f"rail condition '{condition}' is unknown", remedy=f"one of {', '.join(self.base)}"
            )
        centres = _centres(self.trees.size)
        logarithm = np.log(self.base[condition])
        for each in self.changes:
            if each.time <= time:
                within = (centres >= each.start) & (centres < each.end)
                logarithm = logarithm + np.log(each.factor) * within
        return _profile(logarithm)

    def left(self, time: int) -> FloatArray:
        """What is left of each spot's depth: 1 when fresh, 0 before its birth, (spots,)."""
        birth = self.spots["birth"].to_numpy()
        age = (time - birth) / NANOSECONDS
        rain = self.drawn.rain_until(np.array([time]))[0] - self.drawn.rain_until(birth)
        worn = np.maximum(age, 0.0) + self.spots["wash"].to_numpy() * np.maximum(rain, 0.0)
        share = 1.0 / (1.0 + (worn / self.spots["life"].to_numpy()) ** self.spots["sharpness"])
        return np.where((age >= 0.0) & (share >= FADED), share, 0.0)

    def state(self, time: int) -> RailState:
        """What lasts and what passes at a time [ns since 1970 UTC]."""
        weather = self.weather(time)
        left = self.left(time)
        there = self.spots[left > 0.0].assign(left=left[left > 0.0])
        return RailState(self.lasting(weather.condition, time), weather, there)

    def profile(self, time: int, number: int, state: RailState | None = None) -> StepProfile:
        """Maximum adhesion that trip `number` meets at `time`, in the line's own direction.

        Days differ, and trips of a day differ a little: both along the line, too. `state` is that
        of the time, where it is known already.
        """
        state = self.state(time) if state is None else state
        count = self.trees.size
        centres = _centres(count)
        today = np.random.default_rng([self.seed, 15, int(time // DAY)])
        own = np.random.default_rng([self.seed, 16, number])
        logarithm = (
            np.log(state.lasting.values)
            + DAY_SPREAD * (today.uniform(-1.0, 1.0) + _smooth(count, 1500.0, today))
            + TRIP_SPREAD * _smooth(count, 180.0, own)
        )
        fresh = "dry" if state.weather.condition == "dry" else "wet"
        columns = state.spots[["start", "length", fresh, "left"]].to_numpy(np.float64)
        for place, length, lowest, left in columns:
            depth = np.maximum(logarithm - np.log(lowest), 0.0)
            logarithm = logarithm - left * _shape(centres, place, length) * depth
        return _profile(logarithm)


def _pieces(line: Line) -> int:
    """Number of pieces of `STEP` of a line."""
    return int(np.ceil(line.length / STEP))


def _centres(count: int) -> FloatArray:
    """Centres of the first `count` pieces [m]."""
    return np.asarray(STEP * (np.arange(count) + 0.5), dtype=np.float64)


def _profile(logarithm: FloatArray) -> StepProfile:
    """Maximum adhesion of the pieces of a line, from its logarithm; dry rail bears 0.5 at most."""
    values = np.exp(np.minimum(logarithm, np.log(0.5)))
    return StepProfile(
        STEP * np.arange(values.size, dtype=np.float64), np.asarray(values, dtype=np.float64)
    )


def midnight(date: int | str | pd.Timestamp) -> int:
    """The beginning of a day in UTC [ns since 1970 UTC]; a date without a zone is one in UTC."""
    try:
        stamp = utc(date)
    except InputError:
        raise InputError(f"'{date}' is not a date", remedy="give it as 2026-10-01") from None
    return int(stamp.normalize().as_unit("ns").value)


def _shape(centres: FloatArray, start: float, length: float) -> FloatArray:
    """Depth of a spot along the line, 0 to 1: its ends rise over 30 m each, (n,)."""
    inside = np.minimum(centres - start, start + length - centres)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(inside / 30.0 + 0.5, 0.0, 1.0)))


def _smooth(count: int, width: float, generator: np.random.Generator) -> FloatArray:
    """Skewed and heavy-tailed variation of unit variance along the line, (count,).

    Smoothed by a raised cosine: nothing is correlated over more than `width` [m].
    """
    kernel = np.hanning(round(width / STEP) + 2)[1:-1]
    size = count + kernel.size - 1
    skewed = np.sqrt(0.5) * (2.0 - generator.gamma(2.0, 1.0, size))
    heavy = generator.standard_t(5.0, size) * np.sqrt(3.0 / 5.0)
    noise = np.sqrt(0.5) * (skewed + heavy)
    return np.convolve(noise, kernel / np.sqrt(np.sum(kernel**2)), "valid")


def _stretches(count: int, median: float, generator: np.random.Generator) -> FloatArray:
    """Uniform numbers that hold over stretches of lognormal length [m], (count,)."""
    lengths = median * np.exp(0.7 * generator.standard_normal(int(count * STEP / median * 4) + 8))
    index = np.searchsorted(np.cumsum(lengths), _centres(count))
    return generator.uniform(size=lengths.size)[np.minimum(index, lengths.size - 1)]


def _lasting(line: Line, trees: BoolArray, seed: int) -> dict[str, FloatArray]:
    """Maximum adhesion that lasts, by rail condition: sections, variation, slippery places."""
    where = np.random.default_rng([seed, 13])
    count = trees.size
    centres = _centres(count)
    shared = np.sqrt(12.0) * (_stretches(count, 900.0, where) - 0.5)
    starts = likely_places(line, where)
    lengths = where.triangular(60.0, 150.0, 320.0, starts.size)
    quantiles = where.beta(1.5, 1.5, starts.size)
    found = {}
    for number, (condition, (median, spread)) in enumerate(LASTING.items()):
        generator = np.random.default_rng([seed, 13, number])
        logarithm = np.log(median) + spread * (
            0.7 * shared + 0.71 * _smooth(count, 240.0, generator)
        )
        logarithm += np.log(TREES[condition]) * trees
        low, high = DEEPEST[condition]
        for start, length, quantile in zip(starts, lengths, quantiles, strict=True):
            lowest = low + (high - low) * (0.8 * quantile + 0.2 * generator.uniform())
            depth = np.maximum(logarithm - np.log(lowest), 0.0)
            logarithm = logarithm - _shape(centres, start, length) * depth
        found[condition] = np.exp(logarithm)
    return found


def _drawn(weights: FloatArray, count: int, generator: np.random.Generator) -> IntArray:
    """So many places of an array, each as likely as its weight."""
    if not count:
        return np.zeros(0, dtype=np.int64)
    return generator.choice(weights.size, count, p=weights / weights.sum())


def _spots(
    line: Line,
    weather: DrawnWeather,
    trees: BoolArray,
    changes: Sequence[Change],
    generator: np.random.Generator,
) -> pd.DataFrame:
    """Every passing spot from the first hour of the weather to the last."""
    hours = weather.table.starts.size
    centres = _centres(trees.size)
    stations = np.array([station.position for station in line.stations])
    near = np.min(np.abs(centres[:, None] - stations), axis=1, initial=np.inf) < 700.0
    frosty = np.array(weather.table.conditions) == "frost"
    when = {
        "leaves": weather.falling,
        "contamination": np.ones(hours),
        "frost": frosty.astype(float),
    }
    along = {
        "leaves": np.where(trees, 2.5, 0.2),
        "contamination": np.where(near, 2.5, 0.6),
        "frost": np.where(trees, 0.4, 1.3),
    }
    most = max((each.births for each in changes), default=1.0)
    frames = []
    for name, kind in KINDS.items():
        # Some days and some places see many more than their share: births are clustered.
        days = np.repeat(generator.gamma(1.5, 1 / 1.5, hours // 24 + 1), 24)[:hours]
        over_time = when[name] * days
        over_line = (
            along[name]
            * generator.gamma(0.8, 1 / 0.8, 40)[
                np.minimum(40 * np.arange(trees.size) // trees.size, 39)
            ]
        )
        expected = kind.rate / 24.0 * STEP / 1e3 * over_time.sum() * over_line.sum()
        count = int(generator.poisson(expected * max(most, 1.0)))
        hour = _drawn(over_time, count, generator)
        cell = _drawn(over_line, count, generator)
        life = kind.life[0] * np.exp(kind.life[1] * generator.standard_normal(count))
        frames.append(
            pd.DataFrame(
                {
                    "kind": name,
                    "start": STEP * (cell + generator.uniform(size=count)),
                    "length": generator.triangular(*kind.length, count),
                    "birth": weather.table.starts[hour]
                    + (HOUR * generator.uniform(size=count)).astype(np.int64),
                    "life": 3600.0 * np.clip(life, *kind.life[2:]),
                    "sharpness": generator.uniform(1.8, 4.0, count),
                    "dry": generator.uniform(*kind.dry, count),
                    "wet": generator.uniform(*kind.wet, count),
                    "wash": generator.uniform(*kind.wash, count) / MILLIMETRE_PER_HOUR,
                    "chance": generator.uniform(size=count),
                }
            )
        )
    spots = pd.concat(frames).sort_values("birth", ignore_index=True)
    births = np.ones(len(spots))
    for each in changes:
        within = spots["start"].between(each.start, each.end) & (spots["birth"] >= each.time)
        births = np.where(within, births * each.births, births)
    kept = spots["chance"] * max(most, 1.0) < births
    return spots[kept].drop(columns="chance").reset_index(drop=True)

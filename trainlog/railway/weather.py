"""Weather at a line over time: the rail's condition, temperature, humidity, precipitation.

A rail condition is a label (``"dry"``, ``"wet"``, ``"leaves"``, ``"frost"`` ...): the layer of the
track-condition map that trips in it belong to. What is not known is empty or NaN; between rows
nothing is interpolated, and where no row holds nothing is known.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from difflib import get_close_matches

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray, IntArray
from trainlog.declaration import hold_arrays
from trainlog.errors import InputError
from trainlog.units import NANOSECONDS

CONDITIONS = (
    "dry", "wet", "damp", "leaves", "frost", "ice", "snow", "dew", "oil", "rust", "sand",
)  # fmt: skip
"""Rail conditions that are often distinguished; others are given as new, see `given_condition`."""

NEW = "new:"
"""Before a rail condition that is given and not known yet: ``"new:grease"``."""

LONGEST_HOLD = 3 * 3600 * NANOSECONDS
"""A row whose end is not stated holds at most so long [ns]: stations report every three hours."""

MILLIMETRE_PER_HOUR = 1.0 / 3.6e6
"""In m/s."""

WEATHER_BY_EDGE = "weather_by_edge"
"""Metadata of a trip on a route: the rail's condition on each edge, as JSON."""

_LABEL = re.compile(r"[a-z][a-z0-9_-]*")


def stated_condition(metadata: Mapping[str, str], edge: str = "") -> str:
    """The rail's condition that a trip states, on an edge of its route; empty if it states none.

    Parameters
    ----------
    metadata : mapping of str to str
        Of the trip.
    edge : str
        Empty, or one of which nothing else is stated: the trip's one condition.

    Raises
    ------
    InputError
        If the conditions by edge are no JSON object of words.

    Examples
    --------
    >>> stated = {"weather": "dry", "weather_by_edge": '{"A-B": "dry", "B-C": "wet"}'}
    >>> stated_condition(stated), stated_condition(stated, "B-C")
    ('dry', 'wet')
    """
    whole = metadata.get("weather", "")
    if not edge or WEATHER_BY_EDGE not in metadata:
        return whole
    try:
        stated = json.loads(metadata[WEATHER_BY_EDGE])
    except ValueError:
        stated = None
    if not isinstance(stated, dict) or not all(isinstance(each, str) for each in stated.values()):
        raise InputError(
            f"metadata {WEATHER_BY_EDGE} is not a JSON object of rail conditions",
            remedy='write it as {"A-B": "wet", "B-C": "dry"}',
        )
    return str(stated.get(edge, whole))


def check_condition(label: str, known: Iterable[str] = ()) -> str:
    """A rail condition as it was given, if it may be one.

    Parameters
    ----------
    label : str
    known : iterable of str
        Labels in use, such as the layers of a map, beside `CONDITIONS`.

    Raises
    ------
    InputError
        If it is not of small letters, digits, ``_`` and ``-``, or looks like a misspelt one.

    Examples
    --------
    >>> check_condition("leaves"), check_condition("wet-leaves")
    ('leaves', 'wet-leaves')
    >>> check_condition("wett")
    Traceback (most recent call last):
    trainlog.errors.InputError: rail condition 'wett' is not known; did you mean 'wet'?
    """
    if not _LABEL.fullmatch(label):
        raise InputError(
            f"'{label}' cannot name a rail condition",
            remedy="use small letters, digits, '_' and '-', as in 'wet' or 'leaves'",
        )
    every = list(dict.fromkeys((*known, *CONDITIONS)))
    named = set(every) & {label, *re.split("[_-]", label)}
    close = [] if named else get_close_matches(label, every, n=1, cutoff=0.7)
    if close:
        raise InputError(
            f"rail condition '{label}' is not known", remedy=f"did you mean '{close[0]}'?"
        )
    return label


def given_condition(word: str, known: Iterable[str] = ()) -> str:
    """The rail condition that a person gives: one that is known, or a new one after ``new:``.

    Labels made of a known one are known, too: ``"wet-leaves"``.

    Parameters
    ----------
    word : str
    known : iterable of str
        Labels in use, beside `CONDITIONS`.

    Raises
    ------
    InputError
        If it is not known and not given as new, or as `check_condition`.

    Examples
    --------
    >>> given_condition("wet"), given_condition("new:grease"), given_condition("grease", ["grease"])
    ('wet', 'grease', 'grease')
    >>> given_condition("nass")
    Traceback (most recent call last):
    trainlog.errors.InputError: rail condition 'nass' is not known; known: dry, wet, damp, leaves, \
frost, ice, snow, dew, oil, rust, sand; a new one is given as new:nass
    """
    label = word.removeprefix(NEW)
    every = list(dict.fromkeys((*known, *CONDITIONS)))
    check_condition(label, known)
    if label == word and not {label, *re.split("[_-]", label)} & set(every):
        raise InputError(
            f"rail condition '{word}' is not known",
            remedy=f"known: {', '.join(every)}; a new one is given as {NEW}{word}",
        )
    return label


@dataclass(frozen=True, slots=True)
class Conditions:
    """Weather at one time.

    Attributes
    ----------
    condition : str
        Of the rail; empty: not known.
    temperature : float [K]
        Of the air; NaN: not known, as in the others.
    humidity : float
        Relative, 0 to 1.
    precipitation : float [m/s]
    since_rain : float [s]
        Since it last rained; 0 while it does.
    """

    condition: str
    temperature: float = np.nan
    humidity: float = np.nan
    precipitation: float = np.nan
    since_rain: float = np.nan

    def known(self) -> dict[str, str | float]:
        """What is known of it, by name."""
        return {
            name: value
            for name, value in asdict(self).items()
            if (value if isinstance(value, str) else np.isfinite(value))
        }


@dataclass(frozen=True, eq=False)
class Weather:
    """Weather at a line over time, row by row.

    Attributes
    ----------
    starts, ends : (n,) int array [ns since 1970 UTC]
        A row holds from its start until before its end; rows are ordered and do not overlap.
    conditions : tuple of str
        Of the rail; empty: not known.
    temperature : (n,) array [K]
        Of the air.
    humidity : (n,) array
        Relative, 0 to 1.
    precipitation : (n,) array [m/s]
        Depth of water; NaN in these three: not known.

    Examples
    --------
    >>> hour = 3600 * 10**9
    >>> weather = Weather([0, hour], [hour, 2 * hour], ("wet", "dry"), [283.0, 284.0], [0.9, 0.8],
    ...     [2e-7, 0.0])
    >>> weather.at(hour + hour // 2).condition, weather.at(hour + hour // 2).since_rain
    ('dry', 1800.0)
    >>> weather.at(2 * hour) is None
    True
    """

    starts: IntArray
    ends: IntArray
    conditions: tuple[str, ...]
    temperature: FloatArray
    humidity: FloatArray
    precipitation: FloatArray

    def __post_init__(self) -> None:
        hold_arrays(self)
        if len({len(getattr(self, name)) for name in self.__dataclass_fields__}) != 1:
            raise InputError(
                "weather: its columns differ in length", remedy="give one value per row"
            )
        if np.any(self.ends <= self.starts) or np.any(self.starts[1:] < self.ends[:-1]):
            raise InputError(
                "weather: rows must be ordered by time and must not overlap",
                remedy="sort the rows; each ends before the next begins",
            )

    def row_at(self, time: ArrayLike) -> IntArray:
        """Index of the row that holds at each time [ns since 1970 UTC]; -1 where none does."""
        when = np.asarray(time, dtype=np.int64)
        if not len(self.conditions):
            return np.full(when.shape, -1, dtype=np.int64)
        row = np.searchsorted(self.starts, when, side="right") - 1
        holds = (row >= 0) & (when < self.ends[np.maximum(row, 0)])
        return np.asarray(np.where(holds, row, -1), dtype=np.int64)

    def at(self, time: int) -> Conditions | None:
        """Weather at a time [ns since 1970 UTC]; None where no row holds."""
        row = int(self.row_at(time))
        if row < 0:
            return None
        return Conditions(
            self.conditions[row],
            float(self.temperature[row]),
            float(self.humidity[row]),
            float(self.precipitation[row]),
            self._since_rain(row, time),
        )

    def spans(self, start: int, end: int) -> tuple[tuple[int, int, str], ...]:
        """The rail's condition from `start` until before `end` [ns since 1970 UTC].

        Returns
        -------
        tuple of (int, int, str)
            Start, end and condition, without gaps; empty where it is not known. Two that follow
            each other differ.
        """
        edges = np.concatenate((self.starts, self.ends, [start, end]))
        edges = np.unique(edges[(edges >= start) & (edges <= end)])
        row = self.row_at(edges[:-1])
        names = ["" if each < 0 else self.conditions[each] for each in row]
        found: list[tuple[int, int, str]] = []
        for first, last, name in zip(edges[:-1].tolist(), edges[1:].tolist(), names, strict=True):
            if found and found[-1][2] == name:
                found[-1] = (found[-1][0], last, name)
            else:
                found.append((first, last, name))
        return tuple(found)

    def _since_rain(self, row: int, time: int) -> float:
        """Time since it last rained [s]; NaN where a gap or an unknown row lies between."""
        rained = np.flatnonzero(self.precipitation[: row + 1] > 0.0)
        if not rained.size:
            return float(np.nan)
        last = int(rained[-1])
        whole = np.array_equal(self.ends[last:row], self.starts[last + 1 : row + 1])
        if not whole or np.isnan(self.precipitation[last : row + 1]).any():
            return float(np.nan)
        return 0.0 if last == row else (time - int(self.ends[last])) / NANOSECONDS


def sun_elevation(time: int, latitude: float, longitude: float) -> float:
    """Elevation of the sun above the horizon [deg], without refraction.

    The low-precision formulas of the Astronomical Almanac (Michalsky, 1988, Solar Energy 40(3)),
    good to 0.01 degrees from 1950 to 2050.

    Parameters
    ----------
    time : int [ns since 1970 UTC]
    latitude, longitude : float [deg]

    Examples
    --------
    >>> import pandas as pd
    >>> round(sun_elevation(pd.Timestamp("2026-06-21T12:02Z").value, 51.48, 0.0), 1)
    62.0
    """
    days = time / NANOSECONDS / 86_400.0 - 10_957.5  # since noon of 2000-01-01
    mean_anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude_of_sun = np.radians(
        280.460
        + 0.9856474 * days
        + 1.915 * np.sin(mean_anomaly)
        + 0.020 * np.sin(2.0 * mean_anomaly)
    )
    obliquity = np.radians(23.439 - 4e-7 * days)
    ascension = np.arctan2(np.cos(obliquity) * np.sin(longitude_of_sun), np.cos(longitude_of_sun))
    declination = np.arcsin(np.sin(obliquity) * np.sin(longitude_of_sun))
    sidereal = np.radians(15.0 * (18.697374558 + 24.06570982441908 * days) + longitude)
    place = np.radians(latitude)
    sine = np.sin(place) * np.sin(declination) + np.cos(place) * np.cos(declination) * np.cos(
        sidereal - ascension
    )
    return float(np.degrees(np.arcsin(sine)))

"""In what weather a trip ran: what is kept beside its evidence, for models of later days."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray
from trainlog.formats.railway import line_of
from trainlog.railway.weather import Weather, sun_elevation
from trainlog.trip import LINE_ATTACHMENT, Trip
from trainlog.units import NANOSECONDS

TOPICS = ("/environment",)
"""What is read of a log."""

STEP = 60 * NANOSECONDS
"""Weather is averaged over a trip in steps of a minute."""


def covariates(trip: Trip, span: tuple[int, int], weather: Weather | None = None) -> dict[str, Any]:
    """Weather of a trip, as the map keeps it: the entry ``weather``, in SI units.

    The air temperature is what the train measured (topic ``/environment``), else that of the
    weather; humidity, precipitation and time since rain are the weather's. What is not known is
    left out.

    Parameters
    ----------
    trip : Trip
        Of which the topics `TOPICS` are used, if it has them.
    span : (int, int) [ns since 1970 UTC]
        First and last sample of its evidence.
    weather : Weather, optional
        At the line.

    Returns
    -------
    dict
        ``weather``: ``time``, the middle of the trip; means over the trip ``temperature`` [K],
        ``temperature_source`` (``log``, ``weather``), ``head_wind`` [m/s], ``humidity``,
        ``precipitation`` [m/s]; at its middle ``since_rain`` [s], ``condition`` of the rail as the
        weather states it, and ``sun_elevation`` [deg], where the line knows where it lies.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/nonstop.mcap", topics=TOPICS)
    >>> kept = covariates(trip, (trip.start.value, trip.end.value))["weather"]
    >>> kept["temperature"], kept["temperature_source"], kept["time"]
    (283.86, 'log', '2024-10-07T06:09:52Z')
    """
    start, end = span
    middle = (start + end) // 2
    found: dict[str, Any] = {
        "time": f"{pd.Timestamp(middle, tz='UTC').round('s'):%Y-%m-%dT%H:%M:%SZ}"
    }
    for column, name in (("air_temperature", "temperature"), ("head_wind", "head_wind")):
        values = _measured(trip, column)
        if values.size:
            found[name] = round(float(values.mean()), 2)
    if "temperature" in found:
        found["temperature_source"] = "log"
    if weather is not None:
        found = _of_weather(weather, start, end) | found
    position = line_of(trip).geometry if LINE_ATTACHMENT in trip.attachments else None
    if position is not None:
        place = float(np.mean(position.latitudes)), float(np.mean(position.longitudes))
        found["sun_elevation"] = round(sun_elevation(middle, *place), 1)
    return {"weather": dict(sorted(found.items()))}


def _measured(trip: Trip, column: str) -> FloatArray:
    """What the train measured of its surroundings, where it did, (n,)."""
    if "/environment" not in trip:
        return np.empty(0)
    values = trip["/environment"][column].to_numpy(np.float64)
    return np.asarray(values[np.isfinite(values)])


def _of_weather(weather: Weather, start: int, end: int) -> dict[str, Any]:
    """What the weather states of a trip."""
    rows = weather.row_at(np.arange(start, end + 1, STEP, dtype=np.int64))
    rows = rows[rows >= 0]
    found: dict[str, Any] = {}
    for name, digits in (("temperature", 2), ("humidity", 3), ("precipitation", 12)):
        values = getattr(weather, name)[rows]
        if np.isfinite(values).any():
            found[name] = round(float(np.nanmean(values)), digits)
    if "temperature" in found:
        found["temperature_source"] = "weather"
    there = weather.at((start + end) // 2)
    if there is not None:
        known = there.known()
        found |= {name: known[name] for name in ("condition", "since_rain") if name in known}
    return found

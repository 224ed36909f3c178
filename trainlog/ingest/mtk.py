"""Format ``mtk``: the CSV of loggers with an MTK receiver, ten rows a second.

Date and time of day in columns of their own, satellites, longitude and latitude in degrees (or, as
integers, in 1e-7 degrees), altitude [m], speed [m/s], HDOP times 100. Before the first fix the date
is ``2000,0,0``. Loggers differ in the names and the order of the columns: they are found by name.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from trainlog.errors import InputError
from trainlog.ingest.mapping import numbers, recording_of
from trainlog.ingest.profile import PROFILE_FORMAT, Column, Profile, TimeOptions
from trainlog.ingest.recording import HORIZONTAL_PER_HDOP, Recording
from trainlog.ingest.tabular import open_text

NAMES = {
    "year": ("year",),
    "month": ("month",),
    "day": ("day",),
    "hour": ("hour",),
    "minute": ("minute", "min"),
    "second": ("second", "sec"),
    "satellites": ("nsat", "sat", "sats", "satellites", "numsat", "numsv"),
    "longitude": ("lon", "long", "longitude"),
    "latitude": ("lat", "latitude"),
    "altitude": ("alt", "altitude", "height"),
    "speed": ("speed", "v"),
    "hdop": ("hdop",),
}
"""What loggers call the columns, in lower case."""

TIME = ("year", "month", "day", "hour", "minute", "second")

LAYOUT = Profile(
    format=PROFILE_FORMAT,
    version=1,
    name="MTK CSV",
    time=TimeOptions(columns=TIME, format="parts"),
    columns={
        "/gnss/fix.latitude": Column(column="latitude", unit="deg"),
        "/gnss/fix.longitude": Column(column="longitude", unit="deg"),
        "/gnss/fix.altitude": Column(column="altitude", unit="m"),
        "/gnss/fix.horizontal_accuracy": Column(
            column="hdop", unit="m", scale=0.01 * HORIZONTAL_PER_HDOP
        ),
        "/gnss/motion.speed": Column(column="speed", unit="m/s"),
        "/gnss/motion.satellites": Column(column="satellites"),
    },
)
"""What the columns mean, in the words of a profile."""

DEGREES = ("/gnss/fix.latitude", "/gnss/fix.longitude")


def is_mtk(head: bytes) -> bool:
    """Whether a file begins with a header of this layout."""
    first = head.split(b"\n", 1)[0].removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    return set(_columns(first.split(","))) == set(NAMES)


def _columns(names: list[str] | tuple[str, ...]) -> dict[str, str]:
    """What each column that is understood is called in the file."""
    found: dict[str, str] = {}
    for name in names:
        plain = name.strip().strip('"').lower()
        for meaning, spellings in NAMES.items():
            if plain in spellings:
                found.setdefault(meaning, name.strip())
    return found


def read_mtk(path: Path, profile: Profile | None) -> Recording:  # noqa: ARG001
    """Read an MTK CSV; of a profile only what is not about columns is used, and that later.

    Raises
    ------
    InputError
        If the file does not hold the layout's columns.
    """
    text = open_text(path, LAYOUT.file)
    columns = _columns(text.names)
    for meaning, spellings in NAMES.items():
        if meaning not in columns:
            raise InputError(
                f"no column of the {meaning}",
                file=path,
                place=f"row {text.header}, the header",
                remedy=f"expected one called {' or '.join(spellings)}",
            )
    cells = text.cells(columns.values())
    table = cells.table.select(list(columns.values())).rename_columns(list(columns))
    found = recording_of(replace(cells, table=table), _scaled(table), path)
    told = {"clock": "GNSS, UTC", "horizontal_accuracy": f"{HORIZONTAL_PER_HDOP:g} m times HDOP"}
    return replace(found, metadata=told)


def _scaled(table: pa.Table) -> Profile:
    """The layout, with longitude and latitude in 1e-7 degrees where they are integers."""
    latitude = numbers(table["latitude"], ".")[0]
    whole = not pc.any(pc.match_substring(table["latitude"], ".")).as_py()
    if not whole or not np.any(np.abs(latitude) > 90.0):
        return LAYOUT
    scaled = {name: LAYOUT.columns[name].model_copy(update={"scale": 1e-7}) for name in DEGREES}
    return LAYOUT.model_copy(update={"columns": LAYOUT.columns | scaled})

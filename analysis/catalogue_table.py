"""Tables of a catalogue: its trips, its trains and lines, and what does not count."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from trainlog.presentation import MASS, NUMBER, Column, Quantity, Said, WordTable, new_table
from trainlog.units import clock

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue

HOURS = Quantity("s", "h", 1.0 / 3600.0, 1)
DISTANCE = Quantity("m", "km", 1e-3, 1)

_TIME = "%Y-%m-%d %H:%M UTC"


def trips_table(frame: pd.DataFrame, found: int) -> WordTable:
    """Trips, as `trainlog.catalogue.Catalogue.query` gives them; `found`: with those not listed.

    As data the table has all columns, with the units of numbers in their names.
    """
    units = {"s": "_s", "m": "_m", "kg": "_kg"}
    names = {name: f"{name}{units.get(unit, '')}" for name, unit in frame.attrs["units"].items()}
    names |= {"km_from": "from_km", "km_to": "to_km"}
    table = new_table(
        f"{found:,} trips" if found != 1 else "1 trip",
        *map(Column, ("key", "trip", "train", "line", "start", "time", "km", "weather")),
        Column("load", MASS),
        name="trips",
        frame=frame.rename(columns=names).astype(object),
    )
    for row in frame.to_dict("records"):
        km = row["km_from"], row["km_to"]
        table.add_cells(
            str(row["key"])[:8],
            row["name"] if row["path"] is not None else f"{row['name']} (vanished)",
            row["train"],
            row["line"],
            _time(row["start"]),
            clock(float(row["duration"])),
            "-" if pd.isna(km[0]) else f"{km[0]:.1f} to {km[1]:.1f}".replace("-0.0 ", "0.0 "),
            row["weather"],
            row["load"],
        )
    return table


_COLUMNS = (
    *map(Column, ("train", "kind", "line", "edge")),
    Column("day, UTC", key="day"),
    Column("weather"),
    Column("trips", NUMBER),
    Column("trains", NUMBER),
    Column("lines", NUMBER),
    Column("first day", key="first"),
    Column("last day", key="last"),
    Column("forward", NUMBER),
    Column("reverse", NUMBER),
    Column("driven", DISTANCE, key="distance"),
    Column("time", HOURS, key="duration"),
    Column("damaged", NUMBER),
)
_NAMES = {"route": "trains", "weather": "weather"}
"""Keys in JSON that are not plurals of what has a row."""


def overview_table(catalogue: Catalogue, by: str = "route") -> WordTable:
    """How many trips there are by train and line, or by what is given."""
    frame = catalogue.overview(by).map(_cell)
    columns = [each for each in _COLUMNS if each.name in frame]
    table = new_table(f"Catalogue {catalogue.place}", *columns, name=_NAMES.get(by, f"{by}s"))
    return table.add_rows(frame.to_dict("records"))


def _cell(value: Any) -> Any:
    if pd.isna(value):
        return None
    return _time(value, "%Y-%m-%d") if isinstance(value, pd.Timestamp) else value


SHOWN_DIGITS = 6
"""Of a number that a statement finds, in a table."""


def found_table(frame: pd.DataFrame, found: int) -> WordTable:
    """What a statement of SQL finds; `found`: with the rows that are not listed."""
    title = f"{found:,} rows" if found != 1 else "1 row"
    columns = [Column(str(each)) for each in frame.columns]
    table = new_table(title, *columns, name="rows", frame=frame.astype(object))
    for row in frame.itertuples(index=False):
        table.add_cells(*map(_shown, row))
    return table


def _shown(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return str(value.tolist())
    if not isinstance(value, list | dict) and pd.isna(value):
        return "-"
    if isinstance(value, pd.Timestamp):
        return value.isoformat()
    return f"{value:.{SHOWN_DIGITS}g}" if isinstance(value, float | np.floating) else str(value)


def problems_table(catalogue: Catalogue) -> WordTable:
    """Files that do not count, with the reasons, and damaged logs that do."""
    title = "Files that do not count, and damaged logs that do"
    table = new_table(title, "file", "what", "of, or reason", name="files")
    frame = catalogue.uncounted()
    for row in frame.to_dict("records"):
        table.add_row(row["path"], row["what"], row["reason"])
    damaged = catalogue.query("quality = 'damaged'", columns=["path", "name", "damage"])
    for row in damaged.to_dict("records"):
        table.add_row(row["path"] or row["name"], "damaged", row["damage"])
    return table


def _time(time: Any, form: str = _TIME) -> Said:
    known = not pd.isna(time)
    return Said(time.isoformat() if known else None, f"{time:{form}}" if known else "-")

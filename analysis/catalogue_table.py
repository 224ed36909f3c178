"""Tables of a catalogue: its trips, its trains and lines, and what does not count."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pandas as pd

from analysis.tables import MASS, NUMBER, Column, Quantity, Said, WordTable, new_table
from trainlog.units import clock

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue

HOURS = Quantity("s", "h", 1.0 / 3600.0, 1)
DISTANCE = Quantity("m", "km", 1e-3, 1)

_TIME = "%Y-%m-%d %H:%M UTC"


def trips_table(frame: pd.DataFrame, found: int) -> WordTable:
    """Trips, as `trainlog.catalogue.Catalogue.query` gives them; `found`: with those not listed."""
    table = new_table(
        f"{found:,} trips" if found != 1 else "1 trip",
        Column("key"),
        Column("trip"),
        Column("train"),
        Column("line"),
        Column("start"),
        Column("time", Quantity("s", ""), key="duration"),
        Column("km"),
        Column("weather"),
        Column("load", MASS),
        name="trips",
    )
    for row in frame.to_dict("records"):
        km = row["km_from"], row["km_to"]
        table.add_cells(
            str(row["key"])[:8],
            row["name"] if row["path"] is not None else f"{row['name']} (vanished)",
            row["train"],
            row["line"],
            _time(row["start"]),
            Said(row["duration"], clock(float(row["duration"]))),
            "-" if pd.isna(km[0]) else f"{km[0]:.1f} to {km[1]:.1f}".replace("-0.0 ", "0.0 "),
            row["weather"],
            row["load"],
        )
    return table


def trips_as_data(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The same as JSON holds it: numbers with their units, all columns."""
    units = {"s": "_s", "m": "_m", "kg": "_kg"}
    names = {name: f"{name}{units.get(unit, '')}" for name, unit in frame.attrs["units"].items()}
    names |= {"km_from": "from_km", "km_to": "to_km"}
    records = frame.rename(columns=names).to_dict("records")
    return [{str(key): value for key, value in record.items()} for record in records]


def overview_table(catalogue: Catalogue) -> WordTable:
    """How many trips there are by train and line."""
    frame = catalogue.overview()
    table = new_table(
        f"Catalogue {catalogue.place}",
        Column("train"),
        Column("kind"),
        Column("line"),
        Column("trips", NUMBER),
        Column("first"),
        Column("last"),
        Column("driven", DISTANCE, key="distance"),
        Column("time", HOURS, key="duration"),
        name="trains",
    )
    for row in frame.to_dict("records"):
        table.add_cells(
            row["train"],
            row["kind"],
            row["line"],
            row["trips"],
            _time(row["first"]),
            _time(row["last"]),
            float("nan") if row["distance"] is None else float(row["distance"]),
            float(row["duration"]),
        )
    return table


def problems_table(catalogue: Catalogue) -> WordTable:
    """Files that do not count, with the reasons, and damaged logs that do."""
    title = "Files that do not count, and damaged logs that do"
    table = new_table(title, "file", "what", "of, or reason", name="problems")
    frame = catalogue.uncounted()
    for row in frame.to_dict("records"):
        table.add_row(row["path"], row["what"], row["reason"])
    damaged = catalogue.query("quality = 'damaged'", columns=["path", "name", "damage"])
    for row in damaged.to_dict("records"):
        table.add_row(row["path"] or row["name"], "damaged", row["damage"])
    return table


def _time(time: Any) -> Said:
    known = not pd.isna(time)
    return Said(time.isoformat() if known else None, f"{time:{_TIME}}" if known else "-")

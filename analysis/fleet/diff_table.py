"""Tables of what differs between two versions over a fleet."""

from __future__ import annotations

import math
from typing import Any

import pandas as pd

from analysis.fleet.diff import FleetDiff
from analysis.fleet.diff_judgement import CLASSES, RATE, REACH, WITHOUT_BAND
from analysis.fleet.update import EVIDENCE
from trainlog.display import counted
from trainlog.presentation import NUMBER, Column, Quantity, WordTable, new_table, with_band
from trainlog.units import JOULES_PER_KWH

MOST = 20
"""Rows of a table that lists single trips."""

_BANDS = Quantity("", "", 1.0, 2)

_HEADINGS = {
    "same": "same to the bit", "rounding": "within rounding", "within": "within the band",
    "beyond": "beyond the band",
}  # fmt: skip


JUDGED = (
    f"What states no band of its own has one in its place: a count of n that of chance, {REACH}"
    f" times the root of n (at least of 1); another figure {WITHOUT_BAND:.0%} of its value, or of"
    " its root mean square over all trips where that is more."
)
"""What stands in place of a band."""


def counts_table(found: FleetDiff) -> WordTable:
    """Of how many trips the worst difference is which, an analysis a row."""
    table = new_table(
        f"Trips of {found.second} against {found.first}", "analysis", Column("trips", NUMBER),
        *(Column(_HEADINGS[each], NUMBER, each) for each in CLASSES), name="analyses",
        caption="Beyond the band: an estimate at least, or one side alone has a result.",
    )  # fmt: skip
    for row in found.trip_counts.to_dict("records"):
        table.add_cells(row["analysis"], row["trips"], *(row[each] for each in CLASSES))
    return table


def estimates_table(found: FleetDiff, *, changed: bool = True) -> WordTable:
    """How far each estimate of each trip moved; with `changed` those that did beyond rounding."""
    table = new_table(
        "Estimates of single trips", "analysis", "estimate", Column("values", NUMBER),
        *(Column(_HEADINGS[each], NUMBER, each) for each in CLASSES),
        Column("bands, second over first", _BANDS, "band_ratio"), name="estimates",
        caption=JUDGED,
    )  # fmt: skip
    for row in found.estimates.to_dict("records"):
        if changed and not row["within"] + row["beyond"]:
            continue
        ratio = row["band_ratio"]
        table.add_cells(
            row["analysis"], row["estimate"], row["rows"], *(row[each] for each in CLASSES),
            None if math.isnan(ratio) else ratio,
        )  # fmt: skip
    return table


def means_table(found: FleetDiff, most: int = MOST) -> WordTable:
    """Means over all trips, trains and places that moved systematically, the farthest first."""
    rows = found.means[found.means["systematic"]] if len(found.means) else found.means
    table = new_table(
        "Means that moved", "of", "analysis", "estimate", Column("trips", NUMBER), "first side",
        "shift on the same trips", Column("shift over its band", _BANDS, "bands"),
        "beyond the band", name="means",
        caption=f"False discovery rate {RATE:.0%} among {len(found.means):,} means."
        + _more(len(rows), most),
    )  # fmt: skip
    for row in rows.head(most).to_dict("records"):
        name = "all trips" if row["of"] == "all trips" else f"{row['of']} {row['name']}"
        unit = f" {row['unit']}" if row["unit"] else ""
        table.add_cells(
            name, row["analysis"], row["estimate"], row["trips"],
            _number(row["value"], row["value_std"], unit),
            _number(row["shift"], row["shift_std"], unit, sign=True),
            min(row["bands"], 1e6), "yes" if row["beyond"] else "no",
        )  # fmt: skip
    return table


def moved_table(found: FleetDiff, most: int = MOST) -> WordTable:
    """Estimates of single trips that moved beyond their band, the farthest first."""
    table = new_table(
        "Estimates that moved beyond their band", "trip", "train", "place", "analysis", "estimate",
        "first side", "second side", Column("difference over its band", _BANDS, "bands"),
        name="moved", caption=_more(len(found.moved), most).strip() or None,
    )  # fmt: skip
    for row in found.moved.head(most).to_dict("records"):
        unit = f" {row['unit']}" if row["unit"] else ""
        bands = row["bands"]
        table.add_cells(
            row["trip"], row["train"] or "", row["place"] or "", row["analysis"], row["estimate"],
            _number(row["first"], row["std"], unit), _number(row["second"], row["std"], unit),
            bands if math.isfinite(bands) else "one side alone",
        )  # fmt: skip
    return table


def verdicts_table(found: FleetDiff, most: int = MOST) -> WordTable:
    """Trips of which one side alone has a result."""
    table = new_table(
        "Given by one side alone", "trip", "train", "analysis", "first side", "second side",
        name="verdicts", caption=_more(len(found.verdicts), most).strip() or None,
    )  # fmt: skip
    for row in found.verdicts.head(most).to_dict("records"):
        table.add_row(*(str(row[each] or "") for each in VERDICT_COLUMNS))
    return table


VERDICT_COLUMNS = ("trip", "train", "analysis", "first", "second")


def places_table(found: FleetDiff, most: int = MOST) -> WordTable:
    """Stretches of the map of all trips together that moved beyond their band."""
    table = new_table(
        "Places of the track-condition map that moved", "line or edge", "rail", "from, km",
        "to, km", "first side", "second side", Column("difference over its band", _BANDS, "bands"),
        name="places", caption=_more(len(found.places), most).strip() or None,
    )  # fmt: skip
    rows = found.places.sort_values("bands", ascending=False) if len(found.places) else found.places
    for row in rows.head(most).to_dict("records"):
        sides = (_adhesion(row["first"]), _adhesion(row["second"]))
        bands = row["bands"]
        table.add_cells(
            row["place"], row["layer"], f"{row['from_km']:.3f}", f"{row['to_km']:.3f}", *sides,
            bands if math.isfinite(bands) else "one side alone",
        )  # fmt: skip
    return table


def words_table(found: FleetDiff, most: int = MOST) -> WordTable:
    """Texts of trips that differ."""
    table = new_table(
        "Texts that differ", "trip", "analysis", "text", "first side", "second side", name="words",
        caption=_more(len(found.words), most).strip() or None,
    )  # fmt: skip
    for row in found.words.head(most).to_dict("records"):
        names = ("trip", "analysis", "estimate", "first", "second")
        table.add_row(*(str(row[each]) for each in names))
    return table


def tables(found: FleetDiff) -> list[WordTable]:
    """All tables, in the order in which they are read."""
    return [
        counts_table(found), means_table(found), verdicts_table(found), places_table(found),
        moved_table(found), estimates_table(found), words_table(found),
    ]  # fmt: skip


def sentence(found: FleetDiff) -> str:
    """The difference in one sentence."""
    trips = counted(found.trips, "trip")
    if found.same:
        return f"every result of {trips} is the same to the byte"
    left_out = (
        f"; not compared, as the parameters change it: {', '.join(found.by_definition)}"
        if found.by_definition else ""
    )  # fmt: skip
    if not found.beyond:
        return f"nothing moved beyond its band on {trips}{left_out}"
    means = int(found.means["beyond"].sum()) if len(found.means) else 0
    banded = int(found.moved["banded"].sum()) if len(found.moved) else 0
    others = len(found.moved) - banded
    parts = [
        f"{counted(banded, 'estimate')} of single trips" if banded else "",
        f"{counted(others, 'figure')} without a band of single trips" if others else "",
        counted(means, "mean") if means else "",
        f"{counted(len(found.places), 'place')} of the map" if len(found.places) else "",
    ]  # fmt: skip
    words = ", ".join(filter(None, parts))
    said = [f"{words} moved beyond their band" if words else ""]
    said += [
        f"{counted(len(found.verdicts), 'result')} given by one side alone"
        if len(found.verdicts) else "",
        "no place of the map of all trips moved beyond its band"
        if EVIDENCE in found.trip_counts["analysis"].tolist() and not len(found.places) else "",
    ]  # fmt: skip
    return f"{'; '.join(filter(None, said))}, on {trips}{left_out}"


def details(found: FleetDiff) -> dict[str, Any]:
    """The difference as JSON; of single trips as many as the tables list."""
    return {
        "first": str(found.first),
        "second": str(found.second),
        "trips": found.trips,
        "same": found.same,
        "beyond": found.beyond,
        "analyses": _records(found.trip_counts),
        "estimates": _records(found.estimates),
        "means": _records(
            found.means[found.means["systematic"]] if len(found.means) else found.means
        ),
        "moved": _records(found.moved.head(MOST)),
        "moved_in_all": len(found.moved),
        "verdicts": _records(found.verdicts.head(MOST)),
        "verdicts_in_all": len(found.verdicts),
        "places": _records(found.places),
        "words": len(found.words),
        "by_definition": list(found.by_definition),
    }


def _records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows as JSON; what is not finite or known is null."""
    rows = []
    for row in frame.to_dict("records"):
        kept: dict[str, Any] = {}
        for name, value in row.items():
            if isinstance(value, pd.Timestamp):
                value = None if pd.isna(value) else value.isoformat()
            if isinstance(value, float) and not math.isfinite(value):
                value = None
            kept[str(name)] = value
        rows.append(kept)
    return rows


def _more(count: int, most: int) -> str:
    return f" {count - most:,} more are in the folder given by -o." if count > most else ""


def _adhesion(value: float) -> str:
    return "not observed" if math.isnan(value) else f"{value:.3f}"


def _number(value: float, std: float, unit: str, *, sign: bool = False) -> str:
    """A number with its band where it has one; large and small ones in six digits."""
    if math.isnan(value):
        return "-"
    if unit == " J":
        value, std, unit = value / JOULES_PER_KWH, std / JOULES_PER_KWH, " kWh"
    plus = "+" if sign and value > 0.0 else ""
    if not math.isfinite(std) or std <= 0.0 or abs(value) > 1e9:
        return f"{plus}{value:.6g}{unit}"
    return plus + with_band(value, std, unit)

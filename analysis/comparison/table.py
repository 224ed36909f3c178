"""Tables of a comparison."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd

from analysis.comparison.compare import ComparedDirection, ComparedTrip
from analysis.comparison.sections import with_units
from trainlog.presentation import WordTable, new_table
from trainlog.railway.kilometres import in_km
from trainlog.units import JOULES_PER_KWH, KMH

LISTED = 12
"""Losses that are listed of a direction."""

SMALL = 0.5
"""Time lost [s] below which a loss is not listed."""


def direction_tables(found: ComparedDirection) -> list[WordTable]:
    """Tables of a direction: trips, sections, losses, how it was driven."""
    tables = [trips_table(found), sections_table(found)]
    if any(trip.lost is not None and trip.lost.losses for trip in found.trips):
        tables.append(losses_table(found))
    if any(_driving_known(trip) for trip in found.trips):
        tables.append(driving_table(found))
    return tables


def trips_table(found: ComparedDirection) -> WordTable:
    """Each trip as a whole: part of the line, times, energy, time lost by cause."""
    planned = "the trajectory" if found.reference.planned else f"'{found.reference.name}'"
    table = new_table(
        f"{found.line.name}, {found.direction}: trips; time lost against {planned}",
        "trip",
        "km",
        "running\n[min:s]",
        "dwell\n[s]",
        "lost\n[s]",
        "most of it",
        "wheels\n[kWh]",
        "line\n[kWh]",
        "at reference's\nload and time",
    )
    for each in found.trips:
        trip, rows = each.trip, each.table
        dwell = float(rows["dwell"].sum() + rows["stood"].sum())
        table.add_row(
            trip.name,
            _km_span(found, *trip.covered),
            _minutes(float(rows["running_time"].sum())),
            f"{dwell:.0f}",
            *_lost(each, found),
            _energy(float(rows["traction"].sum(min_count=len(rows)))),
            _energy(float(rows["line"].sum(min_count=len(rows)))),
            "" if each.energy is None else _normalised(each),
        )
    return table


def _lost(each: ComparedTrip, found: ComparedDirection) -> tuple[str, str]:
    if each.trip is found.reference:
        return "", "reference"
    if each.lost is None:
        return "", "nothing in common with the reference"
    causes = [f"{cause} {s:+.0f}" for cause, s in each.lost.by_cause().items() if abs(s) >= SMALL]
    biggest = sorted(causes, key=lambda words: -abs(float(words.rpartition(" ")[2])))[:3]
    assert each.common is not None
    low, high = each.trip.covered
    parted = each.common[0] > low + 200.0 or each.common[1] < high - 200.0
    part = f" (km {_km_span(found, *each.common)})" if parted else ""
    return f"{each.lost.total:+.1f}", ", ".join(biggest) + part


def _km_span(found: ComparedDirection, first: float, last: float) -> str:
    start, end = in_km(found.line, [first, last]).tolist()
    return f"{start:.1f} to {end:.1f}"


def _normalised(each: ComparedTrip) -> str:
    assert each.energy is not None
    reach = 1.96 * each.energy.std
    return f"{each.energy.value / JOULES_PER_KWH:.1f} ± {reach / JOULES_PER_KWH:.1f} kWh"


def _minutes(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 60}:{whole % 60:02d}"


def _energy(joules: float) -> str:
    return f"{joules / JOULES_PER_KWH:.1f}" if math.isfinite(joules) else "-"


def sections_table(found: ComparedDirection) -> WordTable:
    """Running time by section, and dwell at the station behind it, side by side."""
    table = new_table(
        f"{found.line.name}, {found.direction}: running time by section + dwell at its end"
        " (+ stood on the way) [s]; in brackets lost",
        "section",
        "km",
        *(each.name for each in found.trips),
    )
    for name, low in zip(found.sections.names, found.sections.edges[:-1], strict=True):
        cells = [_section_cell(each, name) for each in found.trips]
        table.add_row(name, f"{float(in_km(found.line, low)):.1f}", *cells)
    return table


def _section_cell(each: ComparedTrip, name: str) -> str:
    if name not in each.table.index:
        return "-"
    row = each.table.loc[name]
    words = f"{row['running_time']:.0f}"
    words += f" + {row['dwell']:.0f}" * bool(row["dwell"] >= SMALL)
    words += f" + stood {row['stood']:.0f}" * bool(row["stood"] >= SMALL)
    words += f", {row['covered']:.0%} of it" * bool(row["covered"] < 0.98)
    lost = float(each.table["lost"][name]) if "lost" in each.table else float("nan")
    return words + (f" ({lost:+.0f})" if math.isfinite(lost) else "")


def losses_table(found: ComparedDirection) -> WordTable:
    """Where most time was lost, and why; then where most was gained."""
    every = found.losses()
    large = every[every["lost"].abs() >= SMALL]
    lost, gained = large[large["lost"] > 0.0], large[large["lost"] < 0.0]
    table = new_table(
        f"{found.line.name}, {found.direction}: where time was lost,"
        f" {min(LISTED, len(lost))} of {len(lost)} places; gained in {len(gained)}",
        "lost [s]",
        "trip",
        "place",
        "km",
        "cause",
    )
    words = {
        (each.name, loss.place, loss.cause): loss.words
        for each in found.trips
        if each.lost is not None
        for loss in each.lost.losses
    }
    shown = pd.concat([lost.head(LISTED), gained.tail(max(1, LISTED // 4)).iloc[::-1]])
    for row in shown.to_dict("records"):
        first, last = row["first"], row["last"]
        short = last - first < 100.0
        where = f"{float(in_km(found.line, first)):.1f}" if short else _km_span(found, first, last)
        cause = words[row["trip"], row["place"], row["cause"]]
        table.add_row(f"{row['lost']:+.1f}", row["trip"], row["place"], where, cause)
    return table


def _driving_known(each: ComparedTrip) -> bool:
    return bool(each.table[["coasting", "slips", "off_advised_speed"]].notna().any(axis=None))


def driving_table(found: ComparedDirection) -> WordTable:
    """How each trip was driven: coasting, excess speed, slip, how well advice was kept."""
    table = new_table(
        f"{found.line.name}, {found.direction}: how it was driven",
        "trip",
        "mass",
        "coasting",
        "excess speed",
        "slips",
        "off advised speed\n(RMS)",
        "late at the end",
        "braked\n[kWh]",
    )
    for each in found.trips:
        rows = each.table
        distance = rows["last"] - rows["first"]
        coasting = float((rows["coasting"] * distance).sum(min_count=1) / distance.sum())
        excess = float(rows["excess"].max())
        slips, late = float(rows["slips"].sum(min_count=1)), float(rows["lateness"].iloc[-1])
        rms = float(np.sqrt((rows["off_advised_speed"] ** 2 * distance).sum() / distance.sum()))
        advised = bool(rows["off_advised_speed"].notna().any())
        mass = each.trip.mass
        table.add_row(
            each.name,
            f"{mass.value / 1e3:.1f} ± {1.96 * mass.std / 1e3:.1f} t" if mass.known else "-",
            f"{coasting:.0%}" if math.isfinite(coasting) else "-",
            f"{KMH * excess:.1f} km/h, {rows['excess_distance'].sum():.0f} m" if excess else "none",
            f"{slips:.0f}" if math.isfinite(slips) else "-",
            f"{KMH * rms:.1f} km/h" if advised else "-",
            f"{late:+.1f} s" if math.isfinite(late) else "-",
            _energy(float(rows["braking"].sum(min_count=len(rows)))),
        )
    return table


def notes(found: ComparedDirection) -> list[str]:
    """What a reader of the tables must know, in sentences."""
    every = [f"{each.name}: {note}" for each in found.trips for note in each.trip.notes]
    if found.model:
        every.append(
            f"Tractive energy at the load and running time of '{found.reference.name}', by the"
            f" running resistance of the {found.model}; ± is half the 95 % band."
        )
    if any((each.table["excess"] > 0.0).any() for each in found.trips):
        every.append(
            "Excess speed is over the limit under the whole train; plans keep the limit at the"
            " train's front unless made with --set protect=train."
        )
    unknown = [each.name for each in found.trips if "traction" not in each.trip.sums]
    if unknown:
        every.append(f"no efforts are recorded: the energy of {', '.join(unknown)} is not known")
    elif not all("supply" in each.trip.sums for each in found.trips):
        every.append(
            "Energy from the line follows from the train's efficiencies where no current"
            " is recorded."
        )
    return every


def direction_facts(found: ComparedDirection) -> dict[str, Any]:
    """A direction as JSON has it, in SI units."""
    return {
        "direction": found.direction,
        "reference": found.reference.name,
        "trips": [_trip_data(each) for each in found.trips],
    }


def _trip_data(each: ComparedTrip) -> dict[str, Any]:
    trip, energy = each.trip, each.energy
    return {
        "trip": trip.name,
        "first_m": trip.covered[0],
        "last_m": trip.covered[1],
        "duration_s": trip.duration,
        "mass_kg": trip.mass.value,
        "mass_std_kg": trip.mass.std,
        "common_m": each.common,
        "lost_s": None if each.lost is None else each.lost.total,
        "losses": [
            {
                "lost_s": loss.seconds,
                "cause": loss.cause,
                "place": loss.place,
                "first_m": loss.first,
                "last_m": loss.last,
            }
            for loss in (each.lost.losses if each.lost is not None else ())
        ],
        "normalised_traction_J": None if energy is None else energy.value,
        "normalised_traction_std_J": None if energy is None else energy.std,
        "sections": with_units(each.table).to_dict("records"),
        "notes": list(trip.notes),
    }

"""Columns of the tables of results; docs/fleet.md lists them."""

from __future__ import annotations

from analysis.comparison.causes import CAUSES
from trainlog.formats.summaries import Column

KEY = Column("key", "", "of the trip in the catalogue", "text")
"""First column of each table of results."""

QUANTITIES = {
    "effort_delay": ("s", "by which recorded efforts are late"),
    "effort_gain": ("1", "recorded over true effort"),
    "mass": ("kg", "of the loaded train, without the rotating part"),
    "load": ("kg", "above the empty train"),
    "effort_over_mass": ("1", "effort gain times true mass over empty mass"),
    "axle_effort_ratio": ("1", "sum of the axles' efforts over that of the train"),
}

PASSPORT: tuple[Column, ...] = (
    Column("trip", "", "name of the trip", "text"),
    *(
        column
        for name, (unit, meaning) in QUANTITIES.items()
        for column in (
            Column(name, unit, meaning),
            Column(f"{name}_std", unit, "its standard deviation"),
            Column(f"{name}_source", "", "recorded, estimated or assumed", "text"),
        )
    ),
    Column("effort_delay_shared_std", "s", "of its standard deviation, what trips share"),
    Column("speed_noise", "m/s", "of the recorded speed of the train"),
    Column("wheel_factors", "1", "recorded over true speed of each axle", "numbers"),
    Column("wheel_factor_stds", "1", "their standard deviations", "numbers"),
    Column(
        "wheel_factor_source", "", "estimated where satellites or recorded distance show it", "text"
    ),
    Column("sample_time", "s", "between samples of the train's state"),
    Column("findings", "", "what a reader should know, in sentences", "text"),
)

ADHESION: tuple[Column, ...] = (
    Column("trip", "", "name of the trip; on an edge of a network TRIP@EDGE", "text"),
    Column("edge", "", "edge of the network, or line", "text"),
    Column("edge_length", "m", "of the whole edge"),
    Column("bin_length", "m", "of the bins"),
    Column("layer", "", "rail condition", "text"),
    Column("main_layer", "", "rail condition that held longest on this edge", "text"),
    Column("first_day", "d", "first day with evidence, counted from 1970-01-01 UTC", "count"),
    Column("last_day", "d", "last day with evidence", "count"),
    Column("onsets", "1", "onsets of slip that measured the maximum adhesion", "count"),
    Column("bins", "1", "bins with any evidence", "count"),
    Column("weight", "1", "sum of the weights of the onsets"),
    Column("weighted_log", "1", "sum of the weighted logarithms of the maximum adhesion"),
    Column("sha256", "", "of the log; empty of a part of a long one", "text"),
    Column("identity", "", "of the drive, by its recorded samples", "text"),
    Column("steps", "1", "of processing since it was recorded", "count"),
    Column("entry", "", "what a map keeps of the trip, as JSON", "text"),
    Column("evidence", "", "sums by day and bin, packed and compressed", "data"),
)

LOST = tuple(cause for cause in CAUSES if cause not in ("start", "dwell", "stop"))
"""Causes of lost time against the shortest run that makes the same stops."""

DRIVING: tuple[Column, ...] = (
    Column("trip", "", "name of the trip", "text"),
    Column("edge", "", "edge of the network, or line", "text"),
    Column("direction", "", "forward or reverse on the edge's chainage", "text"),
    Column("first", "m", "chainage on the edge where the trip came upon it"),
    Column("last", "m", "chainage on the edge where it left it"),
    Column("entered", "ns", "when it came upon it, since 1970 UTC", "count"),
    Column("distance", "m", "run on the edge"),
    Column("running_time", "s", "without stands"),
    Column("dwell", "s", "at stations"),
    Column("held", "s", "stands off stations"),
    Column("stops", "1", "at stations, those where the trip ends not counted", "count"),
    Column("traction", "J", "work of the tractive effort at the wheel rims"),
    Column("dynamic_braking", "J", "work of the dynamic brake at the wheel rims"),
    Column("braking", "J", "work of all brakes at the wheel rims"),
    Column("line_energy", "J", "drawn from the line less fed back"),
    Column("line_energy_source", "", "recorded, or efficiencies of the train's file", "text"),
    Column("coasting", "1", "share of the distance"),
    Column("excess", "m/s", "largest speed above the permitted one; 0 within 1 km/h"),
    Column("excess_distance", "m", "run above it"),
    Column("slips", "1", "actions of the slip protection"),
    Column("mass", "kg", "of the loaded train, as the log or its passport states it"),
    Column("mass_std", "kg", "its standard deviation"),
    Column("shortest_time", "s", "running time of the shortest run with the same stops"),
    *(Column(f"lost_{cause.replace(' ', '_')}", "s", CAUSES[cause]) for cause in LOST),
)

CHECKS: tuple[Column, ...] = (
    Column("trip", "", "name of the trip", "text"),
    Column("duration", "s", "from the first sample to the last"),
    Column("distance", "m", "between the lowest and the highest position"),
    Column("damage", "", "what of the log is lost; empty if it is whole", "text"),
    Column("gaps", "1", "pauses of the train's state", "count"),
    Column("gap_time", "s", "in all of them"),
    Column("longest_gap", "s", "of them"),
    Column("repairs", "1", "cells and rows that ingest repaired or dropped", "count"),
    Column("repaired", "", "how often each rule was applied: rule=count, ...", "text"),
    Column("missing", "", "channels that are not recorded, separated by commas", "text"),
    Column("frozen", "", "columns that repeat a value while the train moves", "text"),
    Column("frozen_samples", "1", "of them", "count"),
    Column("speed_scale", "1", "measured over true speed, by satellites or recorded distance"),
    Column("speed_scale_std", "1", "its standard deviation"),
    Column("speed_scale_source", "", "by what", "text"),
    Column("fix_beside", "m", "median distance of fixes beside the line's geometry"),
    Column("fix_along", "m", "median difference of the fixes' chainage to the recorded one"),
    Column("fix_spread", "m", "half of the fixes' chainages are within this of that median"),
    Column("doubts", "", "what could not be checked, and why", "text"),
)

"""What is computed of each trip of a fleet: pure functions from a trip to a small table.

Each table has the columns that its analysis declares, the same for whichever trip, in whichever
process: a result depends on the recorded samples, the code and the parameters and on nothing else.
docs/fleet.md lists the columns.
"""

from __future__ import annotations

import json
import sys
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa

from analysis.comparison import CAUSES, LOST
from trainlog.errors import InputError
from trainlog.formats.files import sha256
from trainlog.formats.summaries import COLUMNS as SUMMARY, Column, arrow_of, frame_of
from trainlog.railway.condition import BIN_LENGTH
from trainlog.railway.resistance import LARGEST_STD
from trainlog.version import code_version, code_version_of

if TYPE_CHECKING:
    from analysis.view import TripView
    from trainlog.catalogue import Catalogue, Computation
    from trainlog.railway.passport import Quantity

# What computes is imported where it is called: a process that only names analyses, and asks for
# their parameters and columns, loads none of it. Workers load all of it once (`load_analyses`).

Run = Callable[..., pd.DataFrame]


# docs/fleet.md lists the columns of the tables.

KEY = Column("key", "", "of the trip in the catalogue", "text")
"""First column of each table of results."""

QUANTITIES = {
    "effort_delay": ("s", "delay of recorded efforts"),
    "effort_gain": ("1", "ratio of recorded to true effort"),
    "mass": ("kg", "mass of the loaded train, without the rotating part"),
    "load": ("kg", "mass above that of the empty train"),
    "effort_over_mass": ("1", "effort gain times the ratio of true to empty mass"),
    "axle_effort_ratio": ("1", "ratio of the sum of the axles' efforts to the train's"),
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
    Column(
        "effort_delay_shared_std", "s", "part of the delay's standard deviation that trips share"
    ),
    Column("speed_noise", "m/s", "noise of the recorded speed of the train"),
    Column("wheel_factors", "1", "ratio of recorded to true speed of each axle", "numbers"),
    Column("wheel_factor_stds", "1", "their standard deviations", "numbers"),
    Column(
        "wheel_factor_source", "", "estimated where satellites or recorded distance show it", "text"
    ),
    Column("sample_time", "s", "time between samples of the train's state"),
    Column("findings", "", "findings, in sentences", "text"),
)

ADHESION: tuple[Column, ...] = (
    Column("trip", "", "name of the trip; on an edge of a network TRIP@EDGE", "text"),
    Column("edge", "", "edge of the network, or line", "text"),
    Column("edge_length", "m", "length of the whole edge"),
    Column("bin_length", "m", "length of the bins"),
    Column("layer", "", "rail condition", "text"),
    Column("main_layer", "", "rail condition that held longest on this edge", "text"),
    Column("first_day", "d", "first day with evidence, counted from 1970-01-01 UTC", "count"),
    Column("last_day", "d", "last day with evidence", "count"),
    Column("onsets", "1", "onsets of slip that measured the maximum adhesion", "count"),
    Column("bins", "1", "bins with any evidence", "count"),
    Column("weight", "1", "sum of the weights of the onsets"),
    Column("weighted_log", "1", "sum of the weighted logarithms of the maximum adhesion"),
    Column("sha256", "", "checksum of the log; empty for a part of a long one", "text"),
    Column("identity", "", "checksum of the drive's recorded samples", "text"),
    Column("steps", "1", "steps of processing since the recording", "count"),
    Column("entry", "", "the trip's entry in a map, as JSON", "text"),
    Column("evidence", "", "sums by day and bin, packed and compressed", "data"),
)

DRIVING: tuple[Column, ...] = (
    Column("trip", "", "name of the trip", "text"),
    Column("edge", "", "edge of the network, or line", "text"),
    Column("direction", "", "forward or reverse on the edge's chainage", "text"),
    Column("first", "m", "chainage at which the trip enters the edge"),
    Column("last", "m", "chainage at which it leaves the edge"),
    Column("entered", "ns", "time at which it enters the edge, since 1970 UTC", "count"),
    Column("distance", "m", "distance on the edge"),
    Column("running_time", "s", "running time without stops"),
    Column("dwell", "s", "time standing at stations"),
    Column("held", "s", "time standing elsewhere"),
    Column("stops", "1", "stops at stations, but the trip's own ends", "count"),
    Column("traction", "J", "work of the tractive effort at the wheel rims"),
    Column("dynamic_braking", "J", "work of the dynamic brake at the wheel rims"),
    Column("braking", "J", "work of all brakes at the wheel rims"),
    Column("line_energy", "J", "drawn from the line less fed back"),
    Column("line_energy_source", "", "recorded, or efficiencies of the train's file", "text"),
    Column("coasting", "1", "coasting share of the distance"),
    Column("excess", "m/s", "largest speed above the permitted one; 0 within 1 km/h"),
    Column("excess_distance", "m", "distance above the permitted speed"),
    Column("slips", "1", "actions of the slip protection"),
    Column("mass", "kg", "mass of the loaded train, as the log or its passport states it"),
    Column("mass_std", "kg", "its standard deviation"),
    Column("shortest_time", "s", "running time of the shortest run with the same stops"),
    *(Column(column, "s", CAUSES[cause][0]) for cause, column in LOST.items()),
)

CHECKS: tuple[Column, ...] = (
    Column("trip", "", "name of the trip", "text"),
    Column("duration", "s", "time from the first sample to the last"),
    Column("distance", "m", "distance between the lowest and the highest position"),
    Column("damage", "", "losses of the log; empty if it is whole", "text"),
    Column("gaps", "1", "pauses of the train's state", "count"),
    Column("gap_time", "s", "time of all pauses"),
    Column("longest_gap", "s", "longest pause"),
    Column("repairs", "1", "cells and rows that ingest repaired or dropped", "count"),
    Column("repaired", "", "how often each rule was applied: rule=count, ...", "text"),
    Column(
        "stated",
        "",
        "how often a rule found a defect that it only reports: rule=count, ...",
        "text",
    ),
    Column("missing", "", "channels that are not recorded, separated by commas", "text"),
    Column("frozen", "", "columns that repeat a value while the train moves", "text"),
    Column("frozen_samples", "1", "samples that repeat a value", "count"),
    Column(
        "speed_scale", "1", "ratio of measured to true speed, by satellites or recorded distance"
    ),
    Column("speed_scale_std", "1", "its standard deviation"),
    Column("speed_scale_source", "", "satellites or recorded distance", "text"),
    Column("fix_beside", "m", "median distance of fixes beside the line's geometry"),
    Column("fix_along", "m", "median difference of the fixes' chainage to the recorded one"),
    Column("fix_spread", "m", "half of the fixes' chainages are within this of that median"),
    Column("doubts", "", "checks that could not be made, and why", "text"),
)


@dataclass(frozen=True)
class FleetAnalysis:
    """A pure function of a trip, with the table that it gives.

    Attributes
    ----------
    name : str
        By which results are kept.
    columns : tuple of Column
        Of the table, beside the trip's ``key``; kinds are ``text``, ``count``, ``number``,
        ``numbers`` (a list) and ``data`` (bytes).
    run : callable
        ``run(trip, **parameters) -> DataFrame``: a function of a module, so that processes find
        it by its name. Raises `TrainlogError` where a trip cannot be used.
    parameters : mapping of str to JSON values
        What the result depends on beside trip and code.
    numbers : mapping of str to int
        Of parameters that are a positive number 1, of those that are a lower and a higher one 2;
        others are checked by `run`.

    Examples
    --------
    >>> from analysis import view_of
    >>> from analysis.fleet.analyses import ANALYSES
    >>> trip = view_of("sample_logs/nonstop.mcap")
    >>> found = ANALYSES["resistance"].table(trip)
    >>> len(found), bool(abs(found["mass"][0] - 145e3) < 1e3)
    (1, True)
    """

    name: str
    columns: tuple[Column, ...]
    run: Run
    parameters: Mapping[str, Any] = field(default_factory=dict)
    numbers: Mapping[str, int] = field(default_factory=dict)

    def table(self, trip: TripView) -> pd.DataFrame:
        """The table of a trip, with the declared columns in their order.

        Raises
        ------
        TrainlogError
            If the trip cannot be used, with the reason.
        """
        found = self.run(trip, **self.parameters)
        return found[[column.name for column in self.columns]]

    def with_parameters(self, **parameters: Any) -> FleetAnalysis:
        """The analysis with other parameters.

        Raises
        ------
        InputError
            If it has no such parameter, or the value is not of its `numbers`.

        Examples
        --------
        >>> from analysis.fleet.analyses import ANALYSES
        >>> ANALYSES["adhesion"].with_parameters(bin_length=50.0).parameters
        {'bin_length': 50.0}
        """
        for name, value in parameters.items():
            if name not in self.parameters:
                known = ", ".join(self.parameters) or "none"
                raise InputError(
                    f"analysis '{self.name}' has no parameter '{name}'", remedy=f"it has {known}"
                )
            count = self.numbers.get(name)
            if count is None or value == self.parameters[name]:
                continue
            given = list(value) if isinstance(value, list | tuple) else [value]
            right = len(given) == count and all(isinstance(each, int | float) for each in given)
            steps = np.diff([0.0, *given]) if right else np.zeros(1)
            if not (np.isfinite(steps).all() and steps.min() >= 0.0 and steps[-1] > 0.0):
                remedy = "a positive number" if count == 1 else "two numbers, as [5, 40]"
                raise InputError(
                    f"{self.name}.{name} is {value!r}", remedy=f"give {remedy}, in SI units"
                )
        return replace(self, parameters={**self.parameters, **parameters})

    @property
    def is_default(self) -> bool:
        """Whether it is registered so, with these parameters."""
        return ANALYSES.get(self.name) == self

    @property
    def digest(self) -> str:
        """Of the parameters."""
        return sha256(json.dumps(dict(self.parameters), sort_keys=True).encode())[:16]

    @property
    def schema(self) -> pa.Schema:
        """Of the table as it is kept, with units and meanings."""
        return pa.schema([column.field for column in (KEY, *self.columns)])

    def arrow(self, tables: Iterable[tuple[str, pd.DataFrame]]) -> pa.Table:
        """Tables of trips, by their keys, as one table with units."""
        parts = [frame.assign(**{KEY.name: key}) for key, frame in tables if len(frame)]
        columns = (KEY, *self.columns)
        return arrow_of(
            columns,
            {
                each.name: [value for part in parts for value in part[each.name].tolist()]
                for each in columns
            },
        )


# -------------------------------------------------------------------------------- resistance


def resistance(
    trip: TripView,
    speeds: tuple[float, float] | None = None,
    largest_std: float = LARGEST_STD,
) -> pd.DataFrame:
    """The summary of a trip's fit, one row; also of a trip that is refused, with the reason."""
    from analysis.resistance.combination import summarised
    from analysis.resistance.fit import fit_trip
    from analysis.resistance.recording import TripRefusedError

    digests = {trip.name: trip.sha256}
    try:
        chosen = None if speeds is None else (float(speeds[0]), float(speeds[1]))
        fit = fit_trip(trip, chosen, largest_std=largest_std)
    except TripRefusedError as error:
        return summarised(
            [], {trip.name: error}, trains={trip.name: trip.train.name}, digests=digests
        )
    return summarised([fit], digests=digests)


# ---------------------------------------------------------------------------------- passport


def passport_row(trip: TripView) -> pd.DataFrame:
    """What is known of the trip's recorder and load, one row."""
    from analysis.resistance.passport import passport, shared_delay_std

    found = passport(trip)
    row: dict[str, Any] = {"trip": trip.name, "findings": "; ".join(found.findings)}
    for name in QUANTITIES:
        each: Quantity = getattr(found, name)
        row |= {name: each.value, f"{name}_std": each.std, f"{name}_source": each.source}
    noise = found.speed_noise.get("/train/state.speed")
    sources: list[str] = [each.source for each in found.wheel_factor]
    row |= {
        "effort_delay_shared_std": shared_delay_std(found),
        "speed_noise": np.nan if noise is None else noise.value,
        "wheel_factors": [each.value for each in found.wheel_factor],
        "wheel_factor_stds": [each.std for each in found.wheel_factor],
        "wheel_factor_source": max(sources, key=sources.count) if sources else "",
        "sample_time": found.sample_time.get("/train/state", np.nan),
    }
    return frame_of(PASSPORT, [row])


# ---------------------------------------------------------------------------------- adhesion


def adhesion(trip: TripView, bin_length: float = BIN_LENGTH) -> pd.DataFrame:
    """What a trip shows of the maximum adhesion, one row an edge and rail condition.

    A trip that never met an edge's limit gives a row there, too: what it used without slip.
    """
    from analysis.adhesion.condition_map import empty_map_of, recording_of
    from analysis.adhesion.evidence import condition_of, with_details
    from analysis.adhesion.slip import slip
    from analysis.network.edges import edges_of, on_edge
    from trainlog.formats.mapfile import packed_evidence
    from trainlog.identity import text_of

    line = trip.own_line
    of_line = empty_map_of(line.name, line.length)
    conditions = {
        edge.name: condition_of(trip.trip, of_line, edge=edge.name) for edge in edges_of(line)
    }
    analysis = slip(trip)
    rows = []
    for edge in edges_of(line):
        track = empty_map_of(edge.name, edge.length, bin_length)
        seen = on_edge(analysis, edge)
        if not seen.time.size:
            continue
        found = with_details([seen], trip.trip, track, conditions[edge.name], sha256=trip.sha256,
                             recorded=trip.identity)  # fmt: skip
        entry = recording_of(found).entry
        entry.pop("identity")
        for layer, daily in found.layers.items():
            days = daily.days
            rows.append(
                {
                    "trip": found.trip,
                    "edge": edge.name,
                    "edge_length": edge.length,
                    "bin_length": bin_length,
                    "layer": layer,
                    "main_layer": found.layer,
                    "first_day": int(days[0]) if days.size else -1,
                    "last_day": int(days[-1]) if days.size else -1,
                    "onsets": int(daily.events.sum()),
                    "bins": int(np.union1d(daily.bin, daily.used_bin).size),
                    "weight": float(daily.weight.sum()),
                    "weighted_log": float(daily.weighted_log.sum()),
                    "sha256": trip.sha256,
                    "identity": text_of(trip.identity),
                    "steps": found.steps,
                    "entry": json.dumps(entry, sort_keys=True, ensure_ascii=False),
                    "evidence": zlib.compress(packed_evidence(daily)),
                }
            )
    return frame_of(ADHESION, rows)


# ----------------------------------------------------------------------------- driving, checks


def driving(trip: TripView) -> pd.DataFrame:
    """Times, energy and losses of a trip, one row an edge."""
    from analysis.fleet.driving import driven_edges

    return frame_of(DRIVING, driven_edges(trip))


def checks(trip: TripView) -> pd.DataFrame:
    """What of a trip's recording is doubtful, one row."""
    from analysis.fleet.checks import checked

    return frame_of(CHECKS, [checked(trip)])


ANALYSES: dict[str, FleetAnalysis] = {
    each.name: each
    for each in (
        FleetAnalysis(
            "resistance",
            SUMMARY,
            resistance,
            {"speeds": None, "largest_std": LARGEST_STD},
            {"speeds": 2, "largest_std": 1},
        ),
        FleetAnalysis("passport", PASSPORT, passport_row),
        FleetAnalysis(
            "adhesion", ADHESION, adhesion, {"bin_length": BIN_LENGTH}, {"bin_length": 1}
        ),
        FleetAnalysis("driving", DRIVING, driving),
        FleetAnalysis("checks", CHECKS, checks),
    )
}
"""The registered analyses, by name."""


def analyses_named(names: Iterable[str] | None = None) -> tuple[FleetAnalysis, ...]:
    """The registered analyses of these names, or all.

    Raises
    ------
    InputError
        If there is no analysis of a name.

    Examples
    --------
    >>> [each.name for each in analyses_named(["checks", "resistance"])]
    ['resistance', 'checks']
    """
    wanted = list(ANALYSES) if names is None else list(names)
    for name in wanted:
        if name not in ANALYSES:
            raise InputError(f"there is no analysis '{name}'", remedy=f"give {', '.join(ANALYSES)}")
    return tuple(each for name, each in ANALYSES.items() if name in wanted)


# ------------------------------------------------------------------- results of a catalogue

_WORK = "analysis.fleet.work"
"""Module from which all code is imported that a registered analysis runs through."""


def code_of(analysis: FleetAnalysis) -> str:
    """Version of the code of an analysis: of all modules that it can run through, and of no other.

    What draws, reports, plans or keeps results may change without results being computed anew. Of
    an analysis that is not a part of trainlog: of its own file, and all of trainlog.

    Examples
    --------
    >>> from analysis.fleet.analyses import ANALYSES
    >>> code_of(ANALYSES["checks"]) == code_version_of("analysis.fleet.work")
    True
    """
    module = analysis.run.__module__
    if module.partition(".")[0] in ("analysis", "trainlog"):
        return code_version_of(_WORK)
    file = getattr(sys.modules.get(module), "__file__", None)
    own = Path(file).read_bytes() if file else b""
    return sha256(code_version().encode() + own)[:16]


def computation_of(analysis: FleetAnalysis) -> Computation:
    """The analysis by its present code, as a catalogue keeps what it gives."""
    from trainlog.catalogue import Computation

    return Computation(analysis.name, code_of(analysis), analysis.parameters)


def stored_summaries(catalogue: Catalogue, where: str | None) -> tuple[pd.DataFrame, list[Path]]:
    """Summaries of trips that are stored, and the logs of those of which none is.

    Parameters
    ----------
    catalogue : Catalogue
    where : str or None
        As for `Catalogue.query`.

    Returns
    -------
    DataFrame
        Of the analysis "resistance" by the present code and its ordinary parameters, with the
        columns of `trainlog.formats.summaries.COLUMNS`.
    list of Path
        Of all other trips, whose logs must be read.

    Raises
    ------
    InputError
        As `Catalogue.paths`.
    """
    resistance = computation_of(ANALYSES["resistance"])
    paths = catalogue.paths(where)
    names = [column.name for column in SUMMARY]
    found = catalogue.results(resistance, where=where)
    if found.empty:
        return pd.DataFrame(columns=names), paths
    pending = catalogue.pending(resistance, where=where)
    unknown = {str(Path(path)) for path in pending["path"]}
    summaries = found[names]
    for column in SUMMARY:
        if column.kind == "text":
            summaries = summaries.assign(**{column.name: summaries[column.name].fillna("")})
    return summaries, [path for path in paths if str(path) in unknown]

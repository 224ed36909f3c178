"""What is computed of each trip of a fleet: pure functions from a trip to a small table.

Each table has the columns that its analysis declares, the same for whichever trip, in whichever
process: a result depends on the recorded samples, the code and the parameters and on nothing else.
docs/fleet.md lists the columns.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa

from analysis.fleet.columns import ADHESION, CHECKS, DRIVING, KEY, PASSPORT, QUANTITIES
from trainlog.errors import InputError
from trainlog.formats.files import sha256
from trainlog.formats.summaries import COLUMNS as SUMMARY, Column, arrow_of, frame_of
from trainlog.railway.condition import BIN_LENGTH
from trainlog.railway.resistance import LARGEST_STD

if TYPE_CHECKING:
    from analysis.fleet.trips import FleetTrip
    from trainlog.railway.passport import Quantity

# What computes is imported where it is called: a process that only names analyses, and asks for
# their parameters and columns, loads none of it. Workers load all of it once (`load_analyses`).

Run = Callable[..., pd.DataFrame]


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

    Examples
    --------
    >>> from analysis import fleet_trips
    >>> from analysis.fleet.analyses import ANALYSES
    >>> trip = next(fleet_trips("sample_logs/nonstop.mcap"))
    >>> found = ANALYSES["resistance"].table(trip)
    >>> len(found), bool(abs(found["mass"][0] - 145e3) < 1e3)
    (1, True)
    """

    name: str
    columns: tuple[Column, ...]
    run: Run
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def table(self, trip: FleetTrip) -> pd.DataFrame:
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
            If it has no such parameter.

        Examples
        --------
        >>> from analysis.fleet.analyses import ANALYSES
        >>> ANALYSES["adhesion"].with_parameters(bin_length=50.0).parameters
        {'bin_length': 50.0}
        """
        for name in parameters:
            if name not in self.parameters:
                known = ", ".join(self.parameters) or "none"
                raise InputError(
                    f"analysis '{self.name}' has no parameter '{name}'", remedy=f"it has {known}"
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
    trip: FleetTrip,
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
        fit = fit_trip(trip.trip, chosen, largest_std=largest_std, known=trip.passport)
    except TripRefusedError as error:
        return summarised(
            [], {trip.name: error}, trains={trip.name: trip.train.name}, digests=digests
        )
    return summarised([fit], digests=digests)


# ---------------------------------------------------------------------------------- passport


def passport_row(trip: FleetTrip) -> pd.DataFrame:
    """What is known of the trip's recorder and load, one row."""
    from analysis.passports import shared_delay_std

    found = trip.passport
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


def adhesion(trip: FleetTrip, bin_length: float = BIN_LENGTH) -> pd.DataFrame:
    """What a trip shows of the maximum adhesion, one row an edge and rail condition.

    A trip that never met an edge's limit gives a row there, too: what it used without slip.
    """
    from analysis.adhesion.condition_map import entry_of
    from analysis.adhesion.covariates import covariates
    from analysis.adhesion.empty_map import empty_map_of
    from analysis.adhesion.evidence import condition_of, evidence_of
    from analysis.network.edges import edges_of, on_edge
    from trainlog.formats.recordings import packed_evidence
    from trainlog.identity import text_of

    line = trip.own_line
    of_line = empty_map_of(line.name, line.length)
    conditions = {
        edge.name: condition_of(trip.trip, of_line, edge=edge.name) for edge in edges_of(line)
    }
    analysis = trip.slip
    rows = []
    for edge in edges_of(line):
        track = empty_map_of(edge.name, edge.length, bin_length)
        seen = on_edge(analysis, edge)
        if not seen.time.size:
            continue
        found = evidence_of(seen, track, conditions[edge.name], sha256=trip.sha256)
        details = found.details | covariates(trip.trip, found.span)
        found = replace(found, recorded=trip.identity, details=details)
        entry = {name: each for name, each in entry_of(found).items() if name != "identity"}
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
                    "steps": len(trip.trip.provenance),
                    "entry": json.dumps(entry, sort_keys=True, ensure_ascii=False),
                    "evidence": zlib.compress(packed_evidence(daily)),
                }
            )
    return frame_of(ADHESION, rows)


# ----------------------------------------------------------------------------- driving, checks


def driving(trip: FleetTrip) -> pd.DataFrame:
    """Times, energy and losses of a trip, one row an edge."""
    from analysis.fleet.driving import driven_edges

    return frame_of(DRIVING, driven_edges(trip))


def checks(trip: FleetTrip) -> pd.DataFrame:
    """What of a trip's recording is doubtful, one row."""
    from analysis.fleet.checks import checked

    return frame_of(CHECKS, [checked(trip)])


ANALYSES: dict[str, FleetAnalysis] = {
    each.name: each
    for each in (
        FleetAnalysis(
            "resistance", SUMMARY, resistance, {"speeds": None, "largest_std": LARGEST_STD}
        ),
        FleetAnalysis("passport", PASSPORT, passport_row),
        FleetAnalysis("adhesion", ADHESION, adhesion, {"bin_length": BIN_LENGTH}),
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

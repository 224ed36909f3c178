"""What is computed of each trip of a fleet: what the single analyses give, read once."""

from __future__ import annotations

import json
import re
import zlib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import refused

import trainlog
from analysis.adhesion.condition_map import empty_map
from analysis.adhesion.evidence import evidence_of_log, own_line
from analysis.comparison.driven import driven_trip
from analysis.fleet.analyses import ANALYSES, analyses_named
from analysis.resistance.fit import fit_trip
from analysis.view import TripView, view_of
from trainlog.errors import InputError
from trainlog.formats.mapfile import packed_evidence

pytestmark = pytest.mark.usefixtures("remembered")

LOGS = ("sample_logs/nonstop.mcap", "sample_logs/stopping.mcap")
DOCS = Path(__file__).parents[1] / "docs"


def one(name: str, trip: TripView | str) -> pd.DataFrame:
    given = view_of(trip) if isinstance(trip, str) else trip
    return ANALYSES[name].table(given)


def test_each_table_has_the_columns_that_are_declared_and_documented():
    page = (DOCS / "fleet.md").read_text("utf-8")
    trip = view_of(LOGS[0])
    for analysis in ANALYSES.values():
        table = analysis.arrow([("k", analysis.table(trip))])
        assert table.column_names == ["key", *(column.name for column in analysis.columns)]
        assert table.num_rows == 1
        assert table.schema.equals(analysis.schema, check_metadata=True)
        part = re.search(rf"### `{analysis.name}`\n(.*?)\n##", page, re.DOTALL)
        assert part is not None, f"{analysis.name} is not in docs/fleet.md"
        for column in analysis.columns if analysis.name != "resistance" else ():
            row = f"| `{column.name}` | {column.unit} | {column.meaning} |"
            assert row in part[1], row


def test_results_are_those_of_the_single_analyses():
    """Of the fit, of the map, and of times and works."""
    log = LOGS[1]
    row, fit = one("resistance", log).iloc[0], fit_trip(log)
    assert [row["r0"], row["r1"], row["r2"], row["mass"]] == [*fit.beta.tolist(), fit.mass]
    assert (row["identity"], row["refused"]) == (fit.identity, "")
    row = one("adhesion", log).iloc[0]
    piece = evidence_of_log(Path(log), empty_map(own_line(trainlog.read(log, []))))
    assert zlib.decompress(row["evidence"]) == packed_evidence(piece.daily)
    assert row["layer"] == row["main_layer"] == piece.layer
    assert row["onsets"] == piece.daily.events.sum() > 0
    assert json.loads(row["entry"])["weather"] == piece.details["weather"]
    row, trip = one("driving", log).iloc[0], driven_trip(log)
    assert row["running_time"] == pytest.approx(trip.running[-1], abs=0.2)
    assert row["dwell"] == pytest.approx(trip.duration - trip.running[-1], abs=0.2)
    assert row["traction"] == pytest.approx(np.ptp(trip.sums["traction"]), rel=1e-4)
    assert row["stops"] == len(trip.stands) - 2
    lost = [name for name in row.index if name.startswith("lost_")]
    late = row["running_time"] - row["shortest_time"]
    assert row[lost].sum() == pytest.approx(late, abs=0.4)
    assert late > 0.0


def test_a_trip_that_is_refused_has_a_row_with_the_reason():
    trip = view_of(LOGS[1])
    short = TripView(trip.trip.between("2024-10-07T08:01", "2024-10-07T08:03"))
    row = one("resistance", short).iloc[0]
    assert row["refused"] != ""
    assert "trip-03" in row["message"]
    assert np.isnan(row["mass"])


def test_checks_list_what_is_wrong_with_a_recording():
    trip = trainlog.read(LOGS[1])
    state, axles = trip["/train/state"].copy(), trip["/train/axles"].copy()
    state = state.drop(state.index[4000:4300])
    axles.iloc[6000:6600, 0] = axles.iloc[6000, 0]
    controls = trip["/train/controls"].assign(pneumatic_braking_effort=np.nan)
    worse = trip.with_topic(state).with_topic(axles).with_topic(controls)
    sound, row = (one("checks", TripView(each)).iloc[0] for each in (trip, worse))
    assert (sound["gaps"], sound["frozen"], sound["missing"]) == (0, "", "")
    assert row["gaps"] == 1
    assert row["longest_gap"] == pytest.approx(30.1)
    assert row["missing"] == "pneumatic braking effort"
    assert "/train/axles.wheel_speed" in row["frozen"]
    assert row["frozen_samples"] == 599


def test_parameters_are_part_of_what_identifies_a_result():
    coarse = ANALYSES["adhesion"].with_parameters(bin_length=100.0)
    assert coarse.digest != ANALYSES["adhesion"].digest
    fine, rough = (each.table(view_of(LOGS[0])) for each in (ANALYSES["adhesion"], coarse))
    assert fine["bins"][0] > 2 * rough["bins"][0]
    refused(InputError, "no parameter 'bins'", ANALYSES["adhesion"].with_parameters, bins=3)
    refused(InputError, "no analysis 'energy'", analyses_named, ["energy"])

"""Looking at a track-condition map: its state at a time, as tables, JSON and picture."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import refused

import analysis
import trainlog
from analysis.charts import draw
from trainlog.cli.main import run
from trainlog.condition import estimated
from trainlog.errors import InputError
from trainlog.railway import Line, TrackConditionMap
from trainlog.railway.condition import (
    AdhesionEstimate,
    ConditionChange,
    ConditionLayer,
    ModelParameter,
    PassingSpot,
)
from trainlog.railway.evidence import DailyEvidence

pytestmark = pytest.mark.usefixtures("remembered")

AT = pd.Timestamp("2024-10-09T06:00", tz="UTC")
SPOT = PassingSpot(9_675.0, 9_750.0, 0.07, 0.06, 0.08, 20_003, 20_003, 20_003, 0.9, 2.0)
CHANGE = ConditionChange(100.0, 150.0, 20_002, 20_001, 20_003, 0.10, 0.14, 0.05, 0.05, 8.0)
MODEL = {
    each.name: each
    for each in (
        ModelParameter("trip_std", "1", 0.12, 0.011, "estimated"),
        ModelParameter("correlation_length", "m", 120.0, float("nan"), "assumed"),
        ModelParameter("mean", "1", -1.238, 0.09, "assumed"),
        ModelParameter("slippery_length", "m", 193.2, 124.0, "assumed"),
    )
}


class Layer(ConditionLayer):
    """A layer whose expected condition is lower than the lasting one by a tenth."""

    def expected(self, time: pd.Timestamp | None = None) -> AdhesionEstimate:
        return AdhesionEstimate(self.log_mean + np.log(0.9), self.log_std, self.observed)


@pytest.fixture
def line() -> Line:
    return trainlog.read_line(trainlog.sample(trainlog.DEFAULT_LINE))


@pytest.fixture
def track() -> TrackConditionMap:
    found = trainlog.read_map(trainlog.sample("CH_StGallen_Wil.map"))
    wet = found.layer("wet")
    mine = Layer(
        wet.log_mean,
        wet.log_std,
        wet.observed,
        evidence=wet.evidence,
        spots=(SPOT,),
        changes=(CHANGE,),
        model=MODEL,
    )
    return replace(found, layers={**found.layers, "wet": mine})


def days_of(track: TrackConditionMap, shift: int) -> TrackConditionMap:
    """The map with all its evidence again so many days later, under other trip names."""
    wet = track.layer("wet").evidence
    later = replace(wet, day=wet.day + shift, used_day=wet.used_day + shift)
    both = ConditionLayer.unestimated(DailyEvidence.total([wet, later]))
    trips = [each for each in track.trips if each["layer"] == "wet"]
    again = [
        {**each, "trip": "again", "weather": {"time": "2024-10-10T08:00:00Z"}} for each in trips
    ]
    return estimated(replace(track, layers={"wet": both}, trips=(*trips, *again)))


def test_a_past_time_is_shown_and_written_as_it_was_known_then(tmp_path: Path) -> None:
    track = trainlog.read_map(trainlog.sample("CH_StGallen_Wil.map"))
    longer, past = days_of(track, 3), pd.Timestamp("2024-10-09T06:00Z")
    assert longer.days.tolist() == [20_003, 20_006]
    then = analysis.map_state(longer, past)
    assert then.layers["last_day"].tolist() == ["2024-10-07"]
    assert then.layers["onsets"].tolist() == [203]
    assert [each["trip"] for each in then.data()["trips"]] == ["trip-03", "trip-07", "trip-11"]
    assert then.data()["trips"][0]["day"] == "2024-10-07"
    left = "without the evidence of 1 day, 2024-10-10, which is not from before 2024-10-09 (UTC)"
    assert then.notes[-1] == left
    for name, given in (("then", longer), ("now", track)):
        path = tmp_path / f"{name}.csv"
        analysis.export_map(given, path, at=past, layers=["wet"])
    assert (tmp_path / "then.csv").read_bytes() == (tmp_path / "now.csv").read_bytes()
    early = pd.Timestamp("2024-10-07T23:00Z")
    for view in (
        lambda: analysis.map_state(longer, early),
        lambda: analysis.export_map(longer, tmp_path / "none.csv", at=early),
        lambda: draw(longer, tmp_path / "none.png", at=early),
    ):
        refused(InputError, "has no evidence of a day before 2024-10-07", view)
    assert not list(tmp_path.glob("none*"))


def test_the_default_time_is_right_after_the_last_evidence(track: TrackConditionMap) -> None:
    state = analysis.map_state(track)
    assert state.at == state.last_evidence == pd.Timestamp("2024-10-08", tz="UTC")
    assert state.spots["probability"].tolist() == [0.9]
    naive = analysis.map_state(track, pd.Timestamp("2024-10-09T06:00"))
    assert naive.at == AT
    assert "Passing spots" in naive._repr_html_()
    assert "expected at 2024-10-09 06:00 UTC" in repr(naive)


@pytest.mark.usefixtures("unpainted")
def test_the_command_prints_json_and_states_the_zone_that_it_assumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    condition = str(trainlog.sample("CH_StGallen_Wil.map"))
    words = ["map", "show", condition, "--layer", "wet", "--at", "2024-10-09T08:00"]
    assert run([*words, "--zone", "Europe/Zurich", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["expected_at"] == "2024-10-09T06:00:00+00:00"
    assert [each["layer"] for each in found["layers"]] == ["wet"]
    assert [each["last_day"] for each in found["layers"]] == ["2024-10-07"]
    assert found["last_evidence"] == "2024-10-07"
    assert found["evidence_ends"] == "2024-10-08T00:00:00+00:00"
    lowest = found["lowest"][0]
    assert lowest["near"] == "at Flawil"
    assert lowest["expected_low"] < lowest["expected"] < lowest["expected_high"]
    assert run([*words, "--picture", str(tmp_path / "wet.png")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "states no zone: taken for UTC" in shown
    assert (tmp_path / "wet.png").is_file()
    unread = tmp_path / "other.map"
    unread.write_bytes(b"not a map")
    drawn = ["--picture", str(tmp_path / "no.png")]
    for given, message, more in (
        ("8:8", "not a part of a line", drawn),
        ("8:9", "what a picture shows", []),
    ):
        refused(InputError, message, run, ["map", "show", str(unread), "--km", given, *more])
    with pytest.raises(InputError, match="has no layer 'frost'"):
        run(["map", "show", condition, "--layer", "frost", "--picture", str(tmp_path / "no.png")])
    assert not (tmp_path / "no.png").exists()

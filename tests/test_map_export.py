"""A track-condition map for other programs, and what changed between two maps or dates."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pyogrio
import pytest
from refusals import refused
from scipy.special import ndtr
from simulated_line import level_line

import analysis
import trainlog
from analysis.adhesion.condition_map import empty_map
from analysis.adhesion.condition_table import bins_table, line_table, sections_table
from analysis.adhesion.map_difference import detectable_ratio, q_values
from analysis.adhesion.map_plot import map_charts
from analysis.charts import Chart, Panel, draw, figure_of
from trainlog.cli.main import run
from trainlog.condition import estimated
from trainlog.errors import InputError, MissingExtraError
from trainlog.formats.railway import line_to_bytes, read_line
from trainlog.formats.samples import sample
from trainlog.formats.ttobench import read_adhesion
from trainlog.railway import (
    CurvatureProfile,
    Line,
    LineReference,
    Station,
    StepProfile,
    TrackConditionMap,
    Tunnel,
)
from trainlog.railway.condition import ConditionChange, ConditionLayer, PassingSpot
from trainlog.railway.evidence import DailyEvidence
from trainlog.trip import LINE_ATTACHMENT

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds")

AT = pd.Timestamp("2024-10-09T06:00", tz="UTC")
SPOT = PassingSpot(9_675.0, 9_750.0, 0.07, 0.06, 0.08, 20_003, 20_003, 20_003, 0.9, 2.0)
CHANGE = ConditionChange(100.0, 150.0, 20_002, 20_001, 20_003, 0.10, 0.14, 0.05, 0.05, 8.0)


@pytest.fixture
def line() -> Line:
    """St.Gallen - Wil, counted downwards by its operator with a jump at chainage 10 km."""
    found = trainlog.read_line(trainlog.sample(trainlog.DEFAULT_LINE))
    start, end = np.array([61_200.0, 51_000.0]), np.array([51_200.0, 31_443.9])
    return replace(found, reference=LineReference("850", np.array([0.0, 10_000.0]), start, end))


@pytest.fixture
def track() -> TrackConditionMap:
    found = trainlog.read_map(trainlog.sample("CH_StGallen_Wil.map"))
    wet = replace(found.layer("wet"), spots=(SPOT,), changes=(CHANGE,))
    return replace(found, layers={**found.layers, "wet": wet})


def test_gdal_reads_from_a_geopackage_what_the_map_knows(track, line, tmp_path):
    path, again = tmp_path / "map.gpkg", tmp_path / "again.gpkg"
    for each in (path, again):
        analysis.export_map(track, each, line=line, at=AT)
    assert path.read_bytes() == again.read_bytes()
    tables = {"bins", "sections", "spots", "changes", "stations"}
    assert set(pyogrio.list_layers(path)[:, 0]) == tables
    meta, _, courses, columns = pyogrio.raw.read(path, layer="bins")
    found = pd.DataFrame(dict(zip(meta["fields"], columns, strict=True)))
    assert meta["crs"] == "EPSG:4326"
    expected = bins_table(track, line, AT)
    assert list(found) == [*expected, "expected_at"]
    assert set(found["expected_at"]) == {"2024-10-09T06:00:00+00:00"}
    for name in expected.select_dtypes("number"):
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
    observed = np.concatenate([layer.observed for layer in track.layers.values()])
    for name in ("adhesion", "low", "high", "expected", "expected_low", "expected_high"):
        np.testing.assert_array_equal(found[name].notna(), observed)
    # A probability that no spot lies there would be a claim about what nobody has seen.
    in_spot = expected["spot_probability"] > 0.0
    np.testing.assert_array_equal(found["spot_probability"].notna(), observed | in_spot)
    assert found["spot_probability"].isna().sum() > 2_000
    assert found["changed_day"].dropna().astype(str).tolist() == ["2024-10-06"] * 2
    # Each bin lies where its chainage does: both ends on the line's own course.
    for row in (0, 400, len(found) - 1):
        assert courses[row][:5] == b"\x01\x02\x00\x00\x00"
        points = np.frombuffer(courses[row][9:], "<f8").reshape(-1, 2)
        for end, name in ((0, "start_m"), (-1, "end_m")):
            latitude, longitude = line.geometry.at(found[name][row])
            np.testing.assert_allclose(points[end], [longitude, latitude], atol=1e-7)
    info = pyogrio.read_info(path, layer="bins")
    assert info["dataset_metadata"]["expected_at"] == "2024-10-09T06:00:00+00:00"


def test_geojson_follows_rfc_7946_and_gdal_reads_it(track, line, tmp_path):
    path = tmp_path / "map.geojson"
    analysis.export_map(track, path, line=line, at=AT, layers=["wet"])
    content = json.loads(path.read_text("utf-8"))
    assert content["type"] == "FeatureCollection"
    assert "crs" not in content  # WGS 84 is the only one (section 4)
    kinds = Counter(each["properties"]["kind"] for each in content["features"])
    assert kinds == {"bin": track.bins, "spot": 1, "change": 1, "station": 5}
    for each in content["features"]:
        assert set(each) == {"type", "geometry", "properties"}
        given = each["geometry"]["coordinates"]
        longitude, latitude = given if each["geometry"]["type"] == "Point" else given[0]
        assert 9.0 < longitude < 9.4  # longitude first (section 3.1.1)
        assert 47.4 < latitude < 47.5
    meta, _, geometry, columns = pyogrio.raw.read(path)
    assert meta["crs"] == "EPSG:4326"
    values = columns[list(meta["fields"]).index("adhesion")][: track.bins]
    np.testing.assert_array_equal(values, bins_table(track, line, AT, ["wet"])["adhesion"])
    np.testing.assert_array_equal(np.isfinite(values), track.layer("wet").observed)
    assert len(geometry) == kinds.total()


def test_parquet_and_csv_hold_the_bins_by_chainage(track, line, tmp_path):
    expected = bins_table(track, line, AT)
    analysis.export_map(track, tmp_path / "map.parquet", line=line, at=AT)
    table = pq.read_table(tmp_path / "map.parquet")
    assert table.schema.field("speed_limit_km_h").metadata == {b"unit": b"km/h"}
    assert table.schema.field("curvature_per_km").metadata == {b"unit": b"1/km"}
    assert json.loads(table.schema.metadata[b"trainlog"])["operators_line"] == "850"
    analysis.export_map(track, tmp_path / "map.csv", line=line, at=AT)
    for found in (table.to_pandas(), pd.read_csv(tmp_path / "map.csv")):
        assert list(found)[: len(list(expected))] == list(expected)
        for name in expected.select_dtypes("number"):
            np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
        assert found["station"].dropna().tolist() == [s.name for s in line.stations] * 2
        unseen = ~found["observed"] & ~(expected["spot_probability"] > 0.0)
        assert found.loc[unseen, ["adhesion", "expected", "spot_probability"]].isna().all(axis=None)
    assert "2024-10-07" in (tmp_path / "map.csv").read_text("utf-8")


def test_sections_cover_the_line_and_lose_no_extreme(track, line, tmp_path):
    bins, sections = bins_table(track, line, AT), sections_table(track, line, AT)
    for name in track.layers:
        rows, parts = bins[bins["layer"] == name], sections[sections["layer"] == name]
        assert len(parts) < len(rows) / 5
        assert parts["start_m"].tolist()[1:] == parts["end_m"].tolist()[:-1]
        assert parts["end_m"].iloc[-1] == track.length
        assert parts["bins"].sum() == len(rows)
        assert parts["low"].min() == rows["low"].min()
        assert parts["high"].max() == rows["high"].max()
        assert parts["events"].sum() == rows["events"].sum()
        inside = pd.cut(rows["start_m"] + 1e-3, [*parts["start_m"], track.length], labels=False)
        spread = rows.groupby(inside)["adhesion"].agg(lambda each: each.max() - each.min())
        assert spread.max() <= 0.01
        # No section joins what was observed to what was not.
        assert rows.groupby(inside)["observed"].nunique().max() == 1
    analysis.export_map(track, tmp_path / "wet.json", line=line, at=AT, layers=["wet"])
    found = read_adhesion(tmp_path / "wet.json")
    wet = sections[sections["layer"] == "wet"]
    about = found.metadata.associated_track, found.rail_condition, found.length
    assert about == (track.line, "wet", track.length)
    np.testing.assert_array_equal(found.adhesion[0], wet["start_m"])
    np.testing.assert_array_equal(found.adhesion[1], wet["adhesion"])
    np.testing.assert_array_equal(found.adhesion[6], wet["expected_high"])


def test_what_cannot_be_exported_is_refused_and_older_files_stay(
    track, line, tmp_path, monkeypatch
):
    without = replace(line, geometry=None)
    other = replace(line, name="elsewhere")
    for name, given, layers, message in (
        ("map.shp", line, None, r"not exported to files of this kind; end it in \.geojson, \.gpkg"),
        ("map.gpkg", None, None, "needs the coordinates of line 'CH_StGallen_Wil'"),
        ("map.geojson", without, None, "has no coordinates; add them from fixes with 'trainlog"),
        ("map.csv", other, None, "the map is of line 'CH_StGallen_Wil', 29556.1 m, not of 'else"),
        ("map.csv", line, ["leaves"], "has no layer 'leaves'; layers present: dry, wet"),
        ("map.json", line, None, "has the layers dry, wet; choose one"),
        ("absent/map.gpkg", line, None, "folder"),
    ):
        path = tmp_path / name
        if path.parent.exists():
            path.write_text("older")
        refused(InputError, message, analysis.export_map, track, path, line=given, layers=layers)
        assert not path.parent.exists() or path.read_text() == "older"
        assert not list(tmp_path.glob(".*"))
    empty = replace(track, layers={})
    refused(InputError, "has no layer yet", analysis.export_map, empty, tmp_path / "empty.csv")
    monkeypatch.setitem(sys.modules, "pyogrio", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'trainlog\[gis\]'"):
        analysis.export_map(track, tmp_path / "map.gpkg", line=line)
    assert (tmp_path / "map.gpkg").read_text() == "older"


def test_the_line_is_taken_from_a_log_that_the_map_was_made_from(line, tmp_path):
    own = replace(line, name="own")
    trip = trainlog.read(trainlog.sample("nonstop.mcap"))
    carried = {**trip.attachments, LINE_ATTACHMENT: line_to_bytes(own)}
    known = {**trip.metadata, "line": "own"}
    log, condition = tmp_path / "own.mcap", tmp_path / "own.map"
    trainlog.write(replace(trip, attachments=carried, metadata=known), log)
    # A log that was changed a moment ago may still be changing: the map does not remember it.
    os.utime(log, (1.7e9, 1.7e9))
    assert run(["map", "update", str(log), "--map", str(condition)]) == 0
    words = ["map", "export", str(condition), "-o", str(tmp_path / "own.geojson")]
    assert run(words) == 0
    content = json.loads((tmp_path / "own.geojson").read_text("utf-8"))
    assert content["trainlog"]["operators_line"] == "850"
    log.unlink()
    refused(InputError, r"needs the coordinates of line 'own'.*--line", run, words)


def made_up(**changes: object) -> Line:
    """A line that begins and ends its elements within bins, and whose last bin is short."""
    line = Line(
        "made up",
        1_010.0,
        (Station("A", 0.0), Station("B west", 502.0), Station("B", 510.0), Station("C", 1_010.0)),
        StepProfile([0.0, 333.0, 340.0], [30.0, 10.0, 25.0]),
        StepProfile([0.0, 410.0], [0.012, -0.004]),
        CurvatureProfile(
            [0.0, 205.0, 260.0, 400.0], [0.0, 0.0, -1 / 350, 0.0], [0, -1 / 350, 0, 0]
        ),
        (Tunnel(610.0, 4.0, 40.0),),
    )
    return replace(line, **changes)


@pytest.mark.parametrize("name", ["made up", "CH_StGallen_Wil", "DE_Chemnitz_Cranzahl"])
def test_each_bin_states_what_the_line_is_within_it(name):
    line = made_up() if name == "made up" else read_line(sample(f"{name}.line.json"))
    table = line_table(line, empty_map(line))
    assert table["end_m"].iloc[-1] == line.length
    for row in table.iloc[:: max(1, len(table) // 150)].to_dict("records"):
        # Every centimetre of the bin, its last one left out: there the next begins.
        within = np.arange(row["start_m"], row["end_m"] - 0.005, 0.01)
        assert row["tunnel"] == bool(line.tunnel_cross_section(within).any())
        assert row["gradient_permil"] == pytest.approx(1e3 * line.gradient(within).mean(), abs=0.02)
        assert row["speed_limit_km_h"] == pytest.approx(3.6 * line.speed_limit(within).min())
        if line.curvatures is None:
            assert np.isnan(row["curvature_per_km"])
            continue
        sharpest = np.abs(line.curvature(within)).max()
        assert row["curvature_per_km"] == pytest.approx(1e3 * sharpest, rel=2e-3, abs=1e-6)


def test_what_the_line_does_not_state_is_not_a_number():
    line = made_up(curvatures=None, assumed=("gradients", "speed_limits", "stations"))
    table = line_table(line, empty_map(line))
    unknown = table[["gradient_permil", "curvature_per_km", "speed_limit_km_h"]]
    assert unknown.isna().all(axis=None)
    assert table.station.isna().all()
    other = empty_map(made_up(name="other"))
    refused(InputError, "the map is of line 'other'", line_table, made_up(), other)


def test_limits_of_both_directions_stand_where_they_differ():
    line = made_up(speed_limits_reverse=StepProfile([0.0, 600.0], [15.0, 35.0]))
    table = line_table(line, empty_map(line))
    assert table.speed_limit_km_h.iloc[[0, -1]].tolist() == pytest.approx([108.0, 90.0])
    assert table.speed_limit_reverse_km_h.iloc[[0, -1]].tolist() == pytest.approx([54.0, 126.0])
    unknown = replace(line, assumed=("speed_limits",))
    assert line_table(unknown, empty_map(line)).speed_limit_reverse_km_h.isna().all()


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


def test_a_past_time_is_shown_and_written_as_it_was_known_then(tmp_path):
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


def test_the_default_time_is_right_after_the_last_evidence(track):
    state = analysis.map_state(track)
    assert state.at == state.last_evidence == pd.Timestamp("2024-10-08", tz="UTC")
    assert state.spots["probability"].tolist() == [0.9]
    naive = analysis.map_state(track, pd.Timestamp("2024-10-09T06:00"))
    assert naive.at == AT
    assert "Passing spots" in naive._repr_html_()
    assert "expected at 2024-10-09 06:00 UTC" in repr(naive)


@pytest.mark.usefixtures("unpainted")
def test_the_command_prints_json_and_states_the_zone_that_it_assumed(tmp_path, works):
    condition = trainlog.sample("CH_StGallen_Wil.map")
    words = ("map", "show", condition, "--layer", "wet", "--at", "2024-10-09T08:00")
    found = json.loads(works(*words, "--zone", "Europe/Zurich", "--json"))
    assert found["expected_at"] == "2024-10-09T06:00:00+00:00"
    assert [each["layer"] for each in found["layers"]] == ["wet"]
    assert [each["last_day"] for each in found["layers"]] == ["2024-10-07"]
    assert found["last_evidence"] == "2024-10-07"
    assert found["evidence_ends"] == "2024-10-08T00:00:00+00:00"
    lowest = found["lowest"][0]
    assert lowest["near"] == "0.9 km after Uzwil"
    assert lowest["expected_low"] < lowest["expected"] < lowest["expected_high"]
    shown = " ".join(works(*words, "--picture", tmp_path / "wet.png").split())
    assert "states no zone: taken for UTC" in shown
    assert (tmp_path / "wet.png").is_file()


def test_the_legend_of_a_narrow_chart_stands_over_what_is_drawn():
    """Of the detail of the lowest place of a map, by its limits."""
    charts = map_charts(trainlog.read_map("sample_logs/CH_StGallen_Wil.map"))
    figure = figure_of(charts)
    figure.canvas.draw()
    axes = next(each for each in figure.axes if each.get_ylabel() == "maximum adhesion")
    box = axes.transData.inverted().transform(axes.get_legend().get_window_extent())
    assert box[0, 1] > charts[1].panels[0].limits[1]


def test_the_end_of_a_long_name_is_drawn_too():
    rows = [f"CH_Stadler_FLIRT_TPF_{number} (12 trips)" for number in (1, 2)]
    (axes,) = figure_of(Chart("", [Panel("", [], 1.0, rows=rows)])).axes
    drawn = [each.get_text() for each in axes.get_yticklabels()]
    assert [each[-12:] for each in drawn] == ["1 (12 trips)", "2 (12 trips)"]


DAY = 20_600
CHANGED = slice(150, 162)
"""Bins whose maximum rises by half on the day 30."""

STATIONS = Station("Aach", 0.0), Station("Mitte", 3_900.0), Station("Berg", 6_000.0)
LINE = level_line(6_000.0, limit=30.0, name="A-B", stations=STATIONS)


def a_trip(day: int, seed: int, *, change: bool) -> DailyEvidence:
    """One trip that slips in some of the bins 20 to 40, 150 to 161 and 200 to 230."""
    generator = np.random.default_rng([seed, day])
    bins, levels = 240, 59
    truth = np.log(np.full(bins, 0.12))
    truth[20:40] = np.log(0.09)
    if change and day >= DAY + 30:
        truth[CHANGED] += np.log(1.5)
    prone = np.zeros(bins, dtype=bool)
    for part in (slice(20, 40), CHANGED, slice(200, 230)):
        prone[part] = True
    slips = prone & (generator.random(bins) < 0.4)
    log = truth + generator.laplace(0.0, 0.05) + 0.05 * generator.standard_t(4, bins)
    weight = np.where(slips, 64.0, 0.0)
    used = np.zeros((bins, levels))
    used[60:120, 4] = 1.0
    return DailyEvidence.of_bins(day, slips.astype(float), weight, weight * log, used)


def a_map(days: range, seed: int = 1, *, change: bool = True) -> TrackConditionMap:
    pieces = [a_trip(DAY + day, seed, change=change) for day in days]
    wet = ConditionLayer.unestimated(DailyEvidence.total(pieces))
    trips = tuple(
        {"trip": f"{seed}-{day}", "sha256": f"{seed}-{day}", "layer": "wet"} for day in days
    )
    return replace(empty_map(LINE), layers={"wet": wet}, trips=trips)


@pytest.fixture(scope="module")
def whole() -> TrackConditionMap:
    return estimated(a_map(range(60)))


def test_a_made_up_change_is_found_and_nothing_else(whole):
    found = analysis.map_difference(whole, since=DAY + 29, line=LINE)
    assert found.changed
    inside = found.bins["bin"].between(CHANGED.start, CHANGED.stop - 1)
    assert found.bins.loc[inside, "significant"].sum() >= 10
    assert not found.bins.loc[~inside, "significant"].any()
    (section,) = found.sections.to_dict("records")
    assert section["start_m"] == pytest.approx(25.0 * CHANGED.start, abs=50.0)
    assert section["end_m"] == pytest.approx(25.0 * CHANGED.stop, abs=50.0)
    assert section["before"] == pytest.approx(0.12, abs=0.01)
    assert section["after"] == pytest.approx(0.18, abs=0.015)
    assert section["probability"] > 0.99
    assert section["near"] == "at Mitte"
    assert "1 section changed" in found.sentence


@pytest.mark.parametrize("count", [2, pytest.param(8, marks=pytest.mark.long)])
def test_where_nothing_changed_little_is_found(count):
    """At most one comparison in twenty may find anything; of eight, one at most with luck."""
    found = [
        analysis.map_difference(a_map(range(24), seed, change=False), since=DAY + 11)
        for seed in range(count)
    ]
    assert all(len(each.bins) >= 50 for each in found)
    assert sum(each.changed for each in found) <= 1
    quiet = next(each for each in found if not each.changed)
    assert quiet.data()["layers"]["wet"]["bins"] == len(quiet.bins)
    assert quiet.bins["probability"].mean() < 0.5


def test_dates_and_maps_give_the_same_answer(whole):
    """The map of the first days against the whole compares the same evidence as the dates do."""
    by_date = analysis.map_difference(whole, since=DAY + 29)
    by_map = analysis.map_difference(a_map(range(30)), whole)
    np.testing.assert_array_equal(by_map.bins["difference"], by_date.bins["difference"])
    apart = analysis.map_difference(a_map(range(30)), a_map(range(30, 60)))
    np.testing.assert_array_equal(apart.bins["q_value"], by_date.bins["q_value"])
    back = analysis.map_difference(whole, a_map(range(30)))
    np.testing.assert_allclose(back.bins["difference"], -by_date.bins["difference"], atol=1e-12)
    assert "what the second adds (30 trips)" in by_map.after
    half = analysis.map_difference(a_map(range(40)), a_map(range(20, 60)))
    assert half.notes[0].startswith("Both maps count 20 trips")
    np.testing.assert_array_equal(
        half.bins["after"], analysis.map_difference(whole, since=DAY + 39).bins["after"]
    )


def test_a_trip_under_two_rail_conditions_is_stated_and_not_subtracted():
    first, second = a_map(range(40)), a_map(range(60))
    wet = second.layer("wet").evidence
    moved = [{**each, "layer": "dry"} if each["trip"] == "1-7" else each for each in second.trips]
    parts = [wet.between(-1, DAY + 6), wet.between(DAY + 8, 10**6)]
    evidence = {"dry": a_trip(DAY + 7, 1, change=True), "wet": DailyEvidence.total(parts)}
    layers = {name: ConditionLayer.unestimated(each) for name, each in evidence.items()}
    second = replace(second, layers=layers, trips=tuple(moved))
    found = analysis.map_difference(first, second)
    assert (
        "1 trip under different rail conditions (first, second): 1-7 (wet, dry)" in found.notes[0]
    )
    # The days that only the second has are compared, as if the trip had its right place.
    right = analysis.map_difference(first, a_map(range(60)))
    np.testing.assert_allclose(found.bins["difference"], right.bins["difference"], atol=1e-12)
    other = replace(first, trips=tuple({**each, "layer": "dry"} for each in first.trips))
    with pytest.raises(InputError, match="the same trips, some under another rail condition"):
        analysis.map_difference(first, other)


def test_a_false_discovery_rate_follows_benjamini_and_hochberg():
    # Table 1 of their paper: the four least of fifteen are discoveries at 0.05.
    p = np.array([0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344,
                  0.0459, 0.3240, 0.4262, 0.5719, 0.6528, 0.7590, 1.0])  # fmt: skip
    shuffled = np.random.default_rng(0).permutation(15)
    found = q_values(p[shuffled])
    assert int((found <= 0.05).sum()) == 4
    np.testing.assert_array_equal(np.sort(shuffled[found <= 0.05]), [0, 1, 2, 3])
    assert q_values(np.zeros(0)).size == 0


def test_a_change_of_the_detectable_ratio_is_found_four_times_in_five():
    random = np.random.default_rng(3)
    log_std = random.uniform(0.05, 0.3, 60)
    ratio = detectable_ratio(log_std, 0.05)
    found = 0
    for run_number in range(1_000):
        score = random.standard_normal(60)
        changed = run_number % 60
        score[changed] += np.log(ratio[changed]) / log_std[changed]
        found += q_values(2.0 * ndtr(-np.abs(score)))[changed] <= 0.05
    assert found / 1_000 == pytest.approx(0.8, abs=0.05)


def test_what_cannot_be_compared_is_refused(whole):
    for given, message in (
        ({}, "one map is given; give a second one, or"),
        ({"since": DAY + 90}, "the second date, 2026-07-25, must be after the first, 2026-08-25"),
        ({"since": DAY - 1}, "no layer in common"),
        ({"since": DAY + 29, "layers": ["dry"]}, "has no layer 'dry'"),
        ({"since": DAY + 29, "rate": 0.0}, "rate must be between 0 and 1"),
        ({"second": whole, "since": DAY}, "two maps and dates are given"),
        ({"second": whole}, "both maps count the same trips"),
        ({"second": replace(whole, length=5_900.0)}, "the maps differ in length"),
    ):
        refused(InputError, message, analysis.map_difference, whole, **given)


def test_a_history_has_the_evidence_and_the_estimate_of_each_day(whole, monkeypatch):
    row = CHANGED.start + 5
    position = 25.0 * row + 10.0
    found = analysis.map_history(whole, position, "wet", line=LINE, days=3)
    evidence = whole.layer("wet").evidence
    assert found.onsets["events"].sum() == evidence.events[evidence.bin == row].sum()
    after = found.onsets["day"] >= np.datetime64("2026-06-26")
    assert found.onsets["adhesion"][~after].median() == pytest.approx(0.12, abs=0.012)
    assert found.onsets["adhesion"][after].median() == pytest.approx(0.18, abs=0.018)
    assert (found.onsets["low"] < found.onsets["adhesion"]).all()
    # The estimate as known on a day is that of a map of the days up to then.
    assert found.known["day"].astype(str).tolist() == ["2026-05-27", "2026-06-25", "2026-07-25"]
    assert found.thinned
    then = found.known.iloc[1]
    assert then["adhesion"] == pytest.approx(
        float(np.exp(estimated(a_map(range(30))).layer("wet").log_mean[row])), rel=1e-12
    )
    last = found.known.iloc[-1]
    assert last["adhesion"] == pytest.approx(float(np.exp(whole.layer("wet").log_mean[row])))
    assert last["low"] < last["adhesion"] < last["high"]
    assert found.unmeasured == ""
    assert found.near == "at Mitte"


def test_a_history_of_what_only_used_adhesion_has_levels_and_no_estimate(whole):
    found = analysis.map_history(whole, 2_000.0, "wet", days=2)
    assert found.onsets.empty
    assert found.used["level"].unique().tolist() == pytest.approx([whole.levels[4]])
    assert len(found.used) == 60
    assert found.known.empty
    with pytest.raises(InputError, match=r"km 11 is not on line 'A-B'; it reaches from km 0 to 6"):
        analysis.map_history(whole, 11_000.0, "wet")


@pytest.mark.usefixtures("unpainted")
def test_the_commands_draw_list_and_end_as_diff_does(tmp_path, shell, works):
    path, line = tmp_path / "wet.map", tmp_path / "A-B.line.json"
    trainlog.write_map(estimated(a_map(range(21, 41))), path)
    trainlog.write_line(LINE, line)
    words = ["map", "diff", path, "--from", "2026-06-25", "--line", line]
    status, shown, _ = shell(*words, "--picture", tmp_path / "diff.png")
    shown = " ".join(shown.split())
    assert status == 1
    assert "1 section changed" in shown
    assert "Mitte" in shown
    assert (tmp_path / "diff.png").is_file()
    status, document, _ = shell(*words, "--json")
    found = json.loads(document)
    assert status == 1
    assert found["changed"] is True
    assert [each["near"] for each in found["sections"]] == ["at Mitte"]
    assert found["sentence"] in shown
    words = ["map", "show", path, "--line", line, "--days", "2", "--km"]
    works(*words, "3.9", "--picture", tmp_path / "place.png")
    assert (tmp_path / "place.png").is_file()
    (place,) = json.loads(works(*words, "2", "--json"))["layers"]
    assert place["known"] == []
    assert len(place["used"]) == 20

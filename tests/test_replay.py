"""What a replay holds, read back and compared with the trips; the viewer that shows it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import psutil
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from killed import PATIENCE
from PIL import Image
from refusals import refused
from replay_trips import (
    LENGTH,
    LINE,
    START,
    condition_of,
    entities,
    made_trip,
    rows,
    static,
    trajectory_of,
)
from rerun.chunk import RrdReader
from trip_parts import without

from trainlog import InputError, LogError, ReplayOptions, Trip, frame_of, topics, write_replay
from trainlog.formats.railway import line_to_bytes
from trainlog.formats.samples import sample
from trainlog.mcap import stream_log, write_log
from trainlog.railway.condition import AdhesionEstimate, ConditionLayer, PassingSpot
from trainlog.replay import open_viewer, run_viewer, scalars, take_picture, viewer, write_layout
from trainlog.replay.layout import DRAWN
from trainlog.replay.recording import MOST_WHOLE
from trainlog.replay.samples import CURVES, Samples, thinned
from trainlog.replay.survey import OVERVIEW, extremes, thinned_trips
from trainlog.replay.viewer import HeadlessViewer, has_display, headless_viewer, offline, web_viewer
from trainlog.resampling import time_distance_of
from trainlog.topics import TOPICS
from trainlog.trip import LINE_ATTACHMENT


@pytest.fixture(scope="module")
def trip() -> Trip:
    return made_trip()


@pytest.fixture(scope="module")
def recording(trip: Trip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "one.rrd"
    write_replay([trip], path)
    return path


def curve(path: Path, entity: str, component: str = "Scalars:scalars") -> np.ndarray:
    """Values of a curve without the unknown one that every curve begins with."""
    values = rows(path, entity)[component]
    assert np.isnan(values[0]).all()
    return values[1:]


def test_curves_are_the_samples_in_units_of_the_railway(trip, recording):
    """Braking downwards, a band of one deviation, a line for each axle."""
    state, own, effort = (
        trip[name] for name in ("/train/state", "/estimates/state", "/train/controls")
    )
    speed = curve(recording, "/trips/up/speed/measured")[:, 0]
    assert speed == pytest.approx(state["speed"].to_numpy() * 3.6, abs=1e-12)
    names = ["tractive_effort", "dynamic_braking_effort", "pneumatic_braking_effort"]
    shown = curve(recording, "/trips/up/efforts/measured")
    assert shown == pytest.approx(effort[names].to_numpy() * np.array([1e-3, -1e-3, -1e-3]))
    assert shown[:, 0].max() > 50.0 > 0.0 > shown[:, 1].min()
    middle, variance = (
        curve(recording, "/trips/up/speed/estimated", f"Measurements:{name}")[:, 0]
        for name in ("values", "variances")
    )
    assert middle == pytest.approx(own["speed"].to_numpy() * 3.6)
    assert np.sqrt(variance) == pytest.approx(own["speed_std"].to_numpy() * 3.6)
    frame = trip["/estimates/adhesion"]
    slips = frame[["slip_speed_1", "slip_speed_2"]].to_numpy()
    assert curve(recording, "/trips/up/slip") == pytest.approx(slips * 3.6, abs=1e-12)
    assert static(recording, "/trips/up/slip", "SeriesLines:names") == ["axle 1", "axle 2"]
    used = curve(recording, "/trips/up/adhesion/used")
    assert used == pytest.approx(np.abs(frame[["adhesion_1", "adhesion_2"]].to_numpy()))
    phases = rows(recording, "/trips/up/phase")
    assert list(phases["StateChange:state"]) == [
        "standstill", "traction", "coasting", "braking", "standstill",
    ]  # fmt: skip
    assert (np.diff(phases["time"]) > 0).all()


def test_timelines_tell_when_and_where(trip, recording):
    assert {frozenset(each) for each in entities(recording).values() if each} == {
        frozenset({"time", "elapsed", "position_m"})
    }
    found = rows(recording, "/trips/up/speed/measured")
    frame = trip["/train/state"]
    assert (found["time"][1:] == frame.index.as_unit("ns").asi8).all()
    assert (found["elapsed"] == found["time"] - START).all()
    metres = np.rint(trip["/estimates/state"]["position"].to_numpy())
    assert (found["position_m"][1:] == metres).all()


@settings(max_examples=50)
@given(arrays(np.float64, 30, elements=st.floats(0.0, 1e5)))
def test_a_train_that_only_goes_on_is_where_it_said(position):
    forward = np.sort(position)
    time = START + np.arange(30) * 10**8
    trip = Trip({"/train/state": frame_of(topics.TRAIN_STATE, time, {"position": forward})})
    clock = time_distance_of(trip)
    assert clock.position_at(time) == pytest.approx(forward, abs=1e-9)


def test_unknown_values_and_missing_rows_break_the_line(trip, tmp_path):
    state = trip["/train/state"].copy()
    state.iloc[100:150, state.columns.get_loc("speed")] = np.nan
    kept = trip["/train/state"].drop(state.index[100:150])
    lacking = replace(trip, metadata={**trip.metadata, "trip": "lacking"})
    path = tmp_path / "gap.rrd"
    write_replay([trip.with_topic(state), lacking.with_topic(kept)], path)
    shown = curve(path, "/trips/up/speed/measured")[:, 0]
    assert np.isnan(shown[100:150]).all()
    assert np.isfinite(np.delete(shown, np.s_[100:150])).all()
    shown = curve(path, "/trips/lacking/speed/measured")[:, 0]
    assert shown.size == len(kept) + 1
    assert np.flatnonzero(np.isnan(shown)).tolist() == [100]


@settings(max_examples=100)
@given(arrays(np.float64, 40, elements=st.sampled_from([0.0, 1.0, 2.0, np.nan])))
def test_a_held_value_is_the_same_at_every_instant_after_thinning(values):
    time = np.arange(40, dtype=np.int64)
    kept = thinned(Samples(time, values[:, None]))
    held = kept.ordinates[np.searchsorted(kept.time, time, side="right") - 1, 0]
    np.testing.assert_array_equal(held, values)
    assert kept.time[-1] == time[-1]


def test_places_lie_on_the_line_on_the_globe(trip, tmp_path):
    tiled = tmp_path / "tiles.rrd"
    write_replay([trip], tiled, options=ReplayOptions(tiles=True))
    found = rows(tiled, "/trips/up/place/train")
    latitude, longitude = LINE.geometry.at(time_distance_of(trip).position_at(found["time"]))
    assert found["GeoPoints:positions"] == pytest.approx(
        np.column_stack((latitude, longitude)), abs=1e-8
    )
    fixes = rows(tiled, "/trips/up/place/satellites")["GeoPoints:positions"]
    frame = trip["/gnss/fix"].dropna(subset=["latitude"])
    assert fixes == pytest.approx(frame[["latitude", "longitude"]].to_numpy())


def test_without_tiles_places_are_drawn_to_scale(trip, recording):
    """The line of the example runs east for 2 km; no geographic entity asks for a map."""
    found = rows(recording, "/trips/up/place/train")
    driven = time_distance_of(trip).position_at(found["time"])
    assert found["Points2D:positions"][:, 0] == pytest.approx(driven, abs=2.0)
    assert found["Points2D:positions"][:, 1] == pytest.approx(0.0, abs=0.5)
    chunks = RrdReader(recording).stream().to_chunks()
    names = {name for chunk in chunks for name in chunk.to_record_batch().schema.names}
    assert not {name for name in names if name.startswith("Geo")}
    station = "/lines/hill/stations/B\\ town"
    assert static(recording, station, "Points2D:positions")[0] == pytest.approx([2000, 0], abs=2.0)
    assert static(recording, station, "Points2D:labels") == ["B town"]


def test_a_line_without_coordinates_is_drawn_straight(tmp_path):
    bare = line_to_bytes(replace(LINE, geometry=None))
    both = [
        replace(made_trip(name, direction), attachments={LINE_ATTACHMENT: bare})
        for name, direction in (("up", "forward"), ("down", "reverse"))
    ]
    path = tmp_path / "straight.rrd"
    write_replay(both, path)
    for name, place in (("up", 0.0), ("down", LENGTH)):
        found = rows(path, f"/trips/{name}/place/train")["Points2D:positions"]
        assert abs(found[0, 0] - place) < 5.0
        assert abs(found[-1, 0] - (LENGTH - place)) < 5.0
    ends = static(path, "/lines/hill/track", "LineStrips2D:strips")[0]
    assert np.ptp(np.array(ends)[:, 0]) == pytest.approx(LENGTH, rel=1e-3)


def test_topics_that_are_missing_or_empty_are_left_out(trip, tmp_path):
    bare = replace(trip, topics={"/train/state": trip["/train/state"]}, attachments={})
    for empty in (topics.EVENTS, topics.TRAIN_CONTROLS, topics.GNSS_FIX, topics.TRUTH):
        bare = bare.with_topic(frame_of(empty, np.empty(0, np.int64), {}))
    path = tmp_path / "bare.rrd"
    write_replay([bare], path)
    found = {name for name in entities(path) if name.startswith("/trips")}
    assert found == {
        f"/trips/up/{each}" for each in ("speed/measured", "about", "cursor", "kilometre")
    }


def test_without_a_chainage_receivers_give_the_distance(trip, tmp_path):
    motion = trip["/gnss/motion"]
    covered = np.trapezoid(motion["speed"], (motion.index.asi8 - START) / 1e9)
    assert time_distance_of(Trip({"/gnss/motion": motion})).position[-1] == pytest.approx(covered)
    fixes = time_distance_of(Trip({"/gnss/fix": trip["/gnss/fix"]}))
    assert fixes.position[-1] == pytest.approx(LENGTH, rel=0.01)
    air = frame_of(topics.ENVIRONMENT, START + np.arange(5) * 10**9, {"gradient": np.arange(5.0)})
    write_replay([Trip({"/environment": air})], tmp_path / "air.rrd")
    assert set(rows(tmp_path / "air.rrd", "/trips/unnamed/gradient")["position_m"]) == {0}


def test_the_map_lies_under_a_trip_in_its_own_direction(trip, tmp_path):
    condition, mapped = condition_of(), tmp_path / "map.rrd"
    write_replay([trip, made_trip("down", "reverse")], mapped, condition_map=condition)
    up = rows(mapped, "/trips/up/adhesion/map/dots")
    down = rows(mapped, "/trips/down/adhesion/map/dots")
    seen = np.flatnonzero(condition.layers["dry"].observed)
    assert (up["position_m"] == np.rint(condition.centres[seen])).all()
    assert up["Scalars:scalars"][:, 0] == pytest.approx(
        condition.layers["dry"].maximum_adhesion[seen]
    )
    assert (down["position_m"] == LENGTH - up["position_m"][::-1]).all()
    assert (down["Scalars:scalars"] == up["Scalars:scalars"][::-1]).all()


def test_the_map_of_other_weather_is_not_shown(trip, tmp_path):
    known = {key: value for key, value in trip.metadata.items() if key != "weather"}
    legends = {"dry": ["map, dry"], "wet": None, "snow": None, "": ["map, dry"]}
    trips = [
        replace(trip, metadata=known | {"trip": f"in {name}"} | ({"weather": name} if name else {}))
        for name in legends
    ]
    path = tmp_path / "map.rrd"
    write_replay(trips, path, condition_map=condition_of())
    for name, legend in legends.items():
        dots = f"/trips/in\\ {name}/adhesion/map/dots"
        if legend is None:
            assert dots not in entities(path)
        else:
            assert static(path, dots, "SeriesPoints:names") == legend


def test_a_trip_is_compared_with_what_is_planned_unless_it_followed_or_ran_backwards(
    trip, tmp_path
):
    path, down = tmp_path / "plan.rrd", made_trip("down", "reverse")
    own, back = (without(each, "/reference") for each in (trip, down))
    followed = replace(trip, metadata={**trip.metadata, "trip": "followed"})
    write_replay([own, back, followed], path, trajectory=trajectory_of())
    entity = "/trips/up/speed/trajectory"
    assert [name for name in entities(path) if name.endswith("/speed/trajectory")] == [entity]
    middle = curve(path, entity, "Measurements:values")[:, 0]
    position = time_distance_of(trip).position_at(rows(path, entity)["time"][1:])
    planned = [trajectory_of().speed_at(row, position) for row in (0, 1)]
    assert middle == pytest.approx(np.mean(planned, axis=0) * 3.6, abs=1e-3)
    assert middle[0] == 0.0
    assert middle.max() > 70.0


def test_the_same_trips_give_the_same_content(trip, recording, tmp_path):
    write_replay([trip], tmp_path / "again.rrd")
    paths = recording, tmp_path / "again.rrd"
    one, other = (RrdReader(path).recordings()[0] for path in paths)
    assert one.recording_id == other.recording_id
    assert one.application_id == "trainlog"
    assert _drawn(paths[0]) == _drawn(paths[1])


def test_what_cannot_be_replayed_is_refused_and_leaves_what_there_was(trip, tmp_path):
    older = tmp_path / "replay.rrd"
    older.write_bytes(b"older")
    dale = {"condition_map": replace(condition_of(), line="dale")}
    shorter = {"condition_map": replace(condition_of(), length=LENGTH - 5.0)}
    for trips, name, error, said, options in (
        ([trip], "replay.mcap", InputError, "end it in .rrd", {}),
        ([trip], "no/such/folder.rrd", InputError, "create its folder first", {}),
        ([], "replay.rrd", InputError, "no trip", {}),
        ([trip, Trip({})], "replay.rrd", LogError, "no samples", {}),
        ([trip], "replay.rrd", InputError, r"of line 'dale', .*not of 'hill'", dale),
        ([trip], "replay.rrd", InputError, "1995 m, not of 'hill', 2000 m", shorter),
    ):
        refused(error, said, write_replay, trips, tmp_path / name, **options)
        assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"older"]


def test_pieces_are_drawn_as_the_whole(trip, tmp_path):
    """Of a held value, samples beside the seams may be more, none of them other."""
    whole, parts = tmp_path / "whole.rrd", tmp_path / "parts.rrd"
    write_replay([trip], whole)
    edges = pd.date_range(trip.start, trip.end, periods=6).as_unit("ns").asi8
    edges[0], edges[-1] = 0, 2**62
    spans = np.column_stack((edges[:-1], edges[1:] - 1))
    write_replay([lambda: (trip.cut(span[None, :]) for span in spans)], parts)
    one, other = _drawn(whole), _drawn(parts)
    held = {curve.entity for curve in CURVES if curve.held}
    assert one.keys() == other.keys()
    for key, values in one.items():
        assert values.items() <= other[key].items(), key
        if key.removeprefix("/trips/up/") not in held:
            assert len(values) == len(other[key]), key


def _drawn(path: Path) -> dict[str, dict[str, int]]:
    """How often each row of each entity is in a recording, and what it says."""
    drawn: dict[str, dict[str, int]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        for row in chunk.to_record_batch().to_pylist():
            said = {n: value for n, value in row.items() if not re.search("RowId|row_id", n)}
            found = drawn.setdefault(chunk.entity_path, {})
            found[repr(said)] = found.get(repr(said), 0) + 1
    return drawn


@pytest.fixture(scope="module")
def spotted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map with three spots: there while it was met, gone, and likely there; and a forecast."""
    condition = condition_of()
    day = int(made_trip().start.timestamp() // 86_400)
    spots = (
        PassingSpot(300.0, 350.0, 0.07, 0.06, 0.08, day - 3, day + 1, day + 5, 0.0, 1.0),
        PassingSpot(600.0, 650.0, 0.07, 0.06, 0.08, day - 40, day - 30, day - 30, 0.9, 2.0),
        PassingSpot(1_500.0, 1_600.0, 0.09, 0.08, 0.1, day - 2, day - 1, day - 1, 0.8, 5.0),
    )

    class Layer(ConditionLayer):
        def expected(self, time: pd.Timestamp | None = None) -> AdhesionEstimate:
            assert time == pd.Timestamp(made_trip().start)
            return AdhesionEstimate(self.log_mean + np.log(0.8), self.log_std, self.observed)

    dry = condition.layers["dry"]
    layer = Layer(dry.log_mean, dry.log_std, dry.observed, evidence=dry.evidence, spots=spots)
    path, options = tmp_path_factory.mktemp("spots") / "map.rrd", ReplayOptions(tiles=True)
    both = [made_trip(), made_trip("down", "reverse")]
    track = replace(condition, layers={"dry": layer})
    write_replay(both, path, condition_map=track, options=options)
    return path


def test_the_expected_condition_lies_beside_the_lasting_one(spotted):
    path = spotted
    for trip in ("up", "down"):
        lasting = rows(path, f"/trips/{trip}/adhesion/map/dots")
        expected = rows(path, f"/trips/{trip}/adhesion/expected/dots")
        assert (expected["position_m"] == lasting["position_m"]).all()
        assert expected["Scalars:scalars"] == pytest.approx(0.8 * lasting["Scalars:scalars"])
    band = rows(path, "/trips/up/adhesion/expected/bins")
    value, variance = band["Measurements:values"][:, 0], band["Measurements:variances"][:, 0]
    shown = ~np.isnan(value)
    assert np.sqrt(variance[shown]) / value[shown] == pytest.approx(np.sinh(0.05), rel=1e-5)
    legend = static(path, "/trips/up/adhesion/expected/dots", "SeriesPoints:names")
    assert legend == ["expected, dry"]
    assert "/lines/hill/maximum_adhesion/dry/expected/dots" in entities(path)


def test_spots_that_lay_there_are_shown_under_the_trip_and_on_the_map(spotted):
    path = spotted
    up = rows(path, "/trips/up/adhesion/spots/dots")
    assert up["position_m"].tolist() == [325, 1_550]
    assert up["Scalars:scalars"][:, 0].tolist() == [0.07, 0.09]
    down = rows(path, "/trips/down/adhesion/spots/dots")
    assert down["position_m"].tolist() == [LENGTH - 1_550.0, LENGTH - 325.0]
    named = sorted(each.rsplit("/", 1)[1] for each in entities(path) if "/up/place/spots/" in each)
    assert len(named) == 2
    assert named[0].startswith("km\\ 0.300")
    assert "100" in named[0]
    places = [
        static(path, next(each for each in entities(path) if f"/{trip}/place/spots/km\\ 0" in each),
               "GeoLineStrings:line_strings")
        for trip in ("up", "down")
    ]  # fmt: skip
    assert np.allclose(places[0], places[1])


def unlike(name: str, top: float) -> Trip:
    """A trip of another speed that follows no reference."""
    return without(made_trip(name, top=top), "/reference")


def test_a_trip_is_behind_another_by_the_difference_of_their_passing_times(tmp_path):
    fast, slow = unlike("fast", 25.0), unlike("slow", 16.0)
    path = tmp_path / "both.rrd"
    made = write_replay([fast, slow], path)
    assert made.references == ("fast",)
    found = rows(path, "/trips/slow/behind/time")
    behind, place = found["Scalars:scalars"][1:, 0], found["position_m"][1:].astype(float)
    passed = []  # when each trip passed the places [s], from its samples as they are
    for state in (trip["/train/state"] for trip in (slow, fast)):
        position, time = state["position"].to_numpy(), state.index.as_unit("ns").asi8
        moving = np.concatenate(([True], np.diff(position) > 0.0))
        passed.append(np.interp(place, position[moving], (time[moving] - time[0]) / 1e9))
    expected = passed[0] - passed[1]
    inside = (place > 50.0) & (place < LENGTH - 50.0)
    assert inside.sum() > 150
    assert behind[inside] == pytest.approx((expected - expected[0])[inside], abs=0.15)
    assert behind[-1] > 30.0
    slower = rows(path, "/trips/slow/behind/speed")["Scalars:scalars"][1:, 0]
    assert slower[place == 1000.0] == pytest.approx(-9.0 * 3.6, abs=0.01)
    assert not [name for name in entities(path) if name.startswith("/trips/fast/behind")]


def test_the_reference_is_the_trip_that_is_chosen(tmp_path):
    trips = [unlike("a", 25.0), unlike("b", 16.0), made_trip("c", "reverse"), unlike("d", 20.0)]
    path = tmp_path / "four.rrd"
    made = write_replay(trips, path, options=ReplayOptions(reference=1))
    assert made.references == ("b",)  # the one in reverse has nothing to be compared with
    compared = {name.split("/")[2] for name in entities(path) if name.endswith("/behind/time")}
    assert compared == {"a", "d"}
    assert (rows(path, "/trips/a/behind/time")["Scalars:scalars"][-1] < 0.0).all()
    refused(InputError, "no trip 5", write_replay, trips, path, options=ReplayOptions(reference=4))


def test_a_trajectory_is_a_band_and_the_reference_of_trips_in_its_direction(tmp_path):
    path, plan = tmp_path / "plan.rrd", trajectory_of()
    trip = unlike("up", 20.0)
    made = write_replay([trip, made_trip("down", "reverse")], path, trajectory=plan)
    named = f"the trajectory (configuration {plan.configurations[plan.latest].name})"
    assert made.references == (named,)
    found = rows(path, "/trips/up/behind/speed")
    place = found["position_m"][1:].astype(float)
    middle = np.isin(place, (600.0, 1000.0, 1400.0))
    planned = plan.speed_at(plan.latest, place[middle])
    shown = found["Scalars:scalars"][1:, 0]
    assert shown[middle] == pytest.approx(3.6 * (20.0 - planned), abs=0.02)
    assert "/trips/down/behind/time" not in entities(path)
    # From the slowest to the fastest configuration.
    centre = curve(path, "/trajectory/speed", "Measurements:values")[:, 0]
    half = np.sqrt(curve(path, "/trajectory/speed", "Measurements:variances")[:, 0])
    assert centre + half == pytest.approx(plan.speeds.max(axis=0) * 3.6)
    assert centre - half == pytest.approx(plan.speeds.min(axis=0) * 3.6, abs=1e-9)
    found = rows(path, "/trajectory/speed")
    assert (found["position_m"][1:] == np.rint(plan.positions)).all()
    assert found["elapsed"][1:] / 1e9 == pytest.approx(plan.times.mean(axis=0))


@settings(max_examples=100)
@given(
    arrays(np.float64, 60, elements=st.floats(-1e3, 1e3) | st.just(np.nan)),
    arrays(np.int64, 60, elements=st.integers(0, 2)),
)
def test_thinning_keeps_the_least_and_the_greatest_of_each_piece(values, steps):
    piece = np.cumsum(steps)
    kept = extremes(values, piece)
    assert (np.diff(kept) > 0).all()
    for number in np.unique(piece):
        whole, left = values[piece == number], values[kept][piece[kept] == number]
        assert 1 <= left.size <= 3
        assert np.isnan(whole).any() == np.isnan(left).any()
        if np.isfinite(whole).any():
            assert np.nanmin(left) == np.nanmin(whole)
            assert np.nanmax(left) == np.nanmax(whole)


def test_a_thinned_trip_is_where_it_was(tmp_path):
    trip = made_trip()
    ((known, _),) = thinned_trips([lambda: [trip]])
    whole = time_distance_of(trip)
    assert known.clock.time.size < whole.time.size
    away = np.abs(known.clock.position_at(whole.time) - whole.position)
    assert away.max() < 10.0
    path = tmp_path / "thin.rrd"
    write_replay([trip, unlike("b", 16.0)], path, options=ReplayOptions(thinned=True))
    full = tmp_path / "full.rrd"
    write_replay([trip, unlike("b", 16.0)], full)
    behind = [rows(each, "/trips/b/behind/time")["Scalars:scalars"] for each in (path, full)]
    np.testing.assert_array_equal(*behind)
    received = {name: trip[name] for name in ("/gnss/motion", "/gnss/fix")}
    alone = replace(trip, topics=received, attachments={})
    write_replay([alone], path, options=ReplayOptions(thinned=True))
    assert {"/trips/up/speed/satellites", "/trips/up/place/path"} <= set(entities(path))


def test_of_a_thinned_trip_only_the_overview_is_read(tmp_path):
    log, asked = tmp_path / "up.mcap", []
    write_log(made_trip(), log)

    def source(topics: object = None) -> object:
        asked.append(topics)
        return stream_log(log, topics)

    path = tmp_path / "many.rrd"
    made = write_replay([source] * (MOST_WHOLE + 1), path)
    assert made.thinned
    assert asked == [OVERVIEW] * (MOST_WHOLE + 1)
    assert made.trips[:2] == ("up", "up (2)")
    found = entities(path)
    assert not [name for name in found if "/efforts" in name or "/slip" in name]
    assert {"/trips/up/cursor", "/trips/up/section"} <= set(found)
    assert "/trips/up\\ \\(2\\)/cursor" not in found


def test_a_line_can_be_given_to_a_trip_that_was_on_it(tmp_path):
    path, whole = tmp_path / "line.rrd", made_trip()
    kept = {name: whole[name] for name in ("/train/state", "/gnss/fix")}
    trip = replace(whole, topics=kept, attachments={})
    geometry = replace(LINE.geometry, latitudes=LINE.geometry.latitudes + 0.1)
    short = replace(LINE, length=1500.0, stations=LINE.stations[:1], geometry=None)
    fixes = replace(trip, topics={"/gnss/fix": trip["/gnss/fix"]})
    for one, line, said in (
        (trip, replace(LINE, geometry=geometry), r"'up' was 11\.1 km away .* ingest its recording"),
        (trip, short, "beyond the end.*ingest its recording with --line"),
        (fixes, LINE, "no chainage"),
    ):
        refused(InputError, said, write_replay, [one], path, options=ReplayOptions(line=line))
    assert not list(tmp_path.iterdir())
    write_replay([trip], path, options=ReplayOptions(line=LINE))
    assert {"/trips/up/speed/limit", "/lines/hill/stations/A"} <= set(entities(path))


def test_the_command_states_with_what_trips_are_compared(tmp_path, works):
    for name, top in (("a", 25.0), ("b", 16.0)):
        write_log(unlike(name, top), tmp_path / f"{name}.mcap")
    one, other, target = (tmp_path / each for each in ("a.mcap", "b.mcap", "ab.rrd"))
    stated = works("replay", one, "--reference", other, "-o", target)
    assert "compared along the line with b" in stated
    assert f"wrote {target}" in stated
    assert "/trips/a/behind/time" in entities(target)


def layout_of(path: Path) -> tuple[dict[str, dict[str, Any]], list[dict[str, Any]]]:
    """What the blueprint of a recording says of each entity, and of each view."""
    reader = RrdReader(path)
    (stored,) = reader.blueprints()
    assert stored.application_id == reader.recordings()[0].application_id == "trainlog"
    logged: dict[str, dict[str, Any]] = {}
    for chunk in reader.stream(store=stored).to_chunks():
        batch = chunk.to_record_batch()
        kept = logged.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            if ":" in name:
                kept[name] = batch[name][len(batch) - 1].as_py()
    return logged, [
        {"path": path, **components, **logged[f"{path}/ViewContents"]}
        for path, components in logged.items()
        if re.fullmatch(r"/view/[0-9a-f-]{36}", path)
        and "ViewBlueprint:class_identifier" in components
    ]


def matches(query: str, found: set[str]) -> bool:
    stem = query.removesuffix("/**")
    return any(name == stem or (stem != query and name.startswith(f"{stem}/")) for name in found)


@pytest.mark.parametrize(("count", "beside"), [(1, False), (3, True)])
def test_every_view_has_something_to_show_and_everything_recorded_is_shown(tmp_path, count, beside):
    path = tmp_path / "replay.rrd"
    trips = [made_trip(), made_trip("down", "reverse"), made_trip("up again")]
    given = {"trajectory": trajectory_of(), "condition_map": condition_of()} if beside else {}
    write_replay(trips[:count], path, **given)
    (logged, views), found = layout_of(path), set(entities(path))
    queries = {
        query.lstrip(" +").rstrip().replace("$origin", view["ViewBlueprint:space_origin"][0])
        for view in views
        for line in view["ViewContents:query"]
        for query in line.splitlines()
    }
    assert queries
    assert [query for query in queries if not matches(query, found)] == []
    assert [name for name in found if not any(matches(q, {name}) for q in queries)] == []
    kind = "ContainerBlueprint:container_kind"
    tabs = [each for each in logged.values() if each.get(kind) == [1]]
    assert tabs
    assert all(len(each["ContainerBlueprint:contents"]) > 1 for each in tabs), "none alone"
    titles = {
        value[0]
        for components in logged.values()
        for name, value in components.items()
        if name.endswith(":display_name")
    }
    # Several trips have a tab each, and views over all.
    for several in ("up", "Speed forward [km/h]", "Lateness against "):
        others = titles - {"up: speed [km/h]"}
        assert any(title.startswith(several) for title in others) == (count > 1)
    # Without tiles no map asks for them.
    kinds = {view["ViewBlueprint:class_identifier"][0]: view["path"] for view in views}
    assert "Map" not in kinds
    bounds = logged[f"{kinds['2D']}/VisualBounds2D"]["VisualBounds2D:range"][0]
    (left, right), (top, bottom) = bounds["x_range"], bounds["y_range"]
    assert left < 0.0 < 2000.0 < right < 3000.0
    assert top < 0.0 < bottom


def test_views_without_what_they_are_about_are_refused(tmp_path):
    trip, path = made_trip(), tmp_path / "replay.rrd"
    bare = replace(trip, topics={"/train/state": trip["/train/state"]}, attachments={})
    for view, said in (
        ("traction", r"nothing for the view 'traction'.*overview, driving"),
        ("tractoin", r"no view 'tractoin'.*overview, driving, traction"),
    ):
        refused(InputError, said, write_replay, [bare], path, options=ReplayOptions(view=view))
    assert not list(tmp_path.iterdir())


SETTLE, SIZE = 2.5, (900, 750)
ENOUGH = 100
"""Pixels that are drawn in a panel in which anything is drawn."""
NO_GRAPHICS = "No graphics adapter", "Failed to get render context"


@pytest.fixture(scope="module")
def drawn() -> Trip:
    """A trip with every topic whose fields are drawn."""
    found = made_trip()
    time = found["/train/state"].index
    for topic in DRAWN:
        if topic.name not in found:
            values = {field.name: np.arange(len(time)) + 0.5 for field in topic.fields}
            found = found.with_topic(frame_of(topic, time, values))
    return found


@pytest.fixture(scope="module")
def viewed(drawn: Trip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("viewer") / "replay.rrd"
    write_replay([drawn], path, trajectory=trajectory_of(), condition_map=condition_of())
    return path


@pytest.fixture(scope="module")
def log(drawn: Trip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "hill-up.mcap"
    write_log(drawn, path)
    return path


@pytest.mark.parametrize(
    ("platform", "variables", "display"),
    [
        ("linux", {"DISPLAY": ":0"}, True),
        ("linux", {"WAYLAND_DISPLAY": "wayland-0"}, True),
        ("linux", {}, False),
        ("linux", {"DISPLAY": ""}, False),
        ("linux", {"DISPLAY": "localhost:10.0", "SSH_CONNECTION": "a b c d"}, True),
        ("darwin", {}, True),
        ("darwin", {"SSH_CONNECTION": "a b c d"}, False),
        ("win32", {}, True),
        ("linux", {"DISPLAY": ":0", "CI": "true"}, False),
    ],
)
def test_where_a_window_can_be_opened(platform, variables, display):
    assert has_display(variables, platform) is display


@pytest.mark.parametrize("display", [True, False])
def test_the_viewer_listens_on_this_machine_alone_and_sends_no_usage_data(
    display, viewed, tmp_path, monkeypatch
):
    """Without a display it states how to open the file, or what else there is."""
    calls: list[tuple[Any, Any]] = []
    monkeypatch.setattr(viewer, "has_display", lambda: display)
    monkeypatch.setattr(
        viewer.subprocess, "run", lambda command, **options: calls.append((command, options))
    )
    stated = open_viewer(viewed)
    assert str(viewed) in stated
    if not display:
        assert calls == []
        assert "rerun replay.rrd" in stated
        refused(InputError, r"no display .*--web.*-o out.png.*-o", run_viewer, viewed)
        return
    ((command, options),) = calls
    assert command[:3] == [sys.executable, "-m", "rerun_cli"]
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert str(viewed) in command
    assert options["env"]["CI"]
    for call in (open_viewer, lambda path: take_picture(path, tmp_path / "none.png")):
        refused(InputError, "does not exist", call, tmp_path / "none.rrd")


@pytest.fixture(scope="module")
def shown(viewed: Path) -> Iterator[HeadlessViewer]:
    """One viewer for the pictures of all views; skips where nothing can be drawn."""
    try:
        with headless_viewer(viewed, size=SIZE, settle=SETTLE) as viewer:
            yield viewer
    except InputError as error:
        if not any(words in str(error) for words in NO_GRAPHICS):
            raise
        pytest.skip(str(error))


VIEWS = ["overview", "driving", "traction", "identification", "map", "recorder"]


@pytest.mark.long
def test_every_view_is_drawn(shown, tmp_path):
    for view in shown.views():
        shown.show(view)
        for _ in range(10):  # a busy machine may need longer
            shown.picture(tmp_path / "view.png")
            with Image.open(tmp_path / "view.png") as picture:
                pixels = np.asarray(picture.convert("RGB"), dtype=int)
            found = (np.ptp(pixels, axis=2) > 40).sum()  # axes, grids and text are grey
            if found > ENOUGH:
                break
            time.sleep(0.5)
        assert found > ENOUGH, view


def test_a_picture_of_a_view_is_taken_whole_or_not_at_all(shown, tmp_path):
    assert shown.views() == VIEWS
    shown.show("driving")
    shown.picture(tmp_path / "driving.png")
    with Image.open(tmp_path / "driving.png") as picture:
        assert picture.size == SIZE
        pixels = np.asarray(picture.convert("RGB"), dtype=int)
    # The colours of the limit, the wheels' speed, traction, and the reference.
    for colour in ((235, 90, 90), (90, 180, 240), (90, 205, 120), (190, 140, 255)):
        near = np.abs(pixels - colour).sum(axis=2) < 40
        assert near.sum() > 50, colour
    refused(InputError, r"no view 'mileage'.*overview, driving", shown.show, "mileage")
    refused(InputError, r"no timeline 'mileage'.*position_m", shown.set_time, "mileage", 0)
    assert [path.name for path in tmp_path.iterdir()] == ["driving.png"]


def test_rerun_takes_the_fields_out_of_a_log(drawn, log):
    for topic in DRAWN:
        frame = drawn[topic.name]
        for field in topic.fields:
            names = [n for n in frame if re.fullmatch(rf"{field.name}(_\d+)?", n)]
            chunks = scalars(log, topic.name, field.name).to_chunks()
            assert {chunk.entity_path for chunk in chunks} == {f"{topic.name}/{field.name}"}
            records = [chunk.to_record_batch()["Scalars:scalars"].flatten() for chunk in chunks]
            values = np.concatenate([each.to_numpy(zero_copy_only=False) for each in records])
            np.testing.assert_array_equal(values, frame[names].to_numpy().ravel())
    for name, other in (("/train/state", "mood"), ("/events", "message"), ("/no", "speed")):
        refused(InputError, f"no field {other} of topic {name}", scalars, log, name, other)


@pytest.mark.usefixtures("shown")
def test_a_log_opens_as_it_is_with_its_layout(log, tmp_path):
    layout = tmp_path / "hill-up.rbl"
    write_layout(layout, log.stem)
    for settle in (0.5, SETTLE, 6 * SETTLE):  # a busy machine may need longer
        names = set(take_picture(log, tmp_path / "log.png", layout=layout, settle=settle))
        if len(names) > 1:
            break
    assert {"speed [m/s]", "position [m]", "Satellite fix", "Events"} <= names


def test_the_layout_names_every_field_of_the_log(tmp_path):
    path = tmp_path / "trainlog.rbl"
    write_layout(path, "trainlog")
    content = path.read_bytes()
    assert content[:4] == b"RRF2"
    refused(InputError, r"end it in \.rbl", write_layout, tmp_path / "trainlog.txt", "trainlog")
    assert {topic.name for topic in DRAWN} == set(TOPICS) - {"/gnss/fix", "/events"}


direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def listening(port: int) -> set[str]:
    """Addresses of this machine at which anyone listens on a port."""
    every = (each for each in psutil.net_connections("tcp") if each.status == psutil.CONN_LISTEN)
    return {each.laddr.ip for each in every if each.laddr.port == port}


def test_the_viewer_is_given_no_way_to_the_network():
    made = offline({"HTTPS_PROXY": "http://proxy.example", "HOME": "/home/me"})
    assert {made[name] for name in ("https_proxy", "HTTPS_PROXY", "http_proxy")} == {viewer.NOWHERE}
    assert "127.0.0.1" in made["no_proxy"]
    assert made["CI"] == "true"
    assert made["HOME"] == "/home/me"
    assert offline({"HTTPS_PROXY": "p"}, tiles=True) == {"HTTPS_PROXY": "p", "CI": "true"}


def test_a_page_in_the_browser_reaches_this_machine_alone(viewed):
    with web_viewer(viewed) as (address, process):
        with direct.open(address) as answer:
            policy = answer.headers["Content-Security-Policy"]
            page = answer.read()
        assert b"re_viewer" in page
        assert re.search(r"connect-src 'self' blob: data: http://127\.0\.0\.1:\d+$", policy)
        assert set(re.findall(r"https?://([^:/\s]+)", policy)) == {"127.0.0.1"}
        with direct.open(address.partition("?")[0] + "re_viewer.js") as answer:
            assert len(answer.read()) > 10_000
        with pytest.raises(urllib.error.HTTPError, match="404"):
            direct.open(address.partition("?")[0] + "etc/passwd").close()
        data = int(re.search(r"http://127\.0\.0\.1:(\d+)$", policy)[1])
        own = int(re.search(r"127\.0\.0\.1:(\d+)/", address)[1])
        if sys.platform == "linux":  # elsewhere the superuser alone may ask
            assert listening(data) == listening(own) == {"127.0.0.1"}
    assert process.poll() is not None


def test_ctrl_c_ends_the_viewer_and_leaves_nothing(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-m", "trainlog", "replay", str(sample("nonstop.mcap")), "--web"],
        env={**os.environ, "DISPLAY": "", "WAYLAND_DISPLAY": "", "TMPDIR": str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        line = process.stdout.readline()
        assert line.startswith("http://127.0.0.1:")
        assert viewers_of(tmp_path)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0
    assert viewers_of(tmp_path) == []
    assert not list(tmp_path.iterdir())


def viewers_of(folder: Path) -> list[psutil.Process]:
    """Processes whose command names a file of a folder."""
    every = psutil.process_iter(["cmdline"])
    return [each for each in every if str(folder) in " ".join(each.info["cmdline"] or ())]

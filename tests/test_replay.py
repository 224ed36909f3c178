"""What a replay holds, read back from the recording and compared with the trips."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
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
from trainlog.railway.condition import AdhesionEstimate, ConditionLayer, PassingSpot
from trainlog.replay.samples import CURVES, Samples, clock_of, thinned
from trainlog.trip import LINE_ATTACHMENT


@pytest.fixture(scope="module")
def trip() -> Trip:
    return made_trip()


@pytest.fixture(scope="module")
def recording(trip: Trip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "one.rrd"
    write_replay([trip], path)
    return path


@pytest.fixture(scope="module")
def tiled(trip: Trip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With places on the globe."""
    path = tmp_path_factory.mktemp("replay") / "tiles.rrd"
    write_replay([trip], path, options=ReplayOptions(tiles=True))
    return path


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trip each way over the map."""
    path = tmp_path_factory.mktemp("replay") / "map.rrd"
    both = [made_trip(), made_trip("down", "reverse")]
    write_replay(both, path, condition_map=condition_of())
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
    clock = clock_of(trip)
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


def test_places_lie_on_the_line(trip, tiled):
    found = rows(tiled, "/trips/up/place/train")
    latitude, longitude = LINE.geometry.at(clock_of(trip).position_at(found["time"]))
    assert found["GeoPoints:positions"] == pytest.approx(
        np.column_stack((latitude, longitude)), abs=1e-8
    )
    fixes = rows(tiled, "/trips/up/place/satellites")["GeoPoints:positions"]
    frame = trip["/gnss/fix"].dropna(subset=["latitude"])
    assert fixes == pytest.approx(frame[["latitude", "longitude"]].to_numpy())


def test_without_tiles_places_are_drawn_to_scale(trip, recording):
    """The line of the example runs east for 2 km; no geographic entity asks for a map."""
    found = rows(recording, "/trips/up/place/train")
    driven = clock_of(trip).position_at(found["time"])
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
    assert clock_of(Trip({"/gnss/motion": motion})).position[-1] == pytest.approx(covered)
    fixes = clock_of(Trip({"/gnss/fix": trip["/gnss/fix"]}))
    assert fixes.position[-1] == pytest.approx(LENGTH, rel=0.01)
    air = frame_of(topics.ENVIRONMENT, START + np.arange(5) * 10**9, {"gradient": np.arange(5.0)})
    write_replay([Trip({"/environment": air})], tmp_path / "air.rrd")
    assert set(rows(tmp_path / "air.rrd", "/trips/unnamed/gradient")["position_m"]) == {0}


def test_the_map_lies_under_a_trip_in_its_own_direction(mapped):
    condition = condition_of()
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


def test_a_trajectory_is_a_band_from_slowest_to_fastest(tmp_path):
    plan = trajectory_of()
    path = tmp_path / "plan.rrd"
    write_replay([made_trip(), made_trip("again")], path, trajectory=plan)
    middle = curve(path, "/trajectory/speed", "Measurements:values")[:, 0]
    half = np.sqrt(curve(path, "/trajectory/speed", "Measurements:variances")[:, 0])
    assert middle + half == pytest.approx(plan.speeds.max(axis=0) * 3.6)
    assert middle - half == pytest.approx(plan.speeds.min(axis=0) * 3.6, abs=1e-9)
    found = rows(path, "/trajectory/speed")
    assert (found["position_m"][1:] == np.rint(plan.positions)).all()
    assert found["elapsed"][1:] / 1e9 == pytest.approx(plan.times.mean(axis=0))


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
    position = clock_of(trip).position_at(rows(path, entity)["time"][1:])
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
            said = {
                name: value
                for name, value in row.items()
                if "RowId" not in name and "row_id" not in name
            }
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
    both, track = (
        [made_trip(), made_trip("down", "reverse")],
        replace(condition, layers={"dry": layer}),
    )
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

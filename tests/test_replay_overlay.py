"""Trips over each other by position: differences, references, thinning, and what a line adds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from refusals import refused
from replay_trips import LENGTH, LINE, entities, made_trip, rows, trajectory_of
from trip_parts import without

from trainlog import InputError, ReplayOptions, Trip, write_replay
from trainlog.mcap import stream_log, write_log
from trainlog.replay.recording import MOST_WHOLE
from trainlog.replay.samples import clock_of
from trainlog.replay.survey import OVERVIEW, extremes, thinned_trips


def unlike(name: str, top: float) -> Trip:
    """A trip of another speed that follows no reference."""
    return without(made_trip(name, top=top), "/reference")


def reached(trip: Trip, position: np.ndarray) -> np.ndarray:
    """When a trip of the example passed positions [s], from its samples as they are."""
    state = trip["/train/state"]
    seconds = (state.index.as_unit("ns").asi8 - state.index.as_unit("ns").asi8[0]) / 1e9
    moving = np.concatenate(([True], np.diff(state["position"].to_numpy()) > 0.0))
    return np.interp(position, state["position"].to_numpy()[moving], seconds[moving])


def test_a_trip_is_behind_another_by_the_difference_of_their_passing_times(tmp_path):
    fast, slow = unlike("fast", 25.0), unlike("slow", 16.0)
    path = tmp_path / "both.rrd"
    made = write_replay([fast, slow], path)
    assert made.references == ("fast",)
    found = rows(path, "/trips/slow/behind/time")
    behind, place = found["Scalars:scalars"][1:, 0], found["position_m"][1:].astype(float)
    expected = reached(slow, place) - reached(fast, place)
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


def test_a_trajectory_is_the_reference_of_trips_in_its_direction(tmp_path):
    path, plan = tmp_path / "plan.rrd", trajectory_of()
    trip = unlike("up", 20.0)
    made = write_replay([trip, made_trip("down", "reverse")], path, trajectory=plan)
    assert made.references == (
        f"the trajectory (configuration {plan.configurations[plan.latest].name})",
    )
    found = rows(path, "/trips/up/behind/speed")
    place = found["position_m"][1:].astype(float)
    middle = np.isin(place, (600.0, 1000.0, 1400.0))
    planned = plan.speed_at(plan.latest, place[middle])
    assert found["Scalars:scalars"][1:, 0][middle] == pytest.approx(
        3.6 * (20.0 - planned), abs=0.02
    )
    assert "/trips/down/behind/time" not in entities(path)


# ------------------------------------------------------------------------------------- thinning


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
    whole = clock_of(trip)
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


# ------------------------------------------------------------------------- what the line adds


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


# --------------------------------------------------------------------------------- the command


def test_the_command_states_with_what_trips_are_compared(tmp_path, works):
    for name, top in (("a", 25.0), ("b", 16.0)):
        write_log(unlike(name, top), tmp_path / f"{name}.mcap")
    one, other, target = (tmp_path / each for each in ("a.mcap", "b.mcap", "ab.rrd"))
    stated = works("replay", one, "--reference", other, "-o", target)
    assert "compared along the line with b" in stated
    assert f"wrote {target}" in stated
    assert "/trips/a/behind/time" in entities(target)

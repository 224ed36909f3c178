"""Quantities of a recorder's own: kept with unit and meaning, and used like any other topic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from ingest_logs import plain_profile, write
from refusals import refused
from rerun.chunk import RrdReader

import trainlog
from trainlog.errors import InputError, LogError, TrainlogError
from trainlog.ingest import ingest, report_of
from trainlog.mcap.convert import convert
from trainlog.topics import RECORDED, Field, recorded_topic
from trainlog.trip import Trip, frame_of

START = 1_700_000_000 * 10**9
PANTOGRAPH = recorded_topic(
    "/recorded/pantograph",
    [Field("contact_force", "N", "of the strip"), Field("raised", "1", "whether up", "previous")],
)
WORDS = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)


def made(rows: int = 40) -> Trip:
    time = START + np.arange(rows) * 10**9
    driven = {"position": 20.0 * np.arange(rows), "speed": np.full(rows, 20.0)}
    state = frame_of(trainlog.topics.TRAIN_STATE, time, driven)
    pressed = {"contact_force": 70.0 + np.arange(rows), "raised": 1.0 * (np.arange(rows) > 8)}
    own = frame_of(PANTOGRAPH, time, pressed)
    return Trip({"/train/state": state, PANTOGRAPH.name: own}, {"trip": "own"})


@given(
    st.dictionaries(
        st.lists(WORDS, min_size=1, max_size=2).map(lambda words: RECORDED + "/".join(words)),
        st.dictionaries(
            WORDS, st.tuples(st.sampled_from(["Pa", "1", "V", "m^2/s"]), st.text(max_size=9))
        ).filter(bool),
        min_size=1,
        max_size=3,
    ),
    st.integers(0, 5),
)
@settings(max_examples=15)
def test_whatever_a_recorder_has_reads_back_as_it_was(tmp_path_factory, described, rows):
    time = START + np.arange(rows) * 10**8
    topics = [
        recorded_topic(name, [Field(field, *each) for field, each in fields.items()])
        for name, fields in described.items()
    ]
    frames = {}
    for topic in sorted(topics, key=lambda each: each.name):
        data = {field.name: np.arange(rows) / 7.0 for field in topic.fields}
        frames[topic.name] = frame_of(topic, time, data)
    trip = Trip(frames, {"trip": "any"})
    folder = tmp_path_factory.mktemp("own")
    trainlog.write(trip, folder / "a.mcap")
    trainlog.write_parquet(trip, folder / "a.parquet")
    for back in (trainlog.read(folder / "a.mcap"), trainlog.read_parquet(folder / "a.parquet")):
        assert list(back) == list(trip)
        for name, frame in frames.items():
            assert back[name].equals(frame)
            assert back[name].attrs == frame.attrs


def test_cut_converted_recovered_and_streamed_it_stays(tmp_path):
    trip = made()
    trainlog.write(trip, tmp_path / "whole.mcap")
    part = trainlog.read(tmp_path / "whole.mcap", position=(200.0, 400.0))
    assert part[PANTOGRAPH.name]["contact_force"].tolist() == [80.0 + k for k in range(11)]
    alone = trainlog.read(tmp_path / "whole.mcap", {PANTOGRAPH.name: ["raised"]})
    assert list(alone[PANTOGRAPH.name]) == ["raised"]
    convert(tmp_path / "whole.mcap", tmp_path / "whole.parquet")
    convert(tmp_path / "whole.parquet", tmp_path / "again.mcap")
    assert (
        trainlog.read(tmp_path / "again.mcap")[PANTOGRAPH.name].attrs == part[PANTOGRAPH.name].attrs
    )
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "whole.mcap").read_bytes()[:-400])
    trainlog.recover(tmp_path / "cut.mcap", tmp_path / "recovered.mcap")
    for name in ("again.mcap", "recovered.mcap"):
        found = trainlog.read(tmp_path / name)[PANTOGRAPH.name]
        assert found.equals(trip[PANTOGRAPH.name])
    pieces = list(trainlog.stream(tmp_path / "whole.mcap", rows=16))
    assert sum(len(piece[PANTOGRAPH.name]) for piece in pieces) == 40


def test_the_replay_draws_a_plot_a_unit(tmp_path):
    trainlog.write_replay([made()], tmp_path / "own.rrd")
    store = RrdReader(tmp_path / "own.rrd").stream().collect()
    entities = {str(chunk.entity_path) for chunk in store.stream().to_chunks()}
    assert "/trips/own/recorded_1/pantograph/contact_force" in entities
    assert "/trips/own/recorded_2/pantograph/raised" in entities


def test_a_profile_keeps_any_column_in_si(tmp_path):
    rows = [f"2024-05-01T06:00:{i:02d}Z,{60 + i},{300 + i},{25.1},{i % 2},x{i}" for i in range(30)]
    columns = {
        "/train/state.speed": {"column": "v", "unit": "km/h"},
        "/train/supply.line_voltage": {"column": "U", "unit": "kV"},
        "/recorded/motor.temperature": {"column": "T", "unit": "degF", "meaning": "coil"},
        "/recorded/motor.pump": {"column": "pump", "between": "previous"},
    }
    trip = ingest(
        write(tmp_path / "run.csv", rows, "t,v,T,U,pump,note"), plain_profile(columns=columns)
    )
    motor = trip["/recorded/motor"]
    assert motor.attrs["units"] == {"temperature": "K", "pump": "1"}
    assert motor.attrs["meanings"]["temperature"] == "coil"
    assert motor.attrs["interpolation"]["pump"] == "previous"
    assert motor["temperature"].iloc[0] == pytest.approx((300.0 + 459.67) / 1.8)
    assert trip["/train/supply"]["line_voltage"].iloc[0] == 25_100.0
    assert report_of(trip).not_used == {"columns that the profile does not map: note": 1}


def test_names_units_and_descriptions_that_cannot_be_are_refused(tmp_path):
    for name, fields in (
        ("/recorded/Oil", ["a"]),
        ("/recorded/", ["a"]),
        ("/train/oil", ["a"]),
        ("/recorded/oil", ["Ölstand"]),
        ("/recorded/oil", ["a", "a"]),
        ("/recorded/oil", []),
    ):
        listed = [Field(field, "1", "") for field in fields]
        refused(InputError, "recorded/", recorded_topic, name, listed)
    for topic, column, said in (
        ("/recorded/oil.level", {"unit": "thumbs"}, "unit 'thumbs' is not known"),
        ("/train/state.speed", {"unit": "m/s", "meaning": "speed"},
         "meaning and between are for topics below /recorded/"),
    ):  # fmt: skip
        refused(InputError, said, plain_profile, columns={topic: {"column": "x", **column}})
    bare = made()
    bare[PANTOGRAPH.name].attrs = {"topic": PANTOGRAPH.name}
    refused(LogError, "does not describe its columns", trainlog.write, bare, tmp_path / "bare.mcap")


def test_a_recording_under_way_takes_what_was_declared(tmp_path):
    with trainlog.record(tmp_path / "live.mcap") as recording:
        with pytest.raises(TrainlogError, match="has not been declared"):
            recording.write(PANTOGRAPH.name, START, contact_force=70.0)
        recording.declare(PANTOGRAPH)
        for second in range(5):
            recording.write(PANTOGRAPH.name, START + second * 10**9, contact_force=70.0 + second)
        refused(LogError, "in use already", recording.declare, PANTOGRAPH)
    found = trainlog.read(tmp_path / "live.mcap")[PANTOGRAPH.name]
    assert found["contact_force"].tolist() == [70.0, 71.0, 72.0, 73.0, 74.0]
    assert found["raised"].isna().all()
    assert found.attrs["meanings"]["contact_force"] == "of the strip"

"""Trips as folders of Parquet files."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given, settings, strategies as st
from refusals import refused

from tests.mcap_trips import START, assert_same, trip_of, trips
from trainlog.errors import InputError, LogError
from trainlog.formats import trip_tables
from trainlog.formats.trip_tables import folder_writer, read_parquet, write_parquet
from trainlog.topics import EVENTS, TRAIN_AXLES, TRAIN_STATE
from trainlog.trip import Trip, frame_of

STATE = frame_of(TRAIN_STATE, START + np.arange(3), {"speed": [1.0, 2.0, 3.0]})


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def write_pieces(pieces: Iterator[Trip], folder: Path) -> None:
    with folder_writer(folder) as writer:
        for piece in pieces:
            writer.add(piece)


def interrupted() -> Iterator[Trip]:
    yield trip_of(rows=3)
    raise KeyboardInterrupt


@settings(max_examples=20)
@given(trip=trips())
@example(trip=Trip({}, attachments={"timetable.xls": b"\xd0\xcf\x11\xe0"}))
@example(trip=trip_of(rows=0))
@example(trip=trip_of(rows=1))
@example(trip=trip_of(rows=100))
def test_any_trip_comes_back_to_the_last_bit(tmp_path_factory, trip):
    folder = tmp_path_factory.mktemp("parquet") / "trip.parquet"
    write_parquet(trip, folder)
    assert_same(trip, read_parquet(folder))


def test_frames_of_other_programs_come_back(tmp_path):
    index = pd.DatetimeIndex([1, 2], tz="UTC", name="time").as_unit("ns")
    frame = pd.DataFrame(
        {
            "pose.x": np.array([1, 2], dtype=np.float32),
            "count": np.array([1, 2], dtype=np.uint16),
            "on": [True, False],
            "frame_id": ["map", "odom"],
            "raw": [b"\x00\xff", b""],
            "sequence": pd.array([2**63 - 1, None], dtype="Int64"),
            "valid": pd.array([True, None], dtype="boolean"),
        },
        index=index,
    )
    trip = Trip({"/robot/pose": frame, "/robot_pose": frame, "/ROBOT/pose": frame})
    write_parquet(trip, tmp_path / "other.parquet")
    back = read_parquet(tmp_path / "other.parquet")
    assert list(back.topics) == list(trip.topics)
    for name in trip.topics:
        pd.testing.assert_frame_equal(back[name], frame)


def test_same_trip_same_bytes_whatever_the_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr(trip_tables, "ROWS", 16)
    trip = trip_of(rows=100)
    write_parquet(trip, tmp_path / "whole.parquet")
    parts = (
        {name: frame.iloc[first : first + 7] for name, frame in trip.topics.items()}
        for first in range(0, 100, 7)
    )
    write_pieces((replace(trip, topics=part) for part in parts), tmp_path / "pieces.parquet")
    assert contents(tmp_path / "whole.parquet") == contents(tmp_path / "pieces.parquet")
    state = pq.ParquetFile(tmp_path / "pieces.parquet" / "train_state.parquet")
    assert state.metadata.num_row_groups == 7
    described = state.schema_arrow.field("speed").metadata
    assert described[b"unit"] == b"m/s"
    assert b"speed over ground" in described[b"meaning"]
    assert str(state.schema_arrow.field("time").type) == "timestamp[ns, tz=UTC]"
    assert state.read()["speed"].null_count == trip[TRAIN_STATE.name]["speed"].isna().sum() > 0
    assert_same(trip, read_parquet(tmp_path / "pieces.parquet"))


def test_only_the_topics_and_columns_asked_for_are_read(tmp_path):
    trip = trip_of(rows=5)
    write_parquet(trip, tmp_path / "trip.parquet")
    for other in (tmp_path / "trip.parquet").glob("gnss*.parquet"):
        other.write_bytes(b"")  # what is not asked for is not opened
    back = read_parquet(tmp_path / "trip.parquet", [EVENTS.name, TRAIN_STATE.name, "/unheard"])
    assert list(back.topics) == [TRAIN_STATE.name, EVENTS.name]
    some = read_parquet(
        tmp_path / "trip.parquet", {TRAIN_STATE.name: ["speed", "unheard"], TRAIN_AXLES.name: None}
    )
    pd.testing.assert_frame_equal(some[TRAIN_STATE.name], trip[TRAIN_STATE.name][["speed"]])
    assert some[TRAIN_STATE.name].attrs["units"] == {"speed": "m/s"}
    assert len(some[TRAIN_AXLES.name].columns) == 8
    one = read_parquet(tmp_path / "trip.parquet", {TRAIN_STATE.name: "speed"})
    assert list(one[TRAIN_STATE.name].columns) == ["speed"]


@pytest.mark.parametrize(
    ("trip", "said"),
    [
        (Trip({TRAIN_STATE.name: STATE.reset_index(drop=True)}), "not indexed by time"),
        (Trip({TRAIN_STATE.name: STATE.iloc[::-1]}), "runs backwards"),
        (Trip({TRAIN_STATE.name: STATE.assign(speed=[1.0, "two", 3.0])}), "cannot hold"),
        (Trip({TRAIN_STATE.name: pd.concat([STATE, STATE], axis=1)}), "cannot hold"),
        (Trip({}, provenance=({"step": float("nan")},)), "cannot be written"),
        (Trip({}, {"trip": "\ud800"}), "cannot be written"),
    ],
)
def test_what_cannot_be_written_is_refused_and_leaves_no_folder(trip, said, tmp_path):
    caught = refused(LogError, said, write_parquet, trip, tmp_path / "trip.parquet")
    assert caught.file == tmp_path / "trip.parquet"
    assert caught.remedy
    assert list(tmp_path.iterdir()) == []


def test_only_such_a_folder_is_replaced(tmp_path):
    folder = tmp_path / "trip.parquet"
    write_parquet(trip_of(rows=5), folder)
    write_parquet(trip_of(rows=7), folder)
    assert_same(read_parquet(folder), trip_of(rows=7))
    assert list(tmp_path.iterdir()) == [folder]
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "dog.jpg").write_bytes(b"dog")
    (tmp_path / "file").write_bytes(b"")
    for other in ("photos", "file"):
        with pytest.raises(InputError, match=r"is not a folder with trip\.json") as caught:
            write_parquet(trip_of(rows=5), tmp_path / other)
        assert caught.value.file == tmp_path / other
    assert (tmp_path / "photos" / "dog.jpg").read_bytes() == b"dog"


def test_a_failed_write_leaves_the_older_folder(tmp_path):
    folder = tmp_path / "trip.parquet"
    write_parquet(trip_of(rows=5), folder)
    before = contents(folder)
    no_time = Trip({TRAIN_STATE.name: STATE.reset_index(drop=True)})
    refused(LogError, "not indexed by time", write_parquet, no_time, folder)
    other = iter([Trip({TRAIN_STATE.name: STATE}), Trip({TRAIN_STATE.name: STATE[["speed"]]})])
    refused(LogError, "/train/state changes its columns", write_pieces, other, folder)
    with pytest.raises(KeyboardInterrupt):
        write_pieces(interrupted(), folder)
    assert contents(folder) == before
    assert list(tmp_path.iterdir()) == [folder]


def test_folders_that_hold_no_trip_are_named(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    for name, said in (("nothing", "does not exist"), ("file", "not a folder"), ("", "no trip")):
        caught = refused(InputError, said, read_parquet, tmp_path / name)
        assert caught.remedy


@pytest.fixture
def written(tmp_path: Path) -> Path:
    write_parquet(trip_of(rows=50), tmp_path / "trip.parquet")
    return tmp_path / "trip.parquet"


def test_damaged_files_are_named(written):
    state = written / "train_state.parquet"
    whole = state.read_bytes()
    for name, damaged in {
        "cut": whole[:-9],
        "empty": b"",
        "of other rows": (written / "events.parquet").read_bytes()[:100] + whole[100:],
    }.items():
        state.write_bytes(damaged)
        caught = refused(LogError, "is damaged", read_parquet, written)
        assert caught.file == state, name
        assert caught.remedy
    state.unlink()
    refused(LogError, r"train_state.*missing", read_parquet, written)
    state.write_bytes(whole)
    (written / "attachments" / "0001-line.json").write_bytes(b"{}")
    refused(LogError, r"0001-line.json: is damaged", read_parquet, written)


@settings(max_examples=25)
@given(st.data())
def test_a_flipped_bit_is_found_or_harmless(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("parquet") / "trip.parquet"
    trip = trip_of(rows=50, topics=[TRAIN_STATE.name, EVENTS.name])
    write_parquet(trip, folder)
    file = folder / data.draw(st.sampled_from(["train_state.parquet", "events.parquet"]))
    content = bytearray(file.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    file.write_bytes(content)
    try:
        back = read_parquet(folder)
    except LogError as error:
        named = error.file
    else:
        named = file
        assert_same(trip, back)
    assert named == file


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        ({"format": "trainlog/line"}, InputError, "format 'trainlog/line'"),
        ({"version": 2}, InputError, "newer"),
        ({"schema_version": 99}, InputError, "schema_version"),
        ({"topics": [{"topic": "/a"}]}, InputError, "missing"),
        ({"topics": [{"topic": "/a", "file": "../../x", "footer": ""}]}, LogError, "outside"),
        ({"topics": [{"topic": "/a", "file": "trip.json", "footer": ""}]}, LogError, "damaged"),
    ],
)
def test_an_index_that_does_not_fit_is_refused(change, error, said, written):
    index = json.loads((written / "trip.json").read_text())
    (written / "trip.json").write_text(json.dumps(index | change))
    caught = refused(error, said, read_parquet, written)
    assert caught.file is not None

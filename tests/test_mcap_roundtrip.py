"""A trip that is written reads back the same, to the last bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from mcap_trips import START, assert_same, trip_of, trips
from refusals import refused

import trainlog
from trainlog.errors import InputError, LogError
from trainlog.mcap import read_log, write_log
from trainlog.topics import (
    ENVIRONMENT,
    EVENTS,
    GNSS_FIX,
    GNSS_MOTION,
    TOPICS,
    TRAIN_AXLES,
    TRAIN_STATE,
)
from trainlog.trip import Trip, frame_of


@settings(max_examples=20)
@given(trip=trips())
def test_any_trip_reads_back_as_it_was(trip: Trip, tmp_path: Path) -> None:
    path = tmp_path / "trip.mcap"
    write_log(trip, path)
    assert_same(trip, read_log(path))


def test_every_topic_reads_back(tmp_path: Path) -> None:
    trip = trip_of(rows=500)
    write_log(trip, tmp_path / "trip.mcap")
    assert_same(trip, read_log(tmp_path / "trip.mcap"))


def test_the_package_offers_read_and_write(tmp_path: Path) -> None:
    trip = trip_of(rows=3)
    trainlog.write(trip, tmp_path / "trip.mcap")
    assert_same(trip, trainlog.read(tmp_path / "trip.mcap"))


@pytest.mark.parametrize("axles", range(1, 9))
def test_any_number_of_axles(axles: int, tmp_path: Path) -> None:
    trip = trip_of(rows=20, axles=axles, topics=[TRAIN_AXLES.name])
    write_log(trip, tmp_path / "trip.mcap")
    frame = read_log(tmp_path / "trip.mcap")[TRAIN_AXLES.name]
    assert [name for name in frame if name.startswith("wheel_speed")] == [
        f"wheel_speed_{axle}" for axle in range(1, axles + 1)
    ]
    assert_same(trip, read_log(tmp_path / "trip.mcap"))


def test_fields_may_have_different_axles(tmp_path: Path) -> None:
    frame = frame_of(TRAIN_AXLES, START + np.arange(3), {"wheel_speed": np.ones((3, 2))})
    trip = Trip({TRAIN_AXLES.name: frame})
    write_log(trip, tmp_path / "trip.mcap")
    assert_same(trip, read_log(tmp_path / "trip.mcap"))


def test_empty_topics_keep_their_columns(tmp_path: Path) -> None:
    trip = trip_of(rows=0, axles=3)
    write_log(trip, tmp_path / "trip.mcap")
    back = read_log(tmp_path / "trip.mcap")
    for name, frame in trip.topics.items():
        assert list(back[name].columns) == list(frame.columns)
        assert len(back[name]) == 0
        assert back[name].attrs == frame.attrs


def test_a_trip_without_topics_is_a_trip(tmp_path: Path) -> None:
    trip = Trip({}, {"trip": "planned"})
    write_log(trip, tmp_path / "trip.mcap")
    assert_same(trip, read_log(tmp_path / "trip.mcap"))


def test_absent_is_not_zero(tmp_path: Path) -> None:
    frame = frame_of(ENVIRONMENT, [START, START + 1], {"gradient": [0.0, np.nan]})
    write_log(Trip({ENVIRONMENT.name: frame}), tmp_path / "trip.mcap")
    back = read_log(tmp_path / "trip.mcap")[ENVIRONMENT.name]
    assert back["gradient"].iloc[0] == 0.0
    assert back["gradient"].isna().tolist() == [False, True]
    assert back["head_wind"].isna().all()


def test_zero_latitude_is_kept(tmp_path: Path) -> None:
    data = {"latitude": [0.0], "longitude": [0.0], "altitude": [0.0], "vertical_accuracy": [2.5]}
    trip = Trip({GNSS_FIX.name: frame_of(GNSS_FIX, [START], data)})
    write_log(trip, tmp_path / "trip.mcap")
    assert_same(trip, read_log(tmp_path / "trip.mcap"))


def test_samples_of_the_same_time_keep_their_order(tmp_path: Path) -> None:
    number = np.arange(20_000.0)
    frames = {
        topic.name: frame_of(
            topic,
            START + np.sort(np.random.default_rng(seed).integers(0, 9, len(number))) * 10**9,
            {column: number},
        )
        for seed, (topic, column) in enumerate(
            [(TRAIN_STATE, "position"), (TRAIN_AXLES, "wheel_speed_1"), (ENVIRONMENT, "gradient")]
        )
    }
    write_log(Trip(frames), tmp_path / "trip.mcap")
    back = read_log(tmp_path / "trip.mcap")
    assert_same(Trip(frames), back)
    np.testing.assert_array_equal(back[TRAIN_AXLES.name]["wheel_speed_1"], number)


def test_numbers_of_any_kind_become_doubles(tmp_path: Path) -> None:
    kinds = {
        "speed": np.array([1, 2, 3], dtype=np.int16),
        "speed_accuracy": np.array([0.5, 1.5, 2.5], dtype=np.float32),
        "satellites": pd.array([9, None, 11], dtype="Int64"),
    }
    frame = frame_of(GNSS_MOTION, START + np.arange(3), {})
    frame = frame.assign(**kinds)
    write_log(Trip({GNSS_MOTION.name: frame}), tmp_path / "trip.mcap")
    back = read_log(tmp_path / "trip.mcap")[GNSS_MOTION.name]
    assert back["speed"].tolist() == [1.0, 2.0, 3.0]
    assert back["satellites"].tolist()[::2] == [9.0, 11.0]
    assert np.isnan(back["satellites"].iloc[1])
    assert set(back.dtypes) == {np.dtype(np.float64)}


def test_local_time_is_written_as_utc(tmp_path: Path) -> None:
    frame = frame_of(TRAIN_STATE, START + np.arange(3), {"speed": [1.0, 2.0, 3.0]})
    local = frame.tz_convert("Europe/Zurich")
    local.attrs = frame.attrs
    write_log(Trip({TRAIN_STATE.name: local}), tmp_path / "trip.mcap")
    assert_same(Trip({TRAIN_STATE.name: frame}), read_log(tmp_path / "trip.mcap"))


def test_selected_topics_equal_the_same_topics_of_the_whole(tmp_path: Path) -> None:
    trip = trip_of(rows=300)
    write_log(trip, tmp_path / "trip.mcap")
    for chosen in ([TRAIN_STATE.name], [EVENTS.name, GNSS_FIX.name], []):
        back = read_log(tmp_path / "trip.mcap", topics=chosen)
        wanted = {name: frame for name, frame in trip.topics.items() if name in chosen}
        assert_same(replace(trip, topics=wanted), back)


def test_a_selected_topic_that_is_not_there_is_left_out(tmp_path: Path) -> None:
    write_log(trip_of(rows=3, topics=[TRAIN_STATE.name]), tmp_path / "trip.mcap")
    assert read_log(tmp_path / "trip.mcap", topics=[EVENTS.name]).topics == {}


def test_same_trip_same_bytes(tmp_path: Path) -> None:
    trip = trip_of(rows=200)
    shuffled = Trip(
        dict(reversed(trip.topics.items())),
        dict(reversed(trip.metadata.items())),
        trip.provenance,
        dict(reversed(trip.attachments.items())),
    )
    speed = trip[TRAIN_STATE.name]["speed"].to_numpy()
    other_nan = np.where(np.isnan(speed), np.copysign(np.nan, -1.0), speed)
    assert other_nan.tobytes() != speed.tobytes()
    negative_nan = trip[TRAIN_STATE.name].assign(speed=other_nan)
    for number, each in enumerate((trip, trip, shuffled, shuffled.with_topic(negative_nan))):
        write_log(each, tmp_path / f"{number}.mcap")
    assert len({(tmp_path / f"{number}.mcap").read_bytes() for number in range(4)}) == 1


def test_a_trip_read_and_written_again_gives_the_same_bytes(tmp_path: Path) -> None:
    write_log(trip_of(rows=200), tmp_path / "first.mcap")
    write_log(read_log(tmp_path / "first.mcap"), tmp_path / "second.mcap")
    assert (tmp_path / "first.mcap").read_bytes() == (tmp_path / "second.mcap").read_bytes()


STATE = frame_of(TRAIN_STATE, START + np.arange(3), {"speed": [1.0, 2.0, 3.0]})
EVENT = frame_of(EVENTS, [START], {"level": [2], "message": ["departure"]})


@pytest.mark.parametrize(
    ("trip", "said"),
    [
        (Trip({"/train/mood": STATE}), "no topic /train/mood"),
        (Trip({TRAIN_STATE.name: STATE.assign(mood=1.0)}), "no field for column mood"),
        (Trip({TRAIN_STATE.name: STATE.assign(speed="fast")}), "not a number"),
        (Trip({TRAIN_STATE.name: STATE.iloc[::-1]}), "runs backwards"),
        (Trip({TRAIN_STATE.name: STATE.reset_index(drop=True)}), "not indexed by time"),
        (Trip({TRAIN_STATE.name: STATE.tz_localize(None)}), "not indexed by time"),
        (
            Trip({TRAIN_STATE.name: frame_of(TRAIN_STATE, [-1, 5], {"speed": [1.0, 2.0]})}),
            "before 1970",
        ),
        (
            Trip({TRAIN_AXLES.name: frame_of(TRAIN_AXLES, [START], {"wheel_speed_2": [1.0]})}),
            r"axles \[2\] only",
        ),
        (
            Trip({TRAIN_STATE.name: pd.concat([STATE, STATE[["speed"]]], axis=1)}),
            "has a column twice",
        ),
        (
            Trip({EVENTS.name: frame_of(EVENTS, [START], {"level": [9], "message": ["x"]})}),
            "9 is not a level",
        ),
        (
            Trip(
                {
                    EVENTS.name: EVENT.assign(
                        message=pd.Series(["\ud800"], EVENT.index, dtype=object)
                    )
                }
            ),
            "UTF-8",
        ),
        (Trip({}, {"load": 12000}), "metadata 'load' is 12000, not text"),  # type: ignore[dict-item]
        (Trip({}, {"trip": "\ud800"}), "UTF-8"),
        (Trip({}, provenance=({"step": float("nan")},)), "step 1 of the provenance is not JSON"),
        (Trip({}, provenance=({"step": object()},)), "step 1 of the provenance is not JSON"),
    ],
)
def test_what_cannot_be_written_is_refused_and_leaves_no_file(
    trip: Trip, said: str, tmp_path: Path
) -> None:
    caught = refused(LogError, said, write_log, trip, tmp_path / "trip.mcap")
    assert caught.file == tmp_path / "trip.mcap"
    assert caught.remedy
    assert list(tmp_path.iterdir()) == []


def test_an_older_file_survives_a_failed_write(tmp_path: Path) -> None:
    write_log(trip_of(rows=5), tmp_path / "trip.mcap")
    before = (tmp_path / "trip.mcap").read_bytes()
    refused(LogError, "", write_log, Trip({"/train/mood": STATE}), tmp_path / "trip.mcap")
    assert (tmp_path / "trip.mcap").read_bytes() == before


def test_missing_files_and_unknown_topics_are_named(tmp_path: Path) -> None:
    refused(InputError, "does not exist", read_log, tmp_path / "nothing.mcap")
    with pytest.raises(LogError, match="no topic /train/mood"):
        read_log(tmp_path / "nothing.mcap", topics=["/train/mood"])
    assert "/train/mood" not in TOPICS

"""A trip that is written reads back the same, to the last bit."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import example, given, settings, strategies as st
from mcap.reader import SeekingReader
from mcap_trips import START, assert_same, trip_of, trips
from refusals import refused

import trainlog
from trainlog.errors import LogError
from trainlog.mcap import LogWriter, read_log, write_log
from trainlog.topics import (
    ENVIRONMENT,
    EVENTS,
    GNSS_FIX,
    GNSS_MOTION,
    TRAIN_AXLES,
    TRAIN_CONTROLS,
    TRAIN_STATE,
)
from trainlog.trip import Trip, frame_of


def fix(latitude: float) -> Trip:
    data = {"latitude": [latitude], "longitude": [0.0], "altitude": [0.0]}
    return Trip({GNSS_FIX.name: frame_of(GNSS_FIX, [START], data | {"vertical_accuracy": [2.5]})})


ONE_FIELD_OF_AXLES = frame_of(TRAIN_AXLES, START + np.arange(3), {"wheel_speed": np.ones((3, 2))})


@settings(max_examples=20)
@given(trip=trips())
@example(trip=trip_of(rows=500))
@example(trip=trip_of(rows=20, axles=1, topics=[TRAIN_AXLES.name]))
@example(trip=trip_of(rows=20, axles=8, topics=[TRAIN_AXLES.name]))
@example(trip=Trip({TRAIN_AXLES.name: ONE_FIELD_OF_AXLES}))
@example(trip=trip_of(rows=0, axles=3))
@example(trip=Trip({}, {"trip": "planned"}))
@example(trip=fix(0.0))
@example(trip=fix(np.nan))
def test_any_trip_reads_back_as_it_was(trip, tmp_path):
    path = tmp_path / "trip.mcap"
    trainlog.write(trip, path)
    assert_same(trip, trainlog.read(path))


def test_samples_of_the_same_time_keep_their_order(tmp_path):
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


def test_numbers_of_any_kind_become_doubles_and_local_time_utc(tmp_path):
    frame = frame_of(GNSS_MOTION, START + np.arange(3), {})
    local = frame.assign(
        speed=np.array([1, 2, 3], dtype=np.int16),
        speed_accuracy=np.array([0.5, 1.5, 2.5], dtype=np.float32),
        satellites=pd.array([9, None, 11], dtype="Int64"),
    ).tz_convert("Europe/Zurich")
    write_log(Trip({GNSS_MOTION.name: local}), tmp_path / "trip.mcap")
    back = read_log(tmp_path / "trip.mcap")[GNSS_MOTION.name]
    assert back.index.equals(frame.index)
    assert back["speed"].tolist() == [1.0, 2.0, 3.0]
    np.testing.assert_array_equal(back["satellites"], [9.0, np.nan, 11.0])
    assert set(back.dtypes) == {np.dtype(np.float64)}


def test_same_trip_same_bytes(tmp_path):
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


STATE = frame_of(TRAIN_STATE, START + np.arange(3), {"speed": [1.0, 2.0, 3.0]})
EVENT = frame_of(EVENTS, [START], {"level": [2], "message": ["departure"]})


FRAMES = (
    (STATE.assign(mood=1.0), "no field for column mood"),
    (STATE.assign(speed="fast"), "not a number"),
    (STATE.iloc[::-1], "runs backwards"),
    (STATE.reset_index(drop=True), "not indexed by time"),
    (STATE.tz_localize(None), "not indexed by time"),
    (frame_of(TRAIN_STATE, [-1, 5], {"speed": [1.0, 2.0]}), "before 1970"),
    (frame_of(TRAIN_AXLES, [START], {"wheel_speed_2": [1.0]}), r"axles \[2\] only"),
    (pd.concat([STATE, STATE[["speed"]]], axis=1), "has a column twice"),
    (frame_of(EVENTS, [START], {"level": [9], "message": ["x"]}), "9 is not a level"),
    (EVENT.assign(message=pd.Series(["\ud800"], EVENT.index, dtype=object)), "UTF-8"),
)


@pytest.mark.parametrize(
    ("trip", "said"),
    [
        *((Trip({}).with_topic(frame), said) for frame, said in FRAMES),
        (Trip({"/train/mood": STATE}), "no topic /train/mood"),
        (Trip({}, {"load": 12000}), "metadata 'load' is 12000, not text"),
        (Trip({}, {"trip": "\ud800"}), "UTF-8"),
        (Trip({}, provenance=({"step": float("nan")},)), "step 1 of the provenance is not JSON"),
        (Trip({}, provenance=({"step": object()},)), "step 1 of the provenance is not JSON"),
    ],
)
def test_what_cannot_be_written_is_refused_and_leaves_no_file(trip, said, tmp_path):
    """Nor does an older one suffer."""
    older = tmp_path / "older.mcap"
    older.write_bytes(b"older")
    for path in (tmp_path / "trip.mcap", older):
        caught = refused(LogError, said, write_log, trip, path)
        assert caught.file == path
        assert caught.remedy
    assert list(tmp_path.iterdir()) == [older]
    assert older.read_bytes() == b"older"


# ----------------------- Logs written at once and piece by piece, and disks that do not take them


@cache
def long_trip() -> Trip:
    """Three megabytes in five minutes: chunks cut by size and by time."""
    rows = np.arange(6000)
    dense = frame_of(
        TRAIN_CONTROLS,
        START + np.concatenate([rows[:3000] * 10**7, 10**11 + rows[3000:] * 3 * 10**7]),
        {name.name: np.random.default_rng(n).normal(size=6000) for n, name in enumerate(FIELDS)},
    )
    axles = frame_of(TRAIN_AXLES, START + rows * 5 * 10**7, {"wheel_speed": np.ones((6000, 25))})
    return trip_of(rows=40, step=7 * 10**9).with_topic(dense).with_topic(axles)


FIELDS = TRAIN_CONTROLS.fields


def pieces(trip: Trip, cuts: list[pd.Timestamp]) -> Iterator[Trip]:
    """The trip cut at times; each piece with all topics."""
    edges = [pd.Timestamp(0, tz="UTC"), *cuts, pd.Timestamp.max.tz_localize("UTC")]
    for start, end in pairwise(edges):
        frames = {
            name: frame[(frame.index >= start) & (frame.index < end)]
            for name, frame in trip.topics.items()
        }
        yield Trip(frames, trip.metadata, trip.provenance, trip.attachments)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "trip.mcap"
    write_log(long_trip(), path)
    return path


def write_pieces(path: Path, *pieces: Trip) -> None:
    with LogWriter(path) as log:
        for piece in pieces:
            log.add(piece)


@settings(max_examples=8)
@given(st.lists(st.integers(-(10**9), 301 * 10**9), max_size=6))
def test_any_pieces_give_the_same_bytes(whole, tmp_path_factory, cuts):
    path = tmp_path_factory.getbasetemp() / "pieces.mcap"
    times = [pd.Timestamp(START + cut, tz="UTC") for cut in sorted(cuts)]
    write_pieces(path, *pieces(long_trip(), times))
    assert path.read_bytes() == whole.read_bytes()


def test_chunks_are_full_but_neither_too_long_nor_too_large(whole):
    summary = SeekingReader(BytesIO(whole.read_bytes())).get_summary()
    chunks = summary.chunk_indexes
    assert len(chunks) >= 5
    for index, following in pairwise(chunks):
        assert index.message_end_time - index.message_start_time < 60 * 10**9
        assert index.message_end_time <= following.message_start_time
        assert index.uncompressed_size <= 2**20
        full = index.uncompressed_size > 2**20 - 1000
        assert full or following.message_start_time - index.message_start_time >= 60 * 10**9


def test_a_topic_may_come_late_and_without_a_piece_there_is_an_empty_log(tmp_path):
    first, second = pieces(trip_of(rows=50), [pd.Timestamp(START + 2 * 10**9, tz="UTC")])
    late = {name: frame for name, frame in first.topics.items() if name != EVENTS.name}
    write_pieces(tmp_path / "trip.mcap", Trip(late), second)
    found = read_log(tmp_path / "trip.mcap")
    assert len(found[EVENTS.name]) == len(second[EVENTS.name])
    assert len(found[TRAIN_STATE.name]) == 50
    write_pieces(tmp_path / "none.mcap")
    assert read_log(tmp_path / "none.mcap").topics == {}


def test_pieces_that_do_not_follow_each_other_are_refused(tmp_path):
    first, second = pieces(trip_of(rows=50), [pd.Timestamp(START + 2 * 10**9, tz="UTC")])
    other = Trip({TRAIN_AXLES.name: second[TRAIN_AXLES.name].iloc[:, :0]})
    caught = refused(LogError, "begins before", write_pieces, tmp_path / "trip.mcap", second, first)
    assert caught.file == tmp_path / "trip.mcap"
    refused(LogError, "number of axles", write_pieces, tmp_path / "trip.mcap", first, other)
    assert list(tmp_path.iterdir()) == []


def test_a_block_that_fails_leaves_the_older_file(tmp_path):
    older = trip_of(rows=3)
    write_log(older, tmp_path / "trip.mcap")
    with pytest.raises(ZeroDivisionError), LogWriter(tmp_path / "trip.mcap") as log:
        log.add(trip_of(rows=1 // len(list(tmp_path.glob("*.txt")))))
    assert [path.name for path in tmp_path.iterdir()] == ["trip.mcap"]
    assert_same(read_log(tmp_path / "trip.mcap"), older)

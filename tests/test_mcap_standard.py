"""The file is an ordinary MCAP that reads back the same; what `describe` finds in it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from io import BytesIO, StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import example, given, settings, strategies as st
from mcap.reader import SeekingReader, make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory
from mcap_trips import ATTACHMENTS, METADATA, PROVENANCE, START, assert_same, trip_of, trips
from refusals import refused
from rich.console import Console

import trainlog
from trainlog.errors import LogError
from trainlog.mcap import LogDescription, LogWriter, describe, read_log, tables, write_log
from trainlog.mcap.codec import descriptor_set
from trainlog.topics import (
    ENVIRONMENT,
    EVENTS,
    GNSS_FIX,
    GNSS_MOTION,
    SCHEMA_VERSION,
    TOPICS,
    TRAIN_AXLES,
    TRAIN_CONTROLS,
    TRAIN_STATE,
    Topic,
)
from trainlog.trip import Trip, frame_of

AXLES = 4


@pytest.fixture(scope="module")
def trip() -> Trip:
    return trip_of(rows=700, axles=AXLES)


@pytest.fixture(scope="module")
def log(trip: Trip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "trip.mcap"
    write_log(trip, path)
    return path


def message_class(topic: Topic) -> Any:
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set(topic)).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(topic.message))


def row_of(topic: Topic, message: Any) -> list[float]:
    """What a decoded message says, in the order of the frame's columns."""
    if topic is EVENTS:
        return [message.level, message.message, message.name]
    if topic is GNSS_FIX:
        east, *_, north, _, _, _, up = message.position_covariance
        np.testing.assert_equal(east, north)
        assert all(message.position_covariance[i] == 0.0 for i in (1, 2, 3, 5, 6, 7))
        row = [message.latitude, message.longitude, message.altitude, east**0.5, up**0.5]
        known = message.DIAGONAL_KNOWN if not np.isnan(east) else message.UNKNOWN
        assert message.position_covariance_type == known
        return row
    row = []
    for field in topic.fields:
        value = getattr(message, field.name)
        assert len(value) == AXLES if field.per_axle else message.HasField(field.name)
        row += list(value) if field.per_axle else [value]
    return row


def test_the_official_reader_reads_every_value_in_order(trip, log):
    rows: dict[str, list[list[float]]] = {name: [] for name in trip.topics}
    times: dict[str, list[int]] = {name: [] for name in trip.topics}
    sequences: dict[str, int] = {}
    before = 0
    with log.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            assert schema.name == TOPICS[channel.topic].message
            assert message.publish_time == message.log_time >= before
            # The number of the topic's messages before this chunk, so that a lost one is counted.
            assert message.sequence <= len(rows[channel.topic])
            if message.sequence != sequences.get(channel.topic):
                assert message.sequence == len(rows[channel.topic])
            sequences[channel.topic] = message.sequence
            before = message.log_time
            times[channel.topic].append(message.log_time)
            rows[channel.topic].append(row_of(TOPICS[channel.topic], decoded))
            if hasattr(decoded, "timestamp"):
                assert decoded.timestamp.ToNanoseconds() == message.log_time
    for name, frame in trip.topics.items():
        assert times[name] == frame.index.as_unit("ns").asi8.tolist()
        if name == EVENTS.name:
            assert rows[name] == frame.to_numpy().tolist()
        else:
            np.testing.assert_array_equal(np.array(rows[name]), frame.to_numpy())


def test_descriptors_and_channels_equal_the_table(log):
    summary = SeekingReader(BytesIO(log.read_bytes())).get_summary()
    for topic in TOPICS.values():
        channel = next(c for c in summary.channels.values() if c.topic == topic.name)
        assert channel.message_encoding == "protobuf"
        for field in topic.fields:
            assert channel.metadata[f"unit.{field.name}"] == field.unit
            assert channel.metadata[f"meaning.{field.name}"] == field.meaning
            assert channel.metadata.get(f"axles.{field.name}") == ("4" if field.per_axle else None)
        schema = summary.schemas[channel.schema_id]
        assert (schema.name, schema.encoding) == (topic.message, "protobuf")
        declared = message_class(topic).DESCRIPTOR
        assert declared.full_name == topic.message
        if topic.foxglove:
            continue
        for field in topic.fields:
            assert declared.fields_by_name[field.name].has_presence is not field.per_axle


def write_elsewhere(
    path: Path,
    *batches: Iterable[tuple[int, Any]],
    topic: Topic = TRAIN_STATE,
    names: tuple[str, ...] = (),
    schemas: tuple[bytes, ...] = (),
    metadata: dict[str, str] | None = None,
) -> Path:
    """Times and messages by the official writer: a channel for each batch, one after the other."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for number, messages in enumerate(batches):
            data = schemas[number] if schemas else descriptor_set(topic)
            schema = writer.register_schema(topic.message, "protobuf", data)
            name = names[number] if names else topic.name
            channel = writer.register_channel(name, "protobuf", schema, metadata or {})
            for time, message in messages:
                data = message if isinstance(message, bytes) else message.SerializeToString()
                writer.add_message(channel, time, data, time)
        writer.finish()
    return path


def edited(change: Callable[[Any], None], topic: Topic = TRAIN_STATE) -> bytes:
    """The schema of a topic, changed."""
    files = FileDescriptorSet.FromString(descriptor_set(topic))
    change(files.file[-1].message_type[0])
    return files.SerializeToString()


def with_field(place: int, /, **values: object) -> Callable[[Any], None]:
    """Changes a field of a message's schema."""

    def change(message: Any) -> None:
        for name, value in values.items():
            setattr(message.field[place], name, value)

    return change


TEXT = FieldDescriptorProto.TYPE_STRING


def test_mixed_messages_of_several_channels_and_out_of_order(tmp_path):
    axles, nan = message_class(TRAIN_AXLES), np.nan
    first = [
        (START + 5, axles(wheel_speed=[1.0, 2.0])),
        (START + 1, axles(wheel_speed=[3.0], wheel_effort=[4.0])),
    ]
    second = [(START + 3, axles()), (START + 2, axles(wheel_effort=[5.0, 6.0, 7.0]))]
    names = TRAIN_AXLES.name, TRAIN_AXLES.name, "/other"
    path = tmp_path / "trip.mcap"
    write_elsewhere(path, first, second, first, topic=TRAIN_AXLES, names=names)
    expected = frame_of(
        TRAIN_AXLES,
        START + np.array([1, 2, 3, 5]),
        {
            "wheel_speed": np.array([[3.0, nan], [nan, nan], [nan, nan], [1.0, 2.0]]),
            "wheel_effort": np.array([[4.0, nan, nan], [5.0, 6.0, 7.0], [nan] * 3, [nan] * 3]),
        },
    )
    pd.testing.assert_frame_equal(read_log(path)[TRAIN_AXLES.name], expected, check_freq=False)


def test_columns_that_a_file_does_not_have_are_nan(tmp_path):
    """Of two channels of a topic one lacks a field: NaN in its rows, not what the memory held."""
    rows = 5_000
    numbers = np.arange(float(rows))
    both = [b"\x09%b\x11%b\x19%b" % (3 * (value.tobytes(),)) for value in numbers]
    path = write_elsewhere(
        tmp_path / "trip.mcap",
        [(START + 2 * row, data) for row, data in enumerate(both)],
        [(START + 2 * row + 1, data[:9] + data[18:]) for row, data in enumerate(both)],
        schemas=(descriptor_set(TRAIN_STATE), edited(lambda message: message.field.pop(1))),
    )
    for _ in range(3):
        used = np.full(6 * rows, 7.0)  # memory that was used before is not zero
        del used
        frame = read_log(path)[TRAIN_STATE.name]
        np.testing.assert_array_equal(frame["position"], np.repeat(numbers, 2))
        np.testing.assert_array_equal(frame["acceleration"], np.repeat(numbers, 2))
        np.testing.assert_array_equal(frame["speed"][::2], numbers)
        assert frame["speed"][1::2].isna().all()


def test_foreign_location_fixes(tmp_path):
    fix = message_class(GNSS_FIX)
    unknown = fix(latitude=47.0, longitude=9.0, position_covariance=[0.0] * 9)
    known = fix(
        latitude=47.5,
        longitude=9.5,
        altitude=600.0,
        position_covariance=[9.0, 1.0, 0.0, 1.0, 16.0, 0.0, 0.0, 0.0, 25.0],
        position_covariance_type=3,
        frame_id="antenna",
    )
    messages = [(START, unknown), (START + 1, known)]
    path = write_elsewhere(tmp_path / "trip.mcap", messages, topic=GNSS_FIX)
    np.testing.assert_array_equal(
        read_log(path)[GNSS_FIX.name].to_numpy(),
        [[47.0, 9.0, 0.0, np.nan, np.nan], [47.5, 9.5, 600.0, np.sqrt(12.5), 5.0]],
    )


def test_slow_and_fast_path_agree(trip, log, tmp_path, monkeypatch):
    """As arrays, and message by message with the official decoder."""
    assert_same(trip, read_log(log))
    monkeypatch.setattr(tables.TopicChannel, "arrays", lambda *_: None)
    assert_same(trip, read_log(log))


def test_fields_are_found_by_name_not_by_number_and_numbers_of_any_kind_are_read(tmp_path):
    """A file of another version: one field less, one unknown, numbers moved."""

    def moved(message: Any) -> None:
        for field, name in zip(message.field, ("mood", "position", "speed"), strict=True):
            field.name = name

    def other_kinds(message: Any) -> None:
        with_field(0, type=FieldDescriptorProto.TYPE_SINT32)(message)
        with_field(1, type=FieldDescriptorProto.TYPE_FLOAT)(message)

    doubles = np.array([1.5, 2.5, 3.5])
    mixed = b"\x08\x05" + b"\x15" + np.float32(2.5).tobytes()
    for change, data, expected in (
        (moved, b"\x09%b\x11%b\x19%b" % (*map(bytes, doubles),), [2.5, 3.5, np.nan]),
        (other_kinds, mixed, [-3.0, 2.5, np.nan]),
    ):
        path = tmp_path / f"{change.__name__}.mcap"
        write_elsewhere(path, [(START, data), (START + 1, data)], schemas=(edited(change),))
        frame = read_log(path)[TRAIN_STATE.name]
        assert list(frame.columns) == [field.name for field in TRAIN_STATE.fields]
        np.testing.assert_array_equal(frame.to_numpy(), [expected] * 2)


@pytest.mark.parametrize(
    ("schema", "data", "metadata", "said"),
    [
        (descriptor_set(TRAIN_STATE), b"\xff", {}, "not a trainlog.TrainState"),
        (b"\xff\xff", b"", {}, "not a protobuf descriptor"),
        (descriptor_set(TRAIN_AXLES), b"", {}, "does not declare"),
        (edited(with_field(0, type=TEXT)), b"\x0a\x01x", {}, "do not have the fields"),
        (edited(with_field(0, number=2)), b"", {}, "schema of /train/state cannot be used"),
        (edited(with_field(0, number=-1)), b"", {}, "schema of /train/state cannot be used"),
        (descriptor_set(TRAIN_STATE), b"", {"unit.speed": "km/h"}, "in 'km/h', not in 'm/s'"),
    ],
)
def test_broken_and_contradicting_schemas_are_refused(schema, data, metadata, said, tmp_path):
    path = tmp_path / "trip.mcap"
    write_elsewhere(path, [(START, data)], schemas=(schema,), metadata=metadata)
    assert refused(LogError, said, read_log, path).file == path


def test_later_versions_and_times_beyond_pandas_are_refused(tmp_path):
    for version in (str(SCHEMA_VERSION + 1), "9" * 5000, "next", ""):
        with (tmp_path / "trip.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            writer.add_metadata("trainlog.format", {"schema_version": version})
            writer.finish()
        refused(LogError, "update trainlog", read_log, tmp_path / "trip.mcap")
    late = [(2**63 + 5, message_class(TRAIN_STATE)(speed=1.0))]
    refused(LogError, "times after 2262", read_log, write_elsewhere(tmp_path / "trip.mcap", late))


@pytest.mark.parametrize("axles", ["9" * 5000, "-1", "two", "4096", "0"])
def test_a_wrong_number_of_axles_is_not_followed(axles, tmp_path):
    message = message_class(TRAIN_AXLES)(wheel_speed=[1.0, 2.0], wheel_effort=[3.0, 4.0])
    metadata = {"axles.wheel_speed": axles, "axles.wheel_effort": "2"}
    path = tmp_path / "trip.mcap"
    write_elsewhere(path, [(START, message)], topic=TRAIN_AXLES, metadata=metadata)
    frame = read_log(path)[TRAIN_AXLES.name]
    names = ["wheel_speed_1", "wheel_speed_2", "wheel_effort_1", "wheel_effort_2"]
    assert list(frame.columns) == names
    assert frame.to_numpy().tolist() == [[1.0, 2.0, 3.0, 4.0]]
    assert describe(path).count == 1


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


DATA = Path(__file__).parent / "data"

# Chunks of ten seconds, the row as sequence number; of a minute, numbers that count by chunk.
FILES = ("log_version_1.mcap", "log_version_1_minutes.mcap")
"""Each is `kept_trip` as its version of the table of topics wrote it; none is written again."""

# What version 1 held, in full: the table of topics may grow, these columns may not go.
COLUMNS = {
    "/train/state": "position speed acceleration",
    "/train/controls": "lever tractive_effort_demand braking_effort_demand tractive_effort "
    "dynamic_braking_effort pneumatic_braking_effort",
    "/train/axles": "wheel_speed_1 wheel_speed_2 wheel_speed_3 wheel_effort_1 wheel_effort_2 "
    "wheel_effort_3",
    "/gnss/fix": "latitude longitude altitude horizontal_accuracy vertical_accuracy",
    "/gnss/motion": "speed speed_accuracy satellites pdop",
    "/environment": "speed_limit gradient curvature air_temperature head_wind",
    "/events": "level message name",
    "/estimates/state": "position position_std speed speed_std acceleration acceleration_std",
    "/estimates/running_resistance": "r0 r1 r2 mass resistance resistance_std",
    "/estimates/adhesion": "adhesion_1 adhesion_2 adhesion_3 slip_speed_1 slip_speed_2 "
    "slip_speed_3",
    "/reference": "speed tractive_effort braking_effort lateness",
    "/truth": "position speed acceleration running_resistance maximum_adhesion energy",
}
KEPT_START = 1_735_689_600 * 10**9
"""2025-01-01T00:00:00Z"""

KEPT = {"trip": "kept 1", "train": "FLIRT", "line": "St.Gallen–Wil", "direction": "reverse"}
KEPT_STEPS = {"step": "written by hand", "inputs": {"a": "00"}}, {"step": "second", "count": 2}
KEPT_ATTACHMENTS = {"line.json": b'{"kept": true}', "train.json": b"{}"}


KEPT_EVENTS = {
    "level": [1, 2, 3, 4, 5, 0],
    "message": ["departure", "slip", "", "Überlast", "a\nb", "arrival"],
    "name": ["driver", "axle 1", "", "motor", "line", "driver"],
}


def kept_trip() -> Trip:
    """Half a second between rows, the last two at the same time, each topic a bit later.

    Values are eighths that differ by topic, column and row; the third row is absent.
    """
    frames = {}
    for topic, (name, columns) in enumerate(COLUMNS.items()):
        data: dict[str, object] = dict(KEPT_EVENTS)
        if name != "/events":
            for number, column in enumerate(columns.split()):
                data[column] = np.array([0, 1, np.nan, 3, 4, 5]) / 8 + topic * 100 + number * 10
        times = KEPT_START + np.array([0, 1, 2, 3, 4, 4]) * 500_000_000 + topic
        kept = {column: np.array(data[column]) for column in columns.split()}
        frames[name] = frame_of(TOPICS[name], times, kept)
    return Trip(frames, KEPT, KEPT_STEPS, KEPT_ATTACHMENTS)


@pytest.mark.parametrize("kept", FILES)
def test_fields_keep_their_numbers(kept):
    """A field that moves in the table would be misread by programs with an older descriptor."""
    summary = SeekingReader(BytesIO((DATA / kept).read_bytes())).get_summary()
    for channel in summary.channels.values():
        topic = TOPICS[channel.topic]
        if topic.foxglove:
            continue
        files = FileDescriptorSet.FromString(summary.schemas[channel.schema_id].data)
        for field in files.file[0].message_type[0].field:
            assert topic.fields[field.number - 1].name == field.name
            assert channel.metadata[f"unit.{field.name}"] == topic.field(field.name).unit


@pytest.mark.parametrize("kept", FILES)
def test_a_kept_file_opens_with_the_values_that_todays_writer_writes(kept, tmp_path):
    write_log(kept_trip(), tmp_path / "today.mcap")
    found = read_log(DATA / kept)
    assert_same(found, read_log(tmp_path / "today.mcap"))
    assert list(found.topics) == [name for name in TOPICS if name in COLUMNS]
    for name, columns in COLUMNS.items():
        assert set(columns.split()) <= set(found[name].columns)


def printed(description: LogDescription) -> str:
    console = Console(file=StringIO(), width=140)
    console.print(*description.shown())
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


def test_everything_in_a_log_is_found(tmp_path):
    trip, path = trip_of(rows=120, axles=3), tmp_path / "trip.mcap"
    write_log(trip, path)
    found = describe(path)
    assert (found.path, found.size, found.problem) == (path, path.stat().st_size, None)
    assert found.complete
    assert found.schema_version == "1"
    assert (found.metadata, found.provenance) == (METADATA, PROVENANCE)
    assert [(a.name, a.size, a.sha256) for a in found.attachments] == [
        (name, len(content), hashlib.sha256(content).hexdigest())
        for name, content in sorted(ATTACHMENTS.items())
    ]
    assert [topic.name for topic in found.topics] == list(trip.topics)
    for topic in found.topics:
        frame = trip[topic.name]
        assert (topic.message, topic.encoding) == (TOPICS[topic.name].message, "protobuf")
        assert (topic.count, topic.gaps) == (120, 0)
        stated = [topic.rate, topic.median_interval, topic.largest_gap]
        assert stated == pytest.approx([10.0, 0.1, 0.1])
        assert (topic.first, topic.last) == (frame.index[0], frame.index[-1])
        assert topic.units == {field.name: field.unit for field in TOPICS[topic.name].fields}
        per_axle = [field.name for field in TOPICS[topic.name].fields if field.per_axle]
        assert topic.axles == dict.fromkeys(per_axle, 3)
    assert (found.first, found.last) == (trip.start, trip.end)
    assert found.count == 120 * len(TOPICS)
    position = trip[TRAIN_STATE.name]["position"]
    assert found.position_span == (position.min(), position.max())
    first, last = position.min() / 1e3, position.max() / 1e3
    assert f"position  km {first:.3f} to km {last:.3f}" in repr(found)
    assert (found.chunks, found.compression) == (1, ("zstd",))
    assert 0 < found.stored_size < found.content_size


def test_texts_of_a_file_are_neither_markup_nor_commands(tmp_path):
    metadata = {"trip": "[red]night[/red]", "note": "a\x1b[2Jb\nc", "long": "x" * 500}
    write_log(Trip({}, metadata), tmp_path / "trip.mcap")
    text = printed(describe(tmp_path / "trip.mcap"))
    assert "[red]night[/red]" in text
    assert "\x1b" not in text
    assert "x" * 500 not in text.replace("\n", "").replace(" ", "")


def test_a_damaged_log_is_described_as_far_as_it_goes(tmp_path):
    trip = trip_of(rows=300, step=6 * 10**8)
    write_log(trip, tmp_path / "cut.mcap")
    data = (tmp_path / "cut.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    found = describe(tmp_path / "cut.mcap")
    assert not found.complete
    assert str(found.problem).startswith("byte ")
    assert (found.metadata, found.provenance) == (METADATA, PROVENANCE)
    assert 0 < found.count < 300 * len(TOPICS)
    kept = trip[TRAIN_STATE.name].iloc[: found.topics[0].count]["position"]
    assert found.position_span == (kept.min(), kept.max())
    assert "damaged" in printed(found)

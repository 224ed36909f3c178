"""The file is an ordinary MCAP: other readers find in it what was written, and the reverse."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import SeekingReader, make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory
from mcap_trips import START, assert_same, trip_of
from refusals import refused

from trainlog.errors import LogError
from trainlog.mcap import describe, read_log, tables, write_log
from trainlog.mcap.codec import descriptor_set
from trainlog.topics import (
    EVENTS,
    GNSS_FIX,
    SCHEMA_VERSION,
    TOPICS,
    TRAIN_AXLES,
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


# --- files with our topics that another program wrote


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
        (
            edited(with_field(0, type=FieldDescriptorProto.TYPE_STRING)),
            b"\x0a\x01x",
            {},
            "do not have the fields",
        ),
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

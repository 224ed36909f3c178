"""What the benchmarks of the log write and read: trips, and the same messages by other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory
from small_mcap import McapWriter

from trainlog.mcap.codec import descriptor_set
from trainlog.topics import TOPICS, TRAIN_AXLES, TRAIN_CONTROLS, TRAIN_STATE, Topic
from trainlog.trip import Trip, frame_of

AXLES = 5
START = 1_700_000_000 * 10**9

CASES = {
    "one topic, ten values a message": [TRAIN_AXLES],
    "three topics interleaved": [TRAIN_STATE, TRAIN_CONTROLS, TRAIN_AXLES],
}
"""Topics of the trips that are timed."""


def trip_of(topics: list[Topic], messages: int) -> Trip:
    """A trip of smooth signals with sensor noise, 100 Hz a topic."""
    random = np.random.default_rng(1)
    rows = messages // len(topics)
    at = START + np.arange(rows) * 10**7
    frames = {}
    for topic in topics:
        shape = {field.name: (rows, AXLES) if field.per_axle else (rows,) for field in topic.fields}
        data = {
            name: np.round(20 + np.cumsum(random.normal(0, 0.01, size), axis=0), 3)
            for name, size in shape.items()
        }
        frames[topic.name] = frame_of(topic, at, data)
    return Trip(frames)


@dataclass(frozen=True)
class Channel:
    """A topic as other programs write it: one protobuf object a message."""

    topic: Topic
    schema: bytes
    message: Callable[..., Any]
    rows: Iterator[tuple[Any, ...]]

    def messages(self) -> Iterator[tuple[int, bytes]]:
        """Time and bytes of each message."""
        names = [field.name for field in self.topic.fields]
        scalars = [not field.per_axle for field in self.topic.fields]
        for at, *row in self.rows:
            fields = {
                name: value[0] if scalar else value
                for name, scalar, value in zip(names, scalars, row, strict=True)
            }
            yield at, self.message(**fields).SerializeToString()


def message_of(topic: Topic) -> Callable[..., Any]:
    """The protobuf class of a topic's messages."""
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set(topic)).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(topic.message))


def channels_of(trip: Trip) -> list[Channel]:
    """The topics of a trip, ready to be written message by message."""
    found = []
    for name, frame in trip.topics.items():
        topic = TOPICS[name]
        patterns = [
            f"^{field.name}_[0-9]+$" if field.per_axle else f"^{field.name}$"
            for field in topic.fields
        ]
        values = [frame.filter(regex=pattern).to_numpy().tolist() for pattern in patterns]
        times = frame.index.as_unit("ns").asi8.tolist()
        found.append(
            Channel(
                topic, descriptor_set(topic), message_of(topic), zip(times, *values, strict=True)
            )
        )
    return found


def write_officially(trip: Trip, path: Path) -> None:
    """The same messages with the official writer."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels = channels_of(trip)
        numbers = []
        for each in channels:
            schema = writer.register_schema(each.topic.message, "protobuf", each.schema)
            numbers.append(writer.register_channel(each.topic.name, "protobuf", schema))
        for row in zip(*(each.messages() for each in channels), strict=True):
            for channel, (at, data) in zip(numbers, row, strict=True):
                writer.add_message(channel, at, data, at)
        writer.finish()


def write_small(trip: Trip, path: Path) -> None:
    """The same messages with small-mcap."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, zstd_level=3)
        writer.start()
        channels = channels_of(trip)
        for number, each in enumerate(channels, start=1):
            writer.add_schema(number, each.topic.message, "protobuf", each.schema)
            writer.add_channel(number, each.topic.name, "protobuf", number)
        for row in zip(*(each.messages() for each in channels), strict=True):
            for number, (at, data) in enumerate(row, start=1):
                writer.add_message(number, at, data, at)
        writer.finish()


def read_officially(path: Path) -> int:
    """The same columns with the official reader and decoder."""
    columns: dict[str, list[float]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            columns.setdefault(channel.topic, []).append(message.log_time)
            for field in decoded.DESCRIPTOR.fields:
                columns.setdefault(channel.topic + field.name, []).append(
                    getattr(decoded, field.name)
                )
    return len(columns)

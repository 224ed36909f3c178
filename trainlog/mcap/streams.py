"""From a trip's frames to the channels and message records of its log."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.mcap.channels import channel_of, schema_of
from trainlog.mcap.chunks import Stream
from trainlog.mcap.events import encode_events
from trainlog.mcap.fill import ListedRecords, Records
from trainlog.mcap.samples import Codec, fix_codec, sample_codec, table_of
from trainlog.mcap.schemas import WireField
from trainlog.topics import EVENTS, TOPICS, Topic, column_field
from trainlog.trip import Trip


def topics_of(trip: Trip) -> list[Topic]:
    """The topics that a trip has frames of, in the order of the table.

    Raises
    ------
    LogError
        If the table does not have one of them.
    """
    for name in trip.topics:
        known_topic(name)
    return [topic for topic in TOPICS.values() if topic.name in trip.topics]


def known_topic(name: str) -> Topic:
    """The topic called `name`; LogError if the table does not have it."""
    try:
        return TOPICS[name]
    except KeyError:
        raise LogError(
            f"there is no topic {name}", remedy=f"topics are {', '.join(TOPICS)}"
        ) from None


def stream_of(topic: Topic, frame: pd.DataFrame, number: int) -> Stream:
    """The stream of one frame; channel and schema are both called `number`.

    Raises
    ------
    LogError
        If the frame does not fit the table of topics, or its times run backwards.
    """
    time = _time(topic, frame)
    axles = _axles(topic, frame)
    records: Records
    if topic is EVENTS:
        records = ListedRecords(encode_events(number, frame))
    else:
        codec = codec_for(topic, number, axles)
        records = codec.encode(time, table_of(frame, codec.names))
    return Stream(channel_of(topic, number, number, axles), schema_of(topic, number), time, records)


def codec_for(topic: Topic, channel: int, axles: dict[str, int]) -> Codec:
    """How the messages of a topic's channel are laid out; not for events."""
    if topic.foxglove:
        return fix_codec(channel)
    fields = [
        WireField(field.name, at, field.per_axle) for at, field in enumerate(topic.fields, start=1)
    ]
    return sample_codec(channel, fields, axles)


def _time(topic: Topic, frame: pd.DataFrame) -> NDArray[np.int64]:
    """The frame's times [ns since 1970 UTC], checked."""
    index = frame.index
    if not isinstance(index, pd.DatetimeIndex) or index.tz is None:
        raise LogError(
            f"{topic.name} is not indexed by time with a time zone",
            remedy="build the frame with trainlog.trip.frame_of",
        )
    time = index.as_unit("ns").asi8
    if np.any(time < 0):
        row = int(np.argmax(time < 0))
        raise LogError(
            f"{topic.name} has no time, or one before 1970",
            place=f"row {row}",
            remedy="give every row its time",
        )
    if np.any(np.diff(time) < 0):
        row = int(np.argmax(np.diff(time) < 0)) + 1
        raise LogError(
            f"time of {topic.name} runs backwards to {index[row].isoformat()}",
            place=f"row {row}",
            remedy="sort the rows by time",
        )
    return time


def _axles(topic: Topic, frame: pd.DataFrame) -> dict[str, int]:
    """How many axles each field of the topic has in the frame, all columns checked."""
    if not frame.columns.is_unique:
        raise LogError(f"{topic.name} has a column twice", remedy="remove one of them")
    found: dict[str, set[int]] = {field.name: set() for field in topic.fields if field.per_axle}
    for column in map(str, frame.columns):
        try:
            field = column_field(topic, column)
        except KeyError:
            raise LogError(
                f"{topic.name} has no field for column {column}",
                remedy=f"its fields are {', '.join(field.name for field in topic.fields)}",
            ) from None
        if field.per_axle:
            found[field.name].add(int(column.rpartition("_")[2]))
    for name, numbers in found.items():
        if numbers != set(range(1, len(numbers) + 1)):
            raise LogError(
                f"{topic.name} has {name} for the axles {sorted(numbers)} only",
                remedy="number the axles from 1 without gaps",
            )
    return {name: len(numbers) for name, numbers in found.items()}

"""Channels: what a topic's stream looks like in a file, and how a file's channel is read.

A channel's metadata explains its fields to whoever opens the file: ``unit.<field>`` (SI),
``meaning.<field>`` and, for a field with one value for each powered axle, ``axles.<field>``, the
number of values in every message.
"""

from __future__ import annotations

import re

from mcap.records import Channel, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding

from trainlog.errors import LogError
from trainlog.mcap.errors import shown
from trainlog.mcap.samples import Codec, fix_codec, sample_codec
from trainlog.mcap.schemas import descriptor_set, is_location_fix, wire_fields
from trainlog.topics import EVENTS, TOPICS, Topic

UNIT, MEANING, AXLES = "unit.", "meaning.", "axles."
"""Prefixes of a channel's metadata keys."""

_MOST_AXLES = 4096
"""More values in one message are not believed; a message would pass 64 KiB."""


def schema_of(topic: Topic, schema_id: int) -> Schema:
    """The schema record of a topic."""
    return Schema(
        id=schema_id,
        name=topic.message,
        encoding=SchemaEncoding.Protobuf,
        data=descriptor_set(topic),
    )


def channel_of(topic: Topic, channel_id: int, schema_id: int, axles: dict[str, int]) -> Channel:
    """The channel record of a topic whose fields have that many axles."""
    metadata = {f"{UNIT}{field.name}": field.unit for field in topic.fields}
    metadata |= {f"{MEANING}{field.name}": field.meaning for field in topic.fields}
    metadata |= {f"{AXLES}{name}": str(count) for name, count in axles.items()}
    return Channel(
        id=channel_id,
        topic=topic.name,
        message_encoding=MessageEncoding.Protobuf,
        metadata=metadata,
        schema_id=schema_id,
    )


def topic_of(channel: Channel, schema: Schema | None) -> Topic | None:
    """The topic of trainlog's table that a file's channel carries; None if it is foreign."""
    topic = TOPICS.get(channel.topic)
    if topic is None or schema is None or schema.name != topic.message:
        return None
    encodings = (channel.message_encoding, schema.encoding)
    if encodings != (MessageEncoding.Protobuf, SchemaEncoding.Protobuf):
        return None
    return topic


def codec_of(channel: Channel, schema: Schema) -> Codec | None:
    """How to read the messages of a channel as arrays; None if only one by one.

    Raises
    ------
    LogError
        If the schema is broken, or the channel declares another unit than trainlog's table.
    """
    topic = TOPICS[channel.topic]
    for field in topic.fields:
        declared = channel.metadata.get(f"{UNIT}{field.name}", field.unit)
        if declared != field.unit:
            raise LogError(
                f"channel {topic.name} gives {field.name} in {shown(declared)}, "
                f"not in {shown(field.unit)}",
                remedy="bring it in as a recorded log, which converts units",
            )
    if topic is EVENTS:
        return None
    if topic.foxglove:
        return fix_codec(channel.id) if is_location_fix(schema) else None
    fields = wire_fields(schema)
    return None if fields is None else sample_codec(channel.id, fields, axles_of(channel))


def axles_of(channel: Channel) -> dict[str, int]:
    """How many values each repeated field of the channel has, as its metadata tell."""
    counts = {}
    for key, text in channel.metadata.items():
        if key.startswith(AXLES) and re.fullmatch(r"[0-9]{1,4}", text):
            counts[key.removeprefix(AXLES)] = min(int(text), _MOST_AXLES)
    return counts

"""Messages one by one: for files whose messages do not fit a layout, and for events.

This is the official protobuf decoder, with everything that it can raise on foreign bytes turned
into a `LogError`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory

from trainlog.mcap.codec import Columns, accuracies
from trainlog.mcap.errors import unusable
from trainlog.topics import EVENTS, GNSS_FIX, Topic

Decoder = Callable[[bytes], Any]
"""From a message's bytes to a protobuf message."""


def decoder_of(channel: Channel, schema: Schema) -> Decoder:
    """The protobuf decoder of a channel.

    Raises
    ------
    LogError
        If the schema is broken.
    """
    try:
        decoder = DecoderFactory().decoder_for(channel.message_encoding, schema)
    except (McapError, DecodeError, KeyError, TypeError, ValueError) as error:
        raise unusable(f"the schema of {channel.topic} cannot be used") from error
    if decoder is None:
        raise unusable(f"channel {channel.topic} does not hold protobuf messages")

    def decode(data: bytes) -> Any:
        try:
            return decoder(data)
        except DecodeError as error:
            raise unusable(f"a message of {channel.topic} is not a {schema.name}") from error

    return decode


def columns_of(topic: Topic, messages: Sequence[Any]) -> Columns:
    """The columns that decoded messages of a topic hold; absent values are NaN.

    Raises
    ------
    LogError
        If the messages have other kinds of fields than the topic.
    """
    read = {EVENTS.name: _events, GNSS_FIX.name: _fixes}.get(topic.name)
    try:
        return read(messages) if read else _samples(topic, messages)
    except (AttributeError, TypeError, ValueError) as error:
        raise unusable(
            f"messages of {topic.name} do not have the fields of {topic.message}"
        ) from error


def _samples(topic: Topic, messages: Sequence[Any]) -> Columns:
    found: Columns = {}
    declared = messages[0].DESCRIPTOR.fields_by_name if messages else {}
    for field in topic.fields:
        if field.name not in declared:
            continue
        if field.per_axle:
            lists = [getattr(message, field.name) for message in messages]
            table = np.full((len(lists), max(len(values) for values in lists)), np.nan)
            for row, values in zip(table, lists, strict=True):
                row[: len(values)] = values
            found |= {f"{field.name}_{axle + 1}": column for axle, column in enumerate(table.T)}
        else:
            told = declared[field.name].has_presence
            found[field.name] = np.array(
                [
                    getattr(message, field.name)
                    if not told or message.HasField(field.name)
                    else np.nan
                    for message in messages
                ],
                dtype=np.float64,
            )
    return found


def _fixes(messages: Sequence[Any]) -> Columns:
    table = np.full((len(messages), 7), np.nan)
    for row, fix in zip(table, messages, strict=True):
        row[:4] = fix.latitude, fix.longitude, fix.altitude, fix.position_covariance_type
        if len(fix.position_covariance) == 9:
            row[4:] = fix.position_covariance[::4]
    latitude, longitude, altitude, kind, east, north, up = table.T
    found: Columns = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
    return found | accuracies(kind, east, north, up)


def _events(messages: Sequence[Any]) -> Columns:
    return {
        "level": np.array([message.level for message in messages], dtype=np.int64),
        "message": pd.array([message.message for message in messages], dtype="str"),
        "name": pd.array([message.name for message in messages], dtype="str"),
    }

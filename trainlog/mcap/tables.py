"""From the chunks of a log to the frames of its topics.

Messages that fit the layout of their channel go to the columns of a table as arrays; others (of
other programs, and events) are decoded one by one by the official decoder and joined to it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from mcap.records import Channel, Schema

from trainlog.arrays import UintArray
from trainlog.errors import LogError
from trainlog.mcap.codec import LOG_TIME, Codec, Columns, accuracies, codec_of, gather, topic_of
from trainlog.mcap.contents import ChunkPlace, Contents, MisplacedError, fetched, fetched_index
from trainlog.mcap.foreign import BrokenMessage, Decode, Message, UndecodableError, decoder_of
from trainlog.mcap.records import Index, Source, gone_through, message_data, opened, unusable
from trainlog.topics import EVENTS, GNSS_FIX, TOPICS, Topic, attributes, column_field
from trainlog.trip import frame_of

Wanted = Mapping[str, frozenset[str] | None] | None
"""Columns to read by topic, None for all of a topic; None for all topics."""


@dataclass
class TopicChannel:
    """A channel of a file that carries one of trainlog's topics.

    Attributes
    ----------
    channel, schema
        As the file has them.
    topic : Topic
    """

    channel: Channel
    schema: Schema
    topic: Topic

    @cached_property
    def codec(self) -> Codec | None:
        """How to read its messages as arrays; None if only one by one."""
        return codec_of(self.channel, self.schema)

    @cached_property
    def columns(self) -> list[str]:
        """The columns that its messages have if they fit the layout."""
        if self.codec is None:
            return []
        return list(self.codec.columns(self.codec.layout.rows(0)) or {})

    @cached_property
    def _decode(self) -> Decode:
        try:
            return decoder_of(self.channel, self.schema)
        except UndecodableError as error:
            raise unusable(f"the schema of {self.topic.name} cannot be used") from error

    def arrays(self, content: bytes, offsets: UintArray) -> tuple[UintArray, Columns] | None:
        """Times and columns of messages of a chunk; None if they do not fit the layout."""
        if self.codec is None:
            return None
        rows = gather(content, offsets, self.codec.layout)
        columns = None if rows is None else self.codec.columns(rows)
        return None if rows is None or columns is None else (rows[LOG_TIME], columns)

    def decoded(self, content: bytes, offsets: UintArray, chunk: int) -> tuple[UintArray, Columns]:
        """Times and columns of messages in the chunk at byte `chunk`, decoded one by one.

        Raises
        ------
        MisplacedError
            If one is not where it should be.
        LogError
            If one is not what the channel says.
        """
        times, messages = [], []
        for offset in offsets.tolist():
            found = message_data(content, offset, self.channel.id)
            if found is None:
                raise MisplacedError(
                    f"a message of {self.topic.name} is not where it should be",
                    place=f"byte {chunk}",
                )
            times.append(found[0])
            try:
                messages.append(self._decode(found[1]))
            except BrokenMessage as error:
                problem = f"a message of {self.topic.name} is not a {self.schema.name}"
                raise unusable(problem) from error
        return np.array(times, dtype=np.uint64), _columns_of(self.topic, messages)


def topic_channels(contents: Contents) -> list[TopicChannel]:
    """The channels that carry topics of trainlog."""
    found = []
    for channel in contents.channels.values():
        schema = contents.schema(channel)
        topic = topic_of(channel, schema)
        if topic is not None and schema is not None:
            found.append(TopicChannel(channel, schema, topic))
    return found


class _Table:
    """The rows of one topic, in the order in which their messages stand in the file.

    Parameters
    ----------
    topic : Topic
    declared : set of str
        Columns that the topic's channels declare; those of a topic without rows.
    rows : int
        How many are expected.
    wanted : frozenset of str or None
        Columns asked for; None for all.
    """

    def __init__(
        self, topic: Topic, declared: set[str], rows: int, wanted: frozenset[str] | None
    ) -> None:
        self.topic = topic
        self.wanted = wanted
        self._declared = declared
        self._rows = 0
        self._time = np.empty(rows, dtype=np.uint64)
        self._names: list[str] = []
        self._table = np.empty((0, rows))
        self._texts: list[Columns] = []

    def add(self, time: UintArray, columns: Columns) -> None:
        """Add messages."""
        start, self._rows = self._rows, self._rows + len(time)
        if self._rows > len(self._time):
            self._time = np.pad(self._time, (0, self._rows - len(self._time)))
        self._time[start : self._rows] = time
        if self.topic is EVENTS:
            self._texts.append(columns)
            return
        self._hold(columns.keys())
        for row, name in zip(self._table, self._names, strict=True):
            row[start : self._rows] = columns.get(name, np.nan)

    def _hold(self, columns: Iterable[str]) -> None:
        """Have space for some columns and for those that every message has."""
        every = {item.name for item in self.topic.fields if not item.per_axle}
        new = self._in_order((every | {*columns}) - {*self._names})
        if not self._names:
            self._table = np.empty((len(new), len(self._time)))
        elif new or len(self._time) > self._table.shape[1]:
            more = (0, len(new)), (0, len(self._time) - self._table.shape[1])
            self._table = np.pad(self._table, more, constant_values=np.nan)
        self._names += new

    def frame(self) -> pd.DataFrame:
        """The topic's frame, in the order of time.

        Raises
        ------
        LogError
            If a time is beyond those that pandas has.
        """
        time = self._time[: self._rows]
        if len(time) and time.max() > np.uint64(pd.Timestamp.max.value):
            raise unusable(f"{self.topic.name} has times after {pd.Timestamp.max.year}")
        order = None
        if np.any(time[1:] < time[:-1]):
            order = np.argsort(time, kind="stable")
            time = time[order]
        index = pd.DatetimeIndex(time.view("M8[ns]"), tz="UTC", name="time")
        if self.topic is EVENTS:
            texts = self._texts or [_columns_of(EVENTS, [])]
            joined: dict[str, Any] = {
                name: pd.concat([pd.Series(each[name]) for each in texts], ignore_index=True).array
                for name in texts[0]
            }
            if order is not None:
                joined = {name: values[order] for name, values in joined.items()}
            frame = frame_of(self.topic, index, joined)
            frame = frame[self._in_order(frame.columns)]
        else:
            self._hold(() if self._rows else self._declared)
            table = self._table[:, : self._rows]
            names = self._in_order(self._names)
            if names != self._names:
                table = table[[self._names.index(name) for name in names]]
            table = table if order is None else table[:, order]
            frame = pd.DataFrame(table.T, index=index, columns=names, copy=False)
        frame.attrs = attributes(self.topic, frame.columns)
        return frame

    def _in_order(self, names: Iterable[str]) -> list[str]:
        """Those of the names that are columns of the topic and asked for, in the frame's order."""
        numbers = {item.name: number for number, item in enumerate(self.topic.fields)}
        places = {}
        for name in names:
            with suppress(KeyError):
                item = column_field(self.topic, name)
                axle = int(name.rpartition("_")[2]) if item.per_axle else 0
                places[name] = (numbers[item.name], axle)
        ordered = sorted(places, key=places.__getitem__)
        return [name for name in ordered if self.wanted is None or name in self.wanted]


def frames_in(
    source: Source, contents: Contents, chunks: Sequence[ChunkPlace], columns: Wanted
) -> dict[str, pd.DataFrame]:
    """The frames of some topics as far as the chunks hold them, in the order of the table.

    Damaged chunks are dropped from `contents`.

    Raises
    ------
    LogError
        If messages are not what their channel says.
    MisplacedError
        If something is not as the summary says by which `contents` was found.
    """
    channels = {
        each.channel.id: each
        for each in topic_channels(contents)
        if columns is None or each.topic.name in columns
    }
    work = [place for place in chunks if not channels.keys().isdisjoint(place.counts)]
    tables = _tables(channels.values(), work, columns)
    for place in work:
        found = _read(source, place, channels)
        if isinstance(found, str):
            if contents.indexed:
                raise MisplacedError(found, place=f"byte {place.offset}")
            contents.drop(place, found)
            continue
        for number, time, values in found:
            tables[channels[number].topic.name].add(time, values)
    return {name: tables[name].frame() for name in sorted(tables, key=_place)}


def _place(topic: str) -> tuple[int, str]:
    """Where a topic stands among the frames: by the table, a recorder's own behind it."""
    return (list(TOPICS).index(topic), "") if topic in TOPICS else (len(TOPICS), topic)


def _tables(
    channels: Iterable[TopicChannel], chunks: Sequence[ChunkPlace], wanted: Wanted
) -> dict[str, _Table]:
    """An empty table for each topic that has a channel, with space for its messages."""
    counts: Counter[int] = Counter()
    for place in chunks:
        counts.update(place.counts)
    by_topic: dict[str, list[TopicChannel]] = {}
    for each in channels:
        by_topic.setdefault(each.topic.name, []).append(each)
    tables = {}
    for name, sources in by_topic.items():
        topic = sources[0].topic
        fields = {field.name: field for each in reversed(sources) for field in each.topic.fields}
        more = [field for field in fields.values() if field not in topic.fields]
        if fields.keys() != {field.name for field in topic.fields}:
            topic = replace(topic, fields=(*topic.fields, *more))
        rows = sum(counts[each.channel.id] for each in sources)
        asked = None if wanted is None else wanted[name]
        declared = {column for each in sources for column in each.columns}
        tables[name] = _Table(topic, declared, rows, asked)
    return tables


_Found = list[tuple[int, UintArray, Columns]]
"""Channel, times and columns of messages."""


def _read(source: Source, place: ChunkPlace, channels: Mapping[int, TopicChannel]) -> _Found | str:
    """The messages of some channels in a chunk, or what is wrong with it."""
    try:
        chunk = fetched(source, place)
        content = opened(chunk, place.offset)
    except LogError as error:
        return error.problem
    ours = [channels[number] for number in place.counts if number in channels]
    try:
        with suppress(LogError):
            index = fetched_index(source, place, [each.channel.id for each in ours])
            # An index that leads to one message twice leaves out another.
            if index and all(np.all(each[1:, 1] > each[:-1, 1]) for each in index.values()):
                return _pieces(content, index, place, ours)
        # An index that does not fit the chunk is made again from the chunk's records.
        return _pieces(content, gone_through(content, place.offset)[0], place, ours)
    except LogError as error:
        if chunk.uncompressed_crc and not isinstance(error, MisplacedError):
            # These are the bytes that were written.
            raise
        return error.problem


def _pieces(
    content: bytes, index: Index, place: ChunkPlace, channels: Sequence[TopicChannel]
) -> _Found:
    """The messages of the channels; those that do not fit their layout are decoded one by one."""
    found: _Found = []
    for each in channels:
        number = each.channel.id
        offsets = index[number][:, 1] if number in index else _NOWHERE
        piece = each.arrays(content, offsets)
        found.append((number, *(piece or each.decoded(content, offsets, place.offset))))
    return found


_NOWHERE: UintArray = np.empty(0, dtype=np.uint64)


def _columns_of(topic: Topic, messages: Sequence[Message]) -> Columns:
    """The columns that decoded messages of a topic hold; absent values are NaN.

    Raises
    ------
    LogError
        If the messages have other kinds of fields than the topic.
    """
    read = {EVENTS.name: _events, GNSS_FIX.name: _fixes}.get(topic.name)
    try:
        return read(messages) if read else _samples(topic, messages)
    except (KeyError, TypeError, ValueError) as error:
        raise unusable(
            f"messages of {topic.name} do not have the fields of {topic.message}"
        ) from error


def _samples(topic: Topic, messages: Sequence[Message]) -> Columns:
    found: Columns = {}
    for field in topic.fields:
        values = [message.get(field.name) for message in messages]
        if field.per_axle:
            lists = [each or [] for each in values]
            table = np.full((len(lists), max(map(len, lists), default=0)), np.nan)
            for row, each in zip(table, lists, strict=True):
                row[: len(each)] = each
            found |= {f"{field.name}_{axle + 1}": column for axle, column in enumerate(table.T)}
        else:
            found[field.name] = np.array(values, dtype=np.float64)
    return found


def _fixes(messages: Sequence[Message]) -> Columns:
    table = np.full((len(messages), 7), np.nan)
    names = ("latitude", "longitude", "altitude", "position_covariance_type")
    for row, fix in zip(table, messages, strict=True):
        row[:4] = [fix[name] for name in names]
        if len(fix["position_covariance"]) == 9:
            row[4:] = fix["position_covariance"][::4]
    latitude, longitude, altitude, kind, east, north, up = table.T
    found: Columns = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
    return found | accuracies(kind, east, north, up)


def _events(messages: Sequence[Message]) -> Columns:
    return {
        "level": np.array([message["level"] for message in messages], dtype=np.int64),
        "message": pd.array([message["message"] for message in messages], dtype="str"),
        "name": pd.array([message["name"] for message in messages], dtype="str"),
    }

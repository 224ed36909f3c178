"""From the chunks of a log to the frames of its topics, by several threads.

Messages that fit the layout of their channel go to the columns of a table as arrays; others (of
other programs, and events) are decoded one by one by the official decoder and joined to it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field as dataclass_field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory

from trainlog.arrays import FloatArray, UintArray
from trainlog.errors import LogError
from trainlog.mcap.codec import LOG_TIME, Codec, Columns, accuracies, codec_of, gather, topic_of
from trainlog.mcap.index import ChunkPlace, Contents, MisplacedError, fetched, fetched_index
from trainlog.mcap.records import Index, Source, index_of, message_data, opened, unusable
from trainlog.topics import EVENTS, GNSS_FIX, TOPICS, Topic, attributes, column_field
from trainlog.trip import frame_of

_AT_ONCE = 4
"""Chunks that a thread is given at a time."""

Wanted = Mapping[str, frozenset[str] | None] | None
"""Columns to read by topic, None for all of a topic; None for all topics."""

_Offsets = UintArray | None
"""Where in a chunk messages begin; None where they follow each other and fill the chunk."""


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
    def _decoder(self) -> Callable[[bytes], Any]:
        return _decoder_of(self.channel, self.schema)

    def arrays(self, content: bytes, offsets: _Offsets) -> tuple[UintArray, Columns] | None:
        """Times and columns of messages of a chunk; None if they do not fit the layout."""
        if self.codec is None:
            return None
        form = self.codec.layout
        if offsets is not None:
            rows = gather(content, offsets, form)
        else:
            every = np.frombuffer(content, dtype=form.record)
            rows = every if form.matches(every) else None
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
            messages.append(self._decoder(found[1]))
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


@dataclass
class _Part:
    """The messages of one channel in a chunk: `count` rows of a table from `start` on.

    Attributes
    ----------
    source : TopicChannel
    table : _Table
    start, count : int
    separate : (times, columns) or None
        Where they do not fit into the table's arrays; `_LOST` where nothing could be read.
    """

    source: TopicChannel
    table: _Table
    start: int
    count: int
    separate: tuple[UintArray, Columns] | None = None


_LOST: tuple[UintArray, Columns] = np.empty(0, dtype=np.uint64), {}


@dataclass
class _Table:
    """The rows of one topic, in the order in which their messages stand in the file.

    Attributes
    ----------
    topic : Topic
    wanted : frozenset of str or None
        Columns asked for; None for all.
    names : list of str
        Columns, in the order of the frame.
    time : (n,) uint64
    columns : (columns, n) float64
        Not of events, whose texts are separate.
    parts : list of _Part
        In the order of their rows.
    """

    topic: Topic
    wanted: frozenset[str] | None
    names: list[str]
    time: UintArray
    columns: FloatArray
    parts: list[_Part] = dataclass_field(default_factory=list)

    def fill(self, start: int, count: int, time: UintArray, columns: Columns) -> bool:
        """Take messages to the rows from `start` on; False if the table has no place for them.

        Safe to be called from several threads, each for its own rows.
        """
        if len(time) != count:
            return False
        part = slice(start, start + count)
        self.time[part] = time
        for number, name in enumerate(self.names):
            self.columns[number, part] = columns.get(name, np.nan)
        return True

    def frame(self) -> pd.DataFrame:
        """The topic's frame, in the order of time.

        Raises
        ------
        LogError
            If a time is beyond those that pandas has.
        """
        time, names, columns = self._joined()
        if len(time) and time.max() > np.uint64(pd.Timestamp.max.value):
            raise unusable(f"{self.topic.name} has times after {pd.Timestamp.max.year}")
        stamps = time.view(np.int64)
        if np.any(stamps[1:] < stamps[:-1]):
            order = np.argsort(stamps, kind="stable")
            stamps = stamps[order]
            columns = (
                columns[:, order]
                if isinstance(columns, np.ndarray)
                else {name: values[order] for name, values in columns.items()}
            )
        index = pd.DatetimeIndex(stamps.view("M8[ns]"), tz="UTC", name="time")
        if isinstance(columns, np.ndarray):
            frame = pd.DataFrame(columns.T, index=index, columns=names, copy=False)
        else:
            frame = frame_of(self.topic, index, columns)
            frame = frame[self.in_order(frame.columns)]
        frame.attrs = attributes(self.topic, frame.columns)
        return frame

    def _joined(
        self,
    ) -> tuple[UintArray, list[str], FloatArray | dict[str, Any]]:
        """Times and columns with what is separate in its place."""
        events = self.topic is EVENTS
        if not events and all(part.separate is None for part in self.parts):
            return self.time, self.names, self.columns
        parts: list[tuple[UintArray, Columns]] = []
        for part in self.parts:
            rows = slice(part.start, part.start + part.count)
            held = dict(zip(self.names, self.columns[:, rows], strict=True))
            parts.append(part.separate or (self.time[rows], held))
        parts = [part for part in parts if part is not _LOST]
        time = np.concatenate([np.empty(0, np.uint64), *(each for each, _ in parts)])
        if events:
            texts = [columns for _, columns in parts] or [_columns_of(EVENTS, [])]
            joined = {
                name: pd.concat([pd.Series(each[name]) for each in texts], ignore_index=True).array
                for name in texts[0]
            }
            return time, self.names, joined
        names = self.in_order(
            {item.name for item in self.topic.fields if not item.per_axle}
            | {name for _, each in parts for name in each}
        )
        table = np.full((len(names), len(time)), np.nan)
        at = 0
        for times, values in parts:
            for number, name in enumerate(names):
                if name in values:
                    table[number, at : at + len(times)] = values[name]
            at += len(times)
        return time, names, table

    def in_order(self, names: Iterable[str]) -> list[str]:
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
    source: Source,
    contents: Contents,
    chunks: Sequence[ChunkPlace],
    columns: Wanted,
    threads: int,
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
    tables = _tables(channels.values(), chunks, columns)
    work = _work(chunks, channels, tables)
    for (place, parts), damage in zip(work, _damages(source, work, threads), strict=True):
        if damage is not None:
            if contents.indexed:
                raise MisplacedError(damage, place=f"byte {place.offset}")
            contents.drop(place, damage)
            for part in parts:
                part.separate = _LOST
    return {name: tables[name].frame() for name in sorted(tables, key=_place)}


def _place(topic: str) -> tuple[int, str]:
    """Where a topic stands among the frames: by the table, a recorder's own behind it."""
    return (list(TOPICS).index(topic), "") if topic in TOPICS else (len(TOPICS), topic)


def _tables(
    channels: Iterable[TopicChannel],
    chunks: Sequence[ChunkPlace],
    wanted: Wanted,
) -> dict[str, _Table]:
    """An empty table for each topic that has a channel."""
    counts: Counter[int] = Counter()
    sizes: Counter[int] = Counter()
    for place in chunks:
        counts.update(place.counts)
        sizes.update(dict.fromkeys(place.counts, place.size))
    by_topic: dict[str, list[TopicChannel]] = {}
    for each in channels:
        by_topic.setdefault(each.topic.name, []).append(each)
    tables = {}
    for name, sources in by_topic.items():
        # A layout whose messages would not fit into the chunks has another number of axles.
        columns = {
            column
            for each in sources
            if each.codec is not None
            and each.codec.layout.size * counts[each.channel.id] <= sizes[each.channel.id]
            for column in each.columns
        }
        rows = sum(counts[each.channel.id] for each in sources)
        asked = None if wanted is None else wanted[name]
        tables[name] = _empty_table(_joint_topic(sources), columns, rows, asked)
    return tables


def _joint_topic(sources: Sequence[TopicChannel]) -> Topic:
    """The topic that several channels carry, with the fields of all of them."""
    topic = sources[0].topic
    fields = {field.name: field for each in reversed(sources) for field in each.topic.fields}
    if fields.keys() == {field.name for field in topic.fields}:
        return topic
    more = [field for name, field in fields.items() if field not in topic.fields]
    return replace(topic, fields=(*topic.fields, *more))


def _empty_table(topic: Topic, held: set[str], rows: int, wanted: frozenset[str] | None) -> _Table:
    """A table for so many messages of a topic, whose channels hold these columns."""
    table = _Table(topic, wanted, [], np.empty(rows, dtype=np.uint64), np.empty((0, 0)))
    if topic is not EVENTS:
        table.names = table.in_order(
            held | {item.name for item in topic.fields if not item.per_axle}
        )
        table.columns = np.empty((len(table.names), rows))
    return table


def _work(
    chunks: Sequence[ChunkPlace], channels: dict[int, TopicChannel], tables: dict[str, _Table]
) -> list[tuple[ChunkPlace, list[_Part]]]:
    """The chunks that hold any of the channels, each with the rows that its messages take."""
    filled = dict.fromkeys(tables, 0)
    work = []
    for place in chunks:
        parts = []
        for number, count in place.counts.items():
            if number in channels:
                name = channels[number].topic.name
                parts.append(_Part(channels[number], tables[name], filled[name], count))
                tables[name].parts.append(parts[-1])
                filled[name] += count
        if parts:
            work.append((place, parts))
    return work


def _damages(
    source: Source, work: list[tuple[ChunkPlace, list[_Part]]], threads: int
) -> Iterator[str | None]:
    """Fill the tables from chunks; for each in order what is wrong with it, None if nothing is."""
    if threads == 1 or len(work) == 1:
        yield from (_read(source, *each) for each in work)
        return
    batches = [work[at : at + _AT_ONCE] for at in range(0, len(work), _AT_ONCE)]
    with ThreadPoolExecutor(threads) as pool:
        try:
            for batch in pool.map(lambda batch: [_read(source, *each) for each in batch], batches):
                yield from batch
        finally:
            pool.shutdown(cancel_futures=True)


def _read(source: Source, place: ChunkPlace, parts: list[_Part]) -> str | None:
    """Fill the tables from one chunk; what is wrong with it, None if nothing is."""
    try:
        chunk = fetched(source, place)
        content = opened(chunk, check=True)
    except LogError as error:
        return error.problem
    try:
        with suppress(LogError):
            _fill(content, _offsets(source, place, content, parts), place, parts)
            return None
        # An index that does not fit the chunk is made again from the chunk's records.
        _fill(content, _starts(index_of(content, place.offset)), place, parts)
    except LogError as error:
        if chunk.checksum and not isinstance(error, MisplacedError):
            # These are the bytes that were written.
            raise
        return error.problem
    return None


def _starts(index: Index) -> dict[int, _Offsets]:
    return {channel: entries[:, 1] for channel, entries in index.items()}


def _offsets(
    source: Source, place: ChunkPlace, content: bytes, parts: list[_Part]
) -> dict[int, _Offsets]:
    """Where in the chunk the messages of the parts begin, by channel id."""
    sole = parts[0]
    size = sole.source.codec.layout.size if sole.source.codec is not None else 0
    if len(place.counts) == 1 and size * sole.count == len(content):
        return {sole.source.channel.id: None}
    if place.indexes:
        index = _starts(fetched_index(source, place, [part.source.channel.id for part in parts]))
        # An index that leads to one message twice leaves out another.
        if all(bool(np.all(each[1:] > each[:-1])) for each in index.values() if each is not None):
            return index
    return _starts(index_of(content, place.offset))


def _fill(
    content: bytes, index: dict[int, _Offsets], place: ChunkPlace, parts: list[_Part]
) -> None:
    """Take the messages of a chunk to their tables; those that do not fit are separate."""
    for part in parts:
        number = part.source.channel.id
        offsets = index.get(number, np.empty(0, dtype=np.uint64))
        part.separate = part.source.arrays(content, offsets)
        if part.separate is not None and part.table.fill(part.start, part.count, *part.separate):
            part.separate = None
        elif part.separate is None:
            if offsets is None:
                index = _starts(index_of(content, place.offset))
                offsets = index.get(number)
            each = np.empty(0, dtype=np.uint64) if offsets is None else offsets
            part.separate = part.source.decoded(content, each, place.offset)


def _decoder_of(channel: Channel, schema: Schema) -> Callable[[bytes], Any]:
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


def _columns_of(topic: Topic, messages: Sequence[Any]) -> Columns:
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
            optional = declared[field.name].has_presence
            found[field.name] = np.array(
                [
                    getattr(message, field.name)
                    if not optional or message.HasField(field.name)
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

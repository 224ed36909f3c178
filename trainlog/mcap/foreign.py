"""Any MCAP file as frames: whoever wrote it, in whichever encoding, as far as it can be read."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.mcap.account import Account
from trainlog.mcap.codec import MESSAGE, RECORD_HEAD
from trainlog.mcap.contents import contents_of
from trainlog.mcap.errors import in_file, shown
from trainlog.mcap.foreign_columns import Columns
from trainlog.mcap.foreign_decoders import UndecodableError, decoder_of
from trainlog.mcap.foreign_rows import BrokenMessage, Decode
from trainlog.mcap.places import ChunkPlace, Contents
from trainlog.mcap.reader import check_data_section, report_losses
from trainlog.mcap.records import Index, index_of, opened
from trainlog.mcap.source import Source
from trainlog.mcap.stored import MisplacedError, fetched
from trainlog.mcap.walk import contents_by_walk

_MOST_NAMED = 8
"""Topics that an error names."""

_LAST = pd.Timestamp.max
"""The last time that an index can hold."""

_LATEST = _LAST.value


@dataclass(frozen=True)
class Skipped:
    """Something of a topic that is not in its frame.

    Attributes
    ----------
    topic : str
    field : str
        Path of the field; empty if whole messages are meant.
    reason : str
    messages : int
        In how many messages.
    """

    topic: str
    field: str
    reason: str
    messages: int

    def __str__(self) -> str:
        place = f"{self.topic}.{self.field}" if self.field else self.topic
        return f"{place}: {self.reason} ({self.messages:,} messages)"


@dataclass(frozen=True, eq=False)
class ForeignFrames:
    """What an MCAP file holds, by topic.

    Attributes
    ----------
    frames : dict of str to DataFrame
        By topic, with the log time (UTC, ns) as index, in its order; one column a field, named by
        its path (``pose.position.x``, ``covariance[0]``). ``attrs`` hold ``schema`` and
        ``encoding``. A topic with several schemas has one frame each, ``"/topic (schema)"``.
    publish_times : dict of str to DatetimeIndex
        When each row of a frame was published, as the file says.
    account : Account
        What of the file is readable, and what is lost.
    skipped : tuple of Skipped
        What is not in the frames: channels and messages that cannot be decoded, and fields that do
        not become columns.
    """

    frames: dict[str, pd.DataFrame]
    publish_times: dict[str, pd.DatetimeIndex]
    account: Account
    skipped: tuple[Skipped, ...] = ()


def frames_of(path: str | Path, topics: Iterable[str] | None = None) -> ForeignFrames:
    """Read the frames of any MCAP file, whoever wrote it.

    Messages in protobuf, JSON, ROS 1, ROS 2 (CDR) and FlatBuffers are decoded. What cannot be
    decoded is named and counted, the rest still comes. Of a damaged file everything readable comes,
    with a `DamageWarning`.

    Parameters
    ----------
    path : path
    topics : iterable of str, optional
        Topics to read. Default: all.

    Returns
    -------
    ForeignFrames
        With a frame, without rows if need be, for every channel whose encoding is known.

    Raises
    ------
    LogError
        If it is no MCAP file, or has no topic of a name that is asked for.
    InputError
        If there is no such file.
    """
    with Source(path) as source, in_file(path):
        contents = contents_of(source)
        try:
            found = _frames(source, contents, _wanted(contents, topics))
            if topics is None:
                check_data_section(source, contents)
        except MisplacedError:
            contents = contents_by_walk(source)
            found = _frames(source, contents, _wanted(contents, topics))
    report_losses(path, contents)
    return replace(found, account=contents.account)


def _wanted(contents: Contents, topics: Iterable[str] | None) -> list[Channel]:
    channels = list(contents.channels.values())
    if topics is None:
        return channels
    asked = {topics} if isinstance(topics, str) else set(topics)
    held = sorted({channel.topic for channel in channels})
    for name in sorted(asked - set(held)):
        named = ", ".join(shown(topic) for topic in held[:_MOST_NAMED]) or "none at all"
        more = f" and {len(held) - _MOST_NAMED} more" if len(held) > _MOST_NAMED else ""
        raise LogError(f"holds no topic {shown(name)}", remedy=f"topics are {named}{more}")
    return [channel for channel in channels if channel.topic in asked]


@dataclass(eq=False)
class _Table:
    """A topic's messages while they are being read."""

    topic: str
    schema: str
    encoding: str
    decode: Decode
    time: list[int] = field(default_factory=list)
    published: list[int] = field(default_factory=list)
    columns: Columns = field(default_factory=Columns)
    broken: Counter[str] = field(default_factory=Counter)

    def add(self, content: bytes, offset: int) -> None:
        """Add the message that stands at `offset` of a chunk, or count it as broken."""
        try:
            _, length, _, _, time, published = MESSAGE.unpack_from(content, offset)
            if length < MESSAGE.size - RECORD_HEAD:
                raise BrokenMessage("its record is too short")
            if time > _LATEST or published > _LATEST:
                raise BrokenMessage(f"its time is after {_LAST.year}")
            message = self.decode(content[offset + MESSAGE.size : offset + RECORD_HEAD + length])
        except struct.error:
            self.broken["its record is too short"] += 1
        except BrokenMessage as error:
            self.broken[str(error)] += 1
        else:
            self.columns.add(message, length)
            self.time.append(time)
            self.published.append(published)

    def frame(self) -> tuple[pd.DataFrame, pd.DatetimeIndex]:
        """The frame in the order of log time, and the publish times of its rows."""
        time = np.array(self.time, dtype=np.int64)
        frame = pd.DataFrame(self.columns.frame(), index=_index(time))
        published = np.array(self.published, dtype=np.int64)
        if np.any(np.diff(time) < 0):
            order = np.argsort(time, kind="stable")
            frame, published = frame.iloc[order], published[order]
        frame.attrs = {"schema": self.schema, "encoding": self.encoding}
        return frame, _index(published)

    def skipped(self, name: str) -> list[Skipped]:
        """What of the topic is not in the frame."""
        whole = [Skipped(name, "", reason, count) for reason, count in self.broken.items()]
        return whole + [
            Skipped(name, path, reason, count)
            for (path, reason), count in self.columns.skipped.items()
        ]


def _frames(source: Source, contents: Contents, channels: list[Channel]) -> ForeignFrames:
    """The frames of the channels; chunks that turn out damaged are dropped from the contents.

    Raises
    ------
    MisplacedError
        If the summary by which the contents were found turns out to be wrong.
    """
    by_channel, skipped = _tables(contents, channels)
    for place in list(contents.chunks):
        if place.counts.keys().isdisjoint(by_channel):
            continue
        try:
            content, index = _opened(source, place)
        except LogError as error:
            if contents.indexed and isinstance(error, MisplacedError):
                raise
            contents.drop(place, error.problem)
            continue
        if contents.indexed and place.counts != {each: len(at) for each, at in index.items()}:
            raise MisplacedError("the summary counts other messages", place=f"byte {place.offset}")
        for channel, entries in index.items():
            if channel in by_channel:
                table = by_channel[channel]
                for offset in entries[:, 1].tolist():
                    table.add(content, offset)
    frames, published = {}, {}
    for name, table in _named(by_channel.values()):
        frames[name], published[name] = table.frame()
        skipped += table.skipped(name)
    return ForeignFrames(frames, published, contents.account, tuple(skipped))


def _tables(contents: Contents, channels: list[Channel]) -> tuple[dict[int, _Table], list[Skipped]]:
    """Where the messages of each channel go, and the channels that cannot be decoded."""
    counts = contents.counts()
    tables: dict[tuple[object, ...], _Table] = {}
    by_channel: dict[int, _Table] = {}
    skipped = []
    for channel in channels:
        schema = contents.schema(channel)
        key = _kind(channel, schema)
        try:
            if key not in tables:
                name = schema.name if schema else ""
                decode = decoder_of(channel, schema)
                tables[key] = _Table(channel.topic, name, channel.message_encoding, decode)
            by_channel[channel.id] = tables[key]
        except UndecodableError as error:
            skipped.append(Skipped(channel.topic, "", str(error), counts[channel.id]))
    return by_channel, skipped


def _opened(source: Source, place: ChunkPlace) -> tuple[bytes, Index]:
    """The content of a chunk and, by its own records, where its messages are."""
    content = opened(fetched(source, place), check=True)
    return content, index_of(content, place.offset)


def _kind(channel: Channel, schema: Schema | None) -> tuple[object, ...]:
    """What the channels of one frame have in common."""
    of_schema = (schema.name, schema.encoding, schema.data) if schema else None
    return channel.topic, channel.message_encoding, of_schema


def _named(tables: Iterable[_Table]) -> Iterator[tuple[str, _Table]]:
    """The tables by topic; where a topic has several, by topic and schema."""
    listed = list(dict.fromkeys(tables))
    topics = Counter(table.topic for table in listed)
    names: Counter[str] = Counter()
    for table in listed:
        name = table.topic
        if topics[name] > 1:
            name = f"{name} ({table.schema or table.encoding})"
        names[name] += 1
        yield (f"{name} {names[name]}" if names[name] > 1 else name), table


def _index(time: NDArray[np.int64]) -> pd.DatetimeIndex:
    return pd.DatetimeIndex(time.view("M8[ns]"), tz="UTC")

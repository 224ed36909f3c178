"""Reading a trip from an MCAP file."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Container, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from isal import isal_zlib
from mcap.records import Channel, Metadata, Schema
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.mcap.account import DamageWarning, Loss
from trainlog.mcap.channels import codec_of, topic_of
from trainlog.mcap.contents import contents_of
from trainlog.mcap.decode import Decoder, columns_of, decoder_of
from trainlog.mcap.errors import in_file, shown, unusable
from trainlog.mcap.layout import LOG_TIME, gather
from trainlog.mcap.names import FORMAT_RECORD, PROVENANCE_RECORD, TRIP_RECORD
from trainlog.mcap.places import AttachmentPlace, ChunkPlace, Contents
from trainlog.mcap.records import Index, index_of, message_data, opened
from trainlog.mcap.samples import Codec, Columns
from trainlog.mcap.source import Source
from trainlog.mcap.stored import MisplacedError, attachment_data, fetched, fetched_index
from trainlog.mcap.walk import contents_by_walk
from trainlog.topics import EVENTS, SCHEMA_VERSION, TOPICS, Topic, column_field
from trainlog.trip import Trip, frame_of

_PIECE = 2**22
"""Read at once for the checksum of the data section [bytes]."""

_MOST_NAMED = 8
"""Topics of a foreign file that an error names."""


def read_log(path: str | Path, topics: Iterable[str] | None = None) -> Trip:
    """Read a trip from an MCAP file.

    Of a damaged file everything that is readable comes back, with a `DamageWarning` that carries
    the account of what is lost.

    Parameters
    ----------
    path : path
    topics : iterable of str, optional
        Topics to read; the others are neither decompressed nor decoded. Default: all. A topic that
        the file does not have is left out.

    Returns
    -------
    Trip
        With one frame a topic, by log time, and the metadata, provenance and attachments.

    Raises
    ------
    LogError
        If the file is no log, nothing of it is readable, it holds no trip, was written by a newer
        version of trainlog, or a topic is asked for that does not exist.
    InputError
        If there is no such file.
    """
    wanted = _known(topics)
    with Source(path) as source, in_file(path):
        contents = contents_of(source)
        try:
            trip = trip_of(source, contents, wanted)
        except MisplacedError:
            contents = contents_by_walk(source)
            trip = trip_of(source, contents, wanted)
        if topics is None:
            check_data_section(source, contents)
        _check_readable(contents)
    report_losses(path, contents)
    return trip


def report_losses(path: str | Path, contents: Contents) -> None:
    """Warn of what is lost of a file with a `DamageWarning` at the line that called trainlog."""
    if contents.losses:
        # From here over the public function to its caller.
        warnings.warn(DamageWarning(str(path), contents.account), stacklevel=3)


def check_data_section(source: Source, contents: Contents) -> None:
    """Notice damage outside of the chunks and attachments, each of which has its own checksum."""
    if contents.data_section is None or contents.losses:
        return
    end, expected = contents.data_section
    if not expected:
        return
    checksum = 0
    for at in range(0, end, _PIECE):
        checksum = isal_zlib.crc32(source.read(at, min(_PIECE, end - at)), checksum)
    if checksum != expected:
        reason = "a record between the chunks fails the checksum of the data section"
        contents.losses.append(Loss(end, end, reason, messages=0))


def trip_of(source: Source, contents: Contents, wanted: Container[str]) -> Trip:
    """The trip with the topics `wanted` that a file holds; what turns out damaged is dropped.

    Raises
    ------
    LogError
        As `read_log`.
    MisplacedError
        If the summary by which the contents were found turns out to be wrong.
    """
    channels = _channels(contents)
    metadata = metadata_of(contents)
    _check_readable(contents)
    _check_version(contents, metadata, channels)
    return Trip(
        topics=_frames(source, contents, [each for each in channels if each.topic.name in wanted]),
        metadata=metadata.get(TRIP_RECORD, {}),
        provenance=_provenance(metadata),
        attachments={place.name: data for place, data in attachments_of(source, contents)},
    )


def attachments_of(source: Source, contents: Contents) -> list[tuple[AttachmentPlace, bytes]]:
    """Each attachment with its content; those that fail their checksum are dropped."""
    found = []
    for place in list(contents.attachments):
        try:
            found.append((place, attachment_data(source, place)))
        except LogError as error:
            contents.attachments.remove(place)
            end = place.offset + place.length
            contents.losses.append(Loss(place.offset, end, error.problem, messages=0))
    return found


def metadata_of(contents: Contents) -> dict[str, dict[str, str]]:
    """The metadata records of a file by name; records of the same name are joined."""
    found: dict[str, dict[str, str]] = {}
    record: Metadata
    for record in contents.metadata:
        found.setdefault(record.name, {}).update(record.metadata)
    return found


def _provenance(metadata: dict[str, dict[str, str]]) -> tuple[dict[str, Any], ...]:
    """The processing steps that a file's metadata records tell, oldest first."""
    steps = []
    for key, text in sorted(metadata.get(PROVENANCE_RECORD, {}).items()):
        try:
            step = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise unusable(f"step {shown(key)} of the provenance is not JSON") from error
        if not isinstance(step, dict):
            raise unusable(f"step {shown(key)} of the provenance is not an object")
        steps.append(step)
    return tuple(steps)


@dataclass
class _TopicChannel:
    """A channel of the file that carries one of trainlog's topics."""

    channel: Channel
    schema: Schema
    topic: Topic

    @cached_property
    def codec(self) -> Codec | None:
        return codec_of(self.channel, self.schema)

    @cached_property
    def decoder(self) -> Decoder:
        return decoder_of(self.channel, self.schema)

    def decode(
        self, content: bytes, offsets: NDArray[np.uint64], chunk: int
    ) -> tuple[NDArray[np.uint64], Columns]:
        """Times and columns of this channel's messages in the chunk at byte `chunk`."""
        if self.codec is not None:
            rows = gather(content, offsets, self.codec.layout)
            columns = None if rows is None else self.codec.columns(rows)
            if rows is not None and columns is not None:
                return rows[LOG_TIME], columns
        times, messages = [], []
        for offset in offsets.tolist():
            found = message_data(content, offset, self.channel.id)
            if found is None:
                raise MisplacedError(
                    f"a message of {self.topic.name} is not where it should be",
                    place=f"byte {chunk}",
                )
            times.append(found[0])
            messages.append(self.decoder(found[1]))
        return np.array(times, dtype=np.uint64), columns_of(self.topic, messages)


@dataclass
class _Table:
    """The columns of a topic while they are being filled, chunk by chunk."""

    topic: Topic
    time: NDArray[np.uint64]
    columns: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    texts: list[Columns] = field(default_factory=list)
    filled: int = 0

    def add(self, time: NDArray[np.uint64], columns: Columns) -> None:
        """Append the messages of one channel in one chunk."""
        part = slice(self.filled, self.filled + len(time))
        if part.stop > len(self.time):
            self._grow(part.stop)
        self.time[part] = time
        self.filled = part.stop
        if self.topic is EVENTS:
            self.texts.append(columns)
            return
        for name, values in columns.items():
            if name not in self.columns and self._knows(name):
                self.columns[name] = np.full(len(self.time), np.nan)
            if name in self.columns:
                self.columns[name][part] = values

    def frame(self) -> pd.DataFrame:
        """The topic's frame, in the order of time."""
        stamps = self.time[: self.filled]
        if np.any(stamps > np.uint64(pd.Timestamp.max.value)):
            raise unusable(f"{self.topic.name} has times after {pd.Timestamp.max.year}")
        time = stamps.astype(np.int64)
        data: dict[str, Any] = {name: each[: self.filled] for name, each in self.columns.items()}
        if self.texts:
            data = {
                name: np.concatenate([np.asarray(part[name]) for part in self.texts])
                for name in self.texts[0]
            }
        if np.any(np.diff(time) < 0):
            order = np.argsort(time, kind="stable")
            time = time[order]
            data = {name: values[order] for name, values in data.items()}
        index = pd.DatetimeIndex(time.view("M8[ns]"), tz="UTC")
        return frame_of(self.topic, index, data)

    def _grow(self, rows: int) -> None:
        """Make place for messages that the file's indexes do not list."""
        more = max(rows, 2 * len(self.time)) - len(self.time)
        self.time = np.append(self.time, np.zeros(more, dtype=np.uint64))
        for name, values in self.columns.items():
            self.columns[name] = np.append(values, np.full(more, np.nan))

    def _knows(self, column: str) -> bool:
        try:
            column_field(self.topic, column)
        except KeyError:
            return False
        return True


def _frames(
    source: Source, contents: Contents, channels: list[_TopicChannel]
) -> dict[str, pd.DataFrame]:
    """The frames of the channels' topics, in the order of the table."""
    by_channel = {each.channel.id: each for each in channels}
    counts = contents.counts()
    tables: dict[str, _Table] = {}
    for each in channels:
        name = each.topic.name
        total = sum(counts[one.channel.id] for one in channels if one.topic.name == name)
        if name not in tables:
            tables[name] = _Table(each.topic, np.empty(total, dtype=np.uint64))
        if each.codec is not None and not total:
            # A topic without messages has its columns nevertheless.
            none = each.codec.layout.rows(0)
            tables[name].add(none[LOG_TIME], each.codec.columns(none) or {})
    for place in list(contents.chunks):
        if place.counts.keys().isdisjoint(by_channel):
            continue
        try:
            parts = _decoded(source, place, by_channel)
        except MisplacedError as error:
            if contents.indexed:
                raise
            contents.drop(place, error.problem)
        except _DamagedChunkError as error:
            contents.drop(place, error.problem)
        else:
            for channel, part in parts.items():
                tables[by_channel[channel].topic.name].add(*part)
    return {name: tables[name].frame() for name in TOPICS if name in tables}


class _DamagedChunkError(LogError):
    """A chunk's bytes are not what was written."""


_Parts = dict[int, tuple[NDArray[np.uint64], Columns]]
"""Times and columns of the messages in a chunk by channel id."""


def _decoded(source: Source, place: ChunkPlace, channels: dict[int, _TopicChannel]) -> _Parts:
    """What the chunk that stands there holds of the channels."""
    chunk = fetched(source, place)
    try:
        content = opened(chunk, check=True)
    except LogError as error:
        raise _DamagedChunkError(error.problem, place=error.place) from error
    try:
        if place.indexes:
            # An index that does not fit the chunk is made again from the chunk's records.
            with suppress(LogError):
                return _parts(content, fetched_index(source, place, channels), place, channels)
        return _parts(content, index_of(content, place.offset), place, channels)
    except LogError as error:
        if chunk.checksum:
            # These are the bytes that were written.
            raise
        raise _DamagedChunkError(error.problem, place=error.place) from error


def _parts(
    content: bytes, index: Index, place: ChunkPlace, channels: dict[int, _TopicChannel]
) -> _Parts:
    return {
        number: channels[number].decode(content, entries[:, 1], place.offset)
        for number, entries in index.items()
        if number in channels
    }


def _channels(contents: Contents) -> list[_TopicChannel]:
    """The channels that carry topics of trainlog."""
    found = []
    for channel in contents.channels.values():
        schema = contents.schema(channel)
        topic = topic_of(channel, schema)
        if topic is not None and schema is not None:
            found.append(_TopicChannel(channel, schema, topic))
    return found


def _known(topics: Iterable[str] | None) -> set[str]:
    """The topics asked for, checked."""
    if topics is None:
        return set(TOPICS)
    wanted = {topics} if isinstance(topics, str) else set(topics)
    for name in sorted(wanted - TOPICS.keys()):
        raise LogError(f"there is no topic {name}", remedy=f"topics are {', '.join(TOPICS)}")
    return wanted


def _check_version(
    contents: Contents, metadata: dict[str, dict[str, str]], channels: list[_TopicChannel]
) -> None:
    """Refuse files that hold no trip, and those of a later version."""
    if FORMAT_RECORD not in metadata and not channels:
        held = sorted({shown(channel.topic) for channel in contents.channels.values()})
        raise LogError(
            f"holds no topic of trainlog, but {', '.join(held[:_MOST_NAMED]) or 'none at all'}"
            + (f" and {len(held) - _MOST_NAMED} more" if len(held) > _MOST_NAMED else ""),
            remedy="bring recordings of other programs in as a table (CSV, Parquet)",
        )
    version = metadata.get(FORMAT_RECORD, {}).get("schema_version", str(SCHEMA_VERSION))
    if not re.fullmatch(r"[0-9]{1,9}", version) or int(version) > SCHEMA_VERSION:
        raise LogError(
            f"follows version {shown(version)} of the table of topics, this trainlog knows "
            f"{SCHEMA_VERSION}",
            remedy="update trainlog",
        )


def _check_readable(contents: Contents) -> None:
    """Refuse a damaged file of which no message is readable."""
    account = contents.account
    if account.messages or account.whole:
        return
    first = account.losses[0]
    raise LogError(
        f"is damaged and no message of it is readable: {first.reason}",
        place=f"byte {first.start}",
        remedy="copy or record it again",
    )

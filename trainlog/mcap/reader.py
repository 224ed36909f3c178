"""Reading a trip from an MCAP file."""

from __future__ import annotations

import json
import re
from collections.abc import Container, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mcap.records import Channel, Metadata, Schema
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.formats.files import read_bytes
from trainlog.mcap.channels import codec_of, topic_of
from trainlog.mcap.contents import Contents, contents_of
from trainlog.mcap.decode import Decoder, columns_of, decoder_of
from trainlog.mcap.errors import damaged, in_file, shown, unusable
from trainlog.mcap.layout import LOG_TIME, gather
from trainlog.mcap.names import FORMAT_RECORD, PROVENANCE_RECORD, TRIP_RECORD
from trainlog.mcap.records import message_data, opened
from trainlog.mcap.samples import Codec, Columns
from trainlog.topics import EVENTS, SCHEMA_VERSION, TOPICS, Topic, column_field
from trainlog.trip import Trip, frame_of

_MOST_NAMED = 8
"""Topics of a foreign file that an error names."""


def read_log(path: str | Path, topics: Iterable[str] | None = None) -> Trip:
    """Read a trip from an MCAP file.

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
        If the file is damaged, holds no trip, was written by a newer version of trainlog, or a
        topic is asked for that does not exist.
    InputError
        If there is no such file.
    """
    wanted = _known(topics)
    data = read_bytes(path)
    with in_file(path):
        contents = contents_of(data)
        if contents.damage is not None:
            raise _damage(contents, contents.damage)
        return trip_of(contents, wanted)


def trip_of(contents: Contents, wanted: Container[str]) -> Trip:
    """The trip with the topics `wanted` that a file's contents hold; LogError as `read_log`."""
    sources = _sources(contents)
    metadata = metadata_of(contents)
    _check_version(contents, metadata, sources)
    return Trip(
        topics=_frames(contents, [source for source in sources if source.topic.name in wanted]),
        metadata=metadata.get(TRIP_RECORD, {}),
        provenance=_provenance(metadata),
        attachments={each.name: each.data for each in contents.attachments},
    )


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
class _Source:
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
                raise damaged(chunk, f"a message of {self.topic.name} is not where it should be")
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
        self.time[part] = time
        self.filled += len(time)
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
        if np.any(self.time > np.uint64(pd.Timestamp.max.value)):
            raise unusable(f"{self.topic.name} has times after {pd.Timestamp.max.year}")
        time = self.time.astype(np.int64)
        data: dict[str, Any] = dict(self.columns)
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

    def _knows(self, column: str) -> bool:
        try:
            column_field(self.topic, column)
        except KeyError:
            return False
        return True


def _frames(contents: Contents, sources: list[_Source]) -> dict[str, pd.DataFrame]:
    """The frames of the sources' topics, in the order of the table."""
    by_channel = {source.channel.id: source for source in sources}
    counts = contents.counts()
    tables = {}
    for source in sources:
        name = source.topic.name
        total = sum(counts[each.channel.id] for each in sources if each.topic.name == name)
        if name not in tables:
            tables[name] = _Table(source.topic, np.empty(total, dtype=np.uint64))
        if source.codec is not None and not total:
            # A topic without messages has its columns nevertheless.
            none = source.codec.layout.rows(0)
            tables[name].add(none[LOG_TIME], source.codec.columns(none) or {})
    for chunk, index in contents.chunks:
        held = [channel for channel in index if channel in by_channel]
        if not held:
            continue
        content = opened(chunk)
        for channel in held:
            source = by_channel[channel]
            part = source.decode(content, index[channel][:, 1], chunk.offset)
            tables[source.topic.name].add(*part)
    return {name: tables[name].frame() for name in TOPICS if name in tables}


def _sources(contents: Contents) -> list[_Source]:
    """The channels that carry topics of trainlog."""
    found = []
    for channel in contents.channels.values():
        schema = contents.schema(channel)
        topic = topic_of(channel, schema)
        if topic is not None and schema is not None:
            found.append(_Source(channel, schema, topic))
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
    contents: Contents, metadata: dict[str, dict[str, str]], sources: list[_Source]
) -> None:
    """Refuse files that hold no trip, and those of a later version."""
    if FORMAT_RECORD not in metadata and not sources:
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


def _damage(contents: Contents, damage: LogError) -> LogError:
    """The error for a damaged file, telling what of it is readable."""
    count = contents.counts().total()
    return LogError(
        f"is damaged: {damage.problem}",
        place=damage.place,
        remedy=f"copy or record it again ({count:,} messages in {len(contents.chunks):,} chunks "
        "are readable)",
    )

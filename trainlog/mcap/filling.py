"""From the chunks of a log to the frames of its topics, by several threads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.mcap.codec import LOG_TIME, gather
from trainlog.mcap.places import ChunkPlace, Contents
from trainlog.mcap.records import Index, index_of, opened
from trainlog.mcap.schemas import topic_of
from trainlog.mcap.selection import Columns
from trainlog.mcap.source import Source
from trainlog.mcap.stored import MisplacedError, fetched, fetched_index
from trainlog.mcap.tables import Apart, Table, TopicChannel, table_of
from trainlog.topics import TOPICS

_ROUND = 2**16
"""Lengths of chunks are rounded up to a multiple of this for what is kept between them [bytes]."""

_AT_ONCE = 4
"""Chunks that a thread is given at a time."""


@dataclass(frozen=True)
class _Target:
    """Where the messages of one channel in a chunk go: `count` rows of a table from `start` on."""

    source: TopicChannel
    table: Table
    start: int
    count: int


@dataclass
class _Outcome:
    """What became of a chunk."""

    place: ChunkPlace
    targets: list[_Target]
    damage: str | None = None
    apart: list[tuple[_Target, Apart]] = field(default_factory=list)


def topic_channels(contents: Contents) -> list[TopicChannel]:
    """The channels that carry topics of trainlog."""
    found = []
    for channel in contents.channels.values():
        schema = contents.schema(channel)
        topic = topic_of(channel, schema)
        if topic is not None and schema is not None:
            found.append(TopicChannel(channel, schema, topic))
    return found


def frames_in(
    source: Source,
    contents: Contents,
    chunks: Sequence[ChunkPlace],
    columns: Columns,
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
        each.channel.id: each for each in topic_channels(contents) if each.topic.name in columns
    }
    tables = _tables(channels.values(), chunks, columns)
    for outcome in _outcomes(source, chunks, channels, tables, threads):
        if outcome.damage is not None:
            if contents.indexed:
                raise MisplacedError(outcome.damage, place=f"byte {outcome.place.offset}")
            contents.drop(outcome.place, outcome.damage)
        for target in outcome.targets if outcome.damage is not None else ():
            target.table.set_apart(target.start, target.count, None)
        for target, found in outcome.apart:
            target.table.set_apart(target.start, target.count, found)
    return {name: tables[name].frame() for name in TOPICS if name in tables}


def _tables(
    channels: Iterable[TopicChannel],
    chunks: Sequence[ChunkPlace],
    columns: Columns,
) -> dict[str, Table]:
    """An empty table for each topic that has a channel."""
    counts: Counter[int] = Counter()
    room: Counter[int] = Counter()
    for place in chunks:
        counts.update(place.counts)
        room.update(dict.fromkeys(place.counts, place.size))
    by_topic: dict[str, list[TopicChannel]] = {}
    for each in channels:
        by_topic.setdefault(each.topic.name, []).append(each)
    tables = {}
    for name, sources in by_topic.items():
        # A layout whose messages would not fit into the chunks claims memory for nothing.
        fitting = {
            each.channel.id: each
            for each in sources
            if each.codec is not None
            and each.codec.layout.size * counts[each.channel.id] <= room[each.channel.id]
        }
        rows = sum(counts[each.channel.id] for each in sources)
        tables[name] = table_of(TOPICS[name], fitting, rows, columns[name])
    return tables


def _outcomes(
    source: Source,
    chunks: Sequence[ChunkPlace],
    channels: dict[int, TopicChannel],
    tables: dict[str, Table],
    threads: int,
) -> Iterator[_Outcome]:
    """Read the chunks that hold any of the channels, and tell what became of each, in order."""
    filled = dict.fromkeys(tables, 0)
    work = []
    for place in chunks:
        targets = []
        for number, count in place.counts.items():
            if number in channels:
                each = channels[number]
                start = filled[each.topic.name]
                targets.append(_Target(each, tables[each.topic.name], start, count))
                filled[each.topic.name] += count
        if targets:
            work.append(_Outcome(place, targets))
    if threads == 1 or len(work) == 1:
        for outcome in work:
            _read(source, outcome)
            yield outcome
        return
    batches = [work[at : at + _AT_ONCE] for at in range(0, len(work), _AT_ONCE)]
    with ThreadPoolExecutor(threads) as pool:
        try:
            for batch in pool.map(lambda batch: [_read(source, each) for each in batch], batches):
                yield from batch
        finally:
            pool.shutdown(cancel_futures=True)


def _read(source: Source, outcome: _Outcome) -> _Outcome:
    """Fill the tables from one chunk."""
    place = outcome.place
    try:
        chunk = fetched(source, place)
        content = opened(chunk, check=True)
    except LogError as error:
        outcome.damage = error.problem
        return outcome
    try:
        with suppress(LogError):
            _fill(content, _offsets(source, place, content, outcome.targets), outcome)
            return outcome
        # An index that does not fit the chunk is made again from the chunk's records.
        _fill(content, _starts(index_of(content, place.offset)), outcome)
    except LogError as error:
        if chunk.checksum and not isinstance(error, MisplacedError):
            # These are the bytes that were written.
            raise
        outcome.damage = error.problem
    return outcome


_Offsets = dict[int, NDArray[np.uint64]]
"""Where in a chunk the messages begin, by channel id."""


def _starts(index: Index) -> _Offsets:
    return {channel: entries[:, 1] for channel, entries in index.items()}


def _offsets(source: Source, place: ChunkPlace, content: bytes, targets: list[_Target]) -> _Offsets:
    """Where in the chunk the messages of the targets begin."""
    sole = targets[0].source
    if len(place.counts) == 1 and sole.codec is not None:
        size, count = sole.codec.layout.size, targets[0].count
        if size * count == len(content):
            # One message after the other; the layout is verified where they are read.
            return {sole.channel.id: _evenly(size, -(-len(content) // _ROUND))[:count]}
    if place.indexes:
        index = _starts(
            fetched_index(source, place, [target.source.channel.id for target in targets])
        )
        # An index that leads to one message twice leaves out another.
        if all(bool(np.all(each[1:] > each[:-1])) for each in index.values()):
            return index
    return _starts(index_of(content, place.offset))


@lru_cache(maxsize=16)
def _evenly(size: int, length: int) -> NDArray[np.uint64]:
    """Where messages of one size begin that follow each other; `length` counts by `_ROUND`."""
    return np.arange(0, length * _ROUND, size, dtype=np.uint64)


def _fill(content: bytes, index: _Offsets, outcome: _Outcome) -> None:
    """Take the messages of a chunk to their tables, or apart where they do not fit."""
    outcome.apart = []
    for target in outcome.targets:
        offsets = index.get(target.source.channel.id, np.empty(0, dtype=np.uint64))
        if len(offsets) == target.count and target.table.fill(
            target.source, content, offsets, target.start
        ):
            continue
        outcome.apart.append((target, _taken(target.source, content, offsets, outcome.place)))


def _taken(
    source: TopicChannel, content: bytes, offsets: NDArray[np.uint64], place: ChunkPlace
) -> Apart:
    """Messages that have no place in the table's arrays."""
    if source.codec is not None:
        rows = gather(content, offsets, source.codec.layout)
        columns = None if rows is None else source.codec.columns(rows)
        if rows is not None and columns is not None:
            return Apart(rows[LOG_TIME], columns)
    return Apart(*source.decoded(content, offsets, place.offset))

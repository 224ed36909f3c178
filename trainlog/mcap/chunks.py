"""Chunks: the messages of all channels, interleaved by time, cut, laid out and compressed."""

from __future__ import annotations

import struct
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
import zstandard
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from trainlog.arrays import FloatArray, IntArray, UintArray
from trainlog.errors import InputError, LogError
from trainlog.mcap.codec import (
    SEQUENCE,
    Codec,
    channel_of,
    codec_for,
    encode_events,
    scatter,
    schema_of,
    table_of,
)
from trainlog.mcap.records import checksum
from trainlog.mcap.selection import Range, range_in
from trainlog.topics import EVENTS, RECORDED, TOPICS, Topic, column_field, topic_of_frame
from trainlog.trip import Trip

PERIOD = 60 * 10**9
"""Longest time that one chunk of a derived file spans [ns]: a minute of a trip is what a damaged
chunk costs at most. With 10 s files are up to a twentieth larger, with no limit up to a hundredth
smaller."""

LARGEST = 2**20
"""Largest chunk before compression [bytes], unless one message is longer."""

COMPRESSION = zstandard.ZstdCompressionParameters.from_level(
    3, source_size=2**20, hash_log=18, min_match=4, write_content_size=True
)
"""Level 3 of zstd: a tenth smaller than level 1, for a quarter of the speed. Its longer table of
matches, and matches from four bytes on, are worth a hundredth of the size and cost no time."""

_SEQUENCE_AT = 11
"""Where the sequence number stands in a message record, before the two times."""


# ------------------------------------------------------------------------------------- messages


@dataclass(frozen=True)
class Samples:
    """Messages of one length, as the columns that a codec lays out.

    Attributes
    ----------
    codec : Codec
    table : (columns, n) float64
        One row a column of the codec, one column a message.
    """

    codec: Codec
    table: FloatArray

    @property
    def sizes(self) -> IntArray:
        """Length of each message's record [bytes]."""
        return np.full(self.table.shape[1], self.codec.layout.size, dtype=np.int64)

    def part(self, rows: slice) -> Samples:
        """Some of the messages."""
        return replace(self, table=self.table[:, rows])

    def then(self, others: Samples) -> Samples:
        """These messages and behind them the others."""
        return replace(self, table=np.concatenate([self.table, others.table], axis=1))

    def put(
        self,
        data: NDArray[np.uint8],
        offsets: IntArray,
        time: IntArray,
        sequence: NDArray[np.uint32],
    ) -> None:
        """Lay the records out at `offsets` of a chunk."""
        rows = self.codec.encode(time, self.table)
        rows[SEQUENCE] = sequence
        scatter(rows, data.data, offsets)


@dataclass(frozen=True)
class Listed:
    """Messages that differ in length, each a record already."""

    records: list[bytes]

    @property
    def sizes(self) -> IntArray:
        """Length of each message's record [bytes]."""
        return np.array([len(record) for record in self.records], dtype=np.int64)

    def part(self, rows: slice) -> Listed:
        """Some of the messages."""
        return Listed(self.records[rows])

    def then(self, others: Listed) -> Listed:
        """These messages and behind them the others."""
        return Listed(self.records + others.records)

    def put(
        self,
        data: NDArray[np.uint8],
        offsets: IntArray,
        time: IntArray,
        sequence: NDArray[np.uint32],
    ) -> None:
        """Lay the records out at `offsets` of a chunk."""
        buffer = data.data
        heads = zip(offsets.tolist(), sequence.tolist(), time.tolist(), strict=True)
        for record, (at, number, moment) in zip(self.records, heads, strict=True):
            buffer[at : at + len(record)] = record
            struct.pack_into("<IQQ", buffer, at + _SEQUENCE_AT, number, moment, moment)


@dataclass(frozen=True)
class Stream:
    """One channel and its messages, oldest first.

    Attributes
    ----------
    channel : mcap.records.Channel
    schema : mcap.records.Schema
    time : (n,) int64
        Log time of each message [ns since 1970 UTC], never decreasing.
    messages : Samples or Listed
    sequence : (n,) uint32, optional
        Their sequence numbers. Default: for each the number of messages of the channel before its
        chunk, counted from `before`. Counted on within the chunk, they would make a file a
        twentieth larger.
    before : int
        How many messages of the channel came before these.
    """

    channel: Channel
    schema: Schema
    time: IntArray
    messages: Samples | Listed
    sequence: NDArray[np.uint32] | None = None
    before: int = 0

    def behind(self, row: int) -> Stream:
        """The messages from `row` on."""
        rest = slice(row, None)
        return replace(
            self,
            time=self.time[rest],
            messages=self.messages.part(rest),
            sequence=None if self.sequence is None else self.sequence[rest],
            before=self.before + row,
        )

    def then(self, others: Stream) -> Stream:
        """These messages and behind them those of the same channel that follow."""
        if not len(self.time):
            return replace(others, before=self.before)
        if not len(others.time):
            return self
        # Both are of one channel, so that their messages are of one kind.
        messages = self.messages.then(others.messages)  # type: ignore[arg-type]
        return replace(self, time=np.concatenate([self.time, others.time]), messages=messages)

    def put(self, rows: slice, data: NDArray[np.uint8], offsets: IntArray) -> UintArray:
        """Lay messages out in a chunk; returns their entries of its message index."""
        time = self.time[rows]
        if self.sequence is None:
            count = (self.before + rows.start) & 0xFFFFFFFF
            sequence = np.full(len(time), count, dtype=np.uint32)
        else:
            sequence = self.sequence[rows]
        self.messages.part(rows).put(data, offsets, time, sequence)
        return np.stack([time, offsets], axis=1).view(np.uint64)


def topics_of(trip: Trip) -> list[Topic]:
    """The topics that a trip has frames of, in the order of the table.

    Raises
    ------
    LogError
        If the table does not have one of them.
    """
    others = sorted(name for name in trip.topics if name not in TOPICS)
    own = [known_topic(name, trip.topics[name]) for name in others]
    return [topic for topic in TOPICS.values() if topic.name in trip.topics] + own


def known_topic(name: str, frame: pd.DataFrame | None = None) -> Topic:
    """The topic called `name`, which a recorder's own `frame` describes.

    Raises
    ------
    LogError
        If the table does not have it, and it is no topic of a recorder's own with a frame.
    """
    if name in TOPICS:
        return TOPICS[name]
    if frame is None or not name.startswith(RECORDED):
        remedy = f"topics are {', '.join(TOPICS)}, and a recorder's own below {RECORDED}"
        raise LogError(f"there is no topic {name}", remedy=remedy)
    try:
        return topic_of_frame({**frame.attrs, "topic": name})
    except KeyError:
        raise LogError(
            f"the frame of {name} does not describe its columns",
            remedy="build it with trainlog.trip.frame_of and trainlog.recorded_topic",
        ) from None
    except InputError as error:
        raise LogError(error.problem, remedy=error.remedy) from error


def stream_of(topic: Topic, frame: pd.DataFrame, number: int) -> Stream:
    """The stream of one frame; channel and schema are both called `number`.

    Raises
    ------
    LogError
        If the frame does not fit the table of topics, or its times run backwards.
    """
    time = _time(topic, frame)
    axles = _axles(topic, frame)
    messages: Samples | Listed
    if topic is EVENTS:
        messages = Listed(encode_events(number, frame))
    else:
        codec = codec_for(topic, number, axles)
        messages = Samples(codec, table_of(frame, codec.names))
    channel, schema = channel_of(topic, number, number, axles), schema_of(topic, number)
    return Stream(channel, schema, time, messages)


def _time(topic: Topic, frame: pd.DataFrame) -> IntArray:
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


# --------------------------------------------------------------------------------------- chunks


@dataclass(frozen=True)
class Chunk:
    """A chunk as it will stand in a file.

    Attributes
    ----------
    data : bytes-like
        Its content: message records (and, in files of other programs, schemas and channels).
    start, end : int
        Earliest and latest log time of its messages [ns].
    index : dict of int to (n, 2) uint64 array
        Log time and offset of each message by channel id, for the channels it holds.
    positions : dict of str to (float, float)
        Least and greatest position [m] by topic, for the topics that have one.
    compression : str
        Of `data`: ``"zstd"``, ``"lz4"`` or ``""``.
    size, checksum : int
        Length [bytes] and CRC-32 of its content before compression, zero until that is `packed`; a
        checksum of zero in a file stands for none.
    """

    data: bytes | bytearray | memoryview
    start: int
    end: int
    index: dict[int, UintArray]
    positions: dict[str, Range] = field(default_factory=dict)
    compression: str = ""
    size: int = 0
    checksum: int = 0


class _Compressor(threading.local):
    """One compressor a thread: its tables are a megabyte, and are set up once."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdCompressor(compression_params=COMPRESSION)


_compressor = _Compressor()


def packed(chunk: Chunk) -> Chunk:
    """The chunk compressed, with its checksum. Runs in any thread, mostly without the GIL."""
    return replace(
        chunk,
        data=_compressor.zstd.compress(chunk.data),
        compression="zstd",
        size=len(chunk.data),
        checksum=checksum(chunk.data),
    )


@dataclass(frozen=True)
class Plan:
    """Where each message of some streams comes to stand.

    Attributes
    ----------
    streams : sequence of Stream
    offsets : list of (n,) int64
        For each stream, the place of each message in its chunk [bytes].
    cuts : list of (chunks + 1,) int64
        For each stream, the first message of each chunk, and n.
    sizes : (chunks,) int64
        Length of each chunk [bytes].
    """

    streams: Sequence[Stream]
    offsets: list[IntArray] = field(default_factory=list)
    cuts: list[IntArray] = field(default_factory=list)
    sizes: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def __len__(self) -> int:
        """How many chunks there are."""
        return len(self.sizes)

    def chunk(self, number: int) -> Chunk:
        """Lay out one chunk."""
        parts = [
            (stream, slice(int(cut[number]), int(cut[number + 1])), offsets)
            for stream, cut, offsets in zip(self.streams, self.cuts, self.offsets, strict=True)
            if cut[number] < cut[number + 1]
        ]
        data = np.empty(self.sizes[number], dtype=np.uint8)
        index = {
            stream.channel.id: stream.put(rows, data, offsets[rows])
            for stream, rows, offsets in parts
        }
        start = min(int(stream.time[rows.start]) for stream, rows, _ in parts)
        end = max(int(stream.time[rows.stop - 1]) for stream, rows, _ in parts)
        ranges = {
            stream.channel.topic: range_in(stream.channel.topic, data, offsets[rows])
            for stream, rows, offsets in parts
        }
        positions = {topic: each for topic, each in ranges.items() if each is not None}
        return Chunk(data.data, start, end, index, positions)

    def behind(self, number: int) -> list[Stream]:
        """The messages of the streams from chunk `number` on."""
        if not len(self):
            return list(self.streams)
        return [
            stream.behind(int(cut[number]))
            for stream, cut in zip(self.streams, self.cuts, strict=True)
        ]


def plan_of(streams: Sequence[Stream], period: int = PERIOD, largest: int = LARGEST) -> Plan:
    """The streams' messages in the order of time, cut into chunks that do not overlap.

    Messages of the same time keep the order of the streams. A chunk is closed before the message
    that would make it longer than `largest`, and before the one that lies `period` behind its
    first.

    Parameters
    ----------
    streams : sequence of Stream
    period : int
        Longest time that a chunk spans [ns].
    largest : int
        Largest chunk [bytes], unless one message is longer.
    """
    if not any(len(stream.time) for stream in streams):
        return Plan(streams)
    time = np.concatenate([stream.time for stream in streams])
    sizes = np.concatenate([stream.messages.sizes for stream in streams])
    if len(streams) > 1:
        order = np.argsort(time, kind="stable")
        time, sizes = time[order], sizes[order]
    else:
        order = np.arange(time.size)
    ends = np.cumsum(sizes)
    firsts = _cuts(time, ends, period, largest)
    counts, begins = np.diff(firsts), (ends - sizes)[firsts[:-1]]
    chunk, offset = np.empty_like(order), np.empty_like(ends)
    chunk[order] = np.repeat(np.arange(counts.size), counts)
    offset[order] = ends - sizes - np.repeat(begins, counts)
    parts = np.cumsum([len(stream.time) for stream in streams])[:-1]
    numbers = np.arange(counts.size + 1)
    return Plan(
        streams,
        np.split(offset, parts),
        [np.searchsorted(each, numbers) for each in np.split(chunk, parts)],
        np.diff(begins, append=ends[-1]),
    )


def _cuts(time: IntArray, ends: IntArray, period: int, largest: int) -> IntArray:
    """The first message of each chunk, and their number; `ends` is the sum of the lengths."""
    cuts = [0]
    while cuts[-1] < time.size:
        first = cuts[-1]
        before = int(ends[first - 1]) if first else 0
        full = int(np.searchsorted(ends, before + largest, side="right"))
        late = int(np.searchsorted(time, min(int(time[first]) + period, 2**63 - 1), side="left"))
        cuts.append(max(first + 1, min(full, late if late > first else time.size)))
    return np.array(cuts)

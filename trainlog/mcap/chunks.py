"""Chunks: the messages of all channels, interleaved by time, cut and laid out as bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from trainlog.mcap.fill import Records
from trainlog.mcap.positions import range_in
from trainlog.mcap.sink import RawChunk

PERIOD = 60 * 10**9
"""Longest time that one chunk of a derived file spans [ns]: a minute of a trip is what a damaged
chunk costs at most. With 10 s files are up to a twentieth larger, with no limit up to a hundredth
smaller."""

LARGEST = 2**20
"""Largest chunk before compression [bytes], unless one message is longer."""


@dataclass(frozen=True)
class Stream:
    """One channel and its messages, oldest first.

    Attributes
    ----------
    channel : mcap.records.Channel
    schema : mcap.records.Schema
    time : (n,) int64
        Log time of each message [ns since 1970 UTC], never decreasing.
    records : Records
        The n messages.
    sequence : (n,) uint32, optional
        Their sequence numbers. Default: for each the number of messages of the channel before its
        chunk, counted from `before`. Counted on within the chunk, they would make a file a
        twentieth larger.
    before : int
        How many messages of the channel came before these.
    """

    channel: Channel
    schema: Schema
    time: NDArray[np.int64]
    records: Records
    sequence: NDArray[np.uint32] | None = None
    before: int = 0

    def behind(self, row: int) -> Stream:
        """The messages from `row` on."""
        rest = slice(row, None)
        return replace(
            self,
            time=self.time[rest],
            records=self.records.part(rest),
            sequence=None if self.sequence is None else self.sequence[rest],
            before=self.before + row,
        )

    def then(self, others: Stream) -> Stream:
        """These messages and behind them those of the same channel that follow."""
        if not len(self.time):
            return replace(others, before=self.before)
        if not len(others.time):
            return self
        time = np.concatenate([self.time, others.time])
        return replace(self, time=time, records=self.records.then(others.records))

    def put(
        self, rows: slice, data: NDArray[np.uint8], offsets: NDArray[np.int64]
    ) -> NDArray[np.uint64]:
        """Lay messages out in a chunk; returns their entries of its message index."""
        time = self.time[rows]
        if self.sequence is None:
            count = (self.before + rows.start) & 0xFFFFFFFF
            sequence = np.full(len(time), count, dtype=np.uint32)
        else:
            sequence = self.sequence[rows]
        self.records.part(rows).put(data, offsets, time, sequence)
        return np.stack([time, offsets], axis=1).view(np.uint64)


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
    """

    streams: Sequence[Stream]
    offsets: list[NDArray[np.int64]] = field(default_factory=list)
    cuts: list[NDArray[np.int64]] = field(default_factory=list)

    def __len__(self) -> int:
        """How many chunks there are."""
        return len(self.cuts[0]) - 1 if self.cuts else 0

    def chunk(self, number: int) -> RawChunk:
        """Lay out one chunk."""
        parts = [
            (stream, slice(int(cut[number]), int(cut[number + 1])), offsets)
            for stream, cut, offsets in zip(self.streams, self.cuts, self.offsets, strict=True)
            if cut[number] < cut[number + 1]
        ]
        size = sum(int(stream.records.part(rows).sizes.sum()) for stream, rows, _ in parts)
        data = np.empty(size, dtype=np.uint8)
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
        return RawChunk(data.data, start, end, index, positions)

    def behind(self, number: int) -> list[Stream]:
        """The messages of the streams from chunk `number` on."""
        if not self.cuts:
            return list(self.streams)
        return [
            stream.behind(int(cut[number]))
            for stream, cut in zip(self.streams, self.cuts, strict=True)
        ]


def plan_of(streams: Sequence[Stream], period: int = PERIOD, largest: int = LARGEST) -> Plan:
    """The streams' messages in the order of time, cut into chunks that do not overlap.

    Messages of the same time keep the order of the streams.

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
    from trainlog.mcap.laying import interleave

    starts = np.cumsum([0] + [len(stream.time) for stream in streams], dtype=np.int64)
    time = np.concatenate([stream.time for stream in streams])
    sizes = np.concatenate([stream.records.sizes for stream in streams])
    chunk, offset = interleave(time, sizes, starts, period, largest)
    numbers = np.arange(chunk.max() + 2)
    return Plan(
        streams,
        np.split(offset, starts[1:-1]),
        [np.searchsorted(each, numbers) for each in np.split(chunk, starts[1:-1])],
    )

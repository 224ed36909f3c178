"""Chunks: the messages of all channels, interleaved by time, cut and laid out as bytes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from trainlog.mcap.layout import scatter
from trainlog.mcap.sink import RawChunk

PERIOD = 10 * 10**9
"""Longest time that one chunk spans [ns]: 10 s of a trip is what a damaged chunk costs, and files
are within a tenth of their smallest size."""

LARGEST = 2**20
"""Largest chunk before compression [bytes], unless one message is longer."""


@dataclass(frozen=True)
class Stream:
    """One channel and its message records, oldest first.

    Attributes
    ----------
    channel : mcap.records.Channel
    schema : mcap.records.Schema
    time : (n,) int64
        Log time of each message [ns since 1970 UTC], never decreasing.
    records : (n,) void array, or list of n bytes
        Message records: an array where all have the same length.
    """

    channel: Channel
    schema: Schema
    time: NDArray[np.int64]
    records: NDArray[np.void] | list[bytes]

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Length of each record [bytes]."""
        if isinstance(self.records, list):
            return np.array([len(record) for record in self.records], dtype=np.int64)
        return np.full(len(self.records), self.records.dtype.itemsize, dtype=np.int64)


def chunks(streams: Sequence[Stream]) -> Iterator[RawChunk]:
    """The streams' messages in the order of time, cut into chunks that do not overlap.

    Messages of the same time keep the order of the streams.
    """
    time = np.concatenate([stream.time for stream in streams] or [np.empty(0, np.int64)])
    if len(time) == 0:
        return
    sizes = np.concatenate([stream.sizes for stream in streams])
    order = np.argsort(time, kind="stable")
    time = time[order]
    end = np.cumsum(sizes[order])
    start = end - sizes[order]
    cuts = _cuts(time, start, end)

    # Where each message of each stream has come to stand in the common order.
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    places = np.split(place, np.cumsum([len(stream.time) for stream in streams])[:-1])
    rows = [np.searchsorted(each, cuts) for each in places]

    for chunk, (first, behind) in enumerate(pairwise(cuts.tolist())):
        data = bytearray(int(end[behind - 1] - start[first]))
        index = {}
        for stream, each, row in zip(streams, places, rows, strict=True):
            within = slice(row[chunk], row[chunk + 1])
            if within.start == within.stop:
                continue
            offsets = start[each[within]] - start[first]
            _put(stream.records[within], data, offsets)
            index[stream.channel.id] = np.stack([stream.time[within], offsets], axis=1).astype(
                np.uint64
            )
        yield RawChunk(data, int(time[first]), int(time[behind - 1]), index)


def _cuts(
    time: NDArray[np.int64], start: NDArray[np.int64], end: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Number of the first message of each chunk, and the number of messages.

    A chunk ends with its period of time, and within a period with each `LARGEST` bytes.
    """
    period = (time - time[0]) // PERIOD
    opens = np.flatnonzero(np.diff(period, prepend=-1))
    opened = np.repeat(start[opens], np.diff(opens, append=len(time)))
    piece = (end - opened - 1) // LARGEST
    fresh = (np.diff(period, prepend=-1) != 0) | (np.diff(piece, prepend=-1) != 0)
    return np.append(np.flatnonzero(fresh), len(time))


def _put(
    records: NDArray[np.void] | list[bytes], data: bytearray, offsets: NDArray[np.int64]
) -> None:
    if isinstance(records, list):
        for record, offset in zip(records, offsets.tolist(), strict=True):
            data[offset : offset + len(record)] = record
    else:
        scatter(records, data, offsets)

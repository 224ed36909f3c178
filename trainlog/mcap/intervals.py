"""How the messages of each channel follow each other in time, told by the indexes alone.

The times are gone through in groups of chunks, so that the memory does not grow with the log.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.mcap.places import ChunkPlace, Contents
from trainlog.mcap.source import Source
from trainlog.mcap.stored import index_in

_AT_ONCE = 2**20
"""Messages whose times are held at a time."""

_MOST_DIFFERENT = 2**20
"""Intervals of so many different lengths are kept to the nanosecond; of more, only the first
twelve binary digits, 0.02 %, are told apart."""


@dataclass
class Rhythm:
    """The times of one channel's messages.

    Attributes
    ----------
    count : int
    first, last : int
        [ns]; zero without messages.
    lengths, numbers : (k,) uint64 and int64 arrays
        Lengths of the intervals between messages [ns], increasing, and how many have each.
    """

    count: int = 0
    first: int = 0
    last: int = 0
    lengths: NDArray[np.uint64] = field(default_factory=lambda: np.empty(0, np.uint64))
    numbers: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    def add(self, time: NDArray[np.uint64]) -> None:
        """Go on with times that are not before those added so far."""
        time = np.sort(time)
        if self.count:
            time = np.concatenate([np.array([self.last], dtype=np.uint64), time])
        # Chunks that claim another time than their messages have are out of order.
        time = np.maximum.accumulate(time)
        self.first = self.first if self.count else int(time[0])
        self.count += len(time) - bool(self.count)
        self.last = int(time[-1])
        lengths, numbers = np.unique(np.diff(time), return_counts=True)
        self.lengths, self.numbers = _merged(
            np.concatenate([self.lengths, lengths]), np.concatenate([self.numbers, numbers])
        )
        if len(self.lengths) > _MOST_DIFFERENT:
            digits = np.frexp(self.lengths.astype(np.float64))[1]
            shift = np.maximum(digits - 12, 0).astype(np.uint64)
            self.lengths, self.numbers = _merged(self.lengths >> shift << shift, self.numbers)

    @property
    def median(self) -> float:
        """Median interval [s]; NaN for fewer than two messages."""
        count = int(self.numbers.sum())
        if not count:
            return np.nan
        middle = np.searchsorted(np.cumsum(self.numbers), [(count - 1) // 2, count // 2], "right")
        return float(self.lengths[middle].astype(np.float64).mean() * 1e-9)

    @property
    def largest(self) -> float:
        """Largest interval [s]; NaN for fewer than two messages."""
        return float(self.lengths[-1]) * 1e-9 if len(self.lengths) else np.nan

    def longer_than(self, interval: float) -> int:
        """How many intervals are longer [s]."""
        return int(self.numbers[self.lengths.astype(np.float64) * 1e-9 > interval].sum())


def rhythms(source: Source, contents: Contents) -> dict[int, Rhythm]:
    """The rhythm of every channel; chunks whose messages cannot be told apart are dropped."""
    found = {number: Rhythm() for number in contents.channels}
    for group in _groups(contents):
        times: dict[int, list[NDArray[np.uint64]]] = {}
        for place in group:
            try:
                index = index_in(source, place)
            except LogError as error:
                contents.drop(place, error.problem)
                continue
            for number, entries in index.items():
                # Messages of a channel that is not declared are among the losses.
                if number in found and len(entries):
                    times.setdefault(number, []).append(entries[:, 0].copy())
        for number, parts in times.items():
            found[number].add(np.concatenate(parts))
    return found


def _groups(contents: Contents) -> Iterator[list[ChunkPlace]]:
    """The chunks in groups that do not overlap in time, in its order."""
    group: list[ChunkPlace] = []
    held = end = 0
    for place in sorted(contents.chunks, key=lambda place: (place.start, place.offset)):
        if held > _AT_ONCE and place.start >= end:
            yield group
            group, held = [], 0
        group.append(place)
        held += place.messages
        end = max(end, place.end)
    yield group


def _merged(
    lengths: NDArray[np.uint64], numbers: NDArray[np.int64]
) -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
    """Each length once, with how many there are."""
    different, place = np.unique(lengths, return_inverse=True)
    merged = np.bincount(place, weights=numbers, minlength=len(different))
    return different, merged.astype(np.int64)

"""Long logs in stretches: for analyses that need all samples of a trip side by side.

A stretch is a part of a log that fits into the memory, with a margin of the samples before and
after it, so that what is computed near its ends is what the whole would give. A log that is short
enough is one stretch, and nothing is different for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from trainlog.mcap.reader import read_log
from trainlog.mcap.scan import contents_of
from trainlog.mcap.source import Source, in_file
from trainlog.mcap.tables import topic_channels
from trainlog.spans import ALWAYS
from trainlog.trip import Trip
from trainlog.units import NANOSECONDS

ROWS = 750_000
"""Rows over all topics read up to which a log is one stretch."""

FINER = 5
"""Of a longer log a stretch has so many times fewer: beside it stands what was made of the rest."""

MARGIN = 60.0
"""Time that is read before and after a stretch [s]."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """A part of a trip.

    Attributes
    ----------
    trip : Trip
        The rows of the stretch, and of the margins before and after it. Named as the whole.
    span : (int, int)
        First and last instant of the stretch itself [ns since 1970 UTC]; the stretches of a trip
        share none, and none lies between them.
    number, count : int
        Which of how many, from 1.
    """

    trip: Trip
    span: tuple[int, int]
    number: int
    count: int

    def named(self) -> Trip:
        """The trip; one of several stretches has its number in the name."""
        if self.count == 1:
            return self.trip
        name = f"{self.trip.name} ({self.number} of {self.count})"
        return replace(self.trip, metadata={**self.trip.metadata, "trip": name})

    def core(self, trip: Trip) -> Trip:
        """The rows of the stretch itself in a trip made of it, without the margins."""
        return trip if self.count == 1 else trip.cut(np.array([self.span], dtype=np.int64))


def stretches(
    path: str | Path, topics: Sequence[str] | None = None, *, rows: int | None = None
) -> Iterator[Stretch]:
    """Read a log in stretches, in the order of time.

    Parameters
    ----------
    path : path
    topics : sequence of str, optional
        Default: all.
    rows : int, optional
        A log with so many rows over these topics is one stretch; the stretches of a longer one
        have `FINER` times fewer, without their margins. Default: `ROWS`.

    Yields
    ------
    Stretch
        One at least.

    Raises
    ------
    LogError, InputError
        As `read_log`.

    Examples
    --------
    >>> [part.number for part in stretches("sample_logs/nonstop.mcap", ["/train/state"])]
    [1]
    >>> len(list(stretches("sample_logs/nonstop.mcap", ["/train/state"], rows=5_000))) > 1
    True
    """
    borders = _borders(path, topics, rows or ROWS)
    if not borders:
        yield Stretch(read_log(path, topics), ALWAYS, 1, 1)
        return
    margin = round(MARGIN * NANOSECONDS)
    edges = [ALWAYS[0], *borders, ALWAYS[1] + 1]
    bare = read_log(path, [])
    for number in range(1, len(edges)):
        first, last = edges[number - 1], edges[number] - 1
        time = (
            None if number == 1 else pd.Timestamp(max(first - margin, 0), tz="UTC"),
            None if number == len(edges) - 1 else pd.Timestamp(last + margin, tz="UTC"),
        )
        part = replace(read_log(path, topics, time=time), provenance=bare.provenance)
        yield Stretch(part, (first, last), number, len(edges) - 1)


def _borders(path: str | Path, topics: Sequence[str] | None, rows: int) -> list[int]:
    """Times [ns] at which a log is parted: where chunks begin, so that few are read twice."""
    with Source(path) as source, in_file(path):
        contents = contents_of(source)
        channels = {
            each.channel.id
            for each in topic_channels(contents)
            if topics is None or each.topic.name in topics
        }
        chunks = sorted(contents.chunks, key=lambda place: place.start)
    held = [sum(n for channel, n in each.counts.items() if channel in channels) for each in chunks]
    if sum(held) <= rows:
        return []
    count = -(-sum(held) * FINER // rows)
    before = np.cumsum(held) - held
    wanted = np.arange(1, count) * (sum(held) / count)
    firsts = np.unique(np.clip(np.searchsorted(before, wanted), 1, len(chunks) - 1))
    return sorted({int(chunks[index].start) for index in firsts.tolist()})

"""A log piece by piece, for logs larger than the memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.errors import InputError
from trainlog.mcap.contents import contents_of
from trainlog.mcap.errors import in_file
from trainlog.mcap.filling import frames_in, topic_channels
from trainlog.mcap.places import ChunkPlace
from trainlog.mcap.reader import (
    bare_trip,
    check_readable,
    report_losses,
    spans_of,
    with_losses,
)
from trainlog.mcap.selection import Selection, Topics, chunks_within, selection_of
from trainlog.mcap.source import Source
from trainlog.mcap.stored import MisplacedError
from trainlog.mcap.walk import contents_by_walk
from trainlog.spans import Spans
from trainlog.trip import Trip

_LARGEST_GROUP = 2**26
"""Chunks are read together up to this length when decompressed [bytes]."""

_Frames = dict[str, pd.DataFrame]


def stream_log(
    path: str | Path,
    topics: Topics | None = None,
    *,
    time: tuple[Any, Any] | None = None,
    position: tuple[float | None, float | None] | None = None,
    rows: int = 1_000_000,
) -> Iterator[Trip]:
    """Read a trip, or a part of one, piece by piece in the order of time.

    The pieces one after the other are what `read_log` gives. The memory in use does not grow with
    the log, unless its chunks overlap in time, as some writers' do: messages wait for their turn.

    Parameters
    ----------
    path, topics, time, position
        As for `read_log`.
    rows : int
        Most rows of a piece, over all topics.

    Yields
    ------
    Trip
        With every topic, without rows perhaps, and the metadata, provenance and attachments of the
        whole; the provenance of the last tells what is lost. There is at least one. Messages of the
        same instant are in the same piece, if they are no more than `rows`.

    Raises
    ------
    LogError, InputError
        As `read_log`, when the first piece is asked for; here if `rows` is not positive.

    Warns
    -----
    DamageWarning
        Behind the last piece, if something is lost.
    """
    if rows < 1:
        raise InputError(f"rows is {rows}", remedy="give the most rows of a piece, at least 1")
    return _pieces(path, selection_of(topics, time, position), rows)


def _pieces(path: str | Path, selection: Selection, rows: int) -> Iterator[Trip]:
    with Source(path) as source, in_file(path):
        stream = _Stream(source, selection)
        told = None
        for frames in stream.groups(rows):
            for part in _cut(frames, rows):
                told = stream.told
                yield replace(told, topics=part)
        if told is None or told.provenance != stream.told.provenance:
            # What is lost shows in a piece without rows, too.
            yield replace(stream.told, topics=stream.none)
        check_readable(stream.contents.account)
    report_losses(path, stream.contents)


class _Stream:
    """The state of one reading: what of the file is still to come."""

    def __init__(self, source: Source, selection: Selection) -> None:
        self._source = source
        self._selection = selection
        self.contents = contents_of(source)
        try:
            self._spans = self._begin()
        except MisplacedError:
            self.contents = contents_by_walk(source)
            self._spans = self._begin()
        self.none = frames_in(source, self.contents, [], selection.columns, threads=1)

    def _begin(self) -> Spans:
        bare = bare_trip(self._source, self.contents)
        selection = self._selection
        self.bare = bare.with_slice(time=selection.time, position=selection.position)
        return spans_of(self._source, self.contents, selection, threads=1)

    @property
    def told(self) -> Trip:
        """The trip without its topics; its provenance tells the losses met so far."""
        return with_losses(self.bare, self.contents)

    def groups(self, rows: int) -> Iterator[_Frames]:
        """The rows of all topics that come before all that follow, some chunks at a time."""
        selection = self._selection
        done: set[int] = set()
        waiting: _Frames = {}
        chunks = self._chunks(done)
        while chunks:
            group = self._group(chunks, rows)
            try:
                frames = frames_in(self._source, self.contents, group, selection.columns, threads=2)
            except MisplacedError:
                # What was yielded stays; a walk tells what of the rest there is.
                self.contents = contents_by_walk(self._source)
                chunks = self._chunks(done)
                continue
            done.update(place.offset for place in group)
            chunks = chunks[len(group) :]
            if selection.time is not None or selection.position is not None:
                frames = replace(self.bare, topics=frames).cut(self._spans).topics
            waiting = {name: _joined(waiting.get(name), frame) for name, frame in frames.items()}
            if not chunks:
                break
            until = min(place.start for place in chunks)
            ready = {
                name: frame.iloc[: _times(frame).searchsorted(until)]
                for name, frame in waiting.items()
            }
            waiting = {name: frame.iloc[len(ready[name]) :] for name, frame in waiting.items()}
            yield ready
        yield waiting

    def _chunks(self, done: set[int]) -> list[ChunkPlace]:
        """The chunks that are still to be read, in the order of time."""
        self._channels = {
            each.channel.id
            for each in topic_channels(self.contents)
            if each.topic.name in self._selection.columns
        }
        wanted = [
            place
            for place in chunks_within(self.contents.chunks, self._spans)
            if place.offset not in done and not self._channels.isdisjoint(place.counts)
        ]
        return sorted(wanted, key=lambda place: (place.start, place.offset))

    def _group(self, chunks: Sequence[ChunkPlace], rows: int) -> list[ChunkPlace]:
        """The first of the chunks, as many as make a piece."""
        held = size = 0
        group: list[ChunkPlace] = []
        for place in chunks:
            held += sum(count for number, count in place.counts.items() if number in self._channels)
            size += place.size
            if group and (held > rows or size > _LARGEST_GROUP):
                break
            group.append(place)
        return group


def _joined(waiting: pd.DataFrame | None, frame: pd.DataFrame) -> pd.DataFrame:
    """The rows that wait and those that follow, in the order of time."""
    if waiting is None or waiting.empty:
        return frame
    if frame.empty:
        return waiting
    joined = pd.concat([waiting, frame])
    if not joined.index.is_monotonic_increasing:
        joined = joined.sort_index(kind="stable")
    joined.attrs = frame.attrs
    return joined


def _times(frame: pd.DataFrame) -> NDArray[np.int64]:
    return pd.DatetimeIndex(frame.index).as_unit("ns").asi8


def _cut(frames: _Frames, rows: int) -> Iterator[_Frames]:
    """The frames in pieces of at most `rows` rows over all of them, in the order of time."""
    while True:
        times = {name: _times(frame) for name, frame in frames.items()}
        count = sum(len(each) for each in times.values())
        if count <= rows:
            if count:
                yield frames
            return
        merged = np.sort(np.concatenate(list(times.values())))
        ends = {name: int(each.searchsorted(merged[rows])) for name, each in times.items()}
        if not any(ends.values()):
            # More messages of one instant than a piece may have.
            left = rows
            for name, each in times.items():
                ends[name] = min(left, int(each.searchsorted(merged[0], side="right")))
                left -= ends[name]
        yield {name: frame.iloc[: ends[name]] for name, frame in frames.items()}
        frames = {name: frame.iloc[ends[name] :] for name, frame in frames.items()}

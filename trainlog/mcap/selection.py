"""Which part of a log is asked for, and which of its chunks can hold that.

Where the train was in each chunk is kept in the metadata record `POSITIONS_RECORD`: for each topic
with the train's position, one entry a chunk that has messages of the topic. An entry is four
little-endian words of eight bytes: where the chunk begins in the file and the log time of its first
message, as integers, and the least and the greatest position, as doubles, NaN if none is known. The
entries follow each other, in base64. A file without the record is read no differently, only slower.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.arrays import IntArray
from trainlog.errors import InputError, LogError
from trainlog.mcap.codec import codec_for
from trainlog.mcap.index import (
    ChunkPlace,
    Contents,
)
from trainlog.mcap.records import POSITIONS_RECORD, Source
from trainlog.mcap.tables import Wanted, frames_in, topic_channels
from trainlog.spans import ALWAYS, Spans, merged_spans, position_limits, spans_within, time_limits
from trainlog.topics import RECORDED, TOPICS, Topic, column_field
from trainlog.trip import NO_POSITION, POSITION_TOPICS

Topics = Iterable[str] | Mapping[str, Iterable[str] | None]
"""Names of topics, or the columns asked for by topic, None for all."""


Range = tuple[float, float]
"""Least and greatest position [m]; NaN if none is known."""

Entry = tuple[int, int, float, float]
"""Where a chunk begins, the log time of its first message [ns], its least and greatest position."""

_AT_ONCE = 64
"""Chunks whose positions are held at a time, where the file does not have them."""

_ENTRY = np.dtype([("offset", "<u8"), ("start", "<u8"), ("least", "<f8"), ("greatest", "<f8")])


def encoded(entries: Sequence[Entry]) -> str:
    """The entries of a topic as text."""
    return base64.b64encode(np.array(entries, dtype=_ENTRY).tobytes()).decode("ascii")


def decoded(text: str) -> dict[tuple[int, int], Range]:
    """The positions by offset and start of the chunk; empty if the text is no such index."""
    try:
        data = base64.b64decode(text, validate=True)
        entries = np.frombuffer(data, dtype=_ENTRY).tolist()
    except (binascii.Error, ValueError):
        return {}
    return {(offset, start): (least, greatest) for offset, start, least, greatest in entries}


def range_in(topic: str, data: NDArray[np.uint8], offsets: IntArray) -> Range | None:
    """The positions of a topic's messages in a chunk that is being written; None if it has none."""
    place = _place(topic)
    if place is None or not len(offsets):
        return None
    windows = np.ndarray((len(data) - 7,), "V8", data, 0, (1,))
    values = windows[offsets + place].view(np.float64)
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)


@cache
def _place(topic: str) -> int | None:
    """Where the position stands in a message as this version writes it; None if it has none."""
    if topic not in POSITION_TOPICS:
        return None
    return codec_for(TOPICS[topic], 1, {}).layout.place("position")


def position_ranges(contents: Contents, topic: str) -> list[tuple[ChunkPlace, Range]] | None:
    """The chunks with messages of a topic, each with its positions; None if any is not known."""
    stored = [
        record.metadata[topic]
        for record in contents.metadata
        if record.name == POSITIONS_RECORD and topic in record.metadata
    ]
    known = {key: each for text in stored for key, each in decoded(text).items()}
    found = []
    for place in _with_topic(contents, topic):
        if (place.offset, place.start) not in known:
            return None
        found.append((place, known[place.offset, place.start]))
    return found


def spans_in_log(
    source: Source, contents: Contents, stretch: tuple[float, float], threads: int
) -> Spans:
    """When the train was on a stretch of the line.

    Raises
    ------
    LogError
        If the log does not know where the train was.
    MisplacedError
        If something is not as the summary says.
    """
    for topic in POSITION_TOPICS:
        spans = _spans_by(source, contents, topic, stretch, threads)
        if spans is not None:
            return spans
    raise LogError("does not know where the train was", remedy=NO_POSITION)


def position_span(source: Source, contents: Contents, topic: str) -> tuple[float, float] | None:
    """Least and greatest position by a topic [m]; None if it has none.

    Raises
    ------
    LogError
        If messages are not what their channel says.
    MisplacedError
        If something is not as the summary says.
    """
    ranges = position_ranges(contents, topic)
    if ranges is None:
        ranges = []
        places = _with_topic(contents, topic)
        for at in range(0, len(places), _AT_ONCE):
            group = places[at : at + _AT_ONCE]
            frames = frames_in(source, contents, group, {topic: frozenset(["position"])}, threads=1)
            position = frames[topic]["position"].to_numpy()
            known = position[np.isfinite(position)]
            if len(known):
                ranges.append((group[0], (float(known.min()), float(known.max()))))
    known_ranges = [each for _, each in ranges if not np.isnan(each[0])]
    if not known_ranges:
        return None
    return min(least for least, _ in known_ranges), max(most for _, most in known_ranges)


def _spans_by(
    source: Source, contents: Contents, topic: str, stretch: tuple[float, float], threads: int
) -> Spans | None:
    """The same by one topic; None if it knows no position."""
    ranges = position_ranges(contents, topic)
    if ranges is None or not _in_order(place for place, _ in ranges):
        runs, known = [_with_topic(contents, topic)], False
    else:
        located = [(place, each) for place, each in ranges if not np.isnan(each[0])]
        runs, known = _runs_near(located, stretch), bool(located)
    spans = [np.empty((0, 2), dtype=np.int64)]
    for run in runs:
        frame = frames_in(source, contents, run, {topic: frozenset(["position"])}, threads).get(
            topic
        )
        if frame is not None:
            position = frame["position"].to_numpy()
            known = known or bool(np.isfinite(position).any())
            time = pd.DatetimeIndex(frame.index).as_unit("ns").asi8
            spans.append(spans_within(time, position, *stretch))
    return merged_spans(np.concatenate(spans)) if known else None


def _with_topic(contents: Contents, topic: str) -> list[ChunkPlace]:
    numbers = {each.channel.id for each in topic_channels(contents) if each.topic.name == topic}
    return [place for place in contents.chunks if not numbers.isdisjoint(place.counts)]


def _in_order(places: Iterable[ChunkPlace]) -> bool:
    """Whether the chunks follow each other in time, so that neighbours are neighbours."""
    listed = list(places)
    return all(one.end <= other.start for one, other in pairwise(listed))


def _runs_near(
    located: list[tuple[ChunkPlace, Range]], stretch: tuple[float, float]
) -> list[list[ChunkPlace]]:
    """Chunks next to each other in which, or between which, the train can have been there."""
    if not located:
        return []
    least, greatest = np.array([each for _, each in located]).T
    # Between the last sample of a chunk and the first of the next it was between both.
    joint = (np.minimum(least[1:], least[:-1]) <= stretch[1]) & (
        np.maximum(greatest[1:], greatest[:-1]) >= stretch[0]
    )
    near = (least <= stretch[1]) & (greatest >= stretch[0])
    near[1:] |= joint
    near[:-1] |= joint
    runs: list[list[ChunkPlace]] = []
    for number in np.flatnonzero(near).tolist():
        # Two chunks with a gap in which the train was not there need not be read together.
        if number and near[number - 1] and runs:
            runs[-1].append(located[number][0])
        else:
            runs.append([located[number][0]])
    return runs


# --------------------------------------------------------------------------- what is asked for


@dataclass(frozen=True)
class Selection:
    """A part of a log.

    Attributes
    ----------
    columns : Wanted
    time : (Any, Any) or None
        As given; checked.
    span : (int, int)
        The same [ns since 1970 UTC].
    position : (float, float) or None
        As given; checked.
    whole : bool
        Whether it leaves out nothing.
    """

    columns: Wanted
    time: tuple[Any, Any] | None
    span: tuple[int, int]
    position: tuple[float | None, float | None] | None
    whole: bool

    @property
    def stretch(self) -> tuple[float, float]:
        """The position's limits [m]; infinite where open."""
        return position_limits(*(self.position or (None, None)))


def selection_of(
    topics: Topics | None,
    time: tuple[Any, Any] | None,
    position: tuple[float | None, float | None] | None,
) -> Selection:
    """The part of a log that is asked for, checked.

    Raises
    ------
    LogError
        If there is no such topic or column.
    InputError
        If a limit is no time or no position, or the limits are in the wrong order.
    """
    ends = _pair("time", time)
    stretch = _pair("position", position)
    span = ALWAYS if ends is None else time_limits(*ends)
    if stretch is not None:
        position_limits(*stretch)
    whole = topics is None and ends is None and stretch is None
    return Selection(_columns(topics), ends, span, stretch, whole)


def _pair(name: str, limits: Sequence[Any] | None) -> tuple[Any, Any] | None:
    if limits is None:
        return None
    if isinstance(limits, str) or not hasattr(limits, "__len__") or len(limits) != 2:
        raise InputError(f"{name} is {limits!r}, not two limits", remedy=f"give {name}=(from, to)")
    return limits[0], limits[1]


def _columns(topics: Topics | None) -> Wanted:
    if topics is None:
        return None
    if isinstance(topics, str):
        topics = [topics]
    asked = topics if isinstance(topics, Mapping) else dict.fromkeys(topics)
    for name in asked:
        if name not in TOPICS and not name.startswith(RECORDED):
            raise LogError(f"there is no topic {name}", remedy=f"topics are {', '.join(TOPICS)}")
    return {
        name: None if names is None else _known(TOPICS.get(name), names)
        for name, names in asked.items()
    }


def _known(topic: Topic | None, names: Iterable[str]) -> frozenset[str]:
    """The names, of which a topic of the table must have each; what others have the log knows."""
    names = frozenset([names] if isinstance(names, str) else names)
    if topic is None:
        return names
    for name in sorted(names):
        try:
            column_field(topic, name)
        except KeyError:
            raise LogError(
                f"{topic.name} has no column {name}",
                remedy=f"its fields are {', '.join(item.name for item in topic.fields)}; a field "
                "with one value for each axle has columns such as wheel_speed_1",
            ) from None
    return names


def chunks_within(chunks: Iterable[ChunkPlace], spans: Spans) -> list[ChunkPlace]:
    """The chunks that can hold messages in any of the spans of time."""
    listed = list(chunks)
    if len(spans) == 1 and tuple(spans[0]) == ALWAYS:
        return listed
    if not len(spans) or not listed:
        return []
    highest = np.iinfo(np.int64).max
    first = np.array([min(place.start, highest) for place in listed], dtype=np.int64)
    last = np.array([min(place.end, highest) for place in listed], dtype=np.int64)
    # The first span that ends at or after the chunk's start must begin before its end.
    number = np.searchsorted(spans[:, 1], first)
    begins = np.append(spans[:, 0], highest)[number]
    held = (number < len(spans)) & (begins <= last)
    return [listed[index] for index in np.flatnonzero(held)]


def spans_of(source: Source, contents: Contents, selection: Selection, threads: int) -> Spans:
    """The spans of time that are asked for.

    Raises
    ------
    LogError
        If a stretch of the line is asked for and the log does not know where the train was.
    MisplacedError
        As `trip_of`.
    """
    first, last = selection.span
    if selection.position is None:
        return np.array([[first, last]], dtype=np.int64)
    spans = spans_in_log(source, contents, selection.stretch, threads)
    spans = spans[(spans[:, 1] >= first) & (spans[:, 0] <= last)]
    return np.clip(spans, first, last)

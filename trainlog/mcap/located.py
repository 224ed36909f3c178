"""When the train was on a stretch of the line, found by reading only the chunks near it."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pandas as pd

from trainlog.errors import LogError
from trainlog.mcap.filling import frames_in, topic_channels
from trainlog.mcap.names import POSITIONS_RECORD
from trainlog.mcap.places import ChunkPlace, Contents
from trainlog.mcap.positions import Range, decoded
from trainlog.mcap.source import Source
from trainlog.spans import Spans, merged_spans, spans_within
from trainlog.trip import NO_POSITION, POSITION_TOPICS

_AT_ONCE = 64
"""Chunks whose positions are held at a time, where the file does not tell them."""


def position_ranges(contents: Contents, topic: str) -> list[tuple[ChunkPlace, Range]] | None:
    """The chunks with messages of a topic, each with its positions; None if any is not known."""
    stored = [
        record.metadata[topic]
        for record in contents.metadata
        if record.name == POSITIONS_RECORD and topic in record.metadata
    ]
    told = {key: each for text in stored for key, each in decoded(text).items()}
    found = []
    for place in _with_topic(contents, topic):
        if (place.offset, place.start) not in told:
            return None
        found.append((place, told[place.offset, place.start]))
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
    """Least and greatest position that a topic tells [m]; None if it tells none.

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

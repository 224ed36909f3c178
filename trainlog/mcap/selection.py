"""What part of a log is asked for: topics and columns, a span of time, a stretch of the line."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trainlog.errors import InputError, LogError
from trainlog.mcap.places import ChunkPlace
from trainlog.spans import ALWAYS, Spans, position_limits, time_limits
from trainlog.topics import TOPICS, Topic, column_field

Topics = Iterable[str] | Mapping[str, Iterable[str] | None]
"""Names of topics, or the columns asked for by topic, None for all."""

Columns = Mapping[str, frozenset[str] | None]
"""Columns to read by topic; None for all."""


@dataclass(frozen=True)
class Selection:
    """A part of a log.

    Attributes
    ----------
    columns : Columns
    time : (Any, Any) or None
        As given; checked.
    span : (int, int)
        The same [ns since 1970 UTC].
    position : (float, float) or None
        As given; checked.
    whole : bool
        Whether it leaves out nothing.
    """

    columns: Columns
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


def _columns(topics: Topics | None) -> Columns:
    if topics is None:
        return dict.fromkeys(TOPICS)
    if isinstance(topics, str):
        topics = [topics]
    asked = topics if isinstance(topics, Mapping) else dict.fromkeys(topics)
    for name in asked:
        if name not in TOPICS:
            raise LogError(f"there is no topic {name}", remedy=f"topics are {', '.join(TOPICS)}")
    return {
        name: None if names is None else _known(TOPICS[name], names)
        for name, names in asked.items()
    }


def _known(topic: Topic, names: Iterable[str]) -> frozenset[str]:
    names = frozenset([names] if isinstance(names, str) else names)
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

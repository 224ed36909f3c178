"""A topic's columns while they are being filled from the chunks of a log, by several threads."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from trainlog.mcap.codec import LOG_TIME, Codec, Columns, SampleCodec, codec_of, gather
from trainlog.mcap.decode import Decoder, columns_of, decoder_of
from trainlog.mcap.errors import unusable
from trainlog.mcap.records import message_data
from trainlog.mcap.stored import MisplacedError
from trainlog.topics import EVENTS, Topic, column_field
from trainlog.trip import frame_of

COMPILED_FROM = 4_000_000
"""Messages from which on loading the compiled loop is sooner done than reading with numpy."""


@dataclass
class TopicChannel:
    """A channel of a file that carries one of trainlog's topics.

    Attributes
    ----------
    channel, schema
        As the file has them.
    topic : Topic
    """

    channel: Channel
    schema: Schema
    topic: Topic

    @cached_property
    def codec(self) -> Codec | None:
        """How to read its messages as arrays; None if only one by one."""
        return codec_of(self.channel, self.schema)

    @cached_property
    def columns(self) -> list[str]:
        """The columns that its messages have if they fit the layout."""
        if self.codec is None:
            return []
        return list(self.codec.columns(self.codec.layout.rows(0)) or {})

    @cached_property
    def places(self) -> dict[str, int] | None:
        """Where each column's value stands in a message; None if a column is computed."""
        if not isinstance(self.codec, SampleCodec):
            return None
        found = {}
        for name in self.columns:
            item = column_field(self.topic, name) if _knows(self.topic, name) else None
            if item is not None and item.per_axle:
                axle = int(name.rpartition("_")[2]) - 1
                found[name] = self.codec.layout.place(item.name) + 8 * axle
            elif item is not None:
                found[name] = self.codec.layout.place(name)
        return found

    @cached_property
    def _decoder(self) -> Decoder:
        return decoder_of(self.channel, self.schema)

    def decoded(
        self, content: bytes, offsets: NDArray[np.uint64], chunk: int
    ) -> tuple[NDArray[np.uint64], Columns]:
        """Times and columns of messages in the chunk at byte `chunk`, decoded one by one.

        Raises
        ------
        MisplacedError
            If one is not where it should be.
        LogError
            If one is not what the channel says.
        """
        times, messages = [], []
        for offset in offsets.tolist():
            found = message_data(content, offset, self.channel.id)
            if found is None:
                raise MisplacedError(
                    f"a message of {self.topic.name} is not where it should be",
                    place=f"byte {chunk}",
                )
            times.append(found[0])
            messages.append(self._decoder(found[1]))
        return np.array(times, dtype=np.uint64), columns_of(self.topic, messages)


@dataclass(frozen=True)
class Apart:
    """Messages of one channel in one chunk that do not stand in the table's arrays."""

    time: NDArray[np.uint64]
    columns: Columns


@dataclass(frozen=True)
class Route:
    """Where the values of one channel's messages go: for each its place, and its column."""

    places: NDArray[np.int64]
    rows: NDArray[np.int64]
    absent: NDArray[np.int64]


@dataclass
class Table:
    """The rows of one topic, in the order in which their messages stand in the file.

    Attributes
    ----------
    topic : Topic
    wanted : set of str or None
        Columns asked for; None for all.
    names : list of str
        Columns, in the order of the frame.
    time : (n,) uint64
    columns : (columns, n) float64
        Not of events, whose texts are kept apart.
    routes : dict of int to Route
        By channel id, for the channels that the compiled loop reads.
    apart : dict of int to (int, Apart or None)
        By first row: how many rows stand elsewhere, and where; None if nothing could be read.
    """

    topic: Topic
    wanted: set[str] | None
    names: list[str]
    time: NDArray[np.uint64]
    columns: NDArray[np.float64]
    routes: dict[int, Route]
    apart: dict[int, tuple[int, Apart | None]] = field(default_factory=dict)

    def fill(
        self, source: TopicChannel, content: bytes, offsets: NDArray[np.uint64], start: int
    ) -> bool:
        """Take messages to the rows from `start` on; False if they do not fit the layout.

        Safe to be called from several threads, each for its own rows.
        """
        codec = source.codec
        if codec is None:
            return False
        part = slice(start, start + len(offsets))
        route = self.routes.get(source.channel.id)
        if route is not None:
            from trainlog.mcap.compiled import gather_columns

            self.columns[route.absent, part] = np.nan
            return bool(
                gather_columns(
                    np.frombuffer(content, dtype=np.uint8),
                    offsets,
                    codec.layout.size,
                    codec.layout.masks,
                    route.places,
                    self.time,
                    self.columns,
                    route.rows,
                    start,
                )
            )
        rows = gather(content, offsets, codec.layout)
        columns = None if rows is None else codec.columns(rows)
        if rows is None or columns is None:
            return False
        self.time[part] = rows[LOG_TIME]
        for number, name in enumerate(self.names):
            self.columns[number, part] = columns.get(name, np.nan)
        return True

    def set_apart(self, start: int, count: int, found: Apart | None) -> None:
        """Say that the `count` rows from `start` on are replaced by `found`, or lost."""
        self.apart[start] = (count, found)

    def frame(self) -> pd.DataFrame:
        """The topic's frame, in the order of time.

        Raises
        ------
        LogError
            If a time is beyond those that pandas has.
        """
        time, names, columns = self._joined()
        if len(time) and time.max() > np.uint64(pd.Timestamp.max.value):
            raise unusable(f"{self.topic.name} has times after {pd.Timestamp.max.year}")
        stamps = time.view(np.int64)
        if np.any(stamps[1:] < stamps[:-1]):
            order = np.argsort(stamps, kind="stable")
            stamps = stamps[order]
            columns = (
                columns[:, order]
                if isinstance(columns, np.ndarray)
                else {name: values[order] for name, values in columns.items()}
            )
        index = pd.DatetimeIndex(stamps.view("M8[ns]"), tz="UTC", name="time")
        if isinstance(columns, np.ndarray):
            frame = pd.DataFrame(columns.T, index=index, columns=names, copy=False)
        else:
            frame = frame_of(self.topic, index, columns)
            frame = frame[self._wanted(frame.columns)]
        units = {name: column_field(self.topic, name).unit for name in frame.columns}
        frame.attrs = {"topic": self.topic.name, "units": units}
        return frame

    def _joined(
        self,
    ) -> tuple[NDArray[np.uint64], list[str], NDArray[np.float64] | dict[str, Any]]:
        """Times and columns with what stands apart in its place."""
        if not self.apart and self.topic is not EVENTS:
            return self.time, self.names, self.columns
        parts: list[tuple[NDArray[np.uint64], Columns]] = []
        at = 0
        for start, (count, found) in [*sorted(self.apart.items()), (len(self.time), (0, None))]:
            if at < start and self.topic is not EVENTS:
                stands = dict(zip(self.names, self.columns[:, at:start], strict=True))
                parts.append((self.time[at:start], stands))
            if found is not None:
                parts.append((found.time, found.columns))
            at = start + count
        time = np.concatenate([np.empty(0, np.uint64), *(each for each, _ in parts)])
        if self.topic is EVENTS:
            texts = [columns for _, columns in parts] or [columns_of(EVENTS, [])]
            joined = {
                name: pd.concat([pd.Series(each[name]) for each in texts], ignore_index=True).array
                for name in texts[0]
            }
            return time, self.names, joined
        # A number of axles that no message has is not believed.
        names = self._wanted(
            {item.name for item in self.topic.fields if not item.per_axle}
            | {name for _, each in parts for name in each}
        )
        table = np.full((len(names), len(time)), np.nan)
        at = 0
        for times, each in parts:
            for number, name in enumerate(names):
                if name in each:
                    table[number, at : at + len(times)] = each[name]
            at += len(times)
        return time, names, table

    def _wanted(self, names: Iterable[str]) -> list[str]:
        ordered = in_order(self.topic, names)
        return [name for name in ordered if self.wanted is None or name in self.wanted]


def table_of(
    topic: Topic, sources: Mapping[int, TopicChannel], rows: int, wanted: Iterable[str] | None
) -> Table:
    """An empty table for the messages of a topic's channels.

    Parameters
    ----------
    topic : Topic
    sources : dict of int to TopicChannel
        By channel id, those whose layout the messages can have.
    rows : int
        How many messages of the topic there are.
    wanted : iterable of str, optional
        Columns; the others are left out. Default: all.
    """
    table = Table(
        topic,
        None if wanted is None else set(wanted),
        [],
        np.empty(rows, dtype=np.uint64),
        np.empty((0, 0)),
        {},
    )
    if topic is EVENTS:
        return table
    held = {name for source in sources.values() for name in source.columns}
    table.names = table._wanted(held | {item.name for item in topic.fields if not item.per_axle})
    table.columns = np.empty((len(table.names), rows))
    # Compiling is not worth its time for few messages; once another part has loaded the compiler,
    # only for very few.
    if rows >= COMPILED_FROM or (rows >= COMPILED_FROM // 1000 and "numba" in sys.modules):
        for number, source in sources.items():
            if source.places is not None:
                table.routes[number] = _route(table.names, source.places)
    return table


def _route(names: list[str], places: dict[str, int]) -> Route:
    known = [name for name in names if name in places]
    return Route(
        np.array([places[name] for name in known], dtype=np.int64),
        np.array([names.index(name) for name in known], dtype=np.int64),
        np.array([n for n, name in enumerate(names) if name not in places], dtype=np.int64),
    )


def in_order(topic: Topic, names: Iterable[str]) -> list[str]:
    """Those of the names that are columns of the topic, in the order of its frame."""
    numbers = {item.name: number for number, item in enumerate(topic.fields)}
    places = {}
    for name in names:
        if _knows(topic, name):
            item = column_field(topic, name)
            axle = int(name.rpartition("_")[2]) if item.per_axle else 0
            places[name] = (numbers[item.name], axle)
    return sorted(places, key=places.__getitem__)


def _knows(topic: Topic, column: str) -> bool:
    try:
        column_field(topic, column)
    except KeyError:
        return False
    return True

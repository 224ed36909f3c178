"""Any MCAP file as frames: whoever wrote it, in whichever encoding, as far as it can be read."""

from __future__ import annotations

import struct
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, takewhile
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mcap.records import Channel, Schema

from trainlog.arrays import IntArray
from trainlog.errors import LogError
from trainlog.mcap.account import Account
from trainlog.mcap.foreign_decoders import (
    DEEPEST,
    LONG_ARRAY,
    MOST_ELEMENTS,
    TOO_DEEP,
    BrokenMessage,
    Decode,
    Message,
    UndecodableError,
    Unexpanded,
    decoder_of,
)
from trainlog.mcap.index import ChunkPlace, Contents, MisplacedError, fetched
from trainlog.mcap.reader import check_data_section, report_losses
from trainlog.mcap.records import (
    MESSAGE,
    RECORD_HEAD,
    Index,
    Source,
    in_file,
    index_of,
    opened,
    shown,
)
from trainlog.mcap.scan import contents_used

MOST_COLUMNS = 2_000
"""Columns of a topic; names that are made up message by message must not fill the memory."""

_BATCH = 1_024
"""Messages that are turned into columns at once."""

_BATCH_BYTES = 2**20
"""Length of these messages; as objects they take many times that."""

_PLAIN = {bool, int, float, str}

_TOO_MANY = f"beyond the first {MOST_COLUMNS:,} columns of the topic"
_TWICE = "named twice in a message; the first is kept"
_VARYING = "an array whose length changes, not expanded"
_MIXED = "numbers in some messages, text in others"

_MOST_NAMED = 8
"""Topics that an error names."""

_LAST = pd.Timestamp.max
"""The last time that an index can hold."""

_LATEST = _LAST.value


@dataclass(frozen=True)
class Skipped:
    """Something of a topic that is not in its frame.

    Attributes
    ----------
    topic : str
    field : str
        Path of the field; empty if whole messages are meant.
    reason : str
    messages : int
        In how many messages.
    """

    topic: str
    field: str
    reason: str
    messages: int

    def __str__(self) -> str:
        place = f"{self.topic}.{self.field}" if self.field else self.topic
        return f"{place}: {self.reason} ({self.messages:,} messages)"


@dataclass(frozen=True, eq=False)
class ForeignFrames:
    """What an MCAP file holds, by topic.

    Attributes
    ----------
    frames : dict of str to DataFrame
        By topic, with the log time (UTC, ns) as index, in its order; one column a field, named by
        its path (``pose.position.x``, ``covariance[0]``). ``attrs`` hold ``schema`` and
        ``encoding``. A topic with several schemas has one frame each, ``"/topic (schema)"``.
    publish_times : dict of str to DatetimeIndex
        When each row of a frame was published, as the file says.
    account : Account
        What of the file is readable, and what is lost.
    skipped : tuple of Skipped
        What is not in the frames: channels and messages that cannot be decoded, and fields that do
        not become columns.
    """

    frames: dict[str, pd.DataFrame]
    publish_times: dict[str, pd.DatetimeIndex]
    account: Account
    skipped: tuple[Skipped, ...] = ()


def frames_of(path: str | Path, topics: Iterable[str] | None = None) -> ForeignFrames:
    """Read the frames of any MCAP file, whoever wrote it.

    Messages in protobuf, JSON, ROS 1 and ROS 2 (CDR) are decoded. What cannot be decoded is listed
    and counted, the rest still comes. Of a damaged file everything readable comes, with a
    `DamageWarning`.

    Parameters
    ----------
    path : path
    topics : iterable of str, optional
        Topics to read. Default: all.

    Returns
    -------
    ForeignFrames
        With a frame, without rows if need be, for every channel whose encoding is known.

    Raises
    ------
    LogError
        If it is no MCAP file, or has no topic of a name that is asked for.
    InputError
        If there is no such file.
    MissingExtraError
        If messages of ROS are asked for and rosbags is not installed.

    Examples
    --------
    >>> import trainlog
    >>> found = trainlog.frames("sample_logs/nonstop.mcap", topics=["/train/state"])
    >>> found.frames["/train/state"].attrs
    {'schema': 'trainlog.TrainState', 'encoding': 'protobuf'}
    >>> found.account.whole, found.skipped
    (True, ())
    """
    with Source(path) as source, in_file(path):
        contents, found = contents_used(source, lambda contents: _read(source, contents, topics))
    report_losses(path, contents)
    return replace(found, account=contents.account)


def _read(source: Source, contents: Contents, topics: Iterable[str] | None) -> ForeignFrames:
    """The frames of the topics; if all are asked for, the rest of the file is verified, too."""
    found = _frames(source, contents, _wanted(contents, topics))
    if topics is None:
        check_data_section(source, contents)
    return found


def _wanted(contents: Contents, topics: Iterable[str] | None) -> list[Channel]:
    channels = list(contents.channels.values())
    if topics is None:
        return channels
    asked = {topics} if isinstance(topics, str) else set(topics)
    held = sorted({channel.topic for channel in channels})
    for name in sorted(asked - set(held)):
        named = ", ".join(shown(topic) for topic in held[:_MOST_NAMED]) or "none at all"
        more = f" and {len(held) - _MOST_NAMED} more" if len(held) > _MOST_NAMED else ""
        raise LogError(f"holds no topic {shown(name)}", remedy=f"topics are {named}{more}")
    return [channel for channel in channels if channel.topic in asked]


# -------------------------------------------------------------------------------------- columns


class _Column:
    """The values of one path; `rows` are the messages that have one."""

    def __init__(self) -> None:
        self.rows = array("q")
        self.kinds: set[type] = set()
        self.pieces: list[Any] = []

    def extend(self, rows: Iterable[int], values: Sequence[Any], kinds: set[type]) -> None:
        """Add the values of many messages."""
        self.pieces.append(_packed(values, kinds))
        self.rows.extend(rows)
        self.kinds |= kinds

    def values(self) -> list[Any]:
        """All values, as they came."""
        return list(
            chain.from_iterable(
                piece if isinstance(piece, list) else piece.tolist() for piece in self.pieces
            )
        )


def _packed(values: Sequence[Any], kinds: set[type]) -> Any:
    """Numbers of one kind as an array, to save memory; everything else as a list."""
    try:
        if kinds == {float}:
            return np.array(values, dtype=np.float64)
        if kinds == {int}:
            return np.array(values, dtype=np.int64)
    except OverflowError:
        pass
    return list(values)


class Columns:
    """The columns of a topic while its messages are added.

    Attributes
    ----------
    skipped : Counter of (str, str)
        How many messages had a field (path) that did not become a column, by its reason.
    """

    def __init__(self) -> None:
        self.skipped: Counter[tuple[str, str]] = Counter()
        self._columns: dict[str, _Column] = {}
        self._lengths: dict[str, Counter[int]] = {}
        self._batch: list[Message] = []
        self._waiting = 0
        self._count = 0

    def add(self, message: Message, size: int) -> None:
        """Add what a decoded message of `size` bytes says as the next row."""
        self._batch.append(message)
        self._waiting += size
        if len(self._batch) >= _BATCH or self._waiting >= _BATCH_BYTES:
            self._flush()

    def frame(self) -> dict[str, Any]:
        """The columns; absent values are NaN, or NA in whole numbers and flags."""
        self._flush()
        for path, lengths in self._lengths.items():
            if sum(1 for length in lengths if length) > 1:
                self._drop(f"{path}[")
                self.skipped[path, _VARYING] += lengths.total()
        found = {}
        for path, column in self._columns.items():
            values = _array(column, self._count)
            if values is None:
                self.skipped[path, _MIXED] += len(column.rows)
            else:
                found[path] = values
        return found

    def _flush(self) -> None:
        """Turn the messages that wait into columns."""
        batch, self._batch, self._waiting = self._batch, [], 0
        rows = range(self._count, self._count + len(batch))
        if batch:
            self._spread(rows, batch, "", 0)
        self._count = rows.stop

    def _spread(
        self, rows: Sequence[int], messages: Sequence[Message], prefix: str, depth: int
    ) -> None:
        """Take messages, or messages within them, that stand at the same path."""
        for name, (held, values) in _by_name(rows, messages).items():
            self._take(held, f"{prefix}.{name}" if prefix else name, values, depth)

    def _take(self, rows: Sequence[int], path: str, values: Sequence[Any], depth: int) -> None:
        """Take what stands at the same path of all these rows."""
        kinds = set(map(type, values))
        if kinds <= _PLAIN:
            self._extend(rows, path, values, kinds)
        elif len(kinds) > 1:
            for held, same in _by_kind(rows, values):
                self._take(held, path, same, depth)
        elif kinds == {Unexpanded}:
            for reason, count in Counter(value.reason for value in values).items():
                self._skip(path, reason, count)
        elif not kinds <= {dict, list}:
            (kind,) = kinds
            if kind is not type(None):
                self._skip(path, f"a {kind.__name__}, not expanded", len(values))
        elif depth >= DEEPEST:
            self._skip(path, TOO_DEEP.reason, len(values))
        elif kinds == {dict}:
            self._spread(rows, values, path, depth + 1)
        else:
            self._take_lists(rows, path, values, depth)

    def _take_lists(
        self, rows: Sequence[int], path: str, values: Sequence[list[Any]], depth: int
    ) -> None:
        """Take the elements of arrays; of changing lengths only until that shows."""
        lengths = Counter(map(len, values))
        for length in [each for each in lengths if each > MOST_ELEMENTS]:
            self._skip(path, LONG_ARRAY.reason, lengths.pop(length))
        if path in self._lengths or len(self._lengths) < MOST_COLUMNS:
            self._lengths.setdefault(path, Counter()).update(lengths)
        for length in lengths:
            held, lists = rows, values
            if len(lengths) > 1 or len(values) > lengths[length]:
                pairs = zip(rows, values, strict=True)
                held, lists = zip(*(pair for pair in pairs if len(pair[1]) == length), strict=True)
            for at in range(length):
                self._take(held, f"{path}[{at}]", list(map(itemgetter(at), lists)), depth + 1)

    def _extend(
        self, rows: Sequence[int], path: str, values: Sequence[Any], kinds: set[type]
    ) -> None:
        column = self._columns.get(path)
        if column is None:
            if len(self._columns) >= MOST_COLUMNS:
                self._skip("", _TOO_MANY, len(rows))
                return
            column = self._columns[path] = _Column()
        elif column.rows and column.rows[-1] >= self._count:
            known = set(takewhile(lambda row: row >= self._count, reversed(column.rows)))
            new = {row: each for row, each in zip(rows, values, strict=True) if row not in known}
            if len(new) < len(rows):
                self._skip(path, _TWICE, len(rows) - len(new))
            rows, values, kinds = [*new], [*new.values()], set(map(type, new.values()))
        if len(rows):
            column.extend(rows, values, kinds)

    def _skip(self, path: str, reason: str, messages: int = 1) -> None:
        known = (path, reason) in self.skipped or len(self.skipped) < MOST_COLUMNS
        self.skipped[(path, reason) if known else ("", _TOO_MANY)] += messages

    def _drop(self, start: str) -> None:
        self._columns = {
            path: column for path, column in self._columns.items() if not path.startswith(start)
        }


def _by_name(
    rows: Sequence[int], messages: Sequence[Message]
) -> Mapping[str, tuple[Sequence[int], list[Any]]]:
    """What messages say under each name, and in which rows."""
    if all(message.keys() == messages[0].keys() for message in messages):
        return {name: (rows, list(map(itemgetter(name), messages))) for name in messages[0]}
    found: dict[str, tuple[list[int], list[Any]]] = {}
    for row, message in zip(rows, messages, strict=True):
        for name, value in message.items():
            held, values = found.setdefault(name, ([], []))
            held.append(row)
            values.append(value)
    return found


def _by_kind(
    rows: Sequence[int], values: Sequence[Any]
) -> Iterable[tuple[Sequence[int], Sequence[Any]]]:
    """Numbers and texts, and values of each other kind, with their rows."""
    found: dict[type, tuple[list[int], list[Any]]] = {}
    for row, value in zip(rows, values, strict=True):
        kind = str if type(value) in _PLAIN else type(value)
        held, same = found.setdefault(kind, ([], []))
        held.append(row)
        same.append(value)
    return found.values()


def _array(column: _Column, count: int) -> Any:
    """A column as an array of `count` rows; None if it holds both numbers and text."""
    rows = np.frombuffer(column.rows, dtype=np.int64)
    if str in column.kinds:
        return _texts(column, count) if column.kinds == {str} else None
    if column.kinds == {bool}:
        return _whole(rows, np.array(column.values(), dtype=np.bool_), count, "boolean")
    if float not in column.kinds:
        whole = _whole_numbers(column)
        if whole is not None:
            return _whole(rows, whole, count, "Int64" if whole.dtype == np.int64 else "UInt64")
    values = np.full(count, np.nan)
    values[rows] = np.concatenate([_floats(piece) for piece in column.pieces])
    return values


def _whole_numbers(column: _Column) -> Any:
    """Whole numbers as int64 or uint64; None if they fit neither."""
    if all(isinstance(piece, np.ndarray) for piece in column.pieces):
        return np.concatenate(column.pieces)
    values = column.values()
    for kind in (np.int64, np.uint64):
        try:
            return np.array(values, dtype=kind)
        except OverflowError:
            continue
    return None


def _whole(rows: Any, found: Any, count: int, nullable: Any) -> Any:
    """Whole numbers or flags; with NA, which leaves large ones exact, where there are none."""
    if len(rows) == count:
        return found
    values = np.zeros(count, dtype=found.dtype)
    values[rows] = found
    absent = np.ones(count, dtype=np.bool_)
    absent[rows] = False
    series: Any = pd.Series(values).astype(nullable).array
    series[absent] = pd.NA
    return series


def _texts(column: _Column, count: int) -> Any:
    texts: list[str | None] = [None] * count
    for row, text in zip(column.rows, column.values(), strict=True):
        # JSON can name halves of surrogate pairs, which no file can be written with.
        texts[row] = text if text.isascii() else text.encode("utf-8", "replace").decode()
    return pd.array(texts, dtype="str")


def _floats(piece: Any) -> Any:
    if isinstance(piece, np.ndarray):
        return piece.astype(np.float64)
    return np.array([_as_float(value) for value in piece])


def _as_float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:
        return np.inf if value > 0 else -np.inf


# --------------------------------------------------------------------------------------- topics


@dataclass(eq=False)
class _Table:
    """A topic's messages while they are being read."""

    topic: str
    schema: str
    encoding: str
    decode: Decode
    time: list[int] = field(default_factory=list)
    published: list[int] = field(default_factory=list)
    columns: Columns = field(default_factory=Columns)
    broken: Counter[str] = field(default_factory=Counter)

    def add(self, content: bytes, offset: int) -> None:
        """Add the message that stands at `offset` of a chunk, or count it as broken."""
        try:
            _, length, _, _, time, published = MESSAGE.unpack_from(content, offset)
            if length < MESSAGE.size - RECORD_HEAD:
                raise BrokenMessage("its record is too short")
            if time > _LATEST or published > _LATEST:
                raise BrokenMessage(f"its time is after {_LAST.year}")
            message = self.decode(content[offset + MESSAGE.size : offset + RECORD_HEAD + length])
        except struct.error:
            self.broken["its record is too short"] += 1
        except BrokenMessage as error:
            self.broken[str(error)] += 1
        else:
            self.columns.add(message, length)
            self.time.append(time)
            self.published.append(published)

    def frame(self) -> tuple[pd.DataFrame, pd.DatetimeIndex]:
        """The frame in the order of log time, and the publish times of its rows."""
        time = np.array(self.time, dtype=np.int64)
        frame = pd.DataFrame(self.columns.frame(), index=_index(time))
        published = np.array(self.published, dtype=np.int64)
        if np.any(np.diff(time) < 0):
            order = np.argsort(time, kind="stable")
            frame, published = frame.iloc[order], published[order]
        frame.attrs = {"schema": self.schema, "encoding": self.encoding}
        return frame, _index(published)

    def skipped(self, name: str) -> list[Skipped]:
        """What of the topic is not in the frame."""
        whole = [Skipped(name, "", reason, count) for reason, count in self.broken.items()]
        return whole + [
            Skipped(name, path, reason, count)
            for (path, reason), count in self.columns.skipped.items()
        ]


def _frames(source: Source, contents: Contents, channels: list[Channel]) -> ForeignFrames:
    """The frames of the channels; chunks that turn out damaged are dropped from the contents.

    Raises
    ------
    MisplacedError
        If the summary by which the contents were found turns out to be wrong.
    """
    by_channel, skipped = _tables(contents, channels)
    for place in list(contents.chunks):
        if place.counts.keys().isdisjoint(by_channel):
            continue
        try:
            content, index = _opened(source, place)
        except LogError as error:
            if contents.indexed and isinstance(error, MisplacedError):
                raise
            contents.drop(place, error.problem)
            continue
        if contents.indexed and place.counts != {each: len(at) for each, at in index.items()}:
            raise MisplacedError("the summary counts other messages", place=f"byte {place.offset}")
        for channel, entries in index.items():
            if channel in by_channel:
                table = by_channel[channel]
                for offset in entries[:, 1].tolist():
                    table.add(content, offset)
    frames, published = {}, {}
    for name, table in _named(by_channel.values()):
        frames[name], published[name] = table.frame()
        skipped += table.skipped(name)
    return ForeignFrames(frames, published, contents.account, tuple(skipped))


def _tables(contents: Contents, channels: list[Channel]) -> tuple[dict[int, _Table], list[Skipped]]:
    """Where the messages of each channel go, and the channels that cannot be decoded."""
    counts = contents.counts()
    tables: dict[tuple[object, ...], _Table] = {}
    by_channel: dict[int, _Table] = {}
    skipped = []
    for channel in channels:
        schema = contents.schema(channel)
        key = _kind(channel, schema)
        try:
            if key not in tables:
                name = schema.name if schema else ""
                decode = decoder_of(channel, schema)
                tables[key] = _Table(channel.topic, name, channel.message_encoding, decode)
            by_channel[channel.id] = tables[key]
        except UndecodableError as error:
            skipped.append(Skipped(channel.topic, "", str(error), counts[channel.id]))
    return by_channel, skipped


def _opened(source: Source, place: ChunkPlace) -> tuple[bytes, Index]:
    """The content of a chunk and, by its own records, where its messages are."""
    content = opened(fetched(source, place), check=True)
    return content, index_of(content, place.offset)


def _kind(channel: Channel, schema: Schema | None) -> tuple[object, ...]:
    """What the channels of one frame have in common."""
    of_schema = (schema.name, schema.encoding, schema.data) if schema else None
    return channel.topic, channel.message_encoding, of_schema


def _named(tables: Iterable[_Table]) -> Iterator[tuple[str, _Table]]:
    """The tables by topic; where a topic has several, by topic and schema."""
    listed = list(dict.fromkeys(tables))
    topics = Counter(table.topic for table in listed)
    names: Counter[str] = Counter()
    for table in listed:
        name = table.topic
        if topics[name] > 1:
            name = f"{name} ({table.schema or table.encoding})"
        names[name] += 1
        yield (f"{name} {names[name]}" if names[name] > 1 else name), table


def _index(time: IntArray) -> pd.DatetimeIndex:
    return pd.DatetimeIndex(time.view("M8[ns]"), tz="UTC")

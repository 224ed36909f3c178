"""What is in a log, found without reading more of it than that takes, and printed."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mcap.records import Channel

from trainlog.arrays import UintArray
from trainlog.display import counted, in_brief
from trainlog.errors import LogError, TrainlogError, in_file
from trainlog.formats.files import sha256
from trainlog.formats.railway import travelled_line
from trainlog.mcap.codec import UNIT, axles_of
from trainlog.mcap.contents import ChunkPlace, Contents, MisplacedError, contents_used, index_in
from trainlog.mcap.reader import attachments_of, bare_trip, metadata_of, position_span, read_log
from trainlog.mcap.records import FORMAT_RECORD, PROVENANCE_RECORD, TRIP_RECORD, Account, Source
from trainlog.presentation import Presented, WordTable, facts_table, new_table
from trainlog.railway.line import Line, in_km
from trainlog.topics import EVENTS, RECORDED, TOPICS, TRAIN_STATE, column_field
from trainlog.trip import LINE_ATTACHMENT
from trainlog.units import lasted

GAP = 3.0
"""An interval longer than this many median intervals is a gap."""

_TIME = "%Y-%m-%d %H:%M:%S"

_AT_ONCE = 2**20
"""Messages whose times are held at a time."""

_DIFFERENT = 1000
"""Intervals are kept apart by whole microseconds [ns]: those of a clock that runs unevenly would
else all be different."""


@dataclass(frozen=True)
class TopicDescription:
    """One channel of a log.

    Attributes
    ----------
    name, message, encoding : str
        Channel name, name of the schema, encoding of the messages.
    count : int
        Number of messages.
    rate : float
        Mean number of messages a second [Hz]; NaN for fewer than two.
    first, last : Timestamp or None
    median_interval, largest_gap : float
        Time between messages [s]; NaN for fewer than two.
    gaps : int
        Number of intervals longer than `GAP` median intervals.
    units : dict of str to str
        SI unit by field, as the file says.
    axles : dict of str to int
        Number of axles by field, for the fields that have one value for each.
    """

    name: str
    message: str
    encoding: str
    count: int
    rate: float
    first: pd.Timestamp | None
    last: pd.Timestamp | None
    median_interval: float
    largest_gap: float
    gaps: int
    units: dict[str, str]
    axles: dict[str, int]


@dataclass(frozen=True)
class AttachmentDescription:
    """A file that a log carries; `size` in bytes."""

    name: str
    media_type: str
    size: int
    sha256: str


_SUFFIXES = {"rate": "_Hz", "median_interval": "_s", "largest_gap": "_s", "size": "_bytes"}
"""Units with which keys end where numbers are data."""


@dataclass(frozen=True, eq=False, repr=False)
class LogDescription(Presented):
    """What is in a log.

    Attributes
    ----------
    path : Path
    size : int
        Of the file [bytes].
    account : Account
        What is readable and what is lost, as far as that shows without reading the messages;
        `account_of` reads them all.
    problem : str or None
        What is lost first, or why `read_log` refuses the file: foreign, of a later version; None
        if it reads.
    schema_version : str or None
        Version of the table of topics; None in files that trainlog did not write.
    topics : tuple of TopicDescription
    metadata : dict of str to str
        The trip's; in foreign files that of all records, as ``record/key``.
    provenance : tuple of dict
    attachments : tuple of AttachmentDescription
    position_span : tuple of float or None
        Least and greatest position of the train's front [m].
    chunks : int
    compression : tuple of str
        Kinds in use, ``""`` for none.
    stored_size, content_size : int
        Length of the messages as stored and when decompressed [bytes].
    line : Line or None
        That the log carries, as travelled: its kilometres are shown.
    recorded : dict of str to frozenset of str, optional
        `recorded_fields` of the log: with them the fields without any value are set apart.
    """

    path: Path
    size: int
    account: Account
    problem: str | None
    schema_version: str | None
    topics: tuple[TopicDescription, ...]
    metadata: dict[str, str]
    provenance: tuple[dict[str, Any], ...]
    attachments: tuple[AttachmentDescription, ...]
    position_span: tuple[float, float] | None
    chunks: int
    compression: tuple[str, ...]
    stored_size: int
    content_size: int
    line: Line | None = None
    recorded: Mapping[str, frozenset[str]] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """The file."""
        return str(self.path)

    def summary(self) -> dict[str, str]:
        """Time and position, number of messages, and whether it is whole."""
        found = {}
        if self.first is not None and self.last is not None:
            found["time"] = f"{self.first:{_TIME}} to {self.last:{_TIME}} UTC"
        if self.position_span is not None:
            found["position"] = _stretch(*self.position_span, self.line)
        found["messages"] = f"{self.count:,} of {counted(len(self.topics), 'topic')}"
        return found | {"state": self.account.sentence}

    def facts(self) -> dict[str, Any]:
        """All of it; of each field whether it holds a value."""
        start, end = self.position_span or (None, None)
        return {
            "file": self.path,
            "kind": "log",
            "first": self.first,
            "last": self.last,
            "position_start_m": start,
            "position_end_m": end,
            "messages": self.count,
            "chunks": self.chunks,
            "size_bytes": self.size,
            "schema_version": self.schema_version,
            "whole": self.complete,
            "state": self.account.sentence,
            "problem": self.problem,
            "topics": [
                _data_of(each, "units", "axles", "count")
                | {"messages": each.count, "fields": self._fields_of(each)}
                for each in self.topics
            ],
            "metadata": self.metadata,
            "provenance": [
                json.dumps(step, ensure_ascii=False, default=str) for step in self.provenance
            ],
            "attachments": [_data_of(each) for each in self.attachments],
        }

    def _fields_of(self, topic: TopicDescription) -> list[dict[str, Any]]:
        known = self.recorded.get(topic.name, ())
        return [
            {"name": name, "unit": unit, "axles": topic.axles.get(name), "recorded": name in known}
            for name, unit in topic.units.items()
        ]

    def tables(self) -> list[WordTable]:
        """The file, its topics and their fields, metadata, provenance, attachments."""
        steps = {
            f"{number} {step.get('step', '')}".strip(): in_brief(
                {key: value for key, value in step.items() if key != "step"}
            )
            for number, step in enumerate(self.provenance, start=1)
        }
        return [
            _overview(self),
            _topics(self),
            _fields(self),
            _pairs("metadata", self.metadata),
            _pairs("provenance", steps),
            _attachments(self),
        ]

    @property
    def foreign(self) -> list[str]:
        """Topics that are none of trainlog's."""
        names = {topic.name for topic in self.topics} - TOPICS.keys()
        return sorted(name for name in names if not name.startswith(RECORDED))

    @property
    def complete(self) -> bool:
        """Whether nothing is known to be lost."""
        return self.account.whole

    @property
    def count(self) -> int:
        """Number of messages of all topics."""
        return sum(topic.count for topic in self.topics)

    @property
    def first(self) -> pd.Timestamp | None:
        """Time of the first message of all topics."""
        return min((topic.first for topic in self.topics if topic.first), default=None)

    @property
    def last(self) -> pd.Timestamp | None:
        """Time of the last message of all topics."""
        return max((topic.last for topic in self.topics if topic.last), default=None)


def _data_of(described: TopicDescription | AttachmentDescription, *without: str) -> dict[str, Any]:
    """What is stated of a topic or an attachment, by keys that end in units."""
    return {
        f"{key}{_SUFFIXES.get(key, '')}": value
        for key, value in asdict(described).items()
        if key not in without
    }


def describe(path: str | Path) -> LogDescription:
    """Describe what is in an MCAP file, whoever wrote it, and what is readable of a damaged one.

    Times and gaps come from the message indexes, positions from the file's own record of them:
    messages are decompressed only where a file does not have these. A damaged message is therefore
    not noticed; `account_of` reads and verifies everything.

    Raises
    ------
    LogError
        If it is not an MCAP file at all.
    InputError
        If there is no such file.

    Examples
    --------
    >>> found = describe("sample_logs/nonstop.mcap")
    >>> found
    sample_logs/nonstop.mcap
      time      2024-10-07 06:00:00 to 2024-10-07 06:19:43 UTC
      position  km 0.000 to km 29.556
      messages  59,285 of 8 topics
      state     is whole: 59,285 messages in 20 chunks
    >>> found.count, found.complete
    (59285, True)
    """
    with Source(path) as source, in_file(path):
        contents, (span, refusal) = contents_used(source, lambda found: _span(source, found))
        trip = line = None
        try:
            trip, problem = bare_trip(source, contents), refusal
        except LogError as error:
            problem = str(error)
        records = metadata_of(contents)
        found = _intervals(source, contents)
        topics = tuple(
            _topic(contents, channel, found[number])
            for number, channel in contents.channels.items()
        )
        attachments, lines = list[AttachmentDescription](), list[bytes]()
        for each in attachments_of(source, contents):
            attachments.append(
                AttachmentDescription(each.name, each.media_type, len(each.data), sha256(each.data))
            )
            lines += [each.data] * (each.name == LINE_ATTACHMENT)
        if lines:
            backwards = records.get(TRIP_RECORD, {}).get("direction") == "reverse"
            with suppress(TrainlogError):
                line = travelled_line(lines[-1], backwards)
    account = contents.account
    if not account.whole:
        first = account.losses[0]
        problem = f"byte {first.start}: {first.reason}"
    return LogDescription(
        path=Path(path),
        size=source.size,
        account=account,
        problem=problem,
        schema_version=records.get(FORMAT_RECORD, {}).get("schema_version"),
        topics=topics,
        metadata=_metadata(records),
        provenance=trip.provenance if trip is not None else (),
        attachments=tuple(attachments),
        position_span=span if trip is not None else None,
        chunks=len(contents.chunks),
        compression=tuple(sorted({chunk.compression for chunk in contents.chunks})),
        stored_size=sum(chunk.stored for chunk in contents.chunks),
        content_size=sum(chunk.size for chunk in contents.chunks),
        line=line,
    )


def _span(source: Source, contents: Contents) -> tuple[tuple[float, float] | None, str | None]:
    """Least and greatest position [m], or why they cannot be read."""
    try:
        return position_span(source, contents, TRAIN_STATE.name), None
    except MisplacedError:
        raise
    except LogError as error:
        return None, str(error)


def _metadata(records: dict[str, dict[str, str]]) -> dict[str, str]:
    if FORMAT_RECORD in records or TRIP_RECORD in records:
        return records.get(TRIP_RECORD, {})
    return {
        f"{name}/{key}": value
        for name, values in records.items()
        if name != PROVENANCE_RECORD
        for key, value in values.items()
    }


def _topic(contents: Contents, channel: Channel, intervals: _Intervals) -> TopicDescription:
    schema = contents.schema(channel)
    span = (intervals.last - intervals.first) * 1e-9
    median = intervals.median
    return TopicDescription(
        name=channel.topic,
        message=schema.name if schema else "",
        encoding=channel.message_encoding,
        count=intervals.count,
        rate=(intervals.count - 1) / span if span > 0 else np.nan,
        first=_timestamp(intervals.first) if intervals.count else None,
        last=_timestamp(intervals.last) if intervals.count else None,
        median_interval=median,
        largest_gap=intervals.largest,
        gaps=intervals.longer_than(GAP * median),
        units={
            key.removeprefix(UNIT): value
            for key, value in channel.metadata.items()
            if key.startswith(UNIT)
        },
        axles=axles_of(channel),
    )


def _timestamp(time: int) -> pd.Timestamp | None:
    """The time as a time stamp; None beyond those that pandas has."""
    return None if time > pd.Timestamp.max.value else pd.Timestamp(time, tz="UTC")


@dataclass
class _Intervals:
    """The times of one channel's messages.

    Attributes
    ----------
    count : int
    first, last : int
        [ns]; zero without messages.
    lengths : Counter of int
        How many intervals between messages there are of each length [ns].
    """

    count: int = 0
    first: int = 0
    last: int = 0
    lengths: Counter[int] = field(default_factory=Counter)

    def add(self, time: UintArray) -> None:
        """Go on with times that are not before those added so far."""
        time = np.sort(time)
        if self.count:
            time = np.concatenate([np.array([self.last], dtype=np.uint64), time])
        # Chunks that claim another time than their messages have are out of order.
        time = np.maximum.accumulate(time)
        self.first = self.first if self.count else int(time[0])
        self.count += len(time) - bool(self.count)
        self.last = int(time[-1])
        lengths, numbers = np.unique(np.diff(time) // _DIFFERENT * _DIFFERENT, return_counts=True)
        self.lengths.update(dict(zip(lengths.tolist(), numbers.tolist(), strict=True)))

    @property
    def median(self) -> float:
        """Median interval [s]; NaN for fewer than two messages."""
        if not self.lengths:
            return np.nan
        lengths, numbers = np.array(sorted(self.lengths.items()), dtype=np.float64).T
        count = self.lengths.total()
        middle = np.searchsorted(np.cumsum(numbers), [(count - 1) // 2, count // 2], "right")
        return float(lengths[middle].mean() * 1e-9)

    @property
    def largest(self) -> float:
        """Largest interval [s]; NaN for fewer than two messages."""
        return max(self.lengths, default=np.nan) * 1e-9

    def longer_than(self, interval: float) -> int:
        """How many intervals are longer [s]."""
        return sum(number for length, number in self.lengths.items() if length * 1e-9 > interval)


def _intervals(source: Source, contents: Contents) -> dict[int, _Intervals]:
    """How the messages of every channel follow each other, by the message indexes.

    Chunks whose records cannot be read are dropped. The times are gone through in groups of
    chunks, so that the memory does not grow with the log.
    """
    found = {number: _Intervals() for number in contents.channels}
    for group in _groups(contents):
        times: dict[int, list[UintArray]] = {}
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


_READ_WHOLE, _LOOKED_AT = 500_000, pd.Timedelta("60s")
"""A log of so many messages is read for what its fields hold; of a larger one its first, middle and
last minute."""


def recorded_fields(description: LogDescription) -> dict[str, frozenset[str]]:
    """The fields of each topic that hold a value, by topic.

    Of a log of more than 500,000 messages the first, the middle and the last minute count. Nothing
    of a log that `read_log` refuses.

    Examples
    --------
    >>> found = recorded_fields(describe("sample_logs/nonstop.mcap"))
    >>> sorted(found["/train/axles"])
    ['wheel_effort', 'wheel_speed']
    """
    first, last = description.first, description.last
    if description.problem is not None or first is None or last is None:
        return {}
    spans: list[tuple[Any, Any] | None] = [None]
    if description.count > _READ_WHOLE:
        middle = first + (last - first) / 2
        begins = (first, middle, max(first, last - _LOOKED_AT))
        spans = [(begin, begin + _LOOKED_AT) for begin in begins]
    found: dict[str, frozenset[str]] = {}
    for span in spans:
        for name, frame in read_log(description.path, time=span).topics.items():
            held = {str(column) for column in frame.columns[frame.notna().any()]}
            if name in TOPICS:
                held = {column_field(TOPICS[name], column).name for column in held}
            found[name] = found.get(name, frozenset()) | held
    return found


# -------------------------------------------------------------------------------- for a terminal

_LONGEST = 400
"""Metadata values are cut to this many characters."""


def _stretch(start: float, end: float, line: Line | None = None) -> str:
    first, last = (float(in_km(line, each)) for each in (start, end))
    return f"km {first:.3f} to km {last:.3f}"


def _overview(description: LogDescription) -> WordTable:
    first, last, account = description.first, description.last, description.account
    rows: dict[str, str] = {}
    if first is not None and last is not None:
        duration = lasted((last - first).total_seconds())
        rows["time"] = f"{_time(first)} to {_time(last)} UTC ({duration})"
    if description.position_span is not None:
        start, end = description.position_span
        driven = f"{(end - start) / 1e3:.3f} km"
        rows["position"] = f"{_stretch(start, end, description.line)} ({driven})"
    kinds = " and ".join(kind or "no" for kind in description.compression) or "no"
    stored, content = _size(description.stored_size), _size(description.content_size)
    chunks = f"{counted(description.chunks, 'chunk')}, {stored} with {kinds} compression"
    rows["messages"] = f"{description.count:,} in {chunks} ({content} without)"
    rows["file"] = _size(description.size)
    if description.schema_version is not None:
        rows["topics"] = f"version {description.schema_version} of the table of topics"
    unclosed = not account.whole and account.only_unclosed
    rows["state"] = "damaged, only what is readable is listed"
    if account.whole or unclosed:
        rows["state"] = "ends properly" if account.whole else account.sentence
    if description.problem is not None and not unclosed:
        rows["problem"] = _plain(description.problem)
    return facts_table(_plain(str(description.path)), rows, name="file")


def _topics(description: LogDescription) -> WordTable:
    numbers = ("count", "rate", "from, UTC", "to, UTC", "gaps", "longest")
    table = new_table("", "topic", "message", *numbers, name="topics")
    for topic in description.topics:
        table.add_row(
            _plain(topic.name),
            _plain(topic.message or topic.encoding),
            f"{topic.count:,}",
            _number(topic.rate, "Hz"),
            _time_of_day(topic.first),
            _time_of_day(topic.last),
            # Events come as they come: there is no interval that could be missed.
            "" if topic.message == EVENTS.message else f"{topic.gaps:,}",
            _number(topic.largest_gap, "s"),
        )
    return table


def _fields(description: LogDescription) -> WordTable:
    table = new_table("", "topic", "fields and units", name="fields")
    for topic in description.topics:
        if topic.units:
            # Fields of no axle hold nothing.
            held = [name for name in topic.units if topic.axles.get(name) != 0]
            known = description.recorded.get(topic.name, frozenset(held))
            fields = ", ".join(_field(topic, name) for name in held if name in known)
            empty = ", ".join(name for name in held if name not in known)
            table.add_row(_plain(topic.name), _plain(fields))
            if empty:
                table.add_row("", _plain(f"not recorded: {empty}"))
    return table


def _field(topic: TopicDescription, name: str) -> str:
    unit = topic.units[name]
    shown = name if unit in ("", "1") else f"{name} [{unit}]"
    if name not in topic.axles:
        return shown
    known = TOPICS.get(topic.name)
    each = {field.name: field.each for field in known.fields} if known else {}
    return f"{shown} of {counted(topic.axles[name], each.get(name, 'axle').split()[-1])}"


def _pairs(heading: str, pairs: dict[str, str]) -> WordTable:
    table = new_table("", heading, "", name=heading.lower())
    for key, value in pairs.items():
        shown = value if len(value) <= _LONGEST else f"{value[:_LONGEST]} …"
        table.add_row(_plain(key), _plain(shown))
    return table


def _attachments(description: LogDescription) -> WordTable:
    table = new_table("", "attachment", "size", "SHA-256", name="attachments")
    for attachment in description.attachments:
        table.add_row(_plain(attachment.name), _size(attachment.size), attachment.sha256)
    return table


def _plain(text: str) -> str:
    """Text from a file, which is not allowed to steer the terminal."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def _time(time: pd.Timestamp) -> str:
    return f"{time:%Y-%m-%d %H:%M:%S}.{time.microsecond // 1000:03d}"


def _time_of_day(time: pd.Timestamp | None) -> str:
    return "" if time is None else f"{time:%H:%M:%S}"


def _number(value: float, unit: str) -> str:
    return "" if math.isnan(value) else f"{value:.3g} {unit}"


def _size(size: int) -> str:
    if size < 10_000:
        return f"{size:,} B"
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"

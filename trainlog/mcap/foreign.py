"""Any MCAP file as frames: whoever wrote it, in whichever encoding, as far as it can be read.

Messages in protobuf, JSON, ROS 1 and ROS 2 (CDR) are decoded by the published decoders
(mcap-protobuf, rosbags) and turned into plain values. Files are not trusted: whatever a decoder can
raise on bytes that it was not made for becomes an `UndecodableError` (the channel) or a
`BrokenMessage` (one message), and what a message can claim of memory is bounded by its length.
"""

from __future__ import annotations

import json
import re
import struct
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from keyword import iskeyword
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
import pandas as pd
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.unknown_fields import UnknownFieldSet
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory

from trainlog.arrays import IntArray
from trainlog.display import few
from trainlog.errors import LogError, in_file
from trainlog.extras import load
from trainlog.mcap.contents import (
    Contents,
    MisplacedError,
    check_data_section,
    contents_used,
    fetched,
    report_losses,
)
from trainlog.mcap.records import (
    MESSAGE,
    MOST_NAMED,
    RECORD_HEAD,
    Account,
    Source,
    gone_through,
    opened,
    shown,
)

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc, Typesdict

MOST_COLUMNS = 2_000
"""Columns of a topic; names that are made up message by message must not fill the memory."""

MOST_ELEMENTS = 64
"""Longer arrays are not expanded into columns."""

DEEPEST = 32
"""Messages within messages beyond this are not expanded."""

LARGEST = 2**25
"""Longer messages are not decoded [bytes]: as objects they would take many times their length."""

_MOST_VALUES = 4096
"""Numbers and texts in a ROS message, apart from arrays whose length stands in the message."""

_MOST_OBJECTS = 2**23
"""Texts and messages that the arrays of one ROS message can hold."""

_LONGEST = 1_000_000
"""Longer definitions of ROS messages are not read [bytes]."""

_LAST = pd.Timestamp.max
"""The last time that an index can hold."""

_TOO_MANY = f"beyond the first {MOST_COLUMNS:,} columns of the topic"
_TWICE = "named twice in a message; the first is kept"
_VARYING = "an array whose length changes, not expanded"
_MIXED = "numbers in some messages, text in others"
_TOO_DEEP = f"nested more than {DEEPEST} levels deep"
_UNDECLARED = "fields that the schema does not declare"


@dataclass(frozen=True)
class Unexpanded:
    """A value that does not become columns, with a reason that is the same for all messages."""

    reason: str


BYTES = Unexpanded("bytes, not expanded")
LONG_ARRAY = Unexpanded(f"an array of more than {MOST_ELEMENTS} elements, not expanded")
_MAP = Unexpanded("a map, not expanded")

Message = dict[str, Any]
"""
A decoded message: names (or paths) to numbers, texts, `Unexpanded`, lists and further messages;
None where a value is absent.
"""

Decode = Callable[[bytes], Message]
"""From a message's bytes to what it says; raises `BrokenMessage` and nothing else."""


class BrokenMessage(ValueError):  # noqa: N818 - it is a state of the data, counted, not reported
    """A message that cannot be decoded; the text says why."""


class UndecodableError(ValueError):
    """A channel that cannot be decoded; the text says why."""


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

    def read(contents: Contents) -> ForeignFrames:
        found = _frames(source, contents, _wanted(contents, topics))
        if topics is None:
            check_data_section(source, contents)
        return found

    with Source(path) as source, in_file(path):
        contents, found = contents_used(source, read)
    report_losses(path, contents)
    return replace(found, account=contents.account)


def _wanted(contents: Contents, topics: Iterable[str] | None) -> list[Channel]:
    channels = list(contents.channels.values())
    if topics is None:
        return channels
    asked = {topics} if isinstance(topics, str) else set(topics)
    held = sorted({channel.topic for channel in channels})
    for name in sorted(asked - set(held)):
        named = few([*map(shown, held)], MOST_NAMED) or "none at all"
        raise LogError(f"has no topic {shown(name)}", remedy=f"topics are {named}")
    return [channel for channel in channels if channel.topic in asked]


# -------------------------------------------------------------------------------------- columns


class _Column:
    """The values of one path; `rows` are the messages that have one."""

    def __init__(self, value: Any) -> None:
        self.rows = array("q")
        self.kinds: set[type] = set()
        kinds = {float: "d", int: "q"}
        # Numbers of one kind take an eighth of the memory in an array.
        self.values: Any = array(kinds[type(value)]) if type(value) in kinds else []

    def add(self, row: int, value: Any) -> None:
        """Add the value of a message."""
        self.rows.append(row)
        self.kinds.add(type(value))
        try:
            self.values.append(value)
        except (TypeError, OverflowError):
            self.values = [*self.values, value]

    def array(self, count: int) -> Any:
        """The column as an array of `count` rows; None if it holds both numbers and text."""
        rows = np.frombuffer(self.rows, dtype=np.int64)
        if str in self.kinds:
            return self._texts(rows, count) if self.kinds == {str} else None
        if float not in self.kinds:
            for kind, nullable in _WHOLE if self.kinds != {bool} else _FLAGS:
                with suppress(OverflowError):
                    whole = np.array(self.values, dtype=kind)
                    if len(rows) == count:
                        return whole
                    column: Any = pd.array([pd.NA] * count, dtype=nullable)
                    column[rows] = whole
                    return column
        values = np.full(count, np.nan)
        try:
            values[rows] = np.array(self.values, dtype=np.float64)
        except OverflowError:
            values[rows] = [_as_float(each) for each in self.values]
        return values

    def _texts(self, rows: IntArray, count: int) -> Any:
        texts: list[str | None] = [None] * count
        for row, text in zip(rows.tolist(), self.values, strict=True):
            # JSON can name halves of surrogate pairs, which no file can be written with.
            texts[row] = text if text.isascii() else text.encode("utf-8", "replace").decode()
        return pd.array(texts, dtype="str")


_WHOLE: tuple[tuple[Any, Any], ...] = ((np.int64, "Int64"), (np.uint64, "UInt64"))
_FLAGS: tuple[tuple[Any, Any], ...] = ((np.bool_, "boolean"),)
"""Kinds of whole numbers and flags, and those with absent values, which leave them exact."""


def _as_float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:
        return np.inf if value > 0 else -np.inf


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
        self._count = 0

    def add(self, message: Message) -> None:
        """Add what a decoded message says as the next row."""
        for name, value in message.items():
            self._take(name, value, 0)
        self._count += 1

    def frame(self) -> dict[str, Any]:
        """The columns; absent values are NaN, or NA in whole numbers and flags."""
        for path, lengths in self._lengths.items():
            if sum(1 for length in lengths if length) > 1:
                self._columns = {
                    name: column
                    for name, column in self._columns.items()
                    if not name.startswith(f"{path}[")
                }
                self.skipped[path, _VARYING] += lengths.total()
        found = {}
        for path, column in self._columns.items():
            values = column.array(self._count)
            if values is None:
                self.skipped[path, _MIXED] += len(column.rows)
            else:
                found[path] = values
        return found

    def _take(self, path: str, value: Any, depth: int) -> None:
        """Take what stands at a path of the message."""
        kind = type(value)
        if kind is float or kind is int or kind is str or kind is bool:
            column = self._columns.get(path)
            if column is None:
                if len(self._columns) >= MOST_COLUMNS:
                    self._skip("", _TOO_MANY)
                    return
                column = self._columns[path] = _Column(value)
            elif column.rows and column.rows[-1] == self._count:
                self._skip(path, _TWICE)
                return
            column.add(self._count, value)
        elif kind is dict or kind is list:
            if depth >= DEEPEST:
                self._skip(path, _TOO_DEEP)
            elif kind is dict:
                for name, each in value.items():
                    self._take(f"{path}.{name}", each, depth + 1)
            elif len(value) > MOST_ELEMENTS:
                self._skip(path, LONG_ARRAY.reason)
            else:
                lengths = self._lengths.get(path)
                if lengths is None and len(self._lengths) < MOST_COLUMNS:
                    lengths = self._lengths[path] = Counter()
                if lengths is not None:
                    lengths[len(value)] += 1
                for at, each in enumerate(value):
                    self._take(f"{path}[{at}]", each, depth + 1)
        elif kind is Unexpanded:
            self._skip(path, value.reason)

    def _skip(self, path: str, reason: str) -> None:
        known = (path, reason) in self.skipped or len(self.skipped) < MOST_COLUMNS
        self.skipped[(path, reason) if known else ("", _TOO_MANY)] += 1


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
            if max(time, published) > _LAST.value:
                raise BrokenMessage(f"its time is after {_LAST.year}")
            if length - MESSAGE.size + RECORD_HEAD > LARGEST:
                raise BrokenMessage(f"it has more than {LARGEST // 2**20} MiB")
            message = self.decode(content[offset + MESSAGE.size : offset + RECORD_HEAD + length])
        except struct.error:
            self.broken["its record is too short"] += 1
        except BrokenMessage as error:
            self.broken[str(error)] += 1
        else:
            self.columns.add(message)
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


def _index(time: IntArray) -> pd.DatetimeIndex:
    return pd.DatetimeIndex(time.view("M8[ns]"), tz="UTC")


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
            content = opened(fetched(source, place), place.offset)
            index, _ = gone_through(content, place.offset)
        except LogError as error:
            if contents.indexed and isinstance(error, MisplacedError):
                raise
            contents.drop(place, error.problem)
            continue
        if contents.indexed and place.counts != {each: len(at) for each, at in index.items()}:
            raise MisplacedError("the summary counts other messages", place=f"byte {place.offset}")
        for channel, entries in index.items():
            if channel in by_channel:
                for offset in entries[:, 1].tolist():
                    by_channel[channel].add(content, offset)
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
        described = (schema.name, schema.encoding, schema.data) if schema else None
        key = channel.topic, channel.message_encoding, described
        try:
            if key not in tables:
                name = schema.name if schema else ""
                decode = decoder_of(channel, schema)
                tables[key] = _Table(channel.topic, name, channel.message_encoding, decode)
            by_channel[channel.id] = tables[key]
        except UndecodableError as error:
            skipped.append(Skipped(channel.topic, "", str(error), counts[channel.id]))
    return by_channel, skipped


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


# ------------------------------------------------------------------------------------- decoders


def decoder_of(channel: Channel, schema: Schema | None) -> Decode:
    """The decoder of a channel's messages.

    Raises
    ------
    UndecodableError
        If there is none for its encoding, or its schema is missing or broken.
    """
    encoding = channel.message_encoding
    if encoding == "json":
        return _json
    kinds: dict[tuple[str, str], Callable[[Schema], Decode]] = {
        ("protobuf", "protobuf"): _protobuf,
        ("cdr", "ros2msg"): lambda schema: ros_decoder(schema.name, schema.data, "ros2"),
        ("ros1", "ros1msg"): lambda schema: ros_decoder(schema.name, schema.data, "ros1"),
    }
    if encoding not in {known for known, _ in kinds}:
        raise UndecodableError(f"encoding {shown(encoding)} is not decoded")
    if schema is None:
        raise UndecodableError(f"encoding {shown(encoding)} needs a schema, there is none")
    make = kinds.get((encoding, schema.encoding))
    if make is None:
        raise UndecodableError(
            f"encoding {shown(encoding)} with a schema in {shown(schema.encoding)} is not decoded"
        )
    return make(schema)


def _json(data: bytes) -> Message:
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        raise BrokenMessage("it is not JSON") from None
    if not isinstance(found, dict):
        raise BrokenMessage("it is JSON, but no object")
    return found


_Plain = Callable[[Any], Any] | None
"""From a decoder's value of a field to a plain one; None if it is plain already."""


def _listed(values: Any, one: _Plain) -> Any:
    """The elements of an array as plain values, if there are not too many."""
    if len(values) > MOST_ELEMENTS:
        return LONG_ARRAY
    elements = values.tolist() if isinstance(values, np.ndarray) else list(values)
    return elements if one is None else [one(each) for each in elements]


def _protobuf(schema: Schema) -> Decode:
    try:
        parse = DecoderFactory().decoder_for("protobuf", schema)
    except (McapError, DecodeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise UndecodableError(f"schema {shown(schema.name)} is not its descriptor") from error
    if parse is None:
        raise UndecodableError(f"schema {shown(schema.name)} is not its descriptor")
    known: dict[str, list[tuple[str, bool, _Plain]]] = {}

    def read(message: Any) -> Message:
        kind = message.DESCRIPTOR.full_name
        if kind not in known:
            known[kind] = [
                (each.name, each.has_presence, _plain(each, read))
                for each in message.DESCRIPTOR.fields
            ]
        found: Message = {}
        for name, has_presence, plain in known[kind]:
            if not has_presence or message.HasField(name):
                value = getattr(message, name)
                found[name] = value if plain is None else plain(value)
        return found

    def decode(data: bytes) -> Message:
        try:
            message = parse(data)
        except (DecodeError, RecursionError):
            raise BrokenMessage(f"it is not a {schema.name[:60]}") from None
        found = read(message)
        if len(UnknownFieldSet(message)):
            found["(unknown)"] = Unexpanded(_UNDECLARED)
        return found

    return decode


def _plain(field: Any, read: Callable[[Any], Message]) -> _Plain:
    """What turns the value of a protobuf field into a plain one."""
    nested, blob = field.message_type, field.type == FieldDescriptor.TYPE_BYTES
    if nested is not None and nested.GetOptions().map_entry:
        return lambda values: _MAP if len(values) else None
    one: _Plain = (lambda _: BYTES) if blob else read if nested is not None else None
    # Before version 6 the package has no `is_repeated`, after it the label is given up.
    repeated = field.is_repeated if hasattr(field, "is_repeated") else field.label == _REPEATED
    return (lambda values: _listed(values, one)) if repeated else one


_REPEATED = 3
"""The label of a repeated field in a protobuf descriptor."""


# ----------------------------------------------------------------------------------- ROS 1, ROS 2

Dialect = Literal["ros1", "ros2"]

_ALIASES = {"ros1": {"byte": "int8", "char": "uint8"}, "ros2": {"byte": "uint8", "char": "uint8"}}

_BUILT_IN = {
    "ros1": {
        "builtin_interfaces/Time": "uint32 secs\nuint32 nsecs",
        "builtin_interfaces/Duration": "int32 secs\nint32 nsecs",
    },
    "ros2": {
        "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
        "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    },
}
"""Messages that need no definition; ``time`` and ``duration`` of ROS 1 are two of them."""

_NAME = re.compile(r"[A-Za-z]\w*(?:/\w+){0,2}", re.ASCII)

_FIELD = re.compile(
    rf"(?P<type>{_NAME.pattern})(?:<=\d+)?"
    r"(?P<array>\[(?P<bound><=)?(?P<size>\d*)\])?"
    r"\s+(?P<name>[A-Za-z]\w*)(?P<rest>\s*=.*|\s.*|)",
    re.ASCII,
)

_PLACEHOLDER = "structure_needs_at_least_one_member"
"""The field that rosbags gives a message without content."""


def ros_decoder(name: str, data: bytes, dialect: Dialect) -> Decode:
    """The decoder of the ROS messages that a schema defines, by the type store of rosbags.

    rosbags makes Python code of a definition. It is given nothing of the schema but names, checked
    to be such, and no definition whose messages have no bounded size.

    Parameters
    ----------
    name : str
        Of the schema: the message that its text begins with.
    data : bytes
        Its text.
    dialect : {"ros1", "ros2"}

    Raises
    ------
    UndecodableError
        If the definitions cannot be read, or describe messages that have no bounded size.
    MissingExtraError
        If rosbags is not installed.
    """
    load("rosbags")
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError, get_types_from_msg
    from rosbags.typesys.store import Typestore

    text = _definitions(name, data, dialect)
    store = Typestore()
    try:
        types = get_types_from_msg(text, name)
        root = next(iter(types))
        objects = _extent(root, types, dialect, {}).objects
        store.register(types)
        parse = store.deserialize_ros1 if dialect == "ros1" else store.deserialize_cdr
        read = _ros_reader(root, store.fielddefs, {})
        store.get_msgdef(root)
    except (TypesysError, SerdeError, SyntaxError, TypeError) as error:
        raise UndecodableError("the schema is not a definition of ROS messages") from error

    def decode(data: bytes) -> Message:
        if objects * len(data) > _MOST_OBJECTS:
            raise BrokenMessage(f"its arrays can hold more than {_MOST_OBJECTS:,} elements")
        try:
            return read(parse(data, root))
        except (SerdeError, IndexError, OverflowError):
            raise BrokenMessage(f"it is not a {name[:60]}") from None

    return decode


def _definitions(name: str, data: bytes, dialect: Dialect) -> str:
    """The text of a schema with nothing but types and names of fields: no constants, no bounds."""
    if len(data) > _LONGEST:
        raise UndecodableError(f"the schema has {len(data):,} bytes")
    try:
        first, *others = re.split(r"^={3,}[ \t]*\r?$", data.decode(), flags=re.MULTILINE)
    except UnicodeDecodeError:
        raise UndecodableError("the schema is not UTF-8 text") from None
    sections = [(name, first)]
    for section in others:
        head, _, body = section.lstrip().partition("\n")
        if not head.startswith("MSG:"):
            raise UndecodableError("a part of the schema does not say which message it defines")
        sections.append((head.removeprefix("MSG:").strip(), body))
    # ``package/Name`` of a message, also if given as ``package/msg/Name``.
    known = {f"{each.partition('/')[0]}/{each.rpartition('/')[2]}" for each, _ in sections}
    sections += [(each, body) for each, body in _BUILT_IN[dialect].items() if each not in known]
    texts, count = [], 0
    for message, body in sections:
        if not _NAME.fullmatch(message):
            raise UndecodableError(f"{message[:40]!r} is not the name of a message")
        fields = _fields(message, body, known, dialect)
        count += len(fields)
        if count > _MOST_VALUES:
            raise UndecodableError(f"the schema has more than {_MOST_VALUES:,} fields")
        texts.append("\n".join([f"MSG: {message}", *fields]))
    return f"\n{'=' * 80}\n".join(texts).removeprefix(f"MSG: {name}\n") + "\n"


def _fields(message: str, body: str, known: set[str], dialect: Dialect) -> list[str]:
    """The fields of a message, one a line."""
    fields = {}
    for line in body.splitlines():
        declaration = line.partition("#")[0].strip()
        match = _FIELD.fullmatch(declaration)
        if declaration and match is None:
            raise UndecodableError(f"{declaration[:40]!r} in {message[:60]} is not a field")
        if match is None or match["rest"].lstrip().startswith("="):
            continue  # a comment, or a constant
        kind, size = _ALIASES[dialect].get(match["type"], match["type"]), match["size"] or ""
        beside = f"{message.partition('/')[0]}/{kind}"
        kind = beside if beside in known else kind
        fixed = size and not match["bound"]
        if fixed and (len(size) > 9 or int(size) == 0):
            raise UndecodableError(
                f"{match['name'][:40]} in {message[:60]} has {size[:12]} elements"
            )
        if match["name"] in fields:
            raise UndecodableError(f"{message[:60]} has two fields of the same name")
        array = "" if match["array"] is None else f"[{size if fixed else ''}]"
        fields[match["name"]] = f"{kind}{array} {match['name']}"
    return list(fields.values())


@dataclass(frozen=True)
class _Extent:
    """How large the messages of a definition can become.

    Attributes
    ----------
    values : int
        Numbers and texts that each has, long arrays of numbers counted once.
    least : int
        Length of the shortest one [bytes].
    objects : float
        Most texts and messages that arrays hold, for each byte.
    """

    values: int
    least: int
    objects: float = 0.0


def _extent(
    name: str, types: Typesdict, dialect: Dialect, known: dict[str, _Extent | None]
) -> _Extent:
    """The extent of a message; UndecodableError if it has none."""
    if name not in types:
        raise UndecodableError(f"the schema does not define {name.rpartition('/')[2][:60]!r}")
    if name in known:
        found = known[name]
        if found is None:
            raise UndecodableError(f"{name[:60]} contains itself")
        return found
    if len([each for each in known.values() if each is None]) > DEEPEST:
        raise UndecodableError(f"{name[:60]} is nested more than {DEEPEST} levels deep")
    known[name] = None
    values, least, objects = 0, 0, 0.0
    for _, description in types[name][1]:
        kind, element, count = _element(description)
        if isinstance(element, str):
            one = _extent(element, types, dialect, known)
        elif element[0] == "string":
            one = _Extent(1, 4 if dialect == "ros1" else 5)
        else:
            one = _Extent(1, int(re.sub(r"\D", "", element[0]) or 8) // 8)
        number = not isinstance(element, str) and element[0] != "string"
        objects = max(objects, one.objects)
        if kind == _SEQUENCE:
            values, least = values + 1, least + 4
            if not one.least:
                raise UndecodableError(f"{name[:60]} has an array of messages without content")
            objects = max(objects, 0.0 if number else (1 + one.values) / one.least)
        else:
            values += 1 if number and count > MOST_ELEMENTS else count * max(1, one.values)
            least += count * one.least
        if values > _MOST_VALUES:
            raise UndecodableError(f"the schema has more than {_MOST_VALUES:,} fields")
    # CDR has no message without content: one byte stands for it.
    found = known[name] = _Extent(values, least or int(dialect == "ros2"), objects)
    return found


_BASE, _NESTED, _FIXED, _SEQUENCE = 1, 2, 3, 4
"""Kinds of fields in the type store of rosbags."""


def _element(description: FieldDesc) -> tuple[int, Any, int]:
    """Kind of a field, what it or its elements are, and how many of them it has if it says so.

    What they are is the name of a message, or name and bound of a number or text.
    """
    kind, what = int(description[0]), cast("Any", description[1])
    if kind in (_FIXED, _SEQUENCE):
        (_, element), count = what
        return kind, element, int(count)
    return kind, what, 1


def _ros_reader(
    name: str, types: Typesdict, readers: dict[str, Callable[[Any], Message]]
) -> Callable[[Any], Message]:
    """What turns the objects of rosbags for one kind of message into plain values."""
    names: list[tuple[str, str, _Plain]] = []
    for field_name, description in types[name][1]:
        if field_name == _PLACEHOLDER:
            continue
        kind, element, _ = _element(description)
        one: _Plain = None
        if isinstance(element, str):
            if element not in readers:
                readers[element] = _ros_reader(element, types, readers)
            one = readers[element]
        if kind == _SEQUENCE and element[0] in ("int8", "uint8"):
            plain: _Plain = lambda _: BYTES  # noqa: E731
        else:
            plain = one if kind in (_BASE, _NESTED) else partial(_listed, one=one)
        # rosbags puts a line under names that Python needs itself.
        names.append((field_name, f"{field_name}_" if iskeyword(field_name) else field_name, plain))

    def read(message: Any) -> Message:
        values = message.__dict__
        return {
            each: values[attribute] if plain is None else plain(values[attribute])
            for each, attribute, plain in names
        }

    return read

"""Decoders of the messages of other programs: protobuf, JSON, ROS 1 and ROS 2.

Each turns the bytes of a message into plain values. Files are not trusted: whatever a decoder can
raise on bytes that it was not made for becomes an `UndecodableError` (the channel) or a
`BrokenMessage` (one message), and what a message can claim of memory is bounded by its length.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from keyword import iskeyword
from typing import TYPE_CHECKING, Any, Literal, cast

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError, Message as ProtobufMessage
from google.protobuf.unknown_fields import UnknownFieldSet
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory

from trainlog.extras import load
from trainlog.mcap.records import shown

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc, Typesdict

MOST_ELEMENTS = 64
"""Longer arrays are not expanded into columns."""

DEEPEST = 32
"""Messages within messages beyond this are not expanded."""

Message = dict[str, Any]
"""
A decoded message: names (or paths) to numbers, texts, `Unexpanded`, lists and further messages;
None where a value is absent.
"""

Decode = Callable[[bytes], Message]
"""From a message's bytes to what it says; raises `BrokenMessage` and nothing else."""


class BrokenMessage(ValueError):  # noqa: N818 - it is a state of the data, counted, not reported
    """A message that cannot be decoded; the text says why."""


@dataclass(frozen=True)
class Unexpanded:
    """A value that does not become columns.

    Attributes
    ----------
    reason : str
        What it is, in words that are the same for all messages.
    """

    reason: str


BYTES = Unexpanded("bytes, not expanded")
LONG_ARRAY = Unexpanded(f"an array of more than {MOST_ELEMENTS} elements, not expanded")
TOO_DEEP = Unexpanded(f"nested more than {DEEPEST} levels deep")

LARGEST = 2**25
"""Longer messages are not decoded [bytes]: as objects they would take many times their length."""

_REPEATED = 3
"""The label of a repeated field in a protobuf descriptor."""

_MOST_VALUES = 4096
"""Numbers and texts in a ROS message, apart from arrays whose length stands in the message."""

_MOST_OBJECTS = 2**23
"""Texts and messages that the arrays of one ROS message can hold."""

_LONGEST = 1_000_000
"""Longer definitions of ROS messages are not read [bytes]."""

_MAP = Unexpanded("a map, not expanded")
_UNDECLARED = Unexpanded("fields that the schema does not declare")


class UndecodableError(ValueError):
    """A channel that cannot be decoded; the text says why."""


def decoder_of(channel: Channel, schema: Schema | None) -> Decode:
    """The decoder of a channel's messages.

    Raises
    ------
    UndecodableError
        If there is none for its encoding, or its schema is missing or broken.
    """
    encoding = channel.message_encoding
    if encoding == "json":
        return partial(_bounded, _json)
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


def _bounded(decode: Decode, data: bytes) -> Message:
    """Decode a message whose length bounds what it can become."""
    if len(data) > LARGEST:
        raise BrokenMessage(f"it has more than {LARGEST // 2**20} MiB")
    return decode(data)


def _json(data: bytes) -> Message:
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        raise BrokenMessage("it is not JSON") from None
    if not isinstance(found, dict):
        raise BrokenMessage("it is JSON, but no object")
    return found


def _protobuf(schema: Schema) -> Decode:
    try:
        parse = DecoderFactory().decoder_for("protobuf", schema)
    except (McapError, DecodeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise UndecodableError(f"schema {shown(schema.name)} is no descriptor of it") from error
    if parse is None:
        raise UndecodableError(f"schema {shown(schema.name)} is no descriptor of it")
    readers: dict[str, _Reader] = {}

    def decode(data: bytes) -> Message:
        try:
            message = parse(data)
        except (DecodeError, RecursionError):
            raise BrokenMessage(f"it is no {schema.name[:60]}") from None
        found = _object(message, readers, 0)
        if len(UnknownFieldSet(message)):
            found["(unknown)"] = _UNDECLARED
        return found

    return partial(_bounded, decode)


class _Reader:
    """What turns protobuf messages of one kind into plain values."""

    def __init__(self, descriptor: Any, readers: dict[str, _Reader]) -> None:
        self.readers = readers
        self.scalars = [field.name for field in descriptor.fields if _is_scalar(field)]
        self.others = [
            (field.name, field.has_presence, _plain(field, readers))
            for field in descriptor.fields
            if not _is_scalar(field)
        ]

    def read(self, message: ProtobufMessage, depth: int) -> Message:
        found: Message = {name: getattr(message, name) for name in self.scalars}
        for name, has_presence, plain in self.others:
            if not has_presence or message.HasField(name):
                found[name] = plain(getattr(message, name), depth)
        return found


def _object(message: ProtobufMessage, readers: dict[str, _Reader], depth: int) -> Message:
    descriptor: Any = message.DESCRIPTOR
    reader = readers.get(descriptor.full_name)
    if reader is None:
        reader = readers[descriptor.full_name] = _Reader(descriptor, readers)
    return reader.read(message, depth)


def _is_scalar(field: Any) -> bool:
    """Whether a field always has one number or text."""
    composite = field.message_type is not None or field.type == FieldDescriptor.TYPE_BYTES
    return not (composite or field.has_presence or _is_repeated(field))


def _is_repeated(field: Any) -> bool:
    # Before version 6 the package has no `is_repeated`, after it the label is given up.
    if hasattr(field, "is_repeated"):
        return bool(field.is_repeated)
    return bool(field.label == _REPEATED)


def _plain(field: Any, readers: dict[str, _Reader]) -> Callable[[Any, int], Any]:
    """What turns the value of a field that is not scalar into plain values."""
    nested = field.message_type
    if nested is not None and nested.GetOptions().map_entry:
        return _map

    def single(value: Any, depth: int) -> Any:
        if nested is not None:
            return TOO_DEEP if depth >= DEEPEST else _object(value, readers, depth + 1)
        return BYTES if isinstance(value, bytes) else value

    def several(values: Any, depth: int) -> Any:
        if len(values) > MOST_ELEMENTS:
            return LONG_ARRAY
        if nested is None and field.type != FieldDescriptor.TYPE_BYTES:
            return list(values)
        return [single(value, depth) for value in values]

    return several if _is_repeated(field) else single


def _map(values: Any, depth: int) -> Unexpanded | None:  # noqa: ARG001
    return _MAP if len(values) else None


# ----------------------------------------------------------------------------------- ROS 1, ROS 2

Dialect = Literal["ros1", "ros2"]

_ALIASES = {
    "ros1": {"byte": "int8", "char": "uint8"},
    "ros2": {"byte": "uint8", "char": "uint8"},
}

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
        raise UndecodableError("the schema is no definition of ROS messages") from error

    def decode(data: bytes) -> Message:
        if objects * len(data) > _MOST_OBJECTS:
            raise BrokenMessage(f"its arrays can hold more than {_MOST_OBJECTS:,} elements")
        try:
            return read(parse(data, root))
        except (SerdeError, IndexError, OverflowError):
            raise BrokenMessage(f"it is no {name[:60]}") from None

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
    known = {_short(each) for each, _ in sections}
    sections += [(each, body) for each, body in _BUILT_IN[dialect].items() if each not in known]
    texts, count = [], 0
    for message, body in sections:
        if not _NAME.fullmatch(message):
            raise UndecodableError(f"{message[:40]!r} is no name of a message")
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
            raise UndecodableError(f"{declaration[:40]!r} in {message[:60]} is no field")
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


def _short(name: str) -> str:
    """``package/Name`` of a message, also if given as ``package/msg/Name``."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) > 2 else name


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
    names: list[tuple[str, str]] = []
    others: list[tuple[str, Callable[[Any], Any]]] = []
    for field_name, description in types[name][1]:
        if field_name == _PLACEHOLDER:
            continue
        # rosbags puts a line under names that Python needs itself.
        names.append((field_name, f"{field_name}_" if iskeyword(field_name) else field_name))
        kind, element, _ = _element(description)
        if isinstance(element, str):
            if element not in readers:
                readers[element] = _ros_reader(element, types, readers)
            one = readers[element]
            others.append((field_name, one if kind == _NESTED else partial(_ros_list, one)))
        elif kind == _SEQUENCE and element[0] in ("int8", "uint8"):
            others.append((field_name, _bytes))
        elif kind != _BASE:
            others.append((field_name, _ros_array))

    def read(message: Any) -> Message:
        values = message.__dict__
        found: Message = {each: values[attribute] for each, attribute in names}
        for field_name, plain in others:
            found[field_name] = plain(found[field_name])
        return found

    return read


def _bytes(values: Any) -> Unexpanded:  # noqa: ARG001
    return BYTES


def _ros_array(values: Any) -> Any:
    """An array of numbers, or a list of texts."""
    if len(values) > MOST_ELEMENTS:
        return LONG_ARRAY
    return values if isinstance(values, list) else values.tolist()


def _ros_list(one: Callable[[Any], Message], values: list[Any]) -> Any:
    return LONG_ARRAY if len(values) > MOST_ELEMENTS else [one(each) for each in values]

"""Message definitions of ROS 1 and ROS 2 (``.msg`` text, joined by lines of ``=``).

Only what the wire needs is read: types and names of the fields. Constants, default values and
comments are passed over. The text comes from a file and is not trusted: no code is made of it,
definitions that contain themselves are refused, and nesting and size are bounded.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

Dialect = Literal["ros1", "ros2"]

NUMBERS = {
    "bool": "?",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""Letter of the struct module for each type of number."""

_ALIASES = {
    "ros1": {"byte": "int8", "char": "uint8", "Header": "std_msgs/Header"},
    "ros2": {"byte": "uint8", "char": "uint8"},
}

_LONGEST = 1_000_000
"""Characters of a definition."""

_FIELD = re.compile(
    r"(?P<type>[A-Za-z]\w*(?:/\w+){0,2})(?:<=\d+)?"
    r"(?P<array>\[(?P<bound><=)?(?P<size>\d*)\])?"
    r"\s+(?P<name>[A-Za-z]\w*)(?P<rest>\s*=.*|\s.*|)",
    re.ASCII,
)


class DefinitionError(ValueError):
    """A definition that cannot be read; the text says why."""


@dataclass(frozen=True)
class Member:
    """A field of a message.

    Attributes
    ----------
    name : str
    type : str
        A key of `NUMBERS`, ``"string"``, or the name of a message.
    count : int or None
        Length of a fixed array; None for a single value.
    sequence : bool
        Whether it is an array whose length stands in the message.
    """

    name: str
    type: str
    count: int | None = None
    sequence: bool = False


Definitions = dict[str, tuple[Member, ...]]
"""Members of each message by ``package/Name``."""


def short_name(name: str) -> str:
    """``package/Name`` of a message, also if given as ``package/msg/Name``."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) > 2 else name


def definitions_of(name: str, data: bytes, dialect: Dialect) -> Definitions:
    """The messages that the text of a schema defines.

    Parameters
    ----------
    name : str
        Of the schema: the message that the text begins with.
    data : bytes
    dialect : {"ros1", "ros2"}

    Raises
    ------
    DefinitionError
        If a line is no field, a type is not defined, or a message contains itself.
    """
    if len(data) > _LONGEST:
        raise DefinitionError(f"the schema has {len(data):,} bytes")
    try:
        text = data.decode()
    except UnicodeDecodeError:
        raise DefinitionError("the schema is not UTF-8 text") from None
    found: Definitions = dict(_BUILT_IN[dialect])
    first, *others = re.split(r"^={3,}[ \t]*\r?$", text, flags=re.MULTILINE)
    sections = [(short_name(name), first)]
    for section in others:
        head, _, body = section.lstrip().partition("\n")
        if not head.startswith("MSG:"):
            raise DefinitionError("a part of the schema does not say which message it defines")
        sections.append((short_name(head.removeprefix("MSG:").strip()), body))
    for message, body in sections:
        found[message] = _members(body, message, dialect)
    return {message: _resolved(members, message, found) for message, members in found.items()}


def _members(body: str, message: str, dialect: Dialect) -> tuple[Member, ...]:
    members = []
    for line in body.splitlines():
        declaration = line.partition("#")[0].strip()
        if not declaration:
            continue
        match = _FIELD.fullmatch(declaration)
        if match is None:
            raise DefinitionError(f"{declaration[:40]!r} in {message[:60]} is no field")
        if match["rest"].lstrip().startswith("="):
            continue  # a constant
        type_name = short_name(match["type"])
        type_name = _ALIASES[dialect].get(type_name, type_name)
        array, size = match["array"] is not None, match["size"]
        fixed = array and size and not match["bound"]
        if fixed and (len(size) > 9 or int(size) == 0):
            raise DefinitionError(
                f"{match['name'][:40]} in {message[:60]} has {size[:12]} elements"
            )
        count = int(size) if fixed else None
        members.append(Member(match["name"], type_name, count, array and not fixed))
    if len({member.name for member in members}) < len(members):
        raise DefinitionError(f"{message[:60]} has two fields of the same name")
    return tuple(members)


def _resolved(members: tuple[Member, ...], message: str, found: Definitions) -> tuple[Member, ...]:
    """The members with the full names of the messages that they hold."""
    return tuple(
        Member(each.name, _resolve(each.type, message, found), each.count, each.sequence)
        for each in members
    )


def _resolve(type_name: str, message: str, found: Definitions) -> str:
    if type_name in NUMBERS or type_name == "string" or type_name in found:
        return type_name
    beside = f"{message.partition('/')[0]}/{type_name}"
    if beside in found:
        return beside
    raise DefinitionError(f"the schema does not define {type_name[:60]!r}")


_BUILT_IN: dict[str, Definitions] = {
    "ros1": {
        "time": (Member("secs", "uint32"), Member("nsecs", "uint32")),
        "duration": (Member("secs", "int32"), Member("nsecs", "int32")),
    },
    "ros2": {
        "builtin_interfaces/Time": (Member("sec", "int32"), Member("nanosec", "uint32")),
        "builtin_interfaces/Duration": (Member("sec", "int32"), Member("nanosec", "uint32")),
    },
}

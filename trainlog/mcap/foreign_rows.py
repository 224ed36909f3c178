"""What a foreign message says, flattened: one value a path, such as ``pose.position.x``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

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


@dataclass(frozen=True)
class Length:
    """The length of an array, given before its elements so that changing ones can be told."""

    count: int


def leaves(message: Message, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Path and value of everything a message says; arrays are announced by their `Length`.

    Yields
    ------
    path : str
    value : bool, int, float, str, Length or Unexpanded
    """
    for name, value in message.items():
        if value is None:
            continue
        kind = type(value)
        path = f"{prefix}.{name}" if prefix else name
        if kind is float or kind is int or kind is str or kind is bool:
            yield path, value
        elif depth >= DEEPEST:
            yield path, TOO_DEEP
        elif kind is dict:
            yield from leaves(value, path, depth + 1)
        elif kind is list and len(value) > MOST_ELEMENTS:
            yield path, LONG_ARRAY
        elif kind is list:
            yield path, Length(len(value))
            elements = {f"{path}[{at}]": element for at, element in enumerate(value)}
            yield from leaves(elements, "", depth + 1)
        elif kind is Unexpanded:
            yield path, value
        else:
            yield path, Unexpanded(f"a {kind.__name__}, not expanded")

"""How the project's JSON files look: one row of a table a line, so that differences read well."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from trainlog.errors import InputError

_WIDTH = 96
"""Longest line of a small object [characters]; rows of tables may be longer."""


def to_bytes(value: Any) -> bytes:
    """Lay out a value as JSON: the same value gives the same bytes.

    Lists of plain values stand on one line, lists of lists one row a line, small objects on one
    line. Floats are written with the fewest digits that read back as the same double.

    Raises
    ------
    InputError
        If the value holds NaN, infinity or something JSON has no word for; names the key.
    """
    return ("".join(_pieces(value, 0)) + "\n").encode()


def plain(value: Any, place: str = "") -> Any:
    """`value` in JSON's own types: numpy scalars and arrays, tuples and the like replaced.

    Raises
    ------
    InputError
        If it cannot be said in JSON; names the key.
    """
    if isinstance(value, dict):
        return {str(key): plain(item, f"{place}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, f"{place}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist(), place)
    if isinstance(value, float) and not np.isfinite(value):
        raise InputError(f"{place.lstrip('.') or 'value'}: {value} cannot be written to a file")
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise InputError(
        f"{place.lstrip('.') or 'value'}: a {type(value).__name__} cannot be written to a file"
    )


def shortest(values: Any) -> Any:
    """Floats that are whole numbers as integers, which read back as the same doubles."""
    if isinstance(values, list | tuple):
        return [shortest(value) for value in values]
    whole = isinstance(values, float) and values.is_integer() and abs(values) < 2**53
    # Minus zero has no integer.
    return int(values) if whole and not (values == 0 and np.signbit(values)) else values


def _pieces(value: Any, depth: int) -> Iterator[str]:
    flat = _one_line(value)
    if flat is not None:
        yield flat
        return
    inner = "  " * (depth + 1)
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    items = value.items() if isinstance(value, dict) else ((None, item) for item in value)
    separator = opening
    for key, item in items:
        yield f"{separator}\n{inner}"
        if key is not None:
            yield f"{_text(key)}: "
        yield from _pieces(item, depth + 1)
        separator = ","
    yield f"\n{'  ' * depth}{closing}"


def _one_line(value: Any) -> str | None:
    """`value` on one line, or None if it should be broken up."""
    if isinstance(value, dict):
        parts = [_one_line(item) for item in value.values()]
        if any(part is None or part.startswith(("[", "{")) for part in parts):
            return None if value else "{}"
        text = ", ".join(f"{_text(key)}: {part}" for key, part in zip(value, parts, strict=True))
        return f"{{{text}}}" if len(text) <= _WIDTH else None
    if isinstance(value, list):
        if any(isinstance(item, dict | list) for item in value):
            return None
        return f"[{', '.join(map(_text, value))}]"
    return _text(value)


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)

"""TOML: profiles, and the other form of lines, trains and journeys, which has comments."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trainlog.errors import InputError


def parse_toml(data: bytes, *, file: str | Path) -> dict[str, Any]:
    """The content of the bytes of a TOML file.

    Raises
    ------
    InputError
        With the line and column where the text ceases to be TOML.

    Examples
    --------
    >>> parse_toml(b"length = {value = 1, unit = 'km'}", file="line.toml")
    {'length': {'value': 1, 'unit': 'km'}}
    """
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(
            "is not UTF-8 text", file=file, place=f"byte {error.start}", remedy="expected TOML"
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(
            f"is not TOML: {error}", file=file, remedy="correct it there or just before"
        ) from error


def as_toml(content: Mapping[str, Any], comments: Mapping[str, str]) -> str:
    """The content of a file of the project as TOML, a row of a table a line.

    Parameters
    ----------
    content : dict
        As it stands in JSON.
    comments : dict of str to str
        Put before the keys of this name; the one of the empty key before all.

    Examples
    --------
    >>> print(as_toml({"mass": {"value": 3, "unit": "t"}}, {"mass": "Empty."}), end="")
    # Empty.
    mass = { value = 3, unit = "t" }
    """
    lines = [f"# {line}" for line in comments.get("", "").splitlines()]
    tables = {key for key, value in content.items() if _is_table(value)}
    for key in [*(k for k in content if k not in tables), *(k for k in content if k in tables)]:
        noted = [f"# {line}" for line in comments.get(key, "").splitlines()]
        if key in tables:
            lines += ["", *noted, *_table(key, content[key])]
        else:
            lines += [*noted, f"{key} = {toml_value(content[key])}"]
    return "\n".join(lines) + "\n"


def _is_table(value: Any) -> bool:
    return isinstance(value, dict) and set(value) != {"value", "unit"}


def _table(name: str, content: Mapping[str, Any]) -> list[str]:
    lines, inner = [f"[{name}]"], []
    for key, value in content.items():
        if key == "values":
            lines += ["values = [", *(f"  {toml_value(row)}," for row in value), "]"]
        elif key != "units" and _is_table(value):
            inner += ["", *_table(f"{name}.{key}", value)]
        else:
            lines.append(f"{key} = {toml_value(value)}")
    return lines + inner


def toml_value(value: Any) -> str:
    """A value as TOML has it, in a line.

    Examples
    --------
    >>> toml_value({"unit": "km", "values": (1, 2.5)})
    '{ unit = "km", values = [1, 2.5] }'
    """
    if value is None:
        return "nan"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {toml_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, str):
        # What JSON escapes TOML reads alike, but for characters beyond the first 65,536.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    return repr(value).lower() if isinstance(value, bool) else repr(value)


def _key(key: str) -> str:
    return key if key.replace("_", "").isalnum() and key.isascii() else json.dumps(key)

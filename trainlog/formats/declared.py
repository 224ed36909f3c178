"""The files of declared things: read and written as JSON or TOML, with format and version.

What stands in a file follows from the declaration of the thing, see `trainlog.declaration`.
"""

from __future__ import annotations

import datetime
import json
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from trainlog.declaration import Declared, content_of, from_content
from trainlog.errors import InputError, in_file
from trainlog.formats.files import (
    check_written,
    parse_json,
    read_bytes,
    to_bytes,
    too_large,
    write_bytes,
)


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
    with in_file(file):
        try:
            return tomllib.loads(data.decode("utf-8-sig"))
        except UnicodeDecodeError as error:
            place = f"byte {error.start}"
            raise InputError("is not UTF-8 text", place=place, remedy="expected TOML") from error
        except tomllib.TOMLDecodeError as error:
            remedy = "correct it there or just before"
            raise InputError(f"is not TOML: {error}", remedy=remedy) from error
        except (RecursionError, ValueError) as error:
            raise too_large(error, "TOML") from error


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
    if isinstance(value, datetime.date):
        return value.isoformat()
    return repr(value).lower() if isinstance(value, bool) else repr(value)


def _key(key: str) -> str:
    return key if key.replace("_", "").isalnum() and key.isascii() else json.dumps(key)


Thing = TypeVar("Thing", bound=Declared)
Result = TypeVar("Result")


def thing_from_bytes(
    kind: type[Thing], data: bytes, file: str | Path | None = None, *, judged: bool = False
) -> Thing:
    """The thing in the bytes of its file; `file` is what errors call it.

    Parameters
    ----------
    kind : type
    data : bytes
    file : path, optional
        Default: the kind of thing, as in ``train.json``.
    judged : bool
        Whether values that cannot be meant are refused, too: a train of 122 kg.

    Raises
    ------
    InputError
        If they are not such a file. All that is wrong is listed, each with place and remedy.

    Examples
    --------
    >>> from trainlog.railway import Train
    >>> thing_from_bytes(Train, b"{}", "train.json")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: train.json: is not a trainlog/train file: it has no key 'format'...
    """
    named = file or f"{kind.FORMAT.partition('/')[2]}.json"
    return built(lambda: from_content(kind, body_of(kind, data, named), judged), named)


def body_of(kind: type[Declared], data: bytes, file: str | Path) -> dict[str, Any]:
    """What a file states besides its format and version, which are checked."""
    content = parsed(data, file)
    name = kind.FORMAT
    if not isinstance(content, dict) or "format" not in content:
        raise InputError(
            f"is not a {name} file: it has no key 'format'",
            file=file,
            remedy="bring foreign files in with 'trainlog import'",
        )
    if content["format"] != name:
        raise InputError(
            f"is a file of format '{content['format']}', expected '{name}'",
            file=file,
            place="format",
            remedy=f"name a route of the network: '{file}#FROM,TO'"
            if (content["format"], name) == ("trainlog/network", "trainlog/line")
            else "check which file is meant",
        )
    version = content.get("version")
    if version is None:
        raise InputError(
            f"states no version of the format {name}",
            file=file,
            place="version",
            remedy=f"add the version: {kind.VERSION} for a new file",
        )
    check_version(version, kind.VERSION, file, "version")
    return {key: value for key, value in content.items() if key not in ("format", "version")}


def check_version(version: object, newest: int, file: str | Path, place: str | None = None) -> None:
    """Refuse a file of a version that is not known.

    Raises
    ------
    InputError
    """
    if version in range(1, newest + 1) and not isinstance(version, bool):
        return
    newer = isinstance(version, int) and version > newest
    raise InputError(
        f"version {version} is {'newer than' if newer else 'not one that'} this trainlog"
        f" {f'knows ({newest})' if newer else 'reads'}",
        file=file,
        place=place,
        remedy="update trainlog"
        if newer
        else "expected " + " or ".join(map(str, range(1, newest + 1))),
    )


def file_content(thing: Declared) -> dict[str, Any]:
    """What stands in a thing's file, as plain values.

    Examples
    --------
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> file_content(train)["mass"]
    {'value': 122, 'unit': 't'}
    """
    return {"format": thing.FORMAT, "version": thing.version_needed} | content_of(thing)


def thing_to_bytes(thing: Declared) -> bytes:
    """The bytes of the thing's file, JSON: the same thing gives the same bytes.

    Examples
    --------
    >>> import trainlog
    >>> path = Path("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> thing_to_bytes(trainlog.read_train(path)) == path.read_bytes()
    True
    """
    return to_bytes(file_content(thing))


def read_thing(kind: type[Thing], path: str | Path) -> Thing:
    """Read the file of a thing, JSON or TOML, as a user wrote it.

    Raises
    ------
    InputError
        As `thing_from_bytes`, if the file cannot be read, or if values cannot be meant.

    Examples
    --------
    >>> from trainlog.railway import Train
    >>> train = read_thing(Train, "sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> train.name, train.mass
    ('CH_Stadler_FLIRT_TPF', 122000.0)
    """
    return thing_from_bytes(kind, read_bytes(path), path, judged=True)


def write_thing(thing: Declared, path: str | Path, kind: type[Declared]) -> None:
    """Write the file of a thing, whole or not at all; as TOML if its name ends so.

    Raises
    ------
    InputError
        If `thing` is not of that kind, or the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.railway import Train
    >>> train = read_thing(Train, "sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_thing(train, Path(folder) / "copy.train.toml", Train)
    ...     read_thing(Train, Path(folder) / "copy.train.toml") == train
    True
    """
    check_written(thing, kind)
    content = file_content(thing)
    write_bytes(path, as_toml(content, {}).encode() if is_toml(path) else to_bytes(content))


def is_toml(file: str | Path) -> bool:
    """Whether the name of a file ends in .toml."""
    return Path(file).suffix.lower() == ".toml"


def parsed(data: bytes, file: str | Path) -> Any:
    """The content of a file: TOML if its name ends so, else JSON."""
    return (
        _without_nan(parse_toml(data, file=file)) if is_toml(file) else parse_json(data, file=file)
    )


def _without_nan(content: Any) -> Any:
    """TOML's content with None in the place of nan: it has no word for what is not there."""
    if isinstance(content, dict):
        return {key: _without_nan(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_without_nan(value) for value in content]
    return None if isinstance(content, float) and np.isnan(content) else content


def built(make: Callable[[], Result], file: str | Path) -> Result:
    """`make()`, with the file's name added to the InputError it may raise."""
    # Numbers near the end of the doubles overflow in the checks, which then refuse them.
    with in_file(file), np.errstate(over="ignore", invalid="ignore"):
        return make()

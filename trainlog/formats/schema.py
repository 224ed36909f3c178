"""Checked keys, versions and errors: what every file of the project has in common.

A format is a pydantic model whose fields are in SI units; `trainlog.formats.quantities` says how
they stand in the file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails, PydanticSerializationError

from trainlog.errors import InputError
from trainlog.formats.files import parse_json
from trainlog.formats.layout import plain, to_bytes


class Part(BaseModel):
    """A part of a file: strict types, unknown keys refused, values in SI units."""

    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, arbitrary_types_allowed=True
    )


class File(Part):
    """A whole file: a part that names its format and version."""

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int] = 1

    @classmethod
    def from_bytes(cls, data: bytes, file: str | Path) -> Self:
        """Read and check the bytes of a file; `file` is what errors call it.

        Raises
        ------
        InputError
            One line with the place, for example ``gradients.values[3][1]``, and the remedy.
        """
        content = parse_json(data, file=file)
        name = cls.FORMAT
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
                remedy="check which file is meant",
            )
        version = content.get("version")
        if version != cls.VERSION or isinstance(version, bool):
            newer = isinstance(version, int) and version > cls.VERSION
            raise InputError(
                f"version {version} is {'newer than' if newer else 'not one that'} this trainlog"
                f" {f'knows ({cls.VERSION})' if newer else 'reads'}",
                file=file,
                place="version",
                remedy="update trainlog" if newer else f"expected {cls.VERSION}",
            )
        body = {key: value for key, value in content.items() if key not in ("format", "version")}
        return checked(cls, body, file)

    def to_bytes(self) -> bytes:
        """The file's bytes: canonical units, parts that say nothing left out."""
        return to_bytes({"format": self.FORMAT, "version": self.VERSION} | dumped(self))


Model = TypeVar("Model", bound=BaseModel)
Result = TypeVar("Result")


def checked(model: type[Model], content: Any, file: str | Path) -> Model:
    """Validate `content`; pydantic's complaints become one InputError in one line."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise told(error, file) from error


def dumped(part: Part) -> dict[str, Any]:
    """What a part writes into its file: keys and plain values, nothing for what is None.

    Raises
    ------
    InputError
        If a value cannot be written; names its key.
    """
    try:
        content: dict[str, Any] = plain(part.model_dump(by_alias=True, exclude_none=True))
    except PydanticSerializationError as error:
        if isinstance(error.__cause__, InputError):
            raise error.__cause__ from None
        raise
    return content


def built(make: Callable[[], Result], file: str | Path) -> Result:
    """`make()`, with the file's name added to the InputError it may raise."""
    try:
        # Numbers near the end of the doubles overflow in the checks, which then refuse them.
        with np.errstate(over="ignore", invalid="ignore"):
            return make()
    except InputError as error:
        if error.file is not None:
            raise
        raise InputError(
            error.problem, file=file, place=error.place, remedy=error.remedy
        ) from error


def told(error: ValidationError, file: str | Path) -> InputError:
    """The first complaint in one line, and how many more there are; misspelt keys go first."""
    complaints = error.errors(include_url=False)
    first = min(complaints, key=lambda complaint: complaint["type"] != "extra_forbidden")
    place = ""
    for part in first["loc"]:
        place += f"[{part}]" if isinstance(part, int) else f".{part}"
    if first["type"] == "unit":
        place += f".{first['ctx']['where']}"
    key = first["loc"][-1] if first["loc"] else "file"
    problem, remedy = {
        "missing": (f"'{key}' is missing", "add it"),
        "extra_forbidden": (f"unknown key '{key}'", "correct its spelling or remove it"),
        "finite_number": ("is not a finite number", "give one"),
        "too_short": ("has too few entries", f"give {_at_least(first)}"),
    }.get(first["type"], (_sentence(first["msg"]), None))
    others = len(complaints) - 1
    if others:
        problem += f" (and {others} more {'problem' if others == 1 else 'problems'})"
    return InputError(problem, file=file, place=place.lstrip(".") or None, remedy=remedy)


def _at_least(complaint: ErrorDetails) -> str:
    least = complaint.get("ctx", {}).get("min_length", 1)
    return f"at least {least} item{'' if least == 1 else 's'}"


def _sentence(message: str) -> str:
    return message[:1].lower() + message[1:]

"""The profile: a TOML file that says how a recorder writes, and how its columns become topics.

The profiles in the folder ``profiles`` beside this module are formats of their own: their files are
recognised and need no profile; see `trainlog.ingest.registry`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, Self, get_args

import pydantic
from pydantic import BaseModel, Field
from pydantic_core import ErrorDetails

from trainlog.display import as_text
from trainlog.errors import InputError
from trainlog.formats.declared import parse_toml
from trainlog.formats.files import read_bytes
from trainlog.ingest.profile_checks import (
    ProblemsError,
    Strict,
    refuse,
    suggestion,
)
from trainlog.ingest.profile_columns import Column, LineOptions, column_problems
from trainlog.ingest.profile_parts import (
    Detection,
    FileOptions,
    Limits,
    Repair,
    RideOptions,
    TimeOptions,
    TripOptions,
)
from trainlog.presentation import facts_table

_ASSUMED = re.compile(r"(?P<zone>\S+) assumed: ")

PROFILE_FORMAT = "trainlog/recorder-profile"


class Profile(Strict):
    """A recorder's profile; docs/ingest.md describes it with an example."""

    format: Literal["trainlog/recorder-profile"]
    version: Literal[1]
    name: str
    detect: Detection | None = None
    file: FileOptions = FileOptions()
    time: TimeOptions | None = None
    columns: dict[str, Column] = Field(default_factory=dict)
    lines: LineOptions | None = None
    rides: RideOptions | None = None
    trip: TripOptions = TripOptions()
    metadata: dict[str, str] = Field(default_factory=dict)
    limits: Limits = Limits()
    repair: Repair = Repair()

    @pydantic.model_validator(mode="after")
    def _columns_fit(self) -> Self:
        refuse(column_problems(self.columns, self.file.format, self.lines))
        return self

    def __repr__(self) -> str:
        return as_text(f"Profile '{self.name}'", self._summary())

    __str__ = __repr__

    def _repr_html_(self) -> str:
        return facts_table(f"Profile '{self.name}'", self._summary())._repr_html_()

    def _summary(self) -> dict[str, str]:
        rows = {"format": self.file.format or "detected"}
        if self.time is not None:
            rows["time"] = f"{' '.join(self.time.names)} ({self.time.format}, {self.time.timezone})"
        by_topic: dict[str, list[str]] = {}
        for name in self.columns:
            topic, _, item = name.rpartition(".")
            by_topic.setdefault(topic, []).append(item)
        rows |= {topic: ", ".join(items) for topic, items in by_topic.items()}
        if self.repair.switched_off:
            rows["switched off"] = ", ".join(self.repair.switched_off)
        return rows

    @property
    def clock(self) -> str | None:
        """Where the time of trips comes from: as stated, or that its zone was assumed.

        Proposals of earlier versions stored that statement under ``clock``: it holds only while
        the zone is the one that it names.
        """
        zone = None if self.time is None else self.time.timezone
        stored = _ASSUMED.match(self.trip.clock or "")
        if self.trip.clock is not None and (stored is None or stored["zone"] == zone):
            return self.trip.clock
        if self.time is not None and self.time.assumed_timezone == zone:
            return f"{zone} assumed: the file does not state a zone"
        return None

    def recognises(self, head: bytes) -> bool:
        """Whether a file that begins with `head` is of this layout, by its [detect]."""
        if self.detect is None:
            return False
        text = head.removeprefix(b"\xef\xbb\xbf").decode("latin-1")
        lines = text.splitlines()[: max(1, self.file.header or 1)]
        if self.detect.line is not None and not (lines and re.match(self.detect.line, lines[0])):
            return False
        wanted = [set(self.detect.columns)]
        if self.rides is not None:
            wanted.append(set(self.rides.columns))
        cells = lines[-1].split(self.file.delimiter) if lines else []
        names = set(self.file.named(cell.strip().strip('"').strip() for cell in cells))
        return any(columns <= names for columns in wanted)


def read_profile(path: str | Path) -> Profile:
    """Read a profile from a TOML file.

    Raises
    ------
    InputError
        If it is missing, no TOML, or does not fit; the message names the key and what would fit.

    Examples
    --------
    >>> profile = read_profile("sample_logs/recorder.profile.toml")
    >>> profile.columns["/train/state.speed"].unit
    'km/h'
    """
    return parse_profile(read_bytes(path), file=path)


def parse_profile(data: bytes, *, file: str | Path) -> Profile:
    """The profile that the bytes of a TOML file hold; errors as `read_profile`.

    Examples
    --------
    >>> parse_profile(b"format = 'trainlog/line'", file="mine.toml")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: mine.toml: is not a recorder profile...
    """
    content = parse_toml(data, file=file)
    return profile_of(content, file=file)


def profile_of(content: dict[str, Any], *, file: str | Path | None = None) -> Profile:
    """The profile that a dict of the same layout describes; errors as `read_profile`.

    Examples
    --------
    >>> profile = profile_of(
    ...     {
    ...         "format": "trainlog/recorder-profile",
    ...         "version": 1,
    ...         "name": "mine",
    ...         "time": {"column": "t"},
    ...         "columns": {"/train/state.speed": {"column": "v", "unit": "km/h"}},
    ...     }
    ... )
    >>> profile.time.timezone
    'UTC'
    """
    stated = content.get("format")
    if stated != PROFILE_FORMAT:
        raise InputError(
            f"is not a recorder profile: format is {stated!r}",
            file=file,
            remedy=f"begin the file with format = '{PROFILE_FORMAT}' and version = 1",
        )
    try:
        return Profile.model_validate(content)
    except pydantic.ValidationError as error:
        complaints = error.errors(include_url=False)
        # A misspelt key goes before the one that is missing for it.
        complaints.sort(key=lambda complaint: complaint["type"] != "extra_forbidden")
        problems = [one for complaint in complaints for one in _problems(complaint)]
        if any(complaint["loc"] for complaint in complaints):
            # The whole is looked at only where all its parts fit; what else is wrong is listed too.
            problems += [_split(problem) for problem in _problems_of_columns(content)]
        raise InputError.listing(problems, file=file) from error


def _problems(complaint: ErrorDetails) -> list[InputError]:
    """What a complaint of pydantic states."""
    place = "".join(f'."{part}"' if "/" in str(part) else f".{part}" for part in complaint["loc"])
    key = str(complaint["loc"][-1]) if complaint["loc"] else ""
    where = place.lstrip(".") or None
    cause = complaint.get("ctx", {}).get("error")
    if isinstance(cause, ProblemsError):
        return [_split(problem, where) for problem in cause.problems]
    if complaint["type"] == "extra_forbidden":
        known = _keys_beside(tuple(complaint["loc"]))
        return [InputError(f"unknown key '{key}'", place=where, remedy=suggestion(key, known))]
    if complaint["type"] == "missing":
        return [InputError(f"key '{key}' is missing", place=where, remedy="add it")]
    return [_split(_must_be(complaint["msg"].removeprefix("Value error, ")), where)]


def _must_be(message: str) -> str:
    """A complaint of pydantic ("Input should be a valid string") as what the value must be."""
    demand = re.sub(r"^(?:\w+ )?should ", "must ", message)
    return demand[:1].lower() + demand[1:] if demand == message else demand


def _split(message: str, place: str | None = None) -> InputError:
    """A problem and its remedy, from ``"problem; remedy"``."""
    problem, _, remedy = message.partition("; ")
    return InputError(problem, place=place, remedy=remedy or None)


def _problems_of_columns(content: dict[str, Any]) -> list[str]:
    """What is wrong with those columns of a profile that can be read one by one."""
    columns: dict[str, Column] = {}
    given = content.get("columns")
    for name, described in given.items() if isinstance(given, dict) else ():
        with suppress(pydantic.ValidationError):
            columns[name] = Column.model_validate(described)
    file = content.get("file")
    return column_problems(columns, file.get("format") if isinstance(file, dict) else None)


def _keys_beside(place: tuple[int | str, ...]) -> Iterable[str]:
    """The keys that a profile knows at the same level as the key at `place`."""
    model: type[BaseModel] = Profile
    for part in place[:-1]:
        field = model.model_fields.get(str(part))
        if field is not None:  # else it is a name that the user chose
            model = next(_models(field.annotation), model)
    return model.model_fields


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """The parts of a profile that an annotation such as ``dict[str, Column] | None`` names."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)

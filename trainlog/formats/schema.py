"""What every file of the project has in common: checked keys, versions, errors, units.

A format is a pydantic model whose fields are in SI units. Annotations say how a field stands in the
file: the unit it is written with, and the dimension it must have on reading, in whatever unit the
file declares.
"""

from __future__ import annotations

import json
import re
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import (
    CoreSchema,
    ErrorDetails,
    PydanticCustomError,
    PydanticSerializationError,
    core_schema,
)

from trainlog.arrays import FloatArray
from trainlog.declaration import (
    declared,
    gathered as gathered,
    plain,
    readable as readable,
    shortest,
)
from trainlog.errors import InputError
from trainlog.formats.declared import built as built
from trainlog.formats.files import parse_json, to_bytes
from trainlog.formats.toml import as_toml, parse_toml
from trainlog.units import to_si


class Part(BaseModel):
    """A part of a file: strict types, unknown keys refused, values in SI units."""

    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, arbitrary_types_allowed=True
    )

    @classmethod
    def holding(cls, value: Any, **others: Any) -> Self:
        """The part with the attributes of `value` by the same names; `others` go before these."""
        same = {n: getattr(value, n) for n in cls.model_fields if n not in others}
        return cast(Self, cls.model_construct(**same, **others))


class Foreign(BaseModel):
    """A part of a file of another project: keys that are not known are passed over."""

    model_config = ConfigDict(extra="ignore", frozen=True)


Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class File(Part):
    """A whole file: a part that names its format and version."""

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int] = 1
    """The newest that is read; all older ones are, too."""

    @property
    def version_needed(self) -> int:
        """The oldest version in which all that the file states is known; it is written."""
        return 1

    @classmethod
    def from_bytes(cls, data: bytes, file: str | Path) -> Self:
        """Read and check the bytes of a file; `file` is what errors call it.

        Raises
        ------
        InputError
            One line with the place, for example ``gradients.values[3][1]``, and the remedy.
        """
        content = _parsed(data, file)
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
        if version not in range(1, cls.VERSION + 1) or isinstance(version, bool):
            newer = isinstance(version, int) and version > cls.VERSION
            raise InputError(
                f"version {version} is {'newer than' if newer else 'not one that'} this trainlog"
                f" {f'knows ({cls.VERSION})' if newer else 'reads'}",
                file=file,
                place="version",
                remedy="update trainlog"
                if newer
                else "expected " + " or ".join(map(str, range(1, cls.VERSION + 1))),
            )
        body = {key: value for key, value in content.items() if key not in ("format", "version")}
        try:
            return cls.model_validate(body)
        except ValidationError as error:
            problems = [*problems_of(error), *cls._problems_of_the_rest(body)]
            raise InputError.listing(problems, file=file) from error

    @classmethod
    def _problems_of_the_rest(cls, body: dict[str, Any]) -> list[InputError]:
        """What is wrong besides with those parts of a file that can be read."""
        values: dict[str, Any] = {}
        for name, info in cls.model_fields.items():
            if name not in body:
                if not info.is_required():
                    values[name] = info.get_default(call_default_factory=True)
                continue
            with suppress(ValidationError):
                values[name] = _reader(cls, name).validate_python(body[name])
        if values.keys() != cls.model_fields.keys():
            return cls.implausible(values)
        return cls.model_construct(**values).problems()

    def problems(self) -> list[InputError]:
        """What is wrong with a file whose keys and types are as they must be."""
        problems: list[InputError] = []
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                self.content()
        except InputError as error:
            problems += error.each
        return problems + self.implausible(dict(self))

    def content(self) -> Any:
        """What the file describes; InputError where it cannot be."""
        return None

    @classmethod
    def implausible(cls, values: dict[str, Any]) -> list[InputError]:  # noqa: ARG003
        """What of `values` [SI] by the names of fields, perhaps not of all, cannot be meant."""
        return []

    @classmethod
    def read(cls, data: bytes, file: str | Path) -> Any:
        """What a file that a user wrote describes: as `content`, and plausible besides."""
        parsed = cls.from_bytes(data, file)
        problems = parsed.problems()
        if problems:
            raise InputError.listing(problems, file=file)
        return parsed.content()

    def to_bytes(self) -> bytes:
        """The file's bytes: canonical units, parts without content left out."""
        return to_bytes(self.file_content())

    def bytes_for(self, path: str | Path) -> bytes:
        """The bytes of the file `path`: TOML if its name ends so, else JSON."""
        if is_toml(path):
            return as_toml(self.file_content(), {}).encode()
        return self.to_bytes()

    def file_content(self) -> dict[str, Any]:
        """What stands in the file: canonical units, parts without content left out."""
        return {"format": self.FORMAT, "version": self.version_needed} | dumped(self)


@cache
def _reader(model: type[File], name: str) -> TypeAdapter[Any]:
    """What reads one key of a file alone."""
    info = model.model_fields[name]
    annotation: Any = info.annotation
    for item in info.metadata:
        annotation = Annotated[annotation, item]
    return TypeAdapter(annotation)


Model = TypeVar("Model", bound=BaseModel)
Result = TypeVar("Result")


def checked(model: type[Model], content: Any, file: str | Path) -> Model:
    """Validate `content`; pydantic's complaints become one InputError in one line."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise error_of(error, file) from error


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


def error_of(error: ValidationError, file: str | Path) -> InputError:
    """All complaints of pydantic as one InputError."""
    return InputError.listing(problems_of(error), file=file)


def problems_of(error: ValidationError) -> list[InputError]:
    """Each complaint of pydantic as an InputError; misspelt keys go first."""
    complaints = error.errors(include_url=False)
    return [
        _problem(complaint)
        for complaint in sorted(complaints, key=lambda one: one["type"] != "extra_forbidden")
    ]


def _problem(complaint: ErrorDetails) -> InputError:
    place = ""
    for part in complaint["loc"]:
        place += f"[{part}]" if isinstance(part, int) else f".{part}"
    if complaint["type"] == "unit":
        place += f".{complaint['ctx']['where']}"
    key = complaint["loc"][-1] if complaint["loc"] else "file"
    problem, remedy = {
        "missing": (f"'{key}' is missing", "add it"),
        "extra_forbidden": (f"unknown key '{key}'", "correct its spelling or remove it"),
        "finite_number": ("is not a finite number", "give one"),
        "too_short": ("has too few entries", f"give {_at_least(complaint)}"),
    }.get(complaint["type"], (must_be(complaint["msg"]), None))
    if complaint["type"] in ("unit", "without_unit"):
        problem, _, remedy = problem.partition("; ")
    return InputError(problem, place=place.lstrip(".") or None, remedy=remedy)


def is_toml(file: str | Path) -> bool:
    """Whether the name of a file ends in .toml."""
    return Path(file).suffix.lower() == ".toml"


def _parsed(data: bytes, file: str | Path) -> Any:
    """The content of a file: TOML if its name ends so, else JSON."""
    if is_toml(file):
        return without_nan(parse_toml(data, file=file))
    return parse_json(data, file=file)


def without_nan(content: Any) -> Any:
    """TOML's content with None in the place of nan: it has no word for what is not there."""
    if isinstance(content, dict):
        return {key: without_nan(value) for key, value in content.items()}
    if isinstance(content, list):
        return [without_nan(value) for value in content]
    return None if isinstance(content, float) and np.isnan(content) else content


def _at_least(complaint: ErrorDetails) -> str:
    least = complaint.get("ctx", {}).get("min_length", 1)
    return f"at least {least} item{'' if least == 1 else 's'}"


def must_be(message: str) -> str:
    """A complaint of pydantic ("Input should be a valid string") as what the value must be."""
    demand = re.sub(r"^(?:\w+ )?should ", "must ", message)
    return demand[:1].lower() + demand[1:] if demand == message else demand


INFINITY: tuple[str, float] = ("infinity", np.inf)
"""Radii of straight track."""

MISSING: tuple[None, float] = (None, np.nan)
"""Values that are not set."""

_NUMBER = core_schema.float_schema(strict=True, allow_inf_nan=False)
_TEXT = core_schema.str_schema(strict=True)


def _to_si(values: ArrayLike, unit: str, si: str, where: str = "unit") -> FloatArray:
    """Convert; a wrong unit is reported in pydantic's way, so that its place is kept."""
    try:
        with np.errstate(over="ignore"):
            converted = to_si(values, unit, si)
    except InputError as error:
        raise PydanticCustomError(
            "unit",
            "{problem}; {remedy}",
            {"where": where, "problem": error.problem, "remedy": error.remedy or ""},
        ) from error
    if not np.all(np.isfinite(converted)):
        raise PydanticCustomError("finite_number", "is not a finite number")
    return converted


@dataclass(frozen=True)
class Quantity:
    """A number with its unit: ``{"value": 122, "unit": "t"}``; a float in `si` inside.

    Attributes
    ----------
    unit : str
        What it is written in.
    si : str
    """

    unit: str
    si: str

    def __get_pydantic_core_schema__(self, _: Any, __: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(
            self._read,
            core_schema.no_info_before_validator_function(
                self._refuse_bare, _keys(value=_NUMBER, unit=_TEXT)
            ),
            serialization=core_schema.plain_serializer_function_ser_schema(self.write),
        )

    def _refuse_bare(self, found: Any) -> Any:
        if isinstance(found, int | float | str) and not isinstance(found, bool):
            raise PydanticCustomError(
                "without_unit",
                "{found} has no unit; give value and unit, for example {example}",
                {
                    "found": repr(found),
                    "example": json.dumps(
                        {"value": 1 if isinstance(found, str) else found, "unit": self.unit}
                    ),
                },
            )
        return found

    def _read(self, found: dict[str, Any]) -> float:
        return float(_to_si(found["value"], found["unit"], self.si))

    def write(self, value: float) -> dict[str, Any]:
        """The number as it stands in the file."""
        return {"value": declared(value, self.unit, self.si), "unit": self.unit}


@dataclass(frozen=True, eq=False)
class Named:
    """Numbers under published names, each a `Quantity`; a dict of float inside.

    Attributes
    ----------
    quantities : dict of str to Quantity
        Every name that may occur.
    """

    quantities: dict[str, Quantity]

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.typed_dict_schema(
            {
                name: core_schema.typed_dict_field(
                    quantity.__get_pydantic_core_schema__(float, handler), required=False
                )
                for name, quantity in self.quantities.items()
            },
            extra_behavior="forbid",
            serialization=core_schema.plain_serializer_function_ser_schema(self._write),
        )

    def _write(self, content: dict[str, float]) -> dict[str, Any]:
        for name in content:
            if name not in self.quantities:
                raise InputError(
                    f"parameter '{name}' is not known, so its unit is not either",
                    remedy=f"known are {', '.join(self.quantities)}",
                )
        return {
            name: quantity.write(content[name])
            for name, quantity in self.quantities.items()
            if name in content
        }


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes
    ----------
    name : str
    unit, si : str
        The unit it is written in and the one it holds inside; without units it is text.
    instead : (word, float), optional
        A word that may stand in place of a number, and the number that it is inside.
    """

    name: str
    unit: str = ""
    si: str = ""
    instead: tuple[str | None, float] | None = None

    @property
    def cell(self) -> CoreSchema:
        """What one cell may hold."""
        if not self.unit:
            return _TEXT
        if self.instead is None:
            return _NUMBER
        word = self.instead[0]
        if word is None:
            return core_schema.nullable_schema(_NUMBER)
        return core_schema.union_schema(
            [core_schema.literal_schema([word]), _NUMBER],
            custom_error_type="cell",
            custom_error_message=f"must be a finite number or '{word}'",
        )

    def read(self, cells: tuple[Any, ...], units: dict[str, str]) -> Any:
        """The column in SI units, from its cells and the table's units."""
        if not self.unit:
            return cells
        word, value = self.instead or MISSING
        is_word = np.array([cell == word for cell in cells], dtype=np.bool_)
        numbers = [0.0 if cell == word else cell for cell in cells]
        converted = _to_si(numbers, units[self.name], self.si, f"units.{self.name}")
        return np.where(is_word, value, converted)

    def write(self, values: Any) -> list[Any]:
        """The column's cells."""
        if not self.unit:
            return list(values)
        numbers = np.asarray(values, dtype=np.float64)
        if self.instead is None:
            return list(declared(numbers, self.unit, self.si))
        word, _ = self.instead
        written = declared(np.where(np.isfinite(numbers), numbers, 0.0), self.unit, self.si)
        return [w if f else word for w, f in zip(written, np.isfinite(numbers), strict=True)]


@dataclass(frozen=True)
class Table:
    """Rows with declared units: ``{"units": {"position": "m", ...}, "values": [[...], ...]}``.

    Inside, a tuple with one member a column: an array in SI units, or a tuple of str.
    """

    columns: tuple[Column, ...]

    def __get_pydantic_core_schema__(self, _: Any, __: GetCoreSchemaHandler) -> CoreSchema:
        row = core_schema.tuple_positional_schema([c.cell for c in self.columns], strict=False)
        units = {column.name: _TEXT for column in self.columns if column.unit}
        return core_schema.no_info_after_validator_function(
            self._read,
            _keys(units=_keys(**units), values=core_schema.list_schema(row, strict=True)),
            serialization=core_schema.plain_serializer_function_ser_schema(self._write),
        )

    def _read(self, found: dict[str, Any]) -> tuple[Any, ...]:
        cells = list(zip(*found["values"], strict=True)) or [()] * len(self.columns)
        return tuple(
            column.read(values, found["units"])
            for column, values in zip(self.columns, cells, strict=True)
        )

    def _write(self, content: tuple[Any, ...]) -> dict[str, Any]:
        cells = [c.write(values) for c, values in zip(self.columns, content, strict=True)]
        return {
            "units": {column.name: column.unit for column in self.columns if column.unit},
            "values": [list(row) for row in zip(*cells, strict=True)],
        }


@dataclass(frozen=True)
class Array:
    """Numbers with one unit: ``{"unit": "m/s", "values": [[...], ...]}``; an array inside.

    Attributes
    ----------
    si : str
        What it is written in, exactly, and what it holds.
    dimensions : {1, 2}
    gaps : bool
        Whether values may be missing: ``null`` in the file, NaN inside.
    """

    si: str
    dimensions: int = 1
    gaps: bool = False

    def __get_pydantic_core_schema__(self, _: Any, __: GetCoreSchemaHandler) -> CoreSchema:
        values: CoreSchema = core_schema.nullable_schema(_NUMBER) if self.gaps else _NUMBER
        for _dimension in range(self.dimensions):
            values = core_schema.list_schema(values, strict=True)
        return core_schema.no_info_after_validator_function(
            self._read,
            _keys(unit=_TEXT, values=values),
            serialization=core_schema.plain_serializer_function_ser_schema(self._write),
        )

    def _read(self, found: dict[str, Any]) -> FloatArray:
        rows = found["values"]
        if self.dimensions == 2 and len({len(row) for row in rows}) > 1:
            raise PydanticCustomError("ragged", "rows differ in length")
        numbers = np.array(rows, dtype=np.float64)
        missing = np.isnan(numbers)
        converted = _to_si(np.where(missing, 0.0, numbers), found["unit"], self.si)
        return np.where(missing, np.nan, converted)

    def _write(self, content: FloatArray) -> dict[str, Any]:
        values = shortest(np.asarray(content, dtype=np.float64).tolist())
        return {"unit": self.si, "values": _with_gaps(values) if self.gaps else values}


def _with_gaps(values: Any) -> Any:
    if isinstance(values, list):
        return [_with_gaps(value) for value in values]
    return None if np.isnan(values) else values


def _keys(**fields: CoreSchema) -> CoreSchema:
    """An object with exactly these keys."""
    return core_schema.typed_dict_schema(
        {name: core_schema.typed_dict_field(schema) for name, schema in fields.items()},
        extra_behavior="forbid",
        strict=True,
    )

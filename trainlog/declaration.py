"""What a thing is, declared once: the fields of a frozen dataclass and how they stand in its file.

A field's type says what it is; an annotation says how it is written and what it may be:

    mass: Annotated[float, Quantity("t", "kg", must=POSITIVE, plausible=(5, 2e4, "trains have"))]

From the fields follow the file in both directions (`content_of`, `from_content`), what it must and
what it can be, the commented template of a new file, and the summary that is printed. Inside, all
values are in SI units. The sentence on each field is that of the class's docstring.
"""

from __future__ import annotations

import datetime
import inspect
import json
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import cache
from itertools import groupby
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)  # fmt: skip

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray, IntArray, same_values
from trainlog.display import counted
from trainlog.errors import InputError, suggestion
from trainlog.presentation import Presented
from trainlog.units import KMH, factor, to_si

Thing = TypeVar("Thing")
Result = TypeVar("Result")

Stated = Literal["", "written", "required", "read"]
"""When a field that has a default stands in the file: where it differs from it; always, and it may
be left out; always; it may, and is not written. One without a default always does."""


def _once(make: Callable[[Any], Result]) -> Callable[[Any], Result]:
    """A function of a type whose results are kept."""
    return cache(make)


# ------------------------------------------------------------------ what values may be


@dataclass(frozen=True, slots=True)
class Must:
    """The range in which a number must lie, whatever it describes.

    Examples
    --------
    >>> POSITIVE.holds(0.0), NOT_NEGATIVE.holds(0.0)
    (False, True)
    """

    otherwise: str
    remedy: str
    low: float = 0.0
    high: float = np.inf
    above: bool = False
    """Whether `low` itself is refused."""

    def holds(self, value: float) -> bool:
        """Whether a value is in the range; NaN is not."""
        return (value > self.low if self.above else value >= self.low) and value <= self.high


POSITIVE = Must("is not positive", "give more than 0", above=True)
NOT_NEGATIVE = Must("is negative", "give 0 or more")
SHARE = Must("is not between 0 and 100 %", "give it as a share, for example 90 %", high=1.0)
LARGEST = sys.float_info.max
FINITE = Must("is not a finite number", "give one", low=-LARGEST, high=LARGEST)
POSITIVE_FINITE = Must("is not positive and finite", "give more than 0", high=LARGEST, above=True)
POSITIVE_SHARE = Must(
    "is not above 0 and at most 100 %", "give it as a share, for example 90 %", high=1.0, above=True
)

Confused = tuple[tuple[float, str], ...]
"""Factors by which a value is off when its unit is confused, each with the confusion."""


def _thousand(large: str, small: str) -> Confused:
    """The confusions of a unit with a thousandth of it."""
    return (
        (1e3, f"were {large} meant where the unit states {small}"),
        (1e-3, f"were {small} meant where the unit states {large}"),
    )


TONNES, NEWTONS, WATTS = _thousand("t", "kg"), _thousand("kN", "N"), _thousand("kW", "W")

CONFUSED: dict[str, Confused] = {
    "t": TONNES,
    "kg": TONNES,
    "kN": NEWTONS,
    "kW": WATTS,
    "W/kg": (*WATTS, *TONNES),
    "m": tuple(reversed(_thousand("m", "mm"))),
    "km": _thousand("km", "m"),
    "km/h": (
        (KMH, "were m/s meant where the unit states km/h"),
        (1.0 / KMH, "were km/h meant where the unit states m/s"),
    ),
    "%": ((0.01, "was the percentage given as a pure number"),),
}
"""By the unit of a file."""

# ------------------------------------------------------------------ how values are written


@dataclass(frozen=True, kw_only=True)
class Form:
    """How a field stands in the file: as JSON has its type, or as a word of a Literal.

    Attributes
    ----------
    key : str
        Its key there; empty: its name.
    stated : {"", "written", "required", "read"}
        See `Stated`.
    usual : object
        Value of the template.
    shown : str
        Row of the summary and, after a colon, the words in which ``{}`` is the value.
    must : Must, optional
    """

    key: str = ""
    stated: Stated = ""
    usual: Any = None
    shown: str = ""
    must: Must | None = None

    def read(self, found: Any, kind: Any) -> Any:
        """The value, of type `kind`, that stands in the file as `found`; InputError if none."""
        words = get_args(kind)
        same = (found == word and type(found) is type(word) for word in words)
        if get_origin(kind) is Literal and not any(same):
            *most, last = map(repr, words)
            raise InputError(f"must be {', '.join(most)} or {last}" if most else f"must be {last}")
        kinds = {str: "string", int: "integer", bool: "boolean", dict: "dictionary"}
        held = get_origin(kind) or kind
        return _valid(found, (held,), kinds[held]) if held in kinds else found

    def write(self, value: Any, in_si: bool = False) -> Any:  # noqa: ARG002
        """The value as it stands in the file, perhaps in SI units; None: it is left out."""
        return plain(value, self.key)

    def words(self, value: Any) -> str:
        """The value in a summary."""
        return str(value)

    def refused(self, value: Any, place: str, kind: Any = None) -> InputError | None:
        """Why the value of a field of type `kind` cannot be."""
        if value is None:
            return None
        if get_origin(kind) is Literal and value not in get_args(kind):
            remedy = f"it is one of {', '.join(map(str, get_args(kind)))}"
            return InputError(f"no such {place} '{value}'", place=place, remedy=remedy)
        if self.must is None or self.must.holds(value):
            return None
        problem = f"{self.words(value)} {self.must.otherwise}"
        return InputError(problem, place=place, remedy=self.must.remedy)

    def implausible(self, value: Any, place: str) -> Iterator[InputError]:  # noqa: ARG002
        """Why the value cannot be meant."""
        yield from ()


def _valid(found: Any, kinds: tuple[type, ...], what: str) -> Any:
    """`found` if it is of one of the types; JSON's true and false are no numbers."""
    if type(found) not in kinds:
        raise InputError(f"must be a valid {what}")
    return found


@dataclass(frozen=True)
class Text(Form):
    """Text of at least, and perhaps at most, so many characters."""

    least: int = 0
    most: int | None = None

    def read(self, found: Any, kind: Any = str) -> str:  # noqa: ARG002
        """The text."""
        text: str = super().read(found, str)
        if len(text) < self.least:
            raise InputError(f"must have at least {counted(self.least, 'character')}")
        if self.most is not None and len(text) > self.most:
            raise InputError(f"must have at most {counted(self.most, 'character')}")
        return text


@dataclass(frozen=True)
class Number(Form):
    """A number without a unit.

    Attributes
    ----------
    gaps : bool
        Whether it may be missing, and is NaN then.
    infinite : bool
        Whether it may be infinite; then it is not written.
    """

    gaps: bool = False
    infinite: bool = False

    def read(self, found: Any, kind: Any = float) -> float:  # noqa: ARG002
        """The number."""
        if self.infinite and found in (np.inf, -np.inf):
            return float(found)
        return np.nan if found is None and self.gaps else _number(found)

    def write(self, value: Any, in_si: bool = False) -> Any:  # noqa: ARG002
        """The number; None where there is none."""
        absent = (self.gaps and np.isnan(value)) or (self.infinite and np.isinf(value))
        return None if absent else plain(value, self.key)


@dataclass(frozen=True)
class Moment(Form):
    """A date, or a date and time: as TOML has it, or as text (ISO 8601)."""

    def read(self, found: Any, kind: Any) -> Any:
        """The date."""
        if isinstance(found, str):
            with suppress(ValueError):
                found = kind.fromisoformat(found)
        what = "date and time" if kind is datetime.datetime else "date"
        return _valid(found, (kind,), what)

    def write(self, value: Any, in_si: bool = False) -> Any:  # noqa: ARG002
        """The same."""
        return value


@dataclass(frozen=True)
class Either(Form):
    """A value of one of several types: the first that can be read."""

    def read(self, found: Any, kind: Any) -> Any:
        """The value."""
        problems = Problems()
        for each in get_args(kind):
            if each is not NoneType:
                with problems.at():
                    return _reader(each)(found)
        raise InputError.listing(problems)

    def write(self, value: Any, in_si: bool = False) -> Any:
        """The value as its own type is written."""
        return form_of(type(value)).write(value, in_si)


def _number(found: Any) -> float:
    """A finite number."""
    if not abs(_valid(found, (int, float), "number")) <= LARGEST:
        raise InputError("is not a finite number", remedy="give one")
    return float(found)


@dataclass(frozen=True)
class Quantity(Form):
    """A number with its unit: ``{"value": 122, "unit": "t"}``; a float in `si` inside.

    Attributes
    ----------
    unit : str
        What it is written in.
    si : str
    plausible : (float, float, str), optional
        Least and greatest value [unit] of what is meant, and whose values these are.
    confused : tuple of (float, str), optional
        Instead of the confusions of the unit.

    Examples
    --------
    >>> mass = Quantity("t", "kg")
    >>> mass.write(122e3), mass.read({"value": 500, "unit": "kg"})
    ({'value': 122, 'unit': 't'}, 500.0)
    """

    unit: str
    si: str
    plausible: tuple[float, float, str] | None = None
    confused: Confused | None = None

    def read(self, found: Any, kind: Any = float) -> float:  # noqa: ARG002
        """The number in SI."""
        if type(found) in (int, float, str):
            example = {"value": 1 if isinstance(found, str) else found, "unit": self.unit}
            raise InputError(
                f"{found!r} has no unit",
                remedy=f"give value and unit, for example {json.dumps(example)}",
            )
        value, unit = read_keys(found, value=_number, unit=Text().read)
        return float(in_si(value, unit, self.si))

    def write(self, value: Any, in_si: bool = False) -> Any:
        """The number with its unit."""
        unit = self.si if in_si else self.unit
        return {"value": declared(value, unit, self.si), "unit": unit}

    def words(self, value: Any) -> str:
        """The number in the unit of the file."""
        return f"{self._of_file(value):.6g} {self._named}".removesuffix(" 1")

    def implausible(self, value: Any, place: str) -> Iterator[InputError]:
        """Why the number cannot be meant; what is not positive is not judged."""
        if self.plausible is None or value is None or not np.isfinite(value) or value <= 0.0:
            return
        low, high, whose = self.plausible
        found = self._of_file(value)
        slack = 1e-12
        if low * (1.0 - slack) <= found <= high * (1.0 + slack):
            return
        confused = CONFUSED.get(self.unit, ()) if self.confused is None else self.confused
        likely = [cause for by, cause in confused if low <= found * by <= high]
        yield InputError(
            f"{found:.6g} {self._named} is not plausible: {whose} {low:g} to {high:g}"
            f" {self._named}",
            place=place,
            remedy=f"{likely[0]}?" if likely else "check the value and its unit",
        )

    def _of_file(self, value: float) -> float:
        slope, offset = (1.0, 0.0) if self.unit == self.si else factor(self.unit, self.si)
        return (value - offset) / slope

    @property
    def _named(self) -> str:
        return {"permil": "per mille"}.get(self.unit, self.unit)


def in_si(values: ArrayLike, unit: str, si: str, where: str = "unit") -> FloatArray:
    """Numbers of a file in SI; a wrong unit is reported at the place `where`."""
    with at(where), np.errstate(over="ignore"):
        converted = to_si(values, unit, si)
    if not np.all(np.isfinite(converted)):
        raise InputError("is not a finite number", remedy="give one")
    return converted


def read_keys(found: Any, **reads: Callable[[Any], Any]) -> list[Any]:
    """What stands under the keys of an object that has exactly these."""
    return list(_read_object(found, reads, reads.keys()).values())


def _read_object(
    found: Any, reads: Mapping[str, Callable[[Any], Any]], required: Collection[str] = ()
) -> dict[str, Any]:
    """What stands under the keys of an object, in the order in which they are declared."""
    _valid(found, (dict,), "dictionary")
    problems = Problems(_unknown(key, reads) for key in found if key not in reads)
    values = {}
    for key, read in reads.items():
        if key in found:
            with problems.at(f'"{key}"' if "/" in key else key):
                values[key] = read(found[key])
        elif key in required:
            problems.append(_missing(key))
    problems.check()
    return values


def _unknown(key: str, known: Iterable[str]) -> InputError:
    remedy = suggestion(key, known, "correct its spelling or remove it; known")
    return InputError(f"unknown key '{key}'", place=key, remedy=remedy)


def _missing(key: str) -> InputError:
    return InputError(f"'{key}' is missing", place=key, remedy="add it")


def placed(error: InputError, before: str) -> list[InputError]:
    """The problems of an error with `before` in front of their places.

    Examples
    --------
    >>> [each.place for each in placed(InputError("is wrong", place="[3].unit"), "rows")]
    ['rows[3].unit']
    """
    return [
        InputError(
            each.problem if each.file is None else f"{each.file}: {each.problem}",
            place=f"{before}{'.' * ((each.place or '[')[0] != '[')}{each.place or ''}",
            remedy=each.remedy,
        )
        for each in error.each
    ]


@contextmanager
def at(place: str) -> Iterator[None]:
    """Put a place in front of those of the InputError that the block may raise."""
    problems = Problems()
    with problems.at(place):
        yield
    problems.check()


class Problems(list[InputError]):
    """What is wrong with the parts of a thing, so that all of it is raised at once.

    Examples
    --------
    >>> problems = Problems()
    >>> with problems.at("mass"):
    ...     raise InputError("is negative")
    >>> problems.check()
    Traceback (most recent call last):
    trainlog.errors.InputError: mass: is negative
    """

    @contextmanager
    def at(self, place: str = "") -> Iterator[None]:
        """Add what the block may raise, with a place in front of its own."""
        try:
            yield
        except InputError as error:
            self += placed(error, place) if place else error.each

    def check(self) -> None:
        """Raise one InputError that lists all problems, if there are any."""
        if self:
            raise InputError.listing(self)


Gap = tuple[str | None, float]

INFINITY: Gap = ("infinity", np.inf)
"""Radii of straight track."""

NOT_SET: Gap = (None, np.nan)
"""Values that are not set."""


@dataclass(frozen=True)
class Column(Form):
    """One column of a table.

    Attributes
    ----------
    name : str
    unit, si : str
        The unit it is written in and the one it holds inside; without units it is text.
    instead : (word, float), optional
        A word that may stand in place of a number, and the number that it is inside.
    inverse : bool
        Whether the file has the inverse of what is held: a radius, where inside it is curvature.
    table : str
        Key of the table, where the thing's file has others beside it.
    """

    name: str = ""
    unit: str = ""
    si: str = ""
    instead: Gap | None = None
    inverse: bool = False
    table: str = ""

    def check(self, cell: Any) -> None:
        """Refuse a cell that does not belong into the column."""
        word = self.instead[0] if self.instead else 0
        if not self.unit:
            _valid(cell, (str,), "string")
        elif not (self.instead and cell == word and type(cell) is type(word)):
            try:
                _number(cell)
            except InputError as error:
                if isinstance(word, str):
                    raise InputError(f"must be a finite number or '{word}'") from error
                raise

    def read_cells(self, cells: Sequence[Any], unit: str) -> Any:
        """The column in SI units."""
        if not self.unit:
            return tuple(cells)
        word, value = self.instead or NOT_SET
        is_word = np.array([cell == word for cell in cells], dtype=np.bool_)
        numbers = [0.0 if cell == word else cell for cell in cells]
        converted = np.where(is_word, value, in_si(numbers, unit, self.si, f"units.{self.name}"))
        if not self.inverse:
            return converted
        if np.any(converted == 0.0):
            raise InputError(
                f"the {self.name.replace('_', ' ').partition(' ')[0]} is 0 {self.si}",
                place=f"values[{int(np.argmax(converted == 0.0))}]",
                remedy=f"straight track has the radius '{word}'",
            )
        return 1.0 / converted

    def write_cells(self, values: Any, in_si: bool = False) -> list[Any]:
        """The column's cells."""
        if not self.unit:
            return list(values)
        numbers = np.asarray(values, dtype=np.float64)
        if self.inverse:
            with np.errstate(divide="ignore", over="ignore"):
                numbers = readable(numbers, 1.0 / numbers, lambda inverse: 1.0 / inverse)
        unit = self.si if in_si else self.unit
        if self.instead is None:
            return list(declared(numbers, unit, self.si))
        finite = np.isfinite(numbers)
        written = declared(np.where(finite, numbers, 0.0), unit, self.si)
        return [w if f else self.instead[0] for w, f in zip(written, finite, strict=True)]


@dataclass(frozen=True)
class Table(Form):
    """Rows with declared units: ``{"units": {"position": "m", ...}, "values": [[...], ...]}``.

    Inside, a dataclass with an array for each column, a tuple of dataclasses or of tuples.

    Attributes
    ----------
    columns : tuple of Column
        Empty: those of the dataclass.
    fields : bool
        Whether the columns are fields of the thing itself, beside others.
    """

    columns: tuple[Column, ...] = ()
    fields: bool = False

    def read(self, found: Any, kind: Any) -> Any:
        """What the rows describe."""
        columns = self.columns or columns_of(_row_of(kind))
        content = self.read_columns(found, columns)
        if kind is None or self.fields:
            return content
        if is_dataclass(kind):
            return kind(*content)  # type: ignore[operator]
        cells = [c if isinstance(c, tuple) else c.tolist() for c in content]
        for number, column in enumerate(columns):
            if column.instead is NOT_SET:
                cells[number] = [None if np.isnan(each) else each for each in cells[number]]
        rows = list(zip(*cells, strict=True))
        row: Any = _row_of(kind)
        if not is_dataclass(row):
            return tuple(rows)
        with at("values"):
            return tuple(_items(rows, lambda each: row(*each)))  # type: ignore[operator]

    def read_columns(self, found: Any, columns: tuple[Column, ...]) -> tuple[Any, ...]:
        """Each column in SI."""
        names = dict.fromkeys((column.name for column in columns if column.unit), Text().read)
        units, rows = read_keys(
            found,
            units=lambda each: _read_object(each, names, names),
            values=lambda each: _items(each, lambda row: _checked_row(row, columns)),
        )
        cells = list(zip(*rows, strict=True)) or [()] * len(columns)
        problems, read = Problems(), []
        for column, given in zip(columns, cells, strict=True):
            with problems.at():
                read.append(column.read_cells(given, units.get(column.name, "")))
        problems.check()
        return tuple(read)

    def write(self, value: Any, in_si: bool = False) -> Any:
        """The table."""
        columns = self.columns
        if is_dataclass(value) and not isinstance(value, type):
            columns = columns or columns_of(type(value))
            content = list(vars_of(value).values())
        elif self.fields:
            content = value
        else:
            rows = (vars_of(row).values() if is_dataclass(row) else row for row in value)
            content = list(zip(*rows, strict=True)) or [()] * len(columns)
        cells = [
            column.write_cells(values, in_si)
            for column, values in zip(columns, content, strict=True)
        ]
        units = {c.name: c.si if in_si else c.unit for c in columns if c.unit}
        return {"units": units, "values": [list(row) for row in zip(*cells, strict=True)]}

    def words(self, value: Any) -> str:
        """How many rows there are."""
        return str(len(next(iter(vars_of(value).values())) if is_dataclass(value) else value))


def _row_of(kind: Any) -> Any:
    """The type of a table's rows: of ``tuple[Station, ...]`` the Station."""
    return get_args(kind)[0] if get_origin(kind) is tuple else kind


def _checked_row(row: Any, columns: tuple[Column, ...]) -> Any:
    """A row of a table, whose cells belong into its columns."""
    if len(_valid(row, (list,), "list")) > len(columns):
        raise InputError(f"must have at most {counted(len(columns), 'item')}, not {len(row)}")
    problems = Problems()
    for number, column in enumerate(columns):
        try:
            if number >= len(row):
                raise InputError(f"'{number}' is missing", remedy="add it")
            column.check(row[number])
        except InputError as error:
            problems += placed(error, f"[{number}]")
    problems.check()
    return row


@dataclass(frozen=True)
class Array(Form):
    """Numbers with one unit: ``{"unit": "m/s", "values": [[...], ...]}``; an array inside.

    Attributes
    ----------
    si : str
        What it is written in, exactly, and what it holds. Empty: the numbers stand alone, in the
        units of what they belong to.
    dimensions : {1, 2}
    gaps : bool
        Whether values may be missing: ``null`` in the file, NaN inside.
    """

    si: str = "1"
    dimensions: int = 1
    gaps: bool = False

    def read(self, found: Any, kind: Any) -> FloatArray:  # noqa: ARG002
        """The array in SI."""
        if not self.si:
            return self._numbers(found, self.dimensions)
        unit, numbers = read_keys(
            found, unit=Text().read, values=lambda each: self._numbers(each, self.dimensions)
        )
        missing = np.isnan(numbers)
        converted = in_si(np.where(missing, 0.0, numbers), unit, self.si)
        return np.where(missing, np.nan, converted)

    def _numbers(self, found: Any, dimensions: int) -> FloatArray:
        """Finite numbers in a list, or in rows that are as long as each other."""
        if dimensions == 1:
            return np.array(_items(found, Number(gaps=self.gaps).read), dtype=np.float64)
        rows = _items(found, lambda row: self._numbers(row, 1))
        if len({len(row) for row in rows}) > 1:
            raise InputError("rows differ in length", remedy="give as many numbers in each")
        return np.array(rows, dtype=np.float64).reshape(len(rows), -1 if rows else 0)

    def write(self, value: Any, in_si: bool = False) -> Any:  # noqa: ARG002
        """The numbers with their unit."""
        values = np.asarray(value, dtype=np.float64)
        if self.gaps:
            values = np.where(np.isnan(values), None, values.astype(object))  # type: ignore[call-overload]
        written = shortest(values.tolist())
        return {"unit": self.si, "values": written} if self.si else written


def _items(found: Any, read: Callable[[Any], Any], least: int = 0) -> list[Any]:
    """What `read` makes of each item of a list."""
    _valid(found, (list, tuple), "list")
    if len(found) < least:
        raise InputError("has too few entries", remedy=f"give at least {counted(least, 'item')}")
    values, problems = [], Problems()
    for number, each in enumerate(found):
        try:
            values.append(read(each))
        except InputError as error:
            problems += placed(error, f"[{number}]")
    problems.check()
    return values


@dataclass(frozen=True, eq=False)
class Named(Form):
    """Numbers under published names, each a `Quantity`; a dict of float inside."""

    quantities: Mapping[str, Quantity]

    # Types that are annotated with equal forms are one type to Python.
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def read(self, found: Any, kind: Any) -> dict[str, float]:  # noqa: ARG002
        """The numbers that are there."""
        return _read_object(found, {name: each.read for name, each in self.quantities.items()})

    def write(self, value: Any, in_si: bool = False) -> Any:
        """The numbers with their units, in the order in which they are declared."""
        for name in value:
            if name not in self.quantities:
                raise InputError(
                    f"parameter '{name}' is not known, so its unit is not either",
                    remedy=f"known are {', '.join(self.quantities)}",
                )
        return {n: q.write(value[n], in_si) for n, q in self.quantities.items() if n in value}


@dataclass(frozen=True)
class Ends(Form):
    """Two numbers of one unit, the lowest and the highest; a tuple inside."""

    quantity: Quantity

    def read(self, found: Any, kind: Any) -> tuple[float, ...]:  # noqa: ARG002
        """Both."""
        return tuple(read_keys(found, lowest=self.quantity.read, highest=self.quantity.read))

    def write(self, value: Any, in_si: bool = False) -> Any:
        """Both, each with its unit."""
        lowest, highest = (self.quantity.write(each, in_si) for each in value)
        return {"lowest": lowest, "highest": highest}


@dataclass(frozen=True)
class Covariance(Form):
    """A covariance with the units of its rows; an entry's is that of its row times its column."""

    units: tuple[tuple[str, str], ...] = ()
    """Name and SI unit of each row."""

    def read(self, found: Any, kind: Any) -> FloatArray:  # noqa: ARG002
        """The covariance in SI units."""
        names = dict.fromkeys(dict(self.units), Text().read)
        units, rows = read_keys(
            found,
            units=lambda each: _read_object(each, names, names),
            values=lambda each: _items(each, lambda row: _items(row, _number)),
        )
        size = len(names)
        if [len(row) for row in rows] != [size] * size:
            raise InputError(
                f"needs {size} rows of {size} numbers",
                place="values",
                remedy=f"give {size} by {size}",
            )
        with at("units"):
            scale = [factor(units[name], si)[0] for name, si in self.units]
        return np.asarray(rows * np.outer(scale, scale))

    def write(self, value: Any, in_si: bool = False) -> Any:  # noqa: ARG002
        """The covariance and its units."""
        return {"units": dict(self.units), "values": shortest(value.tolist())}


@dataclass(frozen=True)
class Part(Form):
    """A thing within a thing, perhaps written in SI units whatever its own declaration states."""

    in_si: bool = False

    def read(self, found: Any, kind: Any) -> Any:
        """The thing."""
        return found if isinstance(found, kind) else from_content(kind, found)

    def write(self, value: Any, in_si: bool = False) -> Any:
        """What describes it."""
        return content_of(value, in_si or self.in_si)

    def implausible(self, value: Any, place: str) -> Iterator[InputError]:
        """What of the thing cannot be meant."""
        if value is not None:
            for problem in implausible(type(value), vars_of(value)):
                yield placed(problem, place)[0]


@dataclass(frozen=True)
class Many(Form):
    """A list of things of one form.

    Attributes
    ----------
    least : int
        How many there are at least.
    runs : bool
        Whether equal neighbours share an entry, which then has a `count`.
    in_si : bool
        Whether they are written in SI units.
    """

    least: int = 0
    runs: bool = False
    in_si: bool = False

    def read(self, found: Any, kind: Any) -> Any:
        """The things, in the type that holds them."""
        read = _reader(get_args(kind)[0])
        if self.runs:
            runs = _items(found, lambda each: _run(each, read), self.least)
            return tuple(thing for run in runs for thing in run)
        values = _items(found, read, self.least)
        if get_origin(kind) is tuple and get_args(kind)[-1] is not Ellipsis:
            wanted = len(get_args(kind))
            if len(values) != wanted:
                raise InputError(f"has {len(values)} entries", remedy=f"give {wanted}")
        return values if get_origin(kind) is list else tuple(values)

    def write(self, value: Any, in_si: bool = False) -> Any:
        """What describes each of them."""
        if not value or not is_dataclass(value[0]):
            return plain(list(value), self.key)
        in_si = in_si or self.in_si
        written = [form_of(type(each)).write(each, in_si) for each in value]
        if not self.runs:
            return written
        entries = []
        for entry, group in groupby(written):
            count = {"count": len(list(group))}
            name = {"name": entry["name"]} if "name" in entry else {}
            entries.append(name | count | entry)
        return entries

    def words(self, value: Any) -> str:
        """The things, one after the other."""
        return ", ".join(map(str, value))

    def implausible(self, value: Any, place: str) -> Iterator[InputError]:
        """What of the things cannot be meant."""
        for number, each in enumerate(value):
            yield from form_of(type(each)).implausible(each, f"{place}[{number}]")


def _run(found: Any, read: Callable[[Any], Any]) -> list[Any]:
    """So many equal things as the entry of a run counts."""
    rest = dict(_valid(found, (dict,), "dictionary"))
    problems, count = Problems(), 1
    with problems.at("count"):
        count = Form().read(rest.pop("count", 1), int)
        if not 0 < count <= 1000:
            remedy = "give how many there are"
            raise InputError(f"{count} is not between 1 and 1000", remedy=remedy)
    thing = None
    with problems.at():
        thing = read(rest)
    problems.check()
    return [thing] * count


def _reader(hint: Any) -> Callable[[Any], Any]:
    """Reads one of several values of a type, within the bounds of its form."""
    form, kind = form_of(hint), bare(hint)

    def read(found: Any) -> Any:
        value = form.read(found, kind)
        if form.must is not None and (problem := form.refused(value, "", kind)) is not None:
            raise problem
        return value

    return read


@dataclass(frozen=True)
class ByName(Form):
    """Things of one form under names; a dict inside."""

    def read(self, found: Any, kind: Any) -> dict[str, Any]:
        """The things by their names."""
        names = _valid(found, (dict,), "dictionary")
        return _read_object(found, dict.fromkeys(names, _reader(get_args(kind)[1])))

    def write(self, value: Any, in_si: bool = False) -> Any:
        """What describes each of them."""
        return {name: form_of(type(each)).write(each, in_si) for name, each in value.items()}


def _peeled(hint: Any) -> Iterator[Any]:
    """A type, and what is in it when annotations and None are taken off, one by one."""
    yield hint
    if get_origin(hint) is Annotated:
        yield from _peeled(get_args(hint)[0])
    elif get_origin(hint) in (Union, UnionType):
        rest = [each for each in get_args(hint) if each is not NoneType]
        if len(rest) == 1:
            yield from _peeled(rest[0])


def bare(hint: Any) -> Any:
    """A type without annotations and None."""
    return [*_peeled(hint)][-1]


def form_of(hint: Any) -> Form:
    """The form of a type: what an annotation states, else what follows from the type alone."""
    for layer in _peeled(hint):
        for stated in getattr(layer, "__metadata__", ()):
            if isinstance(stated, Form):
                return stated
    kind = bare(hint)
    if is_dataclass(kind):
        return Table() if is_table(kind) else Part()
    origin = get_origin(kind)
    if origin in (tuple, list):
        return Many()
    if isinstance(origin, type) and issubclass(origin, Mapping) and get_args(kind)[1] is not Any:
        return ByName()
    if origin in (Union, UnionType):
        return Either()
    if isinstance(kind, type) and issubclass(kind, datetime.date):
        return Moment()
    return Number() if kind is float else Form()


# ------------------------------------------------------------------ the entries of a thing's file


@dataclass(frozen=True)
class Entry:
    """One key of a thing's file.

    Attributes
    ----------
    key : str
    names : tuple of str
        Of the fields that it describes: one, or those that are columns of one table.
    form : Form
    kind : type
        Of the field, without None.
    default : object
        What holds where the key is left out; MISSING: it may not be.
    """

    key: str
    names: tuple[str, ...]
    form: Form
    kind: Any
    default: Any

    @property
    def required(self) -> bool:
        """Whether the file must have the key."""
        if self.form.stated == "read":
            return False
        return self.default is MISSING or self.form.stated == "required"

    @property
    def always_written(self) -> bool:
        """Whether the key is written where it holds the default, too."""
        return self.default is MISSING or self.form.stated in ("written", "required")


@_once
def entries(kind: type) -> tuple[Entry, ...]:
    """The keys of a thing's file, in their order there."""
    hints = get_type_hints(kind, include_extras=True)
    made: dict[str, Entry] = {}
    for field in fields(kind):
        hint = hints[field.name]
        form = form_of(hint)
        if not field.init:
            continue
        if isinstance(form, Column) and form.table:
            before = made.get(form.table, Entry(form.table, (), Table(fields=True), None, MISSING))
            table = replace(before.form, columns=(*before.form.columns, form))  # type: ignore[attr-defined, call-arg]
            made[form.table] = replace(before, names=(*before.names, field.name), form=table)
            continue
        name = field.name.replace("_", " ") if getattr(kind, "SPACED", False) else field.name
        form = replace(form, key=form.key or name)
        if isinstance(form, Table) and not form.columns:
            form = replace(form, columns=columns_of(_row_of(bare(hint))))
        default = field.default
        if field.default_factory is not MISSING:
            default = field.default_factory()
        if isinstance(form, Number) and form.gaps and default is MISSING:
            default = np.nan
        made[form.key] = Entry(form.key, (field.name,), form, bare(hint), default)
    first = getattr(kind, "ORDER", ())
    return tuple([made[key] for key in first] + [e for k, e in made.items() if k not in first])


@_once
def is_table(kind: type) -> bool:
    """Whether the file of a thing is nothing but a table of its fields."""
    hints = get_type_hints(kind, include_extras=True)
    forms = [form_of(hints[each.name]) for each in fields(kind)]
    return all(isinstance(form, Column) and not form.table for form in forms)


@_once
def columns_of(kind: type) -> tuple[Column, ...]:
    """The columns of a table that has the fields of a dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    made = []
    for field in fields(kind):
        form = form_of(hints[field.name])
        gap = NOT_SET if field.default is None else None
        if isinstance(form, Column):
            made.append(form)
        elif isinstance(form, Quantity):
            made.append(Column(field.name, form.unit, form.si, gap))
        else:
            made.append(Column(field.name))
    return tuple(made)


def form_for(kind: type, name: str) -> Form:
    """The form of a thing's field.

    Examples
    --------
    >>> from trainlog.railway.train import Train
    >>> form_for(Train, "mass").unit
    't'
    """
    return next(entry.form for entry in entries(kind) if name in entry.names)


# ------------------------------------------------------------------ both directions


def from_content(kind: type[Thing], content: Any, judged: bool = False) -> Thing:
    """The thing that a file's content describes.

    Parameters
    ----------
    kind : type
    content : dict
        As JSON and TOML give it, without format and version.
    judged : bool
        Whether values that cannot be meant are refused, too.

    Raises
    ------
    InputError
        That lists all that is wrong, each with its place and the remedy.

    Examples
    --------
    >>> from trainlog.railway.train import Brake
    >>> seconds = {"value": 400, "unit": "ms"}
    >>> from_content(Brake, {"dead_time": {"value": 1, "unit": "s"}, "lag": seconds}).lag
    0.4
    """
    _valid(content, (dict,), "dictionary")
    known = {entry.key: entry for entry in entries(kind)}
    foreign = issubclass(kind, Foreign)
    problems = Problems(_unknown(key, known) for key in content if key not in known and not foreign)
    unknown = len(problems)
    values: dict[str, Any] = {}
    for key, entry in known.items():
        found = content.get(key)
        if key not in content or (found is None and not entry.always_written):
            if entry.required:
                problems.append(_missing(key))
            elif len(entry.names) == 1:
                values.setdefault(entry.names[0], entry.default)
            continue
        with problems.at(key):
            read = entry.form.read(found, entry.kind)
            values.update(zip(entry.names, read if len(entry.names) > 1 else [read], strict=True))
    thing: Any = None
    if len(problems) == unknown:
        # Numbers near the end of the doubles overflow in the checks, which then refuse them.
        with problems.at(), np.errstate(over="ignore", invalid="ignore"):
            thing = kind(**values)
    if judged:
        problems += implausible(kind, values)
    problems.check()
    return thing  # type: ignore[no-any-return]


def content_of(thing: Any, in_si: bool = False) -> dict[str, Any]:
    """What describes a thing in its file, in plain values; `in_si`: in SI units throughout.

    Examples
    --------
    >>> from trainlog.railway.train import Brake
    >>> content_of(Brake(0.5, 0.25))["lag"]
    {'value': 0.25, 'unit': 's'}
    """
    content: dict[str, Any] = {}
    for entry in entries(type(thing)):
        held = [getattr(thing, name) for name in entry.names]
        value = held[0] if len(held) == 1 else held
        if value is None or entry.form.stated == "read":
            continue
        if not entry.always_written and same_values(value, entry.default):
            continue
        written = entry.form.write(value, in_si)
        if written is not None:
            content[entry.key] = written
    return content


# ------------------------------------------------------------------ checks


def implausible(kind: type, values: Mapping[str, Any]) -> list[InputError]:
    """What of a thing's `values` [SI], perhaps not of all its fields, cannot be meant."""
    problems: list[InputError] = []
    sound = dict(values)
    for entry in entries(kind):
        name = entry.names[0]
        if len(entry.names) > 1 or values.get(name) is None:
            continue
        found = list(entry.form.implausible(values[name], entry.key))
        if found:
            sound.pop(name)
        problems += found
    more = getattr(kind, "implausible", None)
    return problems + (list(more(sound)) if more is not None else [])


def check_plausible(thing: Any) -> None:
    """Refuse a thing that cannot be meant; fields that are assumed are not judged.

    Raises
    ------
    InputError
        That lists each field with its value, what is plausible, and the likely cause.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> check_plausible(train)
    >>> check_plausible(replace(train, mass=122.0, max_load=0.0))  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: mass: 0.122 t is not plausible: trains have 5 to 20000 t; were t...
    """
    assumed = getattr(thing, "assumed", ())
    Problems(
        problem
        for problem in implausible(type(thing), vars_of(thing))
        if str(problem.place).partition(".")[0] not in assumed
    ).check()


def vars_of(thing: Any) -> dict[str, Any]:
    """The values of a thing by the names of its fields."""
    return {each.name: getattr(thing, each.name) for each in fields(thing)}


def check(thing: Any) -> None:
    """Refuse a thing with fields beyond what they must be, or with what its `problems` state.

    Raises
    ------
    InputError
        That lists all of it.

    Examples
    --------
    >>> from trainlog.railway.train import Brake
    >>> Brake(dead_time=-1.0)
    Traceback (most recent call last):
    trainlog.errors.InputError: dead_time: -1 s is negative; give 0 or more
    """
    more = getattr(thing, "problems", None)
    Problems([*_beyond(thing), *(more() if more is not None else ())]).check()


class Declared(Presented):
    """What every declared thing has: checks when it is made, equality, and a summary.

    A class adds what its bounds do not say in `problems`, what cannot be meant in a class method
    `implausible`, and its title in `title`.
    """

    __slots__ = ()

    FORMAT: ClassVar[str] = ""
    """Of its file, such as ``"trainlog/train"``; empty: it is only a part of others."""

    VERSION: ClassVar[int] = 1
    """The newest version of the file that is read; all older ones are, too."""

    SPACED: ClassVar[bool] = False
    """Whether keys have spaces where names have underscores."""

    ORDER: ClassVar[tuple[str, ...]] = ()
    """Keys that come first in the file; the others follow in the order of the fields."""

    def __post_init__(self) -> None:
        hold_arrays(self)
        check(self)

    @property
    def version_needed(self) -> int:
        """The oldest version in which all that the file states is known; it is written."""
        return 1

    def problems(self) -> Iterator[InputError]:
        """What the thing cannot be, one by one."""
        yield from ()

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and all(
            same_values(value, getattr(other, name)) for name, value in vars_of(self).items()
        )

    def __hash__(self) -> int:  # type: ignore[override]
        held = vars_of(self).values()
        return hash(tuple(x.tobytes() if isinstance(x, np.ndarray) else x for x in held))

    @property
    def title(self) -> str:
        """What the thing is, in one line."""
        name = getattr(self, "name", "")
        return f"{type(self).__name__} '{name}'" if name else type(self).__name__

    def summary(self) -> dict[str, str]:
        """The rows of the summary."""
        return summary_of(self)


@dataclass_transform(kw_only_default=True, frozen_default=True, eq_default=False)
class Foreign(Declared):
    """An object in a file of another project; keys that are not known are passed over.

    Its classes are dataclasses as they stand.

    Examples
    --------
    >>> class Wagon(Foreign):
    ...     length: Annotated[float, Number(must=POSITIVE)]
    >>> from_content(Wagon, {"length": 14.0, "colour": "green"}).length
    14.0
    """

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        dataclass(frozen=True, kw_only=True, eq=False, repr=False)(cls)


Name = Annotated[str, Text(least=1)]
Positive = Annotated[float, Number(must=POSITIVE)]
PositiveFinite = Annotated[float, Number(must=POSITIVE_FINITE)]
NotNegative = Annotated[float, Number(must=NOT_NEGATIVE)]


def hold_arrays(thing: Any) -> None:
    """Turn what is given for the arrays of a thing into arrays.

    Raises
    ------
    InputError
        If it is not numbers.
    """
    for name, kind in _arrays_of(type(thing)):
        try:
            values: Any = np.ascontiguousarray(getattr(thing, name), dtype=kind)
        except (TypeError, ValueError):
            raise InputError(
                f"{type(thing).__name__}: {name} must be numbers",
                remedy="replace what is not a number",
            ) from None
        object.__setattr__(thing, name, values)


@_once
def _arrays_of(kind: type) -> tuple[tuple[str, type], ...]:
    """The fields that are arrays of numbers, each with the type of these."""
    hints, known = get_type_hints(kind), {FloatArray: np.float64, IntArray: np.int64}
    return tuple((e.name, known[hints[e.name]]) for e in fields(kind) if hints[e.name] in known)


def _beyond(thing: Any) -> list[InputError]:
    """Fields whose values are beyond what they must be."""
    found = []
    for entry in _bounded(type(thing)):
        name = entry.names[0]
        problem = entry.form.refused(getattr(thing, name), entry.key, entry.kind)
        if problem is not None:
            found.append((name, problem))
    # What is assumed follows from what is given.
    assumed = getattr(thing, "assumed", ())
    return [problem for name, problem in found if name not in assumed] or [p for _, p in found]


@_once
def _bounded(kind: type) -> tuple[Entry, ...]:
    """The fields that have bounds, or are one of some words."""
    return tuple(
        entry
        for entry in entries(kind)
        if len(entry.names) == 1
        and (entry.form.must is not None or get_origin(entry.kind) is Literal)
    )


# ------------------------------------------------------------------ what is shown, and templates


def summary_of(thing: Any) -> dict[str, str]:
    """Rows of what a thing's fields declare to be shown, those of one row together.

    Examples
    --------
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> summary_of(train)["mass"]
    '122 t empty, 25 t load at most'
    """
    rows: dict[str, list[str]] = {}
    for entry in entries(type(thing)):
        row, _, words = entry.form.shown.partition(": ")
        value = getattr(thing, entry.names[0])
        if row and not (
            value is None or (same_values(value, entry.default) and not entry.always_written)
        ):
            rows.setdefault(row, []).append((words or "{}").format(entry.form.words(value)))
    return {row: ", ".join(words) for row, words in rows.items()}


@_once
def meanings(kind: type) -> dict[str, str]:
    """The sentence on each field of a dataclass, from its docstring.

    Examples
    --------
    >>> from trainlog.railway.train import AxleGeometry
    >>> meanings(AxleGeometry)["wheelbase"]
    'Between the first and the last axle of a bogie.'
    """
    found: dict[str, str] = {}
    _, _, section = inspect.getdoc(kind).partition("Attributes\n----------\n")  # type: ignore[union-attr]
    section = re.split(r"\n\n\w+\n-{3,}\n", section)[0]
    for names, words in re.findall(r"^(\S.*?) : .*\n((?:    .*\n?)*)", section + "\n", re.M):
        text = " ".join(words.split()).replace("`", "").replace("``", "")
        found |= dict.fromkeys(names.split(", "), text)
    return found


def example(kind: type[Thing]) -> Thing:
    """A thing with the usual values of its fields."""
    usual = {
        entry.names[0]: entry.form.usual
        for entry in entries(kind)
        if entry.form.usual is not None and not _beside(entry)
    }
    return kind(**usual)


def content_beside(kind: type) -> dict[str, Any]:
    """What a template offers besides: the usual values of tables that may be left out."""
    return {
        entry.key: entry.form.write(entry.form.usual)
        for entry in entries(kind)
        if entry.form.usual is not None and _beside(entry)
    }


def _beside(entry: Entry) -> bool:
    """Whether a template offers a key at its end: tables that may be left out."""
    return not entry.always_written and isinstance(entry.form, (Table, Part))


# ------------------------------------------------------------------ numbers as files have them


def declared(values: ArrayLike, unit: str, si: str) -> Any:
    """SI values in a file's unit, as plain numbers that read back as they were."""
    slope, offset = factor(unit, si)
    numbers = np.asarray(values, dtype=np.float64)
    if (slope, offset) == (1.0, 0.0):
        return shortest(numbers.tolist())
    written = readable(numbers, (numbers - offset) / slope, lambda x: to_si(x, unit, si))
    return shortest(written.tolist())


def readable(
    values: FloatArray, converted: FloatArray, read: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """`converted` with as few digits, from 12 on, as `read` needs to return `values` exactly.

    Where no double reads back exactly it has 14 digits, which read and write to themselves.
    """
    written = _rounded(converted, 14)
    exact = np.zeros(values.shape, dtype=np.bool_)
    for digits in (12, 14, 15, 16, 17):
        candidate = _rounded(converted, digits)
        found = ~exact & (read(candidate) == values)
        written = np.where(found, candidate, written)
        exact |= found
        if np.all(exact):
            break
    return written


def _rounded(values: FloatArray, digits: int) -> FloatArray:
    return np.array([float(f"{x:.{digits}g}") for x in values.ravel()]).reshape(values.shape)


def plain(value: Any, place: str = "") -> Any:
    """`value` in JSON's own types: numpy scalars and arrays, tuples and the like replaced.

    Raises
    ------
    InputError
        If it cannot be said in JSON; names the key.

    Examples
    --------
    >>> plain({"mass": np.float64(2.0), "speeds": np.arange(2)})
    {'mass': 2.0, 'speeds': [0, 1]}
    """
    if isinstance(value, dict):
        return {str(key): plain(item, f"{place}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, f"{place}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist(), place)
    if isinstance(value, float) and not np.isfinite(value):
        raise InputError(
            f"{place.lstrip('.') or 'value'}: {value} cannot be written to a file",
            remedy="give a finite number",
        )
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise InputError(
        f"{place.lstrip('.') or 'value'}: a {type(value).__name__} cannot be written to a file",
        remedy="give numbers, text, lists or dicts",
    )


def shortest(values: Any) -> Any:
    """Floats that are whole numbers as integers, which read back as the same doubles."""
    if isinstance(values, list | tuple):
        return [shortest(value) for value in values]
    whole = isinstance(values, float) and values.is_integer() and abs(values) < 2**53
    # Minus zero has no integer.
    return int(values) if whole and not (values == 0 and np.signbit(values)) else values

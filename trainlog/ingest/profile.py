"""The profile: a TOML file that says how a recorder writes, and how its columns become topics.

The profiles in the folder ``profiles`` beside this module are formats of their own: their files are
recognised and need no profile; see `trainlog.ingest.registry`.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal, dataclass_transform

import numpy as np

from trainlog.declaration import (
    NOT_NEGATIVE,
    POSITIVE,
    ByName,
    Declared,
    Form,
    Must,
    Number,
    Text,
    form_for,
    from_content,
)
from trainlog.errors import InputError, suggestion
from trainlog.formats.declared import parse_toml
from trainlog.formats.files import read_bytes
from trainlog.ingest.recording import base_name, field_of
from trainlog.railway.train import Train
from trainlog.railway.weather import given_condition
from trainlog.spans import zone_of
from trainlog.topics import RECORDED, TOPICS, Bounds, Field as Item, Topic, recorded_topic
from trainlog.units import factor, si_unit, to_si


@dataclass_transform(kw_only_default=True, frozen_default=True)
class Strict(Declared):
    """A part of a profile; its classes are dataclasses as they stand."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        dataclass(frozen=True, kw_only=True)(cls)

    def problems(self) -> Iterator[InputError]:
        """What is wrong with the part beside the types and bounds of its values."""
        yield from (_split(problem) for problem in self.wrong() if problem is not None)

    def wrong(self) -> Iterator[str | None]:
        """The same in words, each with its remedy after a semicolon; None is no problem."""
        yield None


def problem_of(check: Callable[..., object], *given: object) -> str | None:
    """What `check` finds wrong, if anything."""
    try:
        check(*given)
    except (ValueError, InputError) as error:
        return str(error)
    return None


class MismatchError(InputError):
    """A file lacks what its profile names: one of the two has to be corrected."""


def known_field(name: str) -> Item:
    """The field that ``"/topic.field"`` names; ValueError with close matches if there is none."""
    topic_name, _, column = name.rpartition(".")
    if topic_name not in TOPICS:
        every = [f"{topic.name}.{item.name}" for topic in TOPICS.values() for item in topic.fields]
        raise ValueError(f"unknown field '{name}'; {suggestion(name, every)}")
    fields = {item.name: item for item in TOPICS[topic_name].fields}
    if column not in fields:
        raise ValueError(
            f"topic {topic_name} has no field '{column}'; {suggestion(column, fields)}"
        )
    return fields[column]


def check_unit(name: str, unit: str, si: str) -> None:
    """Refuse a unit of `name` that is not known, or not of the kind of the SI unit `si`."""
    try:
        factor(unit, si)
    except InputError as error:
        raise ValueError(f"{name}: {error.problem}; {error.remedy}") from None


@dataclass(frozen=True)
class _Condition(Form):
    """A rail's condition; one that is not known is refused."""

    def read(self, found: Any, kind: Any = str) -> str:  # noqa: ARG002
        """The condition."""
        return given_condition(super().read(found, str))


Condition = Annotated[str, _Condition()]

Level = Annotated[float, Number(infinite=True)]
Extent = Annotated[float, Number(infinite=True, must=NOT_NEGATIVE)]
Rate = Annotated[float, Number(infinite=True, must=POSITIVE)]
"""Thresholds, which an infinite number switches off."""

Count = Annotated[int, Form(must=POSITIVE)]
Place = Annotated[int, Form(must=NOT_NEGATIVE)]
Mark = Annotated[str, Text(most=1)]

_OCTETS = Must("is not between 1 and 65535", "give a whole number between them", 1.0, 65_535.0)
_PART = Must("is not above 0 and at most 1", "give it in seconds", high=1.0, above=True)


class Quantity(Strict):
    """A number with its unit."""

    value: float
    unit: str

    def si(self, unit: str) -> float:
        """The number in the SI unit `unit`."""
        return float(to_si(self.value, self.unit, unit))


WITH_UNITS = ("mdf",)
"""Formats whose files give the units of their columns."""

WORDS = ("/events.message", "/events.name")
"""Fields that hold text."""


class Column(Strict):
    """How a field of our topics comes from columns of the file ([columns]).

    ``field = sign * part(raw * scale + offset)``, in `unit`, then converted to SI.

    Attributes
    ----------
    column : str
        Name of the column; `columns` for the fields that have one value an axle, ``""`` for an
        axle that is not recorded; or a constant `value`.
    unit : str
        Unit of the number after `scale` and `offset`.
    scale, offset : float
    integer_scale : float, optional
        In place of `scale` where the file's column holds whole numbers only.
    part : {"all", "positive", "negative"}
        Of a signed column, only the positive values, or the size of the negative ones; 0 otherwise.
    sign : {1, -1}
    optional : bool
        Whether the file may lack the column.
    meaning : str
        What the quantity is, for a field of a topic of the recorder's own (``"/recorded/..."``).
    between : {"linear", "previous"}
        How its values between two samples are found.
    notation : {"number", "degrees_minutes"}
        How the raw number is written; ``"degrees_minutes"``: as NMEA writes angles, 4728.513 for
        47 degrees and 28.513 minutes.
    unproven : bool
        Whether nothing proves the unit that is stated: trips list such fields.
    slip_protection : list of str
        Of ``"/events.message"``: words by which the recorder reports that slip protection acts, in
        any case; events that hold one are named ``"slip protection"``.
    """

    column: str | None = None
    columns: tuple[str, ...] = ()
    value: float | str | None = None
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    integer_scale: float | None = None
    part: Literal["all", "positive", "negative"] = "all"
    sign: Literal[1, -1] = 1
    optional: bool = False
    meaning: str = ""
    between: Literal["linear", "previous"] = "linear"
    notation: Literal["number", "degrees_minutes"] = "number"
    unproven: bool = False
    slip_protection: tuple[str, ...] = ()

    def field(self, name: str) -> Item:
        """The field of the topics that it fills, as the table or, of the recorder's own, it states.

        Raises
        ------
        InputError
            If it names a topic of the recorder's own wrongly, or its unit is not known.
        KeyError
            If the table has no such field.
        """
        if not name.startswith(RECORDED):
            return field_of(name)[2]
        own = Item(name.rpartition(".")[2], si_unit(self.unit or "1"), self.meaning, self.between)
        return recorded_topic(name.rpartition(".")[0], [own]).fields[0]

    @property
    def names(self) -> tuple[str, ...]:
        """The columns of the file, one an axle where the field has one value an axle."""
        return tuple(name for name in self.sources if name)

    @property
    def sources(self) -> tuple[str, ...]:
        """The same by axle, front first, with ``""`` for an axle that is not recorded."""
        return self.columns if self.column is None else (self.column,)


class Payload(Strict):
    """What the lines of a kind hold.

    Attributes
    ----------
    type : str
        ``"ubx"``: a message of a u-blox receiver; ``"nmea"``: an NMEA sentence; or a numpy type of
        numbers, such as ``"<i2"``.
    count : int
        How many numbers there are in a line.
    """

    type: str
    count: Count = 1

    @property
    def dtype(self) -> np.dtype[Any] | None:
        """The type of the numbers; None if there are none."""
        return None if self.type in ("ubx", "nmea") else np.dtype(self.type)

    def wrong(self) -> Iterator[str | None]:
        """A type that numpy does not know, or that holds no numbers."""
        try:
            known = self.dtype is None or self.dtype.kind in "iuf"
        except TypeError:
            known = False
        if not known:
            yield f"type '{self.type}' must be 'ubx', 'nmea' or numbers of numpy; for example '<i2'"


class LineOptions(Strict):
    """Lines of several kinds ([lines], format ``"tagged"``).

    Attributes
    ----------
    kind : str
        Column that says of which kind a line is.
    payload : str
        Column that holds the data, in hexadecimal digits.
    kinds : dict of str to Payload
        What the payload of each kind is; numbers are the columns ``"KIND.1"``, ``"KIND.2"`` ... of
        [columns].
    """

    kind: str
    payload: str
    kinds: dict[str, Payload]


ARRIVAL = "arrival"
"""Column of telegrams with the time at which a datagram arrived [ns since 1970 UTC]."""

NUMBER_TYPES = (
    "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64",
)  # fmt: skip
"""Types of the numbers in telegrams."""

ByteOrder = Literal["little", "big"]
Decimal = Literal[".", ","]


class TelegramField(Strict):
    """A number, or several of one type behind each other, in a telegram.

    Its unit, scale and sign are those of the column ([columns]) that uses it.

    Attributes
    ----------
    offset : int
        Where it begins [bytes].
    type : str
        One of `NUMBER_TYPES`.
    count : int
        How many there are; several are the columns ``"NAME.1"``, ``"NAME.2"`` ...
    byte_order : {"little", "big"}, optional
        In place of the telegram's.
    bit : int, optional
        The lowest bit that is used, counted from 0; default: the whole number.
    bits : int
        How many bits are used from there.
    words : dict of str to str
        The word that each number stands for; for another number there is no value.
    missing : list of float
        Numbers that mean "no value".
    """

    offset: Place
    type: str
    count: Count = 1
    byte_order: ByteOrder | None = None
    bit: Place | None = None
    bits: Count = 1
    words: dict[str, str] = field(default_factory=dict)
    missing: tuple[float, ...] = ()

    def wrong(self) -> Iterator[str | None]:
        """A type that is not known, or that does not have the bits."""
        if self.type not in NUMBER_TYPES:
            yield f"type '{self.type}' is not known; {suggestion(self.type, NUMBER_TYPES)}"
        elif self.bit is not None and self.type.startswith("float"):
            yield "bit is for whole numbers; give a type such as uint16"
        elif self.bit is not None and self.bit + self.bits > 8 * self.dtype("little").itemsize:
            yield f"type {self.type} has no bit {self.bit + self.bits - 1}"

    def dtype(self, byte_order: ByteOrder) -> np.dtype[Any]:
        """The type of its numbers, in a telegram of that byte order."""
        return np.dtype(self.type).newbyteorder(self.byte_order or byte_order)


class TelegramOptions(Strict):
    """Records of a fixed layout ([telegram], format ``"telegrams"``).

    Attributes
    ----------
    length : int
        Of a telegram [bytes].
    byte_order : {"little", "big"}
    mark : str
        What each telegram begins with, in hexadecimal digits: by it a file in which octets are
        missing is read on.
    port : int, optional
        UDP port of a capture whose datagrams are used; default: of all ports.
    where : dict of str to float
        Numbers that fields must have: telegrams of other kinds are counted and left out.
    fields : dict of str to TelegramField
    """

    length: Annotated[int, Form(must=_OCTETS)]
    byte_order: ByteOrder = "little"
    mark: str = ""
    port: Annotated[int | None, Form(must=_OCTETS)] = None
    where: dict[str, float] = field(default_factory=dict)
    fields: dict[str, TelegramField]

    @property
    def mark_bytes(self) -> bytes:
        """The mark as octets."""
        return bytes.fromhex(self.mark)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns that the fields make, in the order of the profile."""
        return tuple(
            name if field.count == 1 else f"{name}.{place}"
            for name, field in self.fields.items()
            for place in range(1, field.count + 1)
        )

    def field_called(self, column: str) -> tuple[TelegramField, int]:
        """The field of a column, and its place among those of the field, from 0."""
        if column in self.fields:
            return self.fields[column], 0
        name, _, place = column.rpartition(".")
        return self.fields[name], int(place) - 1

    def wrong(self) -> Iterator[str | None]:
        """Fields beyond the telegram, and names and a mark that mean nothing."""
        for name, each in self.fields.items():
            end = each.offset + each.count * each.dtype("little").itemsize
            if end > self.length:
                yield f"field '{name}' ends at byte {end}; the telegram has {self.length}"
        for name in [name for name in self.where if name not in self.fields]:
            yield f"where: no field '{name}'; {suggestion(name, self.fields)}"
        if problem_of(bytes.fromhex, self.mark) is not None:
            yield f"mark '{self.mark}' must be hexadecimal digits; for example 'a55a'"


def column_item(name: str, column: Column) -> Item:
    """The field that a column fills; ValueError if there is none."""
    if not name.startswith(RECORDED):
        if column.meaning or column.between != "linear":
            raise ValueError(
                f'columns."{name}": meaning and between are for topics below {RECORDED};'
                " the table of topics has those of its own"
            )
        return known_field(name)
    try:
        return column.field(name)
    except InputError as error:
        raise ValueError(f'columns."{name}": {error.problem}; {error.remedy}') from None


def own_topics(columns: Mapping[str, Column]) -> dict[str, Topic]:
    """The recorder's own topics that the columns of a profile fill, by name."""
    fields: dict[str, list[Item]] = {}
    for name, column in columns.items():
        if name.startswith(RECORDED):
            fields.setdefault(name.rpartition(".")[0], []).append(column.field(name))
    return {name: recorded_topic(name, items) for name, items in fields.items()}


def _check_column(name: str, column: Column, needs_unit: bool) -> None:
    item = column_item(name, column)
    given = [column.column is not None, bool(column.columns), column.value is not None]
    if sum(given) != 1:
        raise ValueError(f'columns."{name}" needs one of column, columns and value')
    if column.value is None and item.per_axle != bool(column.columns):
        kind = "columns, one an axle" if item.per_axle else "one column"
        raise ValueError(f'columns."{name}" needs {kind}')
    if column.value is None and not column.names:
        raise ValueError(f'columns."{name}" names no column')
    if "" in column.sources and not needs_unit:
        raise ValueError(f'columns."{name}": every axle of this format needs a channel')
    if column.slip_protection and name != "/events.message":
        raise ValueError(f'columns."{name}": slip_protection is for "/events.message"')
    if isinstance(column.value, str) != (name in WORDS) and column.value is not None:
        raise ValueError(f'columns."{name}" needs a {"text" if name in WORDS else "number"}')
    if item.unit:
        unit = column.unit if column.unit is not None or item.unit != "1" else "1"
        if unit is None and not needs_unit and column.value is None:
            return
        if unit is None:
            raise ValueError(f"columns.\"{name}\" needs a unit; for example unit = '{item.unit}'")
        check_unit(f'columns."{name}"', unit, item.unit)
    elif column.unit:
        raise ValueError(f'columns."{name}" has no unit')


def column_problems(
    columns: dict[str, Column],
    format: str | None,
    lines: LineOptions | None = None,
    telegram: TelegramOptions | None = None,
) -> Iterator[str | None]:
    """What is wrong with each of the columns; None is no problem."""
    for name, column in columns.items():
        yield problem_of(_check_column, name, column, format not in WITH_UNITS)
        known = (*telegram.columns, ARRIVAL) if telegram is not None else column.names
        for source in [source for source in column.names if source not in known]:
            remedy = suggestion(source, known)
            yield f"columns.\"{name}\": no field '{source}' of the telegram; {remedy}"
    if lines is not None:
        yield problem_of(_check_lines, lines, columns)


def _check_lines(lines: LineOptions, columns: dict[str, Column]) -> None:
    """Refuse columns that no kind of line has, and topics whose columns are of two kinds."""
    counts = {kind: payload.count for kind, payload in lines.kinds.items() if payload.dtype}
    known = {f"{kind}.{n}": kind for kind, count in counts.items() for n in range(1, count + 1)}
    owners: dict[str, str] = {}
    for name, column in columns.items():
        for source in column.names:
            if source not in known:
                raise ValueError(f"columns.\"{name}\": no '{source}'; {suggestion(source, known)}")
            topic = name.rpartition(".")[0]
            if owners.setdefault(topic, known[source]) != known[source]:
                raise ValueError(f'columns."{name}": the fields of a topic must be of one kind')


_PLAUSIBLE = {"load": "max_load", "mass": "mass"}
"""What a trip can state of the train, and the field of the train that bounds it."""

MISSING = ("", "nan", "NaN", "NAN", "NA", "N/A", "n/a", "null", "NULL", "None", "-", "--", "---")
"""Cells that mean "no value" unless the profile lists others."""


class Detection(Strict):
    """By what a file of this layout is recognised ([detect]); all that is given must hold.

    Attributes
    ----------
    columns : list of str
        Names that the header holds, in any order; those of `FileOptions.aliases` in any spelling.
    line : str, optional
        Regular expression that the first line matches.
    """

    columns: tuple[str, ...] = ()
    line: str | None = None

    def wrong(self) -> Iterator[str | None]:
        """Nothing to recognise a file by."""
        if not self.columns and self.line is None:
            yield "needs columns or line"
        try:
            re.compile(self.line or "")
        except re.error as error:
            yield f"line is not a regular expression: {error}"


class FileOptions(Strict):
    """How the file is written ([file]).

    Attributes
    ----------
    format : str, optional
        Name of the registered format, such as ``"csv"``; detected if absent.
    delimiter, decimal, encoding : str
    thousands : str
        Mark between groups of three digits, as in 1,234.5; none if empty.
    header : int, optional
        Line that holds the names of the columns, counted from 1; 0 if there is none, the columns
        are then called "1", "2" ... Default: the first line that is neither empty nor a comment.
    skip_after_header : int
        Lines after the header that hold no data, such as a line of units.
    comment : str
        First character of lines to be passed over; none if empty.
    missing : list of str
        Cells that mean "no value".
    aliases : dict of str to list of str
        What recorders call a column, in lower case, by the name that the profile uses for it.
    """

    format: str | None = None
    delimiter: Annotated[str, Text(least=1, most=1)] = ","
    decimal: Decimal = "."
    thousands: Mark = ""
    encoding: str = "utf-8"
    header: Place | None = None
    skip_after_header: Place = 0
    comment: Mark = "#"
    missing: tuple[str, ...] = MISSING
    aliases: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def wrong(self) -> Iterator[str | None]:
        """Cells that cannot be parted, and an encoding that is not known."""
        if self.delimiter == self.decimal:
            yield f"delimiter and decimal are both '{self.decimal}'"
        if self.thousands == self.decimal:
            yield f"thousands and decimal are both '{self.decimal}'"
        try:
            "".encode(self.encoding)
        except LookupError:
            yield f"encoding '{self.encoding}' is not known, for example 'utf-8' or 'cp1252'"

    def named(self, names: Iterable[str]) -> tuple[str, ...]:
        """The names of a header's columns, those with aliases as the profile calls them."""
        found: list[str] = []
        for name in names:
            plain = name.lower()
            meant = (ours for ours, spellings in self.aliases.items() if plain in spellings)
            ours = next(meant, name)
            # Of two columns that mean the same the first counts.
            found.append(ours if ours not in self.aliases or ours not in found else f"{name} again")
        return tuple(found)


class TimeOptions(Strict):
    """Where the time of a row stands ([time]).

    Attributes
    ----------
    column : str
    columns : list of str
        Either one column, or several: joined by a blank and read with `format`, or, with
        ``format = "parts"``, year, month, day, hour, minute, second as numbers.
    format : str
        ``"iso"``, ``"epoch"`` (since 1970 UTC), ``"elapsed"`` (since `start`: a number, or text
        such as ``1:02:03.456``), ``"parts"``, or a pattern such as ``"%d.%m.%Y %H:%M:%S.%f"``.
    unit : {"s", "ms", "us", "ns"}
        Of ``"epoch"`` and ``"elapsed"``.
    fraction : float, optional
        Of ``"epoch"`` in two columns, whole seconds and what is beyond them: how many seconds one
        of the second column is, such as 0.01.
    timezone : str
        Of times that name no offset: ``"UTC"``, ``"Europe/Zurich"``, ``"+02:00"``.
    assumed_timezone : str
        The zone that was proposed because the file states none. Trips state that it was assumed,
        as long as it is `timezone`.
    start : datetime or "messages"
        Instant of elapsed time 0; ``"messages"``: as the receiver's messages of the same file give
        it (format ``"tagged"``).
    date : date
        For patterns that hold the time of day only: the day of the first row. Midnight is noticed.
    """

    column: str | None = None
    columns: tuple[str, ...] = ()
    format: str = "iso"
    unit: Literal["s", "ms", "us", "ns"] = "s"
    fraction: Annotated[float | None, Number(must=_PART)] = None
    timezone: str = "UTC"
    assumed_timezone: str | None = None
    start: datetime.datetime | Literal["messages"] | None = None
    date: datetime.date | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The columns that make the time."""
        return self.columns if self.column is None else (self.column,)

    def wrong(self) -> Iterator[str | None]:
        """Keys that do not go together, and a zone that is not known."""
        form, count = self.format, len(self.names)
        patterned = form not in ("iso", "epoch", "elapsed", "parts")
        if (self.column is None) == (not self.columns):
            yield "needs either column or columns"
        if form == "parts" and count != 6:
            yield "format 'parts' needs 6 columns: year month day hour minute second"
        if form in ("epoch", "elapsed") and count > 1 and self.fraction is None:
            yield f"format '{form}' needs one column"
        if self.fraction is not None and (form != "epoch" or count != 2):
            yield "fraction is for format 'epoch' with two columns"
        if (form == "elapsed") != (self.start is not None):
            yield "format 'elapsed' and start = ... go together"
        if patterned and "%" not in form:
            yield (
                f"format '{form}' is not one of 'iso', 'epoch', 'elapsed', 'parts' and no"
                " pattern such as '%d.%m.%Y %H:%M:%S'"
            )
        if self.date is not None and not (patterned and "%d" not in form):
            yield "date is for a pattern that holds the time of day only"
        yield problem_of(zone_of, self.timezone)


class RideOptions(Strict):
    """A table of rides that cuts the fixes of several devices into trips ([rides]).

    Attributes
    ----------
    fixes, table : str
        Names of the two files, which stand in one folder.
    device : str
        Column of both that says whose row it is.
    begin, end : str
        Columns of a ride's begin and end, times in the zone of [time].
    name : list of str
        Columns that name the ride.
    only : dict of str to list of str
        Rides that are used: those with one of these words in that column.
    selection : str
        What `only` selects, in words, for the report.
    least_movement : Quantity, optional
        Distance between the furthest fixes below which the device did not move.
    metadata : dict of str to str
        Columns that become metadata of the trip; those under `only` in lower case.
    """

    fixes: str
    table: str
    device: str
    begin: str
    end: str
    name: tuple[str, ...] = ()
    only: dict[str, tuple[str, ...]] = field(default_factory=dict)
    selection: str = ""
    least_movement: Quantity | None = None
    metadata: dict[str, str] = field(default_factory=dict)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the table of rides that are used."""
        used = (self.device, *self.only, *self.name, self.begin, self.end, *self.metadata.values())
        return tuple(dict.fromkeys(used))

    def wrong(self) -> Iterator[str | None]:
        """A unit that is not one of length."""
        if self.least_movement is not None:
            yield problem_of(check_unit, "least_movement", self.least_movement.unit, "m")


class LoadColumn(Strict):
    """A column that holds the load of the trip, and its unit."""

    column: str
    unit: str

    def wrong(self) -> Iterator[str | None]:
        """A unit that is not one of mass."""
        yield problem_of(check_unit, "load", self.unit, "kg")


class WeatherColumn(Strict):
    """A column that holds the rail's condition.

    Attributes
    ----------
    column : str
    words : dict of str to str
        The condition, such as ``"dry"``, that each of the file's words means; others must be known
        conditions, or are not used.
    """

    column: str
    words: dict[str, Condition] = field(default_factory=dict)


class TripColumns(Strict):
    """Columns that state what holds for a trip ([trip.columns]).

    Attributes
    ----------
    number : str, optional
        Column that numbers the trips: each block of rows of one number is a trip of its own.
    load : LoadColumn, optional
    weather : WeatherColumn, optional
    line : str, optional
        Column with the number of the line that the position of a row is the kilometre of; for
        recordings on a network.
    stations : str, optional
        Column that names the stations of the trip's route one after the other, an empty cell being
        the one before; for recordings on a network.
    """

    number: str | None = None
    load: LoadColumn | None = None
    weather: WeatherColumn | None = None
    line: str | None = None
    stations: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The columns of the file that are needed."""
        found = (
            self.number,
            self.load and self.load.column,
            self.weather and self.weather.column,
            self.line,
            self.stations,
        )
        return tuple(dict.fromkeys(name for name in found if name))


class TripOptions(Strict):
    """What holds for the whole trip ([trip]).

    Attributes
    ----------
    name, train, line, clock : str, optional
    direction : {"forward", "reverse"}, optional
        Along the line as its file gives it.
    weather : str, optional
        The rail's condition, such as ``"dry"``, ``"wet"`` or ``"leaves"``; ``"new:grease"`` for one
        that is not known yet.
    load, mass : Quantity, optional
        Load, or mass of the loaded train without the rotating part (needs the train).
    start_position : Quantity or "stations", optional
        Where the first row's position is; the recorded one then counts from an arbitrary 0.
        ``"stations"``: where the stops lie at stations of the line that is given.
    columns : TripColumns
        Columns that state facts of each trip.
    """

    name: str | None = None
    train: str | None = None
    line: str | None = None
    clock: str | None = None
    direction: Literal["forward", "reverse"] | None = None
    weather: Condition | None = None
    load: Quantity | None = None
    mass: Quantity | None = None
    start_position: Quantity | Literal["stations"] | None = None
    columns: TripColumns = TripColumns()

    def wrong(self) -> Iterator[str | None]:
        """Units of another kind, values that no train has, and two that state the same."""
        for name, unit in (("load", "kg"), ("mass", "kg"), ("start_position", "m")):
            quantity: Quantity | Literal["stations"] | None = getattr(self, name)
            if not isinstance(quantity, Quantity):
                continue
            wrong = problem_of(check_unit, name, quantity.unit, unit)
            yield wrong
            if wrong is None and name in _PLAUSIBLE:
                form = form_for(Train, _PLAUSIBLE[name])
                yield from map(str, form.implausible(quantity.si(unit), name))
        if self.load is not None and self.mass is not None:
            yield "give load or mass, not both"


class Limit(Strict):
    """What a field can be: bounds, and how fast it can change (`unit`; `rate` in `unit`/s).

    The table of topics has the same in SI: `trainlog.topics.Bounds`.
    """

    unit: str
    min: Level | None = None
    max: Level | None = None
    rate: Rate | None = None
    tolerance: Extent | None = None

    def bounds(self, si: str) -> Bounds:
        """The same in the SI unit."""
        slope, offset = factor(self.unit, si or "1")
        return Bounds(
            -math.inf if self.min is None else self.min * slope + offset,
            math.inf if self.max is None else self.max * slope + offset,
            math.inf if self.rate is None else self.rate * slope,
            (self.tolerance or 0.0) * slope,
        )


class Limits(Strict):
    """Thresholds of the rules ([limits]).

    Attributes
    ----------
    sort_within : float [s]
        Rows out of order by no more than this are sorted in, others dropped.
    pause : float [s]
        A pause beyond it, without rows or at standstill, parts two trips.
    gap : float [s], optional
        Time between two rows that counts as a gap; default five usual steps, at least 1 s.
    not_before : date, optional
        Day before which this recorder did not exist: earlier dates are 1024 weeks off, or twice.
    columns : dict of str to Limit
        By ``"/topic.field"``, in place of the bounds in the table of topics.
    """

    sort_within: Extent = 10.0
    pause: Rate = 21_600.0
    gap: Rate | None = None
    not_before: datetime.date | None = None
    columns: dict[str, Limit] = field(default_factory=dict)

    def wrong(self) -> Iterator[str | None]:
        """Limits of fields that are not known, or in a unit of another kind."""
        for name, limit in self.columns.items():
            unknown = problem_of(known_field, name)
            yield unknown or problem_of(check_unit, name, limit.unit, known_field(name).unit)

    def of(self, name: str) -> Bounds:
        """Bounds [SI] of a column ``"/topic.column"``: the profile's, else the topic table's."""
        limit = self.columns.get(base_name(name))
        item = field_of(name)[2]
        return item.bounds if limit is None else limit.bounds(item.unit)


class Repair(Strict):
    """Which rules apply ([repair]); each can be switched off. See `trainlog.ingest.rules`."""

    truncated_rows: bool = True
    damaged_messages: bool = True
    not_a_number: bool = True
    empty: bool = True
    newest_first: bool = True
    before_first_fix: bool = True
    time_unreadable: bool = True
    clock_step: bool = True
    clock_step_suspected: bool = True
    clock_jump: bool = True
    time_backwards: bool = True
    duplicates: bool = True
    subsecond: bool = True
    same_time: bool = True
    no_fix: bool = True
    out_of_limits: bool = True
    counter: bool = True
    spikes: bool = True
    frozen: bool = True
    position_steps: bool = True
    inconsistent: bool = True
    unit_suspected: bool = True
    quantised: bool = True
    gaps: bool = True
    direction: bool = True
    contradicted: bool = True
    off_line: bool = True
    slip: bool = True
    position_offset: bool = True

    @property
    def switched_off(self) -> tuple[str, ...]:
        """Names of the rules that are off."""
        return tuple(each.name for each in fields(self) if not getattr(self, each.name))


@dataclass(frozen=True)
class _Metadata(ByName):
    """Metadata of a trip, of which the weather is a condition of the rail."""

    def read(self, found: Any, kind: Any) -> dict[str, str]:
        """The metadata."""
        stated = super().read(found, kind)
        return {n: given_condition(word) if n == "weather" else word for n, word in stated.items()}


PROFILE_FORMAT: Literal["trainlog/recorder-profile"] = "trainlog/recorder-profile"


class Profile(Strict):
    """A recorder's profile; docs/ingest.md describes it with an example."""

    format: Literal["trainlog/recorder-profile"]
    version: Literal[1]
    name: str
    detect: Detection | None = None
    file: FileOptions = FileOptions()
    time: TimeOptions | None = None
    columns: dict[str, Column] = field(default_factory=dict)
    lines: LineOptions | None = None
    rides: RideOptions | None = None
    telegram: TelegramOptions | None = None
    trip: TripOptions = TripOptions()
    metadata: Annotated[dict[str, str], _Metadata()] = field(default_factory=dict)
    limits: Limits = Limits()
    repair: Repair = Repair()

    @property
    def sources(self) -> set[str]:
        """What a recording calls its times and the columns that are used."""
        times = self.time.names if self.time is not None else ()
        return {*times, *(name for each in self.columns.values() for name in each.names)}

    def wrong(self) -> Iterator[str | None]:
        """What does not fit among the columns, and to the format."""
        yield from column_problems(self.columns, self.file.format, self.lines, self.telegram)
        if (self.telegram is None) == (self.file.format == "telegrams"):
            yield '[telegram] and format = "telegrams" under [file] go together'
        if self.telegram is not None and self.time is not None:
            known = (*self.telegram.columns, ARRIVAL)
            for name in [name for name in self.time.names if name not in known]:
                yield f"time: no field '{name}' of the telegram; {suggestion(name, known)}"

    __repr__ = Declared.__repr__

    def summary(self) -> dict[str, str]:
        """Format, time, the fields of each topic, and the rules that are switched off."""
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
        """Where the time of trips comes from: as stated, or that its zone was assumed."""
        zone = None if self.time is None else self.time.timezone
        if self.time is not None and self.time.assumed_timezone == zone:
            return self.trip.clock or f"{zone} assumed: the file does not state a zone"
        return self.trip.clock

    @property
    def stated(self) -> dict[str, str]:
        """The metadata of trips that it states, and the fields whose unit nothing proves."""
        unproven = [f"{name} [{each.unit}]" for name, each in self.columns.items() if each.unproven]
        return self.metadata | ({"unproven_units": ", ".join(unproven)} if unproven else {})

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


def default_profile() -> Profile:
    """The profile of a recorder of which nothing is stated."""
    return Profile(format=PROFILE_FORMAT, version=1, name="none")


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
        return from_content(Profile, content)
    except InputError as error:
        # The whole is looked at only where all its parts fit; what else is wrong is listed too.
        others = (_split(problem) for problem in _problems_of_columns(content) if problem)
        problems = {str(each): each for each in (*error.each, *others)}
        raise InputError.listing([*problems.values()], file=file) from error


def _split(message: str) -> InputError:
    """A problem and its remedy, from ``"problem; remedy"``."""
    problem, _, remedy = message.partition("; ")
    return InputError(problem, remedy=remedy or None)


def _problems_of_columns(content: dict[str, Any]) -> Iterator[str | None]:
    """What is wrong with those columns of a profile that can be read one by one."""
    columns: dict[str, Column] = {}
    given = content.get("columns")
    for name, described in given.items() if isinstance(given, dict) else ():
        with suppress(InputError):
            columns[name] = from_content(Column, described)
    file = content.get("file")
    return column_problems(columns, file.get("format") if isinstance(file, dict) else None)

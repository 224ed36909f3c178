"""The other parts of a profile: the file, its time and trips, limits and rules of repair."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterable
from typing import Literal, Self

import pydantic
from pydantic import Field

from trainlog.declaration import form_for
from trainlog.ingest.profile_checks import (
    Quantity,
    Strict,
    check_unit,
    known_field,
    problem_of,
    refuse,
)
from trainlog.ingest.recording import base_name, field_of
from trainlog.railway.train import Train
from trainlog.railway.weather import check_condition
from trainlog.topics import Bounds
from trainlog.units import factor

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

    @pydantic.model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.columns and self.line is None:
            raise ValueError("needs columns or line")
        try:
            re.compile(self.line or "")
        except re.error as error:
            raise ValueError(f"line is no regular expression: {error}") from None
        return self


class FileOptions(Strict):
    """How the file is written ([file]).

    Attributes
    ----------
    format : str, optional
        Name of the registered format, such as ``"csv"``; detected if absent.
    delimiter, decimal, encoding : str
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
    delimiter: str = Field(default=",", min_length=1, max_length=1)
    decimal: Literal[".", ","] = "."
    encoding: str = "utf-8"
    header: int | None = Field(default=None, ge=0)
    skip_after_header: int = Field(default=0, ge=0)
    comment: str = Field(default="#", max_length=1)
    missing: tuple[str, ...] = MISSING
    aliases: dict[str, tuple[str, ...]] = Field(default_factory=dict)

    @pydantic.model_validator(mode="after")
    def _distinct(self) -> Self:
        problems = []
        if self.delimiter == self.decimal:
            problems.append(f"delimiter and decimal are both '{self.decimal}'")
        try:
            "".encode(self.encoding)
        except LookupError:
            problems.append(
                f"encoding '{self.encoding}' is not known, for example 'utf-8' or 'cp1252'"
            )
        refuse(problems)
        return self

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
    timezone: str = "UTC"
    assumed_timezone: str | None = None
    start: datetime.datetime | Literal["messages"] | None = None
    date: datetime.date | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The columns that make the time."""
        return self.columns if self.column is None else (self.column,)

    @pydantic.model_validator(mode="after")
    def _consistent(self) -> Self:
        patterned = self.format not in ("iso", "epoch", "elapsed", "parts")
        faults = {
            "needs either column or columns": (self.column is None) == (not self.columns),
            "format 'parts' needs 6 columns: year month day hour minute second": self.format
            == "parts"
            and len(self.names) != 6,
            f"format '{self.format}' needs one column": self.format in ("epoch", "elapsed")
            and len(self.names) > 1,
            "format 'elapsed' and start = ... go together": (self.format == "elapsed")
            != (self.start is not None),
            f"format '{self.format}' is none of 'iso', 'epoch', 'elapsed', 'parts' and no"
            " pattern such as '%d.%m.%Y %H:%M:%S'": patterned and "%" not in self.format,
            "date is for a pattern that holds the time of day only": self.date is not None
            and not (patterned and "%d" not in self.format),
        }
        problems: list[str | None] = [problem for problem, at_fault in faults.items() if at_fault]
        refuse([*problems, problem_of(_check_timezone, self.timezone)])
        return self


def _check_timezone(name: str) -> None:
    import pandas as pd

    try:
        pd.Timestamp(0, tz=name)
    except Exception:  # noqa: BLE001 - pandas raises what its zone library raises
        raise ValueError(
            f"timezone '{name}' is not known; for example 'UTC', 'Europe/Zurich' or '+02:00'"
        ) from None


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
    only: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    selection: str = ""
    least_movement: Quantity | None = None
    metadata: dict[str, str] = Field(default_factory=dict)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the table of rides that are used."""
        used = (self.device, *self.only, *self.name, self.begin, self.end, *self.metadata.values())
        return tuple(dict.fromkeys(used))

    @pydantic.model_validator(mode="after")
    def _units(self) -> Self:
        if self.least_movement is not None:
            check_unit("least_movement", self.least_movement.unit, "m")
        return self


class LoadColumn(Strict):
    """A column that holds the load of the trip, and its unit."""

    column: str
    unit: str

    @pydantic.model_validator(mode="after")
    def _units(self) -> Self:
        check_unit("load", self.unit, "kg")
        return self


class WeatherColumn(Strict):
    """A column that holds the rail's condition.

    Attributes
    ----------
    column : str
    words : dict of str to str
        The condition, such as ``"dry"``, that each of the file's words means; others are taken as
        they are.
    """

    column: str
    words: dict[str, str] = Field(default_factory=dict)

    @pydantic.model_validator(mode="after")
    def _known(self) -> Self:
        refuse(problem_of(check_condition, word) for word in self.words.values())
        return self


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
        The rail's condition, such as ``"dry"``, ``"wet"`` or ``"leaves"``.
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
    weather: str | None = None
    load: Quantity | None = None
    mass: Quantity | None = None
    start_position: Quantity | Literal["stations"] | None = None
    columns: TripColumns = TripColumns()

    @pydantic.model_validator(mode="after")
    def _units(self) -> Self:
        problems: list[str | None] = []
        for name, unit in (("load", "kg"), ("mass", "kg"), ("start_position", "m")):
            quantity: Quantity | Literal["stations"] | None = getattr(self, name)
            if isinstance(quantity, Quantity):
                problems.append(problem_of(check_unit, name, quantity.unit, unit))
        if self.weather is not None:
            problems.append(problem_of(check_condition, self.weather))
        if self.load is not None and self.mass is not None:
            problems.append("give load or mass, not both")
        refuse(problems)
        refuse(
            str(problem)
            for name, field in _PLAUSIBLE.items()
            if (quantity := getattr(self, name)) is not None
            for problem in form_for(Train, field).implausible(quantity.si("kg"), name)
        )
        return self


class Limit(Strict):
    """What a field can be: bounds, and how fast it can change (`unit`; `rate` in `unit`/s).

    The table of topics has the same in SI: `trainlog.topics.Bounds`.
    """

    unit: str
    min: float | None = None
    max: float | None = None
    rate: float | None = Field(default=None, gt=0.0)
    tolerance: float | None = Field(default=None, ge=0.0)

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

    sort_within: float = Field(default=10.0, ge=0.0)
    pause: float = Field(default=21_600.0, gt=0.0)
    gap: float | None = Field(default=None, gt=0.0)
    not_before: datetime.date | None = None
    columns: dict[str, Limit] = Field(default_factory=dict)

    @pydantic.model_validator(mode="after")
    def _known(self) -> Self:
        refuse(problem_of(_check_limit, name, limit) for name, limit in self.columns.items())
        return self

    def of(self, name: str) -> Bounds:
        """Bounds [SI] of a column ``"/topic.column"``: the profile's, else the topic table's."""
        limit = self.columns.get(base_name(name))
        item = field_of(name)[2]
        return item.bounds if limit is None else limit.bounds(item.unit)


def _check_limit(name: str, limit: Limit) -> None:
    check_unit(name, limit.unit, known_field(name).unit)


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
        return tuple(name for name in type(self).model_fields if not getattr(self, name))

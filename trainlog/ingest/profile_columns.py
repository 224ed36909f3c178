"""The columns of a profile: how they become fields of our topics ([columns], [lines])."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
import pydantic
from pydantic import Field

from trainlog.errors import InputError
from trainlog.ingest.profile_checks import (
    Strict,
    check_unit,
    known_field,
    problem_of,
    suggestion,
)
from trainlog.ingest.recording import field_of
from trainlog.topics import RECORDED, Field as Item, Topic, recorded_topic
from trainlog.units import si_unit

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
    slip_protection : list of str
        Of ``"/events.message"``: words by which the recorder reports that slip protection acts, in
        any case; events that hold one are named ``"slip protection"``.
    """

    column: str | None = None
    columns: tuple[str, ...] = ()
    value: float | str | None = None
    unit: str | None = None
    scale: float = Field(default=1.0, allow_inf_nan=False)
    offset: float = Field(default=0.0, allow_inf_nan=False)
    integer_scale: float | None = Field(default=None, allow_inf_nan=False)
    part: Literal["all", "positive", "negative"] = "all"
    sign: Literal[1, -1] = 1
    optional: bool = False
    meaning: str = ""
    between: Literal["linear", "previous"] = "linear"
    notation: Literal["number", "degrees_minutes"] = "number"
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
    count: int = Field(default=1, gt=0)

    @property
    def dtype(self) -> np.dtype[Any] | None:
        """The type of the numbers; None if there are none."""
        return None if self.type in ("ubx", "nmea") else np.dtype(self.type)

    @pydantic.model_validator(mode="after")
    def _known(self) -> Self:
        try:
            known = self.dtype is None or self.dtype.kind in "iuf"
        except TypeError:
            known = False
        if not known:
            raise ValueError(
                f"type '{self.type}' must be 'ubx', 'nmea' or numbers of numpy; for example '<i2'"
            )
        return self


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
    columns: dict[str, Column], format: str | None, lines: LineOptions | None = None
) -> list[str]:
    """What is wrong with each of the columns."""
    needs_unit = format not in WITH_UNITS
    found = [problem_of(_check_column, name, one, needs_unit) for name, one in columns.items()]
    if lines is not None:
        found.append(problem_of(_check_lines, lines, columns))
    return [problem for problem in found if problem is not None]


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

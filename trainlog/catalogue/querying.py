"""Asking a catalogue for trips: which ones some limits choose, and where their logs stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import sqlalchemy as sa

from trainlog.catalogue.database import Database, columns_of
from trainlog.catalogue.days import times_of
from trainlog.catalogue.schema import (
    TRIP_COLUMNS,
    log_of_trip,
    on_line,
    trip_edges,
    trips,
)
from trainlog.display import counted
from trainlog.errors import InputError

COLUMNS = [each.name for each in TRIP_COLUMNS]


@dataclass(frozen=True)
class Limits:
    """What limits the trips that are asked for; see `Catalogue.query`."""

    where: str | None = None
    train: str | None = None
    line: str | None = None
    start: Any = None
    end: Any = None
    zone: str | None = None

    def conditions(self) -> list[sa.ColumnElement[bool]]:
        """The conditions that they are for a statement on the table of trips."""
        found = [each for each in [condition_of(self.where, self.zone)] if each is not None]
        if self.train is not None:
            found.append(trips.c.train == self.train)
        if self.line is not None:
            few = any(each is not None for each in (self.train, self.start, self.end))
            found.append(on_line(trips.c.line == self.line, trip_edges.c.edge == self.line, few))
        first = None if self.start is None else times_of(self.start, self.zone)[0]
        last = None if self.end is None else times_of(self.end, self.zone)[1]
        if first is not None and last is not None and first > last:
            raise InputError(
                f"the time from {self.start} to {self.end} ends before it begins",
                remedy="give the earlier time first",
            )
        if first is not None:
            found.append(trips.c.start >= first)
        if last is not None:
            found.append(trips.c.start <= last)
        return found


def condition_of(where: str | None, zone: str | None = None) -> sa.ColumnElement[bool] | None:
    """The condition that an expression states; None without one."""
    from trainlog.catalogue import where as expressions

    return None if where is None else expressions.condition_of(where, zone)


def query(database: Database, limits: Limits, columns: Sequence[str] | None) -> pd.DataFrame:
    """The trips that are chosen, in the order of start and key; see `Catalogue.query`."""
    names = [*COLUMNS, "path"] if columns is None else list(columns)
    for name in names:
        if name not in COLUMNS and name != "path":
            raise InputError(
                f"'{name}' is no column of trips", remedy=f"known: {', '.join(COLUMNS)}, path"
            )
    path = log_of_trip()
    asked = sa.select(*(path if name == "path" else trips.c[name] for name in names))
    asked = asked.where(trips.c.standing == "counts", *limits.conditions())
    with database.reading() as connection:
        rows = connection.execute(asked.order_by(trips.c.start, trips.c.key)).all()
    return _frame(rows, names)


def _frame(rows: Sequence[Any], names: Sequence[str]) -> pd.DataFrame:
    """A frame of trips, its times as time stamps."""
    kinds = {each.name: each.kind for each in TRIP_COLUMNS}
    made = {
        name: _series(values, kinds.get(name, "text"))
        for name, values in columns_of(rows, names).items()
    }
    frame = pd.DataFrame(made)
    frame.attrs["units"] = {
        each.name: each.unit for each in TRIP_COLUMNS if each.name in made and each.kind == "number"
    }
    return frame


def _series(values: Sequence[Any], kind: str) -> pd.Series:
    """A column of a frame of trips."""
    if kind == "time":
        nothing = np.iinfo(np.int64).min
        stamps = np.array([nothing if each is None else each for each in values], np.int64)
        return pd.Series(pd.DatetimeIndex(stamps.view("datetime64[ns]"), tz="UTC"))
    if kind == "number":
        return pd.Series(np.array(values, np.float64))
    if kind == "count":
        return pd.Series(np.array(values, np.int64))
    held = np.empty(len(values), object)
    held[:] = values
    return pd.Series(held, dtype=object)


def unmatched(
    database: Database, where: str | None, train: str | None, line: str | None
) -> list[str]:
    """Names that are asked for and that no trip has; see `Catalogue.unmatched`."""
    from trainlog.catalogue.where import keys_asked, texts_asked

    asked = [] if where is None else texts_asked(where)
    asked += [(n, v) for n, v in (("train", train), ("line", line)) if v is not None]
    found = []
    for column, value in dict.fromkeys(asked):
        values = _values(database, column)
        if value in values:
            continue
        folded = {each.casefold(): each for each in reversed(values)}
        close = get_close_matches(value.casefold(), list(folded), n=1)
        meant = f" did you mean '{folded[close[0]]}'?" if close else ""
        more = f" and {len(values) - 8} more" if len(values) > 8 else ""
        known = f" known: {', '.join(values[:8])}{more}" if values else " none states any"
        found.append(f"no trip has the {column} '{value}';{meant}{known}")
    for column, key in dict.fromkeys([] if where is None else keys_asked(where)):
        keys = _keys(database, column)
        if key in keys:
            continue
        what = "label" if column == "labels" else "value in its passport named"
        known = f"known: {', '.join(keys)}" if keys else "none states any"
        estimated = "; what the analysis passport estimated is asked by 'trainlog fleet query'"
        also = estimated if column == "passport" else ""
        found.append(f"no trip has a {what} '{key}'; {known}{also}")
    return found


def _keys(database: Database, column: str) -> list[str]:
    """Keys that a column of JSON has, of the trips that count."""
    asked = sa.select(trips.c[column]).where(trips.c.standing == "counts")
    with database.reading() as connection:
        return sorted({key for each in connection.execute(asked).scalars() for key in each or ()})


def _values(database: Database, column: str) -> list[str]:
    """Texts of a column, of the trips that count; of lines, the edges of routes, too."""
    counts = trips.c.standing == "counts"
    asked = [sa.select(trips.c[column]).where(counts).distinct()]
    if column == "line":
        edges = sa.select(trip_edges.c.edge).join(trips, trips.c.id == trip_edges.c.trip)
        asked.append(edges.where(counts).distinct())
    with database.reading() as connection:
        found = {value for each in asked for value in connection.execute(each).scalars()}
    return sorted(each for each in found if each is not None)


def paths(database: Database, limits: Limits) -> list[Path]:
    """The logs of the trips that are chosen, none of which has vanished; see `Catalogue.paths`."""
    found = query(database, limits, ["name", "key", "path"])
    if not len(found):
        why = unmatched(database, limits.where, limits.train, limits.line)
        with database.reading() as connection:
            every = number_of_trips(connection)
        raise InputError(
            f"no trip of the {counted(every, 'trip')} of the catalogue is chosen"
            + "".join(f"; {each}" for each in why),
            file=database.place,
            remedy="'trainlog fleet show' shows which trains and lines there are",
        )
    gone = found[found["path"].isna()]
    if len(gone):
        names = ", ".join(gone["name"].iloc[:5])
        more = f" and {len(gone) - 5} more" if len(gone) > 5 else ""
        raise InputError(
            f"the logs of {counted(len(gone), 'trip')} have vanished: {names}{more}",
            file=database.place,
            remedy="add the folder that they were moved to, or remove them from the catalogue",
        )
    return [Path(path) for path in found["path"]]


def number_of_trips(connection: sa.Connection) -> int:
    """How many trips count."""
    asked = sa.select(sa.func.count()).select_from(trips)
    return int(connection.execute(asked.where(trips.c.standing == "counts")).scalar_one())


def path_of(database: Database, key: str) -> Path:
    """The log of the trip whose key begins so; see `Catalogue.open`."""
    asked = sa.select(trips.c.key).where(
        trips.c.standing == "counts", trips.c.key.startswith(key, autoescape=True)
    )
    with database.reading() as connection:
        found = connection.execute(asked.limit(2)).scalars().all()
    if len(found) != 1 or not key:
        what = f"several trips begin with '{key}'" if found else f"there is no trip '{key}'"
        raise InputError(what, file=database.place, remedy="give the key that 'query' lists")
    (path,) = paths(database, Limits(f"key = '{found[0]}'"))
    return path

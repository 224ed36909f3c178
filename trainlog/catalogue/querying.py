"""The trips of a catalogue: which ones some limits choose, where their logs stand, how many.

At the end the tables that show them, and what does not count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import sqlalchemy as sa

from trainlog.catalogue.database import (
    TRIP_COLUMNS,
    Database,
    columns_of,
    files,
    log_of_trip,
    trip_edges,
    trips,
)
from trainlog.display import counted, few
from trainlog.errors import InputError
from trainlog.presentation import HOURS, MASS, NUMBER, Column, Quantity, Said, WordTable, new_table
from trainlog.spans import times_of
from trainlog.units import DAY, clock

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue
    from trainlog.trip import Trip

GROUPS: dict[str, tuple[str, ...]] = {
    "route": ("train", "kind", "line"),
    "train": ("train",),
    "kind": ("kind",),
    "line": ("line",),
    "weather": ("weather",),
    "edge": ("edge",),
    "day": ("day",),
}
"""By what an overview can be, and the columns that name a row of it."""


COLUMNS = [each.name for each in TRIP_COLUMNS]

_ESTIMATED = "; what the analysis passport estimated is asked by 'trainlog fleet query'"


def expression_of(
    where: str | None = None,
    train: str | None = None,
    line: str | None = None,
    start: Any = None,
    end: Any = None,
) -> str | None:
    """The expression that limits trips as these do; None if nothing does.

    Examples
    --------
    >>> expression_of("weather = 'wet'", train="O'Brien")
    "(weather = 'wet') and (train = 'O''Brien')"
    """
    limits = (("train =", train), ("line =", line), ("start >=", start), ("start <=", end))
    texts = [] if where is None else [where]
    for asked, value in limits:
        if value is not None:
            quoted = str(value).replace("'", "''")
            texts.append(f"{asked} '{quoted}'")
    if len(texts) < 2:
        return texts[0] if texts else None
    return " and ".join(f"({each})" for each in texts)


def conditions(where: str | None = None, zone: str | None = None) -> list[sa.ColumnElement[bool]]:
    """What limits the trips that count, of which an expression chooses some."""
    from trainlog.catalogue.where import condition_of

    counts = trips.c.standing == "counts"
    return [counts] if where is None else [counts, condition_of(where, zone)]


def _frame(rows: Sequence[Any], kinds: Mapping[str, str]) -> pd.DataFrame:
    """A frame of rows whose columns are of these kinds; times become time stamps."""
    frame = pd.DataFrame(columns_of(rows, list(kinds)), dtype=object)
    for name, kind in kinds.items():
        if kind == "time":
            frame[name] = pd.to_datetime(frame[name].astype("Int64"), unit="ns", utc=True)
        elif kind in _NUMBERS:
            frame[name] = frame[name].astype(_NUMBERS[kind])
    return frame


_NUMBERS: dict[str, Any] = {"number": np.float64, "count": np.int64}


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


class Trips(Database):
    """A catalogue as far as it says which trips there are, and where their logs stand."""

    def __len__(self) -> int:
        asked = sa.select(sa.func.count()).select_from(trips)
        with self.reading() as connection:
            return int(connection.execute(asked.where(*conditions())).scalar_one())

    def query(
        self,
        where: str | None = None,
        *,
        train: str | None = None,
        line: str | None = None,
        start: Any = None,
        end: Any = None,
        zone: str | None = None,
        columns: Sequence[str] | None = None,
    ) -> pd.DataFrame:
        """The trips that an expression and the other limits choose, in the order of start and key.

        Parameters
        ----------
        where : str, optional
            ``"weather = 'wet' and duration > '20 min'"``; docs/catalogue.md lists what is known.
        train, line : str, optional
            Of a route, each line that it runs over counts.
        start, end : anything that `pandas.Timestamp` takes, optional
            Trips that start in this time, both ends belonging to it; a day as an end counts whole.
        zone : str, optional
            Time zone of times that state none; default UTC.
        columns : sequence of str, optional
            Of `TRIP_COLUMNS`, and ``path``; default: all.

        Returns
        -------
        DataFrame
            One row a trip. Numbers are in SI units, but kilometres; ``attrs["units"]`` lists them.
            ``path`` is that of a log that is present; None if all have vanished.

        Raises
        ------
        InputError
            If the expression is not understood, or a time or column is none.

        Examples
        --------
        >>> import tempfile
        >>> from trainlog.catalogue import open_catalogue
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     found = catalogue.query("duration > '20 min'", start="2024-10-07")
        >>> found[["name", "weather", "km_to"]].values.tolist()
        [['trip-03', 'wet', 29.55646]]
        """
        names = [*COLUMNS, "path"] if columns is None else list(columns)
        for name in names:
            if name not in COLUMNS and name != "path":
                raise InputError(
                    f"'{name}' is not a column of trips",
                    remedy=f"known: {', '.join(COLUMNS)}, path",
                )
        path = log_of_trip()
        asked = sa.select(*(path if name == "path" else trips.c[name] for name in names))
        both = start is not None and end is not None
        if both and times_of(start, zone)[0] > times_of(end, zone)[1]:
            raise InputError(
                f"the time from {start} to {end} ends before it begins",
                remedy="give the earlier time first",
            )
        asked = asked.where(*conditions(expression_of(where, train, line, start, end), zone))
        with self.reading() as connection:
            rows = connection.execute(asked.order_by(trips.c.start, trips.c.key)).all()
        kinds = {each.name: each.kind for each in TRIP_COLUMNS}
        frame = _frame(rows, {name: kinds.get(name, "text") for name in names})
        frame.attrs["units"] = {
            each.name: each.unit
            for each in TRIP_COLUMNS
            if each.name in names and each.kind == "number"
        }
        return frame

    def unmatched(
        self, where: str | None = None, train: str | None = None, line: str | None = None
    ) -> list[str]:
        """Names that are asked for and that no trip has, each in a sentence with similar ones.

        Parameters are those of `query`; of an expression, texts that a column must equal.

        Examples
        --------
        >>> import tempfile
        >>> from trainlog.catalogue import open_catalogue
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     catalogue.unmatched("weather = 'Wet'")
        ["no trip has the weather 'Wet'; did you mean 'wet'? known: dry, wet"]
        """
        from trainlog.catalogue.where import asked_by

        found, expression = [], expression_of(where, train, line)
        for column, value in dict.fromkeys(() if expression is None else asked_by(expression)):
            keys = column in ("labels", "passport")
            values = _keys(self, column) if keys else _values(self, column)
            if value in values:
                continue
            if keys:
                what = "label" if column == "labels" else "value in its passport named"
                known = f"known: {', '.join(values)}" if values else "none states any"
                also = _ESTIMATED if column == "passport" else ""
                found.append(f"no trip has a {what} '{value}'; {known}{also}")
                continue
            folded = {each.casefold(): each for each in reversed(values)}
            close = get_close_matches(value.casefold(), list(folded), n=1)
            meant = f" did you mean '{folded[close[0]]}'?" if close else ""
            known = f" known: {few(values, 8)}" if values else " none states any"
            found.append(f"no trip has the {column} '{value}';{meant}{known}")
        return found

    def paths(self, where: str | None = None, **limits: Any) -> list[Path]:
        """The logs of the trips that `query` chooses, in its order.

        Raises
        ------
        InputError
            As `query`; if no trip is found, or the logs of some have vanished, which are named.
        """
        found = self.query(where, **limits, columns=["name", "key", "path"])
        if not len(found):
            why = self.unmatched(where, limits.get("train"), limits.get("line"))
            raise InputError(
                f"no trip of the {counted(len(self), 'trip')} of the catalogue is chosen"
                + "".join(f"; {each}" for each in why),
                file=self.place,
                remedy="'trainlog fleet show' shows which trains and lines there are",
            )
        gone = found[found["path"].isna()]
        if len(gone):
            names = few(gone["name"].tolist(), 5)
            raise InputError(
                f"the logs of {counted(len(gone), 'trip')} have vanished: {names}",
                file=self.place,
                remedy="add the folder that they were moved to, or remove them from the catalogue",
            )
        return [Path(path) for path in found["path"]]

    def open(self, trip: str | Mapping[str, Any] | pd.Series, *topics: str) -> Trip:
        """Read the log of a trip.

        Parameters
        ----------
        trip : str, or a row of the frame of trips
            Its key, or the beginning of it.
        *topics : str
            Topics to read; default: all.

        Raises
        ------
        InputError
            If there is no such trip, the beginning is that of several, or its log has vanished.

        Examples
        --------
        >>> import tempfile
        >>> from trainlog.catalogue import open_catalogue
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     trip = catalogue.open(catalogue.query("weather = 'wet'").iloc[0])
        >>> trip.name
        'trip-03'
        """
        from trainlog.mcap import read_log

        key = trip if isinstance(trip, str) else str(trip["key"])
        asked = sa.select(trips.c.key).where(
            trips.c.standing == "counts", trips.c.key.startswith(key, autoescape=True)
        )
        with self.reading() as connection:
            found = connection.execute(asked.limit(2)).scalars().all()
        if len(found) != 1 or not key:
            what = f"several trips begin with '{key}'" if found else f"there is no trip '{key}'"
            raise InputError(what, file=self.place, remedy="give the key that 'query' lists")
        (path,) = self.paths(f"key = '{found[0]}'")
        return read_log(path, topics or None)

    def counts(self) -> dict[str, int]:
        """How many trips count, how many recordings of the same drives there are, and files."""
        count = sa.func.count()
        with self.reading() as connection:
            standing = connection.execute(
                sa.select(trips.c.standing, count).group_by(trips.c.standing)
            )
            states = connection.execute(sa.select(files.c.state, count).group_by(files.c.state))
            trips_by = {row[0]: int(row[1]) for row in standing}
            files_by = {row[0]: int(row[1]) for row in states}
        return {
            "trips": trips_by.get("counts", 0),
            "other recordings": trips_by.get("same drive", 0),
            "older versions": trips_by.get("older version", 0),
            "files": files_by.get("present", 0),
            "vanished": files_by.get("vanished", 0),
            "refused": files_by.get("refused", 0),
        }

    def uncounted(self) -> pd.DataFrame:
        """What does not count, and why: copies, other recordings, old versions, vanished, refused.

        Returns
        -------
        DataFrame
            With the columns ``path``, ``what`` and ``reason``, in the order of path.
        """
        other = trips.alias("other")
        standing = (
            sa.select(files.c.path, trips.c.standing, other.c.name, trips.c.share, other.c.key)
            .select_from(trips)
            .join(files, files.c.trip == trips.c.id)
            .join(other, other.c.id == trips.c.same_as)
            .where(files.c.state == "present", trips.c.standing != "counts")
        )
        state = sa.select(files.c.path, files.c.state, files.c.reason).where(
            files.c.state.in_(("vanished", "refused"))
        )
        earliest = (
            sa.select(sa.func.min(files.c.id))
            .where(files.c.state == "present")
            .group_by(files.c.trip)
        )
        first = sa.select(files.c.trip, files.c.path).where(files.c.id.in_(earliest)).subquery()
        copies = sa.select(files.c.path, first.c.path).where(
            files.c.trip == first.c.trip, files.c.state == "present", files.c.path != first.c.path
        )
        with self.reading() as connection:
            found = [
                (path, what, f"{'' if share is None else f'{share:.0%} in '}'{name}' ({key[:8]})")
                for path, what, name, share, key in connection.execute(standing)
            ]
            found += [(path, what, reason) for path, what, reason in connection.execute(state)]
            known = {path for path, *_ in found}
            found += [
                (path, "copy", f"the same as {other}")
                for path, other in connection.execute(copies)
                if path not in known
            ]
        return pd.DataFrame(sorted(found), columns=["path", "what", "reason"])

    def overview(self, by: str = "route") -> pd.DataFrame:
        """How many trips there are, of those that count.

        Parameters
        ----------
        by : {"route", "train", "kind", "line", "edge", "day", "weather"}
            What has a row: a train and line, a train, ... An edge is each line that trips ran over,
            a route's line also where they only passed over it; a day is that of the start, UTC.

        Returns
        -------
        DataFrame
            What names the row; ``trips``; ``trains`` and ``lines``, how many there are; ``first``
            and ``last`` start; ``distance`` [m] and ``duration`` [s] in all; ``damaged``, of how
            many the log is. Of an edge the distance driven on it, and how often it was run over
            ``forward`` and in ``reverse``.

        Examples
        --------
        >>> import tempfile
        >>> from trainlog.catalogue import open_catalogue
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     catalogue.overview("edge")[["edge", "trips", "trains", "forward"]].values.tolist()
        [['CH_StGallen_Wil', 2, 1, 2]]
        """
        if by not in GROUPS:
            raise InputError(
                f"there is no overview by '{by}'", remedy=f"known: {', '.join(GROUPS)}"
            )
        names = GROUPS[by]
        edge = trip_edges.c
        columns: dict[str, Any] = {name: trips.c[name] for name in names if name in trips.c}
        columns |= {"edge": edge.edge} if by == "edge" else {}
        columns |= {"day": trips.c.start // DAY} if by == "day" else {}
        count, total = sa.func.count, sa.func.sum
        # Of a train some logs may not state the kind.
        sums: dict[str, Any] = {"kind": sa.func.max(trips.c.kind)} if by == "train" else {}
        sums["trips"] = count(trips.c.id.distinct())
        if "train" not in names:
            sums["trains"] = count(trips.c.train.distinct())
        if not {"line", "edge"} & set(names):
            sums["lines"] = count(trips.c.line.distinct())
        if by != "day":
            sums |= {"first": sa.func.min(trips.c.start), "last": sa.func.max(trips.c.start)}
        asked = sa.select(trips.c.id)
        if by == "edge":
            asked = asked.join(trip_edges, edge.trip == trips.c.id)
            sums["forward"] = total(sa.case((edge.direction == "forward", 1), else_=0))
            sums["reverse"] = total(sa.case((edge.direction == "reverse", 1), else_=0))
            sums["distance"] = 1e3 * total(edge.km_to - edge.km_from)
        else:
            sums |= {"distance": total(trips.c.distance), "duration": total(trips.c.duration)}
            sums["damaged"] = total(sa.case((trips.c.quality == "damaged", 1), else_=0))
        asked = asked.with_only_columns(
            *columns.values(), *sums.values(), maintain_column_froms=True
        )
        asked = asked.where(trips.c.standing == "counts").group_by(*columns.values())
        with self.reading() as connection:
            rows = connection.execute(asked).all()
        kinds = dict.fromkeys(columns, "text") | dict.fromkeys(sums, "count")
        kinds |= {name: "time" for name in ("first", "last") if name in sums}
        kinds |= {name: "number" for name in ("distance", "duration") if name in sums}
        kinds |= {"kind": "text"} if "kind" in kinds else {}
        frame = _frame(rows, kinds)
        if by == "day":
            days = pd.to_datetime(frame["day"].astype("Int64") * DAY, unit="ns", utc=True)
            frame["day"] = days.dt.strftime("%Y-%m-%d").astype(object)
        order = frame[list(names)].fillna("").sort_values(list(names))
        return frame.loc[order.index].reset_index(drop=True)


# -------------------------------------------------------------------------- tables of a catalogue


DISTANCE = Quantity("m", "km", 1e-3, 1)

_TIME = "%Y-%m-%d %H:%M UTC"


def trips_table(frame: pd.DataFrame, found: int) -> WordTable:
    """Trips, as `trainlog.catalogue.Catalogue.query` gives them; `found`: with those not listed.

    As data the table has all columns, with the units of numbers in their names.
    """
    units = {"s": "_s", "m": "_m", "kg": "_kg"}
    names = {name: f"{name}{units.get(unit, '')}" for name, unit in frame.attrs["units"].items()}
    names |= {"km_from": "from_km", "km_to": "to_km"}
    table = new_table(
        f"{found:,} trips" if found != 1 else "1 trip",
        *map(Column, ("key", "trip", "train", "line", "start", "time", "km", "weather")),
        Column("load", MASS),
        name="trips",
        frame=frame.rename(columns=names).astype(object),
    )
    for row in frame.to_dict("records"):
        km = row["km_from"], row["km_to"]
        table.add_cells(
            str(row["key"])[:8],
            row["name"] if row["path"] is not None else f"{row['name']} (vanished)",
            row["train"],
            row["line"],
            _time(row["start"]),
            clock(float(row["duration"])),
            "-" if pd.isna(km[0]) else f"{km[0]:.1f} to {km[1]:.1f}".replace("-0.0 ", "0.0 "),
            row["weather"],
            row["load"],
        )
    return table


_COLUMNS = (
    *map(Column, ("train", "kind", "line", "edge")),
    Column("day, UTC", key="day"),
    Column("weather"),
    Column("trips", NUMBER),
    Column("trains", NUMBER),
    Column("lines", NUMBER),
    Column("first day", key="first"),
    Column("last day", key="last"),
    Column("forward", NUMBER),
    Column("reverse", NUMBER),
    Column("driven", DISTANCE, key="distance"),
    Column("time", HOURS, key="duration"),
    Column("damaged", NUMBER),
)
_NAMES = {"route": "trains", "weather": "weather"}
"""Keys in JSON that are not plurals of what has a row."""


def overview_table(catalogue: Catalogue, by: str = "route") -> WordTable:
    """How many trips there are by train and line, or by what is given."""
    frame = catalogue.overview(by)
    columns = [each for each in _COLUMNS if each.name in frame]
    table = new_table(f"Catalogue {catalogue.place}", *columns, name=_NAMES.get(by, f"{by}s"))
    rows = frame.to_dict("records")
    return table.add_rows({name: _cell(row[name]) for name in row} for row in rows)


def _cell(value: Any) -> Any:
    if pd.isna(value):
        return None
    return _time(value, "%Y-%m-%d") if isinstance(value, pd.Timestamp) else value


SHOWN_DIGITS = 6
"""Of a number that a statement finds, in a table."""


def found_table(frame: pd.DataFrame, found: int) -> WordTable:
    """What a statement of SQL finds; `found`: with the rows that are not listed."""
    title = f"{found:,} rows" if found != 1 else "1 row"
    columns = [Column(str(each)) for each in frame.columns]
    table = new_table(title, *columns, name="rows", frame=frame.astype(object))
    for row in frame.itertuples(index=False):
        table.add_cells(*map(_shown, row))
    return table


def _shown(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return str(value.tolist())
    if not isinstance(value, list | dict) and pd.isna(value):
        return "-"
    if isinstance(value, pd.Timestamp):
        return value.isoformat()
    return f"{value:.{SHOWN_DIGITS}g}" if isinstance(value, float | np.floating) else str(value)


def problems_table(catalogue: Catalogue) -> WordTable:
    """Files that do not count, with the reasons, and damaged logs that do."""
    title = "Files that do not count, and damaged logs that do"
    table = new_table(title, "file", "what", "of, or reason", name="files")
    frame = catalogue.uncounted()
    for row in frame.to_dict("records"):
        table.add_row(row["path"], row["what"], row["reason"])
    damaged = catalogue.query("quality = 'damaged'", columns=["path", "name", "damage"])
    for row in damaged.to_dict("records"):
        table.add_row(row["path"] or row["name"], "damaged", row["damage"])
    return table


def _time(time: Any, form: str = _TIME) -> Said:
    known = not pd.isna(time)
    return Said(time.isoformat() if known else None, f"{time:{form}}" if known else "-")

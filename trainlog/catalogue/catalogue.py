"""A catalogue, open: files are added, trips asked for, results kept; statements of SQL over it.

DuckDB runs these, over the Parquet files of results as they are and the tables that a statement
names, of whichever database the catalogue is in. Nothing can be changed, and no other file be read.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import sqlalchemy as sa

from trainlog.catalogue.database import TRIP_COLUMNS, columns_of, files, trip_edges, trips
from trainlog.catalogue.querying import Trips
from trainlog.catalogue.registration import Files
from trainlog.catalogue.results import (
    ATTEMPTS,
    KEY,
    Computed,
    analyses_recorded,
    is_readable,
    recorded,
    unreadable,
)
from trainlog.display import as_text
from trainlog.errors import InputError
from trainlog.extras import require
from trainlog.formats.files import atomic_write, csv_bytes
from trainlog.formats.settings import read_settings

if TYPE_CHECKING:
    import duckdb

    from trainlog.catalogue.database import Database

_EXAMPLE = "select train, count(*) from trips group by train"

_DEFAULT = "catalogue"
"""Folder of the catalogue where none is named."""


def open_catalogue(
    where: str | Path | None = None, *, results: str | Path | None = None, create: bool = True
) -> Catalogue:
    """Open the catalogue of a fleet; a new one is made where there is none.

    Tables of an earlier version are brought to the latest in one transaction, with a warning.

    Parameters
    ----------
    where : path or str, optional
        A folder, which holds the database (SQLite) and the results, or the URL of a PostgreSQL
        database: ``postgresql://user@host/database``, with ``?schema=name`` for a schema of its
        own. Default: as set (``trainlog settings catalogue``), else the folder ``catalogue``.
    results : path, optional
        Folder of the results of a new catalogue in PostgreSQL.
    create : bool
        Whether it is made where there is none.

    Returns
    -------
    Catalogue
        A context manager that closes the database.

    Raises
    ------
    InputError
        If there is none and none is to be made, it is of a version that this trainlog does not
        know, or cannot be reached.
    MissingExtraError
        If the extra ``fleet`` is not installed, or ``postgresql`` with a URL.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
    ...     _ = catalogue.add("sample_logs")
    ...     catalogue.query("weather = 'wet'")["name"].tolist()
    ['trip-03']
    """
    return Catalogue(where or read_settings().catalogue or _DEFAULT, results, create=create)


SECONDS, MEMORY = 600.0, 4e9
"""Time [s] and memory [byte] that a statement of SQL may take unless others are stated."""


class Catalogue(Files, Trips, Computed):
    """Which trips there are, where their logs stand, and what was computed of them.

    `open_catalogue` opens one. Several processes may use the same catalogue at once.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        rows = {name: f"{count:,}" for name, count in self.counts().items()}
        return as_text(f"Catalogue {self.place}", rows)

    def sql(
        self, statement: str, *, seconds: float = SECONDS, memory: float = MEMORY
    ) -> pd.DataFrame:
        """What a statement of SQL finds in the trips and in what was computed of them.

        DuckDB runs it. Its tables are ``trips`` (those that count, with the columns of
        `TRIP_COLUMNS`), ``files``, ``edges`` (a row each line that a trip ran over), and one of
        each analysis, as ``resistance``, with the rows of its latest code and parameters, of each
        trip that counts once; ``key`` joins them. Times are UTC, numbers in SI units but
        kilometres. Nothing can be changed by it.

        Parameters
        ----------
        statement : str
            ``"select weather, avg(r0) from resistance join trips using (key) group by weather"``
        seconds, memory : float [s], [byte]
            That it may take.

        Returns
        -------
        DataFrame

        Raises
        ------
        InputError
            If it is not understood, or names a table or column that there is not; names those that
            there are. If it takes longer, or more memory, than it may.

        Examples
        --------
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     catalogue.sql("select weather, count(*) as trips from trips group by 1 order by 1")
          weather  trips
        0     dry      1
        1     wet      1
        """
        require("duckdb")
        import duckdb

        for attempt in range(ATTEMPTS):
            analyses = _analyses(self)
            tables = [name for name in (*_TABLES, *analyses) if name in statement.casefold()]
            columns: dict[str, dict[str, str]] = {}
            try:
                with _connection(self, analyses, tables) as connection:
                    columns = _columns(connection, tables)
                    wanted = _columns_of(connection, statement)
                    for name in _TABLES.keys() & set(tables):
                        connection.register(name, _table(self, *_TABLES[name], wanted))
                    connection.execute(f"SET memory_limit = '{memory / 1e6:.0f}MB'")
                    connection.execute("SET lock_configuration = true")
                    timer = threading.Timer(seconds, connection.interrupt)
                    timer.daemon = True
                    timer.start()
                    try:
                        return connection.execute(statement).df()
                    finally:
                        timer.cancel()
            except (duckdb.InterruptException, duckdb.OutOfMemoryException) as error:
                long = isinstance(error, duckdb.InterruptException)
                raise InputError(
                    f"the statement takes more than {seconds:g} s"
                    if long
                    else f"the statement takes more than {memory / 1e9:g} GB of memory",
                    remedy="ask for fewer trips or columns; in Python, Catalogue.sql takes other"
                    " limits",
                ) from error
            except duckdb.Error as error:
                if isinstance(error, duckdb.IOException) and attempt + 1 < ATTEMPTS:
                    # Another process put files of results together meanwhile, perhaps.
                    continue
                _check_files(self, analyses, tables, error)
                known = f"tables of {self.place}: {', '.join((*_TABLES, *analyses))}"
                raise _refused(statement, error, columns, known) from error
        raise AssertionError

    def tables(self) -> pd.DataFrame:
        """The tables that `sql` knows, with their columns.

        Returns
        -------
        DataFrame
            The columns ``table``, ``column`` and ``type``.

        Examples
        --------
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     catalogue.tables()["table"].unique().tolist()
        ['trips', 'files', 'edges']
        """
        require("duckdb")
        import duckdb

        analyses = _analyses(self)
        known = [*_TABLES, *analyses]
        try:
            with _connection(self, analyses, known) as connection:
                every = _columns(connection, known)
        except duckdb.Error as error:
            _check_files(self, analyses, known, error)
            raise
        found = [
            (table, name, kind)
            for table, columns in every.items()
            for name, kind in columns.items()
        ]
        return pd.DataFrame(found, columns=["table", "column", "type"])


def _check_files(
    database: Database, analyses: dict[str, str], tables: list[str], error: duckdb.Error
) -> None:
    """Refuse files of results that are missing or damaged, where an error may come from them."""
    import duckdb

    if isinstance(error, duckdb.ParserException | duckdb.BinderException | duckdb.CatalogException):
        return
    for name in tables:
        if name in analyses:
            for path in _results_of(database, analyses[name])[0]:
                if not is_readable(Path(path)):
                    raise unreadable(path) from error


def _analyses(database: Database) -> dict[str, str]:
    """The analyses that have results, by the name of their table."""
    with database.reading() as connection:
        names = analyses_recorded(connection)
    return {f"{name}_results" if name.casefold() in _TABLES else name: name for name in names}


def _columns_of(connection: duckdb.DuckDBPyConnection, statement: str) -> frozenset[str] | None:
    """The columns that a statement reads of tables without rows, by its plan; None if all.

    Raises
    ------
    InputError
        If it is not one statement that reads.
    duckdb.Error
        If it cannot be planned.
    """
    kinds = [each.type.name for each in connection.extract_statements(statement)]
    if kinds not in (["SELECT"], ["MULTI"]):
        raise InputError(
            "is not one statement that reads",
            place=_shown(statement),
            remedy=f"write one as: {_EXAMPLE}",
        )
    # A column that a filter alone asks for is to be named, too.
    connection.execute("SET disabled_optimizers = 'filter_pushdown'")
    ((_, plan),) = connection.execute(f"EXPLAIN (FORMAT JSON) {statement}").fetchall()
    connection.execute("SET disabled_optimizers = ''")
    found, steps = list[str](), json.loads(plan)
    while steps:
        step = steps.pop()
        steps += step["children"]
        if "ARROW_SCAN" in step["name"]:
            read = step["extra_info"].get("Projections")
            found += read if isinstance(read, list) else [read]
    return frozenset(found) if found and all(found) else None


@contextmanager
def _connection(
    database: Database, analyses: dict[str, str], tables: list[str]
) -> Iterator[duckdb.DuckDBPyConnection]:
    """A connection with some tables; those of the database are without rows."""
    import duckdb

    with duckdb.connect(config={"python_enable_replacements": False}) as connection:
        paths: list[str] = []
        for name in tables:
            if name in analyses:
                own, rows = _results_of(database, analyses[name])
                paths += own
                _view(connection, name, own, rows)
            else:
                connection.register(name, _table(database, *_TABLES[name], empty=True))
        # These files alone are read.
        connection.execute(f"SET allowed_paths = [{', '.join(map(_quoted, paths))}]")
        connection.execute("SET enable_external_access = false")
        yield connection


def _results_of(database: Database, analysis: str) -> tuple[list[str], pd.DataFrame]:
    """The files of an analysis, and which of them holds each trip that counts."""
    rows = recorded(database, analysis)
    folder = (database.results_folder / analysis).absolute()
    return [str(folder / name) for name in sorted(set(rows["name"]))], rows


def _view(
    connection: duckdb.DuckDBPyConnection, name: str, paths: list[str], rows: pd.DataFrame
) -> None:
    """A view of the rows of the trips that count, each of the file that holds them."""
    table, held = _identifier(name), f"counting {name}"
    if not paths:
        connection.execute(f"CREATE VIEW {table} AS SELECT '' AS {KEY} WHERE false")
        return
    counting = {
        "trip": pa.array(rows[KEY].tolist(), pa.string()),
        "name": pa.array(rows["name"].tolist(), pa.string()),
    }
    connection.register(held, pa.table(counting))
    listed = ", ".join(map(_quoted, paths))
    connection.execute(
        f"CREATE VIEW {table} AS SELECT r.* EXCLUDE (_file)"
        f" FROM read_parquet([{listed}], union_by_name = true, filename = '_file') r SEMI JOIN"
        f" {_identifier(held)} c ON r.{KEY} = c.trip AND parse_filename(r._file) = c.name"
    )


def _identifier(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


# ------------------------------------------------------------------------ tables of the database

_ARROW = {"text": "string", "json": "string", "number": "double", "count": "int64", "time": "int64"}
_TRIPS = {each.name: (trips.c[each.name], each.kind) for each in TRIP_COLUMNS}
_FILES = {
    "path": (files.c.path, "text"),
    KEY: (trips.c.key, "text"),
    "state": (files.c.state, "text"),
    "reason": (files.c.reason, "text"),
    "size": (files.c.size, "count"),
    "changed": (files.c.changed, "time"),
    "sha256": (files.c.sha256, "text"),
}
_EDGES = {
    KEY: (trips.c.key, "text"),
    "place": (trip_edges.c.place, "count"),
    "edge": (trip_edges.c.edge, "text"),
    "km_from": (trip_edges.c.km_from, "number"),
    "km_to": (trip_edges.c.km_to, "number"),
    "direction": (trip_edges.c.direction, "text"),
}


_COUNTING = sa.select(trips.c.key).where(trips.c.standing == "counts").order_by(trips.c.key)
_TABLES: dict[str, tuple[sa.Select[Any], Mapping[str, tuple[Any, str]]]] = {
    "trips": (_COUNTING, _TRIPS),
    "files": (
        sa.select(files.c.path)
        .outerjoin(trips, trips.c.id == files.c.trip)
        .order_by(files.c.path, files.c.sha256),
        _FILES,
    ),
    "edges": (
        _COUNTING.join(trip_edges, trips.c.id == trip_edges.c.trip).order_by(trip_edges.c.place),
        _EDGES,
    ),
}
"""Statement and columns of each table of the database that a statement of SQL can name."""


def _table(
    database: Database,
    asked: sa.Select[Any],
    columns: Mapping[str, tuple[Any, str]],
    wanted: frozenset[str] | None = None,
    empty: bool = False,
) -> pa.Table:
    """A table of the database; of columns that are not wanted nothing is read, None: of none.

    Times are time stamps in UTC.
    """
    read = [name for name in columns if wanted is None or name in wanted] or [KEY]
    asked = asked.with_only_columns(
        *(
            sa.cast(column, sa.Text) if kind == "json" else column
            for column, kind in map(columns.__getitem__, read)
        ),
        maintain_column_froms=True,
    )
    with database.reading() as connection:
        rows = connection.execute(asked.limit(0) if empty else asked).all()
    held, made = columns_of(rows, read), {}
    for name, (_, kind) in columns.items():
        form = pa.type_for_alias(_ARROW[kind])
        values = pa.array(held[name], form) if name in held else pa.nulls(len(rows), form)
        if kind == "time":
            values = values.cast(pa.timestamp("ns")).cast(pa.timestamp("us"), safe=False)
        made[name] = values
    return pa.table(made)


# ------------------------------------------------------------------------------ what is refused


def _columns(connection: duckdb.DuckDBPyConnection, named: list[str]) -> dict[str, dict[str, str]]:
    """Columns and their types, by table."""
    found = {}
    for name in named:
        rows = connection.execute(f"DESCRIBE {_identifier(name)}").fetchall()
        found[name] = {str(row[0]): str(row[1]) for row in rows}
    return found


def _refused(
    statement: str, error: Exception, columns: dict[str, dict[str, str]], tables: str
) -> InputError:
    """That a statement is refused, in one sentence, with the columns of its tables."""
    # The first line of the message, without the kind of the error and colours of a terminal.
    line = re.sub(r"\x1b\[[\d;]*m", "", str(error)).strip().splitlines()[0]
    problem = re.sub(r"^[A-Z]\w+ Error: ", "", line).rstrip(".!")
    known = "; ".join(f"{table} has {', '.join(names)}" for table, names in columns.items())
    every = {
        "column": [each for names in columns.values() for each in names],
        "table": tables.partition(": ")[2].split(", "),
    }
    for what, names in every.items():
        missing = re.search(_MISSING[what], str(error))
        if missing:
            close = get_close_matches(missing[1], names, n=1)
            problem = f"there is no {what} '{missing[1]}'"
            problem += f"; did you mean '{close[0]}'?" if close else ""
            known = known if what == "column" else tables
    if problem.startswith("Ambiguous reference"):
        known = "name the table before the column"
    return InputError(problem, place=_shown(statement), remedy=known or f"write one as: {_EXAMPLE}")


_MISSING = {
    "column": r'column (?:named )?"([^"]+)"',
    "table": r"Table with name (.+) does not exist",
}
"""What DuckDB says of a column or a table that there is not."""


def _shown(statement: str) -> str:
    text = " ".join(statement.split())
    return f'statement "{text if len(text) <= 200 else f"{text[:200]}..."}"'


def write_trips(frame: pd.DataFrame, path: str | Path) -> None:
    """Write a frame of trips, whole or not at all.

    Headings of CSV name the unit, as ``duration [s]``; in Parquet the fields' metadata do. What
    holds several values, as the topics do, is JSON.

    Parameters
    ----------
    frame : DataFrame
        As `Catalogue.query` gives it.
    path : path
        Ending in ``.csv`` or ``.parquet``.

    Raises
    ------
    InputError
        If the ending is another, or it cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.catalogue import open_catalogue
    >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
    ...     _ = catalogue.add("sample_logs")
    ...     write_trips(catalogue.query(columns=["name", "duration"]), Path(folder) / "trips.csv")
    ...     print((Path(folder) / "trips.csv").read_text(), end="")
    name,duration [s]
    trip-01,1183.1
    trip-03,1413.9
    """
    kind = Path(path).suffix
    if kind not in (".csv", ".parquet"):
        raise InputError(
            "is not the name of a .csv or .parquet file", file=path, remedy="end it in one of them"
        )
    columns = {each.name: each for each in TRIP_COLUMNS}
    shown = frame.copy()
    for name in shown:
        column = columns.get(str(name))
        if column is not None and column.kind == "json":
            texts = [
                None if each is None else json.dumps(each, sort_keys=True, ensure_ascii=False)
                for each in shown[name]
            ]
            shown[name] = pd.Series(texts, index=shown.index, dtype=object)
    units = {name: columns[name].unit for name in shown if name in columns}
    with atomic_write(path) as temporary:
        if kind == ".csv":
            for name in shown:
                if isinstance(shown[name].dtype, pd.DatetimeTZDtype):
                    shown[name] = [None if pd.isna(t) else t.isoformat() for t in shown[name]]
            headings = {name: f"{name} [{unit}]" for name, unit in units.items() if unit}
            temporary.write_bytes(csv_bytes(shown.rename(columns=headings)))
            return
        table = pa.Table.from_pandas(shown, preserve_index=False).replace_schema_metadata(None)
        fields = [
            field.with_metadata({"unit": units[field.name]}) if units.get(field.name) else field
            for field in table.schema
        ]
        pq.write_table(table.cast(pa.schema(fields)), temporary, compression="zstd")

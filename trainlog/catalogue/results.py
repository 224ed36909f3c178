"""What was computed of trips: rows in the database, tables in immutable Parquet files beside it.

A file is named by its content and written whole before its rows are, in one transaction: a process
that is killed leaves a file that no row names, nothing else.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import sqlalchemy as sa

from trainlog.catalogue.database import (
    Database,
    columns_of,
    computations,
    files,
    log_of_trip,
    result_files,
    results,
    trips,
)
from trainlog.catalogue.querying import conditions
from trainlog.catalogue.registration import matching, parts
from trainlog.errors import InputError
from trainlog.formats.files import made_folder, sha256 as digest, write_bytes

ResultState = Literal["done", "refused", "failed"]

STATES: tuple[ResultState, ...] = ("done", "refused", "failed")

KEY = "key"
"""Column of a table of results that names the trip of a row."""

ROWS = 50_000
"""Rows of a row group."""

UNFINISHED = 3600.0
"""Age of a file that is still under a temporary name, from which its process is dead [s]."""

ATTEMPTS = 3
"""At reading files of results that another process puts together meanwhile."""

JOINED = ("train", "kind", "line", "start")
"""Columns of trips that stand beside the results."""


@dataclass(frozen=True)
class Computation:
    """An analysis of trips by one code with one set of parameters.

    Attributes
    ----------
    analysis : str
        Its name.
    code : str
        Version of its code.
    parameters : mapping
        Values of JSON.

    Examples
    --------
    >>> Computation("stops", "1", {"b": 2, "a": 1.5}).content
    '{"a":1.5,"b":2}'
    """

    analysis: str
    code: str
    parameters: Mapping[str, Any] = field(default_factory=dict)

    @property
    def content(self) -> str:
        """The parameters as JSON: the same parameters give the same text.

        Raises
        ------
        InputError
            If they are no values of JSON.
        """
        try:
            return json.dumps(
                dict(self.parameters), sort_keys=True, separators=(",", ":"), allow_nan=False
            )
        except (TypeError, ValueError) as error:
            raise InputError(
                f"parameters cannot be stored: {error}", remedy="give numbers, texts, lists"
            ) from error

    @property
    def digest(self) -> str:
        """The digest by which the parameters are known."""
        return digest(self.content.encode())[:32]


@dataclass(frozen=True, slots=True)
class ResultOutcome:
    """What became of the analysis of a trip.

    Attributes
    ----------
    key, sha256 : str
        Of the trip and of its log, as `Catalogue.pending` gave them.
    state : {"done", "refused", "failed"}
    reason : str
        Why there is no result.
    rows : int
        Of the table.
    seconds : float
        That it took [s].
    """

    key: str
    sha256: str
    state: ResultState = "done"
    reason: str = ""
    rows: int = 0
    seconds: float = 0.0


def computation_id(connection: sa.Connection, of: Computation | str) -> int:
    """The row of a computation, of a name that of the latest; -1 if nothing was recorded."""
    if isinstance(of, str):
        asked = sa.select(computations.c.id).where(computations.c.analysis == of)
        found = connection.execute(asked.order_by(computations.c.last.desc()).limit(1))
    else:
        about = {"analysis": of.analysis, "code": of.code, "parameters": of.digest}
        found = connection.execute(sa.select(computations.c.id).filter_by(**about))
    return found.scalar() or -1


def made_computation(connection: sa.Connection, of: Computation) -> int:
    """The row of a computation, made if need be, as the latest of its analysis."""
    last = sa.select(sa.func.coalesce(sa.func.max(computations.c.last), 0) + 1)
    number = computation_id(connection, of)
    values = {"last": connection.execute(last).scalar_one()}
    if number > 0:
        connection.execute(
            sa.update(computations).where(computations.c.id == number).values(values)
        )
        return number
    values |= {"analysis": of.analysis, "code": of.code}
    values |= {"parameters": of.digest, "content": of.content}
    added = sa.insert(computations).values(values).returning(computations.c.id)
    return int(connection.execute(added).scalar_one())


def trips_with_results(number: int, where: str | None, *columns: Any) -> sa.Select[Any]:
    """A statement: columns of the trips that count and that a computation has a row of."""
    return (
        sa.select(*columns)
        .select_from(trips)
        .join(results, trips.c.id == results.c.trip)
        .where(results.c.computation == number, *conditions(where))
    )


def _unmade(computation: int, where: str | None) -> list[sa.ColumnElement[bool]]:
    """What holds for trips of which a computation has no row."""
    made = sa.exists().where(results.c.computation == computation, results.c.trip == trips.c.id)
    return [*conditions(where), ~made, _there()]


def _there() -> sa.ColumnElement[bool]:
    """Whether a log of a trip is present."""
    return sa.exists().where(files.c.trip == trips.c.id, files.c.state == "present")


def is_readable(path: Path) -> bool:
    """Whether a file of results is there, and whole."""
    try:
        pq.read_table(path, partitioning=None, page_checksum_verification=True)
    except (OSError, pa.ArrowInvalid):
        return False
    return True


def unreadable(path: str | Path) -> InputError:
    """That a file of results is missing, or damaged."""
    problem = "is damaged" if Path(path).is_file() else "is missing"
    return InputError(
        f"a file of results {problem}",
        file=path,
        remedy="'trainlog fleet update --retry' computes its trips anew",
    )


def file_id(connection: sa.Connection, computation: int, name: str, rows: int) -> int:
    """The row of a file of results, made if need be."""
    asked = sa.select(result_files.c.id).where(
        result_files.c.computation == computation, result_files.c.name == name
    )
    found = connection.execute(asked).scalar()
    if found is not None:
        return int(found)
    values = {"computation": computation, "name": name, "rows": rows}
    added = sa.insert(result_files).values(values).returning(result_files.c.id)
    return int(connection.execute(added).scalar_one())


def write_table(folder: Path, table: pa.Table) -> str:
    """Write a table under the name of its content; the name."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", row_group_size=ROWS, write_page_checksum=True)
    data = sink.getvalue().to_pybytes()
    target = made_folder(folder) / f"{digest(data)[:32]}.parquet"
    if not target.is_file():
        write_bytes(target, data)
    return target.name


def remove_left(database: Database, folder: Path) -> None:
    """Remove what processes that were killed left: files that none finishes, or no row names.

    Writing a file and naming it takes seconds; what is older than an hour is of no process.
    """
    old = []
    for path in folder.glob("*.parquet"):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > UNFINISHED:
                old.append(path.name)
    remove_unnamed(database, folder, old)


def remove_unnamed(database: Database, folder: Path, names: Iterable[str]) -> None:
    """Remove those of the named files of results that no row names.

    No process names a file meanwhile: that is done in a transaction that writes, too, which finds
    whether the file is there (`record`).
    """
    with database.reading() as connection:
        found = set(names) - _named(connection, folder.name)
    if not found:
        return
    with database.writing() as connection:
        for name in found - _named(connection, folder.name):
            (folder / name).unlink(missing_ok=True)


def _named(connection: sa.Connection, analysis: str) -> set[str]:
    """The files of results of an analysis that rows name."""
    asked = sa.select(result_files.c.name).join(
        computations, computations.c.id == result_files.c.computation
    )
    return set(connection.execute(asked.where(computations.c.analysis == analysis)).scalars())


def _check(table: pa.Table, outcomes: Sequence[ResultOutcome]) -> None:
    """Refuse a table that does not hold the rows that its outcomes state."""
    if KEY not in table.column_names:
        raise InputError(
            f"the table of results has no column '{KEY}'", remedy="name the trip of each row"
        )
    held = {row["values"]: row["counts"] for row in pc.value_counts(table[KEY]).to_pylist()}
    stated = {each.key: each.rows for each in outcomes if each.rows}
    for key in held.keys() | stated.keys():
        if held.get(key, 0) != stated.get(key, 0):
            raise InputError(
                f"the table holds {held.get(key, 0)} rows of trip {key}, its outcome states"
                f" {stated.get(key, 0)}",
                remedy="record each trip with all of its rows",
            )


def recorded(database: Database, of: Computation | str, where: str | None = None) -> pd.DataFrame:
    """The trips of a computation that have rows, with the file that holds them."""
    with database.reading() as connection:
        return _held(connection, computation_id(connection, of), *conditions(where))


def analyses_recorded(connection: sa.Connection) -> list[str]:
    """The analyses that have results, in the order of their names."""
    asked = sa.select(computations.c.analysis).distinct().order_by(computations.c.analysis)
    return list(connection.execute(asked).scalars())


def _joined(folder: Path, rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of trips with what is known of these."""
    if not len(rows):
        return pd.DataFrame(columns=[KEY, *JOINED])
    together: pd.DataFrame = _table_of(folder, rows).to_pandas()
    place = pd.Index(rows[KEY]).get_indexer(together[KEY])
    for name in JOINED:
        if name not in together:
            values = pd.to_datetime(rows[name], utc=True) if name == "start" else rows[name]
            together[name] = values.take(place).array
    return together


def _by_state(
    connection: sa.Connection, *limits: sa.ColumnElement[bool]
) -> dict[int, dict[str, int]]:
    """How many trips each computation has in each state."""
    by = (results.c.computation, results.c.state)
    asked = sa.select(*by, sa.func.count()).join(trips, trips.c.id == results.c.trip)
    found: dict[int, dict[str, int]] = {}
    for computation, state, count in connection.execute(asked.where(*limits).group_by(*by)):
        found.setdefault(computation, dict.fromkeys(STATES, 0))[state] = int(count)
    return found


def _held(
    connection: sa.Connection, computation: int, *limits: sa.ColumnElement[bool]
) -> pd.DataFrame:
    """The trips of a computation that have rows, with the files that hold these."""
    about = (trips.c.key, trips.c.sha256, trips.c.id, results.c.file, result_files.c.name)
    asked = (
        sa.select(*about, *(trips.c[name] for name in JOINED))
        .select_from(results)
        .join(trips, trips.c.id == results.c.trip)
        .join(result_files, result_files.c.id == results.c.file)
        .where(results.c.computation == computation, *limits)
    )
    names = [KEY, "sha256", "trip", "file", "name", *JOINED]
    return pd.DataFrame(columns_of(connection.execute(asked).all(), names))


def _put(
    database: Database, computation: int, once: pd.DataFrame, path: Path, rows: int
) -> list[str] | None:
    """Name one file in place of those of trips; the files that no row names now.

    None if another process changed what was read.
    """
    with database.writing() as connection:
        now = _held(connection, computation).set_index("trip")["file"]
        if now.reindex(once["trip"]).tolist() != once["file"].tolist() or not path.is_file():
            return None
        file = file_id(connection, computation, path.name, rows)
        for part in parts(once["trip"].tolist()):
            asked = sa.update(results).where(
                results.c.computation == computation, results.c.trip.in_(part)
            )
            connection.execute(asked.values(file=file))
        used = sa.exists().where(results.c.file == result_files.c.id)
        gone = sa.delete(result_files).where(result_files.c.computation == computation, ~used)
        return list(connection.execute(gone.returning(result_files.c.name)).scalars())


def _table_of(folder: Path, rows: pd.DataFrame) -> pa.Table:
    """The rows of trips, each of the file that is named beside it, in the order of trip."""
    pieces = []
    for name, group in rows.groupby("name", sort=True):
        path = folder / str(name)
        try:
            table = pq.read_table(path, partitioning=None, page_checksum_verification=True)
        except FileNotFoundError:
            raise
        except (OSError, pa.ArrowInvalid) as error:
            raise unreadable(path) from error
        pieces.append(
            table.filter(pc.is_in(table[KEY], value_set=pa.array(group[KEY].tolist(), pa.string())))
        )
    together = pa.concat_tables(pieces, promote_options="permissive").combine_chunks()
    keys = together[KEY]
    if pc.all(pc.less_equal(keys[:-1], keys[1:]), min_count=0).as_py():
        return together.replace_schema_metadata(None)
    place = pa.array(range(together.num_rows), pa.int64())
    order = pc.sort_indices(
        pa.table({KEY: together[KEY], "place": place}),
        sort_keys=[(KEY, "ascending"), ("place", "ascending")],
    )
    return together.take(order).replace_schema_metadata(None)


class Computed(Database):
    """A catalogue as far as it keeps what was computed of its trips."""

    def _folder_of(self, of: Computation | str) -> Path:
        """Folder of the results of an analysis."""
        return self.results_folder / (of if isinstance(of, str) else of.analysis)

    def pending(
        self,
        of: Computation | str,
        *,
        where: str | None = None,
        page: tuple[str, int] | None = None,
        keys: Sequence[str] | None = None,
    ) -> pd.DataFrame:
        """The trips of which an analysis has not been recorded, in the order of key.

        Those whose logs have vanished are not among them. A log whose content changed is asked for
        anew: what was computed of it before is not of this content.

        Parameters
        ----------
        of : Computation, or str
            By the name of an analysis its latest computation is meant.
        where : str, optional
            As for `query`.
        page : (str, int), optional
            Only trips behind this key, and so many at most.
        keys : sequence of str, optional
            Only of these trips.

        Returns
        -------
        DataFrame
            With the columns ``key``, ``sha256``, ``path`` and ``name``.
        """
        with self.reading() as connection:
            columns = (trips.c.key, trips.c.sha256, log_of_trip(), trips.c.name)
            asked = sa.select(*columns).where(*_unmade(computation_id(connection, of), where))
            if page is not None:
                asked = asked.where(trips.c.key > page[0]).limit(page[1])
            if keys is not None:
                asked = asked.where(trips.c.key.in_(keys))
            rows = connection.execute(asked.order_by(trips.c.key)).all()
        return pd.DataFrame(columns_of(rows, ["key", "sha256", "path", "name"]), dtype=object)

    def standing(self, of: Computation | str, *, where: str | None = None) -> dict[str, int]:
        """How many trips of an analysis are ``done``, ``refused``, ``failed`` and ``pending``.

        Parameters are those of `pending`.
        """
        with self.reading() as connection:
            number = computation_id(connection, of)
            own = results.c.computation == number
            found = _by_state(connection, own, *conditions(where)).get(number, {})
            left = sa.select(sa.func.count()).select_from(trips).where(*_unmade(number, where))
            pending = int(connection.execute(left).scalar_one())
        return {state: found.get(state, 0) for state in STATES} | {"pending": pending}

    def gone(self, where: str | None = None) -> int:
        """How many trips that count have no log any more: all of their files have vanished.

        Nothing more can be computed of them; what was computed stays.

        Parameters
        ----------
        where : str, optional
            Only of the trips that this expression chooses.
        """
        asked = sa.select(sa.func.count()).select_from(trips)
        with self.reading() as connection:
            found = connection.execute(asked.where(*conditions(where), ~_there()))
            return int(found.scalar_one())

    def forget(
        self,
        of: Computation | str,
        *,
        where: str | None = None,
        states: Sequence[ResultState] = ("refused", "failed"),
    ) -> int:
        """Make trips pending again that an analysis refused or failed at; how many.

        And all trips whose file of results is missing or damaged. Parameters are those of
        `pending`, and the states that are forgotten.
        """
        folder = self._folder_of(of)
        # And of trips that do not count: they may count again.
        chosen = sa.select(trips.c.id).where(*conditions(where)[1:])
        with self.reading() as connection:
            number = computation_id(connection, of)
            asked = sa.select(result_files.c.name).where(result_files.c.computation == number)
            names = connection.execute(asked).scalars().all()
        lost = [name for name in names if not is_readable(folder / name)]
        with self.writing() as connection:
            held = sa.select(result_files.c.id).where(
                result_files.c.computation == number, result_files.c.name.in_(lost)
            )
            gone = sa.delete(results).where(
                results.c.computation == number,
                results.c.file.in_(held)
                | (results.c.state.in_(states) & results.c.trip.in_(chosen)),
            )
            count = int(connection.execute(gone).rowcount)
            connection.execute(sa.delete(result_files).where(result_files.c.id.in_(held)))
            for name in lost:  # of the same content as what is computed anew, perhaps
                (folder / name).unlink(missing_ok=True)
            return count

    def forget_overwritten(self, of: Computation) -> set[str]:
        """Forget what is recorded of trips whose logs were overwritten by logs of others.

        Returns
        -------
        set of str
            SHA-256 of the logs of which a result is recorded still.
        """
        old = sa.select(trips.c.id).where(trips.c.standing == "older version")
        with self.writing() as connection:
            own = results.c.computation == computation_id(connection, of)
            connection.execute(sa.delete(results).where(own, results.c.trip.in_(old)))
            left = sa.select(trips.c.sha256).join(results, results.c.trip == trips.c.id)
            return set(connection.execute(left.where(own)).scalars())

    def record(
        self, of: Computation, outcomes: Sequence[ResultOutcome], table: pa.Table | None = None
    ) -> int:
        """Keep what was computed of a batch of trips: the table first, then all rows at once.

        Of a trip that was recorded meanwhile, by another process perhaps, nothing is recorded a
        second time.

        Parameters
        ----------
        of : Computation
        outcomes : sequence of ResultOutcome
            One a trip, of those that gave nothing, too.
        table : pyarrow.Table, optional
            Rows of all of them, with the column ``key``.

        Returns
        -------
        int
            How many were recorded.

        Raises
        ------
        InputError
            If the table does not hold the rows that the outcomes state, or cannot be written.

        Examples
        --------
        >>> import tempfile
        >>> import pyarrow as pa
        >>> from trainlog.catalogue import Computation, ResultOutcome, open_catalogue
        >>> stops = Computation("stops", code="1")
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     todo = catalogue.pending(stops)
        ...     table = pa.table({"key": todo["key"].tolist(), "stops": [8, 0]})
        ...     done = [ResultOutcome(row.key, row.sha256, rows=1) for row in todo.itertuples()]
        ...     recorded = catalogue.record(stops, done, table)
        ...     left = len(catalogue.pending(stops))
        >>> recorded, left
        (2, 0)
        """
        folder, name = self._folder_of(of), None
        if table is not None and table.num_rows:
            _check(table, outcomes)
            name = write_table(folder, table)
        with self.writing() as connection:
            number = made_computation(connection, of)
            there = sa.exists().where(results.c.computation == number, results.c.trip == trips.c.id)
            asked = sa.select(trips.c.sha256, trips.c.id).where(~there)
            digests = {each.sha256 for each in outcomes}
            left = matching(connection, asked, trips.c.sha256, digests)
            ids = {row["sha256"]: row["id"] for row in left}
            new = [each for each in outcomes if each.sha256 in ids]
            if not new:
                return 0
            file = None
            if name is not None and any(each.rows for each in new):
                assert table is not None
                if not (folder / name).is_file():
                    # It stood there, and was removed as one that no row names.
                    write_table(folder, table)
                file = file_id(connection, number, name, table.num_rows)
            rows = [
                {
                    "computation": number,
                    "trip": ids[each.sha256],
                    "state": each.state,
                    "reason": each.reason,
                    "file": file if each.rows else None,
                    "rows": each.rows,
                    "seconds": each.seconds,
                }
                for each in {each.sha256: each for each in new}.values()
            ]
            connection.execute(sa.insert(results), rows)
            return len(rows)

    def results(self, of: Computation | str, *, where: str | None = None) -> pd.DataFrame:
        """The tables of all trips together, in the order of trip, with what is known of these.

        Parameters
        ----------
        of, where
            As for `pending`.

        Returns
        -------
        DataFrame
            The columns of the analysis, with ``key``, and ``train``, ``kind``, ``line`` and
            ``start`` of the trip where it has none of that name.
        """
        for attempt in range(ATTEMPTS):
            try:
                return _joined(self._folder_of(of), recorded(self, of, where))
            except FileNotFoundError as error:
                # Another process merged small files meanwhile: what it made is named now.
                if attempt + 1 == ATTEMPTS:
                    raise unreadable(error.filename or self.results_folder) from error
        raise AssertionError

    def computations(self) -> pd.DataFrame:
        """What was computed of the trips, the latest first.

        Returns
        -------
        DataFrame
            The columns ``analysis``, ``code``, ``parameters`` (a dict), and how many trips are
            ``done``, ``refused`` and ``failed``.
        """
        with self.reading() as connection:
            asked = sa.select(computations).order_by(computations.c.last.desc())
            rows = connection.execute(asked).mappings().all()
            counts = _by_state(connection, *conditions())
        found = [
            {
                "analysis": row["analysis"],
                "code": row["code"],
                "parameters": json.loads(row["content"]),
                **counts[row["id"]],
            }
            for row in rows
            if any(counts.get(row["id"], {}).values())
        ]
        return pd.DataFrame(found, columns=["analysis", "code", "parameters", *STATES])

    def outcomes(
        self,
        of: Computation | str,
        *,
        where: str | None = None,
        states: Sequence[ResultState] = STATES,
        most: int | None = None,
    ) -> pd.DataFrame:
        """What became of the analysis of each trip, in the order of trip.

        Parameters
        ----------
        of, where
            As for `pending`.
        states : sequence of str
            Only of trips of these.
        most : int, optional
            How many are listed at most.

        Returns
        -------
        DataFrame
            The columns ``key``, ``name``, ``train``, ``kind``, ``line``, ``start`` of the trip,
            ``state``, ``reason``, ``rows`` and ``seconds``, and ``path`` of its log.

        Examples
        --------
        >>> import tempfile
        >>> from trainlog.catalogue import Computation, ResultOutcome, open_catalogue
        >>> stops = Computation("stops", code="1")
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     todo = catalogue.pending(stops)
        ...     given = zip(todo["key"], todo["sha256"])
        ...     refused = [ResultOutcome(*each, "refused", "no stop") for each in given]
        ...     _ = catalogue.record(stops, refused)
        ...     found, made = catalogue.outcomes("stops"), catalogue.computations()
        >>> found["reason"].tolist(), made[["analysis", "refused"]].values.tolist()
        (['no stop', 'no stop'], [['stops', 2]])
        """
        about, own = (KEY, "name", *JOINED), ("state", "reason", "rows", "seconds")
        columns = [*(trips.c[name] for name in about), *(results.c[name] for name in own)]
        with self.reading() as connection:
            number = computation_id(connection, of)
            asked = trips_with_results(number, where, *columns, log_of_trip())
            asked = asked.where(results.c.state.in_(states)).order_by(trips.c.key).limit(most)
            rows = connection.execute(asked).all()
        found = pd.DataFrame(columns_of(rows, [*about, *own, "path"]))
        found["start"] = pd.to_datetime(found["start"], utc=True)
        return found

    def compact(self, of: Computation | str) -> int:
        """Put the rows of all trips into one file, in the order of trip; how many files went.

        The same results give the same bytes, in whatever batches and order they were recorded.
        What reads or records meanwhile is not disturbed. Files that killed processes left
        unfinished are removed when they are an hour old.

        Parameters
        ----------
        of
            As for `pending`.
        """
        folder = self._folder_of(of)
        remove_left(self, folder)
        for _ in range(ATTEMPTS):
            with self.reading() as connection:
                number = computation_id(connection, of)
                files_held = sa.select(sa.func.count()).where(result_files.c.computation == number)
                if connection.execute(files_held).scalar_one() < 2:
                    return 0
                rows = _held(connection, number).sort_values([KEY, "sha256"], kind="stable")
            # Of a trip whose log changed there are rows of both contents, each with its file.
            once = rows[~rows.duplicated(KEY)]
            if once["file"].nunique() < 2:
                return 0
            try:
                table = _table_of(folder, once)
            except FileNotFoundError:
                continue  # another process put them together meanwhile
            path = folder / write_table(folder, table)
            removed = _put(self, number, once, path, table.num_rows)
            if removed is not None:
                remove_unnamed(self, folder, removed)
                return len(removed)
        return 0

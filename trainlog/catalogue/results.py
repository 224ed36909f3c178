"""What was computed of trips: rows in the database, tables in immutable Parquet files beside it.

A file is named by its content and written whole before its rows are, in one transaction: a process
that is killed leaves a file that no row names, nothing else.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pandas as pd
import sqlalchemy as sa

from trainlog.catalogue.database import columns_of
from trainlog.catalogue.registration import parts
from trainlog.catalogue.schema import (
    computations,
    files,
    log_of_trip,
    result_files,
    results,
    trips,
)
from trainlog.errors import InputError
from trainlog.formats.files import made_folder, sha256 as digest, write_bytes

if TYPE_CHECKING:
    import pyarrow as pa

    from trainlog.catalogue.database import Database

ResultState = Literal["done", "refused", "failed"]

STATES: tuple[ResultState, ...] = ("done", "refused", "failed")

KEY = "key"
"""Column of a table of results that names the trip of a row."""

ROWS = 50_000
"""Rows of a row group."""

UNFINISHED = 3600.0
"""Age of a file that is still under a temporary name, from which its process is dead [s]."""

JOINED = ("train", "kind", "line", "start")
"""Columns of trips that stand beside the results."""


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


def parameters_text(parameters: Mapping[str, Any] | None) -> str:
    """Parameters as JSON: the same parameters give the same text.

    Raises
    ------
    InputError
        If they are no values of JSON.

    Examples
    --------
    >>> parameters_text({"b": 2, "a": 1.5})
    '{"a":1.5,"b":2}'
    """
    try:
        return json.dumps(
            dict(parameters or {}), sort_keys=True, separators=(",", ":"), allow_nan=False
        )
    except (TypeError, ValueError) as error:
        raise InputError(
            f"parameters cannot be stored: {error}", remedy="give numbers, texts, lists"
        ) from error


def digest_of(parameters: Mapping[str, Any] | None) -> str:
    """The digest by which parameters are known."""
    return digest(parameters_text(parameters).encode())[:32]


def computation_id(
    connection: sa.Connection, analysis: str, code: str, parameters: Mapping[str, Any] | None
) -> int | None:
    """The row of a computation; None if nothing was recorded of it."""
    found = connection.execute(
        sa.select(computations.c.id).where(
            computations.c.analysis == analysis,
            computations.c.code == code,
            computations.c.parameters == digest_of(parameters),
        )
    )
    return found.scalar()


def made_computation(
    connection: sa.Connection, analysis: str, code: str, parameters: Mapping[str, Any] | None
) -> int:
    """The row of a computation, made if need be, as the latest of its analysis."""
    last = sa.select(sa.func.coalesce(sa.func.max(computations.c.last), 0) + 1)
    number = computation_id(connection, analysis, code, parameters)
    latest = connection.execute(last).scalar_one()
    if number is not None:
        asked = sa.update(computations).where(computations.c.id == number)
        connection.execute(asked.values(last=latest))
        return number
    values = {
        "analysis": analysis,
        "code": code,
        "parameters": digest_of(parameters),
        "content": parameters_text(parameters),
        "last": latest,
    }
    added = sa.insert(computations).values(values).returning(computations.c.id)
    return int(connection.execute(added).scalar_one())


def pending(
    database: Database,
    analysis: str,
    code: str,
    parameters: Mapping[str, Any] | None,
    condition: sa.ColumnElement[bool] | None,
    page: tuple[str, int] | None = None,
) -> pd.DataFrame:
    """The trips that count, whose log is present and of which this computation has no row.

    A `page` is the key behind which it begins, and how many trips it has at most.
    """
    with database.reading() as connection:
        number = computation_id(connection, analysis, code, parameters)
        columns = (trips.c.key, trips.c.sha256, log_of_trip(), trips.c.name)
        asked = sa.select(*columns).where(
            *_unmade(number), *([] if condition is None else [condition])
        )
        if page is not None:
            asked = asked.where(trips.c.key > page[0]).limit(page[1])
        rows = connection.execute(asked.order_by(trips.c.key)).all()
    return pd.DataFrame(columns_of(rows, ["key", "sha256", "path", "name"]), dtype=object)


def _unmade(computation: int | None) -> list[sa.ColumnElement[bool]]:
    """What holds for trips of which a computation has no row."""
    made = sa.exists().where(
        results.c.computation == (computation or -1), results.c.trip == trips.c.id
    )
    return [trips.c.standing == "counts", ~made, _there()]


def _there() -> sa.ColumnElement[bool]:
    """Whether a log of a trip is present."""
    return sa.exists().where(files.c.trip == trips.c.id, files.c.state == "present")


def gone(database: Database, condition: sa.ColumnElement[bool] | None) -> int:
    """How many trips that count have no log any more; see `Catalogue.gone`."""
    also = [] if condition is None else [condition]
    asked = sa.select(sa.func.count()).select_from(trips)
    with database.reading() as connection:
        found = connection.execute(asked.where(trips.c.standing == "counts", ~_there(), *also))
        return int(found.scalar_one())


def standing(
    database: Database,
    analysis: str,
    code: str,
    parameters: Mapping[str, Any] | None,
    condition: sa.ColumnElement[bool] | None,
) -> dict[str, int]:
    """How many trips that count a computation has in each state, and how many are pending."""
    also = [] if condition is None else [condition]
    count = sa.func.count()
    with database.reading() as connection:
        number = computation_id(connection, analysis, code, parameters)
        found: dict[str, int] = {}
        if number is not None and not also:
            found = _by_state(connection, results.c.computation == number).get(number, {})
        elif number is not None:
            asked = (
                sa.select(results.c.state, count)
                .join(trips, trips.c.id == results.c.trip)
                .where(results.c.computation == number, trips.c.standing == "counts", *also)
                .group_by(results.c.state)
            )
            found = {str(row[0]): int(row[1]) for row in connection.execute(asked)}
        left = sa.select(count).select_from(trips).where(*_unmade(number), *also)
        pending = int(connection.execute(left).scalar_one())
    return {state: found.get(state, 0) for state in STATES} | {"pending": pending}


def problems(
    database: Database,
    analysis: str,
    code: str,
    parameters: Mapping[str, Any] | None,
    condition: sa.ColumnElement[bool] | None,
    most: int,
) -> pd.DataFrame:
    """Trips that were refused or failed, with the reasons, in the order of key."""
    columns = (trips.c.key, trips.c.name, log_of_trip(), results.c.state, results.c.reason)
    with database.reading() as connection:
        number = computation_id(connection, analysis, code, parameters)
        asked = (
            sa.select(*columns)
            .join(results, results.c.trip == trips.c.id)
            .where(
                results.c.computation == (number or -1),
                results.c.state.in_(("refused", "failed")),
                trips.c.standing == "counts",
                *([] if condition is None else [condition]),
            )
        )
        rows = connection.execute(asked.order_by(trips.c.key).limit(most)).all()
    return pd.DataFrame(rows, columns=["key", "name", "path", "state", "reason"], dtype=object)


def forget(
    database: Database,
    analysis: str,
    code: str,
    parameters: Mapping[str, Any] | None,
    condition: sa.ColumnElement[bool] | None,
    states: Sequence[ResultState],
) -> int:
    """Make trips pending again, see `Catalogue.forget`; how many."""
    folder = database.results / analysis
    chosen = sa.select(trips.c.id).where(*([] if condition is None else [condition]))
    with database.reading() as connection:
        number = computation_id(connection, analysis, code, parameters) or -1
        asked = sa.select(result_files.c.name).where(result_files.c.computation == number)
        names = connection.execute(asked).scalars().all()
    lost = [name for name in names if not is_readable(folder / name)]
    with database.writing() as connection:
        held = sa.select(result_files.c.id).where(
            result_files.c.computation == number, result_files.c.name.in_(lost)
        )
        gone = sa.delete(results).where(
            results.c.computation == number,
            results.c.file.in_(held) | (results.c.state.in_(states) & results.c.trip.in_(chosen)),
        )
        count = int(connection.execute(gone).rowcount)
        connection.execute(sa.delete(result_files).where(result_files.c.id.in_(held)))
        for name in lost:  # of the same content as what is computed anew, perhaps
            (folder / name).unlink(missing_ok=True)
        return count


def is_readable(path: Path) -> bool:
    """Whether a file of results is there, and whole."""
    import pyarrow as pa
    import pyarrow.parquet as pq

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


def record(
    database: Database,
    analysis: str,
    code: str,
    parameters: Mapping[str, Any] | None,
    outcomes: Sequence[ResultOutcome],
    table: pa.Table | None,
) -> int:
    """Write the file of a batch, then its rows in one transaction; how many were recorded."""
    name = None
    if table is not None and table.num_rows:
        _check(table, outcomes)
        name = write_table(database.results / analysis, table)
    with database.writing() as connection:
        number = made_computation(connection, analysis, code, parameters)
        ids: dict[str, int] = {}
        for part in parts(sorted({each.sha256 for each in outcomes})):
            asked = sa.select(trips.c.sha256, trips.c.id).where(trips.c.sha256.in_(part))
            ids |= {row.sha256: row.id for row in connection.execute(asked)}
        known: set[int] = set()
        for part in parts(sorted(ids.values())):
            there = sa.select(results.c.trip).where(
                results.c.computation == number, results.c.trip.in_(part)
            )
            known |= set(connection.execute(there).scalars())
        new = [each for each in outcomes if each.sha256 in ids and ids[each.sha256] not in known]
        if not new:
            return 0
        file = None
        if name is not None and any(each.rows for each in new):
            assert table is not None
            if not (database.results / analysis / name).is_file():
                # It stood there, and was removed as one that no row names.
                write_table(database.results / analysis, table)
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
    import pyarrow as pa
    import pyarrow.parquet as pq

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
    import pyarrow.compute as pc

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


def merged(
    database: Database,
    analysis: str,
    code: str | None,
    parameters: Mapping[str, Any] | None,
    condition: sa.ColumnElement[bool] | None,
    attempts: int = 3,
) -> pd.DataFrame:
    """The rows of all trips that count, in the order of trip; see `Catalogue.results`."""
    for attempt in range(attempts):
        rows = recorded(database, analysis, code, parameters, condition)
        try:
            return _joined(database, analysis, rows)
        except FileNotFoundError as error:
            # Another process merged small files meanwhile: what it made is named now.
            if attempt + 1 == attempts:
                raise unreadable(error.filename or database.results) from error
    raise AssertionError


def recorded(
    database: Database,
    analysis: str,
    code: str | None,
    parameters: Mapping[str, Any] | None,
    condition: sa.ColumnElement[bool] | None,
) -> pd.DataFrame:
    """The trips of a computation that have rows, with the file that holds them."""
    asked = (
        sa.select(trips.c.key, *(trips.c[name] for name in JOINED), result_files.c.name)
        .select_from(results)
        .join(trips, trips.c.id == results.c.trip)
        .join(result_files, result_files.c.id == results.c.file)
        .where(trips.c.standing == "counts")
    )
    if condition is not None:
        asked = asked.where(condition)
    with database.reading() as connection:
        number = latest(connection, analysis, code, parameters)
        rows = connection.execute(asked.where(results.c.computation == (number or -1)))
        return pd.DataFrame(columns_of(rows.all(), [KEY, *JOINED, "name"]))


def latest(
    connection: sa.Connection, analysis: str, code: str | None, parameters: Mapping[str, Any] | None
) -> int | None:
    """The computation asked for: of several the one that was recorded last."""
    asked = sa.select(computations.c.id).where(computations.c.analysis == analysis)
    if code is not None:
        asked = asked.where(computations.c.code == code)
    if parameters is not None:
        asked = asked.where(computations.c.parameters == digest_of(parameters))
    return connection.execute(asked.order_by(computations.c.last.desc()).limit(1)).scalar()


def analyses_recorded(connection: sa.Connection) -> list[str]:
    """The analyses that have results, in the order of their names."""
    asked = sa.select(computations.c.analysis).distinct().order_by(computations.c.analysis)
    return list(connection.execute(asked).scalars())


def _joined(database: Database, analysis: str, rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of trips with what is known of these."""
    if not len(rows):
        return pd.DataFrame(columns=[KEY, *JOINED])
    together: pd.DataFrame = _table_of(database.results / analysis, rows).to_pandas()
    place = pd.Index(rows[KEY]).get_indexer(together[KEY])
    for name in JOINED:
        if name not in together:
            values = pd.to_datetime(rows[name], utc=True) if name == "start" else rows[name]
            together[name] = values.take(place).array
    return together


def _by_state(
    connection: sa.Connection, *only: sa.ColumnElement[bool]
) -> dict[int, dict[str, int]]:
    """How many trips that count each computation has in each state.

    All of them but those that do not count: these are few, and trips are not read one by one.
    """
    by = (results.c.computation, results.c.state)
    every = sa.select(*by, sa.func.count()).where(*only).group_by(*by)
    apart = every.join(trips, trips.c.id == results.c.trip).where(
        sa.text("trips.standing <> 'counts'")
    )
    found: dict[int, dict[str, int]] = {}
    for asked, sign in ((every, 1), (apart, -1)):
        for computation, state, count in connection.execute(asked):
            counts = found.setdefault(computation, dict.fromkeys(STATES, 0))
            counts[state] += sign * int(count)
    return found


def recorded_computations(database: Database) -> pd.DataFrame:
    """What was computed, and of how many trips; see `Catalogue.computations`."""
    with database.reading() as connection:
        asked = sa.select(computations).order_by(computations.c.last.desc())
        rows = connection.execute(asked).mappings().all()
        counts = _by_state(connection)
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


def outcomes_of(
    database: Database,
    analysis: str,
    code: str | None,
    parameters: Mapping[str, Any] | None,
    condition: sa.ColumnElement[bool] | None,
) -> pd.DataFrame:
    """What became of each trip that counts; see `Catalogue.outcomes`."""
    about = (KEY, "name", *JOINED)
    asked = (
        sa.select(*(trips.c[name] for name in about), results.c.state, results.c.reason,
                  results.c.rows, results.c.seconds)
        .join(trips, trips.c.id == results.c.trip)
        .where(trips.c.standing == "counts")
        .order_by(trips.c.key)
    )  # fmt: skip
    if condition is not None:
        asked = asked.where(condition)
    with database.reading() as connection:
        number = latest(connection, analysis, code, parameters)
        rows = connection.execute(asked.where(results.c.computation == (number or -1))).all()
    names = [*about, "state", "reason", "rows", "seconds"]
    found = pd.DataFrame(columns_of(rows, names))
    found["start"] = pd.to_datetime(found["start"], utc=True)
    return found


def compact(
    database: Database,
    analysis: str,
    code: str | None,
    parameters: Mapping[str, Any] | None,
    attempts: int = 3,
) -> int:
    """Put all rows of a computation into one file; how many files it replaces."""
    folder = database.results / analysis
    remove_left(database, folder)
    for _ in range(attempts):
        with database.reading() as connection:
            number = latest(connection, analysis, code, parameters)
            files_held = sa.select(sa.func.count()).where(result_files.c.computation == number)
            if number is None or connection.execute(files_held).scalar_one() < 2:
                return 0
            rows = _held(connection, number)
        # Of a trip whose log changed there are rows of both contents: each has a file of its own.
        once = rows[~rows.duplicated(KEY)]
        if once["file"].nunique() < 2:
            return 0
        try:
            table = _table_of(folder, once)
        except FileNotFoundError:
            continue  # another process put them together meanwhile
        path = folder / write_table(folder, table)
        removed = _put(database, number, once, path, table.num_rows)
        if removed is not None:
            remove_unnamed(database, folder, removed)
            return len(removed)
    return 0


def _held(connection: sa.Connection, computation: int) -> pd.DataFrame:
    """The trips of a computation that have rows, with the files that hold these."""
    asked = (
        sa.select(trips.c.key, trips.c.sha256, trips.c.id, results.c.file, result_files.c.name)
        .select_from(results)
        .join(trips, trips.c.id == results.c.trip)
        .join(result_files, result_files.c.id == results.c.file)
        .where(results.c.computation == computation)
    )
    rows = connection.execute(asked).all()
    found = pd.DataFrame(columns_of(rows, [KEY, "sha256", "trip", "file", "name"]))
    return found.sort_values([KEY, "sha256"], kind="stable", ignore_index=True)


def _put(
    database: Database, computation: int, once: pd.DataFrame, path: Path, rows: int
) -> list[str] | None:
    """Name one file in place of those of trips; the files that no row names now.

    None if another process changed what was read.
    """
    with database.writing() as connection:
        now = _held(connection, computation)
        now = now[now["trip"].isin(once["trip"])]
        if now["file"].tolist() != once["file"].tolist() or not path.is_file():
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
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

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

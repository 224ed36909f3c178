"""The database of a catalogue: its tables and their versions, how it is opened, transactions.

SQLite in write-ahead logging, one file in the catalogue's folder; or PostgreSQL, a schema of its
own. Both hold the same tables. Times are nanoseconds since 1970 UTC; numbers are in SI units, but
kilometres, which are those that stand along the line.

The table `header` states two numbers. `schema` is the version of the tables. `version` is the least
version that a program must know to use them: it is raised when a column changes its meaning or
goes, not when a column or an index is added, so that an earlier trainlog can go on using a
catalogue that a later one has opened. Both steps and header are written in one transaction.
"""

from __future__ import annotations

import secrets
import sqlite3
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.engine import URL, make_url

from trainlog.errors import InputError
from trainlog.extras import require
from trainlog.formats.files import made_folder, sha256
from trainlog.version import __version__

Kind = Literal["text", "time", "number", "count", "json"]


@dataclass(frozen=True, slots=True)
class TripColumn:
    """What is asked of trips: a column of the frame of trips, and a word of an expression.

    Attributes
    ----------
    name : str
    kind : {"text", "time", "number", "count", "json"}
    unit : str
        In which the frame holds it; an expression states the unit with the number.
    meaning : str
    """

    name: str
    kind: Kind
    unit: str
    meaning: str


TRIP_COLUMNS: tuple[TripColumn, ...] = (
    TripColumn("key", "text", "", "digest of what was recorded: the same for all files of a trip"),
    TripColumn("name", "text", "", "of the trip"),
    TripColumn("train", "text", "", "that drove"),
    TripColumn("kind", "text", "", "of the train"),
    TripColumn("line", "text", "", "that it drove on; of a route also the lines it ran over"),
    TripColumn("direction", "text", "", "forward or reverse"),
    TripColumn("start", "time", "", "of the first message, UTC"),
    TripColumn("end", "time", "", "of the last message, UTC"),
    TripColumn("duration", "number", "s", "from the first to the last message"),
    TripColumn("distance", "number", "m", "between the ends of the stretch driven"),
    TripColumn("km_from", "number", "km", "least kilometre of the stretch driven"),
    TripColumn("km_to", "number", "km", "greatest"),
    TripColumn("weather", "text", "", "condition of the rail that the log states"),
    TripColumn("load", "number", "kg", "that the log states"),
    TripColumn("labels", "json", "", "all other facts that the log states"),
    TripColumn("topics", "json", "", "messages of each topic"),
    TripColumn("passport", "json", "", "value of each quantity of the passport"),
    TripColumn("quality", "text", "", "whole, unclosed or damaged"),
    TripColumn("damage", "text", "", "what of the log is lost; empty if nothing is"),
    TripColumn("repairs", "count", "", "that ingesting the recording took"),
    TripColumn("samples", "count", "", "values of the column that identifies the drive"),
    TripColumn("messages", "count", "", "of all topics"),
    TripColumn("software", "text", "", "that made the log"),
    TripColumn("added", "time", "", "when it came into the catalogue, UTC"),
    TripColumn("sha256", "text", "", "of the log"),
)
"""What the catalogue knows of a trip."""

_JSON = sa.JSON(none_as_null=True)
_TEXT = sa.Text().with_variant(sa.Text(collation="C"), "postgresql")
_TYPES: dict[Kind, Any] = {
    "text": _TEXT,
    "time": sa.BigInteger,
    "number": sa.Double,
    "count": sa.BigInteger,
    "json": _JSON,
}
_ID = sa.BigInteger().with_variant(sa.Integer, "sqlite")

metadata = sa.MetaData()

header = sa.Table(
    "header",
    metadata,
    sa.Column("key", sa.Text, primary_key=True),
    sa.Column("value", sa.Text, nullable=False),
)

trips = sa.Table(
    "trips",
    metadata,
    sa.Column("id", _ID, primary_key=True),
    *(
        sa.Column(each.name, _TYPES[each.kind], nullable=each.name not in ("key", "sha256"))
        for each in TRIP_COLUMNS
    ),
    sa.Column("source", sa.Text, nullable=False),
    sa.Column("blocks", sa.LargeBinary, nullable=False),
    sa.Column("standing", sa.Text, nullable=False),
    sa.Column("same_as", _ID),
    sa.Column("share", sa.Double),
    sa.Index("trips_by_content", "sha256", unique=True),
    sa.Index("trips_counting", "key", "standing", "sha256", "id"),
    sa.Index(
        "trips_apart",
        "id",
        sqlite_where=sa.text("standing <> 'counts'"),
        postgresql_where=sa.text("standing <> 'counts'"),
    ),
    sa.Index("trips_by_time", "start", "end"),
    sa.Index("trips_by_train", "train", "start"),
    sa.Index("trips_by_line", "line", "start"),
    sa.Index("trips_by_duration", "duration"),
)
"""One row a log by content. `standing`: ``"counts"``, ``"same drive"`` (another recording of the
drive is fuller, `same_as`, with which it shares `share` of the shorter one) or ``"older version"``
(what stood under the file's name before)."""

files = sa.Table(
    "files",
    metadata,
    sa.Column("id", _ID, primary_key=True),
    sa.Column("path", _TEXT, nullable=False),
    sa.Column("sha256", _TEXT, nullable=False),
    sa.Column("size", sa.BigInteger),
    sa.Column("changed", sa.BigInteger),
    sa.Column("trip", _ID, sa.ForeignKey("trips.id")),
    sa.Column("state", sa.Text, nullable=False),
    sa.Column("reason", sa.Text, nullable=False),
    sa.UniqueConstraint("path", "sha256"),
    sa.Index("files_by_trip", "trip", "state", "path"),
    sa.Index("files_by_content", "sha256"),
    sa.Index("files_by_state", "state"),
)
"""One row a file and content. `state`: ``"present"``, ``"vanished"``, ``"moved"``, ``"replaced"``
(another content stands under its name) or ``"refused"`` (`reason`)."""

trip_edges = sa.Table(
    "trip_edges",
    metadata,
    sa.Column("trip", _ID, sa.ForeignKey("trips.id"), primary_key=True),
    sa.Column("place", sa.Integer, primary_key=True),
    sa.Column("edge", _TEXT, nullable=False),
    sa.Column("km_from", sa.Double),
    sa.Column("km_to", sa.Double),
    sa.Column("direction", sa.Text, nullable=False),
    sa.Index("trip_edges_by_edge", "edge", "trip"),
)
"""The lines that a trip ran over, in its order: those of its route, or its line."""

computations = sa.Table(
    "computations",
    metadata,
    sa.Column("id", _ID, primary_key=True),
    sa.Column("analysis", _TEXT, nullable=False),
    sa.Column("code", _TEXT, nullable=False),
    sa.Column("parameters", _TEXT, nullable=False),
    sa.Column("content", sa.Text, nullable=False),
    sa.Column("last", sa.BigInteger, nullable=False),
    sa.UniqueConstraint("analysis", "code", "parameters"),
)
"""What was computed: an analysis, the version of its code, the digest of its parameters and these
as JSON; `last` counts what was recorded, so that the latest is known."""

result_files = sa.Table(
    "result_files",
    metadata,
    sa.Column("id", _ID, primary_key=True),
    sa.Column("computation", _ID, sa.ForeignKey("computations.id"), nullable=False),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("rows", sa.BigInteger, nullable=False),
    sa.UniqueConstraint("computation", "name"),
)

results = sa.Table(
    "results",
    metadata,
    sa.Column("computation", _ID, sa.ForeignKey("computations.id"), primary_key=True),
    sa.Column("trip", _ID, sa.ForeignKey("trips.id"), primary_key=True),
    sa.Column("state", sa.Text, nullable=False),
    sa.Column("reason", sa.Text, nullable=False),
    sa.Column("file", _ID, sa.ForeignKey("result_files.id")),
    sa.Column("rows", sa.BigInteger, nullable=False),
    sa.Column("seconds", sa.Double),
    sa.Index("results_by_file", "file"),
)
"""One row a log, analysis, code and parameters: ``"done"``, ``"refused"`` or ``"failed"``."""


def log_of_trip() -> Any:
    """The path of the log of a trip, of several copies that of the first that was registered."""
    asked = sa.select(files.c.path).where(files.c.trip == trips.c.id, files.c.state == "present")
    # A sum, so that SQLite finds the files of the trip, not the first file in the order of id.
    first = asked.order_by(files.c.id + 0).limit(1)
    return first.correlate(trips).scalar_subquery().label("path")


def on_line(
    condition: sa.ColumnElement[bool], over: sa.ColumnElement[bool], few: bool = False
) -> Any:
    """Whether a trip is of a line, or ran over one, by a condition on its name and on an edge's.

    Where what else is asked leaves `few` trips, the edges of each are looked at; else the trips of
    the edge are found first.
    """
    if few:
        edge = sa.exists().where(trip_edges.c.trip == trips.c.id, over).correlate(trips)
        return sa.or_(condition, edge)
    return sa.or_(condition, trips.c.id.in_(sa.select(trip_edges.c.trip).where(over)))


_LOCK_WAIT = "60s"
"""How long PostgreSQL waits for those that read a table that is changed."""


@dataclass(frozen=True)
class Step:
    """What makes the tables of a version out of those of the version before.

    Attributes
    ----------
    version : int
    software : str
        The first trainlog that knows this version.
    change : callable
        Given a connection, in the transaction that also states the new version. Its statements name
        tables as they were then: those of this module are of the latest version.
    breaking : bool
        Whether programs that know earlier versions alone can no longer use the tables.
    """

    version: int
    software: str
    change: Callable[[sa.Connection], object]
    breaking: bool = False


def _index_counting_trips(connection: sa.Connection) -> None:
    """What is pending, and how many trips count, is found in indices, without reading trips."""
    for statement in (
        "CREATE INDEX trips_counting ON trips (key, standing, sha256, id)",
        "CREATE INDEX trips_apart ON trips (id) WHERE standing <> 'counts'",
        "DROP INDEX IF EXISTS trips_by_key",
    ):
        connection.execute(sa.text(statement))


STEPS: tuple[Step, ...] = (
    Step(1, "0.1.0", lambda _: None, breaking=True),
    Step(2, "0.1.0", _index_counting_trips),
)
"""From the first version to the latest."""

VERSION = STEPS[-1].version
"""Of the tables."""


def stated() -> dict[str, str]:
    """What the header states of tables of the latest version."""
    needed = [each for each in STEPS if each.breaking][-1]
    return {
        "version": str(needed.version),
        "schema": str(STEPS[-1].version),
        "needs": f"trainlog {needed.software}",
    }


def version_of(found: Mapping[str, str]) -> int:
    """The version of the tables, by their header; the first one stated but `version`."""
    return int(found.get("schema", found.get("version", "1")))


def check(found: Mapping[str, str], place: str) -> None:
    """Refuse tables that this trainlog cannot use.

    Raises
    ------
    InputError
        Names the trainlog that is needed.
    """
    known = STEPS[-1].version
    needed = int(found.get("version", "1"))
    if needed > known:
        needs = found.get("needs") or found.get("migrated by") or found.get("software", "")
        raise InputError(
            f"follows version {needed} of the catalogue's tables; this is trainlog {__version__},"
            f" which knows {known}",
            file=place,
            remedy=f"update trainlog: {needs} or later is needed" if needs else "update trainlog",
        )


def migrate(connection: sa.Connection, server: bool, place: str) -> int | None:
    """Bring the tables to the latest version; their version before, None if they had it.

    Parameters
    ----------
    connection : of `Database.writing`
        Of several processes that open an earlier version at once one does it, while the others
        wait and then find it done.
    server : bool
        Whether it is PostgreSQL.
    place : str
        Of the catalogue, for messages.
    """
    found = {row.key: row.value for row in connection.execute(sa.select(header))}
    check(found, place)
    before = version_of(found)
    steps = [each for each in STEPS if each.version > before]
    if not steps:
        return None
    if server:
        connection.execute(sa.text(f"SET LOCAL lock_timeout = '{_LOCK_WAIT}'"))
    for step in steps:
        step.change(connection)
    new = {**stated(), "migrated by": f"trainlog {__version__}", "migrated from": str(before)}
    connection.execute(sa.delete(header).where(header.c.key.in_(list(new))))
    connection.execute(sa.insert(header), [{"key": k, "value": v} for k, v in new.items()])
    return before


FORMAT = "trainlog/catalogue"
"""Named in the table `header`."""

DATABASE = "catalogue.sqlite"
"""File of the database in a catalogue's folder."""

RESULTS = "results"
"""Folder of the results in a catalogue's folder."""

SCHEMA = "trainlog"
"""Schema of the tables in PostgreSQL where the URL names none."""

PATIENCE = 60.0
"""How long another process that is writing is waited for [s]."""

_LOCK = 0x746C6361
"""Number of the advisory lock that PostgreSQL holds while a process writes: "tlca"."""

_NETWORK_DRIVES = """
9p afs ceph cifs davfs fuse.davfs2 fuse.glusterfs fuse.rclone fuse.s3fs fuse.sshfs glusterfs gpfs
lustre ncpfs nfs nfs3 nfs4 smb2 smb3 smbfs
"""
"""File systems of Linux that several computers share."""


def network_drive(folder: Path, mounts: Path = Path("/proc/mounts")) -> str:
    r"""The kind of the network drive that a folder is on; empty if it is on none, or not known.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     mounts = Path(folder) / "mounts"
    ...     _ = mounts.write_text("disk / ext4 rw 0 0\nserver:/data /srv/data nfs4 rw 0 0\n")
    ...     [network_drive(Path(each), mounts) for each in ("/srv/data/fleet", "/srv/database")]
    ['nfs4', '']
    """
    if str(folder).startswith("\\\\"):
        return "a share of Windows"
    try:
        lines = mounts.read_text("utf-8", "replace").splitlines()
    except OSError:
        return ""
    longest, found = "", ""
    for _, place, kind, *_ in (line.split(" ") for line in lines if line.count(" ") > 1):
        mounted = place.replace("\\040", " ")
        # Of two at one place the later one is seen.
        if len(mounted) >= len(longest) and folder.is_relative_to(mounted):
            longest, found = mounted, kind
    return found if found in _NETWORK_DRIVES.split() else ""


def columns_of(rows: Sequence[Any], names: Sequence[str]) -> dict[str, tuple[Any, ...]]:
    """The columns of rows, for a frame, which would look at rows of SQLAlchemy one by one.

    Examples
    --------
    >>> columns_of([(1, "a"), (2, "b")], ["number", "letter"])
    {'number': (1, 2), 'letter': ('a', 'b')}
    """
    columns = zip(*rows, strict=True) if rows else [()] * len(names)
    return dict(zip(names, columns, strict=True))


class Database:
    """The database of a catalogue, open.

    Parameters
    ----------
    where : str or Path
        A folder, or a URL ``postgresql://user@host/database?schema=name``.
    results : path, optional
        Folder of the results, stored in a database that is made; needed with a URL then.
    create : bool
        Whether it is made where there is none.

    Raises
    ------
    InputError
        If there is none and none is to be made, it is of a later version, or cannot be reached.
    """

    version: int
    """Of its tables."""

    migrated_from: int | None = None
    """Version that its tables had before they were brought to the latest; None if they had it."""

    def __init__(
        self, where: str | Path, results: str | Path | None = None, *, create: bool = True
    ) -> None:
        text = str(where)
        self.is_server = "://" in text
        self.schema = SCHEMA
        if self.is_server:
            url = self._server(text)
            self.place = url.render_as_string(hide_password=True)
        else:
            self.folder = Path(where).expanduser().absolute()
            if not create and not (self.folder / DATABASE).is_file():
                raise InputError(
                    "has no catalogue",
                    file=where,
                    remedy="make one with 'trainlog fleet add', or name another",
                )
            if create:
                made_folder(self.folder)
            kind = network_drive(self.folder)
            if kind:
                raise InputError(
                    f"is on a network drive ({kind}), where SQLite does not keep processes apart",
                    file=where,
                    remedy="name a folder on a disk of this computer, or a PostgreSQL database",
                )
            url = URL.create("sqlite", database=str(self.folder / DATABASE))
            self.place = str(where)
        self.engine = self._engine(url)
        try:
            with self._reached():
                self._prepare(results, create)
        except BaseException:
            self.engine.dispose()
            raise

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """A connection that sees one state of the database, that of its first statement."""
        with self._reached(), self.engine.connect() as connection:
            if self.is_server:
                connection.execution_options(isolation_level="REPEATABLE READ")
            with connection.begin():
                yield connection

    @contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """A transaction that writes; one at a time, others wait. All of it is kept, or nothing."""
        with self._reached(), self.engine.connect() as connection:
            connection.execution_options(writes=True)
            with connection.begin():
                if self.is_server:
                    lock = sa.func.pg_advisory_xact_lock(_LOCK, sa.func.hashtext(self.schema))
                    connection.execute(sa.select(lock))
                yield connection

    @contextmanager
    def alone(self, what: str) -> Iterator[None]:
        """Do something that one process does at a time; others wait, however long it takes.

        Unlike `writing` it keeps no other from reading and writing meanwhile. Whatever ends a
        process ends its turn.
        """
        if self.is_server:
            words = sa.func.hashtext(f"{self.schema} {what}")
            with self._reached(), self.engine.connect() as connection, connection.begin():
                connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_LOCK + 1, words)))
                yield
            return
        # A database of its own, that holds nothing: its lock goes with its process.
        own = sqlite3.connect(self.folder / f"{what}.lock", timeout=0.1, isolation_level=None)
        try:
            while True:
                try:
                    own.execute("BEGIN EXCLUSIVE")
                    break
                except sqlite3.OperationalError as error:
                    if "locked" not in str(error):
                        raise
            yield
        finally:
            own.close()

    @contextmanager
    def claims(self) -> Iterator[Callable[..., bool]]:
        """``claim(name)`` takes what no other process has; ``claim(name, False)`` frees it.

        It returns whether that was done, without waiting. What a process has is free when it ends.
        """
        if self.is_server:
            with self._reached(), self.engine.connect() as connection:
                connection.execution_options(isolation_level="AUTOCOMMIT")

                def locked(name: str, take: bool = True) -> bool:
                    words = sa.func.hashtext(f"{self.schema} {name}")
                    lock = sa.func.pg_try_advisory_lock if take else sa.func.pg_advisory_unlock
                    return bool(connection.execute(sa.select(lock(_LOCK + 2, words))).scalar())

                try:
                    yield locked
                finally:
                    connection.execute(sa.select(sa.func.pg_advisory_unlock_all()))
            return
        with suppress(ImportError):
            import fcntl

            with (self.folder / "claims.lock").open("ab") as file:

                def reserved(name: str, take: bool = True) -> bool:
                    place = int(sha256(name.encode())[:15], 16)
                    kind = fcntl.LOCK_EX | fcntl.LOCK_NB if take else fcntl.LOCK_UN
                    try:
                        fcntl.lockf(file, kind, 1, place)
                    except (BlockingIOError, PermissionError):
                        return False
                    return True

                yield reserved
            return
        yield lambda *_: True

    @contextmanager
    def _reached(self) -> Iterator[None]:
        """What a database cannot do, stated as an error of ours."""
        try:
            yield
        except sa.exc.DBAPIError as error:
            words = " ".join(str(error.orig).split())
            full = any(each in words for each in ("is full", "disk I/O", "No space left"))
            reached = "check that it can be reached and written"
            remedy = "free some space on its disk" if full else reached
            raise InputError(
                f"the database refuses: {words}",
                file=self.place,
                remedy=f"{remedy}, then do it again: what was begun was undone",
            ) from error

    def _server(self, text: str) -> URL:
        require("psycopg")
        try:
            url = make_url(text)
        except sa.exc.ArgumentError as error:
            raise InputError(
                "the URL of the catalogue is not valid",
                remedy="write it as postgresql://user@host/database",
            ) from error
        if url.get_backend_name() not in ("postgresql", "postgres"):
            raise InputError(
                f"'{url.get_backend_name()}' is not a database for a catalogue",
                remedy="give a folder, or postgresql://user@host/database",
            )
        schema = url.query.get("schema", SCHEMA)
        self.schema = schema if isinstance(schema, str) else schema[0]
        return url.set(drivername="postgresql+psycopg").difference_update_query(["schema"])

    def _engine(self, url: URL) -> sa.Engine:
        waits = {"connect_timeout": 10} if self.is_server else {"timeout": PATIENCE}
        engine = sa.create_engine(url, pool_size=2, connect_args=waits)

        @event.listens_for(engine, "connect")
        def connected(connection: Any, _: Any) -> None:
            if self.is_server:
                with connection.cursor() as cursor:
                    name = '"' + self.schema.replace('"', '""') + '"'
                    cursor.execute(f"SET search_path TO {name}")
                connection.commit()
                return
            connection.isolation_level = None
            for pragma in ("foreign_keys=ON", "case_sensitive_like=ON", "synchronous=FULL"):
                connection.execute(f"PRAGMA {pragma}")

        if not self.is_server:

            @event.listens_for(engine, "begin")
            def begun(connection: sa.Connection) -> None:
                writes = connection.get_execution_options().get("writes")
                connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

        return engine

    def _prepare(self, results: str | Path | None, create: bool) -> None:
        """Make the tables if need be, check their version, find the folder of the results."""
        found = self._header()
        if not found:
            if not create:
                raise InputError("has no catalogue", file=self.place, remedy="name another")
            self._make(results)
            found = self._header()
        check(found, self.place)
        self.version = version_of(found)
        if self.version < VERSION:
            with self.writing() as connection:
                self.migrated_from = migrate(connection, self.is_server, self.place)
            self.version = version_of(self._header())
        if self.migrated_from is not None:
            warnings.warn(
                f"{self.place}: the tables of the catalogue were brought from version"
                f" {self.migrated_from} to {self.version}",
                stacklevel=5,
            )
        self.created_by = found.get("software", "")
        stored = found.get("results", "")
        if self.is_server:
            self.results_folder = Path(stored)
            if results is not None and Path(results).absolute() != self.results_folder:
                raise InputError(
                    f"keeps its results in {self.results_folder}, not in {results}",
                    file=self.place,
                    remedy="leave --results out",
                )
        else:
            self.results_folder = self.folder / RESULTS

    def _header(self) -> dict[str, str]:
        with self.engine.connect() as connection:
            if not sa.inspect(connection).has_table("header"):
                return {}
            return {row.key: row.value for row in connection.execute(sa.select(header))}

    def _make(self, results: str | Path | None) -> None:
        if self.is_server and results is None:
            raise InputError(
                "the database has no catalogue yet, and a new one needs a folder for its results",
                file=self.place,
                remedy="name one that all computers see with --results",
            )
        if not self.is_server:
            with self.engine.connect() as connection:
                raw = connection.connection.driver_connection
                assert raw is not None
                (mode,) = raw.execute("PRAGMA journal_mode=WAL").fetchone()
                if mode != "wal":
                    raise InputError(
                        "its disk does not let SQLite write ahead",
                        file=self.place,
                        remedy="name a folder on a disk of this computer, or a PostgreSQL database",
                    )
        with self.writing() as connection:
            if self.is_server:
                name = '"' + self.schema.replace('"', '""') + '"'
                connection.execute(sa.text(f"CREATE SCHEMA IF NOT EXISTS {name}"))
            metadata.create_all(connection)
            if connection.execute(sa.select(sa.func.count()).select_from(header)).scalar():
                return
            known = {
                "format": FORMAT,
                **stated(),
                "software": f"trainlog {__version__}",
                "identifier": secrets.token_hex(16),
                "results": str(Path(results).absolute()) if results is not None else "",
            }
            rows = [{"key": key, "value": value} for key, value in known.items()]
            connection.execute(sa.insert(header), rows)

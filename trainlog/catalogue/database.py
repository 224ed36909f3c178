"""The database of a catalogue: how it is opened, and transactions that write.

SQLite in write-ahead logging, one file in the catalogue's folder; or PostgreSQL, a schema of its
own. Both hold the same tables, those of `trainlog.catalogue.schema`.
"""

from __future__ import annotations

import secrets
import sqlite3
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.engine import URL, make_url

from trainlog.catalogue import migration
from trainlog.catalogue.schema import header, metadata
from trainlog.errors import InputError
from trainlog.extras import require
from trainlog.formats.files import made_folder
from trainlog.version import __version__

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
        lines = [line.split(" ") for line in mounts.read_text("utf-8", "replace").splitlines()]
    except OSError:
        return ""
    found = max(
        (
            (len(place), number, kind)
            for number, (place, kind) in enumerate(
                (each[1].replace("\\040", " "), each[2]) for each in lines if len(each) > 2
            )
            if folder.is_relative_to(place)
        ),
        default=(0, 0, ""),
    )
    return found[2] if found[2] in _NETWORK_DRIVES.split() else ""


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
                    "holds no catalogue",
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
                "the URL of the catalogue is none",
                remedy="write it as postgresql://user@host/database",
            ) from error
        if url.get_backend_name() not in ("postgresql", "postgres"):
            raise InputError(
                f"'{url.get_backend_name()}' is no database that holds a catalogue",
                remedy="give a folder, or postgresql://user@host/database",
            )
        schema = url.query.get("schema", SCHEMA)
        self.schema = schema if isinstance(schema, str) else schema[0]
        return url.set(drivername="postgresql+psycopg").difference_update_query(["schema"])

    def _engine(self, url: URL) -> sa.Engine:
        engine = sa.create_engine(url, pool_size=2, connect_args=self._arguments())

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

    def _arguments(self) -> dict[str, Any]:
        return {"connect_timeout": 10} if self.is_server else {"timeout": PATIENCE}

    def _prepare(self, results: str | Path | None, create: bool) -> None:
        """Make the tables if need be, check their version, find the folder of the results."""
        found = self._header()
        if not found:
            if not create:
                raise InputError("holds no catalogue", file=self.place, remedy="name another")
            self._make(results)
            found = self._header()
        migration.check(found, self.place)
        self.version = migration.version_of(found)
        if self.version < migration.VERSION:
            with self.writing() as connection:
                self.migrated_from = migration.migrate(connection, self.is_server, self.place)
            self.version = migration.version_of(self._header())
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
                "the database holds no catalogue yet, and a new one needs a folder for its results",
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
                **migration.stated(),
                "software": f"trainlog {__version__}",
                "identifier": secrets.token_hex(16),
                "results": str(Path(results).absolute()) if results is not None else "",
            }
            rows = [{"key": key, "value": value} for key, value in known.items()]
            connection.execute(sa.insert(header), rows)

"""The SQLite database in the file of a track-condition map: tables, rows, checksums, refusals."""

from __future__ import annotations

import json
import os
import secrets
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from trainlog.errors import InputError
from trainlog.formats.files import mistaken_map, plain, sha256, writing_error
from trainlog.formats.recordings import Row, packed_evidence, sealed
from trainlog.railway.condition import TrackConditionMap
from trainlog.railway.evidence import DailyEvidence

APPLICATION = 0x746C6D70
"""SQLite's application_id of a map: "tlmp"."""

VERSION = 1
"""Of the format; SQLite's user_version."""

PATIENCE = 60.0
"""How long another process that is writing is waited for [s]."""

_TABLES = """
CREATE TABLE header (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE trips (
    key TEXT PRIMARY KEY, layer TEXT NOT NULL, start INTEGER, end INTEGER, first_day INTEGER,
    last_day INTEGER, steps INTEGER NOT NULL, entry TEXT NOT NULL, identity TEXT, evidence TEXT,
    counted INTEGER NOT NULL, digest TEXT NOT NULL
) WITHOUT ROWID;
CREATE INDEX trips_by_time ON trips (start, end);
CREATE TABLE evidence (digest TEXT PRIMARY KEY, data BLOB NOT NULL);
CREATE TABLE sums (layer TEXT PRIMARY KEY, digest TEXT NOT NULL, data BLOB NOT NULL);
CREATE TABLE estimates (layer TEXT PRIMARY KEY, made_from TEXT NOT NULL, data BLOB NOT NULL);
CREATE TABLE files (
    path TEXT PRIMARY KEY, size INTEGER NOT NULL, changed INTEGER NOT NULL, sha256 TEXT NOT NULL
);
"""

REFUSED = """
CREATE TABLE IF NOT EXISTS refused (
    sha256 TEXT PRIMARY KEY, path TEXT NOT NULL, reason TEXT NOT NULL, tried TEXT NOT NULL
)
"""
"""A table that a map has once a log was refused."""

HAS_REFUSED = "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'refused'"

SELECT = f"SELECT {', '.join((*Row._fields, 'digest'))} FROM trips"
INSERT = f"INSERT INTO trips VALUES ({', '.join('?' * (len(Row._fields) + 1))})"


# ----------------------------------------------------------------------------------- rows


def replace_row(database: sqlite3.Connection, row: Row, **changes: Any) -> Row:
    """Change a row; the new one."""
    new = row._replace(**changes)
    database.execute(
        "UPDATE trips SET evidence = ?, counted = ?, digest = ? WHERE key = ?",
        (new.evidence, new.counted, new.full[-1], new.key),
    )
    return new


def add_to_total(database: sqlite3.Connection, rows: Sequence[Row]) -> None:
    """Add rows to the number that stands for all, or take away those that are part of it."""
    (known,) = database.execute("SELECT value FROM header WHERE key = 'total'").fetchone()
    total = f"{int(known, 16) ^ _joined_digests(row.full[-1] for row in rows):016x}"
    database.execute("UPDATE header SET value = ? WHERE key = 'total'", (total,))


def set_total(database: sqlite3.Connection) -> None:
    """Set the number that stands for all rows."""
    total = f"{total_in(database):016x}"
    database.execute("INSERT OR REPLACE INTO header VALUES ('total', ?)", (total,))


def total_in(database: sqlite3.Connection) -> int:
    """The number that stands for all rows, of their digests."""
    digests = database.execute("SELECT digest FROM trips UNION ALL SELECT digest FROM sums")
    return _joined_digests(digest for (digest,) in digests)


def _joined_digests(digests: Iterable[str]) -> int:
    """A number for all rows, whatever their order, to which more can be added or taken away."""
    return reduce(xor, (int(digest[:16], 16) for digest in digests), 0)


def insert_sums(database: sqlite3.Connection, layer: str, evidence: DailyEvidence) -> None:
    """Put the sums of a layer in the place of those that are there."""
    raw = packed_evidence(evidence)
    values = (layer, sha256(layer.encode() + raw), zlib.compress(raw))
    database.execute("INSERT OR REPLACE INTO sums VALUES (?, ?, ?)", values)


def amount_in(database: sqlite3.Connection, sums: Iterable[DailyEvidence]) -> tuple[int, int]:
    """How many trips count, and of how many days; those of evidence that was added up, too."""
    (trips,) = database.execute("SELECT count(*) FROM trips WHERE counted").fetchone()
    days = database.execute(
        "SELECT DISTINCT first_day, last_day FROM trips WHERE counted AND first_day IS NOT NULL"
    ).fetchall()
    found = {day for each in sums for day in each.days.tolist()}
    return int(trips), len(found.union(*(range(first, last + 1) for first, last in days)))


# ------------------------------------------------------------------------------ the database


def begin(path: Path, empty: TrackConditionMap) -> None:
    """Begin a file, unless another process has just done so."""
    with new_database(empty) as database:
        data = serialized(database)
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        with temporary.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        try:
            os.link(temporary, path)
        except FileExistsError:
            return
        except OSError:
            # A file system without links.
            if not path.exists():
                temporary.rename(path)
    except OSError as error:
        raise writing_error(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def new_database(empty: TrackConditionMap) -> Iterator[sqlite3.Connection]:
    """A database in memory with the header of a map, in a transaction."""
    database = sqlite3.connect(":memory:", isolation_level=None)
    try:
        database.execute(f"PRAGMA application_id = {APPLICATION}")
        database.execute(f"PRAGMA user_version = {VERSION}")
        database.executescript(_TABLES)
        database.execute("BEGIN")
        header = {
            "line": empty.line,
            "length": empty.length,
            "bin_length": empty.bin_length,
            "levels": plain(empty.levels, "levels"),
            "settings": plain(empty.settings, "settings"),
        }
        for key in sorted(header):
            text = json.dumps(header[key], sort_keys=True, ensure_ascii=False, allow_nan=False)
            database.execute("INSERT INTO header VALUES (?, ?)", (key, text))
        stated = dict(database.execute("SELECT key, value FROM header"))
        database.execute("INSERT INTO header VALUES ('digest', ?)", (_digest_of_header(stated),))
        yield database
    finally:
        database.close()


def serialized(database: sqlite3.Connection, *, in_order: bool = False) -> bytes:
    """The bytes of a database; which release of SQLite wrote them is left out.

    One whose rows were inserted in the order of their keys is compact already.
    """
    set_total(database)
    database.execute("COMMIT")
    if not in_order:
        database.execute("VACUUM")
    data = database.serialize()
    return b"".join((data[:96], bytes(4), memoryview(data)[100:]))


_HEADER = ("bin_length", "length", "levels", "line", "settings")


def _digest_of_header(known: Mapping[str, str]) -> str:
    return sealed([known[key] for key in _HEADER])


def header_of(known: Mapping[str, str]) -> TrackConditionMap:
    """The map without layers and trips that a header describes; it is verified."""
    if _digest_of_header(known) != known["digest"]:
        raise ValueError("its header was changed")
    values = {key: json.loads(known[key]) for key in _HEADER}
    return TrackConditionMap(
        line=values["line"],
        length=float(values["length"]),
        bin_length=float(values["bin_length"]),
        levels=np.asarray(values["levels"], dtype=np.float64),
        layers={},
        settings=values["settings"],
    )


# --------------------------------------------------------------------------------- refusals


def check_start(start: bytes, file: str | Path) -> None:
    """Refuse what is no SQLite database."""
    if not start.startswith(b"SQLite format 3\0"):
        problem, remedy = mistaken_map(start)
        raise InputError(problem, file=file, remedy=remedy)


def check_kind(database: sqlite3.Connection, file: str | Path) -> None:
    """Refuse a database that is no map, or one of another version."""
    (application,) = database.execute("PRAGMA application_id").fetchone()
    (version,) = database.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION:
        raise InputError(
            "is an SQLite database, but holds no track-condition map",
            file=file,
            remedy="name a map that 'trainlog map update' made",
        )
    if version != VERSION:
        raise InputError(
            f"follows version {version} of the format of maps, this trainlog knows {VERSION}",
            file=file,
            remedy="update trainlog" if version > VERSION else "build the map anew from the logs",
        )


@contextmanager
def refusing(file: str | Path) -> Iterator[None]:
    """Errors of SQLite as what a user can do about them."""
    try:
        yield
    except sqlite3.Error as error:
        _refuse(file, error)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        # A value is not what the table says that it is.
        raise damaged(file, "database", str(error)) from error


def _refuse(file: str | Path, error: sqlite3.Error) -> NoReturn:
    words = str(error)
    if "locked" in words or "busy" in words:
        raise InputError(
            f"is being written by another process for more than {PATIENCE:g} s",
            file=file,
            remedy="try again when it has ended",
        ) from error
    if "readonly" in words or "unable to open" in words:
        raise InputError(
            f"cannot be written: {words}",
            file=file,
            remedy="choose a folder you may write to; what an interrupted update left must be"
            " undone by one who may",
        ) from error
    if "full" in words or "disk I/O" in words:
        raise InputError(
            f"cannot be written: {words}",
            file=file,
            remedy="free some space on the disk and try again; what was acknowledged is kept",
        ) from error
    raise damaged(file, "database", words) from error


def damaged(file: str | Path, place: str, what: str) -> InputError:
    """The error that states what of a file is damaged."""
    return InputError(
        f"is damaged: {' '.join(what.split())[:120]}",
        file=file,
        place=place,
        remedy="take a copy of it, or build the map anew from the logs (trainlog map update)",
    )

"""The file of a track-condition map: an SQLite database to which several processes add trips.

Every recording that was given is kept with its evidence; which of them count is decided anew among
the recordings of a drive whenever one comes. What a file holds is therefore a set that only grows,
and the map a function of that set: it does not depend on the order in which trips came, nor on how
they were divided between files that were merged.
"""

from __future__ import annotations

import json
import os
import secrets
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn, Self

import numpy as np

from trainlog.errors import InputError
from trainlog.formats.files import (
    mistaken_map,
    plain,
    refuse_reading,
    sha256,
    writing_error,
)
from trainlog.formats.packed import unpack
from trainlog.formats.recordings import (
    COLUMNS,
    Appended,
    Recording,
    Row,
    changed_row,
    packed_evidence,
    place_of,
    row_of,
    sealed,
    total_of,
)
from trainlog.identity import (
    identity_from_text,
    same_drives,
)
from trainlog.railway.condition import ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence

SUFFIX = ".map"

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
_SELECT = f"SELECT {', '.join((*COLUMNS, 'digest'))} FROM trips"
INSERT = f"INSERT INTO trips VALUES ({', '.join('?' * (len(COLUMNS) + 1))})"


class MapFile:
    """A map's file that is open; close it, or use it in a ``with`` statement.

    Parameters
    ----------
    path : path
    empty : TrackConditionMap, optional
        What to begin the file with if it does not exist: the line, the bins and the settings.

    Raises
    ------
    InputError
        If the file does not exist and `empty` is not given, cannot be read or written, is of
        another kind or a later version, or is damaged.
    """

    def __init__(self, path: str | Path, empty: TrackConditionMap | None = None) -> None:
        self.path = Path(path)
        if empty is not None and not self.path.exists():
            _begin(self.path, empty)
        try:
            with self.path.open("rb") as stream:
                start = stream.read(4096)
        except OSError as error:
            refuse_reading(self.path, error)
        _check_start(start, self.path)
        with _refusing(self.path):
            name = f"{self.path.absolute().as_uri()}?mode=rw"
            self._database = sqlite3.connect(
                name, timeout=PATIENCE, isolation_level=None, uri=True, check_same_thread=False
            )
            # Durable when a trip is acknowledged, also after a power cut.
            self._database.execute("PRAGMA synchronous = EXTRA")
            _check_kind(self._database, self.path)

    @classmethod
    def of_bytes(cls, data: bytes, file: str | Path) -> Self:
        """A copy in memory of the bytes of a file; `file` is what errors call it."""
        _check_start(data[:4096], file)
        found = cls.__new__(cls)
        found.path = Path(file)
        found._database = sqlite3.connect(":memory:", isolation_level=None)
        with _refusing(file):
            found._database.deserialize(data)
            _check_kind(found._database, file)
        return found

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; what was not committed is undone."""
        self._database.close()

    # ------------------------------------------------------------------------------ reading

    @property
    def empty(self) -> TrackConditionMap:
        """The map without its layers and trips."""
        with _refusing(self.path):
            return _header_of(dict(self._database.execute("SELECT key, value FROM header")))

    @property
    def without_evidence(self) -> TrackConditionMap:
        """The map with its layers, in which nothing is."""
        track = self.empty
        with _refusing(self.path):
            names = self._database.execute("SELECT layer FROM trips UNION SELECT layer FROM sums")
            none = ConditionLayer.unestimated(DailyEvidence.none(track.bins, track.levels.size))
            return replace(track, layers={name: none for (name,) in names})

    @contextmanager
    def unchanging(self) -> Iterator[None]:
        """What is read within is of one moment, whatever other processes add."""
        with _refusing(self.path):
            self._database.execute("BEGIN")
            try:
                yield
            finally:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")

    def rows(self, where: str = "", values: Sequence[Any] = ()) -> list[Row]:
        """Rows of the trips; each is verified."""
        found = []
        with _refusing(self.path):
            for row in self._database.execute(f"{_SELECT} {where}", tuple(values)):
                if sealed(row[:-1]) != row[-1]:
                    raise _damaged(self.path, f"trip {str(row[0])[:16]}", "its entry was changed")
                found.append(Row(*row[:-1]))
        return found

    def held(self, key: str) -> Row | None:
        """The recording of a key."""
        return next(iter(self.rows("WHERE key = ?", (key,))), None)

    def evidence(self, digest: str) -> DailyEvidence:
        """The evidence of a digest."""
        with _refusing(self.path):
            found = self._database.execute("SELECT data FROM evidence WHERE digest = ?", (digest,))
            data = found.fetchone()
        return self._unpacked(data[0] if data else b"", digest)

    def blobs(self) -> dict[str, bytes]:
        """All evidence of single trips, compressed, by digest."""
        with _refusing(self.path):
            return dict(self._database.execute("SELECT digest, data FROM evidence"))

    def sums(self) -> dict[str, DailyEvidence]:
        """The evidence that was added up, by layer."""
        with _refusing(self.path):
            rows = self._database.execute("SELECT layer, digest, data FROM sums").fetchall()
            return {layer: self._unpacked(data, digest, layer) for layer, digest, data in rows}

    def _unpacked(self, data: bytes, digest: str, layer: str = "") -> DailyEvidence:
        try:
            raw = zlib.decompress(data)
            if sha256(layer.encode() + raw) != digest:
                raise ValueError("its checksum fails")
            facts, arrays = unpack(raw)
            return DailyEvidence(facts["bins"], facts["levels"], **arrays)
        except (zlib.error, ValueError, TypeError, KeyError) as error:
            raise _damaged(self.path, f"evidence {digest[:16]}", str(error)) from error

    def trips(self) -> list[Row]:
        """All recordings; that none is missing is verified."""
        found = self.rows("ORDER BY layer, first_day, key")
        with _refusing(self.path):
            sums = [digest for (digest,) in self._database.execute("SELECT digest FROM sums")]
            total = self._database.execute("SELECT value FROM header WHERE key = 'total'")
            known = total.fetchone()
            if known is None or int(known[0], 16) != total_of(found, sums):
                raise _damaged(self.path, "table of trips", "entries are missing")
        return found

    def layers(self, trips: Sequence[Row]) -> dict[str, tuple[DailyEvidence, str]]:
        """Evidence of the trips by layer, added up, and a digest of what it was added up from."""
        with _refusing(self.path):
            sums = self._database.execute("SELECT layer, digest, data FROM sums").fetchall()
            known = {layer: self._unpacked(data, digest, layer) for layer, digest, data in sums}
            digests = {layer: digest for layer, digest, _ in sums}
        pieces: dict[str, list[str]] = {layer: [] for layer in known}
        for row in trips:
            for layer, digest in row.pieces.items() if row.counted else ():
                pieces.setdefault(layer, []).append(digest)
        found = {}
        for layer in sorted(pieces):
            made_from = [digests.get(layer, ""), *sorted(pieces[layer])]
            total = DailyEvidence.total(
                [
                    *([known[layer]] if layer in known else []),
                    *_subtotals(self.evidence(each) for each in pieces[layer]),
                ]
            )
            found[layer] = total, sha256("\n".join(made_from).encode())
        return found

    def amount(self) -> tuple[int, int]:
        """How many trips count, and of how many days."""
        with _refusing(self.path):
            (trips,) = self._database.execute("SELECT count(*) FROM trips WHERE counted").fetchone()
            days = self._database.execute(
                "SELECT DISTINCT first_day, last_day FROM trips"
                " WHERE counted AND first_day IS NOT NULL"
            ).fetchall()
        return int(trips), len({day for first, last in days for day in range(first, last + 1)})

    def estimate(self, layer: str, made_from: str) -> bytes | None:
        """The estimate of a layer that was kept, if it was made from this; else None."""
        with _refusing(self.path):
            found = self._database.execute(
                "SELECT data FROM estimates WHERE layer = ? AND made_from = ?", (layer, made_from)
            ).fetchone()
        with suppress(zlib.error, TypeError):
            return None if found is None else zlib.decompress(found[0])
        return None

    # ------------------------------------------------------------------------------ writing

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """A transaction: what is done within is there whole, or not at all."""
        with _refusing(self.path):
            self._database.execute("BEGIN IMMEDIATE")
            try:
                yield self._database
                self._database.execute("COMMIT")
            finally:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")

    def append(self, recording: Recording) -> Appended:
        """Add a recording, and decide which recordings of its drive count.

        When this returns, the recording is on the disk.
        """
        with self._writing() as database:
            before = self.held(recording.key)
            if before is not None:
                return Appended(bool(before.counted), held=True)
            row = self._insert(recording)
            together = self._of_the_drive(row)
            reasons = reasons_of(together)
            replaced: list[str] = []
            changed = [row]
            for each in together:
                counts = each.key not in reasons
                if each.key != row.key and each.counted and not counts:
                    replaced.append(each.known.name)
                if bool(each.counted) != counts and each.evidence is not None:
                    changed += [each, _replaced(database, each, counted=int(counts))]
            _add_to_total(database, changed)
            database.execute("INSERT OR IGNORE INTO header VALUES ('live', '1')")
        reason = reasons.get(row.key, "")
        return Appended(not reason, reason=reason, replaced=tuple(replaced))

    def _insert(self, recording: Recording) -> Row:
        """Insert a recording and its evidence; the row."""
        digests: dict[str, str] | None = None if recording.evidence is None else {}
        for layer, piece in sorted((recording.evidence or {}).items()):
            raw = packed_evidence(piece)
            digests = {**(digests or {}), layer: sha256(raw)}
            self._database.execute(
                "INSERT OR IGNORE INTO evidence VALUES (?, ?)", (sha256(raw), zlib.compress(raw))
            )
        row = row_of(recording, digests)
        self._database.execute(INSERT, row.full)
        return row

    def _of_the_drive(self, row: Row) -> list[Row]:
        """The row and all others that share something recorded with it, or with one that does."""
        found = {row.key: row}
        waiting = [row]
        while waiting:
            one = waiting.pop()
            identity = identity_from_text(one.identity or "")
            if identity is None:
                continue
            near = self.rows("WHERE start <= ? AND end >= ?", (one.end, one.start))
            for other in near:
                theirs = None if other.key in found else identity_from_text(other.identity or "")
                if theirs is not None and identity.shared(theirs) > 0.0:
                    found[other.key] = other
                    waiting.append(other)
        return [found[key] for key in sorted(found)]

    def keep_estimates(self, estimates: Mapping[str, tuple[str, bytes]]) -> None:
        """Keep estimates for later readers, by layer with what they were made from, if possible.

        A map that was written whole is not changed by reading it: only one that trips are added to.
        """
        live = "SELECT 1 FROM header WHERE key = 'live'"
        with suppress(InputError):
            self._database.execute("PRAGMA busy_timeout = 200")
            with self._writing() as database:
                if database.execute(live).fetchone():
                    _insert_estimates(database, estimates)

    def digest_of(self, path: Path, state: os.stat_result) -> str:
        """SHA-256 of a log that has not changed since it was read; empty if that is not known."""
        with _refusing(self.path):
            found = self._database.execute(
                "SELECT sha256 FROM files WHERE path = ? AND size = ? AND changed = ?",
                (str(path.resolve()), state.st_size, state.st_mtime_ns),
            ).fetchone()
        return str(found[0]) if found else ""

    def unchanged_logs(self) -> Iterator[Path]:
        """The logs that trips were added from and that are still where they were, unchanged."""
        with _refusing(self.path):
            known = self._database.execute("SELECT path, size, changed FROM files ORDER BY path")
            rows = known.fetchall()
        for path, size, changed in rows:
            with suppress(OSError):
                state = Path(path).stat()
                if (state.st_size, state.st_mtime_ns) == (size, changed):
                    yield Path(path)

    def remember(self, path: Path, state: os.stat_result, digest: str) -> None:
        """Keep the SHA-256 of a log, with its size and the time of its last change."""
        with self._writing() as database:
            database.execute(
                "INSERT OR REPLACE INTO files VALUES (?, ?, ?, ?)",
                (str(path.resolve()), state.st_size, state.st_mtime_ns, digest),
            )

    def compact(self, before: int) -> int:
        """Replace the evidence of trips by sums of days; returns of how many trips.

        Which recordings of these drives count is then decided: a fuller one that comes later does
        not replace any.

        Parameters
        ----------
        before : int
            Day, counted from 1970-01-01 in UTC: of trips whose evidence is all of earlier days.
        """
        with self._writing() as database:
            rows = self.rows("WHERE evidence IS NOT NULL AND ifnull(last_day, -1) < ?", (before,))
            added: dict[str, list[str]] = {}
            for row in rows:
                for layer, digest in row.pieces.items() if row.counted else ():
                    added.setdefault(layer, []).append(digest)
            for layer in sorted(added):
                known = database.execute(
                    "SELECT data, digest, layer FROM sums WHERE layer = ?", (layer,)
                ).fetchone()
                start = [] if known is None else [self._unpacked(*known)]
                more = _subtotals(self.evidence(digest) for digest in added[layer])
                insert_sums(database, layer, DailyEvidence.total([*start, *more]))
            for row in rows:
                _replaced(database, row, evidence=None)
            kept = {digest for row in self.rows() for digest in row.pieces.values()}
            every = database.execute("SELECT digest FROM evidence").fetchall()
            gone = [each for each in every if each[0] not in kept]
            database.executemany("DELETE FROM evidence WHERE digest = ?", gone)
            _set_total(database)
        with _refusing(self.path):
            self._database.execute("VACUUM")
        return len(rows)


# ------------------------------------------------------------------------------- whole files


def whole_file(track: TrackConditionMap) -> bytes:
    """The bytes of the file of a map at hand: sums by day; the same map gives the same bytes."""
    with new_database(track) as database:
        used: set[str] = set()
        for number, entry in enumerate(sorted(track.trips, key=place_of)):
            known = dict(entry)
            identity = identity_from_text(str(known.get("identity") or ""))
            row = row_of(Recording(str(known.get("layer", "")), known, identity), None)
            if row.key in used:
                row = changed_row(row, key=f"{row.key} {number}")
            used.add(row.key)
            database.execute(INSERT, row.full)
        for layer in sorted(track.layers):
            insert_sums(database, layer, track.layers[layer].evidence)
        return serialized(database)


def reasons_of(rows: Sequence[Row]) -> dict[str, str]:
    """Why recordings do not count, by key: each is of a drive of which another does."""
    same = same_drives([row.known for row in rows])
    return {rows[each.number].key: each.sentence for each in same}


# ----------------------------------------------------------------------------------- rows


def _subtotals(pieces: Iterable[DailyEvidence], rows: int = 1_000_000) -> Iterator[DailyEvidence]:
    """The pieces, some of them added up, so that few rows are in memory at once."""
    waiting: list[DailyEvidence] = []
    held = 0
    for piece in pieces:
        waiting.append(piece)
        held += piece.day.size + piece.used_day.size
        if held >= rows:
            yield DailyEvidence.total(waiting)
            waiting, held = [], 0
    if waiting:
        yield DailyEvidence.total(waiting)


def _replaced(database: sqlite3.Connection, row: Row, **changes: Any) -> Row:
    """Change a row; the new one."""
    new = changed_row(row, **changes)
    database.execute(
        "UPDATE trips SET evidence = ?, counted = ?, digest = ? WHERE key = ?",
        (new.evidence, new.counted, new.full[-1], new.key),
    )
    return new


def _add_to_total(database: sqlite3.Connection, rows: Sequence[Row]) -> None:
    """Add rows to the number that stands for all, or take away those that are part of it."""
    (known,) = database.execute("SELECT value FROM header WHERE key = 'total'").fetchone()
    total = f"{int(known, 16) ^ total_of(rows, ()):016x}"
    database.execute("UPDATE header SET value = ? WHERE key = 'total'", (total,))


def _set_total(database: sqlite3.Connection) -> None:
    rows = (Row(*row[:-1]) for row in database.execute(_SELECT))
    sums = (digest for (digest,) in database.execute("SELECT digest FROM sums"))
    database.execute(
        "INSERT OR REPLACE INTO header VALUES ('total', ?)", (f"{total_of(rows, sums):016x}",)
    )


def insert_sums(database: sqlite3.Connection, layer: str, evidence: DailyEvidence) -> None:
    """Put the sums of a layer in the place of those that are there."""
    raw = packed_evidence(evidence)
    values = (layer, sha256(layer.encode() + raw), zlib.compress(raw))
    database.execute("INSERT OR REPLACE INTO sums VALUES (?, ?, ?)", values)


def _insert_estimates(
    database: sqlite3.Connection, estimates: Mapping[str, tuple[str, bytes]]
) -> None:
    for layer in sorted(estimates):
        made_from, data = estimates[layer]
        values = (layer, made_from, zlib.compress(data))
        database.execute("INSERT OR REPLACE INTO estimates VALUES (?, ?, ?)", values)


# ------------------------------------------------------------------------------ the database


def _begin(path: Path, empty: TrackConditionMap) -> None:
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


def serialized(database: sqlite3.Connection) -> bytes:
    """The bytes of a database; which release of SQLite wrote them is left out."""
    _set_total(database)
    database.execute("COMMIT")
    database.execute("VACUUM")
    data = bytearray(database.serialize())
    data[96:100] = bytes(4)
    return bytes(data)


_HEADER = ("bin_length", "length", "levels", "line", "settings")


def _digest_of_header(known: Mapping[str, str]) -> str:
    return sealed([known[key] for key in _HEADER])


def _header_of(known: Mapping[str, str]) -> TrackConditionMap:
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


def _check_start(start: bytes, file: str | Path) -> None:
    """Refuse what is no SQLite database."""
    if not start.startswith(b"SQLite format 3\0"):
        problem, remedy = mistaken_map(start)
        raise InputError(problem, file=file, remedy=remedy)


def _check_kind(database: sqlite3.Connection, file: str | Path) -> None:
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
def _refusing(file: str | Path) -> Iterator[None]:
    """Errors of SQLite as what a user can do about them."""
    try:
        yield
    except sqlite3.Error as error:
        _refuse(file, error)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        # A value is not what the table says that it is.
        raise _damaged(file, "database", str(error)) from error


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
    raise _damaged(file, "database", words) from error


def _damaged(file: str | Path, place: str, what: str) -> InputError:
    return InputError(
        f"is damaged: {' '.join(what.split())[:120]}",
        file=file,
        place=place,
        remedy="take a copy of it, or build the map anew from the logs (trainlog map update)",
    )

"""The file of a track-condition map: an SQLite database to which several processes add trips.

Every recording that was given is kept with its evidence; which of them count is decided anew among
the recordings of a drive whenever one comes. What a file holds is therefore a set that only grows,
and the map a function of that set: it does not depend on the order in which trips came, nor on how
they were divided between files that were merged.
"""

from __future__ import annotations

import os
import sqlite3
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from isal import isal_zlib
from isal.igzip_lib import IsalError

from trainlog.errors import InputError
from trainlog.formats.files import refuse_reading, sha256
from trainlog.formats.mapdatabase import (
    HAS_REFUSED,
    INSERT,
    PATIENCE,
    REFUSED,
    SELECT,
    add_to_total,
    amount_in,
    begin,
    check_kind,
    check_start,
    damaged,
    header_of,
    insert_sums,
    new_database,
    refusing,
    replace_row,
    serialized,
    set_total,
    total_in,
)
from trainlog.formats.packed import unpack_joined
from trainlog.formats.recordings import (
    Appended,
    Recording,
    Refusal,
    Row,
    packed_evidence,
    place_of,
    row_of,
    sealed,
)
from trainlog.identity import identity_from_text, same_drives
from trainlog.railway.condition import ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence

_TOGETHER = 200
"""So many pieces of evidence are unpacked at once, and their rows in memory."""

_FIRST, _LAST = np.iinfo(np.int64).min, np.iinfo(np.int64).max
"""Days before and after all."""


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
            begin(self.path, empty)
        try:
            with self.path.open("rb") as stream:
                start = stream.read(4096)
        except OSError as error:
            refuse_reading(self.path, error)
        check_start(start, self.path)
        with refusing(self.path):
            name = f"{self.path.absolute().as_uri()}?mode=rw"
            self._database = sqlite3.connect(
                name, timeout=PATIENCE, isolation_level=None, uri=True, check_same_thread=False
            )
            # Durable when a trip is acknowledged, also after a power cut.
            self._database.execute("PRAGMA synchronous = EXTRA")
            check_kind(self._database, self.path)

    @classmethod
    def of_bytes(cls, data: bytes, file: str | Path) -> Self:
        """A copy in memory of the bytes of a file; `file` is what errors call it."""
        check_start(data[:4096], file)
        found = cls.__new__(cls)
        found.path = Path(file)
        found._database = sqlite3.connect(":memory:", isolation_level=None)
        with refusing(file):
            found._database.deserialize(data)
            check_kind(found._database, file)
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
        with refusing(self.path):
            return header_of(dict(self._database.execute("SELECT key, value FROM header")))

    @property
    def without_evidence(self) -> TrackConditionMap:
        """The map with its layers, in which nothing is."""
        track = self.empty
        with refusing(self.path):
            names = self._database.execute("SELECT layer FROM trips UNION SELECT layer FROM sums")
            none = ConditionLayer.unestimated(DailyEvidence.none(track.bins, track.levels.size))
            return replace(track, layers={name: none for (name,) in names})

    @contextmanager
    def unchanging(self) -> Iterator[None]:
        """What is read within is of one moment, whatever other processes add."""
        with refusing(self.path):
            self._database.execute("BEGIN")
            try:
                yield
            finally:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")

    def _asked(self, command: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """The rows that a command of SQL gives."""
        with refusing(self.path):
            return self._database.execute(command, tuple(values)).fetchall()

    def rows(self, where: str = "", values: Sequence[Any] = ()) -> list[Row]:
        """Rows of the trips; each is verified."""
        found = []
        for row in self._asked(f"{SELECT} {where}", values):
            if sealed(row[:-1]) != row[-1]:
                raise damaged(self.path, f"trip {str(row[0])[:16]}", "its entry was changed")
            found.append(Row(*row[:-1]))
        return found

    def held(self, key: str) -> Row | None:
        """The recording of a key."""
        return next(iter(self.rows("WHERE key = ?", (key,))), None)

    def evidence(self, digest: str) -> DailyEvidence:
        """The evidence of a digest."""
        return self._joined(self._raws([digest]), digest)

    def blobs(self) -> dict[str, bytes]:
        """All evidence of single trips, compressed, by digest."""
        return dict(self._asked("SELECT digest, data FROM evidence"))

    def sums(self) -> dict[str, DailyEvidence]:
        """The evidence that was added up, by layer."""
        rows = self._asked("SELECT layer, digest, data FROM sums")
        return {layer: self._unpacked(data, digest, layer) for layer, digest, data in rows}

    def _unpacked(self, data: bytes, digest: str, layer: str = "") -> DailyEvidence:
        return self._joined([self._raw(data, digest, layer)], digest)

    def _raw(self, data: bytes, digest: str, layer: str = "") -> bytes:
        """Evidence of a digest, decompressed and verified."""
        try:
            raw = isal_zlib.decompress(data)
        except (IsalError, TypeError) as error:  # type: ignore[misc]  # the stubs' mistake
            raise damaged(self.path, f"evidence {digest[:16]}", str(error)) from error
        if sha256(layer.encode() + raw) != digest:
            raise damaged(self.path, f"evidence {digest[:16]}", "its checksum fails")
        return raw

    def _raws(self, digests: Sequence[str]) -> list[bytes]:
        """Evidence of each digest, decompressed and verified."""
        every = ",".join("?" * len(digests))
        command = f"SELECT digest, data FROM evidence WHERE digest IN ({every})"
        known = dict(self._asked(command, digests))
        return [self._raw(known.get(each, b""), each) for each in digests]

    def _joined(self, raw: Sequence[bytes], digest: str) -> DailyEvidence:
        """The rows of several pieces of evidence, one behind the other."""
        try:
            facts, arrays = unpack_joined(raw)
            if any(each != facts[0] for each in facts):
                raise ValueError("its bins differ from those of others")
            return DailyEvidence(facts[0]["bins"], facts[0]["levels"], **arrays)
        except (ValueError, TypeError, KeyError) as error:
            raise damaged(self.path, f"evidence {digest[:16]}", str(error)) from error

    def trips(self) -> list[Row]:
        """All recordings; that none is missing is verified."""
        found = self.rows("ORDER BY layer, first_day, key")
        known = self._asked("SELECT value FROM header WHERE key = 'total'")
        with refusing(self.path):
            if not known or int(known[0][0], 16) != total_in(self._database):
                raise damaged(self.path, "table of trips", "entries are missing")
        return found

    def layers(self, trips: Sequence[Row]) -> dict[str, tuple[DailyEvidence, str]]:
        """Evidence of the trips by layer, added up, and a digest of what it was added up from."""
        known = self.sums()
        digests = dict(self._asked("SELECT layer, digest FROM sums"))
        pieces = _pieces_of(trips)
        found = {}
        for layer in sorted({*known, *pieces}):
            given = pieces.get(layer, [])
            made_from = [digests.get(layer, ""), *sorted(each.digest for each in given)]
            total = self._added_up(known.get(layer), given)
            found[layer] = total, sha256("\n".join(made_from).encode())
        return found

    def _added_up(self, known: DailyEvidence | None, pieces: Sequence[_Piece]) -> DailyEvidence:
        """What is known already and the pieces, in one; at least one of them there must be.

        Added up day by day: rows of one day lie close together, and few are in memory at once.
        """
        done = [] if known is None else [known]
        latest: list[DailyEvidence] = []
        for first_day, group in groupby(sorted(pieces), key=lambda piece: piece.first_day):
            # Those of a trip before midnight may lie in this day, too.
            done += [each.between(_FIRST, first_day - 1) for each in latest]
            latest = [each.between(first_day, _LAST) for each in latest]
            digests = [piece.digest for piece in group]
            for start in range(0, len(digests), _TOGETHER):
                some = digests[start : start + _TOGETHER]
                rows = self._joined(self._raws(some), some[0])
                latest = [DailyEvidence.total([*latest, rows])]
        return DailyEvidence.total([*done, *latest])

    def contents(self) -> dict[str, tuple[int, list[int]]]:
        """Trips that count, and the days of their evidence, by layer; it is not added up."""
        days = {layer: set(piece.days.tolist()) for layer, piece in self.sums().items()}
        trips: Counter[str] = Counter()
        for row in self.trips():
            if row.counted:
                trips[row.layer] += 1
                first, last = row.days
                for layer in row.pieces:
                    days.setdefault(layer, set()).update(
                        range(first, last + 1) if last >= 0 else ()
                    )
        return {each: (trips[each], sorted(days.get(each, ()))) for each in sorted({*trips, *days})}

    def amount(self) -> tuple[int, int]:
        """How many trips count, and of how many days."""
        with refusing(self.path):
            return amount_in(self._database, self.sums().values())

    def trip_days(self) -> dict[str, tuple[int, int]]:
        """The trips that count, by the digest of their log: first and last day of their evidence.

        (0, -1): there is none.
        """
        asked = "SELECT key, coalesce(first_day, 0), coalesce(last_day, -1) FROM trips"
        rows = self._asked(f"{asked} WHERE counted")
        return {key: (first, last) for key, first, last in rows}

    def estimate(self, layer: str, made_from: str) -> bytes | None:
        """The estimate of a layer that was kept, if it was made from this; else None."""
        asked = "SELECT data FROM estimates WHERE layer = ? AND made_from = ?"
        found = self._asked(asked, (layer, made_from))
        with suppress(zlib.error, TypeError):
            return zlib.decompress(found[0][0]) if found else None
        return None

    # ------------------------------------------------------------------------------ writing

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """A transaction: what is done within is there whole, or not at all."""
        with refusing(self.path):
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
        return self.append_all([recording])[0]

    def append_all(self, recordings: Sequence[Recording]) -> list[Appended]:
        """Add recordings in one transaction: all of them are on the disk when this returns."""
        with self._writing() as database:
            found = [self._append(database, recording) for recording in recordings]
            if not all(each.held for each in found):
                database.execute("INSERT OR IGNORE INTO header VALUES ('live', '1')")
        return found

    def _append(self, database: sqlite3.Connection, recording: Recording) -> Appended:
        """Add a recording within a transaction."""
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
                changed += [each, replace_row(database, each, counted=int(counts))]
        add_to_total(database, changed)
        reason = reasons.get(row.key, "")
        return Appended(not reason, reason=reason, replaced=tuple(replaced))

    def remove(self, names: Iterable[str]) -> int:
        """Take all recordings of the named trips out; returns how many.

        Of other recordings of their drives those that count are decided anew.

        Parameters
        ----------
        names : iterable of str

        Raises
        ------
        InputError
            If the map holds no trip of a name, or its evidence is in sums of days: nothing is
            taken out then.
        """
        wanted = set(names)
        with self._writing() as database:
            rows = [row for row in self.rows() if row.known.name in wanted]
            for name in sorted(wanted - {row.known.name for row in rows}):
                raise InputError(
                    f"the map holds no trip '{name}'",
                    file=self.path,
                    remedy=f"trainlog show {self.path} --all lists its trips",
                )
            for row in rows:
                if row.evidence is None:
                    raise InputError(
                        f"trip '{row.known.name}' was compacted: its evidence is in sums of days",
                        file=self.path,
                        remedy="build the map anew from the logs without it",
                    )
            database.executemany("DELETE FROM trips WHERE key = ?", [(row.key,) for row in rows])
            gone = {row.key for row in rows}
            near = [each for row in rows for each in self._of_the_drive(row)]
            for each in {row.key: row for row in near if row.key not in gone}.values():
                counts = each.key not in reasons_of(self._of_the_drive(each))
                if bool(each.counted) != counts and each.evidence is not None:
                    replace_row(database, each, counted=int(counts))
            self._delete_unused(database)
            set_total(database)
        return len(rows)

    def _delete_unused(self, database: sqlite3.Connection) -> None:
        """Delete evidence that no row has."""
        kept = {digest for row in self.rows() for digest in row.pieces.values()}
        every = database.execute("SELECT digest FROM evidence").fetchall()
        unused = [each for each in every if each[0] not in kept]
        database.executemany("DELETE FROM evidence WHERE digest = ?", unused)

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
                    for layer, (made_from, data) in sorted(estimates.items()):
                        database.execute(
                            "INSERT OR REPLACE INTO estimates VALUES (?, ?, ?)",
                            (layer, made_from, zlib.compress(data)),
                        )

    def digest_of(self, path: Path, state: os.stat_result) -> str:
        """SHA-256 of a log that has not changed since it was read; empty if that is not known."""
        found = self._asked(
            "SELECT sha256 FROM files WHERE path = ? AND size = ? AND changed = ?",
            (str(path.resolve()), state.st_size, state.st_mtime_ns),
        )
        return str(found[0][0]) if found else ""

    def unchanged_logs(self) -> Iterator[Path]:
        """The logs that trips were added from and that are still where they were, unchanged."""
        asked = "SELECT path, size, changed FROM files WHERE sha256 IN (SELECT key FROM trips)"
        for path, size, changed in self._asked(f"{asked} ORDER BY path"):
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

    def refusal(self, digest: str) -> Refusal | None:
        """How a log with this SHA-256 was refused when it was given last; None if it was not."""
        if not self._asked(HAS_REFUSED):
            return None
        asked = "SELECT path, reason, tried FROM refused WHERE sha256 = ?"
        found = self._asked(asked, (digest,))
        return Refusal(digest, *map(str, found[0])) if found else None

    def remember_refusals(self, refusals: Iterable[Refusal]) -> None:
        """Keep that logs were refused, in place of what is known of them."""
        with self._writing() as database:
            database.execute(REFUSED)
            database.executemany("INSERT OR REPLACE INTO refused VALUES (?, ?, ?, ?)", refusals)

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
            added = _pieces_of(rows)
            for layer in sorted(added):
                known = database.execute(
                    "SELECT data, digest, layer FROM sums WHERE layer = ?", (layer,)
                ).fetchone()
                start = None if known is None else self._unpacked(*known)
                insert_sums(database, layer, self._added_up(start, added[layer]))
            for row in rows:
                replace_row(database, row, evidence=None)
            self._delete_unused(database)
            set_total(database)
        with refusing(self.path):
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
                row = row._replace(key=f"{row.key} {number}")
            used.add(row.key)
            database.execute(INSERT, row.full)
        for layer in sorted(track.layers):
            insert_sums(database, layer, track.layers[layer].evidence)
        return serialized(database)


def reasons_of(rows: Sequence[Row]) -> dict[str, str]:
    """Why recordings do not count, by key: each is of a drive of which another does."""
    same = same_drives([row.known for row in rows])
    return {rows[each.number].key: each.sentence for each in same}


# -------------------------------------------------------------------------------- evidence


class _Piece(NamedTuple):
    """Evidence of a trip in one layer, and the days on which the trip gave evidence."""

    first_day: int
    last_day: int
    digest: str


def _pieces_of(rows: Iterable[Row]) -> dict[str, list[_Piece]]:
    """What the rows that count have in the file, by layer."""
    found: dict[str, list[_Piece]] = {}
    for row in rows:
        for layer, digest in row.pieces.items() if row.counted else ():
            found.setdefault(layer, []).append(_Piece(*row.days, digest))
    return found

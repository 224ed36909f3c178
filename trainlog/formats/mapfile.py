"""The file of a track-condition map: an SQLite database to which several processes add trips.

Every recording that was given is kept with its evidence; which of them count is decided anew among
the recordings of a drive whenever one comes. What a file holds is therefore a set that only grows,
and the map a function of that set: it does not depend on the order in which trips came, nor on how
they were divided between files that were merged. A map at hand has the same ledger, in memory.

The file holds evidence; docs/formats.md has its tables. The estimate is a function of evidence and
settings (`trainlog.condition`): it is made on reading, or taken from the file where an earlier
reader kept it.
"""

from __future__ import annotations

import json
import math
import os
import secrets
import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields, replace
from functools import reduce
from operator import xor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from isal import isal_zlib
from isal.igzip_lib import IsalError
from numpy.typing import NDArray

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError, in_file
from trainlog.formats.files import (
    beginning,
    check_written,
    mistaken_map,
    plain,
    sha256,
    write_bytes,
    writing_error,
)
from trainlog.identity import Known, TripIdentity, identity_from_text, overlapping, same_drives
from trainlog.railway.condition import (
    SET_ASIDE,
    ConditionChange,
    ConditionLayer,
    ModelParameter,
    PassingSpot,
    TrackConditionMap,
    condition_of_layer,
    layer_of,
)
from trainlog.railway.evidence import DailyEvidence
from trainlog.version import code_version_of

if TYPE_CHECKING:
    from trainlog.condition import Reconciled

_WHOLE = ("u1", "i1", "<u2", "<i2", "<i4", "<i8")
"""Types in which whole numbers are kept: the first that holds them all."""

_EXACT = 2.0**53
"""Up to here doubles hold every whole number."""

_KINDS = {"i": np.int64, "u": np.int64, "f": np.float64, "b": np.bool_}
_LENGTH = struct.Struct("<I")
_Kept = tuple[str, str, NDArray[Any]]
"""How the numbers of an array are kept, and these."""


def pack(facts: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Facts, and arrays of whole numbers, truth values or doubles.

    First come four bytes with the length of what follows, little-endian: JSON with the `facts`, and
    of each of the ``arrays`` its name, its type (``i``, ``f``, ``b``), its shape, the type of the
    numbers kept, and how: ``all``, ``steps`` (each less the one before) or ``one`` that all are.
    Behind it the numbers themselves, one array after the other.

    Examples
    --------
    >>> data = pack({"bins": 4}, {"bin": np.array([0, 1, 3]), "weight": np.array([0.5, 2.0, 1.0])})
    >>> facts, arrays = unpack(data)
    >>> facts, arrays["bin"], arrays["weight"]
    ({'bins': 4}, array([0, 1, 3]), array([0.5, 2. , 1. ]))
    """
    listed, kept = [], []
    for name, array in arrays.items():
        form, how, values = _least(array)
        listed.append([name, array.dtype.kind, list(array.shape), form, how])
        kept.append(values.tobytes())
    content = {"arrays": listed, "facts": dict(facts)}
    head = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    return b"".join([_LENGTH.pack(len(head)), head, *kept])


def unpack(data: bytes) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Facts and arrays, the latter of int64, float64 or bool.

    Raises
    ------
    ValueError
        If the data are none that `pack` made.
    """
    arrays: dict[str, NDArray[Any]] = {}
    try:
        (length,) = _LENGTH.unpack_from(data)
        start = _LENGTH.size + length
        content = json.loads(data[_LENGTH.size : start])
        for name, kind, shape, form, how in content["arrays"]:
            size = math.prod(shape)
            kept = np.frombuffer(data, form, min(size, 1) if how == "one" else size, start)
            start += kept.nbytes
            values: NDArray[Any] = kept.astype(_KINDS[kind])
            if how == "one":
                values = np.repeat(values, size)
            arrays[name] = (np.cumsum(values) if how == "steps" else values).reshape(shape)
        return content["facts"], arrays
    except (KeyError, TypeError, struct.error) as error:
        raise ValueError(str(error)) from error


def unpack_joined(many: Sequence[bytes]) -> tuple[list[dict[str, Any]], dict[str, NDArray[Any]]]:
    """Facts of each, and their arrays, one behind the other.

    Raises
    ------
    ValueError
        If they are none that `pack` made, or of different arrays.

    Examples
    --------
    >>> many = [pack({"trip": n}, {"bin": np.arange(2) + 7 * n}) for n in range(3)]
    >>> facts, arrays = unpack_joined(many)
    >>> facts[1], arrays["bin"]
    ({'trip': 1}, array([ 0,  1,  7,  8, 14, 15]))
    """
    facts, arrays = zip(*map(unpack, many), strict=True)
    if any(each.keys() != arrays[0].keys() for each in arrays):
        raise ValueError("their arrays differ")
    return list(facts), {n: np.concatenate([each[n] for each in arrays]) for n in arrays[0]}


def _least(array: NDArray[Any]) -> _Kept:
    """Type of the numbers kept, how they are kept, and these, in the fewest bytes."""
    flat = np.ascontiguousarray(array).ravel()
    if flat.dtype.kind == "f" and not _are_whole(flat):
        same = flat.size > 0 and bool(np.all(flat.view(np.int64) == flat.view(np.int64)[0]))
        return "<f8", "one" if same else "all", flat[:1] if same else flat
    whole = flat.astype(np.int64)
    if whole.size and np.all(whole == whole[0]):
        return _form(whole[:1]), "one", whole[:1].astype(_form(whole[:1]))
    steps = np.diff(whole, prepend=0)
    chosen = min(
        ("all", whole), ("steps", steps), key=lambda each: np.dtype(_form(each[1])).itemsize
    )
    form = _form(chosen[1])
    return form, chosen[0], chosen[1].astype(form)


def _are_whole(values: FloatArray) -> bool:
    """Whether int64 holds them as exactly; minus zero has no whole number."""
    return bool(
        np.all(np.abs(values) < _EXACT)
        and np.all(np.rint(values) == values)
        and not np.any(np.signbit(values) & (values == 0.0))
    )


def _form(values: IntArray) -> str:
    if not values.size:
        return _WHOLE[0]
    low, high = int(values.min()), int(values.max())
    return next(form for form in _WHOLE if np.iinfo(form).min <= low and high <= np.iinfo(form).max)


# ---------------------------------------------------------------- arrays and facts in a few bytes


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
    last_day INTEGER, steps INTEGER NOT NULL, entry BLOB NOT NULL, identity BLOB, evidence TEXT,
    counted INTEGER NOT NULL, digest TEXT NOT NULL
) WITHOUT ROWID;
CREATE INDEX trips_by_time ON trips (start, end);
CREATE TABLE evidence (digest TEXT PRIMARY KEY, data BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE sums (layer TEXT PRIMARY KEY, digest TEXT NOT NULL, data BLOB NOT NULL);
CREATE TABLE estimates (layer TEXT PRIMARY KEY, made_from TEXT NOT NULL, data BLOB NOT NULL);
CREATE TABLE files (
    path TEXT PRIMARY KEY, size INTEGER NOT NULL, changed INTEGER NOT NULL, sha256 TEXT NOT NULL
);
"""

_REFUSED = """
CREATE TABLE IF NOT EXISTS refused (
    sha256 TEXT PRIMARY KEY, path TEXT NOT NULL, reason TEXT NOT NULL, tried TEXT NOT NULL
)
"""
"""A table that a map has once a log was refused."""

_HEADER = ("bin_length", "length", "levels", "line", "settings")
_SORTED_BY = ("layer", "trip", "sha256", "identity")

_EVIDENCE = tuple(
    each.name for each in fields(DailyEvidence) if each.name not in ("bins", "levels")
)
_LISTED: dict[str, Any] = {"spots": PassingSpot, "changes": ConditionChange}

_TOGETHER = 200
"""So many pieces of evidence are unpacked at once, and their rows in memory."""

JUDGED = 500
"""The latest so many trips of a layer are compared with one another."""

PERIODS = ((120, 7), (365, 28))
"""Age [days] from which on sums of days are added up by period, and its length [days]."""

USUAL = (
    '{"common_std":0.009,"damage":"","direction":"reverse","forward","further_layers":["wet"],'
    '"load":"assumed","load":"estimated","layer":"wet","notes":["the efforts are 0.1 s late:'
    ' shifted by that"],"sha256":"","software":"trainlog 0.1.0","trip":"","unmeasured":1,"weather":'
    '{"humidity":,"rain":,"sun_elevation":1,"temperature":28,"temperature_source":"log","time":'
    '"2026-1:00Z"}}'
)
"""What entries of trips have in common: with their key it is the dictionary of their bytes."""


# ------------------------------------------------------------------------------- recordings


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording of a drive, as it is given to a map.

    Attributes
    ----------
    layer : str
        Rail condition; where it changed on the way the one that held longest.
    entry : dict
        What the map keeps of the trip: ``trip`` (its name), ``sha256`` of its log (empty where
        there is none), ``layer``, ``software`` and what else is known.
    identity : TripIdentity or None
        Which drive it is; None: not known.
    steps : int
        Of processing since it was recorded.
    evidence : dict of str to DailyEvidence, optional
        By rail condition. None: in the sums of its layers, or, if it does not count, not kept.
    counted : bool
        Whether it counts; a fuller recording of the same drive may do in its place.
    """

    layer: str
    entry: dict[str, Any]
    identity: TripIdentity | None = None
    steps: int = 0
    evidence: dict[str, DailyEvidence] | None = None
    counted: bool = True

    @property
    def key(self) -> str:
        """What identifies the recording: SHA-256 of the log, else the drive, else the name."""
        if digest := str(self.entry.get("sha256") or ""):
            return digest
        if self.identity is not None:
            return f"drive {sha256(self.identity.text.encode())}"
        return f"trip {self.entry.get('trip', '')}"

    def row(self, digests: Mapping[str, str] | None) -> Row:
        """Its row; the digests of its evidence by layer, None if it is in the sums."""
        identity, pieces = self.identity, (self.evidence or {}).values()
        days = sorted({day for piece in pieces for day in piece.days.tolist()})
        entry = plain({name: v for name, v in self.entry.items() if name != "identity"}, "trips")
        return Row(
            self.key,
            self.layer,
            None if identity is None else int(identity.start.value),
            None if identity is None else int(identity.end.value),
            days[0] if days else None,
            days[-1] if days else None,
            self.steps,
            _compact_json(entry),
            self.entry.get("identity"),
            None if digests is None else _compact_json(digests),
            int(self.counted),
        )


@dataclass(frozen=True, slots=True)
class Appended:
    """What became of a recording that was given to a map.

    Attributes
    ----------
    counted : bool
    held : bool
        Whether the map held this very recording already.
    reason : str
        Why it does not count, in words.
    replaced : tuple of str
        Names of the trips that counted before, and do no more: this is a fuller recording.
    """

    counted: bool
    held: bool = False
    reason: str = ""
    replaced: tuple[str, ...] = ()


class Refusal(NamedTuple):
    """That a log could not be used, as a map's file keeps it.

    Attributes
    ----------
    sha256 : str
        Of the log.
    path : str
        Where it was.
    reason : str
        In words, with the path.
    tried : str
        What the outcome depends on besides the log: code, rail condition and weather given.
    """

    sha256: str
    path: str
    reason: str
    tried: str

    def is_repeated_by(self, other: Refusal) -> bool:
        """Whether the other states the same, of the log where it is then."""
        return self.reason.replace(self.path, "") == other.reason.replace(other.path, "")


class Row(NamedTuple):
    """A row of the table of trips, as it stands in the file.

    Attributes
    ----------
    key : str
        See `Recording.key`.
    layer : str
    start, end : int or None [ns since 1970 UTC]
        Of what was recorded.
    first_day, last_day : int or None
        First and last day with evidence; None: there is none.
    steps : int
    entry : str
        JSON.
    identity : str or None
    evidence : str or None
        JSON: digests of the evidence by layer. None: it is in the sums, or was left out of them.
    counted : int
        1 or 0.
    """

    key: str
    layer: str
    start: int | None
    end: int | None
    first_day: int | None
    last_day: int | None
    steps: int
    entry: str
    identity: str | None
    evidence: str | None
    counted: int

    @property
    def digest(self) -> str:
        """The checksum over the columns."""
        return _sealed(self)

    @property
    def stored(self) -> tuple[Any, ...]:
        """The columns as the file has them, and their digest."""
        return (*self._texts(_deflated), self.digest)

    @classmethod
    def of_stored(cls, columns: Sequence[Any]) -> Row:
        """The row of columns that the file has; `digest` is left out."""
        return cls(*columns)._texts(_inflated)

    def _texts(self, change: Callable[[Any, bytes], Any]) -> Row:
        """With the long texts as bytes, or from bytes."""
        usual = f"{USUAL}{self.key}{self.start} {self.end} ".encode()
        identity = None if self.identity is None else change(self.identity, usual)
        return self._replace(entry=change(self.entry, usual), identity=identity)

    @property
    def days(self) -> tuple[int, int]:
        """The first and the last with evidence; (-1, -1) if there is none."""
        if self.first_day is None or self.last_day is None:
            return -1, -1
        return self.first_day, self.last_day

    @property
    def pieces(self) -> dict[str, str]:
        """Digests of the evidence by layer; none if it is in the sums."""
        found: dict[str, str] = json.loads(self.evidence) if self.evidence else {}
        return found

    def piece(self, digest: str) -> _Piece:
        """Evidence of the trip by its digest."""
        direction = str(json.loads(self.entry).get("direction", ""))
        return _Piece(*self.days, digest, self.key, direction, self.start or -1)

    @property
    def entry_whole(self) -> dict[str, Any]:
        """The entry of the trip as a map at hand has it."""
        entry: dict[str, Any] = json.loads(self.entry)
        entry.pop("direction", None)  # it serves to compare trips, which sums do not allow
        return entry if self.identity is None else {**entry, "identity": self.identity}

    @property
    def known(self) -> Known:
        """The recording, to be compared with others of the drive."""
        entry = json.loads(self.entry)
        name, digest = str(entry.get("trip", "")), str(entry.get("sha256") or "")
        fixed = self.evidence is None
        # What is in the sums is counted for good, what was left out of them never is.
        identity = None if fixed and not self.counted else identity_from_text(self.identity or "")
        order = (self.steps, digest, name)
        return Known(name, identity, order, held=fixed and bool(self.counted), digest=digest)


_SELECT = f"SELECT {', '.join((*Row._fields, 'digest'))} FROM trips"
_INSERT = f"INSERT INTO trips VALUES ({', '.join('?' * (len(Row._fields) + 1))})"


def reasons_of(rows: Sequence[Row]) -> dict[str, str]:
    """Why recordings do not count, by key: each is of a drive of which another does."""
    same = same_drives([row.known for row in rows])
    return {rows[each.number].key: each.sentence for each in same}


def packed_evidence(evidence: DailyEvidence) -> bytes:
    """Evidence as bytes; its digest is that of these."""
    facts = {"bins": evidence.bins, "levels": evidence.levels}
    return pack(facts, {name: getattr(evidence, name) for name in _EVIDENCE})


def unpacked_evidence(many: Sequence[bytes]) -> DailyEvidence:
    """The rows of several pieces of evidence, one behind the other.

    Raises
    ------
    ValueError, TypeError, KeyError
        If they are none that `packed_evidence` made, or of different bins.
    """
    facts, arrays = unpack_joined(many)
    if any(each != facts[0] for each in facts):
        raise ValueError("its bins differ from those of others")
    return DailyEvidence(facts[0]["bins"], facts[0]["levels"], **arrays)


def place_of(entry: Mapping[str, Any]) -> tuple[str, ...]:
    """By what the trips of a map are sorted."""
    return (*(str(entry.get(name, "")) for name in _SORTED_BY), repr(sorted(entry.items())))


def _sealed(values: Sequence[Any]) -> str:
    """The checksum over the columns of a row."""
    return sha256(repr(tuple(values)).encode())[:16]


def _deflated(text: str, usual: bytes) -> bytes:
    """A text in few bytes, most of it being as usual."""
    packing = zlib.compressobj(9, zlib.DEFLATED, -15, zdict=usual)
    return packing.compress(text.encode()) + packing.flush()


def _inflated(data: bytes | str, usual: bytes) -> str:
    """The text of `_deflated`; earlier files have it as it is."""
    if isinstance(data, str):
        return data
    return zlib.decompressobj(-15, zdict=usual).decompress(data).decode()


def _compact_json(value: Mapping[str, Any]) -> str:
    """JSON on one line, keys in order."""
    return json.dumps(value, sort_keys=True, ensure_ascii=False, separators=(",", ":"))


class _Piece(NamedTuple):
    """Evidence of a trip in one layer, and the days on which the trip gave evidence."""

    first_day: int
    last_day: int
    digest: str
    key: str
    direction: str
    start: int


class Sums(NamedTuple):
    """What the trips of a file amount to.

    Attributes
    ----------
    evidence : dict of str to (DailyEvidence, str)
        By layer, added up, with a digest of what it was added up from.
    notes : dict of str to str
        On trips that do not agree with the others, by key.
    layers : dict of (str, str) to str
        Where trips of a rail condition count by direction, the layer of each, by condition and key.
    corrected : dict of (str, str) to DailyEvidence
        What counts of trips that do not agree with the others, by condition and key.
    """

    evidence: dict[str, tuple[DailyEvidence, str]]
    notes: dict[str, str]
    layers: dict[tuple[str, str], str]
    corrected: dict[tuple[str, str], DailyEvidence]


def _pieces_of(rows: Iterable[Row]) -> dict[str, list[_Piece]]:
    """What the rows that count have in the file, by layer."""
    found: dict[str, list[_Piece]] = {}
    for row in rows:
        for layer, digest in row.pieces.items() if row.counted else ():
            found.setdefault(layer, []).append(row.piece(digest))
    return found


# --------------------------------------------------------------------------------- the file


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
        start = beginning(self.path)
        if not start.startswith(b"SQLite format 3\0"):
            problem, remedy = mistaken_map(start)
            raise InputError(problem, file=self.path, remedy=remedy)
        with _refusing(self.path):
            name = f"{self.path.absolute().as_uri()}?mode=rw"
            self._database = sqlite3.connect(
                name, timeout=PATIENCE, isolation_level=None, uri=True, check_same_thread=False
            )
            # Durable when a trip is acknowledged, also after a power cut.
            self._database.execute("PRAGMA synchronous = EXTRA")
            _check_kind(self._database, self.path)

    @classmethod
    def of_map(cls, track: TrackConditionMap, file: str | Path = "map") -> Self:
        """The file of a map at hand, in memory: sums by day, so that all its trips count for good.

        The same map gives the same bytes.
        """
        rows: dict[str, Row] = {}
        for number, entry in enumerate(sorted(track.trips, key=place_of)):
            identity = identity_from_text(str(entry.get("identity") or ""))
            row = Recording(str(entry.get("layer", "")), dict(entry), identity).row(None)
            if row.key in rows:
                row = row._replace(key=f"{row.key} {number}")
            rows[row.key] = row
        sums = {name: track.layers[name].evidence for name in sorted(track.layers)}
        return cls._made(track, file, rows.values(), (), sums)

    @classmethod
    def _made(
        cls,
        empty: TrackConditionMap,
        file: str | Path,
        rows: Iterable[Row],
        evidence: Iterable[tuple[str, bytes]],
        sums: Mapping[str, DailyEvidence],
    ) -> Self:
        """A file in memory with the header of a map, rows, their evidence and sums by layer."""
        found = cls.__new__(cls)
        found.path = Path(file)
        found._database = sqlite3.connect(":memory:", isolation_level=None)
        found._database.execute(f"PRAGMA application_id = {APPLICATION}")
        found._database.execute(f"PRAGMA user_version = {VERSION}")
        found._database.executescript(_TABLES)
        header = {name: plain(getattr(empty, name), name) for name in _HEADER}
        stated = {
            key: json.dumps(value, sort_keys=True, ensure_ascii=False, allow_nan=False)
            for key, value in header.items()
        }
        with found._writing() as database:
            stated["digest"] = _sealed([stated[key] for key in _HEADER])
            database.executemany("INSERT INTO header VALUES (?, ?)", stated.items())
            database.executemany(_INSERT, (row.stored for row in rows))
            database.executemany("INSERT INTO evidence VALUES (?, ?)", evidence)
            for layer, piece in sums.items():
                found._insert_sums(layer, piece)
            found._set_total()
        return found

    def data(self, *, in_order: bool = False) -> bytes:
        """The bytes of a file in memory; which release of SQLite wrote them is left out.

        One whose rows were inserted in the order of their keys is compact already.
        """
        if not in_order:
            self._database.execute("VACUUM")
        data = self._database.serialize()
        return b"".join((data[:96], bytes(4), memoryview(data)[100:]))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; what was not committed is undone."""
        self._database.close()

    # ------------------------------------------------------------------------------ reading

    def read(self) -> TrackConditionMap:
        """The whole map. An estimate that no earlier reader kept is made, and kept if possible.

        Raises
        ------
        InputError
            If the file is damaged, or its evidence is not of its bins.
        """
        with self.unchanging():
            trips = self.trips()
            known, notes, own, _ = self.summed(trips)
            entries = []
            for row in (each for each in trips if each.counted):
                entry = row.entry_whole
                if row.key in notes:
                    entry["notes"] = [*entry.get("notes", ()), notes[row.key]]
                layer = own.get((row.layer, row.key), row.layer)
                entries.append(entry | ({"layer": layer} if layer != row.layer else {}))
            track = replace(self.empty, trips=tuple(sorted(entries, key=place_of)))
            # What else changed since the estimate was made does not matter.
            code = code_version_of("trainlog.condition")
            made_from = {name: f"{digest} {code}" for name, (_, digest) in known.items()}
            kept = {name: self._estimate(name, each) for name, each in made_from.items()}
        for name, (evidence, _) in known.items():
            if (evidence.bins, evidence.levels) != (track.bins, track.levels.size):
                raise InputError(
                    f"has evidence of {evidence.bins} bins and {evidence.levels} levels for a line"
                    f" of {track.bins} and {track.levels.size}",
                    file=self.path,
                    place=f"layer '{name}'",
                    remedy="build the map anew from the logs",
                )
        layers = {
            name: _layer_of(evidence, kept[name]) or ConditionLayer.unestimated(evidence)
            for name, (evidence, _) in known.items()
        }
        if all(kept.values()) and all(np.isfinite(x.log_mean).all() for x in layers.values()):
            return replace(track, layers=layers)
        # Imported where it is needed: to keep evidence takes none of what computes with it.
        from trainlog.condition import estimated

        found = estimated(replace(track, layers=layers))
        with suppress(TypeError, ValueError, InputError):
            new = {name: (made_from[name], _packed(layer)) for name, layer in found.layers.items()}
            self._keep_estimates(new)
        return found

    @property
    def empty(self) -> TrackConditionMap:
        """The map without its layers and trips; its header is verified."""
        known = dict(self._asked("SELECT key, value FROM header"))
        with _refusing(self.path):
            if _sealed([known[key] for key in _HEADER]) != known["digest"]:
                raise ValueError("its header was changed")
            values = {key: json.loads(known[key]) for key in _HEADER}
            for name in ("length", "bin_length"):
                values[name] = float(values[name])
            values["levels"] = np.asarray(values["levels"], dtype=np.float64)
            return TrackConditionMap(layers={}, **values)

    @property
    def without_evidence(self) -> TrackConditionMap:
        """The map with its layers, in which nothing is."""
        track = self.empty
        names = self._asked("SELECT layer FROM trips UNION SELECT layer FROM sums")
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

    def _asked(self, command: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """The rows that a command of SQL gives."""
        with _refusing(self.path):
            return self._database.execute(command, tuple(values)).fetchall()

    def rows(self, where: str = "", values: Sequence[Any] = ()) -> list[Row]:
        """Rows of the trips; each is verified."""
        found = []
        for *columns, digest in self._asked(f"{_SELECT} {where}", values):
            row = None
            with suppress(zlib.error, UnicodeDecodeError, TypeError):
                row = Row.of_stored(columns)
            if row is None or row.digest != digest:
                raise _damaged(self.path, f"trip {str(columns[0])[:16]}", "its entry was changed")
            found.append(row)
        return found

    def held(self, key: str) -> Row | None:
        """The recording of a key."""
        return next(iter(self.rows("WHERE key = ?", (key,))), None)

    def reason(self, recording: Recording) -> str:
        """Why a recording would not count, whatever it shows: empty if that depends on it."""
        if self.held(recording.key) is not None:
            name = recording.entry.get("trip", "")
            return f"trip '{name}': in the map already, not counted again"
        row = recording.row({})
        fixed = [each for each in self._of_the_drive(row) if each.evidence is None]
        return reasons_of([*fixed, row]).get(row.key, "")

    def sums(self) -> dict[str, DailyEvidence]:
        """The evidence that was added up, by layer."""
        return {layer: piece for layer, (piece, _) in self._sums().items()}

    def _sums(self) -> dict[str, tuple[DailyEvidence, str]]:
        """The evidence that was added up, and its digest, by layer."""
        return {
            layer: (self._joined([self._raw(data, digest, layer)]), digest)
            for layer, digest, data in self._asked("SELECT layer, digest, data FROM sums")
        }

    def _raw(self, data: bytes, digest: str, layer: str = "") -> bytes:
        """Evidence of a digest, decompressed and verified."""
        try:
            raw = isal_zlib.decompress(data)
        except (IsalError, TypeError) as error:  # type: ignore[misc]  # the stubs' mistake
            raise _damaged(self.path, f"evidence {digest[:16]}", str(error)) from error
        if sha256(layer.encode() + raw) != digest:
            raise _damaged(self.path, f"evidence {digest[:16]}", "its checksum fails")
        return raw

    def _joined(self, raw: Sequence[bytes]) -> DailyEvidence:
        """The rows of several pieces of evidence, one behind the other."""
        try:
            return unpacked_evidence(raw)
        except (ValueError, TypeError, KeyError) as error:
            raise _damaged(self.path, "evidence", str(error)) from error

    def trips(self) -> list[Row]:
        """All recordings; that none is missing is verified."""
        found = self.rows("ORDER BY layer, first_day, key")
        known = self._asked("SELECT value FROM header WHERE key = 'total'")
        with _refusing(self.path):
            if not known or int(known[0][0], 16) != self._total():
                raise _damaged(self.path, "table of trips", "entries are missing")
        return found

    def summed(self, trips: Sequence[Row]) -> Sums:
        """Evidence of the trips by layer, added up; what does not agree is set aside or apart."""
        known, pieces = self._sums(), _pieces_of(trips)
        found, notes = dict[str, tuple[DailyEvidence, str]](), dict[str, str]()
        layers: dict[tuple[str, str], str] = {}
        corrected: dict[tuple[str, str], DailyEvidence] = {}
        for layer in sorted({*map(condition_of_layer, known), *pieces}):
            given = sorted(pieces.get(layer, []), key=lambda piece: (piece.start, piece.key))
            made_from = sorted(each.digest for each in given)
            sums = {n: each for n, each in known.items() if condition_of_layer(n) == layer}
            parted = bool(set(sums) - {layer})
            judged = self._reconciled(layer, given[-JUDGED:], apart=parted)
            if judged is None:
                start, digest = sums.get(layer, (None, ""))
                whole = "\n".join([digest, *made_from])
                found[layer] = self._added_up(start, given), sha256(whole.encode())
                continue
            notes |= judged.notes
            layers |= {(layer, key): name for key, name in judged.layers.items()}
            corrected |= {(layer, key): piece for key, piece in judged.evidence.items()}
            made_from += [*sorted(judged.notes.values()), *sorted(judged.layers.values())]
            parted = parted or any(name != layer for name in judged.layers.values())
            earlier: dict[str, list[_Piece]] = {}
            for piece in given[:-JUDGED]:
                own = layer_of(layer, piece.direction) if parted and piece.direction else layer
                layers[layer, piece.key] = own
                earlier.setdefault(own, []).append(piece)
            for name in sorted({*judged.layers.values(), *sums, *earlier}) or [layer]:
                start, digest = sums.get(name, (None, ""))
                several = [e for key, e in judged.evidence.items() if judged.layers[key] == name]
                several = several or [DailyEvidence.none(self.empty.bins, self.empty.levels.size)]
                if start is not None or name in earlier:
                    several.append(self._added_up(start, earlier.get(name, [])))
                whole = "\n".join([name, digest, *made_from])
                found[name] = DailyEvidence.total(several), sha256(whole.encode())
        return Sums(found, notes, layers, corrected)

    def _reconciled(
        self, layer: str, pieces: Sequence[_Piece], *, apart: bool
    ) -> Reconciled | None:
        """What counts of the trips of a layer; None if all of them agree."""
        from trainlog.condition import TripEvidence, reconciled

        if len(pieces) < 2 and not apart:
            return None
        every = (self._joined([each]) for raw in self._raw_of(pieces) for each in raw)
        trips = [
            TripEvidence(each.key, each.direction, each.start, evidence)
            for each, evidence in zip(pieces, every, strict=True)
        ]
        trips.sort(key=lambda each: each.key)
        track = self.empty
        sizes = {(each.evidence.bins, each.evidence.levels) for each in trips}
        if sizes - {(track.bins, track.levels.size)}:
            return None  # which is refused where the map is read
        return reconciled(track, layer, trips, apart=apart)

    def _raw_of(self, pieces: Sequence[_Piece]) -> Iterator[list[bytes]]:
        """Evidence of pieces, some hundred at once."""
        for first in range(0, len(pieces), _TOGETHER):
            digests = [piece.digest for piece in pieces[first : first + _TOGETHER]]
            every = ",".join("?" * len(digests))
            asked = f"SELECT digest, data FROM evidence WHERE digest IN ({every})"
            blobs = dict(self._asked(asked, digests))
            yield [self._raw(blobs.get(each, b""), each) for each in digests]

    def _added_up(self, known: DailyEvidence | None, pieces: Sequence[_Piece]) -> DailyEvidence:
        """What is known already and the pieces, in one; at least one of them there must be.

        Those of the same days together: few rows are in memory at once.
        """
        done = [] if known is None else [known]
        in_order = sorted(pieces, key=lambda piece: piece.first_day)
        done += [DailyEvidence.total([self._joined(raw)]) for raw in self._raw_of(in_order)]
        return DailyEvidence.total(done)

    def contents(self) -> dict[str, tuple[int, list[int]]]:
        """Trips that count, and the days of their evidence, by layer; it is not added up."""
        days: dict[str, set[int]] = {}
        trips: Counter[str] = Counter()
        rows = [row for row in self.trips() if row.counted]
        for row in rows:
            trips[row.layer] += 1
            first, last = row.days
            for layer in row.pieces or [row.layer]:
                days.setdefault(layer, set()).update(range(first, last + 1) if last >= 0 else ())
        dated = all(row.evidence is not None or row.last_day is not None for row in rows)
        for layer, piece in self.sums().items():
            if not (dated and condition_of_layer(layer) in days):
                days.setdefault(layer, set()).update(piece.days.tolist())
        return {each: (trips[each], sorted(days.get(each, ()))) for each in sorted({*trips, *days})}

    def amount(self) -> tuple[int, int]:
        """How many trips count, and of how many days; those of evidence that was added up, too."""
        found = self.contents().values()
        return sum(trips for trips, _ in found), len({day for _, days in found for day in days})

    def trip_days(self) -> dict[str, tuple[int, int]]:
        """The trips that count, by the digest of their log: first and last day of their evidence.

        (0, -1): there is none.
        """
        asked = "SELECT key, coalesce(first_day, 0), coalesce(last_day, -1) FROM trips"
        rows = self._asked(f"{asked} WHERE counted")
        return {key: (first, last) for key, first, last in rows}

    def _estimate(self, layer: str, made_from: str) -> bytes | None:
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
        digests: dict[str, str] | None = None if recording.evidence is None else {}
        for layer, piece in sorted((recording.evidence or {}).items()):
            raw = packed_evidence(piece)
            digests = {**(digests or {}), layer: sha256(raw)}
            database.execute(
                "INSERT OR IGNORE INTO evidence VALUES (?, ?)", (sha256(raw), zlib.compress(raw))
            )
        row = recording.row(digests)
        database.execute(_INSERT, row.stored)
        changes, reasons = self._decided(row)
        changed = [row, *(each for pair in changes for each in pair)]
        (known,) = database.execute("SELECT value FROM header WHERE key = 'total'").fetchone()
        total = f"{int(known, 16) ^ _number_of(each.digest for each in changed):016x}"
        database.execute("UPDATE header SET value = ? WHERE key = 'total'", (total,))
        replaced = tuple(old.known.name for old, _ in changes if old.counted and old.key != row.key)
        reason = reasons.get(row.key, "")
        return Appended(not reason, reason=reason, replaced=replaced)

    def _decided(self, row: Row) -> tuple[list[tuple[Row, Row]], dict[str, str]]:
        """Decide which recordings of a row's drive count: rows that changed, before and after.

        And why those do not count that do not, by key.
        """
        together = self._of_the_drive(row)
        reasons = reasons_of(together)
        return [
            (each, self._changed(each, counted=int(each.key not in reasons)))
            for each in together
            if bool(each.counted) != (each.key not in reasons) and each.evidence is not None
        ], reasons

    def _of_the_drive(self, row: Row) -> list[Row]:
        """The row and all others that share something recorded with it, or with one that does."""
        found = {row.key: row}
        waiting = [row]
        while waiting:
            one = waiting.pop()
            identity = identity_from_text(one.identity or "")
            if identity is None:
                continue
            for other in self.rows("WHERE start <= ? AND end >= ?", (one.end, one.start)):
                theirs = None if other.key in found else identity_from_text(other.identity or "")
                if theirs is not None and identity.shared(theirs) > 0.0:
                    found[other.key] = other
                    waiting.append(other)
        return [found[key] for key in sorted(found)]

    def _changed(self, row: Row, **changes: Any) -> Row:
        """Change a row; the new one."""
        new = row._replace(**changes)
        self._database.execute(
            "UPDATE trips SET evidence = ?, counted = ?, digest = ? WHERE key = ?",
            (new.evidence, new.counted, new.digest, new.key),
        )
        return new

    def _total(self) -> int:
        """The number that stands for all rows, of their digests."""
        digests = self._asked("SELECT digest FROM trips UNION ALL SELECT digest FROM sums")
        return _number_of(digest for (digest,) in digests)

    def _set_total(self) -> None:
        total = f"{self._total():016x}"
        self._database.execute("INSERT OR REPLACE INTO header VALUES ('total', ?)", (total,))

    def _insert_sums(self, layer: str, evidence: DailyEvidence) -> None:
        """Put the sums of a layer in the place of those that are there."""
        raw = packed_evidence(evidence)
        values = (layer, sha256(layer.encode() + raw), zlib.compress(raw))
        self._database.execute("INSERT OR REPLACE INTO sums VALUES (?, ?, ?)", values)

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
                    f"the map has no trip '{name}'",
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
            self._take_out(database, rows)
        return len(rows)

    def logs(self, *, summed: bool) -> set[str]:
        """SHA-256 of the logs whose evidence is in sums of days, or of those whose is not."""
        own = f"evidence IS {'' if summed else 'NOT '}NULL"
        return {
            key for (key,) in self._asked(f"SELECT key FROM trips WHERE {own}") if len(key) == 64
        }

    def keep_only(self, logs: Collection[str]) -> int:
        """Take out the recordings of all other logs; returns how many.

        Those without a log, and those in sums of days, stay.

        Parameters
        ----------
        logs : collection of str
            SHA-256 of each.
        """
        gone = sorted(self.logs(summed=False).difference(logs))
        if gone:
            with self._writing() as database:
                self._take_out(database, [row for row in map(self.held, gone) if row is not None])
        return len(gone)

    def _take_out(self, database: sqlite3.Connection, rows: Sequence[Row]) -> None:
        """Delete rows, and decide anew which other recordings of their drives count."""
        database.executemany("DELETE FROM trips WHERE key = ?", [(row.key,) for row in rows])
        gone = {row.key for row in rows}
        near = {each.key: each for row in rows for each in self._of_the_drive(row)}
        for key, each in near.items():
            if key not in gone:
                self._decided(each)
        self._tidy(database)

    def _tidy(self, database: sqlite3.Connection) -> None:
        """Delete evidence that no row has, and count the rows anew."""
        kept = {digest for row in self.rows() for digest in row.pieces.values()}
        every = database.execute("SELECT digest FROM evidence").fetchall()
        unused = [each for each in every if each[0] not in kept]
        database.executemany("DELETE FROM evidence WHERE digest = ?", unused)
        self._set_total()

    def compact(self, before: int | None = None, kept: int = 0) -> int:
        """Replace the evidence of trips by sums of days; returns of how many trips.

        It is what counts of it beside the other trips. Which recordings of these drives count is
        then decided: a fuller one that comes later does not replace any.

        Parameters
        ----------
        before : int, optional
            Day, counted from 1970-01-01 in UTC: of trips whose evidence is all of earlier days.
        kept : int, optional
            So many of the latest trips of each rail condition are left, and fewer than so many
            before them: of which trips depends on those that the map holds, not on how they came.
            Sums older than 120 days are by week then, those older than a year by four weeks
            (`PERIODS`).
        """
        with self._writing() as database:
            every = self.rows()
            rows = [row for row in every if row.evidence is not None]
            if before is not None:
                rows = [row for row in rows if row.days[1] < before]
            if kept:
                old = self.beyond(kept)
                rows = [row for row in rows if row.key in old]
            if not rows:
                return 0
            whole = self.summed(every)
            # What is set aside now may count beside later trips.
            aside = {key for key, note in whole.notes.items() if note.startswith(SET_ASIDE)}
            rows = [row for row in rows if row.key not in aside]
            newest = max((row.days[1] for row in every if row.key not in aside), default=-1)
            added = {layer: [piece] for layer, piece in self.sums().items()}
            for layer, pieces in _pieces_of(rows).items():
                for piece in pieces:
                    own = whole.corrected.get((layer, piece.key)) or self._added_up(None, [piece])
                    added.setdefault(whole.layers.get((layer, piece.key), layer), []).append(own)
            for layer, several in sorted(added.items()):
                total = DailyEvidence.total(several)
                for age, length in PERIODS if kept else ():
                    total = total.by_period(newest - age, length)
                self._insert_sums(layer, total)
            for row in rows:
                self._changed(row, evidence=None)
            self._tidy(database)
        with _refusing(self.path):
            self._database.execute("VACUUM")
        return len(rows)

    def beyond(self, kept: int) -> set[str]:
        """Keys of the recordings of which `compact` would sum evidence up, so many being kept."""
        asked = "SELECT layer, key, evidence IS NOT NULL FROM trips ORDER BY layer, start, key"
        by_layer: dict[str, list[tuple[str, int]]] = {}
        for layer, key, own in self._asked(asked):
            by_layer.setdefault(layer, []).append((key, own))
        return {
            key
            for rows in by_layer.values()
            for key, own in rows[: max(len(rows) // kept - 1, 0) * kept]
            if own
        }

    def _keep_estimates(self, estimates: Mapping[str, tuple[str, bytes]]) -> None:
        """Keep estimates for later readers, by layer with what they were made from, if possible.

        A map that was written whole is not changed by reading it: only one that trips are added to.
        """
        live = "SELECT 1 FROM header WHERE key = 'live'"
        with suppress(InputError):
            self._database.execute("PRAGMA busy_timeout = 200")
            with self._writing() as database:
                if database.execute(live).fetchone():
                    database.executemany(
                        "INSERT OR REPLACE INTO estimates VALUES (?, ?, ?)",
                        (
                            (layer, made_from, zlib.compress(data))
                            for layer, (made_from, data) in sorted(estimates.items())
                        ),
                    )

    # --------------------------------------------------------------------------------- logs

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
        if not self._asked("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'refused'"):
            return None
        asked = "SELECT path, reason, tried FROM refused WHERE sha256 = ?"
        found = self._asked(asked, (digest,))
        return Refusal(digest, *map(str, found[0])) if found else None

    def remember_refusals(self, refusals: Iterable[Refusal]) -> None:
        """Keep that logs were refused, in place of what is known of them."""
        with self._writing() as database:
            database.execute(_REFUSED)
            database.executemany("INSERT OR REPLACE INTO refused VALUES (?, ?, ?, ?)", refusals)


def begin(path: Path, empty: TrackConditionMap) -> None:
    """Begin a file, unless another process has just done so."""
    data = whole_file(replace(empty, layers={}, trips=()))
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


def _number_of(digests: Iterable[str]) -> int:
    """A number for rows, whatever their order, to which more can be added or taken away."""
    return reduce(xor, (int(digest[:16], 16) for digest in digests), 0)


# -------------------------------------------------------------------------------- estimates


def _packed(layer: ConditionLayer) -> bytes:
    """The estimate of a layer, as `_layer_of` reads it."""
    values = {each.name: getattr(layer, each.name) for each in fields(layer)}
    del values["evidence"]
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    facts: dict[str, Any] = {name: [asdict(each) for each in values[name]] for name in _LISTED} | {
        "model": [asdict(each) for each in layer.model.values()]
    }
    return pack(facts, arrays)


def _layer_of(evidence: DailyEvidence, data: bytes | None) -> ConditionLayer | None:
    """A layer with the estimate that the file keeps; None if it keeps none."""
    if data is None:
        return None
    try:
        facts, arrays = unpack(data)
        kept: dict[str, Any] = {**arrays}
        kept |= {
            name: tuple(kind(**each) for each in facts[name]) for name, kind in _LISTED.items()
        }
        kept["model"] = {each["name"]: ModelParameter(**each) for each in facts["model"]}
        return ConditionLayer(evidence=evidence, **kept)
    except (ValueError, KeyError, TypeError):
        return None


# ----------------------------------------------------------------------------- several files


def merge_files(paths: Sequence[str | Path], output: str | Path) -> tuple[int, int]:
    """One file from the files of several maps of one line; trips that several hold count once.

    The same recordings give the same bytes, however they are divided between the files. Which
    recording of a drive counts is decided anew among all.

    Parameters
    ----------
    paths : sequence of path
        At least one.
    output : path
        A new file.

    Returns
    -------
    trips, days : int
        How many trips the new map counts, and of how many days.

    Raises
    ------
    InputError
        If the maps differ in line, bins or settings, have sums of one drive in common, count a
        log in different layers, or the output exists.
    """
    if not paths:
        raise InputError("no map was given", remedy="name the files to merge")
    if Path(output).exists():
        raise InputError(
            "exists already",
            file=output,
            remedy="name a new file: processes may be adding to this one",
        )
    with merged(map(MapFile, paths), output) as whole:
        found = whole.amount()
        write_bytes(output, whole.data(in_order=True))
    return found


def merged(files: Iterable[MapFile], output: str | Path = "map") -> MapFile:
    """One map in memory from several open ones, which are closed; errors as `merge_files`."""
    empty: TrackConditionMap | None = None
    rows: dict[str, Row] = {}
    blobs: dict[str, bytes] = {}
    sums: dict[str, list[DailyEvidence]] = {}
    for file in files:
        with file, in_file(file.path), file.unchanging():
            _check_alike(empty, file.empty)
            empty = file.empty
            for row in file.trips():
                rows[row.key] = _chosen(rows.get(row.key), row)
            blobs.update(file._asked("SELECT digest, data FROM evidence"))
            for layer, piece in file.sums().items():
                sums.setdefault(layer, []).append(piece)
    assert empty is not None
    kept = _decided([rows[key] for key in sorted(rows)])
    used = sorted({digest for row in kept for digest in row.pieces.values()})
    totals = {layer: DailyEvidence.total(sums[layer]) for layer in sorted(sums)}
    return MapFile._made(empty, output, kept, ((each, blobs[each]) for each in used), totals)


def _chosen(first: Row | None, second: Row) -> Row:
    """Which of two rows of one recording is used, whatever their order."""
    if first is None:
        return second
    name = str(json.loads(second.entry).get("trip", ""))
    if first.layer != second.layer:
        raise InputError(
            f"counts trip '{name}' as '{second.layer}', another of the maps as '{first.layer}'",
            remedy="build one map from the logs instead",
        )
    fixed = [row for row in (first, second) if row.evidence is None and row.counted]
    if len(fixed) == 2:
        raise InputError(
            f"has trip '{name}' in its sums, and so has another of the maps",
            remedy="build one map from the logs instead",
        )
    if fixed:
        return fixed[0]
    kept = [row for row in (first, second) if row.evidence is not None] or [first, second]
    return min(kept, key=lambda row: (str(row.evidence), row.entry))


def _decided(rows: Sequence[Row]) -> list[Row]:
    """The rows, each with whether it counts."""
    known = [row for row in rows if row.identity]
    several = [known[number] for number in overlapping([str(row.identity) for row in known])]
    sums = [row for row in several if row.evidence is None and row.counted]
    apart = same_drives([row.known._replace(held=False) for row in sums])
    if apart:
        raise InputError(
            f"the sums of several maps hold one drive: {apart[0].sentence}",
            remedy="build one map from the logs instead",
        )
    reasons = reasons_of(several)
    alone = {row.key for row in rows} - {row.key for row in several}
    found = []
    for row in rows:
        counts = row.key in alone or row.key not in reasons
        changes = row.evidence is not None and bool(row.counted) != counts
        found.append(row._replace(counted=int(counts)) if changes else row)
    return found


def _check_alike(first: TrackConditionMap | None, second: TrackConditionMap) -> None:
    """Refuse to merge maps that differ in more than their trips."""
    for name in ("line", "length", "bin_length", "settings", "levels"):
        if first is not None and not np.array_equal(getattr(first, name), getattr(second, name)):
            stated = [
                f"{v.size} from {v[0]:g} to {v[-1]:g}" if isinstance(v, np.ndarray) else str(v)
                for v in (getattr(each, name) for each in (first, second))
            ]
            raise InputError(
                f"track-condition maps differ in {name}: {' and '.join(stated)}",
                remedy="merge maps of one line that were made with the same settings",
            )


# ------------------------------------------------------------------------- maps at hand


def map_to_bytes(condition: TrackConditionMap) -> bytes:
    """The bytes of a file with the map's evidence, added up by day: equal for equal maps.

    Raises
    ------
    InputError
        If an estimate of the map is not that of its evidence: the file could not hold it.

    Examples
    --------
    >>> condition = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> map_to_bytes(condition) == Path("sample_logs/CH_StGallen_Wil.map").read_bytes()
    True
    """
    _check_estimates(condition)
    return whole_file(condition)


def read_map(path: str | Path) -> TrackConditionMap:
    """Read a track-condition map.

    Raises
    ------
    InputError
        If the file cannot be read, or is not a map file, naming the place and the remedy.

    Examples
    --------
    >>> condition = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> condition.line, list(condition.layers)
    ('CH_StGallen_Wil', ['dry', 'wet'])
    """
    with MapFile(path) as opened:
        return opened.read()


def write_map(condition: TrackConditionMap, path: str | Path) -> None:
    """Write a track-condition map, whole or not at all; errors as `map_to_bytes`.

    A file that is there is replaced, with what other processes add to it at that moment: trips are
    added to a file by `analysis.update_map`.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> condition = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_map(condition, Path(folder) / "copy.map")
    ...     read_map(Path(folder) / "copy.map").bins
    1183
    """
    check_written(condition, TrackConditionMap)
    write_bytes(path, map_to_bytes(condition))


def whole_file(condition: TrackConditionMap) -> bytes:
    """As `map_to_bytes`, of a map with any estimate."""
    with MapFile.of_map(condition) as whole:
        return whole.data()


def _check_estimates(condition: TrackConditionMap) -> None:
    """Refuse a map with an estimate that its evidence does not give."""
    given = {n: each for n, each in condition.layers.items() if np.isfinite(each.log_mean).any()}
    if not given:
        return
    from trainlog.condition import estimated

    found = estimated(replace(condition, layers=given))
    for name, layer in given.items():
        own = found.layers[name]
        if not (
            np.allclose(layer.log_mean, own.log_mean, rtol=0.0, atol=1e-6)
            and np.allclose(layer.log_std, own.log_std, rtol=1e-6, atol=1e-9)
            and np.array_equal(layer.observed, own.observed)
        ):
            raise InputError(
                f"map of line '{condition.line}': the estimate of layer '{name}' is not that of its"
                " evidence, and a map's file holds evidence alone",
                remedy="change the evidence or the settings, and make the estimate of them"
                " (trainlog.condition.estimated)",
            )


# --------------------------------------------------------------------------------- refusals


def _check_kind(database: sqlite3.Connection, file: str | Path) -> None:
    """Refuse a database that is no map, or one of another version."""
    (application,) = database.execute("PRAGMA application_id").fetchone()
    (version,) = database.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION:
        raise InputError(
            "is an SQLite database, but has no track-condition map",
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
        words = str(error)
        for signs, problem, remedy in _TROUBLES:
            if any(sign in words for sign in signs):
                raise InputError(problem.format(words), file=file, remedy=remedy) from error
        raise _damaged(file, "database", words) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        # A value is not what the table says that it is.
        raise _damaged(file, "database", str(error)) from error


_TROUBLES = (
    (
        ("locked", "busy"),
        f"is being written by another process for more than {PATIENCE:g} s",
        "try again when it has ended",
    ),
    (
        ("readonly", "unable to open"),
        "cannot be written: {}",
        "choose a folder you may write to; what an interrupted update left must be undone by one"
        " who may",
    ),
    (
        ("full", "disk I/O"),
        "cannot be written: {}",
        "free some space on the disk and try again; what was acknowledged is kept",
    ),
)
"""Parts of messages of SQLite, what is wrong then, and the remedy."""


def _damaged(file: str | Path, place: str, what: str) -> InputError:
    """The error that states what of a file is damaged."""
    return InputError(
        f"is damaged: {' '.join(what.split())[:120]}",
        file=file,
        place=place,
        remedy="take a copy of it, or build the map anew from the logs (trainlog map update)",
    )

"""Registering logs: rows of trips and files, and which recording of a drive counts.

All of it happens in transactions of `Database.writing`, so that a process that is killed leaves no
half of it. Which recording counts follows from what is registered, not from the order in which it
came.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import sqlalchemy as sa

from trainlog.catalogue.database import Database, files, results, trip_edges, trips
from trainlog.catalogue.querying import conditions
from trainlog.display import counted
from trainlog.errors import InputError, LogError, TrainlogError, in_file
from trainlog.formats.files import logs_below, sha256_of
from trainlog.formats.railway import travelled_line
from trainlog.identity import COLUMNS, Known, TripIdentity, identity_of, same_drives
from trainlog.mcap.contents import Contents, MisplacedError, check_data_section, contents_used
from trainlog.mcap.reader import bare_trip, check_readable, position_span
from trainlog.mcap.records import Source
from trainlog.mcap.tables import frames_in
from trainlog.presentation import Column, Presented, WordTable, new_table
from trainlog.processes import in_processes
from trainlog.progress import track
from trainlog.railway.line import Line, in_km
from trainlog.trip import LINE_ATTACHMENT, PASSPORT_ATTACHMENT, POSITION_TOPICS, Trip
from trainlog.units import NANOSECONDS

_OWN = ("trip", "train", "kind", "line", "direction", "weather", "load", "software", "start")
"""Metadata that has a column; the rest are labels."""


@dataclass(frozen=True)
class LogEntry:
    """What the catalogue keeps of a trip.

    Attributes
    ----------
    values : dict
        By column of `TRIP_COLUMNS`, as the database holds it; without ``key``, ``sha256`` and
        ``added``.
    edges : tuple of (str, float, float, str)
        Lines that it ran over: name, kilometres from and to, direction.
    identity : TripIdentity or None
    """

    values: dict[str, Any]
    edges: tuple[tuple[str, float | None, float | None, str], ...] = ()
    identity: TripIdentity | None = None

    @property
    def key(self) -> str:
        """Digest of what was recorded; empty where that is not known."""
        found = self.identity
        if found is None:
            return ""
        content = f"{found.start.value} {found.end.value} {found.samples} ".encode()
        return sha256(content + found.blocks.astype("<u8").tobytes()).hexdigest()[:32]


@dataclass(frozen=True)
class FileEntry:
    """A file that was looked at: its content, and the trip in it or why it is none.

    Attributes
    ----------
    path : str
    sha256 : str
        Empty if it cannot be read.
    size : int or None
        [bytes]
    changed : int or None
        When it was written last [ns since 1970].
    entry : LogEntry or None
    reason : str
        Why it holds no trip.
    """

    path: str
    sha256: str
    size: int | None = None
    changed: int | None = None
    entry: LogEntry | None = None
    reason: str = field(default="", compare=False)


def read_file(path: str | Path) -> FileEntry:
    """A file as the catalogue registers it; one that cannot be used with the reason.

    A file that is written meanwhile is refused: nothing is known of its content.
    """
    name = str(path)
    try:
        before = Path(path).stat()
        digest = sha256_of(path)
        entry, reason = None, ""
        try:
            entry = read_entry(path)
        except TrainlogError as error:
            reason = _bare(error, name)
        after = Path(path).stat()
    except TrainlogError as error:
        return FileEntry(name, "", reason=_bare(error, name))
    except OSError as error:
        return FileEntry(name, "", reason=error.strerror or str(error))
    if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
        return FileEntry(name, "", reason="is being written; add it when that is done")
    return FileEntry(name, digest, after.st_size, after.st_mtime_ns, entry, reason)


def read_entry(path: str | Path) -> LogEntry:
    """What the catalogue keeps of a log: from its summary, and of the samples one column.

    Of a log whose checksum over all records does not hold, every record is read: what is lost is
    known then.

    Raises
    ------
    LogError
        If it is no log, holds no trip or no sample, or nothing of it is readable.
    InputError
        If there is no such file.

    Examples
    --------
    >>> entry = read_entry("sample_logs/nonstop.mcap")
    >>> entry.values["train"], entry.values["duration"], entry.values["messages"]
    ('CH_Stadler_FLIRT_TPF', 1183.1, 59285)
    """
    with Source(path) as source, in_file(path):
        contents, (trip, span) = contents_used(source, lambda found: _read(source, found))
        check_readable(contents.account)
        if not contents.account.messages:
            raise LogError("has no samples", remedy="leave it out: nothing was recorded")
    return _entry(trip, span, contents)


def _read(source: Source, contents: Contents) -> tuple[Trip, tuple[float, float] | None]:
    """The trip with the column that identifies it alone, and the positions between it was."""
    check_data_section(source, contents)
    trip = bare_trip(source, contents)
    present = {channel.topic for channel in contents.channels.values()}
    frames: dict[str, Any] = {}
    for topic, column, _ in COLUMNS:
        if topic not in present:
            continue
        chunks = list(contents.chunks)
        found = frames_in(source, contents, chunks, {topic: frozenset([column])}).get(topic)
        if found is not None and column in found and found[column].notna().any():
            frames = {topic: found}
            break
    span = None
    for topic in POSITION_TOPICS:
        try:
            span = span or (position_span(source, contents, topic) if topic in present else None)
        except MisplacedError:
            raise
        except LogError:
            continue
    return Trip(frames, trip.metadata, trip.provenance, trip.attachments), span


def _entry(trip: Trip, span: tuple[float, float] | None, contents: Contents) -> LogEntry:
    known, account = trip.metadata, contents.account
    topics = Counter[str]()
    for number, count in contents.counts().items():
        topics[contents.channels[number].topic] += count
    filled = [chunk for chunk in contents.chunks if chunk.counts]
    start = min(chunk.start for chunk in filled)
    end = max(chunk.end for chunk in filled)
    data = trip.attachments.get(LINE_ATTACHMENT)
    line = None
    with suppress(TrainlogError):
        line = None if data is None else travelled_line(data, known.get("direction") == "reverse")
    identity = identity_of(trip)
    km = _km(line, span)
    values = {
        "name": trip.name,
        "train": known.get("train"),
        "kind": known.get("kind"),
        "line": known.get("line") or (line.name if line is not None else None),
        "direction": known.get("direction"),
        "start": start,
        "end": end,
        "duration": (end - start) / NANOSECONDS,
        "distance": None if span is None else span[1] - span[0],
        "km_from": km[0],
        "km_to": km[1],
        "weather": known.get("weather"),
        "load": _number(known.get("load")),
        "labels": {key: value for key, value in sorted(known.items()) if key not in _OWN},
        "topics": dict(sorted(topics.items())),
        "passport": _passport(trip),
        "quality": "whole" if account.whole else "unclosed" if account.only_unclosed else "damaged",
        "damage": "" if account.whole else account.sentence,
        "repairs": sum(
            int(value)
            for key, value in known.items()
            if key.startswith("repair.") and value.isdecimal()
        ),
        "samples": 0 if identity is None else identity.samples,
        "messages": account.messages,
        "software": known.get("software"),
    }
    return LogEntry(values, _edges(values, line, span), identity)


def _km(line: Line | None, span: tuple[float, float] | None) -> tuple[float | None, float | None]:
    """The kilometres of a stretch [m], increasing."""
    if span is None:
        return None, None
    with suppress(InputError):
        found = np.sort(in_km(line, np.asarray(span)))
        return round(float(found[0]), 6), round(float(found[1]), 6)
    return None, None


def _edges(
    values: Mapping[str, Any], line: Line | None, span: tuple[float, float] | None
) -> tuple[tuple[str, float | None, float | None, str], ...]:
    """The lines that a trip ran over: those of its route, as far as it drove, or its line."""
    if line is not None and line.legs:
        parts = [each if span is None else each.between(*span) for each in line.legs]
        return tuple(
            (
                leg.edge,
                min(leg.edge_start, leg.edge_end) / 1e3,
                max(leg.edge_start, leg.edge_end) / 1e3,
                "forward" if leg.forward else "reverse",
            )
            for leg in parts
            if leg is not None
        )
    if not values["line"]:
        return ()
    direction = str(values["direction"] or "forward")
    return ((str(values["line"]), values["km_from"], values["km_to"], direction),)


def _passport(trip: Trip) -> dict[str, float]:
    """The value of each quantity of the passport that is known."""
    data = trip.attachments.get(PASSPORT_ATTACHMENT)
    found: dict[str, float] = {}
    if data is None:
        return found
    with suppress(ValueError, RecursionError):
        document = json.loads(data)
        if isinstance(document, dict):
            for name, quantity in sorted(document.items()):
                value = quantity.get("value") if isinstance(quantity, dict) else None
                if isinstance(value, int | float) and math.isfinite(value):
                    found[name] = float(value)
    return found


def _bare(error: TrainlogError, path: str) -> str:
    """An error without the name of the file, which stands beside it."""
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path}, ")


def _number(text: str | None) -> float | None:
    """A number of the metadata; None if it is none."""
    with suppress(TypeError, ValueError):
        value = float(text or "")
        return value if math.isfinite(value) else None
    return None


# ------------------------------------------------------------------------------------- registering

FileState = Literal["new", "recording", "version", "moved", "copy", "known", "refused"]

FILE_STATES: dict[FileState, str] = {
    "new": "a trip that was not known",
    "recording": "another recording of a drive, of which a fuller one counts",
    "version": "another content under a known name",
    "moved": "a known trip whose file stood elsewhere",
    "copy": "a known trip whose other file is still there",
    "known": "known, nothing to do",
    "refused": "no trip, with the reason",
}
"""What can become of a file that is added."""

_AT_ONCE = 500
"""Values in one statement."""


@dataclass(frozen=True)
class FileOutcome:
    """What became of a file: one of `FILE_STATES`, why it was refused, and what of it is lost."""

    path: str
    state: FileState
    reason: str = ""
    damage: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class Added(Presented):
    """What became of all files that were added."""

    outcomes: tuple[FileOutcome, ...] = field(default=())

    @property
    def title(self) -> str:
        """What became of the files."""
        return f"Added: {self.sentence}"

    def summary(self) -> dict[str, str]:
        """The first that were refused."""
        return {each.path: each.reason for each in self.of("refused")[:8]}

    def facts(self) -> dict[str, Any]:
        """How many files there are of each state."""
        return {"counts": self.counts}

    def tables(self) -> list[WordTable]:
        """A row per file."""
        columns = map(Column, ("path", "state", "reason", "damage"))
        return [new_table("Files", *columns, name="files", usual=False).add_rows(self.outcomes)]

    def sentences(self) -> list[str]:
        """Which logs are damaged, and what became of all files."""
        damaged = [each for each in self.outcomes if each.damage]
        return [*(f"damaged: {each.path}: {each.damage}" for each in damaged), self.sentence]

    def of(self, *states: FileState) -> list[FileOutcome]:
        """The outcomes of some states."""
        return [each for each in self.outcomes if each.state in states]

    @property
    def counts(self) -> dict[FileState, int]:
        """How many files there are of each state."""
        return {state: len(self.of(state)) for state in FILE_STATES}

    @property
    def sentence(self) -> str:
        """All of them in a line."""
        count = self.counts
        words = [f"{counted(count['new'], 'new trip')}"]
        damaged = len([each for each in self.of("new") if each.damage])
        words[0] += f" ({damaged} of damaged logs)" if damaged else ""
        other = count["recording"]
        words += [f"{counted(other, 'other recording')} of the same drives"] if other else []
        words += [f"{counted(count['version'], 'new version')}"] if count["version"] else []
        words += [f"{count['moved']} moved"] if count["moved"] else []
        words += [f"{counted(count['copy'], 'copy').replace('copys', 'copies')}"] * bool(
            count["copy"]
        )
        words += [f"{count['known']} unchanged"] if count["known"] else []
        words += [f"{count['refused']} refused"] if count["refused"] else []
        return ", ".join(words)


_STANDING = ("present", "refused", "vanished")
"""States of files that are where they were seen last."""


def register(
    connection: sa.Connection, entries: Sequence[FileEntry], now: int
) -> list[FileOutcome]:
    """Register files that were looked at; what became of each, in their order.

    Parameters
    ----------
    connection : of `Database.writing`
    entries : sequence of FileEntry
    now : int
        [ns since 1970]
    """
    read = {each.sha256: each for each in entries if each.entry is not None}
    ids = _ids(connection, read)
    new = [each for sha256, each in read.items() if sha256 not in ids]
    ids |= _inserted(connection, new, now)
    unseen, touched, found = {each.sha256 for each in new}, set(ids.values()), []
    seen = set[str]()
    for column, values in (
        (files.c.path, {each.path for each in entries}),
        (files.c.sha256, {each.sha256 for each in entries}),
    ):
        seen |= {row[column] for row in matching(connection, sa.select(column), column, values)}
    for each in entries:
        trip = ids[each.sha256] if each.entry is not None else None
        state = _place_file(connection, each, trip, seen, touched)
        if each.sha256 in unseen and state in ("moved", "copy"):
            state = "new"
        unseen -= {each.sha256} if trip is not None and state != "version" else set()
        found.append(FileOutcome(each.path, state, each.reason))
    settle(connection, touched)
    return found


def _place_file(
    connection: sa.Connection, entry: FileEntry, trip: int | None, seen: set[str], touched: set[int]
) -> FileState:
    """Put a file into the table of files, which has paths and contents that were seen.

    The trips whose files change are added to `touched`.
    """
    content = files.c.sha256 == entry.sha256
    same, state, before = (files.c.path == entry.path) & content, "new", None
    if entry.path in seen:
        before = connection.execute(sa.select(files.c.state).where(same)).scalar()
        state = "known" if before == "present" else "new"
    # Of a file that cannot be read nothing is known: what stood there is not overwritten.
    if entry.path in seen and entry.sha256:
        other = (files.c.path == entry.path) & ~content & files.c.state.in_(_STANDING)
        connection.execute(sa.delete(files).where(other, files.c.trip.is_(None)))
        asked = sa.update(files).where(other).values(state="replaced").returning(files.c.trip)
        replaced = set(connection.execute(asked).scalars())
        touched |= replaced
        state = "version" if replaced else state
    if trip is not None and state == "new" and entry.sha256 in seen:
        copies = sa.select(files).where(
            content, files.c.path != entry.path, files.c.state.in_(("present", "vanished"))
        )
        for row in connection.execute(copies.order_by(files.c.id)).mappings().all():
            if row["state"] == "present" and Path(row["path"]).is_file():
                state = "copy" if state == "new" else state
            else:
                state = "moved"
                gone = sa.update(files).where(files.c.id == row["id"])
                connection.execute(gone.values(state="moved"))
    values = {
        "path": entry.path,
        "sha256": entry.sha256,
        "size": entry.size,
        "changed": entry.changed,
        "trip": trip,
        "state": "refused" if trip is None else "present",
        "reason": entry.reason,
    }
    put = sa.insert(files) if before is None else sa.update(files).where(same)
    connection.execute(put.values(values))
    seen |= {entry.path, entry.sha256}
    return "refused" if trip is None else state  # type: ignore[return-value]


def _ids(connection: sa.Connection, digests: Iterable[str]) -> dict[str, int]:
    """The rows of trips by content."""
    asked = sa.select(trips.c.sha256, trips.c.id)
    found = matching(connection, asked, trips.c.sha256, digests)
    return {row["sha256"]: row["id"] for row in found}


def _inserted(connection: sa.Connection, entries: Sequence[FileEntry], now: int) -> dict[str, int]:
    """Insert the trips of files; their rows by content."""
    rows, edges = list[dict[str, Any]](), list[dict[str, Any]]()
    for each in entries:
        assert each.entry is not None
        identity = each.entry.identity
        rows.append(
            {
                **each.entry.values,
                "key": each.entry.key or each.sha256[:32],
                "sha256": each.sha256,
                "added": now,
                "source": "" if identity is None else identity.source,
                "blocks": b"" if identity is None else identity.blocks.astype("<u8").tobytes(),
                "standing": "counts",
            }
        )
    if rows:
        connection.execute(sa.insert(trips), rows)
    ids = _ids(connection, [each.sha256 for each in entries])
    names = ("edge", "km_from", "km_to", "direction")
    for each in entries:
        assert each.entry is not None
        edges += [
            {"trip": ids[each.sha256], "place": place, **dict(zip(names, edge, strict=True))}
            for place, edge in enumerate(each.entry.edges)
        ]
    if edges:
        connection.execute(sa.insert(trip_edges), edges)
    return ids


def forget(connection: sa.Connection, numbers: Sequence[int]) -> int:
    """Remove trips with their files and results; other recordings of their drives count then."""
    older = sa.select(trips.c.id).where(
        trips.c.same_as.in_(numbers), trips.c.standing == "older version"
    )
    every = sorted({*numbers, *connection.execute(older).scalars()})
    for table in (results, trip_edges, files):
        connection.execute(sa.delete(table).where(table.c.trip.in_(every)))
    connection.execute(sa.delete(trips).where(trips.c.id.in_(every)))
    left = sa.select(trips.c.id).where(trips.c.same_as.in_(every))
    settle(connection, set(connection.execute(left).scalars()))
    return len(numbers)


def parts(values: Sequence[Any]) -> Iterable[Sequence[Any]]:
    """Values in pieces that one statement takes."""
    return (values[at : at + _AT_ONCE] for at in range(0, len(values), _AT_ONCE))


def matching(
    connection: sa.Connection, asked: sa.Select[Any], column: Any, values: Iterable[Any]
) -> Iterator[_Row]:
    """The rows of a statement in which a column has one of some values, however many these are."""
    for part in parts(sorted(values)):
        yield from connection.execute(asked.where(column.in_(part))).mappings()


# ------------------------------------------------------------------------ which recording counts

_ASKED = [
    trips.c[name]
    for name in (
        "id", "name", "sha256", "train", "line", "start", "end", "samples", "messages", "quality",
        "source", "blocks", "standing", "same_as", "share",
    )
]  # fmt: skip

_QUALITIES = ("whole", "unclosed", "damaged")
"""The better one first."""

_Row = sa.RowMapping


def settle(connection: sa.Connection, touched: set[int]) -> None:
    """Decide which recording of each drive counts, of all drives that these trips are of.

    The rule is that of `trainlog.identity.same_drives`: the fullest. Of recordings that are equally
    full one whose file is present counts, then one with line and train, then that of the most
    messages, then one that is not damaged. What stood before under the name of another log is an
    older version and does not count, whatever that log holds.
    """
    if not touched:
        return
    drives = _drives(connection, touched)
    older = _older_versions(connection, drives)
    there = sa.select(files.c.trip).where(files.c.state == "present")
    present = {row["trip"] for row in matching(connection, there, files.c.trip, drives)}
    rows = [drives[number] for number in sorted(drives) if number not in older]
    known = []
    for row in rows:
        worse = (
            row["id"] not in present,
            sum(row[name] is None for name in ("line", "train")),
            -row["messages"],
            _QUALITIES.index(row["quality"]),
        )
        known.append(Known(row["name"], _identity(row), (*worse, row["sha256"])))
    new: dict[int, tuple[str, int | None, float | None]] = dict.fromkeys(
        drives, ("counts", None, None)
    )
    new |= {number: ("older version", other, None) for number, other in older.items()}
    for same in same_drives(known):
        new[rows[same.number]["id"]] = ("same drive", rows[same.other]["id"], same.share)
    for number, (standing, other, share) in new.items():
        row = drives[number]
        if (row["standing"], row["same_as"], row["share"]) != (standing, other, share):
            changed = {"standing": standing, "same_as": other, "share": share}
            connection.execute(sa.update(trips).where(trips.c.id == number).values(changed))


def _drives(connection: sa.Connection, touched: set[int]) -> dict[int, _Row]:
    """The trips, all that share recorded minutes with them, all that share some with these ..."""
    longest = connection.execute(sa.select(sa.func.max(trips.c.duration))).scalar() or 0.0
    found: dict[int, _Row] = {}
    new = _rows(connection, touched)
    while new:
        found |= new
        # The same minutes of a drive were recorded at the same time.
        one = trips.alias()
        met = sa.select(trips.c.id).join(
            one,
            trips.c.start.between(one.c.start - int(longest * 1e9) - 1, one.c.end)
            & (trips.c.end >= one.c.start),
        )
        beside = {row["id"] for row in matching(connection, met.distinct(), one.c.id, new)}
        new = _sharing(new, _rows(connection, beside - found.keys()))
    return found


def _rows(connection: sa.Connection, numbers: set[int]) -> dict[int, _Row]:
    found = matching(connection, sa.select(*_ASKED), trips.c.id, numbers)
    return {row["id"]: row for row in found}


def _sharing(rows: Mapping[int, _Row], others: Mapping[int, _Row]) -> dict[int, _Row]:
    """Those of the others that share a recorded minute, or the recorded file, with a trip."""
    if not others:
        return {}
    sources = {row["source"] for row in rows.values()} - {""}
    blocks = np.concatenate([_blocks(row) for row in rows.values()])
    every = [_blocks(row) for row in others.values()]
    owner = np.repeat(np.array(list(others)), [each.size for each in every])
    shared = set(owner[np.isin(np.concatenate(every), blocks)].tolist())
    return {n: row for n, row in others.items() if n in shared or row["source"] in sources}


def _blocks(row: _Row) -> np.ndarray[Any, np.dtype[np.uint64]]:
    return np.frombuffer(row["blocks"], dtype="<u8").astype(np.uint64)


def _identity(row: _Row) -> TripIdentity | None:
    import pandas as pd

    blocks = _blocks(row)
    if not blocks.size:
        return None
    first, last = (pd.Timestamp(row[name], tz="UTC") for name in ("start", "end"))
    return TripIdentity(first, last, row["samples"], blocks, row["source"])


def _older_versions(connection: sa.Connection, numbers: Iterable[int]) -> dict[int, int]:
    """Trips whose files were all overwritten by logs of trips, each with one that stands there."""
    there = ("present", "vanished")
    now, own = files.alias(), files.alias()
    stands = sa.exists().where(own.c.trip == files.c.trip, own.c.state.in_(there))
    asked = (
        sa.select(files.c.trip, sa.func.min(now.c.trip).label("now"))
        .join(now, (now.c.path == files.c.path) & now.c.state.in_(there))
        .where(files.c.state == "replaced", ~stands, now.c.trip.is_not(None))
        .group_by(files.c.trip)
    )
    found = matching(connection, asked, files.c.trip, numbers)
    return {row["trip"]: row["now"] for row in found}


BATCH = 200
"""Files that are registered in one transaction."""

_SECONDS = 2.0
"""After which what was read is registered [s]: what is interrupted loses no more."""

_TO_A_PROCESS = 8
"""Files that a process is given at once."""

_WORTH_PROCESSES = 200
"""Files from which on starting processes is worth it."""


@dataclass(frozen=True, eq=False, repr=False)
class Refreshed(Added):
    """How a catalogue compares with the disk, and what became of the files that were read.

    Attributes
    ----------
    same : int
        Files as they were.
    vanished, moved, changed : tuple of str
        Paths of files that are not there, of those that were found in another place, and of those
        whose content is another.
    back : int
        Files that had vanished and are there again.
    """

    same: int = 0
    vanished: tuple[str, ...] = ()
    moved: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    back: int = 0

    _others: ClassVar[tuple[str, ...]] = ("vanished", "moved", "changed")

    @property
    def title(self) -> str:
        """How the catalogue compares with the disk."""
        return f"Refreshed: {self.sentence}"

    def facts(self) -> dict[str, Any]:
        """Which files are as they were, and which are not."""
        return {name: getattr(self, name) for name in ("same", *self._others, "back")}

    def sentences(self) -> list[str]:
        """Which files are not as they were, and all of it in a line."""
        listed = [f"  {name}: {path}" for name in self._others for path in getattr(self, name)]
        return [*listed, self.sentence]

    @property
    def sentence(self) -> str:
        """All of it in a line."""
        words = [f"{counted(self.same, 'file')} as they were"]
        others = {name: len(getattr(self, name)) for name in self._others}
        words += [f"{count} {name}" for name, count in others.items() if count]
        words += [f"{self.back} back"] if self.back else []
        return ", ".join(words)


def read_files(paths: Sequence[str], jobs: int = 1) -> Iterator[FileEntry]:
    """Files as the catalogue registers them, read by several processes where there are many."""
    jobs = jobs if len(paths) >= _WORTH_PROCESSES else 1
    size = _TO_A_PROCESS if jobs > 1 else 1
    given = [paths[at : at + size] for at in range(0, len(paths), size)]
    for entries in in_processes(_read_all, None, given, jobs):
        yield from entries


def _read_all(_: None, paths: Sequence[str]) -> list[FileEntry]:

    return [read_file(path) for path in paths]


def batches(entries: Iterable[FileEntry]) -> Iterator[list[FileEntry]]:
    """Entries in batches: as many as a transaction takes, or those of some seconds."""
    batch: list[FileEntry] = []
    begun = time.monotonic()
    for entry in entries:
        batch.append(entry)
        if len(batch) == BATCH or time.monotonic() - begun > _SECONDS:
            yield batch
            batch, begun = [], time.monotonic()
    if batch:
        yield batch


def logs_named(paths: Iterable[str | Path]) -> list[str]:
    """The logs named and those in folders, however deep, each once.

    Raises
    ------
    InputError
        If a path does not exist, or there is no log.
    """
    found: dict[str, None] = {}
    for path in paths:
        given = Path(os.path.abspath(Path(path).expanduser()))  # noqa: PTH100
        if not given.exists():
            raise InputError("does not exist", file=path, remedy="check the path")
        found |= dict.fromkeys(map(str, logs_below(given) if given.is_dir() else [given]))
    if not found:
        raise InputError(
            "no log (*.mcap) was found",
            remedy="name logs or folders, or make logs of recordings with 'trainlog ingest'",
        )
    return list(found)


# --------------------------------------------------------------------- registered, and compared


def _settled(database: Database, outcomes: Sequence[FileOutcome]) -> tuple[FileOutcome, ...]:
    """New trips as they stand once all are registered: fuller recordings may have come."""
    asked = (
        sa.select(files.c.path, trips.c.standing, trips.c.quality, trips.c.damage)
        .join(trips, trips.c.id == files.c.trip)
        .where(files.c.state == "present")
    )
    found: dict[str, tuple[bool, str]] = {}
    new = [each.path for each in outcomes if each.state in ("new", "recording")]
    with database.reading() as connection:
        for row in matching(connection, asked, files.c.path, new):
            lost = row["damage"] if row["quality"] == "damaged" else ""
            found[row["path"]] = (row["standing"] == "same drive", lost)
    settled = []
    for each in outcomes:
        if each.state in ("new", "recording") and each.path in found:
            other, damage = found[each.path]
            each = replace(each, state="recording" if other else "new", damage=damage)
        settled.append(each)
    return tuple(settled)


def _unchanged(database: Database, paths: Sequence[str]) -> dict[str, tuple[Any, str]]:
    """Files that are known as they are, with their state and reason."""
    asked = sa.select(files).where(
        files.c.path.in_(paths), files.c.state.in_(("present", "refused"))
    )
    found: dict[str, tuple[Any, str]] = {}
    with database.reading() as connection:
        rows = connection.execute(asked).mappings().all()
    for row in rows:
        try:
            now = Path(row["path"]).stat()
        except OSError:
            continue
        if row["sha256"] and (now.st_size, now.st_mtime_ns) == (row["size"], row["changed"]):
            state = "known" if row["state"] == "present" else "refused"
            found[row["path"]] = (state, row["reason"])
    return found


def _compared(database: Database) -> tuple[set[int], set[int], set[str], int]:
    """Rows of files that are gone, and back; paths whose content changed; files as before."""
    asked = sa.select(files).where(files.c.state.in_(("present", "vanished")))
    gone, back, changed, same = set[int](), set[int](), set[str](), 0
    with database.reading() as connection:
        rows = connection.execute(asked).mappings().all()
    for row in track(rows, "looking for files", "file"):
        present = row["state"] == "present"
        try:
            now = Path(row["path"]).stat()
        except FileNotFoundError:
            gone |= {row["id"]} if present else set()
            continue
        except OSError:
            # A folder that may not be entered, a server that does not answer: not known.
            continue
        if (now.st_size, now.st_mtime_ns) != (row["size"], row["changed"]):
            changed.add(row["path"])
        elif present:
            same += 1
        else:
            back.add(row["id"])
    return gone, back, changed, same


class Files(Database):
    """The files of a catalogue: registered, compared with the disk, forgotten."""

    def add(
        self,
        paths: str | Path | Iterable[str | Path],
        report: Callable[[FileOutcome, int, int], object] | None = None,
        *,
        jobs: int = 1,
    ) -> Added:
        """Register logs, and those in folders and the folders in them.

        A file whose size and time of change are known is not read again. A log that cannot be used
        is listed with the reason and keeps no other from being registered.

        Parameters
        ----------
        paths : path, or iterable of them
        report : callable, optional
            Called with each outcome, the number of files that are finished, and that of all.
        jobs : int
            Processes that read, where there are many files.

        Returns
        -------
        Added

        Raises
        ------
        InputError
            If a path does not exist, or no log is found.

        Examples
        --------
        >>> import tempfile
        >>> from trainlog.catalogue import open_catalogue
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     first, again = catalogue.add("sample_logs"), catalogue.add("sample_logs")
        >>> first, again
        (Added: 2 new trips, Added: 0 new trips, 2 unchanged)
        """
        found = logs_named([paths] if isinstance(paths, str | Path) else list(paths))
        outcomes: list[FileOutcome] = []

        def state(done: Iterable[FileOutcome]) -> None:
            for outcome in done:
                outcomes.append(outcome)
                if report is not None:
                    report(outcome, len(outcomes), len(found))

        new: list[str] = []
        for part in parts(found):
            known = _unchanged(self, part)
            state(FileOutcome(path, *known[path]) for path in part if path in known)
            new += [path for path in part if path not in known]
        for entries in batches(read_files(new, jobs)):
            state(self.register(entries).outcomes)
        return Added(_settled(self, outcomes))

    def register(self, entries: Sequence[FileEntry]) -> Added:
        """Register files that were looked at, in transactions of some hundred files.

        Examples
        --------
        >>> import tempfile
        >>> from trainlog.catalogue import open_catalogue, read_file
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     catalogue.register([read_file("sample_logs/stopping.mcap")])
        Added: 1 new trip
        """
        outcomes: list[FileOutcome] = []
        for at in range(0, len(entries), BATCH):
            with self.writing() as connection:
                outcomes += register(connection, entries[at : at + BATCH], time.time_ns())
        return Added(_settled(self, outcomes))

    def refresh(self, paths: Iterable[str | Path] = ()) -> Refreshed:
        """Compare the catalogue with the disk: which files vanished, moved, changed or came back.

        Nothing is forgotten: a trip whose file vanished stays, and is found again by its content
        once its file is added from another place.

        Parameters
        ----------
        paths : iterable of path
            Folders that are searched for files that moved, as `add` does.

        Examples
        --------
        >>> import shutil, tempfile
        >>> from trainlog.catalogue import open_catalogue
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     log = shutil.copy("sample_logs/nonstop.mcap", folder)
        ...     _ = catalogue.add(folder)
        ...     Path(log).unlink()
        ...     catalogue.refresh()
        Refreshed: 0 files as they were, 1 vanished
        """
        paths = list(paths)
        gone, back, changed, same = _compared(self)
        for numbers, state in ((gone, "vanished"), (back, "present")):
            for part in parts(sorted(numbers)):
                # Unless another process has done something with the file meanwhile.
                seen = files.c.id.in_(part) & files.c.state.in_(("present", "vanished"))
                put = sa.update(files).where(seen).values(state=state).returning(files.c.trip)
                with self.writing() as connection:
                    settle(connection, set(connection.execute(put).scalars()) - {None})
        added = self.add(paths).outcomes if paths else ()
        read = [*self.register(list(read_files(sorted(changed)))).outcomes, *added]
        moved = [each.path for each in read if each.state == "moved"]
        with self.reading() as connection:
            asked = sa.select(files.c.path).where(files.c.state == "vanished")
            vanished = connection.execute(asked.order_by(files.c.path)).scalars().all()
        return Refreshed(
            tuple(read), same, tuple(vanished), tuple(moved), tuple(sorted(changed)), len(back)
        )

    def remove(self, where: str | None = None, *, vanished: bool = False) -> int:
        """Forget trips and what was computed of them; logs stay as they are. How many went.

        Another recording of the same drive counts then. A log that still stands in a folder that is
        added comes back.

        Parameters
        ----------
        where : str, optional
            As for `query`.
        vanished : bool
            Only trips of whose logs none is present.

        Raises
        ------
        InputError
            If nothing limits what is removed, or as `query`.
        """
        if where is None and not vanished:
            raise InputError(
                "nothing says which trips are to be removed",
                file=self.place,
                remedy="give an expression, or vanished ones",
            )
        asked = sa.select(trips.c.id).where(*conditions(where))
        if vanished:
            there = sa.select(files.c.trip).where(
                files.c.trip.is_not(None), files.c.state == "present"
            )
            asked = asked.where(trips.c.id.not_in(there))
        removed = 0
        with self.writing() as connection:
            for part in parts(sorted(connection.execute(asked).scalars())):
                removed += forget(connection, part)
        return removed

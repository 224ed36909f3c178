"""Registering logs: rows of trips and files, and which recording of a drive counts.

All of it happens in transactions of `Database.writing`, so that a process that is killed leaves no
half of it. Which recording counts follows from what is registered, not from the order in which it
came.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import sqlalchemy as sa

from trainlog.catalogue.database import Database, files, results, trip_edges, trips
from trainlog.catalogue.querying import conditions
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.identity import Known, TripIdentity, same_drives
from trainlog.presentation import Column, Presented, WordTable, new_table
from trainlog.processes import in_processes
from trainlog.progress import track

if TYPE_CHECKING:
    from trainlog.catalogue.reading import FileEntry

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


def register(
    connection: sa.Connection, entries: Sequence[FileEntry], now: int, present: Mapping[str, bool]
) -> list[FileOutcome]:
    """Register files that were looked at; what became of each, in their order.

    Parameters
    ----------
    connection : of `Database.writing`
    entries : sequence of FileEntry
    now : int
        [ns since 1970]
    present : mapping of str to bool
        Whether files of the same contents that are known stand where they stood, by path.
    """
    ids = _ids(connection, {each.sha256 for each in entries if each.entry is not None})
    known_before = set(ids)
    new = {each.sha256: each for each in entries if each.entry is not None}
    _insert(connection, [each for sha, each in new.items() if sha not in ids], now)
    ids |= _ids(connection, {sha for sha in new if sha not in ids})
    rows = _rows_of(connection, entries)
    found, touched = [], set[int]()
    for each in entries:
        trip = ids.get(each.sha256) if each.entry is not None else None
        state = _place_file(connection, each, trip, rows, present, touched)
        if trip is not None:
            touched.add(trip)
            if state in ("new", "moved", "copy") and each.sha256 not in known_before:
                state, known_before = "new", known_before | {each.sha256}
        found.append(FileOutcome(each.path, state, each.reason))
    new_rows = [
        {name: value for name, value in row.items() if name != "id"}
        for row in rows
        if row["id"] is None
    ]
    if new_rows:
        connection.execute(sa.insert(files), new_rows)
    settle(connection, touched)
    return found


def _place_file(
    connection: sa.Connection,
    entry: FileEntry,
    trip: int | None,
    rows: list[dict[str, Any]],
    present: Mapping[str, bool],
    touched: set[int],
) -> FileState:
    """Put a file into the table of files; the trips whose files change are added to `touched`."""
    here = [row for row in rows if row["path"] == entry.path]
    standing = [row for row in here if row["state"] in ("present", "refused", "vanished")]
    same = next((row for row in here if row["sha256"] == entry.sha256), None)
    state: FileState = "new" if trip is not None else "refused"
    if same is not None and same in standing and trip is not None and same["state"] == "present":
        state = "known"
    # Of a file that cannot be read nothing is known: what stood there is not overwritten.
    for row in standing if entry.sha256 else ():
        if row is same:
            continue
        if row["trip"] is None:
            if row["id"] is not None:
                connection.execute(sa.delete(files).where(files.c.id == row["id"]))
            rows.remove(row)
            continue
        state = "version" if trip is not None else state
        _set_file(connection, row, touched, state="replaced")
    if trip is not None and state == "new":
        for row in rows:
            if row["sha256"] != entry.sha256 or row["path"] == entry.path:
                continue
            if row["state"] == "present" and present.get(row["path"], True):
                state = "copy" if state == "new" else state
            elif row["state"] in ("present", "vanished"):
                state = "moved"
                _set_file(connection, row, touched, state="moved")
    values = {
        "path": entry.path,
        "sha256": entry.sha256,
        "size": entry.size,
        "changed": entry.changed,
        "trip": trip,
        "state": "refused" if trip is None else "present",
        "reason": entry.reason,
    }
    if same is not None:
        _set_file(connection, same, touched, **values)
    else:
        rows.append({"id": None, **values})
    return state


def _set_file(
    connection: sa.Connection, row: dict[str, Any], touched: set[int], **values: Any
) -> None:
    """Change a row of files; one without a number is inserted with all others of its batch."""
    if row["id"] is not None:
        connection.execute(sa.update(files).where(files.c.id == row["id"]).values(values))
    touched.update({row["trip"]} - {None})
    row.update(values)


def _rows_of(connection: sa.Connection, entries: Sequence[FileEntry]) -> list[dict[str, Any]]:
    """The rows of files of the same paths or contents."""
    found: dict[int, dict[str, Any]] = {}
    shas = {each.sha256 for each in entries} - {""}
    for column, values in ((files.c.path, {e.path for e in entries}), (files.c.sha256, shas)):
        for part in parts(sorted(values)):
            asked = sa.select(files).where(column.in_(part))
            found |= {row["id"]: dict(row) for row in connection.execute(asked).mappings()}
    return [found[number] for number in sorted(found)]


def _ids(connection: sa.Connection, digests: set[str]) -> dict[str, int]:
    """The rows of trips by content."""
    found: dict[str, int] = {}
    for part in parts(sorted(digests)):
        asked = sa.select(trips.c.sha256, trips.c.id).where(trips.c.sha256.in_(part))
        found |= {row.sha256: row.id for row in connection.execute(asked)}
    return found


def _insert(connection: sa.Connection, entries: Sequence[FileEntry], now: int) -> None:
    """Insert the trips of files."""
    rows, edges = [], []
    for each in entries:
        entry = each.entry
        assert entry is not None
        identity = entry.identity
        rows.append(
            {
                **entry.values,
                "key": entry.key or each.sha256[:32],
                "sha256": each.sha256,
                "added": now,
                "source": "" if identity is None else identity.source,
                "blocks": b"" if identity is None else identity.blocks.astype("<u8").tobytes(),
                "standing": "counts",
            }
        )
    if not rows:
        return
    connection.execute(sa.insert(trips), rows)
    ids = _ids(connection, {each.sha256 for each in entries})
    names = ("edge", "km_from", "km_to", "direction")
    for each in entries:
        assert each.entry is not None
        edges += [
            {"trip": ids[each.sha256], "place": place, **dict(zip(names, edge, strict=True))}
            for place, edge in enumerate(each.entry.edges)
        ]
    if edges:
        connection.execute(sa.insert(trip_edges), edges)


def place_again(connection: sa.Connection, rows: Sequence[int], gone: set[int]) -> None:
    """Mark files as vanished, those of `gone`, or as present again."""
    touched = set[int]()
    for number in rows:
        before, after = ("present", "vanished") if number in gone else ("vanished", "present")
        asked = (
            sa.update(files)
            .where(files.c.id == number, files.c.state == before)
            .values(state=after)
            .returning(files.c.trip)
        )
        touched |= set(connection.execute(asked).scalars()) - {None}
    settle(connection, touched)


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


# ------------------------------------------------------------------------ which recording counts

_ASKED = (
    trips.c.id,
    trips.c.key,
    trips.c.name,
    trips.c.sha256,
    trips.c.start,
    trips.c.end,
    trips.c.samples,
    trips.c.messages,
    trips.c.quality,
    trips.c.source,
    trips.c.blocks,
    trips.c.standing,
    trips.c.same_as,
    trips.c.share,
)

_QUALITIES = ("whole", "unclosed", "damaged")
"""The better one first."""

_Row = sa.RowMapping


def settle(connection: sa.Connection, touched: set[int]) -> None:
    """Decide which recording of each drive counts, of all drives that these trips are of.

    The rule is that of `trainlog.identity.same_drives`: the fullest. Of recordings that are equally
    full one whose file is present counts, then that of the most messages, then one that is not
    damaged. What stood before under the name of another log is an older version and does not count,
    whatever that log holds.
    """
    if not touched:
        return
    drives = _drives(connection, touched)
    placed = _files_by_trip(connection, sorted(drives))
    older = _older_versions(connection, placed)
    rows = [drives[number] for number in sorted(drives) if number not in older]
    states = {number: {row["state"] for row in placed.get(number, ())} for number in drives}
    known = [
        Known(
            row["name"],
            _identity(row),
            (
                "present" not in states[row["id"]],
                -row["messages"],
                _QUALITIES.index(row["quality"]),
                row["sha256"],
            ),
        )
        for row in rows
    ]
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
    found: dict[int, _Row] = {}
    new: dict[int, _Row] = {}
    for part in parts(sorted(touched)):
        asked = sa.select(*_ASKED).where(trips.c.id.in_(part))
        new |= {row["id"]: row for row in connection.execute(asked).mappings()}
    longest = connection.execute(sa.select(sa.func.max(trips.c.duration))).scalar() or 0.0
    while new:
        found |= new
        beside = _meeting(connection, new.values(), int(longest * 1e9) + 1)
        new = _sharing(new, {n: row for n, row in beside.items() if n not in found})
    return found


def _meeting(connection: sa.Connection, rows: Iterable[_Row], longest: int) -> dict[int, _Row]:
    """The trips that were on their way at the same time as one of these.

    The same minutes of a drive were recorded at the same time.
    """
    found: dict[int, _Row] = {}
    window: tuple[int, int] | None = None
    for row in sorted(rows, key=lambda row: row["start"]):
        start, end = row["start"], row["end"]
        if window is not None and start <= window[1] + longest:
            window = (window[0], max(window[1], end))
            continue
        found |= _within(connection, window, longest)
        window = (start, end)
    return found | _within(connection, window, longest)


def _within(
    connection: sa.Connection, window: tuple[int, int] | None, longest: int
) -> dict[int, _Row]:
    if window is None:
        return {}
    asked = sa.select(*_ASKED).where(
        trips.c.start.between(window[0] - longest, window[1]), trips.c.end >= window[0]
    )
    return {row["id"]: row for row in connection.execute(asked).mappings()}


def _sharing(rows: Mapping[int, _Row], others: Mapping[int, _Row]) -> dict[int, _Row]:
    """Those of the others that share a recorded minute, or the recorded file, with a trip."""
    if not others:
        return {}
    sources = {row["source"] for row in rows.values()} - {""}
    blocks = np.concatenate([_blocks(row) for row in rows.values()])
    numbers = list(others)
    every = [_blocks(others[number]) for number in numbers]
    owner = np.repeat(np.arange(len(numbers)), [each.size for each in every])
    shared = np.zeros(len(numbers), dtype=bool)
    shared[owner[np.isin(np.concatenate(every), blocks)]] = True
    return {
        number: others[number]
        for number, both in zip(numbers, shared.tolist(), strict=True)
        if both or others[number]["source"] in sources
    }


def _blocks(row: _Row) -> np.ndarray[Any, np.dtype[np.uint64]]:
    return np.frombuffer(row["blocks"], dtype="<u8").astype(np.uint64)


def _identity(row: _Row) -> TripIdentity | None:
    import pandas as pd

    blocks = _blocks(row)
    if not blocks.size:
        return None
    first, last = (pd.Timestamp(row[name], tz="UTC") for name in ("start", "end"))
    return TripIdentity(first, last, row["samples"], blocks, row["source"])


def _files_by_trip(
    connection: sa.Connection, numbers: Sequence[int]
) -> dict[int, list[dict[str, Any]]]:
    """The files of trips, and what else stood under their names."""
    found: dict[int, list[dict[str, Any]]] = {}
    for part in parts(numbers):
        asked = sa.select(files).where(files.c.trip.in_(part))
        for row in connection.execute(asked).mappings():
            found.setdefault(row["trip"], []).append(dict(row))
    return found


def _older_versions(
    connection: sa.Connection, placed: Mapping[int, Sequence[Mapping[str, Any]]]
) -> dict[int, int]:
    """Trips whose files were all overwritten by logs of trips, each with one that stands there."""
    states = {number: {row["state"] for row in rows} for number, rows in placed.items()}
    lost = [
        number
        for number, found in states.items()
        if "replaced" in found and not found & {"present", "vanished"}
    ]
    paths = {row["path"] for number in lost for row in placed[number]}
    now: dict[str, int] = {}
    for part in parts(sorted(paths)):
        asked = sa.select(files.c.path, files.c.trip).where(
            files.c.path.in_(part),
            files.c.state.in_(("present", "vanished")),
            files.c.trip.is_not(None),
        )
        now |= {row.path: row.trip for row in connection.execute(asked)}
    later = {
        number: [now[row["path"]] for row in placed[number] if row["path"] in now]
        for number in lost
    }
    return {number: min(others) for number, others in later.items() if others}


BATCH = 200
"""Files that are registered in one transaction."""

_SECONDS = 2.0
"""After which what was read is registered [s]: what is interrupted loses no more."""

_TO_A_PROCESS = 8
"""Files that a process is given at once."""

_WORTH_PROCESSES = 200
"""Files from which on starting processes is worth it."""


@dataclass(frozen=True, eq=False, repr=False)
class Refreshed(Presented):
    """How a catalogue compares with the disk.

    Attributes
    ----------
    same : int
        Files as they were.
    vanished, moved, changed : tuple of str
        Paths of files that are not there, of those that were found in another place, and of those
        whose content is another.
    back : int
        Files that had vanished and are there again.
    outcomes : tuple of FileOutcome
        Of what was read.
    """

    same: int
    vanished: tuple[str, ...] = ()
    moved: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    back: int = 0
    outcomes: tuple[FileOutcome, ...] = ()

    _others: ClassVar[tuple[str, ...]] = ("vanished", "moved", "changed")

    @property
    def title(self) -> str:
        """How the catalogue compares with the disk."""
        return f"Refreshed: {self.sentence}"

    def facts(self) -> dict[str, Any]:
        """Which files are as they were, and which are not."""
        return {name: getattr(self, name) for name in ("same", *self._others, "back")}

    def tables(self) -> list[WordTable]:
        """A row per file that was read."""
        columns = map(Column, ("path", "state", "reason", "damage"))
        return [new_table("Files", *columns, name="files", usual=False).add_rows(self.outcomes)]

    def sentences(self) -> list[str]:
        """Which files are not as they were, and all of it in a line."""
        listed = [f"  {name}: {path}" for name in self._others for path in getattr(self, name)]
        return [*listed, self.sentence]

    @property
    def sentence(self) -> str:
        """All of it in a line."""
        words = [f"{counted(self.same, 'file')} as they were"]
        words += [f"{len(self.vanished)} vanished"] if self.vanished else []
        words += [f"{len(self.moved)} moved"] if self.moved else []
        words += [f"{len(self.changed)} changed"] if self.changed else []
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
    from trainlog.catalogue.reading import read_file

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


def logs_below(paths: Iterable[str | Path]) -> list[str]:
    """The logs named and those in folders, however deep, each once.

    Raises
    ------
    InputError
        If a path does not exist, or there is no log.
    """
    found: dict[str, None] = {}
    for path in paths:
        given = os.path.abspath(Path(path).expanduser())  # noqa: PTH100
        if not Path(given).exists():
            raise InputError("does not exist", file=path, remedy="check the path")
        for each in _below(given) if Path(given).is_dir() else (given,):
            found[each] = None
    if not found:
        raise InputError(
            "no log (*.mcap) was found",
            remedy="name logs or folders, or make logs of recordings with 'trainlog ingest'",
        )
    return list(found)


def _below(folder: str) -> Iterator[str]:
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            if name.endswith(".mcap") and not name.startswith("."):
                yield str(Path(place) / name)


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
        for part in parts(new):
            for path, standing, quality, damage in connection.execute(
                asked.where(files.c.path.in_(part))
            ):
                lost = damage if quality == "damaged" else ""
                found[path] = (standing == "same drive", lost)
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


def _present(database: Database, entries: Sequence[FileEntry]) -> dict[str, bool]:
    """Whether known files of the same contents stand where they stood."""
    found: dict[str, bool] = {}
    with database.reading() as connection:
        for part in parts(sorted({each.sha256 for each in entries} - {""})):
            asked = sa.select(files.c.path).where(files.c.sha256.in_(part))
            found |= dict.fromkeys(connection.execute(asked).scalars(), False)
    return {path: Path(path).is_file() for path in found}


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
        found = logs_below([paths] if isinstance(paths, str | Path) else list(paths))
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
            part = entries[at : at + BATCH]
            present = _present(self, part)
            with self.writing() as connection:
                outcomes += register(connection, part, time.time_ns(), present)
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
        for part in parts(sorted(gone | back)):
            with self.writing() as connection:
                place_again(connection, part, gone)
        added = self.add(paths).outcomes if paths else ()
        read = [*self.register(list(read_files(sorted(changed)))).outcomes, *added]
        moved = [each.path for each in read if each.state == "moved"]
        with self.reading() as connection:
            asked = sa.select(files.c.path).where(files.c.state == "vanished")
            vanished = connection.execute(asked.order_by(files.c.path)).scalars().all()
        return Refreshed(
            same, tuple(vanished), tuple(moved), tuple(sorted(changed)), len(back), tuple(read)
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

"""Registering logs: rows of trips and files, and which recording of a drive counts.

All of it happens in transactions of `Database.writing`, so that a process that is killed leaves no
half of it. Which recording counts follows from what is registered, not from the order in which it
came.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import sqlalchemy as sa

from trainlog.catalogue.schema import files, results, trip_edges, trips
from trainlog.display import counted
from trainlog.identity import Known, TripIdentity, same_drives
from trainlog.presentation import Column, Presented, WordTable, new_table

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
    damaged. What stood before under the name of another recording of the same drive is an older
    version of it and does not count.
    """
    if not touched:
        return
    drives = _drives(connection, touched)
    placed = _files_by_trip(connection, sorted(drives))
    older = _older_versions(drives, placed)
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
    drives: Mapping[int, _Row], placed: Mapping[int, Sequence[Mapping[str, Any]]]
) -> dict[int, int]:
    """Trips whose files were all overwritten by others of the same drive, each with a later one."""
    drive_of = _drive_numbers(drives)
    now = {
        row["path"]: number
        for number, rows in placed.items()
        for row in rows
        if row["state"] in ("present", "vanished")
    }
    found = {}
    for number, rows in placed.items():
        states = {row["state"] for row in rows}
        if "replaced" not in states or states & {"present", "vanished"}:
            continue
        later = [now[row["path"]] for row in rows if row["path"] in now]
        later = [other for other in later if drive_of[other] == drive_of[number]]
        if later:
            found[number] = min(later)
    return found


def _drive_numbers(drives: Mapping[int, _Row]) -> dict[int, int]:
    """The least number of a trip that shares a minute with each, directly or over others."""
    first: dict[int, int] = {}
    group = {number: number for number in drives}

    def root(number: int) -> int:
        while group[number] != number:
            number = group[number]
        return number

    for number in sorted(drives):
        row = drives[number]
        marks = [("block", each) for each in _blocks(row).tolist()]
        marks += [("source", row["source"])] if row["source"] else []
        for mark in marks:
            other = first.setdefault(mark, number)  # type: ignore[arg-type]
            a, b = root(other), root(number)
            group[max(a, b)] = min(a, b)
    return {number: root(number) for number in drives}

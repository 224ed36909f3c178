"""Adding logs to a catalogue: found, read by several processes, registered; and seen to again."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import sqlalchemy as sa

from trainlog.catalogue.database import Database
from trainlog.catalogue.querying import conditions
from trainlog.catalogue.registration import (
    Added,
    FileOutcome,
    forget,
    parts,
    place_again,
    register,
)
from trainlog.catalogue.schema import files, trips
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.presentation import Column, Presented, WordTable, new_table
from trainlog.processes import in_processes
from trainlog.progress import track

if TYPE_CHECKING:
    from trainlog.catalogue.reading import FileEntry

BATCH = 200
"""Files that are registered in one transaction."""

_SECONDS = 2.0
"""After which what was read is registered [s]: what is interrupted loses no more."""

_AT_ONCE = 8
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
    size = _AT_ONCE if jobs > 1 else 1
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

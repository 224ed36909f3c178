"""A catalogue, open: files are added, trips asked for, results kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import pandas as pd
import sqlalchemy as sa

from trainlog.catalogue import disk, results as stored
from trainlog.catalogue.disk import Refreshed, batches, logs_below, read_files
from trainlog.catalogue.registration import (
    Added,
    FileOutcome,
    forget,
    parts,
    place_again,
    register,
)
from trainlog.catalogue.results import ResultOutcome, ResultState
from trainlog.catalogue.schema import (
    TRIP_COLUMNS,
    Database,
    files,
    on_line,
    trip_edges,
    trips,
)
from trainlog.display import as_text, counted
from trainlog.errors import InputError
from trainlog.formats.settings import read_settings
from trainlog.progress import track

if TYPE_CHECKING:
    import pyarrow as pa

    from trainlog.catalogue.reading import FileEntry
    from trainlog.trip import Trip

_DEFAULT = "catalogue"
"""Folder of the catalogue where none is named."""

_COLUMNS = [each.name for each in TRIP_COLUMNS]


def open_catalogue(
    where: str | Path | None = None,
    *,
    results: str | Path | None = None,
    create: bool = True,
) -> Catalogue:
    """Open the catalogue of a fleet; a new one is made where there is none.

    Parameters
    ----------
    where : path or str, optional
        A folder, which holds the database (SQLite) and the results, or the URL of a PostgreSQL
        database: ``postgresql://user@host/database``, with ``?schema=name`` for a schema of its
        own. Default: as set (``trainlog settings set catalogue``), else the folder ``catalogue``.
    results : path, optional
        Folder of the results of a new catalogue in PostgreSQL.
    create : bool
        Whether it is made where there is none.

    Returns
    -------
    Catalogue
        A context manager that closes the database.

    Raises
    ------
    InputError
        If there is none and none is to be made, it is of a later version, or cannot be reached.
    MissingExtraError
        If the extra ``fleet`` is not installed, or ``postgresql`` with a URL.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
    ...     _ = catalogue.add("sample_logs")
    ...     catalogue.query("weather = 'wet'")["name"].tolist()
    ['trip-03']
    """
    return Catalogue(where or read_settings().catalogue or _DEFAULT, results, create=create)


class Catalogue:
    """Which trips there are, where their logs stand, and what was computed of them.

    `open_catalogue` opens one. Several processes may use the same catalogue at once.
    """

    def __init__(
        self, where: str | Path, results: str | Path | None = None, *, create: bool = True
    ) -> None:
        self._database = Database(where, results, create=create)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the database."""
        self._database.close()

    def __repr__(self) -> str:
        counts = self.counts()
        rows = {name: f"{count:,}" for name, count in counts.items()}
        return as_text(f"Catalogue {self._database.place}", rows)

    def __len__(self) -> int:
        with self._database.reading() as connection:
            asked = sa.select(sa.func.count()).select_from(trips)
            return int(connection.execute(asked.where(trips.c.standing == "counts")).scalar_one())

    @property
    def place(self) -> str:
        """Where it is: a folder, or a URL without its password."""
        return self._database.place

    @property
    def results_folder(self) -> Path:
        """Folder of the results."""
        return self._database.results

    def counts(self) -> dict[str, int]:
        """How many trips count, how many recordings of the same drives there are, and files."""
        with self._database.reading() as connection:
            count = sa.func.count()
            standing = connection.execute(
                sa.select(trips.c.standing, count).group_by(trips.c.standing)
            )
            states = connection.execute(sa.select(files.c.state, count).group_by(files.c.state))
            trips_by = {row[0]: int(row[1]) for row in standing}
            files_by = {row[0]: int(row[1]) for row in states}
        return {
            "trips": trips_by.get("counts", 0),
            "other recordings": trips_by.get("same drive", 0),
            "older versions": trips_by.get("older version", 0),
            "files": files_by.get("present", 0),
            "vanished": files_by.get("vanished", 0),
            "refused": files_by.get("refused", 0),
        }

    # ---------------------------------------------------------------------------------- files

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
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     first, again = catalogue.add("sample_logs"), catalogue.add("sample_logs")
        >>> first, again
        (Added: 2 new trips, Added: 0 new trips, 2 unchanged)
        """
        every = [paths] if isinstance(paths, str | Path) else list(paths)
        found = logs_below(every)
        outcomes: list[FileOutcome] = []

        def state(done: Iterable[FileOutcome]) -> None:
            for outcome in done:
                outcomes.append(outcome)
                if report is not None:
                    report(outcome, len(outcomes), len(found))

        new: list[str] = []
        for part in parts(found):
            known = self._unchanged(part)
            state(FileOutcome(path, *known[path]) for path in part if path in known)
            new += [path for path in part if path not in known]
        for entries in batches(read_files(new, jobs)):
            state(self.register(entries).outcomes)
        return Added(self._settled(outcomes))

    def register(self, entries: Sequence[FileEntry]) -> Added:
        """Register files that were looked at, in transactions of some hundred files.

        Examples
        --------
        >>> import tempfile
        >>> from trainlog.catalogue import read_file
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     catalogue.register([read_file("sample_logs/stopping.mcap")])
        Added: 1 new trip
        """
        outcomes: list[FileOutcome] = []
        for at in range(0, len(entries), disk.BATCH):
            part = entries[at : at + disk.BATCH]
            present = self._present(part)
            with self._database.writing() as connection:
                outcomes += register(connection, part, time.time_ns(), present)
        return Added(self._settled(outcomes))

    def _settled(self, outcomes: Sequence[FileOutcome]) -> tuple[FileOutcome, ...]:
        """New trips as they stand once all are registered: fuller recordings may have come."""
        asked = (
            sa.select(files.c.path, trips.c.standing, trips.c.quality, trips.c.damage)
            .join(trips, trips.c.id == files.c.trip)
            .where(files.c.state == "present")
        )
        found: dict[str, tuple[bool, str]] = {}
        new = [each.path for each in outcomes if each.state in ("new", "recording")]
        with self._database.reading() as connection:
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

    def _unchanged(self, paths: Sequence[str]) -> dict[str, tuple[Any, str]]:
        """Files that are known as they are, with their state and reason."""
        asked = sa.select(files).where(
            files.c.path.in_(paths), files.c.state.in_(("present", "refused"))
        )
        found: dict[str, tuple[Any, str]] = {}
        with self._database.reading() as connection:
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

    def _present(self, entries: Sequence[FileEntry]) -> dict[str, bool]:
        """Whether known files of the same contents stand where they stood."""
        found: dict[str, bool] = {}
        with self._database.reading() as connection:
            for part in parts(sorted({each.sha256 for each in entries} - {""})):
                asked = sa.select(files.c.path).where(files.c.sha256.in_(part))
                found |= dict.fromkeys(connection.execute(asked).scalars(), False)
        return {path: Path(path).is_file() for path in found}

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
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     log = shutil.copy("sample_logs/nonstop.mcap", folder)
        ...     _ = catalogue.add(folder)
        ...     Path(log).unlink()
        ...     catalogue.refresh()
        Refreshed: 0 files as they were, 1 vanished
        """
        every = list(paths)
        gone, back, changed, same = self._compared()
        for part in parts(sorted(gone | back)):
            with self._database.writing() as connection:
                place_again(connection, part, gone)
        added = self.add(every).outcomes if every else ()
        read = [*self.register(list(read_files(sorted(changed)))).outcomes, *added]
        moved = [each.path for each in read if each.state == "moved"]
        with self._database.reading() as connection:
            asked = sa.select(files.c.path).where(files.c.state == "vanished")
            vanished = connection.execute(asked.order_by(files.c.path)).scalars().all()
        return Refreshed(
            same, tuple(vanished), tuple(moved), tuple(sorted(changed)), len(back), tuple(read)
        )

    def _compared(self) -> tuple[set[int], set[int], set[str], int]:
        """Rows of files that are gone, and back; paths whose content changed; files as before."""
        asked = sa.select(files).where(files.c.state.in_(("present", "vanished")))
        gone, back, changed, same = set[int](), set[int](), set[str](), 0
        with self._database.reading() as connection:
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
        asked = sa.select(trips.c.id).where(
            trips.c.standing == "counts", *self._conditions(where, None, None, None, None, None)
        )
        if vanished:
            there = sa.select(files.c.trip).where(
                files.c.trip.is_not(None), files.c.state == "present"
            )
            asked = asked.where(trips.c.id.not_in(there))
        removed = 0
        with self._database.writing() as connection:
            for part in parts(sorted(connection.execute(asked).scalars())):
                removed += forget(connection, part)
        return removed

    def uncounted(self) -> pd.DataFrame:
        """What does not count, and why: copies, other recordings, old versions, vanished, refused.

        Returns
        -------
        DataFrame
            With the columns ``path``, ``what`` and ``reason``, in the order of path.
        """
        other = trips.alias("other")
        standing = (
            sa.select(files.c.path, trips.c.standing, other.c.name, trips.c.share, other.c.key)
            .select_from(trips)
            .join(files, files.c.trip == trips.c.id)
            .join(other, other.c.id == trips.c.same_as)
            .where(files.c.state == "present", trips.c.standing != "counts")
        )
        state = sa.select(files.c.path, files.c.state, files.c.reason).where(
            files.c.state.in_(("vanished", "refused"))
        )
        first = (
            sa.select(files.c.trip, sa.func.min(files.c.path).label("path"))
            .where(files.c.state == "present")
            .group_by(files.c.trip)
            .subquery()
        )
        copies = sa.select(files.c.path, first.c.path).where(
            files.c.trip == first.c.trip, files.c.state == "present", files.c.path != first.c.path
        )
        with self._database.reading() as connection:
            found = [
                (path, what, f"{'' if share is None else f'{share:.0%} in '}'{name}' ({key[:8]})")
                for path, what, name, share, key in connection.execute(standing)
            ]
            found += [(path, what, reason) for path, what, reason in connection.execute(state)]
            known = {path for path, *_ in found}
            found += [
                (path, "copy", f"the same as {other}")
                for path, other in connection.execute(copies)
                if path not in known
            ]
        return pd.DataFrame(sorted(found), columns=["path", "what", "reason"])

    def overview(self) -> pd.DataFrame:
        """One row a train and line, of the trips that count.

        Returns
        -------
        DataFrame
            ``train``, ``kind``, ``line``, ``trips``, ``first`` and ``last`` start, ``distance`` [m]
            and ``duration`` [s] in all.
        """
        by = (trips.c.train, trips.c.kind, trips.c.line)
        asked = (
            sa.select(
                *by,
                sa.func.count(),
                sa.func.min(trips.c.start),
                sa.func.max(trips.c.start),
                sa.func.sum(trips.c.distance),
                sa.func.sum(trips.c.duration),
            )
            .where(trips.c.standing == "counts")
            .group_by(*by)
        )
        names = ["train", "kind", "line", "trips", "first", "last", "distance", "duration"]
        with self._database.reading() as connection:
            frame = pd.DataFrame(connection.execute(asked).all(), columns=names)
        for name in ("first", "last"):
            frame[name] = pd.to_datetime(frame[name].astype("Int64"), unit="ns", utc=True)
        order = frame[["train", "kind", "line"]].fillna("")
        return frame.loc[order.sort_values(["train", "kind", "line"]).index].reset_index(drop=True)

    # ---------------------------------------------------------------------------------- trips

    def query(
        self,
        where: str | None = None,
        *,
        train: str | None = None,
        line: str | None = None,
        start: Any = None,
        end: Any = None,
        zone: str | None = None,
        columns: Sequence[str] | None = None,
    ) -> pd.DataFrame:
        """The trips that an expression and the other limits choose, in the order of start and key.

        Parameters
        ----------
        where : str, optional
            ``"weather = 'wet' and duration > '20 min'"``; docs/catalogue.md lists what is known.
        train, line : str, optional
            Of a route, each line that it runs over counts.
        start, end : anything that `pandas.Timestamp` takes, optional
            Trips that start in this time, both ends belonging to it; a day as an end counts whole.
        zone : str, optional
            Time zone of times that state none; default UTC.
        columns : sequence of str, optional
            Of `TRIP_COLUMNS`, and ``path``; default: all.

        Returns
        -------
        DataFrame
            One row a trip. Numbers are in SI units, but kilometres; ``attrs["units"]`` lists them.
            ``path`` is that of a log that is present; None if all have vanished.

        Raises
        ------
        InputError
            If the expression is not understood, or a time or column is none.

        Examples
        --------
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     found = catalogue.query("duration > '20 min'", start="2024-10-07")
        >>> found[["name", "weather", "km_to"]].values.tolist()
        [['trip-03', 'wet', 29.55647]]
        """
        names = [*_COLUMNS, "path"] if columns is None else list(columns)
        for name in names:
            if name not in _COLUMNS and name != "path":
                raise InputError(
                    f"'{name}' is no column of trips", remedy=f"known: {', '.join(_COLUMNS)}, path"
                )
        path = (
            sa.select(sa.func.min(files.c.path))
            .where(files.c.trip == trips.c.id, files.c.state == "present")
            .scalar_subquery()
            .label("path")
        )
        asked = sa.select(*(path if name == "path" else trips.c[name] for name in names))
        conditions = self._conditions(where, train, line, start, end, zone)
        asked = asked.where(trips.c.standing == "counts", *conditions)
        with self._database.reading() as connection:
            rows = connection.execute(asked.order_by(trips.c.start, trips.c.key)).all()
        return _frame(rows, names)

    def _conditions(
        self, where: str | None, train: Any, line: Any, start: Any, end: Any, zone: str | None
    ) -> list[sa.ColumnElement[bool]]:
        from trainlog.catalogue.days import times_of

        found: list[sa.ColumnElement[bool]] = []
        if where is not None:
            found.append(_condition(where, zone))
        if train is not None:
            found.append(trips.c.train == train)
        if line is not None:
            found.append(on_line(trips.c.line == line, trip_edges.c.edge == line))
        first = None if start is None else times_of(start, zone)[0]
        last = None if end is None else times_of(end, zone)[1]
        if first is not None and last is not None and first > last:
            raise InputError(
                f"the time from {start} to {end} ends before it begins",
                remedy="give the earlier time first",
            )
        if first is not None:
            found.append(trips.c.start >= first)
        if last is not None:
            found.append(trips.c.start <= last)
        return found

    def unmatched(
        self, where: str | None = None, train: str | None = None, line: str | None = None
    ) -> list[str]:
        """Names that are asked for and that no trip has, each in a sentence with similar ones.

        Parameters are those of `query`; of an expression, texts that a column must equal.

        Examples
        --------
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     catalogue.unmatched("weather = 'Wet'")
        ["no trip has the weather 'Wet'; did you mean 'wet'? known: dry, wet"]
        """
        from trainlog.catalogue.where import texts_asked

        asked = [] if where is None else texts_asked(where)
        asked += [(n, v) for n, v in (("train", train), ("line", line)) if v is not None]
        found = []
        for column, value in dict.fromkeys(asked):
            values = self._values(column)
            if value in values:
                continue
            folded = {each.casefold(): each for each in reversed(values)}
            close = get_close_matches(value.casefold(), list(folded), n=1)
            meant = f" did you mean '{folded[close[0]]}'?" if close else ""
            more = f" and {len(values) - 8} more" if len(values) > 8 else ""
            known = f" known: {', '.join(values[:8])}{more}" if values else " none states any"
            found.append(f"no trip has the {column} '{value}';{meant}{known}")
        return found

    def _values(self, column: str) -> list[str]:
        """Texts of a column, of the trips that count; of lines, the edges of routes, too."""
        counts = trips.c.standing == "counts"
        asked = [sa.select(trips.c[column]).where(counts).distinct()]
        if column == "line":
            edges = sa.select(trip_edges.c.edge).join(trips, trips.c.id == trip_edges.c.trip)
            asked.append(edges.where(counts).distinct())
        with self._database.reading() as connection:
            found = {value for each in asked for value in connection.execute(each).scalars()}
        return sorted(each for each in found if each is not None)

    def paths(self, where: str | None = None, **limits: Any) -> list[Path]:
        """The logs of the trips that `query` chooses, in its order.

        Raises
        ------
        InputError
            As `query`; if no trip is found, or the logs of some have vanished, which are named.
        """
        found = self.query(where, columns=["name", "key", "path"], **limits)
        if not len(found):
            why = self.unmatched(where, limits.get("train"), limits.get("line"))
            raise InputError(
                f"no trip of the {counted(len(self), 'trip')} of the catalogue is chosen"
                + "".join(f"; {each}" for each in why),
                file=self.place,
                remedy="'trainlog catalogue list' shows which trains and lines there are",
            )
        gone = found[found["path"].isna()]
        if len(gone):
            names = ", ".join(gone["name"].iloc[:5])
            more = f" and {len(gone) - 5} more" if len(gone) > 5 else ""
            raise InputError(
                f"the logs of {counted(len(gone), 'trip')} have vanished: {names}{more}",
                file=self.place,
                remedy="add the folder that they were moved to, or remove them from the catalogue",
            )
        return [Path(path) for path in found["path"]]

    def open(self, trip: str | Mapping[str, Any] | pd.Series, *topics: str) -> Trip:
        """Read the log of a trip.

        Parameters
        ----------
        trip : str, or a row of the frame of trips
            Its key, or the beginning of it.
        *topics : str
            Topics to read; default: all.

        Raises
        ------
        InputError
            If there is no such trip, the beginning is that of several, or its log has vanished.

        Examples
        --------
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     trip = catalogue.open(catalogue.query("weather = 'wet'").iloc[0])
        >>> trip.name
        'trip-03'
        """
        key = trip if isinstance(trip, str) else str(trip["key"])
        asked = sa.select(trips.c.key, trips.c.name).where(
            trips.c.standing == "counts", trips.c.key.startswith(key, autoescape=True)
        )
        with self._database.reading() as connection:
            found = connection.execute(asked.limit(2)).all()
        if len(found) != 1 or not key:
            what = f"several trips begin with '{key}'" if found else f"there is no trip '{key}'"
            raise InputError(what, file=self.place, remedy="give the key that 'query' lists")
        (path,) = self.paths(f"key = '{found[0][0]}'")
        from trainlog.mcap import read_log

        return read_log(path, topics or None)

    # -------------------------------------------------------------------------------- results

    def pending(
        self,
        analysis: str,
        code: str,
        parameters: Mapping[str, Any] | None = None,
        *,
        where: str | None = None,
        page: tuple[str, int] | None = None,
    ) -> pd.DataFrame:
        """The trips of which an analysis has not been recorded, in the order of key.

        Those whose logs have vanished are not among them. A log whose content changed is asked for
        anew: what was computed of it before is not of this content.

        Parameters
        ----------
        analysis : str
        code : str
            Version of its code.
        parameters : mapping, optional
            Values of JSON.
        where : str, optional
            As for `query`.
        page : (str, int), optional
            Only trips behind this key, and so many at most.

        Returns
        -------
        DataFrame
            With the columns ``key``, ``sha256`` and ``path``.
        """
        condition = None if where is None else _condition(where)
        return stored.pending(self._database, analysis, code, parameters, condition, page)

    def standing(
        self,
        analysis: str,
        code: str,
        parameters: Mapping[str, Any] | None = None,
        *,
        where: str | None = None,
    ) -> dict[str, int]:
        """How many trips of an analysis are ``done``, ``refused``, ``failed`` and ``pending``.

        Parameters are those of `pending`.
        """
        condition = None if where is None else _condition(where)
        return stored.standing(self._database, analysis, code, parameters, condition)

    def problems(
        self,
        analysis: str,
        code: str,
        parameters: Mapping[str, Any] | None = None,
        *,
        where: str | None = None,
        most: int = 1000,
    ) -> pd.DataFrame:
        """The trips that an analysis refused, or failed at, with the reasons, in the order of key.

        Parameters are those of `pending`, and how many are listed at most.

        Returns
        -------
        DataFrame
            With the columns ``key``, ``name``, ``path``, ``state`` and ``reason``.
        """
        condition = None if where is None else _condition(where)
        return stored.problems(self._database, analysis, code, parameters, condition, most)

    def forget(
        self,
        analysis: str,
        code: str,
        parameters: Mapping[str, Any] | None = None,
        *,
        where: str | None = None,
        states: Sequence[ResultState] = ("refused", "failed"),
    ) -> int:
        """Make trips pending again that an analysis refused or failed at; how many.

        Parameters are those of `pending`, and the states that are forgotten.
        """
        condition = None if where is None else _condition(where)
        return stored.forget(self._database, analysis, code, parameters, condition, states)

    def record(
        self,
        analysis: str,
        code: str,
        parameters: Mapping[str, Any] | None,
        outcomes: Sequence[ResultOutcome],
        table: pa.Table | None = None,
    ) -> int:
        """Keep what was computed of a batch of trips: the table first, then all rows at once.

        Of a trip that was recorded meanwhile, by another process perhaps, nothing is recorded a
        second time.

        Parameters
        ----------
        analysis, code, parameters
            As for `pending`.
        outcomes : sequence of ResultOutcome
            One a trip, of those that gave nothing, too.
        table : pyarrow.Table, optional
            Rows of all of them, with the column ``key``.

        Returns
        -------
        int
            How many were recorded.

        Raises
        ------
        InputError
            If the table does not hold the rows that the outcomes state, or cannot be written.

        Examples
        --------
        >>> import tempfile
        >>> import pyarrow as pa
        >>> from trainlog.catalogue import ResultOutcome
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     todo = catalogue.pending("stops", "1")
        ...     table = pa.table({"key": todo["key"].tolist(), "stops": [8, 0]})
        ...     done = [ResultOutcome(row.key, row.sha256, rows=1) for row in todo.itertuples()]
        ...     recorded = catalogue.record("stops", "1", {}, done, table)
        ...     left = len(catalogue.pending("stops", "1"))
        >>> recorded, left
        (2, 0)
        """
        return stored.record(self._database, analysis, code, parameters, outcomes, table)

    def results(
        self,
        analysis: str,
        code: str | None = None,
        parameters: Mapping[str, Any] | None = None,
        *,
        where: str | None = None,
    ) -> pd.DataFrame:
        """The tables of all trips together, in the order of trip, with what is known of these.

        Parameters
        ----------
        analysis : str
        code, parameters : optional
            Default: those that were recorded last.
        where : str, optional
            As for `query`.

        Returns
        -------
        DataFrame
            The columns of the analysis, with ``key``, and ``train``, ``kind``, ``line`` and
            ``start`` of the trip where it has none of that name.
        """
        condition = None if where is None else _condition(where)
        return stored.merged(self._database, analysis, code, parameters, condition)

    def computations(self) -> pd.DataFrame:
        """What was computed of the trips, the latest first.

        Returns
        -------
        DataFrame
            The columns ``analysis``, ``code``, ``parameters`` (a dict), and how many trips are
            ``done``, ``refused`` and ``failed``.
        """
        return stored.recorded_computations(self._database)

    def outcomes(
        self,
        analysis: str,
        code: str | None = None,
        parameters: Mapping[str, Any] | None = None,
        *,
        where: str | None = None,
    ) -> pd.DataFrame:
        """What became of the analysis of each trip, in the order of trip.

        Parameters
        ----------
        analysis, code, parameters, where
            As for `results`.

        Returns
        -------
        DataFrame
            The columns ``key``, ``name``, ``train``, ``kind``, ``line``, ``start`` of the trip,
            ``state``, ``reason``, ``rows`` and ``seconds``.

        Examples
        --------
        >>> import tempfile
        >>> from trainlog.catalogue import ResultOutcome
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     todo = catalogue.pending("stops", "1")
        ...     given = zip(todo["key"], todo["sha256"])
        ...     refused = [ResultOutcome(*each, "refused", "no stop") for each in given]
        ...     _ = catalogue.record("stops", "1", {}, refused)
        ...     found, made = catalogue.outcomes("stops"), catalogue.computations()
        >>> found["reason"].tolist(), made[["analysis", "refused"]].values.tolist()
        (['no stop', 'no stop'], [['stops', 2]])
        """
        condition = None if where is None else _condition(where)
        return stored.outcomes_of(self._database, analysis, code, parameters, condition)

    def compact(
        self, analysis: str, code: str | None = None, parameters: Mapping[str, Any] | None = None
    ) -> int:
        """Put the rows of all trips into one file, in the order of trip; how many files went.

        The same results give the same bytes, in whatever batches and order they were recorded.
        What reads or records meanwhile is not disturbed. Files that killed processes left
        unfinished are removed when they are an hour old.

        Parameters
        ----------
        analysis : str
        code, parameters : optional
            Default: those that were recorded last.
        """
        return stored.compact(self._database, analysis, code, parameters)


def _condition(where: str, zone: str | None = None) -> sa.ColumnElement[bool]:
    from trainlog.catalogue.where import condition_of

    return condition_of(where, zone)


def _frame(rows: Sequence[Any], names: Sequence[str]) -> pd.DataFrame:
    """A frame of trips, its times as time stamps."""
    frame = pd.DataFrame(rows, columns=list(names))
    units = {}
    for column in TRIP_COLUMNS:
        if column.name not in frame:
            continue
        values = frame[column.name]
        if column.kind == "time":
            frame[column.name] = pd.to_datetime(values.astype("Int64"), unit="ns", utc=True)
        elif column.kind == "number":
            frame[column.name] = values.astype("float64")
            units[column.name] = column.unit
        elif column.kind == "count":
            frame[column.name] = values.astype("int64")
        else:
            frame[column.name] = values.astype(object)
    frame.attrs["units"] = units
    return frame

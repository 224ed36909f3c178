"""A catalogue, open: files are added, trips asked for, results kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import pandas as pd

from trainlog.catalogue import adding, listing, querying, results as stored
from trainlog.catalogue.adding import Refreshed
from trainlog.catalogue.database import Database
from trainlog.catalogue.querying import Limits, condition_of
from trainlog.catalogue.registration import Added, FileOutcome
from trainlog.catalogue.results import ResultOutcome, ResultState
from trainlog.display import as_text
from trainlog.formats.settings import read_settings

if TYPE_CHECKING:
    import pyarrow as pa

    from trainlog.catalogue.reading import FileEntry
    from trainlog.trip import Trip

_DEFAULT = "catalogue"
"""Folder of the catalogue where none is named."""


def open_catalogue(
    where: str | Path | None = None,
    *,
    results: str | Path | None = None,
    create: bool = True,
) -> Catalogue:
    """Open the catalogue of a fleet; a new one is made where there is none.

    Tables of an earlier version are brought to the latest in one transaction, with a warning.

    Parameters
    ----------
    where : path or str, optional
        A folder, which holds the database (SQLite) and the results, or the URL of a PostgreSQL
        database: ``postgresql://user@host/database``, with ``?schema=name`` for a schema of its
        own. Default: as set (``trainlog settings catalogue``), else the folder ``catalogue``.
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
        If there is none and none is to be made, it is of a version that this trainlog does not
        know, or cannot be reached.
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
            return querying.number_of_trips(connection)

    @property
    def place(self) -> str:
        """Where it is: a folder, or a URL without its password."""
        return self._database.place

    @property
    def results_folder(self) -> Path:
        """Folder of the results."""
        return self._database.results

    @property
    def version(self) -> int:
        """Version of its tables."""
        return self._database.version

    @property
    def migrated_from(self) -> int | None:
        """Version that its tables had before opening brought them to the latest; None if none."""
        return self._database.migrated_from

    def counts(self) -> dict[str, int]:
        """How many trips count, how many recordings of the same drives there are, and files."""
        return listing.counts(self._database)

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
        return adding.add(self._database, paths, report, jobs)

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
        return adding.add_entries(self._database, entries)

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
        return adding.refresh(self._database, list(paths))

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
        return adding.remove(self._database, where, vanished)

    def uncounted(self) -> pd.DataFrame:
        """What does not count, and why: copies, other recordings, old versions, vanished, refused.

        Returns
        -------
        DataFrame
            With the columns ``path``, ``what`` and ``reason``, in the order of path.
        """
        return listing.uncounted(self._database)

    def overview(self, by: str = "route") -> pd.DataFrame:
        """How many trips there are, of those that count.

        Parameters
        ----------
        by : {"route", "train", "kind", "line", "edge", "day", "weather"}
            What has a row: a train and line, a train, ... An edge is each line that trips ran over,
            a route's line also where they only passed over it; a day is that of the start, UTC.

        Returns
        -------
        DataFrame
            What names the row; ``trips``; ``trains`` and ``lines``, how many there are; ``first``
            and ``last`` start; ``distance`` [m] and ``duration`` [s] in all; ``damaged``, of how
            many the log is. Of an edge the distance driven on it, and how often it was run over
            ``forward`` and in ``reverse``.

        Examples
        --------
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     catalogue.overview("edge")[["edge", "trips", "trains", "forward"]].values.tolist()
        [['CH_StGallen_Wil', 2, 1, 2]]
        """
        return listing.overview(self._database, by)

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
        return querying.query(self._database, Limits(where, train, line, start, end, zone), columns)

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
        return querying.unmatched(self._database, where, train, line)

    def paths(self, where: str | None = None, **limits: Any) -> list[Path]:
        """The logs of the trips that `query` chooses, in its order.

        Raises
        ------
        InputError
            As `query`; if no trip is found, or the logs of some have vanished, which are named.
        """
        return querying.paths(self._database, Limits(where, **limits))

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
        from trainlog.mcap import read_log

        key = trip if isinstance(trip, str) else str(trip["key"])
        return read_log(querying.path_of(self._database, key), topics or None)

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
            With the columns ``key``, ``sha256``, ``path`` and ``name``.
        """
        condition = condition_of(where)
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
        condition = condition_of(where)
        return stored.standing(self._database, analysis, code, parameters, condition)

    def gone(self, where: str | None = None) -> int:
        """How many trips that count have no log any more: all of their files have vanished.

        Nothing more can be computed of them; what was computed stays.

        Parameters
        ----------
        where : str, optional
            Only of the trips that this expression chooses.
        """
        return stored.gone(self._database, condition_of(where))

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
        condition = condition_of(where)
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

        And all trips whose file of results is missing or damaged. Parameters are those of
        `pending`, and the states that are forgotten.
        """
        condition = condition_of(where)
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
        condition = condition_of(where)
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
        condition = condition_of(where)
        return stored.outcomes_of(self._database, analysis, code, parameters, condition)

    def alone(self, what: str) -> AbstractContextManager[None]:
        """Do something that one process does at a time, whatever else is read and recorded.

        Parameters
        ----------
        what : str
            A word: who does the same under the same word waits.
        """
        return self._database.alone(what)

    def sql(self, statement: str) -> pd.DataFrame:
        """What a statement of SQL finds in the trips and in what was computed of them.

        DuckDB runs it. Its tables are ``trips`` (those that count, with the columns of
        `TRIP_COLUMNS`), ``files``, ``edges`` (a row each line that a trip ran over), and one of
        each analysis, as ``resistance``, with the rows of its latest code and parameters, of each
        trip that counts once; ``key`` joins them. Times are UTC, numbers in SI units but
        kilometres. Nothing can be changed by it.

        Parameters
        ----------
        statement : str
            ``"select train, avg(r0) from resistance join trips using (key) group by train"``

        Returns
        -------
        DataFrame

        Raises
        ------
        InputError
            If it is not understood, or names a table or column that there is not; names those that
            there are.

        Examples
        --------
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     catalogue.sql("select weather, count(*) as trips from trips group by 1 order by 1")
          weather  trips
        0     dry      1
        1     wet      1
        """
        from trainlog.catalogue import sql

        return sql.asked(self._database, statement)

    def tables(self) -> pd.DataFrame:
        """The tables that `sql` knows, with their columns.

        Returns
        -------
        DataFrame
            The columns ``table``, ``column`` and ``type``.

        Examples
        --------
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        ...     _ = catalogue.add("sample_logs")
        ...     catalogue.tables()["table"].unique().tolist()
        ['trips', 'files', 'edges']
        """
        from trainlog.catalogue import sql

        return sql.tables(self._database)

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

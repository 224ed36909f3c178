"""A catalogue, open: files are added, trips asked for, results kept."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import pandas as pd

from trainlog.catalogue.adding import Files
from trainlog.catalogue.querying import Trips
from trainlog.catalogue.results import Computed
from trainlog.display import as_text
from trainlog.formats.settings import read_settings

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


class Catalogue(Files, Trips, Computed):
    """Which trips there are, where their logs stand, and what was computed of them.

    `open_catalogue` opens one. Several processes may use the same catalogue at once.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        rows = {name: f"{count:,}" for name, count in self.counts().items()}
        return as_text(f"Catalogue {self.place}", rows)

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

        return sql.asked(self, statement)

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

        return sql.tables(self)

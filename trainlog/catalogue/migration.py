"""Versions of the tables of a catalogue, and how those of an earlier one are brought to the latest.

The table `header` states two numbers. `schema` is the version of the tables. `version` is the least
version that a program must know to use them: it is raised when a column changes its meaning or
goes, not when a column or an index is added, so that an earlier trainlog can go on using a
catalogue that a later one has opened. Both steps and header are written in one transaction.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import sqlalchemy as sa

from trainlog.catalogue.schema import header
from trainlog.errors import InputError
from trainlog.version import __version__

PATIENCE = "60s"
"""How long PostgreSQL waits for those that read a table that is changed."""


@dataclass(frozen=True)
class Step:
    """What makes the tables of a version out of those of the version before.

    Attributes
    ----------
    version : int
    software : str
        The first trainlog that knows this version.
    change : callable
        Given a connection, in the transaction that also states the new version. Its statements name
        tables as they were then: those of `trainlog.catalogue.schema` are of the latest version.
    breaking : bool
        Whether programs that know earlier versions alone can no longer use the tables.
    """

    version: int
    software: str
    change: Callable[[sa.Connection], object]
    breaking: bool = False


def _nothing(_: sa.Connection) -> None:
    """The first version was made as it is."""


def _index_counting_trips(connection: sa.Connection) -> None:
    """What is pending, and how many trips count, is found in indices, without reading trips."""
    for statement in (
        "CREATE INDEX trips_counting ON trips (key, standing, sha256, id)",
        "CREATE INDEX trips_apart ON trips (id) WHERE standing <> 'counts'",
        "DROP INDEX IF EXISTS trips_by_key",
    ):
        connection.execute(sa.text(statement))


STEPS: tuple[Step, ...] = (
    Step(1, "0.1.0", _nothing, breaking=True),
    Step(2, "0.1.0", _index_counting_trips),
)
"""From the first version to the latest."""

VERSION = STEPS[-1].version
"""Of the tables in `trainlog.catalogue.schema`."""


def stated() -> dict[str, str]:
    """What the header states of tables of the latest version."""
    needed = [each for each in STEPS if each.breaking][-1]
    return {
        "version": str(needed.version),
        "schema": str(STEPS[-1].version),
        "needs": f"trainlog {needed.software}",
    }


def version_of(found: Mapping[str, str]) -> int:
    """The version of the tables, by their header; the first one stated but `version`."""
    return int(found.get("schema", found.get("version", "1")))


def check(found: Mapping[str, str], place: str) -> None:
    """Refuse tables that this trainlog cannot use.

    Raises
    ------
    InputError
        Names the trainlog that is needed.
    """
    known = STEPS[-1].version
    needed = int(found.get("version", "1"))
    if needed > known:
        needs = found.get("needs") or found.get("migrated by") or found.get("software", "")
        raise InputError(
            f"follows version {needed} of the catalogue's tables; this is trainlog {__version__},"
            f" which knows {known}",
            file=place,
            remedy=f"update trainlog: {needs} or later is needed" if needs else "update trainlog",
        )


def migrate(connection: sa.Connection, server: bool, place: str) -> int | None:
    """Bring the tables to the latest version; their version before, None if they had it.

    Parameters
    ----------
    connection : of `Database.writing`
        Of several processes that open an earlier version at once one does it, while the others
        wait and then find it done.
    server : bool
        Whether it is PostgreSQL.
    place : str
        Of the catalogue, for messages.
    """
    found = {row.key: row.value for row in connection.execute(sa.select(header))}
    check(found, place)
    before = version_of(found)
    steps = [each for each in STEPS if each.version > before]
    if not steps:
        return None
    if server:
        connection.execute(sa.text(f"SET LOCAL lock_timeout = '{PATIENCE}'"))
    for step in steps:
        step.change(connection)
    new = {**stated(), "migrated by": f"trainlog {__version__}", "migrated from": str(before)}
    connection.execute(sa.delete(header).where(header.c.key.in_(list(new))))
    connection.execute(sa.insert(header), [{"key": k, "value": v} for k, v in new.items()])
    return before

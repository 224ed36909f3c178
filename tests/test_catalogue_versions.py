"""Versions of a catalogue's tables: an earlier one is brought to the latest."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from killed import in_own_process
from refusals import refused
from synthetic_trips import synthetic_entry

from trainlog.catalogue import Computation, ResultOutcome, database as migration, open_catalogue
from trainlog.errors import InputError

DATA = Path("tests/data")
LIMITED = Computation("stops", "1", {"limit": 2.5})
TABLES = ("header", "trips", "files", "trip_edges", "computations", "result_files", "results")


@pytest.fixture(params=["sqlite", "postgresql"])
def first_version(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Where a catalogue is that the first version of trainlog's tables holds."""
    script = (DATA / "catalogue-1.sqlite.sql").read_text()
    if request.param == "sqlite":
        folder = tmp_path / "catalogue"
        folder.mkdir()
        with sqlite3.connect(folder / "catalogue.sqlite") as database:
            database.execute("PRAGMA journal_mode=WAL")
            database.executescript(script)
        database.close()
        return str(folder)
    place = str(request.getfixturevalue("postgresql_place"))
    held = sqlite3.connect(":memory:")
    held.executescript(script)
    held.execute("UPDATE header SET value = ? WHERE key = 'results'", [str(tmp_path / "results")])
    url, schema = place.rsplit("schema=", 1)
    import psycopg

    with psycopg.connect(url.rstrip("?&")) as connection:
        connection.execute(f"CREATE SCHEMA {schema}")
        connection.execute(f"SET search_path TO {schema}")
        connection.execute((DATA / "catalogue-1.postgresql.sql").read_text())
        for table in TABLES:
            rows = held.execute(f"SELECT * FROM {table}")
            names = [each[0] for each in rows.description]
            listed, signs = ", ".join(f'"{n}"' for n in names), ", ".join(["%s"] * len(names))
            every = rows.fetchall()
            if every:
                asked = f"INSERT INTO {table} ({listed}) VALUES ({signs})"
                connection.cursor().executemany(asked, every)
            if "id" in names:
                sequence = f"pg_get_serial_sequence('{schema}.{table}', 'id')"
                connection.execute(f"SELECT setval({sequence}, {len(every) + 1})")
    held.close()
    return place


def _structure(place: str) -> dict[str, Any]:
    with open_catalogue(place) as catalogue, catalogue.engine.connect() as connection:
        schema = catalogue.schema if "://" in place else None
        about = sa.inspect(connection)
        return {
            table: (
                [(c["name"], str(c["type"])) for c in about.get_columns(table, schema)],
                {i["name"]: i["column_names"] for i in about.get_indexes(table, schema)},
            )
            for table in TABLES
        }


def test_an_earlier_version_is_brought_to_the_latest_with_all_it_holds(first_version, tmp_path):
    with pytest.warns(UserWarning, match="brought from version 1 to 2"):
        opened = open_catalogue(first_version)
    with opened as catalogue:
        assert (catalogue.migrated_from, catalogue.version) == (1, 2)
        assert len(catalogue) == 6
        found = catalogue.query("train = 'flirt-12'", columns=["name"])["name"]
        assert sorted(found) == ["trip-000002", "trip-000004"]
        known = {"done": 0, "refused": 4, "failed": 0, "pending": 2}
        assert catalogue.standing(LIMITED) == known
        todo = catalogue.pending(LIMITED)
        done = [ResultOutcome(row.key, row.sha256) for row in todo.itertuples()]
        assert catalogue.record(LIMITED, done) == 2
        catalogue.register([synthetic_entry(6)])
        assert len(catalogue) == 7
    with open_catalogue(first_version) as again:
        assert again.migrated_from is None
    new = str(tmp_path / "new")
    if "://" in first_version:
        new = first_version + "_new"
    with open_catalogue(new, results=tmp_path / "new" if "://" in new else None) as made:
        assert made.migrated_from is None
    assert _structure(first_version) == _structure(new)


def test_of_processes_that_open_an_earlier_version_at_once_one_migrates_even_if_one_is_killed(
    first_version,
):
    found, said = in_own_process("catalogue_openers.run", first_version, 3)
    assert found["killed"]
    assert sorted(found["migrated"], key=str) == [1, None, None], said
    with open_catalogue(first_version) as catalogue:
        assert len(catalogue) == 6
        assert catalogue.version == migration.VERSION


def test_a_change_that_fails_leaves_the_version_before(first_version, monkeypatch):
    last = migration.STEPS[-1]

    def change(connection: sa.Connection) -> None:
        last.change(connection)
        connection.execute(sa.text("DELETE FROM trips"))
        connection.execute(sa.text("CREATE INDEX wrong ON trips (nothing)"))

    with monkeypatch.context() as patch:
        patch.setattr(migration, "STEPS", (migration.STEPS[0], replace(last, change=change)))
        refused(InputError, "the database refuses", open_catalogue, first_version)
    with pytest.warns(UserWarning, match="from version 1"):
        opened = open_catalogue(first_version)
    with opened as catalogue:
        assert len(catalogue) == 6


def test_a_later_version_is_refused_if_it_must_be_known_and_used_if_not(first_version, monkeypatch):
    compatible = migration.Step(3, "0.2.0", lambda connection: None)
    breaking = migration.Step(4, "0.3.0", lambda connection: None, breaking=True)
    known = migration.STEPS
    for steps in ((*known, compatible), (*known, compatible, breaking)):
        with monkeypatch.context() as patch:
            patch.setattr(migration, "STEPS", steps)
            patch.setattr(migration, "VERSION", steps[-1].version)
            with pytest.warns(UserWarning, match="were brought from version"):
                later = open_catalogue(first_version)
            with later:
                assert later.version == steps[-1].version
        if not steps[-1].breaking:
            with open_catalogue(first_version) as catalogue:
                assert (len(catalogue), catalogue.version) == (6, 3)
    message = r"follows version 4 .* knows 2; update trainlog: trainlog 0\.3\.0 or later is needed"
    refused(InputError, message, open_catalogue, first_version)

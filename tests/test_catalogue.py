"""The catalogue of a fleet on each database: what it registers, answers and keeps."""

import json
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import sqlalchemy as sa
from hypothesis import given, settings, strategies as st
from killed import in_own_process
from refusals import refused
from synthetic_trips import FIRST, synthetic_entry

import trainlog
from analysis.view import views_of
from trainlog.catalogue import Computation, ResultOutcome, database as migration, open_catalogue
from trainlog.catalogue.catalogue import Catalogue
from trainlog.catalogue.database import metadata
from trainlog.catalogue.querying import overview_table
from trainlog.errors import InputError
from trainlog.identity import Known, TripIdentity, same_drives
from trainlog.mcap import DamageWarning, account_of
from trainlog.mcap.contents import contents_of
from trainlog.mcap.records import Source

SAMPLES = Path("sample_logs")

STOPS = Computation("stops", "1")
LIMITED = replace(STOPS, parameters={"limit": 2.5})
DATA = Path("tests/data")
TABLES = ("header", "trips", "files", "trip_edges", "computations", "result_files", "results")


@pytest.fixture(params=["sqlite", "postgresql"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Where the catalogue of a test is, on each database."""
    if request.param == "sqlite":
        return str(tmp_path / "catalogue")
    return str(request.getfixturevalue("postgresql_place"))


@pytest.fixture
def where(place: str, tmp_path: Path) -> Iterator[Callable[[], Catalogue]]:
    """Opens the catalogue of a test; the same one each time."""
    opened: list[Catalogue] = []
    results = tmp_path / "results" if "://" in place else None

    def opener() -> Catalogue:
        opened.append(open_catalogue(place, results=results))
        return opened[-1]

    yield opener
    for each in opened:
        each.close()


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three logs: the beginnings of two drives, and a part of one of them."""
    folder = tmp_path_factory.mktemp("written")
    (folder / "deep").mkdir()
    for name, minutes in (("nonstop", 4), ("deep/stopping", 4), ("part", 2)):
        trip = trainlog.read(SAMPLES / f"{'nonstop' if name == 'nonstop' else 'stopping'}.mcap")
        end = trip.start + pd.Timedelta(minutes=minutes)
        trainlog.write(trip.between(None, end), folder / f"{name}.mcap")
    return folder


@pytest.fixture
def logs(written: Path, tmp_path: Path) -> Path:
    """The same, which a test may change."""
    return Path(shutil.copytree(written, tmp_path / "logs"))


def test_files_are_registered_once_and_the_fullest_recording_of_a_drive_counts(where, logs):
    catalogue = where()
    first, again = catalogue.add(logs), catalogue.add(logs)
    found = {Path(each.path).stem: each.state for each in first.outcomes}
    assert found == {"nonstop": "new", "stopping": "new", "part": "recording"}
    shutil.copy(logs / "nonstop.mcap", logs / "zzz.mcap")
    assert [each.state for each in catalogue.add(logs / "zzz.mcap").outcomes] == ["copy"]
    copies = catalogue.uncounted().set_index("what").loc["copy"]
    assert copies["path"] == str(logs / "zzz.mcap")
    assert str(logs / "nonstop.mcap") in copies["reason"]
    assert [each.state for each in again.outcomes] == ["known"] * 3
    found = catalogue.query()
    assert found["name"].tolist() == ["trip-01", "trip-03"]
    assert found["path"].tolist()[1] == str(logs / "deep" / "stopping.mcap")
    assert catalogue.counts()["other recordings"] == 1
    trip = trainlog.read(logs / "deep" / "stopping.mcap")
    row = found.iloc[1]
    assert (row["start"], row["end"], row["duration"]) == (trip.start, trip.end, trip.duration)
    assert row["topics"] == {name: len(frame) for name, frame in trip.topics.items() if len(frame)}
    assert catalogue.open(row) == trip


def test_another_content_under_a_name_is_a_new_version_that_is_computed_again(where, logs):
    catalogue = where()
    catalogue.add(logs)
    _record(catalogue, catalogue.pending(STOPS))
    trip = trainlog.read(logs / "nonstop.mcap")
    heavier = replace(trip, metadata={**trip.metadata, "load": "40000"})
    trainlog.write(heavier, logs / "nonstop.mcap")
    assert [each.state for each in catalogue.add(logs).outcomes].count("version") == 1
    assert catalogue.query("load > '30 t'")["name"].tolist() == ["trip-01"]
    assert len(catalogue) == 2
    todo = catalogue.pending(STOPS)
    assert todo["path"].tolist() == [str(logs / "nonstop.mcap")]
    assert len(catalogue.results("stops")) == 2
    _record(catalogue, todo, stops=7)
    assert sorted(catalogue.results("stops")["stops"]) == [1, 1, 7, 7]
    # A file that moved is found again, and nothing is pending.
    (logs / "nonstop.mcap").rename(logs / "deep" / "elsewhere.mcap")
    moved = catalogue.add(logs).of("moved")
    assert [each.path for each in moved] == [str(logs / "deep" / "elsewhere.mcap")]
    assert catalogue.query()["path"].tolist()[0] == moved[0].path
    assert len(catalogue.pending(STOPS)) == 0


def test_results_are_recorded_once_and_merged_in_the_order_of_trip(where, logs):
    catalogue, other = where(), where()
    catalogue.add(logs)
    todo = catalogue.pending(LIMITED)
    assert todo["key"].is_monotonic_increasing
    stated = [ResultOutcome(row.key, row.sha256, rows=1) for row in todo.itertuples()]
    less = pa.table({"key": [todo["key"][0]]})
    refused(InputError, "rows of trip", catalogue.record, LIMITED, stated, less)
    assert _record(catalogue, todo.iloc[[1]], LIMITED) == 1
    assert _record(other, todo, LIMITED, stops=99) == 1, "one of them was recorded before"
    assert len(other.pending(LIMITED)) == 0
    assert len(other.pending(replace(LIMITED, code="2"))) == 2
    assert len(other.pending(replace(LIMITED, parameters={"limit": 2.0}))) == 2
    found = catalogue.results("stops")
    assert found["stops"].tolist() == [99, 99, 1, 1]
    assert found["key"].tolist() == [key for key in todo["key"] for _ in range(2)]
    assert set(found) == {"key", "stops", "train", "kind", "line", "start"}
    assert catalogue.compact("stops") == 2
    pd.testing.assert_frame_equal(other.results("stops"), found)
    files = list((catalogue.results_folder / "stops").iterdir())
    assert len(files) == 1


def _record(catalogue, todo, of=STOPS, stops=1):
    keys = [key for key in todo["key"] for _ in range(2)]
    table = pa.table({"key": keys, "stops": [stops] * len(keys)})
    done = [ResultOutcome(row.key, row.sha256, rows=2) for row in todo.itertuples()]
    return catalogue.record(of, done, table)


@pytest.fixture(scope="module")
def many_logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small logs: parts of two drives, many of which overlap, a copy, and what is no log."""
    folder = tmp_path_factory.mktemp("many")
    for name in ("nonstop", "stopping"):
        trip = trainlog.read(SAMPLES / f"{name}.mcap", ["/train/state"])
        for number in range(10):
            first = trip.start + pd.Timedelta(seconds=110 * number)
            part = trip.between(first, first + pd.Timedelta(seconds=(100, 240, 330)[number % 3]))
            named = replace(part, metadata={**part.metadata, "trip": f"{name} {number}"})
            trainlog.write(named, folder / f"{name}-{number}.mcap")
    (folder / "copies").mkdir()
    shutil.copy(folder / "nonstop-3.mcap", folder / "copies")
    (folder / "text.mcap").write_text("no log")
    data = (folder / "stopping-1.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(data[: len(data) // 2])
    return folder


def _held(catalogue: Catalogue) -> dict[str, list[tuple[object, ...]]]:
    """Everything in the catalogue that does not depend on when it came."""
    trips, files, edges = (metadata.tables[each] for each in ("trips", "files", "trip_edges"))
    other = trips.alias()
    own = [c for c in trips.c if c.name not in ("id", "added", "same_as")]
    asked = {
        "trips": sa.select(*own, other.c.sha256).outerjoin(other, other.c.id == trips.c.same_as),
        "files": sa.select(
            *(c for c in files.c if c.name not in ("id", "trip", "reason")), trips.c.sha256
        ).outerjoin(trips, trips.c.id == files.c.trip),
        "edges": sa.select(trips.c.sha256, *(c for c in edges.c if c.name != "trip")).join(
            trips, trips.c.id == edges.c.trip
        ),
    }
    with catalogue.reading() as connection:
        return {
            name: sorted((tuple(row) for row in connection.execute(each)), key=repr)
            for name, each in asked.items()
        }


@pytest.mark.parametrize(
    ("place", "adders", "kills"),
    [
        ("sqlite", 2, 4),
        pytest.param("postgresql", 2, 4, marks=pytest.mark.long),
        pytest.param("sqlite", 4, 100, marks=pytest.mark.long),
        pytest.param("postgresql", 4, 100, marks=pytest.mark.long),
    ],
    indirect=["place"],
)
def test_killed_adders_leave_the_same_catalogue(where, place, many_logs, tmp_path, adders, kills):
    with open_catalogue(tmp_path / "alone") as alone:
        added = alone.add(many_logs)
        assert len(added.of("refused")) == 2
        expected = _held(alone)
        keys = alone.query()["key"].tolist()
    assert 2 <= len(keys) < 20, "several parts of one drive are one"
    catalogue = where()
    results = catalogue.results_folder if "://" in place else None
    killed, said = in_own_process("killed_catalogue.run", place, results, many_logs, adders, kills)
    print(killed)
    assert killed["failed"] == 0, said
    assert killed["killed"] == kills
    assert _held(catalogue) == expected
    found = catalogue.results("length")
    assert found["key"].tolist() == sorted(keys)
    assert len(catalogue.pending(Computation("length", "1"))) == 0


def test_files_that_vanish_are_stated_and_come_back(where, logs):
    catalogue = where()
    catalogue.add(logs)
    path = logs / "deep" / "stopping.mcap"
    kept = path.read_bytes()
    stat = path.stat()
    path.unlink()
    found = catalogue.refresh()
    assert found.vanished == (str(path),)
    assert found.same == len(list(logs.rglob("*.mcap")))
    assert len(catalogue) == 2, "it is not forgotten"
    assert catalogue.query("weather = 'wet'")["path"].tolist() == [None]
    refused(InputError, r"1 trip have vanished: trip-03", catalogue.paths)
    assert catalogue.pending(STOPS)["path"].tolist() == [str(logs / "nonstop.mcap")]
    assert catalogue.uncounted()["what"].tolist() == ["vanished", "same drive"]

    path.write_bytes(kept)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert catalogue.refresh().back == 1
    assert len(catalogue.paths()) == 2

    path.unlink()
    catalogue.refresh()
    assert catalogue.remove(vanished=True) == 1
    # The part of the drive that is still there counts now.
    left = [str(logs / f"{name}.mcap") for name in ("nonstop", "part")]
    assert catalogue.query()["path"].tolist() == left


def test_a_file_that_cannot_be_used_is_listed_and_tried_again_once_it_changes(where, logs):
    catalogue = where()
    bad = logs / "bad.mcap"
    bad.write_text("no log at all")
    for _ in range(2):
        assert [each.path for each in catalogue.add(logs).of("refused")] == [str(bad)]
    assert "not an MCAP file" in catalogue.uncounted().set_index("what")["reason"]["refused"]
    shutil.copy(logs / "nonstop.mcap", bad)
    assert [each.state for each in catalogue.add(bad).outcomes] == ["copy"]
    assert catalogue.counts()["refused"] == 0
    refused(InputError, "does not exist", catalogue.add, logs / "absent")
    refused(InputError, "no log", catalogue.add, SAMPLES / ".." / "docs" / "reference")
    trainlog.write(replace(trainlog.read(logs / "nonstop.mcap"), topics={}), bad)
    assert catalogue.add(logs).counts["refused"] == 1
    assert "has no samples" in catalogue.uncounted().set_index("what")["reason"]["refused"]
    bad.unlink()
    # What cannot be read takes no trip away.
    (logs / "deep" / "stopping.mcap").write_text("no log")
    assert catalogue.add(logs).counts["refused"] == 1
    assert len(catalogue) == 2


def test_trips_of_unknown_train_and_weather_are_summed_under_a_dash(where, logs):
    catalogue = where()
    known = trainlog.read(logs / "nonstop.mcap")
    trainlog.write(replace(known, metadata={}), logs / "nonstop.mcap")
    catalogue.add(logs)
    for by in ("train", "weather"):
        cells = {row[0] for row in overview_table(catalogue, by).words}
        assert len(cells) == 2
        assert "-" in cells


def test_files_are_read_by_several_processes_with_the_same_result(many_logs, tmp_path, monkeypatch):
    monkeypatch.setattr("trainlog.catalogue.registration._WORTH_PROCESSES", 2)
    held = []
    for jobs in (1, 2):
        with open_catalogue(tmp_path / str(jobs)) as catalogue:
            catalogue.add(many_logs, jobs=jobs)
            held.append(_held(catalogue))
    assert held[0] == held[1]


def test_what_is_no_catalogue_is_refused(tmp_path):
    refused(InputError, "has no catalogue", open_catalogue, tmp_path / "none", create=False)
    place = "oracle://me:secret@host/database"
    said = r"holds a catalogue|is not a database"
    assert "secret" not in str(refused(InputError, said, open_catalogue, place))
    (tmp_path / "catalogue.sqlite").write_text("no database " * 500)
    refused(InputError, "file is not a database", open_catalogue, tmp_path)


def test_commands_take_the_trips_of_an_expression(shell, logs, tmp_path):
    fleet = str(tmp_path / "fleet")

    def ran(*words: object) -> tuple[int, str, str]:
        return shell(*words, "--catalogue", fleet)

    assert ran("fleet", "show")[0] == 2
    status, shown, _ = ran("fleet", "add", logs)
    assert (status, shown) == (0, "2 new trips, 1 other recording of the same drives\n")
    assert ran("fleet", "query", "to_km > 20 and duration_s > '1 s'")[0] == 0
    said = " ".join(ran("fleet", "query", "weather = 'Wet'")[2].split())
    assert "no trip has the weather 'Wet'; did you mean 'wet'?" in said
    status, shown, _ = ran("show", "--check", "--trips", "weather = 'wet'", "--json")
    (checked,) = json.loads(shown)["logs"]
    assert checked["log"] == str(logs / "deep" / "stopping.mcap")
    assert ran("map", "update", "--trips", "all", "--map", tmp_path / "map.map", "-q")[0] == 0
    (logs / "nonstop.mcap").unlink()
    status, shown, _ = ran("fleet", "refresh")
    assert status == 1
    assert f"vanished: {logs / 'nonstop.mcap'}" in shown
    for words, complaint in (
        (["--trips", "train = 'none'"], "no trip of the 2 trips of the catalogue is chosen"),
        (["--trips", "wether = 'wet'"], "did you mean 'weather'"),
        ([], "but not which of its trips"),
        (["--trips", "all"], "vanished: trip-01"),
    ):
        status, _, said = ran("show", "--check", *words)
        assert status == 2
        assert complaint in said
    assert "--trips" in shell("show", "--check")[2]


def test_of_equal_recordings_the_one_without_damage_counts_and_of_copies_the_first(where, tmp_path):
    intact = tmp_path / "named-last.mcap"
    shutil.copy(SAMPLES / "nonstop.mcap", intact)
    with Source(intact) as source:
        place = contents_of(source).chunks[1].offset - 20
    data = bytearray(intact.read_bytes())
    # A message index, which nothing reads that goes by the summary: all messages are readable.
    data[place] ^= 0x40
    (tmp_path / "damaged.mcap").write_bytes(data)
    assert not account_of(tmp_path / "damaged.mcap").whole
    with pytest.warns(DamageWarning):
        assert trainlog.read(tmp_path / "damaged.mcap") == trainlog.read(intact)
    (recorded,) = views_of(tmp_path / "damaged.mcap", checked=True)
    assert "fails the checksum" in recorded.damage
    catalogue = where()
    added = catalogue.add(tmp_path / "damaged.mcap")
    assert added.sentence == "1 new trip (1 of damaged logs)"
    assert "fails the checksum" in added.outcomes[0].damage
    assert len(catalogue.query("quality = 'damaged' and damage like '%checksum%'")) == 1
    catalogue.add(intact)
    assert catalogue.query()["quality"].tolist() == ["whole"]
    assert catalogue.uncounted()["path"].tolist() == [str(tmp_path / "damaged.mcap")]
    shutil.copy(intact, tmp_path / "a-copy.mcap")
    catalogue.add(tmp_path / "a-copy.mcap")
    assert catalogue.query()["path"].tolist() == [str(intact)]
    assert catalogue.pending(STOPS)["path"].tolist() == [str(intact)]


@pytest.mark.parametrize("seed", range(4))
def test_a_recording_with_its_line_counts_before_the_same_without(tmp_path, seed):
    """As when a file is ingested again with --line: which comes first does not matter."""
    bare = _file(seed, 0, 9, line=None, messages=1001)
    with open_catalogue(tmp_path) as catalogue:
        catalogue.register([bare])
        catalogue.register([_file(seed + 9, 0, 9)])
        assert catalogue.query()["line"].notna().all()
        assert len(catalogue) == 1


def test_unknown_labels_and_values_of_passports_are_named(where, logs):
    catalogue = where()
    catalogue.add(logs)
    known = sorted(catalogue.query()["labels"].iloc[0])
    (label,) = catalogue.unmatched("label('nothing') = 'x'")
    assert "no trip has a label 'nothing'" in label
    assert known[0] in label
    assert catalogue.unmatched(f"label('{known[0]}') = 'x'") == []
    (passport,) = catalogue.unmatched("passport('nothing') > 1")
    assert "trainlog fleet query" in passport


def test_statements_of_one_reading_see_one_state(where, logs):
    catalogue, other = where(), where()
    catalogue.add(logs / "nonstop.mcap")
    count = sa.select(sa.func.count()).select_from(metadata.tables["trips"])
    with catalogue.reading() as connection:
        before = connection.execute(count).scalar_one()
        other.add(logs / "deep")
        assert connection.execute(count).scalar_one() == before == 1
    with catalogue.reading() as connection:
        assert connection.execute(count).scalar_one() == len(catalogue) > before


def _file(number, first, minutes, *, path="", source="", **values):
    """A file with the trip of some minutes of a drive, whose recorded blocks are their numbers."""
    base = synthetic_entry(number)
    start, end = FIRST + first * 60 * 10**9, FIRST + (first + minutes) * 60 * 10**9
    known = {"start": start, "end": end, "duration": 60.0 * minutes, "samples": 600 * minutes}
    blocks = np.arange(first, first + minutes, dtype=np.uint64) + np.uint64(values.pop("moved", 0))
    ends = (pd.Timestamp(each, tz="UTC") for each in (start, end))
    identity = TripIdentity(*ends, known["samples"], blocks, source)
    values = {**base.entry.values, "messages": 1000, **known, **values}
    entry = replace(base.entry, values=values, identity=identity)
    return replace(base, path=path or base.path, entry=entry)


def _standings(catalogue: Catalogue) -> dict[str, tuple[str, str | None, float | None]]:
    with catalogue.reading() as connection:
        rows = connection.execute(sa.select(metadata.tables["trips"])).mappings().all()
    names = {row["id"]: row["name"] for row in rows}
    return {row["name"]: (row["standing"], names.get(row["same_as"]), row["share"]) for row in rows}


@settings(max_examples=12)
@given(st.data())
def test_what_counts_is_what_one_look_at_all_recordings_says(data):
    """However many are registered at once, and in which order: chains of overlaps, and files that
    were ingested with other times."""
    recordings, known, qualities = [], [], ("whole", "unclosed", "damaged")
    for number in range(data.draw(st.integers(2, 10))):
        first, minutes = data.draw(st.integers(0, 300)), data.draw(st.integers(1, 70))
        source = data.draw(st.sampled_from(("", "", "a", "b")))
        moved = data.draw(st.sampled_from((0, 0, 1000))) if source else 0
        quality = data.draw(st.sampled_from(qualities))
        line = data.draw(st.sampled_from(("X", None)))
        about = {"quality": quality, "messages": data.draw(st.integers(1000, 1001)), "line": line}
        recordings.append(_file(number, first, minutes, source=source, moved=moved, **about))
        entry, worse = recordings[-1].entry, qualities.index(quality)
        order = (False, line is None, -about["messages"], worse, recordings[-1].sha256)
        known.append(Known(entry.values["name"], entry.identity, order))

    def expected_of(known: list[Known]) -> dict[str, tuple[str, str | None, float | None]]:
        found = same_drives(known)
        return {each.name: ("counts", None, None) for each in known} | {
            each.trip: ("same drive", each.of, each.share) for each in found
        }

    expected = expected_of(known)
    with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
        left = data.draw(st.permutations(recordings))
        while left:
            count = data.draw(st.integers(1, len(left)))
            catalogue.register(left[:count])
            left = left[count:]
        assert _standings(catalogue) == expected
        # Without those that count, the others are looked at anew.
        gone = {name for name, (standing, *_) in expected.items() if standing == "counts"}
        catalogue.remove("name in (" + ", ".join(f"'{name}'" for name in sorted(gone)) + ")")
        others = [each for each in known if each.name not in gone]
        assert _standings(catalogue) == expected_of(others)


def test_an_older_version_does_not_count_even_where_the_later_one_vanished(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    for each in (one, two):
        each.touch()
    with open_catalogue(tmp_path / "catalogue") as catalogue:
        old = _file(1, 0, 60, path=str(one))
        catalogue.register([old, replace(old, path=str(two))])
        catalogue.register([_file(2, 2000, 30, path=str(one))])
        # Its other file stands, if only as one that vanished.
        assert _standings(catalogue)["trip-000001"][0] == "counts"
        for each in (one, two):
            each.unlink()
        catalogue.refresh()
        assert _standings(catalogue)["trip-000001"][0] == "counts"
        catalogue.register([_file(3, 3000, 30, path=str(two))])
        older = ("older version", "trip-000002", None)
        assert _standings(catalogue)["trip-000001"] == older
        catalogue.refresh()
        # A part of it counts: what does not count keeps no other recording out.
        catalogue.register([_file(4, 0, 30)])
        assert _standings(catalogue)["trip-000001"] == older
        assert _standings(catalogue)["trip-000004"][0] == "counts"
        catalogue.register([replace(old, path="/back")])
        assert _standings(catalogue)["trip-000001"][0] == "counts"
        assert _standings(catalogue)["trip-000004"] == ("same drive", "trip-000001", 1.0)


@pytest.fixture(params=["sqlite", "postgresql"])
def first_version(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Where a catalogue is that the first version of trainlog's tables holds."""
    script = (DATA / "catalogue-1.sqlite.sql").read_text()
    if request.param == "sqlite":
        with sqlite3.connect(tmp_path / "catalogue.sqlite") as database:
            database.execute("PRAGMA journal_mode=WAL")
            database.executescript(script)
        database.close()
        return str(tmp_path)
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
    new = first_version + "_new" if "://" in first_version else str(tmp_path / "new")
    with open_catalogue(new, results=tmp_path / "new" if "://" in new else None) as made:
        assert made.migrated_from is None
    assert _structure(first_version) == _structure(new)


def test_of_several_openers_of_an_earlier_version_one_migrates_even_if_one_is_killed(first_version):
    found, said = in_own_process("killed_catalogue.opened", first_version, 3)
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
            with open_catalogue(first_version) as known_catalogue:
                assert (len(known_catalogue), known_catalogue.version) == (6, 3)
    message = r"follows version 4 .* knows 2; update trainlog: trainlog 0\.3\.0 or later is needed"
    refused(InputError, message, open_catalogue, first_version)

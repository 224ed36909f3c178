"""Statements of SQL over a catalogue, and its overviews, on SQLite and on PostgreSQL."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from refusals import refused
from synthetic_trips import synthetic_entry

from trainlog.catalogue import (
    Catalogue,
    Computation,
    ResultOutcome,
    catalogue as module,
    open_catalogue,
)
from trainlog.cli.fleet import fleet_query
from trainlog.errors import InputError

TRIPS = 60
FIRST = Computation("top speed", "1")
ENTRIES = [synthetic_entry(number, trains=4, days=5) for number in range(TRIPS)]


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def place(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Where a catalogue of synthetic trips is, of which two computations have results."""
    folder = tmp_path_factory.mktemp("sql")
    where = str(folder / "catalogue")
    if request.param == "postgresql":
        server = str(request.getfixturevalue("postgresql_server"))
        where = f"{server}{'&' if '?' in server else '?'}schema=sql_{folder.name}"
    results = folder / "results" if "://" in where else None
    with open_catalogue(where, results=results) as catalogue:
        catalogue.register(ENTRIES)
        for code, most, value in (("1", TRIPS, 1.0), ("2", 50, 2.0)):
            todo = catalogue.pending(Computation("top speed", code))
            for at in range(0, most, 20):
                part = todo.iloc[at : min(at + 20, most)]
                rows = [key for key in part["key"] for _ in range(2)]
                table = pa.table({"key": rows, "value": [value] * len(rows)})
                done = [ResultOutcome(row.key, row.sha256, rows=2) for row in part.itertuples()]
                catalogue.record(Computation("top speed", code), done, table)
    return where


@pytest.fixture
def catalogue(place: str) -> Iterator[Catalogue]:
    with open_catalogue(place) as opened:
        yield opened


def judged() -> pd.DataFrame:
    """The trips as they were drawn."""
    entries = [each.entry for each in ENTRIES if each.entry is not None]
    frame = pd.DataFrame([{**entry.values, "edges": entry.edges} for entry in entries])
    frame["day"] = pd.to_datetime(frame["start"], unit="ns").dt.strftime("%Y-%m-%d")
    return frame


def test_a_statement_joins_results_with_trips_and_counts_each_once(catalogue):
    statement = """
        select t.train, count(distinct key) as trips, sum(value) as total, min(t.start) as first
        from "top speed" join trips t using (key) group by t.train order by t.train
    """
    found = catalogue.sql(statement).set_index("train")
    results = catalogue.results("top speed")
    assert len(results) == 100, "the latest code has recorded fewer trips than the one before"
    expected = results.groupby("train")["value"].sum()
    assert found["total"].to_dict() == expected.to_dict()
    assert found["trips"].sum() == 50
    first = catalogue.query().groupby("train")["start"].min()
    assert (found["first"].dt.tz_localize("UTC") - first).abs().max() < pd.Timedelta("1us")
    catalogue.compact("top speed")
    pd.testing.assert_frame_equal(catalogue.sql(statement).set_index("train"), found)


def test_tables_of_the_database_are_those_of_the_trips_that_count(catalogue):
    frame = judged()
    found = catalogue.sql("select * from trips order by name")
    assert set(found) == set(catalogue.query().columns) - {"path"}
    assert found["duration"].tolist() == frame.sort_values("name")["duration"].tolist()
    configurations = catalogue.sql("select labels->>'configuration' as c from trips order by name")
    assert configurations["c"].tolist() == [str(number % 4) for number in range(TRIPS)]
    gains = catalogue.sql("select sum(cast(passport->>'effort_gain' as double)) as s from trips")
    expected = sum(each.get("effort_gain", 0.0) for each in frame["passport"])
    assert gains["s"][0] == pytest.approx(expected)
    edges = catalogue.sql(
        "with e as (select * from edges) select edge, sum(km_to - km_from) as km, count(*) as n"
        " from e join files f using (key) where f.state = 'present' group by edge"
    ).set_index("edge")
    lengths: dict[str, float] = {}
    for each in frame["edges"]:
        for name, start, end, _ in each:
            lengths[name] = lengths.get(name, 0.0) + end - start
    assert edges["km"].to_dict() == pytest.approx(lengths)
    known = catalogue.tables()
    assert set(known["table"]) == {"trips", "files", "edges", "top speed"}
    assert known[known["table"] == "top speed"]["column"].tolist() == ["key", "value"]


def test_the_statement_in_the_help_runs(tmp_path):
    """Results have a column ``train``, as the trips do."""
    (statement,) = re.findall(r'fleet query "(select [^"]+)"', str(fleet_query.__doc__))
    with open_catalogue(tmp_path / "catalogue") as catalogue:
        catalogue.register(ENTRIES)
        todo = catalogue.pending(Computation("resistance", "1"))
        table = pa.table({"key": list(todo["key"]), "train": ["a"] * TRIPS, "r0": [2e3] * TRIPS})
        done = [ResultOutcome(row.key, row.sha256, rows=1) for row in todo.itertuples()]
        catalogue.record(Computation("resistance", "1"), done, table)
        assert (catalogue.sql(statement).iloc[:, 1] == 2e3).all()


REFUSED = {
    "select trian from trips": r"no column 'trian'; did you mean 'train'\?; trips has key, name",
    "select t.trian from trips t": r"no column 'trian'; did you mean 'train'\?; trips has key",
    "select * from trip": r"no table 'trip'; did you mean 'trips'\?; tables of .*: trips, files",
    'select * from "top spead"': "did you mean 'top speed'",
    "select train from trips join files using (key) join trips t using (key)": (
        r"train.*\)\; name the table before the column"
    ),
    "delete from trips": "is not one statement that reads",
    "copy trips to 'trips.csv'": "is not one statement that reads",
    "select 1; drop table trips": "is not one statement that reads",
    "attach 'other.db'": "is not one statement that reads",
    "selec train from trips": "statement .*: syntax error at or near .selec.; trips has key",
    "select sum(train) from trips": "No function matches",
    "select * from read_csv('/etc/passwd')": "Cannot access file",
    "select * from read_parquet('**/*.parquet')": "Cannot access file",
    "select * from '/etc/passwd'": "no table",
}


@pytest.mark.parametrize("place", ["sqlite"], indirect=True)
@pytest.mark.parametrize("statement", REFUSED)
def test_what_is_wrong_in_a_statement_is_one_message_with_what_is_known(catalogue, statement):
    caught = refused(InputError, REFUSED[statement], catalogue.sql, statement)
    assert caught.remedy
    assert len(catalogue) == TRIPS


@pytest.mark.parametrize(
    ("statement", "limit", "problem"),
    [
        ("select count(*) from range(100000000000) a", {"seconds": 0.2}, r"more than 0\.2 s;"),
        ("select list(a.range) from range(300000000) a", {"memory": 5e7}, r"0\.05 GB of memory;"),
    ],
)
def test_a_statement_ends_at_its_limits(catalogue, statement, limit, problem):
    refused(InputError, problem, catalogue.sql, statement, **limit)
    assert len(catalogue.sql("select * from trips limit 3")) == 3


SAME = [
    "select count(distinct e) from edges e",
    "select count(*) from trips natural join edges",
    "select to_json(t) from trips t",
    "select unnest(t) from trips t",
    "select json_group_array(e) from edges e",
    "select struct_extract(e, 'edge') from edges e",
    "select (e).edge from edges e",
    "select {'row': e} from edges e where km_to > 20",
    "select list(s) from (select train, line from trips) s",
    "with e as (select distinct edges from edges) select count(*) from e",
    "select b from trips as t(a, b)",
    "select count(*) from (pivot trips on train using count(*))",
    "select count(*) from (unpivot (from edges) on km_from, km_to)",
    "select column_name from (summarize edges)",
    "select count(*) from trips t where exists (from edges e where e.key = t.key)",
    "select train, count(*) as trips from trips group by train order by trips, train",
    'select t.train, avg(value) from "top speed" join trips t using (key) group by all order by 1',
    "select e.edge, t.line from edges e join trips t using (key) order by all",
    "select (select max(km_to) from edges e where e.key = t.key) as far, name from trips t",
    "select distinct on (train) train, KM_TO from trips order by train, km_to",
    "select count(*) from trips positional join edges",
    "select count(columns('d.*')) from trips",
]


def unordered(value: object) -> object:
    """A cell, with the rows that an aggregate gathered in it in a fixed order."""
    if isinstance(value, str) and value.startswith("["):
        value = json.loads(value)
    if isinstance(value, np.ndarray | list):
        return sorted((unordered(each) for each in value), key=repr)
    return value


def as_found(statement: str, frame: pd.DataFrame) -> list[str]:
    """Rows as a statement gives them; in a fixed order where the statement names none."""
    rows = [repr(row) for row in frame.map(unordered).to_numpy().tolist()]
    return rows if "order by" in statement else sorted(rows)


def test_a_statement_finds_the_same_where_only_columns_that_it_names_are_read(
    tmp_path, monkeypatch
):
    with open_catalogue(tmp_path) as catalogue:
        catalogue.register(ENTRIES[:20])
        part = catalogue.pending(FIRST).iloc[:15]
        table = pa.table({"key": part["key"].tolist(), "value": [float(n) for n in range(15)]})
        done = [ResultOutcome(row.key, row.sha256, rows=1) for row in part.itertuples()]
        catalogue.record(FIRST, done, table)
        found = {statement: catalogue.sql(statement) for statement in SAME}
        monkeypatch.setattr(module, "_columns_of", lambda connection, statement: None)
        for statement, frame in found.items():
            assert len(frame), statement
            again = catalogue.sql(statement)
            assert list(again) == list(frame), statement
            assert as_found(statement, again) == as_found(statement, frame), statement


@pytest.mark.parametrize("kept", [0.5, -1])
def test_a_file_of_results_that_is_damaged_is_stated_and_computed_anew(tmp_path, kept):
    with open_catalogue(tmp_path) as catalogue:
        catalogue.register(ENTRIES[:4])
        for half in (0, 2):
            part = catalogue.pending(FIRST).iloc[:2]
            table = pa.table({"key": part["key"].tolist(), "value": [half + 1.0] * 2})
            done = [ResultOutcome(row.key, row.sha256, rows=1) for row in part.itertuples()]
            catalogue.record(FIRST, done, table)
        whole = catalogue.sql('select * from "top speed" order by key')
        (path, _) = sorted((catalogue.results_folder / "top speed").iterdir())
        data = path.read_bytes()
        path.write_bytes(data[: int(kept * len(data)) if kept >= 0 else -1])
        for ask in (
            lambda: catalogue.sql('select sum(value) from "top speed"'),
            lambda: catalogue.sql('select max(valu) from "top speed" natural join trips'),
            catalogue.tables,
            lambda: catalogue.results("top speed"),
            lambda: catalogue.compact("top speed"),
        ):
            caught = refused(InputError, "a file of results is damaged", ask)
            assert str(caught.file) == str(path)
            assert "trainlog fleet update --retry" in str(caught.remedy)
        path.unlink()
        with pytest.raises(InputError, match="a file of results is missing"):
            catalogue.sql('select * from "top speed"')
        assert catalogue.sql("select count(*) as n from trips")["n"][0] == 4
        assert catalogue.forget(FIRST) == 2
        todo = catalogue.pending(FIRST)
        again = whole[whole["key"].isin(todo["key"])]
        assert len(again) == 2
        done = [ResultOutcome(row.key, row.sha256, rows=1) for row in todo.itertuples()]
        table = pa.Table.from_pandas(again, preserve_index=False).replace_schema_metadata(None)
        assert catalogue.record(FIRST, done, table) == 2
        found = catalogue.sql('select * from "top speed" order by key')
        pd.testing.assert_frame_equal(found, whole)
        assert catalogue.forget(FIRST) == 0


def test_overviews_sum_the_trips_by_what_is_asked(catalogue):
    frame = judged()
    for by in ("train", "line", "day", "weather", "kind"):
        found = catalogue.overview(by).set_index(by)
        found.index = found.index.fillna("")
        groups = frame.assign(**{by: frame[by].fillna("")}).groupby(by)
        assert found["trips"].to_dict() == groups.size().to_dict(), by
        for name in ("distance", "duration"):
            assert found[name].to_dict() == pytest.approx(groups[name].sum().to_dict())
        if by != "train":
            assert found["trains"].to_dict() == groups["train"].nunique().to_dict()
        if by != "line":
            assert found["lines"].to_dict() == groups["line"].nunique().to_dict()
    edges = frame.explode("edges")
    edges["edge"], edges["direction"] = edges["edges"].str[0], edges["edges"].str[3]
    found = catalogue.overview("edge").set_index("edge")
    groups = edges.groupby("edge")
    assert found["trips"].to_dict() == groups["name"].nunique().to_dict()
    assert found["forward"].sum() == (edges["direction"] == "forward").sum()
    assert found["distance"].sum() == pytest.approx(
        1e3 * (edges["edges"].str[2] - edges["edges"].str[1]).sum()
    )
    for edge in found.index:
        assert len(catalogue.query(line=edge)) == found["trips"][edge]
    with pytest.raises(InputError, match="no overview by 'colour'; known: route, train"):
        catalogue.overview("colour")

"""Statements of SQL over a catalogue, and its overviews, on SQLite and on PostgreSQL."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator

import pandas as pd
import pyarrow as pa
import pytest
from command import run
from synthetic_trips import synthetic_entry

from trainlog.catalogue import Catalogue, ResultOutcome, open_catalogue
from trainlog.errors import InputError

TRIPS = 60
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
            todo = catalogue.pending("top speed", code)
            for at in range(0, most, 20):
                part = todo.iloc[at : min(at + 20, most)]
                rows = [key for key in part["key"] for _ in range(2)]
                table = pa.table({"key": rows, "value": [value] * len(rows)})
                done = [ResultOutcome(row.key, row.sha256, rows=2) for row in part.itertuples()]
                catalogue.record("top speed", code, {}, done, table)
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


def test_a_statement_joins_results_with_trips_and_counts_each_once(catalogue: Catalogue) -> None:
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


def test_tables_of_the_database_are_those_of_the_trips_that_count(catalogue: Catalogue) -> None:
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


REFUSED = {
    "select trian from trips": r"no column 'trian'; did you mean 'train'\?; trips has key, name",
    "select t.trian from trips t": r"no column 'trian'; did you mean 'train'\?; trips has key",
    "select * from trip": r"no table 'trip'; did you mean 'trips'\?; tables of .*: trips, files",
    "select * from main.trips": "no table 'main.trips'",
    'select * from "top spead"': "did you mean 'top speed'",
    "delete from trips": "is not one statement that reads",
    "copy trips to 'trips.csv'": "is not one statement that reads",
    "select 1; drop table trips": "is not one statement that reads",
    "attach 'other.db'": "is not one statement that reads",
    "selec train from trips": "statement .*; write one as",
    "select sum(train) from trips": "No function matches",
    "select * from read_csv('/etc/passwd')": "Cannot access file",
    "select * from read_parquet('**/*.parquet')": "Cannot access file",
    "select * from '/etc/passwd'": "no table",
}


@pytest.mark.parametrize("statement", REFUSED)
def test_what_is_wrong_in_a_statement_is_one_message_with_what_is_known(
    catalogue: Catalogue, statement: str
) -> None:
    with pytest.raises(InputError, match=REFUSED[statement]) as refused:
        catalogue.sql(statement)
    assert "\n" not in str(refused.value)
    assert refused.value.remedy
    assert len(catalogue) == TRIPS


def test_a_file_of_results_that_is_missing_is_stated(catalogue: Catalogue) -> None:
    folder = catalogue.results_folder / "top speed"
    (path, *_) = sorted(folder.glob("*.parquet"))
    hidden = [each.rename(each.with_suffix(".away")) for each in folder.glob("*.parquet")]
    try:
        with pytest.raises(InputError, match="a file of results cannot be read"):
            catalogue.sql('select * from "top speed"')
    finally:
        for each in hidden:
            each.rename(each.with_suffix(".parquet"))
    assert path.is_file()


def test_overviews_sum_the_trips_by_what_is_asked(catalogue: Catalogue) -> None:
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


def test_commands_ask_by_statements_and_list_by_edge(
    place: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ran(*words: str) -> tuple[int, str, str]:
        return run(monkeypatch, capsys, "catalogue", *words, "--catalogue", place)

    statement = "select train, count(*) as trips from trips group by train order by train"
    status, shown, _ = ran("sql", statement, "--csv")
    assert status == 0
    rows = list(csv.reader(io.StringIO(shown)))
    assert rows[0] == ["train", "trips"]
    assert sum(int(row[1]) for row in rows[1:]) == TRIPS
    _, shown, _ = ran("sql", statement, "--json")
    found = json.loads(shown)
    assert (found["columns"], found["count"]) == (["train", "trips"], 4)
    assert [[name, str(count)] for name, count in found["rows"]] == rows[1:]
    _, shown, _ = ran("sql", statement, "--most", "2")
    assert "4 rows" in shown
    assert "and 2 more" in shown
    _, shown, _ = ran("sql")
    assert "top speed" in shown
    status, _, said = ran("sql", "select trian from trips")
    assert status == 2
    assert "did you mean 'train'" in " ".join(said.split())
    _, shown, _ = ran("list", "--by", "edge", "--json")
    edges = json.loads(shown)["edges"]
    assert len(edges) == 10
    assert {"edge", "trips", "trains", "first", "last", "forward", "reverse"} < set(edges[0])
    _, shown, _ = ran("list", "--by", "day")
    assert "2026-01-01" in shown

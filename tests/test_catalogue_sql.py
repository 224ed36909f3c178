"""Statements of SQL and expressions that choose trips: the same on each database."""

import json
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from refusals import refused
from synthetic_trips import synthetic_entry

from trainlog.catalogue import Computation, ResultOutcome, catalogue as module, open_catalogue
from trainlog.catalogue.catalogue import Catalogue
from trainlog.catalogue.where import condition_of
from trainlog.cli.fleet import fleet_query
from trainlog.cli.options import lasting_change, moment
from trainlog.errors import InputError
from trainlog.simulation import Fault
from trainlog.simulation.rail import midnight
from trainlog.spans import times_of, utc

TRIPS = 120
FIRST = Computation("top speed", "1")
ENTRIES = [synthetic_entry(number, trains=6, days=400) for number in range(TRIPS)]


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
            computation = Computation("top speed", code)
            todo = catalogue.pending(computation)
            for at in range(0, most, 20):
                part = todo.iloc[at : min(at + 20, most)]
                recorded(catalogue, part, computation, each=2, value=value)
    return where


def recorded(catalogue, todo, computation=FIRST, each=1, **values):
    """Record results of trips: of each so many rows of the same values."""
    keys = [key for key in todo["key"] for _ in range(each)]
    columns = {name: given if isinstance(given, list) else [given] * len(keys)
               for name, given in values.items()}  # fmt: skip
    done = [ResultOutcome(row.key, row.sha256, rows=each) for row in todo.itertuples()]
    return catalogue.record(computation, done, pa.table({"key": keys, **columns}))


@pytest.fixture(scope="module")
def catalogue(place: str) -> Iterator[Catalogue]:
    with open_catalogue(place) as opened:
        yield opened


def judged() -> pd.DataFrame:
    """The trips as they were drawn."""
    frame = pd.DataFrame([{**each.entry.values, "edges": each.entry.edges} for each in ENTRIES])
    for name in ("name", "train", "kind", "line", "direction", "weather"):
        frame[name] = frame[name].astype("string")
    for name in ("duration", "distance", "km_from", "km_to", "load"):
        frame[name] = frame[name].astype("Float64")
    for name in ("start", "end"):
        frame[name] = pd.to_datetime(frame[name], unit="ns", utc=True)
    return frame.assign(day=frame["start"].dt.strftime("%Y-%m-%d"))


FRAME = judged()


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
    known = catalogue.query()
    first = known[known["key"].isin(results["key"])].groupby("train")["start"].min()
    assert (found["first"].dt.tz_localize("UTC") - first).abs().max() < pd.Timedelta("1us")
    catalogue.compact("top speed")
    pd.testing.assert_frame_equal(catalogue.sql(statement).set_index("train"), found)


def test_tables_of_the_database_are_those_of_the_trips_that_count(catalogue):
    frame = FRAME
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
        resistance = Computation("resistance", "1")
        recorded(catalogue, catalogue.pending(resistance), resistance, train="a", r0=2e3)
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


def test_a_statement_finds_the_same_where_only_columns_it_names_are_read(tmp_path, monkeypatch):
    with open_catalogue(tmp_path) as catalogue:
        catalogue.register(ENTRIES[:20])
        part = catalogue.pending(FIRST).iloc[:15]
        recorded(catalogue, part, value=[float(n) for n in range(15)])
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
            recorded(catalogue, catalogue.pending(FIRST).iloc[:2], value=half + 1.0)
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
        asked = 'select * from "top speed"'
        refused(InputError, "a file of results is missing", catalogue.sql, asked)
        assert catalogue.sql("select count(*) as n from trips")["n"][0] == 4
        assert catalogue.forget(FIRST) == 2
        todo = catalogue.pending(FIRST)
        again = whole.set_index("key").loc[todo["key"]]
        assert recorded(catalogue, todo, value=again["value"].tolist()) == 2
        found = catalogue.sql('select * from "top speed" order by key')
        pd.testing.assert_frame_equal(found, whole)
        assert catalogue.forget(FIRST) == 0


def test_overviews_sum_the_trips_by_what_is_asked(catalogue):
    frame = FRAME
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
    length = (edges["edges"].str[2] - edges["edges"].str[1]).sum()
    assert found["distance"].sum() == pytest.approx(1e3 * length)
    for edge in found.index:
        assert len(catalogue.query(line=edge)) == found["trips"][edge]
    said = "no overview by 'colour'; known: route, train"
    refused(InputError, said, catalogue.overview, "colour")


def held(name: str, key: str) -> Callable[[pd.DataFrame], pd.Series]:
    """What each trip has under a key of a column of several values."""
    return lambda f: pd.Series([each.get(key) for each in f[name]]).convert_dtypes()


def over(line: str) -> pd.Series:
    edges = [{edge for edge, *_ in each} for each in FRAME["edges"]]
    return pd.Series([line in each for each in edges], dtype="boolean")


def utc_of(text: str) -> pd.Timestamp:
    return pd.Timestamp(text, tz="UTC")


F, START = FRAME, FRAME["start"].dt
CHOSEN: dict[str, Any] = {
    "duration > '20 min'": F.duration > 1200.0,
    "duration <= '0.5 h'": F.duration <= 1800.0,
    "duration != '90 s'": F.duration != 90.0,
    "distance < '12.5 km'": F.distance < 12_500.0,
    "load >= '20 t' or load = '5000 kg'": (F.load >= 20e3) | (F.load == 5e3),
    "km_from < 5 and km_to >= 40": (F.km_from < 5) & (F.km_to >= 40),
    "repairs <> 0": F.repairs != 0,
    "km_to > -5": F.km_to > -5,
    "train = 'flirt-01'": F.train == "flirt-01",
    "kind <> 'FLIRT'": F.kind != "FLIRT",
    "not (kind = 'FLIRT')": ~(F.kind == "FLIRT"),
    "train >= 'flirt-02'": F.train >= "flirt-02",
    "weather = 'O''Brien' or weather = '%'": F.weather == "O'Brien",
    "kind in ('KISS', 'dry')": F.kind.isin(["KISS", "dry"]),
    "not (weather in ('wet', 'snow'))": ~F.weather.isin(["wet", "snow"]) & F.weather.notna(),
    "kind like 'F%'": F.kind.str.startswith("F"),
    "train like 'F%'": F.train.str.startswith("F"),
    "train like '%1'": F.train.str.endswith("1"),
    "weather like '%e%'": F.weather.str.contains("e"),
    "train like 'flirt-0_'": F.train.str.fullmatch("flirt-0."),
    r"name like 'trip\_%'": F["name"].str.startswith("trip_"),
    "line = 'line 3'": over("line 3"),
    "line <> 'line 3' and line = 'line 4'": ~over("line 3") & over("line 4"),
    # A day stands for all of it: the comparison is one of days.
    "start >= '2026-03-01'": F.start >= utc_of("2026-03-01"),
    "start > '2026-03-01'": F.start >= utc_of("2026-03-02"),
    "end <= '2026-06-10'": F.end < utc_of("2026-06-11"),
    "end < '2026-06-10T12:30Z'": F.end < utc_of("2026-06-10T12:30"),
    "year(start) between 2025 and 2026": START.year <= 2026,
    "month(start) between 3 and 6": START.month.between(3, 6),
    "weekday(start) between 1 and 2": START.day_of_week <= 1,
    "hour(start) between 8 and 12": START.hour.between(8, 12),
    "label('configuration') = '2'": held("labels", "configuration")(F) == "2",
    "topic('/train/axles') > 0": held("topics", "/train/axles")(F) > 0,
    "passport('effort_gain') >= 1.01": held("passport", "effort_gain")(F) >= 1.01,
    "kind is not null": F.kind.notna(),
    "(weather = 'wet' or kind is null) and not (line = 'line 1' or train like '%1')": (
        ((F.weather == "wet") | F.kind.isna()) & ~(over("line 1") | F.train.str.endswith("1"))
    ),
}  # expressions, and which trips pandas chooses by them


@pytest.mark.parametrize("text", CHOSEN)
def test_an_expression_means_the_same_to_each_database_and_to_pandas(catalogue, text):
    chosen = CHOSEN[text].astype("boolean").fillna(False).to_numpy(dtype=bool)
    expected = sorted(FRAME["name"][np.flatnonzero(chosen)])
    assert sorted(catalogue.query(text, columns=["name"])["name"]) == expected


def test_each_expression_chooses_some_trips_and_few_all():
    counts = [each.fillna(False).sum() for each in CHOSEN.values()]
    assert sum(0 < count < TRIPS for count in counts) > 0.8 * len(counts)


REFUSED_WHERE = {
    "train in (select name from trips)": (1, "is not allowed"),
    "1 = 1": (1, "begins with a literal"),
    "train = 'a'; drop table trips": (9, "not understood"),
    "train = 'a' -- and so on": (9, "not understood"),
    "train = 'a' union select 1": (13, "not understood at 'union'"),
    'train = "a"': (9, "a text stands in '...'"),
    "train = lower('A')": (9, r"the function lower\(\) is not allowed"),
    "pg_sleep(10) = 1": (1, r"the function pg_sleep\(\) is not allowed"),
    "trips.train = 'a'": (1, "is not allowed"),
    "same_as = 3": (1, "'same_as' is not a column"),
    "wether = 'wet'": (1, "did you mean 'weather'"),
    "weather = 'wet' and duraton > '2 min'": (21, "did you mean 'duration'"),
    "duration > 20": (12, "duration '20' is not a valid time"),
    "duration > '20 km'": (12, "'20 km' is not a valid time"),
    "load > 'heavy'": (8, "'heavy' is not a valid mass"),
    "start > 'soon'": (9, "is not a time"),
    "train > 3": (9, "is a text, not 3"),
    "weather": (1, "compared with nothing"),
    "weather = null": (None, "write 'is null'"),
    "topics = 'a'": (1, "holds several values"),
    "label(train) = 'a'": (7, "takes a name"),
    "label('a\"b') = 'a'": (7, "takes a name"),
    "month(train) = 1": (1, r"month\(\) takes a time"),
    "start > duration": (9, "not of one kind"),
    "train like 'a\\'": (12, "ends in a backslash"),
    "duration >": (None, "is not complete"),
    "": (None, "is empty"),
    "a" * 10_001: (None, "longer than"),
    "(" * 3000 + "repairs = 1" + ")" * 3000: (None, "nested too deeply|not understood"),
}


@pytest.mark.parametrize("text", REFUSED_WHERE)
def test_what_is_not_allowed_is_refused_with_the_place_and_the_remedy(text):
    column, problem = REFUSED_WHERE[text]
    caught = refused(InputError, problem, condition_of, text)
    assert caught.remedy
    if column is not None:
        assert f", column {column}:" in str(caught)


def test_times_without_a_zone_are_of_the_zone_that_is_given(catalogue):
    start = pd.Timestamp(FRAME["start"].iloc[3]).tz_convert("Asia/Tokyo")
    day = f"{start:%Y-%m-%d}"
    for found in (
        catalogue.query(f"start = '{day}'", zone="Asia/Tokyo"),
        catalogue.query(start=day, end=day, zone="Asia/Tokyo"),
    ):
        local = FRAME["start"].dt.tz_convert("Asia/Tokyo").dt.strftime("%Y-%m-%d")
        assert sorted(found["name"]) == sorted(FRAME["name"][local == day])
    refused(InputError, "zone", catalogue.query, "start = '2026-01-01'", zone="Nowhere/There")


@pytest.mark.parametrize(
    "text", ["04.10.2026", "13.10.2026", "10/05/2026", "06.10.26", "5 Oct 2026", "2026-13-10"]
)
def test_a_day_whose_numbers_are_ambiguous_is_refused_wherever_a_time_is_given(text):
    askers: list[Callable[[], object]] = [
        lambda: condition_of(f"start >= '{text}'"),
        lambda: times_of(text),
        lambda: utc(text),
        lambda: moment(text, "Europe/Zurich"),
        lambda: midnight(text),
        lambda: Fault.of(f"train=a,resistance=1.1,from={text}"),
        lambda: lasting_change(f"km=1:2,date={text},factor=1.3"),
    ]
    for ask in askers:
        caught = refused(InputError, "", ask)
        assert text in str(caught)
        assert "2026-10-" in str(caught)
    assert utc("2026-10-04") == utc("2026-10-04T01:00+01:00") == utc("20261004T00Z")

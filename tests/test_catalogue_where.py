"""Expressions that choose trips: the same meaning on each database, with pandas as the judge."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from refusals import refused
from synthetic_trips import synthetic_entry

from trainlog.catalogue import Catalogue, open_catalogue
from trainlog.catalogue.where import condition_of
from trainlog.cli.options import lasting_change, moment
from trainlog.errors import InputError
from trainlog.simulation import Fault
from trainlog.simulation.rail import midnight
from trainlog.spans import times_of, utc

TRIPS = 120
ENTRIES = [synthetic_entry(number, trains=6, days=400) for number in range(TRIPS)]


def _judged() -> pd.DataFrame:
    rows = []
    for each in ENTRIES:
        edges = {edge for edge, *_ in each.entry.edges}
        rows.append({**each.entry.values, "edges": edges})
    frame = pd.DataFrame(rows)
    for name in ("name", "train", "kind", "line", "direction", "weather"):
        frame[name] = frame[name].astype("string")
    for name in ("duration", "distance", "km_from", "km_to", "load"):
        frame[name] = frame[name].astype("Float64")
    for name in ("start", "end"):
        frame[name] = pd.to_datetime(frame[name], unit="ns", utc=True)
    return frame


FRAME = _judged()


@pytest.fixture(scope="module")
def catalogues(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Iterator[dict[str, Callable[[str], list[str]]]]:
    """By database, what chooses the names of trips by an expression."""
    folder = tmp_path_factory.mktemp("where")
    places: dict[str, str | Path] = {"sqlite": folder / "catalogue"}
    try:
        server = request.getfixturevalue("postgresql_server")
        places["postgresql"] = (
            f"{server}{'&' if '?' in server else '?'}schema=expressions_{secrets.token_hex(6)}"
        )
    except pytest.skip.Exception:
        pass
    opened: list[Catalogue] = []
    asked: dict[str, Callable[[str], list[str]]] = {}
    for name, place in places.items():
        results = folder / "results" if isinstance(place, str) else None
        opened.append(open_catalogue(place, results=results))
        opened[-1].register(ENTRIES)
        query = partial(opened[-1].query, columns=["name"])
        asked[name] = lambda where, query=query: sorted(query(where)["name"])
    yield asked
    for each in opened:
        each.close()


def held(name: str, key: str) -> Callable[[pd.DataFrame], pd.Series]:
    """What each trip has under a key of a column of several values."""
    return lambda f: pd.Series([each.get(key) for each in f[name]]).convert_dtypes()


def over(line: str) -> pd.Series:
    return pd.Series([line in each for each in FRAME["edges"]], dtype="boolean")


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
}
"""Expressions, and which trips pandas chooses by them."""


@pytest.mark.parametrize("text", CHOSEN)
def test_an_expression_means_the_same_to_each_database_and_to_pandas(catalogues, text):
    chosen = CHOSEN[text].astype("boolean").fillna(False).to_numpy(dtype=bool)
    expected = sorted(FRAME["name"][np.flatnonzero(chosen)])
    for name, ask in catalogues.items():
        assert ask(text) == expected, name


def test_each_expression_chooses_some_trips_and_few_all():
    counts = [each.fillna(False).sum() for each in CHOSEN.values()]
    assert sum(0 < count < TRIPS for count in counts) > 0.8 * len(counts)


REFUSED = {
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


@pytest.mark.parametrize("text", REFUSED)
def test_what_is_not_allowed_is_refused_with_the_place_and_the_remedy(text):
    column, problem = REFUSED[text]
    caught = refused(InputError, problem, condition_of, text)
    assert caught.remedy
    if column is not None:
        assert f", column {column}:" in str(caught)


def test_times_without_a_zone_are_of_the_zone_that_is_given(catalogues, tmp_path):
    with open_catalogue(tmp_path / "one") as catalogue:
        catalogue.register(ENTRIES)
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

"""Expressions that choose trips: the same meaning on each database, with pandas as the judge."""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
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
        assert each.entry is not None
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
        asked[name] = _asks(opened[-1])
    yield asked
    for each in opened:
        each.close()


def _asks(catalogue: Catalogue) -> Callable[[str], list[str]]:
    return lambda where: sorted(catalogue.query(where, columns=["name"])["name"])


@dataclass(frozen=True)
class Expression:
    """An expression, and which trips pandas chooses by it."""

    text: str
    chosen: Callable[[pd.DataFrame], pd.Series]


def _compared(name: str, sign: str, literal: str, value: Any) -> Expression:
    methods = {"=": "eq", "<>": "ne", "!=": "ne", "<": "lt", "<=": "le", ">": "gt", ">=": "ge"}
    return Expression(
        f"{name} {sign} {literal}",
        lambda f: getattr(f[name], methods[sign])(value).astype("boolean"),
    )


SIGNS = st.sampled_from(["=", "<>", "!=", "<", "<=", ">", ">="])
UNITS = {"duration": [("min", 60.0), ("h", 3600.0), ("s", 1.0)], "distance": [("km", 1e3)]}
UNITS |= {"load": [("t", 1e3), ("kg", 1.0)]}


@st.composite
def quantities(draw: st.DrawFn) -> Expression:
    name = draw(st.sampled_from(sorted(UNITS)))
    unit, factor = draw(st.sampled_from(UNITS[name]))
    value = draw(st.integers(0, 60)) / 2
    return _compared(name, draw(SIGNS), f"'{value:g} {unit}'", value * factor)


@st.composite
def numbers(draw: st.DrawFn) -> Expression:
    name = draw(st.sampled_from(["km_from", "km_to", "repairs"]))
    value = draw(st.integers(-5, 100))
    return _compared(name, draw(SIGNS), str(value), value)


@st.composite
def texts(draw: st.DrawFn) -> Expression:
    name = draw(st.sampled_from(["train", "kind", "direction", "weather"]))
    value = draw(st.sampled_from(["flirt-01", "FLIRT", "flirt", "wet", "forward", "O'Brien", "%"]))
    quoted = value.replace("'", "''")
    if draw(st.booleans()):
        return _compared(name, draw(SIGNS), f"'{quoted}'", value)
    others = draw(st.lists(st.sampled_from(["KISS", "dry", "flirt-02"]), min_size=1, max_size=2))
    listed = ", ".join(f"'{each}'" for each in (quoted, *others))
    return Expression(
        f"{name} in ({listed})",
        lambda f: f[name].isin([value, *others]).astype("boolean").mask(f[name].isna()),
    )


@st.composite
def patterns(draw: st.DrawFn) -> Expression:
    name = draw(st.sampled_from(["train", "kind", "weather", "name"]))
    pattern = draw(
        st.sampled_from(["f%", "F%", "%1", "flirt-0_", "%e%", "trip-00001_", r"trip\_%"])
    )
    regular = re.escape(pattern).replace("%", ".*").replace("_", ".").replace(r"\\.", "_")
    return Expression(
        f"{name} like '{pattern}'", lambda f: f[name].str.fullmatch(regular).astype("boolean")
    )


@st.composite
def lines(draw: st.DrawFn) -> Expression:
    line = f"line {draw(st.integers(0, 10))}"
    over = lambda f: pd.Series([line in each for each in f["edges"]], dtype="boolean")  # noqa: E731
    if draw(st.booleans()):
        return Expression(f"line = '{line}'", over)
    return Expression(f"line <> '{line}'", lambda f: ~over(f))


@st.composite
def times(draw: st.DrawFn) -> Expression:
    day = pd.Timestamp("2026-01-01", tz="UTC") + pd.Timedelta(days=draw(st.integers(-5, 400)))
    name, sign = draw(st.sampled_from(["start", "end"])), draw(SIGNS)
    if draw(st.booleans()):
        # A day stands for all of it: the comparison is one of days.
        words = f"{name} {sign} '{day:%Y-%m-%d}'"
        judge = _compared(name, sign, "", day)
        return Expression(words, lambda f: judge.chosen(f.assign(**{name: f[name].dt.floor("D")})))
    instant = day + pd.Timedelta(minutes=draw(st.integers(0, 1439)))
    return _compared(name, sign, f"'{instant:%Y-%m-%dT%H:%MZ}'", instant)


@st.composite
def calendars(draw: st.DrawFn) -> Expression:
    name, least, most = draw(
        st.sampled_from(
            [("year", 2025, 2027), ("month", 1, 12), ("weekday", 1, 7), ("hour", 0, 23)]
        )
    )
    low, high = sorted([draw(st.integers(least, most)), draw(st.integers(least, most))])

    def chosen(f: pd.DataFrame) -> pd.Series:
        found = getattr(f["start"].dt, {"weekday": "day_of_week"}.get(name, name))
        found = found + (name == "weekday")
        return found.between(low, high).astype("boolean")

    return Expression(f"{name}(start) between {low} and {high}", chosen)


@st.composite
def held(draw: st.DrawFn) -> Expression:
    kind = draw(st.sampled_from(["label", "topic", "passport", "null"]))
    if kind == "label":
        value = str(draw(st.integers(0, 4)))
        return Expression(
            f"label('configuration') = '{value}'",
            lambda f: pd.Series(
                [e["configuration"] == value for e in f["labels"]], dtype="boolean"
            ),
        )
    if kind == "topic":
        return Expression(
            "topic('/train/axles') > 0",
            lambda f: pd.Series([e["/train/axles"] > 0 for e in f["topics"]], dtype="boolean"),
        )
    if kind == "null":
        return Expression("kind is not null", lambda f: f["kind"].notna().astype("boolean"))
    gains = lambda f: pd.Series([e.get("effort_gain") for e in f["passport"]], dtype="Float64")  # noqa: E731
    return Expression(
        "passport('effort_gain') >= 1.01", lambda f: gains(f).ge(1.01).astype("boolean")
    )


ATOMS = st.one_of(
    quantities(), numbers(), texts(), patterns(), lines(), times(), calendars(), held()
)


def _joined(inner: st.SearchStrategy[Expression]) -> st.SearchStrategy[Expression]:
    def both(one: Expression, other: Expression) -> Expression:
        return Expression(
            f"({one.text}) and ({other.text})", lambda f: one.chosen(f) & other.chosen(f)
        )

    def either(one: Expression, other: Expression) -> Expression:
        return Expression(
            f"({one.text}) or {other.text}", lambda f: one.chosen(f) | other.chosen(f)
        )

    return st.one_of(
        st.builds(both, inner, inner),
        st.builds(either, inner, inner),
        inner.map(lambda e: Expression(f"not ({e.text})", lambda f: ~e.chosen(f))),
    )


@settings(max_examples=15, derandomize=True)
@given(expression=st.recursive(ATOMS, _joined, max_leaves=5))
def test_an_expression_means_the_same_to_each_database_and_to_pandas(
    catalogues: dict[str, Callable[[str], list[str]]], expression: Expression
) -> None:
    chosen = expression.chosen(FRAME).fillna(False).to_numpy(dtype=bool)
    expected = sorted(FRAME["name"][np.flatnonzero(chosen)])
    for name, ask in catalogues.items():
        assert ask(expression.text) == expected, name


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
def test_what_is_not_allowed_is_refused_with_the_place_and_the_remedy(text: str) -> None:
    column, problem = REFUSED[text]
    with pytest.raises(InputError, match=problem) as refused:
        condition_of(text)
    assert refused.value.remedy
    if column is not None:
        assert f", column {column}:" in str(refused.value)


def test_times_without_a_zone_are_of_the_zone_that_is_given(
    catalogues: dict[str, Callable[[str], list[str]]], tmp_path: Path
) -> None:
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
        with pytest.raises(InputError, match="zone"):
            catalogue.query("start = '2026-01-01'", zone="Nowhere/There")


@pytest.mark.parametrize(
    "text", ["04.10.2026", "13.10.2026", "10/05/2026", "06.10.26", "5 Oct 2026", "2026-13-10"]
)
def test_a_day_whose_numbers_are_ambiguous_is_refused_wherever_a_time_is_given(text: str) -> None:
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
        with pytest.raises(InputError) as refused:
            ask()
        assert text in str(refused.value)
        assert "2026-10-" in str(refused.value)
    assert utc("2026-10-04") == utc("2026-10-04T01:00+01:00") == utc("20261004T00Z")

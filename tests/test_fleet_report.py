"""The report on a fleet holds what the catalogue's tables say."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("sqlalchemy")

from analysis.fleet.analyses import ANALYSES, computation_of
from analysis.fleet.checks import contradicted_dates
from analysis.fleet.trains import FleetTrains
from analysis.fleet.unlike import Cause, Explanation, Finding, UnlikeTrains
from analysis.fleet.update import UpdateOptions, update_fleet
from analysis.reports.fleet import (
    FleetFacts,
    FleetReportOptions,
    _by_day,
    attention_parts,
    fleet_page,
)
from analysis.reports.page import Page, Section
from trainlog import DEFAULT_LINE, Edge, Network, Node, read_line, sample, write_network
from trainlog.catalogue import Catalogue, ResultOutcome, open_catalogue
from trainlog.presentation import WordTable
from trainlog.units import JOULES_PER_KWH

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds")

REASON = "the wheels' diameters <b>cannot</b> be distinguished: 3.4 of 5 samples"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A catalogue of the two sample trips; of one of them the passport is refused."""
    place = tmp_path_factory.mktemp("fleet") / "catalogue"
    with open_catalogue(place) as catalogue:
        catalogue.add("sample_logs")
        passport = computation_of(ANALYSES["passport"])
        first = catalogue.pending(passport).iloc[0]
        catalogue.record(passport, [ResultOutcome(first.key, first.sha256, "refused", REASON)])
        names = ["adhesion", "driving", "checks"]
        update_fleet(catalogue, names, UpdateOptions(workers=0))
    return place


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    line = read_line(sample(DEFAULT_LINE))
    nodes = (Node("St.Gallen"), Node("Wil"))
    path = tmp_path_factory.mktemp("network") / "one.network.json"
    write_network(Network("one", nodes, (Edge(line.name, line, *(n.name for n in nodes)),)), path)
    return path


def table_of(page: Page, name: str) -> list[dict]:
    """The rows of a table, by its name, wherever it stands."""

    def parts(section: Section):
        for part in section.parts:
            yield from parts(part) if isinstance(part, Section) else [part]

    every = [part for section in page.sections for part in parts(section)]
    (found,) = [part for part in every if isinstance(part, WordTable) and part.name == name]
    return found.data


@pytest.fixture(scope="module")
def catalogue(place: Path):
    with open_catalogue(place) as opened:
        yield opened


@pytest.fixture(scope="module")
def page(catalogue: Catalogue) -> Page:
    return fleet_page(catalogue, FleetReportOptions())


def test_trips_and_energy_are_those_of_the_tables(catalogue, page):
    trips = catalogue.query()
    by_train = table_of(page, "by_train")
    assert sum(row["trips"] for row in by_train) == len(trips) == 2
    assert sum(row["distance_m"] for row in by_train) == pytest.approx(trips["distance"].sum())
    driving = catalogue.results("driving")
    (energy,) = table_of(page, "energy_by_train")
    assert energy["traction_J_m"] == pytest.approx(
        driving["traction"].sum() / driving["distance"].sum()
    )
    assert 3.0 < 1e3 * energy["traction_J_m"] / JOULES_PER_KWH < 12.0
    (edge,) = table_of(page, "energy_by_line")
    assert edge["runs"] == len(driving)
    lost = {row["cause"]: row["a_run_s"] for row in table_of(page, "lost_time")}
    assert lost["slower"] == pytest.approx(driving["lost_slower"].mean())


def test_days_without_trips_have_no_bar():
    """A clock that starts at 1980-01-06 would give thousands of them."""
    starts = pd.to_datetime(["1980-01-06", "2026-10-01", "2026-10-01"], utc=True)
    chart = _by_day(pd.DataFrame({"start": starts, "kind": ["a", "a", None]}))
    first, second = chart.panels[0].curves
    np.testing.assert_array_equal(first.x, [3_657.0, 20_727.0])
    np.testing.assert_array_equal((first.y, second.y), [(1.0, 1.0), (1.0, 2.0)])


@pytest.mark.usefixtures("unpainted_page")
def test_what_was_refused_is_listed_with_its_reason_and_nothing_in_it_is_code(page):
    (row,) = table_of(page, "refused")
    assert (row["analysis"], row["trips"]) == ("passport", 1)
    assert row["reason_of_one_of_them"] == REASON
    computed = {row["analysis"]: row for row in table_of(page, "computed")}
    assert computed["passport"]["refused"] == computed["passport"]["pending"] == 1
    assert computed["resistance"]["pending"] == computed["driving"]["done"] == 2
    html = page.to_html()
    assert "<b>cannot" not in html
    assert REASON in unescape(html)


def test_the_condition_is_that_of_the_maps(catalogue, page):
    rows = table_of(page, "edges")
    assert {row["layer"] for row in rows} == {"dry", "wet"}
    evidence = catalogue.results("adhesion").groupby("layer")["onsets"].sum()
    onsets = {row["layer"]: row["onsets"] for row in rows}
    assert onsets == evidence.to_dict()
    lowest = [row["expected_low"] for row in table_of(page, "lowest_wet")]
    assert np.all(np.diff(lowest) >= 0.0)


def test_findings_and_trains_without_a_result_are_listed_with_what_to_do():
    keys = [str(number) for number in range(8)]
    trips = pd.DataFrame(
        {
            "key": keys, "name": keys, "train": 4 * ["a"] + 4 * ["b"], "reason": "",
            "start": pd.date_range("2026-10-01", periods=8, freq="D", tz="UTC"),
            "line": "A - B", "direction": "forward", "labels": None,
        }
    )  # fmt: skip
    trips["end"] = trips["start"] + pd.Timedelta("1h")
    trips["added"] = trips["start"] + pd.Timedelta("1D")
    states = {
        "driving": 8 * ["done"],
        "resistance": ["done", *3 * ["refused"], *4 * ["done"]],
        "adhesion": 4 * ["done"] + 4 * ["refused"],
        "checks": ["failed"] + 7 * ["done"],
    }
    since = trips["start"][2]
    brake = Cause("dragging brake", 2e3, 150.0, "N", 0.9)
    delay = Cause("sensor delay", 0.3, 0.02, "s", 0.1)
    findings = [
        Finding("a", "unit", Explanation(brake, others, known), since, "2", (since, since), since,
                2, "own past", "constant resistance", 1e-7)
        for others, known in (((), True), ((delay,), True), ((), False))
    ]  # fmt: skip
    facts = FleetFacts(
        trips,
        FleetTrains(cast("Any", ()), UnlikeTrains(tuple(findings), (), 0.01, 1.0), (), {}),
        {name: trips.assign(state=each) for name, each in states.items()},
        pd.DataFrame({"train": trips["train"], "damage": "", "frozen": 7 * [""] + ["speed"]}),
    )
    (table,) = attention_parts(facts)
    nothing = replace(facts, outcomes={}, checks=pd.DataFrame())
    few = replace(nothing, trains=FleetTrains(
        cast("Any", (SimpleNamespace(kind="unit", rows=trips, compared=False),)),
        UnlikeTrains((), (), 0.01, 1.0), (), {},
    ))  # fmt: skip
    words = [str(getattr(each, "text", each)) for each in attention_parts(few)]
    assert words[0].startswith("Nothing: ")
    assert "Too few trains of kind unit (2)" in words[1], "no finding is no all-clear"
    assert isinstance(table, WordTable)
    rows = [(row["train"], row["trips"], row["what_to_do"]) for row in table.data]
    release = "look for a friction brake that does not release"
    assert rows[0] == ("a", 2, release), "of its four trips two began since then"
    assert rows[1][2] == f"{release}; or check clock and filter of the recorded efforts"
    assert rows[2][2].startswith("look at its trips before and after")
    assert [row[:2] for row in rows[3:]] == [("b", 4), ("a", 1), ("b", 1)]
    assert "record the speeds of its axles" in rows[3][2]


def test_trips_whose_dates_contradict_each_other_are_named():
    """A train that runs to and fro; two recorders on one trip contradict nothing."""
    hour, day = pd.Timedelta("1h"), pd.Timedelta("1D")
    start = pd.Timestamp("2026-10-01T05:00Z") + np.arange(12) * hour
    trips = pd.DataFrame(
        {
            "train": ["a", "b"] * 6, "line": ["A - B", "B - A"] * 6, "direction": "forward",
            "start": start, "end": start + 1.5 * hour, "added": start + day, "labels": None,
        }
    )  # fmt: skip
    assert contradicted_dates(trips).empty
    doubled = pd.concat([trips, trips.iloc[:3].assign(end=trips["end"] - 0.5 * hour)])
    assert contradicted_dates(doubled).empty
    wrong = trips.copy()
    wrong.loc[1, ["start", "end"]] += 5 * hour  # b is at 11:00 to 12:30 on its trip of 10:00
    found = contradicted_dates(wrong)
    assert (
        found[["train", "what"]].to_numpy().tolist()
        == [["b", "dated while the train was on another trip"]] * 2
    )
    wrong.loc[2, ["start", "end"]] += 30 * day
    files = pd.DataFrame({"path": ["a.mcap", "b.mcap"], "what": ["refused", "copy"], "reason": ""})
    facts = FleetFacts(wrong, "no curve", {}, pd.DataFrame(), files)
    (table,) = attention_parts(facts)
    assert isinstance(table, WordTable)
    rows = {row["what"]: row for row in table.data}
    assert "1 file refused" in rows
    later = rows["dated after its log was registered"]
    assert (later["train"], later["trips"], later["since"]) == ("a", 1, "2026-10-31 07:00")
    simulated = wrong.assign(labels=[{"clock": "UTC, simulated"}] * 12)
    assert "dated after its log was registered" not in set(contradicted_dates(simulated)["what"])


@pytest.mark.usefixtures("unpainted")
def test_the_command_writes_one_page_that_asks_for_nothing(place, network, tmp_path, shell):
    words = ("report", place, "--network", network, "-o", tmp_path / "fleet.html")
    assert shell(*words)[0] == 0
    html = (tmp_path / "fleet.html").read_text("utf-8")
    assert "Maximum adhesion to count on, wet rail" in html
    elements = re.sub(r"<script.*?</script>", "", html, flags=re.S)
    links = re.findall(r'(?:src|href)="([^"]*)"', elements)
    assert all(each.startswith(("#", "data:")) for each in links)
    assert re.search(r"script-src 'none'|script-src 'sha256-", html)
    wrong = ("report", place, "--trips", "train = 'none'", "-o", tmp_path / "a.html")
    status, _, complaint = shell(*wrong)
    assert (status, "no trip is chosen" in complaint) == (2, True)
    assert not (tmp_path / "a.html").exists()

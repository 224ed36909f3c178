"""What a fleet knows that a trip does not: resistance, drift, unlike trains; the report on it."""

import json
import re
import sys
from dataclasses import replace
from functools import cache
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest
from refusals import refused

from analysis import UpdateOptions, fit, update_fleet, view_of
from analysis.charts import draw_charts
from analysis.fleet import analyses
from analysis.fleet.analyses import ANALYSES, computation_of
from analysis.fleet.checks import contradicted_dates
from analysis.fleet.plot import findings_charts
from analysis.fleet.resistance import KindResistance, TrainResistance, fleet_resistance
from analysis.fleet.trains import Drift, FleetTrains, fleet_trains, trains_in
from analysis.fleet.unlike import Cause, Explanation, Finding, UnlikeTrains
from analysis.reports import fleet as report
from analysis.reports.page import Page, Section
from trainlog import DEFAULT_LINE, Edge, Network, Node, read_line, sample, write_network
from trainlog.catalogue import Catalogue, ResultOutcome, open_catalogue
from trainlog.cli.options import chosen_summaries
from trainlog.cli.terminal import as_json_text
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.presentation import WordTable
from trainlog.units import JOULES_PER_KWH

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "fleet"))

from drawn_trains import Fault, drawn_fleet

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds")

SPEEDS = np.linspace(5.0, 34.0, 30)
FAULTS = {"dragging brake": 2000.0, "mass": 0.05, "wheel diameter": 0.01, "effort gain": 0.05}
FAULTS |= {"sensor delay": 0.3}
SINCE = 40
KINDS = ("flirt", "virm")


@cache
def pool(*kinds: str) -> pd.DataFrame:
    """Summaries and passports of trips that were simulated, recorded and fitted."""
    rows = pd.read_parquet(Path(__file__).parent / "data" / "fleet_trips.parquet")
    return rows[rows["kind"].isin(kinds or KINDS)].reset_index(drop=True)


@pytest.mark.parametrize(("end", "share"), [(SINCE + 9, 1.0), (None, 0.5)])
def test_a_fault_that_goes_again_or_comes_on_some_trips_is_one_finding(end, share):
    faults = tuple(Fault(*each, n, SINCE, end, share) for n, each in enumerate(FAULTS.items()))
    rows = drawn_fleet(pool(), 2, trains=7, trips=80, faults=faults)
    found, named = fleet_trains(rows), []
    for number, (what, size) in enumerate(FAULTS.items(), start=1):
        for kind in KINDS:
            train = f"{kind}-{number:02d}"
            first, *more = found.of(train)
            cause = first.explanation.cause
            said = "until" in str(first), "of its trips" in str(first)
            named += [first.what == what and not more and said == (end is not None, not end)]
            if not named[-1]:
                continue
            assert cause.size == pytest.approx(size, rel=0.25)
            assert first.share == pytest.approx(share, abs=0.25)
            lasted = int(first.lasts(rows["start"][rows["train"] == train]).sum())
            assert lasted == pytest.approx(9 if end else 40, abs=2 if end else 12)
    assert sum(named) >= 8
    assert not [each for each in found.unlike.findings if int(each.train[-2:]) > len(FAULTS)]


def curve(one: TrainResistance) -> np.ndarray:
    return np.asarray(one.resistance(SPEEDS))


def true_curves(kind: KindResistance, rows: pd.DataFrame) -> dict[str, np.ndarray]:
    """Each train's own curve times what days and season add to all of the kind."""
    rows = rows[rows["kind"] == kind.kind]
    names = ("r0", "r1", "r2")
    days = [np.median(rows[f"true_{name}"] / rows[f"own_{name}"]) for name in names]
    first = rows.groupby("train")[[f"own_{name}" for name in names]].first() * days
    return {
        str(train): np.polyval(own[::-1], SPEEDS)
        for train, own in zip(first.index, first.to_numpy(), strict=True)
    }


def test_bands_hold_the_true_curves_after_one_trip_and_after_many():
    for trips in (1, 5):
        inside = []
        for seed in range(2):
            rows = drawn_fleet(pool(), 50 + seed, trains=8, trips=trips)
            for kind in fleet_resistance(rows):
                true = true_curves(kind, rows)
                for one in kind.trains:
                    low, high = one.band(SPEEDS)
                    inside.append(np.all((low <= true[one.train]) & (true[one.train] <= high)))
        assert len(inside) == 32
        # Trains of one fleet share the errors of lines: more may miss at once than by chance.
        assert np.mean(inside) >= 0.9, trips


def test_a_gain_that_many_trips_share_does_not_explain_their_noise():
    rows = drawn_fleet(pool("flirt"), 12, trains=4, trips=150)
    # Two of them weigh no load: their efforts are as uncertain as a recorder's gain.
    unknown = rows["train"].isin(sorted(rows["train"].unique())[:2]).to_numpy()
    size = np.where(unknown, 0.05, 0.0)
    rows["assumed_gain_std"] = np.where(unknown, size, np.nan)
    for i, one in enumerate(("r0", "r1", "r2")):
        for other in ("r0", "r1", "r2")[i:]:
            rows[f"covariance_{one}_{other}"] += size**2 * rows[one] * rows[other]
    kind = fleet_resistance(rows)["flirt"]
    for one, true in zip(kind.trains, true_curves(kind, rows).values(), strict=True):
        low, high = one.band(SPEEDS)
        assert np.all((low < true) & (true < high)), one.train
        assert np.max(np.abs(curve(one) / true - 1.0)) < 0.05


def test_faults_are_named_with_beginning_and_size_and_healthy_trains_raise_no_alarm():
    """Of seven trains of each of two kinds five have a fault from trip 40 on."""
    faults = tuple(Fault(what, size, n, SINCE) for n, (what, size) in enumerate(FAULTS.items()))
    found = fleet_trains(drawn_fleet(pool(), 1, trains=7, trips=60, faults=faults))
    for number, (what, size) in enumerate(FAULTS.items(), start=1):
        for kind in KINDS:
            (finding,) = found.of(f"{kind}-{number:02d}")
            cause = finding.explanation.cause
            named = {finding.what, *(each.what for each in finding.explanation.others)}
            assert what in named
            if what not in ("mass", "effort gain"):
                assert finding.what == what
            assert abs(int(finding.trip[-5:]) - SINCE) <= 1
            assert finding.trips <= 8
            if finding.what == what:
                assert abs(cause.size - size) < 3.0 * cause.std
            assert finding.p < found.unlike.rate
            assert finding.between[0] <= finding.since <= finding.between[1]
    assert {each.train[-2:] for each in found.unlike.findings} == {"01", "02", "03", "04", "05"}
    content = json.loads(as_json_text(found.details()))
    assert {each["train"] for each in content["findings"]} >= {"flirt-01", "virm-03"}
    assert content["false_alarms_per_train_and_month"] == 0.01
    one = found.only("flirt-01")
    assert [each.train for kind in one.resistance for each in kind.trains] == ["flirt-01"]
    refused(InputError, "known are", found.only, "flirt-99")
    short = pool("flirt").head(3).assign(refused="too short", message="too short")
    refused(NotIdentifiableError, "no trip determines", fleet_resistance, short)
    few = fleet_resistance(pool("flirt").head(40))
    refused(InputError, "known are: flirt", few.__getitem__, "kiss")


@pytest.mark.long
def test_a_fleet_of_healthy_trains_raises_no_alarm():
    healthy = fleet_trains(drawn_fleet(pool(), 9, trains=6, trips=60))
    assert healthy.unlike.findings == ()
    assert healthy.unlike.train_months == pytest.approx(12.0, abs=1.0)


DRAGGING, DELAYED = Fault("dragging brake", 3000.0, 0, SINCE), Fault("sensor delay", 0.9, 1, 0)


@pytest.mark.parametrize(
    ("fault", "seed", "trains", "trips", "against"),
    [(DRAGGING, 2, 1, 60, "own past"), (DELAYED, 6, 9, 30, "kind")],
)
def test_a_train_is_compared_with_its_past_and_with_its_kind(fault, seed, trains, trips, against):
    rows = drawn_fleet(pool("flirt"), seed, trains=trains, trips=trips, faults=(fault,))
    found = fleet_trains(rows)
    (finding,) = found.unlike.findings
    assert (finding.train, finding.what) == (f"flirt-{fault.train + 1:02d}", fault.what)
    assert finding.against == against
    assert all(np.isnan(each.constant) for each in found.unlike.limits) == (trains == 1)


def test_of_two_trains_none_is_called_unlike_the_other_and_this_is_stated(tmp_path):
    fault = Fault("dragging brake", 12000.0, 0, 0)
    found = fleet_trains(drawn_fleet(pool("flirt"), 13, trains=2, trips=10, faults=(fault,)))
    assert found.unlike.findings == ()
    assert all(np.isnan(each.constant) for each in found.unlike.limits)
    rows = found.tables()[0].data
    assert all(row["against_kind"] is None for row in rows)
    assert [type(row["trips"]) for row in rows] == [int] * 3
    alone = found.only("flirt-01").unlike.train_months
    assert alone == pytest.approx(0.5 * found.unlike.train_months, rel=0.1)
    for shown in (found, found.only("flirt-01")):
        assert "Too few trains of kind flirt (2)" in shown.too_few
        assert shown.sentences() == [shown.too_few]
    path = tmp_path / "findings.svg"
    draw_charts(findings_charts(found), path)
    drawn = path.read_text("utf-8")
    assert "Too few trains of kind flirt (2)" in drawn
    assert "unlike the others" not in drawn


@pytest.mark.parametrize(
    ("kind", "what", "size", "trips", "since"),
    [
        ("flirt", "dragging brake", 4e3, 18, 9),
        pytest.param("kiss", "effort gain", 0.1, 18, 9, marks=pytest.mark.long),
        ("virm", "wheel diameter", 0.03, 7, 4),
    ],
)
def test_a_gross_fault_of_one_of_two_trains_is_not_hidden_in_noise(kind, what, size, trips, since):
    fault = Fault(what, size, 1, since)
    found = fleet_trains(drawn_fleet(pool(kind), 37, trains=2, trips=trips, faults=(fault,)))
    (finding,) = found.unlike.findings
    named = {each.what for each in (finding.explanation.cause, *finding.explanation.others)}
    assert (finding.train, finding.against) == (f"{kind}-02", "own past")
    assert what in named
    assert int(finding.trip[-5:]) == since
    healthy = fleet_trains(drawn_fleet(pool(kind), 37, trains=2, trips=trips)).unlike
    limits = {(each.train, each.channel): each.change for each in healthy.limits}
    for each in found.unlike.limits:
        # The fault does not make the noise by which it is judged.
        if np.isfinite(each.change):
            assert each.change < 1.25 * limits[each.train, each.channel] + 1e-9


def test_a_step_that_is_no_finding_is_stated():
    fault = Fault("effort gain", 0.1, 1, 4)
    rows = drawn_fleet(pool("kiss"), 37, trains=2, trips=7, faults=(fault,))
    found = fleet_trains(rows)
    assert found.unlike.findings == ()
    step = next(each for each in found.unlike.steps if each.channel == "effort gain")
    assert (step.train, step.trips) == ("kiss-02", 3)
    assert step.size == pytest.approx(0.1, abs=0.03)
    assert f"kiss-02: {step}, since" in str(found.tables()[1].caption)
    # The checks of recordings state it, too, where trains are not compared.
    scale = 1.0 + 0.02 * (rows["start"] >= step.since)
    checks = rows.assign(speed_scale=scale, damage="", frozen="")
    trips = rows.assign(end=rows["start"], added=rows["start"], labels=None)
    (table,) = report.attention_parts(report.FleetFacts(trips, "no curve", {}, checks))
    assert "step of +2 %" in " ".join(row["what"] for row in table.data)


def test_what_is_not_recorded_is_not_judged_and_this_is_stated():
    fault = Fault("wheel diameter", 0.01, 0, SINCE), Fault("effort gain", 0.05, 1, SINCE)
    rows = drawn_fleet(pool("flirt"), 7, trains=5, trips=60, faults=fault)
    blind = rows["train"].isin(["flirt-01", "flirt-02"])
    rows.loc[blind, "speed_scale_source"] = "nothing"
    rows.loc[blind, "load_source"] = "assumed"
    rows.loc[blind, "effort_gain_source"] = "assumed"
    found = fleet_trains(rows)
    assert not any(each.what == "wheel diameter" for each in found.of("flirt-01"))
    limits = {(each.train, each.channel): each for each in found.unlike.limits}
    nowhere = limits["flirt-01", "speed scale"]
    assert np.isnan(nowhere.change)
    assert "neither satellites nor distance" in nowhere.reason
    assert np.isnan(limits["flirt-02", "effort gain"].change)
    assert limits["flirt-03", "speed scale"].change < 0.01


def test_a_single_bad_trip_is_not_a_fault_of_its_train():
    rows = drawn_fleet(pool("flirt"), 8, trains=5, trips=50)
    bad = rows.index[(rows["train"] == "flirt-01")][45]
    rows.loc[bad, "r0"] += 20e3
    rows.loc[bad, "effort_delay"] += 2.0
    assert fleet_trains(rows).unlike.findings == ()


def drift(found: FleetTrains, train: str, channel: str) -> Drift:
    return next(each for each in found.drift if (each.train, each.channel) == (train, channel))


@pytest.mark.parametrize("trips", [60, pytest.param(180, marks=pytest.mark.long)])
def test_the_wear_of_wheels_and_a_season_are_found_where_the_trips_span_enough(trips):
    """Over a year, of few trips or of many."""
    drawn = {"trips": trips, "trips_a_day": trips / 360.0, "wear": 0.0, "season": 0.06}
    rows = drawn_fleet(pool("flirt"), 11, trains=5, **drawn)
    months = (rows["start"] - rows["start"].min()) / pd.Timedelta(days=30.4375)
    # Wear is a share of the scale, a month; the trend is that of its logarithm.
    rows.loc[rows["train"] == "flirt-02", "speed_scale"] *= np.exp(0.0005 * months)
    found = fleet_trains(rows)
    worn = drift(found, "flirt-02", "speed scale")
    low, high = worn.band
    assert low < 0.0005 < high
    assert worn.drifts
    # The others are compared with a kind of which it is one in five.
    assert abs(drift(found, "flirt-04", "speed scale").trend_a_month) < 0.00005
    season = drift(found, "", "size of the curve")
    assert abs(season.season - 0.06) < 3.0 * season.season_std + 0.01
    # The drawn season is highest four months after the start in January.
    assert season.highest_month in (4, 5, 6)


def test_stored_results_show_trains_and_stand_for_logs(tmp_path, monkeypatch):
    with open_catalogue(tmp_path) as catalogue:
        catalogue.add("sample_logs")
        for name in ("resistance", "passport"):
            analysis = ANALYSES[name]
            computation = analyses.computation_of(analysis)
            for number, row in enumerate(catalogue.pending(computation).itertuples()):
                table = analysis.arrow([(row.key, analysis.table(view_of(str(row.path))))])
                outcome = ResultOutcome(row.key, row.sha256, rows=table.num_rows)
                catalogue.record(computation, [outcome], table)
                if name == "resistance" and number == 0:
                    # A fit of chosen trips takes what is stored in place of the log.
                    given = chosen_summaries("all", str(tmp_path))
        every = [Path(path) for path in catalogue.paths()]
        (kind,) = trains_in(catalogue).resistance
        assert [each.trips for each in kind.trains] == [2]
        refused(InputError, "no trips of kind", trains_in, catalogue, kind="steam")
        refused(InputError, "fleet update", trains_in, catalogue, where="train = 'nobody'")
    assert [path.suffix for path in given] == [".parquet", ".mcap"]
    kept, read = fit(given).parameters, fit(every).parameters
    assert kept.configurations == read.configurations
    assert np.array_equal(kept.common_covariance, read.common_covariance)
    # By other code nothing is stored: the logs are read.
    other = replace(analyses.computation_of(ANALYSES["resistance"]), code="other")
    monkeypatch.setattr(analyses, "computation_of", lambda _: other)
    assert [path.suffix for path in chosen_summaries("all", str(tmp_path))] == [".mcap"] * 2


REASON = "the wheels' diameters <b>cannot</b> be distinguished: 3.4 of 5 samples"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("fleet") / "catalogue"
    with open_catalogue(place) as catalogue:
        catalogue.add("sample_logs")
        passport = computation_of(ANALYSES["passport"])
        first = catalogue.pending(passport).iloc[0]
        catalogue.record(passport, [ResultOutcome(first.key, first.sha256, "refused", REASON)])
        names = ["adhesion", "driving", "checks"]
        update_fleet(catalogue, names, UpdateOptions(workers=0))
    return place


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
    return report.fleet_page(catalogue, report.FleetReportOptions())


def test_trips_and_energy_are_those_of_the_tables(catalogue, page):
    trips = catalogue.query()
    by_train = table_of(page, "by_train")
    assert sum(row["trips"] for row in by_train) == len(trips) == 2
    assert sum(row["distance_m"] for row in by_train) == pytest.approx(trips["distance"].sum())
    driving = catalogue.results("driving")
    (energy,) = table_of(page, "energy_by_train")
    work, distance = (driving[name].sum() for name in ("traction", "distance"))
    assert energy["traction_J_m"] == pytest.approx(work / distance)
    assert 3.0 < 1e3 * energy["traction_J_m"] / JOULES_PER_KWH < 12.0
    (edge,) = table_of(page, "energy_by_line")
    assert edge["runs"] == len(driving)
    lost = {row["cause"]: row["a_run_s"] for row in table_of(page, "lost_time")}
    assert lost["slower"] == pytest.approx(driving["lost_slower"].mean())


def test_days_without_trips_have_no_bar():
    """A clock that starts at 1980-01-06 would give thousands of them."""
    starts = pd.to_datetime(["1980-01-06", "2026-10-01", "2026-10-01"], utc=True)
    chart = report._by_day(pd.DataFrame({"start": starts, "kind": ["a", "a", None]}))
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
    facts = report.FleetFacts(
        trips,
        FleetTrains(cast("Any", ()), UnlikeTrains(tuple(findings), (), 0.01, 1.0), (), {}),
        {name: trips.assign(state=each) for name, each in states.items()},
        pd.DataFrame({"train": trips["train"], "damage": "", "frozen": 7 * [""] + ["speed"]}),
    )
    (table,) = report.attention_parts(facts)
    nothing = replace(facts, outcomes={}, checks=pd.DataFrame())
    few = replace(nothing, trains=FleetTrains(
        cast("Any", (SimpleNamespace(kind="unit", rows=trips, compared=False),)),
        UnlikeTrains((), (), 0.01, 1.0), (), {},
    ))  # fmt: skip
    words = [str(getattr(each, "text", each)) for each in report.attention_parts(few)]
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
    named = found[["train", "what"]].to_numpy().tolist()
    assert named == [["b", "dated while the train was on another trip"]] * 2
    wrong.loc[2, ["start", "end"]] += 30 * day
    files = pd.DataFrame({"path": ["a.mcap", "b.mcap"], "what": ["refused", "copy"], "reason": ""})
    facts = report.FleetFacts(wrong, "no curve", {}, pd.DataFrame(), files)
    (table,) = report.attention_parts(facts)
    assert isinstance(table, WordTable)
    rows = {row["what"]: row for row in table.data}
    assert "1 file refused" in rows
    later = rows["dated after its log was registered"]
    assert (later["train"], later["trips"], later["since"]) == ("a", 1, "2026-10-31 07:00")
    simulated = wrong.assign(labels=[{"clock": "UTC, simulated"}] * 12)
    assert "dated after its log was registered" not in set(contradicted_dates(simulated)["what"])


@pytest.mark.usefixtures("unpainted")
def test_the_command_writes_one_page_that_asks_for_nothing(place, tmp_path, shell):
    line, network = read_line(sample(DEFAULT_LINE)), tmp_path / "one.network.json"
    nodes, edge = (Node("St.Gallen"), Node("Wil")), Edge(line.name, line, "St.Gallen", "Wil")
    write_network(Network("one", nodes, (edge,)), network)
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

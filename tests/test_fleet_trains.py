"""What a fleet knows that a trip does not: resistance per train and kind, drift, unlike trains."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import refused

from analysis.charts import draw_charts
from analysis.fleet import analyses
from analysis.fleet.analyses import ANALYSES
from analysis.fleet.plot import findings_charts
from analysis.fleet.resistance import KindResistance, TrainResistance, fleet_resistance
from analysis.fleet.trains import Drift, FleetTrains, fleet_trains, trains_in
from analysis.reports.fleet import FleetFacts, attention_parts
from analysis.resistance.logs import fit
from analysis.view import view_of
from trainlog.catalogue import ResultOutcome, open_catalogue
from trainlog.cli.options import chosen_summaries
from trainlog.cli.terminal import as_json_text
from trainlog.errors import InputError, NotIdentifiableError

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "fleet"))

from drawn_trains import Fault, drawn_fleet

pytestmark = pytest.mark.usefixtures("remembered")

SPEEDS = np.linspace(5.0, 34.0, 30)
FAULTS = {
    "dragging brake": 2000.0,
    "mass": 0.05,
    "wheel diameter": 0.01,
    "effort gain": 0.05,
    "sensor delay": 0.3,
}
SINCE = 40
KINDS = ("flirt", "virm")


@cache
def pool(*kinds: str) -> pd.DataFrame:
    """Summaries and passports of trips that were simulated, recorded and fitted."""
    rows = pd.read_parquet(Path(__file__).parent / "data" / "fleet_trips.parquet")
    return rows[rows["kind"].isin(kinds or KINDS)].reset_index(drop=True)


@pytest.mark.parametrize(("end", "share"), [(SINCE + 9, 1.0), (None, 0.5)])
def test_a_fault_that_goes_again_or_comes_on_some_trips_is_one_finding(end, share):
    faults = tuple(
        Fault(what, size, n, SINCE, end, share) for n, (what, size) in enumerate(FAULTS.items())
    )
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


# ------------------------------------------------------------------------------- resistance


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


# -------------------------------------------------------------------------- unlike trains


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
    refused(
        InputError, "known are: flirt", fleet_resistance(pool("flirt").head(40)).__getitem__, "kiss"
    )


@pytest.mark.long
def test_a_fleet_of_healthy_trains_raises_no_alarm():
    healthy = fleet_trains(drawn_fleet(pool(), 9, trains=6, trips=60))
    assert healthy.unlike.findings == ()
    assert healthy.unlike.train_months == pytest.approx(12.0, abs=1.0)


@pytest.mark.parametrize(
    ("fault", "seed", "trains", "trips", "against"),
    [
        (Fault("dragging brake", 3000.0, 0, SINCE), 2, 1, 60, "own past"),
        # One that was always unlike.
        (Fault("sensor delay", 0.9, 1, 0), 6, 9, 30, "kind"),
    ],
)
def test_a_train_is_compared_with_its_own_past_and_with_its_kind(
    fault, seed, trains, trips, against
):
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
def test_a_gross_fault_of_one_of_two_trains_does_not_hide_itself_in_the_noise(
    kind, what, size, trips, since
):
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
    checks = rows.assign(
        speed_scale=1.0 + 0.02 * (rows["start"] >= step.since), damage="", frozen=""
    )
    trips = rows.assign(end=rows["start"], added=rows["start"], labels=None)
    (table,) = attention_parts(FleetFacts(trips, "no curve", {}, checks))
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


# -------------------------------------------------------------------------------- drift


def drift(found: FleetTrains, train: str, channel: str) -> Drift:
    return next(each for each in found.drift if (each.train, each.channel) == (train, channel))


@pytest.mark.parametrize("trips", [60, pytest.param(180, marks=pytest.mark.long)])
def test_the_wear_of_wheels_and_a_season_are_found_where_the_trips_span_enough(trips):
    """Over a year, of few trips or of many."""
    rows = drawn_fleet(
        pool("flirt"), 11, trains=5, trips=trips, trips_a_day=trips / 360.0, wear=0.0, season=0.06
    )
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


# -------------------------------------------------------------------------------- catalogue


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

"""What changed between two maps or dates, and the history of a place: known answers.

The evidence is drawn with noise that the map's model does not know: heavy tails, and offsets that
all onsets of a trip share.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from scipy.special import ndtr
from simulated_line import level_line

import analysis
import trainlog
from analysis.adhesion.condition_map import empty_map
from analysis.adhesion.map_difference import detectable_ratio, q_values
from trainlog.condition import estimated
from trainlog.errors import InputError
from trainlog.railway import Station, TrackConditionMap
from trainlog.railway.condition import ConditionLayer
from trainlog.railway.evidence import DailyEvidence

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds")

DAY = 20_600
CHANGED = slice(150, 162)
"""Bins whose maximum rises by half on the day 30."""

STATIONS = Station("Aach", 0.0), Station("Mitte", 3_900.0), Station("Berg", 6_000.0)
LINE = level_line(6_000.0, limit=30.0, name="A-B", stations=STATIONS)


def a_trip(day: int, seed: int, *, change: bool) -> DailyEvidence:
    """One trip that slips in some of the bins 20 to 40, 150 to 161 and 200 to 230."""
    generator = np.random.default_rng([seed, day])
    bins, levels = 240, 59
    truth = np.log(np.full(bins, 0.12))
    truth[20:40] = np.log(0.09)
    if change and day >= DAY + 30:
        truth[CHANGED] += np.log(1.5)
    prone = np.zeros(bins, dtype=bool)
    for part in (slice(20, 40), CHANGED, slice(200, 230)):
        prone[part] = True
    slips = prone & (generator.random(bins) < 0.4)
    log = truth + generator.laplace(0.0, 0.05) + 0.05 * generator.standard_t(4, bins)
    weight = np.where(slips, 64.0, 0.0)
    used = np.zeros((bins, levels))
    used[60:120, 4] = 1.0
    return DailyEvidence.of_bins(day, slips.astype(float), weight, weight * log, used)


def a_map(days: range, seed: int = 1, *, change: bool = True) -> TrackConditionMap:
    pieces = [a_trip(DAY + day, seed, change=change) for day in days]
    wet = ConditionLayer.unestimated(DailyEvidence.total(pieces))
    trips = tuple(
        {"trip": f"{seed}-{day}", "sha256": f"{seed}-{day}", "layer": "wet"} for day in days
    )
    return replace(empty_map(LINE), layers={"wet": wet}, trips=trips)


@pytest.fixture(scope="module")
def whole() -> TrackConditionMap:
    return estimated(a_map(range(60)))


def test_a_made_up_change_is_found_and_nothing_else(whole):
    found = analysis.map_difference(whole, since=DAY + 29, line=LINE)
    assert found.changed
    inside = found.bins["bin"].between(CHANGED.start, CHANGED.stop - 1)
    assert found.bins.loc[inside, "significant"].sum() >= 10
    assert not found.bins.loc[~inside, "significant"].any()
    (section,) = found.sections.to_dict("records")
    assert section["start_m"] == pytest.approx(25.0 * CHANGED.start, abs=50.0)
    assert section["end_m"] == pytest.approx(25.0 * CHANGED.stop, abs=50.0)
    assert section["before"] == pytest.approx(0.12, abs=0.01)
    assert section["after"] == pytest.approx(0.18, abs=0.015)
    assert section["probability"] > 0.99
    assert section["near"] == "at Mitte"
    assert "1 section changed" in found.sentence


@pytest.mark.parametrize("count", [2, pytest.param(8, marks=pytest.mark.long)])
def test_where_nothing_changed_little_is_found(count):
    """At most one comparison in twenty may find anything; of eight, one at most with luck."""
    found = [
        analysis.map_difference(a_map(range(24), seed, change=False), since=DAY + 11)
        for seed in range(count)
    ]
    assert all(len(each.bins) >= 50 for each in found)
    assert sum(each.changed for each in found) <= 1
    quiet = next(each for each in found if not each.changed)
    assert quiet.data()["layers"]["wet"]["bins"] == len(quiet.bins)
    assert quiet.bins["probability"].mean() < 0.5


def test_dates_and_maps_give_the_same_answer(whole):
    """The map of the first days against the whole compares the same evidence as the dates do."""
    by_date = analysis.map_difference(whole, since=DAY + 29)
    by_map = analysis.map_difference(a_map(range(30)), whole)
    np.testing.assert_array_equal(by_map.bins["difference"], by_date.bins["difference"])
    apart = analysis.map_difference(a_map(range(30)), a_map(range(30, 60)))
    np.testing.assert_array_equal(apart.bins["q_value"], by_date.bins["q_value"])
    back = analysis.map_difference(whole, a_map(range(30)))
    np.testing.assert_allclose(back.bins["difference"], -by_date.bins["difference"], atol=1e-12)
    assert "what the second adds (30 trips)" in by_map.after
    half = analysis.map_difference(a_map(range(40)), a_map(range(20, 60)))
    assert half.notes[0].startswith("Both maps count 20 trips")
    np.testing.assert_array_equal(
        half.bins["after"], analysis.map_difference(whole, since=DAY + 39).bins["after"]
    )


def test_a_trip_under_two_rail_conditions_is_stated_and_not_subtracted():
    first, second = a_map(range(40)), a_map(range(60))
    wet = second.layer("wet").evidence
    moved = [{**each, "layer": "dry"} if each["trip"] == "1-7" else each for each in second.trips]
    parts = [wet.between(-1, DAY + 6), wet.between(DAY + 8, 10**6)]
    evidence = {"dry": a_trip(DAY + 7, 1, change=True), "wet": DailyEvidence.total(parts)}
    layers = {name: ConditionLayer.unestimated(each) for name, each in evidence.items()}
    second = replace(second, layers=layers, trips=tuple(moved))
    found = analysis.map_difference(first, second)
    assert (
        "1 trip under different rail conditions (first, second): 1-7 (wet, dry)" in found.notes[0]
    )
    # The days that only the second has are compared, as if the trip had its right place.
    right = analysis.map_difference(first, a_map(range(60)))
    np.testing.assert_allclose(found.bins["difference"], right.bins["difference"], atol=1e-12)
    other = replace(first, trips=tuple({**each, "layer": "dry"} for each in first.trips))
    with pytest.raises(InputError, match="the same trips, some under another rail condition"):
        analysis.map_difference(first, other)


def test_a_false_discovery_rate_follows_benjamini_and_hochberg():
    # Table 1 of their paper: the four least of fifteen are discoveries at 0.05.
    p = np.array([0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344,
                  0.0459, 0.3240, 0.4262, 0.5719, 0.6528, 0.7590, 1.0])  # fmt: skip
    shuffled = np.random.default_rng(0).permutation(15)
    found = q_values(p[shuffled])
    assert int((found <= 0.05).sum()) == 4
    np.testing.assert_array_equal(np.sort(shuffled[found <= 0.05]), [0, 1, 2, 3])
    assert q_values(np.zeros(0)).size == 0


def test_a_change_of_the_detectable_ratio_is_found_four_times_in_five():
    random = np.random.default_rng(3)
    log_std = random.uniform(0.05, 0.3, 60)
    ratio = detectable_ratio(log_std, 0.05)
    found = 0
    for run_number in range(1_000):
        score = random.standard_normal(60)
        changed = run_number % 60
        score[changed] += np.log(ratio[changed]) / log_std[changed]
        found += q_values(2.0 * ndtr(-np.abs(score)))[changed] <= 0.05
    assert found / 1_000 == pytest.approx(0.8, abs=0.05)


def test_what_cannot_be_compared_is_refused(whole):
    for given, message in (
        ({}, "one map is given; give a second one, or"),
        ({"since": DAY + 90}, "the second date, 2026-07-25, must be after the first, 2026-08-25"),
        ({"since": DAY - 1}, "no layer in common"),
        ({"since": DAY + 29, "layers": ["dry"]}, "has no layer 'dry'"),
        ({"since": DAY + 29, "rate": 0.0}, "rate must be between 0 and 1"),
        ({"second": whole, "since": DAY}, "two maps and dates are given"),
        ({"second": whole}, "both maps count the same trips"),
        ({"second": replace(whole, length=5_900.0)}, "the maps differ in length"),
    ):
        refused(InputError, message, analysis.map_difference, whole, **given)


def test_a_history_has_the_evidence_and_the_estimate_of_each_day(whole, monkeypatch):
    row = CHANGED.start + 5
    position = 25.0 * row + 10.0
    found = analysis.map_history(whole, position, "wet", line=LINE, days=3)
    evidence = whole.layer("wet").evidence
    assert found.onsets["events"].sum() == evidence.events[evidence.bin == row].sum()
    after = found.onsets["day"] >= np.datetime64("2026-06-26")
    assert found.onsets["adhesion"][~after].median() == pytest.approx(0.12, abs=0.012)
    assert found.onsets["adhesion"][after].median() == pytest.approx(0.18, abs=0.018)
    assert (found.onsets["low"] < found.onsets["adhesion"]).all()
    # The estimate as known on a day is that of a map of the days up to then.
    assert found.known["day"].astype(str).tolist() == ["2026-05-27", "2026-06-25", "2026-07-25"]
    assert found.thinned
    then = found.known.iloc[1]
    assert then["adhesion"] == pytest.approx(
        float(np.exp(estimated(a_map(range(30))).layer("wet").log_mean[row])), rel=1e-12
    )
    last = found.known.iloc[-1]
    assert last["adhesion"] == pytest.approx(float(np.exp(whole.layer("wet").log_mean[row])))
    assert last["low"] < last["adhesion"] < last["high"]
    assert found.unmeasured == ""
    assert found.near == "at Mitte"


def test_a_history_of_what_only_used_adhesion_has_levels_and_no_estimate(whole):
    found = analysis.map_history(whole, 2_000.0, "wet", days=2)
    assert found.onsets.empty
    assert found.used["level"].unique().tolist() == pytest.approx([whole.levels[4]])
    assert len(found.used) == 60
    assert found.known.empty
    with pytest.raises(InputError, match=r"km 11 is not on line 'A-B'; it reaches from km 0 to 6"):
        analysis.map_history(whole, 11_000.0, "wet")


@pytest.mark.usefixtures("unpainted")
def test_the_commands_draw_list_and_end_as_diff_does(tmp_path, shell, works):
    path, line = tmp_path / "wet.map", tmp_path / "A-B.line.json"
    trainlog.write_map(estimated(a_map(range(21, 41))), path)
    trainlog.write_line(LINE, line)
    words = ["map", "diff", path, "--from", "2026-06-25", "--line", line]
    status, shown, _ = shell(*words, "--picture", tmp_path / "diff.png")
    shown = " ".join(shown.split())
    assert status == 1
    assert "1 section changed" in shown
    assert "Mitte" in shown
    assert (tmp_path / "diff.png").is_file()
    status, document, _ = shell(*words, "--json")
    found = json.loads(document)
    assert status == 1
    assert found["changed"] is True
    assert [each["near"] for each in found["sections"]] == ["at Mitte"]
    assert found["sentence"] in shown
    words = ["map", "show", path, "--line", line, "--days", "2", "--km"]
    works(*words, "3.9", "--picture", tmp_path / "place.png")
    assert (tmp_path / "place.png").is_file()
    (place,) = json.loads(works(*words, "2", "--json"))["layers"]
    assert place["known"] == []
    assert len(place["used"]) == 20

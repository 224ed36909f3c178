"""Adhesion forecasts: files, known scores, propriety, reliability on drawn rails, commands."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from contents import put
from hypothesis import given, settings, strategies as st
from refusals import refused
from scipy import stats
from simulated_line import level_line

from analysis.adhesion.condition_map import LEVELS, empty_map
from analysis.verification import scores, verify as verification
from analysis.verification.forecasts import forecast_of, stated_forecast
from analysis.verification.scoring import Score, score_rolling
from trainlog import InputError, TrackConditionMap, read_forecast, read_map, sample, write_forecast
from trainlog.arrays import FloatArray
from trainlog.cli.main import run
from trainlog.cli.terminal import as_json_text
from trainlog.condition import estimated
from trainlog.formats.mapfile import write_map
from trainlog.formats.samples import copy_samples
from trainlog.railway.condition import AdhesionEstimate, ConditionLayer
from trainlog.railway.evidence import DailyEvidence

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds", "unpainted")

BINS = 200
TRACK = empty_map(level_line(25.0 * BINS))
FIRST = 20_000


def normal(mean: FloatArray | float, std: FloatArray | float, bins: int = BINS) -> AdhesionEstimate:
    values = (np.broadcast_to(np.asarray(x, dtype=np.float64), (bins,)) for x in (mean, std))
    return AdhesionEstimate(*values, np.ones(bins, dtype=np.bool_))


@settings(max_examples=40)
@given(st.floats(0.05, 0.4), st.floats(0.05, 0.5), st.floats(0.05, 0.4))
def test_scores_of_a_normal_forecast_are_those_of_the_textbook(median, std, met):
    forecast, z = normal(np.log(median), std, 1), (np.log(met) - np.log(median)) / std
    if abs(z) < 2.5:
        known = stats.norm.logpdf(np.log(met), np.log(median), std)
        assert scores.onset_score(forecast, [met])[0] == pytest.approx(known, abs=0.03)
        assert scores.used_score(forecast, [met])[0] == pytest.approx(stats.norm.logsf(z), abs=0.03)
    # Gneiting and Raftery (2007), eq. (21) and below.
    textbook = z * (2.0 * stats.norm.cdf(z) - 1.0) + 2.0 * stats.norm.pdf(z) - 1.0 / np.sqrt(np.pi)
    assert scores.crps(forecast, [met])[0] == pytest.approx(std * textbook, abs=2e-3)


@settings(max_examples=40)
@given(
    st.lists(
        st.tuples(st.floats(0.0, 1.0), st.integers(0, 5), st.integers(0, 5)),
        min_size=1,
        max_size=30,
    ).filter(lambda rows: any(row[1] + row[2] for row in rows))
)
def test_the_brier_score_is_its_parts_together(rows):
    chance = np.array([row[0] for row in rows])
    slips, others = (np.array([row[i] for row in rows], dtype=np.float64) for i in (1, 2))
    found = scores.brier_score(scores.brier_sums(chance, slips + others, slips))
    direct = np.sum(slips * (1.0 - chance) ** 2 + others * chance**2) / np.sum(slips + others)
    assert found.score == pytest.approx(direct, abs=1e-12)
    parts = found.reliability - found.resolution + found.uncertainty + found.within
    assert parts == pytest.approx(direct, abs=1e-12)


def test_censored_values_do_not_bend_the_observed_shares():
    generator = np.random.default_rng(3)
    value, limit = generator.uniform(size=40_000), generator.beta(1.0, 2.0, 40_000)
    shown = value < limit
    sums = scores.pit_sums(value[shown], np.ones(shown.sum()), True)
    sums += scores.pit_sums(limit[~shown], np.ones((~shown).sum()), False)
    share, trips = scores.observed_shares(sums)
    np.testing.assert_allclose(share[[20, 100, 160]], [0.1, 0.5, 0.8], atol=0.02)
    # The share of those measured alone is far off: slip shows low maxima only.
    assert np.mean(value[shown] < 0.5) > 0.75
    assert trips[0] == 40_000
    assert np.all(np.diff(trips) <= 0.0)


def evidence(day: int, met: dict[int, float], used: dict[int, int]) -> DailyEvidence:
    weight, log, levels = np.zeros(BINS), np.zeros(BINS), np.zeros((BINS, LEVELS.size))
    for place, value in met.items():
        weight[place], log[place] = 64.0, 64.0 * np.log(value)
    for place, level in used.items():
        levels[place, level] = 1.0
    return DailyEvidence.of_bins(day, weight > 0, weight, log, levels)


def test_demand_leaves_out_the_day_and_spreads_what_slipped_over_higher_demands():
    days = [
        evidence(1, {}, {0: 4, 1: 10}),
        evidence(2, {}, {0: 6, 1: 10}),
        evidence(3, {0: 0.075}, {1: 4}),  # slips at level 5: it asked for more
    ]
    demand = verification.Demand(days, LEVELS)
    shares = demand.without(1, np.array([0, 1, 2]))
    assert shares[0, 6] == pytest.approx(0.5 + 0.5 * 0.5)
    assert shares[0, 10] == pytest.approx(0.5 * 0.5)
    assert shares[1, [4, 10]].tolist() == [0.5, 0.5]
    assert np.all(np.isnan(shares[2]))
    # Whether a trip slips on a day does not change the demand by which it is scored.
    changed = verification.Demand([evidence(1, {0: 0.05, 1: 0.05}, {}), *days[1:]], LEVELS)
    np.testing.assert_array_equal(shares, changed.without(1, np.array([0, 1, 2])))


@dataclass(frozen=True, eq=False)
class Drawn:
    """Days on a rail that is drawn anew each day about a level that only one forecaster knows."""

    days: list[verification.Passages]
    demand: verification.Demand
    knows: verification.Forecaster
    level: FloatArray


def shape() -> tuple[FloatArray, FloatArray]:
    """A skewed distribution of the day's deviation: what forecasts of a normal are not."""
    grid = np.linspace(-0.8, 0.8, 641)
    density = stats.gumbel_l.pdf(grid, 0.05, 0.09) + 0.15 * stats.norm.pdf(grid, -0.3, 0.06)
    return grid, density / density.sum()


@cache
def drawn(seed: int, days: int = 30) -> Drawn:
    generator = np.random.default_rng(seed)
    level = np.log(generator.uniform(0.06, 0.2, BINS))
    grid, probability = shape()
    asks = generator.uniform(0.05, 0.2, BINS)
    found = []
    for day in range(FIRST, FIRST + days):
        step = grid[1] - grid[0]
        deviation = generator.choice(grid, BINS, p=probability)
        met = np.exp(level + deviation + step * generator.uniform(-0.5, 0.5, BINS))
        asked = asks * generator.uniform(0.6, 1.4, BINS)
        slipped, held = np.flatnonzero(met < asked), np.flatnonzero(met >= asked)
        used = np.searchsorted(LEVELS, asked[held], side="right") - 1
        low = dict(zip(slipped.tolist(), met[slipped].tolist(), strict=True))
        borne = {int(i): int(k) for i, k in zip(held, used, strict=True) if k >= 0}
        found.append(evidence(day, low, borne))
    log_levels = np.linspace(-4.5, 0.0, 451)
    table = np.array([np.interp(log_levels - each, grid, probability) for each in level])
    table /= table.sum(axis=1, keepdims=True)
    mean = table @ log_levels
    std = np.sqrt(table @ log_levels**2 - mean**2)
    true = AdhesionEstimate(mean, std, np.ones(BINS, dtype=np.bool_), log_levels, table)
    passages = [day for each in found for day in verification.passages_of("wet", each)]
    return Drawn(passages, verification.Demand(found, LEVELS), lambda layer, time: true, level)


@cache
def scored(rail: Drawn, forecaster: verification.Forecaster) -> verification.Verification:
    given = forecaster, lambda layer, day: DailyEvidence.none(BINS, LEVELS.size), rail.demand
    return verification.verify("drawn", TRACK, rail.days, *given)["wet"]


def others(rail: Drawn) -> dict[str, verification.Forecaster]:
    """Forecasters that do not know the rail: too high, too low, too sure, too wide, ignorant."""
    true = rail.knows("wet", pd.Timestamp(0, tz="UTC"))
    made = {
        "too high": normal(true.log_mean + 0.15, true.log_std),
        "too low": normal(true.log_mean - 0.15, true.log_std),
        "too sure": normal(true.log_mean, 0.4 * true.log_std),
        "too wide": normal(true.log_mean, 3.0 * true.log_std),
        "the mean of the line": normal(np.mean(true.log_mean), 0.35),
    }
    return {name: lambda layer, time, each=each: each for name, each in made.items()}


def test_a_forecaster_that_knows_the_rail_beats_those_that_do_not():
    rail = drawn(2)
    best = scored(rail, rail.knows)
    assert best.log_score("onsets", over="prior").low > 0.5
    assert best.brier_gain("prior").low > 0.1
    for name, forecaster in others(rail).items():
        worse = scored(rail, forecaster)
        assert best.log_score("all").value > worse.log_score("all").value + 0.005, name
        # Whether a trip slips hangs on what it asks for, too: how sure a forecast is hardly shows.
        margin = 5e-4 if name == "too sure" else 0.0
        assert best.brier_figure("score").value < worse.brier_figure("score").value + margin, name


@pytest.mark.parametrize("seed", [pytest.param(1, marks=pytest.mark.long), 2])
def test_calibrated_forecasts_are_reliable_and_others_are_not(seed):
    rail = drawn(seed)
    best = scored(rail, rail.knows)
    # An onset within a level of what another trip used without slip may be counted before it.
    for quantile, share, trips in best.reliability((0.05, 0.1, 0.25, 0.5, 0.75, 0.9)):
        assert trips > 100
        assert share.low - 0.02 <= quantile <= share.high + 0.02
    assert best.coverage.low - 0.01 <= 0.95 <= best.coverage.high + 0.01
    for forecast, share, trips, slips in best.classes():
        if trips > 200:
            assert abs(forecast - share) < 4.0 * np.sqrt(slips + 1.0) / trips + 0.03
    sure = scored(rail, others(rail)["too sure"])
    assert sure.coverage.high < 0.85
    high = scored(rail, others(rail)["too high"])
    assert {q: share for q, share, _ in high.reliability()}[0.25].low > 0.35
    assert high.brier_figure("reliability").low > best.brier_figure("reliability").value


def test_the_probability_of_slip_is_that_of_asking_for_more_than_there_is():
    generator = np.random.default_rng(1)
    forecast = normal(np.log(0.1), 0.2, 1)
    share = np.zeros((1, LEVELS.size))
    share[0, [6, 10]] = 0.5
    asked = verification.asked_adhesion(LEVELS)
    met = np.exp(np.log(0.1) + 0.2 * generator.standard_normal(200_000))
    counted = np.mean(met < generator.choice(asked[[6, 10]], met.size))
    found = verification.slip_probability(forecast, share, asked)[0]
    assert found == pytest.approx(counted, abs=0.005)


def test_what_a_forecast_does_not_know_is_counted_apart_and_never_scored():
    rail = drawn(1)
    true = rail.knows("wet", pd.Timestamp(0, tz="UTC"))
    half = np.arange(BINS) < BINS // 2
    part = AdhesionEstimate(true.log_mean, true.log_std, half, true.log_levels, true.probability)
    whole, some = scored(rail, rail.knows), scored(rail, lambda layer, time: part)
    silent = scored(rail, lambda layer, time: None)
    assert whole.unknown_onsets == whole.unknown_used == 0
    assert some.onsets + some.unknown_onsets == whole.onsets == silent.unknown_onsets
    assert some.used + some.unknown_used == whole.used == silent.unknown_used
    assert np.isnan(silent.log_score("onsets").value)
    # Slips where nothing was forecast were not foreseen.
    assert silent.alarm().foreseen.value == 0.0
    assert some.alarm().foreseen.value < whole.alarm().foreseen.value
    # Of the slips where it was known as many were foreseen as before.
    assert some.alarm().foreseen_known.value == pytest.approx(whole.alarm().foreseen.value, abs=0.1)


def test_bands_need_some_days_and_hold_the_figure():
    rail = drawn(3)
    found = scored(rail, rail.knows).log_score("onsets")
    assert found.low < found.value < found.high
    few = Drawn(rail.days[:3], rail.demand, rail.knows, rail.level)
    assert np.isnan(scored(few, rail.knows).log_score("onsets").low)
    with pytest.raises(InputError, match="no trip to compare it with"):
        scored(Drawn([], rail.demand, rail.knows, rail.level), rail.knows)


HEADER = "line,layer,from [km],to [km],valid from,valid to,issued,quantile 0.05,quantile 0.5"
ROW = "CH_StGallen_Wil,wet,1,2,2026-11-22T00:00Z,2026-11-23T00:00Z,2026-11-21T18:00Z,0.08,0.12"
NOON = pd.Timestamp("2026-11-22T12:00Z")


@pytest.fixture(scope="module")
def track() -> TrackConditionMap:
    return read_map(sample("CH_StGallen_Wil.map"))


def written(folder: Path, *rows: str, header: str = HEADER) -> Path:
    return put(folder / "forecast.csv", (header, *rows))


def test_a_row_is_a_distribution_through_its_points(tmp_path, track):
    found = stated_forecast(read_forecast(written(tmp_path, ROW)), track)("wet", NOON)
    assert np.flatnonzero(found.observed).tolist() == list(range(40, 80))
    here = found.at_bins([50])
    assert here.below(0.08)[0] == pytest.approx(0.05, abs=0.01)
    assert here.below(0.12)[0] == pytest.approx(0.5, abs=0.03)
    # Beyond its points it is shaped as the climatology is.
    usual = scores.climatology(track, "wet").at_bins([50])
    upper = (here.below(0.2)[0] - 0.5) / 0.5
    expected = (usual.below(0.2)[0] - usual.below(0.12)[0]) / (1.0 - usual.below(0.12)[0])
    assert upper == pytest.approx(expected, abs=0.05)


def test_a_row_holds_in_its_time_and_rail_condition_and_the_last_issued_counts(tmp_path, track):
    later = ROW.replace("2026-11-21T18:00Z", "2026-11-21T23:00Z").replace("0.12", "0.16")
    anyone = ROW.replace(",wet,", ",,").replace(",1,2,", ",0,5,").replace("0.12", "0.3")
    forecaster = stated_forecast(read_forecast(written(tmp_path, ROW, later, anyone)), track)
    found = forecaster("wet", NOON)
    assert found.below(0.16)[50] == pytest.approx(0.5, abs=0.03)
    assert found.below(0.3)[10] == pytest.approx(0.5, abs=0.03)
    dry = forecaster("dry", NOON)
    assert dry.below(0.3)[50] == pytest.approx(0.5, abs=0.03)
    assert forecaster("wet", pd.Timestamp("2026-11-23T00:00Z")) is None
    assert forecaster("wet", pd.Timestamp("2026-11-21T23:59Z")) is None


BAD = [
    (HEADER, ROW.replace("0.08", "0"), "line 2", "an adhesion above 0"),
    (HEADER, ROW.replace("0.08", "0.2"), "line 2", "must grow with the adhesion"),
    (HEADER, ROW.replace("2026-11-23T00:00Z", "2026-11-21T00:00Z"), "line 2", "correct the times"),
    (HEADER, ROW.replace("2026-11-23T00:00Z", "tomorrow"), "line 2", "'tomorrow' is not a time"),
    (HEADER, ROW.replace("2026-11-21T18", "2026-11-22T18"), "line 2", "issued after"),
    (HEADER, ROW.replace("CH_StGallen_Wil", ""), "line 2", "has no line"),
    (HEADER, f"{ROW}\n{ROW.replace('CH_StGallen_Wil', 'A-B')}", "is for 2 lines", "a file a line"),
    (HEADER, f"{ROW},0.4", "line 2", "10 cells"),
    (HEADER.replace("[km]", ""), ROW, "line 1", "has no unit"),
    (HEADER.replace("from [km]", "from [mile]"), ROW, "line 1", "in neither of km, m"),
    (HEADER.replace("valid to", "until"), ROW, "line 1", "'until' is not known"),
    (HEADER.replace("issued", "valid from"), ROW, "line 1", "are both of the valid from"),
    (HEADER.replace("0.5", "50"), ROW, "line 1", "must be between 0 and 1"),
    (HEADER, "", "has no row", "add one"),
    ("line,from [km],to [km],valid from,valid to", "A,0,1,2026-11-22,2026-11-23", "line 1", "nei"),
]


@pytest.mark.parametrize(("header", "row", "place", "words"), BAD)
def test_bad_rows_are_named(tmp_path, header, row, place, words):
    path = written(tmp_path, row, header=header)
    caught = refused(InputError, "", read_forecast, path)
    for each in (str(path), place, words):
        assert each in str(caught)


def test_all_that_is_wrong_is_listed_at_once(tmp_path):
    wrong = ROW.replace("0.08,0.12", "8,low").replace(",wet,", ",wett,").replace(",1,2,", ",2,1,")
    foo = ROW.replace("CH_StGallen_Wil", "Foo")
    path = written(tmp_path, wrong, foo, ROW.replace(",1,2,", ",1,99,"))
    caught = refused(InputError, "", read_forecast, path, "CH_StGallen_Wil", 29_525.0)
    listed = [(each.place, str(each)) for each in caught.each]
    places = ["line 2, column 'layer'", "line 2", "line 2, column 'quantile 0.05'"]
    places += ["line 2, column 'quantile 0.5'", "line 3", "line 4"]
    assert [place for place, _ in listed] == places
    said = ("did you mean 'wet'?", "must end behind its beginning", "not in per cent")
    said += ("'low' is not a number", "is for line 'Foo'", "reaches km 99.000")
    assert all(each in words for each, (_, words) in zip(said, listed, strict=True))
    refused(InputError, r"5 problems: .*is for 2 lines: CH_StGallen_Wil, Foo", read_forecast, path)


def test_a_forecast_for_another_line_and_two_of_one_place_and_time_are_refused(tmp_path, track):
    both = read_forecast(written(tmp_path, ROW, ROW.replace(",1,2,", ",1.5,3,")))
    said = r"line 3 and forecast.csv, line 2 both hold .* km 1\.500"
    refused(InputError, said, stated_forecast(both, track), "wet", NOON)
    other = read_forecast(written(tmp_path, ROW.replace("CH_StGallen_Wil", "A-B")))
    said = "is for line 'A-B', the trips ran on 'CH_StGallen_Wil'"
    refused(InputError, said, stated_forecast, other, track)
    beyond = read_forecast(written(tmp_path, ROW.replace(",1,2,", ",1,99,")))
    said = r"reaches km 99\.000, the line ends at km 29"
    refused(InputError, said, stated_forecast, beyond, track)


def test_what_a_map_expects_survives_the_file(tmp_path, track):
    path = tmp_path / "forecast.csv"
    write_forecast(forecast_of(track, NOON, hours=6.0), path)
    read = stated_forecast(read_forecast(path), track)
    for layer in track.layers:
        own, found = track.layer(layer).expected(NOON), read(layer, NOON)
        np.testing.assert_array_equal(found.observed, own.observed)
        seen = np.flatnonzero(own.observed)
        for adhesion in (0.06, 0.1, 0.15, 0.3):
            # Between two quantiles that are written, a twentieth apart or a tenth.
            np.testing.assert_allclose(
                found.at_bins(seen).below(adhesion), own.at_bins(seen).below(adhesion), atol=0.05
            )
    assert read("wet", NOON + pd.Timedelta(hours=6)) is None
    refused(InputError, "hours above 0", forecast_of, track, NOON, hours=0.0)


FORECAST = """line,layer,from [km],to [km],valid from,valid to,issued,quantile 0.05,quantile 0.5
CH_StGallen_Wil,,0,15,2024-10-07,2024-10-08,2024-10-06T18:00Z,0.08,0.2
CH_StGallen_Wil,,15,29,2024-10-07,2024-10-08,2024-10-06T18:00Z,0.1,0.25
"""


@cache
def month() -> TrackConditionMap:
    """Twelve days on a line with a place that always slips, and one that slips for three days."""
    days = []
    generator = np.random.default_rng(1)
    for day in range(12):
        met = {i: 0.08 * float(np.exp(0.05 * generator.standard_normal())) for i in range(20, 26)}
        if 5 <= day < 8:
            met |= dict.fromkeys(range(100, 104), 0.06)
        used = {i: 8 for i in range(10, BINS - 10) if i not in met}
        days.append(evidence(FIRST + day, met, used))
    layer = ConditionLayer.unestimated(DailyEvidence.total(days))
    return estimated(replace(TRACK, layers={"wet": layer}))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("score")
    copy_samples(made)
    write_map(month(), made / "month.map")
    (made / "stated.csv").write_text(FORECAST)
    known = read_map(next(made.glob("CH_StGallen_Wil.map*")))
    layers = {}
    for name, layer in known.layers.items():
        one = layer.evidence
        earlier = replace(one, day=one.day - 3, used_day=one.used_day - 3)
        layers[name] = ConditionLayer.unestimated(earlier)
    write_map(estimated(replace(known, layers=layers, trips=())), made / "earlier.map")
    return made


@pytest.fixture
def stated(works: Callable[..., str]) -> Callable[..., dict[str, Any]]:
    return lambda *words: json.loads(works("map", "score", *words, "--json"))


@cache
def first_days() -> TrackConditionMap:
    """The month up to its seventh day, not estimated."""
    known = month().layer("wet").evidence.between(0, FIRST + 6)
    return replace(month(), layers={"wet": ConditionLayer.unestimated(known)})


@pytest.fixture(scope="module")
def first_scored() -> Score:
    return score_rolling(first_days())


def test_each_day_is_forecast_from_the_days_before_alone(first_scored):
    days: list[tuple[int, int]] = []  # which are reported meanwhile
    long = score_rolling(month(), None, lambda *each: days.append(each)).layers["wet"]
    assert list(dict.fromkeys(days)) == [(day, 11) for day in range(1, 12)]
    short = first_scored.layers["wet"]
    # What came later does not change how a day was forecast; only the demand uses all days.
    np.testing.assert_allclose(long.scores[: short.days.size, 0], short.scores[:, 0])
    assert long.days[0] == FIRST + 1
    # The spot of three days was not foreseen on its first day.
    spot, steady = (np.flatnonzero(long.days == FIRST + day)[0] for day in (5, 4))
    assert long.alarms[spot, 0, 4] < long.slips[spot]
    assert long.alarms[steady, 0, 4] == long.slips[steady] == 6.0
    # Nor does persistence know it before its second day.
    persistence = long.scores[:, 2, 0]
    assert persistence[spot] < 0.0 < persistence[[steady, spot + 1]].min()


def test_a_map_is_scored_day_by_day(folder, first_scored, stated):
    picture = folder / "score.png"
    write_map(estimated(first_days()), folder / "first.map")
    found = stated(folder / "first.map", "--rolling", "--picture", picture)
    assert picture.exists()
    wet = found["layers"]["wet"]
    assert wet["days"] == first_scored.layers["wet"].days.size == 6
    assert wet["log_score_onsets_gain_over_prior_low"] > 0.0
    common = {"command": "map score", "status": 0, "written": [str(picture)]}
    assert json.loads(as_json_text(first_scored.data())) | common == found


def test_the_forecast_of_anyone_is_scored(folder, stated):
    path = folder / "forecast.csv"
    path.write_text(FORECAST)
    found = stated(path, folder / "stopping.mcap", folder / "nonstop.mcap")
    whole = found["layers"]["all"]
    assert whole["onsets"] > 0
    # Beyond km 29 nothing is forecast, and on another day nothing at all.
    assert whole["unknown_used"] > 0
    path.write_text(
        FORECAST.replace("2024-10-08", "2024-10-09").replace("2024-10-07", "2024-10-08")
    )
    silent = stated(path, folder / "stopping.mcap")["layers"]["all"]
    assert silent["onsets"] == 0
    assert silent["log_score_onsets"] is None
    assert (silent["days"], silent["days_known"], silent["train_km_known"]) == (1, 0, 0.0)
    outside = "1 of 1 day (1 of 1 trip) lie outside the forecast's validity, 2024-10-08T00:00Z to"
    words = stated(path, folder / "stopping.mcap", "--picture", folder / "silent.png")
    assert words["notes"][0].startswith(outside)
    path.write_text(FORECAST.replace("CH_StGallen_Wil", "Foo").replace(",15,29,", ",15,99,"))
    said = r"2 problems: .*line 2: .*'Foo'.*line 3: .*'Foo'"
    refused(InputError, said, run, ["map", "score", str(path), str(folder / "stopping.mcap")])


def test_a_rail_condition_that_the_forecast_lacks_is_refused_and_another_than_the_logs_stated(
    folder, stated
):
    known, log, path = folder / "earlier.map", folder / "stopping.mcap", folder / "wet.csv"
    path.write_text(FORECAST.replace(",,", ",wet,"))
    for forecast, layer, words in (
        (known, "snow", r"has no layer 'snow'; layers present: .*wet"),
        (path, "snow", r"no row for rail condition 'snow'; rail conditions present: wet"),
        (path, "wett", r"did you mean 'wet'\?"),
    ):
        refused(InputError, words, run, ["map", "score", str(forecast), str(log), "--layer", layer])
    path.write_text(FORECAST)
    found = stated(path, log, "--layer", "leaves")
    assert found["notes"][0] == (
        "trip 'trip-03': scored in 'leaves' as given; the log states 'wet'"
    )
    path.write_text(FORECAST.replace(",,", ",dry,"))
    notes = stated(path, log)["notes"]
    assert notes[0] == "no forecast for rail condition 'wet': there all is unknown"


def test_a_maps_forecast_in_a_file_scores_as_the_map(folder, stated, works):
    path, known = folder / "own.csv", folder / "earlier.map"
    works("map", "forecast", known, "--at", "2024-10-07", "--hours", "24", "-o", path)
    by_map = stated(known, folder / "stopping.mcap")
    assert by_map["notes"][0].startswith("1 day: too few for bands")
    own = by_map["layers"]["all"]
    file = stated(path, folder / "stopping.mcap")["layers"]["all"]
    assert file["onsets"] == own["onsets"]
    assert file["used"] == own["used"]
    for what in ("onsets", "used"):
        one, other = (each[f"log_score_{what}"] for each in (own, file))
        assert one == pytest.approx(other, abs=0.1)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("month.map", "--rolling", "--weather", "stopping.mcap"), "leave out --weather"),
        (("month.map",), "nothing to compare the forecast with"),
        (("month.map", "stopping.mcap", "--rolling"), "scores a map on its own days"),
        (("stated.csv", "--rolling"), "scores a map on its own days"),
        (("month.map", "--rolling", "--layer", "dry"), "no layer 'dry'"),
        (("month.map", "stopping.mcap"), "no trip|is of line"),
    ],
)
def test_what_cannot_be_scored_is_refused(folder, words, problem):
    names = [str(folder / word) if "." in word else word for word in words]
    refused(InputError, problem, run, ["map", "score", *names])

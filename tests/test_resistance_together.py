"""Many trips: the common curve, how trips differ, the observed set, files, pictures."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from resistance_trips import RESISTANCE, constant_speed, trip

from analysis import TripRefusedError, combine, fit, fit_trip, parameter_set
from analysis.charts import draw, draw_all, draw_charts
from analysis.fleet.resistance import fleet_resistance
from analysis.resistance import TripFit, summarised
from analysis.resistance.curve import nearest_physical
from analysis.resistance.logs import AllRefusedError
from analysis.resistance.observed import choose
from analysis.resistance.plot import refused_chart, trips_charts
from estimators.mixed import mixed_effects
from trainlog.arrays import FloatArray
from trainlog.errors import InputError, LogError, NotIdentifiableError
from trainlog.formats.declared import thing_from_bytes, thing_to_bytes
from trainlog.formats.railway import read_parameters, write_parameters
from trainlog.formats.samples import sample
from trainlog.formats.summaries import (
    COLUMNS,
    covariances_of,
    merged,
    parameters_of,
    read_summaries,
    write_summaries,
)
from trainlog.mcap import write_log
from trainlog.railway import Passport, Quantity, RunningResistance
from trainlog.railway.resistance import basis
from trainlog.railway.train import ParameterSet

SPEED = np.linspace(5.0, 35.0, 61)
TRUE = np.array(RESISTANCE.coefficients)
NODES = basis(np.linspace(5.0, 35.0, 3))


@cache
def whole_fit() -> TripFit:
    return fit_trip(trip(noise=0.03))


def fit_of(
    name: str, beta: FloatArray, covariance: FloatArray, train: str = "unit", **changes: Any
) -> TripFit:
    """A fit of made-up coefficients."""
    full = np.zeros((4, 4))
    full[:3, :3], full[3, 3] = covariance, 200.0**2
    known = {"mass": 130e3, "freedom": 90, "asked": (5.0, 35.0), "speed_range": (3.0, 34.0)}
    known |= {"noise": {"speed": 0.01}, "windows": {"used": 94, "outlier": 0}, "max_power": None}
    known |= {"survey": np.zeros((4, 4)), "masked": {"braking": 10.0}, "gradients": ""}
    known |= {"passport": None, "identity": ""}
    curve = RunningResistance(*beta.tolist())
    about = {"trip": name, "train": train, "resistance": curve, "covariance": full}
    return replace(whole_fit(), **known | about | changes)


def covariance_of(curve_std: tuple[float, float, float]) -> FloatArray:
    """Covariance of r0, r1, r2 from independent errors [N] of the curve at three speeds."""
    back = np.linalg.inv(NODES)
    return np.asarray(back @ np.diag(np.square(curve_std)) @ back.T)


def drawn(
    count: int, spread: float, curve_std: tuple[float, float, float], seed: int
) -> tuple[list[TripFit], FloatArray]:
    """Fits of trips whose curves differ by `spread`, and their true coefficients."""
    generator = np.random.default_rng(seed)
    covariance = covariance_of(curve_std)
    root = np.linalg.cholesky(covariance)
    true = TRUE * (1.0 + spread * generator.standard_normal((count, 3)))
    fits = [
        fit_of(f"trip-{k:03d}", true[k] + root @ generator.standard_normal(3), covariance)
        for k in range(count)
    ]
    return fits, true


@settings(max_examples=8)
@given(order=st.permutations(range(6)))
def test_order_does_not_matter(order):
    fits, _ = drawn(6, 0.05, (150.0, 60.0, 100.0), seed=1)
    one, other = combine(fits), combine([fits[k] for k in order])
    assert one.resistance == other.resistance
    assert one.trips == other.trips
    np.testing.assert_array_equal(one.covariance, other.covariance)
    np.testing.assert_array_equal(one.betas, other.betas)


def test_band_of_the_common_curve_covers():
    inside = []
    for seed in range(15):
        fits, _ = drawn(12, 0.06, (200.0, 80.0, 200.0), seed)
        low, high = combine(fits).band(SPEED)
        inside.append(np.all((low < RESISTANCE(SPEED)) & (RESISTANCE(SPEED) < high)))
    assert np.mean(inside) >= 0.92


@settings(max_examples=50)
@given(r0=st.floats(-3000.0, 5000.0), r1=st.floats(-300.0, 300.0), r2=st.floats(1.0, 30.0))
def test_nearest_physical_resistance(r0, r1, r2):
    covariance = covariance_of((300.0, 50.0, 100.0))
    beta = np.array([r0, r1, r2])
    nearest = np.array(nearest_physical(beta, covariance).coefficients)
    assert np.all(nearest >= 0.0)
    if np.all(beta >= 0.0):
        np.testing.assert_allclose(nearest, beta, rtol=1e-6, atol=1e-6)
        return
    weight = np.linalg.inv(covariance)
    distance = (nearest - beta) @ weight @ (nearest - beta)
    for other in np.abs(np.random.default_rng(1).standard_normal((200, 3))) * np.abs(beta):
        assert distance <= (other - beta) @ weight @ (other - beta) * (1.0 + 1e-9)


def test_what_cannot_be_combined_is_refused():
    covariance = covariance_of((50.0, 50.0, 50.0))
    one = fit_of("a", TRUE, covariance)
    other = fit_of("b", TRUE, covariance, train="other")
    refused(NotIdentifiableError, "no trip", combine, [])
    refused(InputError, "given twice", combine, [one, one])
    refused(InputError, "different trains: other, unit", combine, [one, other])


@pytest.mark.usefixtures("unpainted")
def test_logs_to_parameters_and_pictures(tmp_path):
    trips = [trip(name=f"made-{k}", noise=0.03, seed=k) for k in range(3)]
    trips.append(trip(constant_speed, name="dull", noise=0.03))
    logs = [tmp_path / f"{one.name}.mcap" for one in trips]
    for one, path in zip(trips, logs, strict=True):
        write_log(one, path)
    fits = fit(logs)
    assert [one.trip for one in fits.trips] == ["made-0", "made-1", "made-2"]
    assert list(fits.refused) == ["dull"]
    assert fits.refused["dull"].reason == "condition"
    assert "vary too little" in str(fits.refused["dull"])
    assert all(len(detail["sha256"]) == 64 for detail in fits.parameters.details)
    assert set(fits.parameters.provenance["inputs"]) == {one.name for one in trips}
    off = fits.common.resistance(SPEED) / RESISTANCE(SPEED) - 1.0
    assert np.sqrt(np.mean(off**2)) < 0.02
    write_parameters(fits.parameters, tmp_path / "parameters.json")
    back = read_parameters(tmp_path / "parameters.json")
    assert back.configurations == fits.parameters.configurations
    assert back.details == fits.parameters.details
    draw(fits, tmp_path / "fits.png")
    blind = TripRefusedError("not recorded", "nothing")
    dull = fits.refused["dull"]
    for name, refusal in (("dull", dull), ("blind", blind)):
        draw_charts(refused_chart("dull", refusal), tmp_path / f"{name}.png")
    assert all((tmp_path / f"{name}.png").is_file() for name in ("fits", "dull", "blind"))


def test_logs_that_say_nothing_are_refused_together(tmp_path):
    write_log(trip(constant_speed, name="dull", noise=0.03), tmp_path / "dull.mcap")
    with pytest.raises(AllRefusedError, match=r"no trip determines .* vary too little") as stated:
        fit([tmp_path / "dull.mcap"])
    pictures = trips_charts((), stated.value.refused)
    assert draw_all(pictures, tmp_path) == [tmp_path / "dull.png"]
    refused(NotIdentifiableError, r"^no log was given; give logs, folders of logs, or", fit, [])


def test_an_assumed_gain_of_the_efforts_does_not_average_out():
    """All trips of one recorder err alike; what each weighed load shows errs anew."""
    fits, _ = drawn(12, 0.02, (60.0, 60.0, 60.0), seed=4)
    unknown = Quantity(np.nan, np.nan, "assumed")
    found = {}
    for source in ("assumed", "estimated"):
        gain = Quantity(1.0, 0.05, source)
        passport = Passport("made", unknown, gain, *4 * [unknown])
        beta = [np.append(fit.beta, fit.mass) for fit in fits]
        added = [0.05**2 * np.outer(each, each) for each in beta]
        widened = [
            replace(fit, passport=passport, covariance=fit.covariance + more)
            for fit, more in zip(fits, added, strict=True)
        ]
        found[source] = combine(widened)
    speed = 20.0
    share = {source: float(one.std(speed) / one.resistance(speed)) for source, one in found.items()}
    assert 0.05 < share["assumed"] < 0.06
    assert share["estimated"] < 0.03
    # Trips do not differ by what they have in common.
    assert found["assumed"].spread(speed) < 1.5 * combine(fits).spread(speed)


def test_trips_on_different_routes_share_the_errors_of_their_edges():
    """Of an edge that all ran over for half of their way half of the errors do not average out."""
    survey = np.zeros((4, 4))
    survey[:3, :3] = covariance_of((200.0, 200.0, 200.0))
    apart = [f'{{"edge {number}": 1.0}}' for number in range(20)]
    half = [f'{{"common": 0.5, "edge {number}": 0.5}}' for number in range(20)]
    whole = ["a digest"] * 20
    variances = []
    for every in (apart, half, whole):
        fits = [
            fit_of(f"{n}", TRUE, covariance_of((300.0, 300.0, 300.0)), survey=survey, gradients=key)
            for n, key in enumerate(every)
        ]
        variances.append(float(combine(fits).std(20.0)) ** 2)
    independent, shared, same = variances
    assert independent < shared < same
    assert shared - independent == pytest.approx(0.5 * (same - independent), rel=0.05)


def test_options_that_state_nothing_are_refused():
    cases: dict[tuple[str, str], tuple[Any, ...]] = {
        ("cover", "must be a fraction above 0 and below 1"): (95.0, 1.0, "95 %"),
        ("most", "must be a whole number .* 1 or more"): (0, 2.5),
        ("speeds", "must be a lowest and a higher, .* in m/s"): ((30.0, 10.0), (5.0, np.nan), 5.0),
        ("speeds", "give the speeds in m/s, not in km/h"): ((40.0, 120.0),),
    }
    for (name, words), values in cases.items():
        for value in values:
            refused(InputError, words, fit, sample("nonstop.mcap"), **{name: value})


def test_logs_that_cannot_be_fitted_are_refused():
    made = trip()
    refused(LogError, "has no line", fit_trip, replace(made, attachments={}))
    state = made["/train/state"]
    backwards = state.iloc[np.r_[0:100, 50 : len(state)]]
    refused(LogError, "time does not increase", fit_trip, made.with_topic(backwards))


DIRECTIONS = np.random.default_rng(99).standard_normal((400, 4))


def features(count: int, seed: int) -> FloatArray:
    """Trips that differ by some per cent in four correlated features."""
    generator = np.random.default_rng(seed)
    mixing = np.array([[1.0, 0.8, 0.0, 0.0], [0.0, 1.0, 0.5, 0.0], [0, 0, 1.0, 0.3], [0, 0, 0, 1]])
    return np.asarray(1.0 + 0.05 * generator.standard_normal((count, 4)) @ mixing)


def bounded(trips: FloatArray, chosen: FloatArray) -> FloatArray:
    """Share of the trips that the worst of the chosen bounds, in each direction."""
    worst = (chosen @ DIRECTIONS.T).max(axis=0)
    return np.asarray(np.mean(trips @ DIRECTIONS.T <= worst, axis=0))


def test_the_worst_case_of_few_bounds_the_stated_share_of_trips_not_yet_seen():
    shares = []
    for seed in range(5):
        trips, others = features(300, seed), features(2000, 100 + seed)
        chosen = choose(trips, 0.95)
        assert chosen.level >= 0.95
        assert chosen.rows.size < 60
        shares.append(bounded(others, trips[chosen.rows]))
        assert chosen.weights.sum() == 300
        assert chosen.weights.min() >= 1
    assert np.mean(shares) > 0.97
    # A single direction of a single draw may fall short; on average none does.
    assert np.mean(shares, axis=0).min() > 0.94


@pytest.mark.parametrize("most", [1, 3, 8])
def test_so_many_at_most_and_the_level_says_what_they_reach(most):
    trips, others = features(300, 2), features(3000, 3)
    chosen = choose(trips, 0.95, most)
    assert 1 <= chosen.rows.size <= most
    assert chosen.level < 0.95
    assert bounded(others, trips[chosen.rows]).min() > chosen.level - 0.06


def test_the_set_differs_as_much_as_the_trips_do():
    """Best estimates are drawn to the mean; the set is spread out again."""
    estimated, spread, true_spread = [], [], []
    for seed in range(8):
        fits, true = drawn(18, 0.07, (900.0, 300.0, 900.0), seed)
        found = parameter_set(fits)
        assert len(found.configurations) == 18
        speed = 35.0
        spread.append(np.std([c.resistance(speed) for c in found.configurations]))
        basis = np.array([1.0, speed, speed**2])
        estimated.append(np.std(combine(fits).betas @ basis))
        true_spread.append(np.std(true @ basis))
    assert np.mean(estimated) < 0.9 * np.mean(true_spread)
    assert np.mean(spread) == pytest.approx(np.mean(true_spread), rel=0.2)


def test_the_set_says_where_each_configuration_comes_from():
    fits, _ = drawn(60, 0.05, (150.0, 60.0, 100.0), seed=7)
    digests = {fit.trip: f"{number:064x}" for number, fit in enumerate(fits)}
    summaries = summarised(fits, digests=digests)
    found = parameter_set(summaries)
    assert len(found.configurations) < 60
    assert found.cover["trips"] == 60
    assert found.cover["level"] >= found.cover["asked"] == 0.95
    assert sum(detail["stands_for"] for detail in found.details) == 60
    assert found.weights == tuple(detail["stands_for"] for detail in found.details)
    for configuration, detail in zip(found.configurations, found.details, strict=True):
        assert detail["configuration"] == detail["trip"] == configuration.name
        assert detail["sha256"] == digests[configuration.name]
        assert detail["std"]["r2"] > 0.0
        assert np.shape(detail["fitted_correlation"]) == (4, 4)
    data = thing_to_bytes(found)
    assert thing_from_bytes(ParameterSet, data).cover == found.cover
    assert thing_to_bytes(parameter_set(summaries.iloc[::-1])) == data
    older = json.loads(data)
    del older["cover"]
    assert thing_from_bytes(ParameterSet, json.dumps(older).encode()).cover == {}


def test_trips_of_one_name_become_configurations_of_two_names():
    fits, _ = drawn(4, 0.05, (150.0, 60.0, 100.0), seed=8)
    one, other = (
        summarised(fits, digests={fit.trip: f"{k}{number:063x}" for number, fit in enumerate(fits)})
        for k in (1, 2)
    )
    shifted = other.assign(mass=other["mass"] + 5e3)
    names = [c.name for c in parameter_set(pd.concat([one, shifted])).configurations]
    assert len(set(names)) == 8
    assert "trip-000 10000000" in names


# ------------- Summaries of trips: kept in a file, put together in any order, instead of the logs


def rows(count: int = 6, seed: int = 1) -> pd.DataFrame:
    """Summaries of made-up trips, each with a digest."""
    fits, _ = drawn(count, 0.05, (150.0, 60.0, 100.0), seed)
    digests = {fit.trip: f"{seed:02d}{number:062d}" for number, fit in enumerate(fits)}
    return summarised(fits, digests=digests)


def test_a_summary_says_what_the_fit_says():
    fits, _ = drawn(3, 0.05, (150.0, 60.0, 100.0), seed=1)
    found = summarised(fits)
    assert list(found) == [column.name for column in COLUMNS]
    np.testing.assert_array_equal(parameters_of(found)[:, :3], [fit.beta for fit in fits])
    stated = ["noise_speed", "masked_braking", "windows", "outliers"]
    assert found.loc[0, stated].tolist() == [0.01, 10.0, 94, 0]
    assert found.loc[0, "speed_scale_source"] == fits[0].scale.source
    assert found.loc[0, ["asked_lowest", "asked_highest"]].tolist() == [5.0, 35.0]
    assert found.loc[0, ["speed_lowest", "speed_highest"]].tolist() == [3.0, 34.0]
    assert found["max_power"].isna().all()
    # The upper triangle is kept; below it a covariance may differ by a last bit.
    whole = [fit.covariance for fit in fits]
    np.testing.assert_allclose(covariances_of(found), whole, rtol=1e-15)
    one, other = combine(fits), combine(found)
    assert one.resistance == other.resistance
    np.testing.assert_array_equal(one.covariances, other.covariances)


@settings(max_examples=12)
@given(order=st.permutations(range(6)), cut=st.integers(1, 5))
def test_order_and_pieces_do_not_matter(order, cut):
    whole = rows()
    shuffled = whole.iloc[order]
    pieces = [shuffled.iloc[:cut], whole, shuffled.iloc[cut:]]
    pd.testing.assert_frame_equal(merged(pieces), whole, check_exact=True)
    one, other = combine(whole), combine(shuffled)
    assert one.resistance == other.resistance
    np.testing.assert_array_equal(one.betas, other.betas)


def test_summaries_survive_their_file(tmp_path):
    every = rows()
    write_summaries(every, tmp_path / "one.parquet")
    write_summaries(every.iloc[::-1], tmp_path / "other.parquet")
    pd.testing.assert_frame_equal(read_summaries(tmp_path / "one.parquet"), every, check_exact=True)
    assert (tmp_path / "one.parquet").read_bytes() == (tmp_path / "other.parquet").read_bytes()


def test_what_is_no_file_of_summaries_is_refused(tmp_path):
    path = tmp_path / "no.parquet"
    path.write_bytes(b"PAR1 and nothing more")
    refused(InputError, "not a Parquet file", read_summaries, path)
    rows().to_parquet(path)
    refused(InputError, "not a trainlog/summaries file", read_summaries, path)
    refused(InputError, "does not exist", read_summaries, tmp_path / "missing.parquet")
    refused(InputError, "lacks column 'mass'", write_summaries, rows().drop(columns="mass"), path)
    with pytest.raises(InputError, match="unknown column 'weather'"):
        write_summaries(rows().assign(weather="wet"), path)


@pytest.mark.parametrize(
    ("column", "value"),
    [("r1", np.nan), ("mass", -1.0), ("covariance_r0_r0", 0.0), ("covariance_r0_r1", 1e9)],
)
def test_a_row_that_would_spoil_all_trips_is_refused(column, value, tmp_path):
    bad = rows()
    bad.loc[3, column] = value
    with pytest.raises(InputError, match="'trip-003': numbers that no fit gives"):
        write_summaries(bad, tmp_path / "bad.parquet")
    for together in (combine, parameter_set, fleet_resistance):
        refused(InputError, "'trip-003': numbers that no fit gives", together, bad)


def test_a_damaged_file_is_refused(tmp_path):
    path = tmp_path / "damaged.parquet"
    write_summaries(rows(300), path)
    data = bytearray(path.read_bytes())
    for place in range(2000, len(data) // 2, 400):
        data[place] ^= 0xFF
    path.write_bytes(bytes(data))
    refused(InputError, "damaged", read_summaries, path)


def test_known_logs_are_not_read_again_and_nothing_changes(tmp_path):
    trips = [trip(name=f"made-{k}", noise=0.03, seed=k, duration=600.0) for k in range(2)]
    trips.append(trip(constant_speed, name="dull", noise=0.03, duration=600.0))
    logs = [tmp_path / f"{one.name}.mcap" for one in trips]
    for one, path in zip(trips, logs, strict=True):
        write_log(one, path)
    whole = fit(logs)
    for name, part in (("a", logs[:1]), ("b", logs[1:])):
        write_summaries(fit(part).summaries, tmp_path / f"{name}.parquet")
    summaries = [tmp_path / "b.parquet", tmp_path / "a.parquet"]
    again = fit([*summaries, *logs])
    assert again.known == 3
    assert not again.trips
    assert not again.refused
    assert thing_to_bytes(again.parameters) == thing_to_bytes(whole.parameters)
    pd.testing.assert_frame_equal(again.summaries, whole.summaries, check_exact=True)
    alone = fit(summaries)
    assert thing_to_bytes(alone.parameters) == thing_to_bytes(whole.parameters)
    assert whole.parameters.cover["refused"] == {"condition": 1}


def test_variance_between_trips_maximises_the_restricted_likelihood():
    """Nothing near the answer is likelier, prior included."""
    generator = np.random.default_rng(3)
    roots = 0.05 * generator.standard_normal((40, 3, 3))
    variances = roots @ roots.transpose(0, 2, 1) + 1e-4 * np.eye(3)
    noise = np.einsum(
        "kij,kj->ki", np.linalg.cholesky(variances), generator.standard_normal((40, 3))
    )
    values = 1.0 + 0.07 * generator.standard_normal((40, 3)) + noise
    expected, trust = 0.0025 * np.eye(3), 2.0

    def likelihood(between: FloatArray) -> float:
        total = variances + between
        weight = np.linalg.inv(total)
        information = weight.sum(axis=0)
        mean = np.linalg.solve(information, np.einsum("kij,kj->i", weight, values))
        away = values - mean
        fit = np.einsum("ki,kij,kj->", away, weight, away) + np.linalg.slogdet(information)[1]
        fit += np.linalg.slogdet(total)[1].sum()
        prior = np.linalg.slogdet(between)[1] + np.trace(np.linalg.solve(between, expected))
        return float(-0.5 * (fit + trust * prior))

    found = mixed_effects(values, variances, (), expected, trust, tail=np.inf, tolerance=1e-9)
    best = likelihood(found.within)
    for _ in range(200):
        change = 1e-4 * generator.standard_normal((3, 3))
        assert likelihood(found.within + change + change.T) <= best + 1e-9

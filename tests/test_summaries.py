"""Summaries of trips: kept in a file, put together in any order, instead of the logs."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from resistance_trips import constant_speed, trip

from analysis.resistance import combine, summarised
from analysis.resistance.logs import fit
from estimators.mixed import mixed_effects
from tests.test_resistance_together import drawn
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.formats.declared import thing_to_bytes
from trainlog.formats.summaries import (
    COLUMNS,
    covariances_of,
    merged,
    parameters_of,
    read_summaries,
    write_summaries,
)
from trainlog.mcap import write_log


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

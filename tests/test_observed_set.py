"""The observed set: few configurations whose worst case bounds a stated share of trips."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from analysis.resistance import combine, parameter_set, summarised
from analysis.resistance.observed import choose
from tests.test_resistance_together import drawn
from trainlog.arrays import FloatArray
from trainlog.formats.declared import thing_from_bytes, thing_to_bytes
from trainlog.railway.train import ParameterSet

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


def test_the_worst_case_of_few_bounds_the_stated_share_of_trips_not_yet_seen() -> None:
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
def test_so_many_at_most_and_the_level_says_what_they_reach(most: int) -> None:
    trips, others = features(300, 2), features(3000, 3)
    chosen = choose(trips, 0.95, most)
    assert 1 <= chosen.rows.size <= most
    assert chosen.level < 0.95
    assert bounded(others, trips[chosen.rows]).min() > chosen.level - 0.06


def test_the_set_differs_as_much_as_the_trips_do() -> None:
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


def test_the_set_says_where_each_configuration_comes_from() -> None:
    fits, _ = drawn(60, 0.05, (150.0, 60.0, 100.0), seed=7)
    digests = {fit.trip: f"{number:064x}" for number, fit in enumerate(fits)}
    summaries = summarised(fits, digests=digests)
    found = parameter_set(summaries)
    assert len(found.configurations) < 60
    assert found.cover["trips"] == 60
    assert found.cover["level"] >= found.cover["asked"] == 0.95
    assert sum(detail["stands_for"] for detail in found.details) == 60
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


def test_trips_of_one_name_become_configurations_of_two_names() -> None:
    fits, _ = drawn(4, 0.05, (150.0, 60.0, 100.0), seed=8)
    one, other = (
        summarised(fits, digests={fit.trip: f"{k}{number:063x}" for number, fit in enumerate(fits)})
        for k in (1, 2)
    )
    shifted = other.assign(mass=other["mass"] + 5e3)
    names = [c.name for c in parameter_set(pd.concat([one, shifted])).configurations]
    assert len(set(names)) == 8
    assert "trip-000 10000000" in names

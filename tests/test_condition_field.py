"""Lasting condition, passing spots and changes: known answers, and truths it does not know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from simulated_line import level_line

from analysis.adhesion.condition_map import LEVELS, empty_map
from analysis.verification.forecasts import rolling_forecast
from trainlog.condition import estimated, layer_before
from trainlog.railway.condition import ConditionLayer
from trainlog.railway.evidence import DailyEvidence

LINE = level_line(2_500.0)
BINS = 100
DAY = 20_000
TRIP_STD = 0.12
"""With which the evidence is weighted."""


def met(
    day: int, place: int, level: float, borne: float, bins: int = 3, std: float = 0.03
) -> DailyEvidence:
    """A trip with onsets at `level` in a few bins; everywhere else it used `borne` without slip."""
    weight, logs = np.zeros(BINS), np.zeros(BINS)
    slipped = slice(place, place + bins)
    weight[slipped] = 1.0 / (TRIP_STD**2 + std**2)
    logs[slipped] = weight[slipped] * np.log(level)
    used = np.zeros((BINS, LEVELS.size))
    used[:, int(np.searchsorted(LEVELS, borne))] = weight == 0.0
    return DailyEvidence.of_bins(day, weight > 0.0, weight, logs, used)


def calm(day: int, borne: float) -> DailyEvidence:
    return met(day, 0, 0.1, borne, bins=0)


def layer_of(pieces: list[DailyEvidence]) -> ConditionLayer:
    known = ConditionLayer.unestimated(DailyEvidence.total(pieces))
    return estimated(replace(empty_map(LINE), layers={"wet": known})).layer("wet")


def day(number: int) -> pd.Timestamp:
    return pd.Timestamp(0, tz="UTC") + pd.Timedelta(days=DAY + number, hours=6)


class TestWhatPasses:
    def test_a_spot_has_its_place_and_days_and_is_not_the_lasting_condition(self):
        """Thirty days of trips that bear 0.15; on the last three a spot of 0.07 in three bins."""
        pieces = [calm(DAY + number, 0.15) for number in range(27)]
        visited = layer_of(pieces + [met(DAY + n, 40, 0.07, 0.15) for n in range(27, 30)])
        assert np.all(visited.quantile(0.5)[40:43] > 0.14)
        # Yesterday counts, last month hardly.
        assert visited.expected(day(30)).below(0.1)[41] > 0.3
        assert visited.expected(day(75)).below(0.1)[41] < 0.1
        assert visited.expected(day(30)).below(0.1)[80] < 0.1
        (spot,) = visited.spots
        assert (spot.start, spot.end) == (1000.0, 1075.0)
        assert (spot.first - DAY, spot.last - DAY) == (27, 29)
        assert spot.low < 0.07 < spot.high
        assert spot.alive(day(30)) > 10.0 * spot.alive(day(75))

    def test_a_place_that_is_always_low_is_lasting(self):
        layer = layer_of([met(DAY + number, 40, 0.08, 0.15) for number in range(0, 30, 3)])
        assert np.all(np.abs(layer.log_mean[40:43] - np.log(0.08)) < 0.1)
        assert layer.spots == ()
        assert layer.changes == ()


class TestChanges:
    @pytest.mark.parametrize(("before", "after"), [(0.08, 0.16), (0.16, 0.08)])
    def test_a_change_is_dated_and_not_averaged_away(self, before, after):
        """Slip at one level for twenty days, then at another: ground, or grown over."""
        pieces = [met(DAY + number, 38, before, 0.06, bins=6) for number in range(0, 40, 2)]
        pieces += [met(DAY + number, 38, after, 0.06, bins=6) for number in range(40, 56, 2)]
        layer = layer_of(pieces)
        (change,) = layer.changes
        assert abs(change.day - DAY - 40) <= 2
        assert change.earliest <= change.day <= change.latest
        assert change.before == pytest.approx(before, rel=0.1)
        assert change.after == pytest.approx(after, rel=0.1)
        assert change.significance > 3.0
        assert np.all(np.abs(layer.log_mean[38:44] - np.log(after)) < 1.96 * layer.log_std[38:44])


def test_what_one_day_alone_showed_may_have_passed():
    normal = [met(DAY + n, 4 + 12 * n, 0.16, 0.05, bins=8) for n in range(7)]
    once = layer_of([*normal, *(met(DAY + 3, 90, 0.08, 0.05) for _ in range(6))])
    assert once.quantile(0.5)[91] < 0.1
    assert once.quantile(0.975)[91] > 0.14, "a spot of that day is in the band, too"
    often = [met(DAY + 3 * n, 90, 0.08, 0.05) for n in range(6)]
    assert layer_of([*normal, *often]).quantile(0.975)[91] < 0.11


@pytest.mark.parametrize("place_from", [pytest.param(None, marks=pytest.mark.long), 7])
def test_levels_stay_at_those_of_the_onsets_however_many_calm_trips(place_from):
    """Every trip bears 0.13 and all slip is at 0.16, but for a place that is slippery later.

    What was borne without slip allows any level above: a spread between trips that grows with it
    must not lift the levels above all onsets. Days are asked for from the last to the first.
    """
    pieces = []
    for number in range(16):
        pieces += [calm(DAY + number, 0.13), met(DAY + number, 20 + 3 * number, 0.16, 0.13)]
        if place_from is not None and number >= place_from:
            pieces.append(met(DAY + number, 10, 0.07, 0.13))
    known = ConditionLayer.unestimated(DailyEvidence.total(pieces))
    track = replace(empty_map(LINE), layers={"wet": known})
    forecast = rolling_forecast(track)
    for number in (15, 8):
        whole, found = layer_before(track, DAY + number, "wet"), forecast("wet", day(number))
        level = whole.quantile(0.5)[20:]
        assert np.all((level > 0.145) & (level < 0.18)), number
        assert found.quantile(0.5).tobytes() == whole.expected(day(number)).quantile(0.5).tobytes()
        assert whole.model["trip_std"].value < 0.12


def test_without_evidence_parameters_are_assumed_and_with_it_estimated():
    """Levels of places and trips are drawn with numbers that the map does not know."""
    generator = np.random.default_rng(4)
    places = np.log(0.2) + 0.1 * generator.standard_normal(BINS)
    pieces = []
    for number in range(30):
        weight = np.zeros(BINS)
        seen = generator.uniform(size=BINS) < 0.5
        weight[seen] = 1.0 / (TRIP_STD**2 + 0.03**2)
        logs = weight * (places + 0.06 * generator.standard_normal(BINS))
        none = np.zeros((BINS, LEVELS.size))
        pieces.append(DailyEvidence.of_bins(DAY + number, seen, weight, logs, none))
    model = layer_of(pieces).model
    trip = model["trip_std"]
    assert trip.source == "estimated"
    assert trip.value == pytest.approx(0.05, abs=0.015)
    assert model["mean"].value == pytest.approx(np.log(0.2), abs=0.1)
    assert model["spot_life"].source == "assumed"
    empty = layer_of([calm(DAY, 0.02)]).model
    assert {each.source for each in empty.values()} == {"assumed"}


@pytest.mark.parametrize("length", [300.0, 1_000.0, 2_500.0])
def test_bins_longer_than_a_slippery_place_have_the_level_of_their_onsets(length):
    """Of ten bins one was met at 0.06, the others at 0.12, on each of twenty days."""
    levels = np.where(np.arange(10) == 2, 0.06, 0.12)
    weight, unused = np.full(10, 1.0 / TRIP_STD**2), np.zeros((10, LEVELS.size))
    pieces = [
        DailyEvidence.of_bins(DAY + n, weight > 0.0, weight, weight * np.log(levels), unused)
        for n in range(20)
    ]
    known = ConditionLayer.unestimated(DailyEvidence.total(pieces))
    line = level_line(10.0 * length)
    found = estimated(replace(empty_map(line, length), layers={"wet": known})).layer("wet")
    assert found.quantile(0.5) == pytest.approx(levels, rel=0.1)
    assert found.model["slippery_length"].value > 0.0

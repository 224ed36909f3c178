"""What a controller may count on, of a map made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from pandas import Timestamp
from refusals import refused
from simulated_line import flirt, level_line
from trajectory_cases import observed

from analysis.adhesion.condition_map import SETTINGS
from analysis.adhesion.map_state import (
    demonstrated_adhesion,
    risk_of_run,
    typical_adhesion,
    usable_adhesion,
)
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.errors import InputError
from trainlog.railway.condition import AdhesionEstimate, ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence

LEVELS = np.array([0.04, 0.06, 0.08, 0.10])
BINS = 40


def made(
    seen: dict[int, float] | None = None, demonstrated: dict[tuple[int, int], float] | None = None
) -> TrackConditionMap:
    """A map with estimates of 10 per cent where seen, and trips that bore levels."""
    observed, mean, censored = np.zeros(BINS, bool), np.zeros(BINS), np.zeros((BINS, LEVELS.size))
    for index, adhesion in (seen or {}).items():
        observed[index], mean[index] = True, np.log(adhesion)
    for place, trips in (demonstrated or {}).items():
        censored[place] = trips
    nothing = np.zeros(BINS)
    known = DailyEvidence.of_bins(0, nothing, nothing, nothing, censored)
    layer = ConditionLayer(mean, np.full(BINS, 0.1), observed, evidence=known)
    return TrackConditionMap(
        "line", 25.0 * BINS, 25.0, LEVELS, {"wet": layer}, settings=dict(SETTINGS)
    )


def test_each_bin_is_seen_demonstrated_or_assumed():
    track = made({3: 0.07}, {(8, 3): 4.0, (9, 0): 4.0})
    found = usable_adhesion(track, "wet", assumed=0.05)
    assert np.flatnonzero(found.seen).tolist() == [3]
    assert np.flatnonzero(found.demonstrated).tolist() == [8]
    assert np.all(found.seen.astype(int) + found.demonstrated + found.assumed == 1)
    assert found.values[3] == pytest.approx(0.07 * np.exp(-0.1))
    assert np.all(found.values[found.assumed] == 0.05)
    assert found.profile(210.0) == found.values[8] > 0.05


@given(st.lists(st.integers(0, 5), min_size=4, max_size=4), st.floats(0.0, 3.0), st.integers(0, 3))
def test_no_more_is_counted_on_than_was_demonstrated_and_further_trips_take_nothing_away(
    trips, sigmas, further
):
    demonstrated = {(5, k): float(count) for k, count in enumerate(trips)}
    before = demonstrated_adhesion(made(demonstrated=demonstrated), "wet", sigmas)[5]
    highest = max((LEVELS[k] for k, count in enumerate(trips) if count), default=0.0)
    assert before <= highest
    demonstrated[5, further] += 1.0
    assert demonstrated_adhesion(made(demonstrated=demonstrated), "wet", sigmas)[5] >= before


@pytest.mark.parametrize(
    ("settings", "assumed", "words"),
    [(SETTINGS, 0.0, "above 0 and at most 1, not 0"), ({}, 0.05, "lacks the setting 'trip_std'")],
)
def test_what_cannot_be_counted_on_is_refused(settings, assumed, words):
    track = replace(made(), settings=settings)
    refused(InputError, words, usable_adhesion, track, "wet", assumed=assumed)


def test_a_risk_is_the_share_of_trips_that_find_less_at_a_place():
    track = made({3: 0.07, 9: 0.1})
    generator = np.random.default_rng(1)
    for risk in (0.05, 0.2):
        found = usable_adhesion(track, "wet", risk=risk)
        assert np.flatnonzero(found.seen).tolist() == [3, 9]
        met = 0.07 * np.exp(0.1 * generator.standard_normal(20_000))
        assert np.mean(met < found.values[3]) == pytest.approx(risk, abs=0.01)
    # What was demonstrated is read with the same caution, and so is what is typical.
    bold, careful = (
        usable_adhesion(made({3: 0.07}, {(8, 3): 4.0}), "wet", risk=risk, assumed=0.01)
        for risk in (0.3, 0.01)
    )
    assert careful.values[8] < bold.values[8] < 0.1
    typical = [typical_adhesion(track, "wet", risk=risk) for risk in (0.01, 0.05, 0.5)]
    assert typical == sorted(typical)
    for risk in (0.0, 1.0, -0.1, np.nan):
        with pytest.raises(InputError, match="a risk must be between 0 and 1"):
            usable_adhesion(track, "wet", risk=risk)


def test_a_risk_is_read_for_the_time_of_the_run():
    class Fading(ConditionLayer):
        """Expects half of the adhesion until a time."""

        def expected(self, time: Timestamp | None = None) -> AdhesionEstimate:
            worse = time is None or time < Timestamp("2026-11-22", tz="UTC")
            mean = self.log_mean - (np.log(2.0) if worse else 0.0)
            return AdhesionEstimate(mean, self.log_std, self.observed)

    known = made({3: 0.07})
    layer = known.layer("wet")
    fading = Fading(layer.log_mean, layer.log_std, layer.observed, evidence=layer.evidence)
    track = replace(known, layers={"wet": fading})
    early, late = Timestamp("2026-11-21T06:00Z"), Timestamp("2026-11-23T06:00Z")
    for options in ({"risk": 0.05}, {"sigmas": 1.0}):
        now, then = (
            usable_adhesion(track, "wet", time=time, **options).values[3] for time in (early, late)
        )
        assert then == pytest.approx(2.0 * now)
    # Without a time a risk is that right after the last evidence; deviations are of what lasts.
    assert usable_adhesion(track, "wet", risk=0.05).values[3] < 0.04
    assert usable_adhesion(track, "wet", sigmas=1.0).values[3] > 0.06
    line = replace(level_line(track.length), name=track.line)
    options = {"end": 1_000.0, "condition_map": track, "risk": 0.05}
    cells = np.linspace(0.0, 1_000.0, BINS + 1)
    runs = [
        TrajectoryProblem(line, flirt(), observed(flirt(), 1.0), time=time, **options)
        for time in (early, late)
    ]
    assert runs[1].adhesion(cells)[3] == pytest.approx(2.0 * runs[0].adhesion(cells)[3])


@pytest.mark.parametrize("together", [0.0, 0.5, 0.95])
def test_the_risk_of_a_run_lies_between_its_bounds_however_places_hang_together(together):
    generator = np.random.default_rng(2)
    places = np.arange(10, 200, 20)
    rail = AdhesionEstimate(np.full(200, np.log(0.1)), np.full(200, 0.15), np.ones(200, bool))
    demand = np.zeros(200)
    demand[places] = rail.quantile(0.05)[0] * np.linspace(0.9, 1.0, places.size)
    least, most = risk_of_run(rail, demand, 25.0, 100.0)
    shared, own = generator.standard_normal((50_000, 1)), generator.standard_normal((50_000, 10))
    deviation = np.sqrt(together) * shared + np.sqrt(1.0 - together) * own
    met = 0.1 * np.exp(0.15 * deviation)
    failed = np.mean(np.any(met < demand[places], axis=1))
    assert least - 0.003 <= failed <= most + 0.003
    assert least == pytest.approx(0.05)
    assert risk_of_run(rail, np.zeros(200), 25.0, 100.0) == (0.0, 0.0)

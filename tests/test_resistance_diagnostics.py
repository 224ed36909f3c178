"""Residuals that are not what they are taken for are reported; refusals give their reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from resistance_trips import changed, constant_speed, trip

from analysis.resistance import TripRefusedError, fit_trip
from analysis.resistance.recording import REASONS
from analysis.resistance.regression import Residuals, diagnosed
from trainlog.arrays import FloatArray
from trainlog.trip import Trip


def residuals(value: FloatArray, speed: FloatArray | None = None) -> Residuals:
    time = np.arange(value.size, dtype=np.float64)
    return Residuals(time, 20.0 * time, np.sin(time) if speed is None else speed, value)


def test_good_residuals_raise_no_doubt() -> None:
    doubtful = 0
    for seed in range(200):
        noise = np.random.default_rng(seed).standard_normal(150)
        doubtful += bool(diagnosed(residuals(noise)).doubts)
    assert doubtful <= 4


def test_probabilities_of_good_residuals_are_spread_evenly() -> None:
    """Of few windows, too: half of the trips have less than one half."""
    found = [
        diagnosed(residuals(np.random.default_rng(seed).standard_normal(40))) for seed in range(500)
    ]
    for name in ("independence", "flatness"):
        below = np.mean([getattr(each, name) < 0.5 for each in found])
        assert below == pytest.approx(0.5, abs=0.07), name


def test_each_defect_is_reported() -> None:
    noise = np.random.default_rng(1).standard_normal(300)
    wind = np.convolve(noise, np.ones(5) / np.sqrt(5.0), mode="same")
    assert "err together" in " ".join(diagnosed(residuals(wind)).doubts)
    assert "misjudged" in " ".join(diagnosed(residuals(2.0 * noise)).doubts)
    spiky = noise.copy()
    spiky[::60] += 7.0
    assert "not normal" in " ".join(diagnosed(residuals(spiky)).doubts)
    speed = np.linspace(5.0, 35.0, 300)
    tilted = noise + (speed - 20.0) / 15.0
    for size in (1.0, 0.05):  # whatever the noise is taken for
        found = diagnosed(residuals(size * tilted, speed))
        assert "change with speed" in " ".join(found.doubts)
    nothing = diagnosed(residuals(np.zeros(20), np.full(20, 9.0)))
    assert (nothing.normality, nothing.flatness, nothing.independence) == (1.0, 1.0, 1.0)


def blind(made: Trip) -> Trip:
    return changed(made, "/train/controls", tractive_effort=np.nan)


def braked(made: Trip) -> Trip:
    return changed(made, "/train/controls", pneumatic_braking_effort=30e3)


def full_of_gaps(made: Trip) -> Trip:
    """A sample every two seconds: nothing but gaps."""
    rows = slice(None, None, 20)
    topics = {name: frame.iloc[rows] for name, frame in made.topics.items()}
    return replace(made, topics=topics)


def test_refusals_say_why_in_a_word_and_show_where() -> None:
    made = trip(noise=0.03)
    cases = {
        "not recorded": blind(made),
        "gap": full_of_gaps(made),
        "braking": braked(made),
        "standstill": trip(lambda time: np.zeros(time.size), noise=0.0, duration=600.0),
        "too short": trip(duration=150.0),
        "condition": trip(constant_speed, noise=0.03),
    }
    for reason, bad in cases.items():
        caught = refused(TripRefusedError, "", fit_trip, bad)
        assert caught.reason == reason
        assert reason in REASONS
        timeline = caught.timeline
        if reason == "not recorded":
            assert timeline is None
            continue
        assert timeline is not None
        if reason in timeline.masks:
            assert timeline.masks[reason].mean() > 0.9
    caught = refused(TripRefusedError, "", fit_trip, trip(noise=1.0, seed=1), speeds=(0.5, 44.0))
    assert caught.reason == "excitation"


def test_correlations_are_those_of_neighbours_as_far_as_there_are_any() -> None:
    value = np.array([3.0, -1.0, 2.0, -2.0, 3.0])
    about = value - 1.0
    power = 4.0 + 4.0 + 1.0 + 9.0 + 4.0
    pairs = [-4.0 - 2.0 - 3.0 - 6.0, 2.0 + 6.0 + 2.0, -6.0 - 4.0, 4.0]
    assert about @ about == power
    np.testing.assert_allclose(residuals(value).correlation(), np.array(pairs) / power)
    assert residuals(np.arange(99.0)).correlation().size == 10

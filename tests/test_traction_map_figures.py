"""What the track-condition map must show on simulated trips over the sample line."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from analysis.adhesion.condition_map import empty_map, update
from analysis.adhesion.evidence import evidence
from analysis.truth import Truth, true_adhesion, truth_of
from trainlog.arrays import FloatArray
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.railway import TrackConditionMap
from trainlog.simulation import draw_scenarios, simulate

pytestmark = pytest.mark.usefixtures("remembered")


@cache
def twelve_trips(seed: int) -> tuple[TrackConditionMap, tuple[Truth, ...]]:
    """A map of twelve trips, half of them dry, half wet, and what they truly met."""
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    empty = empty_map(line)
    pieces, truths = [], []
    for scenario in draw_scenarios(line, train, 12, seed=seed):
        trip = simulate(scenario)
        pieces.append(evidence(trip, empty))
        truth = truth_of(trip)
        assert truth is not None
        truths.append(truth)
    return update(empty, pieces)[0], tuple(truths)


def errors(seed: int, layer: str) -> tuple[FloatArray, FloatArray]:
    """Error of maximum adhesion in the bins with onsets, and of its logarithm in deviations."""
    track, truths = twelve_trips(seed)
    found = track.layer(layer)
    true = true_adhesion(track, layer, truths)
    seen = found.events > 0
    score = (found.log_mean - np.log(true)) / found.log_std
    return (found.maximum_adhesion - true)[seen], score[seen]


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_twelve_trips() -> None:
    track, truths = twelve_trips(1)
    for name, layer in track.layers.items():
        error, score = errors(1, name)
        assert error.size >= 10
        assert rms(error) <= 0.03
        assert np.mean(np.abs(score) < 1.96) > 0.85
        # Observed bins between the onsets hold as well.
        error = layer.maximum_adhesion - true_adhesion(track, name, truths)
        assert rms(error[layer.observed]) <= 0.03
        assert np.isnan(error[~layer.observed]).all()
    assert set(track.layers) == {"dry", "wet"}


@pytest.mark.long
def test_twelve_trips_on_eight_lines() -> None:
    """Each layer of each line, all together, and the share of truths in the 95 % band.

    Onsets read the maximum .002 too low; what few trips of a dry rail show of a slippery place is
    drawn towards the level of the line, by .010 on average, within its band.
    """
    every = {(seed, name): errors(seed, name) for seed in range(1, 9) for name in ("dry", "wet")}
    for error, _ in every.values():
        assert rms(error) <= 0.03
    together = np.concatenate([error for error, _ in every.values()])
    scores = np.concatenate([score for _, score in every.values()])
    assert rms(together) <= 0.015
    assert abs(np.mean(together)) < 0.005
    assert np.mean(np.abs(scores) < 1.96) > 0.93

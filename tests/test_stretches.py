"""Long logs in stretches: what is computed on them is what the whole gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from analysis import passport
from analysis.adhesion.condition_map import adhesion_map
from analysis.estimates import estimate_log, with_estimates
from analysis.resistance.logs import TOPICS, fit_log
from tests.mcap_trips import assert_same, trip_of
from trainlog.formats.railway import passport_of, with_passport
from trainlog.formats.samples import folder
from trainlog.mcap import read_log, reader as module, write_log
from trainlog.mcap.reader import stretches
from trainlog.topics import TRAIN_STATE
from trainlog.trip import Trip

WHOLE = 10**9
PARTS = 30_000
"""Rows of a stretch that parts the sample trip in three."""


@pytest.fixture(scope="module")
def log() -> Path:
    return folder() / "stopping.mcap"


def test_a_short_log_is_one_stretch(log: Path) -> None:
    (only,) = stretches(log)
    assert only.count == 1
    assert_same(only.named(), read_log(log))
    assert only.core(only.trip) is only.trip


@pytest.mark.parametrize("rows", [3_000, 50_000])
def test_stretches_part_a_log(rows: int, log: Path) -> None:
    whole = read_log(log)
    parts = list(stretches(log, rows=rows))
    assert len(parts) > 1
    assert [part.number for part in parts] == list(range(1, len(parts) + 1))
    for name, frame in whole.topics.items():
        cores = [part.core(part.trip)[name] for part in parts]
        pd.testing.assert_frame_equal(pd.concat(cores), frame, check_exact=True)
    largest = max(sum(map(len, part.core(part.trip).topics.values())) for part in parts)
    assert largest < 2 * rows
    assert all(part.trip.provenance == whole.provenance for part in parts)
    assert parts[1].named().name == f"{whole.name} (2 of {len(parts)})"


def test_a_stretch_has_the_samples_before_and_after_it(log: Path) -> None:
    parts = list(stretches(log, [TRAIN_STATE.name], rows=2_000))
    for part in parts[1:-1]:
        core = part.core(part.trip)
        assert core.start - part.trip.start == pytest.approx(
            pd.Timedelta(seconds=module.MARGIN), abs=pd.Timedelta(seconds=0.2)
        )
        assert part.trip.end > core.end


def test_a_log_without_rows_is_one_stretch(tmp_path: Path) -> None:
    write_log(trip_of(rows=0), tmp_path / "empty.mcap")
    assert [part.count for part in stretches(tmp_path / "empty.mcap")] == [1]


@pytest.fixture(scope="module")
def estimated(log: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Trip, Trip]:
    """What is estimated of a log with its passport: of the whole, and in three stretches."""
    folder = tmp_path_factory.mktemp("estimated")
    recorded, target = folder / "recorded.mcap", folder / "parts.mcap"
    trip = read_log(log)
    write_log(with_passport(trip, passport(trip)), recorded)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "ROWS", PARTS)
        patch.setattr(module, "FINER", 1)
        estimate_log(recorded, target)
    return with_estimates(read_log(recorded))[0], read_log(target)


def test_motion_and_slip_have_no_seams(estimated: tuple[Trip, Trip]) -> None:
    whole, parts = estimated
    name = "/estimates/state"
    difference = (parts[name] - whole[name]).abs()
    assert parts[name].index.equals(whole[name].index)
    assert difference["speed"].max() < 0.01
    assert difference["position"].max() < 1.0
    name = "/estimates/adhesion"
    assert parts[name].index.equals(whole[name].index)
    off = (parts[name] - whole[name]).abs()
    assert off["adhesion_1"].quantile(0.99) < 0.005
    assert off["slip_speed_1"].quantile(0.99) < 0.05


def test_running_resistance_is_not_learnt_anew_at_a_seam(estimated: tuple[Trip, Trip]) -> None:
    whole, parts = estimated
    name = "/estimates/running_resistance"
    assert len(whole[name]) > 100
    assert parts[name].index.equals(whole[name].index)
    np.testing.assert_allclose(parts[name]["resistance"], whole[name]["resistance"], rtol=1e-6)
    # What is known only grows: the deviation at like speeds never jumps back up.
    share = (parts[name]["resistance_std"] / parts[name]["resistance"]).to_numpy()
    assert share[len(share) // 2 :].max() < 0.5 * share[:10].max()


def test_what_was_recorded_stays_as_it_was(estimated: tuple[Trip, Trip], log: Path) -> None:
    recorded = read_log(log)
    for name in (TRAIN_STATE.name, "/train/axles", "/gnss/fix"):
        pd.testing.assert_frame_equal(estimated[1][name], recorded[name], check_exact=True)
    steps = [step["step"] for step in estimated[1].provenance]
    assert steps == ["simulate", "passport", "estimate"]
    assert passport_of(estimated[1]) == passport_of(estimated[0])


def test_the_map_is_nearly_that_of_the_whole(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = adhesion_map(log).track
    monkeypatch.setattr(module, "ROWS", PARTS)
    monkeypatch.setattr(module, "FINER", 1)
    parts = adhesion_map(log).track
    assert [trip["trip"] for trip in parts.trips] == [trip["trip"] for trip in whole.trips]
    for name, layer in whole.layers.items():
        other = parts.layers[name]
        assert abs(other.events.sum() - layer.events.sum()) <= 0.1 * layer.events.sum() + 1
        seen = layer.observed & other.observed
        assert np.abs(other.log_mean - layer.log_mean)[seen].max() < 0.1


@pytest.mark.parametrize(("name", "rows"), [("stopping", 1_500), ("nonstop", 25_000)])
def test_a_log_fitted_in_stretches_gives_what_the_whole_gives(
    name: str, rows: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Runs that cross a border are carried over it: the windows are the same."""
    log = tmp_path / f"{name}.mcap"
    trip = read_log(folder() / f"{name}.mcap")
    write_log(with_passport(trip, passport(trip)), log)
    whole = fit_log(log)
    monkeypatch.setattr(module, "ROWS", rows)
    assert len(list(stretches(log, TOPICS))) > 1
    parts = fit_log(log)
    assert parts.trip == whole.trip
    assert parts.windows == whole.windows
    assert parts.scale.source == whole.scale.source
    assert parts.scale.factor == pytest.approx(whole.scale.factor, rel=1e-12)
    assert parts.masked == pytest.approx(whole.masked, rel=1e-9, abs=1e-6)
    np.testing.assert_allclose(parts.residuals.time, whole.residuals.time, atol=1e-9)
    np.testing.assert_allclose(parts.beta, whole.beta, rtol=1e-8)
    assert parts.mass == pytest.approx(whole.mass, rel=1e-9)
    np.testing.assert_allclose(parts.covariance, whole.covariance, rtol=1e-6)
    assert parts.max_power == whole.max_power
    assert parts.history.time.equals(whole.history.time)

"""A trip as analyses see it: computed once; a log too long for the memory is several trips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fleet_trips import later

import analysis.adhesion.slip as slip_module
import analysis.resistance.coasting_detection as motion_module
from analysis import adhesion_map, coast_down, fit, fit_trip, geometry_of, view as module
from analysis.estimates import estimate_log, with_estimates
from analysis.reports.answers import verdict
from analysis.resistance.recording import TripRefusedError
from tests.refusals import refused
from trainlog.errors import LogError
from trainlog.formats.samples import folder
from trainlog.mcap import LogWriter, read_log, write_log
from trainlog.mcap.reader import rows_of_log
from trainlog.topics import ESTIMATED_STATE, GNSS_MOTION, TRAIN_STATE
from trainlog.trip import frame_of

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds")


@pytest.fixture(scope="module")
def nonstop() -> Path:
    return folder() / "nonstop.mcap"


@pytest.fixture(scope="module")
def there_and_back(nonstop: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample trip twice, an hour apart, as one recording."""
    trip = read_log(nonstop)
    path = tmp_path_factory.mktemp("long") / "long.mcap"
    with LogWriter(path) as writer:
        writer.add(trip)
        writer.add(later(trip, pd.Timedelta("1h")))
    return path


@pytest.mark.parametrize("call", [fit, adhesion_map, coast_down, geometry_of])
def test_infinite_numbers_are_refused_by_every_analysis(nonstop, call):
    trip = read_log(nonstop)
    for name in ("/train/state", "/gnss/motion"):
        frame = trip[name].copy()
        frame.iloc[100:105, frame.columns.get_loc("speed")] = np.inf
        said = f"{name}, column speed: trip 'trip-01' holds 5 infinite numbers; give NaN"
        refused(LogError, said, call, [trip.with_topic(frame)])


def test_the_chainage_of_satellites_serves_where_none_is_recorded(nonstop):
    trip = read_log(nonstop)
    state = trip["/train/state"]
    position = state["position"].to_numpy()
    known = {"position": position, "position_std": np.full(len(position), 2.0)}
    found = frame_of(ESTIMATED_STATE, pd.DatetimeIndex(state.index), known)
    without = state.assign(position=np.nan)
    without.attrs = state.attrs
    located = trip.with_topic(without).with_topic(found)
    assert fit_trip(located).resistance(25.0) == pytest.approx(fit_trip(trip).resistance(25.0))
    kept, refusals = with_estimates(located)
    pd.testing.assert_frame_equal(kept["/estimates/state"], found)
    assert kept["/train/state"]["position"].isna().all(), "what is not recorded stays so"
    assert not any("running resistance" in each for each in refusals)
    assert "position" not in str(verdict(located))
    said = "the fit needs it: map its column, or ingest fixes with a line"
    with pytest.raises(TripRefusedError, match=said):
        fit_trip(trip.with_topic(without))


def test_parts_of_a_long_log_leave_out_no_sample_and_share_none(there_and_back):
    whole = read_log(there_and_back, ["/train/state", "/train/axles"])
    held = rows_of_log(there_and_back, module.TOPICS)
    for rows in (held - 1, held // 7):
        parts = [part.trip for part in module.views_of(there_and_back, module.TOPICS, rows=rows)]
        for topic in whole:
            pd.testing.assert_frame_equal(pd.concat([part[topic] for part in parts]), whole[topic])
        assert len(parts) == len(module.parts_of(there_and_back, held, rows))
        assert max(sum(map(len, part.topics.values())) for part in parts) < 1.5 * rows


def test_maps_and_coasting_take_all_parts_of_a_long_log(there_and_back, nonstop, monkeypatch):
    alone = adhesion_map(nonstop).track
    coasted = coast_down(nonstop)
    monkeypatch.setattr(
        module, "ROWS", rows_of_log(nonstop, (*slip_module.TOPICS, "/environment")) + 1_000
    )
    both = adhesion_map(there_and_back).track
    assert [each["trip"] for each in both.trips] == ["trip-01"]
    for name, layer in alone.layers.items():
        np.testing.assert_array_equal(both.layers[name].events, 2 * layer.events)
    monkeypatch.setattr(module, "ROWS", rows_of_log(nonstop, motion_module.TOPICS) + 1_000)
    twice = coast_down(there_and_back)
    assert len(twice.trips) == 2 * len(coasted.trips)


def test_estimates_of_a_long_log_keep_what_was_recorded(
    there_and_back, nonstop, monkeypatch, tmp_path
):
    monkeypatch.setattr(module, "ROWS", rows_of_log(nonstop) + 1_000)
    assert estimate_log(there_and_back, tmp_path / "parts.mcap") == ()
    parts, recorded = read_log(tmp_path / "parts.mcap"), read_log(there_and_back)
    assert parts.name == recorded.name
    for name in ("/train/state", "/train/axles", "/gnss/fix"):
        pd.testing.assert_frame_equal(parts[name], recorded[name], check_exact=True)
    estimated = parts["/estimates/state"]
    assert estimated.index.equals(recorded["/train/state"].index)
    error = estimated["speed"] - recorded["/truth"]["speed"].to_numpy()
    assert np.sqrt(np.mean(error**2)) < 0.05


def test_a_long_log_without_positions_is_parted_by_its_speed(there_and_back, tmp_path):
    motion = read_log(there_and_back, [GNSS_MOTION.name])
    write_log(motion, tmp_path / "speeds.mcap")
    rows = len(motion[GNSS_MOTION.name])
    views = list(module.views_of(tmp_path / "speeds.mcap", rows=rows // 2 + 100))
    assert len(views) == 2
    together = pd.concat([view.trip[GNSS_MOTION.name] for view in views])
    pd.testing.assert_frame_equal(together, motion[GNSS_MOTION.name])
    fixes = read_log(there_and_back, ["/gnss/fix"])
    write_log(fixes, tmp_path / "fixes.mcap")
    parts = module.views_of(tmp_path / "fixes.mcap", rows=100)
    refused(LogError, "knows neither position nor speed", next, parts)


def test_a_long_log_is_parted_where_the_train_turned_back(tmp_path, nonstop):
    """Out and back, with falling chainage on the way back: two runs, not one every few metres."""
    trip = read_log(nonstop, [TRAIN_STATE.name])
    state = trip[TRAIN_STATE.name]
    length = float(state["position"].iloc[-1])
    back = state.assign(position=length - state["position"])
    back.index = state.index + (state.index[-1] - state.index[0]) + pd.Timedelta("2min")
    with LogWriter(tmp_path / "both.mcap") as writer:
        writer.add(trip)
        writer.add(trip.with_topic(back))
        again = state.set_axis(back.index + (back.index[-1] - back.index[0]) + pd.Timedelta("2min"))
        writer.add(trip.with_topic(again))
    rows = len(state) + 1_000
    views = list(module.views_of(tmp_path / "both.mcap", [TRAIN_STATE.name], rows=rows))
    ends = [view.trip[TRAIN_STATE.name]["position"].iloc[[0, -1]].tolist() for view in views]
    assert len(views) == 3
    for (first, last), way in zip(ends, (1, -1, 1), strict=True):
        assert way * (last - first) > 0.95 * length

"""Logs of one trip as one log: nothing is lost, and nothing contradictory becomes one."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import refused

import trainlog
from tests.mcap_trips import assert_same, trip_of
from trainlog.errors import InputError, LogError
from trainlog.mcap import read_log, write_log
from trainlog.mcap.convert import merge
from trainlog.topics import EVENTS, GNSS_FIX, TRAIN_AXLES, TRAIN_STATE
from trainlog.trip import Trip

STATE = TRAIN_STATE.name


@pytest.fixture
def whole() -> Trip:
    return trip_of(rows=200, topics=[STATE, GNSS_FIX.name, EVENTS.name])


def written(trip: Trip, path: Path) -> Path:
    write_log(trip, path)
    return path


@pytest.mark.parametrize(("cuts", "backwards"), [((0.5,), False), ((0.2, 0.21, 0.9), True)])
def test_parts_in_any_order_are_the_whole(cuts, backwards, whole, tmp_path):
    """Each instant of a cut is in both parts, and once in the whole."""
    length = whole.end - whole.start
    edges = [None, *(whole.start + share * length for share in cuts), None]
    parts = [
        written(whole.between(*ends), tmp_path / f"{number}.mcap")
        for number, ends in enumerate(pairwise(edges))
    ]
    done = merge(parts[::-1] if backwards else parts, tmp_path / "whole.mcap")
    found = read_log(tmp_path / "whole.mcap")
    assert found == whole
    assert done.rows == {name: len(frame) for name, frame in whole.topics.items()}
    step = found.provenance[-1]
    assert step["step"] == "merge"
    assert len(step["inputs"]) == len(parts)
    assert [each["file"] for each in step["others"]] == [
        path.name for path in (parts[::-1] if backwards else parts)[1:]
    ]


def test_topics_of_several_recorders_come_together(whole, tmp_path):
    axles = trip_of(rows=150, topics=[TRAIN_AXLES.name, EVENTS.name])
    second = Trip(axles.topics, whole.metadata | {"clock": "another"}, ({"step": "its own"},))
    paths = [written(whole, tmp_path / "a.mcap"), written(second, tmp_path / "b.mcap")]
    merge(paths, tmp_path / "both.mcap")
    found = read_log(tmp_path / "both.mcap")
    assert found[STATE].equals(whole[STATE])
    assert found[TRAIN_AXLES.name].equals(axles[TRAIN_AXLES.name])
    every = pd.concat([whole[EVENTS.name], axles[EVENTS.name]]).reset_index().drop_duplicates()
    assert len(found[EVENTS.name]) == len(every)
    assert found.metadata["clock"] == whole.metadata.get("clock", "another")
    (other,) = found.provenance[-1]["others"]
    assert other["provenance"] == [{"step": "its own"}]
    assert other["metadata"]["clock"] == "another"


def test_different_samples_of_a_topic_are_refused_or_one_log_is_preferred(whole, tmp_path):
    state = whole[STATE].copy()
    state["speed"] = state["speed"] + 1.0
    other = replace(whole.with_topic(state), provenance=())
    paths = [written(whole, tmp_path / "a.mcap"), written(other, tmp_path / "b.mcap")]
    with pytest.raises(LogError, match=r"b.mcap: holds other samples of /train/state than .*a.mca"):
        merge(paths, tmp_path / "both.mcap")
    assert not (tmp_path / "both.mcap").exists()
    for path, trip in zip(paths, (whole, other), strict=True):
        done = merge(paths, tmp_path / "both.mcap", prefer=path)
        assert_same(
            Trip({STATE: read_log(tmp_path / "both.mcap")[STATE]}), Trip({STATE: trip[STATE]})
        )
        assert done.left_out[STATE] + done.repeated[STATE] == 200
        assert done.left_out[STATE] > 100


def test_logs_of_two_trips_are_refused(whole, tmp_path):
    for key in ("train", "line", "direction"):
        first = replace(whole, metadata=whole.metadata | {key: "one"})
        second = replace(whole, metadata=whole.metadata | {key: "two"})
        paths = [written(first, tmp_path / "a.mcap"), written(second, tmp_path / "b.mcap")]
        with pytest.raises(LogError, match=f"states {key} 'two', .*a.mcap states 'one'"):
            merge(paths, tmp_path / "both.mcap")
    refused(InputError, "name two logs at least", merge, paths[:1], tmp_path / "both.mcap")
    refused(InputError, "given twice", merge, [paths[0], paths[0]], tmp_path / "both.mcap")
    refused(InputError, "would be overwritten", merge, paths, paths[0])


def test_what_logs_disagree_on_is_left_out_and_attachments_are_kept(whole, tmp_path):
    first = replace(whole, metadata=whole.metadata | {"load": "1000"}, attachments={"n": b"1"})
    second = Trip({}, {"load": "2000"}, (), {"n": b"2", "m": b"3"})
    paths = [written(first, tmp_path / "a.mcap"), written(second, tmp_path / "b.mcap")]
    done = merge(paths, tmp_path / "both.mcap")
    found = read_log(tmp_path / "both.mcap")
    assert "load" not in found.metadata
    assert found.attachments == {"n": b"1", "b/n": b"2", "m": b"3"}
    assert done.notes == [
        "load is left out, the logs state 1000 and 2000",
        f"attachment n of {paths[1]} differs: kept as b/n",
    ]


def test_the_commands_cut_and_merge(tmp_path, works):
    log = "sample_logs/nonstop.mcap"
    parts = [tmp_path / f"{number}.mcap" for number in range(2)]
    works("convert", log, "-o", parts[0], "--to", "600s")
    works("convert", log, "-o", parts[1], "--from", "600s")
    shown = works("convert", *parts, "-o", tmp_path / "again.mcap")
    assert "1 row of /train/state in two logs alike: kept once" in shown
    again, whole = trainlog.read(tmp_path / "again.mcap"), trainlog.read(log)
    assert again == whole
    assert again.attachments == whole.attachments
    assert np.all(again[STATE].index == whole[STATE].index)

"""Logs written at once and piece by piece, and disks that do not take them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from mcap.reader import SeekingReader
from mcap_trips import START, assert_same, trip_of
from refusals import refused

from trainlog.errors import LogError
from trainlog.mcap import LogWriter, read_log, write_log
from trainlog.topics import EVENTS, TRAIN_AXLES, TRAIN_CONTROLS, TRAIN_STATE
from trainlog.trip import Trip, frame_of


@cache
def long_trip() -> Trip:
    """Three megabytes in five minutes: chunks cut by size and by time."""
    rows = np.arange(6000)
    dense = frame_of(
        TRAIN_CONTROLS,
        START + np.concatenate([rows[:3000] * 10**7, 10**11 + rows[3000:] * 3 * 10**7]),
        {name.name: np.random.default_rng(n).normal(size=6000) for n, name in enumerate(FIELDS)},
    )
    axles = frame_of(TRAIN_AXLES, START + rows * 5 * 10**7, {"wheel_speed": np.ones((6000, 25))})
    return trip_of(rows=40, step=7 * 10**9).with_topic(dense).with_topic(axles)


FIELDS = TRAIN_CONTROLS.fields


def pieces(trip: Trip, cuts: list[pd.Timestamp]) -> Iterator[Trip]:
    """The trip cut at times; each piece with all topics."""
    edges = [pd.Timestamp(0, tz="UTC"), *cuts, pd.Timestamp.max.tz_localize("UTC")]
    for start, end in pairwise(edges):
        frames = {
            name: frame[(frame.index >= start) & (frame.index < end)]
            for name, frame in trip.topics.items()
        }
        yield Trip(frames, trip.metadata, trip.provenance, trip.attachments)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "trip.mcap"
    write_log(long_trip(), path)
    return path


def write_pieces(path: Path, *pieces: Trip) -> None:
    with LogWriter(path) as log:
        for piece in pieces:
            log.add(piece)


@settings(max_examples=8)
@given(st.lists(st.integers(-(10**9), 301 * 10**9), max_size=6))
def test_any_pieces_give_the_same_bytes(whole, tmp_path_factory, cuts):
    path = tmp_path_factory.getbasetemp() / "pieces.mcap"
    times = [pd.Timestamp(START + cut, tz="UTC") for cut in sorted(cuts)]
    write_pieces(path, *pieces(long_trip(), times))
    assert path.read_bytes() == whole.read_bytes()


def test_chunks_are_full_but_neither_too_long_nor_too_large(whole):
    summary = SeekingReader(BytesIO(whole.read_bytes())).get_summary()
    chunks = summary.chunk_indexes
    assert len(chunks) >= 5
    for index, following in pairwise(chunks):
        assert index.message_end_time - index.message_start_time < 60 * 10**9
        assert index.message_end_time <= following.message_start_time
        assert index.uncompressed_size <= 2**20
        full = index.uncompressed_size > 2**20 - 1000
        assert full or following.message_start_time - index.message_start_time >= 60 * 10**9


def test_a_topic_may_come_late_and_without_a_piece_there_is_an_empty_log(tmp_path):
    first, second = pieces(trip_of(rows=50), [pd.Timestamp(START + 2 * 10**9, tz="UTC")])
    late = {name: frame for name, frame in first.topics.items() if name != EVENTS.name}
    write_pieces(tmp_path / "trip.mcap", Trip(late), second)
    found = read_log(tmp_path / "trip.mcap")
    assert len(found[EVENTS.name]) == len(second[EVENTS.name])
    assert len(found[TRAIN_STATE.name]) == 50
    write_pieces(tmp_path / "none.mcap")
    assert read_log(tmp_path / "none.mcap").topics == {}


def test_pieces_that_do_not_follow_each_other_are_refused(tmp_path):
    first, second = pieces(trip_of(rows=50), [pd.Timestamp(START + 2 * 10**9, tz="UTC")])
    other = Trip({TRAIN_AXLES.name: second[TRAIN_AXLES.name].iloc[:, :0]})
    caught = refused(LogError, "begins before", write_pieces, tmp_path / "trip.mcap", second, first)
    assert caught.file == tmp_path / "trip.mcap"
    refused(LogError, "number of axles", write_pieces, tmp_path / "trip.mcap", first, other)
    assert list(tmp_path.iterdir()) == []


def test_a_block_that_fails_leaves_the_older_file(tmp_path):
    older = trip_of(rows=3)
    write_log(older, tmp_path / "trip.mcap")
    with pytest.raises(ZeroDivisionError), LogWriter(tmp_path / "trip.mcap") as log:
        log.add(trip_of(rows=1 // len(list(tmp_path.glob("*.txt")))))
    assert [path.name for path in tmp_path.iterdir()] == ["trip.mcap"]
    assert_same(read_log(tmp_path / "trip.mcap"), older)
